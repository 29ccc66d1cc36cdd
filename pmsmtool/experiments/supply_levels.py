# SPDX-License-Identifier: MIT
"""Hold a current vector at several lengths while a person reads the bench supply: copper loss of a resting rotor."""

from __future__ import annotations

from collections.abc import Callable

from pmsmtool.drive.port import Drive
from pmsmtool.experiments.signals import table
from pmsmtool.experiments.vector_lead import lead_onto_vector
from pmsmtool.trace import Trace

LEVELS = (0.0, 0.5, 1.0, 0.25, 0.75, 1.0, 0.5, 0.0)
"""Currents, of the largest one: up and down, so that what warms up meanwhile shows as scatter."""
SETTLE_S = 0.5
"""Time from a command to its reading."""
ReadSupply = Callable[[float], tuple[float, float]]
"""Given the current that flows (A peak), returns voltage (V) and current (A) of the supply."""


def hold_supply_levels(drive: Drive, i_a: float, read: ReadSupply) -> Trace:
    """Return the readings, one row per level; the vector stands where it was, at zero current, on return.

    Parameters
    ----------
    drive : Drive
        Enabled.
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
    for share in LEVELS:
        if share and not led:
            lead_onto_vector(drive, share * i_a, 0.0)
            led = True
        drive.command_current(share * i_a, 0.0, fixed_angle_rad=0.0)
        drive.wait(SETTLE_S)
        elapsed_s += SETTLE_S
        volts, amps = read(share * i_a)
        rows.append({"i_command_a": share * i_a, "supply_v": volts, "supply_i_a": amps})
        times.append(elapsed_s)
    drive.command_current(0.0, 0.0, fixed_angle_rad=0.0)
    return table(rows, times)
