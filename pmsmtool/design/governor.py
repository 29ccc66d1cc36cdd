# SPDX-License-Identifier: MIT
"""Numbers of the reference governor: horizon, tightening and options, each with its reason.

Jercic, Iles, Zarko, Matusko 2017 (DOI 10.1080/00051144.2018.1453441) with a tightened steady-state row, without which
the horizon is not finitely determined; and the better laws on offset-free rows {0, infinity}, which need no horizon.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pmsmtool.design.admissible_set import Horizon, PredictionModel, StateBounds, horizon, matrix_exponential
from pmsmtool.design.design_file import DesignValue, Scalar
from pmsmtool.design.loops.current_loop import CurrentGains
from pmsmtool.design.ratings import Ratings
from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.params.catalogue import GOVERNOR_MODES, K_MAX_NOT_DETERMINED
from pmsmtool.units import RPM_PER_RAD_S

HEXAGON, PREDICTOR, CURRENT_ROW, PRE_PROJECTION, MINIMUM_TIME = 1, 2, 4, 8, 16
"""Bits of ``governor.options``."""

EPS_LEAST, EPS_LARGEST = 0.015, 0.08
"""Tightening of the steady-state row: less crawls along it, more gives voltage away. The core steers no transfer along
the current limit from where the present current takes more than 0.99 V_max: a reference that stands on a corner of
steady-state row and current limit beyond that is left and approached again for ever (up to 10 A, with noise from eps
0.012 down; none from 0.015 on)."""

EPS_LISTED = (0.1, 0.01, 1e-3)
"""Tightenings whose horizon is listed beside the chosen one."""

OBSERVER_TIME_S, OBSERVER_TIME_SATURATED_S = 0.8e-3, 8e-3
"""Time constant of the disturbance observer (docs/control.md, 1 and 7: gain 0.1 at 12 kHz). The large inductance of a
saturated machine makes volts of the noise of a sample, L/T_s of it."""

SLACK = 2e-4
"""Squared voltage over the limit, relative, that counts as none: seen up to 1.1e-4 in the exact plant."""

SHORT_HORIZON = 10
"""Prediction rows an exact projection can carry in half of a 12 kHz period on a 170 MHz Cortex-M4F."""

ROWS_IN_DRIVE = 64
"""Prediction rows the drive has (``PMSM_GOVERNOR_ROWS``)."""

STEERED_STEP = 0.8
"""Share of I_max that one period of the whole voltage may move the current where the flux is steered along the
minimum-time direction: the path along the current limit is not resolved beyond. A drawn machine of 1.3 went to 1.21
I_max; those up to 0.73 stay within 1.02."""

EULER_ANGLES = 36
"""Directions of current and voltage over which the prediction error is maximised."""


@dataclass(frozen=True, slots=True)
class GovernorDesign:
    """Governor values with facts and notes for the design file."""

    values: Mapping[str, DesignValue]
    facts: Mapping[str, Scalar]
    notes: tuple[str, ...]


def prediction_model(source: MachineFile, gains: Mapping[str, CurrentGains]) -> PredictionModel:
    """Return the model a drive predicts with: apparent inductances turn with the speed, incremental ones delay."""
    machine = source.machine
    return PredictionModel(
        machine.R_s_ohm, machine.L_d_h, machine.L_q_h, machine.psi_f_wb, source.inverter.T_s, gains["d"], gains["q"]
    )


def euler_error(model: PredictionModel, omega_e: float, V_max: float, I_a: float) -> float:
    """Return the largest one-step error of the Euler prediction, as voltage through K_p over V_max.

    Exact step: the voltage is held in the stator frame over the period, its mean direction being the demanded one;
    |i| = ``I_a``, |u| = V_max, all directions. Resistance is harmless, the turning of the frame is not.
    """
    T = model.T_s
    L = np.array([model.L_d, model.L_q])
    F = np.array([[-model.R / L[0], omega_e * L[1] / L[0]], [-omega_e * L[0] / L[1], -model.R / L[1]]])
    turn = omega_e * np.array([[0.0, 1.0], [-1.0, 0.0]])  # of a voltage fixed to the stator, seen from the rotor
    emf = np.array([0.0, -omega_e * model.psi_f / L[1]])
    joint = np.zeros((5, 5))
    joint[:2, :2], joint[:2, 2:4], joint[:2, 4], joint[2:4, 2:4] = F, np.diag(1.0 / L), emf, turn
    exact = matrix_exponential(T * joint)
    back = matrix_exponential(-0.5 * T * turn)
    angle = 2.0 * math.pi * np.arange(EULER_ANGLES) / EULER_ANGLES
    circle = np.array([np.cos(angle), np.sin(angle)])
    i, u = I_a * circle[:, :, None], V_max * circle[:, None, :]
    held = np.einsum("ab,bjk->ajk", back, np.broadcast_to(u, (2, 1, EULER_ANGLES)))
    after = np.einsum("ab,bjk->ajk", exact[:2, :2], i) + np.einsum("ab,bjk->ajk", exact[:2, 2:4], held)
    after = after + exact[:2, 4, None, None]
    euler = i + T * (np.einsum("ab,bjk->ajk", F, i) + u / L[:, None, None] + emf[:, None, None])
    K_p = np.array([model.gains_d.K_p, model.gains_q.K_p])[:, None, None]
    return float(np.sqrt((((after - euler) * K_p) ** 2).sum(axis=0)).max() / V_max)


def design_governor(
    source: MachineFile,
    rated: Ratings,
    gains: Mapping[str, CurrentGains],
    mode: str,
    *,
    predictor: bool,
    eps: float | None = None,
) -> GovernorDesign:
    """Choose the governor's numbers. Raises ConfigError: unknown mode.

    Parameters
    ----------
    source, rated : MachineFile, Ratings
        Machine and its limits.
    gains : mapping of str to CurrentGains
        Current controllers of axes ``d`` and ``q``.
    mode : str
        A key of ``GOVERNOR_MODES``.
    predictor : bool
        Whether the current controllers predict over the computation delay.
    eps : float, optional
        Tightening asked for; the least that covers the prediction error where none is given.
    """
    if mode not in GOVERNOR_MODES:
        raise ConfigError(
            f"governor mode {mode!r}, allowed are {', '.join(GOVERNOR_MODES)}",
            where="tune",
            hint="`pmsmtool tune --help` explains each",
        )
    model = prediction_model(source, gains)
    V_max = source.inverter.V_max_v
    omega = rated.n_max_rpm / RPM_PER_RAD_S * source.machine.pole_pairs
    error = euler_error(model, omega, V_max, rated.I_nom_apk)
    predicts = mode in ("paper", "linearised", "observe")
    chosen, why = _eps(error if predicts else 0.0, eps)
    found = horizon(model, omega, V_max, chosen) if predicts else None
    listed = {f"k_max_eps_{e:g}": _fact(horizon(model, omega, V_max, e)) for e in EPS_LISTED if predicts}
    observer = OBSERVER_TIME_SATURATED_S if source.flux_map is not None else OBSERVER_TIME_S
    fast = V_max * source.inverter.T_s > STEERED_STEP * rated.I_max_apk * min(model.L_d, model.L_q)
    options, how = _options(mode, predictor, fast)
    values = {
        "governor.mode": DesignValue(GOVERNOR_MODES[mode], f"{mode}, as asked for"),
        "governor.k_max": _k_max(found),
        "governor.eps": DesignValue(chosen, why),
        "governor.options": DesignValue(options, how),
        "governor.I_transient_apk": DesignValue(rated.I_max_apk, "I_max"),
        "governor.observer_gain": DesignValue(min(1.0, source.inverter.T_s / observer), f"{observer:g} s"),
        "governor.slack": DesignValue(SLACK, "above what an exact plant shows"),
    }
    facts: dict[str, Scalar] = {"governor_euler_error_at_n_max": error}
    if found is not None:
        facts |= {"k_max_chosen": _fact(found), "k_max_speed_rpm": rated.n_max_rpm, **listed}
        facts |= {"k_max_without_steady_state_row": "not finitely determined"}
        facts |= _bounded_facts(model, source, rated, chosen)
    facts["straight_segment"] = model.has_straight_segment()
    return GovernorDesign(values, facts, _notes(mode, error, chosen, found, model))


def _bounded_facts(model: PredictionModel, source: MachineFile, rated: Ratings, eps: float) -> dict[str, Scalar]:
    """Horizon over the states that occur, |i|, |v| <= I_max and a small zeta, at and above the base speed."""
    bounds = StateBounds(rated.I_max_apk, ZETA_SHARE * source.inverter.V_max_v)
    facts: dict[str, Scalar] = {}
    for share in BOUNDED_SPEEDS:
        rpm = share * rated.base_speed_rpm
        if 0.0 < rpm <= rated.n_max_rpm:
            omega = rpm / RPM_PER_RAD_S * source.machine.pole_pairs
            facts[f"k_max_bounded_states_at_{rpm:.0f}_rpm"] = _fact(
                horizon(model, omega, source.inverter.V_max_v, eps, bounds, ROWS_IN_DRIVE)
            )
    return facts


ZETA_SHARE = 1.0 / 60.0
"""Bound of |K_i I_e - R i| over V_max in that test: 2 V for the machine of the paper."""

BOUNDED_SPEEDS = (1.0, 1.25)
"""Speeds of that test over the base speed."""


def _fact(found: Horizon) -> Scalar:
    return found.text if found.k_max is None or found.by_tolerance else found.k_max


def _eps(error: float, asked: float | None) -> tuple[float, str]:
    if asked is not None:
        return asked, "asked for"
    chosen = min(EPS_LARGEST, max(EPS_LEAST, error))
    return chosen, f"{EPS_LEAST:g} at least" if chosen == EPS_LEAST else "covers the prediction error at n_max"


def _k_max(found: Horizon | None) -> DesignValue:
    if found is None:
        return DesignValue(0, "no horizon: rows {0, infinity}")
    if found.k_max is None or found.by_tolerance:
        return DesignValue(K_MAX_NOT_DETERMINED, "not finitely determined: the drive predicts as far as it can")
    return DesignValue(min(found.k_max, ROWS_IN_DRIVE - 1), f"redundancy test over all states, eps {found.eps:g}")


def _options(mode: str, predictor: bool, fast: bool) -> tuple[int, str]:
    row = (CURRENT_ROW, "current row"), (PRE_PROJECTION, "pre-projection")
    steered = () if fast else ((MINIMUM_TIME, "minimum-time direction"),)
    ahead = ((PREDICTOR, "predictor"),) if predictor and mode != "off" else ()
    chosen = (*{"line": row, "best": (*row, *steered)}.get(mode, ()), *ahead)
    bits, how = sum(bit for bit, _ in chosen), ", ".join(name for _, name in chosen) or "none"
    if mode == "best" and fast:
        how += f"; no minimum-time direction: a period moves the current by more than {STEERED_STEP:g} I_max"
    return bits, how


def _notes(mode: str, error: float, eps: float, found: Horizon | None, model: PredictionModel) -> tuple[str, ...]:
    notes = []
    if mode in ("paper", "linearised") and found is not None:
        if error > eps:
            notes.append(
                f"governor: Euler's prediction errs by {100.0 * error:.2g} % of V_max at the largest speed, more than "
                f"the steady-state row is tightened ({100.0 * eps:.2g} %); the offset-free modes do not predict"
            )
        if found.k_max is None or found.by_tolerance:
            notes.append("governor: the horizon is not finitely determined at this eps; the drive predicts 63 rows")
        elif found.k_max > SHORT_HORIZON:
            notes.append(
                f"governor: exact projection on {found.k_max} rows does not fit half of a 12 kHz period at 170 MHz "
                f"({SHORT_HORIZON} do); with a straight segment rows 0 and infinity are enough"
            )
    if mode == "best" and not model.has_straight_segment():
        notes.append("governor: the axes share no bandwidth with cancelled poles; rows {0, infinity} are not all")
    return tuple(notes)
