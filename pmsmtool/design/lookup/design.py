# SPDX-License-Identifier: MIT
"""The table a drive needs: axes, voltages and temperatures chosen from machine file and request."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.lookup.grid import (
    GridBounds,
    InterpolationError,
    StoredFormat,
    as_stored,
    interpolation_error,
    largest_speed_rpm,
    refined_table,
    stored_axes,
    table_words,
)
from pmsmtool.design.lookup.table import (
    STANDSTILL_V,
    AxisKind,
    LookupTable,
    TorqueLimits,
    electrical_speed,
    flux_table,
    speed_table,
    torque_limits,
)
from pmsmtool.design.operating_machine import OperatingMachine, at_temperature
from pmsmtool.design.ratings import SAG_SHARE, Ratings
from pmsmtool.errors import ConfigError, DesignInfeasible
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.saturation_table import NODES_D, NODES_Q
from pmsmtool.params.catalogue import LUT_CAPACITY_WORDS, SATURATION_VALUES
from pmsmtool.plain_text import Summarised, Summary

FIRST_TORQUES, FIRST_SPEEDS = 17, 13
"""Nodes of the axes that refinement starts from."""

BOUNDS = (0.01, 0.02, 0.03, 0.05, 0.08, 0.12)
"""Largest errors between nodes where none is asked for, over the largest torque and the voltage limit: the first whose
grid fits the drive."""

LEAST_FLUX_RATIO = 0.02
"""Smallest flux limit of a flux table over the largest, where the speed axis gives none."""


@dataclass(frozen=True, slots=True)
class LookupRequest:
    """What is asked of a table.

    Attributes
    ----------
    axis : {"speed", "flux"}
        Second axis.
    torque_points, y_points : int or None
        Uniform axes with these nodes; None refines until the bounds hold.
    torque_bound, voltage_bound : float or None
        Largest error between nodes, over the largest torque and over the voltage limit; None takes the first of
        :data:`BOUNDS` that fits the drive.
    stored : {"auto", "float32", "int16"}
        Format in the drive; ``auto`` takes float32 where it fits.
    U_dc_v : tuple of float
        DC-link voltages (V); empty for the nominal one.
    T_winding_c, T_magnet_c : float or None
        Temperatures (degC); T_ref where not given.
    n_max_rpm : float or None
        Largest speed; that of the machine.
    """

    axis: AxisKind = "speed"
    torque_points: int | None = None
    y_points: int | None = None
    torque_bound: float | None = None
    voltage_bound: float | None = None
    stored: str = "auto"
    U_dc_v: tuple[float, ...] = ()
    T_winding_c: float | None = None
    T_magnet_c: float | None = None
    n_max_rpm: float | None = None

    def __post_init__(self) -> None:
        wrong = []
        if self.stored not in ("auto", "float32", "int16"):
            wrong.append(f"stored is {self.stored!r}, allowed are auto, float32, int16")
        if (self.torque_points is None) != (self.y_points is None):
            wrong.append("give the nodes of both axes, or of none")
        for name in ("torque_points", "y_points"):
            value = getattr(self, name)
            if value is not None and not 2 <= value <= 4096:
                wrong.append(f"{name} = {value} is outside 2..4096")
        for name in ("torque_bound", "voltage_bound"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                wrong.append(f"{name} = {value!r} is not positive")
        U_dc = self.U_dc_v
        if any(not (math.isfinite(U) and U > 0.0) for U in U_dc) or sorted(set(U_dc)) != list(U_dc):
            wrong.append("the DC-link voltages are not positive and increasing")
        if wrong:
            raise ConfigError("the request cannot be used", where="lut", violations=wrong)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LookupDesign(Summarised):
    """A table with what must be known of it."""

    table: LookupTable
    """As stored in the drive."""
    stored: StoredFormat
    """Its format. One of "float32", "int16"."""
    error: InterpolationError
    """Bounds between its nodes."""
    notes: tuple[str, ...]
    """What a person must know."""
    torque_bound: float = math.inf
    voltage_bound: float = math.inf
    """What its grid was refined to, over the largest torque and the voltage limit; infinite for uniform axes."""

    def summary(self) -> Summary:
        """Return how large the table is, what binds in its cells, and what interpolation does between them."""
        lookup, error = self.table, self.error
        shape = " x ".join(map(str, lookup.i_d_a.shape))
        y_unit = "rpm" if lookup.axis_kind == "speed" else "Wb"
        end = f"torque to {lookup.torque_nm[-1]:.4g} N m, {lookup.axis_kind} to {lookup.y[-1]:.5g} {y_unit}"
        between = (
            f"between nodes: torque within {error.torque_nm:.3g} N m, voltage at most {error.voltage_v:.3g} V "
            f"and current at most {error.current_a:.3g} A beyond their limits"
        )
        cells = list(zip(*lookup.binding_counts(), strict=True))
        return Summary(f"{shape} cells, {self.stored}; {end}", ("limit", "cells"), cells, (between,))


def design_table(
    source: MachineFile,
    rated: Ratings,
    request: LookupRequest,
    voltage_margin: float,
    loss_map: FluxMap | None = None,
) -> LookupDesign:
    """Make the table.

    Raises DesignInfeasible: the bounds cannot be kept in the drive's memory, or no speed can be reached.

    Parameters
    ----------
    source : MachineFile
        Machine and inverter.
    rated : Ratings
        Current limits and speed.
    request : LookupRequest
        What is asked.
    voltage_margin : float
        Share of V_max kept for control.
    loss_map : FluxMap, optional
        Iron loss (``OperatingMachine.loss_map``).
    """
    known = loss_map if request.axis == "speed" else None
    machine = at_temperature(
        source.machine, source.flux_map,
        T_winding_c=request.T_winding_c, T_magnet_c=request.T_magnet_c, loss_map=known,
    )  # fmt: skip
    problem = _Problem(machine, source, rated, request, voltage_margin)
    y, notes = problem.second_axis()
    if loss_map is not known:
        notes = (*notes, "a flux table has no speed axis: least copper loss, the iron-loss map is left out")
    torque = problem.largest_torque()
    if request.torque_points is not None and request.y_points is not None:
        x = np.linspace(-torque, torque, request.torque_points)
        stored = _fitting(request, _capacity_words(source), x.size, y[1].size, problem.V_max.size)
        table = as_stored(problem.solve(*stored_axes(x, y[1], problem.U_dc)), stored)
        return LookupDesign(table, stored, interpolation_error(table), (*notes, *problem.flux_note(table)))
    x = np.linspace(-torque, torque, FIRST_TORQUES)
    limit = float(problem.V_max.min()) if request.axis == "speed" else float(y[1][-1])
    failed: DesignInfeasible | None = None
    for torque_bound, voltage_bound in _bounds(request):
        for stored in _formats(request, first=failed is None):
            bounds = GridBounds(torque_bound * torque, voltage_bound * limit, stored, _capacity_words(source))
            try:
                table, error = refined_table(problem.solve, x, y[0], problem.U_dc, bounds)
            except DesignInfeasible as refused:
                failed = refused
                continue
            notes = (*notes, *problem.flux_note(table), *_wider(request, torque_bound, voltage_bound))
            return LookupDesign(table, stored, error, notes, torque_bound, voltage_bound)
    assert failed is not None
    raise failed


def _formats(request: LookupRequest, *, first: bool) -> tuple[StoredFormat, ...]:
    """Return the formats to try; int16, where it fits, in half the memory, is all there is to try with wider bounds."""
    if request.stored == "auto":
        return ("float32", "int16") if first else ("int16",)
    return ("int16",) if request.stored == "int16" else ("float32",)


def _bounds(request: LookupRequest) -> list[tuple[float, float]]:
    """Return the bounds of torque and voltage to try: what is asked for, and where nothing is, each of BOUNDS."""
    torque, voltage = request.torque_bound, request.voltage_bound
    tried = [(b if torque is None else torque, b if voltage is None else voltage) for b in BOUNDS]
    return list(dict.fromkeys(tried))


def _wider(request: LookupRequest, torque_bound: float, voltage_bound: float) -> tuple[str, ...]:
    """Return what to say of a table whose bounds are not the first ones."""
    free = (("torque", request.torque_bound, torque_bound), ("voltage", request.voltage_bound, voltage_bound))
    wider = [(name, bound) for name, asked, bound in free if asked is None and bound > BOUNDS[0]]
    if not wider:
        return ()
    names = " and ".join(name for name, _ in wider)
    return (
        f"a table within {100.0 * BOUNDS[0]:g} % of {names} does not fit the drive's {LUT_CAPACITY_WORDS} words: "
        f"this one is within {100.0 * wider[0][1]:g} %",
    )


def _capacity_words(source: MachineFile) -> int:
    """Words that the saturation table of a flux map leaves."""
    return LUT_CAPACITY_WORDS - (NODES_D * NODES_Q * SATURATION_VALUES if source.flux_map is not None else 0)


def _fitting(request: LookupRequest, capacity: int, n_x: int, n_y: int, n_z: int) -> StoredFormat:
    """Format of a uniform table: as asked, else float32 unless only int16 fits the drive."""
    if request.stored == "int16":
        return "int16"
    if request.stored == "auto" and table_words(n_x, n_y, n_z, "float32") > capacity:
        return "int16" if table_words(n_x, n_y, n_z, "int16") <= capacity else "float32"
    return "float32"


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    machine: OperatingMachine
    source: MachineFile
    rated: Ratings
    request: LookupRequest
    voltage_margin: float

    @property
    def U_dc(self) -> Array:
        return np.asarray(self.request.U_dc_v or (self.source.inverter.U_dc_v,), dtype=np.float64)

    @property
    def V_max(self) -> Array:
        return self._limit(self.U_dc)

    def _limit(self, U_dc_v: Array) -> Array:
        return (1.0 - self.voltage_margin) * self.source.inverter.voltage_utilisation * U_dc_v

    def largest_torque(self) -> float:
        bounds = torque_limits(self.machine, [0.0], [STANDSTILL_V], self.rated.I_max_apk, self.rated.i_d_min_a)
        return float(max(bounds.largest_nm[0, 0], -bounds.least_nm[0, 0]))

    def solve(self, torque_nm: Array, y: Array, U_dc_v: Array) -> LookupTable:
        I_max, i_d_min = self.rated.I_max_apk, self.rated.i_d_min_a
        if self.request.axis == "flux":
            return flux_table(self.machine, torque_nm=torque_nm, flux_limit_wb=y, I_max_apk=I_max, i_d_min_a=i_d_min)
        return speed_table(
            self.machine, torque_nm=torque_nm, speed_rpm=y, V_max_v=self._limit(U_dc_v), I_max_apk=I_max,
            i_d_min_a=i_d_min, U_dc_v=U_dc_v,
        )  # fmt: skip

    def second_axis(self) -> tuple[tuple[Array, Array], tuple[str, ...]]:
        """Return the first nodes for refinement, the uniform axis, and notes."""
        n_wanted = self.rated.n_max_rpm if self.request.n_max_rpm is None else self.request.n_max_rpm
        sags = self.request.axis == "speed" and len(self.U_dc) == 1  # the drive looks up at n U_dc / U_now
        n_max = largest_speed_rpm(self._reachable, n_wanted / SAG_SHARE if sags else n_wanted)
        notes = () if n_max >= n_wanted else (_unreachable(n_max, n_wanted),)
        points = FIRST_SPEEDS if self.request.y_points is None else self.request.y_points
        if self.request.axis == "speed":
            return (np.linspace(0.0, n_max, FIRST_SPEEDS), np.linspace(0.0, n_max, points)), notes
        top = self._largest_flux()
        low = max(LEAST_FLUX_RATIO * top, float(self.V_max.min()) / float(electrical_speed(self.machine, n_max)))
        return (np.linspace(low, top, FIRST_SPEEDS), np.linspace(low, top, points)), notes

    def _reachable(self, speed_rpm: float) -> bool:
        """Whether zero torque is admissible; beyond, the voltage allows braking alone, and its range may jump."""
        omega = electrical_speed(self.machine, [np.float32(speed_rpm)])
        bounds = self._limits_at(omega, float(self.V_max.min()))
        return bool(bounds.least_nm[0, 0] <= 0.0 <= bounds.largest_nm[0, 0])

    def _limits_at(self, omega_e: Array, V: float) -> TorqueLimits:
        return torque_limits(self.machine, omega_e, [V], self.rated.I_max_apk, self.rated.i_d_min_a)

    def _largest_flux(self) -> float:
        """Flux beyond which no torque needs field weakening."""
        bounds = torque_limits(self.machine, [0.0], [STANDSTILL_V], self.rated.I_max_apk, self.rated.i_d_min_a)
        points = ((bounds.largest_i_d_a, bounds.largest_i_q_a), (bounds.least_i_d_a, bounds.least_i_q_a), (0.0, 0.0))
        return max(float(np.hypot(*self.machine.flux(*point)).max()) for point in points)

    def flux_note(self, table: LookupTable) -> tuple[str, ...]:
        """How far a flux table is off because it knows no resistance."""
        if table.axis_kind == "speed":
            return ()
        V = float(self.V_max.min())
        omega = V / table.y[None, :, None]
        over = max(float(np.nanmax(self.machine.voltage_v(table.i_d_a, table.i_q_a, omega) - V)), 0.0)
        real, without = self._limits_at(omega.ravel(), V), table.torque_limits
        unused = np.maximum(real.largest_nm - without.largest_nm, without.least_nm - real.least_nm)
        lost = max(float(np.nanmax(unused, initial=0.0)), 0.0)
        return (
            f"a flux table contains no resistance: at {V:.4g} V its points need up to {over:.3g} V "
            f"({100.0 * over / V:.2g} %) more than the limit and leave up to {lost:.3g} N m unused; "
            "a table over speed does neither: prefer it",
        )


def _unreachable(n_max: float, wanted: float) -> str:
    return f"beyond {n_max:.5g} rpm (of {wanted:.5g} rpm) the voltage allows no zero torque: the table ends there"
