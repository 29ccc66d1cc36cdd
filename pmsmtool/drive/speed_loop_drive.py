# SPDX-License-Identifier: MIT
"""A drive of another maker in its own velocity mode: steps of its speed reference, position and current as answers.

What one count of its speed is worth is nobody's word: :attr:`SpeedLoopDrive.rad_s_per_count` is measured by who uses it
(``measurement/speed_unit.py``). The speed loop is the drive's own, so that every stop removes the voltage.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import NamedTuple

import numpy as np

from pmsmtool.bus.connection import RESOLUTION_S, Connection
from pmsmtool.cia402 import Mode
from pmsmtool.drive import objects
from pmsmtool.drive.motion_objects import (
    POSITION,
    TORQUE_PERMILLE,
    allowed,
    asked_current,
    current_limits,
    rated_current,
)
from pmsmtool.drive.port import Excitation, Injection, Recording, Shape
from pmsmtool.drive.process_data import LiveValues, live_values
from pmsmtool.drive.standard_drive import POLL_PERIOD_S
from pmsmtool.drive.torque_drives import TorqueDrive
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.errors import DriveTimeout, LimitExceeded, NotAvailable, SdoAbort
from pmsmtool.trace import Trace

ASKED = ("asked", "flows")
OSCILLATION_SAMPLES = 20
"""Periods of sampling over which an oscillation is judged."""
SPEED_S, LOOK_S, SILENT_S = 1e-2, 5e-3, 0.05
"""Time over which a speed is watched, how often outside of records, and for how long no sample may come."""
LARGEST_COUNT = 2.0 * math.pi
"""Largest speed that one count of any drive's velocity is worth (rad/s): a turn per second."""


class Row(NamedTuple):
    """One sample: when it was sent (s), position (rad), current (A).

    Where the drive shows it, counts of the current that is asked for and of the one that flows, and how much later than
    ``current_a`` (s) the former was read.
    """

    t_s: float
    position_rad: float
    current_a: float
    asked: float = 0.0
    flows: float = 0.0
    later_s: float = 0.0


class Oscillation:
    """Root mean square of the current's last samples about their mean: grows when a loop begins to oscillate.

    Attributes
    ----------
    largest_a : float
        Largest one since :meth:`begin`.
    limit_a : float
        Trip level; infinity: only watched.
    """

    def __init__(self) -> None:
        self.limit_a = math.inf
        self.begin()

    def begin(self) -> None:
        """Forget the samples."""
        self._last: deque[float] = deque(maxlen=OSCILLATION_SAMPLES)
        self.largest_a = 0.0

    def take(self, current_a: float) -> None:
        """Take a sample."""
        self._last.append(current_a)
        if len(self._last) == OSCILLATION_SAMPLES:
            mean = math.fsum(self._last) / OSCILLATION_SAMPLES
            square = math.fsum((value - mean) ** 2 for value in self._last) / OSCILLATION_SAMPLES
            self.largest_a = max(self.largest_a, math.sqrt(square))

    def check(self, where: str) -> None:
        """Raise ``LimitExceeded`` where the trip level was reached; the guard then removes the voltage."""
        if self.largest_a > self.limit_a:
            raise LimitExceeded(
                "oscillation of the current", self.largest_a, self.limit_a, "A rms", where=where,
                likely="the changed gain makes the loop oscillate", hint="the gains are restored; nothing was learned",
            )  # fmt: skip


class SpeedLoopDrive(TorqueDrive):
    """A drive that follows a speed by its own loop; a record holds position and current at up to 1 kHz.

    Raises NotAvailable: the drive has no velocity mode.

    Attributes
    ----------
    mode : int
        Velocity mode: cyclic (9) where it has one, for it knows no ramp, else 3.
    rad_s_per_count : float
        One count of 0x60FF; until it is measured the largest that occurs.
    read_as_rms : bool
        Whether the current that is shown was taken as rms without a source: a share of 0x6075 is, too.
    sends : bool
        Whether the drive sends its samples by itself (process data); else they are asked for one by one.
    fastest_rad_s : float
        Speed by the samples at which :meth:`wait` raises ``LimitExceeded``; infinity: not watched.
    starts : callable or None
        Called once in a staircase, :attr:`starts_s` after its begin: starts the drive's own recorder.
    asked : tuple of DriveObject
        Where it shows the current that its speed loop asks for, and what flows, in one unit; empty: it does not.
    """

    starts: Callable[[], None] | None = None
    starts_s = 0.0
    _began_s = 0.0

    def __init__(self, connection: Connection, node_id: int, *, drive_map: DriveMap | None = None) -> None:
        super().__init__(connection, node_id, drive_map=drive_map)
        modes = int(self.node.held(objects.SUPPORTED_MODES) or 0)
        offered = [mode for mode in (Mode.CYCLIC_VELOCITY, Mode.PROFILE_VELOCITY) if modes >> mode - 1 & 1]
        if not offered or self.node.held(objects.TARGET_VELOCITY_MRPM) is None:
            raise NotAvailable(
                f"the drive has no velocity mode (0x6502 = {modes:#x}, 0x60FF)", where=f"node {node_id}",
                hint="`pmsmtool caps` lists what this drive can measure",
            )  # fmt: skip
        self.mode = offered[0]
        self.rad_s_per_count = LARGEST_COUNT
        limits = list(current_limits(self.node, self._rated_apk))
        # the drive's own limit bounds whatever its loop asks for
        self.commands_bounded_current = allowed(self.node, iter(limits)) is not None
        allows = [limit.per_count * value for limit in limits if (value := self.node.held(limit.item)) is not None]
        self.current_limit_apk = min(allows, default=math.inf)
        base = rated_current(self.node)
        of_standard = base is not None and base.item == objects.RATED_CURRENT_MA
        share = self._current.item in (objects.CURRENT_PERMILLE, TORQUE_PERMILLE)
        self.read_as_rms = self.current_undecided or (of_standard and share)
        self.oscillation = Oscillation()
        self.sends = True
        self.asked = asked_current(self.node, self._current)
        self.fastest_rad_s = math.inf
        self._seen: deque[tuple[float, float]] = deque()
        self._seen_s = math.inf
        self._sending: AbstractContextManager[LiveValues] | None = None
        self._samples: list[Row] = []
        self._due: list[tuple[float, float]] = []
        self._written: list[tuple[float, float]] = []
        self._recording = False
        self._unwrapped: float | None = None
        self._behind_s = math.inf

    @property
    def current_count_a(self) -> float:
        """One count of the current that is shown (A, as rms where nobody says)."""
        return self._current.per_count

    # ---- motion ---------------------------------------------------------------------------------

    def enable(self) -> None:
        """Bring the drive to operation enabled at no speed, in its velocity mode."""
        self.node.put(objects.TARGET_VELOCITY_MRPM, 0)
        self._energise(self.mode)

    def command_speed(self, omega_m_rad_s: float) -> None:
        """Ask for the nearest speed that whole counts give."""
        self.node.put(objects.TARGET_VELOCITY_MRPM, self._counts(omega_m_rad_s))

    def command_current(self, i_d_a: float, i_q_a: float, *, fixed_angle_rad: float | None = None) -> None:
        """Refuse: the drive is in its velocity mode."""
        raise NotAvailable("in its velocity mode it takes no current", where=f"node {self.node.node}")

    def _counts(self, omega_m_rad_s: float) -> int:
        return round(omega_m_rad_s / self.rad_s_per_count)

    # ---- records --------------------------------------------------------------------------------

    def send_samples(self) -> None:
        """Have the drive send position and current every millisecond, where it can; else they will be asked for."""
        items = {"position": POSITION, "current": self._current.item}
        items |= {name: item for name, item in zip(ASKED, self.asked, strict=False) if item != self._current.item}
        sending = live_values(self.node, list(items), POLL_PERIOD_S, items)
        try:
            live = sending.__enter__()
        except (NotAvailable, SdoAbort):  # fixed process data
            self.sends = False
            return
        self._sending = sending

        def note(stamp_s: float) -> None:
            self._see(stamp_s, live.values["position"])
            if self._recording:
                # an adapter's time stamps begin where they like; the shortest way here ties them to the clock
                self._behind_s = min(self._behind_s, self.node.connection.clock.now() - stamp_s)
                position, current = live.values["position"], live.values["current"]
                asked, flows = (live.values.get(name, current) for name in ASKED)
                self._take(stamp_s, position, current, asked, flows)

        live.on_set = note

    def end_samples(self) -> None:
        """Bring the drive's process data back; no speed is watched any more."""
        self.fastest_rad_s = math.inf
        sending, self._sending = self._sending, None
        if sending is not None:
            sending.__exit__(None, None, None)

    def prepare(self, excitation: Excitation) -> None:
        """Check that it is a staircase of speeds: the drive has no other excitation."""
        if excitation.point is not Injection.SPEED or excitation.shape is not Shape.BUFFER:
            raise NotAvailable("the drive has no excitation, only references", where=f"node {self.node.node}")

    def begin_record(self, recording: Recording, wait: Callable[[float], None]) -> None:
        """Note every sample from now on; a staircase is written step by step meanwhile."""
        began = self.node.connection.clock.now()
        self._samples, self._written, self._due = [], [], []
        self._began_s = began
        self._unwrapped, self._behind_s = None, math.inf
        self.oscillation.begin()
        step = recording.excitation
        if step is not None:
            last = math.nan
            for k, speed in enumerate(step.buffer):
                if speed != last:
                    self._due.append((began + k * step.hold_periods * self.period_s, speed))
                last = speed
        self._recording = True

    def finish_record(self, recording: Recording) -> Trace:
        """Return the samples, with the references written and their times in ``meta`` (rad/s, s)."""
        self._recording = False
        self.check_operating()
        table = np.array(self._samples, dtype=np.float64).reshape(len(self._samples), 6)
        if self.sends and len(table):
            table[:, 0] += self._behind_s
        first = table[0, 0] if len(table) else 0.0
        steps = [[t - first, speed] for t, speed in self._written]
        signals = {"theta_m_rad": table[:, 1], "i_q_a": table[:, 2]}
        if self.asked:  # in the unit of a current that both objects show
            current, flows = table[:, 2], table[:, 4]
            signals["i_q_ref_a"] = table[:, 3] * (current @ flows) / max(float(flows @ flows), 1.0)
        units = {name: objects.signal_unit(name) for name in signals}
        later_s = float(np.median(table[:, 5])) if len(table) else 0.0
        meta = {"polled": not self.sends, "steps": steps, "asked_later_s": later_s}
        return Trace(table[:, 0] - first, signals, units, meta)

    def end_excitation(self) -> None:
        """Leave the speed where it is: the next command takes it back."""
        self._recording, self._due, self.starts = False, [], None

    def wait(self, seconds: float) -> None:
        """Let time pass; writes the steps that are due, and asks for samples where the drive does not send them."""
        clock = self.node.connection.clock
        end = clock.now() + seconds
        while self._recording or self._watches:
            self.oscillation.check(f"node {self.node.node}")
            if self._watches:
                self._check_speed()
            if self.starts is not None and self._recording and clock.now() - self._began_s >= self.starts_s:
                start, self.starts = self.starts, None
                start()
            while self._due and self._due[0][0] - clock.now() < RESOLUTION_S:
                speed = self._due.pop(0)[1]
                if self._due and self._due[0][0] - clock.now() < RESOLUTION_S:
                    continue  # a bus too slow for every step: the staircase is coarser, and as long as it was planned
                before = clock.now()
                self.command_speed(speed)
                self._written.append((0.5 * (before + clock.now()), self._counts(speed) * self.rad_s_per_count))
            if not self.sends:
                self._ask()
            next_s = clock.now() + (POLL_PERIOD_S if self._recording and not self.sends else LOOK_S)
            left = min([end, next_s, *(at for at, _ in self._due[:1])]) - clock.now()
            if left > 0.0:
                self.node.connection.wait(left)
            if end - clock.now() < RESOLUTION_S:
                break
        super().wait(max(0.0, end - clock.now()))

    @property
    def _watches(self) -> bool:
        return self.may_be_energised and self.fastest_rad_s < math.inf

    def _see(self, t_s: float, counts: float) -> None:
        """Keep the positions of the last :data:`SPEED_S`."""
        self._seen.append((t_s, counts))
        while t_s - self._seen[0][0] > SPEED_S:
            self._seen.popleft()
        self._seen_s = self.node.connection.clock.now()

    def _check_speed(self) -> None:
        """Raise LimitExceeded, DriveTimeout: the shaft is too fast by its last samples, or none come; else return."""
        where, now = f"node {self.node.node}", self.node.connection.clock.now()
        self._seen_s = min(self._seen_s, now)  # the first sample is waited for from here on
        if self.sends and now - self._seen_s > SILENT_S:
            raise DriveTimeout(
                f"no sample of the shaft's position came for {1e3 * (now - self._seen_s):.0f} ms", where=where,
                likely="the bus is busy", hint="leave the bus to this program, then run the command again",
            )  # fmt: skip
        if not self._seen or (seconds := self._seen[-1][0] - self._seen[0][0]) < 0.4 * SPEED_S:
            return
        counts = self._seen[-1][1] - self._seen[0][1]
        counts -= round(counts / 2.0**32) * 2.0**32
        speed = 2.0 * math.pi * abs(counts / self.counts_per_turn) / seconds
        if speed > self.fastest_rad_s:
            raise LimitExceeded(
                "speed", speed, self.fastest_rad_s, "rad/s", where=where, likely="the drive's speed loop runs away",
                hint="tune it by the maker's own set-up; the gains are restored, and nothing was learned",
            )  # fmt: skip

    def _ask(self) -> None:
        values, at = {}, {}
        for item in dict.fromkeys((POSITION, self._current.item, *self.asked)):
            before = self.node.connection.clock.now()
            values[item] = self.node.get(item)
            at[item] = 0.5 * (before + self.node.connection.clock.now())
        asked, flows = self.asked or (self._current.item, self._current.item)
        self._see(at[POSITION], values[POSITION])
        if not self._recording:
            return
        row = values[POSITION], values[self._current.item], values[asked], values[flows]
        self._take(at[POSITION], *row, at[asked] - at[self._current.item])

    def _take(
        self, t_s: float, counts: float, current: float, asked: float = 0.0, flows: float = 0.0, later_s: float = 0.0
    ) -> None:
        if self._unwrapped is not None:
            step = counts - self._unwrapped
            counts = self._unwrapped + step - round(step / 2.0**32) * 2.0**32
        self._unwrapped = counts
        position = 2.0 * math.pi * counts / self.counts_per_turn
        self._samples.append(Row(t_s, position, current * self._current.per_count, asked, flows, later_s))
        self.oscillation.take(self._samples[-1].current_a)
