# SPDX-License-Identifier: MIT
"""``[vendor_tuning]`` of a map file: written, read back, and refused with file and line.

A wrong number here starts something unknown in a drive that moves a machine, so that everything must be said: which
mode, which command, how long, what it moves, and what one count of its result is worth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, get_args

from pmsmtool.drive_maps.vendor_tuning import (
    COMMAND_BYTES,
    DATA_AT,
    OS_COMMAND,
    RESULTS,
    SET_UP,
    Kind,
    Order,
    VendorStep,
    VendorTuning,
)
from pmsmtool.params.catalogue import BY_NAME

if TYPE_CHECKING:
    from pmsmtool.drive_maps.drive_map import Cell

TABLE = "vendor_tuning"
LONGEST_S = 600.0
"""No measurement of a drive's own takes longer; a larger time-out is a mistake."""
START_BITS = (4, 5, 6, 9, 11, 12, 13, 14, 15)
"""Bits of the controlword that no state transition, fault reset or halt uses (CiA 402)."""
DONE_BITS = (8, 10, 12, 13, 14, 15)
"""Bits of the statusword that tell no state."""
ANSWER = (OS_COMMAND, 3)
_COMMON = ("kind", "mode", "source")
_KEYS = {
    "os_command": (*_COMMON, "order", "failures", "steps"),
    "mode": (*_COMMON, "start_bit", "done_bit", "timeout_s", "turns", "moves", "results"),
}
_STEP_KEYS = ("command", "timeout_s", "turns", "moves", "uses", "failures")
_VALUE_KEYS = ("type", "unit", "factor", "form", "source")

Complain = Callable[[tuple[str, ...], str], None]
"""Told the path of a key and what is wrong with it."""
ParseCell = Callable[[str, Any, tuple[str, ...], bool], "Cell | None"]
"""Reads a row of a value: its name, the row, its path, whether any address is allowed."""


def dump_vendor_tuning(tuning: VendorTuning, cell_row: Callable[[Cell], dict[str, Any]]) -> dict[str, Any]:
    """Return the table of a map file; ``cell_row`` writes a value's row."""
    head: dict[str, Any] = {"kind": tuning.kind, "mode": tuning.mode}
    head |= {"source": tuning.source} if tuning.source else {}
    if tuning.kind == "mode":
        step = tuning.steps[SET_UP]
        head |= {"start_bit": tuning.start_bit, "done_bit": tuning.done_bit}
        head |= {"timeout_s": step.timeout_s, "turns": step.turns, "moves": step.moves}
        return head | {"results": {name: cell_row(cell) for name, cell in tuning.results.items()}}
    rows = {}
    for name, step in tuning.steps.items():
        row: dict[str, Any] = {"command": step.command}
        if name in tuning.results:
            row |= {key: value for key, value in cell_row(tuning.results[name]).items() if key in _VALUE_KEYS}
        row |= {"timeout_s": step.timeout_s, "turns": step.turns, "moves": step.moves}
        row |= {"uses": step.uses} if step.uses else {}
        rows[name] = row | ({"failures": _code_table(step.failures)} if step.failures else {})
    return head | {"order": tuning.order, "failures": _code_table(tuning.failures), "steps": rows}


def _code_table(failures: Mapping[int, str]) -> dict[str, str]:
    return {str(code): text for code, text in failures.items()}


def parse_vendor_tuning(
    table: Mapping[str, Any],
    cells: Mapping[str, Cell],
    sources: Mapping[str, str],
    complain: Complain,
    parse_cell: ParseCell,
) -> VendorTuning | None:
    """Read the table; everything that is wrong goes to ``complain``.

    Parameters
    ----------
    cells : mapping of str to Cell
        Objects of the map, where what a step uses is written.
    """
    kind: Any = table.get("kind")
    if kind not in get_args(Kind):
        complain((TABLE, "kind"), f"{TABLE}: kind {kind!r} is none of {', '.join(get_args(Kind))}")
        return None
    said: list[str] = []

    def tell(path: tuple[str, ...], what: str) -> None:
        said.append(what)
        complain((TABLE, *path), f"{TABLE}: {what}")

    for key in table:
        if key not in _KEYS[kind]:
            tell((key,), f"unknown key {key} of kind {kind}; there are {', '.join(_KEYS[kind])}")
    mode = table.get("mode")
    if type(mode) is not int or not -128 <= mode <= -1:
        tell(("mode",), f"mode {mode!r}: a maker's own mode of operation is a whole number from -128 to -1")
    if not isinstance(table.get("source", ""), str) or ("source" in table and table["source"] not in sources):
        tell(("source",), f"source {table['source']!r} is not in [sources]")

    def row_of(name: str, row: Any, path: tuple[str, ...], anywhere: bool) -> Cell | None:
        cell = parse_cell(name, row, (TABLE, *path), anywhere)
        if cell is None:
            said.append(name)
        return cell

    head = {"kind": kind, "mode": mode, "source": table.get("source", "")}
    rest = _parse_mode(table, tell, row_of) if kind == "mode" else _parse_commands(table, cells, tell, row_of)
    if not said and "motor.psi_f_wb" in rest["results"]:
        _check_pole_pairs(rest["results"], cells, tell, "steps" if kind == "os_command" else "results")
    return None if said else VendorTuning(**head, **rest)


def _check_pole_pairs(results: Mapping[str, Cell], cells: Mapping[str, Cell], tell: Complain, table: str) -> None:
    needs = results["motor.psi_f_wb"].gain
    if needs and needs not in results and needs not in cells:
        tell((table, "motor.psi_f_wb"), f"motor.psi_f_wb: its form needs {needs}, which this map does not have")


# ---- kind "mode" -----------------------------------------------------------------------------------


def _parse_mode(table: Mapping[str, Any], tell: Complain, row_of: ParseCell) -> dict[str, Any]:
    for key, allowed in (("start_bit", START_BITS), ("done_bit", DONE_BITS)):
        if type(table.get(key)) is not int or table[key] not in allowed:
            tell((key,), f"{key} {table.get(key)!r} is none of {', '.join(map(str, allowed))}")
    facts = _facts(table, (), tell)
    rows = table.get("results", {})
    if not isinstance(rows, dict):
        tell(("results",), "results: not a table")
        rows = {}
    results = {}
    for name, row in rows.items():
        cell = _result(name, row, ("results", name), tell, row_of, anywhere=False)
        if cell is not None:
            results[name] = cell
    return {
        "start_bit": table.get("start_bit", 0),
        "done_bit": table.get("done_bit", 0),
        "steps": {SET_UP: VendorStep(SET_UP, **facts)},
        "results": results,
    }


# ---- kind "os_command" -----------------------------------------------------------------------------


def _parse_commands(
    table: Mapping[str, Any], cells: Mapping[str, Cell], tell: Complain, row_of: ParseCell
) -> dict[str, Any]:
    order = table.get("order", "little")
    if order not in get_args(Order):
        tell(("order",), f"order {order!r} is none of {', '.join(get_args(Order))}")
    rows = table.get("steps")
    if not isinstance(rows, dict) or not rows:
        tell(("steps",), "steps: no table of commands")
        rows = {}
    steps: dict[str, VendorStep] = {}
    results: dict[str, Cell] = {}
    taken: dict[int, str] = {}
    for name, row in rows.items():
        path = ("steps", name)
        if not isinstance(row, dict):
            tell(path, f"{name}: not a table")
            continue
        command = row.get("command")
        if type(command) is not int or not 0 <= command <= 0xFF:
            tell((*path, "command"), f"{name}: command {command!r} is no number from 0 to 255")
        elif command in taken:
            tell((*path, "command"), f"{name}: command {command} is already {taken[command]}")
        else:
            taken[command] = name
        facts = _facts({key: row[key] for key in _STEP_KEYS if key in row}, path, tell)
        failures = _parse_codes(row.get("failures", {}), (*path, "failures"), tell)
        cell = _answer(name, row, path, tell, row_of)
        uses = _parse_uses(name, row.get("uses", []), results, cells, path, tell)
        if cell is not None:
            results[name] = cell
        steps[name] = VendorStep(
            name, **facts, command=command if type(command) is int else 0, uses=uses, failures=failures
        )
    failures = _parse_codes(table.get("failures", {}), ("failures",), tell)
    return {"order": order, "failures": failures, "steps": steps, "results": results}


def _answer(name: str, row: Mapping[str, Any], path: tuple[str, ...], tell: Complain, row_of: ParseCell) -> Cell | None:
    """Return how the data of an answer are read; None for a check, which answers by failing or not."""
    for key in row:
        if key not in (*_STEP_KEYS, *_VALUE_KEYS):
            tell((*path, key), f"{name}: unknown key {key}")
    value = {key: row[key] for key in _VALUE_KEYS if key in row}
    if name not in BY_NAME:
        if value:
            tell(path, f"{name}: not in the parameter catalogue, so it has no {', '.join(value)}")
        return None
    address = dict(zip(("index", "sub"), ANSWER, strict=True))
    cell = _result(name, {**address, **value}, path, tell, row_of, anywhere=True)
    if cell is not None and cell.size > COMMAND_BYTES - DATA_AT:
        tell(path, f"{name}: {cell.size} bytes do not fit an answer")
    return cell


def _parse_uses(
    name: str, uses: Any, results: Mapping[str, Cell], cells: Mapping[str, Cell], path: tuple[str, ...], tell: Complain
) -> tuple[str, ...]:
    if not isinstance(uses, list) or not all(isinstance(used, str) for used in uses):
        tell((*path, "uses"), f"{name}: uses must be a list of results")
        return ()
    for used in uses:
        if used not in results:
            tell((*path, "uses"), f"{name}: uses {used}, which no step before it measures")
        elif used not in cells:
            tell((*path, "uses"), f"{name}: uses {used}, which [objects] does not hold")
    return tuple(uses)


def _parse_codes(table: Any, path: tuple[str, ...], tell: Complain) -> dict[int, str]:
    good: dict[int, str] = {}
    for key, text in table.items() if isinstance(table, dict) else [("", None)]:
        if not key.isdecimal() or not 0 <= int(key) <= 0xFF or not isinstance(text, str) or not text:
            tell((*path, key) if key else path, "failures: error codes from 0 to 255, each with what it means")
        else:
            good[int(key)] = text
    return good


# ---- both ------------------------------------------------------------------------------------------


def _facts(table: Mapping[str, Any], path: tuple[str, ...], tell: Complain) -> dict[str, Any]:
    """Check what a person must know before it is started."""
    name = f"{path[-1]}: " if path else ""
    seconds: Any = table.get("timeout_s")
    if type(seconds) not in (int, float) or not math.isfinite(seconds) or not 0.0 < seconds <= LONGEST_S:
        tell((*path, "timeout_s"), f"{name}timeout_s {seconds!r} is no time up to {LONGEST_S:g} s")
        seconds = 1.0
    if type(table.get("turns")) is not bool:
        tell((*path, "turns"), f"{name}turns: say whether the shaft must be free to turn (true or false)")
    if not isinstance(table.get("moves"), str) or not table["moves"]:
        tell((*path, "moves"), f"{name}moves: say what it does to the machine")
    return {"timeout_s": float(seconds), "turns": bool(table.get("turns")), "moves": str(table.get("moves", ""))}


def _result(
    name: str, row: Any, path: tuple[str, ...], tell: Complain, row_of: ParseCell, *, anywhere: bool
) -> Cell | None:
    if name not in RESULTS:
        tell(path, f"{name}: no result this program takes; there are {', '.join(RESULTS)}")
        return None
    cell = row_of(name, row, path, anywhere)
    if cell is not None and cell.form not in ("value", "torque constant"):
        tell((*path, "form"), f"{name}: a result is a value or a torque constant")
    return cell
