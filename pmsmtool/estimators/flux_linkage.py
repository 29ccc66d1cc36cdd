"""PM flux linkage, encoder offset and a check of L_q from steady speeds (identification reference, 3.4).

For a drive that turns its voltage by the delay times the speed, the command at constant speed is exactly

    v* = j w sinc(w T_s/2) psi(i) + R <i> + v_err,      sinc x = sin x / x,

so u = (v* - v_err - R i) (w T_s/2)/sin(w T_s/2) is j w psi: the correction DIVIDES by sinc. Over all speeds

    u_q = x1 w + c sgn(w) + m w i_q,        u_d = -L_q w i_q + x2 w - psi w^2 dt,

psi = hypot(x1, x2), frame ahead of the d axis by eps = atan2(x2, x1), m the coupling (L_d - L_q)/2 sin(2 eps) of a
frame that is off its axis, and dt what is left of angle and voltage delay.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.estimators.estimate import SensorTolerance, condition_gate
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.least_squares import linear_solve
from pmsmtool.estimators.refusals import refuse
from pmsmtool.estimators.switching_ripple import Modulation, rippled_error_dq_v
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

STAGE = "flux linkage"
Vector = NDArray[np.float64]

MINIMUM_SPEEDS = 4
"""Speeds per direction."""
SPEED_RATIO = 2.0
"""Largest over smallest speed below which psi and the intercept are one."""
RELATIVE_FLOOR = 5e-5
"""Relative model floor of psi (measured: 0.00-0.03 % bias from the intercept on shapes outside the model)."""
OFFSET_FLOOR_RAD = 1e-4
OFFSET_LIMIT_RAD = math.radians(30.0)
"""Offset above which the speed run cannot have been what it claims; the coarse offset comes first."""
CURRENT_SETTLE_LIMIT = 0.25
"""Change of a current between the halves of a window, of the largest current."""
I_D_SPREAD = 0.5
"""Spread of i_d over the speeds, of the largest current, from which on L_d is fitted with psi."""
SETTLE_LIMIT = 0.02
"""Relative change of the speed between the halves of a window."""


@dataclass(frozen=True, slots=True)
class FluxResult:
    """PM flux linkage and what the same run says about angle and L_q.

    Attributes
    ----------
    psi_f : Estimate
        PM flux linkage at the reference temperature (Wb).
    psi_measured : Estimate
        The same at the temperature of the run (Wb).
    frame_offset : Estimate
        Angle of the frame ahead of the d axis (rad electrical): add it to the stored encoder offset.
    L_q_h, L_q_std_h : float
        Apparent L_q at the small q current of the run, a check only (H).
    angle_delay_s : float
        Delay between angle and voltage that the drive does not compensate (s).
    intercept_v : float
        Dead-time voltage that remains in u_q (V).
    residual_v : float
        Residual standard deviation of u_q (V).
    """

    psi_f: Estimate
    psi_measured: Estimate
    frame_offset: Estimate
    L_q_h: float
    L_q_std_h: float
    angle_delay_s: float
    intercept_v: float
    residual_v: float


def estimate_flux_linkage(
    speeds: Trace,
    R_ohm: float,
    *,
    period_s: float,
    inverter: InverterCurve | None = None,
    waves: Sequence[Trace] = (),
    modulation: Modulation | None = None,
    cross_h_per_a: float = 0.0,
    tolerance: SensorTolerance | None = None,
    T_ref_c: float = 20.0,
    alpha_psi_per_k: float = -0.0012,
) -> FluxResult:
    """PM flux linkage from the means of steady speeds.

    Parameters
    ----------
    speeds : Trace
        One row per speed: ``u_d_v u_q_v i_d_a i_q_a omega_e_rad_s`` (means over whole turns), ``omega_first_rad_s
        omega_second_rad_s i_d_first_a i_d_second_a i_q_first_a i_q_second_a`` (halves of the window), ``T_magnet_c``
        (NaN without a sensor).
    R_ohm : float
        Loop resistance at the temperature of the run (ohm).
    period_s : float
        Control period (s).
    inverter : InverterCurve or None
        Voltage error from the DC levels; the intercept takes what is left.
    waves : sequence of Trace
        ``i_d_a i_q_a theta_e_rad`` over about the window of each speed: the mean error of a current with ripple near
        its zero crossing is not the error of the mean current. Empty: the mean currents are used.
    modulation : Modulation or None
        With waves: what ripple at the switching edges may do to the inverter's error counts as a standard deviation.
    cross_h_per_a : float
        Standard deviation of dL_q/di_d (H/A), which by reciprocity bends psi_d by half of it times i_q^2.
    tolerance : SensorTolerance
        Declared sensor tolerances.
    T_ref_c, alpha_psi_per_k : float
        Reference temperature (degC) and coefficient of the magnets (1/K).

    Raises
    ------
    IdentificationError
        ``E_EXCITATION``, ``E_CLIPPED``, ``E_NOT_SETTLED``, ``E_NOT_IDENTIFIABLE``.
    """
    tolerance = tolerance or SensorTolerance()
    w = speeds["omega_e_rad_s"]
    _check_speeds(speeds, w)
    i_d, i_q = speeds["i_d_a"], speeds["i_q_a"]
    x = 0.5 * w * period_s
    correction = x / np.sin(x)
    e_d, e_q = _inverter_error(inverter, i_d, i_q, waves)
    u_d = (speeds["u_d_v"] - e_d - R_ohm * i_d) * correction
    u_q = (speeds["u_q_v"] - e_q - R_ohm * i_q) * correction
    one = np.ones_like(w)
    q_columns = [w, np.sign(w), w * i_q]
    d_columns = [-w * i_q, w, -w * w]
    if np.ptp(i_d) > I_D_SPREAD * float(np.max(np.hypot(i_d, i_q))):
        # the flux of i_d and its share on the q axis of a frame that is off are unknowns of the same run
        q_columns.append(w * i_d)
        d_columns.append(-w * i_d)
    q_matrix = np.stack(q_columns, axis=1)
    q_fit, q_cov, q_residual, q_condition = linear_solve(q_matrix, u_q, one)
    d_fit, d_cov, d_residual, d_condition = linear_solve(np.stack(d_columns, axis=1), u_d, one)
    condition_gate(q_condition, "psi and the dead-time voltage", STAGE)
    condition_gate(d_condition, "L_q, the offset and the angle delay", STAGE)
    dof_q, dof_d = len(w) - len(q_columns), len(w) - len(d_columns)
    s_q = math.sqrt(float(q_residual @ q_residual) / dof_q)
    s_d = math.sqrt(float(d_residual @ d_residual) / dof_d)
    x1, x2 = float(q_fit[0]), float(d_fit[1])
    psi = math.hypot(x1, x2)
    eps = math.atan2(x2, x1)
    if not x1 > 0.0 or abs(eps) > OFFSET_LIMIT_RAD:
        raise refuse(
            "E_NOT_IDENTIFIABLE",
            f"the voltage of the rotating magnets lies {math.degrees(eps):.3g} deg off the q axis, "
            f"limit {math.degrees(OFFSET_LIMIT_RAD):g} deg",
            stage=STAGE,
            likely="wrong encoder offset, direction or pole pairs",
            hint="identify poles and encoder first",
        )
    std_1, std_2 = s_q * math.sqrt(float(q_cov[0, 0])), s_d * math.sqrt(float(d_cov[1, 1]))
    # what two effects outside the model would do to psi: the same regression of their voltages
    crossed = 0.5 * cross_h_per_a * w * i_q**2
    rippled = np.zeros_like(w)
    if inverter is not None and modulation is not None and waves:
        rippled = (_rippled_error(inverter, speeds, waves, modulation) - e_q) * correction
    model = [float(linear_solve(q_matrix, voltage, one)[0][0]) for voltage in (crossed, rippled)]
    std = math.hypot(
        math.cos(eps) * std_1,
        math.sin(eps) * std_2,
        RELATIVE_FLOOR * psi,
        tolerance.voltage_scale_std * psi,
        *model,
    )
    T = float(np.mean(speeds["T_magnet_c"]))
    measured = Estimate(
        value=psi,
        std=std,
        systematic=tolerance.flux * psi,
        unit="Wb",
        n=len(w),
        chi2=math.nan,
        T_c=T,
        method="regression over speeds in both directions, sampled-data correction",
        i_d_apk=float(np.mean(i_d)),
        i_q_apk=float(np.mean(np.abs(i_q))),
        dof=dof_q,
    )
    offset = Estimate(
        value=eps,
        std=math.hypot(math.cos(eps) * std_2 / psi, math.sin(eps) * std_1 / psi, OFFSET_FLOOR_RAD),
        systematic=0.0,
        unit="rad",
        n=len(w),
        T_c=T,
        method="direction of the no-load voltage over speeds in both directions",
        dof=dof_d,
    )
    return FluxResult(
        psi_f=_normalise(measured, T_ref_c, alpha_psi_per_k, tolerance),
        psi_measured=measured,
        frame_offset=offset,
        L_q_h=float(d_fit[0]),
        L_q_std_h=s_d * math.sqrt(float(d_cov[0, 0])),
        angle_delay_s=float(d_fit[2]) / psi,
        intercept_v=float(q_fit[1]),
        residual_v=s_q,
    )


def _inverter_error(
    curve: InverterCurve | None, i_d: Vector, i_q: Vector, waves: Sequence[Trace]
) -> tuple[Vector, Vector]:
    if curve is None:
        return np.zeros_like(i_d), np.zeros_like(i_d)
    if not waves:
        return mean_inverter_error(curve, i_d, i_q)
    errors = [curve.error_dq_v(wave["i_d_a"], wave["i_q_a"], wave["theta_e_rad"]) for wave in waves]
    return np.array([float(np.mean(e[0])) for e in errors]), np.array([float(np.mean(e[1])) for e in errors])


def _rippled_error(
    curve: InverterCurve, speeds: Trace, waves: Sequence[Trace], modulation: Modulation
) -> Vector:
    """Mean q error of each speed with the ripple at the switching edges (V)."""
    errors = []
    for wave, u_d, u_q in zip(waves, speeds["u_d_v"], speeds["u_q_v"], strict=True):
        voltage = (np.full(len(wave), u_d), np.full(len(wave), u_q))
        current = (wave["i_d_a"], wave["i_q_a"])
        errors.append(float(np.mean(rippled_error_dq_v(curve, current, voltage, wave["theta_e_rad"], modulation)[1])))
    return np.array(errors)


def mean_inverter_error(curve: InverterCurve, i_d: Vector, i_q: Vector) -> tuple[Vector, Vector]:
    """Mean of the three-phase error over one electrical turn, in the rotor frame (V)."""
    angle = np.asarray((np.arange(360) + 0.5) * (2.0 * np.pi / 360.0), dtype=np.float64)
    e_d, e_q = np.empty_like(i_d), np.empty_like(i_q)
    for k, (d, q) in enumerate(zip(i_d, i_q, strict=True)):
        wave_d, wave_q = curve.error_dq_v(np.full_like(angle, d), np.full_like(angle, q), angle)
        e_d[k], e_q[k] = float(np.mean(wave_d)), float(np.mean(wave_q))
    return e_d, e_q


def _check_speeds(speeds: Trace, w: Vector) -> None:
    for sign, name in ((1.0, "forward"), (-1.0, "backward")):
        mine = np.abs(w[np.sign(w) == sign])
        if len(mine) < MINIMUM_SPEEDS or float(np.max(mine)) < SPEED_RATIO * float(np.min(mine)):
            raise refuse(
                "E_EXCITATION",
                f"{len(mine)} speeds {name}; {MINIMUM_SPEEDS} over a range of {SPEED_RATIO:g} to 1 are needed",
                stage=STAGE,
            )
    if "flagged" in speeds.signals and np.any(speeds["flagged"] > 0.0):
        count = int(np.sum(speeds["flagged"] > 0.0))
        raise refuse("E_CLIPPED", f"voltage or current limited at {count} speeds", stage=STAGE)
    change = np.abs(speeds["omega_second_rad_s"] - speeds["omega_first_rad_s"]) / np.abs(w)
    if float(np.max(change)) > SETTLE_LIMIT:
        worst = int(np.argmax(change))
        raise refuse(
            "E_NOT_SETTLED",
            f"at {w[worst]:.4g} rad/s the speed still moves by {100 * change[worst]:.2g} % in one window, "
            f"limit {100 * SETTLE_LIMIT:g} %",
            stage=STAGE,
        )
    for axis in ("d", "q"):
        drift = np.abs(speeds[f"i_{axis}_second_a"] - speeds[f"i_{axis}_first_a"])
        limit = CURRENT_SETTLE_LIMIT * float(np.max(np.hypot(speeds["i_d_a"], speeds["i_q_a"])))
        if float(np.max(drift)) > limit:
            worst = int(np.argmax(drift))
            raise refuse(
                "E_NOT_SETTLED",
                f"at {w[worst]:.4g} rad/s i_{axis} still moves by {drift[worst]:.2g} A in one window, "
                f"limit {limit:.2g} A",
                stage=STAGE,
            )


def _normalise(measured: Estimate, T_ref_c: float, alpha: float, tolerance: SensorTolerance) -> Estimate:
    known = math.isfinite(measured.T_c)
    factor = 1.0 + alpha * (measured.T_c - T_ref_c) if known else 1.0
    value = measured.value / factor
    thermal = abs(alpha) * tolerance.temperature_k * value if known else 0.0
    return Estimate(
        value=value,
        std=measured.std / factor,
        systematic=math.hypot(measured.systematic / factor, thermal),
        unit="Wb",
        n=measured.n,
        chi2=measured.chi2,
        T_c=measured.T_c,
        method=measured.method,
        i_d_apk=measured.i_d_apk,
        i_q_apk=measured.i_q_apk,
        dof=measured.dof,
        fallback="" if known else "magnet temperature unknown: psi_f is not normalised",
    )
