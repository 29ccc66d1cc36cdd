# SPDX-License-Identifier: MIT
"""How a run began and ended, in its own record: one that did not come to its end says so to whoever opens it later.

An account is begun before anything moves and closed on every way out, so a run whose account is still open was killed,
lost its power, or still runs.
"""

from __future__ import annotations

import contextlib
import datetime
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pmsmtool import __version__
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.guard import RESTORED
from pmsmtool.drive.stop import interrupts_deferred
from pmsmtool.errors import (
    ConfigError,
    Declined,
    IdentificationError,
    Interrupted,
    NotAvailable,
    PmsmtoolError,
    SafetyRefusal,
    decisive,
    exit_code_of,
)
from pmsmtool.files import PART
from pmsmtool.measurement.observe import GIVEN_BACK
from pmsmtool.run_directory import RECORD, RunDirectory, Stage, Status, new_record

WRITTEN_AFTER = (RECORD, "report.html")
"""Files of a run that say what the others hold: not counted among them."""
NOTHING_SAID = "no stop and no restore was reported: nothing had been begun, or it was not confirmed"
"""What an account says where no guard lent the drive, or none came to its end."""
Say = Callable[[str], None]


def begin_run(
    drive: CanopenDrive,
    runs: Path,
    *,
    command: Sequence[str] = ("commission",),
    bus: Mapping[str, Any] | None = None,
    level: str = "",
) -> RunDirectory:
    """Make the run directory of a drive below ``runs``; raises ``ConfigError`` when it cannot be written."""
    record = new_record(
        command,
        drive={**asdict(drive.identity), **({"level": level, "map": drive.node.map.name} if level else {})},
        bus={**(bus or {}), "node": drive.identity.node},
        versions={"pmsmtool": __version__, **{name: version(name) for name in ("numpy", "scipy", "python-can")}},
    )
    return RunDirectory.create(runs, drive.identity.serial, record)


@dataclass(frozen=True, slots=True)
class Account:
    """How a run ended."""

    state: str
    """``open``, ``interrupted``, ``refused``, ``fail``; ``complete`` when no error ended it, whatever was measured."""
    stage: str
    """What was done last."""
    began_utc: str
    ended_utc: str = ""
    """When; the end is empty while it is open."""
    exit_code: int | None = None
    """What the program ended with (``pmsmtool help exit-codes``), where an error ended it."""
    error: str = ""
    what: str = ""
    where: str = ""
    likely: str = ""
    next_step: str = ""
    """Name of the error, of a refused measurement its reason (``E_...``), and what was told of it."""
    restored: tuple[str, ...] = ()
    """What was said of the stop and of what the drive holds again."""
    files: Mapping[str, str] = field(default_factory=dict)
    """Complete files of the run and their SHA-256 (hex): a file has its name only when all of it is written."""
    incomplete: tuple[str, ...] = ()
    """Files that were being written."""


class RunAccount:
    """Keeps the account of one run.

    Parameters
    ----------
    run : RunDirectory
        The run.
    tell : callable
        Told every line that is said through :meth:`say`.
    """

    def __init__(self, run: RunDirectory, tell: Say) -> None:
        self._run, self._tell = run, tell
        self._open: Account | None = None
        self._restored: list[str] = []

    def say(self, line: str) -> None:
        """Pass a line on; what it says of a drive that is off and restored, or was only looked at, is kept."""
        if line.startswith((RESTORED, GIVEN_BACK)):
            self._restored.append(line)
        self._tell(line)

    def begin(self, stage: str) -> None:
        """Note that a stage begins; raises ``ConfigError`` when the run cannot be written: nothing has moved yet."""
        self._restored.clear()
        self._open = Account("open", stage, _now())
        self._write(self._open)

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Close the account on every way out; what ends the run outranks an account that cannot be written."""
        try:
            yield
        except BaseException as error:
            if self._open is not None:
                with interrupts_deferred(), contextlib.suppress(ConfigError, OSError):
                    self._write(self._ended(self._open, error))
            raise
        if self._open is not None:
            self._write(replace(self._open, state="complete", **self._at_end()))

    def _ended(self, begun: Account, error: BaseException) -> Account:
        chosen = decisive(error)
        return replace(
            begun,
            state=status_of(chosen),
            exit_code=int(exit_code_of(chosen)),
            error=str(getattr(chosen, "reason", "") or type(chosen).__name__),
            what=chosen.what if isinstance(chosen, PmsmtoolError) else text_of(chosen),
            where=str(getattr(chosen, "where", "")),
            likely=str(getattr(chosen, "likely", "")),
            next_step=str(getattr(chosen, "hint", "")),
            **self._at_end(),
        )

    def _at_end(self) -> dict[str, Any]:
        files, incomplete = _files(self._run.path)
        return {"ended_utc": _now(), "restored": tuple(self._restored), "files": files, "incomplete": incomplete}

    def _write(self, account: Account) -> None:
        self._run.write(replace(self._run.read(), account=asdict(account)))


@contextmanager
def accounted(run: RunDirectory, stage: str, tell: Say) -> Iterator[Say]:
    """Keep the account of a run that is one stage, and record the stage when an error ends it; yields what to say by.

    Raises ConfigError: the run cannot be written; nothing has moved yet.
    """
    account = RunAccount(run, tell)
    with account.kept():
        account.begin(stage)
        try:
            yield account.say
        except BaseException as error:
            with contextlib.suppress(ConfigError, OSError):
                kept = run.read().stage(stage)
                if kept is None or kept.note != text_of(error):  # else it is recorded with what it measured
                    run.add(Stage(stage, status_of(error), 0.0, note=text_of(error)))
            raise


def status_of(error: BaseException) -> Status:
    """Return what an error makes of the stage it ended."""
    if isinstance(error, KeyboardInterrupt | Interrupted):
        return "interrupted"
    if isinstance(error, SafetyRefusal | Declined | IdentificationError | NotAvailable):
        return "refused"
    return "fail"


def text_of(error: BaseException) -> str:
    """Return what is recorded of an error."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    return str(error) or type(error).__name__


def _files(folder: Path) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the complete files below a folder with their hashes, and those that were being written."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in WRITTEN_AFTER)
    parts = tuple(path.relative_to(folder).as_posix() for path in paths if path.suffix == PART)
    whole = {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in paths
        if path.suffix != PART
    }
    return whole, parts


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).replace(microsecond=0).isoformat().replace("+00:00", "Z")


# ---- reading -------------------------------------------------------------------------------------------------


def account_lines(account: Mapping[str, Any]) -> list[str]:
    """Return how a run ended as lines for a person; empty when it came to its end, or kept no account."""
    state = account.get("state", "complete")
    if state == "complete":
        return []
    stage = account["stage"]
    if state == "open":
        return [
            f"{stage} was begun at {account['began_utc']} and did not end: the program was killed, or it still runs; "
            "whether the drive was stopped and restored was not recorded"
        ]
    code, what = account["exit_code"], account["what"]
    lines = [f"{_WORDS[state]} during {stage} at {account['ended_utc']}: {what} (exit code {code}, {account['error']})"]
    lines += [f"{name}: {account[key]}" for key, name in _DETAILS.items() if account[key]]
    lines.append(f"drive: {'; '.join(account['restored']) or NOTHING_SAID}")
    lines.append(f"complete files: {', '.join(account['files']) or 'none'}")
    if account["incomplete"]:
        lines.append(f"not completely written: {', '.join(account['incomplete'])}")
    return lines


_WORDS = {"interrupted": "interrupted", "refused": "refused", "fail": "failed"}
_DETAILS = {"where": "where", "likely": "likely", "next_step": "next step then"}
