# SPDX-License-Identifier: MIT
"""Current steps of saturated machines with the saturation table of the parameter set and without it.

Run from the repository: ``python benchmarks/saturated_steps.py [--machines 4] [--steps 12] [--hunt 40 [--hold-s 10]]``;
some two seconds per machine. Machines, steps and what counts as settled are those of ``default_governor.py``, kind
*saturated*: maps around the profile ``saturated-pmsyrm``, references that the voltage reaches and others that it does
not. Every case runs twice, with the design as ``tune`` makes it and with the same design without its table.

``--hunt N``: N references per machine that the voltage does not reach, three of four braking, held for a second, with
and without the one-step predictor: the largest swing of the current over the last tenth, over I_max. ``--kind`` takes
machines of another kind of ``default_governor.py``, which have no table.

Exit code 1: with the table a limit below is missed.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.default_governor import KINDS, OVER, Step, Steps, draw, run
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.params.parameter_set import SATURATION, ParameterSet
from pmsmtool.sim.closed_loop import simulate
from pmsmtool.sim.kernel import Application
from pmsmtool.sim.scenarios import Scenario

REACHABLE_P95_MS = 15.0
SWING = 0.02
"""Peak to peak over I_max, of what counts as at rest."""


def without_table(params: ParameterSet) -> ParameterSet:
    """Return the set with one inductance per axis."""
    values = {name: 0.0 if name.startswith("saturation.") else value for name, value in params.values.items()}
    return replace(params, values=values, tables={k: v for k, v in params.tables.items() if k != SATURATION})


def hunt(steps: Steps, params: ParameterSet, cases: list[Step], hold_s: float) -> float:
    """Return the largest swing of the current (A peak to peak) over the last tenth of ``hold_s``."""
    worst = 0.0
    unheated = {"protection.I_cont_apk": params.values["motor.I_max_apk"]}  # the thermal budget would cut the request
    params = replace(params, values={**params.values, **unheated})
    for k, (rpm, start, target) in enumerate(cases):
        if k % 4 and rpm * target[1] > 0.0:
            target = target[0], -target[1]
        schedule = {
            n: ((0.0, a), (0.05, a), (0.05, b)) for n, a, b in zip(("i_d_a", "i_q_a"), start, target, strict=True)
        }
        held = Scenario("hold", hold_s, "current", {**schedule, "driven_rpm": ((0.0, rpm),)}, "driven", rpm)
        trace = simulate(steps.source, params, held, application=Application.CORE)
        end = slice(9 * len(trace.t_s) // 10, None)
        worst = max(worst, *(float(np.ptp(trace[name][end])) for name in ("i_d_true_a", "i_q_true_a")))
    return worst


def main() -> int:
    """Print the table; exit code 1 where a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", type=int, default=4)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--hunt", type=int, default=0)
    parser.add_argument("--hold-s", type=float, default=1.0)
    parser.add_argument("--kind", choices=KINDS, default="saturated")
    asked = parser.parse_args()
    found: dict[tuple[str, bool], list[tuple[float, float]]] = {}
    swing, points = 0.0, 0
    for k in range(asked.machines):
        source = draw(asked.kind, 1000 * asked.seed + k)
        steps = Steps(source, 1000 * asked.seed + k)
        cases = [(reachable, step) for reachable in (True, False) for step in steps.draw(reachable, asked.steps)]
        designed = tune(source).parameter_set()
        for law, params in (("table", designed), ("no table", without_table(designed))):
            for reachable, case in cases:
                settled, peak, _ = run(source, params, case)
                found.setdefault((law, reachable), []).append((1e3 * settled, peak / steps.rated.I_max_apk))
        for predictor in (False, True) if asked.hunt else ():
            params = tune(source, TuneRequest(predictor=predictor)).parameter_set()
            held = steps.draw(reachable=False, count=asked.hunt)
            points += len(held)
            swing = max(swing, hunt(steps, params, held, asked.hold_s) / steps.rated.I_max_apk)
    for (law, reachable), rows in found.items():
        ms, peak = np.array(rows).T
        print(
            f"{law:8s} {'reachable' if reachable else 'unreachable':11s} settling ms median {np.median(ms):6.2f} p95 "
            f"{np.percentile(ms, 95):6.2f} max {ms.max():6.2f}; over {OVER:g} I_max {int((peak > OVER).sum())} of "
            f"{len(ms)}, most {peak.max():.3f}"
        )
    if asked.hunt:
        print(f"largest swing at rest {swing:.4f} I_max, {points} references held")
    slow = float(np.percentile([ms for ms, _ in found["table", True]], 95)) > REACHABLE_P95_MS
    over = max(peak for key, rows in found.items() if key[0] == "table" for _, peak in rows) > OVER
    return int(slow or over or swing > SWING)


if __name__ == "__main__":
    sys.exit(main())
