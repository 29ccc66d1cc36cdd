# SPDX-License-Identifier: MIT
"""The objects the tool uses: standard ones (CiA 301, CiA 402) and those of the reference drive.

Parameters stand in the catalogue and reach a drive through its map; these are the ones around them.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, replace

WHOLE_LETTERS = {1: "b", 2: "h", 4: "i", 8: "q"}
"""``struct`` letters of the integers of CiA 301 by their bytes."""


@dataclass(frozen=True, slots=True)
class DriveObject:
    """One object with a number in it."""

    index: int
    sub: int
    """Address."""
    letter: str
    """``struct`` letter of its CiA 301 type."""

    @property
    def size(self) -> int:
        """Bytes on the wire."""
        return struct.calcsize("<" + self.letter)

    @property
    def mapping_word(self) -> int:
        """Word that names the object as a trace channel or PDO entry (coding of 0x1A00)."""
        return self.index << 16 | self.sub << 8 | 8 * self.size

    def encode(self, value: float) -> bytes:
        """Return the bytes of a value; raises ``struct.error`` or ``OverflowError`` when it does not fit."""
        return struct.pack("<" + self.letter, value if self.letter == "f" else round(value))

    def decode(self, data: bytes) -> float:
        """Return the value of the object's bytes."""
        return float(struct.unpack("<" + self.letter, data)[0])

    def of_length(self, length: int) -> DriveObject | None:
        """Return the object as a drive has it that keeps the same whole number in so many bytes; None: it cannot be."""
        letter = WHOLE_LETTERS.get(length) if self.letter in "bBhHiIqQ" else None
        if length == self.size:
            return self
        return None if letter is None else replace(self, letter=letter if self.letter.islower() else letter.upper())


DEVICE_TYPE = DriveObject(0x1000, 0, "I")
ERROR_REGISTER = DriveObject(0x1001, 0, "B")
DC_LINK_MV = DriveObject(0x6079, 0, "I")
ERROR_HISTORY = 0x1003
DEVICE_NAME, HARDWARE_VERSION, SOFTWARE_VERSION = (0x1008, 0), (0x1009, 0), (0x100A, 0)
STORE_ALL = (0x1010, 1)
GUARD_TIME_MS = DriveObject(0x100C, 0, "H")
LIFE_TIME_FACTOR = DriveObject(0x100D, 0, "B")
CONSUMER_HEARTBEAT = 0x1016
PRODUCER_HEARTBEAT_MS = DriveObject(0x1017, 0, "H")
IDENTITY = 0x1018
CONFIGURATION_DATE = DriveObject(0x1020, 1, "I")
CONFIGURATION_TIME = DriveObject(0x1020, 2, "I")

ABORT_CONNECTION = DriveObject(0x6007, 0, "h")
ERROR_CODE = DriveObject(0x603F, 0, "H")
CONTROLWORD = DriveObject(0x6040, 0, "H")
STATUSWORD = DriveObject(0x6041, 0, "H")
QUICK_STOP_OPTION = DriveObject(0x605A, 0, "h")
FAULT_REACTION = DriveObject(0x605E, 0, "h")
MODE = DriveObject(0x6060, 0, "b")
MODE_DISPLAY = DriveObject(0x6061, 0, "b")
VELOCITY_MRPM = DriveObject(0x606C, 0, "i")
TARGET_TORQUE_PERMILLE = DriveObject(0x6071, 0, "h")
MAX_CURRENT_PERMILLE = DriveObject(0x6073, 0, "H")
RATED_CURRENT_MA = DriveObject(0x6075, 0, "I")
CURRENT_PERMILLE = DriveObject(0x6078, 0, "h")
MAX_SPEED_RPM = DriveObject(0x6080, 0, "I")
PROFILE_VELOCITY = DriveObject(0x6081, 0, "I")
PROFILE_ACCELERATION = DriveObject(0x6083, 0, "I")
PROFILE_DECELERATION = DriveObject(0x6084, 0, "I")
PROFILE_JERK = DriveObject(0x60A4, 1, "I")
QUICK_STOP_DECELERATION = DriveObject(0x6085, 0, "I")
TARGET_VELOCITY_MRPM = DriveObject(0x60FF, 0, "i")
ENCODER_INCREMENTS = DriveObject(0x608F, 1, "I")
SUPPORTED_MODES = DriveObject(0x6502, 0, "I")

SET_SCHEMA = DriveObject(0x2000, 1, "H")
SET_SIGNATURE = DriveObject(0x2000, 2, "I")
SET_CRC_ACTIVE = DriveObject(0x2000, 3, "I")
SET_CRC_STORED = DriveObject(0x2000, 4, "I")
SET_CRC_EXPECTED = DriveObject(0x2000, 5, "I")
SET_COMMAND = DriveObject(0x2000, 6, "B")
SET_STATE = DriveObject(0x2000, 7, "B")
SET_OFFENDER = DriveObject(0x2000, 8, "I")
SET_IMAGE = (0x2001, 0)

EXCITATION_COMMAND = DriveObject(0x2050, 0x0D, "B")
EXCITATION_BUFFER = (0x2051, 0)
EXCITATION_FIELDS: dict[str, DriveObject] = {
    "shape": DriveObject(0x2050, 0x01, "B"),
    "point": DriveObject(0x2050, 0x02, "B"),
    "amplitude": DriveObject(0x2050, 0x03, "f"),
    "bias_d_a": DriveObject(0x2050, 0x04, "f"),
    "bias_q_a": DriveObject(0x2050, 0x05, "f"),
    "f0_hz": DriveObject(0x2050, 0x06, "f"),
    "f1_hz": DriveObject(0x2050, 0x07, "f"),
    "duration_s": DriveObject(0x2050, 0x08, "f"),
    "hold_periods": DriveObject(0x2050, 0x09, "I"),
    "fixed_angle_rad": DriveObject(0x2050, 0x0A, "f"),
    "abort_current_apk": DriveObject(0x2050, 0x0B, "f"),
    "abort_speed_rad_s": DriveObject(0x2050, 0x0C, "f"),
    "bias_bandwidth_rad_s": DriveObject(0x2050, 0x0F, "f"),
    "amplitude_q": DriveObject(0x2050, 0x10, "f"),
    "i_limit_d_a": DriveObject(0x2050, 0x11, "f"),
    "i_limit_q_a": DriveObject(0x2050, 0x12, "f"),
    "i_centre_d_a": DriveObject(0x2050, 0x13, "f"),
}
"""Fields of ``port.Excitation`` (``buffer`` is the DOMAIN 0x2051)."""

SET_POINT_D = DriveObject(0x2052, 1, "f")
SET_POINT_Q = DriveObject(0x2052, 2, "f")
SET_POINT_ANGLE = DriveObject(0x2052, 3, "f")

TRACE_DECIMATION = DriveObject(0x2060, 1, "H")
TRACE_DEPTH = DriveObject(0x2060, 2, "I")
TRACE_PRETRIGGER = DriveObject(0x2060, 3, "I")
TRACE_TRIGGER = DriveObject(0x2060, 4, "B")
TRACE_COMMAND = DriveObject(0x2060, 7, "B")
TRACE_STATE = DriveObject(0x2060, 8, "B")
TRACE_STORED = DriveObject(0x2060, 9, "I")
TRACE_POSITION = DriveObject(0x2060, 0x0A, "I")
TRACE_CAPACITY = DriveObject(0x2060, 0x0B, "I")
TRACE_CRC = DriveObject(0x2060, 0x0C, "I")
TRACE_PERIOD_NS = DriveObject(0x2060, 0x0D, "I")
TRACE_VOLTAGE_LAG = DriveObject(0x2060, 0x0E, "B")
TRACE_CHANNELS = tuple(DriveObject(0x2061, sub, "I") for sub in range(1, 9))
TRACE_DATA = (0x2062, 0)

AVERAGE_PERIODS = DriveObject(0x2063, 1, "I")
AVERAGE_COMMAND = DriveObject(0x2063, 2, "B")
AVERAGE_STATE = DriveObject(0x2063, 3, "B")
AVERAGE_MEANS = tuple(DriveObject(0x2063, sub, "f") for sub in range(0x11, 0x19))
AVERAGE_CHANNELS = tuple(DriveObject(0x2064, sub, "I") for sub in range(1, 9))

LIVE: dict[str, DriveObject] = {
    "i_d_a": DriveObject(0x2070, 0x01, "f"),
    "i_q_a": DriveObject(0x2070, 0x02, "f"),
    "i_d_ref_a": DriveObject(0x2070, 0x03, "f"),
    "i_q_ref_a": DriveObject(0x2070, 0x04, "f"),
    "u_d_v": DriveObject(0x2070, 0x05, "f"),
    "u_q_v": DriveObject(0x2070, 0x06, "f"),
    "omega_e_rad_s": DriveObject(0x2070, 0x07, "f"),
    "U_dc_v": DriveObject(0x2070, 0x08, "f"),
    "i_d_req_a": DriveObject(0x2070, 0x09, "f"),
    "i_q_req_a": DriveObject(0x2070, 0x0A, "f"),
    "theta_e_rad": DriveObject(0x2070, 0x0B, "f"),
    "u_d_lim_v": DriveObject(0x2070, 0x0C, "f"),
    "u_q_lim_v": DriveObject(0x2070, 0x0D, "f"),
    "i_a_a": DriveObject(0x2070, 0x0E, "f"),
    "i_b_a": DriveObject(0x2070, 0x0F, "f"),
    "i_c_a": DriveObject(0x2070, 0x10, "f"),
    "flags": DriveObject(0x2070, 0x11, "I"),
    "T_winding_c": DriveObject(0x2070, 0x12, "f"),
    "T_magnet_c": DriveObject(0x2070, 0x13, "f"),
    "theta_m_rad": DriveObject(0x2070, 0x14, "f"),
    "torque_nm": DriveObject(0x2070, 0x15, "f"),
    "kappa": DriveObject(0x2070, 0x16, "f"),
    "binding": DriveObject(0x2070, 0x17, "I"),
    "iterations": DriveObject(0x2070, 0x18, "I"),
    "following_error_rad": DriveObject(0x2070, 0x19, "f"),
    "hall_pattern": DriveObject(0x2070, 0x1A, "I"),
}
"""Live quantities of the reference drive; also what its recorder and its averages take."""

_SUFFIX_UNITS = (("_rad_s", "rad/s"), ("_rad", "rad"), ("_nm", "N m"), ("_a", "A"), ("_v", "V"), ("_c", "degC"))


AXIS_STEP, LAST_AXIS = 0x800, 8
"""Between the objects of one axis and of the next, and how many axes a device has at most (CiA 402-1)."""


def of_axis(item: DriveObject, axis: int) -> DriveObject:
    """Return the object of a further axis of a device; the first is 1."""
    return replace(item, index=item.index + (axis - 1) * AXIS_STEP)


def on_first_axis(index: int) -> int:
    """Return the index that an object of a further axis has on the first one; any other index as it is."""
    first = 0x6000
    return first + (index - first) % AXIS_STEP if first <= index < first + LAST_AXIS * AXIS_STEP else index


def signal_unit(name: str) -> str:
    """Return the unit of a signal from its suffix, ``1`` where it has none."""
    return next((unit for suffix, unit in _SUFFIX_UNITS if name.endswith(suffix)), "1")


FOLLOW_ROTOR = math.nan
"""Fixed angle that means: the frame follows the rotor."""
