# SPDX-License-Identifier: MIT
"""The voltage pulses for the flux map on the drive: sized, and recorded."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from pmsmtool.drive.port import Drive
from pmsmtool.errors import Contradiction
from pmsmtool.estimators.current_sensors import Noise
from pmsmtool.estimators.resistance import ResistanceResult
from pmsmtool.experiments import flux_map_scan
from pmsmtool.identification.flux_map import SET_UP_BY, require_set_up
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.measurement.limits import TRIP_SHARE
from pmsmtool.trace import Trace
from pmsmtool.units import format_current

if TYPE_CHECKING:
    from pmsmtool.measurement.limits import Limits

REACH_SHARE = 0.97
"""Current the pulses aim at, of the envelope's: they overshoot by up to 3 %."""
D_REACH_SHARE = 0.92
"""The same of the largest d current: beside a q current they overshoot by up to 5 % (12.7 A, aimed at 12.1 A)."""
U_SHARE = 0.9
"""Largest voltage vector, of the largest."""
SPEED_SHARE = 0.9
"""Speed at which the drive ends a pulse train by itself, of the envelope's."""
COEFFICIENTS = 360
"""Of the spline, for the deviation predicted before the pulses."""
PLAN_LINE = "voltage pulses of both axes up to the largest current: a free shaft jerks, by a turn or so"
IF_SATURATED = f"where the machine saturates: {PLAN_LINE}"


def plan_lines(nameplate: MachineFile) -> list[str]:
    """Return what a person reads of the pulses before consenting."""
    rated, i_d_min = nameplate.machine.I_nom_apk, nameplate.limits.i_d_min_apk
    if i_d_min is not None:
        return [PLAN_LINE, f"d current at most {format_current(-i_d_min)}, the demagnetisation limit that is stated"]
    if rated is None:
        return [PLAN_LINE]
    why = "assumed, the rated current: no i_d_min_apk is stated"
    return [PLAN_LINE, f"d current at most {format_current(rated)} ({why})"]


def require_own_frame(read: Callable[[str], float], known: MachineFile) -> None:
    """Refuse the map of a held rotor where nothing says how its angle becomes that of the magnets.

    Raises IdentificationError: ``E_NOT_SET_UP``, the drive holds the factory's set; Contradiction: its pole pairs are
    not those of the machine file.
    """
    pole_pairs = read("motor.pole_pairs")
    if round(pole_pairs) != known.machine.pole_pairs:
        raise Contradiction(
            f"the drive holds {pole_pairs:.0f} pole pairs and the machine file states {known.machine.pole_pairs}; a "
            "held rotor cannot show which: nothing was moved, nothing was written",
            where="motor.pole_pairs",
            likely="the drive is set up for another motor, or this is the data sheet of another one",
            hint="free the shaft and `commission`, or correct one of the two",
        )
    require_set_up(pole_pairs, {name: read(name) for name in SET_UP_BY})


def measure_map(
    drive: Drive,
    limits: Limits,
    noise: Noise,
    resistance: ResistanceResult,
    held: bool,
    keep: Callable[[str, Trace], None],
    say: Callable[[str], None],
) -> None:
    """Size the pulses and record their trains as ``map_<k>``.

    Parameters
    ----------
    drive : Drive
        Enabled, with the frame of its encoder.
    limits : Limits
        What may be used.
    noise : Noise
        For the deviation that is predicted before the trains.
    resistance : ResistanceResult
        For the voltage that the pulses need at least.
    held : bool
        Whether the rotor is held.
    keep, say : callable
        As for the other experiments.
    """
    pole_pairs = drive.read("motor.pole_pairs")
    direction = -1.0 if drive.read("encoder.reversed") else 1.0
    facts = {
        "signed_pole_pairs": int(direction * pole_pairs),
        "offset_rad": drive.read("encoder.offset_rad"),
        "psi_f_wb": drive.read("motor.psi_f_wb"),
        "I_nom_a": limits.I_nom_apk,
    }
    i_max = min(REACH_SHARE * limits.i_max_apk, TRIP_SHARE * drive.read("protection.i_trip_apk"))
    drop = resistance.R_measured.value * i_max + max(0.0, resistance.V_dead_v)
    i_d_max = min(i_max, D_REACH_SHARE * limits.i_d_max_apk)
    plan = flux_map_scan.ScanPlan(i_max, U_SHARE * limits.V_max_v, held, drop, i_d_max_a=i_d_max)
    abort = SPEED_SHARE * pole_pairs * limits.omega_max_rad_s
    say(f"flux map: growing pulses size voltage and band up to {i_max:.3g} A, {i_d_max:.3g} A on d")
    d, q = (flux_map_scan.size_axis(drive, plan, axis, abort) for axis in flux_map_scan.AXES)
    swings = [pulse.u_v * pulse.half_period * drive.period_s for pulse in (d, q)]
    rows = 2 * len(plan.rectangles) * flux_map_scan.SAMPLES
    predicted = noise.sigma_a * max(swings) / (2.0 * i_max) * math.sqrt(COEFFICIENTS / rows)
    say(
        f"flux map: {len(plan.rectangles)} trains, {d.u_v:.3g} V on d and {q.u_v:.3g} V on q, "
        f"{plan.duration_s(drive.period_s):.2g} s under voltage; predicted deviation of a flux "
        f"{1e3 * predicted:.2g} mWb of a swing of {1e3 * max(swings):.3g} mWb"
    )
    count = 0

    def keep_train(trace: Trace) -> None:
        nonlocal count
        keep(f"map_{count}", replace(trace, meta={**trace.meta, **facts}))
        count += 1

    flux_map_scan.scan(drive, plan, d, q, abort, keep_train)
