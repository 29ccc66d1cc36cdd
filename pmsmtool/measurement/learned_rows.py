# SPDX-License-Identifier: MIT
"""From measured loops and a machine file to what its gains count, and to rows of a drive map.

The rows have the source ``measured``; published rows are checked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import get_args

from pmsmtool.drive.speed_loop_drive import SpeedLoopDrive
from pmsmtool.drive_maps.drive_map import LETTERS, Cell, DriveMap, Form
from pmsmtool.drive_maps.drive_map_file import dump_drive_map, parse_drive_map
from pmsmtool.drive_maps.motion_objects import UNDECIDED
from pmsmtool.drive_maps.wire_units import wire_unit
from pmsmtool.identification.current_loop_response import Winding
from pmsmtool.identification.learned_gains import (
    BANDWIDTH_DOUBT,
    Convention,
    Learned,
    Rotor,
    convention,
    gain_scale,
    integral_scale,
)
from pmsmtool.identification.speed_loop_response import Emf
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.measurement.changed_gains import GAIN, INTEGRAL, GainObject
from pmsmtool.measurement.learn_current_gains import CURRENT_GAIN, CURRENT_INTEGRAL
from pmsmtool.measurement.learn_gains import LearnedLoop
from pmsmtool.params.catalogue import EVERY

SOURCE = "measured"
FORMS: tuple[str, ...] = get_args(Form)


@dataclass(frozen=True, slots=True)
class MeasuredRow:
    """One gain as it was measured."""

    name: str
    """Catalogue name."""
    index: int
    sub: int
    wire: str
    """The object."""
    form: str
    gain: str
    """As of a row of the map."""
    scale: float
    unit: str
    """One count."""
    half_width: float
    """Of the scale, relative, 95 %."""
    low: float = -math.inf
    high: float = math.inf
    """Smallest and largest count, where the map of the drive's family says so."""

    def cell(self) -> Cell:
        """Return the row of a map."""
        assert self.form in FORMS
        unit = f"{self.scale:.6g} {self.unit}"
        return Cell(
            self.name, self.index, self.sub, self.wire, wire_unit(unit).scale, gain=self.gain, unit=unit,
            form=self.form, source=SOURCE, low=self.low, high=self.high,  # type: ignore[arg-type]
        )  # fmt: skip

    def against(self, published: Cell) -> str:
        """Say how a published row contradicts what was measured; empty where it agrees."""
        if (published.index, published.sub) != (self.index, self.sub):
            return ""
        if published.form == "current":
            return ""  # counts of amperes: the drive's torque per ampere stands between
        if published.form != self.form:
            return f"{self.name}: the map states form {published.form!r}, measured is {self.form!r}"
        miss = math.log(self.scale / published.factor) if published.factor > 0.0 else math.inf
        if abs(miss) <= self.half_width:
            return ""
        return (
            f"{self.name}: one count is {published.factor:.4g} {self.unit} in the map, measured is {self.scale:.4g} "
            f"+-{100 * self.half_width:.0f} %"
        )


def with_measured(
    base: DriveMap, vendor: int, product: int, rows: Sequence[MeasuredRow], said: str, kind: str | None
) -> DriveMap:
    """Return a map of this drive with the measured rows, checked as a file would be.

    Raises ConfigError: the result is no map.

    Parameters
    ----------
    vendor, product : int
        Identity of the drive, where the map names none.
    said : str
        On which drive, and how well.
    kind : str or None
        ``peak`` or ``rms`` where that was decided of currents whose kind no source says.
    """
    held = {*base.cells, *(row.name for row in rows)}
    usable = [row for row in rows if not row.gain or row.gain in held]
    said += "".join(f"; {row.name} is {row.form}, {row.scale:.4g} {row.unit}, and needs {row.gain}" for row in rows
                    if row not in usable)  # fmt: skip
    cells = {**base.cells, **{row.name: row.cell() for row in usable}}
    order = {parameter.name: k for k, parameter in enumerate(EVERY)}
    motion = {
        name: replace(row, unit=row.unit.removesuffix(UNDECIDED) + f" {kind}", source=SOURCE)
        if kind in ("peak", "rms") and row.undecided
        else row
        for name, row in base.motion.items()
    }
    own = base if base.vendor else replace(base, name=f"{base.name} measured", vendor=vendor, product=product)
    found = replace(
        own,
        cells=dict(sorted(cells.items(), key=lambda item: order[item[0]])),
        motion=motion,
        left_out={name: why for name, why in base.left_out.items() if name not in cells},
        sources={**base.sources, SOURCE: said},
    )
    return parse_drive_map(dump_drive_map(found), "measured map")


J_STD = 0.1
"""Standard deviation of an inertia without one (relative): a data sheet's is true to 20 %."""
L_STD = 0.1
"""Of an inductance without one (relative): no scale of a current gain is decided by it."""
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
    share = rotor_of(file).lagging
    return Emf(share, file.machine.R_s_ohm / file.machine.L_q_h, BANDWIDTH_DOUBT * share)


def winding_of(file: MachineFile) -> Winding:
    """Return what a current loop acts on."""
    machine, L = file.machine, file.machine.L_q_h
    return Winding(
        L, _relative(file, "L_q_h", L, L_STD), machine.R_s_ohm, file.inverter.U_dc_v / math.sqrt(3.0),
        machine.pole_pairs * machine.psi_f_wb,
    )  # fmt: skip


def learned_gains(file: MachineFile, measured: LearnedLoop) -> dict[str, Learned]:
    """Return what was found of both gains, by catalogue name."""
    rotor = rotor_of(file)
    return {
        GAIN: gain_scale(measured.base, measured.gain_changed, rotor.basis, GAIN),
        INTEGRAL: integral_scale(
            measured.base, measured.gain_changed, measured.integral_changed, rotor.basis, INTEGRAL
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
    other = ""
    if found.form in ("rate", "time"):
        other = CURRENT_GAIN if gain.name == CURRENT_INTEGRAL else GAIN
    letter = gain.item.letter
    signed = letter.lower() if gain.counts < 1 << 8 * gain.item.size - 1 else letter
    return MeasuredRow(
        gain.name, gain.item.index, gain.item.sub, _WIRES[signed], found.form, other, found.scale,
        found.unit, found.half_width, *gain.limits,
    )  # fmt: skip


def map_with(drive: SpeedLoopDrive, rows: Sequence[MeasuredRow], kind: str | None) -> DriveMap:
    """Return the drive's map with measured rows, which say on which drive and how well; ``kind`` of its amperes."""
    identity = drive.identity
    widths = ", ".join(f"{row.name} +-{100 * row.half_width:.0f} %" for row in rows)
    said = f"pmsmtool map learn on the drive with serial number {identity.serial}: {widths}"
    return with_measured(drive.node.map, identity.vendor, identity.product, rows, said, kind)
