# SPDX-License-Identifier: MIT
"""The run directory ``runs/<utc>-<serial>/``: the record of what was done to one drive.

``run.json`` carries the date, the operator, the drive, the versions, both consents and one entry per stage; the
files beside it (``traces/``, ``machine.toml``, ``design.toml``, ``params.toml``, ``lut.npz``, ``report.html``)
are what the stages left. Every later command takes the directory, and a stage that is recorded as passed is not
run again. The record is replaced as a whole after every stage, never half written.
"""

from __future__ import annotations

import datetime
import getpass
import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

from pmsmtool.errors import ConfigError
from pmsmtool.files import ROWS_BYTES, read_text, refuse_full, write_file

SCHEMA = "pmsmtool.run/1"
RECORD = "run.json"
RUN_ROOM = 8 << 20
"""Bytes that the folder of a run must take before anything moves: a commissioning leaves 2.7 to 5 MB."""
_OTHER_FOLDER = "choose another folder with --runs DIR"
_OTHER_RUN = "this run cannot be read or continued: give another one, or begin anew"

Status = Literal["pass", "partial", "fail", "refused", "interrupted", "not available"]


@dataclass(frozen=True, slots=True)
class Acceptance:
    """One criterion of a stage: what was asked, what was measured, whether it holds."""

    what: str
    measured: str
    limit: str
    ok: bool


@dataclass(frozen=True, slots=True)
class Stage:
    """What one stage did."""

    name: str
    """``identify``, ``tune``, ``lut``, ``margins``, ``flash``, ``verify`` ..."""
    status: Status
    """``pass`` only when every acceptance holds; ``partial``: they hold, but something asked for could not be had;
    ``not available``: the drive lacks what ``note`` names."""
    seconds: float
    """Time the stage took on the bus clock (s)."""
    values: Sequence[Mapping[str, Any]] = ()
    """Estimates or results: ``name value std systematic unit`` and whatever else the stage knows, SI."""
    acceptance: Sequence[Acceptance] = ()
    """The criteria the status follows from."""
    fallbacks: Sequence[str] = ()
    """Every fallback that was taken, one line each."""
    files: Mapping[str, str] = field(default_factory=dict)
    """File name in the run directory -> SHA-256 of its bytes."""
    note: str = ""
    """The error text of a stage that did not pass."""
    summary: str = ""
    """What a person reads in the one line of the stage."""
    comparison: Sequence[Mapping[str, Any]] = ()
    """Rows *data sheet | drive | measured* (``commissioning/contradiction.py``)."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """Quantity that was asked for and is not given -> its reason."""
    not_checked: Sequence[str] = ()
    """What the result follows from and this run did not check (``R_s_ohm: data sheet, NOT CHECKED``): each line stands
    in the headline of the report, and the verdict on a commissioning is then at most partial."""
    accepted: Sequence[str] = ()
    """What a person accepted although it is outside a limit, with the option that says so; on the first screen."""


@dataclass(frozen=True, slots=True)
class RunRecord:
    """Content of ``run.json``; it is signed off by a person, so it carries date and operator.

    ``account`` says how the run ended (:class:`pmsmtool.measurement.run_account.Account`).
    """

    started_utc: str
    operator: str
    command: Sequence[str]
    versions: Mapping[str, str]
    drive: Mapping[str, Any]
    bus: Mapping[str, Any]
    envelope: Mapping[str, Any] = field(default_factory=dict)
    consents: Sequence[Mapping[str, Any]] = ()
    instruments: Sequence[str] = ()
    stages: Sequence[Stage] = ()
    request: Mapping[str, Any] = field(default_factory=dict)
    account: Mapping[str, Any] = field(default_factory=dict)
    schema: str = SCHEMA

    def stage(self, name: str) -> Stage | None:
        """Return the latest entry of a stage, or None when it has not been run."""
        return next((stage for stage in reversed(self.stages) if stage.name == name), None)

    def passed(self, name: str) -> bool:
        """Return whether the latest entry of a stage is a pass."""
        stage = self.stage(name)
        return stage is not None and stage.status == "pass"


@dataclass(frozen=True, slots=True)
class RunDirectory:
    """One run directory on disk."""

    path: Path

    @classmethod
    def create(cls, parent: Path, serial: int, record: RunRecord) -> RunDirectory:
        """Make ``parent/<utc>-<serial>`` with its record; a second run in the same second gets a suffix.

        Raises ConfigError: if the directory cannot be made or written.
        """
        refuse_full(parent, RUN_ROOM, hint=_OTHER_FOLDER)
        stem = f"{record.started_utc.replace(':', '').replace('-', '')}-{serial:08x}"
        for attempt in range(100):
            path = parent / (stem if attempt == 0 else f"{stem}-{attempt}")
            try:
                (path / "traces").mkdir(parents=True, exist_ok=False)
            except FileExistsError:
                continue
            run = cls(path)
            run.write(record)
            return run
        raise ConfigError(
            f"a hundred runs started in the same second under {parent}",
            where=str(parent),
            hint="give another folder with --runs",
        )

    def read(self) -> RunRecord:
        """Return the record. Raises ConfigError: if there is no record, or it is not one of ours."""
        path = self.path / RECORD
        hint = "give a directory that identify or commission made"
        if not path.exists():
            what = f"no {RECORD} here" if self.path.exists() else "no such folder"
            if runs := sorted(self.path.glob(f"*/{RECORD}")):
                what, hint = "this is a folder of runs", f"give one of them; the newest is {runs[-1].parent}"
            raise ConfigError(what, where=str(self.path), hint=hint)
        text = read_text(path, largest=ROWS_BYTES, hint=hint)
        try:
            raw = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ConfigError(f"the record cannot be read: {error}", where=str(path), hint=_OTHER_RUN) from error
        if not isinstance(raw, dict) or raw.get("schema") != SCHEMA:
            raise ConfigError(f"the record is not of schema {SCHEMA}", where=str(path), hint=_OTHER_RUN)
        wrong = _shape_violations(raw, RunRecord)
        for k, entry in enumerate(raw["stages"] if isinstance(raw.get("stages"), list) else ()):
            wrong += [f"stages[{k}] {text}" for text in _stage_violations(entry)]
        if wrong:
            raise ConfigError(
                "the record is damaged", where=str(path), likely="it was edited", hint=_OTHER_RUN, violations=wrong
            )
        raw["stages"] = tuple(_stage(entry) for entry in raw.get("stages", ()))
        return RunRecord(**raw)

    def write(self, record: RunRecord) -> None:
        """Replace the record in one step (write beside it, sync, rename)."""
        text = json.dumps(asdict(record), indent=1, allow_nan=True) + "\n"
        write_file(self.path / RECORD, text, synced=True, hint=_OTHER_FOLDER)

    def save(self, name: str, content: bytes | str) -> None:
        """Put a file into the run, in one step; raises ``ConfigError`` when it cannot be written."""
        write_file(self.path / name, content, hint=_OTHER_FOLDER)

    def add(self, stage: Stage) -> None:
        """Append a stage to the record, with the hashes of the files it names."""
        record = self.read()
        hashed = {name: self.sha256(name) for name in stage.files}
        self.write(replace(record, stages=(*record.stages, replace(stage, files=hashed))))

    def sha256(self, name: str) -> str:
        """Return the SHA-256 of a file of this run (hex)."""
        return hashlib.sha256((self.path / name).read_bytes()).hexdigest()


def new_record(
    command: Sequence[str],
    *,
    drive: Mapping[str, Any],
    bus: Mapping[str, Any],
    versions: Mapping[str, str],
    operator: str | None = None,
    instruments: Sequence[str] = (),
) -> RunRecord:
    """Return a record that starts now, signed with the login name unless an operator is given."""
    now = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    return RunRecord(
        started_utc=now.isoformat().replace("+00:00", "Z"),
        operator=operator if operator is not None else _login_name(),
        command=tuple(command),
        versions={"python": platform.python_version(), **versions},
        drive=dict(drive),
        bus=dict(bus),
        instruments=tuple(instruments),
    )


def _login_name() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return "unknown"


def _stage(entry: Mapping[str, Any]) -> Stage:
    values = dict(entry)
    values["acceptance"] = tuple(Acceptance(**line) for line in values.get("acceptance", ()))
    return Stage(**values)


_SHAPES: dict[str, tuple[type, ...]] = {
    "str": (str,), "Status": (str,), "bool": (bool,), "float": (int, float),
    "Mapping": (dict,), "Sequence": (list,),
}  # fmt: skip
"""Annotation of a field -> what JSON has in its place."""


def _shape_violations(table: Any, kind: type) -> list[str]:
    """Return which fields of a record are missing, unknown or of another type."""
    if not isinstance(table, dict):
        return ["is not a table"]
    wrong = [f"{name}: unknown" for name in table if name not in {item.name for item in fields(kind)}]
    for item in fields(kind):
        shape = str(item.type).split("[")[0]
        if item.name not in table:
            if item.default is MISSING and item.default_factory is MISSING:
                wrong.append(f"{item.name} is missing")
        elif not isinstance(table[item.name], _SHAPES[shape]) or (shape == "float" and table[item.name] is True):
            wrong.append(f"{item.name} is {type(table[item.name]).__name__}, not {shape}")
        elif (str(item.type) == "Sequence[str]" and not all(isinstance(text, str) for text in table[item.name])) or (
            str(item.type) == "Mapping[str, str]" and not all(isinstance(t, str) for t in table[item.name].values())
        ):
            wrong.append(f"{item.name} holds other things than texts")
        elif str(item.type) == "Sequence[Mapping[str, Any]]" and not all(isinstance(t, dict) for t in table[item.name]):
            wrong.append(f"{item.name} holds other things than tables")
    return wrong


def _stage_violations(entry: Any) -> list[str]:
    """Return what is wrong with one stage: types, a status that there is not, values without their numbers."""
    wrong = _shape_violations(entry, Stage)
    if wrong:
        return wrong
    if entry["status"] not in get_args(Status):
        wrong.append(f"status = {entry['status']!r} is not one of {', '.join(get_args(Status))}")
    for k, line in enumerate(entry.get("acceptance", ())):
        wrong += [f"acceptance[{k}]: {text}" for text in _shape_violations(line, Acceptance)]
    for k, value in enumerate(entry.get("values", ())):
        numbers = ("value", "std", "systematic") if "std" in value else ("value",) if "source" in value else ()
        known = [name for name in ("coverage_factor", "T_c") if value.get(name) is not None]
        wrong += [
            f"values[{k}]: {name} is not a number"
            for name in (*numbers, *known)
            if type(value.get(name)) not in (int, float)
        ]
        if numbers and not (isinstance(value.get("name"), str) and isinstance(value.get("unit"), str)):
            wrong.append(f"values[{k}]: without a name, or without a unit")
    return wrong
