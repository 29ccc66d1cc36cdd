# SPDX-License-Identifier: MIT
"""PM flux linkage, encoder offset and a check of L_q from a coasting shaft (docs/identification.md, 3.4).

For a drive that turns its voltage by the delay times the speed, the command is

    v* = j w sinc(w T_s/2) psi(i) + R <i> + v_err,      sinc x = sin x / x,

so u = (v* - v_err - R i) (w T_s/2)/sin(w T_s/2) is j w psi: the correction DIVIDES by sinc. The shaft coasts with
i_q = 0, where the inverter's error has no q part but the one of the ripple (:mod:`inverter_error`), and i_d is held
with both signs one after the other: their sum cancels the flux of i_d and what the ripple of the currents does,

    (u_q+ + u_q-)/(w+ + w-) = x1 (1 + k2 i_d^2 + k4 i_d^4) + i_u e(i_d)/(|w i_d|),   u_d = -L_q w i_q + x2 w + ...,

psi = hypot(x1, x2), frame ahead of the d axis by eps = atan2(x2, x1), k2 and k4 the saturation of the d axis, and i_u a
q current of the legs that no sample holds, as iron loss draws it within the pulses: it turns the inverter's error e.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.estimators.cross_check import SATURATION_DOUBT, cross_check, driven_flux_linkage
from pmsmtool.estimators.estimate import SensorTolerance, condition_gate, information_weights
from pmsmtool.estimators.flux.linkage_rows import (
    STAGE,
    Corrected,
    check_speeds,
    corrected,
    fastest_pair,
    pairs_of,
    usable,
)  # fmt: skip
from pmsmtool.estimators.injection.sampling_instant import CoastingPairs, Sampling, ShownInstant, shown_instant
from pmsmtool.estimators.inverter_error import InverterCurve, Modulation
from pmsmtool.estimators.least_squares import linear_solve
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.temperature import MAGNET_ALPHA_PER_K
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

RELATIVE_FLOOR = 7e-5
"""Relative model floor of psi, one standard deviation: 24 drives with samples in time are 0.020 % off in the
mean beside the thresholds of their bridges, those of 24 and 48 V 0.008 % (largest 0.014 %)."""
OFFSET_FLOOR_RAD = 1e-4
OFFSET_LIMIT_RAD = math.radians(30.0)
"""Offset above which the speed run cannot have been what it claims; the coarse offset comes first."""
RIPPLE_DOUBT = 0.1
"""Standard deviation of the ripple's share of the inverter error, relative. Beside the bridge's thresholds psi is off
by 0.028 % rms on 52 random drives whose dead time takes more than 3 R I, where that share is 0.1 to 2 % of it."""
CURVE_DOUBT = 0.15
"""The same of what the measured curve says about the i_q that is left, or held against friction."""
CURVATURE_DOUBT = 0.2
"""Standard deviation of the way from the smallest d current to none, relative (measured on five reluctance machines
that saturate, whose way is 0.5 %: 0.01 to 0.5)."""
LAG_STD = 0.03
"""Relative standard deviation of the lag (pushes of 10 drives show 0.99 of what the drive's bandwidth says)."""
D_SHARE_DOUBT = 0.07
"""Standard deviation of the d part of the inverter's error at a q current, of its q part (measured on 11 drives: 0.01
to 0.13, rms 0.068, always of the sign that makes L_q too large)."""
MODEL_FLOOR = 3e-4
"""Relative standard deviation of a window's flux linkage by what no model of them has: less decides between none."""
PENALTY = 7.0
"""Price of a parameter in the information criterion, as for L (``axis_fit``): with ln n, 2.8 for 16 pairs, a curvature
that is not there made psi_f scatter by three times its bound."""
INSTANT_STEP = 0.01
"""Step of the derivative by the sampling instant (T_s)."""
MAGNET_CHANGE = 0.003
"""Change of the flux linkage over the pulses of a flux map that counts as none, whatever the scatter."""
PAIR_SCATTERS = 3.0
"""Scatter of a pair of windows, of which two may be apart."""
LEVEL_RATIO = 1.2
"""Ratio of d currents above which they are different levels."""


@dataclass(frozen=True, slots=True)
class FluxResult:
    """PM flux linkage and what the same run says about angle and L_q."""

    psi_f: Estimate
    """PM flux linkage at the reference temperature (Wb)."""
    psi_measured: Estimate
    """The same at the temperature of the run (Wb)."""
    frame_offset: Estimate
    """Angle of the frame ahead of the d axis (rad electrical): add it to the stored encoder offset."""
    driven: Estimate | None
    """PM flux linkage at the reference temperature by the run's q currents, a check (Wb); None without them."""
    voltage_scale_std: float
    """Relative standard deviation that both have from the bridge's thresholds."""
    L_q_app: Estimate
    """Apparent L_q at the q currents of the run, a check only: beside a large dead time it says nothing, and its
    standard deviation says so (H)."""
    curvature: float
    """Mean of psi_d(i_d) and psi_d(-i_d) over psi_f, less one, at the largest d current."""
    low_wb: float
    low_std_wb: float
    low_i_d_a: float
    """That mean itself at the smallest d current (Wb, Wb, A): measured, where psi_f of a machine that saturates is
    extrapolated."""
    omega_rad_s: Array
    residual_wb: Array
    """Electrical speed of every pair of d currents, and what its flux linkage is off (rad/s, Wb). Shape (n,)."""
    shown: ShownInstant | None = None
    """What the d voltage says about the instant at which currents are sampled; None without a modulation."""
    apart_wb: float = 0.0
    """How far the flux linkage by driving currents lies from this one, where beyond what both say of themselves: then
    an effect that neither knows, iron loss above all, is in them, and it is a standard deviation here. Else 0 (Wb)."""
    unseen_a: float = 0.0
    """q current of the legs that no sample holds, with the sign of the speed (A)."""


def estimate_flux_linkage(
    speeds: Trace,
    R_ohm: float,
    *,
    period_s: float,
    inverter: InverterCurve | None = None,
    modulation: Modulation | None = None,
    lag_s: float = 0.0,
    sampling: Sampling | None = None,
    apart_s: float = 0.0,
    tolerance: SensorTolerance | None = None,
    T_ref_c: float = 20.0,
    alpha_psi_per_k: float = MAGNET_ALPHA_PER_K,
) -> FluxResult:
    """PM flux linkage from the means of windows at steady currents.

    Raises IdentificationError: ``E_EXCITATION``, ``E_CLIPPED``, ``E_NOT_SETTLED``, ``E_NOT_IDENTIFIABLE``.

    Parameters
    ----------
    speeds : Trace
        One row per window, d currents of both signs next to each other: ``u_d_v u_q_v i_d_a i_q_a omega_e_rad_s``
        (means over whole turns), ``omega_first_rad_s omega_second_rad_s i_d_first_a i_d_second_a i_q_first_a
        i_q_second_a`` (halves of the window), ``half_s`` (their length), ``T_magnet_c`` (NaN without a sensor).
    R_ohm : float
        Loop resistance at the temperature of the run (ohm).
    period_s : float
        Control period (s).
    inverter : InverterCurve or None
        Voltage error from the DC levels.
    modulation : Modulation or None
        What the ripple at the switching edges makes of that error; None: nothing.
    lag_s : float
        Delay of the drive's speed behind the rotor's while it accelerates: 2/omega of its estimate's double pole (s).
    sampling : Sampling or None
        When and how the currents are sampled, as the inductances' fit has it; None: at the period's start.
    apart_s : float
        What other experiments say of that instant, less what this run shows, where they contradict each other (s).
    tolerance : SensorTolerance
        Declared sensor tolerances.
    T_ref_c, alpha_psi_per_k : float
        Reference temperature (degC) and coefficient of the magnets (1/K).
    """
    tolerance = tolerance or SensorTolerance()
    whole = speeds
    speeds, left_out = usable(whole)
    pairs = pairs_of(speeds)
    check_speeds(speeds, pairs, whole)
    rows = corrected(speeds, R_ohm, period_s, inverter, modulation, lag_s, sampling)
    d_fit, d_std, d_dof = _fit_d(rows)
    T, rough_L_d = float(np.mean(speeds["T_magnet_c"])), _rough_L_d(rows, rows.is_d)
    alike = replace(tolerance, bridge_threshold_v=0.0)  # both methods have the scale of the voltage
    even = _fit_even(rows, pairs, driven_flux_linkage(rows, rough_L_d, 0.0, 0.0, lag_s, alike, T))
    x1, x2 = even.flux_wb, float(d_fit[1])
    psi = math.hypot(x1, x2)
    eps = math.atan2(x2, x1)
    if not x1 > 0.0 or abs(eps) > OFFSET_LIMIT_RAD:
        raise refuse(
            "E_NOT_IDENTIFIABLE",
            f"the voltage of the rotating magnets lies {math.degrees(eps):.3g} deg off the q axis, "
            f"limit {math.degrees(OFFSET_LIMIT_RAD):g} deg",
            stage=STAGE,
            likely="wrong encoder offset, direction or pole pairs",
            hint="check the coupling of the encoder and its increments per turn, then identify poles and encoder, too",
        )
    shown, per_instant = None, 0.0
    if modulation is not None:
        coasting = CoastingPairs(rows.w, rows.u_d, rows.i_d, rows.i_q, speeds["u_d_v"], speeds["u_q_v"], pairs)
        shown = shown_instant(coasting, R_ohm, psi, modulation, float(speeds.meta.get("delay_periods", 1.5)) - 0.5)
        if sampling is not None:
            later = replace(sampling, instant_s=sampling.instant_s + INSTANT_STEP * period_s)
            moved = corrected(speeds, R_ohm, period_s, inverter, modulation, lag_s, later)
            per_instant = even.change(moved.u_q - rows.u_q) / (INSTANT_STEP * period_s)
    model_std = math.hypot(
        RIPPLE_DOUBT * even.change(rows.ripple_q_v),
        CURVE_DOUBT * even.change(rows.curve_q_v),
        CURVATURE_DOUBT * even.way_wb,
        even.curvature * even.q_share**2 * psi,
        LAG_STD * lag_s * even.change(psi * rows.acceleration_rad_s2),
        0.0 if shown is None else per_instant * math.hypot(shown.std_s, apart_s),
        RELATIVE_FLOOR * psi,
        tolerance.voltage_scale_std * psi,
    )
    fitted = math.hypot(math.cos(eps) * even.std_wb, math.sin(eps) * d_std[1])
    std = math.hypot(fitted, model_std)
    driven = driven_flux_linkage(rows, rough_L_d, x2, even.curvature, lag_s, tolerance, T)
    apart = 0.0
    if driven is not None:
        alone = Estimate(psi, std, 0.0, "Wb")
        if not cross_check("psi_f_wb_driven", "psi_f_wb", driven, alone, tolerance.voltage_scale_std).agrees:
            apart = abs(driven.value - psi)
    std = math.hypot(std, apart)
    # an angle old by t shows what a late sample does, but wants less of a correction, and psi was cos(w t) psi on q
    old_s = 0.0 if shown is None else max(0.0, shown.value_s)
    if_old = per_instant * old_s - even.change(0.5 * rows.u_q * (rows.w * old_s) ** 2)
    measured = Estimate(
        value=psi,
        std=std,
        systematic=math.hypot(tolerance.flux * psi, per_instant * tolerance.encoder_latency_s) + abs(if_old),
        unit="Wb",
        n=len(rows.w),
        T_c=T,
        method="coasting in both directions, d currents of both signs, sampled-data correction",
        i_d_apk=0.0,
        i_q_apk=0.0,
        fallback=left_out,
        dof=even.dof * (std / fitted) ** 4 if fitted > 0.0 else math.inf,  # Welch-Satterthwaite, GUM G.4
    )
    offset = Estimate(
        value=eps,
        std=math.hypot(math.cos(eps) * d_std[1] / psi, math.sin(eps) * even.std_wb / psi, OFFSET_FLOOR_RAD),
        systematic=0.0,
        unit="rad",
        n=len(rows.w),
        T_c=T,
        method="direction of the no-load voltage over speeds in both directions",
        dof=d_dof,
    )
    return FluxResult(
        psi_f=normalised(measured, T_ref_c, alpha_psi_per_k, tolerance),
        psi_measured=measured,
        frame_offset=offset,
        driven=None if driven is None else normalised(driven, T_ref_c, alpha_psi_per_k, tolerance),
        voltage_scale_std=tolerance.voltage_scale_std,
        L_q_app=Estimate(
            value=float(d_fit[0]),
            std=float(d_std[0]),
            systematic=tolerance.impedance * abs(float(d_fit[0])),
            unit="H",
            n=int(np.sum(~rows.is_d)),
            method="d voltage of q currents at speed, apparent",
            i_d_apk=0.0,
            i_q_apk=float(np.mean(np.abs(rows.i_q[~rows.is_d]))) if not np.all(rows.is_d) else 0.0,
            dof=d_dof,
        ),
        curvature=even.curvature,
        low_wb=math.hypot(even.low_wb, x2),
        low_std_wb=math.hypot(even.low_std_wb, model_std),
        low_i_d_a=even.low_i_d_a,
        omega_rad_s=even.w,
        residual_wb=even.residual_wb,
        shown=shown,
        apart_wb=apart,
        unseen_a=even.unseen_a,
    )


def check_magnet(before: Trace, again: Trace, flux: FluxResult, alpha_psi_per_k: float) -> None:
    """Compare the flux linkage of two windows with the one of the same two windows later (:func:`magnet_change`).

    Raises IdentificationError: ``E_MAGNET_CHANGED``.
    """
    change = magnet_change(before, again, alpha_psi_per_k)
    scatter = float(np.sqrt(np.mean(flux.residual_wb**2))) / flux.psi_measured.value
    limit = max(MAGNET_CHANGE, PAIR_SCATTERS * math.sqrt(2.0) * scatter)
    if not abs(change) <= limit:
        raise refuse(
            "E_MAGNET_CHANGED",
            f"the flux linkage changed by {100.0 * change:.2g} % over the pulses, limit {100.0 * limit:.2g} %",
            stage="flux map",
        )


def magnet_change(before: Trace, again: Trace, alpha_psi_per_k: float) -> float:
    """Return the relative change of the flux linkage of two windows, beside that of a magnet whose warmth is shown.

    Gains, inverter error and saturation are those of both, and cancel.

    Parameters
    ----------
    before, again : Trace
        Rows of a run over speeds; the two rows of ``again`` repeat ``fastest_pair`` of ``before``.
    alpha_psi_per_k : float
        Temperature coefficient of the magnet flux (1/K).
    """
    pairs = (before, list(fastest_pair(before))), (again, [0, 1])
    psi = [float(np.mean(rows["u_q_v"][at] / rows["omega_e_rad_s"][at])) for rows, at in pairs]
    T = [float(np.mean(rows["T_magnet_c"][at])) for rows, at in pairs]
    warmer = T[1] - T[0] if np.all(np.isfinite(T)) else 0.0  # without a sensor a few seconds count as none
    return psi[1] / (psi[0] * (1.0 + alpha_psi_per_k * warmer)) - 1.0


def _fit_d(rows: Corrected) -> tuple[Array, Array, int]:
    """Regress u_d; returns (L_q, x2, psi dt, ...), their standard deviations and the degrees of freedom.

    In a frame eps ahead of the d axis u_d has w eps times all of psi_d: with i_d^2 and i_q^2, where it saturates.
    """
    w, i_d = rows.w, rows.i_d
    columns = [-w * rows.i_q, w, -w * w, -w * i_d, i_d]
    levels = np.abs(i_d[rows.is_d])
    if np.max(levels) > LEVEL_RATIO * np.min(levels):
        columns += [np.sign(i_d) * rows.is_d, w * i_d * i_d * rows.is_d]
        if not np.all(rows.is_d):
            columns.append(w * ~rows.is_d)
    matrix = np.stack(columns, axis=1)
    fit, covariance, residual, condition = linear_solve(matrix, rows.u_d, np.ones_like(w))
    condition_gate(condition, "L_q, the offset and the angle delay", STAGE)
    dof = len(w) - len(columns)
    std = np.sqrt(float(residual @ residual) / dof * np.diag(covariance))
    d_part = np.where(rows.is_d, 0.0, D_SHARE_DOUBT * np.abs(rows.curve_q_v) * np.sign(w * rows.i_q))
    std[0] = math.hypot(std[0], float(np.linalg.lstsq(matrix, d_part, rcond=None)[0][0]))
    return fit, std, dof


@dataclass(frozen=True, slots=True, eq=False)
class _Even:
    """Fit of the flux that does not depend on the sign of i_d; ``row`` maps the q voltages of all rows onto it.

    ``q_share`` is the largest q current beside a d current, over the largest of those: the shaft was driven. ``way_wb``
    is how far the flux linkage at the smallest d current, as it is shown, lies from the one without any.
    """

    flux_wb: float
    std_wb: float
    dof: float
    curvature: float
    q_share: float
    low_wb: float
    low_std_wb: float
    low_i_d_a: float
    w: Array
    residual_wb: Array
    row: Array
    way_wb: float
    unseen_a: float

    def change(self, voltage_v: Array) -> float:
        """Change of the flux that a q voltage of every row makes (Wb)."""
        return float(self.row @ voltage_v)


def _fit_even(rows: Corrected, pairs: Sequence[tuple[int, int]], driven: Estimate | None = None) -> _Even:
    """Average three models: flux linkage alone, with a current that no sample holds, with as many terms as levels.

    Weighted as the data support them, and the flux linkage of ``driven`` windows, which neither effect moves much: iron
    loss makes the second, a machine that saturates has all levels.
    """
    w, i_d = rows.w, rows.i_d
    first, second = (np.array([pair[k] for pair in pairs]) for k in (0, 1))
    w_sum = w[first] + w[second]
    # every pair as a linear map of the rows' voltages, so that doubts about voltages go the same way
    reduce = np.zeros((len(pairs), len(w)))
    index = np.arange(len(pairs))
    reduce[index, first] = reduce[index, second] = 1.0 / w_sum
    y = reduce @ (rows.u_q - _rough_L_d(rows, np.concatenate([first, second])) * w * i_d)
    turned = reduce @ (np.sign(w) * rows.error_d_v * i_d / np.maximum(i_d**2 + rows.i_q**2, np.finfo(float).tiny))
    level = 0.5 * np.abs(i_d[first] - i_d[second])
    s = level / np.max(level)
    weight = np.abs(w_sum) * s  # an error voltage that falls with the current
    weight = weight / np.mean(weight)
    sizes = np.sort(level)
    levels = 1 + int(np.sum(sizes[1:] > LEVEL_RATIO * sizes[:-1]))
    n = len(y)
    hats, residuals = [], []
    models = sorted({(0, 0), (0, int(np.any(turned))), (levels - 1, 0)})
    for order, unseen in models:
        matrix = np.stack([*(s ** (2 * k) for k in range(order + 1)), *[turned] * unseen], axis=1)
        hats.append(np.linalg.pinv(matrix * weight[:, None]) * weight)
        residuals.append(y - matrix @ (hats[-1] @ y))
    chi = np.array([float(np.sum((weight * residual) ** 2)) for residual in residuals])
    dof = n - 1.0 - np.sum(models, axis=1)
    values = np.array([float(hat[0] @ y) for hat in hats])
    bends = np.array([float(np.sum((hat @ y)[1 : order + 1])) for hat, (order, _) in zip(hats, models, strict=True)])
    unseen_a = np.array([unseen * float(hat[-1] @ y) for hat, (_, unseen) in zip(hats, models, strict=True)])
    floor = MODEL_FLOOR * values[0]
    price = chi / (float(np.min(chi / dof)) + floor**2) + PENALTY * (n - dof) + (unseen_a / sizes[0]) ** 2
    if driven is not None:
        price += (values - driven.value) ** 2 / (driven.std**2 + floor**2 + (SATURATION_DOUBT * bends) ** 2)
    share = information_weights(list(price))
    value = float(share @ values)
    within = chi / dof * np.array([float(np.sum((hat[0] / weight) ** 2)) for hat in hats])
    low, at_low = level < LEVEL_RATIO * sizes[0], y - float(share @ unseen_a) * turned
    return _Even(flux_wb=value, std_wb=math.sqrt(float(share @ (within + (values - value) ** 2))),
                 dof=float(share @ dof),
                 curvature=float(share @ bends) / value,
                 q_share=float(np.max(np.abs(rows.i_q[np.concatenate([first, second])])) / np.max(level)),
                 low_wb=float(np.average(at_low[low], weights=weight[low])),
                 low_std_wb=float(np.std(at_low[low])) / math.sqrt(max(1, int(np.sum(low)) - 1)),
                 low_i_d_a=float(np.mean(level[low])), w=0.5 * w_sum,
                 residual_wb=np.asarray(share @ np.stack(residuals)),
                 row=np.asarray(share @ np.stack([hat[0] for hat in hats]) @ reduce),
                 way_wb=float(np.average(y[low], weights=weight[low])) - value,
                 unseen_a=float(share @ unseen_a))  # fmt: skip


def _rough_L_d(rows: Corrected, which: NDArray[np.int64 | np.bool_]) -> float:
    """L_d from u_q (H): the two windows of a pair differ a little in speed."""
    w, across = rows.w[which], rows.w[which] * rows.i_d[which]
    columns = np.stack([w, across, np.sign(across)], axis=1)
    return float(np.linalg.lstsq(columns, rows.u_q[which], rcond=None)[0][1])


def normalised(measured: Estimate, T_ref_c: float, alpha: float, tolerance: SensorTolerance) -> Estimate:
    """Return psi moved from its measured temperature to the reference temperature."""
    known = math.isfinite(measured.T_c)
    factor = 1.0 + alpha * (measured.T_c - T_ref_c) if known else 1.0
    value = measured.value / factor
    thermal, told = 0.0, "magnet temperature unknown: psi_f is not normalised"
    if known:
        told = ""
        away = tolerance.magnet_per_k * (measured.T_c - T_ref_c)
        thermal = math.hypot(alpha * tolerance.temperature_k, away) * value
    return replace(
        measured,
        value=value,
        std=measured.std / factor,
        systematic=math.hypot(measured.systematic / factor, thermal),
        fallback="; ".join(filter(None, (measured.fallback, told))),
    )
