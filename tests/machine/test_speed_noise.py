# SPDX-License-Identifier: MIT
"""Noise of the estimated speed against a simulated estimate, and the speed loop that it slows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.design.loops.speed_loop import TORQUE_SHARE, speed_noise
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.machine.machine_file import MachineFile, load_machine_file

NOISE_RAD = 2.5e-3
WITHIN = 0.06
"""Of a continuous integral, where poles are at a tenth of the sampling rate; measured 1 and 3 %."""


def noisy(J_share: float, noise_rad: float = NOISE_RAD) -> MachineFile:
    source = load_machine_file("interior-2k2")
    J = J_share * (source.machine.J_kgm2 or 0.0)
    conditions = {**source.conditions, "encoder_noise_rad": noise_rad}
    return replace(source, machine=replace(source.machine, J_kgm2=J), conditions=conditions)


@pytest.mark.parametrize("filter_hz", [20.0, 200.0])
def test_the_noise_of_the_speed_is_that_of_a_simulated_estimate(filter_hz: float) -> None:
    source = noisy(1.0)
    T, a = source.inverter.T_s, 0.05 / source.inverter.T_s
    keep = math.exp(-2.0 * math.pi * filter_hz * T)
    angle = speed = filtered = 0.0
    found = []
    for noise in NOISE_RAD * np.random.default_rng(1).standard_normal(200_000):
        error = noise - angle
        angle += T * (speed + 2.0 * a * error)
        speed += T * a * a * error
        filtered = keep * filtered + (1.0 - keep) * speed
        found.append(filtered)
    assert speed_noise(source, a, filter_hz) == pytest.approx(float(np.std(found[1000:])), rel=WITHIN)
    assert speed_noise(load_machine_file("interior-2k2"), a, filter_hz) == 0.0


def test_a_noisy_encoder_on_a_heavy_shaft_gets_a_slower_speed_loop() -> None:
    """A drive of the population swung its torque from limit to limit: 299 % of the largest, rms, by 0.14 degrees."""
    quiet, heavy, light = (tune(source) for source in (noisy(100.0, 0.0), noisy(100.0), noisy(0.1)))
    K_p, hz = heavy["speed.K_p_nms_per_rad"], heavy["speed.filter_hz"]
    noise_nm = K_p * speed_noise(noisy(100.0), heavy["encoder.pll_bandwidth_rad_s"], hz)
    assert noise_nm == pytest.approx(TORQUE_SHARE * heavy["speed.tau_max_nm"], rel=1e-3)
    assert K_p < 0.2 * quiet["speed.K_p_nms_per_rad"]
    assert any("encoder's noise of 0.14 deg" in note for note in heavy.notes)
    assert not any("encoder's noise" in note for note in (*quiet.notes, *light.notes))
    asked = tune(noisy(100.0), TuneRequest(speed_bandwidth_hz=10.0))
    assert asked["speed.K_p_nms_per_rad"] > 2.0 * K_p, "what is asked for is designed"
