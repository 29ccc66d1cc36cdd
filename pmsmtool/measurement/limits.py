# SPDX-License-Identifier: MIT
"""What one identification is given, whatever the method, and what its experiments may use: current, speed, voltage."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.errors import ConfigError
from pmsmtool.experiments.standstill import ReadSupply
from pmsmtool.identification.request import IdentifyRequest
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.measurement.capabilities import Capabilities
from pmsmtool.refusals import refuse
from pmsmtool.run_directory import RunDirectory
from pmsmtool.trace import Trace
from pmsmtool.units import format_current, rpm_from_rad_s

Keep = Callable[[str, Trace], None]
"""Stores a trace by its name."""
Say = Callable[[str], None]
Allow = Callable[[Sequence[str]], None]
"""Returns when a person agreed to these lines, else raises ``Declined``."""
Known = tuple[MachineFile, str]
"""A machine file and where it comes from."""


@dataclass(frozen=True, slots=True)
class Task:
    """One identification."""

    run: RunDirectory
    """Where everything goes."""
    drive: CanopenDrive
    """Opened as the method needs it."""
    found: Capabilities
    """What the drive has."""
    request: IdentifyRequest
    """What is asked."""
    known: Known | None = None
    """What completes the measured values."""
    read_supply: ReadSupply | None = None
    """Reads the bench supply where R is asked for so."""

    @property
    def machine(self) -> MachineFile | None:
        """The machine file alone."""
        return None if self.known is None else self.known[0]


LEAST_SPEED_SHARE = 0.03
"""Least speed limit for what turns the shaft, of the drive's largest speed: the first push, a tenth of the rated
current for 20 ms, brings a drive with an acceleration time of 50 ms to 2.7 % of it; and the back-emf there is as small
as an inverter's error."""

DURATION_S = 600.0
"""Longest time the machine is energised by `identify` (27 times the rotor's inertia took more than 300 s)."""
HEADROOM = 1.2
"""Largest current of an envelope, of the rated one, where none is asked for."""
LEAST_CURRENT = 0.2
"""Least share of a current that turns the shaft, to spare the supply."""
SAMPLES_A_TURN = 12.0
"""Samples of an electrical turn at the largest speed of the experiments: with 7.3 and 9.6 of it two drives tripped."""
TRIP_SHARE = 0.85
"""Current that the pulses of a flux map aim at, of the drive's overcurrent trip."""


def unused_current(i_max_apk: float, nameplate: MachineFile, *, pulses: bool) -> list[str]:
    """Return what to tell of a current limit above what the experiments use, which is what the machine is rated for.

    Parameters
    ----------
    i_max_apk : float
        Largest current of the envelope (A peak).
    nameplate : MachineFile
        Ratings of machine and drive.
    pulses : bool
        Whether the pulses of a flux map are asked for, which exceed the rated current.
    """
    rated, trip = nameplate.machine.I_nom_apk, nameplate.limits.i_trip_apk
    if rated is None or i_max_apk <= HEADROOM * rated:
        return []
    lines = [f"the current limit is above what is used: {format_current(rated)}, the rated current"]
    if pulses:
        least = None if trip is None else min(i_max_apk, TRIP_SHARE * trip)
        size = "the drive's overcurrent trip" if least is None else format_current(least)
        lines.append(f"only pulses of the flux map go beyond it, up to {size}")
    return lines


def require_speed(omega_max_rad_s: float, n_max_rpm: float) -> None:
    """Refuse a speed limit within which nothing can be told of a turning shaft.

    Raises IdentificationError: ``E_EXCITATION``: the limit is below its share of the largest speed.

    Parameters
    ----------
    omega_max_rad_s : float
        Largest mechanical speed of the envelope (rad/s).
    n_max_rpm : float
        Largest speed of machine and drive (rpm).
    """
    least, given = LEAST_SPEED_SHARE * n_max_rpm, rpm_from_rad_s(omega_max_rad_s)
    if given < least:
        raise refuse(
            "E_EXCITATION",
            f"the speed limit {given:.4g} rpm is below {least:.4g} rpm, {100.0 * LEAST_SPEED_SHARE:g} % of the largest "
            "speed",
            stage="speed limit",
            likely="the first short torque pulse exceeds it, and the back-EMF below it is too small to measure",
            hint=f"allow at least --speed-max {math.ceil(least)}rpm, or identify R, L and inverter only",
        )


def sampled_speed(nameplate: MachineFile) -> float:
    """Return the largest mechanical speed (rad/s) at which a drive samples a machine's currents often enough."""
    return 2.0 * math.pi * nameplate.inverter.f_s_hz / (SAMPLES_A_TURN * nameplate.machine.pole_pairs)


@dataclass(frozen=True, slots=True)
class Limits:
    """What the experiments may use. Raises ConfigError: one of them leaves nothing."""

    I_nom_apk: float
    """Rated current; the scale of every amplitude (A peak)."""
    i_max_apk: float
    """Largest current of the envelope (A peak)."""
    omega_max_rad_s: float
    """Largest mechanical speed of the envelope (rad/s)."""
    V_max_v: float
    """Largest voltage (V peak)."""
    i_d_max_apk: float = math.inf
    """Largest d current in the frame of the rotor (A peak)."""
    supply_w: float = math.inf
    """Largest power that the supply of the DC link is asked for (W)."""
    counts_per_turn: float = math.inf
    """Counts of the encoder in a mechanical turn; infinite where they are not known."""

    def __post_init__(self) -> None:
        """Refuse before anything moves."""
        for what, value, unit in (
            ("rated current", self.I_nom_apk, "A"),
            ("largest current", self.i_max_apk, "A"),
            ("largest speed", self.omega_max_rad_s, "rad/s"),
            ("largest voltage", self.V_max_v, "V"),
        ):
            if not value > 0.0:
                raise ConfigError(
                    f"{what} is {value:.4g} {unit}: nothing can be measured",
                    hint="give --i-max and --speed-max above zero, and ratings above zero in the machine file",
                )

    @property
    def I_test_apk(self) -> float:
        """Largest steady current of an experiment: the rated one, or what the envelope leaves."""
        return min(self.I_nom_apk, self.i_max_apk / 1.1)

    def on_supply(self, supply_w: float, held_w: float) -> Limits:
        """Return the limits on a supply whose link gives way at a power (W), where the test current took ``held_w``."""
        share = min(1.0, math.sqrt(supply_w / held_w)) if held_w > 0.0 else 1.0
        return replace(self, I_nom_apk=share * self.I_test_apk, supply_w=supply_w) if supply_w < math.inf else self

    def within_supply(self, i_q_a: float, omega_rad_s: float, torque_per_a: float) -> tuple[float, float]:
        """Return current (A) and mechanical speed (rad/s) that take no more than the supply gives."""
        return within_supply(self.supply_w, i_q_a, omega_rad_s, torque_per_a)


def within_supply(supply_w: float, i_q_a: float, omega_rad_s: float, torque_per_a: float) -> tuple[float, float]:
    """Return current (A) and mechanical speed (rad/s) that together take no more than a power (W).

    The current is reduced first, for intervals grow as the speed falls, but not below :data:`LEAST_CURRENT`, which
    must move the shaft. ``torque_per_a`` is in N m per ampere of q current.
    """
    taken_w = i_q_a * omega_rad_s * torque_per_a
    share = min(1.0, supply_w / taken_w) if taken_w > 0.0 else 1.0
    less = max(share, LEAST_CURRENT)
    return less * i_q_a, share / less * omega_rad_s
