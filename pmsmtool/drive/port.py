# SPDX-License-Identifier: MIT
"""What a drive can do for the tool: the port every transport and every simulated drive implements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:  # numpy is not for commands that only read a parameter
    from pmsmtool.trace import Trace


class Injection(IntEnum):
    """Injection point of the excitation (object 0x2050:02)."""

    U_D = 0
    U_Q = 1
    I_D = 2
    I_Q = 3
    SPEED = 4


class Shape(IntEnum):
    """Shape of the excitation (object 0x2050:01)."""

    NONE = 0
    STEP = 1
    SINE = 2
    CHIRP = 3
    PRBS = 4
    BUFFER = 5
    SQUARE = 6
    DC = 7
    HYSTERESIS = 8


SERIAL_BITS = 64
"""Of a serial number outside 0x1018."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity object 0x1018 and names of a drive.

    ``serial`` is the maker's own object where 0x1018:04 is absent or 0 and the map names one; 0: the drive tells none.
    ``doubt`` says why its vendor number, which makers share, does not make it the map's drive; empty: nothing does.
    """

    node: int
    vendor: int
    product: int
    revision: int
    serial: int
    name: str = ""
    hardware: str = ""
    software: str = ""
    doubt: str = ""

    @property
    def vendor_product(self) -> tuple[int, int]:
        """Vendor and product for which a map may be chosen; in doubt a product that no map has."""
        return self.vendor, -1 if self.doubt else self.product


@dataclass(frozen=True, slots=True)
class Excitation:
    """One experiment's signal, as the drive generates it (object 0x2050); SI, electrical rad.

    ``amplitude`` is the wave's amplitude at the injection point (V, A or rad/s); ``bias_d_a`` and ``bias_q_a``
    are held by the drive's current loop of bandwidth ``bias_bandwidth_rad_s``; ``fixed_angle_rad`` is
    None to follow the rotor. ``amplitude_q`` and ``i_limit_*`` are for hysteresis pulses. ``lead_s`` is how long it
    runs before the recorder is started: its own first transient stays out of the record.
    """

    shape: Shape
    point: Injection
    amplitude: float
    bias_d_a: float = 0.0
    bias_q_a: float = 0.0
    bias_bandwidth_rad_s: float = 0.0
    f0_hz: float = 0.0
    f1_hz: float = 0.0
    duration_s: float = 0.0
    hold_periods: int = 1
    fixed_angle_rad: float | None = None
    amplitude_q: float = 0.0
    i_limit_d_a: float = 0.0
    i_limit_q_a: float = 0.0
    i_centre_d_a: float = 0.0
    abort_current_apk: float = 0.0
    abort_speed_rad_s: float = 0.0
    buffer: Sequence[float] = field(default=())
    lead_s: float = 0.0


@dataclass(frozen=True, slots=True)
class ProfileMove:
    """A move from where the shaft stands: its way and its limits in increments, per s, s2 and s3 (0: no jerk limit)."""

    way: int
    velocity: int
    acceleration: int
    jerk: int = 0


@dataclass(frozen=True, slots=True)
class Recording:
    """One record: signals every ``decimation`` control periods, from ``pretrigger`` samples before the excitation.

    With ``move``: from the period in which the reference of that move begins to move.
    """

    signals: Sequence[str]
    samples: int
    decimation: int = 1
    excitation: Excitation | None = None
    pretrigger: int = 0
    move: ProfileMove | None = None


class Halves(NamedTuple):
    """Means of two windows, one right after the other, and how many samples of every signal both hold together."""

    first: Mapping[str, float]
    second: Mapping[str, float]
    samples: int


class Drive(Protocol):
    """A connected drive. Every method may raise ``BusError``, ``SdoAbort`` or ``DriveFault``."""

    identity: Identity

    @property
    def period_s(self) -> float:
        """Control period (s)."""

    def read(self, name: str) -> float:
        """Return one parameter by catalogue name, in SI."""

    def write(self, values: Mapping[str, float]) -> None:
        """Write parameters (staged and activated where the drive stages); the guard restores them."""

    def enable(self) -> None:
        """Bring the drive to operation enabled at zero reference."""

    def disable(self) -> None:
        """Remove the voltage; returns when the statusword confirms it."""

    def quick_stop(self) -> None:
        """Stop as fast as the drive can and confirm it, else raise ``StopNotConfirmed``."""

    def command_current(self, i_d_a: float, i_q_a: float, *, fixed_angle_rad: float | None = None) -> None:
        """Hold a current vector (A peak), in the rotor frame or at a fixed electrical angle."""

    def command_speed(self, omega_m_rad_s: float) -> None:
        """Run at a mechanical speed (rad/s)."""

    def average(self, signals: Sequence[str], periods: int) -> Mapping[str, float]:
        """Return means over a window of control periods, taken inside the drive."""

    def halves(self, signals: Sequence[str], periods: int) -> Halves:
        """Return means over two windows of so many control periods each, one right after the other."""

    def record(
        self,
        signals: Sequence[str],
        samples: int,
        *,
        decimation: int = 1,
        excitation: Excitation | None = None,
        pretrigger: int = 0,
    ) -> Trace:
        """Record signals every ``decimation`` periods, starting with the excitation if there is one."""

    def record_move(self, signals: Sequence[str], samples: int, decimation: int, move: ProfileMove) -> Trace:
        """Move by the drive's own position loop; record from the period in which the reference begins to move."""

    def live(self, name: str) -> float:
        """Return one live quantity (``drive.objects.LIVE``) as it is now."""

    def wait(self, seconds: float) -> None:
        """Let time pass on the bus clock."""
