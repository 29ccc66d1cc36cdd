# SPDX-License-Identifier: MIT
"""Drives as their makers built them: what `caps` and `identify` give on nodes made from makers' EDS and DCF files.

    python -m benchmarks.makers_drives TABLE.csv [--family NAME ...] [--machine PROFILE] [--drives 5 --first 300]
    python -m benchmarks.makers_drives drive.eds other.dcf

A table has the columns of ``sim/foreign/file_rows.py``; every family in it is a node. `identify` runs at its default
options with consent, on the machine of a profile, or on random ones from their seeds (``sim/random_drives.py``).
One row per node: the tier and the map, whether the shaft moved, what was told, its error and half width against the
simulated truth, and for what was not told the first reason. Exit code 1 where a truth lies outside its interval.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from click.testing import CliRunner

from pmsmtool.cli.main import cli
from pmsmtool.errors import PmsmtoolError
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.machine.profile import machine_path
from pmsmtool.machine.temperature import magnet_flux_at
from pmsmtool.sim.foreign.behind import set_up_of
from pmsmtool.sim.foreign.drive import ForeignDrive
from pmsmtool.sim.foreign.file_rows import read_makers_objects
from pmsmtool.sim.random_drives import draw_drive
from pmsmtool.sim.simulated_machine import settings_of

TOLD = ("J_per_psi", "J_per_kt")
POLES = ("0x2350:03",)
"""Objects without whose number a drive does not commutate: Faulhaber takes 2 or 4 poles."""


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


def identified(channel: str) -> tuple[int, dict[str, Any], str]:
    """Run `identify`; return its exit code, the values by name, and why it ended."""
    outcome = CliRunner().invoke(cli, ["--sim", channel, "--yes", "identify", "--json"])
    error = outcome.exception
    facts = json.loads(outcome.stdout) if outcome.stdout.startswith("{") else {}
    values = {value["name"]: value for value in facts.get("values", ()) if "total_95" in value}
    if isinstance(error, PmsmtoolError):
        lines = [error.what.splitlines()[0], *(line.strip(" -") for line in error.what.splitlines()[1:])]
        reason = next((line for line in lines if line.startswith("mechanics by standard")), lines[0])
        return error.exit_code, values, reason
    return outcome.exit_code, values, "" if outcome.exit_code in (0, 10) else repr(error)


def too_much_for(file: str, machine: MachineFile) -> str:
    """Return which numbers of the motor the drive cannot hold by the file's limits; currents may be cut."""
    drive = ForeignDrive(read_makers_objects(file), set_up_of(machine))
    return "; ".join(line for line in drive.assumed if "cannot hold" in line and line.startswith(POLES))


def row_of(file: str, name: str, machine: MachineFile) -> tuple[list[str], bool]:
    """Return one row of the table, and whether every truth lay within its interval."""
    began = time.perf_counter()
    caps = CliRunner().invoke(cli, ["caps", "--eds", file, "--json"])
    facts = json.loads(caps.stdout) if caps.stdout.startswith("{") else {}
    beyond = too_much_for(file, machine) if facts else ""
    code, values, reason = (2, {}, beyond) if beyond else identified(f"{name}?nv=:memory:&eds={file}")
    if not facts and isinstance(caps.exception, PmsmtoolError):
        reason = caps.exception.what
    told, good = [], True
    for key, true in truth_of(machine).items():
        if key in values:
            value, half = values[key]["value"], values[key]["total_95"]
            good = good and abs(value - true) <= half
            told.append(f"{key} {100.0 * (value / true - 1.0):+.1f} % +-{100.0 * half / true:.1f} %")
    told = told or ["-"]
    label = file.partition("#")[2] or Path(file).name
    shown = [label, str(facts.get("tier", "-")), str(facts.get("map", "-")), "yes" if values else "no", "; ".join(told)]
    replaced = "; ".join(line.split("(")[0].strip() for line in facts.get("replaced", ()))
    return [*shown, str(code), replaced or "-", reason, f"{time.perf_counter() - began:.0f} s"], good


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", metavar="FILE")
    parser.add_argument("--family", action="append", default=[])
    parser.add_argument("--machine", default="interior-2k2")
    parser.add_argument("--drives", type=int, default=0)
    parser.add_argument("--first", type=int, default=300)
    options = parser.parse_args()
    files = list(files_of(options.sources, options.family))
    good, moved, rows = True, 0, 0
    head = ("node", "tier", "map", "moved", "told: error, half width", "exit", "replaced", "why not", "time")
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        machines: dict[str, MachineFile] = {}
        for seed in range(options.first, options.first + options.drives):
            machines[f"drive-{seed}.toml"] = draw_drive(seed)
            Path(f"drive-{seed}.toml").write_text(dump_machine_file(machines[f"drive-{seed}.toml"]), encoding="utf-8")
        if not machines:
            machines[options.machine] = load_machine_file(machine_path(options.machine))
        for name, machine in machines.items():
            for file in files:
                row, fits = row_of(file, name, machine)
                good, moved, rows = good and fits, moved + (row[3] == "yes"), rows + 1
                print("| " + " | ".join(row) + " |", flush=True)
    print(f"{moved} of {rows} moved and told J over psi or K_T; {'every' if good else 'NOT every'} truth within")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
