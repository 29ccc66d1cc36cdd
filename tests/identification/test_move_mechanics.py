# SPDX-License-Identifier: MIT
"""Inertia and friction from position moves: a shaft whose numbers are known, moved by a loop that saturates nothing."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.axis.move import Profile, plan
from pmsmtool.commissioning.contradiction import flux_doubt
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.identification.completed_machine import completed_machine
from pmsmtool.identification.move_mechanics import halves_of_moves, move_mechanics
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.trace import Trace

J, TAU_C, PSI, POLES = 2.4e-3, 0.08, 0.11, 4
WAY = 2.6
COUNT = 2.0 * math.pi / 8192


def moves(times: int, seed: int, acceleration: float = 150.0, tau_c: float = TAU_C) -> Trace:
    """Moves there and back at 1 kHz: whole counts of the angle, a noisy current, friction that opposes the speed."""
    rng = np.random.default_rng(seed)
    move = plan(WAY, Profile(20.0, acceleration, 20_000.0))
    span = move.duration_s + 0.2
    t = np.arange(0.0, 2 * times * span + 0.2, 1e-3)
    angle, speed, rise = (np.zeros_like(t) for _ in range(3))
    for k in range(2 * times):
        sign = 1.0 if k % 2 == 0 else -1.0
        for total, part in zip((angle, speed, rise), move.at(t - 0.2 - k * span), strict=True):
            total += sign * part
    torque = J * rise + tau_c * np.sign(np.where(np.abs(speed) > 1e-9, speed, 0.0))
    current = torque / torque_per_ampere(POLES, PSI) + rng.normal(0.0, 0.02, t.size)
    seen = np.round((angle + rng.normal(0.0, 0.2 * COUNT, t.size)) / COUNT) * COUNT
    signals = {"theta_ref_rad": angle, "theta_m_rad": seen, "i_q_a": current}
    return Trace(t, signals, {"theta_ref_rad": "rad", "theta_m_rad": "rad", "i_q_a": "A"}, {"way_rad": WAY})


@pytest.mark.parametrize("seed", range(6))
def test_intervals_hold_the_truth(seed: int) -> None:
    found = move_mechanics(moves(4, seed), pole_pairs=POLES, undecided=False)
    inertia, friction = found["J_per_psi"], found["tau_c_per_psi"]
    assert abs(inertia.value - J / PSI) < total_half_width(inertia) < 0.05 * J / PSI
    assert abs(friction.value - TAU_C / PSI) < total_half_width(friction) < 0.3 * TAU_C / PSI
    assert inertia.method == "regression over position moves"


def test_amperes_of_unknown_kind_widen_the_interval_to_both_readings() -> None:
    """Read as rms, they are sqrt 2 larger than peak ones would be: the interval holds both."""
    found = move_mechanics(moves(4, 7), pole_pairs=POLES, undecided=True)["J_per_psi"]
    for truth in (J / PSI, math.sqrt(0.5) * J / PSI):
        assert abs(found.value - truth) < total_half_width(found)


@pytest.mark.parametrize("filter_s", [1e-3, 3e-3])
def test_a_current_that_is_shown_late_takes_no_friction(filter_s: float) -> None:
    """Of a shaft that lags its demand: J was 4.7 and 12.3 % small at +-1.7 and 1.9, friction 67 % at +-13 (3 ms)."""
    made = moves(4, 5, acceleration=400.0)
    t, share = made.t_s, 1e-3 / (filter_s + 1e-3)
    late, shown = 0.0, []
    for current in made["i_q_a"]:
        late += share * (current - late)
        shown.append(late)
    signals = {**made.signals, "i_q_a": np.array(shown), "theta_ref_rad": np.interp(t + 0.03, t, made["theta_ref_rad"])}
    found = move_mechanics(Trace(t, signals, made.units, made.meta), pole_pairs=POLES, undecided=False)
    assert abs(found["J_per_psi"].value - J / PSI) < total_half_width(found["J_per_psi"]) < 0.03 * J / PSI
    assert (
        abs(found["tau_c_per_psi"].value - TAU_C / PSI) < total_half_width(found["tau_c_per_psi"]) < 0.5 * TAU_C / PSI
    )


def test_a_friction_below_zero_is_not_given() -> None:
    """Cogging within the way did that on a drive written apart from this program: -0.05 +-0.036 N m, in truth 0.035."""
    assert list(move_mechanics(moves(4, 1, tau_c=-0.04), pole_pairs=POLES, undecided=False)) == ["J_per_psi"]


def test_an_inertia_from_moves_holds_the_truth_where_the_stated_flux_linkage_is_wrong() -> None:
    """Stated psi 9 % too large: so is J, which had 3 % for an interval."""
    stated = load_machine_file("interior-2k2")
    stated = replace(stated, machine=replace(stated.machine, pole_pairs=POLES, psi_f_wb=1.09 * PSI), std={})
    ratios = move_mechanics(moves(4, 3), pole_pairs=POLES, undecided=False)
    made = completed_machine(stated, ratios, "as given", flux_doubt(stated)).machine
    assert made is not None
    inertia = made.estimates["J_kgm2"]
    assert inertia.value == pytest.approx(1.09 * J, rel=0.03)
    assert abs(inertia.value - J) < total_half_width(inertia) < 0.15 * J
    assert made.systematic["J_kgm2"] == inertia.systematic


def test_every_move_has_two_halves() -> None:
    assert len(halves_of_moves(moves(3, 1))) == 12


def test_one_move_is_not_enough() -> None:
    single = moves(1, 1)
    kept = single.t_s < 0.2 + 0.5 * (single.t_s[-1] - 0.2)
    first = Trace(single.t_s[kept], {k: v[kept] for k, v in single.signals.items()}, single.units, single.meta)
    with pytest.raises(IdentificationError, match="E_EXCITATION"):
        move_mechanics(first, pole_pairs=POLES, undecided=False)


def test_moves_too_short_for_their_samples_are_no_torque_pulses() -> None:
    """90 degrees at an EPOS4's stored ramp, each answer 0.7 ms: the refusal was "0 usable torque pulses, 4 needed"."""
    slow = moves(4, 1)
    kept = np.arange(0, len(slow), 12)
    few = Trace(slow.t_s[kept], {k: v[kept] for k, v in slow.signals.items()}, slow.units, slow.meta)
    with pytest.raises(IdentificationError, match="0 halves of moves have 60 samples") as refused:
        move_mechanics(few, pole_pairs=POLES, undecided=False)
    assert "ms with" in refused.value.what and "--acceleration" in refused.value.hint


@pytest.mark.parametrize("phase", [0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
def test_offsets_of_the_current_sensors_are_within_the_interval(phase: float) -> None:
    """0.2 % of the rated current, which turns with the rotor, where a slow move takes a tenth of it: up to 2.3 %."""
    plain = moves(4, 3, acceleration=40.0)
    rated_apk = 4.0
    offset = 0.002 * rated_apk * np.cos(POLES * plain["theta_m_rad"] + phase)
    shown = Trace(plain.t_s, {**plain.signals, "i_q_a": plain["i_q_a"] + offset}, plain.units, plain.meta)
    found = move_mechanics(shown, pole_pairs=POLES, undecided=False, rated_apk=rated_apk)
    for name, truth in (("J_per_psi", J / PSI), ("tau_c_per_psi", TAU_C / PSI)):
        assert abs(found[name].value - truth) < total_half_width(found[name])
