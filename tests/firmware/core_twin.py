# SPDX-License-Identifier: MIT
"""A second hand at the control core: PI, limits, modulation and look-up in numpy binary32, one operation at a time.

Written from the equations (``docs/simulation.md``, 1), in the core's order of operations, so that
every result can be compared bit for bit. Test code only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

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


@dataclass
class Twin:
    """Current control of one drive; ``values`` is a catalogue mapping, look-up tables are plain arrays."""

    values: Mapping[str, float]
    axes: tuple[np.ndarray, ...] = ()
    tables: tuple[np.ndarray, ...] = ()
    x: list[np.float32] = field(default_factory=lambda: [f(0), f(0)])
    flags: int = 0
    held_q: np.float32 = field(default_factory=lambda: f(0))

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

    def lookup(self, tau: np.float32, omega_M: np.float32, omega_e: np.float32, U_dc: np.float32) -> Vector:
        y = self.second_coordinate(omega_M, omega_e, U_dc)
        sign = f(1)
        if omega_M < 0 and self.axes[1][0] >= 0:
            sign, y = f(-1), abs(y)
        if self.axes[0][0] >= 0:
            sign = f(-1) if tau < 0 else f(1)
        places = [self.find(axis, v) for axis, v in zip(self.axes, (sign * tau, y, U_dc), strict=True)]
        total, weight, hole = [f(0), f(0)], f(0), False
        for k in range(8):
            right = (k >> 2, (k >> 1) & 1, k & 1)
            if right[2] and len(self.axes[2]) < 2:
                continue
            w = [place[1] if r else f(1) - place[1] for place, r in zip(places, right, strict=True)]
            product = (w[0] * w[1]) * w[2]
            if product == 0:
                continue
            cell = tuple(place[0] + r for place, r in zip(places, right, strict=True))
            corner = [table[cell] for table in self.tables]
            if np.isnan(corner).any():
                hole = True
                continue
            total = [t + product * c for t, c in zip(total, corner, strict=True)]
            weight = weight + product
        self.flags |= 16 if hole else 0
        if weight == 0:
            return self["field_weakening.i_d_min_a"], f(0)
        if hole:
            total = [t / weight for t in total]
        return total[0], sign * total[1]

    def lookup_within_limit(self, tau: np.float32, *rest: np.float32) -> Vector:
        """Cut the torque until the table's current keeps the limit."""
        power = self["motor.I_max_apk"] * self["motor.I_max_apk"]

        def size(i: Vector) -> np.float32:
            return i[0] * i[0] + i[1] * i[1]

        def way_out() -> np.float32:
            way = outside[0] - inside[0], outside[1] - inside[1]
            a, b, c = size(way), inside[0] * way[0] + inside[1] * way[1], size(inside) - power
            root = np.sqrt(b * b - a * c)
            return -c / (b + root) if b > 0 else (root - b) / a

        outside = self.lookup(tau, *rest)
        if size(outside) <= power:
            return outside
        flags = self.flags | 4
        inside, low, high = self.lookup(f(0), *rest), f(0), tau
        if size(inside) < power:
            for _ in range(2):
                middle = low + way_out() * (high - low)
                i = self.lookup(middle, *rest)
                if size(i) < power:
                    inside, low = i, middle
                else:
                    outside, high = i, middle
            share = way_out()
            inside = (inside[0] + share * (outside[0] - inside[0]), inside[1] + share * (outside[1] - inside[1]))
        self.flags = flags
        return inside

    def torque_to_current(self, tau: np.float32, omega_M: np.float32, omega_e: np.float32, U_dc: np.float32) -> Vector:
        i = self.lookup_within_limit(tau, omega_M, omega_e, U_dc)
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
