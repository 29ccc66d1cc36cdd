# SPDX-License-Identifier: MIT
"""The stages that write and compare: flash, verify."""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pmsmtool.commissioning.export import image_of
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive_maps.drive_map import DriveMap, reference_map
from pmsmtool.drive_maps.shipped_maps import family_names
from pmsmtool.firmware.image import crc32
from pmsmtool.flash.download import Download, set_named
from pmsmtool.flash.journal import JournalFolder
from pmsmtool.flash.map_gate import unknown_firmware
from pmsmtool.flash.plan import Change, Plan
from pmsmtool.flash.restore import marks_of, plan_download
from pmsmtool.params.parameter_set import read_parameter_set
from pmsmtool.report.comparison import marks
from pmsmtool.run_directory import Acceptance, RunDirectory, Stage

Say = Callable[[str], None]
Consent = Callable[[Sequence[str]], None]
"""Told the lines a person must agree to; raises ``Declined``."""


def flash_stage(run: RunDirectory, drive: CanopenDrive, consent: Consent, say: Say) -> Stage:
    """Write ``params.toml`` to the drive and store it, with journal and roll-back.

    Raises Declined: the person did not agree to the differences; nothing was written; PmsmtoolError: the download
    failed; the error says which set the drive holds.
    """
    wanted = read_parameter_set(run.path / "params.toml")
    folder = JournalFolder(drive.identity)
    with set_named() as jobs, folder.preparing():
        plan = plan_download(drive.node, wanted)
        marks = marks_of(wanted.content_hash(), datetime.datetime.now())
        download = Download(drive.node, drive.identity, plan, marks, folder, say=say)
        jobs.append(download)
        firmware = [line for line in (unknown_firmware(drive.node.map, drive.identity),) if line]
        work = download.has_work()
        if not (work or drive.node.map.staging):
            return _held_already(plan, firmware)
        if work:
            consent(
                [
                    *firmware,
                    *plan.lines(_unchecked_marks(run, [change.name for change in plan.changes])),
                    *plan.after_lines(store=True),
                    f"undo      `pmsmtool restore{_map_option(drive.node.map)}` brings the old values back",
                ]
            )
        outcome = download.run()
    total = len(plan.entries)
    criteria = [
        Acceptance("objects read back as written, after a reset", f"{total} of {total}", "all", True),
        Acceptance("the set is stored", "yes" if outcome.stored else "no", "yes", outcome.stored is True),
    ]
    values = [_change(change) for change in plan.changes]
    good = all(line.ok for line in criteria)
    return Stage(
        "flash", "pass" if good else "fail", 0.0, values=values, acceptance=criteria,
        note="" if good else "the drive does not keep the set", fallbacks=(*plan.left_out(), *firmware),
        summary=f"{outcome.written} of {total} objects written, stored, read back after a reset",
    )  # fmt: skip


def _map_option(drive_map: DriveMap) -> str:
    """Return the option that names the map of a drive which is not the reference drive; FILE for a person's own."""
    name = drive_map.name if drive_map.name in family_names() else "FILE"
    return "" if drive_map.name == reference_map().name else f" --map {name}"


def _held_already(plan: Plan, firmware: Sequence[str]) -> Stage:
    """Return the stage of a drive that holds every value: neither storing nor a reset, which would cost its homing."""
    total = len(plan.entries)
    criteria = [Acceptance("objects that hold their value already", f"{total} of {total}", "all", True)]
    return Stage(
        "flash", "pass", 0.0, acceptance=criteria, fallbacks=(*plan.left_out(), *firmware),
        summary=f"0 of {total} objects written: the drive holds them already; nothing was stored, no reset",
    )  # fmt: skip


def _unchecked_marks(run: RunDirectory, names: Sequence[str]) -> dict[str, str]:
    """Return what of a download follows from values that this run did not check."""
    identified = run.read().stage("identify")
    return {} if identified is None else marks(names, identified.comparison)


def _change(change: Change) -> dict[str, Any]:
    table = math.isnan(change.wanted)
    numbers = (len(change.old), len(change.new), len(change.new)) if table else (
        change.old_value, change.wanted, change.held
    )  # fmt: skip
    return {
        "name": change.name,
        "object": change.where,
        **dict(zip(("old", "asked", "held"), numbers, strict=True)),
        "unit": "bytes" if table else change.unit,
    }


def verify_stage(run: RunDirectory, drive: CanopenDrive) -> Stage:
    """Compare every byte the drive holds with ``params.toml``; behaviour is not compared."""
    wanted = read_parameter_set(run.path / "params.toml")
    plan = plan_download(drive.node, wanted)
    wrong = [f"{c.name}: {c.old_value:.7g} instead of {c.held:.7g}" for c in plan.changes]
    total = len(plan.entries)
    shown = f"{total - len(wrong)} of {total}" + (f" ({'; '.join(wrong[:3])})" if wrong else "")
    criteria = [Acceptance("objects that hold what was designed", shown, "all", not wrong)]
    if drive.node.map.staging:
        expected = crc32(image_of(wanted))
        for name, item in (("active", objects.SET_CRC_ACTIVE), ("stored", objects.SET_CRC_STORED)):
            found = drive.node.whole(item)
            criteria.append(
                Acceptance(f"CRC-32 of the {name} set", f"{found:#010x}", f"{expected:#010x}", found == expected)
            )
    good = all(line.ok for line in criteria)
    values: list[Mapping[str, Any]] = [{"name": "content", "value": wanted.content_hash()}]
    return Stage(
        "verify", "pass" if good else "fail", 0.0, values=values, acceptance=criteria,
        note="" if good else "the drive does not hold the designed set",
        summary=f"{total} of {total} objects match (values only; run prove to test behaviour)",
    )  # fmt: skip
