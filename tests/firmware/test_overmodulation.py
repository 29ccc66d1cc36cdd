# SPDX-License-Identifier: MIT
"""Voltages beyond the linear range, against a projection on the hexagon that is written out here."""

from __future__ import annotations

import ctypes
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmsmtool.design.ratings import ratings
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import ConfigError
from pmsmtool.firmware.core_binding import core
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file, machine_path, parse_machine
from tests.firmware.closed_loop import (
    BEST,
    CURRENT_ROW,
    FLAG_DUTY,
    MINIMUM_TIME,
    MODE_CURRENT,
    PRE_PROJECTION,
    Loop,
    tuned,
)

T_S_NS = 100_000
U_DC = 300.0
FUNDAMENTAL = 5e-4
"""Of the linear limit, over 360 angles; measured 3.6e-4."""
FUNDAMENTAL_ONE = 6e-3
"""One shunt with a window of up to 4 % of the period: it leaves a demand of 1.0 no length, 3e-3 short."""
TIMES = 1e-3
"""ns, rounding of a duty ratio."""


def ask(fundamental: float, angles: np.ndarray, *, off: int = 0, window: int = 0, shunts: int = 0) -> np.ndarray:
    """Duty ratios (n, 3) of a demanded voltage over the linear limit at angles of the frame, from a core at rest."""
    values = tuned(
        inverter__T_s_ns=T_S_NS, inverter__voltage_utilisation=0.6366, inverter__min_off_time_ns=off,
        inverter__sample_window_ns=window, inverter__shunts=shunts, current__options=0, motor__I_max_apk=1e5,
        protection__I_cont_apk=1e5,
    )  # fmt: skip
    values |= {f"current.{gain}": 0.0 for gain in ("K_i_d_v_per_as", "K_i_q_v_per_as")}
    values |= {f"current.K_p_{axis}_v_per_a": 1.0 for axis in "dq"}
    loop = Loop(core(double=True), values, omega=0.0, U_dc=U_DC)
    linear = (1.0 - off / T_S_NS) * U_DC / math.sqrt(3.0)
    duties = []
    for angle in angles:
        loop.binding.library.pmsm_init(ctypes.byref(loop.state))
        loop.measurement.theta_e = float(angle)
        loop.reference.mode, loop.reference.i_d_ref = MODE_CURRENT, fundamental * linear
        out = loop.output
        loop.binding.library.pmsm_step(loop.state, loop.params, None, loop.measurement, loop.reference, out)
        duties.append((out.duty_a, out.duty_b, out.duty_c))
    return np.array(duties)


def voltage(duties: np.ndarray) -> np.ndarray:
    """Stator voltage (V, complex) of duty ratios."""
    third = complex(-0.5, math.sqrt(0.75))
    return 2.0 / 3.0 * U_DC * (duties @ np.array([1.0, third, third.conjugate()]))


@pytest.mark.parametrize("shunts", [0, 1, 3])
@given(asked=st.floats(1.002, 1.09), off=st.integers(0, 3000), window=st.integers(500, 4000), start=st.floats(0.0, 0.1))
@settings(max_examples=12, deadline=None)
def test_the_fundamental_is_the_one_that_was_asked_for(
    shunts: int, asked: float, off: int, window: int, start: float
) -> None:
    angles = start + np.arange(360) * 2.0 * math.pi / 360
    linear = (1.0 - off / T_S_NS) * U_DC / math.sqrt(3.0)
    made = voltage(ask(asked, angles, off=off, window=window, shunts=shunts))
    inverter = replace(
        load_machine_file(machine_path("interior-2k2")).inverter,
        f_s_hz=1e9 / T_S_NS, min_off_time_s=1e-9 * off, sample_window_s=1e-9 * window, shunts=shunts,
    )  # fmt: skip
    most = inverter.largest_utilisation / inverter.linear_utilisation
    found = np.mean(made * np.exp(-1j * angles))
    limit = FUNDAMENTAL_ONE if shunts == 1 else FUNDAMENTAL
    assert abs(found.real / linear - min(asked, most)) < limit
    assert abs(found.imag / linear) < limit


def test_a_leg_leaves_the_lower_switch_its_time_and_shunts_their_window() -> None:
    angles = np.linspace(0.0, 2.0 * math.pi, 721)
    low, off, window = 0.0, 1500, 4000
    for asked in (0.9, 1.0, 1.04, 1.09, 1.1):
        for shunts in (0, 1, 3):
            duties = np.sort(ask(asked, angles, off=off, window=window, shunts=shunts), axis=1)
            assert duties[:, 0].min() >= low
            assert (1.0 - duties[:, 2].max()) * T_S_NS >= off - TIMES
            if shunts == 3:
                assert (1.0 - duties[:, 1].max()) * T_S_NS >= window - TIMES
            elif shunts == 1 and asked > 1.0:
                assert np.diff(duties, axis=1).min() / 2.0 * T_S_NS >= window - TIMES
    plain = np.sort(ask(1.09, angles, off=off), axis=1)
    assert (1.0 - plain[:, 1].max()) * T_S_NS < off + TIMES, "without shunts the second leg goes as far as the first"


@pytest.mark.parametrize("shunts", [0, 1, 3])
@pytest.mark.parametrize(
    ("T_ns", "off", "window"),
    [(100_000, 0, 0), (100_000, 2000, 5000), (100_000, 4000, 3000), (25_000, 20_000, 2000), (25_000, 1000, 11_250)],
)
def test_what_the_times_of_a_leg_leave(shunts: int, T_ns: int, off: int, window: int) -> None:
    """Of duties, of the linear range and of an edge's halves; six steps of what is left (docs/control.md, 8)."""
    times = {"min_off_time_ns": off, "sample_window_ns": window, "shunts": shunts, "T_s_ns": T_ns}
    for governor, share in ((0, 1.005), (5, 1.005), (BEST, 0.99)):
        values = tuned(governor__mode=governor, **{f"inverter__{key}": value for key, value in times.items()})
        loop = Loop(core(double=True), values, omega=0.0)
        loop.step(mode=MODE_CURRENT)
        d = loop.state.derived
        most = max(1.0 - off / T_ns, 0.5)
        second = max(1.0 - window / T_ns, 0.6 * most) if shunts == 3 else most
        apart = min(2.0 * window / T_ns, 0.4 * most) if shunts == 1 else 0.0
        low, high = 1.0 - 2.0 * apart / most, (2.0 * min(second, most) / most - 1.0) - 2.0 * apart / most
        assert [d.duty_most, d.second_duty_most, d.duties_apart] == pytest.approx([most, min(second, most), apart])
        assert d.shunts == (shunts if window else 0)
        assert [d.side_low, d.side_high] == pytest.approx(np.array([low, high]) / math.sqrt(3.0))
        assert d.over_most == pytest.approx(3.0 / math.pi + (math.sqrt(3.0) - 1.5) / math.pi * (low + high), abs=1e-6)
        assert d.over_rate == pytest.approx(6.0 * math.pi * math.sqrt(3.0) / (low**3 + high**3))
        assert d.utilisation_linear == pytest.approx(most / math.sqrt(3.0), rel=3e-5)
        assert d.held_share == share


def test_the_legs_make_the_nearest_point_of_the_hexagon() -> None:
    """Of a longer demand in the same direction: tried against a fine search along the hexagon's outline."""
    corners = 2.0 / 3.0 * U_DC * np.exp(1j * math.pi / 3.0 * np.arange(7))
    outline = np.concatenate([a + (b - a) * np.linspace(0, 1, 800) for a, b in pairwise(corners)])
    angles = np.linspace(0.05, 1.0, 12)
    for angle, made in zip(angles, voltage(ask(1.06, angles)), strict=True):
        assert np.abs(outline - made).min() < 0.2, "on the outline (V)"
        lengths = np.linspace(170.0, 230.0, 150)
        nearest = outline[np.abs(outline[:, None] - lengths * np.exp(1j * angle)).argmin(axis=0)]
        assert np.abs(nearest - made).min() < 0.4, "(V) grid of lengths and outline"


def held(fundamental: float, rpm: float) -> np.ndarray:
    """Currents (A, n x 2) of the Table 1 machine held at a voltage over the linear limit."""
    i, omega = (-20.0, 20.0), rpm * 4.0 * math.pi / 30.0
    values = tuned(2000.0, inverter__voltage_utilisation=0.635, inverter__delay_periods=1.5)
    values |= {f"current.K_i_{axis}_v_per_as": 2000.0 * values["motor.R_s_ohm"] for axis in "dq"}
    R, L_d, L_q = (values[f"motor.{name}"] for name in ("R_s_ohm", "L_d_h", "L_q_h"))
    u = R * i[0] - omega * L_q * i[1], R * i[1] + omega * (L_d * i[0] + values["motor.psi_f_wb"])
    loop = Loop(core(), values, omega=omega, U_dc=math.hypot(*u) * math.sqrt(3.0) / fundamental)
    loop.settle_at(*i)
    seen = []
    for _ in range(3000):
        live = loop.step(mode=MODE_CURRENT, i_d_ref=i[0], i_q_ref=i[1])
        seen.append((live.i_d - i[0], live.i_q - i[1]))
    assert live.flags & FLAG_DUTY or fundamental <= 1.0
    return np.array(seen[1500:])


MEAN_OFF_A = 0.05
"""Of 28 A; measured 0.013. With the harmonics left in the sampled current 1.2 to 2.6."""


@pytest.mark.parametrize("fundamental", [1.0, 1.02, 1.05, 1.07, 1.08])
def test_the_controller_does_not_answer_to_the_harmonics(fundamental: float) -> None:
    off = held(fundamental, 2000.0)
    assert np.abs(off.mean(axis=0)).max() < MEAN_OFF_A
    assert (np.abs(off).max() > 0.5) == (fundamental > 1.01), "they are in what is recorded"


def stepped(utilisation: float, rpm: float, start: float, governor: int) -> tuple[float, float]:
    """Largest current (A) and time to within 1.1 A (ms) of a step to 50 A from a rotor angle (rad, electrical)."""
    values = tuned(2000.0, inverter__voltage_utilisation=utilisation, inverter__delay_periods=1.5)
    values |= {f"current.K_i_{axis}_v_per_as": 2000.0 * values["motor.R_s_ohm"] for axis in "dq"}
    values |= {"governor.mode": governor, "governor.options": CURRENT_ROW | PRE_PROJECTION | MINIMUM_TIME}
    values |= {"governor.alpha_rad_s": 2000.0, "governor.eps": 0.015, "governor.k_max": 0}
    loop = Loop(core(), values, omega=rpm * 4.0 * math.pi / 30.0, U_dc=150.0)
    loop.settle_at(0.0, 0.0)
    loop.plant.theta = start
    seen = []
    for _ in range(600):
        live = loop.step(mode=MODE_CURRENT, i_d_ref=-40.0, i_q_ref=30.0)
        seen.append((live.i_d, live.i_q))
    off = np.flatnonzero(np.hypot(*(np.array(seen) - (-40.0, 30.0)).T) > 1.1)
    return float(np.hypot(*np.array(seen).T).max()), (off[-1] + 1) / 12.0


SLOWER_MS = 0.2
"""A step beside the linear one; measured 0.0, 17 ms later where the cut of a step is taken for harmonics."""
OVER_A = 0.5
"""Of 50 A; measured 0.18, 5 so."""


@pytest.mark.parametrize("governor", [0, BEST])
@pytest.mark.parametrize("rpm", [0.0, 50.0, 300.0])
def test_a_step_with_the_whole_voltage_is_no_fundamental(rpm: float, governor: int) -> None:
    for start in np.linspace(0.0, math.pi / 3.0, 5):
        most, settled = stepped(0.63, rpm, start, governor)
        assert settled <= stepped(0.5773, rpm, start, governor)[1] + SLOWER_MS
        assert most <= 50.0 + OVER_A


@pytest.mark.parametrize(
    ("changes", "used"),
    [({}, 1), ({"polar__mode": 6}, 0), ({"current__options": 15}, 0), ({"inverter__voltage_utilisation": 0.5773}, 0)],
)
def test_polar_laws_and_the_hexagon_keep_their_own_way(changes: dict[str, float], used: int) -> None:
    loop = Loop(core(), tuned(**{"inverter__voltage_utilisation": 0.6, **changes}), omega=0.0)
    loop.step(mode=MODE_CURRENT)
    assert loop.state.derived.overmodulates == used


TEXT = dump_machine_file(load_machine_file(machine_path("interior-2k2")))


def machine(**inverter: float) -> MachineFile:
    lines = "".join(f"{name} = {value}\n" for name, value in inverter.items())
    plain = "\n".join(line for line in TEXT.splitlines() if not line.startswith("voltage_utilisation"))
    return parse_machine(plain.replace("[inverter]\n", f"[inverter]\n{lines}"))


def test_a_file_must_state_what_overmodulation_has_to_leave() -> None:
    with pytest.raises(ConfigError, match="machine") as missing:
        machine(voltage_utilisation=0.61, shunts=3)
    assert "overmodulation" in missing.value.violations[0]
    assert "min_off_time_s, sample_window_s" in missing.value.violations[0]
    stated = {"min_off_time_s": 1e-6, "sample_window_s": 2e-6}
    assert machine(voltage_utilisation=0.61, shunts=3, **stated).inverter.overmodulates
    with pytest.raises(ConfigError, match="machine") as beyond:
        machine(voltage_utilisation=0.63, shunts=1, min_off_time_s=1e-6, sample_window_s=4e-6)
    assert "six steps" in beyond.value.violations[0]
    with pytest.raises(ConfigError, match="machine") as two:
        machine(voltage_utilisation=0.61, shunts=2, **stated)
    assert "0, 1 and 3" in two.value.violations[0]


@pytest.mark.parametrize("shunts", [0, 1, 3])
def test_the_file_is_held_to_the_largest_fundamental_that_the_core_knows(shunts: int) -> None:
    values = tuned(
        inverter__T_s_ns=T_S_NS,
        inverter__min_off_time_ns=1500,
        inverter__sample_window_ns=3000,
        inverter__shunts=shunts,
    )
    loop = Loop(core(double=True), values, omega=0.0)
    loop.step(mode=MODE_CURRENT)
    inverter = replace(
        machine().inverter, f_s_hz=1e9 / T_S_NS, min_off_time_s=1.5e-6, sample_window_s=3e-6, shunts=shunts
    )
    most = inverter.largest_utilisation / inverter.linear_utilisation
    assert most == pytest.approx(loop.state.derived.over_most, rel=1e-6)


def test_without_it_a_minimum_time_lowers_the_linear_limit() -> None:
    inverter = machine(min_off_time_s=2e-6).inverter
    assert inverter.voltage_utilisation == pytest.approx((1.0 - 2e-6 * inverter.f_s_hz) / math.sqrt(3.0))
    assert not inverter.overmodulates
    told = tune(machine(min_off_time_s=2e-6)).values["inverter.voltage_utilisation"].method
    assert "min_off_time_s" in told, "and the design says so"
    fast = TEXT.replace("f_s_hz = 12000.0", "f_s_hz = 30000.0")
    with pytest.raises(ConfigError, match="machine") as long:
        parse_machine(fast.replace("[inverter]\n", "[inverter]\nmin_off_time_s = 2e-5\n"))
    assert "more than half of a period" in long.value.violations[0]
    assert not machine().inverter.overmodulates


def test_a_design_says_how_large_the_harmonic_current_gets() -> None:
    """Against the flux of six steps, integrated here: a hexagon, less its fundamental."""
    source = machine(voltage_utilisation=0.62, shunts=0, min_off_time_s=0.0, sample_window_s=0.0)
    told = tune(source).facts["overmodulation_harmonic_apk"]
    assert "overmodulation_harmonic_apk" not in tune(machine()).facts
    n, omega = 6000, rated_base_speed(source)
    angle = (np.arange(n) + 0.5) * 2.0 * math.pi / n
    steps = np.exp(1j * math.pi / 3.0 * np.round(angle / (math.pi / 3.0)))
    steps *= source.inverter.V_max_v / abs(np.mean(steps * np.exp(-1j * angle)))
    harmonic = steps - np.mean(steps * np.exp(-1j * angle)) * np.exp(1j * angle)
    flux = np.cumsum(harmonic) * 2.0 * math.pi / n / omega
    assert told == pytest.approx(np.abs(flux - flux.mean()).max() / source.machine.L_d_h, rel=5e-3)


def rated_base_speed(source: MachineFile) -> float:
    """Electrical base speed (rad/s)."""
    V = (1.0 - TuneRequest().voltage_margin) * source.inverter.V_max_v
    return ratings(source, V).base_speed_rpm * math.pi / 30.0 * source.machine.pole_pairs
