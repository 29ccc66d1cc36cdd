# SPDX-License-Identifier: MIT
"""Read electronic data sheets as they are: any encoding, loose spelling, vendor keys (CiA 306-1).

What is unambiguous is accepted with a warning that names file and line; what cannot be understood is left out of the
object list with a warning, or refused when nothing usable remains. Nothing raises anything but ``ConfigError``.
"""

from __future__ import annotations

import codecs
import re
import struct
from collections.abc import Container, Iterator
from dataclasses import dataclass, field, replace

from pmsmtool.data_types import DATA_TYPES, codes
from pmsmtool.errors import ConfigError

UNSIGNED8, REAL32, REAL64, VISIBLE_STRING, OCTET_STRING, UNICODE_STRING, DOMAIN = codes(
    "UNSIGNED8", "REAL32", "REAL64", "VISIBLE_STRING", "OCTET_STRING", "UNICODE_STRING", "DOMAIN"
)
INTEGER_BITS = {row.code: 8 * row.size for row in DATA_TYPES.values() if row.is_integer}
NUMBERS = frozenset({*INTEGER_BITS, REAL32, REAL64})
SIGNED = frozenset(row.code for row in DATA_TYPES.values() if row.is_signed)
_VAR, _DOMAIN_OBJECT = 0x07, 0x02
_NOT_COPIED = 0b11
_HAVE_SUBS: Container[object] = frozenset({0x06, 0x08, 0x09})  # DEFSTRUCT, ARRAY, RECORD

_SECTION = re.compile(r"\s*\[([^\]=]*)(?:\]\s*(?:(?:;|#|//).*|[^=]*))?$")
"""Whatever follows on the line: keys behind a section that is not seen would become those of the one before."""
_OBJECT = re.compile(r"(?:0x)?([0-9A-F]{1,4})(?:[ _]*sub[ _]*([0-9A-F]{1,2}))?\Z", re.IGNORECASE)
_REMARK = re.compile(r";|//|(?<!16)#|#(?![0-9A-Fa-f])")
"""But ``16#1F`` is the number 0x1F, as IEC 61131-3 writes it."""
_HEX = re.compile(r"(-?)(?:0x|16#)([0-9a-f]+)u?l{0,2}|(-?)([0-9][0-9a-f]*)h", re.IGNORECASE)
_WHOLE = re.compile(r"([+-]?[0-9]+)\.0*")
"""A whole number with a decimal point behind it."""
LAST_NODE_ID = 127
OCTAL = re.compile("0[0-7]+")
"""As C writes it; makers rather fill decimal numbers up with zeros."""
NODE_ID_WORD = re.compile(r"\$(?:MY_)?NODE_?ID", re.IGNORECASE)
"""Name of the node id in a number; one maker's files spell it otherwise."""
_ACCESS = frozenset({"ro", "wo", "rw", "rwr", "rww", "const"})
_WORDED = {"readwrite": "rw", "read": "ro", "readonly": "ro", "write": "wo", "writeonly": "wo", "constant": "const",
           "r": "ro", "w": "wo"}  # fmt: skip
_INT, _LONG = re.compile(r"(U?)INT(8|16|32|64)\Z"), {"": "INTEGER", "U": "UNSIGNED"}
"""Types as programs name them."""
_NOT_LETTERS = re.compile(r"[^a-z]")
OTHER_FILES = {
    b"<": "a device description in XML (XDD, XDC, ESI), or a page of the web, is no EDS or DCF",
    b"PK": "the file is an archive: the EDS or DCF is in it",
    b"%PDF": "the file is a document",
}
"""What a file is that begins so and holds no object of an EDS."""
COMMISSIONING = ("devicecomissioning", "devicecommissioning")
"""The standard's own spelling and the right one."""


@dataclass(frozen=True, slots=True)
class EdsObject:
    """One entry of the dictionary as the file describes it; numbers are None where the file has none.

    ``copied``: neither "refuse write on download" nor "refuse read on scan" (``ObjFlags``, CiA 306-1).
    """

    index: int
    sub: int
    name: str
    data_type: int
    access: str
    low: int | float | None
    high: int | float | None
    default: str
    value: str
    line: int
    copied: bool = True


@dataclass(frozen=True, slots=True)
class Eds:
    """A data sheet: objects by (index, sub), the device's identity as far as stated, and what was odd."""

    objects: dict[tuple[int, int], EdsObject]
    vendor: int | None
    product: int | None
    revision: int | None
    product_name: str
    node_id: int | None
    encoding: str
    warnings: tuple[str, ...]


@dataclass(slots=True)
class Section:
    """One section of the text: its name, where it stands, and its keys (lower case) with value and line."""

    name: str
    line: int
    entries: dict[str, tuple[str, int]] = field(default_factory=dict)

    def get(self, key: str) -> str:
        """Return the value of a key, empty when there is none."""
        return self.entries.get(key, ("", 0))[0]


def decode(data: bytes) -> tuple[str, str]:
    """Return text and the name of the encoding that fits: UTF-8 (with or without mark), UTF-16, cp1252, Latin-1."""
    wide = _wide(data)
    if wide:
        return data.decode(wide, "replace"), wide
    marked = data.startswith(codecs.BOM_UTF8)
    for encoding in ("utf-8-sig" if marked else "utf-8", "cp1252"):
        try:
            return data.decode(encoding), encoding
        except UnicodeDecodeError:
            continue
    return data.decode("latin-1"), "latin-1"


def _wide(data: bytes) -> str:
    """Return the encoding of a text of 16 bits a character, empty for others; data sheets begin with ASCII."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    return {b"\1\0": "utf-16-le", b"\0\1": "utf-16-be"}.get(bytes(map(bool, data[:2])), "")


def without_remark(text: str) -> str:
    """Return a number or a word without quotes and without what follows it behind ``;``, ``#`` or ``//``."""
    return _REMARK.split(text, maxsplit=1)[0].strip(" \t\"'")


def parse_integer(text: str, node_id: int | None = None) -> int:
    """Return an integer as data sheets write it: decimal, hex, with leading zeros, ``$NODEID+0x600``, with a remark.

    Also as other tools do: ``16#1F``, ``1Fh``, ``0x1Full``, ``31.0``, ``(0x600 + $NODEID)``.

    Raises ValueError: if it is none of these.
    """
    total = 0
    for part in without_remark(text).replace(" ", "").replace("\t", "").strip("()").split("+"):
        if NODE_ID_WORD.fullmatch(part):
            if node_id is None:
                raise ValueError("depends on the node id")
            total += node_id
        elif found := _HEX.fullmatch(part):
            total += int("".join(filter(None, found.groups())), 16)
        else:
            whole = _WHOLE.fullmatch(part)
            part = part if whole is None else whole.group(1)
            total += int(part.lstrip("0") or "0") if not part.startswith("-") else int(part)
    return total


def parse_real(text: str, data_type: int) -> float:
    """Return a number of a real type: as such, or as some makers write it, the hex word of its bits (IEC 60559).

    Raises ValueError: if it is neither.
    """
    text = without_remark(text)
    size, letter = (4, "<f") if data_type == REAL32 else (8, "<d")
    if not text.lower().startswith("0x"):
        return float(text)
    try:
        (value,) = struct.unpack(letter, int(text, 16).to_bytes(size, "little"))
    except OverflowError as error:
        raise ValueError(f"{text} does not fit {8 * size} bits") from error
    return float(value)


def parse_eds(data: bytes, where: str = "EDS", node_id: int | None = None) -> Eds:
    """Return the data sheet. Raises ConfigError: if the file has no object at all.

    Parameters
    ----------
    data : bytes
        The file's bytes, EDS or DCF.
    where : str
        Name for messages.
    node_id : int, optional
        Value of ``$NODEID`` where the file does not state one.
    """
    text, encoding = decode(data)
    warnings: list[str] = []
    sections = _sections(text, where, warnings)
    info = sections.get("deviceinfo", Section("", 0))
    commissioning = next((sections[name] for name in COMMISSIONING if name in sections), Section("", 0))
    stated, line = commissioning.entries.get("nodeid", ("", 0))
    node = _number(stated, None, f"{where}:{line}: NodeID", warnings)
    if isinstance(node, int) and not 1 <= node <= LAST_NODE_ID:  # 255: none was given yet (CiA 305)
        warnings.append(f"{where}:{line}: NodeID {node} is none of 1..{LAST_NODE_ID}, left out")
        node = None
    node = node if isinstance(node, int) else node_id
    objects: dict[tuple[int, int], EdsObject] = {}
    heads: dict[int, Section] = {}
    records: set[int] = set()
    placed: dict[tuple[int, int | None], Section] = {}
    for section in sections.values():
        address = object_of(section.name)
        if address is not None:
            placed.setdefault(address, section)
        if address is not None and address[1] is None:
            heads[address[0]] = section
        elif address is not None and section.get("datatype"):
            records.add(address[0])
        elif address is None and section.get("datatype"):
            warnings.append(f"{where}:{section.line}: [{section.name}] has a DataType and names no object, left out")
    for section in sections.values():
        for entry in _objects_of(section, sections, heads, records, node, where, warnings):
            described = placed.get((entry.index, entry.sub), section)
            if described is section or not entry.sub:  # not by CompactSubObj what has a section of its own
                objects.setdefault((entry.index, entry.sub), entry)
    if not objects:
        likely = next(
            (what for mark, what in OTHER_FILES.items() if data.lstrip(b"\xef\xbb\xbf \r\n").startswith(mark)), ""
        )
        raise ConfigError(
            "no object dictionary entries",
            where=where,
            likely=likely or "this is not an EDS or DCF file",
            hint="give the file that the drive's vendor calls EDS or DCF",
            violations=[] if likely else warnings[:20],
        )

    def identity(key: str) -> int | None:
        text, line = info.entries.get(key, ("", 0))
        number = _number(text, None, f"{where}:{line}: [DeviceInfo] {key}", warnings)
        return number if isinstance(number, int) else None

    return Eds(
        dict(sorted(objects.items())),
        identity("vendornumber"),
        identity("productnumber"),
        identity("revisionnumber"),
        info.get("productname"),
        node,
        encoding,
        tuple(warnings),
    )


def sections_of(lines: list[str]) -> Iterator[tuple[int, str]]:
    """Yield (line index, lower-case section name) of every section header."""
    for number, line in enumerate(lines):
        found = _SECTION.match(line) if "[" in line else None
        if found:
            yield number, found.group(1).strip().lower()


def object_of(section: str) -> tuple[int, int | None] | None:
    """Return (index, sub) of an object section's name, sub None for the object itself, or None for others."""
    found = _OBJECT.match(section)
    if not found:
        return None
    return int(found.group(1), 16), None if found.group(2) is None else int(found.group(2), 16)


def _sections(text: str, where: str, warnings: list[str]) -> dict[str, Section]:
    lines = text.splitlines()
    starts = dict(sections_of(lines))
    sections: dict[str, Section] = {}
    current: Section | None = None
    for number, line in enumerate(lines):
        if number in starts:
            name = starts[number]
            if name in sections:
                warnings.append(f"{where}:{number + 1}: section [{name}] stands twice, merged")
            current = sections.setdefault(name, Section(name, number + 1))
            continue
        stripped = line.strip()
        if not stripped or stripped[0] in ";#":
            continue
        key, equals, value = stripped.partition("=")
        if not equals or current is None:
            warnings.append(f"{where}:{number + 1}: not understood: {stripped[:60]!r}")
            continue
        key = key.strip().lower()
        if key in current.entries and current.entries[key][0] != value.strip():
            warnings.append(f"{where}:{number + 1}: {key} stands twice in [{current.name}], the last one counts")
        current.entries[key] = (value.strip(), number + 1)
    return sections


def _objects_of(
    section: Section, sections: dict[str, Section], heads: dict[int, Section], records: Container[int],
    node: int | None, where: str, warnings: list[str],
) -> Iterator[EdsObject]:  # fmt: skip
    address = object_of(section.name)
    if address is None:
        return
    index, sub = address
    place = f"{where}:{section.line}: {index:04X}"
    kind = _number(section.get("objecttype"), None, f"{place} ObjectType", warnings)
    if sub is None and kind in _HAVE_SUBS:
        compact = _number(section.get("compactsubobj"), None, f"{place} CompactSubObj", warnings)
        if isinstance(compact, int) and compact > 0:
            yield from _compact(section, index, min(compact, 254), sections, node, place, warnings)
        return
    if sub is None and index in records:
        return  # the head of a record, whatever it calls itself
    head = heads.get(index)
    if head is None:
        warnings.append(f"{place}sub{sub:X}: its object has no section, accepted")
    elif sub is not None and head.get("datatype") and not section.get("datatype"):
        compound = _number(head.get("objecttype"), None, place, [])
        if index not in records and compound not in _HAVE_SUBS:
            return  # says nothing; the object itself is described
        if sub:
            section.entries["datatype"] = head.entries["datatype"]  # an array's, said once
    yield _entry(section, index, sub or 0, section.get("parametername"), kind, node, place, warnings)


def _compact(
    section: Section,
    index: int,
    count: int,
    sections: dict[str, Section],
    node: int | None,
    place: str,
    warnings: list[str],
) -> Iterator[EdsObject]:
    """Expand CompactSubObj: sub 0 is the count, subs 1..n share the object's description."""
    names = sections.get(f"{index:04x}name", Section("", 0))
    values = sections.get(f"{index:04x}value", Section("", 0))
    yield EdsObject(index, 0, "number of entries", UNSIGNED8, "ro", None, None, str(count), "", section.line)
    shared = _entry(section, index, 1, "", _VAR, node, place, warnings)
    for sub in range(1, count + 1):
        name = names.get(str(sub)) or f"{section.get('parametername')}{sub}"
        yield replace(shared, sub=sub, name=name, value=values.get(str(sub)))


def _entry(
    section: Section,
    index: int,
    sub: int,
    name: str,
    kind: int | float | None,
    node: int | None,
    place: str,
    warnings: list[str],
) -> EdsObject:
    named = without_remark(section.get("datatype")).upper()
    word = DATA_TYPES.get(_INT.sub(lambda found: f"{_LONG[found[1]]}{found[2]}", named))
    data_type = word.code if word else _number(section.get("datatype"), None, f"{place} DataType", warnings)
    if not isinstance(data_type, int):
        data_type = DOMAIN if kind == _DOMAIN_OBJECT else 0
        if data_type == 0:
            warnings.append(f"{place}sub{sub:X}: no DataType")
    access = _NOT_LETTERS.sub("", without_remark(section.get("accesstype")).lower())
    access = _WORDED.get(access, access)
    if access not in _ACCESS:
        warnings.append(f"{place}sub{sub:X}: AccessType {access or 'missing'}, taken as ro")
        access = "ro"
    low, high = (
        _number(section.get(key), data_type, f"{place}sub{sub:X} {key}", warnings, node)
        for key in ("lowlimit", "highlimit")
    )
    if low is not None and high is not None and low > high:
        warnings.append(f"{place}sub{sub:X}: LowLimit {low} is above HighLimit {high}, both left out")
        low = high = None
    for key in ("lowlimit", "highlimit", "defaultvalue", "parametervalue"):
        text = section.get(key)
        if data_type in INTEGER_BITS and OCTAL.fullmatch(text) and int(text) != int(text, 8):
            warnings.append(f"{place}sub{sub:X} {key}: {text} is taken for a decimal; an octal one is {int(text, 8)}")
        elif data_type in NUMBERS and key.endswith("value"):
            _number(text, data_type, f"{place}sub{sub:X} {key}", warnings, node)  # says what is no number
    flags = _number(section.get("objflags"), None, place, [])
    return EdsObject(
        index,
        sub,
        name,
        data_type,
        access,
        low,
        high,
        section.get("defaultvalue"),
        section.get("parametervalue"),
        section.line,
        not int(flags or 0) & _NOT_COPIED,
    )


def _number(
    text: str, data_type: int | None, place: str, warnings: list[str], node: int | None = None
) -> int | float | None:
    """Return a number, or None with a warning when it is none; empty, or a remark alone, is None without one."""
    if not without_remark(text):
        return None
    try:
        if data_type in (REAL32, REAL64):
            return parse_real(text, data_type)
        value = parse_integer(text, node)
    except ValueError as error:
        if "node id" not in str(error):
            warnings.append(f"{place}: {text[:40]!r} is not a number, left out")
        return None
    if data_type in SIGNED:
        bits = INTEGER_BITS[data_type]
        if value >= 1 << (bits - 1) and value < 1 << bits:  # a negative limit written in hex
            value -= 1 << bits
    return value
