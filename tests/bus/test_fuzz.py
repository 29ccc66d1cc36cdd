# SPDX-License-Identifier: MIT
"""Random frames, a few thousand here; ``benchmarks/fuzz.py`` takes a hundred thousand."""

from __future__ import annotations

import pytest

from tests.bus.frame_fuzz import transfers


@pytest.mark.parametrize("seed", range(5))
def test_random_frames_end_in_bytes_or_in_an_error_of_ours(seed: int) -> None:
    ended = transfers(seed, 200)
    assert sum(ended.values()) == 200
    assert {"done", "SdoAbort", "DriveTimeout"} <= set(ended), "the frames reach every kind of end"
