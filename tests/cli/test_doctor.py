# SPDX-License-Identifier: MIT
"""The doctor before the first frame: what an adapter needs, which one was meant, and an end whatever a driver does."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import can
import pytest
from click.testing import CliRunner

from pmsmtool.bus.connect import ADAPTERS, how_to_set_up, in_time, meant_interface
from pmsmtool.bus.examination import _heard, adapters
from pmsmtool.cli import doctor
from pmsmtool.cli.main import cli
from pmsmtool.errors import BusError


@pytest.mark.parametrize("interface", ["pcan", "ixxat", "kvaser", "slcan", "gs_usb"])
@pytest.mark.parametrize("system", ["linux", "win32", "darwin"])
def test_each_usual_adapter_says_what_to_install_and_to_type(interface: str, system: str) -> None:
    said = how_to_set_up(interface, system)
    if system in ADAPTERS[interface][1]:
        assert "type -i " in said and " -c " in said
    else:
        assert "no driver for this system" in said
    assert interface in can.VALID_INTERFACES
    if system == "linux" and interface != "slcan":
        assert "sudo ip link set can0 up type can bitrate" in said and "-i socketcan -c can0" in said


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("pcna", "pcan"), ("PCAN", "pcan"), ("peak", "pcan"), ("PCAN-USB", "pcan"), ("kvasser", "kvaser"),
        ("canlib", "kvaser"), ("ixat", "ixxat"), ("sclan", "slcan"), ("gsusb", "gs_usb"), ("gs-usb", "gs_usb"),
        ("candlelight", "gs_usb"), ("socketCan", "socketcan"), ("scoketcan", "socketcan"), ("can0", "socketcan"),
        ("pmsm-sim", "pmsmsim"), ("qqqqqq", ""),
    ],
)  # fmt: skip
def test_a_misspelt_interface_is_recognised(name: str, meant: str) -> None:
    assert meant_interface(name, {*can.VALID_INTERFACES, "pmsmsim"}) == meant


def test_the_question_stands_in_the_error() -> None:
    error = CliRunner().invoke(cli, ["-i", "pcna", "-c", "x", "info"]).exception
    assert isinstance(error, BusError) and "did you mean pcan?" in error.what and "PEAK" in error.hint


def test_one_missing_resistor_is_named() -> None:
    for errors, frames in ((5, 0), (5, 100)):
        assert "120 ohm is one missing" in _heard(frames, errors, None)[1]


def test_a_hung_driver_does_not_hang_the_doctor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "WITHIN_S", 0.1)
    monkeypatch.setattr(doctor, "_examined", lambda *arguments: time.sleep(3.0))
    began = time.monotonic()
    error = CliRunner().invoke(cli, ["doctor", "--listen", "0.1s"]).exception
    assert isinstance(error, BusError) and "hangs" in error.likely and time.monotonic() - began < 1.5


def test_a_bounded_call_gives_back_and_raises() -> None:
    assert in_time(lambda: 3, 1.0) == 3
    with pytest.raises(KeyError):
        in_time(lambda: {}[1], 1.0)  # type: ignore[index]


@pytest.mark.chain
def test_python_cans_complaints_are_for_verbose(tmp_path: Path) -> None:
    """The module of the seeedstudio adapter complains under a logger of its own, also when another one is meant."""
    if any(each.name == "seeedstudio" and each.ready for each in adapters()):
        pytest.skip("pyserial is installed")
    program = "from pmsmtool.cli.main import main; main()"
    said = {}
    for option in ("", "-v"):
        line = [sys.executable, "-c", program, *filter(None, (option, "doctor"))]
        said[option] = subprocess.run(line, capture_output=True, text=True, cwd=tmp_path, check=True).stderr
    assert "serial" not in said[""] and "serial" in said["-v"]
