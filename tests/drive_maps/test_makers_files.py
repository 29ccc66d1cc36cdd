# SPDX-License-Identifier: MIT
"""Every row of a shipped map against makers' own files, where a table of their objects lies beside the checkout."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from pmsmtool.data_types import BY_SHORT
from pmsmtool.drive_maps import sheet_check
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.drive_maps.shipped_maps import family_of, load_family
from pmsmtool.sim.foreign.file_rows import read_makers_objects
from pmsmtool.sim.node.dictionary import Dictionary
from pmsmtool.sim.node.family import LACKS, Face

TABLE = Path(__file__).resolve().parents[2].parent / "shared" / "reference" / "drive-objects.csv"
needs_table = pytest.mark.skipif(not TABLE.is_file(), reason="no table of makers' objects beside the checkout")
FILES_OF = {
    "copley": ("copley", "dchcan"),
    "elmo": ("elmo-simpliq", "elmo-gold"),
    "epos2": ("epos2",),
    "epos4": ("epos4",),
    "faulhaber": ("faulhaber",),
    "nanotec": ("nanotec",),
    "zeroerr": ("zeroerr",),
}
"""Families of the table, by the beginning of their names."""
VENDORS = {"copley": 0xAB, "elmo": 0x9A, "epos4": 0xFB, "faulhaber": 0x147, "nanotec": 0x26C, "zeroerr": 0x5A65726F}

Rows = dict[str, dict[tuple[int, int], dict[str, str]]]


@cache
def makers_files(maker: str) -> Rows:
    """Return the objects of every file of a maker, by file."""
    found: Rows = {}
    with TABLE.open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            if row["family"].startswith(FILES_OF[maker]):
                address = int(row["index"], 16), int(row["sub"], 0)
                found.setdefault(row["family"], {})[address] = row
    return found


def mapped(drive_map: DriveMap) -> Iterator[tuple[str, tuple[int, int], str]]:
    """Yield every row of a map: name, object, type."""
    for name, row in (*drive_map.cells.items(), *drive_map.signals.items(), *drive_map.motion.items()):
        if row.index:
            yield name, (row.index, row.sub), row.wire


def contradictions(drive_map: DriveMap, files: Rows) -> list[str]:
    """Return what no file has, and where a file has another type."""
    lines = []
    for name, address, wire in mapped(drive_map):
        types = {file: rows[address]["type"] for file, rows in files.items() if address in rows}
        where = f"{drive_map.name} {name} 0x{address[0]:04X}:{address[1]:02X}"
        if not types:
            lines.append(f"{where}: in no file")
        lines += [f"{where}: {wire}, {file} has {found}" for file, found in types.items() if found != wire]
    return lines


@needs_table
@pytest.mark.parametrize("maker", FILES_OF)
def test_every_row_is_in_a_makers_file_in_its_type(maker: str) -> None:
    files = makers_files(maker)
    assert files and contradictions(load_family(maker), files) == []


@needs_table
@pytest.mark.parametrize("maker", FILES_OF)
def test_a_rehearsed_family_shows_no_object_that_its_makers_files_lack(maker: str) -> None:
    """Of CiA 301 and CiA 402, and of what the table lists of any maker: it leaves some objects out of every file."""
    own, table = makers_files(maker), {index for other in FILES_OF for index in _indices(makers_files(other))}
    if maker == "elmo":
        own = {"elmo-simpliq": own["elmo-simpliq"]}  # the map's; the Gold line has no map
    dictionary = Dictionary(1)
    Face(load_family(maker)).dress(dictionary)
    shown = {entry.row.index for entry in dictionary if not 0x2000 <= entry.row.index < 0x6000} & table
    counts_itself = {0x608F} if maker == "zeroerr" else set()  # the simulated encoder is not a joint's
    assert shown - _indices(own) == counts_itself
    assert not set(LACKS[maker]) & _indices(own)


def _indices(files: Rows) -> set[int]:
    return {index for rows in files.values() for index, _ in rows}


@needs_table
@pytest.mark.parametrize("maker", FILES_OF)
def test_the_identity_is_the_files(maker: str) -> None:
    """What a file states; several leave the vendor or the product blank."""
    drive_map = load_family(maker)
    known = {drive_map.product, *drive_map.more_products}
    for file, rows in makers_files(maker).items():
        stated = [rows.get((0x1018, sub), {}).get("default_or_stored", "") for sub in (1, 2)]
        if stated[0]:
            assert int(stated[0], 0) == drive_map.vendor, file
        if stated[1] and maker != "elmo":  # the Gold line is another one than the SimplIQ of the map
            assert int(stated[1], 0) in known, file


@pytest.mark.parametrize("maker", VENDORS)
def test_a_vendor_number_is_there(maker: str) -> None:
    assert load_family(maker).vendor == VENDORS[maker]
    assert load_family("ingenia").vendor == 0x29C


@pytest.mark.parametrize(
    ("family", "vendor", "product"),
    [
        *(("epos4", 0xFB, product) for product in (0x61500000, 0x64500000, 0x65510000, 0x65520000, 0x68500000)),
        *(("nanotec", 0x26C, product) for product in (0x05, 0x06, 0x10, 0x5B)),
    ],
)
def test_products_of_a_family(family: str, vendor: int, product: int) -> None:
    """Another product with the same objects was a drive that no map names: its 0x6076 was read 1000 times too large."""
    found = family_of(vendor, product)
    assert found is not None and found.name == family


@needs_table
@pytest.mark.parametrize("maker", FILES_OF)
def test_every_row_that_contradicts_its_files_is_named_with_family_object_and_source(maker: str) -> None:
    """Each row of the shipped map in turn, at an object that no file has, and in a type that none has there."""
    drive_map = load_family(maker)
    sheets = [read_makers_objects(f"{TABLE}#{file}") for file in makers_files(maker)]
    types = [{place: BY_SHORT[row.type].name for place, row in sheet.rows.items()} for sheet in sheets]
    turned = 0
    for table in ("cells", "signals", "motion"):
        for name, row in getattr(drive_map, table).items():
            if not row.index:
                continue
            for wrong in (replace(row, index=0x5FF0), replace(row, wire="REAL32")):
                edited = replace(drive_map, **{table: {**getattr(drive_map, table), name: wrong}})
                for found in types:
                    (line,) = sheet_check.contradictions(edited, found, [name])
                    assert line.startswith(f"{maker} {name} 0x{wrong.index:04X}:{wrong.sub:02X}")
                    assert drive_map.sources[row.source] in line
                    turned += 1
    assert turned or not any(True for _ in mapped(drive_map))


@needs_table
def test_a_row_that_contradicts_a_file_is_found() -> None:
    wrong = load_family("epos2")
    assert contradictions(wrong, makers_files("epos4"))
