# SPDX-License-Identifier: MIT
"""The whole chain: identify, tune, lut, margins, flash, verify, prove; one run directory, resumable at every stage.

A stage that is recorded as passed is not run again. The chain ends at the first stage that does not pass, whatever
it had done is recorded, and the drive is off: experiments run inside the guard, a download rolls back by itself, and
what is left is asked of the statusword.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from pmsmtool.commissioning.compared_stage import check_accepted, compared, contradicted_unmoved, refusal
from pmsmtool.commissioning.contradiction import DATA_SHEET
from pmsmtool.commissioning.design_stages import within_ratings
from pmsmtool.commissioning.level_stages import LevelStages
from pmsmtool.commissioning.report_page import report_page
from pmsmtool.design.lookup.design import LookupRequest
from pmsmtool.design.loops.margins import MarginRequest
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.stop import quick_stop
from pmsmtool.errors import (
    CheckFailed,
    ConfigError,
    IdentificationError,
    Interrupted,
    NotAvailable,
    PmsmtoolError,
    SafetyRefusal,
    VerifyMismatch,
)
from pmsmtool.identification.request import NAMEPLATE, IdentifyRequest
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.measurement.capabilities import Capabilities, reference_capabilities
from pmsmtool.measurement.run_account import RunAccount, begin_run, status_of, text_of
from pmsmtool.plain_text import by_reason
from pmsmtool.proof.stage import ProofRequest, not_proven
from pmsmtool.report.verdict import RAN
from pmsmtool.run_directory import RunDirectory, RunRecord, Stage

FROM_TABLE = TuneRequest(field_weakening="lookup")
"""The chain's default design: the drive takes its current references from the table the chain makes and checks."""
STAGES = ("identify", "tune", "lut", "margins", "flash", "verify", "prove")
GIVEN = "machine_given"
"""Key of a run's request: whether ``nameplate.toml`` was given, or is what the drive held at the start."""


class Person(Protocol):
    """Who consents; each method returns when agreed, else it raises ``Declined``."""

    def allow_motion(self, lines: Sequence[str]) -> None:
        """Agree to the motion envelope."""

    def allow_writing(self, lines: Sequence[str]) -> None:
        """Agree to the list of differences."""


class Progress(Protocol):
    """Who is told how far the chain has come."""

    def skip(self, stage: Stage, number: int, count: int) -> None:
        """Tell how a stage ended that was run before."""

    def begin(self, name: str, number: int, count: int) -> None:
        """Tell that a stage begins."""

    def say(self, text: str) -> None:
        """Tell a step inside the stage."""

    def end(self, stage: Stage, number: int, count: int) -> None:
        """Tell how the stage ended."""


def proof_within(asked: IdentifyRequest) -> ProofRequest:
    """Return the proof that keeps within what identification was allowed."""
    return ProofRequest(asked.i_max_apk, asked.speed_max_rad_s, asked.shaft, asked.load, asked.brake)


def due_stages(run: RunDirectory, record: RunRecord) -> tuple[str, ...]:
    """Return the stages still to be run: from the first that has not passed, or whose files are gone, to the last.

    Raises ConfigError: a file is not what its stage left.
    """
    expected: dict[str, str] = {}
    position = -1
    for k, name in enumerate(STAGES):
        places = [place for place, stage in enumerate(record.stages) if stage.name == name]
        latest = record.stages[places[-1]] if places else None
        fresh = latest is not None and latest.status in SETTLED and places[-1] > position
        if latest is None or not fresh or not all((run.path / file).is_file() for file in latest.files):
            _check_unchanged(run, expected, OUTPUTS.get(name, ()))
            return STAGES[k:]
        position = places[-1]
        expected |= latest.files
    _check_unchanged(run, expected, ())
    return ()


NOTHING_GIVEN = (
    "write a machine file from a data sheet or a meter (`pmsmtool machine new`) and begin anew with it: `pmsmtool "
    "commission MACHINE`; `pmsmtool caps` lists what this drive can measure"
)
NOTHING_TAKEN = (
    "`pmsmtool caps` lists what this drive can measure; `pmsmtool tune MACHINE -o design.toml` designs for the machine "
    "alone"
)
"""Next steps after a run of which nothing was available: the same run gives the same again."""
SETTLED = ("pass", "partial", "not available")
"""How a stage may have ended that is not run again."""
OUTPUTS: Mapping[str, tuple[str, ...]] = {
    "identify": ("machine.toml",),
    "tune": ("design.toml",),
    "lut": ("lut.npz", "lut.csv", "design.toml", "params.toml"),
}
"""Files a stage writes, also half-way: a run that was killed may hold them before they are recorded."""


def _check_unchanged(run: RunDirectory, expected: Mapping[str, str], rewritten: Sequence[str]) -> None:
    changed = [name for name, digest in expected.items() if name not in rewritten and run.sha256(name) != digest]
    if changed:
        raise ConfigError(
            f"{', '.join(changed)}: not what the stage left that wrote it",
            where=str(run.path),
            likely="edited after the run",
            hint="delete the file to have its stage run again, or use tune, lut and flash-params one by one",
        )


@dataclass(slots=True)
class Commissioning:
    """One run of the chain."""

    run: RunDirectory
    """Where everything goes; its record names the drive."""
    drive: CanopenDrive
    """The drive; off."""
    person: Person
    """Gives the two consents."""
    progress: Progress
    """Is told."""
    nameplate: MachineFile | None = None
    """What is known of the machine; the drive's own ratings and set when not given."""
    identify: IdentifyRequest = field(default_factory=IdentifyRequest)
    tune: TuneRequest = FROM_TABLE
    lookup: LookupRequest = field(default_factory=LookupRequest)
    margins: MarginRequest = field(default_factory=MarginRequest)
    prove: ProofRequest | None = None
    """What is asked."""
    capabilities: Capabilities | None = None
    """What a drive below the full level has: its stages run as far as that goes, and those that cannot run are
    recorded as not available. Without, everything is expected, and the chain ends where something is missing."""
    drive_bandwidth_hz: float | None = None
    """Bandwidth of the current control of a drive that keeps its own."""
    accept_contradictions: tuple[str, ...] = ()
    """Quantities of the machine file whose contradiction a person accepts."""
    require: tuple[str, ...] = ()
    """Stages without which the run fails; kept in its record, so that they hold when it is resumed."""
    accept_limits: tuple[str, ...] = ()
    """Limits of the design that are accepted below the machine's ratings (``design_stages.NAMES``)."""
    _account: RunAccount | None = field(default=None, init=False)

    def carry_out(self) -> None:
        """Run what is due.

        Raises PmsmtoolError: whatever ended the chain; it is recorded; StopNotConfirmed: the machine may be energised;
        outranks whatever ended the chain.
        """
        check_accepted(self.accept_contradictions)
        record = self.run.read()
        self._check_drive(record)
        self.require = required_of(record, self.require)
        self.run.write(replace(record, request=self._kept_request(record)))
        self._account = account = RunAccount(self.run, self.progress.say)
        with account.kept():
            try:
                self._refuse_required(record)
                self._carry_out_due(record, account)
            except KeyboardInterrupt:
                raise Interrupted("the machine is off") from None
            finally:
                self._make_sure()

    def _kept_request(self, record: RunRecord) -> dict[str, Any]:
        """Return what a resumed run needs of what was asked; a machine file that is given is kept in the run."""
        kept = {GIVEN: self.nameplate is not None, **record.request}
        if self.nameplate is not None and not (self.run.path / NAMEPLATE).is_file():
            self.run.save(NAMEPLATE, dump_machine_file(self.nameplate))
        return {**kept, "require": self.require} if self.require else kept

    def _carry_out_due(self, record: RunRecord, account: RunAccount) -> None:
        due = due_stages(self.run, record)
        for number, name in enumerate(STAGES, 1):
            if name in due:
                account.begin(name)
                self._carry_out(name, number)
            elif (ended := record.stage(name)) is not None:
                self.progress.skip(ended, number, len(STAGES))
        self._refuse_nothing()

    def _refuse_nothing(self) -> None:
        """Refuse a run of which nothing was available: it is not green."""
        record = self.run.read()
        stages = [stage for name in STAGES if (stage := record.stage(name)) is not None]
        if not any(stage.status in RAN for stage in stages):
            raise NotAvailable(
                "\n  - ".join(["nothing of the chain can be done", *(f"{s.name}: {s.note}" for s in stages)]),
                where=f"node {self.drive.identity.node}",
                hint=NOTHING_GIVEN if self.nameplate is None else NOTHING_TAKEN,
            )

    def _refuse_required(self, record: RunRecord) -> None:
        """Refuse, before anything moves or is written, what cannot give a stage that is required."""
        reasons = self.stages.unavailable()
        reasons |= {stage.name: stage.note for stage in record.stages if stage.status == "not available"}
        lines = [f"{name}: not available: {reasons[name]}" for name in self.require if name in reasons]
        if lines:
            raise _required(lines, self.run)

    def _check_drive(self, record: RunRecord) -> None:
        found = asdict(self.drive.identity)
        wrong = [
            f"{key} {found[key]} instead of {record.drive[key]}" for key in IDENTITY if found[key] != record.drive[key]
        ]
        if wrong:
            raise SafetyRefusal(
                f"another drive answers than the run was begun with: {', '.join(wrong)}",
                where=f"node {self.drive.identity.node}, 0x1018",
                likely="drives were swapped, or this is the run of another drive",
                hint="begin a new run for this drive; nothing was moved and nothing written",
            )
        begun, used = record.drive.get("map", ""), self.drive.node.map.name
        if begun not in ("", used):
            raise ConfigError(
                f"the run was begun with the drive map {begun!r}, and now {used!r} is used",
                where=str(self.run.path),
                likely="--map was given then, and is not now",
                hint="give the same --map, or begin a new run; nothing was moved and nothing written",
            )

    def _carry_out(self, name: str, number: int) -> None:
        clock = self.drive.node.connection.clock
        start, recorded = clock.now(), len(self.run.read().stages)
        try:
            self.progress.begin(name, number, len(STAGES))
            unmoved = contradicted_unmoved(self.drive, self.nameplate, self._found) if name == "identify" else None
            stage = replace(unmoved or self._steps()[name](), seconds=clock.now() - start)
            if name == "identify" and unmoved is None:
                stage = self._compared(self._without_map(stage))
        except BaseException as error:
            if isinstance(error, NotAvailable) and (not self.stages.whole or name in self.stages.unavailable()):
                self._not_available(name, number, error, clock.now() - start)
                return
            # the status says that it was interrupted, the note by what
            note = "by Ctrl-C or another signal" if isinstance(error, KeyboardInterrupt) else text_of(error)
            failed = Stage(name, status_of(error), clock.now() - start, note=note)
            # The error that ended the stage outranks a record that cannot be written.
            with contextlib.suppress(ConfigError):
                if kept := self.run.read().stages[recorded:]:  # with what it had measured
                    failed = kept[-1]
                else:
                    self.run.add(failed)
            self.progress.end(failed, number, len(STAGES))
            raise
        self._settle(stage, number)

    def _settle(self, stage: Stage, number: int) -> None:
        """Record a stage; raises its error where its criteria are not met, or where it is required and missing."""
        self.run.add(stage)
        self.progress.end(stage, number, len(STAGES))
        if stage.status not in SETTLED:
            raise _not_good(stage, self.run)
        if stage.status == "not available" and stage.name in self.require:
            raise _required([f"{stage.name}: not available: {stage.note}"], self.run)

    def _without_map(self, stage: Stage) -> Stage:
        """Return the stage saying that a flux map was asked for and is not there."""
        if "map" not in self.identify.quantities or any(name.startswith("flux_map") for name in stage.files):
            return stage
        return replace(stage, not_checked=[*stage.not_checked, "flux map: asked for, not available, NOT CHECKED"])

    def _compared(self, stage: Stage) -> Stage:
        """Return the stage with data sheet, drive and measurement side by side: the gate before anything is written."""
        known = None if self.nameplate is None else (self.nameplate, DATA_SHEET)
        if known is None and not self.stages.injects:
            known = self.stages.known()
        loaded = self.identify.shaft == "coupled"
        return compared(stage, self.drive, known, loaded=loaded, accept=self.accept_contradictions)

    def _not_available(self, name: str, number: int, error: NotAvailable, seconds: float) -> None:
        files = {file: "" for file in OUTPUTS.get(name, ()) if (self.run.path / file).is_file()}
        self._settle(Stage(name, "not available", seconds, note=error.what, files=files), number)

    @property
    def stages(self) -> LevelStages:
        """The stages at the capability level of the drive."""
        return LevelStages(self.run, self.drive, self._found, self.nameplate, self.drive_bandwidth_hz)

    @property
    def _found(self) -> Capabilities:
        return self.capabilities or reference_capabilities(self.drive.identity)

    def _say(self, line: str) -> None:
        """Tell a line, and the account of the run what it is about."""
        (self.progress if self._account is None else self._account).say(line)

    def _steps(self) -> dict[str, Callable[[], Stage]]:
        say, stages, person = self._say, self.stages, self.person
        asked = self.prove or proof_within(self.identify)
        return {
            "identify": lambda: stages.identify(self.identify, person.allow_motion, say),
            "tune": lambda: within_ratings(self.run, stages.tune(self.tune), self.accept_limits),
            "lut": lambda: stages.lut(self.lookup),
            "margins": lambda: stages.margins(self.margins),
            "flash": lambda: stages.flash(person.allow_writing, say),
            "verify": stages.verify,
            "prove": lambda: stages.prove(asked, person.allow_motion, say),
        }

    def _make_sure(self) -> None:
        """Leave the machine off, confirmed, where this program may have energised it."""
        if self.drive.may_be_energised:
            quick_stop(self.drive.node)


def has_measured(run: RunDirectory) -> bool:
    """Return whether a run holds what is worth keeping: a trace, or an identification that ended by itself."""
    identified = run.read().stage("identify")
    return (identified is not None and identified.status in SETTLED) or any(run.path.glob("traces/*"))


def required_of(record: RunRecord, more: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the stages a run must have: those it was begun with, and more."""
    return tuple(dict.fromkeys((*record.request.get("require", ()), *more)))


def _required(lines: Sequence[str], run: RunDirectory) -> CheckFailed:
    return CheckFailed(
        f"required, and cannot be had: {'; '.join(lines)}",
        where=str(run.path),
        hint="provide what is missing, or begin a new run without --require",
    )


def _not_good(stage: Stage, run: RunDirectory) -> PmsmtoolError:
    """Return the error of a stage whose criteria are not met, with its exit code."""
    broken = [f"{line.what}: {line.measured}, limit {line.limit}" for line in stage.acceptance if not line.ok]
    what = f"{stage.name}: {'; '.join(broken) or stage.note}"
    where = str(run.path)
    if (contradicted := refusal(stage, run)) is not None:
        return contradicted
    if stage.name == "identify":
        what = "; ".join(by_reason(stage.refused.items())) or what
        return IdentificationError("E_NOT_ACCEPTED", what, where=where, hint=NOT_ACCEPTED)
    if stage.name == "verify":
        return VerifyMismatch(what, where=where, hint="flash again: commission --resume " + where)
    if stage.name == "prove":
        return not_proven(stage, run)
    return CheckFailed(what, where=where, hint=f"pmsmtool report {where}")


NOT_ACCEPTED = (
    "where it disagrees with the machine file, correct that; where an interval is too wide, allow more (--i-max, "
    "--speed-max); then begin a new run"
)
IDENTITY = ("vendor", "product", "serial")
"""What must agree before a run is resumed."""


def write_report(run: RunDirectory) -> None:
    """Write ``report.html`` of a run from its files."""
    run.save("report.html", report_page(run.path))


class Silent:
    """A progress nobody is told of."""

    def skip(self, stage: Stage, number: int, count: int) -> None:
        """Say nothing."""

    def begin(self, name: str, number: int, count: int) -> None:
        """Say nothing."""

    def say(self, text: str) -> None:
        """Say nothing."""

    def end(self, stage: Stage, number: int, count: int) -> None:
        """Say nothing."""


def commission(
    drive: CanopenDrive,
    runs: Path,
    person: Person,
    *,
    progress: Progress | None = None,
    nameplate: MachineFile | None = None,
    identify: IdentifyRequest | None = None,
    tune: TuneRequest | None = None,
    capabilities: Capabilities | None = None,
) -> RunDirectory:
    """Take a drive from unknown machine to proven parameters, in a new run directory with its report.

    Parameters
    ----------
    drive : CanopenDrive
        The drive; off.
    runs : Path
        Folder of the run directories.
    person : Person
        Consents to every motion and to the differences.
    progress : Progress, optional
        Is told.
    nameplate : MachineFile, optional
        What is known of the machine; the drive's own ratings and set when not given.
    identify, tune : optional
        What is asked; the defaults of their classes.
    capabilities : Capabilities, optional
        Of a drive below the full level (``measurement.capabilities.examine``,
        ``measurement.identify.open_for_level``).

    Raises
    ------
    PmsmtoolError
        Whatever ended the chain; it is recorded and reported, and :meth:`Commissioning.carry_out` goes on there.
    """
    run = begin_run(drive, runs)
    chain = Commissioning(
        run, drive, person, progress or Silent(), nameplate, identify or IdentifyRequest(), tune or FROM_TABLE,
        capabilities=capabilities,
    )  # fmt: skip
    try:
        chain.carry_out()
    except BaseException:
        with contextlib.suppress(Exception):  # what ended the chain outranks a page that cannot be written
            write_report(run)
        raise
    write_report(run)
    return run
