# SPDX-License-Identifier: MIT
"""A second hand at the field weakening by optimisation: one period from any memory, in numpy binary32.

Written from (33) and (42)-(48) of Jercic et al. 2017 and from Beck and Teboulle's FISTA in the core's order of
operations, so that every member of the memory can be compared bit for bit. Test code only.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tests.firmware.core_twin import Twin, Vector, clamp, f
from tests.firmware.projection_twin import (
    BUDGET,
    HALF,
    ONE,
    TWO,
    ZERO,
    Row,
    Steps,
    find_corner,
    project_pair,
    project_row_from,
    project_rows,
    smallest_voltage,
    square,
)

GRADIENT, ACCELERATED, UNCOMPENSATED = 2, 3, 4
NONE, KNOWN, DOUBTED = 0, 1, 2
"""What is known of the corner of both rows."""
FLAG_EMPTY = 128
WITHIN, STEP_END, EVENT, IGNORED = f(1.000002), f(2e-5), f(0.02), f(1e-3)
MOST, FALLING, LEFT, ITERATION = 14, 12, 3, 3
"""Newton steps: of a period, of one whose link falls, too few to go on with, of an iteration besides its projection."""


@dataclass
class WeakeningTwin(Twin):
    """The members are those of ``pmsm_state`` and are set before a period."""

    reference: Vector = (ZERO, ZERO)
    ahead: Vector = (ZERO, ZERO)
    momentum: np.float32 = ONE
    multiplier: np.float32 = ZERO
    tau: np.float32 = ZERO
    U: np.float32 = ZERO
    count: int = 0
    left: int = 0
    known: int = NONE
    empty: bool = False
    asked: np.float32 = ZERO
    corner: Vector = (ZERO, ZERO)
    rows: list[Row] = field(default_factory=list)
    steps: Steps = field(default_factory=Steps)

    @property
    def mode(self) -> int:
        return int(self.values["field_weakening.mode"])

    def hold(self, i: Vector, omega: np.float32) -> Vector:
        """What the current controller gives without an error."""
        options, rotation, psi = int(self.values["current.options"]), ZERO, ZERO
        if options & 1:
            rotation, psi = -(omega * self["motor.L_q_app_h"]) * i[1], self["motor.L_d_app_h"] * i[0]
        psi = psi + self["motor.psi_f_wb"] if options & 2 else psi
        return self.x[0] + rotation, self.x[1] + omega * psi

    def state_problem(self, i: Vector, omega: np.float32, ahead: np.float32) -> None:
        R = self["motor.R_s_ohm"] if self.mode == ACCELERATED else ZERO
        X_d, X_q = omega * self["motor.L_d_app_h"], -omega * self["motor.L_q_app_h"]
        V = (ONE - self["field_weakening.margin"]) * (self["inverter.voltage_utilisation"] * ahead)
        c = ZERO, omega * self["motor.psi_f_wb"]
        if self.mode != UNCOMPENSATED:
            hold = self.hold(i, omega)
            c = hold[0] - (R * i[0] + X_q * i[1]), hold[1] - (X_d * i[0] + R * i[1])
        limit = self["motor.I_max_apk"]
        self.rows = [Row(ONE, ZERO, ZERO, ONE, (ZERO, ZERO), limit)]
        if (abs(X_d) + abs(X_q)) * limit > IGNORED * V:
            self.rows.append(Row(R, X_q, X_d, R, c, V))
        self.corner = self.reference

    @staticmethod
    def is_within(row: Row, x: Vector) -> bool:
        return bool(square(row.voltage(x)) <= WITHIN * row.V * row.V)

    def on_circle(self, x: Vector) -> Vector:
        scale = self.rows[0].V / np.sqrt(square(x))
        return scale * x[0], scale * x[1]

    def nearest(self, y: Vector) -> Vector:
        """From what the last projection knew."""
        circle, ellipse = self.rows[0], self.rows[-1]
        x = y if square(y) <= circle.V * circle.V else self.on_circle(y)
        if len(self.rows) < 2 or self.is_within(ellipse, x):
            self.empty = False
            return x
        doubted, smallest = self.known == DOUBTED or self.empty, (ZERO, ZERO)
        self.empty = False
        if doubted:
            smallest = smallest_voltage(ellipse, circle, self.steps)
            self.empty = self.steps.count < BUDGET and not self.is_within(ellipse, smallest)
        if self.empty:
            return smallest
        if self.known == KNOWN:
            corner, found = find_corner(circle, ellipse, y, self.corner, 4, self.steps)
            if found:
                self.corner = corner
                return corner
            self.known = DOUBTED
        alone, self.multiplier = project_row_from(ellipse, y, self.multiplier, BUDGET, self.steps)
        if self.is_within(circle, alone):
            self.known = NONE
            return alone
        start = self.on_circle(alone)
        if doubted:
            pair, found = project_pair(circle, ellipse, y, start, smallest, self.steps)
            corner = start if pair is None else pair
        else:
            corner, found = find_corner(circle, ellipse, y, start, 4, self.steps)
        self.known = KNOWN if found or doubted else DOUBTED
        self.corner = corner
        self.steps.count = self.steps.count if found else BUDGET
        return corner

    def nearest_anew(self, y: Vector) -> Vector:
        steps, more = Steps(), Steps()
        found = project_rows(self.rows, y, None, steps)
        self.empty = found is None
        x = smallest_voltage(self.rows[1], self.rows[0], more) if found is None else found[0]
        self.steps.count += steps.count + more.count
        return x

    def project(self, y: Vector) -> Vector:
        x = self.nearest(y) if self.mode == ACCELERATED else self.nearest_anew(y)
        i_d_lm = self["field_weakening.i_d_lm_a"]
        for beyond, d in (
            (x[0] > max(i_d_lm, ZERO), max(i_d_lm, ZERO)),
            (x[0] < self["field_weakening.i_d_min_a"], self["field_weakening.i_d_min_a"]),
        ):
            if beyond:
                return d, self.on_line(d, y[1])
        return x

    def on_line(self, d: np.float32, i_q: np.float32) -> np.float32:
        """The i_q nearest to one at a given i_d inside both rows."""
        rest = self.rows[0].V * self.rows[0].V - d * d
        reach = np.sqrt(rest) if rest > 0 else ZERO
        low, high = -reach, reach
        if len(self.rows) > 1:
            row = self.rows[1]
            a = row.voltage((d, ZERO))
            A, B = row.dq * row.dq + row.qq * row.qq, a[0] * row.dq + a[1] * row.qq
            D = B * B - A * (square(a) - row.V * row.V)
            if D < 0:
                self.empty, low = True, clamp(-B / A, low, high)
                high = low
            else:
                ends = (-B - np.sqrt(D)) / A, (-B + np.sqrt(D)) / A
                self.empty = self.empty or bool(ends[1] < low or ends[0] > high)
                low, high = clamp(ends[0], low, high), clamp(ends[1], low, high)
        return clamp(i_q, low, high)

    def torque(self, x: Vector) -> tuple[np.float32, np.float32, np.float32]:
        """What is missing of the asked one, and its derivatives to i_q and, over i_q, to i_d."""
        per_flux = f(1.5) * f(self.values["motor.pole_pairs"])
        k_t = per_flux * self["motor.psi_f_wb"]
        k_s = per_flux * (self["motor.L_d_app_h"] - self["motor.L_q_app_h"])
        slope = k_t + k_s * x[0]
        return self.asked - slope * x[1], slope, k_s

    def gradient(self, x: Vector) -> Vector:
        e, slope, k_s = self.torque(x)
        h1, h2, off = self["field_weakening.h1"], self["field_weakening.h2"], x[0] - self["field_weakening.i_d_lm_a"]
        return TWO * (h2 * off - h1 * e * k_s * x[1]), -TWO * h1 * e * slope

    def cost(self, x: Vector) -> np.float32:
        e, off = self.torque(x)[0], x[0] - self["field_weakening.i_d_lm_a"]
        return self["field_weakening.h1"] * e * e + self["field_weakening.h2"] * off * off

    def gradient_steps(self) -> None:
        x = self.project(self.reference)
        for _ in range(int(self.values["field_weakening.iterations"])):
            if self.empty:
                break
            g, now, beta, z = self.gradient(x), self.cost(x), self["field_weakening.beta"], x
            for _ in range(8):
                z = self.project((x[0] - beta * g[0], x[1] - beta * g[1]))
                decrease = self["field_weakening.sigma"] * (g[0] * (x[0] - z[0]) + g[1] * (x[1] - z[1]))
                if self.cost(z) <= now - decrease:
                    break
                beta = beta * HALF
            self.steps.count += 1
            change = abs(z[0] - x[0]) + abs(z[1] - x[1])
            x = z
            if change < STEP_END:
                break
        self.reference = x

    def accelerated_steps(self) -> None:
        t, x, y = self.momentum, self.reference, self.ahead
        h1, h2 = self["field_weakening.h1"], self["field_weakening.h2"]
        while self.left > 0 and self.steps.count < BUDGET - LEFT:
            e, slope, k_s = self.torque(y)
            side = k_s * y[1]
            curvature = f(2.1) * h1 * (slope * slope + side * side + abs(k_s * e)) + TWO * h2
            if curvature <= 0:
                self.left = 0
                break
            step, g = ONE / curvature, self.gradient(y)
            self.steps.count += ITERATION
            z = self.project((y[0] - step * g[0], y[1] - step * g[1]))
            self.left -= 1
            if self.steps.count >= BUDGET and not self.empty:
                break
            if (y[0] - z[0]) * (z[0] - x[0]) + (y[1] - z[1]) * (z[1] - x[1]) > 0:
                t = ONE
            following = HALF * (ONE + np.sqrt(ONE + f(4) * t * t))
            share = (t - ONE) / following
            change = abs(z[0] - x[0]) + abs(z[1] - x[1])
            y = z[0] + share * (z[0] - x[0]), z[1] + share * (z[1] - x[1])
            x, t = z, following
            self.left = 0 if change < STEP_END or self.empty else self.left
        self.momentum, self.reference, self.ahead = t, x, y

    def period(self, tau: np.float32, i: Vector, omega: np.float32, U_dc: np.float32) -> Vector:
        """The current request of a torque; ``steps`` holds what it took."""
        self.flags, self.steps, self.asked = 0, Steps(), tau
        ahead = self.link_ahead(U_dc)
        rated = f(1.5) * f(self.values["motor.pole_pairs"]) * self["motor.psi_f_wb"] * self["motor.I_nom_apk"]
        event = abs(tau - self.tau) > EVENT * rated or abs(ahead - self.U) > EVENT * self.U
        if self.count == 0 or (event and self.mode == ACCELERATED):
            self.count, self.left = (int(self.values[f"field_weakening.{key}"]) for key in ("N_fw", "iterations"))
            self.tau, self.U, self.momentum, self.ahead = tau, ahead, ONE, self.reference
        if self.left > 0:
            self.state_problem(i, omega, ahead)
            if self.mode == ACCELERATED:
                before = BUDGET - (FALLING if ahead < f(0.99) * U_dc else MOST)
                self.steps.count = before
                self.accelerated_steps()
                self.steps.count -= before
            else:
                self.gradient_steps()
                self.left = 0
        self.count -= 1
        self.flags |= FLAG_EMPTY if self.empty else 0
        asked = self.reference
        if asked[0] < self["field_weakening.i_d_min_a"]:
            self.flags |= 4
            asked = self["field_weakening.i_d_min_a"], asked[1]
        return self.limit_current(asked)
