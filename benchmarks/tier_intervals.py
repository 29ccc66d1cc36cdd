"""Identify random drives at the tiers without injection and say how wide and how true the printed intervals are.

    python -m benchmarks.tier_intervals standard --drives 40 --first 100
    python -m benchmarks.tier_intervals recorder --drives 40 --first 100

Drives follow from their seeds (``workflow/random_drives.py``). The simulated node has the objects of its tier only:
``drive=cia402`` with the master's commutation angle, or the reference drive without excitation (``tier=recorder``).
Seeds 0 to 9 and 100 to 139 were looked at while the recorder's estimator was made. Every estimate is printed on stderr
as error and half width (relative, or in deg).
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections import Counter
from pathlib import Path

from benchmarks.identification_coverage import clopper_pearson
from pmsmtool.bus.connect import connect
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.standard_drive import RecorderDrive, StandardDrive
from pmsmtool.errors import PmsmtoolError
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.firmware.shipped_maps import load_family
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.sim.simulated_machine import Settings, device_slope_ohm
from pmsmtool.workflow.random_drives import draw_drive
from pmsmtool.workflow.tier_identify import HEADROOM, TierResult, identify_recorder, identify_standard

CHANNELS = {"standard": "&drive=cia402", "recorder": "&tier=recorder"}


def truth_of(drive: MachineFile) -> dict[str, float]:
    """Return what the estimates should be, at the temperature of the run."""
    values = Settings(drive.simulation_settings())
    devices = device_slope_ohm(values)
    rise, magnets = (values.number(f"T_{part}_c") - drive.machine.T_ref_c for part in ("winding", "magnet"))
    return {
        "pole_pairs": values.number("pole_pairs"),
        "direction": -1.0 if values.flag("encoder_reversed") else 1.0,
        "offset_rad": values.number("encoder_offset_rad"),
        "frame_offset_rad": 0.0,
        "L_q_app_h": values.number("L_q_h"),
        "psi_f_wb": values.number("psi_f_wb") * (1.0 + drive.machine.alpha_psi_per_k * magnets),
        "R_s_ohm": devices + (values.number("R_s_ohm") - devices) * (1.0 + drive.machine.alpha_R_per_k * rise),
    }


def identify(tier: str, drive: MachineFile, path: Path) -> TierResult:
    """Run one drive."""
    machine = drive.machine
    envelope = Envelope(
        i_max_apk=HEADROOM * (machine.I_nom_apk or 1.0),
        speed_max_rad_s=(machine.n_max_rpm or 1000.0) * math.pi / 30.0,
        duration_s=600.0,
    )
    with connect("pmsmsim", f"{path}?nv=:memory:{CHANNELS[tier]}") as connection:
        if tier == "standard":
            return identify_standard(StandardDrive(connection, 1, drive_map=load_family("cia402")), envelope)
        return identify_recorder(RecorderDrive(connection, 1), envelope)


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tier", choices=sorted(CHANNELS))
    parser.add_argument("--drives", type=int, default=40)
    parser.add_argument("--first", type=int, default=100)
    options = parser.parse_args()
    errors: dict[str, list[tuple[float, float]]] = {}
    refused: Counter[str] = Counter()
    for seed in range(options.first, options.first + options.drives):
        drive = draw_drive(seed)
        truth = truth_of(drive)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "drive.toml"
            path.write_text(dump_machine_file(drive), encoding="utf-8")
            try:
                result = identify(options.tier, drive, path)
            except PmsmtoolError as error:
                refused[getattr(error, "reason", type(error).__name__)] += 1
                continue
        refused.update(f"{name} not told" for name in result.missing)
        for name, estimate in result.estimates.items():
            off, scale = estimate.value - truth[name], abs(truth[name])
            if estimate.unit == "rad":
                off, scale = math.remainder(off, 2.0 * math.pi), math.radians(1.0)
            errors.setdefault(name, []).append((abs(off) / scale, total_half_width(estimate) / scale))
            print(f"{seed} {name} {off / scale:+.5f} +- {total_half_width(estimate) / scale:.5f}", file=sys.stderr)
    print(f"{options.tier}: {options.drives} drives from seed {options.first}; refused: {dict(refused)}")
    print("quantity           n   error: median    p90      max   half width: median   p90    covered")
    for name, rows in errors.items():
        unit, factor = ("deg", 1.0) if name.endswith("_rad") else ("%", 100.0)
        sizes, half = sorted(row[0] * factor for row in rows), sorted(row[1] * factor for row in rows)
        n = len(rows)
        p90 = round(0.9 * (n - 1))
        hits = sum(row[0] <= row[1] + 1e-12 for row in rows)
        low, high = clopper_pearson(hits, n)
        print(
            f"{name:17s} {n:3d}  {sizes[n // 2]:9.3f} {sizes[p90]:8.3f} {sizes[-1]:8.3f} {unit:3s} {half[n // 2]:9.3f} "
            f"{half[p90]:8.3f}   {hits}/{n} ({low:.3f} .. {high:.3f})"
        )


if __name__ == "__main__":
    main()
