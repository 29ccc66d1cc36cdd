# SPDX-License-Identifier: MIT
"""Identify the machine on a drive: one sequence for every method, whose rows are in :data:`METHODS`.

Envelope and consent, then the experiments, whose traces go into a run, then the evaluation of what is stored there.
Nothing is stored in the drive.

The drive's own identification, then the pulses of its capability level: one stage of both.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pmsmtool.bus.connection import Connection
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import RESTORED as OFF_AND_RESTORED
from pmsmtool.drive.recorder_drives import MappedRecorderDrive, RecordingDrive
from pmsmtool.drive.standard_drive import RecorderDrive, StandardDrive
from pmsmtool.drive.torque_drives import ParameterDrive
from pmsmtool.drive.vendor_tuning import VendorDrive
from pmsmtool.errors import IdentificationError, Interrupted, NotAvailable, PmsmtoolError, StopNotConfirmed
from pmsmtool.experiments.standstill import ReadSupply
from pmsmtool.files import make_folder
from pmsmtool.flash.map_gate import check_motion
from pmsmtool.identification.by_pulses import FACTS, read_facts
from pmsmtool.identification.by_vendor import SOURCE
from pmsmtool.identification.request import (
    MACHINE,
    PREDICTED,
    REFUSED,
    REQUEST,
    IdentifyRequest,
    Method,
    dump_request,
    trace_files,
)
from pmsmtool.identification.value_verdict import with_left_out
from pmsmtool.identification.verdicts import KEYS
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file
from pmsmtool.measurement import by_injection, by_pulses, by_vendor
from pmsmtool.measurement.by_injection import nameplate_of, with_own_halls
from pmsmtool.measurement.by_pulses import measurable
from pmsmtool.measurement.by_vendor import vendor_quantities
from pmsmtool.measurement.capabilities import Capabilities, CapabilityLevel, reference_capabilities
from pmsmtool.measurement.limits import Allow, Keep, Known, Say, Task
from pmsmtool.measurement.run_account import status_of, text_of
from pmsmtool.run_directory import RunDirectory, Stage
from pmsmtool.trace import Trace, trace_npz
from pmsmtool.units import format_quantity

SET_UP = "the drive's own set, from its maker's set-up"
RESTORED = "nothing is stored in the drive; every changed object is restored"


@dataclass(frozen=True, slots=True)
class Row:
    """How a method identifies; what a drive must have for it is in ``capabilities.WAYS``."""

    opens: Callable[[Capabilities], type[CanopenDrive]]
    """The kind of drive that its experiments take."""
    plan: Callable[[Task], tuple[Envelope, list[str]]]
    """Returns the envelope and what a person reads before consenting, or refuses."""
    measure: Callable[[Task, Envelope, Keep, Say], Any]
    """Runs the experiments; returns what the evaluation needs besides the stored traces."""
    evaluate: Callable[[Task, Any], Stage]
    """Evaluates what is stored in the run, and writes the machine file."""
    begun: Callable[[RunDirectory], Any] = lambda run: None
    """Returns what to evaluate with where something ended the experiments; None: nothing is evaluated."""


METHODS: Mapping[Method, Row] = {
    Method.INJECT: Row(
        lambda found: CanopenDrive if "averages" in found.features or found.unsafe else RecordingDrive,
        by_injection.plan, by_injection.measure, by_injection.evaluate, begun=lambda run: (),
    ),
    Method.RECORDER: Row(
        lambda found: RecorderDrive if found.drive_map.staging else MappedRecorderDrive,
        by_pulses.plan_recorded, by_pulses.measure_recorded, by_pulses.evaluate,
    ),
    Method.STANDARD: Row(
        lambda found: StandardDrive, by_pulses.plan_polled, by_pulses.measure_polled, by_pulses.evaluate,
        begun=read_facts,
    ),
    Method.VENDOR: Row(lambda found: VendorDrive, by_vendor.plan, by_vendor.measure, by_vendor.evaluate),
}  # fmt: skip
OF_LEVEL: Mapping[CapabilityLevel, Method] = {
    CapabilityLevel.FULL: Method.INJECT, CapabilityLevel.INJECT: Method.INJECT,
    CapabilityLevel.RECORDER: Method.RECORDER, CapabilityLevel.STANDARD: Method.STANDARD,
}  # fmt: skip
"""Method with the narrowest intervals at a capability level."""


def open_for_level(connection: Connection, node: int, found: Capabilities) -> CanopenDrive:
    """Return the port that fits what a drive has.

    Raises ConfigError: the map is that of another drive: nothing is moved or written through it; NotAvailable: it lacks
    what even its capability level needs.
    """
    check_motion(found.drive_map, found.identity)
    method = Method.INJECT if found.unsafe else OF_LEVEL.get(found.level)
    kind = ParameterDrive if method is None else METHODS[method].opens(found)
    return kind(connection, node, drive_map=found.drive_map)


def identify(
    run: RunDirectory,
    drive: CanopenDrive,
    request: IdentifyRequest,
    allow_motion: Allow,
    say: Say = lambda text: None,
    *,
    method: Method = Method.INJECT,
    found: Capabilities | None = None,
    known: Known | None = None,
    read_supply: ReadSupply | None = None,
) -> Stage:
    """Run the experiments of a method, and write their traces and, where it is whole, ``machine.toml``.

    Parameters
    ----------
    run : RunDirectory
        Where everything goes; the caller adds the stage to its record.
    drive : CanopenDrive
        Off; opened once more where the method needs another kind of drive.
    request : IdentifyRequest
        What is asked.
    allow_motion : callable
        Is given the lines a person consents to.
    say : callable, optional
        Is told what is done.
    method : Method, optional
        How.
    found : Capabilities, optional
        What the drive has (``capabilities.examine``); without, it is the reference drive.
    known : MachineFile and its source, optional
        What completes the measured values; by injection the drive's own set when not given.
    read_supply : callable, optional
        Reads the bench supply where R is asked for by the standard method.

    Raises
    ------
    Declined
        The person did not consent; nothing was moved.
    NotAvailable
        The request excludes what the method needs, or nothing that was asked for could be identified.
    IdentificationError
        A trap was seen; no number is given.
    StopNotConfirmed, Interrupted, BusError, DriveFault, LimitExceeded
        As the guard ends the experiment.
    """
    row, found = METHODS[method], found or reference_capabilities(drive.identity)
    if method is Method.INJECT:
        known = (nameplate_of(drive), SET_UP) if known is None else (with_own_halls(known[0], drive.read), known[1])
    with _opened_as(row.opens(found), drive, found) as own:
        task = Task(run, own, found, request, known, read_supply)
        envelope, lines = row.plan(task)
        allow_motion([*envelope.lines(), *lines, RESTORED])
        _set_aside(run)
        run.save(REQUEST, dump_request(request))
        clock = own.node.connection.clock
        start = clock.now()

        def keep(name: str, trace: Trace) -> None:
            run.save(f"traces/{name}.npz", trace_npz(trace))

        experiment = ""

        def told(line: str) -> None:
            nonlocal experiment
            if not line.startswith((" ", OFF_AND_RESTORED)):
                experiment = line
            say(line)

        try:
            facts = row.measure(task, envelope, keep, told)
        except (NotAvailable, StopNotConfirmed):  # the next way is tried; nothing keeps a person from the hardware stop
            raise
        except PmsmtoolError as error:
            if experiment and not isinstance(error, (IdentificationError, Interrupted)):
                error.where = f'{error.where}, during "{experiment}"'.removeprefix(", ")
            with contextlib.suppress(Exception):  # what ended the run outranks what cannot be evaluated
                if (facts := row.begun(run)) is not None:
                    # what was measured before is not lost: it is evaluated and recorded, and the run ends as it did
                    kept = with_left_out(row.evaluate(task, facts), request)
                    run.add(replace(kept, status=status_of(error), note=text_of(error), seconds=clock.now() - start))
            raise
        seconds = clock.now() - start
    return replace(with_left_out(row.evaluate(task, facts), request), seconds=seconds)


def _set_aside(run: RunDirectory) -> None:
    """Move what an attempt that was ended left into a folder of its own: nothing of it is evaluated with the next."""
    left = [*trace_files(run), *(path for path in [run.path / REFUSED] if path.is_file())]
    if not left:
        return
    left += [path for name in (PREDICTED, FACTS, MACHINE) if (path := run.path / name).is_file()]
    folder = next(there for k in itertools.count(1) if not (there := run.path / f"ended-{k}").exists())
    make_folder(folder / "traces", hint="check your rights there and the space on the disk")
    for path in left:
        path.rename(folder / path.relative_to(run.path))


@contextlib.contextmanager
def _opened_as(kind: type[CanopenDrive], drive: CanopenDrive, found: Capabilities) -> Iterator[CanopenDrive]:
    """Open a drive once more where a method needs another kind of it."""
    if type(drive) is kind or kind is CanopenDrive:  # every drive takes what that one does
        yield drive
        return
    own = kind(drive.node.connection, drive.node.node, drive_map=found.drive_map)
    try:
        yield own
    finally:
        drive.may_be_energised = drive.may_be_energised or own.may_be_energised
        own.close()


def identify_after_drive(
    run: RunDirectory,
    drive: CanopenDrive,
    request: IdentifyRequest,
    allow_motion: Allow,
    say: Say,
    *,
    found: Capabilities,
    known: Known | None = None,
) -> Stage:
    """Have the drive identify by itself, then measure what its objects allow besides; one stage of both.

    Raises PmsmtoolError: as either ends.
    """
    asked = replace(request, quantities=vendor_quantities(found))
    own = identify(run, drive, asked, allow_motion, say, method=Method.VENDOR, found=found, known=known)
    if not measurable(Method.STANDARD, found, None if known is None else known[0]):
        return own
    reason = _wrong_set_up(drive, own)
    if reason:
        return replace(own, fallbacks=(*own.fallbacks, reason))
    completed = None if known is None else (load_machine_file(run.path / MACHINE), known[1])
    try:
        rest = identify(run, drive, request, allow_motion, say, method=Method.STANDARD, found=found, known=completed)
    except NotAvailable as lacking:
        return replace(own, fallbacks=(*own.fallbacks, *lacking.what.splitlines()))
    except PmsmtoolError as error:  # the drive's own values are not lost
        kept = run.read().stage("identify")
        if kept is not None and kept.note == text_of(error):
            own = _joined(run, own, kept, known)
        run.add(replace(own, status=status_of(error), note=text_of(error)))
        raise
    return _joined(run, own, rest, known)


def _wrong_set_up(drive: CanopenDrive, own: Stage) -> str:
    """Return why a drive must not be pushed by torque: it commutates by pole pairs that are not the machine's."""
    told = next((round(float(value["value"])) for value in own.values if value["name"] == "pole_pairs"), None)
    held = drive.parameters.held_value("motor.pole_pairs")
    if told is None or held is None or round(held) == told:
        return ""
    return f"torque pulses: not available: the drive is set to {held:.0f} pole pairs, measures {told}; set it up first"


def _joined(run: RunDirectory, own: Stage, rest: Stage, known: Known | None) -> Stage:
    """Join both: a measured value with its interval outranks the drive's own, which is then named beside it."""
    measured = {str(value["name"]): value for value in rest.values if "std" in value and value.get("accepted", True)}
    vendor = {str(value["name"]): value for value in own.values if value["source"] == SOURCE}
    kept = {name: value for name, value in vendor.items() if name not in measured}
    refused = {name: why for name, why in rest.refused.items() if not set(KEYS.get(name, ())) & set(kept)}
    given = [value for value in rest.values if "std" not in value and value["name"] not in vendor]
    beside = [
        f"{name}: the drive's own value is {format_quantity(value['value'], value['unit'])}, "
        f"{100.0 * (value['value'] / measured[name]['value'] - 1.0):+.2g} % of the measured one"
        for name, value in vendor.items()
        if name in measured
    ]
    if known is not None and MACHINE in rest.files:
        _write_sources(run, [str(value["name"]) for value in given], known[1])
    return replace(
        rest,
        status="partial" if refused else "pass",  # the drive's own values are accepted, or it ended there
        refused=refused,
        seconds=own.seconds + rest.seconds,
        values=[*measured.values(), *kept.values(), *given],
        acceptance=[*own.acceptance, *(line for line in rest.acceptance if line.ok)],
        fallbacks=[*own.fallbacks, *beside, *rest.fallbacks],
        files={**own.files, **rest.files},
        summary="; ".join([own.summary.split("; ")[0], *rest.summary.split("; ")[:1], *_given_text(given, known)]),
    )


def _given_text(given: Sequence[Mapping[str, object]], known: Known | None) -> list[str]:
    return [f"{known[1]}: {', '.join(str(value['name']) for value in given)}"] if given and known is not None else []


def _write_sources(run: RunDirectory, given: Sequence[str], source: str) -> None:
    """Say in the machine file where each value comes from."""
    path = run.path / MACHINE
    machine = load_machine_file(path)
    by = {"measured": "pmsmtool", SOURCE: SOURCE}
    parts = {who: [name for name, e in machine.estimates.items() if e.source == said] for who, said in by.items()}
    text = "; ".join(f"{who}: {', '.join(names)}" for who, names in (*parts.items(), (source, given)) if names)
    run.save(MACHINE, dump_machine_file(replace(machine, provenance={"source": text})))
