# SPDX-License-Identifier: MIT
"""Inputs that are no usable numbers: one is held, two are a latched fault; what a fault does to the inverter."""

from __future__ import annotations

import cmath
import math
from typing import Any

import numpy as np
import pytest

from benchmarks.poisoned_periods import ASKED, AWAY, FAILURES, LAWS, NODES, SAMPLED, Case, run
from pmsmtool.firmware.core_binding import core
from tests.firmware.closed_loop import MODE_CURRENT, Loop, tuned

FLAG_HELD, FLAG_FAULT, MODE_OFF, MODE_FAULT = 1 << 11, 1 << 12, 0, 5
FAULT_INPUT, FAULT_RESULT = 1, 2
SEED, PERIODS = 5, 1000


def running(**changes: float) -> Loop:
    """A loop in the steady state of 20 A at 100 rad/s."""
    loop = Loop(core(), tuned(**changes), omega=100.0)
    for _ in range(200):
        loop.step(mode=MODE_CURRENT, i_q_ref=20.0)
    return loop


def poisoned(loop: Loop, name: str, value: float) -> Any:
    """One period with one input replaced; the input is put back."""
    m, r = loop.measurement, loop.reference
    m.theta_e, (m.i_a, m.i_b, m.i_c) = loop.plant.theta, loop.plant.phases()
    target = m if name in SAMPLED else r
    kept = getattr(target, name)
    setattr(target, name, value)
    loop.binding.library.pmsm_step(loop.state, loop.params, None, m, r, loop.output)
    setattr(target, name, kept)
    loop.plant.advance(loop.output.u_alpha, loop.output.u_beta)
    return loop.state.live


def test_a_thousand_poisoned_periods_of_every_law() -> None:
    found, away = run(PERIODS, SEED, episodes=20)
    assert {name: found[name] for name in FAILURES} == dict.fromkeys(FAILURES, 0)
    assert found["judged by the twin"] > 0.3 * PERIODS and set(away) == set(LAWS)


@pytest.mark.parametrize("name", [*SAMPLED, *ASKED])
def test_one_bad_period_holds_the_voltage_and_a_second_latches(name: str) -> None:
    loop = running()
    u = complex(loop.output.u_alpha, loop.output.u_beta)
    integrator = loop.state.integrator.q
    value = math.inf if name == "T_winding" else math.nan
    live = poisoned(loop, name, value)
    assert live.flags & FLAG_HELD and loop.state.fault == 0 and loop.output.gates == 1
    turned = u * cmath.exp(1j * loop.plant.omega * loop.plant.T_s)
    assert complex(loop.output.u_alpha, loop.output.u_beta) == pytest.approx(turned, abs=1e-4)
    assert loop.state.integrator.q == integrator
    assert not loop.step(mode=MODE_CURRENT, i_q_ref=20.0).flags & FLAG_HELD
    for _ in range(2):
        live = poisoned(loop, name, value)
    assert (loop.state.fault, loop.output.gates) == (FAULT_INPUT, 0) and live.flags & FLAG_FAULT
    for _ in range(3):
        live = loop.step(mode=MODE_CURRENT, i_q_ref=20.0)
        assert (loop.state.fault, loop.output.gates) == (FAULT_INPUT, 0) and live.flags & FLAG_FAULT
    loop.binding.library.pmsm_reset_fault(loop.state)
    loop.step(mode=MODE_CURRENT, i_q_ref=20.0)
    assert loop.output.gates == 1 and loop.state.fault == 0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_sizes_count_together_and_each_alone(sign: float) -> None:
    """1e7 in all; angles up to 4000 rad with what the delay adds; less than half a turn in a period."""
    names = [name for name in (*SAMPLED, *ASKED) if name not in ("theta_e", "omega_e", "mode", "bias_bandwidth")]
    loop = running()
    m, r, T_s = loop.measurement, loop.reference, loop.plant.T_s

    def is_held(**changes: float) -> bool:
        kept = {}
        for name, value in changes.items():
            target = m if name in SAMPLED else r
            kept[name] = target, getattr(target, name)
            setattr(target, name, value)
        loop.state.bad_periods = loop.state.fault = 0
        loop.binding.library.pmsm_step(loop.state, loop.params, None, m, r, loop.output)
        for name, (target, value) in kept.items():
            setattr(target, name, value)
        return bool(loop.state.live.flags & FLAG_HELD)

    for one, other in zip(names, [*names[1:], names[0]], strict=True):
        assert is_held(**{one: sign * 1.1e7}), one
        assert is_held(**{one: sign * 0.6e7, other: -0.6e7}), (one, other)
        assert not is_held(**{one: sign * 1e6}), one
    assert is_held(bias_bandwidth=1.1e7) and is_held(bias_bandwidth=5e-4) and is_held(mode=7)
    assert not is_held(bias_bandwidth=2e-3) and not is_held(bias_bandwidth=0.0)
    assert is_held(theta_e=sign * 4001.0, omega_e=0.0) and not is_held(theta_e=sign * 3999.0, omega_e=0.0)
    nothing = dict.fromkeys(("i_a", "i_b", "i_c", "T_winding", "i_q_ref"), 0.0)
    assert not is_held(U_dc=sign * 1e7, **nothing) and is_held(U_dc=sign * 1.0001e7, **nothing)
    assert not is_held(theta_e=sign * 4000.0, omega_e=0.0)
    assert not is_held(bias_bandwidth=1e-3)
    delay = loop.values["inverter.delay_periods"]
    assert is_held(theta_e=sign * 3999.0, omega_e=-2.0 / (delay * T_s))
    assert is_held(omega_e=sign * 1.01 * math.pi / T_s) and not is_held(omega_e=sign * 0.99 * math.pi / T_s)


def test_a_first_period_knows_the_speed_and_changed_parameters_keep_it() -> None:
    loop = Loop(core(), tuned(), omega=100.0)
    loop.step(mode=MODE_OFF)
    omega = 100.0 / loop.values["motor.pole_pairs"]
    assert loop.state.omega_filtered == pytest.approx(omega) == loop.state.omega_ref_ramped
    loop.step(mode=MODE_CURRENT)
    loop.state.omega_ref_ramped = 3.0
    loop.params.inverter_T_s_ns = 100_000
    before = loop.state.derived.T_s
    loop.binding.library.pmsm_parameters_changed(loop.state)
    loop.step(mode=MODE_CURRENT)
    assert loop.state.omega_ref_ramped == 3.0 and loop.state.derived.T_s == pytest.approx(1e-4) != before
    fresh = loop.binding.state()
    loop.binding.library.pmsm_parameters_changed(fresh)
    assert fresh.prepared == 0, "the first period is still to come"


def test_no_temperature_sensor_is_no_bad_sample() -> None:
    loop = running()
    for _ in range(5):
        assert not poisoned(loop, "T_winding", math.nan).flags & (FLAG_HELD | FLAG_FAULT)


@pytest.mark.parametrize("member", ["integrator", "disturbance", "reference_held", "reference_realised"])
def test_a_destroyed_memory_starts_from_rest(member: str) -> None:
    loop = running(governor__mode=3, governor__options=12, current__options=23)
    getattr(loop.state, member).q = math.nan
    for _ in range(3):
        loop.step(mode=MODE_CURRENT, i_q_ref=20.0)
        assert math.isfinite(loop.output.duty_a + loop.output.duty_b + loop.output.duty_c)
    assert loop.state.fault == 0 and loop.output.gates == 1
    for _ in range(400):
        loop.step(mode=MODE_CURRENT, i_q_ref=20.0)
    assert loop.plant.i[1] == pytest.approx(20.0, abs=0.1)


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e30, -1e30, -1.0])
def test_a_destroyed_node_of_the_saturation_table_leaves_the_controller_as_it_was(value: float) -> None:
    """Every word of the table for two periods: 2.2 of what V_max moves in a period before nodes were looked at."""
    case = Case(np.random.default_rng(3), "saturated, best, predictor")
    loop, (first, end) = case.loop, case.words[NODES]
    case.mode = MODE_CURRENT
    for _ in range(200):
        case.good()
    for word in range(first, end):
        if (word - first) % 4 == 0 and value == -1.0:
            continue  # a flux may be negative
        before = loop.plant.i.copy()
        for _ in range(2):
            case.bad(NODES, value, word)
        assert loop.state.fault == 0 and loop.output.gates == 1
        case.good()
        assert case.flux(loop.plant.i - before) < AWAY
        for _ in range(20):
            case.good()


def test_a_fault_shorts_the_windings_above_its_speed_only() -> None:
    """Not both in turn around that speed; the application's own trips react alike."""
    rpm = 100.0 / 4.0 * 30.0 / math.pi

    def reaction(loop: Loop, share: float, mode: int) -> tuple[int, float]:
        loop.plant.omega = 100.0 * share
        loop.plant.transitions.clear()
        loop.step(mode=mode)
        return loop.output.gates, loop.output.duty_a

    loop = running(protection__n_short_circuit_rpm=rpm)
    assert reaction(loop, 0.95, MODE_FAULT) == (0, 0.5)
    assert reaction(loop, 1.05, MODE_FAULT) == (1, 0.0)
    assert reaction(loop, 0.95, MODE_FAULT) == (1, 0.0)
    assert reaction(loop, -0.95, MODE_FAULT) == (1, 0.0)
    assert reaction(loop, 0.85, MODE_FAULT) == (0, 0.5)
    assert reaction(loop, 1.05, MODE_OFF) == (0, 0.5)
    assert reaction(running(), 3.0, MODE_FAULT) == (0, 0.5)
    loop.plant.omega = 130.0
    loop.plant.transitions.clear()
    for _ in range(20):
        loop.step(mode=MODE_CURRENT, i_q_ref=5.0)
    for _ in range(2):
        poisoned(loop, "omega_e", math.nan)
    assert (loop.output.gates, loop.output.duty_a, loop.state.fault) == (1, 0.0, FAULT_INPUT)
    assert np.isfinite(loop.plant.i).all()
