# SPDX-License-Identifier: MIT
"""The command ``pmsmtool``: global options, lazy commands, errors to exit codes."""

from __future__ import annotations

import atexit
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
from pmsmtool.cli.command_table import COMPLETE_VARIABLE, LazyGroup
from pmsmtool.cli.failure import report
from pmsmtool.cli.options import VERBOSITY, examples, global_options
from pmsmtool.errors import ExitCode, decisive

if TYPE_CHECKING:
    from types import FrameType

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
    sys.exit(run(sys.argv[1:]))
