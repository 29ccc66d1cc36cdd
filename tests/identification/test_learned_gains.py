# SPDX-License-Identifier: MIT
"""Form, scale and convention out of measured loops: what is decided is right, and what is not stays unknown."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from pmsmtool.identification.learned_gains import (
    Observation,
    Rotor,
    convention,
    emf_doubt,
    gain_scale,
    integral_scale,
    lag_doubt,
)
from pmsmtool.identification.speed_loop_response import SpeedLoop

J = 2e-3
COUNT, COUNTS, INTEGRALS = 4e-5, 2000, 500
A0 = COUNT * COUNTS / J
RATE = 8.0
F_S = 2000.0 / 0.12
ROTOR = Rotor(J, 0.02, 1.0, F_S)
P, I = "speed.K_p_nms_per_rad", "speed.K_i_nm_per_rad"  # noqa: E741


def loop(a: float, b: float, amps: float = 0.02) -> SpeedLoop:
    return SpeedLoop(a, b, 2e-3, 1e-3, amps)


def b_of(form: str, gain: int, integral: int) -> float:
    a = A0 * gain / COUNTS
    ratio = integral / INTEGRALS
    return {"value": A0 * RATE * ratio, "rate": a * RATE * ratio, "time": a * RATE / ratio, "none": A0 * RATE}[form]


def observed(form: str, half_size: float = 0.0) -> tuple[list[Observation], Observation, list[Observation]]:
    def one(gain: int, integral: int, off: float = 0.0) -> Observation:
        return Observation(gain, integral, loop(A0 * gain / COUNTS, b_of(form, gain, integral) * math.exp(off)))

    base = [one(COUNTS, INTEGRALS), one(COUNTS, INTEGRALS, half_size)]
    return base, one(1400, INTEGRALS), [one(COUNTS, 400), one(COUNTS, 250)]


@pytest.mark.parametrize(
    ("form", "unit", "scale"),
    [("value", "N m/rad", J * A0 * RATE / INTEGRALS), ("rate", "1/s", RATE / INTEGRALS),
     ("time", "s", 1.0 / RATE / INTEGRALS)],
)  # fmt: skip
def test_each_form_is_told_apart(form: str, unit: str, scale: float) -> None:
    base, gain_changed, integral_changed = observed(form)
    gain = gain_scale(base, gain_changed, ROTOR.basis, P)
    assert gain.scale == pytest.approx(COUNT, rel=1e-3) and gain.half_width < 0.12
    found = integral_scale(base, gain_changed, integral_changed, ROTOR.basis, I)
    assert (found.form, found.unit) == (form, unit) and found.scale == pytest.approx(scale, rel=3e-3)
    assert min(found.chi_squares, key=lambda name: found.chi_squares[name]) == form


def test_what_is_not_told_apart_stays_unknown() -> None:
    base, _, integral_changed = observed("value")
    between = Observation(1400, INTEGRALS, loop(0.7 * A0, math.sqrt(0.7) * A0 * RATE))
    found = integral_scale(base, between, integral_changed, ROTOR.basis, I)
    assert found.scale is None and "cannot be separated" in found.why


def test_steps_of_two_sizes_say_what_friction_leaves() -> None:
    base, gain_changed, integral_changed = observed("rate", half_size=-0.04)
    found = integral_scale(base, gain_changed, integral_changed, ROTOR.basis, I)
    assert found.scale == pytest.approx(RATE / INTEGRALS)
    base, gain_changed, integral_changed = observed("rate", half_size=-0.15)
    found = integral_scale(base, gain_changed, integral_changed, ROTOR.basis, I)
    assert found.scale is None and "too wide" in found.why


def test_an_object_without_effect_is_named() -> None:
    base, gain_changed, integral_changed = observed("none")
    found = integral_scale(base, gain_changed, integral_changed, ROTOR.basis, I)
    assert found.scale is None and found.form is None and "no effect" in found.why


def test_a_response_that_does_not_follow_the_counts_decides_nothing() -> None:
    base, gain_changed, _ = observed("value")
    half = Observation(1400, INTEGRALS, loop(A0 * math.sqrt(0.7), A0 * RATE))
    assert "exponent 0.50" in gain_scale(base, half, ROTOR.basis, P).why
    assert gain_scale(base, None, ROTOR.basis, P).scale is None
    wide = gain_scale(base, gain_changed, Rotor(J, 0.13, 1.0, F_S).basis, P)
    assert wide.scale is None and "too wide" in wide.why
    sheet = gain_scale(base, gain_changed, Rotor(J, 0.0577, 1.0, F_S).basis, P)  # 10 % of a data sheet
    assert sheet.scale is not None and 0.113 < sheet.half_width < 0.13


def test_an_integral_that_moves_the_gain_too_is_not_one() -> None:
    base, gain_changed, _ = observed("value")
    both = Observation(COUNTS, 400, loop(0.8 * A0, 0.8 * A0 * RATE))
    assert "moved K_p" in integral_scale(base, gain_changed, [both], ROTOR.basis, I).why


@pytest.mark.parametrize(("kind", "ratio"), [("peak", 1.0), ("rms", math.sqrt(2.0)), ("block", 1.1027)])
def test_convention_from_the_acceleration_of_an_ampere(kind: str, ratio: float) -> None:
    torque_per_apk = 0.3
    shown = [Observation(1, 1, loop(A0, A0 * RATE, amps=J / (torque_per_apk * ratio)))] * 2
    assert convention(shown, Rotor(J, 0.005, 1.0, F_S), torque_per_apk, 0.005, 1.0).kind in (None, kind)
    wide = convention(shown, Rotor(J, 0.04, 1.0, F_S), torque_per_apk, 0.03, 1.0)
    assert wide.kind == ("rms" if kind == "rms" else None)
    read_as_rms = [Observation(1, 1, loop(A0, A0 * RATE, amps=math.sqrt(2.0) * J / (torque_per_apk * ratio)))]
    assert convention(read_as_rms, Rotor(J, 0.04, 1.0, F_S), torque_per_apk, 0.03, math.sqrt(2.0)).kind == wide.kind


def test_a_fit_that_ended_at_a_bound_decides_no_convention() -> None:
    rms = loop(A0, A0 * RATE, amps=J / (0.3 * math.sqrt(2.0)))
    for at_bound, kind in (("", "rms"), ("lag", None)):
        shown = [Observation(1, 1, replace(rms, at_bound=at_bound))]
        assert convention(shown, Rotor(J, 0.04, 1.0, F_S), 0.3, 0.03, 1.0).kind == kind


def test_what_the_emf_may_take_is_in_the_interval_that_it_moves() -> None:
    base, gain_changed, integral_changed = observed("time")
    ends = loop(A0, A0 * RATE), loop(1.16 * A0, 1.16 * A0 * RATE)
    moved = emf_doubt(*ends, 0.1)
    assert moved == pytest.approx((0.074, 0.074, 0.0), abs=1e-3)
    assert emf_doubt(*ends, 0.05) == pytest.approx((0.05, 0.05, 0.0))
    light = [replace(base[0], model_std=moved), *base[1:]]
    assert gain_scale(light, gain_changed, ROTOR.basis, P).scale is None
    assert integral_scale(light, gain_changed, integral_changed, ROTOR.basis, I).scale == pytest.approx(
        1.0 / RATE / INTEGRALS, rel=3e-3
    )


def test_a_lag_that_may_lie_before_the_torque_is_in_the_interval() -> None:
    """An EPOS2 with a current loop of 400 rad/s: K_p was told 10 % too small at +-7 %."""
    base, gain_changed, _ = observed("time")
    own, forward = replace(base[0].loop, misfit=7.5), loop(1.2 * A0, 1.2 * A0 * RATE)
    doubt = lag_doubt(own, replace(forward, misfit=5.5))
    assert doubt == pytest.approx((0.5 * math.log(1.2), 0.5 * math.log(1.2), 0.0), abs=1e-3)
    assert gain_scale([replace(base[0], model_std=doubt), *base[1:]], gain_changed, ROTOR.basis, P).scale is None
    assert lag_doubt(own, replace(forward, misfit=7.4)) == (0.0, 0.0, 0.0), "a fast current loop explains as much"


def test_a_small_current_leaves_gains_unknown() -> None:
    base, gain_changed, _ = observed("value")
    small = [replace(base[0], current_share=0.07), *base[1:]]
    assert gain_scale(base, gain_changed, ROTOR.basis, P).scale
    assert gain_scale(small, gain_changed, ROTOR.basis, P).scale is None


def test_what_does_not_flow_at_once_is_added_and_half_of_it_doubted() -> None:
    """A drive at 22 % of its rated current with K_p 5.5 % too small, and one at 10 % with 16 to 21 %."""
    base, gain_changed, integral_changed = observed("value")

    def shown(at_once: float) -> list[Observation]:
        return [replace(one, current_share=0.1, at_once=at_once) for one in (*base, gain_changed, *integral_changed)]

    own, half, less, *changed = shown(0.84)
    gain = gain_scale([own, half], less, ROTOR.basis, P)
    assert gain.scale == pytest.approx(COUNT * math.exp(0.048), rel=1e-3) and gain.half_width < 0.1
    found = integral_scale([own, half], less, changed, ROTOR.basis, I)
    assert found.scale == pytest.approx(J * A0 * RATE / INTEGRALS * math.exp(0.048), rel=3e-3)
    own, half, less, *_ = shown(0.40)
    assert gain_scale([own, half], less, ROTOR.basis, P).scale is None
