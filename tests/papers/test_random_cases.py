# SPDX-License-Identifier: MIT
"""The drive the figures are made with, and the random cases it is asked for."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.firmware.core_binding import core
from pmsmtool.papers.current_step import EPS, laws
from pmsmtool.papers.governed_drive import (
    DELAYED,
    FAST,
    MODULUS_OPTIMUM,
    NOMINAL,
    TABLE_2B,
    Condition,
    GovernedDrive,
    Law,
    V_max,
    law_values,
    plant_of,
)
from pmsmtool.papers.random_cases import (
    Case,
    feasible_for,
    least_time_s,
    nearest_held,
    reachable,
    run_cases,
    unreachable,
)
from tests.firmware.closed_loop import MODE_CURRENT, RPM, Loop

BEST = Law("best", "best", eps=1e-3)
TWIN_A = 2e-3
"""Largest difference of the current from the core around an exact plant in Python; measured 3e-4 A."""
START_A = 1e-3
"""How near the drive is to its initial current when the step comes; measured 2e-5 A."""


@pytest.mark.chain
@pytest.mark.parametrize("law", [BEST, replace(BEST, governor="paper", alpha=MODULUS_OPTIMUM), Law("back-calculation")])
@pytest.mark.parametrize("condition", [NOMINAL, DELAYED, TABLE_2B])
def test_the_compiled_loop_does_what_the_core_does_around_an_exact_plant(law: Law, condition: Condition) -> None:
    rpm, start, target, periods = 700.0, (-30.0, 5.0), (-25.0, 25.0), 60
    seen = GovernedDrive(law, condition).step(rpm, start, target, periods / 12e3)
    loop = Loop(core(), dict(law_values(law, condition.delayed)), omega=rpm * RPM, U_dc=210.0)
    plant = plant_of(condition)
    loop.plant.R, loop.plant.L_d, loop.plant.L_q, loop.plant.psi = plant.R, plant.L_d, plant.L_q, plant.psi
    loop.settle_at(*start)
    twin = []
    for _ in range(periods):
        twin.append(loop.plant.i)
        loop.step(mode=MODE_CURRENT, i_d_ref=target[0], i_q_ref=target[1])
    assert np.abs(seen.i - np.array(twin)).max() <= TWIN_A
    assert np.hypot(*(seen.i[0] - start)) <= START_A


def test_laws_of_a_comparison_share_everything_but_the_law() -> None:
    for delayed in (False, True):
        sets = [law_values(law, delayed) for law in laws(MODULUS_OPTIMUM)]
        same = ["inverter.delay_periods", "inverter.voltage_utilisation", "motor.I_max_apk"]
        same += [f"current.K_{kind}_{axis}" for kind in "pi" for axis in ("d_v_per_a", "q_v_per_a")][:2]
        same += ["current.K_i_d_v_per_as", "current.K_i_q_v_per_as", "governor.alpha_rad_s"]
        for name in same:
            assert len({values[name] for values in sets}) == 1, name
        predicts = {
            bool(int(values["current.options"]) & 16) or bool(int(values["governor.options"]) & 2) for values in sets
        }
        assert predicts == {delayed}
        assert {values["governor.eps"] for law, values in zip(laws(MODULUS_OPTIMUM), sets, strict=True)
                if law.governor != "off"} == {EPS}  # fmt: skip
    assert law_values(BEST, False)["current.K_p_d_v_per_a"] == pytest.approx(FAST * 2.3e-3)


def test_noise_changes_from_run_to_run_and_not_from_drive_to_drive() -> None:
    noisy = replace(DELAYED, noise=True)
    drives = [GovernedDrive(BEST, noisy, 5) for _ in range(2)]
    runs = [[drive.step(300.0, (0.0, 0.0), (0.0, 10.0), 0.01).i for _ in range(2)] for drive in drives]
    assert np.array_equal(runs[0][0], runs[1][0])
    assert np.array_equal(runs[0][1], runs[1][1])
    assert not np.array_equal(runs[0][0], runs[0][1])
    assert 0.01 < np.std(runs[0][0][-40:] - runs[0][1][-40:]) < 0.3


def test_populations_keep_their_conditions() -> None:
    plant, mismatched = plant_of(), plant_of(TABLE_2B)
    assert reachable(40, 3) == reachable(40, 3)
    assert reachable(40, 3) != reachable(40, 4)
    for case in reachable(40, 3):
        assert case.size > 10.0
        assert plant.voltage(np.array(case.start), case.rpm) <= 0.98 * V_max()
        assert plant.voltage(np.array(case.target), case.rpm) <= 0.92 * V_max()
        assert max(math.hypot(*case.start), math.hypot(*case.target)) <= 56.0
    assert all(plant.voltage(np.array(case.target), case.rpm) > V_max() for case in unreachable(40, 3))
    assert all(mismatched.voltage(np.array(c.target), c.rpm) <= 0.92 * V_max() for c in feasible_for(mismatched, 40, 3))


@pytest.mark.chain
@pytest.mark.parametrize(("limit", "eps"), [(math.inf, 0.0), (56.0, 0.0), (56.0, 0.02)])
def test_nearest_held_current_against_a_search(limit: float, eps: float) -> None:
    plant, radius = plant_of(), np.linspace(0.0, 90.0, 721)
    angle = np.linspace(0.0, 2.0 * math.pi, 721)
    grid = np.stack([np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))], axis=-1)
    compared = 0
    for case in unreachable(12, 8):
        held = (plant.voltage(grid, case.rpm) <= (1.0 - eps) * V_max()) & (np.hypot(*grid.T).T <= limit)
        if not held.any():
            continue
        compared += 1
        found = nearest_held(case, plant, limit, eps)
        distance = np.hypot(*(grid - np.array(case.target)).transpose(2, 0, 1))
        best = float(distance[held].min())
        assert best - 1.0 <= math.dist(found, case.target) <= best + 1e-6  # the grid is 0.1 to 0.8 A wide
        assert plant.voltage(np.array(found), case.rpm) <= (1.0 - eps) * V_max() * (1.0 + 1e-9)
        assert math.hypot(*found) <= limit * (1.0 + 1e-9)
    assert compared >= 6


@pytest.mark.chain
def test_no_law_beats_the_least_time() -> None:
    cases = [case for case in reachable(40, 3) if least_time_s(case) > 1e-3][:12]
    bands = [0.02 * case.size for case in cases]
    for law in (BEST, Law("back-calculation")):
        found = run_cases(GovernedDrive(law), cases, [case.target for case in cases], bands, 0.04)
        assert np.all(found.settling_s >= np.array([least_time_s(case) for case in cases]) - 1.0 / 12e3)


def test_least_time_does_not_depend_on_the_sign_of_the_speed() -> None:
    case = Case(700.0, (-30.0, 5.0), (-25.0, 25.0))
    mirrored = Case(-700.0, (-30.0, -5.0), (-25.0, -25.0))
    assert least_time_s(case) == pytest.approx(least_time_s(mirrored), rel=1e-9)
