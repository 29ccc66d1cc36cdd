# SPDX-License-Identifier: MIT
"""R of a drive that shows no voltage: a current vector is held while a person reads the power of the bench supply."""

from __future__ import annotations

from collections.abc import Callable

from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.standard_drive import StandardDrive
from pmsmtool.experiments.supply_levels import LEVELS, ReadSupply, hold_supply_levels
from pmsmtool.identification.tier_evaluate import SUPPLY_LEVELS
from pmsmtool.trace import Trace


def hold_for_supply(
    drive: StandardDrive,
    envelope: Envelope,
    i_a: float,
    read_supply: ReadSupply,
    keep: Callable[[str, Trace], None],
    say: Callable[[str], None],
) -> None:
    """Hold currents up to ``i_a`` (A peak) and keep what is read; the drive is off on return.

    Raises
    ------
    StopNotConfirmed, Interrupted, BusError, DriveFault, LimitExceeded
        As the guard ends the experiment.
    """
    with guarded(drive, envelope, say=say) as guard:
        guard.enable()
        say(f"R: the power of the bench supply, read {len(LEVELS)} times up to {i_a:.3g} A")
        keep(SUPPLY_LEVELS, hold_supply_levels(guard, i_a, read_supply))
