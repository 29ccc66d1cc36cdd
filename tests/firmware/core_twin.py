# SPDX-License-Identifier: MIT
"""A second hand at the control core: PI, limits, modulation and look-up in numpy binary32, one operation at a time.

Written from the equations (``docs/simulation.md``, 1), in the core's order of operations, so that
every result can be compared bit for bit. Test code only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

f = np.float32
Vector = tuple[np.float32, np.float32]

PIO2 = (f(1.570556640625), f(0.000239670276641845703125), f(1.5893254773528196692e-8))
PI = f(math.pi)
SQRT3 = f(math.sqrt(3.0))
SINE = (f(-0.16666651), f(0.00833197), f(-0.00019495))
COSINE = (f(0.0416666467), f(-0.00138873614), f(2.443773e-5))
RPM = f(30.0) / PI


def nearest(x: np.float32) -> int:
    return int(x + (f(-0.5) if x < 0 else f(0.5)))


def sincos(x: np.float32) -> Vector:
    k = nearest(x * f(0.63661977236758134308))
    n = f(k)
    r = ((x - n * PIO2[0]) - n * PIO2[1]) - n * PIO2[2]
    z = r * r
    s = r + r * z * (SINE[0] + z * (SINE[1] + z * SINE[2]))
    c = f(1.0) - f(0.5) * z + z * z * (COSINE[0] + z * (COSINE[1] + z * COSINE[2]))
    first, second = (c, s) if k & 1 else (s, c)
    return (-first if k & 2 else first), (-second if (k + 1) & 2 else second)


def park(x: Vector, s: np.float32, c: np.float32) -> Vector:
    return c * x[0] + s * x[1], c * x[1] - s * x[0]


def park_inverse(x: Vector, s: np.float32, c: np.float32) -> Vector:
    return c * x[0] - s * x[1], s * x[0] + c * x[1]


def clarke(a: np.float32, b: np.float32, c: np.float32) -> Vector:
    return (f(2.0) * a - b - c) * (f(1.0) / f(3.0)), (b - c) * (f(1.0) / SQRT3)


def clarke_inverse(x: Vector) -> tuple[np.float32, np.float32, np.float32]:
    half, root = f(-0.5) * x[0], (f(0.5) * SQRT3) * x[1]
    return x[0], half + root, half - root


def clamp(x: np.float32, low: np.float32, high: np.float32) -> np.float32:
    return low if x < low else min(x, high)


class Node(NamedTuple):
    """A node of the torque axis: mean current of its corners that hold a point, and whether one holds none."""

    i: Vector
    weight: np.float32
    hole: bool


@dataclass
class Twin:
    """Current control of one drive; ``values`` is a catalogue mapping, look-up tables are plain arrays."""

    values: Mapping[str, float]
    axes: tuple[np.ndarray, ...] = ()
    tables: tuple[np.ndarray, ...] = ()
    x: list[np.float32] = field(default_factory=lambda: [f(0), f(0)])
    flags: int = 0
    held_q: np.float32 = field(default_factory=lambda: f(0))
    cut_node: int | None = None
    U_slow: np.float32 = field(default_factory=lambda: f(0))
    power: np.float32 = field(default_factory=lambda: f(0))
    places: tuple[tuple[int, np.float32], tuple[int, np.float32]] = ((0, f(0)), (0, f(0)))

    def __getitem__(self, name: str) -> np.float32:
        return f(self.values[name])

    def limit_current(self, i: Vector) -> Vector:
        limit = self["motor.I_max_apk"]
        square = limit * limit
        if i[0] * i[0] + i[1] * i[1] <= square:
            return i
        self.flags |= 4
        i_d = clamp(i[0], -limit, limit)
        rest = square - i_d * i_d
        i_q = np.sqrt(rest) if rest > 0 else f(0)
        return i_d, (-i_q if i[1] < 0 else i_q)

    def find(self, axis: np.ndarray, x: np.float32) -> tuple[int, np.float32]:
        if len(axis) < 2 or x <= axis[0]:
            self.flags |= 8 if len(axis) > 1 and x < axis[0] else 0
            return 0, f(0)
        if x >= axis[-1]:
            self.flags |= 8 if x > axis[-1] else 0
            return len(axis) - 2, f(1)
        k = int(np.searchsorted(axis, x, side="right")) - 1
        return k, (x - axis[k]) / (axis[k + 1] - axis[k])

    def link_ahead(self, U_dc: np.float32) -> np.float32:
        """Link voltage that a falling link is going to have."""
        weight = min(f(self.values["inverter.T_s_ns"]) * f(1e-9) * f(500), f(1))
        self.U_slow = self.U_slow + weight * (U_dc - self.U_slow) if self.U_slow > 0 else U_dc
        fall = U_dc - self.U_slow
        return U_dc + fall if fall < 0 and U_dc > -fall else U_dc

    def equivalent_rpm(self, rpm: np.float32, U_dc: np.float32) -> np.float32:
        if len(self.axes[2]) > 1 or U_dc == self.axes[2][0]:
            return rpm
        braking = -self.held_q if rpm < 0 else self.held_q
        drop = self["motor.R_s_ohm"] * braking / self["inverter.voltage_utilisation"]
        left, left_table = U_dc - drop, self.axes[2][0] - drop
        ratio = left_table / left if left * f(1e3) > left_table else f(1e3)
        return rpm * ratio if left_table > 0 else rpm

    def second_coordinate(self, omega_M: np.float32, omega_e: np.float32, U_dc: np.float32) -> np.float32:
        if int(self.values["lut.axis_kind"]) == 0:
            return self.equivalent_rpm(omega_M * RPM, U_dc)
        V_max = self["inverter.voltage_utilisation"] * U_dc
        top = self.axes[1][-1]
        V_m = (f(1.0) - self["field_weakening.margin"]) * V_max
        omega = abs(omega_e)
        return top if omega * top <= V_m else V_m / omega

    def node(self, k: int) -> Node:
        """One node of the torque axis at the speed and link that are placed."""
        y, z = self.places
        total, weight, hole = [f(0), f(0)], f(0), False
        for right_z in (0, 1) if z[1] > 0 else (0,):
            for right_y in (0, 1):
                w = (y[1] if right_y else f(1) - y[1]) * (z[1] if right_z else f(1) - z[1])
                if w == 0:
                    continue
                corner = [table[k, y[0] + right_y, z[0] + right_z] for table in self.tables]
                if np.isnan(corner).any():
                    hole = True
                    continue
                total = [t + w * c for t, c in zip(total, corner, strict=True)]
                weight = weight + w
        if hole and weight > 0:
            total = [t / weight for t in total]
        return Node((total[0], total[1]), weight, hole)

    def within(self, node: Node) -> bool:
        return bool(node.weight > 0 and node.i[0] * node.i[0] + node.i[1] * node.i[1] <= self.power)

    def way_out(self, inside: Vector, outside: Node) -> Vector:
        """Where the way between two points leaves the circle of the limit."""
        if not outside.weight > 0:
            return inside
        way = outside.i[0] - inside[0], outside.i[1] - inside[1]
        a, b = way[0] * way[0] + way[1] * way[1], inside[0] * way[0] + inside[1] * way[1]
        c = (inside[0] * inside[0] + inside[1] * inside[1]) - self.power
        root = np.sqrt(b * b - a * c)
        share = -c / (b + root) if b > 0 else (root - b) / a if a > 0 else f(0)
        return inside[0] + share * way[0], inside[1] + share * way[1]

    def on_way(self, k: int, x: np.float32) -> bool:
        axis = self.axes[0]
        return bool(0 <= k < len(axis) and axis[k] * x >= 0 and abs(axis[k]) <= abs(x))

    def cut_as_before(self, x: np.float32) -> Vector | None:
        """Where the torque was cut in the last period, or one node beside it."""
        low, step = self.cut_node, -1 if x < 0 else 1
        if low is None or not self.on_way(low, x) or not self.on_way(low + step, x):
            return None
        first = self.node(low)
        if not self.within(first):
            if self.axes[0][low] == 0 and first.weight > 0:
                return first.i
            low, beyond = low - step, first
            if not self.on_way(low, x):
                return None
            first = self.node(low)
        else:
            beyond = self.node(low + step)
            if self.within(beyond):
                low, first = low + step, beyond
                if not self.on_way(low + step, x):
                    return None
                beyond = self.node(low + step)
        if not self.within(first) or self.within(beyond):
            return None
        self.cut_node = low
        return self.way_out(first.i, beyond)

    def cut(self, x: np.float32, k: int, near: Node, far: Node) -> Vector:
        axis, low, high, inside, outside = self.axes[0], k, k + (-1 if x < 0 else 1), near, far
        if not self.within(near):
            outside, high, low, known = near, k, len(axis) - 1 if x < 0 else 0, False
            while abs(high - low) > 1:
                middle = (low + high) // 2
                if axis[middle] * x <= 0:
                    low = middle
                elif self.within(node := self.node(middle)):
                    low, inside, known = middle, node, True
                else:
                    high, outside = middle, node
            if not known and low != high:
                inside = self.node(low)
        if axis[low] * x < 0:
            share = axis[low] / (axis[low] - axis[high])
            i = (
                inside.i[0] + share * (outside.i[0] - inside.i[0]),
                inside.i[1] + share * (outside.i[1] - inside.i[1]),
            )
            inside = Node(i, inside.weight, inside.hole)
        self.cut_node = low
        if not inside.weight > 0:
            return self["field_weakening.i_d_min_a"], inside.i[1]
        return self.way_out(inside.i, outside) if self.within(inside) else inside.i

    def lookup(self, tau: np.float32, omega_M: np.float32, omega_e: np.float32, U_dc: np.float32) -> Vector:
        """Currents of a torque, cut where they exceed the limit."""
        U_dc = self.link_ahead(U_dc)
        y = self.second_coordinate(omega_M, omega_e, U_dc)
        sign = f(1)
        if omega_M < 0 and self.axes[1][0] >= 0:
            sign, y = f(-1), abs(y)
        if self.axes[0][0] >= 0:
            sign = f(-1) if tau < 0 else f(1)
        self.places = self.find(self.axes[1], y), self.find(self.axes[2], U_dc)
        self.power = self["motor.I_max_apk"] * self["motor.I_max_apk"]
        axis, x = self.axes[0], sign * tau
        i = self.cut_as_before(x)
        if i is not None:
            self.flags |= 4 | (8 if x < axis[0] or x > axis[-1] else 0)
            return i[0], sign * i[1]
        k, weight = self.find(axis, x)
        left, right = self.node(k), self.node(k + 1)
        flags = self.flags | 4
        i = self.between(left, right, weight)
        self.cut_node = None
        if i[0] * i[0] + i[1] * i[1] > self.power:
            i = self.cut(x, k + 1, right, left) if x < 0 else self.cut(x, k, left, right)
            self.flags = flags
        return i[0], sign * i[1]

    def between(self, left: Node, right: Node, weight: np.float32) -> Vector:
        a, b = f(1) - weight, weight
        if (left.hole and a > 0) or (right.hole and b > 0):
            self.flags |= 16
            a, b = a * left.weight, b * right.weight
            if not a + b > 0:
                return self["field_weakening.i_d_min_a"], f(0)
            scale = f(1) / (a + b)
            a, b = a * scale, b * scale
        return a * left.i[0] + b * right.i[0], a * left.i[1] + b * right.i[1]

    def torque_to_current(self, tau: np.float32, omega_M: np.float32, omega_e: np.float32, U_dc: np.float32) -> Vector:
        i = self.lookup(tau, omega_M, omega_e, U_dc)
        if i[0] < self["field_weakening.i_d_min_a"]:
            self.flags |= 4
            i = self["field_weakening.i_d_min_a"], i[1]
        return self.limit_current(i)

    def demand(self, e: Vector, i: Vector, omega: np.float32) -> Vector:
        options = int(self.values["current.options"])
        rotation_d, psi = f(0), f(0)
        if options & 1:
            rotation_d = -(omega * self["motor.L_q_app_h"]) * i[1]
            psi = self["motor.L_d_app_h"] * i[0]
        if options & 2:
            psi = psi + self["motor.psi_f_wb"]
        u_d = self["current.K_p_d_v_per_a"] * e[0] + self.x[0] + rotation_d + f(0)
        u_q = self["current.K_p_q_v_per_a"] * e[1] + self.x[1] + omega * psi + f(0)
        return u_d, u_q

    def limit_voltage(self, u: Vector, V_max: np.float32) -> Vector:
        square = u[0] * u[0] + u[1] * u[1]
        limit = V_max * V_max
        if int(self.values["current.options"]) & 8 or square <= limit:
            return u
        self.flags |= 1 if square > f(1.00002) * limit else 0
        scale = V_max / np.sqrt(square)
        return u[0] * scale, u[1] * scale

    def duties(self, ab: Vector, U_dc: np.float32) -> tuple[list[np.float32], bool]:
        legs = clarke_inverse(ab)
        middle = f(0.5) * (max(legs) + min(legs))
        inverse = f(1.0) / U_dc
        raw = [f(0.5) + (leg - middle) * inverse for leg in legs]
        return [clamp(d, f(0), f(1)) for d in raw], any(d > 1 or d < 0 for d in raw)

    def integrate(self, reference: Vector, i: Vector, u: Vector, realised: Vector) -> None:
        T_s = f(self.values["inverter.T_s_ns"]) * f(1e-9)
        for k, axis in enumerate("dq"):
            K_p, K_i = self[f"current.K_p_{axis}_v_per_a"], self[f"current.K_i_{axis}_v_per_as"]
            cut = realised[k] - u[k] if int(self.values["current.options"]) & 4 else f(0)
            target = reference[k] + cut / K_p if cut != 0 else reference[k]
            self.x[k] = self.x[k] + T_s * K_i * (target - i[k])

    def step(
        self,
        phases: Vector | tuple,
        theta: np.float32,
        omega: np.float32,
        U_dc: np.float32,
        reference: Vector | None = None,
        tau: np.float32 | None = None,
    ) -> tuple[list[np.float32], Vector, Vector]:
        """Return duties, demanded and realised dq voltage of one period."""
        self.flags = 0
        T_s = f(self.values["inverter.T_s_ns"]) * f(1e-9)
        s, c = sincos(theta)
        s_out, c_out = sincos(theta + self["inverter.delay_periods"] * T_s * omega)
        i = park(clarke(*phases), s, c)
        if tau is not None:
            reference = self.torque_to_current(tau, omega / f(self.values["motor.pole_pairs"]), omega, U_dc)
        else:
            assert reference is not None
            reference = self.limit_current(reference)
        e = reference[0] - i[0], reference[1] - i[1]
        u = self.demand(e, i, omega)
        realised = self.limit_voltage(u, self["inverter.voltage_utilisation"] * U_dc)
        duties, clipped = self.duties(park_inverse(realised, s_out, c_out), U_dc)
        if clipped:
            self.flags |= 2 | (int(self.values["current.options"]) & 8 and 1)
            realised = park(clarke(*(U_dc * d for d in duties)), s_out, c_out)
        self.integrate(reference, i, u, realised)
        self.held_q = reference[1]
        return duties, u, realised
