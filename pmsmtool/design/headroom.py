# SPDX-License-Identifier: MIT
"""Limit headroom of many machines at once: what the nominal references need of voltage, current and copper loss.

The references are those of least loss for the nominal machine, as a look-up table holds them; every sample runs them
with its own resistance, inductance, magnet, temperature, DC link and encoder offset. Headroom is 1 - need/limit: 0 at
the limit, negative beyond. Field weakening that measures the voltage will give up torque instead of exceeding it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.lookup.table import CUT, NONE, electrical_speed, speed_table
from pmsmtool.design.operating_machine import at_temperature
from pmsmtool.design.ratings import Ratings
from pmsmtool.design.tolerance import Samples
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import MachineParameters
from pmsmtool.machine.temperature import magnet_flux_at, resistance_at
from pmsmtool.machine.torque import air_gap_torque

TORQUE_SHARES = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Torques of the cells, over rated torque."""

SPEEDS = 13
"""Speeds of the cells, from standstill to the largest."""


@dataclass(frozen=True, slots=True, eq=False)
class OperatingCells:
    """Nominal references and what is needed to evaluate them on other machines, each shape (cells,)."""

    torque_nm: Array
    speed_rpm: Array
    omega_e: Array
    """Torque achieved nominally (N m), mechanical speed (rpm), electrical speed (rad/s)."""
    i_d_a: Array
    i_q_a: Array
    """References (A peak)."""
    psi_d_wb: Array
    psi_q_wb: Array
    """Nominal fluxes there (Wb)."""
    jacobian: Array
    """Their derivatives by i_d, i_q (H): dd, dq, qd, qq. Shape (4, cells)."""
    unreachable: tuple[str, ...] = ()
    """Points that were left out, because the nominal machine does not reach their torque."""

    def name(self, cell: int) -> str:
        """Return one cell in words."""
        return f"{self.torque_nm[cell]:.4g} N m at {self.speed_rpm[cell]:.5g} rpm"


def operating_cells(source: MachineFile, rated: Ratings, voltage_margin: float) -> OperatingCells:
    """Return the cells up to rated torque, with the references of least loss."""
    machine = at_temperature(source.machine, source.flux_map)
    V = (1.0 - voltage_margin) * source.inverter.V_max_v
    top = speed_table(
        machine, torque_nm=[1e9], speed_rpm=[0.0], V_max_v=[1e9], I_max_apk=rated.I_nom_apk, i_d_min_a=rated.i_d_min_a
    )
    rated_nm = min(float(top.achieved_torque_nm[0, 0, 0]), rated.tau_max_nm)
    table = speed_table(
        machine,
        torque_nm=rated_nm * np.array(TORQUE_SHARES),
        speed_rpm=np.linspace(0.0, rated.n_max_rpm, SPEEDS),
        V_max_v=[V],
        I_max_apk=rated.I_max_apk,
        i_d_min_a=rated.i_d_min_a,
    )
    known = (table.limits[..., 0] & (CUT | NONE)) == 0
    lost = tuple(
        f"{table.torque_nm[x]:.4g} N m at {table.y[y]:.5g} rpm ({table.binding[x, y, 0]})"
        for x, y in np.argwhere(~known)
    )
    i_d, i_q = table.i_d_a[..., 0][known], table.i_q_a[..., 0][known]
    speed = np.broadcast_to(table.y, known.shape)[known]
    psi_d, psi_q = machine.flux(i_d, i_q)
    if source.flux_map is None:
        jacobian = np.tile([[machine.L_d], [0.0], [0.0], [machine.L_q]], i_d.size)
    else:
        jacobian = source.flux_map.incremental_inductance(i_d, i_q).reshape(4, -1)
    # of no torque a solution leaves 1e-21 N m, whose sign turns with the inductances: it would count as out of reach
    asked = np.broadcast_to(table.torque_nm[:, None], known.shape)[known]
    achieved = np.where(asked == 0.0, 0.0, table.achieved_torque_nm[..., 0][known])
    omega = electrical_speed(machine, speed)
    return OperatingCells(achieved, speed, omega, i_d, i_q, psi_d, psi_q, jacobian, lost)


@dataclass(frozen=True, slots=True, eq=False)
class Headroom:
    """Headroom of n samples, each shape (n, cells) but the last."""

    voltage: Array
    """1 - |v| / V_max."""
    current: Array
    """1 - |i| scaled to the wanted torque / I_max; cells of rated torque share only."""
    thermal: Array
    """1 - copper loss of rated torque / copper loss of the continuous current at the winding limit. Shape (n,)."""


@dataclass(frozen=True, slots=True)
class HeadroomLimits:
    """Limits the samples are held against; ratios where no unit is given."""

    utilisation: float
    I_max_apk: float
    I_cont_apk: float
    T_winding_max_c: float


def headroom(machine: MachineParameters, cells: OperatingCells, limits: HeadroomLimits, samples: Samples) -> Headroom:
    """Evaluate the nominal references on every sample."""
    R = samples.column("R_s_ohm") * resistance_at(machine, samples.column("T_winding_c"))
    psi_f = samples.column("psi_f_wb") * magnet_flux_at(machine, samples.column("T_magnet_c"))
    i_d, i_q, psi_d, psi_q = _fluxes(machine, cells, psi_f, samples)
    v_d, v_q = R * i_d - cells.omega_e * psi_q, R * i_q + cells.omega_e * psi_d
    V_max = limits.utilisation * samples.column("U_dc_v")
    torque = air_gap_torque(machine.pole_pairs, psi_d, psi_q, i_d, i_q)
    current = np.hypot(cells.i_d_a, cells.i_q_a)
    with np.errstate(divide="ignore", invalid="ignore"):
        need = np.where(cells.torque_nm == 0.0, current, current * np.abs(cells.torque_nm / torque))
    need = np.where(np.sign(torque) * np.sign(cells.torque_nm) < 0.0, np.inf, need)
    hottest = resistance_at(machine, limits.T_winding_max_c)
    rated = int(np.argmax(cells.torque_nm - 1e-9 * cells.speed_rpm))
    loss = samples.column("R_s_ohm")[:, 0] * need[:, rated] ** 2 * (R / samples.column("R_s_ohm"))[:, 0]
    return Headroom(
        1.0 - np.hypot(v_d, v_q) / V_max,
        1.0 - need / limits.I_max_apk,
        1.0 - loss / (hottest * limits.I_cont_apk**2),
    )


def _fluxes(
    machine: MachineParameters, cells: OperatingCells, psi_f: Array, samples: Samples
) -> tuple[Array, Array, Array, Array]:
    """Currents in the true frame (turned by the encoder error) and their fluxes, shape (n, cells)."""
    turn = samples.column("encoder_rad")
    cosine, sine = np.cos(turn), np.sin(turn)
    i_d = cosine * cells.i_d_a - sine * cells.i_q_a
    i_q = sine * cells.i_d_a + cosine * cells.i_q_a
    step_d, step_q = i_d - cells.i_d_a, i_q - cells.i_q_a
    dd, dq, qd, qq = cells.jacobian
    swing_d = cells.psi_d_wb - machine.psi_f_wb + dd * step_d + dq * step_q
    swing_q = cells.psi_q_wb + qd * step_d + qq * step_q
    return i_d, i_q, psi_f + samples.column("L_d_h") * swing_d, samples.column("L_q_h") * swing_q
