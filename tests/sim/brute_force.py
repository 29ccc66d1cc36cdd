# SPDX-License-Identifier: MIT
"""A switch-level inverter on a locked linear machine, written a second time: explicit steps of a few nanoseconds.

Nothing is shared with the kernel: gate signals come from comparing the duty ratio with a carrier, dead time from a
counter per leg, every device is a voltage that depends on the current (its sign smoothed over 0.1 mA), the node of a
leg in its dead time is a capacitor with two diodes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass
class Circuit:
    R: float
    L_d: float
    L_q: float
    U_dc: float
    T_s: float
    dead_time: tuple[float, float, float]
    V_switch: float
    r_switch: float
    V_diode: float
    r_diode: float
    capacitance: float
    dt: float = 4e-9

    def run(self, duties: np.ndarray, i_start: complex = 0j) -> np.ndarray:
        """Return i_alpha + j i_beta at the start of each period and the end; duties has shape (periods, 3)."""
        steps = round(self.T_s / self.dt)
        dt = self.T_s / steps
        i_a, i_b = i_start.real, i_start.imag
        gate = [-1, -1, -1]  # -1 bottom, 1 top, 0 none
        level = [-1, -1, -1]
        timer = [0.0, 0.0, 0.0]
        node = [0.0, 0.0, 0.0]
        out = [complex(i_a, i_b)]
        half_sqrt3 = 0.5 * math.sqrt(3.0)
        for duty in duties:
            for k in range(steps):
                carrier = abs(1.0 - 2.0 * (k + 0.5) / steps)  # 1 at the period's ends, 0 in its middle
                currents = (i_a, -0.5 * i_a + half_sqrt3 * i_b, -0.5 * i_a - half_sqrt3 * i_b)
                v = [0.0, 0.0, 0.0]
                for x in range(3):
                    wanted = 1 if duty[x] > carrier else -1
                    if wanted != level[x]:
                        level[x], gate[x], timer[x] = wanted, 0, self.dead_time[x]
                    if gate[x] == 0:
                        timer[x] -= dt
                        if timer[x] <= 0.0:
                            gate[x] = level[x]
                    v[x] = self._leg(gate[x], currents[x], node, x, dt)
                u_a = (2.0 * v[0] - v[1] - v[2]) / 3.0
                u_b = (v[1] - v[2]) / math.sqrt(3.0)
                i_a += dt / self.L_d * (u_a - self.R * i_a)
                i_b += dt / self.L_q * (u_b - self.R * i_b)
            out.append(complex(i_a, i_b))
        return np.array(out)

    def _leg(self, gate: int, i: float, node: list[float], x: int, dt: float) -> float:
        out = 0.5 * (1.0 + math.tanh(i / 1e-4))  # share of "current flows out of the leg"
        if gate == 0:
            low, high = -self.V_diode - self.r_diode * i, self.U_dc + self.V_diode - self.r_diode * i
            node[x] = min(max(node[x] - i * dt / self.capacitance, low), high)
            return node[x]
        top = gate == 1
        rail = self.U_dc if top else 0.0
        V_out, r_out = (self.V_switch, self.r_switch) if top else (self.V_diode, self.r_diode)
        V_in, r_in = (self.V_diode, self.r_diode) if top else (self.V_switch, self.r_switch)
        node[x] = rail - out * (V_out + r_out * i) + (1.0 - out) * (V_in - r_in * i)
        return node[x]
