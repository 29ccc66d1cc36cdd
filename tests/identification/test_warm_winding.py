# SPDX-License-Identifier: MIT
"""A winding that is not at the reference temperature: R is accepted, at the temperature of the test and at T_ref."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.random_drives import true_loop_resistance
from pmsmtool.bus.connect import Connection
from pmsmtool.commissioning.contradiction import compare
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.files import data_folder
from pmsmtool.identification.replay import replay
from pmsmtool.identification.request import MACHINE, NAMEPLATE, IdentifyRequest, stored_traces
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file
from pmsmtool.measurement.by_injection import nameplate_of
from pmsmtool.measurement.identify import identify
from pmsmtool.proof.simulated import as_tested
from pmsmtool.run_directory import RunDirectory, new_record
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.trace import trace_npz

pytestmark = pytest.mark.chain

UNKNOWN_HALF_WIDTH = 0.22
"""R at T_ref of a winding of 5 to 90 degC: 1 - 1/(1 + 0.00393 * 70) = 0.2157, and 0.0148 of the measurement."""
MEASURED_HALF_WIDTH = 0.016
"""Largest total 95 % half width of R at the temperature of the test: two 1 % gains are 1.42 %; measured 1.48 %."""


@pytest.mark.parametrize(("name", "T_c"), [("fast-ipm", 90.0), ("interior-2k2", 60.0), ("saturated-pmsyrm", 5.0)])
def test_resistance_is_accepted_and_true_at_the_reference(name: str, T_c: float, tmp_path: Path) -> None:
    """60 degC made 4.9 % of R at T_ref, 90 degC 8.4 %: above the fixed 3 % all of them were refused."""
    base = load_machine_file(data_folder("profiles") / f"{name}.toml")
    path = tmp_path / "drive.toml"
    warm = replace(base, simulation={**base.simulation, "T_winding_c": T_c})
    path.write_text(dump_machine_file(warm, embed_flux_map=True), encoding="utf-8")
    run = RunDirectory.create(tmp_path, 1, new_record(["test"], drive={}, bus={}, versions={}, operator="nobody"))
    with Connection(PmsmSimBus(f"{path}?nv=:memory:")) as connection:
        drive = CanopenDrive(connection, 1)
        nameplate = nameplate_of(drive, "bench")
        request = IdentifyRequest(quantities=("R",))
        stage = identify(run, drive, request, lambda lines: None, lambda text: None, known=(nameplate, "bench"))
        drive.close()
    assert stage.status == "pass", stage.acceptance
    values = {value["name"]: value for value in stage.values}
    at_reference, measured = values["R_s_ohm"], values["R_s_ohm_measured"]
    assert abs(at_reference["value"] - true_loop_resistance(warm)) < at_reference["total_95"]
    assert measured["total_95"] < MEASURED_HALF_WIDTH * measured["value"]
    assert measured["T_c"] == pytest.approx(T_c, abs=3.0)
    assert (measured["value"] > at_reference["value"]) is (T_c > 20.0)
    written = load_machine_file(run.path / MACHINE)
    assert written.estimates["R_s_ohm_measured"].value == measured["value"]
    assert written.machine.R_s_ohm == at_reference["value"]

    # a machine file's own coefficients are used, and kept
    nameplate = load_machine_file(run.path / NAMEPLATE)
    own = replace(nameplate.machine, alpha_R_per_k=0.0030, alpha_psi_per_k=-0.002)
    (run.path / NAMEPLATE).write_text(dump_machine_file(replace(nameplate, machine=own)), encoding="utf-8")
    again = {value["name"]: value["value"] for value in replay(run).values}
    assert again["R_s_ohm"] == pytest.approx(measured["value"] / (1.0 + 0.0030 * (measured["T_c"] - 20.0)), rel=1e-3)
    kept = load_machine_file(run.path / MACHINE).machine
    assert (kept.alpha_R_per_k, kept.alpha_psi_per_k) == (0.0030, -0.002)


@pytest.mark.parametrize("T_c", [5.0, 90.0])
def test_without_a_sensor_the_interval_reaches_to_the_reference(T_c: float, tmp_path: Path) -> None:
    """R at T_ref was the R of the test, +-1.4 %: at 90 degC 27 % off. It is accepted by what loops meet, R of the test.

    Measured total half widths of interior-2k2, with a sensor at 5, 42, 60, 90 degC: 2.4, 3.1, 5.0, 8.3 % of R at T_ref;
    without 1.4 % before, 21.6 % now, and 1.4 % at the temperature of the test.
    """
    base = load_machine_file(data_folder("profiles") / "interior-2k2.toml")
    path = tmp_path / "drive.toml"
    warm = replace(base, std={}, simulation={**base.simulation, "T_winding_c": T_c})
    path.write_text(dump_machine_file(warm), encoding="utf-8")
    run = RunDirectory.create(tmp_path, 1, new_record(["test"], drive={}, bus={}, versions={}, operator="nobody"))
    with Connection(PmsmSimBus(f"{path}?nv=:memory:")) as connection:
        drive = CanopenDrive(connection, 1)
        request = IdentifyRequest(quantities=("R",))
        identify(run, drive, request, lambda lines: None, lambda text: None)
        drive.close()
    for name, trace in stored_traces(run).items():
        if "T_winding_c" in trace.signals:
            blind = {**trace.signals, "T_winding_c": np.full(len(trace), np.nan)}
            run.save(f"traces/{name}.npz", trace_npz(replace(trace, signals=blind)))
    stage = replay(run)
    assert stage.status == "pass" and stage.acceptance[0].measured.startswith("1.4")
    values = {value["name"]: value for value in stage.values}
    R, measured = values["R_s_ohm"], values["R_s_ohm_measured"]
    assert abs(R["value"] - true_loop_resistance(warm)) < R["total_95"] < UNKNOWN_HALF_WIDTH * R["value"]
    assert R["value"] == measured["value"] and measured["total_95"] < MEASURED_HALF_WIDTH * R["value"]

    # a right data sheet is no contradiction; the temperatures that it allows do not count twice
    rows = {row.name: row for row in compare(warm, {}, stage.values)}
    assert rows["R_s_ohm"].verdict == "agrees" and rows["R_s_ohm"].interval == measured["total_95"]
    # a proof is predicted with the resistance of the test, and its interval
    machine = load_machine_file(run.path / MACHINE)
    assert machine.systematic["R_s_ohm"] > 0.2 * R["value"]
    assert as_tested(machine).systematic["R_s_ohm"] == measured["systematic"]
