# SPDX-License-Identifier: MIT
"""Voltages beyond the linear range: their fundamental, the torque on the way there and back, and what the shunts see.

Run from the repository: ``python benchmarks/overmodulation.py [--machines 24] [--seed 1]``; some seconds per machine.
Machines of ``default_governor.py`` (linear and salient) with a drawn minimum low-side time and sampling window, each
with sensors in the phases, three shunts and one, designed by ``tune`` with the largest utilisation. The currents are
held while the speed is raised until they need 0.90 to 0.98 (0.985 without governor) of the largest fundamental, and
lowered again, 20 speeds each way; delay 1.5 periods, ideal sensors.

Printed per kind and shunts: largest fundamental over the linear limit, its largest error against the core's own
voltage, the largest difference of the mean torque over 24 electrical turns to the first one and to the neighbour's,
and the periods in which a lower switch was on for too short a time, or the shunts could not be read. Exit code 1 where
a limit is missed.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.default_governor import Steps, draw
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.firmware.core_binding import core
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import InverterParameters
from tests.firmware.closed_loop import DEFAULTS, MODE_CURRENT, Loop

SHUNTS = (0, 3, 1)
SHARES = {"best": np.linspace(0.90, 0.98, 20), "off": np.linspace(0.90, 0.985, 20)}
"""Of the largest fundamental, by governor: it holds references back that need more than 1 - eps of it, 0.985. A voltage
above 0.99 (1.005 without governor) is taken for a step."""
TURNS, SETTLE_PERIODS = 24, 400
FUNDAMENTAL_ERROR = 0.01
"""Measured: 0.006, of a dozen samples per edge of the hexagon; 0.0003 in the mean over all angles (a test)."""
TORQUE_STEP = 0.02
TIME_S = 1e-9
"""Rounding of a low-side time."""


def prepared(kind: str, seed: int, shunts: int) -> MachineFile:
    """Return a drawn machine whose inverter overmodulates as far as it can."""
    rng = np.random.default_rng([20261127, seed])
    source = draw(kind, seed)
    period = source.inverter.T_s
    inverter = replace(
        source.inverter,
        min_off_time_s=float(rng.uniform(0.0, 0.02)) * period,
        sample_window_s=float(rng.uniform(0.01, 0.04)) * period,
        shunts=shunts,
        delay_periods=1.5,
    )
    return replace(source, inverter=replace(inverter, voltage_utilisation=0.998 * inverter.largest_utilisation))


def sweep(source: MachineFile, seed: int, governor: str) -> dict[str, float]:
    """Return what is printed, of one machine."""
    params = tune(source, TuneRequest(field_weakening="gradient", governor=governor)).parameter_set()
    values = {**DEFAULTS, **params.values, "lut.format": 0.0, "saturation.n_d": 0.0}
    inverter, machine = source.inverter, source.machine
    steps = Steps(source, seed)
    rng = np.random.default_rng([3, seed])
    i_q = float(rng.uniform(0.2, 0.5)) * steps.rated.I_max_apk * float(rng.choice((-1.0, 1.0)))
    i = -float(rng.uniform(0.0, 0.2)) * steps.rated.I_max_apk, i_q
    speeds = [speed_of(source, i, share) for share in SHARES[governor]]
    loop = Loop(core(), values, omega=speeds[0], U_dc=inverter.U_dc_v)
    loop.settle_at(*i)
    linear = inverter.linear_utilisation * inverter.U_dc_v
    asked = machine.torque_nm(*i)
    torque, over, error, late = [], [], [], 0
    for omega in (*speeds, *speeds[::-1]):
        loop.plant.omega = omega
        periods = max(20, round(TURNS * 2.0 * math.pi / abs(omega) / inverter.T_s))
        seen, made = [], []
        for k in range(SETTLE_PERIODS + periods):
            live = loop.step(mode=MODE_CURRENT, i_d_ref=i[0], i_q_ref=i[1])
            duties = sorted((loop.output.duty_a, loop.output.duty_b, loop.output.duty_c))
            late += unreadable(inverter, duties, math.hypot(live.u_d_lim, live.u_q_lim) > 1.0001 * linear)
            if k >= SETTLE_PERIODS:
                seen.append(machine.torque_nm(live.i_d, live.i_q))
                made.append(applied(loop, live))
        torque.append(float(np.mean(seen)) / asked - 1.0)
        fundamental = abs(np.mean([a for a, _ in made]))
        over.append(fundamental / linear)
        error.append(fundamental / abs(np.mean([b for _, b in made])) - 1.0)
    return {
        "over": float(max(over)),
        "error": float(np.abs(error).max()),
        "torque": float(np.abs(torque).max()),
        "step": float(np.abs(np.diff(torque)).max()),
        "unreadable": late,
    }


def speed_of(source: MachineFile, i: tuple[float, float], share: float) -> float:
    """Electrical speed (rad/s) at which a current needs a share of the largest voltage."""
    machine, V = source.machine, share * source.inverter.V_max_v
    psi = machine.L_q_decoupling_h * i[1], machine.psi_f_wb + machine.L_d_decoupling_h * i[0]
    a, b = math.hypot(*psi) ** 2, machine.R_s_ohm * (psi[1] * i[1] - psi[0] * i[0])
    return float((-b + math.sqrt(b * b + a * (V * V - (machine.R_s_ohm * math.hypot(*i)) ** 2))) / a)


def applied(loop: Loop, live: Any) -> tuple[complex, complex]:
    """Voltage of the duty ratios and of the core's own record, in the frame of the applied voltage."""
    d, values, m = loop.output, loop.values, loop.measurement
    third = complex(-0.5, math.sqrt(0.75))
    stator = 2.0 / 3.0 * loop.U_dc * (d.duty_a + d.duty_b * third + d.duty_c * third.conjugate())
    angle = m.theta_e + values["inverter.delay_periods"] * 1e-9 * values["inverter.T_s_ns"] * m.omega_e
    return stator * complex(math.cos(angle), -math.sin(angle)), complex(live.u_d_lim, live.u_q_lim)


def unreadable(inverter: InverterParameters, duties: Sequence[float], beyond: bool) -> int:
    """1: a lower switch is on for too short a time, or the shunts have no window."""
    T_s, window = inverter.T_s, (inverter.sample_window_s or 0.0) - TIME_S
    low, second, high = duties
    bad = (1.0 - high) * T_s < (inverter.min_off_time_s or 0.0) - TIME_S
    if inverter.shunts == 3:
        bad |= (1.0 - second) * T_s < window
    elif inverter.shunts == 1 and beyond:
        bad |= min(second - low, high - second) * T_s / 2.0 < window
    return int(bad)


def main() -> int:
    """Print the table; exit code 1 where a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", type=int, default=24)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    failed = False
    for kind in ("linear", "salient"):
        for shunts, governor in itertools.product(SHUNTS, SHARES):
            rows = []
            for k in range(asked.machines // 2):
                seed = 1000 * asked.seed + 3 * k + (kind == "salient")
                rows.append(sweep(prepared(kind, seed, shunts), seed, governor))
            worst = {name: max(row[name] for row in rows) for name in rows[0]}
            least = min(row["over"] for row in rows)
            print(
                f"{kind:8s} {shunts} shunts, governor {governor:4s}: fundamental {least:.3f} to {worst['over']:.3f} of "
                f"the linear limit, error {worst['error']:.4f}; torque off by {worst['torque']:.4f}, step "
                f"{worst['step']:.4f}; {sum(r['unreadable'] for r in rows)} periods unreadable",
                flush=True,
            )
            failed |= worst["error"] > FUNDAMENTAL_ERROR or worst["step"] > TORQUE_STEP or worst["unreadable"] > 0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
