# SPDX-License-Identifier: MIT
"""LSS slave: node id over the bus (CiA 305): switching, configuration, inquiry, identification, fastscan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

REQUEST_ID = 0x7E5
ANSWER_ID = 0x7E4
UNCONFIGURED = 0xFF
_BIT_TIMINGS = (1_000_000, 800_000, 500_000, 250_000, 125_000, 0, 50_000, 20_000, 10_000)
_SELECTIVE = range(0x40, 0x44)
_IDENTIFY = range(0x46, 0x4C)
_INQUIRE = range(0x5A, 0x5E)
_FASTSCAN_RESET = 0x80


@dataclass(slots=True)
class LssState:
    """What the slave remembers between requests."""

    configuring: bool = False
    selected: int = 0
    matched: int = 0
    scan_position: int = 0


class LssSlave:
    """One LSS slave.

    Parameters
    ----------
    identity : sequence of 4 int
        Vendor, product, revision, serial (object 0x1018).
    bitrate : int or None
        Rate of the line (bit/s); the only one the drive takes. None: any.
    active_id, pending_id : callables
        The node id in use; the one that holds after the next reset.
    set_pending, store : callables
        Take a new node id; keep it in non-volatile memory and then call back with the error (0: stored).
    leave : callable
        Called when configuration ends (an unconfigured node starts then).
    send : callable
        Answers with 8 bytes.
    """

    def __init__(
        self,
        identity: Sequence[int],
        bitrate: int | None,
        *,
        active_id: Callable[[], int],
        pending_id: Callable[[], int],
        set_pending: Callable[[int], None],
        store: Callable[[Callable[[int], None]], None],
        leave: Callable[[], None],
        send: Callable[[bytes], None],
    ) -> None:
        self._identity = tuple(identity)
        self._bitrate = bitrate
        self._active_id = active_id
        self._pending_id = pending_id
        self._set_pending = set_pending
        self._store = store
        self._leave = leave
        self._send = send
        self._state = LssState()

    def receive(self, frame: bytes) -> None:
        """Take one request of the LSS master."""
        if len(frame) != 8:
            return
        command, number = frame[0], int.from_bytes(frame[1:5], "little")
        if command == 0x04:
            self._switch(frame[1])
        elif command in _SELECTIVE:
            self._select(command - 0x40, number)
        elif command in _IDENTIFY:
            self._identify(command - 0x46, number)
        elif command == 0x4C:
            if self._pending_id() == UNCONFIGURED:
                self._answer(0x50)
        elif command == 0x51:
            self._fastscan(number, frame[5], frame[6], frame[7])
        elif self._state.configuring:
            self._configure(command, frame)

    def _answer(self, command: int, *values: int) -> None:
        self._send(bytes((command, *values)).ljust(8, b"\0"))

    def _switch(self, mode: int) -> None:
        if mode not in (0, 1):
            return  # CiA 305 knows waiting and configuration
        was_configuring = self._state.configuring
        self._state.configuring = mode == 1
        if was_configuring and mode == 0:
            self._leave()

    def _select(self, part: int, number: int) -> None:
        state = self._state
        state.selected = state.selected + 1 if number == self._identity[part] and state.selected == part else 0
        if state.selected == 4:
            state.selected = 0
            state.configuring = True
            self._answer(0x44)

    def _identify(self, part: int, number: int) -> None:
        """Compare with one of: vendor, product, lowest and highest revision, lowest and highest serial."""
        vendor, product, revision, serial = self._identity
        fits = (
            number == vendor,
            number == product,
            number <= revision,
            number >= revision,
            number <= serial,
            number >= serial,
        )[part]
        state = self._state
        state.matched = state.matched + 1 if fits and state.matched == part else 0
        if state.matched == 6:
            state.matched = 0
            self._answer(0x4F)

    def _fastscan(self, number: int, bit: int, part: int, following: int) -> None:
        state = self._state
        if self._pending_id() != UNCONFIGURED or state.configuring:
            return
        if bit == _FASTSCAN_RESET:
            state.scan_position = 0
            self._answer(0x4F)
            return
        if bit > 31 or part > 3 or following > 3 or part != state.scan_position:
            return
        mask = 0xFFFFFFFF << bit & 0xFFFFFFFF
        if (number ^ self._identity[part]) & mask:
            return
        state.scan_position = following
        if bit == 0 and following < part:
            state.configuring = True
        self._answer(0x4F)

    def _configure(self, command: int, frame: bytes) -> None:
        if command == 0x11:
            valid = 1 <= frame[1] <= 127 or frame[1] == UNCONFIGURED
            if valid:
                self._set_pending(frame[1])
            self._answer(0x11, 0 if valid else 1)
        elif command == 0x13:
            known = frame[1] == 0 and frame[2] < len(_BIT_TIMINGS) and _BIT_TIMINGS[frame[2]] != 0
            fits = known and self._bitrate in (None, _BIT_TIMINGS[frame[2]])
            self._answer(0x13, 0 if fits else 1)
        elif command == 0x17:
            self._store(lambda error: self._answer(0x17, error))
        elif command in _INQUIRE:
            self._send(bytes((command,)) + self._identity[command - 0x5A].to_bytes(4, "little") + bytes(3))
        elif command == 0x5E:
            self._answer(0x5E, self._active_id())
