# SPDX-License-Identifier: MIT
"""What a drive reports before a proof, what it may do, and how much warmer its winding may get."""

from __future__ import annotations

import contextlib
import math
import statistics
from dataclasses import asdict, dataclass
from typing import Any

from pmsmtool.design.design_file import Design
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope
from pmsmtool.errors import SdoAbort
from pmsmtool.machine.temperature import WARMING
from pmsmtool.machine.torque import torque_per_ampere

LINK_READINGS = 200
"""Readings of the DC link whose mean counts, 0.1 s and more of a rectifier's ripple: with one reading of 2.2 % of it, a
healthy drive entered field weakening 1.23 half widths of the band late (the mean: within 0.2 %)."""
OFFSET_READINGS = 32
"""Readings of each phase's current before the bridge is on: their mean is the offset that the sensor has now."""
WARMEST_SHARE = 0.8
"""Largest rise of the winding in a change of the speed, of what is left below its trip: friction and the loop's
overshoot take current, too. Of a winding that warms with 4.4 s, a step from 105 degC tripped a healthy drive at 155."""


@dataclass(frozen=True, slots=True)
class Conditions:
    """What the drive reports before anything moves, and what it may do."""

    U_dc_v: float
    """DC link as measured (V)."""
    T_winding_c: float
    T_magnet_c: float
    """As measured; NaN without a sensor."""
    encoder_counts: int
    """Counts per turn, 0 when the drive does not tell."""
    i_max_apk: float
    speed_max_rad_s: float
    """The envelope."""
    shaft: str = "free"
    """``free``, ``locked`` or ``coupled``."""
    U_dc_ripple_v: float = 0.0
    """Amplitude of the link's ripple (V)."""
    offsets_apk: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Currents that the sensors of a, b, c show without current (A), less their mean."""

    def facts(self) -> dict[str, Any]:
        """Return them as JSON; what is not known is None."""
        return {key: None if isinstance(v, float) and math.isnan(v) else v for key, v in asdict(self).items()}


def conditions_of(drive: CanopenDrive, envelope: Envelope) -> Conditions:
    """Read what the prediction depends on, with the drive off."""
    counts = 0
    with contextlib.suppress(SdoAbort):
        counts = drive.node.whole(objects.ENCODER_INCREMENTS)

    def live(name: str) -> float:
        try:
            return drive.live(name)
        except SdoAbort:
            return math.nan

    link = [drive.live("U_dc_v") for _ in range(LINK_READINGS)]
    shown = [statistics.fmean(live(f"i_{phase}_a") for _ in range(OFFSET_READINGS)) for phase in "abc"]
    offsets = [offset - statistics.fmean(shown) if math.isfinite(sum(shown)) else 0.0 for offset in shown]
    return Conditions(
        statistics.fmean(link), live("T_winding_c"), live("T_magnet_c"), counts,
        envelope.i_max_apk, envelope.speed_max_rad_s, envelope.shaft, math.sqrt(2.0) * statistics.pstdev(link),
        (offsets[0], offsets[1], offsets[2]),
    )  # fmt: skip


def warmth(design: Design) -> float:
    """Return what the winding rises by in a change of the speed, times its time over its square (K s/(rad/s)2).

    Mechanical; 0 where no sensor told how it warms, or the shaft is not known.
    """
    machine, rate = design.machine.machine, design.machine.conditions.get(WARMING, 0.0)
    per_ampere = torque_per_ampere(machine.pole_pairs, machine.psi_f_wb)
    return rate * ((machine.J_kgm2 or 0.0) / per_ampere) ** 2 if isinstance(rate, float) and per_ampere > 0.0 else 0.0


def room_k(design: Design, T_winding_c: float) -> float:
    """Return by how much a change of the speed may warm the winding (K); any where no sensor tells."""
    left = WARMEST_SHARE * (design["protection.T_winding_max_c"] - T_winding_c)
    return math.inf if math.isnan(left) else max(0.0, left)
