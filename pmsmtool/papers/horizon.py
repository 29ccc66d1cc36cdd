# SPDX-License-Identifier: MIT
"""The horizon k_max of Jercic et al. 2017, (28)-(30), which the paper does not state; and its matrices (15)-(27)."""

from __future__ import annotations

import math

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.admissible_set import Horizon, PredictionModel, StateBounds, horizon
from pmsmtool.design.loops.current_loop import CurrentGains, imc, second_order
from pmsmtool.papers.figure import Check, Column, Reproduction, Table, at_most, near
from pmsmtool.papers.governed_drive import MODULUS_OPTIMUM, V_max, source
from pmsmtool.papers.registry import JERCIC
from pmsmtool.units import RAD_S_PER_RPM

EPS: tuple[float | None, ...] = (0.1, 0.01, 1e-3, 1e-4, None)
"""Tightenings of the steady-state row; None: without that row, as printed."""
REFERENCE = {"modulus optimum": (18, 24, 34), "IMC 2000 rad/s": (36, 49, 71), "second order 2000 rad/s": (14, 23, 33)}
"""k_max at eps = 0.1, 0.01, 1e-3, computed independently."""
K_ROOM = 1
COMPUTED = "derived: independent computation of (28)-(30)"
SPEED_RPM = 620.0
CAP = 100
"""Horizons beyond this count as not finitely determined here; the reference looked up to 800."""
MATRIX_ROOM = 1e-12
"""Largest relative deviation of the matrices that must hold; measured 2e-16."""
BOUNDED_RPM = (310.0, 620.0, 800.0)
BOUNDS = StateBounds(56.0, 2.0)
BOUNDED_REFERENCE = {310.0: (0, 0), 620.0: (0, 14), 800.0: (0, 29)}
"""k_max at eps = 0.01 and 1e-3 over |i|, |v| <= 56 A and |zeta| <= 2 V, modulus optimum."""


def horizons(seed: int) -> Reproduction:
    """Return k_max over tuning, tightening, speed and state bounds, and the deviation of the matrices."""
    del seed  # nothing is random here
    rows, checks = [], []
    for name, reference in REFERENCE.items():
        model = _model(name)
        found = [horizon(model, _omega(SPEED_RPM), V_max(), eps, cap=CAP) for eps in EPS]
        rows.append((name, "all", SPEED_RPM, "yes" if model.has_straight_segment() else "no", *map(_shown, found)))
        for eps, expected, one in zip(EPS, reference, found, strict=False):
            what = f"k_max, {name}, eps {eps:g}"
            checks.append(near(what, expected, _number(one), "1", absolute=K_ROOM, where=COMPUTED))
        determined = found[-1].k_max is not None and not found[-1].by_tolerance
        what = f"finitely determined without steady-state row, {name}"
        checks.append(at_most(what, float(determined), 0.0, "1", where="(28)-(30)"))
    model = _model("modulus optimum")
    for rpm in BOUNDED_RPM:
        pair = [horizon(model, _omega(rpm), V_max(), eps, BOUNDS, CAP) for eps in (0.01, 1e-3)]
        rows.append(
            ("modulus optimum", "|i|, |v| <= 56 A, |zeta| <= 2 V", rpm, "yes", "-", *map(_shown, pair), "-", "-")
        )
        for eps, expected, one in zip((0.01, 1e-3), BOUNDED_REFERENCE[rpm], pair, strict=True):
            what = f"k_max, bounded states, {rpm:g} rpm, eps {eps:g}"
            checks.append(near(what, expected, _number(one), "1", absolute=K_ROOM, where=COMPUTED))
    heads = (
        Column("tuning"), Column("states"), Column("speed", "rpm"), Column("straight segment"),
        *(Column("no steady-state row" if eps is None else f"eps {eps:g}") for eps in EPS),
    )  # fmt: skip
    matrices, matrix_checks = _matrices()
    notes = (
        "A has two eigenvalues 1 (the held references): without a tightened steady-state row the recursion as printed "
        "is not finitely determined",
        "straight segment: poles cancelled at one bandwidth; without integrated error rows 0 and infinity are then all",
        f'"not finitely determined": beyond {CAP} rows',
    )
    return Reproduction(
        f"{JERCIC}, (15)-(30)",
        (Table("k_max", heads, tuple(rows)), matrices), (), (*matrix_checks, *checks), notes,
    )  # fmt: skip


def _omega(rpm: float) -> float:
    return RAD_S_PER_RPM * source().machine.pole_pairs * rpm


def _gains(name: str, L: float) -> CurrentGains:
    R = source().machine.R_s_ohm
    if name.startswith("second"):
        return second_order(R, L, 2000.0, 1.0)
    return imc(R, L, 2000.0 if name.startswith("IMC") else MODULUS_OPTIMUM)


def _model(name: str) -> PredictionModel:
    m = source().machine
    return PredictionModel(
        m.R_s_ohm, m.L_d_h, m.L_q_h, m.psi_f_wb, source().inverter.T_s, _gains(name, m.L_d_h), _gains(name, m.L_q_h)
    )


def _shown(found: Horizon) -> str:
    return found.text


def _number(found: Horizon) -> float:
    return math.nan if found.k_max is None else float(found.k_max)


def _matrices() -> tuple[Table, list[Check]]:
    """Compare A with Euler steps of (11)-(16) taken one state at a time, and A_d, A_q with (13)-(14)."""
    rows, checks = [], []
    for name in REFERENCE:
        model = _model(name)
        w = _omega(SPEED_RPM)
        unit = np.eye(6)
        A = np.column_stack([_euler(model, x) for x in unit])
        C = np.column_stack([_demand(model, w, x) for x in unit])
        for what, ours, stepped in (
            ("A", model.system_matrix(), A),
            ("A_d, A_q", model.voltage_rows(w), C),
        ):
            deviation = float(np.abs(ours - stepped).max() / np.abs(stepped).max())
            rows.append((name, what, deviation))
            checks.append(at_most(f"{what}, {name}: deviation", deviation, MATRIX_ROOM, "1", where="(15)-(16), (27)"))
    heads = (Column("tuning"), Column("matrix"), Column("largest deviation", "", 2))
    return Table(f"matrices at {SPEED_RPM:g} rpm against the equations they stand for", heads, tuple(rows)), checks


def _euler(model: PredictionModel, x: Array) -> Array:
    """One forward Euler step of the closed loop (15)-(16) with the integrators (11)-(12) and held references."""
    out = np.array(x)
    for axis, (L, gains) in enumerate(((model.L_d, model.gains_d), (model.L_q, model.gains_q))):
        i, integral, v = x[axis], x[axis + 2], x[axis + 4]
        out[axis] = i + model.T_s * (gains.K_p * (v - i) + gains.K_i * integral - model.R * i) / L
        out[axis + 2] = integral + model.T_s * (v - i)
    return out


def _demand(model: PredictionModel, w: float, x: Array) -> Array:
    """The control law (13)-(14) without the constant w psi."""
    i_d, i_q, I_d, I_q, v_d, v_q = x
    d, q = model.gains_d, model.gains_q
    return np.array([
        d.K_p * (v_d - i_d) + d.K_i * I_d - w * model.L_q * i_q,
        q.K_p * (v_q - i_q) + q.K_i * I_q + w * model.L_d * i_d,
    ])  # fmt: skip
