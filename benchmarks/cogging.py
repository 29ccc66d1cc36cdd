# SPDX-License-Identifier: MIT
"""Cogging and harmonics of the back-EMF of drawn machines: error of amplitude and phase, and whether intervals cover.

    python -m benchmarks.cogging --drives 20 --first 91000 --results cogging.jsonl

Drives of ``random_drives.py`` get cogging of 0.3 to 5 % of rated torque at the least common multiple of slots and
poles, a 5th of 0.5 to 5 % and a 7th of 0.3 to 3 % of the back-EMF, both drawn evenly over the logarithm. The whole of
`identify --yes` runs over frames. A target is met within 10 % or 0.1 % of rated torque (of the fundamental), and 5
degrees. Marks behind a row: X and P where amplitude and phase miss it, ! where their interval does not cover. With
``--real`` the drives are those of ``benchmarks/real_population.py``, with their other effects. ``--replay`` evaluates
the kept runs anew; ``--table`` only prints. With ``--way 180`` a drive with the objects of ``--face`` moves by that
angle and back instead, `move --cogging` with the machine's own file.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.commissioning import commanded, prepared
from benchmarks.random_drives import draw_drive
from benchmarks.real_effects import EFFECTS, truth_of
from benchmarks.real_population import draw_real
from pmsmtool.errors import PmsmtoolError
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.files import data_folder
from pmsmtool.identification.replay import replay
from pmsmtool.identification.request import MACHINE
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.machine.parameters import Estimate
from pmsmtool.run_directory import RunDirectory
from pmsmtool.sim.simulated_machine import settings_of

COGGING, FIFTH, SEVENTH = (0.3, 5.0), (0.5, 5.0), (0.3, 3.0)
"""Ranges (% of rated torque; % of the back-EMF's fundamental)."""
AMPLITUDE_SHARE, OF_RATED, PHASE_DEG = 0.10, 0.001, 5.0


def drive_of(name: str, cogging: float | None = None, emf: float = 1.0) -> MachineFile:
    """Return ``random-<seed>``, ``real-<seed>`` or a profile, with effects; ``cogging`` in % instead of the drawn."""
    kind, _, number = name.partition("-")
    seed = int(number) if kind in ("random", "real") else 0
    if kind == "random":
        drive = draw_drive(seed)
    elif kind == "real":
        drive = draw_real(seed)[0]
    else:
        drive = load_machine_file(data_folder("profiles") / f"{name}.toml")
    rng = np.random.default_rng([20261124, seed])
    levels = [math.exp(rng.uniform(math.log(low), math.log(high))) for low, high in (COGGING, FIFTH, SEVENTH)]
    changes = EFFECTS["cogging %"][0](drive, levels[0] if cogging is None else cogging)
    psi = truth_of(drive, "psi_f_wb")
    changes |= {"psi_6_wb": emf * 0.01 * levels[1] * psi / 5.0, "psi_7_wb": emf * 0.01 * levels[2] * psi / 7.0}
    return replace(drive, simulation={**drive.simulation, **changes})


def truths_of(drive: MachineFile) -> dict[str, tuple[float, float, float]]:
    """Return amplitude, phase (rad) and what counts as rated of every ripple."""
    values = settings_of(drive)
    p, psi = values.number("pole_pairs"), values.number("psi_f_wb")
    rated = 1.5 * p * psi * float(drive.machine.I_nom_apk or 1.0)
    order = round(values.number("cogging_periods"))
    phase = order * values.number("encoder_offset_rad") / p - 0.5 * math.pi
    found = {f"cogging_{order}": (values.number("cogging_nm"), phase, rated)}
    warm = 1.0 + values.number("alpha_psi_per_k") * (values.number("T_magnet_c") - drive.machine.T_ref_c)
    # harmonics follow the magnets' temperature, as in the plant (sim/plant_point.h)
    found["psi_5"] = (values.number("psi_6_wb") * warm, 0.0, psi * warm / 5.0)
    found["psi_7"] = (values.number("psi_7_wb") * warm, 0.0, psi * warm / 7.0)
    return found


def judged(drive: MachineFile, estimates: dict[str, Estimate], moved: bool = False) -> dict[str, Any]:
    """Return of every ripple: truth and error of rated (%), half width (%), error and half width of the phase (deg).

    ``moved``: angle and torque are those that the drive shows, which an encoder may count against the phase order.
    """
    rows: dict[str, Any] = {}
    against = moved and drive.simulation.get("encoder_reversed", False) != drive.simulation.get("leads_swapped", False)
    for name, (amplitude, phase, rated) in truths_of(drive).items():
        phase = -phase - math.pi if against else phase
        unit = "nm" if name.startswith("cogging") else "wb"
        found, angle = estimates.get(f"{name}_{unit}"), estimates.get(f"{name}_rad")
        row = {"truth": 100.0 * amplitude / rated}
        if found is not None:
            row |= {
                "error": 100.0 * (found.value - amplitude) / rated,
                "half": 100.0 * total_half_width(found) / rated,
                "met": abs(found.value - amplitude) < max(AMPLITUDE_SHARE * amplitude, OF_RATED * rated),
            }
        if angle is not None:
            row |= {
                "phase": math.degrees(math.remainder(angle.value - phase, 2.0 * math.pi)),
                "phase_half": math.degrees(total_half_width(angle)),
            }
        rows[name.split("_")[0] if unit == "nm" else name] = row
        if unit == "nm" and found is None and "cogging_nm" in estimates:
            row["floor"] = 100.0 * total_half_width(estimates["cogging_nm"]) / rated
    return rows


def identify_one(name: str, keep: Path, again: bool, cogging: float | None, emf: float) -> dict[str, Any]:
    """Identify one machine, or replay its run."""
    drive = drive_of(name, cogging, emf)
    kept = keep.resolve() / f"{name}_{'drawn' if cogging is None else f'{cogging:g}'}"
    result: dict[str, Any] = {"name": name, "cogging": cogging, "code": 0, "told": "", "refused": {}, "rows": {}}
    start = time.process_time()
    with prepared():
        if again:
            if not kept.is_dir():
                return {**result, "code": -1, "told": "no run"}
            shutil.copytree(kept, "run")
            folder = Path("run")
            try:
                stage = replay(RunDirectory(folder))
                result["refused"] = dict(stage.refused)
            except PmsmtoolError as error:
                return {**result, "code": 6, "told": str(error)}
        else:
            Path("drive.toml").write_text(dump_machine_file(drive, embed_flux_map=True), encoding="utf-8")
            what = ("mechanics", "R", "L", "psi", "encoder", "cogging", "harmonics")
            code, told = commanded("identify", *what, "-i", "pmsmsim", "-c", "drive.toml", "--yes")
            result |= {"code": code, "told": told.strip().splitlines()[-4:] if code else ""}
            folders = list(Path("runs").glob("*/"))
            if not folders:
                return result
            (folder,) = folders
            stages = [stage for stage in RunDirectory(folder).read().stages if stage.name == "identify"]
            result["refused"] = dict(stages[-1].refused) if stages else {}
            result["machine_s"] = stages[-1].seconds if stages else 0.0
            shutil.rmtree(kept, ignore_errors=True)
            shutil.copytree(folder, kept)
        if (folder / MACHINE).is_file():
            result["rows"] = judged(drive, dict(load_machine_file(folder / MACHINE).estimates))
    return {**result, "seconds": time.process_time() - start}


def move_one(name: str, keep: Path, cogging: float | None, emf: float, way_deg: float, face: str) -> dict[str, Any]:
    """See a part of a turn by slow moves of a drive of another maker."""
    drive = drive_of(name, cogging, emf)
    kept = keep.resolve() / f"{name}_{'drawn' if cogging is None else f'{cogging:g}'}_{way_deg:g}"
    result: dict[str, Any] = {"name": name, "cogging": cogging, "refused": {}, "rows": {}, "told": ""}
    with prepared():
        Path("drive.toml").write_text(dump_machine_file(drive, embed_flux_map=True), encoding="utf-8")
        known = replace(drive, simulation={})
        Path("known.toml").write_text(dump_machine_file(known, embed_flux_map=True), encoding="utf-8")
        simulated = ("--map", face, "--sim", f"{Path('drive.toml').resolve()}?drive={face}&nv={Path('nv').resolve()}")
        code, told = commanded("move", "--by", f"{way_deg:g}deg", "--cogging", "known.toml", *simulated, "--yes")
        result |= {"code": code, "told": told.strip().splitlines()[-4:] if code else ""}
        for folder in Path("runs").glob("*/"):
            if (folder / MACHINE).is_file():
                result["rows"] = judged(drive, dict(load_machine_file(folder / MACHINE).estimates), moved=True)
            shutil.rmtree(kept, ignore_errors=True)
            shutil.copytree(folder, kept)
    return result


def line_of(result: dict[str, Any]) -> str:
    """Return one line of the table."""
    cells = []
    for name in ("cogging", "psi_5", "psi_7"):
        row = result["rows"].get(name)
        if row is None or ("error" not in row and "floor" not in row):
            cells.append(f"{'-':^40}")
        elif "error" not in row:
            cells.append(f"{row['truth']:5.2f} none, floor {row['floor']:6.2f}".ljust(40))
        else:
            mark = (" " if row["met"] else "X") + ("!" if abs(row["error"]) > row["half"] else " ")
            phase = f"{row['phase']:+6.1f}/{row['phase_half']:5.1f}" if "phase" in row else "-".rjust(12)
            if "phase" in row:
                mark += ("P" if abs(row["phase"]) > PHASE_DEG else " ") + (
                    "!" if abs(row["phase"]) > row["phase_half"] else " "
                )
            cells.append(f"{row['truth']:5.2f} {row['error']:+6.3f}/{row['half']:6.3f} {phase} {mark}".ljust(40))
    refused = ", ".join(f"{k}: {v[:60]}" for k, v in result["refused"].items())
    return f"{result['name']:14} {result['code']:3d} {' '.join(cells)} {refused} {result['told'] or ''}"


def summary_of(results: list[dict[str, Any]]) -> str:
    """Return how many amplitudes and phases meet the target, and how many intervals cover."""
    lines = []
    for name in ("cogging", "psi_5", "psi_7"):
        rows = [result["rows"][name] for result in results if name in result["rows"]]
        values = [row for row in rows if "error" in row]
        phases = [row for row in values if "phase" in row]
        none = [row for row in rows if "floor" in row]
        lines.append(
            f"{name:8} {len(results)} drives: {len(values)} values, amplitude met {sum(row['met'] for row in values)}, "
            f"covered {sum(abs(row['error']) <= row['half'] for row in values)}; {len(phases)} phases, met "
            f"{sum(abs(row['phase']) <= PHASE_DEG for row in phases)}, covered "
            f"{sum(abs(row['phase']) <= row['phase_half'] for row in phases)}; none found {len(none)}, of these below "
            f"the stated floor {sum(row['truth'] <= row['floor'] for row in none)}"
        )
    return "\n".join(lines)


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=20)
    parser.add_argument("--first", type=int, default=91000)
    parser.add_argument("--names", nargs="+", help="profiles or random-<seed> instead")
    parser.add_argument("--cogging", type=float, help="%% of rated torque instead of the drawn one")
    parser.add_argument("--emf", type=float, default=1.0, help="factor on the drawn harmonics")
    parser.add_argument("--results", type=Path, default=Path("cogging.jsonl"))
    parser.add_argument("--keep", type=Path, default=Path("cogging_runs"), help="folder that keeps the runs")
    parser.add_argument("--real", action="store_true", help="drives with other effects of real machines")
    parser.add_argument("--way", type=float, help="degrees of a move there and back, instead of an identification")
    parser.add_argument("--face", default="ingenia", help="whose objects the moved drive has")
    parser.add_argument("--replay", action="store_true")
    parser.add_argument("--table", action="store_true")
    asked = parser.parse_args()
    heads = (f"{name + ' % of rated: error/half, deg':40}" for name in ("cogging", "5th", "7th"))
    print(f"{'drive':14} end {' '.join(heads)}")
    if asked.table:
        results = [json.loads(line) for line in asked.results.read_text(encoding="utf-8").splitlines()]
        print("\n".join(map(line_of, results)))
        print(summary_of(results))
        return
    kind = "real" if asked.real else "random"
    names = asked.names or [f"{kind}-{seed}" for seed in range(asked.first, asked.first + asked.drives)]
    results = []
    with asked.results.open("a", encoding="utf-8") as file:
        for name in names:
            if asked.way:
                result = move_one(name, asked.keep, asked.cogging, asked.emf, asked.way, asked.face)
            else:
                result = identify_one(name, asked.keep, asked.replay, asked.cogging, asked.emf)
            file.write(json.dumps(result) + "\n")
            file.flush()
            print(line_of(result), flush=True)
            results.append(result)
    print(summary_of(results))


if __name__ == "__main__":
    main()
