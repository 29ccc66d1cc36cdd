# SPDX-License-Identifier: MIT
"""Whether a design reaches the machine's ratings: one that ends below them fails, unless a person accepts the limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pmsmtool.commissioning.closed_stage import FACT, guaranteed
from pmsmtool.design.design_file import Design, load_design
from pmsmtool.proof.stage import ROUNDING
from pmsmtool.run_directory import Acceptance, RunDirectory, Stage

NAMES = ("current", "speed")
"""Limits of a design that can be accepted below the machine's ratings."""


def within_ratings(run: RunDirectory, stage: Stage, accepted: Sequence[str] = ()) -> Stage:
    """Judge the design of a run by the ratings in its machine file; returns its stage with these criteria.

    Parameters
    ----------
    run : RunDirectory
        Holds ``design.toml``.
    stage : Stage
        The stage that made it.
    accepted : sequence of str
        Out of :data:`NAMES`: limits that a person accepts.
    """
    if stage.status not in ("pass", "not available"):
        return stage
    lines, taken = [], []
    for name, held, rated, unit in _limits(load_design(run.path / "design.toml")):
        ok = held >= rated * (1.0 - ROUNDING)
        what, measured = f"rated {name} within the design", f"{held:.4g} {unit}"
        if ok or name not in accepted:
            hint = "" if ok else f" (or --accept-limit {name})"
            lines.append(Acceptance(what, measured, f">= {rated:.4g} {unit}{hint}", ok))
        else:
            lines.append(Acceptance(what, measured, f"accepted below {rated:.4g} {unit}", True))
            taken.append(f"accepted (--accept-limit {name}): the design ends at {measured}, rated {rated:.4g} {unit}")
    if all(line.ok for line in lines):
        shown = lines if stage.status == "pass" else ()
        return replace(stage, acceptance=[*stage.acceptance, *shown], accepted=[*stage.accepted, *taken])
    broken = [f"{line.what}: {line.measured}, limit {line.limit}" for line in lines if not line.ok]
    return replace(stage, status="fail", acceptance=[*stage.acceptance, *lines], note="; ".join(broken))


def _limits(design: Design) -> list[tuple[str, float, float, str]]:
    """Return name, what the design allows, the rating that the machine file states, and the unit."""
    machine = design.machine.machine
    current, speed = design["motor.I_max_apk"], design["motor.n_max_rpm"]
    if guaranteed(design):  # a drive with fixed firmware is flashed with what its guarantee allows
        current = min(current, float(design.facts[f"{FACT}current_apk"]))
        speed = min(speed, float(design.facts[f"{FACT}speed_rpm"]))
    rows = (("current", current, machine.I_nom_apk, "A pk"), ("speed", speed, machine.n_nom_rpm, "rpm"))
    return [(name, held, rated, unit) for name, held, rated, unit in rows if rated is not None]
