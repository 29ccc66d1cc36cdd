# SPDX-License-Identifier: MIT
"""Cogging as values and as a table over the encoder's angle, and what is said where none was found."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.angle_harmonics import AngleHarmonics, Harmonic
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.identification.cogging import COGGING_CSV, ROWS, Cogging, cogging_of, save_cogging
from pmsmtool.identification.evaluate import Evaluation
from pmsmtool.machine.parameters import Estimate
from pmsmtool.run_directory import RunDirectory, new_record
from pmsmtool.trace import Trace

J = Estimate(0.015, 1e-5, 2e-4, "kg m2")
ORDERS = (Harmonic(12, 30.0, 40.0, 0.5), Harmonic(36, 0.0, 4.0, 0.2))
FOUND = Cogging(AngleHarmonics((), ORDERS, 7.0), J, 54, 0.04, "slow turns")


def test_cogging_is_told_by_order_and_as_a_table(tmp_path: Path) -> None:
    values = FOUND.estimates()
    assert values["cogging_12_nm"].value == pytest.approx(0.75) and values["cogging_36_nm"].value == pytest.approx(0.06)
    assert values["cogging_12_rad"].value == pytest.approx(math.atan2(40.0, 30.0))
    run = RunDirectory.create(tmp_path, 1, new_record(["test"], drive={}, bus={}, versions={}, operator="nobody"))
    assert save_cogging(run, FOUND, -1) == {COGGING_CSV: ""}
    table = np.loadtxt(run.path / COGGING_CSV, delimiter=",", skiprows=1)
    assert table.shape == (ROWS, 3)
    along = -table[:, 0]  # an encoder that counts against the phase order
    true = 0.75 * np.cos(12.0 * along - math.atan2(40.0, 30.0)) + 0.06 * np.sin(36.0 * along)
    assert np.max(np.abs(table[:, 1] - true)) < 1e-5
    assert values["cogging_nm"].value == pytest.approx(np.max(np.abs(true)), rel=1e-4)


def test_none_is_told_with_what_would_have_been_found() -> None:
    none = replace(FOUND, harmonics=AngleHarmonics())
    nowhere = cast(RunDirectory, None)
    assert save_cogging(nowhere, none, 1) == save_cogging(nowhere, None, 1) == {}
    (only,) = none.estimates().values()
    assert only.value == 0.0 and "none found up to order 54" in only.method
    assert total_half_width(only) == pytest.approx(0.04)


K_T, POLE_PAIRS, SLOTTED, OFFSET_NM = 2.0, 3, 36, 0.03
STEP = 2.0 * math.pi / 2**16


def slow_turns(sense: float, cogging: complex, turns: float) -> Trace:
    """A shaft under a speed controller that cogging moves, its encoder and the current; a sensor's offset is unseen."""
    period, fine = 2e-3, 10
    h = period / fine
    theta, omega, sum_rad, k = 0.4, sense * 3.0, 0.0, 0
    rows = []
    while abs(theta - 0.4) < 2.0 * math.pi * turns:
        error = sense * 3.0 - omega
        sum_rad += error * h
        torque = J.value * (60.0 * error + 900.0 * sum_rad) + 0.1 * sense
        if k % fine == 0:
            rows.append((STEP * round(theta / STEP), torque / K_T))
        ripple = (cogging * complex(math.cos(SLOTTED * theta), -math.sin(SLOTTED * theta))).real
        unseen = OFFSET_NM * math.cos(POLE_PAIRS * theta)
        omega += h * (torque + unseen + ripple - 0.1 * sense) / J.value
        theta += h * omega
        k += 1
    theta_M, i_q = np.array(rows).T
    signals = {"theta_M_rad": theta_M, "i_q_a": i_q, "i_d_a": np.zeros(len(rows))}
    meta = {"offset_rad": 0.0, "direction": 1}
    return Trace(period * np.arange(len(rows)), signals, dict.fromkeys(signals, "1"), meta)


def shaft(inertia: dict[str, Estimate]) -> Evaluation:
    pole_pairs, none = SimpleNamespace(value=float(POLE_PAIRS)), None
    return cast(
        Evaluation,
        SimpleNamespace(
            encoder=SimpleNamespace(pole_pairs=pole_pairs),
            offset=SimpleNamespace(value=0.0),
            flux=SimpleNamespace(psi_measured=SimpleNamespace(value=K_T / (1.5 * POLE_PAIRS))),
            flux_map=none, inductance=none, mechanics=none, estimates=lambda: inertia,
        ),
    )  # fmt: skip


def both_ways(cogging: complex, turns: float = 2.1) -> dict[str, Trace]:
    return {f"slow_{k}": slow_turns(sense, cogging, turns) for k, sense in enumerate((1.0, -1.0))}


def test_slow_turns_show_a_cogging_that_coasting_does_not() -> None:
    """Order 36 with the torque of friction; the offset of a current sensor, once per electrical turn, is none."""
    true = 0.1 * np.exp(0.7j)
    found = cogging_of(both_ways(true), shaft({"J_kgm2": J}))
    assert found is not None
    values = found.estimates()
    assert set(values) == {"cogging_nm", "cogging_36_nm", "cogging_36_rad"}
    amplitude, phase = values["cogging_36_nm"], values["cogging_36_rad"]
    assert amplitude.value == pytest.approx(0.1, rel=0.03) and phase.value == pytest.approx(0.7, abs=math.radians(2.0))
    assert abs(amplitude.value - 0.1) < 1.5 * total_half_width(amplitude)


def test_slow_turns_without_cogging_say_how_little_there_is() -> None:
    found = cogging_of(both_ways(0j), shaft({"J_kgm2": J}))
    assert found is not None and not found.harmonics.acceleration_rad_s2 and found.highest_order == 54
    assert 0.0 < found.floor_nm < 0.05  # half of the friction


def test_cogging_needs_a_turn_and_an_inertia() -> None:
    with pytest.raises(IdentificationError, match="one whole turn is needed"):
        cogging_of(both_ways(0j, 0.4), shaft({"J_kgm2": J}))
    assert cogging_of(both_ways(0j, 0.4), shaft({})) is None
    assert cogging_of({}, shaft({"J_kgm2": J})) is None


def test_the_current_of_a_coasting_with_the_voltage_on_is_in_the_intervals_of_its_cogging() -> None:
    """79 +- 6 uN m of a 5 W motor with 90: the back-EMF moved 1 mA, whose torque damped the ripple of the speed."""
    rng, i_q = np.random.default_rng(1), 0.005
    signals = {"theta_M_rad": np.zeros(400), "i_d_a": np.zeros(400), "i_q_a": i_q * rng.standard_normal(400)}
    coasting = Trace(0.001 * np.arange(400), signals, dict.fromkeys(signals, "1"), {"coasting": True, "powered": True})
    orders = AngleHarmonics((), (Harmonic(SLOTTED, 0.1 / J.value, 0.0, 1e-3 / J.value),), 7.0)
    mechanics = SimpleNamespace(harmonics=orders)
    known = cast(Evaluation, SimpleNamespace(**{**vars(shaft({"J_kgm2": J})), "mechanics": mechanics}))
    powered, off = (cogging_of(traces, known) for traces in ({"inertia_1": coasting}, {}))
    assert powered is not None and off is not None
    wide, narrow = (found.estimates()["cogging_36_nm"].std for found in (powered, off))
    assert wide == pytest.approx(math.hypot(narrow, K_T * i_q), rel=0.1)
    signals["i_q_a"] *= 10.0
    assert cogging_of({"inertia_1": coasting}, known) is None  # it does not stand out of what the currents hide
