# SPDX-License-Identifier: MIT
"""The core around a linear machine, period by period. Test code only."""

from __future__ import annotations

import cmath
import ctypes
import math
from typing import Any

import numpy as np

from pmsmtool.firmware.core_binding import CoreBinding
from pmsmtool.params.catalogue import CATALOGUE
from tests.firmware.linear_plant import LinearPlant

DEFAULTS = {row.name: row.default for row in CATALOGUE}
MODE_VOLTAGE, MODE_CURRENT, MODE_TORQUE, MODE_SPEED = 1, 2, 3, 4
FLAG_VOLTAGE, FLAG_DUTY, FLAG_CURRENT, FLAG_EDGE, FLAG_NO_POINT, FLAG_I2T = 1, 2, 4, 8, 16, 256
FLAG_ACTIVE, FLAG_FALLBACK, FLAG_FW_EMPTY = 32, 64, 128
PAPER, LINE, BEST, LINEARISED, OBSERVE = 1, 2, 3, 4, 5
HEXAGON, PREDICTOR, CURRENT_ROW, PRE_PROJECTION, MINIMUM_TIME = 1, 2, 4, 8, 16
RPM = 4 * math.pi / 30
"""Electrical rad/s per rpm of the Table 1 machine."""


def tuned(alpha: float = 2 * math.pi * 400, **changes: float) -> dict[str, float]:
    """Table 1 machine with the gains of the injected controller, K_p = alpha L, K_i = 4 alpha R."""
    values = dict(DEFAULTS)
    for axis in "dq":
        values[f"current.K_p_{axis}_v_per_a"] = alpha * values[f"motor.L_{axis}_h"]
        values[f"current.K_i_{axis}_v_per_as"] = 4 * alpha * values["motor.R_s_ohm"]
    values.update({name.replace("__", "."): value for name, value in changes.items()})
    return values


def reference_case(alpha: float, **changes: float) -> dict[str, float]:
    """Conditions of docs/control.md, 1: V_dc 210 V, pole-zero cancellation, no computation delay."""
    values = tuned(alpha, inverter__delay_periods=0.5, governor__alpha_rad_s=alpha, motor__I_max_time_s=3600.0)
    values |= {f"current.K_i_{axis}_v_per_as": alpha * values["motor.R_s_ohm"] for axis in "dq"}
    values |= {"field_weakening.i_d_min_a": -1000.0, "inverter.voltage_utilisation": 1 / math.sqrt(3)}
    return values | {name.replace("__", "."): value for name, value in changes.items()}


class Loop:
    """The core and a plant; one call of step() is one period."""

    def __init__(
        self, binding: CoreBinding, values: dict[str, float], *, omega: float, U_dc: float = 540.0, lut: bytes = b""
    ) -> None:
        self.binding, self.values, self.U_dc = binding, values, U_dc
        self.params = binding.params(values, lut)
        self.lut = (ctypes.c_uint32 * (len(lut) // 4)).from_buffer_copy(lut) if lut else None
        self.state = binding.state()
        self.output = binding.make("pmsm_output")
        self.measurement = binding.make("pmsm_measurement", T_winding=values["motor.T_ref_c"], U_dc=U_dc)
        self.reference = binding.make("pmsm_reference")
        self.plant = LinearPlant(
            R=values["motor.R_s_ohm"],
            L_d=values["motor.L_d_h"],
            L_q=values["motor.L_q_h"],
            psi=values["motor.psi_f_wb"],
            T_s=1e-9 * values["inverter.T_s_ns"],
            omega=omega,
            delayed=values["inverter.delay_periods"] >= 1,
        )

    def settle_at(self, i_d: float, i_q: float) -> None:
        """Start in the steady state of a current."""
        plant, state, v = self.plant, self.state, self.values
        plant.i = np.array([i_d, i_q], dtype=float)
        lost_d, lost_q = plant.L_d - v["motor.L_d_app_h"], plant.L_q - v["motor.L_q_app_h"]
        state.integrator.d = plant.R * i_d - plant.omega * lost_q * i_q
        state.integrator.q = plant.R * i_q + plant.omega * (lost_d * i_d + plant.psi - v["motor.psi_f_wb"])
        state.disturbance.d = state.integrator.d - v["motor.R_s_ohm"] * i_d
        state.disturbance.q = state.integrator.q - v["motor.R_s_ohm"] * i_q
        u = complex(
            plant.R * i_d - plant.omega * plant.L_q * i_q, plant.R * i_q + plant.omega * (plant.L_d * i_d + plant.psi)
        )
        turn = plant.omega * plant.T_s
        after, before = (u * cmath.exp(1j * (plant.theta + share * turn)) for share in (0.5, -0.5))
        last = after if plant.delayed else before
        state.voltage_committed.d, state.voltage_committed.q = last.real, last.imag
        state.voltage_before.d, state.voltage_before.q = before.real, before.imag
        plant.waiting = np.array([after.real, after.imag])
        for held in (state.reference_held, state.reference_realised, state.current_before, state.fw_reference):
            held.d, held.q = i_d, i_q

    def step(self, **reference: float) -> Any:
        return self.step_with(self.plant.phases(), **reference)

    def step_with(self, phases: tuple[float, float, float], **reference: float) -> Any:
        """One period in which the drive sees these phase currents."""
        m = self.measurement
        m.i_a, m.i_b, m.i_c = phases
        m.theta_e, m.omega_e = self.plant.theta, self.plant.omega
        for name, value in reference.items():
            setattr(self.reference, name, value)
        self.binding.library.pmsm_step(self.state, self.params, self.lut, m, self.reference, self.output)
        d = (self.output.duty_a, self.output.duty_b, self.output.duty_c)
        gates = self.output.gates
        u_alpha = gates * self.U_dc * (2 * d[0] - d[1] - d[2]) / 3
        u_beta = gates * self.U_dc * (d[1] - d[2]) / math.sqrt(3)
        self.plant.advance(u_alpha, u_beta)
        return self.state.live
