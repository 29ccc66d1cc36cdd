# SPDX-License-Identifier: MIT
"""Let simulated drives identify their machines by themselves and say how far what they answer is from the truth.

    python -m benchmarks.vendor_identification --drives 40 --first 8000

The drives of ``benchmarks/level_intervals.py`` (``random_drives.py``) behind the objects of the synapticon map,
read by ``identify --method vendor``. The values have no interval, so that nothing is judged: the table says what a
simple method on such drives is worth, and that what is stored is what was answered. One inductance stands for both
axes; it is compared with L_d, on which the simulated rotor is held. Every error is printed on stderr.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections import Counter
from pathlib import Path

from benchmarks.level_intervals import truth_of
from benchmarks.random_drives import draw_drive
from pmsmtool.bus.connect import connect
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.vendor_tuning import VendorDrive
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import PmsmtoolError
from pmsmtool.identification.by_vendor import PHASE_INDUCTANCE, vendor_estimates
from pmsmtool.machine.machine_file import dump_machine_file
from pmsmtool.measurement.by_pulses import HEADROOM
from pmsmtool.measurement.by_vendor import identify_vendor

FAMILY = "synapticon"


def errors_of(seed: int) -> dict[str, float]:
    """Return the relative errors of one drive's own identification.

    Raises
    ------
    PmsmtoolError
        As it ends.
    """
    drive = draw_drive(seed)
    truth = truth_of(drive) | {PHASE_INDUCTANCE: float(drive.simulation_settings()["L_d_h"])}  # type: ignore[arg-type]
    envelope = Envelope(
        HEADROOM * (drive.machine.I_nom_apk or 1.0), (drive.machine.n_max_rpm or 1000.0) * math.pi / 30.0
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.toml"
        path.write_text(dump_machine_file(drive), encoding="utf-8")
        with connect("pmsmsim", f"{path}?nv=:memory:&drive={FAMILY}") as connection:
            own = VendorDrive(connection, 1, drive_map=load_family(FAMILY))
            steps = own.tuning.steps_for(own.tuning.quantities, turning=True)
            answers = identify_vendor(own, envelope, steps)
            own.close()
    found = vendor_estimates(own.tuning, {name: answer for answer in answers for name in answer.values})
    return {name: estimate.value / truth[name] - 1.0 for name, estimate in found.items()}


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drives", type=int, default=40)
    parser.add_argument("--first", type=int, default=8000)
    options = parser.parse_args()
    rows: list[dict[str, float]] = []
    failed: Counter[str] = Counter()
    for seed in range(options.first, options.first + options.drives):
        try:
            rows.append(errors_of(seed))
        except PmsmtoolError as error:
            failed[str(error).splitlines()[0]] += 1
            print(f"{seed} {error}", file=sys.stderr)
            continue
        print(f"{seed} " + ", ".join(f"{name} {100.0 * e:+.2f} %" for name, e in rows[-1].items()), file=sys.stderr)
    print(f"{options.drives} drives from seed {options.first}; ended in an error: {dict(failed)}")
    print("quantity       n   error: median    p90       max")
    for name in dict.fromkeys(name for row in rows for name in row):
        sizes = sorted(100.0 * abs(row[name]) for row in rows)
        n = len(sizes)
        print(f"{name:12s} {n:3d}  {sizes[n // 2]:12.2f} {sizes[round(0.9 * (n - 1))]:8.2f} {sizes[-1]:8.2f} %")


if __name__ == "__main__":
    main()
