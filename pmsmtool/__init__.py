"""pmsmtool: commission permanent-magnet synchronous motor drives over CANopen.

The names below are the documented Python interface; they are imported when first used, because importing
``pmsmtool`` must cost nothing (a command line that prints its help needs none of them).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pmsmtool.errors import ExitCode as ExitCode
    from pmsmtool.errors import PmsmtoolError as PmsmtoolError
    from pmsmtool.machine.parameters import Estimate as Estimate
    from pmsmtool.machine.parameters import InverterParameters as InverterParameters
    from pmsmtool.machine.parameters import MachineParameters as MachineParameters
    from pmsmtool.trace import Trace as Trace

__version__ = "0.1.0"

_HOME = {
    "PmsmtoolError": "pmsmtool.errors",
    "ExitCode": "pmsmtool.errors",
    "Trace": "pmsmtool.trace",
    "MachineParameters": "pmsmtool.machine.parameters",
    "InverterParameters": "pmsmtool.machine.parameters",
    "Estimate": "pmsmtool.machine.parameters",
}
"""Public name -> module that defines it."""

__all__ = [
    "PmsmtoolError",
    "ExitCode",
    "Trace",
    "MachineParameters",
    "InverterParameters",
    "Estimate",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for."""
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'pmsmtool' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
