# SPDX-License-Identifier: MIT
"""The step that a report's page computes again: the kernel's own bytes, margins of the design, what it cannot do."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from benchmarks.recomputed_page import differing, random_design, random_moves
from pmsmtool import native
from pmsmtool.commissioning import recomputed_page
from pmsmtool.commissioning.printed_page import QUIET, find_browser
from pmsmtool.commissioning.recomputed_page import loop_margins, recomputed
from pmsmtool.design.design_file import Design
from pmsmtool.design.loops.margins import margin_problem
from pmsmtool.design.tune import tune
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.report.report import template

PHASE_DEG = 0.5
"""Error of a phase margin below 90 deg between the nodes of the map; measured 0.25 on 1120 points of 14 drives."""
PAGE_BYTES = 500_000
"""What the step adds to a page at most, of the 3 MB that a report may have; measured 300 kB."""

needs_module = pytest.mark.skipif(native.page_module() is None, reason="the build had no ziglang for the page's module")
needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="no node to run the page's script in")


def profile(name: str) -> Design:
    return tune(load_machine_file(data_folder("profiles") / f"{name}.toml"))


@pytest.fixture(scope="module")
def design() -> Design:
    return profile("interior-2k2")


def page_of(design: Design) -> str:
    drawn = template("recompute.html.j2").render(recomputed=recomputed(design))
    return f'<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>x</title><body>{drawn}</body></html>'


@pytest.mark.chain
@needs_module
@needs_node
def test_the_page_computes_the_bytes_of_the_kernel() -> None:
    """A thousand designs: ``python -m benchmarks.recomputed_page``."""
    assert differing([0, 2, 3]) == (3, 0)


@pytest.mark.chain
@needs_module
@needs_node
def test_margins_between_the_nodes_are_those_of_the_design() -> None:
    for seed in (2, 5):
        design = random_design(seed)
        assert design is not None
        page, problem, rng = recomputed(design), margin_problem(design), np.random.default_rng(seed)
        points = [random_moves(page, rng) for _ in range(40)]
        script = (
            f"const document = {{getElementById: () => ({{textContent: {json.dumps(str(page['data']))}}})}};"
            f"{template('recompute.js.j2').render()}"
            "console.log(JSON.stringify("
            f"{json.dumps(points)}.map(p => ['q', 'd'].map(a => margin(told.margins.tables['phase_' + a].table, p)))))"
        )
        done = subprocess.run(["node", "-"], input=script, capture_output=True, text=True, check=True)
        for point, seen in zip(points, json.loads(done.stdout), strict=True):
            for axis, phase in zip("qd", seen, strict=True):
                exact = loop_margins(problem, axis, [point["L"]], point["delay"], [point["R"]]).phase_deg[0]
                if exact < 90.0:
                    assert phase == pytest.approx(exact, abs=PHASE_DEG)


@needs_module
def test_the_page_needs_nothing_else(design: Design) -> None:
    page = page_of(design)
    assert len(page) < PAGE_BYTES
    script = page[page.rindex("<script>") :]
    assert not re.search(r"innerHTML|outerHTML|document\.write|eval|fetch|XMLHttp|import\(|url\(", script)
    assert set(re.findall(r"https?://[^\"']+", page)) == {"http://www.w3.org/2000/svg"}
    assert page.count("</script>") == 2


@pytest.mark.chain
@needs_module
@pytest.mark.skipif(find_browser() is None, reason="no browser on this computer")
def test_a_browser_shows_the_step_and_follows_a_slider(design: Design, tmp_path: Path) -> None:
    act = (
        "<script>loaded.then(() => setTimeout(() => { const L = document.getElementById('recompute-L'); L.value = 0.5;"
        "L.dispatchEvent(new Event('input')); }));</script>"
    )
    (tmp_path / "page.html").write_text(page_of(design).replace("</body>", f"{act}</body>"))
    command = [find_browser(), *QUIET, "--no-sandbox", f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom",
               "--enable-logging=stderr", "--virtual-time-budget=4000", (tmp_path / "page.html").as_uri()]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    text = dict(re.findall(r'id="recompute-([\w-]+)"[^>]*>([^<]*)<', done.stdout))
    assert "CONSOLE" not in done.stderr
    assert text["L-value"] == "50.0 %" and text["R-value"] == "3.60 ohm" and text["trips"] == "none"
    exact = loop_margins(margin_problem(design), "q", [0.5], 0.0).phase_deg[0]
    assert float(text["phase_q"].removesuffix(" deg")) == pytest.approx(exact, abs=PHASE_DEG)
    assert done.stdout.count('stroke="#1f5fa8"') == 2 and 'id="recompute-panel" hidden' not in done.stdout


@pytest.mark.chain
def test_what_a_page_cannot_compute_is_said(design: Design, monkeypatch: pytest.MonkeyPatch) -> None:
    if native.page_module() is not None:
        assert "saturates" in recomputed(profile("saturated-pmsyrm"))["missing"]
    monkeypatch.setattr(recomputed_page, "page_module", lambda: None)
    found = recomputed(design)
    assert "no WebAssembly module" in found["missing"] and set(found) == {"missing"}
    assert "<script" not in page_of(design)
