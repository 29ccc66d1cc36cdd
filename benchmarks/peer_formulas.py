# SPDX-License-Identifier: MIT
"""What other tools' formulas make of the same traces, beside ours.

    python -m benchmarks.peer_formulas --drives 20

Drives of the random population (switched inverter, ideal sensor gains), each measured once over CANopen frames. Per
quantity one line per formula: error against the truth over the drives it gave a number for.

R: voltage over current at the largest level (VESC, ODrive, SimpleFOC); slope between two levels (moteus, phobia); one
fixed curve v = R i + V tanh(i/i_c) through all levels (as STMBL fits a dead-time curve). L: voltage times half
period over the ripple (ODrive, SimpleFOC); our output-error fit with the axes as they stand, which is ours where the
frame stands on the rotor's axis. psi_f: (u_q - R i_q)/w at the fastest speed, and the slope over speeds without an
intercept. The formulas are written here from their descriptions, not taken from those programs.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.identification_coverage import drawn, evaluated, measured, truth_of
from pmsmtool.errors import PmsmtoolError
from pmsmtool.estimators.injection.axis_response import initial_inductance
from pmsmtool.estimators.injection.inductance import bare_shot
from pmsmtool.estimators.resistance import two_point_slope
from pmsmtool.identification.evaluate import Evaluation, shots_of
from pmsmtool.trace import Trace

Vector = NDArray[np.float64]
Traces = Mapping[str, Trace]
Formula = Callable[[Traces, Evaluation], float]
KNEES = np.geomspace(0.005, 1.0, 60)
"""Knees of the fixed curve that are tried, of the largest current."""


def two_point_resistance(levels: Trace) -> float:
    """Slope between two levels (ohm)."""
    return two_point_slope(levels["i_d_a"], levels["u_d_v"])


def single_point_resistance(levels: Trace) -> float:
    """V/I at the largest level (ohm)."""
    index = int(np.argmax(np.abs(levels["i_d_a"])))
    return float(levels["u_d_v"][index] / levels["i_d_a"][index])


def curve_fit_resistance(levels: Trace) -> float:
    """Return R of v = R i + V tanh(i/i_c) + v0 with the best knee i_c (ohm)."""
    i, v = levels["i_d_a"], levels["u_d_v"]
    peak = float(np.max(np.abs(i)))
    best, R = math.inf, math.nan
    for knee in KNEES:
        columns = np.stack([i, np.tanh(i / (knee * peak)), np.ones_like(i)], axis=1)
        x, *_ = np.linalg.lstsq(columns, v, rcond=None)
        cost = float(np.sum(np.square(v - columns @ x)))
        if cost < best:
            best, R = cost, float(x[0])
    return R


def ripple_inductance(traces: Traces, axis: str) -> float:
    """Return voltage times half period over the ripple (H)."""
    return initial_inductance(bare_shot(shots_of(traces, axis, 1)[0], axis))


def speed_flux(traces: Traces, R_ohm: float, *, slope: bool) -> float:
    """Return (u_q - R i_q)/w at the fastest speed, or the least-squares slope through zero over all speeds (Wb)."""
    speeds = traces["speeds"]
    w = speeds["omega_e_rad_s"]
    u = speeds["u_q_v"] - R_ohm * speeds["i_q_a"]
    if slope:
        return float(w @ u / (w @ w))
    fastest = int(np.argmax(np.abs(w)))
    return float(u[fastest] / w[fastest])


def _inductance_formulas(axis: str) -> dict[str, Formula]:
    def as_they_stand(traces: Traces, found: Evaluation) -> float:
        assert found.inductance is not None
        return found.inductance.axes[axis].L_h

    def ours(traces: Traces, found: Evaluation) -> float:
        return found.estimates()[f"L_{axis}_h"].value

    return {
        "voltage times time over ripple": lambda traces, found: ripple_inductance(traces, axis),
        "output error, axes as they stand": as_they_stand,
        "ours": ours,
    }


def _R(found: Evaluation) -> float:
    assert found.resistance is not None
    return found.resistance.R_measured.value


FORMULAS: dict[str, dict[str, Formula]] = {
    "R_at_T_ohm": {
        "V/I at the largest level": lambda traces, found: single_point_resistance(traces["levels"]),
        "slope between two levels": lambda traces, found: two_point_resistance(traces["levels"]),
        "one fixed dead-time curve": lambda traces, found: curve_fit_resistance(traces["levels"]),
        "ours": lambda traces, found: _R(found),
    },
    "L_d_h": _inductance_formulas("d"),
    "L_q_h": _inductance_formulas("q"),
    "psi_f_wb": {
        "one speed, no dead time": lambda traces, found: speed_flux(traces, _R(found), slope=False),
        "slope over speeds, no dead time": lambda traces, found: speed_flux(traces, _R(found), slope=True),
        "ours": lambda traces, found: found.estimates()["psi_f_wb"].value,
    },
}
"""Quantity, formula, how it comes from traces; the inverter model, offset and bias of ours are not given to theirs."""


def table(errors: Mapping[tuple[str, str], list[float]], drives: int, refused: int) -> str:
    """Return the table: relative errors (1), printed in percent."""
    lines = [f"{drives} drives, {refused} refused by us; absolute error in percent of the truth", ""]
    lines.append(f"{'quantity':12s}{'formula':36s}{'median':>9s}{'p90':>9s}{'largest':>9s}")
    for (quantity, formula), values in errors.items():
        size = 100.0 * np.abs(np.array(values))
        numbers = (float(np.median(size)), float(np.quantile(size, 0.9)), float(np.max(size)))
        lines.append(f"{quantity:12s}{formula:36s}" + "".join(f"{number:9.3f}" for number in numbers))
    return "\n".join(lines) + "\n"


def errors_of(drives: int, first: int, profile: str) -> tuple[dict[tuple[str, str], list[float]], int]:
    """Measure the drives; return relative errors by quantity and formula, and how many were refused."""
    errors: dict[tuple[str, str], list[float]] = {
        (quantity, formula): [] for quantity, formulas in FORMULAS.items() for formula in formulas
    }
    refused = 0
    for seed in range(first, first + drives):
        drive = drawn(profile, seed, "ideal")
        try:
            traces, nameplate, _ = measured(drive)
            found = evaluated(traces, nameplate)
        except PmsmtoolError:
            refused += 1
            continue
        truth = truth_of(drive, found)
        # psi_f of ours is at the reference temperature, theirs at the run's
        speeds = traces["speeds"]
        machine = drive.machine
        warm = 1.0 + machine.alpha_psi_per_k * (float(np.mean(speeds["T_magnet_c"])) - machine.T_ref_c)
        for quantity, formulas in FORMULAS.items():
            for formula, compute in formulas.items():
                true = truth[quantity] * (warm if quantity == "psi_f_wb" and formula != "ours" else 1.0)
                errors[quantity, formula].append(compute(traces, found) / true - 1.0)
    return errors, refused


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drives", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--profile", default="", help="draw around this profile; default the whole population")
    parser.add_argument("--write", type=Path, help="write the table there as well")
    options = parser.parse_args()
    errors, refused = errors_of(options.drives, options.first, options.profile)
    text = table(errors, options.drives, refused)
    print(text, end="")
    if options.write:
        options.write.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
