# SPDX-License-Identifier: MIT
"""Emergency messages, error register and error history (CiA 301: 7.2.7, objects 0x1001, 0x1003, 0x1014, 0x1015)."""

from __future__ import annotations

import struct
from collections.abc import Callable

from pmsmtool.bus.clock import NS, Schedule
from pmsmtool.sim.node.dictionary import Dictionary

_EMCY = struct.Struct("<HB5s")
_HISTORY = 8
_GENERIC = 0x01
# Error register bit of each code group (CiA 301, object 0x1001).
_REGISTER = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x81: 0x10, 0x82: 0x10, 0xF: 0x80}


def register_bits(code: int) -> int:
    """Return the error register bits of an error code."""
    return _GENERIC | _REGISTER.get(code >> 8, _REGISTER.get(code >> 12, 0))


class Emergency:
    """Errors present, their history, and the messages about them."""

    def __init__(self, dictionary: Dictionary, schedule: Schedule, send: Callable[[int, bytes], None]) -> None:
        self._present: set[int] = set()
        self._history: list[int] = []
        self._dictionary = dictionary
        self._schedule = schedule
        self._send = send
        self._free_ns = 0
        entry = dictionary["error.register"]
        entry.source = lambda: bytes((self.register,))
        dictionary["error.history_length"].source = lambda: bytes((len(self._history),))
        dictionary["error.history_length"].sink = self._clear_history
        for number in range(_HISTORY):
            dictionary[f"error.history_{number + 1}"].source = self._history_source(number)

    @property
    def register(self) -> int:
        """Error register: the bits of all errors present."""
        bits = 0
        for code in self._present:
            bits |= register_bits(code)
        return bits

    def _history_source(self, number: int) -> Callable[[], bytes]:
        return lambda: (self._history[number] if number < len(self._history) else 0).to_bytes(4, "little")

    def _clear_history(self, data: bytes) -> None:
        self._history.clear()  # the bounds of the object admit only zero

    def raise_error(self, code: int, detail: bytes = b"") -> None:
        """Report an error: register, history, message."""
        self._present.add(code)
        self._history.insert(0, code)
        del self._history[_HISTORY:]
        self._message(code, detail)

    def clear(self, code: int | None = None) -> None:
        """One error is gone, or all are; the message "error reset" shows in its register what is left."""
        gone = self._present if code is None else self._present & {code}
        if gone:
            self._present = self._present - gone
            self._message(0, b"")

    def _message(self, code: int, detail: bytes) -> None:
        cob_id = self._dictionary["emergency.cob_id"].integer()
        if cob_id & 1 << 31:
            return
        frame = _EMCY.pack(code, self.register, detail)
        inhibit_ns = self._dictionary["emergency.inhibit"].integer() * NS // 10_000
        start_ns = max(self._schedule.now_ns, self._free_ns)
        self._free_ns = start_ns + inhibit_ns
        if start_ns == self._schedule.now_ns:
            self._send(cob_id & 0x7FF, frame)
        else:
            self._schedule.at(start_ns, lambda: self._send(cob_id & 0x7FF, frame))
