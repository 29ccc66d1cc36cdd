# SPDX-License-Identifier: MIT
"""A link behind a supply that only feeds: energy balance, and braking, cut and trip at n_max on every profile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.link_events import ALLOWED, EVENTS, LOADS, run
from pmsmtool.design.ratings import ratings
from pmsmtool.design.tune import tune
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.machine.uncontrolled_generation import SPEED_ROOM, generation_rpm
from pmsmtool.sim.closed_loop import simulate
from pmsmtool.sim.kernel import Application
from pmsmtool.sim.scenarios import Scenario
from tests.sim.test_every_switch import IDEAL

PROFILES = sorted(path.stem for path in data_folder("profiles").glob("*.toml"))
BALANCE = 0.01
"""Energy in the capacitor against that of the shaft less copper loss, relative (measured 0.0013 to 0.0026)."""


def profile(name: str) -> MachineFile:
    return load_machine_file(data_folder("profiles") / f"{name}.toml")


@pytest.mark.parametrize("model", ["averaged", "switched"])
def test_braking_charges_the_capacitor_by_what_the_shaft_gives(model: str) -> None:
    source, C, rpm = profile("interior-2k2"), 1e-3, 900.0
    link = {**IDEAL, "inverter_model": model, "dead_time_s": 2e-6, "deadtime_shape": "tanh", "device_drop_v": 1.0}
    link |= {"diode_drop_v": 1.0, "U_dc_capacitance_f": C, "U_dc_chopper_v": 740.0}
    schedule = {"i_q_a": ((0.0, 0.0), (0.01, 0.0), (0.01, -6.0)), "driven_rpm": ((0.0, rpm),)}
    scenario = Scenario("braking", 0.05, "current", schedule, "driven", rpm, simulation=link)
    trace = simulate(source, tune(source).parameter_set(), scenario, application=Application.CORE)
    U = trace["U_dc_v"]
    rows = slice(int(0.02 * 12000), int(0.045 * 12000))
    i = np.hypot(trace["i_d_true_a"], trace["i_q_true_a"])[rows]
    drops = 2.0 / np.pi * 3.0 * i  # 1 V in each phase, in the mean over a turn
    shaft = -trace["torque_true_nm"][rows] * trace["omega_m_rad_s"][rows] - 1.5 * 3.6 * i**2 - drops
    stored = 0.5 * C * (U[rows.stop] ** 2 - U[rows.start] ** 2)
    assert stored == pytest.approx(shaft.sum() / 12000.0, rel=BALANCE)
    assert U[0] == 540.0 < U[rows.stop] < 740.0


def test_a_chopper_holds_the_link_and_a_cut_supply_lets_it_fall() -> None:
    source = profile("interior-2k2")
    link = {**IDEAL, "U_dc_capacitance_f": 1e-4}
    for i_q, low, high in ((-6.0, 500.0, 567.0), (6.0, 0.0, 540.5)):
        schedule = {
            "i_q_a": ((0.0, 0.0), (0.01, 0.0), (0.01, i_q)),
            "driven_rpm": ((0.0, 900.0),),
            "U_dc_v": ((0.0, 540.0), (0.01, 540.0), (0.01, 0.0)),
        }
        scenario = Scenario("cut", 0.03, "current", schedule, "driven", 900.0, simulation=link)
        U = simulate(source, tune(source).parameter_set(), scenario, application=Application.CORE)["U_dc_v"]
        assert low <= U.min() and U.max() <= high
        assert U[-1] == 567.0 if i_q < 0.0 else U[-1] < 400.0


@pytest.mark.chain
@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("name", PROFILES)
def test_the_link_stays_below_its_limit_at_the_largest_speed(name: str, event: str) -> None:
    """1.05 to 1.07; before: 1.29 to 1.99, gates off and overvoltage trips at 1.25 to 1.9 of the nominal voltage."""
    design = tune(profile(name))
    U = design.machine.inverter.U_dc_v
    assert max(run(design, event, load).U_dc_v for load in LOADS) <= ALLOWED * U


def test_a_machine_that_nothing_protects_gets_no_speed_beyond() -> None:
    """Its largest speed was a note: at 3000 rpm the back-EMF is 911 V on a link for 750 V."""
    whole = profile("interior-2k2")
    bare = replace(whole, inverter=replace(whole.inverter, U_dc_chopper_v=None))
    n_ucg = generation_rpm(bare.machine, 750.0)
    design = tune(bare)
    assert design["protection.n_trip_rpm"] == pytest.approx(n_ucg) and n_ucg < 2500.0
    assert design["motor.n_max_rpm"] == pytest.approx(n_ucg / SPEED_ROOM)
    assert any(f"largest speed {n_ucg / SPEED_ROOM:.4g} rpm" in note for note in design.notes)
    assert tune(whole)["motor.n_max_rpm"] == ratings(bare, 300.0, "chopper").n_max_rpm == 3000.0
