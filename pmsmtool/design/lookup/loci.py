# SPDX-License-Identifier: MIT
"""One-dimensional loci of a table: MTPA over current, MTPV over speed, and the largest torque over speed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.lookup.table import VOLTAGE, LookupTable, electrical_speed, speed_table, torque_limits
from pmsmtool.design.operating_machine import OperatingMachine

BEYOND_CURRENT = 10.0
"""The MTPV locus is sought with this multiple of I_max (a constant machine; a map ends at its own edge)."""

STANDSTILL_V = 1e9
"""A voltage that limits nothing (V)."""


@dataclass(frozen=True, slots=True, eq=False)
class Locus:
    """Operating points along a line, each shape (n,); NaN where there is none.

    Attributes
    ----------
    torque_nm, i_d_a, i_q_a : ndarray
        Torque (N m) and its currents (A peak).
    speed_rpm : ndarray
        Mechanical speed (rpm); zero for MTPA.
    """

    torque_nm: Array
    i_d_a: Array
    i_q_a: Array
    speed_rpm: Array


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
