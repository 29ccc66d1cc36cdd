"""Resistance, flux linkage, L_q and frame offset from recorded torque pushes: one linear regression per axis.

Currents of several sizes and both signs at every speed (``experiments/recorded_push``) separate what single operating
points mix (identification reference, section 8):

    u_q x/sin x = w psi_q + R i_q + V sgn(i_q) + tail(i_q) + w L_d i_d + k w^2 i_q + const,     x = w T_s / 2
    u_d x/sin x - R i_d = w psi_d - w L_q i_q + (a + b abs(w)) sgn(w i_q) + k' w^2 + const
    psi = hypot(psi_q, psi_d), frame ahead of the d axis = atan2(psi_d, psi_q)

The axes are solved apart: R from u_d would rest on the small i_d. Of the inverter's error the plateau V and its tail
stand in u_q; a little turns into u_d, the more the faster, and does not depend on the size of the current. A frame
that is off by an angle that grows with the speed turns w L_q i_q into u_q: k w^2 i_q takes that, and w L_d i_d is not
nothing either; without the two, R was off by up to 11 %, and by 80 % on one drive of 20.

The speed is the encoder's own: a speed observer lags by its bandwidth under acceleration, which is proportional to the
current and would count as resistance. So would the delay between a sample and the middle of its voltage: the
acceleration is carried over it, and half a period of doubt about it goes into the systematic part of R.

The tail's shape is not known: the estimate is the mean over several, and their spread belongs to its standard
deviation; the rest of it is a jackknife over the pushes, because what is wrong with a push (friction, heating) is the
same in all its samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.estimators.estimate import SensorTolerance, statistical_half_width, total_half_width
from pmsmtool.estimators.push_regression import jackknife_variance, regress
from pmsmtool.estimators.refusals import refuse
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

STAGE = "recorded pushes"
BLOCK = 16
"""Samples averaged to one row."""
DELAY_PERIODS = 1.5
"""From a sample to the middle of the voltage computed from it, in control periods."""
DELAY_DOUBT_PERIODS = 0.5
DELAY_DOUBT = "delay_doubt_periods"
"""Key of a trace's ``meta``: how far that middle may be from there, where less is known of a drive's voltages."""
SKIP_SHARE = 0.1
"""Beginning of a push that is left out: the current is still rising."""
LEAST_PUSHES = 6
TAILS: tuple[tuple[int, ...], ...] = ((1,), (2,), (2, 4))
"""Shapes of the tail of the inverter's error curve: powers of 1/|i|. The mean over them gives the values, their spread
counts as doubt; R on 20 drives (seeds 3000 to 3019): 0.6 % in the median, 2.4 % on nine of ten."""
# Model errors: 95 % half widths beyond what the fit sees, chosen on 36 random drives (seeds 1, 2, 3, 8, 9, 105 and 300
# to 329 of benchmarks.tier_intervals); the errors are theirs.
L_Q_FLOOR = 0.07
"""Of L_q (relative): median 1.5 %, 4.4 % on nine of ten, up to 7.8 % (seeds 3000 to 3019)."""
L_Q_PER_ERROR = 0.02
"""More of it per V over the rms voltage of the reactance."""
PSI_FLOOR = 0.006
"""Of psi (relative): up to 1.0 % with ideal gains of the sensors."""
PSI_LIMIT = 0.03
"""Largest relative 95 % half width of psi: beyond, nothing of the pushes is to be trusted (one drive in 36)."""
FRAME_FLOOR_RAD = math.radians(0.3)
"""Of the frame's angle: up to 0.26 deg."""
R_FLOOR = 0.03
"""Of R (relative), chosen on seeds 3000 to 3019."""
R_LIMIT = 0.15
"""Largest relative 95 % half width of R: above, it cannot be told from the inverter's error."""
CLEAN_SHARE = 0.6
"""Least share of blocks without a limited sample."""
METHOD = "regression over recorded torque pushes"

Vector = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PushResult:
    """What the pushes tell.

    Attributes
    ----------
    R : Estimate or None
        Loop resistance at the temperature of the run. None when the inverter's error hides it.
    psi_f, L_q, frame_offset : Estimate
        Flux linkage at the temperature of the run, apparent L_q at the pushes' currents, angle of the frame ahead of
        the d axis (rad electrical).
    V_dead_v : float
        Voltage that changes sign with the current (V).
    """

    R: Estimate | None
    psi_f: Estimate
    L_q: Estimate
    frame_offset: Estimate
    V_dead_v: float


@dataclass(frozen=True, slots=True)
class _Rows:
    """Block means of one push."""

    w: Vector
    i_d: Vector
    i_q: Vector
    u_d: Vector
    u_q: Vector
    rate: float = 0.0


def estimate_pushes(
    pushes: Sequence[Trace], *, period_s: float, pole_pairs: int, tolerance: SensorTolerance | None = None
) -> PushResult:
    """Return the estimates.

    Parameters
    ----------
    pushes : sequence of Trace
        ``i_d_a i_q_a u_d_v u_q_v omega_e_rad_s theta_M_rad flagged``; ``meta["delay_doubt_periods"]`` where it is not
        :data:`DELAY_DOUBT_PERIODS`.
    period_s : float
        Control period (s).
    pole_pairs : int
        Pole pairs.
    tolerance : SensorTolerance
        Declared sensor tolerances.

    Raises
    ------
    IdentificationError
        ``E_EXCITATION``, ``E_CLIPPED``, ``E_NOT_IDENTIFIABLE``.
    """
    tolerance = tolerance or SensorTolerance()
    rows = [_rows(push, period_s, pole_pairs) for push in pushes]
    if len(rows) < LEAST_PUSHES:
        raise refuse("E_EXCITATION", f"{len(rows)} pushes, {LEAST_PUSHES} needed", stage=STAGE)
    shapes = np.array([_solve(rows, tail) for tail in TAILS])
    full = shapes.mean(axis=0)
    n = len(rows)
    std = np.sqrt(jackknife_variance(_mean, rows) + shapes.var(axis=0, ddof=1))
    count = sum(len(push.w) for push in rows)

    def estimate(k: int, unit: str, systematic: float) -> Estimate:
        return Estimate(float(full[k]), float(std[k]), float(systematic), unit, n=count, method=METHOD, dof=n - 1.0)

    if not full[1] > 0.0:
        raise refuse("E_EXCITATION", f"the voltage over speed is {full[1]:.3g} Wb", stage=STAGE)
    psi = estimate(1, "Wb", abs(full[1]) * math.hypot(tolerance.flux, PSI_FLOOR))
    if statistical_half_width(psi) > PSI_LIMIT * psi.value:
        raise refuse(
            "E_NOT_IDENTIFIABLE",
            f"psi scatters by {100.0 * statistical_half_width(psi) / psi.value:.2g} % between the pushes, limit "
            f"{100.0 * PSI_LIMIT:g} %",
            stage=STAGE,
            likely="pushes too short or too weak against friction, or a drive that limits its voltage",
        )
    doubt = max(float(push.meta.get(DELAY_DOUBT, DELAY_DOUBT_PERIODS)) for push in pushes)
    delay = full[1] * doubt * period_s * float(np.median([p.rate / abs(p.i_q.mean()) for p in rows]))
    R = estimate(0, "ohm", math.hypot(full[0] * math.hypot(tolerance.impedance, R_FLOOR), delay))
    reactance = full[2] * math.sqrt(float(np.mean(np.concatenate([(p.w * p.i_q) ** 2 for p in rows]))))
    floor = math.hypot(L_Q_FLOOR, L_Q_PER_ERROR * full[4] / reactance)
    return PushResult(
        R=R if total_half_width(R) <= R_LIMIT * abs(R.value) else None,
        psi_f=psi,
        L_q=estimate(2, "H", abs(full[2]) * math.hypot(tolerance.impedance, floor)),
        frame_offset=estimate(3, "rad", FRAME_FLOOR_RAD),
        V_dead_v=float(full[4]),
    )


def _rows(push: Trace, period_s: float, pole_pairs: int) -> _Rows:
    skip = round(SKIP_SHARE * len(push))
    blocks = (len(push) - skip) // BLOCK
    if blocks < 4:
        raise refuse("E_EXCITATION", f"a push of {len(push)} samples is too short", stage=STAGE)

    def means(name: str) -> Vector:
        signal = np.asarray(push[name], dtype=np.float64)[skip : skip + blocks * BLOCK]
        return np.asarray(signal.reshape(blocks, BLOCK).mean(axis=1))

    clean = means("flagged") == 0.0
    if clean.mean() < CLEAN_SHARE:
        raise refuse("E_CLIPPED", f"{100.0 * (1.0 - clean.mean()):.0f} % of a push were limited", stage=STAGE)
    step_s = BLOCK * float(push.t_s[1] - push.t_s[0])
    angle = np.asarray(push["theta_M_rad"], dtype=np.float64)[skip : skip + blocks * BLOCK].reshape(blocks, BLOCK)
    # the mean angle of a block belongs to its middle: differences of neighbours, extrapolated at the ends
    w = pole_pairs * np.gradient(angle.mean(axis=1), step_s)
    w *= math.copysign(1.0, float(w @ means("omega_e_rad_s")))  # an encoder that counts backwards
    rate = float(np.polyfit(np.arange(blocks) * step_s, w, 1)[0])
    w = w + DELAY_PERIODS * period_s * rate
    x = 0.5 * w * period_s
    sampled = np.where(np.abs(x) > 1e-9, x / np.sin(np.where(np.abs(x) > 1e-9, x, 1.0)), 1.0)
    parts = (w, means("i_d_a"), means("i_q_a"), means("u_d_v") * sampled, means("u_q_v") * sampled)
    clean[[0, -1]] = False  # one-sided differences
    w, i_d, i_q, u_d, u_q = (part[clean] for part in parts)
    return _Rows(w, i_d, i_q, u_d, u_q, abs(rate))


def _mean(rows: Sequence[_Rows]) -> Vector:
    return np.asarray(np.mean([_solve(rows, tail) for tail in TAILS], axis=0))


def _solve(rows: Sequence[_Rows], tail: tuple[int, ...]) -> Vector:
    """Return R, psi, L_q, frame offset and V from all blocks together."""
    w, i_d, i_q, u_d, u_q = (
        np.concatenate([getattr(push, name) for push in rows]) for name in ("w", "i_d", "i_q", "u_d", "u_q")
    )
    one, sign = np.ones_like(w), np.sign(i_q)
    tails = [sign / np.abs(i_q) ** power for power in tail]
    R, psi_q, V = regress([i_q, w, sign, one, w * i_d, w * w * i_q, *tails], u_q, what="R, psi and V", stage=STAGE)[:3]
    # R is known by now: its own column would take what belongs to L_q, i_d being small and not free of w i_q
    columns = [w, -w * i_q, one, np.sign(w) * sign, w * sign, w * w]
    psi_d, L_q = regress(columns, u_d - R * i_d, what="psi and L_q", stage=STAGE)[:2]
    return np.array([R, math.hypot(psi_q, psi_d) * math.copysign(1.0, psi_q), L_q, math.atan2(psi_d, psi_q), V])
