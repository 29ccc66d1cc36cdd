# SPDX-License-Identifier: MIT
"""Checks and repairs of flux maps: planted faults are found with their size, repairs undo them and say so."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.analytic_saturation import BridgeSaturation, saturated_pmsyrm_map
from pmsmtool.errors import ConfigError
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.flux_map_check import LoopIntegrals, check_flux_map, flux_range, reciprocal_change
from pmsmtool.machine.flux_map_repair import FluxGrid, fill_holes, make_reciprocal, rotate, symmetrise

MEASURED_MAP = Path(__file__).parents[2].parent / "shared" / "maps" / "baldor_400rpm_map.npz"


@pytest.fixture(scope="module")
def good():
    return saturated_pmsyrm_map()


def verdicts(report):
    return {finding.name: finding.ok for finding in report.findings}


def test_a_good_map_is_good(good):
    report = check_flux_map(good)
    assert report.ok
    assert report.reciprocity_rms <= 1e-5  # a reciprocal model; measured 3.0e-6 of interpolation
    assert report.no_load_angle_rad == 0.0
    assert report.psi_f_wb == pytest.approx(0.47669, abs=1e-5)
    assert report.asymmetry_max == 0.0
    assert report.not_monotonic == 0
    assert report.det_min_h2 > 0
    assert report.L_qq_h == pytest.approx((0.0109, 0.155), rel=0.01)


def test_a_turned_frame_is_measured_and_turned_back(good):
    angle = math.radians(3.0)
    turned = rotate(good, -angle)
    report = check_flux_map(turned)
    assert not verdicts(report)["d axis"]
    assert not verdicts(report)["symmetric in i_q"]
    assert report.no_load_angle_rad == pytest.approx(angle, abs=1e-12)
    back = rotate(turned, report.no_load_angle_rad)
    assert check_flux_map(back).ok
    i_d, i_q = np.meshgrid(np.linspace(-15, 15, 7), np.linspace(-15, 15, 7))
    error = np.array(back.flux(i_d, i_q)) - good.flux(i_d, i_q)
    assert np.abs(error).max() <= 1e-4 * flux_range(good)  # interpolated twice; measured 1.8e-5
    assert "+3.0000 deg el" in back.meta["repairs"][-1]
    assert "-3.0000 deg el" in back.meta["repairs"][0]


@pytest.mark.parametrize(("angle", "says"), [(math.pi / 2, "swapped"), (math.pi, "reversed")])
def test_gross_rotations_are_named(good, angle, says):
    report = check_flux_map(rotate(good, angle))
    assert says in next(finding.text for finding in report.findings if finding.name == "d axis")


def test_turning_never_leaves_the_data(good):
    for degrees in (-40, -3, 0, 7, 90, 180):
        turned = rotate(good, math.radians(degrees))
        cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        i_d, i_q = np.meshgrid(turned.i_d_a, turned.i_q_a)
        assert np.abs(cos * i_d - sin * i_q).max() <= 26 * (1 + 1e-12)
        assert np.abs(sin * i_d + cos * i_q).max() <= 26 * (1 + 1e-12)


def test_a_map_without_magnets_has_no_angle():
    axis = np.linspace(-5.0, 5.0, 11)
    i_d, i_q = np.meshgrid(axis, axis, indexing="ij")
    reluctance = FluxMap(axis, axis, 0.01 * i_d, 0.03 * i_q)
    report = check_flux_map(reluctance)
    assert report.ok
    assert math.isnan(report.no_load_angle_rad)
    with pytest.raises(ConfigError, match="no magnet flux"):
        rotate(reluctance, report.no_load_angle_rad)


def test_non_reciprocal_flux_is_measured_and_repaired(good):
    i_d, i_q = np.meshgrid(good.i_d_a, good.i_q_a, indexing="ij")
    curl = 1e-3
    bad = replace(good, psi_d_wb=good.psi_d_wb + curl * i_q / 2, psi_q_wb=good.psi_q_wb - curl * i_d / 2)
    report = check_flux_map(bad)
    assert not verdicts(report)["reciprocal"]
    # a curl of 1 mH everywhere, on top of what interpolation leaves at the kinks (0.15 mH)
    assert report.curl_max_h == pytest.approx(curl, abs=0.2e-3)
    # the planted field is its own least change: the pure rotation is orthogonal to every gradient but the border's
    planted = np.sqrt(np.mean((curl / 2) ** 2 * (i_d**2 + i_q**2))) / flux_range(good)
    assert 0.5 * planted <= report.reciprocity_rms <= planted
    repaired = make_reciprocal(bad)
    assert check_flux_map(repaired).reciprocity_rms <= 1e-12
    assert "made reciprocal" in repaired.meta["repairs"][0]


def test_the_reciprocal_change_is_the_least_one():
    rng = np.random.default_rng(3)
    axis_d, axis_q = np.cumsum(rng.uniform(0.5, 1, 6)) - 2, np.cumsum(rng.uniform(0.5, 1, 5)) - 2
    flux_map = FluxMap(axis_d, axis_q, *rng.normal(size=(2, 6, 5)))
    loops = LoopIntegrals(axis_d, axis_q)
    rows = []
    for k in range(60):
        unit = np.zeros(60)
        unit[k] = 1.0
        rows.append(loops(unit[:30].reshape(6, 5), unit[30:].reshape(6, 5)).ravel())
    matrix = np.array(rows).T
    psi = np.concatenate([flux_map.psi_d_wb.ravel(), flux_map.psi_q_wb.ravel()])
    expected = -np.linalg.pinv(matrix) @ matrix @ psi
    change = np.concatenate([part.ravel() for part in reciprocal_change(flux_map)])
    assert np.allclose(change, expected, atol=1e-10)


def test_loop_integrals_of_a_gradient_vanish():
    axis = np.linspace(-2.0, 3.0, 8)
    i_d, i_q = np.meshgrid(axis, axis, indexing="ij")
    # W = d^4 + d^3 q + d^2 q^2 - q^4: its gradient is cubic along each axis, the splines are exact
    psi_d, psi_q = 4 * i_d**3 + 3 * i_d**2 * i_q + 2 * i_d * i_q**2, i_d**3 + 2 * i_d**2 * i_q - 4 * i_q**3
    assert np.abs(LoopIntegrals(axis, axis)(psi_d, psi_q)).max() <= 1e-12


def test_asymmetry_is_measured_and_repaired(good):
    _, i_q = np.meshgrid(good.i_d_a, good.i_q_a, indexing="ij")
    bad = replace(good, psi_d_wb=good.psi_d_wb + 1e-3 * i_q)
    report = check_flux_map(bad)
    assert not verdicts(report)["symmetric in i_q"]
    assert report.asymmetry_max == pytest.approx(1e-3 * 26 / flux_range(bad), rel=1e-9)
    repaired = symmetrise(bad)
    assert check_flux_map(repaired).asymmetry_max <= 1e-12
    assert np.abs(repaired.psi_d_wb - good.psi_d_wb).max() <= 1e-12
    assert "made symmetric" in repaired.meta["repairs"][0]


def test_symmetrise_keeps_only_what_both_sides_have(good):
    cut = FluxMap(good.i_d_a, good.i_q_a[10:], good.psi_d_wb[:, 10:], good.psi_q_wb[:, 10:])
    repaired = symmetrise(cut)
    assert (repaired.i_q_a[0], repaired.i_q_a[-1]) == (-16.0, 16.0)
    assert np.array_equal(repaired.psi_d_wb, repaired.psi_d_wb[:, ::-1])
    assert np.array_equal(repaired.psi_q_wb, -repaired.psi_q_wb[:, ::-1])


@pytest.mark.parametrize("side", [1, -1])
def test_a_half_map_is_mirrored(good, side):
    half = slice(26, None) if side > 0 else slice(None, 27)
    part = FluxMap(good.i_d_a, good.i_q_a[half], good.psi_d_wb[:, half], good.psi_q_wb[:, half])
    assert math.isnan(check_flux_map(part).asymmetry_rms)
    whole = symmetrise(part)
    assert np.array_equal(whole.i_q_a, good.i_q_a)
    assert np.abs(whole.psi_d_wb - good.psi_d_wb).max() <= 1e-15
    assert np.abs(whole.psi_q_wb - good.psi_q_wb).max() <= 1e-15


def test_non_monotonic_points_are_counted_and_placed(good):
    psi_q = good.psi_q_wb.copy()
    psi_q[30, 40] -= 0.3
    report = check_flux_map(replace(good, psi_q_wb=psi_q))
    assert not report.ok
    assert 0 < report.not_monotonic < 200
    text = next(finding.text for finding in report.findings if finding.name == "monotonic")
    assert f"i_d = {good.i_d_a[30]:.4g} A" in text
    assert report.findings[0].ok is False  # what is wrong comes first


# -- holes -------------------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(st.sets(st.tuples(st.integers(0, 6), st.integers(0, 7)), max_size=12))
def test_filling_continues_a_plane(holes):
    axis_d, axis_q = np.linspace(-3, 3, 7), np.array([-4.0, -3, -1.5, 0, 1, 2, 3.5, 4])
    i_d, i_q = np.meshgrid(axis_d, axis_q, indexing="ij")
    planes = 0.1 + 0.02 * i_d + 0.001 * i_q, 0.001 * i_d + 0.05 * i_q
    psi_d = planes[0].copy()
    for m, n in holes:
        psi_d[m, n] = np.nan
    grid = FluxGrid(axis_d, axis_q, psi_d, planes[1])
    known = ~grid.holes
    if min(known.any(axis=1).sum(), known.any(axis=0).sum()) < 4:
        return
    filled, text = fill_holes(grid)
    assert np.allclose(filled.psi_d_wb, planes[0], atol=1e-12)
    assert np.array_equal(filled.psi_q_wb[known], planes[1][known])
    assert text.startswith("holes filled") and f"{len(holes)} of 56" in text


def test_filling_a_saturated_map(good):
    """A hole in the middle and a missing corner: as good as the surface is smooth."""
    psi_d, psi_q = good.psi_d_wb.copy(), good.psi_q_wb.copy()
    psi_d[20:23, 30:33] = np.nan
    psi_q[:3, :3] = np.nan
    filled, _ = fill_holes(FluxGrid(good.i_d_a, good.i_q_a, psi_d, psi_q))
    error = np.hypot(filled.psi_d_wb - good.psi_d_wb, filled.psi_q_wb - good.psi_q_wb) / flux_range(good)
    assert error.max() <= 0.003  # measured 0.0011


def test_too_many_holes_are_refused():
    axis = np.arange(-2.0, 3.0)
    grid = np.full((5, 5), np.nan)
    grid[:2] = 1.0
    with pytest.raises(ConfigError, match="too little is left"):
        fill_holes(FluxGrid(axis, axis, grid, grid))


# -- the model behind the shipped map ----------------------------------------------------------------------


@settings(max_examples=100, deadline=None)
@given(st.floats(-0.5, 1.2), st.floats(-1.5, 1.5))
def test_the_analytic_machine_is_reciprocal(psi_d, psi_q):
    model, h = BridgeSaturation(), 1e-5
    by_q = (model.current(psi_d, psi_q + h)[0] - model.current(psi_d, psi_q - h)[0]) / (2 * h)
    by_d = (model.current(psi_d + h, psi_q)[1] - model.current(psi_d - h, psi_q)[1]) / (2 * h)
    assert by_q == pytest.approx(by_d, rel=1e-5, abs=1e-4)


@settings(max_examples=50, deadline=None)
@given(st.floats(-26, 26), st.floats(-26, 26))
def test_the_analytic_machine_is_inverted(i_d, i_q):
    model = BridgeSaturation()
    assert np.allclose(model.current(*model.flux(i_d, i_q)), [i_d, i_q], atol=1e-10)


def test_a_current_far_outside_the_machine_is_refused():
    with pytest.raises(ArithmeticError, match="no flux found"):
        BridgeSaturation().flux(np.nan, 0.0)


@pytest.mark.skipif(not MEASURED_MAP.is_file(), reason="the measured map is not on this machine")
def test_a_measured_map():
    from pmsmtool.machine.flux_map_import import load_flux_map

    report = check_flux_map(load_flux_map(MEASURED_MAP))
    assert report.ok
    assert 1e-4 < report.reciprocity_rms < 3e-4  # measured 2.04e-4
    assert report.psi_f_wb == pytest.approx(0.44415, abs=1e-5)
