# SPDX-License-Identifier: MIT
"""The parameter image: the same bytes and the same verdicts in C and in Python, whatever the values."""

from __future__ import annotations

import ctypes
import math
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmsmtool.drive_maps.drive_map import reference_map
from pmsmtool.firmware.core_binding import core
from pmsmtool.firmware.image import (
    SCALAR_BYTES,
    SCALAR_WORDS,
    ImageRefused,
    ImageStatus,
    crc32,
    lut_size_words,
    pack_image,
    saturation_words,
    unpack_image,
)
from pmsmtool.firmware.params_header import CORE_DIRECTORY, c_float, generated_files
from pmsmtool.params.catalogue import BY_NAME, CATALOGUE, SCHEMA_VERSION, Parameter, layout_signature
from pmsmtool.params.parameter_set import to_binary32
from pmsmtool.sim.node.parameter_set import ParameterImage

DEFAULTS = {row.name: row.default for row in CATALOGUE}
CELLS = reference_map().cells
"""What the tool writes to the objects of the reference drive."""
RANDOM_SETS = 1000


def random_value(row: Parameter, choice: int, share: float) -> float:
    """A value anywhere inside the bounds, with the bounds themselves well represented."""
    if choice < 2:
        return (row.minimum, row.maximum)[choice]
    if row.is_integer:
        return int(row.minimum) + int(share * (int(row.maximum) - int(row.minimum) + 1))
    if row.minimum > 0 and choice < 5:
        return float(row.minimum * (row.maximum / row.minimum) ** share)
    return float(row.minimum + share * (row.maximum - row.minimum))


def random_values(rng: np.random.Generator) -> dict[str, float]:
    choices, shares = rng.integers(8, size=len(CATALOGUE)).tolist(), rng.random(len(CATALOGUE)).tolist()
    values = {row.name: random_value(row, *drawn) for row, *drawn in zip(CATALOGUE, choices, shares, strict=True)}
    values |= {
        "lut.format": int(rng.integers(3)),
        "lut.n_x": int(rng.integers(2, 6)),
        "lut.n_y": int(rng.integers(2, 6)),
        "lut.n_z": int(rng.integers(1, 4)),
        "saturation.i_d_max_a": rng.uniform(1.0, 50.0),
        "saturation.i_q_max_a": rng.uniform(1.0, 50.0),
    }
    counts = rng.integers(2, 5, 2).tolist() if rng.random() < 0.5 else (0, 0)
    return values | {"saturation.n_d": counts[0], "saturation.n_q": counts[1]}


def random_lut(values: dict[str, float], rng: np.random.Generator) -> bytes:
    nodes = rng.uniform(1e-4, 1.0, saturation_words(values)).astype("<f4").tobytes()
    if values["lut.format"] == 0:
        return nodes
    axes = b"".join(
        np.cumsum(rng.uniform(0.1, 2, int(values[f"lut.n_{axis}"]))).astype("<f4").tobytes() for axis in "xyz"
    )
    return axes + rng.bytes(4 * lut_size_words(values) - len(axes) - len(nodes)) + nodes


def c_image(values: dict[str, float], lut: bytes) -> bytes:
    """The image as C stores it from members assigned one by one."""
    binding = core()
    params = binding.make("pmsm_params")
    for row in CATALOGUE:
        setattr(params, row.c_name, int(values[row.name]) if row.is_integer else values[row.name])
    words = (ctypes.c_uint32 * max(1, len(lut) // 4)).from_buffer_copy(lut or b"\0\0\0\0")
    image = (ctypes.c_uint8 * (SCALAR_BYTES + len(lut)))()
    size = binding.library.pmsm_image_store(params, words, image)
    assert size == len(image)
    return bytes(image)


def c_check(image: bytes, **changes: int) -> ImageStatus:
    announced = {"schema": SCHEMA_VERSION, "signature": layout_signature(), "crc": crc32(image)} | changes
    return ImageStatus(core().library.pmsm_image_check(image, len(image), *announced.values()))


def python_check(image: bytes, **changes: int) -> ImageStatus:
    announced = {"schema": SCHEMA_VERSION, "signature": layout_signature(), "crc": crc32(image)} | changes
    for name, held, status in (
        ("schema", SCHEMA_VERSION, ImageStatus.SCHEMA),
        ("signature", layout_signature(), ImageStatus.SIGNATURE),
        ("crc", crc32(image), ImageStatus.CRC),
    ):
        if announced[name] != held:
            return status
    try:
        unpack_image(image)
    except ImageRefused as refusal:
        return refusal.status
    return ImageStatus.OK


def test_generated_files_are_what_the_catalogue_says() -> None:
    for name, text in generated_files().items():
        assert (CORE_DIRECTORY / name).read_bytes() == text.encode("ascii"), f"run params_header: {name} is stale"


def test_struct_is_the_catalogue_in_order() -> None:
    params = core().types["pmsm_params"]
    assert [name for name, _ in params._fields_] == [row.c_name for row in CATALOGUE]
    assert ctypes.sizeof(params) == SCALAR_BYTES == 4 * SCALAR_WORDS


def object_image(node: ParameterImage, values: dict[str, float], lut: bytes) -> bytes:
    """The image as the drive holds it after every object was written, each with the bytes the tool sends."""
    for name, cell in CELLS.items():
        node.set_wire(BY_NAME[name], cell.encode(values[name], values))
    position = 0
    for key, (_, padded) in node.part_sizes().items():
        node.parts[key] = lut[position : position + padded]
        position += padded
    return node.pack()


@pytest.mark.chain
def test_c_python_and_objects_give_the_same_image_for_random_sets() -> None:
    rng = np.random.default_rng(2026)
    node = ParameterImage.of_values({})
    for _ in range(RANDOM_SETS):
        values = random_values(rng)
        lut = random_lut(values, rng)
        image = pack_image(values, lut)
        assert c_image(values, lut) == image
        assert object_image(node, values, lut) == image
        assert core().library.pmsm_image_crc32(image, len(image)) == crc32(image)
        back, back_lut = unpack_image(image)
        assert back_lut == lut
        assert back == {
            row.name: values[row.name] if row.is_integer else to_binary32(values[row.name]) for row in CATALOGUE
        }
        assert c_check(image) is ImageStatus.OK


def test_image_loads_into_params_and_words() -> None:
    rng = np.random.default_rng(7)
    values = random_values(rng) | {"lut.format": 1}
    lut = random_lut(values, rng)
    image = pack_image(values, lut)
    params, words = core().make("pmsm_params"), (ctypes.c_uint32 * 8192)()
    assert core().library.pmsm_image_load(image, len(image), params, words, 8192) == ImageStatus.OK
    assert bytes(params) + bytes(words)[: len(lut)] == image
    assert core().library.pmsm_lut_words(params) == len(lut) // 4
    assert core().library.pmsm_image_load(image, len(image), params, words, 3) == ImageStatus.LUT_SIZE
    plain = pack_image(DEFAULTS)
    assert unpack_image(bytes(core().params(DEFAULTS)))[0] == unpack_image(plain)[0]


@pytest.mark.parametrize("row", CATALOGUE, ids=lambda row: row.name)
def test_every_member_out_of_its_bounds_is_refused_alike(row: Parameter) -> None:
    image = bytearray(pack_image(DEFAULTS))
    position = 4 * CATALOGUE.index(row)
    if row.is_integer:
        bad = [int(row.maximum) + 1, 0xFFFFFFFF] + ([int(row.minimum) - 1] if row.minimum > 0 else [])
        words = [struct.pack("<I", value) for value in bad]
    else:
        up = np.nextafter(np.float32(row.maximum), np.float32(np.inf))
        down = np.nextafter(np.float32(row.minimum), np.float32(-np.inf))
        words = [struct.pack("<f", value) for value in (up, down, math.nan, math.inf, -math.inf)]
    for word in words:
        image[position : position + 4] = word
        assert c_check(bytes(image)) is python_check(bytes(image)) is ImageStatus.RANGE
        params = core().types["pmsm_params"].from_buffer_copy(image)
        assert core().library.pmsm_params_check(params) == CATALOGUE.index(row)
    with pytest.raises(ImageRefused, match=row.name.replace(".", r"\.")):
        pack_image(DEFAULTS | {row.name: math.nan})


def test_every_damaged_field_is_refused() -> None:
    image = pack_image(DEFAULTS)
    assert c_check(image) is ImageStatus.OK
    for changes, status in (
        ({"schema": SCHEMA_VERSION + 1}, ImageStatus.SCHEMA),
        ({"schema": 0}, ImageStatus.SCHEMA),
        ({"signature": layout_signature() ^ 1}, ImageStatus.SIGNATURE),
        ({"crc": crc32(image) ^ 0x80000000}, ImageStatus.CRC),
    ):
        assert c_check(image, **changes) is python_check(image, **changes) is status
    for position in range(len(image)):  # one bit anywhere
        damaged = bytearray(image)
        damaged[position] ^= 1 << (position % 8)
        for check in (c_check, python_check):
            assert check(bytes(damaged), crc=crc32(image)) is ImageStatus.CRC
    for size in (0, 3, SCALAR_BYTES - 4, SCALAR_BYTES - 1):
        assert c_check(image[:size]) is python_check(image[:size]) is ImageStatus.SIZE
    for tail in (b"\0", b"\0\0\0\0"):
        assert c_check(image + tail) is python_check(image + tail) is ImageStatus.LUT_SIZE


def lut_of(n: tuple[int, int, int], fmt: int) -> tuple[dict[str, float], bytes]:
    values = DEFAULTS | {"lut.format": fmt} | {f"lut.n_{a}": k for a, k in zip("xyz", n, strict=True)}
    axes = b"".join(np.arange(k, dtype="<f4").tobytes() for k in n)
    return values, axes + bytes(4 * lut_size_words(values) - len(axes))


@pytest.mark.parametrize("fmt", [1, 2])
@pytest.mark.parametrize("n", [(1, 5, 1), (5, 1, 1), (5, 5, 0), (0, 0, 0), (255, 255, 1), (255, 255, 16)])
def test_tables_that_cannot_be_used_are_refused_alike(fmt: int, n: tuple[int, int, int]) -> None:
    values, lut = lut_of(n, fmt)
    image = pack_image(DEFAULTS)[:SCALAR_BYTES] + lut
    for name in ("lut.format", "lut.n_x", "lut.n_y", "lut.n_z"):
        k = [row.name for row in CATALOGUE].index(name)
        image = image[: 4 * k] + struct.pack("<I", int(values[name])) + image[4 * k + 4 :]
    assert c_check(image) is python_check(image) is ImageStatus.LUT_SIZE
    with pytest.raises(ImageRefused):
        pack_image(values, lut)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 0.5])
def test_an_axis_that_does_not_increase_is_refused_alike(axis: int, bad: float) -> None:
    n = (4, 5, 3)
    values, lut = lut_of(n, 1)
    good = pack_image(values, lut)
    assert c_check(good) is ImageStatus.OK
    first = SCALAR_WORDS + sum(n[:axis])
    for node in (0, n[axis] - 1):
        if (bad == 0.5 and node == 0) or (bad == -math.inf and node == 0):
            continue  # still increasing, or covered below
        image = good[: 4 * (first + node)] + struct.pack("<f", bad) + good[4 * (first + node) + 4 :]
        assert c_check(image) is python_check(image) is ImageStatus.LUT_AXIS
    image = good[: 4 * first] + struct.pack("<f", -math.inf) + good[4 * first + 4 :]
    assert c_check(image) is python_check(image) is ImageStatus.LUT_AXIS


def test_incomplete_and_unknown_names_are_all_listed() -> None:
    values = dict(DEFAULTS)
    del values["motor.R_s_ohm"], values["polar.b"]
    with pytest.raises(ImageRefused) as caught:
        pack_image(values | {"motor.R_s": 1.0})
    assert len(caught.value.violations) == 3
    assert caught.value.status is ImageStatus.SIZE
    with pytest.raises(ImageRefused, match="not an integer"):
        pack_image(DEFAULTS | {"motor.pole_pairs": 3.5})


@given(st.binary(max_size=400))
def test_crc_is_that_of_zlib(data: bytes) -> None:
    assert core().library.pmsm_image_crc32(data, len(data)) == crc32(data) == zlib.crc32(data)


@pytest.mark.chain
@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
@settings(max_examples=500)
def test_float_literals_read_back_to_the_same_bits(value: float) -> None:
    text = c_float(value)
    assert text.endswith("F")
    assert any(mark in text for mark in ".e")
    assert struct.pack("<f", float(text[:-1])) == struct.pack("<f", value)
