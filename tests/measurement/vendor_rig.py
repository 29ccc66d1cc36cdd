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
from pmsmtool.drive_maps.drive_map_file import dump_drive_map, parse_drive_map
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.resources import data_folder
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.node.session import Session

PROFILE = data_folder("profiles") / "interior-2k2.toml"
TRUTH = load_machine_file(PROFILE).machine
RESULTS = """
[vendor_tuning.results]
"motor.pole_pairs" = { index = 0x3900, sub = 5, type = "UNSIGNED32", unit = "1" }
"motor.R_s_ohm" = { index = 0x3900, sub = 1, type = "UNSIGNED32", unit = "mohm line-line" }
"motor.L_d_h" = { index = 0x3900, sub = 2, type = "UNSIGNED32", unit = "uH" }
"motor.L_q_h" = { index = 0x3900, sub = 3, type = "UNSIGNED32", unit = "uH" }
"motor.psi_f_wb" = { index = 0x3900, sub = 4, type = "UNSIGNED32", unit = "uWb" }
"""
"""Rows that a person adds to the map of a drive whose set-up mode is known, and its identity."""


def filled_in() -> DriveMap:
    """The nanotec map as a person has completed it."""
    text = (data_folder("firmware-params") / "nanotec" / "map.toml").read_text(encoding="utf-8")
    text = text.replace("\n[left_out]", RESULTS + "\n[left_out]").replace("vendor = 0x00000000", "vendor = 0x1234")
    return parse_drive_map(text.replace("product = 0x00000000", "product = 0x5678"))


def without_torque(drive_map: DriveMap) -> DriveMap:
    """The same drive without modes that this program pushes it by: what is left is the vendor tier."""
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
