"""Identify inertia and friction of random drives over CANopen frames, and say how far off they are.

    python -m benchmarks.mechanics_accuracy --drives 30

Drives follow from their seeds (``workflow/random_drives.py``, switched inverter); the tool sees their nameplate only.

Measured with ``--drives 6`` and ``--drives 8 --first 6``: 12 of 14 accepted (one E_MODEL_MISMATCH, one drive fault),
J, tau_c and B off by at most 0.31 %, every interval holds its truth. The error is that of the torque's scale: what a
sample of a switched current differs from its mean.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from pathlib import Path

from benchmarks.identification_coverage import clopper_pearson
from pmsmtool.bus.connect import connect
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.guard import guarded
from pmsmtool.errors import PmsmtoolError
from pmsmtool.estimators.estimate import statistical_half_width
from pmsmtool.machine.machine_file import dump_machine_file
from pmsmtool.sim.simulated_machine import settings_of
from pmsmtool.trace import Trace
from pmsmtool.workflow.evaluate import evaluate
from pmsmtool.workflow.identify import IdentifyRequest, envelope_of, nameplate_of
from pmsmtool.workflow.measure import Limits, Measurement
from pmsmtool.workflow.random_drives import draw_drive

KEYS = ("J_kgm2", "tau_c_nm", "B_nms")


def identify_one(seed: int) -> dict[str, tuple[float, bool]]:
    """Return the relative error of each value and whether its statistical 95 % interval holds the truth."""
    drive_file = draw_drive(seed)
    traces: dict[str, Trace] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.toml"
        path.write_text(dump_machine_file(drive_file), encoding="utf-8")
        with connect("pmsmsim", f"{path}?nv=:memory:") as connection:
            drive = CanopenDrive(connection, 1)
            nameplate = nameplate_of(drive, "random")
            request = IdentifyRequest(("mechanics",))
            envelope = envelope_of(nameplate, request)
            I_nom = nameplate.machine.I_nom_apk or envelope.i_max_apk
            limits = Limits(I_nom, envelope.i_max_apk, envelope.speed_max_rad_s, nameplate.inverter.V_max_v)
            with guarded(drive, envelope) as guard:
                Measurement(guard, limits, traces.__setitem__, lambda text: None).run(request.quantities)
            drive.close()
    inverter = nameplate.inverter
    found = evaluate(traces, inverter.T_s, T_ref_c=nameplate.machine.T_ref_c, U_dc_v=inverter.U_dc_v).estimates()
    settings = settings_of(drive_file)
    row = {}
    for key in KEYS:
        truth = settings.number(key)
        error = found[key].value - truth
        row[key] = (error / truth, abs(error) <= statistical_half_width(found[key]))
    return row


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drives", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    options = parser.parse_args()
    rows, refused = [], Counter[str]()
    for seed in range(options.first, options.first + options.drives):
        try:
            rows.append(identify_one(seed))
        except PmsmtoolError as error:
            refused[getattr(error, "reason", type(error).__name__)] += 1
    print(f"{options.drives} drives, {len(rows)} accepted, refused: {dict(refused) or 'none'}")
    for key in KEYS if rows else ():
        errors = sorted(100.0 * abs(row[key][0]) for row in rows)
        hits = sum(row[key][1] for row in rows)
        low, high = clopper_pearson(hits, len(rows))
        median, p90 = errors[len(errors) // 2], errors[min(len(errors) - 1, round(0.9 * (len(errors) - 1)))]
        print(
            f"{key:9s} median {median:.3f} %  p90 {p90:.3f} %  max {errors[-1]:.3f} %  "
            f"in 95 % interval {hits}/{len(rows)} ({low:.2f} .. {high:.2f})"
        )


if __name__ == "__main__":
    main()
