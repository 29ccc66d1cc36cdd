# SPDX-License-Identifier: MIT
"""What a notebook or ``print`` shows of a value fits a screen and names what is inside.

Before, a design took 12 331 letters on one line, a margin report 7 174, and a trace of 720 rows 258 791.
"""

from __future__ import annotations

from html.parser import HTMLParser

import numpy as np
import pytest

import pmsmtool
from pmsmtool.cli.margins import _sample
from pmsmtool.design.design_file import Design
from pmsmtool.design.lookup.design import LookupDesign
from pmsmtool.design.loops.margins import MarginReport

WIDTH, LINES = 120, 60


@pytest.fixture(scope="module")
def design() -> Design:
    return pmsmtool.tune("interior-2k2")


class Page(HTMLParser):
    """Cells and lines of a page, in order; every tag that is opened is closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        assert self.open[-1] in ("p", "th", "td")
        self.words += data.split()


def shown(value: pmsmtool.Trace | Design | pmsmtool.MachineFile | MarginReport | LookupDesign) -> str:
    text = repr(value)
    assert text == str(value)
    assert Page(value._repr_html_()).words == text.split(), "a notebook shows what print does"
    assert max(map(len, text.splitlines())) <= WIDTH and len(text.splitlines()) <= LINES
    return " ".join(text.split())


def test_a_design_shows_gains_with_units_and_margins(design: Design) -> None:
    text = shown(design)
    assert text.startswith("design of interior-2k2: 100 values")
    assert f"current.K_p_d_v_per_a {design['current.K_p_d_v_per_a']:.6g} V/A imc" in text
    assert f"current_d: phase margin {design.loops['current_d'].phase_margin_deg:.1f} deg" in text
    assert design.notes[0] in text


def test_a_margin_report_shows_worst_and_verdict(design: Design) -> None:
    report = pmsmtool.margin_report(design, pmsmtool.tolerance_box(design.machine), samples=0)
    worst = next(spread for spread in report.loops if spread.name == "current_d_phase")
    assert f"current_d_phase deg {worst.nominal:.4g} {worst.worst:.4g} 30.0 True" in shown(report)


def test_a_machine_file_shows_values_with_deviations() -> None:
    text = shown(pmsmtool.load_machine_file("interior-2k2"))
    assert text.startswith("machine file interior-2k2") and "R_s_ohm 3.6 0.11 L_d_h 0.036 0.0018" in text
    assert "flux_map" not in text and "U_dc_v 540" in text
    assert "flux_map" in shown(pmsmtool.load_machine_file("saturated-pmsyrm"))


@pytest.mark.parametrize("rows", [0, 1, 720])
def test_a_trace_shows_the_range_of_each_signal(rows: int) -> None:
    t_s = np.arange(rows) * 1e-4
    trace = pmsmtool.Trace(t_s, {"i_d_a": np.full(rows, -2.0), "i_q_a": 3.0 * t_s}, {"i_d_a": "A", "i_q_a": "A"})
    text = shown(trace)
    assert text.startswith(f"trace: {rows} rows") and ("i_d_a A -2 -2" in text) is (rows > 0)


def test_a_table_shows_what_binds_and_what_lies_between(design: Design) -> None:
    made = pmsmtool.lut(design, pmsmtool.LookupRequest(torque_points=9, y_points=9))
    text = shown(made)
    assert text.startswith("9 x 9 x 1 cells, float32; torque to 30.87 N m, speed to 4285.7 rpm limit cells current 6")
    assert f"between nodes: torque within {made.error.torque_nm:.3g} N m" in text
    assert any("brake chopper" in note for note in made.notes), "what a fault does beyond this speed"


def test_letters_of_html_in_a_name_are_shown_as_they_are() -> None:
    trace = pmsmtool.Trace(np.zeros(1), {"<b>": np.zeros(1)}, {"<b>": "A&V"})
    assert "&lt;b&gt;</td><td>A&amp;V" in trace._repr_html_() and "<b> A&V" in shown(trace)


def test_a_signal_without_a_unit_shows_no_number_in_its_place() -> None:
    """Before, ``flags  1  0  0`` was read as a range that begins at 1."""
    trace = pmsmtool.Trace(np.array([0.0, 1.0]), {"flags": np.zeros(2)}, {"flags": "1"}, {})
    assert shown(trace).endswith("flags - 0 0")


def test_a_signal_that_is_not_there_names_the_nearest() -> None:
    trace = pmsmtool.Trace(np.zeros(1), {"i_q_a": np.zeros(1)}, {"i_q_a": "A"})
    with pytest.raises(KeyError, match="no signal 'iq_a'; did you mean i_q_a"):
        trace["iq_a"]


def test_a_number_in_place_of_a_schedule_says_how_to_write_it() -> None:
    with pytest.raises(pmsmtool.PmsmtoolError, match=r"i_q_a is a number; write \[\(0.0, 5\)\]"):
        pmsmtool.Scenario("step", 0.06, "current", {"i_q_a": 5})  # type: ignore[dict-item]


def test_a_machine_of_the_tolerance_box_shows_factors_as_such() -> None:
    """Before, 0.902 of the nominal inductance was printed ``L_d_h 0.902``: that reads as 0.902 H."""
    assert _sample({"L_d_h": 0.902, "U_dc_v": 513.0}) == "L_d_h x 0.902, U_dc_v 513"
