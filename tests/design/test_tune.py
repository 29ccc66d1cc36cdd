# SPDX-License-Identifier: MIT
"""Designs: complete, explained, reproducible, refused when they cannot hold."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.random_drives import draw_drive
from pmsmtool.cli.main import cli
from pmsmtool.design.design_file import Design, design_text, load_design, parse_design
from pmsmtool.design.lookup.table import torque_limits
from pmsmtool.design.loops.current_loop import AxisPlant, axis_loop, imc
from pmsmtool.design.loops.designed_loops import choose_current, least_inductance
from pmsmtool.design.loops.sampled_loop import margins
from pmsmtool.design.operating_machine import at_temperature
from pmsmtool.design.ratings import base_speed_rpm, ratings
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import ConfigError, DesignInfeasible
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.machine.parameters import InverterParameters, MachineLimits, MachineParameters, dead_time_compensation
from pmsmtool.params.catalogue import CATALOGUE
from pmsmtool.params.parameter_set import parse_parameter_set

PROFILES = Path(__file__).resolve().parents[2] / "profiles"

T_S_ROUNDED = 1e-5
"""A gain from the period of the set, whole nanoseconds, against one from 1/12 kHz, relative (measured 1.3e-6)."""

SURFACE = MachineFile(
    "surface",
    MachineParameters(4, 0.137, 2.3e-3, 2.1e-3, 0.41, I_nom_apk=28.0, I_max_apk=56.0, n_nom_rpm=620.0, J_kgm2=0.05),
    InverterParameters(210.0, 12e3),
)


def saturated() -> MachineFile:
    i = np.linspace(-30.0, 30.0, 13)
    d, q = np.meshgrid(i, i, indexing="ij")
    flux_map = FluxMap(i, i, 0.1 + 0.1 * np.tanh(d / 20.0) + 1e-3 * d, 0.3 * np.tanh(q / 12.0) + 2e-3 * q)
    machine = replace(SURFACE.machine, L_d_h=6e-3, L_q_h=20e-3, I_max_apk=28.0)
    return replace(SURFACE, flux_map=flux_map, machine=machine)


@pytest.mark.chain
@pytest.mark.parametrize("profile", sorted(PROFILES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_profile_gives_a_complete_valid_set(profile: Path) -> None:
    design = tune(load_machine_file(profile))
    assert set(design.values) == {row.name for row in CATALOGUE}
    assert all(value.method for value in design.values.values())
    assert design.parameter_set().violations() == ()
    assert all(loop.stable for loop in design.loops.values())


def test_the_reference_machine_gets_the_modulus_optimum() -> None:
    design = tune(SURFACE)
    assert design["current.K_p_d_v_per_a"] == pytest.approx(9.2)
    assert design["current.K_p_q_v_per_a"] == pytest.approx(8.4)
    assert design["current.K_i_d_v_per_as"] == pytest.approx(548.0)
    assert design["inverter.T_s_ns"] == 83333
    independent = margins(axis_loop(imc(0.137, 2.3e-3, 4000.0), AxisPlant(0.137, 2.3e-3, 1.0 / 12e3, 1.5)))
    assert design.loops["current_d"] == independent
    # 0.92 V_max carries 28 A at 620 rpm, as the operating point of the machine was chosen
    assert base_speed_rpm(SURFACE, 28.0, -56.0, 0.92 * 210.0 / math.sqrt(3.0)) == pytest.approx(620.0, rel=5e-3)


def test_text_and_back() -> None:
    for source in (SURFACE, saturated()):
        design = tune(source, TuneRequest(bandwidth_hz=120.0, notch_hz=90.0))
        text = design_text(design)
        again = parse_design(text)
        assert design_text(again) == text
        assert again.values == design.values
        assert again.loops == design.loops
        assert again.parameter_set().to_toml() == design.parameter_set().to_toml()
        assert tune(again.machine, TuneRequest(**dict(again.request))).parameter_set() == design.parameter_set()  # type: ignore[arg-type]
        assert parse_parameter_set(design.parameter_set().to_toml()).values == design.parameter_set().values


@pytest.mark.chain
def test_same_bytes_for_the_same_machine_wherever_it_lies(tmp_path: Path) -> None:
    source = PROFILES / "saturated-pmsyrm.toml"
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for name in ("saturated-pmsyrm.toml", "saturated-pmsyrm.csv"):
        (moved / name).write_bytes((PROFILES / name).read_bytes())
    here, there = (design_text(tune(load_machine_file(path))) for path in (source, moved / source.name))
    assert here == there
    assert str(tmp_path) not in there


@cache
def text_of_surface() -> str:
    return design_text(tune(SURFACE))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (("R_s_ohm = 0.137", "R_s_ohm = 0.138"), "machine"),
        (("[value.current.K_p_d_v_per_a]", "[value.current.K_p_d_v_per]"), "did you mean"),
        (('schema = "pmsmtool.design/1"', 'schema = "pmsmtool.design/9"'), "schema"),
        (('unit = "V/A"', 'unit = "ohm"'), "unit"),
        (('loop = "current_d"', 'loop = "current_x"'), "loop"),
        (("[machine_file]", "[machine_fil]"), "machine_file"),
        (("[request]", "[request"), "TOML"),
        (("voltage_margin = 0.08", "voltage_margin = 0.8"), "outside 0..0.5"),
    ],
)
def test_a_damaged_design_is_refused(edit: tuple[str, str], message: str) -> None:
    text = text_of_surface()
    assert edit[0] in text
    with pytest.raises(ConfigError) as caught:
        parse_design(text.replace(*edit))
    assert message in str(caught.value)


def test_a_bandwidth_beyond_the_delay_is_refused_with_one_that_works() -> None:
    with pytest.raises(DesignInfeasible) as caught:
        tune(SURFACE, TuneRequest(bandwidth_hz=3000.0))
    hint = re.search(r"at most ([\d.]+) Hz", caught.value.hint)
    assert hint is not None
    design = tune(SURFACE, TuneRequest(bandwidth_hz=0.9999 * float(hint.group(1))))
    loop = design.loops["current_d"]
    # 6 dB bind before 45 degree
    assert loop.gain_margin_db == pytest.approx(6.0, abs=0.02)
    assert loop.phase_margin_deg >= 45.0


@pytest.mark.chain
def test_saturation_lowers_the_bandwidth_until_the_least_inductance_holds() -> None:
    source = saturated()
    least = least_inductance(source, 28.0)
    assert least["q"] < 0.25 * source.machine.L_q_h
    design = tune(source)
    assert design.loops["current_q_saturated"].gain_margin_db >= 6.0
    assert design.loops["current_q_saturated"].gain_margin_db == pytest.approx(6.0, abs=0.01)
    alone = choose_current(replace(source, flux_map=None), TuneRequest(), 28.0)
    assert design["governor.alpha_rad_s"] < 0.6 * alone.alpha


def test_second_order_and_predictor_reach_the_parameters() -> None:
    design = tune(SURFACE, TuneRequest(method="second-order", bandwidth_hz=250.0, damping=1.0))
    w_n = 2.0 * math.pi * 250.0
    assert design["current.K_i_d_v_per_as"] == pytest.approx(w_n**2 * 2.3e-3)
    assert design["current.K_p_d_v_per_a"] == pytest.approx(2.0 * w_n * 2.3e-3 - 0.137)
    predicted = tune(SURFACE, TuneRequest(bandwidth_hz=1200.0, predictor=True))
    assert int(predicted["current.options"]) & 16
    with pytest.raises(DesignInfeasible):
        tune(SURFACE, TuneRequest(bandwidth_hz=1200.0))
    with pytest.raises(DesignInfeasible, match="predict"):
        tune(replace(SURFACE, inverter=InverterParameters(210.0, 12e3, delay_periods=0.5)), TuneRequest(predictor=True))


@pytest.mark.chain
@pytest.mark.parametrize(
    ("f_s_hz", "delay", "controller", "predicts"),
    [(2400.0, 1.0, "pi", True), (2700.0, 1.5, "pi", False), (2400.0, 0.5, "pi", False), (2400.0, 1.5, "polar", False)],
)
def test_a_rotor_that_turns_far_in_a_period_gets_the_predictor(
    f_s_hz: float, delay: float, controller: str, predicts: bool
) -> None:
    """At base speed it turns by 0.108 rad at 2400 Hz, 0.096 at 2700."""
    source = replace(SURFACE, inverter=InverterParameters(210.0, f_s_hz, delay_periods=delay))
    request = TuneRequest(controller=controller, bandwidth_hz=60.0)
    design = tune(source, request)
    assert bool(int(design["current.options"]) & 16) == design.request["predictor"] == predicts
    assert not int(tune(source, replace(request, predictor=False))["current.options"]) & 16


def test_what_eddy_currents_hide_of_an_inductance_is_told_at_the_loops_frequency() -> None:
    """Of the circuit L parallel to a branch L_e + R_e, by its complex impedance."""
    L, tau, share = SURFACE.machine.L_d_h, 1e-4, 0.2
    source = replace(SURFACE, conditions={"eddy_d_s": share * tau, "eddy_d_time_s": tau})
    design = tune(source)
    (note,) = [note for note in design.notes if "eddy currents" in note]
    w = float(design.facts["current_bandwidth_rad_s"])
    Z = 1.0 / (1.0 / (1j * w * L) + 1.0 / (L / (share * tau) + 1j * w * L / share))
    assert note.startswith("L_d_h") and f"hide {100.0 * (1.0 - Z.imag / (w * L)):.2g} %" in note
    assert not any("eddy currents" in note for note in tune(SURFACE).notes)


def test_without_inertia_the_speed_loop_is_off_and_said_so() -> None:
    design = tune(replace(SURFACE, machine=replace(SURFACE.machine, J_kgm2=None)))
    assert design["speed.K_p_nms_per_rad"] == design["speed.K_i_nm_per_rad"] == 0.0
    assert "speed" not in design.loops
    assert any("inertia" in note for note in design.notes)


def test_without_a_demagnetisation_limit_the_smaller_of_magnet_and_rated_current_is_assumed() -> None:
    strong = tune(SURFACE).values["field_weakening.i_d_min_a"]  # 0.7 * 0.41 Wb / 2.3 mH = 125 A, rated 28 A
    assert strong.value == -28.0
    assert strong.method.startswith("assumed: -I_nom")
    machine = replace(SURFACE.machine, L_d_h=14e-3, L_q_h=14e-3)  # 0.7 * 0.41 Wb / 14 mH = 20.5 A
    weak = ratings(replace(SURFACE, machine=machine), 100.0)
    assert weak.i_d_min_a == pytest.approx(-20.5)
    assert weak.methods["i_d_min"].startswith("assumed: -0.7 psi_f/L_d")
    reluctance = replace(SURFACE, machine=replace(SURFACE.machine, psi_f_wb=0.0))
    assert ratings(reluctance, 100.0).i_d_min_a == -56.0  # no magnet, nothing to demagnetise


@pytest.mark.parametrize("seed", range(8))
def test_with_the_assumed_limit_a_healthy_machine_still_gives_full_torque_at_its_rated_speed(seed: int) -> None:
    drive = draw_drive(seed)
    rated = ratings(drive, 0.95 * drive.inverter.V_max_v)
    assert rated.i_d_min_a >= -(drive.machine.I_nom_apk or 0.0)
    plane = at_temperature(drive.machine, drive.flux_map)
    omega = (drive.machine.n_nom_rpm or 0.0) * math.pi / 30.0 * drive.machine.pole_pairs
    held = torque_limits(plane, [omega], [0.95 * drive.inverter.V_max_v], rated.I_max_apk, rated.i_d_min_a)
    assert float(held.largest_nm[0, 0]) >= 0.99 * rated.tau_max_nm


def test_limits_of_the_machine_file_win_over_assumptions() -> None:
    limits = MachineLimits(i_d_min_apk=-20.0, i_trip_apk=70.0, I_cont_apk=25.0, U_dc_max_v=280.0, tau_max_nm=50.0)
    design = tune(replace(SURFACE, limits=limits))
    assert design["field_weakening.i_d_min_a"] == -20.0
    assert design["protection.i_trip_apk"] == 70.0
    assert design["protection.I_cont_apk"] == 25.0
    assert design["protection.U_dc_max_v"] == 280.0
    assert design["speed.tau_max_nm"] == 50.0
    assert design["protection.U_dc_min_v"] == 105.0
    assert "0.5 U_dc" in design.values["protection.U_dc_min_v"].method


def test_encoder_offset_is_wrapped_and_direction_kept() -> None:
    encoder = replace(SURFACE.encoder, offset_rad=5.0, direction=-1)
    design = tune(replace(SURFACE, encoder=encoder))
    assert design["encoder.offset_rad"] == pytest.approx(5.0 - 2.0 * math.pi)
    assert design["encoder.reversed"] == 1.0


def test_voltage_error_table_becomes_the_ramp_of_equal_area() -> None:
    ramp = InverterParameters(
        210.0, 12e3, voltage_error_i_apk=(-4.0, -2.0, 2.0, 4.0), voltage_error_v=(-3.0, -3.0, 3.0, 3.0)
    )
    assert dead_time_compensation(ramp)[:2] == pytest.approx((3.0, 2.0))
    given = replace(ramp, V_dead_v=2.5, i_knee_apk=0.7)
    assert dead_time_compensation(given)[:2] == (2.5, 0.7)
    design = tune(replace(SURFACE, inverter=ramp))
    assert design["inverter.deadtime_compensation"] == 1.0
    assert tune(SURFACE)["inverter.deadtime_compensation"] == 0.0


def test_no_current_rating_is_a_question_to_the_machine_file() -> None:
    with pytest.raises(ConfigError, match="current rating"):
        tune(replace(SURFACE, machine=replace(SURFACE.machine, I_nom_apk=None, I_max_apk=None)))


def test_a_bad_request_lists_everything() -> None:
    with pytest.raises(ConfigError) as caught:
        TuneRequest(method="magic", damping=-1.0, voltage_margin=0.9, phase_margin_deg=95.0)
    assert len(caught.value.violations) == 4


@pytest.mark.parametrize("periods", [0, 1001])
def test_a_speed_controller_runs_every_period_to_every_thousandth(periods: int) -> None:
    with pytest.raises(ConfigError) as refused:
        TuneRequest(speed_decimation=periods)
    assert refused.value.violations == (f"speed_decimation = {periods} is outside 1..1000",)
    assert [TuneRequest(speed_decimation=allowed).speed_decimation for allowed in (1, 1000)] == [1, 1000]


def small_times_s(design: Design) -> float:
    """Current loop, its delay, estimate with two equal poles, filter, and half a period of the speed controller."""
    pll, cut_off = design["encoder.pll_bandwidth_rad_s"], math.tau * design["speed.filter_hz"]
    T_s = design["inverter.T_s_ns"] * 1e-9
    return 1.0 / 4000.0 + 1.5 * T_s + 2.0 / pll + 1.0 / cut_off + 0.5 * design["speed.decimation"] * T_s


def test_a_speed_bandwidth_asked_for_is_the_crossover_of_the_symmetric_optimum() -> None:
    """K_p = J w and K_i = K_p w^2 T: |K_p / (J s)| is 1 at w, which is the mean of 1/T and K_i/K_p."""
    design = tune(SURFACE, TuneRequest(speed_bandwidth_hz=12.0))
    omega = math.tau * 12.0
    assert design["speed.K_p_nms_per_rad"] == pytest.approx(0.05 * omega, rel=1e-9)
    expected = 0.05 * omega**3 * small_times_s(design)
    assert design["speed.K_i_nm_per_rad"] == pytest.approx(expected, rel=T_S_ROUNDED)


@pytest.mark.parametrize("asked_hz", [None, 5.0])
def test_placed_poles_of_the_speed_loop(asked_hz: float | None) -> None:
    """K_p = 2 zeta w J - B, K_i = w^2 J; nothing asked: half the crossover of the symmetric optimum at 50 degree."""
    stiff = replace(SURFACE, machine=replace(SURFACE.machine, B_nms=0.3))
    request = TuneRequest(speed_bandwidth_hz=asked_hz, speed_method="pole-placement", speed_phase_margin_deg=50.0)
    design = tune(stiff, replace(request, speed_damping=0.9))
    a = math.tan(math.radians(90.0 + 50.0) / 2.0)
    omega = math.tau * asked_hz if asked_hz else 0.5 / (a * small_times_s(design))
    assert design["speed.K_p_nms_per_rad"] == pytest.approx(2.0 * 0.9 * omega * 0.05 - 0.3, rel=T_S_ROUNDED)
    assert design["speed.K_i_nm_per_rad"] == pytest.approx(omega**2 * 0.05, rel=T_S_ROUNDED)


def test_text_is_no_bandwidth() -> None:
    with pytest.raises(ConfigError, match="bandwidth_hz is '500Hz', not a number"):
        TuneRequest(bandwidth_hz="500Hz")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "said"),
    [({"R_s_ohm": 137.0}, "check R and the DC link"), ({"L_d_h": 2.3, "L_q_h": 2.1}, "check the units of L"),
     ({"psi_f_wb": 4.1}, "the back-EMF at rated speed is 1065 V peak")],
)  # fmt: skip
def test_a_value_in_another_unit_is_named_by_the_design(changes: dict[str, float], said: str) -> None:
    source = load_machine_file("jercic-2017")
    assert not any(said in note for note in tune(source).notes)
    assert any(said in note for note in tune(replace(source, machine=replace(source.machine, **changes))).notes)


def test_values_outside_the_catalogue_are_refused() -> None:
    with pytest.raises(DesignInfeasible, match="range of the drive"):
        tune(replace(SURFACE, machine=replace(SURFACE.machine, L_d_h=11.0, L_q_h=11.0)))


def run(*arguments: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(cli, ["tune", *arguments])
    code = int(getattr(result.exception, "exit_code", result.exit_code))
    return code, result.stdout, result.stderr


def test_command_writes_both_files_and_prints_margins(tmp_path: Path) -> None:
    source = str(PROFILES / "jercic-2017.toml")
    code, stdout, _ = run(source, "-o", str(tmp_path / "design.toml"))
    assert code == 0
    assert "61.3" in stdout and "current_d" in stdout
    design: Design = load_design(tmp_path / "design.toml")
    params = parse_parameter_set((tmp_path / "params.toml").read_text())
    assert params.content_hash() == design.parameter_set().content_hash()
    first = (tmp_path / "params.toml").read_bytes()
    assert run(source, "-o", str(tmp_path / "fast.toml"), "--bandwidth-hz", "100")[0] == 0
    assert (tmp_path / "params.toml").read_bytes() == first, "another design does not take its set"
    fast = parse_parameter_set((tmp_path / "fast.params.toml").read_text())
    assert fast.content_hash() == load_design(tmp_path / "fast.toml").parameter_set().content_hash()


def test_command_exit_codes(tmp_path: Path) -> None:
    source, target = str(PROFILES / "jercic-2017.toml"), str(tmp_path / "design.toml")
    assert run(source, "-o", target, "--bandwidth-hz", "5000")[0] == 1
    assert run(source, "-o", target, "--voltage-margin", "0.9")[0] == 2
    assert run(str(tmp_path / "missing.toml"), "-o", target)[0] == 2
    assert run(source, "-o", str(tmp_path / "no" / "design.toml"))[0] == 2
    assert not Path(target).exists()


def test_choices_of_the_command_are_those_of_the_design() -> None:
    from pmsmtool.cli.tune import tune_command
    from pmsmtool.design.tune_request import POLAR_LAWS
    from pmsmtool.params.catalogue import FIELD_WEAKENING_MODES, GOVERNOR_MODES

    choices = {p.name: tuple(p.type.choices) for p in tune_command.params if hasattr(p.type, "choices")}
    assert choices["governor"] == tuple(GOVERNOR_MODES)
    assert choices["field_weakening"] == ("auto", *FIELD_WEAKENING_MODES)
    assert choices["polar_law"] == tuple(POLAR_LAWS)
    for name, options in choices.items():
        for option in options:
            assert TuneRequest(**{name: option}).table()[name] == option
