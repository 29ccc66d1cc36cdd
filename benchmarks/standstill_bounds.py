"""Standard deviation of R, L_d and L_q over their Cramer-Rao bounds, from many realisations of noise on stored traces.

    python -m benchmarks.standstill_bounds --write benchmarks/tables/standstill_bounds.txt

Random drives (``workflow/random_drives.py``) are identified once. The residual of the best fit is taken out of their
square-wave records, white noise of the measured size is put in, and the estimate is made again; the DC levels get the
noise of their means. Each deviation from the mean of its drive is divided by the bound of the same record: for L that
of the best model, all its nuisance parameters free, for R that of the tail 1/|i|, 1/|i|^2 and a drift in time. Printed
is the root of the mean square over all drives and realisations. It speaks of noise alone: what the models leave out is
judged on many drives by ``benchmarks/identification_coverage.py``.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.identification_coverage import drawn, evaluated, measured
from pmsmtool.estimators.axis_response import SKIP_SAMPLES
from pmsmtool.estimators.estimate import scaled_covariance
from pmsmtool.estimators.resistance import FIT_FROM, MEAN_NOISE_FACTOR
from pmsmtool.trace import Trace
from pmsmtool.workflow.evaluate import Evaluation, inductance_of, resistance_of

QUANTITIES = ("R", "L_d", "L_q")
ASKED = {"R": 1.5, "L_d": 1.3, "L_q": 1.3}


def level_noise(traces: dict[str, Trace], found: Evaluation) -> float:
    """Return the noise of the mean voltage of one level (V)."""
    assert found.resistance is not None
    samples = int(traces["levels"].meta["samples"])
    return MEAN_NOISE_FACTOR * found.resistance.R_measured.value * found.noise.sigma_a / math.sqrt(samples)


def bounds_of(traces: dict[str, Trace], found: Evaluation) -> dict[str, float]:
    """Return the Cramer-Rao bounds (ohm, H)."""
    assert found.inductance is not None
    levels = traces["levels"]
    i, t = levels["i_d_a"], levels.t_s
    peak = float(np.max(np.abs(i)))
    used = np.abs(i) >= FIT_FROM * peak
    i, t = i[used], t[used]
    sign, u = np.sign(i), np.abs(i) / peak
    columns = np.stack([i, sign, np.ones_like(i), i * (t - np.mean(t)), sign / u, sign / u**2], axis=1)
    covariance, _ = scaled_covariance(columns / level_noise(traces, found))
    bounds = {f"L_{axis}": fit.bound_h for axis, fit in found.inductance.axes.items()}
    return {"R": math.sqrt(float(covariance[0, 0])), **bounds}


def without_noise(traces: dict[str, Trace], found: Evaluation) -> dict[str, Trace]:
    """Return the traces with the residual of the best fits taken out of the square-wave records."""
    assert found.inductance is not None
    clean = dict(traces)
    for axis, fit in found.inductance.axes.items():
        names = sorted((n for n in traces if n.startswith(f"square_{axis}_")), key=lambda name: int(name[9:]))
        for name, residual in zip(names, fit.residuals, strict=True):
            current = traces[name][f"i_{axis}_a"].copy()
            current[SKIP_SAMPLES:] += residual * found.noise.sigma_a
            clean[name] = replace(traces[name], signals={**traces[name].signals, f"i_{axis}_a": current})
    return clean


def realisation(clean: dict[str, Trace], found: Evaluation, rng: np.random.Generator) -> dict[str, float]:
    """Return the estimates of one realisation of the noise."""
    noisy = dict(clean)
    for name in clean:
        if name.startswith("square_"):
            axis = name[7]
            noise = found.noise.sigma_a * rng.standard_normal(len(clean[name]))
            signals = {**clean[name].signals, f"i_{axis}_a": clean[name][f"i_{axis}_a"] + noise}
            noisy[name] = replace(clean[name], signals=signals)
    levels = clean["levels"]
    u = levels["u_d_v"] + level_noise(clean, found) * rng.standard_normal(len(levels))
    resistance = resistance_of(replace(levels, signals={**levels.signals, "u_d_v": u}), found.noise)
    inductance = inductance_of(noisy, found)
    return {"R": resistance.R_measured.value, "L_d": inductance.L_d.value, "L_q": inductance.L_q.value}


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drives", type=int, default=4, help="random drives, seeds from 0 on")
    parser.add_argument("--realisations", type=int, default=50, help="realisations of noise per drive")
    parser.add_argument("--write", type=Path, help="write the table there as well")
    options = parser.parse_args()
    deviations: dict[str, list[float]] = {name: [] for name in QUANTITIES}
    for seed in range(options.drives):
        traces, nameplate, _ = measured(drawn("", seed, "ideal"))
        found = evaluated(traces, nameplate)
        bounds, clean = bounds_of(traces, found), without_noise(traces, found)
        rng = np.random.default_rng([20261121, seed])
        rows = [realisation(clean, found, rng) for _ in range(options.realisations)]
        for name in QUANTITIES:
            values = np.array([row[name] for row in rows])
            free = math.sqrt(len(values) / (len(values) - 1))  # the mean is taken from the same values
            deviations[name] += [float(z) for z in free * (values - np.mean(values)) / bounds[name]]
    lines = [f"{options.drives} random drives, {options.realisations} realisations of noise each", ""]
    lines.append("quantity   std/bound (pooled rms)   asked")
    for name in QUANTITIES:
        rms = math.sqrt(float(np.mean(np.square(deviations[name]))))
        lines.append(f"{name:8s} {rms:12.2f} {ASKED[name]:20.1f}")
    text = "\n".join(lines) + "\n"
    print(text, end="")
    if options.write:
        options.write.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
