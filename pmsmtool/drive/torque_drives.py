# SPDX-License-Identifier: MIT
"""Drives by what they have besides the reference drive's objects: parameters only, or torque by CiA 402.

:class:`ParameterDrive` is read, written and compared, and never moved. :class:`TorqueDrive` is pushed by torque while
position and current are polled at up to 1 kHz: all of a drive that knows CiA 402 alone and commutates already.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property

import numpy as np

from pmsmtool.bus.connection import Connection
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.motion_objects import LimitedSpeed, limited_speed, torque_target, undecided
from pmsmtool.drive.port import Recording
from pmsmtool.drive.standard_drive import POLL_PERIOD_S, StandardDrive, TorqueCurrent
from pmsmtool.drive_maps.drive_map import LETTERS, DriveMap
from pmsmtool.drive_maps.wire_units import wire_unit
from pmsmtool.errors import NotAvailable, SdoAbort
from pmsmtool.trace import Trace


class ParameterDrive(CanopenDrive):
    """A drive that holds parameters and is not moved."""

    def _control_period_s(self) -> float:
        return POLL_PERIOD_S


class TorqueDrive(TorqueCurrent, StandardDrive):
    """A drive of which only CiA 402 is known, in torque mode: a q current is asked for as torque.

    A record is polled: position and current one after the other, with the time at which each row was begun.

    Attributes
    ----------
    current_undecided : bool
        Whether no source says if the drive's amperes are peak or rms; they are read as rms.
    top_rad_s : float
        Speed that a push must not go beyond, where the drive is told one.
    """

    def __init__(self, connection: Connection, node_id: int, *, drive_map: DriveMap | None = None) -> None:
        super().__init__(connection, node_id, drive_map=drive_map)
        self.current_undecided = undecided(self.node, self._rated_apk)
        self._polled: tuple[str, ...] = ()
        self._rows: list[list[float]] = []

    top_rad_s = math.inf

    def live(self, name: str) -> float:
        """Return a live value; the DC link (0x6079) and voltages where the drive or its map shows them."""
        if name not in ("U_dc_v", "u_d_v", "u_q_v"):
            return super().live(name)
        try:
            signal = self.node.map.signals.get(name)
            if name == "U_dc_v" and (link_v := self.node.link_v()) is not None:
                return link_v
            if signal is not None and name != "U_dc_v":
                shown = objects.DriveObject(signal.index, signal.sub, LETTERS[signal.wire])
                return wire_unit(signal.unit).scale * self.node.get(shown)
        except SdoAbort as abort:
            raise NotAvailable(f"the drive does not show {name}", where=abort.where) from abort
        raise NotAvailable(f"the drive does not show {name}", where=f"node {self.node.node}")

    def begin_record(self, recording: Recording, wait: Callable[[float], None]) -> None:
        """Poll from now on, whenever time passes."""
        if recording.excitation is not None:
            raise NotAvailable("the drive has no excitation", where=f"node {self.node.node}")
        self._polled, self._rows = tuple(recording.signals), []

    def finish_record(self, recording: Recording) -> Trace:
        """Return what was polled."""
        polled, self._polled = self._polled, ()
        self.check_operating()
        table = np.array(self._rows, dtype=np.float64).reshape(len(self._rows), len(polled) + 1)
        units = {name: objects.signal_unit(name) for name in polled}
        return Trace(
            table[:, 0] - table[0, 0], {name: table[:, k] for k, name in enumerate(polled, 1)}, units, {"polled": True}
        )

    def wait(self, seconds: float) -> None:
        """Let time pass; polls meanwhile where a record was begun."""
        clock = self.node.connection.clock
        end = clock.now() + seconds
        while self._polled:
            began = clock.now()  # a transfer lasts about the same every time: a constant delay of all rows
            self._rows.append([began, *(self.live(name) for name in self._polled)])
            left = min(began + self.period_s, end) - clock.now()
            if left > 0.0:
                self.node.connection.wait(left)
            if clock.now() >= end:
                break
        super().wait(max(0.0, end - clock.now()))


class SpeedPushDrive(TorqueDrive):
    """A drive without a torque mode, pushed in its velocity mode: its current limit is the push.

    The speed that is asked for lies beyond the push, so that the speed loop is saturated and the drive gives the
    current of its limit; at that speed it would stay. Without a push the limit is zero, also when it is enabled: the
    speed loop is not proven.
    """

    @cached_property
    def push(self) -> LimitedSpeed:
        """What takes speed and limit."""
        return limited_speed(self.node)

    def enable(self) -> None:
        """Bring the drive to operation enabled at no speed and no current."""
        self.command_current(0.0, 0.0)
        self._energise(self.push.mode)

    def command_current(self, i_d_a: float, i_q_a: float, *, fixed_angle_rad: float | None = None) -> None:
        """Let the drive push with a q current towards the top speed."""
        if i_d_a or fixed_angle_rad is not None:
            raise NotAvailable("the drive has no current set-point, only a limit", where=f"node {self.node.node}")
        limit, speed = self.push.limit, self.push.speed
        self.node.put(limit.item, 0)
        self.node.put(speed.item, math.copysign(math.floor(self.top_rad_s / speed.per_count), i_q_a) if i_q_a else 0)
        if i_q_a:
            self.node.put(limit.item, math.floor(abs(i_q_a) / limit.per_count))


def pushing_drive(connection: Connection, node_id: int, drive_map: DriveMap) -> TorqueDrive:
    """Return the drive that is pushed by torque where it has such a mode, else by its velocity mode."""
    drive = TorqueDrive(connection, node_id, drive_map=drive_map)
    try:
        torque_target(drive.node, drive.rated_apk)
        return drive
    except NotAvailable:
        drive.close()
    return SpeedPushDrive(connection, node_id, drive_map=drive_map)
