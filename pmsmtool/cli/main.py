# SPDX-License-Identifier: MIT
"""The command ``pmsmtool``: global options, lazy commands, and what a person and a script read of an error."""

from __future__ import annotations

import atexit
import contextlib
import errno
import gc
import io
import os
import select
import signal
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TextIO

import click

from pmsmtool import __version__
from pmsmtool.bus.clock import PutOff
from pmsmtool.cli.command_table import COMPLETE_VARIABLE, LazyGroup
from pmsmtool.cli.options import VERBOSITY, examples, global_options
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
from pmsmtool.files import user_folder

if TYPE_CHECKING:
    from pathlib import Path
    from types import FrameType

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


PROGRAM = "pmsmtool"

_GARBAGE_THRESHOLD = 100_000
"""Objects made before Python looks for cycles among them. A simulation ends with 43 000, imports nearly all: to search
them on the way, and once more at exit, took 30 of 240 ms."""


@click.group(
    PROGRAM,
    cls=LazyGroup,
    context_settings={
        "help_option_names": ["-h", "--help"],
        "max_content_width": 120,
        "auto_envvar_prefix": "PMSMTOOL",
        "show_default": True,
    },
    epilog=examples("pmsmtool help units", "pmsmtool help exit-codes"),
)
@global_options
@click.version_option(__version__, "-V", "--version", prog_name=PROGRAM, message="%(prog)s %(version)s")
def cli(**_: Any) -> None:
    """Commission permanent-magnet synchronous motor drives over CANopen.

    Identify the machine, design its control, check it in simulation, flash it, prove it. The sections below say what
    a command does to the machine. Options before a command hold for it as if they stood after it.
    """


def run(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code; errors are told on stderr."""
    context: click.Context | None = None
    try:
        with cli.make_context(PROGRAM, list(arguments)) as context:
            cli.invoke(context)
        sys.stdout.flush()
    except BaseException as error:
        if isinstance(decisive(error), BrokenPipeError) and _reader_gone():
            return int(ExitCode.READER_GONE)
        code = report(error, _verbosity(context))
        return int(ExitCode.READER_GONE) if _reader_gone() and code == 0 else code
    return 0


def _verbosity(context: click.Context | None) -> int:
    if context is None:
        return 0
    # A command that was reached knows the options after it too.
    return int(context.meta.get(VERBOSITY, context.params.get("verbose", 0)))


def _reader_gone() -> bool:
    """Whether nobody reads standard output or standard error any more.

    What could not be written is given up, so that Python's own exit neither tries again nor changes the exit code.
    """
    gone = [_is_given_up(stream) for stream in (sys.stdout, sys.stderr)]
    return any(gone)


def _is_given_up(stream: TextIO) -> bool:
    try:
        descriptor = stream.fileno()
    except (OSError, ValueError):
        return False  # no file of the system behind it
    try:
        stream.flush()
        gone = given_up = _pipe_is_broken(descriptor)
    except OSError as error:
        gone, given_up = isinstance(error, BrokenPipeError), True
    if given_up:
        os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
    return gone


def _pipe_is_broken(descriptor: int) -> bool:
    """Ask the system, for a write that failed leaves nothing to flush."""
    if not hasattr(select, "poll"):
        return False  # Windows: only a failing flush tells
    question = select.poll()
    question.register(descriptor, select.POLLOUT)
    return any(event & select.POLLERR for _, event in question.poll(0))


def _open_standard_streams() -> None:
    """Give up what a closed standard stream would have carried (``>&-``), as if it were redirected to the null device.

    Otherwise the next file that is opened gets its number, and what is printed goes into that file.
    """
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            mode = "r" if name == "stdin" else "w"
            null = os.open(os.devnull, os.O_RDONLY if name == "stdin" else os.O_WRONLY)
            if null != descriptor:
                os.dup2(null, descriptor)
                os.close(null)
            setattr(sys, name, open(descriptor, mode, encoding="utf-8", closefd=False))  # noqa: SIM115 - for good


def _interrupt(number: int, frame: FrameType | None) -> None:
    # Whoever puts Ctrl-C off puts this off, too; SIGINT itself may be ignored, in a background job of a shell.
    handler = signal.getsignal(signal.SIGINT)
    if not callable(handler):
        raise KeyboardInterrupt
    handler(number, frame)


def main() -> None:
    """Entry point of the program."""
    # One thread: more add up in another order, and a replay on a host with other processors would differ in the last
    # digits; to start them takes 50 ms, too.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _open_standard_streams()
    gc.set_threshold(_GARBAGE_THRESHOLD)
    atexit.register(gc.freeze)  # what is left at exit goes with the process
    if COMPLETE_VARIABLE in os.environ:
        from click.shell_completion import shell_complete

        sys.exit(shell_complete(cli, {}, PROGRAM, COMPLETE_VARIABLE, os.environ[COMPLETE_VARIABLE]))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a console without the letter must not end a command
    # Being ended by the system must stop the machine like Ctrl-C does: through every finally on the way out.
    for name in ("SIGTERM", "SIGHUP", "SIGBREAK"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), _interrupt)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, PutOff(signal.default_int_handler))
    sys.exit(run(sys.argv[1:]))
