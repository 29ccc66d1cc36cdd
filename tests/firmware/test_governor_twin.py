# SPDX-License-Identifier: MIT
"""The governed core against its numpy twin, bit for bit over closed loops."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.firmware.core_binding import core
from tests.firmware.closed_loop import (
    BEST,
    CURRENT_ROW,
    FLAG_ACTIVE,
    FLAG_FALLBACK,
    LINE,
    MINIMUM_TIME,
    MODE_CURRENT,
    PAPER,
    PRE_PROJECTION,
    RPM,
    Loop,
    reference_case,
)
from tests.firmware.core_twin import f
from tests.firmware.governor_twin import FOUND, GovernedTwin

V_DC, BUDGET = 210.0, 17
CASES = {
    "paper": (reference_case(4000.0, governor__mode=PAPER, governor__k_max=6, governor__eps=0.01), 620.0),
    "line search": (
        reference_case(4000.0, governor__mode=LINE, governor__eps=0.01, governor__options=PRE_PROJECTION),
        -700.0,
    ),
    "best, rows only": (
        reference_case(
            4000.0,
            governor__mode=BEST,
            governor__eps=0.01,
            governor__observer_gain=0.0,
            governor__options=CURRENT_ROW | PRE_PROJECTION,
        ),
        800.0,
    ),
    "best": (
        reference_case(
            7540.0,
            governor__mode=BEST,
            governor__eps=0.001,
            governor__options=CURRENT_ROW | PRE_PROJECTION | MINIMUM_TIME,
        ),
        850.0,
    ),
    "line search, current row": (
        reference_case(
            7540.0,
            governor__mode=LINE,
            governor__eps=0.001,
            governor__slack=0.02,
            governor__options=CURRENT_ROW | PRE_PROJECTION,
        ),
        900.0,
    ),
    "line search, corner": (
        reference_case(
            7540.0,
            governor__mode=LINE,
            governor__eps=0.001,
            governor__I_transient_apk=50.0,
            governor__options=CURRENT_ROW | PRE_PROJECTION,
        ),
        750.0,
    ),
    "best, corner": (
        reference_case(
            7540.0,
            governor__mode=BEST,
            governor__eps=0.001,
            governor__I_transient_apk=50.0,
            governor__options=CURRENT_ROW | PRE_PROJECTION | MINIMUM_TIME,
        ),
        -800.0,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_governor_equals_the_twin_bit_for_bit(case: str) -> None:
    values, rpm = CASES[case]
    loop, twin = Loop(core(), values, omega=rpm * RPM, U_dc=V_DC), GovernedTwin(values)
    loop.plant.psi *= 0.93  # a machine that is not the controller's
    rng = np.random.default_rng(4)
    target = (0.0, 0.0)
    seen, bindings, cornered = 0, set(), set()
    for k in range(420):
        if k % 60 == 0:
            angle, size = rng.uniform(0, 2 * math.pi), 50 * math.sqrt(rng.uniform())
            target = (size * math.cos(angle) - 15, size * math.sin(angle))
        if k == 250:
            loop.plant.omega *= 1.35  # the held reference becomes inadmissible, sets run empty
        live = loop.step(mode=MODE_CURRENT, i_d_ref=target[0], i_q_ref=target[1])
        m, out = loop.measurement, loop.output
        v, duties, realised = twin.period(
            (f(m.i_a), f(m.i_b), f(m.i_c)), f(m.theta_e), f(m.omega_e), f(m.U_dc), (f(target[0]), f(target[1]))
        )
        mine = np.array([live.i_d_ref, live.i_q_ref, live.u_d_lim, live.u_q_lim, out.duty_a, out.duty_b, out.duty_c])
        assert mine.astype(f).tobytes() == np.array([*v, *realised, *duties], dtype=f).tobytes(), k
        told = 0x7F if live.iterations < BUDGET else 0x7F & ~FLAG_FALLBACK  # the twin has no budget of steps
        assert (live.flags & told) == (twin.flags & told), k
        seen |= live.flags
        bindings.add(live.binding)
        cornered.add(twin.cornered)
    assert seen & FLAG_ACTIVE
    assert (0 in bindings) or (250 in bindings)
    if case in ("best", "best, corner"):
        assert 250 in bindings
    assert (FOUND in cornered) == (case == "line search, corner")
    if not case.startswith("line search"):
        assert seen & FLAG_FALLBACK
