# SPDX-License-Identifier: MIT
"""Tables as the drive uses them: the reported bound is true, files and words carry the same numbers."""

from __future__ import annotations

import ctypes
import json
import math
import re
import struct
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.default_governor import draw
from pmsmtool.cli.main import cli
from pmsmtool.design.lookup import design as lookup_design
from pmsmtool.design.lookup.design import LookupDesign, LookupRequest, design_table
from pmsmtool.design.lookup.file import lut_values, lut_words, table_csv, table_facts, table_npz, table_parameters
from pmsmtool.design.lookup.grid import (
    InterpolationError,
    StoredFormat,
    as_stored,
    interpolation_error,
    lsb_a,
    table_words,
)
from pmsmtool.design.lookup.table import (
    CUT,
    LookupTable,
    electrical_speed,
    flux_table,
    loci,
    speed_table,
    torque_limits,
)
from pmsmtool.design.operating_machine import OperatingMachine
from pmsmtool.design.ratings import ratings
from pmsmtool.design.tune import tune
from pmsmtool.errors import ConfigError, DesignInfeasible
from pmsmtool.firmware.core_binding import core
from pmsmtool.firmware.image import lut_size_words, pack_image
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.iron_loss_map import load_iron_loss_map
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.npz_file import npz_bytes, read_npz
from pmsmtool.params.catalogue import LUT_CAPACITY_WORDS
from pmsmtool.params.parameter_set import ParameterSet, default_set
from pmsmtool.sim.closed_loop import image_of
from pmsmtool.units import RPM_PER_RAD_S

PROFILES = Path(__file__).resolve().parents[2] / "profiles"
M = OperatingMachine(4, 0.05, 1e-3, 2.5e-3, 0.1)


@cache
def made(profile: str, **asked: Any) -> LookupDesign:
    source = load_machine_file(PROFILES / f"{profile}.toml")
    rated = ratings(source, 0.92 * source.inverter.V_max_v)
    return design_table(source, rated, LookupRequest(**asked), 0.08)


def corners(axis: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    cell = np.clip(np.searchsorted(axis, at, side="right") - 1, 0, axis.size - 2)
    return cell, (at - axis[cell]) / (axis[cell + 1] - axis[cell])


def bilinear(table: LookupTable, torque: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Currents at points, interpolated as a drive does; written for the test."""
    i, a = corners(table.torque_nm, torque)
    j, b = corners(table.y, speed)
    found = []
    for grid in (table.i_d_a[..., 0], table.i_q_a[..., 0]):
        low = (1 - a) * grid[i, j] + a * grid[i + 1, j]
        high = (1 - a) * grid[i, j + 1] + a * grid[i + 1, j + 1]
        found.append((1 - b) * low + b * high)
    return found[0], found[1]


def errors_at(table: LookupTable, torque: np.ndarray, speed: np.ndarray) -> tuple[float, float, float]:
    """Largest errors on a mesh of torques and speeds, evaluated with the machine's own functions."""
    machine = table.machine
    bounds = torque_limits(
        machine, electrical_speed(machine, speed), table.V_max_v, table.I_max_apk, table.i_d_min_a
    )  # fmt: skip
    x, y = (grid.ravel() for grid in np.meshgrid(torque, speed, indexing="ij"))
    i_d, i_q = bilinear(table, x, y)
    shape = (torque.size, speed.size)
    least, largest = (np.broadcast_to(b[:, 0], shape).ravel() for b in (bounds.least_nm, bounds.largest_nm))
    reached = machine.torque_nm(i_d, i_q) - np.clip(x, least, largest)
    voltage = machine.voltage_v(i_d, i_q, electrical_speed(machine, y)) - table.V_max_v[0]
    return float(np.abs(reached).max()), float(voltage.max()), float((np.hypot(i_d, i_q) - table.I_max_apk).max())


def finer(axis: np.ndarray, times: int) -> np.ndarray:
    return np.asarray(np.interp(np.arange((axis.size - 1) * times + 1) / times, np.arange(axis.size), axis))


@pytest.mark.parametrize("stored", ["float32", "int16"])
@pytest.mark.parametrize("profile", ["jercic-2017", "mtpv-test", "saturated-pmsyrm", "interior-2k2"])
def test_the_reported_bound_is_true_on_a_ten_times_finer_grid(profile: str, stored: str) -> None:
    design = made(profile, stored=stored, torque_bound=0.02, voltage_bound=0.02)
    table, error = design.table, design.error
    assert design.stored == stored
    grids = [(finer(table.torque_nm, 10), finer(table.y, 10))]
    rng = np.random.default_rng(4)
    inside = [np.sort(rng.uniform(axis[0], axis[-1], 400)) for axis in (table.torque_nm, table.y)]
    grids.append((inside[0], inside[1]))
    for torque, speed in grids:
        found = errors_at(table, torque, speed)
        for value, bound in zip(found, (error.torque_nm, error.voltage_v, error.current_a), strict=True):
            assert value <= bound
    # and the bound is no empty promise: the grid reaches most of it
    assert errors_at(table, *grids[0])[0] >= 0.8 * error.torque_nm
    assert error.torque_nm <= 0.02 * table.torque_nm[-1]
    assert error.voltage_v <= 0.02 * table.V_max_v[0]


@pytest.mark.chain
def test_bounds_that_do_not_fit_the_drive_are_refused_with_what_was_reached() -> None:
    with pytest.raises(DesignInfeasible, match="nodes keep the torque within"):
        made("interior-2k2", stored="float32", torque_bound=1e-3)


@pytest.mark.chain
def test_auto_takes_the_smaller_format_only_where_it_must() -> None:
    assert made("interior-2k2").stored == "float32"
    assert made("jercic-2017", torque_bound=0.009).stored == "int16"


@pytest.mark.chain
def test_a_table_ends_where_the_voltage_allows_braking_alone() -> None:
    design = made("jercic-2017")
    assert 944.0 < design.table.y[-1] < 945.0  # of 952 rpm, up to which a current exists that keeps the voltage limit
    assert any("no zero torque" in note for note in design.notes)
    assert design.table.torque_limits.largest_nm.min() >= 0.0
    assert not np.isnan(design.table.i_d_a).any()


def test_stored_numbers_are_what_comes_back() -> None:
    table = speed_table(
        M, torque_nm=np.linspace(-100, 100, 9), speed_rpm=np.linspace(0, 9000, 8), V_max_v=[30.0], I_max_apk=80.0
    )
    assert np.isnan(table.i_d_a).any()
    whole = as_stored(table, "int16")
    steps = whole.i_d_a / lsb_a(whole)
    assert np.nanmax(np.abs(steps - np.rint(steps))) < 1e-9
    assert np.nanmax(np.abs(whole.i_d_a - table.i_d_a)) <= 0.5001 * lsb_a(table)
    assert lsb_a(whole) == lsb_a(table)
    assert np.nanmax(np.abs(whole.margin_i - (80.0 - np.hypot(whole.i_d_a, whole.i_q_a)))) == 0.0
    rounded = as_stored(table, "float32")
    assert np.array_equal(rounded.i_q_a, table.i_q_a.astype(np.float32).astype(float), equal_nan=True)


@pytest.mark.parametrize("stored", ["float32", "int16"])
def test_words_fit_the_image_and_hold_the_stored_numbers(stored: StoredFormat) -> None:
    table = speed_table(
        M, torque_nm=np.linspace(-100, 100, 9), speed_rpm=np.linspace(0, 9000, 7), V_max_v=[30.0], I_max_apk=80.0
    )
    table = as_stored(table, stored)
    values, tables = lut_values(table, stored)
    words = lut_words(table, stored)
    assert len(words) == 4 * table_words(9, 7, 1, stored)
    complete = {**default_set().values, **values}
    pack_image(complete, words)
    parameters = ParameterSet(complete, tables)
    assert parameters.violations() == ()
    assert struct.unpack_from("<9f", words) == tuple(table.torque_nm.astype(np.float32))
    start = 4 * (9 + 7 + 1)
    if stored == "float32":
        read = np.frombuffer(words, "<f4", 63, start).astype(float)
    else:
        raw = np.frombuffer(words, "<i2", 63, start)
        read = np.where(raw == -32768, np.nan, raw * np.float64(np.float32(values["lut.lsb_a"])))
    assert np.allclose(read, table.i_d_a.ravel(), rtol=1e-7, atol=0.0, equal_nan=True)
    assert np.isnan(read).sum() == np.isnan(table.i_d_a).sum() > 0


@pytest.mark.parametrize("stored", ["float32", "int16"])
def test_what_the_drive_makes_of_the_table_keeps_the_bound(stored: StoredFormat) -> None:
    """The core itself reads the words and asks for currents; the machine says what they are worth."""
    design = made("mtpv-test", stored=stored, torque_bound=0.02, voltage_bound=0.02)
    table, error = design.table, design.error
    values, _ = lut_values(table, stored)
    given = {"field_weakening.mode": 1.0, "motor.I_max_apk": 151.0, "field_weakening.i_d_min_a": -151.0}
    binding = core()
    words = lut_words(table, stored)
    params = binding.params({**default_set().values, **given, **values}, words)
    lut = (ctypes.c_uint32 * (len(words) // 4)).from_buffer_copy(words)
    rng = np.random.default_rng(6)
    torque = rng.uniform(table.torque_nm[0], table.torque_nm[-1], 3000).astype(np.float32).astype(float)
    speed = rng.uniform(0.0, table.y[-1], 3000)
    omega = electrical_speed(table.machine, speed).astype(np.float32).astype(float)
    asked = np.empty((3000, 2))
    for k in range(3000):
        state = binding.state()
        measurement = binding.make("pmsm_measurement", omega_e=omega[k], U_dc=173.2, T_winding=20.0)
        request = binding.make("pmsm_reference", mode=3, tau_ref=torque[k])
        output = binding.make("pmsm_output")
        binding.library.pmsm_step(
            *map(ctypes.byref, (state, params)), lut, *map(ctypes.byref, (measurement, request, output))
        )
        asked[k] = state.live.i_d_req, state.live.i_q_req
    bounds = torque_limits(table.machine, omega, table.V_max_v, table.I_max_apk, table.i_d_min_a)
    wanted = np.clip(torque, bounds.least_nm[:, 0], bounds.largest_nm[:, 0])
    reached = table.machine.torque_nm(asked[:, 0], asked[:, 1])
    assert np.abs(reached - wanted).max() <= error.torque_nm
    assert (table.machine.voltage_v(asked[:, 0], asked[:, 1], omega) - table.V_max_v[0]).max() <= error.voltage_v
    assert np.abs(reached - wanted).max() > 0.3 * error.torque_nm  # the table was really asked


@pytest.mark.chain
@pytest.mark.parametrize("stored", ["float32", "int16"])
def test_a_voltage_axis_is_refined_and_bounded_between_its_voltages_too(stored: str) -> None:
    asked = {"U_dc_v": (130.0, 190.0), "torque_bound": 0.05, "voltage_bound": 0.03, "stored": stored}
    design = made("mtpv-test", **asked)
    table, error = design.table, design.error
    assert table.U_dc_v.size > 2 and {130.0, 190.0} <= set(table.U_dc_v.tolist())
    assert error.torque_nm <= 0.05 * table.torque_nm[-1] and error.voltage_v <= 0.03 * table.V_max_v[0]
    # a grid ten times finer along every axis, taken in random planes of it
    torque, speed, voltage = (finer(axis, 10) for axis in (table.torque_nm, table.y, table.U_dc_v))
    rng = np.random.default_rng(1)
    worst_torque = 0.0
    for U_dc in rng.choice(voltage, 9, replace=False):
        k, c = (float(v[0]) for v in corners(table.U_dc_v, np.array([U_dc])))
        low, high = int(k), int(k) + 1
        plane = replace(
            table,
            i_d_a=(1 - c) * table.i_d_a[..., low : low + 1] + c * table.i_d_a[..., high : high + 1],
            i_q_a=(1 - c) * table.i_q_a[..., low : low + 1] + c * table.i_q_a[..., high : high + 1],
            V_max_v=(1 - c) * table.V_max_v[low : low + 1] + c * table.V_max_v[high : high + 1],
        )
        found = errors_at(plane, torque, speed)
        for value, bound in zip(found, (error.torque_nm, error.voltage_v, error.current_a), strict=True):
            assert value <= bound
        worst_torque = max(worst_torque, found[0])
    assert worst_torque >= 0.5 * error.torque_nm


@pytest.mark.chain
def test_without_bounds_two_voltages_get_the_largest_grid_that_fits_and_it_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With a tenth of the memory, which is as full at 5 and 8 % as all of it with the default profile at 1 %."""
    monkeypatch.setattr(lookup_design, "LUT_CAPACITY_WORDS", 800)
    design = made("interior-2k2", U_dc_v=(400.0, 600.0))
    assert design.torque_bound == design.voltage_bound in lookup_design.BOUNDS[1:]
    assert any(f"this one is within {100.0 * design.torque_bound:g} %" in note for note in design.notes)
    assert table_words(*design.table.i_d_a.shape, design.stored) <= 800  # type: ignore[arg-type]
    assert design.error.torque_nm <= design.torque_bound * design.table.torque_nm[-1]
    assert design.error.voltage_v <= design.voltage_bound * design.table.V_max_v.min()
    with pytest.raises(DesignInfeasible, match="asked for"):
        made("interior-2k2", U_dc_v=(400.0, 600.0), torque_bound=0.01)


@pytest.mark.parametrize("stored", ["float32", "int16"])
def test_the_bound_of_a_flux_table_is_true_on_a_ten_times_finer_grid(stored: str) -> None:
    design = made("mtpv-test", axis="flux", stored=stored, torque_bound=0.02, voltage_bound=0.02)
    table, error = design.table, design.error
    torque, flux = finer(table.torque_nm, 10), finer(table.y, 10)
    lossless = replace(table.machine, R=0.0)
    bounds = torque_limits(lossless, [1.0], flux, table.I_max_apk, table.i_d_min_a)
    x, y = (grid.ravel() for grid in np.meshgrid(torque, flux, indexing="ij"))
    i_d, i_q = bilinear(table, x, y)
    shape = (torque.size, flux.size)
    least, largest = (np.broadcast_to(b[0], shape).ravel() for b in (bounds.least_nm, bounds.largest_nm))
    reached = np.abs(lossless.torque_nm(i_d, i_q) - np.clip(x, least, largest)).max()
    assert 0.8 * error.torque_nm <= reached <= error.torque_nm
    assert (np.hypot(*lossless.flux(i_d, i_q)) - y).max() <= error.voltage_v
    assert (np.hypot(i_d, i_q) - table.I_max_apk).max() <= error.current_a


def test_flux_table_is_exact_without_resistance_and_says_how_far_off_it_is_with() -> None:
    lossless = replace(M, R=0.0)
    flux = np.linspace(0.02, 0.3, 9)
    torque = np.linspace(-120.0, 120.0, 7)
    over_flux = flux_table(lossless, torque_nm=torque, flux_limit_wb=flux, I_max_apk=150.0)
    for k, limit in enumerate(flux):
        rpm = 100.0 / limit / M.pole_pairs * RPM_PER_RAD_S
        over_speed = speed_table(lossless, torque_nm=torque, speed_rpm=[rpm], V_max_v=[100.0], I_max_apk=150.0)
        assert np.allclose(over_flux.i_d_a[:, k, 0], over_speed.i_d_a[:, 0, 0], atol=1e-6)
        assert np.allclose(over_flux.i_q_a[:, k, 0], over_speed.i_q_a[:, 0, 0], atol=1e-6)
    design = made("mtpv-test", axis="flux", torque_bound=0.03)
    note = " ".join(design.notes)
    assert "prefer" in note
    V = 0.92 * 173.2 / math.sqrt(3.0)
    over = over_the_limit(design.table, V)
    assert f"need up to {over:.3g} V" in note
    # braking: resistance helps, the flux table does not know it
    omega = V / design.table.y
    reach = torque_limits(design.table.machine, omega, [V], 150.0, design.table.i_d_min_a).least_nm[:, 0]
    unused = design.table.torque_limits.least_nm[:, 0] - reach
    assert f"leave up to {np.nanmax(unused):.3g} N m unused" in note
    assert design.table.margin_v.min() >= -1e-6
    assert lut_values(design.table, design.stored)[0]["lut.axis_kind"] == 1.0


def over_the_limit(table: LookupTable, V: float) -> float:
    """Largest voltage that the points of a flux table need beyond V at the speeds where it sends them, cell by cell."""
    worst = 0.0
    for k, flux in enumerate(table.y):
        voltage = table.machine.voltage_v(table.i_d_a[:, k, 0], table.i_q_a[:, k, 0], V / flux)
        worst = max(worst, float(voltage.max()) - V)
    return worst


def test_every_cell_says_how_much_torque_is_left_or_missing() -> None:
    table = speed_table(
        M, torque_nm=[-500.0, -20.0, 0.0, 60.0, 500.0], speed_rpm=[0.0, 3000.0, 9000.0], V_max_v=[100.0, 15.0],
        I_max_apk=80.0,
    )  # fmt: skip
    cut = (table.limits & CUT) != 0
    none = np.isnan(table.i_d_a)
    assert cut.any() and none.any() and (~cut & ~none).any()
    assert np.array_equal(np.isnan(table.margin_torque_nm), none)
    demand = np.broadcast_to(table.torque_nm[:, None, None], cut.shape)
    missing = np.abs(demand - table.achieved_torque_nm)[cut]
    assert np.allclose(table.margin_torque_nm[cut], -missing, rtol=1e-12)
    assert (table.margin_torque_nm[~cut & ~none] >= 0.0).all()


@pytest.mark.chain
def test_hot_and_cold_tables_differ_as_the_machine_does() -> None:
    cold, hot = made("mtpv-test"), made("mtpv-test", T_winding_c=140.0, T_magnet_c=100.0)
    assert hot.table.machine.R == pytest.approx(0.05 * (1.0 + 0.00393 * 120.0))
    assert hot.table.machine.psi_f == pytest.approx(0.1 * (1.0 - 0.0012 * 80.0))
    assert hot.table.torque_limits.largest_nm[0, 0] < cold.table.torque_limits.largest_nm[0, 0]


def test_loci_follow_the_closed_forms() -> None:
    table = speed_table(
        replace(M, R=0.0), torque_nm=[0.0, 100.0], speed_rpm=[1.0, 5000.0], V_max_v=[100.0], I_max_apk=150.0
    )
    lines = loci(table, points=26)
    mtpa, mtpv = lines["mtpa"], lines["mtpv"]
    square, k = mtpa.i_d_a**2 + mtpa.i_q_a**2, M.L_d - M.L_q
    assert np.allclose(mtpa.i_d_a, (-0.1 + np.sqrt(0.01 + 8 * k**2 * square)) / (4 * k), atol=1e-6)
    F = 100.0 / electrical_speed(M, mtpv.speed_rpm)
    psi_d = (-M.L_q * 0.1 + np.sqrt(M.L_q**2 * 0.01 + 8 * k**2 * F**2)) / (4 * k)
    known = ~np.isnan(mtpv.torque_nm)
    assert known.sum() > 20
    assert np.allclose(M.psi_f + M.L_d * mtpv.i_d_a[known], psi_d[known], atol=1e-8)
    assert np.nanmax(lines["largest"].torque_nm - np.maximum(mtpv.torque_nm, 0.0)) >= 0.0


# -- iron loss -----------------------------------------------------------------------------------------------


@pytest.mark.chain
def test_iron_loss_moves_the_optimum_to_the_least_total_loss(tmp_path: Path) -> None:
    """Coefficients proportional to |psi|^2, as a machine has them; every cell against a search along its contour."""
    i_d, i_q = np.linspace(-160.0, 60.0, 23), np.linspace(-160.0, 160.0, 33)
    psi_d, psi_q = M.flux(i_d[:, None], i_q[None, :])
    grid = psi_d**2 + psi_q**2
    path = tmp_path / "iron.npz"
    path.write_bytes(npz_bytes({"i_d_a": i_d, "i_q_a": i_q, "c_h_w_per_hz": 60.0 * grid, "c_e_w_per_hz2": 0.4 * grid}))
    machine = replace(M, loss_map=load_iron_loss_map(path))
    rpm = np.array([200.0, 1500.0, 3000.0, 5000.0])
    torque = np.array([-60.0, 15.0, 40.0, 90.0])
    table = speed_table(machine, torque_nm=torque, speed_rpm=rpm, V_max_v=[100.0], I_max_apk=150.0)
    copper = speed_table(M, torque_nm=torque, speed_rpm=rpm, V_max_v=[100.0], I_max_apk=150.0)
    moved = 0
    for y, omega in enumerate(electrical_speed(M, rpm)):
        f = omega / (2.0 * np.pi)

        def loss(d: np.ndarray, q: np.ndarray, f: float = f) -> np.ndarray:
            psi = np.hypot(*M.flux(d, q))
            return np.asarray(1.5 * M.R * (d**2 + q**2) + (60.0 * f + 0.4 * f**2) * psi**2)

        for x, wanted in enumerate(torque):
            if not copper.torque_limits.least_nm[y, 0] < wanted < copper.torque_limits.largest_nm[y, 0]:
                continue
            d = np.linspace(-150.0, 60.0, 400_001)
            q = wanted / (1.5 * M.pole_pairs * (M.psi_f + (M.L_d - M.L_q) * d))
            allowed = (np.hypot(d, q) <= 150.0) & (M.voltage_v(d, q, omega) <= 100.0)
            best = float(loss(d, q)[allowed].min())
            ours = float(loss(table.i_d_a[x, y, 0], table.i_q_a[x, y, 0]))
            # the search steps by 0.5 mA, so at the voltage limit it ends a little before the optimum
            assert best * (1.0 - 1e-5) <= ours <= best * (1.0 + 1e-8)
            assert table.margin_v[x, y, 0] >= -1e-9 * 100.0
            assert float(table.achieved_torque_nm[x, y, 0]) == pytest.approx(wanted, rel=1e-9)
            moved += abs(table.i_d_a[x, y, 0] - copper.i_d_a[x, y, 0]) > 0.5
    assert moved >= 6


def test_a_bad_iron_loss_map_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "iron.npz"
    axis = np.linspace(-1.0, 1.0, 5)
    path.write_bytes(npz_bytes({"i_d_a": axis, "i_q_a": axis, "c_h_w_per_hz": np.ones((5, 5))}))
    with pytest.raises(ConfigError, match="c_e_w_per_hz2"):
        load_iron_loss_map(path)
    grids = {"c_h_w_per_hz": np.ones((5, 5)), "c_e_w_per_hz2": -np.ones((5, 5))}
    path.write_bytes(npz_bytes({"i_d_a": axis, "i_q_a": axis, **grids}))
    with pytest.raises(ConfigError, match="negative"):
        load_iron_loss_map(path)


def test_references_beyond_the_iron_loss_map_are_refused() -> None:
    axis = np.linspace(-40.0, 40.0, 9)
    flux = np.hypot(*M.flux(axis[:, None], axis[None, :])) ** 2
    machine = replace(M, loss_map=FluxMap(axis, axis, 60.0 * flux, 0.4 * flux))
    inside = speed_table(machine, torque_nm=[20.0], speed_rpm=[1500.0], V_max_v=[100.0], I_max_apk=150.0)
    assert np.hypot(inside.i_d_a, inside.i_q_a).max() < 40.0
    with pytest.raises(ConfigError, match="1 of 1 references lie outside"):
        speed_table(machine, torque_nm=[90.0], speed_rpm=[1500.0], V_max_v=[100.0], I_max_apk=150.0)


def test_a_flux_table_does_not_pretend_to_know_iron_loss() -> None:
    axis = np.linspace(-200.0, 200.0, 9)
    flux = np.hypot(*M.flux(axis[:, None], axis[None, :])) ** 2
    loss = FluxMap(axis, axis, 60.0 * flux, 0.4 * flux)
    with pytest.raises(ConfigError, match="iron loss depends on the speed"):
        flux_table(replace(M, loss_map=loss), torque_nm=[20.0], flux_limit_wb=[0.1], I_max_apk=150.0)
    source = load_machine_file(PROFILES / "mtpv-test.toml")
    rated, request = ratings(source, 0.92 * source.inverter.V_max_v), LookupRequest("flux", 5, 5)
    design = design_table(source, rated, request, 0.08, loss)
    assert any("iron-loss map is left out" in note for note in design.notes)
    assert np.array_equal(design.table.i_d_a, design_table(source, rated, request, 0.08).table.i_d_a)


def test_a_flux_table_says_by_how_much_it_is_off() -> None:
    """In volts, of the order of R i, and as a share of the limit."""
    source = load_machine_file(PROFILES / "mtpv-test.toml")
    V = 0.92 * source.inverter.V_max_v
    design = design_table(source, ratings(source, V), LookupRequest("flux", 7, 7), 0.08)
    (note,) = (note for note in design.notes if "contains no resistance" in note)
    table = design.table
    at, over, percent, unused = (float(x) for x in re.findall(r"(?:at|up to|\() ?([0-9.e+-]+) ?(?:V|%|N m)", note))
    drop = source.machine.R_s_ohm * float(np.nanmax(np.hypot(table.i_d_a, table.i_q_a)))
    assert at == pytest.approx(V, rel=1e-3) and 0.3 * drop < over < 2.0 * drop
    assert percent == pytest.approx(100.0 * over / at, rel=0.06)
    assert 0.0 <= unused < 0.05 * float(table.torque_nm[-1])


# -- files and command ---------------------------------------------------------------------------------------


def test_files_hold_every_cell_and_the_same_bytes(tmp_path: Path) -> None:
    design = made("mtpv-test", torque_bound=0.05, voltage_bound=0.05)
    facts = table_facts(design.table, design.stored, design.error)
    content = table_npz(design.table, facts, loci(design.table, 11))
    assert content == table_npz(design.table, facts, loci(design.table, 11))
    (tmp_path / "lut.npz").write_bytes(content)
    arrays = read_npz(tmp_path / "lut.npz")
    assert arrays["torque_nm"].ndim == arrays["speed_rpm"].ndim == 1
    shape = (arrays["torque_nm"].size, arrays["speed_rpm"].size)
    for name in ("i_d_a", "i_q_a", "achieved_torque_nm", "binding", "margin_v", "margin_i", "margin_torque_nm"):
        assert arrays[name].shape == shape
    assert json.loads(str(arrays["meta"]))["content"].startswith("sha256:")
    lines_of = {name.split("_")[0]: len(arrays[name]) for name in arrays if name.startswith("mtp")}
    assert lines_of == {"mtpa": 11, "mtpv": 11}
    assert "mtpv_speed_rpm" in arrays and "mtpa_speed_rpm" not in arrays, "a largest torque per ampere has no speed"
    back = table_parameters(arrays, "lut.npz")
    values, tables = lut_values(design.table, design.stored)
    assert (back.values, back.tables) == (values, tables)
    lines = table_csv(design.table).splitlines()
    assert lines[0].startswith("torque_nm,speed_rpm,i_d_a") and lines[0].endswith("binding")
    assert lines[1].startswith("N m,rpm,A,A,N m,V,A")
    assert len(lines) == 2 + shape[0] * shape[1]
    row = lines[2 + shape[1] + 3].split(",")
    assert float(row[2]) == arrays["i_d_a"][1, 3] and row[-1] == arrays["binding"][1, 3]


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(cli, ["lut", *arguments])
    return int(getattr(result.exception, "exit_code", result.exit_code)), result.stdout


@pytest.mark.chain
def test_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "lut.npz"
    source = str(PROFILES / "mtpv-test.toml")
    points = ["--torque-points", "7", "--speed-points", "5"]
    code, text = run(source, "-o", str(target), *points, "--plot", str(tmp_path / "lut.svg"))
    assert code == 0 and "mtpv" in text
    assert target.exists() and (tmp_path / "lut.csv").exists()
    first = (tmp_path / "lut.svg").read_bytes()
    assert run(source, "-o", str(target), *points, "--plot", str(tmp_path / "lut.svg"))[0] == 0
    assert (tmp_path / "lut.svg").read_bytes() == first
    with monkeypatch.context() as patched:  # what fills the whole memory is tried above
        patched.setattr("pmsmtool.design.lookup.grid._TURNS_MAX", 2)
        assert run(source, "-o", str(target), "--torque-bound", "1e-4")[0] == 1
    assert run(source, "-o", str(target), "--torque-points", "12")[0] == 2
    assert run(source, "-o", str(target), *points, "--plot", str(tmp_path / "lut.xyz"))[0] == 2
    flux = run(source, "-o", str(target), *points, "--axis", "flux", "--plot", str(tmp_path / "flux.svg"))
    assert flux[0] == 0 and b"flux / Wb" in (tmp_path / "flux.svg").read_bytes()
    code, text = run(source, "-o", str(target), *points, "--json")
    found = json.loads(text)
    assert found["schema"] == "pmsmtool.lut/1"
    code, text = run(str(PROFILES / "interior-2k2.toml"), "-o", str(target), *points, "--json")
    assert any("rectifies through the brake chopper" in note for note in json.loads(text)["notes"])


def test_a_table_of_a_design_uses_its_limits(tmp_path: Path) -> None:
    design = tmp_path / "design.toml"
    source = str(PROFILES / "mtpv-test.toml")
    assert CliRunner().invoke(cli, ["tune", source, "-o", str(design), "--voltage-margin", "0.2"]).exit_code == 0
    points = ["--torque-points", "5", "--speed-points", "5"]
    assert run(str(design), "-o", str(tmp_path / "a.npz"), *points)[0] == 0
    assert run(source, "-o", str(tmp_path / "b.npz"), *points, "--voltage-margin", "0.2")[0] == 0
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_capacity_is_the_drives() -> None:
    assert table_words(63, 63, 1, "float32") <= LUT_CAPACITY_WORDS < table_words(64, 64, 1, "float32")
    assert isinstance(interpolation_error(made("interior-2k2").table), InterpolationError)


@pytest.mark.chain
def test_a_table_leaves_room_for_the_saturation_table() -> None:
    """75 x 53 nodes in float32 need 8079 words, with the saturation table 8275: the drive refused the set of `tune`."""
    source = draw("saturated", 8601)
    stored = tune(source).parameter_set()
    words = lut_size_words(stored.values)
    assert words <= LUT_CAPACITY_WORDS and not stored.violations()
    assert len(image_of(source, stored)) > 4 * words
    zeros = (0.0,) * (75 * 53)
    x, y = (tuple(map(float, range(n))) for n in (75, 53))
    nodes = {"lut.i_d_a": zeros, "lut.i_q_a": zeros, "lut.axis_x": x, "lut.axis_y": y}
    full = {**stored.values, "lut.format": 1.0, "lut.n_x": 75.0, "lut.n_y": 53.0}
    full_set = replace(stored, values=full, tables={**stored.tables, **nodes})
    assert any("axes and tables need 8275 words" in line for line in full_set.violations())
