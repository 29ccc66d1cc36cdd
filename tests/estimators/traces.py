# SPDX-License-Identifier: MIT
"""Traces that a test writes down itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pmsmtool.arrays import Array
from pmsmtool.trace import Trace


def trace_of(t: Array, meta: Mapping[str, Any] | None = None, **signals: Array) -> Trace:
    """Return a trace of signals without units."""
    return Trace(t, signals, dict.fromkeys(signals, "1"), dict(meta or {}))
