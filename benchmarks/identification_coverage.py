# SPDX-License-Identifier: MIT
"""Identify many random drives over CANopen frames and say how often the truth lies in the printed interval.

    python -m benchmarks.identification_coverage --drives 200 --around jercic-2017 interior-2k2 \
        saturated-pmsyrm measured-map
    python -m benchmarks.identification_coverage --drives 400 --block timing
    python -m benchmarks.identification_coverage --drives 100 --first 10000 --hard
    python -m benchmarks.identification_coverage --drives 400 --keep FOLDER --measure-only
    python -m benchmarks.identification_coverage --drives 400 --keep FOLDER --bridge 0.2

Drives follow from their seeds (``random_drives.py``); the tool sees their nameplate only. Printed per
quantity: error quantiles, how often the statistical and the total (printed) 95 % interval holds the truth, with its
Clopper-Pearson interval, and every refusal by name. ``R_at_T_ohm`` is the loop at the temperature of the measurement:
the share of devices and copper, which no experiment sees, enters ``R_s_ohm`` only. The thresholds of the bridge's
devices act as another DC link, which no current shows either: psi_f is told with and without them. ``--bridge`` has
their data sheet say so (``identify --cal bridge=...``), off by what its tolerance says.

With ``--keep`` the traces are kept, 0.6 MB a drive, and read from there when they are there already: a run that was
interrupted goes on, and changed estimators are judged in a sixth of the time.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import math
import multiprocessing
import pickle
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.commissioning import drive_of
from benchmarks.random_drives import draw_around, draw_drive, true_loop_resistance
from pmsmtool.bus.connect import connect
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.guard import guarded
from pmsmtool.errors import PmsmtoolError
from pmsmtool.estimators.estimate import COVERAGE_FACTOR, SensorTolerance, statistical_half_width, total_half_width
from pmsmtool.identification.evaluate import Evaluation, evaluate
from pmsmtool.identification.request import IdentifyRequest
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.measurement.by_injection import envelope_of, nameplate_of
from pmsmtool.measurement.limits import Limits
from pmsmtool.measurement.measure import Measurement
from pmsmtool.sim.simulated_machine import device_slope_ohm, settings_of
from pmsmtool.trace import Trace

QUANTITIES = ("R_at_T_ohm", "R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb", "offset_rad")
ELECTRICAL = ("R", "L", "psi", "encoder", "poles", "inverter")
"""What is identified here; mechanics has a program of its own (``benchmarks/mechanics_accuracy.py``)."""
HARD_RATIO = 3.0
"""Dead-time voltage over R I_nom from which a drive is of the hard class of the resistance."""
BUS_TIME_S = 60.0
"""Time on the bus that the electrical identification is to keep to."""
DATA_SHEET = 1
"""Beside the seed of a drive: what its data sheet is off by."""
DRAWN_SPREAD = 0.10
"""Spread of the drives around a profile (standard deviation of the log of each parameter)."""


def truth_of(drive: MachineFile, evaluation: Evaluation) -> dict[str, float]:
    """Return what the estimates should be: of a saturated machine the incremental values at the printed bias."""
    values = settings_of(drive)
    truth = {name: values.number(name) for name in ("L_d_h", "L_q_h", "psi_f_wb", "J_kgm2")}
    truth["R_s_ohm"] = true_loop_resistance(drive)
    devices = device_slope_ohm(values)
    rise = values.number("T_winding_c") - drive.machine.T_ref_c
    copper = truth["R_s_ohm"] - devices
    truth["R_at_T_ohm"] = devices + copper * (1.0 + drive.machine.alpha_R_per_k * rise)
    truth["offset_rad"] = values.number("encoder_offset_rad")
    if drive.flux_map is not None and evaluation.inductance is not None:
        for k, (name, found) in enumerate((("L_d_h", evaluation.inductance.L_d), ("L_q_h", evaluation.inductance.L_q))):
            truth[name] = float(drive.flux_map.incremental_inductance(found.i_d_apk, found.i_q_apk)[k, k])
        # the simulated magnets lose alpha of the file's psi_f, which is not the drawn map's; what is printed is what
        # they have at their temperature, taken to T_ref by alpha
        loss = drive.machine.alpha_psi_per_k * (values.number("T_magnet_c") - drive.machine.T_ref_c)
        truth["psi_f_wb"] = (float(drive.flux_map.flux(0.0, 0.0)[0]) + loss * truth["psi_f_wb"]) / (1.0 + loss)
    return truth


def drawn(profile: str, seed: int, block: str) -> MachineFile:
    """Return a drive around a profile, or of the population where that is empty."""
    if not profile:
        return draw_drive(seed, block)  # type: ignore[arg-type]
    base = drive_of(profile, "switched")
    return draw_around(base, seed, block, spread=DRAWN_SPREAD)  # type: ignore[arg-type]


def is_hard(drive: MachineFile) -> bool:
    """Say whether the dead time takes more voltage than three times the winding at rated current."""
    inverter, I_nom = drive.inverter, drive.machine.I_nom_apk
    assert I_nom is not None
    return inverter.U_dc_v * inverter.dead_time_s * inverter.f_s_hz >= HARD_RATIO * drive.machine.R_s_ohm * I_nom


@dataclass(frozen=True, slots=True)
class Choice:
    """What is done with every drive."""

    keep: Path | None = None
    measure_only: bool = False
    bridge_v: float = 0.0


@dataclass(frozen=True)
class Refusal:
    """Why a drive was refused, and what was said of it."""

    refused: str
    text: str

    @classmethod
    def of(cls, error: PmsmtoolError) -> Refusal:
        """Return an error's name and its first line."""
        return cls(getattr(error, "reason", type(error).__name__), str(error).splitlines()[0])


Measured = tuple[dict[str, Trace], MachineFile, float]
"""Traces, nameplate and time on the bus (s)."""


def threshold_share(row: Mapping[str, Any]) -> float:
    """Return (V_diode - V_switch) / U_dc of a drive: it moves all legs alike, so that no current shows it.

    A bridge of MOSFETs has none: its diodes conduct in the dead time only.
    """
    drive = drawn(row["profile"], row["seed"], row["block"])
    return threshold_difference_v(drive) / drive.inverter.U_dc_v


def threshold_difference_v(drive: MachineFile) -> float:
    """Return V_diode - V_switch of a drive (V)."""
    values = settings_of(drive)
    switch = values.number("device_drop_v")
    return values.number("diode_drop_v") - switch if switch > 0.0 else 0.0


def data_sheet(drive: MachineFile, seed: int, tolerance_v: float) -> SensorTolerance | None:
    """Return what a data sheet says of the bridge, off by what its tolerance (V, 95 %) says; None without one."""
    if not tolerance_v:
        return None
    std_v = tolerance_v / COVERAGE_FACTOR
    off_v = std_v * float(np.random.default_rng([seed, DATA_SHEET]).standard_normal())
    difference_v = threshold_difference_v(drive)
    if not difference_v:
        return None
    return SensorTolerance(bridge_difference_v=difference_v + off_v, bridge_threshold_v=std_v)


def identify_one(job: tuple[str, int, str], choice: Choice) -> dict[str, Any]:
    """Identify one drive; returns errors, half widths and refusal, all JSON."""
    profile, seed, block = job
    drive = drawn(profile, seed, block)
    row: dict[str, Any] = {"profile": profile, "seed": seed, "block": block, "hard": is_hard(drive)}
    found_traces = kept(job, drive, choice)
    if isinstance(found_traces, Refusal):
        return {**row, **asdict(found_traces)}
    if choice.measure_only:
        return row
    traces, nameplate, seconds = found_traces
    start = time.process_time()
    try:
        evaluation = evaluated(traces, nameplate, data_sheet(drive, seed, choice.bridge_v))
    except PmsmtoolError as error:
        return {**row, **asdict(Refusal.of(error))}
    row["offline_s"] = time.process_time() - start
    truth = truth_of(drive, evaluation)
    found = evaluation.estimates()
    assert evaluation.resistance is not None
    found["R_at_T_ohm"] = evaluation.resistance.R_measured
    row["seconds"], row["bridge_v"] = seconds, choice.bridge_v
    for name in QUANTITIES:
        estimate = found[name]
        off = estimate.value - truth[name]
        scale = truth[name]
        if name == "offset_rad":
            off, scale = math.remainder(off, 2.0 * math.pi), 1.0
        row[name] = {
            "error": off / scale,
            "statistical": statistical_half_width(estimate) / scale,
            "total": total_half_width(estimate) / scale,
        }
    return row


def kept(job: tuple[str, int, str], drive: MachineFile, choice: Choice) -> Measured | Refusal:
    """Return what was kept of this drive, or measure and keep it."""
    profile, seed, block = job
    name = f"{profile or 'population'}-{block}-{seed}.pickle"
    if choice.keep is not None and (choice.keep / name).exists():
        stored: Measured | Refusal = pickle.loads((choice.keep / name).read_bytes())
        return stored
    try:
        found: Measured | Refusal = measured(drive)
    except PmsmtoolError as error:
        found = Refusal.of(error)
    if choice.keep is not None:
        scratch = choice.keep / f"{name}.part"
        scratch.write_bytes(pickle.dumps(found))
        scratch.replace(choice.keep / name)
    return found


def measured(drive: MachineFile, accuracy: float | None = None) -> Measured:
    """Run the experiments on a simulated drive; return traces, nameplate and time on the bus (s)."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.toml"
        path.write_text(dump_machine_file(drive, embed_flux_map=drive.flux_map is not None), encoding="utf-8")
        return _measured(path, accuracy)


def evaluated(traces: dict[str, Trace], nameplate: MachineFile, tolerance: SensorTolerance | None = None) -> Evaluation:
    """Estimate from the traces of :func:`measured`."""
    T_ref_c, inverter = nameplate.machine.T_ref_c, nameplate.inverter
    return evaluate(traces, inverter.T_s, T_ref_c=T_ref_c, U_dc_v=inverter.U_dc_v, tolerance=tolerance).whole()


def _measured(path: Path, accuracy: float | None) -> Measured:
    traces: dict[str, Trace] = {}
    with connect("pmsmsim", f"{path}?nv=:memory:") as connection:
        drive = CanopenDrive(connection, 1)
        nameplate = nameplate_of(drive, "random")
        request = IdentifyRequest()
        envelope = envelope_of(nameplate, request)
        limits = Limits(
            nameplate.machine.I_nom_apk or envelope.i_max_apk,
            envelope.i_max_apk,
            envelope.speed_max_rad_s,
            nameplate.inverter.V_max_v,
        )
        start = connection.clock.now()
        with guarded(drive, envelope) as guard:
            measurement = Measurement(guard, limits, traces.__setitem__, lambda text: None, accuracy=accuracy)
            measurement.run(ELECTRICAL)
        seconds = connection.clock.now() - start
        drive.close()
    return traces, nameplate, seconds


def clopper_pearson(hits: int, n: int) -> tuple[float, float]:
    """Return the exact two-sided 95 % interval of a share."""
    from scipy.stats import beta

    low = 0.0 if hits == 0 else float(beta.ppf(0.025, hits, n - hits + 1))
    high = 1.0 if hits == n else float(beta.ppf(0.975, hits + 1, n - hits))
    return low, high


def summary(rows: list[dict[str, Any]]) -> str:
    """Return the table."""
    accepted = [row for row in rows if "refused" not in row]
    lines = [f"{len(rows)} drives, {len(accepted)} accepted"]
    for reason, count in Counter(row["refused"] for row in rows if "refused" in row).most_common():
        lines.append(f"  refused {reason}: {count}")
    if not accepted:
        return "\n".join(lines)
    lines.append("quantity     median      p90       max   in statistical 95 %         in total 95 %")
    for name in QUANTITIES:
        errors = sorted(abs(row[name]["error"]) for row in accepted)
        unit, scale = ("deg", 180.0 / math.pi) if name == "offset_rad" else ("%", 100.0)
        quantiles = [errors[min(len(errors) - 1, round(q * (len(errors) - 1)))] * scale for q in (0.5, 0.9, 1.0)]
        lines.append(
            f"{name:10s} "
            + " ".join(f"{q:8.4f}{unit:3s}" for q in quantiles)
            + "  ".join(_covered(accepted, name, kind) for kind in ("statistical", "total"))
        )
    widths = []
    for name in QUANTITIES:
        totals = sorted(row[name]["total"] for row in accepted)
        unit, scale = ("deg", 180.0 / math.pi) if name == "offset_rad" else ("%", 100.0)
        widths.append(f"{name} {totals[round(0.9 * (len(totals) - 1))] * scale:.3g} {unit}")
    lines.append(f"total 95 % half width, p90: {', '.join(widths)}")
    if bridge_v := accepted[0].get("bridge_v"):
        lines.append(f"the thresholds of the bridge were told, within {bridge_v:g} V (95 %)")
    else:
        shares = [threshold_share(row) for row in accepted]
        seen = [100.0 * abs(row["psi_f_wb"]["error"] + share) for row, share in zip(accepted, shares, strict=True)]
        seen.sort()
        lines.append(
            f"psi_f besides the bridge's thresholds: p90 {seen[round(0.9 * (len(seen) - 1))]:.4f}%, max {seen[-1]:.4f}%"
        )
    times = sorted(row["seconds"] for row in accepted)
    late = sum(seconds > BUS_TIME_S for seconds in times)
    middle = times[len(times) // 2]
    lines.append(f"bus time per drive: median {middle:.1f} s, longest {times[-1]:.1f} s, {late} above {BUS_TIME_S:g} s")
    offline = sorted(row["offline_s"] for row in accepted)
    lines.append(f"processing off-line: median {offline[len(offline) // 2]:.1f} s, longest {offline[-1]:.1f} s (CPU)")
    return "\n".join(lines)


def _covered(rows: list[dict[str, Any]], name: str, kind: str) -> str:
    hits = sum(abs(row[name]["error"]) <= row[name][kind] for row in rows)
    low, high = clopper_pearson(hits, len(rows))
    return f" {hits:4d}/{len(rows)} ({low:.3f} .. {high:.3f})"


def show(rows: list[dict[str, Any]], profiles: list[str]) -> None:
    """Print the table of each profile, and of all together."""
    for profile, hard in itertools.product(profiles, (False, True)):
        mine = [row for row in rows if row["profile"] == profile and row["hard"] == hard]
        if not mine:
            continue
        kind = f"dead-time voltage {'>=' if hard else '<'} {HARD_RATIO:g} R I"
        print(f"== {profile or 'population'}, block {', '.join(sorted({row['block'] for row in mine}))}, {kind}")
        print(summary(mine))
    if len(profiles) > 1:
        print("== all")
        print(summary(rows))


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drives", type=int, default=200, help="number of drives (with --around: in all)")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--block", choices=["ideal", "timing", "gains"], default="ideal")
    around = "draw around these profiles; measured-map: the map in ../shared/maps"
    parser.add_argument("--around", nargs="*", default=[], metavar="PROFILE", help=around)
    parser.add_argument("--hard", action="store_true", help="only drives whose dead time takes 3 R I and more")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--rows", type=Path, help="write every drive's result there (JSON lines)")
    parser.add_argument("--tabulate", type=Path, metavar="ROWS", help="only print the table of a file of --rows")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the traces there, and use what is there")
    parser.add_argument("--bridge", type=float, default=0.0, metavar="V", help="tell its thresholds, to this tolerance")
    parser.add_argument("--measure-only", action="store_true", help="with --keep: estimate nothing yet")
    options = parser.parse_args()
    if options.measure_only and not options.keep:
        parser.error("--measure-only needs --keep")
    if options.keep:
        options.keep.mkdir(parents=True, exist_ok=True)
    if options.tabulate:
        stored = [json.loads(line) for line in options.tabulate.read_text(encoding="utf-8").splitlines()]
        show(stored, sorted({row["profile"] for row in stored}))
        return
    profiles = options.around or [""]
    seeds = itertools.count(options.first)
    jobs = ((profiles[k % len(profiles)], seed, options.block) for k, seed in enumerate(seeds))
    if options.hard:
        jobs = (job for job in jobs if is_hard(drawn(*job)))
    with multiprocessing.Pool(options.processes) as pool:
        rows = []
        choice = Choice(options.keep, options.measure_only, options.bridge)
        one = functools.partial(identify_one, choice=choice)
        for row in pool.imap_unordered(one, itertools.islice(jobs, options.drives)):
            rows.append(row)
            if options.rows:
                with options.rows.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps(row) + "\n")
    if not options.measure_only:
        show(rows, profiles)


if __name__ == "__main__":
    main()
