# SPDX-License-Identifier: MIT
"""Run `pmsmtool check FILE --yes` on random drives, healthy and miswired, and count right names and false alarms.

    python -m benchmarks.wiring_check --miswired 400 --healthy 200 --first 300000

Drives follow from their seeds (``sim/random_drives.py``); FILE is a data sheet within its tolerances. A miswired
one is named rightly when the first row that is wrong is about what was done to it.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections import Counter
from dataclasses import replace
from pathlib import Path

from benchmarks.commissioning import prepared
from benchmarks.motor_files import wrong_file
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.sim.random_drives import data_sheet, draw_drive

WIRED: dict[str, tuple[dict[str, object], str]] = {
    "phase a open": ({"phase_open": "a"}, "phases"),
    "phase b open": ({"phase_open": "b"}, "phases"),
    "phase c open": ({"phase_open": "c"}, "phases"),
    "leads swapped": ({"leads_swapped": True}, "encoder sign"),
    "encoder reversed": ({"encoder_reversed": True}, "encoder sign"),
    "shaft held": ({"rotor": "locked"}, "shaft"),
    "sensor gain": ({"sensor_gain_b": 1.25}, "current sensors"),
    "half the voltage": ({"U_dc_v": 0.5}, "supply"),
}
"""What is done to the drive, and the row that it belongs to."""
FILED = {
    "pole pairs x2": "pole pairs", "pole pairs /2": "pole pairs", "pole pairs +1": "pole pairs",
    "encoder x4": "encoder counts", "encoder /4": "encoder counts",
}  # fmt: skip
"""What is wrong in FILE."""
KINDS = (*WIRED, *FILED)


def drive_of(seed: int, wired: dict[str, object]) -> MachineFile:
    """Return a drive whose leads and encoder are right but for what is done to it."""
    drive = draw_drive(seed, ("ideal", "timing", "gains")[seed % 3])
    changes = dict(wired)
    if "U_dc_v" in changes:
        changes["U_dc_v"] = 0.5 * drive.inverter.U_dc_v
    simulation = {**drive.simulation, "leads_swapped": False, "encoder_reversed": False, **changes}
    return replace(drive, simulation=simulation)  # type: ignore[arg-type]


def examine(job: tuple[int, str]) -> tuple[int, str, str, int, str]:
    """Check one drive; return seed, kind, the first row that is wrong, exit code and the table."""
    import contextlib
    import io

    from pmsmtool.cli.main import run

    seed, kind = job
    wired = WIRED[kind][0] if kind in WIRED else {}
    drive = drive_of(seed, wired)
    sheet = data_sheet(drive, seed)
    if kind in FILED:
        sheet = wrong_file(sheet, kind)
    with prepared():
        Path("drive.toml").write_text(dump_machine_file(drive), encoding="utf-8")
        Path("sheet.toml").write_text(dump_machine_file(sheet), encoding="utf-8")
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()):
            code = run(("-i", "pmsmsim", "-c", "drive.toml?nv=:memory:", "check", "sheet.toml", "--yes", "--json"))
    text = printed.getvalue()
    rows = json.loads(text)["findings"] if text.strip() else []
    first = next((row["looked_at"] for row in rows if row["verdict"] == "WRONG"), "")
    return seed, kind, first, code, "; ".join(f"{r['looked_at']} {r['verdict']} {r['shown']}" for r in rows)


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--miswired", type=int, default=400)
    parser.add_argument("--healthy", type=int, default=200)
    parser.add_argument("--first", type=int, default=300_000, help="first seed")
    parser.add_argument("--processes", type=int, default=2)
    asked = parser.parse_args()
    jobs = [(asked.first + k, KINDS[k % len(KINDS)]) for k in range(asked.miswired)]
    jobs += [(asked.first + asked.miswired + k, "healthy") for k in range(asked.healthy)]
    right, of = Counter[str](), Counter[str]()
    passed = 0
    with multiprocessing.Pool(asked.processes, maxtasksperchild=4) as pool:
        for seed, kind, first, code, rows in pool.imap_unordered(examine, jobs):
            due = WIRED[kind][1] if kind in WIRED else FILED.get(kind, "")
            of[kind] += 1
            right[kind] += first == due and (code == 0) == (kind == "healthy")
            passed += kind != "healthy" and code == 0
            if first != due or (kind == "healthy" and code):
                print(f"{seed} {kind}: exit {code}, first {first!r}: {rows}", flush=True)
    for kind, count in of.items():
        print(f"{kind:18} {right[kind]:4d} of {count}")
    miswired = sum(count for kind, count in of.items() if kind != "healthy")
    named = sum(count for kind, count in right.items() if kind != "healthy")
    print(f"miswired: {named} of {miswired} named rightly, {passed} passed")
    print(f"healthy: {of['healthy'] - right['healthy']} of {of['healthy']} false alarms")


if __name__ == "__main__":
    main()
