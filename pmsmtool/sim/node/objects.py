# SPDX-License-Identifier: MIT
"""The rows of the simulated drive's object dictionary: its own table plus the parameter catalogue.

``firmware-params/pmsmsim/objects.csv`` holds everything that is not a parameter; every row of ``params/catalogue.py``
becomes an object too. Both the running node and its EDS are built from :func:`object_rows`.

Columns: ``index`` and ``sub`` hexadecimal; ``key``, by which the program names the object; ``type`` (``ARRAY`` and
``RECORD`` head a group, with 8 they have a writable sub 0); ``access``; ``pdo`` T mappable for sending, R for receiving
too, 0 neither; ``default``, ``low``, ``high``; ``store`` y: kept by 0x1010.

``python -m pmsmtool.sim.node.objects`` rewrites ``firmware-params/pmsmsim/pmsmsim.eds`` (CiA 306-1) and, beside it,
``map.toml``, the drive's map as any other drive would need one; neither carries a date.
"""

from __future__ import annotations

import csv
import math
import struct
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from pmsmtool.data_types import BY_SHORT, SHORT, DataType
from pmsmtool.drive_maps.drive_map import reference_map
from pmsmtool.drive_maps.drive_map_file import dump_drive_map
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
    pdo: str = "0"
    unit: str = ""
    default: str = ""
    low: float | None = None
    high: float | None = None
    stored: bool = False
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
            row = replace(row, default=str(highest[row.index]))
        filled[row.index, row.sub] = row
    for index, sub in filled:
        if (index, 0) not in filled:
            raise ValueError(f"{path}: object 0x{index:04X}:{sub:02X} has no sub-index 0")
    return tuple(filled[key] for key in sorted(filled))


FILE_NAME = "pmsmsim.eds"
MAP_NAME = "map.toml"
_VAR, _DOMAIN, _ARRAY, _RECORD = 0x7, 0x2, 0x8, 0x9
_MANDATORY = (0x1000, 0x1001, 0x1018)
_BAUD_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)


def eds_text() -> str:
    """Return the data sheet of the simulated drive."""
    rows = object_rows()
    return "\n".join([*_file_info(), *_device_info(rows), *_object_lists(rows), *_objects(rows)]) + "\n"


def _file_info() -> Iterator[str]:
    yield from ("[FileInfo]", f"FileName={FILE_NAME}", "FileVersion=1", "FileRevision=0", "EDSVersion=4.0")
    yield from ("Description=Simulated PMSM drive of pmsmtool", "CreatedBy=pmsmtool", "ModifiedBy=pmsmtool", "")


def _device_info(rows: Sequence[ObjectRow]) -> Iterator[str]:
    by_key = {row.key: row.default for row in rows}
    yield from ("[DeviceInfo]", "VendorName=pmsmtool", f"VendorNumber={by_key['identity.vendor']}")
    yield from (f"ProductName={by_key['device.name']}", f"ProductNumber={by_key['identity.product']}")
    yield f"RevisionNumber={by_key['identity.revision']}"
    for rate in _BAUD_RATES:
        yield f"BaudRate_{rate}=1"
    yield from ("SimpleBootUpMaster=0", "SimpleBootUpSlave=1", "Granularity=8", "DynamicChannelsSupported=0")
    yield from ("GroupMessaging=0", "NrOfRXPDO=4", "NrOfTXPDO=4", "LSS_Supported=1", "")
    yield "[DummyUsage]"
    for code in range(1, 8):
        yield f"Dummy{code:04X}=0"
    yield from ("", "[Comments]", "Lines=0", "")


def _object_lists(rows: Sequence[ObjectRow]) -> Iterator[str]:
    indices = sorted({row.index for row in rows})
    groups = {
        "MandatoryObjects": [index for index in indices if index in _MANDATORY],
        "OptionalObjects": [index for index in indices if index not in _MANDATORY and not 0x2000 <= index < 0x6000],
        "ManufacturerObjects": [index for index in indices if 0x2000 <= index < 0x6000],
    }
    for name, members in groups.items():
        yield from (f"[{name}]", f"SupportedObjects={len(members)}")
        for number, index in enumerate(members, 1):
            yield f"{number}=0x{index:04X}"
        yield ""


def _objects(rows: Sequence[ObjectRow]) -> Iterator[str]:
    for row in rows:
        if row.container:
            members = sum(other.index == row.index for other in rows)
            kind = _ARRAY if row.container == "ARRAY" else _RECORD
            yield from (f"[{row.index:04X}]", f"ParameterName={row.name}", f"ObjectType=0x{kind:X}")
            yield from (f"SubNumber={members}", "")
            yield from _variable(f"{row.index:04X}sub0", row, "Highest sub-index supported")
        else:
            alone = row.sub == 0
            yield from _variable(f"{row.index:04X}" if alone else f"{row.index:04X}sub{row.sub:X}", row, row.name)


def _variable(section: str, row: ObjectRow, name: str) -> Iterator[str]:
    kind = _DOMAIN if row.type == "DOMAIN" else _VAR
    access = "rww" if row.pdo == "R" else row.access
    yield from (f"[{section}]", f"ParameterName={name}", f"ObjectType=0x{kind:X}")
    yield from (f"DataType=0x{row.data_type.code:04X}", f"AccessType={access}")
    if row.type != "DOMAIN":
        yield f"DefaultValue={row.default}"
    if not row.container:
        yield from _limits(row)
    yield from (f"PDOMapping={int(row.pdo in ('T', 'R'))}", "")


def _limits(row: ObjectRow) -> Iterator[str]:
    for label, bound in (("LowLimit", row.low), ("HighLimit", row.high)):
        if bound is not None:
            yield f"{label}={bound:.9g}" if row.data_type.is_float else f"{label}={_integer(row, int(bound))}"


def _integer(row: ObjectRow, bound: int) -> str:
    """Return an integer limit; negative ones as two's complement, which every reader understands."""
    return f"{bound}" if bound >= 0 else f"0x{bound & (1 << 8 * row.data_type.size) - 1:X}"


def write_files() -> tuple[str, str]:
    """Write data sheet and map beside the object table and return their paths."""
    folder = data_folder("firmware-params") / "pmsmsim"
    texts = {FILE_NAME: eds_text(), MAP_NAME: dump_drive_map(reference_map())}
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="ascii", newline="\n")
    return str(folder / FILE_NAME), str(folder / MAP_NAME)


if __name__ == "__main__":
    sys.stdout.write("\n".join(write_files()) + "\n")
