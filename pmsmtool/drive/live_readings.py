# SPDX-License-Identifier: MIT
"""Live quantities of a drive, reading after reading: asked for one by one, or as the drive sends them."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator

from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import IDENTITY, LIVE, SET_SIGNATURE, DriveObject
from pmsmtool.drive.process_data import live_values
from pmsmtool.errors import DriveTimeout, NotAvailable
from pmsmtool.params.catalogue import layout_signature

SILENT_S = 1.0
"""A drive that was told to send by a timer and sends nothing for this long, and for three periods, is lost."""

Readings = Generator[tuple[float, dict[str, float]], None, None]
"""Time since the first reading (s), and the value of every quantity by its name."""


class Column:
    """Running statistics of one quantity (Welford)."""

    def __init__(self) -> None:
        self.last = self.low = self.high = math.nan
        self._count = 0
        self._mean = 0.0
        self._square = 0.0

    def add(self, value: float) -> None:
        """Take a value."""
        self.last = value
        self.low = value if self._count == 0 else min(self.low, value)
        self.high = value if self._count == 0 else max(self.high, value)
        self._count += 1
        step = value - self._mean
        self._mean += step / self._count
        self._square += step * (value - self._mean)

    @property
    def std(self) -> float:
        """Standard deviation; 0 of a single value."""
        return math.sqrt(self._square / (self._count - 1)) if self._count > 1 else 0.0


def available(node: DriveNode, wanted: Callable[[str], object]) -> list[str]:
    """Return the names of the live quantities that are wanted and that the drive has; raises ``NotAvailable``."""
    own = _is_reference(node)  # of another maker's drive the same objects are something else
    names = [name for name, item in LIVE.items() if own and wanted(name) and node.has(item.index, item.sub)]
    if names:
        return names
    if any(map(wanted, LIVE)):
        raise NotAvailable(
            "the drive has none of these live quantities", where=f"node {node.node}, 0x2070",
            likely="a drive without the pmsmtool reference objects",
            hint="`pmsmtool param get 0x6064 0x6077 0x6078` reads what CiA 402 knows, `monitor --log` what it sends",
        )  # fmt: skip
    raise NotAvailable("there is no live quantity of that name", hint=f"there are {', '.join(LIVE)}")


def _is_reference(node: DriveNode) -> bool:
    """Return whether a drive names itself the reference drive, or holds its parameter set under another name."""
    named = (int(node.held(DriveObject(IDENTITY, sub, "I")) or 0) for sub in (1, 2))
    return node.map.is_for(*named) or node.held(SET_SIGNATURE) == layout_signature()


def readings(node: DriveNode, names: list[str], period_s: float, seconds: float | None) -> Readings:
    """Read the quantities one after the other, once per period, for a time or for ever."""
    clock = node.connection.clock
    start = clock.now()
    number = 0
    while seconds is None or clock.now() - start < seconds:
        yield clock.now() - start, {name: node.get(LIVE[name]) for name in names}
        number += 1
        node.connection.wait(max(0.0, start + number * period_s - clock.now()))
        node.supervision.check()


def sent(node: DriveNode, names: list[str], period_s: float, seconds: float | None) -> Readings:
    """As :func:`readings`, of what the drive sends by itself. Raises DriveTimeout: it sends nothing any more."""
    clock = node.connection.clock
    with live_values(node, names, period_s) as live:
        start = clock.now()
        received, silent_s = 0, 0.0
        while seconds is None or clock.now() - start < seconds:
            node.connection.wait(period_s)
            node.supervision.check()
            # in periods waited for, not by the clock: a computer that stood still is no drive that fell silent
            silent_s = silent_s + period_s if live.received == received else 0.0
            received = live.received
            if silent_s > max(SILENT_S, 3.0 * period_s):
                raise DriveTimeout(
                    f"the drive has sent no process data for {silent_s:.1f} s",
                    where=f"node {node.node}",
                    likely="the node lost its supply, or the cable is open",
                    hint="check both, and reset the drive: its PDOs may still be the temporary ones",
                )
            if len(live.values) == len(names):
                yield clock.now() - start, {name: live.values[name] for name in names}
