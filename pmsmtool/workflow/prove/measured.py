"""The planned experiments on the machine: recorded by the drive, within the guard."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from pmsmtool.drive.port import Drive, Injection
from pmsmtool.experiments.speed_run import reach
from pmsmtool.trace import Trace
from pmsmtool.workflow.prove.plan import SIGNALS, Experiment, ProofPlan

REACH_S = 4.0
"""A speed that is not reached by then is not waited for any longer: the record shows it."""
STANDSTILL_S = 2.0
STANDSTILL_RAD_S = 1.0
"""Longest wait for the shaft, and electrical speed that counts as standstill (the noise of a 12-bit encoder)."""
LOOK_S = 0.05

Keep = Callable[[Experiment, Trace], bool]
"""Told every record as soon as it is there; returns whether to go on."""


def run_experiments(drive: Drive, plan: ProofPlan, pole_pairs: int, keep: Keep, say: Callable[[str], None]) -> None:
    """Run the experiments in their order; the drive is guarded and off on entry.

    Parameters
    ----------
    drive : Drive
        Guarded.
    plan : ProofPlan
        What is run.
    pole_pairs : int
        Of the design.
    keep : callable
        Takes each record; the rest is not run when it returns False.
    say : callable
        Told one line per experiment.
    """
    drive.enable()
    drive.command_current(0.0, 0.0)  # the frame follows the rotor; what a later current step starts from
    for experiment in plan.experiments:
        say(experiment.text)
        if experiment.base_rad_s or experiment.excitation.point is Injection.SPEED:
            drive.command_speed(experiment.base_rad_s)
            if not experiment.base_rad_s:
                _come_to_rest(drive)  # the shaft may still turn from what was done before
        if experiment.base_rad_s:
            reach(drive, pole_pairs * experiment.base_rad_s, limit_s=REACH_S)
            drive.wait(experiment.settle_s)
        trace = drive.record(SIGNALS, experiment.rows, decimation=experiment.decimation,
                             excitation=experiment.excitation)  # fmt: skip
        if not keep(experiment, replace(trace, meta={**trace.meta, **_facts(experiment)})):
            break
    if any(e.base_rad_s for e in plan.experiments):
        drive.command_speed(0.0)
        _come_to_rest(drive)


def _come_to_rest(drive: Drive) -> None:
    """Wait for the shaft as long as it gets slower; the guard's stop brakes what is left."""
    waited, last = 0.0, math.inf
    while waited < STANDSTILL_S:
        speed = abs(drive.live("omega_e_rad_s"))
        if speed > 0.98 * last or speed < STANDSTILL_RAD_S:
            return
        last = speed
        drive.wait(LOOK_S)
        waited += LOOK_S


def _facts(experiment: Experiment) -> dict[str, object]:
    return {"experiment": experiment.name, "text": experiment.text, "repeats": experiment.repeats}
