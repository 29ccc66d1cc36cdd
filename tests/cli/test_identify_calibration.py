# SPDX-License-Identifier: MIT
"""``--cal``: a scale against an instrument leaves the instrument's tolerance; three kinds of interval stay apart."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.random_drives import true_loop_resistance
from pmsmtool.cli.main import run
from pmsmtool.errors import ConfigError
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.files import data_folder
from pmsmtool.identification.calibration import calibrated_tolerance
from pmsmtool.identification.evaluate import tolerance_on
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file
from tests.simulated_bus import settle

GAIN = 1.01
"""Of the simulated drive's DC-link measurement: commands come out smaller than the drive believes."""


def answer(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, float]:
    capsys.readouterr()
    code = run(("identify", *arguments, "--json"))
    printed = capsys.readouterr()
    assert code == 0, printed.err
    (value,) = (value for value in json.loads(printed.out)["values"] if value["name"] == "R_s_ohm")
    return dict(value)


@pytest.mark.chain
def test_a_scale_is_taken_out_and_its_tolerance_takes_the_sensors_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    settle(tmp_path, monkeypatch)
    base = load_machine_file(data_folder("profiles") / "interior-2k2.toml")
    changed = {"rotor": "locked", "U_dc_gain": GAIN, "T_winding_c": 20.0, "thermal_on": False}
    drive = replace(base, simulation={**base.simulation, **changed})
    Path("drive.toml").write_text(dump_machine_file(drive), encoding="utf-8")
    R = true_loop_resistance(drive)
    channel = "drive.toml?nv=:memory:"
    shown = answer(capsys, "-i", "pmsmsim", "-c", channel, "--yes", "--shaft", "locked", "R")
    assert shown["systematic"] / shown["value"] == pytest.approx(math.hypot(0.01, 0.01), rel=0.2)
    assert shown["value"] == pytest.approx(R * GAIN, rel=3e-3)  # measured 0.1 %

    (folder,) = Path("runs").iterdir()
    true = answer(capsys, "--replay", str(folder), "--cal", "V_dc=565.6V:560V:0.56V", "--cal", "I=5Apk:5Apk:0.1%")
    assert true["value"] == pytest.approx(shown["value"] / GAIN, rel=1e-6)
    assert true["value"] == pytest.approx(R, rel=3e-3)
    assert true["std"] == pytest.approx(shown["std"] / GAIN, rel=1e-3)
    # what is left: two instruments of 0.1 % and the 2 K of the temperature sensor
    assert true["systematic"] / true["value"] == pytest.approx(math.hypot(1e-3, 1e-3, 2.0 * 0.00393), rel=0.01)

    for value in (shown, true):
        assert value["statistical_95"] == pytest.approx(value["coverage_factor"] * value["std"])
        assert value["total_95"] == pytest.approx(math.hypot(value["statistical_95"], value["systematic"]))
    kept = tomllib.loads((folder / "machine.toml").read_text(encoding="utf-8"))
    assert kept["std"]["R_s_ohm"] == pytest.approx(true["std"])
    assert kept["systematic"]["R_s_ohm"] == pytest.approx(true["systematic"])
    assert kept["conditions"]["voltage_scale"] == pytest.approx(1.0 / GAIN)
    again = answer(capsys, "--replay", str(folder))
    assert again == true  # the run keeps its calibration


@pytest.mark.parametrize(
    "text",
    [
        "U=1V:1V:0.1V", "V_dc=48V", "V_dc=48V:0V:0.1V", "V_dc=0V:48V:0.1V", "V_dc=48V:48V:0V", "V_dc=48V:480V:1V",
        "V_dc=a:b:c", "V_dc=48:48:0.1", "V_dc=48V:48V:0.1", "V_dc=48V:48V:0.1A", "V_dc=48V:48V:1V:1V", "I=5:5:0.1",
        "I=5A:5A:0.1A", "I=5Apk:5Apk:0.1", "I=5Apk:5Apk:0%", "bridge=1V", "bridge=1V:1V:0V", "bridge=1:1:0.1",
        "bridge=-1V:1V:0.1V", "bridge=1V:4V:0.1V", "bridge=1A:1A:0.1A",
    ],
)  # fmt: skip
def test_what_is_no_calibration_is_a_usage_error(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(("identify", "-i", "virtual", "-c", "nothing", "--yes", "--cal", text)) == 2
    err = capsys.readouterr().err
    assert "instrument" in err or "cannot be calibrated" in err or "thresholds of switch and diode" in err


def test_a_calibration_carries_its_units() -> None:
    bare = SensorTolerance()
    volts = calibrated_tolerance(bare, ["V_dc=540V:0.537kV:500mV"])
    assert volts.voltage_scale == pytest.approx(537.0 / 540.0) and volts.voltage_gain == pytest.approx(0.5 / 537.0)
    peak = calibrated_tolerance(bare, ["I=5.00Apk:5.02Apk:0.2%"])
    assert peak.current_scale == pytest.approx(1.004) and peak.current_gain == pytest.approx(0.002)
    mixed = calibrated_tolerance(bare, ["I=5Apk:3.5355339Arms:10mArms"])
    assert mixed.current_scale == pytest.approx(1.0) and mixed.current_gain == pytest.approx(0.01 / 3.5355339)
    with pytest.raises(ConfigError, match="has no unit"):
        calibrated_tolerance(bare, ["V_dc=540:537:0.5"])
    with pytest.raises(ConfigError, match="peak or an rms"):
        calibrated_tolerance(bare, ["I=5A:5A:0.1A"])


@pytest.mark.chain
def test_the_data_sheet_of_the_bridge_takes_its_threshold_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A leg swings by U_dc + V_diode - V_switch, which no current shows; whoever says so gets R without it."""
    settle(tmp_path, monkeypatch)
    base = load_machine_file(data_folder("profiles") / "interior-2k2.toml")
    bridge = {"inverter_model": "switched", "device_drop_v": 0.3, "diode_drop_v": 2.3}
    changed = {**bridge, "rotor": "locked", "T_winding_c": 20.0, "thermal_on": False}
    drive = replace(base, simulation={**base.simulation, **changed})
    Path("drive.toml").write_text(dump_machine_file(drive), encoding="utf-8")
    swing = 1.0 + 2.0 / drive.inverter.U_dc_v
    shown = answer(capsys, "-i", "pmsmsim", "-c", "drive.toml?nv=:memory:", "--yes", "--shaft", "locked", "R")
    (folder,) = Path("runs").iterdir()
    true = answer(capsys, "--replay", str(folder), "--cal", "bridge=0.3V:2.3V:0.1V")
    assert true["value"] / shown["value"] == pytest.approx(swing, rel=1e-6)
    R = true_loop_resistance(drive)
    assert abs(true["value"] - R) < 0.5 * abs(shown["value"] - R), (true, shown, R)
    assert true["std"] < shown["std"]
    kept = tomllib.loads((folder / "machine.toml").read_text(encoding="utf-8"))
    assert kept["conditions"]["bridge_difference_v"] == pytest.approx(2.0)
    assert answer(capsys, "--replay", str(folder)) == true


def test_a_bridge_is_told_on_a_low_link_too() -> None:
    told = calibrated_tolerance(SensorTolerance(), ["bridge=0V:0.7V:0.2V"])
    low = tolerance_on(told, 48.0)
    assert low.applied_scale == pytest.approx(1.0 + 0.7 / 48.0)
    assert low.voltage_scale_std == pytest.approx(0.2 / 1.96 / 48.0, rel=1e-3)
    assert tolerance_on(SensorTolerance(), 48.0).applied_scale == 1.0
