"""From bus options to an open bus, a node or a drive."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.options import FILE, BusOptions
from pmsmtool.errors import BusError, ConfigError

if TYPE_CHECKING:
    from pmsmtool.bus.connection import Connection
    from pmsmtool.drive.canopen_drive import CanopenDrive
    from pmsmtool.drive.drive_node import DriveNode
    from pmsmtool.firmware.drive_map import DriveMap


def map_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``--map`` to a command, which receives ``map_file: Path | None``."""
    text = "Map of the drive's objects: TOML file, or family (`firmware-params`)."
    return click.option("--map", "map_file", type=FILE, metavar="FILE", help=text)(function)


def read_map(path: Path | None) -> DriveMap:
    """Return the drive map of a file or a shipped family, the reference drive's without one."""
    from pmsmtool.firmware.drive_map import reference_map
    from pmsmtool.firmware.drive_map_file import parse_drive_map
    from pmsmtool.firmware.shipped_maps import family_names, load_family

    if path is None:
        return reference_map()
    if str(path) in family_names() and not path.is_file():
        return load_family(str(path))
    try:
        return parse_drive_map(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read: {error}", where=str(path)) from error


@contextmanager
def open_node(bus: BusOptions, drive_map: DriveMap | None = None) -> Iterator[DriveNode]:
    """Open the bus and the node on it; without ``-n`` the only drive there is."""
    from pmsmtool.drive.drive_node import DriveNode

    with bus.connect() as connection:
        node = DriveNode(connection, choose_node(connection, bus.node), drive_map=drive_map)
        yield node
        node.close()


@contextmanager
def open_drive(bus: BusOptions, drive_map: DriveMap | None = None) -> Iterator[CanopenDrive]:
    """Open the bus and the drive on it, ready for experiments.

    Raises
    ------
    NotAvailable
        The drive lacks the reference drive's objects.
    """
    from pmsmtool.drive.canopen_drive import CanopenDrive
    from pmsmtool.errors import NotAvailable, SdoAbort

    with bus.connect() as connection:
        try:
            drive = CanopenDrive(connection, choose_node(connection, bus.node), drive_map=drive_map)
        except SdoAbort as abort:
            raise NotAvailable(
                "this drive does not have the objects that experiments and commissioning need",
                where=abort.where,
                likely="a drive of another family",
                hint="`pmsmtool caps` lists what it can give and what is missing",
            ) from abort
        yield drive
        drive.close()


def choose_node(connection: Connection, node: int | None) -> int:
    """Return the node id to use.

    Raises
    ------
    BusError
        No drive answers.
    ConfigError
        Several do, and none was named.
    """
    from pmsmtool.bus.scan import find_nodes

    if node is not None:
        return node
    found = find_nodes(connection)
    drives = [entry.node for entry in found if entry.is_drive] or [entry.node for entry in found]
    if len(drives) == 1:
        return drives[0]
    if not drives:
        likely, hint = connection.explain_silence(0)
        raise BusError("no drive answers", where=str(connection.bus.channel_info), likely=likely, hint=hint)
    raise ConfigError(f"several nodes answer: {', '.join(map(str, drives))}", hint="choose one with -n")
