# SPDX-License-Identifier: MIT
"""The CiA 402 state machine, modes and references on SDO frames."""

from __future__ import annotations

import math

import pytest

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.cia402 import Command, Mode, State, command_towards_enabled, error_text, state_of
from pmsmtool.sim.node.drive_core import ControlMode
from tests.node.bench import Bench
from tests.node.raw_client import Aborted

RPM = 2.0 * math.pi / 60.0


def control(bench: Bench, word: int) -> None:
    bench.client.put(0x6040, 0, word, "H")


def state(bench: Bench) -> State | None:
    return state_of(int(bench.client.number(0x6041, 0, "H")))


def enable(bench: Bench, mode: Mode = Mode.NONE) -> None:
    bench.client.put(0x6060, 0, mode, "b")
    for word in (Command.SHUTDOWN, Command.SWITCH_ON, Command.ENABLE_OPERATION):
        control(bench, word)


def test_the_tool_side_path_leads_to_operation_enabled(bench: Bench) -> None:
    seen = []
    while (found := state(bench)) is not State.OPERATION_ENABLED:
        assert found is not None
        seen.append(found)
        command = command_towards_enabled(found)
        assert command is not None
        control(bench, command)
    assert seen == [State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON, State.SWITCHED_ON]
    assert command_towards_enabled(State.OPERATION_ENABLED) is None
    assert command_towards_enabled(State.FAULT) is None


_S, _R, _W, _O = (
    State.SWITCH_ON_DISABLED,
    State.READY_TO_SWITCH_ON,
    State.SWITCHED_ON,
    State.OPERATION_ENABLED,
)
_PATHS = {_S: (), _R: (0x06,), _W: (0x06, 0x07), _O: (0x06, 0x07, 0x0F)}
# Rows: state; columns: controlword 0x00 disable voltage, 0x02 quick stop, 0x06 shutdown, 0x07 switch on, 0x0F enable.
_TABLE = {
    _S: (_S, _S, _R, _S, _S),
    _R: (_S, _S, _R, _W, _O),
    _W: (_S, _S, _R, _W, _O),
    _O: (_S, None, _R, _W, _O),
}


@pytest.mark.parametrize("start", list(_TABLE))
def test_every_transition_of_the_standard_table(bench: Bench, start: State) -> None:
    for word, target in zip((0x00, 0x02, 0x06, 0x07, 0x0F), _TABLE[start], strict=True):
        control(bench, 0)
        for step in _PATHS[start]:
            control(bench, step)
        assert state(bench) is start
        control(bench, word)
        assert state(bench) is (State.QUICK_STOP_ACTIVE if target is None else target)
        bench.wait(0.1)


@pytest.mark.parametrize("word", range(0, 0x100, 1))
def test_statusword_patterns_decode_as_the_standard_says(word: int) -> None:
    found = state_of(word)
    patterns = {
        0x00: (0x4F, State.NOT_READY_TO_SWITCH_ON),
        0x40: (0x4F, State.SWITCH_ON_DISABLED),
        0x21: (0x6F, State.READY_TO_SWITCH_ON),
        0x23: (0x6F, State.SWITCHED_ON),
        0x27: (0x6F, State.OPERATION_ENABLED),
        0x07: (0x6F, State.QUICK_STOP_ACTIVE),
        0x0F: (0x4F, State.FAULT_REACTION_ACTIVE),
        0x08: (0x4F, State.FAULT),
    }
    matches = [expected for pattern, (mask, expected) in patterns.items() if word & mask == pattern]
    assert found is (matches[0] if matches else None)


def test_gates_are_on_only_in_operation_enabled(bench: Bench) -> None:
    modes = []
    for word in (0x06, 0x07, 0x0F, 0x00):
        control(bench, word)
        modes.append(bench.core.command_seen.mode)
    assert modes == [ControlMode.OFF, ControlMode.OFF, ControlMode.CURRENT, ControlMode.OFF]


def test_velocity_mode_reaches_its_target_and_quick_stop_brings_it_to_rest(bench: Bench) -> None:
    enable(bench, Mode.PROFILE_VELOCITY)
    bench.client.put(0x60FF, 0, 300_000, "i")
    assert not int(bench.client.number(0x6041, 0, "H")) & 0x400
    bench.wait(0.2)
    assert bench.core.omega == pytest.approx(300 * RPM, rel=1e-3)
    assert bench.client.number(0x606C, 0, "i") == pytest.approx(300_000, rel=1e-3)
    assert int(bench.client.number(0x6041, 0, "H")) & 0x400
    control(bench, Command.QUICK_STOP)
    assert state(bench) is State.QUICK_STOP_ACTIVE
    bench.wait(0.2)
    assert state(bench) is State.SWITCH_ON_DISABLED
    assert abs(bench.core.omega) < 3 * RPM


def turning(bench: Bench, mode: Mode, gain: float, option: int, slope_rpm_s: int) -> float:
    """Quick-stop from 300 rpm in a mode and return the time until the gates were off (s)."""
    bench.client.put(0x2021, 1, gain, "f")
    bench.client.put(0x605A, 0, option, "h")
    bench.client.put(0x6085, 0, slope_rpm_s)
    enable(bench, mode)
    bench.core.omega = 300 * RPM
    started = bench.bus.clock.now()
    control(bench, Command.QUICK_STOP)
    while state(bench) is State.QUICK_STOP_ACTIVE:
        bench.wait(0.001)
    assert state(bench) is State.SWITCH_ON_DISABLED
    return bench.bus.clock.now() - started


@pytest.mark.parametrize("mode", [Mode.PROFILE_TORQUE, Mode.CYCLIC_TORQUE, Mode.PROFILE_VELOCITY])
def test_quick_stop_brakes_a_turning_machine_by_the_ramp(bench: Bench, mode: Mode) -> None:
    """300 rpm at 600 rpm/s: 0.5 s."""
    assert turning(bench, mode, 0.1, 2, 600) == pytest.approx(0.5, abs=0.02)
    assert abs(bench.core.omega) < 3 * RPM


@pytest.mark.parametrize(("gain", "option"), [(0.0, 2), (0.1, 3)])
def test_quick_stop_brakes_at_the_limit_without_a_tuned_speed_controller_or_when_asked(
    bench: Bench, gain: float, option: int
) -> None:
    """The simple machine brakes with 400 rad/s2 at most: 0.08 s."""
    assert turning(bench, Mode.PROFILE_TORQUE, gain, option, 600) == pytest.approx(0.08, abs=0.01)
    assert abs(bench.core.omega) < 3 * RPM


def test_quick_stop_in_identification_only_takes_the_current_away(bench: Bench) -> None:
    bench.client.put(0x2052, 1, 5.0, "f")
    assert turning(bench, Mode.IDENTIFICATION, 0.1, 2, 600) < 0.02
    assert bench.core.omega > 250 * RPM


def test_a_mode_written_during_a_stop_does_not_change_how_it_ends(bench: Bench) -> None:
    bench.client.put(0x2021, 1, 0.1, "f")
    bench.client.put(0x6085, 0, 600)
    enable(bench, Mode.PROFILE_VELOCITY)
    bench.core.omega = 300 * RPM
    control(bench, Command.QUICK_STOP)
    bench.client.put(0x6060, 0, Mode.IDENTIFICATION, "b")
    bench.wait(0.3)
    assert state(bench) is State.QUICK_STOP_ACTIVE
    bench.wait(0.3)
    assert state(bench) is State.SWITCH_ON_DISABLED
    assert abs(bench.core.omega) < 3 * RPM


def test_a_stop_that_does_not_succeed_ends_without_current_after_its_time(bench: Bench) -> None:
    """Ramp of 0.03 s, 1.5 times that and 0.5 s: a machine that something else drives is let go."""
    bench.client.put(0x2021, 1, 0.1, "f")
    enable(bench, Mode.PROFILE_VELOCITY)
    bench.core.omega = 300 * RPM
    bench.core.driven = True
    control(bench, Command.QUICK_STOP)
    bench.wait(0.5)
    assert state(bench) is State.QUICK_STOP_ACTIVE
    bench.wait(0.1)
    assert state(bench) is State.SWITCH_ON_DISABLED
    assert bench.core.command_seen.mode is ControlMode.OFF


def test_quick_stop_that_stays_can_be_resumed(bench: Bench) -> None:
    bench.client.put(0x605A, 0, 6, "h")
    enable(bench, Mode.PROFILE_VELOCITY)
    control(bench, Command.QUICK_STOP)
    bench.wait(0.5)
    assert state(bench) is State.QUICK_STOP_ACTIVE
    assert bench.core.command_seen.mode is ControlMode.OFF
    control(bench, Command.ENABLE_OPERATION)
    assert state(bench) is State.OPERATION_ENABLED


def test_quick_stop_disabled_drops_the_voltage_at_once(bench: Bench) -> None:
    bench.client.put(0x605A, 0, 0, "h")
    enable(bench)
    control(bench, Command.QUICK_STOP)
    assert state(bench) is State.SWITCH_ON_DISABLED
    with pytest.raises(Aborted) as caught:
        bench.client.put(0x605A, 0, 4, "h")
    assert caught.value.code == AbortCode.VALUE


def test_torque_mode_follows_target_offset_limit_and_slope(bench: Bench) -> None:
    client = bench.client
    enable(bench, Mode.PROFILE_TORQUE)
    client.put(0x6071, 0, 500, "h")
    assert bench.core.command_seen.torque_nm == pytest.approx(4.0)
    client.put(0x60B2, 0, 100, "h")
    assert client.number(0x6074, 0, "h") == 600
    client.put(0x6072, 0, 550, "H")
    assert bench.core.command_seen.torque_nm == pytest.approx(4.4)
    client.put(0x6087, 0, 1000)
    client.put(0x6071, 0, -500, "h")
    bench.wait(0.1)
    assert client.number(0x6074, 0, "h") == pytest.approx(450, abs=3)
    bench.wait(1.5)
    assert client.number(0x6074, 0, "h") == -400
    assert int(client.number(0x6041, 0, "H")) & 0x400


def test_set_point_of_the_identification_mode(bench: Bench) -> None:
    client = bench.client
    client.put(0x2052, 1, 3.0, "f")
    client.put(0x2052, 2, -2.0, "f")
    client.put(0x2052, 3, 1.5, "f")
    enable(bench, Mode.IDENTIFICATION)
    seen = bench.core.command_seen
    assert (seen.mode, seen.i_d_a, seen.i_q_a, seen.fixed_angle_rad) == (ControlMode.CURRENT, 3.0, -2.0, 1.5)
    client.put(0x2052, 3, math.nan, "f")
    assert math.isnan(bench.core.command_seen.fixed_angle_rad)
    control(bench, 0x10F)
    assert bench.core.command_seen.i_d_a == 0.0
    control(bench, 0x00F)
    assert bench.core.command_seen.i_d_a == 3.0


def test_unknown_modes_are_refused_and_position_before_it_is_tuned(bench: Bench) -> None:
    for mode, code in (
        (2, AbortCode.VALUE),
        (5, AbortCode.VALUE),
        (6, AbortCode.DEVICE_STATE),
        (1, AbortCode.DEVICE_STATE),
    ):
        with pytest.raises(Aborted) as caught:
            bench.client.put(0x6060, 0, mode, "b")
        assert caught.value.code == code
    assert bench.client.number(0x6061, 0, "b") == 0
    supported = {bit for bit in range(32) if int(bench.client.number(0x6502)) >> bit & 1}
    assert supported == {0, 2, 3, 5, 6, 7, 8, 9, 16}
    bench.client.put(0x2022, 1, 20.0, "f")
    bench.client.put(0x6060, 0, 1, "b")


def test_a_trip_is_a_fault_with_code_register_and_emergency_at_its_time(bench: Bench) -> None:
    enable(bench)
    bench.core.trip_at[bench.core.periods + 1234] = 0x2310
    started = bench.bus.clock.now()
    found = [message for message in bench.listen(1.0) if message.arbitration_id == 0x081]
    assert [bytes(message.data) for message in found] == [bytes.fromhex("1023030000000000")]
    assert found[0].timestamp - started == pytest.approx(0.1234, abs=0.0015)
    assert state(bench) is State.FAULT
    assert bench.client.number(0x603F, 0, "H") == 0x2310
    assert bench.client.number(0x1001, 0, "B") == 3
    assert bench.core.command_seen.mode is ControlMode.OFF


def test_fault_reset_needs_a_rising_edge_and_a_cause_that_is_gone(bench: Bench) -> None:
    enable(bench)
    bench.core.persistent_trip = 0x3210
    bench.wait(0.05)
    assert state(bench) is State.FAULT
    control(bench, Command.FAULT_RESET)
    assert state(bench) is State.FAULT
    bench.core.persistent_trip = 0
    control(bench, Command.FAULT_RESET)
    assert state(bench) is State.FAULT
    control(bench, 0)
    control(bench, Command.FAULT_RESET)
    assert state(bench) is State.SWITCH_ON_DISABLED
    assert bench.client.number(0x603F, 0, "H") == 0
    assert bench.client.heard(0x081)[-1] == bytes(8)


def test_actual_values_are_scaled_by_the_ratings(bench: Bench) -> None:
    client = bench.client
    client.put(0x2052, 2, 10.0 * math.sqrt(2.0), "f")
    enable(bench, Mode.IDENTIFICATION)
    bench.wait(0.05)
    assert client.number(0x6078, 0, "h") == pytest.approx(1000, abs=1)
    assert client.number(0x6077, 0, "h") == pytest.approx(0.4 * 10.0 * math.sqrt(2.0) / 8.0 * 1000, abs=1)
    assert client.number(0x6079) == 300_000
    assert client.number(0x608F, 1) == 4096


def test_limits_reach_the_core_but_not_the_parameter_set(bench: Bench) -> None:
    client = bench.client
    before = client.number(0x2000, 3)
    client.put(0x6073, 0, 2000, "H")
    client.put(0x6080, 0, 500)
    assert bench.core.parameters is not None
    assert bench.core.parameters.get("motor.I_max_apk") == pytest.approx(20.0 * math.sqrt(2.0))
    assert bench.core.parameters.get("motor.n_max_rpm") == 500
    assert client.number(0x2010, 6, "f") == 56
    assert client.number(0x2000, 3) == before


def test_error_texts_fall_back_to_their_group() -> None:
    assert error_text(0x2310) == "continuous over-current at the output"
    assert error_text(0x2340) == "current, device output side"
    assert error_text(0x4210) == "device temperature"
    assert error_text(0xFFAA) == "manufacturer-specific error"
