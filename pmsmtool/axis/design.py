# SPDX-License-Identifier: MIT
"""From a design to the design of its axis: speed and position gains, feed-forward, notch, and the move to follow."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.axis.drive import (
    CASCADE,
    DERIVATIVE,
    LEAD,
    NOTCH,
    PID,
    PROFILE,
    SPEED,
    SPEED_FORWARD,
    AxisDrive,
    AxisRequest,
    assumed_torque,
    axis_path,
    cases,
    from_pid,
)  # fmt: skip
from pmsmtool.axis.loops import AxisGains, AxisPath, Lifted, best_share, following_error
from pmsmtool.axis.move import Move, Profile, followed, jerk_limited, plan
from pmsmtool.axis.search import Box, Judged, Limits, stiffest
from pmsmtool.design.design_file import Design, DesignValue, Scalar
from pmsmtool.design.ratings import ratings_of
from pmsmtool.errors import DesignInfeasible
from pmsmtool.machine.datasheet import CONVERSION
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.two_masses import Mechanics, mechanics_of
from pmsmtool.params.catalogue import INCREMENTS, TORQUE_PER_AMPERE
from pmsmtool.units import rad_s_from_rpm, rpm_from_rad_s

SPEED_LOOP, POSITION_LOOP = "axis_speed", "axis_position"
ROUNDED_DEG, ROUNDED_DB = 0.5, 0.1
"""What counts of a drive may take of the margins asked for: a learned map's took 0.3 degrees of one load of ten."""
ASSUMED_BITS = 16
"""Of an encoder that the machine file does not state: the drive's own increments are what counts."""
SPEED_SHARE = 0.8
"""Speed of a move, of the largest speed that has its torque."""
TORQUE_SHARE = 0.6
"""Torque of the acceleration, of the largest one beyond friction: the rest is for the loops."""
WAY_RAD = math.pi
"""Way of the move whose following error is predicted, at these limits."""
FILTER_SHARE, FILTER_WORTH = 0.1, 2.0
"""Low-pass of the speed that is tried where a resonance limits a drive without a notch, of its frequency, and how many
times the position gain it must give to be named."""
RESONANCE_LIMITS = 0.1
"""Crossover K_p / J of the speed times its lag below which a resonance limits it (0.39 on rigid shafts, measured)."""
OF_TUNED_SPEED = ("notch at", "no notch at", "speed loop of")
"""How notes on the speed loop of `tune` begin: the axis has another."""
RAMP = 4.0
"""Ramp of the acceleration on a rigid shaft, in time constants J / K_p of the speed loop: torque follows to 2 %."""


@dataclass(frozen=True, slots=True)
class AxisDesign:
    """A design with its axis, and what judges other gains for it: those a drive holds after rounding."""

    design: Design
    box: Box
    speed: AxisGains
    position: AxisGains

    def noted(self, facts: Mapping[str, Scalar], *notes: str) -> AxisDesign:
        """Return the design with more facts and notes."""
        design = self.design
        return replace(self, design=replace(design, facts={**design.facts, **facts}, notes=(*design.notes, *notes)))

    @property
    def limits(self) -> Limits:
        """What was asked for."""
        asked = AxisRequest.of(self.design)
        return Limits(asked.phase_margin_deg, asked.peak_db)

    @property
    def friction_nm(self) -> float:
        """Coulomb friction (N m)."""
        return self.design.machine.machine.tau_c_nm or 0.0

    def with_held(self, held: Mapping[str, float]) -> Design:
        """Return the design with values as a drive holds them, by catalogue name, judged by the loops these make."""
        values = {name: replace(self.design.values[name], value=value) for name, value in held.items()}
        speed, position = self.speed, self.position
        if SPEED[0] in held and SPEED[1] in held:
            speed = replace(speed, K_p=held[SPEED[0]], K_i=held[SPEED[1]], K_v=held.get(CASCADE[0], speed.K_v))
        if PID[0] in held:
            position = from_pid(held[PID[0]], held[PID[1]], held[PID[2]], position)
        elif self.box.path.structure == "cascade":
            position = speed
        return judged_design(self.design, values, self.box, speed, position)


def own_move(design: Design, drive: AxisDrive) -> Move:
    """Return the move of a design by half a turn, at its limits, as the drive makes it."""
    speed, acceleration, jerk = (
        float(design.facts[f"axis_{name}"]) for name in ("speed_rad_s", "acceleration_rad_s2", "jerk_rad_s3")
    )
    return _move(Profile(speed, acceleration, jerk), drive)


def _move(profile: Profile, drive: AxisDrive) -> Move:
    return plan(WAY_RAD, profile if drive.jerks else replace(profile, jerk=math.inf))


def move_peaks(
    path: AxisPath, plant: Lifted, gains: AxisGains, move: Move, held: Mapping[str, float], friction_nm: float
) -> tuple[float, float]:
    """Return the largest following error (rad) and torque (N m) of a move there and back.

    The error is that of the loops, and what friction adds without integral part; the torque has no limit.

    ``held``: the feed-forwards that a drive holds, by catalogue name.
    """
    leads = LEAD in held
    plain, added = following_error(plant, path, gains, move, held.get(CASCADE[1], 0.0), leads=leads)
    forward = held[LEAD] * gains.K_p if leads else held.get(CASCADE[2], 0.0)
    error, torque = np.max(np.abs(plain + forward / path.shaft.J * added), axis=1)
    return float(error) + friction_nm / gains.pid[0], float(torque) + friction_nm


def best_forward(box: Box, gains: AxisGains, move: Move, drive: AxisDrive) -> tuple[float, float]:
    """Return the share of the inertia to feed forward and the following error (rad), with what acts on this drive."""
    plain, added = following_error(
        box.plant, box.path, gains, move, float(drive.feeds(CASCADE[1])), leads=drive.leads
    )  # fmt: skip
    return best_share(plain, added if drive.leads or drive.feeds(CASCADE[2]) else np.zeros_like(added))


def with_axis(design: Design, request: AxisRequest, drive: AxisDrive) -> AxisDesign:
    """Return a design whose speed and position loops are those of its axis.

    Raises ConfigError: the machine has no inertia; DesignInfeasible: no gains keep the margins over the tolerance box.

    Parameters
    ----------
    design : Design
        As ``tune`` makes it: its current loop is part of the path.
    """
    source = design.machine
    shaft = mechanics_of(source)
    path, notes = axis_path(design, request, drive, shaft)
    box = Box(path, cases(source, drive))
    limits, notch = Limits(request.phase_margin_deg, request.peak_db), NOTCH[0] in drive.offers
    if drive.pid:  # the controller of the speed acts in velocity modes alone
        speed = stiffest(box, limits, notch=notch, loops=("speed",))
        position = stiffest(box, limits, notch=notch, loops=("position",))
    else:
        speed = position = stiffest(box, limits, notch=notch)
    filtered = _filter_worth(box, limits, position, drive)
    notes = (*notes, *([filtered] if filtered else []))
    torque = ratings_of(design).tau_max_nm
    if drive.torque_nm is not None and drive.torque_nm < torque:
        share, torque = drive.torque_nm / torque, drive.torque_nm
        notes = (*notes, f"the drive's own current limit gives {share:.3g} of the largest torque: the move is for that")
    elif drive.torque_nm is None and not drive.own_core:
        notes = (*notes, "the drive's own current limit is not known (--stored): the move is for that of the machine")
    profile = profile_of(design, shaft, position, path.T, torque)
    friction_rad = (source.machine.tau_c_nm or 0.0) / position.pid[0]

    def behind(limits: Profile) -> float:
        return best_forward(box, position, _move(limits, drive), drive)[1] + friction_rad

    far = behind(profile)
    if far > WAY_RAD:
        raise DesignInfeasible(
            f"with margins over the tolerance box a move of half a turn stays {math.degrees(far):.3g} deg behind",
            where="axis", likely="a resonance that is little damped, or of an unknown damping, without a notch",
            hint=filtered or "measure it with `identify frf`, ask for smaller margins, or keep the drive's own gains",
        )  # fmt: skip
    slow = followed(WAY_RAD, profile, behind)
    if slow is not None and slow != profile:
        share = slow.speed / profile.speed
        notes = (*notes, f"the move has {share:.2g} of the speed and acceleration that voltage and torque allow: with "
                         f"those the shaft would stay {math.degrees(far):.3g} deg behind")  # fmt: skip
        profile = slow
    unknown = [case.shaft.resonance_hz for case in box.cases if case.shaft is not None]
    if unknown:
        swings = f"the shaft has play, or is not rigid: it may swing from {min(unknown):.3g} to {max(unknown):.3g} Hz"
        notes = (*notes, f"{swings}, and the loops keep their margins with all of that")
    hertz = design.loops["current_q"].bandwidth_rad_s / (2.0 * math.pi)
    counted = f"the margins count on a q current loop of {hertz:.3g} Hz, which the set of the axis does not write"
    notes = (*notes, f"{counted}: `tune` without --axis designs it")
    inertia = source.estimates.get("J_kgm2")
    if inertia is not None and inertia.method == CONVERSION:
        stated = f"the inertia {inertia.value:.4g} kg m2 is as given, not measured"
        notes = (*notes, f"{stated}: of the motor alone, the load is missing, and the margins do not hold with it")
    if PROFILE[3] not in drive.offers and PROFILE[0] in drive.offers:
        notes = (*notes, "no object for the jerk (0x60A4): moves are trapezoids")
    how = f"stiffest with {request.phase_margin_deg:g} deg and |S| below {request.peak_db:g} dB over the tolerance box"
    asked: dict[str, Scalar] = {**design.request, **request.table()}
    if not drive.own_core:
        asked["drive"] = drive.name
    facts: dict[str, Scalar] = {
        **{name: fact for name, fact in design.facts.items() if name != "speed_crossover_rad_s"},
        "axis_structure": path.structure,
        "axis_loop_period_s": path.T,
        "axis_load_ratio": shaft.load_ratio,
        "axis_torque_nm": torque,
        "axis_speed_rad_s": profile.speed,
        "axis_acceleration_rad_s2": profile.acceleration,
        "axis_jerk_rad_s3": profile.jerk,
    }
    # the loop of the speed alone is judged as part of the axis
    kept = {name: replace(value, loop="") if value.loop == "speed" else value for name, value in design.values.items()}
    base = replace(
        design, request=asked, facts=facts, values=kept,
        notes=(*(note for note in design.notes if not note.startswith(OF_TUNED_SPEED)), *notes),
        loops={name: loop for name, loop in design.loops.items() if name != "speed"},
    )  # fmt: skip
    share, error = best_forward(box, position, own_move(base, drive), drive)
    predicted: dict[str, Scalar] = {
        "axis_inertia_ff_share": share,
        "axis_following_error_rad": error,
        "axis_friction_error_rad": friction_rad,
    }
    base = replace(base, facts={**base.facts, **predicted})
    values = axis_values(source, speed, position, share, profile, drive, how)
    return AxisDesign(judged_design(base, values, box, speed, position), box, speed, position)


def _filter_worth(box: Box, limits: Limits, gains: AxisGains, drive: AxisDrive) -> str:
    """Return what a low-pass of the speed gives where a resonance limits a cascade without a notch, else nothing."""
    path = box.path
    slow = gains.K_p / path.shaft.J * path.lag_s < RESONANCE_LIMITS
    if NOTCH[0] in drive.offers or path.structure != "cascade" or path.filter_hz or not (path.shaft.elastic and slow):
        return ""
    smoothed = replace(path, filter_hz=FILTER_SHARE * path.shaft.resonance_hz)
    try:
        more = stiffest(Box(smoothed, box.cases), limits, notch=False).K_v / gains.K_v
    except DesignInfeasible:
        return ""
    if more < FILTER_WORTH:
        return ""
    hertz = f"{smoothed.filter_hz:.2g}"
    return (
        f"the resonance limits the gains: with a low-pass of {hertz} Hz on the speed, set in the drive, the position "
        f"gain can be {more:.2g} times as large (--speed-filter-hz {hertz})"
    )


def judged_design(
    design: Design, values: Mapping[str, DesignValue], box: Box, speed: AxisGains, position: AxisGains
) -> Design:
    """Return a design with values of its axis, judged by the loops that the gains make."""
    loops, facts = dict(design.loops), dict(design.facts)
    facts |= {
        "axis_K_p_nms_per_rad": position.K_p,
        "axis_K_i_nm_per_rad": position.K_i,
        "axis_K_v_per_s": position.K_v,
        "axis_stiffness_nm_per_rads": position.K_i * position.K_v,
    }
    for name, found in ((SPEED_LOOP, box.judged(speed, "speed")), (POSITION_LOOP, box.judged(position, "position"))):
        loops[name] = found.nominal.loop
        facts |= _facts(name, found)
    asked = AxisRequest.of(design)
    facts["axis_margins_kept"] = all(
        float(facts[f"{name}_phase_least_deg"]) >= asked.phase_margin_deg - ROUNDED_DEG
        and float(facts[f"{name}_S_peak_db"]) <= asked.peak_db + ROUNDED_DB
        for name in (SPEED_LOOP, POSITION_LOOP)
    )
    return replace(design, values={**design.values, **values}, loops=loops, facts=facts)


def _facts(name: str, found: Judged) -> dict[str, Scalar]:
    return {
        f"{name}_phase_least_deg": found.phase_deg,
        f"{name}_phase_least_at": str(found.phase_case),
        f"{name}_S_peak_db": found.S_db,
        f"{name}_S_peak_at": str(found.S_case),
        f"{name}_T_peak_db": found.T_db,
    }


def profile_of(design: Design, shaft: Mechanics, gains: AxisGains, T: float, torque_nm: float) -> Profile:
    """Return the limits of a move that a torque and the voltage allow, and that leaves the load at rest."""
    source, rated = design.machine, ratings_of(design)
    top_rpm = min(rated.n_max_rpm, rated.base_speed_rpm) if rated.base_speed_rpm > 0.0 else rated.n_max_rpm
    speed, B = SPEED_SHARE * rad_s_from_rpm(top_rpm), source.machine.B_nms or 0.0
    if torque_nm < rated.tau_max_nm and B:  # half of a low limit is left to accelerate
        speed = min(speed, 0.5 * _beyond_friction(torque_nm, source, 0.0) / B)
    torque = TORQUE_SHARE * _beyond_friction(torque_nm, source, speed)
    ramp = 1.0 / shaft.antiresonance_hz if shaft.elastic else RAMP * shaft.J / gains.K_p
    return jerk_limited(speed, torque / shaft.J, math.ceil(ramp / T) * T)


def profile_within(design: Design, torque_nm: float) -> Profile:
    """Return the limits of a move of a design of the axis where a drive gives less than the largest torque.

    The same share of what it gives beyond friction accelerates, in ramps of the same time.

    Raises DesignInfeasible: friction takes the whole torque.
    """
    source, facts = design.machine, design.facts
    speed, acceleration, jerk = (
        float(facts[f"axis_{name}"]) for name in ("speed_rad_s", "acceleration_rad_s2", "jerk_rad_s3")
    )
    most = float(facts.get("axis_torque_nm", ratings_of(design).tau_max_nm))  # as of earlier versions: the largest
    given, whole = (_beyond_friction(torque, source, speed) for torque in (min(torque_nm, most), most))
    return Profile(speed, acceleration * given / whole, jerk * given / whole)


def _beyond_friction(torque_nm: float, source: MachineFile, speed: float) -> float:
    machine = source.machine
    left = torque_nm - (machine.tau_c_nm or 0.0) - (machine.B_nms or 0.0) * speed
    if left <= 0.0:
        raise DesignInfeasible(
            f"friction takes the whole torque, {torque_nm:.4g} N m, at {rpm_from_rad_s(speed):.4g} rpm",
            where="machine.B_nms, machine.tau_c_nm",
            hint="correct the friction, or the largest speed, or allow more current",
        )
    return left


def axis_values(
    source: MachineFile,
    speed: AxisGains,
    position: AxisGains,
    inertia_share: float,
    profile: Profile,
    drive: AxisDrive,
    how: str,
) -> dict[str, DesignValue]:
    """Return the values of an axis by catalogue name; those of other makers' drives as far as this one has objects."""
    machine = source.machine
    J, B = machine.J_kgm2 or 0.0, machine.B_nms or 0.0
    K_P, K_I, K_D = position.pid
    forward = f"{inertia_share:g} of the inertia: the least predicted following error"
    notch = "at the resonance" if position.notch.hz else "off: not needed, or the drive has none"
    profile_how = f"{SPEED_SHARE:g} of the largest speed, {TORQUE_SHARE:g} of the torque beyond friction"
    found = {
        SPEED[0]: DesignValue(speed.K_p, how, SPEED_LOOP),
        SPEED[1]: DesignValue(speed.K_i, how, SPEED_LOOP),
        SPEED_FORWARD[0]: DesignValue(inertia_share * J, forward),
        SPEED_FORWARD[1]: DesignValue(B, "viscous friction"),
        NOTCH[0]: DesignValue(position.notch.hz, notch),
        NOTCH[1]: DesignValue(position.notch.zeta_num, notch),
        NOTCH[2]: DesignValue(position.notch.zeta_den, notch),
        CASCADE[0]: DesignValue(position.K_v, how, POSITION_LOOP),
        CASCADE[1]: DesignValue(1.0, "the whole speed of the reference"),
        CASCADE[2]: DesignValue(inertia_share * J, forward),
        LEAD: DesignValue(inertia_share * J / position.K_p, forward),
        DERIVATIVE: DesignValue(0.0, "as little as the drive's object takes"),
        PID[0]: DesignValue(K_P, how, POSITION_LOOP),
        PID[1]: DesignValue(K_I, how, POSITION_LOOP),
        PID[2]: DesignValue(K_D, how, POSITION_LOOP),
        PID[3]: DesignValue(B, "viscous friction"),
        PROFILE[0]: DesignValue(rpm_from_rad_s(profile.speed), profile_how),
        PROFILE[1]: DesignValue(rpm_from_rad_s(profile.acceleration), profile_how),
        PROFILE[2]: DesignValue(rpm_from_rad_s(profile.acceleration), profile_how),
        PROFILE[3]: DesignValue(
            rpm_from_rad_s(profile.jerk), "a ramp of one period of the load's own swing, or of 4 J / K_p"
        ),
    }
    # without an object, too: a person enters them
    told = (*SPEED, *NOTCH, *(() if drive.pid else CASCADE[: 2 if drive.leads else 3]))
    values = {name: value for name, value in found.items() if name in drive.offers or name in told}
    if not drive.leads:
        values.pop(LEAD, None)
    if drive.amperes:
        K_t = assumed_torque(machine)
        how = "1.5 p psi_f per ampere, between peak and rms: compared, never written"
        values[TORQUE_PER_AMPERE] = DesignValue(K_t, how)
    if INCREMENTS in drive.offers:
        bits = source.encoder.bits or ASSUMED_BITS
        values[INCREMENTS] = DesignValue(2.0**bits, "of the encoder; the drive's own are taken, never written")
    return values
