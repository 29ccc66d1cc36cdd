# SPDX-License-Identifier: MIT
"""A misspelt name is answered with the name that was probably meant; what is missing is named at once; help fits."""

from __future__ import annotations

from collections.abc import Iterator

import click
import pytest

from pmsmtool.cli.main import cli, run
from pmsmtool.errors import ExitCode

TERMINAL = 80
"""Columns of a terminal that nobody has widened."""


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("commissoin", "commission"),
        ("param gte motor.R_s_ohm", "get"),
        ("help untis", "units"),
        ("help exit-code", "exit-codes"),
        ("help param dif", "diff"),
        ("caps --sim interor-2k2", "interior-2k2"),
        ("caps --map epos5 -i pmsmsim", "epos4"),
        ("commission interior-2k2 --rehearse nanotek --yes", "nanotec"),
        ("commission interior-2k2 --rehearse EPOS4 --yes", "epos4"),
        ("tune INTERIOR-2K2 -o d.toml", "interior-2k2"),
        ("scan -i soketcan -c can0", "socketcan"),
        ("param help current.K_p", "current.K_p_d_v_per_a"),
        ("param help motor.R_s", "motor.R_s_ohm"),
        ("info --sim interior-2k2?sed=1", "seed"),
        ("simulate interior-2k2 --scenario sped-ramp --json", "speed-ramp"),
        ("reproduce closed-drve", "closed-drive"),
        ("lut interor-2k2 -o lut.npz", "interior-2k2"),
        ("scope --sim interior-2k2 iq --plain --for 1s", "i_q_a"),
    ],
)
def test_a_misspelt_name_is_recognised(typed: str, meant: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(typed.split()) in (ExitCode.USAGE, ExitCode.BUS)
    answer = capsys.readouterr().err.lower()
    assert "did you mean" in answer and meant.lower() in answer


@pytest.mark.parametrize(("typed", "near"), [("--force", ""), ("--bandwith-hz", "--bandwidth-hz")])
def test_an_option_is_compared_without_its_dashes(typed: str, near: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["tune", "interior-2k2", typed, "3"]) == ExitCode.USAGE
    answer = capsys.readouterr().err
    assert near in answer and ("id you mean" in answer) == bool(near), "--force was answered with --stored"


@pytest.mark.parametrize(("typed", "held"), [("800", "800"), ("800Hz", "800"), ("0.8kHz", "800"), ("800V", "")])
def test_an_option_in_hertz_takes_the_unit_too(typed: str, held: str, capsys: pytest.CaptureFixture[str]) -> None:
    code = run(["tune", "interior-2k2", "-o", "/dev/null", "--bandwidth-hz", typed])
    assert (code == 2) == (not held)
    assert f"imc, {held} Hz" in capsys.readouterr().out if held else "not of frequency" in capsys.readouterr().err


def test_the_version_has_a_short_option(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["-V"]) == run(["--version"]) == 0
    short, long = capsys.readouterr().out.splitlines()
    assert short == long


def test_a_machine_file_names_everything_that_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["machine", "new", "--r", "1ohm", "--l-d", "1mH"]) == 2
    first = capsys.readouterr().err.splitlines()[0]
    assert first == "error: missing options: --name, --pole-pairs, --u-dc, --pwm, --output, --ke or --kt"


@pytest.mark.parametrize(
    ("typed", "says"),
    [
        ("check --speed-max", "option '--speed-max' needs a value behind it"),
        ("tune interior-2k2 -o d.toml --eps 2O", "'2O' is not a number"),
        ("fleet nowhere", "no such folder"),
    ],
)
def test_a_plain_mistake_is_named_in_plain_words(typed: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Before: "requires an argument", "not a valid float", "no run with identified values in here"."""
    assert run(typed.split()) == 2
    assert says in capsys.readouterr().err


def helps(command: click.Command, context: click.Context, typed: str) -> Iterator[tuple[str, str]]:
    """Every command as typed, and its help as a terminal shows it."""
    yield typed, command.get_help(context)
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            child = command.get_command(context, name)
            assert child is not None
            inner = click.Context(child, parent=context, info_name=name, terminal_width=TERMINAL)
            yield from helps(child, inner, f"{typed} {name}")


def test_every_help_fits_a_terminal_and_ends_with_examples() -> None:
    context = click.Context(cli, info_name="pmsmtool", terminal_width=TERMINAL)
    for typed, text in helps(cli, context, "pmsmtool"):
        assert "Examples:" in text, typed
        assert [line for line in text.splitlines() if len(line) > TERMINAL] == [], typed
