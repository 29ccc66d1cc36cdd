# SPDX-License-Identifier: MIT
"""NumPy archives: deterministic bytes, and one clear error per kind of damage."""

import io
import tracemalloc
import zipfile

import numpy as np
import pytest

from pmsmtool.errors import ConfigError
from pmsmtool.files import NUMBERS_BYTES
from pmsmtool.npz_file import npz_bytes, read_npz

ARRAYS = {"x": np.arange(5.0), "grid": np.arange(6).reshape(2, 3), "text": np.array('{"a": 1}')}


def test_reads_back(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(npz_bytes(ARRAYS))
    back = read_npz(path)
    assert list(back) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert back[name].dtype == array.dtype
        assert back[name].shape == array.shape
        assert np.array_equal(back[name], array)


def test_same_arrays_same_bytes():
    assert npz_bytes(ARRAYS) == npz_bytes({name: np.array(array, order="F") for name, array in ARRAYS.items()})


def test_numpy_reads_it(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(npz_bytes(ARRAYS))
    with np.load(path) as archive:
        assert np.array_equal(archive["grid"], ARRAYS["grid"])


def test_objects_are_not_written():
    with pytest.raises(ValueError, match="Object arrays"):
        npz_bytes({"x": np.array([object()])})


def test_missing_file(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        read_npz(tmp_path / "none.npz")


def test_a_folder_is_no_archive(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_npz(tmp_path)


@pytest.mark.parametrize("keep", [0, 1, 10, 100, 300])
def test_truncated_file(tmp_path, keep):
    path = tmp_path / "a.npz"
    path.write_bytes(npz_bytes(ARRAYS)[:keep])
    with pytest.raises(ConfigError, match="is not a complete"):
        read_npz(path)


def test_damaged_member(tmp_path):
    path = tmp_path / "a.npz"
    data = bytearray(npz_bytes(ARRAYS))
    data[data.index(b"NUMPY") + 130] ^= 0xFF
    path.write_bytes(bytes(data))
    with pytest.raises(ConfigError):
        read_npz(path)


def test_pickles_are_never_loaded(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, x=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ConfigError):
        read_npz(path)


def test_a_single_array_is_no_archive(tmp_path):
    path = tmp_path / "a.npz"
    with path.open("wb") as file:
        np.save(file, np.arange(3))
    with pytest.raises(ConfigError, match="single array"):
        read_npz(path)


def bomb(kind, count, *, said=None):
    """A small archive with one array that announces ``said`` numbers and unpacks to ``count`` of them."""
    header = io.BytesIO()
    fields = {"descr": np.dtype(kind).str, "fortran_order": False, "shape": (said or count,)}
    np.lib.format.write_array_header_1_0(header, fields)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("x.npy", "w") as member:
        member.write(header.getvalue())
        block = bytes(1 << 20)
        for _ in range(count * np.dtype(kind).itemsize >> 20):
            member.write(block)
    return out.getvalue()


@pytest.mark.chain
@pytest.mark.parametrize(
    ("data", "said"),
    [
        (lambda: bomb("f8", (NUMBERS_BYTES >> 3) + (1 << 17)), "more than the 128 MiB"),
        (lambda: bomb("i1", 17 << 20), "more than the 128 MiB"),  # 136 MiB once it is computed with
        (lambda: bomb("f8", 1 << 17, said=1 << 50), "is not an array of"),
    ],
    ids=["unpacked size", "widened numbers", "header only"],
)
def test_what_an_archive_announces_is_refused_before_it_is_unpacked(tmp_path, data, said):
    path = tmp_path / "bomb.npz"
    path.write_bytes(data())
    assert path.stat().st_size < 1 << 20
    tracemalloc.start()
    try:
        with pytest.raises(ConfigError) as caught:
            read_npz(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert said in f"{caught.value}"
    assert peak < 4 << 20  # 2 GB before
