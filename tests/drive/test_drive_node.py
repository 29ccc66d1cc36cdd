# SPDX-License-Identifier: MIT
"""A node's identity, its way through the states, its faults, its store and its reset; and how it is stopped."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.connect import Connection, connect
from pmsmtool.bus.supervision import Emergency
from pmsmtool.cia402 import EXCITATION_ABORTED, Command, State
from pmsmtool.drive import objects, stop
from pmsmtool.drive.drive_node import DriveNode, is_safe, state_text
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive_maps.drive_map import reference_map
from pmsmtool.drive_maps.identity_rows import IdentityRows
from pmsmtool.drive_maps.motion_objects import MotionObject
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import BusError, DriveFault, DriveTimeout, NotAvailable, SdoAbort, StopNotConfirmed
from tests.bus.scripted import NODE, ScriptedBus
from tests.drive.table_drive import TableDrive, node_of

GENERIC = load_family("cia402")
OURS = replace(GENERIC, vendor=0x1234, product=0x5678)
"""A map that names the drive of the table."""


# ---- who it is ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sub", "data", "number"),
    [
        (4, None, 0), (4, b"\x63\0\0\0", 99), (4, b"\x63", 99), (4, b"\x63\0\0\0\0", 0), (3, None, 0), (2, None, 0),
        (2, b"\x01\x02\x03\x04", 0x04030201),
    ],
)  # fmt: skip
def test_a_number_that_the_node_lacks_is_zero(sub: int, data: bytes | None, number: int) -> None:
    with node_of({}) as (table, node):
        del table.objects[0x1018, sub]
        if data is not None:
            table.objects[0x1018, sub] = data
        who = node.identity()
        assert {2: who.product, 3: who.revision, 4: who.serial}[sub] == number
        assert who.vendor == 0x1234 and who.node == NODE


def test_the_vendor_is_mandatory_and_a_refusal_of_a_busy_node_is_no_zero() -> None:
    with node_of({}) as (table, node):
        for sub, code in ((1, AbortCode.NO_OBJECT), (4, AbortCode.DEVICE_STATE), (2, AbortCode.DEVICE_STATE)):
            table.refuse = {(0x1018, sub): code}
            with pytest.raises(SdoAbort):
                node.identity()
        for code in (AbortCode.NO_OBJECT, AbortCode.NO_SUBINDEX, AbortCode.WRITE_ONLY):
            table.refuse = {(0x1018, 4): code}
            assert node.identity().serial == 0


@pytest.mark.parametrize(
    ("data", "size", "serial"), [(b"\x07\0\0\0\0\0\0\1", 8, 0x0100000000000007), (b"\7\0\0\0", 8, 0), (None, 8, 0)]
)
def test_a_serial_number_where_the_family_keeps_it(data: bytes | None, size: int, serial: int) -> None:
    drive_map = replace(OURS, identity=IdentityRows(serial=(0x2100, 1, size)))
    with node_of({}, drive_map) as (table, node):
        if data is not None:
            table.objects[0x2100, 1] = data
        assert node.identity().serial == 77, "that of the standard counts first"
        table.objects[0x1018, 4] = bytes(4)
        assert node.identity().serial == serial


@pytest.mark.parametrize(
    ("name", "marks", "doubt"),
    [
        (b"Axis AX20 rev 3", {}, ""), (b"axis ax20", {}, ""),
        (b"other", {}, "calls itself 'other' and lacks 0x2200:01"),
        (b"other", {(0x2200, 1): 2, (0x2201, 0): 4}, ""), (b"", {}, "has no name (0x1008) and lacks"),
        (b"other", {(0x2200, 1): 2}, "lacks 0x2201:00 of that family"),
        (b"other", {(0x2200, 1): 4, (0x2201, 0): 4}, "lacks 0x2200:01 of that family"),
    ],
)  # fmt: skip
def test_of_a_shared_vendor_number_the_name_or_every_mark_tells(name: bytes, marks: dict[Any, int], doubt: str) -> None:
    rows = IdentityRows(names=("AX20",), marks=((0x2200, 1, 2), (0x2201, 0, 4)))
    with node_of({}, replace(OURS, identity=rows)) as (table, node):
        table.objects |= {key: bytes(size) for key, size in marks.items()}
        if name:
            table.objects[0x1008, 0] = name
        found = node.identity().doubt
        assert doubt in found and bool(found) == bool(doubt)


def test_of_a_shared_vendor_number_without_marks_the_name_alone_tells() -> None:
    with node_of({}, replace(OURS, identity=IdentityRows(names=("AX20",)))) as (table, node):
        table.objects[0x1008, 0] = b"other"
        assert "calls itself 'other', so it is no" in node.identity().doubt
        node.map = replace(OURS, product=0x5679)
        assert node.identity().doubt == "", "not the map's drive at all"


@pytest.mark.parametrize(("ms", "period_s"), [(100, 0.1), (0, None), (None, None)])
def test_the_period_of_its_heartbeat(ms: int | None, period_s: float | None) -> None:
    with node_of({} if ms is None else {objects.PRODUCER_HEARTBEAT_MS: ms}) as (_, node):
        node.identity()
        assert node.supervision.heartbeat_period_s == period_s


def test_a_number_wider_than_the_drive_keeps_it_is_named() -> None:
    """`map learn` ended in a traceback (70) on a drive with 0x60FF of 16 bits."""
    with node_of({}) as (table, node):
        table.objects[0x60FF, 0] = bytes(2)
        assert node.held(objects.TARGET_VELOCITY_MRPM) == 0.0
        node.put(objects.TARGET_VELOCITY_MRPM, -32768)
        with pytest.raises(NotAvailable, match="32768 does not fit into the object's 16 bits"):
            node.put(objects.TARGET_VELOCITY_MRPM, 32768)
        assert table.objects[0x60FF, 0] == b"\x00\x80"


# ---- states ---------------------------------------------------------------------------------------


def test_the_way_to_operation_enabled_and_back() -> None:
    with node_of({}) as (table, node):
        node.enable()
        words = [int(word) for _, word in table.written(objects.CONTROLWORD)]
        assert words == [Command.SHUTDOWN, Command.SWITCH_ON, Command.ENABLE_OPERATION]
        node.enable()
        assert len(table.writes) == 3
        assert node.disable_voltage() is State.SWITCH_ON_DISABLED and node.state() is State.SWITCH_ON_DISABLED


@pytest.mark.parametrize(
    ("status", "named"),
    [
        (0x0208, "in fault 0x2310"), (0x020F, "in fault 0x2310"), (0x0240, "stays in SWITCH ON DISABLED"),
        (0x0200, "stays in NOT READY TO SWITCH ON"), (0x0213, "stays in an undefined state"),
    ],
)  # fmt: skip
def test_a_drive_that_does_not_enable(status: int, named: str) -> None:
    with node_of({objects.ERROR_CODE: 0x2310}) as (table, node):
        table.shown[objects.STATUSWORD] = lambda: status
        with pytest.raises(DriveFault, match=named):
            node.enable()
        limit = 2.1 if "stays" in named else 0.1
        assert node.connection.clock.now() < limit


def test_a_drive_that_needs_time_is_waited_for() -> None:
    with node_of({}) as (table, node):
        clock = node.connection.clock
        table.objects[0x6041, 0] = objects.STATUSWORD.encode(0)
        table.bus.clock.after(1.5, lambda: table.objects.update({(0x6041, 0): b"\x40\x02"}))
        node.enable()
        assert node.state() is State.OPERATION_ENABLED and 1.5 < clock.now() < 1.6


@pytest.mark.parametrize(
    ("code", "emergencies", "said", "likely"),
    [
        (0x2310, [], "fault 0x2310: continuous over-current", ""), (0x7305, [], "0x7305", "encoder's cable"),
        (EXCITATION_ABORTED, [], "0xff10: excitation left", "left the limits of the envelope"),
        (None, [0x4310, 0x3210, 0], "0x3210: DC-link over-voltage", "nothing takes its energy"),
        (None, [0], "names no error", ""), (None, [], "names no error", ""),
    ],
)  # fmt: skip
def test_a_fault_is_named_by_its_object_else_by_the_last_emergency(
    code: int | None, emergencies: list[int], said: str, likely: str
) -> None:
    with node_of({} if code is None else {objects.ERROR_CODE: code}) as (_, node):
        node.supervision.emergencies = [Emergency(each, 0, b"") for each in emergencies]
        node.supervision.take_note_of_emergencies()
        error = node.fault_error()
        assert said in error.what and likely in error.likely and bool(error.likely) == bool(likely)
        assert ("allow more" in error.hint) == (code == EXCITATION_ABORTED)
        assert f"fault reset -n {NODE}" in error.hint


@pytest.mark.parametrize("comes_back", [False, True])
def test_a_fault_is_reset_by_the_edge_of_its_bit(comes_back: bool) -> None:
    with node_of({objects.ERROR_CODE: 0x2310}) as (table, node):
        words = table.written
        table.shown[objects.STATUSWORD] = lambda: (
            0x0208 if comes_back or (objects.CONTROLWORD, 0x80) not in words(objects.CONTROLWORD) else 0x0240
        )
        if comes_back:
            with pytest.raises(DriveFault, match="0x2310"):
                node.reset_fault()
        else:
            node.reset_fault()
        assert [int(word) for _, word in words(objects.CONTROLWORD)] == [0, 0x80, 0]


@pytest.mark.parametrize(("state", "safe"), [(None, False), *((each, not each.energised) for each in State)])
def test_which_states_certainly_drive_no_current(state: State | None, safe: bool) -> None:
    assert is_safe(state) == safe
    assert state_text(state) == ("an undefined state" if state is None else state.name.replace("_", " "))
    energised = {State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE}
    assert safe == (state is not None and state not in energised)


# ---- store and reset ------------------------------------------------------------------------------

STORE = DriveObject(0x1010, 1, "I")


@pytest.mark.parametrize(
    ("code", "can"), [(None, True), (0x06020000, False), (0x06090011, False), (0x06010001, True), (0x08000022, True)]
)  # fmt: skip
def test_whether_it_has_a_command_that_stores(code: int | None, can: bool) -> None:
    with node_of({STORE: 1}) as (table, node):
        if code is not None:
            table.refuse[0x1010, 1] = code
        assert node.can_store() == can


@pytest.mark.parametrize(
    ("silent_s", "code", "stored"),
    [
        (0.0, None, True), (9.0, None, True), (15.0, None, True), (18.0, None, True), (23.0, None, False),
        (15.0, 0x06010001, True), (15.0, 0x06020000, True), (15.0, 0x08000022, False),
    ],
)  # fmt: skip
def test_a_store_is_commanded_once_and_waited_for(silent_s: float, code: int | None, stored: bool) -> None:
    """10 s for its answer, and as long again until the drive answers for 0x1010; what it answers counts little."""
    with node_of({STORE: 1}) as (table, node):
        clock, saves = node.connection.clock, list[bytes]()
        step = table._step

        def slow(data: bytes) -> list[bytes]:
            if data[:4] == b"\x23\x10\x10\x01":
                saves.append(data[4:])
                table.bus.clock.after(silent_s, lambda: setattr(table, "hung", False))
                table.hung = silent_s > 0.0
                if code is not None:
                    table.refuse[0x1010, 1] = code
                answer = step(data)
                return [] if table.hung else answer
            return step(data)

        table._step = slow  # type: ignore[method-assign]
        if stored:
            node.store()
            assert silent_s <= clock.now() < (max(silent_s, 10.0) + 2.0 if silent_s else 0.1)
        else:
            with pytest.raises(DriveTimeout, match="does not finish storing within 20 s"):
                node.store()
            assert 19.9 < clock.now() < 22.0
        assert saves == [b"save"]


@pytest.mark.parametrize(("silent_s", "back"), [(0.0, True), (2.5, True), (8.0, False)])
@pytest.mark.parametrize("operational", [False, True])
def test_a_reset_node_is_waited_for_and_started_again(silent_s: float, back: bool, operational: bool) -> None:
    with node_of({}) as (table, node):
        bus: Any = node.connection.bus
        bus.deliver(0x700 + NODE, b"\x05" if operational else b"\x7f")
        node.connection.collect()
        nmt = table.nmt

        def reset(data: bytes) -> None:
            nmt(data)
            if data[0] == 0x81:
                table.hung = silent_s > 0.0
                bus.clock.after(silent_s, lambda: setattr(table, "hung", False))

        table.nmt = reset  # type: ignore[method-assign]
        if not back:
            with pytest.raises(DriveTimeout):
                node.reset()
            assert 3.0 < bus.clock.now() < 5.5
            return
        node.reset()
        commands = [data for cob, data in bus.sent if cob == 0]
        assert commands == [bytes((0x81, NODE)), *([bytes((1, NODE))] if operational else [])]
        assert silent_s <= bus.clock.now() < silent_s + 1.5
        node.supervision.check()  # its boot-up was wanted


@pytest.mark.parametrize("silent", [False, True])
def test_a_node_that_ignores_its_reset_is_not_called_silent(silent: bool) -> None:
    """Its SDO server was blamed, which nobody had asked."""
    with node_of({}) as (table, node):
        table.nmt = lambda data: []  # type: ignore[method-assign]
        if silent:
            table.answer = lambda data: iter(())  # type: ignore[method-assign]
        with pytest.raises(DriveTimeout, match="no boot-up") as caught:
            node.reset()
        assert ("does not obey the reset" in caught.value.likely) is not silent


# ---- stops ----------------------------------------------------------------------------------------


class Braking(TableDrive):
    """A drive that brakes by ``ramp_rpm_per_s`` from ``rpm`` at a quick stop, then does as ``option`` says."""

    def __init__(self, option: int, rpm: float, ramp_rpm_per_s: float, told: int) -> None:
        super().__init__(
            {
                objects.QUICK_STOP_OPTION: option, objects.QUICK_STOP_DECELERATION: told,
                objects.PROFILE_DECELERATION: told, objects.STATUSWORD: 0x0237,
            }
        )  # fmt: skip
        self.began_s: float | None = None
        self.option, self.rpm, self.ramp = option, rpm, ramp_rpm_per_s
        self.shown[objects.VELOCITY_MRPM] = lambda: round(1000.0 * self.speed())

    def speed(self) -> float:
        if self.began_s is None:
            return self.rpm
        fallen = self.ramp * (self.bus.clock.now() - self.began_s)
        return self.rpm - max(-abs(self.rpm), min(fallen, abs(self.rpm))) * (1 if self.rpm > 0 else -1)

    def answer(self, data: bytes) -> Any:
        if self.began_s is not None and self.option < 5 and abs(self.speed()) < 1e-9:
            self.objects[0x6041, 0] = b"\x40\x02"
        return super().answer(data)

    def _store(self, index: int, sub: int, body: bytes) -> None:
        super()._store(index, sub, body)
        if index == 0x6040 and body[0] == Command.QUICK_STOP:
            self.began_s = self.bus.clock.now()
            self.objects[0x6041, 0] = b"\x17\x02"


@pytest.mark.parametrize(
    ("option", "rpm", "ramp", "told", "ramped", "stops_s"),
    [
        (2, 3000.0, 1000.0, 1000, True, 3.0), (2, -3000.0, 1000.0, 1000, True, 3.0),
        (1, 3000.0, 1000.0, 1000, True, 3.0),
        (6, 3000.0, 1000.0, 1000, True, 3.0), (5, -3000.0, 1000.0, 1000, True, 3.0),
        (2, 3000.0, 500.0, 1000, True, 6.0),  # half of what it says: twice the time is allowed
        (2, 3000.0, 400.0, 1000, True, 7.0),  # slower: the voltage is removed after twice the ramp and 1 s
        (2, 3000.0, 0.0, 1000, True, 1.1),  # it does not fall at all
        (2, 3000.0, -100.0, 1000, True, 1.1),  # it accelerates
        (2, 0.0, 1000.0, 1000, True, 0.0), (2, 3000.0, 1000.0, 1000, False, 0.0),
        (2, 3000.0, 45.0, 45, True, 61.0),  # no ramp is waited for longer than a minute
    ],
)  # fmt: skip
def test_a_quick_stop_has_the_time_of_its_ramp(
    option: int, rpm: float, ramp: float, told: int, ramped: bool, stops_s: float
) -> None:
    table = Braking(option, rpm, ramp, told)
    said: list[str] = []
    with Connection(ScriptedBus(table)) as connection:
        node = DriveNode(connection, NODE)
        assert stop.quick_stop(node, ramp=ramped, say=said.append) is State.SWITCH_ON_DISABLED
        assert connection.clock.now() == pytest.approx(stops_s, abs=0.25)
        words = [int(word) for _, word in table.written(objects.CONTROLWORD)]
        assert words == ([Command.QUICK_STOP, 0] if ramped else [0])
        assert bool(said) == (stops_s > 0.5)
        if said:
            assert said[0] == f"braking, up to {min(60.0, 2.0 * abs(rpm) / told):.0f} s"
            shown = [float(text.removeprefix("braking, ").removesuffix(" rpm")) for text in said[1:]]
            assert all(speed <= 1.05 * abs(rpm) for speed in shown) and shown[0] > 0.8 * abs(rpm)


def test_a_drive_that_keeps_its_voltage_is_not_confirmed() -> None:
    with node_of({}) as (table, node):
        table.shown[objects.STATUSWORD] = lambda: 0x0237
        with pytest.raises(StopNotConfirmed, match="still shows OPERATION ENABLED"):
            stop.disable(node)
        assert node.connection.clock.now() == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(("status", "confirmed"), [(0x0240, True), (0x0237, False)])
def test_a_drive_that_takes_no_controlword_is_off_when_it_shows_so(status: int, confirmed: bool) -> None:
    with node_of({objects.CONTROLWORD: 0}) as (table, node):
        table.fixed[0x6040, 0] = 0x08000022
        table.shown[objects.STATUSWORD] = lambda: status
        if confirmed:
            assert stop.disable(node) is State.SWITCH_ON_DISABLED
        else:
            with pytest.raises(SdoAbort):
                stop.disable(node)


OWN = DriveObject(0x2030, 1, "h")


@pytest.mark.parametrize(("vendor", "zeroed"), [(0x1234, True), (0x9999, False)])
def test_references_come_to_zero_and_only_those_of_this_maker(vendor: int, zeroed: bool) -> None:
    """An object of another maker's at the same address is something else."""
    row = {"target_current": MotionObject(0x2030, 1, "INTEGER16", "mA peak", "s", mode=-3)}
    held = {objects.TARGET_VELOCITY_MRPM: 5000, objects.TARGET_TORQUE_PERMILLE: 0, OWN: 7}
    with node_of(held, replace(OURS, vendor=vendor, motion=row)) as (table, node):
        stop.zero_references(node)
        assert table.written(objects.TARGET_VELOCITY_MRPM, objects.TARGET_TORQUE_PERMILLE, OWN) == [
            (objects.TARGET_VELOCITY_MRPM, 0), *([(OWN, 0)] if zeroed else []),
        ]  # fmt: skip


@pytest.mark.parametrize(
    ("code", "until_s", "ends_s", "confirmed"),
    [
        (0x08000022, 2.5, 2.5, True), (0x08000021, 2.8, 2.8, True), (0x060A0023, 60.0, 3.0, False),
        (0x06010000, 0.5, 0.0, False),  # refused for good: four tries without a pause
    ],
)  # fmt: skip
def test_a_busy_drive_is_asked_for_its_stop_for_three_seconds(
    code: int, until_s: float, ends_s: float, confirmed: bool
) -> None:
    with node_of({}) as (table, node):
        table.refuse[0x6041, 0] = code
        table.bus.clock.after(until_s, table.refuse.clear)
        if confirmed:
            assert stop.quick_stop(node) is State.SWITCH_ON_DISABLED
        else:
            with pytest.raises(StopNotConfirmed):
                stop.quick_stop(node)
            posted = [data for cob, data in table.bus.sent if data[1:4] == b"\x40\x60\0" and cob == 0x600 + NODE]
            assert posted and posted[-1][4:6] == b"\0\0", "the voltage is removed unheard"
            assert ends_s or len(posted) == 4
        assert node.connection.clock.now() == pytest.approx(ends_s, abs=0.15)


def test_a_drive_that_was_silent_before_has_a_fifth_of_a_second() -> None:
    with node_of({}) as (table, node):
        table.hung = True
        with pytest.raises(DriveTimeout):
            node.state()
        began = node.connection.clock.now()
        assert began > 1.5, "silent for longer than a stop waits in all"
        with pytest.raises(StopNotConfirmed):
            stop.quick_stop(node)
        assert 0.2 <= node.connection.clock.now() - began < 0.6


@pytest.mark.parametrize("lacks", [objects.VELOCITY_MRPM, objects.QUICK_STOP_DECELERATION])
def test_a_drive_that_tells_no_ramp_has_one_second(lacks: DriveObject) -> None:
    table = Braking(2, 3000.0, 100.0, 100)
    table.shown.pop(objects.VELOCITY_MRPM)
    table.objects[0x606C, 0] = objects.VELOCITY_MRPM.encode(3e6)
    del table.objects[lacks.index, lacks.sub]
    with Connection(ScriptedBus(table)) as connection:
        assert stop.quick_stop(DriveNode(connection, NODE)) is State.SWITCH_ON_DISABLED
        assert connection.clock.now() == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("vendor", "ended"), [(0x1234, True), (0x9999, False)])
def test_an_excitation_ends_and_set_points_are_zero_on_the_reference_drive(vendor: int, ended: bool) -> None:
    held = {objects.EXCITATION_COMMAND: 2, objects.SET_POINT_D: 1.5, objects.SET_POINT_Q: -2.5}
    with node_of(held, replace(reference_map(), vendor=vendor)) as (table, node):
        stop.zero_references(node)
        left = [table.number(item) for item in held]
        assert left == ([0.0, 0.0, 0.0] if ended else [2.0, 1.5, -2.5])


@pytest.mark.parametrize("by_itself", [True, False])
def test_what_fails_at_the_close_does_not_hide_that_a_drive_may_be_energised(by_itself: bool) -> None:
    """Exit code 3 and "the adapter is gone" took the place of 8 and the hardware stop, where process data were lent."""

    def gone() -> None:
        raise BusError("the adapter is gone")

    for ended in (StopNotConfirmed("the drive may still be energised"), None):
        with (
            pytest.raises(BusError if ended is None else StopNotConfirmed),
            connect("pmsmsim", "interior-2k2?nv=:memory:") as connection,
        ):
            node = DriveNode(connection, 1)
            node.before_close.append(gone)
            try:
                if ended is not None:
                    raise ended
            finally:
                if by_itself:
                    node.close()
