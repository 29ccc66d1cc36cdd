# SPDX-License-Identifier: MIT
"""The rotor on a slowly turning vector: what it swings by, on a mass that only friction damps, and on a whole drive."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from pmsmtool.estimators.encoder import LINEARITY_LIMIT_RAD, estimate_encoder
from pmsmtool.experiments.rotation import (
    BRAKED_S,
    LOOK_S,
    QUICK_DWELL_S,
    QUICK_STEP_RAD,
    RAMP_S,
    REST_LIMIT_S,
    STUCK_S,
    SWING,
    SWINGS_MOST_S,
    RotationPlan,
    come_to_rest,
    rising,
    rotate_vector,
    step_within,
    turn_vector,
)
from pmsmtool.machine.parameters import MAX_POLE_PAIRS
from pmsmtool.measurement.effort import ROTATIONS
from pmsmtool.measurement.limits import Limits
from pmsmtool.measurement.measure import Measurement
from pmsmtool.trace import Trace

POLE_PAIRS = 2
FRICTION = 0.02
"""Friction over the largest torque of the vector: the rotor comes to rest within this angle (rad electrical)."""
FRAME_S = 0.002
"""Time that a command or a question takes on the bus."""
STEP_S = 1e-3
SWING_LIMIT_RAD = math.radians(15.0)
"""Half of what the estimator refuses. These turns swing by 10 deg at the most; on a vector that jumps to 75/6 rad/s
98, 34, 21, 17 and 7 deg."""


class SwingingRotor:
    """A mass on the current vector, whose angle the dead time moves by ``ripple_rad`` six times a turn."""

    period_s = 1e-4

    def __init__(self, swing_rad_s: float, ripple_rad: float = 0.0, theta_rad: float = 0.0) -> None:
        self.swing_rad_s, self.ripple_rad = swing_rad_s, ripple_rad
        self.theta, self.omega, self.i_a, self.vector = theta_rad, 0.0, 0.0, 0.0
        self.elapsed = 0.0
        self.speeds: list[float] = []

    def command_current(self, i_d_a: float, i_q_a: float, *, fixed_angle_rad: float | None = None) -> None:
        assert fixed_angle_rad is not None
        self.i_a, self.vector = i_d_a, fixed_angle_rad
        self.wait(FRAME_S)

    def wait(self, seconds: float) -> None:
        spring = self.swing_rad_s**2
        for _ in range(round(seconds / STEP_S)):
            pull = self.vector + self.ripple_rad * math.sin(6.0 * self.vector) - self.theta
            push = spring * self.i_a * math.sin(pull)
            held = spring * FRICTION
            if abs(self.omega) <= STEP_S * held and abs(push) <= held:
                self.omega = 0.0
            else:
                self.omega += STEP_S * (push - math.copysign(held, self.omega or push))
            self.theta += STEP_S * self.omega
            self.elapsed += STEP_S
            self.speeds.append(self.omega)

    def live(self, name: str) -> float:
        self.wait(FRAME_S)
        return self.theta / POLE_PAIRS

    def average(self, signals: Sequence[str], periods: int) -> Mapping[str, float]:
        self.wait(FRAME_S + periods * self.period_s)
        return {"theta_m_rad": self.theta / POLE_PAIRS}


class CountedRotor(SwingingRotor):
    """Its encoder shows whole counts, a fifth of one of noise on them."""

    bits = 12

    def __init__(self, swing_rad_s: float, theta_rad: float) -> None:
        super().__init__(swing_rad_s, 0.02, theta_rad)
        self.rng = np.random.default_rng(1)

    def live(self, name: str) -> float:
        count = 2.0 * math.pi / 2**self.bits
        return count * math.floor(super().live(name) / count + 0.2 * self.rng.standard_normal())

    def average(self, signals: Sequence[str], periods: int) -> Mapping[str, float]:
        self.wait(periods * self.period_s)
        return {"theta_m_rad": self.live("theta_m_rad")}


def swing_rad(run: Trace) -> float:
    off = POLE_PAIRS * run["theta_M_rad"] - run["theta_imposed_rad"]
    return float(np.max(np.abs(off - np.mean(off))))


def first_plan(omega_max_rad_s: float = 300.0) -> RotationPlan:
    _, step_rad, dwell_s, ramp_s = ROTATIONS[0]
    return RotationPlan(1.0, *step_within(step_rad, dwell_s, omega_max_rad_s), ramp_s=ramp_s)


@pytest.mark.parametrize(
    ("swing_rad_s", "ripple_rad"), [(19.0, 0.0), (25.0, 0.03), (60.0, 0.03), (75.0, 0.03), (106.0, 0.0)]
)
def test_a_rotor_that_swings_stays_on_the_first_vector(swing_rad_s: float, ripple_rad: float) -> None:
    drive = SwingingRotor(swing_rad_s, ripple_rad)
    runs = rotate_vector(drive, first_plan())  # type: ignore[arg-type]
    assert max(map(swing_rad, runs)) < SWING_LIMIT_RAD
    found = estimate_encoder(*runs)
    assert found.pole_pairs.value == POLE_PAIRS
    assert abs(found.offset.value) < math.radians(1.0)


def test_as_many_pole_pairs_as_a_machine_file_states_are_turned_through(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stepper motor of 50 ended its turn after 0.65 of it, and with it L, psi and the mechanics."""
    monkeypatch.setitem(globals(), "POLE_PAIRS", MAX_POLE_PAIRS)
    found = estimate_encoder(*rotate_vector(SwingingRotor(60.0, 0.03), first_plan()))  # type: ignore[arg-type]
    assert found.pole_pairs.value == MAX_POLE_PAIRS


def test_the_rotor_rests_on_a_whole_turn_afterwards() -> None:
    drive = SwingingRotor(25.0, 0.02, theta_rad=math.radians(330.0))
    rotate_vector(drive, first_plan(), start_rad=math.radians(330.0))  # type: ignore[arg-type]
    assert drive.i_a == 0.0
    assert math.remainder(drive.vector, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)
    assert abs(math.remainder(drive.theta, 2.0 * math.pi)) < 2.0 * FRICTION
    assert abs(drive.omega) < 0.1


def test_a_rotor_far_off_the_first_vector_is_waited_for() -> None:
    drive = SwingingRotor(40.0, theta_rad=math.radians(100.0))
    assert max(map(swing_rad, rotate_vector(drive, first_plan()))) < SWING_LIMIT_RAD  # type: ignore[arg-type]


@pytest.mark.parametrize("swing_rad_s", [16.0, 30.0, 60.0])
def test_half_an_electrical_turn_leaves_no_swing(swing_rad_s: float) -> None:
    drive = SwingingRotor(swing_rad_s)
    turn_vector(drive, 1.0, 0.0, math.pi)  # type: ignore[arg-type]
    drive.speeds.clear()
    drive.wait(0.5)
    assert max(map(abs, drive.speeds)) < math.radians(10.0) * swing_rad_s


def test_rest_is_not_taken_for_the_end_of_a_swing_and_not_waited_for_for_ever() -> None:
    class Endless(SwingingRotor):
        def average(self, signals: Sequence[str], periods: int) -> Mapping[str, float]:
            self.elapsed += FRAME_S
            return {"theta_m_rad": 0.1 * math.cos(7.0 * self.elapsed)}

        def wait(self, seconds: float) -> None:
            self.elapsed += seconds

    endless = Endless(7.0)
    assert come_to_rest(endless, 1.0, 0.0) == pytest.approx(REST_LIMIT_S + BRAKED_S, abs=LOOK_S)  # type: ignore[arg-type]
    assert endless.i_a == 1.0  # all of the current again
    short = come_to_rest(Endless(7.0), 1.0, 0.0, limit_s=REST_LIMIT_S)  # type: ignore[arg-type]
    assert short == pytest.approx(REST_LIMIT_S, abs=LOOK_S)
    assert come_to_rest(SwingingRotor(7.0), 1.0, 0.0) < 0.2  # type: ignore[arg-type]


@pytest.mark.parametrize(("swing_rad_s", "theta_rad"), [(4.5, 2.9), (3.0, 1.0), (9.0, 1.0)])
def test_a_heavy_load_that_would_swing_for_minutes_is_braked(
    swing_rad_s: float, theta_rad: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """50 times the rotor's inertia as load: every slow turn was refused, and with it L, psi_f and J."""
    monkeypatch.setattr("tests.measurement.test_slow_turn.FRICTION", 1e-3)
    drive = SwingingRotor(swing_rad_s, theta_rad=theta_rad)
    drive.command_current(1.0, 0.0, fixed_angle_rad=0.0)
    come_to_rest(drive, 1.0, 0.0, limit_s=REST_LIMIT_S)  # type: ignore[arg-type]
    left_swinging = 2.0 * max(map(abs, drive.speeds[-2000:])) / swing_rad_s
    waited = come_to_rest(drive, 1.0, 0.0)  # type: ignore[arg-type]
    drive.wait(2.0)
    swings = max(map(abs, drive.speeds[-2000:])) / swing_rad_s
    assert left_swinging > math.radians(90.0) and swings < math.radians(3.0) and drive.i_a == 1.0
    assert waited < REST_LIMIT_S + BRAKED_S


@pytest.mark.parametrize(("swing_rad_s", "bits"), [(1.7, 12), (3.0, 10), (10.0, 10), (100.0, 12)])
def test_a_heavy_load_swings_from_step_to_step(swing_rad_s: float, bits: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """8 to 26 rotors of load, 1 % of friction: behind a vector that turns by itself they swung by 50 to 180 degrees.

    With differences of a few looks for the speed a count of the encoder was a turning point, and the vector ran away.
    """
    monkeypatch.setattr("tests.measurement.test_slow_turn.FRICTION", 0.03)
    led = RotationPlan(1.0, *step_within(*ROTATIONS[1][1:3], 300.0))
    drive = CountedRotor(swing_rad_s, 1.0)
    drive.bits = bits
    runs = rotate_vector(drive, led)  # type: ignore[arg-type]
    assert max(map(swing_rad, runs)) < LINEARITY_LIMIT_RAD
    found = estimate_encoder(*runs)
    assert found.pole_pairs.value == POLE_PAIRS and abs(found.offset.value) < math.radians(3.0)
    assert all(float(np.ptp(run.t_s)) < SWINGS_MOST_S for run in runs) and drive.i_a == 0.0


def test_a_ramp_rises_smoothly_and_never_beyond_the_speed() -> None:
    ramp = rising(30)
    assert list(ramp) == sorted(ramp)
    assert 0.0 < ramp[0] < 0.01 and 0.99 < ramp[-1] < 1.0
    assert sum(ramp) == pytest.approx(15.0)
    assert len(RotationPlan(1.0, dwell_s=0.018, ramp_s=RAMP_S).ramp) == 25


@pytest.mark.parametrize("rpm", [26.0, 60.0, 120.0, 249.0, 251.0, 400.0, 573.0, 3000.0])
@pytest.mark.parametrize("plan", ROTATIONS)
def test_every_try_keeps_to_the_speed_limit(rpm: float, plan: tuple[float, float, float | None, float]) -> None:
    allowed = rpm * math.pi / 30.0
    step_rad, dwell_s = step_within(plan[1], plan[2], allowed)
    if dwell_s is None:
        fastest = 0.5 * step_rad * 105.0
        assert plan[2] is None
    else:
        fastest = SWING * step_rad / (dwell_s + 0.002)
        assert dwell_s >= (plan[2] or 0.0)
    assert fastest <= allowed * (1.0 + 1e-12)
    assert step_rad <= plan[1]
    if rpm == 3000.0:
        assert (step_rad, dwell_s) == plan[1:3]


def test_the_first_vector_is_above_the_swing_of_every_drive_it_was_made_for() -> None:
    """The dead time pulls six times per turn; 105 rad/s is the fastest swing of 400 random drives."""
    on_the_bus_s = QUICK_DWELL_S + 0.006
    assert 6.0 * QUICK_STEP_RAD / on_the_bus_s > 1.3 * 105.0


def turned(offset_rad: float, jumps_rad: float) -> tuple[Trace, Trace]:
    """Both runs of a rotor that jumps beside its vector by up to an angle, eight times a turn of the shaft."""
    angle = np.linspace(0.0, 2.05 * math.pi * POLE_PAIRS, 300)
    runs = []
    for imposed in (angle, angle[::-1]):
        theta_e = imposed + offset_rad + jumps_rad * np.sin(8.0 * imposed / POLE_PAIRS)
        signals = {"theta_imposed_rad": imposed, "theta_M_rad": theta_e / POLE_PAIRS}
        runs.append(Trace(np.arange(300.0), signals, dict.fromkeys(signals, "rad"), {}))
    return runs[0], runs[1]


def test_swings_that_take_too_long_for_a_turn_leave_the_other_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    """They end after 100 s, with E_EXCITATION for a third of a turn: the encoder was refused, and all behind it."""
    whole = turned(0.0, 0.1)
    part = tuple(run.rows(slice(0, 50)) for run in whole)
    left = iter([turned(0.0, 1.1), part, whole])
    monkeypatch.setattr("pmsmtool.experiments.rotation.rotate_vector", lambda *_, **__: next(left))
    said: list[str] = []
    limits = Limits(1.0, 1.2, 300.0, 100.0)
    measurement = Measurement(SwingingRotor(20.0), limits, lambda *_: None, said.append)  # type: ignore[arg-type]
    assert measurement._rotation(0.0).pole_pairs.value == POLE_PAIRS
    assert [line.endswith("own swings") for line in said] == [False, True, False]


@pytest.mark.parametrize(("of_the_largest", "used"), [(0.75, 1), (0.02, 4)])
def test_the_largest_current_is_not_trusted_where_it_puts_a_jumping_rotor_beside_its_vector(
    of_the_largest: float, used: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cogging of 5 % on fast-ipm: above psi/(L_q - L_d) the rotor rested 43 deg off, and was taken for aligned."""
    tries = [turned(0.0, 1.1), turned(0.03, 0.7), turned(0.1, 1.0), turned(0.1, 1.0), turned(of_the_largest, 0.1)]
    left = iter(tries)
    monkeypatch.setattr("pmsmtool.experiments.rotation.rotate_vector", lambda *_, **__: next(left))
    kept: dict[str, Trace] = {}
    limits = Limits(1.0, 1.2, 300.0, 100.0)
    measurement = Measurement(SwingingRotor(20.0), limits, kept.__setitem__, lambda text: None)  # type: ignore[arg-type]
    found = measurement._rotation(0.0)
    assert found.offset.value == pytest.approx([0.0, 0.03, 0.1, 0.1, of_the_largest][used], abs=0.03)
    assert (kept["rotation_forward"], kept["rotation_backward"]) == tries[used]


@pytest.mark.parametrize("swing_rad_s", [3.0, 10.0, 30.0, 60.0, 105.0])
@pytest.mark.parametrize("way_rad", [math.radians(60.0), -math.pi])
def test_a_rotor_swings_onto_its_vector_whatever_its_inertia(swing_rad_s: float, way_rad: float) -> None:
    """It says itself how long a turn takes: half a swing per sixth of a turn. Seen 1 to 8 degrees afterwards."""
    drive = SwingingRotor(swing_rad_s)
    told = turn_vector(drive, 1.0, 0.0, way_rad, None)  # type: ignore[arg-type]
    swings = drive.elapsed * swing_rad_s / math.pi
    parts = abs(way_rad) / math.radians(60.0)
    assert drive.vector == way_rad and told <= drive.elapsed
    assert swings < 1.5 * parts
    drive.speeds.clear()
    drive.wait(math.pi / swing_rad_s)
    assert max(map(abs, drive.speeds)) < math.radians(10.0) * swing_rad_s


def test_a_rotor_that_friction_holds_is_not_waited_for() -> None:
    drive = SwingingRotor(30.0)
    turn_vector(drive, 0.5 * FRICTION, 0.0, math.radians(60.0), None)  # type: ignore[arg-type]
    assert drive.theta == 0.0 and STUCK_S < drive.elapsed < 2.0 * STUCK_S + 10.0 * FRAME_S
