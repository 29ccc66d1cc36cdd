# SPDX-License-Identifier: MIT
"""The rows of the simulated drive's object dictionary: its own table plus the parameter catalogue.

``firmware-params/pmsmsim/objects.csv`` holds everything that is not a parameter; every row of ``params/catalogue.py``
becomes an object too. Both the running node and its EDS are built from :func:`object_rows`.

Columns: ``index`` and ``sub`` hexadecimal; ``key``, by which the program names the object; ``type`` (``ARRAY`` and
``RECORD`` head a group, with 8 they have a writable sub 0); ``access``; ``pdo`` T mappable for sending, R for receiving
too, 0 neither; ``default``, ``low``, ``high``; ``store`` y: kept by 0x1010.
"""

from __future__ import annotations

import csv
import math
import struct
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from pmsmtool.data_types import BY_SHORT, SHORT, DataType
from pmsmtool.files import data_folder
from pmsmtool.params.catalogue import CATALOGUE, SCHEMA_VERSION, Parameter, layout_signature

_COUNTED = {"ARRAY8": "ARRAY", "RECORD8": "RECORD"}


@dataclass(frozen=True, slots=True)
class ObjectRow:
    """One sub-object, or the heading of a record or array (``container`` set, sub 0).

    ``default`` is text as in an EDS; ``low`` and ``high`` are None where only the type bounds the value. ``stored``
    says that the value survives a reset when it was saved (the parameter set is stored as one image). ``copied`` is the
    data sheet's word (``ObjFlags``): a backup reads it, a download writes it.
    """

    index: int
    sub: int
    key: str
    name: str
    type: str
    access: str
    pdo: str
    unit: str
    default: str
    low: float | None
    high: float | None
    stored: bool
    container: str = ""
    parameter: Parameter | None = None
    copied: bool = True

    @property
    def data_type(self) -> DataType:
        """Type of the value."""
        return BY_SHORT[self.type]

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and largest number: what is stated, within what a whole number of the type holds."""
        kind, low, high = self.data_type, -math.inf, math.inf
        if kind.is_integer:
            span = 2.0 ** (8 * kind.size)
            low, high = (-0.5 * span, 0.5 * span - 1.0) if kind.is_signed else (0.0, span - 1.0)
        return max(low, low if self.low is None else self.low), min(high, high if self.high is None else self.high)

    def default_number(self, node: int) -> float:
        """Return the default as a number, ``$NODEID`` replaced."""
        return float(self.default) if self.data_type.is_float else float(self._whole(node))

    def _whole(self, node: int) -> int:
        text = self.default.removeprefix("$NODEID+")
        return int(text or "0", 0) + (node if text != self.default else 0)

    def default_bytes(self, node: int) -> bytes:
        """Return the default as it travels, little endian."""
        kind = self.data_type
        if not kind.letter:
            return self.default.encode("ascii")
        return struct.pack("<" + kind.letter, float(self.default) if kind.is_float else self._whole(node))


def _bound(text: str) -> float | None:
    return float(int(text, 16)) if text.startswith("0x") else float(text) if text else None


def _csv_row(fields: dict[str, str]) -> ObjectRow:
    kind = fields["type"]
    container = _COUNTED.get(kind, kind if kind in ("ARRAY", "RECORD") else "")
    default = fields["default"].replace("$SCHEMA", str(SCHEMA_VERSION))
    return ObjectRow(
        index=int(fields["index"], 16),
        sub=int(fields["sub"], 16),
        key=fields["key"],
        name=fields["name"],
        type="U8" if container else kind,
        access=fields["access"] or "const",
        pdo=fields["pdo"] or "0",
        unit=fields["unit"],
        default=default.replace("$SIGNATURE", f"0x{layout_signature():08X}"),
        low=_bound(fields["low"]),
        high=_bound(fields["high"]),
        stored=fields["store"] == "y",
        container=container,
    )


def _parameter_row(parameter: Parameter) -> ObjectRow:
    default = f"{int(parameter.default)}" if parameter.is_integer else f"{parameter.default:.9g}"
    return ObjectRow(
        index=parameter.index,
        sub=parameter.sub,
        key=parameter.name,
        name=parameter.meaning[0].upper() + parameter.meaning[1:],
        type=SHORT[parameter.wire],
        access="rw",
        pdo="R" if parameter.live else "0",
        unit=parameter.unit,
        default=default,
        low=parameter.minimum,
        high=parameter.maximum,
        stored=False,
        parameter=parameter,
    )


def _counts(rows: list[ObjectRow]) -> dict[int, int]:
    highest: dict[int, int] = {}
    for row in rows:
        highest[row.index] = max(highest.get(row.index, 0), row.sub)
    return highest


@cache
def object_rows() -> tuple[ObjectRow, ...]:
    """Return all rows sorted by index and sub-index; constant sub 0 of containers filled with the highest sub."""
    path = data_folder("firmware-params") / "pmsmsim" / "objects.csv"
    return build_rows(path)


def build_rows(path: Path) -> tuple[ObjectRow, ...]:
    """Return the rows of a table file and of the catalogue.

    Raises ValueError: two rows name the same object, or one misses its container.
    """
    with path.open(encoding="ascii", newline="") as file:
        rows = [_csv_row(fields) for fields in csv.DictReader(file)]
    rows += [_parameter_row(parameter) for parameter in CATALOGUE]
    highest = _counts(rows)
    filled: dict[tuple[int, int], ObjectRow] = {}
    for row in rows:
        if (row.index, row.sub) in filled:
            raise ValueError(f"{path}: object 0x{row.index:04X}:{row.sub:02X} appears twice")
        if row.container and row.access == "const":
            row = _with_default(row, highest[row.index])
        filled[row.index, row.sub] = row
    for index, sub in filled:
        if (index, 0) not in filled:
            raise ValueError(f"{path}: object 0x{index:04X}:{sub:02X} has no sub-index 0")
    return tuple(filled[key] for key in sorted(filled))


def _with_default(row: ObjectRow, highest: int) -> ObjectRow:
    return ObjectRow(
        row.index, row.sub, row.key, row.name, row.type, row.access, row.pdo, row.unit,
        str(highest), row.low, row.high, row.stored, row.container,
    )  # fmt: skip
