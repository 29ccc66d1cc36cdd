# SPDX-License-Identifier: MIT
"""What the functions under test return, compared with what they returned when somebody last looked.

Every test of a folder that imports :func:`recorded` in its ``conftest.py`` is watched: the numbers in the results of the
pure rooms' functions it calls, and of every sixteenth call of the control core, are added up with fixed weights, a sum
per function, and compared with ``recorded.json`` of that folder. It stands beside the tests against independent
sources: a recorded number says that something has changed, not that it was right before. After an intended change,
look at which tests the difference names, and renew:

    PMSMTOOL_RENEW=1 python -m pytest tests/design -p no:xdist
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import inspect
import itertools
import json
import math
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.lib.recfunctions import structured_to_unstructured

from pmsmtool.firmware.core_binding import core

PURE = re.compile(r"pmsmtool\.(design|estimators|firmware)\b")
TOLERANCE = 1e-6  # relative, per number; with five kernels of OpenBLAS at most MEASURED
SMALLEST = 1e-10  # of a number, 1e-9 of an array's largest: below, a number counts as it stands
EVERY = 16  # calls of the core


class Numbers:
    """A weighted sum over the numbers of everything that is added."""

    def __init__(self) -> None:
        self.sum, self.count = 0.0, 0

    def add(self, thing: Any, depth: int = 0) -> None:
        """Add the numbers in a result: of arrays, records, sequences, mappings and messages."""
        if isinstance(thing, bool | int | float | complex | np.generic | np.ndarray | ctypes.Array):
            self._array(np.asarray(thing))
        elif isinstance(thing, str):
            self._array(np.array([float(each) for each in re.findall(r"\d+(?:\.\d+)?", thing)]))
        elif isinstance(thing, Enum):
            self.add(thing.value, depth)
        elif depth > 8 or thing is None or isinstance(thing, bytes | Path | type) or inspect.isroutine(thing):
            self.count += thing is None
        elif isinstance(thing, Mapping):
            for name in sorted(thing, key=str):
                self.add(thing[name], depth + 1)
        elif isinstance(thing, tuple | list):
            for each in thing:
                self.add(each, depth + 1)
        elif dataclasses.is_dataclass(thing):
            for field in dataclasses.fields(thing):
                self.add(getattr(thing, field.name, None), depth + 1)

    def _array(self, array: np.ndarray) -> None:
        if array.dtype.kind == "c":
            array = np.stack([array.real, array.imag])
        if array.dtype.kind not in "biuf" or not array.size:
            return
        x = array.astype(float).ravel()
        finite = np.isfinite(x)
        x = np.where(finite, x, 1.0)
        least = max(SMALLEST, 1e-9 * float(np.max(np.abs(x)))) if x.size > 1 else SMALLEST
        weights = np.cos(1.0 + 2.399963 * np.arange(x.size)) / math.sqrt(x.size)
        self.count += 1
        self.sum += math.cos(0.7 * self.count) * float(weights @ np.where(finite, np.arcsinh(x / least), 100.0))


def _watching(function: Callable[..., Any], seen: dict[str, Numbers]) -> Callable[..., Any]:
    @functools.wraps(function)
    def watched(*args: Any, **kwargs: Any) -> Any:
        numbers = seen.setdefault(function.__name__, Numbers())
        try:
            result = function(*args, **kwargs)
        except Exception as error:
            numbers.add(str(error))
            raise
        numbers.add(result)
        return result

    return watched


def _watching_core(function: Callable[..., Any], name: str, seen: dict[str, Numbers]) -> Callable[..., Any]:
    calls = itertools.count()

    def watched(*args: Any) -> Any:
        result = function(*args)
        if next(calls) % EVERY == 0:
            numbers = seen.setdefault(name, Numbers())
            for each in (result, *args):
                if isinstance(each, ctypes.Structure):
                    record = np.frombuffer(each, dtype=_dtype(type(each)))
                    numbers.add(structured_to_unstructured(record, dtype=float))
        return result

    return watched


_dtype = functools.cache(np.dtype)


@pytest.fixture(autouse=True)
def recorded(request: pytest.FixtureRequest) -> Iterator[None]:
    """Watch a test and compare what it saw; a test that draws its own examples is left alone."""
    if getattr(request.function, "is_hypothesis_test", False):
        yield
        return
    folder, seen = request.path.parent, dict[str, Numbers]()
    package = request.module.__name__.rpartition(".")[0]
    with pytest.MonkeyPatch.context() as patch:
        for module in [each for name, each in sys.modules.items() if name.startswith(package + ".")]:
            for name, thing in list(vars(module).items()):
                if inspect.isfunction(thing) and PURE.match(thing.__module__ or ""):
                    patch.setattr(module, name, _watching(thing, seen))
        for library in {core().library, core(double=True).library} if folder.name == "firmware" else ():
            for name in ("pmsm_step", "pmsm_project_row", "pmsm_smallest_voltage"):
                patch.setattr(library, name, _watching_core(getattr(library, name), name, seen))
        yield
    path, test = folder / "recorded.json", request.node.nodeid.rpartition("/")[2]
    sums = {name: [numbers.count, round(numbers.sum, 7)] for name, numbers in sorted(seen.items()) if numbers.count}
    if os.environ.get("PMSMTOOL_RENEW"):
        rows = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        rows |= {test: sums}
        lines = (f"{json.dumps(name)}: {json.dumps(rows[name])}" for name in sorted(rows) if rows[name])
        path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
        return
    for name, (count, value) in _rows(path).get(test, {}).items():
        assert seen[name].count == count, f"{name}: {seen[name].count} results, {count} recorded"
        assert abs(seen[name].sum - value) <= TOLERANCE * math.sqrt(count), f"{name} returns other numbers"


@functools.cache
def _rows(path: Path) -> dict[str, dict[str, tuple[int, float]]]:
    rows: dict[str, dict[str, tuple[int, float]]] = json.loads(path.read_text(encoding="utf-8"))
    return rows
