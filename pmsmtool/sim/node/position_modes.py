# SPDX-License-Identifier: MIT
"""The position modes of the node, of CiA 402: profile (1), homing (6), interpolated (7), cyclic synchronous (8).

Unit of every position is the encoder's count, from 0x608F; velocities are counts over seconds. When a mode begins, the
shaft is held where it is: only a target that is written afterwards moves it.

Homing methods of CiA 402-2: 17 and 18 negative and positive limit switch, 33 and 34 the next index in negative and
positive direction, 37 the present position. Of the drive's own: -1 and -2 a mechanical stop in negative and positive
direction, told by the torque. The home position becomes zero less the home offset 0x607C (the zero is the offset beyond
it). The application homes; the node says when.

Another family's face has its profile in its own units. One with a single controller of the position (K_P, K_I, K_D of
its error) runs the cascade of the same gains while a position mode is chosen: K_D = K_p, K_P = K_p K_v + K_i, K_I = K_i
K_v, with the speed fed forward. Its controller of the speed acts in the other modes. The pole of its derivative and its
feed-forward of friction are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.cia402 import Control, Mode, Status
from pmsmtool.sim.node.dictionary import Dictionary, Entry, Refused
from pmsmtool.sim.node.drive_core import (
    DriveCore,
    HomingCommand,
    HomingPhase,
    PositionCommand,
    PositionFlag,
    PositionState,
    wrapped,
)

POSITION_MODES = (Mode.PROFILE_POSITION, Mode.CYCLIC_POSITION)
PID = ("position.pid_p_nm_per_rad", "position.pid_i_nm_per_rads", "position.pid_d_nms_per_rad")
SPEED = ("speed.K_p_nms_per_rad", "speed.K_i_nm_per_rad")
PROFILE = {
    "reference.profile_speed_rpm": "cia402.profile_velocity",
    "reference.profile_acceleration_rpm_per_s": "cia402.profile_acceleration",
    "reference.profile_deceleration_rpm_per_s": "cia402.profile_deceleration",
    "reference.profile_jerk_rpm_per_s2": "cia402.profile_jerk",
}
"""Limits of a move by catalogue name, and the object of the drive behind, in increments."""
INCREMENTS = "reference.encoder_increments"
K_V_PER_S, CROSSOVER_RAD_S = 15.0, 60.0
"""Position gain and crossover of the speed loop as a maker's tool leaves them: calm, without feed-forward."""


def calm_gains(J_kgm2: float) -> dict[str, float]:
    """Return the gains of both loops as a maker's tool leaves them."""
    K_p = CROSSOVER_RAD_S * J_kgm2
    return {
        SPEED[0]: K_p, SPEED[1]: K_V_PER_S * K_p, "position.K_p_per_s": K_V_PER_S, "position.velocity_ff": 0.0,
    }  # fmt: skip


def pid_of(K_p: float, K_i: float, K_v: float) -> dict[str, float]:
    """Return the one controller of the position that a cascade is."""
    return dict(zip(PID, (K_p * K_v + K_i, K_i * K_v, K_p), strict=True))


def cascade_of(pid: Mapping[str, float]) -> tuple[float, float, float]:
    """Return K_p, K_i and K_v of a controller of the position; of both cascades the one with the smaller K_v."""
    K_P, K_I, K_D = (pid[name] for name in PID)
    if not K_D:
        return 0.0, 0.0, 0.0
    K_v = (K_P - math.sqrt(max(K_P * K_P - 4.0 * K_D * K_I, 0.0))) / (2.0 * K_D)
    return K_D, K_P - K_D * K_v, K_v


class PositionSide:
    """Which gains act behind a family with one controller of the position.

    Parameters
    ----------
    dictionary : Dictionary
        Of the drive behind.
    held : callable
        Returns what the family's objects hold (SI), by catalogue name.
    """

    def __init__(self, dictionary: Dictionary, held: Callable[[str], float]) -> None:
        self._dictionary, self._held = dictionary, held

    def apply(self) -> None:
        """Let the gains of the present mode act."""
        held = {name: self._held(name) for name in (*PID, *SPEED)}  # all of them: the first look keeps what they hold
        if self._dictionary["cia402.mode"].integer() in POSITION_MODES:
            K_p, K_i, K_v = cascade_of(held)
            acting = {SPEED[0]: K_p, SPEED[1]: K_i, "position.K_p_per_s": K_v, "position.velocity_ff": 1.0}
        else:
            acting = {name: held[name] for name in SPEED}
        for name, value in acting.items():
            inner: Entry = self._dictionary[name]
            self._dictionary.write(inner, inner.encode(value))


MODES = (Mode.PROFILE_POSITION, Mode.HOMING, Mode.INTERPOLATED_POSITION, Mode.CYCLIC_POSITION)
FOLLOWING_ERROR = 0x8611
"""Error code of a position that left the window of its reference for its time."""
METHODS = frozenset((-2, -1, 17, 18, 33, 34, 37))
"""Of homing (``enum pmsm_homing_method``)."""
_HOMES = (HomingPhase.SEARCH, HomingPhase.AWAY, HomingPhase.REST)
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
    rated_torque : callable
        Returns the rated torque (N m).
    """

    def __init__(
        self,
        dictionary: Dictionary,
        core: DriveCore,
        *,
        look: Callable[[], None],
        mode: Callable[[], Mode],
        apply: Callable[[], None],
        rated_torque: Callable[[], float],
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
        self._home = False
        self._rated_torque = rated_torque
        dictionary["cia402.homing_method"].sink = self._write_method
        self._hook("target_position", Mode.CYCLIC_POSITION)
        self._hook("interpolated_position", Mode.INTERPOLATED_POSITION)
        dictionary["cia402.position"].shows(lambda: self.state().actual)
        dictionary["cia402.position_demand"].shows(lambda: self.state().demand)
        dictionary["cia402.following_error"].shows(lambda: self.state().error)
        dictionary["cia402.inputs"].shows(lambda: self.state().limits)

    def _hook(self, key: str, mode: Mode) -> None:
        entry = self._dictionary[f"cia402.{key}"]

        def sink(data: bytes) -> None:
            entry.value = data
            if self._mode() is mode:
                self._go(entry.integer())

        entry.sink = sink

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

    # ---- targets -------------------------------------------------------------------------------

    def begin(self) -> None:
        """Forget targets: the shaft is held."""
        self._waiting, self._taken = None, False
        self._target = self.state().actual

    def controlword(self, word: int, rising: int) -> None:
        """Take a set-point of mode 1 by its handshake: at once, or after the move that is under way."""
        self._home = bool(word & Control.NEW_SET_POINT) and not word & Control.HALT
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
            profile=self._mode() is Mode.PROFILE_POSITION,
            interval_s=self._number("interpolation_period") * 10.0 ** self._number("interpolation_exponent"),
            velocity=min(self._number("homing_speed_switch" if homing else "profile_velocity"), fastest),
            acceleration=self._number(ramps[0]),
            deceleration=self._number(ramps[1]),
            stop_deceleration=self._number("quick_stop_deceleration") / 60.0 * counts,
            jerk=self._number("profile_jerk"),
            halt=halt,
            minimum=0 if homing else int(self._number("minimum_position")),
            maximum=0 if homing else int(self._number("maximum_position")),
            window=0.0 if homing or window == _OFF else window,
            window_time_s=1e-3 * self._number("following_time"),
            homing=HomingCommand(
                active=homing,
                start=self._home,
                method=self._dictionary["cia402.homing_method"].integer(),
                slow=min(self._number("homing_speed_zero"), fastest),
                torque_nm=1e-3 * self._number("homing_torque") * self._rated_torque(),
                home_offset=self._dictionary["cia402.home_offset"].integer(),
            ),
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
            if state.homing is HomingPhase.FAILED:
                bits |= Status.HOMING_ERROR
            if state.homing is HomingPhase.DONE:
                bits |= Status.HOMING_ATTAINED
            return bits if state.homing in _HOMES else bits | Status.TARGET_REACHED
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
