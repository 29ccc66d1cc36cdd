# SPDX-License-Identifier: MIT
"""python-can interface ``pmsmsim``: a simulated drive on a virtual bus, in this process and without hardware.

``can.Bus(interface="pmsmsim", channel="NAME[?seed=N&nv=FILE&faults=FILE&bitrate=B]")``; see ``sim/channel.py`` for the
keys. Buses of one process with the same channel string share one line; when the last one is shut down the drives lose
their power (their non-volatile memory stays).

Time is virtual and belongs to the line: ``bus.clock``. It advances by the time frames take, by ``clock.wait``, and by
an idle ``recv``: the thread that opened the bus sees its time-outs pass at once. A reader thread of another program
(python-can's ``Notifier``) may not run away with the time while its owner thinks, so in any other thread an idle
``recv`` waits for real, at the pace of the wall clock; frames still arrive at once. A thread that works on a drive
says so with ``receive_in_this_thread``. For the same bytes in every run, receive in the thread that opened the bus.
"""

from __future__ import annotations

import errno
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import can
from can.broadcastmanager import (
    LimitedDurationCyclicSendTaskABC,
    ModifiableCyclicTaskABC,
    RestartableCyclicTaskABC,
)

from pmsmtool.bus.clock import NEVER, NS, Ticker, VirtualClock
from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_file import profile_names
from pmsmtool.sim.channel import build_line, parse_channel
from pmsmtool.sim.drive_kernel import BenchSupply, KernelCore
from pmsmtool.sim.line import EXTENDED, REMOTE, Frame, Line

POLL_NS = 10_000
"""Time an empty ``recv(0)`` takes, so that a program that polls gets on."""
TRANSMIT_QUEUE = 8
"""Frames an adapter keeps while nobody acknowledges, before sending fails."""
_PACE_SLICE_S = 0.05

_lines: dict[str, Line] = {}
# Its holder may take it again: Python may collect a forgotten bus at any instruction, and ``__del__`` shuts it down.
_lines_lock = threading.RLock()


class _Pace:
    """Maps the wall clock to the line's clock for readers that wait for real."""

    def __init__(self, line: Line, speed: float) -> None:
        self._line = line
        self._speed = speed
        self._wall = time.monotonic()
        self._virtual_ns = line.clock.now_ns

    def target_ns(self) -> int:
        """Return the instant the line may have reached by now; the lock must be held."""
        wall = time.monotonic()
        elapsed_ns = round((wall - self._wall) * self._speed * NS)
        self._wall = wall
        self._virtual_ns = max(self._line.clock.now_ns, self._virtual_ns + elapsed_ns)
        return self._virtual_ns

    def seconds_until(self, instant_ns: int) -> float:
        """Return the real time until an instant."""
        return max(0.0, (instant_ns - self._line.clock.now_ns) / NS / self._speed)


class PmsmSimBus(can.BusABC):
    """A program's connection to a simulated line.

    Parameters
    ----------
    channel : str, optional
        Channel string; default: an interior-magnet profile.
    receive_own_messages : bool
        Whether own frames come back.
    bitrate : int, optional
        Bit rate of the program's adapter. The drives follow it unless the channel string fixes theirs; when the two
        differ, nothing but error frames passes, as on a real bus.
    line : Line, optional
        A line that exists already, instead of the one the channel describes.

    Attributes
    ----------
    clock : VirtualClock
        The clock of the line.
    line : Line
        The line and its drives.
    """

    def __init__(
        self,
        channel: str | None = None,
        can_filters: can.typechecking.CanFilters | None = None,
        receive_own_messages: bool = False,
        bitrate: int | None = None,
        line: Line | None = None,
        **kwargs: Any,
    ) -> None:
        self.echo = receive_own_messages
        self._key = str(channel or "")
        self._queue: deque[can.Message] = deque()
        self._waiting = 0
        self._in_flight = 0
        self._unacknowledged = 0
        self._drivers = {threading.get_ident()}
        self._pace: _Pace | None = None
        self._supplies: dict[int, BenchSupply] = {}
        self._pulled = False
        self._recv_raises = False
        try:
            parsed = parse_channel(self._key)
            self.line = _join(self._key, lambda: build_line(parsed, bitrate=bitrate)) if line is None else line
        except ConfigError as error:
            raise can.CanInitializationError(str(error)) from error
        self.clock: VirtualClock = self.line.clock
        self.channel_info = f"pmsmsim channel {self._key or 'default'}"
        self._speed = parsed.speed
        self._arrived = threading.Condition(self.clock.lock)
        other_rate = None not in (bitrate, self.line.bitrate) and int(bitrate or 0) != self.line.bitrate
        self._deaf = other_rate or parsed.terminator == "missing"
        self._open = True
        with self.clock.held:
            self.line.attach(self)
        super().__init__(channel=self._key, can_filters=can_filters)

    def read_supply(self, node_id: int) -> tuple[float, float]:
        """Return voltage (V) and current (A) of the bench supply that feeds one drive, as its display shows them."""
        with self.clock.held:
            node = next(node for node in self.line.nodes if node.node_id == node_id)
            if node_id not in self._supplies:
                assert isinstance(node.core, KernelCore)
                self._supplies[node_id] = BenchSupply(node.core, seed=node.identity[-1])
            return self._supplies[node_id].read()

    # ---- sending -------------------------------------------------------------------------------

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame; returns when it has left, in virtual time.

        Raises can.CanOperationError: the bus is shut down, the adapter was pulled (fault injection), or nobody
        acknowledges.
        """
        self._check_usable()
        if msg.is_fd or msg.is_error_frame:
            raise can.CanOperationError("the simulated bus carries classic data and remote frames only")
        flags = (EXTENDED if msg.is_extended_id else 0) | (REMOTE if msg.is_remote_frame else 0)
        frame = Frame(msg.arbitration_id, b"" if flags & REMOTE else bytes(msg.data), flags, msg.dlc)
        clock = self.clock
        with clock.held:
            if self._unacknowledged >= TRANSMIT_QUEUE:
                if not self.line.is_acknowledged(self):
                    raise can.CanOperationError("transmit queue full: no node acknowledges", errno.ENOBUFS)
                self._unacknowledged = 0
            self._in_flight += 1
            self.line.queue(self, frame)
            if not clock.running_actions:
                while self._in_flight:
                    clock.step(NEVER)
            if self._waiting:
                self._arrived.notify_all()

    def transmitted(self, acknowledged: bool) -> None:
        """One of our frames has left (called by the line)."""
        self._in_flight -= 1
        self._unacknowledged = 0 if acknowledged else self._unacknowledged + 1

    def _check_usable(self) -> None:
        if not self._open:
            raise can.CanOperationError("the bus is shut down")
        if self._pulled:
            raise can.CanOperationError("the adapter is gone", errno.ENODEV)

    # ---- receiving -----------------------------------------------------------------------------

    def hear(self, frame: Frame, own: bool) -> None:
        """Take a frame of the line (called by the line)."""
        if self._pulled:
            return
        can_id, data, flags, dlc = frame
        self._queue.append(
            can.Message(
                self.clock.now_ns / NS,
                can_id,
                bool(flags & EXTENDED),
                bool(flags & REMOTE),
                self._deaf,
                self._key,
                dlc if flags & REMOTE else len(data),
                bytearray(data),
                is_rx=not own,
            )
        )
        if self._waiting:
            self._arrived.notify_all()

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame, or None when ``timeout`` seconds have passed on the bus clock."""
        return self._recv_internal(timeout)[0]

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        paced = self._speed is not None or threading.get_ident() not in self._drivers
        clock = self.clock
        deadline = NEVER if timeout is None else clock.now_ns + max(POLL_NS, round(timeout * NS))
        queue = self._queue
        while True:
            message = self._next_message()
            if message is not None:
                return message, True
            if paced:
                if not self._wait_paced(deadline):
                    return None, True
                continue
            with clock.held:
                if queue:
                    continue
                if clock.now_ns >= deadline:
                    return None, True
                if deadline == NEVER and clock.next_ns() == NEVER:
                    self._wait_for_traffic(_PACE_SLICE_S)
                else:
                    clock.step(deadline)

    def _next_message(self) -> can.Message | None:
        queue = self._queue
        while queue:
            message = queue.popleft()
            if self._filters is None or self._matches_filters(message):
                return message
        if not self._open:
            raise can.CanOperationError("the bus is shut down")
        if self._recv_raises:
            raise can.CanOperationError("the adapter is gone", errno.ENODEV)
        return None

    def _wait_for_traffic(self, seconds: float) -> None:
        self._waiting += 1
        try:
            self._arrived.wait(seconds)
        finally:
            self._waiting -= 1

    def _wait_paced(self, deadline: int) -> bool:
        """Wait for real until something happens; returns False when the deadline has passed."""
        line, clock = self.line, self.clock
        with clock.held:
            if self._pace is None:
                self._pace = _Pace(line, self._speed or 1.0)
            target = max(self._pace.target_ns(), clock.next_ns() if line.busy else 0)
            while clock.now_ns < min(target, deadline) and not self._queue:
                clock.step(min(target, deadline))
            if self._queue:
                return True
            if clock.now_ns >= deadline:
                return False
            seconds = self._pace.seconds_until(min(deadline, clock.next_ns()))
            self._wait_for_traffic(min(seconds, _PACE_SLICE_S))
        return True

    def receive_in_this_thread(self) -> None:
        """Let time-outs of the calling thread, too, pass at once (one that works on a drive, not a mere reader)."""
        self._drivers.add(threading.get_ident())

    # ---- the rest of python-can's interface ----------------------------------------------------

    def _send_periodic_internal(
        self,
        msgs: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None = None,
        autostart: bool = True,
        modifier_callback: Callable[[can.Message], None] | None = None,
    ) -> _PeriodicTask:
        task = _PeriodicTask(self, msgs, period, duration, modifier_callback)
        if autostart:
            task.start()
        return task

    def pull(self, recv_raises: bool) -> None:
        """Pull the adapter (fault injection): sending raises, nothing is received any more."""
        self._pulled = True
        self._recv_raises = recv_raises
        self._queue.clear()

    def flush_tx_buffer(self) -> None:
        """Nothing waits: frames leave before ``send`` returns."""

    def shutdown(self) -> None:
        """Leave the line; with its last program the drives lose their power."""
        super().shutdown()
        if self._open:
            self._open = False
            with self.clock.held:
                self._arrived.notify_all()
            _leave(self._key, self)

    @staticmethod
    def _detect_available_configs() -> list[can.typechecking.AutoDetectedConfig]:
        return [{"interface": "pmsmsim", "channel": name} for name in profile_names()]


class _PeriodicTask(ModifiableCyclicTaskABC, LimitedDurationCyclicSendTaskABC, RestartableCyclicTaskABC):
    """python-can's cyclic sending, on the clock of the line."""

    def __init__(
        self,
        bus: PmsmSimBus,
        messages: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None,
        modifier: Callable[[can.Message], None] | None,
    ) -> None:
        super().__init__(messages, period, duration)
        self._bus = bus
        self._modifier = modifier
        self._ticker: Ticker | None = None
        self._number = 0
        self._left: int | None = None

    def start(self) -> None:
        """Send the first message now, the others one period apart."""
        self.stop()
        self._left = None if self.duration is None else max(1, round(self.duration / self.period))
        self._tick()
        if self._left is None or self._left > 0:
            self._ticker = self._bus.clock.every(self.period, self._tick)

    def _tick(self) -> None:
        message = self.messages[self._number % len(self.messages)]
        self._number += 1
        if self._modifier is not None:
            self._modifier(message)
        self._bus.send(message)
        if self._left is not None:
            self._left -= 1
            if self._left <= 0:
                self.stop()

    def stop(self) -> None:
        """End sending."""
        if self._ticker is not None:
            self._ticker.stop()
            self._ticker = None


def _join(key: str, build: Callable[[], Line]) -> Line:
    with _lines_lock:
        line = _lines.get(key)
        if line is None:
            line = _lines[key] = build()
        return line


def _leave(key: str, bus: PmsmSimBus) -> None:
    # Never both locks at once: a thread that holds the clock may collect a forgotten bus and come here.
    with bus.line.clock.held:
        bus.line.detach(bus)
    with _lines_lock:
        if not bus.line.endpoints and _lines.get(key) is bus.line:
            del _lines[key]
