# SPDX-License-Identifier: MIT
"""The drive contract on the simulated drive in this process."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from pmsmtool.drive.canopen_drive import CanopenDrive
from tests.drive.bench import sim_bench
from tests.drive.contract import DriveContract


class TestPmsmSim(DriveContract):
    @pytest.fixture
    def drive(self) -> Iterator[CanopenDrive]:
        with sim_bench() as bench:
            yield bench.drive
