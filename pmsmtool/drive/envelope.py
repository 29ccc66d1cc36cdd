# SPDX-License-Identifier: MIT
"""The motion envelope: what a person allows the machine to do, shown before anything moves."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pmsmtool.errors import SafetyRefusal
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import Brake, Load, MachineParameters, Shaft
from pmsmtool.units import format_current, rpm_from_rad_s

OFF_S = 0.5
"""Longest time from a tool that fails to the voltage being off: freshness of a look, one heartbeat period, the drive's
consumer time and its reaction (``guard``, ``heartbeat``, ``dead_man``)."""
LEAST_INERTIA = 0.8
"""Of the one that is given: a data sheet's is true to 20 %."""
MOST_LINK, LEAST_FLUX, MOST_INDUCTANCE = 1.1, 0.8, 1.3
"""Of what is given: a supply at its upper tolerance; a data sheet's flux linkage (10 %) with hot magnets; its
inductance."""
SIX_STEP = 2.0 / math.pi
"""Largest phase voltage amplitude, of the DC link: a controller may overmodulate up to six steps."""
_ANGLES = tuple(math.radians(5.0 * k) for k in range(13))
# Of the current vector, from the q axis towards negative d: the largest torque lies within 45 degrees, and is flat.

_MAY = {
    "free": "may turn freely",
    "locked": "is locked: it must not turn",
    "coupled": "is coupled: whatever hangs on it moves too",
}


@dataclass(frozen=True, slots=True)
class Envelope:
    """Limits of an experiment.

    Attributes
    ----------
    i_max_apk : float
        Largest current vector (A peak).
    i_d_max_apk : float
        Largest d current in the frame of the rotor (A peak): more may demagnetise it; infinity: as the vector.
    speed_max_rad_s : float
        Largest mechanical speed (rad/s).
    duration_s : float
        Longest time the machine is energised (s).
    energy_j : float
        Largest copper loss in the winding (J).
    travel_rad : float
        Largest mechanical way from where the shaft stands (rad); infinity: not limited.
    shaft : str
        What the shaft may do.
    load, brake : str
        What pulls on it, and the holding brake.
    acceleration_rad_s2 : float or None
        Of the shaft by the largest current (mechanical), None where the inertia is not known.
    voltage_speed_rad_s : float
        Mechanical speed above which the voltage allows no torque; infinity where it is not known.
    """

    i_max_apk: float
    speed_max_rad_s: float
    duration_s: float = 600.0
    energy_j: float = math.inf
    travel_rad: float = math.inf
    shaft: Shaft = "free"
    load: Load = "none"
    brake: Brake = "none"
    acceleration_rad_s2: float | None = None
    i_d_max_apk: float = math.inf
    voltage_speed_rad_s: float = math.inf

    def lines(self) -> list[str]:
        """Return the envelope as a person reads it before consenting."""
        rpm = rpm_from_rad_s(self.speed_max_rad_s)
        if self.acceleration_rad_s2 is None:
            gain = "the speed gained until then is not known (no inertia is given)"
        else:
            gained = rpm_from_rad_s(self.acceleration_rad_s2 * OFF_S)
            reached = max(rpm, rpm_from_rad_s(self.voltage_speed_rad_s))
            gain = (
                f"until then full torque adds up to {float(f'{gained:.3g}'):g} rpm"
                if rpm + gained < reached
                else f"until then full torque may reach {float(f'{reached:.3g}'):g} rpm, where the voltage limits it"
            )
        travel = "not limited" if math.isinf(self.travel_rad) else f"{math.degrees(self.travel_rad):.4g} deg (mech)"
        energy = "not limited" if math.isinf(self.energy_j) else f"{self.energy_j:.4g} J"
        return [
            f"current   at most {format_current(self.i_max_apk)}",
            f"speed     at most {float(f'{rpm:.4g}'):g} rpm",
            f"travel    {travel}",
            f"energy    {energy} in the winding",
            f"duration  at most {self.duration_s:.4g} s",
            f"failure   of the tool: voltage off after {OFF_S:g} s; {gain}",
            "stop      voltage off, the shaft coasts; with the drive's ramp only after its speed loop held a speed",
            f"shaft     {self.shaft}: {_MAY[self.shaft]}; load {self.load}, brake {self.brake}",
        ]

    def refuse_gravity(self) -> None:
        """Refuse a load that falls when the torque is zero.

        Raises SafetyRefusal: gravity load on a shaft that is not locked: the dead-man proof and every stop hold zero
        torque.
        """
        if self.load == "gravity" and self.shaft != "locked":
            raise SafetyRefusal(
                "a gravity load falls when the torque is zero, and every stop ends at zero torque",
                likely="--load gravity was given and the shaft is not locked",
                hint="uncouple the load, or lock the shaft and give --shaft locked",
            )


def largest_acceleration(machine: MachineParameters, i_max_apk: float) -> float | None:
    """Return the largest acceleration (rad/s2, mechanical) by a current (A peak); None where the inertia is not known.

    The inertia is taken at the low end of what a data sheet's may be.
    """
    if not machine.J_kgm2:
        return None
    return largest_torque(machine, i_max_apk) / (LEAST_INERTIA * machine.J_kgm2)


def largest_torque(machine: MachineParameters, i_max_apk: float) -> float:
    """Return the largest torque (N m) of a current (A peak)."""
    return max(machine.torque_nm(-i_max_apk * math.sin(angle), i_max_apk * math.cos(angle)) for angle in _ANGLES)


def voltage_speed(known: MachineFile, i_max_apk: float) -> float:
    """Return the mechanical speed (rad/s) above which no current up to one (A peak) gives torque; infinity if none is.

    That is where the voltage of six steps cannot hold the flux that the whole current on -d leaves, with the tolerances
    of a data sheet: U_dc 2 / pi = p omega (psi_f - L_d I).
    """
    machine = known.machine
    left_wb = LEAST_FLUX * machine.psi_f_wb - MOST_INDUCTANCE * machine.L_d_h * i_max_apk
    if not left_wb > 0.0:
        return math.inf
    return SIX_STEP * MOST_LINK * known.inverter.U_dc_v / (left_wb * machine.pole_pairs)
