# SPDX-License-Identifier: MIT
"""Journal, backup and snapshot: one file format, exact bytes, never half written.

A journal is on disk, synced, before the first write to a drive; it holds what the drive held. It
stands in the user's data folder under the drive's identity, so that ``restore`` finds it without
being told, also after the tool was killed.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

from pmsmtool.drive.port import SERIAL_BITS, Identity
from pmsmtool.errors import ConfigError, next_step
from pmsmtool.files import ELSEWHERE, make_folder, read_bytes, read_text, user_folder, write_file
from pmsmtool.machine.key import Key, check_table

NEXT_STEP = "give a file of `pmsmtool backup`, or a journal as it was written"

_HASH_DIGITS = 12
"""In the names of older journals."""

SCHEMA = "pmsmtool.snapshot/1"

Kind = Literal["journal", "backup"]
State = Literal["open", "done", "restored"]


class DamagedSnapshot(ConfigError):
    """The bytes are not those of a snapshot as it was written."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One object of a snapshot."""

    name: str
    """Catalogue or table name; ``design_id``, ``configuration_date``, ``configuration_time`` for the marks."""
    index: int
    sub: int
    """The object."""
    old: bytes
    """What the drive held."""
    new: bytes | None = None
    """What a download was to write; None in a backup."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What a drive held, and what it was to hold."""

    kind: Kind
    """``journal`` of a download or ``backup``."""
    state: State
    """``open`` until the drive is known to hold the new or the old set again."""
    identity: Identity
    """Of the drive."""
    signature: int
    """Layout signature of its parameter set, 0 where it has none."""
    content: str
    """Content hash of the set that was written; empty in a backup."""
    entries: tuple[Entry, ...]
    """Parameters in writing order, then the marks."""
    current_limit_apk: float | None = None
    """Smallest limit of the current that the drive held (A peak); None where none of known unit was seen."""
    stored: bool = False
    """Whether that download stored what it wrote, or brought back, and saw it after a reset."""

    def shows_stored(self, held: Mapping[tuple[int, int], bytes]) -> bool | None:
        """Return whether a drive keeps over a reset what it holds, by its last journal; None: that does not show it.

        ``held``: contents by index and sub-index.
        """
        if self.state == "open":
            return False
        left = {(e.index, e.sub): (e.new if self.state == "done" else e.old) for e in self.entries}
        if self.stored:
            return True if held and held.items() <= left.items() else None
        changed = {(e.index, e.sub) for e in self.entries if e.new != e.old}
        unsaved = self.state == "done" and any(held[key] == left[key] for key in changed & held.keys())
        return False if unsaved else None

    def dumps(self) -> str:
        """Return the file's text."""
        body = self._body()
        return json.dumps({**body, "check": check_sum(body)}, indent=1) + "\n"

    def _body(self) -> dict[str, Any]:
        identity = asdict(self.identity)
        del identity["node"], identity["doubt"]
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
            **({} if self.current_limit_apk is None else {"current_limit_apk": self.current_limit_apk}),
            **({"stored": True} if self.stored else {}),
            "entries": entries,
        }


@next_step(NEXT_STEP)
def parse_snapshot(text: str, where: str) -> Snapshot:
    """Read a snapshot's text. Raises ConfigError: not a snapshot, or damaged."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        what = f"the file is no whole backup: {error}"
        raise DamagedSnapshot(what, where=where, likely="it was edited or cut") from error
    if not isinstance(document, dict):
        raise DamagedSnapshot("is no backup: it holds no names", where=where)
    schema, check = document.get("schema"), document.pop("check", None)
    if isinstance(schema, str) and schema != SCHEMA:
        raise ConfigError(
            f"schema is {schema!r}, expected {SCHEMA!r}",
            where=where,
            hint="restore it with the version of pmsmtool that wrote it",
        )
    if check != check_sum(document):
        raise DamagedSnapshot(
            "the backup is damaged: its check sum does not fit", where=where, likely="it was edited or cut"
        )
    wrong: list[str] = []
    identity = document.pop("identity", None)
    rows = document.pop("entries", None)
    head = _checked(document, _HEAD, where, wrong)
    who = _checked(identity, _IDENTITY, f"{where}: identity", wrong)
    found = [_entry(row, f"{where}: entries[{k}]", wrong) for k, row in enumerate(rows if type(rows) is list else ())]
    entries = tuple(entry for entry in found if entry is not None)
    if not entries:
        wrong.append(f"{where}: holds no entries")
    for what, keys in (("name", [e.name for e in entries]), ("object", [(e.index, e.sub) for e in entries])):
        if len(set(keys)) < len(keys):
            wrong.append(f"{where}: an entry's {what} is there twice")
    if wrong:
        raise DamagedSnapshot("not a snapshot", where=where, violations=wrong)
    return Snapshot(
        head["kind"], head["state"], Identity(node=head["node"], **who), head["signature"], head["content"], entries,
        head.get("current_limit_apk"), head.get("stored", False),
    )  # fmt: skip


@next_step(NEXT_STEP)
def read_snapshot(path: Path) -> Snapshot:
    """Read a snapshot file; raises ``ConfigError`` naming it."""
    if path.is_dir():
        raise ConfigError(
            "is a folder, no backup", where=str(path), likely="a run directory: it holds a set, no backup",
            hint=f"`pmsmtool flash-params {path}` writes the set of a run; restore takes a file of `pmsmtool backup`",
        )  # fmt: skip
    return parse_snapshot(read_text(path), str(path))


def write_snapshot(path: Path, snapshot: Snapshot) -> None:
    """Write a snapshot so that the file is the old or the new one at every instant, and on disk on return.

    Raises ConfigError: the folder cannot be written.
    """
    make_folder(path.parent, hint=ELSEWHERE)
    write_file(path, snapshot.dumps(), synced=True, hint=ELSEWHERE)


_WORD = 0xFFFFFFFF


def _required(name: str, meaning: str, *, choices: tuple[str, ...] = ()) -> Key:
    return Key("", name, "text", "", 0, 0, None, meaning, required=True, choices=choices)


def _whole(name: str, largest: int, meaning: str) -> Key:
    return Key("", name, "int", "1", 0, largest, None, meaning, required=True)


_HEAD: tuple[Key, ...] = (
    _required("schema", "format of the file"),
    _required("kind", "journal or backup", choices=get_args(Kind)),
    _required("state", "how the download ended", choices=get_args(State)),
    _whole("node", 127, "node of the drive"),
    _whole("signature", _WORD, "layout of its parameter set"),
    _required("content", "content hash of the set"),
    Key("", "current_limit_apk", "float", "A", 0, math.inf, None, "smallest limit of the current"),
    Key("", "stored", "bool", "", 0, 0, None, "the set was stored"),
)
_IDENTITY: tuple[Key, ...] = (
    *(_whole(name, _WORD, "object 0x1018") for name in ("vendor", "product", "revision")),
    _whole("serial", 1 << SERIAL_BITS, "object 0x1018, or the maker's own"),
    *(_required(name, "text of the drive") for name in ("name", "hardware", "software")),
)
_ENTRY: tuple[Key, ...] = (
    _required("name", "parameter, table or mark"),
    _required("object", "index and sub-index"),
    _required("old", "bytes the drive held"),
    Key("", "new", "text", "", 0, 0, None, "bytes it was to hold"),
)
_OBJECT = re.compile(r"0x([0-9A-Fa-f]{4}):([0-9A-Fa-f]{2})")


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
        self._note = self.path.with_name("begun")

    @contextlib.contextmanager
    def preparing(self) -> Iterator[None]:
        """Keep a note while a download is prepared: of a tool killed before its journal only the note is left."""
        if self.path.exists():  # otherwise there is nothing to go back to
            with contextlib.suppress(ConfigError, OSError):  # where nothing can be written, the journal says so
                write_file(self._note, "", synced=True)
        try:
            yield
        finally:
            self._forget_note()

    def _forget_note(self) -> None:
        with contextlib.suppress(OSError):
            self._note.unlink(missing_ok=True)

    @property
    def was_preparing(self) -> bool:
        """Whether the last download ended before its journal was begun: it wrote nothing, the last journal is older."""
        return self._note.exists()

    def last(self) -> Snapshot | None:
        """Return the last journal, None when there never was one."""
        try:
            return read_snapshot(self.path) if self.path.exists() else None
        except DamagedSnapshot as error:
            error.hint = (
                f"`restore FILE` with a backup or an older journal ({self.path.with_name('journal-*.json')}); "
                "the next flash-params sets this one aside"
            )
            raise

    def set_aside_damaged(self) -> Path | None:
        """Rename the last journal when it is damaged, and return its new name; its bytes stay as they are."""
        try:
            self.last()
        except DamagedSnapshot:
            digest = hashlib.sha256(read_bytes(self.path, largest=_WORD)).hexdigest()[:_HASH_DIGITS]
            aside = self.path.with_name(f"journal-damaged-{digest}.json")
            try:
                os.replace(self.path, aside)
            except OSError as error:
                raise ConfigError(
                    f"cannot be renamed: {error.strerror}", where=str(self.path), hint=ELSEWHERE
                ) from error
            return aside
        return None

    def begin(self, snapshot: Snapshot) -> Snapshot:
        """Put a new journal on disk and return it; of one still open, or done and repeated, the old contents are kept.

        An interrupted download left the drive somewhere between its old and new set. What counts as
        old is what stood there before the first of them, and so it is where the same set goes to a drive that holds it.
        """
        previous = self.last()
        if previous is not None and (previous.state == "open" or _repeats(previous, snapshot)):
            snapshot = merged(previous, snapshot)
        elif previous is not None:
            self._archive(previous)
        write_snapshot(self.path, snapshot)
        self._forget_note()
        return snapshot

    def close(self, snapshot: Snapshot, state: State, *, stored: bool = False) -> None:
        """Note that the drive holds the new set (``done``), the old one again (``restored``), or neither (``open``)."""
        write_snapshot(self.path, replace(snapshot, state=state, stored=stored))

    def _archive(self, snapshot: Snapshot) -> None:
        text = snapshot.dumps()
        name = hashlib.sha256(text.encode()).hexdigest()[:_HASH_DIGITS]
        write_snapshot(self.path.with_name(f"journal-{name}.json"), snapshot)


def _repeats(first: Snapshot, second: Snapshot) -> bool:
    """Return whether a download writes what the finished one before it wrote, to a drive that holds it."""
    held = {(e.index, e.sub, e.new, e.new) for e in first.entries if _marks_last(e) < 0}
    return first.state == "done" and held == {
        (e.index, e.sub, e.old, e.new) for e in second.entries if _marks_last(e) < 0
    }


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
    return names.index(entry.name) if entry.name in names else -1


def _checked(table: Any, keys: tuple[Key, ...], where: str, wrong: list[str]) -> dict[str, Any]:
    """Return the values of a table, all of which a snapshot has."""
    if not isinstance(table, dict):
        wrong.append(f"{where} is not a table of names")
        return {}
    return dict(check_table(table, keys, {"": where, **{name: f"{where}: {name}" for name in table}}, wrong, {}))


def _entry(row: Any, where: str, wrong: list[str]) -> Entry | None:
    before = len(wrong)
    values = _checked(row, _ENTRY, where, wrong)
    if len(wrong) > before:
        return None
    at = _OBJECT.fullmatch(values["object"])
    try:
        old, new = (None if (text := values.get(side)) is None else bytes.fromhex(text) for side in ("old", "new"))
    except ValueError as error:
        at = None
        wrong.append(f"{where}: bytes that are not hexadecimal ({error})")
    else:
        if at is None:
            wrong.append(f"{where}: object = {values['object']!r} is not of the form 0x2010:02")
    return None if at is None else Entry(values["name"], int(at[1], 16), int(at[2], 16), old or b"", new)


def check_sum(body: dict[str, Any]) -> str:
    """Return the check sum of a snapshot's content."""
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
