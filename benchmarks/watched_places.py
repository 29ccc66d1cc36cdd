# SPDX-License-Identifier: MIT
"""What a watched operator computes in the copies of ``benchmarks.mutations``: both results, and whether they differ.

Every place has a byte in a file that all processes share; it is 1 where the place's mutation made a difference.
"""

from __future__ import annotations

import mmap
import operator
import os
import sys
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

PLACES = "PMSMTOOL_WATCHED_PLACES"
_OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq, "!=": operator.ne,
    "+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv,
}  # fmt: skip
with open(os.environ[PLACES], "r+b") as file:
    NOTED = mmap.mmap(file.fileno(), 0)


def reached(number: int, value: Any) -> Any:
    """Note a place that is computed at all; return its value."""
    NOTED[number] = 1
    return value


def computed(number: int, symbol: str, other: str, left: Any, right: Any) -> Any:
    """Note a place where another operator gives another value; return the value of the one that is written."""
    value = _OPERATORS[symbol](left, right)
    if not NOTED[number]:
        numpy = sys.modules.get("numpy")
        try:
            with numpy.errstate(all="ignore") if numpy else nullcontext():
                same = value is (changed := _OPERATORS[other](left, right)) or not _any(value != changed)
        except Exception:
            same = False
        NOTED[number] = not same
    return value


def _any(different: Any) -> bool:
    return bool(different.any()) if hasattr(different, "any") else bool(different)
