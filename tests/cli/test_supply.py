# SPDX-License-Identifier: MIT
"""``identify R --supply``: the bench supply that a person reads, here the simulated one's display or typed numbers."""

from __future__ import annotations

import json
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result

from pmsmtool.bus.connect import connect
from pmsmtool.cli.identify import supply_reader
from pmsmtool.cli.main import cli
from pmsmtool.errors import Declined, NotAvailable
from pmsmtool.identification.request import Method
from pmsmtool.machine.machine_file import load_machine_file, machine_path
from pmsmtool.measurement.capabilities import WAYS

CHANNEL = "interior-2k2?nv=:memory:&drive=cia402"


def run(*arguments: str, channel: str = CHANNEL) -> Result:
    return CliRunner().invoke(cli, ["--sim", channel, "--yes", *arguments])


@pytest.mark.chain
def test_resistance_by_a_bench_supply(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = run("identify", "R", "--supply", "--json")
    assert outcome.exit_code == 0, outcome.exception
    facts = json.loads(outcome.stdout)
    (found,) = (value for value in facts["values"] if value["name"] == "R_s_ohm_measured")
    drive = load_machine_file(machine_path("interior-2k2"))
    rise = float(drive.simulation_settings()["T_winding_c"]) - drive.machine.T_ref_c  # type: ignore[arg-type]
    truth = drive.machine.R_s_ohm * (1.0 + drive.machine.alpha_R_per_k * rise)
    assert found["method"] == "power of a bench supply, read at several currents"
    assert found["value"] == pytest.approx(truth, rel=0.02)  # measured: 0.3 %
    half = 100.0 * ((found["coverage_factor"] * found["std"]) ** 2 + found["systematic"] ** 2) ** 0.5 / found["value"]
    (expected,) = WAYS["R"][Method.STANDARD].expected
    assert half <= 1.1 * expected.half_width  # measured: 2.7 of 3.0 %
    assert "bench supply, read 8 times" in outcome.stderr and "pole pairs, direction" not in outcome.stderr
    replayed = CliRunner().invoke(cli, ["identify", "--replay", facts["run"], "--json"])
    assert json.loads(replayed.stdout)["values"] == facts["values"]


def test_what_needs_the_person_is_said_before(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    table = CliRunner().invoke(cli, ["--sim", CHANNEL, "caps"]).stdout
    (line,) = (line for line in table.splitlines() if line.startswith("R ") and "standard" in line)
    assert "R_s_ohm +-" in line and "needs a bench supply whose power a person reads" in line
    error = run("identify", "R").exception
    assert isinstance(error, NotAvailable) and "R by standard: not available: needs a bench supply" in str(error)
    error = run("identify", "R", "--supply", channel="interior-2k2?nv=:memory:").exception
    assert isinstance(error, NotAvailable) and "the method inject reads no bench supply" in str(error)
    assert not (tmp_path / "runs").exists()


def test_a_person_types_what_the_supply_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    with connect("pmsmsim", CHANNEL) as connection:
        monkeypatch.setattr("pmsmtool.cli.consent.person_present", lambda: False)
        with pytest.raises(Declined, match="no terminal to ask what the bench supply shows"):
            supply_reader(connection, 1, simulated=False)
        monkeypatch.setattr("pmsmtool.cli.consent.person_present", lambda: True)
        ask = supply_reader(connection, 1, simulated=False)

    @click.command()
    def typed() -> None:
        click.echo(str(ask(3.1)))

    outcome = CliRunner().invoke(typed, input="48.02\n-1\n1.25\n")
    assert "3.1 Apk in the machine: what does the bench supply show?" in outcome.stderr
    assert outcome.stdout.splitlines()[-1] == "(48.02, 1.25)"  # a negative current is asked for again
