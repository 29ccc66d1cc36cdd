# SPDX-License-Identifier: MIT
"""Offers simulated drives to other processes: a socketcand server in raw mode, on the wall clock.

Every client hears the drives and the other clients, as programs on one bus do. python-can's stock ``socketcand``
backend connects with ``host``, ``port`` and any channel name; ``tcp_tune=True`` keeps block transfers fast.

Protocol (linux-can/socketcand, ``doc/protocol.md``): ``< hi >``, ``< open NAME >`` and ``< rawmode >`` answered by
``< ok >``; then ``< send ID LEN B B ... >`` and ``< frame ID SECONDS DATA >``. That backend reads each answer with one
``recv``, so the first frames are held for ``HOLD_S`` behind the last ``< ok >``.

Where the computer does not let this process run, the drives' time stands still too: making up for it in a burst would
let their supervision miss heartbeats that were sent in time.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from pmsmtool.bus.clock import NEVER, NS
from pmsmtool.errors import BusError
from pmsmtool.sim.line import EXTENDED, REMOTE, Frame, Line

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 29536
HOLD_S = 0.05
"""Frames wait this long behind the handshake; dropping them instead would lose the first answers."""
PAUSED = "the simulation stood still for"
WORTH_SAYING_S = 0.1
_SLICE_NS = 50_000_000
_BEHIND_S = 0.1
# Further behind the wall clock than this, beyond an idle time, is not made up for.
_IDLE_S = 0.1
_RECEIVE_BYTES = 8192
# Of one client in one turn, some 250 frames: whoever floods the line does not keep the others waiting.
_BACKLOG_LIMIT = 4 << 20
# Bytes that a client has not read; more, and it is dropped.
_QUEUE_LIMIT = 64
# Frames of one client that wait for the wire; before these have left, no more are taken from it.
_ACCEPTED_AT_ONCE = 64
_MOST_CLIENTS = 512
_HANDSHAKE_S = 10.0
# A client that is not in raw mode by then is dropped.
_LONGEST_COMMAND = 200
_GREETING, _OPENED, _RAW = range(3)
_DAMAGED = 0x2000_0008
# An error frame of SocketCAN: a violation of the protocol (CAN_ERR_FLAG, CAN_ERR_PROT of linux/can/error.h).


@dataclass(slots=True, eq=False)
class Client:
    """One program that has connected; an endpoint of the line once it is in raw mode."""

    server: SocketcandServer
    connection: socket.socket
    echo: bool = False
    stage: int = _GREETING
    since: float = field(default_factory=time.monotonic)
    held_until: float = 0.0
    incoming: bytes = b""
    outgoing: bytearray = field(default_factory=bytearray)
    queued: int = 0
    awaited: int = selectors.EVENT_READ
    here: bool = True

    # ---- endpoint of the line ------------------------------------------------------------------

    def hear(self, frame: Frame, own: bool) -> None:
        """Queue a frame for the program; remote frames have no place in the protocol."""
        if frame.flags & REMOTE or len(self.outgoing) > _BACKLOG_LIMIT:
            return
        if self.server.damaged:
            self.outgoing += f"< error {_DAMAGED:08X} {self.server.stamp():.6f} >".encode("ascii")
            return
        identifier = f"{frame.can_id:08X}" if frame.flags & EXTENDED else f"{frame.can_id:03X}"
        self.outgoing += f"< frame {identifier} {self.server.stamp():.6f} {frame.data.hex()} >".encode("ascii")

    def transmitted(self, acknowledged: bool) -> None:
        """Make room for the program's next frame."""
        self.queued -= 1

    def pull(self, recv_raises: bool) -> None:
        """Fault injection: the adapter is pulled, the connection ends."""
        self.server.drop(self)

    # ---- the program's commands ----------------------------------------------------------------

    def take(self, data: bytes) -> None:
        """Take bytes of the program and obey the complete commands in them, as far as its frames find room."""
        self.incoming += data
        while self.here and not self.full and (end := self.incoming.find(b">")) >= 0:
            words = self.incoming[:end].decode("ascii", "replace").strip().removeprefix("<").split()
            self.incoming = self.incoming[end + 1 :]
            self._obey(words)
        if len(self.incoming) > _LONGEST_COMMAND and not self.full:
            self.server.drop(self)

    @property
    def full(self) -> bool:
        """Whether frames of the program must leave before more are taken."""
        return self.queued >= _QUEUE_LIMIT

    def _obey(self, words: Sequence[str]) -> None:
        if words[:1] == ["send"] and self.stage == _RAW:
            self._send(words[1:])
        elif words[:1] == ["open"] and self.stage == _GREETING:
            self.stage = _OPENED
            self.outgoing += b"< ok >"
        elif words == ["rawmode"] and self.stage == _OPENED:
            self.outgoing += b"< ok >"
            self.server.flush(self)
            if not self.here:
                return  # it has vanished; attached now, it would hear every frame for ever
            self.stage = _RAW
            self.held_until = time.monotonic() + HOLD_S
            self.server.line.attach(self)
        elif words == ["echo"]:
            self.outgoing += b"< echo >"
        else:
            self.outgoing += b"< error unknown command >"

    def _send(self, words: Sequence[str]) -> None:
        try:
            can_id, length = int(words[0], 16), int(words[1], 16)
            data = bytes(int(word, 16) for word in words[2 : 2 + length])
            extended = len(words[0]) > 3
            if length > 8 or len(data) != length or not 0 <= can_id <= (0x1FFFFFFF if extended else 0x7FF):
                raise ValueError("no classic CAN frame")
        except (ValueError, IndexError):
            self.outgoing += b"< error could not parse send command >"
            return
        self.queued += 1
        self.server.line.queue(self, Frame(can_id, data, EXTENDED if extended else 0))


class SocketcandServer:
    """Serves one line. Raises BusError: the address is in use or does not exist.

    Parameters
    ----------
    line : Line
        Drives and wire; nobody else may move its clock.
    host, port
        Where to listen; port 0 chooses a free one.
    speed : float
        Virtual seconds per second of the wall clock; fewer where the computer cannot keep up.
    damaged : bool
        Whether every frame reaches the programs as an error frame: a terminating resistor is missing.
    say : callable
        Told one line when the drives' time stood still for ``WORTH_SAYING_S`` or more.
    """

    def __init__(
        self,
        line: Line,
        host: str = DEFAULT_HOST,
        port: int = DEFAULT_PORT,
        *,
        speed: float = 1.0,
        damaged: bool = False,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        self.line = line
        self.damaged = damaged
        self._say = say
        self._speed = speed
        self._selector = selectors.DefaultSelector()
        self._clients: dict[Client, None] = {}
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            if hasattr(socket, "SO_EXCLUSIVEADDRUSE"):  # Windows: SO_REUSEADDR would let two servers share a port
                self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
            else:
                self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.bind((host, port))
            self._listener.listen(_ACCEPTED_AT_ONCE)
        except OSError as error:
            self._listener.close()
            raise BusError(
                f"cannot listen: {error.strerror or error}",
                where=f"{host}:{port}",
                likely="another simulated drive is being served there",
                hint="choose another --port; 0 takes a free one",
            ) from error
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._epoch = time.time()
        self._started = time.monotonic()

    @property
    def port(self) -> int:
        """Port the server listens on."""
        return int(self._listener.getsockname()[1])

    def stamp(self) -> float:
        """Return the time stamp of a frame that arrives now (s, Unix time at speed 1)."""
        return self._epoch + self.line.clock.now_ns / NS

    def serve(self, stopped: Callable[[], bool]) -> None:
        """Serve until ``stopped`` returns True; it is asked at least ten times a second."""
        self._started = time.monotonic() - self.line.clock.now_ns / NS / self._speed
        try:
            while not stopped():
                idle_s = self._idle_s()
                for key, events in self._selector.select(idle_s):
                    self._ready(key.data, events)
                self._run(idle_s)
                self._go_on()
        finally:
            self.close()

    def _go_on(self) -> None:
        """Take what clients had to wait with, send what waits for them, drop those that are not there."""
        latest = time.monotonic() - _HANDSHAKE_S
        for client in tuple(self._clients):
            if client.incoming and not client.full:
                client.take(b"")
            if client.outgoing:
                self.flush(client)
            self._await(client)
            if len(client.outgoing) > _BACKLOG_LIMIT or (client.stage != _RAW and client.since < latest):
                self.drop(client)

    def close(self) -> None:
        """Drop all clients and stop listening."""
        for client in tuple(self._clients):
            self.drop(client)
        self._selector.close()
        self._listener.close()

    # ---- time ----------------------------------------------------------------------------------

    def _now_ns(self) -> int:
        return round((time.monotonic() - self._started) * self._speed * NS)

    def _run(self, idle_s: float) -> None:
        """Let the line's time follow the wall clock, in slices so that clients are heard in between."""
        clock = self.line.clock
        behind_s = (self._now_ns() - clock.now_ns) / NS / self._speed - idle_s
        if behind_s > _BEHIND_S:
            paused_s = behind_s - 0.5 * _BEHIND_S
            self._started += paused_s
            if paused_s >= WORTH_SAYING_S:
                self._say(f"{PAUSED} {paused_s:.2f} s: this computer did not run it")
        target = min(self._now_ns(), clock.now_ns + _SLICE_NS)
        with clock.held:
            clock.step(clock.now_ns)
        clock.run_until(max(target, clock.now_ns))

    def _idle_s(self) -> float:
        wall = time.monotonic()
        limits = [_IDLE_S]
        next_ns = self.line.clock.next_ns()
        if next_ns != NEVER:
            limits.append((next_ns - self._now_ns()) / NS / self._speed)
        if self._now_ns() - self.line.clock.now_ns > _SLICE_NS:
            limits.append(0.0)
        if any(client.full for client in self._clients):
            limits.append(0.0)
        limits += [client.held_until - wall for client in self._clients if client.outgoing and client.held_until > wall]
        return max(0.0, min(limits))

    # ---- sockets -------------------------------------------------------------------------------

    def _ready(self, client: Client | None, events: int) -> None:
        if client is None:
            for _ in range(_ACCEPTED_AT_ONCE):
                if not self._accept():
                    return
            return
        if events & selectors.EVENT_READ:
            try:
                data = client.connection.recv(_RECEIVE_BYTES)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if data:
                client.take(data)
            else:
                self.drop(client)

    def _accept(self) -> bool:
        """Take one connection; return whether there was one."""
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return False
        if len(self._clients) >= _MOST_CLIENTS:
            connection.close()
            return True
        connection.setblocking(False)
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = Client(self, connection)
        self._clients[client] = None
        self._selector.register(connection, selectors.EVENT_READ, client)
        client.outgoing += b"< hi >"
        self.flush(client)
        return True

    def flush(self, client: Client) -> None:
        """Send what waits for a client, as much as it takes."""
        if not client.here or client.held_until > time.monotonic():
            return
        try:
            while client.outgoing:
                sent = client.connection.send(client.outgoing)
                del client.outgoing[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self.drop(client)

    def _await(self, client: Client) -> None:
        """Wait for what can happen next with a client: a full one is not read."""
        sending = client.outgoing and client.held_until <= time.monotonic()
        wanted = (0 if client.full else selectors.EVENT_READ) | (selectors.EVENT_WRITE if sending else 0)
        if client.here and wanted != client.awaited:
            if client.awaited == 0:
                self._selector.register(client.connection, wanted, client)
            elif wanted == 0:
                self._selector.unregister(client.connection)
            else:
                self._selector.modify(client.connection, wanted, client)
            client.awaited = wanted

    def drop(self, client: Client) -> None:
        """Close a client's connection."""
        if client.here:
            client.here = False
            del self._clients[client]
            self.line.detach(client)
            if client.awaited:
                self._selector.unregister(client.connection)
            client.connection.close()
