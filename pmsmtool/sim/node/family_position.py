# SPDX-License-Identifier: MIT
"""Position modes of another family's face: its profile in its own units, and its one controller of the position.

The drive behind has a cascade. A family with one controller of the position (K_P, K_I, K_D of its error) runs the
cascade of the same gains while a position mode is chosen: K_D = K_p, K_P = K_p K_v + K_i, K_I = K_i K_v, with the speed
fed forward. Its controller of the speed acts in the other modes. The pole of its derivative and its feed-forward of
friction are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from pmsmtool.cia402 import Mode
from pmsmtool.sim.node.dictionary import Dictionary, Entry

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
