"""Proof of the dead-man: the drive stops by itself when the tool dies.

Nothing moves before this was shown: consumer heartbeat 0x1016, abort connection option 0x6007 and
quick stop option 0x605A are read (and set where they say "do nothing"), the drive is enabled at
zero current, the tool's heartbeat is stopped, and operation must be left within the declared time.
"""

from __future__ import annotations

from dataclasses import dataclass

from pmsmtool.bus.sdo import Retry
from pmsmtool.cia402 import AbortConnection, QuickStop, State
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.heartbeat import TOOL_NODE, Heartbeat
from pmsmtool.errors import SafetyRefusal, SdoAbort

CONSUMER_MS = 250
"""Consumer heartbeat time set for the tool: five of its heartbeats."""
REACTION_S = 0.1
"""Beyond the consumer time: the drive's own reaction and one round of polling."""
_POLL_S = 0.005


@dataclass(frozen=True, slots=True)
class DeadManProof:
    """What was declared and what was measured.

    Attributes
    ----------
    consumer_s : float
        Consumer heartbeat time of the drive (s).
    declared_s : float
        Operation must be left within this time after the last heartbeat (s).
    measured_s : float
        Time it took (s).
    abort_connection, quick_stop : int
        Option codes 0x6007 and 0x605A in force.
    left_for : State
        State the drive went to.
    """

    consumer_s: float
    declared_s: float
    measured_s: float
    abort_connection: AbortConnection
    quick_stop: QuickStop
    left_for: State

    def __str__(self) -> str:
        return (
            f"dead-man proven: heartbeat stopped, operation left after {1000 * self.measured_s:.0f} ms "
            f"(declared {1000 * self.declared_s:.0f} ms), to {self.left_for.name.replace('_', ' ')}"
        )


def prove_dead_man(drive: CanopenDrive, heartbeat: Heartbeat) -> DeadManProof:
    """Show that the drive leaves operation when the heartbeat stops; it is disabled on return.

    Parameters
    ----------
    heartbeat : Heartbeat
        The tool's; it runs on return.

    Raises
    ------
    SafetyRefusal
        The drive has no heartbeat supervision, ignores it, or reacts too late.
    """
    node = drive.node
    _set_consumer(drive)
    abort_option = _abort_option(drive)
    quick_stop = QuickStop(node.whole(objects.QUICK_STOP_OPTION))
    heartbeat.start()
    with node.emergencies_tolerated():
        drive.enable()
        node.connection.wait(2e-3 * CONSUMER_MS)
        if node.state() is not State.OPERATION_ENABLED:
            drive.quick_stop()
            raise _refused("the drive leaves operation although the tool's heartbeat runs", drive)
        proof = _stop_and_measure(drive, heartbeat, abort_option, quick_stop)
        heartbeat.start()
        if node.state() in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            node.wait_for_state(lambda state: state is State.FAULT)
            node.reset_fault()
        drive.disable()
    return proof


def _stop_and_measure(
    drive: CanopenDrive, heartbeat: Heartbeat, abort_option: AbortConnection, quick_stop: QuickStop
) -> DeadManProof:
    clock = drive.node.connection.clock
    heartbeat.stop()
    stopped = clock.now()
    declared = 1e-3 * CONSUMER_MS + REACTION_S
    while True:
        state = drive.node.state()
        passed = clock.now() - stopped
        if state is not State.OPERATION_ENABLED and state is not None:
            return DeadManProof(1e-3 * CONSUMER_MS, declared, passed, abort_option, quick_stop, state)
        if passed > declared:
            drive.quick_stop()
            raise _refused(f"the drive is still enabled {1000 * declared:.0f} ms after the last heartbeat", drive)
        drive.node.connection.wait(_POLL_S)


def _set_consumer(drive: CanopenDrive) -> None:
    """Make the drive watch the tool's heartbeat, in its own entry of 0x1016 or a free one."""
    node = drive.node
    try:
        count = node.sdo.read(objects.CONSUMER_HEARTBEAT, 0, size=1)[0]
        entries = {
            sub: int.from_bytes(node.sdo.read(objects.CONSUMER_HEARTBEAT, sub, size=4), "little")
            for sub in range(1, count + 1)
        }
        free = [sub for sub, word in entries.items() if word >> 16 & 0xFF in (TOOL_NODE, 0)]
        if not free:
            raise _refused("all entries of the consumer heartbeat time are taken", drive)
        free.sort(key=lambda sub: entries[sub] >> 16 & 0xFF != TOOL_NODE)
        word = (TOOL_NODE << 16 | CONSUMER_MS).to_bytes(4, "little")
        node.write_bytes(objects.CONSUMER_HEARTBEAT, free[0], word)
    except SdoAbort as abort:
        raise _refused(
            "the drive has no consumer heartbeat (0x1016): it would not notice that the tool died", drive
        ) from abort


def _abort_option(drive: CanopenDrive) -> AbortConnection:
    node = drive.node
    try:
        option = node.whole(objects.ABORT_CONNECTION)
        if option == AbortConnection.NO_ACTION:
            node.put(objects.ABORT_CONNECTION, AbortConnection.QUICK_STOP, retry=Retry.READ_BACK)
            option = node.whole(objects.ABORT_CONNECTION)
    except SdoAbort as abort:
        raise _refused("the drive does not say what it does when the connection is lost (0x6007)", drive) from abort
    if option not in (AbortConnection.FAULT, AbortConnection.DISABLE_VOLTAGE, AbortConnection.QUICK_STOP):
        raise _refused(f"abort connection option code {option} does not stop the machine", drive)
    return AbortConnection(option)


def _refused(what: str, drive: CanopenDrive) -> SafetyRefusal:
    return SafetyRefusal(
        what,
        where=f"node {drive.node.node}",
        likely="the drive's firmware has no heartbeat supervision, or it is switched off",
        hint="nothing will be moved over this connection; use the drive's own commissioning over its panel",
    )
