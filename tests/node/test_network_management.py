# SPDX-License-Identifier: MIT
"""NMT, boot-up, heartbeats both ways, emergency messages, error history, identity."""

from __future__ import annotations

import pytest

from pmsmtool.bus.abort_codes import AbortCode
from tests.node.bench import SERIAL, Bench
from tests.node.conftest import BenchMaker
from tests.node.raw_client import Aborted

MS = 1e-3


def test_a_drive_that_has_been_on_sends_heartbeats_of_its_default_period(bench: Bench) -> None:
    found = [(round(message.timestamp, 3), bytes(message.data)) for message in bench.listen(1.05)]
    assert found == [(0.2, b"\x7f"), (0.4, b"\x7f"), (0.6, b"\x7f"), (0.8, b"\x7f"), (1.0, b"\x7f")]


@pytest.mark.parametrize(("command", "shown"), [(1, 5), (2, 4), (128, 127)])
def test_heartbeat_shows_the_state_the_master_commanded(bench: Bench, command: int, shown: int) -> None:
    bench.nmt(command)
    assert bench.frames(0x701, 0.25)[-1] == bytes((shown,))


def test_commands_for_another_node_are_not_ours_and_zero_means_all(bench: Bench) -> None:
    bench.nmt(2, node=5)
    assert bench.frames(0x701, 0.25) == [b"\x7f"]
    bench.nmt(2, node=0)
    assert bench.frames(0x701, 0.25) == [b"\x04"]


@pytest.mark.parametrize("command", [129, 130])
def test_reset_ends_in_boot_up_and_pre_operational(bench: Bench, command: int) -> None:
    bench.nmt(1)
    bench.listen(0.05)
    bench.nmt(command)
    frames = bench.frames(0x701, 0.5)
    assert frames[0] == b"\x00"
    assert set(frames[1:]) == {b"\x7f"}


@pytest.mark.parametrize("command", [2, 129, 130])
def test_a_master_that_ends_the_connection_does_not_leave_the_drive_enabled(bench: Bench, command: int) -> None:
    enable(bench)
    bench.nmt(command)
    bench.wait(0.2)
    bench.nmt(128)
    bench.client.drain()
    assert int(bench.client.number(0x6041, 0, "H")) & 0x6F == 0x40
    assert bench.core.restarts == (command == 129)


@pytest.mark.parametrize(("option", "state"), [(0, 0x27), (1, 0x08), (2, 0x40), (3, 0x40)])
def test_abort_connection_option_also_holds_for_an_nmt_stop(bench: Bench, option: int, state: int) -> None:
    bench.client.put(0x6007, 0, option, "h")
    enable(bench)
    bench.nmt(2)
    bench.wait(0.2)
    bench.nmt(128)
    assert int(bench.client.number(0x6041, 0, "H")) & (0x4F if state in (0x08, 0x40) else 0x6F) == state
    assert bench.client.number(0x603F, 0, "H") == (0x8100 if option == 1 else 0)


def test_an_nmt_stop_of_a_disabled_drive_is_no_fault(bench: Bench) -> None:
    bench.client.put(0x6007, 0, 1, "h")
    bench.nmt(2)
    bench.nmt(128)
    assert int(bench.client.number(0x6041, 0, "H")) & 0x6F == 0x40


def test_no_emergency_is_sent_while_stopped(bench: Bench) -> None:
    bench.nmt(2)
    bench.core.trip_at[bench.core.periods + 20] = 0x2310
    assert bench.frames(0x081, 0.1) == []
    bench.nmt(128)
    assert bench.client.number(0x1003, 1) == 0x2310


def test_reset_communication_brings_back_communication_defaults_only(bench: Bench) -> None:
    bench.client.put(0x1017, 0, 50, "H")
    bench.client.put(0x6007, 0, 1, "h")
    bench.nmt(130)
    bench.wait(0.1)
    bench.client.drain()
    assert bench.client.number(0x1017, 0, "H") == 200
    assert bench.client.number(0x6007, 0, "h") == 1


def enable(bench: Bench) -> None:
    for word in (0x06, 0x07, 0x0F):
        bench.client.put(0x6040, 0, word, "H")


def consume(bench: Bench, node: int, period_ms: int) -> None:
    bench.client.put(0x1016, 1, node << 16 | period_ms)


def test_a_lost_heartbeat_is_reported_after_its_time_and_not_before(bench: Bench) -> None:
    consume(bench, 0x7F, 100)
    for _ in range(5):
        bench.client.send(b"\x05", 0x77F)
        assert bench.frames(0x081, 0.09) == []
    started = bench.bus.clock.now()
    emergencies = [message for message in bench.listen(0.5) if message.arbitration_id == 0x081]
    assert [bytes(message.data) for message in emergencies] == [bytes.fromhex("3081117f00000000")]
    assert emergencies[0].timestamp - started == pytest.approx(0.01, abs=0.002)


def test_a_heartbeat_that_comes_back_clears_the_error(bench: Bench) -> None:
    consume(bench, 0x7F, 100)
    bench.client.send(b"\x05", 0x77F)
    assert bench.frames(0x081, 0.2) == [bytes.fromhex("3081117f00000000")]
    assert bench.client.number(0x1001, 0, "B") == 0x11
    bench.client.send(b"\x05", 0x77F)
    assert bench.frames(0x081, 0.05) == [bytes(8)]
    assert bench.client.number(0x1001, 0, "B") == 0
    assert bench.client.number(0x1003, 0, "B") == 1, "the history keeps it"


def test_a_consumer_that_is_taken_away_clears_the_error(bench: Bench) -> None:
    consume(bench, 0x7F, 100)
    bench.client.send(b"\x05", 0x77F)
    bench.wait(0.2)
    bench.client.put(0x1016, 1, 0)
    assert bench.client.number(0x1001, 0, "B") == 0


def test_errors_without_a_fault_are_acknowledged_by_a_fault_reset_and_others_stay_listed(bench: Bench) -> None:
    bench.nmt(1)
    bench.client.send(b"\x06", 0x201)
    bench.wait(0.01)
    assert bench.client.number(0x1001, 0, "B") == 0x11
    bench.client.put(0x6040, 0, 0x80, "H")
    assert bench.client.number(0x1001, 0, "B") == 0
    assert bench.client.heard(0x081) == [bytes.fromhex("1082110000000000"), bytes(8)]


def test_watching_begins_with_the_first_heartbeat(bench: Bench) -> None:
    consume(bench, 0x7F, 100)
    assert bench.frames(0x081, 1.0) == []


def test_one_producer_has_one_consumer_entry(bench: Bench) -> None:
    consume(bench, 0x7F, 100)
    with pytest.raises(Aborted) as caught:
        bench.client.put(0x1016, 2, 0x7F << 16 | 50)
    assert caught.value.code == AbortCode.INCOMPATIBLE
    bench.client.put(0x1016, 1, 0)
    bench.client.put(0x1016, 2, 0x7F << 16 | 50)


@pytest.mark.parametrize(("behaviour", "shown"), [(0, 127), (1, 5), (2, 4)])
def test_error_behaviour_decides_the_nmt_state_after_a_lost_heartbeat(bench: Bench, behaviour: int, shown: int) -> None:
    bench.client.put(0x1029, 1, behaviour, "B")
    consume(bench, 0x7F, 50)
    bench.nmt(1)
    bench.client.send(b"\x05", 0x77F)
    assert bench.frames(0x701, 0.35)[-1] == bytes((shown,))


@pytest.mark.parametrize(
    ("option", "state", "standing"),
    [(0, 0x27, False), (1, 0x08, True), (2, 0x40, True), (3, 0x40, True)],
)
def test_abort_connection_option_decides_what_the_enabled_drive_does(
    bench: Bench, option: int, state: int, standing: bool
) -> None:
    client = bench.client
    client.put(0x6007, 0, option, "h")
    consume(bench, 0x7F, 50)
    client.put(0x6060, 0, 3, "b")
    client.put(0x60FF, 0, 100_000, "i")
    enable(bench)
    for _ in range(10):
        client.send(b"\x05", 0x77F)
        bench.wait(0.04)
    assert bench.core.omega > 5.0
    bench.wait(0.5)
    mask = 0x4F if state in (0x08, 0x40) else 0x6F
    assert int(client.number(0x6041, 0, "H")) & mask == state
    assert (abs(bench.core.omega) < 5.0 or option == 2) is standing


def test_error_history_lists_the_latest_first_and_can_be_cleared(bench: Bench) -> None:
    for code in (0x3210, 0x2310):
        bench.core.trip_at[bench.core.periods + 20] = code
        bench.wait(0.1)
        bench.core.persistent_trip = 0
        bench.client.put(0x6040, 0, 0, "H")
        bench.client.put(0x6040, 0, 0x80, "H")
    assert bench.client.number(0x1003, 0, "B") == 2
    assert [bench.client.number(0x1003, sub) for sub in (1, 2, 3)] == [0x2310, 0x3210, 0]
    with pytest.raises(Aborted):
        bench.client.put(0x1003, 0, 1, "B")
    bench.client.put(0x1003, 0, 0, "B")
    assert bench.client.number(0x1003, 0, "B") == 0


def test_emergencies_keep_the_inhibit_time(bench: Bench) -> None:
    bench.client.put(0x1015, 0, 500, "H")
    bench.core.trip_at[bench.core.periods + 100] = 0x2310
    bench.wait(0.02)
    bench.client.put(0x6040, 0, 0x80, "H")
    heard = [*bench.client.others, *bench.listen(0.2)]
    stamps = [message.timestamp for message in heard if message.arbitration_id == 0x081]
    assert len(stamps) == 2
    assert stamps[1] - stamps[0] == pytest.approx(0.05, abs=1e-6)


def test_identity_and_names(bench: Bench) -> None:
    client = bench.client
    assert client.number(0x1000) == 0x00020192
    assert [client.number(0x1018, sub) for sub in (1, 2, 3, 4)] == [0x706D736D, 1, 0x00010000, SERIAL]
    assert client.read(0x1008) == b"test drive"


def test_several_drives_share_a_line(make_bench: BenchMaker) -> None:
    bench = make_bench(nodes=3)
    serials = []
    for node in (1, 2, 3):
        bench.client.node = node
        serials.append(bench.client.number(0x1018, 4))
    assert serials == [SERIAL, SERIAL + 1, SERIAL + 2]
    assert sorted(set(bench.ids(0.3)) & {0x701, 0x702, 0x703}) == [0x701, 0x702, 0x703]
