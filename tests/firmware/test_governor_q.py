# SPDX-License-Identifier: MIT
"""The fixed-point governor against the float core: same inputs, closed loops, extremes, refusals."""

from __future__ import annotations

import math
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pmsmtool.commissioning.export import ONE, fixed_point_files, q_files, q_format
from pmsmtool.errors import ConfigError
from pmsmtool.firmware.core_binding import core
from pmsmtool.firmware.export_c import FLAGS
from tests.firmware.closed_loop import LINE, MODE_CURRENT, RPM, Loop, reference_case
from tests.firmware.governor_q import FixedPointGovernor

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler on this machine")
U_DC = 210.0
V_MAX = U_DC / math.sqrt(3)
VALUES = reference_case(4000.0, governor__mode=LINE, governor__eps=0.01)
SAME_INPUT = 1e-3  # A; measured 5.9e-4, the resolution of the search (2^-20 of a way of up to 112 A)
CLOSED_LOOP = 0.02  # A of current; measured 0.016 at 800 rpm, where held references jam at the boundary
DEMAND = 2e-6  # relative excess of the demanded voltage; measured 4.8e-8

EXTREMES = r"""
#include <stdlib.h>
#include "motor_cfg_q.h"
static uint32_t seed = 1u;
static int32_t any(void)
{
    static const int32_t special[8] = {0, 1, -1, INT32_MAX, INT32_MIN, 1 << 30, -(1 << 30), 1 << 27};
    seed = seed * 1664525u + 1013904223u;
    const uint32_t word = seed ^ (seed >> 13);
    const int32_t number = (int32_t)(word >> (1u + ((word >> 3) & 15u)));
    return ((word & 7u) == 0u) ? special[(word >> 8) & 7u] : ((word & 64u) != 0u ? number : -number);
}
int main(int argc, char **argv)
{
    (void)argv;
    for (uint32_t k = 0u; k < 400000u; k++) {
        pmsm_governor_q_constants m = motor_cfg_q;
        pmsm_governor_q_state state = {{any(), any()}, 0u};
        pmsm_governor_q_input in = {{any(), any()}, {any(), any()}, {any(), any()}, any(), any()};
        if (argc > 1) {
            pmsm_governor_q_constants odd = {any(), any(), any(), any(), any(), any(), any(), any(), any(), any()};
            m = odd;
        }
        const pmsm_q27_dq v = pmsm_governor_q(&m, &state, &in);
        if (v.d > (1 << 30) || v.d < -(1 << 30) || v.q > (1 << 30) || v.q < -(1 << 30)) {
            return 3;
        }
    }
    return 0;
}
"""


@pytest.fixture(scope="module")
def governor(tmp_path_factory: pytest.TempPathFactory) -> FixedPointGovernor:
    assert COMPILER is not None
    return FixedPointGovernor(VALUES, tmp_path_factory.mktemp("fixed"), COMPILER)


def row_0(loop: Loop, v: tuple[float, float], state: tuple[float, ...]) -> float:
    """Size of the voltage that the controller demands for a reference."""
    i_d, i_q, x_d, x_q, omega = state
    p = loop.values
    u_d = p["current.K_p_d_v_per_a"] * (v[0] - i_d) + x_d - omega * p["motor.L_q_app_h"] * i_q
    u_q = p["current.K_p_q_v_per_a"] * (v[1] - i_q) + x_q + omega * (p["motor.L_d_app_h"] * i_d + p["motor.psi_f_wb"])
    return math.hypot(u_d, u_q)


@pytest.mark.chain
@needs_compiler
@pytest.mark.parametrize("rpm", [0.0, 310.0, -620.0, 800.0])
def test_same_inputs_give_the_float_cores_reference(rpm: float, governor: FixedPointGovernor) -> None:
    loop = Loop(core(), VALUES, omega=rpm * RPM, U_dc=U_DC)
    rng = np.random.default_rng(int(abs(rpm)))
    target, stopped = (0.0, 0.0), 0
    for k in range(900):
        if k % 60 == 0:
            angle, size = rng.uniform(0, 2 * math.pi), 50 * math.sqrt(rng.uniform())
            target = (size * math.cos(angle) - 10, size * math.sin(angle))
        if k == 500:
            loop.plant.omega *= 1.3  # the held reference becomes inadmissible
        state = loop.state
        held = (state.reference_held.d, state.reference_held.q)
        i, x = (float(loop.plant.i[0]), float(loop.plant.i[1])), (state.integrator.d, state.integrator.q)
        live = loop.step(mode=MODE_CURRENT, i_d_ref=target[0], i_q_ref=target[1])
        governor.hold(held)
        v = governor.govern((live.i_d_req, live.i_q_req), i, x, loop.measurement.omega_e, V_MAX)
        assert math.dist(v, (live.i_d_ref, live.i_q_ref)) <= SAME_INPUT, k
        assert row_0(loop, v, (*i, *x, loop.measurement.omega_e)) <= V_MAX * (1 + DEMAND)
        stopped += governor.state.binding != 255
    assert stopped > (4 if rpm == 0 else 20)


@needs_compiler
@pytest.mark.parametrize("rpm", [310.0, -620.0, 800.0])
def test_closed_loops_of_fixed_and_float_stay_together(rpm: float, governor: FixedPointGovernor) -> None:
    floating = Loop(core(), VALUES, omega=rpm * RPM, U_dc=U_DC)
    fixed = Loop(core(), VALUES | {"governor.mode": 0}, omega=rpm * RPM, U_dc=U_DC)  # governed outside
    governor.hold((0.0, 0.0))
    rng = np.random.default_rng(3)
    target, worst, changed = (0.0, 0.0), 0.0, 0
    for k in range(900):
        if k % 100 == 0:
            angle, size = rng.uniform(0, 2 * math.pi), 40 * math.sqrt(rng.uniform())
            target = (size * math.cos(angle) - 15, size * math.sin(angle))
        live = floating.step(mode=MODE_CURRENT, i_d_ref=target[0], i_q_ref=target[1])
        x = (fixed.state.integrator.d, fixed.state.integrator.q)
        i = (float(fixed.plant.i[0]), float(fixed.plant.i[1]))
        v = governor.govern((live.i_d_req, live.i_q_req), i, x, floating.measurement.omega_e, V_MAX)
        fixed.step(mode=MODE_CURRENT, i_d_ref=v[0], i_q_ref=v[1])
        worst = max(worst, float(np.abs(fixed.plant.i - floating.plant.i).max()))
        changed += governor.state.binding != 255
    assert worst <= CLOSED_LOOP
    assert changed > 20


@pytest.mark.chain
@needs_compiler
@pytest.mark.parametrize("arguments", [[], ["odd constants"]])
def test_nothing_is_undefined_for_any_input(arguments: list[str], tmp_path: Path) -> None:
    for name, text in q_files(VALUES, prefix="motor").items():
        (tmp_path / name).write_text(text)
    (tmp_path / "main.c").write_text(EXTREMES)
    assert COMPILER is not None
    built = subprocess.run(
        [
            COMPILER,
            "-std=c99",
            "-O1",
            "-fsanitize=undefined",
            "-fno-sanitize-recover=all",
            "-o",
            "extremes",
            "main.c",
            "motor_cfg_q.c",
            "pmsm_governor_q.c",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    if built.returncode and "ubsan" in built.stderr:
        pytest.skip("the compiler has no library for -fsanitize=undefined")
    assert built.returncode == 0, built.stderr
    done = subprocess.run([tmp_path / "extremes", *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@needs_compiler
def test_a_held_reference_far_outside_is_brought_back(governor: FixedPointGovernor) -> None:
    governor.hold((900.0, -900.0))
    v = governor.govern((0.0, 2.0), (0.0, 0.0), (0.0, 0.0), 100.0, V_MAX)
    assert math.hypot(v[0] * VALUES["current.K_p_d_v_per_a"], v[1] * VALUES["current.K_p_q_v_per_a"]) < 1.5 * V_MAX
    for _ in range(50):
        v = governor.govern((0.0, 2.0), (0.0, 0.0), (0.0, 0.0), 100.0, V_MAX)
    assert v == pytest.approx((0.0, 2.0), abs=1e-5)


def test_bases_leave_room_and_errors_are_those_of_rounding() -> None:
    q = q_format(VALUES)
    assert q.I_base >= 2 * VALUES["motor.I_max_apk"]
    assert q.U_base >= 2 * V_MAX
    assert all(math.frexp(base)[0] == 0.5 for base in (q.I_base, q.U_base, q.omega_base))
    R, error = q.constants["R_s"]
    assert R / ONE * q.U_base / q.I_base == pytest.approx(VALUES["motor.R_s_ohm"], rel=2 * abs(error) + 1e-12)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"current.options": 4}, "decoupling"),
        ({"current.K_p_d_v_per_a": 1e4}, "more than Q4.27"),
        ({"current.K_p_q_v_per_a": 1e-3}, "inverse_K_p_q"),
        ({"current.K_p_d_v_per_a": 0.0}, "proportional"),
        ({"motor.R_s_ohm": 1e-9}, "vanishes"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict[str, float], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        q_format(VALUES | change)


def test_two_exports_are_equal_and_the_text_is_plain() -> None:
    first, second = q_files(VALUES, design_id="sha256:ab"), q_files(VALUES, design_id="sha256:ab")
    assert first == second
    assert set(first) == {"pmsm_cfg_q.h", "pmsm_cfg_q.c", *(name for name, _ in fixed_point_files())}
    for text in first.values():
        assert text.isascii()
        assert all(len(line) <= 120 for line in text.splitlines())
    assert FLAGS
