# SPDX-License-Identifier: MIT
"""The guard: limits, Ctrl-C at any moment, pulled cables, and a drive that holds what it held."""

from __future__ import annotations

import math
import random
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from types import FrameType
from typing import Any

import numpy as np
import pytest

from pmsmtool.cia402 import State
from pmsmtool.drive import objects
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import FRESH_S, OVERSHOOT, RESTORED, GuardedDrive, guarded
from pmsmtool.drive.port import Excitation, Injection, Shape
from pmsmtool.errors import (
    DriveFault,
    Interrupted,
    LimitExceeded,
    PmsmtoolError,
    SafetyRefusal,
    StopNotConfirmed,
    VerifyMismatch,
)
from tests.drive.bench import ENVELOPE, SimBench, sim_bench

INTERRUPTIONS = 50
DECELERATION = objects.QUICK_STOP_DECELERATION
RUNNING = {
    "motor.pole_pairs": 3,
    "encoder.offset_rad": 0.35,
    "motor.psi_f_wb": 0.545,
    "speed.K_p_nms_per_rad": 0.05,
    "speed.K_i_nm_per_rad": 0.5,
}
"""What the profile's machine needs to run; a drive fresh from the factory does not know it."""
STIFF = {"speed.K_p_nms_per_rad": 0.5, "speed.K_i_nm_per_rad": 2.0}
"""A speed loop that keeps a speed within 0.5 s; the one above swings by half of it for six seconds."""


@pytest.fixture
def bench() -> Iterator[SimBench]:
    with sim_bench() as opened:
        yield opened


def experiment(guard: GuardedDrive) -> None:
    """A short experiment that touches everything: parameters, set-points, excitation, recorder, averages."""
    guard.write({"motor.R_s_ohm": 2.0, "motor.L_d_h": 0.02})
    guard.enable()
    guard.command_current(1.0, 0.0, fixed_angle_rad=0.5)
    guard.wait(0.1)
    guard.average(["i_d_a", "u_d_v"], 500)
    square = Excitation(Shape.SQUARE, Injection.U_D, 4.0, bias_d_a=1.0, bias_bandwidth_rad_s=94.0, hold_periods=6)
    guard.record(["i_d_a", "i_q_a", "u_d_v"], 512, excitation=square)
    noise = Excitation(Shape.BUFFER, Injection.U_D, 1.0, buffer=[0.5, -0.5] * 20)
    guard.record(["i_d_a"], 256, excitation=noise)


def test_everything_an_experiment_changed_is_restored(bench: SimBench) -> None:
    bench.drive.node.sdo.download(0x1020, 1, (15000).to_bytes(4, "little"))
    before = bench.memory()
    said: list[str] = []
    with guarded(bench.drive, ENVELOPE, say=said.append) as guard:
        experiment(guard)
        assert bench.memory() != before
    assert bench.memory() == before
    assert bench.drive.node.state() is State.SWITCH_ON_DISABLED
    assert "drive restored" in said[-1]


def test_failure_in_the_experiment_stops_and_restores(bench: SimBench) -> None:
    before = bench.memory()
    with pytest.raises(ZeroDivisionError), guarded(bench.drive, ENVELOPE) as guard:
        experiment(guard)
        raise ZeroDivisionError
    assert bench.memory() == before and bench.drive.node.state() is State.SWITCH_ON_DISABLED


def test_envelope_reaches_the_drive_itself(bench: SimBench) -> None:
    with guarded(bench.drive, Envelope(i_max_apk=2.0, speed_max_rad_s=50.0)):
        limits = {key: bench.session.dictionary[f"cia402.{key}"].number() for key in ("max_current", "max_speed")}
    rated_apk = 1e-3 * bench.session.dictionary["cia402.rated_current"].number() * math.sqrt(2.0)
    assert 2.0 <= limits["max_current"] / 1000.0 * rated_apk < 2.0 + 0.002 * rated_apk
    assert limits["max_speed"] == math.ceil(50.0 * 60.0 / (2.0 * math.pi))


def test_a_shaft_said_to_be_locked_is_not_turned(bench: SimBench) -> None:
    locked = replace(ENVELOPE, shaft="locked")
    with pytest.raises(SafetyRefusal, match="--shaft locked is given"), guarded(bench.drive, locked) as guard:
        guard.enable()
        guard.command_speed(5.0)
    assert bench.drive.node.state() is State.SWITCH_ON_DISABLED


def test_a_shaft_that_turns_though_said_to_be_locked_is_stopped(bench: SimBench) -> None:
    locked = replace(ENVELOPE, shaft="locked", travel_rad=math.inf)
    with pytest.raises(LimitExceeded, match="travel") as caught, guarded(bench.drive, locked) as guard:
        guard.enable()
        for angle in np.arange(0.0, 12.0, 0.2):  # a vector that turns takes the free rotor with it
            guard.command_current(2.0, 0.0, fixed_angle_rad=float(angle))
            guard.wait(0.05)
    assert bench.drive.node.state() is State.SWITCH_ON_DISABLED
    assert "--shaft locked is given" in caught.value.likely and "clamp the shaft" in caught.value.hint


@pytest.mark.parametrize("moment", range(INTERRUPTIONS))
def test_ctrl_c_at_any_moment_ends_stopped_and_restored(bench: SimBench, moment: int) -> None:
    before = bench.memory()
    when = random.Random(moment).uniform(0.0, 1.6)
    bench.bus.clock.after(when, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(Interrupted) as caught, guarded(bench.drive, ENVELOPE) as guard:
        experiment(guard)
        guard.wait(10.0)
    assert caught.value.exit_code == 130
    assert bench.session.power.state is State.SWITCH_ON_DISABLED
    assert bench.memory() == before


@pytest.mark.parametrize("moment", range(8))
def test_second_ctrl_c_while_stopping_still_ends_confirmed(bench: SimBench, moment: int) -> None:
    before = bench.memory()
    for delay in (0.9, 0.9005 + 0.0007 * moment):
        bench.bus.clock.after(delay, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises((Interrupted, KeyboardInterrupt)), guarded(bench.drive, ENVELOPE) as guard:
        experiment(guard)
        guard.wait(10.0)
    assert bench.session.power.state is State.SWITCH_ON_DISABLED
    assert bench.memory() == before


def test_ctrl_c_while_an_experiment_stops_ends_it(bench: SimBench) -> None:
    """`map learn` stops ten times; a Ctrl-C then was lost, and it went on to its end (exit code 0)."""
    with pytest.raises(Interrupted), guarded(bench.drive, ENVELOPE) as guard:
        guard.enable()
        bench.bus.clock.after(1e-4, lambda: signal.raise_signal(signal.SIGINT))
        guard.quick_stop()
        pytest.fail("the experiment went on")
    assert bench.session.power.state is State.SWITCH_ON_DISABLED


def test_second_ctrl_c_removes_the_voltage_at_once(bench: SimBench) -> None:
    """A quick stop ramp of seconds is cut short."""
    with guarded(bench.drive, Envelope(i_max_apk=5.0, speed_max_rad_s=150.0)) as guard:
        bench.drive.node.put(DECELERATION, 60)
        guard.write({**RUNNING, **STIFF})
        guard.enable()
        guard.command_speed(80.0)
        guard.wait(4.0)
        assert guard.live("omega_e_rad_s") > 200.0 and bench.drive.stops_by_ramp
        started = bench.bus.clock.now()
        bench.bus.clock.after(0.1, lambda: signal.raise_signal(signal.SIGINT))
        guard.stop()
        assert 0.1 <= bench.bus.clock.now() - started < 0.2
    assert bench.session.power.state is State.SWITCH_ON_DISABLED


def test_a_kept_speed_proves_the_ramp_and_a_new_parameter_takes_that_back(bench: SimBench) -> None:
    """A stop removes the voltage until commanded speeds were kept; the ramp takes longer than no ramp."""
    option = bench.session.dictionary["cia402.quick_stop"]
    before, states = option.number(), []
    bench.session.power.on_state = lambda: states.append(bench.session.power.state)
    for proven in (False, True):
        with guarded(bench.drive, Envelope(i_max_apk=5.0, speed_max_rad_s=150.0)) as guard:
            guard.write({**RUNNING, **STIFF})
            guard.enable()
            guard.command_speed(40.0)
            guard.wait(1.5 if proven else 0.4)
            assert bench.drive.stops_by_ramp is proven and option.number() == (before if proven else 0)
            states.clear()
            guard.stop()
            assert (State.QUICK_STOP_ACTIVE in states) is proven
            guard.write({"speed.K_p_nms_per_rad": 0.06})
            assert not bench.drive.stops_by_ramp and option.number() == 0
        assert bench.drive.stops_by_ramp and option.number() == before


@pytest.mark.chain
@pytest.mark.parametrize("moment", [0.8, 0.95, 1.1])
def test_pulled_cable_is_exit_8_and_says_what_to_do(bench: SimBench, moment: float) -> None:
    def unplug() -> None:
        bench.simulated.plugged = False

    bench.bus.clock.after(moment, unplug)
    with pytest.raises(StopNotConfirmed) as caught, guarded(bench.drive, ENVELOPE) as guard:
        experiment(guard)
        guard.wait(10.0)
    assert caught.value.exit_code == 8 and "hardware stop" in str(caught.value)


@pytest.mark.chain
def test_drive_behind_a_pulled_cable_stops_by_itself(bench: SimBench) -> None:
    """The dead-man at work: the tool is cut off, the drive leaves operation in the declared time."""

    def unplug() -> None:
        bench.simulated.plugged = False

    bench.bus.clock.after(1.0, unplug)
    with pytest.raises(StopNotConfirmed), guarded(bench.drive, ENVELOPE) as guard:
        experiment(guard)
        guard.wait(10.0)
    assert bench.session.power.state is not State.OPERATION_ENABLED


def test_unreachable_before_anything_was_enabled_is_a_bus_error(bench: SimBench) -> None:
    bench.simulated.plugged = False
    with pytest.raises(PmsmtoolError) as caught, guarded(bench.drive, ENVELOPE):
        pass
    assert caught.value.exit_code == 3


def test_speed_beyond_the_envelope_stops(bench: SimBench) -> None:
    with pytest.raises(LimitExceeded, match="speed") as caught, guarded(bench.drive, Envelope(5.0, 20.0)) as guard:
        guard.write(RUNNING)
        guard.enable()
        bench.drive.node.put(objects.MAX_SPEED_RPM, 100000)  # the drive's own limit is out of the way
        bench.drive.command_speed(60.0)
        guard.wait(5.0)
    assert caught.value.exit_code == 5
    assert bench.session.power.state is State.SWITCH_ON_DISABLED


def test_current_beyond_the_envelope_stops(bench: SimBench) -> None:
    with pytest.raises(LimitExceeded, match="current") as caught, guarded(bench.drive, Envelope(3.0, 100.0)) as guard:
        guard.enable()
        bench.drive.node.put(objects.MAX_CURRENT_PERMILLE, 2000)  # the drive's own limit is out of the way
        bench.drive.command_current(-2.8, 2.8, fixed_angle_rad=0.0)
        guard.wait(1.0)
    assert caught.value.exit_code == 5
    assert bench.session.power.state is State.SWITCH_ON_DISABLED


def test_a_d_current_beyond_the_magnets_limit_is_refused_before_it_flows(bench: SimBench) -> None:
    """In the frame of the rotor only: of a vector that is held in space the rotor turns away."""
    pulses = Excitation(Shape.HYSTERESIS, Injection.U_D, 20.0, i_limit_d_a=2.1, i_limit_q_a=1.0, duration_s=0.01)
    with guarded(bench.drive, Envelope(5.0, 20.0, i_d_max_apk=2.0)) as guard:
        guard.enable()
        guard.command_current(2.1, 0.0, fixed_angle_rad=0.0)
        guard.command_current(-1.9, 0.0)
        for asked in (lambda: guard.command_current(-2.1, 0.0), lambda: guard.record(["i_d_a"], 64, excitation=pulses)):
            with pytest.raises(LimitExceeded, match="d current") as caught:
                asked()
            assert "i_d_min_apk" in caught.value.hint


def test_a_vector_that_turns_between_two_reads_is_no_excess(bench: SimBench, monkeypatch: pytest.MonkeyPatch) -> None:
    """i_d and i_q are two objects; a slow host reads one before, one after a turn by 90 degree."""
    read = bench.drive.live
    seen: dict[str, list[float]] = {"i_d_a": [], "i_q_a": []}

    def slowly(name: str) -> float:
        if name == "i_q_a":
            bench.drive.command_current(0.0, 2.9, fixed_angle_rad=0.0)
            for _ in range(20):  # a second, in which the tool asks often enough to be alive
                bench.drive.wait(0.5 * FRESH_S)
                bench.drive.node.state()
        value = read(name)
        seen.get(name, []).append(value)
        return value

    with guarded(bench.drive, ENVELOPE) as guard:
        guard.enable()
        guard.command_current(-2.9, 0.0, fixed_angle_rad=0.0)
        guard.wait(1.0)
        monkeypatch.setattr(bench.drive, "live", slowly)
        guard.wait(0.0)
        monkeypatch.undo()
    assert math.hypot(seen["i_d_a"][0], seen["i_q_a"][0]) > OVERSHOOT * ENVELOPE.i_max_apk, "the trap was set"


@pytest.mark.parametrize(
    ("envelope", "quantity"),
    [
        (Envelope(3.0, 100.0, duration_s=0.5), "time energised"),
        (Envelope(3.0, 100.0, energy_j=1.0), "energy"),
        (Envelope(3.0, 100.0, travel_rad=0.01), "travel"),
    ],
)
def test_budgets_end_an_experiment(bench: SimBench, envelope: Envelope, quantity: str) -> None:
    with pytest.raises(LimitExceeded, match=quantity) as caught, guarded(bench.drive, envelope) as guard:
        assert guard.energy_j == guard.energised_s == 0.0, "nothing is counted before it is energised"
        guard.write({"motor.R_s_ohm": 3.6})
        guard.enable()
        for angle in range(100):
            guard.command_current(2.5, 0.0, fixed_angle_rad=0.3 * angle)
            guard.wait(0.1)
    assert "locked" not in caught.value.likely, "the shaft may turn"
    assert bench.session.power.state is State.SWITCH_ON_DISABLED


def test_excitation_that_leaves_its_limits_is_a_fault_and_stopped(bench: SimBench) -> None:
    with pytest.raises(DriveFault, match="abort limit"), guarded(bench.drive, ENVELOPE) as guard:
        guard.enable()
        guard.record(["i_d_a"], 2000, excitation=Excitation(Shape.DC, Injection.U_D, 100.0, fixed_angle_rad=0.0))
    assert not bench.session.power.state.energised
    bench.drive.node.reset_fault()


def test_gravity_load_is_refused_before_anything_is_sent(bench: SimBench) -> None:
    before = bench.bus.line.frames
    with pytest.raises(SafetyRefusal, match="gravity"), guarded(bench.drive, Envelope(3.0, 100.0, load="gravity")):
        pass
    assert bench.bus.line.frames == before
    Envelope(3.0, 100.0, load="gravity", shaft="locked").refuse_gravity()


def test_drive_that_somebody_else_enabled_is_left_alone(bench: SimBench) -> None:
    bench.drive.node.enable()
    with pytest.raises(SafetyRefusal, match="another program"), guarded(bench.drive, ENVELOPE):
        pass
    assert bench.session.power.state is State.OPERATION_ENABLED


def test_nothing_is_enabled_without_the_proof(bench: SimBench) -> None:
    with pytest.raises(SafetyRefusal, match="not tested"), guarded(bench.drive, ENVELOPE, prove=False) as guard:
        guard.enable()


def test_object_that_refuses_its_old_value_is_named(bench: SimBench) -> None:
    with pytest.raises(VerifyMismatch, match="0x6085:00") as caught, guarded(bench.drive, ENVELOPE):
        bench.drive.node.put(DECELERATION, 60)
        entry = bench.session.dictionary["cia402.quick_stop_deceleration"]
        entry.sink = lambda data: None
    assert "reset the drive" in caught.value.hint


def test_node_that_boots_in_the_middle_ends_the_experiment_stopped(bench: SimBench) -> None:
    bench.bus.clock.after(1.0, bench.simulated.reset)
    with pytest.raises(PmsmtoolError, match="was reset") as caught, guarded(bench.drive, ENVELOPE) as guard:
        experiment(guard)
        guard.wait(10.0)
    assert caught.value.exit_code == 3 and bench.session.power.state is State.SWITCH_ON_DISABLED


@pytest.mark.parametrize("measure", ["average", "record"])
def test_what_a_stopped_machine_shows_is_no_measurement(bench: SimBench, measure: str) -> None:
    """The tool's heartbeat stays away and the drive stops by itself: a mean of 0 A would be a wrong number."""
    with pytest.raises(DriveFault, match="left operation|in fault"), guarded(bench.drive, ENVELOPE) as guard:
        guard.enable()
        guard.command_current(2.0, 0.0, fixed_angle_rad=0.0)
        guard.wait(0.05)
        assert guard.average(["i_d_a"], 100)["i_d_a"] > 1.0, "the current flows"
        guard._heartbeat.stop()
        guard.wait(1.0)
        if measure == "average":
            guard.average(["i_d_a"], 100)
        else:
            guard.record(["i_d_a"], 100)


class InterruptAtBytecode:
    """Ctrl-C at the n-th bytecode after :meth:`arm`, in whatever frame of this package, these tests or contextlib."""

    def __init__(self, number: int) -> None:
        self.left = number

    def arm(self) -> None:
        frame = sys._getframe(1)
        while frame is not None:
            frame.f_trace, frame.f_trace_opcodes = self.trace, True
            frame = frame.f_back
        sys.settrace(self.trace)

    def trace(self, frame: FrameType, event: str, argument: object) -> Any:
        frame.f_trace_opcodes = True
        if event == "opcode":
            self.left -= 1
            if self.left < 0:
                sys.settrace(None)
                raise KeyboardInterrupt
        return self.trace


@pytest.mark.parametrize("number", range(24))
def test_ctrl_c_between_the_guard_and_its_block_restores_too(number: int) -> None:
    """A `with` statement that is interrupted before its block has begun calls no exit: closing the bus has to do it."""
    said: list[str] = []
    moment = InterruptAtBytecode(number)

    def say(text: str) -> None:
        said.append(text)
        if text.startswith("supervision"):
            moment.arm()

    bench = None
    try:
        with pytest.raises((Interrupted, KeyboardInterrupt)), sim_bench() as bench:
            before = bench.memory()
            with guarded(bench.drive, ENVELOPE, say=say) as guard:
                guard.enable()
                guard.wait(10.0)
    finally:
        sys.settrace(None)
    assert bench is not None and moment.left < 0, "the interrupt came"
    assert bench.session.power.state is State.SWITCH_ON_DISABLED
    assert bench.memory() == before
    assert sum(RESTORED in text for text in said) == 1
