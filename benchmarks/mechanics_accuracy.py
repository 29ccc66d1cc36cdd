# SPDX-License-Identifier: MIT
"""Identify inertia and friction of random drives over CANopen frames, and say how far off they are.

    python -m benchmarks.mechanics_accuracy --drives 100 --first 1000
    python -m benchmarks.mechanics_accuracy --bound 200

Drives follow from their seeds (``random_drives.py``, switched inverter, ideal gains and timing); the tool sees
their nameplate only. An error of the flux linkage goes into all three values one to one; ``J/psi`` is the error without
it. Every standard deviation is compared with the one that was said before the machine moved for it. ``--rows FILE``
keeps a line per drive and goes on from there; without drives the table is made of what it holds.

``--bound`` draws realisations of the noise that the fit assumes (encoder steps, current noise, torque ripple) around
random shafts and compares the scatter with the Cramer-Rao bound of the whitened model.

Results: ``benchmarks/tables/mechanics_accuracy.txt``.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.identification_coverage import clopper_pearson
from benchmarks.random_drives import draw_drive
from pmsmtool.bus.connect import connect
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.guard import guarded
from pmsmtool.errors import IdentificationError, PmsmtoolError
from pmsmtool.estimators.estimate import statistical_half_width, total_half_width
from pmsmtool.estimators.shaft.mechanics import BLOCKS, TORQUE_FLOOR, estimate_mechanics
from pmsmtool.estimators.shaft.model import positions
from pmsmtool.identification.evaluate import evaluate
from pmsmtool.identification.request import IdentifyRequest
from pmsmtool.machine.machine_file import dump_machine_file
from pmsmtool.measurement.by_injection import envelope_of, nameplate_of
from pmsmtool.measurement.limits import Limits
from pmsmtool.measurement.measure import Measurement
from pmsmtool.sim.simulated_machine import settings_of
from pmsmtool.trace import Trace

KEYS = ("J_kgm2", "tau_c_nm", "B_nms")
PREDICTED_KEYS = (*KEYS, "psi_f_wb", "R_s_ohm", "L_d_h", "L_q_h")
ROWS_PER_BLOCK = 4
TWICE = 2.0
"""Factor within which a predicted deviation is called right."""
Row = dict[str, Any]


def identify_one(seed: int) -> Row:
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
            said: dict[str, Row] = {}
            with guarded(drive, envelope) as guard:
                measurement = Measurement(guard, limits, traces.__setitem__, lambda text: None)
                measurement.predicted = lambda prediction: said.__setitem__(prediction["before"], prediction)
                measurement.run(request.quantities)
            drive.close()
    inverter = nameplate.inverter
    result = evaluate(traces, inverter.T_s, T_ref_c=nameplate.machine.T_ref_c, U_dc_v=inverter.U_dc_v).whole()
    found, settings = result.estimates(), settings_of(drive_file)
    row: Row = {"seed": seed}
    for key in KEYS:
        truth = settings.number(key)
        error = found[key].value - truth
        row[key] = (error / truth, abs(error) <= statistical_half_width(found[key]))
    psi_error = found["psi_f_wb"].value / settings.number("psi_f_wb") - 1.0
    assert result.mechanics is not None
    own = result.mechanics.fit_std[0] / found["J_kgm2"].value
    row["psi_f_wb"] = (psi_error, abs(psi_error) <= statistical_half_width(found["psi_f_wb"]) / found["psi_f_wb"].value)
    row["J/psi"] = (row["J_kgm2"][0] - psi_error, True)
    row["total J"] = total_half_width(found["J_kgm2"]) / found["J_kgm2"].value
    predicted = said["levels"]["relative_std"] | said["mechanics"]["relative_std"]
    row["std"] = {key: found[key].std / abs(found[key].value) for key in predicted}
    row["predicted"] = predicted
    row |= {"chi2": result.mechanics.chi2, "ripple": result.mechanics.ripple, "fit_std_J": own}
    return row


def attempt(seed: int) -> Row:
    """Return the row of a drive, or how it was refused."""
    try:
        return identify_one(seed)
    except PmsmtoolError as error:
        return {"seed": seed, "refused": getattr(error, "reason", type(error).__name__), "text": str(error)}


def show(rows: Sequence[Row]) -> None:
    """Print the table."""
    good = [row for row in rows if "refused" not in row]
    refused = {row["seed"]: row["refused"] for row in rows if "refused" in row}
    print(f"{len(rows)} drives, {len(good)} accepted, refused: {dict(Counter(refused.values())) or 'none'}")
    for key in (*KEYS, "psi_f_wb", "J/psi") if good else ():
        errors = sorted(100.0 * abs(row[key][0]) for row in good)
        median, p90 = errors[len(errors) // 2], errors[min(len(errors) - 1, round(0.9 * (len(errors) - 1)))]
        line = f"{key:9s} median {median:.3f} %  p90 {p90:.3f} %  max {errors[-1]:.3f} %"
        if key != "J/psi":
            hits = sum(bool(row[key][1]) for row in good)
            low, high = clopper_pearson(hits, len(good))
            line += f"  in 95 % interval {hits}/{len(good)} ({low:.3f} .. {high:.3f})"
        print(line)
    totals = sorted(100.0 * row["total J"] for row in good if "total J" in row)
    if totals:
        print(f"total 95 % half width of J: p90 {totals[round(0.9 * (len(totals) - 1))]:.2f} % of {len(totals)} drives")
    for key in PREDICTED_KEYS:
        ratios = sorted(row["std"][key] / row["predicted"][key] for row in good if key in row.get("predicted", ()))
        if ratios:
            n, within = len(ratios), sum(1.0 / TWICE <= ratio <= TWICE for ratio in ratios)
            ends = ", ".join(f"{ratios[round(share * (n - 1))]:.2f}" for share in (0.05, 0.5, 0.95))
            print(f"{key:9s} std over the predicted one: 5, 50, 95 % of drives {ends}; within a factor 2: {within}/{n}")
    for seed, reason in refused.items():
        print(f"refused: seed {seed}, {reason}")


# ---- the bound ------------------------------------------------------------------------------------------------


def realisation(rng: np.random.Generator) -> tuple[list[Trace], tuple[float, float, float], float, float]:
    """Return push, coasting, push, coasting of a random shaft; J, B, tau_c; torque per ampere and current noise."""
    per_a, current = 0.9, 4.0
    speed = math.exp(rng.uniform(math.log(30.0), math.log(400.0)))
    unit = math.exp(rng.uniform(math.log(0.05), math.log(0.4)))
    J = per_a * current * unit / speed
    tau_c, B = current * per_a * rng.uniform(0.005, 0.05), current * per_a * rng.uniform(0.005, 0.05) / speed
    step, sigma = 2.0 * math.pi / 2 ** int(rng.integers(12, 20)), 0.02
    omega, traces = 0.0, []
    for push, seconds, coasting in (
        (current, unit, False),
        (0.0, 6.0 * unit, True),
        (-current, 2.0 * unit, False),
        (0.0, 6.0 * unit, True),
    ):
        rows = ROWS_PER_BLOCK * BLOCKS
        T = seconds / rows
        torque = np.full(rows, per_a * push)
        if not coasting:  # blocks as the estimator makes them: it leaves out the first part of the way
            torque += np.repeat(TORQUE_FLOOR * per_a * current * rng.standard_normal(BLOCKS), ROWS_PER_BLOCK)
        theta = positions(torque, T, np.array([math.log(J), B, tau_c, 0.0, omega]))
        ahead = positions(torque[-1:], T, np.array([math.log(J), B, tau_c, 0.0, _speed(theta, T, torque, J, B, tau_c)]))
        omega = (ahead[1] - ahead[0]) / T
        signals = {
            "i_d_a": np.zeros(rows + 1),
            "i_q_a": push + sigma * rng.standard_normal(rows + 1),
            "theta_M_rad": step * np.round((theta + rng.uniform(0.0, step)) / step),
            "flagged": np.zeros(rows + 1),
        }
        traces.append(
            Trace(
                T * np.arange(rows + 1, dtype=np.float64), signals, dict.fromkeys(signals, "1"), {"coasting": coasting}
            )
        )
    return traces, (J, B, tau_c), per_a, sigma


def _speed(
    theta: np.ndarray[Any, Any], T: float, torque: np.ndarray[Any, Any], J: float, B: float, tau_c: float
) -> float:
    """Speed at the end of a trace, half an interval after that of its last way."""
    last = float(theta[-1] - theta[-2]) / T
    friction = B * last + tau_c * math.copysign(1.0, last)
    return last + 0.5 * T * (float(torque[-1]) - friction) / J


def bound_ratio(count: int, seed: int) -> None:
    """Print the rms of errors over the bound, pooled over realisations."""
    rng = np.random.default_rng(seed)
    ratios: list[list[float]] = []
    refused = Counter[str]()
    while len(ratios) < count:
        traces, truth, per_a, sigma = realisation(rng)
        try:
            found = estimate_mechanics(traces, lambda i_d, i_q, k=per_a: k * i_q, per_a, sigma, 0.0)  # type: ignore[misc]
        except IdentificationError as error:
            refused[error.reason] += 1
            continue
        values = (found.J.value, found.B.value, found.tau_c.value)
        widened = math.sqrt(max(1.0, found.chi2))
        ratios.append([(v - t) / s * widened for v, t, s in zip(values, truth, found.fit_std, strict=True)])
    table = np.array(ratios)
    print(f"refused: {dict(refused) or 'none'}")
    rms, mean = np.sqrt(np.mean(table**2, axis=0)), np.mean(table, axis=0)
    for name, r, m in zip(("J", "B", "tau_c"), rms, mean, strict=True):
        print(f"{name:6s} std/bound {r:.3f} +- {r / math.sqrt(2.0 * count):.3f}, mean {m:+.3f} ({count} realisations)")


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drives", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--rows", type=Path, nargs="+", help="files with a line per drive; the first is written")
    parser.add_argument("--bound", type=int, metavar="N", help="realisations of the noise, instead of drives")
    options = parser.parse_args()
    if options.bound:
        bound_ratio(options.bound, options.first)
        return
    rows: list[Row] = []
    for file in options.rows or ():
        if file.is_file():
            rows += [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    done = {row["seed"] for row in rows}
    for seed in range(options.first, options.first + options.drives):
        if seed in done:
            continue
        rows.append(attempt(seed))
        if options.rows:
            with options.rows[0].open("a", encoding="utf-8") as out:
                out.write(json.dumps(rows[-1], default=bool) + "\n")
    show(sorted(rows, key=lambda row: int(row["seed"])))


if __name__ == "__main__":
    main()
