# SPDX-License-Identifier: MIT
"""The governor of a closed drive on a simulated node of the standard level: what it promises, and what it costs.

A simulated drive of the standard level under a torque that its master asks for, while a load machine sets the speed.

The node is operated through its object dictionary, what it did is read from the simulation itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.cia402 import Mode
from pmsmtool.design.closed_drive import RATED, SLOPE, TORQUE, ClosedDrive, Guarantee, tune_closed
from pmsmtool.design.design_file import Design
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.firmware.image import pack_image
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.papers.figure import Check, Column, Panel, Reproduction, Series, Table, at_least, at_most
from pmsmtool.papers.registry import OURS
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.sim.drive_kernel import KernelCore
from pmsmtool.sim.kernel import Signal, Target, Truth
from pmsmtool.sim.line import Line
from pmsmtool.sim.node.drive_core import Command, ControlMode
from pmsmtool.sim.node.factory import SET_UP_BANDWIDTH, drive_settings
from pmsmtool.sim.node.family import Face
from pmsmtool.sim.node.memory import Memory, RamStorage
from pmsmtool.sim.node.node import Node
from pmsmtool.sim.node.session import Session
from pmsmtool.sim.simulated_machine import with_simulation
from pmsmtool.units import RPM_PER_RAD_S

STANDARD = "cia402"
"""Family of a drive of which only the standard is known."""
_LARGEST = 32767
OVER_LIMIT = 1e-4
"""Relative excess from which a demand counts as above the largest voltage: a governor in binary32 keeps 2e-6."""
ENABLE = (0x0006, 0x0007, 0x000F)
"""Controlwords to operation enabled."""
SETTLE_S = 0.3
"""Time at the first speed before anything is asked for."""
_RECORDED = (Truth.T, Signal.U_D, Signal.U_Q, Signal.U_DC, Truth.TORQUE, Truth.I_D, Truth.I_Q, Truth.OMEGA_M)


@dataclass(frozen=True, slots=True)
class Seat:
    """What a run showed, one row per control period, each shape (n,)."""

    t_s: Array
    rpm: Array
    torque_nm: Array
    """Time, speed, torque of the machine."""
    demand_v: Array
    V_max_v: Array
    """Voltage demanded before the limiter, and the largest the inverter has."""
    current_a: Array
    """Length of the current vector."""

    @property
    def saturated(self) -> int:
        """Periods in which the demand was above the largest voltage."""
        return int(np.sum(self.demand_v > (1.0 + OVER_LIMIT) * self.V_max_v))


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
        simulation.schedule(
            Target.DRIVEN_SPEED, times, [rpm[0][1] / RPM_PER_RAD_S, *(n / RPM_PER_RAD_S for _, n in rpm)]
        )

    def _record(self, duration_s: float) -> Array:
        rows = int((duration_s + 1e-9) / (1e-9 * self.core.period_ns))
        return self.core.simulation.record(_RECORDED, rows)

    def _seat(self, record: Array) -> Seat:
        table = record[: self.core.simulation.recorded_rows].T
        return Seat(
            table[0] - table[0, 0], table[7] * RPM_PER_RAD_S, table[4].copy(), np.hypot(table[1], table[2]),
            self.source.inverter.voltage_utilisation * table[3], np.hypot(table[5], table[6]),
        )  # fmt: skip


class OpenDrive(_Rig):
    """The reference drive with a design of its own, on the same machine.

    ``source``, ``values``, ``seed``: as of :class:`ClosedNode`; all values of the catalogue.
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
    """A drive of the standard level on a machine whose speed is imposed.

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


PROFILE = "interior-2k2"
SPEED_RPM, ACCELERATION, RISE_S = 600.0, 3000.0, 0.02
"""Speed the guarantee is asked for, its acceleration (rpm/s), and the time to the torque limit."""
REFERENCES, HOLD_S = 24, (0.01, 0.15)
"""Unreachable references of a run, and how long each is held."""
BEYOND = (1.2, 3.0)
"""Size of the references over the full governor's largest torque."""
REST_S = 0.2
RAW_PERMILLE_PER_S = 1e7
RAW_TORQUE = 10.0
"""Slope and torque limit (over rated) of a drive as delivered: none."""
LEAST_TIGHT = 0.6
"""Share of the bound the worst run must reach, else the guarantee gives too much away; 0.72 over five seeds."""


def source() -> MachineFile:
    """Return the machine: the profile at a constant temperature."""
    return with_simulation(load_machine_file(PROFILE), {"thermal_on": False})


def design(request: TuneRequest) -> tuple[Design, Guarantee]:
    """Return the design for the standard-level node; its current bandwidth is what its maker's tool has set up."""
    file = source()
    bandwidth = SET_UP_BANDWIDTH / file.inverter.T_s / (2.0 * np.pi)
    offers = frozenset(load_family(STANDARD).cells)
    return tune_closed(file, request, ClosedDrive(STANDARD, offers, bandwidth, RISE_S, SPEED_RPM, ACCELERATION))


def closed_drive(seed: int) -> Reproduction:
    """Ask a closed drive for unreachable torques, and hold one on speed ramps; with its limits, 3x slope, and none."""
    made, promised = design(TuneRequest())
    values = {name: value.value for name, value in made.values.items()}
    raw = {**values, SLOPE: 1e-3 * RAW_PERMILLE_PER_S * values[RATED], TORQUE: RAW_TORQUE * values[RATED]}
    full = tune(source(), TuneRequest(governor="best")).parameter_set().values
    drives: dict[str, Mapping[str, float]] = {
        "closed, limits": values,
        "closed, slope x 3": {**values, SLOPE: 3.0 * values[SLOPE]},
        "closed, as delivered": raw,
    }
    rows, checks, shown = [], [], {}
    for name, (rpm, torque) in _scenarios(promised, seed).items():
        best = OpenDrive(source(), full, seed).run(rpm, torque)
        useful = _useful(best, torque)
        rows.append(_row(name, "full governor", best, promised, useful, useful))
        for drive, given in drives.items():
            seen = ClosedNode(source(), given, seed).run(rpm, torque)
            rows.append(_row(name, drive, seen, promised, _useful(seen, torque), useful))
            shown[name, drive] = seen
            if drive == "closed, limits":
                checks += _checks(name, seen, promised)
    tight = max(float(shown[name, "closed, limits"].demand_v.max()) for name in _scenarios(promised, seed))
    checks.append(at_least("largest demand over its bound", tight / promised.demand_v, LEAST_TIGHT, "1"))
    worst = shown["unreachable references", "closed, as delivered"]
    checks.append(at_least("as delivered, unreachable references: saturated periods", worst.saturated, 1, "1"))
    return Reproduction(
        OURS,
        (Table(f"{PROFILE}, up to {promised.n_rpm:.5g} rpm", HEADS, tuple(rows)), _cost(promised)),
        _panels(promised, shown), tuple(checks), made.notes,
    )  # fmt: skip


HEADS = (
    Column("scenario"), Column("drive"), Column("peak demand", "V"), Column("over its bound"),
    Column("saturated", "periods"), Column("peak |i|", "A"), Column("mean torque asked for", "N m"),
    Column("lost against the full governor", "%", 3),
)  # fmt: skip


def _scenarios(promised: Guarantee, seed: int) -> dict[str, tuple[Nodes, Nodes]]:
    """Return speed and torque nodes by name."""
    rng = np.random.default_rng(seed)
    largest = float(promised.governed_nm.max())
    t, torque = 0.0, []
    for k in range(REFERENCES):
        torque.append((t, float((-1) ** k * rng.uniform(*BEYOND) * largest)))
        t += float(rng.uniform(*HOLD_S))
    torque.append((t, 0.0))
    rise = promised.n_rpm / promised.acceleration_rpm_per_s
    top = promised.n_rpm
    ramp = ((0.0, 0.0), (rise, top), (rise + REST_S, top), (3.0 * rise + REST_S, -top), (3.0 * rise + 2 * REST_S, -top))
    held = ((0.0, 3.0 * largest), (rise + 0.5 * REST_S, -3.0 * largest), (ramp[-1][0], 0.0))
    return {"unreachable references": (((0.0, top),), tuple(torque)), "speed ramp": (ramp, held)}


def _useful(seen: Seat, torque: Nodes) -> float:
    """Return the mean torque in the direction that was asked for (N m)."""
    times, asked = np.array(torque).T
    sign = np.sign(asked[np.clip(np.searchsorted(times, seen.t_s, side="right") - 1, 0, len(asked) - 2)])
    return float(np.mean(sign * seen.torque_nm))


def _row(
    name: str, drive: str, seen: Seat, promised: Guarantee, useful: float, best: float
) -> tuple[str | float | int, ...]:
    demand = float(seen.demand_v.max())
    return (
        name, drive, demand, demand / promised.demand_v, seen.saturated, float(seen.current_a.max()), useful,
        100.0 * (1.0 - useful / best),
    )  # fmt: skip


def _checks(name: str, seen: Seat, promised: Guarantee) -> list[Check]:
    current = promised.I_apk + promised.deviation_a
    return [
        at_most(f"{name}: saturated periods", seen.saturated, 0, "1"),
        at_most(f"{name}: largest demand", float(seen.demand_v.max()), promised.demand_v, "V"),
        at_most(f"{name}: largest current", float(seen.current_a.max()), current, "A"),
    ]


def _cost(promised: Guarantee) -> Table:
    columns = (
        Column("speed", "rpm"), Column("torque, constant limits", "N m"), Column("limit that follows the speed", "N m"),
        Column("full governor", "N m"), Column("lost", "%", 3),
    )  # fmt: skip
    rows = []
    for k in range(0, len(promised.speeds_rpm), 5):
        full = float(promised.governed_nm[k])
        lost = 100.0 * (1.0 - promised.tau_nm / full)
        rows.append((float(promised.speeds_rpm[k]), promised.tau_nm, float(promised.closed_nm[k]), full, lost))
    return Table("what the limits cost", columns, tuple(rows))


def _panels(promised: Guarantee, shown: Mapping[tuple[str, str], Seat]) -> tuple[Panel, ...]:
    panels = []
    for name in ("unreachable references", "speed ramp"):
        lines = [
            Series(drive, shown[name, drive].t_s, shown[name, drive].demand_v)
            for drive in ("closed, as delivered", "closed, slope x 3", "closed, limits")
        ]
        t = shown[name, "closed, limits"].t_s
        lines.append(Series("bound", t[[0, -1]], np.full(2, promised.demand_v), "--", -1))
        lines.append(Series("V_max", t[[0, -1]], np.full(2, shown[name, "closed, limits"].V_max_v.min()), ":", -1))
        panels.append(Panel(name, "t / s", "|u| / V", tuple(lines)))
    x = promised.speeds_rpm
    torque = (
        Series("full governor", x, promised.governed_nm), Series("limit that follows the speed", x, promised.closed_nm),
        Series("constant limits", x, np.full(len(x), promised.tau_nm)),
    )  # fmt: skip
    return (*panels, Panel("largest torque", "n / rpm", "T / N m", torque))
