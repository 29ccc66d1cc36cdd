# SPDX-License-Identifier: MIT
"""Design of current control with the voltage amplitude and phase as inputs, for a surface machine.

Miyajima, Fujimoto, Fujitsuna, "Control method for SPMSM in polar coordinates" (2013): v = j V_a exp(j delta), so
v_d = -V_a sin(delta), v_q = V_a cos(delta) (1). Their second page is not available; (3)-(10) are derived here from
L di/dt = v - (R + j omega_e L) i - j omega_e psi_f. The equations have the same form in peak and in power-invariant
quantities as long as V_a, i and psi_f share the scaling; this module is peak, and torque is 1.5 p psi_f i_q.

All of it assumes L_d = L_q: a machine with more saliency than :data:`SALIENCY_LIMIT` is refused.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.errors import DesignInfeasible
from pmsmtool.machine.parameters import MachineParameters
from pmsmtool.machine.torque import torque_per_ampere

SALIENCY_LIMIT = 0.02
"""Largest |L_d - L_q| / mean that is treated as none; 2 % moves the equilibrium current by about 1 % of i_q."""

PHASE_SIGMA_RAD_S = 600.0
AMPLITUDE_SIGMA_RAD_S = 300.0
"""Real parts of the placed poles in the paper's section III (rad/s)."""

CDM_GAMMA = 2.5
"""Stability index of the coefficient diagram method, (32)-(35)."""


@dataclass(frozen=True, slots=True)
class SurfaceMachine:
    """The four numbers the laws need: resistance (ohm), inductance (H), flux linkage (Wb, peak), pole pairs."""

    R_s_ohm: float
    L_s_h: float
    psi_f_wb: float
    pole_pairs: int

    @classmethod
    def of(cls, machine: MachineParameters) -> SurfaceMachine:
        """Return the surface machine behind machine parameters.

        Raises DesignInfeasible: if L_d and L_q differ by more than :data:`SALIENCY_LIMIT`: none of the laws holds then.
        """
        mean = 0.5 * (machine.L_d_h + machine.L_q_h)
        saliency = abs(machine.L_d_h - machine.L_q_h) / mean
        if saliency > SALIENCY_LIMIT:
            raise DesignInfeasible(
                f"control in polar coordinates needs L_d = L_q; they differ by {100 * saliency:.1f} %"
                f" (limit {100 * SALIENCY_LIMIT:.0f} %)",
                where="machine.L_d_h, machine.L_q_h",
                likely="an interior-magnet machine, for which the paper's model does not hold",
                hint="use --controller pi with field weakening, which covers interior machines",
            )
        return cls(machine.R_s_ohm, mean, machine.psi_f_wb, machine.pole_pairs)

    @property
    def alpha(self) -> float:
        """Inverse electrical time constant R/L (rad/s)."""
        return self.R_s_ohm / self.L_s_h

    def impedance(self, omega_e: float) -> complex:
        """R + j omega_e L (ohm)."""
        return complex(self.R_s_ohm, omega_e * self.L_s_h)

    def current_a(self, torque_nm: float) -> float:
        """Return i_q (A peak) for a torque: T / (1.5 p psi_f)."""
        return torque_nm / torque_per_ampere(self.pole_pairs, self.psi_f_wb)


@dataclass(frozen=True, slots=True)
class Equilibrium:
    """A steady state: inputs, currents, and whether the asked torque is reachable at that amplitude."""

    omega_e: float
    V_a: float
    delta: float
    i_d: float
    i_q: float
    reachable: bool

    def residual_a_per_s(self, machine: SurfaceMachine) -> float:
        """Return |di/dt| (A/s) of the machine equation at this state; zero for an exact equilibrium."""
        v = 1j * self.V_a * cmath.exp(1j * self.delta)
        i = complex(self.i_d, self.i_q)
        return abs(v - machine.impedance(self.omega_e) * i - 1j * self.omega_e * machine.psi_f_wb) / machine.L_s_h


def equilibrium_at_amplitude(machine: SurfaceMachine, omega_e: float, i_q: float, V_a: float) -> Equilibrium:
    """Return the stable steady state with amplitude ``V_a`` that carries ``i_q``, (9).

    delta = asin((Z^2 i_q + omega_e R psi_f) / (V_a Z)) - atan2(R, omega_e L). When the torque cannot be reached, the
    state of largest torque at this amplitude is returned and ``reachable`` is False.
    """
    impedance = machine.impedance(omega_e)
    size = abs(impedance)
    sine = (size * size * i_q + omega_e * machine.R_s_ohm * machine.psi_f_wb) / (V_a * size)
    reachable = abs(sine) <= 1.0
    sine = max(-1.0, min(1.0, sine))
    delta = math.asin(sine) - math.atan2(machine.R_s_ohm, omega_e * machine.L_s_h)
    current = (1j * V_a * cmath.exp(1j * delta) - 1j * omega_e * machine.psi_f_wb) / impedance
    return Equilibrium(omega_e, V_a, delta, current.real, current.imag, reachable)


def largest_i_q(machine: SurfaceMachine, omega_e: float, V_a: float) -> float:
    """Return the largest i_q (A peak) that amplitude ``V_a`` holds, at delta = atan2(omega_e L, R)."""
    size = abs(machine.impedance(omega_e))
    return V_a / size - omega_e * machine.R_s_ohm * machine.psi_f_wb / size**2


def equilibrium_without_i_d(machine: SurfaceMachine, omega_e: float, i_q: float, V_max: float) -> Equilibrium:
    """Return the steady state of least loss: i_d = 0 while the voltage suffices, else amplitude ``V_max``."""
    v = machine.impedance(omega_e) * 1j * i_q + 1j * omega_e * machine.psi_f_wb
    if abs(v) > V_max:
        return equilibrium_at_amplitude(machine, omega_e, i_q, V_max)
    return Equilibrium(omega_e, abs(v), math.atan2(-v.real, v.imag) if v else 0.0, 0.0, i_q, True)


def linearised(machine: SurfaceMachine, point: Equilibrium) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return A (2, 2) and B (2, 2) of d(i_d, i_q)/dt = A di + B (dV_a, ddelta), (3)-(6)."""
    s, c = math.sin(point.delta), math.cos(point.delta)
    a = np.array([[-machine.alpha, point.omega_e], [-point.omega_e, -machine.alpha]])
    b = np.array([[-s, -point.V_a * c], [c, -point.V_a * s]]) / machine.L_s_h
    return a, b


@dataclass(frozen=True, slots=True)
class SecondOrderPlant:
    """(n1 s + n0) / (s^2 + d1 s + d0)."""

    n1: float
    n0: float
    d1: float
    d0: float


def phase_plant(machine: SurfaceMachine, point: Equilibrium) -> SecondOrderPlant:
    """Return i_q / delta at an equilibrium (dP22)."""
    plant = amplitude_plant(machine, point)
    return SecondOrderPlant(point.V_a * plant.n1, point.V_a * plant.n0, plant.d1, plant.d0)


def amplitude_plant(machine: SurfaceMachine, point: Equilibrium) -> SecondOrderPlant:
    """Return i_d / V_a at an equilibrium (dP11 = dP22 / V_a)."""
    s, c = math.sin(point.delta), math.cos(point.delta)
    return SecondOrderPlant(
        n1=-s / machine.L_s_h,
        n0=(point.omega_e * c - machine.alpha * s) / machine.L_s_h,
        d1=2.0 * machine.alpha,
        d0=machine.alpha**2 + point.omega_e**2,
    )


@dataclass(frozen=True, slots=True)
class Pid:
    """C(s) = K_p + K_i / s + K_d a s / (s + a)."""

    K_p: float
    K_i: float
    K_d: float
    a: float

    @property
    def numerator(self) -> tuple[float, float, float]:
        """Coefficients b2, b1, b0 of C = (b2 s^2 + b1 s + b0) / (s (s + a))."""
        return self.K_p + self.K_d * self.a, self.K_p * self.a + self.K_i, self.K_i * self.a


def circle_poles(machine: SurfaceMachine, omega_e: float, sigma: float) -> tuple[complex, ...]:
    """Return the four placed poles: two coincident pairs with real part -sigma on the plant's circle.

    |p|^2 = alpha^2 + omega_e^2; below the speed where |p| = sigma the pairs collapse onto -sigma.
    """
    imaginary = math.sqrt(max(0.0, machine.alpha**2 + omega_e**2 - sigma**2))
    return (complex(-sigma, imaginary), complex(-sigma, -imaginary)) * 2


def place_pid(plant: SecondOrderPlant, poles: Sequence[complex]) -> Pid:
    """Return the PID with derivative filter that gives the closed loop the four poles, (7), (8), (11).

    Raises DesignInfeasible: if the placement is singular: the plant's static gain is zero at maximum torque (delta =
    theta).
    """
    c3, c2, c1, c0 = np.real(np.poly(np.asarray(poles)))[1:]
    matrix = np.array(
        [
            [1.0, plant.n1, 0.0, 0.0],
            [plant.d1, plant.n0, plant.n1, 0.0],
            [plant.d0, 0.0, plant.n0, plant.n1],
            [0.0, 0.0, 0.0, plant.n0],
        ]
    )
    try:
        a, b2, b1, b0 = np.linalg.solve(matrix, [c3 - plant.d1, c2 - plant.d0, c1, c0])
    except np.linalg.LinAlgError:
        a = 0.0
    if a == 0.0:
        raise DesignInfeasible(
            "the loop cannot be placed here: its static gain is zero",
            likely="the operating point is at maximum torque for this amplitude (delta = atan(omega_e L / R))",
            hint="design for less torque or more voltage",
        )
    K_i = b0 / a
    K_p = (b1 - K_i) / a
    return Pid(float(K_p), float(K_i), float((b2 - K_p) / a), float(a))


def closed_loop_polynomial(plant: SecondOrderPlant, pid: Pid) -> NDArray[np.float64]:
    """Return the monic characteristic polynomial (5,) of one loop, highest power first."""
    b2, b1, b0 = pid.numerator
    denominator = np.polymul([1.0, plant.d1, plant.d0], [1.0, pid.a, 0.0])
    return np.asarray(np.polyadd(denominator, np.polymul([plant.n1, plant.n0], [b2, b1, b0])), dtype=np.float64)


def two_input_eigenvalues(
    machine: SurfaceMachine, point: Equilibrium, phase: Pid, amplitude: Pid
) -> NDArray[np.complex128]:
    """Return the eigenvalues (6,) of the true loop: both PIDs on the coupled plant.

    The two single-loop designs ignore the cross terms; these are the poles the drive will really have.
    """
    a, b = linearised(machine, point)
    system = np.zeros((6, 6))
    system[:2, :2] = a
    # u = C e with e = -i: integrator state x' = e, filter state z' = -a z + e, u = K_p e + K_i x + K_d a (e - a z)
    loops = ((0, 0, amplitude), (1, 1, phase))
    for column, axis, pid in loops:
        integrator, lowpass = 2 + 2 * column, 3 + 2 * column
        direct = pid.K_p + pid.K_d * pid.a
        system[:2, axis] -= b[:, column] * direct
        system[:2, integrator] += b[:, column] * pid.K_i
        system[:2, lowpass] -= b[:, column] * pid.K_d * pid.a**2
        system[integrator, axis] -= 1.0
        system[lowpass, axis] -= 1.0
        system[lowpass, lowpass] -= pid.a
    return np.linalg.eigvals(system).astype(np.complex128)


@dataclass(frozen=True, slots=True)
class CdmGains:
    """PI gains of the linear-range control, (28)-(31): q axis acts on V_a, d axis on delta."""

    K_P21: float
    K_I21: float
    K_P12: float
    K_I12: float


def cdm_gains(machine: SurfaceMachine, V_a: float, delta: float, V_max: float, T_s: float, tau_s: float) -> CdmGains:
    """Return the gains of the coefficient diagram method at one operating point, (24)-(37).

    a1 = gamma / tau, a0 = gamma / tau^2. Near zero voltage the d axis is slowed down by (37):
    tau_12 = 0.1 V_max / |V_a cos(delta)| T_s when |V_a cos(delta)| < 0.01 V_max.
    """
    sign = -1.0 if V_a < 0.0 else 1.0
    V_a = sign * max(abs(V_a), 0.001 * V_max)  # (39): kept away from zero, with its sign
    cosine = math.cos(max(-0.45 * math.pi, min(0.45 * math.pi, delta)))  # (38)
    level = abs(V_a * cosine) / V_max
    tau_12 = 0.1 / level * T_s if level < 0.01 else tau_s

    def pair(tau: float, gain: float) -> tuple[float, float]:
        return (CDM_GAMMA / tau * machine.L_s_h - machine.R_s_ohm) / gain, CDM_GAMMA / tau**2 * machine.L_s_h / gain

    K_P21, K_I21 = pair(tau_s, cosine)
    K_P12, K_I12 = pair(tau_12, -V_a * cosine)
    return CdmGains(K_P21, K_I21, K_P12, K_I12)


@dataclass(frozen=True, slots=True)
class Conditioning:
    """How well the two inputs span the plane at one operating point."""

    V_a: float
    condition: float
    relative_gain_dc: float
    relative_gain_high: float
    zero_rad_s: float
    reachable: bool


def conditioning(machine: SurfaceMachine, omega_e: float, torque_nm: float, V_max: float) -> Conditioning:
    """Return condition number and relative gains at a speed and torque.

    cond(B diag(V_max, 1)) = V_max / V_a exactly: infinite at zero voltage only. The relative gain is that of the
    pairing (i_d <- V_a, i_q <- delta): cos^2(delta + phi) at DC, sin^2(delta) at high frequency.
    """
    point = equilibrium_without_i_d(machine, omega_e, machine.current_a(torque_nm), V_max)
    phi = math.atan2(machine.R_s_ohm, omega_e * machine.L_s_h)
    tangent = math.tan(point.delta)
    return Conditioning(
        V_a=point.V_a,
        condition=V_max / point.V_a if point.V_a > 0.0 else math.inf,
        relative_gain_dc=math.cos(point.delta + phi) ** 2,
        relative_gain_high=math.sin(point.delta) ** 2,
        zero_rad_s=omega_e / tangent - machine.alpha if tangent != 0.0 else math.inf,
        reachable=point.reachable,
    )


@dataclass(frozen=True, slots=True)
class PolarDesign:
    """The gains at the design point, with what the true two-input loop makes of them."""

    point: Equilibrium
    phase: Pid
    amplitude: Pid
    slowest_rad_s: float
    stable: bool


def design_at(
    machine: SurfaceMachine,
    omega_e: float,
    i_q: float,
    V_max: float,
    sigma_phase: float = PHASE_SIGMA_RAD_S,
    sigma_amplitude: float = AMPLITUDE_SIGMA_RAD_S,
) -> PolarDesign:
    """Return the placed loops at an operating point and the stability of both together.

    Raises DesignInfeasible: if the torque is out of reach at ``V_max`` (A peak, V peak, rad/s electrical).
    """
    point = equilibrium_without_i_d(machine, omega_e, i_q, V_max)
    if not point.reachable:
        raise DesignInfeasible(
            f"i_q = {i_q:.4g} A cannot be reached at {omega_e:.4g} rad/s with {V_max:.4g} V",
            hint=f"ask for at most {point.i_q:.4g} A at this speed",
        )
    phase = place_pid(phase_plant(machine, point), circle_poles(machine, omega_e, sigma_phase))
    amplitude = place_pid(amplitude_plant(machine, point), circle_poles(machine, omega_e, sigma_amplitude))
    slowest = float(np.max(two_input_eigenvalues(machine, point, phase, amplitude).real))
    return PolarDesign(point, phase, amplitude, slowest, slowest < 0.0)
