# SPDX-License-Identifier: MIT
"""Fixtures: benches with simulated drives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.node.bench import Bench, open_bench

BenchMaker = Callable[..., Bench]


@pytest.fixture
def make_bench() -> Iterator[BenchMaker]:
    """Return a maker of benches, see ``open_bench``."""
    opened: list[Bench] = []

    def make(**wanted: Any) -> Bench:
        opened.append(open_bench(**wanted))
        return opened[-1]

    yield make
    for bench in opened:
        bench.bus.shutdown()


@pytest.fixture
def bench(make_bench: BenchMaker) -> Bench:
    """Return a bench with one drive in PRE-OPERATIONAL."""
    return make_bench()
