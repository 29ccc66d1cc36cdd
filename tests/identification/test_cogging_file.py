# SPDX-License-Identifier: MIT
"""Cogging as values and as a table over the encoder's angle."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmsmtool.estimators.angle_harmonics import AngleHarmonics, Harmonic
from pmsmtool.estimators.shaft.mechanics import MechanicsResult
from pmsmtool.identification.cogging_file import COGGING_CSV, ROWS, cogging_estimates, save_cogging
from pmsmtool.machine.parameters import Estimate
from pmsmtool.run_directory import RunDirectory, new_record

J = Estimate(0.015, 1e-5, 2e-4, "kg m2")
ORDERS = (Harmonic(12, 30.0, 40.0, 0.5), Harmonic(36, 0.0, 4.0, 0.2))
FOUND = MechanicsResult(J, J, J, (0.0, 0.0, 0.0), 0.0, 1.0, 10.0, False, AngleHarmonics((), ORDERS, 7.0))


def test_cogging_is_told_by_order_and_as_a_table(tmp_path: Path) -> None:
    values = cogging_estimates(FOUND)
    assert values["cogging_12_nm"].value == pytest.approx(0.75) and values["cogging_36_nm"].value == pytest.approx(0.06)
    assert values["cogging_12_rad"].value == pytest.approx(math.atan2(40.0, 30.0))
    run = RunDirectory.create(tmp_path, 1, new_record(["test"], drive={}, bus={}, versions={}, operator="nobody"))
    assert save_cogging(run, FOUND, -1) == {COGGING_CSV: ""}
    table = np.loadtxt(run.path / COGGING_CSV, delimiter=",", skiprows=1)
    assert table.shape == (ROWS, 3)
    along = -table[:, 0]  # an encoder that counts against the phase order
    true = 0.75 * np.cos(12.0 * along - math.atan2(40.0, 30.0)) + 0.06 * np.sin(36.0 * along)
    assert np.max(np.abs(table[:, 1] - true)) < 1e-5
    none = replace(FOUND, harmonics=AngleHarmonics())
    assert cogging_estimates(none) == {} and save_cogging(run, none, 1) == {} and cogging_estimates(None) == {}
