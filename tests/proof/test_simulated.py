# SPDX-License-Identifier: MIT
"""The machines and starts that a prediction draws."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.proof.plan import Conditions, plan_proof
from pmsmtool.proof.simulated import SimulatedDrives
from pmsmtool.resources import data_folder

pytestmark = pytest.mark.chain


def test_offsets_are_drawn_about_what_the_sensors_show() -> None:
    base = load_machine_file(data_folder("profiles") / "interior-2k2.toml")
    design = tune(base, TuneRequest(field_weakening="off"))
    conditions = Conditions(540.0, math.nan, math.nan, 2**17, 10.0, 300.0, offsets_apk=(0.3, -0.2, -0.1))
    drives = SimulatedDrives(design, conditions, plan_proof(design, conditions), 16, seed=0)
    drawn = np.array([list(setup.sensors.offset) for setup in drives.setups])
    np.testing.assert_allclose(drawn.mean(axis=0), conditions.offsets_apk, atol=0.02)  # 0.004 measured
    assert 0.0 < np.std(drawn, axis=0).max() < 0.05


def test_what_holds_the_shaft_before_a_move_is_drawn_anew_before_the_next() -> None:
    """With one draw for both, a friction that held both alike cancelled: a healthy drive came to 131 % of a band."""
    base = load_machine_file(data_folder("profiles") / "interior-2k2.toml")
    known = replace(
        base, machine=replace(base.machine, tau_c_nm=0.5, B_nms=0.0), conditions={"shaft_response": "rigid"}
    )
    design = tune(known, TuneRequest(field_weakening="off"))
    conditions = Conditions(540.0, math.nan, math.nan, 2**17, 10.0, 300.0)
    plan = plan_proof(design, conditions)
    there, back = (e for e in plan.experiments if e.move is not None)
    drives = SimulatedDrives(design, conditions, plan, 6, seed=0)
    held = np.array([drives.respond(e)[:, e.signals.index("i_q_a"), 0] for e in (there, back)])
    assert float(np.ptp(held)) > 0.1  # A: 0.5 N m either way
    apart = np.abs(held[0] - held[1])
    assert float(np.min(apart)) > 5e-3  # of six: 0.015 to 0.30; with one draw 0
    assert np.any(held[0] * held[1] < 0.0)
    again = SimulatedDrives(design, conditions, plan, 6, seed=0).respond(there)[:, there.signals.index("i_q_a"), 0]
    np.testing.assert_array_equal(again, held[0])
