# SPDX-License-Identifier: MIT
"""What the drive cannot be made to do: one healthy run, its traces spoilt in one way each, and replayed.

Every trap is named. What does not depend on its trace is given all the same (exit code 10); else none is (6).
The traps of the speed runs and of the injection each have more names, all refused in ``tests/estimators``.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pmsmtool.cli.main import run
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.trace import Trace, read_trace, trace_npz
from tests.simulated_bus import settle

pytestmark = pytest.mark.chain

SHIFT = 0.005
"""Change of a value without the correction that another one gave it (relative); measured 0.3 % (R by the instant)."""
Signals = dict[str, NDArray[np.float64]]
Spoil = Callable[[Trace], Signals]


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A run directory of a healthy drive."""
    folder = tmp_path_factory.mktemp("healthy")
    with pytest.MonkeyPatch.context() as patch:
        settle(folder, patch)
        assert run(("identify", "-i", "pmsmsim", "-c", "interior-2k2?nv=:memory:", "--yes", "R", "L", "psi")) == 0
        (made,) = (folder / "runs").iterdir()
        yield made


def ramp(t: Trace, name: str, size: float) -> Signals:
    return {name: t[name] + np.linspace(0.0, size, len(t))}


def warmer(t: Trace) -> Signals:
    """A winding that heats by a fifth of its resistance while nobody measures its temperature."""
    slope = float(np.median(t["u_d_v"] / t["i_d_a"]))
    growth = 0.2 * slope * t.t_s / t.t_s[-1] * t["i_d_a"]
    halves = {name: t[name] + growth for name in ("u_d_v", "u_d_first_v", "u_d_second_v")}
    return {**halves, "T_winding_c": np.full(len(t), np.nan)}


def turned(t: Trace) -> Signals:
    """The voltage of a rotor whose encoder offset is off by 60 degrees."""
    c, s = 0.5, 0.5 * np.sqrt(3.0)
    return {"u_d_v": c * t["u_d_v"] - s * t["u_q_v"], "u_q_v": s * t["u_d_v"] + c * t["u_q_v"]}


TRAPS: dict[str, tuple[str, Spoil, str]] = {
    "noise below the converter's step": (
        "zero_current",
        lambda t: {name: np.full(len(t), 0.01) for name in ("i_d_a", "i_q_a")},
        "E_SNR",
    ),
    "rotor swings under the first vectors": ("phase_vectors", lambda t: {"moved": np.ones(len(t))}, "E_NOT_SETTLED"),
    "encoder stands still": ("first_turn", lambda t: {"theta_M_rad": np.zeros(len(t))}, "E_ENCODER"),
    "voltage limited at a level": ("levels", lambda t: {"flagged": np.eye(len(t))[-1]}, "E_CLIPPED"),
    "voltage drifts in a window": ("levels", lambda t: {"u_d_second_v": 1.1 * t["u_d_second_v"]}, "E_NOT_SETTLED"),
    "winding heats unseen": ("levels", warmer, "E_THERMAL_DRIFT"),
    "levels of one size": ("levels", lambda t: {"i_d_a": np.sign(t["i_d_a"])}, "E_EXCITATION"),
    "no model explains the levels": (
        "levels",
        lambda t: {"u_d_v": t["u_d_v"] * (1.0 + 0.01 * (-1.0) ** np.arange(len(t)))},
        "E_MODEL_MISMATCH",
    ),
    "one pair of phases has more resistance": (
        "phase_pairs",
        lambda t: {"u_d_v": t["u_d_v"] * np.array([1.0, 1.3, 1.0, 1.0, 1.0, 1.0])},
        "E_UNBALANCED",
    ),
    "gains of the sensors differ": ("phase_pairs", lambda t: {"i_a_a": 1.08 * t["i_a_a"]}, "E_CURRENT_SENSOR"),
    "a gear before the encoder": (
        "rotation_forward",
        lambda t: {"theta_M_rad": 1.25 * t["theta_M_rad"]},
        "E_POLE_PAIRS",
    ),
    "rotor leaves the turning vector": (
        "rotation_forward",
        lambda t: {"theta_M_rad": t["theta_M_rad"] + 1.0 * np.sin(6.0 * t["theta_imposed_rad"])},
        "E_ROTOR_MOVED",
    ),
    "encoder offset far off": ("speeds", turned, "E_NOT_IDENTIFIABLE"),
    "rotor moves in the injection": ("square_q_6", lambda t: ramp(t, "theta_M_rad", 0.1), "E_ROTOR_MOVED"),
    "samples limited in the injection": ("square_d_9", lambda t: {"flagged": np.eye(len(t))[0]}, "E_CLIPPED"),
    "no current follows the injection": (
        "square_q_6",
        lambda t: {"i_q_a": np.full(len(t), np.mean(t["i_q_a"]))},
        "E_EXCITATION",
    ),
}
"""Trace, what happens to it, and the name."""


ACCEPTED = {
    "rotation_forward": {"R_s_ohm"},
    "speeds": {"R_s_ohm", "L_d_h", "L_q_h"},
    "square_q_6": {"R_s_ohm", "psi_f_wb"},
    "square_d_9": {"R_s_ohm", "psi_f_wb"},
}
"""Values of R, L and psi that do not depend on a trace; none where a trace is not named."""


@pytest.mark.parametrize("case", TRAPS)
def test_a_trap_is_named_and_takes_only_what_depends_on_it(
    case: str, healthy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, spoil, reason = TRAPS[case]
    folder = tmp_path / "run"
    shutil.copytree(healthy, folder)
    before = load_machine_file(folder / "machine.toml")
    nameplate = load_machine_file(folder / "nameplate.toml")
    (folder / "machine.toml").unlink()
    path = folder / "traces" / f"{name}.npz"
    trace = read_trace(path)
    signals = {**trace.signals, **spoil(trace)}
    path.write_bytes(trace_npz(replace(trace, signals=signals, units=dict.fromkeys(signals, "1"))))
    capsys.readouterr()
    code = run(("identify", "--replay", str(folder), "--json"))
    printed = capsys.readouterr()
    assert f"{reason}: " in printed.err
    assert "likely:" in printed.err and "try:" in printed.err
    good = ACCEPTED.get(name, set())
    if not good:
        assert (code, printed.out) == (6, ""), printed.err
        assert not (folder / "machine.toml").exists()
        return
    assert code == 10, printed.err
    data = json.loads(printed.out)
    keys = {"R": ["R_s_ohm"], "L": ["L_d_h", "L_q_h"], "psi": ["psi_f_wb"]}
    assert {key for quantity in set(keys) - set(data["refused"]) for key in keys[quantity]} == good
    assert any(f"{reason}: " in why for why in data["refused"].values())
    written = load_machine_file(folder / "machine.toml")
    for key in ("R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb"):
        kept = before if key in good else nameplate
        assert getattr(written.machine, key) == pytest.approx(getattr(kept.machine, key), rel=SHIFT), key
        assert (key in written.estimates) is (key in good)


@pytest.mark.parametrize("name", ["speeds", "levels", "square_q_6"])
@pytest.mark.parametrize("calibration", [(), ("--cal", "V_dc=540V:537V:0.5V")])
def test_a_record_of_an_earlier_version_is_named(
    name: str, calibration: tuple[str, ...], healthy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its experiment recorded something else: ``half_s`` is what the speed runs of early versions have not."""
    missing = {"speeds": "half_s", "levels": "u_d_first_v", "square_q_6": "u_q_v"}[name]
    folder = tmp_path / "run"
    shutil.copytree(healthy, folder)
    made = (folder / "machine.toml").read_bytes()
    path = folder / "traces" / f"{name}.npz"
    trace = read_trace(path)
    signals = {signal: values for signal, values in trace.signals.items() if signal != missing}
    path.write_bytes(trace_npz(replace(trace, signals=signals)))
    capsys.readouterr()
    code = run(("identify", "--replay", str(folder), *calibration))
    printed = capsys.readouterr()
    assert (code, printed.out) == (2, ""), printed.err
    assert f"the record has no signal {missing}\n" in printed.err and f"where:  {path}\n" in printed.err
    assert "earlier version" in printed.err and "try:" in printed.err
    assert (folder / "machine.toml").read_bytes() == made
