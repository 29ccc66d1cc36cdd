# SPDX-License-Identifier: MIT
"""Band, verdict and cause on responses that are made up, so that what must come out is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.design.prediction import LEAST_FACTOR, Direction, Prediction, predict
from pmsmtool.errors import ConfigError
from pmsmtool.npz_file import npz_bytes
from pmsmtool.proof.judgement import (
    OSCILLATES,
    SHAKES,
    SPEED_STEP,
    from_arrays,
    judge,
    patterns,
    to_arrays,
    with_ripple,
)
from pmsmtool.trace import Trace

ROWS = 120
KEY = ("step", "i_q_a")
T_S = np.arange(ROWS) * 1e-4


def responses(count: int, seed: int, *, gain: float = 1.0, delay: int = 0) -> np.ndarray:  # type: ignore[type-arg]
    """First-order steps whose gain and time constant vary by 3 %, with noise, shape (count, ROWS)."""
    rng = np.random.default_rng(seed)
    tau = 12.0 * (1.0 + 0.03 * rng.standard_normal((count, 1))) / gain
    final = 1.0 + 0.01 * rng.standard_normal((count, 1))
    k = np.maximum(np.arange(ROWS)[None, :] - delay, 0)
    return final * (1.0 - np.exp(-k / tau)) + 0.005 * rng.standard_normal((count, ROWS))


def prediction(seed: int = 0, runs: int = 96) -> Prediction:
    few = {KEY: responses(6, seed)}
    fast, slow = {KEY: responses(6, seed, gain=1.25)}, {KEY: responses(6, seed, gain=0.8)}
    late = {KEY: responses(6, seed, delay=3)}
    return predict(
        {"step": T_S},
        {KEY: responses(runs, seed)},
        {KEY: 1.0},
        directions={
            "gain": Direction(1.0, "1", fast, slow, 1.25, 0.8),
            "delay": Direction(0.0, "1", late, few, 3.0, 0.0),
        },
        faults={"fast": ("too much gain", fast), "slow": ("too little gain", slow), "late": ("a delay", late)},
        facts={"seed": seed},
    )


def shares(found: Prediction, runs: np.ndarray) -> list[float]:  # type: ignore[type-arg]
    return [max(line.share for line in judge(found, {KEY: run}).seen) for run in runs]


@pytest.mark.chain
def test_the_band_holds_at_least_what_it_says_of_fresh_responses() -> None:
    """Over 20 predictions, 200 fresh responses each: at least 95 % inside (measured: 99.9 %)."""
    inside = [share <= 1.0 for seed in range(20) for share in shares(prediction(seed), responses(200, 1000 + seed))]
    assert np.mean(inside) >= 0.95


def test_the_band_is_no_wider_than_it_must_be() -> None:
    """A gain 20 % off, and three rows of delay, are caught every time."""
    found = prediction()
    for wrong in ({"gain": 1.25}, {"gain": 0.8}, {"delay": 3}):
        assert min(shares(found, responses(50, 77, **wrong))) > 1.0, wrong  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("wrong", "cause"),
    [({"gain": 1.3}, "too much gain"), ({"gain": 0.75}, "too little gain"), ({"delay": 3}, "a delay")],
)
def test_the_cause_is_the_nearest_signature(wrong: dict[str, float], cause: str) -> None:
    found = prediction()
    named = [judge(found, {KEY: run}).cause for run in responses(20, 5, **wrong)]  # type: ignore[arg-type]
    assert named.count(cause) >= 18


def test_a_fault_that_shows_elsewhere_is_not_the_cause_where_nothing_shows() -> None:
    """A shaft that reached its speed was said to have wrong pole pairs, for its current steps were off."""
    speed, noise = ("run", "omega_e_rad_s"), 0.01 * np.random.default_rng(3).standard_normal((97, ROWS))
    fast = {KEY: responses(6, 0, gain=1.25), speed: noise[:6] + 10.0}
    healthy = {KEY: responses(96, 0), speed: noise[1:]}
    found = predict({"step": T_S, "run": T_S}, healthy, {KEY: 1.0, speed: 1.0}, faults={"fast": ("too much", fast)})
    step = responses(1, 5, gain=1.25)[0]
    for reached, cause in ((10.0, "too much"), (0.0, "")):
        assert judge(found, {KEY: step, speed: noise[0] + reached}).cause == cause


def test_what_looks_like_no_fault_has_no_cause() -> None:
    odd = responses(1, 9)[0]
    odd[60:] *= -1.0
    judgement = judge(prediction(), {KEY: odd})
    assert not judgement.inside and judgement.cause == ""


def test_what_lies_between_two_faults_is_blamed_on_neither() -> None:
    one = {KEY: responses(6, 0, gain=1.25)}
    found = predict({"step": T_S}, {KEY: responses(96, 0)}, {KEY: 1.0}, faults={
        "a": ("too much gain", one), "b": ("its twin", {KEY: responses(6, 1, gain=1.27)})})  # fmt: skip
    alone = predict({"step": T_S}, {KEY: responses(96, 0)}, {KEY: 1.0}, faults={"a": ("too much gain", one)})
    wrong = {KEY: responses(1, 5, gain=1.3)[0]}
    assert judge(alone, wrong).cause == "too much gain"
    assert judge(found, wrong).cause == ""


def test_quantities_measure_what_they_say() -> None:
    found = prediction()
    gain, delay = found.quantities["gain"], found.quantities["delay"]
    assert gain.low < 1.0 < gain.high and delay.low < 0.0 < delay.high
    mean = found.bands[KEY].mean
    high = np.mean(responses(400, 3, gain=1.25), axis=0) - mean
    assert gain.of({KEY: high}) == pytest.approx(1.25, abs=0.06)
    assert delay.of({KEY: np.mean(responses(400, 3, delay=3), axis=0) - mean}) == pytest.approx(3.0, abs=0.2)


@pytest.mark.parametrize(("sign", "cause"), [(1.0, "too much"), (-1.0, "too little")])
def test_a_quantity_that_is_outside_alone_names_the_cause(sign: float, cause: str) -> None:
    """Every response is inside its band, what they tell together is not; no fault has a signature here."""
    fast, slow = {KEY: responses(6, 0, gain=1.25)}, {KEY: responses(6, 0, gain=0.8)}
    direction = Direction(1.0, "1", fast, slow, 1.25, 0.8, "too little", "too much")
    found = predict({"step": T_S}, {KEY: responses(96, 0)}, {KEY: 1.0}, directions={"gain": direction})
    change = np.mean(fast[KEY] - slow[KEY], axis=0) / 0.45
    narrow = replace(found, quantities={"gain": replace(found.quantities["gain"], low=0.98, high=1.02)})
    judgement = judge(from_arrays(to_arrays(narrow)), {KEY: found.bands[KEY].mean + sign * 0.04 * change})
    assert [line.what for line in judgement.seen if not line.inside] == ["gain"]
    assert judgement.cause == cause


def test_a_number_that_is_none_is_outside() -> None:
    broken = responses(1, 4)[0]
    broken[10] = math.nan
    assert judge(prediction(), {KEY: broken}).seen[0].share == math.inf


def test_a_signal_that_nothing_moves_keeps_its_floor() -> None:
    runs = np.ones((32, ROWS)) + 1e-9 * np.random.default_rng(0).standard_normal((32, ROWS))
    found = predict({"step": T_S}, {KEY: runs}, {KEY: 1.0})
    band = found.bands[KEY]
    assert band.factor >= LEAST_FACTOR and float(np.min(band.high - band.low)) > 0.01


def test_a_response_in_which_no_run_differs_from_another_is_predicted() -> None:
    """A locked machine: the speed is exactly zero in all runs, and the decoupling changes nothing."""
    still = ("step", "omega_e_rad_s")
    runs = {KEY: responses(32, 0), still: np.zeros((32, ROWS))}
    same = {key: values[:6] for key, values in runs.items()}
    nothing = Direction(1.0, "1", same, same, 1.0, -1.0)
    found = predict({"step": T_S}, runs, {KEY: 1.0, still: 1.0}, directions={"decoupling": nothing})
    alone = predict({"step": T_S}, {KEY: runs[KEY]}, {KEY: 1.0})
    assert found.bands[KEY].factor == alone.bands[KEY].factor
    assert found.quantities == {}, "what shows in nothing is not judged"
    assert judge(found, {key: values[0] for key, values in runs.items()}).inside
    assert not judge(found, {KEY: runs[KEY][0], still: np.ones(ROWS)}).inside


def steady(found: Prediction) -> Prediction:
    return replace(found, facts={**found.facts, "steady_rows": {"step": 40}})


def recorded(values: np.ndarray, omega_e: float = 0.0) -> dict[str, Trace]:  # type: ignore[type-arg]
    signals = {"i_q_a": values, "omega_e_rad_s": np.full(values.size, omega_e)}
    return {"step": Trace(1e-4 * np.arange(values.size), signals, {"i_q_a": "A", "omega_e_rad_s": "rad/s"})}


def half(found: Prediction) -> float:
    return float(np.median(found.bands[KEY].half))


def test_a_machine_that_shakes_passes_and_one_that_shakes_too_much_does_not() -> None:
    found = steady(prediction())
    band, angle = found.bands[KEY], np.arange(ROWS) * 2.0
    for size, passes in ((0.8, True), (3.0, False)):
        shaken = band.mean + 0.5 * half(found) + size * half(found) * np.sin(angle)
        assert not judge(found, {KEY: shaken}).seen[0].inside
        wider = with_ripple(found, recorded(shaken))
        assert judge(wider, {KEY: shaken}).seen[0].inside == passes
        assert "ripple" in judge(wider, {KEY: shaken}).seen[0].where
        assert passes or judge(wider, {KEY: shaken}).cause == SHAKES
        assert half(wider) <= 2.0 * half(found) * 1.001


@pytest.mark.parametrize(("size", "named"), [(0.4, False), (0.8, True)])
def test_a_current_that_swings_between_both_signs_is_an_oscillation(size: float, named: bool) -> None:
    """A wrong sign of the decoupling was named where a speed loop swung the torque from limit to limit."""
    found = prediction()
    found = replace(found, bands={SPEED_STEP: found.bands[KEY]}, t_s={"speed_step": T_S}, quantities={}, faults={})
    swinging = found.bands[SPEED_STEP].mean * (T_S > 60e-4) + size * np.cos(3e3 * T_S) * (T_S <= 60e-4)
    judged = judge(found, {SPEED_STEP: swinging})
    assert not judged.inside and (judged.cause == OSCILLATES) == named


def test_what_is_off_or_still_on_its_way_is_no_ripple() -> None:
    found = steady(prediction())
    for off in (1.5 * half(found), 3.0 * half(found) * (1.0 - T_S / T_S[-1])):
        response = found.bands[KEY].mean + off
        wider = with_ripple(found, recorded(response))
        assert half(wider) == pytest.approx(half(found), rel=1e-6) and not judge(wider, {KEY: response}).inside


def test_of_a_repeated_pattern_the_ripple_is_what_its_average_holds() -> None:
    found = prediction()
    rng = np.random.default_rng(0)
    shaken = np.tile(found.bands[KEY].mean, 8) + 0.01 * rng.standard_normal(8 * ROWS)
    wider = with_ripple(found, recorded(shaken))
    assert wider.bands[KEY].ripple == pytest.approx(3.0 * 0.01 / math.sqrt(8.0), rel=0.1)
    assert np.max(np.abs(shaken.reshape(8, -1).mean(axis=0) - found.bands[KEY].mean)) < 1.3 * wider.bands[KEY].ripple


@pytest.mark.parametrize("order", [1, 2, 6, 12])
def test_what_turns_with_the_rotor_is_in_no_repeated_pattern(order: int) -> None:
    found, turns = prediction(), 1.0 + 0.9 / order
    omega_e = 2.0 * math.pi * turns / (ROWS * 1e-4)
    angle = omega_e * 1e-4 * np.arange(1, 8 * ROWS + 1)
    for gain, inside in ((1.0, True), (1.25, False)):
        response = np.mean(responses(400, 3, gain=gain), axis=0)
        alone = judge(found, {KEY: response}).seen[0].share
        shaken = np.tile(response, 8) + 6.0 * half(found) * np.cos(order * angle + 1.0)
        assert not judge(found, {KEY: shaken.reshape(8, -1).mean(axis=0)}).inside
        record = recorded(shaken, omega_e)
        measured = {KEY: patterns(record["step"], "i_q_a", ROWS).mean(axis=0)}
        wider = with_ripple(found, record)
        assert wider.bands[KEY].ripple < 1e-6 * half(found)
        assert judge(wider, measured).inside == inside
        assert judge(wider, measured).seen[0].share == pytest.approx(alone, rel=1e-6)


@pytest.mark.parametrize(("repeats", "omega_e"), [(8, 0.0), (8, 2e-3), (1, 500.0), (8, math.nan)])
def test_patterns_at_equal_angles_stay_as_they_are(repeats: int, omega_e: float) -> None:
    values = np.random.default_rng(0).standard_normal((repeats, ROWS))
    assert np.array_equal(patterns(recorded(values.ravel(), omega_e)["step"], "i_q_a", ROWS), values)


def test_another_length_is_refused() -> None:
    with pytest.raises(ConfigError, match="120 were predicted"):
        judge(prediction(), {KEY: np.zeros(119)})


def test_the_committed_file_judges_as_the_prediction_does() -> None:
    found = prediction()
    arrays = to_arrays(found)
    assert npz_bytes(arrays) == npz_bytes(to_arrays(prediction())), "same input, same bytes"
    again = from_arrays(arrays)
    assert again.facts == found.facts
    run = responses(1, 6, gain=1.3)[0]
    first, second = judge(found, {KEY: run}), judge(again, {KEY: run})
    assert first.cause == second.cause == "too much gain"
    assert {line.what: line.share for line in first.seen} == {line.what: line.share for line in second.seen}


@pytest.mark.parametrize("lost", ["_meta", "std|step|i_q_a"])
def test_a_damaged_file_is_named(lost: str) -> None:
    arrays = to_arrays(prediction())
    del arrays[lost]
    with pytest.raises(ConfigError, match=r"proof\.npz"):
        from_arrays(arrays, where="proof.npz")
