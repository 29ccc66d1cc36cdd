# SPDX-License-Identifier: MIT
"""How much is collected for an accuracy that was asked for: levels, windows, shots and speeds, by what they predict.

Without one everything is collected. The short lists begin with what the estimators need at least: both signs and five
levels above their least one, two half periods, four pairs of d currents over two speeds in each direction, three of
them with the largest, which show the sampling instant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from pmsmtool.estimators.estimate import COVERAGE_FACTOR
from pmsmtool.experiments import mechanics_run, rotation, speed_run, square_injection, standstill
from pmsmtool.experiments.mechanics_run import MechanicsPlan
from pmsmtool.identification.prediction import Prediction

Rotation = tuple[float, float, float | None, float]

LEVELS = 12
LOWEST_LEVEL = 0.08
"""Lowest DC level of the sweep, of the largest; the low ones serve the inverter curve."""


@dataclass(frozen=True, slots=True)
class LevelEffort:
    """DC levels and how they are held."""

    shares: tuple[float, ...] | None = None
    """Of the largest; None: :data:`LEVELS` of them."""
    low: tuple[float, ...] = (0.02, 0.04)
    """Those for the inverter curve alone: a speed run at small current lives there."""
    window: int = standstill.LEVEL_WINDOW
    drift: float = standstill.DRIFTED
    settle_s: float = 0.06
    """As ``standstill.LevelPlan``."""

    def magnitudes(self, largest_a: float) -> list[float]:
        """Return the currents that are held with both signs (A), rising."""
        if self.shares is not None:
            return [largest_a * share for share in self.shares]
        ratio = (1.0 / LOWEST_LEVEL) ** (1.0 / (LEVELS - 1))
        magnitudes = [largest_a * max(LOWEST_LEVEL, (k + 1) / LEVELS) for k in range(LEVELS)]
        magnitudes[:2] = [largest_a * LOWEST_LEVEL, largest_a * LOWEST_LEVEL * ratio]
        return sorted(set(magnitudes))

    def sequence(self, largest_a: float, low_a: Sequence[float] = ()) -> tuple[float, ...]:
        """Return the levels with their signs (A), in the order in which they are held; ``low_a`` besides."""
        order = standstill.calm_sequence if self.shares is None else standstill.falling_sequence
        return order(self.magnitudes(largest_a), low_a)


@dataclass(frozen=True, slots=True)
class SpeedEffort:
    """Speeds and d currents of the flux run (``speed_run.SpeedPlan``), and rows of the pushes before and after it.

    ``speed_share`` is its largest speed, of the largest; ``answer_samples`` are those of a push that looks for the
    shaft's answer, which is one from ``answer_share`` of the speed that the pushes aim at. ``quick`` runs have more
    accelerating current, shorter looks at the speed and fewer at what keeps it.
    """

    shares: tuple[float, ...] = speed_run.SHARES
    d_shares: tuple[tuple[float, ...], ...] = speed_run.D_SHARES
    q_at: tuple[int, ...] = speed_run.Q_AT
    window_s: float = speed_run.WINDOW_S
    longest_s: float = speed_run.LONGEST_S
    push_samples: int = 1024
    mechanics_rows: int = mechanics_run.ROWS
    speed_share: float = 1.0
    answer_samples: int = 256
    answer_share: float = 0.15
    quick: bool = False


ALL_SPEEDS = SpeedEffort()
ALL_LEVELS = LevelEffort()


ROTATIONS: tuple[Rotation, ...] = (
    (0.35, rotation.QUICK_STEP_RAD, rotation.QUICK_DWELL_S, rotation.RAMP_S),
    (0.35, rotation.SWUNG_RAD, None, 0.0),
    (0.18, rotation.STEP_RAD, 0.03, 3.0 * rotation.RAMP_S),
    (0.09, rotation.STEP_RAD, 0.03, 4.0 * rotation.RAMP_S),
    (0.7, rotation.STEP_RAD, 0.06, 4.0 * rotation.RAMP_S),
)
"""Current, of the test current, largest step (rad), time per step and ramp (s) of every try. Above psi/(L_q - L_d) a d
current is no stable position: a reluctance machine follows a smaller vector only, and swings longer on it. Those with
longer ramps have another speed, too, for a rotor that swings with the first. Without a time per step the rotor swings
from step to step: a heavy one swings behind every vector that turns by itself. The last is for friction and inertia
that hold the rotor off a smaller vector."""


@dataclass(frozen=True, slots=True)
class Effort:
    """What is collected; the default is all of it. ``rotations`` are tried one after the other.

    Without ``turn_s`` a rotor swings from vector to vector (``experiments/rotation``), as one does that the slow turn
    left swinging.

    With ``quick`` pole pairs, direction and offset come from the rotor's rests on the vectors of levels and pairs,
    where these show them, without the slow turn; levels, pairs and square waves are held as ``quick`` ones. The rotor
    is turned by ``turn_share`` of the test current at least.
    """

    levels: LevelEffort = ALL_LEVELS
    turn_s: float | None = rotation.TURN_S
    turn_share: float = 0.0
    quick: bool = False
    rotations: tuple[Rotation, ...] = ROTATIONS
    shot_samples: int = square_injection.SHOT_SAMPLES
    speeds: SpeedEffort = ALL_SPEEDS

    @property
    def left_out(self) -> dict[str, str]:
        """What is not collected, by quantity of a request."""
        found = {}
        if self.levels != ALL_LEVELS:
            held, all_of = (2 * (len(one.magnitudes(1.0)) + len(one.low)) for one in (self.levels, ALL_LEVELS))
            found["R"] = f"{all_of - held} of {all_of} levels"
        waves = ["one of two fast square waves"] if self.quick else []
        if self.shot_samples != square_injection.SHOT_SAMPLES:
            all_of = square_injection.SHOT_SAMPLES
            waves.append(f"up to {all_of - self.shot_samples} of {all_of} samples of a square wave")
        if waves:
            found["L"] = ", ".join(waves)
        if self.speeds != ALL_SPEEDS:
            share, all_of = self.speeds.speed_share, len(speed_run.SHARES)
            slower = f", down to {100.0 * share:.0f} % of the largest speed" if share < 1.0 else ""
            held, currents = (sum(map(len, one.d_shares)) for one in (self.speeds, ALL_SPEEDS))
            speeds = f"{all_of - len(self.speeds.shares)} of {all_of} speeds in each direction{slower}"
            found["psi"] = f"{speeds}, {currents - held} of {currents} d currents"
            rows = mechanics_run.ROWS
            found["mechanics"] = f"{rows - self.speeds.mechanics_rows} of {rows} rows of a torque pulse"
        return found


ALL = Effort()
LEVEL_EFFORTS = (
    LevelEffort((0.08, 0.16, 0.3, 0.42, 0.6, 0.8, 1.0), (0.03,), 400, 4.0 * standstill.DRIFTED, 0.0),
    LevelEffort((0.08, 0.12, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0), (0.02, 0.04), 800, 2.0 * standstill.DRIFTED),
    ALL_LEVELS,
)
SHOT_EFFORTS = (256, 512, 1024, square_injection.SHOT_SAMPLES)
_TWO_SPEEDS = SpeedEffort(
    (0.42, 0.85), ((1.0,), (1.0 / 3.0, 1.0, 1.0)), (0,), window_s=0.03, longest_s=0.06, push_samples=128,
    mechanics_rows=400, answer_samples=64, answer_share=0.05, quick=True,
)  # fmt: skip
SPEED_EFFORTS = (replace(_TWO_SPEEDS, speed_share=0.5), _TWO_SPEEDS, ALL_SPEEDS)
QUICK_NOISE_SAMPLES = 400
"""The noise is known to 2.5 % of itself."""
QUICK_TURN_SHARE = 0.3
"""Current that swings the rotor from vector to vector, of the test current: that of the pairs of phases."""
QUICK_ROTATION: Rotation = (0.35, math.radians(30.0), rotation.QUICK_DWELL_S, 0.35)
"""Current, step, dwell and ramp of a slow turn that is tried before :data:`ROTATIONS`: what swings with it takes
those. It serves pole pairs and direction; the offset comes from the speed run."""
MECHANICS = ("J_kgm2", "B_nms", "tau_c_nm")
COASTINGS = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0)
"""Times of coasting, in pushes, that may be enough (``mechanics_run.COAST_UNITS``)."""
AS_GOOD = 1.05
"""Deviation that a coasting is predicted to leave, of that of the longest, which counts as no worse."""
R_MISFIT, L_MISFIT, PSI_MISFIT = 1.0, 1.5, 1.0
"""Half width that is found at the least effort, of the predicted one: it has the model's misfit, too. Largest
of 14 random drives, two of them hard: 1.0, 1.45 and 0.93 (``benchmarks/machine_time.py``)."""


def effort_for(accuracy: float | None, predicted: Callable[[Effort], Prediction]) -> Effort:
    """Return the least effort whose predicted 95 % half widths are within an accuracy (1); all without one.

    Each experiment is chosen by itself; one that would miss it with all of its effort gets all of it.
    """
    if accuracy is None:
        return ALL

    def enough(std: float, misfit: float) -> bool:
        return misfit * COVERAGE_FACTOR * std <= accuracy

    levels = next(
        (one for one in LEVEL_EFFORTS if enough(predicted(Effort(levels=one)).R_s, R_MISFIT)), LEVEL_EFFORTS[-1]
    )
    shots = next(
        (one for one in SHOT_EFFORTS if enough(predicted(Effort(shot_samples=one)).L, L_MISFIT)), SHOT_EFFORTS[-1]
    )
    speeds = next(
        (one for one in SPEED_EFFORTS if enough(predicted(Effort(speeds=one)).psi_f, PSI_MISFIT)), SPEED_EFFORTS[-1]
    )
    return Effort(
        levels, turn_s=None, turn_share=QUICK_TURN_SHARE, quick=True, rotations=(QUICK_ROTATION, *ROTATIONS),
        shot_samples=shots, speeds=speeds,
    )  # fmt: skip


def coasting_for(
    accuracy: float | None, plan: MechanicsPlan, predicted: Callable[[MechanicsPlan], Mapping[str, float]]
) -> tuple[MechanicsPlan, Mapping[str, float]]:
    """Return the plan with the shortest coasting whose J, B and tau_c are predicted within an accuracy, and these.

    One that the longest would miss, too, must be as good as that. Unchanged without an accuracy, or where a friction is
    not predicted: it is too small for a short coasting.
    """
    whole = predicted(plan)
    if accuracy is None or len(whole) < len(MECHANICS):
        return plan, whole
    for units in COASTINGS:
        found = predicted(shorter := replace(plan, coast_units=units))
        if all(value <= max(accuracy / COVERAGE_FACTOR, AS_GOOD * whole[name]) for name, value in found.items()):
            return shorter, found
    return plan, whole


def larger_levels(effort: LevelEffort) -> tuple[LevelEffort, ...]:
    """Return the next larger efforts of the levels."""
    return LEVEL_EFFORTS[LEVEL_EFFORTS.index(effort) + 1 :]
