# SPDX-License-Identifier: MIT
"""A run passes only when all of it ran on measured values; what it ran on, and an unsafe end, come first."""

from __future__ import annotations

from typing import Any

import pytest

from pmsmtool.bus.connection import Connection
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.measurement.capabilities import examine
from pmsmtool.report.report import render
from pmsmtool.report.verdict import COMPLETE, NEEDED, on_which_drive, verdict_of
from pmsmtool.sim.bus import PmsmSimBus


def stage(name: str, status: str = "pass", **more: Any) -> dict[str, Any]:
    line = {"what": "criterion", "measured": "1 %", "limit": "3 %", "ok": status != "fail"}
    values = [{"name": key, "value": 1.0, "std": 0.1, "systematic": 0.1, "unit": "ohm"} for key in NEEDED]
    return {
        "name": name, "status": status, "note": "" if status == "pass" else f"{name} says why", "seconds": 1.0,
        "values": values if name == "identify" else [], "acceptance": [line], **more,
    }  # fmt: skip


def record(*stages: dict[str, Any], **more: Any) -> dict[str, Any]:
    ran = {entry["name"]: entry for entry in stages}
    return {
        "drive": {"name": "EPOS4", "serial": 7}, "bus": {"interface": "socketcan"}, "operator": "A", "started_utc": "",
        "stages": [ran.pop(name, None) or stage(name) for name in COMPLETE], **more,
    }  # fmt: skip


def test_all_stages_on_measured_values_pass() -> None:
    found = verdict_of(record())
    assert (found.kind, found.headline) == ("pass", "PASS: 7 of 7 stages ran, 7 criteria, all met")


@pytest.mark.parametrize("name", COMPLETE)
def test_a_stage_that_the_drive_cannot_give_makes_it_partial_with_its_reason(name: str) -> None:
    found = verdict_of(record(stage(name, "not available")))
    assert found.kind == "partial" and found.headline.startswith("PARTIAL: 6 of 7 stages ran")
    assert f"{name}: not available: {name} says why" in found.details


@pytest.mark.parametrize("status", ["refused", "interrupted", "fail"])
def test_a_stage_that_did_not_hold_fails(status: str) -> None:
    assert verdict_of(record(stage("margins", status))).kind == "fail"


@pytest.mark.parametrize(("status", "code"), [("refused", 7), ("interrupted", 130)])
def test_a_run_that_a_person_ended_broke_no_criterion(status: str, code: int) -> None:
    ended = {"state": status, "stage": "flash", "exit_code": code, "what": "no"}
    found = verdict_of(record(stage("flash", status), account=ended))
    said = "interrupted during flash: flash says why; resumed, it begins with that stage again; 6 of 7 stages ran"
    assert found.kind == "partial" and found.headline.startswith(f"PARTIAL: {said}") is (status == "interrupted")
    assert (f"flash: {status}: flash says why" in found.details) is (status == "refused")
    nothing = verdict_of({"stages": [stage("identify", status)], "account": ended}).headline
    assert nothing.endswith("no stage came to its end")


def test_wrong_wiring_comes_before_what_ran() -> None:
    """Before, a commissioning with two swapped leads ended with '6 of 7 stages ran, 20 criteria, all met'."""
    why = "the position falls under positive torque (likely two motor leads swapped; try: `pmsmtool check`)"
    identified = {**stage("identify", "partial"), "refused": {"encoder sign": why}}
    found = verdict_of(record(identified, *(stage(name) for name in COMPLETE[1:])))
    assert found.headline.startswith("PARTIAL: encoder sign WRONG: the position falls under positive torque; 7 of 7")
    assert f"encoder sign: refused: {why}" in found.details


def test_a_failed_run_says_what_was_refused_before() -> None:
    """Before, a proof that failed after refused mechanics ended without the reason of the refusal."""
    identified = {**stage("identify", "partial"), "refused": {"mechanics": "E_MODEL_MISMATCH: the shaft is not rigid"}}
    found = verdict_of(record(identified, stage("prove", "fail")))
    assert found.headline.startswith("FAIL: prove: ")
    assert found.details == ("mechanics: refused: E_MODEL_MISMATCH: the shaft is not rigid",)


def test_a_failed_run_says_what_it_follows_from_and_nobody_measured() -> None:
    """A proof failed for an R twice the motor's, which the bridge hid: the verdict named no cause, and not R either."""
    row = {"name": "R_s_ohm", "verdict": "NOT CHECKED", "source": "data sheet", "stated": 2.0, "text": ""}
    identified = {**stage("identify", "partial"), "comparison": [row]}
    assert verdict_of(record(identified, stage("prove", "fail"))).details == ("NOT CHECKED (data sheet): R",)


def test_an_identification_that_gave_a_part_is_partial_and_names_the_rest() -> None:
    identified = stage("identify", "partial")
    identified["values"] = [value for value in identified["values"] if value["name"] != "psi_f_wb"]
    found = verdict_of(record(identified))
    assert found.kind == "partial" and found.headline.startswith("PARTIAL: 7 of 7 stages ran")
    assert "NOT CHECKED (not measured in this run): psi" in found.headline
    assert "identify: partial: identify says why" in found.details


def test_a_chain_that_went_on_from_an_identification_of_less_does_not_pass() -> None:
    """`identify R`, then `commission --resume`: the gains follow from what nobody measured."""
    identified = stage("identify")
    identified["values"] = [value for value in identified["values"] if value["name"] == "R_s_ohm"]
    found = verdict_of(record(identified)).headline
    assert "(not measured in this run): pole pairs, L_d, L_q, psi, J" in found


def test_what_a_stage_leaves_unchecked_stands_in_the_headline() -> None:
    found = verdict_of(record(stage("identify", not_checked=["R_s_ohm: data sheet, NOT CHECKED"])))
    assert found.kind == "partial" and "R_s_ohm: data sheet, NOT CHECKED" in found.headline


def test_a_given_value_is_not_checked() -> None:
    identified = stage("identify")
    identified["values"][1] = {"name": "R_s_ohm", "value": 1.0, "unit": "ohm", "source": "as given"}
    found = verdict_of(record(identified))
    assert found.kind == "partial" and "NOT CHECKED (data sheet): R" in found.headline


@pytest.mark.parametrize("status", ["pass", "not available"])
def test_a_required_stage_that_is_missing_fails(status: str) -> None:
    found = verdict_of(record(stage("prove", status), request={"require": ["prove"]}))
    assert found.kind == ("pass" if status == "pass" else "fail")
    if status != "pass":
        assert found.headline == "FAIL: prove: required, and not available: prove says why"


def test_a_required_stage_that_was_never_begun_fails() -> None:
    short = record(request={"require": ["prove"]})
    short["stages"] = short["stages"][:3]
    assert verdict_of(short).headline == "FAIL: prove: required, and it did not run"


def test_an_accepted_limit_is_shown_on_the_first_screen() -> None:
    line = "accepted (--accept-limit speed): the design ends at 639 rpm, rated 1500 rpm"
    found = verdict_of(record(stage("tune", accepted=[line])))
    assert found.kind == "pass" and line in found.details


def test_a_run_in_which_nothing_ran_is_no_pass() -> None:
    assert verdict_of({"stages": []}, ("identify",)).headline.startswith("PARTIAL")


def test_a_run_that_was_killed_in_a_repeated_stage_does_not_keep_its_pass() -> None:
    found = verdict_of(record(account={"state": "open", "stage": "prove", "exit_code": None}))
    assert found.kind == "partial" and "prove: begun, and its end was not recorded" in found.details


def test_a_stop_that_was_not_confirmed_is_the_first_of_the_report() -> None:
    ended = {"state": "fail", "stage": "prove", "exit_code": 8, "what": "node 1 does not answer"}
    page = render(record(stage("prove", "fail"), account=ended), ended=["failed during prove"])
    body = page[page.index("<body>") :]
    first = body.index("STOP NOT CONFIRMED: the machine may be energised: use the hardware stop")
    assert first < min(body.index(text) for text in ("<h1>", "prove says why", "criterion", "failed during prove"))
    assert page.index("<title>STOP NOT CONFIRMED") > 0
    over = {**ended, "state": "complete", "exit_code": None}
    assert "STOP NOT CONFIRMED" not in render(record(account=over)), "a later run of the stage ended well"


@pytest.mark.parametrize("face", ["", "&drive=epos4", "&drive=copley", "&drive=faulhaber", "&level=recorder"])
def test_a_served_simulation_is_known_by_the_name_it_gives_itself(face: str) -> None:
    with Connection(PmsmSimBus(f"interior-2k2?nv=:memory:{face}")) as connection:
        node = DriveNode(connection, 1)
        name = examine(node).identity.name
        node.close()
    served = record(drive={"name": name, "serial": 7}, bus={"interface": "socketcand"})
    assert verdict_of(served).headline.startswith("SIMULATED DRIVE, PASS")
    assert ">SIMULATED DRIVE, PASS: 7 of 7" in render(served)
    assert on_which_drive("R 3.6 ohm", served) == "SIMULATED DRIVE, R 3.6 ohm"
    assert on_which_drive("", served) == "SIMULATED DRIVE" and on_which_drive("R", record()) == "R"
