# SPDX-License-Identifier: MIT
"""How far a closed drive's voltage demand can stray from its steady state, for every course of reference and speed.

Nothing is assumed of the reference but that it moves in stairs of a limited height, and of the speed that it changes at
a limited rate; machine constants are anywhere in their intervals. Sampled model at a frozen speed w, rotor
frame, d and q coupled: x = (i, voltage on its way, integrators), z = x - x_ss(w, r) obeys

    z(k+1) = A z(k) + B_r step(k) + B_w (w(k+1) - w(k)) + B_p E z(k),

with E what speed and constants differ from the frozen ones; at age t the speed differs by a t at most.
|z| is bounded by sums of absolute responses (l1 gains), and E z by what |z| itself is bounded by (small gain,
component by component), so that the bound holds for every course, not for those that were tried.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.admissible_set import matrix_exponential
from pmsmtool.errors import DesignInfeasible

Interval = tuple[float, float]

SETTLED, TAIL = 1e-4, 1e-3
"""Responses are summed until ``LOOK`` periods add less than the first (relative); the second is added for the rest:
enough for everything that decays by a tenth in ``LOOK`` periods."""
LOOK = 64
LARGEST_RADIUS = 1.0 - 1e-4
"""Spectral radius from which a loop counts as unstable: a motion slower than 10 000 periods."""
_SPEED_STEP = 1e-2
"""Step of the derivatives by speed (rad/s)."""
ROUNDS, CONVERGED, LARGEST = 200, 1e-6, 1e9
"""Of the small-gain iteration: it converges geometrically or not at all."""


@dataclass(frozen=True, slots=True)
class CurrentLoops:
    """What is known of a closed drive's current control."""

    K_p: tuple[float, float]
    K_i: tuple[float, float]
    """Gains of d and q (V/A, V/(A s))."""
    T_s: float
    """Control period (s)."""
    delay_periods: int = 1
    """Whole periods from the sample to the start of the voltage it leads to (0 or 1)."""
    decoupled: bool = False
    """Whether it adds omega (L i + psi) of its own motor data."""
    stair_s: float = 1e-3
    """Time between two steps of its torque slope (s)."""


@dataclass(frozen=True, slots=True)
class MachineBox:
    """Intervals of the machine's constants: ohm, H, H, Wb."""

    R: Interval
    L_d: Interval
    L_q: Interval
    psi: Interval

    @property
    def middle(self) -> tuple[float, float, float]:
        """R, L_d, L_q in the middle."""
        return tuple(0.5 * (low + high) for low, high in (self.R, self.L_d, self.L_q))  # type: ignore[return-value]


@dataclass(frozen=True, slots=True)
class Sampled:
    """One period of a machine at a constant speed: i+ = Phi i + Gamma u + e psi, shape (..., 2, 2) and (..., 2)."""

    Phi: Array
    Gamma: Array
    e: Array


def sampled_machine(R: Array, L_d: Array, L_q: Array, omega_e: Array, T_s: float) -> Sampled:
    """Return the exact sampled machine under a voltage that is held in the stator frame.

    The frame of the command is turned ahead to the middle of the period in which it acts.
    """
    R, L_d, L_q, w = np.broadcast_arrays(R, L_d, L_q, omega_e)
    F = np.zeros((*w.shape, 5, 5))
    F[..., 0, 0], F[..., 0, 1], F[..., 0, 2] = -R / L_d, w * L_q / L_d, 1.0 / L_d
    F[..., 1, 0], F[..., 1, 1], F[..., 1, 3], F[..., 1, 4] = -w * L_d / L_q, -R / L_q, 1.0 / L_q, -w / L_q
    F[..., 2, 3], F[..., 3, 2] = w, -w
    X = matrix_exponential(F * T_s)
    turn = 0.5 * w * T_s
    rotation = np.stack([np.stack([np.cos(turn), -np.sin(turn)], -1), np.stack([np.sin(turn), np.cos(turn)], -1)], -2)
    return Sampled(X[..., :2, :2], X[..., :2, 2:4] @ rotation, X[..., :2, 4])


def steady_voltage(machine: Sampled, i: Array, psi: Array | float) -> Array:
    """Return the command (V) that holds currents of shape (..., 2), shape (..., 2)."""
    rest = i - (machine.Phi @ i[..., None])[..., 0] - machine.e * np.asarray(psi)[..., None]
    return np.asarray(np.linalg.solve(machine.Gamma, rest[..., None])[..., 0])


@dataclass(frozen=True, slots=True, eq=False)
class SlopeResponse:
    """Sums of absolute responses at m speeds, from which any bound follows.

    Rows of 6: i_d, i_q, u_d and u_q on their way, u_d and u_q demanded.
    """

    omega_e: Array
    """Speeds (rad/s), rising from 0; each stands for all within half a step. Shape (m,)."""
    stair: Array
    """Per ampere of a stair of the reference. Shape (m, 6)."""
    drift: Array
    """Per rad/s2 of acceleration: per ampere of the reference; constant, from the magnet. Shape (m, 6, 2)."""
    push: Array
    aged: Array
    """Of disturbances of the rows of i and of u on the way; ``aged``: each weighted with its age (s).
    Shape (m, 6, 4)."""
    spread: Array
    by_speed: Array
    """|E| of the constants and of half a step of speed; |E| per rad/s. Shape (m, 4, 4)."""
    demanded: Array
    """What half a step of speed changes in the command itself per ampere, where it is decoupled. Shape (m, 2, 2)."""
    steady: Array
    """Steady command (d, q) at all ends of constants, speed step and flux: constant, and per ampere of i_q.
    Shape (m, n, 2, 2)."""
    _way: slice

    def largest_demand(self, I_apk: float, stair_a: float, acceleration: float, speeds: int) -> tuple[Array, float]:
        """Return bounds of the demand and of the current's deviation.

        Parameters
        ----------
        I_apk : float
            Largest |i_q| of the reference (A).
        stair_a : float
            Largest stair of the reference (A).
        acceleration : float
            Largest |d omega_e / dt| (rad/s2).
        speeds : int
            How many speeds may occur, counted from standstill.

        Returns
        -------
        demand : ndarray, shape (speeds,)
            Bound of |u| (V) at each speed; infinite where none was found.
        deviation : float
            Bound of the current's distance from its reference (A).
        """
        here = slice(0, speeds)
        given = self.stair[here] * stair_a + acceleration * (self.drift[here] @ np.array([I_apk, 1.0]))
        loop = self.push[here] @ self.spread[here] + acceleration * (self.aged[here] @ self.by_speed[here])
        z = np.zeros(6)  # at every speed: what is felt now began at another
        done = False
        for _ in range(ROUNDS):
            bound = given + loop @ np.concatenate([z[:2], z[self._way]])
            bound[:, 4:] += (self.demanded[here] @ bound[:, :2, None])[..., 0]
            new = bound.max(axis=0)
            done = bool(np.all(new - z <= CONVERGED * new))
            z = new
            if done or not np.all(z < LARGEST):
                break
        if not done:
            return np.full(speeds, np.inf), np.inf
        steady = self.steady[here]
        ends = np.abs(np.stack([steady[..., 0] + sign * I_apk * steady[..., 1] for sign in (1.0, -1.0)], axis=-2))
        total = np.hypot(*np.moveaxis(ends + bound[:, None, None, 4:], -1, 0))
        return np.asarray(total.max(axis=(1, 2))), float(np.hypot(z[0], z[1]))


@dataclass(frozen=True, slots=True)
class _Model:
    """Closed loop of given machines at given speeds: A, what E is made of, and the steady state."""

    A: Array
    C: Array
    E: Array
    X_r: Array
    X_0: Array  # shape (..., states, 2): at both ends of the flux
    u_r: Array
    u_psi: Array


_STATES = 6
"""i_d, i_q, two voltages on their way, two integrators."""


def _model(constants: Sequence[float], omega: Array, loops: CurrentLoops, own: MachineBox) -> _Model:
    R, L_d, L_q = (np.asarray(value) for value in constants)
    machine = sampled_machine(R, L_d, L_q, omega, loops.T_s)
    w = omega
    shape = omega.shape
    _, own_d, own_q = own.middle
    D = np.zeros((*shape, 2, 2))
    if loops.decoupled:
        D[..., 0, 1], D[..., 1, 0] = -w * own_q, w * own_d
    K_p, K_i = np.diag(loops.K_p), np.diag(loops.K_i)
    C = np.zeros((*shape, 2, _STATES))
    C[..., :2], C[..., 4:] = D - K_p, np.eye(2)
    A = np.zeros((*shape, _STATES, _STATES))
    A[..., :2, :2] = machine.Phi
    if loops.delay_periods:
        A[..., :2, 2:4] = machine.Gamma
    else:
        A[..., :2, :] += machine.Gamma @ C
    A[..., 2:4, :] = C
    A[..., 4:, :2], A[..., 4:, 4:] = -loops.T_s * K_i, np.eye(2)
    E = np.zeros((*shape, 4, 4))
    E[..., :2, :2], E[..., :2, 2:], E[..., 2:, :2] = machine.Phi, machine.Gamma, D
    if not loops.delay_periods:
        E[..., :2, :2] += machine.Gamma @ D
    unit_q = np.array([0.0, 1.0])
    nothing = np.zeros((*shape, 2))
    u_r = steady_voltage(machine, np.broadcast_to(unit_q, (*shape, 2)), np.zeros(shape))
    u_psi = steady_voltage(machine, nothing, np.ones(shape))
    X_r = np.zeros((*shape, _STATES))
    X_r[..., 1], X_r[..., 2:4], X_r[..., 4:] = 1.0, u_r, u_r - D[..., :, 1]
    X_0 = np.zeros((*shape, _STATES, 2))
    forward = w * sum(own.psi) / 2.0 if loops.decoupled else np.zeros(shape)
    for k, psi in enumerate(own.psi):
        X_0[..., 2:4, k] = X_0[..., 4:, k] = psi * u_psi
        X_0[..., 5, k] -= forward
    return _Model(A, C, E, X_r, X_0, u_r, u_psi)


def slope_response(box: MachineBox, loops: CurrentLoops, omega_e_max: float, speeds: int) -> SlopeResponse:
    """Return the responses at ``speeds`` (at least 2) speeds from standstill to ``omega_e_max`` (rad/s).

    Raises DesignInfeasible: the loops do not settle at one of the speeds.
    """
    omega = np.linspace(0.0, omega_e_max, speeds)
    half = 0.5 * float(omega[1])
    at, above = (_model(box.middle, omega + step, loops, box) for step in (0.0, _SPEED_STEP))
    spread = np.zeros_like(at.E)
    steady, columns = [], []
    for corner in itertools.product(box.R, box.L_d, box.L_q):
        for shift in (-half, half):
            there, further = (_model(corner, omega + shift + step, loops, box) for step in (0.0, _SPEED_STEP))
            spread = np.maximum(spread, np.abs(there.E - at.E))
            steady += [np.stack([there.u_psi * psi, there.u_r], axis=-1) for psi in box.psi]
            per_current = (further.X_r - there.X_r) / _SPEED_STEP
            constant = (further.X_0 - there.X_0) / _SPEED_STEP
            columns.append(np.concatenate([there.X_r[..., None], per_current[..., None], constant], axis=-1))
    radius = float(np.abs(np.linalg.eigvals(at.A)).max())
    if radius >= LARGEST_RADIUS:
        raise DesignInfeasible(
            f"the current loop of the drive with fixed firmware is unstable below {omega_e_max:.4g} rad/s",
            where="drive with fixed firmware",
            likely=f"its slowest motion keeps {radius:.6g} of itself per period",
            hint="give the bandwidth its maker's tool shows, or a lower speed",
        )
    pushes = np.broadcast_to(np.eye(_STATES)[:, :4], (speeds, _STATES, 4))
    stairs, plain, aged = _sums(at, np.concatenate([pushes, *columns], axis=-1), loops)
    grouped = plain[..., 4:].reshape(speeds, 6, -1, 4)
    drift = np.stack([grouped[..., 1].max(axis=-1), grouped[..., 2:].max(axis=(-1, -2))], axis=-1)
    by_speed = np.abs(above.E - at.E) / _SPEED_STEP
    return SlopeResponse(
        omega, stairs[..., 4::4].max(axis=-1), loops.T_s * drift, plain[..., :4], aged[..., :4], spread, by_speed,
        half * by_speed[:, 2:, :2], np.stack(steady, axis=1), slice(2, 4) if loops.delay_periods else slice(4, 6),
    )  # fmt: skip


def _sums(at: _Model, columns: Array, loops: CurrentLoops) -> tuple[Array, Array, Array]:
    """Return sums over a period's responses: over every stair's phase the largest, over all, over all with their age.

    Rows: the four first states and the command; shape (m, 6, columns).
    """
    every = max(1, math.floor(loops.stair_s / loops.T_s + 1e-9))
    shape = (len(columns), 6, columns.shape[-1])
    phases, plain, aged = np.zeros((every, *shape)), np.zeros(shape), np.zeros(shape)
    before = np.zeros((2, *shape))
    X = columns
    for k in itertools.count():
        seen = np.abs(np.concatenate([X[..., :4, :], at.C @ X], axis=-2))
        phases[k % every] += seen
        plain += seen
        aged += (k * loops.T_s) * seen
        X = at.A @ X
        if k % LOOK == LOOK - 1:
            both = np.stack([plain, aged])
            if np.all(both - before <= SETTLED * both):
                whole = 1.0 + TAIL
                return whole * phases.max(axis=0), whole * plain, whole * aged
            before = both
    raise AssertionError("not reached: the loops are stable")
