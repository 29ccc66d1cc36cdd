"""Parameters of the polar laws, from machine file to parameter set."""

from __future__ import annotations

from pathlib import Path

import pytest

from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import ConfigError, DesignInfeasible
from pmsmtool.machine.machine_file import load_machine_file

PROFILES = Path(__file__).resolve().parents[2] / "profiles"


def test_times_follow_the_control_period() -> None:
    design = tune(load_machine_file(PROFILES / "miyajima-2013-assumed.toml"), TuneRequest(controller="polar"))
    T_s = design.machine.inverter.T_s
    assert T_s == pytest.approx(1e-4)
    assert design["polar.mode"] == 6.0
    assert design["polar.tau_s"] == pytest.approx(1e-3)
    assert design["polar.omega_c_rad_s"] == pytest.approx(1250.0)
    assert design["polar.omega_dob_rad_s"] == pytest.approx(400.0)
    assert design["governor.mode"] == design["field_weakening.mode"] == 0.0
    assert design.facts["polar_two_input_stable"] is True
    assert design.parameter_set().violations() == ()


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


def test_pi_leaves_polar_control_off() -> None:
    assert tune(load_machine_file(PROFILES / "miyajima-2013-assumed.toml"))["polar.mode"] == 0.0
    with pytest.raises(ConfigError, match="request"):
        TuneRequest(controller="fuzzy")
