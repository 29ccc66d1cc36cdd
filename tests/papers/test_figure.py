# SPDX-License-Identifier: MIT
"""The contract of a reproduced figure: what counts as within, what is shown, what the registry promises."""

from __future__ import annotations

import importlib
import math

import numpy as np
import pytest

from pmsmtool.errors import ConfigError
from pmsmtool.papers.figure import (
    Check,
    Column,
    Panel,
    Reproduction,
    Series,
    Table,
    as_printed,
    at_least,
    at_most,
    check_table,
    csv_text,
    figure_of,
    near,
    tables_of,
)
from pmsmtool.papers.registry import FIGURES, find


def test_a_check_is_within_its_range_and_never_without_a_number() -> None:
    assert near("x", 2.0, 2.1, "A", absolute=0.1, where="fig. 1").within
    assert not near("x", 2.0, 2.11, "A", absolute=0.1, where="fig. 1").within
    assert near("x", -30.0, -31.0, "%", relative=0.05, where="fig. 1").within
    assert at_most("x", 1.0, 1.0, "A").within
    assert not at_most("x", 1.0 + 1e-9, 1.0, "A").within
    assert at_least("x", 0.0, 0.0, "A").within
    assert not at_least("x", math.inf, 0.0, "A").within
    assert not at_most("x", math.nan, 1.0, "A").within


def test_the_range_is_shown() -> None:
    checks = (
        at_most("a", 3.0, 1.0, "A"),
        at_least("b", 1.0, 0.5, "A"),
        near("c", 1.0, 1.0, "A", absolute=0.25, where="fig. 1"),
    )
    shown = [row[5] for row in check_table(checks).shown()]
    assert shown == ["<= 1", ">= 0.5", "0.75 .. 1.25"]
    assert [row[6] for row in check_table(checks).shown()] == ["NO", "yes", "yes"]


def test_only_what_the_paper_prints_stands_under_printed() -> None:
    checks = (
        as_printed("R_s", 0.137, 0.137, "ohm", where="table 1"),
        near("t", 0.92, 1.0, "ms", where="read off fig. 10"),
    )
    table = check_table(checks)
    assert [column.name for column in table.columns[1:3]] == ["printed", "expected"]
    assert [row[1:3] for row in table.rows] == [(0.137, None), (None, 0.92)]
    assert [row[-1] for row in table.rows] == ["table 1", "read off fig. 10"]
    assert checks[0].within and not as_printed("R_s", 0.137, 0.1371, "ohm", where="table 1").within


def test_an_expected_number_without_a_source_is_refused() -> None:
    with pytest.raises(ValueError, match="needs its source"):
        near("t", 0.92, 0.92, "ms")


def test_a_row_must_fill_its_columns() -> None:
    with pytest.raises(ValueError, match="columns"):
        Table("t", (Column("a"), Column("b")), ((1.0,),))


def test_cells_have_the_digits_of_their_column() -> None:
    table = Table("t", (Column("a", "A", 3), Column("b")), ((1.23456, "x"), (math.nan, None), (7, 2.0)))
    assert table.shown() == [("1.23", "x"), ("-", "-"), ("7", "2")]
    assert table.columns[0].head == "a / A"


def example(panels: int = 1) -> Reproduction:
    x = np.array([0.0, 1.0, 2.0])
    panel = Panel("p", "time / s", "i / A", (Series("one", x, x**2), Series("two", x, np.array([1.0, math.nan, 2.0]))))
    return Reproduction("s", (), (panel,) * panels, (Check("w", 1.0, 5.0, "A", 0.0, 2.0, "read off fig. 1"),))


def test_the_checked_numbers_are_the_last_table() -> None:
    assert not example().good
    assert tables_of(example())[-1].title.startswith("checked numbers")
    assert tables_of(Reproduction("s")) == ()


def test_csv_has_a_line_per_point_and_nothing_for_a_missing_one() -> None:
    lines = csv_text(example()).splitlines()
    assert lines[0] == "panel,series,x,y,x_axis,y_axis"
    assert lines[1] == "p,one,0.0,0.0,time / s,i / A"
    assert lines[5] == "p,two,1.0,,time / s,i / A"
    assert len(lines) == 7


@pytest.mark.chain
def test_every_panel_is_drawn() -> None:
    figure = figure_of(example(3), "t")
    assert len(figure.axes) == 3
    assert [line.get_label() for line in figure.axes[0].get_lines()] == ["one", "two"]
    assert figure.axes[0].get_xlabel() == "time / s"
    with pytest.raises(ConfigError, match="nothing to plot"):
        figure_of(Reproduction("s"), "t")


@pytest.mark.parametrize("row", FIGURES, ids=lambda row: row.name)
def test_every_row_names_a_function(row: object) -> None:
    module, _, name = row.target.partition(":")  # type: ignore[attr-defined]
    assert callable(getattr(importlib.import_module(f"pmsmtool.papers.{module}"), name))


def test_names_are_unique_and_a_wrong_one_is_answered() -> None:
    assert len({row.name for row in FIGURES}) == len(FIGURES)
    assert find("jercic-fig10").name == "jercic-fig10"
    with pytest.raises(ConfigError, match="did you mean jercic-fig1"):
        find("jercic-fig1")
