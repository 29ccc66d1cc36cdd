# SPDX-License-Identifier: MIT
"""A drive for judging estimators, written apart from them: many machines at once, small steps, ugly on purpose.

Three phases with an inverter error of a drawn shape per phase current, a current sensor with lag, noise and
quantisation, a sampling instant that may be late, a saturating d axis, a rotor that is held, free or driven.
Integrated in the stator frame with explicit midpoint steps; nothing here knows the estimators' closed forms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from pmsmtool.trace import Trace

Vector = NDArray[np.float64]
ROOT_3 = math.sqrt(3.0)


# Odd shapes with limits +-1, none of which is a finite sum of the estimator's tail terms except by accident.
_SHAPES: tuple[Callable[[Vector], Vector], ...] = (
    lambda x: 2.0 / np.pi * np.arctan(x),
    np.tanh,
    lambda x: np.where(np.abs(x) < 1.0, 0.5 * x, np.sign(x) * (1.0 - 0.5 / np.maximum(np.abs(x), 1.0))),
    lambda x: np.sign(x) * -np.expm1(-np.abs(x)),
    lambda x: x / np.sqrt(1.0 + x * x),
    lambda x: np.minimum(np.maximum(x, -1.0), 1.0),
)
SHAPES = len(_SHAPES)


def inverter_shape(kind: float, x: Vector) -> Vector:
    """One of the shapes."""
    return _SHAPES[int(kind)](x)


def inverter_shapes(kinds: Sequence[tuple[int, NDArray[np.intp]]], x: Vector) -> Vector:
    """The shape of each column of ``x``, given as pairs of shape and columns: only those that occur are computed."""
    if len(kinds) == 1:
        return _SHAPES[kinds[0][0]](x)
    out = np.empty_like(x)
    for kind, columns in kinds:
        out[:, columns] = _SHAPES[kind](x[:, columns])
    return out


def kinds_of(shape: Vector) -> list[tuple[int, NDArray[np.intp]]]:
    """Shapes that occur, with the columns of each."""
    return [(int(kind), np.flatnonzero(shape == kind)) for kind in np.unique(shape)]


@dataclass
class Drives:
    """Arrays of shape (n,), one entry per drive."""

    U_dc: Vector
    I_r: Vector
    T_s: Vector
    R: Vector
    L_d: Vector
    L_q: Vector
    psi: Vector
    p: Vector
    J: Vector
    B: Vector
    tau_c: Vector
    dV: Vector
    drop: Vector
    knee: Vector
    shape: Vector
    lsb: Vector
    adc_noise: Vector
    offset: Vector  # encoder offset error: frame angle minus true d axis (rad electrical)
    encoder_steps: Vector
    lag: Vector
    late: Vector  # sampling instant, fraction of T_s
    bend: Vector  # relative change of L_d per ampere
    w_base: Vector

    @property
    def n(self) -> int:
        return len(self.R)

    @property
    def sigma_dq(self) -> Vector:
        return np.sqrt(2.0 / 3.0 * (self.lsb**2 / 12.0 + self.adc_noise**2))


def draw(n: int, rng: np.random.Generator, *, lag_max: float = 0.0, late_max: float = 0.0) -> Drives:
    """Draw n drives from the population of docs/identification.md, 1."""
    small = rng.random(n) < 0.55

    def pick(a: Vector, b: Vector) -> Vector:
        return np.where(small, a, b)

    def log_uniform(low: float, high: float) -> Vector:
        return np.exp(rng.uniform(math.log(low), math.log(high), n))

    U_dc = pick(rng.choice([24.0, 48.0], n), rng.choice([325.0, 560.0], n))
    I_r = pick(log_uniform(5, 60), log_uniform(3, 25))
    T_s = 1.0 / pick(rng.uniform(16e3, 40e3, n), rng.uniform(8e3, 24e3, n))
    dead_time = pick(rng.uniform(0.1e-6, 0.8e-6, n), rng.uniform(0.5e-6, 3e-6, n))
    w_base = rng.uniform(400, 1600, n)
    emf = rng.uniform(0.6, 0.75, n) * U_dc / ROOT_3
    R = rng.uniform(0.02, 0.12, n) * emf / I_r
    # reactance 20-60 % of the emf at rated current and base speed
    L_d = rng.uniform(0.2, 0.6, n) * emf / (w_base * I_r)
    lsb = 2.0 * rng.uniform(1.8, 3.2, n) * I_r / 4096.0
    p = rng.integers(2, 11, n).astype(float)
    psi = emf / w_base
    return Drives(
        U_dc=U_dc,
        I_r=I_r,
        T_s=T_s,
        R=R,
        L_d=L_d,
        L_q=L_d * rng.uniform(1.0, 2.2, n),
        psi=psi,
        p=p,
        J=1.5 * p * psi * I_r / (w_base / p) * rng.uniform(0.02, 0.1, n),
        B=np.full(n, 0.0),
        tau_c=1.5 * p * psi * I_r * rng.uniform(0.002, 0.02, n),
        dV=U_dc * dead_time / T_s,
        drop=pick(np.zeros(n), rng.uniform(0.3, 1.2, n)),
        knee=rng.uniform(0.005, 0.06, n) * I_r,
        shape=rng.integers(0, SHAPES, n).astype(float),
        lsb=lsb,
        adc_noise=rng.uniform(0.5, 2.0, n) * lsb,
        offset=rng.uniform(-0.1, 0.1, n),
        encoder_steps=np.asarray(2.0 ** rng.integers(12, 20, n), dtype=np.float64),
        lag=rng.uniform(0.0, lag_max, n) if lag_max else np.zeros(n),
        late=rng.uniform(0.0, late_max, n) if late_max else np.zeros(n),
        bend=np.zeros(n),
        w_base=w_base,
    )


def repeat(drives: Drives, times: int) -> Drives:
    """The same drives several times over, so that different runs of all of them share the interpreter's loop."""
    return Drives(**{field.name: np.tile(getattr(drives, field.name), times) for field in fields(Drives)})


def curve_points(d: Drives, k: int) -> tuple[Vector, Vector]:
    """True error of one phase of a drive at the phase currents a level run with fine low levels visits."""
    i = 0.866 * np.concatenate([[0.004, 0.008, 0.015, 0.025, 0.036], np.linspace(0.05, 1.0, 20)]) * d.I_r[k]
    return i, d.dV[k] * inverter_shape(d.shape[k], i / d.knee[k]) + d.drop[k] * np.tanh(i / (0.3 * d.knee[k]))


ABC = np.array([[1.0, 0.0], [-0.5, 0.5 * ROOT_3], [-0.5, -0.5 * ROOT_3]])
"""Phases of a vector (alpha, beta)."""
ALPHA_BETA = np.array([[2.0, -1.0, -1.0], [0.0, ROOT_3, -ROOT_3]]) / 3.0
"""Vector of three phases."""


@dataclass
class Run:
    """What a drive records; arrays of shape (samples, n)."""

    i_d: Vector
    i_q: Vector
    u_d: Vector
    u_q: Vector
    theta: Vector
    omega: Vector

    def trace(self, d: Drives, k: int, skip: int = 0, **meta: object) -> Trace:
        """Trace of one drive."""
        names = {
            "i_d_a": self.i_d,
            "i_q_a": self.i_q,
            "u_d_v": self.u_d,
            "u_q_v": self.u_q,
            "theta_M_rad": self.theta / d.p,
            "omega_e_rad_s": self.omega,
        }
        signals = {name: np.ascontiguousarray(values[skip:, k]) for name, values in names.items()}
        t = np.arange(len(self.i_d) - skip) * d.T_s[k]
        return Trace(t, signals, dict.fromkeys(signals, "1"), {"pole_pairs": d.p[k], **meta})


def run(
    d: Drives,
    rng: np.random.Generator,
    samples: int,
    *,
    frame: Vector | None = None,
    bias_d: Vector | None = None,
    bias_q: Vector | None = None,
    square_d: Vector | None = None,
    square_q: Vector | None = None,
    half_period: int | Vector = 6,
    bandwidth: float = 2.0 * math.pi * 15.0,
    imposed_speed: Vector | None = None,
    free: bool = False,
    substeps: int = 20,
    square_from: int = 0,
) -> Run:
    """Run all drives for ``samples`` periods under current control plus a square wave on the voltage.

    ``frame`` freezes the frame at these true electrical angles (rotor at angle 0 unless free or driven); otherwise the
    frame follows the encoder, which is off by ``d.offset``.
    """
    n = d.n
    zero = np.zeros(n)
    ref_d, ref_q = (zero if b is None else b for b in (bias_d, bias_q))
    sq_d, sq_q = (zero if b is None else b for b in (square_d, square_q))
    theta, omega = np.zeros(n), zero.copy() if imposed_speed is None else imposed_speed.copy()
    # start at the bias: a square wave that has run for a while, not the settling of the loop, is what is looked at
    start = zero if frame is None else frame
    c, s = np.cos(start), np.sin(start)
    i_a, i_b = c * ref_d - s * ref_q, s * ref_d + c * ref_q
    root = np.sqrt(1.0 + 2.0 * d.bend * i_a)
    flux_d = np.where(d.bend > 0.0, (root - 1.0) / np.where(d.bend > 0.0, d.bend, 1.0), i_a) * d.L_d
    i, psi = np.stack([i_a, i_b]), np.stack([d.psi + flux_d, d.L_q * i_b])
    # what is not there is not computed: thousands of steps of a few drives cost what the calls of numpy cost
    turns, lags, drops, kinds = free or imposed_speed is not None, np.any(d.lag), np.any(d.drop), kinds_of(d.shape)

    def lost(phases: Vector) -> Vector:
        error = d.dV * inverter_shapes(kinds, phases / d.knee)
        return error + d.drop * np.tanh(phases / (0.3 * d.knee)) if drops else error

    def currents(psi: Vector, th: Vector) -> Vector:
        if turns:
            c, s = np.cos(th), np.sin(th)
            x_d, x_q = (c * psi[0] + s * psi[1] - d.psi) / d.L_d, (c * psi[1] - s * psi[0]) / d.L_q
        else:  # the rotor is held at angle 0
            x_d, x_q = (psi[0] - d.psi) / d.L_d, psi[1] / d.L_q
        i_d = x_d * (1.0 + 0.5 * d.bend * x_d)
        i = np.empty((2, n))
        i[0], i[1] = (c * i_d - s * x_q, s * i_d + c * x_q) if turns else (i_d, x_q)
        return i

    def derivative(i: Vector, v: Vector) -> Vector:
        return np.asarray(v - ALPHA_BETA @ lost(ABC @ i) - d.R * i)

    lagged = ABC @ i
    u_a, u_b = d.R * i + ALPHA_BETA @ lost(lagged)
    x_d, x_q = c * u_a + s * u_b, c * u_b - s * u_a
    pending_a, pending_b = u_a, u_b
    h = d.T_s / substeps
    half_h = 0.5 * h
    keep = -np.expm1(-h / np.maximum(d.lag, 1e-12))
    late_step = np.round(d.late * substeps).astype(int)
    taken = [bool(np.any(late_step == step)) for step in range(substeps + 1)]
    sample = np.zeros((3, n))
    angle_at_sample, speed = np.zeros(n), omega.copy()
    out = [np.empty((samples, n)) for _ in range(6)]

    for k in range(-1, samples):
        # samples of this period are taken late by up to a fraction of it; the command they give acts one period later
        v = np.stack([pending_a, pending_b])
        for step in range(substeps + 1):
            if step < substeps or k < 0:
                i = currents(psi, theta)
                if taken[step] or k < 0:
                    take = late_step == step
                    lagged = np.where(d.lag > 0.0, lagged, ABC @ i)
                    noisy = lagged + d.adc_noise * rng.standard_normal((3, n))
                    quantised = d.lsb * np.round(noisy / d.lsb)
                    sample = np.where(take, quantised, sample)
                    angle_at_sample = np.where(take, theta, angle_at_sample)
                    speed = np.where(take, omega, speed)
            if step == substeps:
                break
            middle = currents(psi + half_h * derivative(i, v), theta + half_h * omega)
            torque = 1.5 * d.p * (psi[0] * middle[1] - psi[1] * middle[0]) if free else zero
            psi = psi + h * derivative(middle, v)
            if lags:
                lagged = np.where(d.lag > 0.0, lagged + keep * (ABC @ middle - lagged), lagged)
            if imposed_speed is not None:
                theta = theta + h * omega
            elif free:
                friction = d.tau_c * np.tanh(omega / (1e-3 * d.w_base)) + d.B * omega / d.p
                omega = omega + h * d.p * (torque - friction) / d.J
                theta = theta + h * omega
        if k < 0:
            continue
        step_angle = 2.0 * np.pi * d.p / d.encoder_steps
        measured = np.round(angle_at_sample / step_angle) * step_angle
        f = measured + d.offset if frame is None else frame
        sa, sb = ALPHA_BETA @ sample
        c, s = np.cos(f), np.sin(f)
        i_d, i_q = c * sa + s * sb, c * sb - s * sa
        K_d, K_q = bandwidth * d.L_d, bandwidth * d.L_q
        e_d, e_q = ref_d - i_d, ref_q - i_q
        slow = 0.25 * bandwidth**2 * d.T_s  # integral action at a quarter of the bandwidth
        x_d, x_q = x_d + slow * d.L_d * e_d, x_q + slow * d.L_q * e_q
        w_frame = speed if frame is None else zero
        t = k - square_from
        # the first half period is halved: a wave that has been running swings about the bias
        sign = np.where(((t + half_period // 2) // half_period) % 2 == 0, 1.0, -1.0) if t >= 0 else zero
        u_d = x_d + K_d * e_d + sign * sq_d - w_frame * d.L_q * i_q
        u_q = x_q + K_q * e_q + sign * sq_q + w_frame * (d.L_d * i_d + d.psi)
        for store, value in zip(out, (i_d, i_q, u_d, u_q, measured + 0.0, speed), strict=True):
            store[k] = value
        g = f + 1.5 * w_frame * d.T_s
        c, s = np.cos(g), np.sin(g)
        pending_a, pending_b = c * u_d - s * u_q, s * u_d + c * u_q
    return Run(*out)


def level_sequence(magnitudes: Sequence[float]) -> tuple[float, ...]:
    """Order of the levels: + and - alternating, magnitudes up and then down (A)."""
    up = sorted(magnitudes)
    return tuple(sign * value for run in (up, up[::-1]) for value in run for sign in (1.0, -1.0))
