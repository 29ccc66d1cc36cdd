# SPDX-License-Identifier: MIT
"""The map of a drive: which object holds which catalogue value, in which type, scale and form.

No standard says what a current-loop gain is; every drive has its own objects. One :class:`Cell` says it
for one value: ``raw = round((SI - offset) / factor)``, little endian, in a CiA 301 type. What the
drive will really hold is :meth:`DriveMap.quantised`; it is shown before anything is written.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from pmsmtool.data_types import DATA_TYPES
from pmsmtool.drive_maps.identity_rows import IdentityRows
from pmsmtool.drive_maps.map_tables import decode_table, encode_table, shortest_binary32
from pmsmtool.drive_maps.motion_objects import MotionObject
from pmsmtool.drive_maps.recorder_map import RecorderMap, Recording
from pmsmtool.drive_maps.vendor_tuning import VendorTuning
from pmsmtool.drive_maps.wire_units import as_peak
from pmsmtool.errors import ConfigError, next_step
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.params.catalogue import BY_NAME, CATALOGUE, INCREMENTS, OWN_SCALES, TORQUE_PER_AMPERE, layout_signature
from pmsmtool.params.parameter_set import SATURATION, TABLE_NAMES, ParameterSet
from pmsmtool.plain_text import counted

_LOOP_GAIN = re.compile(r"(?<=\.)(K_|pid_)[pid]_.*")
_ADDRESS = re.compile(r"0x([0-9A-F]{4}):([0-9A-F]{2})(?: |\Z)")
Rounding = Literal["nearest", "down", "up"]
Form = Literal["value", "time", "rate", "relative", "torque constant", "current"]
Injecting = Literal["none", "current", "voltage"]

LETTERS: dict[str, str] = {
    name: DATA_TYPES[name].letter
    for name in ("UNSIGNED8", "UNSIGNED16", "UNSIGNED32", "INTEGER8", "INTEGER16", "INTEGER32", "REAL32")
}
"""CiA 301 types a value may have on the wire, with their ``struct`` letters."""

IN_AMPERES = "kept in amperes: `pmsmtool tune --axis` designs it with the torque of an ampere"
"""Why a gain is not written that needs the torque per ampere beside it."""
PER_INCREMENT = "kept per increment of the encoder: `pmsmtool tune --axis` designs it with the drive's own increments"
NOT_ALONE = {TORQUE_PER_AMPERE: IN_AMPERES, INCREMENTS: PER_INCREMENT}
REFERENCE_VENDOR = 0x706D736D
REFERENCE_PRODUCT = 0x00000001
REFERENCE_TABLES = {
    "lut.i_d_a": (0x2042, 0),
    "lut.i_q_a": (0x2043, 0),
    "lut.axis_x": (0x2044, 0),
    "lut.axis_y": (0x2045, 0),
    "lut.axis_z": (0x2046, 0),
    SATURATION: (0x2049, 0),
}
"""DOMAIN objects of the reference drive's tables."""


@dataclass(frozen=True, slots=True)
class Cell:
    """Where and how a drive keeps one value."""

    name: str
    """Catalogue name."""
    index: int
    sub: int
    """The object."""
    wire: str
    """CiA 301 type."""
    factor: float = 1.0
    offset: float = 0.0
    """SI value = raw factor + offset."""
    rounding: Rounding = "nearest"
    """``nearest``, or towards the safe side: ``down``, ``up`` (integers only)."""
    gain: str = ""
    """Empty, or the catalogue name of the other value the form needs."""
    unit: str = ""
    """What one count is worth (``drive_maps/wire_units.py``), as in the drive's manual."""
    form: Form = "value"
    """``value``; ``time``: the drive keeps gain / value (an integral time T_n = K_p / K_i); ``rate``: value / gain
    (an integral rate K_i / K_p, a torque slope / rated torque); ``relative``: value / gain of the same unit (a
    torque / rated torque); ``torque constant``: 1.5 p psi_f instead of the flux linkage (``gain`` is the number of
    pole pairs); ``current``: value / gain, a torque per something kept as a current (``gain`` is the torque per
    ampere)."""
    source: str = ""
    """Key of ``DriveMap.sources`` that confirms the object."""
    low: float = -math.inf
    high: float = math.inf
    """Smallest and largest count that the drive takes, where its maker's file says so."""

    def __post_init__(self) -> None:
        if self.gain and self.form == "value":
            object.__setattr__(self, "form", "time")  # a gain alone has always meant an integral time

    @property
    def size(self) -> int:
        """Bytes on the wire."""
        return struct.calcsize("<" + LETTERS[self.wire])

    @property
    def largest(self) -> float:
        """Largest count that the object holds."""
        letter = LETTERS[self.wire]
        return self.high if letter == "f" else min(self.high, 2.0 ** (8 * self.size - letter.islower()) - 1.0)

    def encode(self, value: float, values: Mapping[str, float]) -> bytes:
        """Return the bytes of an SI value.

        Raises ConfigError: the value does not fit the type, is beyond the drive's limits, or the gain is missing.

        Parameters
        ----------
        values : mapping
            The set the value belongs to; asked for ``gain``.
        """
        raw = self.counts(value, values)
        letter = LETTERS[self.wire]
        if letter != "f":
            raw = self._rounded(raw)
        where = f"{self.name} -> 0x{self.index:04X}:{self.sub:02X}"
        try:
            data = struct.pack("<" + letter, raw if letter == "f" else int(raw))
        except (struct.error, OverflowError, ValueError) as error:
            raise ConfigError(
                f"{value:.9g} does not fit {self.wire} in steps of {self.factor:g}", where=where
            ) from error
        if not self.low <= raw <= self.high:
            limit, end = (self.high, "most") if raw > self.high else (self.low, "least")
            bound = self._meant(limit * self.factor + self.offset, values)
            unit = BY_NAME[self.name].unit.removesuffix("1")
            asked, taken = (f"{number:.6g} {unit}".rstrip() for number in (value, bound))
            what = f"{asked} is {raw:.9g} in its counts, the drive takes at {end} {limit:.9g} ({taken})"
            raise ConfigError(what, where=where)
        return data

    def counts(self, value: float, values: Mapping[str, float]) -> float:
        """Return an SI value in counts of the object, not rounded yet."""
        return (self._formed(value, values) - self.offset) / self.factor

    def decode(self, data: bytes, values: Mapping[str, float]) -> float:
        """Return the SI value of the object's bytes, with the fewest digits that give these bytes again."""
        if len(data) != self.size:
            raise ConfigError(
                f"{len(data)} bytes are no {self.wire}", where=f"{self.name} -> 0x{self.index:04X}:{self.sub:02X}"
            )
        letter = LETTERS[self.wire]
        raw = struct.unpack("<" + letter, data)[0]
        if letter == "f":
            raw = shortest_binary32(raw)
        # fifteen digits: one count more or less shows, the product's last bit does not
        return self._meant(float(f"{raw * self.factor + self.offset:.15g}"), values)

    def _formed(self, value: float, values: Mapping[str, float]) -> float:
        """What the drive keeps for a value."""
        if self.form == "value":
            return value
        other = self._other(values)
        if self.form == "torque constant":
            return torque_per_ampere(other, value)
        divided = (other, value) if self.form == "time" else (value, other)
        return divided[0] / divided[1] if divided[1] else math.inf

    def _meant(self, kept: float, values: Mapping[str, float]) -> float:
        """What a kept number means; the inverse of :meth:`_formed`."""
        if self.form == "value":
            return kept
        other = self._other(values)
        if self.form in ("rate", "relative", "current"):
            return kept * other
        if self.form == "torque constant":
            return kept / torque_per_ampere(other, 1.0) if other else math.inf
        return other / kept if kept else math.inf

    def _other(self, values: Mapping[str, float]) -> float:
        if self.gain not in values:
            raise ConfigError(f"needs {self.gain} in the same set", where=self.name)
        return values[self.gain]

    def _rounded(self, raw: float) -> float:
        if not math.isfinite(raw):
            return raw
        if self.rounding == "nearest":
            return round(raw)
        return math.floor(raw) if self.rounding == "down" else math.ceil(raw)


@dataclass(frozen=True, slots=True)
class SignalCell:
    """Where a drive shows or takes a quantity of its running control."""

    index: int
    sub: int
    """The object."""
    wire: str
    """CiA 301 type."""
    unit: str
    """What one count is worth (``drive_maps/wire_units.py``)."""
    source: str = ""
    """Key of ``DriveMap.sources``."""

    @property
    def size(self) -> int:
        """Bytes on the wire."""
        return struct.calcsize("<" + LETTERS[self.wire])


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What a family can do besides holding parameters; the drive itself must confirm it."""

    torque_mode: bool | None = None
    """CiA 402 modes 4 or 10; None: as the drive says (0x6502)."""
    velocity_mode: bool = False
    """CiA 402 modes 3 or 9, of a simulated drive."""
    commutation_angle: bool = False
    """Mode 11 with the commutation angle 0x60EA."""
    pdo: bool = False
    """Live quantities as process data."""
    recorder: Recording = "none"
    """``none``, or how it is read: one of :data:`~pmsmtool.drive_maps.recorder_map.Recording`."""
    injection: Injecting = "none"
    """``none``, ``current`` or ``voltage`` set-points for d and q."""
    averages: bool = False
    """Window averages inside the drive, and a voltage whose acting period is known."""


@dataclass(frozen=True, slots=True)
class DriveMap:
    """All cells of one drive family."""

    name: str
    """Family name."""
    vendor: int
    product: int
    """Identity 0x1018:01, 02 a drive must show before anything is written."""
    cells: Mapping[str, Cell]
    """By catalogue name, in catalogue order."""
    tables: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    """DOMAIN objects of the look-up table; empty where the drive has none. Mapping of str to (index, sub)."""
    staging: bool = False
    """Whether the drive takes a whole set at once (objects 0x2000, 0x2001 of the reference drive)."""
    more_products: tuple[int, ...] = ()
    """Further product codes of the family."""
    capabilities: Capabilities = Capabilities()
    """What it can do besides."""
    signals: Mapping[str, SignalCell] = field(default_factory=dict)
    """Live quantities and references, by the names of :data:`SIGNALS`."""
    motion: Mapping[str, MotionObject] = field(default_factory=dict)
    """The maker's own objects where motion needs what CiA 402 leaves optional."""
    recorder: RecorderMap = field(default_factory=RecorderMap)
    """What its recorder can be told to record, where that is not said by ``signals``."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """What is not mapped and why, by catalogue or signal name."""
    sources: Mapping[str, str] = field(default_factory=dict)
    """Where the facts come from."""
    vendor_tuning: VendorTuning | None = None
    """How the drive's own identification is started and read."""
    identity: IdentityRows = field(default_factory=IdentityRows)
    """What beyond vendor and product tells whether a drive is the map's."""
    whole: DriveMap | None = None
    """The map of the file, where this one is without rows that a drive lacks."""

    @property
    def signature(self) -> int:
        """Layout signature of the family's parameter set, 0 where it has none."""
        return layout_signature() if self.staging else 0

    def is_for(self, vendor: int, product: int) -> bool:
        """Whether a drive of this identity belongs to the family."""
        return vendor == self.vendor and product in (self.product, *self.more_products)

    @next_step("ask for values the drive can hold (`tune --map`, less bandwidth), or correct type and unit in its map")
    def encode(self, wanted: ParameterSet) -> dict[str, bytes]:
        """Return the bytes of every entry the drive has an object for, in the order they are written.

        Raises ConfigError: entries that do not fit; all of them.
        """
        encoded, refused = self._encoded(wanted)
        if refused:
            what = f"the drive cannot hold {counted(len(refused), 'value')}"
            wrong = [f"{name} -> {why}" for name, why in refused.items()]
            raise ConfigError(what, where=self.name, violations=wrong)
        for name, table in wanted.tables.items():
            if name in self.tables:
                encoded[name] = encode_table(name, table, wanted.values)
        return encoded

    def refused(self, wanted: ParameterSet) -> dict[str, str]:
        """Return which values of a set its objects do not hold, and why: type, limits, or what it is counted by."""
        return self._encoded(wanted)[1]

    def _encoded(self, wanted: ParameterSet) -> tuple[dict[str, bytes], dict[str, str]]:
        encoded, refused = {}, {}
        for name, value in wanted.values.items():
            if name in self.cells and self.writes(name, wanted.values):
                cell = self.cells[name]
                try:
                    encoded[name] = cell.encode(value, wanted.values)
                except ConfigError as error:
                    refused[name] = f"0x{cell.index:04X}:{cell.sub:02X}: {error.what}"
        return encoded, refused

    def limited(self, limits: Mapping[tuple[int, int], tuple[float, float]]) -> DriveMap:
        """Return the map with smallest and largest count of objects."""
        cells = {
            name: replace(cell, low=limits[at][0], high=limits[at][1])
            for name, cell in self.cells.items()
            if (at := (cell.index, cell.sub)) in limits
        }
        return replace(self, cells={**self.cells, **cells}, whole=self.whole or self)

    @next_step("compare type and size in the drive's map with its manual")
    def decode(self, found: Mapping[str, bytes], given: Mapping[str, float] | None = None) -> ParameterSet:
        """Return the set that a drive's bytes mean.

        ``given`` has values that the drive has no object for and others are counted by. Gains in amperes, or per
        increment, are left out where neither says what those are.
        """
        values: dict[str, float] = dict(given or {})
        # Gains first: an integral time is decoded with its gain.
        for cell in sorted(self.cells.values(), key=lambda cell: bool(cell.gain)):
            if cell.name in found and not (cell.gain not in values and self.scale_of(cell)):
                values[cell.name] = cell.decode(found[cell.name], values)
        tables = {n: decode_table(n, found[n], values) for n in TABLE_NAMES if found.get(n)}
        return ParameterSet(values, tables, name=self.name)

    def writes(self, name: str, values: Mapping[str, float]) -> bool:
        """Whether a value with a row is written: never what a drive scales by, and what rests on it only with it."""
        if name in OWN_SCALES:
            return False
        scale = self.scale_of(self.cells[name])
        return not scale or scale in values

    def scale_of(self, cell: Cell) -> str:
        """Return which of a drive's own scales a value is counted by, itself or through its gain; empty: none."""
        if cell.gain == INCREMENTS:
            return INCREMENTS
        amperes = cell.form == "current" or (cell.gain in self.cells and self.cells[cell.gain].form == "current")
        return TORQUE_PER_AMPERE if amperes else ""

    def without(self, lacking: Mapping[str, str]) -> DriveMap:
        """Return the map less rows, named with the reason, and less what acts only with one of them.

        That is what is counted by it, and the other gains of its loop: new ones do not fit the old ones beside them.
        """
        gone = dict(lacking)
        for name, cell in self.cells.items():
            beside = [other for other in lacking if _LOOP_GAIN.sub("", name) == _LOOP_GAIN.sub("", other)]
            for base in (cell.gain, self.scale_of(cell), *beside):
                if base in lacking and name not in lacking:
                    gone[name] = f"not without {base}, and {lacking[base]}"
        cells = {name: cell for name, cell in self.cells.items() if name not in gone}
        return replace(self, cells=cells, left_out={**self.left_out, **gone}, whole=self.whole or self)

    def missing(self, wanted: ParameterSet) -> tuple[str, ...]:
        """Return the entries of a set that this drive has no object for."""
        return tuple(self.not_written([*wanted.values, *wanted.tables]))

    def quantised(self, wanted: ParameterSet) -> ParameterSet:
        """Return what the drive will really hold of a set."""
        given = {name: wanted.values[name] for name in OWN_SCALES if name in wanted.values}
        return self.decode(self.encode(wanted), given)

    def address(self, name: str) -> tuple[int, int]:
        """Return index and sub-index of an entry."""
        if name in self.tables:
            return self.tables[name]
        cell = self.cells.get(name)
        if cell is not None:
            return cell.index, cell.sub
        address = address_in(name)
        if address is None:
            raise KeyError(name)
        return address

    def row_text(self, name: str) -> str:
        """Return a row as messages name it: family, name, object, type and where it is from."""
        row = self.cells.get(name) or self.signals.get(name) or self.motion[name]
        source = f"{row.source}: {self.sources[row.source]}" if row.source in self.sources else "no source stated"
        return f"{self.name} {name} 0x{row.index:04X}:{row.sub:02X} {row.wire} ({source})"

    def not_written(self, names: Iterable[str]) -> dict[str, str]:
        """Return the entries of a set that the map has no object for, and why."""
        names = list(names)
        lacking = (name for name in names if name not in self.cells and name not in self.tables)
        missing = {name: self.left_out.get(name, f"the map {self.name!r} has no row for it") for name in lacking}
        scales = {name: self.scale_of(self.cells[name]) for name in names if name in self.cells}
        return missing | {name: NOT_ALONE[scale] for name, scale in scales.items() if scale and scale not in names}

    @property
    def scales(self) -> bool:
        """Whether any value goes through the map; otherwise objects go by their addresses, byte for byte."""
        return bool(self.cells or self.tables)


def address_in(name: str) -> tuple[int, int] | None:
    """Return index and sub-index with which a name begins (``0x3001:02 Output current limit``), None without."""
    found = _ADDRESS.match(name)
    return None if found is None else (int(found[1], 16), int(found[2], 16))


SIGNALS: dict[str, str] = {
    "position_rad": "angle",
    "omega_M_rad_s": "angular speed",
    "torque_nm": "torque",
    "i_q_a": "current",
    "i_d_a": "current",
    "i_q_ref_a": "current",
    "asked_u_q": "ratio",
    "u_q_v": "voltage",
    "u_d_v": "voltage",
    "U_dc_v": "voltage",
    "target_torque_nm": "torque",
    "target_omega_M_rad_s": "angular speed",
}
"""Live quantities and references a map may name, with their dimension; mechanical angles and speeds."""

REFERENCE_CAPABILITIES = Capabilities(
    torque_mode=True, velocity_mode=True, pdo=True, recorder="domain", injection="voltage", averages=True
)
REFERENCE_SIGNALS = {
    "omega_M_rad_s": SignalCell(0x606C, 0, "INTEGER32", "mrpm"),
    "torque_nm": SignalCell(0x6077, 0, "INTEGER16", "permille of 0x6076"),
    "i_q_a": SignalCell(0x2070, 2, "REAL32", "A peak"),
    "i_d_a": SignalCell(0x2070, 1, "REAL32", "A peak"),
    "u_q_v": SignalCell(0x2070, 6, "REAL32", "V"),
    "u_d_v": SignalCell(0x2070, 5, "REAL32", "V"),
    "U_dc_v": SignalCell(0x2070, 8, "REAL32", "V"),
    "target_torque_nm": SignalCell(0x6071, 0, "INTEGER16", "permille of 0x6076"),
    "target_omega_M_rad_s": SignalCell(0x60FF, 0, "INTEGER32", "mrpm"),
}


def reference_map() -> DriveMap:
    """Return the map of the reference drive, which is the parameter catalogue itself."""
    cells = {row.name: Cell(row.name, row.index, row.sub, row.wire, unit=as_peak(row.unit)) for row in CATALOGUE}
    return DriveMap(
        "pmsmsim", REFERENCE_VENDOR, REFERENCE_PRODUCT, cells, REFERENCE_TABLES, staging=True,
        capabilities=REFERENCE_CAPABILITIES, signals=REFERENCE_SIGNALS,
    )  # fmt: skip
