"""NumPy archives with deterministic bytes, and their reading with one clear error each."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.errors import ConfigError, next_step

NEXT_STEP = "give a file that pmsmtool wrote, or numpy.savez without objects"

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

    Raises
    ------
    ConfigError
        Missing, truncated, not an archive, or holding Python objects (which are never executed).
    """
    try:
        loaded = np.load(path, allow_pickle=False)
        if not isinstance(loaded, np.lib.npyio.NpzFile):
            raise ConfigError(
                "is a single array, not an .npz archive", where=str(path), hint="write named arrays with numpy.savez"
            )
        with loaded as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError:
        raise ConfigError("no such file", where=str(path), hint="check the path") from None
    except ConfigError:
        raise
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror or error}", where=str(path)) from None
    except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds on damaged files
        raise ConfigError(
            "is not a complete .npz archive of numbers",
            where=str(path),
            likely=f"truncated or another format ({error})",
            hint="write the file again",
        ) from None
