# SPDX-License-Identifier: MIT
"""What a person reads fits the terminal; what a program reads stays one line."""

from __future__ import annotations

import sys

import pytest

from pmsmtool.cli.help_topics import TOPICS
from pmsmtool.cli.output import FILE_WIDTH
from pmsmtool.plain_text import folded, table
from tests.cli.conftest import Tool

WIDTH = 80
COMMANDS = (
    *(("help", topic) for topic in TOPICS),
    ("help",),
    ("scan", "--sim", "interior-2k2"),
    ("caps", "--sim", "interior-2k2?drive=epos4"),
    ("caps", "--sim", "interior-2k2?drive=epos4", "--map", "nanotec"),
    ("tune", "interior-2k2", "-o", "design.toml"),
    ("margins", "interior-2k2"),
    ("doctor", "--sim", "interior-2k2?bitrate=500000", "-b", "250000"),
    ("commission", "interior-2k2", "--rehearse", "epos5"),
)


@pytest.mark.chain
@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_no_line_is_wider_than_the_terminal(
    tool: Tool, command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    narrow = _printed(tool, command, monkeypatch, terminal=True)
    assert [line for line in narrow.splitlines() if len(line) > WIDTH] == []
    # no letter is lost; a broken cell moves its words to other lines
    if command[0] == "doctor":  # a driver's module that is missing is told once in a process
        return
    wide = _printed(tool, command, monkeypatch, terminal=False)
    assert sorted("".join(narrow.split())) == sorted("".join(wide.split()))


def _printed(tool: Tool, command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, *, terminal: bool) -> str:
    for stream in (sys.stdout, sys.stderr):
        monkeypatch.setattr(stream, "isatty", lambda: terminal)
    _, out, err = tool(*command)
    return out + err


def test_outside_a_terminal_a_line_stays_one_line(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    _, out, _ = tool("caps", "--sim", "interior-2k2?drive=epos4")
    assert max(map(len, out.splitlines())) > WIDTH
    assert "needs mode 11 with commutation angle (0x6502 bit 10, 0x60EA)" in out


def test_a_table_in_a_file_has_a_width_that_can_be_read(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before, the table of the axis was as wide as its longest cell: 177 letters; of a check of the wiring 300."""
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    code, out, _ = tool("tune", "interior-2k2", "-o", "axis.toml", "--axis", "--map", "epos4")
    assert code in (0, 10) and "over the tolerance box" in out
    assert 100 < max(map(len, out.splitlines())) <= FILE_WIDTH


def test_tune_shows_every_number_with_its_unit(tool: Tool) -> None:
    _, out, _ = tool("tune", "interior-2k2", "-o", "design.toml")
    facts = out.split("governor, field weakening, loops")[1].splitlines()[1:]
    units = {line.split()[0]: " ".join(line.split()[2:]) for line in facts}
    assert units["current_bandwidth_rad_s"] == "rad/s" and units["maximum_delay_d_periods"] == "control periods"
    assert units["voltage_overshoot_per_rpm_per_s"] == "1/(rpm/s)" and units["psi_f_at_T_magnet_max_wb"] == "Wb"
    assert [name for name, unit in units.items() if not unit] == ["straight_segment"]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("duration  at most 15 s", "duration  at most 15 s"),
        ("stop      voltage off, the shaft coasts", "stop      voltage off,|          the shaft|          coasts"),
        ("  likely: a wrong bit rate or more", "  likely: a wrong bit|          rate or more"),
        ("not written: one pair of gains serves", "not written: one pair of|  gains serves"),
        ("report: runs/20261126T131225Z-000055f1/report.html", "report:|  runs/20261126T131225Z-000055f1/report.html"),
    ],
)
def test_folded(line: str, expected: str) -> None:
    assert "|".join(folded(line, 24)) == expected


def test_a_table_breaks_its_widest_cells_and_no_word() -> None:
    rows = [("supply", 48.0, "the link is lower than stated"), ("phases", 1.25, "ok")]
    assert table(("looked at", "value", "seen"), rows, 30) == [
        "looked at  value  seen",
        "supply      48.0  the link is",
        "                  lower than",
        "                  stated",
        "phases      1.25  ok",
    ]
    assert table(("looked at", "value", "seen"), rows, 5)[2].split() == ["supply", "48.0", "the"]
