# SPDX-License-Identifier: MIT
"""Trace: named signals over one time base, with units and the facts needed to read them.

Its files are ``.npz`` (fast, exact) and ``.csv``; same trace, same bytes. NPZ: one array per signal, ``t_s``, and the
members ``_units`` and ``_meta`` (JSON). CSV: row 1 names, row 2 units, then one row per sample with the shortest text
that reads back to the same number; facts, if any, in a last line that starts with ``# {``.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.errors import ConfigError, next_step
from pmsmtool.files import ROWS_BYTES, read_text, write_file
from pmsmtool.npz_file import npz_bytes, read_npz
from pmsmtool.plain_text import Summarised, Summary
from pmsmtool.units import UNITS


@dataclass(frozen=True, slots=True, repr=False)
class Trace(Summarised):
    """Samples of several signals at common instants.

    Row k of a drive trace holds the currents and the angle *sampled* at ``t_s[k]`` and the voltage
    command *computed* there, which acts in the stator frame one period later (identification
    reference, "trace row k").

    Parameters
    ----------
    t_s : ndarray, shape (n,)
        Sampling instants (s), increasing.
    signals : mapping of str to ndarray, shape (n,)
        One array per signal; the unit is the name's suffix (``i_d_a``, ``u_q_v``, ``theta_e_rad``).
    units : mapping of str to str
        Unit of each signal, as in ``units.UNITS``.
    meta : mapping
        JSON-serialisable facts: period, excitation, temperatures, flags' meaning.
    """

    t_s: NDArray[np.float64]
    signals: Mapping[str, NDArray[np.float64]]
    units: Mapping[str, str]
    meta: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, values in self.signals.items():
            if values.shape != self.t_s.shape:
                raise ValueError(f"signal {name} has {values.shape}, the time base {self.t_s.shape}")
            if name not in self.units:
                raise ValueError(f"signal {name} has no unit")

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return one signal; raises ``KeyError`` with the nearest name where there is none."""
        try:
            return self.signals[name]
        except KeyError:
            near = get_close_matches(name, self.signals, n=1, cutoff=0.5)
            raise KeyError(f"no signal {name!r}" + (f"; did you mean {near[0]}?" if near else "")) from None

    def summary(self) -> Summary:
        """Return the range of each signal."""
        span = f" from {self.t_s[0]:.6g} to {self.t_s[-1]:.6g} s" if len(self) else ""
        units = {name: "-" if unit == "1" else unit for name, unit in self.units.items()}  # "1" looks like a value
        rows = [
            (name, units[name], *((f"{values.min():.5g}", f"{values.max():.5g}") if len(self) else ("", "")))
            for name, values in self.signals.items()
        ]
        notes = [self.trip] if self.trip else []
        return Summary(f"trace: {len(self)} rows{span}", ("signal", "unit", "least", "largest"), rows, notes)

    @property
    def trip(self) -> str:
        """Whether and when a simulated drive switched off by itself, as a sentence; else an empty text."""
        codes = self.signals.get("trip")
        if codes is None or not codes.any():
            return ""
        first = int((codes != 0).argmax())
        return f"the drive tripped (error code {int(codes[first]):#06x}) at {self.t_s[first]:.6g} s"

    @staticmethod
    def load(path: str | Path) -> Trace:
        """Read a trace that a command wrote (.npz or .csv), as :func:`~pmsmtool.trace.read_trace` does."""
        return read_trace(Path(path))

    def __len__(self) -> int:
        return len(self.t_s)

    def rows(self, which: slice | NDArray[np.bool_]) -> Trace:
        """Return the trace of some of its rows, at their instants."""
        signals: Any = copy(self.signals)  # those of a file name it where one is missing
        for name, values in self.signals.items():
            signals[name] = values[which]
        return replace(self, t_s=self.t_s[which], signals=signals)

    @property
    def period_s(self) -> float:
        """Sampling period (s)."""
        return float(self.t_s[-1] - self.t_s[0]) / (len(self.t_s) - 1)


NEXT_STEP = "give a trace as pmsmtool writes it: .npz, or .csv with names in row 1 and units in row 2"

_UNITS, _META = "_units", "_meta"


class Recorded(dict[str, Any]):
    """Signals or facts that were read from a file: one that is not there is the file's fault, and said so.

    Parameters
    ----------
    found : mapping of str
        What the file holds.
    kind : str
        What it is, in the singular.
    where : str
        The file.
    """

    def __init__(self, found: Mapping[str, Any], kind: str, where: str) -> None:
        super().__init__(found)
        self.kind = kind
        self.where = where

    def __missing__(self, name: str) -> Any:
        """Name the file and what it has not. Raises ConfigError: always."""
        raise ConfigError(
            f"the record has no {self.kind} {name}",
            where=self.where,
            likely="an earlier version wrote it, whose experiment was another one",
            hint="run the experiment again, or use the version that wrote it (run.json of a run directory names it)",
        )


def write_trace(trace: Trace, path: Path) -> None:
    """Write a trace by suffix, ``.npz`` or ``.csv``, replacing the file at once.

    Raises ConfigError: another suffix, or the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in (".npz", ".csv"):
        raise _no_format(path)
    data = trace_npz(trace) if suffix == ".npz" else trace_csv(trace).encode()
    write_file(path, data)


@next_step(NEXT_STEP)
def read_trace(path: str | Path) -> Trace:
    """Read a trace by suffix.

    Raises
    ------
    ConfigError
        Missing, truncated, not numeric, without time base or units, or time does not increase.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return _from_arrays(read_npz(path), str(path))
    if suffix == ".csv":
        return _from_csv(path)
    raise _no_format(path)


def _no_format(path: Path) -> ConfigError:
    what = f"{path.suffix or 'a name without suffix'} is no trace format"
    return ConfigError(what, where=str(path), hint="use .npz or .csv")


def trace_npz(trace: Trace) -> bytes:
    """Return the bytes of the ``.npz`` file."""
    texts = {_UNITS: _json(trace.units), _META: _json(trace.meta)}
    return npz_bytes(
        {
            "t_s": trace.t_s,
            **dict(trace.signals),
            **{name: np.array(text) for name, text in texts.items()},
        }
    )


def trace_csv(trace: Trace) -> str:
    """Return the text of the ``.csv`` file."""
    names = list(trace.signals)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["t_s", *names])
    writer.writerow(["s", *(trace.units[name] for name in names)])
    columns = [np.asarray(column, dtype=np.float64).tolist() for column in (trace.t_s, *trace.signals.values())]
    out.writelines(",".join(map(repr, row)) + "\n" for row in zip(*columns, strict=True))
    if trace.meta:
        out.write(f"# {_json(trace.meta)}\n")
    return out.getvalue()


def _json(facts: Mapping[str, Any]) -> str:
    return json.dumps(dict(facts), sort_keys=True, ensure_ascii=True)


def _from_arrays(arrays: dict[str, NDArray[Any]], where: str) -> Trace:
    try:
        units = dict(json.loads(str(arrays.pop(_UNITS, "{}"))))
        meta = dict(json.loads(str(arrays.pop(_META, "{}"))))
    except (TypeError, ValueError):
        raise ConfigError("units or facts are not JSON", where=where) from None
    for name, array in arrays.items():
        if array.dtype.kind not in "fiub" or array.ndim != 1:
            raise ConfigError(f"{name} is not a vector of numbers ({array.dtype}, {array.shape})", where=where)
    columns = {name: np.asarray(array, dtype=np.float64) for name, array in arrays.items()}
    return _trace(columns, units, meta, where)


def _trace(columns: dict[str, NDArray[np.float64]], units: dict[str, str], meta: dict[str, Any], where: str) -> Trace:
    t_s = columns.pop("t_s", None)
    if t_s is None:
        raise ConfigError("has no column t_s", where=where, hint="the time base is called t_s and is in seconds")
    violations = [f"{name} has no unit" for name in columns if not units.get(name)]
    violations += [f"{name}: unknown unit {units[name]!r}" for name in columns if units.get(name, "1") not in UNITS]
    violations += [f"{name} has {len(c)} values, t_s {len(t_s)}" for name, c in columns.items() if len(c) != len(t_s)]
    if len(t_s) == 0 or not np.all(np.isfinite(t_s)):
        violations.append("t_s is empty or not finite")
    elif np.any(np.diff(t_s) <= 0):
        violations.append(f"t_s does not increase at sample {int(np.argmax(np.diff(t_s) <= 0)) + 1}")
    if violations:
        raise ConfigError("is not a trace", where=where, violations=violations)
    signals, facts = Recorded(columns, "signal", where), Recorded(meta, "fact", where)
    return Trace(t_s, signals, {name: units[name] for name in columns}, facts)


def _from_csv(path: Path) -> Trace:
    where = str(path)
    lines = read_text(path, largest=ROWS_BYTES, encoding="utf-8-sig").splitlines()
    meta: dict[str, Any] = {}
    if lines and lines[-1].startswith("# {"):
        try:
            meta = dict(json.loads(lines.pop()[2:]))
        except ValueError:
            raise ConfigError("the last line is not JSON", where=where, likely="a truncated file") from None
    if len(lines) < 2:
        raise ConfigError("is no trace: row 1 holds names, row 2 units", where=where)
    names, units = next(csv.reader([lines[0]])), next(csv.reader([lines[1]]))
    if len(names) != len(units) or len(set(names)) != len(names):
        raise ConfigError(f"{len(names)} names (each once) need as many units, not {len(units)}", where=f"{where}:2")
    values = _csv_values(lines, len(names), where)
    columns = {name.strip(): np.ascontiguousarray(values[:, k]) for k, name in enumerate(names)}
    return _trace(columns, dict(zip((n.strip() for n in names), units, strict=True)), meta, where)


def _csv_values(lines: list[str], columns: int, where: str) -> NDArray[np.float64]:
    values = np.empty((len(lines) - 2, columns))
    for number, line in enumerate(lines[2:], start=3):
        cells = line.split(",")
        if len(cells) != columns:
            raise ConfigError(
                f"the row has {len(cells)} values for {columns} columns",
                where=f"{where}:{number}",
                likely="a truncated file",
            )
        try:
            values[number - 3] = [float(cell) for cell in cells]
        except ValueError as error:
            raise ConfigError(f"not a number: {error}", where=f"{where}:{number}") from None
    return values
