# SPDX-License-Identifier: MIT
"""``map learn``, its second part: moves at even speed with the drive's own position gain, and with 0.7 of it.

The only change of the gain is a step down. The feed-forward of the speed is 0 meanwhile, where it has an object.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from pmsmtool.bus.connection import Connection
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.position_drive import PositionDrive
from pmsmtool.errors import IdentificationError, LimitExceeded, NotAvailable, SafetyRefusal
from pmsmtool.experiments.move import record_move
from pmsmtool.identification.learned_gains import Learned
from pmsmtool.identification.position_lag import PositionLag, position_lag, position_scale
from pmsmtool.measurement.changed_gains import (
    DOWN,
    GainObject,
    changed_counts,
    changing,
    gain_object,
    named_addresses,
    refuse_unsafe,
)

POSITION, FORWARD = "position.K_p_per_s", "position.velocity_ff"
SPEED_RAD_S, RAMP_S, EVEN_S = 2.0 * math.pi, 0.25, 3.0
"""A turn per second: cogging is even over a turn; three of them, so that gains down to 3 1/s settle."""
WAY_RAD = SPEED_RAD_S * (EVEN_S + RAMP_S)
SHORT_RAD = 0.5 * math.pi
"""Way of the moves that find the drive's own profile."""
REST_S = 1.0
TRAVEL = 1.3
"""Largest travel, of the way."""
BEHIND = 0.5
"""Largest lag of a shaft that does not follow, of the way."""


def position_gain(node: DriveNode, address: tuple[int, int] | None = None) -> GainObject | None:
    """Return the object of the position gain, where its map names one without a unit or the caller does; else None."""
    where = address or _place(node, POSITION)
    return None if where is None else gain_object(node, POSITION, *where)


def _place(node: DriveNode, name: str) -> tuple[int, int] | None:
    return next((address for address in named_addresses(node, name) if node.has(*address)), None)


def learn_position_gain(
    connection: Connection, node: DriveNode, gain: GainObject, envelope: Envelope, say: Callable[[str], None]
) -> tuple[Learned, LimitExceeded | None]:
    """Return what one count of the position gain is worth, or why that stays unknown; the drive is as before.

    What was learned of other gains stays where this is refused: that is the reason then. A limit of the motion that
    stopped the shaft is returned beside it, for the caller to raise.

    Raises DriveTimeout, DriveFault: the drive no longer does as it is told: the voltage is off and the gains are back.
    """
    try:
        drive = PositionDrive(connection, node.node, drive_map=node.map)
        try:
            return _moved(drive, gain, envelope, say), None
        finally:
            drive.close()
    except (IdentificationError, NotAvailable, SafetyRefusal) as error:
        likely = f" (likely: {error.likely})" if error.likely else ""
        unknown = Learned(POSITION, None, math.inf, None, "", error.what.partition("\n")[0] + likely)
        return unknown, error if isinstance(error, LimitExceeded) else None


def _moved(drive: PositionDrive, gain: GainObject, envelope: Envelope, say: Callable[[str], None]) -> Learned:
    """Move with the gain as it is and with less of it."""
    node = drive.node
    refuse_unsafe(node, envelope)
    forward, forward_is_zero = _fed_forward(node)
    written = [gain] if forward is None else [gain, forward]
    drive.error_limit_rad = BEHIND * WAY_RAD
    lags: list[tuple[float, PositionLag]] = []
    with changing(drive, written, replace(envelope, travel_rad=TRAVEL * WAY_RAD), say) as (guard, put):
        if forward is not None:
            put(forward, 0.0)
        record_move(guard, drive, SHORT_RAD, REST_S, find=(SPEED_RAD_S, SPEED_RAD_S / RAMP_S))
        for counts in (gain.counts, changed_counts(gain, DOWN)):
            if lags:
                put(gain, counts)
            trace, _ = record_move(guard, drive, WAY_RAD, REST_S)
            lags.append((counts, position_lag(trace, drive.rad_per_count)))
            say(f"{gain.address} = {counts:.9g}: speed over lag {lags[-1][1].gain_per_s:.4g} 1/s")
        for item in written:
            put(item, item.counts)
    return position_scale(lags[0], lags[1], POSITION, forward_is_zero=forward_is_zero)


def _fed_forward(node: DriveNode) -> tuple[GainObject | None, bool]:
    """Return what must be set to 0 so that no speed is fed forward, and whether none is then."""
    where = node.map.address(FORWARD) if FORWARD in node.map.cells else _place(node, FORWARD)
    if where is None:
        return None, False
    if not any(node.sdo.read(*where)):
        return None, True
    try:
        return gain_object(node, FORWARD, *where), True
    except NotAvailable:  # no whole number
        return None, False
