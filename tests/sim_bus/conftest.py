# SPDX-License-Identifier: MIT
"""Benches for the tests of the bus; see ``tests/node``."""

from tests.node.conftest import bench, make_bench

__all__ = ["bench", "make_bench"]
