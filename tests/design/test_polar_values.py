# SPDX-License-Identifier: MIT
"""Parameters of the polar laws, from machine file to parameter set."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from pmsmtool.cli.main import cli
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import LINEAR_RANGE, TuneRequest
from pmsmtool.errors import ConfigError, DesignInfeasible
from pmsmtool.machine.machine_file import load_machine_file

PROFILES = Path(__file__).resolve().parents[2] / "profiles"
ASSUMED = PROFILES / "miyajima-2013-assumed.toml"


def test_times_follow_the_control_period() -> None:
    design = tune(load_machine_file(ASSUMED), TuneRequest(controller="polar"))
    T_s = design.machine.inverter.T_s
    assert T_s == pytest.approx(1e-4)
    assert design["polar.mode"] == 6.0
    assert design["polar.tau_s"] == pytest.approx(1e-3)
    assert design["polar.omega_c_rad_s"] == pytest.approx(1250.0)
    assert design["polar.omega_dob_rad_s"] == pytest.approx(400.0)
    assert design["governor.mode"] == design["field_weakening.mode"] == 0.0
    assert design.facts["polar_two_input_stable"] is True
    assert design.parameter_set().violations() == ()


@pytest.mark.parametrize("law", ["conventional", "proposed"])
def test_phase_laws_get_the_switch_they_need_at_standstill(law: str) -> None:
    design = tune(load_machine_file(ASSUMED), TuneRequest(controller="polar", polar_law=law))
    assert int(design["polar.options"]) & LINEAR_RANGE
    assert any("standstill" in note for note in design.notes)


@pytest.mark.parametrize("law", ["linear", "regularised"])
def test_laws_of_the_linear_range_get_a_table_or_say_what_they_lack(law: str) -> None:
    source = load_machine_file(ASSUMED)
    with_table = tune(source, TuneRequest(controller="polar", polar_law=law))
    assert with_table["field_weakening.mode"] == 1.0
    assert with_table.tables
    without = tune(source, TuneRequest(controller="polar", polar_law=law, field_weakening="off"))
    assert without["field_weakening.mode"] == 0.0
    assert any("linear range" in note for note in without.notes)
    assert not any("linear range" in note for note in with_table.notes)
    assert not int(without["polar.options"]) & LINEAR_RANGE


@pytest.mark.chain
@pytest.mark.parametrize(
    ("profile", "mode"), [("interior-2k2", 1.0), ("saturated-pmsyrm", 1.0), ("miyajima-2013-assumed", 0.0)]
)
def test_unified_law_gets_a_table_where_the_table_knows_more(profile: str, mode: float) -> None:
    design = tune(load_machine_file(PROFILES / f"{profile}.toml"), TuneRequest(controller="polar"))
    assert design["field_weakening.mode"] == mode
    assert design["governor.mode"] == 0.0


def test_an_optimisation_that_reads_the_integrators_is_switched_off() -> None:
    request = TuneRequest(controller="polar", field_weakening="accelerated")
    assert tune(load_machine_file(PROFILES / "interior-2k2.toml"), request)["field_weakening.mode"] == 0.0


def test_facts_state_the_voltage_limit_the_reach_and_the_slowest_true_pole() -> None:
    facts = tune(load_machine_file(ASSUMED), TuneRequest(controller="polar")).facts
    assert facts["polar_V_a_max_v"] == pytest.approx(36.0 / 3**0.5)
    assert facts["polar_largest_torque_nm"] > 8.42  # that is the most at 800 rpm; the design speed is lower
    assert float(facts["polar_slowest_pole_anywhere_rad_s"]) < -100.0
    assert float(facts["polar_slowest_pole_anywhere_rad_s"]) >= float(facts["polar_slowest_pole_rad_s"]) - 1.0


@pytest.mark.parametrize("law", ["conventional", "proposed", "linear", "linear-printed"])
def test_the_papers_laws_are_refused_on_a_salient_machine(law: str) -> None:
    source = load_machine_file(PROFILES / "interior-2k2.toml")
    with pytest.raises(DesignInfeasible, match="L_d = L_q"):
        tune(source, TuneRequest(controller="polar", polar_law=law))


@pytest.mark.parametrize(("law", "mode"), [("regularised", 5.0), ("unified", 6.0)])
def test_the_improved_laws_take_it_and_say_so(law: str, mode: float) -> None:
    design = tune(load_machine_file(PROFILES / "interior-2k2.toml"), TuneRequest(controller="polar", polar_law=law))
    assert design["polar.mode"] == mode
    assert any("differ" in note for note in design.notes)


def test_tune_shows_the_values_of_the_law_and_what_the_true_loop_makes_of_it(tmp_path: Path) -> None:
    arguments = ["tune", str(ASSUMED), "--controller", "polar", "-o", str(tmp_path / "design.toml")]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output
    for name in ("polar.omega_c_rad_s", "polar_V_a_max_v", "polar_two_input_stable", "polar_slowest_pole_rad_s"):
        assert name in result.output
    assert "current.K_p_d" not in result.output


def test_pi_leaves_polar_control_off() -> None:
    assert tune(load_machine_file(ASSUMED))["polar.mode"] == 0.0
    with pytest.raises(ConfigError, match="request"):
        TuneRequest(controller="fuzzy")
