# SPDX-License-Identifier: MIT
"""The object table and the data sheet generated from it."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import canopen
import pytest

from pmsmtool.data_types import DATA_TYPES
from pmsmtool.drive_maps.drive_map import reference_map
from pmsmtool.drive_maps.drive_map_file import parse_drive_map
from pmsmtool.files import data_folder
from pmsmtool.params.catalogue import CATALOGUE, layout_signature
from pmsmtool.sim.node.dictionary import Dictionary
from pmsmtool.sim.node.objects import FILE_NAME, MAP_NAME, ObjectRow, build_rows, eds_text, object_rows
from tests.node.bench import Bench

FOLDER = data_folder("firmware-params") / "pmsmsim"


def test_the_committed_data_sheet_and_map_are_the_generated_ones() -> None:
    """Regenerate with ``python -m pmsmtool.sim.node.objects``."""
    assert (FOLDER / FILE_NAME).read_text(encoding="ascii") == eds_text()
    assert parse_drive_map((FOLDER / MAP_NAME).read_text(encoding="ascii")) == reference_map()


def test_the_map_names_objects_of_the_drive_in_their_types() -> None:
    rows = {(row.index, row.sub): row for row in object_rows()}
    drive_map = parse_drive_map((FOLDER / MAP_NAME).read_text(encoding="ascii"))
    assert len(drive_map.cells) == len(CATALOGUE)
    for cell in drive_map.cells.values():
        assert rows[cell.index, cell.sub].key == cell.name
        assert rows[cell.index, cell.sub].data_type.size == DATA_TYPES[cell.wire].size
    assert {rows[address].type for address in drive_map.tables.values()} == {"DOMAIN"}


@pytest.fixture(scope="module")
def stock_dictionary() -> canopen.ObjectDictionary:
    return canopen.import_od(str(FOLDER / FILE_NAME), node_id=5)


def test_stock_canopen_reads_every_object_with_type_access_and_default(
    stock_dictionary: canopen.ObjectDictionary,
) -> None:
    for row in object_rows():
        variable = stock_dictionary.get_variable(row.index, row.sub)
        assert variable is not None, f"0x{row.index:04X}:{row.sub:02X}"
        assert variable.data_type == row.data_type.code
        assert variable.writable == (row.access == "rw")
        if row.data_type.letter and row.default != "nan":
            assert variable.default == pytest.approx(row.default_number(5), rel=1e-9)


def test_stock_canopen_sees_the_integer_limits_of_the_catalogue(stock_dictionary: canopen.ObjectDictionary) -> None:
    for row in CATALOGUE:
        variable = stock_dictionary.get_variable(row.index, row.sub)
        assert variable is not None
        if row.is_integer:
            assert (variable.min, variable.max) == (row.minimum, row.maximum)


def test_every_parameter_is_in_the_table_once(stock_dictionary: canopen.ObjectDictionary) -> None:
    rows = {row.key: row for row in object_rows() if row.parameter is not None}
    assert set(rows) == {row.name for row in CATALOGUE}
    for row in CATALOGUE:
        assert rows[row.name].data_type.size == DATA_TYPES[row.wire].size
        assert rows[row.name].pdo == ("R" if row.live else "0")


def test_the_rows_of_the_proposal_keep_their_place() -> None:
    """Objects of the reference's proposal that this drive has sit where the proposal put them."""
    proposal = Path(__file__).parents[2].parent / "shared" / "reference" / "object-dictionary.csv"
    if not proposal.is_file():
        pytest.skip("the reference is not here")
    ours = {(row.index, row.sub): row for row in object_rows()}
    types = {"RECORD": "U8", "ARRAY": "U8"}
    moved = {(0x2041, sub) for sub in range(1, 10)}  # the catalogue's descriptor has other members
    missing, different = [], []
    for fields in csv.DictReader(io.StringIO(proposal.read_text())):
        place = int(fields["index"], 16), int(fields["sub"], 16)
        row = ours.get(place)
        if row is None:
            missing.append(place)
        elif row.type != types.get(fields["type"], fields["type"]) and place not in moved:
            different.append(place)
    assert missing == [(0x2030, 7), (0x2030, 8), (0x2041, 7), (0x2041, 8), (0x2041, 9)]
    assert different == []


def test_the_signature_in_the_data_sheet_is_computed() -> None:
    row = next(row for row in object_rows() if row.key == "parameter_set.signature")
    assert int(row.default, 0) == layout_signature()


def test_a_table_with_a_duplicate_or_an_orphan_is_refused(tmp_path: Path) -> None:
    text = (FOLDER / "objects.csv").read_text(encoding="ascii")
    path = tmp_path / "objects.csv"
    path.write_text(text + text.splitlines()[1] + "\n", encoding="ascii")
    with pytest.raises(ValueError, match="appears twice"):
        build_rows(path)
    path.write_text(text + "5000,1,x,y,U8,rw,0,1,0,,,\n", encoding="ascii")
    with pytest.raises(ValueError, match="no sub-index 0"):
        build_rows(path)


def test_the_node_serves_its_own_data_sheet(bench: Bench) -> None:
    assert bench.client.read_block(0x1021) == eds_text().encode("ascii")
    assert bench.client.number(0x1022, 0, "H") == 0


def test_every_readable_object_can_be_read_and_every_default_is_within_its_bounds(bench: Bench) -> None:
    for row in object_rows():
        if row.type != "DOMAIN":
            data = bench.client.read(row.index, row.sub)
            assert len(data) == row.data_type.size or row.type == "VSTR"
    for entry in Dictionary(1):
        if entry.row.type not in ("DOMAIN", "VSTR"):
            entry.check(entry.value)


def test_the_bounds_of_a_number_are_those_stated_within_those_of_its_type() -> None:
    def bounds(kind: str, low: float | None, high: float | None) -> tuple[float, float]:
        row = ObjectRow(0x6075, 0, "", "", kind, "rw", "0", "", "", low, high, stored=False)
        return row.bounds

    assert bounds("U16", None, None) == (0.0, 65535.0)
    assert bounds("I8", -200.0, 5.0) == (-128.0, 5.0)
    assert bounds("U32", 1.0, 1e12) == (1.0, 2.0**32 - 1.0)
    assert bounds("REAL32", None, 2.0) == (-math.inf, 2.0)
