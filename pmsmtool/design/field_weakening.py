# SPDX-License-Identifier: MIT
"""Numbers of field weakening: weights, step length, rate and overshoot; and the limits of the linear machine.

Section 4 of Jercic et al. 2017 (DOI 10.1080/00051144.2018.1453441), corrected: the voltage ellipse of (33) is centred
at (-psi/L_d, 0).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pmsmtool.design.design_file import DesignValue, Scalar
from pmsmtool.design.lookup.table import torque_limits
from pmsmtool.design.operating_machine import at_temperature
from pmsmtool.design.ratings import Ratings
from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import MachineParameters
from pmsmtool.machine.temperature import magnet_flux_at
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.params.catalogue import FIELD_WEAKENING_MODES
from pmsmtool.units import RPM_PER_RAD_S

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
ROUNDING = 1e-9
"""Share of the rated current below which i_d of least current is rounding: 6e-17 without saliency."""


@dataclass(frozen=True, slots=True)
class FieldWeakeningDesign:
    """Values of field weakening with facts for the design file."""

    values: Mapping[str, DesignValue]
    """Catalogue values."""
    facts: Mapping[str, Scalar]
    """Predicted voltage overshoot and the like."""
    ramp_limit_rpm_per_s: float
    """Speed slope at which the voltage overshoot between two calls spends the reserve; infinite without a reserve to
    spend or without field weakening."""


def design_field_weakening(source: MachineFile, rated: Ratings, mode: str, margin: float) -> FieldWeakeningDesign:
    """Choose the numbers of field weakening. Raises ConfigError: unknown mode.

    Parameters
    ----------
    source, rated : MachineFile, Ratings
        Machine and its limits.
    mode : str
        A key of ``FIELD_WEAKENING_MODES``.
    margin : float
        Share of V_max kept for control.
    """
    if mode not in FIELD_WEAKENING_MODES:
        raise ConfigError(
            f"field-weakening mode {mode!r}, allowed are {', '.join(FIELD_WEAKENING_MODES)}",
            where="tune",
            hint="`pmsmtool tune --help` explains each",
        )
    i_d_lm = loss_minimising_i_d(source, rated)
    K_t = torque_constant(source.machine, i_d_lm)
    periods = max(1, round(source.inverter.f_s_hz / RATE_HZ))
    every = periods * source.inverter.T_s
    h1, h2, beta = 1.0, WEIGHT_RATIO * K_t**2, STEP / K_t**2
    values = {
        "field_weakening.mode": DesignValue(FIELD_WEAKENING_MODES[mode], f"{mode}, as asked for"),
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
    facts = limit_facts(source, rated, (1.0 - margin) * source.inverter.V_max_v)
    if mode in ("off", "lookup") or rated.base_speed_rpm <= 0.0:
        return FieldWeakeningDesign(values, facts, math.inf)
    limit = ramp_limit_rpm_per_s(rated.base_speed_rpm, every, margin)
    facts |= {
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
    i_d = float(top.largest_i_d_a[0, 0])
    return i_d if abs(i_d) > ROUNDING * rated.I_nom_apk else 0.0  # without saliency


def torque_constant(machine: MachineParameters, i_d_a: float) -> float:
    """Return dT/di_q (N m/A) at i_d: 1.5 p (psi + (L_d - L_q) i_d)."""
    saliency = machine.L_d_decoupling_h - machine.L_q_decoupling_h
    return torque_per_ampere(machine.pole_pairs, machine.psi_f_wb + saliency * i_d_a)


# -- where the machine ends ----------------------------------------------------------------------------------------


def limit_facts(source: MachineFile, rated: Ratings, V_m: float) -> dict[str, Scalar]:
    """Return where a constant machine's field weakening ends: MTPVA at n_max, MTPV, the empty set, the hot magnet.

    Nothing of the currents for a machine with a flux map: its look-up table holds these limits cell by cell.
    """
    machine = source.machine
    facts: dict[str, Scalar] = {}
    hot = source.limits.T_magnet_max_c
    if hot is not None:
        facts["psi_f_at_T_magnet_max_wb"] = magnet_flux_at(machine, hot)
    if source.flux_map is not None or machine.psi_f_wb <= 0.0:
        return facts
    facts["characteristic_current_apk"] = machine.psi_f_wb / machine.L_d_decoupling_h
    entry = mtpv_entry_rpm(machine, V_m, rated.I_max_apk)
    facts["mtpv_from_rpm"] = "unreachable: psi/L_d exceeds I_max" if math.isinf(entry) else entry
    empty = empty_above_rpm(machine, V_m, rated.I_max_apk)
    facts["field_weakening_empty_above_rpm"] = "never" if math.isinf(empty) else empty
    top = min(rated.n_max_rpm, MTPVA_SHARE * empty)
    corner = mtpva(machine, top / RPM_PER_RAD_S * machine.pole_pairs, V_m, rated.I_max_apk)
    if corner is not None and top > rated.base_speed_rpm:
        facts |= {"mtpva_speed_rpm": top, "mtpva_i_d_a": corner[0], "mtpva_i_q_a": corner[1]}
    return facts


def mtpv_entry_rpm(machine: MachineParameters, V_m: float, I_max: float) -> float:
    """Return the speed (rpm) from which on the largest torque needs less than I_max; infinite where it never does.

    The MTPV point moves towards (-psi/L_d, 0) as the speed rises: with psi/L_d >= I_max it stays outside the circle.
    """
    if machine.psi_f_wb / machine.L_d_decoupling_h >= I_max:
        return math.inf
    low, high = 0.0, 1.0
    while math.hypot(*mtpv(machine, high, V_m)) > I_max:
        low, high = high, 2.0 * high
    return (
        RPM_PER_RAD_S / machine.pole_pairs * _bisected(lambda w: math.hypot(*mtpv(machine, w, V_m)) > I_max, low, high)
    )


def empty_above_rpm(machine: MachineParameters, V_m: float, I_max: float) -> float:
    """Return the speed (rpm) above which no current within I_max needs as little as V_m, R included; infinite for none.

    The set (44) is empty there: field weakening can only hold the current of the smallest voltage.
    """
    if machine.psi_f_wb / machine.L_d_decoupling_h <= I_max:
        return math.inf
    high = 1.0
    while _least_voltage(machine, high, I_max) <= V_m:
        high *= 2.0
    found = _bisected(lambda w: _least_voltage(machine, w, I_max) <= V_m, 0.5 * high, high)
    return RPM_PER_RAD_S / machine.pole_pairs * found


def _bisected(below: Callable[[float], bool], low: float, high: float) -> float:
    """Return where a condition that holds at ``low`` ends."""
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if below(middle) else (low, middle)
    return high


def _least_voltage(machine: MachineParameters, omega_e: float, I_max: float) -> float:
    """Return the smallest steady-state voltage (V) over |i| <= I_max; the minimum lies on the circle or is zero."""
    R, emf = machine.R_s_ohm, omega_e * machine.psi_f_wb
    X_d, X_q = omega_e * machine.L_d_decoupling_h, omega_e * machine.L_q_decoupling_h
    # normal equations of |M i + c| with M = [[R, -X_q], [X_d, R]], c = [0, emf]; written out: numpy's solve took 40 ms
    g_dd, g_dq, g_qq = R * R + X_d * X_d, R * (X_d - X_q), R * R + X_q * X_q
    pull_d, pull_q = X_d * emf, R * emf

    def point(ridge: float) -> tuple[float, float]:
        a, c = g_dd + ridge, g_qq + ridge
        det = a * c - g_dq * g_dq
        return (g_dq * pull_q - c * pull_d) / det, (g_dq * pull_d - a * pull_q) / det

    if math.hypot(*point(0.0)) <= I_max:
        return 0.0
    largest = math.hypot(pull_d, pull_q) / I_max
    ridge = _bisected(lambda mu: math.hypot(*point(mu)) > I_max, 0.0, largest)
    i_d, i_q = point(ridge)
    return math.hypot(R * i_d - X_q * i_q, X_d * i_d + R * i_q + emf)


MTPVA_SHARE = 0.95
"""The MTPVA point is listed at n_max, or at this share of the speed at which nothing is feasible any more."""

_BISECTIONS = 60

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
