# SPDX-License-Identifier: MIT
"""A bench supply that feeds one simulated drive: voltage and current as a person reads them off its display.

The power is what machine and inverter take at standstill: copper, the devices' drops and slopes (switch and diode carry
each phase current half of the time near zero voltage), switching loss in proportion to the current, and what the drive
takes by itself. The display rounds, and its gains are off by a fixed part within its class.
"""

from __future__ import annotations

import numpy as np

from pmsmtool.sim.drive_kernel import KernelCore
from pmsmtool.sim.kernel import Truth

IDLE_W = 4.0
"""Power of the drive without a motor current."""
SWITCHING_S = 1e-7
"""Time by whose share of the control period a phase current loads the link: switching loss."""
GAIN = 0.003
"""Largest error of either display's gain."""
CURRENT_DIGIT_A = 1e-3
VOLTAGE_DIGITS = ((100.0, 0.01), (np.inf, 0.1))
"""Last digit (V) up to a voltage (V)."""


class BenchSupply:
    """One supply."""

    def __init__(self, core: KernelCore, seed: int) -> None:
        self._simulation = core.simulation
        self._period_s = 1e-9 * core.period_ns
        self._rng = np.random.default_rng([20260103, seed])
        self._gains = 1.0 + GAIN * self._rng.uniform(-1.0, 1.0, 2)

    def power_w(self) -> float:
        """Return what drive and machine take now (W)."""
        machine, inverter = self._simulation.setup.machine, self._simulation.setup.inverter
        signal = self._simulation.signal
        rise = signal(Truth.T_WINDING) - machine.T_ref
        R = machine.R_copper * (1.0 + machine.alpha_R * rise) + machine.R_fixed
        two_kinds = inverter.V_switch > 0.0  # else the channel conducts both ways, and diodes in the dead time only
        R += 0.5 * (inverter.r_switch + inverter.r_diode) if two_kinds else inverter.r_switch
        drop = 0.5 * (inverter.V_switch + inverter.V_diode) if two_kinds else 0.0
        drop += signal(Truth.U_DC) * SWITCHING_S / self._period_s
        currents = [signal(part) for part in (Truth.I_A, Truth.I_B, Truth.I_C)]
        return IDLE_W + sum(float(R * i * i + drop * abs(i)) for i in currents)

    def read(self) -> tuple[float, float]:
        """Return voltage (V) and current (A) as they are shown."""
        volts = self._simulation.signal(Truth.U_DC)
        amps = self.power_w() / volts
        digit = next(step for limit, step in VOLTAGE_DIGITS if volts < limit)
        shown = self._gains * (volts, amps) + self._rng.uniform(-0.5, 0.5, 2) * (digit, CURRENT_DIGIT_A)
        return round(shown[0] / digit) * digit, round(shown[1] / CURRENT_DIGIT_A) * CURRENT_DIGIT_A
