# SPDX-License-Identifier: MIT
"""What of a drive decides its axis: the rows it has objects for, the path of its loops, and the tolerance box."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from pmsmtool.axis.loops import AxisGains, AxisPath
from pmsmtool.axis.search import Case, Limits
from pmsmtool.design.design_file import Design, Scalar
from pmsmtool.design.loops.current_loop import AxisPlant, CurrentGains, axis_loop
from pmsmtool.design.loops.sampled_loop import SampledLoop
from pmsmtool.design.loops.speed_loop import Notch
from pmsmtool.design.tolerance import NORMAL_95, tolerance_box
from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import MachineParameters
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.machine.two_masses import Mechanics, shafts_of
from pmsmtool.params.catalogue import INCREMENTS, MIDDLE_KIND, TORQUE_PER_AMPERE

CASCADE = ("position.K_p_per_s", "position.velocity_ff", "position.inertia_ff_kgm2")
PID = (
    "position.pid_p_nm_per_rad", "position.pid_i_nm_per_rads", "position.pid_d_nms_per_rad",
    "position.friction_ff_nms_per_rad",
)  # fmt: skip
LEAD = "position.acceleration_ff_s"
"""Feed-forward of the acceleration that is added to the reference of the speed, not to the torque (Copley)."""
DERIVATIVE = "position.derivative_share"
"""Derivative part beside a position gain (Faulhaber): as small as its object lets it be, for no loop here has one."""
SPEED = ("speed.K_p_nms_per_rad", "speed.K_i_nm_per_rad")
SPEED_FORWARD = ("speed.inertia_ff_kgm2", "speed.friction_ff_nms_per_rad")
NOTCH = ("speed.notch_hz", "speed.notch_zeta_num", "speed.notch_zeta_den")
PROFILE = (
    "reference.profile_speed_rpm", "reference.profile_acceleration_rpm_per_s",
    "reference.profile_deceleration_rpm_per_s", "reference.profile_jerk_rpm_per_s2",
)  # fmt: skip
AXIS_GAINS = (*SPEED, *SPEED_FORWARD, *CASCADE[:2], *PID[:3], CASCADE[2], LEAD, DERIVATIVE, PID[3])
CURRENT = ("current.K_p_q_v_per_a", "current.K_i_q_v_per_as")
"""Gains of the loop below, which the set of an axis does not write."""
AXIS_ROWS = frozenset((TORQUE_PER_AMPERE, INCREMENTS, *AXIS_GAINS, *NOTCH, *PROFILE))
"""What the design of an axis decides, and what is written into a drive for it."""
LOOSEST = Limits(20.0, 12.0)
"""Least phase margin and largest |S| that may be asked for."""
ASSUMED_RATE_HZ = 1000.0
"""Rate of the loops of a drive that says none."""
OWN_TORQUE = 0.1
"""Half width (relative) of the torque of an ampere that the drive itself holds, whatever its ampere is: as true as a
data sheet's."""
UNKNOWN_KIND = 0.2
"""Of one taken from psi_f, where nothing says if the drive's amperes are peak, rms or block: the middle of peak and rms
is 19 % from both."""
RESONANCE = 0.03
"""Half width (relative) of a resonance without a standard deviation."""
DAMPING_SHARE = 0.5
"""Smallest damping looked at, of one without a standard deviation."""


@dataclass(frozen=True, slots=True)
class AxisRequest:
    """What is asked of an axis."""

    phase_margin_deg: float = 45.0
    peak_db: float = 6.0
    """Least phase margin (degree) and largest |S| (dB) of both loops over the tolerance box."""
    loop_rate_hz: float | None = None
    """Rate of the drive's speed and position loops (Hz); None: as its map states, else 1 kHz."""
    speed_filter_hz: float | None = None
    """Its filter on the speed (Hz); None: as the design says for a reference drive, none for others."""

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
    """What of a drive decides its axis."""

    name: str
    """Of its map."""
    offers: frozenset[str]
    """Catalogue names it has objects for."""
    own_core: bool
    """Whether it runs the control of this program: rate, speed estimate and filter are then those of the design."""
    period_s: float | None = None
    """Period of its loops as its map states (s)."""
    amperes: bool = False
    """Whether its gains are in amperes."""
    holds_torque: bool = False
    """Whether it holds the torque of an ampere itself."""
    torque_nm: float | None = None
    """What its own limit of the current gives (N m); None: not known."""

    @property
    def pid(self) -> bool:
        """Whether one controller of the position gives the torque."""
        return PID[0] in self.offers

    @property
    def jerks(self) -> bool:
        """Whether its moves are limited in jerk."""
        return self.own_core or PROFILE[3] in self.offers

    @property
    def leads(self) -> bool:
        """Whether its feed-forward of the acceleration acts through the controller of the speed."""
        return LEAD in self.offers and CASCADE[2] not in self.offers

    def feeds(self, name: str) -> bool:
        """Whether a feed-forward acts as designed: it is written, or a person enters the whole axis by hand."""
        return name in self.offers or not self.offers & {CASCADE[0], PID[0]}


def assumed_torque(machine: MachineParameters) -> float:
    """Return the torque of an ampere of unknown kind (N m/A): the middle of peak and rms."""
    return MIDDLE_KIND * torque_per_ampere(machine.pole_pairs, machine.psi_f_wb)


def from_pid(K_P: float, K_I: float, K_D: float, like: AxisGains) -> AxisGains:
    """Return the cascade of a PID: K_v is the root of K_D K_v^2 - K_P K_v + K_I that is nearer to another's."""
    apart = math.sqrt(max(K_P * K_P - 4.0 * K_D * K_I, 0.0))
    K_v = min(((K_P + sign * apart) / (2.0 * K_D) for sign in (1.0, -1.0)), key=lambda root: abs(root - like.K_v))
    return replace(like, K_p=K_D, K_i=K_P - K_D * K_v, K_v=K_v)


def gain_rows(drive: AxisDrive) -> tuple[str, ...]:
    """Return the gains that decide how a move is followed."""
    return PID[:3] if drive.pid else (*SPEED, *CASCADE[:1])


def held_loop(held: Mapping[str, float], like: AxisGains, drive: AxisDrive) -> AxisGains | None:
    """Return the loop of the position that gains of a drive make; None where one of them is missing or off.

    ``like``: gains of a similar loop, for the K_v of one controller of the position.
    """
    if not all(held.get(name, 0.0) > 0.0 for name in gain_rows(drive)):
        return None
    notch = Notch(held.get(NOTCH[0], 0.0), *(held.get(name, 1.0) for name in NOTCH[1:]))
    if drive.pid:
        return replace(from_pid(held[PID[0]], held[PID[1]], held[PID[2]], like), notch=notch)
    return AxisGains(held[SPEED[0]], held[SPEED[1]], held[CASCADE[0]], notch)


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
    gains = CurrentGains(*(design[name] for name in CURRENT))
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
