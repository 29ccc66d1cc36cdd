# SPDX-License-Identifier: MIT
"""What the noise of an encoder makes of the estimated speed, and so of the torque that a speed loop asks for."""

from __future__ import annotations

import math

from pmsmtool.machine.machine_file import MachineFile

TORQUE_SHARE = 0.1
"""Largest standard deviation of the torque that the noise makes a speed loop ask for, of the largest torque."""


def speed_noise(machine: MachineFile, pll_rad_s: float, filter_hz: float) -> float:
    """Return the standard deviation of the filtered speed (rad/s, mechanical) by the encoder noise that was identified.

    White noise n of the position, sampled every T_s, through a loop with both poles at a and a filter at b gives the
    variance n^2 T_s a^3/4 (b/(a + b))^2: the integral of w^2 a^4 b^2/((w^2 + a^2)^2 (w^2 + b^2)) over all frequencies.
    """
    noise = machine.conditions.get("encoder_noise_rad")
    if not isinstance(noise, float):
        return 0.0
    a, b = pll_rad_s, 2.0 * math.pi * filter_hz
    return noise * math.sqrt(machine.inverter.T_s * a**3 / 4.0) * b / (a + b)


def quieter(machine: MachineFile, noise_nm: float, tau_max_nm: float) -> tuple[float, str]:
    """Return the share of a speed loop's gain that keeps the torque's noise (N m) within bounds, and why it is less."""
    if noise_nm <= TORQUE_SHARE * tau_max_nm:
        return 1.0, ""
    share = TORQUE_SHARE * tau_max_nm / noise_nm
    noise_deg = math.degrees(float(machine.conditions["encoder_noise_rad"]))
    return share, (
        f"the speed loop is {1.0 / share:.3g} times slower than its phase margin allows: the encoder's noise of "
        f"{noise_deg:.2g} deg would make it ask for {100.0 * noise_nm / tau_max_nm:.3g} % of the largest torque (rms)"
    )
