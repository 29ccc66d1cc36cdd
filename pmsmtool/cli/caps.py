# SPDX-License-Identifier: MIT
"""``pmsmtool caps``: what this very drive can give, and what is missing for the rest."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.drive_access import LOOKING_S, map_option, open_node, read_map, rehearsal_bus
from pmsmtool.cli.options import FILE, BusOptions, bus_options, examples, output_options
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import PmsmtoolError
from pmsmtool.plain_text import by_reason

if TYPE_CHECKING:
    from pmsmtool.design.tune_request import TuneRequest
    from pmsmtool.measurement.capabilities import Capabilities, Row


@click.command(
    "caps",
    epilog=examples(
        "pmsmtool --sim interior-2k2 caps",
        "pmsmtool -i socketcan -c can0 -n 5 caps --map my-drive.toml --json",
        "pmsmtool caps --eds maker.eds",
        "pmsmtool caps motor.toml --eds maker.eds",
    ),
)
@click.argument("machine", required=False, type=FILE)
@click.option("--eds", metavar="FILE", help="Ask no drive: what a drive with the objects of this EDS or DCF allows.")
@map_option
@bus_options
@output_options
def caps_command(bus: BusOptions, out: Output, machine: Path | None, map_file: Path | None, eds: str | None) -> None:
    """Show for every quantity the methods, the interval to expect, and what this drive lacks.

    The drive is only read. Without --map the map for its vendor and product is used; without such a map the objects of
    CiA 402. The intervals were measured on simulated drives of the same capability level; where none was measured, none
    is printed.

    With --eds no bus is needed: a simulated drive with the objects of the file is asked, with a motor set up in it.
    MACHINE, a machine file or profile, is that motor, and what of it the drive cannot hold is named.
    """
    from pmsmtool.drive_maps.shipped_maps import GENERIC, kin_of
    from pmsmtool.flash.map_gate import other_drive, unknown_firmware
    from pmsmtool.machine.machine_file import load_machine_file
    from pmsmtool.measurement.capabilities import examine
    from pmsmtool.measurement.changed_gains import GAIN, INTEGRAL, named_addresses
    from pmsmtool.measurement.learn_position_gain import POSITION
    from pmsmtool.params.catalogue import BY_NAME
    from pmsmtool.sim.foreign.drive import assumptions_of

    given = None if map_file is None else read_map(map_file)
    if machine is not None and eds is None:
        raise click.UsageError("give MACHINE with --eds FILE alone: a drive on the bus has its own motor")
    if eds is not None:
        bus = rehearsal_bus(bus, eds=eds, machine=machine)
        assumed = assumptions_of(eds, None if machine is None else load_machine_file(machine))
    with open_node(bus, within_s=LOOKING_S) as node:
        found = as_in_file(examine(node, given, may_try=eds is not None), eds)
        held = ((name, named_addresses(found.drive_map, name)) for name in (GAIN, INTEGRAL, POSITION))
        learned = [name for name, addresses in held if any(node.has(*address) for address in addresses)]
    refused = refused_of_design(machine, found, out)
    facts = {**_facts(found), "learned": learned, **({"refused": refused} if machine is not None else {})}
    out.result("caps", facts, lambda: _lines(found, out.verbosity > 0, asked=eds is None))
    if learned:
        out.note(f"`pmsmtool map learn` measures on the free shaft what one count is worth of: {', '.join(learned)}")
    for name, why in found.drive_map.not_written(BY_NAME).items():
        if name not in found.drive_map.left_out:
            out.detail(f"not written: {name}: {why}")
    if eds is not None:
        out.note(f"no drive was asked: this is what the objects of {eds} allow once a motor is set up")
        for line in assumed:
            out.warn(f"{eds}: {line}")
    if given is not None and given.name != GENERIC and not found.map_is_drives:
        differ = other_drive(given, found.identity.vendor, found.identity.product, found.identity.doubt)
        out.warn(f"{differ}: what is listed is that map's, and nothing is written or moved through it")
    elif not found.map_is_drives:
        kin = kin_of(found.identity.vendor)
        others = f" ({kin}: of other products of its maker)" if kin and kin != found.drive_map.name else ""
        doubt = found.identity.doubt or f"no map names this drive{others}"
        out.warn(f"{doubt}: {found.drive_map.name} was used, and nothing is written through it")
    elif firmware := unknown_firmware(found.drive_map, found.identity):
        out.warn(firmware)


def as_in_file(found: Capabilities, eds: str | None) -> Capabilities:
    """Return what a drive gives, its map as far as the drive's file agrees, with the limits that this states."""
    if eds is None:
        return found
    from pmsmtool.drive_maps import sheet_check
    from pmsmtool.sim.foreign.file_rows import read_makers_objects

    rows = read_makers_objects(eds).rows
    types = {at: row.data_type.name for at, row in rows.items()}
    limits = {at: row.bounds for at, row in rows.items()}
    written = {at for at, row in rows.items() if "w" in row.access}
    return dataclasses.replace(found, drive_map=sheet_check.as_in_file(found.drive_map, types, limits, written))


def refused_of_design(
    machine: Path | None, found: Capabilities, out: Output, request: TuneRequest | None = None
) -> dict[str, str]:
    """Say which values of a machine's design (the usual one) a drive refuses, or slows, and why; return the refused."""
    if machine is None or not found.map_is_drives or found.drive_map.staging:
        return {}
    from pmsmtool.commissioning.axis_design import refused_by_limits
    from pmsmtool.machine.machine_file import load_machine_file

    try:
        refused, slower = refused_by_limits(load_machine_file(machine), found.drive_map, request)
    except PmsmtoolError as error:
        out.warn(f"whether this drive holds a design of {machine} is not known: {error.what}")
        return {}
    for line in (*slower, *(f"this drive refuses {name}: {why}" for name, why in refused.items())):
        out.warn(f"of the design of {machine} {line}")
    return refused


def _facts(found: Capabilities) -> dict[str, Any]:
    from pmsmtool.drive_maps.drive_map_file import map_hash
    from pmsmtool.params.catalogue import BY_NAME

    return {
        "identity": found.identity,
        "map": found.drive_map.name,
        "map_sha256": map_hash(found.drive_map),
        "map_is_drives": found.map_is_drives,
        "level": found.level.value,
        "tier": found.level.value,  # the older name: scripts may read it
        "features": sorted(found.features),
        "recorder": found.recorder,
        "replaced": list(found.replaced),
        "quantities": [_row_facts(row) for row in found.rows()],
        "parameters": sorted(found.drive_map.cells),
        "left_out": dict(found.drive_map.left_out),
        "written": {name: found.drive_map.row_text(name) for name in _written(found)},
        "not_written": {**found.drive_map.not_written(BY_NAME), **_unwritten(found)},
    }


def _row_facts(row: Row) -> dict[str, Any]:
    return {
        "quantity": row.quantity,
        "method": row.method.value,
        "available": row.available,
        "needs": list(row.missing),
        "expected": [dataclasses.asdict(each) for each in row.expected],
        "note": row.note,
    }


def _written(found: Capabilities) -> list[str]:
    return [name for name in found.drive_map.cells if name not in _unwritten(found)]


def _unwritten(found: Capabilities) -> dict[str, str]:
    """Return the mapped parameters that are not written all the same, and why."""
    from pmsmtool.params.catalogue import OWN_SCALES

    if not found.map_is_drives:
        return dict.fromkeys(found.drive_map.cells, "this map does not name this drive")
    own = [name for name in found.drive_map.cells if name in OWN_SCALES]
    return dict.fromkeys(own, "the drive counts gains by it: compared with the machine, never written")


def _parameter_lines(found: Capabilities, sources: bool) -> list[str]:
    """Say value by value what `flash-params` writes; what the map does not even name is a number (-v: by name)."""
    from pmsmtool.params.catalogue import BY_NAME

    drive_map = found.drive_map
    others = len(drive_map.not_written(BY_NAME).keys() - drive_map.left_out.keys())
    reasons = ((drive_map.row_text(n) if sources else n, why) for n, why in _unwritten(found).items())
    written = {name: drive_map.cells[name] for name in _written(found)}
    rows = [
        (f"written: {n}", f"0x{row.index:04X}:{row.sub:02X}", row.wire, drive_map.scale_of(row) and "by `tune --axis`")
        for n, row in written.items()
    ]
    lines = [f"written: {drive_map.row_text(name)}" for name in written] if sources else table([""] * 4, rows)[1:]
    return [
        "",
        "of a set, `flash-params` writes what is listed here as written; nothing is written now",
        *lines,
        *(f"not written: {line}" for line in by_reason(reasons)),
        *(f"not written: {name}: {why}" for name, why in drive_map.left_out.items() if name in BY_NAME),
        *([f"not written: {others} other parameters, which the map has no row for"] if others else []),
    ]


def _lines(found: Capabilities, sources: bool, *, asked: bool) -> list[str]:
    """Return what a person reads: what is had, then what is missing and for what, then what is written.

    ``asked``: a drive was asked; else node and serial number are none.
    """
    identity = found.identity
    who = f"{identity.name}  vendor {identity.vendor:#010x}  product {identity.product:#x}".strip()
    lines = [
        f"node {identity.node}  {who}  serial {identity.serial}" if asked else who,
        f"map {found.drive_map.name} ({len(found.drive_map.cells)} parameters)  capability level {found.level}",
        *([f"recorder: {found.recorder}"] if found.recorder else []),
        *found.replaced,
        "",
    ]
    rows = found.rows()
    had = [row for row in rows if row.method != "manual" and (row.available or row.waits_for_person)]
    lines += table(
        ("quantity", "method", "expected total 95 %", ""),
        [(row.quantity, row.method.value, *_said(row)) for row in had],
    )
    by_hand = ", ".join(row.quantity for row in rows if row.method == "manual")
    lines += [f"as given, in a motor file (`pmsmtool machine new`): {by_hand}", ""]
    lacking = [row for row in rows if not row.available and not row.waits_for_person]
    reasons = ((row.quantity, f"by {row.method.value}: needs {', '.join(row.missing)}") for row in lacking)
    lines += [f"not available: {line}" for line in by_reason(reasons, " ")]
    if found.map_to_write:
        what = "it moves" if "push" in found.features else "`pmsmtool move` moves it"
        lines += ["", f"{what} with --map mine.toml: these lines, numbers of its name plate in place of ?"]
        lines += [f"    {line}" for line in found.map_to_write]
    return lines if found.drive_map.staging else [*lines, *_parameter_lines(found, sources)]


def _said(row: Row) -> tuple[str, str]:
    if row.waits_for_person:
        return ", ".join(map(str, row.expected)), f"needs {', '.join(row.missing)}"
    if row.method == "vendor":
        return "no interval", "; ".join(filter(None, ("`pmsmtool identify --method vendor`", row.note)))
    return ", ".join(map(str, row.expected)) or "not measured", row.note
