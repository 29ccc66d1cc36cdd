# SPDX-License-Identifier: MIT
"""Answers that a node gave lately: one that comes again and says something else is that of a second node."""

from __future__ import annotations

import math
from collections import deque

from pmsmtool.bus.abort_codes import TRANSPORT_CODES
from pmsmtool.bus.sdo_transfer import MULTIPLEXOR

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
