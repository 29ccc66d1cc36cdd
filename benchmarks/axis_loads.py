# SPDX-License-Identifier: MIT
"""Following error of one move with stored and with designed gains, over random loads behind an elastic shaft.

    python -m benchmarks.axis_loads --loads 40
    python -m benchmarks.axis_loads --loads 10 --drive epos4
    python -m benchmarks.axis_loads --loads 6 --first 944 --drive copley --table TABLE.csv

The reference drive's firmware turns a motor with a load: resonance 50 to 800 Hz, load over motor inertia 0.2 to 20,
damping 0.5 to 5 %, Coulomb friction 0.5 to 3 % of the rated torque, half of the loads with backlash of up to 0.1
degree. The design knows inertia, both frequencies and the damping as `identify` leaves them, off by a draw from their
intervals. The stored gains are those of a maker's tool: crossover 60 rad/s for the whole inertia, not fed forward.
Said are the largest following error of the designed gains over that of the stored ones, without and with ``--stored``,
and the least margins over the tolerance box.

With ``--drive FAMILY`` a simulated drive of that family does the whole job over CAN, by the commands that a person
gives: `backup`, `tune --axis --stored`, and `move --design --flash`, which moves, writes and moves again. Stored are
the gains of its face (crossover 60 rad/s and 15 1/s for the whole inertia, no feed-forward). The move is of 60 degrees
at half of the designed acceleration, at most 300 rad/s2; after `map learn` as the design gives it within the drive's
own limits of current.
Said besides are how long both moves kept the drive, how often a person is asked for consent, the following errors
over the predicted ones, and why a load got no comparison. The ratio is infinite where the designed gains cannot do the
move.

Families whose gains have no published unit are nodes of a ``--table`` (``sim/foreign/file_rows.py``) with gains that a
seed drew for the motor alone (``sim/foreign/drawn_gains.py``). There `map learn` comes first, on the uncoupled motor;
the other commands take the map that it wrote. A Faulhaber has the objects of its position gain besides
(:data:`MORE_OBJECTS`), and a motor of two pole pairs: it commutates no more.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.makers_drives import asked
from pmsmtool.axis.drive import AxisRequest
from pmsmtool.cli import consent
from pmsmtool.commissioning.axis_design import design_axis
from pmsmtool.design.design_file import Design
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive.guard import GuardedDrive
from pmsmtool.drive.port import Excitation, Injection, ProfileMove, Shape
from pmsmtool.drive_maps.drive_map import reference_map
from pmsmtool.errors import DesignInfeasible
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.proof.plan import MOVE_SIGNALS, Experiment
from pmsmtool.proof.simulated_move import hold, record_move
from pmsmtool.run_directory import RunDirectory
from pmsmtool.sim.closed_loop import image_of
from pmsmtool.sim.foreign.behind import stored_gains
from pmsmtool.sim.kernel import Simulation
from pmsmtool.sim.simulated_machine import build_setup, settings_of

STD = {"J_kgm2": 0.015, "resonance_hz": 0.005, "antiresonance_hz": 0.005, "resonance_zeta": 0.05}
"""Relative standard deviation of what the design knows; `identify frf` left 1.8 % of a damping of 0.04."""
ENCODER_BITS = 17
WAY_RAD, REST_S = math.pi, 0.4
ROWS = 2000
SLACK = 0.1
"""Of a margin (degree, dB): gains are rounded to binary32."""
GAINS = ("speed.K_p_nms_per_rad", "speed.K_i_nm_per_rad", "position.K_p_per_s")


def loaded(seed: int) -> tuple[MachineFile, MachineFile]:
    """Return a machine with its load, and what the design knows of it."""
    rng = np.random.default_rng([20261124, seed])
    base = load_machine_file("interior-2k2")
    motor = base.machine
    ratio = math.exp(rng.uniform(math.log(0.2), math.log(20.0)))
    f_r = math.exp(rng.uniform(math.log(50.0), math.log(800.0)))
    f_a, zeta = f_r / math.sqrt(1.0 + ratio), math.exp(rng.uniform(math.log(0.005), math.log(0.05)))
    J_M = motor.J_kgm2 or 0.0
    J_L = ratio * J_M
    k = J_L * (2.0 * math.pi * f_a) ** 2
    rated = abs(motor.torque_nm(0.0, motor.I_nom_apk or 1.0))
    tau_c = float(rng.uniform(0.005, 0.03)) * rated
    settings: dict[str, Any] = {
        "J_kgm2": J_M, "J_load_kgm2": J_L, "coupling_stiffness_nm_per_rad": k, "tau_c_nm": tau_c,
        "coupling_damping_nms_per_rad": 2.0 * zeta * k / (2.0 * math.pi * f_r), "encoder_bits": ENCODER_BITS,
        "backlash_rad": float(rng.uniform(0.0, math.radians(0.1))) if rng.random() < 0.5 else 0.0,
    }  # fmt: skip
    true = {"J_kgm2": J_M + J_L, "resonance_hz": f_r, "antiresonance_hz": f_a, "resonance_zeta": zeta}
    seen: dict[str, Any] = {name: value * (1.0 + STD[name] * rng.standard_normal()) for name, value in true.items()}
    known = replace(motor, **seen, tau_c_nm=tau_c)
    std = {**base.std, **{name: STD[name] * value for name, value in seen.items()}}
    described = replace(base, machine=known, std=std)
    return replace(described, simulation={**base.simulation, **settings}), described


def fitting(file: MachineFile, family: str) -> MachineFile:
    """Return a machine as the family's drive can commutate it, with the same torque per ampere, and its encoder."""
    if family not in MORE_OBJECTS:
        return file
    psi_f_wb = file.machine.psi_f_wb * file.machine.pole_pairs / TWO_PAIRS
    return replace(
        file, machine=replace(file.machine, pole_pairs=TWO_PAIRS, psi_f_wb=psi_f_wb),
        encoder=replace(file.encoder, bits=OWN_BITS), simulation={**file.simulation, "encoder_bits": OWN_BITS},
        std={name: std * psi_f_wb / file.machine.psi_f_wb if name == "psi_f_wb" else std
             for name, std in file.std.items()},
    )  # fmt: skip


def uncoupled(truth: MachineFile) -> MachineFile:
    """Return the motor alone, its inertia known to :data:`STD`."""
    load = ("J_load_kgm2", "coupling_stiffness_nm_per_rad", "coupling_damping_nms_per_rad", "backlash_rad")
    settings = {key: value for key, value in truth.simulation.items() if key not in load}
    J = settings_of(truth).number("J_kgm2")
    machine = replace(truth.machine, J_kgm2=J, resonance_hz=None, antiresonance_hz=None, resonance_zeta=None)
    return replace(truth, machine=machine, std={"J_kgm2": STD["J_kgm2"] * J}, simulation=settings)


def error_rad(truth: MachineFile, params: ParameterSet, design: Design) -> float:
    """Return the largest following error (rad) of the design's move with some parameters; infinity when it trips."""
    setup, keep = build_setup(truth)
    simulation = Simulation(setup, image_of(truth, params), keep)
    unit, T_s = 2.0 * math.pi / 2**ENCODER_BITS, truth.inverter.T_s
    speed, acceleration, jerk = (
        float(design.facts[f"axis_{name}"]) / unit for name in ("speed_rad_s", "acceleration_rad_s2", "jerk_rad_s3")
    )
    move = ProfileMove(round(WAY_RAD / unit), round(speed), round(acceleration), round(jerk))
    seconds = WAY_RAD / unit / speed + speed / acceleration + acceleration / jerk + REST_S
    decimation = max(1, math.ceil(seconds / (ROWS * T_s)))
    nothing = Excitation(Shape.NONE, Injection.SPEED, 0.0)
    experiment = Experiment("move", "", 0.0, nothing, ROWS, decimation, judged=MOVE_SIGNALS, move=move)
    hold(simulation, experiment, 2**ENCODER_BITS, T_s, 0, 0.0)
    found = float(np.max(np.abs(record_move(simulation, experiment)[:, 0])))
    return found if math.isfinite(found) else math.inf


LEARNED = {
    "copley": "copley", "nanotec-c5-e": "nanotec", "nanotec-pd4-c": "nanotec", "zeroerr": "zeroerr",
    "faulhaber": "faulhaber",
}  # fmt: skip
"""Map of the families of a table whose gains `map learn` must find first."""
MORE_OBJECTS = {
    "faulhaber": (
        (0x2332, 1, "Position Control Parameter Set: Proportional Term PP"),
        (0x2332, 2, "Position Control Parameter Set: Derivative Term PD"),
    )
}
"""Objects that the table lacks: UNSIGNED16, 1 to 255, in the EDS of newer firmware (rauc-lab/being MCLM3002P-CO.eds).
"""
TWO_PAIRS, OWN_BITS = 2, 12
"""Pole pairs (0x2350:03 takes 2 to 4 poles) and encoder (0x608F is 4096 and fixed) of a Faulhaber's motor."""
UNABLE = ("following error", "speed", "travel")
"""Limits that end a move which the stored gains cannot do: the shaft swings, or comes no nearer. Its ratio is 0."""
SHARE_OF_ACCELERATION, FASTEST = 0.5, 300.0
"""Acceleration of the compared move: of the designed one, and its largest (rad/s2)."""


PROMPTS = {"motion": 0, "writing": 0}
"""How often consent was asked for since :func:`count_prompts`; ``--yes`` answers."""


GUARDS: list[GuardedDrive] = []
"""Of the drives that were energised since they were last forgotten; each knows for how long."""


def count_prompts() -> None:
    """Count what the commands ask a person for, and how long they energise a drive."""
    made = GuardedDrive.__init__

    def kept(guard: GuardedDrive, *given: Any, **options: Any) -> None:
        made(guard, *given, **options)
        GUARDS.append(guard)

    GuardedDrive.__init__ = kept  # type: ignore[method-assign, assignment]
    for subject, question in (("motion", consent.ask_motion), ("writing", consent.ask_writing)):

        def counted(*given: Any, subject: str = subject, question: Any = question, **options: Any) -> Any:
            PROMPTS[subject] += 1
            return question(*given, **options)

        setattr(consent, question.__name__, counted)


def done(*arguments: str) -> Any:
    """Run a command and return what it answers.

    Raises
    ------
    RuntimeError
        It ended with an error.
    """
    code, answer, reason = asked(*arguments, "--json")
    if code not in (0, 10):
        raise RuntimeError(f"{arguments[0]}: exit {code}: {reason}")
    return answer


def learned(family: str, channel: str) -> None:
    """Learn the gains of the uncoupled motor's drive into ``mine.toml``, as a person does."""
    drive = ("--map", LEARNED[family], "--sim", channel)
    learn = ("map", "learn", *GAINS, "--machine", "motor.toml", "-o", "mine.toml", "--shaft", "free", "--yes")
    GUARDS.clear()
    gains = [gain for gain in done(*learn, *drive)["gains"] if gain["name"] in GAINS]
    print(f"map learn energised the drive for {sum(guard.energised_s for guard in GUARDS):.0f} s; ", end="")
    unknown = [f"{gain['name']}: {gain['why']}" for gain in gains if gain["scale"] is None]
    if unknown:
        raise RuntimeError(f"map learn: not decided: {'; '.join(unknown)}")
    if len(gains) < len(GAINS):
        raise RuntimeError(f"map learn: no object is known for one of {', '.join(GAINS)}")


def compared_on(family: str, seed: int, table: str) -> tuple[float, float, float, float, int, str]:
    """Return the ratio of errors on a family's drive, margins (degree, dB), seconds of the moves, prompts, and a line.

    Raises
    ------
    RuntimeError
        A command ended with an error, or a gain stayed unknown.
    """
    truth, known = (fitting(file, family) for file in loaded(seed))
    PROMPTS.update(motion=0, writing=0)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        os.environ["PMSMTOOL_HOME"] = folder
        Path("truth.toml").write_text(dump_machine_file(truth), encoding="utf-8")
        Path("known.toml").write_text(dump_machine_file(known), encoding="utf-8")
        if family in MORE_OBJECTS:
            more = (f"{family},,0x{index:04X},{sub},{name},UNSIGNED16,rww,,1,255\n"
                    for index, sub, name in MORE_OBJECTS[family])  # fmt: skip
            Path("objects.csv").write_text(Path(table).read_text(encoding="utf-8") + "".join(more), encoding="utf-8")
            table = "objects.csv"
        node = f"eds={table}#{family}&gains={seed}" if family in LEARNED else f"drive={family}"
        node += f"&nv=drive.nv&encoder_bits={known.encoder.bits or ENCODER_BITS}"
        used = family
        if family in LEARNED:
            Path("motor.toml").write_text(dump_machine_file(uncoupled(truth)), encoding="utf-8")
            learned(family, f"motor.toml?{node}")
            used = "mine.toml"
        drive = ("--map", used, "--sim", f"truth.toml?{node}")
        done("backup", "-o", "stored.json", *drive)
        made = done("tune", "known.toml", "-o", "axis.toml", "--axis", "--stored", "stored.json", "--map", used)
        acceleration = min(FASTEST, SHARE_OF_ACCELERATION * float(made["facts"]["axis_acceleration_rad_s2"]))
        limits: tuple[str, ...] = ("--speed", "300rpm", "--acceleration", f"{acceleration:.4g}")
        if family in LEARNED:  # the stored gains are for the motor alone, and its drive may give little torque
            limits = ("--speed", "40rpm")
        move = ("move", "--by", "60deg", *limits, "--design", "axis.toml", "--flash", *drive, "--yes")
        code, after, why = asked(*move, "--json")
        if not after or not (code in (0, 10) or why.startswith(UNABLE)):
            raise RuntimeError(f"move: exit {code}: {why}")
        before = after["before"]
        both = [one for one in (before, after if after["move"] else None) if one]
        stages = [RunDirectory(Path(one["run"])).read().stage("move") for one in both]
    seconds = sum(stage.seconds for stage in stages if stage is not None)
    errors = [math.degrees(one["move"]["error_peak_rad"]) if one in both else math.inf for one in (before, after)]
    phase = min(float(made["facts"][f"axis_{loop}_phase_least_deg"]) for loop in ("speed", "position"))
    peak = max(float(made["facts"][f"axis_{loop}_S_peak_db"]) for loop in ("speed", "position"))
    if all(math.isinf(error) for error in errors):
        raise RuntimeError(f"neither the stored nor the designed gains can do the move: {why}")
    ratio, prompts = errors[1] / errors[0], sum(PROMPTS.values())
    stored = f"{errors[0]:.3g} deg" if math.isfinite(errors[0]) else "cannot do it"
    told = "; ".join(map(foretold, both)) + ("" if after in both else f"; designed: {why}")
    line = (
        f"{known.machine.resonance_hz:.0f} Hz, load {float(made['facts']['axis_load_ratio']):.2g}: stored "
        f"{stored}, with --stored x {ratio:.2f} ({phase:.0f} deg, {peak:.1f} dB, {seconds:.0f} s, {prompts} prompts; "
        f"{told}; stored gains {made['facts']['axis_stored_gains']})"
    )
    return ratio, phase, peak, seconds, prompts, line


def foretold(answer: Any) -> str:
    """Return the following error of a move over both ends of the predicted one."""
    error, ends = answer["move"]["error_peak_rad"], answer["predicted"]
    least, most = (error / ends[f"error_{end}_rad"] for end in ("least", "most"))
    return f"measured over predicted {most:.2f} to {least:.2f}"


def compare_on(family: str, first: int, loads: int, table: str) -> None:
    """Compare moves of random loads on a family's drive; print a line for every one, and the shares."""
    rows, ended = [], 0
    before = Path.cwd()
    count_prompts()
    for seed in range(first, first + loads):
        try:
            *numbers, line = compared_on(family, seed, table)
        except RuntimeError as error:
            ended += 1
            line = str(error)
        else:
            rows.append(numbers)
        os.chdir(before)
        print(f"{seed}: {line}", flush=True)
    if not rows:
        print(f"none of {loads} compared")
        return
    ratios, phases, peaks, seconds, prompts = np.array(rows).T
    print(f"following error over that of the stored gains: median {np.median(ratios):.2f}, p95 "
          f"{np.quantile(ratios, 0.95):.2f}, largest {ratios.max():.2f}; least margin {phases.min():.1f} deg, "
          f"largest |S| {peaks.max():.1f} dB; both moves at most {seconds.max():.0f} s, {prompts.max():.0f} prompts; "
          f"{len(rows)} of {loads} compared, {ended} ended before")  # fmt: skip


def main() -> None:
    """Run the loads; print a line for every one, and the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loads", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--drive", default="", help="family of the simulated drive; default: our own core")
    parser.add_argument("--table", type=Path, default=Path(), help="objects of makers' files, for families to learn")
    options = parser.parse_args()
    if options.drive:
        compare_on(options.drive, options.first, options.loads, str(options.table.resolve()))
        return
    plain, kept, phases, peaks, infeasible = [], [], [], [], 0
    for seed in range(options.first, options.first + options.loads):
        truth, known = loaded(seed)
        J = known.machine.J_kgm2 or 0.0
        gains = stored_gains(J)
        stored = dict(zip(GAINS, (gains.K_p, gains.K_i, gains.K_v), strict=True)) | {"position.velocity_ff": 1.0}
        try:
            made = design_axis(known, TuneRequest(), AxisRequest(), reference_map())
            held = design_axis(known, TuneRequest(), AxisRequest(), reference_map(), stored)
        except DesignInfeasible as error:
            infeasible += 1
            print(f"{seed}: {error.what}", flush=True)
            continue
        params = made.parameter_set()
        as_stored = replace(params, values={**params.values, **stored, "position.inertia_ff_kgm2": 0.0})
        as_stored = replace(as_stored, values={**as_stored.values, "speed.notch_hz": 0.0})
        before, after, with_stored = (
            error_rad(truth, values, made) for values in (as_stored, params, held.parameter_set())
        )
        plain.append(after / before if math.isfinite(before) else 0.0)
        kept.append(with_stored / before if math.isfinite(before) else 0.0)
        loops = ("axis_speed", "axis_position")
        phases.append(min(float(held.facts[f"{loop}_phase_least_deg"]) for loop in loops))
        peaks.append(max(float(held.facts[f"{loop}_S_peak_db"]) for loop in loops))
        load = f"{known.machine.resonance_hz:.0f} Hz, load {float(made.facts['axis_load_ratio']):.2g}"
        same = "kept" if held[GAINS[0]] == stored[GAINS[0]] else "designed"
        print(
            f"{seed}: {load}: stored {math.degrees(before):.3g} deg, designed x {plain[-1]:.2f}, with --stored x "
            f"{kept[-1]:.2f} ({same}, {phases[-1]:.0f} deg, {peaks[-1]:.1f} dB)", flush=True,
        )  # fmt: skip
    for name, ratios in (("designed", plain), ("with --stored", kept)):
        print(f"{name}: following error over that of the stored gains: median {np.median(ratios):.2f}, "
              f"p95 {np.quantile(ratios, 0.95):.2f}, largest {max(ratios):.2f}")  # fmt: skip
    asked_for = AxisRequest()
    both = zip(phases, peaks, strict=True)
    good = sum(p >= asked_for.phase_margin_deg - SLACK and s <= asked_for.peak_db + SLACK for p, s in both)
    print(f"margins kept over the box: {good} of {len(phases)}; no design: {infeasible}")


if __name__ == "__main__":
    main()
