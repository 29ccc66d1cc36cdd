# SPDX-License-Identifier: MIT
"""The gate before anything is written: what contradicts, what a data sheet may be off, what stays unchecked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from pmsmtool.commissioning import compared_stage
from pmsmtool.commissioning.compared_stage import check_accepted, contradicted_unmoved, refusal
from pmsmtool.commissioning.contradiction import ACCEPTABLE, HELD, OTHER_MOTOR, Row, compare
from pmsmtool.errors import ConfigError, SafetyRefusal
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.measurement.capabilities import reference_capabilities
from pmsmtool.params.parameter_set import default_set
from pmsmtool.report.comparison import headline, marks, table_cells, unchecked
from pmsmtool.report.report import verdict_of
from pmsmtool.run_directory import RunDirectory, Stage

TRUTH = replace(load_machine_file(data_folder("profiles") / "interior-2k2.toml"), std={})
"""No standard deviations: the tolerances of a catalogue hold."""
UNIT = {"R_s_ohm": "ohm", "L_d_h": "H", "L_q_h": "H", "psi_f_wb": "Wb", "J_kgm2": "kg m2"}
INTERVAL = 0.015
"""Relative 95 % half width of the measured values here, as identification leaves it."""


def value(name: str, number: float, *, half: float = INTERVAL, T_c: float | None = 20.0) -> dict[str, Any]:
    return {"name": name, "value": number, "std": 0.5 * half * number, "systematic": 0.0, "total_95": half * number,
            "unit": UNIT.get(name, "1"), "T_c": T_c, "source": "pmsmtool"}  # fmt: skip


def measured(**changed: float) -> list[dict[str, Any]]:
    """Every value of the full level, as the machine has it."""
    truth = {key: getattr(TRUTH.machine, key) for key in HELD} | changed
    return [value(key, number) for key, number in truth.items()]


def stated(**factors: float) -> MachineFile:
    """A file whose values are the truth times a factor; pole pairs as given."""
    machine = TRUTH.machine
    values = {key: f if key == "pole_pairs" else getattr(machine, key) * f for key, f in factors.items()}
    return replace(TRUTH, machine=replace(machine, **values))  # type: ignore[arg-type]


def found(rows: tuple[Row, ...]) -> Mapping[str, str]:
    return {row.name: row.verdict for row in rows}


def wrong(rows: tuple[Row, ...]) -> list[str]:
    return [row.name for row in rows if row.verdict == "contradicts"]


@pytest.mark.parametrize(
    ("factors", "names", "cause"),
    [
        ({"pole_pairs": 12}, ["pole_pairs"], "integer ratio 4: encoder counts per turn"),
        ({"pole_pairs": 6}, ["pole_pairs"], "poles instead of pole pairs"),
        ({"pole_pairs": 4}, ["pole_pairs"], "another motor, or encoder counts per turn (ratio 3/4)"),
        ({"R_s_ohm": 2.0}, ["R_s_ohm"], "line to line instead of phase"),
        ({"R_s_ohm": 0.5}, ["R_s_ohm"], "line to line instead of phase"),
        ({"psi_f_wb": 1.65}, ["psi_f_wb"], "Kt = 1.654 p psi"),
        ({"psi_f_wb": math.sqrt(3.0)}, ["psi_f_wb"], "line to line instead of phase"),
        ({"psi_f_wb": 1.5 * math.sqrt(2.0)}, ["psi_f_wb"], "Kt = 2.121 p psi"),
        ({"psi_f_wb": 1.0 / 1.5}, ["psi_f_wb"], "Kt = 1.5 p psi"),
        ({"L_d_h": 2.0, "L_q_h": 2.0}, ["L_d_h", "L_q_h"], "line to line instead of phase"),
        ({"J_kgm2": 5.0}, ["J_kgm2"], "another motor"),
        ({"J_kgm2": 0.2}, ["J_kgm2"], "a load on the shaft"),
        ({"J_kgm2": 1e4}, ["J_kgm2"], "kg cm2"),
    ],
)
def test_a_wrong_file_is_named_with_its_likely_cause(factors: dict[str, float], names: list[str], cause: str) -> None:
    rows = compare(stated(**factors), {}, measured())
    assert wrong(rows) == names
    text = next(row.text for row in rows if row.name == names[0])
    assert cause in text and "states" in text and "measured" in text and "allowed" in text


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("name", "share"), [("R_s_ohm", 0.1), ("L_d_h", 0.3), ("L_q_h", 0.3), ("psi_f_wb", 0.1), ("J_kgm2", 0.2)]
)
def test_the_limit_is_the_joint_interval(name: str, share: float, sign: float) -> None:
    """Just inside the data sheet's tolerance and the measured interval agrees, just outside contradicts."""
    allowed = 1.0 / (1.0 - share) if sign > 0.0 else 1.0 - share
    value_at = getattr(TRUTH.machine, name) * allowed / (1.0 - sign * INTERVAL)
    assert not wrong(compare(TRUTH, {}, measured(**{name: value_at * (1.0 - 1e-6 * sign)})))
    outside = compare(TRUTH, {}, measured(**{name: value_at * (1.0 + 1e-3 * sign)}))
    # the measured loop may be above a data sheet's winding by what bridge and cable have
    assert wrong(outside) == ([] if name == "R_s_ohm" and sign > 0.0 else [name])
    assert wrong(compare(TRUTH, {}, measured(R_s_ohm=1.65 * TRUTH.machine.R_s_ohm))) == ["R_s_ohm"]
    # so it may where a meter read the winding alone, as `machine new` writes it
    # a metre of cable has 0.02 ohm, a bridge for 6 A 0.07 ohm, one for 2 A 0.2 ohm
    winding = replace(TRUTH.machine, R_s_ohm=0.0223)
    for I_nom, loop, verdict in (
        (50.0, 0.033, "agrees"),
        (50.0, 0.0377, "NOT CHECKED"),
        (50.0, 0.05, "contradicts"),
        (6.08, 0.05, "NOT CHECKED"),
        (6.08, 0.1, "contradicts"),
        (2.0, 0.1, "NOT CHECKED"),
        (2.0, 0.25, "contradicts"),
    ):
        low = replace(TRUTH, machine=replace(winding, I_nom_apk=I_nom))
        rows = compare(low, {}, measured(R_s_ohm=loop))
        R_row = next(row for row in rows if row.name == "R_s_ohm")
        assert R_row.verdict == verdict and ("measure the winding" in R_row.tolerance) == (verdict == "NOT CHECKED")
        assert not marks(("current.K_i_d_v_per_as",), [row.facts() for row in rows]), (
            "it follows from the measured loop"
        )
    R = TRUTH.machine.R_s_ohm
    for winding, contradicted in ((R, []), (0.9 * R, ["R_s_ohm"])):
        meter = replace(TRUTH, machine=replace(TRUTH.machine, R_winding_ohm=winding), std={"R_s_ohm": 0.005 * R})
        assert wrong(compare(meter, {}, measured(R_s_ohm=1.3 * R))) == contradicted


def test_an_inductance_without_its_bias_may_be_what_the_sheet_states() -> None:
    """L_d of a sheet 28 % too high, of a machine that loses 13 % to the bias: half of that agrees by the slope."""
    L_d = TRUTH.machine.L_d_h
    facts = [row | {"i_d_apk": 5.0} for row in measured(L_d_h=0.87 * L_d)]
    assert wrong(compare(stated(L_d_h=1.28), {}, facts)) == ["L_d_h"]
    bent = [row | {"bend_per_a": -0.02} if row["name"] == "L_d_h" else row for row in facts]
    assert not wrong(compare(stated(L_d_h=1.28), {}, bent))
    assert wrong(compare(stated(L_d_h=1.6), {}, bent)) == ["L_d_h"]


def test_its_own_deviations_outrank_the_catalogue() -> None:
    psi = TRUTH.machine.psi_f_wb
    tight = replace(TRUTH, std={"psi_f_wb": 0.01 * psi}, systematic={"psi_f_wb": 0.01 * psi})
    limit = 1.0 + 1.96 * 0.01 + 0.01
    assert not wrong(compare(tight, {}, measured(psi_f_wb=0.999 * limit * psi / (1.0 - INTERVAL))))
    assert wrong(compare(tight, {}, measured(psi_f_wb=1.001 * limit * psi / (1.0 - INTERVAL)))) == ["psi_f_wb"]


def test_an_unknown_temperature_widens_what_copper_and_magnets_allow() -> None:
    """At 90 degC R is 27.5 % up and psi 8.4 % down; with a known one the value is at T_ref and that is no excuse."""
    machine = TRUTH.machine
    hot = {"R_s_ohm": 1.1 * 1.275 * machine.R_s_ohm, "psi_f_wb": 0.9 * 0.918 * machine.psi_f_wb}
    bare = replace(TRUTH, machine=replace(machine, R_winding_ohm=0.9 * machine.R_s_ohm))
    for name, number in hot.items():
        assert not wrong(compare(bare, {}, [value(name, number, T_c=None)]))
        assert wrong(compare(bare, {}, [value(name, number, T_c=20.0)])) == [name]


def test_the_ratio_alone_tells_a_wrong_flux_or_inertia() -> None:
    ratio = value("J_per_psi", TRUTH.machine.J_kgm2 / TRUTH.machine.psi_f_wb)  # type: ignore[operator]
    rows = compare(TRUTH, {}, [ratio])
    assert found(rows)["J_per_psi"] == "agrees"
    assert found(rows)["psi_f_wb"] == found(rows)["J_kgm2"] == "NOT CHECKED"
    assert wrong(compare(stated(psi_f_wb=1.65), {}, [ratio])) == ["J_per_psi"]
    assert wrong(compare(stated(J_kgm2=5.0), {}, [ratio])) == ["J_per_psi"]
    assert not wrong(compare(stated(J_kgm2=1.1, psi_f_wb=0.9), {}, [ratio]))
    with_psi = compare(TRUTH, {}, [ratio, value("psi_f_wb", TRUTH.machine.psi_f_wb)])
    assert found(with_psi)["J_kgm2"] == "agrees"


def test_a_coupled_load_may_be_any_but_less_than_the_rotor_is_not_that_rotor() -> None:
    J = TRUTH.machine.J_kgm2
    assert J is not None
    assert not wrong(compare(TRUTH, {}, measured(J_kgm2=5.0 * J), loaded=True))
    assert wrong(compare(TRUTH, {}, measured(J_kgm2=0.5 * J), loaded=True)) == ["J_kgm2"]


def test_one_inductance_for_both_axes_lies_between_them() -> None:
    L_d, L_q = TRUTH.machine.L_d_h, TRUTH.machine.L_q_h

    def one(inductance: float) -> list[str]:
        file = replace(TRUTH, machine=replace(TRUTH.machine, L_d_h=inductance, L_q_h=inductance))
        return wrong(compare(file, {}, measured()))

    assert not one(L_d) and not one(L_q) and not one(0.8 * L_d) and not one(1.3 * L_q)
    assert one(0.65 * L_d) == ["L_d_h"] and one(1.6 * L_q) == ["L_q_h"]


def test_one_inductance_measured_by_the_drive_lies_between_the_axes() -> None:
    """A drive that measures one phase, 15 % off at most: it checks neither L_d nor L_q of a salient file."""

    def phase(inductance: float) -> list[dict[str, Any]]:
        return [{"name": "L_phase_h", "value": inductance, "unit": "H", "source": "vendor"}]

    L_d, L_q = TRUTH.machine.L_d_h, TRUTH.machine.L_q_h
    for inductance in (L_d, L_q):
        rows = compare(TRUTH, {}, phase(inductance))
        assert not wrong(rows) and found(rows)["L_d_h"] == found(rows)["L_q_h"] == "NOT CHECKED"
    assert wrong(compare(TRUTH, {}, phase(2.0 * L_q))) == ["L_phase_h"]
    assert wrong(compare(TRUTH, {}, phase(0.5 * L_d))) == ["L_phase_h"]
    round_rotor = replace(TRUTH, machine=replace(TRUTH.machine, L_q_h=L_d))
    assert found(compare(round_rotor, {}, phase(L_d)))["L_q_h"] == "agrees"


# ---- what the drive holds -----------------------------------------------------------------------------------


def test_what_was_not_measured_must_not_contradict_what_somebody_set() -> None:
    """7 pole pairs and 0.46 ohm against a drive that holds 3: nothing else tells."""
    file = stated(pole_pairs=7, R_s_ohm=0.46 / 3.6)
    assert wrong(compare(file, {"pole_pairs": 3.0}, [])) == ["pole_pairs"]
    assert wrong(compare(file, {"pole_pairs": 7.0, "R_s_ohm": 3.6}, [])) == ["R_s_ohm"]
    rows = compare(file, {"pole_pairs": 7.0}, [])
    assert not wrong(rows) and found(rows)["pole_pairs"] == "NOT CHECKED"


def test_a_factory_default_and_an_empty_object_are_nobodys() -> None:
    factory = {key: default_set().values[f"motor.{key}"] for key in HELD}
    held = dict(factory)
    rows = compare(TRUTH, held, [], defaults=factory)
    assert not wrong(rows) and all(row.factory for row in rows if row.held is not None)
    assert wrong(compare(TRUTH, held, [])) != []
    assert not wrong(compare(TRUTH, dict.fromkeys(HELD, 0.0), []))
    # unless the measurement stands on it
    assert wrong(compare(TRUTH, held, [], defaults=factory, used=("pole_pairs",))) == ["pole_pairs"]


def test_a_memory_of_another_motor_is_healthy_where_everything_is_measured() -> None:
    held = {"pole_pairs": 7.0, "R_s_ohm": 0.1, "L_d_h": 1e-4, "L_q_h": 1e-4, "psi_f_wb": 0.01, "J_kgm2": 1e-5}
    held["encoder_counts"] = 2.0**17
    rows = compare(TRUTH, held, measured())
    assert not wrong(rows) and not unchecked([row.facts() for row in rows])


def test_a_memory_of_another_motor_checks_nothing_of_what_was_refused() -> None:
    """R of a motor of 0.1 A is refused beside a set of a motor of 50 A: no contradiction, and not checked either."""
    other = {"pole_pairs": 7.0, "R_s_ohm": 0.1, "L_d_h": 1e-4, "L_q_h": 1e-4, "psi_f_wb": 0.01}
    for refused in (["R_s_ohm"], ["R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb", "J_kgm2"]):
        rows = compare(TRUTH, other, [v for v in measured() if v["name"] not in refused])
        left = [row for row in rows if row.name in refused]
        assert not wrong(rows) and {row.verdict for row in left} == {"NOT CHECKED"}
        assert all(OTHER_MOTOR in row.text for row in left if row.held is not None)
    # two motors may have as many pole pairs
    alike = [v for v in measured() if v["name"] in ("pole_pairs", "psi_f_wb")]
    assert not wrong(compare(TRUTH, {**other, "pole_pairs": TRUTH.machine.pole_pairs}, alike))
    # one value that differs is a wrong file, or one wrong value in the drive: the others still are this motor's
    one = {**{key: getattr(TRUTH.machine, key) for key in HELD}, "L_d_h": 1e-4}
    assert wrong(compare(stated(R_s_ohm=2.0), one, [v for v in measured() if v["name"] != "R_s_ohm"])) == ["R_s_ohm"]
    # nothing measured, nothing known of whose set it is; a measurement that stands on the held value is none of its own
    assert wrong(compare(TRUTH, other, [])) == [*other]
    only = [v for v in measured() if v["name"] == "R_s_ohm"]
    assert wrong(compare(TRUTH, other, only, used=("pole_pairs",))) == ["pole_pairs"]


def test_only_what_no_measurement_could_tell_is_compared_before_anything_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reference drive measures its pole pairs, and may hold those of another motor; nothing measures the counts."""
    held = {"pole_pairs": 7.0, "R_s_ohm": 50.0, "encoder_counts": 4096.0}
    monkeypatch.setattr(compared_stage, "held_values", lambda _: held)
    whole = reference_capabilities(Mock())
    blind = replace(whole, features=frozenset())
    for capabilities, names in ((whole, ["encoder_counts"]), (blind, ["pole_pairs", "encoder_counts"])):
        stage = contradicted_unmoved(Mock(), TRUTH, capabilities)
        assert stage is not None and stage.status == "fail"
        assert [row["name"] for row in stage.comparison if row["verdict"] == "contradicts"] == names
    assert contradicted_unmoved(Mock(), None, whole) is None
    held.pop("encoder_counts")
    assert contradicted_unmoved(Mock(), TRUTH, whole) is None


def test_a_value_that_is_hardly_known_checks_nothing() -> None:
    """R within the knee of the inverter's error, known to +-98 %, agreed with every data sheet."""
    R = TRUTH.machine.R_s_ohm
    for half, verdict in ((0.45, "agrees"), (0.98, "NOT CHECKED")):
        values = [*(v for v in measured() if v["name"] != "R_s_ohm"), value("R_s_ohm", R, half=half)]
        rows = compare(TRUTH, {}, values)
        assert found(rows)["R_s_ohm"] == verdict
        assert ("R_s_ohm" in unchecked([row.facts() for row in rows])) == (verdict == "NOT CHECKED")
    assert wrong(compare(stated(R_s_ohm=3.0), {}, [value("R_s_ohm", R, half=0.6)])) == ["R_s_ohm"]


def test_a_refused_value_checks_nothing() -> None:
    values = [{**v, "accepted": v["name"] != "R_s_ohm"} for v in measured(R_s_ohm=9.9)]
    assert found(compare(TRUTH, {}, values))["R_s_ohm"] == "NOT CHECKED"


def test_encoder_counts_are_those_of_the_drive() -> None:
    assert TRUTH.encoder.bits == 17
    assert found(compare(TRUTH, {"encoder_counts": 2.0**17}, measured()))["encoder_counts"] == "agrees"
    rows = compare(TRUTH, {"encoder_counts": 2.0**15}, measured())
    assert wrong(rows) == ["encoder_counts"] and "ratio 4" in rows[-1].text
    assert found(compare(TRUTH, {}, measured()))["encoder_counts"] == "NOT CHECKED"


# ---- accepting, and what is said ------------------------------------------------------------------------------


def test_an_accepted_contradiction_stands_below_the_headline() -> None:
    rows = [row.facts() for row in compare(stated(J_kgm2=5.0), {}, measured(), accept=("J_kgm2",))]
    assert next(row for row in rows if row["name"] == "J_kgm2")["verdict"] == "accepted"
    stage = {"name": "identify", "status": "pass", "comparison": rows}
    assert verdict_of({"stages": [stage]}, ("identify",)).details[0].startswith("CONTRADICTION ACCEPTED: J_kgm2: ")


@pytest.mark.parametrize("name", ["pole_pairs", "encoder_counts", "psi_f_wb", "L_d_h"])
def test_what_commutation_and_limits_follow_from_is_never_accepted(name: str) -> None:
    assert name not in ACCEPTABLE
    with pytest.raises(SafetyRefusal, match=name):
        check_accepted((name,))
    file = stated(pole_pairs=7, psi_f_wb=2.0, L_d_h=2.0, L_q_h=2.0)
    rows = compare(file, {"encoder_counts": 5.0}, measured(), accept=(name,))
    assert name in wrong(rows)


@pytest.mark.parametrize("name", ["offset_rad", "direction", "I_nom_apk", "I_max_apk", "n_max_rpm"])
def test_limits_sign_and_offset_are_refused_by_name(name: str) -> None:
    with pytest.raises(SafetyRefusal, match=name):
        check_accepted((name,))


def test_an_unknown_name_is_no_quantity() -> None:
    with pytest.raises(ConfigError, match="friction"):
        check_accepted(("friction",))


def test_what_is_not_checked_is_in_the_headline_and_no_plain_pass() -> None:
    rows = [row.facts() for row in compare(TRUTH, {}, [v for v in measured() if v["name"] != "R_s_ohm"])]
    assert unchecked(rows) == {"R_s_ohm": "data sheet", "encoder_counts": "data sheet"}
    assert headline(rows) == ([], ["NOT CHECKED (data sheet): R, encoder counts"])
    stage = {"name": "identify", "status": "pass", "comparison": rows}
    found_verdict = verdict_of({"stages": [stage]}, ("identify",))
    assert found_verdict.word == "PARTIAL" and "NOT CHECKED (data sheet): R" in found_verdict.headline


def test_gains_that_follow_from_it_are_marked() -> None:
    rows = [row.facts() for row in compare(TRUTH, {}, [v for v in measured() if v["name"] != "L_d_h"])]
    found_marks = marks(("motor.L_d_h", "current.K_p_d_v_per_a", "current.K_p_q_v_per_a", "speed.K_i_nm_per_rad"), rows)
    assert found_marks == dict.fromkeys(("motor.L_d_h", "current.K_p_d_v_per_a"), "from L_d: NOT CHECKED")


def test_the_table_shows_all_three() -> None:
    rows = [row.facts() for row in compare(TRUTH, {"pole_pairs": 3.0}, measured())]
    cells = {cell[0]: cell for cell in table_cells(rows)}
    assert cells["pole_pairs"][1:] == ("3", "exact", "3", "3", "agrees")
    assert cells["psi_f_wb"][1] == "0.545 Wb" and "data sheet 10 %" in cells["psi_f_wb"][2]


def test_values_with_one_cause_name_it_once(tmp_path: Path) -> None:
    """Three values read line to line named it three times each."""
    rows = compare(stated(R_s_ohm=0.5, L_d_h=0.5, L_q_h=0.5, psi_f_wb=0.7), {}, measured())
    stage = Stage("identify", "fail", 1.0, values=[{"name": "R_s_ohm"}], comparison=[row.facts() for row in rows])
    error = refusal(stage, RunDirectory(tmp_path))
    assert error is not None and "likely" not in error.what and error.what.count("the data sheet states") == 4
    assert error.likely.startswith("R_s_ohm x2 is near 2, L_d_h x2 is near 2, L_q_h x2 is near 2: line to line instead")
    assert error.likely.endswith("; psi_f_wb x1.43 is near 1.414: rms instead of peak")
