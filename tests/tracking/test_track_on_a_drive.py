# SPDX-License-Identifier: MIT
"""``track`` on a simulated drive in operation, by process data and by recordings; replay; the command line."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from pmsmtool.cli.main import run as program
from pmsmtool.commissioning.commission import begin_run
from pmsmtool.design.tune import tune
from pmsmtool.drive import objects
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.errors import ConfigError
from pmsmtool.files import data_folder
from pmsmtool.identification.track import (
    dump_known,
    follow,
    keep,
    known_of,
    load_known,
    replay_observations,
    systematic_of,
    track_stage,
)
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.measurement.observe import Observations, joined, observe_process_data, observe_recordings
from pmsmtool.run_directory import RunDirectory
from pmsmtool.sim.kernel import Truth
from pmsmtool.sim.simulated_machine import device_slope_ohm, settings_of
from pmsmtool.trace import Trace, trace_npz
from tests.drive.bench import SimBench, sim_bench
from tests.simulated_bus import settle

POINTS = ((60.0, 2.0), (150.0, 11.0), (-100.0, -6.0), (90.0, 4.0), (-150.0, 11.0), (120.0, 8.0))
"""Speed (rad/s) and load (N m) of the operation that is looked at."""
WANTED = ("R_s_ohm", "psi_f_wb")
R_WITHIN = 0.08
"""Of the true R (measured 0.067 by process data, 2.4 standard deviations; 0.012 by recordings)."""


def identified() -> MachineFile:
    """The profile's machine as identification would leave it."""
    machine = load_machine_file(data_folder("profiles") / "interior-2k2.toml")
    return replace(machine, inverter=replace(machine.inverter, V_dead_v=13.76, i_knee_apk=0.2), simulation={})


@cache
def observed(by: str) -> tuple[Trace, float]:
    """Observations of a drive in operation, and the true R at the end."""
    with sim_bench() as bench:
        return operated(bench, by)


def operated(bench: SimBench, by: str) -> tuple[Trace, float]:
    """Track while the machine is driven through the points; returns the observations and the true R at the end."""
    core = bench.session.hardware.core  # type: ignore[attr-defined]
    bench.drive.write(dict(tune(identified()).parameter_set().values))
    before = bench.memory()
    parts = []
    with guarded(bench.drive, Envelope(12.0, 300.0)) as guard:
        guard.enable()
        for speed, load in POINTS:
            core.simulation.library.pmsm_sim_set_load(core.simulation.sim, load)
            guard.command_speed(speed)
            guard.wait(0.4)
            seen = Observations()
            if by == "pdo":
                for _ in range(20):  # who drives the machine looks at it meanwhile
                    observe_process_data(bench.drive.node, 0.05, 100.0, seen)
                    guard.wait(0.0)
            else:
                observe_recordings(bench.drive, 1.0, seen)
            parts.append(seen.trace())
        devices = device_slope_ohm(settings_of(load_machine_file(data_folder("profiles") / "interior-2k2.toml")))
        truth = core.simulation.signal(Truth.R) + devices
    assert bench.memory() == before, "what tracking borrowed is brought back"
    return joined(parts), truth


@pytest.mark.chain
@pytest.mark.parametrize("by", ["pdo", "trace"])
def test_a_machine_in_operation_is_followed(by: str, tmp_path: Path) -> None:
    observations, truth = observed(by)
    known = known_of(identified(), compensated=False)
    found = follow(observations, known, identified())
    with sim_bench() as bench:
        run = begin_run(bench.drive, tmp_path)
    off = found.track.value["R_s_ohm"][-1] - truth
    assert abs(off) < 3.0 * found.track.std["R_s_ohm"][-1] and abs(off) < R_WITHIN * truth
    assert found.track.value["psi_f_wb"][-1] == pytest.approx(0.5417, abs=3.0 * found.track.std["psi_f_wb"][-1])
    temperature, std = found.temperatures["T_winding_c"]
    assert abs(temperature - found.sensor_c) < 3.0 * std
    keep(run, observations, known)
    run.add(track_stage(found, WANTED, identified()))
    again = follow(replay_observations(run), load_known(run.path / "track.json"), identified())
    assert again.track.value["R_s_ohm"].tolist() == found.track.value["R_s_ohm"].tolist()
    assert run.read().passed("track")


def test_the_recorder_is_brought_back(tmp_path: Path) -> None:
    with sim_bench() as bench:
        node = bench.drive.node
        node.put(objects.TRACE_DEPTH, 123)
        node.put(objects.TRACE_PRETRIGGER, 7)
        node.put(objects.TRACE_CHANNELS[0], objects.LIVE["i_a_a"].mapping_word)
        before = bench.memory()
        observe_recordings(bench.drive, 0.3, Observations())
        assert bench.memory() == before


def test_what_is_known_survives_its_file(tmp_path: Path) -> None:
    known = known_of(identified(), compensated=True)
    assert known.error_share == (0.0, 0.4)
    path = tmp_path / "track.json"
    path.write_text(dump_known(known))
    again = load_known(path)
    assert again.curve is not None and known.curve is not None
    assert again.curve.u_error_v.tolist() == known.curve.u_error_v.tolist()
    assert replace(again, curve=None) == replace(known, curve=None)
    path.write_text("{}")
    with pytest.raises(ConfigError, match=r"track\.json"):
        load_known(path)


def test_the_systematic_part_widens_the_inductance() -> None:
    machine = replace(identified(), std={}, systematic={"L_q_h": 0.1 * 0.051})
    assert known_of(machine, compensated=False).L_std == pytest.approx((0.02, 0.1 / 1.96))


def test_a_machine_that_states_no_systematic_part_gets_that_of_usual_sensors() -> None:
    """It was counted as none: a track on the values that the drive holds claimed psi without its sensors' 1 %."""
    machine = replace(identified(), systematic={"R_s_ohm": 0.01})
    assert systematic_of(machine, "R_s_ohm") == 0.01
    assert systematic_of(machine, "psi_f_wb") == pytest.approx(0.01 * 0.545)
    assert systematic_of(replace(machine, systematic={}), "R_s_ohm") == pytest.approx(2**0.5 * 0.01 * 3.6)


# ---- the command line -----------------------------------------------------------------------------------------


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    settle(tmp_path, monkeypatch)
    return tmp_path


def test_a_machine_at_rest_shows_nothing_and_is_refused(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = program(["track", "--sim", "interior-2k2", "--for", "1s"])
    printed = capsys.readouterr()
    assert code == 6 and printed.out == ""
    assert "E_NOT_IDENTIFIABLE" in printed.err and "no current flows" in printed.err
    (run,) = (here / "runs").iterdir()
    assert (run / "traces" / "track.npz").is_file(), "what was seen is kept"


@pytest.mark.chain
def test_replay_from_the_command_line(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    observations, _ = observed("trace")
    with sim_bench() as bench:
        run = begin_run(bench.drive, here / "runs")
    keep(run, observations, known_of(identified(), compensated=False))
    (run.path / "machine.toml").write_text(dump_machine_file(identified()))
    assert program(["track", "--replay", str(run.path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["schema"] == "pmsmtool.track/1"
    assert len(found["values"]["R_s_ohm"]["value"]) == len(observations)
    assert set(found["temperatures"]) == {"T_winding_c", "T_magnet_c"}
    assert program(["track", "psi", "--replay", str(run.path)]) == 0
    assert "psi_f_wb" in (text := capsys.readouterr().out) and "R_s_ohm" not in text


@pytest.mark.chain
@pytest.mark.parametrize("recorded", [(), ("push_0", "push_1", "speeds")])
def test_a_run_of_another_command_is_refused_by_name(
    recorded: tuple[str, ...], here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Identification's traces have voltages, currents and speed too, and still give no number."""
    with sim_bench() as bench:
        run: RunDirectory = begin_run(bench.drive, here / "runs")
    shutil.copy(data_folder("profiles") / "interior-2k2.toml", run.path / "machine.toml")
    for name in recorded:
        run.save(f"traces/{name}.npz", trace_npz(observed("trace")[0]))
    assert program(["track", "--replay", str(run.path)]) == 9
    printed = capsys.readouterr()
    assert printed.out == "" and "no observations of `track` (traces/track.npz)" in printed.err
    assert f"its traces: {', '.join(recorded) or 'none'}" in printed.err
