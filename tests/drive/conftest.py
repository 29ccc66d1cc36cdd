# SPDX-License-Identifier: MIT
"""Recorders for the tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.drive.recorder_rig import KINDS, Opener, Rig, rig_of


@pytest.fixture(params=KINDS)
def opened(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Opener]:
    """Open a recorder of every kind, as often as a test asks for one."""
    with ExitStack() as stack:

        def start(faults: str = "") -> Rig:
            return stack.enter_context(rig_of(KINDS[request.param], tmp_path, faults))

        yield start
