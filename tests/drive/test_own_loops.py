# SPDX-License-Identifier: MIT
"""Drives whose own loops follow a position or a speed: what they are given, what is noted, and when a move is ended."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.cia402 import Mode
from pmsmtool.drive import motion_objects as motion
from pmsmtool.drive import objects
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.port import Excitation, Injection, Recording, Shape
from pmsmtool.drive.position_drive import PositionDrive
from pmsmtool.drive.set_point import ACKNOWLEDGE_S, FOLLOWING_ERROR, POSITION_DEMAND, TARGET_POSITION, start_move
from pmsmtool.drive.speed_loop_drive import LARGEST_COUNT, OSCILLATION_SAMPLES, POSITION, Oscillation, SpeedLoopDrive
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.drive_maps.motion_objects import MotionObject
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import DriveTimeout, LimitExceeded, NotAvailable
from tests.bus.scripted import NODE
from tests.drive.table_drive import Held, TableDrive, node_of, opened

GENERIC = load_family("cia402")
RATED_APK = 4.0 * math.sqrt(2.0)
COUNTS = 4000
HELD: dict[Any, float] = {
    objects.RATED_CURRENT_MA: 4000, objects.CURRENT_PERMILLE: 0, motion.POSITION: 0, motion.ENCODER_COUNTS: COUNTS,
    objects.SUPPORTED_MODES: 0x7FF, objects.MODE: 0, objects.MODE_DISPLAY: 0, TARGET_POSITION: 1, POSITION_DEMAND: 0,
    objects.TARGET_VELOCITY_MRPM: 5,
}  # fmt: skip
TAKEN = 0x1000


# ---- the set-point's handshake --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("counts", "target"),
    [
        (0.4, 0), (-1234.6, -1235), (2**31 - 1, 2**31 - 1), (2**31, -(2**31)), (-(2**31), -(2**31)),
        (-(2**31) - 1, 2**31 - 1), (2**32 + 17, 17), (-(2**32) - 17, -17),
    ],
)  # fmt: skip
def test_a_set_point_is_taken_modulo_the_counter(counts: float, target: int) -> None:
    with node_of({TARGET_POSITION: 5}) as (table, node):
        table.shown[objects.STATUSWORD] = lambda: 0x0237 | TAKEN
        start_move(node, counts)
        assert table.number(TARGET_POSITION) == target
        words = [int(word) for _, word in table.written(objects.CONTROLWORD)]
        assert words == [0x1F, 0x0F], "new set-point, and ready for the next"
        start_move(node, counts, at_once=True)
        words = [int(word) for _, word in table.written(objects.CONTROLWORD)]
        assert words[2:] == [0x3F, 0x2F], "bit 5: not after the move that is under way"


@pytest.mark.parametrize(("late_s", "taken"), [(0.4, True), (0.6, False)])
def test_a_set_point_that_is_not_acknowledged(late_s: float, taken: bool) -> None:
    with node_of({TARGET_POSITION: 5}) as (table, node):
        clock = node.connection.clock
        table.shown[objects.STATUSWORD] = lambda: 0x0237 | (TAKEN if clock.now() > late_s else 0)
        if taken:
            start_move(node, 7)
            assert late_s < clock.now() < late_s + 0.01
            return
        with pytest.raises(DriveTimeout, match="does not acknowledge a set-point within 0.5 s"):
            start_move(node, 7)
        assert ACKNOWLEDGE_S < clock.now() < ACKNOWLEDGE_S + 0.01


# ---- a position loop ------------------------------------------------------------------------------


@contextmanager
def positioned(more: Held | None = None, drive_map: DriveMap = GENERIC) -> Iterator[tuple[TableDrive, PositionDrive]]:
    with opened({**HELD, **(more or {})}) as (table, connection):
        yield table, PositionDrive(connection, NODE, drive_map=drive_map)


@pytest.mark.parametrize(
    ("lacks", "modes", "named"),
    [
        (None, 0x7FE, "profile position mode"), (objects.SUPPORTED_MODES, None, "profile position mode"),
        (TARGET_POSITION, 1, "a target position"),
        (POSITION_DEMAND, 1, "its position demand"), (None, 0x1, ""),
    ],
)  # fmt: skip
def test_what_a_position_drive_must_have(lacks: Any, modes: int | None, named: str) -> None:
    held = HELD | ({} if modes is None else {objects.SUPPORTED_MODES: modes})
    held = {item: value for item, value in held.items() if item is not lacks}
    with opened(held) as (_, connection):
        if not named:
            assert PositionDrive(connection, NODE, drive_map=GENERIC).sends
            return
        with pytest.raises(NotAvailable) as caught:
            PositionDrive(connection, NODE, drive_map=GENERIC)
        assert named in caught.value.what and "," not in caught.value.what


@pytest.mark.parametrize(
    ("permille", "apk"), [(None, RATED_APK), (500, 0.5 * RATED_APK), (2000, RATED_APK), (0, 0.0)]
)  # fmt: skip
def test_the_current_that_a_position_drive_may_take(permille: int | None, apk: float) -> None:
    with positioned({} if permille is None else {objects.MAX_CURRENT_PERMILLE: permille}) as (_, drive):
        assert drive.current_allowed_apk == pytest.approx(apk)


@pytest.mark.parametrize("polarity", [0, 0x80])
@pytest.mark.parametrize("start", [0, 1500, 2**31 - 100, -(2**31) + 100])
def test_a_move_is_counted_from_where_the_shaft_stood(start: int, polarity: int) -> None:
    sign = -1 if polarity else 1
    with positioned({motion.POSITION: start, motion.POLARITY: polarity}) as (table, drive):
        drive.enable()
        assert table.number(objects.MODE) == Mode.PROFILE_POSITION and drive.may_be_energised
        assert table.written(TARGET_POSITION) == [(TARGET_POSITION, start)], "it stays where it is"
        order = [(i, s) for i, s, _ in table.writes]
        assert order.index((0x607A, 0)) < order.index((0x6060, 0)) < order.index((0x6040, 0))
        table.shown[objects.STATUSWORD] = lambda: 0x0237 | TAKEN
        drive.move_to(0.5 * math.pi)
        there = (start + sign * 1000 + 2**31) % 2**32 - 2**31
        assert table.number(TARGET_POSITION) == there
        table.objects[0x6062, 0] = POSITION_DEMAND.encode(there)
        assert drive.demanded_rad() == pytest.approx(0.5 * math.pi)


def test_samples_are_asked_for_where_they_cannot_be_sent() -> None:
    with positioned({motion.POSITION: 1000}) as (table, drive):
        drive.enable()
        clock = drive.node.connection.clock
        table.shown[motion.POSITION] = lambda: 1000 + round(1e4 * clock.now())
        table.shown[POSITION_DEMAND] = lambda: 1000 + round(2e4 * clock.now())
        table.shown[objects.CURRENT_PERMILLE] = lambda: 500
        drive.begin_samples()
        assert not drive.sends
        began = clock.now()
        drive.wait(0.02)
        trace = drive.end_samples()
        assert clock.now() - began == pytest.approx(0.02, abs=1e-3)
        drive.wait(0.02)
        assert len(drive._taken) == len(trace) > 20, "one after the other, and none any more at the end"
        per_count = 2.0 * math.pi / COUNTS
        start_rad = pytest.approx(1000 * per_count)  # where it was enabled
        assert trace.t_s[0] == 0.0
        assert trace.meta == {"polled": True, "speed_doubt": "", "start_rad": start_rad}
        assert trace.units == {"theta_m_rad": "rad", "theta_ref_rad": "rad", "i_q_a": "A"}
        assert trace["theta_m_rad"][-1] == pytest.approx(1e4 * (trace.t_s[-1] + began) * per_count, rel=0.02)
        assert trace["theta_ref_rad"][-1] == pytest.approx(2e4 * (trace.t_s[-1] + began) * per_count, rel=0.02)
        assert trace["i_q_a"] == pytest.approx(0.5 * RATED_APK)


def test_without_a_demand_the_following_error_tells_it() -> None:
    held = {item: value for item, value in HELD.items() if item is not POSITION_DEMAND}
    with opened({**held, motion.POSITION: 1000, FOLLOWING_ERROR: 0}) as (table, connection):
        drive = PositionDrive(connection, NODE, drive_map=GENERIC)
        drive.enable()
        table.shown[motion.POSITION] = lambda: 1400
        table.shown[FOLLOWING_ERROR] = lambda: -150
        quarter = 0.5 * math.pi / 1000.0
        assert drive.demanded_rad() == pytest.approx(250 * quarter)
        drive.begin_samples()
        drive.wait(0.02)
        trace = drive.end_samples()
        assert trace["theta_m_rad"] == pytest.approx(400 * quarter)
        assert trace["theta_ref_rad"] == pytest.approx(250 * quarter)
        assert drive.lag_rad() == pytest.approx(-150 * quarter)


def test_a_record_without_a_sample_is_empty() -> None:
    with positioned() as (_, drive):
        assert len(drive.end_samples()) == 0


LIMIT_RAD = 2.0


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize(
    ("lag", "nearer", "ended"),
    [
        (0.99, 0.0, False), (1.0, 0.0, False), (1.01, 0.0, True), (1.01, 0.011, False),
        (1.01, 0.009, True),
        (1.01, -0.5, True), (2.19, 0.5, False), (2.21, 0.5, True), (0.5, -0.5, False),
    ],
)  # fmt: skip
def test_a_move_ends_where_the_shaft_lags_and_does_not_follow(
    lag: float, nearer: float, ended: bool, way: float
) -> None:
    """A lag beyond the limit counts unless it shrank by 1 % of it within 50 ms; 2.2 times it in any case."""
    drive = object.__new__(PositionDrive)
    passed: list[float] = []
    clock = SimpleNamespace(now=lambda: 10.0 + sum(passed))
    connection = SimpleNamespace(clock=clock, wait=passed.append)
    drive.node = SimpleNamespace(node=1, connection=connection, supervision=SimpleNamespace(check=lambda: None))  # type: ignore[assignment]
    drive._polled, drive.sends, drive._recording, drive.error_limit_rad = (), True, True, LIMIT_RAD
    drive._taken = []
    drive.wait(0.01)  # without a sample there is nothing to judge
    demand = 8.0 * way
    at, nearer = demand - way * lag * LIMIT_RAD, nearer * LIMIT_RAD
    drive._taken = [
        (0.0, at - way * 99.0, demand, 0.0), (0.95, at - way * nearer, demand, 0.0),
        (0.97, at + way * 99.0, demand + 50.0, 0.0), (1.0, at, demand, 0.0),
    ]  # fmt: skip
    if ended:
        with pytest.raises(LimitExceeded, match="following error") as caught:
            drive.wait(0.01)
        assert caught.value.where == "node 1" and "voltage is off" in caught.value.hint
    else:
        drive.wait(0.01)
    drive._recording = False
    drive.wait(0.01)
    assert sum(passed) == pytest.approx(0.03)


def test_before_the_window_is_full_the_first_sample_counts() -> None:
    drive = object.__new__(PositionDrive)
    drive.error_limit_rad = LIMIT_RAD
    drive._taken = [(1.0, 0.0, 3.0, 0.0), (1.01, 0.03, 3.0, 0.0)]
    assert drive._follows(2.98) and not drive._follows(-2.98)


# ---- a speed loop ---------------------------------------------------------------------------------


@contextmanager
def speed_loop(more: Held | None = None) -> Iterator[tuple[TableDrive, SpeedLoopDrive]]:
    with opened({**HELD, **(more or {})}) as (table, connection):
        yield table, SpeedLoopDrive(connection, NODE, drive_map=GENERIC)


@pytest.mark.parametrize(
    ("modes", "target", "mode"),
    [(0x104, True, 9), (0x100, True, 9), (0x004, True, 3), (0x7FF & ~0x104, True, None), (0x104, False, None)],
)
def test_the_velocity_mode(modes: int, target: bool, mode: int | None) -> None:
    """Cyclic where it has that, for it knows no ramp."""
    held = {item: value for item, value in HELD.items() if target or item is not objects.TARGET_VELOCITY_MRPM}
    with opened({**held, objects.SUPPORTED_MODES: modes}) as (table, connection):
        if mode is None:
            with pytest.raises(NotAvailable, match="no velocity mode"):
                SpeedLoopDrive(connection, NODE, drive_map=GENERIC)
            return
        drive = SpeedLoopDrive(connection, NODE, drive_map=GENERIC)
        assert drive.mode == mode and drive.rad_s_per_count == LARGEST_COUNT == pytest.approx(2.0 * math.pi)
        drive.enable()
        assert drive.may_be_energised and table.number(objects.MODE) == mode
        assert table.written(objects.TARGET_VELOCITY_MRPM) == [(objects.TARGET_VELOCITY_MRPM, 0)]
        order = [(i, s) for i, s, _ in table.writes]
        assert order.index((0x60FF, 0)) < order.index((0x6060, 0)) < order.index((0x6040, 0))


@pytest.mark.parametrize(
    ("more", "bounded", "apk"),
    [
        ({}, False, math.inf), ({objects.MAX_CURRENT_PERMILLE: 1500}, True, 1.5 * RATED_APK),
        ({motion.MAX_TORQUE_PERMILLE: 800}, True, 0.8 * RATED_APK),
        ({objects.MAX_CURRENT_PERMILLE: 1500, motion.MAX_TORQUE_PERMILLE: 800}, True, 0.8 * RATED_APK),
    ],
)  # fmt: skip
def test_the_current_limit_of_a_speed_loop_is_the_smallest_it_has(more: Held, bounded: bool, apk: float) -> None:
    with speed_loop(more) as (_, drive):
        assert drive.commands_bounded_current == bounded and drive.current_limit_apk == pytest.approx(apk)
        assert drive.read_as_rms and drive.current_count_a == pytest.approx(1e-3 * RATED_APK)
        with pytest.raises(NotAvailable, match="takes no current"):
            drive.command_current(0.0, 0.0)


OWN_CURRENT, OWN_RATED = DriveObject(0x3001, 1, "h"), DriveObject(0x3001, 2, "H")
PEAK = {"current": MotionObject(0x3001, 1, "INTEGER16", "mA peak", "s")}
RATED_PEAK = {"rated_current": MotionObject(0x3001, 2, "UNSIGNED16", "mA peak", "s")}
RATED_OPEN = {"rated_current": MotionObject(0x3001, 2, "UNSIGNED16", "mA peak-or-rms", "s")}


@pytest.mark.parametrize(
    ("rows", "standard_ma", "as_rms"),
    [
        ({}, 4000, True), (PEAK, 4000, False), (RATED_PEAK, None, False), (RATED_OPEN, None, True),
        ({**PEAK, **RATED_PEAK}, None, False), (RATED_PEAK, 4000, False), (RATED_PEAK, 2828, False),
        (RATED_PEAK, 3500, True), (RATED_OPEN, 4000, True),
    ],
)  # fmt: skip
def test_whether_the_current_was_taken_as_rms(
    rows: dict[str, MotionObject], standard_ma: int | None, as_rms: bool
) -> None:
    """A share of 0x6075 is, and one of a rated current of undecided kind; the maker's own peak amperes are not.

    4 A peak beside a 0x6075 of 4 A, or of that current rms, tell its kind; beside 3.5 A they tell nothing.
    """
    held = {item: value for item, value in HELD.items() if item is not objects.RATED_CURRENT_MA}
    stated = {} if standard_ma is None else {objects.RATED_CURRENT_MA: standard_ma}
    with opened({**held, **stated, OWN_CURRENT: 0, OWN_RATED: 4000}) as (_, connection):
        assert SpeedLoopDrive(connection, NODE, drive_map=replace(GENERIC, motion=rows)).read_as_rms == as_rms


@pytest.mark.parametrize("recording", [False, True])
@pytest.mark.parametrize("sends", [False, True])
def test_a_wait_lasts_as_long_as_it_is_asked_for(recording: bool, sends: bool) -> None:
    with speed_loop() as (_, drive):
        drive.sends = sends
        if recording:
            drive.begin_record(Recording((), 0, 1, None, 0), drive.wait)
        clock = drive.node.connection.clock
        for seconds in (0.02, 0.0, 0.05):
            began = clock.now()
            drive.wait(seconds)
            assert clock.now() - began == pytest.approx(seconds, abs=1e-3)


@pytest.mark.parametrize(("code", "untuned"), [(AbortCode.VALUE, False), (AbortCode.DEVICE_STATE, True)])
def test_a_mode_without_gains_is_told_from_one_that_is_not_there(code: int, untuned: bool) -> None:
    with speed_loop() as (table, drive):
        table.objects[0x6061, 0], table.fixed[0x6060, 0] = b"\0", code
        with pytest.raises(NotAvailable, match="no mode of operation") as caught:
            drive._set_mode(Mode.PROFILE_VELOCITY)
        assert ("has no gains yet" in caught.value.likely) == untuned


@pytest.mark.parametrize(("speed", "counts"), [(10.0, 20), (-10.2, -20), (10.3, 21), (0.24, 0), (-0.26, -1)])
def test_a_speed_is_whole_counts(speed: float, counts: int) -> None:
    with speed_loop() as (table, drive):
        drive.rad_s_per_count = 0.5
        drive.command_speed(speed)
        assert table.number(objects.TARGET_VELOCITY_MRPM) == counts


def test_an_oscillation_is_the_spread_of_twenty_samples() -> None:
    watch = Oscillation()
    for k in range(OSCILLATION_SAMPLES - 1):
        watch.take(5.0 + (-1.0) ** k)
    assert watch.largest_a == 0.0, "not before the window is full"
    watch.take(5.0 - 1.0)
    assert watch.largest_a == pytest.approx(1.0), "about the mean, whatever that is"
    for _ in range(3 * OSCILLATION_SAMPLES):
        watch.take(5.0)
    assert watch.largest_a == pytest.approx(1.0), "the largest counts"
    watch.check("node 1")
    for limit, ended in ((watch.largest_a, False), (0.99, True)):
        watch.limit_a = limit
        if ended:
            with pytest.raises(LimitExceeded, match="oscillation") as caught:
                watch.check("node 7")
            assert caught.value.where == "node 7"
        else:
            watch.check("node 7")
    watch.begin()
    assert watch.largest_a == 0.0 and watch.limit_a == 0.99


def test_an_oscillation_ends_the_record() -> None:
    with speed_loop() as (table, drive):
        drive.sends = False
        flips = [0]

        def flip() -> float:
            flips[0] += 1
            return 500.0 * (-1.0) ** (flips[0] // 2)

        table.shown[objects.CURRENT_PERMILLE] = flip
        drive.oscillation.limit_a = 0.3 * RATED_APK
        drive.begin_record(Recording((), 0, 1, None, 0), drive.wait)
        with pytest.raises(LimitExceeded, match="oscillation"):
            drive.wait(1.0)
        assert drive.node.connection.clock.now() < 0.1
        drive.end_excitation()
        drive.wait(0.1)


def test_a_shaft_too_fast_by_its_samples_ends_a_wait_before_the_guard_looks() -> None:
    """`map learn` gives a drive without a speed limit as much current as this leaves time for."""
    for speed, error, within_s in ((19.0, None, 1.0), (21.0, LimitExceeded, 0.02)):
        with speed_loop() as (table, drive):
            clock = drive.node.connection.clock
            began = clock.now()

            def counts(clock: Any = clock, began: float = began, speed: float = speed) -> float:
                passed = 2**31 - 10 + speed / (2.0 * math.pi) * COUNTS * (clock.now() - began)
                return (round(passed) + 2**31) % 2**32 - 2**31

            table.shown[POSITION] = counts
            drive.sends, drive.may_be_energised, drive.fastest_rad_s = False, True, 20.0
            with contextlib.nullcontext() if error is None else pytest.raises(error, match="speed"):
                drive.wait(0.2)
            assert clock.now() - began < within_s
            drive.may_be_energised = False


def test_a_drive_that_sends_no_more_samples_is_not_left_alone() -> None:
    with speed_loop() as (_, drive):
        drive.sends, drive.may_be_energised, drive.fastest_rad_s = True, True, 20.0
        began = drive.node.connection.clock.now()
        with pytest.raises(DriveTimeout, match="no sample"):
            drive.wait(1.0)
        assert drive.node.connection.clock.now() - began < 0.07
        drive.may_be_energised = False


@pytest.mark.parametrize("start", [0, 2**31 - 5, -(2**31) + 5])
def test_positions_of_a_record_go_on_where_the_counter_wraps(start: int) -> None:
    with speed_loop() as (_, drive):
        drive.begin_record(Recording((), 0, 1, None, 0), drive.wait)
        for k, counts in enumerate((start, start + 9, start - 9)):
            drive._take(0.1 * k, (counts + 2**31) % 2**32 - 2**31, 100.0 * k)
        rows = np.array(drive._samples)
        assert rows[:, 0] == pytest.approx([0.0, 0.1, 0.2])
        assert rows[:, 1] - rows[0, 1] == pytest.approx(2.0 * math.pi / COUNTS * np.array([0.0, 9.0, -9.0]))
        assert rows[:, 2] == pytest.approx([0.0, 0.1 * RATED_APK, 0.2 * RATED_APK])


@pytest.mark.parametrize("shape", [Shape.STEP, Shape.BUFFER])
@pytest.mark.parametrize("point", [Injection.SPEED, Injection.I_D])
def test_a_speed_loop_takes_a_staircase_alone(shape: Shape, point: Injection) -> None:
    with speed_loop() as (_, drive):
        excitation = Excitation(shape, point, 1.0, buffer=(1.0,))
        if (shape, point) == (Shape.BUFFER, Injection.SPEED):
            drive.prepare(excitation)
        else:
            with pytest.raises(NotAvailable, match="only references"):
                drive.prepare(excitation)


def test_steps_that_are_sent_are_tied_to_the_clock_by_the_shortest_way() -> None:
    """An adapter's time stamps begin where they like: samples come 2, 5 and 3 ms after they were stamped."""
    with speed_loop() as (_, drive):
        clock = drive.node.connection.clock
        live = SimpleNamespace(values={"position": 0.0, "current": 0.0}, on_set=None)
        drive._sending = None
        import pmsmtool.drive.speed_loop_drive as module

        @contextmanager
        def sending(node: DriveNode, names: Any, period_s: float, items: Any) -> Iterator[Any]:
            assert (period_s, list(items)) == (1e-3, ["position", "current"])
            yield live

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "live_values", sending)
            drive.send_samples()
        drive.begin_record(Recording((), 0, 1, None, 0), drive.wait)
        began = clock.now()
        for k, late_s in enumerate((2e-3, 5e-3, 3e-3)):
            clock.wait(0.01)
            live.values["position"] = 10.0 * k
            live.on_set(clock.now() - late_s + 1000.0)
        drive._written = [(began + 0.015, 3.0)]
        trace = drive.finish_record(Recording((), 0, 1, None, 0))
        assert trace.t_s == pytest.approx([0.0, 0.007, 0.019]) and trace.meta["polled"] is False
        ((at, speed),) = trace.meta["steps"]
        assert (at, speed) == (pytest.approx(0.005), 3.0)
        live.on_set(clock.now())
        assert len(drive._samples) == 3, "only while a record is taken"
        drive.end_samples()
