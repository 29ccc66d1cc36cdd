# SPDX-License-Identifier: MIT
"""What the simulated drive leaves its factory with: ratings of its inverter, and harmless controller gains.

Nothing here tells the tool about the machine: motor data are the catalogue's defaults, except what is written on the
drive's own plate (currents, DC link, timing).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pmsmtool.params.catalogue import BY_NAME
from pmsmtool.sim.node.dictionary import DriveFace
from pmsmtool.sim.node.node import Settings
from pmsmtool.sim.node.parameter_set import ParameterImage
from pmsmtool.sim.node.position_modes import calm_gains
from pmsmtool.sim.simulated_machine import settings_of

if TYPE_CHECKING:
    from pmsmtool.machine.machine_file import MachineFile

GAIN_SHARE = 0.1
"""Proportional gain as a share of U_max / I_max: far below the stability limit of any machine that fits the drive."""
INTEGRAL_RATE_RAD_S = 100.0
TRIP_SHARE = 1.3
"""Trip level as a share of I_max, below the full scale of the current sensors (1.5 I_max)."""
DC_HIGH_SHARE = 1.35
DC_LOW_SHARE = 0.5
OVERSPEED_SHARE = 1.5
SET_UP_BANDWIDTH = 0.05
"""Current bandwidth (rad/s) times control period of a drive that its maker's tool has set up."""


def factory_values(machine_file: MachineFile) -> dict[str, float]:
    """Return the parameters in which the drive differs from the catalogue's defaults (names, SI)."""
    machine, inverter, limits = machine_file.machine, machine_file.inverter, machine_file.limits
    i_max = machine.I_max_apk or machine.I_nom_apk or BY_NAME["motor.I_max_apk"].default
    i_nom = machine.I_nom_apk or i_max / 2.0
    n_max = machine.top_rpm or BY_NAME["motor.n_max_rpm"].default
    gain = GAIN_SHARE * inverter.V_max_v / i_max
    values = {
        "motor.I_max_apk": i_max,
        "motor.I_nom_apk": i_nom,
        "motor.n_max_rpm": n_max,
        "inverter.T_s_ns": round(inverter.T_s * 1e9),
        "inverter.voltage_utilisation": inverter.voltage_utilisation,
        "inverter.dead_time_ns": round(inverter.dead_time_s * 1e9),
        "inverter.delay_periods": inverter.delay_periods,
        "inverter.U_dc_nom_v": inverter.U_dc_v,
        **{f"inverter.{name}": value for name, value in inverter.shunt_values().items()},
        "protection.i_trip_apk": limits.i_trip_apk or TRIP_SHARE * i_max,
        "protection.I_cont_apk": limits.I_cont_apk or i_nom,
        "protection.U_dc_min_v": limits.U_dc_min_v or DC_LOW_SHARE * inverter.U_dc_v,
        "protection.U_dc_max_v": limits.U_dc_max_v or DC_HIGH_SHARE * inverter.U_dc_v,
        "protection.n_trip_rpm": limits.n_trip_rpm or OVERSPEED_SHARE * n_max,
        "governor.I_transient_apk": i_max,
        "field_weakening.i_d_min_a": -i_max,
        "current.K_p_d_v_per_a": gain,
        "current.K_p_q_v_per_a": gain,
        "current.K_i_d_v_per_as": gain * INTEGRAL_RATE_RAD_S,
        "current.K_i_q_v_per_as": gain * INTEGRAL_RATE_RAD_S,
        "current.options": 0b100,  # back-calculation only: decoupling needs machine data nobody has entered yet
    }
    return {name: min(max(value, BY_NAME[name].minimum), BY_NAME[name].maximum) for name, value in values.items()}


def set_up_values(machine_file: MachineFile) -> dict[str, float]:
    """Return what the maker's own set-up tool would have left in a closed drive: it commutates and controls currents.

    From the simulated machine itself: a drive of another family, or without current set-points, cannot be given this
    through its own dictionary.
    """
    truth = settings_of(machine_file)
    number = truth.number
    alpha = SET_UP_BANDWIDTH / machine_file.inverter.T_s
    values = {
        "motor.pole_pairs": number("pole_pairs"),
        "motor.R_s_ohm": number("R_s_ohm"),
        "motor.psi_f_wb": number("psi_f_wb"),
        "encoder.offset_rad": number("encoder_offset_rad"),
        "encoder.reversed": float(truth.flag("encoder_reversed")),
    }
    values |= calm_gains(number("J_kgm2") + number("J_load_kgm2"))
    for axis in "dq":
        inductance = number(f"L_{axis}_h")
        values |= {f"motor.L_{axis}_h": inductance, f"motor.L_{axis}_app_h": inductance}
        values |= {f"current.K_p_{axis}_v_per_a": alpha * inductance}
        values |= {f"current.K_i_{axis}_v_per_as": alpha * number("R_s_ohm")}
    return values


def drive_settings(
    machine_file: MachineFile,
    name: str,
    node_id: int,
    position: int,
    *,
    fixed_node_id: bool = False,
    face: DriveFace | None = None,
) -> Settings:
    """Return the settings of a drive made for a machine file.

    Parameters
    ----------
    name : str
        Profile, part of the device name.
    node_id : int
        Node id while LSS has stored none.
    position : int
        Number of the drive on its line, from 0; counts the serial number up.
    fixed_node_id : bool
        Whether the node id outranks a stored one.
    face : DriveFace, optional
        What the drive shows instead of its own dictionary.
    """
    values = factory_values(machine_file)
    if face is not None:
        values |= set_up_values(machine_file)
    machine = machine_file.machine
    i_nom = values["motor.I_nom_apk"]
    torque = abs(machine.torque_nm(0.0, i_nom)) or 1.0
    serial = int(machine_file.simulation.get("serial", 1)) + position  # type: ignore[arg-type]
    return Settings(
        node_id=node_id,
        serial=serial & 0xFFFFFFFF,
        name=f"{'pmsmsim' if face is None else face.label} {name}",
        factory=ParameterImage.of_values(values),
        rated_current_ma=max(1, round(1000.0 * i_nom / math.sqrt(2.0))),
        rated_torque_mnm=max(1, round(1000.0 * torque)),
        fixed_node_id=fixed_node_id,
        face=face,
    )
