# SPDX-License-Identifier: MIT
"""``identify --fingerprint RUN``: the same motor, another one, and what cannot be compared."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pmsmtool.commissioning.report_page import report_page, verdict
from pmsmtool.identification.by_pulses import FACTS, PulseFacts, dump_facts
from pmsmtool.identification.by_vendor import ANSWERS
from pmsmtool.identification.fingerprint import QUANTITIES, fingerprint_stage, read_earlier
from pmsmtool.identification.request import REQUEST, IdentifyRequest, Method, dump_request
from pmsmtool.identification.value_verdict import value_facts
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file, machine_path
from pmsmtool.machine.parameters import Estimate
from pmsmtool.measurement.by_injection import with_limits_of
from pmsmtool.run_directory import RunDirectory, RunRecord, Stage
from tests.cli.conftest import Tool

PROFILE = load_machine_file(machine_path("interior-2k2"))
VALUES: dict[str, Estimate] = {
    "R_s_ohm": Estimate(3.6, 0.004, 0.06, "ohm", T_c=25.0),
    "L_d_h": Estimate(0.036, 3e-5, 5e-4, "H", i_d_apk=3.0),
    "L_q_h": Estimate(0.051, 4e-5, 7e-4, "H", i_d_apk=3.0),
    "psi_f_wb": Estimate(0.545, 3e-4, 6e-3, "Wb", T_c=25.0),
    "pole_pairs": Estimate(3.0, 0.001, 0.0, "1"),
    "offset_rad": Estimate(3.1, 2e-4, 0.0, "rad"),
}


def made(folder: Path, values: Mapping[str, Estimate], *, serial: int = 5, direction: int = 1) -> RunDirectory:
    """Make a run as `identify` leaves it."""
    facts = [{**value_facts(name, estimate), "accepted": True} for name, estimate in values.items()]
    stage = Stage("identify", "pass", 1.0, values=facts)
    drive = {"serial": serial, "vendor": 1, "name": "x"}
    record = RunRecord("2026-01-01T00:00:00Z", "x", ("pmsmtool", "identify"), {}, drive, {}, stages=(stage,))
    run = RunDirectory.create(folder, serial, record)
    encoder = replace(PROFILE.encoder, direction=direction)  # type: ignore[arg-type]
    run.save("machine.toml", dump_machine_file(replace(PROFILE, encoder=encoder)))
    run.save(REQUEST, dump_request(IdentifyRequest()))
    return run


def changed(**factors: float) -> dict[str, Estimate]:
    """Return the values of another motor; an angle and a count get the number added, the others are multiplied."""
    added = ("offset_rad", "pole_pairs")
    return {
        name: replace(e, value=e.value + factors.get(name, 0.0) if name in added else e.value * factors.get(name, 1.0))
        for name, e in VALUES.items()
    }


def compared(folder: Path, then: RunDirectory, now: RunDirectory) -> Stage:
    return fingerprint_stage(read_earlier(then), now, QUANTITIES)[0]


def test_equal_machines_agree_in_all_values_in_95_of_100(tmp_path: Path) -> None:
    """Each value by itself would let 26 % of equal machines differ in one; here 5 % at most (measured 1 %)."""
    rng = np.random.default_rng(3)
    earlier = read_earlier(made(tmp_path, VALUES))
    run = made(tmp_path, VALUES)
    record = run.read()
    agree = 0
    for _ in range(100):
        pair = [{n: replace(e, value=float(rng.normal(e.value, e.std))) for n, e in VALUES.items()} for _ in range(2)]
        pair = [{**values, "pole_pairs": VALUES["pole_pairs"]} for values in pair]
        facts = [{**value_facts(name, e), "accepted": True} for name, e in pair[1].items()]
        run.write(replace(record, stages=(replace(record.stages[0], values=facts),)))
        agree += fingerprint_stage(replace(earlier, estimates={**pair[0]}), run, ("R", "L", "psi"))[0].status == "pass"
    assert agree >= 95


TURNS = {"R_s_ohm": 1.21, "L_d_h": 1.21, "L_q_h": 1.21, "psi_f_wb": 1.1}
CAUSES: dict[str, tuple[dict[str, float], int, str]] = {
    "pole pairs": ({"pole_pairs": 1.0, "psi_f_wb": 0.8}, 1, "another motor: other pole pairs"),
    "rewound": (TURNS, 1, "another number of turns"),
    "demagnetised": ({"psi_f_wb": 0.97}, 1, "demagnetised"),
    "stronger": ({"psi_f_wb": 1.03}, 1, "another rotor"),
    "cable": ({"R_s_ohm": 1.05}, 1, "cable or joint"),
    "air gap": ({"L_d_h": 1.02, "L_q_h": 1.02}, 1, "air gap"),
    "another": ({"R_s_ohm": 1.1, "L_d_h": 0.9, "L_q_h": 0.9, "psi_f_wb": 1.02}, 1, "another motor"),
    "moved": ({"offset_rad": 0.2}, 1, "encoder was moved"),
    "shifted": ({"offset_rad": 2.0 * math.pi / 3.0 - 2.0 * math.pi}, 1, "shifted by one"),
    "swapped": ({"offset_rad": 1.0}, -1, "two motor leads are swapped"),
}


@pytest.mark.parametrize("case", CAUSES)
def test_a_difference_has_a_likely_cause_and_stands_in_record_and_report(case: str, tmp_path: Path) -> None:
    factors, direction, cause = CAUSES[case]
    then, now = made(tmp_path, VALUES), made(tmp_path, changed(**factors), direction=direction)
    stage = compared(tmp_path, then, now)
    differ = {row["name"] for row in stage.values if row["verdict"] == "DIFFERENT"}
    assert differ == {*factors, *(["direction"] if direction < 0 else [])}
    assert stage.status == "fail" and cause in stage.note and "DIFFERENT: " in stage.summary
    now.add(stage)
    kept = now.read().stage("fingerprint")
    assert kept is not None and (kept.status, kept.note, list(kept.values)) == ("fail", stage.note, list(stage.values))
    assert verdict(now.path).word == "FAIL" and cause in report_page(now.path)


def test_the_same_motor_passes_also_round_the_circle(tmp_path: Path) -> None:
    then = made(tmp_path, changed(offset_rad=math.pi - 3.10005))
    now = made(tmp_path, changed(offset_rad=-math.pi - 3.09995))
    stage = compared(tmp_path, then, now)
    now.add(stage)
    assert stage.status == "pass" and not stage.note and verdict(now.path).word == "PASS"
    assert "identify and fingerprint, 7 criteria, all met" in verdict(now.path).headline
    assert {line.what.split(":")[0] for line in stage.acceptance} == {*VALUES, "direction"}
    assert f"as in {then.path.name}" in report_page(now.path)


def test_between_two_drives_the_sensors_count(tmp_path: Path) -> None:
    values = changed(R_s_ohm=1.015, L_d_h=1.01, L_q_h=1.01, psi_f_wb=0.99)
    then = made(tmp_path, VALUES)
    assert compared(tmp_path, then, made(tmp_path, values)).status == "fail"
    assert compared(tmp_path, then, made(tmp_path, values, serial=6)).status == "pass"


def test_what_is_in_one_run_only_is_named_and_never_the_same(tmp_path: Path) -> None:
    then = made(tmp_path, {name: e for name, e in VALUES.items() if name != "psi_f_wb"})
    other = replace(VALUES["L_d_h"], i_d_apk=1.5)
    now = made(tmp_path, {**VALUES, "L_d_h": other, "R_s_ohm": replace(VALUES["R_s_ohm"], value=math.nan)})
    stage, rows, left = fingerprint_stage(read_earlier(then), now, QUANTITIES)
    assert stage.status == "partial" and set(left) == {"psi_f_wb", "L_d_h", "R_s_ohm"}
    assert {row.name for row in rows} == {"L_q_h", "pole_pairs", "offset_rad", "direction"}
    assert "1.5 A now" in left["L_d_h"] and "psi_f_wb not compared: the earlier run" in stage.note
    now.add(stage)
    assert verdict(now.path).word == "PARTIAL"
    assert read_earlier(then).measurable(QUANTITIES) == ("R", "L", "encoder", "poles"), "psi is not even measured"


def test_it_repeats_with_the_limits_of_the_run_but_never_above_the_drive(tmp_path: Path) -> None:
    then = IdentifyRequest(i_max_apk=3.0, speed_max_rad_s=1e5)
    found = with_limits_of(then, IdentifyRequest(), PROFILE)
    assert found.i_max_apk == 3.0 and found.speed_max_rad_s == pytest.approx(math.pi * 100.0)
    assert with_limits_of(then, IdentifyRequest(i_max_apk=2.0), PROFILE).i_max_apk == 2.0
    assert with_limits_of(replace(then, i_max_apk=50.0), IdentifyRequest(), PROFILE).i_max_apk == pytest.approx(7.296)


def broken(run: RunDirectory, kind: str) -> None:
    record = run.read()
    if kind == "no identification":
        run.write(replace(record, stages=()))
    elif kind == "no values":
        run.write(replace(record, stages=(replace(record.stages[0], values=()),)))
    elif kind == "by the drive itself":
        run.save(ANSWERS, "{}")
    elif kind == "level damaged":
        run.save(FACTS, "{")
    elif kind == "another level":
        run.save(FACTS, dump_facts(PulseFacts(Method.RECORDER)))
    elif kind == "no request":
        (run.path / REQUEST).unlink()
    elif kind == "request damaged":
        run.save(REQUEST, '{"quantities": 3}')
    elif kind == "machine damaged":
        run.save("machine.toml", "[machine")
    elif kind == "record damaged":
        run.save("run.json", '{"schema": "pmsmtool.run/1", "stages": [{"name": 3}]}')
    else:
        run.save("run.json", "")


BROKEN: dict[str, str] = {
    "no identification": "nothing was identified", "no values": "no value of R, L, psi", "no record": "run.json",
    "by the drive itself": "no interval", "level damaged": "level is damaged", "another level": "--method recorder",
    "no request": "request.json", "request damaged": "request is damaged", "machine damaged": "machine.toml",
    "record damaged": "record is damaged",
}  # fmt: skip


@pytest.mark.parametrize("kind", BROKEN)
def test_a_run_that_cannot_be_compared_with_is_refused_before_anything_is_asked(
    kind: str, tool: Tool, tmp_path: Path
) -> None:
    run = made(tmp_path, VALUES)
    broken(run, kind)
    method = ("--method", "inject") if kind == "another level" else ()
    code, out, err = tool(
        "identify", "-i", "pmsmsim", "-c", "nothing", "--yes", "--fingerprint", str(run.path), *method
    )
    assert (code, out) == (2, "") and BROKEN[kind] in err and "try:" in err, err


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [(("map",), 2, "single values"), (("mechanics",), 2, "no value of mechanics"), (("--replay", "x"), 2, "diff")],
)
def test_what_cannot_be_asked(tool: Tool, tmp_path: Path, arguments: tuple[str, ...], code: int, text: str) -> None:
    run = made(tmp_path, VALUES)
    (tmp_path / "x").mkdir()
    found, _, err = tool("identify", "--sim", "interior-2k2", "--fingerprint", str(run.path), *arguments)
    assert found == code and text in err, err


def test_a_drive_that_lacks_the_level_of_the_run_says_what_is_missing(tool: Tool, tmp_path: Path) -> None:
    run = made(tmp_path, VALUES)
    channel = "interior-2k2?drive=cia402&nv=:memory:"
    code, _, err = tool("identify", "-i", "pmsmsim", "-c", channel, "--yes", "--fingerprint", str(run.path))
    assert code == 9 and "inject" in err, err


def on_a_drive(tool: Tool, *arguments: str, seed: int, **simulation: Any) -> tuple[int, dict[str, Any], str]:
    machine = replace(PROFILE, simulation={**PROFILE.simulation, **simulation})
    Path("drive.toml").write_text(dump_machine_file(machine))
    channel = f"drive.toml?nv=:memory:&seed={seed}"
    code, out, err = tool("identify", "-i", "pmsmsim", "-c", channel, "--yes", "--json", *arguments)
    return code, json.loads(out), err


@pytest.mark.chain
def test_on_a_simulated_drive(tool: Tool, tmp_path: Path) -> None:
    run = made(tmp_path, {"R_s_ohm": replace(VALUES["R_s_ohm"], value=3.602)})
    earlier = ("--fingerprint", str(run.path))
    code, found, err = on_a_drive(tool, "R", *earlier, seed=2)
    assert code == 0, err
    (row,) = found["fingerprint"]["quantities"]
    assert row["name"] == "R_s_ohm" and row["verdict"] == "SAME" and abs(row["difference"]) > 0.0
    assert RunDirectory(Path(found["run"])).read().passed("fingerprint")
    assert err.splitlines()[-1] == f"SAME motor as in {run.path.name}: 1 of 1 values agree"
    code, found, err = on_a_drive(tool, "R", *earlier, seed=2, R_s_ohm=3.8)
    assert code == 1 and "R_s_ohm: not as in" in err and "cable or joint" in err
    assert found["fingerprint"]["likely"] in err
    code, found, err = on_a_drive(tool, *earlier, seed=2, T_winding_c=60.0)
    rests = {"pole_pairs", "direction", "offset_rad"}  # the rotor's, on the vectors that R is measured on
    assert code == 10 and set(found["fingerprint"]["not_compared"]) == {"L", "psi", *rests}
    named = {value["name"] for value in found["values"]}
    assert named == {"R_s_ohm", "R_s_ohm_measured", "pole_pairs", "offset_rad"}, "nothing else was moved for"
