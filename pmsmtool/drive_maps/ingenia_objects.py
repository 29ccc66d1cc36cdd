# SPDX-License-Identifier: MIT
"""Objects of the monitor in Novanta/Ingenia Summit drives: a recorder whose data register is read again and again.

Addresses, types and bits: ingeniamc/ingenialink-python@626d4d7 tests/resources/den-net-e_2.8.0_v3.xdf (CANopen index
of each register, fields of the status, kinds of the trigger); how a register is mapped, that the sampling rate is the
position loop's over the divider, and blocks of 512 bytes: ingenialink/servo.py and examples/canopen/can_monitoring.py
there. Not confirmed, and not used: pre-trigger (0x58C2), edge triggers, and how the voltage is aligned to the current.
"""

from __future__ import annotations

from pmsmtool.drive_maps.recorder_map import Address

STATUS: Address = (0x58B0, 0, "I")
DATA = 0x58B2
LARGEST_BYTES: Address = (0x58B5, 0, "I")
BYTES_LEFT: Address = (0x58B7, 0, "I")
ENABLE: Address = (0x58C0, 0, "H")
DIVIDER: Address = (0x58C1, 0, "H")
WINDOW: Address = (0x58C3, 0, "I")
FIRST_MAP: Address = (0x58D0, 0, "I")
MAPPED: Address = (0x58E3, 0, "H")
ROW_BYTES: Address = (0x58E4, 0, "H")
REMOVE_DATA: Address = (0x58EA, 0, "H")
TRIGGER_KIND: Address = (0x58F0, 0, "H")
FORCE_TRIGGER: Address = (0x58F3, 0, "H")
LOOP_RATE_HZ: Address = (0x2520, 0, "I")
"""Rate of the position and velocity loops."""

CHANNELS = 16
BLOCK_BYTES = 512
FORCED = 1
"""Kind of trigger: by command."""
ENABLED_BIT, AVAILABLE_BIT = 1 << 0, 1 << 4
AXIS, AXIS_OFFSET = 1, 0x2000
"""Registers of the first axis stand at CANopen index address + 0x2000."""
TYPE_CODES = {
    "UNSIGNED8": 0, "INTEGER8": 1, "UNSIGNED16": 2, "INTEGER16": 3, "UNSIGNED32": 4, "INTEGER32": 5, "REAL32": 8,
}  # fmt: skip
"""Numbers of the types in a mapping word."""


def mapping_word(index: int, wire: str, size: int) -> int:
    """Return the word that maps the register of an object: address and axis, type, bytes."""
    return ((index - AXIS_OFFSET) | AXIS << 12) << 16 | TYPE_CODES[wire] << 8 | size


def mapped_index(word: int) -> int:
    """Return the CANopen index of the register a word maps."""
    return (word >> 16 & 0xFFF) + AXIS_OFFSET
