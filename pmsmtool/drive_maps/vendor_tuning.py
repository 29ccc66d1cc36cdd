# SPDX-License-Identifier: MIT
"""How a drive's own identification is started and where its results stand: facts of a drive map, nothing is moved here.

Two kinds are known. ``os_command``: the OS command object of CiA 301 (0x1023, with its mode 0x1024) takes the number of
a measurement and answers with its result. ``mode``: a mode of operation of its maker's (0x6060 below zero), started by
a bit of the controlword and ended by one of the statusword; the results then stand in objects of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from pmsmtool.drive_maps.drive_map import Cell

Kind = Literal["os_command", "mode"]
Order = Literal["little", "big"]

OS_COMMAND = 0x1023
"""OS command (CiA 301, 7.5.2.26): sub 1 takes a command and starts it, sub 2 tells its status, sub 3 the answer."""
OS_COMMAND_MODE = 0x1024
"""OS command mode (CiA 301, 7.5.2.27)."""
EXECUTE_AT_ONCE, ABORT = 0, 3
"""Values of 0x1024: the next command is carried out at once; the present one is given up."""
COMMAND_BYTES = 8
"""Length of a command and of an answer: number, then data; status, reserved, then data."""
DATA_AT = 2
"""First byte of the data in an answer; in that of a failed command the error code."""
DONE, DONE_WITH_DATA, FAILED, FAILED_WITH_CODE = 0, 1, 2, 3
"""Status of a command that has ended; everything else: it is running."""

RESULTS: Mapping[str, str] = {
    "motor.pole_pairs": "poles",
    "motor.R_s_ohm": "R",
    "motor.L_d_h": "L",
    "motor.L_q_h": "L",
    "motor.psi_f_wb": "psi",
}
"""What a drive's own identification may tell, by catalogue name, and the quantity ``identify`` asks for it by."""
SET_UP = "set-up"
"""Name of the one step of kind ``mode``."""


@dataclass(frozen=True, slots=True)
class VendorStep:
    """One measurement of the drive's own.

    Attributes
    ----------
    name : str
        Catalogue name of its result, or what it checks.
    timeout_s : float
        Longest time it may take (s).
    turns : bool
        Whether the shaft must be free to turn.
    moves : str
        What it does to the machine, as a person reads it before consenting.
    command : int
        Its number as OS command.
    uses : tuple of str
        Catalogue names of results the drive works with: written into it before, as far as they were measured.
    failures : mapping of int to str
        Its own error codes.
    """

    name: str
    timeout_s: float
    turns: bool
    moves: str
    command: int = 0
    uses: tuple[str, ...] = ()
    failures: Mapping[int, str] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Its name as a person reads it."""
        return self.name.removeprefix("motor.")


@dataclass(frozen=True, slots=True)
class VendorTuning:
    """The drive's own identification.

    Attributes
    ----------
    kind : str
        ``os_command`` or ``mode``.
    mode : int
        Mode of operation in which the drive is enabled for it.
    steps : mapping of str to VendorStep
        In the order in which they run.
    results : mapping of str to Cell
        By catalogue name; of kind ``os_command`` the answer's data, whose address is that of the answer.
    order : str
        Byte order of the data in an answer.
    failures : mapping of int to str
        Error codes that every OS command may answer.
    start_bit, done_bit : int
        Bits of controlword and statusword, kind ``mode``.
    source : str
        Key of ``DriveMap.sources``.
    """

    kind: Kind
    mode: int
    steps: Mapping[str, VendorStep]
    results: Mapping[str, Cell]
    order: Order = "little"
    failures: Mapping[int, str] = field(default_factory=dict)
    start_bit: int = 4
    done_bit: int = 12
    source: str = ""

    @property
    def quantities(self) -> frozenset[str]:
        """What can be asked of it, as ``identify`` names it."""
        return frozenset(RESULTS[name] for name in self.results)

    def steps_for(self, quantities: frozenset[str], *, turning: bool) -> tuple[VendorStep, ...]:
        """Return the steps that tell the quantities, with what they use and all checks, in order.

        Parameters
        ----------
        turning : bool
            Whether the shaft may turn.
        """
        if self.kind == "mode":
            return tuple(step for step in self.steps.values() if turning or not step.turns)
        wanted = {name for name in self.results if RESULTS[name] in quantities}
        for step in reversed(tuple(self.steps.values())):
            if step.name in wanted:
                wanted |= set(step.uses)
        chosen = (step for step in self.steps.values() if step.name in wanted or step.name not in self.results)
        return tuple(step for step in chosen if turning or not step.turns)


@dataclass(frozen=True, slots=True)
class VendorAnswer:
    """What a drive answered to one step.

    Attributes
    ----------
    step : str
        Name of the step.
    data : bytes
        Bytes of its results as they came, OS commands with their status in front; empty where there is none.
    seconds : float
        Time it took (s).
    values : dict of str to float
        Results by catalogue name, SI.
    relative_to : dict of str to float
        What they were counted relative to.
    """

    step: str
    data: bytes
    seconds: float
    values: dict[str, float]
    relative_to: dict[str, float]
