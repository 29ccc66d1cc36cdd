# SPDX-License-Identifier: MIT
"""What an SDO transfer is made of: modes, retry policies, the result, the attempt under way.

A drive that refuses because it is busy is asked again, until it takes what is asked or a time is over. An answer that
comes again and says something else is that of a second node.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TypeVar

from pmsmtool.bus.abort_codes import BUSY_CODES, TRANSPORT_CODES, AbortCode
from pmsmtool.bus.connection import Connection
from pmsmtool.errors import DriveFault, SdoAbort

Done = TypeVar("Done")
BUSY_POLL_S = 0.05
"""A busy drive is asked again so often."""


def is_busy(fault: DriveFault) -> bool:
    """Whether a drive refuses for now: it stores, starts, or is asked too much."""
    return isinstance(fault, SdoAbort) and fault.code in BUSY_CODES


def when_ready(
    connection: Connection,
    work: Callable[[], Done],
    within_s: float,
    *,
    busy: Callable[[DriveFault], bool] = is_busy,
    meanwhile: Callable[[], None] = lambda: None,
) -> Done:
    """Do something, again as long as the drive is busy; return what it gives.

    Raises DriveFault: any that does not pass, or did not in the time.

    Parameters
    ----------
    work : callable
        May have been done in part before it is called again.
    within_s : float
        Time (s, bus clock) from which on the refusal is final.
    busy : callable, optional
        Which faults pass.
    meanwhile : callable, optional
        Done after every such fault.
    """
    clock = connection.clock
    until = clock.now() + within_s
    while True:
        try:
            return work()
        except DriveFault as fault:
            if not busy(fault) or clock.now() >= until:
                raise
        meanwhile()
        connection.wait(BUSY_POLL_S)


MULTIPLEXOR = struct.Struct("<BHB")
"""Command specifier, index, sub-index: the head of every initiate and abort frame."""
LARGEST_UNKNOWN = 1 << 20
"""Bytes of an object whose size nobody knows; the EDS in a drive (0x1021) has some 10^5."""
OBJECT_LIMIT_S = 60.0
"""Time one object may take, all tries together, beyond what its expected size needs."""
SLOWEST_S_PER_BYTE = 4e-3
"""A segmented transfer at 10 kbit/s: two frames of 130 bits for 7 bytes."""


class Mode(StrEnum):
    """How an object travelled, or shall travel."""

    AUTO = "auto"
    EXPEDITED = "expedited"
    SEGMENTED = "segmented"
    BLOCK = "block"


class Retry(StrEnum):
    """What may be done when the answer to a write is lost.

    ``READ_BACK``: read the object, write again only if it differs. ``REPEAT``: write again, the
    object takes the same value twice without harm. ``NEVER``: the write is a command; whether it
    was taken must be found out from the drive's state.
    """

    READ_BACK = "read back"
    REPEAT = "repeat"
    NEVER = "never"


@dataclass(frozen=True, slots=True)
class Transfer:
    """What one confirmed transfer took."""

    data: bytes
    """Bytes read or written."""
    mode: Mode
    """How they travelled in the end."""
    tries: int = 1
    """Attempts, 1 when nothing was lost."""
    retransmitted: int = 0
    """Segments of block transfers that travelled again."""
    discarded: int = 0
    """Frames that were not the answer awaited: late, duplicated or foreign."""
    notes: tuple[str, ...] = ()
    """One line per retry and fall-back."""


@dataclass(slots=True)
class Attempt:
    """One object under way: what is awaited and what was met.

    ``longest`` bytes are taken at most where no ``size`` is expected, and the object has until ``until_s`` on the bus
    clock, all tries together. ``segments`` tells that the attempt has begun a segmented upload,
    ``urgent`` that it is a command, which waits for no barrier: its answer names its object.
    """

    index: int
    sub: int
    timeout_s: float
    mode: Mode
    size: int | None = None
    longest: int = LARGEST_UNKNOWN
    until_s: float = math.inf
    segments: bool = False
    urgent: bool = False
    retransmitted: int = 0
    discarded: int = 0
    notes: list[str] = field(default_factory=list)

    @property
    def limit(self) -> int:
        """Bytes that are taken at most."""
        return self.longest if self.size is None else self.size

    def head(self, command: int) -> bytes:
        """Return command specifier and multiplexor."""
        return MULTIPLEXOR.pack(command, self.index, self.sub)

    def owns(self, frame: bytes) -> bool:
        """Whether a frame carries the multiplexor of this object."""
        return MULTIPLEXOR.unpack_from(frame)[1:] == (self.index, self.sub)


class TransferLost(Exception):
    """An attempt failed in the transport; the object may be tried again. Never leaves ``bus``.

    Parameters
    ----------
    code : int
        Abort code that describes the failure.
    abort_owed : bool
        Whether the node still believes in the transfer and must be told.
    likely : str
        The cause where the frames that came show it.
    """

    def __init__(
        self, what: str, code: int = AbortCode.TIMED_OUT, *, abort_owed: bool = True, likely: str = ""
    ) -> None:
        super().__init__(what)
        self.what = what
        self.code = code
        self.abort_owed = abort_owed
        self.likely = likely


class BlockRefused(Exception):
    """The node has no block transfer for this object. Never leaves ``bus``."""


NAMING = (2, 3, 4)
"""Server command specifiers of the answers that name their object: upload, download, abort."""
REMEMBERED = 4
"""Answers kept to compare late ones with: a second node may be slower by a few round trips."""
LATEST_S = 2.0
"""After a lost answer, what comes within this time may be that one."""


class GivenAnswers:
    """The latest answers of one node id (CiA 301, 7.2.4.3).

    Attributes
    ----------
    contradiction : str
        The last answer that came a second time and said something else; empty where none did.
    """

    def __init__(self) -> None:
        self.contradiction = ""
        self._answers: deque[bytes] = deque(maxlen=REMEMBERED)
        self._compared_from_s = -math.inf

    def keep(self, answer: bytes, now_s: float) -> None:
        """Take an answer that was awaited."""
        if now_s > self._compared_from_s:
            self._answers.append(answer)

    def clear(self) -> None:
        """Forget all: somebody else of this program has asked the node, too."""
        self._answers.clear()

    def forget(self, now_s: float) -> None:
        """After a lost answer: what still comes for a while may be late, and contradicts nothing."""
        self._answers.clear()
        self._compared_from_s = now_s + LATEST_S

    def compare(self, frame: bytes) -> None:
        """Note an answer to a request that was answered before, and otherwise."""
        alike = [answer for answer in self._answers if answer[1:4] == frame[1:4]]
        of_transport = frame[0] == 0x80 and int.from_bytes(frame[4:8], "little") in TRANSPORT_CODES
        if frame[0] >> 5 in NAMING and alike and frame not in alike and not of_transport:
            self.contradiction = f"{named(frame)} came twice, as {alike[-1].hex(' ')} and as {frame.hex(' ')}"


def named(frame: bytes) -> str:
    """Say what a frame is that was not the answer awaited."""
    if frame[0] >> 5 not in NAMING:
        return "a segment with the wrong toggle bit, or a late one"
    _, index, sub = MULTIPLEXOR.unpack_from(frame)
    return f"an answer for 0x{index:04X}:{sub:02X}"
