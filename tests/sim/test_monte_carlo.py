# SPDX-License-Identifier: MIT
"""Many drives in one call: each as it would run alone, whatever the number of threads; machines that differ."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pmsmtool.machine.flux_map import FluxMap, FluxScale, ScalableMap
from pmsmtool.machine.flux_map_cells import library
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.sim.closed_loop import DriveRuns, Variation, cores, simulate, simulate_many
from pmsmtool.sim.scenarios import Scenario
from tests.sim.bench import U_DC, values

PROFILES = Path(__file__).resolve().parents[2] / "profiles"

STEPS = Scenario(
    "steps", 0.02, "current", {"i_q_a": ((0.0, 0.0), (0.002, 10.0), (0.01, -6.0)), "driven_rpm": ((0.0, 900.0),)},
    rotor="driven", start_rpm=900.0,
)  # fmt: skip

SCALED_A = 1e-9
"""Currents of the stretched table against those of the nominal one (A; measured 2e-12)."""

FITTED = 1e-12
"""Closed loop on a stretched table against one fitted from scaled grids, relative (measured 6e-16)."""


def interior() -> tuple[MachineFile, ParameterSet]:
    return load_machine_file(PROFILES / "interior-2k2.toml"), ParameterSet(values(inverter__U_dc_nom_v=540.0))


def same(first: DriveRuns, second: DriveRuns) -> bool:
    return all(
        np.array_equal(getattr(first, field.name), getattr(second, field.name), equal_nan=True)
        for field in fields(DriveRuns)
    )


def after(machine: MachineFile, params: ParameterSet, seed: int) -> NDArray[np.float64]:
    """Return the amplitude of the true current at every period's end, of the scenario on one drive alone."""
    longer = replace(STEPS, duration_s=STEPS.duration_s + 1e-9 * params.values["inverter.T_s_ns"])
    trace = simulate(machine, params, longer, seed=seed)  # its rows are of the periods' starts
    amplitude: NDArray[np.float64] = np.sqrt(trace["i_d_true_a"] ** 2 + trace["i_q_true_a"] ** 2)[1:]
    return amplitude


def test_every_drive_runs_as_it_would_alone() -> None:
    machine, params = interior()
    noisy = replace(machine, simulation={**machine.simulation, "sensor_noise_apk": 0.05})
    runs = simulate_many(noisy, params, STEPS, [Variation(seed=7), Variation(seed=8)])
    for k, seed in enumerate((7, 8)):
        alone = after(noisy, params, seed)
        assert runs.i_peak_a[k] == alone.max()
        assert runs.i_rms_a[k] == pytest.approx(math.sqrt(np.mean(alone**2)), rel=1e-12)
    assert runs.i_peak_a[0] != runs.i_peak_a[1]


def test_what_is_kept_is_of_the_whole_run() -> None:
    machine, params = interior()
    runs = simulate_many(machine, params, STEPS, [Variation(T_winding_c=50.0)])
    assert runs.omega_peak_rad_s[0] == pytest.approx(900.0 * math.pi / 30.0, rel=1e-9)
    assert 0.0 < runs.u_peak[0] <= 1.0 / math.sqrt(3.0) + 1e-6
    assert runs.trip[0] == 0


def test_a_trip_is_named() -> None:
    machine, params = interior()
    low = params.merged(ParameterSet({"protection.i_trip_apk": 8.0}))
    assert simulate_many(machine, low, STEPS, [Variation()]).trip[0] == 0x2310


@pytest.mark.parametrize("profile", ["interior-2k2", "saturated-pmsyrm"])
def test_the_numbers_do_not_depend_on_threads_or_neighbours(profile: str) -> None:
    machine, params = load_machine_file(PROFILES / f"{profile}.toml"), interior()[1]
    rng = np.random.default_rng(2)
    factors = rng.uniform(0.9, 1.1, (13, 5)).tolist()
    many = [
        Variation(R, L_d, L_q, psi_f, J, 0.01 * k, 80.0, 60.0, 500.0, k)
        for k, (R, L_d, L_q, psi_f, J) in enumerate(factors)
    ]
    one = simulate_many(machine, params, STEPS, many, threads=1)
    assert len(set(one.i_peak_a.tolist())) == len(many)
    for threads in (2, 5, None):
        assert same(simulate_many(machine, params, STEPS, many, threads=threads), one)
    few = simulate_many(machine, params, STEPS, many[4:6])
    assert few.i_rms_a.tolist() == one.i_rms_a[4:6].tolist()
    assert cores() >= 1


def test_a_varied_machine_is_that_machine() -> None:
    """The factors, against a machine file that says the same."""
    machine, params = interior()
    m = machine.machine
    other = replace(
        machine,
        machine=replace(
            m, R_s_ohm=1.1 * m.R_s_ohm, L_d_h=0.9 * m.L_d_h, L_q_h=1.05 * m.L_q_h, psi_f_wb=0.97 * m.psi_f_wb
        ),
        inverter=replace(machine.inverter, U_dc_v=500.0),
        simulation={"T_winding_c": 90.0, "T_magnet_c": 70.0, "encoder_offset_rad": 0.03},
    )
    written = simulate_many(other, params, STEPS, [Variation()])
    varied = simulate_many(
        replace(machine, simulation={"encoder_offset_rad": 0.0}), params, STEPS,
        [Variation(1.1, 0.9, 1.05, 0.97, 1.0, 0.03, 90.0, 70.0, 500.0)],
    )  # fmt: skip
    for name in ("i_peak_a", "i_rms_a", "torque_nm", "u_peak"):
        assert getattr(varied, name)[0] == pytest.approx(getattr(written, name)[0], rel=1e-9)
    assert U_DC != 500.0


def test_a_scaled_flux_map_is_the_scaled_machine() -> None:
    machine = load_machine_file(PROFILES / "saturated-pmsyrm.toml")
    flux_map, psi_f = machine.flux_map, machine.machine.psi_f_wb
    assert flux_map is not None
    scale = FluxScale(L_d=1.1, L_q=0.93, psi_f=0.96)
    scalable = ScalableMap.of(flux_map, psi_f)
    struct = scalable.struct(scale)
    rng = np.random.default_rng(5)
    psi_d, psi_q = flux_map.flux(rng.uniform(-15.0, 5.0, 200), rng.uniform(-15.0, 15.0, 200))
    scaled = np.array([0.96 * psi_f + 1.1 * (psi_d - psi_f), 0.93 * psi_q])
    back = np.empty((2, 200))
    library().pmsm_flux_map_current_many(
        struct, 200, scaled[0].ctypes.data, scaled[1].ctypes.data, back[0].ctypes.data, back[1].ctypes.data, None
    )
    assert np.allclose(back, flux_map.current(psi_d, psi_q), rtol=0.0, atol=SCALED_A)
    # the same machine, fitted from the scaled grids, in closed loop
    grids = (0.96 * psi_f + 1.1 * (flux_map.psi_d_wb - psi_f), 0.93 * flux_map.psi_q_wb)
    own = replace(machine.machine, psi_f_wb=0.96 * psi_f)
    fitted = replace(machine, machine=own, flux_map=FluxMap(flux_map.i_d_a, flux_map.i_q_a, *grids))
    params = interior()[1]
    written = simulate_many(fitted, params, STEPS, [Variation(T_magnet_c=80.0)])
    varied = simulate_many(machine, params, STEPS, [Variation(L_d=1.1, L_q=0.93, psi_f=0.96, T_magnet_c=80.0)])
    for name in ("i_peak_a", "i_rms_a", "torque_nm", "u_peak"):
        assert getattr(varied, name)[0] == pytest.approx(getattr(written, name)[0], rel=FITTED)


def test_the_forward_cell_holds_what_a_simulation_asks_for() -> None:
    machine = load_machine_file(PROFILES / "saturated-pmsyrm.toml")
    flux_map, psi_f = machine.flux_map, machine.machine.psi_f_wb
    assert flux_map is not None
    scalable = ScalableMap.of(flux_map, psi_f)
    i_d, i_q = np.zeros(1), np.zeros(1)
    psi, jac = np.empty((2, 1)), np.empty(4)
    library().pmsm_flux_map_flux_many(
        scalable.struct(FluxScale(1.2, 0.9, 0.95)), 1, i_d.ctypes.data, i_q.ctypes.data, psi[0].ctypes.data,
        psi[1].ctypes.data, jac.ctypes.data, None,
    )  # fmt: skip
    zero = flux_map.flux(0.0, 0.0)
    assert psi[0, 0] == pytest.approx(0.95 * psi_f + 1.2 * (float(zero[0]) - psi_f), rel=1e-12)
    assert psi[1, 0] == pytest.approx(0.9 * float(zero[1]), abs=1e-15)
    assert jac == pytest.approx([0.9 * scalable.L_least_h, 0.0, 0.0, 0.9 * scalable.L_least_h], rel=1e-12)
    nodes = flux_map.incremental_inductance(*np.meshgrid(flux_map.i_d_a, flux_map.i_q_a))
    assert 0.0 < scalable.L_least_h <= min(nodes[0, 0].min(), nodes[1, 1].min())
