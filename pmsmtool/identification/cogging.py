# SPDX-License-Identifier: MIT
"""Cogging torque of an identification: one value per order, and a table over the encoder's angle for firmware.

Slow turns under speed control show it by what they balance it with: with E = J omega^2/2 over the angle

    T_cogging(theta) = dE/dtheta - T_current(theta) + friction,

order by order over whole turns, the mean of both directions. What they differ by is the noise. Without slow turns the
orders are those of the coasting traces (``estimators/angle_harmonics``), which show strong ones of low order.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pmsmtool.arrays import Array, Complex
from pmsmtool.estimators.angle_harmonics import (
    ENCODER_ORDERS,
    HIGHEST_ORDER,
    ORDERS_MOST,
    SURE,
    AngleHarmonics,
    Harmonic,
)
from pmsmtool.estimators.estimate import COVERAGE_FACTOR
from pmsmtool.estimators.shaft.mechanics import POWERED, Torque
from pmsmtool.estimators.shaft.position import encoder_step
from pmsmtool.identification.mechanics import in_frame, torque_of
from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import refuse
from pmsmtool.run_directory import RunDirectory
from pmsmtool.trace import Trace

if TYPE_CHECKING:
    from pmsmtool.identification.evaluate import Evaluation


COGGING_CSV = "cogging.csv"
ROWS = 1024
"""Rows of the table over one turn, or over what was seen of it."""
PARTIAL = "partial"
ORDERS_PER_POLE_PAIR = 18
"""Highest order that none being found is stated for: the least common multiple of slots and poles is 6 to 18 times the
pole pairs of usual windings (9 slots on 8 poles: 72)."""


SLOW_TRACE = "slow_"
"""Followed by a number: one direction, the other."""
GRID = 4096
"""Angles of a turn at which energy and torque are interpolated."""
NEIGHBOURS = 12
"""Orders to either side whose differences between the directions say the noise of an order."""
QUANTISED = 0.02
"""Standard deviation of a position's ripple by the encoder's steps, of one: rows that come in step with them hold lines
of step/(pi m). An order 126 whose ripple was 0.09 steps of 12 bits came out 34 % too small."""
CLEAR = 2.0
"""Amplitude of an order, in these deviations, from which on it is none of those lines."""
MODEL_SHARE = 0.005
"""Relative deviation of an order beyond noise: age of the current against the position, phase by up to 0.6 deg."""
MISMATCH = 0.03
"""Torque of order 2 p that unequal gains of the current sensors hide, of the current's (one standard deviation). Their
offsets hide one of order p, which is not told from cogging, and with the dead time as much of order 3 p (0.12 % of
rated torque beside 0.09 %, seen once)."""


@dataclass(frozen=True, slots=True)
class Part:
    """Part of a turn that was seen: from an angle (rad, as the drive shows it) over a way (rad)."""

    start_rad: float
    way_rad: float
    lowest_order: int
    apart: int
    """Orders that differ by less are not separated."""
    ambiguous: tuple[int, ...] = ()
    """Orders that may as well be a neighbour: they get no phase."""
    left_nm: float = 0.0
    """Root mean square of the torque that the orders leave (N m)."""
    J_least_kgm2: float = 0.0
    """Inertia that the torque of the current speeds up at least (95 %)."""

    def __str__(self) -> str:
        ambiguous = f"; {', '.join(map(str, self.ambiguous))} may be a neighbour" if self.ambiguous else ""
        return (
            f"partial: over {self.way_rad / math.tau:.2g} of a turn; orders below {self.lowest_order} are not "
            f"identified, orders that differ by less than {self.apart} are not separated{ambiguous}"
        )


@dataclass(frozen=True, slots=True)
class Cogging:
    """Accelerations over the angle, the inertia (kg m2), and what is said where there are none.

    ``floor_nm`` is the amplitude from which on every order up to ``highest_order`` is found, ``part`` what was seen of
    a turn where that is less than all of it.
    """

    harmonics: AngleHarmonics
    J: Estimate
    highest_order: int
    floor_nm: float
    how: str
    part: Part | None = None

    def estimates(self) -> dict[str, Estimate]:
        """Return the largest torque, and amplitude (N m) and phase (rad) of every order per turn, by their names.

        The torque along the phase order is amplitude cos(order theta - phase), theta the encoder's angle along it.
        Where none was found the largest torque is 0, with the floor as its 95 % interval.
        """
        J, harmonics, part = self.J, self.harmonics, self.part
        how, fallback = (self.how, "") if part is None else (f"{self.how}; {part}", PARTIAL)
        ambiguous = () if part is None else part.ambiguous
        if not harmonics.acceleration_rad_s2:
            method = f"none found up to order {self.highest_order} per turn, {how}; the interval is what would be"
            std = self.floor_nm / COVERAGE_FACTOR
            return {"cogging_nm": Estimate(0.0, std, 0.0, "N m", method=method, fallback=fallback)}
        found: dict[str, Estimate] = {}
        largest = float(np.max(np.abs(harmonics.torque_nm(self.angles, J.value))))
        std = math.hypot(self.table_std_nm, J.std / J.value * largest)
        scale = J.systematic / J.value
        method = f"largest over {'a turn' if part is None else 'the way'}, {how}"
        found["cogging_nm"] = Estimate(largest, std, scale * largest, "N m", method=method)
        for h in harmonics.acceleration_rad_s2:
            method = f"order {h.order} per turn, {how}"
            amplitude, std = J.value * h.amplitude, math.hypot(J.value * h.std, J.std * h.amplitude)
            found[f"cogging_{h.order}_nm"] = Estimate(amplitude, std, scale * amplitude, "N m", method=method)
            if h.order not in ambiguous:
                found[f"cogging_{h.order}_rad"] = Estimate(h.phase_rad, h.std / h.amplitude, 0.0, "rad", method=method)
        return {name: replace(estimate, fallback=fallback) for name, estimate in found.items()}

    @property
    def angles(self) -> Array:
        """Angles of the table (rad): of a turn, or of what was seen of it; shape (ROWS,)."""
        if self.part is None:
            return np.linspace(0.0, 2.0 * math.pi, ROWS, endpoint=False)
        return np.linspace(self.part.start_rad, self.part.start_rad + self.part.way_rad, ROWS)

    @property
    def table_std_nm(self) -> float:
        """Standard deviation of the torque at an angle, beside that of the inertia (N m)."""
        return self.J.value * math.sqrt(sum(h.std**2 for h in self.harmonics.acceleration_rad_s2))


def cogging_of(traces: Mapping[str, Trace], result: Evaluation) -> Cogging | None:
    """Return the cogging torque; None where nothing says the inertia, and where coasting alone shows none.

    Raises IdentificationError: ``E_EXCITATION``: the shaft did not turn once, in both directions.

    Parameters
    ----------
    traces : mapping of str to Trace
        ``slow_<k>`` of the run: ``i_d_a i_q_a theta_M_rad``.
    result : Evaluation
        With what mechanics, or the frequency response, says of the inertia.
    """
    slow = [trace for name, trace in sorted(traces.items()) if name.startswith(SLOW_TRACE)]
    J = result.estimates().get("J_kgm2")
    if J is None or result.encoder is None or result.offset is None:
        return None
    pole_pairs = round(result.encoder.pole_pairs.value)
    highest = min(HIGHEST_ORDER, ORDERS_PER_POLE_PAIR * pole_pairs)
    torque = torque_of(result, pole_pairs)
    if slow:
        behind = result.offset.value - float(slow[0].meta["offset_rad"])
        both, friction = [], 0.0
        step = encoder_step([trace["theta_M_rad"] for trace in slow])
        for trace in slow:
            seen = in_frame(trace, behind)
            theta = int(trace.meta["direction"]) * trace["theta_M_rad"]
            of_current = torque(seen["i_d_a"], seen["i_q_a"])
            both.append(torque_orders(seen.t_s, theta, of_current, J.value, highest))
            friction = max(friction, abs(float(np.mean(of_current))))
        speed = max(float(np.ptp(trace["theta_M_rad"]) / trace.t_s[-1]) for trace in slow)
        steps_nm = QUANTISED * step * J.value * (speed * np.arange(highest + 1, dtype=np.float64)) ** 2
        hidden = {2 * pole_pairs: MISMATCH * friction, 3 * pole_pairs: abs(both[0][pole_pairs] + both[-1][pole_pairs])}
        return _of_slow_turns(both, J, pole_pairs, steps_nm, hidden)
    if result.mechanics is None or not result.mechanics.harmonics.acceleration_rad_s2:
        return None
    harmonics = result.mechanics.harmonics
    # small currents of a coasting with the voltage on damp what cogging makes of the speed
    coasted = [trace for trace in traces.values() if trace.meta.get(POWERED)]
    damped = max((coasting_torque(trace, torque) for trace in coasted), default=0.0) / J.value
    shown = [replace(h, std=math.hypot(h.std, damped)) for h in harmonics.acceleration_rad_s2]
    if not (clear := tuple(h for h in shown if h.amplitude > SURE * h.std)):
        return None
    harmonics = replace(harmonics, acceleration_rad_s2=clear)
    how = f"coasting through {harmonics.turns:.3g} turns and more each way"
    return Cogging(harmonics, J, highest, math.inf, how)


def coasting_torque(trace: Trace, torque: Torque) -> float:
    """Return the standard deviation of the torque (N m) of a coasting's currents once those of the push are gone."""
    later = slice(len(trace) // 4, None)
    return float(np.std(torque(trace["i_d_a"][later], trace["i_q_a"][later])))


def torque_orders(t_s: Array, theta: Array, torque_nm: Array, J_kgm2: float, highest: int) -> Complex:
    """Return the torque over the angle by order, as phasors of exp(j order theta), shape (highest + 1,).

    Raises IdentificationError: ``E_EXCITATION``.

    Parameters
    ----------
    t_s, theta, torque_nm : ndarray, shape (n,)
        Times (s), positions along the phase order (rad, unwrapped) and torque of the currents (N m) of a slow turn.
    J_kgm2 : float
        Inertia.
    highest : int
        Highest order.
    """
    sense = 1.0 if theta[-1] > theta[0] else -1.0
    way = np.maximum.accumulate(sense * (theta - theta[0]))
    turns = int(way[-1] / (2.0 * math.pi))
    if turns < 1:
        raise refuse(
            "E_EXCITATION",
            f"the shaft turned {way[-1] / (2.0 * math.pi):.2g} times at low speed, one whole turn is needed",
            stage="cogging",
            likely="cogging or friction that the speed controller does not overcome at 30 rpm, or a limited travel",
            hint="`pmsmtool move --cogging MACHINE` sees a part of it within an angle, by the position loop",
        )
    angle = np.arange(turns * GRID) * (2.0 * math.pi / GRID)
    step = np.diff(way)
    middle = way[:-1] + 0.5 * step
    energy = 0.5 * J_kgm2 * (step / np.diff(t_s)) ** 2
    energy = energy - np.polyval(np.polyfit(middle, energy, 1), middle)
    order = np.arange(highest + 1)
    found = []
    for values, at in ((energy, middle), (torque_nm, way)):
        folded = np.interp(angle, at, values).reshape(turns, GRID).mean(axis=0)
        phasors = 2.0 / GRID * np.fft.rfft(folded)[: highest + 1]
        # a turn backward runs through the angles the other way round
        found.append((phasors if sense > 0.0 else phasors.conj()) * np.exp(-1j * order * theta[0]))
    # what straight lines between the rows leave of an order; speeds are means between two rows besides
    row = 2.0 * math.pi * turns / np.count_nonzero(middle < 2.0 * math.pi * turns)
    mean = np.sinc(0.5 * order * row / math.pi)
    return np.asarray((1j * order * found[0] / mean - found[1]) / mean**2)


def _of_slow_turns(
    both: Sequence[Complex], J: Estimate, pole_pairs: int, steps_nm: Array, hidden_nm: Mapping[int, float]
) -> Cogging:
    """Return the orders that stand out of what the directions differ by, and of what encoder and sensors hide.

    ``steps_nm`` is the deviation of every order by the encoder's steps, ``hidden_nm`` that of some by the sensors.
    """
    highest = len(steps_nm) - 1
    if len(both) != 2:
        raise refuse("E_EXCITATION", "slow turns in one direction only", stage="cogging")
    mean, apart = 0.5 * (both[0] + both[1]), 0.5 * np.abs(both[0] - both[1])
    # the median of a squared amplitude is 2 ln 2 of the variance of its parts
    std = np.array(
        [
            math.sqrt(np.median(apart[max(1, n - NEIGHBOURS) : n + NEIGHBOURS + 1] ** 2) / (2.0 * math.log(2.0)))
            for n in range(highest + 1)
        ]
    )
    least = np.maximum(SURE * std, CLEAR * steps_nm)
    std = np.hypot(std, steps_nm)
    for n, torque_nm in hidden_nm.items():
        std[n], least[n] = max(std[n], torque_nm), max(least[n], SURE * torque_nm)
    besides = {0, *ENCODER_ORDERS, pole_pairs}
    orders = [n for n in range(highest + 1) if n not in besides]
    clear = sorted((n for n in orders if abs(mean[n]) > least[n]), key=lambda n: -abs(mean[n]))[:ORDERS_MOST]
    harmonics = []
    for n in sorted(clear):
        torque, deviation = complex(mean[n]), max(float(std[n]), float(apart[n]) / math.sqrt(2.0))
        deviation = math.hypot(deviation, MODEL_SHARE * abs(torque))
        harmonics.append(Harmonic(n, torque.real / J.value, -torque.imag / J.value, deviation / J.value))
    floor = float(np.max(least[[n for n in orders if n not in hidden_nm]]))
    return Cogging(AngleHarmonics((), tuple(harmonics)), J, highest, floor, "slow turns in both directions")


def save_cogging(run: RunDirectory, cogging: Cogging | None, direction: int) -> dict[str, str]:
    """Write the table into the run; returns its name as a stage lists it, nothing where no cogging was found.

    ``theta_m_rad`` is what the drive's encoder shows, ``direction`` its sign along the phase order.
    """
    if cogging is None or not cogging.harmonics.acceleration_rad_s2:
        return {}
    theta = cogging.angles
    torque = cogging.harmonics.torque_nm(direction * theta, cogging.J.value)
    half = COVERAGE_FACTOR * cogging.table_std_nm
    rows = [f"{angle:.9g},{value:.6g},{half:.3g}" for angle, value in zip(theta, torque, strict=True)]
    run.save(COGGING_CSV, "\n".join(["theta_m_rad,torque_nm,half_width_95_nm", *rows]) + "\n")
    return {COGGING_CSV: ""}
