# SPDX-License-Identifier: MIT
"""Interrupt every writing or moving command at many moments, by Ctrl-C and by pulling the adapter.

    python -m benchmarks.interrupted_commands                                   # all commands, both ways, 50 moments
    python -m benchmarks.interrupted_commands --command jog flash-params --how adapter --moments 10

A moment is a CAN frame that the tool sends or hears; the moments are spread evenly over the whole run, each is tried in
a run of its own, and the drive stays powered.

*Ctrl-C*: SIGINT at that frame. Wanted: exit code 130, statusword off, everything the drive holds as before; a download
that was through may also leave exactly the new set. A command that only writes says which of them the drive holds.

*Adapter*: from that frame on nothing is sent and nothing received. Wanted: exit code 8 where the machine was energised
(the hardware stop is named), otherwise 3 (or 8); the drive, still powered, off by itself a second later, and its set
the old or the new one, never mixed.

A line per moment that breaks this, and a summary; exit 1 when there is one.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import multiprocessing
import signal
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can

from benchmarks.commissioning import commanded, powered, prepared
from pmsmtool.bus.connect import Connection
from pmsmtool.cia402 import Command, State, state_of
from pmsmtool.commissioning.export import image_of
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.drive_node import is_safe
from pmsmtool.firmware.image import crc32
from pmsmtool.flash.restore import take_backup
from pmsmtool.params.parameter_set import read_parameter_set
from pmsmtool.sim.bus import PmsmSimBus

PROFILE = "interior-2k2"
LIMIT_OBJECTS = ((0x6073, 0), (0x6080, 0), (0x1016, 1), (0x6007, 0))
"""Beside what a backup holds; the configuration date is left out, a value that was written has a new one."""
OWN_STOP_S = 1.0
"""The declared dead-man time is 0.35 s."""
NEW_SET = "new/params.toml"
WAYS = ("ctrl-c", "adapter")
_CONTROLWORD_WRITTEN = b"\x2b\x40\x60\x00"
_STATUSWORD_READ = b"\x4b\x41\x60\x00"
TO_DO = ("hardware stop", "reset the drive")
MEASURING = ("identify", "commission")
JOURNALED = ("flash-params", "restore", "commission")
WRITING = ("flash-params", "restore", "param set")
OLD_SET = ("the set that it held before", "exactly the old set")
COMMANDS = {
    "jog": ("jog", "--current", "2Apk", "--for", "1s"),
    "identify": ("identify",),
    "commission": ("commission",),
    "flash-params": ("flash-params", NEW_SET),
    "restore": ("restore", "old.backup"),
    "param set": ("param", "set", "speed.K_p_nms_per_rad=0.0421"),
}


@dataclass(frozen=True, slots=True)
class Outcome:
    """What an interrupted run left.

    Attributes
    ----------
    moments : int
        Waits, or frames, that the run passed.
    code : int
        Exit code.
    verdict : str
        What the drive held.
    good : bool
        Whether that is what it should be.
    """

    moments: int
    code: int
    verdict: str
    good: bool


@dataclass(frozen=True, slots=True)
class Held:
    """What a drive holds, and whether it is off."""

    everything: Any
    crc: int
    stored: int
    off: bool


def held(channel: str) -> Held:
    """Read a drive through a connection of its own."""
    with Connection(PmsmSimBus(channel)) as connection:
        drive = CanopenDrive(connection, 1)
        entries = {entry.name: entry.old for entry in take_backup(drive.node, drive.identity).entries}
        entries = {name: data for name, data in entries.items() if not name.startswith("configuration_")}
        limits = [drive.node.sdo.read(*where) for where in LIMIT_OBJECTS]
        crcs = drive.parameters.crc_active, drive.parameters.crc_stored
        found = Held((entries, limits), *crcs, is_safe(drive.node.state()))
        drive.close()
    return found


def prepare(command: str, channel: str) -> None:
    """Lay down what the command works on: the new set of a download, the old one of a restore."""
    arguments = ("-i", "pmsmsim", "-c", channel, "--yes")
    if command in ("flash-params", "restore"):
        Path("new").mkdir()
        _must(commanded("tune", PROFILE, "-o", "new/design.toml"))
        _must(commanded("backup", *arguments[:-1], "-o", "old.backup"))
    if command == "restore":
        _must(commanded("flash-params", NEW_SET, *arguments))


def _must(result: tuple[int, str]) -> None:
    code, told = result
    if code != 0:
        raise RuntimeError(f"the preparation failed with exit code {code}: {told}")


class Watch:
    """Every frame that the tool sends or hears, and what happens at one of them.

    Parameters
    ----------
    how : str
        ``ctrl-c`` or ``adapter``.
    moment : int or None
        Number of the frame; ``None``: nothing happens.
    """

    def __init__(self, how: str, moment: int | None) -> None:
        self.how = how
        self.moment = moment
        self.frames = 0
        self.enabled = False
        """As the tool knows it: by the controlword it sent and the statusword it read."""

    @property
    def gone(self) -> bool:
        """Whether the adapter has been pulled."""
        return self.how == "adapter" and self.moment is not None and self.frames >= self.moment

    def passes(self, frame: can.Message) -> bool:
        """Count a frame; return whether it gets through."""
        self.frames += 1
        if self.gone:
            return False
        if self.frames == self.moment:
            signal.raise_signal(signal.SIGINT)
        data = bytes(frame.data)
        if data[:4] == _CONTROLWORD_WRITTEN and data[4] & 0x0F == Command.ENABLE_OPERATION:
            self.enabled = True
        elif data[:4] == _STATUSWORD_READ:
            self.enabled = state_of(int.from_bytes(data[4:6], "little")) is State.OPERATION_ENABLED
        return True

    @contextlib.contextmanager
    def on(self) -> Iterator[None]:
        """Watch every simulated bus of this process."""
        send, receive = PmsmSimBus.send, PmsmSimBus.recv

        def sending(bus: PmsmSimBus, msg: can.Message, timeout: float | None = None) -> None:
            if not self.passes(msg):
                raise can.CanOperationError("No such device")
            send(bus, msg, timeout)

        def receiving(bus: PmsmSimBus, timeout: float | None = None) -> can.Message | None:
            frame = receive(bus, timeout)
            return frame if frame is not None and self.passes(frame) else None

        setattr(PmsmSimBus, "send", sending)  # noqa: B010 - methods are replaced on purpose
        setattr(PmsmSimBus, "recv", receiving)  # noqa: B010
        try:
            yield
        finally:
            setattr(PmsmSimBus, "send", send)  # noqa: B010
            setattr(PmsmSimBus, "recv", receive)  # noqa: B010


def interrupted(how: str, command: str, moment: int | None) -> Outcome:
    """Run a command and interrupt it at the n-th frame; ``None``: a whole run."""
    channel = f"{PROFILE}?nv=drive.nv"
    watch = Watch(how, moment)
    with prepared(), powered(channel) as line:
        prepare(command, channel)
        before = held(channel)
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job would ignore it
        with watch.on():
            code, told = commanded(*COMMANDS[command], "-i", "pmsmsim", "-c", channel, "--yes")
        if moment is None:
            return Outcome(watch.frames, code, "whole run", code == 0)
        if how == "adapter":
            line.clock.wait(OWN_STOP_S)
        after = held(channel)
        verdict, kept = _compare(command, before, after, gone=how == "adapter")
    if how == "ctrl-c":
        wanted = code == 130
        if command in WRITING and not _names_the_set(told, after, before):
            verdict, wanted = f"{verdict}; the set is not named rightly: {told[-300:]!r}", False
    else:
        wanted = code == 8 and all(word in told for word in TO_DO) if watch.enabled else code in (3, 8)
        verdict += ", the machine energised when it went" if watch.enabled else ", nothing energised"
    if not told.strip() or "Traceback" in told:
        verdict, wanted = f"{verdict}; said: {told[-300:]!r}", False
    return Outcome(watch.frames, code, verdict, after.off and kept and wanted)


def _names_the_set(told: str, after: Held, before: Held) -> bool:
    """Whether the message says which set the drive holds, and that is the one it holds."""
    said_old = any(words in told for words in OLD_SET)
    return said_old != ("the drive holds the new set" in told) and said_old == (after.crc == before.crc)


def _compare(command: str, before: Held, after: Held, *, gone: bool) -> tuple[str, bool]:
    """Return what the drive holds now, and whether the command may leave it so.

    With the adapter gone nothing can be restored: limits, staged values and what a measurement has set stay until the
    next run or reset. A download may not leave a mixed *active* set, a measurement not another *stored* one.
    """
    if not after.off:
        return "NOT OFF", False
    if after.everything == before.everything:
        return "off, everything as before", True
    new = {crc32(image_of(read_parameter_set(path))) for path in Path().glob("**/params.toml")}
    if command in JOURNALED and after.crc in new:
        return "off, exactly the new set", True
    if command == "restore" and after.crc != before.crc:
        return "off, exactly the old set", True
    if command == "param set" and after.everything[1] == before.everything[1]:
        return "off, the one value written", True
    if gone and after.crc == before.crc:
        return "off, the active set as before", True
    if gone and command in MEASURING and after.stored == before.stored:
        return "off, values of the measurement until the next reset, the stored set as before", True
    return "CHANGED", False


def one(job: tuple[str, str, int]) -> tuple[int, Outcome]:
    """Interrupt one run; for a pool."""
    how, command, moment = job
    return moment, interrupted(how, command, moment)


def interrupt(command: str, how: str, moments: int, processes: int) -> int:
    """Print the moments that went wrong and a summary; return their number."""
    whole = interrupted(how, command, None)
    places = sorted({max(1, math.ceil((k + 0.5) * whole.moments / moments)) for k in range(moments)})
    print(
        f"{command}, {how}: {whole.moments} moments in a whole run (exit {whole.code}), {len(places)} tried", flush=True
    )
    outcomes: Counter[tuple[int, str]] = Counter()
    wrong = 0 if whole.good else 1
    with multiprocessing.Pool(processes, maxtasksperchild=4) as pool:
        for moment, outcome in pool.imap(one, [(how, command, place) for place in places], chunksize=1):
            outcomes[outcome.code, outcome.verdict] += 1
            if not outcome.good:
                wrong += 1
                print(f"  WRONG at {moment}: exit {outcome.code}, {outcome.verdict}", flush=True)
    for (code, verdict), times in sorted(outcomes.items()):
        print(f"  exit {code}, {verdict}: {times}", flush=True)
    return wrong


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--command", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--how", nargs="+", choices=WAYS, default=WAYS)
    parser.add_argument("--moments", type=int, default=50)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args(argv)
    wrong = sum(
        interrupt(command, how, options.moments, options.processes)
        for command in options.command
        for how in options.how
    )
    print(f"{wrong} moments went wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
