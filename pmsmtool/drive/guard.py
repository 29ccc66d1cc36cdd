# SPDX-License-Identifier: MIT
"""The guard: the only way an experiment gets a drive.

It keeps the motion envelope before and during every command, in the tool and in the drive, notes
every object that is changed, proves the dead-man, and whatever happens leaves a machine that is
stopped (confirmed from the statusword) and a drive that holds what it held before.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

from pmsmtool.cia402 import QuickStop
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.changed_objects import NO_LIMITS, ChangedObjects, clear_offsets, lower_limits, put_limit
from pmsmtool.drive.dead_man import DeadManProof, prove_dead_man, set_quick_stop
from pmsmtool.drive.drive_node import is_safe, state_text
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.heartbeat import Heartbeat
from pmsmtool.drive.motion_objects import OVER_SPEED_TRIP, encoder_counts, few_counts, lowered_trip, trips_itself
from pmsmtool.drive.port import Excitation, Halves, Identity, Injection, ProfileMove, Recording, Shape
from pmsmtool.drive.stop import interrupts_deferred
from pmsmtool.errors import (
    BusError,
    DriveFault,
    Interrupted,
    LimitExceeded,
    PmsmtoolError,
    SafetyRefusal,
    StopNotConfirmed,
)
from pmsmtool.files import ELSEWHERE, USER_ROOM, refuse_full, user_folder
from pmsmtool.trace import Trace
from pmsmtool.units import rad_s_from_rpm, rpm_from_rad_s

WATCH_S = 0.05
"""The machine is looked at this often while time passes."""
FRESH_S = 0.1
"""The tool's heartbeat is sent while the machine was looked at within this time: two looks.

So a main thread that hangs lets the drive stop after at most this time, one heartbeat period and the drive's own
declared time, together 0.5 s."""
LOCKED_TRAVEL_RAD = math.radians(20.0)
"""A clamp and its coupling give by a few degrees; a shaft that goes further is not locked."""
_BUG = "this is a bug worth reporting"
_TURNS = "the shaft turns, but --shaft locked is given"
_AS_GIVEN: Mapping[str, tuple[Callable[[float], float], str]] = {
    "rad/s": (rpm_from_rad_s, "rpm"), "rad": (math.degrees, "deg"),
}  # fmt: skip
"""How a limit is given (``--speed-max``, ``--travel``), by its SI unit."""
_OTHER_UNIT = {
    "current": "the loop overshoots, or what shows the current is no permille of the rated one (0x6078, 0x6077)",
    "speed": "a shaft lighter than taken, or a turn has other units of position than 0x608F, 0x6092 or the map state",
}
"""Likely causes on a drive of which only CiA 402 is known: whatever bounds its commands rests on these units."""
_NEXT_STEP = {
    "current": "raise the limit knowingly (--i-max), or ask for less",
    "d current": "state i_d_min_apk in the machine file where the magnets stand more, or ask for less",
    "speed": "raise the limit knowingly (--speed-max), or ask for less",
    "travel": "clamp the shaft, or allow more travel; a move by the drive's own position loop: ask for a slower one",
}
OVERSHOOT = 1.25
"""Measured current or speed over its limit that ends an experiment: regulation overshoots, noise peaks."""
KEPT_SHARE, KEPT_S = 0.1, 0.5
"""A commanded speed kept this closely for so long proves encoder sign and speed loop: a wrong sign runs away."""
UNPROVEN_BY = ("motor.", "encoder.", "current.", "speed.", "inverter.")
"""Parameters after whose change a proven speed loop is proven no more."""
_ROUNDING = 1e-9
RESTORED = "voltage off, drive restored"
"""What is said when a drive that was lent is off and holds again what it held before."""


class GuardedDrive:
    """A drive within an envelope; implements ``drive.port.Drive``.

    Made by :func:`guarded` only.

    Attributes
    ----------
    proof : DeadManProof or None
        Of the dead-man, once it was shown.
    energy_j, energised_s : float
        Copper loss and time spent so far.
    over : bool
        Whether the drive was given back, restored or with an error that says what is not.
    """

    def __init__(self, drive: CanopenDrive, envelope: Envelope) -> None:
        self.envelope = envelope
        self.identity: Identity = drive.identity
        self.proof: DeadManProof | None = None
        self.energy_j = 0.0
        self.energised_s = 0.0
        self._drive = drive
        self._node = drive.node
        self._heartbeat = Heartbeat(drive.node.connection, is_watched=self._is_watched)
        self._changed = ChangedObjects(drive)
        self.over = False
        self._ended = False
        self._start_rad: float | None = None
        self._looked_s = -math.inf
        self._speed_overshoot = OVERSHOOT
        self._asked_rad_s = 0.0
        self._kept_since_s: float | None = None
        self._pole_pairs = 1.0
        self._counts: float | None = None
        self._R_s_ohm = 0.0
        self._limits = NO_LIMITS

    # ---- beginning and end ----------------------------------------------------------------------

    def begin(self, *, prove: bool = True, first: Mapping[str, float] | None = None) -> None:
        """Note the marks, write limits and ``first``, prove the dead-man; the drive is off on return."""
        self.envelope.refuse_gravity()
        if not is_safe(self._node.state()):
            raise SafetyRefusal(
                f"the drive is in {state_text(self._node.state())}: another program has enabled it",
                where=f"node {self._node.node}, 0x6041:00",
                hint=f"`pmsmtool stop -n {self._node.node}`, then run the command again",
            )
        self._drive.parameters.settle()
        self._changed.begin()
        self._pole_pairs = self._drive.read("motor.pole_pairs")
        self._R_s_ohm = self._drive.read("motor.R_s_ohm")
        self._counts = encoder_counts(self._node)
        self._refuse_unwatched()
        self._limit_in_drive()
        self._drive.stops_by_ramp = False
        self.write(first or {})
        if prove:
            self.proof = prove_dead_man(self._drive, self._heartbeat)

    @property
    def refused_limits(self) -> tuple[str, ...]:
        """Limits that the drive does not let be lowered, one line each."""
        return self._limits.refused

    def _refuse_unwatched(self) -> None:
        """Refuse a limit that cannot be watched on this drive."""
        if math.isfinite(self.envelope.energy_j) and not self._R_s_ohm > 0.0:
            raise SafetyRefusal(
                f"the energy limit {self.envelope.energy_j:.4g} J cannot be watched: the resistance is not known",
                where=f"node {self._node.node}",
                likely="this drive has no object for the winding's resistance",
                hint="limit the current and the duration instead",
            )

    def _limit_in_drive(self) -> None:
        """Make the drive itself keep current and speed where it can."""
        clear_offsets(self._node)
        self._limits = lower_limits(self._drive, self.envelope)
        self._speed_overshoot = OVERSHOOT if self._limits.speed else 1.0
        if trips_itself(self._node):
            held = self._drive.read(OVER_SPEED_TRIP)
            self.write({OVER_SPEED_TRIP: lowered_trip(held, rpm_from_rad_s(self.envelope.speed_max_rad_s))})

    def stop(self) -> bool:
        """Stop and confirm it; a Ctrl-C meanwhile removes the voltage at once.

        Raises StopNotConfirmed: the drive does not confirm.

        Returns
        -------
        bool
            Whether there was a Ctrl-C meanwhile.
        """
        interrupted = False
        while self._drive.may_be_energised:
            try:
                self._drive.quick_stop()
            except KeyboardInterrupt:
                interrupted = True
                self._drive.disable_at_once()
        return interrupted

    @property
    def left(self) -> list[str]:
        """Addresses of changed objects that are not known to hold their old content again."""
        return self._changed.left

    def restore(self) -> int:
        """Bring every changed object back to what it held, read it back, end the heartbeat.

        Raises VerifyMismatch: an object does not hold its old content; each is named.

        Returns
        -------
        int
            Objects brought back.
        """
        self._ended = True
        self._drive.stops_by_ramp = True
        try:
            with self._node.emergencies_tolerated(), self._node.supervision.other_masters_tolerated():
                return self._changed.restore()
        finally:
            self._heartbeat.stop()

    # ---- the port -------------------------------------------------------------------------------

    @property
    def period_s(self) -> float:
        """Control period (s)."""
        return self._drive.period_s

    def read(self, name: str) -> float:
        """Return one parameter by catalogue name, in SI."""
        return self._drive.read(name)

    def live(self, name: str) -> float:
        """Return one live quantity."""
        self._look_when_due()
        return self._drive.live(name)

    def write(self, values: Mapping[str, float]) -> None:
        """Write parameters; they are restored when the guard ends."""
        if self._drive.stops_by_ramp and any(name.startswith(UNPROVEN_BY) for name in values):
            self._stop_without_ramp()
        self._drive.write(values)
        # speed and loss are judged with what the drive now takes for its motor
        self._pole_pairs = values.get("motor.pole_pairs", self._pole_pairs)
        self._R_s_ohm = values.get("motor.R_s_ohm", self._R_s_ohm)

    def limit_current(self, apk: float) -> float | None:
        """Lower the drive's own current limit (A peak), at most to the envelope's; return what it keeps.

        None where the drive has no limit that this could lower.
        """
        return put_limit(self._node, self._limits.current, apk, self._limits.most_apk)

    def limit_speed(self, rad_s: float) -> float | None:
        """Lower the drive's own speed limit (rad/s, mechanical), as :meth:`limit_current`; return what it keeps."""
        kept = put_limit(self._node, self._limits.speed, rpm_from_rad_s(rad_s), self._limits.most_rpm)
        return None if kept is None else rad_s_from_rpm(kept)

    def change(self, item: objects.DriveObject, data: bytes) -> None:
        """Write a gain that no map knows, while the voltage is off, and read it back; restored when the guard ends.

        From then on a stop removes the voltage: the speed loop is proven no more.

        Raises SafetyRefusal: the drive is not off, or does not hold what was written.
        """
        where = f"node {self._node.node}, 0x{item.index:04X}:{item.sub:02X}"
        if self._drive.may_be_energised or not is_safe(self._node.state()):
            raise SafetyRefusal("gains are changed only while the voltage is off", where=where, hint=_BUG)
        self._stop_without_ramp()
        self._node.write_bytes(item.index, item.sub, data)
        held = self._node.sdo.read(item.index, item.sub)
        if held != data:
            raise SafetyRefusal(
                f"the drive holds {held.hex(' ')}, not the {data.hex(' ')} that was written", where=where,
                likely="the drive limits the gain, or activates it later",
                hint="nothing is learned from this gain; it was restored",
            )  # fmt: skip

    def enable(self) -> None:
        """Bring the drive to operation enabled at zero reference, supervised by the tool's heartbeat.

        Raises SafetyRefusal: the dead-man was not proven, or the guard has ended; BusError: the heartbeat cannot be
        sent; nothing is enabled.
        """
        if self._ended:
            raise SafetyRefusal(
                "the guard has ended and the drive is restored, so nothing is enabled",
                where=f"node {self._node.node}",
                hint=_BUG,
            )
        if self.proof is None:
            raise SafetyRefusal(
                "the supervision was not tested, so nothing is enabled", where=f"node {self._node.node}",
                hint=_BUG,
            )  # fmt: skip
        self._heartbeat.resume()  # after the dead-man ended operation nobody else would watch
        self._drive.enable()
        self._looked_s = self._node.connection.clock.now()
        if self._start_rad is None:
            self._start_rad = self._drive.live("theta_m_rad")

    def disable(self) -> None:
        """Remove the voltage and confirm it."""
        self._drive.disable()

    def quick_stop(self) -> None:
        """Stop as fast as the drive can and confirm it; a Ctrl-C meanwhile is raised then."""
        if self.stop():
            raise KeyboardInterrupt

    def command_current(self, i_d_a: float, i_q_a: float, *, fixed_angle_rad: float | None = None) -> None:
        """Hold a current vector (A peak) within the envelope."""
        self._check("current", math.hypot(i_d_a, i_q_a), self.envelope.i_max_apk, "A")
        if fixed_angle_rad is None:
            self._check("d current", abs(i_d_a), self.envelope.i_d_max_apk, "A")
        self._asked_rad_s = 0.0
        self._drive.command_current(i_d_a, i_q_a, fixed_angle_rad=fixed_angle_rad)

    def command_speed(self, omega_m_rad_s: float) -> None:
        """Run at a mechanical speed (rad/s) within the envelope."""
        self._check("speed", abs(omega_m_rad_s), self.envelope.speed_max_rad_s, "rad/s")
        self._refuse_turning()
        self._asked_rad_s, self._kept_since_s = omega_m_rad_s, None
        self._drive.command_speed(omega_m_rad_s)

    def average(self, signals: Sequence[str], periods: int) -> Mapping[str, float]:
        """Return means over a window of control periods, taken inside the drive."""
        self._drive.recorder.start_average(signals, periods)
        self.wait(periods * self.period_s)
        means = self._drive.recorder.finish_average(signals)
        self._drive.check_operating()
        return means

    def halves(self, signals: Sequence[str], periods: int) -> Halves:
        """Return means over two windows, one right after the other."""
        return self._drive.recorder.halves(lambda count: self.average(signals, count), periods)

    def record(
        self,
        signals: Sequence[str],
        samples: int,
        *,
        decimation: int = 1,
        excitation: Excitation | None = None,
        pretrigger: int = 0,
    ) -> Trace:
        """Record signals, with an excitation whose abort limits are at most the envelope's."""
        within = None if excitation is None else self._within(excitation)
        return self._drive.take(Recording(signals, samples, decimation, within, pretrigger), self.wait)

    def record_move(self, signals: Sequence[str], samples: int, decimation: int, move: ProfileMove) -> Trace:
        """Move by the drive's own position loop and record it; the speed of the move is at most the envelope's."""
        turn = self._node.whole(objects.ENCODER_INCREMENTS)
        self._check("speed", 2.0 * math.pi * move.velocity / turn, self.envelope.speed_max_rad_s, "rad/s")
        self._refuse_turning()
        self._asked_rad_s, self._kept_since_s = 0.0, None
        return self._drive.take(Recording(signals, samples, decimation, move=move), self.wait)

    def wait(self, seconds: float) -> None:
        """Let time pass, looking at the machine in between."""
        clock = self._node.connection.clock
        end = clock.now() + seconds
        while True:
            left = end - clock.now()
            step = min(left, WATCH_S)
            self._drive.wait(max(step, 0.0))
            if self._drive.may_be_energised:
                self._watch()
            if left <= WATCH_S:
                return

    # ---- limits ---------------------------------------------------------------------------------

    def _within(self, excitation: Excitation) -> Excitation:
        """Check an excitation and return it with the envelope as its abort limits."""
        i_max = self.envelope.i_max_apk
        peak = (
            max(map(abs, excitation.buffer), default=0.0)
            if excitation.shape is Shape.BUFFER
            else abs(excitation.amplitude)
        )
        bias = math.hypot(excitation.bias_d_a, excitation.bias_q_a)
        if excitation.point in (Injection.I_D, Injection.I_Q):
            self._check("current", bias + peak, i_max, "A")
        else:
            self._check("current", bias, i_max, "A")
        if excitation.shape is Shape.HYSTERESIS:
            largest = math.hypot(abs(excitation.i_centre_d_a) + excitation.i_limit_d_a, excitation.i_limit_q_a)
            self._check("current", largest, i_max, "A")
            in_d = abs(excitation.i_centre_d_a) + excitation.i_limit_d_a
            self._check("d current", in_d, self.envelope.i_d_max_apk, "A")
        if excitation.point is Injection.SPEED:
            self._check("speed", peak, self.envelope.speed_max_rad_s, "rad/s")
            self._refuse_turning()
        speed = self._pole_pairs * self.envelope.speed_max_rad_s
        return replace(
            excitation,
            abort_current_apk=min(excitation.abort_current_apk or math.inf, OVERSHOOT * i_max),
            abort_speed_rad_s=min(excitation.abort_speed_rad_s or math.inf, OVERSHOOT * speed),
        )

    def _refuse_turning(self) -> None:
        if self.envelope.shaft == "locked":
            raise SafetyRefusal(
                "a speed is commanded, but --shaft locked is given",
                where=f"node {self._node.node}",
                hint="unlock the shaft and give --shaft free or coupled",
            )

    def _is_watched(self) -> bool:
        """Whether the machine is off, or was looked at a moment ago; asked by the heartbeat's thread.

        A transfer under way counts: its channel is busy, so that nothing else can be asked, and each of its frames
        shows that tool and drive are alive. It ends with its time-out.
        """
        if not self._drive.may_be_energised:
            return True
        latest = max(self._looked_s, self._node.sdo.active_s)
        return self._node.connection.clock.now() - latest <= FRESH_S

    def _look_when_due(self) -> None:
        """Look at the machine where time has passed since, whatever it passed with."""
        if self._drive.may_be_energised and self._node.connection.clock.now() - self._looked_s > WATCH_S:
            self._watch()

    def _watch(self) -> None:
        """Look at the machine once: still in operation, and every limit kept.

        Raises LimitExceeded, DriveFault: a limit is exceeded, after a confirmed stop; or the drive has left operation
        by itself.
        """
        self._drive.check_operating()
        current = self._current()
        now = self._node.connection.clock.now()
        seconds, self._looked_s = now - self._looked_s, now
        self.energised_s += seconds
        self.energy_j += 1.5 * self._R_s_ohm * current * current * seconds
        envelope = self.envelope
        omega = self._drive.live("omega_e_rad_s") / self._pole_pairs
        speed = abs(omega)
        checks = [
            ("current", current, OVERSHOOT * envelope.i_max_apk, "A"),
            ("speed", speed, self._speed_overshoot * envelope.speed_max_rad_s, "rad/s"),
            ("time energised", self.energised_s, envelope.duration_s, "s"),
            ("energy in the winding", self.energy_j, envelope.energy_j, "J"),
        ]
        travel = min(envelope.travel_rad, LOCKED_TRAVEL_RAD) if envelope.shaft == "locked" else envelope.travel_rad
        if not math.isinf(travel) and self._start_rad is not None:
            way = abs(self._drive.live("theta_m_rad") - self._start_rad)
            checks.append(("travel", way, travel, "rad"))
        for quantity, value, limit, unit in checks:
            if not value <= limit:  # a value that is no number keeps no limit
                self.stop()
                self._check(quantity, value, limit, unit)
        self._prove_speed_loop(omega)

    def _prove_speed_loop(self, omega_m_rad_s: float) -> None:
        """Allow the quick stop ramp once commanded speeds are kept: until then every stop removes the voltage."""
        if self._drive.stops_by_ramp or self._asked_rad_s == 0.0:
            return
        if abs(omega_m_rad_s - self._asked_rad_s) > KEPT_SHARE * abs(self._asked_rad_s):
            self._kept_since_s = None
            return
        if self._kept_since_s is None:
            self._kept_since_s = self._looked_s
        if self._looked_s - self._kept_since_s < KEPT_S:
            return
        before = self._changed.held_before(objects.QUICK_STOP_OPTION)
        if before is not None:
            set_quick_stop(self._node, int(before))
        self._drive.stops_by_ramp = True

    def _stop_without_ramp(self) -> None:
        self._drive.stops_by_ramp, self._kept_since_s = False, None
        set_quick_stop(self._node, QuickStop.DISABLE)

    def _current(self) -> float:
        """Return the length of the current vector (A) from two objects, which are read one after the other.

        Where the vector turns, two reads are not one vector: braking out of field weakening at the current limit,
        i_d gives way to i_q within some 10 ms, and a slow host saw 1.29 of the limit that was kept throughout. What
        seems too much is therefore judged with i_d read on either side of i_q, of which the smaller counts.
        """
        i_d, i_q = self._drive.live("i_d_a"), self._drive.live("i_q_a")
        if math.hypot(i_d, i_q) > OVERSHOOT * self.envelope.i_max_apk:
            i_d = min(abs(i_d), abs(self._drive.live("i_d_a")))
        return math.hypot(i_d, i_q)

    def _likely(self, quantity: str) -> str:
        if quantity == "travel" and self.envelope.shaft == "locked":
            return _TURNS
        if quantity == "current" and (few := few_counts(self._counts, self._pole_pairs)):
            return f"{few}, and the current follows; less speed makes that less (--speed-max)"
        return _OTHER_UNIT.get(quantity, "") if self._drive.commands_bounded_current else ""

    def _check(self, quantity: str, value: float, limit: float, unit: str) -> None:
        if not value <= limit * (1.0 + _ROUNDING):
            as_given, shown = _AS_GIVEN.get(unit, (float, unit))
            raise LimitExceeded(
                quantity,
                as_given(value),
                as_given(limit),
                shown,
                where=f"node {self._node.node}",
                likely=self._likely(quantity),
                hint=_NEXT_STEP.get(quantity, "ask for less"),
            )


@contextmanager
def guarded(
    drive: CanopenDrive,
    envelope: Envelope,
    *,
    prove: bool = True,
    first: Mapping[str, float] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Iterator[GuardedDrive]:
    """Lend a drive to an experiment, within an envelope.

    Parameters
    ----------
    drive : CanopenDrive
        The drive; off.
    envelope : Envelope
        Its limits.
    prove : bool
        Whether the dead-man is proven first; without it nothing may be enabled.
    first : mapping, optional
        Parameters that are written before anything is enabled, the dead-man's proof included.
    say : callable
        Told one line per step.

    Raises
    ------
    StopNotConfirmed
        The machine may be energised; outranks whatever ended the experiment.
    Interrupted
        Ctrl-C, after a confirmed stop and the restore.
    SafetyRefusal
        The dead-man could not be shown.
    ConfigError
        The user's folder cannot be written, where locks, journals and what is lent to a run are kept.
    """
    refuse_full(user_folder(), USER_ROOM, hint=ELSEWHERE)
    guard = GuardedDrive(drive, envelope)
    # A signal on the way into or out of the `with` block leaves this generator where it is: closing the node ends it.
    drive.node.before_close.append(lambda: _end(guard, say))
    interrupted = False
    try:
        try:
            guard.begin(prove=prove, first=first)
            for line in (*guard.refused_limits, *((str(guard.proof),) if guard.proof is not None else ())):
                say(line)
            yield guard
        except KeyboardInterrupt:
            interrupted = True
            say("interrupted: stopping the machine (Ctrl-C again removes the voltage at once)")
        finally:
            interrupted = guard.stop() or interrupted
    finally:
        interrupted = _end(guard, say) or interrupted
    if interrupted:
        raise Interrupted("the machine is stopped, voltage off, and the drive restored")


def _end(guard: GuardedDrive, say: Callable[[str], None]) -> bool:
    """Stop, restore and say so, once; return whether there was a Ctrl-C meanwhile."""
    if guard.over:
        return False
    try:
        # Again: a signal in the wrong microsecond may have ended the first stop. It does nothing when that succeeded.
        interrupted = guard.stop()
        with interrupts_deferred() as noted:
            count = _restored(guard)
            guard.over = True
    except PmsmtoolError:
        guard.over = True  # it is told what is left, and would fail again
        raise
    say(f"{RESTORED} ({count} objects)")
    return interrupted or bool(noted)


def _restored(guard: GuardedDrive) -> int:
    try:
        return guard.restore()
    except StopNotConfirmed:
        raise
    except (BusError, DriveFault) as error:
        raise _not_restored(error, guard.left) from error


def _not_restored(error: PmsmtoolError, left: list[str]) -> PmsmtoolError:
    named = f": {', '.join(left)} may hold values of this run until its next reset" if left else ""
    error.what = f"{error.what}; the machine is stopped, but the drive could not be restored{named}"
    error.args = (error.what,)
    error.hint = error.hint or "reset the drive: it comes back with what it has stored"
    return error
