# SPDX-License-Identifier: MIT
"""Proof of the dead-man: the drive stops by itself when the tool dies.

Nothing moves before this was shown: the consumer heartbeat time 0x1016 is set, node guarding (0x100C, 0x100D) where
that cannot be, or the time within which a PDO is expected (0x1400:05) where that is missing, too; abort connection
option 0x6007 and quick stop option 0x605A are set to remove the voltage where the drive has them and takes that (a ramp
runs a speed loop which nobody has proven yet), the drive is enabled at zero current, the tool's heartbeat is stopped,
and the voltage must be off within the declared time: by the state, as bit 4 of the statusword shows the supply, not the
power stage (CiA 402-2).
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.nmt import HEARTBEAT_ID, TOOL_NODE, NmtCommand, NmtState, send_nmt
from pmsmtool.cia402 import AbortConnection, FaultReaction, QuickStop, State
from pmsmtool.drive import objects
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import DriveNode, is_safe, state_text
from pmsmtool.drive.heartbeat import PERIOD_S, Heartbeat, expect_pdo
from pmsmtool.drive.objects import DriveObject
from pmsmtool.errors import BusError, SafetyRefusal, SdoAbort

CONSUMER_MS = 250
"""Consumer heartbeat time set for the tool: five of its heartbeats."""
REACTION_S = 0.1
"""Beyond the consumer time: the drive's own reaction and one round of polling."""
TRIES = 3
"""Where the computer stalled meanwhile, nothing is shown, and it is tried again."""
LATE_S = 0.5e-3 * CONSUMER_MS
"""A tool's heartbeat later than this is the computer's fault, not the drive's."""
ROUND_S = 0.02
"""Polling once takes at most this long; measured 5.4 to 14 ms over socketcand."""
STALLED_S = 0.05
"""Polling that took longer than it should by more than this, in all, measures nothing."""
ANSWER_S = 0.2
"""A remote frame is answered within this time: a round trip takes milliseconds."""
ABSENT = (AbortCode.NO_OBJECT, AbortCode.NO_SUBINDEX)
NO_CONSUMER = "the drive has no consumer heartbeat (0x1016)"
_POLL_S = 0.005
_STOPPING = (AbortConnection.FAULT, AbortConnection.DISABLE_VOLTAGE, AbortConnection.QUICK_STOP)


@dataclass(frozen=True, slots=True)
class DeadManProof:
    """What was declared and what was measured."""

    declared_s: float
    """The voltage must be off within this time after the last heartbeat (s)."""
    measured_s: float
    """Time it took (s)."""
    abort_connection: AbortConnection | None
    """Option code 0x6007 in force; None where the drive has none: what it does was seen, not asked."""
    quick_stop: int | None
    """Option code 0x605A in force; None where the drive has none."""
    left_for: State
    """State the drive went to."""
    by: str = "heartbeat"
    """What stopped: the tool's ``heartbeat``, its ``node guarding``, or its ``process data``."""

    def __str__(self) -> str:
        return (
            f"supervision tested: {self.by} stopped, voltage off after {1000 * self.measured_s:.0f} ms "
            f"(declared {1000 * self.declared_s:.0f} ms), to {self.left_for.name.replace('_', ' ')}"
        )


@dataclass(slots=True)
class _Late:
    """What kept a try from measuring."""

    own_s: float = 0.0
    """By how much this computer woke later than it wanted to, at most (s)."""
    answer_s: float = 0.0
    """Longest time between a question and its answer (s)."""

    def note(self, wanted_s: float, began_s: float, asked_s: float, answered_s: float) -> None:
        """Take a pause that should have taken a time (s), and the question behind it: began, asked, answered (s)."""
        self.own_s = max(self.own_s, asked_s - began_s - wanted_s)
        self.answer_s = max(self.answer_s, answered_s - asked_s)

    def refusal(self, node: int) -> SafetyRefusal:
        """Return what ends the proof: the computer where it was late by itself, else the answers."""
        busy = self.own_s > ROUND_S
        return SafetyRefusal(
            f"the supervision could not be tested in {TRIES} tries: an answer took up to {1e3 * self.answer_s:.0f} ms, "
            f"and this computer was up to {1e3 * self.own_s:.0f} ms late by itself",
            where=f"node {node}",
            likely="other programs keep the tool from running, so its heartbeat stays away" if busy
            else "the drive, the adapter or the bus is slow: this computer is not",
            hint=f"{'end them' if busy else 'use another adapter or a faster bit rate, end other traffic'}, then run "
            "the command again; nothing was moved",
        )  # fmt: skip


def prove_dead_man(drive: CanopenDrive, heartbeat: Heartbeat) -> DeadManProof:
    """Show that the drive leaves operation when the heartbeat stops; it is disabled on return.

    Raises SafetyRefusal: the drive has no supervision, ignores it, or reacts too late; or computer or answers are too
    late to show it.

    Parameters
    ----------
    heartbeat : Heartbeat
        The tool's; it runs on return.
    """
    node = drive.node
    lacking = _set_consumer(drive)
    if lacking and not (_set_guarding(drive, heartbeat) or _set_process_data(drive, heartbeat)):
        raise _refused(
            f"{lacking}; there is no node guarding (0x100C, 0x100D), and the drive expects no process data "
            "(0x1400:05): it would not notice that the tool died", drive,
        )  # fmt: skip
    abort_option = _abort_option(drive)
    quick_stop = set_quick_stop(node, QuickStop.DISABLE)
    if abort_option in (None, AbortConnection.FAULT):
        _fault_without_ramp(node)
    late = _Late()
    with node.emergencies_tolerated():
        for _ in range(TRIES):
            proof = _try(drive, heartbeat, abort_option, quick_stop, late)
            heartbeat.start()
            if node.state() in (State.FAULT, State.FAULT_REACTION_ACTIVE):
                node.wait_for_state(lambda state: state is State.FAULT)
                node.reset_fault()
            drive.disable()
            if proof is not None:
                return proof
    raise late.refusal(node.node)


def _try(
    drive: CanopenDrive,
    heartbeat: Heartbeat,
    abort_option: AbortConnection | None,
    quick_stop: int | None,
    late: _Late,
) -> DeadManProof | None:
    """Enable, stop the heartbeat and measure; None where computer or answers stalled, so that nothing is shown."""
    node, clock = drive.node, drive.node.connection.clock
    heartbeat.start()
    drive.enable()
    for _ in range(round(2e-3 * CONSUMER_MS / PERIOD_S)):  # asked meanwhile: the heartbeat is sent while it is watched
        began = clock.now()
        node.connection.wait(PERIOD_S)
        asked = clock.now()
        state = node.state()
        late.note(PERIOD_S, began, asked, clock.now())
    if state is not State.OPERATION_ENABLED:
        stayed_away = heartbeat.longest_gap_s() > LATE_S
        heartbeat.stop()
        drive.quick_stop()
        if stayed_away:
            return None
        raise _refused("the drive leaves operation although the tool's heartbeat runs", drive)
    return _stop_and_measure(drive, heartbeat, abort_option, quick_stop, late)


def _stop_and_measure(
    drive: CanopenDrive,
    heartbeat: Heartbeat,
    abort_option: AbortConnection | None,
    quick_stop: int | None,
    late: _Late,
) -> DeadManProof | None:
    clock = drive.node.connection.clock
    stopped = clock.now()
    heartbeat.stop()
    if heartbeat.longest_gap_s() > LATE_S:
        drive.quick_stop()
        return None
    declared = 1e-3 * CONSUMER_MS + REACTION_S
    passed = stalled = 0.0
    while True:
        # A state is as old as its question: an answer that took long says nothing about the time it came.
        before, asked = passed, clock.now() - stopped
        state = drive.node.state()
        passed = clock.now() - stopped
        stalled += max(0.0, passed - before - ROUND_S)
        late.note(_POLL_S if before else asked, before, asked, passed)
        off = is_safe(state)
        if state is not None and off and passed <= declared:
            return DeadManProof(declared, passed, abort_option, quick_stop, state, heartbeat.kind)
        if off or asked > declared:
            if not off:
                drive.quick_stop()
            if stalled > STALLED_S:
                return None
            what = (
                "the drive was still enabled"
                if state is State.OPERATION_ENABLED or off
                else (f"the drive had left operation for {state_text(state)}, but was still energised,")
            )
            raise _refused(f"{what} {1000 * declared:.0f} ms after the last heartbeat", drive)
        drive.node.connection.wait(_POLL_S)


def _set_consumer(drive: CanopenDrive) -> str:
    """Make the drive watch the tool's heartbeat, in its own entry of 0x1016 or a free one.

    Returns
    -------
    str
        Why it does not; empty where it does.
    """
    node = drive.node
    word = (TOOL_NODE << 16 | CONSUMER_MS).to_bytes(4, "little")
    try:
        count = node.sdo.read(objects.CONSUMER_HEARTBEAT, 0, size=1)[0]
        held = {sub: node.held(DriveObject(objects.CONSUMER_HEARTBEAT, sub, "I")) for sub in range(1, count + 1)}
        entries = {sub: int(word) for sub, word in held.items() if word is not None}  # some count more than they have
        if not entries:
            return NO_CONSUMER
        free = [sub for sub, word in entries.items() if word >> 16 & 0xFF in (TOOL_NODE, 0)]
        if not free:
            return "all entries of the consumer heartbeat time (0x1016) are taken"
        free.sort(key=lambda sub: entries[sub] >> 16 & 0xFF != TOOL_NODE)
        if entries[free[0]] == int.from_bytes(word, "little"):  # left by a run that was killed, not the owner's
            node.sdo.download(objects.CONSUMER_HEARTBEAT, free[0], bytes(4))
        node.write_bytes(objects.CONSUMER_HEARTBEAT, free[0], word)
    except SdoAbort as abort:
        return NO_CONSUMER if abort.code in ABSENT else "the consumer heartbeat (0x1016) cannot be written"
    return ""


def _set_guarding(drive: CanopenDrive, heartbeat: Heartbeat) -> bool:
    """Make the drive watch the tool's remote frames (node guarding, CiA 301, 7.2.8.2.2.1); False where it cannot.

    It is active only without a heartbeat of the drive (0x1017 = 0), in the NMT state operational, and after one remote
    frame was answered: so the adapter must be able to send them.
    """
    node = drive.node
    try:
        node.put(objects.LIFE_TIME_FACTOR, 1e-3 * CONSUMER_MS / PERIOD_S)
        node.put(objects.GUARD_TIME_MS, 1e3 * PERIOD_S)
    except SdoAbort:
        return False
    with contextlib.suppress(SdoAbort):
        if node.get(objects.PRODUCER_HEARTBEAT_MS):
            node.put(objects.PRODUCER_HEARTBEAT_MS, 0)
    node.supervision.heartbeat_period_s = None
    node.supervision.nmt_state = None
    node.connection.request(HEARTBEAT_ID + node.node, 1)
    if not node.connection.wait_until(lambda: node.supervision.nmt_state is not None, ANSWER_S):
        raise _refused(
            "without a consumer heartbeat (0x1016), the drive does not answer the remote frames of node guarding",
            drive, likely="the adapter sends no remote frames, or the drive's guarding is switched off",
        )  # fmt: skip
    _start(node)
    heartbeat.guarded_node = node.node
    return True


def _set_process_data(drive: CanopenDrive, heartbeat: Heartbeat) -> bool:
    """Make the drive expect an empty PDO of the tool's; False where it cannot."""
    heartbeat.expected_pdo = expect_pdo(drive.node, CONSUMER_MS)
    if heartbeat.expected_pdo is None:
        return False
    _start(drive.node)
    return True


def _start(node: DriveNode) -> None:
    """Bring the node to the NMT state operational; it is back in pre-operational when it is closed, if it was there."""
    before = node.supervision.nmt_state
    if before is not NmtState.OPERATIONAL:
        send_nmt(node.connection, NmtCommand.START, node.node)
        if before is not NmtState.STOPPED:

            def back() -> None:
                with contextlib.suppress(BusError):  # a lost adapter must not hide that the drive may be energised
                    send_nmt(node.connection, NmtCommand.PRE_OPERATIONAL, node.node)

            node.before_close.append(back)


def set_quick_stop(node: DriveNode, option: int) -> int | None:
    """Set what a quick stop does (0x605A) where the drive takes it; return what is in force, None where it has none."""
    _put_option(node, objects.QUICK_STOP_OPTION, option)
    with contextlib.suppress(SdoAbort):
        return node.whole(objects.QUICK_STOP_OPTION)
    return None


def _put_option(node: DriveNode, item: objects.DriveObject, option: int) -> None:
    """Set an option code where the drive has it and takes it, in the width that it has there."""
    with contextlib.suppress(SdoAbort):
        if node.held(item) not in (None, option):
            node.put(item, option)


def _fault_without_ramp(node: DriveNode) -> None:
    """Make a fault remove the voltage (0x605E) where a lost connection is one: at rest a ramp would not be seen."""
    _put_option(node, objects.FAULT_REACTION, FaultReaction.DISABLE)


def _abort_option(drive: CanopenDrive) -> AbortConnection | None:
    """Make the drive remove the voltage when the connection is lost, else stop in another way.

    None where it has no such object: what is seen counts. A drive that follows more than bounded currents must have it.
    """
    node = drive.node
    try:
        node.held(objects.ABORT_CONNECTION)  # from here on it is read and written in the width that the drive has
        option = node.whole(objects.ABORT_CONNECTION)
        if option != AbortConnection.DISABLE_VOLTAGE:
            with contextlib.suppress(SdoAbort):
                node.put(objects.ABORT_CONNECTION, AbortConnection.DISABLE_VOLTAGE)
            option = node.whole(objects.ABORT_CONNECTION)
        if option == AbortConnection.NO_ACTION:
            node.put(objects.ABORT_CONNECTION, AbortConnection.QUICK_STOP)
            option = node.whole(objects.ABORT_CONNECTION)
    except SdoAbort as abort:
        if abort.code in ABSENT and drive.commands_bounded_current:
            return None
        what = f"the drive's reaction to a lost connection (0x6007) cannot be made to stop: {abort.what}"
        raise _refused(what, drive) from abort
    if option not in _STOPPING:
        raise _refused(f"abort connection option code {option} does not stop the machine", drive)
    return AbortConnection(option)


def _refused(what: str, drive: CanopenDrive, *, likely: str = "") -> SafetyRefusal:
    return SafetyRefusal(
        what,
        where=f"node {drive.node.node}",
        likely=likely or "the drive's firmware has no heartbeat supervision, or it is switched off",
        hint="nothing will be moved over this connection; use the drive's own commissioning over its panel",
    )
