# SPDX-License-Identifier: MIT
"""`monitor --log`: a recorded bus by the names and units of a map, and files that are damaged."""

from __future__ import annotations

import csv
import random
from pathlib import Path

import pytest

from pmsmtool.cli.main import run as program

EDS = """[DeviceInfo]
VendorNumber=0xFB
[1800sub1]
ParameterName=COB-ID
DataType=0x0007
AccessType=rw
DefaultValue=$NODEID+0x180
[1A00sub0]
ParameterName=entries
DataType=0x0005
AccessType=rw
DefaultValue=2
[1A00sub1]
ParameterName=first
DataType=0x0007
AccessType=rw
DefaultValue=0x60410010
[1A00sub2]
ParameterName=second
DataType=0x0007
AccessType=rw
DefaultValue=0x606C0020
[2100sub1]
ParameterName=Board temperature
DataType=0x0003
AccessType=ro
"""


def frame(t_s: float, cob_id: int, data: str) -> str:
    return f"({t_s:.6f}) can0 {cob_id:03X}#{data}"


LINES = [
    frame(10.0, 0x705, "05"),
    frame(10.1, 0x605, "406C600000000000"), frame(10.101, 0x585, "436C6000E8030000"),  # 1000 rpm read
    frame(10.2, 0x605, "4000210100000000"), frame(10.201, 0x585, "4B002101D7FF0000"),  # -41 counts
    frame(10.3, 0x605, "2B716000F4010000"), frame(10.301, 0x585, "6071600000000000"),  # 500 permille written
    frame(10.4, 0x605, "2B71600058020000"), frame(10.401, 0x585, "8071600011000906"),  # refused
    frame(10.5, 0x185, "3706C4090000"),
    frame(10.6, 0x285, "0102"),
    frame(10.7, 0x085, "2073010000000000"),
]  # fmt: skip


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    (tmp_path / "drive.eds").write_text(EDS)
    (tmp_path / "bus.log").write_text("\n".join(LINES) + "\n")
    return tmp_path


def rows_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(text.splitlines()))


def test_a_makers_drive_by_its_map_and_data_sheet(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["monitor", "--log", str(recorded / "bus.log"), "--map", "epos4", "--eds", str(recorded / "drive.eds")]
    assert program([*command, "--csv"]) == 0
    shown = capsys.readouterr()
    units, *rows = rows_of(shown.out)
    last = rows[-1]
    assert units["omega_M_rad_s"] == "rad/s" and units["target_torque_nm"] == "permille of 0x6076"
    assert float(rows[0]["omega_M_rad_s"]) == pytest.approx(104.7197551) and rows[0]["t_s"] == "0.101"
    assert float(last["omega_M_rad_s"]) == pytest.approx(261.7993878) and float(last["statusword"]) == 0x0637
    assert last["0x2100:01 Board temperature"] == "-41" and last["target_torque_nm"] == "500", "what was refused is not"
    assert "PDO 0x285: 1 frame not decoded" in shown.err
    assert "0.700 s: emergency 0x7320: " in shown.err and "node 5: 12 frames in 0.7 s" in shown.err


@pytest.mark.chain
@pytest.mark.parametrize("suffix", ["log", "asc", "trc", "blf"])
def test_a_recorded_monitor_says_the_same_again(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    live = ["--sim", "interior-2k2", "--trace-can", f"bus.{suffix}", "monitor", "--pdo", "--for", "0.2s"]
    assert program([*live, "--rate", "50Hz", "-g", "i_q_a|U_dc|T_mag", "--csv"]) == 0
    _, *seen = rows_of(capsys.readouterr().out)
    assert program(["monitor", "--log", f"bus.{suffix}", "-g", "i_q_a|U_dc|T_mag", "--csv"]) == 0
    _, *again = rows_of(capsys.readouterr().out)
    found = [row["i_q_a"] for row in again]
    assert len(seen) > 5 and {row["i_q_a"] for row in seen} <= set(found)
    assert again[-1]["U_dc_v"] == seen[-1]["U_dc_v"] and again[-1]["T_magnet_c"] == seen[-1]["T_magnet_c"]


def test_lines_that_are_no_frame_are_left_out_and_said(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = ["(11.0) can0 185#37", "(x) can0 185#3706C4090000", "no frame", "(12.0) can0 185#3706D0070"]
    (recorded / "bus.log").write_text("\n".join([wrong[2], *LINES[:10], *wrong, frame(13.0, 0x185, "3706D0070000")]))
    command = ["monitor", "--log", str(recorded / "bus.log"), "--map", "epos4", "--eds", str(recorded / "drive.eds")]
    assert program([*command, "--csv", "-g", "omega"]) == 0
    shown = capsys.readouterr()
    assert "3 lines left out, no CAN frame: ValueError" in shown.err
    assert float(rows_of(shown.out)[-1]["omega_M_rad_s"]) == pytest.approx(209.4395102)


@pytest.mark.parametrize("suffix", ["log", "asc", "trc", "blf", "mf4"])
def test_a_damaged_file_ends_in_a_sentence(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = random.Random(3)
    whole = ("\n".join(LINES) + "\n").encode()
    path = tmp_path / f"bus.{suffix}"
    for content in (b"", whole, *(whole[:n] for n in (1, 40, 97)), rng.randbytes(2000), b"\xff\xfe" + whole):
        path.write_bytes(content)
        assert program(["monitor", "--log", str(path), "--map", "epos4"]) in (0, 2)
        assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "options", "message"),
    [
        ("", [], "there is no CAN frame in the file"),
        ("\n".join([*LINES, frame(11.0, 0x704, "05")]), [], "name one: -n 4, -n 5"),
        ("\n".join(LINES), ["-g", "absent"], "none holds a quantity that is asked for"),
        ("\n".join(LINES), ["--pdo"], "--log reads what was recorded"),
    ],
)
def test_what_cannot_be_shown_is_said(
    content: str, options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bus.log").write_text(content)
    assert program(["monitor", "--log", str(tmp_path / "bus.log"), *options]) == 2
    assert message in capsys.readouterr().err


def test_another_format_names_those_that_are_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert program(["monitor", "--log", str(tmp_path / "bus.txt")]) == 2
    assert ".log, .asc, .trc, .blf, .mf4" in capsys.readouterr().err
    assert program(["monitor", "--map", "epos4"]) == 2
    assert "--eds and --map are for --log" in capsys.readouterr().err
