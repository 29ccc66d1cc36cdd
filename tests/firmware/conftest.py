# SPDX-License-Identifier: MIT
"""Every test here can be watched by :mod:`tests.recorded_results`."""

from tests.recorded_results import recorded

__all__ = ["recorded"]
