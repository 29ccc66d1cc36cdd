# SPDX-License-Identifier: MIT
"""Machine time of ``identify`` on random drives, without and with ``--accuracy``; one process.

    nice -n 5 python -m benchmarks.machine_time --drives 12 --first 880211

Machine time is that of the bus clock from consent to the restored drive, all default quantities. Printed per accuracy:
median and largest time, errors, how often the total 95 % interval holds the truth, the statistical half widths, how
often the accuracy was said to be reached, and the half width that was found over the one that was predicted.

Of these 12 drives (block timing) at an earlier state, seconds of machine time, relative errors and statistical 95 %
half widths in percent, the largest of the drives; R at the temperature of the measurement:

    asked     median  largest   error: R    L     psi    half width: R    L     psi   truth in total 95 %
    nothing    45.6    50.2        0.11   0.08   0.12           0.30   0.25   0.32    60 of 60
    0.03       31.1    34.0        0.16   0.13   0.13           0.45   0.36   0.32    60 of 60
    0.01       31.1    34.0        0.16   0.13   0.13           0.45   0.36   0.32    60 of 60

Both shares get the least effort, which leaves twice the accuracy of 1 %. What is left is no matter of how much is
collected: the seconds by experiment are printed, too.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from benchmarks.identification_coverage import drawn
from benchmarks.random_drives import true_loop_resistance
from pmsmtool.bus.connect import connect
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.errors import PmsmtoolError
from pmsmtool.estimators.estimate import COVERAGE_FACTOR
from pmsmtool.estimators.resistance import R_MEASURED
from pmsmtool.identification.request import PREDICTED, IdentifyRequest, accuracy_told
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.measurement.identify import identify
from pmsmtool.run_directory import RunDirectory, Stage, new_record
from pmsmtool.sim.simulated_machine import device_slope_ohm, settings_of

NAMES = (R_MEASURED, "L_d_h", "L_q_h", "psi_f_wb", "J_kgm2", "B_nms", "tau_c_nm")
Row = dict[str, Any]


EXPERIMENTS = {
    "noise": "noise",
    "phases": "phases, current limit, first turn",
    "R and inverter": "levels",
    "pairs": "pairs of phases",
    "pole pairs": "slow turn",
    "L_d, L_q": "square waves",
    "flux and inertia": "pushes, speed limit",
    "psi_f": "speeds",
    "J, B, tau_c": "mechanics",
}
"""Experiments by the beginning of what is said of them."""


def identified(
    drive_file: MachineFile, accuracy: float | None, folder: Path
) -> tuple[Stage, dict[str, float], dict[str, float]]:
    """Identify a simulated drive; return stage, predicted standard deviations (1) and seconds by experiment (s)."""
    path = folder / "drive.toml"
    path.write_text(dump_machine_file(drive_file), encoding="utf-8")
    run = RunDirectory.create(folder, 1, new_record(["benchmark"], drive={}, bus={}, versions={}))
    with connect("pmsmsim", f"{path}?nv=:memory:") as connection:
        drive = CanopenDrive(connection, 1)
        request = IdentifyRequest(accuracy=accuracy)
        clock, spent = connection.clock, defaultdict[str, float](float)
        experiment, since = "start", connection.clock.now()

        def say(text: str) -> None:
            nonlocal experiment, since
            begun = next((name for begin, name in EXPERIMENTS.items() if text.startswith(begin)), experiment)
            spent[experiment] += clock.now() - since
            experiment, since = begun, clock.now()

        stage = identify(run, drive, request, lambda _: None, say)
        drive.close()
    entries = json.loads((run.path / PREDICTED).read_text(encoding="utf-8"))["predictions"]
    return stage, {key: value for entry in entries for key, value in entry["relative_std"].items()}, dict(spent)


def row_of(seed: int, block: str, accuracy: float | None) -> Row:
    """Identify one drive; return time, errors and half widths, all relative to the truth."""
    drive_file = drawn("", seed, block)
    settings = settings_of(drive_file)
    truth = {name: settings.number(name) for name in NAMES if name != R_MEASURED}
    devices, machine = device_slope_ohm(settings), drive_file.machine
    warm = 1.0 + machine.alpha_R_per_k * (settings.number("T_winding_c") - machine.T_ref_c)
    truth[R_MEASURED] = devices + warm * (true_loop_resistance(drive_file) - devices)
    row: Row = {"seed": seed, "accuracy": accuracy}
    with tempfile.TemporaryDirectory() as folder:
        try:
            stage, predicted, row["spent"] = identified(drive_file, accuracy, Path(folder))
        except PmsmtoolError as error:
            return {**row, "refused": getattr(error, "reason", type(error).__name__)}
    told = accuracy_told(stage.values).values()
    row |= {"seconds": stage.seconds, "status": stage.status, "missing": sorted(stage.refused)}
    row["reached"] = all(fact["reached"] for fact in told)
    for value in stage.values:
        name = value["name"]
        if name in NAMES and value["accepted"]:
            row[name] = {
                "error": value["value"] / truth[name] - 1.0,
                "statistical": value["statistical_95"] / truth[name],
                "total": value["total_95"] / truth[name],
                "predicted": COVERAGE_FACTOR * predicted.get("R_s_ohm" if name == R_MEASURED else name, math.nan),
            }
    return row


def table(rows: list[Row]) -> str:
    """Return what the rows of one accuracy say."""
    done = [row for row in rows if "seconds" in row]
    times = np.array([row["seconds"] for row in done])
    lines = [
        f"{len(done)} of {len(rows)} drives; machine time: median {np.median(times):.1f} s, "
        f"p95 {np.quantile(times, 0.95):.1f} s, largest {np.max(times):.1f} s",
        f"status {dict(Counter(row['status'] for row in done))}, accuracy reached: {sum(r['reached'] for r in done)}",
        "experiment: median, p95: "
        + "; ".join(
            f"{name} {np.median(part):.1f}, {np.quantile(part, 0.95):.1f} s"
            for name in ("start", *EXPERIMENTS.values())
            if any(part := [row["spent"].get(name, 0.0) for row in done])
        ),
        "quantity          error: median      p90      max  in total, statistical 95 %  half width: median     max  "
        "over predicted: median, max",
    ]
    for name in NAMES:
        mine = [row[name] for row in done if name in row]
        error, statistical = (100.0 * np.abs([one[key] for one in mine]) for key in ("error", "statistical"))
        ratio = [one["statistical"] / one["predicted"] for one in mine]
        hits = [sum(abs(one["error"]) <= one[key] for one in mine) for key in ("total", "statistical")]
        lines.append(
            f"{name:17s} {np.median(error):11.3f} % {np.quantile(error, 0.9):6.3f} % {np.max(error):6.3f} %"
            f"  {hits[0]:3d}, {hits[1]:3d} of {len(mine):<3d}"
            f"  {np.median(statistical):24.3f} % {np.max(statistical):6.3f} % "
            f"{np.nanmedian(ratio):6.2f}, {np.nanmax(ratio):.2f}"
        )
    return "\n".join(lines)


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drives", type=int, default=12, help="number of drives")
    parser.add_argument("--first", type=int, default=880211, help="first seed")
    parser.add_argument("--block", choices=["ideal", "timing", "gains"], default="timing")
    parser.add_argument("--accuracy", type=float, nargs="*", default=[0.0, 0.03, 0.01], help="0: without")
    parser.add_argument("--rows", action="store_true", help="one JSON line per identification, too")
    chosen = parser.parse_args()
    found: dict[float, list[Row]] = {accuracy: [] for accuracy in chosen.accuracy}
    for seed in range(chosen.first, chosen.first + chosen.drives):
        for accuracy, rows in found.items():
            rows.append(row_of(seed, chosen.block, accuracy or None))
            if chosen.rows:
                print(json.dumps(rows[-1]), flush=True)
    for accuracy, rows in found.items():
        print(f"== {f'--accuracy {accuracy:g}' if accuracy else 'without'}, block {chosen.block}")
        print(table(rows))


if __name__ == "__main__":
    main()
