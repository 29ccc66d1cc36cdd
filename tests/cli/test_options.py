# SPDX-License-Identifier: MIT
"""Shared options: before a command, after it, from the environment."""

from __future__ import annotations

import math
import os
import re
import socket
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from pmsmtool.bus.connect import connect
from pmsmtool.cli import options
from pmsmtool.cli.options import BusOptions, MotionOptions
from pmsmtool.cli.output import Output
from pmsmtool.cli.sim import _how_to_join
from pmsmtool.errors import BusError
from tests.cli.conftest import Tool


def probe(arguments: list[str], **environment: str) -> tuple[BusOptions, Output, MotionOptions]:
    """Run a command that takes all shared options below the real group."""
    seen: list[tuple[BusOptions, Output, MotionOptions]] = []

    @click.command("probe")
    @options.bus_options
    @options.output_options
    @options.motion_options
    def command(bus: BusOptions, out: Output, motion: MotionOptions) -> None:
        seen.append((bus, out, motion))

    @click.group("pmsmtool", context_settings={"auto_envvar_prefix": "PMSMTOOL"})
    @options.global_options
    def group(**_: object) -> None: ...

    group.add_command(command)
    env: dict[str, str | None] = {name: None for name in os.environ if name.startswith("PMSMTOOL_")}
    result = CliRunner(env={**env, **environment}).invoke(
        group, arguments, catch_exceptions=False, standalone_mode=False
    )
    assert result.exit_code == 0, result.output
    return seen[0]


@pytest.mark.parametrize(
    ("arguments", "environment", "expected"),
    [
        (["probe"], {}, BusOptions()),
        (["-n", "5", "probe"], {}, BusOptions(node=5)),
        (["probe", "-n", "0x10"], {}, BusOptions(node=16)),
        (["-n", "5", "probe", "-n", "6"], {}, BusOptions(node=6)),
        (["probe"], {"PMSMTOOL_NODE": "7"}, BusOptions(node=7)),
        (["-n", "5", "probe"], {"PMSMTOOL_NODE": "7"}, BusOptions(node=5)),
        (["probe", "-n", "6"], {"PMSMTOOL_NODE": "7"}, BusOptions(node=6)),
        (["probe"], {"PMSMTOOL_PROBE_NODE": "7"}, BusOptions()),
        (["-i", "pcan", "probe", "-c", "x"], {}, BusOptions("pcan", "x")),
        (["probe", "--sim", "demo"], {}, BusOptions("pmsmsim", "demo")),
        (["--sim", "demo", "probe", "-b", "250000"], {}, BusOptions("pmsmsim", "demo", 250000)),
        (["probe", "--sim", "demo"], {"PMSMTOOL_INTERFACE": "pcan"}, BusOptions("pmsmsim", "demo")),
        (["probe", "-i", "pcan"], {"PMSMTOOL_SIM": "demo"}, BusOptions("pcan")),
        (["probe"], {"PMSMTOOL_SIM": "demo"}, BusOptions("pmsmsim", "demo")),
        (["probe", "--trace-can", "x.asc"], {}, BusOptions(trace_can=Path("x.asc"))),
    ],
)
def test_bus_options(arguments: list[str], environment: dict[str, str], expected: BusOptions) -> None:
    assert probe(arguments, **environment)[0] == expected


@pytest.mark.parametrize(
    ("arguments", "environment"),
    [
        (["probe", "--sim", "demo", "-i", "pcan"], {}),
        (["-c", "can0", "probe", "--sim", "demo"], {}),
        (["probe"], {"PMSMTOOL_SIM": "demo", "PMSMTOOL_INTERFACE": "pcan"}),
        (["probe", "-n", "128"], {}),
        (["probe", "-n", "0"], {}),
        (["probe", "-n", "five"], {}),
        (["probe", "-b", "500k"], {}),
        (["probe", "--i-max", "12"], {}),
        (["probe", "--i-max", "12A"], {}),
        (["probe", "--speed-max", "1200"], {}),
        (["probe", "--shaft", "loose"], {}),
    ],
)
def test_bus_options_refused(arguments: list[str], environment: dict[str, str]) -> None:
    with pytest.raises(click.UsageError):
        probe(arguments, **environment)


def test_output_and_motion_options() -> None:
    _, out, motion = probe(["--json", "-v", "probe", "-v", "--i-max", "8.5Arms", "--speed-max", "60rpm", "--yes"])
    assert (out.json, out.verbosity) == (True, 2)
    assert motion.i_max_apk == pytest.approx(8.5 * math.sqrt(2.0), rel=1e-12)
    assert motion.speed_max_rad_s == pytest.approx(2.0 * math.pi, rel=1e-12)
    assert (motion.yes, motion.load, motion.brake, motion.shaft) == (True, "none", "none", None)
    _, out, motion = probe(["probe", "-q", "-v"])
    assert (out.json, out.verbosity, motion.yes) == (False, -1, False)


@pytest.mark.parametrize("command", ["restore", "param set", "flash-params", "lss set-node"])
def test_what_moves_nothing_lists_no_limits_of_motion(command: str, tool: Tool) -> None:
    """They were listed though nothing moves; a line of a script that gives them is still taken."""
    code, told, _ = tool(*command.split(), "--help")
    assert code == 0 and "--serial" in told and not re.search("--i-max|--speed-max|--shaft", told)
    limits = ("--i-max", "12Apk", "--speed-max", "60rpm", "--shaft", "free")
    assert tool(*command.split(), *limits, "--help")[0] == 0


def test_consent_is_not_taken_from_the_environment() -> None:
    assert probe(["probe"], PMSMTOOL_YES="1", PMSMTOOL_PROBE_YES="1")[2].yes is False


def test_simulated_only_when_the_interface_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("CAN_INTERFACE", raising=False)
    assert BusOptions("pmsmsim").simulated()
    assert not BusOptions("socketcand").simulated()
    assert not BusOptions().simulated()


def test_a_dash_is_no_file(tool: Tool) -> None:
    """Before, ``-o -`` left a file of that name."""
    code, _, err = tool("tune", "interior-2k2", "-o", "-")
    assert code == 2 and "'-' is not the name of a file" in err and not Path("-").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("lut", "interior-2k2", "-o", "t.csv"), "'t.csv' ends in .csv; what is written is .npz"),
        (("lut", "interior-2k2", "-o", "t.npz", "--plot", "t.xyz"), "t.xyz has no figure format"),
        (("tune", "interior-2k2", "-o", "t.json"), "'t.json' ends in .json; what is written is .toml"),
        (("report", ".", "-o", "t.pdf"), "t.pdf: what is written is .html; --pdf writes a .pdf beside the page"),
        (("report", ".", "--junit", "-o", "t.json"), "t.json: what is written is .xml with --junit"),
        (("report", ".", "--anonymous", "-o", "t.html"), "t.html: what is written is .json with --anonymous"),
        (("tune", "", "-o", "t.toml"), "'MACHINE': the text is empty"),
        (("report", ""), "'RUN': the text is empty"),
        (("--sim", "", "info"), "'--sim': the text is empty"),
        (("fleet", __file__), f"Directory '{__file__}' is a file"),
        (("margins", "d.toml", "--thermal-headroom", "nan"), "'--thermal-headroom': nan is not finite"),
        (("identify", "R", "--accuracy", "nan"), "'--accuracy': nan is not finite"),
        (("diff", ".", ".", "--tol", "x%"), "write it like 0.02 or 2%"),
        (("-b", "500k", "scan"), "'500k' is no whole number (decimal or 0x...); did you mean 500000?"),
    ],
)
def test_a_name_or_number_in_another_form_is_refused(tool: Tool, arguments: tuple[str, ...], said: str) -> None:
    """Before, ``lut -o t.csv`` overwrote its own table, and one of 4 MB was made before ``t.xyz`` was looked at."""
    code, _, err = tool(*arguments)
    assert code == 2 and said in err and not list(Path().glob("t.*"))


def test_where_no_server_was_found_is_told() -> None:
    """Before, "Connection refused": a drive served at another port is another line of a file."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(BusError) as caught:
        connect("socketcand", "vcan0", host="127.0.0.1", port=port)
    assert f"no server listens at 127.0.0.1:{port}" in str(caught.value) and "can.conf" in caught.value.likely


def test_a_served_drive_on_another_port_is_joined_by_a_file_that_python_can_reads() -> None:
    """Before, a person was given a line of Python alone: no option of the command line has host and port."""
    said = _how_to_join("127.0.0.1", 29700)
    assert "`host = 127.0.0.1` and `port = 29700` below `[default]` in ~/can.conf" in said
    assert _how_to_join("127.0.0.1", 29536).endswith("pmsmtool -i socketcand -c vcan0 scan")


@pytest.mark.parametrize("command", [("info",), ("commission", "interior-2k2", "--yes"), ("doctor",)])
def test_a_damaged_can_conf_is_named(tool: Tool, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]) -> None:
    """The file is written by hand (docs/your-drive.md, 3); a missing bracket was an internal error."""
    monkeypatch.setattr("can.util.CONFIG_FILES", ["can.conf"])
    Path("can.conf").write_text("[default\ninterface = pmsmsim\n", encoding="utf-8")
    code, _, err = tool(*command)
    assert code == 2 and "a missing bracket" in err and "can.conf" in err, err
