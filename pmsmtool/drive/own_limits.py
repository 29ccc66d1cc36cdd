# SPDX-License-Identifier: MIT
"""Limits that a drive keeps by itself, lowered while it is lent, and what it adds to commands, cleared meanwhile."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from typing import NamedTuple

from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.motion_objects import Quantity, allowed, current_limits, rated_apk, speed_limits
from pmsmtool.drive.objects import DriveObject
from pmsmtool.errors import NotAvailable, SafetyRefusal, SdoAbort
from pmsmtool.units import format_current, rpm_from_rad_s

RATED_RATIO = 30.0
"""Largest current limit over the drive's rated current (0x6075): three times the rated current of a motor ten times as
large as the one that the drive still holds."""
LEAST_COUNTS = 4
"""Steps of its limit below which a drive is not asked to keep a current or speed: they are too coarse."""
_ROUNDING = 1e-6
OFFSETS = (DriveObject(0x60B0, 0, "i"), DriveObject(0x60B1, 0, "i"), DriveObject(0x60B2, 0, "h"))
"""What a drive adds to commands of position, speed and torque, as another master left it (CiA 402-2)."""


class OwnLimits(NamedTuple):
    """The drive's own limits.

    Attributes
    ----------
    current, speed : Quantity or None
        The objects in use, None where the drive has none.
    most_apk, most_rpm : float
        What they allow after they were lowered to the envelope (A peak, rpm).
    refused : tuple of str
        Limits that the drive does not let be lowered, one line each.
    """

    current: Quantity | None
    speed: Quantity | None
    most_apk: float
    most_rpm: float
    refused: tuple[str, ...] = ()


NO_LIMITS = OwnLimits(None, None, math.inf, math.inf)


def lower_limits(drive: CanopenDrive, envelope: Envelope) -> OwnLimits:
    """Make the drive itself keep current and speed, by the first object it has for each (0x6073, 0x6080).

    Where it has none, a drive whose every command is a bounded current goes on: its current is commanded and looked
    at by the guard, and its speed may not even overshoot.

    Raises SafetyRefusal: the current limit is none beside the rated current, or beyond what the drive shows of its
    current; or the drive does not hold what was written; NotAvailable: the drive lacks a limit that nothing replaces.
    """
    node = drive.node
    rated = rated_apk(node)
    _refuse_no_limit(node, rated, envelope.i_max_apk)
    if envelope.i_max_apk > drive.shows_apk:
        raise SafetyRefusal(
            f"the current limit of {format_current(envelope.i_max_apk)} cannot be watched: what the drive shows of its "
            f"current ends at {format_current(drive.shows_apk)}",
            where=f"node {node.node}",
            likely="an object of 16 bits in mA, as a drive for small motors has it",
            hint="limit the current to less (--i-max); nothing was energised",
        )
    refused: list[str] = []
    current = _lowered(node, current_limits(node, rated), envelope.i_max_apk, refused)
    speed = _lowered(node, speed_limits(node), rpm_from_rad_s(envelope.speed_max_rad_s), refused)
    if not (current and speed) and not drive.commands_bounded_current:
        lacking = [
            name for found, name in ((current, "current (0x6073, 0x6072)"), (speed, "speed (0x6080)")) if found is None
        ]
        raise NotAvailable(
            "; ".join([f"the drive keeps no limit of its own of its {' and its '.join(lacking)}", *refused]),
            where=f"node {node.node}",
            hint="without it nothing is moved but by a current that this program commands; where the maker has another "
            "object for it, name that in [motion] of a map (current_limit, speed_limit)",
        )
    return OwnLimits(
        None if current is None else current[0],
        None if speed is None else speed[0],
        math.inf if current is None else current[1],
        math.inf if speed is None else speed[1],
        tuple(refused),
    )


def clear_offsets(node: DriveNode) -> None:
    """Make the drive add nothing to a command while it is lent. Raises SafetyRefusal: it goes on adding something."""
    for item in OFFSETS:
        held = node.held(item)
        if not held:
            continue
        with contextlib.suppress(SdoAbort):
            node.put(item, 0.0)
        if node.get(item):
            raise SafetyRefusal(
                f"the drive adds {held:g} to every command, and it cannot be cleared",
                where=f"node {node.node}, 0x{item.index:04X}:00",
                likely="an offset that another master keeps, or that is set by the maker's software",
                hint="set it to 0, and run the command again; nothing was energised",
            )


def put_limit(node: DriveNode, limit: Quantity | None, wanted: float, most: float) -> float | None:
    """Let the drive keep a current (A peak) or a speed (rpm), at most what it allows while it is lent.

    Returns what it keeps; None where it has no such limit, or steps too coarse for it.
    """
    if limit is None:
        return None
    counts = math.floor(min(wanted, most) / limit.per_count + _ROUNDING)
    if counts < LEAST_COUNTS:
        return None
    try:
        _put(node, limit, counts)
    except (SafetyRefusal, SdoAbort):
        return None
    return counts * limit.per_count


def refuse_no_current(node: DriveNode, i_max: float) -> None:
    """Refuse to begin where the drive allows no current; what is no number is told as what limits nothing."""
    if i_max <= 0.0:
        raise SafetyRefusal(
            "the drive allows no current: its rated current or one of its limits (0x6073, 0x6072) is 0",
            where=f"node {node.node}", likely="the drive is as it left its factory: the motor is not set up",
            hint="run the maker's own set-up first",
        )  # fmt: skip


def _refuse_no_limit(node: DriveNode, rated: float, i_max: float) -> None:
    """Refuse a current limit so far above the drive's rated current that it limits nothing."""
    refuse_no_current(node, i_max)
    largest = RATED_RATIO * rated
    if not i_max <= largest:  # what is no number is no limit either
        raise SafetyRefusal(
            f"the current limit of {i_max:.4g} A (peak) is none: the drive is rated {rated:.4g} A (peak), and "
            f"at most {RATED_RATIO:g} times that, {largest:.4g} A, counts as a limit; nothing was energised",
            where=f"node {node.node}, 0x6075:00",
            likely="a wrong digit or unit in --i-max, or the drive holds the rated current of a much smaller motor",
            hint="give --i-max within what the motor can carry, or write the motor's rated current to 0x6075 first",
        )


def _lowered(
    node: DriveNode, limits: Iterator[Quantity], wanted: float, refused: list[str]
) -> tuple[Quantity, float] | None:
    """Lower the drive's own limit to what is wanted and return it with what it allows (A peak or rpm).

    The next one is tried where the drive refuses to: a limit that nobody can lower counts as none.
    """
    for limit in limits:
        found = allowed(node, iter((limit,)))
        if found is None:
            continue
        # Rounded up: a permille of the rated current must not cut what the envelope allows.
        counts = math.ceil(wanted / limit.per_count)
        if counts * limit.per_count >= found[1]:
            return found
        try:
            node.put(limit.item, node.get(limit.item))  # what it refuses now could not be brought back
            _put(node, limit, counts)
        except SdoAbort as abort:
            refused.append(f"limit {limit} stays at what the drive holds ({abort.what}): this program looks instead")
            continue
        return limit, counts * limit.per_count
    return None


def _put(node: DriveNode, limit: Quantity, counts: int) -> None:
    item = limit.item
    node.put(item, counts)
    held = node.get(item)
    if held > counts:
        raise SafetyRefusal(
            f"the drive holds the limit {held:.0f}, not the {counts:.0f} that was written",
            where=f"node {node.node}, 0x{item.index:04X}:{item.sub:02X}",
            likely="the object is locked, or follows another one of the maker's",
            hint="set it with the maker's software; nothing is moved without limits in the drive",
        )
