# SPDX-License-Identifier: MIT
"""A move by the position loop of a simulated drive, recorded as the drive itself records it."""

from __future__ import annotations

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.proof.plan import Experiment
from pmsmtool.sim.kernel import Part, Signal, Simulation
from pmsmtool.sim.node.drive_core import ControlMode, RecorderState, Trigger

_SIGNALS = {
    "following_error_rad": Signal.FOLLOWING_ERROR, "omega_e_rad_s": Signal.OMEGA_E, "i_q_a": Signal.I_Q,
}  # fmt: skip
HELD_S = 0.02
"""Time for which the shaft, at rest from the beginning, is held: current loops and estimates settle."""
AWAITED_STEPS = 4
"""Steps of the speed loop within which a move has begun (measured: 1)."""


def hold(
    simulation: Simulation, experiment: Experiment, increments: int, T_s: float, phase: int, held_nm: float,
    weakened_a: float = 0.0,
) -> None:  # fmt: skip
    """Let the position loop hold the shaft where it is, ready for the move of an experiment.

    The torque that the loop holds against friction is what stopped the shaft before: any within the Coulomb torque.

    Parameters
    ----------
    increments : int
        Of the position in a turn.
    T_s : float
        Control period (s).
    phase : int
        Control periods more than the drive holds.
    held_nm : float
        Torque that is held (N m).
    weakened_a : float
        d current that field weakening has from before (A).
    """
    assert experiment.move is not None
    asked = simulation.position.asked
    asked.increments, asked.profile = increments, 1
    asked.velocity, asked.jerk = experiment.move.velocity, experiment.move.jerk
    asked.acceleration = asked.deceleration = asked.stop_deceleration = experiment.move.acceleration
    simulation.params.position_velocity_ff *= experiment.velocity_ff
    simulation.reference.mode = ControlMode.POSITION
    simulation.word(Part.ENABLED).value = 1
    simulation.run(1)  # the first period clears the controllers
    simulation.floats_at(Part.SPEED_INTEGRAL, 1)[0] = held_nm
    weaken(simulation, weakened_a)
    simulation.run(phase + round(HELD_S / T_s))


def weaken(simulation: Simulation, i_d_a: float) -> None:
    """Let field weakening have a d current (A) from before, once the search has ended that it began with."""
    if i_d_a:
        simulation.run(simulation.params.field_weakening_iterations)
        simulation.floats_at(Part.FIELD_WEAKENING, 1)[0] = i_d_a


def record_move(simulation: Simulation, experiment: Experiment) -> Array:
    """Move, and return the record from the begin of the move on, shape (rows, signals)."""
    assert experiment.move is not None
    recorder, position = simulation.recorder, simulation.position
    rows, width = experiment.rows, len(experiment.signals)
    recorder.channel[:] = [*(_SIGNALS[name] for name in experiment.signals), *[Signal.NONE] * (8 - width)]
    recorder.decimation, recorder.depth, recorder.pretrigger = experiment.decimation, rows, 0
    recorder.trigger, recorder.command = Trigger.MOVE_START, 1
    position.asked.target = (position.reference + experiment.move.way + 2**31) % 2**32 - 2**31
    position.asked.set_point += 1
    steps = rows * experiment.decimation + AWAITED_STEPS * simulation.params.speed_decimation
    simulation.run(int(steps))
    if recorder.state != RecorderState.COMPLETE:  # it tripped, or fell out of step: nothing of it is a response
        return np.full((rows, width), np.nan)
    return np.array(simulation.floats_at(Part.TRACE, rows * width), dtype=np.float64).reshape(rows, width)
