# SPDX-License-Identifier: MIT
"""The journal of gains that are changed on a live drive for a measurement: beside the drive's other journals.

It is on disk before the first change, and before every further one. What ends a measurement without its end (a killed
program, a dead battery) leaves it there; the next connection to the drive restores before it does anything else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pmsmtool.drive.drive_node import DriveNode, is_safe, state_text
from pmsmtool.drive.port import Identity
from pmsmtool.errors import ConfigError, SafetyRefusal, VerifyMismatch
from pmsmtool.files import user_folder
from pmsmtool.flash.journal import Entry, JournalFolder, Snapshot, read_snapshot, write_snapshot

FILE = "gains.json"
CONTENT = "gains changed for a measurement"


class GainJournal:
    """Gains of one drive while they are changed.

    Parameters
    ----------
    identity : Identity
        Of the drive.
    entries : sequence of Entry
        What every object holds now; their ``new`` is None.
    """

    def __init__(self, identity: Identity, entries: Sequence[Entry]) -> None:
        self.path = path_of(identity)
        self._snapshot = Snapshot("journal", "open", identity, 0, CONTENT, tuple(entries))

    def begin(self) -> None:
        """Put the journal on disk. Raises ConfigError: the folder cannot be written: nothing may be changed then."""
        write_snapshot(self.path, self._snapshot)

    def note(self, index: int, sub: int, data: bytes) -> None:
        """Put on disk what is about to be written; what was held before leaves what was noted, for it may fail yet."""
        entries = tuple(
            replace(entry, new=data) if (entry.index, entry.sub) == (index, sub) and data != entry.old else entry
            for entry in self._snapshot.entries
        )
        self._snapshot = replace(self._snapshot, entries=entries)
        self.begin()

    def end(self, node: DriveNode) -> None:
        """Read every object, and remove the journal when all hold again what they held.

        Raises VerifyMismatch: an object does not; the journal stays.
        """
        _confirm(node, self._snapshot)
        self.path.unlink(missing_ok=True)


def path_of(identity: Identity) -> Path:
    """Return where a drive's journal of changed gains stands."""
    return JournalFolder(identity).path.with_name(FILE)


def any_left() -> bool:
    """Whether a measurement of any drive ended without its end; looks at the disk alone."""
    return any((user_folder() / "journals").glob(f"*/{FILE}"))


def restore_left(node: DriveNode, identity: Identity) -> int:
    """Bring back the gains that an ended measurement left changed; return how many objects were written.

    Raises
    ------
    SafetyRefusal
        The drive is energised, or an object holds neither the old value nor the one that was written.
    ConfigError
        The journal is damaged.
    VerifyMismatch
        An object does not hold its old value again.
    """
    path = path_of(identity)
    if not path.exists():
        return 0
    try:
        snapshot = read_snapshot(path)
    except ConfigError as error:
        raise ConfigError(
            f"the record of the gains that an interrupted `map learn` changed is damaged: {error.what}",
            where=str(path),
            hint="reset the drive: it comes back with the gains it has stored; then delete the file",
        ) from error  # fmt: skip
    state = node.state()
    if not is_safe(state):
        raise SafetyRefusal(
            f"an interrupted `map learn` left gains of this drive changed, and it is in {state_text(state)}",
            where=f"node {node.node}, {path}",
            hint=f"`pmsmtool stop -n {node.node}`, then run the command again: it restores them first",
        )
    held = {entry: node.sdo.read(entry.index, entry.sub) for entry in snapshot.entries}
    strange = [e for e, data in held.items() if data not in (e.old, e.new)]
    if strange:
        names = ", ".join(f"0x{e.index:04X}:{e.sub:02X}" for e in strange)
        raise SafetyRefusal(
            f"{names} hold neither what they held before `map learn` nor what it wrote",
            where=f"node {node.node}, {path}",
            likely="another program wrote them since, or another drive without a serial number answers",
            hint="compare them with the file; when they are right, delete it",
        )
    changed = [entry for entry, data in held.items() if data != entry.old]
    for entry in changed:
        node.sdo.download(entry.index, entry.sub, entry.old)
    _confirm(node, snapshot)
    path.unlink(missing_ok=True)
    return len(changed)


def _confirm(node: DriveNode, snapshot: Snapshot) -> None:
    wrong = [
        f"0x{e.index:04X}:{e.sub:02X} holds {held.hex(' ')}, before {e.old.hex(' ')}"
        for e in snapshot.entries
        if (held := node.sdo.read(e.index, e.sub)) != e.old
    ]
    if wrong:
        raise VerifyMismatch(
            "gains of the drive are not what they were before the measurement", where=f"node {node.node}",
            differences=wrong, hint="connect again: the journal brings them back; or reset the drive",
        )  # fmt: skip
