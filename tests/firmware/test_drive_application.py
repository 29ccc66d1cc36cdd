# SPDX-License-Identifier: MIT
"""The simulated drive's application around the core: sensors, excitation, recorder, averages, trips, quick stop."""

from __future__ import annotations

import ctypes
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pmsmtool.firmware.core_binding import core
from pmsmtool.firmware.image import pack_image
from pmsmtool.native import load, parse_structs
from pmsmtool.params.catalogue import CATALOGUE
from tests.firmware.linear_plant import LinearPlant

DEFAULTS = {row.name: row.default for row in CATALOGUE}
PACKAGE = Path(__file__).resolve().parents[2] / "pmsmtool"
HEADERS = (PACKAGE / "firmware" / "application" / "pmsm_application.h", PACKAGE / "sim" / "drive.h")
STOP, ARM, START = 0, 1, 2
IDLE, ARMED, RUNNING, DONE, ABORTED = range(5)
(NONE, STEP, SINE, CHIRP, PRBS, BUFFER, SQUARE, DC, HYSTERESIS) = range(9)
U_D, U_Q, I_D, I_Q, SPEED = range(5)
MODE_OFF, MODE_VOLTAGE, MODE_CURRENT, MODE_TORQUE, MODE_SPEED = range(5)
SIGNALS = (
    "NONE",
    "I_D",
    "I_Q",
    "I_D_REQ",
    "I_Q_REQ",
    "I_D_REF",
    "I_Q_REF",
    "U_D",
    "U_Q",
    "U_D_LIM",
    "U_Q_LIM",
    "THETA_E",
    "OMEGA_E",
    "TAU",
    "KAPPA",
    "BINDING",
    "ITERATIONS",
    "FLAGS",
    "I_A",
    "I_B",
    "I_C",
    "U_DC",
    "T_WINDING",
    "T_MAGNET",
    "THETA_M",
)
S = {name: k for k, name in enumerate(SIGNALS)}


def read_encoder(sensors: Any, theta_M: float) -> None:
    """Fill in an unwrapped angle (rad); what is no number is a failed encoder."""
    sensors.encoder_failed = int(not math.isfinite(theta_M))
    if not sensors.encoder_failed:
        parts = round(theta_M / (2 * math.pi) * 2**32)
        sensors.turns, sensors.angle = parts >> 32, parts & 0xFFFFFFFF


class Bench:
    """A drive application with a linear machine at an imposed or free speed."""

    def __init__(self, omega_M: float = 0.0, inertia: float = 0.0, **changes: float) -> None:
        self.values = DEFAULTS | {k.replace("__", "."): v for k, v in changes.items()}
        self.library = load("pmsm_sim")
        self.library.pmsm_application_signal.restype = ctypes.c_float
        self.types = parse_structs("".join(path.read_text(encoding="ascii") for path in HEADERS), core().types)
        self.memory: Any = self.types["pmsm_drive"]()
        self.drive: Any = self.memory.application
        self.output = core().make("pmsm_output")
        self.library.pmsm_drive_init(ctypes.byref(self.memory))
        self.load()
        v = self.values
        self.p = int(v["motor.pole_pairs"])
        self.plant = LinearPlant(
            R=v["motor.R_s_ohm"],
            L_d=v["motor.L_d_h"],
            L_q=v["motor.L_q_h"],
            psi=v["motor.psi_f_wb"],
            T_s=1e-9 * v["inverter.T_s_ns"],
            omega=self.p * omega_M,
        )
        self.inertia, self.omega_M, self.theta_M, self.U_dc = inertia, omega_M, 0.0, 210.0
        self.drive.speed.omega = omega_M
        self.drive.enabled = 1
        self.drive.reference.mode = MODE_CURRENT
        self.sensors = self.types["pmsm_sensors"](T_winding=20.0, T_magnet=21.0)

    def load(self, **changes: float) -> None:
        self.values |= {k.replace("__", "."): v for k, v in changes.items()}
        image = pack_image(self.values)
        assert self.library.pmsm_drive_load(ctypes.byref(self.memory), image, len(image)) == 0

    def run(self, periods: int = 1) -> None:
        for _ in range(periods):
            self.period()

    def period(self) -> None:
        sensors, plant = self.sensors, self.plant
        sensors.i_a, sensors.i_b, sensors.i_c = plant.phases()
        sensors.U_dc = self.U_dc
        read_encoder(sensors, self.theta_M)
        self.library.pmsm_application_period(ctypes.byref(self.drive), ctypes.byref(sensors), ctypes.byref(self.output))
        gates = self.output.gates
        if gates:
            plant.advance(self.output.u_alpha, self.output.u_beta)
        else:  # diodes: the current is gone before the next sample
            plant.i, plant.waiting = np.zeros(2), np.zeros(2)
            plant.theta = math.remainder(plant.theta + plant.omega * plant.T_s, 2 * math.pi)
        if self.inertia:
            torque = 1.5 * self.p * (plant.psi + (plant.L_d - plant.L_q) * plant.i[0]) * plant.i[1]
            self.omega_M += plant.T_s / self.inertia * torque
            plant.omega = self.p * self.omega_M
            plant.transitions.clear()
        self.theta_M += self.omega_M * plant.T_s

    def signal(self, name: str) -> float:
        return float(self.library.pmsm_application_signal(ctypes.byref(self.drive), S[name]))

    def excite(self, command: int = START, **members: float) -> None:
        for name, value in members.items():
            setattr(self.drive.excitation, name, value)
        self.drive.excitation.command = command

    def record(self, *names: str, depth: int, **members: int | float) -> None:
        r = self.drive.recorder
        for k in range(8):
            r.channel[k] = S[names[k]] if k < len(names) else 0
        r.depth, r.decimation, r.pretrigger, r.trigger = depth, 1, 0, 0
        for name, value in members.items():
            setattr(r, name, value)
        r.command = ARM

    def recording(self) -> np.ndarray:
        r = self.drive.recorder
        count = sum(1 for k in range(8) if r.channel[k])
        return np.frombuffer(bytes(self.memory.trace)[: 4 * count * r.stored], dtype="<f4").reshape(r.stored, count)


def test_the_python_mirror_has_the_size_of_the_c_struct() -> None:
    bench = Bench()
    assert ctypes.sizeof(bench.types["pmsm_drive"]) == bench.library.pmsm_drive_size()


def test_signal_names_are_those_of_the_header() -> None:
    text = HEADERS[0].read_text(encoding="ascii")
    names = text.split("PMSM_SIGNAL_NONE = 0,")[1].split("PMSM_SIGNAL_COUNT")[0]
    found = [part.strip() for part in names.replace("/*", ",/*").split(",") if part.strip().startswith("PMSM_SIGNAL_")]
    assert ["NONE", *(name.removeprefix("PMSM_SIGNAL_") for name in found)] == [*SIGNALS]


@pytest.mark.parametrize("speed", [0.0, 65.0, -65.0, 1150.0])
def test_speed_and_angle_follow_the_encoder_without_a_lag(speed: float) -> None:
    bench = Bench(speed, encoder__offset_rad=0.3, protection__n_trip_rpm=20000.0)
    bench.drive.enabled = 0
    bench.drive.speed.omega = 0.9 * speed
    bench.theta_M = 5000.0
    bench.run(600)
    assert bench.drive.speed.omega == pytest.approx(speed, rel=1e-6, abs=1e-8)
    expected = math.remainder(bench.p * (bench.theta_M - speed * bench.plant.T_s) - 0.3, 2 * math.pi)
    assert math.remainder(bench.signal("THETA_E") - expected, 2 * math.pi) == pytest.approx(0, abs=1e-6)
    bench.load(encoder__reversed=1)
    bench.run(900)
    assert bench.drive.speed.omega == pytest.approx(-speed, rel=1e-4, abs=1e-8)


@pytest.mark.parametrize("bandwidth", [600.0, 1e5])
@pytest.mark.parametrize("speed", [0.0, 65.0])
def test_no_parameter_makes_the_speed_estimate_jump(speed: float, bandwidth: float) -> None:
    """Far from zero, the angle jumps by twice of it with the sign; offset, bandwidth, reset move nothing either."""
    bench = Bench(speed, encoder__pll_bandwidth_rad_s=bandwidth)
    bench.drive.enabled = 0
    bench.theta_M = 5000.0
    bench.run(20)
    for change, sign in (
        ({"encoder__reversed": 1}, -1.0),
        ({"encoder__offset_rad": 3.0}, -1.0),
        ({"encoder__pll_bandwidth_rad_s": 0.5 * bandwidth}, -1.0),
        ({"encoder__reversed": 0, "encoder__offset_rad": 0.0}, 1.0),
    ):
        bench.load(**change)
        for _ in range(20):
            bench.run()
            assert bench.drive.speed.omega == pytest.approx(sign * speed, rel=1e-6, abs=1e-6)
    assert bench.drive.trip == 0


def test_the_speed_estimate_survives_a_gap_of_the_encoder() -> None:
    bench = Bench(65.0)
    bench.drive.enabled = 0
    bench.run(20)
    seen, bench.theta_M = bench.theta_M, math.nan
    bench.run(2)
    bench.theta_M = seen + 50.0
    bench.run()
    assert bench.drive.trip == 0x7305 and bench.drive.speed.omega == pytest.approx(65.0)
    bench.library.pmsm_application_reset_fault(ctypes.byref(bench.drive))
    bench.run(20)
    assert bench.drive.trip == 0


def test_window_average_and_its_spread() -> None:
    bench = Bench(30.0)
    bench.drive.reference.i_q_ref = 5.0
    bench.run(1500)
    a = bench.drive.average
    a.signal[0], a.signal[1], a.signal[2] = S["I_Q"], S["U_Q_LIM"], S["U_DC"]
    a.periods, a.command = 400, 1
    bench.run(399)
    assert a.state == 1
    bench.run(1)
    assert a.state == 2
    assert list(a.mean[:3]) == pytest.approx([5.0, 120 * (0.41) + 5 * 0.137, 210.0], rel=2e-3)
    assert a.std[2] == 0.0
    assert 0 <= a.std[0] < 1e-3


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        (SINE, lambda k, T: 3 * np.sin(2 * np.pi * 250 * k * T)),
        (CHIRP, lambda k, T: 3 * np.sin(2 * np.pi * (250 + 0.5 * (900 - 250) / 0.02 * k * T) * k * T)),
        (SQUARE, lambda k, T: np.where((k // 6) % 2 == 0, 3.0, -3.0)),
        (STEP, lambda k, T: np.full(len(k), 3.0)),
        (DC, lambda k, T: np.minimum(3.0, 3.0 * (k + 1) / 6)),
        (BUFFER, lambda k, T: np.array([1.0, -2.0, 0.5])[(k // 6) % 3]),
    ],
)
def test_shapes(shape: int, expected: Any) -> None:
    bench = Bench()
    bench.memory.buffer[0], bench.memory.buffer[1], bench.memory.buffer[2] = 1.0, -2.0, 0.5
    bench.excite(
        shape=shape, point=U_Q, amplitude=3.0, f0=250.0, f1=900.0, duration=0.02, hold_periods=6, buffer_samples=3
    )
    bench.record("U_Q", "FLAGS", depth=300, trigger=4)
    bench.run(300)
    u, flags = bench.recording().T
    k = np.arange(240)  # 0.02 s
    assert u[:240] == pytest.approx(expected(k, 83.333e-6), abs=2e-5)
    assert (flags[:240] == 1024).all()
    assert (flags[240:] == 0).all()
    assert bench.drive.excitation.state == DONE


def test_buffer_without_a_duration_runs_once() -> None:
    bench = Bench()
    bench.memory.buffer[0] = 2.0
    bench.excite(shape=BUFFER, point=U_D, buffer_samples=5, hold_periods=2)
    bench.run(9)
    assert bench.drive.excitation.state == RUNNING
    bench.run(1)
    assert bench.drive.excitation.state == DONE


def test_prbs_is_maximal_and_balanced() -> None:
    bench = Bench()
    bench.excite(shape=PRBS, point=U_D, amplitude=1.0, hold_periods=1)
    bench.record("U_D", depth=8000, trigger=4)
    bench.run(8000)
    bits = bench.recording()[:, 0]
    assert set(np.unique(bits)) == {-1.0, 1.0}
    assert abs(bits.mean()) < 0.05
    spectrum = np.abs(np.correlate(bits, bits[:2000], "valid"))
    assert spectrum[1:].max() < 0.15 * spectrum[0]  # measured 0.10 over this stretch of the period 32767


def test_square_wave_on_a_bias_in_a_frozen_frame() -> None:
    bench = Bench(motor__L_d_h=0.0023)
    bias = 14.0
    bench.excite(
        ARM,
        shape=SQUARE,
        point=U_Q,
        amplitude=30.0,
        hold_periods=6,
        bias_d=bias,
        bias_bandwidth=2 * math.pi * 60,
        fixed_angle=0.4,
        duration=0.02,
        abort_current=40.0,
    )
    bench.run(1500)
    assert bench.drive.excitation.state == ARMED
    assert bench.plant.phases()[0] == pytest.approx(bias * math.cos(0.4), abs=0.02)
    assert bench.signal("THETA_E") == pytest.approx(0.4, abs=1e-6)
    bench.record("I_Q", "U_Q_LIM", depth=120, trigger=4, pretrigger=10)
    bench.run(20)
    bench.excite(START)
    bench.run(110)
    rows = bench.recording()
    assert bench.drive.recorder.trigger_position == 10
    assert np.abs(rows[:10]).max() < 0.2
    assert rows[10, 1] == pytest.approx(30.0, abs=0.2)
    assert np.ptp(rows[90:, 0]) == pytest.approx(30 * 6 * bench.plant.T_s / 0.0022, rel=0.15)  # L at 0.4 rad
    bench.run(200)
    assert bench.drive.excitation.state == DONE


def test_current_injection_and_speed_injection_add_to_their_references() -> None:
    bench = Bench(20.0, speed__K_p_nms_per_rad=0.1)
    bench.excite(shape=SQUARE, point=I_Q, amplitude=2.0, hold_periods=100, bias_q=5.0, bias_d=-1.0)
    bench.run(1)
    assert (bench.signal("I_Q_REQ"), bench.signal("I_D_REQ")) == (7.0, -1.0)
    bench.run(100)
    assert bench.signal("I_Q_REQ") == 3.0
    bench.drive.reference.mode = MODE_SPEED
    bench.drive.reference.omega_M_ref = 20.0
    bench.excite(shape=STEP, point=SPEED, amplitude=4.0)
    bench.run(30)
    assert bench.drive.applied.omega_M_ref == 24.0


def test_hysteresis_pulses_turn_at_their_current_limits() -> None:
    bench = Bench(protection__i_trip_apk=200.0)
    bench.excite(
        shape=HYSTERESIS,
        amplitude=60.0,
        amplitude_q=45.0,
        i_limit_d=6.0,
        i_limit_q=8.0,
        i_centre_d=-4.0,
        fixed_angle=0.0,
        duration=0.1,
    )
    bench.record("I_D", "I_Q", "U_D_LIM", "U_Q_LIM", depth=1200, trigger=4)
    bench.run(1200)
    i_d, i_q, u_d, u_q = bench.recording().T
    slack_d, slack_q = 3 * 60 * bench.plant.T_s / 0.0023, 3 * 45 * bench.plant.T_s / 0.0021  # delay and one sample
    assert 2.0 < i_d.max() < 2.0 + slack_d
    assert -10.0 > i_d.min() > -10.0 - slack_d
    assert 8.0 < i_q.max() < 8.0 + slack_q
    assert set(np.round(np.unique(u_d), 3)) == {-60.0, 60.0}
    assert set(np.round(np.unique(u_q), 3)) == {-45.0, 45.0}
    flips = np.flatnonzero(np.diff(u_d) < 0)
    assert len(flips) > 20
    assert (i_d[flips + 1] > 2.0).all()
    assert (i_d[flips] <= 2.0).all()


def test_abort_limits_take_the_gates_away_until_the_next_command() -> None:
    bench = Bench()
    bench.excite(shape=STEP, point=U_D, amplitude=50.0, abort_current=10.0)
    bench.run(30)
    assert bench.drive.excitation.state == ABORTED
    assert bench.output.gates == 0
    assert np.abs(bench.plant.i).max() == 0.0
    bench.excite(STOP)
    bench.run(2)
    assert (bench.drive.excitation.state, bench.output.gates) == (IDLE, 1)


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize(("limit", "state"), [(49.0, ABORTED), (51.0, RUNNING)])
def test_the_abort_speed_is_electrical(limit: float, state: int, direction: float) -> None:
    fast = Bench(50.0 * direction)
    assert fast.p > 1
    fast.excite(shape=SINE, point=U_D, amplitude=1.0, f0=100.0, abort_speed=fast.p * limit)
    fast.run(2)
    assert fast.drive.excitation.state == state


def test_recorder_triggers_and_keeps_the_oldest_row_first() -> None:
    bench = Bench()
    for trigger, level, source in ((1, 2.0, "I_Q"), (3, 2.0, "I_Q"), (2, -2.0, "I_Q")):
        bench.drive.reference.i_q_ref = 0.0
        bench.run(400)
        bench.record(
            "I_Q", "I_Q_REF", depth=50, pretrigger=20, trigger=trigger, trigger_level=level, trigger_signal=S[source]
        )
        bench.run(37)
        assert bench.drive.recorder.state == ARMED
        bench.drive.reference.i_q_ref = -4.0 if trigger == 2 else 4.0
        bench.run(200)
        assert (bench.drive.recorder.state, bench.drive.recorder.stored) == (3, 50)
        i_q = bench.recording()[:, 0]
        k = bench.drive.recorder.trigger_position
        assert k == 20
        assert abs(i_q[k - 1]) < 2.0 <= abs(i_q[k])
        assert (np.diff(np.abs(i_q[k - 3 : k + 3])) > 0).all()


@pytest.mark.chain
def test_recorder_decimates_forces_stops_and_respects_its_memory() -> None:
    bench = Bench(10.0)
    bench.record("THETA_M", depth=10**6, decimation=3)
    bench.run(3 * 16384)
    assert (bench.drive.recorder.state, bench.drive.recorder.stored) == (3, 16384)
    steps = np.diff(bench.recording()[:2000, 0].astype(float))
    assert steps == pytest.approx(np.full(1999, 3 * 10.0 * bench.plant.T_s), abs=1e-6)
    bench.record("THETA_M", "OMEGA_E", depth=100, trigger=5, pretrigger=30)
    bench.run(140)
    assert bench.drive.recorder.state == ARMED
    bench.drive.recorder.command = 2
    bench.run(20)
    bench.drive.recorder.command = 0
    bench.run(1)
    assert (bench.drive.recorder.state, bench.drive.recorder.stored) == (0, 50)
    assert bench.drive.recorder.trigger_position == 30
    assert (np.diff(bench.recording()[:, 0]) > 0).all()


def test_fault_trigger_records_the_trip() -> None:
    bench = Bench()
    bench.record("I_A", "U_DC", depth=40, pretrigger=25, trigger=5)
    bench.run(60)
    bench.U_dc = 900.0
    bench.run(30)
    assert bench.drive.trip == 0x3210
    assert bench.recording()[24:26, 1].tolist() == [210.0, 900.0]


@pytest.mark.parametrize(
    ("code", "member", "value"),
    [
        (0x2310, "i_b", -90.0),
        (0x3210, "U_dc", 801.0),
        (0x3220, "U_dc", 19.0),
        (0x4310, "T_winding", 156.0),
        (0x5530, "i_a", math.nan),
        (0x7305, "encoder_failed", 1),
    ],
)
def test_trips_latch_and_remove_the_gates(code: int, member: str, value: float) -> None:
    bench = Bench()
    bench.drive.reference.i_q_ref = 1.0
    bench.run(3)
    assert bench.output.gates == 1
    sensors = bench.types["pmsm_sensors"](T_winding=20.0, U_dc=210.0)
    setattr(sensors, member, value)

    def call(s: Any) -> None:
        bench.library.pmsm_application_period(ctypes.byref(bench.drive), ctypes.byref(s), ctypes.byref(bench.output))

    no_sample = code in (0x5530, 0x7305)
    call(sensors)
    if no_sample:  # one is held
        assert (bench.drive.trip, bench.output.gates) == (0, 1)
        call(sensors)
    assert (bench.drive.trip, bench.output.gates) == (code, 0)
    bench.library.pmsm_application_reset_fault(ctypes.byref(bench.drive))
    call(sensors)
    if no_sample:
        call(sensors)
    assert bench.drive.trip == code  # the cause persists
    healthy = bench.types["pmsm_sensors"](T_winding=20.0, U_dc=210.0)
    call(healthy)
    assert (bench.drive.trip, bench.output.gates) == (code, 0)
    bench.library.pmsm_application_reset_fault(ctypes.byref(bench.drive))
    call(healthy)
    assert (bench.drive.trip, bench.output.gates) == (0, 1)


def test_overspeed_trips_and_undervoltage_only_when_enabled() -> None:
    bench = Bench(200.0, protection__n_trip_rpm=1800.0)
    bench.run(1)
    assert bench.drive.trip == 0x8480
    bench = Bench()
    bench.drive.enabled, bench.U_dc = 0, 0.0
    bench.run(10)
    assert bench.drive.trip == 0
    bench.drive.enabled = 1
    bench.run(1)
    assert bench.drive.trip == 0x3220


def test_quick_stop_ramps_the_current_and_then_takes_the_gates() -> None:
    bench = Bench()
    bench.drive.reference.i_d_ref = 20.0
    bench.drive.fixed_angle = 1.0
    bench.run(600)
    bench.drive.quick_stop = 1
    bench.run(60)
    assert bench.signal("I_D") == pytest.approx(10.0, abs=1.0)
    assert bench.signal("THETA_E") == pytest.approx(1.0)
    bench.run(70)
    assert abs(bench.signal("I_D")) < 0.3
    bench.run(1300)
    assert (bench.drive.stopping.state, bench.output.gates) == (2, 0)
    bench.drive.quick_stop = 0
    bench.run(2)
    assert (bench.drive.stopping.state, bench.output.gates) == (0, 1)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_quick_stop_brakes_a_turning_machine(direction: float) -> None:
    bench = Bench(40.0 * direction, inertia=0.01, speed__K_p_nms_per_rad=0.5, speed__K_i_nm_per_rad=5.0)
    bench.drive.reference.mode = MODE_SPEED
    bench.drive.reference.omega_M_ref = 40.0 * direction
    bench.run(50)
    bench.drive.quick_stop = 1
    periods = 0
    while bench.drive.stopping.state != 2 and periods < 6000:
        bench.run(1)
        periods += 1
        assert bench.omega_M * direction > -3.0
    assert periods * bench.plant.T_s < 0.25
    assert abs(bench.omega_M) < 0.02 * 1200 * math.pi / 30
    assert bench.output.gates == 0


@pytest.mark.parametrize("omega", [100.0, -2.0])
@pytest.mark.parametrize("torque_most", [2.0, 50.0])
@pytest.mark.parametrize(("K_p", "J"), [(0.1, 0.01), (0.0, 0.01), (0.0, 0.0)])
def test_quick_stop_brakes_by_the_gain_that_is_known(K_p: float, J: float, torque_most: float, omega: float) -> None:
    """Of the speed controller, else of the inertia, else of the speed range; at most rated and allowed torque."""
    changes = {"speed__K_p_nms_per_rad": K_p, "motor__J_kgm2": J, "speed__tau_max_nm": torque_most}
    bench = Bench(omega, **changes)
    bench.drive.reference.mode = MODE_SPEED
    bench.run(1)
    bench.drive.quick_stop = 1
    bench.run(1)
    v = bench.values
    most = min(torque_most, 1.5 * bench.p * v["motor.psi_f_wb"] * v["motor.I_nom_apk"])
    of_range = most / (0.25 * v["motor.n_max_rpm"] * math.pi / 30.0)
    gain = K_p or (J * v["encoder.pll_bandwidth_rad_s"] / 6.0 if J else of_range)
    expected = -max(-most, min(gain * bench.drive.speed.omega, most))
    assert bench.drive.applied.tau_ref == pytest.approx(expected, rel=1e-5)  # binary32


def test_live_parameters_keep_the_controller_memory() -> None:
    bench = Bench(30.0)
    bench.drive.reference.i_q_ref = 6.0
    bench.run(1500)
    integrator = bench.drive.control.integrator.q
    bench.load(current__K_p_q_v_per_a=5.0)
    bench.run(1)
    assert integrator != 0
    assert bench.drive.control.integrator.q == pytest.approx(integrator, rel=1e-3)
    assert bench.plant.i[1] == pytest.approx(6.0, abs=0.01)
    image = bytearray(pack_image(bench.values))
    image[0] = 0
    before = bytes(bench.memory.params)
    assert bench.library.pmsm_drive_load(ctypes.byref(bench.memory), bytes(image), len(image)) == 5
    assert bytes(bench.memory.params) == before
