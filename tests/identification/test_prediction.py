# SPDX-License-Identifier: MIT
"""The prediction from the first small shot: its size, and when it stops a run."""

import math
from dataclasses import replace

import pytest

from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.current_sensors import Noise
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.identification.prediction import Prediction, check_prediction, line_of, predict

LEVELS = [sign * k / 12.0 for k in range(1, 13) for sign in (1.0, -1.0)] * 2
EXACT = SensorTolerance(bridge_threshold_v=0.0)


def of(sigma_a: float, *, dead_time_v: float = 2.0, tolerance: SensorTolerance = EXACT) -> Prediction:
    return predict(Noise(sigma_a, 0.0, 0.0), LEVELS, 1600, 0.25, 4096, dead_time_v, 80.0, tolerance)


def test_a_usual_drive_is_predicted_below_a_third_of_a_percent() -> None:
    usual = of(0.002)
    assert usual.R_s < 3e-3 and usual.L < 2e-3 and usual.psi_f == pytest.approx(5e-4)  # 1.9e-3, 0.9e-3
    check_prediction(usual.values())


def test_noise_reaches_R_and_L_and_dead_time_reaches_psi() -> None:
    quiet, noisy = of(0.02), of(0.2)
    assert noisy.R_s > 2.0 * quiet.R_s
    assert noisy.L == pytest.approx(10.0 * quiet.L, rel=0.05)
    assert of(0.002, dead_time_v=20.0).psi_f == pytest.approx(10.0 * of(0.002).psi_f)
    bridge = of(0.002, tolerance=SensorTolerance(U_dc_v=100.0))
    assert bridge.psi_f == pytest.approx(math.hypot(of(0.002).psi_f, 3.5e-3))


@pytest.mark.parametrize("name", ["R_s", "L", "psi_f"])
def test_what_cannot_become_good_enough_is_not_begun(name: str) -> None:
    with pytest.raises(IdentificationError) as caught:
        check_prediction(replace(of(0.002), **{name: 0.02}).values())
    assert caught.value.reason == "E_SNR"
    assert name in str(caught.value)
    others = {"levels", "square", "speeds"} - {{"R_s": "levels", "L": "square", "psi_f": "speeds"}[name]}
    check_prediction(replace(of(0.002), **{name: 0.02}).values(others))  # what is not measured refuses nothing


def test_only_what_a_run_measures_is_predicted() -> None:
    usual = of(0.002)
    assert set(usual.values({"levels", "rotation"})) == {"R_s_ohm"}
    assert set(usual.values()) == {"R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb"}
    line = line_of(usual.values({"levels", "square"}))
    assert "R_s" in line and "L_d, L_q" in line and "psi_f" not in line
