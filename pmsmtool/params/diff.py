# SPDX-License-Identifier: MIT
"""Differences between two sets of drive parameters, entry by entry in catalogue order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pmsmtool.params.catalogue import BY_NAME, EVERY
from pmsmtool.params.parameter_set import SATURATION, TABLE_NAMES, ParameterSet


@dataclass(frozen=True, slots=True)
class Difference:
    """One entry that two sets do not share.

    Attributes
    ----------
    name : str
        Catalogue or table name.
    old, new : float or None
        Values in SI, None where a set has no such entry; for a table the entries that differ are
        counted in ``cells`` and ``old``, ``new`` are those of the first one.
    unit : str
        Unit of both.
    cells : int
        How many numbers of a table differ; 0 for a scalar.
    """

    name: str
    old: float | None
    new: float | None
    unit: str
    cells: int = 0

    @property
    def relative(self) -> float:
        """Relative change ``new / old - 1``; NaN where it has no meaning."""
        if self.old is None or self.new is None or self.old == 0:
            return math.nan
        return self.new / self.old - 1.0


def compare(old: ParameterSet, new: ParameterSet, *, common_only: bool = False) -> tuple[Difference, ...]:
    """List the entries in which ``new`` differs from ``old``.

    Parameters
    ----------
    common_only : bool
        Leave out what only one of the sets holds.
    """
    found = []
    for row in EVERY:
        a, b = old.values.get(row.name), new.values.get(row.name)
        if a != b and not (common_only and None in (a, b)):
            found.append(Difference(row.name, a, b, row.unit))
    for name in TABLE_NAMES:
        table_a, table_b = old.tables.get(name), new.tables.get(name)
        if common_only and (table_a is None or table_b is None):
            continue
        difference = _compare_tables(name, table_a or (), table_b or ())
        if difference is not None:
            found.append(difference)
    return tuple(found)


def _compare_tables(name: str, old: Sequence[float], new: Sequence[float]) -> Difference | None:
    shared = [(a, b) for a, b in zip(old, new, strict=False) if a != b and not (math.isnan(a) and math.isnan(b))]
    cells = len(shared) + abs(len(old) - len(new))
    if cells == 0:
        return None
    first_old, first_new = shared[0] if shared else (None, None)
    return Difference(name, first_old, first_new, table_unit(name), cells)


def table_unit(name: str) -> str:
    """Return the unit of a look-up axis or table, the second axis's only in words (it has two kinds)."""
    units = {"lut.axis_x": "N m", "lut.axis_y": "rpm or Wb", "lut.axis_z": "V", SATURATION: "Wb and H"}
    return BY_NAME[name].unit if name in BY_NAME else units.get(name, "A")
