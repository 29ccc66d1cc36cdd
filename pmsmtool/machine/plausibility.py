# SPDX-License-Identifier: MIT
"""Values of a machine that are possible but look like another unit."""

from __future__ import annotations

from pmsmtool.machine.parameters import InverterParameters, MachineParameters
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.units import RAD_S_PER_RPM, format_quantity

RUN_UP_S = (3e-4, 60.0)
"""Time (s) to rated speed at rated torque of rotors and loads in use."""
LARGEST_OWN_FLUX = 10.0
"""Flux that the rated current makes, of the magnet's: some times of it where reluctance gives most of the torque."""


def implausible(machine: MachineParameters, inverter: InverterParameters) -> list[str]:
    """Return a sentence for each value that is likely in a wrong unit."""
    found: list[str] = []
    tau_e = min(machine.L_d_h, machine.L_q_h) / machine.R_s_ohm
    if not 5e-5 <= tau_e <= 1.0:
        found.append(f"L/R = {format_quantity(tau_e, 's')} is unusual for a machine (50 us to 1 s): check the units")
    if machine.n_nom_rpm is not None:
        emf = machine.psi_f_wb * machine.pole_pairs * machine.n_nom_rpm * RAD_S_PER_RPM
        if emf > inverter.V_max_v:
            found.append(
                f"the back-EMF at rated speed is {emf:.4g} V peak, above the {inverter.V_max_v:.4g} V "
                f"that {inverter.U_dc_v:g} V DC give"
            )
    if not 0.3 <= machine.L_q_h / machine.L_d_h <= 10.0:
        found.append(f"L_q/L_d = {machine.L_q_h / machine.L_d_h:.3g} is unusual: check the axes")
    if machine.I_nom_apk is None or not machine.psi_f_wb > 0.0:
        return found
    own = machine.I_nom_apk * max(machine.L_d_h, machine.L_q_h) / machine.psi_f_wb
    if own > LARGEST_OWN_FLUX:
        found.append(f"L at the rated current makes {own:.3g} times the magnet's flux: check the units of L and K_e")
    drop = machine.R_s_ohm * machine.I_nom_apk
    if drop > inverter.V_max_v:
        found.append(f"R takes {drop:.4g} V at the rated current, of {inverter.V_max_v:.4g} V: check R and the DC link")
    if machine.J_kgm2 is not None and machine.n_nom_rpm is not None:
        torque = torque_per_ampere(machine.pole_pairs, machine.psi_f_wb) * machine.I_nom_apk
        run_up = machine.J_kgm2 * machine.n_nom_rpm * RAD_S_PER_RPM / torque
        if not RUN_UP_S[0] <= run_up <= RUN_UP_S[1]:
            found.append(
                f"J = {machine.J_kgm2:.3g} kg m2 comes to rated speed in {format_quantity(run_up, 's')}, unusual "
                f"({format_quantity(RUN_UP_S[0], 's')} to {RUN_UP_S[1]:g} s): check its unit, g cm2 or kg cm2"
            )
    return found
