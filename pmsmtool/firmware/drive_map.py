"""The map of a drive: which object holds which catalogue value, in which type, scale and form.

No standard says what a current-loop gain is; every drive has its own objects. One :class:`Cell` says it
for one value: ``raw = round((SI - offset) / factor)``, little endian, in a CiA 301 type. What the
drive will really hold is :meth:`DriveMap.quantised`; it is shown before anything is written.
"""

from __future__ import annotations

import math
import struct
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from pmsmtool.errors import ConfigError
from pmsmtool.firmware.image import LUT_FORMAT_INT16, LUT_INT16_NO_POINT
from pmsmtool.params.catalogue import BY_NAME, CATALOGUE
from pmsmtool.params.parameter_set import TABLE_NAMES, ParameterSet
from pmsmtool.toml_text import toml_text

SCHEMA = "pmsmtool.drive-map/1"

Rounding = Literal["nearest", "down", "up"]

_LETTERS: dict[str, str] = {
    "UNSIGNED8": "B",
    "UNSIGNED16": "H",
    "UNSIGNED32": "I",
    "INTEGER8": "b",
    "INTEGER16": "h",
    "INTEGER32": "i",
    "REAL32": "f",
}
"""CiA 301 types a value may have on the wire, with their ``struct`` letters."""

REFERENCE_VENDOR = 0x706D736D
REFERENCE_PRODUCT = 0x00000001
REFERENCE_TABLES = {
    "lut.i_d_a": (0x2042, 0),
    "lut.i_q_a": (0x2043, 0),
    "lut.axis_x": (0x2044, 0),
    "lut.axis_y": (0x2045, 0),
    "lut.axis_z": (0x2046, 0),
}
"""DOMAIN objects of the reference drive's look-up table."""


@dataclass(frozen=True, slots=True)
class Cell:
    """Where and how a drive keeps one value.

    Attributes
    ----------
    name : str
        Catalogue name.
    index, sub : int
        The object.
    wire : str
        CiA 301 type.
    factor, offset : float
        SI value = raw factor + offset.
    rounding : str
        ``nearest``, or towards the safe side: ``down``, ``up`` (integers only).
    gain : str
        Empty, or the catalogue name of a gain: the drive keeps gain / value instead of the value
        (an integral time T_n = K_p / K_i).
    """

    name: str
    index: int
    sub: int
    wire: str
    factor: float = 1.0
    offset: float = 0.0
    rounding: Rounding = "nearest"
    gain: str = ""

    @property
    def size(self) -> int:
        """Bytes on the wire."""
        return struct.calcsize("<" + _LETTERS[self.wire])

    def encode(self, value: float, values: Mapping[str, float]) -> bytes:
        """Return the bytes of an SI value.

        Parameters
        ----------
        values : mapping
            The set the value belongs to; asked for ``gain``.

        Raises
        ------
        ConfigError
            The value does not fit the type, or the gain is missing.
        """
        raw = (self._formed(value, values) - self.offset) / self.factor
        letter = _LETTERS[self.wire]
        if letter != "f":
            raw = self._rounded(raw)
        try:
            return struct.pack("<" + letter, raw if letter == "f" else int(raw))
        except (struct.error, OverflowError, ValueError) as error:
            raise ConfigError(
                f"{value:.9g} does not fit {self.wire} in steps of {self.factor:g}",
                where=f"{self.name} -> 0x{self.index:04X}:{self.sub:02X}",
            ) from error

    def decode(self, data: bytes, values: Mapping[str, float]) -> float:
        """Return the SI value of the object's bytes, with the fewest digits that give these bytes again."""
        if len(data) != self.size:
            raise ConfigError(
                f"{len(data)} bytes are no {self.wire}", where=f"{self.name} -> 0x{self.index:04X}:{self.sub:02X}"
            )
        letter = _LETTERS[self.wire]
        raw = struct.unpack("<" + letter, data)[0]
        if letter == "f":
            raw = shortest_binary32(raw)
        return self._formed(raw * self.factor + self.offset, values)

    def _formed(self, value: float, values: Mapping[str, float]) -> float:
        """Integral time from integral gain and back: both are the gain over the other."""
        if not self.gain:
            return value
        if self.gain not in values:
            raise ConfigError(f"needs {self.gain} in the same set", where=self.name)
        return values[self.gain] / value if value else math.inf

    def _rounded(self, raw: float) -> float:
        if not math.isfinite(raw):
            return raw
        if self.rounding == "nearest":
            return round(raw)
        return math.floor(raw) if self.rounding == "down" else math.ceil(raw)


@dataclass(frozen=True, slots=True)
class DriveMap:
    """All cells of one drive family.

    Attributes
    ----------
    name : str
        Family name.
    vendor, product : int
        Identity 0x1018:01, 02 a drive must show before anything is written.
    cells : mapping of str to Cell
        By catalogue name, in catalogue order.
    tables : mapping of str to (index, sub)
        DOMAIN objects of the look-up table; empty where the drive has none.
    staging : bool
        Whether the drive takes a whole set at once (objects 0x2000, 0x2001 of the reference drive).
    """

    name: str
    vendor: int
    product: int
    cells: Mapping[str, Cell]
    tables: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    staging: bool = False

    def encode(self, wanted: ParameterSet) -> dict[str, bytes]:
        """Return the bytes of every entry the drive has an object for, in the order they are written.

        Raises
        ------
        ConfigError
            Entries that do not fit; all of them.
        """
        encoded: dict[str, bytes] = {}
        wrong: list[str] = []
        for name, value in wanted.values.items():
            if name in self.cells:
                try:
                    encoded[name] = self.cells[name].encode(value, wanted.values)
                except ConfigError as error:
                    wrong.append(f"{error.where}: {error.what}")
        if wrong:
            raise ConfigError(f"{len(wrong)} value(s) do not fit the drive", where=self.name, violations=wrong)
        for name, table in wanted.tables.items():
            if name in self.tables:
                encoded[name] = encode_table(name, table, wanted.values)
        return encoded

    def decode(self, found: Mapping[str, bytes]) -> ParameterSet:
        """Return the set that a drive's bytes mean."""
        values: dict[str, float] = {}
        # Gains first: an integral time is decoded with its gain.
        for cell in sorted(self.cells.values(), key=lambda cell: bool(cell.gain)):
            if cell.name in found:
                values[cell.name] = cell.decode(found[cell.name], values)
        tables = {n: decode_table(n, found[n], values) for n in TABLE_NAMES if found.get(n)}
        return ParameterSet(values, tables, name=self.name)

    def missing(self, wanted: ParameterSet) -> tuple[str, ...]:
        """Return the entries of a set that this drive has no object for."""
        return tuple(n for n in [*wanted.values, *wanted.tables] if n not in self.cells and n not in self.tables)

    def quantised(self, wanted: ParameterSet) -> ParameterSet:
        """Return what the drive will really hold of a set."""
        return self.decode(self.encode(wanted))

    def address(self, name: str) -> tuple[int, int]:
        """Return index and sub-index of an entry."""
        if name in self.tables:
            return self.tables[name]
        cell = self.cells[name]
        return cell.index, cell.sub


def encode_table(name: str, numbers: Sequence[float], values: Mapping[str, float]) -> bytes:
    """Return the DOMAIN of an axis or a table; tables in the format ``lut.format`` of the same set says.

    Raises
    ------
    ConfigError
        A number does not fit the format.
    """
    try:
        if name.startswith("lut.axis_") or values.get("lut.format") != LUT_FORMAT_INT16:
            return struct.pack(f"<{len(numbers)}f", *numbers)
        lsb = values["lut.lsb_a"]
        steps = (LUT_INT16_NO_POINT if math.isnan(x) else round(x / lsb) for x in numbers)
        # Padded as in the image, so that the drive reads the same back before and after a reset.
        return struct.pack(f"<{len(numbers)}h", *steps) + bytes(2 * (len(numbers) % 2))
    except (struct.error, OverflowError, KeyError, ZeroDivisionError) as error:
        raise ConfigError(
            "a number does not fit the table's format", where=name, hint="choose a larger lut.lsb_a"
        ) from error


def decode_table(name: str, data: bytes, values: Mapping[str, float]) -> tuple[float, ...]:
    """Return the numbers of a DOMAIN; the inverse of :func:`encode_table`."""
    if name.startswith("lut.axis_") or values.get("lut.format") != LUT_FORMAT_INT16:
        return tuple(map(shortest_binary32, struct.unpack(f"<{len(data) // 4}f", data[: len(data) // 4 * 4])))
    lsb = values["lut.lsb_a"]
    cells = math.prod(int(values.get(f"lut.n_{axis}", 0)) for axis in "xyz") or len(data) // 2
    steps = struct.unpack(f"<{len(data) // 2}h", data[: len(data) // 2 * 2])[:cells]
    return tuple(math.nan if k == LUT_INT16_NO_POINT else k * lsb for k in steps)


def look_up_words(encoded: Mapping[str, bytes]) -> bytes:
    """Return axes and tables as they stand in the parameter image, one after the other."""
    return b"".join(encoded.get(name, b"") for name in TABLE_NAMES)


def shortest_binary32(value: float) -> float:
    """Return the number with the fewest decimal digits that rounds to the same binary32."""
    if not math.isfinite(value):
        return value
    for digits in range(6, 10):
        short = float(f"{value:.{digits}g}")
        if struct.pack("<f", short) == struct.pack("<f", value):
            return short
    return value


def reference_map() -> DriveMap:
    """Return the map of the reference drive, which is the parameter catalogue itself."""
    cells = {row.name: Cell(row.name, row.index, row.sub, row.wire) for row in CATALOGUE}
    return DriveMap("pmsmsim", REFERENCE_VENDOR, REFERENCE_PRODUCT, cells, REFERENCE_TABLES, staging=True)


def dump_drive_map(drive_map: DriveMap) -> str:
    """Return the text of a map file, which :func:`parse_drive_map` reads back."""
    objects = {}
    for cell in drive_map.cells.values():
        row: dict[str, Any] = {"index": cell.index, "sub": cell.sub, "type": cell.wire}
        row |= {"factor": cell.factor} if cell.factor != 1.0 else {}
        row |= {"offset": cell.offset} if cell.offset else {}
        row |= {"rounding": cell.rounding} if cell.rounding != "nearest" else {}
        row |= {"gain": cell.gain} if cell.gain else {}
        objects[cell.name] = row
    tables = {name: {"index": index, "sub": sub} for name, (index, sub) in drive_map.tables.items()}
    head = {"schema": SCHEMA, "name": drive_map.name, "vendor": drive_map.vendor, "product": drive_map.product}
    return toml_text({**head, "staging": drive_map.staging, "objects": objects, "tables": tables})


def parse_drive_map(text: str, where: str = "map.toml") -> DriveMap:
    """Read a map file.

    Raises
    ------
    ConfigError
        Everything that is wrong with it, at once.
    """
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"not a TOML file: {error}", where=where) from error
    if document.get("schema") != SCHEMA:
        raise ConfigError(f"schema is {document.get('schema')!r}, expected {SCHEMA!r}", where=where)
    wrong: list[str] = []
    for key in ("vendor", "product"):
        if type(document.get(key)) is not int:
            wrong.append(f"{key}: not a whole number")
    objects, tables = document.get("objects", {}), document.get("tables", {})
    cells = {name: _parse_cell(name, row, wrong) for name, row in objects.items()} if isinstance(objects, dict) else {}
    found = {name: _parse_table(name, row, wrong) for name, row in tables.items()} if isinstance(tables, dict) else {}
    if wrong:
        raise ConfigError("the drive map cannot be used", where=where, violations=wrong)
    ordered = {row.name: cells[row.name] for row in CATALOGUE if cells.get(row.name) is not None}
    return DriveMap(
        str(document.get("name", "")), document["vendor"], document["product"],
        {name: cell for name, cell in ordered.items() if cell is not None}, found, bool(document.get("staging", False)),
    )  # fmt: skip


def _parse_cell(name: str, row: Any, wrong: list[str]) -> Cell | None:
    before = len(wrong)
    if name not in BY_NAME:
        wrong.append(f"{name}: not in the parameter catalogue")
    if not isinstance(row, dict) or not _is_address(row):
        wrong.append(f"{name}: needs index (0..0xFFFF) and sub (0..0xFF)")
        return None
    if row.get("type") not in _LETTERS:
        wrong.append(f"{name}: type {row.get('type')!r} is none of {', '.join(_LETTERS)}")
    numbers = [row.get("factor", 1.0), row.get("offset", 0.0)]
    if not all(isinstance(x, (int, float)) and math.isfinite(x) for x in numbers) or numbers[0] == 0:
        wrong.append(f"{name}: factor and offset must be finite numbers, factor not zero")
    if row.get("rounding", "nearest") not in ("nearest", "down", "up"):
        wrong.append(f"{name}: rounding {row['rounding']!r} is none of nearest, down, up")
    if row.get("gain", "") not in ("", *BY_NAME):
        wrong.append(f"{name}: gain {row['gain']!r} is not in the parameter catalogue")
    unknown = set(row) - {"index", "sub", "type", "factor", "offset", "rounding", "gain"}
    wrong.extend(f"{name}: unknown key {key}" for key in sorted(unknown))
    if len(wrong) > before:
        return None
    factor, offset = map(float, numbers)
    return Cell(
        name, row["index"], row["sub"], row["type"], factor, offset, row.get("rounding", "nearest"), row.get("gain", "")
    )


def _parse_table(name: str, row: Any, wrong: list[str]) -> tuple[int, int]:
    if name not in TABLE_NAMES or not isinstance(row, dict) or not _is_address(row):
        wrong.append(f"tables.{name}: unknown table, or without index and sub")
        return (0, 0)
    return row["index"], row["sub"]


def _is_address(row: Mapping[str, Any]) -> bool:
    index, sub = row.get("index"), row.get("sub")
    return type(index) is int and type(sub) is int and 0 <= index <= 0xFFFF and 0 <= sub <= 0xFF
