# SPDX-License-Identifier: MIT
"""Several drives without a person at the terminal: what must hold before the first write (`docs/safety.md`).

Every drive is named by node and serial number in a file. One drive of the same kind, the canary, was commissioned with
the same set before, and `prove` passed on it. All drives are off and stand still. Nothing is moved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.motion_objects import POSITION
from pmsmtool.drive.port import Identity
from pmsmtool.errors import ConfigError, NotAvailable, SafetyRefusal, SdoAbort
from pmsmtool.files import read_text
from pmsmtool.flash.download import refuse_while_enabled
from pmsmtool.run_directory import RunRecord

STILL_S, LOOKS = 2.0, 5
"""How long every drive must be off and stand still before the first write, and how often it is looked at."""
STILL_COUNTS = 2
"""Change of the position (increments) of an encoder at rest: its last digit flickers by one."""
KIND = ("vendor", "product", "revision", "hardware", "software")
"""What a drive has in common with its canary."""
PROVEN = ("flash", "verify", "prove")
"""Stages that the canary's run passed."""
FORM = "one line per drive: NODE SERIAL, as `pmsmtool scan` lists them; # begins a comment"


def read_serials(path: Path) -> dict[int, int]:
    """Return node id -> serial number, from a file of lines ``NODE SERIAL`` (decimal or 0x...).

    Raises ConfigError: it cannot be read, a line is not of that form, a node stands twice, or a serial number is 0.
    """
    found: dict[int, int] = {}
    wrong = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            node, serial = (int(word, 0) for word in words)
        except ValueError:
            wrong.append(f"line {number}: {line.strip()!r} is not NODE SERIAL")
            continue
        if node in found:
            wrong.append(f"line {number}: node {node} stands there twice")
        if not serial:
            wrong.append(f"line {number}: a drive with serial number 0 is written by a person only")
        found[node] = serial
    if wrong or not found:
        violations = wrong or ("it names no drive",)
        raise ConfigError("no list of serial numbers", where=str(path), hint=FORM, violations=violations)
    return found


def check_canary(record: RunRecord, *, same_set: bool, where: str) -> None:
    """Refuse a run that does not prove the set on a drive.

    Raises SafetyRefusal: a stage of :data:`PROVEN` did not pass, or another set was proven.
    """
    missing = [name for name in PROVEN if not record.passed(name)]
    if missing:
        raise SafetyRefusal(
            f"the canary's run did not pass {', '.join(missing)}", where=where,
            hint="commission one drive of this kind first: all seven stages must pass",
        )  # fmt: skip
    if not same_set:
        raise SafetyRefusal(
            "the set to be written is not the one that was proven on the canary", where=where,
            hint="name the canary's run as the source: pmsmtool flash-params RUN_DIR --nodes LIST --yes --serials FILE",
        )  # fmt: skip


def check_drives(identities: Sequence[Identity], serials: Mapping[int, int], canary: Mapping[str, Any]) -> None:
    """Refuse drives that are not listed, or not of the canary's kind; all reasons at once.

    Raises SafetyRefusal: with a line per drive and reason.

    Parameters
    ----------
    identities : sequence of Identity
        Of the drives that answer.
    serials : mapping of int to int
        Node id -> serial number, as listed.
    canary : mapping
        The drive of the canary's run (``RunRecord.drive``).
    """
    reasons = []
    for found in identities:
        listed = serials.get(found.node)
        if listed is None:
            reasons.append(f"node {found.node}: not in the list of serial numbers")
        elif listed != found.serial or not found.serial:
            reasons.append(f"node {found.node}: serial number {found.serial}, the list has {listed}")
        reasons += [
            f"node {found.node}: {key} {_shown(getattr(found, key))}, the canary's is {_shown(canary.get(key))}"
            for key in KIND
            if getattr(found, key) != canary.get(key)
        ]
    if reasons:
        raise SafetyRefusal(
            "\n  - ".join(["nothing was written: not every drive may be", *reasons]),
            likely="drives were exchanged, or another type or firmware is among them",
            hint="`pmsmtool scan` shows who answers; correct the list, or write the other drives with a person present",
        )


def _shown(value: object) -> str:
    """Return a number of the identity as `pmsmtool scan` shows it."""
    return f"{value:#x}" if isinstance(value, int) else str(value)


def wait_still(nodes: Sequence[DriveNode]) -> None:
    """Watch that every drive is off and stands still for :data:`STILL_S`.

    Raises SafetyRefusal: a drive is energised, turns, or does not show its position.
    """
    first: dict[int, float] = {}
    for look in range(LOOKS + 1):
        for node in nodes:
            refuse_while_enabled(node)
            try:
                position = node.get(POSITION)
            except (SdoAbort, NotAvailable) as error:
                raise SafetyRefusal(
                    "the drive does not show its position: that it stands still cannot be seen",
                    where=f"node {node.node}, 0x6064", hint="write this drive with a person present, without --serials",
                ) from error  # fmt: skip
            moved = position - first.setdefault(node.node, position)
            if abs(moved) > STILL_COUNTS:
                raise SafetyRefusal(
                    f"the shaft turns: {moved:+.0f} increments within {look * STILL_S / LOOKS:.2g} s",
                    where=f"node {node.node}, 0x6064", likely="another program moves it, or it coasts",
                    hint=f"wait until it stands; `pmsmtool stop -n {node.node}`",
                )  # fmt: skip
        if look < LOOKS:
            nodes[0].connection.wait(STILL_S / LOOKS)
