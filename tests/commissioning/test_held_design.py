# SPDX-License-Identifier: MIT
"""A design as a drive will hold it: what is judged is what is written, and nothing else is judged."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from click.testing import CliRunner

from pmsmtool.cli.main import cli
from pmsmtool.commissioning.axis_design import design_for, held_design, why_not_judged
from pmsmtool.design.closed_drive import RATED, SLOPE, STATED, TORQUE
from pmsmtool.design.design_file import Design, DesignValue, design_text, load_design, parse_design
from pmsmtool.design.loops.designed_loops import CURRENT_GAINS, open_loops
from pmsmtool.design.loops.margins import margin_report
from pmsmtool.design.loops.sampled_loop import margins
from pmsmtool.design.tolerance import tolerance_box
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive_maps.shipped_maps import family_names, load_family
from pmsmtool.errors import ConfigError, NotAvailable
from pmsmtool.machine.machine_file import load_machine_file, machine_path

FOREIGN = [name for name in family_names() if name != "pmsmsim"]
TAKES = {"epos4": {"current_d", "current_q"}, "ingenia": {"current_d", "current_q"}}
"""Loops of the families that have objects for their gains; the others keep their own."""


@cache
def designed() -> Design:
    return tune(load_machine_file(machine_path("interior-2k2")))


@pytest.mark.parametrize("family", FOREIGN)
def test_only_loops_whose_gains_the_drive_takes_are_judged(family: str) -> None:
    held = held_design(designed(), load_family(family))
    assert set(held.loops) == TAKES.get(family, set())
    again = parse_design(design_text(held))
    assert set(again.loops) == set(held.loops) and all(v.loop in {"", *held.loops} for v in again.values.values())
    judged = {spread.name.rpartition("_")[0] for spread in margin_report(again, tolerance_box(again.machine)).loops}
    assert judged == set(held.loops)
    assert bool(why_not_judged(held)) == (not held.loops)
    assert any("speed loop not judged" in note and "speed.filter_hz" in note for note in held.notes)


@pytest.mark.parametrize("family", sorted(TAKES))
def test_the_margins_are_those_of_the_gains_as_written(family: str) -> None:
    drive_map = load_family(family)
    held = held_design(designed(), drive_map)
    written = drive_map.quantised(held.parameter_set()).values
    for name in CURRENT_GAINS:
        if name in drive_map.cells:
            assert held[name] == written[name], "what is judged is what the drive will hold"
    for name, loop in open_loops(held).items():
        assert margins(loop).phase_margin_deg == held.loops[name].phase_margin_deg


def test_one_pair_is_judged_on_both_axes() -> None:
    """L_q is larger than L_d: with the gains of d the q loop is slower, by their ratio, and keeps more margin."""
    held, machine = held_design(designed(), load_family("epos4")), designed().machine.machine
    assert held["current.K_p_d_v_per_a"] == held["current.K_p_q_v_per_a"] < designed()["current.K_p_q_v_per_a"]
    assert held.loops["current_q"].phase_margin_deg > designed().loops["current_q"].phase_margin_deg + 5.0
    alpha = float(held.facts["current_bandwidth_rad_s"])
    assert alpha == pytest.approx(held["current.K_p_q_v_per_a"] / machine.L_q_h)
    assert held["governor.alpha_rad_s"] == alpha
    assert "speed_crossover_rad_s" not in held.facts, "the drive keeps its own speed loop"


def test_a_reference_drive_holds_the_design_as_it_is() -> None:
    assert held_design(designed(), load_family("pmsmsim")) is designed()


def test_gains_that_do_not_fit_are_refused() -> None:
    design = designed()
    name = "current.K_p_q_v_per_a"
    large = replace(
        design,
        values={
            **design.values,
            **{n: replace(design.values[n], value=1e6) for n in (name, name.replace("_q_", "_d_"))},
        },
    )
    with pytest.raises(ConfigError, match="cannot hold 1 value"):
        held_design(large, load_family("epos4"))


@pytest.mark.chain
def test_loops_whose_gains_the_objects_do_not_hold_are_designed_slower() -> None:
    """With the margins of the gains that are written; a tenth of the bandwidth and less is no design for the drive."""
    machine, name = load_machine_file(machine_path("interior-2k2")), "current.K_p_q_v_per_a"
    whole = held_design(designed(), load_family("epos4"))
    held = design_for(load_family("epos4").limited({(0x30A0, 1): (0, 50_000_000)}), tune, machine, TuneRequest())
    assert held[name] == 50.0 < whole[name]
    ratio = whole[name] / whole["current.K_i_q_v_per_as"]
    assert held[name] / held["current.K_i_q_v_per_as"] == pytest.approx(ratio, rel=1e-6)
    assert held.loops["current_d"].phase_margin_deg > whole.loops["current_d"].phase_margin_deg + 10.0
    assert any(f"{name}, current.K_i_q_v_per_as hold" in note for note in held.notes)
    with pytest.raises(ConfigError, match="cannot hold 1 value"):
        design_for(load_family("epos4").limited({(0x30A0, 1): (0, 5_000_000)}), tune, machine, TuneRequest())


def run(*arguments: str) -> tuple[int, str, BaseException | None]:
    result = CliRunner().invoke(cli, arguments)
    return result.exit_code, result.output, result.exception


@pytest.mark.chain
def test_tune_judges_the_loops_at_the_bandwidth_that_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for hertz in (100.0, 400.0):
        code, out, _ = run(
            "tune", "interior-2k2", "-o", "d.toml", "--map", "copley", "--drive-bandwidth-hz", f"{hertz}", "--json"
        )  # fmt: skip
        data = json.loads(out.splitlines()[0])
        assert code == 0 and set(data["loops"]) == {"current_d", "current_q"}
        assert data["facts"]["current_bandwidth_rad_s"] == pytest.approx(2.0 * math.pi * hertz)
        for loop in data["loops"].values():  # a first-order loop crosses at its bandwidth
            assert loop["crossover_rad_s"] == pytest.approx(2.0 * math.pi * hertz, rel=0.02)
    design = load_design(tmp_path / "d.toml")
    assert design.request[STATED] == 400.0 and "not written" in design.values[CURRENT_GAINS[0]].method
    assert run("margins", "d.toml")[0] == 0


def test_margins_of_a_drive_that_takes_no_gains_are_not_available(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    design = held_design(designed(), load_family("faulhaber"))
    (tmp_path / "d.toml").write_text(design_text(design), encoding="utf-8")
    code, out, error = run("margins", "d.toml")
    assert isinstance(error, NotAvailable) and "the map 'faulhaber' has no object" in str(error)
    assert "current_d_phase" not in out and "headroom_voltage" in out
    code, out, error = run("margins", "d.toml", "--thermal-headroom", "-1")
    assert code == 0, "what is asked of the headroom is judged"


@pytest.mark.parametrize("kind", ["design", "set"])
def test_a_design_goes_to_a_drive_with_one_pair_as_it_was_judged(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one that was made without a map, and its set: the gain of q would be too large for d."""
    monkeypatch.chdir(tmp_path)
    text = design_text(designed()) if kind == "design" else designed().parameter_set().to_toml()
    (tmp_path / "d.toml").write_text(text, encoding="utf-8")
    code, out, _ = run(
        "-i", "pmsmsim", "-c", "interior-2k2?nv=:memory:&drive=epos4", "flash-params", "d.toml", "--map", "epos4",
        "--dry-run", "--json",
    )  # fmt: skip
    wanted = {change["name"]: change["wanted"] for change in json.loads(out)["changes"]}
    assert code == 0
    assert wanted["current.K_p_q_v_per_a"] == designed()["current.K_p_d_v_per_a"] < designed()["current.K_p_q_v_per_a"]


@pytest.mark.parametrize("rated_nm", [14.9074, 14.9076, 0.31415, 0.0016])
def test_limits_are_held_at_or_below_what_is_asked(rated_nm: float) -> None:
    """They are counted relative to the rated torque, which the drive keeps in whole mN m: rounded up it raised them."""
    drive_map = load_family("cia402")
    asked = {RATED: rated_nm, SLOPE: 37.77 * rated_nm, TORQUE: 0.7777 * rated_nm}
    design = replace(designed(), values={**designed().values, **{n: DesignValue(v, "") for n, v in asked.items()}})
    held = drive_map.quantised(held_design(design, drive_map).parameter_set()).values
    assert held[RATED] == pytest.approx(rated_nm, abs=0.5e-3)
    count = 1e-3 * held[RATED]  # permille, and permille per second
    for name in (SLOPE, TORQUE):
        assert asked[name] - 1.001 * count <= held[name] <= asked[name] * (1.0 + 1e-14)
