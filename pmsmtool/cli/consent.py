# SPDX-License-Identifier: MIT
"""The two consents: the motion envelope before anything moves, the list of differences before anything is written.

Each is asked on its own. ``--yes`` answers them on a simulated bus; on a real one only together with the serial number
of the very drive that answered, so that a line from a script's history cannot move another machine, and for a motion
with ``--i-max``, ``--speed-max`` and ``--shaft``; a drive that shows no serial number is not moved or written by it at
all. Where nobody can be asked, nothing is done (exit code 7).
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Literal

import click

from pmsmtool.cli.options import MotionOptions
from pmsmtool.cli.output import Output, show
from pmsmtool.errors import ConfigError, Declined
from pmsmtool.files import ELSEWHERE, USER_ROOM, refuse_full, user_folder

if TYPE_CHECKING:
    from pmsmtool.run_directory import RunDirectory

Subject = Literal["motion", "writing"]


@dataclass(frozen=True, slots=True)
class Consent:
    """A consent that was given, as the run record keeps it."""

    subject: Subject
    """``motion`` or ``writing``."""
    answer: Literal["prompt", "--yes"]
    """``prompt`` when a person typed it, ``--yes`` otherwise."""
    text: tuple[str, ...]
    """The lines the consent is about."""


def keep(run: RunDirectory, given: Consent) -> None:
    """Put a consent into the record before anything moves: somebody signs it, however the run ends."""
    record = run.read()
    run.write(replace(record, consents=(*record.consents, asdict(given))))


def person_present() -> bool:
    """Whether a question can be seen and answered: stdin and stderr are terminals."""
    return sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty()


def missing_for_yes(options: MotionOptions, subject: Subject = "motion") -> list[str]:
    """Return the options ``--yes`` still needs on a real bus; what only writes needs no limits of a motion."""
    limits = {"--i-max": options.i_max_apk, "--speed-max": options.speed_max_rad_s, "--shaft": options.shaft}
    needed = {**(limits if subject == "motion" else {}), "--serial": options.serial}
    return [name for name, value in needed.items() if value is None]


def refuse_unattended(option: str, names: Iterable[str], options: MotionOptions, *, simulated: bool) -> None:
    """Refuse an ``--accept-...`` option together with ``--yes`` on a real bus: a person accepts, not a script.

    Raises ConfigError: both are given, and the bus is not the simulated drive.
    """
    if list(names) and options.yes and not simulated:
        raise ConfigError(
            f"{option} and --yes exclude each other on a real bus",
            hint=f"leave --yes out and answer the questions, or leave {option} out",
        )


def ask_motion(
    envelope: Iterable[str], options: MotionOptions, *, simulated: bool, serial: int, out: Output
) -> Consent:
    """Show the motion envelope and return the consent to move.

    Raises Declined: the person said no, nobody can be asked, or another drive answered than ``--serial`` names.

    Parameters
    ----------
    envelope : lines
        Largest current, energy, speed, travel, duration, what the shaft may do.
    options : MotionOptions
        From the command line.
    simulated : bool
        The bus is the simulated drive (``BusOptions.simulated``).
    serial : int
        Serial number the drive reports.
    out : Output
        Where the lines go.
    """
    return _ask("motion", "Move the machine within these limits?", tuple(envelope), options, simulated, serial, out)


def ask_writing(
    differences: Iterable[str], options: MotionOptions, *, simulated: bool, serial: int, out: Output
) -> Consent:
    """Show what a download would change and return the consent to write; parameters as :func:`ask_motion`."""
    return _ask("writing", "Write these values to the drive?", tuple(differences), options, simulated, serial, out)


def _ask(
    subject: Subject,
    question: str,
    text: tuple[str, ...],
    options: MotionOptions,
    simulated: bool,
    serial: int,
    out: Output,
) -> Consent:
    refuse_full(user_folder(), USER_ROOM, hint=ELSEWHERE)  # first: nobody agrees to what cannot be done
    # shown even when quiet: nobody consents to what he has not seen; a simulated drive may go without
    if not (simulated and options.yes and out.verbosity < 0):
        for line in text:
            show(line, err=True)
    if options.serial is not None and options.serial != serial:
        raise Declined(
            f"the drive's serial number is {serial}, --serial says {options.serial}: nothing was done",
            likely="another drive answers on this node",
            hint="check channel and node; `pmsmtool info` shows the drive",
        )
    missing = missing_for_yes(options, subject)
    if not serial:
        missing.append("a drive that shows its serial number")
    if options.yes and (simulated or not missing):
        return Consent(subject, "--yes", text)
    if options.yes:
        out.warn(f"--yes alone answers only for a simulated drive; missing here: {', '.join(missing)}")
    if not person_present():
        raise Declined(
            f"no terminal to ask for consent to {_NAMES[subject]}: {_NOTHING[subject]}",
            likely="standard input or standard error is not a terminal",
            hint="--yes" if simulated or not missing else _lacking(missing, serial),
        )
    try:
        agreed = click.confirm(question, default=False, err=True)
    except click.Abort:
        agreed = False
    if not agreed:
        raise Declined(
            f"consent to {_NAMES[subject]} was not given: {_NOTHING[subject]}",
            hint="run the command again and answer y, when all that is shown above is right",
        )
    return Consent(subject, "prompt", text)


def _lacking(missing: list[str], serial: int) -> str:
    if not serial:
        return "run it in a terminal: this drive shows no serial number; without one --yes is not possible"
    return f"run it in a terminal, or give --yes {' '.join(f'{name} ...' for name in missing)}"


_NAMES: dict[Subject, str] = {"motion": "move the machine", "writing": "write to the drive"}
_NOTHING: dict[Subject, str] = {"motion": "nothing was moved", "writing": "nothing was written"}
