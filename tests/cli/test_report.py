# SPDX-License-Identifier: MIT
"""The report: one page that needs nothing else, made from the run's files alone, the same bytes every time."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from pmsmtool.cli.main import run as program
from pmsmtool.commissioning import report_page
from pmsmtool.commissioning.design_stages import lut_stage, tune_stage
from pmsmtool.commissioning.printed_page import LIMIT_S, QUIET, find_browser, print_page
from pmsmtool.design.design_file import load_design
from pmsmtool.design.lookup.design import LookupRequest
from pmsmtool.design.loops.designed_loops import open_loops
from pmsmtool.design.loops.sampled_loop import margins
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import ConfigError, IdentificationError
from pmsmtool.files import data_folder
from pmsmtool.identification.value_verdict import value_facts
from pmsmtool.machine.parameters import Estimate
from pmsmtool.report.verdict import Verdict, junit_xml
from pmsmtool.run_directory import Acceptance, RunDirectory, Stage, new_record
from pmsmtool.trace import Trace


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with the stages that need no drive, and a download as it is recorded."""
    folder = tmp_path_factory.mktemp("runs")
    record = new_record(
        ["commission"], drive={"name": "bench <2>", "serial": 7}, bus={}, versions={}, operator="A. Engineer"
    )
    run = RunDirectory.create(folder, 7, record)
    shutil.copy(data_folder("profiles") / "interior-2k2.toml", run.path / "machine.toml")
    run.add(tune_stage(run, TuneRequest()))
    run.add(lut_stage(run, LookupRequest()))
    change = {"name": "motor.R_s_ohm", "object": "0x2010:02", "old": 0.2, "asked": 0.137, "held": 0.137, "unit": "ohm"}
    run.add(Stage("flash", "pass", 1.0, values=[change], acceptance=[Acceptance("read back", "84 of 84", "all", True)]))
    return run.path


RECOMPUTED = '<section class="recompute"'


def without_recomputed(page: str) -> str:
    return page[: page.index(RECOMPUTED)] + page[page.index("</section>") :]


def page_of(folder: Path) -> str:
    assert program(["report", str(folder), "-q"]) == 0
    return (folder / "report.html").read_text()


@pytest.mark.chain
def test_the_page_needs_nothing_else_puts_the_verdict_first_and_is_the_same_again(made: Path, tmp_path: Path) -> None:
    page = page_of(made)
    assert program(["report", str(made), "-o", str(tmp_path / "again.html"), "-q"]) == 0
    assert (tmp_path / "again.html").read_bytes() == (made / "report.html").read_bytes()
    assert page.index("PARTIAL: 3 of 7 stages ran") < page.index("<h1")
    assert "not run: identify, margins, verify, prove" in page
    assert page.count(RECOMPUTED) == 1  # its own test: tests/commissioning/test_recomputed_page.py
    page = without_recomputed(page)
    assert not re.search(r"<(script|link|iframe|img)\b|@import|url\((?!#)", page)
    assert not re.search(r'(?:src|href)="(?!#)', page)
    assert page.count("<svg") == 3, "references, Bode, Nyquist"
    assert "bench &lt;2&gt;" in page
    for text in ("motor.R_s_ohm", "84 of 84", "What was not checked", "Behaviour: the drive", "A. Engineer"):
        assert text in page
    ids = re.findall(r' id="([^"]+)"', page)
    assert set(ids) == set(re.findall(r'(?:url\(#|xlink:href="#)([^)"]+)', page)), "every one is referenced"


@pytest.mark.usefixtures("undrawn")
@pytest.mark.chain
def test_json_gives_the_verdict_on_stdout_alone(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert program(["report", str(made), "--json", "-o", str(tmp_path / "r.html")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["schema"] == "pmsmtool.report/1"
    assert found["verdict"] == "PARTIAL" and found["simulated"] is False


@pytest.mark.parametrize("name", ["track", "identify", "prove"])
def test_a_run_of_one_stage_is_complete_with_that_stage(name: str, tmp_path: Path) -> None:
    command = ["pmsmtool", "-i", "pmsmsim", name, "psi"]
    run = RunDirectory.create(tmp_path, 7, new_record(command, drive={}, bus={}, versions={}, operator="A. Engineer"))
    assert report_page.verdict(run.path).lines == (f"{name} did not run",)
    run.add(Stage(name, "pass", 1.0, note="worth a note", acceptance=[Acceptance("width", "1 %", "3 %", True)]))
    assert report_page.verdict(run.path) == Verdict("pass", "PASS", (f"{name} alone, 1 criterion, met",))
    page = page_of(run.path)
    assert "PARTIAL" not in page and "<p>worth a note</p>" in page
    run.add(Stage("tune", "pass", 1.0))
    assert report_page.verdict(run.path).word == "PARTIAL", "somebody went on towards a commissioning"


def test_a_commissioning_of_one_stage_so_far_is_not_complete(tmp_path: Path) -> None:
    command = ["pmsmtool", "commission", "--runs", "identify"]
    run = RunDirectory.create(tmp_path, 7, new_record(command, drive={}, bus={}, versions={}, operator="A. Engineer"))
    run.add(Stage("identify", "pass", 1.0))
    assert report_page.verdict(run.path).word == "PARTIAL"


@pytest.mark.usefixtures("undrawn")
@pytest.mark.chain
def test_a_failed_stage_makes_the_verdict(made: Path, tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    shutil.copytree(made, run.path)
    run.add(Stage("tune", "fail", 0.0, acceptance=[Acceptance("phase margin", "31 deg", ">= 45 deg", False)]))
    page = page_of(run.path)
    assert "<strong>FAIL: tune: phase margin: 31 deg, limit &gt;= 45 deg" in page


def test_the_loops_drawn_are_those_of_the_design(made: Path) -> None:
    design = load_design(made / "design.toml")
    loops = open_loops(design)
    assert set(loops) == {"current_d", "current_q", "speed"}
    for name, loop in loops.items():
        again, stated = margins(loop), design.loops[name]
        assert again.phase_margin_deg == pytest.approx(stated.phase_margin_deg, rel=1e-9), name
        assert again.gain_margin == pytest.approx(stated.gain_margin, rel=1e-9), name


@pytest.mark.usefixtures("undrawn")
@pytest.mark.chain
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda run: (run / "run.json").unlink(), "no run.json here"),
        (lambda run: (run / "run.json").write_text("{"), "cannot be read"),
        (lambda run: (run / "design.toml").write_text("x"), "design.toml"),
        (lambda run: (run / "lut.npz").write_bytes(b"PK"), "lut.npz"),
        (shutil.rmtree, "no such folder"),
    ],
)
def test_a_damaged_run_is_named(
    damage: object, message: str, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(made, folder)
    (folder / "report.html").unlink(missing_ok=True)
    damage(folder)  # type: ignore[operator]
    assert program(["report", str(folder)]) == 2
    assert message in capsys.readouterr().err
    assert not (folder / "report.html").exists()


@pytest.mark.usefixtures("undrawn")
@pytest.mark.chain
def test_a_page_that_cannot_be_written_leaves_the_run_alone(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.read_bytes() for path in made.rglob("*") if path.is_file() and path.name != "report.html"}
    assert program(["report", str(made), "-o", str(made / "nowhere" / "r.html")]) == 2
    assert "cannot be written" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.usefixtures("undrawn")
@pytest.mark.chain
def test_values_with_a_deviation_become_the_table(made: Path, tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    shutil.copytree(made, run.path)
    value = {"name": "R_s_ohm", "value": 0.13712, "std": 2e-4, "systematic": 1.4e-3, "unit": "ohm", "T_c": 20.0}
    run.write(replace(run.read(), stages=(Stage("identify", "pass", 9.0, values=[value]), *run.read().stages)))
    assert "<span>0.1371</span> <span>+- 0.0015 ohm</span>" in page_of(run.path)


@pytest.mark.parametrize(
    ("present", "passed", "kept"),
    [
        (["zero_current"], False, {"zero_current"}),
        (["zero_current", "phase_vectors", "levels", "rotation_forward"], False, {"phase_vectors", "levels"}),
        (
            ["phase_vectors", "levels", "rotation_forward", "rotation_backward", "square_d_6"],
            False,
            {"rotation_forward"},
        ),
        (["phase_vectors", "levels"], True, {"phase_vectors", "levels"}),
        (["levels", "square_d_6", "square_q_6", "push_0", "speeds"], False, {"push_0", "square_q_6"}),
    ],
)
def test_an_experiment_that_was_cut_short_is_not_evaluated(
    present: list[str], passed: bool, kept: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[set[str]] = []

    def evaluate(traces: dict[str, object], period_s: float) -> str:
        seen.append(set(traces))
        return "done"

    monkeypatch.setattr(report_page, "evaluate", evaluate)
    traces = {name: object() for name in present}
    assert report_page._evaluated(traces, 1e-4, complete=passed) == "done"  # type: ignore[arg-type, comparison-overlap]
    assert kept <= seen[0]
    if not passed:
        assert present[-1] not in seen[0] or present[-1] == "zero_current"


def test_what_is_refused_is_left_out_until_something_remains(monkeypatch: pytest.MonkeyPatch) -> None:
    def evaluate(traces: dict[str, object], period_s: float) -> set[str]:
        if "rotation_forward" in traces:
            raise IdentificationError("E_TRACK_LOST", "lost")
        return set(traces)

    monkeypatch.setattr(report_page, "evaluate", evaluate)
    traces = {name: object() for name in ("zero_current", "phase_vectors", "levels", "rotation_forward", "square_d_6")}
    found = report_page._evaluated(traces, 1e-4, complete=True)  # type: ignore[arg-type]
    assert found == {"zero_current", "phase_vectors", "levels"}  # type: ignore[comparison-overlap]


def test_junit_has_a_case_per_criterion_and_is_green_only_for_a_pass(made: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(made, tmp_path / "run")
    refused = {"L_q": "noise\x1b[2J & <more>"}
    failed = [Acceptance("R_s_ohm: interval", "9 %", "3 %", False)]
    RunDirectory(folder).add(Stage("identify", "fail", 2.5, acceptance=failed, refused=refused, note="not accepted"))
    RunDirectory(folder).add(Stage("prove", "not available", 0.0, note="no torque mode"))
    assert program(["report", "--junit", str(folder), "-o", str(tmp_path / "out.xml"), "-q"]) == 0
    suite = ElementTree.parse(tmp_path / "out.xml").getroot()
    cases = {(case.get("classname"), case.get("name")): case for case in suite.iter("testcase")}
    assert cases["pmsmtool.commissioning", "verdict"].find("failure") is not None
    assert cases["pmsmtool.flash", "read back"].find("failure") is None
    assert cases["pmsmtool.identify", "R_s_ohm: interval"].find("failure").text == "9 %, limit 3 %"  # type: ignore[union-attr]
    assert cases["pmsmtool.identify", "ran"].get("time") == "2.500"
    assert "\\x1b[2J & <more>" in str(cases["pmsmtool.identify", "L_q given"].find("skipped").text)  # type: ignore[union-attr]
    assert cases["pmsmtool.prove", "ran"].find("skipped") is not None
    assert {key: suite.get(key) for key in ("failures", "skipped")} == {"failures": "3", "skipped": "2"}
    assert suite.get("tests") == str(len(cases))
    record = {"started_utc": "", "stages": ()}
    for kind, inside in (("pass", "system-out"), ("partial", "skipped")):
        found = ElementTree.fromstring(junit_xml(record, Verdict(kind, "", ("x",))).encode())  # type: ignore[arg-type]
        assert found.find(f"testcase/{inside}") is not None and found.get("failures") == "0"
    assert program(["report", "--junit", "--anonymous", str(folder), "-q"]) == 2


def test_the_margin_map_has_the_margin_of_the_design_where_nothing_differs(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    design = load_design(made / "design.toml")
    drawn: list[Any] = []
    monkeypatch.setattr(report_page.figures, "margin_map_figure", lambda *given: drawn.append(given))
    list(report_page._margin_map(design))
    factor, delay, phase, designed, _ = drawn[0]
    at = [float(np.interp(1.0, factor, row)) for row in phase]
    nominal = design.loops["current_q"].phase_margin_deg
    assert float(np.interp(designed[1], delay, at)) == pytest.approx(nominal, abs=0.5), "by interpolation: 0.1 seen"
    assert phase[-1, 0] < phase[0, -1], "a smaller inductance and a longer delay cost margin"


def test_the_least_time_to_a_current_at_standstill_is_that_of_a_winding(made: Path) -> None:
    """t = L/R ln(V / (V - R i)) for constant voltage."""
    design = load_design(made / "design.toml")
    machine, i_q = design.machine.machine, np.linspace(0.0, 6.0, 40)
    trace = Trace(np.arange(40) * 1e-4, {"omega_e_rad_s": np.zeros(40)}, {"omega_e_rad_s": "rad/s"})
    prediction: Any = SimpleNamespace(facts={"conditions": {"U_dc_v": 540.0}})
    found = report_page._least_times(prediction, trace, {"i_d_a": 0.0 * i_q, "i_q_a": i_q}, design)
    assert found is not None
    V, R = 540.0 * design["inverter.voltage_utilisation"], machine.R_s_ohm
    expected = machine.L_q_h / R * np.log(V / (V - R * found[1]["i_q_a"]))
    assert found[0] == pytest.approx(expected, rel=2e-3), "within 2e-4 seen"


@pytest.mark.parametrize("browser", ["missing", "silent"])
def test_a_browser_that_makes_no_pdf_is_named(browser: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    silent = tmp_path / "silent"
    silent.write_text("#!/bin/sh\n")
    silent.chmod(0o755)
    monkeypatch.setenv("PMSMTOOL_BROWSER", str(silent) if browser == "silent" else "no-such-browser")
    with pytest.raises(ConfigError) as caught:
        print_page(tmp_path / "report.html", tmp_path / "report.pdf")
    assert caught.value.hint.endswith("print it: it is laid out for A4 and Letter")
    assert not (tmp_path / "report.pdf").exists()


@pytest.mark.chain
@pytest.mark.skipif(find_browser() is None, reason="no browser on this computer")
def test_the_page_as_pdf(made: Path) -> None:
    assert program(["report", str(made), "--pdf", "-q"]) == 0
    assert (made / "report.pdf").read_bytes().startswith(b"%PDF-")
    (made / "report.pdf").unlink()


@pytest.mark.chain
def test_it_says_on_a_terminal_that_it_works(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A report of a whole commissioning takes 5 s; before, nothing was on the screen meanwhile."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert program(["report", str(made), "-o", str(tmp_path / "report.html")]) == 0
    assert capsys.readouterr().err.startswith("\rwriting the report ...\r")


def in_a_frame(folder: Path, page: str, width_mm: float, script: str) -> str:
    """Return what a script finds in a page that is so wide; ``page`` is its document there."""
    (folder / "report.html").write_text(page, encoding="utf-8")
    (folder / "frame.html").write_text(
        f'<iframe id="frame" src="report.html" style="width:{width_mm}mm;height:800px;border:0"></iframe>'
        '<pre id="out"></pre><script>document.getElementById("frame").onload = event => {'
        "const page = event.target.contentDocument;"
        f'document.getElementById("out").textContent = {script}}};</script>',
        encoding="utf-8",
    )
    command = [
        str(find_browser()), *QUIET, "--no-sandbox", f"--user-data-dir={folder}/profile", "--window-size=900,900",
        "--hide-scrollbars", "--allow-file-access-from-files", "--virtual-time-budget=20000", "--dump-dom",
    ]  # fmt: skip
    address = (folder / "frame.html").as_uri()
    seen = subprocess.run([*command, address], capture_output=True, text=True, timeout=LIMIT_S, check=True).stdout
    found = re.search(r'<pre id="out">(.*?)</pre>', seen)
    assert found is not None, seen[-500:]
    return found[1]


def page_with_values(run: RunDirectory) -> str:
    """A page with the widest values and rows seen: a small friction, a comparison with a data sheet."""
    values = [
        {**value_facts(name, estimate), "accepted": True}
        for name, estimate in {
            "R_s_ohm_measured": Estimate(3.6, 0.004, 0.06, "ohm", T_c=25.0, method="multi-level DC, asymptotic slope"),
            "J_per_psi": Estimate(2.62e-3, 9.2e-6, 3.7e-5, "kg m2/Wb", method="regression over torque pulses"),
            "B_nms": Estimate(2e-3, 3e-6, 2.8e-5, "N m s", method="torque pulses, output error, whitened"),
        }.items()
    ]
    row = {
        "name": "J_per_psi", "unit": "kg m2/Wb", "interval": 4.2e-5, "stated": 0.002607, "held": None,
        "factory": False, "measured": 0.002623, "low": 0.0021, "high": 0.0031, "verdict": "agrees",
        "tolerance": "11 % by its [std] and 11 % by its [std], magnets 5 to 90 degC",
    }  # fmt: skip
    held = {"name": "R_s_ohm", "unit": "ohm", "measured": 3.601, "interval": 0.063, "held": 0.137, "factory": True}
    run.add(Stage("identify", "pass", 1.0, values=values, comparison=[row, {**row, **held}]))
    return report_page.report_page(run.path)


@pytest.mark.chain
@pytest.mark.skipif(find_browser() is None, reason="no browser on this computer")
@pytest.mark.parametrize("paper_mm", [210.0, 215.9], ids=["A4", "Letter"])
def test_on_paper_no_column_is_cut_off_and_no_number_is_broken(made: Path, tmp_path: Path, paper_mm: float) -> None:
    """Before, ``2.000 +- 0.029 mN m s`` was printed as ``mN`` over ``m s``, ``9.2e-06`` as ``9.2e-`` over ``06``."""
    page = page_with_values(RunDirectory(shutil.copytree(made, tmp_path / "run")))
    margin_mm = float(re.search(r"@page { margin: \d+mm (\d+)mm", page)[1])  # type: ignore[index]
    page = page.replace("@media screen", "@media speech").replace("@media print", "@media screen")
    found = in_a_frame(
        tmp_path, page, paper_mm - 2.0 * margin_mm,
        "[page.body.scrollWidth > page.body.clientWidth ? 'page' : '',"
        "...[...page.querySelectorAll('td, th')].filter(e => e.scrollWidth > e.clientWidth),"
        "...[...page.querySelectorAll('td.number span')].filter(e => e.getClientRects().length > 1),"
        "...[...page.querySelectorAll('thead')].filter(e => getComputedStyle(e).display != 'table-header-group')]"
        ".map(e => e.textContent || e).join('|') + ' of ' + page.querySelectorAll('td.number span').length",
    )  # fmt: skip
    assert re.fullmatch(r" of (2\d|3\d)", found), found


@pytest.mark.chain
@pytest.mark.skipif(find_browser() is None, reason="no browser on this computer")
def test_on_a_phone_no_part_is_wider_than_the_screen(made: Path, tmp_path: Path) -> None:
    """In a frame of 390 px; before, the hidden heads of the tables made the page 478 to 564 px wide."""
    page = page_with_values(RunDirectory(shutil.copytree(made, tmp_path / "run")))
    root = "page.documentElement"
    found = in_a_frame(tmp_path, page, 390.0 * 25.4 / 96.0, f"`${{{root}.scrollWidth}} ${{{root}.clientWidth}}`")
    wide, seen = map(int, found.split())
    assert wide <= seen <= 390


AXE = Path(os.environ.get("PMSMTOOL_AXE", "axe.min.js"))
"""The script of the package axe-core (Deque Systems), where somebody has it."""


@pytest.mark.chain
@pytest.mark.skipif(find_browser() is None, reason="no browser on this computer")
@pytest.mark.skipif(not AXE.is_file(), reason="no axe-core: PMSMTOOL_AXE names its axe.min.js")
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_core_finds_nothing_serious(made: Path, tmp_path: Path, scheme: str) -> None:
    page = page_with_values(RunDirectory(shutil.copytree(made, tmp_path / "run")))
    page = page.replace("screen and (prefers-color-scheme: dark)", "screen" if scheme == "dark" else "speech")
    (tmp_path / "axe.js").write_bytes(AXE.read_bytes())
    found = in_a_frame(
        tmp_path, page.replace("</head>", '<script src="axe.js"></script></head>'), 210.0,
        "'waiting'; event.target.contentWindow.axe.run(page).then(seen => {"
        "document.getElementById('out').textContent = `${seen.passes.length} `"
        "+ seen.violations.map(each => `${each.impact} ${each.id}`).join('|') })",
    )  # fmt: skip
    passed, _, wrong = found.partition(" ")
    assert int(passed) > 15 and not re.search("serious|critical", wrong), found


@pytest.mark.parametrize(
    ("measured", "rejected", "files", "unchecked"),
    [
        (
            (),
            (),
            (),
            "bias points that are named, cogging, harmonics of the back-EMF, iron losses, slot harmonics of L.",
        ),
        (("cogging_nm",), (), (), "named, harmonics of the back-EMF, iron losses, slot harmonics of L."),
        (("cogging_nm", "psi_5_wb", "iron_loss_ohm"), (), (), "named, slot harmonics of L."),
        (("cogging_nm", "psi_5_wb"), (), ("flux_map.npz",), "flux map, iron losses, slot harmonics of L."),
        (("cogging_nm", "psi_5_wb"), ("cogging_nm",), (), "named, cogging, iron losses, slot harmonics of L."),
    ],
)
def test_the_page_says_unchecked_of_no_effect_that_was_measured(
    measured: tuple[str, ...], rejected: tuple[str, ...], files: tuple[str, ...], unchecked: str, tmp_path: Path
) -> None:
    """It said so of cogging in every report, also in that of `identify cogging`."""
    record = new_record(["identify"], drive={}, bus={}, versions={}, operator="nobody")
    run = RunDirectory.create(tmp_path, 7, record)
    values = [
        {**value_facts(name, Estimate(0.1, 0.01, 0.0, "1")), "accepted": name not in rejected} for name in measured
    ]
    for name in files:
        (run.path / name).write_bytes(b"")
    run.add(Stage("identify", "pass", 1.0, values=values, files=dict.fromkeys(files, "")))
    page = report_page.report_page(run.path)
    assert f"{unchecked}</li>" in page and page.count("slot harmonics") == 1
