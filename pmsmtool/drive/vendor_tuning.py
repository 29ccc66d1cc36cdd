# SPDX-License-Identifier: MIT
"""A drive's own identification, started and read by OS commands of CiA 301.

The drive moves the machine by itself. Of the envelope it keeps its own limits (0x6073, 0x6080); the rest is watched by
the guard, which stops it. What it answers is taken as it is.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from pmsmtool.bus.connection import Connection
from pmsmtool.bus.sdo import Retry
from pmsmtool.cia402 import State
from pmsmtool.drive import objects
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.standard_drive import StandardDrive
from pmsmtool.drive_maps.drive_map import DriveMap
from pmsmtool.drive_maps.vendor_tuning import (
    ABORT,
    COMMAND_BYTES,
    DATA_AT,
    DONE_WITH_DATA,
    EXECUTE_AT_ONCE,
    FAILED,
    FAILED_WITH_CODE,
    OS_COMMAND,
    OS_COMMAND_MODE,
    VendorAnswer,
    VendorStep,
    VendorTuning,
)
from pmsmtool.errors import BusError, DriveFault, DriveTimeout, NotAvailable, SdoAbort

POLL_S = 0.1
"""The drive is asked this often whether it has finished; the guard looks at the machine in between."""
GIVE_UP_S = 2.0
"""Longest time in which a drive must tell that it gave a command up."""
COMMAND_MODE = DriveObject(OS_COMMAND_MODE, 0, "B")

Wait = Callable[[float], None]
"""Lets time pass; the guard's."""


class VendorDrive(StandardDrive):
    """A drive that identifies its machine by itself, enabled in the mode that this takes.

    Raises
    ------
    NotAvailable
        Its map does not say how.
    """

    def __init__(self, connection: Connection, node_id: int, *, drive_map: DriveMap | None = None) -> None:
        super().__init__(connection, node_id, drive_map=drive_map)
        self.commands_bounded_current = False  # it moves by itself
        tuning = self.node.map.vendor_tuning
        if tuning is None:
            raise NotAvailable(
                "the drive's map does not state how its own identification is started",
                where=f"node {node_id}",
                hint="[vendor_tuning] of the map (firmware-params/README.md)",
            )
        self.tuning: VendorTuning = tuning
        self._commanded = False

    # ---- the port -------------------------------------------------------------------------------

    def enable(self) -> None:
        """Bring the drive to operation enabled in its maker's mode; nothing is started yet."""
        if self.node.whole(objects.MODE_DISPLAY) != self.tuning.mode:
            try:
                self.node.put(objects.MODE, self.tuning.mode)
            except SdoAbort as abort:
                raise NotAvailable(
                    f"the drive has no mode of operation {self.tuning.mode}, which its own identification needs",
                    where=abort.where,
                    likely="other firmware than the map is for",
                    hint="compare mode of [vendor_tuning] in the map with the manual of this firmware",
                ) from abort
        self.may_be_energised = True
        self.node.enable()

    def quick_stop(self) -> None:
        """Stop and confirm it; an OS command that runs is given up then, so that the next one is taken."""
        super().quick_stop()
        self._give_up()

    def _give_up(self) -> None:
        if not self._commanded:
            return
        self._commanded = False
        with contextlib.suppress(BusError, SdoAbort):  # the machine is off: what is left is for the next command
            self.node.put(COMMAND_MODE, ABORT)
            deadline = self.node.connection.clock.now() + GIVE_UP_S
            while self._read_answer()[0] > FAILED_WITH_CODE and self.node.connection.clock.now() < deadline:
                self.node.connection.wait(POLL_S)
            self.node.put(COMMAND_MODE, EXECUTE_AT_ONCE)

    # ---- steps ----------------------------------------------------------------------------------

    def carry_out(self, step: VendorStep, wait: Wait, known: dict[str, float]) -> VendorAnswer:
        """Start a step, wait for its end, and read its results.

        Raises DriveFault: the drive refuses, fails, or leaves operation; its error code is told with its meaning;
        DriveTimeout: it does not end in its time.

        Parameters
        ----------
        step : VendorStep
            Of the drive's map.
        wait : callable
            Lets time pass under the guard's eyes.
        known : dict of str to float
            Results so far, for what is counted relative to them.
        """
        node = self.node
        began = node.connection.clock.now()
        node.put(COMMAND_MODE, EXECUTE_AT_ONCE)
        if self._read_answer()[0] > FAILED_WITH_CODE:  # reading it also takes an old answer away
            raise DriveFault(
                "another OS command is running in the drive",
                where=f"node {node.node}, 0x1023:03",
                hint="wait until it has ended, or end the program that started it",
            )
        self._commanded = True
        node.sdo.download(OS_COMMAND, 1, bytes((step.command,)).ljust(COMMAND_BYTES, b"\0"), retry=Retry.NEVER)
        while True:
            answer = self._read_answer()
            if answer[0] <= FAILED_WITH_CODE:
                self._commanded = False
                self._check_answer(step, answer)
                seconds = node.connection.clock.now() - began
                return VendorAnswer(step.name, answer, seconds, self._answered(step, answer, known), dict(known))
            if node.state() in (State.FAULT, State.FAULT_REACTION_ACTIVE):
                raise node.fault_error()
            self.check_operating()
            if node.connection.clock.now() >= began + step.timeout_s:
                raise DriveTimeout(
                    f"the drive's own identification ({step.title}) does not end within {step.timeout_s:g} s",
                    where=f"node {node.node}",
                    likely="a shaft that does not turn as it should, or other firmware than the map is for",
                    hint="timeout_s in [vendor_tuning] of the map, if this drive needs more time",
                )
            wait(POLL_S)

    def _read_answer(self) -> bytes:
        answer = self.node.sdo.read(OS_COMMAND, 3)
        if len(answer) < COMMAND_BYTES:
            raise DriveFault(
                f"the answer to an OS command has {len(answer)} bytes, expected {COMMAND_BYTES}",
                where=f"node {self.node.node}, 0x1023:03",
                hint="compare order and data of [vendor_tuning] in the map with the manual of this firmware",
            )
        return answer

    def _check_answer(self, step: VendorStep, answer: bytes) -> None:
        if answer[0] not in (FAILED, FAILED_WITH_CODE):
            return
        text = "no reason is given"
        if answer[0] == FAILED_WITH_CODE:
            code = answer[DATA_AT]
            known = step.failures.get(code) or self.tuning.failures.get(code)
            text = known or f"its error code {code} is not in the map"
        raise DriveFault(
            f"the drive's own identification failed ({step.title}): {text}",
            where=f"node {self.node.node}, 0x1023:03 = {answer.hex(' ')}",
            hint="remove the cause and run the command again; the drive holds what it held before",
        )

    def _answered(self, step: VendorStep, answer: bytes, known: dict[str, float]) -> dict[str, float]:
        cell = self.tuning.results.get(step.name)
        if cell is None:
            return {}
        if answer[0] != DONE_WITH_DATA:
            raise DriveFault(
                f"the drive's own identification ({step.title}) ended without a result",
                where=f"node {self.node.node}, 0x1023:03 = {answer.hex(' ')}",
                likely="other firmware than the map is for",
                hint="compare [vendor_tuning] of the map with the manual of this firmware",
            )
        data = answer[DATA_AT : DATA_AT + cell.size]
        return {step.name: cell.decode(data[::-1] if self.tuning.order == "big" else data, known)}
