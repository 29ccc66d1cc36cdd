# SPDX-License-Identifier: MIT
"""The guarantee of a closed drive over random drives: no demand above its bound, no saturation, no current beyond.

Run from the repository: ``python -m benchmarks.closed_drive [--drives 100] [--first 1]``; about 0.4 s of one core per
drive. Machines around interior-2k2 (R, L, saliency, flux, inertia, intervals), the truth anywhere in their intervals,
link and temperatures anywhere in their ranges; speed, acceleration and rise of the limits at random. Each drive is a
simulated node of the standard level: its torque is asked for far beyond the limits and turns at random times, while a
load machine moves the speed within the guarantee, as fast as it says. Exit code 1 when one drive leaves its bound.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import numpy as np

from pmsmtool.design.closed_drive import ClosedDrive, Guarantee, tune_closed
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import DesignInfeasible
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import MachineFile, load_machine_file, machine_path
from pmsmtool.papers.closed_drive import STANDARD, ClosedNode, Nodes, Seat
from pmsmtool.sim.node.factory import SET_UP_BANDWIDTH
from pmsmtool.sim.simulated_machine import with_simulation

Rng = np.random.Generator
DURATION_S = 0.6
NORMAL_95 = 1.96


def between(rng: Rng, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def drawn(rng: Rng) -> tuple[MachineFile, MachineFile]:
    """Return a machine as its file says, and the true one inside the intervals."""
    base = load_machine_file(machine_path("interior-2k2"))
    m, doubt = base.machine, float(rng.uniform(0.003, 0.03))
    L_d = m.L_d_h * between(rng, 0.5, 1.6)
    values = {"R_s_ohm": m.R_s_ohm * between(rng, 0.37, 2.0), "L_d_h": L_d, "L_q_h": L_d * float(rng.uniform(1.0, 1.8)),
              "psi_f_wb": m.psi_f_wb * float(rng.uniform(0.6, 1.3))}  # fmt: skip
    J = (m.J_kgm2 or 0.0) * between(rng, 0.5, 2.7)
    std = {name: doubt * value for name, value in {**values, "J_kgm2": J}.items()}
    machine = replace(
        m, R_s_ohm=values["R_s_ohm"], L_d_h=values["L_d_h"], L_q_h=values["L_q_h"], psi_f_wb=values["psi_f_wb"],
        J_kgm2=J,
    )  # fmt: skip
    file = replace(base, machine=machine, std=std)
    truth: dict[str, Value] = {
        name: value * (1.0 + NORMAL_95 * doubt * float(rng.uniform(-1.0, 1.0))) for name, value in values.items()
    }
    truth |= {
        "U_dc_v": base.inverter.U_dc_v * float(rng.uniform(0.95, 1.05)), "thermal_on": False,
        "T_winding_c": float(rng.uniform(-20.0, 140.0)), "T_magnet_c": float(rng.uniform(-20.0, 120.0)),
    }  # fmt: skip
    return file, with_simulation(file, truth)


def course(rng: Rng, found: Guarantee) -> tuple[Nodes, Nodes]:
    """Return nodes of speed and torque."""
    rpm, t = [(0.0, float(rng.uniform(-found.n_rpm, found.n_rpm)))], 0.0
    while t < DURATION_S:
        to = float(rng.uniform(-found.n_rpm, found.n_rpm))
        t += abs(to - rpm[-1][1]) / found.acceleration_rpm_per_s + 1e-3
        rpm.append((t, to))
    times = np.cumsum(rng.uniform(0.004, 0.06, 200))
    turns = [(float(x), float((-1) ** k * rng.uniform(10.0, 99.0))) for k, x in enumerate(times[times < DURATION_S])]
    return rpm, [(0.0, 99.0), *turns, (DURATION_S, 0.0)]


def tried(number: int) -> tuple[Guarantee, Seat] | None:
    """Return what was promised and seen for one random drive, None where no torque is admissible."""
    rng = np.random.default_rng([77, number])
    file, truth = drawn(rng)
    drive = ClosedDrive(
        STANDARD, frozenset(load_family(STANDARD).cells), SET_UP_BANDWIDTH / file.inverter.T_s / (2.0 * math.pi),
        rise_s=between(rng, 0.004, 0.06), speed_rpm=float(rng.uniform(150.0, 900.0)),
        acceleration_rpm_per_s=float(rng.uniform(500.0, 5000.0)),
    )  # fmt: skip
    try:
        design, found = tune_closed(file, TuneRequest(), drive)
    except DesignInfeasible:
        return None
    values = {name: value.value for name, value in design.values.items()}
    return found, ClosedNode(truth, values, number).run(*course(rng, found))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drives", type=int, default=100)
    parser.add_argument("--first", type=int, default=1)
    asked = parser.parse_args()
    shares, losses, beyond, infeasible = [], [], 0, 0
    for number in range(asked.first, asked.first + asked.drives):
        pair = tried(number)
        if pair is None:
            infeasible += 1
            continue
        found, seen = pair
        share = float(seen.demand_v.max()) / found.demand_v
        current = float(seen.current_a.max())
        shares.append(share)
        losses.append(found.torque_loss)
        if share > 1.0 or seen.saturated or current > found.I_apk + found.deviation_a:
            beyond += 1
            print(f"drive {number}: {share:.3f} of the bound, {seen.saturated} periods, {current:.4g} A")
    print(f"{len(shares)} drives, {infeasible} without admissible torque, {beyond} beyond their bound")
    for name, values in (("demand over its bound", shares), ("torque lost at that speed", losses)):
        low, middle, high = np.percentile(values, [0.0, 50.0, 100.0])
        print(f"{name}: least {low:.2f}, median {middle:.2f}, largest {high:.2f}")
    return 1 if beyond else 0


if __name__ == "__main__":
    raise SystemExit(main())
