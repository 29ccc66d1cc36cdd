# SPDX-License-Identifier: MIT
"""The report says PASS only when everything passed, and shows every number with its interval."""

from __future__ import annotations

import copy
import math
import re

import pytest

from pmsmtool.report.report import INTEGER, Change, Figure, _estimate_row, _intervals, render, total_interval
from pmsmtool.report.verdict import COMPLETE, NEEDED


def _record() -> dict:
    stages = [
        {
            "name": name,
            "status": "pass",
            "seconds": 1.0,
            "values": [],
            "acceptance": [{"what": f"{name} criterion", "measured": "0.1 %", "limit": "1 %", "ok": True}],
            "fallbacks": [],
            "files": {},
            "note": "",
        }
        for name in COMPLETE
    ]
    stages[0]["values"] = [
        {
            "name": "R_s_ohm",
            "value": 0.13712,
            "std": 0.0002,
            "systematic": 0.0014,
            "unit": "ohm",
            "T_c": 24.5,
            "method": "multi-level DC",
            "source": "pmsmtool",
            "i_d_apk": math.nan,
            "i_q_apk": math.nan,
        }
    ]
    stages[0]["values"] += [{**stages[0]["values"][0], "name": name} for name in NEEDED if name != "R_s_ohm"]
    return {
        "schema": "pmsmtool.run/1",
        "started_utc": "2026-01-01T00:00:00Z",
        "operator": "A. <b>Engineer</b>",
        "command": ["commission"],
        "versions": {"pmsmtool": "0.1.0"},
        "drive": {"name": "pmsmsim", "serial": 17},
        "bus": {"interface": "pmsmsim"},
        "envelope": {"i_max": "28 A pk"},
        "consents": [{"what": "motion", "answer": "yes"}],
        "stages": stages,
    }


def test_conditions_are_read_by_a_person() -> None:
    record = _record()
    record["drive"] |= {"vendor": 0x1F5, "product": 0x504D, "revision": 0x10001, "serial": 22001}
    record["bus"] |= {"bitrate": None, "node": 5}
    record["consents"] = [
        {"subject": "motion", "answer": "--yes", "text": ["at most 6 A", "free shaft"], "limits": {"i_max": "6 A"}}
    ]
    page = render(record)
    assert "0x000001f5" in page and "0x504d" in page and "0x10001" in page and "22001" in page
    assert "bitrate" not in page and "None" not in page
    assert "subject: motion, answer: --yes, text: at most 6 A; free shaft, limits: i_max: 6 A" in page


def test_all_passed_is_pass_and_names_the_value_with_its_interval() -> None:
    page = render(_record(), not_checked=["thermal behaviour under load"])
    assert ">SIMULATED DRIVE, PASS: 7 of 7 stages ran, 7 criteria, all met</strong>" in page
    assert "0.1371" in page and "multi-level DC" in page
    assert "thermal behaviour under load" in page
    order = [page.index(text) for text in ("PASS: 7 of 7", "<h1>", "What was not checked", "Identification: ")]
    assert order == sorted(order), "the verdict comes first"


@pytest.mark.parametrize("missing", COMPLETE)
def test_a_missing_stage_keeps_the_verdict_open(missing: str) -> None:
    record = _record()
    record["stages"] = [stage for stage in record["stages"] if stage["name"] != missing]
    page = render(record)
    assert "PARTIAL: 6 of 7 stages ran" in page and f"not run: {missing}" in page
    assert "PASS:" not in page


def test_a_failed_criterion_is_named_with_number_and_limit() -> None:
    record = _record()
    stage = record["stages"][2]
    stage["status"] = "fail"
    stage["acceptance"][0] = {"what": "phase margin", "measured": "31 deg", "limit": "40 deg", "ok": False}
    page = render(record)
    assert "FAIL: " in page and "phase margin: 31 deg, limit 40 deg" in page


def test_a_stage_that_was_repeated_counts_with_its_last_entry() -> None:
    record = _record()
    failed = copy.deepcopy(record["stages"][0])
    failed["status"] = "fail"
    record["stages"].insert(0, failed)
    assert "PASS: 7 of 7" in render(record)


def test_text_from_outside_is_escaped_and_figures_are_inline() -> None:
    page = render(
        _record(),
        figures=[Figure('<?xml version="1.0"?>\n<svg xmlns="http://www.w3.org/2000/svg"></svg>', "a & b")],
        changes=[Change("motor.R_s_ohm", "0.2", "0.13712", "0.13712", "ohm")],
    )
    assert "<b>Engineer</b>" not in page and "&lt;b&gt;Engineer&lt;/b&gt;" in page
    assert "<svg xmlns" in page and "<?xml" not in page and "a &amp; b" in page
    assert "motor.R_s_ohm" in page
    assert "<script" not in page and " src=" not in page


def test_total_interval_adds_in_quadrature() -> None:
    assert total_interval(1.0, 0.0) == pytest.approx(1.96)
    assert total_interval(1.0, 1.96) == pytest.approx(1.96 * math.sqrt(2.0))


def test_the_figure_that_shows_the_verdict_best_stands_first_and_the_others_with_their_stage() -> None:
    drawn = [
        Figure("<svg>bode</svg>", "loops", stage="tune", weight=2.0),
        Figure("<svg>step</svg>", "proof", stage="prove", weight=4.3),
        Figure("<svg>other</svg>", "of no stage that ran", stage="scan"),
    ]
    page = render(_record(), figures=drawn)
    texts = ("<h1>", ">step<", "What was not checked", "Control design: ", ">bode<", "Proof on")
    order = [page.index(text) for text in texts]
    assert order == sorted(order) and page.count(">step<") == 1 and ">other<" in page


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_text_colour_stands_out_from_the_page(scheme: str) -> None:
    """At least 4.5, the contrast that WCAG 2.1 asks of text (1.4.3); the least is 5.3."""

    def luminance(colour: str) -> float:
        digits = colour * 2 if len(colour) == 3 else colour
        parts = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
        red, green, blue = (x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in parts)
        return 0.2126 * red + 0.7152 * green + 0.0722 * blue

    page = render(_record())
    colours = dict(re.findall(r"--(\w+): #(\w+);", page.split(":root")[1 if scheme == "light" else 2].split("}")[0]))
    for text in ("ink", "muted", "good", "bad", "partial"):
        for ground in ("page", "card"):
            low, high = sorted(luminance(colours[name]) for name in (text, ground))
            assert (high + 0.05) / (low + 0.05) >= 4.5, (text, ground)


def test_tables_keep_their_heads_in_print_and_their_labels_on_a_phone() -> None:
    page = render(_record(), changes=[Change("motor.R_s_ohm", "0.2", "0.1", "0.1", "ohm")])
    assert page.count("<main>") == 1 and page.count("<table>") == page.count("<thead>") >= len(COMPLETE)
    assert "thead { display: table-header-group; }" in page and 'data-label="limit" class="limit">1 %</td>' in page
    assert '<td data-label="held by the drive" class="number"><div><span>0.1</span></div></td>' in page
    for role in ("commissioned by", "checked by", "released by"):
        assert f'<td data-label="role">{role}</td>' in page


@pytest.mark.parametrize(("measured", "meet"), [(1.05, True), (1.19, True), (1.3, False), (0.5, False)])
def test_two_intervals_are_drawn_and_said_to_overlap_or_not(measured: float, meet: bool) -> None:
    row = {"measured": measured, "interval": 0.1, "low": 0.9, "high": 1.1}
    assert ('aria-label="the intervals overlap"' in _intervals(row)) == meet
    assert _intervals({**row, "low": None}) == "" == _intervals({**row, "measured": None})


def test_only_an_integer_without_an_interval_is_called_one() -> None:
    exact = {"name": "x", "std": 0.0, "systematic": 0.0}
    assert [cell[0] for cell in _estimate_row({**exact, "value": 3.0, "unit": "1"})][1:3] == ["3", INTEGER]
    assert [cell[0] for cell in _estimate_row({**exact, "value": 0.35, "unit": "ohm"})][1:3] == [
        "0.35 ohm (exact)",
        "0 ohm",
    ]
