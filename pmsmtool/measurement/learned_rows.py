# SPDX-License-Identifier: MIT
"""From measured loops and a machine file to what its gains count, and to rows of a drive map."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pmsmtool.drive.speed_loop_drive import SpeedLoopDrive
from pmsmtool.drive_maps.drive_map import LETTERS, DriveMap
from pmsmtool.drive_maps.measured_rows import MeasuredRow, with_measured
from pmsmtool.identification.learned_gains import Convention, Learned, Rotor, convention, gain_scale, integral_scale
from pmsmtool.identification.speed_loop_response import Emf
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.measurement.changed_gains import GAIN, INTEGRAL, GainObject
from pmsmtool.measurement.learn_gains import LearnedLoop

J_STD = 0.1
"""Standard deviation of an inertia without one (relative): a data sheet's is true to 20 %."""
PSI_STD = 0.05
"""Of a flux linkage (relative), with what a magnet 40 K warmer loses."""
READ_AS_RMS = math.sqrt(2.0)
"""By what a shown current is multiplied where no source says peak or rms (``drive/motion_objects.py``)."""
_WIRES = {letter: name for name, letter in LETTERS.items()}


def _relative(file: MachineFile, key: str, value: float, otherwise: float) -> float:
    return file.std[key] / value if key in file.std and value else otherwise


def rotor_of(file: MachineFile) -> Rotor:
    """Return what the scales rest on."""
    machine = file.machine
    J = float(machine.J_kgm2 or 0.0)
    EMF_per_rad_s = machine.pole_pairs * machine.psi_f_wb
    tau_s = J * machine.R_s_ohm / (torque_per_ampere(machine.pole_pairs, machine.psi_f_wb) * EMF_per_rad_s)
    return Rotor(J, _relative(file, "J_kgm2", J, J_STD), tau_s, file.inverter.f_s_hz)


def emf_of(file: MachineFile) -> Emf:
    """Return what the EMF takes from the current loop of a drive that nobody knows."""
    return Emf(rotor_of(file).lagging, file.machine.R_s_ohm / file.machine.L_q_h)


def learned_gains(file: MachineFile, measured: LearnedLoop) -> dict[str, Learned]:
    """Return what was found of both gains, by catalogue name."""
    rotor = rotor_of(file)
    return {
        GAIN: gain_scale(measured.base, measured.gain_changed, rotor, GAIN),
        INTEGRAL: integral_scale(
            measured.base, measured.gain_changed, measured.integral_changed, rotor, INTEGRAL
        ),
    }  # fmt: skip


def shown_currents(file: MachineFile, measured: LearnedLoop, drive: SpeedLoopDrive) -> Convention:
    """Return whether the drive's amperes are peak, rms or block."""
    machine = file.machine
    psi_std = _relative(file, "psi_f_wb", machine.psi_f_wb, PSI_STD)
    return convention(
        measured.base, rotor_of(file), torque_per_ampere(machine.pole_pairs, machine.psi_f_wb), psi_std,
        READ_AS_RMS if drive.read_as_rms else 1.0,
    )  # fmt: skip


def measured_row(gain: GainObject, found: Learned) -> MeasuredRow:
    """Return the row of a map; the scale must be decided. A whole number may have a sign: half of its room is used."""
    assert found.scale is not None and found.form is not None
    other = GAIN if found.form in ("rate", "time") else ""
    letter = gain.item.letter
    signed = letter.lower() if gain.counts < 1 << 8 * gain.item.size - 1 else letter
    return MeasuredRow(
        gain.name, gain.item.index, gain.item.sub, _WIRES[signed], found.form, other, found.scale,
        found.unit, found.half_width,
    )  # fmt: skip


def map_with(drive: SpeedLoopDrive, rows: Sequence[MeasuredRow], kind: str | None) -> DriveMap:
    """Return the drive's map with measured rows, which say on which drive and how well; ``kind`` of its amperes."""
    identity = drive.identity
    widths = ", ".join(f"{row.name} +-{100 * row.half_width:.0f} %" for row in rows)
    said = f"pmsmtool map learn on the drive with serial number {identity.serial}: {widths}"
    return with_measured(drive.node.map, identity.vendor, identity.product, rows, said, kind)
