# SPDX-License-Identifier: MIT
"""The drive port over CANopen: CiA 402 for states and modes, the reference drive's objects for the rest."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.connection import Connection
from pmsmtool.cia402 import Command, Mode, State
from pmsmtool.drive import objects, stop
from pmsmtool.drive.drive_node import DriveNode, is_safe, state_text
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.drive.port import Excitation, Halves, Injection, ProfileMove, Recording, Shape
from pmsmtool.drive.recorders.reference import Recorder
from pmsmtool.drive.set_point import POSITION_DEMAND, start_move
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.errors import ConfigError, DriveFault, NotAvailable, SdoAbort
from pmsmtool.params.catalogue import BY_NAME
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.trace import Trace
from pmsmtool.units import RAD_S_PER_MRPM

PERIOD = "inverter.T_s_ns"
"""The reference drive counts speed in thousandths of a mechanical revolution per minute."""
MODE_S, MODE_LOOK_S = 0.5, 0.005
"""Longest time until a drive shows the mode that it took, and the time between two looks."""
HELD_S = 0.2
"""The position loop holds the shaft this long before a move that is recorded."""


class CanopenDrive:
    """A drive on a CANopen bus; implements ``drive.port.Drive``.

    Parameters
    ----------
    connection : Connection
        The bus.
    node_id : int
        The drive's node id.
    drive_map : DriveMap, optional
        Which object holds which parameter.

    Attributes
    ----------
    node : DriveNode
        The node beneath, for what the port does not have.
    identity : Identity
        As read when the drive was opened.
    period_s : float
        Control period (s); follows the parameter.
    recorder : Recorder
        Traces and averages.
    may_be_energised : bool
        From an attempt to enable until a confirmed stop.
    stops_by_ramp : bool
        Whether a stop may use the drive's quick stop ramp, which runs its speed loop; else it removes the voltage.
    commands_bounded_current : bool
        Whether every command is a current that this program bounds, so that it may replace a limit the drive lacks.
    shows_apk : float
        Largest current that the object holds by which the guard sees it (A peak).
    """

    stops_by_ramp = True
    commands_bounded_current = False
    shows_apk = math.inf

    def __init__(self, connection: Connection, node_id: int, *, drive_map: DriveMap | None = None) -> None:
        self.node = DriveNode(connection, node_id, drive_map=drive_map)
        self.parameters = DriveParameters(self.node)
        self.may_be_energised = False
        self.identity = self.node.identity()
        self.period_s = self._control_period_s()
        self.recorder = Recorder(self.node, self.period_s)

    def _control_period_s(self) -> float:
        return 1e-9 * self.parameters.read_value(PERIOD)

    def close(self) -> None:
        """Stop listening to the drive."""
        self.node.close()

    # ---- parameters and live values -------------------------------------------------------------

    def read(self, name: str) -> float:
        """Return one parameter by catalogue name, in SI."""
        return self.parameters.read_value(name)

    def live(self, name: str) -> float:
        """Return one live quantity by its name in ``objects.LIVE``."""
        return self.node.get(objects.LIVE[name])

    def write(self, values: Mapping[str, float]) -> None:
        """Write parameters and read them back: together while the drive is off, live gains while it is enabled.

        Raises
        ------
        NotAvailable
            The drive has no object for one of them.
        ConfigError
            A value is out of bounds.
        DriveFault
            The drive is enabled and a parameter is not live, or it refuses a value.
        """
        wanted = ParameterSet(values)
        missing = self.node.map.missing(wanted)
        if missing:
            raise NotAvailable(f"the drive has no object for {', '.join(missing)}", where=f"node {self.node.node}")
        violations = wanted.violations()
        if violations:
            raise ConfigError(
                "values cannot be written",
                violations=violations,
                hint="`pmsmtool param help NAME` shows a parameter's bounds",
            )
        new = self.node.map.encode(wanted)
        old = self.parameters.read(new)
        changed = {name: data for name, data in new.items() if data != old[name]}
        if not changed:
            return
        if is_safe(self.node.state()):
            self.replace(changed)
            return
        fixed = [name for name in changed if not BY_NAME[name].live]
        if fixed:
            raise DriveFault(
                f"{', '.join(fixed)} cannot change while the drive is enabled",
                where=f"node {self.node.node}",
                hint="disable the drive first",
            )
        self.parameters.write_live(changed)

    def replace(self, changed: Mapping[str, bytes]) -> None:
        """Write contents by name while the drive is off, and read them back."""
        self.parameters.replace(changed)
        if PERIOD in changed:
            self.period_s = self._control_period_s()

    # ---- states ---------------------------------------------------------------------------------

    def enable(self) -> None:
        """Bring the drive to operation enabled at zero reference, in the identification mode."""
        stop.zero_references(self.node)
        self._energise(Mode.IDENTIFICATION)

    def disable(self) -> None:
        """Remove the voltage; returns when the statusword confirms it, else ``StopNotConfirmed``."""
        stop.disable(self.node)
        self.may_be_energised = False

    def quick_stop(self) -> None:
        """Quick stop, voltage off, zero references, confirmed from the statusword, else ``StopNotConfirmed``."""
        stop.quick_stop(self.node, ramp=self.stops_by_ramp)
        self.may_be_energised = False

    def disable_at_once(self) -> None:
        """Send the controlword that removes the voltage, without waiting for anything."""
        stop.disable_at_once(self.node)

    # ---- references -----------------------------------------------------------------------------

    def command_current(self, i_d_a: float, i_q_a: float, *, fixed_angle_rad: float | None = None) -> None:
        """Hold a current vector (A peak), in the rotor frame or at a fixed electrical angle."""
        self._set_mode(Mode.IDENTIFICATION)
        # The angle first: turning the frame under a flowing current would be a jump.
        self.node.put(objects.SET_POINT_ANGLE, objects.FOLLOW_ROTOR if fixed_angle_rad is None else fixed_angle_rad)
        self.node.put(objects.SET_POINT_D, i_d_a)
        self.node.put(objects.SET_POINT_Q, i_q_a)

    def command_speed(self, omega_m_rad_s: float) -> None:
        """Run at a mechanical speed (rad/s)."""
        self.node.put(objects.TARGET_VELOCITY_MRPM, omega_m_rad_s / RAD_S_PER_MRPM)
        self._set_mode(Mode.PROFILE_VELOCITY)

    def _energise(self, mode: int) -> None:
        """Bring the drive to operation enabled in a mode of operation.

        Raises NotAvailable: as :meth:`_set_mode`; in another mode than before it was enabled it is off again.
        """
        self._set_mode(mode)
        self.may_be_energised = True
        self.node.enable()
        if (shown := self._shown_mode()) not in (None, mode):
            self.disable()
            raise self._other_mode(mode, shown, "once enabled, the drive changes to")

    def _set_mode(self, mode: int) -> None:
        """Ask for a mode of operation, and go on when the drive shows it (0x6061), or shows none at all.

        Raises NotAvailable: the drive refuses the mode, or stays in another one.
        """
        if self._shown_mode() == mode:
            return
        try:
            self._ask_for_mode(mode)
        except SdoAbort as abort:
            untuned = (
                "the loop of this mode has no gains yet: `tune` and `flash-params` give it some; or the drive takes a "
                "mode in other states only"
            )
            raise NotAvailable(
                f"the drive has no mode of operation{_mode_name(mode)} ({int(mode)})",
                where=f"node {self.node.node}, 0x6060:00",
                likely=untuned if abort.code == AbortCode.DEVICE_STATE else "",
                hint="`pmsmtool caps` lists what this drive can measure",
            ) from abort
        clock = self.node.connection.clock
        end = clock.now() + MODE_S
        while (shown := self._shown_mode()) not in (None, mode):
            if clock.now() >= end:
                raise self._other_mode(mode, shown, "the drive stays in")
            self.node.connection.wait(MODE_LOOK_S)

    def _ask_for_mode(self, mode: int) -> None:
        """Write a mode; some drives take it from READY TO SWITCH ON onwards, where there is no voltage yet."""
        try:
            self.node.put(objects.MODE, mode)
        except SdoAbort as abort:
            if abort.code != AbortCode.DEVICE_STATE or self.node.state() is not State.SWITCH_ON_DISABLED:
                raise
            self.node.go(Command.SHUTDOWN)
            self.node.wait_for_state(lambda now: now is not State.SWITCH_ON_DISABLED)
            self.node.put(objects.MODE, mode)

    def _other_mode(self, mode: int, shown: int, does: str) -> NotAvailable:
        return NotAvailable(
            f"{does} mode of operation{_mode_name(shown)} ({shown}), though{_mode_name(mode)} "
            f"({int(mode)}) was asked for and taken", where=f"node {self.node.node}, 0x6061:00",
            likely="the mode needs an option of the drive, or another source of commands is set in it",
            hint="choose the source and the mode with the maker's tool; `pmsmtool caps` lists what this drive "
            "can measure",
        )  # fmt: skip

    def _shown_mode(self) -> int | None:
        try:
            return self.node.whole(objects.MODE_DISPLAY)
        except SdoAbort:  # an object that the standard asks for; whoever lacks it is taken at its word
            return None

    # ---- measurements ---------------------------------------------------------------------------

    def average(self, signals: Sequence[str], periods: int) -> Mapping[str, float]:
        """Return means over a window of control periods, taken inside the drive."""
        self.recorder.start_average(signals, periods)
        self.wait(periods * self.period_s)
        means = self.recorder.finish_average(signals)
        self.check_operating()
        return means

    def halves(self, signals: Sequence[str], periods: int) -> Halves:
        """Return means over two windows, one right after the other."""
        return self.recorder.halves(lambda count: self.average(signals, count), periods)

    def record(
        self,
        signals: Sequence[str],
        samples: int,
        *,
        decimation: int = 1,
        excitation: Excitation | None = None,
        pretrigger: int = 0,
    ) -> Trace:
        """Record signals every ``decimation`` periods, starting with the excitation if there is one.

        Raises NotAvailable: more signals or samples than the recorder holds; DriveFault: the drive tripped, or the
        excitation left its abort limits.
        """
        return self.take(Recording(signals, samples, decimation, excitation, pretrigger), self.wait)

    def take(self, recording: Recording, wait: Callable[[float], None]) -> Trace:
        """Prepare, begin and finish a record; ``wait`` lets time pass. An excitation ends however this ends.

        A buffer is played to its end, also where it is longer than the record: so a speed comes back by its levels.
        """
        excitation = recording.excitation
        if excitation is not None:
            self.prepare(excitation)
        try:
            self.begin_record(recording, wait)
            wait(max(recording.samples * recording.decimation, _buffer_periods(excitation)) * self.period_s)
            return self.finish_record(recording)
        finally:
            if excitation is not None:
                self.end_excitation()

    def end_excitation(self) -> None:
        """End an excitation, whether it runs or not."""
        self.node.command(objects.EXCITATION_COMMAND, 0)

    def prepare(self, excitation: Excitation) -> None:
        """Write the fields of an excitation; nothing moves yet."""
        for name, item in objects.EXCITATION_FIELDS.items():
            value = getattr(excitation, name)
            self.node.put(item, objects.FOLLOW_ROTOR if value is None else value)
        if excitation.shape is Shape.BUFFER:
            data = b"".join(objects.DriveObject(0, 0, "f").encode(value) for value in excitation.buffer)
            self.node.write_bytes(*objects.EXCITATION_BUFFER, data)

    def begin_record(self, recording: Recording, wait: Callable[[float], None]) -> None:
        """Start the (prepared) excitation and the recorder, in the order its ``lead_s`` asks for."""
        if recording.move is not None:
            self._begin_move(recording, recording.move, wait)
            return
        excitation, decimation, pretrigger = recording.excitation, recording.decimation, recording.pretrigger
        lead_s = 0.0 if excitation is None else excitation.lead_s
        in_current_mode = excitation is not None and excitation.point is not Injection.SPEED
        if lead_s > 0.0:
            if in_current_mode:
                self._set_mode(Mode.IDENTIFICATION)
            self.node.command(objects.EXCITATION_COMMAND, 2)
            wait(lead_s)
        at_start = excitation is not None and lead_s <= 0.0
        self.recorder.arm(recording.signals, recording.samples, decimation, pretrigger, at_excitation=at_start)
        if at_start:
            if in_current_mode:  # not before: a shaft that turned under speed control coasts from here on
                self._set_mode(Mode.IDENTIFICATION)
            wait(pretrigger * decimation * self.period_s)
            self.node.command(objects.EXCITATION_COMMAND, 2)

    def _begin_move(self, recording: Recording, move: ProfileMove, wait: Callable[[float], None]) -> None:
        for item, value in (
            (objects.PROFILE_VELOCITY, move.velocity),
            (objects.PROFILE_ACCELERATION, move.acceleration),
            (objects.PROFILE_DECELERATION, move.acceleration),
            (objects.PROFILE_JERK, move.jerk),
        ):
            self.node.put(item, value)
        self._set_mode(Mode.PROFILE_POSITION)
        wait(HELD_S)
        self.recorder.arm(
            recording.signals, recording.samples, recording.decimation, 0, at_excitation=False, at_move=True
        )  # fmt: skip
        start_move(self.node, self.node.get(POSITION_DEMAND) + move.way)

    def finish_record(self, recording: Recording) -> Trace:
        """Wait until the recorder is complete and return its trace, if the drive did not trip meanwhile."""
        trace = self.recorder.fetch(recording.signals, recording.decimation)
        self.check_operating()
        if recording.excitation is None:
            return trace
        return replace(trace, meta={**trace.meta, "excitation": _excitation_facts(recording.excitation)})

    def check_operating(self) -> None:
        """Make sure that a machine that was enabled still is: what a stopped one shows is no measurement.

        Raises DriveFault: the drive tripped, or left operation by itself.
        """
        if not self.may_be_energised:
            return
        state = self.node.state()
        if state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            raise self.node.fault_error()
        if state is not State.OPERATION_ENABLED:
            raise DriveFault(
                f"the drive left operation during a measurement: it is in {state_text(state)}",
                where=f"node {self.node.node}",
                likely="its safe torque off (STO) or enable input opened, it missed the tool's heartbeat because this "
                "computer or the bus was busy, or another program stopped it",
                hint="run the command again; nothing of this measurement was used",
            )

    def wait(self, seconds: float) -> None:
        """Let time pass on the bus clock; an alarm of the drive ends it."""
        self.node.connection.wait(seconds)
        self.node.supervision.check()


def _mode_name(mode: int) -> str:
    return f" {Mode(mode).name.lower().replace('_', ' ')}" if mode in set(Mode) else ""


def _buffer_periods(excitation: Excitation | None) -> int:
    """Return how many control periods the buffer of an excitation takes, 0 without one."""
    return 0 if excitation is None else len(excitation.buffer) * excitation.hold_periods


def _excitation_facts(excitation: Excitation) -> dict[str, object]:
    """Return an excitation as JSON-serialisable facts."""
    facts: dict[str, object] = {name: getattr(excitation, name) for name in objects.EXCITATION_FIELDS}
    facts |= {"shape": excitation.shape.name.lower(), "point": excitation.point.name.lower()}
    return {**facts, "buffer": list(excitation.buffer), "lead_s": excitation.lead_s}
