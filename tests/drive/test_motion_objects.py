# SPDX-License-Identifier: MIT
"""Which objects command, limit and show the motion of another maker's drive, and what one count of them is worth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from pmsmtool.drive import motion_objects as motion
from pmsmtool.drive import objects
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.motion_objects import Quantity
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive_maps.drive_map import DriveMap, SignalCell
from pmsmtool.drive_maps.motion_objects import MotionObject
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import NotAvailable, SdoAbort
from tests.drive.table_drive import Held, node_of

GENERIC = load_family("cia402")
PEAK, RMS, OPEN = "10 mA peak", "10 mA rms", "10 mA peak-or-rms"
OWN = DriveObject(0x3001, 1, "H")
RATED = {objects.RATED_CURRENT_MA: 4000}
STATED = MotionObject(0x6075, 0, "UNSIGNED32", "mA peak", "s")
RATED_APK = 4.0 * math.sqrt(2.0)


def own(unit: str, index: int = 0x3001, sub: int = 1, *, wire: str = "UNSIGNED16", mode: int = 0) -> MotionObject:
    return MotionObject(index, sub, wire, unit, "s", mode)


@contextmanager
def drive(held: Held, signals: dict[str, SignalCell] | None = None, /, **rows: MotionObject) -> Iterator[DriveNode]:
    drive_map: DriveMap = replace(GENERIC, motion=rows, signals=signals or {})
    with node_of({motion.POSITION: 0, **held}, drive_map) as (_, node):
        yield node


@pytest.mark.parametrize(
    ("held", "rows", "apk", "where"),
    [
        (RATED, {}, RATED_APK, "0x6075"),
        ({**RATED, OWN: 700}, {"rated_current": own(PEAK)}, RATED_APK, "0x6075"),  # the standard's first
        ({**RATED, OWN: 566}, {"rated_current": own(PEAK)}, 5.66, "0x3001:01"),  # 0x6075 is rms, by the maker's own
        ({**RATED, OWN: 400}, {"rated_current": own(PEAK)}, 4.0, "0x3001:01"),  # or peak
        ({**RATED, OWN: 566}, {"rated_current": own(OPEN)}, RATED_APK, "0x6075"),
        (RATED, {"rated_current": STATED}, RATED_APK / math.sqrt(2.0), "0x6075"),  # which a map says is peak
        ({OWN: 700}, {"rated_current": own(PEAK)}, 7.0, "0x3001:01"),
        ({OWN: 700}, {"rated_current": own(RMS)}, 7.0 * math.sqrt(2.0), "0x3001:01"),
        ({OWN: 700}, {"rated_current": own(OPEN)}, 7.0 * math.sqrt(2.0), "0x3001:01"),
        ({}, {"rated_current": MotionObject(unit=RMS, number=500.0)}, 5.0 * math.sqrt(2.0), None),
        ({}, {"rated_current": own(PEAK)}, None, "0x3001:01"),
        ({}, {}, None, None),
        ({objects.RATED_CURRENT_MA: 0}, {}, None, None),  # never set
        ({objects.RATED_CURRENT_MA: 0xFFFF_FFFF, OWN: 700}, {"rated_current": own(PEAK)}, 7.0, "0x3001:01"),
    ],
)  # fmt: skip
def test_rated_current(held: Held, rows: dict[str, MotionObject], apk: float | None, where: str | None) -> None:
    with drive(held, **rows) as node:
        quantity = motion.rated_current(node)
        assert (None if quantity is None else str(quantity)) == where
        if apk is None:
            with pytest.raises(NotAvailable, match="does not report its rated current"):
                motion.rated_apk(node)
        else:
            assert motion.rated_apk(node) == pytest.approx(apk, rel=1e-12)


def test_a_rated_current_that_no_motor_has_is_none() -> None:
    """8 A in a REAL32, read as the whole number of a map: every limit above it would limit nothing."""
    with (
        drive({DriveObject(0x3001, 1, "I"): 0x4100_0000}, rated_current=own("mA rms", wire="UNSIGNED32")) as node,
        pytest.raises(NotAvailable, match="no motor has the rated current") as caught,
    ):
        motion.rated_apk(node)
    assert caught.value.where == "node 5, 0x3001:01" and "REAL32" in caught.value.likely


I_Q = {"i_q_a": SignalCell(0x3002, 2, "INTEGER16", "mA peak", "s")}
SHARE = {"i_q_a": SignalCell(0x3002, 2, "INTEGER16", "permille of 0x6075", "s")}
SIGNAL = DriveObject(0x3002, 2, "h")


@pytest.mark.parametrize(
    ("held", "signals", "rows", "shown", "open_kind"),
    [
        ({objects.CURRENT_PERMILLE: 0, OWN: 0}, {}, {"current": own(PEAK)}, Quantity(OWN, 0.01), False),
        ({OWN: 0}, {}, {"current": own(OPEN)}, Quantity(OWN, 0.01 * math.sqrt(2.0), True), True),
        ({**RATED, objects.CURRENT_PERMILLE: 0}, {}, {"current": own(PEAK)}, Quantity(objects.CURRENT_PERMILLE, 0.01),
         True),  # the standard leaves open which of both 0x6075 is
        ({**RATED, objects.CURRENT_PERMILLE: 0, motion.TORQUE_PERMILLE: 0}, I_Q, {},
         Quantity(objects.CURRENT_PERMILLE, 0.01), True),
        ({**RATED, objects.CURRENT_PERMILLE: 0}, {}, {"rated_current": STATED},
         Quantity(objects.CURRENT_PERMILLE, 0.01), False),
        ({OWN: 0, objects.CURRENT_PERMILLE: 0}, {}, {"rated_current": own(OPEN)},
         Quantity(objects.CURRENT_PERMILLE, 0.01), True),
        ({SIGNAL: 0, motion.TORQUE_PERMILLE: 0}, I_Q, {}, Quantity(SIGNAL, 0.001), False),
        ({SIGNAL: 0, motion.TORQUE_PERMILLE: 0}, SHARE, {}, Quantity(motion.TORQUE_PERMILLE, 0.01), False),
        ({OWN: 0, motion.TORQUE_PERMILLE: 0}, {}, {"rated_current": own(OPEN)}, Quantity(motion.TORQUE_PERMILLE, 0.01),
         True),
        ({OWN: 0}, SHARE, {}, None, False),
    ],
)  # fmt: skip
def test_the_current_that_is_shown(
    held: Held, signals: dict[str, SignalCell], rows: dict[str, MotionObject], shown: Quantity | None, open_kind: bool
) -> None:
    """Of a drive rated 10 A peak: 1 permille is 10 mA."""
    with drive(held, signals, **rows) as node:
        if shown is None:
            with pytest.raises(NotAvailable, match="shows neither current"):
                motion.shown_current(node, 10.0)
            return
        found = motion.shown_current(node, 10.0)
        assert found.item == shown.item and found.per_count == pytest.approx(shown.per_count)
        assert motion.undecided(node, 10.0) == open_kind


TORQUE = {objects.TARGET_TORQUE_PERMILLE: 0}
SLOW = {motion.TORQUE_SLOPE: 100}


@pytest.mark.parametrize(
    ("modes", "more", "mode"),
    [
        (0x008, TORQUE, 4), (0x200, TORQUE, 10), (0x208, TORQUE, 4), (0x208, {**TORQUE, **SLOW}, 10),
        (0x008, {**TORQUE, **SLOW}, 4), (0x3F7 & ~0x208, TORQUE, None), (0x208, {}, None),
    ],
)  # fmt: skip
@pytest.mark.parametrize("with_own", [False, True])
def test_the_torque_mode(modes: int, more: Held, mode: int | None, with_own: bool) -> None:
    """Mode 4, else 10; 10 first where the drive's own slope is slow; the maker's own last."""
    item = DriveObject(0x3001, 1, "h")
    held = {objects.SUPPORTED_MODES: modes, **more, **({item: 0} if with_own else {})}
    rows = {"target_current": own(PEAK, wire="INTEGER16", mode=-3)} if with_own else {}
    with drive(held, **rows) as node:
        if mode is not None:
            target = motion.torque_target(node, 10.0)
            assert (target.mode, target.cyclic) == (mode, mode == 10)
            assert (target.quantity.item, target.quantity.per_count) == (objects.TARGET_TORQUE_PERMILLE, 0.01)
        elif with_own:
            target = motion.torque_target(node, 10.0)
            assert (target.mode, target.quantity.item) == (-3, item)
            assert target.quantity.per_count == pytest.approx(0.01)
        else:
            with pytest.raises(NotAvailable, match=f"0x6502 = {modes:#x}"):
                motion.torque_target(node, 10.0)
        node.map = replace(node.map, capabilities=replace(node.map.capabilities, torque_mode=False))
        if not with_own:
            with pytest.raises(NotAvailable):
                motion.torque_target(node, 10.0)
        else:
            assert motion.torque_target(node, 10.0).mode == -3


SPEED, LIMIT = DriveObject(0x3010, 0, "i"), DriveObject(0x3011, 2, "H")
ROWS = {
    "target_speed": own("rpm", 0x3010, 0, wire="INTEGER32", mode=3), "current_limit": own("mA rms", 0x3011, 2),
}  # fmt: skip


@pytest.mark.parametrize(
    ("lacks", "modes", "there"),
    [
        ("", 0x4, True), ("", 0xFFFFFFFB, False), ("target_speed", 0x4, False), ("current_limit", 0x4, False),
        ("speed object", 0x4, False), ("limit object", 0x4, False),
    ],
)  # fmt: skip
def test_a_velocity_mode_whose_limit_pushes(lacks: str, modes: int, there: bool) -> None:
    held = {objects.SUPPORTED_MODES: modes, SPEED: 0, LIMIT: 0}
    for item, name in ((SPEED, "speed object"), (LIMIT, "limit object")):
        if lacks == name:
            del held[item]
    with drive(held, **{name: row for name, row in ROWS.items() if name != lacks}) as node:
        if not there:
            with pytest.raises(NotAvailable, match="neither a torque mode nor a velocity mode"):
                motion.limited_speed(node)
            return
        push = motion.limited_speed(node)
        assert (push.mode, push.speed.item, push.limit.item) == (3, SPEED, LIMIT)
        assert push.speed.per_count == pytest.approx(2.0 * math.pi / 60.0)
        assert push.limit.per_count == pytest.approx(1e-3 * math.sqrt(2.0))


COUNTS, TURNS = {motion.ENCODER_COUNTS: 4096}, {motion.MOTOR_TURNS: 2}
GEAR = {motion.GEAR_MOTOR: 10, motion.GEAR_SHAFT: 4}
FEED = {motion.FEED: 7200, motion.FEED_TURNS: 3}
TURNED = {motion.POLARITY: 0x80}


@pytest.mark.parametrize(
    ("held", "units"),
    [
        (COUNTS, 4096.0), ({**COUNTS, **TURNS}, 2048.0), ({**COUNTS, motion.MOTOR_TURNS: 0}, 4096.0),
        ({**COUNTS, **TURNED}, -4096.0), ({**COUNTS, motion.POLARITY: 0x7F}, 4096.0),
        ({**COUNTS, motion.GEAR_MOTOR: 4, motion.GEAR_SHAFT: 4}, 4096.0),
        ({**COUNTS, motion.GEAR_MOTOR: 0, motion.GEAR_SHAFT: 0}, 4096.0),
        ({**COUNTS, **GEAR}, "a gear of 2.5 is set"), ({**COUNTS, motion.GEAR_SHAFT: 4}, "a gear of 0.25 is set"),
        ({**COUNTS, **FEED}, 2400.0), ({**COUNTS, **FEED, **GEAR}, 960.0), ({**COUNTS, **FEED, **TURNED}, -2400.0),
        ({**COUNTS, motion.FEED: 1, **GEAR}, "a gear of 2.5"), ({**COUNTS, motion.FEED: 0}, 4096.0),
        ({**COUNTS, motion.FEED: 2}, "2 units of position"),
        ({**COUNTS, motion.FEED: 7200, motion.FEED_TURNS: 0}, 7200.0), ({motion.FEED: 7200}, 7200.0),
        ({motion.POSITION_UNIT: 0x00410000}, 360.0), ({motion.POSITION_UNIT: 0xFD410000, **COUNTS}, 360e3),
        ({motion.POSITION_UNIT: 0x01410000, **TURNED}, -36.0), ({motion.POSITION_UNIT: 0xFD410000, **GEAR}, 144e3),
        ({motion.POSITION_UNIT: 0x7F410000}, "0 units|e-125 units"), ({motion.POSITION_UNIT: 0x80410000}, 360e128),
        ({motion.POSITION_UNIT: 0xFD010000, **COUNTS}, "says nothing of a turn"),
        ({motion.POSITION_UNIT: 0xFD010000, **FEED}, 2400.0), ({motion.POSITION_UNIT: 0x00B50000, **COUNTS}, 4096.0),
        ({motion.POSITION_UNIT: 0xFD100000}, 2e3 * math.pi), ({motion.POSITION_UNIT: 0xFDB40000}, 1000.0),
        ({motion.POSITION_UNIT: 0x00420000}, 21600.0), ({motion.POSITION_UNIT: 0x01430000}, 129600.0),
        ({motion.ENCODER_COUNTS: 24}, 24.0), ({motion.ENCODER_COUNTS: 23}, "23 units of position, 24 are needed"),
        ({motion.ENCODER_COUNTS: 0}, "0 units of position"), ({}, "does not report how many increments"),
    ],
)  # fmt: skip
def test_units_of_position_per_turn(held: Held, units: float | str) -> None:
    """0x608F, 0x6091, 0x6092, 0x60A8 (degrees times a power of ten) and the sign of 0x607E."""
    with drive(held) as node:
        if isinstance(units, str):
            with pytest.raises(NotAvailable, match=units):
                motion.position_units(node)
        else:
            assert motion.position_units(node) == pytest.approx(units, rel=1e-12)


@pytest.mark.parametrize(
    ("ends", "letter", "units", "turns"),
    [
        ((0, 0), "i", 4096, None), ((-(2**31), 2**31 - 1), "i", 4096, None), ((0, 16 * 4096 - 1), "i", 4096, None),
        ((0, 16 * 4096 - 2), "i", 4096, "16 turns"), ((-2048, 2047), "i", 4096, "1 turns"),
        ((0, 0), "h", 4096, None), ((0, 0), "h", 8192, "8 turns"), ((0, 0), "i", 2**29, "8 turns"),
    ],
)  # fmt: skip
def test_a_position_that_begins_again_shows_no_speed(
    ends: tuple[int, int], letter: str, units: int, turns: str | None
) -> None:
    """A rotary axis kept within a turn, a position of 16 bits, an encoder of 29: the guard could not see a speed."""
    limits = dict(zip(motion.RANGE_LIMIT, ends, strict=True))
    with drive({replace(motion.POSITION, letter=letter): 0, **limits}) as node:
        node.held(motion.POSITION)
        if turns is None:
            assert motion.position_turns(node, -units) >= motion.LEAST_TURNS
        else:
            with pytest.raises(NotAvailable, match=f"begins again after {turns}"):
                motion.position_turns(node, -units)


@pytest.mark.parametrize(
    ("row", "units"),
    [(MotionObject(number=2000.0), 2000.0), (own("4 1"), 4.0 * 512), (MotionObject(number=20.0), None)],
)
@pytest.mark.parametrize("turned", [False, True])
def test_the_makers_own_units_of_position(row: MotionObject, units: float | None, turned: bool) -> None:
    with drive({OWN: 512, **(TURNED if turned else {})}, counts_per_turn=row) as node:
        if units is None:
            with pytest.raises(NotAvailable, match="20 units"):
                motion.position_units(node)
        else:
            assert motion.position_units(node) == pytest.approx(-units if turned else units)


@pytest.mark.parametrize(("stated", "said"), [(4000.0, 1), (8192.0, 0), (0.0, 0)])
def test_a_stated_number_that_the_drive_contradicts_is_named(stated: float, said: int) -> None:
    """The drive's own was used without a word."""
    with drive({motion.ENCODER_COUNTS: 8192}, counts_per_turn=MotionObject(number=stated)) as node:
        lines = motion.unlike_stated(node)
        assert len(lines) == said and all("8192" in line and "4000" in line and "which count" in line for line in lines)
        assert motion.position_units(node) == 8192.0


def test_limits_in_their_order_and_units() -> None:
    """Of the current: 0x6073, the maker's own, 0x6072; of the speed (rpm): 0x6080, the maker's own."""
    rows = {"current_limit": own(RMS), "speed_limit": own("rad/s", 0x3005, 0)}
    with drive({**RATED}, **rows) as node:
        current, speed = list(motion.current_limits(node, 10.0)), list(motion.speed_limits(node))
    assert [str(limit) for limit in current] == ["0x6073", "0x3001:01", "0x6072"]
    assert [limit.per_count for limit in current] == pytest.approx([0.01, 0.01 * math.sqrt(2.0), 0.01])
    assert [str(limit) for limit in speed] == ["0x6080", "0x3005"]
    assert [limit.per_count for limit in speed] == pytest.approx([1.0, 60.0 / (2.0 * math.pi)])
    with drive({}) as node:
        assert [str(limit) for limit in motion.current_limits(node, 10.0)] == ["0x6073", "0x6072"]
        assert [str(limit) for limit in motion.speed_limits(node)] == ["0x6080"]


@pytest.mark.parametrize(
    ("held", "number"),
    [
        ({objects.MAX_CURRENT_PERMILLE: 1500}, 15.0), ({motion.MAX_TORQUE_PERMILLE: 800}, 8.0), ({}, None),
        ({objects.MAX_CURRENT_PERMILLE: 1500, motion.MAX_TORQUE_PERMILLE: 800}, 15.0),
        ({DriveObject(0x6073, 0, "I"): 1500, motion.MAX_TORQUE_PERMILLE: 800}, 15.0),  # of another width
    ],
)  # fmt: skip
def test_the_first_limit_that_the_drive_has_counts(held: Held, number: float | None) -> None:
    with drive(held) as node:
        found = motion.allowed(node, motion.current_limits(node, 10.0))
    assert (None if found is None else found[1]) == (None if number is None else pytest.approx(number))


@pytest.mark.parametrize(
    ("code", "missing"), [(0x06020000, True), (0x06090011, True), (0x06010001, True), (0x08000022, False)]
)
def test_what_cannot_be_read_counts_as_missing_and_a_busy_drive_does_not(code: int, missing: bool) -> None:
    with node_of({objects.MODE: 1}) as (table, node):
        table.refuse[0x6060, 0] = code
        if missing:
            assert node.held(objects.MODE) is None
        else:
            with pytest.raises(SdoAbort):
                node.held(objects.MODE)


@pytest.mark.parametrize(
    ("held_rpm", "speed_max_rpm", "trip_rpm"),
    [(6000.0, 2000.0, 3000.0), (6000.0, 5000.0, 6000.0), (6000.0, 1000.0, 2250.0), (6000.0, 1500.0, 2250.0)],
)
def test_the_drives_own_trip_is_lowered_with_the_envelope(
    held_rpm: float, speed_max_rpm: float, trip_rpm: float
) -> None:
    """Half more than the envelope's speed; never above what the drive holds, nor below three eighths of it."""
    assert motion.lowered_trip(held_rpm, speed_max_rpm) == pytest.approx(trip_rpm)


@pytest.mark.parametrize(
    ("held", "told"),
    [
        ({}, ["current", "speed"]), ({objects.MAX_CURRENT_PERMILLE: 900}, ["speed"]),
        ({objects.MAX_SPEED_RPM: 1}, ["current"]),
        ({motion.MAX_TORQUE_PERMILLE: 900, objects.MAX_SPEED_RPM: 1}, []),
        ({motion.MAX_TORQUE_PERMILLE: 900, objects.MAX_SPEED_RPM: 1, **SLOW}, ["slope 10 s: raised for the pulses"]),
        ({motion.MAX_TORQUE_PERMILLE: 900, objects.MAX_SPEED_RPM: 1, **SLOW, objects.SUPPORTED_MODES: 0x200},
         ["slope 10 s: mode 10 ignores it"]),
        ({objects.MAX_CURRENT_PERMILLE: 2000, motion.MAX_TORQUE_PERMILLE: 80, objects.MAX_SPEED_RPM: 1},
         ["current 0.8 Apk: 8 % of its rated current (0x6072)"]),
        ({motion.MAX_TORQUE_PERMILLE: 900, objects.MAX_SPEED_RPM: 1, **SLOW, objects.SUPPORTED_MODES: 0x500},
         ["slope 10 s: raised for the pulses"]),
    ],
)  # fmt: skip
def test_what_the_drive_does_not_keep_by_itself_is_told(held: Held, told: list[str]) -> None:
    with drive(held) as node:
        lines = motion.watched_by_tool(node, 10.0)
    assert [line.split()[0] for line in lines] == [text.split()[0] for text in told]
    for line, text in zip(lines, told, strict=True):
        assert all(part in line for part in text.partition(" ")[2].split(": ") if part)


def test_a_drive_that_announces_no_mode_has_none() -> None:
    with drive(TORQUE) as node:
        for asked in (lambda: motion.torque_target(node, 10.0), lambda: motion.limited_speed(node)):
            with pytest.raises(NotAvailable, match=r"0x6502 = 0x0\)"):
                asked()


@pytest.mark.parametrize(
    ("held", "rows", "found"),
    [
        ({OWN: 1, motion.TORQUE_PERMILLE: 1}, {"asked_current": own(PEAK)}, (0x3001, 0x3002)),
        ({OWN: 1}, {"asked_current": own(RMS)}, ()),  # in another unit than the current that is shown
        ({}, {"asked_current": own(PEAK)}, ()),
        ({motion.ASKED_PERMILLE: 1, motion.TORQUE_PERMILLE: 1}, {}, (0x6074, 0x6077)),
        ({motion.ASKED_PERMILLE: 1}, {}, ()),
    ],
)
def test_what_the_current_loop_is_asked_for(held: Held, rows: dict[str, MotionObject], found: tuple[int, ...]) -> None:
    shown = Quantity(DriveObject(0x3002, 0, "h"), 0.01)
    with drive(held, **rows) as node:
        assert tuple(item.index for item in motion.asked_current(node, shown)) == found
