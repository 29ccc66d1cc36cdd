# SPDX-License-Identifier: MIT
"""From bus options to an open bus, a node or a drive."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import click

from pmsmtool.cli.options import DIR, FILE, SIMULATED_INTERFACE, BusOptions
from pmsmtool.cli.output import Output
from pmsmtool.errors import BusError, ConfigError, NotAvailable, SdoAbort
from pmsmtool.files import read_bytes, read_text, refuse_existing
from pmsmtool.plain_text import counted

if TYPE_CHECKING:
    from pmsmtool.bus.connection import Connection
    from pmsmtool.drive.canopen_drive import CanopenDrive
    from pmsmtool.drive.drive_node import DriveNode
    from pmsmtool.drive_maps.drive_map import DriveMap
    from pmsmtool.run_directory import RunDirectory

FORCE = "pmsmtool.force"
LOOKING_S = 30.0
"""Time for the transfers of a command that reads a few objects; a drive that answers needs a second."""
WHOLE_SET_S = 120.0
"""Time for reading all parameters and tables, 200 KiB of tables at 50 kbit/s take 80 s."""
REHEARSED = "interior-2k2"
"""Machine behind a maker's dictionary where none is given."""
OWN_FAMILY = "pmsmsim"
"""The reference drive's map, which commands take without ``--map``."""


def map_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``--map`` to a command, which receives ``map_file: Path | None``."""
    text = "Map of the drive's objects: TOML file, family (`firmware-params`), or its EDS."
    return click.option("--map", "map_file", type=FILE, metavar="FILE", help=text)(function)


def runs_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``--runs`` to a command, which receives ``runs: Path``."""
    text = "Where run directories are made."
    return click.option("--runs", type=DIR, default=Path("runs"), metavar="DIR", help=text)(function)


def new_file(*names: str, **attributes: Any) -> Callable[..., Any]:
    """Add ``-o`` of a file that files cannot give again; one that is there is replaced with ``--force`` alone."""

    def checked(ctx: click.Context, _: click.Parameter, path: Path | None) -> Path | None:
        if path is not None:
            refuse_existing(path, force=ctx.meta[FORCE])
        return path

    force = click.option("--force", is_flag=True, is_eager=True, expose_value=False, help="Replace the file.",
                         callback=lambda ctx, _, given: ctx.meta.update({FORCE: given}))  # fmt: skip
    output = click.option("-o", "--output", *names, type=FILE, metavar="FILE", callback=checked, **attributes)
    return lambda function: output(force(function))


def new_run(bus: BusOptions, drive: CanopenDrive, runs: Path, level: str = "") -> RunDirectory:
    """Make the directory of a run that begins now; its record has the command line and the bus."""
    from pmsmtool.measurement.run_account import begin_run

    return begin_run(drive, runs, command=["pmsmtool", *sys.argv[1:]], bus=bus.recorded, level=level)


def read_map(path: Path | None) -> DriveMap:
    """Return the drive map of a file or a shipped family, the reference drive's without one."""
    from pmsmtool.drive_maps.drive_map import reference_map
    from pmsmtool.drive_maps.drive_map_file import parse_drive_map
    from pmsmtool.drive_maps.eds import parse_eds
    from pmsmtool.drive_maps.sheet_check import map_of_sheet
    from pmsmtool.drive_maps.shipped_maps import family_names, load_family

    if path is None:
        return reference_map()
    if not path.is_file() and (str(path) in family_names() or (path.name == str(path) and not path.suffix)):
        return load_family(str(path))
    hint = "give a map file in UTF-8 that you may read, or the name of a shipped family"
    if path.suffix.lower() in (".eds", ".dcf"):
        return map_of_sheet(parse_eds(read_bytes(path, hint=hint), str(path)))
    return parse_drive_map(read_text(path, hint=hint), str(path))


def map_of_drive(bus: BusOptions, map_file: Path | None, other: str | None = None) -> DriveMap:
    """Return the map that is given, else that of the family of the drive that answers, else ``other`` or CiA 402."""
    from pmsmtool.drive_maps.shipped_maps import GENERIC, family_of, load_family

    if map_file is not None:
        return read_map(map_file)
    with open_node(bus, within_s=LOOKING_S) as node:
        return family_of(*node.identity().vendor_product) or load_family(other or GENERIC)


def rehearsal_bus(
    bus: BusOptions, *, eds: str | None, family: str | None = None, machine: Path | None = None
) -> BusOptions:
    """Return a simulated bus with a machine behind a maker's dictionary, in volatile memory.

    Raises ConfigError: a bus is named, too, or both a file and a family.

    Parameters
    ----------
    eds : str or None
        EDS or DCF of the drive, or ``TABLE.csv#FAMILY``.
    family : str, optional
        Shipped family whose map the drive shows, instead of a file.
    machine : Path, optional
        The machine; a profile without one.
    """
    if bus.interface is not None or bus.channel is not None:
        raise ConfigError(
            "a rehearsal needs no bus, and one is named", hint="leave out --sim, -i and -c, or --eds and --rehearse"
        )
    if eds is not None and family is not None:
        raise ConfigError("--rehearse and --eds name two drives", hint="give one of them")
    shown = f"eds={quote(eds, safe='/#')}" if eds is not None else f"drive={quote(str(family))}"
    name = REHEARSED if machine is None else str(machine)
    return replace(bus, interface=SIMULATED_INTERFACE, channel=f"{name}?nv=:memory:&{shown}")


@contextmanager
def open_node(
    bus: BusOptions, drive_map: DriveMap | None = None, *, within_s: float | None = None
) -> Iterator[DriveNode]:
    """Open the bus and the node on it; without ``-n`` the only drive there is.

    ``within_s``: what all transfers may take together, of a command that only reads.
    """
    from pmsmtool.drive.drive_node import DriveNode

    with bus.connect() as connection:
        began_s = connection.clock.now()
        node = DriveNode(connection, claimed_node(connection, bus.node), drive_map=drive_map)
        if within_s is not None:
            node.sdo.finish_within(within_s - (connection.clock.now() - began_s))
        yield node
        node.close()


def _vendor_product(node: DriveNode) -> tuple[int, int] | None:
    """Return vendor and product (0x1018), None where the drive shows none."""
    from pmsmtool.drive import objects

    try:
        vendor, product = (int.from_bytes(node.sdo.read(objects.IDENTITY, sub, size=4), "little") for sub in (1, 2))
    except SdoAbort:
        return None
    return vendor, product


def difference_of_drive(node: DriveNode) -> str:
    """Say in which way the drive is not the one of its map; empty when it is."""
    from pmsmtool.flash.map_gate import other_drive

    shown = _vendor_product(node) or (0, 0)
    shared = node.map.identity.shared and node.map.is_for(*shown)
    return other_drive(node.map, *shown, node.identity().doubt if shared else "")


def warn_of_other_drive(node: DriveNode, out: Output) -> None:
    """Say that what is read is read through the map of another drive; writing through it is refused."""
    differ = difference_of_drive(node)
    if differ:
        out.warn(f"{differ}: what is read may mean something else, and nothing is written or moved through it")


@contextmanager
def open_drive(bus: BusOptions, drive_map: DriveMap | None = None) -> Iterator[CanopenDrive]:
    """Open the bus and the drive on it, ready for experiments.

    Raises ConfigError: the map is that of another drive: nothing is moved through it; NotAvailable: the drive lacks the
    reference drive's objects.
    """
    from pmsmtool.drive.canopen_drive import CanopenDrive
    from pmsmtool.flash.map_gate import check_motion

    with bus.connect() as connection:
        try:
            drive = CanopenDrive(connection, claimed_node(connection, bus.node), drive_map=drive_map)
        except (SdoAbort, NotAvailable) as lacking:
            raise NotAvailable(
                "this command needs set-points for d and q, and a recorder at loop rate: this drive lacks them",
                where=lacking.where,
                likely="a drive with fixed firmware",
                hint="`pmsmtool move` moves it by its own position loop; `pmsmtool commission` runs what it allows, "
                "`pmsmtool caps` lists what it has",
            ) from lacking
        check_motion(drive.node.map, drive.identity)
        yield drive
        drive.close()


def claimed_node(connection: Connection, node: int | None) -> int:
    """Return the node id to use, as :func:`choose_node`, its drive locked until the connection is closed.

    Raises SecondMaster: another program works with the drive; SafetyRefusal: what an interrupted run left changed
    cannot be restored.
    """
    from pmsmtool.drive.drive_lock import claim

    chosen = choose_node(connection, node)
    claim(connection, chosen)
    _restore_left(connection, chosen)
    return chosen


def _restore_left(connection: Connection, node_id: int) -> None:
    """Bring back what a killed run left changed, before anything else is done with the drive."""
    from pmsmtool.drive.changed_objects import any_lent, restore_lent
    from pmsmtool.flash.gain_journal import any_left, restore_left

    if not (any_lent() or any_left()):
        return
    from pmsmtool.drive.drive_node import DriveNode

    node = DriveNode(connection, node_id)
    try:
        identity = node.identity()
        count = restore_lent(node, identity, partial(click.echo, err=True)) + restore_left(node, identity)
    finally:
        node.close()
    if count:
        objects = counted(count, "object")
        click.echo(f"node {node_id}: {objects} restored that an interrupted run left changed", err=True)


def choose_node(connection: Connection, node: int | None) -> int:
    """Return the node id to use. Raises BusError: no drive answers; ConfigError: several do, and none was named."""
    from pmsmtool.bus.nmt import find_nodes

    if node is not None:
        return node
    found = find_nodes(connection)
    drives = [entry.node for entry in found if entry.is_drive] or [entry.node for entry in found]
    if len(drives) == 1:
        return drives[0]
    if not drives:
        likely, hint = connection.explain_silence(0)
        raise BusError("no drive answers", where=str(connection.bus.channel_info), likely=likely, hint=hint)
    raise ConfigError(
        f"several nodes answer: {', '.join(map(str, drives))}", hint="choose one with -n; `pmsmtool scan` lists them"
    )
