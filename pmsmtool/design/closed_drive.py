# SPDX-License-Identifier: MIT
"""The governor of a drive that cannot be reflashed: the admissible set projected onto what it offers.

A closed drive takes no governed reference. It offers a limit of its torque (0x6072) or current, a slope of its
set-point (0x6087, which acts in profile torque mode) and a limit of its speed (0x6080), all constant.
:func:`tune_closed` chooses the three so that its voltage demand never exceeds the limit and its current never I_max,
for every course of the torque asked for and of the speed within them (``slope_response.py``), and says what that costs
against the full governor with field weakening.

What is taken as known: i_d = 0 (no field weakening), PI control with the gains that are written or said, demand
proportional to torque, a command frame turned ahead to the middle of the period. Whether it decouples is not published
by any maker: the worse of both is kept. The voltage margin covers what no model holds: noise, encoder error, ripple.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.design_file import Design, DesignValue, Scalar
from pmsmtool.design.lookup.table import torque_limits
from pmsmtool.design.loops.designed_loops import (
    CURRENT_GAINS,
    CURRENT_LOOPS,
    SPEED_LOOP,
    lacking_gains,
    one_pair,
    with_gains,
)
from pmsmtool.design.minimum_time import TransferProblem, minimum_time
from pmsmtool.design.operating_machine import at_temperature
from pmsmtool.design.ratings import Ratings, ratings
from pmsmtool.design.slope_response import CurrentLoops, MachineBox, SlopeResponse, slope_response
from pmsmtool.design.tolerance import ToleranceBox, tolerance_box
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import ConfigError, DesignInfeasible, NotAvailable
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.temperature import magnet_flux_at, resistance_at
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.units import RPM_PER_RAD_S

RATED, SLOPE, TORQUE, CURRENT, SPEED = (
    "reference.tau_rated_nm", "reference.torque_slope_nm_per_s", "speed.tau_max_nm", "motor.I_max_apk",
    "motor.n_max_rpm",
)  # fmt: skip
STATED = "drive_bandwidth_hz"
"""Key of the request under which a design names the bandwidth its current loops stand for."""
GAINS = ("current.K_p_q_v_per_a", "current.K_i_q_v_per_as")
SPEEDS = 26
"""Speeds of the responses; the cells between them widen the bound by 1 % of the voltage (measured on interior-2k2)."""
STAIR_S = 1e-3
"""Time between two steps of a closed drive's slope, where its maker does not say."""
RISE_S = 0.02
"""Time from zero to the torque limit where none is asked for."""
HALVINGS = 14
LOWER, TRIES = 0.8, 20
"""Where the loops are unstable at the largest speed, a lower one is tried."""
DEAD_TIME_VECTOR = 4.0 / 3.0
"""Length of the sum of three phase errors of one size and the signs of their currents."""
BAND = 0.02


@dataclass(frozen=True, slots=True)
class ClosedDrive:
    """What a closed drive offers and what is known of its control."""

    name: str
    """Family."""
    offers: frozenset[str]
    """Catalogue names it has an object for."""
    bandwidth_hz: float | None = None
    """Bandwidth of its current control where its gains cannot be written."""
    rise_s: float = RISE_S
    """Largest time from zero to the torque limit."""
    speed_rpm: float | None = None
    """Speed up to which the guarantee is to hold; None: where torque times speed is largest."""
    acceleration_rpm_per_s: float | None = None
    """Largest acceleration, whatever causes it; None: what the torque limit does to the least inertia."""
    decoupled: bool | None = None
    """Whether its current control adds omega (L i + psi); None: not known, both are held to."""

    def __post_init__(self) -> None:
        numbers = {"bandwidth_hz": self.bandwidth_hz, "rise_s": self.rise_s, "speed_rpm": self.speed_rpm,
                   "acceleration_rpm_per_s": self.acceleration_rpm_per_s}  # fmt: skip
        wrong = [
            f"{name} = {value!r} is not a positive number"
            for name, value in numbers.items()
            if value is not None and not (math.isfinite(value) and value > 0.0)
        ]
        if wrong:
            raise ConfigError("the request cannot be used", where="drive with fixed firmware", violations=wrong)
        missing = [name for name in (RATED, SLOPE) if name not in self.offers]
        missing += [] if self.offers & {TORQUE, CURRENT} else [f"{TORQUE} or {CURRENT}"]
        if missing:
            raise NotAvailable(
                f"the drive map {self.name!r} has no object for {', '.join(missing)}",
                where="drive with fixed firmware",
                likely="its maker documents no torque mode with a slope and a limit (0x6087, 0x6072, 0x6076)",
                hint="add --axis for gains of its speed and position loops, or design without --map: `flash-params "
                "--map` and `commission` write what the drive takes",
            )


@dataclass(frozen=True, slots=True, eq=False)
class Guarantee:
    """In which range the voltage demand never exceeds the limit, and what that costs."""

    tau_nm: float
    n_rpm: float
    slope_nm_per_s: float
    acceleration_rpm_per_s: float
    """The range: torque, speed, slope of the set-point, acceleration."""
    I_apk: float
    deviation_a: float
    """Largest current of the reference, and how far the current may stray from it (A)."""
    demand_v: float
    limit_v: float
    V_max_v: float
    """Bound of the demand; what it is held to: the least V_max less margin and dead time; the least V_max."""
    speeds_rpm: Array
    closed_nm: Array
    governed_nm: Array
    """Largest torque over speed: of a limit that followed the speed, and of the full governor. Shape (m,)."""
    governed_rise_s: float
    """Time from zero to ``tau_nm`` at ``n_rpm`` in the shortest possible way, which the full governor takes."""

    @property
    def torque_loss(self) -> float:
        """Share of the full governor's torque at the guaranteed speed that is lost."""
        return 1.0 - self.tau_nm / float(np.interp(self.n_rpm, self.speeds_rpm, self.governed_nm))

    @property
    def standstill_loss(self) -> float:
        """The same at standstill."""
        return 1.0 - self.tau_nm / float(self.governed_nm[0])

    @property
    def rise_s(self) -> float:
        """Time from zero to the torque limit along the slope."""
        return self.tau_nm / self.slope_nm_per_s

    def facts(self) -> dict[str, Scalar]:
        """Return everything as facts of a design."""
        return {
            "closed_drive_torque_nm": self.tau_nm,
            "closed_drive_speed_rpm": self.n_rpm,
            "closed_drive_slope_nm_per_s": self.slope_nm_per_s,
            "closed_drive_acceleration_rpm_per_s": self.acceleration_rpm_per_s,
            "closed_drive_current_apk": self.I_apk,
            "closed_drive_current_deviation_a": self.deviation_a,
            "closed_drive_demand_v": self.demand_v,
            "closed_drive_limit_v": self.limit_v,
            "closed_drive_V_max_v": self.V_max_v,
            "closed_drive_torque_loss_percent": 100.0 * self.torque_loss,
            "closed_drive_standstill_loss_percent": 100.0 * self.standstill_loss,
            "closed_drive_rise_s": self.rise_s,
            "closed_drive_governed_rise_s": self.governed_rise_s,
        }

    def sentence(self) -> str:
        """Return the guarantee as a person reads it."""
        return (
            f"in profile torque mode: voltage demand <= {self.demand_v:.4g} V (limit {self.limit_v:.4g} V of "
            f"{self.V_max_v:.4g} V) and current <= {self.I_apk + self.deviation_a:.4g} A. This holds for every torque "
            f"set-point within +-{self.tau_nm:.4g} N m, speed within +-{self.n_rpm:.4g} rpm and acceleration up to "
            f"{self.acceleration_rpm_per_s:.3g} rpm/s, delay and intervals included; no guarantee above "
            f"that speed. Cost: {100.0 * self.torque_loss:.1f} % of the full governor's torque at that speed, "
            f"{100.0 * self.standstill_loss:.1f} % at standstill; {1e3 * self.rise_s:.3g} ms to the torque limit "
            f"instead of {1e3 * self.governed_rise_s:.3g} ms"
        )


def tune_closed(source: MachineFile, request: TuneRequest, drive: ClosedDrive) -> tuple[Design, Guarantee]:
    """Design a closed drive: gains as far as it takes them, and the limits that keep it out of saturation.

    Raises ConfigError: what is needed and not known: bandwidth of a drive whose gains cannot be written, inertia or
    acceleration; DesignInfeasible: no torque is admissible, not even at the lowest speeds.
    """
    unheld = tune(source, replace(request, controller="pi", governor="off", field_weakening="off", predictor=False))
    design = _as_controlled(unheld, drive)
    V_limit = (1.0 - request.voltage_margin) * source.inverter.V_max_v
    rated = ratings(source, V_limit, request.overspeed_protection)
    loops = current_loops(design, drive)
    found = _Projection(source, rated, request, drive, loops).guarantee()
    how = f"{drive.name}: largest torque x speed whose demand is bounded by the voltage limit"
    rated_nm = torque_per_ampere(source.machine.pole_pairs, source.machine.psi_f_wb) * rated.I_nom_apk
    values = {
        **design.values,
        RATED: DesignValue(rated_nm, "torque of the rated current without i_d"),
        SLOPE: DesignValue(found.slope_nm_per_s, f"{drive.name}: largest slope with a bounded demand"),
        TORQUE: DesignValue(found.tau_nm, how),
        SPEED: DesignValue(min(found.n_rpm, rated.n_max_rpm), how),
    }
    if TORQUE not in drive.offers:
        values[CURRENT] = DesignValue(found.I_apk, how)
    notes = (*design.notes, *tolerance_box(source).notes, found.sentence())
    if SPEED not in drive.offers:
        notes += (f"{drive.name} has no object for the speed limit: keep {found.n_rpm:.4g} rpm in the application",)
    asked: dict[str, Scalar] = {**design.request, "drive": drive.name}
    if drive.bandwidth_hz is not None and not _takes_gains(drive):
        asked[STATED] = drive.bandwidth_hz
    return replace(design, values=values, facts={**design.facts, **found.facts()}, notes=notes, request=asked), found


def _takes_gains(drive: ClosedDrive) -> bool:
    return not lacking_gains(drive.offers)[CURRENT_LOOPS]


def _as_controlled(design: Design, drive: ClosedDrive) -> Design:
    """Return the design with the gains its drive has: those written, else those its bandwidth stands for."""
    machine = design.machine.machine
    if _takes_gains(drive):
        gains = one_pair(design, drive.offers)
    elif drive.bandwidth_hz is not None:
        alpha = 2.0 * math.pi * drive.bandwidth_hz
        stated = (alpha * machine.L_d_h, alpha * machine.R_s_ohm, alpha * machine.L_q_h, alpha * machine.R_s_ohm)
        how = f"{drive.name}: from its bandwidth of {drive.bandwidth_hz:.5g} Hz, not written"
        gains = {name: DesignValue(value, how) for name, value in zip(CURRENT_GAINS, stated, strict=True)}
    else:
        raise ConfigError(
            f"the gains of {drive.name!r} cannot be written, and its current bandwidth is not known",
            where="drive with fixed firmware",
            hint="give --drive-bandwidth-hz, as in the maker's tool or manual",
        )
    judged = (CURRENT_LOOPS,) if lacking_gains(drive.offers)[SPEED_LOOP] else (CURRENT_LOOPS, SPEED_LOOP)
    return with_gains(design, gains, judged)


def current_loops(design: Design, drive: ClosedDrive) -> CurrentLoops:
    """Return the current control that a design of a closed drive holds."""
    inverter = design.machine.inverter
    whole = max(0, math.ceil(inverter.delay_periods - 0.5 - 1e-9))
    if whole > 1:
        raise ConfigError(
            f"{inverter.delay_periods:g} periods of delay are not modelled",
            where="drive with fixed firmware",
            hint="the guarantee covers up to 1.5 periods: correct inverter.delay_periods, or leave --map out",
        )
    K_p_d, K_i_d, K_p_q, K_i_q = (design[name] for name in CURRENT_GAINS)
    return CurrentLoops((K_p_d, K_p_q), (K_i_d, K_i_q), inverter.T_s, whole, stair_s=STAIR_S)


def machine_box(source: MachineFile, box: ToleranceBox) -> MachineBox:
    """Return the constants' 95 % intervals over the temperatures of a tolerance box."""
    machine = source.machine

    def ends(name: str, low: float, high: float) -> tuple[float, float]:
        half = box.factors[name].half_width if name in box.factors else 0.0
        return (1.0 - half) * low, (1.0 + half) * high

    R = [resistance_at(machine, T) for T in box.T_winding_c]
    psi = [magnet_flux_at(machine, T) for T in box.T_magnet_c]
    return MachineBox(
        ends("R_s_ohm", min(R), max(R)),
        ends("L_d_h", machine.L_d_h, machine.L_d_h),
        ends("L_q_h", machine.L_q_h, machine.L_q_h),
        ends("psi_f_wb", min(psi), max(psi)),
    )


class _Projection:
    """Search of the largest range; everything in SI, electrical speed."""

    def __init__(
        self, source: MachineFile, rated: Ratings, request: TuneRequest, drive: ClosedDrive, loops: CurrentLoops
    ) -> None:
        machine, inverter = source.machine, source.inverter
        tolerance = tolerance_box(source)
        self.source, self.rated, self.drive = source, rated, drive
        self.box = machine_box(source, tolerance)
        self.V_max = inverter.voltage_utilisation * min(tolerance.U_dc_v)
        dead = DEAD_TIME_VECTOR * inverter.dead_time_s / inverter.T_s * max(tolerance.U_dc_v)
        self.margin = request.voltage_margin
        self.limit = (1.0 - request.voltage_margin) * self.V_max - dead
        flux = tolerance.factors["psi_f_wb"].half_width if "psi_f_wb" in tolerance.factors else 0.0
        self.per_ampere = torque_per_ampere(machine.pole_pairs, machine.psi_f_wb) * (1.0 - flux)
        if machine.psi_f_wb == 0.0:
            raise DesignInfeasible(
                "without a magnet there is no torque at i_d = 0",
                where="drive with fixed firmware",
                hint="leave the limits out: a reluctance machine needs i_d, which cannot be commanded on such a drive",
            )
        if machine.J_kgm2 is None and drive.acceleration_rpm_per_s is None:
            raise ConfigError(
                "neither the inertia J_kgm2 nor the largest acceleration is known",
                where="drive with fixed firmware",
                hint="put J_kgm2 into the machine file, or give --limit-acceleration-rpm-per-s",
            )
        J = tolerance.factors["J_kgm2"].half_width if "J_kgm2" in tolerance.factors else 0.0
        self.least_J = (machine.J_kgm2 or math.inf) * (1.0 - J)
        self.per_rpm = machine.pole_pairs / RPM_PER_RAD_S
        self.responses = self._responses(loops)
        self.I_top = min(rated.I_max_apk, rated.tau_max_nm / self.per_ampere)

    def _responses(self, loops: CurrentLoops) -> Sequence[SlopeResponse]:
        """Return the responses of both structures; without a speed asked for, up to where the loops are stable."""
        asked = self.drive.speed_rpm
        # beyond, the magnet alone takes the whole voltage
        top_rpm = min(self.rated.n_max_rpm, self.limit / self.box.psi[0] / self.per_rpm) if asked is None else asked
        structures = (False, True) if self.drive.decoupled is None else (self.drive.decoupled,)
        for _ in range(TRIES):
            try:
                return [
                    slope_response(self.box, replace(loops, decoupled=one), top_rpm * self.per_rpm, SPEEDS)
                    for one in structures
                ]
            except DesignInfeasible:
                if asked is not None:
                    raise
                top_rpm *= LOWER
        raise DesignInfeasible(
            "the current loops of the drive with fixed firmware are unstable",
            where="drive with fixed firmware",
            hint="give a smaller bandwidth, or a lower speed",
        )

    def demand(self, I_apk: float, slope_a: float, speeds: int) -> tuple[float, float]:
        """Return bounds of the demand (V) and of the current's deviation (A)."""
        stair = min(slope_a * STAIR_S, 2.0 * I_apk)
        rate = self.acceleration(I_apk)
        bounds = [one.largest_demand(I_apk, stair, rate, speeds) for one in self.responses]
        return max(float(demand.max()) for demand, _ in bounds), max(deviation for _, deviation in bounds)

    def holds(self, I_apk: float, slope_a: float, speeds: int) -> bool:
        """Whether neither voltage nor current can leave their limits."""
        demand, deviation = self.demand(I_apk, slope_a, speeds)
        return demand <= self.limit and I_apk + deviation <= self.rated.I_max_apk

    def acceleration(self, I_apk: float) -> float:
        """Return the largest |d omega_e / dt| (rad/s2)."""
        if self.drive.acceleration_rpm_per_s is not None:
            return self.drive.acceleration_rpm_per_s * self.per_rpm
        # the machine's own torque, at the largest flux
        machine = self.source.machine
        torque = torque_per_ampere(machine.pole_pairs, self.box.psi[1]) * I_apk
        return machine.pole_pairs * torque / self.least_J

    def _rises(self, speeds: int, I_apk: float) -> bool:
        return self.holds(I_apk, I_apk / self.drive.rise_s, speeds)

    def currents(self) -> Array:
        """Return the largest current admissible up to each speed, rising within the time asked for."""
        found = [self.I_top]
        for k in range(SPEEDS):
            # the more speeds the less current
            found.append(_largest(partial(self._rises, k + 1), found[-1]))
        return np.array(found[1:])

    def guarantee(self) -> Guarantee:
        """Return the chosen range and its cost."""
        omega = self.responses[0].omega_e
        speeds_rpm = omega / self.per_rpm
        currents = self.currents()
        last = len(omega) - 1 if self.drive.speed_rpm is not None else int(np.argmax(currents * omega))
        I_apk = float(currents[last])
        if I_apk <= 0.0 or omega[last] <= 0.0:
            demand, _ = self.demand(0.0, 0.0, last + 1)
            raise DesignInfeasible(
                f"no torque is admissible up to {speeds_rpm[last]:.5g} rpm",
                where="drive with fixed firmware",
                likely=f"without any torque the demand is bounded by {demand:.4g} V, the limit is {self.limit:.4g} V",
                hint="ask for a lower speed, a longer rise, or a smaller acceleration",
            )
        slope_a = _largest(lambda slope: self.holds(I_apk, slope, last + 1), 2.0 * I_apk / STAIR_S)
        demand, deviation = self.demand(I_apk, slope_a, last + 1)
        machine = at_temperature(self.source.machine, self.source.flux_map)
        V = (1.0 - self.margin) * self.source.inverter.V_max_v
        full = torque_limits(machine, omega, [V], self.rated.I_max_apk, self.rated.i_d_min_a).largest_nm[:, 0]
        # the drive's own constant may be the least of the interval: then a torque takes the most current
        per_ampere = self.per_ampere
        return Guarantee(
            per_ampere * I_apk, float(speeds_rpm[last]), per_ampere * slope_a, self.acceleration(I_apk) / self.per_rpm,
            I_apk, deviation, demand, self.limit, self.V_max, speeds_rpm, per_ampere * currents,
            np.minimum(full, self.rated.tau_max_nm), self._shortest(I_apk, float(omega[last]), V),
        )  # fmt: skip

    def _shortest(self, I_apk: float, omega: float, V: float) -> float:
        m = self.source.machine
        problem = TransferProblem(m.R_s_ohm, m.L_d_h, m.L_q_h, m.psi_f_wb, omega, V)
        return minimum_time(problem, (0.0, 0.0), (0.0, I_apk), radius=BAND * I_apk)


def _largest(holds: Callable[[float], bool], top: float) -> float:
    """Return the largest number up to ``top`` for which something holds that holds less and less."""
    if holds(top):
        return top
    low, high = 0.0, top
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low
