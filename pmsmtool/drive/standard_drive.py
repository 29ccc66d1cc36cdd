# SPDX-License-Identifier: MIT
"""Drives without the reference drive's objects behind the same port: CiA 402 modes and what their map shows.

:class:`StandardDrive` needs mode 11 with the commutation angle 0x60EA; it turns a current vector and reads the encoder.
:class:`RecorderDrive` has a recorder of currents and voltages at loop rate and a torque mode that commutates already.
Both give the guard what it watches; everything else ends in ``NotAvailable``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.connection import Connection
from pmsmtool.cia402 import Mode
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.motion_objects import (
    POSITION,
    TorqueTarget,
    cyclic_period_s,
    position_turns,
    position_units,
    quicken_slope,
    rated_apk,
    shown_current,
    torque_target,
)
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.port import Excitation, Injection, Recording, Shape
from pmsmtool.drive.recorders.reference import Recorder
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.errors import DriveTimeout, NotAvailable, SdoAbort
from pmsmtool.trace import Trace
from pmsmtool.units import RAD_S_PER_MRPM

COMMUTATION_ANGLE = DriveObject(0x60EA, 0, "H")
ANGLE_COUNTS = 1 << 16
"""Counts of 0x60EA per electrical turn."""
RESISTANCE = "motor.R_s_ohm"
SPEED_S = 0.02
"""Shortest time between two looks at the position that show a speed."""
POLL_PERIOD_S = 1e-3
"""Live values are polled about this often: process data of a CAN bus do not come faster."""
SPARE_ROWS = 8
"""Rows a record of a step is longer, to take off the beginning what came before it."""
QUARTER_TURN = 0.5 * math.pi
"""Torque current flows a quarter turn ahead of the commutation angle; the rotor's d axis settles there."""


OUT_OF_RANGE = (AbortCode.VALUE, AbortCode.VALUE_HIGH, AbortCode.VALUE_LOW)
MOST_STEP, STEP_S = 0.1, 1e-3
"""A target that the drive takes at once moves by this share of the rated current in this time: CST has no 0x6087."""


class StandardDrive(CanopenDrive):
    """A drive of which only CiA 402 is known; implements ``drive.port.Drive`` as far as that goes.

    Its own pole pairs are unknown: electrical speed is counted per mechanical turn.

    Attributes
    ----------
    counts_per_turn : float
        Units of position per motor turn (0x608F, 0x6091, 0x6092, 0x60A8, or the maker's own object), negative where the
        polarity (0x607E) turns it.
    """

    commands_bounded_current = True

    def __init__(self, connection: Connection, node_id: int, *, drive_map: DriveMap | None = None) -> None:
        super().__init__(connection, node_id, drive_map=drive_map)
        self.recorder: Recorder = PolledMeans(self.node, self.live)
        self._last_counts: float | None = None
        self._since: tuple[float, float] = (0.0, 0.0)  # counts, and the instant (s) before they were asked for
        self._speed_rad_s = 0.0
        self.counts_per_turn = position_units(self.node)
        position_turns(self.node, self.counts_per_turn)
        self._rated_apk = rated_apk(self.node)
        self._current = shown_current(self.node, self._rated_apk)
        bits = 8 * self.node.typed(self._current.item).size
        self.shows_apk = self._current.per_count * ((1 << bits - 1) - 1)

    def _control_period_s(self) -> float:
        return POLL_PERIOD_S

    @property
    def rated_apk(self) -> float:
        """Rated current (A peak)."""
        return self._rated_apk

    def read(self, name: str) -> float:
        """Return one parameter; of those the guard scales with, neutral values.

        The pole pairs are one even where the drive's map knows them: its speed is counted per mechanical turn.
        """
        if name == "motor.pole_pairs":
            return 1.0
        cell = self.node.map.cells.get(name)
        if cell is not None and (name != RESISTANCE or self.node.has(cell.index, cell.sub)):
            return super().read(name)
        if name == RESISTANCE:
            return 0.0
        raise NotAvailable(f"the drive has no object for {name}", where=f"node {self.node.node}")

    def live(self, name: str) -> float:
        """Return position, speed per mechanical turn, or the current as if all of it were torque current (A peak)."""
        if name == "theta_m_rad":
            return self._position_rad()
        if name == "omega_e_rad_s":
            self._position_rad()
            return self._speed_rad_s
        if name == "i_q_a":
            # Taken as rms, the larger of the two readings, for safety.
            return self._current.per_count * self.node.get(self._current.item)
        if name == "i_d_a":
            return 0.0
        raise NotAvailable(f"the drive does not show {name}", where=f"node {self.node.node}")

    def _position_rad(self) -> float:
        """Return the unwrapped mechanical angle; its change over :data:`SPEED_S` and more is the speed.

        An answer may come any time after the drive read its position, so two looks 1 ms apart show any speed. The time
        counted is that from the older request to the newer answer: the speed is never shown larger than it was.
        """
        clock = self.node.connection.clock
        asked_s, counts, now = clock.now(), self.node.get(POSITION), clock.now()
        if self._last_counts is None:
            self._since = counts, asked_s
        else:
            step = counts - self._last_counts
            counts = self._last_counts + step - round(step / 2.0**32) * 2.0**32
        self._last_counts = counts
        older, older_s = self._since
        if now - older_s >= SPEED_S:
            self._speed_rad_s = 2.0 * math.pi * (counts - older) / self.counts_per_turn / (now - older_s)
            self._since = counts, asked_s
        return 2.0 * math.pi * counts / self.counts_per_turn

    def enable(self) -> None:
        """Bring the drive to operation enabled at zero torque with the master's commutation angle."""
        self.node.put(objects.TARGET_TORQUE_PERMILLE, 0)
        self._energise(Mode.CYCLIC_TORQUE_ANGLE)

    def command_current(self, i_d_a: float, i_q_a: float, *, fixed_angle_rad: float | None = None) -> None:
        """Hold a current vector at a fixed electrical angle: torque current behind a commutation angle."""
        if fixed_angle_rad is None and (i_d_a or i_q_a):
            raise NotAvailable("the drive has no d and q current set-points", where=f"node {self.node.node}")
        length = math.hypot(i_d_a, i_q_a)
        if fixed_angle_rad is not None:
            angle = fixed_angle_rad + math.atan2(i_q_a, i_d_a) - QUARTER_TURN
            self.node.put(COMMUTATION_ANGLE, round(angle / (2.0 * math.pi) * ANGLE_COUNTS) % ANGLE_COUNTS)
        self.node.put(objects.TARGET_TORQUE_PERMILLE, round(1000.0 * length / self._rated_apk))

    def command_speed(self, omega_m_rad_s: float) -> None:
        """Refuse: the unit of the target velocity is not known."""
        raise NotAvailable("the drive's unit of speed is not known", where=f"node {self.node.node}, 0x60FF:00")

    def prepare(self, excitation: Excitation) -> None:
        """Refuse: there is no excitation."""
        raise NotAvailable("the drive has no excitation", where=f"node {self.node.node}")


class PolledMeans(Recorder):
    """Means over a window, from live values polled one after the other.

    Parameters
    ----------
    node : DriveNode
        The drive.
    live : callable
        Returns a live value by name.
    """

    SAMPLES = 4

    def __init__(self, node: DriveNode, live: Callable[[str], float]) -> None:
        super().__init__(node, POLL_PERIOD_S)
        self._live = live

    def start_average(self, signals: Sequence[str], periods: int) -> None:
        """Nothing to start: the values are polled at the end."""

    def finish_average(self, signals: Sequence[str]) -> dict[str, float]:
        """Return means of a few polled values."""
        sums = dict.fromkeys(signals, 0.0)
        for _ in range(self.SAMPLES):
            for name in signals:
                sums[name] += self._live(name)
        return {name: total / self.SAMPLES for name, total in sums.items()}


class TorqueCurrent(CanopenDrive):
    """A drive that takes a q current as torque, in permille of rated: both are taken as proportional."""

    _rated_apk: float
    _step_s = STEP_S

    @cached_property
    def target(self) -> TorqueTarget:
        """What takes the torque current: mode 4, else 10, else the maker's own."""
        return torque_target(self.node, self._rated_apk)

    def enable(self) -> None:
        """Bring the drive to operation enabled at zero torque; some drives take a target only from then on."""
        if self.node.held(self.target.quantity.item) != 0.0:
            self.node.put(self.target.quantity.item, 0)
        self._asked_a = 0.0
        if self.target.cyclic:
            self._step_s = max(STEP_S, cyclic_period_s(self.node, STEP_S))
        elif self.target.mode == Mode.PROFILE_TORQUE:
            quicken_slope(self.node)
        self._energise(self.target.mode)

    def command_current(self, i_d_a: float, i_q_a: float, *, fixed_angle_rad: float | None = None) -> None:
        """Ask for the torque of a q current."""
        if i_d_a or fixed_angle_rad is not None:
            raise NotAvailable("the drive has no current set-point, only torque", where=f"node {self.node.node}")
        steps = 1
        if self.target.cyclic:  # taken at once: ramped here
            steps = max(1, math.ceil(abs(i_q_a - self._asked_a) / (MOST_STEP * self._rated_apk)))
        first = self._asked_a
        for step in range(1, steps + 1):
            asked = first + (i_q_a - first) * step / steps
            self._put_target(round(asked / self.target.quantity.per_count))
            self._asked_a = asked
            if step < steps:
                self.node.connection.wait(self._step_s)

    def _put_target(self, counts: int) -> None:
        """Write a target; raises NotAvailable: the drive takes none so large."""
        try:
            self.node.put(self.target.quantity.item, counts)
        except SdoAbort as abort:
            if abort.code not in OUT_OF_RANGE:
                raise
            raise NotAvailable(
                f"the drive takes no target of {counts} ({abort.what})", where=abort.where,
                hint="give a smaller --i-max, or raise the drive's limit with the maker's software",
            ) from abort  # fmt: skip


class RecorderDrive(TorqueCurrent):
    """A drive with a recorder and a torque mode, without excitation; the part of ``drive.port.Drive`` that this gives.

    That current and torque are proportional is corrected by the recorded current.
    """

    def __init__(self, connection: Connection, node_id: int, *, drive_map: DriveMap | None = None) -> None:
        super().__init__(connection, node_id, drive_map=drive_map)
        self._rated_apk = rated_apk(self.node)
        self._late_s = 0.0

    def prepare(self, excitation: Excitation) -> None:
        """Check that a speed reference is all that is asked for: there is no excitation."""
        if excitation.point is not Injection.SPEED or excitation.shape is not Shape.STEP:
            raise NotAvailable("the drive has no excitation, only references", where=f"node {self.node.node}")

    def begin_record(self, recording: Recording, wait: Callable[[float], None]) -> None:
        """Start the recorder, and right behind it the speed step that is asked for."""
        step = recording.excitation
        samples = recording.samples + (0 if step is None else SPARE_ROWS)
        self.recorder.arm(
            recording.signals, samples, recording.decimation, recording.pretrigger, at_excitation=False
        )  # fmt: skip
        if step is not None:
            clock = self.node.connection.clock
            armed = clock.now()
            self.node.put(objects.TARGET_VELOCITY_MRPM, step.amplitude / RAD_S_PER_MRPM)
            self._late_s = clock.now() - armed
            self._set_mode(Mode.PROFILE_VELOCITY)

    def finish_record(self, recording: Recording) -> Trace:
        """Return the record; of a speed step from the instant at which the drive got it.

        Recorder and step are commanded one after the other: the transfers last about the same, so the time between
        their answers is the time between their effects.
        """
        if recording.excitation is None:
            self.coast()
            return super().finish_record(recording)
        trace = super().finish_record(recording)
        rows = len(trace) - SPARE_ROWS
        if self._late_s > SPARE_ROWS * trace.period_s:
            raise DriveTimeout(
                f"the step came {1e3 * self._late_s:.2g} ms after the recorder was started",
                where=f"node {self.node.node}", likely="a slow adapter",
                hint="use a faster adapter, or close what else uses this one",
            )  # fmt: skip
        at = trace.t_s[:rows] + self._late_s
        signals_at = {name: np.interp(at, trace.t_s, values) for name, values in trace.signals.items()}
        return Trace(trace.t_s[:rows], signals_at, trace.units, {**trace.meta, "late_s": self._late_s})

    def coast(self) -> None:
        """Take the torque away before a record is read: reading may last longer than the push, which would go on."""
        self.command_current(0.0, 0.0)

    def end_excitation(self) -> None:
        """Leave the speed where it is: the next command takes it back."""

    def average(self, signals: Sequence[str], periods: int) -> Mapping[str, float]:
        """Return the live values: the drive has no averages."""
        return {name: self.live(name) for name in signals}
