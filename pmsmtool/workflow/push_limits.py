"""What recorded torque pushes do not tell of some machines, although a number comes out: said by name, not given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

RELUCTANCE_LIMIT = 0.15
"""Largest torque of the d current, of the magnets', beside which J/psi stands: J/psi was off by 1.1 % where it was 0.02
(interior-2k2), by 26 % at 0.40 (saturated-pmsyrm) and 24 % at 0.53 (fast-ipm). L_d, on which it depends, is unknown."""


def reluctance_share(pushes: Sequence[Trace], L_q_h: float, psi_f_wb: float) -> float:
    """Return the largest share of the d current's torque in that of the magnets: with L_d = 0."""
    i_d, i_q = (np.concatenate([push[name] for push in pushes]) for name in ("i_d_a", "i_q_a"))
    return L_q_h / psi_f_wb * float(np.sum(np.abs(i_d * i_q)) / np.sum(np.abs(i_q)))


def not_told(estimates: Mapping[str, Estimate], pushes: Sequence[Trace], L_q_limit: float) -> dict[str, str]:
    """Return why estimates of recorded pushes are not given, by their keys.

    Parameters
    ----------
    estimates : mapping of str to Estimate
        ``L_q_app_h``, ``psi_f_wb`` and what else was estimated.
    pushes : sequence of Trace
        With ``i_d_a`` and ``i_q_a``.
    L_q_limit : float
        Largest relative total 95 % half width of an accepted L_q.
    """
    L_q = estimates["L_q_app_h"]
    reasons = {}
    half = total_half_width(L_q) / L_q.value
    if half > L_q_limit:
        reasons["L_q_app_h"] = (
            f"{L_q.value:.3g} H +- {100.0 * half:.2g} %, limit {100.0 * L_q_limit:g} %: it changes with the current; "
            "needs current set-points"
        )
    share = reluctance_share(pushes, L_q.value, estimates["psi_f_wb"].value)
    if share > RELUCTANCE_LIMIT and "J_per_psi" in estimates:
        reasons["J_per_psi"] = (
            f"this drive lets a d current flow whose torque may be {100.0 * share:.2g} % of the magnets', limit "
            f"{100.0 * RELUCTANCE_LIMIT:g} %; needs current set-points"
        )
    return reasons


def without(estimates: Mapping[str, Estimate], reasons: Mapping[str, str]) -> dict[str, Estimate]:
    """Return the estimates that are given; the friction goes with the inertia it was told with."""
    left_out = {*reasons, *(("tau_c_per_psi",) if "J_per_psi" in reasons else ())}
    return {name: estimate for name, estimate in estimates.items() if name not in left_out}
