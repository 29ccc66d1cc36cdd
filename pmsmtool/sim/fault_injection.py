# SPDX-License-Identifier: MIT
"""Carries the faults of a plan (``sim/faults.py``) out on one simulated line."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from pmsmtool.errors import ConfigError
from pmsmtool.sim.faults import DriveFault, FaultPlan, FrameFault, Refusal

if TYPE_CHECKING:
    from pmsmtool.sim.line import Endpoint, Frame, Line
    from pmsmtool.sim.node.node import Node


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
