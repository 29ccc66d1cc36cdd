# SPDX-License-Identifier: MIT
"""Supervision of one node: heartbeat, boot-ups, emergencies, and other masters on the bus.

Callbacks only take notes; :meth:`Supervision.check` raises. The SDO channel calls it whenever it
waits, so a node that went away ends a download within a second instead of after hundreds of time-outs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from pmsmtool.bus.connection import Connection
from pmsmtool.bus.nmt import HEARTBEAT_ID, NMT_ID, TOOL_NODE, NmtState
from pmsmtool.cia402 import ERROR_CAUSES, error_text
from pmsmtool.errors import BusError, DriveFault

HEARTBEAT_TOLERANCE = 2.5
"""Periods without any frame of the node after which it counts as lost: one lost heartbeat is no lost node."""
LIFE = (0x080, 0x180, 0x280, 0x380, 0x480, 0x580)
"""Emergencies, TPDOs and SDO answers: beside its heartbeat, what only a living node sends (CiA 301, section 7.3.3)."""
HARMLESS = frozenset({0x1000, 0x1018})
"""Who only reads these looks who is on the bus, as every second tool does before it knows that the drive is taken."""
EMERGENCIES_MAX = 1000
"""Newest emergencies kept: a node that floods the bus sends 4000 a second at 500 kbit/s."""
SENT_MEMORY = 256
"""Requests remembered to tell our own echo from a second master; a sub-block has 127."""
STOPPING_CLASSES = frozenset({0x2, 0x3, 0x4, 0x7})
"""Emergency classes current, voltage, temperature, additional modules: work on this node ends."""
_GRACE_S = 0.05
# A reader thread that a busy main thread starved gets this long before a heartbeat counts as lost.


class NodeReset(BusError):
    """The node booted although nobody asked it to: what was written so far is lost."""


class HeartbeatLost(BusError):
    """The node's heartbeat stayed away."""


class SecondMaster(BusError):
    """Somebody else speaks to the node."""


@dataclass(frozen=True, slots=True)
class Emergency:
    """One emergency message (CiA 301, section 7.2.7)."""

    code: int
    """Error code, 0 for "error reset"."""
    register: int
    """Error register 0x1001."""
    detail: bytes
    """Manufacturer's five bytes, fewer when the message was short."""

    def __str__(self) -> str:
        text = f"emergency {self.code:#06x} ({error_text(self.code)}), register {self.register:#04x}"
        return text + (f", detail {self.detail.hex(' ')}" if any(self.detail) else "")


class Supervision:
    """What is known about one node from the frames it and others send.

    Attributes
    ----------
    heartbeat_period_s : float or None
        Producer heartbeat time 0x1017; None where the node has none or it was not read yet.
    nmt_state : NmtState or None
        As last reported.
    boot_ups : int
        Boot-up messages heard.
    emergencies : list of Emergency
        The newest ones, in order of arrival.
    foreign_requests : int
        SDO requests to the node, NMT commands and heartbeats of a master that this program did not send.
    foreign : str
        What the last of them was.
    stop_at_emergency, stop_at_other_master : bool
        Whether these end the work; not while the drive is being stopped.
    """

    def __init__(self, connection: Connection, node: int) -> None:
        self.node = node
        self.heartbeat_period_s: float | None = None
        self.nmt_state: NmtState | None = None
        self.boot_ups = 0
        self.emergencies: list[Emergency] = []
        self.foreign_requests = 0
        self.foreign = ""
        self.stop_at_emergency = True
        self.stop_at_other_master = True
        self._connection = connection
        self._last_heard_s: float | None = None
        self._deaf_then_s = 0.0
        self._boots_seen = 0
        self._emergencies_seen = 0
        self._foreign_seen = 0
        self._echoes: bool | None = None  # whether the adapter shows what we send as received; None: not known yet
        self._paused = False
        self._subscriptions = [
            (HEARTBEAT_ID + node, self._on_heartbeat),
            (0x080 + node, self._on_emergency),
            (0x600 + node, self._on_request),
            (NMT_ID, self._on_request),
            (0x580 + node, self._on_answer),
            (HEARTBEAT_ID + TOOL_NODE, self._on_master),
            *((base + node, self._on_life) for base in LIFE),
        ]
        for cob_id in (0x600 + node, NMT_ID, HEARTBEAT_ID + TOOL_NODE):
            connection.sent.setdefault(cob_id, deque(maxlen=SENT_MEMORY))
        for cob_id, callback in self._subscriptions:
            connection.subscribe(cob_id, callback)

    def close(self) -> None:
        """Stop listening."""
        for cob_id, callback in self._subscriptions:
            self._connection.unsubscribe(cob_id, callback)

    def expect_master(self, master: int) -> None:
        """Take heartbeats of a node for those of another master: one that the drive itself supervises (0x1016)."""
        subscription = (HEARTBEAT_ID + master, self._on_master)
        if master != self.node and subscription not in self._subscriptions:
            self._subscriptions.append(subscription)
            self._connection.subscribe(*subscription)

    @contextmanager
    def expected_reset(self) -> Iterator[None]:
        """While the node is reset on purpose: its boot-up and its silence are no errors."""
        self._paused = True
        try:
            yield
        finally:
            self._paused = False
            self._boots_seen = self.boot_ups
            self._last_heard_s = None

    @contextmanager
    def other_masters_tolerated(self) -> Iterator[None]:
        """While the drive is stopped and restored: that is done whoever else talks to it."""
        before, self.stop_at_other_master = self.stop_at_other_master, False
        try:
            yield
        finally:
            self.stop_at_other_master = before

    def check(self) -> None:
        """Raise what makes further work on the node pointless.

        Raises NodeReset, HeartbeatLost, SecondMaster, DriveFault: each once per occurrence.
        """
        if self._paused:
            return
        if self.boot_ups > self._boots_seen:
            self._boots_seen = self.boot_ups
            raise NodeReset(
                "the node was reset in the middle of the work: values not stored are lost",
                where=f"node {self.node}",
                likely="its supply dipped, its watchdog fired, another master reset it, or a second node has its id",
                hint="check the supply, then run the command again",
            )
        if self.foreign_requests > self._foreign_seen and self.stop_at_other_master:
            self._foreign_seen = self.foreign_requests
            raise SecondMaster(
                f"another master is on the bus: {self.foreign}",
                where=f"node {self.node}",
                likely="a PLC, the vendor's software or a second pmsmtool is connected",
                hint="disconnect it: two masters on one SDO channel corrupt each other's transfers",
            )
        self._check_emergencies()
        self._check_heartbeat()

    def begin(self) -> None:
        """What happened until now is no error of the work that begins."""
        self._connection.collect()
        self._boots_seen = self.boot_ups
        self._foreign_seen = self.foreign_requests
        self.take_note_of_emergencies()

    def take_note_of_emergencies(self) -> None:
        """What came until now raises nothing any more."""
        self._emergencies_seen = len(self.emergencies)

    def _check_emergencies(self) -> None:
        fresh = self.emergencies[self._emergencies_seen :]
        self._emergencies_seen = len(self.emergencies)
        for emergency in fresh:
            if self.stop_at_emergency and emergency.code >> 12 in STOPPING_CLASSES:
                raise DriveFault(
                    str(emergency), where=f"node {self.node}", likely=ERROR_CAUSES.get(emergency.code, ""),
                    hint=f"`pmsmtool fault show -n {self.node}`",
                )  # fmt: skip

    def _check_heartbeat(self) -> None:
        if self._overdue() and not self._connection.in_callback():
            self._connection.wait(_GRACE_S)
            if self._overdue():
                self._last_heard_s = None
                raise HeartbeatLost(
                    f"no heartbeat, and no other frame, for {HEARTBEAT_TOLERANCE:g} periods "
                    f"of {self.heartbeat_period_s:g} s",
                    where=f"node {self.node}",
                    likely="the node lost its supply, or the cable is open",
                    hint="check supply and cable, then run the command again",
                )

    def _overdue(self) -> bool:
        """Whether the heartbeat stayed away while somebody listened: a stalled computer is no lost node."""
        if self.heartbeat_period_s is None or self._last_heard_s is None:
            return False
        silent_s = self._connection.clock.now() - self._last_heard_s - (self._connection.deaf_s - self._deaf_then_s)
        return silent_s > HEARTBEAT_TOLERANCE * self.heartbeat_period_s

    # ---- notes taken ----------------------------------------------------------------------------

    def _on_heartbeat(self, cob_id: int, data: bytes, timestamp: float) -> None:
        self._last_heard_s = self._connection.clock.now()
        self._deaf_then_s = self._connection.deaf_s
        state = data[0] & 0x7F if data else 0x7F
        self.nmt_state = NmtState(state) if state in set(NmtState) else None
        if state == NmtState.BOOT_UP:
            self.boot_ups += 1

    def _on_life(self, cob_id: int, data: bytes, timestamp: float) -> None:
        if self._last_heard_s is not None:  # of a node whose heartbeat was heard; others are not watched
            self._last_heard_s = self._connection.clock.now()
            self._deaf_then_s = self._connection.deaf_s

    def _on_master(self, cob_id: int, data: bytes, timestamp: float) -> None:
        if self._is_echo(cob_id, data, timestamp):
            self._connection.sent[cob_id].clear()
        else:
            self.foreign_requests += 1
            name = "another pmsmtool" if cob_id == HEARTBEAT_ID + TOOL_NODE else "a master this drive supervises"
            self.foreign = f"the heartbeat of node {cob_id - HEARTBEAT_ID}, {name}"

    def _on_emergency(self, cob_id: int, data: bytes, timestamp: float) -> None:
        if len(data) >= 2:
            code = int.from_bytes(data[:2], "little")
            register = data[2] if len(data) > 2 else 0
            self.emergencies.append(Emergency(code, register, data[3:8]))
            if len(self.emergencies) > EMERGENCIES_MAX:
                # One that ends the work is not pushed out by others before it was looked at.
                harmless = (k for k, one in enumerate(self.emergencies) if one.code >> 12 not in STOPPING_CLASSES)
                oldest = next(harmless, 0)
                del self.emergencies[oldest]
                self._emergencies_seen -= oldest < self._emergencies_seen

    def _on_request(self, cob_id: int, data: bytes, timestamp: float) -> None:
        if cob_id == NMT_ID and data[1:2] not in (b"\0", bytes((self.node,))):
            return
        if self._is_echo(cob_id, data, timestamp):
            self._echoes = True
        elif cob_id == NMT_ID or not _only_looks(data):
            self.foreign_requests += 1
            self.foreign = "an NMT command" if cob_id == NMT_ID else _described(data)

    def _is_echo(self, cob_id: int, data: bytes, timestamp: float) -> bool:
        """Whether a frame is our own, which comes back once; every other supervision of the node is told of it, too."""
        sent, frame = self._connection.sent.get(cob_id, ()), (cob_id, data, timestamp)
        if data in sent:
            self._connection.sent[cob_id].remove(data)
            self._connection.echo = frame
        return self._connection.echo == frame

    def _on_answer(self, cob_id: int, data: bytes, timestamp: float) -> None:
        # An echo comes before the answer, or right behind it where adapter and node race. What is older has none to
        # come, and would hide a second master's request that is the same.
        sent = self._connection.sent[0x600 + self.node]
        if len(sent) > 1:
            self._echoes = False
        if self._echoes is False:
            sent.clear()


def _only_looks(request: bytes) -> bool:
    """Whether an SDO request only reads, or ends the reading of, who the node is."""
    return request[:1] in (b"\x40", b"\x80") and int.from_bytes(request[1:3], "little") in HARMLESS


def _described(request: bytes) -> str:
    """Name an SDO request; inside a transfer only its initiate frame names the object."""
    kinds = {1: "a write of", 2: "a read of", 4: "an abort of"}
    kind = kinds.get(request[0] >> 5) if len(request) >= 4 else None
    if kind is None:
        return "an SDO transfer to this node"
    return f"{kind} 0x{int.from_bytes(request[1:3], 'little'):04X}:{request[3]:02X} of this node"
