# SPDX-License-Identifier: MIT
"""The kernel as the node sees it: modes, excitation, recorder, averages, trips, early returns."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.drive.port import Excitation, Injection, Shape
from pmsmtool.errors import ConfigError
from pmsmtool.files import data_folder
from pmsmtool.firmware.image import pack_image
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.sim.drive_kernel import IDEAL_ENCODER_COUNTS, KernelCore, create
from pmsmtool.sim.kernel import Signal, Truth
from pmsmtool.sim.node.drive_core import (
    AverageState,
    Command,
    ControlMode,
    DriveCore,
    ExcitationState,
    RecorderSetup,
    RecorderState,
    Trigger,
)
from pmsmtool.sim.simulate import find_drive
from pmsmtool.sim.simulated_machine import with_simulation

QUIET = {"sensor_noise_apk": 0.0, "thermal_on": False}


def image(**changes: float) -> bytes:
    values = dict(find_drive("interior-2k2").params.values)
    return pack_image(values | {name.replace("__", "."): value for name, value in changes.items()})


def open_core(seed: int = 0, **simulation: object) -> KernelCore:
    machine_file = load_machine_file(data_folder("profiles") / "interior-2k2.toml")
    core = create(with_simulation(machine_file, {**QUIET, **simulation}), seed)
    core.load(image())
    return core


def run(core: DriveCore, periods: int) -> None:
    left = periods
    while left:
        left -= core.run(left)


def test_protocol_facts():
    core = open_core()
    assert core.period_ns == 83333
    assert core.encoder_counts == 1 << 17
    assert open_core(encoder_bits=0).encoder_counts == IDEAL_ENCODER_COUNTS
    core.load(image(inverter__T_s_ns=50_000))
    assert core.period_ns == 50_000
    before = core.simulation.time_ns
    assert core.run(10) == 10
    assert core.simulation.time_ns - before == 500_000


def test_refuses_a_broken_image_and_keeps_the_old_one():
    core = open_core()
    with pytest.raises(ConfigError, match="refuses"):
        core.load(b"\0" * 12)
    assert core.period_ns == 83333


def test_current_mode_in_the_rotor_and_in_a_fixed_frame():
    core = open_core(rotor="locked")
    core.command(Command(ControlMode.CURRENT, i_d_a=2.0, i_q_a=3.0))
    run(core, 2000)
    assert core.signal(Signal.I_D) == pytest.approx(2.0, abs=0.02)
    assert core.signal(Signal.I_Q) == pytest.approx(3.0, abs=0.02)
    core.command(Command(ControlMode.CURRENT, i_d_a=4.0, fixed_angle_rad=math.pi / 2.0))
    run(core, 2000)
    assert core.signal(Signal.THETA_E) == pytest.approx(math.pi / 2.0, abs=1e-5)
    vector = [core.simulation.signal(signal) for signal in (Truth.I_A, Truth.I_B, Truth.I_C)]
    assert vector == pytest.approx(
        [0.0, 4.0 * math.sin(math.pi / 3.0 * 2.0), -4.0 * math.sin(math.pi / 3.0 * 2.0)], abs=0.03
    )


def test_off_removes_the_gates_at_once():
    core = open_core(rotor="locked")
    core.command(Command(ControlMode.CURRENT, i_q_a=5.0))
    run(core, 2000)
    core.command(Command())
    core.run(1)
    assert core.simulation.signal(Truth.GATES) == 0.0
    falling = core.simulation.signal(Truth.I_Q)
    assert falling < 4.9  # in the very period of the command, through the diodes against the DC link
    run(core, 40)
    assert core.simulation.signal(Truth.I_Q) == pytest.approx(0.0, abs=1e-9)


def test_speed_mode_and_quick_stop():
    core = open_core()
    core.command(Command(ControlMode.SPEED, omega_m_rad_s=80.0))
    run(core, 12_000)
    assert core.simulation.signal(Truth.OMEGA_M) == pytest.approx(80.0, rel=0.02)
    core.command(Command(ControlMode.SPEED, quick_stop=True))
    run(core, 6000)
    assert abs(core.simulation.signal(Truth.OMEGA_M)) < 4.0
    assert core.simulation.signal(Truth.GATES) == 0.0


def square(**changes: object) -> Excitation:
    base = Excitation(
        Shape.SQUARE, Injection.U_D, 20.0, bias_d_a=4.0, bias_bandwidth_rad_s=94.0, hold_periods=6, fixed_angle_rad=0.0
    )
    return replace(base, **changes)  # type: ignore[arg-type]


def test_excitation_runs_changes_and_ends():
    core = open_core(rotor="locked")
    core.command(Command(ControlMode.CURRENT, i_d_a=4.0, fixed_angle_rad=0.0))
    run(core, 3000)
    core.excite(square())
    assert core.excitation_state() is ExcitationState.RUNNING
    assert core.run(100) == 1  # the state changed in this period
    run(core, 600)
    core.record(RecorderSetup([Signal.I_D], 120))
    run(core, 125)
    ripple = np.ptp(np.frombuffer(core.recording(), "<f4"))
    core.excite(square(amplitude=40.0))
    assert core.run(100) == 100  # still running: nothing to report
    run(core, 600)
    core.record(RecorderSetup([Signal.I_D], 120))
    run(core, 125)
    assert np.ptp(np.frombuffer(core.recording(), "<f4")) == pytest.approx(2.0 * ripple, rel=0.1)
    core.excite(None)
    assert core.excitation_state() is ExcitationState.IDLE
    core.run(1)
    assert core.excitation_state() is ExcitationState.IDLE


def test_excitation_ends_after_its_duration_with_an_early_return():
    core = open_core(rotor="locked")
    core.command(Command(ControlMode.CURRENT, fixed_angle_rad=0.0))
    core.run(10)
    core.excite(square(duration_s=0.01))
    assert core.run(1000) == 1
    ran = core.run(1000)
    assert core.excitation_state() is ExcitationState.DONE
    assert ran == pytest.approx(120, abs=2)


def test_excitation_aborts_at_its_current_limit():
    core = open_core(rotor="locked")
    core.command(Command(ControlMode.CURRENT, fixed_angle_rad=0.0))
    core.run(10)
    core.excite(square(amplitude=200.0, bias_d_a=0.0, bias_bandwidth_rad_s=0.0, abort_current_apk=2.0))
    run(core, 200)
    assert core.excitation_state() is ExcitationState.ABORTED
    assert core.simulation.signal(Truth.GATES) == 0.0


def test_buffer_excitation_plays_its_samples():
    core = open_core(rotor="locked")
    core.command(Command(ControlMode.CURRENT, fixed_angle_rad=0.0))
    core.run(10)
    core.record(RecorderSetup([Signal.U_D], 6, trigger=Trigger.EXCITATION_START))
    samples = (1.0, 2.0, 3.0)
    core.excite(Excitation(Shape.BUFFER, Injection.U_D, 0.0, buffer=samples, hold_periods=2, fixed_angle_rad=0.0))
    run(core, 20)
    assert struct.unpack("<6f", core.recording()) == (1.0, 1.0, 2.0, 2.0, 3.0, 3.0)
    assert core.excitation_state() is ExcitationState.DONE
    with pytest.raises(ConfigError, match="do not fit the buffer"):
        core.excite(Excitation(Shape.BUFFER, Injection.U_D, 0.0, buffer=(0.0,) * 5000))


def test_recorder_pretrigger_level_and_early_return():
    core = open_core(rotor="locked")
    core.command(Command(ControlMode.CURRENT, fixed_angle_rad=0.0))
    run(core, 500)
    setup = RecorderSetup([Signal.I_D, Signal.I_D_REF], 50, pretrigger=10, trigger=Trigger.RISING,
                          source=Signal.I_D_REF, level=0.5)  # fmt: skip
    core.record(setup)
    assert core.recorder().state is RecorderState.ARMED
    run(core, 100)
    assert core.recorder().state is RecorderState.ARMED
    core.command(Command(ControlMode.CURRENT, i_d_a=1.0, fixed_angle_rad=0.0))
    assert core.run(1000) == 1
    assert core.recorder().state is RecorderState.TRIGGERED
    assert core.run(1000) == 39
    status = core.recorder()
    assert (status.state, status.stored, status.trigger_position) == (RecorderState.COMPLETE, 50, 10)
    rows = np.frombuffer(core.recording(), "<f4").reshape(50, 2)
    assert not rows[:10, 1].any()
    assert np.all(rows[10:, 1] == 1.0)


def test_recorder_stop_force_and_capacity():
    core = open_core()
    core.record(RecorderSetup([Signal.U_DC], 20, trigger=Trigger.RISING, source=Signal.U_DC, level=1e6))
    core.run(5)
    core.force_trigger()
    run(core, 30)
    assert core.recorder().state is RecorderState.COMPLETE
    core.record(RecorderSetup([Signal.U_DC], 1000))
    run(core, 100)
    core.record(None)
    core.run(1)
    assert core.recorder().state is RecorderState.IDLE
    assert 99 <= core.recorder().stored <= 101
    assert len(core.recording()) == 4 * core.recorder().stored
    with pytest.raises(ConfigError, match="do not fit the recorder"):
        core.record(RecorderSetup([Signal.I_D] * 8, 4096))


def test_averages_over_a_window():
    core = open_core(rotor="locked", sensor_noise_apk=0.05, adc_bits=0)
    core.command(Command(ControlMode.CURRENT, i_d_a=3.0, fixed_angle_rad=0.0))
    run(core, 3000)
    core.average([Signal.I_D, Signal.U_DC], 1600)
    assert core.averages().state is AverageState.RUNNING
    assert core.run(5000) == 1
    assert core.run(5000) == 1599
    result = core.averages()
    assert result.state is AverageState.COMPLETE
    assert result.mean == pytest.approx((3.0, 540.0), abs=0.01)
    # dq noise of three phases: sqrt(2/3) of one phase's, and what the loop makes of it
    assert result.std[0] == pytest.approx(0.05 * math.sqrt(2.0 / 3.0), rel=0.15)
    core.average((), 0)
    core.run(1)
    assert core.averages().state is AverageState.IDLE


def test_overcurrent_trips_with_an_early_return_and_latches():
    core = open_core(rotor="locked")
    core.load(image(protection__i_trip_apk=2.0))
    core.command(Command(ControlMode.CURRENT, i_d_a=5.0, fixed_angle_rad=0.0))
    ran = core.run(1000)
    assert ran < 1000
    assert core.trip() == 0x2310
    assert core.simulation.signal(Truth.GATES) == 0.0
    core.run(50)
    assert core.trip() == 0x2310
    core.command(Command())
    core.run(200)
    core.reset_fault()
    core.run(5)
    assert core.trip() == 0


def test_restart_clears_the_application_but_not_the_rotor():
    core = open_core()
    core.command(Command(ControlMode.SPEED, omega_m_rad_s=60.0))
    run(core, 12_000)
    core.record(RecorderSetup([Signal.I_D], 100))
    core.run(10)
    core.restart()
    assert core.recorder().state is RecorderState.IDLE
    assert core.simulation.signal(Truth.OMEGA_M) > 50.0
    core.run(1)
    assert core.simulation.signal(Truth.GATES) == 0.0
    assert core.period_ns == 83333
    run(core, 2000)
    assert core.trip() == 0
    omega = core.signal(Signal.OMEGA_E) / 3.0
    assert omega == pytest.approx(core.simulation.signal(Truth.OMEGA_M), rel=0.01)  # the estimate found it again


def test_built_in_compensation_survives_every_load():
    core = open_core(compensation="wrong", recorded_voltage="after")
    for _ in range(2):
        core.load(image())
        params = core.simulation.params
        assert params.inverter_deadtime_compensation == 1
        assert params.inverter_V_dead_v == pytest.approx(1.4 * (540.0 * 2e-6 * 12000.0 + 0.8))
        assert params.current_options & 32
    core.restart()
    assert core.simulation.params.inverter_deadtime_compensation == 1


def test_faults_of_the_machine_show_in_the_currents():
    def level(**simulation: object) -> list[float]:
        core = open_core(rotor="locked", **simulation)
        core.command(Command(ControlMode.CURRENT, i_d_a=3.0, fixed_angle_rad=0.0))
        run(core, 3000)
        return [core.simulation.signal(signal) for signal in (Truth.I_A, Truth.I_B, Truth.I_C)]

    assert level() == pytest.approx([3.0, -1.5, -1.5], abs=0.03)
    assert level(drive_fault="not_connected") == [0.0, 0.0, 0.0]
    assert level(phase_open="a") == pytest.approx([0.0, 0.0, 0.0], abs=0.2)
    driven = open_core(rotor="driven", driven_rpm=300.0, drive_fault="encoder_stuck")
    run(driven, 1000)
    assert driven.simulation.signal(Truth.OMEGA_M) == pytest.approx(10.0 * math.pi)
    assert driven.signal(Signal.OMEGA_E) == pytest.approx(0.0, abs=1e-6)


def test_same_seed_same_recording():
    def recording(seed: int) -> bytes:
        core = open_core(seed, sensor_noise_apk=0.02, inverter_model="switched")
        core.command(Command(ControlMode.CURRENT, i_q_a=1.0))
        core.record(RecorderSetup([Signal.I_D, Signal.I_Q, Signal.THETA_M], 400))
        run(core, 500)
        return core.recording()

    assert recording(1) == recording(1) != recording(2)
