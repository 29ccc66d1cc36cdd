# SPDX-License-Identifier: MIT
"""What an SDO transfer is made of: modes, retry policies, the result, the attempt under way."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field
from enum import StrEnum

from pmsmtool.bus.abort_codes import AbortCode

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
    """What one confirmed transfer took.

    Attributes
    ----------
    data : bytes
        Bytes read or written.
    mode : Mode
        How they travelled in the end.
    tries : int
        Attempts, 1 when nothing was lost.
    retransmitted : int
        Segments of block transfers that travelled again.
    discarded : int
        Frames that were not the answer awaited: late, duplicated or foreign.
    notes : tuple of str
        One line per retry and fall-back.
    """

    data: bytes
    mode: Mode
    tries: int = 1
    retransmitted: int = 0
    discarded: int = 0
    notes: tuple[str, ...] = ()


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
