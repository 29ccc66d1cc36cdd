# SPDX-License-Identifier: MIT
"""The two clocks behind one interface; the virtual one is exact, repeatable and unimpressed by Ctrl-C."""

from __future__ import annotations

import signal
import threading
import time
from typing import Any

import pytest

from pmsmtool.bus.clock import NEVER, NS, PutOff, VirtualClock, WallClock, clock_of
from pmsmtool.cli.main import _interrupt as end_by_system

pytestmark = pytest.mark.wall_clock


def test_virtual_time_passes_only_by_waiting_and_costs_none() -> None:
    clock = VirtualClock()
    started = time.monotonic()
    time.sleep(0.01)
    assert clock.now() == 0.0
    clock.wait(3600.0)
    assert clock.now() == 3600.0
    clock.wait(-1.0)
    assert clock.now() == 3600.0
    assert time.monotonic() - started < 1.0


def test_actions_run_at_their_instant_in_the_order_they_were_planned() -> None:
    clock = VirtualClock()
    seen: list[tuple[str, int]] = []
    clock.at(200, lambda: seen.append(("b", clock.now_ns)))
    clock.at(100, lambda: seen.append(("a", clock.now_ns)))
    clock.at(200, lambda: seen.append(("c", clock.now_ns)))
    cancelled = clock.at(150, lambda: seen.append(("never", clock.now_ns)))
    cancelled.cancel()

    def plan_another() -> None:
        clock.at(100, lambda: seen.append(("a2", clock.now_ns)))

    clock.at(100, plan_another)
    assert clock.next_ns() == 100
    clock.run_until(1000)
    assert seen == [("a", 100), ("a2", 100), ("b", 200), ("c", 200)]
    assert clock.now_ns == 1000
    assert clock.next_ns() == NEVER


def test_tickers_are_due_at_exact_multiples() -> None:
    clock = VirtualClock()
    stamps: list[int] = []
    ticker = clock.every(0.1, lambda: stamps.append(clock.now_ns))
    clock.wait(0.35)
    ticker.stop()
    clock.wait(1.0)
    assert stamps == [NS // 10, 2 * NS // 10, 3 * NS // 10]


def test_runners_are_asked_for_every_move_and_may_stop_it_early() -> None:
    clock = VirtualClock()
    asked: list[int] = []

    def run(instant_ns: int) -> int:
        asked.append(instant_ns)
        return 40 if clock.now_ns < 40 < instant_ns else instant_ns

    clock.runners.append(run)
    clock.at(70, lambda: None)
    clock.run_until(100)
    assert asked == [70, 70, 100]


def test_an_action_cannot_wait_for_the_clock() -> None:
    clock = VirtualClock()
    clock.at(10, lambda: clock.wait(1.0))
    with pytest.raises(RuntimeError, match="cannot wait"):
        clock.wait(1.0)


@pytest.mark.parametrize("handler", [signal.default_int_handler, PutOff(signal.default_int_handler)])
def test_ctrl_c_is_put_off_until_the_action_is_complete(handler: Any) -> None:
    clock = VirtualClock()
    steps: list[str] = []

    def action() -> None:
        steps.append("begun")
        signal.raise_signal(signal.SIGINT)
        steps.append("complete")

    clock.at(10, action)
    clock.at(20, lambda: steps.append("later"))
    previous = signal.signal(signal.SIGINT, handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            clock.wait(1.0)
        assert steps == ["begun", "complete"]
        assert signal.getsignal(signal.SIGINT) is handler
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, previous)
    clock.wait(1.0)
    assert steps == ["begun", "complete", "later"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("keyboard", [signal.default_int_handler, signal.SIG_IGN, PutOff(signal.default_int_handler)])
def test_the_program_is_ended_by_the_system_after_the_action(number: signal.Signals, keyboard: Any) -> None:
    """A simulated node that was left in the middle of a frame hung the tool; SIGINT is ignored in background jobs."""
    clock = VirtualClock()
    steps: list[str] = []

    def action() -> None:
        signal.raise_signal(number)
        steps.append("complete")

    previous = {number: signal.signal(number, end_by_system), signal.SIGINT: signal.signal(signal.SIGINT, keyboard)}
    try:
        clock.at(10, action)
        with pytest.raises(KeyboardInterrupt):
            clock.wait(1.0)
        assert steps == ["complete"]
        assert signal.getsignal(signal.SIGINT) == keyboard
    finally:
        for which, handler in previous.items():
            signal.signal(which, handler)


def test_a_handler_of_the_program_gets_the_ctrl_c_that_was_put_off() -> None:
    clock = VirtualClock()
    received: list[int] = []
    previous = signal.signal(signal.SIGINT, lambda number, frame: received.append(clock.now_ns))
    try:
        clock.at(10, lambda: signal.raise_signal(signal.SIGINT))
        clock.wait(1e-6)
    finally:
        signal.signal(signal.SIGINT, previous)
    assert received == [10]


def test_the_lock_is_free_again_after_any_ctrl_c() -> None:
    """Interrupts at random instants of waiting: another thread can always go on afterwards."""
    clock = VirtualClock()
    clock.every(1e-6, lambda: None)
    interrupted = 0
    for _ in range(30):
        timer = threading.Timer(0.005, lambda: signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT))
        try:
            timer.start()
            clock.wait(3600.0)
        except KeyboardInterrupt:
            interrupted += 1
        timer.join()
    assert interrupted == 30
    other = threading.Thread(target=clock.wait, args=(1e-5,))
    other.start()
    other.join(5.0)
    assert not other.is_alive()


def test_threads_share_the_time() -> None:
    clock = VirtualClock()
    clock.every(1e-3, lambda: None)
    threads = [threading.Thread(target=clock.wait, args=(1.0,)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10.0)
    assert 1.0 <= clock.now() < 4.1


def test_the_wall_clock_ticks_while_the_main_thread_is_busy() -> None:
    clock = WallClock()
    stamps: list[float] = []
    ticker = clock.every(0.02, lambda: stamps.append(clock.now()))
    end = time.monotonic() + 0.3
    while time.monotonic() < end:
        sum(range(1000))
    ticker.stop()
    count = len(stamps)
    assert count >= 5
    clock.wait(0.05)
    assert len(stamps) == count


def test_a_bus_without_a_clock_has_the_wall_clock() -> None:
    assert isinstance(clock_of(object()), WallClock)
