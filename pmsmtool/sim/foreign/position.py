# SPDX-License-Identifier: MIT
"""Position modes of a simulated drive of another maker: its own profile, its own loop, its own units.

Mode 1 runs trapezoids between set-points taken with bit 4 of the controlword, mode 8 follows the target as it comes.
The loop is one controller of the position, or a position gain on a speed controller; it shares nothing with the tool's
design. Torque is all that it commands; its sign is that of the encoder's counts, also of one that counts against the
phase order: a commissioned drive knows the direction.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from pmsmtool.cia402 import State
from pmsmtool.sim.foreign.behind import POSITION_MODES, Behind
from pmsmtool.sim.node.dictionary import Dictionary, Entry, Refused

if TYPE_CHECKING:
    from pmsmtool.bus.clock import Schedule
    from pmsmtool.sim.node.power_drive import PowerDrive

TURN = 2.0 * math.pi
NEW_SET_POINT, AT_ONCE, RELATIVE, HALT = 0x0010, 0x0020, 0x0040, 0x0100
ACKNOWLEDGED, REACHED = 0x1000, 0x0400
DERIVATIVE_POLE = 10.0
"""Pole of the derivative over K_P / K_D (EPOS4 application notes, rel6835)."""
ARRIVED_TURNS = 1e-3
WORD_TURNS = 1 << 32


class _Trapezoid:
    """A move at limited speed and acceleration from rest to rest, by the clock (turns, s)."""

    def __init__(self, start: float, end: float, speed: float, up: float, down: float) -> None:
        way = abs(end - start)
        self.start, self.sign = start, math.copysign(1.0, end - start)
        top = min(speed, math.sqrt(2.0 * way * up * down / (up + down))) if way else 0.0
        self.top, self.up, self.down, self.end = top, up, down, end
        self.t_up, self.t_down = top / up, top / down
        even = way - 0.5 * top * (self.t_up + self.t_down)
        self.t_even = even / top if top else 0.0

    def at(self, t: float) -> tuple[float, float, float]:
        """Return place, speed and acceleration."""
        if t < self.t_up:
            return self.start + self.sign * 0.5 * self.up * t * t, self.sign * self.up * t, self.sign * self.up
        done = 0.5 * self.top * self.t_up
        t -= self.t_up
        if t < self.t_even:
            return self.start + self.sign * (done + self.top * t), self.sign * self.top, 0.0
        done += self.top * self.t_even
        t -= self.t_even
        if t < self.t_down:
            speed = self.top - self.down * t
            place = done + self.top * t - 0.5 * self.down * t * t
            return self.start + self.sign * place, self.sign * speed, -self.sign * self.down
        return self.end, 0.0, 0.0

    def over(self, t: float) -> bool:
        """Whether the move has ended."""
        return t >= self.t_up + self.t_even + self.t_down


class PositionLoop:
    """Runs while the drive is enabled in a position mode.

    Parameters
    ----------
    behind : Behind
        The machine.
    dictionary, power, schedule
        Of the session.
    per_turn, per_rps : float
        Units of position per turn; of speed per turn per second, and of acceleration per turn per second squared.
    period_s : float
        Of the loop.
    """

    def __init__(
        self,
        behind: Behind,
        dictionary: Dictionary,
        power: PowerDrive,
        schedule: Schedule,
        per_turn: float,
        per_rps: float,
        period_s: float,
    ) -> None:
        self.behind, self._find, self._power, self._schedule = behind, dictionary.find, power, schedule
        self._per_turn, self._per_rps, self._T = per_turn, per_rps, period_s
        self._running = self._acknowledged = False
        self._target: float | None = None
        self._word = 0
        self._begin(0.0)

    def _begin(self, turns: float) -> None:
        self.demand = self._at = self._ahead = turns
        self._move: _Trapezoid | None = None
        self._waiting: float | None = None
        self._began_ns = 0
        self._sum = self._derivative = self._error = self._demand_speed = 0.0

    def hook(self, mode: Callable[[], int]) -> None:
        """Watch the controlword and the target; show demand, following error and the bits of the mode."""
        self._mode = mode
        word, status = self._find(0x6040, 0), self._find(0x6041, 0)
        pass_on, state = word.sink, status.source

        def command(data: bytes) -> None:
            if pass_on is not None:
                pass_on(data)
            self._command(int.from_bytes(data[:2], "little"))

        def shown() -> bytes:
            number = int.from_bytes(state() if state is not None else status.value, "little")
            if self._running:
                number = number & ~(ACKNOWLEDGED | REACHED) | self._bits()
            return number.to_bytes(2, "little")

        word.sink, status.source = command, shown
        self._show(0x6062, lambda: self._count(self.demand))
        self._show(0x60F4, lambda: (self.demand - self._at) * self._per_turn)

    def _show(self, index: int, value: Callable[[], float]) -> None:
        try:
            entry: Entry = self._find(index, 0)
        except Refused:  # the drive has no such object
            return
        if entry.code is not None:  # a file may make it a text
            entry.shows(value)

    def _count(self, turns: float) -> float:
        half = WORD_TURNS // 2
        return (round(turns * self._per_turn) + half) % WORD_TURNS - half

    def _number(self, index: int, otherwise: float) -> float:
        try:
            return self._find(index, 0).number() or otherwise
        except Refused:  # the drive has no such object
            return otherwise

    def _bits(self) -> int:
        word = ACKNOWLEDGED if self._acknowledged else 0
        still = self._move is None and abs(self.demand - self._at) < ARRIVED_TURNS
        return word | (REACHED if still else 0)

    def _enabled(self) -> bool:
        return self._power.state is State.OPERATION_ENABLED and self._mode() in POSITION_MODES

    def _turns(self) -> float:
        return self.behind.position(self._per_turn) / self._per_turn

    def _command(self, word: int) -> None:
        rising, self._word = word & ~self._word, word
        if not self._enabled():
            self._running = False
            return
        if not self._running:
            self._running = True
            self._begin(self._turns())
            self._schedule.after(self._T, self._tick)
        if rising & NEW_SET_POINT and self._mode() == 1:
            wanted = self._find(0x607A, 0).number() / self._per_turn + (self.demand if word & RELATIVE else 0.0)
            if self._move is None or word & AT_ONCE:
                self._go(wanted)
            else:  # CiA 402-2: taken after the move that is under way
                self._waiting = wanted
        self._acknowledged = bool(word & NEW_SET_POINT)

    def _go(self, wanted: float) -> None:
        speed = self._number(0x6081, 1.0) / self._per_rps
        up = self._number(0x6083, 1.0) / self._per_rps
        down = self._number(0x6084, up * self._per_rps) / self._per_rps
        self._move, self._waiting = _Trapezoid(self.demand, wanted, speed, up, down), None
        self._began_ns = self._schedule.now_ns

    def _reference(self) -> tuple[float, float, float]:
        if self._mode() == 8:
            wanted = self._find(0x607A, 0).number() / self._per_turn
            return wanted, (wanted - self.demand) / self._T, 0.0
        if self._move is None:
            return self.demand, 0.0, 0.0
        t = 1e-9 * (self._schedule.now_ns - self._began_ns)
        found = self._move.at(t)
        if self._move.over(t):
            self._move = None
            if self._waiting is not None:
                self._go(self._waiting)
        return found

    def _tick(self) -> None:
        if not self._running or not self._enabled():
            self._running = False
            return
        before, self._at = self._at, self._turns()
        self.demand, speed, acceleration = self._reference()
        gains = self.behind.position_gains
        error = TURN * (self.demand - self._at)
        if gains.pid is not None:
            K_P, K_I, K_D = gains.pid
            pole = DERIVATIVE_POLE * K_P / K_D if K_D else 0.0
            keep = 1.0 / (1.0 + pole * self._T)
            self._derivative = keep * (self._derivative + K_D * pole * (error - self._error)) if K_D else 0.0
            self._error = error
            torque, gain, slip = K_P * error + self._derivative, K_I, error
        else:
            seen = TURN * (self._at - before) / self._T
            ahead = speed * self.behind.velocity_ff + acceleration * self.behind.acceleration_ff_s
            slip = gains.K_v * error + TURN * ahead - seen
            slip += self.behind.derivative_share * (error - self._error) / self._T
            self._error = error
            torque, gain = gains.K_p * slip, gains.K_i
        torque += TURN * (gains.inertia_ff * acceleration + gains.friction_ff * speed)
        most = self.behind.set_up.i_max_apk * self.behind.set_up.torque_constant
        asked = torque + self._sum
        if abs(asked) < most:
            self._sum += gain * self._T * slip
        self.behind.push(self.behind.direction * math.copysign(min(abs(asked), most), asked))
        self._schedule.after(self._T, self._tick)
