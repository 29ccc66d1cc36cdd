# SPDX-License-Identifier: MIT
"""MATLAB files: the same content as scipy reads, and every damaged file one clear error."""

from __future__ import annotations

import random
import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from pmsmtool.errors import ConfigError
from pmsmtool.machine.mat_file import read_mat

CONTENT: dict[str, Any] = {
    "doubles": np.linspace(-3.0, 5.0, 12).reshape(3, 4),
    "singles": np.arange(6, dtype=np.float32).reshape(2, 3),
    "bytes_in_a_small_element": np.array([[1, 2, 3]], dtype=np.uint8),
    "cube": np.arange(24.0).reshape(2, 3, 4),
    "complex": np.array([[1.0 + 2.0j, -0.5j], [3.0, 4.0 - 1.0j]]),
    "scalar": 2.5,
}


@pytest.mark.parametrize("compressed", [False, True])
def test_numbers_are_those_that_scipy_reads(tmp_path: Path, compressed: bool) -> None:
    path = tmp_path / "content.mat"
    savemat(path, CONTENT, do_compression=compressed)
    found, expected = read_mat(path), loadmat(path, squeeze_me=True)
    assert set(found) == set(CONTENT)
    for name, value in found.items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)


def test_structures_are_tables_and_what_is_no_number_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "content.mat"
    savemat(
        path, {"motor": {"map": {"psi": np.eye(3)}, "name": "x"}, "text": "no", "cells": np.array([1, "a"], object)}
    )
    found = read_mat(path)
    assert list(found) == ["motor"]
    assert list(found["motor"]) == ["map"]
    np.testing.assert_array_equal(found["motor"]["map"]["psi"], np.eye(3))


def test_other_levels_are_named(tmp_path: Path) -> None:
    old, new = tmp_path / "old.mat", tmp_path / "new.mat"
    savemat(old, {"a": np.eye(2)}, format="4")
    new.write_bytes(b"MATLAB 7.3".ljust(512) + b"\x89HDF\r\n\x1a\n")
    with pytest.raises(ConfigError, match="not a MATLAB file of level 5"):
        read_mat(old)
    with pytest.raises(ConfigError, match="MATLAB 7.3"):
        read_mat(new)
    with pytest.raises(ConfigError, match="no such file"):
        read_mat(tmp_path / "missing.mat")


@pytest.mark.parametrize("compressed", [False, True])
def test_a_file_that_was_cut_anywhere_is_refused_or_holds_whole_arrays(tmp_path: Path, compressed: bool) -> None:
    whole, cut = tmp_path / "whole.mat", tmp_path / "cut.mat"
    savemat(whole, CONTENT, do_compression=compressed)
    data = whole.read_bytes()
    refused = 0
    for size in range(0, len(data), 3):
        cut.write_bytes(data[:size])
        try:
            found = read_mat(cut)
        except ConfigError:
            refused += 1
        else:
            for name, value in found.items():
                np.testing.assert_array_equal(value, np.squeeze(CONTENT[name]), err_msg=name)
    assert refused > 0.8 * len(data) / 3


def test_damaged_bytes_end_in_arrays_or_in_one_error(tmp_path: Path) -> None:
    """10^5 of them are read by ``benchmarks/fuzz.py``; scipy ended the process on one of the first 2000."""
    path = tmp_path / "content.mat"
    savemat(path, CONTENT)
    data, rng, refused = path.read_bytes(), random.Random(1), 0
    for _ in range(500):
        changed = bytearray(data)
        for _ in range(3):
            changed[rng.randrange(128, len(data))] = rng.randrange(256)
        path.write_bytes(changed)
        try:
            read_mat(path)
        except ConfigError:
            refused += 1
    assert 0 < refused < 500


def _stream(element):
    packed = zlib.compress(element, 9)
    return struct.pack("<II", 15, len(packed)) + packed


def _bombs():
    import io

    many = io.BytesIO()
    savemat(many, {f"x{k}": np.zeros(1 << 17) for k in range(20)}, do_compression=True)
    size = (16 << 20) - 16
    header = b"MATLAB 5.0".ljust(124) + b"\0\1IM"
    return {
        "sum of arrays": (many.getvalue(), "more than the 16 MiB"),
        "one array": (header + _stream(struct.pack("<II", 14, 2 * size) + bytes(2 * size)), "more than the 16 MiB"),
        "empty elements": (header + _stream(struct.pack("<II", 14, size) + bytes(size)), "more than 10000 elements"),
    }


@pytest.mark.chain
@pytest.mark.parametrize("kind", ["sum of arrays", "one array", "empty elements"])
def test_streams_that_unpack_to_gigabytes_are_refused_at_the_limit(tmp_path, kind):
    data, said = _bombs()[kind]
    assert len(data) < 64 << 10
    path = tmp_path / "bomb.mat"
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(ConfigError) as caught:
            read_mat(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert said in f"{caught.value}"
    assert peak < 80 << 20  # 4.25 GB before for a file of 1 MB
