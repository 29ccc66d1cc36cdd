# SPDX-License-Identifier: MIT
"""Drives by their recorder: means from records of the reference drive's, and torque pushes in that of another maker.

A drive of another maker whose map names enough of its recorder is polled as any drive of the standard level, position,
speed and current; pushes come from the recorder that the map describes. A recorder that holds fewer rows than asked for
takes them further apart.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pmsmtool.bus.connection import Connection
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import signal_unit
from pmsmtool.drive.port import Halves, Recording
from pmsmtool.drive.recorders.choice import recorder_of
from pmsmtool.drive.recorders.commanded import CommandedRecorder
from pmsmtool.drive.recorders.reference import Recorder
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


LOOK, AT_REST, TURNING = 32, 256, 128
"""Rows of a mean that only looks, of half a window with the shaft at rest, and of both halves while it turns: a shaft
that coasts slows down while a record is uploaded, and 6 signals of 128 rows are 57 ms at 1 Mbit/s."""
REST_RAD_S = 20.0
"""Electrical speed below which a shaft counts as being at rest."""
ANGLE = "theta_m_rad"
SLOW = ("T_winding_c", "T_magnet_c")
"""Signals that do not change in a window: read once, which leaves the record shorter."""
HARMONICS = (6, 12, 18, 24)
"""What the inverter's error repeats per electrical turn."""
BEATS = 2.0
"""Least number of beats of such a harmonic with the rows in half a window: one that beats slower stays in the mean."""


def spacing(periods: int, rows: int, turns_per_period: float) -> int:
    """Return how many control periods apart rows are taken, so that no harmonic of a turning machine aliases to DC.

    Parameters
    ----------
    periods, rows : int
        Length of the window, and about how many rows are wanted.
    turns_per_period : float
        Electrical turns in one control period.
    """
    least = math.ceil(periods / rows)
    for candidate in range(least, 2 * least):
        cycles = (harmonic * turns_per_period * candidate for harmonic in HARMONICS)
        if all(abs(cycle - round(cycle)) * (periods // candidate) / 2.0 >= BEATS for cycle in cycles):
            return candidate
    return least


def _fast(signals: Sequence[str]) -> list[str]:
    return [name for name in signals if name not in SLOW]


class RecordedMeans(Recorder):
    """Means over a window from a record of it, of so many rows as there is time to upload.

    At rest the rows are one right after the other, from the beginning of the window: what the noise of one current
    does to the voltage the next ones take back, so that thinned out they would carry the noise times the controller's
    gain (400 rows four periods apart scattered by 5 mV in the levels of interior-2k2, and R was refused). While the
    shaft turns the rows span the whole turns.
    """

    _decimation: int
    _angle_rad = 0.0
    _looks = True
    _trace: Trace | None = None
    _slow: Mapping[str, float] = MappingProxyType({})
    _armed: tuple[object, ...] | None = None

    def arm(
        self, signals: Sequence[str], samples: int, decimation: int, pretrigger: int, *, at_excitation: bool,
        at_move: bool = False,
    ) -> None:  # fmt: skip
        """Set the recorder up and arm it; only arm it where it is set up like this: hundreds of means are alike."""
        wanted = (tuple(signals), samples, decimation, pretrigger, at_excitation, at_move)
        if wanted == self._armed:
            self._node.command(objects.TRACE_COMMAND, 1)
            return
        self._armed = None
        super().arm(signals, samples, decimation, pretrigger, at_excitation=at_excitation, at_move=at_move)
        self._armed = wanted

    def forget(self) -> None:
        """What was written to the drive is no longer known (it was reset or restored)."""
        super().forget()
        self._armed = None

    def start_average(self, signals: Sequence[str], periods: int) -> None:
        """Start recording the next ``periods`` control periods.

        Raises NotAvailable: the drive has no recorder, or not these signals.
        """
        omega_e = self._omega_e_rad_s()
        if omega_e > REST_RAD_S:
            turns = omega_e * self._period_s / (2.0 * math.pi)
            self._decimation = spacing(periods, LOOK if self._looks else TURNING, turns)
            rows = periods // self._decimation
        else:
            self._decimation, rows = 1, min(periods, LOOK if self._looks else AT_REST)
        self.arm(_fast(signals), rows, self._decimation, 0, at_excitation=False)

    def finish_average(self, signals: Sequence[str]) -> Mapping[str, float]:
        """Wait for the record and return its means by signal."""
        self._trace = self.fetch(_fast(signals), self._decimation)
        self._slow = {name: self._node.get(objects.LIVE[name]) for name in signals if name in SLOW}
        return self._means(self._trace, slice(None))

    def halves(self, take: Callable[[int], Mapping[str, float]], periods: int) -> Halves:
        """Return means over two windows; from one record while the shaft turns: it slows down while one is uploaded."""
        self._looks = False
        try:
            if self._omega_e_rad_s() <= REST_RAD_S:
                return Halves(take(periods), take(periods), 2 * min(periods, AT_REST))
            take(2 * periods)
        finally:
            self._looks = True
        assert self._trace is not None
        half = len(self._trace) // 2
        first, second = (self._means(self._trace, rows) for rows in (slice(half), slice(-half, None)))
        return Halves(first, second, 2 * half)

    def _omega_e_rad_s(self) -> float:
        return abs(self._node.get(objects.LIVE["omega_e_rad_s"]))

    def _means(self, trace: Trace, rows: slice) -> Mapping[str, float]:
        means = {name: float(values[rows].mean()) for name, values in trace.signals.items()}
        if ANGLE in means:
            means[ANGLE] = self.continued(means[ANGLE])
        return {**means, **self._slow}

    def continued(self, angle_rad: float) -> float:
        """Return an angle with the turns put back: every record takes whole turns off what is shown afterwards."""
        turns = round((self._angle_rad - angle_rad) / (2.0 * math.pi))
        self._angle_rad = angle_rad + 2.0 * math.pi * turns
        return self._angle_rad


class RecordingDrive(CanopenDrive):
    """The reference drive's port with :class:`RecordedMeans` for its averages (level ``inject``)."""

    def __init__(self, connection: Connection, node_id: int, *, drive_map: DriveMap | None = None) -> None:
        super().__init__(connection, node_id, drive_map=drive_map)
        self._means = RecordedMeans(self.node, self.period_s)
        self.recorder = self._means

    def live(self, name: str) -> float:
        """Return one live quantity; the mechanical angle without the jumps that records leave in it."""
        value = super().live(name)
        return self._means.continued(value) if name == ANGLE else value
