# SPDX-License-Identifier: MIT
"""What the functions under test return, compared with what they returned when somebody last looked.

Every test of a folder whose ``conftest.py`` has :func:`recorded` can be watched. The numbers in the results of the pure
rooms' functions it calls, of every sixteenth call of the control core, and of what is written over SDO, are added up
with fixed weights. The sum of each function is compared with ``recorded.json`` of that folder. This stands beside the
tests against independent sources: a recorded number says that something has changed, not that it was right before. It
says so of every intended change as well, and of another processor's last digits. So it is done only where it is asked
for: by somebody who moves code whose results must stay, and by ``python -m benchmarks.mutations``:

    PMSMTOOL_RECORDED=compare python -m pytest tests/design

After intended changes look at which tests the difference names, and renew. What then still differs from run to run,
or with another kernel of OpenBLAS, is marked and no longer compared:

    PMSMTOOL_RECORDED=renew python -m pytest tests/design -p no:xdist
    PMSMTOOL_RECORDED=unsteady OPENBLAS_CORETYPE=Prescott python -m pytest tests/design -p no:xdist
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
from collections.abc import Callable, Generator, Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.lib.recfunctions import structured_to_unstructured

from pmsmtool.bus.sdo import SdoChannel, Transfer
from pmsmtool.firmware.core_binding import core

PURE = re.compile(r"pmsmtool\.(design|estimators|firmware|drive|flash)\b")
TOLERANCE = 1e-6  # relative, per number; with five kernels of OpenBLAS at most MEASURED
SMALLEST = 1e-10  # of a number, 1e-9 of an array's largest: below, a number counts as it stands
EVERY = 16  # calls of the core
DEPTH = 9  # of records within records
Sum = tuple[int, float]
"""How many numbers or arrays, and their sum."""


class Numbers:
    """The numbers of everything that is added, each with a weight of its own."""

    def __init__(self) -> None:
        self.terms: list[float] = []
        self.structures: dict[type, list[bytes]] = {}

    def sum(self) -> Sum:
        """Return how many numbers there are, an array being one, and their weighted sum."""
        for kind, copies in self.structures.items():
            records: Any = np.frombuffer(b"".join(copies), dtype=np.dtype(kind))
            for column in structured_to_unstructured(records, dtype=np.dtype(float)).T:
                self._array(column)
        self.structures = {}
        weights = np.cos(0.7 * np.arange(1, len(self.terms) + 1))
        return len(self.terms), round(float(weights @ np.array(self.terms)), 7)

    def add(self, thing: Any, depth: int = 0) -> None:
        """Add the numbers in a result: of arrays, records, sequences, mappings and messages."""
        if isinstance(thing, int | float):
            self._number(float(thing))
        elif isinstance(thing, complex | np.generic | np.ndarray):
            self._array(np.asarray(thing))
        elif isinstance(thing, ctypes.Structure):
            self.structures.setdefault(type(thing), []).append(bytes(thing))
        elif isinstance(thing, str):
            self._array(np.array([float(each) for each in re.findall(r"\d+(?:\.\d+)?", thing)]))
        elif isinstance(thing, Enum):
            self.add(thing.value, depth)
        elif thing is None:
            self.terms.append(0.0)
        elif isinstance(thing, Mapping) and depth < DEPTH:
            for name in sorted(thing, key=str):
                self.add(thing[name], depth + 1)
        elif isinstance(thing, tuple | list) and depth < DEPTH:
            for each in thing:
                self.add(each, depth + 1)
        elif dataclasses.is_dataclass(thing) and not isinstance(thing, type) and depth < DEPTH:
            for field in dataclasses.fields(thing):
                self.add(getattr(thing, field.name, None), depth + 1)

    def _number(self, x: float) -> None:
        """Add one number as an array of one; a relative change counts the same in a large and in a small one."""
        self.terms.append(math.cos(1.0) * (math.asinh(x / SMALLEST) if math.isfinite(x) else 100.0))

    def _array(self, array: np.ndarray) -> None:
        if array.dtype.kind == "c":
            array = np.stack([array.real, array.imag])
        if array.dtype.kind not in "biuf" or not array.size:
            return
        x = array.astype(float).ravel()
        if x.size == 1:
            self._number(float(x[0]))
            return
        finite = np.isfinite(x)
        x = np.where(finite, x, 1.0)
        terms = np.where(finite, np.arcsinh(x / max(SMALLEST, 1e-9 * float(np.max(np.abs(x))))), 100.0)
        self.terms.append(float(np.cos(1.0 + 2.399963 * np.arange(x.size)) @ terms) / math.sqrt(x.size))


class Seen(dict[str, Numbers]):
    """What a test saw, by function; ``sharing`` while it makes what other tests of its module use as well."""

    sharing = False


def _sharing(function: Callable[..., Any], seen: Seen) -> Callable[..., Any]:
    @functools.wraps(function)
    def shared(*args: Any, **kwargs: Any) -> Any:
        before, seen.sharing = seen.sharing, True
        try:
            result = function(*args, **kwargs)
        finally:
            seen.sharing = before
        if not before:
            seen.setdefault(function.__name__, Numbers()).add(result)
        return result

    return shared


def _watching(function: Callable[..., Any], seen: Seen) -> Callable[..., Any]:
    @functools.wraps(function)
    def watched(*args: Any, **kwargs: Any) -> Any:
        if seen.sharing:
            return function(*args, **kwargs)
        numbers = seen.setdefault(function.__name__, Numbers())
        try:
            result = function(*args, **kwargs)
        except Exception as error:
            numbers.add(str(error))
            raise
        numbers.add(result)
        return result

    return watched


def _watching_core(function: Callable[..., Any], name: str, seen: Seen) -> Callable[..., Any]:
    calls = itertools.count()

    def watched(*args: Any) -> Any:
        result = function(*args)
        if not seen.sharing and next(calls) % EVERY == 0:
            numbers = seen.setdefault(name, Numbers())
            for each in (result, args[0], args[-1]):
                if isinstance(each, ctypes.Structure):
                    numbers.add(each)
        return result

    return watched


def _watching_download(function: Callable[..., Transfer], seen: Seen) -> Callable[..., Transfer]:
    @functools.wraps(function)
    def watched(self: SdoChannel, index: int, sub: int, data: bytes, *args: Any, **kwargs: Any) -> Transfer:
        numbers = seen.setdefault("download", Numbers())
        numbers.add(np.array([index, sub, len(data), *data[:64]]))
        return function(self, index, sub, data, *args, **kwargs)

    return watched


PASSED = pytest.StashKey[bool]()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Note whether a test passed: one that is skipped half way has seen less."""
    report = yield
    item.stash[PASSED] = report.passed
    return report


@pytest.fixture(autouse=True)
def recorded(request: pytest.FixtureRequest) -> Iterator[None]:
    """Where it is asked for, watch a test and compare what it saw; one that draws its own examples is left alone."""
    asked = os.environ.get("PMSMTOOL_RECORDED", "")
    if not asked or getattr(request.function, "is_hypothesis_test", False):
        yield
        return
    folder, seen = request.path.parent, Seen()
    package = request.module.__name__.rpartition(".")[0]
    with pytest.MonkeyPatch.context() as patch:
        for module in [each for name, each in sys.modules.items() if name.startswith(package + ".")]:
            for name, thing in list(vars(module).items()):
                if inspect.isfunction(thing) and PURE.match(thing.__module__ or ""):
                    patch.setattr(module, name, _watching(thing, seen))
                elif hasattr(thing, "cache_clear") and module.__name__ == getattr(thing, "__module__", ""):
                    patch.setattr(module, name, _sharing(thing, seen))
        for library in {core().library, core(double=True).library} if folder.name == "firmware" else ():
            for name in ("pmsm_step", "pmsm_project_row", "pmsm_smallest_voltage"):
                patch.setattr(library, name, _watching_core(getattr(library, name), name, seen))
        if folder.name in ("drive", "flash"):
            patch.setattr(SdoChannel, "download", _watching_download(SdoChannel.download, seen))
        yield
    if not request.node.stash.get(PASSED, False):
        return
    path, test = folder / "recorded.json", f"{request.path.name}::{request.node.nodeid.partition('::')[2]}"
    sums = {name: total for name, numbers in sorted(seen.items()) if (total := numbers.sum())[0]}
    if asked != "compare":
        rows = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        held = rows.get(test, {})
        unsteady = {name for name, row in held.items() if row is None}
        if asked == "unsteady":
            unsteady |= {name for name, row in held.items() if row and not _agree(row, sums.get(name, (0, 0.0)))}
            sums = held
        rows[test] = {name: None if name in unsteady else row for name, row in sums.items()}
        lines = (f"{json.dumps(name)}: {json.dumps(rows[name])}" for name in sorted(rows) if rows[name])
        path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
        return
    for name, row in _rows(path).get(test, {}).items():
        found = sums.get(name, (0, 0.0))
        assert row is None or _agree(row, found), (
            f"{name}: {found}, recorded {row} (tests/recorded_results.py says how to renew)"
        )


def _agree(row: Sum, found: Sum) -> bool:
    return row[0] == found[0] and abs(row[1] - found[1]) <= TOLERANCE * math.sqrt(row[0])


@functools.cache
def _rows(path: Path) -> dict[str, dict[str, Sum | None]]:
    rows: dict[str, dict[str, Sum | None]] = json.loads(path.read_text(encoding="utf-8"))
    return rows
