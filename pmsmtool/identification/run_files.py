# SPDX-License-Identifier: MIT
"""The files of an identification in its run: traces, machine file, and the records of what went on meanwhile."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pmsmtool.errors import ConfigError, IdentificationError
from pmsmtool.files import make_folder
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.run_directory import RunDirectory, RunRecord
from pmsmtool.trace import Trace
from pmsmtool.trace_file import read_trace

MACHINE = "machine.toml"
NAMEPLATE = "nameplate.toml"
REPLAYED = "replayed"
"""Folder of a run for what a replay makes of it once a design stands on its machine file."""
_MADE_FROM_MACHINE = ("design.toml", "params.toml")
PREDICTED = "predicted.json"
"""What was said before the machine moved."""
SCHEMA = "pmsmtool.predicted/1"


def read_run(path: Path) -> tuple[RunRecord, MachineFile]:
    """Return the record of a run and the machine it identified; raises ``ConfigError`` where it identified none."""
    record = RunDirectory(path).read()
    if not (path / MACHINE).is_file():
        raise ConfigError(
            f"the run has no {MACHINE}: nothing was identified",
            where=str(path),
            hint="`pmsmtool report RUN` says how it ended",
        )
    return record, load_machine_file(path / MACHINE)


def entry(before: str, relative_std: Mapping[str, float], **more: object) -> dict[str, Any]:
    """Return one prediction: before which experiment it was said, and relative standard deviations by key."""
    return {"before": before, "relative_std": dict(relative_std), **more}


def dump_predicted(entries: list[dict[str, Any]]) -> str:
    """Return the file's text."""
    return json.dumps({"schema": SCHEMA, "predictions": entries}, indent=1) + "\n"


REFUSED = "refused.json"
"""Experiments that ended before their traces were whole, by the keys of ``evaluate.Evaluation.refused``."""


def dump_refused(refused: Mapping[str, IdentificationError]) -> str:
    """Return refusals as JSON."""
    facts = {
        name: {"reason": e.reason, "what": e.what.partition(": ")[2], "where": e.where, "likely": e.likely,
               "hint": e.hint}
        for name, e in refused.items()
    }  # fmt: skip
    return json.dumps(facts, indent=1) + "\n"


def refused_in(run: RunDirectory) -> dict[str, IdentificationError]:
    """Return the refusals of a run; raises ``ConfigError`` where their record is damaged."""
    path = run.path / REFUSED
    if not path.is_file():
        return {}
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
        return {name: IdentificationError(**error) for name, error in facts.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise ConfigError(
            f"the record of what was refused is damaged: {error}", where=str(path), hint="identify again"
        ) from error


def place_of(run: RunDirectory, text: str) -> tuple[RunDirectory, str]:
    """Return where a machine file goes, and the beginning of its name in the run: beside one a design was made from."""
    return (run, "") if _may_write(run, text) else (_beside(run), f"{REPLAYED}/")


def _may_write(run: RunDirectory, text: str) -> bool:
    """Whether a machine file may stand in the run: nothing was made from it yet, or it is the one that was used."""
    if not any((run.path / name).is_file() for name in _MADE_FROM_MACHINE):
        return True
    recorded = run.read().stage("identify")
    used = run.sha256(MACHINE) if (run.path / MACHINE).is_file() else recorded and recorded.files.get(MACHINE)
    return hashlib.sha256(text.encode()).hexdigest() == used


def _beside(run: RunDirectory) -> RunDirectory:
    folder = run.path / REPLAYED
    make_folder(folder, hint="check your rights there and the space on the disk")
    return RunDirectory(folder)


def stored_traces(run: RunDirectory) -> dict[str, Trace]:
    """Return the traces of a run by name."""
    return {path.stem: read_trace(path) for path in trace_files(run)}


def trace_files(run: RunDirectory) -> list[Path]:
    """Return the files of the traces of a run, by name."""
    return sorted((run.path / "traces").glob("*.npz"))
