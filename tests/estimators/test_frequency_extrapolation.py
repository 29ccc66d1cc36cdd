# SPDX-License-Identifier: MIT
"""R_s from levels at two control frequencies, on dead-time shapes that no tail of the fit describes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.estimate import COVERAGE_FACTOR, SensorTolerance
from pmsmtool.estimators.frequency_extrapolation import FrequencySplit, extrapolated, split_by_frequency
from pmsmtool.estimators.noise import Noise
from pmsmtool.estimators.resistance import (
    FIT_FROM,
    HARD_RATIO,
    Copper,
    at_one_temperature,
    estimate_resistance,
    level_sequence,
)
from pmsmtool.trace import Trace
from tests.estimators.plant import SHAPES, Drives, draw, inverter_shape
from tests.estimators.test_resistance import ALPHA, LEVELS, SAMPLES, noise_of

DEVICES_V = 0.8
PERIOD_S = 5e-5
HARDNESS = 4.5


def hard(count: int, seed: int) -> tuple[Drives, np.random.Generator]:
    """Drives whose dead time takes a multiple of R I, over every shape."""
    rng = np.random.default_rng(seed)
    d = draw(count, rng)
    shape = np.arange(count) % SHAPES
    return replace(d, dV=HARDNESS * d.R * d.I_r, shape=shape.astype(np.float64)), rng


def levels_at(
    d: Drives, k: int, rng: np.random.Generator, share: float, *, T_c: float = 20.0, least: float = 0.0
) -> Trace:
    """Levels at a multiple of the drive's own frequency: dead time scales with it, devices do not."""
    i = np.array(level_sequence([fraction * d.I_r[k] for fraction in LEVELS if fraction >= least]))
    n = len(i)
    phase = 0.5 * math.sqrt(3.0) * i
    error = share * d.dV[k] * inverter_shape(d.shape[k], phase / d.knee[k]) + DEVICES_V * np.sign(i)
    v = d.R[k] * (1.0 + ALPHA * (T_c - 20.0)) * i + 2.0 / math.sqrt(3.0) * error + 0.01 * share
    shown = [i + d.sigma_dq[k] * rng.standard_normal(n) / math.sqrt(SAMPLES / 2) for _ in range(2)]
    signals = {
        "i_d_a": 0.5 * (shown[0] + shown[1]),
        "u_d_v": v,
        "i_d_first_a": shown[0],
        "i_d_second_a": shown[1],
        "u_d_first_v": v,
        "u_d_second_v": v,
        "T_winding_c": np.full(n, T_c),
    }
    meta = {"samples": SAMPLES, "period_s": PERIOD_S / share, "own_period_s": PERIOD_S}
    return Trace(np.arange(n, dtype=np.float64) * 0.25, signals, dict.fromkeys(signals, "1"), meta)


def split_of(d: Drives, k: int, rng: np.random.Generator) -> tuple[FrequencySplit, Trace]:
    levels = levels_at(d, k, rng, 1.0)
    slower = levels_at(d, k, rng, 0.5, least=FIT_FROM)
    return split_by_frequency(levels, slower, noise_of(d, k), least_current=FIT_FROM), levels


@pytest.mark.chain
@pytest.mark.parametrize("seed", range(5))
def test_dead_time_of_any_shape_falls_out(seed: int) -> None:
    """Over ten seeds the largest error is 0.014 to 0.032 %; one frequency has 0.11 to 1.2 % on the same levels."""
    d, rng = hard(4 * SHAPES, seed)
    two, one = [], []
    for k in range(d.n):
        split, levels = split_of(d, k, rng)
        two.append(abs(split.R_ohm / d.R[k] - 1.0))
        assert two[-1] < COVERAGE_FACTOR * split.std_ohm / d.R[k]
        assert split.V_device_v == pytest.approx(DEVICES_V, abs=4e-4 * d.dV[k])  # measured 0.6e-4
        expected = d.dV[k] * inverter_shape(d.shape[k], split.curve.i_phase_a[-1:] / d.knee[k])[0]
        assert split.V_dead_v == pytest.approx(expected, rel=4e-4)  # measured 0.9e-4
        single = estimate_resistance(levels, noise_of(d, k), half_width_limit=math.inf)
        assert single.hardness > HARD_RATIO
        one.append(abs(single.R_measured.value / d.R[k] - 1.0))
    assert max(two) < 8e-4
    assert max(one) > 3.0 * max(two)


def test_the_dead_time_follows_from_voltage_and_period() -> None:
    d, rng = hard(1, 9)
    split, _ = split_of(d, 0, rng)
    assert 0.0 < split.V_dead_std_v < 1e-3 * split.V_dead_v
    assert split.dead_time_s(d.U_dc[0]) == pytest.approx(split.V_dead_v * PERIOD_S / d.U_dc[0])


def test_a_drive_whose_error_does_not_know_the_frequency_has_no_dead_time() -> None:
    """A built-in compensation, or another PWM frequency than the one that was set, looks like this."""
    d, rng = hard(1, 3)
    levels, same = levels_at(d, 0, rng, 1.0), levels_at(d, 0, rng, 1.0, least=FIT_FROM)
    slower = replace(same, meta={**same.meta, "period_s": 2.0 * PERIOD_S})
    split = split_by_frequency(levels, slower, noise_of(d, 0), least_current=FIT_FROM)
    assert abs(split.V_dead_v) < 0.01 * d.dV[0]
    assert split.V_device_v == pytest.approx(d.dV[0] + DEVICES_V, rel=0.03)


def test_a_winding_that_is_warmer_the_second_time_is_referred_to_one_temperature() -> None:
    d, rng = hard(1, 4)
    noise, copper = noise_of(d, 0), Copper()
    levels, slower = levels_at(d, 0, rng, 1.0, T_c=25.0), levels_at(d, 0, rng, 0.5, T_c=45.0, least=FIT_FROM)
    single = estimate_resistance(levels, noise, half_width_limit=math.inf)
    referred = [at_one_temperature(trace, single.R_measured, copper) for trace in (levels, slower)]
    split = split_by_frequency(referred[0], referred[1], noise, least_current=FIT_FROM)
    hot = d.R[0] * (1.0 + ALPHA * 5.0)
    assert split.R_ohm == pytest.approx(hot, rel=3e-3)
    unknown = split_by_frequency(levels, slower, noise, least_current=FIT_FROM)
    assert abs(unknown.R_ohm / hot - 1.0) > 0.1  # what the reading is worth: the extrapolation doubles the difference


def test_steady_heating_that_no_sensor_shows_is_told_from_the_dead_time() -> None:
    d, rng = hard(1, 7)
    noise, rise_k_per_s = noise_of(d, 0), 0.2
    levels, slower = levels_at(d, 0, rng, 1.0), levels_at(d, 0, rng, 0.5, least=FIT_FROM)
    start = levels.t_s[-1] + 0.25

    def warming(trace: Trace, start_s: float) -> Trace:
        more = d.R[0] * ALPHA * rise_k_per_s * (trace.t_s + start_s) * trace["i_d_a"]
        return replace(trace, signals={**trace.signals, "u_d_v": trace["u_d_v"] + more})

    split = split_by_frequency(warming(levels, 0.0), warming(slower, start), noise, least_current=FIT_FROM)
    seconds = start + slower.t_s[-1]
    assert split.R_ohm == pytest.approx(d.R[0] * (1.0 + 0.5 * ALPHA * rise_k_per_s * seconds), rel=3e-3)
    assert split.drift == pytest.approx(ALPHA * rise_k_per_s * seconds, rel=0.2)


def test_the_result_of_one_frequency_takes_resistance_and_curve_of_two() -> None:
    d, rng = hard(1, 5)
    split, levels = split_of(d, 0, rng)
    single = estimate_resistance(levels, noise_of(d, 0), half_width_limit=math.inf)
    both = extrapolated(single, split, Copper(), SensorTolerance())
    assert both.R_s.value == pytest.approx(split.R_ohm) and "two control frequencies" in both.R_s.method
    assert both.V_dead_v == pytest.approx(both.curve.u_error_v[-1], rel=0.03)  # the curve's last point is a mean
    drops = [r.R_measured.value * r.curve.i_phase_a + r.curve.u_error_v for r in (single, both)]
    assert np.allclose(drops[0], drops[1])  # together they are still what was measured


def test_sequences_that_cannot_be_compared_are_refused() -> None:
    d, rng = hard(1, 6)
    levels, noise = levels_at(d, 0, rng, 1.0), Noise(d.sigma_dq[0], 0.0, 0.0, 2048)
    with pytest.raises(IdentificationError, match="are the same") as caught:
        split_by_frequency(levels, levels, noise)
    assert caught.value.reason == "E_EXCITATION"
    few = levels_at(d, 0, rng, 0.5, least=0.85)
    with pytest.raises(IdentificationError, match="share 4 levels"):
        split_by_frequency(levels, few, noise)
