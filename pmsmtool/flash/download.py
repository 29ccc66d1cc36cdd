# SPDX-License-Identifier: MIT
"""The download: a transaction from what a drive holds to what it shall hold.

Gate, journal, staged write with read-back, activation, marks (0x1020 last), one store, reset,
re-identification, everything read again. Whatever fails on the way, the old set comes back, and
the error says which set the drive holds. A tool that was killed, or a drive that lost its supply,
leaves an open journal: the same command, or ``restore``, finishes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import IntEnum, auto

from pmsmtool.bus.nmt import TOOL_NODE
from pmsmtool.bus.sdo import SdoChannel
from pmsmtool.bus.sdo_transfer import is_busy, when_ready
from pmsmtool.bus.supervision import NodeReset
from pmsmtool.drive import objects
from pmsmtool.drive.drive_node import STORE_TIMEOUT_S, DriveNode, state_text
from pmsmtool.drive.parameters import DriveParameters, Progress
from pmsmtool.drive.port import Identity
from pmsmtool.drive.stop import interrupts_deferred
from pmsmtool.drive_maps.shipped_maps import nothing_to_write
from pmsmtool.errors import (
    DriveTimeout,
    Interrupted,
    NotAvailable,
    PmsmtoolError,
    SafetyRefusal,
    SdoAbort,
    VerifyMismatch,
)
from pmsmtool.flash.journal import MARKS, DamagedSnapshot, Entry, JournalFolder, Snapshot, State
from pmsmtool.flash.map_gate import check_map, remember_map
from pmsmtool.flash.plan import Change, Plan, differences
from pmsmtool.flash.whole_drive import WholeDrive, parameters_of
from pmsmtool.plain_text import counted

CONSUMERS_MAX = 8
"""Entries of 0x1016 that are read; drives have one to four."""
LISTEN_S = 0.25
"""Before the first write the bus is listened to this long: another master would be heard."""
_STARTS = 2
NO_STORE = "the drive has no command that stores parameters (0x1010:01): a written set would be lost at the next reset"
NOTHING_WRITTEN = "nothing was written: the drive holds the set that it held before"


class Phase(IntEnum):
    """How far a download has come; decides what a roll-back must do."""

    BEFORE = auto()
    STAGING = auto()
    ACTIVE = auto()
    STORING = auto()


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a download did."""

    written: int
    equal: int
    """Objects written, objects that held their value already."""
    stored: bool | None
    """Whether the drive keeps the set over a reset, as seen after one; None where nothing shows it."""
    crc: int | None
    """CRC-32 of the drive's whole set; None where it has none."""
    retries: int
    """Transfers repeated."""
    starts: int
    """2 when the node was reset in between and everything started over."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """Objects the drive did not take or keep, and why; only where objects go by their addresses."""

    @property
    def kept(self) -> str:
        """How long the drive keeps the set."""
        if self.stored is None:
            return "nothing stored, no reset; whether it is stored is not known, `flash-params --store` stores it"
        return "stored" if self.stored else "active until the next reset"


class Download:
    """One download to one drive.

    Parameters
    ----------
    node : DriveNode
        The drive.
    identity : Identity
        As read when the plan was made; it must still be this one.
    plan : Plan
        Old and new bytes.
    marks : mapping of str to bytes
        What ``flash.journal.MARKS`` shall hold afterwards.
    folder : JournalFolder
        Where the journal is kept.
    say : callable
        Told one line per step.
    """

    def __init__(
        self,
        node: DriveNode,
        identity: Identity,
        plan: Plan,
        marks: Mapping[str, bytes],
        folder: JournalFolder,
        *,
        say: Callable[[str], None] = lambda text: None,
        progress: Progress = lambda done, total: None,
    ) -> None:
        self.node = node
        self.identity = identity
        self.plan = plan
        self.folder = folder
        self.phase = Phase.BEFORE
        self._parameters = parameters_of(node)
        self._say = say
        self._progress = progress
        self._wanted_marks = dict(marks)
        self._old_marks: dict[str, bytes] = {}
        self._was_stored = False
        self._crc_before: int | None = None
        self._stored_before: int | None = None
        self._rolled_back: State = "restored"
        self._holds = ""

    @property
    def holds(self) -> str:
        """Which set the drive holds, as far as this download knows it now."""
        if self._holds:
            return self._holds
        with contextlib.suppress(PmsmtoolError):
            if (last := self.folder.last()) is not None and last.state == "open":
                return f"nothing was written, and an earlier download was interrupted: {self._unknown()}"
        return NOTHING_WRITTEN

    def _unknown(self) -> str:
        return f"which set the drive holds is not known, `pmsmtool restore -n {self.node.node}` brings the old one back"

    def run(self, *, store: bool | None = None, restoring: bool = False) -> Outcome:
        """Carry the plan out.

        Parameters
        ----------
        store : bool, optional
            Keep it in non-volatile memory: always, or never, so that it acts until the next reset; not given: what is
            written, and what is known to wait for storing.
        restoring : bool
            The plan brings the last journal's old contents back: that journal is kept, no new one begun, so that
            what counts as old stays the same however often it is brought back.

        Raises
        ------
        PmsmtoolError
            With the old set back on the drive, or with what to do said.
        Interrupted
            Ctrl-C, after the roll-back. From the save request on the download is finished first. It says which set
            the drive holds.
        """
        self._gate(store)
        if (aside := self.folder.set_aside_damaged()) is not None:
            self._say(f"the last journal was damaged, is kept as {aside}; what the drive held before is not known")
        if not self.has_work(store=store):
            kept = stored(self.node, self.plan, self.folder)
            self._close_stale(restoring)
            return self._outcome(0, starts=1, stored=kept)
        store = store is not False
        with contextlib.ExitStack() as hold:
            # An interrupt leaves no journal behind that nobody closes: from here on it is answered by the roll-back.
            noted = hold.enter_context(interrupts_deferred())
            journal = self._journal(restoring)
            self._holds = self._unknown()
            starts, what = 0, ""
            while True:
                starts += 1
                try:
                    hold.close()
                    if noted:
                        raise KeyboardInterrupt
                    if starts > 1:
                        self._say(f"{what}; starting over once")
                        self._start_over()
                    noted = self._forward(store, hold)
                    break
                except NodeReset as reset:
                    if starts == _STARTS or self.phase >= Phase.STORING:
                        raise self._roll_back(reset, journal) from reset
                    what = reset.what
                except BaseException as error:
                    raise self._roll_back(error, journal) from error
            self.folder.close(journal, "restored" if restoring else "done", stored=store)
            reached = "the set that was to be restored" if restoring else "the new set"
            self._holds = f"the drive holds {reached}, {'stored and read back' if store else 'until its next reset'}"
            outcome = self._outcome(len(self.plan.changes), starts=starts, stored=store)
        if noted:
            raise Interrupted(f"the download was finished first: {self._holds}")
        return outcome

    # ---- before ---------------------------------------------------------------------------------

    def has_work(self, *, store: bool | None = None) -> bool:
        """Whether anything would be written, marks and storing included; only reads the drive. ``store`` as of run."""
        self._old_marks = self._read_marks()
        self._was_stored = self._parameters.is_stored()
        self._crc_before = self._parameters.crc_active if self.node.map.staging else None
        self._stored_before = self._stored_crc()
        marks = "design_id" in self._old_marks and self._old_marks["design_id"] != self._wanted_marks.get("design_id")
        waits = store is not False and stored(self.node, self.plan, self.folder) is False
        asked = store is True and not self.node.map.staging
        return bool(self.plan.changes) or marks or waits or asked

    def admit(self, *, store: bool | None = None) -> None:
        """Refuse what no consent would allow: a map that is not this drive's, a drive that may move; only reads.

        Raises ConfigError, SafetyRefusal: as ``flash.map_gate.check_map`` and :func:`refuse_while_enabled`;
        NotAvailable: the plan has no entry; or it is to be stored, and the drive has no command for it.

        Parameters
        ----------
        store : bool, optional
            As of :meth:`run`.
        """
        check_map(self.node.map, self.identity, self.folder)
        refuse_empty(self.node, self.plan)  # storing would keep what others left in it, for nothing
        if store is not False and self.has_work(store=store) and not self.node.can_store():
            raise NotAvailable(
                NO_STORE, where=f"node {self.node.node}",
                hint="`flash-params --no-store` lets the set act until then; nothing was written",
            )  # fmt: skip
        refuse_while_enabled(self.node)

    def _gate(self, store: bool | None) -> None:
        check_identity(self.node, self.identity)
        self.admit(store=store)
        self._parameters.check_layout()
        if self._parameters.is_staged():
            raise SafetyRefusal(
                "the drive holds a staged set that another program has begun",
                where=f"node {self.node.node}, 0x2000:07",
                likely="another tool is at work, or one was interrupted while this plan was made",
                hint="make sure that no other tool is connected, then run the command again",
            )
        self._watch_for_masters()
        self.node.connection.wait(LISTEN_S)
        self.node.supervision.check()

    def _watch_for_masters(self) -> None:
        """Take heartbeats of the nodes that the drive supervises for those of other masters."""
        with contextlib.suppress(SdoAbort):
            count = self.node.sdo.read(objects.CONSUMER_HEARTBEAT, 0, size=1)[0]
            for sub in range(1, min(count, CONSUMERS_MAX) + 1):
                word = int.from_bytes(self.node.sdo.read(objects.CONSUMER_HEARTBEAT, sub, size=4), "little")
                other = word >> 16 & 0xFF
                if word & 0xFFFF and 0 < other < 0x80 and other != TOOL_NODE and not self._is_device(other):
                    self.node.supervision.expect_master(other)

    def _is_device(self, other: int) -> bool:
        """Whether a node answers for its device type: drives of one machine supervise each other, too."""
        channel = SdoChannel(self.node.connection, other)
        try:
            channel.upload(objects.DEVICE_TYPE.index, objects.DEVICE_TYPE.sub, tries=1)
        except (DriveTimeout, SdoAbort) as error:
            return isinstance(error, SdoAbort)
        finally:
            channel.close()
        return True

    def _close_stale(self, restoring: bool) -> None:
        """An interrupted download that had reached its end after all."""
        last = self.folder.last()
        if last is not None and last.state == "open":
            self.folder.close(last, "restored" if restoring else "done")

    def _journal(self, restoring: bool) -> Snapshot:
        last = self.folder.last()
        if restoring and last is not None:
            self._rolled_back = last.state
            self.folder.close(last, "open")  # until the old set is back; whoever is killed meanwhile restores again
            return last
        entries = [Entry(e.name, e.index, e.sub, e.old, e.new) for e in self.plan.entries]
        entries += [
            Entry(name, index, sub, self._old_marks[name], self._wanted_marks.get(name))
            for name, index, sub in MARKS
            if name in self._old_marks
        ]
        snapshot = Snapshot(
            "journal", "open", self.identity, self.node.map.signature, self.plan.content, tuple(entries)
        )
        remember_map(self.node.map, self.folder)
        journal = self.folder.begin(snapshot)
        self._say(f"journal: {self.folder.path}")
        return journal

    def _read_marks(self) -> dict[str, bytes]:
        found = {}
        for name, index, sub in MARKS:
            if name == "design_id" and not self.node.map.staging:
                continue  # 0x2000 is another maker's own object
            try:
                found[name] = self.node.sdo.read(index, sub)
            except SdoAbort:
                continue  # the drive does not keep this mark
        return found

    # ---- forward --------------------------------------------------------------------------------

    def _forward(self, store: bool, hold: contextlib.ExitStack) -> list[int]:
        """Write, activate, store; return the list of signals that are held from the save request on."""
        self.phase = Phase.STAGING
        changes = self.plan.changes
        if changes:
            self._say(f"writing and reading back {counted(len(changes), 'object')}")
            self._parameters.replace({change.name: change.new for change in changes}, progress=self._progress)
        self.phase = Phase.ACTIVE
        expected = self._parameters.crc_active if self.node.map.staging else None
        self._write_marks(self._wanted_marks)
        noted = hold.enter_context(interrupts_deferred(self._say, "storing"))
        if store:
            self.phase = Phase.STORING
            self._say("storing")
            self.node.store()
            self._say("resetting the drive and reading everything again")
            self.node.reset()
            check_identity(self.node, self.identity)
            self._verify(self.plan.entries, self._wanted_marks, expected)
        return noted

    def _write_marks(self, marks: Mapping[str, bytes]) -> None:
        for name, index, sub in MARKS:
            if name in self._old_marks and name in marks:
                try:
                    self.node.sdo.download(index, sub, marks[name])
                except SdoAbort:
                    if self.node.map.staging:
                        raise  # of another maker's drive it is no part of the set

    def _verify(
        self, entries: tuple[Change, ...], marks: Mapping[str, bytes], crc: int | None, *, stored: bool = True
    ) -> None:
        """Compare everything, also what was not written: the drive was reset in between."""
        found = self._parameters.read([entry.name for entry in entries], progress=self._progress)
        wrong = self._not_excused(entries, found)
        held = self._read_marks()
        lost = [name for name in held if name in marks and held[name] != marks[name]]
        if lost and not self.node.map.staging:
            self._say("the drive does not keep the date of its configuration (0x1020)")
            lost = []
        wrong += [f"{name}: wrote {marks[name].hex(' ')}, reads {held[name].hex(' ')}" for name in lost]
        if crc is not None:
            numbers = {"active": self._parameters.crc_active}
            numbers |= {"stored": self._parameters.crc_stored} if stored else {}
            wrong += [
                f"CRC-32 of the {k} set is {v:#010x}, expected {crc:#010x}" for k, v in numbers.items() if v != crc
            ]
        if wrong:
            raise VerifyMismatch(
                "after the reset the drive does not hold what was stored",
                where=f"node {self.node.node}",
                differences=wrong,
                hint="`pmsmtool verify` shows what it holds, `pmsmtool restore` brings back what it held before",
            )

    def _not_excused(self, entries: tuple[Change, ...], found: Mapping[str, bytes]) -> list[str]:
        """Return the differences that end the download; where objects go by their addresses only a loss of all."""
        whole = self._parameters
        if not isinstance(whole, WholeDrive):
            return differences(entries, found)
        due = [entry for entry in entries if entry.changes and entry.name not in whole.refused]
        lost = [entry for entry in entries if entry.name not in whole.refused and found.get(entry.name) != entry.new]
        if due and len(lost) >= len(due):
            return differences(tuple(lost), found)
        whole.refused.update((entry.name, "the drive does not keep it over a reset") for entry in lost)
        return []

    def _start_over(self) -> None:
        with self.node.supervision.expected_reset():
            self.node.connection.wait(LISTEN_S)
        check_identity(self.node, self.identity)

    # ---- back -----------------------------------------------------------------------------------

    def _roll_back(self, error: BaseException, journal: Snapshot) -> BaseException:
        """Bring the old set back; return the error to raise, which says what the drive holds now."""
        with interrupts_deferred(self._say, "bringing the old set back"):
            self.node.sdo.cancel(None)
            try:
                self._say(f"{_name(error)}: bringing the old set back")
                with self.node.supervision.expected_reset():
                    self._bring_back()
                self.folder.close(journal, self._rolled_back)
                self._holds = "the drive holds exactly the old set again"
            except (PmsmtoolError, OSError, KeyboardInterrupt) as second:
                self._holds = self._left_behind(second)
        return _told(error, self._holds)

    def _bring_back(self) -> None:
        if self.phase is Phase.BEFORE:
            return
        if (
            self.phase is Phase.STAGING
            and self._crc_before is not None
            and self._parameters.crc_active == self._crc_before
        ):
            return  # the staged copy was discarded, or lost in a reset; nothing of it ever acted
        if self.phase is Phase.STORING:
            self.node.wait_for_store()  # interrupted while the drive stores, which takes no write meanwhile
        old = tuple(_reversed(change) for change in self.plan.entries)
        if self.phase is Phase.ACTIVE and self._was_stored:
            self.node.reset()
        else:
            self._until_stored(self._write_old)
            if self.phase is Phase.STORING:
                # The memory may hold the new set already; the set that acted before is stored over it. Where the drive
                # refuses that, it is seen after the reset whether it refused the new set, too.
                with contextlib.suppress(SdoAbort):
                    self._until_stored(self.node.store)
                self.node.reset()
        stored = self._was_stored or self._stored_crc() != self._stored_before
        self._verify(old, self._old_marks, self._crc_before, stored=stored)

    def _write_old(self) -> None:
        whole = isinstance(self._parameters, WholeDrive)  # compares first: a PDO half written shows
        due = self.plan.entries if whole else self.plan.changes
        self._parameters.replace({change.name: change.old for change in due})
        self._write_marks(self._old_marks)

    def _until_stored(self, work: Callable[[], None]) -> None:
        """Do something that a drive refuses while it still stores, again until it has finished."""
        within_s = STORE_TIMEOUT_S if self.phase is Phase.STORING else 0.0
        when_ready(self.node.connection, work, within_s, busy=lambda f: is_busy(f) or not isinstance(f, SdoAbort))

    def _stored_crc(self) -> int | None:
        return self._parameters.crc_stored if self.node.map.staging else None

    def _left_behind(self, second: BaseException) -> str:
        holds = (
            "it holds exactly the old or exactly the new set, which of them is not known"
            if self.node.map.staging
            else "it may hold a part of the new set"
        )
        return (
            f"the roll-back failed too ({_name(second)}); {holds}. The journal is kept: when the drive answers again, "
            f"run the same command, or `pmsmtool restore -n {self.node.node}`"
        )

    def _outcome(self, written: int, *, starts: int, stored: bool | None) -> Outcome:
        crc = self._parameters.crc_active if self.node.map.staging else None
        whole = self._parameters
        refused = dict(whole.refused) if isinstance(whole, WholeDrive) else {}
        equal = len(self.plan.entries) - written
        written -= len(refused)
        return Outcome(written, equal, stored, crc, self.node.sdo.retries, starts, refused)


def stored(node: DriveNode, plan: Plan, folder: JournalFolder) -> bool | None:
    """Return whether a drive keeps over a reset what it holds of a plan; of other makers' its last journal may show it.

    None: nothing shows it.
    """
    if node.map.staging:
        return DriveParameters(node).is_stored()
    with contextlib.suppress(DamagedSnapshot):
        if (last := folder.last()) is not None:
            return last.shows_stored({(entry.index, entry.sub): entry.old for entry in plan.entries})
    return None


def run_all(jobs: Iterable[Download], *, store: bool | None, to_the_end: bool) -> list[Outcome | PmsmtoolError | None]:
    """Run downloads one after the other; None for one that was not begun after a failure.

    Raises Interrupted: Ctrl-C.
    """
    results: list[Outcome | PmsmtoolError | None] = []
    for job in jobs:
        if not to_the_end and any(isinstance(result, PmsmtoolError) for result in results):
            results.append(None)
            continue
        try:
            results.append(job.run(store=store))
        except Interrupted:
            raise
        except PmsmtoolError as error:
            results.append(error)
    return results


@contextlib.contextmanager
def set_named() -> Iterator[list[Download]]:
    """Say at a Ctrl-C which set the drives hold; yields the list into which downloads are put that are begun.

    Raises Interrupted: in place of a ``KeyboardInterrupt``, and for all drives where there are several.
    """
    jobs: list[Download] = []
    try:
        yield jobs
    except (KeyboardInterrupt, Interrupted) as error:
        several = len(jobs) > 1
        if isinstance(error, Interrupted) and not several:
            raise
        held = [f"node {job.node.node}: {job.holds}" if several else job.holds for job in jobs]
        raise Interrupted("; ".join(held) or NOTHING_WRITTEN) from error


def check_identity(node: DriveNode, expected: Identity) -> None:
    """Refuse to go on when another drive answers than the one a plan was made for.

    Raises SafetyRefusal: vendor, product or serial number differ.
    """
    found = node.identity()
    if (found.vendor, found.product, found.serial) != (expected.vendor, expected.product, expected.serial):
        raise SafetyRefusal(
            f"another drive answers: {describe(found)} instead of {describe(expected)}",
            where=f"node {node.node}, 0x1018",
            likely="drives were swapped, or two share this node id",
            hint="check the node id; nothing was written to this drive",
        )


def refuse_empty(node: DriveNode, plan: Plan) -> None:
    """Raise NotAvailable: the plan has no entry."""
    if not plan.entries:
        raise nothing_to_write(node.map, f"node {node.node}")


def refuse_while_enabled(node: DriveNode) -> None:
    """Refuse to write to a drive that may drive current; it is never disabled unasked.

    Raises SafetyRefusal: the statusword shows an energised state, or that of a further axis does: the reset is of all.
    """
    state = node.state()
    energised = {"the drive": state} if state is None or state.energised else {}
    energised |= {f"axis {axis}": its for axis, its in node.other_axes().items() if its is not None and its.energised}
    for who, shown in energised.items():
        raise SafetyRefusal(
            f"{who} is in {state_text(shown)}: parameters are not written to a drive that may move",
            where=f"node {node.node}, 0x6041:00",
            hint=f"`pmsmtool stop -n {node.node}` disables it",
        )


def describe(identity: Identity) -> str:
    """Return an identity in one line."""
    numbers = f"vendor {identity.vendor:#010x} product {identity.product:#010x} serial {identity.serial}"
    return f"{identity.name} ({numbers})" if identity.name else numbers


def _reversed(change: Change) -> Change:
    return Change(change.name, change.index, change.sub, change.new, change.old)


def _name(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    text = getattr(error, "what", "") or str(error) or type(error).__name__
    return str(text).splitlines()[0]


def _told(error: BaseException, state: str) -> BaseException:
    """Return the error with the drive's state in it."""
    if isinstance(error, KeyboardInterrupt):
        return Interrupted(state)
    if isinstance(error, PmsmtoolError):
        error.what = f"{error.what}; {state}"
        error.args = (error.what,)
    return error
