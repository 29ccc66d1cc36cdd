# SPDX-License-Identifier: MIT
"""Staging, validation and activation of the parameter set, direct writes, image and look-up table."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.data_types import DATA_TYPES
from pmsmtool.firmware.image import ImageStatus, crc32, pack_image
from pmsmtool.params.catalogue import CATALOGUE, SCHEMA_VERSION, Parameter, layout_signature
from pmsmtool.sim.node.parameter_set import LUT_PARTS, ParameterImage, SetState
from tests.node.bench import Bench
from tests.node.raw_client import Aborted, RawClient

LETTERS = {"UNSIGNED8": "B", "UNSIGNED16": "H", "UNSIGNED32": "I", "REAL32": "f"}
LUT_OBJECTS = dict(zip(LUT_PARTS, (0x2044, 0x2045, 0x2046, 0x2042, 0x2043), strict=True))


def command(client: RawClient, number: int) -> None:
    client.put(0x2000, 6, number, "B")


def set_state(client: RawClient) -> SetState:
    return SetState(int(client.number(0x2000, 7, "B")))


def put(client: RawClient, name: str, value: float) -> None:
    row = next(row for row in CATALOGUE if row.name == name)
    client.put(row.index, row.sub, int(value) if row.is_integer else value, LETTERS[row.wire])


def lut_parts(n_x: int = 5, n_y: int = 3, n_z: int = 1) -> dict[str, bytes]:
    cells = n_x * n_y * n_z
    return {
        "lut.axis_x": struct.pack(f"<{n_x}f", *range(n_x)),
        "lut.axis_y": struct.pack(f"<{n_y}f", *(100.0 * k for k in range(n_y))),
        "lut.axis_z": struct.pack(f"<{n_z}f", *(300.0 + k for k in range(n_z))),
        "lut.table_i_d": struct.pack(f"<{cells}f", *(-float(k) for k in range(cells))),
        "lut.table_i_q": struct.pack(f"<{cells}f", *(float(k) for k in range(cells))),
    }


def stage_lut(client: RawClient, parts: Mapping[str, bytes], n_x: int = 5, n_y: int = 3, n_z: int = 1) -> None:
    for name, value in (("lut.format", 1), ("lut.n_x", n_x), ("lut.n_y", n_y), ("lut.n_z", n_z)):
        put(client, name, value)
    for key, data in parts.items():
        client.write(LUT_OBJECTS[key], 0, data, segmented=True)


def expected_image(changes: Mapping[str, float], lut: bytes = b"") -> bytes:
    values = {row.name: row.default for row in CATALOGUE} | {"inverter.T_s_ns": 100_000.0} | dict(changes)
    return pack_image(values, lut)


def test_constants_identify_the_layout(bench: Bench) -> None:
    assert bench.client.number(0x2000, 1, "H") == SCHEMA_VERSION
    assert bench.client.number(0x2000, 2) == layout_signature()


def test_the_image_object_holds_the_bytes_every_other_part_computes(bench: Bench) -> None:
    image = expected_image({})
    assert bench.client.read_block(0x2001) == image
    assert bench.client.number(0x2000, 3) == crc32(image)
    assert bench.core.image == image
    assert bench.client.number(0x2000, 4) == 0


def test_every_parameter_is_an_object_of_its_wire_type_with_its_bounds(bench: Bench) -> None:
    client = bench.client
    for row in CATALOGUE:
        assert len(client.read(row.index, row.sub)) == DATA_TYPES[row.wire].size
        top = 2 ** (8 * DATA_TYPES[row.wire].size) - 1
        if not row.is_integer or row.maximum < top:
            with pytest.raises(Aborted) as caught:
                put(client, row.name, row.maximum + 1 if row.is_integer else row.maximum * 1.001 + 1e-3)
            assert caught.value.code == AbortCode.VALUE_HIGH
        if not row.is_integer or row.minimum > 0:
            with pytest.raises(Aborted) as caught:
                step = 1 if row.is_integer else abs(row.minimum) * 1e-3 + 1e-3
                put(client, row.name, row.minimum - step)
            assert caught.value.code == AbortCode.VALUE_LOW


def test_a_staged_set_acts_only_when_it_is_activated(bench: Bench) -> None:
    client = bench.client
    before = bench.core.image
    command(client, 1)
    put(client, "motor.R_s_ohm", 0.25)
    put(client, "governor.k_max", 9)
    stage_lut(client, lut_parts())
    assert client.number(0x2010, 2, "f") == 0.25
    assert client.read(0x2042) == lut_parts()["lut.table_i_d"]
    assert bench.core.image == before
    assert set_state(client) is SetState.STAGING
    image = expected_image(
        {"motor.R_s_ohm": 0.25, "governor.k_max": 9, "lut.format": 1, "lut.n_x": 5, "lut.n_y": 3, "lut.n_z": 1},
        b"".join(lut_parts().values()),
    )
    assert client.read_block(0x2001) == image
    client.put(0x2000, 5, crc32(image))
    command(client, 2)
    assert set_state(client) is SetState.VALID
    command(client, 3)
    assert set_state(client) is SetState.ACTIVE
    assert bench.core.image == image
    assert client.number(0x2000, 3) == crc32(image)


def test_discard_leaves_the_active_set(bench: Bench) -> None:
    client = bench.client
    command(client, 1)
    put(client, "motor.R_s_ohm", 0.25)
    command(client, 4)
    assert set_state(client) is SetState.NONE
    assert client.number(0x2010, 2, "f") == pytest.approx(0.137)


def test_a_write_after_validation_needs_validation_again(bench: Bench) -> None:
    client = bench.client
    command(client, 1)
    client.put(0x2000, 5, crc32(expected_image({})))
    command(client, 2)
    assert set_state(client) is SetState.VALID
    put(client, "motor.R_s_ohm", 0.2)
    with pytest.raises(Aborted) as caught:
        command(client, 3)
    assert caught.value.code == AbortCode.DEVICE_STATE


def test_a_wrong_crc_is_rejected_and_names_the_object(bench: Bench) -> None:
    client = bench.client
    command(client, 1)
    client.put(0x2000, 5, 0x12345678)
    command(client, 2)
    assert set_state(client) is SetState.REJECTED
    assert client.number(0x2000, 8) == 0x2000 << 16 | 5 << 8 | ImageStatus.CRC


def test_activation_is_refused_while_the_drive_is_enabled(bench: Bench) -> None:
    client = bench.client
    command(client, 1)
    client.put(0x2000, 5, crc32(expected_image({})))
    command(client, 2)
    for word in (6, 7, 15):
        client.put(0x6040, 0, word, "H")
    with pytest.raises(Aborted) as caught:
        command(client, 3)
    assert caught.value.code == AbortCode.DEVICE_STATE
    client.put(0x6040, 0, 0, "H")
    command(client, 3)
    assert set_state(client) is SetState.ACTIVE


def test_direct_writes_act_at_once_while_disabled_and_only_live_gains_while_enabled(bench: Bench) -> None:
    client = bench.client
    put(client, "motor.R_s_ohm", 0.2)
    assert bench.core.image == expected_image({"motor.R_s_ohm": 0.2})
    for word in (6, 7, 15):
        client.put(0x6040, 0, word, "H")
    put(client, "current.K_p_d_v_per_a", 1.25)
    assert bench.core.image == expected_image({"motor.R_s_ohm": 0.2, "current.K_p_d_v_per_a": 1.25})
    with pytest.raises(Aborted) as caught:
        put(client, "motor.R_s_ohm", 0.3)
    assert caught.value.code == AbortCode.DEVICE_STATE
    assert client.number(0x2010, 2, "f") == pytest.approx(0.2)


@pytest.mark.parametrize("index", [0x2001, 0x2042, 0x2043, 0x2044, 0x2045, 0x2046])
def test_tables_and_image_are_written_while_staging_only(bench: Bench, index: int) -> None:
    with pytest.raises(Aborted) as caught:
        bench.client.write(index, 0, bytes(400), segmented=True)
    assert caught.value.code == AbortCode.DEVICE_STATE
    with pytest.raises(Aborted) as caught:
        put(bench.client, "lut.n_x", 3)
    assert caught.value.code == AbortCode.DEVICE_STATE


@pytest.mark.parametrize(
    ("key", "data", "reason"),
    [
        ("lut.table_i_d", bytes(56), ImageStatus.LUT_SIZE),
        ("lut.table_i_q", bytes(64), ImageStatus.LUT_SIZE),
        ("lut.axis_x", struct.pack("<5f", 0, 1, 1, 2, 3), ImageStatus.LUT_AXIS),
        ("lut.axis_y", struct.pack("<3f", 0, math.nan, 3), ImageStatus.LUT_AXIS),
        ("lut.axis_z", b"", ImageStatus.LUT_SIZE),
    ],
)
def test_a_broken_table_is_rejected_and_named(bench: Bench, key: str, data: bytes, reason: ImageStatus) -> None:
    client = bench.client
    command(client, 1)
    stage_lut(client, lut_parts() | {key: data})
    command(client, 2)
    assert set_state(client) is SetState.REJECTED
    assert client.number(0x2000, 8) == LUT_OBJECTS[key] << 16 | reason


def test_a_set_written_as_one_image_is_the_same_set(bench: Bench) -> None:
    client = bench.client
    parts = lut_parts(4, 4, 2)
    image = expected_image(
        {"motor.L_d_h": 0.001, "lut.format": 1, "lut.n_x": 4, "lut.n_y": 4, "lut.n_z": 2}, b"".join(parts.values())
    )
    command(client, 1)
    client.write_block(0x2001, 0, image)
    assert client.read_block(0x2001) == image
    assert client.number(0x2010, 3, "f") == pytest.approx(0.001)
    for key, data in parts.items():
        assert client.read(LUT_OBJECTS[key]) == data
    client.put(0x2000, 5, crc32(image))
    command(client, 2)
    command(client, 3)
    assert bench.core.image == image


@pytest.mark.parametrize("row", CATALOGUE, ids=lambda row: row.name)
def test_an_image_with_one_value_out_of_range_is_rejected_with_its_object(bench: Bench, row: Parameter) -> None:
    image = bytearray(expected_image({}))
    position = 4 * CATALOGUE.index(row)
    if row.is_integer:
        struct.pack_into("<I", image, position, int(row.maximum) + 1)
    else:
        struct.pack_into("<f", image, position, math.nan)
    client = bench.client
    command(client, 1)
    client.write_block(0x2001, 0, bytes(image))
    client.put(0x2000, 5, crc32(bytes(image)))
    command(client, 2)
    assert set_state(client) is SetState.REJECTED
    assert client.number(0x2000, 8) == row.index << 16 | row.sub << 8 | ImageStatus.RANGE


def test_any_change_zeroes_the_configuration_date(bench: Bench) -> None:
    client = bench.client

    def date() -> None:
        client.put(0x1020, 1, 15000)
        client.put(0x1020, 2, 1000)
        assert [client.number(0x1020, sub) for sub in (1, 2)] == [15000, 1000]

    date()
    put(client, "motor.R_s_ohm", 0.2)
    assert [client.number(0x1020, sub) for sub in (1, 2)] == [0, 0]
    date()
    client.put(0x6007, 0, 1, "h")
    assert [client.number(0x1020, sub) for sub in (1, 2)] == [0, 0]
    date()
    client.put(0x6007, 0, 1, "h")
    command(client, 1)
    put(client, "motor.R_s_ohm", 0.1)
    assert [client.number(0x1020, sub) for sub in (1, 2)] == [15000, 1000]
    client.put(0x2000, 5, crc32(expected_image({"motor.R_s_ohm": 0.1})))
    command(client, 2)
    command(client, 3)
    assert [client.number(0x1020, sub) for sub in (1, 2)] == [0, 0]


_VALUES = st.fixed_dictionaries(
    {
        row.name: st.integers(int(row.minimum), int(row.maximum))
        if row.is_integer
        else st.floats(
            struct.unpack("<f", struct.pack("<f", row.minimum))[0],
            struct.unpack("<f", struct.pack("<f", row.maximum))[0],
            width=32,
        )
        for row in CATALOGUE
        if not row.name.startswith(("lut.", "saturation.n_"))
    }
)


@pytest.mark.chain
@given(_VALUES)
@settings(max_examples=100, deadline=None)
def test_object_bytes_python_image_and_node_image_are_the_same_bytes(values: dict[str, float]) -> None:
    image = ParameterImage.of_values({})
    for row in CATALOGUE:
        if row.name in values:
            value = values[row.name]
            image.set_wire(row, struct.pack("<" + LETTERS[row.wire], int(value) if row.is_integer else value))
    complete = {row.name: row.default for row in CATALOGUE} | values
    assert image.pack() == pack_image(complete)
    assert image.first_offender() is None
    assert ParameterImage.of_bytes(image.pack()).pack() == image.pack()
