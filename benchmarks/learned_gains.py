# SPDX-License-Identifier: MIT
"""`map learn` on drives whose gains, forms and conventions a seed drew: what is decided, what is wrong, what is left.

    python -m benchmarks.learned_gains TABLE.csv [--drives 100] [--first 0] [--processes 2]

A table has the columns of ``sim/foreign/file_rows.py``; the nodes are its families that have a velocity mode and gains
of a speed loop (``sim/foreign/drawn_gains.py``), and one that keeps to CiA 402. Machines are random
(``random_drives.py``); the learner gets inertia and inductance with errors drawn from the deviations it is told. With
``--light`` they have the free shafts of servo motors, 10 to 50 times lighter, whose inertia a data sheet gives; the
scales that rest on it are compared as a design with the same inertia uses them.

A scale is right within 12 %, of a current gain within 3 %; the truth is what one count does on this machine (its
magnets are not at 20 degC, so the drive's own newton metre is not one). *Wrong* is a decided scale, form or convention
that is not the truth. After every run the gains are compared, and the largest speed of the shaft with the limit. Runs
that are killed: ``interrupted_learning.py``.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.random_drives import draw_drive
from pmsmtool.bus.connect import connect
from pmsmtool.bus.connection import Connection
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.speed_loop_drive import SpeedLoopDrive
from pmsmtool.drive_maps.shipped_maps import family_of, load_family
from pmsmtool.errors import PmsmtoolError
from pmsmtool.identification.learned_gains import Learned
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.machine.temperature import magnet_flux_at
from pmsmtool.measurement.changed_gains import GAIN, INTEGRAL, gain_object
from pmsmtool.measurement.learn_current_gains import (
    CURRENT_GAIN,
    CURRENT_INTEGRAL,
    current_gain_objects,
    learn_current_gains,
)
from pmsmtool.measurement.learn_gains import learn_speed_loop, learning_envelope
from pmsmtool.measurement.learn_position_gain import FORWARD, POSITION, learn_position_gain, position_gain
from pmsmtool.measurement.learned_rows import emf_of, learned_gains, shown_currents, winding_of
from pmsmtool.sim.foreign.drawn_gains import DrawnGains
from pmsmtool.sim.simulated_machine import settings_of

FAMILIES = (
    "epos4-c505-eds", "epos4-50/8-eds", "epos2", "copley", "nanotec-c5-e", "nanotec-pd4-c", "faulhaber", "cia402",
)  # fmt: skip
RIGHT = 0.12
RIGHT_CURRENT = 0.03
J_STD, L_STD = 0.03, 0.005
LIGHT_RAD_S2, LIGHT_POWER, LIGHT_SPREAD = 25_000.0, -0.4, 2.0
"""By how much the rated torque accelerates the free shaft of a servo motor of 1 N m, its power of the torque, and the
factor around that: seven motors in data sheets of 0.05 to 14 N m have 6000 to 90 000 rad/s2."""
LIGHT_J_OFF, LIGHT_J_STD = 0.1, 0.0577
"""A data sheet's inertia is up to 10 % off; `machine new` states that as a standard deviation."""
FORMS = {"parallel": "value", "rate": "rate", "time": "time"}
OVER = 1.25
"""Speed over the limit that counts as an over-speed: what the guard itself allows for overshoot."""
CIA402 = (
    "0x1000,0,UNSIGNED32,ro,0x00020192", "0x1016,1,UNSIGNED32,rw,0", "0x1017,0,UNSIGNED16,rw,0",
    "0x1018,1,UNSIGNED32,ro,0x999", "0x1018,2,UNSIGNED32,ro,1", "0x1018,4,UNSIGNED32,ro,0",
    "0x6007,0,INTEGER16,rw,2", "0x6072,0,UNSIGNED16,rw,0", "0x6073,0,UNSIGNED16,rw,0", "0x6075,0,UNSIGNED32,rw,0",
    "0x6076,0,UNSIGNED32,rw,0", "0x6077,0,INTEGER16,ro,0", "0x6078,0,INTEGER16,ro,0", "0x6064,0,INTEGER32,ro,0",
    "0x606C,0,INTEGER32,ro,0", "0x6080,0,UNSIGNED32,rw,0", "0x608F,1,UNSIGNED32,ro,1", "0x608F,2,UNSIGNED32,ro,1",
    "0x60FF,0,INTEGER32,rw,0", "0x60F9,1,UNSIGNED16,rw,0", "0x60F9,2,UNSIGNED16,rw,0", "0x6502,0,UNSIGNED32,ro,0x104",
)  # fmt: skip
"""A drive of the standard alone: torque is not offered, the cyclic velocity mode is."""


@dataclass(slots=True)
class Result:
    """What one run gave."""

    seed: int
    family: str
    verdicts: dict[str, str] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)
    why: dict[str, str] = field(default_factory=dict)
    left_changed: bool = False
    over_speed: bool = False
    fault: str = ""


def drawn(seed: int, light: bool = False) -> MachineFile:
    """Return a seed's machine; ``light``: with the inertia of a servo motor's free shaft."""
    machine = draw_drive(3000 + seed)
    if not light:
        return machine
    torque = machine.machine.torque_nm(0.0, machine.machine.I_nom_apk or 1.0)
    spread = LIGHT_SPREAD ** random.Random(f"light {seed}").uniform(-1.0, 1.0)
    J = torque / (LIGHT_RAD_S2 * torque**LIGHT_POWER * spread)
    return replace(machine, machine=replace(machine.machine, J_kgm2=J))


def stated(machine: MachineFile, seed: int, light: bool = False) -> MachineFile:
    """Return the machine as a person knows it: inertia and inductance with an error, and how well they are known."""
    number, known = settings_of(machine).number, random.Random(f"inertia {seed}")
    off, J_std = (
        (known.uniform(-LIGHT_J_OFF, LIGHT_J_OFF), LIGHT_J_STD) if light else (J_STD * known.gauss(0, 1), J_STD)
    )
    told = number("J_kgm2") * (1.0 + off)
    L_q = number("L_q_h") * (1.0 + L_STD * random.Random(f"inductance {seed}").gauss(0.0, 1.0))
    std = {**machine.std, "J_kgm2": J_std * told, "L_q_h": L_STD * L_q}
    return replace(machine, machine=replace(machine.machine, J_kgm2=told, L_q_h=L_q), std=std)


def strength(machine: MachineFile) -> float:
    """Return torque per ampere of the simulated machine over the one that its drive was told."""
    number = settings_of(machine).number
    cold = replace(machine.machine, psi_f_wb=number("psi_f_wb"))
    return float(magnet_flux_at(cold, number("T_magnet_c"))) / number("psi_f_wb")


@contextmanager
def machine_at(seed: int, table: str, family: str, light: bool = False) -> Iterator[str]:
    """Yield the channel of a seed's drive, in a folder of its own."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        os.environ["PMSMTOOL_HOME"] = folder
        try:
            Path("drive.toml").write_text(dump_machine_file(drawn(seed, light)), encoding="utf-8")
            source = table
            if family == "cia402":
                head = "family,source,index,sub,name,type,access,default_or_stored,low,high\n"
                rows = ("cia402,CiA 402,{},{},x,{},{},{},,\n".format(*row.split(",")) for row in CIA402)
                Path("cia402.csv").write_text(head + "".join(rows), encoding="ascii")
                source = "cia402.csv"
            yield f"drive.toml?nv=:memory:&eds={source}#{family}&gains={seed}"
        finally:
            os.chdir(before)


def _gains(connection: Connection) -> DrawnGains:
    return connection.bus.line.nodes[0].face.gains  # type: ignore[attr-defined,no-any-return]


def _held(connection: Connection, gains: DrawnGains) -> list[bytes]:
    dictionary = connection.bus.line.nodes[0].face.behind.dictionary  # type: ignore[attr-defined]
    loops = [gains] if gains.current is None else [gains, gains.current]
    return [dictionary.find(*address).value for loop in loops for address in (loop.gain, loop.integral)]


def run(seed: int, table: str, light: bool = False) -> Result:
    """Learn one drive's gains."""
    family = FAMILIES[seed % len(FAMILIES)]
    result = Result(seed, family)
    with machine_at(seed, table, family, light) as channel, connect("pmsmsim", channel) as watching:
        machine = drawn(seed, light)
        gains = _gains(watching)
        before = _held(watching, gains)
        told = stated(machine, seed, light)
        try:
            with connect("pmsmsim", channel) as connection:
                _learn(connection, told, machine, gains, result, light)
        except PmsmtoolError as error:
            result.fault = f"{type(error).__name__}: {error.what}"
        result.left_changed = _held(watching, gains) != before
    return result


def _learn(
    connection: Connection, told: MachineFile, machine: MachineFile, gains: DrawnGains, result: Result, light: bool
) -> None:
    node = DriveNode(connection, 1)
    identity = node.identity()
    node.close()
    drive_map = family_of(identity.vendor, identity.product) or load_family("cia402")
    drive = SpeedLoopDrive(connection, 1, drive_map=drive_map)
    gain, integral = gain_object(drive.node, GAIN, *gains.gain), gain_object(drive.node, INTEGRAL, *gains.integral)
    envelope = learning_envelope(drive, told, None, None, "free", "none", "none")
    drive_live = drive.live
    largest = 0.0

    def live(name: str) -> float:
        nonlocal largest
        value = drive_live(name)
        if name == "omega_e_rad_s":
            largest = max(largest, abs(value))
        return value

    drive.live = live  # type: ignore[method-assign]
    try:
        measured = learn_speed_loop(
            drive, gain, integral, envelope, emf_of(told), lambda text: None,
            lambda measured: all(one.scale is not None for one in learned_gains(told, measured).values()),
        )  # fmt: skip
    finally:
        result.over_speed = largest > OVER * envelope.speed_max_rad_s
    for note in measured.notes:
        result.why["note"] = note
    _judge(result, told, machine, gains, measured, drive, light)
    of_currents = current_gain_objects(drive.node, {CURRENT_GAIN: None})
    if of_currents and (current := gains.current) is not None:
        loops, _ = learn_current_gains(
            drive, of_currents, envelope, measured.base[0].loop, winding_of(told), lambda text: None
        )  # fmt: skip
        _note(result, "K_p cur", loops[CURRENT_GAIN], "value", current.K_p_nms_per_rad, RIGHT_CURRENT)
        form = FORMS[current.form]
        _note(result, "K_i cur", loops[CURRENT_INTEGRAL], form, current.integral_scale, RIGHT_CURRENT)
    held = position_gain(drive.node)
    if held is not None and gains.position == (held.item.index, held.item.sub):
        found, _ = learn_position_gain(connection, drive.node, held, envelope, lambda text: None)
        _note(result, "K_v", found[POSITION], "value", gains.K_v_per_s)
        if FORWARD in found:
            _note(result, "v_ff", found[FORWARD], "value", gains.forward_share)


def _judge(
    result: Result, told: MachineFile, machine: MachineFile, gains: DrawnGains, measured: Any, drive: SpeedLoopDrive,
    light: bool,
) -> None:  # fmt: skip
    found = learned_gains(told, measured)
    stronger = strength(machine)
    if light:  # a design rests on the same inertia as the scales: what both have of its error no loop has
        stronger *= (told.machine.J_kgm2 or 0.0) / settings_of(machine).number("J_kgm2")
    relative = gains.form != "parallel"
    truth = {
        GAIN: ("value", gains.K_p_nms_per_rad * stronger),
        INTEGRAL: (FORMS[gains.form], gains.integral_scale * (1.0 if relative else stronger)),
    }
    for name, (form, scale) in truth.items():
        _note(result, name.split(".")[1][:3], found[name], form, scale)
    kind = shown_currents(told, measured, drive).kind
    rms = gains.rms if drive.current_undecided or result.family == "cia402" else None
    if kind is None or rms is None:
        result.verdicts["current"] = "unknown" if rms is not None else "published"
    else:
        result.verdicts["current"] = "right" if kind == ("rms" if rms else "peak") else "wrong"


def _note(result: Result, key: str, one: Learned, form: str, scale: float, right: float = RIGHT) -> None:
    """Keep what was found of a gain beside its truth."""
    result.why[key] = one.why
    if one.scale is None:
        result.verdicts[key] = "unknown"
        return
    result.errors[key] = one.scale / scale - 1.0
    result.verdicts[key] = "right" if one.form == form and abs(result.errors[key]) <= right else "wrong"


def main() -> int:
    """Print a line per drive and the summary; exit code 1 where something is wrong, left or too fast."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=lambda text: str(Path(text).resolve()))
    parser.add_argument("--drives", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--light", action="store_true", help="free shafts of servo motors, J by a data sheet")
    parser.add_argument("--family", choices=FAMILIES, help="only drives of this family")
    options = parser.parse_args()
    seeds = [
        seed for seed in range(options.first, options.first + options.drives)
        if options.family in (None, FAMILIES[seed % len(FAMILIES)])
    ]  # fmt: skip
    with ProcessPoolExecutor(options.processes) as pool:
        results = []
        for r in pool.map(partial(run, table=options.table, light=options.light), seeds):
            results.append(r)
            errors = " ".join(f"{k} {100 * e:+.1f}%" for k, e in r.errors.items())
            said = " ".join(f"{k}:{v}" for k, v in r.verdicts.items())
            print(
                f"{r.seed} {r.family}: {said} {errors} {r.fault} {'; '.join(w for w in r.why.values() if w)}",
                flush=True,
            )
    counted = Counter((key, verdict) for r in results for key, verdict in r.verdicts.items())
    wrong = sum(n for (_, verdict), n in counted.items() if verdict == "wrong")
    print(f"{len(results)} drives of {len(FAMILIES)} families")
    for key in ("K_p", "K_i", "K_v", "v_ff", "K_p cur", "K_i cur", "current"):
        right, bad = counted[key, "right"], counted[key, "wrong"]
        known = max(1, right + bad + counted[key, "unknown"])
        sizes = sorted(100 * abs(r.errors[key]) for r in results if key in r.errors)
        spread = f"; error median {sizes[len(sizes) // 2]:.1f} %, largest {sizes[-1]:.1f} %" if sizes else ""
        print(f"{key}: decided {right + bad} of {known} ({100 * (right + bad) / known:.0f} %), wrong {bad}{spread}")
    left = sum(r.left_changed for r in results)
    fast = sum(r.over_speed for r in results)
    print(f"gains left changed {left} of {len(results)}, over-speeds {fast}")
    return 1 if wrong or left or fast else 0


if __name__ == "__main__":
    sys.exit(main())
