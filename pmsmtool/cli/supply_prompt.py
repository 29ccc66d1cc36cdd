# SPDX-License-Identifier: MIT
"""The readings of a bench supply: typed by a person while a current flows, or the simulated supply's."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from pmsmtool.cli.consent import person_present
from pmsmtool.errors import Declined

if TYPE_CHECKING:
    from pmsmtool.bus.connection import Connection
    from pmsmtool.experiments.supply_levels import ReadSupply


def supply_reader(connection: Connection, node: int, *, simulated: bool) -> ReadSupply:
    """Return what reads the supply that feeds a drive.

    Parameters
    ----------
    simulated : bool
        The drive is simulated in this process, and its supply with it.

    Raises
    ------
    Declined
        Nobody can be asked; nothing was moved.
    """
    if simulated:
        return lambda i_a: connection.bus.read_supply(node)  # type: ignore[attr-defined]
    if not person_present():
        raise Declined(
            "no terminal to ask what the bench supply shows: nothing was done",
            likely="standard input or standard error is not a terminal",
            hint="run it in a terminal, or leave --supply out",
        )
    return _ask


def _ask(i_a: float) -> tuple[float, float]:
    """Ask a person for voltage (V) and current (A) while ``i_a`` (A peak) flows."""
    click.echo(f"{i_a:.4g} Apk in the machine: what does the bench supply show?", err=True)
    shown = [click.prompt(f"  {what}", type=click.FloatRange(min=0.0), err=True) for what in ("volts", "amperes")]
    return shown[0], shown[1]
