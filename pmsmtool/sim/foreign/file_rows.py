# SPDX-License-Identifier: MIT
"""The objects of a maker's drive as its file lists them: an EDS, a DCF, or a table of such rows.

What the file lacks does not exist on the simulated drive. Added is only what CiA 301 and CiA 402 make mandatory for the
modes that the file announces, and the number of entries of a record; each is ``assumed``, and so is every limit that
contradicts the standard.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from pmsmtool.data_types import BY_SHORT
from pmsmtool.drive_maps.eds import NODE_ID_WORD, Eds, decode, parse_eds, parse_integer, parse_real, without_remark
from pmsmtool.errors import ConfigError
from pmsmtool.files import read_bytes
from pmsmtool.sim.node.objects import ObjectRow, object_rows

FAMILY_MARK = "#"
"""Between the path of a table and the family whose rows are meant: ``objects.csv#maker``."""
COLUMNS = ("family", "index", "sub", "name", "type", "access", "default_or_stored", "low", "high")
"""Columns a table needs."""
_KEPT_AS = {"BOOL": "U8", "OSTR": "VSTR", "USTR": "VSTR"}
_LONG = {kind.name: _KEPT_AS.get(short, short) for short, kind in BY_SHORT.items()}
_CODES = {kind.code: _KEPT_AS.get(short, short) for short, kind in BY_SHORT.items()}
"""CiA 301 data types by number and by name."""
_ACCESS = {"ro": "ro", "const": "const", "wo": "wo", "rw": "rw", "rwr": "rw", "rww": "rw"}
MAPPINGS = frozenset((*range(0x1600, 0x1800), *range(0x1A00, 0x1C00)))
"""Mapping of the PDOs: its number of entries is written when it changes (CiA 301, 7.5.2.36 and 7.5.2.38)."""
FIRST_OBJECT = 0x1000
"""Below are the data types."""
_MAPPED_AS = {8: ("U8", "0"), 16: ("U16", "0"), 32: ("U32", "0"), 64: ("U64", "0")}
CONSUMER_LIMIT = 0x7FFFFF
"""Largest entry of 0x1016: a node id above 16 bits of time (CiA 301); files with 65535 leave no room for the node."""

SHOWN = 3
"""Odd lines of a file that are told."""
NODE_ID, LAST_NODE_ID = 1, 127
"""Of the drive that the file describes, where a value depends on it; the largest one."""
LARGEST_BINARY32 = 3.4e38

MANDATORY: tuple[tuple[int, int, str, str, str], ...] = (
    (0x1000, 0, "U32", "const", "0x00020192"),
    (0x1001, 0, "U8", "ro", "0"),
    (0x1018, 1, "U32", "ro", "0"),
    (0x6040, 0, "U16", "rw", "0"),
    (0x6041, 0, "U16", "ro", "0"),
    (0x6060, 0, "I8", "rw", "0"),
    (0x6061, 0, "I8", "ro", "0"),
    (0x6502, 0, "U32", "ro", ""),
)
"""Of every drive (CiA 301, 7.5.2; CiA 402-2, 8 and 10)."""
BY_MODE: Mapping[int, tuple[tuple[int, int, str, str, str], ...]] = {
    1: ((0x607A, 0, "I32", "rw", "0"), (0x6081, 0, "U32", "rw", "0"), (0x6083, 0, "U32", "rw", "0")),
    3: ((0x606C, 0, "I32", "ro", "0"), (0x60FF, 0, "I32", "rw", "0")),
    4: ((0x6071, 0, "I16", "rw", "0"),),
    8: ((0x607A, 0, "I32", "rw", "0"), (0x6064, 0, "I32", "ro", "0")),
    9: ((0x60FF, 0, "I32", "rw", "0"),),
    10: ((0x6071, 0, "I16", "rw", "0"),),
}
"""Mandatory in a mode of operation (CiA 402-2, its table of objects per mode)."""
NOT_KEPT = frozenset({0x1003, 0x1010, 0x1011, 0x1013, 0x1020, 0x6040, 0x6071, 0x607A, 0x60FF, 0x60FE})
"""Commands and set points; every other object that can be written outlives a reset once it is stored (assumed)."""
DRIVE_PROFILE, PROFILES = 402, range(401, 500)
"""A file that states no CiA profile, and has control and status word, is that of a drive all the same."""


@dataclass(frozen=True, slots=True)
class MakersObjects:
    """What a file says a drive has."""

    name: str
    """Of the file or the family."""
    rows: Mapping[tuple[int, int], ObjectRow]
    """Every object, sorted. Mapping of (index, sub) to ObjectRow."""
    assumed: tuple[str, ...]
    """What is not the file's, one line each."""
    odd: tuple[str, ...] = ()
    """Lines of an EDS or DCF that had to be interpreted, the first few, one line each."""

    def stored(self, index: int, sub: int = 0) -> int:
        """Return the whole number that the file says an object holds; 0 where it says none."""
        row = self.rows.get((index, sub))
        return 0 if row is None or not row.data_type.is_integer else int(row.default_number(NODE_ID))

    def has(self, *addresses: tuple[int, int]) -> bool:
        """Whether all the objects are there."""
        return all(address in self.rows for address in addresses)


def read_makers_objects(where: str) -> MakersObjects:
    """Return the objects of an EDS, a DCF, or of one family of a table (``FILE.csv#FAMILY``).

    Raises ConfigError: the file cannot be read, holds no objects, or is no file of a drive (CiA 402).
    """
    path, _ = _path_and_family(where)
    hint = "give the EDS or DCF that the drive's maker offers, or TABLE.csv#FAMILY"
    return _read(read_bytes(path, hint=hint), where)


@lru_cache(maxsize=2)
def _read(data: bytes, where: str) -> MakersObjects:
    """Keep the last files: one command asks for the same one several times, and 12 000 objects take seconds."""
    path, family = _path_and_family(where)
    odd: tuple[str, ...] = ()
    if path.suffix.lower() == ".csv":
        found, label = dict(_of_table(data, path, family)), family
    else:
        eds = parse_eds(data, str(path), NODE_ID)
        found, label, odd = dict(_of_eds(data, eds)), path.stem, _first_of(eds.warnings, f"{path}:")
    has_words = all((word, 0) in found and (word, 1) not in found for word in (0x6040, 0x6041))  # no records
    stated = MakersObjects(label, found, ()).stored(0x1000) & 0xFFFF  # by the file itself
    rows, assumed, corrected = _completed(found)
    if stated != DRIVE_PROFILE and (stated in PROFILES or not has_words):
        named = f"of a device of profile {stated}" if stated else "of a device without control and status word (0x6040)"
        raise ConfigError(
            f"the file is {named}, not of a drive (CiA 402)",
            where=where,
            likely="a controller of another profile, or a master, which is neither simulated nor moved",
            hint="give the EDS or DCF of a drive",
        )
    return MakersObjects(label, rows, (*assumed, *corrected), (*odd, *corrected))


def _first_of(warnings: tuple[str, ...], place: str) -> tuple[str, ...]:
    told = [f"line {text.removeprefix(place)}" for text in warnings[:SHOWN]]
    return (*told, *([f"and {len(warnings) - SHOWN} more of that kind"] if len(warnings) > SHOWN else []))


def _path_and_family(where: str) -> tuple[Path, str]:
    """Return the file and the family of a table; the name of a data sheet may have the mark in it, too."""
    name, _, family = where.partition(FAMILY_MARK)
    return (Path(name), family) if name.lower().endswith(".csv") else (Path(where), "")


def _of_eds(data: bytes, eds: Eds) -> Iterator[tuple[tuple[int, int], ObjectRow]]:
    identity = {1: eds.vendor, 2: eds.product, 3: eds.revision}
    read = _as_canopen_reads(decode(data)[0])
    for (index, sub), entry in eds.objects.items():
        ours = entry.data_type, entry.access, entry.value or entry.default
        data_type, access, value = read.get((index, sub), ours)
        if access not in _ACCESS:  # ``canopen`` keeps "Read/Write" as it is
            access = entry.access
        if index == 0x1018 and not value and identity.get(sub) is not None:
            value = str(identity[sub])
        kind = _CODES.get(data_type, "DOMAIN")
        row = _row(index, sub, entry.name, kind, access, value, entry.low, entry.high)
        yield (index, sub), row if entry.copied else replace(row, copied=False)


def _as_canopen_reads(text: str) -> dict[tuple[int, int], tuple[int, str, str]]:
    """Return type, access and value of every object as the package ``canopen`` reads them; none of a file it rejects.

    A simulated drive that was built with the tool's own reader alone would share its mistakes.
    """
    from canopen.objectdictionary import ODVariable
    from canopen.objectdictionary.eds import import_eds

    try:
        dictionary = import_eds(io.StringIO(text), NODE_ID)  # type: ignore[no-untyped-call]
    except Exception:  # no family of errors: KeyError, ValueError, those of configparser
        return {}
    found = {}
    for entry in dictionary.values():
        for variable in (entry,) if isinstance(entry, ODVariable) else entry.values():
            value = getattr(variable, "value_raw", "") or getattr(variable, "default_raw", "")
            found[variable.index, variable.subindex] = (variable.data_type or 0, variable.access_type, value)
    return found


def _of_table(data: bytes, path: Path, family: str) -> Iterator[tuple[tuple[int, int], ObjectRow]]:
    table = csv.DictReader(io.StringIO(decode(data)[0], newline=""))
    if not set(COLUMNS) <= set(table.fieldnames or ()):
        raise ConfigError("not a table of objects", where=str(path), hint=f"it needs the columns {', '.join(COLUMNS)}")
    families: dict[str, None] = {}
    for fields in table:
        families[fields["family"]] = None
        if fields["family"] != family:
            continue
        kind = _LONG.get(fields["type"].strip().upper(), "DOMAIN")
        index, sub = int(fields["index"], 16), int(fields["sub"], 0)
        low, high = (_limit(fields[key], kind) for key in ("low", "high"))
        value = fields["default_or_stored"]
        yield (index, sub), _row(index, sub, fields["name"], kind, fields["access"].lower(), value, low, high)
    if family not in families:
        raise ConfigError(
            f"the table has no rows of family {family!r}", where=str(path),
            hint=f"write FILE{FAMILY_MARK}FAMILY with one of {', '.join(families)}",
        )  # fmt: skip


def _limit(text: str, kind: str) -> int | float | None:
    try:
        is_float, code = BY_SHORT[kind].is_float, BY_SHORT[kind].code
        value = parse_real(text, code) if is_float else parse_integer(text, NODE_ID) if text.strip() else None
    except ValueError:
        return None
    bits = 8 * BY_SHORT[kind].size
    if kind.startswith("I") and value is not None and (1 << bits - 1) <= value < (1 << bits):
        return value - (1 << bits)  # a negative limit written in hex
    return value


def _row(
    index: int, sub: int, name: str, kind: str, access: str, value: str, low: float | None, high: float | None
) -> ObjectRow:
    access = _ACCESS.get(access, "ro")
    if low is not None and high is not None and not low < high and access == "rw":
        low = high = None if low > high or low == 0 else low  # the wrong way round, or both 0: it says nothing
    kept = access == "rw" and index not in NOT_KEPT
    mapped = "R" if access in ("rw", "wo") else "T"  # the files' own word for it is often missing
    return ObjectRow(index, sub, "", name, kind, access, mapped, "", _value(value, kind), low, high, kept)


def _value(text: str, kind: str) -> str:
    """Return a stored value as an object row keeps it: a number that fits its type, or ASCII; blank stays blank."""
    code = BY_SHORT[kind]
    if not code.letter:
        return text.encode("ascii", "replace").decode("ascii")
    text = without_remark(text)
    if not text:
        return "0" if code.is_float else ""  # blank: the file does not say
    try:
        if code.is_float:
            number = parse_real(text, code.code)
            return str(number) if abs(number) <= LARGEST_BINARY32 else "0"
        value = parse_integer(text, NODE_ID)
    except ValueError:
        return "0" if code.is_float else ""  # the reader has told it
    bits = 8 * code.size
    if NODE_ID_WORD.search(text) and NODE_ID <= value and value + LAST_NODE_ID < 1 << bits - code.is_signed:
        return f"$NODEID+{value - NODE_ID:#x}"
    value %= 1 << bits
    return str(value - (1 << bits) if kind.startswith("I") and value >> bits - 1 else value)


def _mapped_words(found: Mapping[tuple[int, int], ObjectRow]) -> list[int]:
    """Return what the mappings of the PDOs name, but dummies: no file has them as objects (CiA 301, 7.5.2.36)."""
    words = [
        int(row.default_number(NODE_ID))
        for (index, sub), row in found.items()
        if index in MAPPINGS and sub and row.data_type.is_integer
    ]
    return [word for word in words if word >> 16 >= FIRST_OBJECT]


def _named(found: Mapping[tuple[int, int], ObjectRow], index: int) -> int:
    """Return how many entries of a PDO's mapping name an object, up to the first that names none."""
    count = 0
    while row := found.get((index, count + 1)):
        if not row.data_type.is_integer or not row.default_number(NODE_ID):
            break
        count += 1
    return count


def _completed(
    found: dict[tuple[int, int], ObjectRow],
) -> tuple[dict[tuple[int, int], ObjectRow], list[str], list[str]]:
    """Add what the standards make mandatory; return it with what was added, and what was read in another way."""
    assumed: list[str] = []
    odd: list[str] = []

    def add(items: Iterable[tuple[int, int, str, str, str]], why: str) -> None:
        for index, sub, kind, access, value in items:
            if (index, sub) not in found:
                found[index, sub] = _row(index, sub, "mandatory", kind, access, value, None, None)
                assumed.append(f"0x{index:04X}:{sub:02X} {why}")

    for standard in object_rows():  # by the types that the reference drive has of CiA 301 and CiA 402
        at = standard.index, standard.sub
        row = found.get(at) if not 0x2000 <= standard.index < 0x6000 else None
        if row is not None and row.type == "DOMAIN" and standard.data_type.is_integer:
            found[at] = replace(row, type=standard.type, default=_value(row.default, standard.type))
            assumed.append(f"0x{at[0]:04X}:{at[1]:02X} is {standard.type} by the standard: the file has no type for it")
    for index, sub, kind, access, value in MANDATORY:
        row = found.get((index, sub))
        if row is None:
            continue
        if not row.data_type.is_integer or row.data_type.size < BY_SHORT[kind].size:
            stored = row.default if row.data_type.is_integer else value
            odd.append(f"0x{index:04X}:{sub:02X} is {row.type} in the file, read as {kind}: so the standard has it")
            row = replace(row, type=kind, default=_value(stored, kind), low=None, high=None)
        if (access == "rw") > (row.access in ("rw", "wo")) or (access != "rw" and row.access == "wo"):
            odd.append(f"0x{index:04X}:{sub:02X} is {row.access} in the file, read as {access}: so the standard has it")
            row = replace(row, access=access)
        found[index, sub] = row
    add(MANDATORY, "mandatory")
    announced = int(found[0x6502, 0].default_number(NODE_ID))
    for mode, items in BY_MODE.items():
        if announced >> mode - 1 & 1:
            add(items, f"mandatory in mode {mode}")
    for word in _mapped_words(found):
        kind, value = _MAPPED_AS.get(word & 0xFF, ("VSTR", ""))
        add([(word >> 16, word >> 8 & 0xFF, kind, "ro", value)], "named by the mapping of a PDO")
    for index, highest in sorted(dict(sorted(at for at in found if at[1])).items()):
        if index in MAPPINGS:
            add([(index, 0, "U8", "rw", str(_named(found, index)))], "number of entries")
        add([(index, 0, "U8", "const", str(highest))], "number of entries")
    for (index, sub), row in found.items():
        if index == 0x1016 and sub and row.high is not None and row.high < CONSUMER_LIMIT:
            found[index, sub] = replace(row, high=None)
            assumed.append(f"0x1016:{sub:02X} takes a node id, for which the file's limit leaves no room")
    return dict(sorted(found.items())), assumed, odd
