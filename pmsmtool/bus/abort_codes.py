# SPDX-License-Identifier: MIT
"""SDO abort codes (CiA 301, section 7.2.4.3.17, table 22) and what they mean to a person."""

from __future__ import annotations

from enum import IntEnum


class AbortCode(IntEnum):
    """Abort codes an SDO server or client may send."""

    TOGGLE = 0x05030000
    TIMED_OUT = 0x05040000
    COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE = 0x05040003
    CRC = 0x05040004
    MEMORY = 0x05040005
    ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE = 0x06040043
    INTERNAL = 0x06040047
    HARDWARE = 0x06060000
    LENGTH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE = 0x06090030
    VALUE_HIGH = 0x06090031
    VALUE_LOW = 0x06090032
    RANGE_INVERTED = 0x06090036
    RESOURCE = 0x060A0023
    GENERAL = 0x08000000
    NOT_STORED = 0x08000020
    LOCAL_CONTROL = 0x08000021
    DEVICE_STATE = 0x08000022
    NO_DICTIONARY = 0x08000023
    NO_DATA = 0x08000024


TRANSPORT_CODES = frozenset(
    {AbortCode.TOGGLE, AbortCode.TIMED_OUT, AbortCode.COMMAND, AbortCode.BLOCK_SIZE, AbortCode.SEQUENCE, AbortCode.CRC}
)
"""Codes that speak of the transfer, not of the value: the whole object may be tried again."""

BLOCK_REFUSED_CODES = frozenset({AbortCode.COMMAND, AbortCode.ACCESS})
"""What servers without block transfer answer to its initiate; other codes are about the object."""

BUSY_CODES = frozenset({AbortCode.RESOURCE, AbortCode.LOCAL_CONTROL, AbortCode.DEVICE_STATE})
"""What drives answer while they store, start, or are asked too much: the same request may pass a moment later."""

_MANUAL = "look the object up in the drive's manual or EDS; `pmsmtool info` names drive and firmware"
_LIMITS = "`pmsmtool param help NAME` shows the limits; another maker's: `pmsmtool export csv SET --map ITS.eds`"
_LIKELY: dict[int, tuple[str, str]] = {
    AbortCode.NO_OBJECT: ("the drive's firmware does not have this object", "compare `pmsmtool info` with the map"),
    AbortCode.NO_SUBINDEX: ("the drive's firmware does not have this object", "compare `pmsmtool info` with the map"),
    AbortCode.VALUE_HIGH: ("the value is above the drive's limit", _LIMITS),
    AbortCode.VALUE_LOW: ("the value is below the drive's limit", _LIMITS),
    AbortCode.VALUE: ("the value is outside what the drive accepts", _LIMITS),
    AbortCode.DEVICE_STATE: (
        "the drive takes it in another state only: disabled, enabled, or without a fault",
        "`pmsmtool stop`, then `pmsmtool fault show`",
    ),
    AbortCode.RESOURCE: ("the drive is busy, it may store or start", "run the command again in a few seconds"),
    AbortCode.LOCAL_CONTROL: ("the drive is under local control", "release the panel or the vendor's software"),
    AbortCode.READ_ONLY: ("the object only reports", _MANUAL),
    AbortCode.WRITE_ONLY: ("the object can only be written", _MANUAL),
}


def abort_text(code: int) -> str:
    """Return the meaning of an abort code as the package ``canopen`` words it; other codes are named as such."""
    from canopen.sdo.exceptions import SdoAbortedError

    text = SdoAbortedError.CODES.get(code, "abort code not in CiA 301")
    return text if text[1].isupper() else text[0].lower() + text[1:]


def abort_advice(code: int) -> tuple[str, str]:
    """Return the likely cause and the next step for an abort code; the cause is empty where the code tells none."""
    return _LIKELY.get(code, ("", _MANUAL))
