# SPDX-License-Identifier: MIT
"""Look-up axes and tables and the saturation table as bytes of a DOMAIN; binary32 with as few digits as it needs."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence

from pmsmtool.errors import ConfigError
from pmsmtool.firmware.image import LUT_FORMAT_INT16, LUT_INT16_NO_POINT
from pmsmtool.params.parameter_set import SATURATION, TABLE_NAMES


def encode_table(name: str, numbers: Sequence[float], values: Mapping[str, float]) -> bytes:
    """Return the DOMAIN of an axis or a table; tables in the format ``lut.format`` of the same set says.

    Raises ConfigError: a number does not fit the format.
    """
    try:
        if _is_binary32(name) or values.get("lut.format") != LUT_FORMAT_INT16:
            return struct.pack(f"<{len(numbers)}f", *numbers)
        lsb = values["lut.lsb_a"]
        steps = (LUT_INT16_NO_POINT if math.isnan(x) else round(x / lsb) for x in numbers)
        # Padded as in the image, so that the drive reads the same back before and after a reset.
        return struct.pack(f"<{len(numbers)}h", *steps) + bytes(2 * (len(numbers) % 2))
    except (struct.error, OverflowError, KeyError, ZeroDivisionError) as error:
        raise ConfigError(
            "a number does not fit the table's format", where=name, hint="choose a larger lut.lsb_a"
        ) from error


def decode_table(name: str, data: bytes, values: Mapping[str, float]) -> tuple[float, ...]:
    """Return the numbers of a DOMAIN; the inverse of :func:`encode_table`."""
    if _is_binary32(name) or values.get("lut.format") != LUT_FORMAT_INT16:
        return tuple(map(shortest_binary32, struct.unpack(f"<{len(data) // 4}f", data[: len(data) // 4 * 4])))
    lsb = values["lut.lsb_a"]
    cells = math.prod(int(values.get(f"lut.n_{axis}", 0)) for axis in "xyz") or len(data) // 2
    steps = struct.unpack(f"<{len(data) // 2}h", data[: len(data) // 2 * 2])[:cells]
    return tuple(math.nan if k == LUT_INT16_NO_POINT else k * lsb for k in steps)


def _is_binary32(name: str) -> bool:
    """Whether a table has one format only."""
    return name.startswith("lut.axis_") or name == SATURATION


def look_up_words(encoded: Mapping[str, bytes]) -> bytes:
    """Return axes and tables, then the saturation table, as they stand in the parameter image, one after the other."""
    return b"".join(encoded.get(name, b"") for name in TABLE_NAMES)


def shortest_binary32(value: float) -> float:
    """Return the number with the fewest decimal digits that rounds to the same binary32."""
    if not math.isfinite(value):
        return value
    for digits in range(6, 10):
        short = float(f"{value:.{digits}g}")
        if struct.pack("<f", short) == struct.pack("<f", value):
            return short
    return value
