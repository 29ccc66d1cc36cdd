"""Drives by what they have besides the reference drive's objects: parameters only, or torque by CiA 402.

:class:`ParameterDrive` is read, written and compared, and never moved. :class:`TorqueDrive` is pushed by torque while
position and current are polled at up to 1 kHz: all of a drive that knows CiA 402 alone and commutates already.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pmsmtool.bus.connection import Connection
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.motion_objects import undecided
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.drive.port import Recording
from pmsmtool.drive.recorder import Recorder
from pmsmtool.drive.standard_drive import POLL_PERIOD_S, StandardDrive, TorqueCurrent
from pmsmtool.errors import NotAvailable, SdoAbort
from pmsmtool.firmware.drive_map import LETTERS, DriveMap
from pmsmtool.firmware.wire_units import wire_unit
from pmsmtool.trace import Trace

DC_LINK_MV = objects.DriveObject(0x6079, 0, "I")


class ParameterDrive(CanopenDrive):
    """A drive that holds parameters and is not moved."""

    def __init__(self, connection: Connection, node_id: int, *, drive_map: DriveMap | None = None) -> None:
        self.node = DriveNode(connection, node_id, drive_map=drive_map)
        self.parameters = DriveParameters(self.node)
        self.may_be_energised = False
        self.identity = self.node.identity()
        self.period_s = POLL_PERIOD_S
        self.recorder = Recorder(self.node, POLL_PERIOD_S)


class TorqueDrive(TorqueCurrent, StandardDrive):
    """A drive of which only CiA 402 is known, in torque mode: a q current is asked for as torque.

    A record is polled: position and current one after the other, with the time at which each row was begun.

    Attributes
    ----------
    current_undecided : bool
        Whether no source says if the drive's amperes are peak or rms; they are read as rms.
    """

    def __init__(self, connection: Connection, node_id: int, *, drive_map: DriveMap | None = None) -> None:
        super().__init__(connection, node_id, drive_map=drive_map)
        self.current_undecided = undecided(self.node, self._rated_apk)
        self._polled: tuple[str, ...] = ()
        self._rows: list[list[float]] = []

    def live(self, name: str) -> float:
        """Return a live value; the DC link (0x6079) and voltages where the drive or its map shows them."""
        if name not in ("U_dc_v", "u_d_v", "u_q_v"):
            return super().live(name)
        try:
            signal = self.node.map.signals.get(name)
            if signal is None and name == "U_dc_v":
                return 1e-3 * self.node.get(DC_LINK_MV)
            if signal is not None:
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
