"""Stopping a drive, confirmed from its statusword or said aloud that it is not."""

from __future__ import annotations

import contextlib

from pmsmtool.bus.supervision import NodeReset
from pmsmtool.cia402 import Command, QuickStop, State
from pmsmtool.drive import objects
from pmsmtool.drive.drive_node import STATE_TIMEOUT_S, DriveNode, is_safe
from pmsmtool.errors import BusError, DriveFault, PmsmtoolError, SdoAbort, StopNotConfirmed

STOP_MARGIN_S = 1.0
"""Beyond the time the deceleration ramp needs."""
STOP_TRIES = 4
"""A stop is asked for this often: each kind of alarm may end one attempt."""
STANDSTILL_MRPM = 5_000.0
"""Speed (thousandths of rpm) below which a drive that stays in quick stop counts as standing."""


def quick_stop(node: DriveNode, *, ramp: bool = True) -> State:
    """Quick stop, voltage off, references to zero; return the state the statusword then shows.

    Parameters
    ----------
    ramp : bool
        Whether the drive may brake by its quick stop ramp; without it the voltage is removed and the shaft coasts.

    Raises
    ------
    StopNotConfirmed
        The drive did not confirm; the machine may be energised.
    """
    failure: PmsmtoolError | None = None
    for _ in range(STOP_TRIES):
        try:
            with node.emergencies_tolerated(), node.supervision.other_masters_tolerated():
                return _stop_once(node, ramp=ramp)
        except StopNotConfirmed:
            raise
        except NodeReset as reset:
            failure = reset  # a drive that boots is off; the next round confirms it
        except (BusError, DriveFault) as error:
            failure = error
            with contextlib.suppress(BusError):
                disable_at_once(node)
    raise not_confirmed(node, failure.what if failure else "no answer") from failure


def disable(node: DriveNode) -> State:
    """Remove the voltage; return the state that confirms it.

    Raises
    ------
    StopNotConfirmed
        The statusword does not.
    """
    state = node.disable_voltage(STATE_TIMEOUT_S)
    if state is None or not is_safe(state):
        raise not_confirmed(node, f"the statusword still shows {state_text(state)}")
    return state


def disable_at_once(node: DriveNode) -> None:
    """Send the controlword that removes the voltage, without waiting for anything."""
    word = objects.CONTROLWORD
    node.sdo.post(word.index, word.sub, word.encode(Command.DISABLE_VOLTAGE))


def zero_references(node: DriveNode) -> None:
    """End an excitation and bring all references to zero; a drive without these objects needs none."""
    references = [objects.TARGET_VELOCITY_MRPM, objects.TARGET_TORQUE_PERMILLE]
    if node.map.staging and _is_maps_drive(node):  # 0x2050 and 0x2052 of another maker's drive are something else
        with contextlib.suppress(SdoAbort):
            node.command(objects.EXCITATION_COMMAND, 0)
        references = [objects.SET_POINT_D, objects.SET_POINT_Q, *references]
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
        hint="use the hardware stop (emergency stop, safe torque off, or mains), check cable and supply, then reset the"
        " drive: until then it may hold values of an interrupted run",
    )


def state_text(state: State | None) -> str:
    """Return a state as people write it."""
    return "an undefined state" if state is None else state.name.replace("_", " ")


def _stop_once(node: DriveNode, *, ramp: bool) -> State:
    state = node.state()
    if ramp and not is_safe(state):
        node.go(Command.QUICK_STOP)
        stays = node.whole(objects.QUICK_STOP_OPTION) >= QuickStop.SLOW_DOWN_AND_STAY if _has_option(node) else False
        node.wait_for_state(lambda now: _has_stopped(node, now, stays), _stop_time_s(node))
    state = disable(node)
    zero_references(node)
    return state


def _has_option(node: DriveNode) -> bool:
    return node.has(objects.QUICK_STOP_OPTION.index, objects.QUICK_STOP_OPTION.sub)


def _has_stopped(node: DriveNode, state: State | None, stays: bool) -> bool:
    if is_safe(state):
        return True
    return stays and state is State.QUICK_STOP_ACTIVE and abs(node.get(objects.VELOCITY_MRPM)) < STANDSTILL_MRPM


def _stop_time_s(node: DriveNode) -> float:
    """Time the ramp of 0x6085 needs from the present speed; the margin alone where the drive tells neither."""
    try:
        rpm = abs(node.get(objects.VELOCITY_MRPM)) / 1000.0
        return STOP_MARGIN_S + 2.0 * rpm / max(node.get(objects.QUICK_STOP_DECELERATION), 1.0)
    except SdoAbort:
        return STOP_MARGIN_S
