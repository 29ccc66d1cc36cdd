# SPDX-License-Identifier: MIT
"""Stopping a drive, confirmed from its statusword or said aloud that it is not; and Ctrl-C that waits.

Work that must not be left half done is finished first, within a time that is said.
"""

from __future__ import annotations

import contextlib
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from pmsmtool.bus.sdo import OutOfTime
from pmsmtool.bus.sdo_transfer import when_ready
from pmsmtool.bus.supervision import NodeReset
from pmsmtool.cia402 import Command, QuickStop, State, state_of
from pmsmtool.drive import objects
from pmsmtool.drive.drive_node import POLL_S, STATE_TIMEOUT_S, DriveNode, is_safe, state_text
from pmsmtool.drive.objects import LAST_AXIS, of_axis
from pmsmtool.drive_maps.drive_map import LETTERS
from pmsmtool.errors import BusError, DriveFault, PmsmtoolError, SdoAbort, StopNotConfirmed

STOP_MARGIN_S = 1.0
"""Beyond the time the deceleration ramp needs."""
SILENCE_S = 1.5
"""A drive without a valid answer for so long does not confirm any more; with all around it that takes 2 s."""
OWN_S = 0.2
"""What a stop has at least, of a drive that was silent before."""
RAMP_LIMIT_S = 60.0
"""No ramp is waited for longer: then the voltage is removed, whatever the drive reports about its speed."""
STALLED_S = 1.0
"""A speed that has not fallen for so long does not follow the ramp: the voltage is removed."""
ANSWERS_S = 8.0
"""Beyond the ramp: the states on the way and the references, of a drive that answers after retries."""
_HARDWARE_STOP = (
    "use the hardware stop (emergency stop, safe torque off, or mains), check cable and supply, then reset the drive:"
    " until then it may hold values of an interrupted run"
)
SPEED_PERIOD_S = 0.1
FALLEN = 0.995
"""A speed below this share of the lowest before has fallen."""
STOP_TRIES = 4
"""A stop is asked for this often: each kind of alarm may end one attempt."""
BUSY_S = 3.0
"""A drive that refuses because it is busy is asked again for so long."""
STANDSTILL_MRPM = 5_000.0
"""Speed (thousandths of rpm) below which a drive that stays in quick stop counts as standing."""


def quick_stop(node: DriveNode, *, ramp: bool = True, say: Callable[[str], None] = lambda text: None) -> State:
    """Quick stop, voltage off, references to zero; return the state the statusword then shows.

    A drive that answers has the time of its ramp; one that is silent for ``SILENCE_S`` ends the stop.

    Raises StopNotConfirmed: the drive did not confirm; the machine may be energised.

    Parameters
    ----------
    ramp : bool
        Whether the drive may brake by its quick stop ramp; without it the voltage is removed and the shaft coasts.
    say : callable
        Told how the speed falls.
    """
    failure: PmsmtoolError | None = None
    clock = node.connection.clock
    busy_until = clock.now() + BUSY_S

    def off_unheard() -> None:
        with contextlib.suppress(BusError):
            disable_at_once(node)

    with node.sdo.limited(silence_s=SILENCE_S, own_s=OWN_S, total_s=RAMP_LIMIT_S + ANSWERS_S):
        for _ in range(STOP_TRIES):
            try:
                with node.emergencies_tolerated(), node.supervision.other_masters_tolerated():
                    return when_ready(
                        node.connection, lambda: _stop_once(node, say, ramp=ramp), busy_until - clock.now(),
                        meanwhile=off_unheard,
                    )  # fmt: skip
            except StopNotConfirmed:
                raise
            except NodeReset as reset:
                failure = reset  # a drive that boots is off; the next round confirms it
            except (BusError, DriveFault) as error:
                failure = error
                off_unheard()
                if isinstance(error, OutOfTime):
                    break
    raise not_confirmed(node, failure.what if failure else "no answer") from failure


def disable(node: DriveNode) -> State:
    """Remove the voltage; return the state that confirms it. Raises StopNotConfirmed: the statusword does not."""
    try:
        state = node.disable_voltage(STATE_TIMEOUT_S)
    except SdoAbort:  # it takes no controlword: what its statusword shows counts
        state = node.state()
        if not is_safe(state):
            raise
    if state is None or not is_safe(state):
        raise not_confirmed(node, f"the statusword still shows {state_text(state)}")
    return state


def stop_other_axes(node: DriveNode) -> None:
    """Stop the further axes of a device that has several, each with its own controlword and statusword.

    Every other command of this program knows the first alone.

    Raises StopNotConfirmed: one may be energised.
    """
    for axis in range(2, LAST_AXIS + 1):
        control, status = (of_axis(item, axis) for item in (objects.CONTROLWORD, objects.STATUSWORD))
        shown: State | None = None
        try:
            with node.sdo.limited(silence_s=SILENCE_S, own_s=OWN_S, total_s=ANSWERS_S):
                word = node.held(status)
                if word is None:
                    return
                shown = state_of(int(word))
                for command in (Command.QUICK_STOP, Command.DISABLE_VOLTAGE):
                    if not is_safe(shown):
                        shown = _commanded(node, control, status, command)
        except (BusError, DriveFault) as error:
            if axis == 2 and shown is None:  # nothing says that there is a second one
                return
            raise not_confirmed(node, f"axis {axis}: {error.what}") from error
        if not is_safe(shown):
            raise not_confirmed(node, f"axis {axis} shows {state_text(shown)} (0x{status.index:04X})")


def _commanded(
    node: DriveNode, control: objects.DriveObject, status: objects.DriveObject, command: Command
) -> State | None:
    """Give an axis a command, wait until it is safe or does not become so; return its state."""
    clock = node.connection.clock
    with contextlib.suppress(SdoAbort):
        node.command(control, command)
    deadline_s = clock.now() + STATE_TIMEOUT_S
    shown = state_of(node.whole(status))
    while not is_safe(shown) and clock.now() < deadline_s:
        node.connection.wait(POLL_S)
        shown = state_of(node.whole(status))
    return shown


def ask_at_once(node: DriveNode) -> None:
    """Send the controlword of the quick stop without waiting for anything: each of several drives begins to brake."""
    word = node.typed(objects.CONTROLWORD)
    node.sdo.post(word.index, word.sub, word.encode(Command.QUICK_STOP))


def disable_at_once(node: DriveNode) -> None:
    """Send the controlword that removes the voltage, without waiting for anything."""
    word = node.typed(objects.CONTROLWORD)
    node.sdo.post(word.index, word.sub, word.encode(Command.DISABLE_VOLTAGE))


def zero_references(node: DriveNode) -> None:
    """End an excitation and bring all references to zero; a drive without these objects needs none."""
    references = [objects.TARGET_VELOCITY_MRPM, objects.TARGET_TORQUE_PERMILLE]
    if node.map.staging and _is_maps_drive(node):  # 0x2050 and 0x2052 of another maker's drive are something else
        with contextlib.suppress(SdoAbort):
            node.command(objects.EXCITATION_COMMAND, 0)
        references = [objects.SET_POINT_D, objects.SET_POINT_Q, *references]
    own = node.map.motion.get("target_current")
    if own is not None and _is_maps_drive(node):
        references.append(objects.DriveObject(own.index, own.sub, LETTERS[own.wire]))
    for reference in references:
        with contextlib.suppress(SdoAbort):
            if node.get(reference) != 0.0:
                node.put(reference, 0.0)


def _is_maps_drive(node: DriveNode) -> bool:
    """Whether the drive is of the maker its map is for; a map may be a mere default."""
    try:
        return int.from_bytes(node.sdo.read(objects.IDENTITY, 1, size=4), "little") == node.map.vendor
    except SdoAbort:
        return False


def not_confirmed(node: DriveNode, why: str) -> StopNotConfirmed:
    """Return the error that outranks all others."""
    return StopNotConfirmed(
        f"the drive did not confirm that it stopped ({why}): the machine may be energised",
        where=f"node {node.node}, 0x6041:00",
        likely="the bus or the drive does not answer; its heartbeat supervision stops it if that was set",
        hint=_HARDWARE_STOP,
    )


def nobody_confirms(why: str, likely: str) -> StopNotConfirmed:
    """Return the error of a stop that reached no drive at all."""
    return StopNotConfirmed(
        f"no stop was confirmed ({why}): the machine may be energised", likely=likely, hint=_HARDWARE_STOP
    )


def _stop_once(node: DriveNode, say: Callable[[str], None], *, ramp: bool) -> State:
    state = node.state()
    if ramp and not is_safe(state):
        node.go(Command.QUICK_STOP)
        option = _option(node)
        stays = option is not None and option.stays
        ramp_s = _ramp_s(node, option)
        if ramp_s > STOP_MARGIN_S:
            say(f"braking, up to {ramp_s:.0f} s")
        falling = _Falling(node, say)
        node.wait_for_state(lambda now: _has_stopped(node, now, stays) or falling.stalled(), STOP_MARGIN_S + ramp_s)
    state = disable(node)
    zero_references(node)
    return state


def _option(node: DriveNode) -> QuickStop | None:
    """Return the quick stop option; None where the drive has none, or one of its maker's own."""
    with contextlib.suppress(SdoAbort, ValueError):
        held = node.held(objects.QUICK_STOP_OPTION)
        return None if held is None else QuickStop(int(held))
    return None


def _has_stopped(node: DriveNode, state: State | None, stays: bool) -> bool:
    if is_safe(state):
        return True
    return stays and state is State.QUICK_STOP_ACTIVE and abs(node.get(objects.VELOCITY_MRPM)) < STANDSTILL_MRPM


def _ramp_s(node: DriveNode, option: QuickStop | None) -> float:
    """Twice the time its ramp (0x6085, or 0x6084) needs from the present speed; 0 where the drive tells neither."""
    slow = option in (QuickStop.SLOW_DOWN, QuickStop.SLOW_DOWN_AND_STAY)
    ramp = objects.PROFILE_DECELERATION if slow else objects.QUICK_STOP_DECELERATION
    try:
        rpm = abs(node.get(objects.VELOCITY_MRPM)) / 1000.0
        return min(2.0 * rpm / max(node.get(ramp), 1.0), RAMP_LIMIT_S)
    except SdoAbort:
        return 0.0


class _Falling:
    """Watches the speed while a drive brakes."""

    def __init__(self, node: DriveNode, say: Callable[[str], None]) -> None:
        self._node = node
        self._say = say
        self._lowest = math.inf
        self._since_s = self._read_s = node.connection.clock.now()

    def stalled(self) -> bool:
        """Whether the speed has not fallen for ``STALLED_S``; not where the drive shows none, or stands."""
        now = self._node.connection.clock.now()
        if now - self._read_s < SPEED_PERIOD_S:
            return False
        self._read_s = now
        try:
            speed = abs(self._node.get(objects.VELOCITY_MRPM))
        except SdoAbort:
            return False
        self._say(f"braking, {speed / 1000.0:.0f} rpm")
        if speed < min(FALLEN * self._lowest, self._lowest - 1.0):
            self._lowest, self._since_s = speed, now
        return speed >= STANDSTILL_MRPM and now - self._since_s > STALLED_S


_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name))
LONGEST_S = 60.0
"""After this a Ctrl-C acts again, whatever hangs; a store takes 20 s at most, reading a set again 2 s at 500 kbit/s."""


@contextmanager
def interrupts_deferred(say: Callable[[str], None] | None = None, work: str = "") -> Iterator[list[int]]:
    """Collect signals that would interrupt; yields the list they are noted in.

    Outside the main thread nothing is delivered anyway, and nothing is changed; ignored signals stay ignored.

    Parameters
    ----------
    say : callable, optional
        Told at every signal what is finished first, and within which time; from ``LONGEST_S`` on signals act again.
    work : str
        What is finished first.
    """
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return
    began = time.monotonic()
    previous: dict[int, Any] = {}

    def note(number: int, frame: FrameType | None) -> None:
        left = LONGEST_S - (time.monotonic() - began)
        if say is not None and left <= 0.0:
            handler = previous[number]
            if not callable(handler):
                raise KeyboardInterrupt
            handler(number, frame)
            return
        noted.append(number)
        if say is not None:
            with contextlib.suppress(RuntimeError):  # the signal came while this very stream was written
                say(f"interrupted: {work} is finished first, within {left:.0f} s; after that Ctrl-C ends it")

    try:
        for number in _SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                previous[number] = signal.getsignal(number)
                signal.signal(number, note)
        yield noted
    finally:
        for number, handler in previous.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
