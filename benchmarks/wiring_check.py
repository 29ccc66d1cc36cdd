# SPDX-License-Identifier: MIT
"""Run `pmsmtool check FILE --yes` on random drives, healthy and miswired, and count right names and false alarms.

    python -m benchmarks.wiring_check --miswired 400 --healthy 200 --first 300000
    python -m benchmarks.wiring_check --level recorder --miswired 130 --healthy 65
    python -m benchmarks.wiring_check --level TABLE.csv#FAMILY --miswired 130 --healthy 65

Drives follow from their seeds (``random_drives.py``); FILE is a data sheet within its tolerances. A miswired
one is named rightly when the first row that is wrong is about what was done to it. Below the full level `not shown`
counts those of which the row is listed as NOT CHECKED and no other is wrong; exit code 0 would be a pass.

The simulated drive of level ``inject`` was set up after it was wired, so that its sign is right: those two kinds are
left out. A motor whose poles the drive of a file cannot hold is left out, too.
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
from benchmarks.random_drives import data_sheet, draw_drive
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.sim.foreign.behind import set_up_of
from pmsmtool.sim.foreign.drive import ForeignDrive
from pmsmtool.sim.foreign.file_rows import read_makers_objects

WIRED: dict[str, tuple[dict[str, object], str]] = {
    "phase a open": ({"phase_open": "a"}, "phases"),
    "phase b open": ({"phase_open": "b"}, "phases"),
    "phase c open": ({"phase_open": "c"}, "phases"),
    "leads swapped": ({"leads_swapped": True}, "encoder sign"),
    "encoder reversed": ({"encoder_reversed": True}, "encoder sign"),
    "shaft held": ({"rotor": "locked"}, "shaft"),
    "sensor gain": ({"sensor_gain_b": 1.25}, "current sensors"),
    "half the voltage": ({"U_dc_v": 0.5}, "supply"),
    "leads touch": ({"drive_fault": "phases_shorted"}, "phases"),
    "supply in limit": ({"drive_fault": "supply_limit"}, "supply"),
    "torque safely off": ({"drive_fault": "safe_torque_off"}, "safe torque off"),
    "encoder signal": ({"drive_fault": "encoder_signal"}, "encoder counts"),
    "encoder stuck": ({"drive_fault": "encoder_stuck"}, "shaft"),
}
"""What is done to the drive, and the row that it belongs to."""
FILED = {
    "pole pairs x2": "pole pairs", "pole pairs /2": "pole pairs", "pole pairs +1": "pole pairs",
    "encoder x4": "encoder counts", "encoder /4": "encoder counts",
}  # fmt: skip
"""What is wrong in FILE."""
KINDS = (*WIRED, *FILED)
LEVELS = {"full": "", "inject": "&level=inject", "recorder": "&level=recorder", "standard": "&drive=cia402"}


def drive_of(seed: int, wired: dict[str, object]) -> MachineFile:
    """Return a drive whose leads and encoder are right but for what is done to it."""
    drive = draw_drive(seed, ("ideal", "timing", "gains")[seed % 3])
    changes = dict(wired)
    if "U_dc_v" in changes:
        changes["U_dc_v"] = 0.5 * drive.inverter.U_dc_v
    simulation = {**drive.simulation, "leads_swapped": False, "encoder_reversed": False, **changes}
    return replace(drive, simulation=simulation)  # type: ignore[arg-type]


def holds_poles(seed: int, level: str) -> bool:
    """Whether the drive of a file can be set up for a seed's motor; any level of the reference drive can."""
    return level in LEVELS or not ForeignDrive(read_makers_objects(level), set_up_of(drive_of(seed, {}))).too_few_poles


def examine(job: tuple[int, str, str]) -> tuple[int, str, str, int, str, bool]:
    """Check one drive; return seed, kind, first wrong row, exit code, the table, and whether the row is not shown."""
    import contextlib
    import io

    from pmsmtool.cli.main import run

    seed, kind, level = job
    wired = WIRED[kind][0] if kind in WIRED else {}
    drive = drive_of(seed, wired)
    sheet = data_sheet(drive, seed)
    if kind in FILED:
        sheet = wrong_file(sheet, kind)
    with prepared():
        Path("drive.toml").write_text(dump_machine_file(drive), encoding="utf-8")
        Path("sheet.toml").write_text(dump_machine_file(sheet), encoding="utf-8")
        printed, told = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(told):
            shown = LEVELS.get(level, f"&eds={level}")
            code = run(
                ("-i", "pmsmsim", "-c", f"drive.toml?nv=:memory:{shown}", "check", "sheet.toml", "--yes", "--json")
            )
    text = printed.getvalue()
    rows = json.loads(text)["findings"] if text.strip() else []
    first = next((row["looked_at"] for row in rows if row["verdict"] == "WRONG"), "")
    due = WIRED[kind][1] if kind in WIRED else FILED.get(kind, "")
    unseen = any(row["looked_at"] == due and row["verdict"] == "NOT CHECKED" for row in rows)
    table = "; ".join(f"{r['looked_at']} {r['verdict']} {r['shown']}" for r in rows)
    return seed, kind, first, code, table or told.getvalue()[-300:], unseen


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--miswired", type=int, default=400)
    parser.add_argument("--healthy", type=int, default=200)
    parser.add_argument("--first", type=int, default=300_000, help="first seed")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--level", default="full", help="full, inject, recorder, standard, or an EDS or TABLE#FAMILY")
    asked = parser.parse_args()
    kinds = [kind for kind in KINDS if asked.level != "inject" or WIRED.get(kind, ({}, ""))[1] != "encoder sign"]
    jobs = [(asked.first + k, kinds[k % len(kinds)], asked.level) for k in range(asked.miswired)]
    jobs += [(asked.first + asked.miswired + k, "healthy", asked.level) for k in range(asked.healthy)]
    jobs = [job for job in jobs if holds_poles(job[0], asked.level)]
    right, of, unshown = Counter[str](), Counter[str](), Counter[str]()
    passed = 0
    good = (0,) if asked.level in ("full", "inject") else (10,)
    with multiprocessing.Pool(asked.processes, maxtasksperchild=4) as pool:
        for seed, kind, first, code, rows, unseen in pool.imap_unordered(examine, jobs):
            due = WIRED[kind][1] if kind in WIRED else FILED.get(kind, "")
            of[kind] += 1
            named = first == due and (code in good) == (kind == "healthy")
            right[kind] += named
            unshown[kind] += unseen and not first
            passed += kind != "healthy" and code == 0
            if not named and not (unseen and not first):
                print(f"{seed} {kind}: exit {code}, first {first!r}: {rows}", flush=True)
    for kind, count in of.items():
        print(f"{kind:18} {right[kind]:4d} of {count}" + (f", not shown {unshown[kind]}" if unshown[kind] else ""))
    miswired = sum(count for kind, count in of.items() if kind != "healthy")
    named_all = sum(count for kind, count in right.items() if kind != "healthy")
    print(f"miswired: {named_all} of {miswired} named rightly, {sum(unshown.values())} not shown, {passed} passed")
    print(f"healthy: {of['healthy'] - right['healthy']} of {of['healthy']} false alarms")


if __name__ == "__main__":
    main()
