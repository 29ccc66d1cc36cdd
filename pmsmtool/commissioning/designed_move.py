# SPDX-License-Identifier: MIT
"""What a design of the axis says of one move before a drive makes it: its limits, following error and torque."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from pmsmtool.axis.design import move_peaks, profile_within
from pmsmtool.axis.drive import AxisRequest, axis_path, cases, held_loop
from pmsmtool.axis.loops import AxisGains
from pmsmtool.axis.move import Profile, plan
from pmsmtool.axis.search import Box
from pmsmtool.commissioning.axis_design import axis_drive
from pmsmtool.design.design_file import Design
from pmsmtool.drive.envelope import largest_torque
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.errors import ConfigError
from pmsmtool.machine.two_masses import mechanics_of

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
