# SPDX-License-Identifier: MIT
"""A drive that identifies its motor by itself: how it is started, what its answers mean, and how it is given up."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from pmsmtool.bus.connect import Connection
from pmsmtool.drive import motion_objects as motion
from pmsmtool.drive import objects
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.vendor_tuning import COMMAND_MODE, FAILED_WITH_CODE, POLL_S, VendorDrive
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.drive_maps.vendor_tuning import VendorStep
from pmsmtool.errors import DriveFault, DriveTimeout, NotAvailable
from tests.bus.scripted import NODE, ScriptedBus
from tests.drive.table_drive import TableDrive

SYNAPTICON = load_family("synapticon")
assert SYNAPTICON.vendor_tuning is not None
STEPS = SYNAPTICON.vendor_tuning.steps
RUNNING = 255


class Identifying(TableDrive):
    """Answers a command after ``seconds`` with ``then``; until then it says that it runs."""

    def __init__(self, then: bytes, seconds: float = 0.45) -> None:
        super().__init__(
            {
                objects.RATED_CURRENT_MA: 4000, objects.CURRENT_PERMILLE: 0, motion.POSITION: 0, objects.MODE: 0,
                motion.ENCODER_COUNTS: 4096, objects.MODE_DISPLAY: 0, COMMAND_MODE: 9,
            }
        )  # fmt: skip
        self.then, self.seconds, self.started_s = then.ljust(8, b"\0"), seconds, math.inf
        self.objects[0x1023, 1] = bytes(8)
        self.objects[0x1023, 3] = bytes(8)
        self.gives_up = True

    def answer(self, data: bytes) -> Iterator[bytes]:
        if self.started_s < math.inf:
            done = self.bus.clock.now() >= self.started_s + self.seconds
            self.objects[0x1023, 3] = self.then if done else bytes((RUNNING,)).ljust(8, b"\0")
        return super().answer(data)

    def _store(self, index: int, sub: int, body: bytes) -> None:
        super()._store(index, sub, body)
        if (index, sub) == (0x1023, 1):
            self.started_s = self.bus.clock.now()
        elif index == 0x1024 and body == b"\3" and self.gives_up:
            self.started_s = math.inf
            self.objects[0x1023, 3] = b"\3\0\xfc".ljust(8, b"\0")


@contextmanager
def vendor(table: TableDrive, drive_map: DriveMap = SYNAPTICON) -> Iterator[VendorDrive]:
    with Connection(ScriptedBus(table)) as connection:
        yield VendorDrive(connection, NODE, drive_map=drive_map)


def test_it_is_enabled_in_the_mode_that_its_identification_takes() -> None:
    table = Identifying(b"")
    with vendor(table) as drive:
        assert not drive.commands_bounded_current, "it moves by itself"
        drive.enable()
        assert table.number(objects.MODE) == -2 and drive.may_be_energised
        drive.quick_stop()
        table.writes.clear()
        drive.enable()
        assert table.written(objects.MODE) == [], "the mode is held already"
        table.fixed[0x6060, 0] = 0x06090030
        table.objects[0x6061, 0] = b"\0"
        with pytest.raises(NotAvailable, match="no mode of operation -2"):
            drive.enable()
    with pytest.raises(NotAvailable, match="does not state how"), vendor(Identifying(b""), load_family("cia402")):
        pass


@pytest.mark.parametrize(
    ("name", "answer", "value"),
    [
        ("motor.pole_pairs", b"\1\0\x07", 7.0), ("motor.R_s_ohm", b"\1\0\x00\x00\x01\x02", 0.258),
        ("motor.L_q_h", b"\1\0\x00\x01\x00\x00\xff\xff", 0.065536), ("open phase", b"\0", None),
    ],
)  # fmt: skip
def test_an_answer_is_read_by_the_map(name: str, answer: bytes, value: float | None) -> None:
    """Big endian, from the third byte on: 0x0102 mohm, 0x10000 uH."""
    table, step, waited = Identifying(answer), STEPS[name], list[float]()
    table.objects[0x1023, 3] = bytes((FAILED_WITH_CODE,)).ljust(8, b"\0")  # of a command before
    with vendor(table) as drive:
        clock = drive.node.connection.clock
        clock.wait(1.0)

        def wait(seconds: float) -> None:
            waited.append(seconds)
            clock.wait(seconds)

        found = drive.carry_out(step, wait, {"motor.pole_pairs": 4.0})
        assert found.relative_to == {"motor.pole_pairs": 4.0}
        assert found.step == name and found.seconds == pytest.approx(0.5, abs=0.1)
        assert found.values == ({} if value is None else {name: pytest.approx(value)})
        assert found.data == table.then
        assert waited == [POLL_S] * len(waited) and 4 <= len(waited) <= 6
        assert table.objects[0x1023, 1] == bytes((step.command,)).ljust(8, b"\0")
        assert [value for _, value in table.written(COMMAND_MODE)] == [0], "executed at once"
        table.writes.clear()
        drive.quick_stop()
        assert table.written(COMMAND_MODE) == [], "nothing is left to give up"


@pytest.mark.parametrize(
    ("name", "answer", "named"),
    [
        ("motor.pole_pairs", b"\2", "no reason is given"), ("motor.pole_pairs", b"\3\0\0", "the current it needs"),
        ("open phase", b"\3\0\x01", "terminal B is not connected"), ("open phase", b"\3\0\xfb", "not allowed now"),
        ("open phase", b"\3\0\x63", "its error code 99 is not in the map"),
        ("motor.R_s_ohm", b"\0\0\0\0\1\2", "ended without a result"),
    ],
)  # fmt: skip
def test_a_failure_is_named(name: str, answer: bytes, named: str) -> None:
    table = Identifying(answer)
    with vendor(table) as drive, pytest.raises(DriveFault, match=named) as caught:
        drive.carry_out(STEPS[name], drive.node.connection.clock.wait, {})
    assert table.then.hex(" ") in caught.value.where and STEPS[name].title in caught.value.what


def test_a_command_that_another_program_started_is_left_alone() -> None:
    table = Identifying(b"\0")
    table.objects[0x1023, 3] = bytes((RUNNING,)).ljust(8, b"\0")
    with vendor(table) as drive:
        with pytest.raises(DriveFault, match="another OS command is running"):
            drive.carry_out(STEPS["open phase"], drive.node.connection.clock.wait, {})
        assert (0x1023, 1) not in [(i, s) for i, s, _ in table.writes]
        drive.quick_stop()
        assert [value for _, value in table.written(COMMAND_MODE)] == [0], "not ours to give up"


@pytest.mark.parametrize("length", [7, 9])
def test_an_answer_of_another_length(length: int) -> None:
    table = Identifying(b"\0")
    table.objects[0x1023, 3] = bytes(length)
    table.seconds = 0.0
    with vendor(table) as drive:
        if length < 8:
            with pytest.raises(DriveFault, match="has 7 bytes, expected 8"):
                drive.carry_out(STEPS["open phase"], drive.node.connection.clock.wait, {})
        else:
            assert drive.carry_out(STEPS["open phase"], drive.node.connection.clock.wait, {}).values == {}


@pytest.mark.parametrize("gives_up", [True, False])
def test_a_step_that_does_not_end_is_given_up(gives_up: bool) -> None:
    table = Identifying(b"\0", seconds=1e6)
    table.gives_up = gives_up
    step: VendorStep = replace(STEPS["open phase"], timeout_s=2.0)
    with vendor(table) as drive:
        clock = drive.node.connection.clock
        drive.enable()
        with pytest.raises(DriveTimeout, match="does not end within 2 s"):
            drive.carry_out(step, clock.wait, {})
        assert clock.now() == pytest.approx(2.0, abs=0.2)
        began = clock.now()
        table.writes.clear()
        drive.quick_stop()
        assert [value for _, value in table.written(COMMAND_MODE)] == [3, 0], "aborted, then ready for the next"
        limit = 0.15 if gives_up else 2.2
        assert clock.now() - began < limit and (gives_up or clock.now() - began > 1.9)


@pytest.mark.parametrize(("status", "error"), [(0x0208, "in fault"), (0x020F, "in fault"), (0x0240, "left operation")])
def test_a_drive_that_trips_meanwhile(status: int, error: str) -> None:
    table = Identifying(b"\0", seconds=1e6)
    table.objects[0x603F, 0] = b"\x10\x23"
    with vendor(table) as drive:
        drive.enable()
        table.bus.clock.after(0.5, lambda: table.shown.update({objects.STATUSWORD: lambda: status}))
        with pytest.raises(DriveFault, match=error):
            drive.carry_out(STEPS["open phase"], drive.node.connection.clock.wait, {})
        assert drive.node.connection.clock.now() < 0.8


def test_the_address_of_the_command_mode() -> None:
    assert DriveObject(0x1024, 0, "B") == COMMAND_MODE
