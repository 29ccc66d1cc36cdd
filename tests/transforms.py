# SPDX-License-Identifier: MIT
"""Clarke and Park transformations, amplitude-invariant (peak), for numbers and arrays of any shape.

alpha along phase a; d at the electrical angle theta_e from alpha; q ahead of d by pi/2. The zero component is
dropped: a star without neutral carries none.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SQRT3 = math.sqrt(3.0)


def clarke(a: ArrayLike, b: ArrayLike, c: ArrayLike) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return alpha = (2 a - b - c)/3 and beta = (b - c)/sqrt 3."""
    a, b, c = np.asarray(a, float), np.asarray(b, float), np.asarray(c, float)
    return (2.0 * a - b - c) / 3.0, (b - c) / _SQRT3


def inverse_clarke(alpha: ArrayLike, beta: ArrayLike) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return the phase quantities a = alpha, b, c = -alpha/2 +- sqrt 3/2 beta, which sum to zero."""
    alpha, beta = np.asarray(alpha, float), np.asarray(beta, float)
    half = 0.5 * _SQRT3 * beta
    return alpha, half - 0.5 * alpha, -half - 0.5 * alpha


def park(alpha: ArrayLike, beta: ArrayLike, theta_e: ArrayLike) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return d = cos alpha + sin beta, q = -sin alpha + cos beta at the electrical angle theta_e (rad)."""
    cos, sin = np.cos(theta_e), np.sin(theta_e)
    return cos * alpha + sin * beta, cos * beta - sin * alpha


def inverse_park(d: ArrayLike, q: ArrayLike, theta_e: ArrayLike) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return alpha and beta of d and q at the electrical angle theta_e (rad)."""
    cos, sin = np.cos(theta_e), np.sin(theta_e)
    return cos * d - sin * q, sin * d + cos * q


def electrical_angle(theta_M: ArrayLike, pole_pairs: int, offset_rad: float = 0.0, direction: int = 1) -> NDArray[Any]:
    """Return theta_e = direction p theta_M - offset in [-pi, pi) (rad)."""
    raw = direction * pole_pairs * np.asarray(theta_M, float) - offset_rad
    return np.asarray((raw + math.pi) % (2.0 * math.pi) - math.pi)
