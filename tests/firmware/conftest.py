# SPDX-License-Identifier: MIT
"""Every test here can be watched by :mod:`tests.recorded_results`."""

from tests.recorded_results import pytest_runtest_makereport, recorded

__all__ = ["pytest_runtest_makereport", "recorded"]
