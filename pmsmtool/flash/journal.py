"""Journal, backup and snapshot: one file format, exact bytes, never half written.

A journal is on disk, synced, before the first write to a drive; it holds what the drive held. It
stands in the user's data folder under the drive's identity, so that ``restore`` finds it without
being told, also after the tool was killed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pmsmtool.drive.port import Identity
from pmsmtool.errors import ConfigError, next_step
from pmsmtool.files import read_text, write_file
from pmsmtool.resources import user_folder

NEXT_STEP = "give a file of `pmsmtool backup`, or a journal as it was written"

_ELSEWHERE = "PMSMTOOL_HOME names another folder for journals"

SCHEMA = "pmsmtool.snapshot/1"

Kind = Literal["journal", "backup"]
State = Literal["open", "done", "restored"]


@dataclass(frozen=True, slots=True)
class Entry:
    """One object of a snapshot.

    Attributes
    ----------
    name : str
        Catalogue or table name; ``design_id``, ``configuration_date``, ``configuration_time`` for the marks.
    index, sub : int
        The object.
    old : bytes
        What the drive held.
    new : bytes or None
        What a download was to write; None in a backup.
    """

    name: str
    index: int
    sub: int
    old: bytes
    new: bytes | None = None


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What a drive held, and what it was to hold.

    Attributes
    ----------
    kind : str
        ``journal`` of a download or ``backup``.
    state : str
        ``open`` until the drive is known to hold the new or the old set again.
    identity : Identity
        Of the drive.
    signature : int
        Layout signature of its parameter set, 0 where it has none.
    content : str
        Content hash of the set that was written; empty in a backup.
    entries : tuple of Entry
        Parameters in writing order, then the marks.
    """

    kind: Kind
    state: State
    identity: Identity
    signature: int
    content: str
    entries: tuple[Entry, ...]

    def with_state(self, state: State) -> Snapshot:
        """Return the snapshot in another state."""
        return replace(self, state=state)

    def dumps(self) -> str:
        """Return the file's text."""
        body = self._body()
        return json.dumps({**body, "check": check_sum(body)}, indent=1) + "\n"

    def _body(self) -> dict[str, Any]:
        identity = asdict(self.identity)
        del identity["node"]
        entries = [
            {"name": e.name, "object": f"0x{e.index:04X}:{e.sub:02X}", "old": e.old.hex()}
            | ({} if e.new is None else {"new": e.new.hex()})
            for e in self.entries
        ]
        return {
            "schema": SCHEMA,
            "kind": self.kind,
            "state": self.state,
            "identity": identity,
            "node": self.identity.node,
            "signature": self.signature,
            "content": self.content,
            "entries": entries,
        }


@next_step(NEXT_STEP)
def parse_snapshot(text: str, where: str) -> Snapshot:
    """Read a snapshot's text.

    Raises
    ------
    ConfigError
        Not a snapshot, or damaged.
    """
    try:
        document = json.loads(text)
        check = document.pop("check")
        if document["schema"] != SCHEMA:
            raise ConfigError(
                f"schema is {document['schema']!r}, expected {SCHEMA!r}",
                where=where,
                hint="restore it with the version of pmsmtool that wrote it",
            )
        if check != check_sum(document):
            raise ConfigError(
                "the snapshot is damaged: its check sum does not fit", where=where, likely="it was edited or cut"
            )
        entries = tuple(_entry(row) for row in document["entries"])
        identity = Identity(node=document["node"], **document["identity"])
        return Snapshot(
            document["kind"], document["state"], identity, document["signature"], document["content"], entries
        )
    except ConfigError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise ConfigError(
            f"not a snapshot: {error}", where=where, hint="give a file of `pmsmtool backup` or a journal"
        ) from error


@next_step(NEXT_STEP)
def read_snapshot(path: Path) -> Snapshot:
    """Read a snapshot file; raises ``ConfigError`` naming it."""
    return parse_snapshot(read_text(path), str(path))


def write_snapshot(path: Path, snapshot: Snapshot) -> None:
    """Write a snapshot so that the file is the old or the new one at every instant, and on disk on return.

    Raises
    ------
    ConfigError
        The folder cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot be made: {error.strerror}", where=str(path.parent), hint=_ELSEWHERE) from error
    write_file(path, snapshot.dumps(), synced=True, hint=_ELSEWHERE)


class JournalFolder:
    """Journals of one drive: ``journal.json`` is the last download's, older ones stand beside it.

    Parameters
    ----------
    identity : Identity
        Of the drive.
    root : Path, optional
        Instead of the user's data folder.
    """

    def __init__(self, identity: Identity, root: Path | None = None) -> None:
        name = f"{identity.vendor:08x}-{identity.product:08x}-{identity.serial}"
        self.path = (root or user_folder() / "journals") / name / "journal.json"

    def last(self) -> Snapshot | None:
        """Return the last journal, None when there never was one."""
        return read_snapshot(self.path) if self.path.exists() else None

    def begin(self, snapshot: Snapshot) -> Snapshot:
        """Put a new journal on disk and return it; of one still open, the old contents are kept.

        An interrupted download left the drive somewhere between its old and new set. What counts as
        old is what stood there before the first of them.
        """
        previous = self.last()
        if previous is not None and previous.state == "open":
            snapshot = merged(previous, snapshot)
        elif previous is not None:
            self._archive(previous)
        write_snapshot(self.path, snapshot)
        return snapshot

    def close(self, snapshot: Snapshot, state: State) -> None:
        """Note that the drive holds the new set (``done``), the old one again (``restored``), or neither (``open``)."""
        write_snapshot(self.path, snapshot.with_state(state))

    def _archive(self, snapshot: Snapshot) -> None:
        text = snapshot.dumps()
        name = hashlib.sha256(text.encode()).hexdigest()[:12]
        write_snapshot(self.path.with_name(f"journal-{name}.json"), snapshot)


def merged(first: Snapshot, second: Snapshot) -> Snapshot:
    """Return the journal of a download that follows an unfinished one: the oldest old, the newest new."""
    old = {(e.index, e.sub): e.old for e in second.entries} | {(e.index, e.sub): e.old for e in first.entries}
    new = {(e.index, e.sub): e for e in first.entries} | {(e.index, e.sub): e for e in second.entries}
    entries = tuple(replace(entry, old=old[key]) for key, entry in new.items())
    return replace(second, entries=tuple(sorted(entries, key=_marks_last)))


MARKS: Sequence[tuple[str, int, int]] = (
    ("design_id", 0x2000, 9),
    ("configuration_date", 0x1020, 1),
    ("configuration_time", 0x1020, 2),
)
"""Objects that say which set a drive holds; written after the parameters, 0x1020 last."""


def _marks_last(entry: Entry) -> int:
    names = [name for name, _, _ in MARKS]
    return names.index(entry.name) + 1 if entry.name in names else 0


def _entry(row: dict[str, Any]) -> Entry:
    index, sub = row["object"].split(":")
    new = row.get("new")
    return Entry(
        str(row["name"]), int(index, 16), int(sub, 16), bytes.fromhex(row["old"]),
        None if new is None else bytes.fromhex(new),
    )  # fmt: skip


def check_sum(body: dict[str, Any]) -> str:
    """Return the check sum of a snapshot's content."""
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
