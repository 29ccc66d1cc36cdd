# SPDX-License-Identifier: MIT
"""``pmsmtool prove``: the machine itself shows whether it does what the design promises."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.drive_access import map_option, new_run, open_drive, read_map, runs_option
from pmsmtool.cli.options import (
    ANY_PATH,
    BusOptions,
    MotionOptions,
    bus_options,
    examples,
    motion_options,
    output_options,
    overspeed_option,
)
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import ConfigError, SafetyRefusal

if TYPE_CHECKING:
    from pmsmtool.run_directory import RunDirectory, Stage


@click.command(
    "prove",
    epilog=examples(
        "pmsmtool prove --sim interior-2k2 runs/20260101T120000Z-000055f1 --yes",
        "pmsmtool prove -i socketcan -c can0 -n 5 design.toml --i-max 12Apk --speed-max 3000rpm --shaft free",
    ),
)
@click.argument("design", type=ANY_PATH)
@runs_option
@click.option("--machines", type=click.IntRange(32, 2000), default=96, help="Machines drawn for the prediction.")
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of the draw.")
@overspeed_option
@map_option
@bus_options
@motion_options
@output_options
def prove_command(
    bus: BusOptions,
    motion: MotionOptions,
    out: Output,
    design: Path,
    runs: Path,
    machines: int,
    seed: int,
    overspeed_protection: str | None,
    map_file: Path | None,
) -> None:
    """Predict the response of a flashed DESIGN, run it on the machine, compare; exit code 1 outside the 95 % band.

    DESIGN is design.toml or a run directory; the proof of a run is kept in that run. The drive must hold the values of
    the design, and the shaft must carry the same load as in the design. Nothing is stored in the drive.

    The band follows from the intervals of the machine in the design. It is printed with its SHA-256 before the first
    step. The steps: speed, current in two sizes and both signs, a governed unreachable reference, entry into field
    weakening, a move of the position loop with the speed fed forward and one without. Above the speed of uncontrolled
    generation they go only where a fault shorts the windings, or a brake chopper is stated.
    """
    from pmsmtool.cli.consent import ask_motion, keep
    from pmsmtool.commissioning.commission import write_report
    from pmsmtool.design.design_file import design_text, load_design
    from pmsmtool.proof.stage import ProofRequest, not_proven, prove_stage
    from pmsmtool.run_directory import RunDirectory

    path = design / "design.toml" if design.is_dir() else design
    made = load_design(path)
    if overspeed_protection == "short-circuit" and not made["protection.n_short_circuit_rpm"]:
        raise ConfigError(
            "--overspeed-protection short-circuit: a fault of this design removes the gates",
            where=str(path),
            hint="pmsmtool tune --overspeed-protection short-circuit, flash that design, then prove it",
        )
    if overspeed_protection is not None:
        made = replace(made, request={**made.request, "overspeed_protection": overspeed_protection})
    asked = ProofRequest(
        motion.i_max_apk, motion.speed_max_rad_s, motion.shaft or "free", motion.load, motion.brake, machines, seed
    )
    with open_drive(bus, read_map(map_file)) as drive:

        def allow(lines: Any) -> None:
            serial = drive.identity.serial
            keep(run, ask_motion(lines, motion, simulated=bus.simulated(), serial=serial, out=out))

        if design.is_dir():
            run = RunDirectory(design)
            _same_drive(run, drive.identity.serial)
        else:
            run = new_run(bus, drive, runs)
            run.save("design.toml", design_text(made))
        stage = _proven(
            run, out, lambda say: prove_stage(run, drive, made, asked, allow, say), fresh=not design.is_dir()
        )
    out.status("writing the report ...")
    write_report(run)
    _show(run, stage, out)
    if stage.status != "pass":
        raise not_proven(stage, run)


def _same_drive(run: RunDirectory, serial: int) -> None:
    expected = run.read().drive.get("serial")
    if expected != serial:
        raise SafetyRefusal(
            f"the run is of the drive with serial number {expected}, {serial} answers",
            where=str(run.path),
            hint="give the design.toml itself when this drive is to be proven; nothing was moved",
        )


def _proven(run: RunDirectory, out: Output, prove: Callable[[Callable[[str], None]], Stage], *, fresh: bool) -> Stage:
    """Carry the proof out and record it; a run that was made for it and saw no prediction leaves no trace."""
    import shutil

    from pmsmtool.measurement.run_account import accounted
    from pmsmtool.proof.stage import FOLDER as PROOFS

    try:
        with accounted(run, "prove", out.note) as say:
            stage = prove(say)
            run.add(stage)
    except BaseException:
        if fresh and not (run.path / PROOFS).exists():
            shutil.rmtree(run.path, ignore_errors=True)
        raise
    return stage


def _show(run: RunDirectory, stage: Stage, out: Output) -> None:

    from pmsmtool.report.verdict import is_simulated, on_which_drive

    facts = {str(value["name"]): value["value"] for value in stage.values if "where" not in value}
    data = {
        "run": run.path,
        "verdict": "PASS" if stage.status == "pass" else "FAIL",
        "simulated": is_simulated(asdict(run.read())),
        "prediction": facts["prediction"],
        "cause": facts["cause"],
        "event": facts["event"],
        "left_out": stage.fallbacks,
        "seen": [
            {"what": value["name"], "share_of_band": value["value"], "inside": value["value"] <= 1.0}
            for value in stage.values
            if "where" in value
        ],
    }
    rows = [("inside" if line.ok else "OUTSIDE", line.what, line.measured) for line in stage.acceptance]
    out.result("prove", data, lambda: table(("", "response", "measured"), rows))
    for line in stage.fallbacks:
        out.warn(line)
    text = f"{data['verdict']}: {stage.summary if stage.status == 'pass' else stage.note}"
    out.note(on_which_drive(text, asdict(run.read())))
    out.note(f"report: {run.path / 'report.html'}")
