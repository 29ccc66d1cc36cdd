# SPDX-License-Identifier: MIT
"""One clock per bus: real on real buses, virtual on the simulated one.

Whoever waits or measures a time-out on a bus reads the clock that the bus owns, ``clock_of(bus)``, and never the
computer's. On a real bus that is :class:`WallClock`. On the simulated bus it is a :class:`VirtualClock`: a second
passes when somebody waits for one, and at once; periodic jobs (a heartbeat) are due at exact virtual instants.
"""

from __future__ import annotations

import heapq
import importlib
import signal
import threading
import time
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Protocol

NS = 1_000_000_000
"""Nanoseconds per second."""
NEVER = 1 << 62
"""An instant that does not come (ns)."""

_JOINT_STEP_NS = 10_000_000
# Several runners advance together in steps of this size, so that none is far ahead when another stops early.

_MAIN_THREAD = threading.main_thread().ident
_SIGINT = int(signal.SIGINT)
_signal: Any = importlib.import_module("_signal")
# The module behind ``signal``: its enum conversions would cost a third of the time of a frame.
_set_handler: Any = _signal.signal
_handler: Any = _signal.getsignal
_pop, _push = heapq.heappop, heapq.heappush
_thread = threading.get_ident


class Ticker(Protocol):
    """A periodic job that can be ended."""

    def stop(self) -> None:
        """End the job; it does not run again after this returns."""


class Clock(Protocol):
    """Time as a bus knows it."""

    def now(self) -> float:
        """Return the time (s) since an arbitrary instant."""

    def wait(self, seconds: float) -> None:
        """Let ``seconds`` pass."""

    def every(self, period_s: float, action: Callable[[], None]) -> Ticker:
        """Run ``action`` once per period until stopped, also while the caller is busy or waits."""


class _Thread:
    """Ticker of the wall clock: a daemon thread of its own, so that a busy main thread does not stop it."""

    def __init__(self, period_s: float, action: Callable[[], None]) -> None:
        self._period_s = period_s
        self._action = action
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pmsmtool ticker", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        due = time.monotonic() + self._period_s
        while not self._end.wait(max(0.0, due - time.monotonic())):
            self._action()
            due = max(due + self._period_s, time.monotonic())

    def stop(self) -> None:
        self._end.set()
        if threading.current_thread() is not self._thread:
            self._thread.join()


class WallClock:
    """The computer's monotonic clock."""

    def now(self) -> float:
        """Return the monotonic time (s)."""
        return time.monotonic()

    def wait(self, seconds: float) -> None:
        """Sleep."""
        time.sleep(max(0.0, seconds))

    def every(self, period_s: float, action: Callable[[], None]) -> Ticker:
        """Run ``action`` periodically in a thread of its own."""
        return _Thread(period_s, action)


class Timer:
    """One planned action of a virtual clock."""

    __slots__ = ("action",)

    def __init__(self, action: Callable[[], None]) -> None:
        self.action: Callable[[], None] | None = action

    def cancel(self) -> None:
        """Take the action back; harmless when it has run."""
        self.action = None


class _Interrupts:
    """The main thread's Ctrl-C: how many virtual clocks it holds, and the signal that waits until it holds none."""

    __slots__ = ("depth", "pending", "previous", "replaced")

    def __init__(self) -> None:
        self.depth = self.pending = 0
        self.previous: Any = None
        self.replaced = False

    def remember(self, number: int, frame: FrameType | None) -> None:
        self.pending = number


_interrupts = _Interrupts()


class PutOff:
    """A handler of SIGINT that waits itself until no virtual clock is held: none need be set for every frame.

    Two system calls per frame were a tenth of a read.
    """

    def __init__(self, handler: Callable[[int, FrameType | None], object]) -> None:
        self._handler = handler

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Take the signal."""
        if _interrupts.depth:
            _interrupts.pending = number
        else:
            self._handler(number, frame)


class _Held:
    """Context of a virtual clock: its lock, and Ctrl-C put off until the simulated world is consistent again.

    A Ctrl-C meant for the tool must not stop the drive in the middle of a frame: a real drive would not notice it.
    Other signals that end a program are put off, too, where their handlers ask the one of SIGINT (``cli.main``).
    """

    __slots__ = ("_lock",)

    def __init__(self, lock: threading.RLock) -> None:
        self._lock = lock

    def __enter__(self) -> None:
        if _thread() == _MAIN_THREAD:
            if _interrupts.depth == 0 and type(_handler(_SIGINT)) is not PutOff:
                # First the handler, then the lock: an interrupt in between leaves neither behind.
                _interrupts.previous, _interrupts.replaced = _set_handler(_SIGINT, _interrupts.remember), True
            _interrupts.depth += 1
        self._lock.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._lock.release()
        if _thread() == _MAIN_THREAD:
            _interrupts.depth -= 1
            if _interrupts.depth == 0:
                if _interrupts.replaced:
                    previous, _interrupts.replaced = _interrupts.previous, False
                    _set_handler(_SIGINT, _signal.SIG_DFL if previous is None else previous)
                if _interrupts.pending:
                    number, _interrupts.pending = _interrupts.pending, 0
                    _signal.raise_signal(number)


class _VirtualTicker:
    def __init__(self, clock: VirtualClock, period_ns: int, action: Callable[[], None]) -> None:
        self._clock = clock
        self._period_ns = period_ns
        self._action = action
        self._due = clock.now_ns + period_ns
        self._timer = clock.at(self._due, self._tick)

    def _tick(self) -> None:
        self._due += self._period_ns
        self._timer = self._clock.at(self._due, self._tick)
        self._action()

    def stop(self) -> None:
        with self._clock.held:
            self._timer.cancel()


class VirtualClock:
    """Time that passes only when somebody waits for it; integer nanoseconds, so it is exact and repeatable.

    Attributes
    ----------
    now_ns : int
        The present instant (ns).
    held : context manager
        The lock of everything that lives on this clock.
    runners : list of callables
        Continuous processes. Each is called with the instant (ns) the clock is about to move to and returns the
        instant it wants to stop at, at most that one.
    running_actions : bool
        True while planned actions run: then nobody may wait.
    """

    def __init__(self) -> None:
        self.now_ns = 0
        self.lock = threading.RLock()
        self.held = _Held(self.lock)
        self.runners: list[Callable[[int], int]] = []
        self.running_actions = False
        self._plan: list[tuple[int, int, Timer]] = []
        self._count = 0

    def now(self) -> float:
        """Return the virtual time (s)."""
        return self.now_ns / NS

    def at(self, instant_ns: int, action: Callable[[], None]) -> Timer:
        """Plan an action; actions of one instant run in the order they were planned."""
        timer = Timer(action)
        self._count += 1
        _push(self._plan, (instant_ns, self._count, timer))
        return timer

    def after(self, seconds: float, action: Callable[[], None]) -> Timer:
        """Plan an action ``seconds`` from now."""
        return self.at(self.now_ns + round(seconds * NS), action)

    def every(self, period_s: float, action: Callable[[], None]) -> Ticker:
        """Run ``action`` at every multiple of the period from now, in whichever thread lets the time pass."""
        with self.held:
            return _VirtualTicker(self, max(1, round(period_s * NS)), action)

    def next_ns(self) -> int:
        """Return the instant of the next planned action, ``NEVER`` when there is none."""
        plan = self._plan
        while plan and plan[0][2].action is None:
            _pop(plan)
        return plan[0][0] if plan else NEVER

    def step(self, limit_ns: int) -> None:
        """Move to the next planned instant, at most to the limit, and run what is due; the lock must be held."""
        if self.running_actions:
            raise RuntimeError("an action of the clock cannot wait for the clock")
        # Once per frame: comparisons instead of min and max, which would cost a fifth of the step.
        instant = self.next_ns()
        if instant > limit_ns:
            instant = limit_ns
        if instant > self.now_ns:
            runners = self.runners
            if len(runners) > 1:
                instant = min(instant, self.now_ns + _JOINT_STEP_NS)
            for run in runners:
                reached = run(instant)
                if reached < instant:
                    instant = reached
            if instant > self.now_ns:
                self.now_ns = instant
        plan = self._plan
        self.running_actions = True
        try:
            while plan and plan[0][0] <= self.now_ns:
                timer = _pop(plan)[2]
                action = timer.action
                if action is not None:
                    timer.action = None
                    action()
        finally:
            self.running_actions = False

    def run_until(self, instant_ns: int) -> None:
        """Let time pass until an instant; other threads get their turn at every planned action."""
        while True:
            with self.held:
                if self.now_ns >= instant_ns:
                    return
                self.step(instant_ns)

    def wait(self, seconds: float) -> None:
        """Let ``seconds`` pass, at once."""
        self.run_until(self.now_ns + round(max(0.0, seconds) * NS))


_WALL = WallClock()


def clock_of(bus: object) -> Clock:
    """Return the clock a bus owns, the wall clock for a bus without one."""
    clock: Clock = getattr(bus, "clock", _WALL)
    return clock


class Schedule:
    """Plans actions that run only while this schedule is open."""

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock
        self._open = True

    @property
    def now_ns(self) -> int:
        """The present instant (ns)."""
        return self._clock.now_ns

    def at(self, instant_ns: int, action: Callable[[], None]) -> Timer:
        """Plan an action at an instant (ns)."""

        def run() -> None:
            if self._open:
                action()

        return self._clock.at(instant_ns, run)

    def after(self, seconds: float, action: Callable[[], None]) -> Timer:
        """Plan an action ``seconds`` from now."""
        return self.at(self._clock.now_ns + round(seconds * NS), action)

    def close(self) -> None:
        """Forget all that was planned."""
        self._open = False
