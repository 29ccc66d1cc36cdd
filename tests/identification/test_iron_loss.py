# SPDX-License-Identifier: MIT
"""Iron loss of whole identifications over CANopen, and what is said where nothing tells it from something else."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.identification_coverage import drawn, evaluated, measured
from benchmarks.real_effects import EFFECTS
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.estimators.injection.sampling_instant import Sampling
from pmsmtool.identification.evaluate import Evaluation
from pmsmtool.identification.iron_loss import IRON_LOSS, best_L_q, iron_loss_lines, iron_loss_of, least_ohm
from pmsmtool.identification.mechanics import pushes_of
from pmsmtool.machine.machine_keys import estimated_key
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.torque import iron_drag
from pmsmtool.trace import Trace

pytestmark = pytest.mark.chain

SEED = 90341
WIDEST = 0.08
"""Relative total half width; 0.036 here, to 0.067 on other drives whose L_q is good."""


@cache
def _found() -> tuple[Evaluation, float]:
    """Evaluation of a drive with iron loss, and its iron-loss resistance (ohm)."""
    drive = drawn("", SEED, "ideal")
    drive = replace(drive, simulation={**drive.simulation, **EFFECTS["iron loss %"][0](drive, 5.0)})
    traces, nameplate, _ = measured(drive, accuracy=0.01)
    return evaluated(traces, nameplate), float(drive.simulation_settings()["iron_loss_ohm"])  # type: ignore[arg-type]


def test_iron_loss_is_found_within_its_interval() -> None:
    evaluation, truth = _found()
    found = evaluation.effects()[IRON_LOSS]
    assert abs(found.value - truth) < total_half_width(found) < WIDEST * found.value
    assert abs(found.value - truth) < 0.02 * truth  # 0.2 %
    assert estimated_key(IRON_LOSS), "a machine file takes it"


def test_iron_loss_is_named_in_place_of_early_samples() -> None:
    evaluation, _ = _found()
    (line,) = iron_loss_lines(evaluation)
    assert line.startswith("iron loss, ") and "+-" in line


def _shown(evaluation: Evaluation, factor: float) -> Evaluation:
    assert evaluation.flux is not None and evaluation.flux.shown is not None
    shown = replace(evaluation.flux.shown, value_s=factor * evaluation.flux.shown.value_s)
    return replace(evaluation, flux=replace(evaluation.flux, shown=shown))


def test_an_eddy_branch_is_no_iron_loss() -> None:
    """Of the rotor: the square waves show it, a turning machine does not, and the instant of sampling is known."""
    evaluation, _ = _found()
    assert evaluation.inductance is not None and "eddy" in evaluation.inductance.axes["d"].effects
    still = _shown(evaluation, 0.0)
    assert iron_loss_of(still) is None and IRON_LOSS not in still.effects()
    timed = replace(still, inductance=replace(evaluation.inductance, sampling=Sampling()))
    assert iron_loss_of(timed) is None and iron_loss_lines(timed) == []
    early = replace(evaluation, inductance=timed.inductance)
    assert iron_loss_of(early) is None, "what is known to be early samples is no loss"


def test_what_both_runs_say_otherwise_is_in_the_interval() -> None:
    evaluation, truth = _found()
    beside = _shown(evaluation, 1.2)
    found = iron_loss_of(beside)
    assert found is not None and abs(found.value - truth) < total_half_width(found)
    assert iron_loss_of(_shown(evaluation, 0.25)) is None, "another instant may be all of it"


@pytest.mark.parametrize(("factor", "told"), [(0.25, "iron loss would"), (-1.0, "encoder angle that is so old")])
def test_what_is_not_told_apart_is_said(factor: float, told: str) -> None:
    evaluation, _ = _found()
    hidden, line = iron_loss_lines(_shown(evaluation, factor))
    assert "eddy currents on d, q, not separated from iron loss" in hidden
    assert told in line and "R and L lie in the middle" not in line


def test_the_current_of_the_iron_makes_no_reluctance_torque() -> None:
    """A resistor across j w psi takes w L_q i_q/R_fe from i_d; of a ferrite machine it moved J by 9.6 %."""
    evaluation, _ = _found()
    assert evaluation.encoder is not None and evaluation.flux is not None and evaluation.inductance is not None
    rows, omega_m, i_q = 400, 100.0, 3.0
    t_s = np.arange(rows) * 1e-3
    signals = {"theta_M_rad": omega_m * t_s, "i_d_a": np.zeros(rows), "i_q_a": np.full(rows, i_q)}
    meta = {"coasting": False, "offset_rad": evaluation.offset.value, "direction": 1}  # type: ignore[union-attr]
    units = {"theta_M_rad": "rad", "i_d_a": "A", "i_q_a": "A"}
    push = {"inertia_0": Trace(t_s, signals, units, meta)}
    lossy, lossless = (pushes_of(push, seen, None) for seen in (evaluation, _shown(evaluation, 0.0)))
    assert lossy is not None and lossless is not None
    omega_e = omega_m * round(evaluation.encoder.pole_pairs.value)
    L_q = best_L_q(evaluation.inductance, evaluation.flux).value
    expected = omega_e * L_q * i_q / evaluation.effects()[IRON_LOSS].value
    found = lossy.parts[0]["i_d_a"] - lossless.parts[0]["i_d_a"]
    assert found[rows // 2] == pytest.approx(expected, rel=1e-6) and expected > 0.0


def test_the_drag_bounds_the_loss() -> None:
    """A loss that would brake more than B is none: what brakes less than a hundredth is no contradiction."""
    evaluation, truth = _found()
    assert evaluation.encoder is not None and evaluation.flux is not None
    drag = iron_drag(round(evaluation.encoder.pole_pairs.value), evaluation.flux.psi_measured.value, truth)
    for share, found in ((1.1, True), (0.5, False)):
        B = Estimate(share * drag, 0.0, 0.0, "N m s")
        braked = replace(evaluation, mechanics=_Friction(B))  # type: ignore[arg-type]
        assert least_ohm(braked) == pytest.approx(truth / share, rel=1e-6)
        assert (iron_loss_of(braked) is not None) == found
    assert math.isclose(least_ohm(evaluation), 0.0), "without torque pulses there is no bound"


class _Friction:
    """What of the mechanics bounds the loss."""

    drag = None

    def __init__(self, B: Estimate) -> None:
        self.B = B
