# SPDX-License-Identifier: MIT
"""What a design of the axis says of one move before a drive makes it: its limits, following error and torque."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pmsmtool.axis.design import move_peaks, profile_within
from pmsmtool.axis.drive import PROFILE, AxisRequest, axis_path, cases, held_loop
from pmsmtool.axis.loops import AxisGains
from pmsmtool.axis.move import UNITS, MoveResult, Profile, plan, shown
from pmsmtool.axis.search import Box
from pmsmtool.commissioning.axis_design import axis_drive
from pmsmtool.commissioning.compared_stage import refuse_inertia
from pmsmtool.commissioning.contradiction import flux_doubt
from pmsmtool.design.design_file import Design
from pmsmtool.drive.envelope import largest_torque
from pmsmtool.drive.position_drive import PositionDrive
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.errors import ConfigError
from pmsmtool.identification.completed_machine import PER_PSI, completed_machine
from pmsmtool.identification.move_mechanics import move_mechanics
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.two_masses import mechanics_of
from pmsmtool.params.catalogue import BY_NAME
from pmsmtool.run_directory import RunDirectory, Stage
from pmsmtool.trace import Trace
from pmsmtool.units import rad_s_from_rpm, rpm_from_rad_s

SPEED, UP, DOWN, JERK = PROFILE
HELD, DESIGNED = "that the drive holds", "of the design"


@dataclass(frozen=True, slots=True)
class ForetoldMove:
    """A move before it is made.

    Attributes
    ----------
    error_least_rad, error_most_rad : float
        Largest following error over the corners of the tolerance box (rad); the current is not limited in it. The
        larger end has the way of one period of the loops: demand and position may be seen that far apart.
    gains : str
        Whose gains: those that the drive holds, or those of the design where a unit of the held ones is unknown.
    torque_nm : float
        Largest torque that the loops ask for, over the same corners (N m).
    torque_limit_nm : float
        What the current limit gives on the q axis alone (N m).
    """

    error_least_rad: float
    error_most_rad: float
    gains: str
    torque_nm: float
    torque_limit_nm: float

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
    path, _ = axis_path(design, AxisRequest.of(design), drive, mechanics_of(design.machine))
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
    return ForetoldMove(min(errors), max(errors) + apart, whose, max(torques), torque)


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


def move_stage(
    found: MoveResult,
    gains: Mapping[str, float],
    foretold: ForetoldMove | None,
    seconds: float,
    doubts: Sequence[str],
    trace: str,
) -> Stage:
    """Return a move as its run keeps it; ``gains`` by catalogue name, ``trace`` its file."""
    values = [{"name": name, "value": float(getattr(found, name)), "unit": unit} for name, unit in UNITS.items()]
    values += [{"name": name, "value": value, "unit": BY_NAME[name].unit} for name, value in gains.items()]
    summary = f"following error at most {shown(found.error_peak_rad, 'rad')}"
    if foretold:
        values += foretold.rows()
        summary += f" (predicted: {foretold})"
    return Stage(
        "move", "pass", seconds, values=values, files={trace: ""}, fallbacks=doubts,
        summary=f"{summary}, settling: {shown(found.settling_s, 's')}",
    )  # fmt: skip


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
