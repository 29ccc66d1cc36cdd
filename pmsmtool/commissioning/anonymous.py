# SPDX-License-Identifier: MIT
"""A run without names: what owners of real drives can send, so that others learn how a drive behaves.

Nothing is taken out of the run's texts: texts are not taken over at all. Every word of the file is one of this
program's own (a quantity, a unit, a family, a verdict); what bears another name gets a number in its place. Numbers are
those of fields that hold measurements; dates, serial numbers, node ids and hashes are none of them.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from pmsmtool.commissioning.report_page import verdict
from pmsmtool.drive.objects import LIVE, signal_unit
from pmsmtool.drive.port import Excitation
from pmsmtool.drive_maps.shipped_maps import family_names
from pmsmtool.identification.request import MACHINE, Method, stored_traces
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.measurement.capabilities import QUANTITIES, CapabilityLevel
from pmsmtool.params.catalogue import BY_NAME
from pmsmtool.params.parameter_set import read_parameter_set
from pmsmtool.refusals import REFUSALS
from pmsmtool.run_directory import RunDirectory, RunRecord, Stage, Status
from pmsmtool.trace import Trace
from pmsmtool.units import UNITS

SCHEMA = "pmsmtool.anonymous/1"
DIGITS = 9
"""Of every number: a binary32 is told by nine."""
STAGES = ("check", "identify", "tune", "lut", "margins", "flash", "verify", "prove", "track", "learn", "fingerprint")
PROGRAMS = ("pmsmtool", "python", "numpy", "scipy", "python-can")
INTERFACES = (
    "pmsmsim", "socketcan", "socketcand", "virtual", "udp_multicast", "slcan", "pcan", "ixxat", "kvaser", "vector",
    "gs_usb", "serial", "nican", "usb2can", "systec", "neovi", "canalystii", "seeedstudio", "robotell", "etas",
    "nixnet", "cantact", "iscan", "neousys", "remote",
)  # fmt: skip
"""Kinds of adapter; a plug-in of one's own bears a name."""
ESTIMATES = ("R_s_ohm", "L_d_h", "L_q_h", "L_phase_h", "L_d_app_h", "L_q_app_h", "psi_f_wb", "pole_pairs", "offset_rad",
             "direction", "J_kgm2", "B_nms", "tau_c_nm", "J_per_psi", "tau_c_per_psi", "J_per_kt",
             "tau_c_per_kt")  # fmt: skip
NUMBERS = ("value", "std", "systematic", "total_95", "coverage_factor", "n", "chi2", "T_c", "i_d_apk", "i_q_apk", "old",
           "asked", "held", "p5", "p50", "p95", "least")  # fmt: skip
"""What a row of a stage may say in numbers."""
TRACES = re.compile(
    r"(zero_current|phase_vectors|phase_pairs|levels|supply_levels|first_turn|rotation_(forward|backward)|speeds"
    r"(_after_map)?|voltage_limit|(torque_)?push_\d{1,3}|coast_\d{1,3}|map_\d{1,4}|(square|angle)_[dq]_\d{1,6})"
)
FACTS = ("period_s", "decimation", "pretrigger", "polled", "coasting", "i_command_a", "half_period", "held", "i_max_a",
         "U_dc_v", "i_bias_a")  # fmt: skip
"""Numbers that a trace may carry."""
_VERSION = re.compile(r"\d{1,4}(\.\d{1,4}){1,3}")
_OBJECT = re.compile(r"0x[0-9A-F]{4}:[0-9A-F]{2}")
_EXCITATION = tuple(item.name for item in fields(Excitation))
_WORD = 1 << 32


class _Names:
    """Known words as they are, others by a number: the same word gets the same one."""

    def __init__(self, known: Iterable[str], other: str) -> None:
        self._known, self._other, self._numbers = frozenset(known), other, dict[str, str]()

    def __call__(self, name: Any) -> str:
        text = str(name)
        return text if text in self._known else self._numbers.setdefault(text, f"{self._other}_{len(self._numbers)}")


def anonymous_text(path: Path) -> str:
    """Return the file of a run: JSON, the same bytes for the same run.

    Raises ConfigError: there is no run in the folder, or one of its files is damaged.
    """
    return json.dumps(anonymous_run(path), indent=1, allow_nan=False) + "\n"


def anonymous_run(path: Path) -> dict[str, Any]:
    """Return what :func:`anonymous_text` writes."""
    run = RunDirectory(path)
    record, found = run.read(), verdict(path)
    machine, parameters = run.path / MACHINE, run.path / "params.toml"
    known = (*ESTIMATES, *BY_NAME, *(name for name in QUANTITIES))
    names, stages = _Names(known, "value"), _Names(STAGES, "stage")
    traces, signals = _Names((), "trace"), _Names((*LIVE, "theta_m_rad", "theta_M_rad", "omega_m_rad_s"), "signal")
    return {
        "schema": SCHEMA,
        "verdict": found.kind,
        "simulated": found.simulated,
        "versions": _versions(record),
        "drive": _drive(record),
        "interface": _one_of(record.bus.get("interface"), INTERFACES),
        "stages": [_stage(stage, stages(stage.name), names) for stage in record.stages],
        "machine": _machine(machine) if machine.is_file() else {},
        "parameters": _parameters(parameters) if parameters.is_file() else {},
        "traces": {
            name if TRACES.fullmatch(name) else traces(name): _trace(trace, signals)
            for name, trace in stored_traces(run).items()
        },
    }


def _versions(record: RunRecord) -> dict[str, str]:
    told = {name: record.versions.get(name) for name in PROGRAMS}
    return {name: text for name, text in told.items() if isinstance(text, str) and _VERSION.fullmatch(text)}


def _drive(record: RunRecord) -> dict[str, Any]:
    """Vendor, product and firmware tell a kind of drive; the serial number and the texts of a drive are one's own."""
    numbers = {key: record.drive.get(key) for key in ("vendor", "product", "revision")}
    kept: dict[str, Any] = {key: n for key, n in numbers.items() if type(n) is int and 0 <= n < _WORD}
    level = _one_of(record.drive.get("level", record.drive.get("tier")), tuple(CapabilityLevel))
    family = _one_of(record.drive.get("map"), family_names())
    return kept | ({"level": level} if level else {}) | ({"map": family} if family else {})


def _one_of(text: Any, known: Sequence[str]) -> str:
    return str(text) if text in tuple(known) else ""


def _stage(stage: Stage, name: str, names: _Names) -> dict[str, Any]:
    return {
        "stage": name,
        "status": _one_of(stage.status, get_args(Status)),
        "seconds": _number(stage.seconds),
        "criteria": [bool(line.ok) for line in stage.acceptance],
        "fallbacks": len(stage.fallbacks),
        "refused": {names(quantity): _reason(text) for quantity, text in stage.refused.items()},
        "reason": _reason(stage.note),
        "values": [_row(row, names) for row in stage.values],
    }


def _reason(text: str) -> str:
    """Return the named refusal that a text tells, empty where it tells none."""
    return next((name for name in REFUSALS if re.search(rf"\b{name}\b", text)), "")


def _row(row: Mapping[str, Any], names: _Names) -> dict[str, Any]:
    kept: dict[str, Any] = {"name": names(row.get("name"))}
    kept |= {key: _number(row[key]) for key in NUMBERS if _is_number(row.get(key))}
    unit, method = _one_of(row.get("unit"), tuple(UNITS)), _one_of(row.get("source"), tuple(Method))
    place = row.get("object")
    kept |= {"object": place} if isinstance(place, str) and _OBJECT.fullmatch(place) else {}
    return kept | ({"unit": unit} if unit else {}) | ({"method": method} if method else {})


def _machine(path: Path) -> dict[str, Any]:
    found = load_machine_file(path)
    tables = {name: getattr(found, name) for name in ("machine", "inverter", "encoder", "limits")}
    known = {item.name for table in tables.values() if is_dataclass(table) for item in fields(table)}
    kept = {name: _numbers(asdict(table), known) for name, table in tables.items()}
    return kept | {"std": _numbers(found.std, known), "systematic": _numbers(found.systematic, known)}


def _parameters(path: Path) -> dict[str, Any]:
    found = read_parameter_set(path)
    tables = {name: [_number(value) for value in table] for name, table in found.tables.items()}
    return _numbers(found.values, frozenset(BY_NAME)) | tables


def _trace(trace: Trace, signals: _Names) -> dict[str, Any]:
    """A trace from its own first instant on: what its clock began at says when the run was made."""
    named = {signals(name): name for name in trace.signals}
    excitation = trace.meta.get("excitation")
    facts = _numbers(trace.meta, frozenset(FACTS))
    facts |= _numbers(excitation, frozenset(_EXCITATION)) if isinstance(excitation, Mapping) else {}
    return {
        "units": {
            shown: _one_of(trace.units[name], tuple(UNITS)) or signal_unit(shown) for shown, name in named.items()
        },
        "facts": facts,
        "t_s": _column(trace.t_s - trace.t_s[:1]),
        "signals": {shown: _column(trace.signals[name]) for shown, name in named.items()},
    }


def _numbers(table: Mapping[str, Any], known: Iterable[str]) -> dict[str, Any]:
    return {key: _number(table[key]) for key in known if key in table and _is_number(table[key])}


def _column(values: Any) -> list[float | None]:
    return [_number(float(value)) for value in np.asarray(values, dtype=np.float64)]


def _is_number(value: Any) -> bool:
    return isinstance(value, bool | int | float)


def _number(value: float | bool) -> float | bool | None:
    """Return a number in :data:`DIGITS`; one that is none, as JSON has it."""
    if isinstance(value, bool):
        return value
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
