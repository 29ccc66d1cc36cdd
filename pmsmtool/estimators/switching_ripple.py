"""What the ripple of pulse-width modulation does to an inverter's voltage error near a zero crossing.

Dead time acts at the two edges of each leg, and there the current differs from its sampled value. With centre-aligned
pulses, min-max zero sequence and samples in the middle of the zero vector the ripple is +delta at the rising and -delta
at the falling edge,

    delta_x = -(1/L) [ U_dc/3 sum_y max(0, t_x - t_y) + v_x t_x ],      t_x = (1 - d_x) T_s/2,

and because a dead time t_d delays every pulse by half of it, the sample is v_x t_d/(2 L) above the current between. A
leg then loses (e(i_x + delta_x) + e(i_x - delta_x))/2. At standstill all legs switch together and nothing of this is
there: the curve measured then is too sharp for a machine that turns. How much it matters depends on diodes and
capacitances that nobody measured, so the difference is an uncertainty and not a correction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.estimators.inverter_error import InverterCurve

Vector = NDArray[np.float64]
ROOT_3 = math.sqrt(3.0)


@dataclass(frozen=True, slots=True)
class Modulation:
    """What the ripple depends on besides the voltage.

    Attributes
    ----------
    U_dc_v : float
        DC link (V).
    L_h : float
        Inductance of the machine at the switching frequency, mean of the axes (H).
    period_s : float
        Switching period (s).
    dead_time_s : float
        From the plateau of the measured curve: V_dead T_s/U_dc (s).
    """

    U_dc_v: float
    L_h: float
    period_s: float
    dead_time_s: float


def phases_of(d: Vector, q: Vector, theta_rad: Vector) -> NDArray[np.float64]:
    """Phase quantities, shape (3, n), of a vector in a frame at ``theta_rad``."""
    c, s = np.cos(theta_rad), np.sin(theta_rad)
    alpha, beta = c * d - s * q, s * d + c * q
    return np.stack([alpha, -0.5 * alpha + 0.5 * ROOT_3 * beta, -0.5 * alpha - 0.5 * ROOT_3 * beta])


def ripple_at_edges(v_phase_v: NDArray[np.float64], modulation: Modulation) -> NDArray[np.float64]:
    """Ripple at the rising edge of each leg (A), shape (3, n); minus that at the falling one.

    Parameters
    ----------
    v_phase_v : ndarray, shape (3, n)
        Mean phase voltages of the period, without zero sequence (V).
    modulation : Modulation
        Link, inductance and period.
    """
    zero = -0.5 * (np.max(v_phase_v, axis=0) + np.min(v_phase_v, axis=0))
    duty = np.clip(0.5 + (v_phase_v + zero) / modulation.U_dc_v, 0.0, 1.0)
    edge = (1.0 - duty) * 0.5 * modulation.period_s
    others_on = np.sum(np.maximum(0.0, edge[:, None, :] - edge[None, :, :]), axis=1)
    return np.asarray(-(modulation.U_dc_v / 3.0 * others_on + v_phase_v * edge) / modulation.L_h)


def rippled_error_dq_v(
    curve: InverterCurve,
    current: tuple[Vector, Vector],
    voltage: tuple[Vector, Vector],
    theta_rad: Vector,
    modulation: Modulation,
) -> tuple[Vector, Vector]:
    """Error of the three phases in the rotor frame with the ripple at their edges (V).

    Parameters
    ----------
    curve : InverterCurve
        Error without ripple.
    current, voltage : (ndarray, ndarray)
        d and q values (A, V), shape (n,).
    theta_rad : ndarray, shape (n,)
        Angle of the frame (rad electrical).
    modulation : Modulation
        Link, inductance, period and dead time.
    """
    v = phases_of(*voltage, theta_rad)
    i = phases_of(*current, theta_rad) - v * modulation.dead_time_s / (2.0 * modulation.L_h)
    delta = ripple_at_edges(v, modulation)
    e_a, e_b, e_c = 0.5 * (curve.error_v(i + delta) + curve.error_v(i - delta))
    e_alpha, e_beta = (2.0 * e_a - e_b - e_c) / 3.0, (e_b - e_c) / ROOT_3
    c, s = np.cos(theta_rad), np.sin(theta_rad)
    return c * e_alpha + s * e_beta, c * e_beta - s * e_alpha
