# SPDX-License-Identifier: MIT
"""Connection to a CAN bus: one clock, one place where frames arrive, one where they are sent.

On the simulated bus time is virtual and whoever waits for a frame takes it from the bus himself
("pumped"): no thread, so runs repeat exactly. On a real bus a reader thread of our own receives.
Either way every subscriber is called in order of arrival, and a callback may only take notes.
"""

from __future__ import annotations

import contextlib
import errno
import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from types import TracebackType
from typing import Any

import can

from pmsmtool.bus.clock import Clock, clock_of
from pmsmtool.errors import BusError, ConfigError, PmsmtoolError
from pmsmtool.plain_text import reason

TRACE_HINT = "name a file in a folder that can be written and has room"
"""What to do when a bus trace cannot be written."""

SEND_PATIENCE_S = 0.5
"""A full transmit queue is waited for this long; a bus where nobody acknowledges stays full."""

_POLL_S = 0.05
"""The reader thread looks this often whether it shall end: half of it is what closing a bus waits."""
_SEND_PAUSE_S = 0.001
RESOLUTION_S = 1e-9
"""Of the virtual clock: less than that never passes."""
_SPIN_LIMIT = 200
_SPIN_S = 0.001
_FULL_ERRNO = (errno.ENOBUFS, errno.EAGAIN)

Callback = Callable[[int, bytes, float], None]
"""Called with COB-ID, data and time stamp, as canopen does."""


class Mailbox:
    """Frames of one COB-ID, in order of arrival, for one reader."""

    def __init__(self, connection: Connection, cob_id: int) -> None:
        self._connection = connection
        self._cob_id = cob_id
        self._frames: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        connection.subscribe(cob_id, self._put)

    def _put(self, cob_id: int, data: bytes, timestamp: float) -> None:
        self._frames.put(data)

    def get(self, timeout_s: float) -> bytes | None:
        """Return the next frame's data, or None after ``timeout_s`` on the bus clock."""
        return self._connection.wait_for(self._frames, timeout_s)

    def clear(self) -> list[bytes]:
        """Take out all that arrived, and return it."""
        self._connection.collect()
        taken = []
        while not self._frames.empty():
            taken.append(self._frames.get_nowait())
        return taken

    def close(self) -> None:
        """Stop listening."""
        self._connection.unsubscribe(self._cob_id, self._put)


class Connection:
    """An open bus.

    Parameters
    ----------
    bus : can.BusABC
        Any python-can bus. One that owns a clock (``bus.clock``) is pumped, others get a reader thread.
    writer : python-can listener, optional
        Receives every frame, sent ones included (``--trace-can``).

    Attributes
    ----------
    clock : Clock
        The clock of this bus.
    frames_received, error_frames : int
        Counts since the connection was opened.
    heard : set of int
        COB-IDs seen.
    sent : dict of int to deque
        The last requests sent per watched COB-ID, to tell our own echo from a second master.
    echo : tuple or None
        The frame (COB-ID, data, time) that was last told for one.
    sends : Counter of int
        How many frames were sent per COB-ID.
    deaf_s : float
        How long the reader thread did not listen because the computer did not run it (s).
    listeners : list of callable
        Given every message received, error frames too.
    at_close : list of callable
        Called, the last first, before the bus is shut down.
    """

    def __init__(self, bus: can.BusABC, *, writer: Any = None) -> None:
        self.bus = bus
        self.clock: Clock = clock_of(bus)
        self.frames_received = 0
        self.error_frames = 0
        self.deaf_s = 0.0
        self.heard: set[int] = set()
        self.sent: dict[int, deque[bytes]] = {}
        self.echo: tuple[int, bytes, float] | None = None
        self.sends: Counter[int] = Counter()
        self.listeners: list[Callable[[can.Message], None]] = []
        self.at_close: list[Callable[[], None]] = []
        self._writer = writer
        self._subscribers: dict[int, tuple[Callback, ...]] = {}
        self._failure: PmsmtoolError | None = None
        # Reentrant: on the simulated bus a heartbeat falls due while a frame is on the wire, in the same thread.
        self._send_lock = threading.RLock()
        self._pump_lock = threading.Lock()
        self._trace_lock = threading.RLock()  # one thread sends frames, another receives them
        self._dispatching: int | None = None
        self._closing = False
        self._reader: threading.Thread | None = None
        if not hasattr(bus, "clock"):
            _watch_for_spin(bus)
            self._reader = threading.Thread(target=self._read, name="pmsmtool bus reader", daemon=True)
            self._reader.start()

    def __enter__(self) -> Connection:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End what is still open on the bus, shut it and the trace down; harmless when it has failed already."""
        with contextlib.ExitStack() as last:
            last.callback(self._shut)
            for close in self.at_close:
                last.callback(close)

    def _shut(self) -> None:
        self._closing = True
        if self._reader is not None and self._reader is not threading.current_thread():
            self._reader.join(2 * _POLL_S)
        with contextlib.suppress(can.CanError, OSError):
            self.bus.shutdown()
        with self._trace_lock:
            if self._writer is not None:
                self._writer.stop()
                self._writer = None

    # ---- sending --------------------------------------------------------------------------------

    def send(self, cob_id: int, data: bytes, *, patience_s: float = SEND_PATIENCE_S) -> None:
        """Send one frame. Raises BusError: the adapter is gone, or nobody on the bus acknowledges.

        Parameters
        ----------
        patience_s : float
            How long a full transmit queue is waited for; 0 inside an action of the clock.
        """
        # A fresh message each time: some adapters pad its data in place.
        message = can.Message(arbitration_id=cob_id, data=data, is_extended_id=False)
        self.sends[cob_id] += 1
        if cob_id in self.sent:
            self.sent[cob_id].append(data)
        while True:
            try:
                with self._send_lock:
                    self.bus.send(message)
                break
            except (can.CanError, OSError, ValueError) as error:
                if patience_s <= 0.0 or not _is_full(error):
                    raise self._send_failure(error) from error
            self.clock.wait(_SEND_PAUSE_S)
            patience_s -= _SEND_PAUSE_S
        if self._writer is not None:
            message.is_rx = False
            message.timestamp = self._stamp()
            self._write(message)

    def request(self, cob_id: int, length: int) -> None:
        """Send a remote frame, once: it is asked again soon.

        Raises BusError: the adapter is gone, nobody acknowledges, or it sends no remote frames.
        """
        message = can.Message(arbitration_id=cob_id, is_remote_frame=True, dlc=length, is_extended_id=False)
        try:
            with self._send_lock:
                self.bus.send(message)
        except (can.CanError, OSError, ValueError, NotImplementedError) as error:
            raise self._send_failure(error) from error
        if self._writer is not None:
            message.is_rx = False
            message.timestamp = self._stamp()
            self._write(message)

    # ---- receiving ------------------------------------------------------------------------------

    def subscribe(self, cob_id: int, callback: Callback) -> None:
        """Call ``callback`` with every data frame of a COB-ID."""
        self._subscribers[cob_id] = (*self._subscribers.get(cob_id, ()), callback)

    def unsubscribe(self, cob_id: int, callback: Callback | None = None) -> None:
        """Take one callback back, or all of a COB-ID; harmless when there is none."""
        left = () if callback is None else tuple(c for c in self._subscribers.get(cob_id, ()) if c != callback)
        self._subscribers[cob_id] = left

    @property
    def shared(self) -> bool:
        """Whether other programs may be on the bus, too: not on the simulated one in this process."""
        return self._reader is not None

    def mailbox(self, cob_id: int) -> Mailbox:
        """Return a queue of the frames of one COB-ID."""
        return Mailbox(self, cob_id)

    def in_callback(self) -> bool:
        """Whether the caller runs inside a subscriber's callback, where waiting would never end."""
        return self._dispatching == threading.get_ident() or self._reader is threading.current_thread()

    def wait_for(self, frames: queue.SimpleQueue[bytes], timeout_s: float) -> bytes | None:
        """Return the next entry of a mailbox's queue, or None after ``timeout_s`` on the bus clock."""
        if self._reader is not None:
            try:
                return frames.get(timeout=max(timeout_s, 0.0))
            except queue.Empty:
                self.raise_if_failed()
                return None
        if not frames.empty():
            return frames.get_nowait()
        deadline = self.clock.now() + timeout_s
        while True:
            if self.pump(max(timeout_s, 0.0)) and not frames.empty():
                return frames.get_nowait()
            timeout_s = deadline - self.clock.now()
            if timeout_s < RESOLUTION_S:
                return None

    def pump(self, timeout_s: float) -> bool:
        """Take one frame from a pumped bus and hand it on; return whether there was one."""
        with self._pump_lock:
            try:
                message = self.bus.recv(timeout_s)
            except (can.CanError, OSError) as error:
                self._failure = gone(error)
                raise self._failure from error
            if message is None:
                return False
            self._dispatching = threading.get_ident()
            try:
                self._dispatch(message)
            finally:
                self._dispatching = None
            return True

    def collect(self) -> None:
        """Hand on what a pumped bus has received by now."""
        if self._reader is None:
            while self.pump(0.0):
                pass

    def wait(self, seconds: float) -> None:
        """Let time pass on the bus clock; what arrives meanwhile reaches its subscribers."""
        self.clock.wait(seconds)
        self.collect()
        self.raise_if_failed()

    def wait_until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until subscribers made ``condition`` true; return whether they did in time."""
        deadline = self.clock.now() + timeout_s
        while not condition():
            left = deadline - self.clock.now()
            if left < RESOLUTION_S:
                return False
            if self._reader is None:
                self.pump(left)
            else:
                self.wait(min(left, 0.005))
        return True

    def raise_if_failed(self) -> None:
        """Raise the error that ended reception, if one did."""
        if self._failure is not None:
            raise self._failure

    def explain_silence(self, node: int) -> tuple[str, str]:
        """Say why a node may not answer and what to do, from what was heard on the bus."""
        services = (0x080, 0x180, 0x280, 0x380, 0x480, 0x580, 0x700)
        others = sorted({c & 0x7F for c in self.heard if c & 0x7F and c & 0x780 in services} - {node})
        if any(base + node in self.heard for base in services):
            return (
                f"node {node} is on the bus, but its SDO server does not answer",
                f"`pmsmtool info -n {node}`, or reset the node",
            )
        if others:
            heard = ", ".join(map(str, others))
            return f"only others were heard, node {heard}: wrong node id?", "`pmsmtool scan` without -n"
        if self.error_frames:
            return "only error frames were heard: wrong bit rate, or a bus without termination", "`pmsmtool doctor`"
        return (
            "nothing was heard: no power, wrong bit rate, missing termination, or another channel",
            "`pmsmtool doctor`",
        )

    # ---- inside ---------------------------------------------------------------------------------

    def _read(self) -> None:
        before = self.clock.now()
        while not self._closing:
            try:
                message = self.bus.recv(_POLL_S)
                now = self.clock.now()
                self.deaf_s += max(0.0, now - before - _POLL_S)
                before = now
                if message is not None:
                    self._dispatch(message)
            except PmsmtoolError as error:
                self._failure = error
                return
            except Exception as error:  # whatever a back end raises ends reception, and is told to whoever waits
                if not self._closing:
                    self._failure = gone(error)
                return

    def _dispatch(self, message: can.Message) -> None:
        if self._writer is not None:
            self._write(message)
        for listener in self.listeners:
            listener(message)
        if message.is_error_frame:
            self.error_frames += 1
            return
        self.frames_received += 1
        cob_id = message.arbitration_id
        odd = message.is_extended_id or message.is_remote_frame or message.is_fd or len(message.data) > 8
        if odd or not message.is_rx:  # CANopen has classic data frames with 11-bit identifiers alone
            return
        self.heard.add(cob_id)
        callbacks = self._subscribers.get(cob_id)
        if callbacks:
            data, timestamp = bytes(message.data), message.timestamp
            for callback in callbacks:
                callback(cob_id, data, timestamp)

    def _write(self, message: can.Message) -> None:
        try:
            with self._trace_lock:
                if self._writer is not None:
                    self._writer(message)
        except (OSError, ValueError) as error:
            self._writer = None
            raise ConfigError(
                f"the bus trace cannot be written: {error}", where="--trace-can", hint=TRACE_HINT
            ) from error

    def _stamp(self) -> float:
        return time.time() if self._reader is not None else self.clock.now()

    def _send_failure(self, error: Exception) -> BusError:
        if _is_full(error):
            return BusError(
                f"no frame can be sent: {reason(error)}",
                where=str(self.bus.channel_info),
                likely="no other node acknowledges: wrong bit rate, no power, no termination, or bus off",
                hint="`pmsmtool doctor`",
            )
        return gone(error)


def _is_full(error: Exception) -> bool:
    code = getattr(error, "error_code", None) or getattr(error, "errno", None)
    return code in _FULL_ERRNO or isinstance(error, can.CanTimeoutError)


def gone(error: Exception) -> BusError:
    """Return the error that says the adapter is gone."""
    return BusError(
        f"the adapter is gone: {reason(error)}",
        likely="unplugged, its server ended, or bus off",
        hint="check cable and adapter; the drive stops by itself when its heartbeat supervision is set",
    )


def _watch_for_spin(bus: can.BusABC) -> None:
    """Make a backend that returns nothing without waiting raise: its other end is gone (socketcand does that)."""
    inner = bus._recv_internal
    empty = 0

    def watched(timeout: float | None) -> tuple[can.Message | None, bool]:
        nonlocal empty
        started = time.monotonic()
        found = inner(timeout)
        quick = found[0] is None and (timeout or 0.0) > 10 * _SPIN_S and time.monotonic() - started < _SPIN_S
        empty = empty + 1 if quick else 0
        if empty > _SPIN_LIMIT:
            raise can.CanOperationError("the adapter returns nothing without waiting")
        return found

    bus._recv_internal = watched  # type: ignore[method-assign]
