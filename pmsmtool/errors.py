# SPDX-License-Identifier: MIT
"""Errors and exit codes of pmsmtool.

::

    PmsmtoolError                      70  a bug, unless a subclass says better
    +-- ConfigError (ValueError)        2  bad file, bad flag, bad value; lists every violation
    +-- BusError                        3  no bus, no drive, connection lost
    |   +-- DriveTimeout (TimeoutError) 3  the drive did not answer in time
    +-- DriveFault                      4  drive in fault, or it refused a value
    |   +-- SdoAbort                    4  an SDO transfer was aborted, with the abort code
    +-- SafetyRefusal                   5  refused for safety before anything moved or was written
    |   +-- LimitExceeded               5  a quantity is outside its limit
    +-- IdentificationError             6  the measurement is not trustworthy; no number is given
    +-- Declined                        7  the person said no, or nobody could be asked
    +-- StopNotConfirmed                8  the machine may be energised; outranks every other error
    +-- NotAvailable                    9  this drive cannot give that; what is missing is named
    +-- Partial                        10  what ran is good, but something asked for could not be had; it is named
    +-- CheckFailed                     1  checked and not good (margin, compare, prove)
        +-- Contradiction               1  machine file, drive and measurement contradict each other
        +-- VerifyMismatch              1  read back differs from what was written
        +-- DesignInfeasible            1  no design satisfies the request

``Interrupted`` (130) is a BaseException-free sibling raised after a confirmed safe stop.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import IntEnum
from typing import TypedDict, Unpack


class ExitCode(IntEnum):
    """Exit codes of the command line (``pmsmtool help exit-codes``)."""

    OK = 0
    CHECK_FAILED = 1
    USAGE = 2
    BUS = 3
    DRIVE = 4
    SAFETY = 5
    NOT_TRUSTWORTHY = 6
    DECLINED = 7
    STOP_NOT_CONFIRMED = 8
    NOT_AVAILABLE = 9
    PARTIAL = 10
    INTERNAL = 70
    INTERRUPTED = 130
    READER_GONE = 141


class Said(TypedDict, total=False):
    """What every error may say besides what happened; see :class:`PmsmtoolError`."""

    where: str
    likely: str
    hint: str


class PmsmtoolError(Exception):
    """Base of all errors a user can meet.

    Parameters
    ----------
    what : str
        What happened, one sentence.
    where : str
        File and key, or node and object ("node 5, 0x6040:00"); empty when there is no place.
    likely : str
        The most likely cause.
    hint : str
        The next step to take.
    """

    exit_code = ExitCode.INTERNAL

    def __init__(self, what: str, *, where: str = "", likely: str = "", hint: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.where = where
        self.likely = likely
        self.hint = hint

    def __str__(self) -> str:
        parts = [f"{self.where}: {self.what}" if self.where else self.what]
        if self.likely:
            parts.append(f"likely: {self.likely}")
        if self.hint:
            parts.append(f"try: {self.hint}")
        return "\n".join(parts)


class ConfigError(PmsmtoolError, ValueError):
    """A file, flag or value is not usable; ``violations`` lists all that is wrong, not the first."""

    exit_code = ExitCode.USAGE

    def __init__(self, what: str, *, violations: Sequence[str] = (), **said: Unpack[Said]) -> None:
        super().__init__(what, **said)
        self.violations = tuple(violations)

    def __str__(self) -> str:
        lines = [super().__str__()]
        lines[1:] = [f"  - {violation}" for violation in self.violations]
        return "\n".join(lines)


@contextmanager
def next_step(hint: str) -> Iterator[None]:
    """Give what is refused inside a next step, where it names none of its own; also a decorator, of a format's reader.

    ``hint``: what to do with a file of this format that cannot be used.
    """
    try:
        yield
    except ConfigError as error:
        error.hint = error.hint or hint
        raise


class BusError(PmsmtoolError):
    """No bus, no drive on it, or the connection was lost."""

    exit_code = ExitCode.BUS


class DriveTimeout(BusError, TimeoutError):
    """The drive did not answer within its deadline."""


class DriveFault(PmsmtoolError):
    """The drive is in fault, or refuses what was asked."""

    exit_code = ExitCode.DRIVE


class SdoAbort(DriveFault):
    """An SDO transfer ended with an abort.

    Parameters
    ----------
    code : int
        CiA 301 abort code (table 22), e.g. 0x06090030.
    index, sub : int
        The object of the transfer.
    """

    def __init__(self, code: int, index: int, sub: int, what: str, **said: Unpack[Said]) -> None:
        super().__init__(what, **said)
        self.code = code
        self.index = index
        self.sub = sub


class SafetyRefusal(PmsmtoolError):
    """Refused for safety: nothing was energised, nothing was written."""

    exit_code = ExitCode.SAFETY


class LimitExceeded(SafetyRefusal):
    """A quantity is outside its safety limit."""

    def __init__(self, quantity: str, value: float, limit: float, unit: str, **said: Unpack[Said]) -> None:
        super().__init__(f"{quantity} {value:.4g} {unit} is outside the limit {limit:.4g} {unit}", **said)
        self.quantity = quantity
        self.value = value
        self.limit = limit
        self.unit = unit


class IdentificationError(PmsmtoolError):
    """A measurement that must not be trusted: no number is given.

    Parameters
    ----------
    reason : str
        Name of the detected trap, e.g. ``E_MODEL_MISMATCH`` (``pmsmtool help refusals``).
    """

    exit_code = ExitCode.NOT_TRUSTWORTHY

    def __init__(self, reason: str, what: str, **said: Unpack[Said]) -> None:
        super().__init__(f"{reason}: {what}", **said)
        self.reason = reason


class Declined(PmsmtoolError):
    """The person declined, or there was no terminal to ask on."""

    exit_code = ExitCode.DECLINED


class StopNotConfirmed(PmsmtoolError):
    """The drive did not confirm that it stopped: use the hardware stop."""

    exit_code = ExitCode.STOP_NOT_CONFIRMED


class NotAvailable(PmsmtoolError):
    """This drive cannot give what was asked; the message names what is missing."""

    exit_code = ExitCode.NOT_AVAILABLE


class Partial(PmsmtoolError):
    """What ran is good, but something asked for could not be had; ``missing`` has one line each."""

    exit_code = ExitCode.PARTIAL

    def __init__(self, what: str, *, missing: Sequence[str] = (), **said: Unpack[Said]) -> None:
        super().__init__(what, **said)
        self.missing = tuple(missing)

    def __str__(self) -> str:
        return "\n".join([super().__str__(), *(f"  - {line}" for line in self.missing)])


class CheckFailed(PmsmtoolError):
    """Checked and not good."""

    exit_code = ExitCode.CHECK_FAILED


class Contradiction(CheckFailed):
    """Machine file, drive and measurement contradict each other; nothing was written."""


class VerifyMismatch(CheckFailed):
    """What the drive holds differs from what it should hold; ``differences`` has one line each."""

    def __init__(self, what: str, *, differences: Sequence[str] = (), **said: Unpack[Said]) -> None:
        super().__init__(what, **said)
        self.differences = tuple(differences)

    def __str__(self) -> str:
        return "\n".join([super().__str__(), *(f"  - {line}" for line in self.differences)])


class DesignInfeasible(CheckFailed):
    """No design satisfies what was asked."""


class Interrupted(PmsmtoolError):
    """Interrupted by the person, after a confirmed safe stop."""

    exit_code = ExitCode.INTERRUPTED


def related(error: BaseException) -> Iterator[BaseException]:
    """Yield an error, what it was raised from or during, and the members of groups, each once."""
    seen: set[int] = set()
    waiting: list[BaseException | None] = [error]
    while waiting:
        current = waiting.pop(0)
        if current is None or id(current) in seen:
            continue
        seen.add(id(current))
        yield current
        if isinstance(current, BaseExceptionGroup):
            waiting.extend(current.exceptions)
        waiting.extend((current.__cause__, current.__context__))


def decisive(error: BaseException) -> BaseException:
    """Return the error that decides the exit code.

    A stop that was not confirmed outranks whatever was raised before, after or because of it. Of a group, the
    first error of our own decides.
    """
    for candidate in related(error):
        if isinstance(candidate, StopNotConfirmed):
            return candidate
    if isinstance(error, BaseExceptionGroup):
        members = (member for member in related(error) if isinstance(member, (PmsmtoolError, KeyboardInterrupt)))
        return next(members, error)
    return error


def exit_code_of(error: BaseException) -> ExitCode:
    """Return the exit code of a program that an error ends; an error that is not ours is a bug.

    A broken pipe is neither: whoever read the output went away, as from a filter that SIGPIPE ends (128 + 13).
    """
    chosen = decisive(error)
    if isinstance(chosen, PmsmtoolError):
        return chosen.exit_code
    if isinstance(chosen, BrokenPipeError):
        return ExitCode.READER_GONE
    return ExitCode.INTERRUPTED if isinstance(chosen, KeyboardInterrupt) else ExitCode.INTERNAL
