# SPDX-License-Identifier: MIT
"""``map learn``, its second part: moves at even speed with the drive's own position gain, and with 0.7 of it.

The only change of the gain is a step down. The feed-forwards of speed and acceleration are 0 meanwhile, where they have
objects; they are learned last, with the drive's own counts, or with as many as are seen, from one upwards. A derivative
part beside the gain is as small as its object lets it be; it is learned from the drive's own counts alone.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import replace

from pmsmtool.arrays import Array
from pmsmtool.bus.connection import Connection
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import WATCH_S
from pmsmtool.drive.motion_objects import limits_speed
from pmsmtool.drive.position_drive import PositionDrive
from pmsmtool.errors import IdentificationError, LimitExceeded, NotAvailable, SafetyRefusal
from pmsmtool.experiments.move import record_move
from pmsmtool.identification.learned_gains import Learned
from pmsmtool.identification.position_lag import (
    PositionLag,
    fed_share,
    forward_scale,
    led_s,
    position_lag,
    position_scale,
    ramp_areas,
)
from pmsmtool.measurement.changed_gains import (
    DOWN,
    FLOATS_FROM,
    GainObject,
    changed_counts,
    changing,
    gain_object,
    named_addresses,
    refuse_unsafe,
)
from pmsmtool.measurement.learn_gains import MOST, share_of_current
from pmsmtool.trace import Trace

POSITION = "position.K_p_per_s"
FORWARDS = FORWARD, LEAD = "position.velocity_ff", "position.acceleration_ff_s"
DERIVATIVE = "position.derivative_share"
"""It raises the gain of the speed loop: no more of it than the drive holds is tried."""
BESIDE = (*FORWARDS, DERIVATIVE)
SPEED_RAD_S, RAMP_S, EVEN_S = 2.0 * math.pi, 0.25, 2.0
"""A turn per second: cogging is even over a turn, and the second of two shows the lag, with gains down to 4 1/s."""
WAY_RAD = SPEED_RAD_S * (EVEN_S + RAMP_S)
LONGER, SHORT = 2.0, 0.5
"""Way over that: for a lag that has not settled, and to see a feed-forward."""
SHORT_RAD = 0.5 * math.pi
"""Way of the moves that find the drive's own profile."""
REST_S = 1.0
TRAVEL = 1.3
"""Largest travel, of the way."""
FASTEST, UNWATCHED_S = 2.0, 2.0 * WATCH_S
"""Speed that ends the moves of a drive without a speed limit, of the one asked for, and time until the voltage is off
where only the guard's looks watch it. With 0.3 of the current of the steps friction ended those of light rotors."""
BEHIND = 0.5
"""Largest lag of a shaft that does not follow, of the way."""
SEEN, AIM, SURELY, GROWTH, FORWARD_MOVES = 0.3, 0.8, 2.0, 64.0, 10
"""Share of the speed from which a feed-forward is clearly seen, and the one aimed at until then, by as many standard
deviations above what was seen; by how much its counts grow at most, and in how many moves."""
LEAD_SEEN_S, LEAD_AIM_S = 12e-3, 30e-3
"""The same of a feed-forward of the acceleration: the aim is 0.75 rad/s on the ramps of these moves."""


def position_gain(node: DriveNode, address: tuple[int, int] | None = None) -> GainObject | None:
    """Return the object of the position gain, where its map names one without a unit or the caller does; else None."""
    where = address or _place(node, POSITION)
    return None if where is None else gain_object(node, POSITION, *where)


def position_gain_objects(node: DriveNode, asked: Mapping[str, tuple[int, int] | None]) -> dict[str, GainObject]:
    """Return the position gain where it is asked for, and the objects beside it; else none."""
    gain = position_gain(node, asked[POSITION]) if POSITION in asked else None
    return {} if gain is None else {POSITION: gain, **objects_beside(node)}


def _place(node: DriveNode, name: str) -> tuple[int, int] | None:
    return next((address for address in named_addresses(node.map, name) if node.has(*address)), None)


def objects_beside(node: DriveNode) -> dict[str, GainObject]:
    """Return the objects of feed-forwards and derivative, whatever they hold, as far as they are whole numbers."""
    found = {}
    for name in BESIDE:
        where = node.map.address(name) if name in node.map.cells else _place(node, name)
        with contextlib.suppress(NotAvailable):
            if where is not None:
                found[name] = gain_object(node, name, *where, may_be_zero=True)
    return found


def learn_position_gain(
    connection: Connection, node: DriveNode, gain: GainObject, envelope: Envelope, say: Callable[[str], None]
) -> tuple[dict[str, Learned], LimitExceeded | None]:
    """Return what one count of the position gain is worth, or why that stays unknown; the drive is as before.

    Beside it what one count of either feed-forward is worth, where that has an object. What was learned of other
    gains stays where this is refused: that is the reason then. A limit of the motion that stopped the shaft is returned
    beside it, for the caller to raise.

    Raises DriveTimeout, DriveFault: the drive no longer does as it is told: the voltage is off and the gains are back.
    """
    found: dict[str, Learned] = {}
    try:
        drive = PositionDrive(connection, node.node, drive_map=node.map)
        try:
            _moved(drive, gain, envelope, say, found)
        finally:
            drive.close()
    except (IdentificationError, NotAvailable, SafetyRefusal) as error:
        likely = f" (likely: {error.likely})" if error.likely else ""
        name = next((name for name in (POSITION, *objects_beside(node)) if name not in found), POSITION)
        found[name] = Learned(name, None, math.inf, None, "", error.what.partition("\n")[0] + likely)
        return found, error if isinstance(error, LimitExceeded) else None
    return found, None


def _moved(
    drive: PositionDrive, gain: GainObject, envelope: Envelope, say: Callable[[str], None], found: dict[str, Learned]
) -> None:
    """Move with the gain as it is and with less of it, then with the speed fed forward; note what is found."""
    node = drive.node
    refuse_unsafe(node, envelope)
    beside = objects_beside(node)
    written = [gain, *beside.values()]
    drive.error_limit_rad = BEHIND * WAY_RAD
    lags: list[tuple[float, PositionLag]] = []
    areas: list[Array] = []
    envelope = replace(envelope, travel_rad=TRAVEL * LONGER * WAY_RAD)
    if not limits_speed(node):
        limit = envelope.speed_max_rad_s
        speed = min(FASTEST * SPEED_RAD_S, limit)
        share = share_of_current(node, envelope.acceleration_rad_s2, MOST * limit - speed, UNWATCHED_S)
        envelope = replace(envelope, speed_max_rad_s=speed, i_max_apk=share * envelope.i_max_apk)
    way = WAY_RAD
    with changing(drive, written, envelope, say) as (guard, put):

        def lagging() -> tuple[Trace, PositionLag]:
            """Move, once more and further where the lag has not settled."""
            nonlocal way
            trace, _ = record_move(guard, drive, way, REST_S)
            try:
                return trace, position_lag(trace, drive.rad_per_count)
            except IdentificationError:
                if way > WAY_RAD:
                    raise
                way *= LONGER
                return lagging()

        for item in beside.values():
            if item.counts != _least(item):
                put(item, _least(item))
        record_move(guard, drive, SHORT_RAD, REST_S, find=(SPEED_RAD_S, SPEED_RAD_S / RAMP_S))
        for counts in (gain.counts, changed_counts(gain, DOWN)):
            if lags:
                put(gain, counts)
            trace, lag = lagging()
            lags.append((counts, lag))
            if beside.keys() & {LEAD, DERIVATIVE}:
                areas.append(ramp_areas(trace))
            say(f"{gain.address} = {counts:.9g}: speed over lag {lag.gain_per_s:.4g} 1/s")
        put(gain, gain.counts)
        told = position_scale(lags[0], lags[1], POSITION, forward_is_zero=FORWARD in beside)
        found[POSITION] = told

        def fed_by(item: GainObject, counts: float, unit: str, fed: Fed, part: float = 1.0) -> tuple[float, float]:
            """Return what some counts feed forward, and its standard deviation, from moves by part of the way."""
            put(item, counts)
            share, std = fed(record_move(guard, drive, part * way, REST_S)[0])
            say(f"{item.address} = {counts:.9g}: {share:.3g} {unit} fed forward")
            return share, std

        def learn(name: str, seen: float, aim: float, unit: str, fed: Fed) -> None:
            """Feed forward until it is seen, with short moves; note what one count of it is worth."""
            forward = beside[name]
            counts = forward.counts or 1.0
            for _ in range(FORWARD_MOVES):
                share, std = fed_by(forward, counts, unit, fed, SHORT)
                more = round(counts * aim / max(share + SURELY * std, aim / GROWTH))
                if share > seen or more > _most(forward):
                    break
                counts = more
            found[name] = forward_scale(counts, share, std, name, unit)
            if found[name].scale is None:
                found[name] = forward_scale(counts, *fed_by(forward, counts, unit, fed), name, unit)
            put(forward, 0.0)

        if FORWARD in beside and told.scale is not None:
            learn(FORWARD, SEEN, AIM, "1", lambda trace: fed_share(trace, lags[0][1]))
        if LEAD in beside and told.scale is not None:
            learn(LEAD, LEAD_SEEN_S, LEAD_AIM_S, "s", lambda trace: led_s(trace, areas[0]))
        held = beside.get(DERIVATIVE)
        if held is not None and told.scale is not None and held.counts > _least(held):
            # over a ramp T e' takes from the lag what T a fed forward takes; T is the share over the position gain
            led, std = (lags[0][1].gain_per_s * x for x in fed_by(held, held.counts, "s", lambda t: led_s(t, areas[0])))
            found[DERIVATIVE] = forward_scale(held.counts - _least(held), led, std, DERIVATIVE)
        for item in written:
            put(item, item.counts)


Fed = Callable[[Trace], tuple[float, float]]


def _least(item: GainObject) -> float:
    """Return the smallest counts that an object takes."""
    return max(item.limits[0], 0.0)


def _most(gain: GainObject) -> float:
    """Return the largest counts that an object is tried with: it may have a sign, or four bytes may be a REAL32."""
    return FLOATS_FROM if gain.item.size == 4 else (1 << 8 * gain.item.size - 1) - 1
