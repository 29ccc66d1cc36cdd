# SPDX-License-Identifier: MIT
"""The packed parameter image: one sequence of little-endian four-byte words for C, Python and the drive.

The scalars of the catalogue come first, in catalogue order (that is the C struct ``pmsm_params``), then the look-up
words: axes x, y, z as binary32, then the tables of i_d and i_q, row-major x, y, z, as binary32 (format 1) or as
int16 multiples of ``lut.lsb_a`` (format 2), each table padded with zeros to four bytes. A cell without an operating
point is NaN (format 1) or -32768 (format 2). ``firmware/core/image.c`` does the same in the drive.
"""

from __future__ import annotations

import itertools
import math
import struct
import zlib
from collections.abc import Mapping
from enum import IntEnum

from pmsmtool.errors import ConfigError
from pmsmtool.params.catalogue import (
    CATALOGUE,
    CLOSED_DRIVE,
    FLUX_MOST_WB,
    INDUCTANCE_RANGE_H,
    LUT_CAPACITY_WORDS,
    SATURATION_VALUES,
    Parameter,
)
from pmsmtool.params.parameter_set import to_binary32
from pmsmtool.plain_text import counted

LUT_FORMAT_NONE, LUT_FORMAT_BINARY32, LUT_FORMAT_INT16 = 0, 1, 2
LUT_INT16_NO_POINT = -32768
"""Table value of a cell without an operating point in the int16 format."""

SCALAR_WORDS = len(CATALOGUE)
SCALAR_BYTES = 4 * SCALAR_WORDS
_SCALARS = struct.Struct("<" + "".join("I" if row.is_integer else "f" for row in CATALOGUE))
_WORD_MAX = 0xFFFFFFFF


class ImageStatus(IntEnum):
    """Verdict on an image (``enum pmsm_image_status`` of the core)."""

    OK = 0
    SIZE = 1
    SCHEMA = 2
    SIGNATURE = 3
    CRC = 4
    RANGE = 5
    LUT_SIZE = 6
    LUT_AXIS = 7


class ImageRefused(ConfigError):
    """An image, or the values for one, cannot be used."""

    def __init__(
        self, status: ImageStatus, what: str, *, violations: tuple[str, ...] = (), likely: str = "", hint: str = ""
    ) -> None:
        super().__init__(what, where="parameter image", violations=violations, likely=likely, hint=hint)
        self.status = status


def _violation(row: Parameter, value: float) -> str | None:
    """Say what is wrong with a value, exactly as the drive judges its binary32 or integer form."""
    if row.is_integer:
        if not math.isfinite(value) or value != math.floor(value):
            return f"{row.name} = {value!r} is not an integer"
        inside = row.minimum <= value <= row.maximum
    else:
        inside = to_binary32(row.minimum) <= to_binary32(value) <= to_binary32(row.maximum)
    if inside:
        return None
    return f"{row.name} = {value!r} {row.unit} is outside {row.minimum:.9g} .. {row.maximum:.9g}"


def _check_names(values: Mapping[str, float]) -> None:
    known = {row.name for row in CATALOGUE}
    wrong = [f"{row.name} is missing" for row in CATALOGUE if row.name not in values]
    wrong += [f"{name} is not in the catalogue" for name in values if name not in known]
    if wrong:
        raise ImageRefused(
            ImageStatus.SIZE,
            "the values do not fill the image",
            violations=tuple(wrong),
            likely="it is for a drive that cannot be reflashed, which has no image"
            if any(row.name in values for row in CLOSED_DRIVE)
            else "the set was written for another schema",
        )


def _check_ranges(values: Mapping[str, float]) -> None:
    wrong = [text for row in CATALOGUE if (text := _violation(row, values[row.name])) is not None]
    if wrong:
        raise ImageRefused(ImageStatus.RANGE, f"{counted(len(wrong), 'value')} out of range", violations=tuple(wrong))


def lut_size_words(values: Mapping[str, float]) -> int:
    """Return the four-byte words of all axes and tables that the ``lut.*`` and ``saturation.*`` values announce."""
    return _look_up_words(values) + saturation_words(values)


def saturation_words(values: Mapping[str, float]) -> int:
    """Return the four-byte words of the saturation table, the last ones of the image."""
    return int(values["saturation.n_d"] * values["saturation.n_q"]) * SATURATION_VALUES


def _look_up_words(values: Mapping[str, float]) -> int:
    kind = int(values["lut.format"])
    if kind == LUT_FORMAT_NONE:
        return 0
    n_x, n_y, n_z = (int(values[f"lut.n_{axis}"]) for axis in "xyz")
    cells = n_x * n_y * n_z
    table = cells if kind == LUT_FORMAT_BINARY32 else (cells + 1) // 2
    return n_x + n_y + n_z + 2 * table


def _check_lut(values: Mapping[str, float], lut: bytes) -> None:
    words = lut_size_words(values)
    if len(lut) != 4 * words:
        raise ImageRefused(
            ImageStatus.LUT_SIZE, f"look-up data of {len(lut)} bytes, the descriptor announces {4 * words}"
        )
    _check_saturation(values, lut[4 * _look_up_words(values) :])
    if int(values["lut.format"]) == LUT_FORMAT_NONE:
        return
    counts = [int(values[f"lut.n_{axis}"]) for axis in "xyz"]
    if words > LUT_CAPACITY_WORDS or min(counts) < 1 or min(counts[:2]) < 2:
        raise ImageRefused(
            ImageStatus.LUT_SIZE,
            f"a table of {counts[0]} x {counts[1]} x {counts[2]} nodes cannot be used",
            likely=f"{words} words, the drive reserves {LUT_CAPACITY_WORDS}; the torque and speed axes need 2 nodes",
            hint="use fewer nodes or the int16 format",
        )
    start = 0
    for axis, count in zip("xyz", counts, strict=True):
        nodes = struct.unpack_from(f"<{count}f", lut, 4 * start)
        start += count
        if not all(map(math.isfinite, nodes)) or any(b <= a for a, b in itertools.pairwise(nodes)):
            raise ImageRefused(ImageStatus.LUT_AXIS, f"axis {axis} of the look-up table does not increase")


def _check_saturation(values: Mapping[str, float], nodes: bytes) -> None:
    n_d, n_q = int(values["saturation.n_d"]), int(values["saturation.n_q"])
    if n_d == n_q == 0:
        return
    if min(n_d, n_q) < 2:
        raise ImageRefused(ImageStatus.LUT_SIZE, f"a saturation table of {n_d} x {n_q} nodes: either axis needs 2")
    low, high, q = (to_binary32(values[f"saturation.{key}_a"]) for key in ("i_d_min", "i_d_max", "i_q_max"))
    if not (low < high and q > 0.0):
        raise ImageRefused(ImageStatus.LUT_AXIS, f"the saturation table spans i_d {low:g}..{high:g} A, i_q 0..{q:g} A")
    numbers = struct.unpack(f"<{len(nodes) // 4}f", nodes)
    least, most = map(to_binary32, INDUCTANCE_RANGE_H)
    if not all(-FLUX_MOST_WB <= psi <= FLUX_MOST_WB for psi in numbers[::SATURATION_VALUES]) or not all(
        least <= L <= most for k, L in enumerate(numbers) if k % SATURATION_VALUES
    ):
        raise ImageRefused(
            ImageStatus.RANGE, f"the saturation table holds no flux, or an inductance not above {least:g} H"
        )


def pack_image(values: Mapping[str, float], lut: bytes = b"") -> bytes:
    """Return the image of a complete set of values.

    Raises ImageRefused: names missing or unknown, values out of range, look-up data that do not fit; all violations are
    listed.

    Parameters
    ----------
    values : mapping of str to float
        Every catalogue name, in SI; floats are rounded to binary32.
    lut : bytes
        The look-up words, ``4 * lut_size_words(values)`` bytes.

    Returns
    -------
    bytes
        ``4 * (SCALAR_WORDS + lut_size_words(values))`` bytes, little endian.
    """
    _check_names(values)
    _check_ranges(values)
    _check_lut(values, lut)
    return _SCALARS.pack(*(int(values[row.name]) if row.is_integer else values[row.name] for row in CATALOGUE)) + lut


def unpack_image(image: bytes) -> tuple[dict[str, float], bytes]:
    """Return the values and the look-up words of an image; the inverse of :func:`pack_image`.

    Raises ImageRefused: wrong size, a value out of range, or look-up data that do not fit.
    """
    if len(image) < SCALAR_BYTES:
        raise ImageRefused(ImageStatus.SIZE, f"{len(image)} bytes, the scalars alone take {SCALAR_BYTES}")
    values: dict[str, float] = dict(zip((row.name for row in CATALOGUE), _SCALARS.unpack_from(image), strict=True))
    lut = bytes(image[SCALAR_BYTES:])
    _check_ranges(values)
    _check_lut(values, lut)
    return values, lut


def crc32(image: bytes) -> int:
    """Return the CRC-32 (IEEE 802.3, as zlib) of an image: the one number file, tool and drive compare."""
    return zlib.crc32(image) & _WORD_MAX
