# SPDX-License-Identifier: MIT
"""Layer setting services: find nodes that have no id yet, and give them one (CiA 305).

One slave is configured at a time. The fast scan finds one unconfigured slave by asking for its
identity bit by bit; nothing is changed until :meth:`LssMaster.set_node_id`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum

from pmsmtool.bus.connection import Connection
from pmsmtool.errors import DriveFault, DriveTimeout

MASTER_ID = 0x7E5
SLAVE_ID = 0x7E4
TIMEOUT_S = 0.1
"""Slaves answer within a few ms; the fast scan waits this long for every bit nobody confirms."""
STORE_TIMEOUT_S = 2.0
_BITS = 32
_PARTS = 4


class LssCommand(IntEnum):
    """Command specifiers (CiA 305, section 4.10)."""

    SWITCH_GLOBAL = 0x04
    SET_NODE_ID = 0x11
    STORE = 0x17
    SELECT_VENDOR = 0x40
    SELECTED = 0x44
    FAST_SCAN_FOUND = 0x4F
    FAST_SCAN = 0x51


@dataclass(frozen=True, slots=True)
class LssAddress:
    """Identity by which one slave is addressed."""

    vendor: int
    product: int
    revision: int
    serial: int


class LssMaster:
    """Master of the layer setting services on one bus.

    ``connection``: the bus; no other LSS master may be on it.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._mailbox = connection.mailbox(SLAVE_ID)

    def close(self) -> None:
        """Stop listening."""
        self._mailbox.close()

    def fast_scan(self) -> LssAddress | None:
        """Return the identity of one unconfigured slave, None when there is none.

        Every slave is in the waiting state afterwards. It is before, too: a slave that an earlier master left in the
        configuration state takes no part in a scan.
        """
        with self._all_waiting_afterwards():
            return self._scan()

    def _scan(self) -> LssAddress | None:
        if not self._confirmed(0, 128, 0, 0):
            return None
        numbers = []
        for part in range(_PARTS):
            number = 0
            for bit in range(_BITS - 1, -1, -1):
                # A slave whose bit is 0 confirms; silence means 1.
                if not self._confirmed(number, bit, part, part):
                    number |= 1 << bit
            if not self._confirmed(number, 0, part, (part + 1) % _PARTS):
                raise DriveTimeout(
                    "the LSS slave stopped answering in the middle of the scan",
                    likely="it lost its supply, or several masters scan at once",
                    hint="run the scan again",
                )
            numbers.append(number)
        return LssAddress(*numbers)

    def select(self, address: LssAddress) -> None:
        """Put the slave with an identity into the configuration state. Raises DriveTimeout: no slave has it."""
        parts = (address.vendor, address.product, address.revision, address.serial)
        for offset, number in enumerate(parts):
            self._send(LssCommand.SELECT_VENDOR + offset, number.to_bytes(4, "little"))
        self._await(LssCommand.SELECTED, TIMEOUT_S, "the selection")

    def set_node_id(self, node: int) -> None:
        """Give the selected slave a node id (1..127; 255: none); it takes it when the configuration state is left.

        Raises DriveFault: it refuses the id.
        """
        self._send(LssCommand.SET_NODE_ID, bytes((node,)))
        answer = self._await(LssCommand.SET_NODE_ID, TIMEOUT_S, "the node id")
        if answer[1]:
            raise DriveFault(f"the slave refuses node id {node} (error {answer[1]})", hint="choose 1..127")

    def store(self) -> None:
        """Make the selected slave keep its node id over a power-off. Raises DriveFault: it cannot."""
        self._send(LssCommand.STORE)
        answer = self._await(LssCommand.STORE, STORE_TIMEOUT_S, "storing")
        if answer[1]:
            raise DriveFault(
                f"the slave does not store its node id (error {answer[1]})",
                likely="it has no memory for it",
                hint="set the id once more after every power-on, or by the switches of the drive",
            )

    @contextmanager
    def configuration(self, address: LssAddress) -> Iterator[None]:
        """Select one slave; every slave returns to the waiting state afterwards, and takes its new id then."""
        with self._all_waiting_afterwards():
            self.select(address)
            yield

    @contextmanager
    def _all_waiting_afterwards(self) -> Iterator[None]:
        """Switch all slaves to the waiting state, before and on every way out (CiA 305, switch state global)."""
        self._send(LssCommand.SWITCH_GLOBAL, b"\0")
        try:
            yield
        finally:
            self._send(LssCommand.SWITCH_GLOBAL, b"\0")

    def _confirmed(self, number: int, bit: int, part: int, following: int) -> bool:
        self._mailbox.clear()
        self._send(LssCommand.FAST_SCAN, number.to_bytes(4, "little") + bytes((bit, part, following)))
        answer = self._mailbox.get(TIMEOUT_S)
        if answer is None:
            return False
        # Several unconfigured slaves confirm the same bit; their answers are one.
        self._connection.wait(0.0)
        return answer[0] == LssCommand.FAST_SCAN_FOUND

    def _send(self, command: int, data: bytes = b"") -> None:
        self._connection.send(MASTER_ID, (bytes((command,)) + data).ljust(8, b"\0"))

    def _await(self, command: int, timeout_s: float, what: str) -> bytes:
        while True:
            answer = self._mailbox.get(timeout_s)
            if answer is None:
                raise DriveTimeout(
                    f"no LSS answer to {what} within {timeout_s:g} s",
                    likely="no slave has this identity, or it has no layer setting services",
                    hint="`pmsmtool lss scan` finds unconfigured slaves",
                )
            if answer[0] == command:
                return answer.ljust(8, b"\0")
