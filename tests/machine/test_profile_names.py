# SPDX-License-Identifier: MIT
"""How a machine is named: a file, a run directory, a profile."""

from __future__ import annotations

from pathlib import Path

import pytest

from pmsmtool.cli import main
from pmsmtool.errors import ConfigError
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import machine_path, profile_names


def test_a_profile_is_found_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(profile_names()) >= 6
    for name in profile_names():
        assert machine_path(name) == data_folder("profiles") / f"{name}.toml"


def test_files_and_run_directories_come_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "interior-2k2"
    run.mkdir()
    assert machine_path("interior-2k2") == data_folder("profiles") / "interior-2k2.toml"  # nothing in the folder
    (run / "machine.toml").write_text("")
    assert machine_path("interior-2k2") == Path("interior-2k2/machine.toml")
    assert machine_path("missing.toml") == Path("missing.toml")  # the reader says what is wrong
    (tmp_path / "plain").write_text("")
    assert machine_path("plain") == Path("plain")


def test_what_is_neither_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    with pytest.raises(ConfigError, match=r"no machine\.toml in this folder"):
        machine_path("runs")
    with pytest.raises(ConfigError, match="did you mean interior-2k2"):
        machine_path("interior-2k3")


@pytest.mark.parametrize(
    "command",
    [
        "tune {} -o design.toml",
        "lut {} -o lut.npz --torque-points 5 --speed-points 4 --torque-bound 1 --voltage-bound 1",
        "simulate {} --scenario q-step -o trace.npz",
    ],
)
def test_commands_take_a_profile_by_name(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main.run(command.format("jercic-2017").split()) == 0
    assert any(tmp_path.iterdir())
    capsys.readouterr()
    assert main.run(command.format("jercic-2018").split()) == 2
    assert "did you mean jercic-2017?" in capsys.readouterr().err
