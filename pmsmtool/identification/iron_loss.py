# SPDX-License-Identifier: MIT
"""Iron loss: a resistance R_fe across the flux voltage, by the run over speeds and the square waves.

Where a machine coasts at no sampled q current, its core draws w psi/R_fe along q, and the winding carries the opposite:

    u_d = w L_q (w psi/R_fe),

as currents sampled by L_q/R_fe before the middle of the zero vector would show it. Square waves in a frame that stands
show a branch of R + R_fe beside the winding. They alone cannot tell it from eddy currents of the rotor, which a turning
machine does not show. The loss brakes by 1.5 p^2 psi^2/R_fe, which a coasting counts to B: R_fe is no less than that
makes of B.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pmsmtool.estimators.estimate import COVERAGE_FACTOR, total_half_width
from pmsmtool.estimators.flux.linkage import FluxResult
from pmsmtool.estimators.injection.inductance import InductanceResult
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.torque import iron_drag
from pmsmtool.units import format_estimate, format_quantity

if TYPE_CHECKING:
    from pmsmtool.identification.evaluate import Evaluation

IRON_LOSS, LEAST = "iron_loss_ohm", "iron_loss_least_ohm"
"""Keys of the estimate, and of the condition that stands in its place where the loss is not found."""
MODEL_STD = 0.015
"""Relative standard deviation beside the noise."""
LAG_MOST_S = 10e-6
"""What may be another instant of sampling, at most (s): current sensors lag by 1 to 10 us."""
APART = 0.5
"""Relative 95 % half width of the loss from which on it is not told from eddy currents and the instant of sampling."""
TOLD_PERIODS = 0.03
"""Instant that a run over speeds shows from which on a reader is told what it stands for (T_s)."""


def iron_loss_of(result: Evaluation) -> Estimate | None:
    """Return R_fe (ohm); None where the runs show none, or do not tell it from something else.

    The square waves must show a branch, too. What both say otherwise is in the interval, up to what may be another
    instant of sampling.
    """
    inductance, flux, resistance = result.inductance, result.flux, result.resistance
    if inductance is None or flux is None or flux.shown is None or resistance is None or inductance.sampling:
        return None
    ahead_s = -flux.shown.value_s
    L_q = best_L_q(inductance, flux)
    branches = [
        fit.L_h / fit.eddy_s - resistance.R_measured.value for fit in inductance.axes.values() if fit.eddy_s > 0.0
    ]
    if not branches or not ahead_s > 0.0 or not L_q.value > 0.0:
        return None
    off_s = min(LAG_MOST_S, *(abs(L_q.value / branch - ahead_s) for branch in branches if branch > 0.0))
    noise = COVERAGE_FACTOR * math.hypot(flux.shown.std_s / ahead_s, L_q.std / L_q.value, MODEL_STD)
    share = math.hypot(noise, off_s / ahead_s)
    value = L_q.value / ahead_s
    half = value * share / max(1.0 - share, APART)  # the longer side: R_fe is one over what is measured
    if share > APART or value + half < least_ohm(result):
        return None
    return Estimate(
        value, half / COVERAGE_FACTOR, value * L_q.systematic / L_q.value, "ohm", T_c=flux.psi_measured.T_c,
        method="d voltage of a coasting machine, with the branch of the square waves",
    )  # fmt: skip


def best_L_q(inductance: InductanceResult, flux: FluxResult) -> Estimate:
    """Return L_q of the square waves or of the run over speeds, whichever is known better."""
    return min((inductance.L_q, flux.L_q_app), key=lambda estimate: estimate.std)


def least_ohm(result: Evaluation) -> float:
    """Return what R_fe is no less than (ohm): less would brake more than all that B and its interval hold; else 0."""
    flux, encoder, mechanics = result.flux, result.encoder, result.mechanics
    if flux is None or encoder is None or mechanics is None:
        return 0.0
    most_nms = mechanics.B.value + total_half_width(mechanics.B)
    one_ohm_nms = iron_drag(round(encoder.pole_pairs.value), flux.psi_measured.value, 1.0)
    return one_ohm_nms / most_nms if most_nms > 0.0 else 0.0


def iron_loss_lines(result: Evaluation) -> list[str]:
    """Return what a reader should know of iron loss, and of what a run over speeds shows as it does."""
    inductance, shown, found = result.inductance, result.shown, iron_loss_of(result)
    beside_us = 0.0 if shown is None else 1e6 * shown.value_s
    sampled = f"currents sampled {beside_us:+.2g} us beside the middle of the zero vector"
    if found is not None:
        told = format_estimate(found.value, total_half_width(found), found.unit)
        return [f"iron loss, {told} across the flux voltage: at speed it shows as {sampled}, and B holds its drag"]
    least = least_ohm(result)
    bound = f"; the resistance of iron loss is at least {format_quantity(least, 'ohm')}, by B" if least else ""
    branch = [a for a, fit in ({} if inductance is None else inductance.axes).items() if "eddy" in fit.effects]
    hidden = bool(branch) and inductance is not None and inductance.sampling is None
    lines = [f"L: eddy currents on {', '.join(branch)}, not separated from iron loss{bound}"] if hidden else []
    if shown is not None and abs(shown.value_s) >= TOLD_PERIODS * shown.period_s:
        early = f", as a lag of their sensors or iron loss would{'' if hidden else bound}"
        middle = "" if hidden else "; R and L lie in the middle, and both are in the intervals"
        old = f" or an encoder angle that is so old{middle}"
        lines.append(f"the d voltage at speed shows {sampled}{early if shown.value_s < 0.0 else old}")
    return lines
