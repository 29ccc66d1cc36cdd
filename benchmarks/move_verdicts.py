# SPDX-License-Identifier: MIT
"""How often `prove` passes moves of healthy drives and catches those of spoiled ones, by its moves alone.

    python -m benchmarks.move_verdicts --drives 30
    python -m benchmarks.move_verdicts --drives 10 --first 500 --kinds late inertia

Drives follow from their seeds (``random_drives.py``, switched inverter). Each is given its true parameters, off by
draws from the intervals that identification declares (``prove_verdicts.declared``), designed, flashed over the bus, and
moved twice. Then once more with one thing wrong that its objects do not show (the kinds in turn): the gain of the
position loop 20 % up or down, that of the speed loop 20 % down, speed or acceleration fed forward with the wrong sign,
the angle one period of the speed loop older, inertia 1.5 times as large. ``tables/move_verdicts.txt`` holds what was
measured.
"""

from __future__ import annotations

import argparse
import math
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from benchmarks.prove_verdicts import Change, Shared, declared, interval, proven, spoiled
from benchmarks.random_drives import draw_drive
from pmsmtool.design.design_file import Design
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import DesignInfeasible, PmsmtoolError
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.proof import stage as proving
from pmsmtool.sim.kernel import Params

MOVES = ("move", "move_lag")


def _times(**factors: float) -> Change:
    def change(params: Params) -> None:
        for name, factor in factors.items():
            setattr(params, name, factor * getattr(params, name))

    return change


CHANGES: dict[str, Change] = {
    "gain_low": _times(position_K_p_per_s=0.8),
    "gain_high": _times(position_K_p_per_s=1.2),
    "speed_gain_low": _times(speed_K_p_nms_per_rad=0.8, speed_K_i_nm_per_rad=0.8),
    "speed_ff_sign": _times(position_velocity_ff=-1.0),
    "inertia_ff_sign": _times(position_inertia_ff_kgm2=-1.0),
}
"""In the parameters."""


def _late(truth: MachineFile, design: Design) -> MachineFile:
    late_s = design["speed.decimation"] * truth.inverter.T_s
    return replace(truth, simulation={**truth.simulation, "encoder_latency_s": late_s})


def _heavy(truth: MachineFile, design: Design) -> MachineFile:
    return replace(truth, machine=replace(truth.machine, J_kgm2=1.5 * (truth.machine.J_kgm2 or 0.0)))


TRUTHS: dict[str, Callable[[MachineFile, Design], MachineFile]] = {"late": _late, "inertia": _heavy}
"""In the machine and its sensors."""
KINDS = (*CHANGES, *TRUTHS)


def one_move(truth: MachineFile, design: Design, kind: str) -> tuple[bool, str]:
    """Return whether the moves pass, healthy (empty kind) or spoiled, and the reason."""
    machine = TRUTHS[kind](truth, design) if kind in TRUTHS else truth
    try:
        with spoiled(kind if kind in CHANGES else "", CHANGES):
            stage = proven(machine, design, proving.ProofRequest(experiments=MOVES))
    except PmsmtoolError as error:
        return False, f"{type(error).__name__}: {error.what}"
    seen = [(float(v["value"]), str(v["name"])) for v in stage.values if "where" in v]
    worst, what = max(seen, default=(math.nan, ""))
    return stage.status == "pass", f"{worst:.2f} {what} | {stage.note}"


def main() -> None:
    """Run the drives; print a line for every proof, and the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--kinds", nargs="*", choices=KINDS, help="all of these on every drive; default: in turn")
    asked = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    setattr(proving, "predict_proof", Shared().predict)  # noqa: B010 - replaced on purpose
    good: Counter[str] = Counter()
    total: Counter[str] = Counter()
    for k in range(asked.drives):
        truth = draw_drive(asked.first + k)
        try:
            design = tune(declared(truth), TuneRequest(field_weakening="lookup"))
        except DesignInfeasible as error:
            print(f"{asked.first + k}: no design, not counted: {error.what}", flush=True)
            continue
        for kind in ("", *(asked.kinds or (KINDS[k % len(KINDS)],))):
            passed, why = one_move(truth, design, kind)
            name = kind or "healthy"
            total[name] += 1
            good[name] += passed if not kind else not passed
            print(f"{asked.first + k} {name}: {'pass' if passed else 'fail'} {why}", flush=True)
    for name, count in total.items():
        print(f"{name}: {good[name]} of {count}")
    wrong = [name for name in total if name != "healthy"]
    print(f"healthy pass: {interval(good['healthy'], total['healthy'])}")
    print(f"spoiled caught: {interval(sum(good[n] for n in wrong), sum(total[n] for n in wrong))}")


if __name__ == "__main__":
    main()
