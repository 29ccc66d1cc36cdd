# SPDX-License-Identifier: MIT
"""Sampling instant and sensor lag that nobody told: R, L and psi_f of a whole identification over CANopen.

A drive that samples in time is in ``tests/measurement/test_speed_run.py``.
"""

from dataclasses import replace
from functools import cache

import pytest

from benchmarks.identification_coverage import drawn, evaluated, measured, threshold_share, truth_of
from pmsmtool.estimators.estimate import SensorTolerance, total_half_width
from pmsmtool.identification.evaluate import Evaluation, flux_of
from pmsmtool.identification.iron_loss import iron_loss_lines
from pmsmtool.identification.sampling import timing_estimates
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.sim.simulated_machine import Settings
from pmsmtool.trace import Trace

pytestmark = pytest.mark.chain

SEED = 41023  # 560 V, sampled 4.75 us late (7.1 % of a period) through a lag of 1.0 us
INSTANT_S, LAG_S = 4.75e-6, 1.03e-6


@cache
def _found() -> tuple[dict[str, Trace], MachineFile, Evaluation, dict[str, float], float]:
    drive = drawn("", SEED, "timing")
    traces, nameplate, _ = measured(drive, accuracy=0.01)
    evaluation = evaluated(traces, nameplate)
    share = threshold_share({"profile": "", "seed": SEED, "block": "timing"})
    return traces, nameplate, evaluation, truth_of(drive, evaluation), share


def test_values_are_those_of_the_mean_current() -> None:
    _, _, evaluation, truth, share = _found()
    assert evaluation.resistance is not None and evaluation.inductance is not None and evaluation.flux is not None
    # besides the thresholds of the bridge, which act as another DC link and which no current shows
    # 2e-4 and less, and -4.6e-4 of a run that begins two reads of the drive later
    assert evaluation.flux.psi_f.value / truth["psi_f_wb"] - 1.0 + share == pytest.approx(0.0, abs=7e-4)
    R = evaluation.resistance.R_measured.value / truth["R_at_T_ohm"] - 1.0 + share
    assert R == pytest.approx(0.0, abs=3.5e-3)  # 2.1, 2.7e-3: half of what an angle as old would leave
    for found, name in ((evaluation.inductance.L_d, "L_d_h"), (evaluation.inductance.L_q, "L_q_h")):
        assert found.value / truth[name] - 1.0 + share == pytest.approx(0.0, abs=2.5e-3)  # 1.1e-3 and less


def test_the_instant_is_told() -> None:
    _, _, evaluation, _, _ = _found()
    found = timing_estimates(evaluation.inductance, evaluation.shown, SensorTolerance())
    instant, lag = found["sampling_instant_s"], found["current_lag_s"]
    for estimate, truth_s in ((instant, INSTANT_S), (lag, LAG_S)):
        assert abs(estimate.value - truth_s) < 2.0 * estimate.std
    # what they do together is known better, where the lag is far below a period
    assert evaluation.shown is not None
    assert instant.value - lag.value == pytest.approx(INSTANT_S - LAG_S, abs=2.0 * evaluation.shown.std_s + 0.3e-6)
    (line,) = iron_loss_lines(evaluation)
    assert "sampled +" in line and "old" in line


def test_psi_f_is_wrong_for_samples_taken_to_be_in_time() -> None:
    """The test above could not fail if nothing had to be corrected."""
    drive = drawn("", SEED, "timing")
    assert Settings(drive.simulation_settings()).number("sampling_shift_s") == pytest.approx(INSTANT_S, rel=2e-3)
    traces, nameplate, evaluation, truth, share = _found()
    assert evaluation.resistance is not None
    plain = flux_of(
        traces, evaluation.resistance, nameplate.inverter.T_s, nameplate.machine.alpha_psi_per_k, SensorTolerance()
    )
    assert plain.psi_f.value / truth["psi_f_wb"] - 1.0 + share > 2e-3


AGE_S = 9.2e-6
BESIDE_AN_AGE = 1.1
"""Of the total interval: R 1.01, L_d 0.95, psi 0.46 of it; all of it is the age, which is read as a late sample."""


def test_an_old_encoder_angle_is_in_the_intervals() -> None:
    """It is read as a late sample, which left L 2.8 % too small, 1.9 times the interval."""
    drive = drawn("", 171006, "ideal")
    drive = replace(drive, simulation={**drive.simulation, "encoder_latency_s": AGE_S})
    traces, nameplate, _ = measured(drive, accuracy=0.01)
    evaluation = evaluated(traces, nameplate)
    truth = truth_of(drive, evaluation)
    assert evaluation.resistance is not None and evaluation.inductance is not None and evaluation.flux is not None
    found = {
        "L_d_h": evaluation.inductance.L_d, "L_q_h": evaluation.inductance.L_q,
        "R_at_T_ohm": evaluation.resistance.R_measured, "psi_f_wb": evaluation.flux.psi_f,
    }  # fmt: skip
    for name, value in found.items():
        assert abs(value.value - truth[name]) < BESIDE_AN_AGE * total_half_width(value), name
