# SPDX-License-Identifier: MIT
"""What a machine may be besides its nominal numbers: a box of tolerances, its corners and random samples from it.

Each parameter has a relative (or absolute) standard deviation and a systematic half width; its 95 % interval is
nominal +- (1.96 std + systematic). Temperatures and the DC-link voltage have ranges. Corners are all combinations of
interval ends; random samples are normal plus uniform, ranges uniform.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_file import MachineFile, load_machine_file

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
