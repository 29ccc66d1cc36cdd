# SPDX-License-Identifier: MIT
"""``[vendor_tuning]`` of a drive map: how a drive's own identification is started, and what its answers mean.

The OS command object of CiA 301 (0x1023, with its mode 0x1024) takes the number of a measurement and answers with its
result. A wrong number here starts something unknown in a drive that moves a machine, so that everything must be said:
which mode, which command, how long, what it moves, and what one count of its result is worth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pmsmtool.params.catalogue import BY_NAME

if TYPE_CHECKING:
    from pmsmtool.drive_maps.drive_map import Cell

TABLE = "vendor_tuning"
KIND = "os_command"
ORDERS = ("little", "big")

OS_COMMAND = 0x1023
"""OS command (CiA 301, 7.5.2.26): sub 1 takes a command and starts it, sub 2 tells its status, sub 3 the answer."""
OS_COMMAND_MODE = 0x1024
"""OS command mode (CiA 301, 7.5.2.27)."""
EXECUTE_AT_ONCE, ABORT = 0, 3
"""Values of 0x1024: the next command is carried out at once; the present one is given up."""
COMMAND_BYTES = 8
"""Length of a command and of an answer: number, then data; status, reserved, then data."""
DATA_AT = 2
"""First byte of the data in an answer; in that of a failed command the error code."""
DONE, DONE_WITH_DATA, FAILED, FAILED_WITH_CODE = 0, 1, 2, 3
"""Status of a command that has ended; everything else: it is running."""

RESULTS: Mapping[str, str] = {
    "motor.pole_pairs": "poles",
    "motor.R_s_ohm": "R",
    "motor.L_d_h": "L",
    "motor.L_q_h": "L",
    "motor.psi_f_wb": "psi",
}
"""What a drive's own identification may tell, by catalogue name, and the quantity ``identify`` asks for it by."""
LONGEST_S = 600.0
"""No measurement of a drive's own takes longer; a larger time-out is a mistake."""
_KEYS = ("kind", "mode", "source", "order", "failures", "steps")
_STEP_KEYS = ("command", "timeout_s", "turns", "moves", "uses", "failures")
_VALUE_KEYS = ("type", "unit", "factor", "form", "source")

Complain = Callable[[tuple[str, ...], str], None]
"""Told the path of a key and what is wrong with it."""
ParseCell = Callable[[str, Any, tuple[str, ...]], "Cell | None"]
"""Reads a row of a value: its name, the row, its path."""


@dataclass(frozen=True, slots=True)
class VendorStep:
    """One measurement of the drive's own."""

    name: str
    """Catalogue name of its result, or what it checks."""
    timeout_s: float
    """Longest time it may take (s)."""
    turns: bool
    """Whether the shaft must be free to turn."""
    moves: str
    """What it does to the machine, as a person reads it before consenting."""
    command: int
    """Its number as OS command."""
    uses: tuple[str, ...] = ()
    """Catalogue names of results the drive works with: written into it before, as far as they were measured."""
    failures: Mapping[int, str] = field(default_factory=dict)
    """Its own error codes."""

    @property
    def title(self) -> str:
        """Its name as a person reads it."""
        return self.name.removeprefix("motor.")


@dataclass(frozen=True, slots=True)
class VendorTuning:
    """The drive's own identification."""

    mode: int
    """Mode of operation in which the drive is enabled for it."""
    steps: Mapping[str, VendorStep]
    """In the order in which they run."""
    results: Mapping[str, Cell]
    """By catalogue name: how the answer's data are read."""
    order: str = "little"
    """Byte order of the data in an answer."""
    failures: Mapping[int, str] = field(default_factory=dict)
    """Error codes that every OS command may answer."""
    source: str = ""
    """Key of ``DriveMap.sources``."""

    @property
    def quantities(self) -> frozenset[str]:
        """What can be asked of it, as ``identify`` names it."""
        return frozenset(RESULTS[name] for name in self.results)

    def steps_for(self, quantities: frozenset[str], *, turning: bool) -> tuple[VendorStep, ...]:
        """Return the steps that tell the quantities, with what they use and all checks, in order."""
        wanted = {name for name in self.results if RESULTS[name] in quantities}
        for step in reversed(tuple(self.steps.values())):
            if step.name in wanted:
                wanted |= set(step.uses)
        chosen = (step for step in self.steps.values() if step.name in wanted or step.name not in self.results)
        return tuple(step for step in chosen if turning or not step.turns)


@dataclass(frozen=True, slots=True)
class VendorAnswer:
    """What a drive answered to one step."""

    step: str
    """Name of the step."""
    data: bytes
    """Bytes of its answer as they came, the status in front."""
    seconds: float
    """Time it took (s)."""
    values: dict[str, float]
    """Results by catalogue name, SI."""
    relative_to: dict[str, float]
    """What they were counted relative to."""


# ---- the table of a map file ------------------------------------------------------------------------


def dump_vendor_tuning(tuning: VendorTuning, cell_row: Callable[[Cell], dict[str, Any]]) -> dict[str, Any]:
    """Return the table of a map file; ``cell_row`` writes a value's row."""

    def codes(failures: Mapping[int, str]) -> dict[str, str]:
        return {str(code): text for code, text in failures.items()}

    rows = {}
    for name, step in tuning.steps.items():
        row: dict[str, Any] = {"command": step.command}
        if name in tuning.results:
            row |= {key: value for key, value in cell_row(tuning.results[name]).items() if key in _VALUE_KEYS}
        row |= {"timeout_s": step.timeout_s, "turns": step.turns, "moves": step.moves}
        row |= {"uses": step.uses} if step.uses else {}
        rows[name] = row | ({"failures": codes(step.failures)} if step.failures else {})
    head = {"kind": KIND, "mode": tuning.mode, **({"source": tuning.source} if tuning.source else {})}
    return {**head, "order": tuning.order, "failures": codes(tuning.failures), "steps": rows}


def parse_vendor_tuning(
    table: Mapping[str, Any],
    cells: Mapping[str, Cell],
    sources: Mapping[str, str],
    complain: Complain,
    parse_cell: ParseCell,
) -> VendorTuning | None:
    """Read the table; everything that is wrong goes to ``complain``.

    ``cells``: objects of the map, where what a step uses is written.
    """
    said: list[str] = []

    def check(good: bool, path: tuple[str, ...], what: str) -> None:
        if not good:
            said.append(what)
            complain((TABLE, *path), f"{TABLE}: {what}")

    kind, mode, source = table.get("kind"), table.get("mode"), table.get("source", "")
    check(kind == KIND, ("kind",), f"kind {kind!r} is not {KIND}")
    for key in table:
        check(key in _KEYS, (key,), f"unknown key {key}; there are {', '.join(_KEYS)}")
    own = type(mode) is int and -128 <= mode <= -1
    check(own, ("mode",), f"mode {mode!r}: a maker's own mode of operation is a whole number from -128 to -1")
    known = isinstance(source, str) and ("source" not in table or source in sources)
    check(known, ("source",), f"source {source!r} is not in [sources]")
    order = table.get("order", "little")
    check(order in ORDERS, ("order",), f"order {order!r} is not one of {', '.join(ORDERS)}")
    failures = _parse_codes(table.get("failures", {}), ("failures",), check)
    rows = table.get("steps")
    check(isinstance(rows, dict) and bool(rows), ("steps",), "steps: no table of commands")
    steps: dict[str, VendorStep] = {}
    results: dict[str, Cell] = {}
    for name, row in rows.items() if isinstance(rows, dict) else ():
        path = ("steps", name)
        check(isinstance(row, dict), path, f"{name}: not a table")
        if not isinstance(row, dict):
            continue
        step = _parse_step(name, row, path, check)
        other = next((done.name for done in steps.values() if done.command == step.command), None)
        check(other is None, (*path, "command"), f"{name}: command {step.command} is already {other}")
        for used in step.uses:
            check(used in results, (*path, "uses"), f"{name}: uses {used}, which no step before it measures")
            check(used in cells, (*path, "uses"), f"{name}: uses {used}, which [objects] does not hold")
        steps[name] = step
        value = {key: row[key] for key in _VALUE_KEYS if key in row}
        if name not in BY_NAME:  # a check, which answers by failing or not
            check(not value, path, f"{name}: not in the parameter catalogue, so it has no {', '.join(value)}")
        elif name not in RESULTS:
            check(False, path, f"{name}: no result this program takes; there are {', '.join(RESULTS)}")
        elif (cell := parse_cell(name, {"index": OS_COMMAND, "sub": 3, **value}, (TABLE, *path))) is None:
            said.append(name)
        else:
            results[name] = cell
            form = cell.form in ("value", "torque constant")
            check(form, (*path, "form"), f"{name}: a result is a value or a torque constant")
            check(cell.size <= COMMAND_BYTES - DATA_AT, path, f"{name}: {cell.size} bytes do not fit an answer")
            lacking = cell.gain and not said and cell.gain not in results and cell.gain not in cells
            check(not lacking, path, f"{name}: its form needs {cell.gain}, which this map does not have")
    return None if said else VendorTuning(mode, steps, results, order, failures, source)  # type: ignore[arg-type]


_Check = Callable[[bool, tuple[str, ...], str], None]


def _parse_step(name: str, row: dict[str, Any], path: tuple[str, ...], check: _Check) -> VendorStep:
    """Read one command; what a person must know before it is started must be there."""
    for key in row:
        check(key in (*_STEP_KEYS, *_VALUE_KEYS), (*path, key), f"{name}: unknown key {key}")
    facts: list[Any] = [row.get(key) for key in ("command", "timeout_s", "turns", "moves")]
    command, seconds, turns, moves = facts
    number = type(command) is int and 0 <= command <= 0xFF
    check(number, (*path, "command"), f"{name}: command {command!r} is no number from 0 to 255")
    time = type(seconds) in (int, float) and math.isfinite(seconds) and 0.0 < seconds <= LONGEST_S
    check(time, (*path, "timeout_s"), f"{name}: timeout_s {seconds!r} is no time up to {LONGEST_S:g} s")
    said = type(turns) is bool
    check(said, (*path, "turns"), f"{name}: turns: say whether the shaft must be free to turn (true or false)")
    check(isinstance(moves, str) and bool(moves), (*path, "moves"), f"{name}: moves: say what it does to the machine")
    uses = row.get("uses", [])
    listed = isinstance(uses, list) and all(isinstance(used, str) for used in uses)
    check(listed, (*path, "uses"), f"{name}: uses must be a list of results")
    failures = _parse_codes(row.get("failures", {}), (*path, "failures"), check)
    return VendorStep(
        name, float(seconds) if time else 1.0, bool(turns), str(moves), command if number else -1,
        tuple(uses) if listed else (), failures,
    )  # fmt: skip


def _parse_codes(table: Any, path: tuple[str, ...], check: _Check) -> dict[int, str]:
    good: dict[int, str] = {}
    rows: Mapping[str, Any] = table if isinstance(table, dict) else {"": None}
    for key, text in rows.items():
        meant = key.isdecimal() and 0 <= int(key) <= 0xFF and isinstance(text, str) and bool(text)
        check(meant, (*path, key) if key else path, "failures: error codes from 0 to 255, each with what it means")
        if meant:
            good[int(key)] = text
    return good
