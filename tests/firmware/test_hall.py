# SPDX-License-Identifier: MIT
"""Commutation by Hall sensors: the start before the index, Hall sensors alone, six steps."""

from __future__ import annotations

import functools
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pmsmtool
from pmsmtool.design.tune import tune
from pmsmtool.firmware.image import pack_image
from pmsmtool.identification.hall import HallAlignment
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.machine.parameters import HALL_ORDERS, HallCommutation
from pmsmtool.sim.closed_loop import drive_values
from pmsmtool.sim.kernel import Part, Signal, Simulation, Truth
from pmsmtool.sim.node.drive_core import ControlMode, HomingPhase
from pmsmtool.sim.simulated_machine import build_setup

NONE, START, ALONE, STEPS = range(4)
MACHINE = load_machine_file("jercic-2017")
P = 4
ERRORS = {f"hall_error_{phase}_rad": math.radians(error) for phase, error in zip("abc", (9.0, -12.0, 7.0), strict=True)}
TURN_RAD = 0.3
COUNTS = 4096
SLOW = {"speed.K_p_nms_per_rad": 0.3, "speed.K_i_nm_per_rad": 0.09}
"""Of the speed controller that is tuned for an encoder."""


@functools.cache
def tuned() -> dict[str, float]:
    """Parameters of the design of the machine."""
    return dict(drive_values(MACHINE, tune(MACHINE).parameter_set()))


def axes(order: str) -> dict[str, float]:
    """Parameters of the misplaced sensors."""
    alignment = HallAlignment(order, TURN_RAD, 0.0, tuple(ERRORS.values()), 0.0)  # type: ignore[arg-type]
    return {f"hall.axis_{k}_rad": axis for k, axis in enumerate(alignment.axes_rad, 1)}


def drive(
    commutation: int, mode: ControlMode, *, kind: str = "none", theta_M: float = 0.0, order: str = "abc",
    changes: dict[str, float] | None = None, **settings: Value,
) -> Simulation:  # fmt: skip
    """Return an enabled drive with misplaced Hall sensors, whose places it knows."""
    told: dict[str, Value] = {"encoder_kind": kind, "hall_order": order, "hall_offset_rad": TURN_RAD, **ERRORS}
    setup, keep = build_setup(replace(MACHINE, simulation={**MACHINE.simulation, **told, **settings}), seed=1)
    setup.theta_M = theta_M
    values = tuned() | axes(order) | {"hall.commutation": commutation} | (changes or {})
    if kind == "none":
        values["encoder.offset_rad"] = 0.0
    simulation = Simulation(setup, pack_image(values), keep)
    simulation.reference.mode = mode
    simulation.position.asked.increments = COUNTS
    simulation.word(Part.ENABLED).value = 1
    return simulation


def angle_error(rows: np.ndarray) -> np.ndarray:
    """Degrees, of (seen, true) electrical angles."""
    return np.degrees(np.angle(np.exp(1j * (rows[:, 0] - rows[:, 1]))))


ANGLES = (Signal.THETA_E, Truth.THETA_E, Truth.I_Q, Truth.OMEGA_M, Signal.OMEGA_E)
STARTS = np.linspace(0.0, 2 * math.pi / P, 25)


@pytest.mark.chain
@pytest.mark.parametrize(
    ("commutation", "kind", "least", "furthest"),
    [(START, "index", 0.77, 30.8), (ALONE, "none", 0.51, 40.6), (STEPS, "none", 0.43, 40.6)],
)
def test_a_rotor_starts_from_every_angle(commutation: int, kind: str, least: float, furthest: float) -> None:
    """The least share of the q current, and the largest error of the angle (degree), are those measured."""
    shares, errors = [], []
    for theta in STARTS:
        for way in (10.0, -10.0):
            simulation = drive(commutation, ControlMode.CURRENT, kind=kind, theta_M=theta, order="bca")
            simulation.reference.i_q_ref = way
            rows = simulation.record(ANGLES, 600)
            simulation.run(600)
            shares.append((rows[36:, 2] / way).min())  # the current has risen
            errors.append(np.abs(angle_error(rows)).max())
            assert way * rows[-1, 3] > 0.0 and not simulation.word(Part.TRIP).value
    assert min(shares) > least and max(errors) < furthest


@pytest.mark.chain
def test_at_the_index_the_encoder_takes_over_and_nothing_jumps() -> None:
    simulation = drive(START, ControlMode.CURRENT, kind="index", theta_M=0.4)
    simulation.reference.i_q_ref = 3.0
    rows = simulation.record(ANGLES, 9000)
    simulation.run(1)
    positions = []
    for _ in range(8999):
        simulation.run(1)
        positions.append(simulation.position.actual)
    error, speed = angle_error(rows), rows[:, 4] / P - rows[:, 3]
    first = int(np.flatnonzero(np.abs(error) > 0.1)[-1]) + 1  # measured 0.006 afterwards
    assert 1000 < first < 8000 and np.abs(error[:first]).max() > 1.0
    assert np.abs(speed[first - 5 : first + 500]).max() < 0.5  # rad/s; measured 0.40, 0.33 of it before
    assert abs(np.diff(positions, 2)).max() <= 3, "the position goes on"


@pytest.mark.chain
def test_homing_by_an_index_that_was_never_passed() -> None:
    simulation = drive(START, ControlMode.POSITION, kind="index", theta_M=0.4, hall_order="abc")
    asked = simulation.position.asked
    asked.velocity, asked.acceleration, asked.deceleration = 2048.0, 80000.0, 80000.0
    asked.homing.active, asked.homing.method, asked.homing.slow = 1, 34, 2048.0
    simulation.run(30)
    asked.homing.start = 1
    for _ in range(3000):
        if simulation.position.homing == HomingPhase.DONE:
            break
        simulation.run(20)
    assert simulation.position.homing == HomingPhase.DONE
    simulation.run(6000)
    truth = simulation.signal(Truth.THETA_M) + tuned()["encoder.offset_rad"] / P
    assert abs(simulation.position.actual - truth / (2 * math.pi) * COUNTS % COUNTS) < 2.0


@pytest.mark.chain
@pytest.mark.parametrize("order", HALL_ORDERS)
def test_hall_sensors_alone_hold_a_speed_both_ways_and_count(order: str) -> None:
    simulation = drive(ALONE, ControlMode.SPEED, order=order, changes={n: x * tuned()[n] for n, x in SLOW.items()})
    turned = 0.0
    for omega in (-30.0, 20.0):
        simulation.reference.omega_M_ref = omega
        every = simulation.record(ANGLES, 18000)
        simulation.run(18000)
        turned += every[:, 3].sum() * 1e-9 * tuned()["inverter.T_s_ns"]
        rows = every[12000:]
        assert rows[:, 3].mean() == pytest.approx(omega, abs=0.05) and rows[:, 3].std() < 0.1  # measured 0.02, 0.053
        assert np.abs(angle_error(rows)).max() < 4.0  # measured 2.6
    seen = simulation.position.actual / COUNTS * 2 * math.pi
    assert turned < -2.0 * math.pi and abs(seen - turned) < math.pi / 3 / P, "within a sector, over whole turns"
    assert not simulation.word(Part.TRIP).value


@pytest.mark.chain
@pytest.mark.parametrize("omega", [5.0, -20.0])
def test_six_steps_let_current_through_two_phases(omega: float) -> None:
    told: dict[str, Value] = dict.fromkeys((*ERRORS, "hall_offset_rad"), 0.0)
    values = {f"hall.axis_{k + 1}_rad": 2.0 * math.pi / 3.0 * k for k in range(3)}
    simulation = drive(STEPS, ControlMode.CURRENT, changes=values, rotor="driven", **told)
    simulation.setup.omega_M = omega
    simulation.library.pmsm_sim_set_rotor(simulation.sim, 2, omega)
    simulation.run(6000)
    simulation.reference.i_q_ref = 10.0
    simulation.run(3000)
    rows = simulation.record((Signal.THETA_E, Truth.I_Q, Truth.I_A), 12000)
    simulation.run(12000)
    steps = np.degrees(rows[:, 0]) / 60.0
    assert np.abs(steps - np.round(steps)).max() < 1e-3 and len({round(step) % 6 for step in steps}) == 6
    assert rows[:, 1].mean() == pytest.approx(10.0 * 3.0 / math.pi, rel=0.04)  # measured 0.01 % at 5, 3.0 % at 20 rad/s
    assert np.abs(rows[:, 2]).max() < 10.0 * math.cos(math.pi / 6) * 1.2  # measured 1.18 where the steps are
    assert 0.25 < np.mean(np.abs(rows[:, 2]) < 1.0) < 0.4, "an idle phase a third of the time"


def patterns(order: str) -> list[tuple[int, float]]:
    """Pattern and middle of the six sectors, upwards, by the arithmetic of the identification."""
    alignment = HallAlignment(order, TURN_RAD, 0.0, tuple(ERRORS.values()), 0.0)  # type: ignore[arg-type]
    return sorted(alignment.sectors().items(), key=lambda one: one[1])


def shown(simulation: Simulation, pattern: int) -> float:
    """Return the angle of a period in which the wires are held at a pattern."""
    axis = simulation.setup.sensors.hall_axis
    for k in range(3):  # a sensor whose middle is here is high, one whose middle is opposite is low
        axis[k] = P * simulation.signal(Truth.THETA_M) + (0.0 if pattern >> k & 1 else math.pi)
    _hand_over(simulation)
    simulation.run(1)
    return simulation.signal(Signal.THETA_E)


def _hand_over(simulation: Simulation) -> None:
    """The simulation copies its setup when it starts: it lies first in its memory."""
    setup: Any = type(simulation.setup).from_address(simulation.sim)
    setup.sensors.hall_axis[:] = simulation.setup.sensors.hall_axis[:]


@pytest.mark.parametrize("order", HALL_ORDERS)
def test_the_sectors_are_those_of_the_identification(order: str) -> None:
    simulation = drive(STEPS, ControlMode.CURRENT, order=order, rotor="locked")
    for pattern, middle in patterns(order):
        assert math.remainder(shown(simulation, pattern) - middle, 2 * math.pi) == pytest.approx(0.0, abs=1e-5)


def test_an_edge_that_is_passed_back_tells_no_speed() -> None:
    simulation = drive(ALONE, ControlMode.CURRENT, rotor="locked")
    there, next_up, beyond = (pattern for pattern, _ in patterns("abc")[1:4])
    for pattern, moves in ((there, 0.0), (next_up, 0.0), (there, 0.0), (next_up, 0.0), (beyond, 1.0)):
        simulation.run(200)
        shown(simulation, pattern)
        simulation.run(100)
        assert (abs(simulation.signal(Signal.OMEGA_E)) > 1.0) == bool(moves)


def test_a_wire_that_fails_trips_and_one_bad_period_does_not() -> None:
    simulation = drive(ALONE, ControlMode.CURRENT, rotor="locked")
    simulation.run(10)
    for pattern in (0, 7):
        shown(simulation, pattern)
        assert not simulation.word(Part.TRIP).value
        shown(simulation, 1)
    shown(simulation, 7)
    shown(simulation, 7)
    assert simulation.word(Part.TRIP).value == 0x7305


def test_without_encoder_and_without_commutation_there_is_no_angle() -> None:
    simulation = drive(NONE, ControlMode.CURRENT)
    simulation.run(3)
    assert simulation.word(Part.TRIP).value == 0x7305


def test_a_speed_fades_where_the_next_edge_stays_away() -> None:
    simulation = drive(ALONE, ControlMode.CURRENT, rotor="driven")
    simulation.library.pmsm_sim_set_rotor(simulation.sim, 2, 20.0)
    simulation.run(6000)
    assert simulation.signal(Signal.OMEGA_E) == pytest.approx(20.0 * P, rel=0.01)
    simulation.library.pmsm_sim_set_rotor(simulation.sim, 1, 0.0)
    took = math.pi / 3 / P / 20.0 * 1e9 / tuned()["inverter.T_s_ns"]  # periods of a sector
    simulation.run(round(11 * took))
    assert 0.0 < simulation.signal(Signal.OMEGA_E) < 0.11 * 20.0 * P
    middle = min(
        (m for _, m in patterns("abc")),
        key=lambda m: abs(math.remainder(m - P * simulation.signal(Truth.THETA_M), 2 * math.pi)),
    )
    assert abs(math.remainder(simulation.signal(Signal.THETA_E) - middle, 2 * math.pi)) < math.radians(
        4.0
    )  # measured 2.8


def test_the_kinds_of_commutation_are_those_of_the_header() -> None:
    header = (Path(pmsmtool.__file__).parent / "firmware/application/pmsm_application.h").read_text(encoding="utf-8")
    declared = re.search(r"enum pmsm_hall_commutation \{(.*?)\}", header, re.DOTALL)
    assert declared is not None
    names = re.findall(r"PMSM_HALL_(\w+)", declared[1])
    assert names == [kind.name for kind in HallCommutation] and list(HallCommutation) == list(range(len(names)))
