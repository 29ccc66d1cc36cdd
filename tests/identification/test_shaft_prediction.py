# SPDX-License-Identifier: MIT
"""Predicted deviations of inertia and friction against those that the fits of random shafts give."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.mechanics_accuracy import realisation
from pmsmtool.estimators.shaft.mechanics import TORQUE_FLOOR, estimate_mechanics
from pmsmtool.estimators.shaft.position import encoder_step
from pmsmtool.identification import prediction
from pmsmtool.identification.prediction import PushPlan, RoughShaft, predict_mechanics, rough_friction
from pmsmtool.trace import Trace

CURRENT_A = 4.0
SHAFTS = 5
J_RATIO, FRICTION_RATIO = (0.9, 1.15), (0.07, 3.0)
"""Fit's deviation over the predicted one. Measured: 1.00 to 1.11, and 0.36 to 2.82 for friction: the second push of
these realisations lasts twice as long as the first also where the plan would make it shorter, and a drag that may be
there has a part in B, which no prediction knows."""
KEYS = ("J_kgm2", "B_nms", "tau_c_nm")


@pytest.mark.chain
def test_the_prediction_is_what_the_fit_says_of_random_shafts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prediction, "RIPPLE", TORQUE_FLOOR)  # that of the realisations
    monkeypatch.setattr(prediction, "SCALE_FLOOR", 0.0)
    rng = np.random.default_rng(11)
    for _ in range(SHAFTS):
        traces, (J, B, tau_c), per_a, sigma = realisation(rng)
        found = estimate_mechanics(traces, lambda i_d, i_q, k=per_a: k * i_q, per_a, sigma, 0.0)
        unit_s, coast_s = (float(trace.t_s[-1]) for trace in traces[:2])
        shaft = RoughShaft(J, B, tau_c, per_a, encoder_step([t["theta_M_rad"] for t in traces]))
        predicted = predict_mechanics(shaft, PushPlan(CURRENT_A, unit_s, coast_s, len(traces[0])), sigma, 0.0)
        for key, std, true in zip(KEYS, found.fit_std, (J, B, tau_c), strict=True):
            least, most = J_RATIO if key == "J_kgm2" else FRICTION_RATIO
            assert least < std / true / predicted[key] < most, key


def test_the_scale_of_the_torque_reaches_all_three_and_unseen_friction_is_left_out() -> None:
    plan = PushPlan(4.0, 0.2, 1.2, 2000)
    shaft = RoughShaft(2e-3, 1e-3, 0.05, 0.9, 1e-4)
    sure, unsure = predict_mechanics(shaft, plan, 0.02, 0.0), predict_mechanics(shaft, plan, 0.02, 0.01)
    assert set(sure) == set(KEYS)
    for key in KEYS:
        assert unsure[key] == pytest.approx(math.hypot(sure[key], 0.01), rel=2e-3)
    coarse = predict_mechanics(RoughShaft(2e-3, 1e-3, 0.05, 0.9, 2e-3), plan, 0.02, 0.0)
    assert coarse["tau_c_nm"] > 1.2 * sure["tau_c_nm"]
    assert set(predict_mechanics(RoughShaft(2e-3, 0.0, 0.0, 0.9, 1e-4), plan, 0.02, 0.0)) == {"J_kgm2"}


def test_the_friction_is_seen_in_how_the_shaft_slows_down() -> None:
    J, B, tau_c, pole_pairs, half_s, per_a = 2e-3, 1e-3, 0.05, 3, 0.05, 0.9
    first = np.array([100.0, 200.0, 300.0, 300.0, -100.0, -200.0, -300.0, -300.0])
    i_q = np.array([0.0, 0.01, 0.0, 1.0, 0.0, 0.0, -0.01, -1.0])
    second = first + half_s * (per_a * i_q - B * first - tau_c * np.sign(first)) / J
    signals = {
        "omega_first_rad_s": pole_pairs * first,
        "omega_second_rad_s": pole_pairs * second,
        "half_s": np.full(8, half_s),
        "i_q_a": i_q,
    }
    trace = Trace(np.arange(8.0), signals, dict.fromkeys(signals, "1"))
    assert rough_friction(trace, J, per_a, pole_pairs) == (pytest.approx(B, rel=0.05), pytest.approx(tau_c, rel=0.05))
