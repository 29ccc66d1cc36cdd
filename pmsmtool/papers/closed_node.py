# SPDX-License-Identifier: MIT
"""A simulated drive of the standard tier under a torque that its master asks for, while a load machine sets the speed.

The node is operated through its object dictionary, what it did is read from the simulation itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pmsmtool.cia402 import Mode
from pmsmtool.design.lookup.table import RPM
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.firmware.image import pack_image
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.papers.figure import Array
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.sim.drive_kernel import KernelCore
from pmsmtool.sim.kernel import Target
from pmsmtool.sim.line import Line
from pmsmtool.sim.node.drive_core import Command, ControlMode
from pmsmtool.sim.node.factory import drive_settings
from pmsmtool.sim.node.family import Face
from pmsmtool.sim.node.memory import Memory, RamStorage
from pmsmtool.sim.node.node import Node
from pmsmtool.sim.node.session import Session
from pmsmtool.sim.signals import Signal, Truth
from pmsmtool.sim.simulated_machine import with_simulation

STANDARD = "cia402"
"""Family of a drive of which only the standard is known."""
_LARGEST = 32767
BEYOND = 1e-4
"""Relative excess from which a demand counts as above the largest voltage: a governor in binary32 keeps 2e-6."""
ENABLE = (0x0006, 0x0007, 0x000F)
"""Controlwords to operation enabled."""
SETTLE_S = 0.3
"""Time at the first speed before anything is asked for."""
_RECORDED = (Truth.T, Signal.U_D, Signal.U_Q, Signal.U_DC, Truth.TORQUE, Truth.I_D, Truth.I_Q, Truth.OMEGA_M)


@dataclass(frozen=True, slots=True)
class Seat:
    """What a run showed, one row per control period, each shape (n,).

    Attributes
    ----------
    t_s, rpm, torque_nm : ndarray
        Time, speed, torque of the machine.
    demand_v, V_max_v : ndarray
        Voltage demanded before the limiter, and the largest the inverter has.
    current_a : ndarray
        Length of the current vector.
    """

    t_s: Array
    rpm: Array
    torque_nm: Array
    demand_v: Array
    V_max_v: Array
    current_a: Array

    @property
    def saturated(self) -> int:
        """Periods in which the demand was above the largest voltage."""
        return int(np.sum(self.demand_v > (1.0 + BEYOND) * self.V_max_v))


Nodes = Sequence[tuple[float, float]]


class _Rig:
    """A simulated drive whose machine is turned by a load machine."""

    def __init__(self, source: MachineFile, seed: int) -> None:
        self.source = with_simulation(source, {"rotor": "driven"})
        self.core = KernelCore(self.source, seed)

    def _turn(self, rpm: Nodes) -> None:
        """Let the speed follow nodes from :data:`SETTLE_S` on."""
        simulation = self.core.simulation
        times = [0.0, *(1e-9 * simulation.time_ns + SETTLE_S + t for t, _ in rpm)]
        simulation.schedule(Target.DRIVEN_SPEED, times, [rpm[0][1] / RPM, *(n / RPM for _, n in rpm)])

    def _record(self, duration_s: float) -> Array:
        rows = int((duration_s + 1e-9) / (1e-9 * self.core.period_ns))
        return self.core.simulation.record(_RECORDED, rows)

    def _seat(self, record: Array) -> Seat:
        table = record[: self.core.simulation.recorded_rows].T
        return Seat(
            table[0] - table[0, 0], table[7] * RPM, table[4].copy(), np.hypot(table[1], table[2]),
            self.source.inverter.voltage_utilisation * table[3], np.hypot(table[5], table[6]),
        )  # fmt: skip


class OpenDrive(_Rig):
    """The reference drive with a design of its own, on the same machine.

    Parameters
    ----------
    source, values, seed
        As of :class:`ClosedNode`; all values of the catalogue.
    """

    def __init__(self, source: MachineFile, values: Mapping[str, float], seed: int) -> None:
        super().__init__(source, seed)
        self.core.load(pack_image(dict(values)))

    def run(self, rpm: Nodes, torque_nm: Nodes) -> Seat:
        """As :meth:`ClosedNode.run`."""
        self._turn(rpm)
        periods_per_s = 1e9 / self.core.period_ns
        self.core.command(Command(ControlMode.TORQUE))
        self.core.run(round(SETTLE_S * periods_per_s))
        record = self._record(torque_nm[-1][0])
        for (t, torque), (end, _) in pairwise(torque_nm):
            self.core.command(Command(ControlMode.TORQUE, torque_nm=torque))
            self.core.run(round(end * periods_per_s) - round(t * periods_per_s))
        return self._seat(record)


class ClosedNode(_Rig):
    """A drive of the standard tier on a machine whose speed is imposed.

    Parameters
    ----------
    source : MachineFile
        The machine, with its truth in ``[simulation]``.
    values : mapping of str to float
        What was written into the drive: catalogue values its map has an object for.
    seed : int
        Seed of its noise.
    """

    def __init__(self, source: MachineFile, values: Mapping[str, float], seed: int) -> None:
        super().__init__(source, seed)
        drive_map = load_family(STANDARD)
        settings = drive_settings(self.source, "closed", 1, 0, face=Face(drive_map))
        self.line = Line(None, None, seed=seed, instant=True)
        self.node = Node(self.line, self.core, Memory(RamStorage()), settings)
        self.line.add_node(self.node)
        wanted = {name: value for name, value in values.items() if name in drive_map.cells}
        for name, data in drive_map.encode(ParameterSet(wanted)).items():
            self._write_bytes(*drive_map.address(name), data)

    def _write_bytes(self, index: int, sub: int, data: bytes) -> None:
        dictionary = self._session.dictionary
        dictionary.write(dictionary.writable(index, sub), data)

    @property
    def _session(self) -> Session:
        assert self.node.session is not None
        return self.node.session

    def write(self, index: int, number: int, size: int) -> None:
        """Write a whole number."""
        self._write_bytes(index, 0, number.to_bytes(size, "little", signed=number < 0))

    def run(self, rpm: Nodes, torque_nm: Nodes) -> Seat:
        """Let the speed follow nodes (s, rpm), and ask for torques: each holds from its time to the next's.

        The last torque node ends the run. Times count from when the first speed has been held for a while.
        """
        self._turn(rpm)
        self.write(0x6060, Mode.PROFILE_TORQUE, 1)
        self.write(0x6071, 0, 2)
        for word in ENABLE:
            self.write(0x6040, word, 2)
        self.line.clock.wait(SETTLE_S)
        self.node.look()
        record = self._record(torque_nm[-1][0])
        for (t, torque), (end, _) in pairwise(torque_nm):
            self.write(0x6071, self._permille(torque), 2)
            self.line.clock.wait(end - t)
        self.node.look()
        return self._seat(record)

    def _permille(self, torque_nm: float) -> int:
        rated = 1e-3 * self._session.dictionary["cia402.rated_torque"].number()
        return max(-_LARGEST, min(_LARGEST, round(1000.0 * torque_nm / rated)))
