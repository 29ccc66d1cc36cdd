# SPDX-License-Identifier: MIT
"""What a drive lends and gets back: PDOs; and what the tool sends to say that it is alive."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.heartbeat import PERIOD_S, Heartbeat, expect_pdo, expects_pdos
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.process_data import BorrowedPdo, LiveValues, live_values, sent_every_s
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import BusError, NotAvailable, VerifyMismatch
from tests.bus.scripted import NODE
from tests.drive.table_drive import TableDrive, node_of

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
        node.may_try = True
        assert expects_pdos(node) == any((0x1400 + number - 1, 5) not in fixed for number in numbers)
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
