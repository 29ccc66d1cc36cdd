# SPDX-License-Identifier: MIT
"""A drive of another maker whose map names enough of its recorder: torque pushes recorded at its own loop's rate.

Position, speed and current are polled as on any drive of the standard level; what is recorded comes from the recorder
that the map describes. A recorder that holds fewer rows than asked for takes them further apart.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.bus.connection import Connection
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import signal_unit
from pmsmtool.drive.port import Recording
from pmsmtool.drive.recorders.choice import recorder_of
from pmsmtool.drive.recorders.commanded import CommandedRecorder
from pmsmtool.drive.standard_drive import POLL_PERIOD_S, RecorderDrive
from pmsmtool.drive.torque_drives import TorqueDrive
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.errors import BusError, NotAvailable, SdoAbort
from pmsmtool.estimators.recorded_push import DELAY_DOUBT
from pmsmtool.trace import Trace

RECORDED = {
    "i_d_a": "i_d_a",
    "i_q_a": "i_q_a",
    "u_d_v": "u_d_v",
    "u_q_v": "u_q_v",
    "omega_e_rad_s": "omega_M_rad_s",
    "theta_m_rad": "position_rad",
}
"""What a recorded push needs, and its name in a map."""
FLAGS = "flags"
"""Marks of limited samples: no maker's recorder has them, so they are judged by the DC link."""
VOLTAGE_LIMITED = 1 << 0
LINEAR_SHARE = 0.95
"""Phase voltage, of the DC link over sqrt 3, from which a sample counts as limited."""
DELAY_DOUBT_PERIODS = 1.5
"""No map says to which control period a maker's recorded voltage belongs: it may be the one before or after."""
NOT_SHOWN = ("T_winding_c", "T_magnet_c")
POLE_PAIRS = "motor.pole_pairs"


def records_pushes(node: DriveNode) -> bool:
    """Whether the recorder of another maker's drive answers and takes all that recorded pushes need; only reads."""
    if node.map.staging or POLE_PAIRS not in node.map.cells:
        return False
    try:
        recorder = recorder_of(node, POLL_PERIOD_S)
    except NotAvailable:
        return False
    return isinstance(recorder, CommandedRecorder) and set(RECORDED.values()) <= set(recorder.signals)


class MappedRecorderDrive(RecorderDrive, TorqueDrive):
    """A drive of which :func:`records_pushes` is true.

    Raises
    ------
    NotAvailable
        It has no recorder that this program reads.
    """

    def __init__(self, connection: Connection, node_id: int, *, drive_map: DriveMap | None = None) -> None:
        super().__init__(connection, node_id, drive_map=drive_map)
        self.commands_bounded_current = False  # a speed step is the drive's own
        traces = recorder_of(self.node, POLL_PERIOD_S)
        if not isinstance(traces, CommandedRecorder):
            raise NotAvailable("pmsmtool reads no recorder of this drive", where=f"node {self.node.node}")
        self.traces = traces
        self.period_s = traces.period_s
        self._apart = 1
        self._recording = False
        self._own_pole_pairs = self.parameters.read_value(POLE_PAIRS)

    def read(self, name: str) -> float:
        """Return one parameter; the pole pairs are those of its map."""
        return self._own_pole_pairs if name == POLE_PAIRS else super().read(name)

    def live(self, name: str) -> float:
        """Return a live value; NaN for a temperature, which it does not show."""
        if name in NOT_SHOWN:
            return math.nan
        value = super().live(name)
        return value * self._own_pole_pairs if name == "omega_e_rad_s" else value

    def quick_stop(self) -> None:
        """Stop the machine and confirm it; then the recorder, whose settings cannot be brought back while it runs."""
        super().quick_stop()
        self._halt()

    def disable(self) -> None:
        """Remove the voltage and confirm it; then stop the recorder."""
        super().disable()
        self._halt()

    def _halt(self) -> None:
        if self._recording:
            with contextlib.suppress(SdoAbort, BusError):  # the bus may be what has failed
                self.traces.halt()
            self._recording = False

    def begin_record(self, recording: Recording, wait: Callable[[float], None]) -> None:
        """Start the recorder; where it holds fewer rows, they are taken further apart."""
        if recording.excitation is not None:
            raise NotAvailable("only torque pulses are recorded on this drive", where=f"node {self.node.node}")
        names = self._names(recording.signals)
        self._apart = max(1, math.ceil(recording.samples / max(1, self.traces.room(names))))
        rows = max(1, recording.samples // self._apart)
        self._recording = True
        self.traces.arm(names, rows, self._apart * recording.decimation, recording.pretrigger, at_excitation=False)

    def finish_record(self, recording: Recording) -> Trace:
        """Return the record by the names asked for."""
        self.coast()
        trace = self.traces.fetch(self._names(recording.signals), self._apart * recording.decimation)
        self._recording = False
        self.check_operating()
        columns = {}
        for name in recording.signals:
            if name == FLAGS:
                columns[name] = self._limited(trace)
            else:
                scale = self._own_pole_pairs if name == "omega_e_rad_s" else 1.0
                columns[name] = scale * trace[RECORDED[name]]
        units = {name: signal_unit(name) for name in recording.signals}
        return replace(trace, signals=columns, units=units, meta={**trace.meta, DELAY_DOUBT: DELAY_DOUBT_PERIODS})

    def _limited(self, trace: Trace) -> NDArray[np.float64]:
        """Return the flag of samples near the largest voltage; none where neither drive nor map shows the DC link."""
        if not {"u_d_v", "u_q_v"} <= set(trace.signals):
            return np.zeros(len(trace))
        try:
            largest_v = self.live("U_dc_v") / math.sqrt(3.0)
        except NotAvailable:
            return np.zeros(len(trace))
        near = np.hypot(trace["u_d_v"], trace["u_q_v"]) > LINEAR_SHARE * largest_v
        return np.where(near, float(VOLTAGE_LIMITED), 0.0)

    def _names(self, signals: Sequence[str]) -> list[str]:
        unknown = [name for name in signals if name != FLAGS and name not in RECORDED]
        if unknown:
            raise NotAvailable(f"the recorder has no signal {', '.join(unknown)}", where=f"node {self.node.node}")
        return [RECORDED[name] for name in signals if name != FLAGS]
