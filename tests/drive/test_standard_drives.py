# SPDX-License-Identifier: MIT
"""Drives of CiA 402 alone: what they show, what they are commanded, and what a record of them holds."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.cia402 import Mode
from pmsmtool.drive import motion_objects as motion
from pmsmtool.drive import objects
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.port import Excitation, Injection, Recording, Shape
from pmsmtool.drive.standard_drive import COMMUTATION_ANGLE, RecorderDrive, StandardDrive
from pmsmtool.drive.torque_drives import SpeedPushDrive, TorqueDrive, pushing_drive
from pmsmtool.drive_maps.drive_map import Cell
from pmsmtool.drive_maps.motion_objects import MotionObject
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import NotAvailable
from tests.bus.scripted import NODE
from tests.drive.table_drive import Held, TableDrive, opened

GENERIC = load_family("cia402")
RATED_APK = 4.0 * math.sqrt(2.0)
COUNTS = 4000
HELD: Held = {
    objects.RATED_CURRENT_MA: 4000, objects.CURRENT_PERMILLE: 0, motion.POSITION: 0, motion.ENCODER_COUNTS: COUNTS,
    objects.SUPPORTED_MODES: 0x7FF, objects.TARGET_TORQUE_PERMILLE: 55, objects.MODE: 0, objects.MODE_DISPLAY: 0,
}  # fmt: skip
TARGET = objects.TARGET_TORQUE_PERMILLE


@contextmanager
def standard(**more: float) -> Iterator[tuple[TableDrive, StandardDrive]]:
    with opened(HELD) as (table, connection):
        yield table, StandardDrive(connection, NODE, drive_map=GENERIC)


@contextmanager
def torque(modes: int = 0x008, more: Held | None = None) -> Iterator[tuple[TableDrive, TorqueDrive]]:
    with opened({**HELD, objects.SUPPORTED_MODES: modes, **(more or {})}) as (table, connection):
        yield table, TorqueDrive(connection, NODE, drive_map=GENERIC)


def test_what_a_standard_drive_shows() -> None:
    """Torque current alone, in permille of the rated one taken as rms; speed per mechanical turn."""
    with standard() as (table, drive):
        assert drive.rated_apk == pytest.approx(RATED_APK) and drive.counts_per_turn == COUNTS
        table.objects[0x6078, 0] = objects.CURRENT_PERMILLE.encode(-250)
        table.objects[0x6064, 0] = motion.POSITION.encode(-1000)
        assert drive.live("i_q_a") == pytest.approx(-0.25 * RATED_APK) and drive.live("i_d_a") == 0.0
        assert drive.live("theta_m_rad") == pytest.approx(-0.5 * math.pi)
        for name in ("u_d_v", "U_dc_v", "theta_e_rad"):
            with pytest.raises(NotAvailable, match=f"does not show {name}"):
                drive.live(name)


@pytest.mark.parametrize("polarity", [0, 0x80])
@pytest.mark.parametrize("rad_s", [30.0, -30.0])
@pytest.mark.parametrize("start", [0, 2**31 - 700, -(2**31) + 700])
def test_speed_is_the_change_of_the_position(polarity: int, rad_s: float, start: int) -> None:
    """Also over the end of the counter, and the other way round where the polarity turns it."""
    with opened({**HELD, motion.POLARITY: polarity}) as (table, connection):
        clock, sign = connection.clock, -1.0 if polarity else 1.0
        table.shown[motion.POSITION] = lambda: (
            (start + round(sign * rad_s * clock.now() * COUNTS / (2.0 * math.pi)) + 2**31) % 2**32 - 2**31
        )
        drive = StandardDrive(connection, NODE, drive_map=GENERIC)
        assert drive.live("omega_e_rad_s") == 0.0, "of one look none is known"
        first = drive.live("theta_m_rad")
        for _ in range(20):
            clock.wait(0.05)
            assert drive.live("omega_e_rad_s") == pytest.approx(rad_s, rel=0.01)
        turned = drive.live("theta_m_rad") - first
        assert turned == pytest.approx(rad_s, rel=0.02), "the angle goes on where the counter wraps"


@pytest.mark.parametrize(
    ("i_d", "i_q", "fixed", "counts", "permille"),
    [
        (0.0, 1.0, 0.0, 0, 177), (1.0, 0.0, 0.0, 0xC000, 177), (1.0, 0.0, 0.5 * math.pi, 0, 177),
        (-1.0, 0.0, 0.0, 0x4000, 177), (1.0, 1.0, 0.0, 0xE000, 250), (2.0, 0.0, math.pi, 0x4000, 354),
        (0.0, 0.0, 0.5 * math.pi, 0, 0),
    ],
)  # fmt: skip
def test_a_vector_is_torque_current_behind_a_commutation_angle(
    i_d: float, i_q: float, fixed: float, counts: int, permille: int
) -> None:
    """A quarter turn ahead of the angle 0x60EA, 65536 counts per electrical turn; 5.657 A are 1000 permille."""
    with opened({**HELD, COMMUTATION_ANGLE: 7}) as (table, connection):
        drive = StandardDrive(connection, NODE, drive_map=GENERIC)
        drive.command_current(i_d, i_q, fixed_angle_rad=fixed)
        assert (table.number(COMMUTATION_ANGLE), table.number(TARGET)) == (counts, permille)
        order = [item for item, _ in table.written(COMMUTATION_ANGLE, TARGET)]
        assert order == [COMMUTATION_ANGLE, TARGET], "the angle first: a turn under current would be a jump"
        drive.command_current(0.0, 0.0)
        assert (table.number(COMMUTATION_ANGLE), table.number(TARGET)) == (counts, 0)
        for vector in ((0.1, 0.0), (0.0, 0.1)):
            with pytest.raises(NotAvailable, match="no d and q current"):
                drive.command_current(*vector)


def test_a_standard_drive_is_enabled_without_torque_and_takes_no_speed() -> None:
    with standard() as (table, drive):
        drive.enable()
        assert drive.may_be_energised and table.number(objects.STATUSWORD) == 0x0237
        first = [item for item, _ in table.written(TARGET, objects.MODE, objects.CONTROLWORD)]
        assert first[:2] == [TARGET, objects.MODE] and table.number(TARGET) == 0
        assert table.number(objects.MODE) == Mode.CYCLIC_TORQUE_ANGLE
        with pytest.raises(NotAvailable):
            drive.command_speed(1.0)
        with pytest.raises(NotAvailable):
            drive.prepare(Excitation(Shape.SINE, Injection.I_D, 1.0))


def test_parameters_of_a_drive_that_its_map_does_not_know() -> None:
    with standard() as (table, drive):
        assert drive.read("motor.pole_pairs") == 1.0 and drive.read("motor.R_s_ohm") == 0.0
        with pytest.raises(NotAvailable, match=r"no object for motor\.L_d_h"):
            drive.read("motor.L_d_h")
        cell = Cell("motor.R_s_ohm", 0x3002, 1, "UNSIGNED16", factor=1e-3)
        drive.node.map = drive.parameters.map = replace(GENERIC, cells={"motor.R_s_ohm": cell})
        assert drive.read("motor.R_s_ohm") == 0.0, "the map has it, this drive has not"
        table.objects[0x3002, 1] = b"\x64\0"
        assert drive.read("motor.R_s_ohm") == pytest.approx(0.1)


def test_means_are_those_of_four_looks() -> None:
    with standard() as (table, drive):
        looks = iter([100, 200, 300, 400, 500])
        table.shown[objects.CURRENT_PERMILLE] = lambda: 0.0
        read = drive.live
        drive.recorder._live = lambda name: next(looks) if name == "i_q_a" else read(name)  # type: ignore[attr-defined]
        assert drive.average(["i_q_a", "i_d_a"], 1) == {"i_q_a": 250.0, "i_d_a": 0.0}


@pytest.mark.parametrize(("modes", "mode"), [(0x008, 4), (0x200, 10), (0x208, 4)])
def test_a_torque_drive_is_enabled_at_no_torque_in_its_mode(modes: int, mode: int) -> None:
    with torque(modes) as (table, drive):
        drive.enable()
        assert drive.may_be_energised and (table.number(TARGET), table.number(objects.MODE)) == (0, mode)
        assert [item for item, _ in table.written(TARGET, objects.MODE)] == [TARGET, objects.MODE]


@pytest.mark.parametrize(
    ("modes", "asked", "steps"),
    [(0x008, [2.0], [354]), (0x008, [-2.0, 0.0], [-354, 0]), (0x200, [2.0], [88, 177, 265, 354]),
     (0x200, [-1.0], [-88, -177]), (0x200, [0.565], [100]), (0x200, [0.6], [53, 106]),
     (0x200, [1.0, -0.2], [88, 177, 106, 35, -35]), (0x200, [0.0], [0])],
)  # fmt: skip
def test_a_target_that_is_taken_at_once_is_ramped(modes: int, asked: list[float], steps: list[int]) -> None:
    """By a tenth of the rated current per millisecond; a drive with a slope of its own gets the value."""
    with torque(modes) as (table, drive):
        drive.enable()
        table.writes.clear()
        clock = drive.node.connection.clock
        began = clock.now()
        for current in asked:
            drive.command_current(0.0, current)
        assert [value for _, value in table.written(TARGET)] == steps
        pauses = len(steps) - len(asked)
        assert clock.now() - began == pytest.approx(1e-3 * pauses, abs=0.2e-3 * len(steps) + 1e-6)
        for wrong in ({"i_d_a": 0.1, "i_q_a": 0.0}, {"i_d_a": 0.0, "i_q_a": 0.1, "fixed_angle_rad": 0.0}):
            with pytest.raises(NotAvailable, match="only torque"):
                drive.command_current(**wrong)


def test_the_ramp_keeps_the_time_between_two_targets() -> None:
    """A drive that holds 4 ms (0x60C2) gets a step every 4 ms."""
    period = {motion.PERIOD_VALUE: 4, motion.PERIOD_EXPONENT: -3}
    with torque(0x200, period) as (table, drive):
        table.fixed[0x60C2, 1] = 0x06010002
        drive.enable()
        clock = drive.node.connection.clock
        began = clock.now()
        drive.command_current(0.0, 2.0)
        assert clock.now() - began == pytest.approx(12e-3, abs=1e-3)


def test_a_polled_record_of_a_torque_drive() -> None:
    with torque() as (table, drive):
        clock = drive.node.connection.clock
        table.shown[objects.CURRENT_PERMILLE] = lambda: round(1e3 * clock.now())
        table.shown[motion.POSITION] = lambda: round(1e3 * COUNTS * clock.now())
        recording = Recording(("theta_m_rad", "i_q_a"), 20, 1, None, 0)
        drive.begin_record(recording, drive.wait)
        began = clock.now()
        drive.wait(0.02)
        assert clock.now() - began == pytest.approx(0.02, abs=1.5e-3)
        trace = drive.finish_record(recording)
        drive.wait(0.01)
        assert 19 <= len(trace) <= 21 and trace.t_s[0] == 0.0
        assert np.diff(trace.t_s) == pytest.approx(1e-3, abs=1e-4), "a row every millisecond"
        assert trace.units == {"theta_m_rad": "rad", "i_q_a": "A"} and trace.meta == {"polled": True}
        assert trace["theta_m_rad"][10] - trace["theta_m_rad"][0] == pytest.approx(
            2e3 * math.pi * trace.t_s[10], rel=0.02
        )
        assert trace["i_q_a"][0] == pytest.approx(1e-3 * RATED_APK * round(1e3 * began), abs=2e-3 * RATED_APK)
        with pytest.raises(NotAvailable, match="no excitation"):
            drive.begin_record(replace(recording, excitation=Excitation(Shape.STEP, Injection.SPEED, 1.0)), drive.wait)


@pytest.mark.parametrize("shape", [Shape.STEP, Shape.SINE, Shape.BUFFER])
@pytest.mark.parametrize("point", [Injection.SPEED, Injection.I_D, Injection.U_D])
def test_a_recorder_drive_takes_a_step_of_the_speed_alone(shape: Shape, point: Injection) -> None:
    drive = object.__new__(RecorderDrive)
    drive.node = type("Node", (), {"node": 1})()
    excitation = Excitation(shape, point, 1.0)
    if (shape, point) == (Shape.STEP, Injection.SPEED):
        drive.prepare(excitation)
    else:
        with pytest.raises(NotAvailable, match="only references"):
            drive.prepare(excitation)


# ---- pushed by the limit of a velocity mode -------------------------------------------------------

SPEED, LIMIT = DriveObject(0x3010, 0, "i"), DriveObject(0x3011, 2, "H")
PUSHED = replace(
    GENERIC,
    motion={
        "target_speed": MotionObject(0x3010, 0, "INTEGER32", "rpm", "s", mode=3),
        "current_limit": MotionObject(0x3011, 2, "UNSIGNED16", "mA rms", "s"),
    },
)
WITHOUT_TORQUE: Held = {**HELD, objects.SUPPORTED_MODES: 0x4, SPEED: 99, LIMIT: 99}


@pytest.mark.parametrize(
    ("i_q", "top", "written"),
    [
        (2.0, 10.0, [(LIMIT, 0), (SPEED, 95), (LIMIT, 1414)]), (-2.0, 10.0, [(LIMIT, 0), (SPEED, -95), (LIMIT, 1414)]),
        (0.0, 10.0, [(LIMIT, 0), (SPEED, 0)]), (1e-4, 0.2, [(LIMIT, 0), (SPEED, 1), (LIMIT, 0)]),
    ],
)  # fmt: skip
def test_the_limit_pushes_towards_the_top_speed(
    i_q: float, top: float, written: list[tuple[DriveObject, float]]
) -> None:
    """No current before the speed is set; both rounded down: 10 rad/s are 95.49 rpm, 2 A peak 1414.2 mA rms."""
    with opened(WITHOUT_TORQUE) as (table, connection):
        drive = pushing_drive(connection, NODE, PUSHED)
        assert isinstance(drive, SpeedPushDrive) and drive.top_rad_s == math.inf
        drive.top_rad_s = top
        drive.command_current(0.0, i_q)
        assert table.written(SPEED, LIMIT) == written
        for wrong in ({"i_d_a": 0.1, "i_q_a": 0.0}, {"i_d_a": 0.0, "i_q_a": 0.1, "fixed_angle_rad": 0.0}):
            with pytest.raises(NotAvailable, match="only a limit"):
                drive.command_current(**wrong)


def test_without_a_push_there_is_no_current_when_it_is_enabled() -> None:
    with opened(WITHOUT_TORQUE) as (table, connection):
        drive = pushing_drive(connection, NODE, PUSHED)
        drive.enable()
        assert drive.may_be_energised and table.number(objects.MODE) == 3
        assert table.written(SPEED, LIMIT) == [(LIMIT, 0), (SPEED, 0)]
        first = [(i, s) for i, s, _ in table.writes]
        assert first.index((0x3011, 2)) < first.index((0x6060, 0)) < first.index((0x6040, 0))


def test_a_drive_with_a_torque_mode_is_pushed_by_torque() -> None:
    with opened({**WITHOUT_TORQUE, objects.SUPPORTED_MODES: 0xC}) as (_, connection):
        assert type(pushing_drive(connection, NODE, PUSHED)) is TorqueDrive
