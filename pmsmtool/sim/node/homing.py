# SPDX-License-Identifier: MIT
"""Homing (mode 6) of the node: by a mechanical stop, a limit switch, the encoder's index, or where the shaft is.

Methods of CiA 402-2: 17 and 18 negative and positive limit switch, 33 and 34 the next index in negative and positive
direction, 37 the present position. Of the drive's own: -1 and -2 a mechanical stop in negative and positive direction,
told by the torque. The home position becomes zero less the home offset 0x607C (the zero is the offset beyond it).
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

from pmsmtool.bus.clock import Timer
from pmsmtool.cia402 import Status
from pmsmtool.sim.node.dictionary import Dictionary
from pmsmtool.sim.node.drive_core import PositionState
from pmsmtool.sim.node.schedule import Schedule

HERE, SWITCHES, INDEXES, STOPS = 37, {17: -1, 18: 1}, {33: -1, 34: 1}, {-1: -1, -2: 1}
"""Methods; the direction of those that move."""
METHODS = frozenset((HERE, *SWITCHES, *INDEXES, *STOPS))
FAR = 1 << 30
"""Way of a search (counts): half of what a position can tell."""
PUSHED_MS = 20
"""A stop is one when the torque has stayed for this long; an acceleration is over before."""
_POLL_S = 0.001


class Phase(Enum):
    """Where a homing is."""

    IDLE = 0
    SEARCH = 1
    AWAY = 2
    RELEASED = 3
    DONE = 4
    INTERRUPTED = 5


class Homing:
    """One homing at a time.

    Parameters
    ----------
    state, torque : callables
        Return the position controller's state, and the torque in permille of rated.
    go : callable
        Begins a move to a target (counts) at a speed (counts/s).
    release : callable
        Leaves the shaft without torque, with a new offset of the position; ``hold`` holds it again where it is.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        schedule: Schedule,
        *,
        state: Callable[[], PositionState],
        torque: Callable[[], float],
        go: Callable[[int, float], None],
        release: Callable[[int], None],
        hold: Callable[[], None],
    ) -> None:
        self._dictionary = dictionary
        self._schedule = schedule
        self._state = state
        self._torque = torque
        self._go = go
        self._release = release
        self._hold = hold
        self._timer: Timer | None = None
        self._phase = Phase.IDLE
        self._method = HERE
        self._raw = 0
        self._pushed_ms = 0

    def _number(self, key: str) -> float:
        return self._dictionary[f"cia402.{key}"].number()

    def start(self) -> None:
        """Begin by the method of 0x6098."""
        self._cancel()
        self._method = self._dictionary["cia402.homing_method"].integer()
        self._pushed_ms, self._raw = 0, self._state().raw
        if self._method == HERE:
            self._found(self._raw)
            return
        self._phase = Phase.SEARCH
        slow = self._method in INDEXES
        self._search(self._direction(), "homing_speed_zero" if slow else "homing_speed_switch")
        self._again()

    def interrupt(self) -> None:
        """End a search that is under way; the shaft comes to rest."""
        if self._phase in (Phase.SEARCH, Phase.AWAY):
            self._cancel()
            self._phase = Phase.INTERRUPTED
            self._hold()

    def forget(self) -> None:
        """Begin anew: nothing is under way, nothing is told."""
        self._cancel()
        self._phase = Phase.IDLE

    def status(self) -> Status:
        """Return the bits of the statusword: reached and attained, or neither while it moves."""
        if self._phase is Phase.DONE:
            return Status.TARGET_REACHED | Status.HOMING_ATTAINED
        return Status(0) if self._timer is not None else Status.TARGET_REACHED

    @property
    def released(self) -> bool:
        """Whether the shaft is without torque for the moment in which its position gets another zero."""
        return self._phase is Phase.RELEASED

    def _direction(self) -> int:
        return {**SWITCHES, **INDEXES, **STOPS}[self._method]

    def _search(self, direction: int, speed: str) -> None:
        self._go(self._state().actual + direction * FAR, self._number(speed))

    def _again(self) -> None:
        self._timer = self._schedule.after(_POLL_S, self._poll)

    def _cancel(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _poll(self) -> None:
        self._timer = None
        if self._phase is Phase.RELEASED:
            self._phase = Phase.DONE
            self._hold()
            return
        state, direction = self._state(), self._direction()
        at = self._home(state, direction)
        self._raw = state.raw
        if at is None:
            self._again()
        else:
            self._found(at)

    def _home(self, state: PositionState, direction: int) -> int | None:
        """Return the raw position (counts) of the home position once it is found."""
        if self._method in INDEXES:
            counts = int(self._number("encoder_counts"))
            turn, before = state.raw // counts, self._raw // counts
            return None if turn == before else counts * max(turn, before)
        if self._method in STOPS:
            pushes = abs(self._torque()) >= self._number("homing_torque")
            self._pushed_ms = self._pushed_ms + 1 if pushes else 0
            return state.raw if self._pushed_ms >= PUSHED_MS else None
        active = state.limits & (2 if direction > 0 else 1)
        if self._phase is Phase.SEARCH and active:
            self._phase = Phase.AWAY
            self._search(-direction, "homing_speed_zero")
        return state.raw if self._phase is Phase.AWAY and not active else None

    def _found(self, raw: int) -> None:
        self._release(-raw - int(self._number("home_offset")))
        self._phase = Phase.RELEASED
        self._again()
