# SPDX-License-Identifier: MIT
"""``prove`` on a machine that saturates: its flux map is drawn within the intervals, and it is led back gently."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from benchmarks.prove_verdicts import Shared, flash, spoiled
from pmsmtool.bus.connect import connect
from pmsmtool.commissioning.commission import begin_run
from pmsmtool.design.design_file import Design
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.guard import GuardedDrive
from pmsmtool.files import data_folder
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.proof import stage as stages
from pmsmtool.proof.conditions import Conditions
from pmsmtool.proof.plan import ProofPlan, plan_proof
from pmsmtool.proof.simulated import SimulatedDrives
from pmsmtool.proof.stage import ProofRequest, prove_stage
from pmsmtool.run_directory import Stage

pytestmark = pytest.mark.chain

FEW = ProofRequest(runs=16, experiments=("speed_step", "q_steps", "d_steps", "weakening"))
"""Those in which saturation shows; every one is run in ``test_prove.py``."""
SHARE = 0.02
"""Standard deviation of the declared values, relative."""
AT_REST = Conditions(540.0, 25.0, 25.0, 1 << 17, 20.0, 4500.0 * math.pi / 30.0)
SHARED = Shared()
"""One prediction serves every proof of the design."""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(stages, "predict_proof", SHARED.predict)
    monkeypatch.setattr("can.util.VALID_INTERFACES", frozenset({*can.VALID_INTERFACES, "pmsmsim"}))
    monkeypatch.setitem(can.interfaces.BACKENDS, "pmsmsim", ("pmsmtool.sim.bus", "PmsmSimBus"))


@cache
def profile() -> MachineFile:
    return load_machine_file(data_folder("profiles") / "saturated-pmsyrm.toml")


def declared(share: float) -> MachineFile:
    base = profile()
    names = ("R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb", "J_kgm2")
    std = {name: share * getattr(base.machine, name) for name in names}
    inverter = replace(base.inverter, V_dead_v=13.76, i_knee_apk=0.3)
    return replace(base, inverter=inverter, std={**std, "offset_rad": 2e-3}, systematic={})


@cache
def design() -> Design:
    return tune(declared(SHARE), TuneRequest(field_weakening="lookup"))


def scaled(L_d: float, L_q: float, psi_f: float) -> MachineFile:
    """The profile's machine with other inductances, saturation included, and another magnet."""
    base = profile()
    machine, known = base.machine, base.flux_map
    assert known is not None
    psi = machine.psi_f_wb
    psi_d = psi_f * psi + L_d * (known.psi_d_wb - psi)
    other = replace(machine, flux_map=None, psi_f_wb=psi_f * psi)
    return replace(base, machine=other, flux_map=FluxMap(known.i_d_a, known.i_q_a, psi_d, L_q * known.psi_q_wb))


@contextmanager
def flashed(truth: MachineFile) -> Iterator[CanopenDrive]:
    Path("drive.toml").write_text(dump_machine_file(truth, embed_flux_map=True))
    with connect("pmsmsim", "drive.toml?nv=:memory:") as connection:
        drive = CanopenDrive(connection, 1)
        flash(drive, design(), Path("journals"))
        yield drive
        drive.close()


def proven(truth: MachineFile, kind: str = "", names: tuple[str, ...] = ()) -> Stage:
    with spoiled(kind), flashed(truth) as drive:
        run = begin_run(drive, Path("runs"))
        return prove_stage(
            run,
            drive,
            design(),
            replace(FEW, experiments=names or FEW.experiments),
            lambda lines: None,
            lambda line: None,
        )


def drawn(share: float, runs: int = 12) -> tuple[SimulatedDrives, ProofPlan]:
    made = replace(design(), machine=declared(share))
    plan = plan_proof(made, AT_REST)
    return SimulatedDrives(made, AT_REST, plan, runs, 0), plan


def slopes(share: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """How far i_d comes in the first rows of its first step, on every drawn machine: a matter of L_d alone."""
    drives, plan = drawn(share)
    steps = next(e for e in plan.experiments if e.name == "d_steps")
    found = drives.respond(steps)[:, 0, :]
    return np.asarray(found[:, 4] - found[:, 0])


def test_the_drawn_machines_saturate_each_in_its_own_way() -> None:
    ratio = slopes(0.1) / slopes(1e-9)  # of pairs that differ in nothing but the machine's values
    assert 0.05 < np.std(ratio) < 0.15, "measured 0.097; with one map for all 0.0006"


def test_a_fault_of_the_inductance_reaches_a_machine_with_a_map() -> None:
    from pmsmtool.proof.defects import DEFECTS

    drives, plan = drawn(1e-9, 2)
    steps = next(e for e in plan.experiments if e.name == "d_steps")
    healthy, saturated = (drives.respond(steps, defect)[:, 0, 4].mean() for defect in (None, DEFECTS["inductance"]))
    assert saturated > 1.15 * healthy, "less inductance, more current at once; measured 1.46"


@pytest.mark.parametrize("factors", [(1.03, 0.97, 1.02), (0.965, 0.965, 0.97)])
def test_a_healthy_machine_within_its_intervals_passes(factors: tuple[float, float, float]) -> None:
    stage = proven(scaled(*factors))
    assert stage.status == "pass", stage.note
    assert [name.rsplit("/", 1)[1] for name in stage.files][1:] == [
        "speed_step.npz", "q_steps.npz", "d_steps.npz", "weakening.npz",
    ]  # fmt: skip


@pytest.mark.parametrize(("kind", "cause"), [("gain_low", "gain of the current loops is lower")])
def test_a_spoiled_machine_fails(kind: str, cause: str) -> None:
    stage = proven(profile(), kind)
    assert stage.status == "fail" and cause in stage.note


def test_the_speed_comes_back_by_the_levels_it_came(monkeypatch: pytest.MonkeyPatch) -> None:
    """The profile itself passes. In one step from weakening its drive trips: 0x2310, full torque while i_d gives way
    to i_q.
    """
    asked: list[float] = []
    seen: list[tuple[float, float]] = []
    command, watch = GuardedDrive.command_speed, GuardedDrive._watch

    def noted(self: GuardedDrive, omega_m_rad_s: float) -> None:
        asked.append(omega_m_rad_s)
        command(self, omega_m_rad_s)

    def watched(self: GuardedDrive) -> None:
        watch(self)
        seen.append((self._node.connection.clock.now(), self.live("omega_e_rad_s")))

    monkeypatch.setattr(GuardedDrive, "command_speed", noted)
    monkeypatch.setattr(GuardedDrive, "_watch", watched)
    stage = proven(profile(), names=("weakening",))
    assert stage.status == "pass", stage.note
    plan = plan_proof(design(), AT_REST)
    weakening = next(e for e in plan.experiments if e.name == "weakening")
    levels = weakening.excitation.buffer
    assert levels[-1] == 0.0
    top = levels.index(max(levels))
    rise = max(b - a for a, b in pairwise(levels[: top + 1]))
    assert max(a - b for a, b in pairwise(levels)) <= rise * (1.0 + 1e-9), "no fall is larger than a rise"
    last = [omega for omega in asked if omega <= weakening.base_rad_s][-64:]
    assert last[-1] == 0.0 and last[0] > 0.9 * weakening.base_rad_s
    assert max(a - b for a, b in pairwise(last)) <= 1.1 * weakening.base_rad_s / 64, "and so does the rest of it"
    full = design()["speed.acceleration_rpm_per_s"] * math.pi / 30.0 * profile().machine.pole_pairs
    falls = [(a - b) / (t1 - t0) for (t0, a), (t1, b) in pairwise(seen) if t1 - t0 > 0.02 and a > 100.0]
    assert max(falls) < 0.5 * full, "of the design's slope; measured 0.27"
