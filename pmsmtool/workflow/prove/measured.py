"""The planned experiments on the machine: recorded by the drive, within the guard."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from pmsmtool.drive.port import Drive, Injection
from pmsmtool.experiments.speed_run import reach
from pmsmtool.trace import Trace
from pmsmtool.workflow.prove.plan import RPM, SIGNALS, Experiment, ProofPlan

REACH_S = 4.0
"""A speed that is not reached by then is not waited for any longer: the record shows it."""
STANDSTILL_S = 2.0
STANDSTILL_RAD_S = 1.0
"""Longest wait for the shaft, and electrical speed that counts as standstill (the noise of a 12-bit encoder)."""
LOOK_S = 0.05
RISE_STEPS = 64
RISE_SHARE = 0.25
RISE_S = 3.0
"""A speed is approached in this many steps, on average with this share of the design's slope, but within this time (s):
at full torque a current limit below the design's leaves no i_q beside the i_d that the look-up tables ask for, and the
machine stays where it is (interior-2k2 at 5 A: at 375 of 474 rad/s with i_d = -4.99 A)."""

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
            _approach(drive, experiment.base_rad_s, pole_pairs)
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


def _approach(drive: Drive, speed_rad_s: float, pole_pairs: int) -> None:
    """Ask for a mechanical speed (rad/s), for one above the present in small steps."""
    present = drive.live("omega_e_rad_s") / pole_pairs
    rise = speed_rad_s - present
    slope = RISE_SHARE * drive.read("speed.acceleration_rpm_per_s") * RPM
    if present >= 0.0 and rise > 0.0 and slope > 0.0:
        for k in range(1, RISE_STEPS):
            drive.command_speed(present + rise * k / RISE_STEPS)
            drive.wait(min(rise / slope, RISE_S) / RISE_STEPS)
    drive.command_speed(speed_rad_s)


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
