# SPDX-License-Identifier: MIT
"""From a design to the design of its axis: speed and position gains, feed-forward, notch, and the move to follow."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.axis.loops import AxisGains, AxisPath, Lifted, best_share, following_error
from pmsmtool.axis.move import Move, Profile, jerk_limited, plan
from pmsmtool.axis.search import Box, Case, Judged, Limits, stiffest
from pmsmtool.design.design_file import Design, DesignValue, Scalar
from pmsmtool.design.loops.current_loop import AxisPlant, CurrentGains, axis_loop
from pmsmtool.design.loops.sampled_loop import SampledLoop
from pmsmtool.design.loops.speed_loop import Notch
from pmsmtool.design.ratings import ratings_of
from pmsmtool.design.tolerance import NORMAL_95, tolerance_box
from pmsmtool.errors import ConfigError, DesignInfeasible
from pmsmtool.machine.datasheet import CONVERSION
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import MachineParameters
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.machine.two_masses import Mechanics, mechanics_of, shafts_of
from pmsmtool.params.catalogue import INCREMENTS, MIDDLE_KIND, TORQUE_PER_AMPERE
from pmsmtool.units import rad_s_from_rpm, rpm_from_rad_s

CASCADE = ("position.K_p_per_s", "position.velocity_ff", "position.inertia_ff_kgm2")
PID = (
    "position.pid_p_nm_per_rad", "position.pid_i_nm_per_rads", "position.pid_d_nms_per_rad",
    "position.friction_ff_nms_per_rad",
)  # fmt: skip
SPEED = ("speed.K_p_nms_per_rad", "speed.K_i_nm_per_rad")
SPEED_FORWARD = ("speed.inertia_ff_kgm2", "speed.friction_ff_nms_per_rad")
NOTCH = ("speed.notch_hz", "speed.notch_zeta_num", "speed.notch_zeta_den")
PROFILE = (
    "reference.profile_speed_rpm", "reference.profile_acceleration_rpm_per_s",
    "reference.profile_deceleration_rpm_per_s", "reference.profile_jerk_rpm_per_s2",
)  # fmt: skip
AXIS_GAINS = (*SPEED, *SPEED_FORWARD, *CASCADE[:2], *PID[:3], CASCADE[2], PID[3])
AXIS_ROWS = frozenset((TORQUE_PER_AMPERE, INCREMENTS, *AXIS_GAINS, *NOTCH, *PROFILE))
"""What the design of an axis decides, and what is written into a drive for it."""
SPEED_LOOP, POSITION_LOOP = "axis_speed", "axis_position"

LOOSEST = Limits(20.0, 12.0)
"""Least phase margin and largest |S| that may be asked for."""
AS_WELL = 0.02
"""Gains and following errors that differ by less (relative) are the same: what a count of a drive may change."""
ROUNDED_DEG, ROUNDED_DB = 0.5, 0.1
"""What counts of a drive may take of the margins asked for: a learned map's took 0.3 degrees of one load of ten."""
ASSUMED_RATE_HZ = 1000.0
"""Rate of the loops of a drive that says none."""
OWN_TORQUE = 0.1
"""Half width (relative) of the torque of an ampere that the drive itself holds, whatever its ampere is: as true as a
data sheet's."""
UNKNOWN_KIND = 0.2
"""Of one taken from psi_f, where nothing says if the drive's amperes are peak, rms or block: the middle of peak and rms
is 19 % from both."""
ASSUMED_BITS = 16
"""Of an encoder that the machine file does not state: the drive's own increments are what counts."""
RESONANCE = 0.03
"""Half width (relative) of a resonance without a standard deviation."""
DAMPING_SHARE = 0.5
"""Smallest damping looked at, of one without a standard deviation."""
SPEED_SHARE = 0.8
"""Speed of a move, of the largest speed that has its torque."""
TORQUE_SHARE = 0.6
"""Torque of the acceleration, of the largest one beyond friction: the rest is for the loops."""
WAY_RAD = math.pi
"""Way of the move whose following error is predicted, at these limits."""
OF_TUNED_SPEED = ("notch at", "no notch at", "speed loop of")
"""How notes on the speed loop of `tune` begin: the axis has another."""
RAMP = 4.0
"""Ramp of the acceleration on a rigid shaft, in time constants J / K_p of the speed loop: torque follows to 2 %."""


@dataclass(frozen=True, slots=True)
class AxisRequest:
    """What is asked of an axis.

    Attributes
    ----------
    phase_margin_deg, peak_db : float
        Least phase margin (degree) and largest |S| (dB) of both loops over the tolerance box.
    loop_rate_hz : float or None
        Rate of the drive's speed and position loops (Hz); None: as its map states, else 1 kHz.
    speed_filter_hz : float or None
        Its filter on the speed (Hz); None: as the design says for a reference drive, none for others.
    """

    phase_margin_deg: float = 45.0
    peak_db: float = 6.0
    loop_rate_hz: float | None = None
    speed_filter_hz: float | None = None

    def __post_init__(self) -> None:
        wrong = []
        if not LOOSEST.phase_deg <= self.phase_margin_deg <= 75.0:
            wrong.append(
                f"axis_phase_margin_deg = {self.phase_margin_deg!r} is not between {LOOSEST.phase_deg:g} and 75 degree"
            )
        if not 2.0 <= self.peak_db <= LOOSEST.S_db:
            wrong.append(f"axis_peak_db = {self.peak_db!r} is not between 2 and {LOOSEST.S_db:g} dB")
        for name in ("loop_rate_hz", "speed_filter_hz"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                wrong.append(f"{name} = {value!r} is not a positive number")
        if wrong:
            raise ConfigError(
                "the request cannot be used", where="tune --axis", hint="ask within these bounds", violations=wrong
            )

    def table(self) -> dict[str, Scalar]:
        """Return what was asked, as the design file keeps it."""
        asked: dict[str, Scalar] = {
            "axis": True, "axis_phase_margin_deg": self.phase_margin_deg, "axis_peak_db": self.peak_db,
        }  # fmt: skip
        given = {"loop_rate_hz": self.loop_rate_hz, "axis_speed_filter_hz": self.speed_filter_hz}
        return asked | {name: value for name, value in given.items() if value is not None}

    @classmethod
    def of(cls, design: Design) -> AxisRequest:
        """Return what was asked of a design's axis: :meth:`table` read back."""
        names = ("axis_phase_margin_deg", "axis_peak_db", "loop_rate_hz", "axis_speed_filter_hz")
        return cls(*(design.request.get(name) for name in names))  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class AxisDrive:
    """What of a drive decides its axis.

    Attributes
    ----------
    name : str
        Of its map.
    offers : frozenset of str
        Catalogue names it has objects for.
    own_core : bool
        Whether it runs the control of this program: rate, speed estimate and filter are then those of the design.
    period_s : float or None
        Period of its loops as its map states (s).
    amperes : bool
        Whether its gains are in amperes.
    holds_torque : bool
        Whether it holds the torque of an ampere itself.
    torque_nm : float or None
        What its own limit of the current gives (N m); None: not known.
    """

    name: str
    offers: frozenset[str]
    own_core: bool
    period_s: float | None = None
    amperes: bool = False
    holds_torque: bool = False
    torque_nm: float | None = None

    @property
    def pid(self) -> bool:
        """Whether one controller of the position gives the torque."""
        return PID[0] in self.offers

    @property
    def jerks(self) -> bool:
        """Whether its moves are limited in jerk."""
        return self.own_core or PROFILE[3] in self.offers

    def feeds(self, name: str) -> bool:
        """Whether a feed-forward acts as designed: it is written, or a person enters the whole axis by hand."""
        return name in self.offers or not self.offers & {CASCADE[0], PID[0]}


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
        return _judged(self.design, values, self.box, speed, position)


def assumed_torque(machine: MachineParameters) -> float:
    """Return the torque of an ampere of unknown kind (N m/A): the middle of peak and rms."""
    return MIDDLE_KIND * torque_per_ampere(machine.pole_pairs, machine.psi_f_wb)


def from_pid(K_P: float, K_I: float, K_D: float, like: AxisGains) -> AxisGains:
    """Return the cascade of a PID: K_v is the root of K_D K_v^2 - K_P K_v + K_I that is nearer to another's."""
    apart = math.sqrt(max(K_P * K_P - 4.0 * K_D * K_I, 0.0))
    K_v = min(((K_P + sign * apart) / (2.0 * K_D) for sign in (1.0, -1.0)), key=lambda root: abs(root - like.K_v))
    return replace(like, K_p=K_D, K_i=K_P - K_D * K_v, K_v=K_v)


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
    move = _own_move(design, drive)
    before, _ = move_peaks(box.path, box.plant, position, move, stored, made.friction_nm)
    told: dict[str, Scalar] = {
        "axis_error_rad": after, "axis_stored_error_rad": before, "axis_stored_phase_least_deg": phase,
        "axis_stored_S_peak_db": peak, "axis_stored_gains": "not kept: the designed ones follow as well",
    }  # fmt: skip
    if all(abs(stored[name] / design[name] - 1.0) < AS_WELL for name in _gain_rows(drive)):
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
    share, error = _best_forward(made.box, position, move, drive)
    friction = made.friction_nm / position.pid[0]
    values = {SPEED[0]: speed.K_p, SPEED[1]: speed.K_i, CASCADE[0]: position.K_v}
    if drive.pid:
        values = dict(zip(PID, position.pid, strict=False))
    values |= zip(NOTCH, (position.notch.hz, position.notch.zeta_num, position.notch.zeta_den), strict=True)
    how = "as the drive holds it"
    gains = {name: DesignValue(value, how, design.values[name].loop) for name, value in values.items()}
    forward = f"{share:g} of the inertia: the least predicted following error"
    gains |= {
        name: DesignValue(share * J, forward)
        for name in (*CASCADE[2:], SPEED_FORWARD[0])
        if name in design.values and name in drive.offers
    }
    facts = {
        "axis_inertia_ff_share": share, "axis_following_error_rad": error, "axis_friction_error_rad": friction,
        "axis_error_rad": error + friction,
    }  # fmt: skip
    base = made.noted(facts, "the stored gains are kept: the designed ones would follow worse").design
    return replace(made, design=_judged(base, gains, made.box, speed, position), speed=speed, position=position)


def _own_move(design: Design, drive: AxisDrive) -> Move:
    """Return the move of a design by half a turn, at its limits, as the drive makes it."""
    speed, acceleration, jerk = (
        float(design.facts[f"axis_{name}"]) for name in ("speed_rad_s", "acceleration_rad_s2", "jerk_rad_s3")
    )
    return plan(WAY_RAD, Profile(speed, acceleration, jerk if drive.jerks else math.inf))


def move_peaks(
    path: AxisPath, plant: Lifted, gains: AxisGains, move: Move, held: Mapping[str, float], friction_nm: float
) -> tuple[float, float]:
    """Return the largest following error (rad) and torque (N m) of a move there and back.

    The error is that of the loops, and what friction adds without integral part; the torque has no limit.

    ``held``: the feed-forwards that a drive holds, by catalogue name.
    """
    plain, added = following_error(plant, path, gains, move, held.get(CASCADE[1], 0.0))
    error, torque = np.max(np.abs(plain + held.get(CASCADE[2], 0.0) / path.shaft.J * added), axis=1)
    return float(error) + friction_nm / gains.pid[0], float(torque) + friction_nm


def _best_forward(box: Box, gains: AxisGains, move: Move, drive: AxisDrive) -> tuple[float, float]:
    """Return the share of the inertia to feed forward and the following error (rad), with what acts on this drive."""
    plain, added = following_error(box.plant, box.path, gains, move, float(drive.feeds(CASCADE[1])))
    return best_share(plain, added if drive.feeds(CASCADE[2]) else np.zeros_like(added))


def _gain_rows(drive: AxisDrive) -> tuple[str, ...]:
    """Return the gains that decide how a move is followed."""
    return PID[:3] if drive.pid else (*SPEED, *CASCADE[:1])


def held_loop(held: Mapping[str, float], like: AxisGains, drive: AxisDrive) -> AxisGains | None:
    """Return the loop of the position that gains of a drive make; None where one of them is missing or off.

    ``like``: gains of a similar loop, for the K_v of one controller of the position.
    """
    if not all(held.get(name, 0.0) > 0.0 for name in _gain_rows(drive)):
        return None
    notch = Notch(held.get(NOTCH[0], 0.0), *(held.get(name, 1.0) for name in NOTCH[1:]))
    if drive.pid:
        return replace(from_pid(held[PID[0]], held[PID[1]], held[PID[2]], like), notch=notch)
    return AxisGains(held[SPEED[0]], held[SPEED[1]], held[CASCADE[0]], notch)


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
    torque = ratings_of(design).tau_max_nm
    if drive.torque_nm is not None and drive.torque_nm < torque:
        share, torque = drive.torque_nm / torque, drive.torque_nm
        notes = (*notes, f"the drive's own current limit gives {share:.3g} of the largest torque: the move is for that")
    elif drive.torque_nm is None and not drive.own_core:
        notes = (*notes, "the drive's own current limit is not known (--stored): the move is for that of the machine")
    profile = profile_of(design, shaft, position, path.T, torque)
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
    share, error = _best_forward(box, position, _own_move(base, drive), drive)
    predicted: dict[str, Scalar] = {
        "axis_inertia_ff_share": share,
        "axis_following_error_rad": error,
        "axis_friction_error_rad": (source.machine.tau_c_nm or 0.0) / position.pid[0],
    }
    behind = error + float(predicted["axis_friction_error_rad"])
    if behind > WAY_RAD:
        raise DesignInfeasible(
            f"with margins over the tolerance box a move of half a turn stays {math.degrees(behind):.3g} deg behind",
            where="axis", likely="a resonance that is little damped, or of an unknown damping, without a notch",
            hint="measure it with `identify frf`, ask for smaller margins, or keep the gains that the drive holds",
        )  # fmt: skip
    base = replace(base, facts={**base.facts, **predicted})
    values = axis_values(source, speed, position, share, profile, drive, how)
    return AxisDesign(_judged(base, values, box, speed, position), box, speed, position)


def _judged(
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


def axis_path(
    design: Design, request: AxisRequest, drive: AxisDrive, shaft: Mechanics
) -> tuple[AxisPath, tuple[str, ...]]:
    """Return what lies between torque and angle on this drive, and what was assumed."""
    current = _current(design)
    if drive.own_core:
        return AxisPath(
            shaft, current, int(design["speed.decimation"]), pll_rad_s=design["encoder.pll_bandwidth_rad_s"],
            filter_hz=design["speed.filter_hz"],
        ), ()  # fmt: skip
    notes = []
    period = 1.0 / request.loop_rate_hz if request.loop_rate_hz else drive.period_s
    if period is None:
        period = 1.0 / ASSUMED_RATE_HZ
        notes.append(
            f"the map {drive.name!r} does not state the rate of the loops: {ASSUMED_RATE_HZ:g} Hz assumed; "
            "--loop-rate-hz gives it"
        )
    decimation = max(1, round(period / current.T_s))
    if abs(decimation * current.T_s / period - 1.0) > 0.02:
        # the loops run on their own clock: take the control period that fits a whole number of times
        current = replace(current, T_s=period / decimation)
    notes.append("the torque of a sample is taken to act one period of the loops later, besides the current loop")
    structure = "pid" if drive.pid else "cascade"
    return AxisPath(shaft, current, decimation, 1, structure, filter_hz=request.speed_filter_hz or 0.0), tuple(notes)  # type: ignore[arg-type]


def _current(design: Design) -> SampledLoop:
    machine, inverter = design.machine.machine, design.machine.inverter
    plant = AxisPlant(machine.R_s_ohm, machine.L_q_h, inverter.T_s, inverter.delay_periods)
    gains = CurrentGains(design["current.K_p_q_v_per_a"], design["current.K_i_q_v_per_as"])
    return axis_loop(gains, plant, plant if design.request.get("predictor") else None)


def cases(source: MachineFile, drive: AxisDrive) -> tuple[Case, ...]:
    """Return the corners of the tolerance box that decide the loops: torque over inertia, resonance and damping."""
    factors = tolerance_box(source).factors
    inertia = factors["J_kgm2"].half_width
    torque = factors["psi_f_wb"].half_width if "psi_f_wb" in factors else 0.0
    if drive.amperes:
        torque = OWN_TORQUE if drive.holds_torque else UNKNOWN_KIND
    ends = ((1.0 - torque) / (1.0 + inertia), (1.0 + torque) / (1.0 - min(inertia, 0.8)))
    f_r = source.machine.resonance_hz
    if f_r is None:  # with play, or where what swings is not known, elastic shafts that it may be
        others = (None, *shafts_of(source)[1:])
        return tuple(Case(end, shaft=shaft) for end in ends for shaft in others)
    doubt = _half_width(source, "resonance_hz", f_r, RESONANCE)
    zeta = source.machine.resonance_zeta
    least = 1.0 - (_half_width(source, "resonance_zeta", zeta, DAMPING_SHARE) if zeta else DAMPING_SHARE)
    shifts = (1.0 - doubt, 1.0 + doubt)
    return tuple(Case(end, shift, max(least, 0.1)) for end in ends for shift in shifts)


def _half_width(source: MachineFile, key: str, value: float, otherwise: float) -> float:
    """Return half of the 95 % interval of a key, relative; ``otherwise`` where the file has no standard deviation."""
    if key not in source.std:
        return otherwise
    return (NORMAL_95 * source.std[key] + source.systematic.get(key, 0.0)) / value


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
    told = (*SPEED, *NOTCH, *(() if drive.pid else CASCADE))  # without an object, too: a person enters them
    values = {name: value for name, value in found.items() if name in drive.offers or name in told}
    if drive.amperes:
        K_t = assumed_torque(machine)
        how = "1.5 p psi_f per ampere, between peak and rms: compared, never written"
        values[TORQUE_PER_AMPERE] = DesignValue(K_t, how)
    if INCREMENTS in drive.offers:
        bits = source.encoder.bits or ASSUMED_BITS
        values[INCREMENTS] = DesignValue(2.0**bits, "of the encoder; the drive's own are taken, never written")
    return values
