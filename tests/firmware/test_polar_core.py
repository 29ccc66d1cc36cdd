# SPDX-License-Identifier: MIT
"""The polar-coordinate laws in the compiled closed loop against the numbers stated here.

Machine of docs/control.md, 3 (assumed: the paper's table is missing). Amperes are power-invariant as in the paper.
Each target stands beside the value measured with ``pmsmtool reproduce polar-steps`` (``-linear``, ``-noise``,
``-ramps``, ``-sweep``, ``-limit``, ``-salient``).
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.firmware.core_binding import core
from pmsmtool.papers import (
    polar_limit,
    polar_linear,
    polar_salient,
    polar_steps,
    polar_sweep,
)
from pmsmtool.papers.polar_scene import (
    CONVENTIONAL,
    CONVENTIONAL_ON_MEASUREMENT,
    K_T,
    LINEAR,
    NOISY,
    PRINTED,
    PROPOSED,
    PROPOSED_ON_MEASUREMENT,
    REGULARISED,
    REGULARISED_TABLE,
    SIMULATION,
    SWITCHED,
    UNIFIED,
    UNIFIED_TABLE,
    UNIFIED_TUNED,
    WOUND_UP,
    Bench,
    Controller,
    run,
    steps,
)
from pmsmtool.papers.statistics import TorqueStep
from tests.firmware.closed_loop import MODE_CURRENT, MODE_TORQUE, Loop
from tests.firmware.test_polar_twin import RPM, U_DC, values

RPM_800 = 800.0


def measured(law: Controller, bench: Bench = SIMULATION) -> TorqueStep:
    return polar_steps.measured(polar_steps.response(law, bench))


# ---- 800 rpm, 1 -> 4.5 -> 1 N m ------------------------------------------------------------------------------

CONVENTIONAL_I_D, CONVENTIONAL_I_D_ROOM = 4.47, 0.01  # A; 4.477: the inverter holds the voltage in the stator frame
CONVENTIONAL_PEAK = (5.0, 6.5)  # A; 5.76
CONVENTIONAL_SETTLING = (8.0, 13.0)  # ms; 11.0 up, 10.7 down
PROPOSED_I_D = 0.02  # A; 1e-5
PROPOSED_AREA = 0.15  # of conventional; 0.105, with P and D on the measurement 0.089
PROPOSED_PEAK, ON_MEASUREMENT_PEAK = 0.92, 0.5  # of conventional; 0.863 and 0.380
PROPOSED_SETTLING = (0.65, 1.15)  # of conventional; 0.82 and 0.83, on the measurement 0.92 and 0.72
WITHOUT_ANTI_WINDUP = 3.0  # times slower; 4.9
ON_MEASUREMENT_OVER = 2.0  # %; 0.1 and 1.1


def test_conventional_law_strengthens_the_flux() -> None:
    step = measured(CONVENTIONAL)
    assert step.end_a == pytest.approx(CONVENTIONAL_I_D, abs=CONVENTIONAL_I_D_ROOM)
    assert CONVENTIONAL_PEAK[0] <= step.peak_a <= CONVENTIONAL_PEAK[1]
    for settling in (step.up_ms, step.down_ms):
        assert CONVENTIONAL_SETTLING[0] <= settling <= CONVENTIONAL_SETTLING[1]


def test_proposed_law_removes_the_sustained_flux_strengthening() -> None:
    step, conventional, wound_up = measured(PROPOSED), measured(CONVENTIONAL), measured(WOUND_UP)
    assert abs(step.end_a) <= PROPOSED_I_D
    assert step.area_mas <= PROPOSED_AREA * conventional.area_mas
    assert step.peak_a <= PROPOSED_PEAK * conventional.peak_a
    for new, old in ((step.up_ms, conventional.up_ms), (step.down_ms, conventional.down_ms)):
        assert PROPOSED_SETTLING[0] * old <= new <= PROPOSED_SETTLING[1] * old
    assert wound_up.down_ms >= WITHOUT_ANTI_WINDUP * step.down_ms


def test_p_and_d_on_the_measurement_halve_the_peak() -> None:
    step, conventional = measured(PROPOSED_ON_MEASUREMENT), measured(CONVENTIONAL)
    assert abs(step.end_a) <= PROPOSED_I_D
    assert step.peak_a <= ON_MEASUREMENT_PEAK * conventional.peak_a
    assert step.area_mas <= PROPOSED_AREA * conventional.area_mas
    for new, old in ((step.up_ms, conventional.up_ms), (step.down_ms, conventional.down_ms)):
        assert PROPOSED_SETTLING[0] * old <= new <= PROPOSED_SETTLING[1] * old
    assert max(step.over_up, step.over_down) <= ON_MEASUREMENT_OVER


def test_always_in_field_weakening_proposed_is_conventional_bit_for_bit() -> None:
    torque = steps([(0.0, 0.5), (0.03, 3.0), (0.09, 0.5)])
    # the amplitude is at its limit as soon as i_d has become negative; both start from no current
    seen = [run(law, SIMULATION, torque, [(0.0, 1000.0)], 0.16) for law in (CONVENTIONAL, PROPOSED)]
    start = seen[0].index(0.02)
    assert seen[1].i_d[start:].max() < 0.0
    assert np.array_equal(seen[0].i_q[start:], seen[1].i_q[start:])
    assert np.array_equal(seen[0].u_q[start:], seen[1].u_q[start:])


def test_small_signal_response_decays_as_placed() -> None:
    at, small = 0.06, 0.0264  # 0.1 A
    r = run(CONVENTIONAL, SIMULATION, steps([(0.0, 1.0), (at, 1.0 + small)]), [(0.0, RPM_800)], 0.1)
    response = (r.i_q[r.index(at) :] - 1.0 / K_T) / (small / K_T)
    rate = np.polyfit(1e-4 * np.arange(140), np.log(np.abs(response[60:200] - 1.0) + 1e-6), 1)[0]
    assert -900.0 < rate < -250.0  # 1/s; double poles at -600 +- j346
    assert response.max() < 1.1


# ---- unified law in field weakening --------------------------------------------------------------------------

UNIFIED_UP, UNIFIED_DOWN = 6.0, 3.0  # ms; 4.9 and 2.0 (V_ref 0.97 V_max: 3.7 and 2.0), with delay and noise 5.0 and 2.1
UNIFIED_OVER = 1.0  # %; 0.002, with delay and noise 0.4
UNIFIED_PEAK, UNIFIED_NOISY_PEAK = 0.1, 0.3  # A; 1e-4 and 0.055
MIRROR_A = 5e-4  # A; 2e-5: binary32 rounds the phases b and c in another order
MIRROR_DOUBLE_A = 1e-11  # A; 3e-13 in binary64
RAMP_BUMP = 0.025  # N m; 0.0224 and 0.0058 on the torque ramp, 0.0090 and 0.0003 on the speed ramp


BENCHES = ((SIMULATION, UNIFIED_PEAK), (NOISY, UNIFIED_NOISY_PEAK))


@pytest.mark.parametrize("law", [UNIFIED, UNIFIED_TUNED], ids=["V_max", "0.97 V_max"])
@pytest.mark.parametrize(("bench", "peak"), BENCHES, ids=["ideal", "noisy"])
def test_unified_law_in_field_weakening(law: Controller, bench: Bench, peak: float) -> None:
    step = measured(law, bench)
    assert step.up_ms <= UNIFIED_UP
    assert step.down_ms <= UNIFIED_DOWN
    assert max(step.over_up, step.over_down) <= UNIFIED_OVER
    assert step.peak_a <= peak


@pytest.mark.parametrize("law", [CONVENTIONAL, PROPOSED, SWITCHED, UNIFIED], ids=lambda law: law.name)
def test_backwards_is_the_mirror_image(law: Controller) -> None:
    forward, backward = (polar_steps.response(law, mirrored=mirrored) for mirrored in (False, True))
    assert np.abs(forward.i_d - backward.i_d).max() <= MIRROR_A
    assert np.abs(forward.i_q + backward.i_q).max() <= MIRROR_A


def test_the_mirror_is_exact_but_for_rounding() -> None:
    found = []
    for sign in (1.0, -1.0):
        loop = Loop(core(double=True), values(6, polar__V_ref_ratio=0.97), omega=sign * 900 * RPM, U_dc=U_DC)
        rows = []
        for k in range(200):
            loop.step(mode=MODE_CURRENT, i_q_ref=sign * (12.0 if k > 50 else 2.0))
            rows.append(loop.plant.i * (1.0, sign))
        found.append(np.array(rows))
    assert np.abs(found[0] - found[1]).max() <= MIRROR_DOUBLE_A


@pytest.mark.parametrize("ramp", [polar_sweep.TORQUE, polar_sweep.SPEED], ids=["torque", "speed"])
def test_torque_bump_on_ramps(ramp: polar_sweep.Ramp) -> None:
    bump = {
        law.name: polar_sweep.measured(polar_sweep.response(law, ramp), ramp)[0]
        for law in (PROPOSED, UNIFIED, UNIFIED_TUNED)
    }
    assert bump[UNIFIED.name] <= RAMP_BUMP
    assert bump[UNIFIED_TUNED.name] <= 0.3 * bump[UNIFIED.name]  # 0.26 and 0.04
    assert bump[PROPOSED.name] > bump[UNIFIED.name]


def test_reversal_through_zero_voltage() -> None:
    r = polar_sweep.response(UNIFIED_TUNED, polar_sweep.REVERSAL)
    bump, error, i_d = polar_sweep.measured(r, polar_sweep.REVERSAL)
    assert bump <= RAMP_BUMP  # 0.0172
    assert error <= 2 * RAMP_BUMP  # 0.0233
    assert i_d <= UNIFIED_PEAK  # 0.037


# ---- linear range --------------------------------------------------------------------------------------------

STANDSTILL_OVER, STANDSTILL_OVER_ROOM = 18.5, 1.5  # %; 18.5
TURNING_OVER, TURNING_I_D = 20.5, (0.1, 0.45)  # %, A; 19.0 and 0.176
SETTLING_ROOM = 0.3  # ms between 0 and 400 rpm; 0.0
IMPROVED_SAME, IMPROVED_OVER, IMPROVED_I_D = 0.5, 3.5, 1.0  # points, %, % of the step; 0.003, 2.8, 0.66
PHASE_RATIO = 1.0 / 15.0  # of the paper's law; 1/18 regularised, 1/66 unified
SPIKE = 0.12  # A; 0.081 and 0.058


def stairs(law: Controller, rpm: float) -> polar_linear.Staircase:
    return polar_linear.measured(polar_linear.response(law, rpm))


def test_linear_range_as_in_the_paper() -> None:
    standstill, turning = stairs(LINEAR, 0.0), stairs(LINEAR, 400.0)
    assert standstill.over == pytest.approx(STANDSTILL_OVER, abs=STANDSTILL_OVER_ROOM)
    assert standstill.i_d_a <= 1e-3  # 2e-6
    assert turning.over <= TURNING_OVER
    assert TURNING_I_D[0] <= turning.i_d_a <= TURNING_I_D[1]
    assert turning.settle_ms == pytest.approx(standstill.settle_ms, abs=SETTLING_ROOM)


def test_printed_decoupling_fails_to_settle() -> None:
    printed = stairs(PRINTED, 400.0)
    assert math.isinf(printed.settle_ms)
    assert printed.i_d_a > 3.0  # 8.7
    assert stairs(PRINTED, 0.0).over == pytest.approx(STANDSTILL_OVER, abs=STANDSTILL_OVER_ROOM)  # blind at standstill


@pytest.mark.parametrize("law", [REGULARISED, UNIFIED_TUNED], ids=lambda law: law.name)
def test_improved_linear_laws(law: Controller) -> None:
    standstill, turning = stairs(law, 0.0), stairs(law, 400.0)
    assert abs(turning.over - standstill.over) <= IMPROVED_SAME
    assert turning.over <= IMPROVED_OVER
    assert turning.i_d_percent <= IMPROVED_I_D


@pytest.mark.parametrize("law", [REGULARISED, UNIFIED_TUNED], ids=lambda law: law.name)
def test_phase_is_quiet_at_zero_voltage(law: Controller) -> None:
    papers, improved = (polar_linear.at_rest(one, 0.0, 4, 8, 0) for one in (LINEAR, law))
    assert improved.phase_rad <= PHASE_RATIO * papers.phase_rad
    assert improved.i_d_a <= papers.i_d_a
    assert improved.i_q_a <= papers.i_q_a
    assert max(improved.spikes_a) <= SPIKE < max(papers.spikes_a)  # the paper's 1.2


@pytest.mark.parametrize("law", [SWITCHED, polar_sweep.CONVENTIONAL_SWITCHED], ids=lambda law: law.name)
def test_switching_to_the_linear_law_is_bumpless(law: Controller) -> None:
    step = measured(law)
    assert step.up_ms <= 11.0  # 7.9 and 9.8
    assert step.down_ms <= 3.5  # 2.2
    assert step.over_down <= 4.0  # 2.7
    assert step.peak_a <= 1.2  # 0.98 and 1.02
    assert abs(step.end_a) <= PROPOSED_I_D


@pytest.mark.parametrize("law", [SWITCHED, polar_sweep.CONVENTIONAL_SWITCHED], ids=lambda law: law.name)
def test_the_switch_makes_the_phase_laws_work_at_standstill(law: Controller) -> None:
    r = run(law, SIMULATION, steps([(0.0, 0.0), (0.01, 1.0)]), [(0.0, 0.0)], 0.06)
    assert r.torque[-1] == pytest.approx(1.0, abs=1e-3)


# ---- everywhere ----------------------------------------------------------------------------------------------


def test_unified_law_over_six_speeds_and_four_loads() -> None:
    cells = polar_sweep.grid(UNIFIED_TUNED, SIMULATION, polar_sweep.SPEEDS_RPM, polar_sweep.LOADS_NM, 0)
    failures = {cell for cell, one in cells.items() if one.fails(polar_sweep.ERROR_A, polar_sweep.RIPPLE_A)}
    assert len(cells) == 24
    assert failures == set()
    assert max(one.i_d_a for one in cells.values()) <= 0.5  # A; 0.31 where the step itself clips the voltage


def test_unified_law_on_the_whole_drive() -> None:
    cells = polar_sweep.grid(UNIFIED_TUNED, polar_sweep.EXPERIMENT, (0.0, 900.0, -1400.0), (-4.0, 1.0), 0)
    assert not any(one.fails(polar_sweep.NOISY_ERROR_A, polar_sweep.NOISY_RIPPLE_A) for one in cells.values())


@pytest.mark.chain
def test_unified_law_on_random_machines() -> None:
    found = polar_sweep.random_outcomes(UNIFIED_TUNED, 100, 0)
    failed = [k for k, one in enumerate(found) if one.fails(polar_sweep.RANDOM_ERROR_A, polar_sweep.RANDOM_RIPPLE_A)]
    assert failed == []


REACHED = (
    (CONVENTIONAL, 8.099),
    (CONVENTIONAL_ON_MEASUREMENT, 8.099),
    (PROPOSED_ON_MEASUREMENT, 8.099),
    (UNIFIED, 8.101),
    (UNIFIED_TUNED, 7.787),
)
"""Torque held at 800 rpm where 12 N m are asked for and 8.42 N m are the most: 0.97 of the reach."""
REACH_ROOM_NM = 0.02


@pytest.mark.parametrize(("law", "torque"), REACHED, ids=[law.name for law, _ in REACHED])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torque_out_of_reach_is_cut_and_comes_back(law: Controller, torque: float, sign: float) -> None:
    torque_nm = [(t, sign * nm) for t, nm in steps([(0.0, 1.0), (0.06, 12.0), (0.16, 1.0)])]
    r = run(law, SIMULATION, torque_nm, [(0.0, sign * 800.0)], 0.3)
    held = polar_limit.held(r, 0.13, 0.16)
    assert sign * held.torque == pytest.approx(torque, abs=REACH_ROOM_NM)
    assert held.ripple <= 0.01  # N m; 1e-5
    assert sign * r.torque[-1] == pytest.approx(1.0, abs=0.01)


def test_unified_law_keeps_the_current_limit_out_of_reach() -> None:
    _, r = polar_limit.unreachable(UNIFIED_TUNED)
    assert np.hypot(r.i_d, r.i_q).max() <= 40.0 * math.sqrt(1.5)  # I_max of the profile; 31.4 A peak


OVERMODULATED_NM = 0.01  # 0.001


@pytest.mark.parametrize("ratio", [1.05, 1.08])
def test_unified_law_holds_torque_in_overmodulation(ratio: float) -> None:
    law = Controller("unified", "unified", 0, (("polar.V_ref_ratio", 0.97 * ratio),))
    held = polar_limit.at_ratio(law, ratio, 4.5)
    assert held.torque == pytest.approx(4.5, abs=OVERMODULATED_NM)
    assert held.fundamental > 1.0


# ---- L_d != L_q ----------------------------------------------------------------------------------------------


def test_the_papers_laws_are_refused_on_an_interior_machine() -> None:
    refused = polar_salient.refusals()
    assert {law for law, why in refused.items() if why} == {"conventional", "proposed", "linear", "linear-printed"}
    assert all("L_d = L_q" in why for why in refused.values() if why)


@pytest.mark.parametrize("rpm", [500.0, 2000.0, -2500.0])
@pytest.mark.parametrize("torque", [4.0, 14.0, -14.0])
def test_unified_law_holds_torque_on_an_interior_machine(rpm: float, torque: float) -> None:
    point = polar_salient.point(polar_salient.response(UNIFIED_TUNED, rpm, torque))
    assert point.torque == pytest.approx(torque, rel=polar_salient.TORQUE_SHARE)
    assert point.voltage <= 1.0 + 1e-4


@pytest.mark.parametrize("law", [UNIFIED_TABLE, REGULARISED_TABLE], ids=lambda law: law.name)
@pytest.mark.parametrize(("rpm", "torque"), [(500.0, 4.0), (2000.0, 14.0), (-2500.0, -14.0)])
def test_laws_follow_the_table_on_an_interior_machine(law: Controller, rpm: float, torque: float) -> None:
    point = polar_salient.point(polar_salient.response(law, rpm, torque))
    assert point.torque == pytest.approx(torque, rel=polar_salient.TORQUE_SHARE)  # 0.0013, the table's
    assert point.voltage <= 0.97


def test_regularised_law_with_the_table_works_in_field_weakening() -> None:
    step = measured(REGULARISED_TABLE)
    assert step.up_ms <= UNIFIED_UP  # 5.1
    assert step.down_ms <= UNIFIED_DOWN  # 2.0
    assert step.peak_a <= 0.5  # 0.21
    assert step.loss_w == pytest.approx(50.4, abs=0.2)  # 0.95 V_max


def test_regularised_law_holds_torque_on_an_interior_machine() -> None:
    r = polar_salient.response(REGULARISED, 500.0, 14.0)
    assert polar_salient.point(r).torque == pytest.approx(14.0, rel=polar_salient.TORQUE_SHARE)
    assert r.torque.max() <= 1.06 * 14.0  # 1.033


@pytest.mark.parametrize(("rpm", "torque"), [(2500.0, 20.0), (3000.0, 14.0), (-3000.0, -20.0)])
def test_unified_law_keeps_the_demagnetisation_limit(rpm: float, torque: float) -> None:
    point = polar_salient.point(polar_salient.response(UNIFIED_TUNED, rpm, torque))
    assert point.i_d == pytest.approx(-10.0, abs=0.01)
    assert 0.5 * abs(torque) < abs(point.torque) < abs(torque)
    assert point.peak <= 12.0


# ---- nothing but finite duties -------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", range(1, 7))
@pytest.mark.parametrize("options", [0, 1, 2, 5, 9])
def test_every_law_stays_finite_on_states_no_loop_visits(mode: int, options: int) -> None:
    rng = np.random.default_rng(mode)
    loop = Loop(core(), values(mode, options, inverter__delay_periods=1.5), omega=0.0, U_dc=U_DC)
    for _ in range(60):
        m = loop.measurement
        m.theta_e = float(rng.uniform(-3, 3))
        m.omega_e = float(rng.choice([0.0, 1e-3, 1.0, -1.0]) * rng.uniform(0, 3000))
        m.U_dc = float(rng.choice([0.0, 1.0, 36.0, 60.0]))
        phases = rng.normal(0, 30, 3)
        loop.measurement.i_a, loop.measurement.i_b, loop.measurement.i_c = (float(x) for x in phases - phases.mean())
        loop.reference.mode = int(rng.choice([MODE_CURRENT, MODE_TORQUE]))
        loop.reference.i_q_ref, loop.reference.tau_ref = float(rng.normal(0, 40)), float(rng.normal(0, 12))
        loop.binding.library.pmsm_step(loop.state, loop.params, loop.lut, m, loop.reference, loop.output)
        duties = np.array([loop.output.duty_a, loop.output.duty_b, loop.output.duty_c])
        assert np.isfinite(duties).all()
        assert ((duties >= 0.0) & (duties <= 1.0)).all()
