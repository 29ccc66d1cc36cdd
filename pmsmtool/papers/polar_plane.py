# SPDX-License-Identifier: MIT
"""Over speed and torque: equilibria, conditioning and controllability, stability of the true loop, gain schedules."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pmsmtool.design.polar import (
    Equilibrium,
    SurfaceMachine,
    amplitude_plant,
    circle_poles,
    closed_loop_polynomial,
    conditioning,
    equilibrium_at_amplitude,
    equilibrium_without_i_d,
    linearised,
    phase_plant,
    place_pid,
)
from pmsmtool.design.polar_values import (
    ScheduledGains,
    condition_map,
    controllable,
    design_or_none,
    gain_schedule,
    share_above,
    stability_map,
)
from pmsmtool.papers.figure import Check, Column, Panel, Reproduction, Series, Table
from pmsmtool.papers.polar_scene import ASSUMED, K_T, PEAK, SOURCE, V_MAX, at_most, machine_file, near
from pmsmtool.units import RAD_S_PER_RPM

SPEEDS_RPM = np.linspace(0.0, 1400.0, 281)
TORQUES_NM = np.linspace(-5.0, 5.0, 201)


def machine() -> SurfaceMachine:
    """Return the assumed machine (peak quantities)."""
    return SurfaceMachine.of(machine_file().machine)


V_PEAK = V_MAX * PEAK


def _omega(rpm: float) -> float:
    return rpm * RAD_S_PER_RPM * machine().pole_pairs


# ---- equilibria ----------------------------------------------------------------------------------------------


def _equilibrium_row(rpm: float, torque: float, point: Equilibrium) -> tuple[str | float, ...]:
    return (
        rpm,
        torque,
        point.V_a / PEAK,
        point.delta,
        point.i_d / PEAK,
        point.i_q / PEAK,
        K_T * point.i_q / PEAK,
        "yes" if point.reachable else "no",
        point.residual_a_per_s(machine()),
    )


def equilibria(seed: int) -> Reproduction:
    """Equilibrium search (9) over speed and torque, torque out of reach included; identities of the linear model."""
    del seed  # nothing here is random
    m = machine()
    columns = (
        Column("speed", "rpm", 4),
        Column("torque asked", "N m", 3),
        Column("V_a", "V", 5),
        Column("delta_o", "rad", 5),
        Column("i_d", "A", 5),
        Column("i_q", "A", 5),
        Column("torque", "N m", 4),
        Column("reachable"),
        Column("residual", "A/s", 2),
    )
    cases = [(rpm, torque) for rpm in (0.0, 400.0, 800.0, 1200.0, -800.0) for torque in (1.0, 4.5, 12.0, -4.5)]
    points = [equilibrium_without_i_d(m, _omega(rpm), m.current_a(torque), V_PEAK) for rpm, torque in cases]
    rows = tuple(_equilibrium_row(*case, point) for case, point in zip(cases, points, strict=True))
    worst = max(point.residual_a_per_s(m) for point in points)
    far = equilibrium_at_amplitude(m, _omega(800.0), m.current_a(12.0), V_PEAK)
    checks = (
        at_most("largest equilibrium residual", worst, 1e-6, "A/s", expected=0.0, where="f(x_o, u_o) = 0"),
        near("largest i_q at 800 rpm", 31.9, far.i_q / PEAK, "A", absolute=0.05),
        near("largest torque at 800 rpm", 8.42, K_T * far.i_q / PEAK, "N m", absolute=0.01),
        near("i_q at the linear limit, 800 rpm", 13.17, _limit_i_q(800.0), "A", absolute=0.05),
        near("i_q at the linear limit, 400 rpm", 54.0, _limit_i_q(400.0), "A", absolute=0.3),
        *_identities(),
    )
    table = Table("least-loss steady state; out of reach: the largest torque at full voltage", columns, rows)
    return Reproduction(SOURCE, (table,), _loci(), checks, ASSUMED, columns=2)


def _loci() -> tuple[Panel, ...]:
    """Phase and i_d of the steady state over the torque, to the end of what full voltage reaches."""
    m = machine()
    torques = np.linspace(-6.0, 12.0, 361)
    phase, i_d = [], []
    for rpm in (400.0, 800.0, 1000.0, 1200.0):
        points = [equilibrium_without_i_d(m, _omega(rpm), m.current_a(float(torque)), V_PEAK) for torque in torques]
        kept = [point for point in points if point.reachable]
        reached = np.array([K_T * point.i_q / PEAK for point in kept])
        phase.append(Series(f"{rpm:g} rpm", reached, np.array([point.delta for point in kept])))
        i_d.append(Series(f"{rpm:g} rpm", reached, np.array([point.i_d / PEAK for point in kept])))
    return (
        Panel("phase of the steady state", "torque / N m", "delta_o / rad", tuple(phase)),
        Panel("d-axis current of the steady state", "torque / N m", "i_d / A", tuple(i_d)),
    )


def _limit_i_q(rpm: float) -> float:
    """i_q (A) at which i_d = 0 needs V_max: Z^2 i_q^2 + 2 omega R K_e i_q + (omega K_e)^2 = V_max^2."""
    m, omega = machine(), _omega(rpm)
    Z2, emf = abs(m.impedance(omega)) ** 2, omega * m.psi_f_wb
    half = emf * m.R_s_ohm
    return (-half + math.sqrt(half**2 - Z2 * (emf**2 - V_PEAK**2))) / Z2 / PEAK


def _identities() -> list[Check]:
    """Transfer functions against the state space, the identities, determinant, condition number, placed polynomials."""
    m = machine()
    errors = dict.fromkeys(("transfer functions", "identities", "determinant", "condition number", "polynomials"), 0.0)
    for rpm in (100.0, 800.0, 1200.0, -800.0):
        for torque in (0.5, 2.0, 4.5, -3.0):
            point = equilibrium_without_i_d(m, _omega(rpm), m.current_a(torque), V_PEAK)
            a, b = linearised(m, point)
            for omega in (3.0, 100.0, 3000.0):
                s = 1j * omega
                full = np.linalg.solve(s * np.eye(2) - a, b)
                for plant, entry in ((amplitude_plant(m, point), full[0, 0]), (phase_plant(m, point), full[1, 1])):
                    value = (plant.n1 * s + plant.n0) / (s * s + plant.d1 * s + plant.d0)
                    errors["transfer functions"] = max(errors["transfer functions"], abs(value / entry - 1.0))
                pairs = ((full[1, 1], point.V_a * full[0, 0]), (full[0, 1], -point.V_a * full[1, 0]))
                worst = max(abs(left / right - 1.0) for left, right in pairs)
                errors["identities"] = max(errors["identities"], worst)
            determinant = float(np.linalg.det(b)) * m.L_s_h**2 / point.V_a
            errors["determinant"] = max(errors["determinant"], abs(determinant - 1.0))
            ratio = float(np.linalg.cond(b @ np.diag([V_PEAK, 1.0]))) * point.V_a / V_PEAK
            errors["condition number"] = max(errors["condition number"], abs(ratio - 1.0))
            if rpm >= 800.0:
                for plant, sigma in ((phase_plant(m, point), 600.0), (amplitude_plant(m, point), 300.0)):
                    poles = circle_poles(m, _omega(rpm), sigma)
                    wanted = np.real(np.poly(np.array(poles)))
                    got = closed_loop_polynomial(plant, place_pid(plant, poles))
                    errors["polynomials"] = max(errors["polynomials"], float(np.abs(got / wanted - 1.0).max()))
    limits = {"polynomials": 1e-6}
    return [
        at_most(f"{name}: largest relative error", value, limits.get(name, 1e-9), "1", expected=0.0, where="(2)-(11)")
        for name, value in errors.items()
    ]


# ---- conditioning, stability ---------------------------------------------------------------------------------

POINTS = (
    (0.0, 0.1, 428.0),
    (0.0, 1.0, 42.8),
    (10.0, 0.0, 92.0),
    (50.0, 0.0, 18.4),
    (100.0, 0.0, 9.2),
    (400.0, 0.0, 2.3),
    (800.0, 1.0, 1.12),
    (800.0, 4.5, 1.0),
)
"""Speed (rpm), torque (N m), expected condition number."""


def controllability(seed: int) -> Reproduction:
    """Condition number over speed and torque, relative gains, and the poles of the true two-input loop."""
    del seed  # nothing here is random
    m = machine()
    columns = (
        Column("speed", "rpm", 4),
        Column("torque", "N m", 3),
        Column("V_a", "V", 4),
        Column("condition number", "", 4),
        Column("[B, AB] has rank 2"),
        Column("relative gain at DC", "", 3),
        Column("at high frequency", "", 3),
        Column("zero", "rad/s", 4),
    )
    rows, checks = [], []
    for rpm, torque, expected in (*POINTS, (0.0, 0.0, math.inf), (800.0, 8.0, 1.0)):
        found = conditioning(m, _omega(rpm), torque, V_PEAK)
        point = equilibrium_without_i_d(m, _omega(rpm), m.current_a(torque), V_PEAK)
        rank = "yes" if controllable(m, point) else "no"
        zero = found.zero_rad_s if math.isfinite(found.zero_rad_s) else None
        rows.append(
            (
                rpm,
                torque,
                found.V_a / PEAK,
                found.condition,
                rank,
                found.relative_gain_dc,
                found.relative_gain_high,
                zero,
            )
        )
        if math.isfinite(expected):
            what = f"condition number at {rpm:g} rpm, {torque:g} N m"
            checks.append(near(what, expected, found.condition, "1", relative=0.006))
    for torque, gain, zero_at in ((1.0, 0.88, 6490.0), (4.5, 0.60, 1268.0), (8.0, 0.08, 223.0)):
        found = conditioning(m, _omega(800.0), torque, V_PEAK)
        checks.append(near(f"relative gain, {torque:g} N m", gain, found.relative_gain_dc, "1", absolute=0.006))
        checks.append(near(f"zero, {torque:g} N m", zero_at, found.zero_rad_s, "rad/s", relative=0.003))
    grid = condition_map(m, V_PEAK, SPEEDS_RPM, TORQUES_NM)
    checks.append(
        near("share of the reachable area with condition > 10", 6.6, 100 * share_above(grid, 10.0), "%", absolute=0.5)
    )
    checks.append(near("share with condition > 100", 0.3, 100 * share_above(grid, 100.0), "%", absolute=0.1))
    stability, more = _stability()
    notes = (
        *ASSUMED,
        "cond(B diag(V_max, 1)) = V_max / V_a, whatever speed and phase; infinite at standstill without current only",
        "relative gain of the pairing i_d <- V_a, i_q <- delta (section III); below 0.5 that of section IV is better",
        "true two-input loop: both PIDs on the coupled machine; in field weakening the amplitude rests at its limit",
    )
    return Reproduction(
        SOURCE,
        (Table("conditioning", columns, tuple(rows)), stability),
        _panels(),
        (*checks, *more),
        notes,
    )


STABILITY_RPM = (100.0, 200.0, 400.0, 600.0, 685.0, 800.0, 900.0)
STABILITY_NM = (-4.5, -1.0, 0.5, 1.0, 2.0, 3.0, 4.5, 6.0)


def _stability() -> tuple[Table, list[Check]]:
    m = machine()
    slowest = stability_map(m, V_PEAK, STABILITY_RPM, STABILITY_NM)
    columns = (
        Column("slowest pole, rad/s; speed", "rpm", 4),
        *(Column(f"{torque:g}", "N m", 3) for torque in STABILITY_NM),
    )
    rows = tuple((rpm, *(float(x) for x in row)) for rpm, row in zip(STABILITY_RPM, slowest, strict=True))
    checks = [
        at_most("slowest pole anywhere in the linear range", float(np.nanmax(slowest)), -1.0, "rad/s", where="stable")
    ]
    for i_q, expected in ((0.5, -181.0), (13.0, -153.0)):
        found = design_or_none(m, V_PEAK, 800.0, K_T * i_q)
        assert found is not None
        checks.append(near(f"slowest pole at 800 rpm, {i_q:g} A", expected, found.slowest_rad_s, "rad/s", absolute=1.5))
    return Table(
        "real part of the slowest pole of the true two-input loop; designed for -600 and -300 rad/s", columns, rows
    ), checks


def _panels() -> tuple[Panel, ...]:
    m = machine()
    speeds = np.linspace(1.0, 1400.0, 400)
    lines = []
    for torque in (0.0, 0.1, 0.5, 1.0, 3.0):
        values = [conditioning(m, _omega(float(rpm)), torque, V_PEAK).condition for rpm in speeds]
        lines.append(Series(f"{torque:g} N m", speeds, np.array(values)))
    torques = np.linspace(0.0, 8.0, 81)
    slow = stability_map(m, V_PEAK, STABILITY_RPM[2:], torques)
    poles = tuple(Series(f"{rpm:g} rpm", torques, row) for rpm, row in zip(STABILITY_RPM[2:], slow, strict=True))
    return (
        Panel("condition number V_max / V_a", "speed / rpm", "condition number", tuple(lines), x_log=True, y_log=True),
        Panel("slowest pole of the true two-input loop", "torque / N m", "real part / (rad/s)", poles),
    )


def _lines(
    curves: Mapping[float, Sequence[ScheduledGains]], pick: Callable[[ScheduledGains], float]
) -> tuple[Series, ...]:
    return tuple(
        Series(f"{torque:g} N m", np.array([g.rpm for g in gains]), np.array([pick(g) for g in gains]))
        for torque, gains in curves.items()
    )


# ---- gain schedules --------------------------------------------------------------------------------------------


def gain_schedules(seed: int) -> Reproduction:
    """Gains over speed and torque as the drive schedules them; printed in power-invariant units."""
    del seed  # nothing here is random
    m, T_s = machine(), machine_file().inverter.T_s
    points = [(rpm, torque) for torque in (1.0, 4.5) for rpm in (100.0, 200.0, 400.0, 685.0, 800.0, 1000.0, 1200.0)]
    found = gain_schedule(m, V_PEAK, T_s, points)
    columns = (
        Column("speed", "rpm", 4),
        Column("torque", "N m", 3),
        *(
            Column(f"phase {name}", unit, 3)
            for name, unit in (("K_p", "rad/A"), ("K_i", "rad/(A s)"), ("K_d", "rad s/A"), ("a", "rad/s"))
        ),
        Column("kick K_p + K_d a", "rad/A", 3),
        *(
            Column(f"amplitude {name}", unit, 3)
            for name, unit in (("K_p", "V/A"), ("K_i", "V/(A s)"), ("K_d", "V s/A"), ("a", "rad/s"))
        ),
        Column("K_P21", "V/A", 3),
        Column("K_I21", "V/(A s)", 4),
        Column("K_P12", "rad/A", 3),
        Column("K_I12", "rad/(A s)", 4),
    )
    rows = []
    for g in found:
        K_p, K_i, K_d, a = g.phase
        rows.append(
            (
                g.rpm,
                g.torque_nm,
                K_p * PEAK,
                K_i * PEAK,
                K_d * PEAK,
                a,
                g.direct_phase * PEAK,
                *g.amplitude,
                g.K_P21,
                g.K_I21,
                g.K_P12 * PEAK,
                g.K_I12 * PEAK,
            )
        )
    at_800 = next(g for g in found if (g.rpm, g.torque_nm) == (800.0, 1.0))
    expected = (3.8e-4, 6.26, 3.14e-5, 2230.0, -0.124, 341.0, 9.3e-4, 934.0)
    ours = (*(x * PEAK for x in at_800.phase[:3]), at_800.phase[3], *at_800.amplitude)
    names = [
        f"{loop} {name} at 800 rpm, 1 N m" for loop in ("phase", "amplitude") for name in ("K_p", "K_i", "K_d", "a")
    ]
    checks = [
        near(name, want, got, "as above", relative=0.02) for name, want, got in zip(names, expected, ours, strict=True)
    ]
    speeds = np.linspace(100.0, 1400.0, 131)
    curves = {
        torque: gain_schedule(m, V_PEAK, T_s, [(float(rpm), torque) for rpm in speeds]) for torque in (1.0, 3.0, 4.5)
    }
    drawn: tuple[tuple[str, str, Callable[[ScheduledGains], float]], ...] = (
        ("phase PID, integral gain", "K_i / (rad/(A s))", lambda g: g.phase[1] * PEAK),
        ("phase PID, kick", "(K_p + K_d a) / (rad/A)", lambda g: g.direct_phase * PEAK),
        ("amplitude PID, integral gain", "K_i / (V/(A s))", lambda g: g.amplitude[1]),
    )
    plots = tuple(
        Panel(title, "speed / rpm", unit, _lines(curves, pick), x_log=False, y_log=True) for title, unit, pick in drawn
    )
    return Reproduction(
        SOURCE,
        (Table("gains over speed and torque", columns, tuple(rows)),),
        plots,
        tuple(checks),
        (
            *ASSUMED,
            "below 685 rpm |p| < 600 rad/s: the poles collapse onto -600 and the kick of the PID on the error grows",
        ),
    )
