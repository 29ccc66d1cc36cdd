# SPDX-License-Identifier: MIT
"""Square waves: where the frame stands, and a rotor that still moves in a shot."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from pmsmtool.estimators.angle_harmonics import Harmonic
from pmsmtool.estimators.current_sensors import Noise
from pmsmtool.estimators.encoder import EncoderResult
from pmsmtool.estimators.estimate import Verdict
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.resistance import ResistanceResult
from pmsmtool.experiments import square_injection
from pmsmtool.machine.parameters import Estimate
from pmsmtool.measurement.square_waves import LEADS, SquareStage, knee_of, whole_periods
from pmsmtool.trace import Trace

PAIRS = 4
ENCODER = EncoderResult(Estimate(PAIRS, 0.0, 0.0, "1"), 1, Estimate(0.0, 0.0, 0.0, "rad"), 0.0)
PLAN = square_injection.SquarePlan(30.0, 15.0, 50.0)


@pytest.mark.parametrize(
    ("ways_deg", "recorded"), [((0.1, 9.0, 9.0), 1), ((3.1, 0.4, 9.0), 2), ((9.0, 2.5, 0.3), 3), ((9.0, 2.5, 2.4), 3)]
)
def test_a_shot_is_recorded_until_the_rotor_stands_still(
    ways_deg: tuple[float, ...], recorded: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """mtpv-test with a winding of 42 to 90 degC lost L_d and L_q: its rotor came back by 3.1 degrees in one shot."""
    plans: list[square_injection.SquarePlan] = []

    def inject(drive: Any, plan: square_injection.SquarePlan, *rest: Any) -> Trace:
        way = math.radians(ways_deg[len(plans)]) / PAIRS
        plans.append(plan)
        return Trace(np.arange(400) / 8e3, {"theta_M_rad": np.linspace(0.0, way, 400)}, {"theta_M_rad": "rad"})

    monkeypatch.setattr(square_injection, "inject_square", inject)
    kept: dict[str, Trace] = {}
    stage = SquareStage(None, None, kept.__setitem__, print, ripple_share=0.25)  # type: ignore[arg-type]
    shot = stage._shot("square_q_9", ENCODER, replace(PLAN, samples=100), "q", 9, 50.0)
    assert kept == {"square_q_9": shot}
    assert {plan.samples for plan in plans} == {whole_periods(9)}, "few samples are enough, few periods are not"
    assert [plan.lead_s for plan in plans] == pytest.approx([lead * PLAN.lead_s for lead in LEADS[:recorded]])
    assert math.degrees(float(shot["theta_M_rad"][-1])) * PAIRS == pytest.approx(ways_deg[recorded - 1])


@pytest.mark.parametrize(("longest_a", "L_h"), [(2.9, 10.0 * 9e-4 / 2.9), (1.5, 1.1 * 3e-3)])
def test_a_loop_for_the_runs_takes_no_rough_inductance_far_above_another(
    longest_a: float, L_h: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half periods of 6 and 9 samples showed 0.86 and 1.6 L: decoupled by 1.6 L, the drive tripped at speed."""
    ripples = {6: 2.0, 9: longest_a}  # 3 mH by the shorter

    def shot(self: SquareStage, name: str, *rest: Any) -> str:
        return name

    monkeypatch.setattr(SquareStage, "_hold_stable_bias", lambda self, plan, *_: plan)
    monkeypatch.setattr(SquareStage, "_further_angles", lambda self, plan, *_: plan)
    monkeypatch.setattr(SquareStage, "_shot", shot)
    monkeypatch.setattr(square_injection, "find_amplitude", lambda *_: 10.0)
    monkeypatch.setattr(square_injection, "ripple_of", lambda name, axis: ripples[int(name.split("_")[-1])])
    monkeypatch.setattr(square_injection, "slow_half_period", lambda *_: 0)
    R = Estimate(0.9, 1e-3, 0.01, "ohm")
    resistance = ResistanceResult(R, R, InverterCurve(np.ones(1), np.zeros(1), 0.0), 0.0, 0.0, Verdict.PASS)
    drive = Mock(period_s=1e-4)
    stage = SquareStage(drive, Mock(I_test_apk=10.0, V_max_v=20.0), print, print, ripple_share=0.25)  # type: ignore[arg-type]
    assert PLAN.half_periods == (6, 9)
    assert stage.measure(Mock(), resistance, ENCODER) == pytest.approx((L_h, L_h))


@pytest.mark.parametrize(("error_deg", "known", "angles_deg"), [(1.1, True, [0.0, 4.4]), (0.4, False, [0.0, 1.6])])
def test_a_frame_does_not_follow_what_the_encoder_errs(
    error_deg: float, known: bool, angles_deg: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rotor that stood on its vector was shown 4 degrees ahead of any: the frame ended at 27, a phase in the knee."""
    held: list[float] = []
    monkeypatch.setattr(square_injection, "hold_bias", lambda _, plan: held.append(plan.angle_rad))
    shown = SimpleNamespace(
        period_s=1e-4, average=lambda *_: {"theta_m_rad": held[-1] / PAIRS + math.radians(error_deg)}
    )
    found = (Harmonic(1, 0.0, math.radians(1.2), 1e-5),) if known else ()
    stage = SquareStage(shown, None, print, print, ripple_share=0.25)  # type: ignore[arg-type]
    plan = stage._hold_stable_bias(PLAN, replace(ENCODER, per_turn=found), 0.5, Noise(0.01, 0.0, 0.0))
    assert plan.angle_rad == held[-1] and np.degrees(held) == pytest.approx(angles_deg)


@pytest.mark.parametrize(("plateau_v", "knee_a"), [(5e-4, 0.5), (5.0, 2.0)])
def test_an_error_within_the_interval_of_R_has_no_knee(plateau_v: float, knee_a: float) -> None:
    """A plateau of 0.5 mV had a knee of 54 A on levels up to 12 A: the ripple was a fifth of the wanted one."""
    i = np.linspace(0.5, 12.0, 12)
    noise_v = 1e-4 * np.sin(7.0 * np.arange(12.0))
    error_v = noise_v if plateau_v < 1.0 else plateau_v * np.minimum(1.0, i / knee_a)
    curve = InverterCurve(i, error_v, 0.0)
    R = Estimate(0.9, 1e-3, 0.01, "ohm")  # 24 mV of interval at 12 A
    assert knee_of(ResistanceResult(R, R, curve, plateau_v, 0.0, Verdict.PASS)) == pytest.approx(knee_a, rel=1e-3)
