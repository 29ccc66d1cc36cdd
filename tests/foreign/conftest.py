# SPDX-License-Identifier: MIT
"""The command line of ``tests/cli``, on drives of other makers."""

import pytest

from tests.cli.conftest import tool

__all__ = ["tool"]


@pytest.fixture(autouse=True)
def _no_drawing(undrawn: None) -> None:
    """Reports of these chains are written, not looked at."""
