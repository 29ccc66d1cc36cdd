# SPDX-License-Identifier: MIT
"""Whoever consents to an alignment, to new encoder parameters or to a reset reads, once, that homing is lost."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from pmsmtool.cia402 import HOMING_LOST
from pmsmtool.cli.main import cli
from pmsmtool.params.parameter_set import ParameterSet

MACHINE = str(Path(__file__).resolve().parents[2] / "profiles" / "interior-2k2.toml")


def shown(channel: str, *command: str) -> list[str]:
    """Return the lines that say it; nobody is there to consent, so nothing is done."""
    outcome = CliRunner().invoke(cli, ["-i", "pmsmsim", "-c", f"interior-2k2?nv=:memory:{channel}", *command], input="")
    return [line for line in outcome.stderr.splitlines() if HOMING_LOST in line]


@pytest.mark.parametrize(
    ("drive", "command"),
    [("", ("identify",)), ("&drive=ingenia", ("commission", MACHINE)), ("&drive=cia402", ("commission", MACHINE))],
    ids=["full", "recorder", "standard"],
)
def test_before_the_rotor_is_moved(drive: str, command: tuple[str, ...]) -> None:
    assert len(shown(drive, *command)) == 1


@pytest.mark.parametrize(
    ("options", "times"), [(("--nodes", "1-2"), ["node 1", "node 2"]), (("-n", "1"), ["the set"])], ids=["fleet", "one"]
)
def test_before_a_set_is_stored_and_the_drive_reset(tmp_path: Path, options: tuple[str, ...], times: list[str]) -> None:
    wanted = tmp_path / "params.toml"
    wanted.write_text(ParameterSet({"motor.I_max_apk": 11.0}).to_toml(), encoding="utf-8")
    lines = shown("&nodes=2", "flash-params", str(wanted), *options)
    assert [line[: len(start)] for line, start in zip(lines, times, strict=True)] == times


def test_before_encoder_parameters_change_and_only_then() -> None:
    assert len(shown("", "param", "set", "encoder.offset_rad=0.5")) == 1
    assert not shown("", "param", "set", "motor.I_max_apk=11")


def test_with_a_reset() -> None:
    assert len(shown("", "nmt", "reset-node")) == 1
    assert not shown("", "nmt", "start")
