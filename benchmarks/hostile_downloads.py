# SPDX-License-Identifier: MIT
"""Download a design to a drive whose SDO server does anything, and compare what it then holds with what was told.

    python -m benchmarks.hostile_downloads --runs 1500 --first 1000
    python -m benchmarks.hostile_downloads --runs 150 --family epos4
    python -m benchmarks.hostile_downloads --runs 400 --first 1000 --further

The vice follows from the seed: requests that are lost, altered, or confirmed without being carried out; answers that
are lost, doubled, altered, for another object, with a wrong toggle bit, block count or block size; refusals that are
none; a store that is refused and done, or confirmed and not done; silence. It begins at any frame and lasts for one,
some, or all of them. Afterwards the drive is opened again, without the vice, from its non-volatile memory. Counted as
found: exit code 0 without the whole new set, a set that is neither the old nor the new one, a traceback (exit code 70),
and a set that the same command does not complete once the vice is gone. Exit code 1 when something was found.

With --further: a value altered and read back as asked until the next reset, refusals of a code that CiA 301 does not
have, answers after the next one, reboots, emergencies by the thirty, another node of the same number, and uploads of a
wrong length, size or toggle bit.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from typing import Any
from unittest import mock

import can

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.connect import Connection
from pmsmtool.cli.main import run
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive_maps.drive_map import reference_map
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.line import Frame

PROFILE, NODE, DESIGN = "interior-2k2", 1, "design.toml"
REQUEST, ANSWER, STORE = 0x600 + NODE, 0x580 + NODE, 0x1010
ALIVE, EMERGENCY = 0x700 + NODE, 0x80 + NODE
VICES = (
    "request lost", "request altered", "request only confirmed", "store only confirmed", "store done and refused",
    "answer lost", "answer twice", "answer altered", "answer for another object", "wrong toggle bit",
    "refused and done", "busy", "wrong block count", "wrong block size", "end of a block lost", "silent",
)  # fmt: skip
FURTHER = (
    "altered and read back as asked", "unknown refusal", "answer after the next", "reboots", "emergencies", "twin",
    "length of a value wrong", "size of an upload wrong", "wrong toggle bit of an upload",
)  # fmt: skip
UNKNOWN_CODE = 0x08FF_1234
"""An abort code that CiA 301 does not have."""
CODES = (AbortCode.VALUE, AbortCode.DEVICE_STATE, AbortCode.NOT_STORED, AbortCode.GENERAL, AbortCode.TIMED_OUT)


class Vice:
    """What a server does wrong, and when; ``index`` is the object of the present transfer."""

    def __init__(self, seed: int, kinds: Sequence[str] = VICES) -> None:
        self.random = random.Random(seed)
        self.kind = self.random.choice(kinds)
        self.first = self.random.choice((0, 0, 3, 10, 20, 40, 80))
        self.count = self.random.choice((1, 1, 3, 20, 10**9))
        self.share = self.random.choice((1.0, 0.3, 0.05))
        self.code = int(self.random.choice(CODES))
        self.index, self.sub, self.writing, self._met = 0, 0, False, 0
        self.hidden: dict[tuple[int, int], bytes] = {}
        self.late: list[bytes] = []

    def __str__(self) -> str:
        return f"{self.kind}, from {self.first}, {self.count} times, {100 * self.share:.0f} %"

    def _strikes(self, *kinds: str) -> bool:
        if self.kind not in kinds:
            return False
        self._met += 1
        return self.first < self._met <= self.first + self.count and self.random.random() < self.share

    def _flipped(self, data: bytes, first: int, last: int) -> bytes:
        place = self.random.randrange(first, last)
        return data[:place] + bytes((data[place] ^ 1 << self.random.randrange(8),)) + data[place + 1 :]

    def request(self, data: bytes) -> tuple[bytes | None, bytes | None]:
        """Return what of a request reaches the drive, and what answers in its stead."""
        command = data[0] >> 5
        if command in (1, 2) or data[0] & 0xE1 == 0xC0:
            self.index, self.sub, self.writing = int.from_bytes(data[1:3], "little"), data[3], command != 2
        if not self.writing:
            return data, None
        if self._strikes("request lost"):
            return None, None
        if self.kind == FURTHER[0] and command == 1 and data[0] & 2 and self.index != STORE:
            self.hidden.pop((self.index, self.sub), None)
            if self._strikes(FURTHER[0]):
                self.hidden[self.index, self.sub] = data[4:]
                return self._flipped(data, 4, 8 - (data[0] >> 2 & 3)), None
        if command == 1 and data[0] & 2:
            if self._strikes("request altered"):
                return self._flipped(data, 4, 8 - (data[0] >> 2 & 3)), None
            if self._strikes("request only confirmed") or (
                self.index == STORE and self._strikes("store only confirmed")
            ):
                return None, b"\x60" + data[1:4] + bytes(4)
        return data, None

    def answer(self, data: bytes) -> list[bytes]:
        """Return what of an answer reaches the tool."""
        refusal = b"\x80" + self.index.to_bytes(2, "little") + bytes((self.sub,)) + self.code.to_bytes(4, "little")
        if self._strikes("silent"):
            return []
        if self.late or self._strikes("answer after the next"):
            self.late, told = ([], [data, *self.late]) if self.late else ([data], [])
            return told
        if not self.writing and data[0] & 0xE2 == 0x42 and (self.index, self.sub) in self.hidden:
            return [data[:4] + self.hidden[self.index, self.sub]]
        if not self.writing and data[0] & 0xE3 == 0x43 and self._strikes("length of a value wrong"):
            return [bytes((data[0] ^ 4,)) + data[1:]]
        if data[0] == 0x41 and self._strikes("size of an upload wrong"):
            return [data[:4] + bytes((data[4] + 1 & 0xFF,)) + data[5:]]
        if not self.writing and data[0] >> 5 == 0 and self._strikes("wrong toggle bit of an upload"):
            return [bytes((data[0] ^ 0x10,)) + data[1:]]
        if data[0] >> 5 in (1, 3) and self._strikes("unknown refusal"):
            return [refusal[:4] + UNKNOWN_CODE.to_bytes(4, "little")]
        if not self.writing:
            expedited = data[0] & 0xE2 == 0x42
            return (
                [self._flipped(data, 4, 8 - (data[0] >> 2 & 3))]
                if expedited and self._strikes("answer altered")
                else [data]
            )
        if self._strikes("answer lost"):
            return []
        if self._strikes("answer twice"):
            return [data, data]
        if data[0] >> 5 in (1, 3) and self._strikes("refused and done"):
            return [refusal]
        if self._strikes("busy"):
            return [refusal[:4] + int(AbortCode.DEVICE_STATE).to_bytes(4, "little")]
        if data[0] == 0x60 and self.index == STORE and self._strikes("store done and refused"):
            return [refusal]
        if data[0] == 0x60 and self._strikes("answer for another object"):
            return [data[:3] + bytes((data[3] ^ 1,)) + data[4:]]
        if data[0] >> 5 == 1 and self._strikes("wrong toggle bit"):
            return [bytes((data[0] ^ 0x10,)) + data[1:]]
        if data[0] == 0xA2 and self._strikes("wrong block count"):
            return [data[:1] + bytes((self.random.choice((0, 1, data[1] // 2, 127, 255)),)) + data[2:]]
        if data[0] == 0xA2 and self._strikes("wrong block size"):
            return [data[:2] + bytes((self.random.choice((0, 1, 128, 255)),)) + data[3:]]
        return [] if data[0] & 0xE3 == 0xA1 and self._strikes("end of a block lost") else [data]


@contextlib.contextmanager
def vicious(vice: Vice) -> Any:
    """Put a vice between every program's adapter and the line."""
    send, hear = PmsmSimBus.send, PmsmSimBus.hear

    def sent(bus: PmsmSimBus, message: can.Message, timeout: float | None = None) -> None:
        if message.arbitration_id != REQUEST:
            return send(bus, message, timeout)
        if vice._strikes("reboots"):
            return send(bus, can.Message(arbitration_id=0, data=(0x81, NODE), is_extended_id=False), timeout)
        passed, instead = vice.request(bytes(message.data))
        if instead is not None:
            hear(bus, Frame(ANSWER, instead), False)
        if passed is not None:
            send(bus, can.Message(arbitration_id=REQUEST, data=passed, is_extended_id=False), timeout)
        return None

    def heard(bus: PmsmSimBus, frame: Frame, own: bool) -> None:
        if frame.can_id == ALIVE and frame.data[:1] == bytes(1):
            vice.hidden.clear()  # it starts again: what it shows is what it holds
        if frame.can_id == ANSWER and vice._strikes("emergencies"):
            for k in range(30):
                hear(bus, Frame(EMERGENCY, bytes((k, 0x82, 0x11, 0, 0, 0, 0, 0))), False)
        if frame.can_id == ANSWER and vice._strikes("twin"):
            hear(bus, Frame(ALIVE, bytes((vice.random.choice((0, 4, 5, 127)),))), False)
        for data in vice.answer(frame.data) if frame.can_id == ANSWER else [frame.data]:
            hear(bus, frame._replace(data=data), own)

    with mock.patch.multiple(PmsmSimBus, send=sent, hear=heard):
        yield


def told(*arguments: str) -> tuple[int, str]:
    """Run a command; return its exit code and what it printed."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        return run([*arguments]), out.getvalue()


def held(channel: str, family: str) -> dict[str, bytes]:
    """Return every parameter of the drive, as it starts from its memory."""
    rows = load_family(family) if family else reference_map()
    with Connection(PmsmSimBus(channel)) as connection:
        node = DriveNode(connection, NODE)
        return {name: node.sdo.read(*rows.address(name)) for name in rows.cells}


def main(argv: Sequence[str] | None = None) -> int:
    """Print every run, and how often each exit code met which set; the exit code 1 says that something was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--family", default="", help="the face of another maker's drive")
    parser.add_argument(
        "--further", action="store_true", help="other vices: lies that hold until a reset, reboots, twins"
    )
    asked = parser.parse_args(argv)
    face = f"drive={asked.family}&" if asked.family else ""
    by_map = ("--map", asked.family) if asked.family else ()
    ends: Counter[str] = Counter()
    found = 0
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        os.environ["PMSMTOOL_HOME"] = folder

        def flash(name: str) -> tuple[int, str]:
            channel = f"{PROFILE}?{face}nv={folder}/{name}"
            return told("--yes", "flash-params", DESIGN, *by_map, "-i", "pmsmsim", "-c", channel)

        told("tune", PROFILE, "-o", DESIGN)
        old = held(f"{PROFILE}?{face}nv={folder}/old", asked.family)
        if flash("new")[0]:
            raise SystemExit("without a vice the download fails")
        new = held(f"{PROFILE}?{face}nv={folder}/new", asked.family)
        for seed in range(asked.first, asked.first + asked.runs):
            vice, name = Vice(seed, FURTHER if asked.further else VICES), f"drive{seed}"
            with vicious(vice):
                code, text = flash(name)
            now = held(f"{PROFILE}?{face}nv={folder}/{name}", asked.family)
            state = "new" if now == new else "old" if now == old else "mixed"
            again = flash(name)[0] if code else 0
            whole = not code or held(f"{PROFILE}?{face}nv={folder}/{name}", asked.family) == new
            bad = code == 70 or state == "mixed" or (code == 0 and state != "new") or again != 0 or not whole
            found += bad
            ends[f"exit {code}, {state} set"] += 1
            print(f"{seed} exit {code} {state}: {vice}{'  FOUND' if bad else ''}", flush=True)
            if bad:
                print(text)
    for end, count in ends.most_common():
        print(f"{count:6d}  {end}")
    print(f"{found} of {asked.runs} found")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
