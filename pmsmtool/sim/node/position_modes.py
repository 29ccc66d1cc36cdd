# SPDX-License-Identifier: MIT
"""The position modes of the node, of CiA 402: profile (1), homing (6), interpolated (7), cyclic synchronous (8).

Unit of every position is the encoder's count, from 0x608F; velocities are counts over seconds. When a mode begins, the
shaft is held where it is: only a target that is written afterwards moves it.

Homing (mode 6) of the node: by a mechanical stop, a limit switch, the encoder's index, or where the shaft is.

Methods of CiA 402-2: 17 and 18 negative and positive limit switch, 33 and 34 the next index in negative and positive
direction, 37 the present position. Of the drive's own: -1 and -2 a mechanical stop in negative and positive direction,
told by the torque. The home position becomes zero less the home offset 0x607C (the zero is the offset beyond it).
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.clock import Timer
from pmsmtool.cia402 import Control, Mode, Status
from pmsmtool.sim.node.dictionary import Dictionary, Refused
from pmsmtool.sim.node.drive_core import (
    Command,
    ControlMode,
    DriveCore,
    PositionCommand,
    PositionFlag,
    PositionState,
    wrapped,
)
from pmsmtool.sim.node.schedule import Schedule

MODES = (Mode.PROFILE_POSITION, Mode.HOMING, Mode.INTERPOLATED_POSITION, Mode.CYCLIC_POSITION)
FOLLOWING_ERROR = 0x8611
"""Error code of a position that left the window of its reference for its time."""
_OFF = 0xFFFFFFFF
_CUT = PositionFlag.SOFTWARE_LIMIT | PositionFlag.LIMIT_SWITCH | PositionFlag.SATURATED


class PositionModes:
    """Targets, and what the statusword says of them.

    Parameters
    ----------
    core : DriveCore
        What is moved.
    look : callable
        Brings the core to the present instant.
    mode : callable
        Returns the mode of operation.
    apply : callable
        Gives the references to the core.
    torque : callable
        Returns the torque in permille of rated.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        core: DriveCore,
        schedule: Schedule,
        *,
        look: Callable[[], None],
        mode: Callable[[], Mode],
        apply: Callable[[], None],
        torque: Callable[[], float],
    ) -> None:
        self._dictionary = dictionary
        self._core = core
        self._look = look
        self._mode = mode
        self._apply = apply
        self._target = 0
        self._set_point = 0
        self._waiting: int | None = None
        self._taken = False
        self._offset = 0
        self._homing_speed = 0.0
        self._homing = Homing(
            dictionary,
            schedule,
            state=self.state,
            torque=torque,
            go=self._search,
            release=self._release,
            hold=self._hold,
        )
        dictionary["cia402.homing_method"].sink = self._write_method
        self._hook("target_position", Mode.CYCLIC_POSITION)
        self._hook("interpolated_position", Mode.INTERPOLATED_POSITION)
        for key, value in (
            ("position", lambda state: state.actual),
            ("position_demand", lambda state: state.demand),
            ("following_error", lambda state: round(state.error)),
            ("inputs", lambda state: state.limits),
        ):
            self._show(key, value)

    def _hook(self, key: str, mode: Mode) -> None:
        entry = self._dictionary[f"cia402.{key}"]

        def sink(data: bytes) -> None:
            entry.value = data
            if self._mode() is mode:
                self._go(entry.integer())

        entry.sink = sink

    def _show(self, key: str, value: Callable[[PositionState], int]) -> None:
        entry = self._dictionary[f"cia402.{key}"]
        entry.source = lambda: entry.encode(value(self.state()))

    def _number(self, key: str) -> float:
        return self._dictionary[f"cia402.{key}"].number()

    def state(self) -> PositionState:
        """Return the state of the position controller now."""
        self._look()
        return self._core.position()

    # ---- homing --------------------------------------------------------------------------------

    def _write_method(self, data: bytes) -> None:
        if int.from_bytes(data, "little", signed=True) not in METHODS:
            raise Refused(AbortCode.VALUE)
        self._dictionary["cia402.homing_method"].value = data

    @property
    def released(self) -> bool:
        """Whether the position has no controller for the moment in which it gets another zero."""
        return self._homing.released

    def _search(self, target: int, speed: float) -> None:
        self._homing_speed = speed
        self._go(wrapped(target))

    def _release(self, offset: int) -> None:
        self._offset = wrapped(offset)
        self._core.command(Command(ControlMode.CURRENT, position=self.command(halt=False)))

    def _hold(self) -> None:
        self._homing_speed = 0.0
        self._target = self.state().actual
        self._apply()

    # ---- targets -------------------------------------------------------------------------------

    def begin(self) -> None:
        """Forget targets: the shaft is held."""
        self._waiting, self._taken = None, False
        self._homing.forget()
        self._target = self.state().actual

    def controlword(self, word: int, rising: int) -> None:
        """Take a set-point of mode 1 by its handshake: at once, or after the move that is under way."""
        if self._mode() is Mode.HOMING:
            if rising & Control.NEW_SET_POINT:
                self._homing.start()
            elif not word & Control.NEW_SET_POINT or word & Control.HALT:
                self._homing.interrupt()
        if self._mode() is not Mode.PROFILE_POSITION:
            return
        if rising & Control.NEW_SET_POINT:
            target = int(self._number("target_position"))
            base = self._target if self._waiting is None else self._waiting
            target = wrapped(base + target) if word & Control.RELATIVE else target
            self._taken = True
            if word & Control.AT_ONCE or not self._moves():
                self._waiting = None
                self._go(target)
            elif self._waiting is None:
                self._waiting = target
        elif not word & Control.NEW_SET_POINT and self._waiting is None:
            self._taken = False

    def attend(self, word: int) -> None:
        """Start the set-point that waited for the end of a move."""
        if self._waiting is not None and not self._moves():
            target, self._waiting = self._waiting, None
            self._taken = bool(word & Control.NEW_SET_POINT)
            self._go(target)

    def _moves(self) -> bool:
        flags = self.state().flags
        return bool(flags & PositionFlag.MOVING) and not flags & PositionFlag.LIMIT_SWITCH  # which ended it

    def _go(self, target: int) -> None:
        self._target = target
        self._set_point += 1
        self._apply()

    def command(self, *, halt: bool) -> PositionCommand:
        """Return what the controller shall do."""
        counts = self._number("encoder_counts")
        fastest = min(self._number("max_profile_velocity"), self._number("max_speed") / 60.0 * counts)
        window = self._number("following_window")
        homing = self._mode() is Mode.HOMING
        ramps = ("homing_acceleration",) * 2 if homing else ("profile_acceleration", "profile_deceleration")
        return PositionCommand(
            target=self._target,
            set_point=self._set_point,
            offset=self._offset,
            profile=homing or self._mode() is Mode.PROFILE_POSITION,
            interval_s=self._number("interpolation_period") * 10.0 ** self._number("interpolation_exponent"),
            velocity=min(self._homing_speed if homing else self._number("profile_velocity"), fastest),
            acceleration=self._number(ramps[0]),
            deceleration=self._number(ramps[1]),
            stop_deceleration=self._number("quick_stop_deceleration") / 60.0 * counts,
            jerk=self._number("profile_jerk"),
            halt=halt,
            minimum=0 if homing else int(self._number("minimum_position")),
            maximum=0 if homing else int(self._number("maximum_position")),
            window=0.0 if homing or window == _OFF else window,
            window_time_s=1e-3 * self._number("following_time"),
        )

    # ---- what is told --------------------------------------------------------------------------

    def status(self) -> Status:
        """Return the bits of the statusword that belong to the mode."""
        state, bits = self.state(), Status(0)
        if state.flags & PositionFlag.FOLLOWING_ERROR:
            bits |= Status.FOLLOWING_ERROR
        if state.flags & _CUT:
            bits |= Status.INTERNAL_LIMIT
        if self._mode() is Mode.HOMING:
            return bits | self._homing.status()
        if self._mode() is not Mode.PROFILE_POSITION:
            return bits | Status.SET_POINT_TAKEN  # in these modes bit 12: the drive follows the targets
        if self._taken:
            bits |= Status.SET_POINT_TAKEN
        window = self._number("position_window")
        arrived = not state.flags & PositionFlag.MOVING and self._waiting is None
        if arrived and (window == _OFF or abs(state.error) <= window):
            bits |= Status.TARGET_REACHED
        return bits

    def failed(self) -> bool:
        """Whether the following error left its window for its time."""
        return self._mode() in MODES and bool(self._core.position().flags & PositionFlag.FOLLOWING_ERROR)


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
