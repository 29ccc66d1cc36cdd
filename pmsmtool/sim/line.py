# SPDX-License-Identifier: MIT
"""The simulated CAN line: one wire with arbitration and frame times, the drives on it, the programs attached to it.

Frames queue for the wire, the lowest identifier goes first when it becomes free, and a frame arrives everywhere at the
end of its time on the wire. Everything runs on the line's own virtual clock.

Carries the faults of a plan (``sim/faults.py``) out on one simulated line.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, Protocol

from pmsmtool.bus.clock import NS, VirtualClock
from pmsmtool.bus.frame_time import frame_bits, unstuffed_bits
from pmsmtool.errors import ConfigError
from pmsmtool.sim.faults import DriveFault, FaultPlan, FrameFault, Refusal
from pmsmtool.sim.node.node import Node

NOMINAL_BITRATE = 1_000_000
"""Rate (bit/s) whose unstuffed frame lengths pass when no bit rate is given."""
EXTENDED = 1
REMOTE = 2
_NOMINAL_NS = tuple(unstuffed_bits(length) * NS // NOMINAL_BITRATE for length in range(9))


class Frame(NamedTuple):
    """A frame: identifier, data, flags (``EXTENDED``, ``REMOTE``), length code of a remote frame."""

    can_id: int
    data: bytes
    flags: int = 0
    dlc: int = 0


class Endpoint(Protocol):
    """A program attached to the line."""

    echo: bool
    """Whether it hears its own frames."""

    def hear(self, frame: Frame, own: bool) -> None:
        """Take a frame that has arrived."""

    def transmitted(self, acknowledged: bool) -> None:
        """One of the endpoint's frames has left."""

    def pull(self, recv_raises: bool) -> None:
        """Fault injection: the adapter is pulled."""


def _priority(frame: Frame) -> int:
    """Return the arbitration field as a number; the smaller wins (ISO 11898-1, 10.8)."""
    remote = frame.flags & REMOTE
    if frame.flags & EXTENDED:
        base, low = frame.can_id >> 18, frame.can_id & 0x3FFFF
        return base << 21 | 1 << 20 | 1 << 19 | low << 1 | remote >> 1
    return frame.can_id << 21 | (remote >> 1) << 20


class Line:
    """One simulated line.

    Parameters
    ----------
    bitrate : int or None
        Bit rate (bit/s) for bit-exact frame times. None: nominal times.
    faults : FaultPlan or None
        Faults on purpose.
    instant : bool
        Frames take no time (a served line without a bit rate, where the network takes longer anyway).

    Attributes
    ----------
    clock : VirtualClock
        The time of everything on the line.
    nodes : list of Node
        The drives.
    frames : int
        Frames that have passed.
    wire_ns : int
        Time (ns) the wire has been busy.
    """

    def __init__(
        self, bitrate: int | None = None, faults: FaultPlan | None = None, *, seed: int = 0, instant: bool = False
    ) -> None:
        self.clock = VirtualClock()
        self.bitrate = bitrate
        self.nodes: list[Node] = []
        self.endpoints: list[Endpoint] = []
        self.frames = 0
        self.wire_ns = 0
        self._instant = instant
        self._pending: list[tuple[int, int, Node | Endpoint, Frame]] = []
        self._count = 0
        self._on_wire: tuple[Node | Endpoint, Frame] | None = None
        self._injector = None if faults is None else Injector(faults, self, seed)

    # ---- the wire ------------------------------------------------------------------------------

    def transmit(self, sender: Node, can_id: int, data: bytes) -> None:
        """Queue a data frame of a node."""
        self.queue(sender, Frame(can_id, data))

    def queue(self, sender: Node | Endpoint, frame: Frame) -> None:
        """Queue a frame for the wire."""
        if self._on_wire is None:  # nothing to arbitrate with
            self._put_on_wire(sender, frame)
            return
        self._count += 1
        heapq.heappush(self._pending, (_priority(frame), self._count, sender, frame))

    def withdraw(self, sender: Node, can_id: int | None) -> None:
        """Take back queued frames of a node, of one identifier or all."""
        kept = [
            item for item in self._pending if item[2] is not sender or (can_id is not None and item[3].can_id != can_id)
        ]
        if len(kept) != len(self._pending):
            self._pending = kept
            heapq.heapify(kept)

    def _duration_ns(self, frame: Frame) -> int:
        if self._instant and self.bitrate is None:
            return 0
        if self.bitrate is None and not frame.flags:
            return _NOMINAL_NS[len(frame.data)]
        bits = frame_bits(
            frame.can_id,
            frame.data,
            extended=bool(frame.flags & EXTENDED),
            remote=bool(frame.flags & REMOTE),
            dlc=frame.dlc if frame.flags & REMOTE else None,
        )
        return bits * NS // (self.bitrate or NOMINAL_BITRATE)

    def _put_on_wire(self, sender: Node | Endpoint, frame: Frame) -> None:
        self._on_wire = sender, frame
        duration_ns = self._duration_ns(frame)
        self.wire_ns += duration_ns
        clock = self.clock
        clock.at(clock.now_ns + duration_ns, self._arrive)

    def _arrive(self) -> None:
        if self._on_wire is None:
            raise RuntimeError("nothing is on the wire")
        sender, frame = self._on_wire
        self.frames += 1
        # what waited by now begins when the wire is free; whoever answers this frame has yet to read it
        waited = heapq.heappop(self._pending)[2:] if self._pending else None
        program = None if isinstance(sender, Node) else sender
        acknowledged = program is None or self.is_acknowledged(program)
        if acknowledged:
            if self._injector is None:
                self.deliver(sender, frame)
            else:
                self._injector.carry(sender, frame, program is None)
        if program is not None:
            program.transmitted(acknowledged)
        self._on_wire = None
        if waited is not None:
            self._put_on_wire(*waited)
        elif self._pending:
            self._put_on_wire(*heapq.heappop(self._pending)[2:])

    @property
    def busy(self) -> bool:
        """Whether a frame is on the wire."""
        return self._on_wire is not None

    def is_acknowledged(self, sender: Endpoint) -> bool:
        """Whether any other controller is there to acknowledge a program's frame."""
        return len(self.endpoints) > 1 or any(node.listens for node in self.nodes)

    def deliver(self, sender: Node | Endpoint | None, frame: Frame) -> None:
        """Hand a frame to everybody but its sender."""
        for endpoint in self.endpoints:
            own = endpoint is sender
            if not own or endpoint.echo:
                endpoint.hear(frame, own)
        for node in self.nodes:
            if node is not sender:
                node.receive(frame.can_id, frame.data, frame.flags)

    # ---- who is there --------------------------------------------------------------------------

    def attach(self, endpoint: Endpoint) -> None:
        """Attach a program."""
        self.endpoints.append(endpoint)

    def detach(self, endpoint: Endpoint) -> None:
        """Detach a program; its frames still queued are lost."""
        if endpoint in self.endpoints:
            self.endpoints.remove(endpoint)
            self._pending = [item for item in self._pending if item[2] is not endpoint]
            heapq.heapify(self._pending)

    def add_node(self, node: Node) -> None:
        """Connect a drive."""
        self.nodes.append(node)

    def arm_faults(self) -> None:
        """Begin with the faults on purpose, now that the drives are there."""
        if self._injector is not None:
            self._injector.arm()

    def node_by_id(self, node_id: int) -> Node | None:
        """Return the node that uses a node id now."""
        return next((node for node in self.nodes if node.node_id == node_id), None)


class Injector:
    """Carries a plan out on one line."""

    def __init__(self, plan: FaultPlan, line: Line, seed: int) -> None:
        self._plan = plan
        self._line = line
        self._random = random.Random(seed)
        self._matched = [0] * len(plan.frames)
        self._struck = [0] * len(plan.frames)
        self._held: dict[bool, list[tuple[Node | Endpoint, Frame]]] = {False: [], True: []}
        self._at_frame: list[tuple[int, Callable[[], None]]] = []

    def arm(self) -> None:
        """Plan what happens at instants, frames and store steps; the line's drives are there."""
        for fault in self._plan.drives:
            self._arm_drive(fault)
        for pulled in self._plan.adapters:
            self._arm_when(pulled.at_frame, pulled.at_s, partial(self._pull, pulled.recv_raises))
        for node in self._line.nodes:
            node.set_faults(
                refuse=_Refuser(self._plan.refusals) if self._plan.refusals else None,
                distort=self._distort if self._plan.lies else None,
                store_scale=self._plan.store_factor,
                absent=self._plan.absences,
            )

    def _arm_when(self, at_frame: int | None, at_s: float | None, action: Callable[[], None]) -> None:
        if at_frame is not None:
            self._at_frame.append((at_frame, action))
        elif at_s is not None:
            self._line.clock.after(at_s, action)

    def _arm_drive(self, fault: DriveFault) -> None:
        node = self._line.nodes[0] if fault.node is None else self._line.node_by_id(fault.node)
        if node is None:
            raise ConfigError(
                f"no drive with node id {fault.node} is on the line",
                where="[[drive]] node",
                hint="give the node id of a drive that is served",
            )
        if fault.at_store_step is not None:
            _StepCounter(node, fault.at_store_step, lambda: self._strike(node, fault))
        else:
            self._arm_when(fault.at_frame, fault.at_s, lambda: self._strike(node, fault))

    def _strike(self, node: Node, fault: DriveFault) -> None:
        if fault.action == "reset":
            node.reset()
            return
        back: Callable[[], None]
        if fault.action == "unplug":
            node.plugged = False
            back = node.plug_in
        else:
            node.power_cut()
            back = node.power_on
        if fault.back_after_s is not None:
            self._line.clock.after(fault.back_after_s, back)

    def _pull(self, recv_raises: bool) -> None:
        for endpoint in tuple(self._line.endpoints):
            endpoint.pull(recv_raises)

    def _distort(self, index: int, sub: int, data: bytes) -> tuple[int, bytes]:
        for lie in self._plan.lies:
            if lie.target == (index, sub):
                sent = data[: len(data) - lie.cut] if lie.cut else data
                return max(0, len(data) + lie.announce), sent
        return len(data), data

    # ---- frames --------------------------------------------------------------------------------

    def carry(self, sender: Node | Endpoint, frame: Frame, from_drive: bool) -> None:
        """Deliver a frame, or what the rules make of it."""
        strike = self._strike_frame(frame.can_id, from_drive)
        if strike is None:
            self._deliver(sender, frame, from_drive)
        else:
            self._apply(strike, sender, frame, from_drive)
        if self._at_frame:
            due = [action for number, action in self._at_frame if number <= self._line.frames]
            self._at_frame = [item for item in self._at_frame if item[0] > self._line.frames]
            for action in due:
                action()

    def _strike_frame(self, can_id: int, from_drive: bool) -> FrameFault | None:
        for number, rule in enumerate(self._plan.frames):
            if not rule.matches(can_id, from_drive):
                continue
            self._matched[number] += 1
            if self._matched[number] <= rule.after or (rule.count is not None and self._struck[number] >= rule.count):
                continue
            if rule.probability >= 1.0 or self._random.random() < rule.probability:
                self._struck[number] += 1
                return rule
        return None

    def _apply(self, rule: FrameFault, sender: Node | Endpoint, frame: Frame, from_drive: bool) -> None:
        if rule.action == "delay":
            self._line.clock.after(rule.delay_s, lambda: self._line.deliver(sender, frame))
        elif rule.action == "duplicate":
            self._deliver(sender, frame, from_drive)
            self._line.deliver(sender, frame)
        elif rule.action == "reorder":
            held = sender, frame
            self._held[from_drive].append(held)
            self._line.clock.after(rule.delay_s, lambda: self._release(held, from_drive))
        elif rule.action == "corrupt":
            self._deliver(sender, self._corrupted(frame), from_drive)

    def _corrupted(self, frame: Frame) -> Frame:
        if not frame.data:
            return frame
        data = bytearray(frame.data)
        data[self._random.randrange(len(data))] ^= 1 << self._random.randrange(8)
        return frame._replace(data=bytes(data))

    def _deliver(self, sender: Node | Endpoint, frame: Frame, from_drive: bool) -> None:
        self._line.deliver(sender, frame)
        for held in tuple(self._held[from_drive]):
            self._release(held, from_drive)

    def _release(self, held: tuple[Node | Endpoint, Frame], from_drive: bool) -> None:
        if held in self._held[from_drive]:
            self._held[from_drive].remove(held)
            self._line.deliver(*held)


class _Refuser:
    """Counts down the refusals of a plan."""

    def __init__(self, refusals: Sequence[Refusal]) -> None:
        self._refusals = tuple(refusals)
        self._used = [0] * len(self._refusals)

    def __call__(self, index: int, sub: int) -> int | None:
        for number, refusal in enumerate(self._refusals):
            if refusal.target == (index, sub) and (refusal.count is None or self._used[number] < refusal.count):
                self._used[number] += 1
                return refusal.code
        return None


class _StepCounter:
    """Acts after a number of write steps of a node's memory, counted over all stores."""

    def __init__(self, node: Node, steps: int, action: Callable[[], None]) -> None:
        self._left = steps
        self._action = action
        self._before = node.on_store_step
        node.on_store_step = self

    def __call__(self) -> None:
        self._before()
        self._left -= 1
        if self._left == 0:
            self._action()
