# SPDX-License-Identifier: MIT
"""pmsmtool: commission permanent-magnet synchronous motor drives over CANopen.

The names below are the documented Python interface; they are imported when first used, because importing
``pmsmtool`` must cost nothing (a command line that prints its help needs none of them).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pmsmtool.bus.connect import connect as connect
    from pmsmtool.commissioning.commission import commission as commission
    from pmsmtool.commissioning.design_stages import lut as lut
    from pmsmtool.commissioning.parameter_source import load_parameters as load_parameters
    from pmsmtool.commissioning.report_page import report_page as report_page
    from pmsmtool.design.design_file import load_design as load_design
    from pmsmtool.design.lookup.design import LookupRequest as LookupRequest
    from pmsmtool.design.loops.margins import margin_report as margin_report
    from pmsmtool.design.tolerance import tolerance_box as tolerance_box
    from pmsmtool.design.tune import tune as tune
    from pmsmtool.design.tune_request import TuneRequest as TuneRequest
    from pmsmtool.drive.canopen_drive import CanopenDrive as CanopenDrive
    from pmsmtool.drive.envelope import Envelope as Envelope
    from pmsmtool.drive.guard import guarded as guarded
    from pmsmtool.errors import ExitCode as ExitCode
    from pmsmtool.errors import PmsmtoolError as PmsmtoolError
    from pmsmtool.machine.machine_file import MachineFile as MachineFile
    from pmsmtool.machine.machine_file import load_machine_file as load_machine_file
    from pmsmtool.machine.parameters import Estimate as Estimate
    from pmsmtool.machine.parameters import InverterParameters as InverterParameters
    from pmsmtool.machine.parameters import MachineParameters as MachineParameters
    from pmsmtool.papers.registry import reproduce as reproduce
    from pmsmtool.params.parameter_set import ParameterSet as ParameterSet
    from pmsmtool.sim.scenarios import Scenario as Scenario
    from pmsmtool.sim.simulate import simulate as simulate
    from pmsmtool.trace import Trace as Trace
    from pmsmtool.trace import read_trace as read_trace

__version__ = "0.1.0"

_HOME = {
    "PmsmtoolError": "pmsmtool.errors",
    "ExitCode": "pmsmtool.errors",
    "Trace": "pmsmtool.trace",
    "read_trace": "pmsmtool.trace",
    "Estimate": "pmsmtool.machine.parameters",
    "MachineParameters": "pmsmtool.machine.parameters",
    "InverterParameters": "pmsmtool.machine.parameters",
    "MachineFile": "pmsmtool.machine.machine_file",
    "load_machine_file": "pmsmtool.machine.machine_file",
    "ParameterSet": "pmsmtool.params.parameter_set",
    "load_parameters": "pmsmtool.commissioning.parameter_source",
    "TuneRequest": "pmsmtool.design.tune_request",
    "tune": "pmsmtool.design.tune",
    "LookupRequest": "pmsmtool.design.lookup.design",
    "lut": "pmsmtool.commissioning.design_stages",
    "load_design": "pmsmtool.design.design_file",
    "tolerance_box": "pmsmtool.design.tolerance",
    "margin_report": "pmsmtool.design.loops.margins",
    "Scenario": "pmsmtool.sim.scenarios",
    "simulate": "pmsmtool.sim.simulate",
    "reproduce": "pmsmtool.papers.registry",
    "connect": "pmsmtool.bus.connect",
    "CanopenDrive": "pmsmtool.drive.canopen_drive",
    "Envelope": "pmsmtool.drive.envelope",
    "guarded": "pmsmtool.drive.guard",
    "identify": "pmsmtool.measurement.identify",
    "commission": "pmsmtool.commissioning.commission",
    "report_page": "pmsmtool.commissioning.report_page",
}
"""Public name -> module that defines it."""

__all__ = [
    "PmsmtoolError",
    "ExitCode",
    "Trace",
    "read_trace",
    "Estimate",
    "MachineParameters",
    "InverterParameters",
    "MachineFile",
    "load_machine_file",
    "ParameterSet",
    "load_parameters",
    "TuneRequest",
    "tune",
    "LookupRequest",
    "lut",
    "load_design",
    "tolerance_box",
    "margin_report",
    "Scenario",
    "simulate",
    "reproduce",
    "connect",
    "CanopenDrive",
    "Envelope",
    "guarded",
    "identify",
    "commission",
    "report_page",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for."""
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'pmsmtool' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
