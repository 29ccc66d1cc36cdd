# SPDX-License-Identifier: MIT
"""``pmsmtool reproduce`` as a command."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from pmsmtool.cli.main import run
from pmsmtool.papers import registry
from pmsmtool.papers.figure import Reproduction, at_most


@dataclass(frozen=True)
class Done:
    exit_code: int
    stdout: str
    stderr: str


@pytest.fixture
def pmsmtool(capsys: pytest.CaptureFixture[str]) -> Callable[..., Done]:
    def call(*arguments: str) -> Done:
        capsys.readouterr()
        code = run(["reproduce", *arguments])
        said = capsys.readouterr()
        return Done(code, said.out, said.err)

    return call


Command = Callable[..., Done]


def test_list_names_every_figure(pmsmtool: Command) -> None:
    listed = pmsmtool("--list")
    assert listed.exit_code == 0
    assert all(row.name in listed.stdout for row in registry.FIGURES)
    data = json.loads(pmsmtool("--list", "--json").stdout)
    assert data["schema"] == "pmsmtool.reproduce/1"
    assert [one["name"] for one in data["figures"]] == [row.name for row in registry.FIGURES]


@pytest.mark.chain
def test_tables_go_to_stdout_and_files_hold_the_same_bytes_twice(pmsmtool: Command, tmp_path: Path) -> None:
    done = pmsmtool("miyajima-fig7", "-o", str(tmp_path / "one"))
    assert done.exit_code == 0, done.stderr
    assert "checked numbers: printed in the paper, or expected" in done.stdout
    assert "worst step; ideal inverter" in done.stdout
    assert "wrote" in done.stderr
    assert "wrote" not in done.stdout
    written = {path.suffix: path for path in sorted((tmp_path / "one").iterdir())}
    assert [path.name for path in written.values()] == [f"miyajima-fig7.{end}" for end in ("csv", "json", "svg", "txt")]
    stored = json.loads(written[".json"].read_text(encoding="utf-8"))
    assert stored["schema"] == "pmsmtool.reproduce/1"
    assert stored["ok"] is True
    assert len(stored["panels"][0]["series"][0]["x"]) == 850

    asked = {end: tmp_path / f"two{end}" for end in (".csv", ".svg")}
    done = pmsmtool("miyajima-fig7", "--json", "-o", str(asked[".csv"]), "--plot", str(asked[".svg"]))
    data = json.loads(done.stdout)
    assert data["name"] == "miyajima-fig7"
    assert all(check["within"] for check in data["checks"])
    assert data["tables"][0]["units"][:4] == ["", "%", "ms", "A"]
    assert all(path.read_bytes() == written[end].read_bytes() for end, path in asked.items())
    assert asked[".csv"].read_text(encoding="utf-8").startswith("panel,series,x,y")
    assert asked[".svg"].read_text(encoding="utf-8").startswith("<?xml")
    assert len(list(tmp_path.iterdir())) == 3


def outside(seed: int) -> Reproduction:
    return Reproduction("s", checks=(at_most("the number", 2.0 + seed, 1.0, "A"),))


def test_a_number_out_of_range_is_exit_code_1_after_the_table(
    pmsmtool: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = registry.Row("bad", "none:none", "t", "s", 1.0)
    monkeypatch.setattr(registry, "FIGURES", (row,))
    monkeypatch.setattr(registry, "reproduce", lambda row, seed: outside(seed))
    for name in ("bad", "all"):
        done = pmsmtool(name, "--seed", "3")
        assert done.exit_code == 1
        assert "the number" in done.stdout
        assert "5" in done.stdout
        assert "NO" in done.stdout
        assert "bad: the number" in done.stderr
    assert json.loads(pmsmtool("all", "--json").stdout)["figures"][0]["ok"] is False


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((), "missing argument FIGURE"),
        (("jercic-fig1",), "did you mean"),
        (("all", "--plot", "x.svg"), "folder"),
        (("all", "-o", "x.json"), "folder"),
        (("jercic-fig12", "-o", "x.xls"), "no format"),
        (("jercic-fig12", "--plot", "x.gif"), "no figure format"),
        (("jercic-fig12", "--seed", "-1"), "outside"),
    ],
)
def test_wrong_use_is_refused_before_anything_runs(
    pmsmtool: Command, arguments: tuple[str, ...], complaint: str
) -> None:
    done = pmsmtool(*arguments)
    assert done.exit_code == 2
    assert complaint in done.stderr


def test_a_table_without_plot_says_so(pmsmtool: Command, tmp_path: Path) -> None:
    done = pmsmtool("jercic-table2", "--plot", str(tmp_path / "t.svg"))
    assert done.exit_code == 2
    assert "nothing to plot" in done.stderr
