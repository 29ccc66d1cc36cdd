# SPDX-License-Identifier: MIT
"""Hold a current vector at several lengths while a person reads the bench supply: copper loss of a resting rotor."""

from __future__ import annotations

from collections.abc import Callable

from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.standard_drive import StandardDrive
from pmsmtool.experiments.signals import table
from pmsmtool.experiments.vector_turn import lead_onto_vector
from pmsmtool.trace import Trace

LEVELS = (0.0, 0.5, 1.0, 0.25, 0.75, 1.0, 0.5, 0.0)
"""Currents, of the largest one: up and down, so that what warms up meanwhile shows as scatter."""
SETTLE_S = 0.5
"""Time from a command to its reading."""
ReadSupply = Callable[[float], tuple[float, float]]
"""Given the current that flows (A peak), returns voltage (V) and current (A) of the supply."""


def hold_supply_levels(
    drive: StandardDrive, envelope: Envelope, i_a: float, read: ReadSupply, say: Callable[[str], None]
) -> Trace:
    """Return the readings, one row per level; the drive is off on return.

    Raises StopNotConfirmed, Interrupted, BusError, DriveFault, LimitExceeded: as the guard ends the experiment.

    Parameters
    ----------
    i_a : float
        Largest length of the vector (A peak).
    read : ReadSupply
        Asks the person, or a simulated supply.

    Returns
    -------
    Trace
        ``i_command_a``, ``supply_v``, ``supply_i_a``.
    """
    rows: list[dict[str, float]] = []
    times: list[float] = []
    elapsed_s, led = 0.0, False
    with guarded(drive, envelope, say=say) as guard:
        guard.enable()
        say(f"R: the power of the bench supply, read {len(LEVELS)} times up to {i_a:.3g} A")
        for share in LEVELS:
            if share and not led:
                lead_onto_vector(guard, share * i_a, 0.0)
                led = True
            guard.command_current(share * i_a, 0.0, fixed_angle_rad=0.0)
            guard.wait(SETTLE_S)
            elapsed_s += SETTLE_S
            volts, amps = read(share * i_a)
            rows.append({"i_command_a": share * i_a, "supply_v": volts, "supply_i_a": amps})
            times.append(elapsed_s)
        guard.command_current(0.0, 0.0, fixed_angle_rad=0.0)
    return table(rows, times)
