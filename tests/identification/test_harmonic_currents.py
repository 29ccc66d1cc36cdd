# SPDX-License-Identifier: MIT
"""What harmonics of the back-EMF take from the torque of a push, against the power of the circuit in closed form."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pmsmtool.estimators.current_sensors import Noise
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.flux.linkage import FluxResult
from pmsmtool.estimators.injection.sampling_instant import Sampling
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.identification import evaluate
from pmsmtool.identification.mechanics import HARMONIC_PARTS, _drag_of_unknown_instant, _harmonic_current
from pmsmtool.machine.parameters import Estimate
from pmsmtool.trace import Trace

R, K_P, PSI, PAIRS, SIGMA_A, ROWS = 0.5, (0.8, 1.2), 0.05, 4, 0.01, 4000
KNOWN = Estimate(1.0, 0.001, 0.0, "1")
WITHIN = 0.01
"""Relative; measured 0.14 %."""


def push(amplitudes: tuple[float, float], sense: float = 1.0) -> Trace:
    """A push to 400 rad/s with currents of the 6th order on 5 A."""
    t = np.linspace(0.0, 0.5, ROWS)
    theta = sense * 0.5 * 800.0 * t * t
    noise = np.random.default_rng(5).normal(0.0, SIGMA_A, (2, ROWS))
    i_d, i_q = (a * np.cos(6.0 * PAIRS * theta + at) for a, at in zip(amplitudes, (0.3, 1.0), strict=True))
    signals = {"i_d_a": i_d + noise[0], "i_q_a": sense * 5.0 + i_q + noise[1], "theta_M_rad": theta}
    return Trace(t, signals, {"i_d_a": "A", "i_q_a": "A", "theta_M_rad": "rad"}, {"K_p_v_per_a": K_P})


def known(curve: InverterCurve | None = None) -> Any:
    return SimpleNamespace(
        flux=SimpleNamespace(psi_measured=SimpleNamespace(value=PSI)),
        resistance=SimpleNamespace(R_measured=SimpleNamespace(value=R), curve=curve),
        offset=SimpleNamespace(value=0.0),
        noise=Noise(SIGMA_A, 0.0, 0.0),
    )


@pytest.mark.parametrize("sense", [1.0, -1.0])
@pytest.mark.parametrize("direction", [1, -1])
def test_the_power_against_resistance_and_gain_brakes_the_shaft(sense: float, direction: int) -> None:
    """EMF of 10 % of the 5th and 6 % of the 7th: J was 2.4 and 1.3 % too large on two drives of 48 V."""
    amplitudes = (1.0, 0.4)
    trace = push(amplitudes, sense)
    counted = replace(trace, signals={**trace.signals, "theta_M_rad": direction * trace["theta_M_rad"]})
    taken = _harmonic_current(counted, direction, PAIRS, known())
    power = sum(0.5 * a * a * (R + K_p) for a, K_p in zip(amplitudes, K_P, strict=True))
    last = np.arange(ROWS) >= ROWS - ROWS // HARMONIC_PARTS
    omega = PAIRS * sense * 800.0 * float(np.mean(trace.t_s[last]))
    assert float(np.mean(taken[last])) == pytest.approx(power / (omega * PSI), rel=WITHIN)
    assert not np.any(taken[: ROWS // HARMONIC_PARTS])  # the current's step is there


def test_noise_of_the_sensors_brakes_nothing() -> None:
    assert np.max(np.abs(_harmonic_current(push((0.0, 0.0)), 1, PAIRS, known()))) < 1e-5  # measured 1.2e-6 A


def test_a_push_that_moved_nothing_has_no_harmonics() -> None:
    """A light rotor that cogging held, 60 W: a division by its speed ended the command with exit 70."""
    trace = push((0.5, 0.2))
    stood = replace(trace, signals={**trace.signals, "theta_M_rad": np.zeros(ROWS)})
    assert not np.any(_harmonic_current(stood, 1, PAIRS, known()))


def test_the_inverter_drives_its_own_harmonics() -> None:
    """Its error alone, behind R and K_p: 0.65 % of J, which a healthy drive without harmonics would have lost."""
    curve = InverterCurve(np.array([0.5, 1.0]), np.array([2.0, 2.0]), 0.0)
    trace = push((0.0, 0.0))
    ripple = np.zeros((2, ROWS))
    for _ in range(20):  # the error is that of the currents it drives
        error = np.stack(curve.error_dq_v(ripple[0], 5.0 + ripple[1], PAIRS * trace["theta_M_rad"]))
        mean = np.mean(error, axis=1, keepdims=True)
        ripple = 0.5 * ripple - 0.5 * (error - mean) / (R + np.array(K_P)[:, None])
    noise = np.random.default_rng(6).normal(0.0, SIGMA_A, (2, ROWS))
    signals = {**trace.signals, "i_d_a": ripple[0] + noise[0], "i_q_a": 5.0 + ripple[1] + noise[1]}
    driven = Trace(trace.t_s, signals, trace.units, trace.meta)
    without, with_it = (
        abs(float(np.mean(_harmonic_current(driven, 1, PAIRS, known(c))[-500:]))) for c in (None, curve)
    )
    assert with_it < 0.1 * without  # measured 0.006 of it


def test_what_is_not_sure_to_be_the_samples_instant_is_in_the_friction() -> None:
    """A sample 7 us late at w shows w psi 7 us/L_q too much; the torque of that over the speed is a part of B."""
    psi, L_q, pole_pairs, late_s = 0.02, 4.7e-4, 13, -7e-6
    two = 1.5 * pole_pairs * psi * (pole_pairs * psi * 7e-6 / L_q)
    flux = SimpleNamespace(psi_measured=SimpleNamespace(value=psi))
    cases = ((None, late_s, two), (Sampling(), late_s, 0.0), (Sampling(), -late_s, two), (None, None, 0.0))
    for sampling, shown_s, expected in cases:  # what is used may be an old angle, which no early sample is
        shown = None if shown_s is None else SimpleNamespace(value_s=shown_s)
        result = SimpleNamespace(flux=flux, shown=shown, inductance=SimpleNamespace(sampling=sampling))
        assert _drag_of_unknown_instant(cast(Any, result), pole_pairs, L_q) == pytest.approx(0.5 * expected)
    refused = SimpleNamespace(flux=flux, shown=SimpleNamespace(value_s=late_s), inductance=None)
    assert _drag_of_unknown_instant(cast(Any, refused), pole_pairs, L_q) == pytest.approx(0.5 * two)
    assert _drag_of_unknown_instant(cast(Any, refused), pole_pairs, 0.0) == 0.0


@pytest.mark.parametrize(("shown_s", "hidden_s"), [(33e-6, 5e-6), (-13e-6, 5e-6), (6e-6, 3e-6), (0.0, 0.0)])
def test_an_instant_that_eddy_currents_hide_is_in_the_flux_linkage(
    monkeypatch: pytest.MonkeyPatch, shown_s: float, hidden_s: float
) -> None:
    """Half of what the run over speeds shows, at most 5 us: nothing of it is corrected."""
    psi, per_s = replace(KNOWN, value=0.7), -2000.0  # 0.2 % per us: L/R of 1.6 ms, and a ripple as large as i_d

    def flux_of(*given: Any) -> Any:
        value = 0.69 * (1.0 + per_s * given[6].instant_s) if len(given) > 6 else 0.0
        return SimpleNamespace(psi_measured=replace(psi, value=value))

    monkeypatch.setattr(evaluate, "flux_of", flux_of)
    flux = FluxResult(psi, psi, psi, None, 0.0, psi, 0.0, 0.0, 0.0, 0.0, np.zeros(1), np.zeros(1),
                      cast(Any, SimpleNamespace(value_s=shown_s)))  # fmt: skip
    inductance = SimpleNamespace(L_d=psi, L_q=psi, sampling=None)
    result = evaluate.Evaluation(Noise(SIGMA_A, 0.0, 0.0), flux=flux, inductance=cast(Any, inductance),
                                 resistance=cast(Any, known().resistance))  # fmt: skip
    found = evaluate.as_sampled({}, result, 1e-4, 0.0, SensorTolerance()).flux
    assert found is not None and found.psi_f == found.psi_measured and found.psi_f.value == 0.7
    assert found.psi_f.std == pytest.approx(np.hypot(0.001, 0.7 * per_s * hidden_s))
