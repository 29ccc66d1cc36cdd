# SPDX-License-Identifier: MIT
"""PmsmSimBus as python-can sees it: time, frames, filters, threads, several programs on one line."""

from __future__ import annotations

import gc
import threading
import time
from typing import Any

import can
import pytest

from pmsmtool.bus.frame_time import frame_bits, unstuffed_bits
from pmsmtool.sim import bus as simulated
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.line import Frame, Line
from tests.node.bench import Bench
from tests.node.conftest import BenchMaker

pytestmark = pytest.mark.wall_clock


def message(can_id: int, data: bytes = b"", **more: Any) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=more.pop("is_extended_id", False), **more)


READ_SERIAL = bytes.fromhex("4018100400000000")


def test_an_idle_listener_lets_virtual_time_pass_and_sees_heartbeats(bench: Bench) -> None:
    started = time.monotonic()
    found = [bench.bus.recv(10.0) for _ in range(50)]
    assert [(m.arbitration_id, round(m.timestamp, 3)) for m in found if m is not None] == [
        (0x701, round(0.2 * k, 3)) for k in range(1, 51)
    ]
    assert time.monotonic() - started < 2.0


def test_a_time_out_takes_exactly_its_time(bench: Bench) -> None:
    bench.client.put(0x1017, 0, 0, "H")
    now = bench.bus.clock.now_ns
    assert bench.bus.recv(1.5) is None
    assert bench.bus.clock.now_ns == now + 1_500_000_000


def test_a_polling_program_gets_on(bench: Bench) -> None:
    polls = 0
    while bench.bus.recv(0) is None:
        polls += 1
    assert 1000 < polls < 25_000


def test_send_takes_the_time_of_the_frame_and_the_answer_another(bench: Bench) -> None:
    start = bench.bus.clock.now_ns
    bench.bus.send(message(0x601, READ_SERIAL))
    assert bench.bus.clock.now_ns - start == unstuffed_bits(8) * 1000
    answer = bench.bus.recv(1.0)
    assert answer is not None
    assert bench.bus.clock.now_ns - start == 2 * unstuffed_bits(8) * 1000
    assert answer.timestamp == bench.bus.clock.now()


@pytest.mark.parametrize("bitrate", [125_000, 500_000, 1_000_000])
def test_with_a_bit_rate_every_frame_takes_its_stuffed_length(make_bench: BenchMaker, bitrate: int) -> None:
    bench = make_bench(bitrate=bitrate)
    start = bench.bus.clock.now_ns
    bench.bus.send(message(0x601, READ_SERIAL))
    answer = bench.bus.recv(1.0)
    assert answer is not None
    bits = frame_bits(0x601, READ_SERIAL) + frame_bits(0x581, bytes(answer.data))
    assert bench.bus.clock.now_ns - start == bits * 1_000_000_000 // bitrate
    assert bench.line.wire_ns == bench.bus.clock.now_ns - start
    assert bench.line.frames == 2


def test_the_lowest_identifier_wins_when_the_wire_becomes_free(bench: Bench) -> None:
    standard = [Frame(can_id, b"a") for can_id in (0x300, 0x7FF, 0x123, 0x080)]
    frames = [*standard, Frame(0x123 << 18 | 5, b"c", 1)]
    with bench.bus.clock.held:
        for frame in frames:
            bench.bus._in_flight += 1
            bench.line.queue(bench.bus, frame)
    second = PmsmSimBus("bench", line=bench.line)
    order = [second.recv(0.01) for _ in frames]
    second.shutdown()
    assert [m.arbitration_id for m in order if m is not None] == [0x300, 0x080, 0x123, 0x123 << 18 | 5, 0x7FF]


def test_what_waited_goes_before_the_answer_to_a_frame_that_has_just_come(bench: Bench) -> None:
    """A node reads a frame before it answers; meanwhile the wire is free for what waited."""
    second = PmsmSimBus("bench", line=bench.line)
    with bench.bus.clock.held:
        for frame in (Frame(0x601, READ_SERIAL), Frame(0x7FF, b"a")):
            bench.bus._in_flight += 1
            bench.line.queue(bench.bus, frame)
    order = [second.recv(0.01) for _ in range(3)]
    second.shutdown()
    assert [m.arbitration_id for m in order if m is not None] == [0x601, 0x7FF, 0x581]


def test_programs_on_one_line_hear_each_other_and_themselves_on_request(bench: Bench) -> None:
    second = PmsmSimBus("bench", line=bench.line, receive_own_messages=True)
    second.send(message(0x123, b"hello"))
    heard, own = bench.bus.recv(0.01), second.recv(0.01)
    assert heard is not None
    assert own is not None
    assert (heard.arbitration_id, bytes(heard.data), heard.is_rx) == (0x123, b"hello", True)
    assert (own.arbitration_id, own.is_rx) == (0x123, False)
    second.shutdown()
    bench.bus.send(message(0x124))
    assert bench.bus.recv(0.01) is None


def test_extended_and_remote_frames_pass_and_mean_nothing_to_the_drive(bench: Bench) -> None:
    second = PmsmSimBus("bench", line=bench.line)
    bench.bus.send(message(0x601, READ_SERIAL, is_extended_id=True))
    bench.bus.send(message(0x601, dlc=8, is_remote_frame=True))
    first, remote = second.recv(0.01), second.recv(0.01)
    assert first is not None
    assert remote is not None
    assert (first.is_extended_id, first.dlc) == (True, 8)
    assert (remote.is_remote_frame, remote.dlc, len(remote.data)) == (True, 8, 0)
    assert bench.bus.recv(0.05) is None
    second.shutdown()


def test_filters_are_python_cans(bench: Bench) -> None:
    bench.bus.set_filters([{"can_id": 0x581, "can_mask": 0x7FF}])
    bench.bus.send(message(0x601, READ_SERIAL))
    bench.bus.clock.wait(1.0)
    heard = [bench.bus.recv(0.0) for _ in range(3)]
    assert [m.arbitration_id for m in heard if m is not None] == [0x581]


def test_a_shut_down_bus_raises_python_cans_errors(bench: Bench) -> None:
    bench.bus.shutdown()
    with pytest.raises(can.CanOperationError):
        bench.bus.send(message(0x123))
    with pytest.raises(can.CanOperationError):
        bench.bus.recv(0.1)
    bench.bus.shutdown()


def test_fd_frames_are_refused(bench: Bench) -> None:
    with pytest.raises(can.CanOperationError, match="classic"):
        bench.bus.send(message(0x123, is_fd=True))


def test_nobody_to_acknowledge_fills_the_queue_and_says_so(bench: Bench) -> None:
    bench.node.plugged = False
    for _ in range(8):
        bench.bus.send(message(0x601, READ_SERIAL))
    with pytest.raises(can.CanOperationError, match="no node acknowledges") as caught:
        bench.bus.send(message(0x601, READ_SERIAL))
    assert caught.value.error_code is not None
    bench.node.plug_in()
    bench.bus.send(message(0x601, READ_SERIAL))
    assert bench.bus.recv(0.1) is not None


def test_a_program_at_the_wrong_bit_rate_hears_error_frames_only() -> None:
    line = Line(500_000)
    right = PmsmSimBus("bench", line=line, bitrate=500_000)
    wrong = PmsmSimBus("bench", line=line, bitrate=250_000)
    right.send(message(0x123, b"x"))
    heard = wrong.recv(0.1)
    assert heard is not None
    assert heard.is_error_frame
    right.shutdown()
    wrong.shutdown()


def test_periodic_messages_run_on_the_virtual_clock(bench: Bench) -> None:
    second = PmsmSimBus("bench", line=bench.line)
    task = bench.bus.send_periodic(message(0x77F, b"\x05"), 0.1, duration=1.0)
    stamps = []
    while (heard := second.recv(2.0)) is not None:
        if heard.arbitration_id == 0x77F:
            stamps.append(round(heard.timestamp, 2))
        if bench.bus.clock.now() > 3.0:
            break
    assert stamps == [round(0.1 * k, 2) for k in range(10)]
    assert isinstance(task, can.CyclicSendTaskABC)
    task.stop()
    second.shutdown()


def test_a_heartbeat_of_the_program_keeps_the_drive_content_while_it_waits(bench: Bench) -> None:
    """``clock.every`` fires inside ``clock.wait``: the tool's heartbeat survives whatever the main thread does."""
    bench.client.put(0x1016, 1, 0x7F << 16 | 100)
    ticker = bench.bus.clock.every(0.05, lambda: bench.bus.send(message(0x77F, b"\x05")))
    bench.wait(5.0)
    assert bench.client.number(0x1003, 0, "B") == 0
    ticker.stop()
    bench.wait(0.2)
    assert bench.client.number(0x1003, 1) == 0x8130


def test_a_reader_thread_does_not_run_away_with_the_time(bench: Bench) -> None:
    """A Notifier reads while its owner thinks for 0.3 s: about 0.3 s pass, not hours; frames arrive at once."""
    heard: list[can.Message] = []
    notifier = can.Notifier(bench.bus, [heard.append], timeout=1.0)
    started = bench.bus.clock.now()
    time.sleep(0.3)
    bench.bus.send(message(0x601, READ_SERIAL))
    limit = time.monotonic() + 2.0
    sent = time.monotonic()
    while not any(m.arbitration_id == 0x581 for m in heard) and time.monotonic() < limit:
        time.sleep(0.0005)
    waited = time.monotonic() - sent
    passed = bench.bus.clock.now() - started
    notifier.stop()
    assert any(m.arbitration_id == 0x581 for m in heard)
    assert waited < 0.1
    assert 0.2 < passed < 1.0
    assert any(m.arbitration_id == 0x701 for m in heard)


@pytest.mark.chain
def test_another_thread_can_become_the_one_that_drives_time(bench: Bench) -> None:
    elapsed: list[float] = []

    def listen() -> None:
        bench.bus.receive_in_this_thread()
        started = time.monotonic()
        for _ in range(100):
            bench.bus.recv(10.0)
        elapsed.append(time.monotonic() - started)

    thread = threading.Thread(target=listen)
    thread.start()
    thread.join(20.0)
    assert elapsed
    assert elapsed[0] < 2.0
    assert bench.bus.clock.now() == pytest.approx(20.0, abs=0.1)


def test_threads_may_send_at_any_time(bench: Bench) -> None:
    """Four threads send while the main thread receives: every request is answered once."""

    def ask() -> None:
        for _ in range(50):
            bench.bus.send(message(0x601, READ_SERIAL))

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    answers = [m for m in bench.listen(0.3) if m.arbitration_id == 0x581]
    assert len(answers) == 200


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_forgotten_bus_is_collected_in_the_middle_of_joining_and_leaving() -> None:
    """Python may collect one at any instruction, also where its own thread holds the table of lines."""
    forgotten = [PmsmSimBus(line=Line())]

    def collect_inside() -> None:
        with simulated._lines_lock:
            forgotten.clear()
            gc.collect()

    thread = threading.Thread(target=collect_inside, daemon=True)
    thread.start()
    thread.join(10.0)
    assert not thread.is_alive(), "the thread waits for a lock that it holds itself"
