# SPDX-License-Identifier: MIT
"""The speed that a drive shows in a stated unit, against the slope of its position: one may be counted wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.motion_objects import shown_speed

AGREE, STANDS_STILL = (0.6, 1.6), 0.01
"""Least and largest of the one over the other: one is filtered and read later. Wrong units differ by 2, 4 and more.
What shows nothing while the shaft turns is no unit."""
ROWS, LEAST_ROWS, LONGEST_S = 16, 5, 0.05
"""Positions before a look whose slope is taken, the fewest, and the time within which they lie."""
LEAST_LOOKS, FAST_SHARE = 4, 0.3
"""Looks that are needed at more than this share of the largest speed."""


class ComparedSpeed:
    """Notes both speeds while a drive moves.

    Parameters
    ----------
    node : DriveNode
        The drive.
    counts_per_turn : float
        Units of position per turn that its angles are made with.
    """

    def __init__(self, node: DriveNode, counts_per_turn: float) -> None:
        self._node, self._counts_per_turn = node, abs(counts_per_turn)
        self._item = shown_speed(node)
        self._pairs: list[tuple[float, float]] = []

    def look(self, rows: Sequence[Sequence[float]]) -> None:
        """Note the speed that is shown now, and that of the rows (time in s, angle in rad, ...) before."""
        clock = self._node.connection.clock
        recent = [row[:2] for row in rows[-ROWS:] if row[0] > clock.now() - LONGEST_S]
        if self._item is None or len(recent) < LEAST_ROWS:
            return
        began = clock.now()
        shown = self._item.per_count * self._node.get(self._item.item)
        t, angle = np.array(recent).T
        slope = np.polyfit(t - 0.5 * (began + clock.now()), angle, 2)[1]
        self._pairs.append((shown, float(slope)))

    @property
    def doubt(self) -> str:
        """What is said where both contradict each other; empty where they do not, or too little was seen."""
        shown, seen = np.abs(np.array(self._pairs, dtype=np.float64).reshape(-1, 2)).T
        fast = seen > FAST_SHARE * np.max(seen, initial=0.0)
        if np.count_nonzero(fast) < LEAST_LOOKS:
            return ""
        ratio = float(shown[fast] @ seen[fast] / (seen[fast] @ seen[fast]))
        if ratio < STANDS_STILL or AGREE[0] <= ratio <= AGREE[1]:
            return ""
        return (
            f"the drive shows {ratio:.3g} times the speed of its position ({self._item}): one of both has another unit "
            f"than stated. {self._counts_per_turn:.9g} units of position a turn are taken (0x608F, 0x6092, or the map)"
        )
