# SPDX-License-Identifier: MIT
"""Commission random drives with wrong and with right motor files, and count what passes, what is written, what is said.

    python -m benchmarks.motor_files --drives 24 --first 91000
    python -m benchmarks.motor_files --drives 200 --first 91000 --levels full recorder standard

Drive, file and error follow from the seed. Every file states values a catalogue may state: R, psi and J within 10 %,
L within 30 % of the truth, no deviations; winding and magnets have 5 to 90 degC. A wrong file has one error more. The
real chain runs over frames (``Commissioning``); it ends where it ends by itself. ``written`` counts drives whose
parameters are others afterwards; ``not checked`` those whose headline names the wrong quantity so and is no plain PASS.
``refused``: an identification that gives no number (exit code 6): nothing is written, but the file is not named.
``--to-the-end`` lets right files run the whole chain; without it they end behind the gate, where false alarms are.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import multiprocessing
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.commissioning import prepared
from benchmarks.random_drives import data_sheet, draw_drive
from pmsmtool.bus.connect import Connection
from pmsmtool.commissioning.commission import Commissioning, Silent
from pmsmtool.commissioning.report_page import verdict
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.errors import Declined, PmsmtoolError, exit_code_of
from pmsmtool.identification.request import IdentifyRequest
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.measurement.capabilities import examine
from pmsmtool.measurement.identify import open_for_level
from pmsmtool.measurement.run_account import begin_run
from pmsmtool.proof.stage import ProofRequest
from pmsmtool.report.comparison import unchecked
from pmsmtool.run_directory import RunDirectory, Stage
from pmsmtool.sim.bus import PmsmSimBus

LEVELS = {"full": "", "inject": "&level=inject", "recorder": "&level=recorder", "standard": "&drive=cia402"}
ERRORS: dict[str, tuple[tuple[str, ...], float]] = {
    "pole pairs x2": (("pole_pairs",), 2.0),
    "pole pairs /2": (("pole_pairs",), 0.5),
    "pole pairs +1": (("pole_pairs",), 0.0),
    "R x2": (("R_s_ohm", "R_winding_ohm"), 2.0),
    "R /2": (("R_s_ohm", "R_winding_ohm"), 0.5),
    "psi x1.65": (("psi_f_wb",), 1.65),
    "psi /1.73": (("psi_f_wb",), 1.0 / math.sqrt(3.0)),
    "L x2": (("L_d_h", "L_q_h"), 2.0),
    "L /2": (("L_d_h", "L_q_h"), 0.5),
    "J x5": (("J_kgm2",), 5.0),
    "J /5": (("J_kgm2",), 0.2),
    "encoder x4": (("bits",), 2.0),
    "encoder /4": (("bits",), -2.0),
}
"""Keys that are wrong, and by which factor; pole pairs by one where it is 0, bits by a sum."""
RIGHT = "right"


@dataclass(frozen=True, slots=True)
class Outcome:
    """How one chain ended."""

    error: str
    level: str
    seed: int
    code: int
    word: str
    written: bool
    not_checked: bool
    contradicted: tuple[str, ...]
    text: str


def drive_of(seed: int) -> MachineFile:
    """Return a drive of the population."""
    return draw_drive(seed, ("ideal", "timing", "gains")[seed % 3])


def wrong_file(file: MachineFile, error: str) -> MachineFile:
    """Return a file with one error."""
    keys, factor = ERRORS[error]
    machine = file.machine
    if keys == ("bits",):
        return replace(file, encoder=replace(file.encoder, bits=(file.encoder.bits or 17) + round(factor)))
    if keys == ("pole_pairs",):
        p = machine.pole_pairs
        wrong = p + 1 if not factor or (p == 1 and factor < 1.0) else max(1, round(p * factor + 1e-9))
        return replace(file, machine=replace(machine, pole_pairs=p + 1 if wrong == p else wrong))
    return replace(file, machine=replace(machine, **{key: getattr(machine, key) * factor for key in keys}))


class Agrees:
    """A person who agrees; to writing only where the chain is to run to its end."""

    def __init__(self, *, writes: bool) -> None:
        self.writes = writes

    def allow_motion(self, lines: Sequence[str]) -> None:
        """Agree."""

    def allow_writing(self, lines: Sequence[str]) -> None:
        """Agree, or end the chain."""
        if not self.writes:
            raise Declined("far enough")


class BehindTheGate(Silent):
    """Ends the chain once identification has passed, where nobody wants the rest."""

    def __init__(self, *, ends: bool) -> None:
        self.ends = ends

    def begin(self, name: str, number: int, count: int) -> None:
        """End the chain behind the gate."""
        if self.ends and name != "identify":
            raise Declined("far enough")


def commission_one(job: tuple[str, str, int, bool]) -> Outcome:
    """Commission one drive with one file."""
    error, level, seed, to_the_end = job
    drive_file = drive_of(seed)
    file = data_sheet(drive_file, seed)
    if error != RIGHT:
        file = wrong_file(file, error)
    with prepared():
        Path("drive.toml").write_text(dump_machine_file(drive_file))
        with Connection(PmsmSimBus(f"drive.toml?nv=:memory:{LEVELS[level]}")) as connection:
            node = DriveNode(connection, 1)
            found = examine(node)
            node.close()
            drive = open_for_level(connection, 1, found)
            before = _contents(drive)
            run = begin_run(drive, Path("runs"), level=found.level)
            ends = error == RIGHT and not to_the_end
            chain = Commissioning(
                run, drive, Agrees(writes=True), BehindTheGate(ends=ends), file,
                identify=IdentifyRequest(map_if_saturated=True, resonance=True),  # as the command asks
                prove=ProofRequest(runs=32), capabilities=found,
            )  # fmt: skip
            code, text = 0, ""
            try:
                chain.carry_out()
            except PmsmtoolError as ended:
                code, text = int(exit_code_of(ended)), str(ended)
            if ends and code == int(Declined.exit_code):
                code, text = 0, ""
            written = _contents(drive) != before
            drive.close()
            return _outcome(job, run, code, text, written=written)


def _outcome(job: tuple[str, str, int, bool], run: RunDirectory, code: int, text: str, *, written: bool) -> Outcome:
    error, level, seed, _ = job
    stage = run.read().stage("identify") or Stage("identify", "refused", 0.0)
    found = verdict(run.path)
    lines = " ".join(found.lines)
    keys = ERRORS[error][0] if error != RIGHT else ()
    open_ = {{"encoder_counts": "bits"}.get(name, name) for name in unchecked(stage.comparison)}
    said = bool(keys) and set(keys) - {"R_winding_ohm"} <= open_ and "NOT CHECKED" in lines and found.word != "PASS"
    contradicted = tuple(str(row["name"]) for row in stage.comparison if row["verdict"] == "contradicts")
    return Outcome(error, level, seed, code, found.word, written, said, contradicted, text)


def _contents(drive: CanopenDrive) -> dict[str, bytes]:
    names = list(drive.node.map.cells)
    with contextlib.suppress(PmsmtoolError):
        return drive.parameters.read(names)
    return {}


def summary(outcomes: Sequence[Outcome]) -> list[str]:
    """Return one row per error and level."""
    lines = [
        f"{'file':14} {'level':9} {'drives':>6} {'contradicted':>12} {'refused':>8} {'other':>6} {'PASS':>5} "
        f"{'written':>8} {'not checked':>12}"
    ]
    for error, level in dict.fromkeys((o.error, o.level) for o in outcomes):
        rows = [o for o in outcomes if (o.error, o.level) == (error, level)]
        count: Counter[str] = Counter()
        for o in rows:
            ended = (
                "contradicted"
                if o.contradicted
                else "refused"
                if o.code == 6
                else "other"
                if o.code not in (0, 10)
                else "passed"
            )
            count[ended] += 1
            count["PASS"] += o.word == "PASS" and not o.code
            count["written"] += o.written
            count["not checked"] += o.not_checked and not o.contradicted
        lines.append(
            f"{error:14} {level:9} {len(rows):6d} {count['contradicted']:12d} {count['refused']:8d} "
            f"{count['other']:6d} {count['PASS']:5d} {count['written']:8d} {count['not checked']:12d}"
        )
    right = [o for o in outcomes if o.error == RIGHT]
    alarms = [o for o in right if o.contradicted]
    wrong = [o for o in outcomes if o.error != RIGHT]
    silent = [o for o in wrong if not o.contradicted and not o.not_checked and o.code not in (6,)]
    lines.append(f"false alarms: {len(alarms)} of {len(right)} right files")
    lines.append(f"wrong files neither refused, contradicted nor NOT CHECKED: {len(silent)} of {len(wrong)}")
    lines += [
        f"  {o.error}, {o.level}, seed {o.seed}: exit {o.code}, {o.word}; {o.text[:300]}" for o in [*alarms, *silent]
    ]
    return lines


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drives", type=int, default=24, help="wrong files, and as many right ones, per level")
    parser.add_argument("--first", type=int, default=91000)
    parser.add_argument("--levels", nargs="+", choices=list(LEVELS), default=["full", "recorder", "standard"])
    parser.add_argument("--errors", nargs="+", default=list(ERRORS), help="which of the errors, by their names")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--to-the-end", action="store_true")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.drives)
    jobs = [
        (error, level, seed, options.to_the_end)
        for level in options.levels
        for k, seed in enumerate(seeds)
        for error in (options.errors[k % len(options.errors)], RIGHT)
    ]
    outcomes = []
    with multiprocessing.Pool(options.processes, maxtasksperchild=8) as pool:
        for outcome in pool.imap(commission_one, jobs, chunksize=1):
            outcomes.append(outcome)
            told = outcome.text.replace("\n", " ")[:200]
            print(
                f"{outcome.error:14} {outcome.level:9} {outcome.seed} exit {outcome.code} {outcome.word}: "
                f"{', '.join(outcome.contradicted) or '-'}{' NOT CHECKED' if outcome.not_checked else ''} {told}",
                flush=True,
            )
    order = sorted(outcomes, key=lambda o: (o.error == RIGHT, o.error, o.level))
    print("\n".join(summary(order)))


if __name__ == "__main__":
    main()
