# SPDX-License-Identifier: MIT
"""Simulated drives that lie: every command that moves or writes against random vices, on virtual time.

    python -m benchmarks.lying_drives [--cases 200] [--first 0] [--eds FILE ...] [--show CODE]

From a seed follow a drive (the reference drive, a family, or a node of a maker's file), a command, and one to three
vices: refusals of any object, answers with another index or toggle, doubled and late frames, a second node with the
same id, a heartbeat of another state, floods of emergencies, a reset in the middle, numbers that change between two
reads or come back rounded, a statusword that is not true, a controlword that is taken and not obeyed, modes, names and
identities that cannot be. Counted are tracebacks, exit codes that do not exist, control characters on the terminal,
commands that do not end, and drives whose voltage is on when the program says that it is off (any exit code but 8).
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

from pmsmtool.machine.machine_file import machine_path
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.line import Frame

MACHINE = "interior-2k2"
LONGEST_WALL_S, LONGEST_BUS_S = 150.0, 1500.0
CODES = (*range(11), 130)
NOT_CONFIRMED = 8
FAMILIES = ("", "epos4", "copley", "elmo", "faulhaber", "nanotec", "epos2")
TARGETS = (
    0x1000, 0x1001, 0x1010, 0x1016, 0x1017, 0x1018, 0x1020, 0x100C, 0x6007, 0x603F, 0x6040, 0x6041, 0x605A, 0x6060,
    0x6061, 0x6064, 0x606C, 0x6071, 0x6073, 0x6075, 0x6076, 0x6077, 0x6078, 0x6080, 0x608F, 0x60FF, 0x6502,
)  # fmt: skip
CODES_OF_ABORTS = (
    0x06020000, 0x06010000, 0x06010001, 0x06010002, 0x06090011, 0x06090030, 0x06070010, 0x05040000,
    0x05040001, 0x05030000, 0x08000000, 0x08000020, 0x08000022, 0x060A0023, 0xFFFFFFFF, 0,
)  # fmt: skip
NAMES = (b"\x1b[2J\x1b]0;owned\x07", b"n" * 10_000, bytes(range(256)), b"", b"\xff\xfe drive \xe2\x80\xae")
COMMANDS: tuple[str, ...] = (
    "--yes identify", "--yes identify mechanics", "--yes check {machine}", "--yes jog --current 1Apk --for 0.2s",
    "--yes jog --speed 100rpm --for 0.2s", "--yes move --by 90deg", "--yes commission {machine}",
    "--yes flash-params {design}{map}", "--yes param set speed.K_p_nms_per_rad=0.1{map}",
    "backup -o b2.json --force{map}", "--yes restore b.json", "fault reset", "fault show", "stop", "caps",
    "info", "verify {design}{map}", "scan", "monitor --for 0.3s", "--yes prove {design}{map}",
    "--yes map learn speed.K_p_nms_per_rad --machine {machine}", "nmt start", "doctor", "param dump{map}",
)  # fmt: skip


@dataclass
class Liar:
    """The vices of one case, between the drive and the program's adapter."""

    rng: random.Random
    vices: dict[str, object]
    bus: PmsmSimBus | None = None
    asked: tuple[int, int] = (0, 0)
    written: set[tuple[int, int]] = field(default_factory=set)
    energised: bool = False
    began_s: float = 0.0

    def on(self, name: str) -> bool:
        """Whether a vice acts now."""
        return name in self.vices and self.now() >= self.began_s

    def now(self) -> float:
        """Time of the bus (s)."""
        return 0.0 if self.bus is None else self.bus.clock.now()

    # ---- what the program sends -----------------------------------------------------------------

    def sends(self, can_id: int, data: bytes) -> bytes:
        """Return what reaches the drive."""
        if 0x600 < can_id < 0x680 and len(data) == 8:
            kind = data[0] >> 5
            if kind in (1, 2):
                self.asked = data[1] | data[2] << 8, data[3]
            if kind == 1:
                self.written.add(self.asked)
                if self.asked[0] == 0x6040 and self.on("deaf") and not data[4] & 0x08 and self._is_energised():
                    return data[:4] + bytes((0x0F, data[5])) + data[6:]
        return data

    # ---- what the drive says --------------------------------------------------------------------

    def hears(self, frame: Frame, give: Callable[[Frame], None]) -> None:
        """Hand on a frame of the drive, or what becomes of it."""
        can_id, data, rng = frame.can_id, frame.data, self.rng
        if 0x700 < can_id and self.on("heartbeat") and len(data) == 1:
            give(frame._replace(data=bytes((rng.choice((0, 4, 5, 0x7F, 0x99, 0xFF)),))))
            return
        if not 0x580 < can_id < 0x600 or len(data) != 8:
            give(frame)
            return
        changed = self._answer(data)
        frames = [frame._replace(data=changed)]
        if self.on("other index") and rng.random() < 0.1:
            frames.insert(0, frame._replace(data=changed[:1] + rng.randbytes(3) + changed[4:]))
        if self.on("toggle") and changed[0] >> 5 in (0, 1) and rng.random() < 0.2:
            frames = [frame._replace(data=bytes((changed[0] ^ 0x10,)) + changed[1:])]
        if self.on("twice") and rng.random() < 0.3:
            frames.append(frames[-1])
        if self.on("second node") and changed[0] & 0xE0 == 0x40:
            frames.append(frame._replace(data=changed[:4] + rng.randbytes(4)))
        if self.on("short") and rng.random() < 0.02:
            frames = [frame._replace(data=changed[: rng.randrange(8)])]
        for each in frames:
            if self.on("late") and rng.random() < 0.05 and self.bus is not None:
                self.bus.clock.after(rng.choice((0.05, 0.31, 0.6, 1.5)), lambda each=each: give(each))  # type: ignore[misc]
            else:
                give(each)

    def _answer(self, data: bytes) -> bytes:
        index, sub = self.asked
        head, kind = data[1:4], data[0] & 0xE0
        if self.on("abort") and kind in (0x40, 0x60) and (
            index == self.vices["abort"] or (not self.vices["abort"] and self.rng.random() < 0.01)
        ):  # fmt: skip
            return b"\x80" + head + self.rng.choice(CODES_OF_ABORTS).to_bytes(4, "little")
        if kind != 0x40 or not data[0] & 2:
            return data
        size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
        number = int.from_bytes(data[4 : 4 + size], "little")
        if index == 0x6041 and self.on("statusword"):
            said = self.vices["statusword"]
            number = self.rng.getrandbits(16) if said is None else int(said)  # type: ignore[call-overload]
        elif index == self.vices.get("changing") and self.on("changing"):
            number = self.rng.getrandbits(8 * size)
        elif index == self.vices.get("frozen") and self.on("frozen"):
            number = 7
        elif (index, sub) in self.written and index >= 0x2000 and index not in (0x6040, 0x6060) and self.on("rounded"):
            number ^= 1
        else:
            return data
        return data[:4] + (number % (1 << 8 * size)).to_bytes(size, "little") + bytes(4 - size)

    # ---- what nobody asked for ------------------------------------------------------------------

    def joined(self, bus: PmsmSimBus) -> None:
        """Arm what goes by the clock, and what the dictionary holds."""
        self.bus = bus
        node = bus.line.nodes[0]
        session = node.session
        if session is None:
            return
        find = session.dictionary.find
        with contextlib.suppress(Exception):
            for name, index, sub in (("name", 0x1008, 0), ("modes", 0x6502, 0)):
                if name in self.vices:
                    entry = find(index, sub)
                    entry.source, entry.value = None, bytes(self.vices[name])  # type: ignore[call-overload]
            if "identity" in self.vices:
                for sub in (1, 2, 4):
                    find(0x1018, sub).value = bytes(self.vices["identity"])  # type: ignore[call-overload]
        if "reset" in self.vices:
            bus.clock.after(self.began_s, lambda: session.command_nmt(0x81))
        if "flood" in self.vices:
            self._flood()

    def _flood(self) -> None:
        if self.bus is None or not self.bus._open:
            return
        code = self.rng.choice((b"\0\0\0", self.rng.randbytes(3)))
        frame = Frame(0x80 + self.bus.line.nodes[0].node_id, code + bytes(5), 0, 8)
        if self.on("flood"):
            self.bus.line.deliver(None, frame)
        self.bus.clock.after(0.02, self._flood)

    def left(self, bus: PmsmSimBus) -> None:
        """Note whether a drive is left with its voltage on."""
        self.energised = self._is_energised()

    def _is_energised(self) -> bool:
        nodes = () if self.bus is None else self.bus.line.nodes
        return any(node.session is not None and node.session.is_energised() for node in nodes)


VICES: dict[str, Callable[[random.Random], object]] = {
    "abort": lambda rng: rng.choice((0, *TARGETS)),
    "rounded": lambda rng: 1,
    "statusword": lambda rng: rng.choice((None, 0x0237, 0x0250, 0x0208, 0x0233, 0x0000, 0xFFFF, 0x0207)),
    "heartbeat": lambda rng: 1,
    "twice": lambda rng: 1,
    "other index": lambda rng: 1,
    "toggle": lambda rng: 1,
    "late": lambda rng: 1,
    "short": lambda rng: 1,
    "second node": lambda rng: 1,
    "reset": lambda rng: 1,
    "flood": lambda rng: 1,
    "changing": lambda rng: rng.choice((0x1018, *TARGETS)),
    "frozen": lambda rng: rng.choice((0x6064, 0x606C, 0x6077, 0x6078, 0x6061, 0x6041)),
    "name": lambda rng: rng.choice(NAMES),
    "modes": lambda rng: rng.choice((bytes(4), b"\xff" * 4, b"\x01\0\0\0", b"\0\x02\0\0")),
    "identity": lambda rng: rng.choice((bytes(4), b"\xff" * 4)),
    "deaf": lambda rng: 1,
}
UNKNOWABLE = frozenset({"statusword", "changing", "frozen", "second node", "abort"})
"""With these a drive may hide that its voltage is on."""


def case_of(seed: int, files: list[str]) -> tuple[str, str, Liar]:
    """Return channel, command and vices of a seed."""
    rng = random.Random(f"lies {seed}")
    family = rng.choice((*FAMILIES, *files))
    eds = f"&eds={family}" if family in files else f"&drive={family}" if family else ""
    names = rng.sample(sorted(VICES), rng.choice((1, 1, 1, 2, 3)))
    liar = Liar(rng, {name: VICES[name](rng) for name in names})
    liar.began_s = rng.choice((0.0, 0.0, rng.uniform(0.0, 5.0), rng.uniform(0.0, 30.0)))
    known = f" --map {family}" if family in FAMILIES and family else ""
    command = rng.choice(COMMANDS).format(machine=machine_path(MACHINE), design="design.toml", map=known)
    return f"{MACHINE}?nv=:memory:{eds}", command, liar


@contextlib.contextmanager
def lying(liar: Liar):  # type: ignore[no-untyped-def]
    """Put a liar between the simulated line and every bus of the program."""
    init, hear, send, shutdown = PmsmSimBus.__init__, PmsmSimBus.hear, PmsmSimBus.send, PmsmSimBus.shutdown

    def begin(self: PmsmSimBus, *args: object, **kwargs: object) -> None:
        init(self, *args, **kwargs)  # type: ignore[arg-type]
        liar.joined(self)

    def heard(self: PmsmSimBus, frame: Frame, own: bool) -> None:
        if own:
            hear(self, frame, own)
        else:
            liar.hears(frame, lambda each: hear(self, each, own))

    def sent(self: PmsmSimBus, msg, timeout=None) -> None:  # type: ignore[no-untyped-def]
        msg.data = bytearray(liar.sends(msg.arbitration_id, bytes(msg.data)))
        send(self, msg, timeout)

    def ended(self: PmsmSimBus) -> None:
        if self._open:
            liar.left(self)
        shutdown(self)

    with (
        mock.patch.object(PmsmSimBus, "__init__", begin), mock.patch.object(PmsmSimBus, "hear", heard),
        mock.patch.object(PmsmSimBus, "send", sent), mock.patch.object(PmsmSimBus, "shutdown", ended),
    ):  # fmt: skip
        yield


def examine(seed: int, files: list[str]) -> tuple[str, int, str, list[str]]:
    """Run one case; return what it was, its exit code, what was printed, and what must not be."""
    from pmsmtool.cli.main import run

    channel, command, liar = case_of(seed, files)
    printed = io.StringIO()
    began = time.monotonic()
    with (
        lying(liar),
        mock.patch("click.utils.should_strip_ansi", return_value=False),
        mock.patch("click.style", lambda text, **given: text),
        contextlib.redirect_stdout(printed),
        contextlib.redirect_stderr(printed),
    ):
        code = run(["--sim", channel, *command.split()])
    wall_s, text = time.monotonic() - began, printed.getvalue()
    odd = sorted({c for c in text if not (c.isprintable() or c in "\n\t\r")})
    wrong = []
    if code not in CODES or "Traceback" in text:
        wrong.append(f"exit {code}")
        for crash in Path("crashes").glob("*"):
            wrong.append(crash.read_text(encoding="utf-8")[-1500:])
            crash.unlink()
    if odd:
        wrong.append(f"control characters {odd!r}")
    if wall_s > LONGEST_WALL_S or liar.now() > LONGEST_BUS_S:
        wrong.append(f"{wall_s:.0f} s, {liar.now():.0f} s of the bus")
    if liar.energised and code != NOT_CONFIRMED and not UNKNOWABLE & set(liar.vices):
        wrong.append("the voltage is on at the end")
    if code and not text.strip():
        wrong.append("ends without a word")
    shown = {name: value if not isinstance(value, bytes) else value[:8] for name, value in liar.vices.items()}
    return f"{command} on {channel} with {shown} from {liar.began_s:.1f} s", code, text, wrong


def main() -> int:
    """Print a line per case that shows what must not be, and the exit codes; exit code 1 where there is one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--eds", action="append", default=[], metavar="FILE")
    parser.add_argument("--show", type=int, action="append", default=[], metavar="CODE")
    options = parser.parse_args()
    files = [str(Path(name).resolve()) for name in options.eds]
    codes: Counter[str] = Counter()
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        os.environ["PMSMTOOL_HOME"] = folder
        from pmsmtool.cli.main import run

        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            run(["tune", str(machine_path(MACHINE)), "-o", "design.toml"])
            run(["--sim", f"{MACHINE}?nv=:memory:", "backup", "-o", "b.json"])
        for seed in range(options.first, options.first + options.cases):
            began = time.perf_counter()
            what, code, text, wrong = examine(seed, files)
            codes[f"{what.removeprefix('--yes ').split()[0]} {code}"] += 1
            if wrong or code in options.show:
                last = " / ".join(text.strip().splitlines()[-4:])
                print(f"{seed}: {what}: exit {code} ({time.perf_counter() - began:.0f} s): {last[:600]}", flush=True)
            for line in wrong:
                print(f"    WRONG {line}", flush=True)
            bad += bool(wrong)
    for name, count in sorted(codes.items()):
        print(f"{name}: {count}")
    print(f"{options.cases} cases, {bad} with something that must not be")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
