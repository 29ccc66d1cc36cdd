# SPDX-License-Identifier: MIT
"""Faults on purpose: what a simulated bus and drive do wrong, from a TOML file, the same for the same seed.

:data:`EXAMPLE` shows every table and key. A frame is corrupted behind the CAN controller (a gateway, a driver): one bit
of its data flips, no error is seen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pmsmtool.errors import ConfigError, next_step
from pmsmtool.files import read_text
from pmsmtool.toml_file import parse_toml

NEXT_STEP = "`pmsmtool sim faults` prints an example with every key"

EXAMPLE = """\
# Faults on purpose, for pmsmtool sim serve --faults FILE, or -i pmsmsim -c 'NAME?faults=FILE'.
# The same seed gives the same faults. Delete what you do not want; every table may appear several times.

[[frame]]                           # rules for frames, tried in order; the first that strikes acts
action = "drop"                     # drop | delay | duplicate | reorder | corrupt (one bit of the data flips)
probability = 0.001                 # per matching frame; default 1
direction = "both"                  # to-drive | from-drive | both
ids = ["0x581", "0x601-0x67F"]      # identifiers; default all
after = 100                         # the first 100 matching frames pass untouched
count = 3                           # strikes at most three times

[[frame]]
action = "delay"
delay_s = 0.45                      # delay: how late; reorder: the longest it waits for the next frame
ids = "0x581"
probability = 0.01

[[drive]]                           # something happens to a drive
action = "reset"                    # reset | unplug | power-cut
node = 1                            # node id; default: the first drive
at_frame = 5000                     # when that many frames have passed on the line; or:
# at_s = 1.5                        # at this time of the bus; or:
# at_store_step = 3                 # after that many write steps of its non-volatile memory

[[drive]]
action = "power-cut"
at_s = 600.0
back_after_s = 0.5                  # powered, or plugged in, again; default never

[[adapter]]                         # the program's adapter is pulled: sending fails, nothing is received
at_s = 900.0                        # or at_frame
recv_raises = false                 # some adapters raise in recv, too

[[refuse]]                          # writes that the drive refuses
object = "0x2010:02"
code = "0x06090030"
count = 1                           # default: always

[[lie]]                             # uploads whose announced size is wrong
object = "0x2062:00"
announce = 16                       # bytes announced beyond those sent
cut = 0                             # bytes left out at the end

[[absent]]                          # an object that this firmware does not have
object = "0x60B2"                   # all of an index, or one sub-object: "0x2070:12"

[store]
factor = 2.0                        # storing takes that many times as long
"""
"""A faults file with every table, every key and what it means."""

FRAME_ACTIONS = ("drop", "delay", "duplicate", "reorder", "corrupt")
DRIVE_ACTIONS = ("reset", "unplug", "power-cut")
DIRECTIONS = ("to-drive", "from-drive", "both")
DEFAULT_DELAY_S = 0.005


@dataclass(frozen=True, slots=True)
class FrameFault:
    """A rule for frames (``[[frame]]``)."""

    action: str
    probability: float = 1.0
    direction: str = "both"
    ids: tuple[tuple[int, int], ...] = ()
    after: int = 0
    count: int | None = None
    delay_s: float = DEFAULT_DELAY_S

    def matches(self, can_id: int, from_drive: bool) -> bool:
        """Whether the rule is about a frame."""
        if self.direction != "both" and (self.direction == "from-drive") != from_drive:
            return False
        return not self.ids or any(low <= can_id <= high for low, high in self.ids)


@dataclass(frozen=True, slots=True)
class DriveFault:
    """Something that happens to a drive (``[[drive]]``)."""

    action: str
    node: int | None = None
    at_frame: int | None = None
    at_s: float | None = None
    at_store_step: int | None = None
    back_after_s: float | None = None


@dataclass(frozen=True, slots=True)
class AdapterFault:
    """The adapter is pulled (``[[adapter]]``)."""

    at_frame: int | None = None
    at_s: float | None = None
    recv_raises: bool = False


@dataclass(frozen=True, slots=True)
class Refusal:
    """Writes the drive refuses (``[[refuse]]``)."""

    target: tuple[int, int]
    code: int
    count: int | None = None


@dataclass(frozen=True, slots=True)
class Lie:
    """Uploads with a wrong announced size (``[[lie]]``)."""

    target: tuple[int, int]
    announce: int = 0
    cut: int = 0


@dataclass(frozen=True, slots=True)
class Absence:
    """An object the drive does not have (``[[absent]]``); ``sub`` None: the whole index."""

    index: int
    sub: int | None = None


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """All faults of a file."""

    frames: tuple[FrameFault, ...] = ()
    drives: tuple[DriveFault, ...] = ()
    adapters: tuple[AdapterFault, ...] = ()
    refusals: tuple[Refusal, ...] = ()
    lies: tuple[Lie, ...] = ()
    absences: tuple[Absence, ...] = ()
    store_factor: float = 1.0


# ---- the file ------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Reader:
    """Collects what is wrong with a faults file."""

    violations: list[str] = field(default_factory=list)

    def table(self, name: str, table: Mapping[str, Any], known: Mapping[str, Callable[[Any], Any]]) -> dict[str, Any]:
        found = {}
        for key, value in table.items():
            if key not in known:
                self.violations.append(f"{name} {key}: unknown key, known are {', '.join(known)}")
                continue
            try:
                found[key] = known[key](value)
            except (TypeError, ValueError) as error:
                self.violations.append(f"{name} {key} = {value!r}: {error}")
        return found

    def require(self, name: str, table: Mapping[str, Any], *keys: str) -> bool:
        missing = [key for key in keys if key not in table]
        if missing:
            self.violations.append(f"{name}: {', '.join(missing)} missing")
        return not missing


def _choice(*allowed: str) -> Callable[[Any], str]:
    def check(value: Any) -> str:
        if value not in allowed:
            raise ValueError(f"allowed are {', '.join(allowed)}")
        return str(value)

    return check


def _number(low: float, high: float) -> Callable[[Any], float]:
    def check(value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise ValueError(f"must be a number within {low:g} .. {high:g}")
        return float(value)

    return check


def _whole(low: int, high: int = 1 << 62) -> Callable[[Any], int]:
    def check(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise ValueError(f"must be a whole number of at least {low}")
        return value

    return check


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError("must be true or false")
    return value


def _integer(value: Any) -> int:
    return value if isinstance(value, int) and not isinstance(value, bool) else int(str(value), 0)


def _object(value: Any) -> tuple[int, int]:
    index, _, sub = str(value).partition(":")
    return int(index, 0), int(sub or "0", 16)


def _absence(value: Any) -> Absence:
    index, sub = _object(value)
    return Absence(index, sub if ":" in str(value) else None)


def _ids(value: Any) -> tuple[tuple[int, int], ...]:
    items = value if isinstance(value, list) else [value]
    ranges = []
    for item in items:
        low, _, high = str(item).partition("-")
        ranges.append((int(low, 0), int(high or low, 0)))
    return tuple(ranges)


_WHEN: dict[str, Callable[[Any], Any]] = {"at_frame": _whole(1), "at_s": _number(0, 1e9)}
_FRAME: dict[str, Callable[[Any], Any]] = {
    "action": _choice(*FRAME_ACTIONS),
    "probability": _number(0, 1),
    "direction": _choice(*DIRECTIONS),
    "ids": _ids,
    "after": _whole(0),
    "count": _whole(1),
    "delay_s": _number(0, 3600),
}
_DRIVE: dict[str, Callable[[Any], Any]] = {
    **_WHEN,
    "action": _choice(*DRIVE_ACTIONS),
    "node": _whole(1, 127),
    "at_store_step": _whole(1),
    "back_after_s": _number(0, 1e9),
}
_ADAPTER: dict[str, Callable[[Any], Any]] = {**_WHEN, "recv_raises": _flag}
_REFUSE: dict[str, Callable[[Any], Any]] = {"object": _object, "code": _integer, "count": _whole(1)}
_LIE: dict[str, Callable[[Any], Any]] = {"object": _object, "announce": _whole(-(1 << 31)), "cut": _whole(0)}
_ABSENT: dict[str, Callable[[Any], Any]] = {"object": _absence}
_STORE: dict[str, Callable[[Any], Any]] = {"factor": _number(0.01, 1e4)}
_TABLES = ("frame", "drive", "adapter", "refuse", "lie", "absent", "store")


@next_step(NEXT_STEP)
def parse_faults(text: str, where: str = "faults") -> FaultPlan:
    """Return the plan a TOML text describes. Raises ConfigError: everything that is wrong with the text."""
    document = parse_toml(text, where=where)
    reader = _Reader()
    for name in document:
        if name not in _TABLES:
            reader.violations.append(f"[{name}]: unknown table, known are {', '.join(_TABLES)}")
    plan = _plan(reader, document)
    if reader.violations:
        raise ConfigError("the faults cannot be used", where=where, violations=reader.violations)
    return plan


def _rows(
    reader: _Reader, document: Mapping[str, Any], name: str, known: Mapping[str, Callable[[Any], Any]], *required: str
) -> list[dict[str, Any]]:
    rows = document.get(name, [])
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        reader.violations.append(f"[[{name}]]: must be an array of tables")
        return []
    found = []
    for row in rows:
        values = reader.table(f"[[{name}]]", row, known)
        if reader.require(f"[[{name}]]", row, *required) and all(key in values for key in required):
            found.append(values)
    return found


def _timed(reader: _Reader, name: str, rows: list[dict[str, Any]], *when: str) -> list[dict[str, Any]]:
    for row in rows:
        if sum(key in row for key in when) != 1:
            reader.violations.append(f"[[{name}]]: give exactly one of {', '.join(when)}")
    return rows


def _plan(reader: _Reader, document: Mapping[str, Any]) -> FaultPlan:
    drives = _timed(
        reader, "drive", _rows(reader, document, "drive", _DRIVE, "action"), "at_frame", "at_s", "at_store_step"
    )
    adapters = _timed(reader, "adapter", _rows(reader, document, "adapter", _ADAPTER), "at_frame", "at_s")
    refusals = _rows(reader, document, "refuse", _REFUSE, "object", "code")
    lies = _rows(reader, document, "lie", _LIE, "object")
    store = document.get("store", {})
    if not isinstance(store, dict):
        reader.violations.append("[store]: must be a table")
        store = {}
    return FaultPlan(
        frames=tuple(FrameFault(**row) for row in _rows(reader, document, "frame", _FRAME, "action")),
        drives=tuple(DriveFault(**row) for row in drives),
        adapters=tuple(AdapterFault(**row) for row in adapters),
        refusals=tuple(Refusal(row["object"], row["code"], row.get("count")) for row in refusals),
        lies=tuple(Lie(row["object"], row.get("announce", 0), row.get("cut", 0)) for row in lies),
        absences=tuple(row["object"] for row in _rows(reader, document, "absent", _ABSENT, "object")),
        store_factor=reader.table("[store]", store, _STORE).get("factor", 1.0),
    )


@next_step(NEXT_STEP)
def load_faults(path: Path) -> FaultPlan:
    """Read a faults file. Raises ConfigError: the file cannot be read, or everything that is wrong in it."""
    return parse_faults(read_text(path), where=str(path))
