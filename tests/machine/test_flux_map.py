# SPDX-License-Identifier: MIT
"""Flux maps: cells against scipy, C against numpy, the inverse against the forward table, what lies outside."""

import ctypes
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline, RectBivariateSpline, RegularGridInterpolator

from benchmarks.analytic_saturation import BridgeSaturation, saturated_pmsyrm_map
from pmsmtool.errors import ConfigError
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.flux_map_cells import (
    NOT_CONVERGED,
    OUTSIDE_I_D,
    OUTSIDE_I_Q,
    OUTSIDE_PSI,
    FluxMapStruct,
    Table,
    library,
    per_step,
)
from pmsmtool.machine.parameters import MachineParameters

SPLINE_TOLERANCE = 1e-12
"""Against scipy, relative to the largest value; measured 1.2e-14."""

ROUND_TRIP_A = 0.006
"""Inverse table of 129 x 129 nodes of the shipped map, largest error in A; measured 0.00497."""

MEASURED_MAP = Path(__file__).parents[2].parent / "shared" / "maps" / "baldor_400rpm_map.npz"


@pytest.fixture(scope="module")
def pmsyrm():
    return saturated_pmsyrm_map()


def linear_map(kind="bicubic"):
    """1.2/3.4 mH with 0.1 mH mutual inductance and 0.1 Wb."""
    i_d, i_q = np.linspace(-10.0, 6.0, 9), np.linspace(-8.0, 8.0, 8)
    grid_d, grid_q = np.meshgrid(i_d, i_q, indexing="ij")
    psi_d, psi_q = 0.1 + 1.2e-3 * grid_d + 1e-4 * grid_q, 1e-4 * grid_d + 3.4e-3 * grid_q
    return FluxMap(i_d, i_q, psi_d, psi_q, kind, (7, 9))


def axes_and_values(seed, equidistant):
    rng = np.random.default_rng(seed)
    n_x, n_y = rng.integers(4, 12, 2)
    if equidistant:
        x, y = np.linspace(-3.0, 5.0, n_x), np.linspace(-1.0, 1.0, n_y)
    else:
        x, y = np.cumsum(rng.uniform(0.2, 1.0, n_x)), np.cumsum(rng.uniform(0.2, 1.0, n_y))
    return x, y, rng.normal(size=(2, n_x, n_y)), rng


# -- cells ------------------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.booleans())
def test_bicubic_cells_are_the_interpolating_spline(seed, equidistant):
    x, y, values, rng = axes_and_values(seed, equidistant)
    table = Table.fit("bicubic", x, y, (values[0], values[1]))
    at_x, at_y = rng.uniform(x[0], x[-1], 200), rng.uniform(y[0], y[-1], 200)
    found = table.evaluate(at_x, at_y)
    for k in range(2):
        spline = RectBivariateSpline(x, y, values[k], s=0)
        scale = np.abs(spline.ev(at_x, at_y)).max()
        for ours, dx, dy in ((found.value[k], 0, 0), (found.jacobian[k, 0], 1, 0), (found.jacobian[k, 1], 0, 1)):
            theirs = spline.ev(at_x, at_y, dx=dx, dy=dy)
            assert np.abs(ours - theirs).max() <= SPLINE_TOLERANCE * max(scale, np.abs(theirs).max())
    assert not found.outside.any()


def test_bilinear_cells():
    x, y, values, rng = axes_and_values(3, False)
    table = Table.fit("bilinear", x, y, (values[0], values[1]))
    points = np.column_stack([rng.uniform(x[0], x[-1], 200), rng.uniform(y[0], y[-1], 200)])
    found = table.evaluate(points[:, 0], points[:, 1]).value
    for k in range(2):
        assert np.allclose(found[k], RegularGridInterpolator((x, y), values[k])(points), rtol=0, atol=1e-13)


def test_nodes_are_hit():
    x, y, values, _ = axes_and_values(5, False)
    table = Table.fit("bicubic", x, y, (values[0], values[1]))
    grid = np.meshgrid(x, y, indexing="ij")
    assert np.abs(table.evaluate(*grid).value - values).max() <= 1e-13


def test_four_nodes_are_one_cubic():
    x = np.array([0.0, 1.0, 2.5, 3.0])
    values = np.add.outer(x**3, 2 * x**3 - x)
    table = Table.fit("bicubic", x, x, (values, -values))
    at = np.linspace(0.0, 3.0, 31)
    assert np.allclose(table.evaluate(at, 1.7).value[0], at**3 + 2 * 1.7**3 - 1.7, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.booleans())
def test_the_continuation_outside_is_smooth(seed, equidistant):
    """Value and slopes are continuous over every border, also outside the corners."""
    x, y, values, rng = axes_and_values(seed, equidistant)
    table = Table.fit("bicubic", x, y, (values[0], values[1]))
    span = max(np.ptp(x), np.ptp(y))
    eps = 1e-9 * span
    for border in (x[0], x[-1]):
        along = rng.uniform(y[0] - 0.3 * span, y[-1] + 0.3 * span, 20)
        low, high = table.evaluate(border - eps, along), table.evaluate(border + eps, along)
        curvature = 1.0 + np.abs(low.jacobian).max()
        assert np.allclose(low.value, high.value, atol=1e-5 * curvature)
        assert np.allclose(low.jacobian, high.jacobian, atol=1e-5 * curvature)
        assert (low.outside[0] != high.outside[0]).all()


def test_outside_jacobian_is_the_derivative():
    x, y, values, _ = axes_and_values(11, True)
    table = Table.fit("bicubic", x, y, (values[0], values[1]))
    at_x, at_y, h = np.array([x[0] - 1.0, x[-1] + 0.5, 0.1]), np.array([y[-1] + 0.7, 0.0, y[0] - 0.4]), 1e-6
    jacobian = table.evaluate(at_x, at_y).jacobian
    by_x = (table.evaluate(at_x + h, at_y).value - table.evaluate(at_x - h, at_y).value) / (2 * h)
    by_y = (table.evaluate(at_x, at_y + h).value - table.evaluate(at_x, at_y - h).value) / (2 * h)
    assert np.allclose(jacobian[:, 0], by_x, rtol=1e-6, atol=1e-7)
    assert np.allclose(jacobian[:, 1], by_y, rtol=1e-6, atol=1e-7)


def test_an_equidistant_axis_is_recognised():
    assert per_step(np.linspace(-20.0, 20.0, 21)) == pytest.approx(0.5, rel=1e-12)
    assert per_step(np.array([0.0, 1.0, 2.1, 3.0])) == 0.0


# -- C and numpy are the same ------------------------------------------------------------------------------------


def call_flux(struct, i_d, i_q):
    n = len(i_d)
    psi_d, psi_q, jac, status = np.empty(n), np.empty(n), np.empty((n, 2, 2)), np.empty(n, np.uint32)
    library().pmsm_flux_map_flux_many(
        ctypes.byref(struct), n, i_d.ctypes.data, i_q.ctypes.data, psi_d.ctypes.data, psi_q.ctypes.data,
        jac.ctypes.data, status.ctypes.data,
    )  # fmt: skip
    return psi_d, psi_q, jac, status


def call_current(struct, psi_d, psi_q):
    n = len(psi_d)
    i_d, i_q, status = np.empty(n), np.empty(n), np.empty(n, np.uint32)
    library().pmsm_flux_map_current_many(
        ctypes.byref(struct), n, psi_d.ctypes.data, psi_q.ctypes.data, i_d.ctypes.data, i_q.ctypes.data,
        status.ctypes.data,
    )  # fmt: skip
    return i_d, i_q, status


@pytest.mark.parametrize("kind", ["bicubic", "bilinear"])
@pytest.mark.parametrize("equidistant", [True, False])
def test_c_gives_the_bits_of_numpy(pmsyrm, kind, equidistant):
    i_d = pmsyrm.i_d_a
    if not equidistant:
        i_d = i_d[[0, 1, 3, 4, 8, 13, 20, 26, 27, 33, 41, 49, 52]]
    rows = np.searchsorted(pmsyrm.i_d_a, i_d)
    flux_map = FluxMap(i_d, pmsyrm.i_q_a, pmsyrm.psi_d_wb[rows], pmsyrm.psi_q_wb[rows], kind, (33, 40))
    rng = np.random.default_rng(1)
    at_d, at_q = rng.uniform(-32, 32, 5000), rng.uniform(-32, 32, 5000)
    psi_d, psi_q, jac, status = call_flux(flux_map.as_struct(inverse=False), at_d, at_q)
    expected = flux_map.forward.evaluate(at_d, at_q)
    assert np.array_equal([psi_d, psi_q], expected.value)
    assert np.array_equal(np.moveaxis(jac, 0, 2), expected.jacobian)
    assert np.array_equal((status & OUTSIDE_I_D) != 0, expected.outside[0])
    assert np.array_equal((status & OUTSIDE_I_Q) != 0, expected.outside[1])

    psi = rng.uniform(-0.5, 1.2, 5000), rng.uniform(-1.6, 1.6, 5000)
    found_d, found_q, status = call_current(flux_map.as_struct(), *psi)
    inverse = flux_map.tables.inverse.evaluate(*psi)
    assert np.array_equal([found_d, found_q], inverse.value)
    assert np.array_equal((status & OUTSIDE_PSI) != 0, inverse.outside.any(axis=0))
    outside = (found_d < i_d[0]) | (found_d > i_d[-1])
    assert np.array_equal((status & OUTSIDE_I_D) != 0, outside)
    assert 0 < outside.sum() < 5000


def test_nan_stays_nan_and_is_flagged(pmsyrm):
    nan = np.array([np.nan, 1.0])
    good = np.array([1.0, np.nan])
    psi_d, psi_q, _, status = call_flux(pmsyrm.as_struct(), nan, good)
    assert np.isnan([psi_d, psi_q]).all()
    assert (status != 0).all()
    i_d, i_q, status = call_current(pmsyrm.as_struct(), nan, good)
    assert np.isnan([i_d, i_q]).all()
    assert ((status & OUTSIDE_PSI) != 0).all()


@pytest.mark.parametrize("huge", [1e300, -1e300, np.inf, -np.inf])
def test_huge_arguments_do_not_crash(pmsyrm, huge):
    argument = np.array([huge])
    assert call_flux(pmsyrm.as_struct(), argument, argument)[3][0] & (OUTSIDE_I_D | OUTSIDE_I_Q)
    assert call_current(pmsyrm.as_struct(), argument, argument)[2][0] & OUTSIDE_PSI


def test_the_struct_keeps_its_arrays_alive():
    struct = linear_map().as_struct()
    assert len(struct.arrays) == 4
    assert ctypes.sizeof(FluxMapStruct) == library().pmsm_flux_map_size()


# -- the inverse ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["bicubic", "bilinear"])
def test_a_linear_machine_is_inverted_exactly(kind):
    flux_map = linear_map(kind)
    rng = np.random.default_rng(2)
    i_d, i_q = rng.uniform(-10, 6, 500), rng.uniform(-8, 8, 500)
    back = flux_map.current(*flux_map.flux(i_d, i_q))
    assert np.abs(np.array(back) - [i_d, i_q]).max() <= 1e-10
    assert flux_map.tables.inverse_error_a <= 1e-10


def test_the_inverse_table_is_a_spline_through_solved_nodes(pmsyrm):
    inverse = pmsyrm.tables.inverse
    nodes = inverse.evaluate(*np.meshgrid(inverse.axis_1, inverse.axis_2, indexing="ij")).value
    psi = np.array(pmsyrm.flux(*nodes))
    residual = np.abs(psi - np.meshgrid(inverse.axis_1, inverse.axis_2, indexing="ij"))
    assert residual.max() <= 1e-12  # Wb; measured 1.3e-13
    rng = np.random.default_rng(3)
    at = rng.uniform(inverse.axis_1[0], inverse.axis_1[-1], 500), rng.uniform(-1.2, 1.2, 500)
    found = inverse.evaluate(*at).value
    for k in range(2):
        spline = RectBivariateSpline(inverse.axis_1, inverse.axis_2, nodes[k], s=0)
        assert np.abs(spline.ev(*at) - found[k]).max() <= 1e-11  # currents up to 47 A; measured 2e-14


@pytest.mark.chain
@settings(max_examples=200, deadline=None)
@given(st.floats(-26, 26), st.floats(-26, 26))
def test_round_trip_of_the_shipped_map(i_d, i_q):
    flux_map = round_trip_map()
    back = flux_map.current(*flux_map.flux(i_d, i_q))
    assert np.hypot(back[0] - i_d, back[1] - i_q) <= ROUND_TRIP_A


_MAPS: list[FluxMap] = []


def round_trip_map():
    if not _MAPS:
        _MAPS.append(saturated_pmsyrm_map())
    return _MAPS[0]


def test_the_stated_inverse_error_is_the_error(pmsyrm):
    assert 0 < pmsyrm.tables.inverse_error_rms_a < pmsyrm.tables.inverse_error_a <= ROUND_TRIP_A


def test_more_inverse_nodes_are_closer(pmsyrm):
    errors = [
        FluxMap(pmsyrm.i_d_a, pmsyrm.i_q_a, pmsyrm.psi_d_wb, pmsyrm.psi_q_wb, "bicubic", (n, n)).tables
        for n in (33, 65, 129, 257)
    ]
    rms = [tables.inverse_error_rms_a for tables in errors]
    assert all(fine < coarse / 3 for coarse, fine in pairwise(rms))  # measured 4.7 to 7.2


def test_newton_in_c_solves_the_forward_table(pmsyrm):
    rng = np.random.default_rng(4)
    i_d, i_q = rng.uniform(-26, 26, 1000), rng.uniform(-26, 26, 1000)
    psi_d, psi_q = (np.ascontiguousarray(psi) for psi in pmsyrm.flux(i_d, i_q))
    found_d, found_q, status = np.zeros(1000), np.zeros(1000), np.empty(1000, np.uint32)
    library().pmsm_flux_map_solve_many(
        ctypes.byref(pmsyrm.as_struct()), 1000, psi_d.ctypes.data, psi_q.ctypes.data, 1e-13, 60,
        found_d.ctypes.data, found_q.ctypes.data, status.ctypes.data,
    )  # fmt: skip
    assert not (status & NOT_CONVERGED).any()
    assert np.abs([found_d - i_d, found_q - i_q]).max() <= 1e-9


def test_newton_says_when_it_does_not_arrive(pmsyrm):
    out = np.zeros(1), np.zeros(1), np.empty(1, np.uint32)
    far = np.array([0.9]), np.array([0.9])
    library().pmsm_flux_map_solve_many(
        ctypes.byref(pmsyrm.as_struct()), 1, far[0].ctypes.data, far[1].ctypes.data, 1e-13, 1,
        out[0].ctypes.data, out[1].ctypes.data, out[2].ctypes.data,
    )  # fmt: skip
    assert out[2][0] & NOT_CONVERGED


def test_a_folded_map_is_refused_with_its_place(pmsyrm):
    psi_q = pmsyrm.psi_q_wb.copy()
    psi_q[:, 40:] = psi_q[:, [40]]
    flux_map = FluxMap(pmsyrm.i_d_a, pmsyrm.i_q_a, pmsyrm.psi_d_wb, psi_q)
    with pytest.raises(ConfigError, match="cannot be inverted") as caught:
        _ = flux_map.tables
    assert "i_q = " in str(caught.value)
    assert flux_map.flux(0.0, 0.0)  # the forward table stands


def test_building_is_reproducible(pmsyrm):
    again = saturated_pmsyrm_map()
    assert np.array_equal(pmsyrm.tables.inverse.cells, again.tables.inverse.cells)
    assert pmsyrm.content_hash() == again.content_hash()


# -- quantities -----------------------------------------------------------------------------------------------------


def test_inductances_of_a_linear_machine():
    flux_map = linear_map()
    assert np.allclose(flux_map.incremental_inductance(-3.0, 2.0), [[1.2e-3, 1e-4], [1e-4, 3.4e-3]], rtol=1e-12)
    for i_d, i_q in ((0.0, 2.0), (-3.0, 0.0), (0.0, 0.0)):
        expected_d = 1.2e-3 + (1e-4 * i_q / i_d if i_d else 0.0)
        expected_q = 3.4e-3 + (1e-4 * i_d / i_q if i_q else 0.0)
        assert np.allclose(flux_map.apparent_inductance(i_d, i_q), [expected_d, expected_q], rtol=1e-10)


def test_apparent_inductances_give_the_torque_of_the_point(pmsyrm):
    i_d, i_q = -8.0, 9.0
    L_d, L_q = pmsyrm.apparent_inductance(i_d, i_q)
    psi_f = pmsyrm.flux(0.0, 0.0)[0]
    constant = MachineParameters(2, 0.63, 0.02, 0.05, float(psi_f), L_d_app_h=float(L_d), L_q_app_h=float(L_q))
    assert constant.torque_nm(i_d, i_q) == pytest.approx(float(pmsyrm.torque_nm(2, i_d, i_q)), rel=1e-12)


def test_inductances_of_a_saturated_machine(pmsyrm):
    """Finite differences of the analytic model; the map interpolates it, so a per cent apart from its kinks."""
    model, h = BridgeSaturation(), 1e-4
    for i_d, i_q in ((-8.3, 9.4), (3.7, 5.2), (-15.5, 20.5)):
        jac = pmsyrm.incremental_inductance(i_d, i_q)
        by_d = (np.array(model.flux(i_d + h, i_q)) - np.array(model.flux(i_d - h, i_q))) / (2 * h)
        by_q = (np.array(model.flux(i_d, i_q + h)) - np.array(model.flux(i_d, i_q - h))) / (2 * h)
        assert np.allclose(jac[:, 0], by_d, rtol=0.01, atol=1e-5)
        assert np.allclose(jac[:, 1], by_q, rtol=0.01, atol=1e-5)
        apparent = pmsyrm.apparent_inductance(i_d, i_q)
        assert apparent[1] == pytest.approx(float(model.flux(i_d, i_q)[1]) / i_q, rel=1e-3)
        assert apparent[1] > 1.3 * jac[1, 1]  # incremental and apparent are not the same number


def test_torque():
    flux_map = linear_map()
    psi_d, psi_q = flux_map.flux(-3.0, 2.0)
    assert flux_map.torque_nm(4, -3.0, 2.0) == pytest.approx(6.0 * (psi_d * 2.0 + psi_q * 3.0))


def test_shapes_broadcast(pmsyrm):
    psi_d, psi_q = pmsyrm.flux(np.zeros((3, 1)), np.arange(4.0))
    assert psi_d.shape == psi_q.shape == (3, 4)
    assert pmsyrm.incremental_inductance(np.zeros((3, 1)), np.arange(4.0)).shape == (2, 2, 3, 4)
    assert np.ndim(pmsyrm.current(0.4, 0.1)[0]) == 0


def test_interpolation_is_stated(pmsyrm):
    assert pmsyrm.interpolation() == "bicubic psi(i) on 53 x 53 nodes, bicubic i(psi) on 129 x 129 flux nodes"


def test_the_hash_covers_what_decides_the_machine(pmsyrm):
    same = pmsyrm.with_meta(note="x")
    assert same.content_hash() == pmsyrm.content_hash()
    parts = (pmsyrm.i_d_a, pmsyrm.i_q_a, pmsyrm.psi_d_wb, pmsyrm.psi_q_wb)
    assert FluxMap(*parts, "bilinear").content_hash() != pmsyrm.content_hash()
    assert FluxMap(*parts, "bicubic", (65, 65)).content_hash() != pmsyrm.content_hash()
    other = pmsyrm.psi_d_wb.copy()
    other[0, 0] += 1e-12
    assert FluxMap(*parts[:2], other, parts[3]).content_hash() != pmsyrm.content_hash()


# -- what is no map --------------------------------------------------------------------------------------------------


AXIS = np.arange(-2.0, 3.0)
GRID = np.add.outer(AXIS, AXIS)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"i_d_a": np.array([-2.0, -1.0, -1.0, 1.0, 2.0])}, "axis i_d_a does not increase: -1 A is followed by -1 A"),
        ({"i_q_a": AXIS[::-1]}, "axis i_q_a does not increase"),
        ({"i_q_a": AXIS + 10}, "leaves out zero current"),
        ({"i_d_a": np.array([0.0, 1.0, np.nan, 3.0, 4.0])}, "not finite"),
        ({"i_d_a": AXIS[:3]}, "at least 4 nodes"),
        ({"psi_d_wb": GRID[:3]}, "psi_d_wb has shape (3, 5), the axes say (5, 5)"),
        ({"psi_q_wb": np.where(GRID > 3, np.nan, GRID)}, "psi_q_wb has 1 holes"),
        ({"kind": "quintic"}, "allowed are bicubic, bilinear"),
        ({"inverse_nodes": (3, 65)}, "inverse_nodes is 3"),
    ],
)
def test_what_is_no_map_is_refused(change, says):
    parts = {"i_d_a": AXIS, "i_q_a": AXIS, "psi_d_wb": GRID, "psi_q_wb": GRID, **change}
    with pytest.raises(ConfigError) as caught:
        FluxMap(**parts)
    assert says in str(caught.value)


def test_all_that_is_wrong_is_listed():
    with pytest.raises(ConfigError) as caught:
        FluxMap(AXIS[:3], AXIS[::-1], GRID, GRID)
    assert len(caught.value.violations) == 2


# -- a measured map ---------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not MEASURED_MAP.is_file(), reason="the measured map is not on this machine")
def test_measured_map():
    from pmsmtool.machine.flux_map_import import load_flux_map

    flux_map = load_flux_map(MEASURED_MAP)
    assert flux_map.shape == (21, 27)
    jac = flux_map.incremental_inductance(*np.meshgrid(np.linspace(-20, 20, 81), np.linspace(-26, 26, 105)))
    assert 0.010 < jac[0, 0].min() < 0.016 < 0.043 < jac[0, 0].max() < 0.050
    assert 0.013 < jac[1, 1].min() < 0.016 < 0.140 < jac[1, 1].max() < 0.155
    assert flux_map.tables.inverse_error_a <= 0.012  # of 26 A; measured 0.0107
    assert flux_map.tables.inverse_error_rms_a <= 0.001  # measured 0.00083


def test_slopes_matrix_against_scipy():
    from pmsmtool.machine.flux_map_check import spline_slopes_matrix

    rng = np.random.default_rng(7)
    axis, values = np.cumsum(rng.uniform(0.1, 1.0, 9)), rng.normal(size=9)
    expected = CubicSpline(axis, values, bc_type="not-a-knot")(axis, 1)
    assert np.allclose(spline_slopes_matrix(axis) @ values, expected, atol=1e-12)
