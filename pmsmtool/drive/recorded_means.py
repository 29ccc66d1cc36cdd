"""A drive that injects and records but takes no window averages: means are made from records of its trace recorder."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from pmsmtool.bus.connection import Connection
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.recorder import Recorder
from pmsmtool.firmware.drive_map import DriveMap

AT_REST, TURNING = 1024, 64
"""Samples of a mean. With the shaft at rest there is time (32 KiB are half a second); a shaft that turns changes its
speed while a record is uploaded, and 8 signals of 64 samples are 35 ms."""
REST_RAD_S = 20.0
"""Electrical speed below which a shaft counts as being at rest."""
ANGLE = "theta_m_rad"


class RecordedMeans(Recorder):
    """Means over a window from a record of it, thinned out to so many samples as there is time to upload."""

    _decimation = 1
    _angle_rad = 0.0

    def start_average(self, signals: Sequence[str], periods: int) -> None:
        """Start recording the next ``periods`` control periods.

        Raises
        ------
        NotAvailable
            The drive has no recorder, or not these signals.
        """
        turning = abs(self._node.get(objects.LIVE["omega_e_rad_s"])) > REST_RAD_S
        self._decimation = max(1, math.ceil(periods / (TURNING if turning else AT_REST)))
        self.arm(signals, max(1, periods // self._decimation), self._decimation, 0, at_excitation=False)

    def finish_average(self, signals: Sequence[str]) -> Mapping[str, float]:
        """Wait for the record and return its means by signal."""
        trace = self.fetch(signals, self._decimation)
        means = {name: float(trace[name].mean()) for name in signals}
        if ANGLE in means:
            means[ANGLE] = self.continued(means[ANGLE])
        return means

    def continued(self, angle_rad: float) -> float:
        """Return an angle with the turns put back: every record takes whole turns off what is shown afterwards."""
        turns = round((self._angle_rad - angle_rad) / (2.0 * math.pi))
        self._angle_rad = angle_rad + 2.0 * math.pi * turns
        return self._angle_rad


class RecordingDrive(CanopenDrive):
    """The reference drive's port with :class:`RecordedMeans` for its averages (tier ``inject``)."""

    def __init__(self, connection: Connection, node_id: int, *, drive_map: DriveMap | None = None) -> None:
        super().__init__(connection, node_id, drive_map=drive_map)
        self._means = RecordedMeans(self.node, self.period_s)
        self.recorder = self._means

    def live(self, name: str) -> float:
        """Return one live quantity; the mechanical angle without the jumps that records leave in it."""
        value = super().live(name)
        return self._means.continued(value) if name == ANGLE else value
