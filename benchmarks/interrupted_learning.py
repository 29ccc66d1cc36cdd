# SPDX-License-Identifier: MIT
"""Interrupt `map learn` at drawn moments, in six ways, and look at the gains, at the speed and at what was said.

    python -m benchmarks.interrupted_learning TABLE.csv [--drives 8] [--first 0] [--moments 8] [--processes 2]

Drives and gains are those of ``learned_gains.py``, moments and ways those of ``interrupted_commands.py``; besides,
*error* is one that nobody expects. Half of the moments lie at, before or after a frame by which the tool writes an
object, half anywhere. The answer of every fit is the truth, for what is asked here is not accuracy.

A drive's second run is copied at each of its moments (``os.fork``: drive, tool and clock are one process without
threads). The copy is interrupted and looked at, and its files are taken back; the run goes on. So a moment costs what
follows it, and not what was before.

Wanted: the drive off, no speed beyond the limit, and the drive's own gains: at once where tool and bus live, else after
the next command, which says so. Exit code 130 after Ctrl-C, 8 where the adapter went while the drive was energised;
where a gain was changed then, it is said how it comes back.

A line per run that breaks this, and a summary; exit 1 when there is one.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import pickle
import random
import shutil
import signal
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can

from benchmarks.commissioning import commanded, powered, prepared
from benchmarks.interrupted_commands import KILLED, MEMORY_WAIT_S, OWN_STOP_S, TO_DO, Watch
from benchmarks.learned_gains import FAMILIES, machine_at, stated
from benchmarks.random_drives import draw_drive
from pmsmtool.drive.drive_node import is_safe
from pmsmtool.flash.gain_journal import any_left
from pmsmtool.identification.speed_loop_response import SpeedLoop
from pmsmtool.machine.machine_file import dump_machine_file
from pmsmtool.measurement import learn_current_gains, learn_gains, learn_position_gain
from pmsmtool.measurement.changed_gains import BACK, GAIN, INTEGRAL
from pmsmtool.measurement.learn_current_gains import CURRENT_GAIN
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.foreign.drawn_gains import ACCELERATION_OBJECT
from pmsmtool.sim.simulated_machine import settings_of
from pmsmtool.units import rad_s_from_rpm, rpm_from_rad_s

LEARN_WAYS = ("kill", "adapter", "freeze", "ctrl-c", "error", "power")
SHORT = {
    (learn_gains, "LEAST_S"): 0.6, (learn_position_gain, "WAY_RAD"): 9.0, (learn_current_gains, "RECORDS"): 1,
}  # fmt: skip
"""What makes a run shorter."""
LIMIT_SHARE = 0.4
"""Speed limit, of the machine's largest speed."""


@dataclass(frozen=True, slots=True)
class Learning:
    """What an interrupted `map learn` left; ``written`` are the frames by which the tool wrote."""

    frames: int
    written: tuple[int, ...]
    code: int
    verdict: str
    good: bool
    fastest: float


class CopiedWatch(Watch):
    """A watch whose process is copied at given frames; every copy is interrupted there, this process never.

    Parameters
    ----------
    line : PmsmSimBus
        A member of the line that stays.
    due : sequence of (int, str)
        Frame, and what happens there.
    """

    def __init__(self, line: PmsmSimBus, due: Sequence[tuple[int, str]]) -> None:
        super().__init__("none", None, line)
        self.due = list(due)
        self.answer: Path | None = None
        """Where a copy leaves what it found; None: this is no copy."""
        self.found: list[tuple[int, str, Learning]] = []

    def passes(self, frame: can.Message) -> None:
        """Let copies go on from here, each interrupted by this frame."""
        for at, how in [one for one in self.due if one[0] == self.frames + 1]:
            self._copy(at, how)
        super().passes(frame)

    def _copy(self, at: int, how: str) -> None:
        if self.answer is not None:
            return
        outside = Path(tempfile.mkdtemp())  # taken away by hand: a copy leaves no block behind it
        shutil.copytree(Path.cwd(), outside / "kept")
        process = os.fork()
        if not process:
            self.answer, self.how, self.moment = outside / "answer", how, at
            return
        os.waitpid(process, 0)
        for entry in Path.cwd().iterdir():
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
        shutil.copytree(outside / "kept", Path.cwd(), dirs_exist_ok=True)
        self.found.append((at, how, pickle.loads((outside / "answer").read_bytes())))
        shutil.rmtree(outside)

    def leave(self, found: Learning) -> None:
        """End a copy with what it found."""
        if self.answer is not None:
            self.answer.write_bytes(pickle.dumps(found))
            os._exit(0)

    def failed(self, kind: object, error: BaseException | None, trace: object) -> None:
        """End a copy with what it failed by, before the folder of both goes."""
        if error is not None:
            told = "".join(traceback.format_exception(error))
            self.leave(Learning(self.frames, (), 70, f"the benchmark failed: {told[-400:]}", False, 0.0))


def learning(table: str, seed: int, due: Sequence[tuple[int, str]] = ()) -> tuple[Learning, CopiedWatch]:
    """Run `map learn` on a seed's drive, with copies that are interrupted at their frames."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(prepared())
        channel = stack.enter_context(machine_at(seed, table, FAMILIES[seed % len(FAMILIES)]))
        line = stack.enter_context(powered(channel))
        face: Any = line.line.nodes[0].face
        machine = draw_drive(3000 + seed)
        told_machine = stated(machine, seed)
        Path("told.toml").write_text(dump_machine_file(told_machine), encoding="utf-8")
        limit = LIMIT_SHARE * rad_s_from_rpm(told_machine.machine.top_rpm or 1000.0)
        J = settings_of(machine).number("J_kgm2")

        def truth(*arguments: Any, **options: Any) -> SpeedLoop:
            held = face.behind.position_gains
            return SpeedLoop(held.K_p / J, held.K_i / J, 2e-3, 1e-3, 0.02)

        def counts() -> list[bytes]:
            places = [face.gains.gain, face.gains.integral, face.gains.position, face.gains.forward]
            if face.gains.acceleration_ff_s:
                places.append(ACCELERATION_OBJECT)
            if face.gains.current is not None:
                places += [face.gains.current.gain, face.gains.current.integral]
            return [face.behind.dictionary.find(*place).value for place in places if place is not None]

        for (module, name), value in {**SHORT, (learn_gains, "fit_speed_loop"): truth}.items():
            stack.callback(setattr, module, name, getattr(module, name))
            setattr(module, name, value)
        before = counts()
        watch = CopiedWatch(line, due)
        stack.push(watch.failed)
        fastest = 0.0

        def look() -> None:
            nonlocal fastest
            if face.behind is not None:
                fastest = max(fastest, abs(face.behind.power.omega_m()) / limit)

        watch.look = look
        signal.signal(signal.SIGINT, signal.default_int_handler)
        on = ("-i", "pmsmsim", "-c", channel, "--yes")
        places = {GAIN: face.gains.gain, INTEGRAL: face.gains.integral}
        names = [f"{name}=0x{index:04X}:{sub:02X}" for name, (index, sub) in places.items()]
        if face.gains.position is not None:
            names.append("position.K_p_per_s=0x{:04X}:{:02X}".format(*face.gains.position))
        if face.gains.current is not None:
            names.append(CURRENT_GAIN)
        with watch.on():
            limited = ("--speed-max", f"{rpm_from_rad_s(limit):.6g}rpm")
            code, told = commanded("map", "learn", *names, "--machine", "told.toml", *limited, *on)
            watch.over, how = True, watch.how
            alive = how in ("ctrl-c", "error") or (how == "freeze" and not watch.enabled)
            if how == "kill" and watch.happened:
                code, told = KILLED, "nothing"
            line.clock.wait(OWN_STOP_S)
        line.line.nodes[0].power_on()
        line.clock.wait(MEMORY_WAIT_S)
        changed, left = counts() != before, any_left()
        wrong = []
        if changed and alive:
            wrong.append("GAINS CHANGED although the tool lived")
        if changed and not left:
            wrong.append("GAINS CHANGED AND NO JOURNAL")
        if changed and how == "adapter" and BACK not in told:
            wrong.append(f"not said that gains are changed: {told[-400:]!r}")
        if how == "ctrl-c" and watch.happened and code != 130:
            wrong.append(f"exit code {code}: {told[-300:]!r}")
        if how == "adapter" and watch.enabled and not (code == 8 and all(word in told for word in TO_DO)):
            wrong.append(f"energised when the adapter went, exit code {code}: {told[-300:]!r}")
        if code == 70 and how != "error":
            wrong.append(f"a traceback: {told[-300:]!r}")
        next_code, next_told = commanded("info", *on[:-1])
        if counts() != before:
            wrong.append(f"GAINS LEFT CHANGED, then exit code {next_code}: {next_told[-400:]!r}")
        elif changed and "restored" not in next_told:
            wrong.append("restored without a word")
        if any_left():
            wrong.append(f"A JOURNAL LEFT, then exit code {next_code}: {next_told[-400:]!r}")
        if not held_off(line):
            wrong.append("NOT OFF")
        if fastest > 1.0:
            wrong.append(f"OVER-SPEED {fastest:.2f} of the limit")
        verdict = "; ".join(wrong) or ("gains back by the next command" if changed else "gains as before")
        found = Learning(watch.frames, tuple(watch.written_at), code, verdict, not wrong, fastest)
        watch.leave(found)
    return found, watch


def held_off(line: PmsmSimBus) -> bool:
    """Whether the drive is off."""
    face: Any = line.line.nodes[0].face
    return is_safe(face.behind.power.state)


def learn_one(job: tuple[str, int, int]) -> list[tuple[str, int, str, Learning]]:
    """Interrupt the run of one seed at drawn moments; the first is the whole run."""
    table, seed, moments = job
    family = FAMILIES[seed % len(FAMILIES)]
    whole, _ = learning(table, seed)
    chance = random.Random(f"interrupt {seed}")
    due = []
    for number in range(moments):
        at = chance.choice(whole.written) + chance.choice((-1, 0, 1)) if number % 2 else chance.randint(1, whole.frames)
        due.append((at, chance.choice(LEARN_WAYS)))
    _, watch = learning(table, seed, due)
    return [(family, 0, "whole run", whole), *((family, *found) for found in watch.found)]


def interrupt(options: argparse.Namespace) -> int:
    """Print what interrupted runs of `map learn` left; return how many went wrong."""
    jobs = [(options.table, seed, options.moments) for seed in range(options.first, options.first + options.drives)]
    outcomes: Counter[tuple[str, int, str]] = Counter()
    wrong, fastest = 0, 0.0
    with multiprocessing.Pool(options.processes, maxtasksperchild=1) as pool:
        for job, runs in zip(jobs, pool.imap(learn_one, jobs, chunksize=1), strict=True):
            for family, moment, how, run in runs:
                fastest = max(fastest, run.fastest)
                wrong += not run.good
                outcomes[how, run.code, run.verdict if run.good else "WRONG"] += 1
                if not run.good or not moment:
                    print(f"  {job[1]} {family}, {how} at {moment}: exit {run.code}, {run.verdict}", flush=True)
    for (how, code, verdict), times in sorted(outcomes.items()):
        print(f"{how}, exit {code}, {verdict}: {times}")
    print(f"{sum(outcomes.values())} runs, largest speed {fastest:.2f} of the limit")
    return wrong


def main() -> int:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("table", type=lambda text: str(Path(text).resolve()))
    parser.add_argument("--drives", type=int, default=8)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--moments", type=int, default=8)
    parser.add_argument("--processes", type=int, default=2)
    wrong = interrupt(parser.parse_args())
    print(f"{wrong} runs went wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
