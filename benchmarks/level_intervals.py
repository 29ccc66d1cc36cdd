# SPDX-License-Identifier: MIT
"""Identify random drives below the full capability level: how wide and how true the printed intervals are.

    python -m benchmarks.level_intervals standard --drives 200 --first 5000 --speed 1.35
    python -m benchmarks.level_intervals supply --drives 60 --first 65000
    python -m benchmarks.level_intervals recorder --drives 200 --first 5000
    python -m benchmarks.level_intervals inject --drives 200 --first 7200

Drives follow from their seeds (``random_drives.py``). The simulated node has the objects of its level only:
``drive=cia402`` with the master's commutation angle, or the reference drive without excitation (``level=recorder``) or
averages (``level=inject``). ``supply``: R of the standard level from the readings of the simulated bench supply
(``sim/channel.py``). ``--speed`` is the largest speed that is allowed, over the nameplate's: the flux linkage of
the standard level needs one at which the voltage is at its limit. ``--no-machine``: no machine file tells that level
the inverter.
Every estimate is printed on stderr as error and half width (relative, or in deg); with ``--record FILE`` it goes there
too, and a second run goes on behind it.

``p`` is the probability of at most so many hits if an interval held the truth 95 times in 100; at 0.001 or less the
intervals are too narrow.

Seeds that were looked at while the estimators were made: 0 to 9, 100 to 139, 300 to 329, 2000 to 2019, 3000 to 3019,
5000 to 5075 (voltage limit), 7000 to 7002 and 7100 to 7151 (inject), 8000 to 8041 and 65000 to 65076 (recorder).
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.identification_coverage import clopper_pearson
from benchmarks.random_drives import draw_drive
from pmsmtool.bus.connect import connect
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.recorder_drives import RecordingDrive
from pmsmtool.drive.standard_drive import RecorderDrive, StandardDrive
from pmsmtool.drive.torque_drives import TorqueDrive
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import PmsmtoolError
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.experiments.standstill import ReadSupply, hold_supply_levels
from pmsmtool.identification.by_pulses import SUPPLY_LEVELS, PulseFacts, PulseResult, pulse_result
from pmsmtool.identification.evaluate import evaluate
from pmsmtool.identification.request import IdentifyRequest, Method
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.machine.parameters import Estimate, InverterParameters
from pmsmtool.measurement.by_injection import envelope_of, nameplate_of
from pmsmtool.measurement.by_pulses import HEADROOM, push_by_torque, swing_and_record, turn_both_ways
from pmsmtool.measurement.limits import Keep, Limits, Say
from pmsmtool.measurement.measure import Measurement
from pmsmtool.sim.simulated_machine import device_slope_ohm, settings_of
from pmsmtool.trace import Trace

CHANNELS = {
    "standard": "&drive=cia402",
    "supply": "&drive=cia402",
    "recorder": "&level=recorder",
    "inject": "&level=inject",
}
TOO_NARROW = 1e-3
OF_THE_MACHINE = ("R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb", "J_kgm2", "offset_rad")
"""What is judged at level inject, at the reference temperature."""
AT_REFERENCE = {"inject": OF_THE_MACHINE, "recorder": ("R_s_ohm", "psi_f_wb")}
"""What a level tells at the reference temperature; the ratios to psi are at the temperature of the run."""


def truth_of(drive: MachineFile) -> dict[str, float]:
    """Return what the estimates should be, at the temperature of the run."""
    values = settings_of(drive)
    devices = device_slope_ohm(values)
    rise, magnets = (values.number(f"T_{part}_c") - drive.machine.T_ref_c for part in ("winding", "magnet"))
    psi = values.number("psi_f_wb") * (1.0 + drive.machine.alpha_psi_per_k * magnets)
    R_s = devices + (values.number("R_s_ohm") - devices) * (1.0 + drive.machine.alpha_R_per_k * rise)
    return {
        "pole_pairs": values.number("pole_pairs"),
        "direction": -1.0 if values.flag("encoder_reversed") else 1.0,
        "offset_rad": values.number("encoder_offset_rad"),
        "frame_offset_rad": 0.0,
        "L_q_app_h": values.number("L_q_h"),
        "psi_f_wb": psi,
        "R_s_ohm": R_s,
        "R_s_ohm_measured": R_s,
        "J_per_psi": values.number("J_kgm2") / psi,
        "tau_c_per_psi": values.number("tau_c_nm") / psi,
    }


def identify(level: str, drive: MachineFile, path: Path, speed: float, *, given: bool = True) -> PulseResult:
    """Run one drive; the inverter is known where a machine file is given."""
    machine = drive.machine
    envelope = Envelope(
        i_max_apk=HEADROOM * (machine.I_nom_apk or 1.0),
        speed_max_rad_s=speed * (machine.n_max_rpm or 1000.0) * math.pi / 30.0,
        duration_s=600.0,
    )
    with connect("pmsmsim", f"{path}?nv=:memory:{CHANNELS[level]}") as connection:
        if level == "inject":
            return _by_injection(RecordingDrive(connection, 1))
        if level == "recorder":
            return told_by(swing_and_record, RecorderDrive(connection, 1), envelope)
        family = load_family("cia402")
        turning = StandardDrive(connection, 1, drive_map=family)
        if level == "supply":
            return _by_supply(turning, envelope, lambda i_a: connection.bus.read_supply(1))  # type: ignore[attr-defined]
        found = told_by(turn_both_ways, turning, envelope)
        turning.close()
        pole_pairs = round(found.estimates["pole_pairs"].value)
        pushing = TorqueDrive(connection, 1, drive_map=family)
        pushed = told_by(push_by_torque, pushing, envelope, drive.inverter if given else None, pole_pairs=pole_pairs)
        return PulseResult({**found.estimates, **pushed.estimates}, pushed.missing)


def told_by(
    experiment: Callable[[Any, Envelope, Keep, Say], PulseFacts],
    drive: CanopenDrive,
    envelope: Envelope,
    inverter: InverterParameters | None = None,
    **known: Any,
) -> PulseResult:
    """Return what an experiment on a drive tells; ``known`` replaces what the drive says of itself."""
    traces: dict[str, Trace] = {}
    facts = experiment(drive, envelope, traces.__setitem__, lambda text: None)
    return pulse_result(traces, replace(facts, **known), None, inverter)


def _by_supply(drive: StandardDrive, envelope: Envelope, read: ReadSupply) -> PulseResult:
    traces: dict[str, Trace] = {}
    i_a = envelope.i_max_apk / HEADROOM
    traces[SUPPLY_LEVELS] = hold_supply_levels(drive, envelope, i_a, read, lambda text: None)
    drive.close()
    return pulse_result(traces, PulseFacts(Method.STANDARD))


def _by_injection(drive: RecordingDrive) -> PulseResult:
    traces: dict[str, Trace] = {}
    nameplate, request = nameplate_of(drive, "random"), IdentifyRequest()
    envelope = envelope_of(nameplate, request)
    limits = Limits(
        nameplate.machine.I_nom_apk or envelope.i_max_apk, envelope.i_max_apk, envelope.speed_max_rad_s,
        nameplate.inverter.V_max_v,
    )  # fmt: skip
    with guarded(drive, envelope) as guard:
        Measurement(guard, limits, traces.__setitem__, lambda text: None).run(request.quantities)
    T_s, T_ref, U_dc = nameplate.inverter.T_s, nameplate.machine.T_ref_c, nameplate.inverter.U_dc_v
    found = evaluate(traces, T_s, T_ref_c=T_ref, U_dc_v=U_dc).whole()
    estimates: dict[str, Estimate] = found.estimates()
    return PulseResult({name: estimates[name] for name in OF_THE_MACHINE}, {})


def judged(level: str, seed: int, speed: float, *, given: bool = True) -> dict[str, Any]:
    """Identify one drive; returns errors and half widths, or the refusal."""
    drive = draw_drive(seed)
    truth = truth_of(drive)
    values = settings_of(drive)
    truth |= {name: values.number(name) for name in AT_REFERENCE.get(level, ()) if not name.endswith("_rad")}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.toml"
        path.write_text(dump_machine_file(drive), encoding="utf-8")
        try:
            result = identify(level, drive, path, speed, given=given)
        except PmsmtoolError as error:
            return {"seed": seed, "refused": getattr(error, "reason", type(error).__name__)}
    row: dict[str, Any] = {"seed": seed, "missing": sorted(result.missing), "found": {}}
    for name, estimate in result.estimates.items():
        off, scale = estimate.value - truth[name], abs(truth[name])
        if estimate.unit == "rad":
            off, scale = math.remainder(off, 2.0 * math.pi), math.radians(1.0)
        row["found"][name] = (off / scale, total_half_width(estimate) / scale)
        print(f"{seed} {name} {off / scale:+.5f} +- {row['found'][name][1]:.5f}", file=sys.stderr)
    return row


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Return the summary."""
    from scipy.stats import binom

    refused = Counter(row["refused"] for row in rows if "refused" in row)
    for row in rows:
        refused.update(f"{name} not identified" for name in row.get("missing", ()))
    lines = [f"refused: {dict(refused)}"]
    lines.append("quantity            n   error: median    p90      max   half width: median   p90    covered, p")
    for name in dict.fromkeys(name for row in rows for name in row.get("found", ())):
        pairs = [row["found"][name] for row in rows if name in row.get("found", ())]
        unit, factor = ("deg", 1.0) if name.endswith("_rad") else ("%", 100.0)
        sizes, half = sorted(abs(pair[0]) * factor for pair in pairs), sorted(pair[1] * factor for pair in pairs)
        n = len(pairs)
        p90 = round(0.9 * (n - 1))
        hits = sum(abs(pair[0]) <= pair[1] + 1e-12 for pair in pairs)
        low, high = clopper_pearson(hits, n)
        p = float(binom.cdf(hits, n, 0.95))
        verdict = "TOO NARROW" if p <= TOO_NARROW else "holds"
        lines.append(
            f"{name:17s} {n:3d}  {sizes[n // 2]:9.3f} {sizes[p90]:8.3f} {sizes[-1]:8.3f} {unit:3s} {half[n // 2]:9.3f} "
            f"{half[p90]:8.3f}   {hits}/{n} ({low:.3f} .. {high:.3f}) p {p:.2g} {verdict}"
        )
    return lines


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("level", choices=sorted(CHANNELS))
    parser.add_argument("--drives", type=int, default=40)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--no-machine", action="store_true")
    parser.add_argument("--record", type=Path)
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    if options.record is not None and options.record.is_file():
        rows = [json.loads(line) for line in options.record.read_text(encoding="utf-8").splitlines()]
    done = {row["seed"] for row in rows}
    for seed in range(options.first, options.first + options.drives):
        if seed in done:
            continue
        rows.append(judged(options.level, seed, options.speed, given=not options.no_machine))
        if options.record is not None:
            with options.record.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(rows[-1]) + "\n")
    print(f"{options.level}: {len(rows)} drives from seed {options.first}, speed {options.speed:g} of the nameplate's")
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
