# SPDX-License-Identifier: MIT
"""Modes 1, 7 and 8 of the simulated drive, over CAN frames: handshake, targets, windows, limits, stops."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace

import pytest

from pmsmtool.cia402 import Command, Control, State, Status, state_of
from pmsmtool.data_types import DATA_TYPES
from pmsmtool.design.tune import tune
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.params.catalogue import CATALOGUE
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.closed_loop import drive_values
from pmsmtool.sim.drive_kernel import KernelCore
from tests.node.raw_client import Aborted, RawClient

pytestmark = pytest.mark.chain

PROFILE = "jercic-2017"
TURN = 1 << 17
LETTERS = {"UNSIGNED8": "B", "UNSIGNED16": "H", "UNSIGNED32": "I", "REAL32": "f"}


class Axis:
    """A tuned drive of the profile, in a mode, enabled."""

    def __init__(self, bus: PmsmSimBus) -> None:
        self.bus, self.client = bus, RawClient(bus)
        machine = load_machine_file(PROFILE)
        values = drive_values(machine, tune(machine).parameter_set())
        for row in CATALOGUE:
            if values[row.name] != row.default:
                value = int(values[row.name]) if row.is_integer else values[row.name]
                self.client.write(row.index, row.sub, struct.pack("<" + LETTERS[row.wire], value))
                assert DATA_TYPES[row.wire].size == struct.calcsize(LETTERS[row.wire])
        self.put(0x60A4, 1, 100 * TURN)
        self.put(0x6081, 0, 2 * TURN)

    def put(self, index: int, sub: int, value: int, kind: str = "I") -> None:
        self.client.put(index, sub, value, kind)

    def number(self, index: int, sub: int = 0, kind: str = "i") -> int:
        return int(self.client.number(index, sub, kind))

    def enable(self, mode: int) -> int:
        """Enable in a mode; return the position (counts)."""
        self.put(0x6060, 0, mode, "b")
        for word in (Command.SHUTDOWN, Command.SWITCH_ON, Command.ENABLE_OPERATION):
            self.put(0x6040, 0, word, "H")
        self.wait(0.02)
        assert self.state is State.OPERATION_ENABLED
        return self.number(0x6064)

    def wait(self, seconds: float) -> None:
        deadline = self.bus.clock.now() + seconds
        while (left := deadline - self.bus.clock.now()) > 0:
            self.bus.recv(left)

    def control(self, *bits: Control) -> None:
        self.put(0x6040, 0, Command.ENABLE_OPERATION | sum(bits), "H")

    def go(self, target: int, *bits: Control) -> None:
        """Ask for a target of mode 1 by the handshake."""
        self.put(0x607A, 0, target, "i")
        self.control(Control.NEW_SET_POINT, *bits)
        assert self.status & Status.SET_POINT_TAKEN
        self.control()

    @property
    def status(self) -> Status:
        return Status(self.number(0x6041, 0, "H"))

    @property
    def state(self) -> State | None:
        return state_of(self.number(0x6041, 0, "H"))


@pytest.fixture
def axis() -> Iterator[Axis]:
    bus = PmsmSimBus(f"{PROFILE}?nv=:memory:")
    yield Axis(bus)
    bus.shutdown()


def test_a_move_by_the_handshake(axis: Axis) -> None:
    start = axis.enable(1)
    axis.wait(0.2)
    assert abs(axis.number(0x6064) - start) < 50 and axis.status & Status.TARGET_REACHED
    axis.put(0x6067, 0, 100)
    axis.go(start + TURN)
    axis.wait(0.1)
    status = axis.status
    assert not status & Status.TARGET_REACHED and not status & Status.SET_POINT_TAKEN
    assert 0 < axis.number(0x6062) - start < TURN
    axis.wait(1.0)
    assert axis.status & Status.TARGET_REACHED and axis.number(0x6062) == start + TURN
    assert abs(axis.number(0x6064) - start - TURN) < 100 and abs(axis.number(0x60F4)) < 100
    axis.go(-TURN, Control.RELATIVE)
    axis.wait(1.2)
    assert axis.number(0x6062) == start


def test_a_second_set_point_waits_and_one_at_once_does_not(axis: Axis) -> None:
    start = axis.enable(1)
    axis.go(start + TURN)
    axis.put(0x607A, 0, start - TURN // 2, "i")
    axis.control(Control.NEW_SET_POINT)
    axis.control()
    axis.wait(0.3)
    assert axis.status & Status.SET_POINT_TAKEN, "the buffer is full"
    seen = []
    for _ in range(30):
        axis.wait(0.1)
        seen.append(axis.number(0x6062) - start)
    assert max(seen) > 0.95 * TURN and seen[-1] == -TURN // 2
    assert axis.status & Status.TARGET_REACHED and not axis.status & Status.SET_POINT_TAKEN
    axis.go(start + 3 * TURN)
    axis.wait(0.3)
    axis.go(start, Control.AT_ONCE)
    axis.wait(1.5)
    assert axis.number(0x6062) == start


def test_halt_quick_stop_and_the_way_on(axis: Axis) -> None:
    start = axis.enable(1)
    axis.go(start + 20 * TURN)
    axis.wait(0.8)
    assert axis.number(0x606C) > 60_000
    axis.control(Control.HALT)
    axis.wait(0.6)
    assert abs(axis.number(0x606C)) < 2_000 and axis.state is State.OPERATION_ENABLED
    axis.control()
    axis.wait(0.8)
    assert axis.number(0x606C) > 60_000
    axis.put(0x6040, 0, Command.QUICK_STOP, "H")
    assert axis.state is State.QUICK_STOP_ACTIVE
    axis.wait(1.0)
    assert axis.state is State.SWITCH_ON_DISABLED and abs(axis.number(0x606C)) < 3_000


@pytest.mark.parametrize(("mode", "index", "sub"), [(8, 0x607A, 0), (7, 0x60C1, 1)])
def test_cyclic_targets_are_followed(axis: Axis, mode: int, index: int, sub: int) -> None:
    axis.put(0x607A, 0, 77 * TURN, "i")
    start = axis.enable(mode)
    axis.wait(0.2)
    assert abs(axis.number(0x6064) - start) < 50, "what was written before is no target"
    axis.put(0x60C2, 1, 4, "B")
    for k in range(1, 100):
        axis.put(index, sub, start + 500 * k, "i")
        axis.wait(0.004)
    axis.wait(0.5)
    assert axis.number(0x6062) == start + 500 * 99 and abs(axis.number(0x60F4)) < 50
    assert axis.status & Status.SET_POINT_TAKEN


def test_a_following_error_is_a_fault(axis: Axis) -> None:
    start = axis.enable(1)
    axis.put(0x6065, 0, 300)
    axis.put(0x6066, 0, 10, "H")
    axis.put(0x60A4, 1, 0)
    axis.put(0x6083, 0, 4_000_000_000)
    axis.go(start + 5 * TURN)
    axis.wait(1.5)
    assert axis.state is State.FAULT and axis.number(0x603F, 0, "H") == 0x8611
    axis.put(0x6040, 0, 0, "H")
    axis.put(0x6040, 0, Command.FAULT_RESET, "H")
    assert axis.state is State.SWITCH_ON_DISABLED


def test_software_limits_and_switches_show_and_stop(axis: Axis) -> None:
    start = axis.enable(1)
    axis.put(0x607D, 1, start - TURN, "i")
    axis.put(0x607D, 2, start + TURN // 4, "i")
    axis.go(start + TURN)
    axis.wait(1.0)
    assert axis.number(0x6062) == start + TURN // 4 and axis.status & Status.INTERNAL_LIMIT
    simulation = axis.bus.line.nodes[0].core.simulation
    simulation.library.pmsm_sim_set_switches(simulation.sim, -1.0, 100.0)
    axis.go(start - TURN)
    axis.wait(1.5)
    assert axis.number(0x60FD, 0, "I") == 1 and axis.status & Status.INTERNAL_LIMIT
    assert not axis.status & Status.TARGET_REACHED and start - TURN < axis.number(0x6062) < start
    axis.go(start)
    axis.wait(1.5)
    assert axis.number(0x6062) == start and axis.status & Status.TARGET_REACHED


def home(axis: Axis, method: int, seconds: float) -> Status:
    """Home by a method; return what the statusword says after a time."""
    axis.put(0x6098, 0, method, "b")
    axis.control(Control.NEW_SET_POINT)
    assert not axis.status & Status.HOMING_ATTAINED
    axis.wait(seconds)
    return axis.status


def test_homing_where_it_is_sets_the_position_and_moves_nothing(axis: Axis) -> None:
    axis.enable(6)
    axis.put(0x607C, 0, 1000, "i")
    assert home(axis, 37, 0.3) & Status.HOMING_ATTAINED
    assert axis.number(0x6064) == pytest.approx(-1000, abs=20)
    axis.control()
    axis.put(0x6060, 0, 1, "b")
    axis.go(TURN)
    axis.wait(1.5)
    assert axis.number(0x6064) == pytest.approx(TURN, abs=100)


@pytest.mark.parametrize(("method", "direction"), [(33, -1), (34, 1)])
def test_homing_by_the_index_finds_the_encoders_zero(axis: Axis, method: int, direction: int) -> None:
    raw = axis.enable(6)
    axis.put(0x6099, 2, TURN // 2)
    assert home(axis, method, 3.0) & Status.HOMING_ATTAINED
    index = (raw // TURN + (direction > 0)) * TURN
    simulation = axis.bus.line.nodes[0].core.simulation
    assert simulation.position.asked.offset == -index
    ramp, jerk = axis.number(0x609A, 0, "I"), axis.number(0x60A4, 1, "I")
    way = (TURN // 2) ** 2 / (2 * ramp) + 0.5 * (TURN // 2) * ramp / jerk  # of coming to rest, behind the index
    assert direction * axis.number(0x6064) == pytest.approx(way, rel=0.05)  # measured 0.98


@pytest.mark.parametrize(("method", "direction"), [(17, -1), (18, 1)])
def test_homing_by_a_limit_switch_ends_where_it_opens(axis: Axis, method: int, direction: int) -> None:
    raw = axis.enable(6)
    axis.put(0x6099, 1, TURN)
    simulation = axis.bus.line.nodes[0].core.simulation
    at = 1.5  # rad
    simulation.library.pmsm_sim_set_switches(simulation.sim, -at, at)
    status = home(axis, method, 5.0)
    assert status & Status.HOMING_ATTAINED and not status & Status.INTERNAL_LIMIT
    expected = direction * at / 6.283185307 * TURN + raw  # the shaft began at angle 0
    assert -simulation.position.asked.offset == pytest.approx(expected, abs=0.01 * TURN)


@pytest.mark.parametrize(("method", "direction"), [(-1, -1), (-2, 1)])
def test_homing_by_a_stop_ends_when_the_torque_stays(axis: Axis, method: int, direction: int) -> None:
    raw = axis.enable(6)
    axis.put(0x2053, 0, 100, "H")
    assert not home(axis, method, 0.5) & Status.HOMING_ATTAINED
    simulation = axis.bus.line.nodes[0].core.simulation
    moved = axis.number(0x6064) - raw
    assert moved * direction > TURN // 8
    simulation.library.pmsm_sim_set_rotor(simulation.sim, 1, 0.0)
    axis.wait(2.0)
    assert axis.status & Status.HOMING_ATTAINED and abs(axis.number(0x6064)) < 20


def test_a_stop_that_is_a_limit_switch_is_a_homing_error(axis: Axis) -> None:
    axis.enable(6)
    simulation = axis.bus.line.nodes[0].core.simulation
    simulation.library.pmsm_sim_set_switches(simulation.sim, -1.0, 100.0)
    axis.put(0x2053, 0, 900, "H")
    status = home(axis, -1, 3.0)
    assert status & Status.HOMING_ERROR and status & Status.TARGET_REACHED and not status & Status.HOMING_ATTAINED


def test_a_homing_is_interrupted_and_unknown_methods_are_refused(axis: Axis) -> None:
    axis.enable(6)
    home(axis, 18, 0.4)
    assert abs(axis.number(0x606C)) > 5_000
    axis.control()
    axis.wait(0.5)
    assert abs(axis.number(0x606C)) < 2_000 and not axis.status & Status.HOMING_ATTAINED
    axis.control(Control.NEW_SET_POINT, Control.HALT)
    assert not axis.number(0x606C) > 5_000 and axis.status & Status.TARGET_REACHED
    for method in (0, 1, 19, 36, -3):
        with pytest.raises(Aborted):
            axis.put(0x6098, 0, method, "b")


@pytest.mark.parametrize(("start_rad", "active"), [(0.0, 0), (0.4, 2), (-0.6, 1)])
def test_limit_switches_of_the_machine_file(start_rad: float, active: int) -> None:
    base = load_machine_file("jercic-2017")
    settings = {"theta_M_start_rad": start_rad, "limit_switch_negative_rad": -0.5, "limit_switch_positive_rad": 0.3}
    core = KernelCore(replace(base, simulation={**base.simulation, **settings}), 1)
    core.run(3)
    assert core.position().limits == active
