# SPDX-License-Identifier: MIT
"""Live quantities as process data: the drive sends them by itself (TPDOs, CiA 301, section 7.5.2.35 on).

The transmit PDOs 2 to 4 are borrowed: what they were is noted first and brought back at the end, with
the NMT state. One that could not be brought back is passed over. TPDO 1 is left to whoever watches the statusword.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from pmsmtool.bus.nmt import NmtCommand, NmtState, send_nmt
from pmsmtool.drive.borrowed_pdo import BorrowedPdo
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.interruption import interrupts_deferred
from pmsmtool.drive.objects import LIVE, DriveObject
from pmsmtool.errors import BusError, NotAvailable, SdoAbort

BORROWED = (2, 3, 4)
"""Numbers of the transmit PDOs in use."""
PDO_BYTES = 8
EVENT_DRIVEN = 255
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
    objects = {name: node.typed(objects[name]) for name in names}
    groups = _groups(names, objects)
    live = LiveValues(objects)
    before: list[BorrowedPdo] = []
    cob_ids: list[int] = []
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
        while before:
            before.pop().bring_back(node)

    lost: BusError | None = None
    node.before_close.append(bring_back)  # a signal between two bytecodes of a `with` statement calls no exit
    try:
        left = _usable(node, max(len(group) for group in groups), len(groups))
        for group in groups:
            cob_id = _lend(node, left, before, [objects[name] for name in group], period_s)
            live.expect(cob_id, group)
            cob_ids.append(cob_id)
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


def _usable(node: DriveNode, entries: int, wanted: int) -> list[tuple[int, BorrowedPdo]]:
    """Return the PDOs that can be borrowed by what they hold, with their numbers; writes nothing.

    Raises
    ------
    NotAvailable
        Fewer than wanted; each other one is named with its reason.
    """
    found: list[tuple[int, BorrowedPdo]] = []
    reasons: list[str] = []
    for number in BORROWED:
        communication, mapping = 0x1800 + number - 1, 0x1A00 + number - 1
        try:
            pdo = BorrowedPdo.read(node, communication, mapping, entries)
        except (NotAvailable, SdoAbort) as reason:
            reasons.append(f"0x{mapping:04X}: {reason.what}")
            continue
        if pdo.has_event_timer:
            found.append((number, pdo))
        else:
            reasons.append(f"0x{communication:04X}: it has no event timer")
    if len(found) < wanted:
        raise NotAvailable(
            f"the drive cannot send these as process data: {'; '.join(reasons)}",
            where=f"node {node.node}", hint="leave --pdo out",
        )  # fmt: skip
    return found


def _lend(
    node: DriveNode, left: list[tuple[int, BorrowedPdo]], before: list[BorrowedPdo], items: Sequence[DriveObject],
    period_s: float,
) -> int:  # fmt: skip
    """Let the next PDO that can be brought back send the items; return its COB-ID."""
    while left:
        number, pdo = left.pop(0)
        cob_id = 0x80 + 0x100 * number + node.node
        before.append(pdo)
        try:
            pdo.switch_off(node)
        except SdoAbort:  # it still holds what it refused
            before.remove(pdo)
            pdo.bring_back(node)
            continue
        pdo.change(node, [item.mapping_word for item in items], EVENT_DRIVEN)
        node.sdo.download(pdo.communication, 5, round(1000.0 * sent_every_s(period_s)).to_bytes(2, "little"))
        node.sdo.download(pdo.communication, 1, (cob_id | _NO_RTR).to_bytes(4, "little"))
        return cob_id
    raise NotAvailable(
        "the drive cannot send these as process data: it refuses what its own PDOs hold",
        where=f"node {node.node}", hint="leave --pdo out",
    )  # fmt: skip


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
