# SPDX-License-Identifier: MIT
"""The command line of ``tests/cli``, on drives of other makers."""

from tests.cli.conftest import tool

__all__ = ["tool"]
