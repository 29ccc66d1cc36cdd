# SPDX-License-Identifier: MIT
"""Parameters of control in polar coordinates (``polar.py``): which law, its speeds, and what the true loop makes of it.

The times are those of Miyajima et al. 2013 and of the laws built on it, in control periods: they were found at 0.1 ms.
Section IV.A there: the inputs (V_a, delta) span the current plane wherever V_a is not zero. Here with numbers, over
speed and torque: how well they span it, what the two single-loop designs make of the coupled machine, how far gains go.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.design_file import DesignValue, Scalar
from pmsmtool.design.polar import (
    AMPLITUDE_SIGMA_RAD_S,
    CDM_GAMMA,
    PHASE_SIGMA_RAD_S,
    Equilibrium,
    PolarDesign,
    SurfaceMachine,
    cdm_gains,
    conditioning,
    design_at,
    largest_i_q,
    linearised,
)
from pmsmtool.design.ratings import Ratings
from pmsmtool.design.tune_request import LINEAR_RANGE, ON_MEASUREMENT, PHASE_LAWS, POLAR_LAWS, PREDICT, SURFACE_ONLY
from pmsmtool.errors import DesignInfeasible
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.units import RAD_S_PER_RPM, RPM_PER_RAD_S

TAU_PERIODS = 10.0
"""Equivalent time constant of the coefficient diagram method, in control periods."""

OMEGA_C_PER_PERIOD, OMEGA_DOB_PER_PERIOD = 0.125, 0.04
"""Bandwidths of the unified law and of its observer times T_s: 1250 and 400 rad/s at 0.1 ms."""

V_REF_RATIO = 0.97
"""Reference amplitude of the unified law over V_max: smoother torque on speed ramps than 1."""

NEEDS_SWITCH = (
    "polar: the phase is no input for i_q at standstill; inside the voltage limit the drive switches to the"
    " regularised law (polar.options, bit 3), whose transition shows in the torque; the unified law has none"
)
LINEAR_ONLY = (
    "polar: a law of the linear range without a table of currents; where the voltage limit is reached it loses torque,"
    " above base speed down to the wrong sign"
)

MAP_SPEED_SHARES = (0.25, 0.5, 0.75, 1.0)
MAP_CURRENT_SHARES = (-1.0, -0.5, 0.1, 0.5, 1.0)
"""Grid over base speed and rated current on which the true loops are judged."""

DESIGN_SPEED_SHARE = 0.8
"""Speed at which the placed loops are looked at, over base speed: inside the linear range, voltage well above zero."""

RANK_TOLERANCE = 1e-9
"""A direction counts as reached when its singular value exceeds this share of the largest."""


def weakening_mode(source: MachineFile, law: str) -> str:
    """Return the mode of field weakening that suits a law: ``lookup`` or ``off``.

    The laws of the linear range need the table's i_d. The unified law weakens the field of a surface machine best
    itself, at full voltage; with L_d != L_q or saturation the table knows the current of least loss, and beyond the
    largest i_q of the voltage ellipse the way to the maximum torque per volt.
    """
    if law in PHASE_LAWS:
        return "off"
    if law == "unified" and source.flux_map is None and _surface(source) is not None:
        return "off"
    return "lookup"


def _surface(source: MachineFile) -> SurfaceMachine | None:
    try:
        return SurfaceMachine.of(source.machine)
    except DesignInfeasible:
        return None


def polar_values(
    source: MachineFile, rated: Ratings, law: str, weakening: str
) -> tuple[dict[str, DesignValue], dict[str, Scalar], tuple[str, ...]]:
    """Return catalogue values, facts and notes of a polar law.

    Raises DesignInfeasible: a law of the paper on a machine with L_d != L_q.

    Parameters
    ----------
    source, rated : MachineFile, Ratings
        Machine and its limits.
    law : str
        A key of :data:`tune_request.POLAR_LAWS`.
    weakening : str
        Mode of field weakening that was designed; other than ``lookup`` it is switched off.
    """
    T_s = source.inverter.T_s
    surface = SurfaceMachine.of(source.machine) if law in SURFACE_ONLY else _surface(source)
    options, how = _options(source.inverter.delay_periods, law)
    values = {
        "polar.mode": DesignValue(POLAR_LAWS[law], f"{law}, as asked for"),
        "polar.options": DesignValue(options, how),
        "polar.sigma_phase_rad_s": DesignValue(PHASE_SIGMA_RAD_S, "real part of the placed poles"),
        "polar.sigma_amplitude_rad_s": DesignValue(AMPLITUDE_SIGMA_RAD_S, "real part of the placed poles"),
        "polar.tau_s": DesignValue(TAU_PERIODS * T_s, f"{TAU_PERIODS:g} T_s"),
        "polar.gamma": DesignValue(CDM_GAMMA, "coefficient diagram method"),
        "polar.omega_c_rad_s": DesignValue(OMEGA_C_PER_PERIOD / T_s, f"{OMEGA_C_PER_PERIOD:g} / T_s"),
        "polar.omega_dob_rad_s": DesignValue(OMEGA_DOB_PER_PERIOD / T_s, f"{OMEGA_DOB_PER_PERIOD:g} / T_s"),
        "polar.V_ref_ratio": DesignValue(V_REF_RATIO, "smoother on ramps than full voltage"),
        # the laws weaken the field by themselves, and a governed reference is not theirs
        "governor.mode": DesignValue(0, "off: the polar law limits the voltage itself"),
    }
    if weakening != "lookup":
        values["field_weakening.mode"] = DesignValue(0, "off: the polar law weakens the field itself")
    notes: tuple[str, ...] = (NEEDS_SWITCH,) if law in PHASE_LAWS else ()
    if law not in PHASE_LAWS and law != "unified" and weakening != "lookup":
        notes = (LINEAR_ONLY,)
    if surface is None:
        differ = "polar: L_d and L_q differ; the placed loops of the paper do not apply, the law does"
        return values, {}, (differ, *notes)
    return values, _facts(surface, rated, source.inverter.V_max_v), notes


def _options(delay_periods: float, law: str) -> tuple[int, str]:
    options, parts = ON_MEASUREMENT, ["P and D on the measurement"]
    if delay_periods >= 1.0:
        options, parts = options | PREDICT, [*parts, "prediction over the delay"]
    if law in PHASE_LAWS:
        options, parts = options | LINEAR_RANGE, [*parts, "regularised law inside the voltage limit"]
    return options, ", ".join(parts)


def _facts(surface: SurfaceMachine, rated: Ratings, V_max: float) -> dict[str, Scalar]:
    """The placed loops at the design point, both together on the coupled plant."""
    omega = DESIGN_SPEED_SHARE * rated.base_speed_rpm / RPM_PER_RAD_S * surface.pole_pairs
    if omega <= 0.0:
        return {}
    found = design_at(surface, omega, rated.I_nom_apk, V_max)
    per_ampere = torque_per_ampere(surface.pole_pairs, surface.psi_f_wb)
    torque = per_ampere * rated.I_nom_apk
    speeds = [share * rated.base_speed_rpm for share in MAP_SPEED_SHARES]
    torques = [share * torque for share in MAP_CURRENT_SHARES]
    slowest = stability_map(surface, V_max, speeds, torques)
    linear_range = slowest[~np.isnan(slowest)]
    anywhere = {"polar_slowest_pole_anywhere_rad_s": float(linear_range.max())} if len(linear_range) else {}
    return {
        "polar_V_a_max_v": V_max,
        "polar_largest_torque_nm": per_ampere * largest_i_q(surface, omega, V_max),
        **anywhere,
        "polar_design_speed_rpm": DESIGN_SPEED_SHARE * rated.base_speed_rpm,
        "polar_two_input_stable": found.stable,
        "polar_slowest_pole_rad_s": found.slowest_rad_s,
        "polar_condition": conditioning(surface, omega, torque, V_max).condition,
    }


def controllable(machine: SurfaceMachine, point: Equilibrium) -> bool:
    """Return whether [B, AB] has rank 2: lost only where V_a = 0 and omega_e = 0.

    A alone turns the direction that V_a moves, so that a turning machine stays controllable at zero voltage, through
    V_a only and slowly; (13) of the paper looks at B alone.
    """
    a, b = linearised(machine, point)
    values = np.linalg.svd(np.hstack([b, a @ b]), compute_uv=False)
    return bool(values[1] > RANK_TOLERANCE * values[0])


def condition_map(
    machine: SurfaceMachine, V_max: float, speed_rpm: Sequence[float] | Array, torque_nm: Sequence[float] | Array
) -> Array:
    """Return V_max / V_a in the steady states of least loss, shape (n, m).

    Infinite without voltage, NaN out of reach.
    """
    condition = np.full((len(speed_rpm), len(torque_nm)), np.nan)
    for k, rpm in enumerate(speed_rpm):
        for n, torque in enumerate(torque_nm):
            found = conditioning(machine, float(rpm) * RAD_S_PER_RPM * machine.pole_pairs, float(torque), V_max)
            if found.reachable:
                condition[k, n] = found.condition
    return condition


def share_above(condition: Array, limit: float) -> float:
    """Return the share of the reachable points whose condition number exceeds a limit."""
    return float(np.mean(condition[~np.isnan(condition)] > limit))


def stability_map(
    machine: SurfaceMachine, V_max: float, speed_rpm: Sequence[float] | Array, torque_nm: Sequence[float] | Array
) -> Array:
    """Return the real part of the slowest pole of the true two-input loop (rad/s), shape (n, m).

    The single-loop designs promise -600 (phase) and -300 rad/s (amplitude). NaN out of reach, and in field weakening,
    where the amplitude rests at its limit and the phase loop, alone, has the poles it was placed with.
    """
    slowest = np.full((len(speed_rpm), len(torque_nm)), np.nan)
    for k, rpm in enumerate(speed_rpm):
        for n, torque in enumerate(torque_nm):
            found = design_or_none(machine, V_max, float(rpm), float(torque))
            if found is not None and found.point.V_a < V_max:
                slowest[k, n] = found.slowest_rad_s
    return slowest


def design_or_none(machine: SurfaceMachine, V_max: float, rpm: float, torque_nm: float) -> PolarDesign | None:
    """Return the placed loops at a point, None where the torque is out of reach or the loop has no static gain."""
    try:
        return design_at(
            machine,
            rpm * RAD_S_PER_RPM * machine.pole_pairs,
            machine.current_a(torque_nm),
            V_max,
            PHASE_SIGMA_RAD_S,
            AMPLITUDE_SIGMA_RAD_S,
        )
    except DesignInfeasible:
        return None


@dataclass(frozen=True, slots=True)
class ScheduledGains:
    """Gains at one operating point; a current is A peak, a voltage V peak."""

    rpm: float
    torque_nm: float
    """The point."""
    phase: tuple[float, float, float, float]
    amplitude: tuple[float, float, float, float]
    """K_p, K_i, K_d and a of the PIDs."""
    K_P21: float
    K_I21: float
    K_P12: float
    K_I12: float
    """PI gains of the linear range, (28)-(31)."""
    direct_phase: float
    """Gain of the phase PID at high frequency, K_p + K_d a (rad/A): what a step of the reference kicks with."""


def gain_schedule(
    machine: SurfaceMachine, V_max: float, T_s: float, points: Sequence[tuple[float, float]]
) -> tuple[ScheduledGains, ...]:
    """Return the gains the drive schedules to at points (rpm, N m); points out of reach are left out."""
    found = []
    for rpm, torque in points:
        design = design_or_none(machine, V_max, rpm, torque)
        if design is None:
            continue
        linear = cdm_gains(machine, design.point.V_a, design.point.delta, V_max, T_s, 10.0 * T_s)
        phase, amplitude = design.phase, design.amplitude
        found.append(
            ScheduledGains(
                rpm,
                torque,
                (phase.K_p, phase.K_i, phase.K_d, phase.a),
                (amplitude.K_p, amplitude.K_i, amplitude.K_d, amplitude.a),
                linear.K_P21,
                linear.K_I21,
                linear.K_P12,
                linear.K_I12,
                phase.K_p + phase.K_d * phase.a,
            )
        )
    return tuple(found)
