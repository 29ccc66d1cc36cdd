# SPDX-License-Identifier: MIT
"""From an exception to what a person reads and to the exit code a script reads."""

from __future__ import annotations

import contextlib
import errno
import sys
from typing import TYPE_CHECKING

import click

from pmsmtool.cli.output import show
from pmsmtool.errors import (
    CheckFailed,
    ConfigError,
    Declined,
    ExitCode,
    Interrupted,
    NotAvailable,
    Partial,
    PmsmtoolError,
    StopNotConfirmed,
    VerifyMismatch,
    decisive,
    related,
)

if TYPE_CHECKING:
    from pathlib import Path

_DISK = (errno.ENOSPC, errno.EROFS, errno.EIO, getattr(errno, "EDQUOT", errno.ENOSPC))
"""Errors of writing that name no file, such as those of standard output."""
_DISK_HINT = "check the path, your rights there and the space on the disk"
_WHAT_IT_GIVES = "`pmsmtool caps` shows what this drive can measure"
"""Next step of what a drive cannot give, where none is named."""


def report(error: BaseException, verbosity: int = 0) -> int:
    """Tell the error on stderr and return the exit code.

    Parameters
    ----------
    error : BaseException
        Whatever left the command.
    verbosity : int
        From 2 on (``-vv``) the traceback is printed too.
    """
    chosen = decisive(error)
    if verbosity >= 2 and not isinstance(chosen, (click.exceptions.Exit, click.Abort)):
        _echo(_traceback(error))
    if isinstance(chosen, click.exceptions.Exit):
        return chosen.exit_code
    if isinstance(chosen, StopNotConfirmed):  # the most urgent line is the last on the screen
        _tell_others(error, chosen)
        _tell(chosen, head_last=True)
        return int(chosen.exit_code)
    if isinstance(chosen, PmsmtoolError):
        _tell(chosen)
        if chosen is not error:
            _tell_others(error, chosen)
        return int(chosen.exit_code)
    if isinstance(chosen, click.ClickException):
        return _tell_usage(chosen)
    if isinstance(chosen, (KeyboardInterrupt, click.Abort)):
        _echo("interrupted")
        return int(ExitCode.INTERRUPTED)
    if isinstance(chosen, OSError) and (chosen.filename is not None or chosen.errno in _DISK):
        place = str(chosen.filename) if chosen.filename is not None else "while writing"
        _tell(ConfigError(chosen.strerror or str(chosen), where=place, hint=_DISK_HINT))
        return int(ExitCode.USAGE)
    return _tell_bug(error)


_LABELS: tuple[tuple[type[PmsmtoolError], str], ...] = (
    (StopNotConfirmed, "STOP NOT CONFIRMED"),
    (Partial, "partial"),
    (CheckFailed, "not good"),
    (Declined, "declined"),
    (Interrupted, "interrupted"),
)


def _tell_others(error: BaseException, told: BaseException) -> None:
    """Name what else went wrong when one error outranked the others."""
    for other in related(error):
        if other is not told and not isinstance(other, BaseExceptionGroup):
            first = (str(other) or "no message").splitlines()[0]
            _echo(f"  {'also:':<8}{type(other).__name__}: {first}")


def _tell(error: PmsmtoolError, *, head_last: bool = False) -> None:
    label = next((text for kind, text in _LABELS if isinstance(error, kind)), "error")
    label = click.style(label, fg="yellow" if isinstance(error, Partial) else "red", bold=True) + ": "
    if not head_last:
        _echo(error.what, label)
    details = error.violations if isinstance(error, ConfigError) else ()
    details = error.differences if isinstance(error, VerifyMismatch) else details
    details = error.missing if isinstance(error, Partial) else details
    for detail in details:
        _echo(f"  - {detail}")
    hint = error.hint or (_WHAT_IT_GIVES if isinstance(error, NotAvailable) else "")
    for name, text in (("where", error.where), ("likely", error.likely), ("try", hint)):
        if text:
            _echo(f"  {name + ':':<8}{text}")
    if head_last:
        _echo(error.what if "hardware stop" in error.what else f"{error.what}; use the hardware stop", label)


def _tell_usage(error: click.ClickException) -> int:
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        _echo(error.format_message())
        return int(ExitCode.USAGE)
    if isinstance(error, click.NoSuchOption) and error.possibilities:  # compared with their dashes, which all share
        from difflib import get_close_matches

        near = [o for o in error.possibilities if get_close_matches(error.option_name.strip("-"), [o.strip("-")])]
        error = click.NoSuchOption(error.option_name, possibilities=near, ctx=error.ctx)
    place = f"{error.ctx.command_path} --help" if isinstance(error, click.UsageError) and error.ctx else ""
    message = error.format_message().strip().replace("a valid integer range", "a whole number")
    message = message.replace("a valid float", "a number").replace("requires an argument", "needs a value behind it")
    _tell(ConfigError(message[:1].lower() + message[1:].rstrip("."), hint=place))
    return int(ExitCode.USAGE)


def _tell_bug(error: BaseException) -> int:
    text = _traceback(error)
    path = _keep(text)
    summary = f"{type(error).__name__}: {error}".splitlines()[0]
    if path is None:
        _echo(text)
    _tell(
        PmsmtoolError(
            f"internal error, this is a bug in pmsmtool: {summary}",
            where=f"traceback in {path}" if path else "traceback above (no folder can be written to keep it)",
            hint="report it with that file; -vv shows the traceback here",
        )
    )
    return int(ExitCode.INTERNAL)


def _traceback(error: BaseException) -> str:
    import traceback

    return "".join(traceback.format_exception(error))


def _keep(text: str) -> Path | None:
    """Write a traceback to the user's folder, or to the temporary one; None when neither can be written."""
    import datetime
    import platform
    import tempfile
    from pathlib import Path

    from pmsmtool import __version__
    from pmsmtool.resources import user_folder

    head = f"pmsmtool {__version__}, Python {platform.python_version()}, {platform.platform()}\n{' '.join(sys.argv)}\n"
    stamp = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%S%fZ")
    folders = [Path(tempfile.gettempdir())]
    with contextlib.suppress(ConfigError):
        folders.insert(0, user_folder() / "crashes")
    for folder in folders:
        path = folder / f"pmsmtool-crash-{stamp}.txt"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.write_text(head + text, encoding="utf-8", errors="backslashreplace")
        except OSError:
            continue
        return path
    return None


def _echo(text: str, label: str = "") -> None:
    show(text.rstrip("\n"), label, err=True)
