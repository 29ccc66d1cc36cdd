# SPDX-License-Identifier: MIT
"""Numbers no machine has are refused, all at once, with file, key, limit and cause; those of real ones are not."""

import pytest

from pmsmtool.design.design_file import design_text, parse_design
from pmsmtool.design.tune import tune
from pmsmtool.errors import ConfigError
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file, parse_machine

PROFILES = sorted(data_folder("profiles").glob("*.toml"))
MACHINE = """\
schema = "pmsmtool.machine/1"
name = "m"
[machine]
pole_pairs = 3
R_s_ohm = 3.6
L_d_h = 0.036
L_q_h = 0.051
psi_f_wb = 0.545
I_nom_apk = 6.1
n_nom_rpm = 1500.0
J_kgm2 = 0.015
B_nms = 0.0003
tau_c_nm = 0.1
[inverter]
U_dc_v = 540.0
f_s_hz = 10000.0
[std]
R_s_ohm = 0.01
[estimate.R_s_ohm]
value = 3.6
std = 0.01
"""


def violations(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_machine(text, where="m.toml")
    return "\n".join(caught.value.violations)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[std]\nR_s_ohm = 0.01", "[std]\nR_s_ohm = 1e300", "[std] R_s_ohm = 1e+300 is above 1000 ohm"),
        ("[std]\nR_s_ohm = 0.01", "[std]\nR_s_ohm = 37.0", "more than 10 times the value 3.6 ohm"),
        ("[std]", "[systematic]\nJ_kgm2 = 0.2\n[std]", "[systematic] J_kgm2 = 0.2 is more than 10 times"),
        ("B_nms = 0.0003", "B_nms = 300.0", "m.toml:12: [machine] B_nms = 300: friction of 4.71e+04 N m"),
        ("tau_c_nm = 0.1", "tau_c_nm = 200.0", "[machine] tau_c_nm = 200: friction of 200 N m"),
        ("psi_f_wb = 0.545", "psi_f_wb = 1e-300", "psi_f_wb = 1e-300 is below 1e-06 Wb"),
        ("value = 3.6", "value = -3.6", "[estimate.R_s_ohm] value = -3.6 is below 1e-05"),
        ("value = 3.6", "value = 3600.0", "value = 3600 is above 1000"),
        ("value = 3.6", "value = 0.0036", "differs more than 10 times from [machine] R_s_ohm = 3.6 ohm"),
        ("std = 0.01", "std = 1e300", "std = 1e+300 is above"),
    ],
)
def test_what_no_machine_has_is_refused(old, new, said):
    assert MACHINE.count(old) >= 1
    found = violations(MACHINE[::-1].replace(old[::-1], new[::-1], 1)[::-1])
    assert said in found and "m.toml:" in found


def test_all_of_it_is_named_at_once():
    text = MACHINE.replace("B_nms = 0.0003", "B_nms = 300.0").replace("value = 3.6", "value = -3.6")
    found = violations(text.replace("[std]\nR_s_ohm = 0.01", "[std]\nR_s_ohm = 1e300"))
    assert all(part in found for part in ("B_nms = 300", "value = -3.6", "1e+300"))


@pytest.mark.parametrize("psi", ["0.0", "0.0001"])
def test_machines_with_little_or_no_magnet_are_read(psi):
    assert parse_machine(MACHINE.replace("psi_f_wb = 0.545", f"psi_f_wb = {psi}")).machine.psi_f_wb == float(psi)


@pytest.mark.chain
@pytest.mark.parametrize("path", PROFILES, ids=lambda path: path.stem)
def test_every_profile_and_its_design_are_read(path):
    machine_file = load_machine_file(path)
    again = parse_machine(dump_machine_file(machine_file), folder=path.parent)
    assert again.content_hash() == machine_file.content_hash()
    design = tune(machine_file)
    assert design_text(parse_design(design_text(design))) == design_text(design)


@pytest.fixture(scope="module")
def design() -> str:
    return design_text(tune(parse_machine(MACHINE)))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("damping = 1.0", "damping = nan", "[request] damping = nan is not finite"),
        ("phase_margin_deg = 45.0", 'phase_margin_deg = "45"', "[request] phase_margin_deg is text"),
        ("phase_margin_deg = 45.0", "phase_margin_deg = 95.0", "phase_margin_deg = 95.0 is not between 0 and 90"),
        ("damping = 1.0", "dampng = 1.0", "[request] dampng: unknown key; did you mean damping"),
        ("[facts]", "[facts]\nspare = nan", "[facts] spare = nan is not finite"),
        ("[facts]", "[facts]\nspare = [1, 2]", "[facts] spare is an array"),
        ("modulus_margin = ", 'modulus_margin = "x" # ', "modulus_margin is text"),
        ("modulus_margin = ", "modulus_margin = nan # ", "modulus_margin = nan is not finite"),
        ("crossover_rad_s = ", "crossover_rad_s = 1e300 # ", "crossover_rad_s = 1e+300 is above"),
        ("[facts]", "[loop]\nodd = 3\n[facts]", "[loop.odd] is not a table"),
    ],
)
def test_request_facts_and_margins_of_a_design_are_checked(design, old, new, said):
    assert old in design
    with pytest.raises(ConfigError) as caught:
        parse_design(design.replace(old, new, 1), where="design.toml")
    assert any(said in line and "design.toml: [" in line for line in caught.value.violations), caught.value.violations


def test_a_value_beyond_the_catalogue_is_refused(design):
    at = design.index("[value.motor.R_s_ohm]")
    damaged = design[:at] + design[at:].replace("value = ", "value = 1e30 # ", 1)
    with pytest.raises(ConfigError) as caught:
        parse_design(damaged)
    assert any("motor.R_s_ohm" in line for line in caught.value.violations)
