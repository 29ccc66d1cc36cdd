# SPDX-License-Identifier: MIT
"""Drives as their makers built them: what nodes made from makers' EDS and DCF files give, command by command.

    python -m benchmarks.makers_drives TABLE.csv [--family NAME ...] [--machine PROFILE] [--drives 5 --first 300]
    python -m benchmarks.makers_drives drive.eds other.dcf
    python -m benchmarks.makers_drives TABLE.csv --page docs/drives.md

A table has the columns of ``sim/foreign/file_rows.py``; every family in it is a node. `caps`, `identify`, `commission`
and `flash-params` run at their default options with consent, on the machine of a profile, or on random ones from their
seeds (``random_drives.py``); a drive that by its file cannot commutate that machine gets the first random one that
it can. One row per node: level and map, what was told with its error and half width against the simulated truth, the
stages of the chain, what was written, and for what was not had the first reason. Every row that could be written is
also counted against the node's own units. Exit code 1 where a truth lies outside its interval, or a unit is wrong.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from click.testing import CliRunner

from benchmarks.random_drives import draw_drive
from pmsmtool.cli.main import cli
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import PmsmtoolError
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file, machine_path
from pmsmtool.machine.temperature import magnet_flux_at
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.run_directory import RunDirectory
from pmsmtool.sim.foreign.behind import set_up_of
from pmsmtool.sim.foreign.drive import ForeignDrive
from pmsmtool.sim.foreign.file_rows import MakersObjects, read_makers_objects
from pmsmtool.sim.simulated_machine import settings_of

TOLD = ("J_per_psi", "J_per_kt")
SAME = (("copley", "dchcan"), ("elmo-gold-a", "elmo-gold-b", "elmo-gold-c"))
"""Files of one drive: they count once."""
COUNTS = 1.0
"""A row of a map agrees with the node's own unit within so many counts: both round."""
LONGEST_REASON = 300
LEAST_COUNTS = 64
"""Increments per turn from which the number of a file is an encoder's; one holds 1."""
MOST_MACHINES = 3
"""Random machines that are tried on a drive that cannot commutate the one asked for."""


@dataclass(frozen=True)
class Row:
    """What one node gave; texts as the table shows them."""

    node: str
    level: str
    map: str
    identify: str
    commission: str
    flash: str
    reasons: tuple[str, ...]
    told: tuple[str, ...]
    good: bool
    seconds: float

    def cells(self) -> tuple[str, ...]:
        """Return the columns of the table."""
        why = "; ".join(dict.fromkeys(self.reasons)) or "-"
        return self.node, f"{self.level}, {self.map}", self.identify, self.commission, self.flash, why


HEADS = ("node", "`caps`: level, map", "`identify`", "`commission`", "`flash-params`", "what is not had, and why")


def files_of(sources: list[str], families: list[str]) -> Iterator[str]:
    """Yield every node's file as `?eds=` takes it."""
    for source in sources:
        path = str(Path(source).resolve())
        if not path.endswith(".csv"):
            yield path
            continue
        with Path(path).open(encoding="utf-8", newline="") as stream:
            for family in dict.fromkeys(row["family"] for row in csv.DictReader(stream)):
                if not families or family in families:
                    yield f"{path}#{family}"


def truth_of(machine: MachineFile) -> dict[str, float]:
    """Return what the simulated machine has, by the keys of :data:`TOLD`, at the temperature of its magnets."""
    number = settings_of(machine).number
    J, pole_pairs = number("J_kgm2"), number("pole_pairs")
    psi = magnet_flux_at(replace(machine.machine, psi_f_wb=number("psi_f_wb")), number("T_magnet_c"))
    return {"J_per_psi": J / psi, "J_per_kt": J / (1.5 * pole_pairs * psi)}


def too_much_for(objects: MakersObjects, machine: MachineFile) -> bool:
    """Return whether the drive cannot hold the motor's poles by the file's limits; currents may be cut."""
    return bool(ForeignDrive(objects, set_up_of(machine)).too_few_poles)


def machines_for(objects: MakersObjects, name: str, first: int) -> Iterator[tuple[str, MachineFile]]:
    """Yield the machine named if the drive can commutate it, else random ones that it can, with its file's encoder."""
    machine = load_machine_file(machine_path(name)) if not Path(name).is_file() else load_machine_file(Path(name))
    if not too_much_for(objects, machine):
        yield with_encoder(objects, name, machine)
        return
    for seed in itertools.count(first):
        machine = draw_drive(seed)
        if not too_much_for(objects, machine):
            Path(f"drive-{seed}.toml").write_text(dump_machine_file(machine), encoding="utf-8")
            yield with_encoder(objects, f"drive-{seed}.toml", machine)


def with_encoder(objects: MakersObjects, name: str, machine: MachineFile) -> tuple[str, MachineFile]:
    """Return the machine with the encoder that the file states for good (0x608F, ro), where it states another one."""
    row = objects.rows.get((0x608F, 1))
    counts = int(row.default, 0) if row is not None and row.default and row.access != "rw" else 0
    if counts < LEAST_COUNTS or machine.encoder.bits is None or counts == 1 << machine.encoder.bits:
        return name, machine
    bits = counts.bit_length() - 1 if counts & counts - 1 == 0 else None  # a machine file knows powers of two
    machine = replace(machine, encoder=replace(machine.encoder, bits=bits))
    own = f"{name.removesuffix('.toml')}-encoder.toml"
    Path(own).write_text(dump_machine_file(machine), encoding="utf-8")
    return own, machine


def asked(*words: str) -> tuple[int, dict[str, Any], str]:
    """Run a command; return its exit code, its JSON object, and why it ended."""
    outcome = CliRunner().invoke(cli, list(words))
    error = outcome.exception
    facts = json.loads(outcome.stdout) if outcome.stdout.startswith("{") else {}
    if isinstance(error, PmsmtoolError):
        lines = [line.strip(" -") for line in str(error).splitlines()]
        first = error.what.splitlines()[0]
        reason = next((line for line in lines if "mechanics by standard" in line), first)
        return error.exit_code, facts, reason
    return outcome.exit_code, facts, "" if outcome.exit_code in (0, 10) else repr(error)


def identified(channel: str, machine: MachineFile) -> tuple[str, list[str], bool, str]:
    """Return what `identify` told, by which keys, whether every truth lay within, and why it told no more."""
    code, facts, reason = asked("--sim", channel, "--yes", "identify", "--json")
    values = {value["name"]: value for value in facts.get("values", ()) if "total_95" in value}
    if code in (0, 10):
        lacking = ("psi",) if "J_per_psi" not in values else ("J_per_psi",)  # the pole pairs, or peak or rms
        told_why = [*facts.get("warnings", ()), *(f"{key}: {why}" for key, why in facts.get("refused", {}).items())]
        reason = next((line for line in told_why if line.startswith(lacking)), "")
    told, good = against_truth(values, machine)
    return "; ".join(told) or f"nothing (exit {code})", [key for key in TOLD if key in values], good, reason


def against_truth(values: Mapping[str, Mapping[str, Any]], machine: MachineFile) -> tuple[list[str], bool]:
    """Return what was told with its error and half width, and whether every truth lay within."""
    told, good = [], True
    for key, true in truth_of(machine).items():
        if key in values:
            value, half = values[key]["value"], values[key]["total_95"]
            good = good and abs(value - true) <= half
            told.append(f"{key} {100.0 * (value / true - 1.0):+.1f} % +-{100.0 * half / true:.1f} %")
    return told, good


def commissioned(file: str, machine: str) -> tuple[str, str, dict[str, Mapping[str, Any]]]:
    """Return the stages that `commission` passed, the first reason of one that it did not, and what it identified."""
    shutil.rmtree("chain", ignore_errors=True)
    code, _, reason = asked("--yes", "commission", machine, "--eds", file, "--runs", "chain", "--json")
    stages = next((RunDirectory(path).read().stages for path in Path("chain").glob("*")), ())
    passed = [stage.name for stage in stages if stage.status in ("pass", "partial")]
    failed = next((f"{stage.name}: {stage.note}" for stage in stages if stage.name not in passed), reason)
    rows = [row for stage in stages if stage.name == "identify" for row in stage.values if "total_95" in row]
    text = f"{', '.join(passed) or 'no stage'} (exit {code})"
    return text, failed if code else "", {str(row["name"]): row for row in rows}


def flashed(channel: str, family: str) -> tuple[str, str]:
    """Return how many of the design's values went to the drive, and why none did."""
    code, facts, reason = asked("--sim", channel, "--yes", "flash-params", "design.toml", "--map", family, "--json")
    if code:
        return f"nothing (exit {code})", reason
    outcome, names = facts["outcome"], [change["name"] for change in facts["changes"]]
    held = outcome["written"] + outcome["equal"]
    lacks = "" if held else f"flash-params: the map {family!r} has no row for a parameter"
    return f"{held} values held, {len(names)} changed" if held else "nothing", lacks


def wrong_units(objects: MakersObjects, machine: MachineFile, family: str) -> tuple[int, list[str]]:
    """Count the rows of a map that the node knows in units of its own, and name those that differ."""
    drive = ForeignDrive(objects, set_up_of(machine))
    motor = drive.set_up
    true = {
        "motor.pole_pairs": float(motor.pole_pairs), "motor.R_s_ohm": motor.R_s_ohm, "motor.L_q_h": motor.L_q_h,
        "motor.psi_f_wb": motor.torque_constant / torque_per_ampere(motor.pole_pairs, 1.0),
        "motor.I_nom_apk": motor.i_nom_apk, "motor.I_max_apk": motor.i_max_apk, "motor.I_max_time_s": 1.0,
        "motor.n_max_rpm": motor.n_max_rpm, "reference.tau_rated_nm": motor.torque_nm,
        "current.K_p_q_v_per_a": motor.K_p_v_per_a, "current.K_i_q_v_per_as": motor.K_i_v_per_as,
    }  # fmt: skip
    drive_map, laws = load_family(family), drive.laws
    wanted = ParameterSet({name: true[name] for name in drive_map.cells if name in true})
    judged, wrong = 0, []
    for name in wanted.values:
        cell = drive_map.cells[name]
        law = laws.get((cell.index, cell.sub))
        if law is not None and law.set_up is not None:
            judged += 1
            counts = cell.counts(true[name], wanted.values)
            if abs(counts - law.set_up) > COUNTS:
                wrong.append(f"{drive_map.row_text(name)}: {counts:.6g} counts, the node means {law.set_up:.6g}")
    return judged, wrong


def row_of(file: str, name: str, first: int) -> tuple[Row, int]:
    """Return the row of a node, and how many rows of its map were judged by the node's own units."""
    began = time.perf_counter()
    label = file.partition("#")[2] or Path(file).name
    code, facts, reason = asked("caps", "--eds", file, "--json")
    if not facts:
        refused = f"refused (exit {code})"
        return Row(label, "-", "-", refused, refused, refused, (reason,), (), True, 0.0), 0
    objects = read_makers_objects(file)
    reasons, good = [], True
    for own, machine in itertools.islice(machines_for(objects, name, first), MOST_MACHINES):
        channel = f"{own}?nv=:memory:&eds={file}"
        told, keys, within, why = identified(channel, machine)
        good = good and within
        drawn = own.startswith("drive-") and not name.startswith("drive-")
        motor = f"random motor of {machine.machine.pole_pairs} pole pairs, seed {own.split('-')[1].split('.')[0]}"
        reasons.append(f"{motor}: {why}" if drawn and why else why)
        if drawn:
            told += f" ({motor}: it cannot commutate {name})"
        if keys:
            break
    chain, missing, values = commissioned(file, own if Path(own).is_file() else str(machine_path(own)))
    more, within = against_truth(values, machine)
    if "J_per_psi" in values and "J_per_psi" not in keys:  # the machine file tells the pole pairs
        chain, keys = f"{'; '.join(more)}; {chain}", [*keys, "J_per_psi"]
        good = good and within
    asked("tune", own, "-o", "design.toml")
    written, unwritten = flashed(channel, facts["map"])
    judged, wrong = wrong_units(objects, machine, facts["map"])
    if not keys and missing.startswith("identify:"):
        missing = ""  # the same reason once more
    shown = tuple(short(line) for line in (*reasons, missing, unwritten, *wrong) if line)
    seconds = time.perf_counter() - began
    row = Row(
        label, facts["level"], facts["map"], told, chain, written, shown, tuple(keys), good and not wrong, seconds
    )  # fmt: skip
    return row, judged


def short(text: str) -> str:
    """Return a reason as a cell of a table takes it."""
    line = " ".join(text.partition(" (try:")[0].replace("|", "/").split())
    return line if len(line) <= LONGEST_REASON else f"{line[: LONGEST_REASON - 3]}..."


def counted(rows: Sequence[Row]) -> tuple[int, int, int]:
    """Return how many nodes there are, told J/psi or J/K_T, and told J/psi; files of one drive count once."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(next((same[0] for same in SAME if row.node in same), row.node), []).append(row)
    moved = sum(any(row.told for row in group) for group in groups.values())
    return len(groups), moved, sum(any("J_per_psi" in row.told for row in group) for group in groups.values())


def table(rows: Sequence[Row]) -> list[str]:
    """Return the rows as a table in Markdown."""
    lines = ["| " + " | ".join(HEADS) + " |", "|" + "---|" * len(HEADS)]
    return [*lines, *("| " + " | ".join(row.cells()) + " |" for row in rows)]


def main() -> int:
    """Print the table, and put it into a page between its marks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", metavar="FILE")
    parser.add_argument("--family", action="append", default=[])
    parser.add_argument("--machine", default="interior-2k2")
    parser.add_argument("--drives", type=int, default=0)
    parser.add_argument("--first", type=int, default=300)
    parser.add_argument("--page", type=Path, metavar="FILE", help="put the table there, between its two marks")
    options = parser.parse_args()
    files = list(files_of(options.sources, options.family))
    page = None if options.page is None else options.page.resolve()
    rows: list[Row] = []
    judged = 0
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        names = [f"drive-{seed}.toml" for seed in range(options.first, options.first + options.drives)]
        for name in names:
            seed = int(name.removeprefix("drive-").removesuffix(".toml"))
            Path(name).write_text(dump_machine_file(draw_drive(seed)), encoding="utf-8")
        for name in names or [options.machine]:
            for file in files:
                row, units = row_of(file, name, options.first)
                rows.append(row)
                judged += units
                print("| " + " | ".join(row.cells()) + f" | {row.seconds:.0f} s", flush=True)
    good = all(row.good for row in rows)
    nodes, moved, told = counted(rows)
    sums = [
        f"{moved} of {nodes} drives moved; {told} gave J/psi, by `identify` alone or with the pole pairs of the "
        "machine file in `commission`. "
        f"{'Every' if good else 'NOT every'} truth is within its interval. {judged} rows of maps counted in the node's "
        f"own units, {'none' if good else 'SOME'} wrong."
    ]
    print(*sums)
    if page is not None:
        head, mark, rest = page.read_text(encoding="utf-8").partition(BEGIN)
        _, end, tail = rest.partition(END)
        page.write_text("\n".join([head + mark, *table(rows), "", *sums, end + tail]), encoding="utf-8")
    return 0 if good else 1


BEGIN, END = "<!-- begin: benchmarks.makers_drives -->", "<!-- end -->"

if __name__ == "__main__":
    sys.exit(main())
