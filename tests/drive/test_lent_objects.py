# SPDX-License-Identifier: MIT
"""What a drive lends and gets back: PDOs, limits, modes; and what the tool sends to say that it is alive."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pmsmtool.bus.nmt import NmtState
from pmsmtool.drive import heartbeat as beating
from pmsmtool.drive import objects
from pmsmtool.drive.changed_objects import ChangedObjects, any_lent, restore_lent
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.heartbeat import PERIOD_S, Heartbeat, expect_pdo, expects_pdos
from pmsmtool.drive.motion_objects import MAX_TORQUE_PERMILLE, Quantity
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.own_limits import LEAST_COUNTS, lower_limits, put_limit
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.drive.port import Identity
from pmsmtool.drive.process_data import BorrowedPdo, LiveValues, live_values, sent_every_s
from pmsmtool.drive_maps.drive_map import reference_map
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import BusError, DriveFault, NotAvailable, SafetyRefusal, SdoAbort, VerifyMismatch
from tests.bus.scripted import NODE
from tests.drive.table_drive import Held, TableDrive, node_of

GENERIC = load_family("cia402")


# ---- PDOs -----------------------------------------------------------------------------------------


def pdo_objects(communication: int, words: list[int], *, times: bool = True, room: int = 8) -> dict[Any, bytes]:
    """Return the raw objects of a PDO that maps these words."""
    mapping = communication + 0x200
    found = {
        (communication, 1): (0x40000281).to_bytes(4, "little"), (communication, 2): b"\xfe",
        (mapping, 0): bytes((len(words),)),
        **{(mapping, sub): word.to_bytes(4, "little") for sub, word in enumerate([*words, *[0] * room][:room], 1)},
    }  # fmt: skip
    return found | ({(communication, 3): b"\x14\0", (communication, 5): b"\x64\0"} if times else {})


STATUS_WORD, POSITION_WORD = 0x60410010, 0x60640020


@contextmanager
def with_pdo(raw: dict[Any, bytes]) -> Iterator[tuple[TableDrive, DriveNode]]:
    with node_of({DriveObject(0x6064, 0, "i"): 0}) as (table, node):
        table.objects |= raw
        yield table, node


@pytest.mark.parametrize(
    ("communication", "words", "times", "rest"),
    [
        (0x1800, [STATUS_WORD, POSITION_WORD], True, {2: b"\xfe", 3: b"\x14\0", 5: b"\x64\0"}),
        (0x1801, [STATUS_WORD], False, {2: b"\xfe"}),
        (0x1400, [STATUS_WORD], True, {2: b"\xfe", 5: b"\x64\0"}),  # one that is received has no inhibit time
        (0x17FF, [], True, {2: b"\xfe", 5: b"\x64\0"}),
        (0x1800, [0x00050008, 0x0FFF0008], True, {2: b"\xfe", 3: b"\x14\0", 5: b"\x64\0"}),  # dummies
    ],
)  # fmt: skip
def test_a_pdo_is_lent_and_comes_back(
    communication: int, words: list[int], times: bool, rest: dict[int, bytes]
) -> None:
    with with_pdo(pdo_objects(communication, words, times=times)) as (table, node):
        before = dict(table.objects)
        pdo = BorrowedPdo.read(node, communication, communication + 0x200, 3)
        assert (pdo.count, pdo.cob_id, pdo.rest) == (len(words), 0x40000281, rest)
        assert pdo.entries == tuple([*words, 0, 0, 0][: max(3, len(words))])
        assert pdo.has_event_timer == times
        pdo.switch_off(node)
        assert int.from_bytes(table.objects[communication, 1], "little") == 0xC0000281
        pdo.change(node, [POSITION_WORD, STATUS_WORD, POSITION_WORD], 255)
        mapping = communication + 0x200
        assert table.objects[mapping, 0] == b"\3" and table.objects[communication, 2] == b"\xff"
        assert [int.from_bytes(table.objects[mapping, sub], "little") for sub in (1, 2, 3)] == [
            POSITION_WORD, STATUS_WORD, POSITION_WORD,
        ]  # fmt: skip
        assert table.objects.get((communication, 3)) == (b"\0\0" if 3 in rest else before.get((communication, 3)))
        emptied = [data for index, sub, data in table.writes if (index, sub) == (mapping, 0)]
        assert emptied[-2:] == [b"\0", b"\3"], "the entries change while none is in force"
        pdo.bring_back(node)
        assert table.objects == before


@pytest.mark.parametrize(
    ("words", "count", "named"),
    [
        ([STATUS_WORD, 0x60780010], 2, "entry 2 of the PDO names an object that the drive lacks (0x60780010)"),
        ([0x10000020], 1, ""), ([0x10500020], 1, "names an object that the drive lacks"),
        ([0x00000000], 1, "entry 1 of the PDO"), ([STATUS_WORD], 65, "multiplexed"),
        ([STATUS_WORD, 0x60780010], 1, ""), ([STATUS_WORD] * 8, 64, ""),
    ],
)  # fmt: skip
def test_a_pdo_that_could_not_be_brought_back_is_not_lent(words: list[int], count: int, named: str) -> None:
    with with_pdo(pdo_objects(0x1800, words)) as (table, node):
        table.objects[0x1A00, 0] = bytes((count,))
        table.objects |= {(0x1A00, sub): table.objects[0x1A00, 1] for sub in range(9, count + 1)}
        if not named:
            assert BorrowedPdo.read(node, 0x1800, 0x1A00, 1).count == count
            return
        with pytest.raises(NotAvailable) as caught:
            BorrowedPdo.read(node, 0x1800, 0x1A00, 1)
        assert named in caught.value.what and table.writes == []


def test_what_does_not_come_back_is_named() -> None:
    with with_pdo(pdo_objects(0x1800, [STATUS_WORD])) as (table, node):
        pdo = BorrowedPdo.read(node, 0x1800, 0x1A00, 1)
        pdo.switch_off(node)
        pdo.change(node, [POSITION_WORD], 255)
        table.fixed[0x1A00, 1] = 0x06040041
        with pytest.raises(VerifyMismatch) as caught:
            pdo.bring_back(node)
        (line,) = caught.value.differences
        assert line.startswith("0x1A00:01 does not hold 10 00 41 60 again: node refused") and "0x06040041" in line
        assert table.objects[0x1800, 1] == (0x40000281).to_bytes(4, "little"), "the others have their content"


# ---- values that are sent -------------------------------------------------------------------------

VALUES = {
    "a": DriveObject(0x6064, 0, "i"), "b": DriveObject(0x6078, 0, "h"), "c": DriveObject(0x6041, 0, "H"),
    "d": DriveObject(0x606C, 0, "i"), "e": DriveObject(0x6061, 0, "b"),
}  # fmt: skip


def test_values_are_taken_by_place_and_set_by_set() -> None:
    live, stamps = LiveValues(VALUES), list[float]()
    live.on_set = stamps.append
    live.expect(0x181, ["a", "b"])
    live.expect(0x281, ["d"])
    live.take(0x281, (7).to_bytes(4, "little"), 1.0)
    assert stamps == [], "the first of the set is missing"
    live.take(0x181, (-5).to_bytes(4, "little", signed=True) + (-2).to_bytes(2, "little", signed=True), 2.0)
    live.take(0x281, (8).to_bytes(4, "little"), 3.0)
    assert stamps == [3.0] and live.values == {"a": -5.0, "b": -2.0, "d": 8.0} and live.received == 3
    live.take(0x281, (9).to_bytes(4, "little"), 4.0)
    assert stamps == [3.0] and live.values["d"] == 9.0
    live.take(0x181, b"\1\0\0\0\1", 5.0)  # too short for both
    live.take(0x281, (9).to_bytes(4, "little"), 6.0)
    assert stamps == [3.0] and live.values["b"] == -2.0 and live.received == 5


@pytest.mark.parametrize(
    ("wanted_s", "sent_s"),
    [(1e-3, 1e-3), (1e-5, 1e-3), (1.4e-3, 1e-3), (1.6e-3, 2e-3), (65.535, 65.535), (100.0, 65.535)],
)
def test_a_period_is_whole_milliseconds(wanted_s: float, sent_s: float) -> None:
    assert sent_every_s(wanted_s) == pytest.approx(sent_s)


def test_values_are_spread_over_the_pdos_and_started() -> None:
    """4 + 2 + 2 bytes fill the first one; it is off until its period and identifier stand."""
    with node_of(dict.fromkeys(VALUES.values(), 0)) as (table, node):
        for number in range(4):
            table.objects |= pdo_objects(0x1800 + number, [])
        before = dict(table.objects)
        with live_values(node, list(VALUES), 2e-3, VALUES) as live:
            used = {
                number: int.from_bytes(table.objects[0x1800 + number, 1], "little") & 0x7FF for number in range(4)
                if table.objects[0x1A00 + number, 0] != b"\0"
            }  # fmt: skip
            assert len(used) == 2 and all(cob == 0x180 + 0x100 * number + NODE for number, cob in used.items())
            first, second = used
            assert table.objects[0x1A00 + first, 0] == b"\3" and table.objects[0x1A00 + second, 0] == b"\2"
            assert table.objects[0x1800 + first, 5] == b"\2\0" and table.objects[0x1800 + first, 2] == b"\xff"
            assert not int.from_bytes(table.objects[0x1800 + first, 1], "little") >> 31
            bus: Any = node.connection.bus
            bus.deliver(used[first], bytes(4) + b"\5\0\6\0")
            bus.deliver(used[second], (12).to_bytes(4, "little") + b"\xff")
            node.connection.wait(0.01)
            assert live.values == {"a": 0.0, "b": 5.0, "c": 6.0, "d": 12.0, "e": -1.0}
            nmt = [data for cob, data in bus.sent if cob == 0]
            assert nmt == [bytes((1, NODE))]
        assert table.objects == before
        assert [data for cob, data in bus.sent if cob == 0][1:] == [bytes((0x80, NODE))], "as it was found"
        bus.deliver(used[first], bytes(8))
        node.connection.wait(0.01)
        assert live.received == 2


def test_three_pdos_are_lent_and_never_the_first() -> None:
    """A master uses that one."""
    six = {f"v{k}": DriveObject(0x2000 + k, 0, "I") for k in range(6)}
    with node_of(dict.fromkeys(six.values(), 0)) as (table, node):
        for number in range(4):
            table.objects |= pdo_objects(0x1800 + number, [])
        with live_values(node, list(six), 1e-3, six):
            filled = [number for number in range(4) if table.objects[0x1A00 + number, 0] == b"\2"]
            assert filled == [1, 2, 3]
        seven = six | {"v6": DriveObject(0x2006, 0, "B")}
        with (
            pytest.raises(NotAvailable, match="7 quantities do not fit 3"),
            live_values(node, list(seven), 1e-3, seven),
        ):
            pass


def test_more_values_than_the_pdos_hold_are_refused() -> None:
    many = {f"v{k}": DriveObject(0x2000 + k, 0, "I") for k in range(9)}
    with node_of({}) as (table, node):
        with pytest.raises(NotAvailable, match="9 quantities do not fit"), live_values(node, list(many), 1e-3, many):
            pass
        assert table.writes == []


# ---- the tool's heartbeat -------------------------------------------------------------------------


class Beats:
    """A bus that counts what is sent, and can fail."""

    def __init__(self) -> None:
        self.t_s, self.fails, self.sent = 100.0, False, list[tuple[int, bytes]]()
        self.clock = self
        self.job: Any = None
        self.stopped = 0

    def now(self) -> float:
        return self.t_s

    def every(self, period_s: float, job: Any) -> Any:
        assert period_s == PERIOD_S
        self.job = job
        return SimpleNamespace(stop=self._stop)

    def _stop(self) -> None:
        self.stopped += 1

    def send(self, cob_id: int, data: bytes, *, patience_s: float) -> None:
        if self.fails:
            raise BusError("gone")
        self.sent.append((cob_id, data))

    def request(self, cob_id: int, length: int) -> None:
        self.send(cob_id, bytes(length), patience_s=0.0)


@pytest.mark.parametrize(
    ("guarded", "pdo", "kind", "frame"),
    [
        (None, None, "heartbeat", (0x77E, b"\x05")), (9, None, "node guarding", (0x709, b"\0")),
        (None, 0x205, "process data", (0x205, b"\0")), (9, 0x205, "process data", (0x205, b"\0")),
    ],
)  # fmt: skip
def test_what_says_that_the_tool_is_alive(
    guarded: int | None, pdo: int | None, kind: str, frame: tuple[int, bytes]
) -> None:
    bus: Any = Beats()
    watched = [True]
    beat = Heartbeat(bus, is_watched=lambda: watched[0])
    beat.guarded_node, beat.expected_pdo = guarded, pdo
    assert beat.kind == kind
    with beat:
        assert bus.sent == [frame]
        bus.t_s += PERIOD_S
        bus.job()
        assert bus.sent == [frame] * 2
        watched[0] = False
        bus.job()
        assert len(bus.sent) == 2, "nobody watches the machine"
        beat.start()
        assert len(bus.sent) == 2, "it runs already"
    assert bus.stopped == 1
    beat.stop()
    assert bus.stopped == 1


def test_the_longest_gap_is_that_since_the_start() -> None:
    bus: Any = Beats()
    beat = Heartbeat(bus)
    beat.start()
    for gap_s in (0.05, 0.30, 0.05):
        bus.t_s += gap_s
        bus.job()
    assert beat.longest_gap_s() == pytest.approx(0.30)
    bus.t_s += 0.4
    assert beat.longest_gap_s() == pytest.approx(0.40), "also the one that lasts"
    beat.stop()
    beat.start()
    assert beat.longest_gap_s() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("fails", "late_s", "sent"), [(False, 0.09, 0), (False, 0.11, 1), (True, 0.0, 1)]
)  # fmt: skip
def test_a_drive_that_ended_operation_watches_again_from_the_next_heartbeat(
    fails: bool, late_s: float, sent: int
) -> None:
    """Sent at once where the last one failed, or is more than two periods old."""
    bus: Any = Beats()
    beat = Heartbeat(bus)
    beat.resume()
    assert len(bus.sent) == 1, "one that was stopped is started"
    bus.t_s += PERIOD_S
    bus.fails = fails
    bus.job()
    bus.fails = False
    bus.sent.clear()
    bus.t_s += late_s
    beat.resume()
    assert len(bus.sent) == sent
    bus.sent.clear()
    beat.resume()
    assert len(bus.sent) == (1 if late_s > 0.1 else 0)
    bus.fails = True
    bus.t_s += 1.0
    with pytest.raises(BusError):
        beat.resume()


def received(number: int, timer: bool = True) -> dict[Any, bytes]:
    raw = pdo_objects(0x1400 + number - 1, [], times=False)
    return raw | ({(0x1400 + number - 1, 5): b"\0\0"} if timer else {})


@pytest.mark.parametrize(
    ("numbers", "fixed", "taken"),
    [
        ((1, 2, 3, 4), {}, 4), ((1, 2), {}, 2), ((1, 2, 3, 4), {(0x1603, 1): 0x06040041}, 3), ((), {}, None),
        ((1,), {(0x1400, 1): 0x06010002}, None), ((2,), {(0x1401, 5): 0x06010002}, None),
    ],
)  # fmt: skip
def test_the_last_pdo_that_can_be_lent_is_expected(
    numbers: tuple[int, ...], fixed: dict[Any, int], taken: int | None
) -> None:
    """The first ones are what a master uses. The empty one maps a dummy byte, at once, with a time in ms."""
    with node_of({}) as (table, node):
        for number in numbers:
            table.objects |= received(number)
        table.objects |= {key: data for key, data in received(3, timer=False).items() if 3 not in numbers}
        table.fixed = dict(fixed)
        before = dict(table.objects)
        assert expects_pdos(node) == bool(numbers)
        cob_id = expect_pdo(node, 250)
        if taken is None:
            assert cob_id is None and table.objects == before and node.before_close == []
            return
        communication = 0x1400 + taken - 1
        assert cob_id == 0x100 + 0x100 * taken + NODE
        assert table.objects[communication, 1] == cob_id.to_bytes(4, "little")
        assert table.objects[communication, 5] == (250).to_bytes(2, "little")
        assert table.objects[communication + 0x200, 1] == (0x00050008).to_bytes(4, "little")
        assert table.objects[communication + 0x200, 0] == b"\1" and table.objects[communication, 2] == b"\xff"
        table.objects[communication, 5] = before[communication, 5]  # who wrote it brings that back
        node.close()
        assert table.objects == before


# ---- objects and limits ---------------------------------------------------------------------------


def changed_of(node: DriveNode) -> ChangedObjects:
    drive: Any = SimpleNamespace(node=node, parameters=DriveParameters(node), replace=None, identity=LENT)
    return ChangedObjects(drive)


A, B, LIMIT = DriveObject(0x6071, 0, "h"), DriveObject(0x60FF, 0, "i"), DriveObject(0x6073, 0, "H")
LENT = Identity(NODE, 0xA51, 2, 3, 417, "", "", "")


@pytest.mark.parametrize("serial", [417, 0])
def test_what_a_killed_run_left_comes_back_with_the_next_command(
    serial: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next download stored the lowered limits of a killed `identify` with its own values, and exited with 0."""
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))  # other tests leave records of drives that fell silent
    killed, identity = {A: 5, B: 6, objects.MODE: 3, objects.STATUSWORD: 0x40}, replace(LENT, serial=serial)
    with node_of(killed, GENERIC) as (table, node):
        changed = changed_of(node)
        changed._drive.identity = identity
        changed.begin()
        for item, value in ((A, 50), (B, 60), (A, 70), (objects.MODE, 4)):
            node.put(item, value)
        assert any_lent() is bool(serial)
        table.objects[0x60FF, 0] = B.encode(61)  # somebody else wrote it since: it stays
        node.before_write = None
        table.objects[0x6041, 0] = objects.STATUSWORD.encode(0x27)
        assert restore_lent(node, identity, print) == 0, "energised"
        table.objects[0x6041, 0] = objects.STATUSWORD.encode(0x40)
        assert restore_lent(node, identity, print) == (2 if serial else 0)
        assert (node.get(A), node.get(B)) == (5.0 if serial else 70.0, 61.0) and not any_lent()
    with node_of({A: 5}, GENERIC) as (_, node):
        changed = changed_of(node)
        changed.begin()
        node.put(A, 50)
        assert any_lent() and changed.restore() == 1 and not any_lent()


def test_what_a_drive_refuses_to_take_back_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    with node_of({A: 5, B: 6, objects.STATUSWORD: 0x40}, GENERIC) as (table, node):
        changed = changed_of(node)
        changed.begin()
        node.put(A, 50)
        node.put(B, 60)
        node.before_write = None
        kept = table.objects.pop((0x6071, 0))
        assert restore_lent(node, LENT, print) == 1 and node.get(B) == 6.0 and any_lent()
        table.objects[0x6071, 0] = kept
        assert restore_lent(node, LENT, print) == 1 and node.get(A) == 5.0 and not any_lent()


@pytest.mark.parametrize("text", ["{", "[1]", '{"6073:00": 5}', '{"6073:00": ["zz", "05"]}', "\xff"])
def test_a_damaged_record_of_a_killed_run_is_said(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was dropped without a word, or ended in a traceback, and the lowered limits could have been stored."""
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path))
    said: list[str] = []
    with node_of({A: 5, objects.STATUSWORD: 0x40}, GENERIC) as (_, node):
        changed_of(node)._keep()
        (record,) = (tmp_path / "lent").glob("*.json")
        record.write_text(text, encoding="latin-1")
        assert restore_lent(node, LENT, said.append) == 0 and not any_lent()
    assert "may still be lowered" in said[0] and "nmt reset-node" in said[0] and str(record) in said[0]


def test_what_was_changed_comes_back_in_reverse_and_once() -> None:
    with node_of({A: 5, B: 6, objects.MODE: 3}, GENERIC) as (table, node):
        changed = changed_of(node)
        changed.begin()
        for item, value in ((A, 50), (B, 60), (A, 70), (objects.MODE, 4)):
            node.put(item, value)
        assert (changed.held_before(A), changed.held_before(B)) == (5.0, 6.0)
        assert changed.held_before(objects.STATUSWORD) is None
        table.objects[0x60FF, 0] = B.encode(6)  # the drive brought it back by itself
        table.writes.clear()
        assert changed.restore() == 2
        assert table.written(A, B, objects.MODE) == [(objects.MODE, 3), (A, 5)]
        node.put(A, 1)
        assert changed.held_before(A) == 5.0 and node.before_write is None, "no longer noted"


@pytest.mark.parametrize(
    ("item", "code", "named"),
    [(LIMIT, 0x06090030, "0x6073:00: node refused"), (objects.MODE, 0x06090030, ""), (A, 0x08000022, "")],
)  # fmt: skip
def test_a_refused_old_value_is_named_but_of_mode_and_targets(item: DriveObject, code: int, named: str) -> None:
    with node_of({A: 5, objects.MODE: 3, LIMIT: 5}, GENERIC) as (table, node):
        changed = changed_of(node)
        changed.begin()
        node.put(item, 9)
        table.fixed[item.index, 0] = code
        if not named:
            assert changed.restore() == 0
            return
        with pytest.raises(VerifyMismatch) as caught:
            changed.restore()
        assert caught.value.differences[0].startswith(named) and len(caught.value.differences) == 1


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (VerifyMismatch("the drive does not hold it", differences=["motor.R_s_ohm: wrote 1, reads 2"]), "wrote 1"),
        (DriveFault("the drive refused 1 of 1 value"), "refused 1 of 1"),
        (SdoAbort(0x06090030, 0x2010, 2, "node refused: value"), "node refused"),
    ],
)  # fmt: skip
def test_the_limits_come_back_where_a_parameter_does_not(error: Exception, told: str) -> None:
    """They had stayed lowered: the parameters came first, and their error ended the restore."""

    def refused(changed: object) -> None:
        raise error

    with node_of({A: 5, B: 6}, reference_map()) as (table, node):
        table.objects[0x2010, 2] = bytes(4)
        changed = changed_of(node)
        changed._drive.replace = refused  # type: ignore[method-assign]
        changed.begin()
        node.put(A, 50)
        node.put(B, 60)
        node.write_bytes(0x2010, 2, b"\0\0\x80\x3f")
        with pytest.raises(VerifyMismatch, match="not everything could be restored") as caught:
            changed.restore()
        assert [told in line for line in caught.value.differences] == [True]
        assert (table.number(A), table.number(B)) == (5, 6)


@pytest.mark.parametrize(("code", "busy_s", "comes_back"), [(0x08000021, 4.5, True), (0x08000022, 9.0, False)])
def test_a_busy_drive_is_asked_again_for_its_old_values(code: int, busy_s: float, comes_back: bool) -> None:
    """It had been left with lowered limits where it was busy for an instant, or refused one object for its state."""
    with node_of({A: 5, LIMIT: 6}, GENERIC) as (table, node):
        changed = changed_of(node)
        changed.begin()
        node.put(A, 50)
        node.put(LIMIT, 60)
        table.fixed[LIMIT.index, 0] = code
        table.bus.clock.after(busy_s, table.fixed.clear)
        if comes_back:
            assert changed.restore() == 2 and busy_s < node.connection.clock.now() < busy_s + 0.2
        else:
            with pytest.raises(SdoAbort):
                changed.restore()
            assert node.connection.clock.now() < 5.3 and table.number(A) == 5, "the others came back"


def test_an_object_that_takes_its_old_value_and_does_not_keep_it() -> None:
    item = DriveObject(0x2042, 0, "Q")
    with node_of({item: 0x0102030405060708}, GENERIC) as (table, node):
        changed = changed_of(node)
        changed.begin()
        node.write_bytes(0x2042, 0, bytes(12))
        table.shown[item] = lambda: 7
        with pytest.raises(VerifyMismatch) as caught:
            changed.restore()
        assert caught.value.differences == ("0x2042:00 does not hold 08 07 06 05 04 03 02 01 again",)


@pytest.mark.parametrize(
    ("wanted", "most", "kept"),
    [(1.0, 9.0, 1.0), (1.09, 9.0, 1.0), (9.0, 1.05, 1.0), (LEAST_COUNTS * 0.1, 9.0, LEAST_COUNTS * 0.1),
     (LEAST_COUNTS * 0.1 - 0.01, 9.0, None), (9.0, 0.2, None)],
)  # fmt: skip
def test_a_limit_is_kept_in_whole_counts_and_never_above(wanted: float, most: float, kept: float | None) -> None:
    """One count is 0.1 A; below four of them the drive is not asked."""
    with node_of({objects.MAX_CURRENT_PERMILLE: 77}) as (table, node):
        found = put_limit(node, Quantity(objects.MAX_CURRENT_PERMILLE, 0.1), wanted, most)
        assert found == (None if kept is None else pytest.approx(kept))
        held = table.number(objects.MAX_CURRENT_PERMILLE)
        assert held == (77 if kept is None else round(10.0 * kept))
        table.fixed[0x6073, 0] = 0x08000022
        assert put_limit(node, Quantity(objects.MAX_CURRENT_PERMILLE, 0.1), 2.0, 9.0) is None
        assert put_limit(node, None, 2.0, 9.0) is None


RATED: Held = {objects.RATED_CURRENT_MA: 4000}
RATED_APK = 4.0 * math.sqrt(2.0)


@pytest.mark.parametrize(
    ("more", "bounded", "current", "speed"),
    [
        ({objects.MAX_CURRENT_PERMILLE: 3000, objects.MAX_SPEED_RPM: 6000}, False, ("0x6073", 531), ("0x6080", 955)),
        ({objects.MAX_CURRENT_PERMILLE: 500, objects.MAX_SPEED_RPM: 900}, False, ("0x6073", 500), ("0x6080", 900)),
        ({MAX_TORQUE_PERMILLE: 3000}, True, ("0x6072", 531), None), ({}, True, None, None),
        ({objects.MAX_CURRENT_PERMILLE: 3000}, False, "lacks", None),
        ({objects.MAX_SPEED_RPM: 6000}, False, "lacks", None),
    ],
)  # fmt: skip
def test_the_drives_own_limits_are_lowered_to_the_envelope(more: Held, bounded: bool, current: Any, speed: Any) -> None:
    """3 A of 5.66 A are 530.3 permille, 100 rad/s are 954.9 rpm: rounded up, and never raised."""
    with node_of({**RATED, **more}, GENERIC) as (table, node):
        drive: Any = SimpleNamespace(node=node, commands_bounded_current=bounded, shows_apk=math.inf)
        envelope = Envelope(i_max_apk=3.0, speed_max_rad_s=100.0)
        if current == "lacks":
            with pytest.raises(NotAvailable, match="no current and speed limit"):
                lower_limits(drive, envelope)
            return
        found = lower_limits(drive, envelope)
        for quantity, most, expected, unit in (
            (found.current, found.most_apk, current, 1e-3 * RATED_APK), (found.speed, found.most_rpm, speed, 1.0),
        ):  # fmt: skip
            if expected is None:
                assert quantity is None and most == math.inf
            else:
                assert str(quantity) == expected[0] and most == pytest.approx(expected[1] * unit)
                assert quantity is not None and table.number(quantity.item) == expected[1]


@pytest.mark.parametrize(("ratio", "refused"), [(30.0, False), (30.1, True), (math.inf, True), (math.nan, True)])
def test_a_limit_of_more_than_thirty_times_the_rated_current_is_none(ratio: float, refused: bool) -> None:
    with node_of(RATED, GENERIC) as (_, node):
        drive: Any = SimpleNamespace(node=node, commands_bounded_current=True, shows_apk=math.inf)
        envelope = Envelope(i_max_apk=ratio * RATED_APK, speed_max_rad_s=100.0)
        if not refused:
            lower_limits(drive, envelope)
            return
        with pytest.raises(SafetyRefusal, match="is none: the drive is rated 5.657 A"):
            lower_limits(drive, envelope)


@pytest.mark.parametrize(("holds", "refused"), [(600, True), (531, False), (400, False)])
def test_a_limit_that_the_drive_does_not_hold_is_refused(holds: int, refused: bool) -> None:
    with node_of({**RATED, objects.MAX_CURRENT_PERMILLE: 3000}, GENERIC) as (table, node):
        reads = [3000, holds]
        table.shown[objects.MAX_CURRENT_PERMILLE] = lambda: reads[bool(table.writes)]
        drive: Any = SimpleNamespace(node=node, commands_bounded_current=True, shows_apk=math.inf)
        envelope = Envelope(i_max_apk=3.0, speed_max_rad_s=100.0)
        if not refused:
            assert lower_limits(drive, envelope).most_apk == pytest.approx(531e-3 * RATED_APK)
            return
        with pytest.raises(SafetyRefusal, match="holds the limit 600, not the 531") as caught:
            lower_limits(drive, envelope)
        assert "0x6073:00" in caught.value.where


def test_states_that_the_tool_says_of_itself() -> None:
    assert (NmtState.OPERATIONAL, beating.DUMMY, len(beating.NUMBERS)) == (5, b"\0", 4)
