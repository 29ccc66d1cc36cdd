# SPDX-License-Identifier: MIT
"""What the CANopen node needs from the simulated drive's application (``pmsm_application.h``).

The node decides when something may happen and speaks CANopen; everything that happens every control period (control
core, excitation, recorder, window averages, trips, plant) lies behind this protocol. Between two calls of
:meth:`DriveCore.run` nothing moves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import Protocol

from pmsmtool.drive.port import Excitation
from pmsmtool.sim.kernel import Signal

TRACE_BYTES = 65536
"""Capacity of the recorder (bytes)."""
TRACE_CHANNELS = 8
"""Channels of the recorder, and of the window averages."""
BUFFER_SAMPLES = 4096
"""Capacity of the excitation buffer (binary32 samples)."""


class ControlMode(IntEnum):
    """What the controller does (``enum pmsm_mode``)."""

    OFF = 0
    VOLTAGE = 1
    CURRENT = 2
    TORQUE = 3
    SPEED = 4
    POSITION = 6


class PositionFlag(IntFlag):
    """``enum pmsm_position_flag``."""

    MOVING = 1 << 0
    FOLLOWING_ERROR = 1 << 1
    SOFTWARE_LIMIT = 1 << 2
    LIMIT_SWITCH = 1 << 3
    SATURATED = 1 << 4


class Trigger(IntEnum):
    """Trigger of the recorder (object 0x2060:04)."""

    NOW = 0
    RISING = 1
    FALLING = 2
    WINDOW = 3
    EXCITATION_START = 4
    FAULT = 5
    MOVE_START = 6


class ExcitationState(IntEnum):
    """Object 0x2050:0E."""

    IDLE = 0
    ARMED = 1
    RUNNING = 2
    DONE = 3
    ABORTED = 4


class RecorderState(IntEnum):
    """Object 0x2060:08."""

    IDLE = 0
    ARMED = 1
    TRIGGERED = 2
    COMPLETE = 3


class AverageState(IntEnum):
    """Object 0x2063:03."""

    IDLE = 0
    RUNNING = 1
    COMPLETE = 2


class HomingPhase(IntEnum):
    """``enum pmsm_homing_phase``."""

    IDLE = 0
    SEARCH = 1
    AWAY = 2
    REST = 3
    DONE = 4
    INTERRUPTED = 5
    FAILED = 6


@dataclass(frozen=True, slots=True)
class HomingCommand:
    """How to home (``pmsm_homing_request``); encoder counts, and counts per second."""

    active: bool = False
    start: bool = False
    method: int = 0
    slow: float = 0.0
    torque_nm: float = 0.0
    home_offset: int = 0


@dataclass(frozen=True, slots=True)
class PositionCommand:
    """What the position controller shall do (``pmsm_position_request``); encoder counts, and counts over seconds.

    A target counts when ``set_point`` is another number than before. ``profile`` moves to it within velocity,
    acceleration and jerk (0: not limited); without, it is reached on a straight line after ``interval_s``.
    """

    target: int = 0
    set_point: int = 0
    profile: bool = False
    interval_s: float = 0.001
    velocity: float = 0.0
    acceleration: float = 0.0
    deceleration: float = 0.0
    stop_deceleration: float = 0.0
    jerk: float = 0.0
    halt: bool = False
    minimum: int = 0
    maximum: int = 0
    window: float = 0.0
    window_time_s: float = 0.0
    homing: HomingCommand = HomingCommand()


def wrapped(count: int) -> int:
    """Return a count as 32 bits with a sign."""
    return (count + (1 << 31)) % (1 << 32) - (1 << 31)


@dataclass(frozen=True, slots=True)
class PositionState:
    """Position now, what it shall be, and their difference (encoder counts); flags, limit switches, and homing."""

    actual: int
    demand: int
    error: float
    flags: PositionFlag
    limits: int = 0
    homing: HomingPhase = HomingPhase.IDLE


@dataclass(frozen=True, slots=True)
class Command:
    """References of the running mode; SI, peak, mechanical speed, electrical frame angle.

    ``fixed_angle_rad`` is NaN when the frame follows the rotor. With ``quick_stop`` the core ramps the current to
    zero (and brakes in speed mode) and ignores the references.
    """

    mode: ControlMode = ControlMode.OFF
    i_d_a: float = 0.0
    i_q_a: float = 0.0
    torque_nm: float = 0.0
    omega_m_rad_s: float = 0.0
    fixed_angle_rad: float = math.nan
    quick_stop: bool = False
    position: PositionCommand | None = None


@dataclass(frozen=True, slots=True)
class RecorderSetup:
    """How to record (objects 0x2060, 0x2061); samples are taken every ``decimation`` periods."""

    channels: Sequence[Signal]
    depth: int
    decimation: int = 1
    pretrigger: int = 0
    trigger: Trigger = Trigger.NOW
    source: Signal = Signal.NONE
    level: float = 0.0


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """State of the recorder; ``trigger_position`` is the row of the trigger in the recording."""

    state: RecorderState
    stored: int = 0
    trigger_position: int = 0


@dataclass(frozen=True, slots=True)
class Averages:
    """Means and standard deviations over the last window, in the order of the signals asked for."""

    state: AverageState
    mean: Sequence[float] = field(default=())
    std: Sequence[float] = field(default=())


class DriveCore(Protocol):
    """The drive's application at control-period rate, with the machine behind it.

    Attributes
    ----------
    torque_safely_off : bool
        Whether the input for safe torque off is open.
    """

    torque_safely_off: bool

    @property
    def period_ns(self) -> int:
        """Control period of the loaded parameters (ns)."""

    @property
    def encoder_counts(self) -> int:
        """Encoder counts per mechanical turn."""

    def load(self, image: bytes) -> None:
        """Take a parameter image (``firmware/image.py``); controller memory is kept (live gains)."""

    def restart(self) -> None:
        """Firmware reset: gates off; controller memory, excitation, recorder and trip cleared; the rotor moves on."""

    def run(self, periods: int) -> int:
        """Run at most ``periods`` control periods and return how many ran (at least 1 for ``periods`` >= 1).

        Returns early after the period in which a trip was latched or the state of the excitation, the recorder, the
        averages or the position controller changed, so that the node can report it at the right time.
        """

    def command(self, command: Command) -> None:
        """Set mode and references from the next period on; mode OFF removes the gate signals at once."""

    def signal(self, signal: Signal) -> float:
        """Return a signal as it would be recorded now."""

    def position(self) -> PositionState:
        """Return the state of the position controller."""

    def trip(self) -> int:
        """Return the latched trip as CiA 402 error code (0x2310 over-current, ...), 0 when there is none."""

    def reset_fault(self) -> None:
        """Clear the trip latch; a cause that persists latches again in the next period."""

    def excite(self, excitation: Excitation | None) -> None:
        """Start an excitation in the running mode, change the running one, or end it with None.

        When an abort limit is exceeded the state becomes ABORTED and the injection ends.
        """

    def excitation_state(self) -> ExcitationState:
        """Return IDLE, RUNNING, DONE or ABORTED."""

    def record(self, setup: RecorderSetup | None) -> None:
        """Arm the recorder, or stop it with None (what was stored stays)."""

    def force_trigger(self) -> None:
        """Trigger an armed recorder now."""

    def recorder(self) -> RecorderStatus:
        """Return the state of the recorder."""

    def recording(self) -> bytes:
        """Return the stored rows, oldest first: one little-endian binary32 per channel."""

    def average(self, signals: Sequence[Signal], periods: int) -> None:
        """Start a window average over the next ``periods`` periods."""

    def averages(self) -> Averages:
        """Return the state and, when complete, the result of the window average."""
