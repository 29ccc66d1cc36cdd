# SPDX-License-Identifier: MIT
"""Position control of the application: moves, wrap, saturation, following error, limits and stops, one by one."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest

from pmsmtool.design.tune import tune
from pmsmtool.firmware.image import pack_image
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.sim.closed_loop import drive_values
from pmsmtool.sim.kernel import Part, Signal, Simulation, Truth
from pmsmtool.sim.node.drive_core import HomingPhase as Phase
from pmsmtool.sim.node.drive_core import PositionFlag as Flag
from pmsmtool.sim.simulated_machine import build_setup
from pmsmtool.units import rad_s_from_rpm

MODE_POSITION = 6
INCREMENTS = 4096
FOLLOWS = 8.5
"""Following error of a move (increments of 4096 a turn); measured 8.07 one way, 7.55 the other."""
OVERSHOOT = 0.02
MACHINE = load_machine_file("jercic-2017")


@functools.cache
def tuned() -> dict[str, float]:
    """Parameters of the design of the machine."""
    return dict(drive_values(MACHINE, tune(MACHINE).parameter_set()))


class Axis:
    """A simulated drive in position control, at rest after some turns; moves of 2 turns/s."""

    def __init__(self, turns: float = 0.0, **changes: float) -> None:
        setup, keep = build_setup(MACHINE, seed=1)
        setup.theta_M = 2 * math.pi * turns
        values = tuned() | {name.replace("__", "."): value for name, value in changes.items()}
        self.simulation = Simulation(setup, pack_image(values), keep)
        self.position = self.simulation.position
        self.asked = self.position.asked
        self.asked.increments, self.asked.profile = INCREMENTS, 1
        self.asked.velocity, self.asked.acceleration, self.asked.deceleration = 8192.0, 80000.0, 80000.0
        self.asked.stop_deceleration, self.asked.jerk = 160000.0, 4e6
        self.T_s = 1e-9 * values["inverter.T_s_ns"]
        self.steps = int(values["speed.decimation"])
        self.T = self.steps * self.T_s
        self.simulation.reference.mode = MODE_POSITION
        self.enable(True)
        self.simulation.run(1)

    def enable(self, on: bool) -> None:
        self.simulation.word(Part.ENABLED).value = int(on)

    def go(self, target: int) -> None:
        """Ask for another target."""
        self.asked.target = _wrapped(target)
        self.asked.set_point += 1

    def run(self, seconds: float) -> np.ndarray:
        """Run; rows (reference less the first, velocity, error) of the speed controller's steps."""
        p, first, rows = self.position, self.position.reference, []
        for _ in range(round(seconds / self.T)):
            self.simulation.run(self.steps)
            rows.append((_wrapped(p.reference - first) + p.reference_part, p.velocity, p.error))
        return np.array(rows)

    @property
    def flags(self) -> Flag:
        return Flag(self.position.flags)

    @property
    def omega(self) -> float:
        return self.simulation.signal(Truth.OMEGA_M)


def _wrapped(count: int) -> int:
    return int((count + 2**31) % 2**32 - 2**31)


@pytest.mark.parametrize("turns", [0.0, 2.0**31 / INCREMENTS - 0.5, -(2.0**31) / INCREMENTS + 0.25])
@pytest.mark.parametrize("way", [4000, -4000])
def test_a_move_arrives_within_its_limits_also_across_the_wrap(turns: float, way: int) -> None:
    axis = Axis(turns)
    start = axis.position.actual
    axis.go(start + way)
    rows = axis.run(1.2)
    assert rows[-1, 0] == way and not axis.flags & Flag.MOVING
    assert abs(_wrapped(axis.position.actual - start - way)) <= 2
    velocity = np.diff(rows[:, 0]) / axis.T
    assert np.abs(velocity).max() <= 8192.0 * 1.001
    assert np.abs(np.diff(velocity)).max() / axis.T <= 80000 * 1.01
    assert np.abs(np.diff(velocity, 2)).max() / axis.T**2 <= 4e6 * 1.1  # measured 1.075: the trapezoid's last step
    assert np.abs(rows[:, 2]).max() < FOLLOWS  # fed forward


def test_without_a_new_target_the_shaft_is_held_where_it_is() -> None:
    axis = Axis(3.3)
    start = axis.position.actual
    axis.asked.target = -77777
    axis.run(0.2)
    assert axis.position.reference == start and abs(axis.position.error) <= 2


@pytest.mark.chain
def test_the_feed_forward_is_what_keeps_the_error_small() -> None:
    errors = []
    slow = {"speed__acceleration_rpm_per_s": 10.0}  # a limit of the speed mode alone
    for changes in (slow, {"position__inertia_ff_kgm2": 0.0}, {"position__velocity_ff": 0.0}):
        axis = Axis(**changes)
        axis.go(8000)
        errors.append(np.abs(axis.run(1.5)[:, 2]).max())
    assert errors[1] > 2 * errors[0] and errors[2] > 8192.0 / tuned()["position.K_p_per_s"] * 0.9, errors


@pytest.mark.chain
def test_a_target_may_change_on_the_way_and_a_halt_ends_it() -> None:
    axis = Axis()
    axis.go(100000)
    axis.run(0.4)
    axis.go(1000)  # back
    rows = axis.run(2.0)
    assert axis.position.reference == 1000 and not axis.flags & Flag.MOVING
    assert np.abs(np.diff(rows[:, 0], 2)).max() / axis.T**2 <= 80000 * 1.01
    axis.go(100000)
    axis.run(0.4)
    axis.asked.halt = 1
    axis.run(0.4)
    assert axis.position.velocity == 0.0 and axis.flags & Flag.MOVING
    assert 1000 < axis.position.reference < 100000


def test_targets_follow_on_straight_lines_and_end_where_they_are() -> None:
    axis = Axis()
    axis.asked.profile, axis.asked.interval = 0, 12 * axis.T_s
    for k in range(1, 400):
        axis.go(8 * k)
        axis.simulation.run(12)
    assert axis.position.velocity == pytest.approx(8 / (12 * axis.T_s), rel=1e-3)
    assert abs(axis.position.error) < FOLLOWS
    axis.run(0.4)
    assert axis.position.reference == 8 * 399 and abs(axis.position.error) <= 2


def test_a_profile_takes_over_from_targets_that_were_followed() -> None:
    """Where the following is, and at its speed: not where the last profile began."""
    axis = Axis()
    axis.asked.profile, axis.asked.interval = 0, 0.5
    axis.go(2 * INCREMENTS)
    axis.run(0.25)
    before = axis.position.reference
    axis.asked.profile = 1
    rows = axis.run(1.0)
    assert np.abs(np.diff(rows[:, 0], 2)).max() / axis.T**2 <= 80000 * 1.15  # measured 1.12: the last step
    assert rows[-1, 0] == 2 * INCREMENTS - before and not axis.flags & Flag.MOVING
    assert np.abs(rows[:, 2]).max() < 2 * FOLLOWS  # measured 12.1: a straight line begins without an acceleration


def test_the_following_error_is_told_after_its_time_and_starts_anew() -> None:
    axis = Axis(speed__tau_max_nm=0.5)  # cannot follow
    axis.asked.window, axis.asked.window_time = 200.0, 0.05
    axis.go(20000)
    errors = []
    while sum(error > 200.0 for error in errors) < 40:
        errors.append(axis.run(axis.T)[0, 2])
    assert not axis.flags & Flag.FOLLOWING_ERROR
    axis.asked.window = 1e6  # back inside for a moment: the time begins anew
    axis.run(axis.T)
    axis.asked.window = 200.0
    errors = []
    while not axis.flags & Flag.FOLLOWING_ERROR and len(errors) < 2000:
        errors.append(axis.run(axis.T)[0, 2])
    outside = sum(abs(error) > 200.0 for error in errors) * axis.T
    assert outside == pytest.approx(0.05, abs=2 * axis.T)
    axis.enable(False)
    axis.run(0.01)
    axis.enable(True)
    axis.run(0.01)
    assert not axis.flags & Flag.FOLLOWING_ERROR


@pytest.mark.chain
def test_a_saturated_loop_does_not_wind_up() -> None:
    """A step of twenty turns at once: the speed limit acts, torque too, and there is no second swing."""
    axis = Axis(motor__n_max_rpm=200.0)
    axis.asked.profile, axis.asked.interval = 0, axis.T_s
    axis.go(20 * INCREMENTS)
    axis.run(2 * axis.T)
    assert axis.flags & Flag.SATURATED
    assert axis.position.omega_ref == pytest.approx(rad_s_from_rpm(200.0))
    furthest = max(-row[2] for row in axis.run(7.5))
    assert not axis.flags & Flag.SATURATED and abs(axis.position.error) <= 2
    assert furthest < OVERSHOOT * 20 * INCREMENTS


@pytest.mark.parametrize("direction", [1, -1])
def test_software_limits_cut_the_target(direction: int) -> None:
    axis = Axis()
    axis.asked.minimum, axis.asked.maximum = -1000, 1000
    axis.go(5000 * direction)
    axis.run(1.0)
    assert axis.position.reference == 1000 * direction and axis.flags == Flag.SOFTWARE_LIMIT
    axis.go(0)
    axis.run(1.0)
    assert axis.position.reference == 0 and axis.flags == 0


@pytest.mark.chain
@pytest.mark.parametrize("profile", [1, 0])
@pytest.mark.parametrize("direction", [1, -1])
def test_a_limit_switch_stops_the_way_into_it_and_only_that(direction: int, profile: int) -> None:
    axis = Axis()
    axis.asked.profile, axis.asked.interval = profile, 2.0
    axis.simulation.library.pmsm_sim_set_switches(axis.simulation.sim, -4 * math.pi, 4 * math.pi)
    axis.go(12000 * direction)  # the switch is at 8192
    axis.run(1.9)
    held = axis.position.reference
    assert axis.position.velocity == 0.0 and axis.flags & Flag.LIMIT_SWITCH
    assert abs(abs(held) - 8192) < 8192**2 / (2 * 80000)  # the encoder's zero is 131 increments off
    axis.go(12000 * direction)
    axis.run(0.4)
    assert axis.position.reference == held
    axis.go(0)
    axis.run(2.5)
    assert axis.position.reference == 0 and not axis.flags & (Flag.LIMIT_SWITCH | Flag.MOVING)


def test_an_axis_that_a_switch_stopped_waits_for_a_new_target() -> None:
    """Not the mode nor the switch that opens again may start the way to the old target."""
    axis = Axis()
    axis.asked.profile, axis.asked.interval = 0, 0.2
    axis.simulation.library.pmsm_sim_set_switches(axis.simulation.sim, -0.5, 0.5)
    axis.go(1500)
    axis.run(0.25)
    held = axis.position.reference
    assert axis.position.velocity == 0.0 and 0 < held < 1500
    axis.asked.profile = 1
    axis.simulation.library.pmsm_sim_set_switches(axis.simulation.sim, -4 * math.pi, 4 * math.pi)
    axis.run(0.1)
    assert axis.position.reference == held
    axis.go(1500)
    axis.run(0.1)
    assert axis.position.reference > held


def test_a_quick_stop_brakes_a_move_and_the_next_one_begins_at_rest() -> None:
    axis = Axis()
    axis.go(100000)
    axis.run(0.5)
    assert axis.omega > 5.0
    axis.simulation.word(Part.QUICK_STOP).value = 1
    axis.run(0.5)
    assert abs(axis.omega) < 2.0 and axis.simulation.signal(Truth.GATES) == 0.0
    axis.simulation.word(Part.QUICK_STOP).value = 0
    axis.run(1.0)
    assert axis.position.velocity == 0.0 and abs(axis.position.error) <= 2
    assert axis.simulation.signal(Signal.FOLLOWING_ERROR) == pytest.approx(
        axis.position.error * 2 * math.pi / INCREMENTS, abs=1e-9
    )


def test_a_reversed_encoder_counts_and_moves_the_other_way() -> None:
    axis = Axis()
    axis.go(2000 + axis.position.actual)
    axis.run(0.3)
    forward = axis.omega
    setup, keep = build_setup(MACHINE, seed=1)
    setup.sensors.encoder_reversed ^= 1
    values = tuned() | {"encoder.reversed": 1.0 - tuned()["encoder.reversed"]}
    axis.simulation = Simulation(setup, pack_image(values), keep)
    other = axis.simulation.position
    for name in ("increments", "profile", "velocity", "acceleration", "deceleration", "jerk"):
        setattr(other.asked, name, getattr(axis.asked, name))
    axis.position, axis.asked = other, other.asked
    axis.simulation.reference.mode = MODE_POSITION
    axis.enable(True)
    axis.simulation.run(1)
    axis.go(2000 + other.actual)
    axis.run(0.3)
    assert axis.omega == pytest.approx(-forward, rel=0.05) and abs(forward) > 5.0


SLOW = 2048.0
HERE, INDEXES, SWITCHES, STOPS = 37, {33: -1, 34: 1}, {17: -1, 18: 1}, {-1: -1, -2: 1}


class Homing(Axis):
    """An axis that homes: it steps period by period until a phase is left."""

    def home(self, method: int, offset: int = 0, torque: float = 40.0) -> Phase:
        """Ask for it, and return the phase after a step of the speed controller."""
        homing = self.asked.homing
        homing.active, homing.method, homing.slow, homing.torque = 1, method, SLOW, torque
        homing.home_offset, homing.start = offset, 0
        self.run(self.T)
        homing.start = 1
        self.run(self.T)
        return self.phase

    @property
    def phase(self) -> Phase:
        return Phase(self.position.homing)

    def left(self, phase: Phase, seconds: float = 3.0) -> Phase:
        """Return what follows a phase; its own when it lasts."""
        for _ in range(round(seconds / self.T)):
            if self.phase is not phase:
                break
            self.run(self.T)
        return self.phase

    @property
    def count(self) -> int:
        """The encoder's, whatever the zero."""
        return _wrapped(self.position.actual - self.asked.offset)


@pytest.mark.parametrize("turns", [0.3, 2.0**31 / INCREMENTS - 1e-3, -(2.0**31) / INCREMENTS + 1e-3])
def test_homing_where_it_is_moves_nothing_and_its_zero_is_beyond(turns: float) -> None:
    axis = Homing(turns)
    before = axis.count
    assert axis.home(HERE, offset=700) is Phase.DONE
    assert abs(axis.position.actual + 700) <= 2 and abs(_wrapped(axis.count - before)) <= 2
    axis.asked.homing.active = 0
    axis.go(0)
    axis.run(0.5)
    assert axis.phase is Phase.IDLE and axis.position.reference == 0 and abs(axis.position.actual) <= 2
    assert abs(_wrapped(axis.count - before) - 700) <= 4


@pytest.mark.parametrize(("method", "direction"), INDEXES.items())
@pytest.mark.parametrize("turns", [0.3, 2.0**31 / INCREMENTS - 0.2])
def test_homing_by_the_index(turns: float, method: int, direction: int) -> None:
    axis = Homing(turns)
    turn = axis.count // INCREMENTS + (direction > 0)
    assert axis.home(method) is Phase.SEARCH
    axis.run(0.1)
    assert axis.position.velocity == pytest.approx(direction * SLOW)
    assert axis.left(Phase.SEARCH) is Phase.REST
    assert axis.asked.offset == _wrapped(-turn * INCREMENTS)
    speed = axis.position.velocity
    assert axis.left(Phase.REST) is Phase.DONE and speed == pytest.approx(direction * SLOW, rel=0.01)
    way = SLOW**2 / (2 * 80000) + 0.5 * SLOW * 80000 / 4e6  # by the ramp, and the jerk's time
    assert direction * axis.position.reference == pytest.approx(way, abs=2 * SLOW * axis.T + FOLLOWS)
    assert abs(axis.position.error) < FOLLOWS


@pytest.mark.parametrize(("method", "direction"), SWITCHES.items())
def test_homing_by_a_limit_switch_and_back_until_it_opens(method: int, direction: int) -> None:
    axis = Homing()
    first = axis.count
    axis.simulation.library.pmsm_sim_set_switches(axis.simulation.sim, -2 * math.pi, 2 * math.pi)
    assert axis.home(method) is Phase.SEARCH and axis.left(Phase.SEARCH) is Phase.AWAY
    assert axis.position.velocity == pytest.approx(direction * 8192.0, rel=0.05)
    assert axis.left(Phase.AWAY) is Phase.REST
    assert axis.left(Phase.REST) is Phase.DONE
    assert -axis.asked.offset == pytest.approx(first + direction * INCREMENTS, abs=SLOW * 2 * axis.T + 2)
    assert not axis.position.limits and not axis.flags & Flag.LIMIT_SWITCH


@pytest.mark.parametrize(("method", "direction"), STOPS.items())
def test_homing_by_a_stop_ends_where_the_torque_stays(method: int, direction: int) -> None:
    axis = Homing()
    assert axis.home(method) is Phase.SEARCH
    axis.run(0.5)
    assert axis.phase is Phase.SEARCH and direction * axis.position.velocity > 8000, "an acceleration is no stop"
    axis.simulation.library.pmsm_sim_set_rotor(axis.simulation.sim, 1, 0.0)
    assert axis.left(Phase.SEARCH) is Phase.DONE
    assert abs(axis.position.actual) <= 2 and abs(axis.position.reference) <= 2, "no way on into the stop"


def test_a_homing_ends_early() -> None:
    axis = Homing()
    for method in (0, 1, 19, -3):
        assert axis.home(method) is Phase.FAILED, method
    offset = axis.asked.offset
    assert axis.home(18) is Phase.SEARCH
    axis.run(0.2)
    axis.asked.homing.start = 0  # taken back
    assert axis.left(Phase.SEARCH) is Phase.INTERRUPTED
    axis.run(0.3)
    assert axis.position.velocity == 0.0 and not axis.flags & Flag.MOVING and abs(axis.position.error) <= 3
    for word, value in ((Part.QUICK_STOP, 1), (Part.ENABLED, 0)):
        assert axis.home(18) is Phase.SEARCH
        axis.simulation.word(word).value = value
        assert axis.left(Phase.SEARCH) is Phase.INTERRUPTED
        axis.simulation.word(word).value = 1 - value
        axis.run(0.5)
        assert axis.phase is Phase.INTERRUPTED, "it does not begin by itself"
    axis.simulation.library.pmsm_sim_set_switches(axis.simulation.sim, -9.0, -8.0)
    assert axis.home(34) is Phase.FAILED, "a limit switch bars the way to the index"
    axis.asked.homing.active = 0
    axis.run(axis.T)
    assert axis.phase is Phase.IDLE and axis.asked.offset == offset


def test_a_search_that_finds_nothing_ends() -> None:
    """After half of the way that a position tells, here one turn."""
    axis = Homing()
    axis.asked.increments, scale = 1 << 30, (1 << 30) / INCREMENTS
    for name in ("velocity", "acceleration", "deceleration", "stop_deceleration", "jerk"):
        setattr(axis.asked, name, scale * getattr(axis.asked, name))
    assert axis.home(18) is Phase.SEARCH and axis.left(Phase.SEARCH) is Phase.FAILED
    axis.run(0.1)
    assert axis.position.velocity == 0.0
