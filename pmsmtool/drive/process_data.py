# SPDX-License-Identifier: MIT
"""Live quantities as process data: the drive sends them by itself (TPDOs, CiA 301, section 7.5.2.35 on).

The transmit PDOs 2 to 4 are borrowed: what they were is noted first and brought back at the end, with
the NMT state. TPDO 1 is left to whoever watches the statusword.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from pmsmtool.bus.nmt import NmtCommand, NmtState, send_nmt
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.interruption import interrupts_deferred
from pmsmtool.drive.objects import LIVE, DriveObject
from pmsmtool.errors import BusError, NotAvailable, SdoAbort

BORROWED = (2, 3, 4)
"""Numbers of the transmit PDOs in use."""
PDO_BYTES = 8
EVENT_DRIVEN = 255
_OFF = 1 << 31
_NO_RTR = 1 << 30
_NMT_WAIT_S = 0.05


class LiveValues:
    """Latest values, as they arrive.

    Attributes
    ----------
    values : dict of str to float
        By name; a name is there from its first PDO on.
    received : int
        PDOs received.
    on_set : callable
        Called with the bus's time stamp when every PDO has come once more; may only take notes.
    """

    def __init__(self, objects: Mapping[str, DriveObject] = LIVE) -> None:
        self._objects = objects
        self.values: dict[str, float] = {}
        self.received = 0
        self.on_set: Callable[[float], None] = lambda stamp_s: None
        self._fresh: set[int] = set()
        self._layout: dict[int, list[tuple[str, struct.Struct]]] = {}

    def expect(self, cob_id: int, names: Sequence[str]) -> None:
        """Say what a COB-ID carries."""
        self._layout[cob_id] = [(name, struct.Struct("<" + self._objects[name].letter)) for name in names]

    def take(self, cob_id: int, data: bytes, timestamp: float) -> None:
        """Take the values of one PDO; a short one is left out."""
        position = 0
        for name, code in self._layout[cob_id]:
            if position + code.size > len(data):
                return
            self.values[name] = float(code.unpack_from(data, position)[0])
            position += code.size
        self.received += 1
        self._fresh.add(cob_id)
        if cob_id == max(self._layout):  # the drive sends the lowest identifier first
            if len(self._fresh) == len(self._layout):
                self.on_set(timestamp)
            self._fresh.clear()


@contextmanager
def live_values(
    node: DriveNode, names: Sequence[str], period_s: float, objects: Mapping[str, DriveObject] = LIVE
) -> Iterator[LiveValues]:
    """Have the drive send live quantities every ``period_s``, as long as the context lasts.

    Parameters
    ----------
    objects : mapping of str to DriveObject
        Where a drive shows what the names mean; default: the reference drive's.

    Raises
    ------
    NotAvailable
        More quantities than the borrowed PDOs hold, or a drive without them.
    """
    groups = _groups(names, objects)
    live = LiveValues(objects)
    before: list[tuple[int, int, bytes]] = []
    cob_ids = [0x80 + 0x100 * number + node.node for number in BORROWED[: len(groups)]]
    state = node.supervision.nmt_state
    brought_back = False

    def bring_back() -> None:
        nonlocal brought_back
        if brought_back:
            return
        for cob_id in cob_ids:
            node.connection.unsubscribe(cob_id, live.take)
        if state is not NmtState.OPERATIONAL:
            send_nmt(node.connection, NmtCommand.PRE_OPERATIONAL, node.node)
        brought_back = True
        bring_pdos_back(node, before)

    lost: BusError | None = None
    node.before_close.append(bring_back)  # a signal between two bytecodes of a `with` statement calls no exit
    try:
        for number, cob_id, group in zip(BORROWED, cob_ids, groups, strict=False):
            before += pdo_contents(node, 0x1800 + number - 1, 0x1A00 + number - 1)
            _map(node, number, cob_id, [objects[name] for name in group], period_s)
            live.expect(cob_id, group)
            node.connection.subscribe(cob_id, live.take)
        send_nmt(node.connection, NmtCommand.START, node.node)
        node.connection.wait(_NMT_WAIT_S)
        yield live
    except SdoAbort as abort:
        raise NotAvailable(
            "the drive cannot send these as process data", where=abort.where, hint="leave --pdo out"
        ) from abort
    except BusError as error:
        lost = error
        raise
    finally:
        with interrupts_deferred() as noted:
            try:
                bring_back()
            except BusError:
                if lost is None:
                    raise  # else what was lost first says more
        if noted:
            raise KeyboardInterrupt


def sent_every_s(period_s: float) -> float:
    """Return the period (s) nearest to the one wanted that an event timer holds, in whole milliseconds."""
    return 1e-3 * min(max(1, round(1000.0 * period_s)), 0xFFFF)


def _groups(names: Sequence[str], objects: Mapping[str, DriveObject]) -> list[list[str]]:
    """Fill the PDOs in order."""
    groups: list[list[str]] = [[]]
    for name in names:
        if sum(objects[other].size for other in [*groups[-1], name]) > PDO_BYTES:
            groups.append([])
        groups[-1].append(name)
    if len(groups) > len(BORROWED):
        raise NotAvailable(
            f"{len(names)} quantities do not fit {len(BORROWED)} process data objects",
            hint="choose fewer with -g, or leave --pdo out",
        )
    return groups


def pdo_contents(node: DriveNode, communication: int, mapping: int) -> list[tuple[int, int, bytes]]:
    """Return what a PDO is, in the order in which it can be written back: off, empty, mapping, count, on."""
    count = node.sdo.read(mapping, 0, size=1)
    entries = [(mapping, sub, node.sdo.read(mapping, sub, size=4)) for sub in range(1, max(count[0], 2) + 1)]
    cob_id = node.sdo.read(communication, 1, size=4)
    rest = [(communication, 2, node.sdo.read(communication, 2, size=1))]
    with contextlib.suppress(SdoAbort):
        rest.append((communication, 5, node.sdo.read(communication, 5, size=2)))
    return [
        (communication, 1, _with_off(cob_id)), (mapping, 0, b"\0"), *entries, (mapping, 0, count), *rest,
        (communication, 1, cob_id),
    ]  # fmt: skip


def _with_off(cob_id: bytes) -> bytes:
    return (int.from_bytes(cob_id, "little") | _OFF).to_bytes(4, "little")


def _map(node: DriveNode, number: int, cob_id: int, items: Sequence[DriveObject], period_s: float) -> None:
    communication, mapping = 0x1800 + number - 1, 0x1A00 + number - 1
    write = node.sdo.download
    write(communication, 1, (cob_id | _OFF | _NO_RTR).to_bytes(4, "little"))
    write(mapping, 0, b"\0")
    for sub, item in enumerate(items, 1):
        write(mapping, sub, item.mapping_word.to_bytes(4, "little"))
    write(mapping, 0, bytes((len(items),)))
    write(communication, 2, bytes((EVENT_DRIVEN,)))
    write(communication, 5, round(1000.0 * sent_every_s(period_s)).to_bytes(2, "little"))
    write(communication, 1, (cob_id | _NO_RTR).to_bytes(4, "little"))


def bring_pdos_back(node: DriveNode, before: list[tuple[int, int, bytes]]) -> None:
    """Write the contents of PDOs; an object that is refused does not keep the others from it."""
    refused: SdoAbort | None = None
    for index, sub, data in before:
        try:
            node.sdo.download(index, sub, data)
        except SdoAbort as abort:  # a drive that refuses one must get the others
            refused = refused or abort
    if refused is not None:
        raise refused
