# SPDX-License-Identifier: MIT
"""The ``[simulation]`` table of a machine file made from a datasheet: what a rehearsal needs and no datasheet says."""

from __future__ import annotations

from pmsmtool.machine.key import Value
from pmsmtool.machine.parameters import MachineParameters
from pmsmtool.machine.simulation_keys import FULL_SCALE_SHARE, PEAK_SHARE
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.units import format_quantity

NOISE_SHARE = 5e-4
"""Standard deviation of a phase current sample, of full scale; that of the shipped profiles."""
ENCODER_BITS = 17
FRICTION_SHARE = 0.02
"""Coulomb friction of the rated torque; the shipped profiles have 0.5 to 3 %."""
ACCELERATION_RAD_S2 = 5000.0
"""Of the rotor under rated torque where no inertia is stated; servo motors have 3000 to 30000."""


def simulation_of(machine: MachineParameters, encoder_bits: int | None) -> tuple[dict[str, Value], list[str]]:
    """Return the table, and one line per value that is assumed.

    Parameters
    ----------
    machine : MachineParameters
        As the datasheet says it; its own values are the simulated machine's where the table has none.
    encoder_bits : int or None
        Resolution per turn.
    """
    table: dict[str, Value] = {"encoder_bits": ENCODER_BITS if encoder_bits is None else encoder_bits}
    assumed = [] if encoder_bits is not None else [f"encoder of {ENCODER_BITS} bits per turn"]
    rated = machine.I_nom_apk or (machine.I_max_apk or 0.0) / PEAK_SHARE
    if not rated:
        return {**table, "adc_bits": 0}, [*assumed, "no rated current is given: no current measurement is modelled"]
    full_scale = FULL_SCALE_SHARE * (machine.I_max_apk or PEAK_SHARE * rated)
    table |= {"adc_full_scale_apk": full_scale, "sensor_noise_apk": NOISE_SHARE * full_scale}
    assumed.append(f"current measurement to {format_quantity(full_scale, 'A', 3)} peak, noise {NOISE_SHARE:g} of it")
    torque = torque_per_ampere(machine.pole_pairs, machine.psi_f_wb) * rated
    table["tau_c_nm"] = FRICTION_SHARE * torque
    assumed.append(f"Coulomb friction {100.0 * FRICTION_SHARE:g} % of the rated torque")
    if machine.J_kgm2 is None:
        table["J_kgm2"] = torque / ACCELERATION_RAD_S2
        assumed.append(f"inertia: {ACCELERATION_RAD_S2:g} rad/s2 under rated torque (none is given)")
    return table, assumed
