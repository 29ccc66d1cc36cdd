# SPDX-License-Identifier: MIT
"""The recorder level tells R and psi at the reference temperature, as the full one; ratios stay those of the run."""

from __future__ import annotations

import math

import pytest

from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.resistance import Copper, copper_of
from pmsmtool.identification.by_pulses import PulseFacts, PulseResult, pulse_result
from pmsmtool.identification.completed_machine import UNKNOWN_TEMPERATURE_K, completed_machine
from pmsmtool.identification.request import Method
from pmsmtool.machine.machine_file import load_machine_file, machine_path
from tests.estimators.test_recorded_push import PAIRS, T_S, swing

WARM_C, RISE_K, ALPHA, ALPHA_PSI = 60.0, 40.0, 0.00393, -0.0012
TOLERANCE = SensorTolerance()


def told(T_c: float | None, **known: object) -> PulseResult:
    facts = PulseFacts(Method.RECORDER, T_S, PAIRS, T_winding_c=T_c, T_magnet_c=T_c)
    traces = {f"push_{k}": trace for k, trace in enumerate(swing())}
    return pulse_result(traces, facts, TOLERANCE, **known)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def warm() -> PulseResult:
    return told(WARM_C)


@pytest.fixture(scope="module")
def unknown() -> PulseResult:
    return told(None)


def test_resistance_and_flux_are_told_at_the_reference_temperature(warm: PulseResult, unknown: PulseResult) -> None:
    """Nobody says how much of the loop is copper: what devices may be of it widens the interval."""
    R, raw = warm.estimates["R_s_ohm"], unknown.estimates["R_s_ohm_measured"]
    factor = 1.0 + ALPHA * RISE_K
    assert R.value == pytest.approx(raw.value / factor) and R.std == pytest.approx(raw.std / factor)
    assert R.T_c == WARM_C and R.dof == raw.dof and not R.fallback
    devices = TOLERANCE.device_share_max * ALPHA * RISE_K * R.value
    sensor = ALPHA * TOLERANCE.temperature_k * R.value
    assert R.systematic == pytest.approx(math.hypot(raw.systematic / factor, devices, sensor))
    psi, raw = warm.estimates["psi_f_wb"], unknown.estimates["psi_f_wb"]
    assert psi.value == pytest.approx(raw.value / (1.0 + ALPHA_PSI * RISE_K)) and psi.T_c == WARM_C
    assert warm.estimates["L_q_app_h"] == unknown.estimates["L_q_app_h"]


def test_a_temperature_nobody_knows_is_said(unknown: PulseResult) -> None:
    R, raw = unknown.estimates["R_s_ohm"], unknown.estimates["R_s_ohm_measured"]
    assert R.fallback.startswith("winding temperature unknown: R_s as measured") and R.value == raw.value
    hot = 1.0 - 1.0 / (1.0 + ALPHA * 70.0)  # of the winding at 90 degC: farther off than at 5 degC
    assert R.systematic == pytest.approx(math.hypot(raw.systematic, hot * R.value)) and R.std == raw.std
    assert unknown.estimates["psi_f_wb"].fallback == "magnet temperature unknown: psi_f is not normalised"
    assert math.isnan(unknown.estimates["R_s_ohm"].T_c)


def test_a_known_winding_leaves_no_doubt_about_the_devices(warm: PulseResult, unknown: PulseResult) -> None:
    raw = unknown.estimates["R_s_ohm_measured"]
    R = told(WARM_C, copper=Copper(R_winding_ohm=0.3)).estimates["R_s_ohm"]
    assert R.value == pytest.approx(raw.value - 0.3 * ALPHA * RISE_K)
    assert R.systematic < warm.estimates["R_s_ohm"].systematic


def test_a_machine_takes_the_values_once_and_inertia_by_the_flux_of_the_run(
    warm: PulseResult, unknown: PulseResult
) -> None:
    """J/psi was measured with warm magnets: with the flux at the reference temperature J would be 5 % too large."""
    known = load_machine_file(machine_path("interior-2k2"))
    assert copper_of(known) == Copper(known.machine.T_ref_c, known.machine.alpha_R_per_k)
    made = completed_machine(known, warm.estimates, "as given").machine
    assert made is not None and made.machine.J_kgm2 is not None
    assert made.machine.R_s_ohm == warm.estimates["R_s_ohm"].value
    psi, ratio = warm.estimates["psi_f_wb"].value, warm.estimates["J_per_psi"].value
    assert made.machine.psi_f_wb == psi
    assert made.machine.J_kgm2 == pytest.approx(ratio * psi * (1.0 + ALPHA_PSI * RISE_K))
    cold = completed_machine(known, unknown.estimates, "as given")
    assert cold.machine is not None and any("no sensor shows its temperature" in note for note in cold.notes)
    assert cold.machine.systematic["R_s_ohm"] == unknown.estimates["R_s_ohm"].systematic, "not widened twice"
    assert cold.machine.estimates["R_s_ohm_measured"] == unknown.estimates["R_s_ohm_measured"]
    raw = unknown.estimates["psi_f_wb"]
    assert cold.machine.machine.J_kgm2 == pytest.approx(unknown.estimates["J_per_psi"].value * raw.value)
    widened = math.hypot(raw.systematic, -ALPHA_PSI * UNKNOWN_TEMPERATURE_K * raw.value)
    assert cold.machine.systematic["psi_f_wb"] == pytest.approx(widened)
