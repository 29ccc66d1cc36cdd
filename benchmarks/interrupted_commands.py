# SPDX-License-Identifier: MIT
"""Interrupt every writing or moving command at many moments, in five ways, and look at the drive and at what was said.

    python -m benchmarks.interrupted_commands                                   # all commands, all ways, 50 moments
    python -m benchmarks.interrupted_commands --command jog flash-params --how adapter --moments 10
    python -m benchmarks.interrupted_commands --command flash-params restore --every 10
    python -m benchmarks.interrupted_commands --command flash-params --store-window
    python -m benchmarks.interrupted_commands --command "commission --resume" --every 10   # its flash stage

A moment is a CAN frame that the tool sends or hears; the moments are spread evenly over the whole run (or: every N-th
frame, or every millisecond from the request to store on), each is tried in a run of its own.

*ctrl-c*: SIGINT at that frame. Wanted: exit code 130, statusword off, everything the drive holds as before; a download
that was through may also leave exactly the new set. A command that only writes says which of them the drive holds.
*adapter*: from that frame on nothing is sent and nothing received, as when a server vanishes. Wanted: exit code 8 where
the machine was energised (the hardware stop is named), otherwise 3 (or 8).
*kill*: the tool is gone. *power*: the drive loses its supply, the tool goes on; it is back when the tool has ended.
*freeze*: the tool stands still for three seconds and goes on; the commands end as they do, but not in a traceback.

After each: the drive off by itself within a second, its set the old or the new one, never mixed. An open journal may be
left where the tool was killed or cut off; then `restore` must end well, with exactly the old set.

A line per moment that breaks this, and a summary; exit 1 when there is one. `map learn` is interrupted by
``interrupted_learning.py``.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import multiprocessing
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
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
from pmsmtool.flash.journal import JournalFolder
from pmsmtool.flash.restore import take_backup
from pmsmtool.params.parameter_set import read_parameter_set
from pmsmtool.sim.bus import PmsmSimBus

PROFILE = "interior-2k2"
CHANNEL = f"{PROFILE}?nv=drive.nv"
ON_THE_DRIVE = ("-i", "pmsmsim", "-c", CHANNEL, "--yes")
LIMIT_OBJECTS = ((0x6073, 0), (0x6080, 0), (0x1016, 1), (0x6007, 0))
"""Beside what a backup holds; the configuration date is left out, a value that was written has a new one."""
OWN_STOP_S = 1.0
"""The declared dead-man time is 0.35 s."""
NEW_SET = "new/params.toml"
WAYS = ("ctrl-c", "adapter", "kill", "power", "freeze")
FREEZE_S = 3.0
KILLED = -9
STORE_WINDOW_MS = 380
"""From the request to the last frame (320 ms the store, 35 to 57 what follows)."""
MEMORY_WAIT_S = 2.0
"""A store that was under way ends, a node that booted is up."""
BEFORE_THE_STORE = 20
"""Frames: a commission interrupted there has written a part of the set, and takes it back."""
_STORE_REQUESTED = b"\x23\x10\x10\x01"
_CONTROLWORD_WRITTEN = b"\x2b\x40\x60\x00"
_STATUSWORD_READ = b"\x4b\x41\x60\x00"
_TO_THE_SERVER = 0x600 >> 7
_SPEED_ASKED = b"\xff\x60"
LOOK_EVERY = 20
"""Frames between looks at the drive; where it sends its samples, some ms."""
TO_DO = ("hardware stop", "reset the drive")
MEASURING = ("identify", "commission")
FLASH_STAGE = "commission --resume"
"""A commission that ended while it wrote goes on; the moments lie in its flash stage, with which it begins."""
JOURNALED = ("flash-params", "restore", "commission", FLASH_STAGE)
WRITING = ("flash-params", "restore", "param set", "param set --store")
OLD_SET = ("the set that it held before", "exactly the old set")
COMMANDS = {
    "jog": ("jog", "--current", "2Apk", "--for", "1s"),
    "identify": ("identify",),
    "commission": ("commission",),
    FLASH_STAGE: ("commission", "--resume"),
    "flash-params": ("flash-params", NEW_SET),
    "restore": ("restore", "old.backup"),
    "param set": ("param", "set", "speed.K_p_nms_per_rad=0.0421"),
    "param set --store": ("param", "set", "speed.K_p_nms_per_rad=0.0421", "--store"),
}
ONE_VALUE = ("param set", "param set --store")


class Killed(BaseException):
    """SIGKILL, as far as one process can have it: nothing the tool sends afterwards has an effect."""


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
    journal: str


def held() -> Held:
    """Read a drive through a connection of its own."""
    with Connection(PmsmSimBus(CHANNEL)) as connection:
        drive = CanopenDrive(connection, 1)
        entries = {entry.name: entry.old for entry in take_backup(drive.node, drive.identity).entries}
        entries = {name: data for name, data in entries.items() if not name.startswith("configuration_")}
        limits = [drive.node.sdo.read(*where) for where in LIMIT_OBJECTS]
        crcs = drive.parameters.crc_active, drive.parameters.crc_stored
        journal = JournalFolder(drive.identity).last()
        off = is_safe(drive.node.state())
        found = Held((entries, limits), *crcs, off, "none" if journal is None else journal.state)
        drive.close()
    return found


def begin_commission(folder: Path) -> None:
    """Leave in a folder the run and the drive's memory of a commission that was interrupted while it wrote."""
    moment = None
    for _ in range(2):  # the first run tells when
        with prepared():
            with powered(CHANNEL) as line:
                watch = Watch("ctrl-c", moment, line)
                signal.signal(signal.SIGINT, signal.default_int_handler)
                with watch.on():
                    code, told = commanded("commission", *ON_THE_DRIVE)
            if code != (0 if moment is None else 130):
                raise RuntimeError(f"the preparation ended with exit code {code}: {told}")
            if moment is not None:
                shutil.copytree(Path.cwd(), folder, dirs_exist_ok=True)
            moment = watch.stored_after - BEFORE_THE_STORE


def prepare(command: str) -> None:
    """Lay down what the command works on: the new set of a download, the old one of a restore."""
    if command in ("flash-params", "restore"):
        Path("new").mkdir()
        _must(commanded("tune", PROFILE, "-o", "new/design.toml"))
        _must(commanded("backup", *ON_THE_DRIVE[:-1], "-o", "old.backup"))
    if command == "restore":
        _must(commanded("flash-params", NEW_SET, *ON_THE_DRIVE))


def _must(result: tuple[int, str]) -> None:
    code, told = result
    if code != 0:
        raise RuntimeError(f"the preparation failed with exit code {code}: {told}")


class Watch:
    """Every frame that the tool sends or hears, and what happens at one of them.

    Parameters
    ----------
    how : str
        Of ``WAYS``.
    moment : int or None
        Number of the frame, or milliseconds after the request to store; ``None``: nothing happens.
    line : PmsmSimBus
        A member of the line that stays.
    in_store : bool
        The moment counts from the request to store.
    """

    def __init__(self, how: str, moment: int | None, line: PmsmSimBus, *, in_store: bool = False) -> None:
        self.how = how
        self.moment = moment
        self.line = line
        self.in_store = in_store
        self.frames = 0
        self.written_at: list[int] = []
        """Frames by which the tool wrote an object other than a speed."""
        self.look: Callable[[], None] = lambda: None
        """Called some hundred times a second."""
        self.stored_after = 0
        """Frames until the drive was asked to store."""
        self.stored_until = 0
        """Frames until it has stored and answered."""
        self.enabled = False
        """As the tool knows it: by the controlword it sent and the statusword it read."""
        self.happened = False
        self.over = False
        self._frozen = False
        self._thaws = False

    @property
    def cut_off(self) -> bool:
        """Whether nothing that the tool sends gets through."""
        return self._frozen or (self.happened and self.how in ("adapter", "kill"))

    def passes(self, frame: can.Message) -> None:
        """Count a frame, and let happen what happens at it."""
        self.frames += 1
        data = bytes(frame.data)
        if frame.arbitration_id >> 7 == _TO_THE_SERVER and data[0] >> 5 == 1 and data[1:3] != _SPEED_ASKED:
            self.written_at.append(self.frames)
        if self.frames % LOOK_EVERY == 0:
            self.look()
        if data[:4] == _CONTROLWORD_WRITTEN and data[4] & 0x0F == Command.ENABLE_OPERATION:
            self.enabled = True
        elif data[:4] == _STATUSWORD_READ:
            self.enabled = state_of(int.from_bytes(data[4:6], "little")) is State.OPERATION_ENABLED
        if data[:4] == _STORE_REQUESTED and not self.stored_after:
            self.stored_after = self.frames
            self.line.clock.after(STORE_WINDOW_MS / 1000.0, self._stored)
            if self.in_store and self.moment is not None:
                self.line.clock.after(self.moment / 1000.0, self.happen)
        if not self.in_store and self.frames == self.moment:
            self.happen()

    def happen(self) -> None:
        """Let it happen, unless the command has ended."""
        if self.over:
            return
        self.happened = True
        if self.how == "ctrl-c":
            signal.raise_signal(signal.SIGINT)
        elif self.how == "error":
            raise RuntimeError("an error that nobody expects")
        elif self.how == "power":
            self.line.line.nodes[0].power_cut()
        self._thaws = self.how == "freeze"

    def _stored(self) -> None:
        self.stored_until = self.frames

    def stand_still(self) -> None:
        """A frozen tool sends nothing, the heartbeat least of all; what arrives waits in its queue."""
        self._thaws, self._frozen = False, True
        self.line.clock.wait(FREEZE_S)
        self._frozen = False

    @contextlib.contextmanager
    def on(self) -> Iterator[None]:
        """Watch every simulated bus of this process."""
        send, receive = PmsmSimBus.send, PmsmSimBus.recv

        def sending(bus: PmsmSimBus, msg: can.Message, timeout: float | None = None) -> None:
            if self.cut_off and self.how == "adapter":
                raise can.CanOperationError("No such device")
            if not self.cut_off:
                send(bus, msg, timeout)
                self.passes(msg)

        def receiving(bus: PmsmSimBus, timeout: float | None = None) -> can.Message | None:
            if self._thaws:
                self.stand_still()
            frame = receive(bus, timeout)
            if self.cut_off and self.how == "kill":
                raise Killed
            if frame is not None and not self.cut_off:
                self.passes(frame)
            return None if self.cut_off else frame

        setattr(PmsmSimBus, "send", sending)  # noqa: B010 - methods are replaced on purpose
        setattr(PmsmSimBus, "recv", receiving)  # noqa: B010
        try:
            yield
        finally:
            setattr(PmsmSimBus, "send", send)  # noqa: B010
            setattr(PmsmSimBus, "recv", receive)  # noqa: B010


def interrupted(how: str, command: str, moment: int | None, begun: Path, *, in_store: bool = False) -> Outcome:
    """Run a command and interrupt it at the n-th frame, or so many ms into the store; ``None``: a whole run."""
    arguments = COMMANDS[command]
    with contextlib.ExitStack() as stack:
        stack.enter_context(prepared())
        if command == FLASH_STAGE:
            shutil.copytree(begun, Path.cwd(), dirs_exist_ok=True)
            arguments = (*arguments, *map(str, Path("runs").iterdir()))
        line = stack.enter_context(powered(CHANNEL))
        watch = Watch(how, moment, line, in_store=in_store)
        prepare(command)
        before = held()
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job would ignore it
        with watch.on():
            code, told = commanded(*arguments, *ON_THE_DRIVE)
            watch.over = True
            if how == "kill" and watch.happened:
                code, told = KILLED, "nothing"
            if moment is None:
                frames = watch.stored_until if command == FLASH_STAGE else watch.frames
                return Outcome(watch.stored_after if in_store else frames, code, "whole run", code == 0)
            if how != "ctrl-c":
                line.clock.wait(OWN_STOP_S)
        line.line.nodes[0].power_on()
        line.clock.wait(MEMORY_WAIT_S)
        after = held()
        verdict, kept = _compare(command, before, after, gone=how in ("adapter", "kill", "power"))
        if kept and after.journal == "open":
            verdict, kept = _recovered(verdict, before, may=how in ("adapter", "kill", "power"))
    if how == "ctrl-c":
        wanted = code == 130 or not watch.happened
        if command in WRITING and watch.happened and not _names_the_set(told, after, before):
            verdict, wanted = f"{verdict}; the set is not named rightly: {told[-300:]!r}", False
    elif how == "adapter":
        wanted = code == 8 and all(word in told for word in TO_DO) if watch.enabled else code in (3, 8)
        verdict += ", the machine energised when it went" if watch.enabled else ", nothing energised"
    else:
        wanted = code != 70 and (code != 0 or after.off)
    if not told.strip() or "Traceback" in told:
        verdict, wanted = f"{verdict}; said: {told[-300:]!r}", False
    return Outcome(watch.frames, code, verdict, after.off and kept and (wanted or not watch.happened))


def _recovered(verdict: str, before: Held, *, may: bool) -> tuple[str, bool]:
    """Whether `restore` closes a journal that was left open, with exactly what was held before."""
    if not may:
        return f"{verdict}; THE JOURNAL IS LEFT OPEN", False
    code, told = commanded("restore", *ON_THE_DRIVE)
    found = held()
    if code == 0 and found.crc == before.crc and found.stored in (before.stored, found.crc) and found.journal != "open":
        return f"{verdict}; restored", True
    return f"{verdict}; RESTORE FAILED, exit {code}: {told[-300:]!r}", False


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
    if command in ONE_VALUE and _differ(before, after) <= 1:
        return "off, the one value written", True
    if gone and after.crc == before.crc and after.stored in {before.stored, *new}:
        return "off, the active set as before", True
    if gone and command in MEASURING and after.stored == before.stored:
        return "off, values of the measurement until the next reset, the stored set as before", True
    return "CHANGED", False


def _differ(before: Held, after: Held) -> int:
    """Number of the values that a backup holds and that differ, but for the mark of the set."""
    (old, limits), (new, limits_now) = before.everything, after.everything
    changed = [name for name, data in new.items() if old.get(name) != data and name != "design_id"]
    return len(changed) + int(limits != limits_now)


def one(job: tuple[str, str, int, Path, bool]) -> tuple[int, Outcome]:
    """Interrupt one run; for a pool."""
    how, command, moment, begun, in_store = job
    return moment, interrupted(how, command, moment, begun, in_store=in_store)


def interrupt(command: str, how: str, begun: Path, options: argparse.Namespace) -> int:
    """Print the moments that went wrong and a summary; return their number."""
    in_store = bool(options.store_window)
    whole = interrupted(how, command, None, begun, in_store=in_store)
    if in_store:
        places = list(range(STORE_WINDOW_MS)) if whole.moments else []
    elif options.every:
        places = list(range(1, whole.moments + 1, options.every))
    else:
        places = sorted(
            {max(1, math.ceil((k + 0.5) * whole.moments / options.moments)) for k in range(options.moments)}
        )
    print(
        f"{command}, {how}: {whole.moments} moments in a whole run (exit {whole.code}), {len(places)} tried", flush=True
    )
    outcomes: Counter[tuple[int, str]] = Counter()
    wrong = 0 if whole.good else 1
    with multiprocessing.Pool(options.processes, maxtasksperchild=16) as pool:
        jobs = [(how, command, place, begun, in_store) for place in places]
        for moment, outcome in pool.imap(one, jobs, chunksize=1):
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
    parser.add_argument("--every", type=int, help="every N-th frame instead")
    parser.add_argument("--store-window", action="store_true", help="every ms from the request to store on instead")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        begun = Path(folder)
        if FLASH_STAGE in options.command:
            begin_commission(begun)
        wrong = sum(interrupt(command, how, begun, options) for command in options.command for how in options.how)
    print(f"{wrong} moments went wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
