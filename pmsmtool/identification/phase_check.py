# SPDX-License-Identifier: MIT
"""Is the motor there, are its phases and sensors alike? Three small vectors before any larger current; then pairs.

At five percent of the rated current dead time hides an unbalance of the winding: the small vectors find what is not
connected, and the slope of the voltage through each pair of phases at half and full current finds what is unequal; how
far the gains of the current sensors differ is measured there, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.estimators.current_sensors import MEAN_SAMPLES, Noise, SensorMismatch, estimate_mismatch
from pmsmtool.estimators.estimate import COVERAGE_FACTOR, SensorTolerance
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.resistance import ResistanceResult, normalised, resistance_warmed
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

STAGE = "phase check"
CONNECTED_SIGMA = 10.0
"""Multiples of the noise of a mean that a current must exceed."""
OPEN_FRACTION = 0.2
"""Fraction of the other phases' current below which a phase counts as open, and of the command all of them."""
BALANCE_LIMIT = 0.10
"""Largest relative spread of currents or resistances between the phases."""
SMALL_LIMIT = 0.30
"""The same, of u/i at the small vectors: legs whose dead times differ by 5 % already make 0.11 of it."""
SENSOR_LIMIT = 0.05
"""Largest difference of the gains of two current sensors: up to it the traces are corrected, beyond it a sensor or its
scale is wrong. Healthy sensors differ by 0.3 to 2 %. Beyond it for sure: 5 % was refused on one of two drives."""
OFFSET_LIMIT = 0.2
"""Largest offset of the current sensors, of the small test current: 1 % of the rated one."""
LEG_DOUBT = 0.05
"""Part of what the inverter's curve takes from a slope that may differ between pairs: legs whose dead times differ by
5 %. Six drives whose dead time takes more than 3 R I show 0.01 to 0.04."""
SLOPE_SIGMA = 6.0
"""Standard deviations that a difference must exceed besides."""
UNEQUAL_SIGMA = 4.0
"""Standard deviations from which on the resistances of the pairs count as unequal; legs whose dead times differ by 5 %
left 0.01 to 0.04 % of R beside 0.07 to 0.15 % of noise."""
USUAL_BEYOND = 0.015
"""Largest usual resistance of a pair beyond the mean, relative: phases differ by 0.3 to 3 %. Of a real drive whose pair
was 0.8 % off, at 3.5 standard deviations, R was 1.0 % off, and nothing in its interval but the sensors held that."""
MEAN_NOISE_FACTOR = 1.5
"""Noise of a slope, of what the noise of the two mean currents makes of it: a window's mean voltage has noise of its
own, since the current that follows the sensor's noise ends elsewhere than it began (L/R of 40 control periods: as much
again). 34 drives whose inverter takes less than 6 % of the slope: 1.53 (rms). Without it 1 of 222 equal windings
counted as unequal, at 4.6 standard deviations, with it the largest has 3.6."""
PAIRS = ("b-c", "c-a", "a-b")
"""Phases that carry the current when a, b or c is idle."""


@dataclass(frozen=True, slots=True)
class PhaseCheck:
    """Result of the three vectors."""

    currents_a: tuple[float, float, float]
    """Current along each vector (A)."""
    impedance_ohm: tuple[float, float, float]
    """u/i along each vector, dead-time voltage included (ohm)."""


def check_phases(vectors: Trace, noise: Noise) -> PhaseCheck:
    """Judge three vectors at 0, 120 and 240 degrees.

    Raises IdentificationError: ``E_SNR``, ``E_NOT_CONNECTED``, ``E_PHASE_OPEN``, ``E_CURRENT_SENSOR``,
    ``E_NOT_SETTLED``, ``E_UNBALANCED``.

    Parameters
    ----------
    vectors : Trace
        Three rows: ``i_a_a i_b_a i_c_a`` phase currents and ``u_d_v i_d_a i_q_a`` along the vector (means);
        ``moved`` 1 where the rotor did not come to rest; ``meta["i_command_a"]``.
    noise : Noise
        From the zero-current trace.
    """
    phases = np.stack([vectors["i_a_a"], vectors["i_b_a"], vectors["i_c_a"]], axis=1)
    strongest = np.max(np.abs(phases), axis=0)
    # an open phase still leaves 0.87 of the current in the other two for the vectors off its axis
    floor = CONNECTED_SIGMA * noise.sigma_a / math.sqrt(MEAN_SAMPLES)
    command = float(vectors.meta.get("i_command_a", 0.0))
    if 0.0 < command < 2.0 * floor:
        raise refuse(
            "E_SNR",
            f"ten times the noise of a mean current is {floor:.3g} A, above half of the {command:.3g} A of the test",
            stage=STAGE,
        )
    floor = max(floor, OPEN_FRACTION * command)
    if float(np.max(strongest)) < floor:
        raise refuse(
            "E_NOT_CONNECTED",
            f"largest phase current {float(np.max(strongest)):.3g} A, limit {floor:.3g} A",
            stage=STAGE,
        )
    weakest = int(np.argmin(strongest))
    others = float(np.min(np.delete(strongest, weakest)))
    if strongest[weakest] < max(floor, OPEN_FRACTION * others):
        raise refuse(
            "E_PHASE_OPEN",
            f"phase {'abc'[weakest]} carries {strongest[weakest]:.3g} A where the others carry {others:.3g} A",
            stage=STAGE,
        )
    offset = math.hypot(noise.offset_d_a, noise.offset_q_a)
    if 0.0 < OFFSET_LIMIT * command < offset:
        raise refuse(
            "E_CURRENT_SENSOR",
            f"at rest the sensors show a current of {offset:.3g} A, limit {OFFSET_LIMIT * command:.3g} A",
            stage=STAGE,
            likely="offset of a phase current sensor",
        )
    if "moved" in vectors.signals and float(np.max(vectors["moved"])) > 0.0:
        raise refuse("E_NOT_SETTLED", "the rotor still swings under the test vectors", stage=STAGE)
    along = vectors["i_d_a"]
    impedance = vectors["u_d_v"] / along
    spread = max(_spread(along), _spread(impedance))
    across = float(np.max(np.abs(vectors["i_q_a"] / along)))
    unequal = max(_spread(along), across) > BALANCE_LIMIT or _spread(impedance) > SMALL_LIMIT
    if unequal or not math.isfinite(spread):
        raise refuse(
            "E_UNBALANCED",
            f"currents differ by {100 * _spread(along):.2g} %, {100 * across:.2g} % of the current is off its axis, "
            f"limit {100 * BALANCE_LIMIT:g} %; u/i by {100 * _spread(impedance):.2g} %, limit {100 * SMALL_LIMIT:g} %",
            stage=STAGE,
        )
    return PhaseCheck(
        (float(along[0]), float(along[1]), float(along[2])),
        (float(impedance[0]), float(impedance[1]), float(impedance[2])),
    )


@dataclass(frozen=True, slots=True)
class PairCheck:
    """Result of the three pairs."""

    resistance_ohm: tuple[float, float, float]
    """Slope of the voltage with phase a, b and c idle (ohm)."""
    mismatch: SensorMismatch
    """Gains of the current sensors over their mean."""
    judged: bool = True
    """Whether the rotor was at rest, so that their differences mean something."""
    std_ohm: float = math.inf
    """Standard deviation of a difference between two slopes: noise, and legs that are not alike."""

    @property
    def beyond_mean_ohm(self) -> tuple[float, float, float]:
        """Slopes beyond their mean; zeros where they differ by no more than they are known."""
        mean = sum(self.resistance_ohm) / 3.0
        beyond = tuple(slope - mean for slope in self.resistance_ohm)
        unequal = self.judged and max(map(abs, beyond)) > UNEQUAL_SIGMA * self.std_ohm
        return (beyond[0], beyond[1], beyond[2]) if unequal else (0.0, 0.0, 0.0)


def at_one_temperature(pairs: Trace, resistance: ResistanceResult) -> Trace:
    """Return pairs of phases as a winding at their mean temperature shows them; as they are without a sensor of it.

    They follow the levels, which warmed it: of ten drives that cooled by 2 to 8 K from pair to pair each first pair had
    0.5 to 2 % more, and R, as the mean of the phases, that much less.
    """
    T_c, measured = pairs.signals.get("T_winding_c", np.array([math.nan])), resistance.R_measured
    if not np.all(np.isfinite(T_c)):
        return pairs
    warm = np.array([resistance_warmed(measured, float(T), resistance.copper) for T in (*T_c, np.mean(T_c))])
    signals = {**pairs.signals, "u_d_v": pairs["u_d_v"] - (warm[:-1] - warm[-1]) * pairs["i_d_a"]}
    return Trace(pairs.t_s, signals, pairs.units, pairs.meta)


def check_pairs(pairs: Trace, noise: Noise, curve: InverterCurve) -> PairCheck:
    """Judge the slopes of the three pairs of phases; while the rotor moves they say nothing, and are not judged.

    Raises IdentificationError: ``E_CURRENT_SENSOR``, ``E_UNBALANCED``.

    Parameters
    ----------
    pairs : Trace
        Six rows, two currents with each phase idle (``meta["idle"]``, else a, b, c): ``i_a_a i_b_a i_c_a u_d_v i_d_a``,
        ``moved`` 1 where the rotor did not come to rest; ``u_d_change_v i_d_change_a`` from half to half of a window,
        and ``meta["samples"]``, where they are known.
    noise : Noise
        From the zero-current trace.
    curve : InverterCurve
        Voltage error from the DC levels.
    """
    mismatch = estimate_mismatch(pairs, noise)
    if mismatch.spread - COVERAGE_FACTOR * mismatch.doubt > SENSOR_LIMIT:
        named = ", ".join(f"{phase} {100 * gain:+.2g} %" for phase, gain in zip("abc", mismatch.gains, strict=True))
        raise refuse(
            "E_CURRENT_SENSOR",
            f"the gains of the phase current sensors differ by {100 * mismatch.spread:.2g} % ({named} of their mean), "
            f"limit {100 * SENSOR_LIMIT:g} %",
            stage=STAGE,
            likely="a damaged sensor, or a wrong scale of one phase",
        )
    # the other two phases of a pair have half of the idle one's gain less, beyond the mean
    gains = np.array(mismatch.gains) if mismatch.corrected else np.zeros(3)
    order = np.argsort(pairs.meta.get("idle", list("aabbcc")), kind="stable")
    i, u = pairs["i_d_a"][order] / (1.0 - 0.5 * np.repeat(gains, 2)), pairs["u_d_v"][order]
    offset = math.hypot(noise.offset_d_a, noise.offset_q_a)
    lost, beside = (curve.vector_error_v(i - off) for off in (0.0, offset))
    steps = np.diff(i)[::2]
    raw = np.diff(u)[::2] / steps
    taken = np.diff(lost)[::2] / steps
    slopes = raw - taken
    # noise of a mean, seen through the slope at both ends; and legs that are not alike
    samples = int(pairs.meta.get("samples", MEAN_SAMPLES))
    std = MEAN_NOISE_FACTOR * noise.sigma_a * math.sqrt(2.0 / samples) * float(np.max(np.abs(raw)))
    if "u_d_change_v" in pairs.signals:  # ripple of a link: a mean of both halves has half of their difference
        change = pairs["u_d_change_v"] - float(np.mean(raw)) * pairs["i_d_change_a"]
        std = max(std, math.sqrt(0.5 * float(np.mean(change**2))))
    std /= float(np.min(np.abs(steps)))
    limit = max(BALANCE_LIMIT * float(np.mean(slopes)), SLOPE_SIGMA * std)
    # legs, and what offsets of the sensors are in the knee of the curve
    limit += LEG_DOUBT * float(np.max(np.abs(taken)))
    limit += float(np.max(np.abs(lost - beside).reshape(3, 2).sum(axis=1) / np.abs(steps)))
    difference = float(np.ptp(slopes))
    moved = "moved" in pairs.signals and float(np.max(pairs["moved"])) > 0.0
    if not moved and not (difference <= limit and float(np.min(raw)) > 0.0):
        named = ", ".join(f"{name} {slope:.4g}" for name, slope in zip(PAIRS, slopes, strict=True))
        raise refuse(
            "E_UNBALANCED",
            f"the resistances of the phase pairs differ by {difference:.3g} ohm, limit {limit:.3g} ohm ({named} ohm)",
            stage=STAGE,
        )
    resistances = (float(slopes[0]), float(slopes[1]), float(slopes[2]))
    # legs: how much of the inverter's error each pair has, beside its resistance
    rest = (u - float(np.mean(slopes)) * i - lost).reshape(3, 2)
    legs = [np.linalg.lstsq(np.stack(rows, axis=1), r, rcond=None)[0][1] for *rows, r in zip(
        i.reshape(3, 2), lost.reshape(3, 2), rest, strict=True
    )]  # fmt: skip
    std = math.hypot(std, float(np.ptp(legs)) * float(np.max(np.abs(taken))))
    return PairCheck(resistances, mismatch, not moved, std)


def over_phases(resistance: ResistanceResult, pairs: PairCheck, tolerance: SensorTolerance) -> ResistanceResult:
    """Return R as the mean of the phases, where they differ: the levels are held with phase a idle.

    A controller of one R meets all of them: how far a pair is from the mean is part of the interval. A difference that
    is not sure enough to be taken off is, too, up to the usual one.
    """
    beyond, measured = pairs.beyond_mean_ohm, resistance.R_measured
    if not any(beyond):
        seems = abs(pairs.resistance_ohm[0] - sum(pairs.resistance_ohm) / 3.0) if pairs.judged else 0.0
        doubt = math.hypot(measured.systematic, min(seems, USUAL_BEYOND * measured.value))
        told, R_measured = resistance.R_s.fallback, replace(measured, systematic=doubt)
        R_s = replace(normalised(R_measured, resistance.copper, tolerance), fallback=told)
        return replace(resistance, R_measured=R_measured, R_s=R_s)
    mean = replace(
        measured,
        value=measured.value - beyond[0],
        std=math.hypot(measured.std, pairs.std_ohm),
        systematic=math.hypot(measured.systematic, max(map(abs, beyond))),
    )
    phases = ", ".join(f"{phase} {mean.value - 2.0 * b:.4g}" for phase, b in zip("abc", beyond, strict=True))
    told = "; ".join(part for part in (resistance.R_s.fallback, f"mean of the phases: {phases} ohm") if part)
    normal = replace(normalised(mean, resistance.copper, tolerance), fallback=told)
    return replace(resistance, R_measured=mean, R_s=normal)


def _spread(values: NDArray[np.float64]) -> float:
    return float(np.ptp(values) / np.abs(np.mean(values)))
