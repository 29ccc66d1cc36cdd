# SPDX-License-Identifier: MIT
"""How often `prove` passes healthy drives and catches spoiled ones, over random simulated drives on CANopen frames.

    python -m benchmarks.prove_verdicts --drives 300
    python -m benchmarks.prove_verdicts --drives 40 --first 5000 --kinds gain_low gain_high
    python -m benchmarks.prove_verdicts --drives 300 --declared
    python -m benchmarks.prove_verdicts --drives 200 --first 205000 --real

Drives follow from their seeds (``random_drives.py``, switched inverter). Each is identified first, over the
bus as the tool does it; a drive that is refused there is counted apart. With ``--declared`` identification is skipped:
the tool is given the true parameters off by draws from the intervals that it declares (:data:`DECLARED`). Then it
designs, flashes over the bus, and proves. With ``--real`` the drives have effects of real machines
(``real_population.py``). Every drive is proven healthy, and once more with one defect that its objects
do not show (the kinds in turn): K_p 20 % up or down, one more period of delay, decoupling of the wrong sign, one pole
pair more or less. A spoiled drive is caught when the proof fails, however it fails.

``tables/prove_verdicts.txt`` holds what was measured, and of which seeds the allowances are.
"""

from __future__ import annotations

import argparse
import datetime
import math
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.random_drives import draw_drive
from benchmarks.real_population import draw_real
from benchmarks.whole_commission import BLOCKS
from pmsmtool.bus.connect import connect
from pmsmtool.design.design_file import Design
from pmsmtool.design.prediction import Prediction
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.errors import DesignInfeasible, PmsmtoolError
from pmsmtool.flash.download import Download
from pmsmtool.flash.journal import JournalFolder
from pmsmtool.flash.restore import marks_of, plan_download
from pmsmtool.identification.request import IdentifyRequest
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.measurement.by_injection import nameplate_of
from pmsmtool.measurement.identify import identify
from pmsmtool.measurement.run_account import begin_run
from pmsmtool.proof import stage as proving
from pmsmtool.proof.simulated import predict_proof
from pmsmtool.run_directory import RunDirectory, Stage, new_record
from pmsmtool.sim.drive_kernel import KernelCore
from pmsmtool.sim.kernel import Params
from pmsmtool.sim.simulated_machine import settings_of

DECLARED: dict[str, tuple[float, float]] = {
    "R_s_ohm": (0.005, 0.016),
    "L_d_h": (0.003, 0.014),
    "L_q_h": (0.003, 0.014),
    "psi_f_wb": (0.001, 0.011),
    "J_kgm2": (0.01, 0.014),
}
"""Relative standard deviation and systematic half width, as the README's first session prints them for 1 % sensors."""
OFFSET_STD_RAD = math.radians(0.1)

Change = Callable[[Params], None]


def _gain(factor: float) -> Change:
    def change(params: Params) -> None:
        params.current_K_p_d_v_per_a *= factor
        params.current_K_p_q_v_per_a *= factor

    return change


def _decoupling(params: Params) -> None:
    params.motor_L_d_app_h *= -1.0
    params.motor_L_q_app_h *= -1.0


def _pole_pairs(step: int) -> Change:
    def change(params: Params) -> None:
        params.motor_pole_pairs = max(1, params.motor_pole_pairs + step)

    return change


def _nothing(params: Params) -> None:
    return


KINDS: dict[str, Change] = {
    "gain_low": _gain(0.8),
    "delay": _nothing,
    "gain_high": _gain(1.2),
    "decoupling": _decoupling,
    "pole_pairs_high": _pole_pairs(1),
    "pole_pairs_low": _pole_pairs(-1),
}
"""Defects by name; the one of the delay is in the simulated inverter, not in the parameters."""


def declared(drive: MachineFile) -> MachineFile:
    """Return what identification would say of a drive: the truth, off by a draw from its own intervals."""
    true, settings = drive.machine, settings_of(drive)
    rng = np.random.default_rng([20261121, int(settings.number("seed"))])
    values: dict[str, Any] = {}
    for name, (std, systematic) in DECLARED.items():
        off = std * float(rng.standard_normal()) + systematic * float(rng.uniform(-1.0, 1.0))
        values[name] = (1.0 + off) * float(getattr(true, name))
    step = 2.0 * settings.number("adc_full_scale_apk") / 2**12
    noise = math.sqrt(2.0 / 3.0) * math.hypot(settings.number("sensor_noise_apk"), step / math.sqrt(12.0))
    dead, U_dc, T_s = drive.inverter.dead_time_s, drive.inverter.U_dc_v, drive.inverter.T_s
    plateau = U_dc * dead / T_s
    if settings.number("device_drop_v") > 0.0:  # of a MOSFET bridge the diodes conduct in the dead time only
        plateau += 0.5 * (settings.number("device_drop_v") + settings.number("diode_drop_v"))
    knee = 2.0 * settings.number("output_capacitance_f") * U_dc / dead  # charges a leg's output within the dead time
    offset = settings.number("encoder_offset_rad") + OFFSET_STD_RAD * float(rng.standard_normal())
    return replace(
        drive,
        machine=replace(true, **values, B_nms=None, tau_c_nm=float(rng.uniform(0.7, 1.3)) * (true.tau_c_nm or 0.0)),
        inverter=replace(drive.inverter, V_dead_v=plateau, i_knee_apk=max(knee, 1e-3)),
        encoder=replace(
            drive.encoder,
            offset_rad=math.remainder(offset, 2.0 * math.pi),
            direction=-1 if settings.flag("encoder_reversed") else 1,
        ),
        std={**{n: s * values[n] for n, (s, _) in DECLARED.items()}, "offset_rad": OFFSET_STD_RAD},
        systematic={n: s * values[n] for n, (_, s) in DECLARED.items()},
        conditions={"noise_apk": noise},
        simulation={},
    )


def identified(truth: MachineFile) -> MachineFile:
    """Return what identification says of a simulated drive; raises what it refuses with."""
    with tempfile.TemporaryDirectory() as folder, _powered(truth, Path(folder)) as drive:
        run = begin_run(drive, Path(folder) / "runs")
        known = nameplate_of(drive, truth.name), "bench"
        identify(run, drive, IdentifyRequest(resonance=True), _silent, _silent, known=known)
        return load_machine_file(run.path / "machine.toml")


def _silent(said: object) -> None:
    return


@contextmanager
def _powered(truth: MachineFile, folder: Path) -> Iterator[CanopenDrive]:
    path = folder / "drive.toml"
    path.write_text(dump_machine_file(truth, embed_flux_map=truth.flux_map is not None), encoding="utf-8")
    with connect("pmsmsim", f"{path}?nv=:memory:") as connection:
        drive = CanopenDrive(connection, 1)
        yield drive
        drive.close()


@contextmanager
def spoiled(kind: str, kinds: Mapping[str, Change] = KINDS) -> Iterator[None]:
    """Let every simulated drive run with a defect that its objects do not show."""
    original = KernelCore._parameters_changed

    def changed(self: KernelCore) -> None:
        original(self)
        kinds[kind](self.simulation.params)

    if kind:
        KernelCore._parameters_changed = changed  # type: ignore[method-assign]
    try:
        yield
    finally:
        KernelCore._parameters_changed = original  # type: ignore[method-assign]


def flash(drive: CanopenDrive, design: Design, folder: Path) -> None:
    """Write and store a design."""
    wanted = design.parameter_set()
    plan = plan_download(drive.node, wanted)
    marks = marks_of(wanted.content_hash(), datetime.datetime(2026, 1, 1))
    Download(drive.node, drive.identity, plan, marks, JournalFolder(drive.identity, folder), say=lambda t: None).run()


def prove(truth: MachineFile, design: Design, kind: str, *, log: Callable[[str], None] = lambda text: None) -> Stage:
    """Flash a design on a simulated drive, healthy (empty kind) or spoiled, and prove it."""
    if kind == "delay":
        truth = replace(truth, inverter=replace(truth.inverter, delay_periods=truth.inverter.delay_periods + 1.0))
    with spoiled(kind):
        return proven(truth, design, proving.ProofRequest(), log)


def proven(
    truth: MachineFile, design: Design, asked: proving.ProofRequest, log: Callable[[str], None] = lambda text: None
) -> Stage:
    """Flash a design on a simulated drive, and prove it."""
    with tempfile.TemporaryDirectory() as folder, _powered(truth, Path(folder)) as drive:
        flash(drive, design, Path(folder))
        run = RunDirectory(Path(folder))
        run.write(new_record(["prove_verdicts"], drive={}, bus={}, versions={}))
        return proving.prove_stage(run, drive, design, asked, lambda lines: None, log)


KEPT = 16
"""Predictions that are kept."""


class Shared:
    """The last predictions by design, conditions and plan: a drive is proven twice and more from one.

    The offsets of its current sensors are a drive's own: what differs of them between two proofs is the noise of their
    reading, 4 mA, for which every proof had a prediction of its own.
    """

    def __init__(self) -> None:
        self.known: dict[str, Prediction] = {}

    def predict(self, design: Design, conditions: Any, plan: Any, **asked: Any) -> Prediction:
        """Return the prediction, made once."""
        of_drive = replace(conditions, offsets_apk=())
        key = f"{design.content_hash()} {of_drive} {[e.name for e in plan.experiments]} {asked}"
        found = self.known.pop(key, None) or predict_proof(design, conditions, plan, **asked)
        while len(self.known) >= KEPT:
            del self.known[next(iter(self.known))]
        self.known[key] = found  # the last one used
        return found


def one_drive(
    truth: MachineFile, kinds: tuple[str, ...], known: Callable[[MachineFile], MachineFile] = identified
) -> Iterator[tuple[str, bool, str]]:
    """Yield kind (empty: healthy), verdict and the reason for each proof of a drive; ``known`` says what it is."""
    design = tune(known(truth), TuneRequest(field_weakening="lookup"))
    for kind in ("", *kinds):
        try:
            stage = prove(truth, design, kind)
        except PmsmtoolError as error:
            yield kind, False, f"{type(error).__name__}: {error.what}"
        else:
            worst = max((float(v["value"]) for v in stage.values if "where" in v), default=math.nan)
            yield kind, stage.status == "pass", f"{worst:.2f} {stage.note}"


def main() -> None:
    """Run the drives, print one line for what is wrong and the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--kinds", nargs="*", choices=list(KINDS), help="all of these on every drive; default: in turn")
    parser.add_argument("--declared", action="store_true", help="skip identification: the truth, off by its intervals")
    parser.add_argument("--real", action="store_true", help="with effects of real machines (real_population.py)")
    parser.add_argument("--verbose", action="store_true", help="a line for every proof")
    asked = parser.parse_args()
    if asked.declared and asked.real:
        parser.error("what is declared has a rigid shaft and no iron loss: identify --real drives")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    setattr(proving, "predict_proof", Shared().predict)  # noqa: B010 - replaced on purpose
    refused = 0
    good: Counter[str] = Counter()
    total: Counter[str] = Counter()
    named: Counter[str] = Counter()
    names = list(KINDS)
    known = declared if asked.declared else identified
    for k in range(asked.drives):
        seed = asked.first + k
        try:
            truth = draw_real(seed, BLOCKS[seed % len(BLOCKS)])[0] if asked.real else draw_drive(seed)
            for kind, passed, why in one_drive(truth, tuple(asked.kinds or (names[k % len(names)],)), known):
                right = passed if not kind else not passed
                total[kind or "healthy"] += 1
                good[kind or "healthy"] += right
                named[kind] += "likely" in why
                if asked.verbose or not right:
                    print(f"{seed} {kind or 'healthy'}: {'pass' if passed else 'fail'} {why}", flush=True)
        except DesignInfeasible as error:
            print(f"{seed}: no design, not counted: {error.what}", flush=True)
        except PmsmtoolError as error:
            refused += 1
            print(f"{seed}: refused by identify: {type(error).__name__}: {error.what}", flush=True)
    for kind, count in total.items():
        cause = f", {named[kind]} with a likely cause" if kind != "healthy" else ""
        print(f"{kind}: {good[kind]} of {count} ({100.0 * good[kind] / count:.1f} %){cause}")
    spoiled_kinds = [k for k in total if k != "healthy"]
    caught, spoiled_count = sum(good[k] for k in spoiled_kinds), sum(total[k] for k in spoiled_kinds)
    if refused:
        print(f"refused by identify: {refused} of {asked.drives}")
    print(f"healthy pass: {interval(good['healthy'], total['healthy'])}")
    print(f"spoiled caught: {interval(caught, spoiled_count)}")


def interval(good: int, total: int) -> str:
    """Return a share with its 95 % interval (Clopper and Pearson, DOI 10.1093/biomet/26.4.404)."""
    from scipy.stats import beta

    low = float(beta.ppf(0.025, good, total - good + 1)) if good else 0.0
    high = float(beta.ppf(0.975, good + 1, total - good)) if good < total else 1.0
    return f"{good} of {total} (95 % interval {100.0 * low:.1f} to {100.0 * high:.1f} %)"


if __name__ == "__main__":
    main()
