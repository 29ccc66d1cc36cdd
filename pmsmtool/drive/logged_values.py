# SPDX-License-Identifier: MIT
"""What a drive shows over time by the names and units of its map: live, and in a recorded bus.

Live quantities are asked for one by one, or come as the drive sends them. Of a recorded bus: which objects a PDO
carries is read from the log itself (writes and reads of 0x1400 to 0x1BFF), else from an EDS file. Numbers are decoded
as they are when the drive is asked: :data:`~pmsmtool.drive.objects.LIVE` and the map's rows.
"""

from __future__ import annotations

import contextlib
import math
import struct
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass

from pmsmtool.bus.bus_log import LogFrame
from pmsmtool.cia402 import error_text
from pmsmtool.data_types import DATA_TYPES
from pmsmtool.drive import objects
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import IDENTITY, LIVE, SET_SIGNATURE, DriveObject, signal_unit
from pmsmtool.drive.process_data import live_values
from pmsmtool.drive_maps.drive_map import LETTERS, DriveMap
from pmsmtool.drive_maps.eds import Eds, parse_integer
from pmsmtool.drive_maps.wire_units import wire_unit
from pmsmtool.errors import ConfigError, DriveTimeout, NotAvailable
from pmsmtool.params.catalogue import BY_NAME, layout_signature

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


Address = tuple[int, int]

STANDARD: Mapping[str, DriveObject] = {
    "statusword": objects.STATUSWORD, "controlword": objects.CONTROLWORD, "mode": objects.MODE_DISPLAY,
    "error_code": objects.ERROR_CODE,
}  # fmt: skip
"""Objects of CiA 402 that every drive has, as they stand on the bus."""
EMERGENCY, TPDO, RPDO, ANSWER, REQUEST = 0x080, 0x180, 0x200, 0x580, 0x600
"""First identifiers of CiA 301's predefined connection set; PDO 2 to 4 follow in steps of 0x100."""
PDO_COMMUNICATION = {0x1400: (0x1600, RPDO), 0x1800: (0x1A00, TPDO)}
"""First communication objects, their first mapping objects and identifiers."""
PDOS = 4
_VALID_ID = 0x7FF
_BY_CODE = {row.code: row.letter for row in DATA_TYPES.values() if row.letter}


@dataclass(frozen=True, slots=True)
class Quantity:
    """A named number: unit, ``struct`` letter on the wire, value of one count and of zero."""

    name: str
    unit: str
    letter: str
    factor: float = 1.0
    offset: float = 0.0

    def decode(self, data: bytes) -> float | None:
        """Return the value; None for bytes of another length."""
        if len(data) != struct.calcsize("<" + self.letter):
            return None
        return float(struct.unpack("<" + self.letter, data)[0]) * self.factor + self.offset


def quantities(drive_map: DriveMap, sheet: Eds | None = None) -> dict[Address, Quantity]:
    """Return what can be named, by address: the map's rows, CiA 402, then names of the data sheet in counts.

    A value relative to a rated one stays in its share: the log need not hold the rated one.
    """
    found: dict[Address, Quantity] = {}
    for (index, sub), item in () if sheet is None else sheet.objects.items():
        if item.data_type in _BY_CODE:
            name = f"0x{index:04X}:{sub:02X} {item.name}"
            found[index, sub] = Quantity(name, "counts", _BY_CODE[item.data_type])
    for name, standard in STANDARD.items():
        found[standard.index, standard.sub] = Quantity(name, "1", standard.letter)
    for name, cell in drive_map.cells.items():
        if cell.form == "value":
            letter = LETTERS[cell.wire]
            found[cell.index, cell.sub] = Quantity(name, BY_NAME[name].unit, letter, cell.factor, cell.offset)
    for name, signal in drive_map.signals.items():
        unit = wire_unit(signal.unit)
        scale, shown = (1.0, signal.unit) if unit.relative_to else (unit.scale, signal_unit(name))
        found[signal.index, signal.sub] = Quantity(name, shown, LETTERS[signal.wire], scale)
    if drive_map.capabilities.recorder == "domain":  # the reference objects
        for name, live in LIVE.items():
            found[live.index, live.sub] = Quantity(name, signal_unit(name), live.letter)
    return found


class LoggedDrive:
    """One node of a log.

    Parameters
    ----------
    node : int
        Node id.
    named : mapping of (index, sub) to Quantity
        From :func:`quantities`.
    sheet : Eds, optional
        Its PDOs count until the log says otherwise.

    Attributes
    ----------
    emergencies : list of str
        What the drive reported, with the time.
    unknown : Counter
        PDO identifiers of this node whose content is not known, with their frames.
    """

    def __init__(self, node: int, named: Mapping[Address, Quantity], sheet: Eds | None = None) -> None:
        self.node, self._named = node, named
        self.emergencies: list[str] = []
        self.unknown: Counter[int] = Counter()
        self._pdo: dict[Address, int] = {}
        self._asked: tuple[Address, bytes] | None = None
        self._layouts: dict[int, list[tuple[Address, int]]] | None = None
        for (index, sub), item in () if sheet is None else sheet.objects.items():
            with contextlib.suppress(ValueError):  # no number, as most objects of it
                self._pdo[index, sub] = parse_integer(item.value or item.default, node)

    @staticmethod
    def _is_of_a_pdo(index: int) -> bool:
        return any(
            first <= index < first + PDOS for pair in PDO_COMMUNICATION.items() for first in (pair[0], pair[1][0])
        )

    def take(self, frame: LogFrame) -> dict[str, float]:
        """Return the values that a frame carries, by name."""
        base = frame.cob_id - self.node
        if base in (ANSWER, REQUEST):
            return self._transfer(base, frame.data)
        if base == EMERGENCY and len(frame.data) >= 2:
            code = int.from_bytes(frame.data[:2], "little")
            if code:
                self.emergencies.append(f"{frame.t_s:.3f} s: emergency 0x{code:04X}: {error_text(code)}")
            return {}
        if self._layouts is None:
            self._layouts = self._read_layouts()
        layout = self._layouts.get(frame.cob_id)
        if layout is None:
            if any(base == first + 0x100 * k for _, first in PDO_COMMUNICATION.values() for k in range(PDOS)):
                self.unknown[frame.cob_id] += 1
            return {}
        values: dict[str, float] = {}
        position = 0
        for address, size in layout:
            values |= self._value(address, frame.data[position : position + size])
            position += size
        return values

    def _read_layouts(self) -> dict[int, list[tuple[Address, int]]]:
        found = {}
        for communication, (mapping, first) in PDO_COMMUNICATION.items():
            for k in range(PDOS):
                words = [
                    self._pdo.get((mapping + k, sub), 0) for sub in range(1, self._pdo.get((mapping + k, 0), 8) + 1)
                ]
                cob_id = self._pdo.get((communication + k, 1), first + 0x100 * k + self.node)
                if any(words) and not cob_id >> 31:
                    found[cob_id & _VALID_ID] = [
                        ((word >> 16, word >> 8 & 0xFF), (word & 0xFF) // 8) for word in words if word
                    ]
        return found

    def _transfer(self, base: int, data: bytes) -> dict[str, float]:
        """Follow expedited transfers (CiA 301, 7.2.4.3): a write counts when it is confirmed."""
        if len(data) < 8:
            return {}
        command, index, sub = struct.unpack_from("<BHB", data)
        size = 4 - (command >> 2 & 3) if command & 1 else 4
        if base == REQUEST:
            self._asked = ((index, sub), data[4 : 4 + size]) if command & 0xE2 == 0x22 else None
            return {}
        if command & 0xE2 == 0x42:
            return self._held((index, sub), data[4 : 4 + size])
        if command == 0x60 and self._asked is not None and self._asked[0] == (index, sub):
            (address, written), self._asked = self._asked, None
            return self._held(address, written)
        return {}

    def _held(self, address: Address, data: bytes) -> dict[str, float]:
        if self._is_of_a_pdo(address[0]):
            self._pdo[address] = int.from_bytes(data, "little")
            self._layouts = None
        return self._value(address, data)

    def _value(self, address: Address, data: bytes) -> dict[str, float]:
        quantity = self._named.get(address)
        value = None if quantity is None else quantity.decode(data)
        return {} if quantity is None or value is None else {quantity.name: value}


def nodes_in(frames: Iterable[LogFrame]) -> list[int]:
    """Return the nodes that answered or beat in a log."""
    own = (0x700, ANSWER, EMERGENCY, TPDO)
    return sorted({frame.cob_id & 0x7F for frame in frames if frame.cob_id & 0x780 in own} - {0})


def logged_values(
    frames: list[LogFrame], node: int | None, named: Mapping[Address, Quantity], sheet: Eds | None, where: str
) -> tuple[LoggedDrive, Iterator[tuple[float, dict[str, float]]]]:
    """Return the drive of a log, and what it says over time (s).

    Raises ConfigError: the log holds no frame, no node, or several and none was named.
    """
    present = nodes_in(frames)
    if node is None and len(present) != 1:
        what = f"{len(present)} nodes are in the log" if frames else "there is no CAN frame in the file"
        nothing = "record one with --trace-can FILE, or by candump -L"
        hint = f"name one: -n {', -n '.join(map(str, present))}" if present else nothing
        raise ConfigError(what, where=where, hint=hint)
    drive = LoggedDrive(present[0] if node is None else node, named, sheet)
    taken = ((frame.t_s, drive.take(frame)) for frame in frames)
    return drive, ((t_s, values) for t_s, values in taken if values)
