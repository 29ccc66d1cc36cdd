# SPDX-License-Identifier: MIT
"""Process data objects: mapping rules, transmission types, inhibit and event timers, reception."""

from __future__ import annotations

import struct

import pytest

from pmsmtool.bus.abort_codes import AbortCode
from tests.node.bench import Bench
from tests.node.raw_client import Aborted, RawClient

OFF = 1 << 31


def map_pdo(client: RawClient, comm: int, words: list[int], cob_id: int, kind: int, *, event_ms: int = 0) -> None:
    mapping = comm + 0x200
    client.put(comm, 1, cob_id | OFF)
    client.put(mapping, 0, 0, "B")
    for number, word in enumerate(words, 1):
        client.put(mapping, number, word)
    client.put(mapping, 0, len(words), "B")
    client.put(comm, 2, kind, "B")
    if event_ms:
        client.put(comm, 5, event_ms, "H")
    client.put(comm, 1, cob_id)


def test_statusword_is_sent_at_start_and_on_every_change_only(bench: Bench) -> None:
    bench.nmt(1)
    bench.client.put(0x6040, 0, 6, "H")
    bench.client.put(0x6040, 0, 6, "H")
    heard = [*bench.client.heard(0x181), *bench.frames(0x181, 1.0)]
    assert [int.from_bytes(data, "little") & 0x6F for data in heard] == [0x40, 0x21]


def test_nothing_is_sent_or_taken_outside_operational(bench: Bench) -> None:
    bench.client.send(struct.pack("<H", 6), 0x201)
    assert bench.frames(0x181, 0.5) == []
    assert bench.client.number(0x6041, 0, "H") == 0x240 | 0x10


def test_received_controlword_acts_at_once(bench: Bench) -> None:
    bench.nmt(1)
    for word in (6, 7, 15):
        bench.client.send(struct.pack("<H", word), 0x201)
    assert int(bench.client.number(0x6041, 0, "H")) & 0x6F == 0x27


def test_synchronous_pdos_wait_for_sync(bench: Bench) -> None:
    client = bench.client
    map_pdo(client, 0x1802, [0x20700120, 0x20700220], 0x381, 2)
    map_pdo(client, 0x1400, [0x60400010], 0x201, 0)
    bench.nmt(1)
    client.send(struct.pack("<H", 6), 0x201)
    assert int(client.number(0x6041, 0, "H")) & 0x6F == 0x40
    client.send(b"", 0x080)
    assert int(client.number(0x6041, 0, "H")) & 0x6F == 0x21
    assert client.heard(0x381) == []
    client.send(b"", 0x080)
    assert len(bench.frames(0x381, 0.01)) == 1


def test_event_timer_and_content(bench: Bench) -> None:
    client = bench.client
    map_pdo(client, 0x1802, [0x20700720, 0x20700820], 0x381, 255, event_ms=10)
    bench.nmt(1)
    frames = [message for message in bench.listen(0.1) if message.arbitration_id == 0x381]
    assert len(frames) == 10
    assert struct.unpack("<2f", frames[-1].data) == (0.0, 300.0)


def test_inhibit_time_spaces_a_changing_pdo(bench: Bench) -> None:
    client = bench.client
    client.put(0x1800, 3, 1000, "H")
    bench.nmt(1)
    for word in (6, 7, 15, 0, 6):
        client.put(0x6040, 0, word, "H")
    heard = [message for message in [*client.others, *bench.listen(0.5)] if message.arbitration_id == 0x181]
    assert len(heard) == 2
    assert heard[1].timestamp - heard[0].timestamp == pytest.approx(0.1, abs=1e-3)
    assert int.from_bytes(heard[1].data, "little") & 0x6F == 0x21


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ([0x10180420], AbortCode.NOT_MAPPABLE),
        ([0x47110020], AbortCode.NO_OBJECT),
        ([0x20700110], AbortCode.PDO_LENGTH),
        ([0x20700120, 0x20700220, 0x20700320], AbortCode.PDO_LENGTH),
    ],
)
def test_wrong_mappings_are_refused(bench: Bench, words: list[int], code: int) -> None:
    with pytest.raises(Aborted) as caught:
        map_pdo(bench.client, 0x1803, words, 0x481, 255)
    assert caught.value.code == code


def test_a_valid_pdo_must_be_switched_off_before_it_is_changed(bench: Bench) -> None:
    client = bench.client
    for index, sub, value, letter in ((0x1A00, 0, 0, "B"), (0x1A00, 1, 0x60610008, "I"), (0x1800, 1, 0x182, "I")):
        with pytest.raises(Aborted):
            client.put(index, sub, value, letter)
    client.put(0x1800, 1, OFF | 0x182)
    client.put(0x1A00, 0, 0, "B")
    client.put(0x1A00, 1, 0x60610008)
    client.put(0x1A00, 0, 1, "B")
    client.put(0x1800, 1, 0x182)
    bench.nmt(1)
    assert bench.frames(0x182, 0.1) == [b"\x00"]


def test_a_short_pdo_is_an_emergency_and_not_taken(bench: Bench) -> None:
    bench.nmt(1)
    bench.client.send(b"\x06", 0x201)
    assert bench.frames(0x081, 0.1)[0][:2] == b"\x10\x82"
    assert int(bench.client.number(0x6041, 0, "H")) & 0x6F == 0x40


def test_live_gains_arrive_by_pdo_and_bad_values_are_left(bench: Bench) -> None:
    client = bench.client
    map_pdo(client, 0x1402, [0x20200120, 0x20200220], 0x401, 255)
    bench.nmt(1)
    client.send(struct.pack("<2f", 1.5, -1.0), 0x401)
    assert client.number(0x2020, 1, "f") == 1.5
    assert client.number(0x2020, 2, "f") == 411
