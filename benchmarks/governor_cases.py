# SPDX-License-Identifier: MIT
"""The reference governor at full size: what the tests check on samples, over hundreds to thousands of random cases.

Run from the repository: ``python benchmarks/governor_cases.py [--scale 1.0]``; about two minutes of one core.
Table 1 of Jercic et al. 2017, V_dc 210 V, no computation delay where not said. Exit code 1 when a limit is missed.

* projection: exact projection against SLSQP (made exact by a root of the optimality conditions), empty sets included;
* demand: 1000 closed loops per condition, largest demanded voltage over its limit, float32 and double build;
* steps: 300 random reachable steps with T_min > 1 ms, settling over the minimum time;
* unreachable: 300 requests outside the voltage limit, settling on the nearest reachable current;
* mismatch: 300 steps for each of five plants that are not the controller's, current reached.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from pmsmtool.design.minimum_time import TransferProblem, minimum_time
from pmsmtool.firmware.core_binding import core
from tests.firmware.closed_loop import PREDICTOR, RPM, reference_case
from tests.firmware.governor_rows import Table1
from tests.firmware.test_governor import (
    ALL_OPTIONS,
    CONDITIONS,
    T_S,
    V_DC,
    V_MAX,
    VOLTAGE_DOUBLE,
    VOLTAGE_FLOAT,
    best,
    nearest_reachable,
    paper,
    random_cases,
    run,
    settling_ms,
    steady_voltage,
)
from tests.firmware.test_projection import (
    EMPTY,
    excess,
    general_solution,
    instances,
    project,
    smallest_excess,
)

DELAYED = {"inverter__delay_periods": 1.5}
PLANTS = {
    "0.7 L": (1, 0.7, 1),
    "1.43 L": (1, 1.43, 1),
    "0.7 psi, 1.5 R": (1.5, 1, 0.7),
    "1.1 psi": (1, 1, 1.1),
    "1.5 R": (1.5, 1, 1),
}
BACK_CALCULATION_DELAYED = {"inverter__delay_periods": 1.5, "current__options": 23}

Verdict = tuple[str, float, float]


def projection(count: int) -> list[Verdict]:
    """Largest distances to the general solver, wrong verdicts about empty sets, Newton steps."""
    double, single = core(double=True), core()
    rng = np.random.default_rng(3)
    far = far_float = wrong = steps_most = 0.0
    statuses = dict.fromkeys((0, 1, 2, EMPTY), 0)
    compared = 0
    for rows, r in instances(count):
        status, v, steps = project(double, rows, r)
        status_float, v_float, steps_float = project(single, rows, r)
        statuses[status] += 1
        steps_most = max(steps_most, steps, steps_float)
        if status == EMPTY or status_float == EMPTY:
            wrong += status != status_float or smallest_excess(rows) <= 1e-9
            continue
        far_float = max(far_float, float(np.linalg.norm(v - v_float)))
        general = r if excess(rows, r) <= 0 else general_solution(rows, r, v, rng)
        if general is not None:
            compared += 1
            far = max(far, float(np.linalg.norm(general - v)))
    print(
        f"  {count} instances: {statuses[0]} pass, {statuses[1]} on one row, {statuses[2]} on two, "
        f"{statuses[EMPTY]} empty; {compared} compared"
    )
    return [
        ("projection, double build against SLSQP (A)", far, 1e-5),
        ("projection, float32 against double (A)", far_float, 2e-3),
        ("projection, Newton steps of one call", steps_most, 30),
        ("projection, instances not compared", count - statuses[EMPTY] - compared, 0),
        ("projection, wrong verdict about an empty set", wrong, 0),
    ]


def demand(count: int) -> list[Verdict]:
    """Largest relative excess of the demanded voltage per condition and build."""
    out = []
    for name, (values, options) in CONDITIONS.items():
        for double, limit in ((False, VOLTAGE_FLOAT), (True, VOLTAGE_DOUBLE)):
            most = 0.0
            for rpm, start, target in random_cases(count, 11):
                seen = run(values, rpm, start, target, 60, double=double, **options)
                most = max(most, float(np.hypot(*seen["u"].T).max() / V_MAX - 1))
            out.append((f"demand over its limit, {name}, {'double' if double else 'float32'}", most, limit))
    return out


def reachable_steps(count: int) -> list[Any]:
    """(rpm, start, target, T_min in s) with both ends inside the limits and T_min > 1 ms."""
    m, out = Table1(), []
    for rpm, start, target in random_cases(100 * count, 21):
        way = math.dist(start, target)
        if way <= 10 or steady_voltage(np.array(target), rpm * RPM) > 0.92 * V_MAX:
            continue
        problem = TransferProblem(m.R, m.L_d, m.L_q, m.psi, rpm * RPM, V_MAX)
        T_min = minimum_time(problem, start, target, radius=0.02 * way)
        if T_min > 1e-3:
            out.append((rpm, start, target, T_min))
        if len(out) == count:
            break
    return out


def steps(count: int) -> list[Verdict]:
    """Median and 95th percentile of settling over minimum time, laws side by side."""
    laws: dict[str, tuple[dict[str, float], tuple[float, float] | None]] = {
        "paper, modulus optimum": (paper(governor__eps=1e-3), (1.25, 1.40)),
        "best, alpha 7540": (best(), (1.06, 1.10)),
        "best, delay and predictor": (best(options=ALL_OPTIONS | PREDICTOR, **DELAYED), (1.11, 1.18)),
        "back-calculation, modulus optimum": (reference_case(4000.0), None),
        "back-calculation, alpha 7540": (reference_case(7540.0), None),
        "back-calculation, delay and predictor": (reference_case(7540.0, **BACK_CALCULATION_DELAYED), None),
    }
    cases = reachable_steps(count)
    out = []
    for name, (values, limits) in laws.items():
        ratios = []
        for rpm, start, target, T_min in cases:
            seen = run(values, rpm, start, target, int(3 * T_min / T_S) + 60)
            ratios.append(1e-3 * settling_ms(seen["i"], target, 0.02 * math.dist(start, target)) / T_min)
        median, p95 = np.percentile(ratios, [50, 95])
        print(f"  {name}: settling/T_min median {median:.3f}, p95 {p95:.3f}, most {max(ratios):.3f}")
        if limits is not None:
            out += [(f"steps, {name}, median", median, limits[0]), (f"steps, {name}, p95", p95, limits[1])]
    return out


def unreachable(count: int) -> list[Verdict]:
    """Settling on the nearest reachable current; the paper's failures are printed."""
    out: list[Verdict] = []
    for name, values in (("best", best(governor__I_transient_apk=80.0)), ("paper", paper(governor__eps=1e-3))):
        times, unsettled = [], 0
        for rpm, start, target in random_cases(40 * count, 5):
            if steady_voltage(np.array(target), rpm * RPM) <= V_MAX:
                continue
            nearest = nearest_reachable(target, rpm * RPM)
            seen = run(values, rpm, start, target, 1200 if name == "best" else 600)
            end = settling_ms(seen["i"], (nearest[0], nearest[1]), max(0.2, 0.02 * math.dist(nearest, start)))
            times.append(end)
            unsettled += end >= len(seen["i"]) * T_S * 1e3 - 1e-3
            if len(times) == count:
                break
        p95 = float(np.percentile(times, 95))
        print(
            f"  {name}: {unsettled} of {len(times)} not settled after {len(seen['i']) * T_S * 1e3:.0f} ms, "
            f"p95 {p95:.2f} ms"
        )
        if name == "best":
            out += [
                ("unreachable, best mode, not settled", unsettled, 0),
                ("unreachable, best mode, p95 (ms)", p95, 6.0),
            ]
    return out


def mismatch(count: int) -> list[Verdict]:
    """Steps that are feasible for the plant and do not arrive within 1 A."""
    m = Table1()
    out: list[Verdict] = []
    for name, plant in PLANTS.items():
        missed = done = 0
        for rpm, start, target in random_cases(100 * count, 4):
            held = [
                math.hypot(
                    plant[0] * m.R * i[0] - rpm * RPM * plant[1] * m.L_q * i[1],
                    plant[0] * m.R * i[1] + rpm * RPM * (plant[1] * m.L_d * i[0] + plant[2] * m.psi),
                )
                for i in (start, target)
            ]
            if max(held) > 0.92 * V_MAX:
                continue
            seen = run(best(governor__observer_gain=0.1), rpm, start, target, 500, plant=plant)
            missed += bool(np.linalg.norm(seen["i"][-1] - target) > 1.0)
            done += 1
            if done == count:
                break
        out.append((f"mismatch {name}, {done} steps, not converged", missed, 0))
    return out


def main() -> int:
    """Run every part, print, compare with the limits."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--scale", type=float, default=1.0, help="share of the full number of cases")
    parser.add_argument("--only", choices=["projection", "demand", "steps", "unreachable", "mismatch"])
    options = parser.parse_args()
    print(f"Table 1 machine, V_dc {V_DC:g} V, 12 kHz")
    missed = 0
    for part, count in ((projection, 2000), (demand, 1000), (steps, 300), (unreachable, 300), (mismatch, 300)):
        if options.only not in (None, part.__name__):
            continue
        for text, value, limit in part(max(5, round(options.scale * count))):
            good = value <= limit
            missed += not good
            print(f"{'ok  ' if good else 'MISS'} {text}: {value:.4g} (limit {limit:g})", flush=True)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
