# SPDX-License-Identifier: MIT
"""The position of a drive that is no reference drive: a record does not change it.

The reference drive takes whole turns off its angle when a record begins, so that binary32 resolves it. A face over it
puts them back.
"""

from __future__ import annotations

import math

from pmsmtool.sim.node.dictionary import Dictionary
from pmsmtool.sim.node.drive_core import RecorderState
from pmsmtool.sim.node.power_drive import Plant
from pmsmtool.sim.node.schedule import Schedule
from pmsmtool.sim.signals import Signal

POSITION = "cia402.position"


class WholeTurns:
    """Turns taken off the angle so far, put back where the position is shown.

    Parameters
    ----------
    dictionary : Dictionary
        Its position is shown with them.
    plant, schedule : Plant, Schedule
        The drive behind, and its clock.
    """

    def __init__(self, dictionary: Dictionary, plant: Plant, schedule: Schedule) -> None:
        self._plant = plant
        self._schedule = schedule
        self._taken = 0
        self._before_rad: float | None = None
        entry = dictionary[POSITION]
        shown = entry.source
        assert shown is not None

        def position() -> bytes:
            self._settle()
            counts = int.from_bytes(shown(), "little", signed=True) + self._taken * plant.core.encoder_counts
            return entry.encode((counts + (1 << 31)) % (1 << 32) - (1 << 31))

        entry.source = position

    def about_to_record(self) -> None:
        """Note the angle: the record begins with the next control period."""
        self._settle()
        self._before_rad = self._angle_rad()
        self._look_again()

    def _look_again(self) -> None:
        self._schedule.after(2e-9 * self._plant.core.period_ns, self._settle)

    def _settle(self) -> None:
        if self._before_rad is None:
            return
        angle = self._angle_rad()
        if self._plant.core.recorder().state is RecorderState.ARMED:
            self._look_again()
            return
        self._taken += round((self._before_rad - angle) / (2.0 * math.pi))
        self._before_rad = None

    def _angle_rad(self) -> float:
        self._plant.look()
        return self._plant.core.signal(Signal.THETA_M)
