# SPDX-License-Identifier: MIT
"""Fill the current plane with voltage pulses that turn at a current: the traces a flux map is made from.

The drive applies +-V on an axis of the rotor frame and turns it when the current leaves its band (Hinkkanen et al.
2017, DOI 10.1109/TIA.2016.2644624). Pulses on both axes with different voltages drift against each other and fill the
rectangle between the limits; several rectangles, the widest and the highest at last single axes, fill the disc.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pmsmtool.drive.port import Drive, Excitation, Injection, Shape
from pmsmtool.errors import LimitExceeded
from pmsmtool.experiments.signals import readable
from pmsmtool.experiments.speed_run import RAMP_MOST_S
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

Axis = Literal["d", "q"]

AXES: tuple[Axis, Axis] = ("d", "q")
STAGE = "flux map"
SIGNALS = ("i_d_a", "i_q_a", "u_d_v", "u_q_v", "theta_m_rad", "omega_e_rad_s", "flags", "T_winding_c")
SAMPLES = 2048
"""64 kB of eight signals; with half of it the slow axis of a saturated machine does not complete its cycles."""
RECTANGLES = (
    (1.0, 0.0),
    (0.0, 1.0),
    (0.72, 0.69),
    (0.45, 0.89),
    (0.89, 0.45),
    (0.5, 0.55),
    (0.24, 0.97),
    (0.97, 0.24),
    (0.6, 0.8),
    (0.8, 0.6),
)
"""Largest d and q current of each trace, of the largest vector."""
VOLTAGE_RATIOS = (
    (1.0, 0.0),
    (0.0, 1.0),
    (0.8, 1.0),
    (1.0, 0.83),
    (0.77, 1.0),
    (1.0, 0.71),
    (0.87, 1.0),
    (1.0, 0.9),
    (0.73, 1.0),
    (1.0, 0.78),
)
"""Voltage of d and q of each trace, of the axis' own: unequal, so that the two cycles drift against each other."""
HALF_PERIODS_HELD = 70
HALF_PERIODS_FREE = 45
"""Samples between two turns at full current: fewer move a free rotor less, more leave the inverter less to say."""
DROPS_HELD, DROPS_FREE = 2.5, 4.0
"""Smallest voltage over the resistive drop. Near the drop the current creeps towards its limit; on a free rotor the
back-emf then makes it creep longer in one direction, which turns the rotor faster still."""
HALF_PERIODS_LEAST = 14
"""Samples between two turns that a higher voltage for the drop must leave: fewer, and the overshoot is the current."""
BRAKE_LIMIT_S, SLOWER = 0.6, 0.99
"""Time in which a shaft must lose a hundredth of its speed, or counts as one that does not come to rest: a heavy one
that still turned when the first pulse came drove current over the abort limit, and the run was lost."""
BRAKE_LOOK_S = 0.03
STANDSTILL_SHARE = 0.004
"""Speed that counts as rest, of the largest."""
FIRST_SHARE = 0.02
"""First voltage of the search, of the largest."""
SHARES = (0.25, 0.6, 1.0)
"""Currents of the growing shots that size voltage and band, of the largest."""
SEARCH_STEPS = 14
GROWN_LEAST, GROWN_MOST = 1.3, 4.0
"""Factors on the voltage of a shot that did not reach its band: over the share that it reached, and the largest."""
OVERSHOOT_ALLOWANCE = 1.3
"""Over the overshoot of the shot before: the plane saturates further out."""
TURNS_LEAST = 3
"""Turns of the voltage that a shot must show before it sizes anything."""
REST_S = 0.08
"""Pause at zero current between two traces: the current decays and the shaft slows down."""


@dataclass(frozen=True, slots=True)
class AxisPulse:
    """Pulses on one axis: voltage (V), current at which they turn (A), and what the current reaches beyond it (A)."""

    u_v: float
    limit_a: float
    overshoot_a: float
    half_period: float


@dataclass(frozen=True, slots=True)
class ScanPlan:
    """What a scan may use."""

    i_max_a: float
    """Largest current vector that the machine is to see (A peak)."""
    u_max_v: float
    """Largest voltage vector (V peak)."""
    held: bool
    """Whether the rotor is held; a free one gets shorter and higher pulses, and is braked before each train."""
    drop_v: float = 0.0
    """Resistive drop at that current and the inverter's error (V): the pulses must be well above it."""
    rectangles: tuple[tuple[float, float], ...] = RECTANGLES
    """Shares of d and q current, one trace each."""
    i_d_max_a: float = math.inf
    """Largest d current, of either sign: more may demagnetise the rotor (A peak)."""

    def reach_a(self, axis: Axis) -> float:
        """Return the largest current of an axis (A peak)."""
        return min(self.i_max_a, self.i_d_max_a) if axis == "d" else self.i_max_a

    @property
    def half_periods(self) -> int:
        """Samples between two turns that are aimed at."""
        return HALF_PERIODS_HELD if self.held else HALF_PERIODS_FREE

    @property
    def u_least_v(self) -> float:
        """Smallest voltage of an axis (V)."""
        return min(self.u_max_v, (DROPS_HELD if self.held else DROPS_FREE) * self.drop_v)

    def duration_s(self, period_s: float) -> float:
        """Return the time under voltage (s)."""
        return len(self.rectangles) * SAMPLES * period_s


def pulse(
    drive: Drive,
    u_dq_v: tuple[float, float],
    limit_dq_a: tuple[float, float],
    samples: int,
    abort_speed_rad_s: float,
    *,
    brake: bool = False,
) -> Trace:
    """Record one train of pulses from rest; zero current is asked for before and after it.

    ``brake`` stops the shaft by the drive's own speed controller first.

    Raises DriveFault: the drive aborted the pulses at its current or speed limit.
    """
    excitation = Excitation(
        shape=Shape.HYSTERESIS,
        point=Injection.U_D,
        amplitude=u_dq_v[0],
        amplitude_q=u_dq_v[1],
        i_limit_d_a=limit_dq_a[0],
        i_limit_q_a=limit_dq_a[1],
        duration_s=samples * drive.period_s,
        abort_speed_rad_s=abort_speed_rad_s,
    )
    if brake:
        _brake(drive, STANDSTILL_SHARE * abort_speed_rad_s)
    drive.command_current(0.0, 0.0)
    return readable(drive.record(SIGNALS, samples, excitation=excitation))


def _brake(drive: Drive, omega_e_rad_s: float) -> None:
    """Bring the shaft to rest, or as near as it comes."""
    drive.command_speed(0.0)
    periods = max(1, round(0.3 * BRAKE_LOOK_S / drive.period_s))
    waited, slower, least = 0.0, 0.0, math.inf
    while waited - slower < BRAKE_LIMIT_S and waited < RAMP_MOST_S:
        drive.wait(BRAKE_LOOK_S)
        waited += BRAKE_LOOK_S
        omega = abs(drive.average(("omega_e_rad_s",), periods)["omega_e_rad_s"])
        if omega <= omega_e_rad_s:
            return
        if omega < SLOWER * least:
            least, slower = omega, waited


def size_axis(drive: Drive, plan: ScanPlan, axis: Axis, abort_speed_rad_s: float) -> AxisPulse:
    """Find voltage and band of one axis by growing shots.

    Raises IdentificationError: ``E_EXCITATION``: the largest voltage does not bring the current to its band within a
    shot.
    """
    u = max(FIRST_SHARE * plan.u_max_v, SHARES[0] * plan.u_least_v)
    samples = round((2 * TURNS_LEAST + 1) * plan.half_periods)
    found: AxisPulse | None = None
    reach = plan.reach_a(axis)
    for share in SHARES:
        limit = share * reach
        if found is not None:
            # a saturating axis needs less flux than in proportion: the half period comes out shorter, never longer
            grown = limit / (found.limit_a + found.overshoot_a)
            u = _voltage(plan, share, found.u_v * grown * found.half_period)
            limit = max(0.3 * limit, limit - OVERSHOOT_ALLOWANCE * found.overshoot_a * u / found.u_v)
        found = _shot_that_turns(drive, plan, axis, u, limit, samples, abort_speed_rad_s)
    assert found is not None
    u = _voltage(plan, 1.0, found.u_v * found.half_period)
    overshoot = found.overshoot_a * u / found.u_v
    limit = reach - OVERSHOOT_ALLOWANCE * overshoot
    if limit < 0.4 * reach:
        raise refuse(
            "E_EXCITATION",
            f"the {axis} current overshoots its band by {overshoot:.3g} A of {reach:.3g} A",
            stage=STAGE,
            likely="a control period too long for this inductance",
        )
    return AxisPulse(u, limit, overshoot, found.half_period * found.u_v / u)


def _voltage(plan: ScanPlan, share: float, volt_samples: float) -> float:
    """Return the voltage for a swing of that many volt-samples: the wanted half period, but above the drop."""
    least = min(share * plan.u_least_v, volt_samples / HALF_PERIODS_LEAST)
    return min(plan.u_max_v, max(least, volt_samples / plan.half_periods))


def _shot_that_turns(
    drive: Drive, plan: ScanPlan, axis: Axis, u: float, limit: float, samples: int, abort_speed_rad_s: float
) -> AxisPulse:
    for _ in range(SEARCH_STEPS):
        on_d = axis == "d"
        bands = (limit, 0.0) if on_d else (0.0, limit)  # without voltage a band does nothing
        volts = (u, 0.0) if on_d else (0.0, u)
        trace = pulse(drive, volts, bands, samples, abort_speed_rad_s, brake=not plan.held)
        turns = np.flatnonzero(np.diff(np.sign(trace[f"u_{axis}_v"][1:]))) + 1
        peak = float(np.max(np.abs(trace[f"i_{axis}_a"])))
        if len(turns) >= TURNS_LEAST:
            return AxisPulse(u, limit, max(0.0, peak - limit), float(np.median(np.diff(turns))))
        if u >= plan.u_max_v:
            break
        # what dead time and resistance take leaves the rest to the current: no more than it lacks, or it overshoots
        reached = peak / limit
        u = min(plan.u_max_v, u * (min(GROWN_MOST, GROWN_LEAST / reached) if reached < 1.0 else 2.0))
    raise refuse(
        "E_EXCITATION",
        f"{u:.3g} V do not turn the {axis} current at {limit:.3g} A often enough, peak {peak:.3g} A",
        stage=STAGE,
        likely="too little DC-link voltage for this inductance",
    )


def scan(
    drive: Drive, plan: ScanPlan, d: AxisPulse, q: AxisPulse, abort_speed_rad_s: float, keep: Callable[[Trace], None]
) -> None:
    """Record one trace per rectangle; each is handed over as soon as it is there.

    The drive is enabled on entry with its frame on the rotor, and holds zero current on return.

    Raises LimitExceeded: a trace went over the largest current by more than the allowance.
    """
    for rectangle, ratio in zip(plan.rectangles, VOLTAGE_RATIOS, strict=False):
        u = (ratio[0] * d.u_v, ratio[1] * q.u_v)
        too_much = math.hypot(*u) / plan.u_max_v
        if too_much > 1.0:
            u = (u[0] / too_much, u[1] / too_much)
        bands = [
            _band(min(share * plan.i_max_a, plan.reach_a(name)), axis, volts)
            for share, name, axis, volts in zip(rectangle, AXES, (d, q), u, strict=True)
        ]
        trace = pulse(drive, u, (bands[0], bands[1]), SAMPLES, abort_speed_rad_s, brake=not plan.held)
        keep(replace(trace, meta={**trace.meta, "held": plan.held, "i_max_a": plan.i_max_a}))
        drive.wait(REST_S)


def _band(largest_a: float, axis: AxisPulse, u_v: float) -> float:
    """Band of one axis: what it is to reach, less the overshoot at this voltage."""
    return max(0.3 * largest_a, largest_a - axis.overshoot_a * u_v / axis.u_v)


__all__ = ["AxisPulse", "LimitExceeded", "ScanPlan", "pulse", "scan", "size_axis"]
