# SPDX-License-Identifier: MIT
"""The chain's stages: each runs as far as drive and map go, or says what it needs.

A stage that cannot run raises ``NotAvailable``; the chain records it as not available and goes on. What runs is judged
by the same criteria as on the reference drive.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from pmsmtool.commissioning.design_stages import (
    LIMITS,
    closed_stage,
    guaranteed,
    lut_stage,
    margins_stage,
    tune_stage,
    why_no_limits,
)
from pmsmtool.commissioning.flash_stages import flash_stage, verify_stage
from pmsmtool.design.design_file import load_design
from pmsmtool.design.lookup.design import LookupRequest
from pmsmtool.design.loops.designed_loops import CURRENT_LOOPS, lacking_gains
from pmsmtool.design.loops.margins import MarginRequest
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.errors import ConfigError, IdentificationError, NotAvailable
from pmsmtool.flash.download import NO_STORE
from pmsmtool.flash.journal import JournalFolder
from pmsmtool.flash.map_gate import check_map
from pmsmtool.identification.by_pulses import NO_POLE_PAIRS, TOO_WIDE
from pmsmtool.identification.completed_machine import NEEDED, completed_machine
from pmsmtool.identification.request import MACHINE, NAMEPLATE, QUANTITIES, IdentifyRequest, Method
from pmsmtool.identification.verdicts import blocking
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.measurement.by_injection import nameplate_of, with_own_encoder
from pmsmtool.measurement.by_pulses import OVER_TORQUE_CONSTANT, measurable
from pmsmtool.measurement.by_vendor import vendor_line
from pmsmtool.measurement.capabilities import Capabilities, CapabilityLevel
from pmsmtool.measurement.identify import OF_LEVEL, SET_UP, identify, identify_after_drive
from pmsmtool.measurement.limits import Allow, Say
from pmsmtool.params.parameter_set import read_parameter_set
from pmsmtool.proof.plan import HALLS_ALONE
from pmsmtool.proof.stage import ProofRequest, prove_stage
from pmsmtool.report.verdict import ENCODER_SIGN
from pmsmtool.run_directory import RunDirectory, Stage

DATA_SHEET = "as given"
NO_AVERAGES = "means are made from records: the drive has no averages"
RECORDER_STEPS = ("speed_step",)
"""Experiments of a proof that need no excitation: a speed reference while the drive records."""
PREDICTED = ("speed.K_p_nms_per_rad", "speed.filter_hz")
"""What a predicted speed step stands on besides the gains of the current loops."""
NO_STEPS = "the drive's responses cannot be recorded: needs set-points for d and q, and a recorder at loop rate"
NOT_SHOWN = (
    "; the guarantee of its limits bounds a voltage that it does not record (on a simulated node: `pmsmtool reproduce "
    "closed-drive`)"
)
FOR_READING = "the drive has no object for the table"


@dataclass(frozen=True, slots=True)
class LevelStages:
    """The stages of one run on one drive."""

    run: RunDirectory
    """Where everything goes."""
    drive: CanopenDrive
    """As ``identify.open_for_level`` gives it."""
    found: Capabilities
    """What the drive has."""
    nameplate: MachineFile | None
    """What is known of the machine."""
    drive_bandwidth_hz: float | None = None
    """Bandwidth of the current control of a drive that keeps its own, where it is known."""

    @property
    def whole(self) -> bool:
        """Whether every stage is expected: at the full level, and where it lacks only what makes motion safe."""
        return self.found.level is CapabilityLevel.FULL or self.found.unsafe

    @property
    def injects(self) -> bool:
        """Whether the machine is identified by injection."""
        return self.whole or self.found.level is CapabilityLevel.INJECT

    def plan_lines(self) -> list[str]:
        """Return what the chain will do below the full level, one line per stage, before anything moves."""
        if self.whole:
            return []
        drive_map, level = self.found.drive_map, self.found.level
        known = self.known()
        count = len(drive_map.cells)
        lines = [f"capability level {level}, map {drive_map.name}: {count} parameter{'s' * (count != 1)}"]
        lines.append("identify: " + ("; ".join(self._measurable()) or f"not available: {self._nothing()}"))
        rest = "what is measured"
        if known is not None:
            rest = f"{rest}, the rest {known[1]}" if self._measurable() else f"values {known[1]}"
        design = f"with {rest}" if self._complete(known) else f"not available: {_machine_needed(NEEDED)}"
        lines.append(f"tune, lut, margins: {design}")
        lacking = lacking_gains(drive_map.cells)[CURRENT_LOOPS]
        if not drive_map.staging and lacking and self.drive_bandwidth_hz is None and self._complete(known):
            lines[-1] = f"lut: {design}; {FOR_READING}"
            needs = f"needs the gains of the current loops: the map has no object for {', '.join(lacking)}"
            lines.append(f"tune, margins: not available: {needs}")
        if not drive_map.staging:
            reason = why_no_limits(drive_map, self.drive_bandwidth_hz)
            lines.append(f"{LIMITS}: " + (f"not available: {reason}" if reason else "judged by what they guarantee"))
        flash = self._no_writing()
        lines.append("flash, verify: " + (f"not available: {flash}" if flash else "parameters that the map has"))
        proof = self._no_proof()
        lines.append("prove: " + (f"not available: {proof}" if proof else self._provable()))
        return lines

    def unavailable(self) -> dict[str, str]:
        """Return the stages that drive and map cannot give, with the reason, as known before anything moves."""
        if self.whole:
            return {} if "encoder" in self.found.features else {"prove": HALLS_ALONE}
        writing, proof = self._no_writing(), self._no_proof()
        reasons = {"flash": writing, "verify": writing, "prove": proof}
        if self.known() is None:
            reasons["identify"] = self._nothing()
        return {name: reason for name, reason in reasons.items() if reason}

    # ---- the stages -----------------------------------------------------------------------------

    def identify(self, request: IdentifyRequest, allow: Allow, say: Say) -> Stage:
        """Measure what the drive allows; the machine file is completed by what was given.

        Where nothing can be measured, or nothing closely enough, and a machine file was given, the stage is not
        available and that file stands in the run, its values as given.

        Raises
        ------
        NotAvailable
            Nothing can be measured, and no machine file was given.
        PmsmtoolError
            As the experiments end.
        """
        run, drive, found = self.run, self.drive, self.found
        if self.injects:
            given = None if self.nameplate is None else (self.nameplate, DATA_SHEET)
            asked = self._injected(request)
            stage = _stopped(identify(run, drive, asked, allow, say, found=found, known=given), given=given)
            return stage if self.whole else replace(stage, fallbacks=(*stage.fallbacks, NO_AVERAGES))
        known = self.known()
        if known is not None:
            run.save(NAMEPLATE, dump_machine_file(known[0]))
        reason = self._nothing()
        asked = replace(request, quantities=tuple(self._quantities()))
        if self._own_line() and request.shaft != "locked":
            return _stopped(identify_after_drive(run, drive, asked, allow, say, found=found, known=known), True)
        if not reason and request.shaft == "locked":
            reason = "needs a rotor that may turn, and the shaft is locked"
        if not reason:
            method = OF_LEVEL[found.level]
            try:
                return _stopped(identify(run, drive, asked, allow, say, method=method, found=found, known=known), True)
            except IdentificationError as error:
                if error.reason != TOO_WIDE or self.nameplate is None:
                    raise
                reason = f"nothing was identified: {error.what}; likely {error.likely}; {error.hint}"
            except NotAvailable as error:
                if known is None:
                    raise
                reason = error.what
        if known is not None:
            made = completed_machine(known[0], {}, known[1])
            assert made.machine is not None
            run.save(MACHINE, dump_machine_file(made.machine))
            return Stage(
                "identify", "not available", 0.0, values=made.given_values(known[1]), files={MACHINE: ""}, note=reason
            )
        raise NotAvailable(reason, where=f"node {self.found.identity.node}")

    def tune(self, request: TuneRequest) -> Stage:
        """Design the control, and the limits of a drive that keeps its own; one pair of gains where it has no more."""
        if not (self.run.path / MACHINE).is_file():
            raise NotAvailable(
                _machine_needed(self._lacking()), hint="begin a new run with it: `pmsmtool commission MACHINE`"
            )
        drive_map = self.found.drive_map
        if drive_map.staging:
            return tune_stage(self.run, request)
        return closed_stage(self.run, request, drive_map, self.drive_bandwidth_hz)

    def lut(self, request: LookupRequest) -> Stage:
        """Make the table of the design."""
        self._need_design()
        stage = lut_stage(self.run, request)
        if self.found.drive_map.tables:
            return stage
        notes = [FOR_READING, *_without_base(self.run, self.found.drive_map)]
        return replace(stage, fallbacks=(*stage.fallbacks, *notes), summary=f"{stage.summary}; {FOR_READING}")

    def margins(self, request: MarginRequest) -> Stage:
        """Judge the design over what the machine may be, as far as the drive takes its gains."""
        self._need_design()
        return margins_stage(self.run, request)

    def flash(self, allow: Allow, say: Say) -> Stage:
        """Write what the map has an object for."""
        self._need_design()
        self._refuse(self._no_writing())
        return flash_stage(self.run, self.drive, allow, say)

    def verify(self) -> Stage:
        """Compare what was written."""
        self._need_design()
        self._refuse(self._no_writing())
        return verify_stage(self.run, self.drive)

    def prove(self, request: ProofRequest, allow: Allow, say: Say) -> Stage:
        """Prove what the drive can show."""
        self._need_design()
        self._refuse(self._no_proof())
        if self.found.level is CapabilityLevel.RECORDER:
            request = replace(request, experiments=RECORDER_STEPS)
        return prove_stage(self.run, self.drive, load_design(self.run.path / "design.toml"), request, allow, say)

    # ---- what there is --------------------------------------------------------------------------

    def known(self) -> tuple[MachineFile, str] | None:
        """Return what completes the measured values; the encoder is the drive's own where its set can be read."""
        known = None if self.nameplate is None else (self.nameplate, DATA_SHEET)
        if not self.found.drive_map.staging:
            return known
        if known is None:
            known = nameplate_of(self.drive), SET_UP
        return with_own_encoder(known[0], self.drive), known[1]

    def _injected(self, request: IdentifyRequest) -> IdentifyRequest:
        """Return a request without what needs an encoder, where the drive has none."""
        may = [name for name in (*request.quantities, "frf") if self.found.row(name, Method.INJECT).available]
        if not may:  # a drive without its own safety: the guard says so
            return request
        _, given, left = self.found.choose(request.quantities, Method.INJECT)
        return replace(request, quantities=given, left_out=left, resonance=request.resonance and "frf" in may)

    def _complete(self, known: Any) -> bool:
        return known is not None or self.found.level is CapabilityLevel.INJECT

    def _measurable(self) -> list[str]:
        if self.found.level is CapabilityLevel.INJECT:
            return [", ".join(QUANTITIES)]
        told = measurable(OF_LEVEL.get(self.found.level, Method.STANDARD), self.found, self.nameplate)
        return [*self._own_line(), *(line for line in told if line != OVER_TORQUE_CONSTANT)]

    def _own_line(self) -> list[str]:
        """Return what the drive's own identification tells; where a recorder measures with intervals, it is not run."""
        return [] if self.found.level in (CapabilityLevel.INJECT, CapabilityLevel.RECORDER) else vendor_line(self.found)

    def _quantities(self) -> list[str]:
        return [
            name
            for name in QUANTITIES
            if any(self.found.row(name, m).available for m in (Method.RECORDER, Method.STANDARD))
        ]

    def _nothing(self) -> str:
        if self._measurable():
            return ""
        missing = self.found.row("mechanics", Method.STANDARD).missing
        return f"needs {', '.join(missing)}" if missing else NO_POLE_PAIRS

    def _lacking(self) -> tuple[str, ...]:
        stage = self.run.read().stage("identify")
        measured = {str(value["name"]) for value in (stage.values if stage else ())}
        return tuple(name for name in NEEDED if name not in measured)

    def _need_design(self) -> None:
        if not (self.run.path / "design.toml").is_file():
            raise NotAvailable(
                "needs a design, and there is none without a whole machine file",
                hint="begin a new run with one: `pmsmtool commission MACHINE`",
            )

    def _no_writing(self) -> str:
        """Return why nothing can be written, empty when something can."""
        if sign := _wrong_sign(self.run):
            return sign
        drive_map = self.found.drive_map
        if not drive_map.cells:
            return f"needs a map with objects for parameters: {drive_map.name!r} has none that this drive has"
        if not self.found.map_is_drives:
            return f"needs a map that names this drive's vendor and product (0x1018): {drive_map.name!r} does not"
        try:
            check_map(drive_map, self.found.identity, JournalFolder(self.found.identity))
        except ConfigError as error:
            return error.what
        return "" if self.drive.node.can_store() else NO_STORE

    def _no_proof(self) -> str:
        if sign := _wrong_sign(self.run):
            return sign
        if self.found.drive_map.staging and (self.injects or self.found.level is CapabilityLevel.RECORDER):
            return ""
        cells = self.found.drive_map.cells
        reason = "the drive's current-loop gains cannot be read"
        if not lacking_gains(cells)[CURRENT_LOOPS]:
            lacking = ", ".join(name for name in PREDICTED if name not in cells)
            reason = f"the response of its speed loop cannot be predicted: the map has no object for {lacking}"
            reason = reason if lacking else NO_STEPS
        design = self.run.path / "design.toml"
        return reason + (NOT_SHOWN if design.is_file() and guaranteed(load_design(design)) else "")

    def _provable(self) -> str:
        if self.found.level is CapabilityLevel.INJECT:
            return "speed step, current steps, unreachable reference, field weakening"
        return "speed step; the others need excitation"

    def _refuse(self, reason: str) -> None:
        if reason:
            raise NotAvailable(reason, where=f"node {self.found.identity.node}")


def _stopped(stage: Stage, given: object) -> Stage:
    """Return a stage that fails where pole pairs or angle are refused; what else is lacking is as given, unchecked.

    Without a machine file that a person gave, the drive's own set would stand in: it may be another machine's.
    """
    return replace(stage, status="fail") if blocking(stage.refused, given=given is not None) else stage


def _wrong_sign(run: RunDirectory) -> str:
    """Return why no loop may be closed: the position falls under positive torque; empty where nothing shows that."""
    identified = run.read().stage("identify")
    if identified is None or ENCODER_SIGN not in identified.refused:
        return ""
    return f"{ENCODER_SIGN} WRONG: swap two motor leads, or the encoder's tracks; then begin a new run"


def _without_base(run: RunDirectory, drive_map: DriveMap) -> list[str]:
    """Leave out of the set what the drive counts relative to a value the set does not have; say so.

    What it counts by the torque of an ampere, or by its increments, stays: the list of differences names it.
    """
    wanted = read_parameter_set(run.path / "params.toml")
    cells = (drive_map.cells[name] for name in wanted.values if name in drive_map.cells)
    left = {c.name: c.gain for c in cells if c.gain and c.gain not in wanted.values and not drive_map.scale_of(c)}
    if left:
        values = {name: value for name, value in wanted.values.items() if name not in left}
        run.save("params.toml", replace(wanted, values=values).to_toml())
    return [f"{name} stays as it is: counted relative to {base} (`pmsmtool tune --map`)" for name, base in left.items()]


def _machine_needed(names: Sequence[str]) -> str:
    what = ", ".join(names) or "ratings and the inverter"
    return f"needs {what}: give a machine file (`pmsmtool machine new` takes a data sheet or a meter)"
