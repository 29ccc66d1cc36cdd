# SPDX-License-Identifier: MIT
"""Harmonics of the back-EMF from records of a machine integrated in phase quantities, beside a dead time."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.cogging import truths_of
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.estimate import SensorTolerance, Verdict, total_half_width
from pmsmtool.estimators.injection.sampling_instant import Sampling
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.resistance import ResistanceResult
from pmsmtool.identification.emf_harmonics import EmfHarmonics, harmonics_of
from pmsmtool.identification.evaluate import Evaluation
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

R, L_D, L_Q, PSI, POLE_PAIRS = 1.0, 8e-3, 12e-3, 0.2, 4
PERIOD_S, ROWS, SETTLE, FINE = 1e-4, 900, 300, 6
I_D, KNEE, V_DEAD, K_P, K_I = 3.0, 0.3, 4.0, 8.0, 1600.0
NOISE_A = 5e-3
OFFSET_RAD, EPS_RAD = 0.7, 0.05
"""Encoder offset, and what the frame of the records is ahead of the d axis."""
THIRDS = np.array([0.0, 2.0, 4.0]) * math.pi / 3.0
VECTOR = 2.0 / 3.0 * np.exp(1j * THIRDS)
Array, Complex = NDArray[np.float64], NDArray[np.complex128]


def of_magnets(theta: Array, harmonics: dict[int, complex]) -> Complex:
    """Flux of the magnets in the stator's frame (Wb): of phases with psi_m cos(m theta_x - phase) at their angles."""
    x = theta[:, None] - THIRDS
    flux = PSI * np.cos(x)
    for order, value in harmonics.items():
        flux = flux + abs(value) * np.cos(order * x - cmath.phase(value))
    return np.asarray(flux @ VECTOR)


def records(w: Array, i_d: Array, harmonics: dict[int, complex], V_dead: float) -> list[Trace]:
    """One record per speed: flux of the phases over time, a voltage one period late, a current control."""
    rng = np.random.default_rng(7)
    h = PERIOD_S / FINE
    theta = np.full(len(w), 0.3)
    flux = (PSI + L_D * i_d) * np.exp(1j * theta)
    waiting = 1j * w * flux
    integral = R * i_d + 1j * w * (PSI + L_D * i_d)
    rows = []
    for k in range(ROWS + SETTLE):
        shown = current(flux, theta, harmonics) * np.exp(-1j * (theta + EPS_RAD))
        shown = shown + rng.normal(0.0, NOISE_A, (2, len(w))).T @ np.array([1.0, 1j])
        integral = integral + K_I * PERIOD_S * (i_d - shown)
        wanted = K_P * (i_d - shown) + integral
        if k >= SETTLE:
            rows.append((wanted.real, wanted.imag, shown.real, shown.imag, (theta + OFFSET_RAD) / POLE_PAIRS))
        now, waiting = waiting, wanted * np.exp(1j * (theta + EPS_RAD + 1.5 * w * PERIOD_S))
        for _ in range(FINE):
            i = current(flux, theta, harmonics)
            lost = (V_dead * np.tanh((i[:, None] * np.exp(-1j * THIRDS)).real / KNEE)) @ VECTOR
            flux = flux + h * (now - lost - R * i)
            theta = theta + h * w
    names = ("u_d_v", "u_q_v", "i_d_a", "i_q_a", "theta_M_rad")
    meta = {"offset_rad": OFFSET_RAD - EPS_RAD, "direction": 1, "delay_periods": 1.5}
    return [
        Trace(
            PERIOD_S * np.arange(ROWS),
            dict(zip(names, table, strict=True)) | {"flagged": np.zeros(ROWS)},
            dict.fromkeys((*names, "flagged"), "1"),
            meta,
        )
        for table in np.array(rows).transpose(2, 1, 0)
    ]


def current(flux: Complex, theta: Array, harmonics: dict[int, complex]) -> Complex:
    """Return the current in the stator's frame (A): of what the magnets leave of the flux linkage."""
    own = (flux - of_magnets(theta, harmonics)) * np.exp(-1j * theta)
    return np.asarray((own.real / L_D + 1j * own.imag / L_Q) * np.exp(1j * theta))


def identified(runs: list[Trace], measured_dead: float) -> EmfHarmonics:
    def estimate(value: float, std: float, unit: str) -> Estimate:
        return Estimate(value, std, 0.0, unit)

    grid = np.linspace(0.02, 6.0, 120)
    curve = InverterCurve(grid, measured_dead * np.tanh(grid / KNEE), 0.0)
    resistance = estimate(R, 1e-3, "ohm")
    result = SimpleNamespace(
        resistance=ResistanceResult(resistance, resistance, curve, measured_dead, 0.0, Verdict.PASS),
        inductance=SimpleNamespace(L_d=estimate(L_D, 1e-5, "H"), L_q=estimate(L_Q, 1e-5, "H"), sampling=Sampling()),
        flux=SimpleNamespace(psi_measured=estimate(PSI, 1e-4, "Wb")),
        encoder=SimpleNamespace(direction=1, pole_pairs=estimate(POLE_PAIRS, 0.0, "1")),
        offset=estimate(OFFSET_RAD, 1e-4, "rad"),
    )
    traces = {f"turns_{k}": trace for k, trace in enumerate(runs)}
    found = harmonics_of(traces, cast(Evaluation, result), SensorTolerance(), PERIOD_S)
    assert found is not None
    return found


def run(harmonics: dict[int, complex], V_dead: float, speeds: tuple[float, ...] = (180.0, 280.0, 400.0)) -> list[Trace]:
    rows = [(sense * w, sign * I_D) for sense in (1, -1) for w in speeds for sign in (1, -1)]
    w, i_d = np.array(rows).T
    return records(w, i_d, harmonics, V_dead)


@pytest.mark.chain
def test_harmonics_come_with_amplitude_and_phase_beside_a_dead_time() -> None:
    """2 % and 0.8 % of the back-EMF, beside a dead time whose measured curve is 20 % off."""
    true = {5: cmath.rect(0.02 * PSI / 5.0, 0.9), 7: cmath.rect(0.008 * PSI / 7.0, -2.0)}
    values = identified(run(true, V_DEAD), 1.2 * V_DEAD).estimates()
    for order, value in true.items():
        amplitude, phase = values[f"psi_{order}_wb"], values[f"psi_{order}_rad"]
        assert amplitude.value == pytest.approx(abs(value), abs=0.001 * PSI / order)
        assert abs(math.remainder(phase.value - cmath.phase(value), 2.0 * math.pi)) < math.radians(5.0)
        assert abs(amplitude.value - abs(value)) < 1.5 * total_half_width(amplitude)


def test_a_dead_time_alone_is_no_harmonic_of_the_back_emf() -> None:
    """Its 5th and 7th are 20 and 12 times the interval at the lowest speed."""
    values = identified(run({}, V_DEAD), 0.8 * V_DEAD).estimates()
    assert set(values) == {"psi_5_wb", "psi_7_wb"}  # not found: no phase
    for order in (5, 7):
        assert values[f"psi_{order}_wb"].value < total_half_width(values[f"psi_{order}_wb"]) < 0.001 * PSI / order


def test_limited_records_are_left_out_and_too_few_refused() -> None:
    """One speed alone does not tell the dead time from the back-EMF."""
    true = {5: complex(0.02 * PSI / 5.0)}
    runs = run(true, 0.0)
    for k in (0, 5):
        runs[k].signals["flagged"][3] = 1.0  # type: ignore[index]
        runs[k].signals["u_q_v"][3:] += 5.0  # type: ignore[index]
    fifth = identified(runs, 0.0).estimates()["psi_5_wb"]
    assert fifth.value == pytest.approx(0.004 * PSI, rel=0.05)
    with pytest.raises(IdentificationError, match="E_CLIPPED.*7 left"):
        identified([*runs[:6], *runs[9:]], 0.0)
    with pytest.raises(IdentificationError, match="8 records do not separate the dead time"):
        identified([*runs[10:], *runs[10:], *runs[4:5], *runs[4:5], *runs[10:]], 0.0)


def test_the_benchmark_knows_that_the_harmonics_of_warm_magnets_are_smaller() -> None:
    """Without it a right value on a warm drive was 4 to 6 half widths off."""
    drive = load_machine_file("interior-2k2")
    warm = {"psi_6_wb": 0.01, "psi_7_wb": 0.004, "T_magnet_c": drive.machine.T_ref_c + 50.0, "alpha_psi_per_k": -0.0012}
    truths = truths_of(replace(drive, simulation={**drive.simulation, **warm}))
    assert truths["psi_5"][0] == pytest.approx(0.01 * 0.94) and truths["psi_7"][0] == pytest.approx(0.004 * 0.94)
