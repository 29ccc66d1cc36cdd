# SPDX-License-Identifier: MIT
"""Noise of the estimated speed against a simulated estimate, and the speed loop that it slows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.design.loops.speed_loop import TORQUE_SHARE, SpeedPath, encoder_torque, speed_noise
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
    shapes = [design["speed.K_i_nm_per_rad"] / design["speed.K_p_nms_per_rad"] ** 2 for design in (heavy, quiet)]
    assert shapes[0] == pytest.approx(shapes[1], rel=1e-6), "a slow integral let a heavy shaft creep for seconds"
    assert any("(0.14 deg noise) would make it ask" in note for note in heavy.notes)
    assert not any("the encoder (" in note for note in (*quiet.notes, *light.notes))
    asked = tune(noisy(100.0), TuneRequest(speed_bandwidth_hz=10.0))
    assert asked["speed.K_p_nms_per_rad"] > 2.0 * K_p, "what is asked for is designed"


def off_centre(J_share: float, once_rad: float) -> MachineFile:
    source = noisy(J_share, 0.0)
    return replace(source, conditions={**source.conditions, "encoder_once_rad": once_rad})


def path_of(source: MachineFile, filter_hz: float) -> SpeedPath:
    J = source.machine.J_kgm2
    assert J is not None
    return SpeedPath(J, 0.0, None, 1, 0.05 / source.inverter.T_s, filter_hz)  # type: ignore[arg-type]


@pytest.mark.parametrize("speed_rad_s", [30.0, 300.0])
def test_the_torque_of_an_error_per_turn_is_that_of_a_simulated_loop(speed_rad_s: float) -> None:
    """A rigid shaft under K_p alone, whose encoder is off centre, at a mean speed."""
    source, e_rad = off_centre(1.0, 5e-3), 5e-3
    T, path = source.inverter.T_s, path_of(source, 200.0)
    a, K_p = path.pll_rad_s, 50.0 * path.J
    keep = math.exp(-2.0 * math.pi * path.filter_hz * T)
    angle = speed = filtered = shaft = turned = 0.0
    asked = []
    for k in range(round(4.0 * 2.0 * math.pi / speed_rad_s / T) + 20_000):
        error = turned + e_rad * math.sin(speed_rad_s * k * T) - angle
        angle += T * (speed + 2.0 * a * error)
        speed += T * a * a * error
        filtered = keep * filtered + (1.0 - keep) * speed
        asked.append(-K_p * filtered)
        shaft += T * asked[-1] / path.J
        turned += T * shaft
    found = float(np.std(asked[-round(2.0 * 2.0 * math.pi / speed_rad_s / T) :]))
    assert encoder_torque(source, path, K_p, speed_rad_s) == pytest.approx(found, rel=WITHIN)  # measured: 0.2, 0.8 %


def test_an_encoder_off_centre_on_a_heavy_shaft_gets_a_slower_speed_loop() -> None:
    """A load of 46 rotors behind 0.34 degrees shook between -12 and 12 A at a constant speed, inside its band."""
    centred, heavy, light = (tune(off_centre(*drawn)) for drawn in ((100.0, 0.0), (100.0, 6e-3), (1.0, 6e-3)))
    ratio = heavy["speed.K_p_nms_per_rad"] / centred["speed.K_p_nms_per_rad"]
    assert ratio < 0.3
    path = path_of(off_centre(100.0, 6e-3), heavy["speed.filter_hz"])
    path = replace(path, pll_rad_s=heavy["encoder.pll_bandwidth_rad_s"])
    rated_rad_s = (heavy.machine.machine.n_nom_rpm or 0.0) * math.pi / 30.0
    asked_nm = encoder_torque(heavy.machine, path, heavy["speed.K_p_nms_per_rad"], rated_rad_s)
    assert asked_nm == pytest.approx(TORQUE_SHARE * heavy["speed.tau_max_nm"], rel=1e-3)
    assert any("(0.34 deg once per turn) would make it ask" in note for note in heavy.notes)
    assert not any("the encoder (" in note for note in (*centred.notes, *light.notes))
