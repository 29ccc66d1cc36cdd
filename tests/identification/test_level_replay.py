# SPDX-License-Identifier: MIT
"""``identify --replay`` at lower capability levels: the same numbers from the stored traces, others where asked."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from click.testing import CliRunner

from pmsmtool.bus.connect import Connection
from pmsmtool.cli.main import cli
from pmsmtool.commissioning.commission import begin_run
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.errors import ConfigError, Declined, NotAvailable, Partial
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.files import data_folder
from pmsmtool.identification.by_pulses import FACTS, OLDER_FACTS, PulseFacts, below_voltage, read_facts
from pmsmtool.identification.by_vendor import ANSWERS
from pmsmtool.identification.replay import replay
from pmsmtool.identification.request import MACHINE, NAMEPLATE, REPLAYED, IdentifyRequest, Method
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.measurement.capabilities import Capabilities, examine
from pmsmtool.measurement.identify import OF_LEVEL, identify, open_for_level
from pmsmtool.run_directory import RunDirectory, Stage
from pmsmtool.sim.bus import PmsmSimBus

pytestmark = pytest.mark.chain

PROFILE = data_folder("profiles") / "interior-2k2.toml"
ASKED = ("poles", "encoder", "psi", "mechanics")
SHEET = "as given"


@contextmanager
def opened(options: str) -> Iterator[tuple[CanopenDrive, Capabilities]]:
    with Connection(PmsmSimBus(f"interior-2k2?nv=:memory:{options}")) as connection:
        node = DriveNode(connection, 1)
        found = examine(node)
        node.close()
        drive = open_for_level(connection, 1, found)
        yield drive, found
        drive.close()


def measured(
    options: str, folder: Path, quantities: tuple[str, ...], known: MachineFile | None = None, **limits: object
) -> tuple[RunDirectory, Stage]:
    request = IdentifyRequest(quantities, **limits)  # type: ignore[arg-type]
    with opened(options) as (drive, found):
        run = begin_run(drive, folder, level=found.level)
        if known is not None:
            run.save(NAMEPLATE, dump_machine_file(known))
        pair = None if known is None else (known, SHEET)
        method = OF_LEVEL[found.level]
        stage = identify(run, drive, request, lambda lines: None, method=method, found=found, known=pair)
    run.add(stage)
    return run, stage


def told(stage: Stage) -> str:
    return json.dumps([list(stage.values), stage.summary, stage.status, list(stage.fallbacks)])


@pytest.mark.parametrize(("method", "told"), [(Method.RECORDER, "recorded"), (Method.STANDARD, "polled")])
def test_the_method_asked_for_is_the_one_that_runs(method: Method, told: str, tmp_path: Path) -> None:
    """A drive with a recorder was always pushed by recorded pulses, one with injection by polled ones."""
    lines: list[str] = []

    def declined(plan: Sequence[str]) -> None:
        lines.extend(plan)
        raise Declined("no")

    for options in ("&level=recorder", ""):
        with opened(options) as (drive, found), pytest.raises(Declined):
            request = IdentifyRequest(("psi", "mechanics"), speed_max_rad_s=100.0)
            known = load_machine_file(PROFILE), SHEET
            identify(RunDirectory(tmp_path), drive, request, declined, method=method, found=found, known=known)
    assert sum(f"{told} torque pulses" in line for line in lines) == 2 and not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def recorded_once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Stage]:
    """A run of the recorder level with a machine file."""
    folder = tmp_path_factory.mktemp("recorded")
    run, stage = measured("&level=recorder", folder, ("R", "psi", "L"), load_machine_file(PROFILE))
    return run.path, stage


@pytest.fixture
def recorded(recorded_once: tuple[Path, Stage], tmp_path: Path) -> tuple[RunDirectory, Stage]:
    """A copy of it."""
    shutil.copytree(recorded_once[0], tmp_path / "run")
    return RunDirectory(tmp_path / "run"), recorded_once[1]


def test_a_run_of_the_recorder_level_gives_the_same_bytes(recorded: tuple[RunDirectory, Stage]) -> None:
    assert_replayed(*recorded)


def test_a_run_with_the_older_name_of_its_facts_is_replayed(recorded: tuple[RunDirectory, Stage]) -> None:
    run, stage = recorded
    (run.path / FACTS).rename(run.path / OLDER_FACTS)
    again = replay(run)
    assert told(again) == told(stage) and OLDER_FACTS in again.files and FACTS not in again.files


def test_a_run_of_the_standard_level_gives_the_same_bytes(tmp_path: Path) -> None:
    assert_replayed(*measured("&drive=cia402", tmp_path, ASKED, load_machine_file(PROFILE)))


def assert_replayed(run: RunDirectory, stage: Stage) -> None:
    """Replay a run with a machine file, with its own and with other tolerances."""
    before = {name: (run.path / name).read_bytes() for name in (MACHINE, "run.json", FACTS)}
    again = replay(run)
    assert told(again) == told(stage) and "psi_f_wb" in told(stage)
    assert {name: (run.path / name).read_bytes() for name in before} == before

    wider = replay(run, SensorTolerance(current_gain=0.03, voltage_gain=0.03))
    psi, doubted = ({v["name"]: v for v in s.values}["psi_f_wb"] for s in (again, wider))
    assert doubted["value"] == psi["value"] and doubted["systematic"] > 1.2 * psi["systematic"]
    assert (run.path / MACHINE).read_bytes() != before[MACHINE]
    assert told(run.read().stage("identify")) == told(wider)  # type: ignore[arg-type]

    used = (run.path / MACHINE).read_bytes()
    run.save("design.toml", "made from it")
    narrow = replay(run, SensorTolerance(current_gain=0.001, voltage_gain=0.001))
    assert (run.path / MACHINE).read_bytes() == used and f"{REPLAYED}/{MACHINE}" in narrow.files
    assert told(run.read().stage("identify")) == told(wider)  # type: ignore[arg-type]


def test_a_run_without_a_machine_file_is_replayed_from_the_command_line(tmp_path: Path) -> None:
    """Slow on purpose: the voltage limit is not reached, and what it needs is said with numbers."""
    left = {"L": "E_NOT_MEASURED: by inject needs current set-points"}  # asked for beside the others
    run, stage = measured("&drive=cia402", tmp_path, ASKED, speed_max_rad_s=60.0, left_out=left)
    assert not any(line.startswith("L_d_h, L_q_h") for line in stage.fallbacks), "said once, as refused"
    assert not (run.path / MACHINE).exists()
    needed = "up to 561 rpm it was not: allow a larger --speed-max"
    assert any(needed in line for line in stage.fallbacks) and needed in stage.summary
    outcome = CliRunner().invoke(cli, ["--json", "identify", "--replay", str(run.path)])
    assert isinstance(outcome.exception, Partial) and "run.json" in outcome.exception.hint
    assert stage.status == "partial" and list(stage.refused) == ["psi", "L"] and needed in stage.refused["psi"]
    shown = json.loads(outcome.stdout)
    assert shown["values"] == json.loads(told(stage))[0] and shown["refused"]["L"] == left["L"]

    facts = read_facts(run)
    assert facts is not None
    assert facts.traces[:2] == ("rotation_forward", "rotation_backward") and facts.pushed and facts.voltage == "link"
    run.save(FACTS, "{}")
    with pytest.raises(ConfigError, match="the record of the capability level is damaged"):
        replay(run)
    run.save(ANSWERS, "{}")
    with pytest.raises(ConfigError, match="nothing of that can be recomputed"):
        replay(run)


def test_what_the_flux_linkage_needs_is_a_speed_in_numbers() -> None:
    facts = PulseFacts(Method.STANDARD, pole_pairs=3, pushed=True, voltage="link", top_rpm=1000.0, U_dc_v=540.0)
    text = below_voltage(facts, 0.5, 0.5)
    assert "up to 1000 rpm it was not" in text and "that is at about 1719 rpm with 540 V" in text  # 540 / 2 / 0.5 / 3
    assert "given flux linkage" not in below_voltage(facts, 0.5, 0.0)


def test_an_instrument_scales_what_a_recorder_told(recorded: tuple[RunDirectory, Stage]) -> None:
    """Voltage and current as the instruments have them: psi goes with the voltage, R and L_q with their ratio."""
    run, stage = recorded
    plain = {row["name"]: row for row in stage.values}
    again = replay(run, None, ["V_dc=560V:554.4V:0.5V", "I=5Apk:5.05Apk:0.1%"])
    scaled = {row["name"]: row for row in again.values}
    assert scaled["psi_f_wb"]["value"] / plain["psi_f_wb"]["value"] == pytest.approx(0.99, rel=1e-3)
    assert scaled["R_s_ohm"]["value"] / plain["R_s_ohm"]["value"] == pytest.approx(0.99 / 1.01, rel=1e-3)
    assert scaled["psi_f_wb"]["systematic"] < 0.8 * plain["psi_f_wb"]["systematic"]
    with pytest.raises(NotAvailable, match="did not record"):
        replay(run, None, ["bridge=1V:1.2V:0.2V"])
