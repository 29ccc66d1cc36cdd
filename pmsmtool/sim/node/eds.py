# SPDX-License-Identifier: MIT
"""The simulated drive's electronic data sheet (CiA 306-1), generated from its object table and the catalogue.

``python -m pmsmtool.sim.node.eds`` rewrites ``firmware-params/pmsmsim/pmsmsim.eds`` and, beside it, ``map.toml``, the
drive's map as any other drive would need one (``--map``); neither carries a date, the same rows give the same bytes.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence

from pmsmtool.drive_maps.drive_map import reference_map
from pmsmtool.drive_maps.drive_map_file import dump_drive_map
from pmsmtool.files import data_folder
from pmsmtool.sim.node.objects import ObjectRow, object_rows

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
