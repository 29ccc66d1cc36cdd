# SPDX-License-Identifier: MIT
"""The file that owners of real drives send: what is in it, and what must not be, whatever the run says."""

from __future__ import annotations

import getpass
import json
import math
import platform
import random
import string
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pmsmtool.cli.main import run as program
from pmsmtool.commissioning.anonymous import DIGITS, anonymous_run, anonymous_text
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file, machine_path
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.run_directory import Acceptance, RunDirectory, RunRecord, Stage, new_record
from pmsmtool.trace import Trace, trace_npz

SERIAL = 0x5EC2E7A1
BEGAN_S = 1_795_446_123.25
"""A clock that counts from 1970 says when the run was made."""


class Namer:
    """Random names, each kept to be looked for."""

    def __init__(self, seed: int) -> None:
        self.rng, self.given = random.Random(seed), list[str]()

    def __call__(self) -> str:
        body = "".join(self.rng.choice(string.ascii_letters + string.digits + " _-./\\@é") for _ in range(9))
        self.given.append(f"Zq{body}7Kw")
        return self.given[-1]

    def everywhere(self, value: Any) -> Any:
        """Put a name in place of every text, and one more behind a new key of every free table."""
        if isinstance(value, str):
            return self()
        if isinstance(value, dict):
            return {key: self.everywhere(part) for key, part in value.items()} | {self(): self()}
        if isinstance(value, list | tuple):
            return [self.everywhere(part) for part in value] + [self()] * (len(value) > 0 and isinstance(value[0], str))
        return value


def row(**more: Any) -> dict[str, Any]:
    return {"name": "J_per_psi", "value": 0.0275, "std": 1e-4, "systematic": 2e-4, "unit": "kg m2/Wb", **more}


def made(folder: Path, name: Namer | None = None) -> Path:
    """Make a run of every kind of record; with names in all its free texts."""
    text = name if name is not None else (lambda: "plain")
    drive = {"node": 5, "vendor": 0xFB, "product": 0x65510000, "revision": 0x01700000, "serial": SERIAL, "name": text(),
             "hardware": text(), "software": text(), "level": "standard", "map": "epos4"}  # fmt: skip
    versions = {"pmsmtool": "0.1.0", "numpy": text()}
    record = new_record([text(), text()], drive=drive, bus={"interface": "socketcan", "channel": text()},
                        versions=versions, operator=text(), instruments=[text()])  # fmt: skip
    record = replace(record, consents=[{"subject": "motion", "text": [text()]}], request={"machine": text()})
    stage = Stage(
        "identify", "partial", 12.5, values=[row(source="standard"), row(name="R_s_ohm", object="0x30A0:01")],
        acceptance=[Acceptance(text(), text(), text(), True), Acceptance(text(), text(), text(), False)],
        fallbacks=[text()], note=f"{text()}: E_NOT_IDENTIFIABLE {text()}", summary=text(),
        refused={"L": f"E_SNR: {text()}", text(): text()}, not_checked=[text()], accepted=[text()],
    )  # fmt: skip
    if name is not None:
        free = {"drive", "bus", "envelope", "consents", "instruments", "request", "account", "command", "versions"}
        whole = {key: name.everywhere(part) if key in free else part for key, part in asdict(record).items()}
        numbers = {key: value for key, value in drive.items() if isinstance(value, int)}
        record = RunRecord(**{**whole, "operator": name(), "drive": {**whole["drive"], **numbers}, "stages": ()})
        rows = [{**name.everywhere(part), "name": name(), "unit": name()} for part in stage.values]
        stage = replace(
            stage, name=name(), values=[*rows, row()], comparison=[name.everywhere(row(text="", verdict=""))]
        )
    run = RunDirectory.create(folder, SERIAL, record)
    machine = load_machine_file(machine_path("interior-2k2"))
    machine = replace(machine, name=text(), provenance={"by": text()}, conditions={"bench": text()})
    run.save("machine.toml", dump_machine_file(machine))
    provenance = {"motor.R_s_ohm": text()}
    run.save("params.toml", ParameterSet({"motor.R_s_ohm": 0.123456789}, {}, provenance, text()).to_toml())
    run.save("notes.txt", text())
    t_s = BEGAN_S + 1e-3 * np.arange(3)
    signals = {"i_q_a": np.array([1.0, 2.0, math.nan]), text().replace("\\", "").replace("/", ""): np.arange(3.0)}
    trace = Trace(t_s, signals, dict.fromkeys(signals, "A"), {"decimation": 2, "began": BEGAN_S, text(): text()})
    for stem in ("torque_push_0", text().replace("/", "").replace("\\", "")):
        run.save(f"traces/{stem}.npz", trace_npz(trace))
    run.write(replace(run.read(), stages=(stage,)))
    return run.path


def test_it_holds_what_a_drive_did(tmp_path: Path) -> None:
    found = anonymous_run(made(tmp_path))
    assert found["drive"] == {"vendor": 0xFB, "product": 0x65510000, "revision": 0x01700000, "level": "standard",
                              "map": "epos4"}  # fmt: skip
    (stage,) = found["stages"]
    assert (stage["stage"], stage["status"], stage["criteria"]) == ("identify", "partial", [True, False])
    assert stage["reason"] == "E_NOT_IDENTIFIABLE" and stage["refused"]["L"] == "E_SNR"
    assert stage["values"][0] == {"name": "J_per_psi", "value": 0.0275, "std": 1e-4, "systematic": 2e-4,
                                  "unit": "kg m2/Wb", "method": "standard"}  # fmt: skip
    assert stage["values"][1]["object"] == "0x30A0:01"
    assert found["machine"]["machine"]["R_s_ohm"] == 3.6 and found["parameters"] == {"motor.R_s_ohm": 0.123456789}
    trace = found["traces"]["torque_push_0"]
    assert trace["signals"]["i_q_a"] == [1.0, 2.0, None] and trace["facts"] == {"decimation": 2.0}
    assert trace["t_s"] == pytest.approx([0.0, 1e-3, 2e-3], abs=1e-6)
    assert found["interface"] == "socketcan" and found["verdict"] in ("partial", "fail")


@pytest.mark.parametrize("seed", range(20))
def test_no_name_of_the_run_is_in_it(tmp_path: Path, seed: int) -> None:
    """Random names in every free text, key, file and signal of the run; the file is opened and searched."""
    name = Namer(seed)
    path = made(tmp_path / "Zqsecretfolder7Kw", name)
    text = anonymous_text(path)
    assert len(name.given) > 60
    leaked = [given for given in [*name.given, "Zq", "7Kw"] if given.lower() in text.lower()]
    assert leaked == []
    record = RunDirectory(path).read()
    forbidden = [str(SERIAL), f"{SERIAL:x}", f"{SERIAL:X}", str(int(BEGAN_S)), record.started_utc[:10], path.name]
    forbidden += [getpass.getuser() + "@", platform.node() or "-host-", str(Path.home()), "/", "\\\\"]
    own = {f'"{unit}"' for unit in ("kg m2/Wb", "rad/s", "N m/Wb", "pmsmtool.anonymous/1")}
    searched = text
    for word in own:
        searched = searched.replace(word, "")
    assert [word for word in forbidden if word in searched] == []
    assert all(len(f"{number:.17g}") <= 24 for number in numbers_in(json.loads(text)))


def numbers_in(value: Any) -> list[float]:
    if isinstance(value, dict):
        return [number for part in value.values() for number in numbers_in(part)]
    if isinstance(value, list):
        return [number for part in value for number in numbers_in(part)]
    return [value] if isinstance(value, int | float) and not isinstance(value, bool) else []


def test_numbers_that_are_no_measurement_are_not_in_it(tmp_path: Path) -> None:
    """A number in a field that holds none of the drive's: a licence, a telephone number, the node id."""
    path = made(tmp_path)
    run = RunDirectory(path)
    record = run.read()
    stage = replace(record.stages[0], values=[row(phone=49_123_456_789.0)])
    strange = {"vendor": "251", "product": True, "revision": -1, "serial": 4711_4711, "plant": 20_391}
    run.write(replace(record, drive=strange, stages=(stage,), request={"inventory": 918_273.0}))
    found = anonymous_run(path)
    assert found["drive"] == {}
    for number in (49_123_456_789.0, 4711_4711, 20_391, 918_273.0):
        assert number not in numbers_in(found)


def test_the_command_writes_one_file_that_can_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = made(tmp_path)
    assert program(["report", "--anonymous", str(path)]) == 0
    assert "no names" in capsys.readouterr().out
    text = (path / "anonymous.json").read_text(encoding="utf-8")
    assert json.loads(text)["schema"] == "pmsmtool.anonymous/1"
    assert program(["report", "--anonymous", str(path), "-o", str(tmp_path / "send.json"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["traces"] == 2
    assert (tmp_path / "send.json").read_text(encoding="utf-8") == text, "the same run, the same bytes"
    assert not (path / "report.html").exists()
    assert DIGITS == 9
