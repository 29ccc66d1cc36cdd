# SPDX-License-Identifier: MIT
"""Pole pairs, direction, coarse offset; the three-vector phase check; noise; the table of refusals."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.errors import ExitCode, IdentificationError
from pmsmtool.estimators.current_sensors import Noise, SensorMismatch, estimate_noise, widened, without_mismatch
from pmsmtool.estimators.encoder import (
    JUMP_LIMIT_RAD,
    EncoderResult,
    check_encoder_counts,
    estimate_by_rests,
    estimate_encoder,
)
from pmsmtool.estimators.estimate import SensorTolerance, Verdict
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.resistance import ResistanceResult
from pmsmtool.identification.phase_check import (
    BALANCE_LIMIT,
    SMALL_LIMIT,
    USUAL_BEYOND,
    PairCheck,
    at_one_temperature,
    check_pairs,
    check_phases,
    over_phases,
)
from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import REFUSALS, refuse
from pmsmtool.trace import Trace


def trace(meta: dict[str, object] | None = None, **signals: np.ndarray) -> Trace:
    n = len(next(iter(signals.values())))
    return Trace(np.arange(n, dtype=np.float64), signals, dict.fromkeys(signals, "1"), meta or {})


def rotation(
    pole_pairs: float, direction: int, offset: float, *, lag: float = 0.0, ripple: float = 0.0, turns: float = 1.02
) -> tuple[Trace, Trace]:
    """Both runs of a rotor that lags the vector and cogs six times per turn (rad electrical)."""
    imposed = np.linspace(0.0, 2.0 * math.pi * pole_pairs * turns, 400)
    runs = []
    for sign, angle in ((1.0, imposed), (-1.0, imposed[::-1])):
        theta_e = angle - sign * lag + ripple * np.sin(6.0 * angle / pole_pairs)
        runs.append(trace(theta_imposed_rad=angle, theta_M_rad=direction * (theta_e + offset) / pole_pairs))
    return runs[0], runs[1]


@pytest.mark.parametrize("pole_pairs", [1, 2, 5, 10, 21])
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("offset", [-3.0, -0.4, 0.0, 1.7])
def test_pole_pairs_direction_and_offset(pole_pairs: int, direction: int, offset: float) -> None:
    result: EncoderResult = estimate_encoder(*rotation(pole_pairs, direction, offset, lag=0.12, ripple=0.05))
    assert result.pole_pairs.value == pole_pairs
    assert result.direction == direction
    assert math.remainder(result.offset.value - offset, 2.0 * math.pi) == pytest.approx(0.0, abs=2e-3)
    assert abs(result.lag_rad) == pytest.approx(0.12, abs=2e-3)  # friction cancels in the offset and is reported


def test_a_heavy_rotor_that_swings_behind_the_vector_keeps_its_pole_pairs() -> None:
    """It swung by 1.5 rad about its vector: 3.90 pole pairs of 4, refused at 0.1, and with it all but R."""
    swing = 1.5 * np.sin(2.0 * math.pi * 3.5 * np.arange(400) / 400.0)
    runs = [replace(run, signals={**run.signals, "theta_M_rad": run["theta_M_rad"] + swing / 4.0})
            for run in rotation(4, 1, 0.3)]  # fmt: skip
    found = estimate_encoder(*runs, JUMP_LIMIT_RAD)
    assert found.pole_pairs.value == 4 and found.pole_pairs.std < 0.09  # 0.024 measured; 0.15 the other way round


def test_a_gear_or_a_wrong_encoder_resolution_gives_no_integer() -> None:
    with pytest.raises(IdentificationError) as caught:
        estimate_encoder(*rotation(3.4, 1, 0.2))
    assert caught.value.reason == "E_POLE_PAIRS"


def test_a_rotor_that_follows_only_one_way_is_refused() -> None:
    forward, backward = rotation(4, 1, 0.0)
    mirrored = trace(theta_imposed_rad=backward["theta_imposed_rad"], theta_M_rad=-backward["theta_M_rad"])
    with pytest.raises(IdentificationError, match="E_POLE_PAIRS"):
        estimate_encoder(forward, mirrored)


def test_a_locked_shaft_is_refused() -> None:
    angle = np.linspace(0.0, 25.0, 400)
    still = trace(theta_imposed_rad=angle, theta_M_rad=np.zeros(400))
    with pytest.raises(IdentificationError, match="E_POLE_PAIRS"):
        estimate_encoder(still, still)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("swing", [0.0, 0.02])
def test_an_encoder_off_centre_is_seen_per_turn_and_a_swinging_rotor_is_not(direction: int, swing: float) -> None:
    """A rotor that swings does so otherwise on the way back."""
    once, twice = 0.01, 0.006
    runs = []
    for sign, run in zip((1.0, -1.0), rotation(4, direction, 0.3, lag=0.1, ripple=0.05), strict=True):
        theta = run["theta_M_rad"]
        off = once * np.sin(theta) + twice * np.cos(2.0 * theta) + sign * swing * np.sin(theta)
        runs.append(trace(theta_imposed_rad=run["theta_imposed_rad"], theta_M_rad=theta + off))
    found = estimate_encoder(*runs)
    assert found.pole_pairs.value == 4.0 and found.direction == direction
    expected = (0.0 if swing else once, twice)
    assert found.per_turn_rad == pytest.approx(expected, rel=0.1)


def test_cogging_and_friction_are_no_error_of_the_encoder() -> None:
    assert estimate_encoder(*rotation(3, 1, 0.3, lag=0.2, ripple=0.1)).per_turn_rad == (0.0, 0.0)


def test_half_a_turn_is_not_enough() -> None:
    with pytest.raises(IdentificationError, match="E_EXCITATION"):
        estimate_encoder(*rotation(4, 1, 0.0, turns=0.5))


def test_a_cogging_rotor_that_leaves_the_vector_is_refused() -> None:
    with pytest.raises(IdentificationError, match="E_ROTOR_MOVED"):
        estimate_encoder(*rotation(4, 1, 0.0, ripple=math.radians(40.0)))


def test_a_rotor_that_jumps_is_taken_where_nothing_better_is_had() -> None:
    """Between positions a sixth of a turn apart: the mean of both directions is right, and its deviation large."""
    found = estimate_encoder(*rotation(4, 1, 0.3, lag=0.3, ripple=math.radians(60.0)), JUMP_LIMIT_RAD)
    assert found.offset.value == pytest.approx(0.3, abs=0.05) and found.offset.std > math.radians(20.0)
    with pytest.raises(IdentificationError, match="E_ROTOR_MOVED"):
        estimate_encoder(*rotation(4, 1, 0.0, ripple=math.radians(100.0)), math.radians(90.0))


def vectors(i: float = 0.5, R: float = 1.0, phases: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Trace:
    """Three vectors of a drive whose phase currents and resistances are scaled per phase."""
    angles = np.radians([0.0, 120.0, 240.0])
    rows = [[i * math.cos(a - shift) * f for shift, f in zip(angles, phases, strict=True)] for a in angles]
    abc = np.array(rows)
    along = np.array([i * phases[k] for k in range(3)])
    return trace(
        i_a_a=abc[:, 0],
        i_b_a=abc[:, 1],
        i_c_a=abc[:, 2],
        i_d_a=along,
        i_q_a=np.zeros(3),
        u_d_v=R * np.full(3, i),
    )


NOISE = Noise(0.005, 0.0, 0.0)


def test_a_healthy_motor_passes() -> None:
    result = check_phases(vectors(phases=(1.0, 0.98, 1.01)), NOISE)
    assert result.currents_a == pytest.approx((0.5, 0.49, 0.505))


@pytest.mark.parametrize(
    ("phases", "reason"),
    [
        ((0.0, 0.0, 0.0), "E_NOT_CONNECTED"),
        ((0.0, 1.0, 1.0), "E_PHASE_OPEN"),
        ((1.0, 0.0, 1.0), "E_PHASE_OPEN"),
        ((1.0, 1.0, 0.1), "E_PHASE_OPEN"),
        ((1.0, 0.85, 1.0), "E_UNBALANCED"),
    ],
)
def test_a_bad_motor_is_named(phases: tuple[float, float, float], reason: str) -> None:
    with pytest.raises(IdentificationError) as caught:
        check_phases(vectors(phases=phases), NOISE)
    assert caught.value.reason == reason


def test_an_unequal_motor_is_told_by_how_much() -> None:
    with pytest.raises(IdentificationError) as caught:
        check_phases(vectors(phases=(1.0, 0.85, 1.0)), NOISE)
    numbers = [float(x) for x in re.findall(r"([0-9.e+-]+) %", caught.value.what)]
    i = (1.0, 0.85, 1.0)  # the spread is of the mean
    assert numbers[0] == pytest.approx(100.0 * 0.15 / np.mean(i), rel=0.05)
    assert numbers[2] == 100.0 * BALANCE_LIMIT and numbers[4] == 100.0 * SMALL_LIMIT
    assert numbers[3] == pytest.approx(100.0 * (1.0 / 0.85 - 1.0) / np.mean(np.divide(1.0, i)), rel=0.05)


def test_an_encoder_that_does_not_count_is_named_and_a_slow_one_is_not() -> None:
    imposed = np.array([0.0, math.radians(150.0)])
    check_encoder_counts(trace(theta_imposed_rad=imposed, theta_M_rad=-imposed / 32.0))
    with pytest.raises(IdentificationError) as caught:
        check_encoder_counts(trace(theta_imposed_rad=imposed, theta_M_rad=np.array([1.0, 1.0001])))
    assert caught.value.reason == "E_ENCODER"


def test_a_motor_without_current_and_a_drive_without_signal_are_told_apart() -> None:
    small = vectors(phases=(0.02, 0.02, 0.02))
    small.meta["i_command_a"] = 0.5
    with pytest.raises(IdentificationError, match="E_NOT_CONNECTED"):
        check_phases(small, NOISE)
    with pytest.raises(IdentificationError, match="E_SNR"):
        check_phases(small, Noise(1.0, 0.0, 0.0))
    with pytest.raises(IdentificationError, match="E_CURRENT_SENSOR"):
        check_phases(vectors_of(0.5), Noise(0.005, 0.2, 0.0))


def vectors_of(command: float) -> Trace:
    healthy = vectors()
    healthy.meta["i_command_a"] = command
    return healthy


def pairs(R: tuple[float, float, float], gains: tuple[float, float, float] = (1.0, 1.0, 1.0), moved: int = 0) -> Trace:
    """Two currents through each pair of phases of resistances R, read by sensors of different gains."""
    rows = []
    for k in range(3):
        angle = math.pi / 2.0 + 2.0 * math.pi / 3.0 * k
        for i in (1.0, 2.0):
            phase = [i * math.cos(angle - 2.0 * math.pi / 3.0 * x) for x in range(3)]
            drops = [r * c for r, c in zip(R, phase, strict=True)]
            along = 2.0 / 3.0 * sum(u * math.cos(angle - 2.0 * math.pi / 3.0 * x) for x, u in enumerate(drops))
            dead = 5.0 * 2.0 / math.sqrt(3.0)  # a curve of 5 V on every phase, along a vector with one phase idle
            rows.append((*(g * c for g, c in zip(gains, phase, strict=True)), along + dead, i, float(moved)))
    names = ("i_a_a", "i_b_a", "i_c_a", "u_d_v", "i_d_a", "moved")
    return trace(**{name: np.array(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)})


STEP = InverterCurve(np.array([1e-3, 10.0]), np.array([5.0, 5.0]), 0.0)


def test_pairs_are_told_by_what_is_idle_in_whatever_order_they_were_held() -> None:
    """A quick run holds a, c and b; with a tolerance of its sensors' gains, too."""
    plain = pairs((2.06, 1.98, 1.96), gains=(1.0, 1.01, 1.0))
    order = [0, 1, 4, 5, 2, 3]
    held = replace(plain, signals={name: values[order] for name, values in plain.signals.items()})
    held = replace(held, meta={**plain.meta, "idle": list("aaccbb")})
    found, expected = (check_pairs(one, NOISE, STEP) for one in (held, plain))
    assert found.resistance_ohm == pytest.approx(expected.resistance_ohm)
    assert found.mismatch.gains == pytest.approx(expected.mismatch.gains)


def test_equal_pairs_show_their_resistance_whatever_the_dead_time() -> None:
    result = check_pairs(pairs((2.0, 2.0, 2.0)), NOISE, STEP)
    assert result.resistance_ohm == pytest.approx((2.0, 2.0, 2.0))
    assert result.mismatch.spread == pytest.approx(0.0, abs=1e-12)
    assert result.judged


def test_unequal_phases_give_the_mean_of_them() -> None:
    """Levels are held with phase a idle: they show the mean of b and c."""
    found = check_pairs(pairs((2.06, 1.98, 1.96)), NOISE, STEP)
    R = Estimate(1.97, 1e-3, 0.01, "ohm", T_c=20.0)
    levels = ResistanceResult(R, R, STEP, 5.0, 0.0, Verdict.PASS)
    mean = over_phases(levels, found, SensorTolerance())
    assert mean.R_measured.value == pytest.approx(2.0) and mean.R_s.value == pytest.approx(2.0)
    assert mean.R_s.systematic >= 0.03  # what a pair of phases is off the mean
    assert "a 2.06, b 1.98, c 1.96" in mean.R_s.fallback
    alike = over_phases(levels, check_pairs(pairs((2.001, 2.0, 2.0)), NOISE, STEP), SensorTolerance())
    assert alike.R_measured == replace(R, systematic=pytest.approx(0.01, rel=1e-2)) and not alike.R_s.fallback


def test_a_winding_that_cools_from_pair_to_pair_has_no_unequal_phases() -> None:
    """Real drive 216860: the levels warmed it by 15 K, its pairs cooled by 7 K, and R was 1.8 % too low."""
    R = Estimate(2.0, 1e-3, 0.01, "ohm", T_c=20.0)
    levels = ResistanceResult(R, R, STEP, 5.0, 0.0, Verdict.PASS)
    T_c, shown = np.array([24.2, 23.8, 20.0, 19.8, 16.2, 16.0]), pairs((2.0, 2.0, 2.0))
    warm = 2.0 * levels.copper.alpha_per_k * (T_c - 20.0) * shown["i_d_a"]
    signals = {**shown.signals, "u_d_v": shown["u_d_v"] + warm}
    assert any(check_pairs(trace(**signals), NOISE, STEP).beyond_mean_ohm)
    sensed = at_one_temperature(trace(**signals, T_winding_c=T_c), levels)
    assert check_pairs(sensed, NOISE, STEP).resistance_ohm == pytest.approx([2.0] * 3, rel=1e-9)
    unknown = trace(**signals, T_winding_c=np.full(6, math.nan))
    assert at_one_temperature(unknown, levels) is unknown and at_one_temperature(shown, levels) is shown


def test_a_difference_of_phases_that_is_not_sure_is_in_the_interval_of_r() -> None:
    """Real drive 217486: 0.8 % of R at 3.5 standard deviations, and R was 1.0 % off."""
    R = Estimate(1.98, 1e-3, 0.01, "ohm", T_c=20.0)
    levels = ResistanceResult(R, R, STEP, 5.0, 0.0, Verdict.PASS)
    unsure = PairCheck((1.98, 2.01, 2.01), SensorMismatch((0.0, 0.0, 0.0), 1e-3), std_ohm=0.006)
    found = over_phases(levels, unsure, SensorTolerance())
    assert found.R_measured.value == R.value
    assert found.R_measured.systematic == pytest.approx(math.hypot(0.01, 0.02))
    assert found.R_s.systematic >= found.R_measured.systematic
    far = over_phases(levels, replace(unsure, resistance_ohm=(1.5, 2.25, 2.25), std_ohm=0.5), SensorTolerance())
    assert far.R_measured.systematic == pytest.approx(math.hypot(0.01, USUAL_BEYOND * 1.98))
    moved = over_phases(levels, replace(unsure, judged=False), SensorTolerance())
    assert moved.R_measured.systematic == pytest.approx(0.01)


def test_what_the_noise_of_a_mean_voltage_makes_is_no_unequal_phase() -> None:
    """Random drive 520004: 4.6 standard deviations of the currents' noise alone, and its phases are alike."""
    noise = Noise(0.01, 0.0, 0.0)
    alone = 2.0 * noise.sigma_a * math.sqrt(2.0 / 512.0)  # of a slope of 2 ohm, between 1 and 2 A

    def off(times: float) -> tuple[float, float, float]:
        beyond = times * alone
        return check_pairs(pairs((2.0 + 2.0 * beyond, 2.0 - beyond, 2.0 - beyond)), noise, STEP).beyond_mean_ohm

    assert off(4.6) == (0.0, 0.0, 0.0)
    assert max(map(abs, off(6.5))) == pytest.approx(6.5 * alone, rel=0.05)


def test_what_the_ripple_of_a_link_leaves_in_a_window_is_no_unequal_phase() -> None:
    """Real drive 216572: a slope 1.8 % off by a ripple of 3.6 %, and R with it 1.1 % off at +-1.9 %."""
    shown, off_v = pairs((2.0, 2.0, 2.0)), 0.036
    u = shown["u_d_v"] + off_v * np.array([0.0, 1.0, 0.0, -1.0, 0.0, 0.0])
    unlike = trace(**{**shown.signals, "u_d_v": u})
    halves = {"u_d_change_v": 2.0 * off_v * np.array([1.0, -1.0, 0.3, 0.8, -0.6, 1.0]), "i_d_change_a": np.zeros(6)}
    assert any(check_pairs(unlike, NOISE, STEP).beyond_mean_ohm)
    rippled = check_pairs(trace(**{**unlike.signals, **halves}), NOISE, STEP)
    assert not any(rippled.beyond_mean_ohm) and rippled.std_ohm > 0.5 * off_v


def test_what_offsets_of_sensors_make_in_the_knee_of_the_inverter_is_no_unbalanced_phase() -> None:
    """A stranger's bridge of 560 V on 0.4 A: equal phases differed by 9 ohm of 8, of 60 that the knee takes."""
    knee = InverterCurve(np.array([1.5, 10.0]), np.array([15.0, 18.0]), 0.0)  # the pairs hold 0.87 and 1.7 A a phase
    shown = pairs((2.0, 2.0, 2.0))
    seen = (
        2.0 / math.sqrt(3.0) * knee.error_v(math.sqrt(3.0) / 2.0 * (shown["i_d_a"] + 0.05 * np.repeat([1, 0, -1], 2)))
    )
    shown = trace(**{**shown.signals, "u_d_v": 2.0 * shown["i_d_a"] + seen})
    with pytest.raises(IdentificationError, match="E_UNBALANCED"):
        check_pairs(shown, NOISE, knee)
    found = check_pairs(shown, Noise(0.005, 0.03, -0.04), knee)
    assert np.mean(found.resistance_ohm) == pytest.approx(2.0) and not any(found.beyond_mean_ohm)
    with pytest.raises(IdentificationError, match="E_UNBALANCED"):  # beyond the knee an offset takes nothing
        check_pairs(pairs((3.0, 2.0, 2.0)), Noise(0.005, 0.03, -0.04), STEP)


@pytest.mark.parametrize(
    ("found", "reason"),
    [
        (pairs((3.0, 2.0, 2.0)), "E_UNBALANCED"),
        (pairs((2.0, 2.0, 1.5)), "E_UNBALANCED"),
        (pairs((2.0, 2.0, 2.0), gains=(1.0, 0.94, 1.0)), "E_CURRENT_SENSOR"),
        (pairs((3.0, 2.0, 2.0), gains=(1.15, 1.0, 1.0)), "E_CURRENT_SENSOR"),
    ],
)
def test_unequal_pairs_and_unequal_sensors_are_told_apart(found: Trace, reason: str) -> None:
    with pytest.raises(IdentificationError) as caught:
        check_pairs(found, NOISE, STEP)
    assert caught.value.reason == reason


def test_sensors_at_the_limit_are_corrected() -> None:
    """What is corrected is known to a twentieth of it: 5.2 % read may be 4.7."""
    assert check_pairs(pairs((2.0, 2.0, 2.0), gains=(1.0, 0.95, 1.0)), NOISE, STEP).mismatch.corrected


def test_unequal_sensors_are_named_with_their_gains() -> None:
    named = r"differ by 6\.2 % \(a \+2\.1 %, b -4\.2 %, c \+2\.1 % of their mean\), limit 5 %"
    with pytest.raises(IdentificationError, match=named):
        check_pairs(pairs((2.0, 2.0, 2.0), gains=(1.0, 0.94, 1.0)), NOISE, STEP)


def test_sensors_that_differ_a_little_are_measured_and_corrected() -> None:
    gains = (1.014, 0.99, 0.996)
    found = check_pairs(pairs((2.0, 2.0, 2.0), gains=gains), NOISE, STEP).mismatch
    assert found.corrected and found.gains == pytest.approx([gain - 1.0 for gain in gains], abs=2e-4)
    for angle in (0.3, math.pi / 2.0):  # a vector of (3, 0.2) A as the sensors show it along that angle
        phases = np.array([3.0 * math.cos(angle - k) - 0.2 * math.sin(angle - k) for k in LEGS]) * gains
        d = 2.0 / 3.0 * sum(i * math.cos(angle - k) for i, k in zip(phases, LEGS, strict=True))
        q = -2.0 / 3.0 * sum(i * math.sin(angle - k) for i, k in zip(phases, LEGS, strict=True))
        shown = trace(i_d_a=np.array([d]), i_q_a=np.array([q]))
        true = without_mismatch(shown, found, angle)
        assert abs(d - 3.0) > 5e-3
        assert (true["i_d_a"][0], true["i_q_a"][0]) == pytest.approx((3.0, 0.2), abs=1e-3)


def test_resistances_of_pairs_are_those_of_the_true_currents() -> None:
    """Along a vector with phase a idle the sensors of b and c show the current: half of a's gain less, beyond it."""
    gains = (1.014, 0.99, 0.996)
    shown = pairs((2.0, 2.0, 2.0), gains=gains)
    along = shown["i_d_a"] * (1.0 - 0.5 * np.repeat(np.array(gains) - 1.0, 2))
    found = check_pairs(trace(**{**shown.signals, "i_d_a": along}), NOISE, STEP)
    assert found.resistance_ohm == pytest.approx((2.0, 2.0, 2.0), rel=3e-4)  # 1.4 % apart as shown
    assert max(found.resistance_ohm) - min(found.resistance_ohm) < 1e-3


@pytest.mark.parametrize(
    ("gains", "std", "corrected"),
    [
        ((0.0019, -0.0019, 0.0), 1e-5, False),
        ((0.0021, -0.0012, -0.0009), 1e-5, True),
        ((0.0012, -0.0021, 0.0009), 5e-4, True),
        ((0.0012, -0.0021, 0.0009), 5.5e-4, False),  # not by four standard deviations
    ],
)
def test_a_mismatch_is_corrected_where_it_is_large_and_sure(
    gains: tuple[float, float, float], std: float, corrected: bool
) -> None:
    mismatch = SensorMismatch(gains, std)
    assert mismatch.corrected == corrected
    assert mismatch.spread == pytest.approx(max(gains) - min(gains))
    doubt = math.hypot(0.05 * mismatch.spread, std) if corrected else 0.0
    assert mismatch.doubt == pytest.approx(doubt)
    R = Estimate(-2.0, 1e-3, 0.01, "ohm")
    assert widened(R, None) is R
    assert widened(R, mismatch).std == pytest.approx(math.hypot(1e-3, 2.0 * doubt))


LEGS = tuple(2.0 * math.pi / 3.0 * k for k in range(3))


STEEP = InverterCurve(np.array([1e-3, math.sqrt(0.75), math.sqrt(3.0)]), np.array([4.0, 5.0, 8.0]), 0.0)
"""An error that still rises by 3.46 V along the vector between the two currents: 4 ohm of slope at 2 ohm of winding."""


def through_steep(R: tuple[float, float, float], legs: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Trace:
    """The pairs with the error of ``STEEP``; that of each pair is as much larger as its legs say."""
    found = pairs(R)
    i = found["i_d_a"]
    error = STEEP.error_v(math.sqrt(0.75) * i) * 2.0 / math.sqrt(3.0) * np.repeat(legs, 2)
    return trace(**{**found.signals, "u_d_v": found["u_d_v"] - 10.0 / math.sqrt(3.0) + error})


def test_legs_that_are_not_alike_are_no_unbalance_of_the_winding() -> None:
    legs = (1.035, 0.97, 1.0)  # 0.22 ohm of difference, 11 % of the winding
    check_pairs(through_steep((2.0, 2.0, 2.0), legs), NOISE, STEEP)
    with pytest.raises(IdentificationError, match="E_UNBALANCED"):
        check_pairs(through_steep((3.5, 2.0, 2.0), legs), NOISE, STEEP)
    with pytest.raises(IdentificationError, match="E_UNBALANCED"):
        check_pairs(through_steep((2.0, 2.0, 1.2), legs), NOISE, STEEP)


def test_pairs_under_a_moving_rotor_are_not_judged() -> None:
    assert not check_pairs(pairs((3.0, 2.0, 2.0), moved=1), NOISE, STEP).judged


def test_noise_is_found_and_a_slow_drift_is_not_noise() -> None:
    rng = np.random.default_rng(1)
    n = 4096
    drift = np.linspace(-0.1, 0.1, n)
    result = estimate_noise(
        trace(i_d_a=0.02 * rng.standard_normal(n) + drift, i_q_a=0.02 * rng.standard_normal(n) + 0.3)
    )
    assert result.sigma_a == pytest.approx(0.02, rel=0.03)
    assert result.offset_q_a == pytest.approx(0.3, abs=2e-3)


def test_a_quantiser_that_hides_the_noise_is_refused() -> None:
    with pytest.raises(IdentificationError, match="E_SNR"):
        estimate_noise(trace(i_d_a=np.full(1000, 0.1), i_q_a=np.zeros(1000)))


def test_too_few_samples_for_a_noise_are_refused() -> None:
    with pytest.raises(IdentificationError, match="E_EXCITATION"):
        estimate_noise(trace(i_d_a=np.arange(100.0), i_q_a=np.arange(100.0)))


@pytest.mark.parametrize("name", sorted(REFUSALS))
def test_every_refusal_says_what_to_do(name: str) -> None:
    error = refuse(name, "measured 3, limit 2", stage="somewhere")
    assert error.reason == name
    assert error.exit_code is ExitCode.NOT_TRUSTWORTHY
    assert error.likely and error.hint
    assert str(error).startswith(f"somewhere: {name}: measured 3, limit 2")


def rests(pole_pairs: int, direction: int, offset: float, holds: float) -> tuple[Trace, Trace]:
    """Rests on vectors led on by 600 degrees, the first reached backward; friction ``holds`` a share of the torque."""
    quarter, third = 0.5 * math.pi, 2.0 * math.pi / 3.0
    levels = [(quarter, 0.3, 1.0), (quarter, 1.0, 1.0), (3.0 * quarter, 1.0, -1.0), (3.0 * quarter, 0.3, -1.0)]
    levels += [(5.0 * quarter, 0.8, -1.0)]
    pairs = [(5.0 * quarter + k * third, 0.3, -1.0) for k in range(3)]
    found = []
    for rows in (levels, pairs):
        imposed, current, ahead = np.array(rows).T
        theta = direction * (imposed + ahead * np.arcsin(holds / current) + offset) / pole_pairs
        found.append(trace(theta_imposed_rad=imposed, theta_M_rad=theta, i_d_a=current, moved=0.0 * current))
    return found[0], found[1]


@pytest.mark.parametrize("pole_pairs", [1, 2, 5, 10])
@pytest.mark.parametrize("direction", [1, -1])
def test_rests_on_vectors_show_pole_pairs_direction_and_offset(pole_pairs: int, direction: int) -> None:
    found = estimate_by_rests(*rests(pole_pairs, direction, 1.7, 0.02))
    assert (found.pole_pairs.value, found.direction, found.per_turn) == (pole_pairs, direction, ())
    assert found.offset.value == pytest.approx(1.7, abs=2e-3)  # 0.001 measured: friction cancels but for the 0.8
    assert abs(found.lag_rad) == pytest.approx(0.02, abs=4e-3)


def test_rests_that_another_number_of_pole_pairs_explains_tell_none() -> None:
    """Friction of a tenth of the torque: 16 pole pairs off by 5 degrees each way, 15 or 17 by no more than 3 times."""
    with pytest.raises(IdentificationError, match="with 1[57]"):
        estimate_by_rests(*rests(16, 1, 0.3, 0.1))
    levels, pairs = rests(4, 1, 0.3, 0.02)
    with pytest.raises(IdentificationError, match="E_POLE_PAIRS"):
        estimate_by_rests(replace(levels, signals={**levels.signals, "moved": np.ones(5)}), pairs)
