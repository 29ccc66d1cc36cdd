# SPDX-License-Identifier: MIT
"""Random frames at the tool: whatever a node sends, a transfer ends in time with bytes or with an error of ours."""

from __future__ import annotations

import random
from collections.abc import Iterator

from pmsmtool.bus.connection import Connection
from pmsmtool.bus.sdo import Mode, Retry, SdoChannel
from pmsmtool.bus.supervision import Supervision
from pmsmtool.errors import PmsmtoolError
from tests.bus.scripted import NODE, ScriptedBus, ScriptedSlave

LONGEST_S = 60.0
"""Virtual time any transfer may take: three tries of a block transfer with all its silences."""
COMMANDS = (
    0x00,
    0x10,
    0x01,
    0x20,
    0x30,
    0x40,
    0x41,
    0x42,
    0x43,
    0x4F,
    0x60,
    0x80,
    0xA0,
    0xA1,
    0xA2,
    0xA4,
    0xC0,
    0xC1,
    0xC4,
    0xC6,
)
"""What servers say, and what only clients say."""


class RandomSlave(ScriptedSlave):
    """Answers every request with a few random frames, most of them nearly right."""

    def __init__(self, rng: random.Random) -> None:
        super().__init__()
        self.rng = rng

    def answer(self, data: bytes) -> Iterator[bytes]:
        for _ in range(self.rng.choice((0, 1, 1, 1, 1, 2, 3, 130 if self.rng.random() < 0.02 else 1))):
            yield self._frame(data)
        if self.rng.random() < 0.02:
            base = self.rng.choice((0x080, 0x700, 0x180, 0x600))
            self.bus.deliver(base + NODE, self.rng.randbytes(self.rng.randrange(9)))

    def _frame(self, request: bytes) -> bytes:
        rng = self.rng
        command = rng.choice(COMMANDS) | (rng.getrandbits(4) if rng.random() < 0.3 else 0)
        head = request[1:4] if rng.random() < 0.85 else rng.randbytes(3)
        tail = rng.randbytes(4) if rng.random() < 0.5 else rng.choice((0, 1, 7, 20, 127)).to_bytes(4, "little")
        frame = bytes((command & 0xFF,)) + head + tail
        return frame if rng.random() < 0.97 else rng.randbytes(rng.randrange(9))


def transfers(seed: int, count: int) -> dict[str, int]:
    """Run random transfers against a random slave; return how they ended.

    Raises whatever is no error of ours, and AssertionError when one takes too long.
    """
    rng = random.Random(seed)
    ended: dict[str, int] = {}
    bus = ScriptedBus(RandomSlave(rng))
    with Connection(bus) as connection:
        supervision = Supervision(connection, NODE)
        channel = SdoChannel(connection, NODE, timeout_s=0.05, check=supervision.check)
        for _ in range(count):
            started = bus.clock.now()
            bus.sent.clear()
            try:
                _one(channel, rng)
                outcome = "done"
            except PmsmtoolError as error:
                outcome = type(error).__name__
            ended[outcome] = ended.get(outcome, 0) + 1
            assert bus.clock.now() - started < LONGEST_S
            bus.inbox.clear()
    return ended


def _one(channel: SdoChannel, rng: random.Random) -> None:
    mode = rng.choice((Mode.AUTO, Mode.SEGMENTED, Mode.BLOCK))
    if rng.random() < 0.5:
        size = rng.choice((None, 1, 4, 8, 40, 1000))
        data = channel.upload(0x2042, 0, size=size, mode=mode).data
        assert size is None or len(data) == size, "a wrong length was returned as good"
    else:
        channel.download(
            0x2042, 0, rng.randbytes(rng.choice((0, 1, 4, 5, 40, 1000))), mode=mode, retry=rng.choice(list(Retry))
        )
