# SPDX-License-Identifier: MIT
"""Datasheets: one machine, printed in every usual way, always gives the same file; contradictions are named."""

import itertools
import json
import math
from dataclasses import replace

import pytest
from click.testing import CliRunner

from benchmarks.analytic_saturation import saturated_pmsyrm_map
from pmsmtool.cli.machine import machine_command
from pmsmtool.errors import ConfigError
from pmsmtool.machine.datasheet import (
    TOLERANCE,
    Datasheet,
    disagreement,
    line_current,
    machine_from_datasheet,
    parse_emf_constant,
    parse_torque_constant,
    star_phase,
    torque_constant_by_emf,
)
from pmsmtool.machine.flux_map_import import flux_map_csv, load_flux_map
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.sim.simulated_machine import settings_of

P, R, L, PSI = 4, 0.137, 2.2e-3, 0.41
"""Star phase of the machine behind all sheets: ohm at 20 degC, H, Wb peak."""

KRPM = 1000 * 2 * math.pi / 60


def sheet(**changes):
    values = {
        "name": "m",
        "pole_pairs": P,
        "U_dc_v": 300.0,
        "f_s_hz": 12e3,
        "R_ohm": 2 * R,
        "L_d_h": 2 * L,
        "L_q_h": 2 * L,
        "K_e": parse_emf_constant(f"{PSI!r}Wb", None),
        "T_c": 20.0,
    }
    return Datasheet(**{**values, **changes})


def emf_texts():
    """K_e of the machine in every unit, with where it is measured: (text, between, connection)."""
    for kind, between, connection in itertools.product(("rms", "pk"), ("line-line", "phase"), ("star", "delta")):
        volts = PSI * P  # peak of the star phase per mechanical rad/s
        if between == "line-line" or connection == "delta":
            volts *= math.sqrt(3)
        if kind == "rms":
            volts /= math.sqrt(2)
        yield f"{volts * KRPM!r}V{kind}/krpm", between, connection
        yield f"{volts * KRPM!r} V{kind}/1000 min-1", between, connection
        yield f"{volts * KRPM!r}mV{kind}/rpm", between, connection
        yield f"{volts!r}V{kind}/(rad/s)", between, connection
        yield f"{volts * 1e3!r}mV{kind}s/rad", between, connection
        yield f"{1 / (volts * KRPM / 1000)!r}rpm/V{kind}", between, connection


@pytest.mark.parametrize(("text", "between", "connection"), list(emf_texts()))
def test_every_way_to_print_the_back_emf(text, between, connection):
    resistance = {"R_ohm": 3 * R, "R_between": "phase"} if connection == "delta" else {}
    result = machine_from_datasheet(sheet(K_e=parse_emf_constant(text, between), connection=connection, **resistance))
    assert result.machine_file.machine.psi_f_wb == pytest.approx(PSI, rel=1e-12)
    assert result.machine_file.machine.R_s_ohm == pytest.approx(R, rel=1e-12)
    assert not result.warnings


@pytest.mark.parametrize(
    "text",
    [
        f"{1.5 * P * PSI!r}Nm/Apk",
        f"{1.5 * P * PSI * math.sqrt(2)!r} N m/Arms",
        f"{1.5 * P * PSI * 1e3!r}mNm/Apk",
        f"{1.5 * P * PSI / 0.0070615518!r}oz-in/Apk",
        f"{1.5 * P * PSI / 0.1129848290!r}lb-in/Apk",
        f"{3e3 * math.sqrt(3) / math.pi * P * PSI!r} mNm/A block",
    ],
)
def test_every_way_to_print_the_torque_constant(text):
    alone = machine_from_datasheet(sheet(K_e=None, K_t=parse_torque_constant(text)))
    assert alone.machine_file.machine.psi_f_wb == pytest.approx(PSI, rel=1e-9)
    both = machine_from_datasheet(sheet(K_t=parse_torque_constant(text)))
    assert not both.warnings
    assert [step.key for step in both.conversions].count("(check)") == 1


def test_a_datasheet_of_block_commutation():
    """Its amperes and volts are direct ones through two terminals: K_t = 1 / (speed constant) = 3 sqrt3 / pi p psi."""
    speed_constant = 30 / math.pi / (3 * math.sqrt(3) / math.pi * P * PSI)
    for text in (f"{speed_constant!r}rpm/V block", f"{speed_constant!r} rpm/V(dc)"):
        found = machine_from_datasheet(sheet(K_e=parse_emf_constant(text, None)))
        assert found.machine_file.machine.psi_f_wb == pytest.approx(PSI, rel=1e-9)
    with pytest.raises(ConfigError, match="between two terminals"):
        parse_emf_constant("285rpm/V block", "phase")
    assert line_current("9A block") == pytest.approx(9 * 2 * math.sqrt(3) / math.pi)  # the same torque
    assert line_current("9000 mA dc") == line_current("9A(block)") and line_current("9Apk") == 9.0


@pytest.mark.parametrize(
    ("between", "connection", "factor"),
    [("line-line", "star", 2.0), ("line-line", "delta", 2.0), ("phase", "star", 1.0), ("phase", "delta", 3.0)],
)
def test_impedances_become_the_star_phase(between, connection, factor):
    assert star_phase(factor * 7.0, between, connection)[0] == pytest.approx(7.0)


def test_resistance_is_brought_to_20_degrees():
    hot = R * (1 + 0.00393 * 60.0)
    assert machine_from_datasheet(sheet(R_ohm=2 * hot, T_c=80.0)).machine_file.machine.R_s_ohm == pytest.approx(R)


@pytest.mark.parametrize(
    ("factor", "says"),
    [
        (math.sqrt(2), "rms where peak"),
        (1 / math.sqrt(2), "rms where peak"),
        (math.sqrt(3), "line-line where phase"),
        (1 / math.sqrt(6), "line-line peak and phase rms"),
        (4.0, "pole pairs"),
        (9.5493, "rpm and rad/s"),
        (1.12, "differ by +12.0 %"),
        (2 * math.sqrt(3) / math.pi, "block commutation where peak was said"),
        (math.pi / math.sqrt(6), "block commutation where rms was said"),
    ],
)
def test_a_torque_constant_that_contradicts_is_named(factor, says):
    K_t = parse_torque_constant(f"{1.5 * P * PSI * factor!r}Nm/Apk")
    result = machine_from_datasheet(sheet(K_t=K_t))
    assert says in result.warnings[0] and result.warnings[0].endswith("K_e was taken: to take K_t, leave out --ke")
    assert result.machine_file.machine.psi_f_wb == pytest.approx(PSI)  # K_e decides


def test_constants_of_block_commutation_that_are_called_rms_are_named():
    """44 mNm/A and 217 rpm/V of one motor: "one of the two is line-line where phase was said"."""
    K_t, K_e = parse_torque_constant("44mNm/Arms"), parse_emf_constant("217rpm/Vrms", "line-line")
    (warning,) = machine_from_datasheet(sheet(K_t=K_t, K_e=K_e)).warnings
    assert warning.endswith("both are those of block commutation, 'A block' and 'rpm/V block'")


@pytest.mark.parametrize(("factor", "kind"), [(1.5, "peak"), (2.1213, "rms"), (1.654, "block")])
def test_an_ampere_that_is_not_said_is_recognised_by_the_back_emf(factor, kind):
    text = f"{factor * P * PSI * 1.006!r}Nm/A"
    found, said = torque_constant_by_emf(text, parse_emf_constant(f"{PSI!r}Wb", None), P, "star")
    assert found.kind == kind and kind in said and "+0.6" in said
    assert torque_constant_by_emf("1Nm/Arms", parse_emf_constant(f"{PSI!r}Wb", None), P, "star") == (
        parse_torque_constant("1Nm/Arms"),
        "",
    )
    with pytest.raises(ConfigError, match="none of"):
        torque_constant_by_emf(f"{1.9 * P * PSI!r}Nm/A", parse_emf_constant(f"{PSI!r}Wb", None), P, "star")


@pytest.mark.parametrize(("rated", "assumed"), [(20.0, 3), (None, 1)])
def test_what_a_rehearsal_needs_is_written_and_named(rated, assumed):
    """Without it: `adc_bits needs adc_full_scale_apk`."""
    result = machine_from_datasheet(sheet(I_nom_apk=rated, encoder_bits=12))
    settings = settings_of(result.machine_file)
    assert settings.whole("encoder_bits") == result.machine_file.encoder.bits == 12  # `check` compares them
    assert [step.given for step in result.conversions if step.key == "[simulation]"] == ["assumed"] * assumed
    if rated is not None:
        assert settings.number("J_kgm2") > 0.0 and settings.number("adc_full_scale_apk") == 1.5 * 2.0 * rated


def test_a_machine_without_the_table_of_a_rehearsal_has_the_same_current_measurement():
    """As `identify` writes it; before, `simulate RUN` and the page of its report refused the rehearsed motor."""
    written = machine_from_datasheet(sheet(I_nom_apk=20.0)).machine_file
    bare = replace(written, simulation={})
    assert settings_of(bare).number("adc_full_scale_apk") == settings_of(written).number("adc_full_scale_apk") == 60.0
    largest = replace(bare, machine=replace(bare.machine, I_max_apk=30.0))
    assert settings_of(largest).number("adc_full_scale_apk") == 45.0
    none = replace(bare, machine=replace(bare.machine, I_nom_apk=None))
    assert not settings_of(none).number("adc_full_scale_apk")


def test_small_disagreement_is_production_spread():
    assert disagreement(0.41, 0.41 * 1.04, 4) == ""
    assert disagreement(0.41, 0.41 * 1.06, 4) != ""


@pytest.mark.parametrize("source", ["datasheet", "meter", "guess"])
def test_deviations_follow_the_source(source):
    result = machine_from_datasheet(sheet(sources={"R": source}, J_kgm2=1e-3))
    machine_file = result.machine_file
    assert machine_file.std["R_s_ohm"] == pytest.approx(R * TOLERANCE[source]["R"] / math.sqrt(3))
    assert machine_file.machine.R_winding_ohm == machine_file.machine.R_s_ohm, "the motor's terminals: no bridge"
    assert machine_file.std["R_winding_ohm"] == machine_file.std["R_s_ohm"]
    assert machine_file.std["L_d_h"] == pytest.approx(L * TOLERANCE["datasheet"]["L"] / math.sqrt(3))
    assert machine_file.estimates["R_s_ohm"].source == source
    assert machine_file.estimates["J_kgm2"].value == 1e-3


@pytest.mark.parametrize(
    ("text", "between", "says"),
    [
        ("60V/krpm", "line-line", "does not say whether it is rms or peak"),
        ("60Vrms/krpm", None, "where the voltage is measured"),
        ("60Vrms/furlong", "phase", "no back-EMF constant"),
        ("0Vrms/krpm", "phase", "no back-EMF constant"),
        ("fast", "phase", "no back-EMF constant"),
    ],
)
def test_a_bad_back_emf_constant_says_why(text, between, says):
    with pytest.raises(ConfigError) as caught:
        parse_emf_constant(text, between)
    assert says in str(caught.value)


@pytest.mark.parametrize("text", ["1.7Nm/A", "1.7", "-1Nm/Apk", "1.7V/Apk"])
def test_a_bad_torque_constant_is_refused(text):
    with pytest.raises(ConfigError):
        parse_torque_constant(text)


def test_neither_constant():
    with pytest.raises(ConfigError, match="neither"):
        machine_from_datasheet(sheet(K_e=None))


def test_implausible_numbers_are_flagged():
    texts = " ".join(machine_from_datasheet(sheet(L_d_h=4.4, L_q_h=0.0044, n_nom_rpm=6000.0)).warnings)
    assert "L_q/L_d = 0.001" in texts
    assert "back-EMF at rated speed is 1030 V" in texts
    assert "L/R" in " ".join(machine_from_datasheet(sheet(R_ohm=2e3 * R)).warnings)


@pytest.mark.parametrize(
    ("changes", "told"),
    [({"J_kgm2": 300.0}, "J = 300 kg m2"), ({"J_kgm2": 1e-8}, "J = 1e-08 kg m2"), ({"J_kgm2": None}, ""),
     ({"L_d_h": 4.4, "L_q_h": 4.4}, "L at the rated current"), ({"R_ohm": 1e3 * R}, "R takes")],
)  # fmt: skip
def test_a_value_in_a_wrong_unit_is_named(changes: dict[str, float | None], told: str) -> None:
    """300 kg m2 on a motor of half a newton metre was taken without a word, and `tune` then failed without its name."""
    texts = machine_from_datasheet(sheet(n_nom_rpm=2000.0, I_nom_apk=6.0, **{"J_kgm2": 0.01, **changes})).warnings
    assert any(text.startswith(told) for text in texts) if told else not any("J =" in text for text in texts)


# -- the command -------------------------------------------------------------------------------------------------------


NEW = [
    "new",
    "--name",
    "m1",
    "--pole-pairs",
    "4",
    "--r",
    "0.274ohm",
    "--l",
    "4.4mH",
    "--u-dc",
    "540V",
    "--pwm",
    "12kHz",
]
EMF = ["--ke", "60.7Vrms/krpm", "--ke-between", "line-line"]


def run(*arguments):
    return CliRunner().invoke(machine_command, arguments)


def test_new_writes_a_file_that_loads(tmp_path):
    path = tmp_path / "m1.toml"
    result = run(*NEW, *EMF, "--i-nom", "20Arms", "--n-nom", "3000rpm", "--inertia", "12kgcm2", "-o", str(path))
    assert result.exit_code == 0, result.output
    machine_file = load_machine_file(path)
    assert machine_file.machine.psi_f_wb == pytest.approx(60.7 * math.sqrt(2 / 3) / KRPM / 4)
    assert machine_file.machine.R_s_ohm == pytest.approx(0.137 / (1 + 5 * 0.00393))
    assert machine_file.machine.I_nom_apk == pytest.approx(20 * math.sqrt(2))
    assert machine_file.machine.n_nom_rpm == 3000.0
    assert machine_file.machine.J_kgm2 == 1.2e-3
    assert "line-line / 2" in result.stdout
    assert "sqrt 2" in result.stdout  # the rule breaks: a table in a file is 120 wide


def test_new_is_reproducible(tmp_path):
    paths = [tmp_path / "a.toml", tmp_path / "b.toml"]
    for path in paths:
        assert run(*NEW, *EMF, "-o", str(path)).exit_code == 0
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_new_flags_a_contradiction(tmp_path):
    result = run(*NEW, *EMF, "--kt", "1Nm/Apk", "-o", str(tmp_path / "m.toml"), "--json")
    assert result.exit_code == 0
    data = json.loads(result.stdout)
    assert data["schema"] == "pmsmtool.machine-new/1"
    assert "rms where peak" in data["warnings"][0]
    assert data["machine"]["pole_pairs"] == 4
    assert "warning" in result.stderr


def test_new_does_not_replace_a_file(tmp_path):
    path = tmp_path / "m.toml"
    path.write_text("precious")
    result = run(*NEW, *EMF, "-o", str(path))
    assert isinstance(result.exception, ConfigError)
    assert path.read_text() == "precious"
    assert run(*NEW, *EMF, "-o", str(path), "--force").exit_code == 0


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (["--r", "0.274"], "has no unit"),
        (["--i-nom", "20A"], "peak or an rms"),
        (["--r", "0.274mH"], "is a unit of inductance"),
    ],
)
def test_new_teaches_units(tmp_path, change, says):
    result = run(*NEW, *EMF, *change, "-o", str(tmp_path / "m.toml"))
    assert result.exit_code == 2
    assert says in result.output


def test_new_refuses_what_a_file_may_not_hold(tmp_path):
    result = run(*NEW, *EMF, "--r", "5kohm", "-o", str(tmp_path / "m.toml"))
    assert isinstance(result.exception, ConfigError)
    assert "above 1000 ohm" in str(result.exception)
    assert not (tmp_path / "m.toml").exists()


def test_map_checks_and_repairs(tmp_path):
    lines = flux_map_csv(saturated_pmsyrm_map()).splitlines()
    source, repaired = tmp_path / "map.csv", tmp_path / "map.npz"
    source.write_text("\n".join(lines[:100] + lines[101:]))
    assert "--fill-holes -o whole.npz" in run("map", str(source)).exception.hint
    result = run("map", str(source), "--fill-holes", "--symmetrise", "-o", str(repaired))
    assert result.exit_code == 0, result.output
    assert "holes filled by the smoothest surface; 1 of 2809" in result.stdout
    assert "ok   reciprocal" in result.stdout
    assert len(load_flux_map(repaired).meta["repairs"]) == 2


def test_map_that_is_not_good(tmp_path):
    lines = flux_map_csv(saturated_pmsyrm_map()).splitlines()
    i_d, i_q, psi_d, _ = lines[1500].split(",")
    lines[1500] = f"{i_d},{i_q},{psi_d},3.0"
    path = tmp_path / "map.csv"
    path.write_text("\n".join(lines))
    result = run("map", str(path), "--json")
    assert "not good" not in str(result.exception), "the command line says it before"
    assert json.loads(result.stdout)["report"]["not_monotonic"] > 0


def test_the_examples_of_the_help_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    new = machine_command.commands["new"]
    lines = [line.strip() for line in (new.epilog or "").splitlines() if "Examples" not in line and line != "\b"]
    examples = " ".join(lines).replace("\\ ", "").split("pmsmtool machine ")[1:]
    assert len(examples) == 2
    for example in examples:
        result = run(*example.split())
        assert result.exit_code == 0, result.output
    assert load_machine_file(tmp_path / "m2.toml").machine.L_q_h == pytest.approx(0.014)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("--r", "0ohm"), "--r 0 is not above zero"),
        (("--l", "0H"), "--l-d 0 is not above zero"),
        (("--l-q", "2mH"), "not one inductance of each axis"),
        (("--r-temperature", "-300degC"), "-300 is not between -60 and 250 degC"),
        (("--ke", "8,35Vrms/krpm"), "a decimal comma"),
    ],
)
def test_numbers_that_no_machine_has_are_named_by_their_option(tmp_path, change, says):
    """A resistance or an inductance of 0 ended with a division by zero."""
    result = run(*NEW, *EMF, *change, "-o", str(tmp_path / "m.toml"))
    assert isinstance(result.exception, ConfigError) and says in str(result.exception)


def test_a_torque_constant_with_a_point_between_its_units():
    assert parse_torque_constant("80mN\u00b7m/Arms").value == parse_torque_constant("0.08 N.m/Arms").value == 0.08


@pytest.mark.parametrize("command", ["new", "map"])
def test_a_folder_that_is_not_there(tmp_path, command):
    path = str(tmp_path / "none" / ("m.toml" if command == "new" else "m.npz"))
    source = tmp_path / "map.csv"
    source.write_text(flux_map_csv(saturated_pmsyrm_map()))
    result = run(*(NEW + EMF if command == "new" else ["map", str(source)]), "-o", path)
    assert isinstance(result.exception, ConfigError)
    assert "cannot be written" in str(result.exception)
