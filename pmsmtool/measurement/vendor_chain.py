# SPDX-License-Identifier: MIT
"""The drive's own identification, then the pulses of its capability level: one stage of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.errors import NotAvailable
from pmsmtool.identification.by_vendor import SOURCE
from pmsmtool.identification.request import IdentifyRequest, Method
from pmsmtool.identification.run_files import MACHINE
from pmsmtool.identification.verdicts import KEYS
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file
from pmsmtool.measurement.by_pulses import measurable
from pmsmtool.measurement.by_vendor import vendor_quantities
from pmsmtool.measurement.capabilities import Capabilities
from pmsmtool.measurement.identify import identify
from pmsmtool.measurement.task import Allow, Known, Say
from pmsmtool.run_directory import RunDirectory, Stage
from pmsmtool.units import format_quantity


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

    Raises
    ------
    PmsmtoolError
        As either ends.
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
    return _joined(run, own, rest, known)


def _wrong_set_up(drive: CanopenDrive, own: Stage) -> str:
    """Return why a drive must not be pushed by torque: it commutates by pole pairs that are not the machine's."""
    told = next((round(float(value["value"])) for value in own.values if value["name"] == "pole_pairs"), None)
    if told is None or "motor.pole_pairs" not in drive.node.map.cells:
        return ""
    held = round(drive.parameters.read_value("motor.pole_pairs"))
    if held == told:
        return ""
    return f"torque pulses: not available: the drive is set to {held} pole pairs and measures {told}; set it up first"


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
