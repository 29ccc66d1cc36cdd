# SPDX-License-Identifier: MIT
"""Three Hall sensors a third of an electrical turn apart: which phase each wire belongs to, and where it is high."""

from __future__ import annotations

import itertools
import math
from enum import IntEnum

PHASES = "abc"
HALL_ORDERS = tuple("".join(order) for order in itertools.permutations(PHASES))
"""Phase whose sensor is on wires 1, 2 and 3."""
HALL_SECTOR_RAD = math.pi / 3.0
"""Angle over which no wire changes, electrical."""


class HallCommutation(IntEnum):
    """Values of ``hall.commutation``, the enum ``pmsm_hall_commutation`` of the exported C."""

    NONE = 0
    START = 1
    """Until the encoder counts from its index."""
    ALONE = 2
    """In place of an encoder."""
    STEPS = 3
    """The same, in a frame that stands in the middle of the sector: six steps per turn."""


def hall_axis(phase: str) -> float:
    """Return the electrical angle (rad) at the middle of the half turn in which the sensor of a phase is high."""
    return 2.0 * HALL_SECTOR_RAD * PHASES.index(phase)
