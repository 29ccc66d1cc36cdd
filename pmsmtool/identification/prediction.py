# SPDX-License-Identifier: MIT
"""What the run will be good for, from its first small shot: standard deviations before the machine moves.

R from the design matrix of the levels and the noise at rest, L from the information of a triangle of the planned
ripple, psi_f from what the dead-time voltage of the small vectors leaves in the intercept. A prediction above the limit
of an accepted value refuses the run while nothing larger than the small vectors has been applied.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pmsmtool.estimators.estimate import COVERAGE_FACTOR, SensorTolerance
from pmsmtool.estimators.least_squares import linear_solve
from pmsmtool.estimators.noise import Noise
from pmsmtool.estimators.resistance import FIT_FROM, MEAN_NOISE_FACTOR, MODEL_FLOOR
from pmsmtool.refusals import refuse

STAGE = "plan"
TAIL = (1, 2)
"""Tail terms of the predicted fit: the richest of the usual models."""
L_NUISANCE = 2.0
"""Standard deviation with delay, lag and resistance free, over the one of L alone (random drives: 1.5 to 2.5)."""
L_FLOOR = 3e-4
PSI_DEAD_TIME = 0.02
"""Part of the dead-time voltage that stays in psi_f's back-emf (random drives: 0.01 to 0.03)."""
LIMIT = 0.03
"""Relative 95 % half width of an accepted value."""


NAMES: Mapping[str, str] = {
    "R_s_ohm": "R_s",
    "L_d_h": "L_d",
    "L_q_h": "L_q",
    "psi_f_wb": "psi_f",
    "J_kgm2": "J",
    "B_nms": "B",
    "tau_c_nm": "tau_c",
}
"""Machine-file keys as a person reads them."""
STEPS: Mapping[str, tuple[str, ...]] = {"levels": ("R_s_ohm",), "square": ("L_d_h", "L_q_h"), "speeds": ("psi_f_wb",)}
"""What each experiment gives that the first small shot predicts."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """Relative standard deviations of the run to come (1)."""

    R_s: float
    L: float
    psi_f: float

    def values(self, steps: Iterable[str] = tuple(STEPS)) -> dict[str, float]:
        """Return those that a run of these experiments gives, by machine-file key."""
        known = {"R_s_ohm": self.R_s, "L_d_h": self.L, "L_q_h": self.L, "psi_f_wb": self.psi_f}
        run = set(steps)
        return {key: known[key] for step, keys in STEPS.items() if step in run for key in keys}


def line_of(values: Mapping[str, float]) -> str:
    """Return predictions as a person reads them; neighbours of one value share it."""
    parts: list[str] = []
    keys = list(values)
    for k, key in enumerate(keys):
        alike = k + 1 < len(keys) and values[keys[k + 1]] == values[key]
        parts.append(NAMES[key] if alike else f"{NAMES[key]} {100 * values[key]:.2g} %")
    return "predicted standard deviation: " + ", ".join(parts)


def predict(
    noise: Noise,
    levels_a: Sequence[float],
    window_samples: int,
    ripple_a: float,
    shot_samples: int,
    dead_time_v: float,
    emf_v: float,
    tolerance: SensorTolerance,
) -> Prediction:
    """Predict the standard deviations.

    Parameters
    ----------
    noise : Noise
        From the zero-current trace.
    levels_a : sequence of float
        Planned DC levels, both signs (A).
    window_samples : int
        Samples averaged at each.
    ripple_a, shot_samples : float, int
        Planned ripple, peak to peak (A), and samples of both shots of an axis.
    dead_time_v, emf_v : float
        Largest voltage of the small vectors, which dead time makes, and back-emf of the middle speed (V).
    tolerance : SensorTolerance
        With the thresholds of the bridge.
    """
    levels = np.asarray(levels_a, dtype=np.float64)
    peak = float(np.max(np.abs(levels)))
    used = levels[np.abs(levels) >= FIT_FROM * peak] / peak
    sign = np.sign(used)
    columns = np.stack([used, sign, np.ones_like(used), *(sign / np.abs(used) ** p for p in TAIL)], axis=1)
    covariance = linear_solve(columns, used, np.ones_like(used))[1]
    per_level = math.hypot(MEAN_NOISE_FACTOR * noise.sigma_a / (math.sqrt(window_samples) * peak), MODEL_FLOOR)
    R_s = per_level * math.sqrt(float(covariance[0, 0]))
    L = L_NUISANCE * noise.sigma_a * math.sqrt(12.0 / shot_samples) / ripple_a
    scale = tolerance.voltage_scale_std
    return Prediction(
        math.hypot(R_s, scale), math.hypot(L, L_FLOOR, scale), math.hypot(PSI_DEAD_TIME * dead_time_v / emf_v, scale)
    )


def check_prediction(values: Mapping[str, float]) -> None:
    """Refuse a run whose intervals would be wider than an accepted value's. Raises IdentificationError: ``E_SNR``.

    Parameters
    ----------
    values : mapping of str to float
        Relative standard deviations of what the run is to give.
    """
    for key, value in values.items():
        if COVERAGE_FACTOR * value > LIMIT:
            raise refuse(
                "E_SNR",
                f"the 95 % interval of {NAMES[key]} would be {100 * COVERAGE_FACTOR * value:.2g} %, limit "
                f"{100 * LIMIT:g} %",
                stage=STAGE,
            )
