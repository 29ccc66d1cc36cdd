# SPDX-License-Identifier: MIT
"""What one count of a drive's speed reference is worth: measured by its own position, from no speed upwards."""

from __future__ import annotations

from pmsmtool.drive.guard import GuardedDrive
from pmsmtool.drive.speed_loop_drive import SpeedLoopDrive
from pmsmtool.errors import NotAvailable

GROWTH = 4.0
"""A speed that is not seen is asked for this many times as large."""
SEEN = 0.125
"""Share of the wanted speed from which the shaft counts as turning as asked."""
SETTLE_S, LOOK_S = 0.3, 0.1
SETTLED_S = 0.8
"""Before a look: whether the shaft turns at all; at what speed."""
TRIES = 20
"""4^20 is more than any encoder's counts per turn."""
LINEAR = 0.1
"""Two speeds, one twice the other, give the same unit within this; cogging and a slow integral leave some percent."""


def find_speed_unit(guard: GuardedDrive, drive: SpeedLoopDrive, aim_rad_s: float) -> float:
    """Bring the shaft to a speed, and leave in the drive what one count of 0x60FF is worth; return it (rad/s).

    It begins with the smallest number of counts, and asks for more only while the shaft turns slower than wanted: the
    speed that is commanded never exceeds ``GROWTH`` times the one that was seen, or the speed that is wanted.

    Raises NotAvailable: the shaft does not follow.
    """
    per_count = drive.rad_s_per_count
    for _ in range(TRIES):
        counts = max(1, int(SEEN * aim_rad_s / per_count))
        seen = _speed(guard, drive, counts * per_count)
        if abs(seen) > SEEN * aim_rad_s / GROWTH:
            per_count = drive.rad_s_per_count = seen / counts
            half, whole = (
                per_count * _speed(guard, drive, speed, SETTLED_S) / (per_count * round(speed / per_count))
                for speed in (0.5 * aim_rad_s, aim_rad_s)
            )
            if abs(half - whole) > LINEAR * abs(whole):
                break
            drive.rad_s_per_count = whole
            return whole
        per_count /= GROWTH
        drive.rad_s_per_count = per_count
    raise NotAvailable(
        "the shaft does not follow the drive's velocity mode", where=f"node {drive.node.node}, 0x60FF:00",
        likely="the shaft is blocked, the speed loop too weak for its friction, or a ramp of the drive's very slow",
        hint="`pmsmtool check` looks at the wiring",
    )  # fmt: skip


def _speed(guard: GuardedDrive, drive: SpeedLoopDrive, omega_rad_s: float, settle_s: float = SETTLE_S) -> float:
    """Command a speed, let it settle, and return the one of the shaft (rad/s)."""
    guard.command_speed(omega_rad_s)
    guard.wait(settle_s)
    clock = drive.node.connection.clock
    first, began = guard.live("theta_m_rad"), clock.now()
    guard.wait(LOOK_S)
    return (guard.live("theta_m_rad") - first) / (clock.now() - began)
