# SPDX-License-Identifier: MIT
"""A map is for one drive: nothing is written or moved through the map of another, and what is only read is marked."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pmsmtool.bus.sdo import SdoChannel
from pmsmtool.cli.main import run
from pmsmtool.drive_maps.drive_map import DriveMap, reference_map
from pmsmtool.drive_maps.drive_map_file import dump_drive_map
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.sim.node import node
from tests.cli.conftest import Result, Tool

EPOS4 = "interior-2k2?nv=:memory:&drive=epos4"
REFERENCE = "interior-2k2?nv=:memory:"

FOREIGN: dict[str, Callable[[], DriveMap]] = {
    "epos.toml": lambda: replace(load_family("epos4"), name="another", product=0x777, more_products=()),
    "core.toml": lambda: replace(reference_map(), name="another", vendor=0x1234),
    "nobody.toml": lambda: replace(load_family("epos4"), name="nobody's", vendor=0, product=0, more_products=()),
}


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Every object that is written during the test."""
    seen: list[tuple[int, int]] = []
    real = SdoChannel.download

    def spy(channel: SdoChannel, index: int, sub: int, *rest: object, **named: object) -> object:
        seen.append((index, sub))
        return real(channel, index, sub, *rest, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(SdoChannel, "download", spy)
    return seen


@pytest.fixture
def files(tool: Tool) -> Tool:
    for name, made in FOREIGN.items():
        Path(name).write_text(dump_drive_map(made()), encoding="utf-8")
    Path("set.toml").write_text(ParameterSet({"motor.pole_pairs": 3.0}).to_toml(), encoding="utf-8")
    return tool


def on(channel: str, capsys: pytest.CaptureFixture[str], *arguments: str) -> Result:
    capsys.readouterr()
    code = run(["-i", "pmsmsim", "-c", channel, *arguments])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(
    ("channel", "map_file", "command"),
    [
        (EPOS4, "epos.toml", ("identify",)),
        (EPOS4, "epos.toml", ("identify", "R", "--method", "vendor")),
        (EPOS4, "nobody.toml", ("identify", "mechanics")),
        (EPOS4, "epos2", ("identify", "R")),
        (EPOS4, "epos.toml", ("commission",)),
        (EPOS4, "epos.toml", ("param", "set", "motor.pole_pairs=3")),
        (EPOS4, "epos.toml", ("flash-params", "set.toml")),
        (EPOS4, "nobody.toml", ("flash-params", "set.toml")),
        (REFERENCE, "core.toml", ("identify", "R")),
        (REFERENCE, "core.toml", ("jog", "--current", "1Apk", "--for", "0.1s")),
        (REFERENCE, "core.toml", ("restore",)),
    ],
)
def test_nothing_is_moved_or_written_through_the_map_of_another_drive(
    channel: str,
    map_file: str,
    command: tuple[str, ...],
    written: list[tuple[int, int]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    code, out, err = on(channel, capsys, "--yes", *command, "--map", map_file)
    assert (code, out) == (2, ""), err
    assert "where:" in err and "0x1018" in err and "nothing was moved or written" in err
    expected = "does not state whose drive it is for" if map_file == "nobody.toml" else "is for vendor"
    assert expected in err
    assert "shaft" not in err, "no consent was asked"
    assert written == []
    assert not Path("runs").exists()


@pytest.mark.usefixtures("files")
def test_track_neither_reads_nor_writes_through_it(
    written: list[tuple[int, int]], capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = on(REFERENCE, capsys, "track", "--for", "0.1s", "--map", "core.toml")
    assert code == 2 and "is for vendor 0x00001234" in err and written == []


@pytest.mark.usefixtures("files")
def test_the_next_step_names_the_shipped_map(capsys: pytest.CaptureFixture[str]) -> None:
    _, _, err = on(EPOS4, capsys, "--yes", "identify", "R", "--map", "epos2")
    assert "try:    give --map epos4; nothing was moved or written" in err


@pytest.mark.chain
@pytest.mark.usefixtures("files")
def test_what_cia402_alone_says_holds_on_every_drive(capsys: pytest.CaptureFixture[str]) -> None:
    """The map that is taken where none is known may be named, too."""
    code, out, err = on(
        "interior-2k2?nv=:memory:&drive=cia402", capsys, "--yes", "identify", "poles", "--map", "cia402", "--json"
    )
    assert code == 0, err
    assert {value["name"] for value in json.loads(out)["values"]} >= {"pole_pairs", "offset_rad"}


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(
    ("channel", "map_file", "command"),
    [
        (EPOS4, "epos.toml", ("param", "get", "current.*")),
        (
            EPOS4,
            "epos.toml",
            (
                "param",
                "dump",
            ),
        ),
        (EPOS4, "epos.toml", ("param", "diff", "device", "default")),
        (EPOS4, "epos.toml", ("caps",)),
        (EPOS4, "epos2", ("caps",)),
        (REFERENCE, "core.toml", ("sim", "clone", "interior-2k2", "-o", "twin.toml")),
    ],
)
def test_what_is_read_through_it_is_marked(
    channel: str,
    map_file: str,
    command: tuple[str, ...],
    written: list[tuple[int, int]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    code, _, err = on(channel, capsys, *command, "--map", map_file)
    assert code == 0, err
    assert "warning: the map" in err and "is for vendor" in err and "nothing is written or moved through it" in err
    assert written == []


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize("more", [(), ("--pdo",)])
def test_what_is_monitored_through_it_is_marked(
    more: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another product of the same maker, with something at the same indexes."""
    command = ("monitor", "--for", "0.1s", "-g", "U_dc_v", "--rate", "50Hz", *more)
    code, out, err = on(REFERENCE, capsys, *command)
    assert code == 0 and "U_dc_v" in out and "warning" not in err, err
    monkeypatch.setattr(node, "PRODUCT", 0x777)
    code, out, err = on(REFERENCE, capsys, *command)
    assert code == 0 and "U_dc_v" in out, err
    assert "warning: the map 'pmsmsim' is for vendor" in err and "what is read may mean something else" in err


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize("command", [("param", "get", "current.*"), ("param", "dump"), ("caps",)])
def test_what_is_read_through_the_drives_own_map_is_not_marked(
    command: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = on(EPOS4, capsys, *command, "--map", "epos4")
    assert (code, "warning" in err) == (0, False), err


@pytest.mark.parametrize(
    ("family", "arms", "line"),
    [
        ("epos4", None, "rated     4.299 A in 0x3001:01: whether peak or rms is its maker's choice"),
        ("copley", 6.08 / 2**0.5, "rated     4.29921 Arms (6.08 Apk)"),
        ("cia402", None, "rated     4.299 A in 0x6075: whether peak or rms is its maker's choice"),
    ],
)
def test_info_says_where_the_rated_current_stands_and_claims_no_kind(
    tool: Tool, family: str, arms: float | None, line: str
) -> None:
    """It was read at 0x6075 alone, and called rms."""
    asked = ("--sim", f"interior-2k2?nv=:memory:&drive={family}", "info")
    limits = json.loads(tool(*asked, "--json")[1])["limits"]
    assert limits["rated_current_arms"] == (None if arms is None else pytest.approx(arms))
    assert line in tool(*asked)[1].splitlines()
