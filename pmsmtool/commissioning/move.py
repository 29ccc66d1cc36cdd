# SPDX-License-Identifier: MIT
"""One move there and back by a drive's position loop: planned, with what a design says of it, made, and kept."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from pmsmtool.axis.design import move_peaks, profile_within
from pmsmtool.axis.drive import CURRENT, PROFILE, AxisRequest, axis_path, cases, held_loop
from pmsmtool.axis.loops import AxisGains, bandwidth
from pmsmtool.axis.move import ENDED, UNITS, MoveResult, Profile, followed, move_result, plan, shown
from pmsmtool.axis.search import Box
from pmsmtool.commissioning.axis_design import axis_drive
from pmsmtool.commissioning.compared_stage import refuse_inertia
from pmsmtool.commissioning.contradiction import flux_doubt, stated_share
from pmsmtool.design.design_file import Design
from pmsmtool.drive.changed_objects import refuse_no_current
from pmsmtool.drive.envelope import Envelope, largest_acceleration, largest_torque
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.motion_objects import first_of_axes, held_current_limits, low_limits
from pmsmtool.drive.position_drive import PositionDrive
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.errors import ConfigError, Contradiction
from pmsmtool.experiments.move import MoveProfile, record_move
from pmsmtool.identification.cogging import PARTIAL, Cogging, save_cogging
from pmsmtool.identification.completed_machine import PER_PSI, completed_machine
from pmsmtool.identification.move_mechanics import move_mechanics
from pmsmtool.identification.partial_cogging import partial_cogging
from pmsmtool.identification.value_verdict import value_facts
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.two_masses import mechanics_of
from pmsmtool.params.catalogue import BY_NAME
from pmsmtool.plain_text import counted
from pmsmtool.run_directory import RunDirectory, Stage
from pmsmtool.trace import Trace, trace_npz
from pmsmtool.units import rad_s_from_rpm, rpm_from_rad_s

SPEED, UP, DOWN, JERK = PROFILE
HELD, DESIGNED = "that the drive holds", "of the design"
TRAVEL_MARGIN, SPEED_MARGIN = 1.5, 1.5
"""Limits over what is asked for: more ends the move. Calm gains of makers' tools go 30 % beyond a way of 60 degrees."""
SLOW_CURRENT = 0.7
"""Bandwidth of the drive's own current loop, of the one that a design counts on, below which that is said: at 0.15 the
following error was 31 degrees where 9 to 24 were predicted."""
SLOWEST_SHARE = 0.4
"""Least share of the limits asked for that a move is slowed to: a tenth of 40 rpm is too few counts to be found."""
DURATION_S = 45.0
"""Longest time of a move there and back."""
TRACE = "traces/move.npz"


@dataclass(frozen=True, slots=True)
class ForetoldMove:
    """A move before it is made."""

    error_least_rad: float
    error_most_rad: float
    """Largest following error over the corners of the tolerance box (rad); the current is not limited in it. The
    larger end has the way of one period of the loops: demand and position may be seen that far apart."""
    gains: str
    """Whose gains: those that the drive holds, or those of the design where a unit of the held ones is unknown."""
    torque_nm: float
    """Largest torque that the loops ask for, over the same corners (N m)."""
    torque_limit_nm: float
    """What the current limit gives on the q axis alone (N m)."""
    current_share: float
    """Bandwidth of the q current loop with the gains that the drive holds, of the one that the design counts on."""

    def __str__(self) -> str:
        least, most = (math.degrees(error) for error in (self.error_least_rad, self.error_most_rad))
        return f"{least:.3g} to {most:.3g} deg with the gains {self.gains}"

    def rows(self) -> list[dict[str, object]]:
        """Return both ends as a record of a move keeps values."""
        ends = {"predicted_least_rad": self.error_least_rad, "predicted_most_rad": self.error_most_rad}
        return [{"name": name, "value": value, "unit": "rad"} for name, value in ends.items()]

    def lines(self, error_limit_rad: float) -> list[str]:
        """Return what is said before the move; ``error_limit_rad``: following error at which it is ended."""
        said = [f"predicted following error: {self}; a play of the shaft is not in it"]
        if self.error_most_rad > error_limit_rad:
            said[0] += "; it is beyond what ends the move: ask for a slower one"
        if self.torque_nm > self.torque_limit_nm:
            said.append(
                f"the loops would ask for {self.torque_nm:.3g} N m, the current limit gives {self.torque_limit_nm:.3g} "
                "N m: the shaft may fall behind more than predicted"
            )
        if self.current_share < SLOW_CURRENT:
            said.append(
                f"with the gains that the drive holds its q current loop has {self.current_share:.2g} of the bandwidth "
                "that the design counts on: write the design of `pmsmtool tune` without --axis first"
            )
        return said


def limits_of_move(design: Design, i_max_apk: float, speed_rad_s: float | None, acceleration: float | None) -> Profile:
    """Return the limits of a move of a design within a current (A peak), but for those that are asked for.

    Raises ConfigError: not a design of an axis; DesignInfeasible: friction takes the whole torque.
    """
    if "axis_speed_rad_s" not in design.facts:
        raise ConfigError(
            "not a design of an axis", where=design.name, hint="`pmsmtool tune --axis` makes one"
        )  # fmt: skip
    within = profile_within(design, largest_torque(design.machine.machine, i_max_apk))
    return replace(
        within, speed=speed_rad_s or within.speed, acceleration=acceleration or within.acceleration
    )  # fmt: skip


def foretold_move(
    design: Design, drive_map: DriveMap, held: Mapping[str, float], way_rad: float, profile: Profile, i_max_apk: float
) -> ForetoldMove:
    """Return what a design says of a move within a current (A peak).

    ``held``: gains and feed-forwards that the drive holds, by catalogue name, as far as their units are known.
    """
    drive, machine = axis_drive(drive_map), design.machine.machine
    own = {name: replace(design.values[name], value=held[name]) for name in CURRENT if held.get(name, 0.0) > 0.0}
    on_drive = replace(design, values={**design.values, **own})
    counted_on, path = (
        axis_path(which, AxisRequest.of(design), drive, mechanics_of(design.machine))[0] for which in (design, on_drive)
    )
    K_p, K_i, K_v = (float(design.facts[f"axis_{key}"]) for key in ("K_p_nms_per_rad", "K_i_nm_per_rad", "K_v_per_s"))
    designed = AxisGains(K_p, K_i, K_v)
    gains, whose = held_loop(held, designed, drive), HELD
    if gains is None:
        designs = {name: value.value for name, value in design.values.items()}
        gains, whose, held = held_loop(designs, designed, drive) or designed, DESIGNED, designs
    box = Box(path, cases(design.machine, drive))
    move = plan(way_rad, profile if drive.jerks else replace(profile, jerk=math.inf))
    peaks = [move_peaks(path, plant, gains, move, held, machine.tau_c_nm or 0.0) for plant in box.plants]
    errors, torques = zip(*peaks, strict=True)
    apart = path.T * abs(move.distance) / move.t_speed
    torque = abs(machine.torque_nm(0.0, i_max_apk))
    share = bandwidth(path.current) / bandwidth(counted_on.current)
    return ForetoldMove(min(errors), max(errors) + apart, whose, max(torques), torque, share)


def followable(
    design: Design, drive_map: DriveMap, held: Mapping[str, float], way_rad: float, limits: Profile, i_max_apk: float
) -> tuple[Profile, str]:
    """Return limits of a move with which neither the held nor the designed gains stay so far behind that it is ended.

    Beside them what is said of that, empty where they are as they were. Gains that no slower move helps, such as
    unstable ones, do not count. Parameters as of :func:`foretold_move`.
    """
    fastest, slower = limits, None
    for gains in (held, {name: held[name] for name in CURRENT if name in held}):

        def most(profile: Profile, gains: Mapping[str, float] = gains) -> float:
            return foretold_move(design, drive_map, gains, way_rad, profile, i_max_apk).error_most_rad

        slower = followed(way_rad, limits, most, SLOWEST_SHARE)
        limits = slower or limits
    if slower is None:
        return limits, "with the gains of the design no slower move helps: give a longer way (--by)"
    if limits == fastest:
        return limits, ""
    return limits, (
        f"slower, with {limits.speed / fastest.speed:.2g} of speed and acceleration: the shaft would stay too far "
        "behind, with the gains that the drive holds or with those of the design"
    )


def asked_profile(limits: Profile | None, speed_rad_s: float | None, acceleration: float | None) -> dict[str, float]:
    """Return the limits of the move by catalogue name: those of a design, or those that are asked for."""
    given = (speed_rad_s, acceleration, None) if limits is None else (limits.speed, limits.acceleration, limits.jerk)
    rows = ((SPEED,), (UP, DOWN), (JERK,))
    return {name: rpm_from_rad_s(value) for value, names in zip(given, rows, strict=True) if value for name in names}


def lent_profile(
    drive: PositionDrive, profile: Mapping[str, float]
) -> tuple[dict[str, float], tuple[float, float] | None]:
    """Return what of a profile this drive can be lent by its map, and what is to be found by its demand (rad/s).

    Raises ConfigError: the map lacks units, and speed or acceleration is not given.
    """
    cells = drive.node.map.cells
    if not profile or all(name in cells for name in profile if name != JERK):
        return {name: value for name, value in profile.items() if name in cells}, None
    if not {SPEED, UP} <= set(profile):
        lacks = f"the map {drive.node.map.name!r} lacks units of the profile"
        raise ConfigError(lacks, hint="give both --speed and --acceleration")
    return {}, (rad_s_from_rpm(profile[SPEED]), rad_s_from_rpm(profile[UP]))


@dataclass(frozen=True, slots=True)
class PlannedMove:
    """Moves there and back on one drive, before they are made."""

    way_rad: float
    times: int
    """Of the shaft (rad), and how often."""
    envelope: Envelope
    """Limits."""
    gains: dict[str, float]
    lent: dict[str, float]
    """What the drive holds, and what is changed in it for the moves, by catalogue name."""
    find: tuple[float, float] | None
    """Speed and acceleration (rad/s, rad/s2) for which counts are found by the demand."""
    limits: Profile | None
    """Of a design, or slower; None without one."""
    foretold: ForetoldMove | None
    """What a design says of them."""
    slowed: str = ""
    """Why they are slower than asked for, or than the design's limits, or cannot be slow enough."""

    @property
    def error_limit_rad(self) -> float:
        """Following error at which the voltage is removed (rad)."""
        return ENDED * abs(self.way_rad)

    def lines(self, drive: PositionDrive) -> list[str]:
        """Return what a person agrees to."""
        return [
            *self.envelope.lines(),
            *first_of_axes(drive.node),
            *low_limits(drive.node, drive.rated_apk),
            f"the shaft moves by {math.degrees(self.way_rad):.4g} deg and back with the drive's own position "
            f"loop, {counted(self.times, 'time')}",
            f"voltage off where the shaft is {math.degrees(self.error_limit_rad):.3g} deg behind and comes no nearer",
            *([self.slowed] if self.slowed else []),
            *(self.foretold.lines(self.error_limit_rad) if self.foretold else []),
            "before that it turns by a degree with little current, to see that it does not run away",
            *([] if self.find is None else ["its profile is found first by slower moves within this way"]),
            *(f"changed for the move: {name} {value:.5g} {BY_NAME[name].unit}" for name, value in self.lent.items()),
            "nothing is stored in the drive; every changed object is restored",
        ]


def plan_move(
    drive: PositionDrive, allowed: Envelope, way_rad: float, times: int, design: Design | None,
    speed_rad_s: float | None, acceleration: float | None, like: PlannedMove | None = None,
) -> PlannedMove:  # fmt: skip
    """Return the limits of moves on a drive, what is changed for them, and what a design says of them.

    Raises ConfigError: not a design of an axis, or the speed of the move is not known; SafetyRefusal: a gravity load,
    or a drive that allows no current.

    Parameters
    ----------
    allowed : Envelope
        What a person allows; infinite: the current that the drive allows, and a speed above that of the move.
    design : Design or None
        Its limits are those of the move, but for the speed (rad/s) and acceleration (rad/s2) that are given; all of
        them are made slower where the gains that the drive holds, or the designed ones, would stay too far behind.
    like : PlannedMove or None
        A move whose limits this one has.
    """
    node, i_max, speed_max = drive.node, allowed.i_max_apk, allowed.speed_max_rad_s
    if math.isinf(i_max):
        i_max = drive.current_allowed_apk
    given = min([i_max, *(apk for _, apk in held_current_limits(node, drive.rated_apk))])
    refuse_no_current(node, given)
    limits, slowed, gains = None, "", drive.held_gains()
    if like is not None:
        limits = like.limits
    elif design is not None:
        fastest = limits_of_move(design, given, speed_rad_s, acceleration)
        limits, slowed = followable(design, node.map, gains, way_rad, fastest, given)
    profile = asked_profile(limits, speed_rad_s, acceleration)
    lent, find = lent_profile(drive, profile)
    if math.isinf(speed_max):
        speed = profile.get(SPEED) or (drive.read(SPEED) if SPEED in node.map.cells else None)
        if not speed:
            unknown = "the speed of the drive's own move is not known: its map has no row for it"
            raise ConfigError(unknown, hint="give --speed and --acceleration, or --speed-max")
        speed_max = SPEED_MARGIN * rad_s_from_rpm(speed)
    envelope = replace(
        allowed, i_max_apk=i_max, speed_max_rad_s=speed_max, duration_s=DURATION_S * times,
        travel_rad=min(allowed.travel_rad, TRAVEL_MARGIN * abs(way_rad)),
        acceleration_rad_s2=None if design is None else largest_acceleration(design.machine.machine, i_max),
    )  # fmt: skip
    envelope.refuse_gravity()
    foretold = None
    if design is not None and limits is not None:
        foretold = foretold_move(design, node.map, gains, way_rad, limits, given)
    return PlannedMove(way_rad, times, envelope, gains, lent, find, limits, foretold, slowed)


def make_move(
    drive: PositionDrive, planned: PlannedMove, settle_s: float, run: RunDirectory, say: Callable[[str], None]
) -> tuple[MoveResult, MoveProfile | None, Trace]:
    """Move within the limits, close the drive, and keep trace and stage in the run; raises as :func:`record_move`.

    ``settle_s``: how long to look on after a demand ended. Returns the result, the counts that were found, the trace.
    """
    clock = drive.node.connection.clock
    drive.error_limit_rad = planned.error_limit_rad
    with guarded(drive, planned.envelope, say=say) as guard:
        guard.write(planned.lent)
        began = clock.now()
        trace, counts = record_move(guard, drive, planned.way_rad, settle_s, planned.times, planned.find)
        seconds = clock.now() - began
    drive.close()
    run.save(TRACE, trace_npz(trace))
    found = move_result(trace)
    values = [{"name": name, "value": float(getattr(found, name)), "unit": unit} for name, unit in UNITS.items()]
    values += [{"name": name, "value": value, "unit": BY_NAME[name].unit} for name, value in planned.gains.items()]
    summary = f"following error at most {shown(found.error_peak_rad, 'rad')}"
    if planned.foretold:
        values += planned.foretold.rows()
        summary += f" (predicted: {planned.foretold})"
    summary += f", settling: {shown(found.settling_s, 's')}"
    doubts = trace.meta["doubts"]
    run.add(Stage("move", "pass", seconds, values=values, files={TRACE: ""}, fallbacks=doubts, summary=summary))
    return found, counts, trace


def moved_machine(
    source: MachineFile, trace: Trace, drive: PositionDrive, run: RunDirectory
) -> tuple[MachineFile, dict[str, Estimate]]:
    """Find inertia and friction from moves, keep the machine file in the run, and return it with what was found.

    Raises Contradiction: less inertia than the machine file allows; IdentificationError: the moves do not show it.
    """
    ratios = move_mechanics(
        trace, pole_pairs=source.machine.pole_pairs, undecided=drive.current_undecided, rated_apk=drive.rated_apk
    )
    refuse_inertia(source, ratios["J_per_psi"], run)
    made = completed_machine(source, ratios, "as given", flux_doubt(source)).machine
    assert made is not None
    run.save("machine.toml", dump_machine_file(made))
    return made, {name: made.estimates[name] for ratio, name in PER_PSI.items() if ratio in ratios}


CURRENT_SHARE = 0.01
"""Gain of a drive's current sensors may be off by this (95 %), as `identify` takes it."""
PEAK = math.sqrt(0.5)
"""Torque of amperes that are peak, of that of rms ones."""
HEAVIER = 0.5
"""Inertia that the moves show beyond the file's, of it, from which on it contradicts; healthy drives: up to 0.11."""
CLEARLY = 1.5
"""Torque that the wrong reading leaves unexplained, of the right one, from which on it is decided."""


def inertia_of(source: MachineFile) -> float:
    """Return the inertia of a machine file (kg m2); raises ConfigError where it has none."""
    if not source.machine.J_kgm2:
        raise ConfigError(
            "cogging needs the inertia of motor and load: it moves the shaft, too", where="[machine] J_kgm2",
            hint="`pmsmtool move --identify MACHINE -o FILE` finds it by faster moves",
        )  # fmt: skip
    return source.machine.J_kgm2


def moved_cogging(
    source: MachineFile, trace: Trace, drive: PositionDrive, run: RunDirectory
) -> tuple[MachineFile, dict[str, Estimate]]:
    """Find cogging over the way of slow moves, keep machine file and table in the run, and return it with what it is.

    Raises ConfigError: a machine file without the inertia; IdentificationError: the moves do not show it;
    Contradiction: the current speeds up more than that inertia.
    """
    machine, J_kgm2 = source.machine, inertia_of(source)
    share = math.hypot(flux_doubt(source), CURRENT_SHARE)
    J_share = stated_share("J_kgm2", source)[0]

    def read_as(scale: float, more: float = 0.0) -> Cogging:
        return partial_cogging(
            trace, pole_pairs=machine.pole_pairs, psi_wb=scale * machine.psi_f_wb, J_kgm2=J_kgm2,
            shares=(share + more, J_share),
        )  # fmt: skip

    found, said = read_as(1.0), []
    lightest = found.part
    if drive.current_undecided:
        peak = read_as(PEAK)
        rms_left, peak_left = (one.part.left_nm if one.part else 0.0 for one in (found, peak))
        if max(rms_left, peak_left) > CLEARLY * min(rms_left, peak_left):
            found, kind = (found, "rms") if rms_left < peak_left else (peak, "peak")
            said, lightest = [f"amperes taken as {kind}, by the inertia of the machine file"], found.part
        else:
            found, said = read_as(1.0, 1.0 - PEAK), ["amperes may be peak or rms: the interval is that of both"]
            lightest = peak.part
    if lightest and lightest.J_least_kgm2 > (1.0 + max(HEAVIER, J_share)) * J_kgm2:
        raise Contradiction(
            f"the torque of the moves speeds up at least {lightest.J_least_kgm2:.3g} kg m2, MACHINE has {J_kgm2:.3g}: "
            "cogging would be as many times too large; nothing was written",
            where=str(run.path),
            likely="an encoder offset that was never set, a current in another unit, or a load that MACHINE leaves out",
            hint="set up the offset there; `pmsmtool move --identify MACHINE -o FILE` finds the inertia",
        )
    said = [str(found.part), *said]
    told = found.estimates()
    made = replace(source, estimates={**source.estimates, **told}, simulation={})
    run.save("machine.toml", dump_machine_file(made))
    files = {"machine.toml": "", **save_cogging(run, found, 1)}
    values = [{**value_facts(name, estimate), PARTIAL: str(found.part)} for name, estimate in told.items()]
    run.add(Stage("cogging", "partial", 0.0, values=values, fallbacks=said, files=files, summary=str(found.part)))
    return made, told
