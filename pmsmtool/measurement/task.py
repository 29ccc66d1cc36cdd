# SPDX-License-Identifier: MIT
"""What one identification is given, whatever the method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.experiments.supply_levels import ReadSupply
from pmsmtool.identification.request import IdentifyRequest
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.measurement.capabilities import Capabilities
from pmsmtool.run_directory import RunDirectory
from pmsmtool.trace import Trace

Keep = Callable[[str, Trace], None]
"""Stores a trace by its name."""
Say = Callable[[str], None]
Allow = Callable[[Sequence[str]], None]
"""Returns when a person agreed to these lines, else raises ``Declined``."""
Known = tuple[MachineFile, str]
"""A machine file and where it comes from."""


@dataclass(frozen=True, slots=True)
class Task:
    """One identification.

    Attributes
    ----------
    run : RunDirectory
        Where everything goes.
    drive : CanopenDrive
        Opened as the method needs it.
    found : Capabilities
        What the drive has.
    request : IdentifyRequest
        What is asked.
    known : MachineFile and its source, or None
        What completes the measured values.
    read_supply : callable or None
        Reads the bench supply where R is asked for so.
    """

    run: RunDirectory
    drive: CanopenDrive
    found: Capabilities
    request: IdentifyRequest
    known: Known | None = None
    read_supply: ReadSupply | None = None

    @property
    def machine(self) -> MachineFile | None:
        """The machine file alone."""
        return None if self.known is None else self.known[0]
