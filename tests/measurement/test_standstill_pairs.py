# SPDX-License-Identifier: MIT
"""The windows of small vectors and of phase pairs, on drives whose current comes late or whose rotor swings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.arrays import Array
from pmsmtool.drive.port import Halves
from pmsmtool.experiments import standstill
from pmsmtool.experiments.standstill import (
    ARRIVAL_LIMIT_S,
    DC_ANGLE_RAD,
    INDUCED,
    NEAR_ANGLES_RAD,
    PAIR_ARRIVED,
    PHASE_ARRIVED,
    PHASE_HALF_S,
    SWINGING_TURN_S,
    LevelPlan,
    calm_sequence,
    falling_sequence,
    hold_levels,
    hold_pairs,
    hold_phase_vectors,
    pair_currents,
    steady_half,
)

I_A = 10.0
PAIR_A = (1.5, 3.0)
PERIOD_S = 1e-4


class LateDrive:
    """A current loop that undershoots: ``short`` of the set-point is missing in the first windows after a command."""

    period_s = PERIOD_S
    ripple = 0.0

    def __init__(self, short: float, windows: int) -> None:
        self.short, self.windows = short, windows
        self.wanted_a, self.seen, self.taken = 0.0, 0, 0

    def command_current(self, i_d_a: float, i_q_a: float, *, fixed_angle_rad: float | None = None) -> None:
        self.wanted_a, self.seen = i_d_a, 0

    def wait(self, seconds: float) -> None:
        pass

    def live(self, name: str) -> float:
        return 0.0

    def record(self, signals: Sequence[str], samples: int, *, decimation: int = 1) -> Mapping[str, Array]:
        t = np.arange(samples) * decimation * PERIOD_S
        return {"U_dc_v": 48.0 * (1.0 + self.ripple * np.sin(2.0 * math.pi * 100.0 * t))}

    def average(self, signals: Sequence[str], periods: int) -> Mapping[str, float]:
        off = self.short if self.seen < self.windows else 0.0
        return {name: (1.0 - off) * self.wanted_a if name == "i_d_a" else 0.0 for name in signals}

    def halves(self, signals: Sequence[str], periods: int) -> Halves:
        row = self.average(signals, periods)
        self.seen += 1
        self.taken += 1
        return Halves(row, row, periods)


@pytest.mark.parametrize("windows", [1, 3])
def test_a_window_waits_until_the_current_is_there(windows: int) -> None:
    drive = LateDrive(0.02, windows)
    rows = hold_pairs(drive, PAIR_A, 1.5, 0.0)  # type: ignore[arg-type]
    assert rows["i_d_a"] == pytest.approx([*PAIR_A] * 3, rel=PAIR_ARRIVED)
    assert drive.taken == 6 * (windows + 1)
    assert rows["T_winding_c"] == pytest.approx(np.zeros(6))  # as the drive shows it


def test_a_current_that_is_there_takes_one_window() -> None:
    drive = LateDrive(0.5 * PAIR_ARRIVED, 99)
    hold_pairs(drive, PAIR_A, 1.5, 0.0)  # type: ignore[arg-type]
    assert drive.taken == 6


def test_pairs_are_held_at_currents_of_levels() -> None:
    levels = (0.2, -0.2, 1.2, -1.2, 2.8, 3.5, 10.0, -10.0)
    assert pair_currents(levels, I_A) == (1.2, 2.8)
    assert pair_currents(levels, 5.0) == (0.2, 1.2)  # a supply that gave way allows less than the levels had
    assert pair_currents(levels, 1.0) == pytest.approx((0.15, 0.3))


class RippledDrive(LateDrive):
    """A voltage that swings by 3.6 % of the link's ripple at 100 Hz."""

    def __init__(self) -> None:
        super().__init__(0.0, 0)
        self.t = 0.0

    def halves(self, signals: Sequence[str], periods: int) -> Halves:
        parts = []
        for _ in range(2):
            self.t += 0.0113  # what a request takes: the windows begin anywhere
            t = self.t + np.arange(periods) * PERIOD_S
            self.t = float(t[-1]) + PERIOD_S
            u = self.wanted_a * (1.0 + 0.036 * float(np.mean(np.sin(2.0 * math.pi * 100.0 * t))))
            parts.append({name: {"i_d_a": self.wanted_a, "u_d_v": u}.get(name, 0.0) for name in signals})
        return Halves(parts[0], parts[1], 2 * periods)


def test_windows_of_pairs_are_whole_periods_of_a_links_ripple() -> None:
    """512 periods of 0.1 ms left 0.34 % of a voltage, 2 % of a slope."""
    pairs = hold_pairs(RippledDrive(), PAIR_A, 1.5, 0.0)  # type: ignore[arg-type]
    assert pairs["u_d_v"] == pytest.approx(pairs["i_d_a"], rel=1e-6)
    assert pairs.meta["samples"] == 1000 and pairs["u_d_change_v"] == pytest.approx(np.zeros(6), abs=1e-6)


class SwingingDrive(LateDrive):
    """A heavy rotor that swings on a vector: what it induces keeps the current from its set-point."""

    OMEGA, DECAY, SWING_RAD, CURRENT_PER_RAD = 3.2, 0.25, 0.1, 1.2

    def __init__(self, *, open_phase: bool = False) -> None:
        super().__init__(0.0, 0)
        self.t, self.open, self.waited = 0.0, open_phase, 0.0

    def enable(self) -> None:
        self.t = 0.0

    disable = enable

    def wait(self, seconds: float) -> None:
        self.t += seconds
        self.waited += seconds

    def average(self, signals: Sequence[str], periods: int) -> Mapping[str, float]:
        swing = 0.0 if self.open else self.SWING_RAD * math.exp(-self.DECAY * self.t) * math.cos(self.OMEGA * self.t)
        current = self.wanted_a * (0.1 if self.open else 1.0 - self.CURRENT_PER_RAD * swing)
        return {name: {"theta_m_rad": swing, "i_d_a": current}.get(name, 0.0) for name in signals}

    def halves(self, signals: Sequence[str], periods: int) -> Halves:
        first = self.average(signals, periods)
        self.wait(periods * PERIOD_S)
        return Halves(first, self.average(signals, periods), periods)


def test_a_small_vector_waits_for_a_rotor_that_swings_past_its_rest() -> None:
    """2.9 kg m2 on 45 mA: where it turns back it looks at rest, and the phases of a healthy machine were 11 % apart."""
    vectors = hold_phase_vectors(SwingingDrive(), I_A)  # type: ignore[arg-type]
    assert vectors["i_d_a"] == pytest.approx([I_A] * 3, rel=PHASE_ARRIVED) and not np.any(vectors["moved"])


def test_a_swing_too_small_for_the_encoder_is_waited_for_while_its_current_does_not_stay() -> None:
    """0.125 ohm and 6 Hz: 0.5 mrad kept i_d 10 % off, and a healthy machine was refused with E_UNBALANCED."""
    drive = SwingingDrive()
    drive.OMEGA, drive.DECAY, drive.SWING_RAD, drive.CURRENT_PER_RAD = 38.0, 0.6, 2e-4, 1200.0  # type: ignore[misc]
    vectors = hold_phase_vectors(drive, I_A)  # type: ignore[arg-type]
    assert vectors["i_d_a"] == pytest.approx([I_A] * 3, rel=PHASE_ARRIVED) and not np.any(vectors["moved"])


class TurningDrive(SwingingDrive):
    """Its currents are there at once, and what it induces dies away."""

    CURRENT_PER_RAD, induced = 0.1, 0.0

    def average(self, signals: Sequence[str], periods: int) -> Mapping[str, float]:
        across = self.induced * math.exp(-self.DECAY * self.t)
        return {**super().average(signals, periods), "u_d_v": 1.0, "u_q_v": across}


@pytest.mark.parametrize(("induced", "least_s", "most_s"), [(0.5 * INDUCED, 0.0, 0.3), (2.0 * INDUCED, 2.0, 10.0)])
def test_a_rotor_on_its_way_is_waited_for_while_it_induces_a_voltage(
    induced: float, least_s: float, most_s: float
) -> None:
    """At rest its currents are the same: three vectors took up to 0.8 s longer."""
    drive = TurningDrive()
    drive.induced = induced
    vectors = hold_phase_vectors(drive, I_A)  # type: ignore[arg-type]
    assert least_s <= drive.waited <= most_s and not np.any(vectors["moved"])


def test_a_current_that_does_not_come_at_a_shaft_that_stands_is_not_waited_for() -> None:
    drive = SwingingDrive(open_phase=True)
    vectors = hold_phase_vectors(drive, I_A)  # type: ignore[arg-type]
    assert vectors["i_d_a"] == pytest.approx([0.1 * I_A] * 3)
    assert drive.waited < 3 * 2.5 * ARRIVAL_LIMIT_S


@pytest.mark.parametrize("period_s", [2.5e-5, 1.25e-4])
def test_windows_of_small_vectors_are_short_at_every_control_frequency(period_s: float) -> None:
    """At 8 kHz 256 periods were 32 ms: a current that a rotor moves stayed in no such window for 2 s."""
    taken = []

    class Slow(LateDrive):
        def halves(self, signals: Sequence[str], periods: int) -> Halves:
            taken.append(periods * self.period_s)
            return super().halves(signals, periods)

    drive = Slow(0.0, 0)
    drive.period_s = period_s
    drive.enable = drive.disable = lambda: None  # type: ignore[attr-defined]
    hold_phase_vectors(drive, I_A, NEAR_ANGLES_RAD)  # type: ignore[arg-type]
    assert max(taken) <= PHASE_HALF_S * (1.0 + 1e-9)


@pytest.mark.parametrize(("quick", "windows"), [(True, 1), (False, standstill.TRIES)])
def test_a_low_level_is_held_again_by_the_largest_voltage(quick: bool, windows: int) -> None:
    """Its current comes last and serves the inverter curve alone: it took two windows of every drive."""

    class Creeping(LateDrive):
        def average(self, signals: Sequence[str], periods: int) -> Mapping[str, float]:
            return {**super().average(signals, periods), "u_d_v": self.wanted_a}

        def halves(self, signals: Sequence[str], periods: int) -> Halves:
            first, second, samples = super().halves(signals, periods)
            return Halves(first, {**second, "u_d_v": second["u_d_v"] + 0.001}, samples)

    drive = Creeping(0.0, 0)
    plan = LevelPlan((4.0, 0.2), 1.5, DC_ANGLE_RAD, quick=quick)
    hold_levels(drive, plan)  # type: ignore[arg-type]
    # 1 mV is little of 4 V, and 0.5 % of 0.2 V
    assert drive.taken == 1 + windows


def test_a_vector_that_is_led_on_reaches_every_angle_forward() -> None:
    """So the rests of two signs and three pairs span 300 degrees (electrical)."""
    plan = LevelPlan((1.0, 4.0, -4.0, -1.0, 2.0), 1.5, DC_ANGLE_RAD, quick=True)
    levels = hold_levels(LateDrive(0.0, 0), plan)  # type: ignore[arg-type]
    quarters = levels["theta_imposed_rad"] / DC_ANGLE_RAD
    assert quarters == pytest.approx([1.0, 1.0, 3.0, 3.0, 5.0])
    assert "theta_imposed_rad" not in hold_levels(LateDrive(0.0, 0), replace(plan, quick=False)).signals  # type: ignore[arg-type]
    pairs = hold_pairs(LateDrive(0.0, 0), PAIR_A, 1.5, 3.0 * DC_ANGLE_RAD, quick=True)  # type: ignore[arg-type]
    assert np.degrees(pairs["theta_imposed_rad"]) == pytest.approx([270.0, 270.0, 330.0, 330.0, 390.0, 390.0])
    assert pairs.meta["idle"] == list("aaccbb"), "the same pairs as on 90, 330 and 210 degrees, with the other sign"
    assert hold_pairs(LateDrive(0.0, 0), PAIR_A, 1.5, 0.0).meta["idle"] == list("aabbcc")  # type: ignore[arg-type]


@pytest.mark.parametrize(("ripple", "samples"), [(0.0, 400), (0.036, 1000)])
def test_windows_are_short_on_a_steady_link_alone(ripple: float, samples: int) -> None:
    drive = LateDrive(0.0, 0)
    drive.ripple = ripple
    plan = LevelPlan((4.0, 1.0), 1.5, DC_ANGLE_RAD, window_periods=400, quick=True)
    assert hold_levels(drive, plan).meta["samples"] == samples // 2  # type: ignore[arg-type]
    assert hold_levels(drive, replace(plan, quick=False)).meta["samples"] == 500  # type: ignore[arg-type]


def test_noise_of_the_link_is_no_ripple() -> None:
    drive = LateDrive(0.0, 0)
    noise = np.random.default_rng(1).standard_normal(60)
    drive.record = lambda *asked, **more: {"U_dc_v": 48.0 * (1.0 + 1e-3 * noise)}  # type: ignore[method-assign]
    assert steady_half(drive, 400) == 200  # type: ignore[arg-type]


def test_falling_levels_are_of_both_signs_and_rise_to_the_largest_alone() -> None:
    """From a tenth of it the largest one at once took a link to its under-voltage."""
    levels = falling_sequence([1.0, 3.0, 2.0, 4.0, 5.0], [0.1])
    assert levels == (1.0, 3.0, 5.0, 4.0, 2.0, 0.1, -1.0, -3.0, -5.0, -4.0, -2.0, -0.1)
    assert sorted(levels) == sorted(calm_sequence([1.0, 3.0, 2.0, 4.0, 5.0], [0.1]))


def test_near_vectors_show_where_the_rotor_went() -> None:
    """So an encoder that counts is seen without a turn of its own."""
    near = hold_phase_vectors(SwingingDrive(), I_A, NEAR_ANGLES_RAD)  # type: ignore[arg-type]
    assert near["theta_imposed_rad"].tolist() == list(NEAR_ANGLES_RAD) and "theta_M_rad" in near.signals
    assert NEAR_ANGLES_RAD[-1] == DC_ANGLE_RAD, "the first level's"
    assert "theta_M_rad" not in hold_phase_vectors(SwingingDrive(), I_A).signals  # type: ignore[arg-type]


class HeavyDrive(LateDrive):
    """A load that swings on a small vector for good, until a large one is held that long."""

    LARGE_A, CALM_S = 4.0, 0.1

    def __init__(self) -> None:
        super().__init__(0.0, 0)
        self.t = self.held_s = 0.0

    def wait(self, seconds: float) -> None:
        self.t += seconds
        self.held_s += seconds * (self.wanted_a >= self.LARGE_A)

    def average(self, signals: Sequence[str], periods: int) -> Mapping[str, float]:
        self.taken += 1
        swing = 0.1 * math.cos(3.0 * self.t) if self.held_s < self.CALM_S else 0.0
        return {name: {"theta_m_rad": swing, "i_d_a": self.wanted_a}.get(name, 0.0) for name in signals}

    def halves(self, signals: Sequence[str], periods: int) -> Halves:
        first = self.average(signals, periods)
        self.wait(periods * PERIOD_S)
        return Halves(first, self.average(signals, periods), periods)


@pytest.mark.parametrize("quick", [True, False])
def test_a_load_that_swings_on_a_small_level_is_braked_on_the_largest(quick: bool) -> None:
    """Of a drive with 35 times its inertia every level was refused after 460 s; R after 45 s."""
    plan = LevelPlan((1.0, 2.0, 4.0), 1.5, DC_ANGLE_RAD, quick=quick)
    levels = hold_levels(HeavyDrive(), plan)  # type: ignore[arg-type]
    assert levels["moved"].tolist() == [0.0, 0.0, 0.0]


def test_a_rotor_that_stands_where_it_stood_needs_one_look() -> None:
    taken = []
    for quick in (True, False):
        drive = HeavyDrive()
        drive.held_s = drive.CALM_S
        hold_levels(drive, LevelPlan((1.0, 2.0, 4.0), 1.5, DC_ANGLE_RAD, quick=quick))  # type: ignore[arg-type]
        taken.append(drive.taken)
    assert taken == [3 * 3 + 1, 3 * 4]


def test_once_a_swing_was_braked_the_vector_turns_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    """In 0.4 s a load of 36 times the inertia was left behind: L was refused after 318 s; 53 s and a good L so."""
    turns: list[float] = []
    monkeypatch.setattr(standstill, "turn_vector", lambda *told: turns.append(told[4]) or told[4])
    calm = HeavyDrive()
    calm.held_s = calm.CALM_S
    for drive in (calm, HeavyDrive()):
        hold_levels(drive, LevelPlan((1.0, 4.0, -4.0), 1.5, DC_ANGLE_RAD, turn_s=0.4, quick=True))  # type: ignore[arg-type]
    assert turns == [0.4, SWINGING_TURN_S]
