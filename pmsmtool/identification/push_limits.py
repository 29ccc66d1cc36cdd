# SPDX-License-Identifier: MIT
"""What recorded torque pushes do not tell of some machines, although a number comes out: said by name, not given."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

RELUCTANCE_LIMIT = 0.15
"""Largest torque of the d current, of the magnets', beside which J/psi stands: J/psi was off by 1.1 % where it was 0.02
(interior-2k2), by 26 % at 0.40 (saturated-pmsyrm) and 24 % at 0.53 (fast-ipm). L_d, on which it depends, is unknown."""


def reluctance_share(pushes: Sequence[Trace], L_q_h: float, psi_f_wb: float) -> float:
    """Return the largest share of the d current's torque in that of the magnets: with L_d = 0."""
    i_d, i_q = (np.concatenate([push[name] for push in pushes]) for name in ("i_d_a", "i_q_a"))
    return L_q_h / psi_f_wb * float(np.sum(np.abs(i_d * i_q)) / np.sum(np.abs(i_q)))


def not_told(estimates: Mapping[str, Estimate], pushes: Sequence[Trace]) -> dict[str, str]:
    """Return why estimates of recorded pushes are not given, by their keys.

    Parameters
    ----------
    estimates : mapping of str to Estimate
        ``L_q_app_h``, ``psi_f_wb`` and what else was estimated.
    pushes : sequence of Trace
        With ``i_d_a`` and ``i_q_a``.
    """
    share = reluctance_share(pushes, estimates["L_q_app_h"].value, estimates["psi_f_wb"].value)
    if share <= RELUCTANCE_LIMIT or "J_per_psi" not in estimates:
        return {}
    return {
        "J_per_psi": f"this drive lets a d current flow whose torque may be {100.0 * share:.2g} % of the magnets', "
        f"limit {100.0 * RELUCTANCE_LIMIT:g} %; needs current set-points"
    }


def without(estimates: Mapping[str, Estimate], reasons: Iterable[str]) -> dict[str, Estimate]:
    """Return the estimates that are given; the friction goes with the inertia it was told with."""
    left_out = set(reasons)
    left_out |= {"tau_c_per_psi"} if "J_per_psi" in left_out else set()
    return {name: estimate for name, estimate in estimates.items() if name not in left_out}
