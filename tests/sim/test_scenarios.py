# SPDX-License-Identifier: MIT
"""Scenarios: built-in ones on every profile, files with everything that can be wrong in them, and the trace."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.random_drives import draw_drive
from pmsmtool.errors import ConfigError
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.params.parameter_set import ParameterSet, default_set
from pmsmtool.sim.closed_loop import DRIVE_SIGNALS, TRUE_SIGNALS, drive_values, image_of, simulate
from pmsmtool.sim.scenarios import BUILT_IN, FILE_EXAMPLE, Scenario, built_in, load_scenario
from pmsmtool.sim.simulate import find_drive, find_scenario, run_scenario
from pmsmtool.sim.simulated_machine import (
    DRIVE_FAULTS,
    WRONG_COMPENSATION,
    build_setup,
    own_compensation,
    with_simulation,
)
from pmsmtool.units import UNITS

PROFILES = sorted(path.stem for path in data_folder("profiles").glob("*.toml"))


def machine(name: str):
    return load_machine_file(data_folder("profiles") / f"{name}.toml")


@pytest.fixture(scope="module")
def drive():
    return find_drive("interior-2k2")


@pytest.mark.chain
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("name", BUILT_IN)
def test_every_scenario_runs_on_every_profile(profile, name):
    drive = find_drive(profile)
    trace = run_scenario(drive, find_scenario(name, drive))
    assert not trace["trip"].any()
    if name == "field-weakening-sweep":  # the field is weakened to the end, and there is torque left there
        assert trace["i_d_true_a"][-1] < trace["i_d_true_a"].min() + 0.1 * np.ptp(trace["i_d_true_a"])
        assert trace["torque_true_nm"][-1] > 0.5 * trace["torque_true_nm"].max()
    assert trace.meta["event_overruns"] == 0
    assert all(np.all(np.isfinite(trace[signal])) for signal in trace.signals)
    current = np.hypot(trace["i_d_true_a"], trace["i_q_true_a"])
    assert 0.0 < current.max() < 3.0 * (drive.machine.machine.I_max_apk or math.inf)


def test_trace_has_units_time_and_provenance(drive):
    trace = run_scenario(drive, find_scenario("q-step", drive))
    assert set(trace.signals) == {*DRIVE_SIGNALS, *TRUE_SIGNALS}
    assert all(unit in UNITS for unit in trace.units.values())
    T_s = 1e-9 * round(1e9 / 12000.0)
    assert trace.t_s[0] == 0.0
    assert np.abs(np.diff(trace.t_s) - T_s).max() < 1e-12
    assert trace.meta["machine"] == "interior-2k2"
    assert trace.meta["params"] == drive.params.content_hash()
    assert trace.meta["machine_sha256"] == drive.machine.content_hash()


def test_steps_arrive_when_they_are_scheduled(drive):
    trace = run_scenario(drive, find_scenario("q-step", drive), simulation={"sensor_noise_apk": 0.0})
    asked = trace["i_q_req_a"]
    step = int(np.argmax(asked > 0.0))
    assert trace.t_s[step - 1] < 0.01 <= trace.t_s[step] + 1e-9
    assert trace["i_q_true_a"][-1] == pytest.approx(asked[-1], rel=0.02)


def test_same_seed_same_trace_other_seed_other_noise(drive):
    scenario = find_scenario("q-step", drive)
    first, again, other = (run_scenario(drive, scenario, seed=seed) for seed in (3, 3, 4))
    assert all(np.array_equal(first[name], again[name]) for name in first.signals)
    assert not np.array_equal(first["i_q_a"], other["i_q_a"])


def test_decimation_keeps_every_nth_row(drive):
    scenario = find_scenario("q-step", drive)
    full, thin = run_scenario(drive, scenario), run_scenario(drive, replace(scenario, decimation=7))
    assert np.array_equal(full["i_q_a"][::7], thin["i_q_a"])
    assert np.array_equal(full.t_s[::7], thin.t_s)


def test_speed_mode_reaches_its_reference(drive):
    trace = run_scenario(drive, find_scenario("speed-ramp", drive))
    assert trace["omega_m_rad_s"][-1] == pytest.approx(1500.0 * math.pi / 30.0, rel=5e-3)


def test_load_step_is_carried(drive):
    trace = run_scenario(drive, find_scenario("load-step", drive))
    loaded = (trace.t_s > 0.5) & (trace.t_s < 0.6)
    friction = 0.002 * 78.5 + 0.12
    assert np.mean(trace["torque_true_nm"][loaded]) == pytest.approx(
        np.mean(trace["load_nm"][loaded]) + friction, rel=0.05
    )


# ---- files ---------------------------------------------------------------------------------------------------------


def write(tmp_path, text: str):
    path = tmp_path / "scenario.toml"
    path.write_text(text, encoding="utf-8")
    return path


GOOD = """schema = "pmsmtool.scenario/1"
duration_s = 0.03
mode = "speed"
rotor = "free"
start_rpm = 300
decimation = 2
[schedule]
speed_rpm = [[0.0, 300], [0.02, 300], [0.02, 400.0]]
load_nm = 1.5
U_dc_v = [[0.0, 540], [0.03, 500]]
[simulation]
sensor_noise_apk = 0
"""


def test_the_example_of_the_help_runs(tmp_path, drive):
    trace = run_scenario(drive, load_scenario(write(tmp_path, FILE_EXAMPLE)))
    assert trace.t_s[-1] == pytest.approx(0.4, abs=1e-3)
    assert not trace["trip"].any()
    assert trace["omega_m_rad_s"].max() > 50.0


def test_file_says_what_happens(tmp_path, drive):
    scenario = load_scenario(write(tmp_path, GOOD))
    assert scenario.name == "scenario"
    assert scenario.schedule["load_nm"] == ((0.0, 1.5),)
    trace = run_scenario(drive, scenario)
    assert len(trace) == 180
    assert trace["omega_m_rad_s"][0] == pytest.approx(300.0 * math.pi / 30.0)
    assert np.all(trace["load_nm"] == 1.5)
    assert trace["U_dc_v"][-1] == pytest.approx(500.0, abs=0.5)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"pmsmtool.scenario/1"', '"pmsmtool.scenario/9"', "another schema"),
        ('mode = "speed"', 'mode = "sped"', "did you mean speed"),
        ("duration_s = 0.03", "", "duration_s is missing"),
        ("duration_s = 0.03", "duration_s = -1", "duration_s = -1 is below"),
        ("duration_s = 0.03", 'duration_s = "0.1s"', "duration_s is text; write the number 0.1"),
        ("decimation = 2", "decimation = 0", "below 1"),
        ("decimation = 2", "decimation = nan", "decimation = nan is not finite"),
        ("decimation = 2", "decimation = 1.5", "is not a whole number"),
        ('rotor = "free"', 'rotor = "loose"', "not one of free, locked, driven"),
        ("speed_rpm = [[0.0, 300]", "speed_rmp = [[0.0, 300]", "did you mean speed_rpm"),
        ("[0.02, 300], [0.02, 400.0]", "[0.02, 300], [0.01, 400.0]", "the times decrease"),
        ("load_nm = 1.5", "load_nm = []", "has no nodes"),
        ("load_nm = 1.5", "load_nm = [[0.0]]", "neither a number nor a list"),
        ("load_nm = 1.5", "load_nm = [[0.0, nan]]", "not finite"),
        ("start_rpm = 300", "start_rpm = 300\ncolour = 1", "colour: unknown"),
        ("[simulation]", "[[simulation]]", "not a table"),
        ("schema", "schema = [", "not TOML"),
    ],
)
def test_bad_file_is_refused_with_its_reason(tmp_path, old, new, said):
    assert old in GOOD
    with pytest.raises(ConfigError) as caught:
        load_scenario(write(tmp_path, GOOD.replace(old, new, 1)))
    assert said in str(caught.value)
    assert "scenario.toml" in str(caught.value)


def test_all_violations_are_listed_at_once(tmp_path):
    text = GOOD.replace('"speed"', '"fly"').replace("decimation = 2", "decimation = -3")
    with pytest.raises(ConfigError) as caught:
        load_scenario(write(tmp_path, text))
    assert len(caught.value.violations) == 2


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"duration_s": "60ms"}, "duration_s is '60ms', not a number"),
        ({"schedule": {"i_q_a": [(0.0, 0.0), (10.0, 5.0)]}}, "first change is at 10 s, the run ends at 0.06 s"),
        ({"schedule": {"i_q_a": ([0.0, 0.01, 0.02], [0.0, 0.0, 5.0])}}, "a node is not a time in s and a value"),
    ],
)
def test_a_scenario_in_another_unit_or_form_is_refused(changes, said):
    with pytest.raises(ConfigError) as caught:
        Scenario(**{"name": "mine", "duration_s": 0.06, "mode": "current", **changes})
    assert said in str(caught.value)


def test_nodes_may_be_the_rows_of_an_array():
    nodes = np.array([[0.0, 0.0], [0.01, 5.0]])
    assert len(Scenario("mine", 0.06, "current", {"i_q_a": nodes}).schedule["i_q_a"]) == 2


def test_a_trace_says_that_the_drive_tripped(drive):
    healthy = run_scenario(drive, find_scenario("q-step", drive))
    assert "tripped" not in repr(healthy)
    fast = Scenario("fast", 0.01, "current", {"driven_rpm": [(0.0, 9000.0)]}, rotor="driven", start_rpm=9000.0)
    assert "the drive tripped (error code 0x" in repr(run_scenario(drive, fast))


def test_missing_file_and_unknown_name(tmp_path, drive):
    with pytest.raises(ConfigError, match="no such file"):
        find_scenario(str(tmp_path / "nothing.toml"), drive)
    with pytest.raises(ConfigError, match="did you mean q-step"):
        find_scenario("q-steps", drive)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"mode": "speed", "rotor": "locked", "start_rpm": 10.0}, "a locked rotor does not turn"),
        ({"schedule": {"driven_rpm": ((0.0, 100.0),)}, "rotor": "free"}, "driven_rpm needs rotor"),
        ({"duration_s": 3000.0}, "too many"),
    ],
)
def test_scenario_that_does_not_fit_is_refused(drive, changes, said):
    with pytest.raises(ConfigError) as caught:
        run_scenario(drive, replace(find_scenario("q-step", drive), **changes))
    assert said in str(caught.value)


def test_speed_mode_without_a_speed_controller_is_refused():
    with pytest.raises(ConfigError, match="speed controller"):
        simulate(machine("interior-2k2"), default_set(), Scenario("s", 0.01, "speed"))


# ---- what the machine file says --------------------------------------------------------------------------------------


def test_loop_resistance_is_what_the_file_says():
    """Devices and phase together: R_s_ohm of [machine], whatever the inverter model."""
    for model, devices in (("averaged", 0.02), ("switched", 0.5 * (0.02 + 0.018))):
        setup, _ = build_setup(with_simulation(machine("interior-2k2"), {"inverter_model": model}))
        assert setup.machine.R_copper + setup.machine.R_fixed == pytest.approx(3.6 - devices, rel=1e-12)


def test_winding_resistance_is_the_copper_part():
    source = machine("interior-2k2")
    source = replace(source, machine=replace(source.machine, R_winding_ohm=3.0))
    setup, _ = build_setup(source)
    assert setup.machine.R_copper == pytest.approx(3.0, rel=1e-12)
    assert setup.machine.R_fixed == pytest.approx(3.6 - 0.02 - 3.0, rel=1e-9)


def test_truth_may_differ_from_the_file():
    source = with_simulation(machine("interior-2k2"), {"R_s_ohm": 4.0, "L_d_h": 0.03, "pole_pairs": 4, "psi_f_wb": 0.6})
    setup, _ = build_setup(source)
    assert (setup.machine.L_d, setup.machine.psi_f, setup.machine.pole_pairs) == (0.03, 0.6, 4)
    assert setup.machine.L_q == 0.051
    assert setup.machine.R_copper == pytest.approx(3.98)


def test_every_drive_fault_can_be_built():
    for fault in DRIVE_FAULTS:
        build_setup(with_simulation(machine("interior-2k2"), {"drive_fault": fault}))
    setup, _ = build_setup(with_simulation(machine("interior-2k2"), {"drive_fault": "not_connected"}))
    assert list(setup.inverter.open) == [1, 1, 1]
    setup, _ = build_setup(with_simulation(machine("interior-2k2"), {"phase_open": "b"}))
    assert list(setup.inverter.open) == [0, 1, 0]


def test_an_imbalance_of_the_resistances_keeps_their_mean():
    setup, _ = build_setup(with_simulation(machine("interior-2k2"), {"resistance_imbalance": 0.04}))
    even, _ = build_setup(machine("interior-2k2"))
    R_mean = even.machine.R_copper + even.machine.R_fixed
    phases = [setup.machine.R_copper + setup.machine.R_fixed + more for more in setup.inverter.r_leg]
    assert sum(phases) / 3.0 == pytest.approx(R_mean, rel=1e-12)
    assert phases[0] / R_mean == pytest.approx(1.04, rel=1e-2)  # of the loop, the switches' share included


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"drive_fault": "gremlins"}, "no drive fault"),
        ({"sampling_shift_s": 9e-5}, "not within one period"),
        ({"leg_mismatch_s": 3e-6}, "leaves no dead time"),
        ({"J_load_kgm2": 0.01}, "coupling_stiffness"),
        ({"inverter_model": "switched", "output_capacitance_f": 1e-15}, "not resolved"),
        ({"R_s_ohm": 0.01}, "must exceed the devices' share"),
    ],
)
def test_what_cannot_be_simulated_is_refused(changes, said):
    with pytest.raises(ConfigError) as caught:
        build_setup(with_simulation(machine("interior-2k2"), changes))
    assert said in str(caught.value)


def test_an_elastic_shaft_of_unstated_damping_does_not_swing_for_ever():
    """1 % of critical damping, where 2 zeta w_r J_1 J_2 / (J_1 + J_2) is that of two masses; what is stated holds."""
    spring = {"J_kgm2": 2e-3, "J_load_kgm2": 5e-3, "coupling_stiffness_nm_per_rad": 400.0}
    common = 2e-3 * 5e-3 / 7e-3
    setup, _ = build_setup(with_simulation(machine("interior-2k2"), spring))
    assert setup.machine.coupling_damping == pytest.approx(0.02 * math.sqrt(400.0 / common) * common, rel=1e-12)
    stated = {**spring, "coupling_damping_nms_per_rad": 1e-6}
    assert build_setup(with_simulation(machine("interior-2k2"), stated))[0].machine.coupling_damping == 1e-6


def test_every_drive_of_the_population_can_be_simulated():
    # 2.96 us of dead time, 86 pF and 0.24 mH ring longest of 8000 drives: 70 steps in a dead time
    build_setup(draw_drive(74814))
    for seed in range(200):
        build_setup(draw_drive(seed))


def test_machine_file_limits_of_the_simulation():
    source = machine("interior-2k2")
    without = replace(source, machine=replace(source.machine, J_kgm2=None))
    with pytest.raises(ConfigError, match="free rotor needs J_kgm2"):
        build_setup(without)
    odd = replace(source, inverter=replace(source.inverter, delay_periods=1.2))
    with pytest.raises(ConfigError, match=r"simulated are 0\.5, 1\.5 and 2\.5"):
        build_setup(odd)
    early = replace(source, inverter=replace(source.inverter, delay_periods=0.5))
    with pytest.raises(ConfigError, match="late sample"):
        build_setup(with_simulation(early, {"sampling_shift_s": 1e-6}))
    with pytest.raises(ConfigError, match="the flux map is the machine"):
        build_setup(with_simulation(machine("saturated-pmsyrm"), {"L_d_h": 0.03}))


def test_unknown_simulation_key_is_named():
    with pytest.raises(ConfigError, match="sensor_nois: unknown key; did you mean sensor_noise_apk"):
        with_simulation(machine("interior-2k2"), {"sensor_nois": 1.0})


def test_compensation_built_into_the_drive():
    source = machine("interior-2k2")
    assert own_compensation(source) == {}
    right = own_compensation(with_simulation(source, {"compensation": "right"}))
    wrong = own_compensation(with_simulation(source, {"compensation": "wrong"}))
    plateau = 540.0 * 2e-6 * 12000.0 + 0.8
    assert right["inverter.V_dead_v"] == pytest.approx(plateau)
    assert wrong["inverter.V_dead_v"] == pytest.approx(WRONG_COMPENSATION * plateau)
    after = with_simulation(source, {"compensation": "right", "recorded_voltage": "after"})
    assert int(drive_values(after, default_set())["current.options"]) & 32


def test_right_compensation_hides_the_dead_time(drive):
    """Locked at 5 A: without compensation the demand holds the whole error, with the right one next to nothing."""
    scenario = Scenario(
        "hold", 0.2, "current", {"i_d_a": ((0.0, 5.0),)}, rotor="locked", simulation={"sensor_noise_apk": 0.0}
    )
    demand = {}
    for kind in ("off", "right", "wrong"):
        trace = run_scenario(drive, scenario, simulation={"compensation": kind, "thermal_on": False})
        demand[kind] = float(np.mean(trace["u_d_lim_v"][-400:])) - 3.6 * (1.0 + 0.00393 * 5.0) * 5.0
    error = 4.0 / 3.0 * (540.0 * 2e-6 * 12000.0 + 0.8)
    assert demand["off"] == pytest.approx(error, rel=0.02)
    assert abs(demand["right"]) < 0.05 * error
    assert demand["wrong"] == pytest.approx(-(WRONG_COMPENSATION - 1.0) * error, rel=0.05)


def test_look_up_table_reaches_the_core():
    """A parameter set with tables: the torque reference becomes the currents of the table."""
    source = machine("interior-2k2")
    params = find_drive("interior-2k2").params
    with_table = ParameterSet(
        {**params.values, "field_weakening.mode": 1, "lut.format": 1, "lut.axis_kind": 0,
         "lut.n_x": 2, "lut.n_y": 2, "lut.n_z": 1},
        {"lut.axis_x": (0.0, 20.0), "lut.axis_y": (0.0, 3000.0), "lut.axis_z": (540.0,),
         "lut.i_d_a": (0.0, 0.0, -4.0, -4.0), "lut.i_q_a": (0.0, 0.0, 6.0, 6.0)},
    )  # fmt: skip
    assert len(image_of(source, with_table)) > len(image_of(source, params))
    scenario = Scenario("t", 0.05, "torque", {"torque_nm": ((0.0, 10.0),)}, rotor="driven", start_rpm=500.0)
    trace = simulate(source, with_table, scenario)
    assert trace["i_d_req_a"][-1] == pytest.approx(-2.0, rel=1e-5)
    assert trace["i_q_req_a"][-1] == pytest.approx(3.0, rel=1e-5)


def test_parameter_file_is_laid_over_the_design(tmp_path):
    path = tmp_path / "params.toml"
    path.write_text(ParameterSet({"current.K_p_d_v_per_a": 1.25}).to_toml(), encoding="utf-8")
    assert find_drive("interior-2k2", path).params.values["current.K_p_d_v_per_a"] == 1.25


def test_find_drive_takes_designs_and_run_directories(tmp_path, drive):
    from pmsmtool.design.design_file import design_text
    from pmsmtool.design.tune import tune

    text = design_text(tune(drive.machine))
    (tmp_path / "design.toml").write_text(text, encoding="utf-8")
    for source in (str(tmp_path), str(tmp_path / "design.toml")):
        found = find_drive(source)
        assert found.origin == "design"
        assert found.params.content_hash() == drive.params.content_hash()
    (tmp_path / "other.toml").write_text('schema = "something/1"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match="schema is"):
        find_drive(str(tmp_path / "other.toml"))
    with pytest.raises(ConfigError, match="interior-2k2"):
        find_drive("interior-2k")


def test_built_in_needs_no_rated_values():
    source = machine("interior-2k2")
    bare = replace(source, machine=replace(source.machine, I_nom_apk=None, n_nom_rpm=None, n_max_rpm=None))
    values = dict(default_set().values)
    scenario = built_in("field-weakening-sweep", bare, values)
    speeds = [n for _, n in scenario.schedule["driven_rpm"]]
    assert speeds[0] < speeds[-1]
