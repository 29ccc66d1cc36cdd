# SPDX-License-Identifier: MIT
"""The kernel's own sine, cosine, exponential, logarithm: against numpy in extended precision."""

from __future__ import annotations

import numpy as np
import pytest

from pmsmtool.sim.kernel import library

ULP = 2.0**-53
"""Half a unit in the last place of 1."""

SIN, COS, EXP, LOG, TANH, ATAN = range(6)


def kernel(which: int, x: np.ndarray) -> np.ndarray:
    return np.array([library().pmsm_sim_elementary(which, float(v)) for v in x])


def points(low: float, high: float, n: int = 20000) -> np.ndarray:
    return np.concatenate((np.random.default_rng(1).uniform(low, high, n), np.linspace(low, high, 400)))


@pytest.mark.parametrize(("which", "function"), [(SIN, np.sin), (COS, np.cos)])
def test_sine_and_cosine_are_right_to_the_last_bit_or_so(which, function):
    x = points(-201.1, 201.1)  # 64 pole pairs times half a turn
    error = np.abs(kernel(which, x) - function(x.astype(np.longdouble)))
    assert float(error.max()) <= 2.0 * ULP  # measured 1.5 ULP


@pytest.mark.parametrize(
    ("which", "function", "low", "high", "limit"),
    [
        (EXP, np.exp, -690.0, 690.0, 4.0),  # measured 1.3
        (TANH, np.tanh, -20.0, 20.0, 40.0),  # measured 14, at 0.01 where 1 - exp loses digits
        (ATAN, np.arctan, -50.0, 50.0, 4.0),  # measured 1.5
    ],
)
def test_relative_error(which, function, low, high, limit):
    x = points(low, high)
    exact = function(x.astype(np.longdouble))
    assert float(np.abs(kernel(which, x) / exact - 1.0).max()) <= limit * ULP


def test_logarithm():
    x = np.exp(points(-300.0, 300.0))
    exact = np.log(x.astype(np.longdouble))
    assert float(np.abs((kernel(LOG, x) - exact) / np.maximum(np.abs(exact), 1.0)).max()) <= 4.0 * ULP  # measured 2


def test_special_values():
    assert library().pmsm_sim_elementary(SIN, 0.0) == 0.0
    assert library().pmsm_sim_elementary(COS, 0.0) == 1.0
    assert library().pmsm_sim_elementary(EXP, 0.0) == 1.0
    assert library().pmsm_sim_elementary(EXP, -1e4) == 0.0
    assert library().pmsm_sim_elementary(LOG, 1.0) == 0.0
    assert library().pmsm_sim_elementary(ATAN, 1e300) == pytest.approx(np.pi / 2, rel=1e-15)
    assert library().pmsm_sim_elementary(TANH, -50.0) == -1.0


def test_bytes_do_not_depend_on_the_platform():
    """Bits as they came out on x86-64 Linux: x87, a fused multiply-add or a libm inside would change them."""
    expected = {
        (SIN, 100.1): "-0x1.abc60c6e652b1p-2",
        (COS, -7.7): "0x1.3a1c134c1c59ep-3",
        (EXP, 3.3): "0x1.b1cd5e7807b7bp+4",
        (LOG, 7.7): "0x1.0546b52e30f62p+1",
        (TANH, 0.3): "0x1.2a4dda7d914f9p-2",
        (ATAN, 2.2): "0x1.24e83fa9b4e48p+0",
    }
    assert {key: float(library().pmsm_sim_elementary(*key)).hex() for key in expected} == expected
    normal = np.empty(4)
    library().pmsm_sim_normal(7, 4, normal.ctypes.data)
    assert [float(x).hex() for x in normal] == [
        "0x1.ac8da7097b412p+0",
        "-0x1.1ebed0f15bbdep-1",
        "0x1.13676381fc58bp-1",
        "-0x1.45f0bff488031p-5",
    ]


def test_normal_numbers_are_normal_and_reproducible():
    n = 200_000
    first, again, other = np.empty(n), np.empty(n), np.empty(n)
    for seed, out in ((1, first), (1, again), (2, other)):
        library().pmsm_sim_normal(seed, n, out.ctypes.data)
    assert np.array_equal(first, again)
    assert abs(np.corrcoef(first, other)[0, 1]) < 4.0 / np.sqrt(n)
    assert abs(first.mean()) < 4.0 / np.sqrt(n)
    assert abs(first.std() - 1.0) < 4.0 / np.sqrt(2.0 * n)
    share = np.mean(np.abs(first) > 1.959964)
    assert abs(share - 0.05) < 4.0 * np.sqrt(0.05 * 0.95 / n)
    assert abs(np.corrcoef(first[1:], first[:-1])[0, 1]) < 4.0 / np.sqrt(n)
