# SPDX-License-Identifier: MIT
"""Reading and writing whole files: how large one may be, and how the old one stays until the new one is there.

Every file that comes from outside is read here, so that its size is checked before its content is in memory. Every
file that the tool leaves is written here: beside its place under a name that did not exist, then renamed.

The folders of the installation and of the user are found the same way from a wheel and from a checkout.
"""

from __future__ import annotations

import contextlib
import os
import stat
import sys
from difflib import get_close_matches
from pathlib import Path
from typing import Literal

from pmsmtool.errors import ConfigError, PmsmtoolError

DataFolder = Literal["profiles", "firmware-params"]

_PACKAGE = Path(__file__).parent
ELSEWHERE = "check your rights there and the space on the disk; PMSMTOOL_HOME names another folder"
"""Next step where the user's folder cannot be written."""
USER_ROOM = 1 << 20
"""Bytes that the user's folder must take before anything moves: a journal with tables has 0.1 MB."""
BUNDLE = "_data"
"""Folder inside the installed package that the wheel fills; a checkout has none."""


def data_folder(name: DataFolder) -> Path:
    """Return the folder of the machine profiles or of the firmware parameter maps.

    A wheel carries them inside the package, a checkout (also one installed with ``pip install -e``) at its top.

    Raises PmsmtoolError: the folder is in neither place.
    """
    bundled = _PACKAGE / BUNDLE / name
    if bundled.is_dir():
        return bundled
    checkout = _PACKAGE.parent / name
    if checkout.is_dir() and (_PACKAGE.parent / "pyproject.toml").is_file():
        return checkout
    raise PmsmtoolError(
        f"the folder {name} is missing",
        where=str(bundled),
        likely="the installation is damaged",
        hint="install pmsmtool again",
    )


def user_folder() -> Path:
    """Return the folder for what must outlive a run: journals, crash reports; not created here.

    ``PMSMTOOL_HOME`` if set, else the platform's place for application data.

    Raises ConfigError: the user has no home folder (a container with a bare user number).
    """
    chosen = os.environ.get("PMSMTOOL_HOME")
    if chosen:
        return Path(chosen)
    try:
        home = Path.home()
    except RuntimeError as error:
        raise ConfigError("this user has no home folder", hint="set PMSMTOOL_HOME to a folder") from error
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local") / "pmsmtool"
    if sys.platform == "darwin":
        return home / "Library" / "Application Support" / "pmsmtool"
    return Path(os.environ.get("XDG_DATA_HOME") or home / ".local" / "share") / "pmsmtool"


TEXT_BYTES = 8 << 20
"""Largest file of keys or objects (TOML, JSON, EDS); the largest that is known, a drive's EDS, has 4 MB."""
ROWS_BYTES = 64 << 20
"""Largest text of rows (CSV): some 3 million numbers."""
NUMBERS_BYTES = 128 << 20
"""Largest archive, packed and unpacked: 16 million numbers of 8 bytes, a minute of 13 signals at 20 kHz."""
PART = ".part"
"""Suffix of a file that is being written: without it, all of the file is there."""
_DEVICES = ("/dev/", "/proc/")
# Written in place: /dev/stdout cannot be replaced, and must not be where the user could.


def read_bytes(path: Path, *, largest: int = TEXT_BYTES, hint: str = "check the path") -> bytes:
    """Return the bytes of a file. Raises ConfigError: missing, unreadable or too large.

    Parameters
    ----------
    path : Path
        The file.
    largest : int
        Bytes it may have; more are not read.
    hint : str
        Next step where there is no such file.
    """
    where = str(path)
    try:
        with Path(path).open("rb") as stream:
            status = os.fstat(stream.fileno())
            regular = stat.S_ISREG(status.st_mode)
            if regular and status.st_size > largest:
                raise too_large("the file", largest, where)
            content = stream.read() if regular else stream.read(largest + 1)
    except FileNotFoundError:
        raise ConfigError("no such file", where=where, likely=near_names(path), hint=hint) from None
    except ConfigError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        reason = (error.strerror if isinstance(error, OSError) else "") or error
        raise ConfigError(f"cannot be read: {reason}", where=where, hint="give a file that you may read") from None
    if len(content) > largest:
        raise too_large("the file", largest, where)
    return content


def read_text(path: Path, *, largest: int = TEXT_BYTES, encoding: str = "utf-8", hint: str = "check the path") -> str:
    """Return the text of a file, with one kind of line end; raises ``ConfigError`` as :func:`read_bytes`."""
    try:
        text = read_bytes(path, largest=largest, hint=hint).decode(encoding)
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"cannot be read as text: byte {error.start + 1} is not {encoding.upper()}",
            where=str(path),
            likely="an editor saved it in another encoding (UTF-16, Windows-1252), or it is no text",
            hint="give the file that is due here, saved as UTF-8",
        ) from None
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def near_names(path: Path) -> str:
    """Return which file of the same folder may be meant, as a question; empty when none is near or readable."""
    try:
        names = [entry.name for entry in Path(path).parent.iterdir()]
    except (OSError, ValueError):
        return ""
    typed = Path(path).name
    names = [name for name in names if name != typed]  # a device, or one that may not be read: it is there
    near = [name for name in names if Path(name).stem == typed] or get_close_matches(typed, names, 2)
    return f"did you mean {' or '.join(str(Path(path).with_name(name)) for name in near)}?" if near else ""


def too_large(what: str, largest: int, where: str) -> ConfigError:
    """Return the refusal of something with more than ``largest`` bytes."""
    return ConfigError(
        f"{what} has more than the {largest >> 20} MiB that are read",
        where=where,
        likely="a damaged file, or one of another kind",
        hint="give a smaller file: fewer samples, or fewer points",
    )


def make_folder(path: Path, *, hint: str = "choose another folder") -> None:
    """Make a folder and those above it; raises ``ConfigError`` with the next step where that fails."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        likely = "a file has that name, the disk is read-only or full, or you may not write there"
        raise ConfigError(f"cannot be made: {error.strerror}", where=str(path), likely=likely, hint=hint) from None


def refuse_existing(path: Path, *, force: bool) -> None:
    """Refuse a file that is there, unless by force, or whose folder is not, before it is worked for; not a device.

    Raises ConfigError: there is such a file, or no such folder.
    """
    if str(path).startswith(_DEVICES):
        return
    if not os.access(path.parent, os.W_OK):
        why = "you may not write there" if path.parent.is_dir() else "there is no such folder"
        raise ConfigError(f"cannot be written: {why}", where=str(path.parent), hint="choose another folder")
    if path.exists() and not force:
        raise ConfigError("the file exists", where=str(path), hint="choose another name, or --force")


def refuse_source(source: Path | str, *targets: Path | None) -> None:
    """Refuse to write a file over the one that it is made from; raises ``ConfigError``."""
    for path in targets:
        if path is not None and path.is_file() and Path(source).is_file() and path.samefile(source):
            raise ConfigError(
                "this is the file that is read: it would be replaced", where=str(path), hint="choose another name"
            )


def write_file(path: Path, content: bytes | str, *, synced: bool = False, hint: str = "choose another folder") -> None:
    """Write a file in one step: a reader finds the old or the new one, never a part.

    Raises ConfigError: it cannot be written; the old file, if there was one, is still there.

    Parameters
    ----------
    path : Path
        The file; a link of that name is replaced, never followed. A device (``/dev/stdout``) is written in place.
    content : bytes or str
        All of it; text is written in UTF-8.
    synced : bool
        Whether it must be on the disk on return, for what has to survive a power cut.
    hint : str
        Next step where it cannot be written.
    """
    # a path in another encoding is in a text as lone surrogates
    data = content.encode(errors="backslashreplace") if isinstance(content, str) else content
    path = Path(path)
    try:
        if str(path).startswith(_DEVICES) or (path.exists() and not path.is_file()):
            path.write_bytes(data)
            return
        # O_EXCL: a file or link that somebody left under this name is never opened.
        part = path.with_name(f".{path.name}.{os.urandom(6).hex()}{PART}")
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
        descriptor = os.open(part, flags, 0o666)
        try:
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(data)
                stream.flush()
                if synced:
                    os.fsync(stream.fileno())
            os.replace(part, path)
        except BaseException:
            with contextlib.suppress(OSError):
                part.unlink()
            raise
        if synced:
            _sync_folder(path.parent)
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else "") or error
        likely = "a read-only or full disk"
        if isinstance(error, FileNotFoundError) and not path.parent.is_dir():
            likely = f"there is no folder {path.parent}"
        elif isinstance(error, PermissionError):
            likely = "you may not write there, or another program holds the file"
        raise ConfigError(f"cannot be written: {reason}", where=str(path), likely=likely, hint=hint) from error


def refuse_full(folder: Path, room: int, *, hint: str) -> None:
    """Refuse a folder, there or to be made, that does not take ``room`` bytes; nothing of the trial stays.

    Raises ConfigError: it cannot be made or written, or its disk is full; ``hint`` is the next step.
    """
    there = next(path for path in (Path(folder), *Path(folder).absolute().parents) if os.path.lexists(path))
    if not os.path.isdir(there):
        make_folder(folder, hint=hint)  # says why it cannot
    trial = there / ".room"
    write_file(trial, bytes(room), hint=hint)
    trial.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    # Windows cannot open a folder; there the rename is on disk with the file.
    with contextlib.suppress(PermissionError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
