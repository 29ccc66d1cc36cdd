"""Inertia, viscous and Coulomb friction: whitened output-error fit on the encoder's position (reference, 3.5).

    J dw/dt = T_e - B w - T_c sgn(w), with stick-slip

Pushes by a known current, and coasting with the voltage off; each trace has its own first position and speed. The
measured currents drive the model, so their noise is torque noise, a random walk in speed. The residual of the
position is whitened with Sigma = s_theta^2 I + s_T^2 G G', G_kj = (k - j - 1/2) T^2/J for j < k; without it friction
wanders by several standard deviations. Every interval is solved in closed form, with the instant of a reversal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.estimators.estimate import SensorTolerance, chi2_gate, condition_gate, information_bound
from pmsmtool.estimators.least_squares import RELATIVE_STEP, Fit, levenberg_marquardt, linear_solve
from pmsmtool.estimators.refusals import refuse
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

Array = NDArray[np.float64]
Torque = Callable[[Array, Array], Array]
"""Torque (N m) of arrays of i_d, i_q (A)."""

STAGE = "mechanics"
BLOCKS = 400
"""Positions of a trace in the fit; the currents between two are averaged."""
TRACES_LEAST = 4
"""A push and a coasting in each direction."""
ENCODER_STEPS_LEAST = 200
"""Way of the shaft in encoder steps below which the run says nothing."""
REPEATS = 2
"""Fits; the second whitens with the inertia of the first."""
TORQUE_FLOOR = 1e-3
"""Deviation of a block's torque beyond the noise of the currents, of the push's: ripple that samples do not show."""
SCALE_FLOOR = 5e-4
"""Relative deviation of the torque's scale beyond that of the flux linkage: the sample of a switched current is not its
mean. Largest error of J over twelve random drives, that of the flux linkage included: 0.0031, inside its interval."""
SMALLEST_DECAY = 1e-9
"""B T/J below which an interval is a parabola."""
ROUNDING_RAD = 1e-6
"""Of a position recorded in binary32."""
METHOD = "pushes and coasting, output error on position, whitened"


@dataclass(frozen=True, slots=True)
class MechanicsResult:
    """What a run of current steps says of the shaft.

    Attributes
    ----------
    J, B, tau_c : Estimate
        Inertia (kg m2), viscous (N m s) and Coulomb friction (N m).
    chi2 : float
        Reduced chi-square of the whitened position.
    condition : float
        Condition number of the scaled, whitened Jacobian.
    """

    J: Estimate
    B: Estimate
    tau_c: Estimate
    chi2: float
    condition: float


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """Blocks of one run: positions (n + 1,), mean torques (n,), period, and the deviations of both."""

    theta: Array
    torque: Array
    T: float
    theta_std: float
    torque_std: float


def estimate_mechanics(
    runs: Sequence[Trace],
    torque: Torque,
    torque_per_a: float,
    sigma_a: float,
    scale_std: float,
    *,
    direction: int = 1,
    tolerance: SensorTolerance | None = None,
) -> MechanicsResult:
    """Estimate inertia and friction.

    Parameters
    ----------
    runs : sequence of Trace
        ``i_d_a i_q_a theta_M_rad flagged`` of pushes and coasting in both directions, in the frame of the d axis;
        ``meta["coasting"]``: no torque.
    torque : callable
        Torque of the currents, by flux linkage or flux map at the temperature of the run.
    torque_per_a : float
        Its slope over i_q (N m/A), for the noise.
    sigma_a : float
        Noise of one sample of i_q (A).
    scale_std : float
        Relative standard deviation of that torque's scale: it goes into all three one to one.
    direction : int
        Sign of the encoder's count along the phase order.
    tolerance : SensorTolerance
        Declared sensor tolerances.

    Raises
    ------
    IdentificationError
        ``E_CLIPPED``, ``E_EXCITATION``, ``E_NOT_IDENTIFIABLE``, ``E_NOT_CONVERGED``, ``E_MODEL_MISMATCH``.
    """
    tolerance = tolerance or SensorTolerance()
    if len(runs) < TRACES_LEAST:
        raise refuse("E_EXCITATION", f"{len(runs)} traces, {TRACES_LEAST} needed", stage=STAGE)
    flagged = sum(int(np.sum(run["flagged"] > 0.0)) for run in runs if not run.meta["coasting"])
    if flagged:
        raise refuse("E_CLIPPED", f"{flagged} samples of the run are limited or clipped", stage=STAGE)
    step = _encoder_step([run["theta_M_rad"] for run in runs])
    blocks = [_blocks(run, torque, torque_per_a, sigma_a, direction, step) for run in runs]
    start = _start(blocks)
    fit, chi2 = _fit(blocks, start)
    if not fit.converged:
        raise refuse("E_NOT_CONVERGED", f"{fit.iterations} steps without a minimum", stage=STAGE)
    bound, condition = information_bound(fit.jacobian)
    condition_gate(condition, "B and tau_c", STAGE)
    _, widen = chi2_gate(chi2, STAGE)
    J, B, tau_c = math.exp(fit.x[0]), float(fit.x[1]), float(fit.x[2])
    stds = (J * float(bound[0]) * widen, float(bound[1]) * widen, float(bound[2]) * widen)
    n = sum(len(block.theta) for block in blocks)
    scale_std = math.hypot(scale_std, SCALE_FLOOR)
    estimates = [
        Estimate(
            value,
            math.hypot(std, scale_std * value),
            tolerance.inertia * abs(value),
            unit,
            n=n,
            chi2=chi2,
            method=METHOD,
        )
        for value, std, unit in zip((J, B, tau_c), stds, ("kg m2", "N m s", "N m"), strict=True)
    ]
    return MechanicsResult(estimates[0], estimates[1], estimates[2], chi2, condition)


def _encoder_step(positions: Sequence[Array]) -> float:
    """Return one step of the encoder (rad), from second differences: of a turning shaft every first one is many."""
    seconds = [np.abs(np.diff(theta, 2)) for theta in positions]
    limits = [ROUNDING_RAD * max(1.0, float(np.max(np.abs(theta)))) for theta in positions]
    steps = np.concatenate([second[second > limit] for second, limit in zip(seconds, limits, strict=True)])
    step = float(np.min(steps)) if len(steps) else 0.0
    way = min(float(np.ptp(theta)) for theta in positions)
    if step == 0.0 or way < ENCODER_STEPS_LEAST * step:
        raise refuse(
            "E_EXCITATION",
            f"the shaft turned by {way:.3g} rad during a trace, {ENCODER_STEPS_LEAST} steps of the encoder are needed",
            stage=STAGE,
            likely="a held shaft, much friction, or a speed limit that leaves no motion",
        )
    return step


def _blocks(run: Trace, torque: Torque, torque_per_a: float, sigma_a: float, direction: int, step: float) -> _Run:
    rows = max(1, (len(run) - 1) // BLOCKS)
    count = (len(run) - 1) // rows
    theta = direction * run["theta_M_rad"][: count * rows + 1 : rows]
    if run.meta["coasting"]:
        return _Run(theta, np.zeros(count), rows * run.period_s, step / math.sqrt(12.0), 0.0)
    tau = torque(run["i_d_a"], run["i_q_a"])
    mean = (0.5 * (tau[:-1] + tau[1:]))[: count * rows].reshape(count, rows).mean(axis=1)
    noise = math.hypot(abs(torque_per_a) * sigma_a / math.sqrt(rows), TORQUE_FLOOR * float(np.max(np.abs(mean))))
    return _Run(theta, mean, rows * run.period_s, step / math.sqrt(12.0), noise)


def _start(runs: Sequence[_Run]) -> Array:
    """Return ln J, B, tau_c and each trace's first position and speed, from a regression of torque on motion."""
    rows, torques, states = [], [], []
    for run in runs:
        t = run.T * np.arange(len(run.theta))
        # a parabola follows a push or a coasting closely enough for a start; halves of it tell the friction's slope
        for part in (slice(0, len(t) // 2), slice(len(t) // 2, None)):
            a, b, _ = np.polyfit(t[part], run.theta[part], 2)
            omega = b + 2.0 * a * float(np.mean(t[part]))
            rows.append([2.0 * a, omega, math.copysign(1.0, omega)])
            torques.append(float(np.mean(run.torque[part])))
        first = np.polyfit(t[: len(t) // 4], run.theta[: len(t) // 4], 2)
        states += [run.theta[0], float(first[1])]
    x, _, _, _ = linear_solve(np.array(rows), np.array(torques), np.ones(len(rows)))
    if not x[0] > 0.0:
        raise refuse("E_NOT_IDENTIFIABLE", f"J = {x[0]:.3g} kg m2", stage=STAGE, likely="the shaft is held or driven")
    return np.array([math.log(x[0]), x[1], max(x[2], 0.0), *states])


def _fit(runs: Sequence[_Run], start: Array) -> tuple[Fit, float]:
    speed = max(float(np.max(np.abs(np.diff(run.theta)))) / run.T for run in runs)
    largest = max(float(np.max(np.abs(run.torque))) for run in runs)
    scale = np.array([1.0, largest / speed, largest, *(value for run in runs for value in (1.0, speed))])
    x = start
    for _ in range(REPEATS):
        problem = _Problem(runs, [_whitener(run, math.exp(float(x[0]))) for run in runs], RELATIVE_STEP * scale)
        fit = levenberg_marquardt(problem.residual, x, scale, cost_tolerance=1e-4, derivative=problem.jacobian)
        x = fit.x
    return fit, fit.cost / fit.dof


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Whitened residual of all traces; a trace knows the three common parameters and its own two."""

    runs: Sequence[_Run]
    factors: Sequence[Array]
    step: Array

    def of_run(self, k: int, x: Array) -> Array:
        """Whitened residual of one trace."""
        run = self.runs[k]
        own = np.append(x[:3], x[3 + 2 * k : 5 + 2 * k])
        return np.asarray(self.factors[k] @ (positions(run.torque, run.T, own) - run.theta))

    def residual(self, x: Array) -> Array:
        """Whitened residual, shape (n,)."""
        return np.concatenate([self.of_run(k, x) for k in range(len(self.runs))])

    def jacobian(self, x: Array) -> Array:
        """Its derivative by central differences, shape (n, k)."""
        blocks = []
        for k, run in enumerate(self.runs):
            block = np.zeros((len(run.theta), len(x)))
            for column in (0, 1, 2, 3 + 2 * k, 4 + 2 * k):
                plus, minus = x.copy(), x.copy()
                plus[column] += self.step[column]
                minus[column] -= self.step[column]
                change = self.of_run(k, plus) - self.of_run(k, minus)
                block[:, column] = change / (plus[column] - minus[column])
            blocks.append(block)
        return np.concatenate(blocks)


def _whitener(run: _Run, J: float) -> Array:
    """Return the inverse of the Cholesky factor of the position residual's covariance."""
    n = len(run.theta)
    lag = np.arange(n)[:, None] - np.arange(n - 1)[None, :] - 0.5
    G = np.where(lag > 0.0, lag, 0.0) * run.T**2 / J
    covariance = run.theta_std**2 * np.eye(n) + run.torque_std**2 * (G @ G.T)
    factor = np.linalg.cholesky(covariance)
    return np.asarray(np.linalg.inv(factor))


def positions(torque: Array, T: float, x: Array) -> Array:
    """Return the positions (rad) at the ends of intervals of constant torque, shape (n + 1,).

    Parameters
    ----------
    torque : ndarray, shape (n,)
        Mean torque of each interval (N m).
    T : float
        Length of an interval (s).
    x : ndarray, shape (5,)
        ln J, B, tau_c, first position and first speed.
    """
    J, B, tau_c = math.exp(float(x[0])), float(x[1]), float(x[2])
    theta, omega = float(x[3]), float(x[4])
    out = np.empty(len(torque) + 1)
    out[0] = theta
    for k, tau in enumerate(torque.tolist()):
        left = T
        while left > 0.0:
            if omega == 0.0 and abs(tau) <= tau_c:
                break
            sign = math.copysign(1.0, omega if omega != 0.0 else tau)
            drive = tau - tau_c * sign
            stop = _stops_after(omega, drive, B, J)
            step = left if not 0.0 < stop < left else stop
            way, end = _coast(omega, drive, B, J, step)
            theta += way
            omega = 0.0 if step == stop else end
            left -= step
        out[k + 1] = theta
    return out


def _coast(omega: float, drive: float, B: float, J: float, t: float) -> tuple[float, float]:
    """Return way and final speed after a time of constant net torque."""
    decay = B * t / J
    if abs(decay) < SMALLEST_DECAY:
        return omega * t + 0.5 * drive / J * t * t, omega + drive / J * t
    final = drive / B
    gone = -math.expm1(-decay)
    return final * t + (omega - final) * gone * J / B, omega + (final - omega) * gone


def _stops_after(omega: float, drive: float, B: float, J: float) -> float:
    """Return when the speed comes to zero (s), infinity when it does not."""
    if omega * drive >= 0.0:
        return math.inf
    ratio = B * omega / drive  # negative where the torque opposes the motion
    if abs(ratio) < SMALLEST_DECAY:
        return -omega * J / drive
    return math.log1p(-ratio) * J / B if ratio < 1.0 else math.inf
