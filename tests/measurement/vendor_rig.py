# SPDX-License-Identifier: MIT
"""Simulated drives that identify their machine by themselves, and maps that say how."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from pmsmtool.bus.connection import Connection
from pmsmtool.drive.vendor_tuning import VendorDrive
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.drive_maps.drive_map_file import dump_drive_map
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.node.session import Session

PROFILE = data_folder("profiles") / "interior-2k2.toml"
TRUTH = load_machine_file(PROFILE).machine


def without_torque(drive_map: DriveMap) -> DriveMap:
    """The same drive without modes that this program pushes it by: what is left is the vendor level."""
    return replace(drive_map, capabilities=replace(drive_map.capabilities, torque_mode=False, velocity_mode=False))


def channel(folder: Path, drive_map: DriveMap, *, machine: str = "interior-2k2", more: str = "") -> str:
    path = folder / f"{drive_map.name}.toml"
    path.write_text(dump_drive_map(drive_map), encoding="utf-8")
    return f"{machine}?nv=:memory:&drive={path}{more}"


@contextmanager
def opened(folder: Path, drive_map: DriveMap, **more: str) -> Iterator[tuple[VendorDrive, Session]]:
    with Connection(PmsmSimBus(channel(folder, drive_map, **more))) as connection:
        drive = VendorDrive(connection, 1, drive_map=drive_map)
        session = connection.bus.line.nodes[0].session  # type: ignore[attr-defined]
        yield drive, session
        assert not session.power.state.energised
        drive.close()
