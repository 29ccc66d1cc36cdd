# SPDX-License-Identifier: MIT
"""A design of an axis beside the gains that the drive holds: these are kept where they follow better."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from pmsmtool.axis.design import AxisDesign, best_forward, judged_design, move_peaks, own_move
from pmsmtool.axis.drive import CASCADE, LEAD, NOTCH, PID, SPEED, SPEED_FORWARD, AxisDrive, gain_rows, held_loop
from pmsmtool.axis.loops import AxisGains
from pmsmtool.axis.move import Move
from pmsmtool.design.design_file import DesignValue, Scalar

AS_WELL = 0.02
"""Gains and following errors that differ by less (relative) are the same: what a count of a drive may change."""


def at_least_as_good(made: AxisDesign, stored: Mapping[str, float], drive: AxisDrive) -> AxisDesign:
    """Return a design of the axis, with the gains a drive holds where they follow better with the margins asked for.

    What is compared is the largest following error of one move: that of the loops, with the feed-forward that belongs
    to the gains, and what Coulomb friction adds. Stored gains that follow better with less margin than asked for are
    not kept. ``axis_stored_gains`` says what became of them.

    ``stored``: what the drive holds, by catalogue name; without all gains of its controller nothing is compared.
    """
    design, box, limits = made.design, made.box, made.limits
    position = held_loop(stored, made.position, drive)
    if position is None:
        note = "no comparison with the stored gains: those of a loop are missing or zero"
        return made.noted({"axis_stored_gains": "not compared"}, note)
    speed = made.speed if drive.pid else position
    judged = [box.judged(position, "position")]
    if not drive.pid:  # one controller of the position moves alone: the controller of the speed stays as designed
        judged.append(box.judged(speed, "speed"))
    phase, peak = min(found.phase_deg for found in judged), max(found.S_db for found in judged)
    after = float(design.facts["axis_following_error_rad"]) + float(design.facts["axis_friction_error_rad"])
    if not math.isfinite(phase):
        note = "the stored gains are unstable somewhere in the tolerance box: they are not kept"
        return made.noted({"axis_error_rad": after, "axis_stored_gains": "not kept: unstable"}, note)
    move = own_move(design, drive)
    before, _ = move_peaks(box.path, box.plant, position, move, stored, made.friction_nm)
    told: dict[str, Scalar] = {
        "axis_error_rad": after, "axis_stored_error_rad": before, "axis_stored_phase_least_deg": phase,
        "axis_stored_S_peak_db": peak, "axis_stored_gains": "not kept: the designed ones follow at least as well",
    }  # fmt: skip
    if all(abs(stored[name] / design[name] - 1.0) < AS_WELL for name in gain_rows(drive)):
        return made.noted(told | {"axis_stored_gains": "as designed"}, "the drive holds the designed gains already")
    if after <= (1.0 + AS_WELL) * before:
        return made.noted(told)
    if phase >= limits.phase_deg and peak <= limits.S_db:
        return _kept(made.noted({**told, "axis_stored_gains": "kept"}), speed, position, move, drive)
    errors = " against ".join(f"{math.degrees(error):.3g}" for error in (before, after))
    note = (
        f"the stored gains are not kept: {phase:.3g} deg and {peak:.3g} dB over the tolerance box, of both loops "
        f"opened at the torque; asked for are {limits}. They would follow better: {errors} deg; "
        "--axis-phase-margin-deg and --axis-peak-db allow less margin"
    )
    return made.noted({**told, "axis_stored_gains": "not kept: less margin than asked for"}, note)


def _kept(made: AxisDesign, speed: AxisGains, position: AxisGains, move: Move, drive: AxisDrive) -> AxisDesign:
    """Return a design of the axis with the gains that the drive holds, and the feed-forward that belongs to them."""
    design, J = made.design, made.box.path.shaft.J
    share, error = best_forward(made.box, position, move, drive)
    friction = made.friction_nm / position.pid[0]
    values = {SPEED[0]: speed.K_p, SPEED[1]: speed.K_i, CASCADE[0]: position.K_v}
    if drive.pid:
        values = dict(zip(PID, position.pid, strict=False))
    values |= zip(NOTCH, (position.notch.hz, position.notch.zeta_num, position.notch.zeta_den), strict=True)
    how = "as the drive holds it"
    gains = {name: DesignValue(value, how, design.values[name].loop) for name, value in values.items()}
    forward = f"{share:g} of the inertia: the least predicted following error"
    fed = {CASCADE[2]: share * J, SPEED_FORWARD[0]: share * J, LEAD: share * J / position.K_p}
    gains |= {
        name: DesignValue(value, forward)
        for name, value in fed.items()
        if name in design.values and name in drive.offers
    }
    facts = {
        "axis_inertia_ff_share": share, "axis_following_error_rad": error, "axis_friction_error_rad": friction,
        "axis_error_rad": error + friction,
    }  # fmt: skip
    base = made.noted(facts, "the stored gains are kept: the designed ones would follow worse").design
    return replace(made, design=judged_design(base, gains, made.box, speed, position), speed=speed, position=position)
