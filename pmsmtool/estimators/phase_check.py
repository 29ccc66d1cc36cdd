"""Is the motor there, and are its phases alike? Three small vectors before any larger current."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.estimators.noise import Noise
from pmsmtool.estimators.refusals import refuse
from pmsmtool.trace import Trace

STAGE = "phase check"
CONNECTED_SIGMA = 10.0
"""Multiples of the noise of one sample that a current must exceed."""
OPEN_FRACTION = 0.2
"""Fraction of the other phases' current below which a phase counts as open."""
BALANCE_LIMIT = 0.10
"""Largest relative spread of currents or resistances between the phases."""


@dataclass(frozen=True, slots=True)
class PhaseCheck:
    """Result of the three vectors.

    Attributes
    ----------
    currents_a : tuple of float
        Current along each vector (A).
    impedance_ohm : tuple of float
        u/i along each vector, dead-time voltage included (ohm).
    spread : float
        Largest relative difference of either.
    """

    currents_a: tuple[float, float, float]
    impedance_ohm: tuple[float, float, float]
    spread: float


def check_phases(vectors: Trace, noise: Noise) -> PhaseCheck:
    """Judge three vectors at 0, 120 and 240 degrees.

    Parameters
    ----------
    vectors : Trace
        Three rows: ``i_a_a i_b_a i_c_a`` phase currents and ``u_d_v i_d_a i_q_a`` along the vector (means);
        ``moved`` 1 where the rotor did not come to rest; ``meta["i_command_a"]``.
    noise : Noise
        From the zero-current trace.

    Raises
    ------
    IdentificationError
        ``E_NOT_CONNECTED``, ``E_PHASE_OPEN``, ``E_NOT_SETTLED``, ``E_UNBALANCED``.
    """
    phases = np.stack([vectors["i_a_a"], vectors["i_b_a"], vectors["i_c_a"]], axis=1)
    strongest = np.max(np.abs(phases), axis=0)
    # an open phase still leaves 0.87 of the current in the other two for the vectors off its axis
    floor = CONNECTED_SIGMA * noise.sigma_a
    if float(np.max(strongest)) < floor:
        raise refuse(
            "E_NOT_CONNECTED",
            f"largest phase current {float(np.max(strongest)):.3g} A, below ten times the noise, {floor:.3g} A",
            stage=STAGE,
        )
    weakest = int(np.argmin(strongest))
    others = float(np.min(np.delete(strongest, weakest)))
    if strongest[weakest] < max(floor, OPEN_FRACTION * others):
        raise refuse(
            "E_PHASE_OPEN",
            f"phase {'abc'[weakest]} carries {strongest[weakest]:.3g} A where the others carry {others:.3g} A",
            stage=STAGE,
        )
    if "moved" in vectors.signals and float(np.max(vectors["moved"])) > 0.0:
        raise refuse("E_NOT_SETTLED", "the rotor still swings under the test vectors", stage=STAGE)
    along = vectors["i_d_a"]
    impedance = vectors["u_d_v"] / along
    spread = max(_spread(along), _spread(impedance))
    across = float(np.max(np.abs(vectors["i_q_a"] / along)))
    if max(spread, across) > BALANCE_LIMIT or not math.isfinite(spread):
        raise refuse(
            "E_UNBALANCED",
            f"currents differ by {100 * _spread(along):.2g} %, u/i by {100 * _spread(impedance):.2g} %, "
            f"{100 * across:.2g} % of the current is off its axis; limit {100 * BALANCE_LIMIT:g} %",
            stage=STAGE,
        )
    return PhaseCheck(
        (float(along[0]), float(along[1]), float(along[2])),
        (float(impedance[0]), float(impedance[1]), float(impedance[2])),
        max(spread, across),
    )


def _spread(values: NDArray[np.float64]) -> float:
    return float(np.ptp(values) / np.abs(np.mean(values)))
