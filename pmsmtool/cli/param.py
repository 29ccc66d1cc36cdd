# SPDX-License-Identifier: MIT
"""``pmsmtool param``: parameters by catalogue name or object."""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.drive_access import (
    LOOKING_S,
    OWN_FAMILY,
    WHOLE_SET_S,
    difference_of_drive,
    map_of_drive,
    map_option,
    new_file,
    open_node,
    read_map,
    warn_of_other_drive,
)
from pmsmtool.cli.options import BusOptions, MotionOptions, bus_options, examples, output_options, write_options
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import BusError, CheckFailed, ConfigError, NotAvailable, PmsmtoolError, SdoAbort
from pmsmtool.files import write_file
from pmsmtool.plain_text import counted
from pmsmtool.units import parse_quantity

if TYPE_CHECKING:
    from pmsmtool.drive.drive_node import DriveNode
    from pmsmtool.drive_maps.drive_map import DriveMap
    from pmsmtool.params.parameter_set import Difference, ParameterSet

_ADDRESS = re.compile(r"(0[xX][0-9a-fA-F]{1,4})(?::([0-9a-fA-F]{1,2}))?")


@click.group(
    "param",
    epilog=examples("pmsmtool -i pmsmsim param get 'motor.*'", "pmsmtool param help current.K_p_d_v_per_a"),
)
def param_command() -> None:
    """Read, write, compare and explain parameters, by catalogue name (wildcards) or as 0x2010:02."""


@param_command.command(
    "get", epilog=examples("pmsmtool -i pmsmsim param get 'motor.*'", "pmsmtool -n 5 param get 0x2010:02 0x1018:04")
)
@click.argument("names", nargs=-1, required=True)
@map_option
@bus_options
@output_options
def get_command(bus: BusOptions, out: Output, names: tuple[str, ...], map_file: Path | None) -> None:
    """Print parameters in SI, or the bytes of any object.

    An object given by its address is read as bytes where the map is not this drive's. What cannot be read is named in
    its row; the exit code is that of the worst.
    """
    addresses = [text for text in names if _ADDRESS.fullmatch(text)]
    of_no_map = len(addresses) == len(names) and map_file is None
    drive_map = read_map(None) if of_no_map else map_of_drive(bus, map_file)
    wanted = [entry for name in names for entry in _resolve(name, drive_map)]
    with open_node(bus, None if of_no_map else drive_map, within_s=LOOKING_S) as node:
        if difference_of_drive(node):
            raw = {_resolve(text, drive_map)[0][1] for text in addresses}
            wanted = [("" if where in raw else name, where) for name, where in wanted]
            if any(name for name, _ in wanted):
                warn_of_other_drive(node, out)
        else:
            _say_staged(node, out)
        entries, failures = _read_all(node, wanted)
    heads = ("name", "value", "unit", "object")
    if len(entries) > 1 or not failures:
        out.result(
            "param-get",
            {"parameters": entries},
            lambda: table(heads, [(e["name"], _text(e), e["unit"], e["object"]) for e in entries]),
        )
    if failures:
        raise max(failures, key=_badness)


@param_command.command(
    "set",
    epilog=examples(
        "pmsmtool -i pmsmsim --yes param set current.K_p_d_v_per_a=7.5 motor.R_s_ohm=0.14",
        "pmsmtool -n 5 param set speed.filter_hz=150 --store",
    ),
)
@click.argument("assignments", nargs=-1, required=True, metavar="NAME=VALUE...")
@click.option("--store", is_flag=True, help="Also keep them over a reset.")
@map_option
@bus_options
@write_options
@output_options
def set_command(
    bus: BusOptions,
    motion: MotionOptions,
    out: Output,
    assignments: tuple[str, ...],
    store: bool,
    map_file: Path | None,
) -> None:
    """Write parameters; a plain number is in the unit of the name. They act until the next reset unless stored.

    The change is a transaction as in flash-params: journal, write, read back, roll back on any failure.
    """
    from pmsmtool.cli.flash_session import carry_out
    from pmsmtool.flash.download import set_named
    from pmsmtool.params.parameter_set import ParameterSet

    drive_map = map_of_drive(bus, map_file, OWN_FAMILY)
    values: dict[str, float] = {}
    for assignment in assignments:
        values |= _assignment(assignment, drive_map)
    with set_named() as jobs, open_node(bus, drive_map, within_s=WHOLE_SET_S) as node:
        carry_out(node, jobs, ParameterSet(values), bus, motion, out, command="param-set", store=store)


@param_command.command(
    "dump",
    epilog=examples("pmsmtool -i pmsmsim param dump --all > params.toml", "pmsmtool -n 5 param dump -o now.toml"),
)
@click.option("--all", "everything", is_flag=True, help="Also the values that equal the factory defaults.")
@new_file("path", help="File to write; default: standard output.")
@map_option
@bus_options
@output_options
def dump_command(bus: BusOptions, out: Output, everything: bool, path: Path | None, map_file: Path | None) -> None:
    """Print the drive's parameters as a parameter set that flash-params takes."""
    with open_node(bus, map_of_drive(bus, map_file), within_s=WHOLE_SET_S) as node:
        warn_of_other_drive(node, out)
        _say_staged(node, out)
        held = _device_set(node, out)
    text = (held if everything else _without_defaults(held)).to_toml()
    if path is not None:
        write_file(path, text)
        out.note(f"wrote {path}")
        return
    data = {"content": held.content_hash(), "values": held.values, "tables": held.tables}
    out.result("param-dump", data, text.rstrip("\n").split("\n"))


@param_command.command(
    "diff",
    epilog=examples(
        "pmsmtool -i pmsmsim param diff default device",
        "pmsmtool param diff old/params.toml new/params.toml --check",
    ),
)
@click.argument("old")
@click.argument("new")
@click.option("--check", is_flag=True, help="Exit code 1 when they differ.")
@map_option
@bus_options
@output_options
def diff_command(bus: BusOptions, out: Output, old: str, new: str, check: bool, map_file: Path | None) -> None:
    """Compare any two of: device, default, a parameter set, a design, a DCF, a run directory."""
    from pmsmtool.params.parameter_set import compare

    drive_map = map_of_drive(bus, map_file) if "device" in (old, new) else read_map(map_file)
    if "device" in (old, new):
        with open_node(bus, drive_map, within_s=WHOLE_SET_S) as node:
            warn_of_other_drive(node, out)
            held = _device_set(node, out)
            sets = [held if side == "device" else _side(side, drive_map) for side in (old, new)]
    else:
        sets = [_side(side, drive_map) for side in (old, new)]
    for given in sets:
        drive_map = drive_map.without(drive_map.refused(given))
    first, second = (drive_map.quantised(given) for given in sets)
    differences = compare(first, second, common_only=True)
    lacking = drive_map.not_written(dict.fromkeys(name for side in sets for name in (*side.values, *side.tables)))
    equal = [name for name in first.values if name in second.values and first.values[name] == second.values[name]]
    facts = {"old": old, "new": new, "differences": differences, "equal": equal, "not_written": lacking}
    rows = [_difference_cells(d) for d in differences]
    out.result("param-diff", facts, lambda: table(("name", old, new, "unit", "change"), rows))
    out.note(f"{counted(len(differences), 'difference')} among what both hold")
    for name, why in lacking.items():
        (out.note if name in drive_map.left_out else out.detail)(f"not compared, not written: {name}: {why}")
    unnamed = len(lacking.keys() - drive_map.left_out.keys())
    if unnamed:
        out.note(f"not compared, not written: {unnamed} entries that the map has no row for (-v names them)")
    if check and differences:
        raise CheckFailed(
            f"{counted(len(differences), 'difference')} found",
            where=f"{old} and {new}",
            hint="the table above names them; `pmsmtool flash-params` writes a set",
        )


@param_command.command("help", epilog=examples("pmsmtool param help governor.k_max", "pmsmtool param help 'motor.*'"))
@click.argument("names", nargs=-1, required=True)
@output_options
def help_command(out: Output, names: tuple[str, ...]) -> None:
    """Explain parameters: meaning, unit, bounds, factory value, object."""
    from pmsmtool.drive_maps.drive_map import reference_map
    from pmsmtool.params.catalogue import BY_NAME

    rows = [BY_NAME[name] for text in names for name, _ in _resolve(text, reference_map()) if name]
    heads = ("name", "meaning", "unit", "default", "from", "to", "object", "while enabled")
    cells = [
        (
            row.name, row.meaning, row.unit, f"{row.default:.9g}", f"{row.minimum:.9g}", f"{row.maximum:.9g}",
            f"0x{row.index:04X}:{row.sub:02X}", "yes" if row.live else "no",
        )
        for row in rows
    ]  # fmt: skip
    out.result("param-help", {"parameters": rows}, lambda: table(heads, cells))


# ---- names and values ------------------------------------------------------------------------------------

_Entry = tuple[str, tuple[int, int]]
"""Catalogue name (empty: none) and object."""


def _resolve(text: str, drive_map: DriveMap) -> list[_Entry]:
    """Return what a name, a wildcard or an object means.

    Raises ConfigError: nothing has that name; NotAvailable: the map has no object for it.
    """
    from pmsmtool.params.catalogue import BY_NAME

    address = _ADDRESS.fullmatch(text)
    if address is not None:
        wanted = int(address[1], 16), int(address[2] or "0", 16)
        names = [name for name in drive_map.cells if drive_map.address(name) == wanted]
        return [(names[0] if names else "", wanted)]
    found = [name for name in drive_map.cells if fnmatch.fnmatchcase(name, text)]
    if not found and text in BY_NAME:
        raise NotAvailable(
            f"the map {drive_map.name!r} has no object for {text}",
            hint="`pmsmtool caps` lists what it has, and why a value is left out",
        )
    if not found:
        near = _near(text, drive_map.cells)
        raise ConfigError(
            f"no parameter is named {text!r}",
            hint=f"did you mean {' or '.join(near)}?" if near else "pmsmtool param help '*' lists them",
        )
    return [(name, drive_map.address(name)) for name in found]


def _near(text: str, names: Collection[str]) -> list[str]:
    """Return at most three names that were probably meant: those that contain the text, else those alike."""
    import difflib

    alike = [name for name in names if text.lower() in name.lower()] or difflib.get_close_matches(text, names, n=1)
    return alike[:3]


def _assignment(text: str, drive_map: DriveMap) -> dict[str, float]:
    name, equals, value = text.partition("=")
    if not equals:
        raise ConfigError(f"{text!r} is no NAME=VALUE", hint="write it like motor.R_s_ohm=0.1")
    entries = _resolve(name, drive_map)
    if not entries[0][0]:
        raise ConfigError(
            f"{name} is no parameter of this drive's map", hint="its meaning and type must be known: --map"
        )
    return {entry: _number(value, entry) for entry, _ in entries}


def _number(text: str, name: str) -> float:
    """Return a value: plain in the unit of the name, hexadecimal, or with a unit of its own."""
    from pmsmtool.params.catalogue import BY_NAME

    try:
        return float(int(text, 16)) if text.lower().startswith("0x") else float(text)
    except ValueError:
        try:
            return parse_quantity(text, BY_NAME[name].unit)
        except ConfigError as error:
            raise ConfigError(error.what, where=name, likely=error.likely, hint=error.hint) from None


# ---- reading ---------------------------------------------------------------------------------------------


def _read_all(node: DriveNode, wanted: list[_Entry]) -> tuple[list[dict[str, Any]], list[PmsmtoolError]]:
    """Return what each object holds, or why it could not be read, and these errors."""
    entries, failures = [], []
    for entry in wanted:
        try:
            entries.append(_read(node, entry))
        except PmsmtoolError as error:
            name, (index, sub) = entry
            where = f"0x{index:04X}:{sub:02X}"
            entries.append({"name": name or where, "value": None, "unit": "", "object": where, "error": error.what})
            failures.append(error)
    return entries, failures


def _badness(error: PmsmtoolError) -> int:
    """Order errors: what the drive does not have, what it refuses, what it does not answer."""
    return 2 if isinstance(error, BusError) else 0 if isinstance(error, NotAvailable) else 1


def _read(node: DriveNode, entry: _Entry) -> dict[str, Any]:
    from pmsmtool.drive.parameters import DriveParameters
    from pmsmtool.params.catalogue import BY_NAME

    name, (index, sub) = entry
    where = f"0x{index:04X}:{sub:02X}"
    if name:
        value = DriveParameters(node).read_value(name)
        return {"name": name, "value": value, "unit": BY_NAME[name].unit, "object": where}
    data = node.sdo.read(index, sub)
    return {"name": where, "value": None, "unit": "", "object": where, "bytes": data.hex()}


def _text(entry: dict[str, Any]) -> str:
    if "error" in entry:
        return f"not read: {entry['error']}"
    if entry["value"] is not None:
        return f"{entry['value']:.9g}"
    data = bytes.fromhex(entry["bytes"])
    shown = data[:16].hex(" ") + (" .." if len(data) > 16 else "")
    return f"{shown} (= {int.from_bytes(data, 'little')})" if 0 < len(data) <= 4 else shown


def _say_staged(node: DriveNode, out: Output) -> None:
    from pmsmtool.drive.parameters import DriveParameters

    try:
        if DriveParameters(node).is_staged():
            out.warn("a staged set is open on the drive: the values are the staged ones, not those that act")
    except SdoAbort:
        return  # a drive without staging


def _device_set(node: DriveNode, out: Output) -> ParameterSet:
    """Return what the drive holds; rows of a family's map that this drive lacks are left out and told."""
    from pmsmtool.drive.parameters import DriveParameters
    from pmsmtool.flash.map_gate import map_on

    held = map_on(node)
    for name in (name for name in node.map.cells if name not in held.cells):
        out.warn(f"left out: {name}: {held.left_out[name]}")
    return held.decode(DriveParameters(node).read([*held.cells, *held.tables]))


def _without_defaults(held: ParameterSet) -> ParameterSet:
    from pmsmtool.drive_maps.drive_map import reference_map
    from pmsmtool.params.parameter_set import ParameterSet, default_set

    factory = reference_map().quantised(default_set()).values
    values = {name: value for name, value in held.values.items() if value != factory.get(name)}
    return ParameterSet(values, held.tables, held.provenance, held.name)


def _side(text: str, drive_map: DriveMap) -> ParameterSet:
    from pmsmtool.commissioning.parameter_source import load_parameters
    from pmsmtool.params.parameter_set import default_set

    return default_set() if text == "default" else load_parameters(Path(text), drive_map)


def _difference_cells(difference: Difference) -> tuple[str, ...]:
    def text(value: float | None) -> str:
        return "-" if value is None else f"{value:.9g}"

    change = "" if math.isnan(difference.relative) else f"{100.0 * difference.relative:+.3g} %"
    if difference.cells:
        change = f"{counted(difference.cells, 'cell')}, the first shown"
    return difference.name, text(difference.old), text(difference.new), difference.unit, change
