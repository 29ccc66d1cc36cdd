# SPDX-License-Identifier: MIT
"""Track R(T) and psi(T) of random machines that warm up while they run, and say how often the interval holds the truth.

    python -m benchmarks.tracking_coverage --drives 80

Every drive follows from its seed: a profile whose R, L, psi, dead time, device drop, shape and knee of the inverter's
error and temperatures are drawn, with the profile's own noise; it runs for eight seconds through drawn speeds and loads
while winding and magnets warm up. What the filter knows before: inductances off by a draw of 2 % standard deviation,
the inverter's error by one of 10 %, R and psi as they are at the reference temperature. The inverter is the averaged
one, so that its curve is known up to that factor; how well identification finds the curve is
``identification_coverage``. Errors within a run are one draw: the coverage is that of the last value and, beside it,
the mean share of the time after the first two seconds.

Results: ``benchmarks/tables/tracking_coverage.txt``.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.identification_coverage import clopper_pearson
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.tracking import track
from pmsmtool.estimators.tracking_model import TRACKED, Known, steady, windows
from pmsmtool.files import data_folder
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.sim.simulated_machine import settings_of
from tests.tracking.simulated import true_values, warming_run

Array = NDArray[np.float64]

PROFILES = ("interior-2k2", "jercic-2017", "miyajima-2013-assumed")
SECONDS, SETTLED_S, WINDOW_S = 8.0, 2.0, 0.02
SPREAD = 0.15
SHAPES: dict[str, Callable[[Array], Array]] = {
    "tanh": lambda x: np.asarray(np.tanh(x)),
    "atan": lambda x: np.asarray(2.0 / math.pi * np.arctan(x)),
    "capacitive": lambda x: np.where(np.abs(x) < 1.0, 0.5 * x, np.sign(x) - 0.5 / np.where(x == 0.0, 1.0, x)),
}
"""Error curves of the averaged inverter, of its plateau (docs/identification.md, 2)."""
SPEED_SHARES = (-0.6, -0.3, 0.2, 0.4, 0.6)
LOAD_SHARE = 0.8
WINDING_K = (5.0, 40.0)
"""Rise of the winding at rated current over the whole run, without cooling."""
MAGNET_K_PER_S = (0.0, 2.0)


def drawn(seed: int) -> tuple[MachineFile, Known, np.random.Generator]:
    """Return a drive and what is known of it before."""
    rng = np.random.default_rng([20261121, seed])
    base = load_machine_file(data_folder("profiles") / f"{PROFILES[seed % len(PROFILES)]}.toml")
    m, inverter = base.machine, base.inverter
    value = {
        name: float(getattr(m, name)) * math.exp(SPREAD * rng.standard_normal())
        for name in ("R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb")
    }
    shape = str(rng.choice(list(SHAPES)))
    dead_time = inverter.dead_time_s * math.exp(0.3 * rng.standard_normal())
    I_nom = m.I_nom_apk or 1.0
    temperature = float(rng.uniform(15.0, 60.0))
    rise = float(rng.uniform(*WINDING_K))
    truth: dict[str, Value] = {
        **value,
        "inverter_model": "averaged",
        "deadtime_shape": shape,
        "i_knee_apk": I_nom * float(rng.uniform(0.005, 0.06)),
        "device_drop_v": 0.0 if inverter.U_dc_v < 100.0 else float(rng.uniform(0.3, 1.2)),
        "T_winding_c": temperature,
        "T_magnet_c": temperature,
        "T_ambient_c": temperature,
        "thermal_on": True,
        "thermal_capacity_j_per_k": 1.5 * value["R_s_ohm"] * I_nom**2 * SECONDS / rise,
        "seed": seed,
    }
    drive = replace(base, inverter=replace(inverter, dead_time_s=dead_time), simulation={**base.simulation, **truth})
    settings = settings_of(drive)
    plateau = inverter.U_dc_v * dead_time * inverter.f_s_hz + settings.number("device_drop_v")
    i = np.linspace(0.0, 2.0 * I_nom, 801)[1:]
    curve = plateau * (1.0 + 0.1 * rng.standard_normal()) * SHAPES[shape](i / settings.number("i_knee_apk"))
    known = Known(
        value["R_s_ohm"],
        value["psi_f_wb"],
        value["L_d_h"] * (1.0 + 0.02 * rng.standard_normal()),
        value["L_q_h"] * (1.0 + 0.02 * rng.standard_normal()),
        inverter.T_s,
        curve=InverterCurve(i, curve, 0.0),
    )
    return drive, known, rng


def one(seed: int) -> dict[str, tuple[float, bool, float]]:
    """Return, per quantity, the last value's relative error, whether its interval holds, and the share of the time."""
    drive, known, rng = drawn(seed)
    m = drive.machine
    psi, I_nom = settings_of(drive).number("psi_f_wb"), m.I_nom_apk or 1.0
    base = (m.n_nom_rpm or 1000.0) * math.pi / 30.0
    load = LOAD_SHARE * 1.5 * m.pole_pairs * psi * I_nom
    trace = warming_run(
        drive,
        SECONDS,
        seed,
        simulation={name: drive.simulation[name] for name in ("thermal_capacity_j_per_k", "T_magnet_c")},
        speeds_rad_s=[share * base for share in SPEED_SHARES],
        loads_nm=(-load, load),
        magnet_k_per_s=float(rng.uniform(*MAGNET_K_PER_S)),
    )
    found = track(steady([windows(trace, round(WINDOW_S / trace.period_s))])[0], known)
    truth = true_values(drive, trace, found.t_s)
    late = found.t_s > SETTLED_S
    row = {}
    for name in TRACKED:
        off = found.value[name] - truth[name]
        within = np.abs(off) <= 1.96 * found.std[name]
        row[name] = (float(off[-1] / truth[name][-1]), bool(within[-1]), float(np.mean(within[late])))
    return row


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drives", type=int, default=80)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    options = parser.parse_args()
    rows, refused = [], Counter[str]()
    for seed in range(options.first, options.first + options.drives):
        try:
            rows.append(one(seed))
        except IdentificationError as error:
            refused[error.reason] += 1
    print(f"{options.drives} drives, {len(rows)} accepted, refused: {dict(refused) or 'none'}")
    for name in TRACKED if rows else ():
        errors = sorted(100.0 * abs(row[name][0]) for row in rows)
        hits = sum(row[name][1] for row in rows)
        low, high = clopper_pearson(hits, len(rows))
        p90 = errors[min(len(errors) - 1, round(0.9 * (len(errors) - 1)))]
        print(
            f"{name:9s} at the end: median {errors[len(errors) // 2]:.3f} %  p90 {p90:.3f} %  max {errors[-1]:.3f} %  "
            f"in 95 % interval {hits}/{len(rows)} ({low:.3f} .. {high:.3f}); "
            f"share of the time {np.mean([row[name][2] for row in rows]):.3f}"
        )


if __name__ == "__main__":
    main()
