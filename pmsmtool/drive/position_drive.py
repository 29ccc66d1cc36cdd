# SPDX-License-Identifier: MIT
"""A drive of another maker in profile position mode: it runs its own move, and shows demand, position and current.

Demand (0x6062) and position (0x6064) come in one sample: their difference is the drive's own following error, without
any delay of the bus. A drive without demand shows that error (0x60F4). The position loop is the drive's own: every stop
removes the voltage.
The speed that it shows in a stated unit is held against the slope of its position: one may be counted wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.axis.drive import AXIS_GAINS, CURRENT, NOTCH
from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.connection import Connection
from pmsmtool.cia402 import Mode
from pmsmtool.drive import objects
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.motion_objects import POSITION, allowed, current_limits, shown_speed
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.process_data import LiveValues, live_values
from pmsmtool.drive.set_point import FOLLOWING_ERROR, POSITION_DEMAND, TARGET_POSITION, WHOLE, start_move
from pmsmtool.drive.standard_drive import POLL_PERIOD_S
from pmsmtool.drive.torque_drives import TorqueDrive
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.errors import LimitExceeded, NotAvailable, SdoAbort
from pmsmtool.trace import Trace

AGREE, STANDS_STILL = (0.6, 1.6), 0.01
"""Least and largest of the one over the other: one is filtered and read later. Wrong units differ by 2, 4 and more.
What shows nothing while the shaft turns is no unit."""
ROWS, LEAST_ROWS, LONGEST_S = 16, 5, 0.05
"""Positions before a look whose slope is taken, the fewest, and the time within which they lie."""
LEAST_LOOKS, FAST_SHARE = 4, 0.3
"""Looks that are needed at more than this share of the largest speed."""


class ComparedSpeed:
    """Notes both speeds while a drive moves.

    Parameters
    ----------
    node : DriveNode
        The drive.
    counts_per_turn : float
        Units of position per turn that its angles are made with.
    """

    def __init__(self, node: DriveNode, counts_per_turn: float) -> None:
        self._node, self._counts_per_turn = node, abs(counts_per_turn)
        self._item = shown_speed(node)
        self._pairs: list[tuple[float, float]] = []

    def look(self, rows: Sequence[Sequence[float]]) -> None:
        """Note the speed that is shown now, and that of the rows (time in s, angle in rad, ...) before."""
        clock = self._node.connection.clock
        recent = [row[:2] for row in rows[-ROWS:] if row[0] > clock.now() - LONGEST_S]
        if self._item is None or len(recent) < LEAST_ROWS:
            return
        began = clock.now()
        shown = self._item.per_count * self._node.get(self._item.item)
        t, angle = np.array(recent).T
        slope = np.polyfit(t - 0.5 * (began + clock.now()), angle, 2)[1]
        self._pairs.append((shown, float(slope)))

    @property
    def doubt(self) -> str:
        """What is said where both contradict each other; empty where they do not, or too little was seen."""
        shown, seen = np.abs(np.array(self._pairs, dtype=np.float64).reshape(-1, 2)).T
        fast = seen > FAST_SHARE * np.max(seen, initial=0.0)
        if np.count_nonzero(fast) < LEAST_LOOKS:
            return ""
        ratio = float(shown[fast] @ seen[fast] / (seen[fast] @ seen[fast]))
        if ratio < STANDS_STILL or AGREE[0] <= ratio <= AGREE[1]:
            return ""
        return (
            f"the drive shows {ratio:.3g} times the speed of its position ({self._item}): one of both has another unit "
            f"than stated. {self._counts_per_turn:.9g} units of position a turn are taken (0x608F, 0x6092, or the map)"
        )


SHOWN = ("position", "demand", "current")
RAMPS = (objects.PROFILE_ACCELERATION, objects.PROFILE_DECELERATION)
LARGEST = 0xFFFF_FFFF

FOLLOWS_S, FOLLOWS_SHARE = 0.05, 0.01
"""A shaft is on its way where in that time it has come nearer by that share of the limit. As their makers' tools leave
them, loops of 15 rad/s without feed-forward lag 63 to 80 degrees of a move by 90; blocked ones come no nearer."""
WHOLE_WAY = 2.2
"""Limit of the lag over that of a shaft that stands; the latter is half of the way."""


class PositionDrive(TorqueDrive):
    """A drive that follows a position by its own loop, from where it stands.

    Raises NotAvailable: the drive has no profile position mode, or shows neither its demand nor its following error.

    Attributes
    ----------
    error_limit_rad : float
        Following error at which the voltage is removed, unless the shaft is on its way to the demand; at ``WHOLE_WAY``
        times that, in any case.
    current_allowed_apk : float
        Rated current, or the drive's own limit or what it can show where that is smaller (A peak).
    compared : ComparedSpeed
        The speed that the drive shows, against that of its position.
    brakes_alone : bool
        Whether the drive's deceleration (0x6084) can only be read: it brakes by that, or by 0x6083 where it has one
        ramp for both. Known once a profile was lent.
    sends : bool
        Whether the drive sends its samples by itself (process data); else they are asked for one by one.
    """

    def __init__(self, connection: Connection, node_id: int, *, drive_map: DriveMap | None = None) -> None:
        super().__init__(connection, node_id, drive_map=drive_map)
        modes = int(self.node.held(objects.SUPPORTED_MODES) or 0)
        self._by_error = self.node.held(POSITION_DEMAND) is None
        shown = not self._by_error or self.node.held(FOLLOWING_ERROR) is not None
        lacking = [
            what
            for what, has in (
                ("profile position mode (bit 0 of 0x6502)", modes & 1),
                ("a target position (0x607A)", self.node.held(TARGET_POSITION) is not None),
                ("its position demand (0x6062) or following error (0x60F4)", shown),
            )
            if not has
        ]
        if lacking:
            raise NotAvailable(
                f"the drive lacks {', '.join(lacking)}", where=f"node {node_id}",
                hint="`pmsmtool caps` lists what this drive can measure",
            )  # fmt: skip
        self.error_limit_rad = math.inf
        kept = allowed(self.node, current_limits(self.node, self._rated_apk))
        self.current_allowed_apk = min(self._rated_apk, math.inf if kept is None else kept[1], self.shows_apk)
        self.brakes_alone = False
        self.sends = True
        self._sending: AbstractContextManager[LiveValues] | None = None
        self._taken: list[tuple[float, float, float, float]] = []
        self._recording = False
        self._start_counts = 0.0
        self.compared = ComparedSpeed(self.node, self.counts_per_turn)

    def held_gains(self) -> dict[str, float]:
        """Return gains of position, speed and current, and notch, that the drive holds, by name; those of its map."""
        held = {name: self.parameters.held_value(name) for name in (*AXIS_GAINS, *NOTCH, *CURRENT)}
        return {name: value for name, value in held.items() if value is not None}

    # ---- motion ---------------------------------------------------------------------------------

    def enable(self) -> None:
        """Bring the drive to operation enabled in its position mode, at the place where the shaft stands.

        Some drives take a target only once enabled: they stay where they are until a set-point is announced.
        """
        self._start_counts = self.node.get(POSITION)
        try:
            self.node.put(TARGET_POSITION, self._start_counts)
        except SdoAbort as abort:
            if abort.code != AbortCode.DEVICE_STATE:
                raise
        self._energise(Mode.PROFILE_POSITION)

    def move_to(self, angle_rad: float, *, at_once: bool = False) -> None:
        """Start a move to an angle from where the shaft stood when it was enabled; ``at_once`` ends another move.

        Raises DriveTimeout: the drive does not take the set-point.
        """
        counts = self._start_counts + angle_rad / (2.0 * math.pi) * self.counts_per_turn
        start_move(self.node, counts, at_once=at_once)

    def profile(self) -> str:
        """Return what the drive's own profile holds, in its units."""
        held = ((item, self.node.held(item)) for item in (objects.PROFILE_VELOCITY, *RAMPS))
        return ", ".join(f"0x{item.index:04X} = {value:.0f}" for item, value in held if value is not None)

    def ramp_counts(self) -> float:
        """Return what the drive's acceleration (0x6083) holds; 0 where it has none."""
        return self.node.held(objects.PROFILE_ACCELERATION) or 0.0

    def lend_profile(self, speed: int, ramp: int) -> None:
        """Write counts of speed and of both ramps, whatever their unit; the guard brings the old ones back.

        Raises NotAvailable: the drive refuses them.
        """
        for item, counts in zip((objects.PROFILE_VELOCITY, *RAMPS), (speed, ramp, ramp), strict=True):
            try:
                if self.node.held(item) not in (None, counts):
                    self.node.put(item, counts)
            except SdoAbort as abort:
                if item == objects.PROFILE_DECELERATION and abort.code == AbortCode.READ_ONLY:
                    self.brakes_alone = True
                    continue
                raise NotAvailable(
                    f"the drive refuses {counts} in 0x{item.index:04X}", where=abort.where,
                    hint="leave --design, --speed and --acceleration out: the drive then moves as it is set up",
                ) from abort  # fmt: skip

    def demanded_rad(self) -> float:
        """Return the demand as the drive shows it now, from where the shaft stood when it was enabled."""
        demand = self.node.get(self._demand) + (self.node.get(POSITION) if self._by_error else 0.0)
        return self._angle(demand - self._start_counts)

    @property
    def _demand(self) -> DriveObject:
        """What shows the demand: itself, or what is added to the position."""
        return FOLLOWING_ERROR if self._by_error else POSITION_DEMAND

    def _angle(self, counts: float) -> float:
        return 2.0 * math.pi * (counts - round(counts / WHOLE) * WHOLE) / self.counts_per_turn

    @property
    def rad_per_count(self) -> float:
        """Angle of one unit of the position (rad)."""
        return 2.0 * math.pi / abs(self.counts_per_turn)

    def look_at_speed(self) -> None:
        """Compare the speed that the drive shows with that of the samples before."""
        self.compared.look(self._taken)

    # ---- records --------------------------------------------------------------------------------

    def begin_samples(self) -> None:
        """Note demand, position and current every millisecond from now on; asked for where they cannot be sent."""
        self._taken, self._recording = [], True
        items = {"position": POSITION, "demand": self._demand, "current": self._current.item}
        sending = live_values(self.node, SHOWN, POLL_PERIOD_S, items)
        try:
            live = sending.__enter__()
        except (NotAvailable, SdoAbort):  # fixed process data
            self.sends = False
            return
        self._sending = sending
        live.on_set = lambda stamp_s: self._take(stamp_s, *(live.values[name] for name in SHOWN))

    @property
    def samples(self) -> int:
        """Samples noted so far."""
        return len(self._taken)

    def demand_since(self, first: int) -> tuple[Array, Array]:
        """Return times (s) and demands (rad) noted from a sample on, shape (n,)."""
        table = np.array(self._taken[first:], dtype=np.float64).reshape(-1, 4)
        return table[:, 0], table[:, 2]

    def lag_rad(self) -> float:
        """Return the following error of the latest sample (rad); 0 without one."""
        return self._taken[-1][2] - self._taken[-1][1] if self._taken else 0.0

    def forget_samples(self) -> None:
        """Let the record begin now."""
        self._taken = []

    def end_samples(self) -> Trace:
        """Bring the drive's process data back; return what was noted: angles from the start (rad), current (A).

        ``start_rad`` of its ``meta`` is the angle that the drive showed at the start.
        """
        self._recording = False
        sending, self._sending = self._sending, None
        if sending is not None:
            sending.__exit__(None, None, None)
        table = np.array(self._taken, dtype=np.float64).reshape(len(self._taken), 4)
        units = {"theta_m_rad": "rad", "theta_ref_rad": "rad", "i_q_a": "A"}
        signals = dict(zip(units, table[:, 1:].T, strict=True))
        return Trace(
            table[:, 0] - table[:1, 0],
            signals,
            units,
            {
                "polled": not self.sends,
                "speed_doubt": self.compared.doubt,
                "start_rad": self._angle(self._start_counts),
            },
        )

    def wait(self, seconds: float) -> None:
        """Let time pass; asks for samples where the drive does not send them, and watches the following error."""
        clock = self.node.connection.clock
        end = clock.now() + seconds
        while self._recording and not self.sends and clock.now() < end:
            now = clock.now()
            self._take(now, *(self.node.get(item) for item in (POSITION, self._demand, self._current.item)))
        super().wait(max(0.0, end - clock.now()))
        if self._taken and self._recording:
            error = self.lag_rad()
            if abs(error) > self.error_limit_rad and (
                not self._follows(error) or abs(error) > WHOLE_WAY * self.error_limit_rad
            ):
                raise LimitExceeded(
                    "following error", abs(error), self.error_limit_rad, "rad", where=f"node {self.node.node}",
                    likely="the position loop oscillates or saturates, or the shaft is blocked",
                    hint="the voltage is off; ask for a slower move, or look at the gains",
                )  # fmt: skip

    def _follows(self, error: float) -> bool:
        """Whether the shaft turns towards the demand: a calm loop without feed-forward lags by speed over its gain."""
        end = self._taken[-1][0]
        before = next((sample for sample in reversed(self._taken) if sample[0] <= end - FOLLOWS_S), self._taken[0])
        return math.copysign(1.0, error) * (self._taken[-1][1] - before[1]) > FOLLOWS_SHARE * self.error_limit_rad

    def _take(self, t_s: float, position: float, demand: float, current: float) -> None:
        demand += position if self._by_error else 0.0
        angles = (self._angle(counts - self._start_counts) for counts in (position, demand))
        self._taken.append((t_s, *angles, current * self._current.per_count))  # type: ignore[arg-type]
