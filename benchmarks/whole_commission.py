# SPDX-License-Identifier: MIT
"""Run the whole command `pmsmtool commission FILE --yes` on random drives and judge verdicts and values.

    python -m benchmarks.whole_commission --drives 200 --first 120000 --results results.jsonl
    python -m benchmarks.whole_commission --real --drives 400 --first 160000 --results real.jsonl
    python -m benchmarks.whole_commission --wide --drives 40 --first 1000 --results wide.jsonl
    python -m benchmarks.whole_commission --second-plant --drives 60 --first 170000 --results second.jsonl

Drives follow from their seeds (``random_drives.py``: switched inverter, half of the encoders reversed, half of
the machines with two leads swapped, 5 to 90 degC, three kinds of sensors in turn). FILE is a data sheet within its
tolerances, and the drive's memory holds the set of another motor. The command runs in the process, over frames, with
its default options. Every result is appended to the file as it comes; a seed in the file is not run again, and
``--drives 0`` only sums up. A false alarm: a right file that the comparison of the values contradicts.
With ``--second-plant`` motor, shaft and bridge are those of ``benchmarks/second_plant``, and every result names them
by the sha256 of their sources.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import multiprocessing
import statistics
import struct
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import second_plant
from benchmarks.commissioning import QUANTITIES, commanded, errors_of, prepared
from benchmarks.random_drives import Block, data_sheet, draw_drive, draw_wide, true_loop_resistance
from benchmarks.real_population import draw_real
from pmsmtool.commissioning.report_page import verdict
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.estimators.resistance import R_MEASURED
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.machine.parameters import MachineParameters
from pmsmtool.machine.temperature import resistance_at
from pmsmtool.params.catalogue import layout_signature
from pmsmtool.run_directory import RunDirectory
from pmsmtool.sim.node.factory import factory_values, set_up_values
from pmsmtool.sim.node.memory import IMAGE_KEY, SIGNATURE_KEY, FileStorage, Memory, encode
from pmsmtool.sim.node.parameter_set import ParameterImage
from pmsmtool.sim.simulated_machine import device_slope_ohm, settings_of

BLOCKS: tuple[Block, ...] = ("ideal", "timing", "gains")
OTHER = 1_000_000
"""Seed of the motor in a drive's memory, above the drive's."""
PARTIAL = 10
LINES = 12
"""Lines of what a failed command told that are kept."""


def fill_memory(path: Path, drive: MachineFile, other: MachineFile) -> None:
    """Write the memory of a drive that served another motor: its data, the sign of its encoder, its gains."""
    on_this_inverter = replace(other, inverter=drive.inverter)
    image = ParameterImage.of_values(factory_values(drive) | set_up_values(on_this_inverter))
    content = {IMAGE_KEY: image.pack(), SIGNATURE_KEY: struct.pack("<I", layout_signature())}
    for _ in Memory(FileStorage(path)).store(encode(content)):
        pass


def with_devices(drive: MachineFile) -> MachineParameters:
    """Return the machine with the loop as the drive sees it, and its copper part."""
    loop = true_loop_resistance(drive)
    return replace(drive.machine, R_s_ohm=loop, R_winding_ohm=loop - device_slope_ohm(settings_of(drive)))


def seen_factor(drive: MachineFile, name: str) -> float:
    """Return by how much the mean sensor gains alone make a value wrong (1): what no measurement with them can find.

    Currents read ``g_i`` times too large, and voltages, whose duty cycles are shares of the measured link, ``g_u``.
    """
    settings = settings_of(drive)
    g_i = statistics.fmean(settings.number(f"sensor_gain_{phase}") for phase in "abc")
    g_u = settings.number("U_dc_gain")
    if name == "psi_f_wb":
        return g_u
    return g_u * g_i if name == "J_kgm2" else g_u / g_i


def commission_real(seed: int) -> dict[str, Any]:
    """Commission one drive of the *real* population and return what is judged."""
    drive, effects = draw_real(seed, BLOCKS[seed % len(BLOCKS)])
    return commission_one(seed, drive) | {"effects": effects}


def commission_one(seed: int, drive: MachineFile | None = None) -> dict[str, Any]:
    """Commission one drive and return what is judged."""
    drive = draw_drive(seed, BLOCKS[seed % len(BLOCKS)]) if drive is None else drive
    start = time.process_time()
    with prepared():
        Path("drive.toml").write_text(dump_machine_file(drive), encoding="utf-8")
        Path("sheet.toml").write_text(dump_machine_file(data_sheet(drive, seed)), encoding="utf-8")
        fill_memory(Path("held.nv"), drive, draw_drive(seed + OTHER))
        code, told = commanded("commission", "sheet.toml", "-i", "pmsmsim", "-c", "drive.toml?nv=held.nv", "--yes")
        result: dict[str, Any] = {"seed": seed, "code": code, "word": "", "stage": "", "values": {}, "alarms": []}
        for folder in Path("runs").glob("*/"):
            stages = RunDirectory(folder).read().stages
            failed = [s.name for s in stages if s.status not in ("pass", "not available")]
            result |= {"word": verdict(folder).word, "stage": failed[-1] if failed else ""}
            result["alarms"] = [r["name"] for s in stages for r in s.comparison if r["verdict"] == "contradicts"]
            result["refused"] = {name: why for s in stages if s.name == "identify" for name, why in s.refused.items()}
            errors = errors_of(drive, folder)
            found = load_machine_file(folder / "machine.toml").estimates if errors else {}
            settings = settings_of(drive)
            if R_MEASURED in found and not settings.flag("thermal_on"):
                R_true = resistance_at(with_devices(drive), settings.number("T_winding_c"))
                errors[R_MEASURED] = found[R_MEASURED].value / R_true - 1.0
            result["values"] = {
                name: (error, total_half_width(found[name]) / found[name].value) for name, error in errors.items()
            }
            result["seen"] = {name: (1.0 + error) / seen_factor(drive, name) - 1.0 for name, error in errors.items()}
        result["told"] = [] if code == 0 else told.strip().splitlines()[-LINES:]
    return {**result, "seconds": time.process_time() - start}


def commission_wide(seed: int) -> dict[str, Any]:
    """Commission one drive of the *wide* population."""
    return commission_one(seed, draw_wide(seed, BLOCKS[seed % len(BLOCKS)]))


POPULATIONS: dict[str, Callable[[int], dict[str, Any]]] = {
    "clean": commission_one,
    "real": commission_real,
    "wide": commission_wide,
}


def commission_job(seed: int, *, population: str, second: bool) -> dict[str, Any]:
    """Commission one drive of a population, on the project's plant or on the second one."""
    commission = POPULATIONS[population]
    if not second:
        return commission(seed)
    with second_plant.used() as digest:
        return commission(seed) | {"plant": digest}


def ended(result: dict[str, Any]) -> str:
    """Return PASS, PARTIAL or FAIL."""
    return {0: "PASS", PARTIAL: "PARTIAL"}.get(result["code"], "FAIL")


def summary(results: Sequence[dict[str, Any]]) -> list[str]:
    """Return counts, failures, and errors: against their total intervals, absolute, and seen through the true gains."""
    count = Counter(map(ended, results))
    lines = [f"{len(results)} drives: " + ", ".join(f"{count[word]} {word}" for word in ("PASS", "PARTIAL", "FAIL"))]
    lines.append(f"gate false alarms: {sum(bool(result['alarms']) for result in results)}")
    lines.append(
        f"{'quantity':16} {'values':>6} {'median half width %':>19} {'beyond 1x':>9} {'2x':>4} {'3x':>4}"
        f" {'p90 of the error %':>18} {'through the gains':>17}"
    )
    for name in (R_MEASURED, *QUANTITIES):
        pairs = [result["values"][name] for result in results if name in result["values"]]
        if pairs:
            ratios = [abs(error) / half for error, half in pairs]
            beyond = [sum(ratio > times for ratio in ratios) for times in (1, 2, 3)]
            width = 100.0 * statistics.median(half for _, half in pairs)
            lines.append(
                f"{name:16} {len(pairs):6d} {width:19.2f} {beyond[0]:9d} {beyond[1]:4d} {beyond[2]:4d}"
                f" {_p90([error for error, _ in pairs]):18.2f}"
                f" {_p90([result['seen'][name] for result in results if name in result.get('seen', {})]):17.2f}"
            )
    for result in sorted(results, key=lambda each: str(each["stage"])):
        if result["code"]:
            lines.append(f"{result['seed']} {ended(result)} exit {result['code']}, {result['stage'] or 'no stage'}:")
            lines += [f"    {name} {level:.3g}" for name, level in result.get("effects", {}).items()]
            lines += [f"    {line}" for line in result["told"]]
    return lines


def _p90(errors: Sequence[float]) -> float:
    """Return the 90th percentile of the absolute errors (%)."""
    return float(100.0 * np.quantile(np.abs(errors), 0.9)) if errors else math.nan


def read_results(path: Path) -> list[dict[str, Any]]:
    """Return the results of a file; one line that was cut off is left out."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [json.loads(line) for line in lines if line.endswith("}")]


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=200)
    parser.add_argument("--first", type=int, default=120_000, help="first seed")
    for flag, text in (
        ("real", "with effects of real machines (real_population.py)"),
        ("wide", "from 5 W to 60 kW (random_drives.draw_wide)"),
    ):
        parser.add_argument(f"--{flag}", dest="population", action="store_const", const=flag, help=text)
    parser.set_defaults(population="clean")
    parser.add_argument("--second-plant", action="store_true", help="motor, shaft and bridge of second_plant/")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--results", type=Path, default=Path("whole_commission.jsonl"))
    asked = parser.parse_args()
    done = {result["seed"] for result in read_results(asked.results)}
    seeds = [seed for seed in range(asked.first, asked.first + asked.drives) if seed not in done]
    if asked.second_plant:
        second_plant.build()
        print(f"second plant, sha256 of its sources {second_plant.digest()}", flush=True)
    commission = functools.partial(commission_job, population=asked.population, second=asked.second_plant)
    with multiprocessing.Pool(asked.processes, maxtasksperchild=1) as pool, asked.results.open("a") as file:
        for result in pool.imap_unordered(commission, seeds, chunksize=1):
            file.write(json.dumps(result) + "\n")
            file.flush()
            print(f"{result['seed']} {ended(result)} {result['stage']} {result['seconds']:.0f} s", flush=True)
    print("\n".join(summary(read_results(asked.results))))


if __name__ == "__main__":
    main()
