# SPDX-License-Identifier: MIT
"""A folder of its own and the simulated bus, for command lines that run in the test's process."""

from __future__ import annotations

from pathlib import Path

import can
import pytest


def settle(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Work in ``folder``, keep journals and backups there, and let python-can know the simulated bus.

    A checkout that is not installed has no entry point for it.
    """
    patch.chdir(folder)
    patch.setenv("PMSMTOOL_HOME", str(folder / "home"))
    patch.setattr("can.util.VALID_INTERFACES", frozenset({*can.VALID_INTERFACES, "pmsmsim"}))
    patch.setitem(can.interfaces.BACKENDS, "pmsmsim", ("pmsmtool.sim.bus", "PmsmSimBus"))
