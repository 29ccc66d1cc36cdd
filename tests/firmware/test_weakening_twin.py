# SPDX-License-Identifier: MIT
"""Field weakening by optimisation against its numpy twin, bit for bit, from any memory that a drive can hold."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest

from pmsmtool.firmware.core_binding import core
from tests.firmware.closed_loop import MODE_TORQUE, RPM, Loop, reference_case
from tests.firmware.core_twin import f
from tests.firmware.weakening_twin import ACCELERATED, DOUBTED, GRADIENT, KNOWN, NONE, UNCOMPENSATED, WeakeningTwin

SALIENT = {"motor__L_q_app_h": 0.012, "motor__L_q_h": 0.012}
CASES: dict[str, dict[str, float]] = {
    "gradient": {
        "field_weakening__mode": GRADIENT, "field_weakening__iterations": 6, "field_weakening__i_d_lm_a": -3.0,
        "field_weakening__h1": 0.7, "field_weakening__h2": 0.4, **SALIENT,
    },
    "gradient, bound of i_d": {
        "field_weakening__mode": GRADIENT, "field_weakening__i_d_min_a": -20.0, "motor__I_max_apk": 30.0,
    },
    "uncompensated": {"field_weakening__mode": UNCOMPENSATED, "field_weakening__iterations": 6, **SALIENT},
    "accelerated": {"field_weakening__mode": ACCELERATED, "field_weakening__i_d_lm_a": -3.0, **SALIENT},
    "accelerated, positive i_d": {"field_weakening__mode": ACCELERATED, "field_weakening__i_d_lm_a": 6.0},
    "accelerated, bound of i_d": {
        "field_weakening__mode": ACCELERATED, "field_weakening__i_d_min_a": -8.0, "motor__I_max_apk": 20.0, **SALIENT,
    },
    "without feed-forward": {"field_weakening__mode": ACCELERATED, "current__options": 4},
    "decoupled only": {"field_weakening__mode": GRADIENT, "current__options": 1},
    "accelerated, no cost": {"field_weakening__mode": ACCELERATED, "field_weakening__h1": 0, "field_weakening__h2": 0},
}  # fmt: skip
REACHED = {
    "gradient": {"empty", "on"},
    "accelerated": {"empty", "on", KNOWN, DOUBTED, NONE, "goes on"},
}
"""Ends that a case has to come to."""


@pytest.mark.parametrize("case", CASES)
def test_a_period_equals_the_twin_bit_for_bit(case: str) -> None:
    values = reference_case(4000.0, **CASES[case])
    loop, rng, seen = Loop(core(), values, omega=0.0), np.random.default_rng(7), Counter[object]()
    loop.step(mode=MODE_TORQUE)
    for k in range(150):
        if k % 5 == 0:  # another memory; in between it goes on from its own
            loop.plant.omega = float(rng.choice([0.0, 0.1, 20.0, *rng.uniform(200, 1500, 4)])) * RPM
            loop.U_dc = loop.measurement.U_dc = float(f(rng.uniform(120, 230)))
            memory = disturb(loop, rng)
        else:
            loop.measurement.U_dc = float(f(loop.measurement.U_dc * rng.choice([1.0, 0.97, 0.7])))
        tau = float(f(rng.choice([memory, memory + 0.3, rng.uniform(-60, 60)])))
        loop.plant.i = rng.uniform(-40, 40, 2)
        twin = twin_of(loop)
        live = loop.step(mode=MODE_TORQUE, tau_ref=tau)
        m, state = loop.measurement, loop.state
        request = twin.period(f(tau), (f(live.i_d), f(live.i_q)), f(m.omega_e), f(m.U_dc))
        mine = [live.i_d_req, live.i_q_req, state.fw_reference.d, state.fw_reference.q, state.fw_momentum]
        mine += [state.fw_ahead.d, state.fw_ahead.q, state.fw_multiplier, state.fw_tau, state.fw_U_dc, state.U_dc_slow]
        other = [*request, *twin.reference, twin.momentum, *twin.ahead, twin.multiplier, twin.tau, twin.U, twin.U_slow]
        np.testing.assert_array_equal(np.array(mine, dtype=f), np.array(other, dtype=f), str(k))
        whole = state.fw_count, state.fw_left, state.fw_corner_state, bool(state.fw_empty), live.iterations
        assert whole == (twin.count, twin.left, twin.known, twin.empty, twin.steps.count), k
        assert live.flags & 0x84 == twin.flags, k
        seen[twin.known] += 1
        seen["empty" if twin.empty else "on"] += 1
        seen["goes on"] += twin.left > 0
    assert not REACHED.get(case, set()) - {key for key, count in seen.items() if count > 1}


def disturb(loop: Loop, rng: np.random.Generator) -> float:
    """Set the memory of the optimisation at random; return the torque it was for."""
    state, fresh = loop.state, rng.uniform() < 0.2
    angle, size = rng.uniform(0, 2 * math.pi), 56 * math.sqrt(rng.uniform())
    state.fw_reference.d, state.fw_reference.q = -abs(size * math.cos(angle)), size * math.sin(angle)
    state.fw_ahead.d, state.fw_ahead.q = state.fw_reference.d + rng.uniform(-1, 1), state.fw_reference.q
    state.fw_momentum, state.fw_multiplier = rng.uniform(1, 3), rng.choice([0.0, rng.uniform(0, 0.3)])
    state.fw_corner_state, state.fw_empty = (0, 0) if fresh else (int(rng.integers(3)), int(rng.integers(2)))
    state.fw_count, state.fw_left = (0, 0) if fresh else (int(rng.integers(1, 9)), int(rng.integers(4)))
    state.fw_tau, state.fw_U_dc = float(f(rng.uniform(-60, 60))), loop.U_dc
    state.U_dc_slow = loop.U_dc * rng.choice([0.0, 0.98, 1.0, 1.05, 1.5])
    state.integrator.d, state.integrator.q = rng.uniform(-40, 40, 2)
    return float(state.fw_tau)


def twin_of(loop: Loop) -> WeakeningTwin:
    """The twin with the memory of the core."""
    s = loop.state
    return WeakeningTwin(
        loop.values, x=[f(s.integrator.d), f(s.integrator.q)], U_slow=f(s.U_dc_slow),
        reference=(f(s.fw_reference.d), f(s.fw_reference.q)), ahead=(f(s.fw_ahead.d), f(s.fw_ahead.q)),
        momentum=f(s.fw_momentum), multiplier=f(s.fw_multiplier), tau=f(s.fw_tau), U=f(s.fw_U_dc), count=s.fw_count,
        left=s.fw_left, known=s.fw_corner_state, empty=bool(s.fw_empty),
    )  # fmt: skip
