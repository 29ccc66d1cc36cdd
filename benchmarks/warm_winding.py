# SPDX-License-Identifier: MIT
"""Identify the shipped machines with windings and magnets of 5 to 90 degC, and say what is accepted and how far off.

    python -m benchmarks.warm_winding

The whole of `identify --yes` runs in the process, over frames, with its default options. ``R off`` is the error of the
resistance at the reference temperature over its truth, ``half`` its total half width; ``ratio`` is the largest error of
any value over its total half width, and ``of`` names that value.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.commissioning import commanded, errors_of, prepared
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file, profile_names

TEMPERATURES_C = (5.0, 42.0, 60.0, 90.0)


def identify_one(job: tuple[str, float, tuple[str, ...]]) -> str:
    """Identify one machine and return its row."""
    name, T_c, options = job
    base = load_machine_file(data_folder("profiles") / f"{name}.toml")
    drive = replace(base, simulation={**base.simulation, "T_winding_c": T_c, "T_magnet_c": T_c})
    with prepared():
        Path("drive.toml").write_text(dump_machine_file(drive, embed_flux_map=True), encoding="utf-8")
        code, told = commanded("identify", "-i", "pmsmsim", "-c", "drive.toml", "--yes", *options)
        (folder,) = Path("runs").iterdir()
        errors = errors_of(drive, folder)
        found = load_machine_file(folder / "machine.toml").estimates if errors else {}
        halves = {key: total_half_width(found[key]) / abs(found[key].value) for key in errors}
    row = f"{name:22} {T_c:5.0f} {code:4d}"
    if "R_s_ohm" in errors:
        ratios = {key: abs(error) / halves[key] for key, error in errors.items()}
        worst = max(ratios, key=lambda key: ratios[key])
        row += f" {100.0 * errors['R_s_ohm']:+7.2f} {100.0 * halves['R_s_ohm']:6.2f} {ratios[worst]:6.2f} {worst}"
    lines = [] if code == 0 else told.strip().splitlines()[-4:]
    return "\n".join([row, *(f"    {line}" for line in lines)])


def table(names: Sequence[str], temperatures_c: Sequence[float], processes: int, options: tuple[str, ...]) -> None:
    """Print one row per machine and temperature."""
    print(f"{'machine':22} {'degC':>5} {'exit':>4} {'R off %':>7} {'half %':>6} {'ratio':>6} of")
    jobs = [(name, T_c, options) for name in names for T_c in temperatures_c]
    with multiprocessing.Pool(processes, maxtasksperchild=1) as pool:
        for row in pool.imap(identify_one, jobs, chunksize=1):
            print(row, flush=True)


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--profiles", nargs="+", default=list(profile_names()))
    parser.add_argument("--temperatures", nargs="+", type=float, default=list(TEMPERATURES_C))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--quantities", nargs="*", default=[], help="of `identify`; all of them without")
    asked = parser.parse_args()
    table(asked.profiles, asked.temperatures, asked.processes, tuple(asked.quantities))


if __name__ == "__main__":
    main()
