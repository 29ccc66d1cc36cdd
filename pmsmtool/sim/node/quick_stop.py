# SPDX-License-Identifier: MIT
"""How the simulated drive comes to rest: quick stop and fault reaction with a ramp.

In the speed and torque modes the machine is braked: by the ramp 0x6085 where the speed controller is tuned and the
option code asks for a ramp, else at the current limit. In the other modes (identification, none) the rotor angle may
still be unknown and torque could drive instead of brake, so the current goes to zero and the machine coasts.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from pmsmtool.bus.clock import NS, Schedule, Timer
from pmsmtool.cia402 import QuickStop
from pmsmtool.sim.kernel import Signal
from pmsmtool.sim.node.dictionary import Dictionary
from pmsmtool.sim.node.drive_core import Command, ControlMode, DriveCore
from pmsmtool.units import RAD_S_PER_RPM

CURRENT_GONE_SHARE = 0.02
"""Share of I_nom below which a ramped-down current counts as zero."""
_POLL_S = 0.001
_MARGIN_S = 0.5
_FACTOR = 1.5
# The gates go off at the latest after the margin and this many times the ramp's own time.
_RAMPED = (
    QuickStop.SLOW_DOWN,
    QuickStop.QUICK_STOP_RAMP,
    QuickStop.SLOW_DOWN_AND_STAY,
    QuickStop.QUICK_STOP_RAMP_AND_STAY,
)


class Stopping:
    """One stop at a time.

    Parameters
    ----------
    core : DriveCore
        What is stopped.
    omega_m, standstill_rad_s : callables
        Return the mechanical speed now, and below which the machine counts as standing (rad/s).
    parameter : callable
        Returns an active parameter by catalogue name.
    done : callable
        Called when the machine stands, the current is gone, or the time for it has passed.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        schedule: Schedule,
        core: DriveCore,
        *,
        omega_m: Callable[[], float],
        standstill_rad_s: Callable[[], float],
        parameter: Callable[[str], float],
        done: Callable[[], None],
    ) -> None:
        self._deceleration = dictionary["cia402.quick_stop_deceleration"]
        self._schedule = schedule
        self._core = core
        self._omega_m = omega_m
        self._standstill_rad_s = standstill_rad_s
        self._parameter = parameter
        self._done = done
        self._timer: Timer | None = None
        self._deadline_ns = 0
        self._brakes = False
        self._ramp_rad_s: float | None = None

    def begin(self, control: ControlMode, option: QuickStop) -> None:
        """Begin to stop from a control mode as an option code of object 0x605A says."""
        omega = self._omega_m()
        seconds = _MARGIN_S + _FACTOR * abs(omega) / self._slope_rad_s2()
        self._deadline_ns = self._schedule.now_ns + round(seconds * NS)
        turns = abs(omega) > self._standstill_rad_s()
        self._brakes = control in (ControlMode.SPEED, ControlMode.POSITION) or (control is ControlMode.TORQUE and turns)
        is_tuned = self._parameter("speed.K_p_nms_per_rad") > 0.0
        self._ramp_rad_s = omega if self._brakes and is_tuned and option in _RAMPED else None
        if self._brakes:
            # The core brakes in the mode it was in: some periods in the speed mode come first.
            self._core.command(Command(ControlMode.SPEED, omega_m_rad_s=omega))
        else:
            self._core.command(Command(control, quick_stop=True))
        self.cancel()
        self._timer = self._schedule.after(_POLL_S, self._poll)

    def cancel(self) -> None:
        """Forget the stop under way."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _slope_rad_s2(self) -> float:
        return self._deceleration.number() * RAD_S_PER_RPM

    def _poll(self) -> None:
        self._timer = None
        if self._has_stopped() or self._schedule.now_ns >= self._deadline_ns:
            self._done()
            return
        if self._brakes:
            self._brake()
        self._timer = self._schedule.after(_POLL_S, self._poll)

    def _brake(self) -> None:
        omega = self._ramp_rad_s
        if omega is None:
            self._core.command(Command(ControlMode.SPEED, quick_stop=True))
            return
        step = self._slope_rad_s2() * _POLL_S
        self._ramp_rad_s = math.copysign(max(0.0, abs(omega) - step), omega)
        self._core.command(Command(ControlMode.SPEED, omega_m_rad_s=self._ramp_rad_s))

    def _has_stopped(self) -> bool:
        omega = self._omega_m()  # brings the core to the present instant, too
        if self._brakes:
            return abs(omega) <= self._standstill_rad_s()
        current = math.hypot(self._core.signal(Signal.I_D), self._core.signal(Signal.I_Q))
        return current <= CURRENT_GONE_SHARE * self._parameter("motor.I_nom_apk")
