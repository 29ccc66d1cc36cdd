# SPDX-License-Identifier: MIT
"""Order of the wires and alignment of three Hall sensors, from a rotor that a current vector turned both ways.

A wire is high for half an electrical turn. The middle of that half is found from its edges; friction keeps the rotor
behind the vector, by as much one way as the other. The fit: three middles are an offset plus a third of a turn each in
some order, and what is left is how the sensors are placed. A turn of all three by 120 degrees looks like two exchanges
of wires, so the order is the one whose offset is least; 60 degrees of offset are the limit.
"""

from __future__ import annotations

import cmath
import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.machine.parameters import HALL_ORDERS, HALL_SECTOR_RAD, PHASES, hall_axis
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

STAGE = "Hall sensors"

SPACED_60 = (0, 7)
"""Patterns that sensors a third of a turn apart never show."""
WRONGLY_SPACED = 0.02
"""Largest share of them: edges of two wires that almost coincide are seen in another order for a step."""
ENGAGED_RAD = math.radians(90.0)
"""Way behind which friction is taken up."""
EDGES = 2
"""Edges of a wire in a turn."""
SWING_RAD = math.radians(20.0)
"""Changes of a wire that are nearer to one another are one edge."""
INDEPENDENT = 3
"""Of the twelve edges, how many have errors of their own: cogging and the inverter repeat over the turn."""
LARGEST_ERROR_RAD = 0.5 * HALL_SECTOR_RAD
"""Placement error beyond which the order is not decided (5 to 15 degrees are usual)."""


@dataclass(frozen=True, slots=True)
class HallAlignment:
    """Three Hall sensors as they are wired and placed; electrical angles (rad)."""

    order: str
    """Phase whose sensor is on wires 1, 2, 3; ``abc`` is right."""
    offset_rad: float
    """By which all are turned against the phases."""
    offset_half_rad: float
    """Half of its 95 % interval."""
    errors_rad: tuple[float, float, float]
    """Placement error of the sensors of phases a, b, c; they add up to 0."""
    lag_rad: float
    """Of the rotor behind the vector."""

    @property
    def wiring(self) -> str:
        """What is to be done to the wires, in words; empty where they are right."""
        wrong = [k for k in range(3) if self.order[k] != PHASES[k]]
        if len(wrong) == 2:
            return f"Hall wires {wrong[0] + 1} and {wrong[1] + 1} are swapped"
        return f"Hall wires 1, 2, 3 carry the sensors of phases {', '.join(self.order)}" if wrong else ""

    @property
    def axes_rad(self) -> tuple[float, ...]:
        """Middle of the high half of wires 1, 2, 3: what ``hall.axis_1_rad`` and so on hold."""
        by_phase = dict(zip(PHASES, self.errors_rad, strict=True))
        return tuple(math.remainder(self.offset_rad + hall_axis(x) + by_phase[x], 2.0 * math.pi) for x in self.order)

    def sectors(self) -> dict[int, float]:
        """Return the middle of the angle in which the wires show each pattern, as they are wired (rad)."""
        axes = self.axes_rad
        quarter, turn = 0.5 * math.pi, 2.0 * math.pi
        edges = sorted(math.remainder(axis + side, turn) for axis in axes for side in (-quarter, quarter))
        middles = [0.5 * (low + high) for low, high in itertools.pairwise([*edges, edges[0] + turn])]
        return {
            sum((math.cos(middle - axis) >= 0.0) << k for k, axis in enumerate(axes)): math.remainder(middle, turn)
            for middle in middles
        }


def hall_alignment(trace: Trace) -> HallAlignment:
    """Return how three Hall sensors are wired and placed.

    Raises IdentificationError: E_HALL: a wire does not change, the sensors are spaced by 60 degrees, or their errors
    hide the order.

    Parameters
    ----------
    trace : Trace
        ``commanded_rad`` and ``angle_rad``: electrical angle of the current vector, a turn and more each way;
        ``hall_pattern``: bit k is wire k + 1.
    """
    angle, pattern = trace["angle_rad"], np.asarray(trace["hall_pattern"], dtype=np.int64)
    for k in range(3):
        if np.ptp(pattern >> k & 1) == 0:
            raise refuse("E_HALL", f"wire {k + 1} does not change over a turn", stage=STAGE)
    if np.isin(pattern, SPACED_60).mean() > WRONGLY_SPACED:
        what = "all wires are high, or all low, over a part of the turn: sensors 60 degrees apart"
        raise refuse("E_HALL", what, stage=STAGE)
    commanded = trace["commanded_rad"]
    found = [_middle(commanded, angle, pattern >> k & 1, k) for k in range(3)]
    middles, lag = [middle for middle, _, _ in found], float(np.mean([late for _, late, _ in found]))
    tried = ((order, _offset(middles, order)) for order in HALL_ORDERS)
    order, offset = min(tried, key=lambda one: _cost(middles, *one))
    errors = {
        phase: math.remainder(middles[k] - hall_axis(phase) - offset, 2.0 * math.pi) for k, phase in enumerate(order)
    }
    worst = math.degrees(max(map(abs, errors.values())))
    if worst > math.degrees(LARGEST_ERROR_RAD):
        raise refuse("E_HALL", f"placement errors up to {worst:.3g} degrees", stage=STAGE)
    scatter = np.array([one for _, _, edges in found for one in edges])
    step = float(np.median(np.abs(np.diff(commanded)))) / math.sqrt(12.0)
    half = 2.0 * max(float(np.sqrt(np.mean(scatter**2))), step) / math.sqrt(INDEPENDENT)
    return HallAlignment(order, offset, half, (errors["a"], errors["b"], errors["c"]), lag)


def _offset(middles: list[float], order: str) -> float:
    return cmath.phase(sum(cmath.rect(1.0, middle - hall_axis(x)) for middle, x in zip(middles, order, strict=True)))


def _cost(middles: list[float], order: str, offset: float) -> tuple[bool, float]:
    """Order orders: those that turn the right way round first, of these the one that is turned least."""
    left = [math.remainder(m - hall_axis(x) - offset, 2.0 * math.pi) for m, x in zip(middles, order, strict=True)]
    return max(map(abs, left)) > LARGEST_ERROR_RAD, abs(offset)


def _middle(commanded: Array, angle: Array, level: NDArray[np.int64], wire: int) -> tuple[float, float, list[float]]:
    """Return the middle of a wire's high half, by how much the rotor was late, and how its edges scatter (rad)."""
    moved, changed = np.diff(commanded), np.diff(level)
    between = 0.5 * (angle[:-1] + angle[1:])
    sides, scatter = [], []
    for way in (1.0, -1.0):
        towards = way * commanded
        gone = towards - np.minimum.accumulate(towards)
        at = np.flatnonzero((changed != 0) & (moved * way > 0.0) & (gone[1:] > ENGAGED_RAD))
        edges = _edges(between[at], changed[at])
        if len(edges) < EDGES:
            raise refuse("E_HALL", f"wire {wire + 1} has fewer than {EDGES} edges in a turn", stage=STAGE)
        middles = [edge + 0.5 * math.pi * way * rise for edge, rise in edges]
        sides.append(cmath.phase(sum(cmath.rect(1.0, middle) for middle in middles)))
        scatter += [math.remainder(middle - sides[-1], 2.0 * math.pi) for middle in middles]
    late = 0.5 * math.remainder(sides[0] - sides[1], 2.0 * math.pi)
    return math.remainder(sides[1] + late, 2.0 * math.pi), late, scatter


def _edges(angle: Array, rise: NDArray[np.int64]) -> list[tuple[float, int]]:
    """Return where a wire changes, and which way: a rotor that swings over an edge passes it three times and more."""
    edges: list[tuple[float, int]] = []
    bounds = np.flatnonzero(np.abs(np.diff(angle)) > SWING_RAD) + 1
    for passed, ways in zip(np.split(angle, bounds), np.split(rise, bounds), strict=True):
        net = int(ways.sum())
        if net:
            edges.append((float(passed @ ways) / net, net))
    return edges
