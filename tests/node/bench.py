# SPDX-License-Identifier: MIT
"""A simulated line with simple drives on it, and raw access to it."""

from __future__ import annotations

from dataclasses import dataclass

import can

from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.faults import parse_faults
from pmsmtool.sim.line import Line
from pmsmtool.sim.node.memory import PAGE_BYTES, Memory, RamStorage, Storage
from pmsmtool.sim.node.node import Node, Settings
from pmsmtool.sim.node.parameter_set import ParameterImage
from tests.node.raw_client import RawClient
from tests.node.simple_core import SimpleCore

SERIAL = 0x1234


def steps_of(content: bytes) -> int:
    """Return the write steps of a store: header erased, pages, header written."""
    return 2 + -(-len(content) // PAGE_BYTES)


@dataclass
class Bench:
    """A line, its first drive, a program on it."""

    line: Line
    node: Node
    core: SimpleCore
    storage: Storage
    bus: PmsmSimBus
    client: RawClient

    def listen(self, seconds: float) -> list[can.Message]:
        """Return what arrives within a time."""
        deadline = self.bus.clock.now() + seconds
        found = []
        while (left := deadline - self.bus.clock.now()) > 0:
            message = self.bus.recv(left)
            if message is not None:
                found.append(message)
        return found

    def ids(self, seconds: float) -> list[int]:
        """Return the identifiers of what arrives within a time."""
        return [message.arbitration_id for message in self.listen(seconds)]

    def frames(self, can_id: int, seconds: float) -> list[bytes]:
        """Return the data of one identifier's frames within a time."""
        return [bytes(message.data) for message in self.listen(seconds) if message.arbitration_id == can_id]

    def nmt(self, command: int, node: int = 1) -> None:
        """Send an NMT command."""
        self.client.send(bytes((command, node)), 0)

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        self.bus.clock.wait(seconds)


def open_bench(
    *,
    bitrate: int | None = None,
    faults: str | None = None,
    seed: int = 1,
    node_id: int = 1,
    storage: Storage | None = None,
    nodes: int = 1,
    timeout_s: float = 0.5,
    fixed: bool = False,
) -> Bench:
    """Return a bench; ``faults`` is TOML text; only the first drive uses ``storage``."""
    line = Line(bitrate, None if faults is None else parse_faults(faults), seed=seed)
    kept = RamStorage() if storage is None else storage
    for number in range(nodes):
        settings = Settings(
            node_id=node_id if node_id == 255 else node_id + number,
            serial=SERIAL + number,
            name="test drive",
            factory=ParameterImage.of_values({"inverter.T_s_ns": 100_000}),
            rated_current_ma=10_000,
            rated_torque_mnm=8_000,
            fixed_node_id=fixed,
        )
        line.add_node(Node(line, SimpleCore(), Memory(kept if number == 0 else RamStorage()), settings))
    line.arm_faults()
    bus = PmsmSimBus("bench?nv=:memory:", line=line)
    node = line.nodes[0]
    core = node.core
    assert isinstance(core, SimpleCore)
    return Bench(line, node, core, kept, bus, RawClient(bus, 1 if node_id == 255 else node_id, timeout_s))
