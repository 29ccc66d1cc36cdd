# SPDX-License-Identifier: MIT
"""A simulated drive in the image of a real one: its identified machine, its parameters, its data sheet.

The clone's truth is what identification found, or a draw from its intervals: a design made from the same machine
file then meets a machine that differs as the real one may.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.bus.sdo import Mode
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.errors import SdoAbort
from pmsmtool.estimators.estimate import COVERAGE_FACTOR, total_half_width
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.measurement.capabilities import Capabilities
from pmsmtool.params.parameter_set import ParameterSet

TRUTH: Mapping[str, str] = {
    "R_s_ohm": "R_s_ohm",
    "L_d_h": "L_d_h",
    "L_q_h": "L_q_h",
    "psi_f_wb": "psi_f_wb",
    "J_kgm2": "J_kgm2",
    "offset_rad": "encoder_offset_rad",
}
"""Estimates and the keys of ``[simulation]`` they decide."""
DATA_SHEET = (0x1021, 0)


@dataclass(frozen=True, slots=True)
class Clone:
    """A simulated drive and what to load into it."""

    machine_file: MachineFile
    """With ``[simulation]``; ``--sim FILE``."""
    parameters: ParameterSet
    """What the real drive holds, as far as its map goes."""
    data_sheet: bytes
    """Its stored EDS, empty where it has none."""
    family: str
    """Its family; the clone shows that dictionary with ``?drive=``."""


def clone_drive(node: DriveNode, found: Capabilities, machine_file: MachineFile, draw: int | None = None) -> Clone:
    """Return the clone of a drive; the drive is only read.

    Parameters
    ----------
    found : Capabilities
        Of the drive; its map is used.
    machine_file : MachineFile
        The machine on it, as ``identify`` left it or from a data sheet.
    draw : int, optional
        Seed of a draw from the estimates' total intervals; default: the estimates themselves.
    """
    parameters = DriveParameters(node)
    held = node.map.decode(parameters.read(node.map.cells))
    truth: dict[str, Value] = {**machine_file.simulation, **drawn_truth(machine_file, draw)}
    truth |= _noise(machine_file) | {"serial": found.identity.serial, "seed": 0 if draw is None else draw}
    return Clone(replace(machine_file, simulation=truth), held, _data_sheet(node), found.drive_map.name)


def drawn_truth(machine_file: MachineFile, draw: int | None) -> dict[str, Value]:
    """Return what the simulated machine really is: the file's values, or a draw around them.

    A quantity without an interval stays what the file states; it must stay positive where it is a size.
    """
    rng = None if draw is None else np.random.default_rng([20260103, draw])
    truth: dict[str, Value] = {"pole_pairs": machine_file.machine.pole_pairs}
    for name, key in TRUTH.items():
        owner = machine_file.encoder if name == "offset_rad" else machine_file.machine
        value = getattr(owner, name)
        if value is None:
            continue
        estimate = machine_file.estimates.get(name)
        if rng is not None and estimate is not None and math.isfinite(estimate.std):
            drawn = value + total_half_width(estimate) / COVERAGE_FACTOR * float(rng.standard_normal())
            value = math.remainder(drawn, 2.0 * math.pi) if name == "offset_rad" else max(drawn, 0.5 * value)
        truth[key] = float(value)
    return truth


def _noise(machine_file: MachineFile) -> dict[str, Value]:
    """Return the noise of the clone's current sensors: one step of their converter where the file states none.

    Without noise all samples at rest are equal, and identification of the clone is refused (E_SNR).
    """
    settings = machine_file.simulation_settings()
    bits, full_scale = settings["adc_bits"], settings.get("adc_full_scale_apk")
    if "sensor_noise_apk" in machine_file.simulation or not (isinstance(bits, int) and isinstance(full_scale, float)):
        return {}
    return {"sensor_noise_apk": full_scale / 2 ** (bits - 1)} if bits else {}


def _data_sheet(node: DriveNode) -> bytes:
    try:
        return node.sdo.upload(*DATA_SHEET, mode=Mode.BLOCK).data
    except SdoAbort:
        return b""
