"""Numbers of field weakening: weights, step length, rate and overshoot; and the limits of the linear machine.

Section 4 of Jercic et al. 2017 (DOI 10.1080/00051144.2018.1453441), corrected: the voltage ellipse of (33) is centred
at (-psi/L_d, 0).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from pmsmtool.design.design_file import DesignValue, Scalar
from pmsmtool.design.lookup_table import torque_limits
from pmsmtool.design.operating_machine import at_temperature, magnet_flux_at
from pmsmtool.design.ratings import Ratings
from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import MachineParameters

MODES: Mapping[str, int] = {"off": 0, "lookup": 1, "gradient": 2, "accelerated": 3, "uncompensated": 4}
"""``field_weakening.mode`` of the catalogue."""

RATE_HZ = 240.0
"""Rate of the optimisation (the paper's N_FW = 50 at 12 kHz): slow against a current step, fast against the shaft."""

WEIGHT_RATIO = 1.65e-4
"""h2 / (h1 K_t^2): 1e-3 for the machine of the paper; biases the torque by 0.003 N m there."""

STEP = 0.5
"""beta h1 K_t^2: first step length of a gradient step, half the inverse curvature along the torque."""

SIGMA = 0.1
"""Armijo constant of (47)."""

ITERATIONS = 8
"""Steps per call: a warm start on a ramp needs a median of 1 and rarely more than 8."""

STANDSTILL_V = 1e9


@dataclass(frozen=True, slots=True)
class FieldWeakeningDesign:
    """Values of field weakening with facts for the design file.

    Attributes
    ----------
    values : mapping of str to DesignValue
        Catalogue values.
    facts : mapping of str to scalar
        Predicted voltage overshoot and the like.
    ramp_limit_rpm_per_s : float
        Speed slope at which the voltage overshoot between two calls spends the reserve; infinite without a reserve to
        spend or without field weakening.
    """

    values: Mapping[str, DesignValue]
    facts: Mapping[str, Scalar]
    ramp_limit_rpm_per_s: float


def design_field_weakening(source: MachineFile, rated: Ratings, mode: str, margin: float) -> FieldWeakeningDesign:
    """Choose the numbers of field weakening.

    Parameters
    ----------
    source, rated : MachineFile, Ratings
        Machine and its limits.
    mode : str
        A key of ``MODES``.
    margin : float
        Share of V_max kept for control.

    Raises
    ------
    ConfigError
        Unknown mode.
    """
    if mode not in MODES:
        raise ConfigError(f"field-weakening mode {mode!r}, allowed are {', '.join(MODES)}", where="tune")
    i_d_lm = loss_minimising_i_d(source, rated)
    K_t = torque_constant(source.machine, i_d_lm)
    periods = max(1, round(source.inverter.f_s_hz / RATE_HZ))
    every = periods * source.inverter.T_s
    h1, h2, beta = 1.0, WEIGHT_RATIO * K_t**2, STEP / K_t**2
    values = {
        "field_weakening.mode": DesignValue(MODES[mode], f"{mode}, as asked for"),
        "field_weakening.N_fw": DesignValue(periods, f"{RATE_HZ:g} Hz"),
        "field_weakening.margin": DesignValue(margin, "asked for"),
        "field_weakening.h1": DesignValue(h1, "1"),
        "field_weakening.h2": DesignValue(h2, f"{WEIGHT_RATIO:g} h1 K_t^2"),
        "field_weakening.beta": DesignValue(beta, f"{STEP:g} / (h1 K_t^2)"),
        "field_weakening.sigma": DesignValue(SIGMA, "Armijo constant"),
        "field_weakening.iterations": DesignValue(ITERATIONS, "enough for a warm start on a ramp"),
        "field_weakening.i_d_min_a": DesignValue(rated.i_d_min_a, rated.methods["i_d_min"]),
        "field_weakening.i_d_lm_a": DesignValue(i_d_lm, "least current at rated torque"),
    }
    if mode in ("off", "lookup") or rated.base_speed_rpm <= 0.0:
        return FieldWeakeningDesign(values, {}, math.inf)
    limit = ramp_limit_rpm_per_s(rated.base_speed_rpm, every, margin)
    facts: dict[str, Scalar] = {
        "field_weakening_period_s": every,
        "field_weakening_entry_rpm": rated.base_speed_rpm,
        "voltage_overshoot_per_rpm_per_s": overshoot_per_slope(rated.base_speed_rpm, every),
        "ramp_that_spends_the_reserve_rpm_per_s": limit,
    }
    return FieldWeakeningDesign(values, facts, limit)


def overshoot_per_slope(speed_rpm: float, period_s: float) -> float:
    """Return the voltage over V_m, relative, per rpm/s: the speed rises for one period before the next call."""
    return period_s / speed_rpm


def ramp_limit_rpm_per_s(speed_rpm: float, period_s: float, margin: float) -> float:
    """Return the speed slope whose overshoot reaches V_max: margin / (1 - margin) of V_m."""
    return margin / (1.0 - margin) / overshoot_per_slope(speed_rpm, period_s)


def loss_minimising_i_d(source: MachineFile, rated: Ratings) -> float:
    """Return i_d (A) of least current at rated current; positive where L_d > L_q."""
    machine = at_temperature(source.machine, source.flux_map)
    top = torque_limits(machine, [0.0], [STANDSTILL_V], rated.I_nom_apk, rated.i_d_min_a)
    return float(top.largest_i_d_a[0, 0])


def torque_constant(machine: MachineParameters, i_d_a: float) -> float:
    """Return dT/di_q (N m/A) at i_d: 1.5 p (psi + (L_d - L_q) i_d)."""
    saliency = machine.L_d_decoupling_h - machine.L_q_decoupling_h
    return 1.5 * machine.pole_pairs * (machine.psi_f_wb + saliency * i_d_a)


# -- limits of the linear machine without resistance -----------------------------------------------------------


def mtpv(machine: MachineParameters, omega_e: float, V_m: float) -> tuple[float, float]:
    """Return i_d, i_q (A) of the largest torque on the voltage ellipse, whatever the current.

    With F = V_m/|w|, i_d = (F c - psi)/L_d, i_q = F sqrt(1 - c^2)/L_q, c solves
    2 (L_d - L_q) F c^2 + L_q psi c - (L_d - L_q) F = 0.
    """
    L_d, L_q, psi = machine.L_d_decoupling_h, machine.L_q_decoupling_h, machine.psi_f_wb
    F, k = V_m / abs(omega_e), L_d - L_q
    # the root of smaller magnitude, in the form that does not cancel
    c = 2.0 * k * F / (L_q * psi + math.sqrt((L_q * psi) ** 2 + 8.0 * (k * F) ** 2)) if k != 0.0 else 0.0
    return (F * c - psi) / L_d, F * math.sqrt(1.0 - c * c) / L_q


def mtpva(machine: MachineParameters, omega_e: float, V_m: float, I_max: float) -> tuple[float, float] | None:
    """Return i_d, i_q (A) where the voltage ellipse meets the current circle, i_q >= 0; None where it does not.

    (psi + L_d i_d)^2 + L_q^2 (I_max^2 - i_d^2) = (V_m/w)^2, the root of larger i_d.
    """
    L_d, L_q, psi = machine.L_d_decoupling_h, machine.L_q_decoupling_h, machine.psi_f_wb
    F2 = (V_m / omega_e) ** 2
    a, b, c = L_d**2 - L_q**2, 2.0 * psi * L_d, psi**2 + (L_q * I_max) ** 2 - F2
    if abs(a) <= 1e-12 * L_d**2:
        roots = [-c / b] if b != 0.0 else []
    else:
        under = b * b - 4.0 * a * c
        if under < 0.0:
            return None
        q = -0.5 * (b + math.copysign(math.sqrt(under), b))
        roots = [q / a, c / q] if q != 0.0 else [0.0]
    inside = [i_d for i_d in roots if abs(i_d) <= I_max]
    if not inside:
        return None
    i_d = max(inside)
    return i_d, math.sqrt(I_max**2 - i_d * i_d)


def flux_at_temperature(machine: MachineParameters, T_magnet_c: float) -> float:
    """Return psi(T) = psi(T_ref) (1 + alpha_psi (T - T_ref)) (Wb), (36)."""
    return magnet_flux_at(machine, T_magnet_c)
