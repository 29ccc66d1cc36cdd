# SPDX-License-Identifier: MIT
"""What commands print: JSON forms, tables, streams."""

from __future__ import annotations

import enum
import json
import math
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from pmsmtool.cli.main import report
from pmsmtool.cli.output import Output, jsonable, table
from pmsmtool.errors import BusError
from pmsmtool.plain_text import reason


class Mode(enum.IntEnum):
    """A mode with a number, printed by name."""

    LINE_SEARCH = 2


class Bits(enum.IntFlag):
    """Bits, printed as their number."""

    A = 1
    B = 2


@dataclass(frozen=True)
class Triple:
    """A number with its doubt."""

    value: float
    std: float
    systematic: float


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (Triple(0.1, math.nan, math.inf), {"value": 0.1, "std": None, "systematic": None}),
        (np.array([[1.0, math.nan]]), [[1.0, None]]),
        (np.array(3), 3),
        (np.float32(0.5), 0.5),
        (np.int64(5), 5),
        (np.bool_(True), True),
        (Mode.LINE_SEARCH, "line-search"),
        (Bits.A | Bits.B, 3),
        ({1: (True, None)}, {"1": [True, None]}),
        ({"b", "a"}, ["a", "b"]),
        (Path("a") / "b", str(Path("a/b"))),
    ],
)
def test_jsonable(value: object, expected: object) -> None:
    found = jsonable(value)
    assert found == expected
    assert json.loads(json.dumps(found, allow_nan=False)) == expected


@pytest.mark.parametrize("value", [b"x", object(), Triple])
def test_jsonable_refuses(value: object) -> None:
    with pytest.raises(TypeError):
        jsonable(value)


def test_result_is_text_or_one_json_object(capsys: pytest.CaptureFixture[str]) -> None:
    Output().result("scan", {"nodes": [5]}, ["node 5"])
    assert capsys.readouterr().out == "node 5\n"
    Output(json=True).result("scan", {"nodes": [5]}, lambda: pytest.fail("text is not made for JSON"))
    assert json.loads(capsys.readouterr().out) == {"schema": "pmsmtool.scan/1", "nodes": [5]}


@pytest.mark.parametrize(
    ("verbosity", "expected"), [(-1, "warning: w\n"), (0, "n\nwarning: w\n"), (1, "n\nd\nwarning: w\n")]
)
def test_notes_go_to_stderr(verbosity: int, expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = Output(verbosity=verbosity)
    out.note("n")
    out.detail("d")
    out.status("not on a terminal")
    out.warn("w")
    assert capsys.readouterr() == ("", expected)


def test_table_aligns() -> None:
    assert table(("name", "ohm"), [("R_s", 0.1), ("R_winding", "12.25")]) == [
        "name         ohm",
        "R_s          0.1",
        "R_winding  12.25",
    ]
    assert table(("a", "b"), []) == ["a  b"]


NASTY = "a\x1b[2J\x07\x9b31m\x7f\u202eb"
SHOWN = "a\\x1b[2J\\x07\\x9b31m\\x7f\\u202eb"


def test_nothing_that_steers_a_terminal_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    """Whatever the way to the terminal; lines stay lines, but not inside a cell of a table."""
    out = Output(verbosity=1)
    with mock.patch("click.utils.should_strip_ansi", return_value=False):
        out.result("x", {}, [NASTY, *table(("n", "m"), [(NASTY + "\n", 1)])])
        for say in (out.note, out.detail, out.warn):
            say(NASTY + "\nnext")
        report(BusError(NASTY, where=NASTY, likely=NASTY, hint=NASTY))
    printed = capsys.readouterr()
    text = printed.out + printed.err.replace("\x1b[31m", "").replace("\x1b[33m", "").replace("\x1b[1m", "")
    assert text.replace("\x1b[0m", "").count(SHOWN) == 2 + 3 + 4
    assert all(c.isprintable() or c == "\n" for c in text.replace("\x1b[0m", ""))
    assert SHOWN + "\\n" in printed.out


def test_a_back_ends_traceback_is_no_message() -> None:
    error = ValueError("Failed to receive: bad\x1b  Traceback (most recent call last):\n  File 'x.py'\n")
    assert reason(error) == "Failed to receive: bad\\x1b"
    assert len(reason(ValueError("x" * 10_000))) < 320
