# SPDX-License-Identifier: MIT
"""CiA 402: states, modes, controlword and statusword, option codes; one source for tool and simulated drive.

Numbers follow IEC 61800-7-201 (CiA 402-2): statusword tables and the finite-state automaton of power drive systems.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag

HOMING_LOST = "homing is lost"
"""Said before an alignment, a change of the encoder's parameters and a reset: the position reference is gone after."""


class State(IntEnum):
    """States of the power drive system; the value is the statusword pattern of the state."""

    NOT_READY_TO_SWITCH_ON = 0x0000
    SWITCH_ON_DISABLED = 0x0040
    READY_TO_SWITCH_ON = 0x0021
    SWITCHED_ON = 0x0023
    OPERATION_ENABLED = 0x0027
    QUICK_STOP_ACTIVE = 0x0007
    FAULT_REACTION_ACTIVE = 0x000F
    FAULT = 0x0008

    @property
    def energised(self) -> bool:
        """Whether the power stage may drive current in this state."""
        return self in _ENERGISED


_ENERGISED = (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)
_MASK_SHORT = 0x004F
_MASK_LONG = 0x006F
_SHORT = (State.NOT_READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED, State.FAULT_REACTION_ACTIVE, State.FAULT)
_LONG = (
    State.READY_TO_SWITCH_ON,
    State.SWITCHED_ON,
    State.OPERATION_ENABLED,
    State.QUICK_STOP_ACTIVE,
)


class Status(IntFlag):
    """Bits of the statusword 0x6041."""

    READY_TO_SWITCH_ON = 1 << 0
    SWITCHED_ON = 1 << 1
    OPERATION_ENABLED = 1 << 2
    FAULT = 1 << 3
    VOLTAGE_ENABLED = 1 << 4
    QUICK_STOP_NOT_ACTIVE = 1 << 5
    SWITCH_ON_DISABLED = 1 << 6
    WARNING = 1 << 7
    REMOTE = 1 << 9
    TARGET_REACHED = 1 << 10
    INTERNAL_LIMIT = 1 << 11
    SPEED_ZERO = 1 << 12
    SET_POINT_TAKEN = 1 << 12
    HOMING_ATTAINED = 1 << 12
    FOLLOWING_ERROR = 1 << 13
    HOMING_ERROR = 1 << 13


class Control(IntFlag):
    """Bits of the controlword 0x6040."""

    SWITCH_ON = 1 << 0
    ENABLE_VOLTAGE = 1 << 1
    QUICK_STOP_OFF = 1 << 2
    ENABLE_OPERATION = 1 << 3
    NEW_SET_POINT = 1 << 4
    AT_ONCE = 1 << 5
    RELATIVE = 1 << 6
    FAULT_RESET = 1 << 7
    HALT = 1 << 8


class Command(IntEnum):
    """Controlwords that ask for a transition."""

    DISABLE_VOLTAGE = 0x0000
    QUICK_STOP = 0x0002
    SHUTDOWN = 0x0006
    SWITCH_ON = 0x0007
    ENABLE_OPERATION = 0x000F
    FAULT_RESET = 0x0080


class Mode(IntEnum):
    """Modes of operation, objects 0x6060 and 0x6061."""

    IDENTIFICATION = -1
    """Manufacturer mode: current set-point 0x2052 and excitation 0x2050."""
    NONE = 0
    PROFILE_POSITION = 1
    PROFILE_VELOCITY = 3
    PROFILE_TORQUE = 4
    HOMING = 6
    INTERPOLATED_POSITION = 7
    CYCLIC_POSITION = 8
    CYCLIC_VELOCITY = 9
    CYCLIC_TORQUE = 10
    CYCLIC_TORQUE_ANGLE = 11
    """Torque with a commutation angle from the master (0x60EA)."""


class AbortConnection(IntEnum):
    """Abort connection option code 0x6007: what the drive does when the connection is lost."""

    NO_ACTION = 0
    FAULT = 1
    DISABLE_VOLTAGE = 2
    QUICK_STOP = 3


class QuickStop(IntEnum):
    """Quick stop option code 0x605A."""

    DISABLE = 0
    SLOW_DOWN = 1
    QUICK_STOP_RAMP = 2
    CURRENT_LIMIT = 3
    SLOW_DOWN_AND_STAY = 5
    QUICK_STOP_RAMP_AND_STAY = 6
    CURRENT_LIMIT_AND_STAY = 7

    @property
    def stays(self) -> bool:
        """Whether the drive remains in quick stop active after standstill."""
        return self >= QuickStop.SLOW_DOWN_AND_STAY


class FaultReaction(IntEnum):
    """Fault reaction option code 0x605E."""

    DISABLE = 0
    SLOW_DOWN = 1
    QUICK_STOP_RAMP = 2


EXCITATION_ABORTED = 0xFF10
"""Error code of the reference drive: it ended an excitation by itself."""
ERROR_TEXTS: dict[int, str] = {
    0x0000: "no error",
    0x2310: "continuous over-current at the output",
    0x2350: "thermal overload of the motor (I2t)",
    0x3210: "DC-link over-voltage",
    0x3220: "DC-link under-voltage",
    0x4310: "motor over-temperature",
    0x5530: "non-volatile memory fault",
    0x6100: "internal software fault",
    0x6310: "parameter set lost, factory values are active",
    0x6320: "parameter error",
    0x7300: "sensor fault",
    0x7305: "encoder fault",
    0x8100: "connection ended while the drive was enabled",
    0x8130: "heartbeat of the master lost",
    0x8210: "PDO not processed: too short",
    0x8480: "over-speed",
    0x8611: "following error",
    EXCITATION_ABORTED: "excitation left its abort limit",
}
"""Error codes of object 0x603F and of emergency messages (CiA 301 table 26, CiA 402-2)."""


ERROR_CAUSES: dict[int, str] = {
    0x2320: "two motor leads touch each other or earth, or the output stage is damaged",
    0x7305: "the encoder's cable or supply; its index is missing; another encoder than is set",
    0x2350: "more current, or for longer, than the winding can carry",
    0x3210: "the shaft was braked and nothing takes its energy: no chopper, or a supply that cannot sink",
    0x3220: "the supply is off, too weak, or in current limit: raise its limit, or go on with a lower --i-max",
    0x4310: "the winding is still warm from what ran before: let it cool, then go on",
    0x8611: "a blocked shaft or a closed brake, an encoder that counts the other way (`pmsmtool check`), too small a "
    "current limit for the move, or a narrow window (0x6065)",
}
"""Likely cause of some of them."""


def state_of(statusword: int) -> State | None:
    """Return the state a statusword shows, None for a pattern the standard does not define."""
    short = statusword & _MASK_SHORT
    if short in _SHORT:
        return State(short)
    long = statusword & _MASK_LONG
    return State(long) if long in _LONG else None


_PATH: dict[State, Command] = {
    State.SWITCH_ON_DISABLED: Command.SHUTDOWN,
    State.READY_TO_SWITCH_ON: Command.SWITCH_ON,
    State.SWITCHED_ON: Command.ENABLE_OPERATION,
    State.QUICK_STOP_ACTIVE: Command.DISABLE_VOLTAGE,
}


def command_towards_enabled(state: State) -> Command | None:
    """Return the next controlword on the way to OPERATION ENABLED.

    None when there is nothing to send: already there, still starting, or in fault (a fault is reset on purpose only).
    """
    return _PATH.get(state)


def error_text(code: int) -> str:
    """Return the text of an error code, by its group when the code itself is not listed."""
    text = ERROR_TEXTS.get(code)
    if text is not None:
        return text
    group = _GROUPS.get(code >> 8) or _GROUPS.get((code >> 12) << 4)
    return group or "manufacturer-specific error"


_GROUPS: dict[int, str] = {
    0x10: "generic error",
    0x20: "current",
    0x21: "current, device input side",
    0x22: "current inside the device",
    0x23: "current, device output side",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "DC-link voltage",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x43: "drive temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x70: "additional modules",
    0x73: "sensor",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol error",
    0x84: "speed controller",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "manufacturer-specific error",
}

LEAST_LINK_V = 5.0
"""A DC link below this has no supply; the smallest drives work from about 10 V. Above it 0x6079 counts mV."""
