# SPDX-License-Identifier: MIT
"""Current references of least loss over torque x speed x DC-link voltage, or torque x flux limit.

The kernel (``lookup_table.c``) solves every cell in double precision; here are the table as a value, its margins and
the names of its limits. The winding resistance is part of the voltage everywhere; a table over the flux limit is the
same problem without resistance, which is why it is only as good as the resistance drop is small.
Its loci are MTPA over current, MTPV over speed, and the largest torque over speed.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pmsmtool.arrays import Array
from pmsmtool.design.operating_machine import OperatingMachine, design_library
from pmsmtool.errors import ConfigError, DesignInfeasible
from pmsmtool.units import RPM_PER_RAD_S

AxisKind = Literal["speed", "flux"]

CURRENT, VOLTAGE, DEMAGNETISATION, MAP, CUT, NONE = 1, 2, 4, 8, 16, 32
"""Bits of a cell's limits (``enum pmsm_limit``)."""


_NAMES = ((CURRENT, "current"), (VOLTAGE, "voltage"), (DEMAGNETISATION, "demagnetisation"), (MAP, "map"))


def binding_name(limits: int) -> str:
    """Return the name of what binds in a cell.

    ``mtpa`` no limit; ``voltage`` field weakening; ``mtpv`` torque cut by the voltage alone; otherwise the limits
    touched, joined by ``+``; ``none`` no admissible point.
    """
    if limits & NONE:
        return "none"
    touched = [name for bit, name in _NAMES if limits & bit]
    if touched == ["voltage"] and limits & CUT:
        return "mtpv"
    return "+".join(touched) or "mtpa"


@dataclass(frozen=True, slots=True, eq=False)
class TorqueLimits:
    """Least and largest torque (N m) per speed and voltage, and their currents (A peak); NaN: no admissible point.

    All of shape (n_speed, n_voltage).
    """

    least_nm: Array
    least_i_d_a: Array
    least_i_q_a: Array
    largest_nm: Array
    largest_i_d_a: Array
    largest_i_q_a: Array

    def nearest(self, torque_nm: ArrayLike) -> Array:
        """Clamp torques, broadcast against (n_speed, n_voltage), to what each speed allows."""
        return np.asarray(np.clip(np.asarray(torque_nm, dtype=np.float64), self.least_nm, self.largest_nm))


@dataclass(frozen=True, slots=True, eq=False)
class LookupTable:
    """References over torque (x), speed or flux limit (y) and DC-link voltage (z)."""

    machine: OperatingMachine
    """Machine and temperatures the table is for."""
    axis_kind: AxisKind
    """What y is. One of "speed", "flux"."""
    torque_nm: Array
    """Torque axis (N m), both signs as wanted. Shape (n_x,)."""
    y: Array
    """Mechanical speed (rpm) or flux limit (Wb). Shape (n_y,)."""
    U_dc_v: Array
    """DC-link voltage (V); one entry for a table without that axis. Shape (n_z,)."""
    V_max_v: Array
    """Voltage limit used (V peak); for a flux table of no meaning. Shape (n_z,)."""
    I_max_apk: float
    i_d_min_a: float
    """Current limits (A); minus infinity where there is no demagnetisation limit."""
    i_d_a: Array
    i_q_a: Array
    achieved_torque_nm: Array
    """References (A peak) and their torque (N m); NaN in cells without a point. Shape (n_x, n_y, n_z)."""
    limits: NDArray[np.uint8]
    """Bits of the limits that bind (:func:`binding_name`). Shape (n_x, n_y, n_z)."""
    margin_v: Array
    margin_i: Array
    """V_max - |v| (V; Wb for a flux table) and I_max - |i| (A) of the stored currents. Shape (n_x, n_y, n_z)."""
    torque_limits: TorqueLimits
    """Per (y, z)."""

    @property
    def margin_torque_nm(self) -> Array:
        """Torque left to the limit of the cell's speed and voltage on the side of the demand, shape of the tables.

        Negative: the demand lies that far beyond the nearest feasible torque, which the cell holds instead; NaN where
        there is no admissible point.
        """
        T = self.torque_nm[:, None, None]
        return np.where(T >= 0.0, self.torque_limits.largest_nm - T, T - self.torque_limits.least_nm)

    @property
    def binding(self) -> NDArray[np.str_]:
        """Names of the binding limits, shape of the tables."""
        names = np.array([binding_name(k) for k in range(64)])
        return names[self.limits]

    def binding_counts(self) -> tuple[list[str], list[int]]:
        """Return the names of the limits that bind somewhere, and in how many cells."""
        names, counts = np.unique(self.binding, return_counts=True)
        return names.tolist(), counts.tolist()

    def with_currents(self, i_d_a: Array, i_q_a: Array) -> LookupTable:
        """Return the table with other stored currents (rounded ones); torque and margins follow from them."""
        voltage, limit = _demand(self, i_d_a, i_q_a)
        return replace(
            self,
            i_d_a=i_d_a,
            i_q_a=i_q_a,
            achieved_torque_nm=self.machine.torque_nm(i_d_a, i_q_a),
            margin_v=limit - voltage,
            margin_i=self.I_max_apk - np.hypot(i_d_a, i_q_a),
        )


def electrical_speed(machine: OperatingMachine, speed_rpm: ArrayLike) -> Array:
    """Return the electrical angular speed (rad/s) of mechanical speeds (rpm)."""
    return np.asarray(speed_rpm, dtype=np.float64) * machine.pole_pairs / RPM_PER_RAD_S


def _demand(table: LookupTable, i_d: Array, i_q: Array) -> tuple[Array, Array]:
    """Voltage (or flux) of the currents, and its limit."""
    if table.axis_kind == "flux":
        return np.hypot(*table.machine.flux(i_d, i_q)), np.broadcast_to(table.y[None, :, None], i_d.shape)
    omega = electrical_speed(table.machine, table.y)[None, :, None]
    return table.machine.voltage_v(i_d, i_q, omega), np.broadcast_to(table.V_max_v[None, None, :], i_d.shape)


def speed_table(
    machine: OperatingMachine,
    *,
    torque_nm: ArrayLike,
    speed_rpm: ArrayLike,
    V_max_v: ArrayLike,
    I_max_apk: float,
    i_d_min_a: float = -math.inf,
    U_dc_v: ArrayLike | None = None,
) -> LookupTable:
    """Solve a table over torque, speed and voltage.

    Raises DesignInfeasible: a folded flux map, or limits that leave out zero current; ConfigError: references outside
    the iron-loss map.

    Parameters
    ----------
    machine : OperatingMachine
        Machine at its temperatures.
    torque_nm, speed_rpm : array_like, shape (n_x,), (n_y,)
        Axes; any signs.
    V_max_v : array_like, shape (n_z,)
        Voltage limits (V peak), one per entry of ``U_dc_v``.
    I_max_apk : float
        Current limit (A peak).
    i_d_min_a : float
        Most negative i_d (A).
    U_dc_v : array_like, optional
        DC-link voltages (V) the limits belong to; sqrt(3) V_max where not given.
    """
    V_max = np.atleast_1d(np.asarray(V_max_v, dtype=np.float64))
    U_dc = math.sqrt(3.0) * V_max if U_dc_v is None else np.atleast_1d(np.asarray(U_dc_v, dtype=np.float64))
    y = np.atleast_1d(np.asarray(speed_rpm, dtype=np.float64))
    return _solve(machine, "speed", torque_nm, y, electrical_speed(machine, y), U_dc, V_max, I_max_apk, i_d_min_a)


def flux_table(
    machine: OperatingMachine,
    *,
    torque_nm: ArrayLike,
    flux_limit_wb: ArrayLike,
    I_max_apk: float,
    i_d_min_a: float = -math.inf,
) -> LookupTable:
    """Solve a table over torque and flux limit |psi| <= y: exact for a machine without resistance only.

    Parameters are those of :func:`speed_table`; ``flux_limit_wb`` (Wb) is positive. Iron loss needs the speed, which
    such a table does not know: a machine with a loss map is refused (``ConfigError``).
    """
    if machine.loss_map is not None:
        raise ConfigError(
            "iron loss depends on the speed, which it lacks", where="flux table", hint="take a table over speed"
        )
    y = np.atleast_1d(np.asarray(flux_limit_wb, dtype=np.float64))
    lossless = replace(machine, R=0.0)
    # |v| = |psi| at w = 1 rad/s without resistance: each limit is one "voltage" of one "speed".
    solved = _solve(lossless, "speed", torque_nm, np.ones(1), np.ones(1), y, y, I_max_apk, i_d_min_a)
    cells = {
        name: np.ascontiguousarray(np.swapaxes(getattr(solved, name), 1, 2))
        for name in ("i_d_a", "i_q_a", "achieved_torque_nm", "limits", "margin_i")
    }
    bounds = TorqueLimits(*(np.ascontiguousarray(getattr(solved.torque_limits, n).T) for n in TorqueLimits.__slots__))
    table = LookupTable(
        machine, "flux", solved.torque_nm, y, np.zeros(1), np.zeros(1), I_max_apk, i_d_min_a,
        margin_v=np.zeros(1), torque_limits=bounds, **cells,
    )  # fmt: skip
    return table.with_currents(table.i_d_a, table.i_q_a)


def torque_limits(
    machine: OperatingMachine, omega_e: ArrayLike, V_max_v: ArrayLike, I_max_apk: float, i_d_min_a: float = -math.inf
) -> TorqueLimits:
    """Return the least and largest torque at electrical speeds (rad/s) and voltages (V peak)."""
    omega = np.atleast_1d(np.asarray(omega_e, dtype=np.float64))
    V = np.atleast_1d(np.asarray(V_max_v, dtype=np.float64))
    return _kernel(machine, np.empty(0), omega, V, I_max_apk, i_d_min_a)[1]


def _solve(
    machine: OperatingMachine,
    axis_kind: AxisKind,
    torque_nm: ArrayLike,
    y: Array,
    omega: Array,
    U_dc: Array,
    V_max: Array,
    I_max: float,
    i_d_min: float,
) -> LookupTable:
    torque = np.atleast_1d(np.asarray(torque_nm, dtype=np.float64))
    (i_d, i_q, achieved, limits), bounds = _kernel(machine, torque, omega, V_max, I_max, i_d_min)
    _require_loss_data(machine, i_d, i_q)
    voltage = machine.voltage_v(i_d, i_q, omega[None, :, None])
    return LookupTable(
        machine, axis_kind, torque, y, U_dc, V_max, I_max, i_d_min, i_d, i_q, achieved, limits,
        V_max - voltage, I_max - np.hypot(i_d, i_q), bounds,
    )  # fmt: skip


def _kernel(
    machine: OperatingMachine, torque: Array, omega: Array, V: Array, I_max: float, i_d_min: float
) -> tuple[tuple[Array, Array, Array, NDArray[np.uint8]], TorqueLimits]:
    _check(machine, torque, omega, V, I_max, i_d_min)
    shape = (torque.size, omega.size, V.size)
    i_d, i_q, achieved = (np.empty(shape) for _ in range(3))
    limits = np.empty(shape, dtype=np.uint8)
    extreme = np.empty((omega.size, V.size, 2, 3))
    axes = [part for axis in (torque, omega, V) for part in (axis.size, axis.ctypes.data)]
    out = [array.ctypes.data for array in (i_d, i_q, achieved, limits, extreme)]
    plane = machine.as_struct(I_max, i_d_min)
    unsolved = design_library().pmsm_lookup_table(ctypes.byref(plane), *axes, *out)
    if unsolved:
        at = np.argwhere(limits == 255)[0]
        raise DesignInfeasible(
            f"{unsolved} of {limits.size} cells have no operating point that could be found, first at "
            f"{torque[at[0]]:.4g} N m, {omega[at[1]]:.4g} rad/s, {V[at[2]]:.4g} V",
            where="flux map",
            likely="the map is folded or noisy: flux does not rise with current",
            hint="check the map, or cut it to the currents in use",
        )
    sides = (extreme[:, :, side, k].copy() for side in range(2) for k in range(3))
    return (i_d, i_q, achieved, limits), TorqueLimits(*sides)


def _require_loss_data(machine: OperatingMachine, i_d: Array, i_q: Array) -> None:
    """Refuse references whose iron loss was extrapolated: least loss means nothing there."""
    if machine.loss_map is None:
        return
    axes = machine.loss_map.i_d_a, machine.loss_map.i_q_a
    outside = [(i < axis[0]) | (i > axis[-1]) for i, axis in zip((i_d, i_q), axes, strict=True)]
    worst = int(np.count_nonzero(outside[0] | outside[1]))
    if worst:
        ends = ", ".join(f"{n} {a[0]:g} to {a[-1]:g} A" for n, a in zip(("i_d", "i_q"), axes, strict=True))
        raise ConfigError(
            f"the map covers {ends}, and {worst} of {i_d.size} references lie outside",
            where="iron-loss map",
            hint="measure or compute the loss over the whole current range, or lower I_max",
        )


def _check(machine: OperatingMachine, torque: Array, omega: Array, V: Array, I_max: float, i_d_min: float) -> None:
    wrong = []
    if not (I_max > 0.0 and math.isfinite(I_max)):
        wrong.append(f"I_max = {I_max!r} A is not a positive number")
    if not i_d_min <= 0.0:
        wrong.append(f"i_d_min = {i_d_min!r} A is positive")
    if V.size == 0 or not np.all(np.isfinite(V) & (V > 0.0)):
        wrong.append("a voltage limit is not a positive number")
    if not (np.all(np.isfinite(omega)) and np.all(np.isfinite(torque))):
        wrong.append("an axis holds values that are not finite")
    if machine.flux_map is None and not (machine.L_d > 0.0 and machine.L_q > 0.0):
        wrong.append("an inductance is not positive")
    if wrong:
        raise DesignInfeasible(
            "; ".join(wrong), where="look-up table", hint="correct the machine file or the axes of the table"
        )


BEYOND_CURRENT = 10.0
"""The MTPV locus is sought with this multiple of I_max (a constant machine; a map ends at its own edge)."""

STANDSTILL_V = 1e9
"""A voltage that limits nothing (V)."""


@dataclass(frozen=True, slots=True, eq=False)
class Locus:
    """Operating points along a line, each shape (n,); NaN where there is none."""

    torque_nm: Array
    i_d_a: Array
    i_q_a: Array
    """Torque (N m) and its currents (A peak)."""
    speed_rpm: Array
    """Mechanical speed (rpm); zero for MTPA."""


def mtpa_locus(machine: OperatingMachine, I_max_apk: float, i_d_min_a: float = -math.inf, points: int = 101) -> Locus:
    """Return the points of least current from zero to the largest torque, equidistant in torque."""
    top = float(torque_limits(machine, [0.0], [STANDSTILL_V], I_max_apk, i_d_min_a).largest_nm[0, 0])
    table = speed_table(
        machine, torque_nm=np.linspace(0.0, top, points), speed_rpm=[0.0], V_max_v=[STANDSTILL_V],
        I_max_apk=I_max_apk, i_d_min_a=i_d_min_a,
    )  # fmt: skip
    return Locus(table.torque_nm, table.i_d_a[:, 0, 0], table.i_q_a[:, 0, 0], np.zeros(points))


def limit_locus(
    machine: OperatingMachine, speed_rpm: Array, V_max_v: float, I_max_apk: float, i_d_min_a: float = -math.inf
) -> tuple[Locus, Locus]:
    """Return the largest and the least torque over speed, all limits in force."""
    bounds = torque_limits(machine, electrical_speed(machine, speed_rpm), [V_max_v], I_max_apk, i_d_min_a)
    largest = Locus(bounds.largest_nm[:, 0], bounds.largest_i_d_a[:, 0], bounds.largest_i_q_a[:, 0], speed_rpm)
    return largest, Locus(bounds.least_nm[:, 0], bounds.least_i_d_a[:, 0], bounds.least_i_q_a[:, 0], speed_rpm)


def mtpv_locus(machine: OperatingMachine, speed_rpm: Array, V_max_v: float, I_max_apk: float) -> Locus:
    """Return the largest torque under the voltage alone; NaN where the edge of a map comes first."""
    reach = BEYOND_CURRENT * I_max_apk
    table = speed_table(
        machine, torque_nm=[1e9], speed_rpm=speed_rpm, V_max_v=[V_max_v], I_max_apk=reach, i_d_min_a=-math.inf
    )
    alone = (table.limits[0, :, 0] & 0b1111) == VOLTAGE
    columns = (t[0, :, 0] for t in (table.achieved_torque_nm, table.i_d_a, table.i_q_a))
    torque, i_d, i_q = (np.where(alone, column, np.nan) for column in columns)
    return Locus(torque, i_d, i_q, np.asarray(speed_rpm, dtype=np.float64))


def loci(table: LookupTable, points: int = 101) -> dict[str, Locus]:
    """Return ``mtpa``, ``mtpv``, ``largest``, ``least`` for the limits of a speed table at its lowest voltage.

    A flux table knows no voltage: its locus is ``mtpa`` alone.
    """
    mtpa = mtpa_locus(table.machine, table.I_max_apk, table.i_d_min_a, points)
    if table.axis_kind == "flux":
        return {"mtpa": mtpa}
    speed = np.linspace(float(table.y[0]), float(table.y[-1]), points)
    V = float(table.V_max_v.min())
    largest, least = limit_locus(table.machine, speed, V, table.I_max_apk, table.i_d_min_a)
    return {
        "mtpa": mtpa,
        "mtpv": mtpv_locus(table.machine, speed, V, table.I_max_apk),
        "largest": largest,
        "least": least,
    }
