# SPDX-License-Identifier: MIT
"""A drive that refuses because it is busy is asked again, until it takes what is asked or a time is over."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from pmsmtool.bus.abort_codes import BUSY_CODES
from pmsmtool.bus.connection import Connection
from pmsmtool.errors import DriveFault, SdoAbort

Done = TypeVar("Done")
BUSY_POLL_S = 0.05
"""A busy drive is asked again so often."""


def is_busy(fault: DriveFault) -> bool:
    """Whether a drive refuses for now: it stores, starts, or is asked too much."""
    return isinstance(fault, SdoAbort) and fault.code in BUSY_CODES


def when_ready(
    connection: Connection,
    work: Callable[[], Done],
    within_s: float,
    *,
    busy: Callable[[DriveFault], bool] = is_busy,
    meanwhile: Callable[[], None] = lambda: None,
) -> Done:
    """Do something, again as long as the drive is busy; return what it gives.

    Raises DriveFault: any that does not pass, or did not in the time.

    Parameters
    ----------
    work : callable
        May have been done in part before it is called again.
    within_s : float
        Time (s, bus clock) from which on the refusal is final.
    busy : callable, optional
        Which faults pass.
    meanwhile : callable, optional
        Done after every such fault.
    """
    clock = connection.clock
    until = clock.now() + within_s
    while True:
        try:
            return work()
        except DriveFault as fault:
            if not busy(fault) or clock.now() >= until:
                raise
        meanwhile()
        connection.wait(BUSY_POLL_S)
