# SPDX-License-Identifier: MIT
"""What a machine may be besides its nominal numbers: a box of tolerances, its corners and random samples from it.

Each parameter has a relative (or absolute) standard deviation and a systematic half width; its 95 % interval is
nominal +- (1.96 std + systematic). Temperatures and the DC-link voltage have ranges. Corners are all combinations of
interval ends; random samples are normal plus uniform, ranges uniform.

Limit headroom of many machines: what the nominal references need of voltage, current and copper loss. The references
are those of least loss for the nominal machine, as a look-up table holds them; every sample runs them with its own
resistance, inductance, magnet, temperature, DC link and encoder offset. Headroom is 1 - need/limit: 0 at the limit,
negative beyond. Field weakening that measures the voltage will give up torque instead of exceeding it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.lookup.table import CUT, NONE, electrical_speed, speed_table
from pmsmtool.design.operating_machine import at_temperature
from pmsmtool.design.ratings import Ratings
from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.machine.parameters import MachineParameters
from pmsmtool.machine.temperature import magnet_flux_at, resistance_at
from pmsmtool.machine.torque import air_gap_torque

NORMAL_95 = 1.959963984540054
"""Two-sided 95 % quantile of the normal distribution."""

PARAMETERS = ("R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb", "J_kgm2")
"""Machine keys that vary."""

ASSUMED_STD: Mapping[str, float] = {"R_s_ohm": 0.03, "L_d_h": 0.05, "L_q_h": 0.05, "psi_f_wb": 0.02, "J_kgm2": 0.05}
"""Relative standard deviation where the machine file gives none: what a data sheet leaves open."""

T_WINDING_RANGE_C = (-20.0, 155.0)
T_MAGNET_RANGE_C = (-20.0, 120.0)
"""Ranges where the machine file gives no limits: cold start to insulation class F and a common magnet limit."""

U_DC_TOLERANCE = 0.05
"""Relative range of the DC-link voltage where none is asked for."""

ENCODER_STD_RAD = math.radians(1.0)
"""Standard deviation of the electrical encoder offset where the machine file gives none."""

SPREAD_LIMITS = (0.2, 5.0)
"""A random factor is kept inside: beyond, the number was never measured."""


@dataclass(frozen=True, slots=True)
class Deviation:
    """Doubt of one quantity, in its own unit: standard deviation and systematic half width."""

    std: float
    systematic: float = 0.0

    @property
    def half_width(self) -> float:
        """Half of the 95 % interval."""
        return NORMAL_95 * self.std + self.systematic


@dataclass(frozen=True, slots=True)
class ToleranceBox:
    """Ranges of everything that varies."""

    factors: Mapping[str, Deviation]
    """Relative deviation of each machine key of ``PARAMETERS`` that is known."""
    encoder_rad: Deviation
    """Electrical encoder offset (rad)."""
    T_winding_c: tuple[float, float]
    T_magnet_c: tuple[float, float]
    U_dc_v: tuple[float, float]
    """Ranges."""
    notes: tuple[str, ...] = ()
    """What was assumed."""

    @property
    def names(self) -> tuple[str, ...]:
        """Columns of a sample matrix."""
        return (*self.factors, "encoder_rad", "T_winding_c", "T_magnet_c", "U_dc_v", "operating_point")

    def nominal(self, source: MachineFile) -> Samples:
        """Return the machine as written, at its reference temperature."""
        machine = source.machine
        row = [1.0] * len(self.factors) + [0.0, machine.T_ref_c, machine.T_ref_c, source.inverter.U_dc_v, 0.0]
        return Samples(self.names, np.array([row]))

    def corners(self) -> Samples:
        """Return all combinations of interval ends.

        ``operating_point`` is 0 (inductance of the design) or 1 (the least inside the current limit).
        """
        ends = [(1.0 - d.half_width, 1.0 + d.half_width) for d in self.factors.values()]
        ends += [(-self.encoder_rad.half_width, self.encoder_rad.half_width)]
        ends += [self.T_winding_c, self.T_magnet_c, self.U_dc_v, (0.0, 1.0)]
        return Samples(self.names, np.array(list(itertools.product(*ends))))

    def draw(self, count: int, seed: int, block: int) -> Samples:
        """Return random samples; the same for the same seed and block, whoever draws the other blocks."""
        rng = np.random.default_rng([seed, block])
        low, high = SPREAD_LIMITS
        columns = []
        for deviation in self.factors.values():
            error = rng.normal(0.0, deviation.std, count) + rng.uniform(-1.0, 1.0, count) * deviation.systematic
            columns.append(np.clip(1.0 + error, low, high))
        offset = self.encoder_rad
        columns.append(rng.normal(0.0, offset.std, count) + rng.uniform(-1.0, 1.0, count) * offset.systematic)
        columns += [rng.uniform(*ends, count) for ends in (self.T_winding_c, self.T_magnet_c, self.U_dc_v)]
        columns.append(rng.uniform(0.0, 1.0, count))
        return Samples(self.names, np.column_stack(columns))


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Rows of varied quantities."""

    names: tuple[str, ...]
    """Columns: factors over nominal, then absolute quantities."""
    rows: Array
    """One sample per row. Shape (n, columns)."""

    def __len__(self) -> int:
        return len(self.rows)

    def column(self, name: str) -> Array:
        """Return one quantity, shape (n, 1); a factor that does not vary is one."""
        if name in self.names:
            return self.rows[:, self.names.index(name), None]
        return np.ones((len(self.rows), 1))

    def describe(self, row: int) -> dict[str, float]:
        """Return one sample by name."""
        return dict(zip(self.names, self.rows[row].tolist(), strict=True))


def tolerance_box(
    source: MachineFile | str | Path,
    *,
    U_dc_v: tuple[float, float] | None = None,
    T_winding_c: tuple[float, float] | None = None,
    T_magnet_c: tuple[float, float] | None = None,
) -> ToleranceBox:
    """Collect the box of a machine file, or of its name; ranges asked for win over its limits, those over assumptions.

    Raises
    ------
    ConfigError
        A range that is empty or not finite.
    """
    if not isinstance(source, MachineFile):
        source = load_machine_file(source)
    notes = []
    factors = {}
    for name in PARAMETERS:
        value = getattr(source.machine, name)
        if value is None or value == 0.0:
            continue
        if name not in source.std:
            own = name in source.estimates and source.estimates[name].source == "vendor"
            why = "the drive's own value has no interval" if own else "no standard deviation is given"
            notes.append(f"{name}: {why}, {100.0 * ASSUMED_STD[name]:g} % assumed")
        std = source.std.get(name, ASSUMED_STD[name] * value)
        factors[name] = Deviation(std / value, source.systematic.get(name, 0.0) / value)
    limits, machine = source.limits, source.machine
    if "offset_rad" not in source.std:
        degrees = math.degrees(ENCODER_STD_RAD)
        notes.append(f"encoder offset: no standard deviation is given, {degrees:g} degree assumed")
    encoder = Deviation(source.std.get("offset_rad", ENCODER_STD_RAD), source.systematic.get("offset_rad", 0.0))
    winding_top = T_WINDING_RANGE_C[1] if limits.T_winding_max_c is None else limits.T_winding_max_c
    magnet_top = T_MAGNET_RANGE_C[1] if limits.T_magnet_max_c is None else limits.T_magnet_max_c
    coldest = min(T_WINDING_RANGE_C[0], machine.T_ref_c)
    U_dc = source.inverter.U_dc_v
    if U_dc_v is None:
        U_dc_v = ((1.0 - U_DC_TOLERANCE) * U_dc, (1.0 + U_DC_TOLERANCE) * U_dc)
        notes.append(f"DC-link voltage: +-{100.0 * U_DC_TOLERANCE:g} % assumed")
    box = ToleranceBox(
        factors,
        encoder,
        T_winding_c or (coldest, winding_top),
        T_magnet_c or (coldest, magnet_top),
        U_dc_v,
        tuple(notes),
    )
    wrong = [
        f"{name} = {ends} is no range"
        for name, ends in (("T_winding_c", box.T_winding_c), ("T_magnet_c", box.T_magnet_c), ("U_dc_v", box.U_dc_v))
        if not (math.isfinite(ends[0]) and math.isfinite(ends[1]) and ends[0] <= ends[1])
    ]
    if wrong:
        raise ConfigError("the tolerance box cannot be used", where="margins", violations=wrong)
    return box


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
    loss = R[:, 0] * need[:, rated] ** 2
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
