# SPDX-License-Identifier: MIT
"""A drive map with what was measured on the drive: rows with the source ``measured``, and published rows checked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import get_args

from pmsmtool.drive_maps.drive_map import Cell, DriveMap, Form
from pmsmtool.drive_maps.drive_map_file import dump_drive_map, parse_drive_map
from pmsmtool.drive_maps.motion_objects import UNDECIDED
from pmsmtool.drive_maps.wire_units import wire_unit
from pmsmtool.params.catalogue import EVERY

SOURCE = "measured"
FORMS: tuple[str, ...] = get_args(Form)


@dataclass(frozen=True, slots=True)
class MeasuredRow:
    """One gain as it was measured.

    Attributes
    ----------
    name : str
        Catalogue name.
    index, sub, wire : int, int, str
        The object.
    form, gain : str
        As of a row of the map.
    scale, unit : float, str
        One count.
    half_width : float
        Of the scale, relative, 95 %.
    """

    name: str
    index: int
    sub: int
    wire: str
    form: str
    gain: str
    scale: float
    unit: str
    half_width: float

    def cell(self) -> Cell:
        """Return the row of a map."""
        assert self.form in FORMS
        unit = f"{self.scale:.6g} {self.unit}"
        return Cell(
            self.name, self.index, self.sub, self.wire, wire_unit(unit).scale, gain=self.gain, unit=unit,
            form=self.form, source=SOURCE,  # type: ignore[arg-type]
        )  # fmt: skip

    def against(self, published: Cell) -> str:
        """Say how a published row contradicts what was measured; empty where it agrees."""
        if (published.index, published.sub) != (self.index, self.sub):
            return ""
        if published.form == "current":
            return ""  # counts of amperes: the drive's torque per ampere stands between
        if published.form != self.form:
            return f"{self.name}: the map states form {published.form!r}, measured is {self.form!r}"
        miss = math.log(self.scale / published.factor) if published.factor > 0.0 else math.inf
        if abs(miss) <= self.half_width:
            return ""
        return (
            f"{self.name}: one count is {published.factor:.4g} {self.unit} in the map, measured is {self.scale:.4g} "
            f"+-{100 * self.half_width:.0f} %"
        )


def with_measured(
    base: DriveMap, vendor: int, product: int, rows: Sequence[MeasuredRow], said: str, kind: str | None
) -> DriveMap:
    """Return a map of this drive with the measured rows, checked as a file would be.

    Raises ConfigError: the result is no map.

    Parameters
    ----------
    vendor, product : int
        Identity of the drive, where the map names none.
    said : str
        On which drive, and how well.
    kind : str or None
        ``peak`` or ``rms`` where that was decided of currents whose kind no source says.
    """
    held = {*base.cells, *(row.name for row in rows)}
    usable = [row for row in rows if not row.gain or row.gain in held]
    said += "".join(f"; {row.name} is {row.form}, {row.scale:.4g} {row.unit}, and needs {row.gain}" for row in rows
                    if row not in usable)  # fmt: skip
    cells = {**base.cells, **{row.name: row.cell() for row in usable}}
    order = {parameter.name: k for k, parameter in enumerate(EVERY)}
    motion = {
        name: replace(row, unit=row.unit.removesuffix(UNDECIDED) + f" {kind}", source=SOURCE)
        if kind in ("peak", "rms") and row.undecided
        else row
        for name, row in base.motion.items()
    }
    own = base if base.vendor else replace(base, name=f"{base.name} measured", vendor=vendor, product=product)
    found = replace(
        own,
        cells=dict(sorted(cells.items(), key=lambda item: order[item[0]])),
        motion=motion,
        left_out={name: why for name, why in base.left_out.items() if name not in cells},
        sources={**base.sources, SOURCE: said},
    )
    return parse_drive_map(dump_drive_map(found), "measured map")
