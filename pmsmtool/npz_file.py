# SPDX-License-Identifier: MIT
"""NumPy archives with deterministic bytes, and their reading with one clear error each."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.errors import ConfigError, next_step
from pmsmtool.files import NUMBERS_BYTES, read_bytes, too_large

NEXT_STEP = "give a file that pmsmtool wrote, or numpy.savez without objects"

_MOST_ARRAYS = 1000
"""A trace of the simulator has some 60."""
_EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time stamp of every member, the oldest a ZIP archive can hold."""


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return the bytes of an uncompressed ``.npz`` archive (compressed bytes depend on the zlib in use).

    Parameters
    ----------
    arrays : mapping of str to ndarray
        Members in this order; object arrays are refused.
    """
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy", date_time=_EPOCH)
            member.create_system = 3  # as on Unix, whatever the host
            member.external_attr = 0o600 << 16
            text = io.BytesIO()
            np.lib.format.write_array(text, np.asarray(array, order="C"), version=(1, 0), allow_pickle=False)
            archive.writestr(member, text.getvalue())
    return out.getvalue()


@next_step(NEXT_STEP)
def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an ``.npz`` archive.

    What the archive announces is added up before anything is unpacked: every number counts 8 bytes, which is what it
    takes once it is computed with.

    Raises ConfigError: missing, too large, truncated, not an archive, or holding Python objects (which are never
    executed).
    """
    where = str(path)
    content = read_bytes(path, largest=NUMBERS_BYTES)
    if content.startswith(b"\x93NUMPY"):
        raise ConfigError("is a single array, not an .npz archive", where=where, hint="write named arrays with savez")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
            if len(members) > _MOST_ARRAYS:
                raise ConfigError(f"holds {len(members)} arrays, at most {_MOST_ARRAYS} are read", where=where)
            room = NUMBERS_BYTES - sum(member.file_size for member in members)
            for member in members:
                room -= _widened_bytes(archive, member) if room >= 0 else 0
                if room < 0:
                    raise too_large("the unpacked content", NUMBERS_BYTES, where)
            return {member.filename.removesuffix(".npy"): _array(archive, member) for member in members}
    except ConfigError:
        raise
    except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds on damaged files
        raise ConfigError(
            "is not a complete .npz archive of numbers",
            where=where,
            likely=f"truncated or another format ({error})",
            hint="write the file again",
        ) from None


def _shape(stream: IO[bytes]) -> tuple[int, np.dtype[Any]]:
    """Return how many numbers an array announces and their type; the stream stands behind that."""
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = read(stream)
    return math.prod(shape), kind


def _widened_bytes(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> int:
    """Return the bytes that an array takes beyond those of its file once its numbers have 8 bytes each."""
    with archive.open(member) as stream:
        count, kind = _shape(stream)
        if kind.hasobject or count * kind.itemsize != member.file_size - stream.tell():
            raise ValueError(f"{member.filename} is not an array of {count} {kind}")
        return count * max(8 - kind.itemsize, 0)


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    with archive.open(member) as stream:
        array: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
        return array
