# SPDX-License-Identifier: MIT
"""What a recorded move says: following error, settling, and the current it took."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.trace import Trace

WINDOW = 0.01
"""Window in which the error of a move has settled, of its way."""
RESTING, NEAR, NOISES = 1e-4, 0.01, 3.0
"""Distance from an end of the move within which a demand rests, and within which its noise is looked for, of the way;
and how much of that noise (its upper quartile) still counts as rest."""
SAMPLES = 5
"""Of which the middle one counts: one that is far off ends no rest."""
LEAST_SAMPLES = 50
INSIDE = 20
"""Last samples of a rest that are inside where an error has settled."""
SAME_WAY = 0.01
"""Ways of two moves that are the same (relative)."""
SAME_SPEED = 0.1
"""Mean speeds of their demands that are the same (relative): samples over a bus are some milliseconds apart."""


@dataclass(frozen=True, slots=True)
class MoveResult:
    """One move there and back.

    Attributes
    ----------
    way_rad : float
        Angle of the move (rad).
    error_peak_rad, error_rms_rad : float
        Largest following error, and its root mean square while the demand moves (rad).
    settling_s : float
        Longest time from the end of a demand until the error stays inside 1 % of the way (s); infinity where it does
        not within the record.
    error_end_rad : float
        Largest error left at the end of the record or of a rest (rad).
    current_peak_a, current_rms_a : float
        Of the current while the demand moves, without what flowed at rest before (A).
    moving_s : float
        Time in which the demand moved (s).
    samples : int
        Rows.
    """

    way_rad: float
    error_peak_rad: float
    error_rms_rad: float
    settling_s: float
    error_end_rad: float
    current_peak_a: float
    current_rms_a: float
    moving_s: float
    samples: int


UNITS = {
    "way_rad": "rad", "error_peak_rad": "rad", "error_rms_rad": "rad", "settling_s": "s", "error_end_rad": "rad",
    "current_peak_a": "A", "current_rms_a": "A", "moving_s": "s", "samples": "1",
}  # fmt: skip


def shown(value: float, unit: str) -> str:
    """Return a number of a move as people read it."""
    if math.isinf(value):
        return "not within the record"
    factor, told = {"rad": (math.degrees(1.0), "deg"), "s": (1e3, "ms"), "1": (1.0, "")}.get(unit, (1.0, unit))
    return f"{factor * value:.4g} {told}".strip()


def moving(trace: Trace) -> NDArray[np.bool_]:
    """Return where the demand of moves there and back is at neither end of them, shape (n,).

    A demand that is the sum of position and following error is noisy at rest: a shaft that still swings was seen at
    another instant than its error.
    """
    from scipy.ndimage import median_filter  # only after a move

    demand, way = trace["theta_ref_rad"], float(trace.meta["way_rad"])
    off = np.min(np.abs(demand - demand[0] - np.array([[0.0], [way]])), axis=0)
    off = median_filter(off, SAMPLES, mode="nearest")
    noise = float(np.quantile(off[off < NEAR * abs(way)], 0.75))
    return np.asarray(off > max(RESTING * abs(way), NOISES * noise), dtype=np.bool_)


def move_result(trace: Trace) -> MoveResult:
    """Return what a move says. Raises IdentificationError: too few samples, or the demand did not move.

    Parameters
    ----------
    trace : Trace
        As ``experiments.move.record_move`` leaves it.
    """
    way = abs(float(trace.meta["way_rad"]))
    t, error = trace.t_s, trace["theta_ref_rad"] - trace["theta_m_rad"]
    moves = moving(trace)
    if t.size < LEAST_SAMPLES or not moves.any():
        raise IdentificationError(
            "E_EXCITATION", f"{t.size} samples, in {int(moves.sum())} of which the demand moved",
            likely="the bus is busy, or the drive did not take the set-point",
            hint="leave the bus to this program, then run the command again",
        )  # fmt: skip
    first = int(np.argmax(moves))
    rest = float(np.median(trace["i_q_a"][:first])) if first else 0.0
    current = trace["i_q_a"][moves] - rest
    stops = np.flatnonzero(moves[:-1] & ~moves[1:]) + 1
    ends = [int(k) for k in stops if not moves[k : k + LEAST_SAMPLES].any()]
    spans = [(k, next((int(m) for m in np.flatnonzero(moves[k:]) + k), t.size)) for k in ends]
    return MoveResult(
        way_rad=way,
        error_peak_rad=float(np.max(np.abs(error[first:]))),
        error_rms_rad=float(np.sqrt(np.mean(error[moves] ** 2))),
        settling_s=max((_settled(t[k:m], error[k:m], WINDOW * way) for k, m in spans), default=0.0),
        error_end_rad=max((float(np.mean(np.abs(error[max(k, m - 20) : m]))) for k, m in spans), default=0.0),
        current_peak_a=float(np.max(np.abs(current))),
        current_rms_a=float(np.sqrt(np.mean(current**2))),
        moving_s=float(np.sum(np.diff(t, append=t[-1:])[moves])),
        samples=int(t.size),
    )


def _settled(t: Array, error: Array, window: float) -> float:
    outside = np.flatnonzero(np.abs(error) > window)
    if outside.size and outside[-1] + INSIDE > error.size:
        return math.inf
    return float(t[outside[-1]] - t[0]) if outside.size else 0.0


@dataclass(frozen=True, slots=True)
class MoveDifference:
    """One number of two moves; ``ratio`` is second over first, NaN where the first is 0 or both have no end."""

    name: str
    unit: str
    first: float
    second: float

    @property
    def ratio(self) -> float:
        """Second over first."""
        return self.second / self.first if self.first else float("nan")

    @property
    def shown_ratio(self) -> str:
        """The ratio as people read it."""
        return f"{self.ratio:.3g}" if math.isfinite(self.ratio) and math.isfinite(self.first) else "-"


Rows = Iterable[Mapping[str, Any]]
"""``name``, ``value`` and ``unit`` of what the record of a move keeps."""


def compared_moves(first: MoveResult, second: MoveResult, kept: Sequence[Rows] = ((), ())) -> list[MoveDifference]:
    """Return two moves number by number, then the gains that both drives held, as their records keep them."""
    moves = [
        MoveDifference(name, unit, float(getattr(first, name)), float(getattr(second, name)))
        for name, unit in UNITS.items()
    ]
    before, after = ({str(row["name"]): row for row in rows} for rows in kept)
    return moves + [
        MoveDifference(name, str(row["unit"]), float(before[name]["value"]), float(row["value"]))
        for name, row in after.items()
        if name in before and name not in UNITS
    ]


def same_move(first: Trace, second: Trace) -> bool:
    """Whether two records are of moves by one way at one speed, however often they went."""
    (way, speed), (other_way, other_speed) = (demanded(trace) for trace in (first, second))
    return abs(other_way - way) <= SAME_WAY * way and abs(other_speed - speed) <= SAME_SPEED * speed


def demanded(trace: Trace) -> tuple[float, float]:
    """Return the way (rad) and the mean speed (rad/s) of the demand while it moves."""
    found = move_result(trace)
    return found.way_rad, float(np.abs(np.diff(trace["theta_ref_rad"])).sum()) / found.moving_s
