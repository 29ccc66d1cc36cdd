# SPDX-License-Identifier: MIT
"""Standard deviation of R, L and psi_f over their Cramer-Rao bounds, from many realisations of noise on stored traces.

    python -m benchmarks.standstill_bounds --drives 10 --realisations 20 --write benchmarks/tables/standstill_bounds.txt

Random drives (``random_drives.py``) are identified once. The residual of the best fit is taken out of their
square-wave records and of their coasting windows, white noise of the measured size is put in, and the estimate is made
again; the DC levels get the noise of their means. Each deviation from the mean of its drive is divided by the bound of
the same record: for L that of the best model, all its nuisance parameters free, for R that of the tail 1/|i|, 1/|i|^2
and a drift in time, for psi_f that of a constant flux (the smallest) and that with the curvature free, which a machine
that may saturate needs. Printed is the root of the mean square over all drives and realisations. It speaks of noise
alone: what the models leave out is judged on many drives by ``benchmarks/identification_coverage.py``.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.identification_coverage import Choice, Refusal, drawn, evaluated, kept
from pmsmtool.estimators.estimate import scaled_covariance
from pmsmtool.estimators.flux.linkage import LEVEL_RATIO
from pmsmtool.estimators.flux.linkage_rows import pairs_of
from pmsmtool.estimators.injection.axis_response import SKIP_SAMPLES
from pmsmtool.estimators.resistance import FIT_FROM, MEAN_NOISE_FACTOR
from pmsmtool.identification.evaluate import Evaluation, flux_of, inductance_of, resistance_of
from pmsmtool.machine.parameters import InverterParameters
from pmsmtool.machine.temperature import MAGNET_ALPHA_PER_K
from pmsmtool.trace import Trace

ASKED = {"R": 1.5, "L_d": 1.3, "L_q": 1.3, "psi_f": 1.5, "psi_f, curvature free": 1.5}
"""Largest standard deviation over bound, and the rows of the table."""
Vector = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Coasting:
    """Pairs of windows of a speed run, the noise of their q voltage, and the bounds of psi_f that follow.

    Attributes
    ----------
    pairs : ndarray of int, shape (n, 2)
        Rows of the windows.
    sigma_v : ndarray, shape (n,)
        Noise of each window's voltage (V): the estimator weights as if it fell with the d current.
    bound_wb, curved_bound_wb : float
        Bound with a constant flux, and with one term of curvature less than there are levels of i_d (Wb).
    """

    pairs: NDArray[np.int64]
    sigma_v: Vector
    bound_wb: float
    curved_bound_wb: float


def level_noise(traces: dict[str, Trace], found: Evaluation) -> float:
    """Return the noise of the mean voltage of one level (V)."""
    assert found.resistance is not None
    samples = int(traces["levels"].meta["samples"])
    return MEAN_NOISE_FACTOR * found.resistance.R_measured.value * found.noise.sigma_a / math.sqrt(samples)


def coasting_of(speeds: Trace, residual_wb: Vector) -> Coasting:
    """Return noise and bounds of a speed run, the noise from the residuals of its fit."""
    pairs = np.array(pairs_of(speeds))
    w_sum = np.abs(speeds["omega_e_rad_s"][pairs]).sum(axis=1)
    level = 0.5 * np.abs(np.diff(speeds["i_d_a"][pairs], axis=1)[:, 0])
    s = level / np.max(level)
    sizes = np.sort(level)
    levels = 1 + int(np.sum(sizes[1:] > LEVEL_RATIO * sizes[:-1]))
    power = float(np.sum((s * w_sum * residual_wb) ** 2))
    sigma_v = math.sqrt(power / (2 * (len(s) - levels))) / s
    columns = np.stack([s ** (2 * k) for k in range(levels)], axis=1) * (w_sum / (math.sqrt(2.0) * sigma_v))[:, None]
    bounds = [math.sqrt(float(scaled_covariance(columns[:, :k])[0][0, 0])) for k in (1, levels)]
    return Coasting(pairs, sigma_v, *bounds)


def bounds_of(traces: dict[str, Trace], found: Evaluation) -> dict[str, float]:
    """Return the Cramer-Rao bounds (ohm, H, Wb)."""
    assert found.inductance is not None and found.flux is not None
    levels = traces["levels"]
    i, t = levels["i_d_a"], levels.t_s
    peak = float(np.max(np.abs(i)))
    used = np.abs(i) >= FIT_FROM * peak
    i, t = i[used], t[used]
    sign, u = np.sign(i), np.abs(i) / peak
    columns = np.stack([i, sign, np.ones_like(i), i * (t - np.mean(t)), sign / u, sign / u**2], axis=1)
    covariance, _ = scaled_covariance(columns / level_noise(traces, found))
    bounds = {f"L_{axis}": fit.bound_h for axis, fit in found.inductance.axes.items()}
    coasting = coasting_of(traces["speeds"], found.flux.residual_wb)
    bounds |= {"psi_f": coasting.bound_wb, "psi_f, curvature free": coasting.curved_bound_wb}
    return {"R": math.sqrt(float(covariance[0, 0])), **bounds}


def without_noise(traces: dict[str, Trace], found: Evaluation) -> dict[str, Trace]:
    """Return the traces with the residual of the best fits taken out of square-wave records and coasting windows."""
    assert found.inductance is not None and found.flux is not None
    clean = dict(traces)
    coasting = coasting_of(traces["speeds"], found.flux.residual_wb)
    u_q = traces["speeds"]["u_q_v"].copy()
    u_q[coasting.pairs] -= found.flux.residual_wb[:, None] * traces["speeds"]["omega_e_rad_s"][coasting.pairs]
    clean["speeds"] = replace(traces["speeds"], signals={**traces["speeds"].signals, "u_q_v": u_q})
    for axis, fit in found.inductance.axes.items():
        names = sorted((n for n in traces if n.startswith(f"square_{axis}_")), key=lambda name: int(name[9:]))
        for name, residual in zip(names, fit.residuals, strict=True):
            current = traces[name][f"i_{axis}_a"].copy()
            current[SKIP_SAMPLES:] += residual * found.noise.sigma_a
            clean[name] = replace(traces[name], signals={**traces[name].signals, f"i_{axis}_a": current})
    return clean


def realisation(
    clean: dict[str, Trace],
    found: Evaluation,
    coasting: Coasting,
    inverter: InverterParameters,
    rng: np.random.Generator,
) -> dict[str, float]:
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
    inductance = inductance_of(noisy, found, None, inverter.U_dc_v)
    assert found.resistance is not None and found.inductance is not None
    L = (found.inductance.L_d.value, found.inductance.L_q.value)
    speeds = clean["speeds"]
    u_q = speeds["u_q_v"].copy()
    u_q[coasting.pairs] += coasting.sigma_v[:, None] * rng.standard_normal(coasting.pairs.shape)
    rows = {**clean, "speeds": replace(speeds, signals={**speeds.signals, "u_q_v": u_q})}
    flux = flux_of(rows, found.resistance, inverter.T_s, MAGNET_ALPHA_PER_K, None, L, found.inductance.sampling)
    psi = flux.psi_measured.value
    values = {"R": resistance.R_measured.value, "L_d": inductance.L_d.value, "L_q": inductance.L_q.value}
    return {**values, "psi_f": psi, "psi_f, curvature free": psi}


def deviations_of(seed: int, realisations: int, keep: Path | None) -> dict[str, Vector] | None:
    """Return the deviations of one drive's realisations from their mean, over the bounds; None of a refused one."""
    stored = kept(("", seed, "ideal"), drawn("", seed, "ideal"), Choice(keep=keep))
    if isinstance(stored, Refusal):
        return None
    traces, nameplate, _ = stored
    found = evaluated(traces, nameplate)
    assert found.flux is not None
    bounds, clean = bounds_of(traces, found), without_noise(traces, found)
    coasting = coasting_of(traces["speeds"], found.flux.residual_wb)
    rng = np.random.default_rng([20261121, seed])
    rows = [realisation(clean, found, coasting, nameplate.inverter, rng) for _ in range(realisations)]
    free = math.sqrt(realisations / (realisations - 1))  # the mean is taken from the same values
    out = {}
    for name in ASKED:
        values = np.array([row[name] for row in rows])
        out[name] = free * (values - np.mean(values)) / bounds[name]
    return out


def rms(values: Vector) -> float:
    """Return the root of the mean square."""
    return math.sqrt(float(np.mean(np.square(values))))


def table(drives: list[dict[str, Vector]]) -> str:
    """Return the table."""
    count = sum(len(drive["R"]) for drive in drives)
    lines = [f"{len(drives)} random drives, {count} realisations of noise in all", ""]
    lines.append("std over bound          pooled rms    smallest and largest of a drive   asked")
    for name, asked in ASKED.items():
        pooled = rms(np.concatenate([drive[name] for drive in drives]))
        single = [rms(drive[name]) for drive in drives]
        lines.append(f"{name:22s} {pooled:10.2f} {min(single):18.2f} {max(single):10.2f} {asked:15.1f}")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drives", type=int, default=10, help="number of random drives")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--realisations", type=int, default=20, help="realisations of noise per drive")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the traces there, and use what is there")
    parser.add_argument("--write", type=Path, help="write the table there as well")
    options = parser.parse_args()
    drives = []
    for seed in range(options.first, options.first + options.drives):
        found = deviations_of(seed, options.realisations, options.keep)
        if found is None:
            print(f"seed {seed}: refused", flush=True)
            continue
        drives.append(found)
        print(f"seed {seed}: " + ", ".join(f"{name} {rms(values):.2f}" for name, values in found.items()), flush=True)
    text = table(drives)
    print(text, end="")
    if options.write:
        command = f"python -m benchmarks.standstill_bounds --drives {options.drives} --first {options.first}"
        command += f" --realisations {options.realisations}"
        options.write.write_text(f"{command}\n{text}", encoding="utf-8")


if __name__ == "__main__":
    main()
