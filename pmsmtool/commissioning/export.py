# SPDX-License-Identifier: MIT
"""A parameter set in the forms other programs take: DCF, concise DCF, C, CSV.

Every value goes through the drive's map, so the bytes in a file are the bytes ``flash-params`` would send. Same set,
same bytes: no date, no path, no user.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping

from pmsmtool.drive import objects
from pmsmtool.drive.parameters import SetCommand
from pmsmtool.drive_maps.dcf import Entry, new_dcf, write_concise
from pmsmtool.drive_maps.drive_map import DriveMap, reference_map
from pmsmtool.drive_maps.eds import parse_eds
from pmsmtool.drive_maps.map_tables import encode_table, look_up_words
from pmsmtool.drive_maps.sheet_check import contradictions, family_of_sheet, types_of, unnamed_sheet
from pmsmtool.errors import ConfigError
from pmsmtool.firmware.image import crc32, pack_image
from pmsmtool.params.catalogue import BY_NAME, CATALOGUE
from pmsmtool.params.parameter_set import ParameterSet, table_unit
from pmsmtool.plain_text import counted
from pmsmtool.resources import data_folder

CSV_HEAD = ("name", "value", "unit", "held", "object", "type", "bytes", "meaning", "not written because")

MOST_NAMED = 8
"""Rows that the refusal of another drive's file lists; they are all rows of a map where it is the wrong one."""


def checked(wanted: ParameterSet) -> ParameterSet:
    """Return the set, or raise ``ConfigError`` listing every value out of bounds."""
    violations = wanted.violations()
    if violations:
        raise ConfigError(
            "the parameter set cannot be exported",
            where=wanted.name,
            violations=violations,
            hint="`pmsmtool param help NAME` shows a parameter's bounds",
        )
    return wanted


def image_of(wanted: ParameterSet) -> bytes:
    """Return the packed image of a complete set (object 0x2001), look-up words included.

    Raises ConfigError: parameters are missing or out of bounds, or the tables do not fit their descriptor.
    """
    checked(wanted)
    tables = {name: encode_table(name, table, wanted.values) for name, table in wanted.tables.items()}
    return pack_image(wanted.values, look_up_words(tables))


def dcf_file(
    wanted: ParameterSet,
    *,
    drive_map: DriveMap | None = None,
    base: bytes | None = None,
    node_id: int = 1,
    where: str = "EDS",
) -> bytes:
    """Return a device configuration file (CiA 306-1).

    Raises ConfigError: values that do not fit, or objects the base does not describe.

    Parameters
    ----------
    wanted : ParameterSet
        What the drive shall hold; what its map does not know is left out.
    drive_map : DriveMap, optional
        The reference drive's when not given.
    base : bytes, optional
        EDS or DCF the values are laid into, every other byte kept; the EDS of the reference drive when not given.
    node_id : int
        Into the DeviceComissioning section when the base has none.
    where : str
        Name of the base for messages.
    """
    given, drive_map = drive_map is not None, drive_map or reference_map()
    if base is None:
        base = (data_folder("firmware-params") / drive_map.name / f"{drive_map.name}.eds").read_bytes()
    encoded = drive_map.encode(checked(wanted))
    rows = [name for name in encoded if name in drive_map.cells]
    sheet = parse_eds(base, where)
    wrong = contradictions(drive_map, types_of(sheet), rows)
    if wrong:
        more = len(wrong) - MOST_NAMED
        family = family_of_sheet(sheet)
        if family is None and not given:
            raise unnamed_sheet(sheet, where)
        other = family is not None and family.name != drive_map.name
        its = f"--map {family.name}" if family is not None and other else "a map of the drive with --map"
        raise ConfigError(
            f"the file contradicts {counted(len(wrong), 'row')} of the map {drive_map.name!r}",
            where=where, violations=[*wrong[:MOST_NAMED], *([f"and {more} more"] if more > 0 else [])],
            likely="the file belongs to another drive or firmware",
            hint=f"give the EDS of the drive that the map is for, or {its}; nothing was written",
        )  # fmt: skip
    values = {drive_map.address(name): data for name, data in encoded.items()}
    return new_dcf(base, values, node_id=node_id, node_name=wanted.name, where=where)


def concise_dcf(wanted: ParameterSet, *, drive_map: DriveMap | None = None) -> bytes:
    """Return a concise DCF (CiA 302-2, object 0x1F22), which a CANopen manager plays object by object at boot-up.

    For a drive that stages, a complete set is framed by its staging commands, so that the drive takes it as a whole
    and only if its CRC-32 is right. An incomplete set has no CRC of its own and is written directly; the look-up
    table cannot be written that way.

    Raises ConfigError: values that do not fit, or a look-up table in an incomplete set.
    """
    drive_map = drive_map or reference_map()
    entries = [Entry(*drive_map.address(name), data) for name, data in drive_map.encode(checked(wanted)).items()]
    if drive_map.staging:
        complete = all(row.name in wanted.values for row in CATALOGUE)
        if complete:
            entries = [*_stage(SetCommand.BEGIN), *entries, *_take(crc32(image_of(wanted)))]
        elif wanted.tables or any(name.startswith(("lut.", "saturation.")) for name in wanted.values):
            raise ConfigError(
                "a table can be sent to this drive only together with the whole set",
                where=wanted.name,
                hint="export the design, or a complete params.toml",
            )
    return write_concise(entries)


def _stage(command: SetCommand) -> Iterator[Entry]:
    item = objects.SET_COMMAND
    yield Entry(item.index, item.sub, item.encode(command))


def _take(crc: int) -> Iterator[Entry]:
    item = objects.SET_CRC_EXPECTED
    yield Entry(item.index, item.sub, item.encode(crc))
    yield from _stage(SetCommand.VALIDATE)
    yield from _stage(SetCommand.ACTIVATE)


def csv_text(wanted: ParameterSet, *, drive_map: DriveMap | None = None) -> str:
    """Return a table for people and spreadsheets: one row per value, asked for and held, with its object and bytes.

    A look-up table gives one row per axis or table and one per number (``lut.i_d_a[17]``, row-major).
    """
    drive_map = drive_map or reference_map()
    encoded = drive_map.encode(checked(wanted))
    held = drive_map.decode(encoded)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(CSV_HEAD)
    writer.writerows(_scalar_rows(wanted, drive_map, encoded, held.values))
    writer.writerows(_table_rows(wanted, drive_map, encoded, held))
    return out.getvalue()


Row = tuple[str, str, str, str, str, str, str, str, str]


def _scalar_rows(
    wanted: ParameterSet, drive_map: DriveMap, encoded: Mapping[str, bytes], held: Mapping[str, float]
) -> Iterator[Row]:
    lacking = drive_map.not_written(wanted.values)
    for name, value in wanted.values.items():
        row, cell = BY_NAME[name], drive_map.cells.get(name)
        if cell is None:
            yield name, _number(value), row.unit, "", "", "", "", row.meaning, lacking[name]
        else:
            where = f"0x{cell.index:04X}:{cell.sub:02X}"
            data = encoded[name].hex()
            yield name, _number(value), row.unit, _number(held[name]), where, cell.wire, data, row.meaning, ""


def _table_rows(
    wanted: ParameterSet, drive_map: DriveMap, encoded: Mapping[str, bytes], held: ParameterSet
) -> Iterator[Row]:
    for name, table in wanted.tables.items():
        unit = table_unit(name)
        known = name in drive_map.tables
        where = "0x{:04X}:{:02X}".format(*drive_map.tables[name]) if known else ""
        size = f"{len(encoded[name])} bytes" if known else ""
        lacking = "; ".join(drive_map.not_written([name]).values())
        yield name, f"{len(table)} numbers", unit, "", where, "DOMAIN" if known else "", size, "look-up table", lacking
        for k, value in enumerate(table):
            kept = _number(held.tables[name][k]) if known else ""
            yield f"{name}[{k}]", _number(value), unit, kept, "", "", "", "", lacking


def _number(value: float) -> str:
    whole = math.isfinite(value) and value == int(value) and abs(value) < 2**53
    return str(int(value)) if whole else repr(float(value))
