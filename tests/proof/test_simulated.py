# SPDX-License-Identifier: MIT
"""The machines and starts that a prediction draws."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.machine.parameters import Estimate, InverterParameters, MachineParameters
from pmsmtool.proof.conditions import Conditions
from pmsmtool.proof.drawn_machine import bend_of
from pmsmtool.proof.plan import SIGNALS, plan_proof
from pmsmtool.proof.simulated import SimulatedDrives
from pmsmtool.units import rad_s_from_rpm

pytestmark = pytest.mark.chain


def test_offsets_are_drawn_about_what_the_sensors_show() -> None:
    base = load_machine_file(data_folder("profiles") / "interior-2k2.toml")
    design = tune(base, TuneRequest(field_weakening="off"))
    conditions = Conditions(540.0, math.nan, math.nan, 2**17, 10.0, 300.0, offsets_apk=(0.3, -0.2, -0.1))
    drives = SimulatedDrives(design, conditions, plan_proof(design, conditions), 16, seed=0)
    drawn = np.array([list(setup.sensors.offset) for setup in drives.setups])
    np.testing.assert_allclose(drawn.mean(axis=0), conditions.offsets_apk, atol=0.02)  # 0.004 measured
    assert 0.0 < np.std(drawn, axis=0).max() < 0.05


def test_inductances_are_drawn_over_the_currents_of_the_steps_where_they_bend() -> None:
    """L_d 17 % larger at the steps' other end failed a healthy machine: a loop gain 0.932, 0.955 to 1.04 predicted."""
    base = load_machine_file(data_folder("profiles") / "interior-2k2.toml")
    I_nom, L_d, L_q = base.machine.I_nom_apk, base.machine.L_d_h, base.machine.L_q_h
    assert I_nom is not None
    at_bias = Estimate(L_d, 0.005 * L_d, 0.0, "H", i_d_apk=0.5 * I_nom, i_q_apk=0.0)
    known = replace(base, estimates={"L_d_h": at_bias}, std={"L_d_h": 0.005 * L_d, "L_q_h": 0.005 * L_q})
    bent = replace(known, conditions={"L_d_bend_per_a": -0.3 / I_nom})
    assert (bend_of(known), bend_of(bent)) == (0.0, -0.3 / I_nom)
    spans = []
    for machine in (known, bent):
        design = tune(machine, TuneRequest(field_weakening="off"))
        conditions = Conditions(540.0, math.nan, math.nan, 2**17, 10.0, 300.0)
        drives = SimulatedDrives(design, conditions, plan_proof(design, conditions), 24, seed=0)
        drawn = np.array([(s.machine.L_d / L_d, s.machine.L_q / L_q) for s in drives.setups])
        spans.append((drawn.min(axis=0), drawn.max(axis=0)))
    (low, high), (low_bent, high_bent) = spans
    assert np.all(low > 0.98) and np.all(high < 1.02)  # 0.987 to 1.013
    assert low_bent[0] < 1.05 and high_bent[0] > 1.2  # from the one end of the steps to the other: 1 to 1.3
    assert low_bent[1] < 0.98 and 1.05 < high_bent[1] < 1.2  # 0.93 to 1.15


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


def test_no_predicted_drive_has_tripped_before_its_record_begins() -> None:
    """A drag, which nothing held, slowed light machines so much that the start for it was beyond their trip."""
    machine = MachineParameters(
        7, 0.05, 25e-6, 25e-6, 0.005, I_nom_apk=30.0, I_max_apk=60.0, n_nom_rpm=750.0, n_max_rpm=1420.0,
        J_kgm2=1.2e-5, B_nms=2e-6, tau_c_nm=0.002,
    )  # fmt: skip
    source = MachineFile("light", machine, InverterParameters(U_dc_v=24.0, f_s_hz=40e3, dead_time_s=0.3e-6))
    made = tune(source, TuneRequest())
    limits = Conditions(24.0, 25.0, 25.0, 1 << 17, made["motor.I_max_apk"], rad_s_from_rpm(made["motor.n_max_rpm"]))
    plan = plan_proof(made, limits)
    step = next(e for e in plan.experiments if e.name == "q_steps")
    drag = 0.3 * machine.torque_nm(0.0, 30.0) / step.base_rad_s**2
    made = tune(replace(source, conditions={"drag_nms2": drag}), TuneRequest())
    found = SimulatedDrives(made, limits, plan, 4, 0).respond(replace(step, rows=step.pattern_rows, repeats=1))
    reached = np.max(np.abs(found[:, SIGNALS.index("i_q_a")]), axis=1)
    assert (reached > 0.8 * step.excitation.amplitude).all()  # 0.84 to 0.87, of tripped ones 0.03
