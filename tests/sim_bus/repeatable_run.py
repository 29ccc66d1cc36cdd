"""A short life of a simulated drive on a lossy bus; prints hashes of every frame and of the trace.

``python tests/sim_bus/repeatable_run.py SEED`` from the root of the checkout.
"""

from __future__ import annotations

import hashlib
import struct
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from pmsmtool.sim.bus import PmsmSimBus
from tests.node.raw_client import Lost, RawClient

FAULTS = '[[frame]]\naction = "drop"\nprobability = 0.002\n[[frame]]\naction = "duplicate"\nprobability = 0.002\n'


def patiently(client: RawClient, index: int, sub: int, value: float, kind: str) -> None:
    for _ in range(5):
        try:
            client.put(index, sub, value, kind)
        except Lost:
            client.drain()
        else:
            return


def run(seed: int) -> tuple[str, str]:
    """Return hashes of all frames with their times, and of the recorded trace."""
    with tempfile.TemporaryDirectory() as folder:
        faults = Path(folder) / "faults.toml"
        faults.write_text(FAULTS, encoding="utf-8")
        channel = f"interior-2k2?nv=:memory:&seed={seed}&bitrate=500000&faults={faults}"
        bus = PmsmSimBus(channel)
        witness = PmsmSimBus(channel, receive_own_messages=True)
        trace = _commission(bus)
        frames = hashlib.sha256()
        while (message := witness.recv(0.0)) is not None:
            frames.update(struct.pack("<dI", message.timestamp, message.arbitration_id) + message.data)
        bus.shutdown()
        witness.shutdown()
        return frames.hexdigest(), hashlib.sha256(trace).hexdigest()


def _commission(bus: PmsmSimBus) -> bytes:
    client = RawClient(bus, timeout_s=0.3)
    patiently(client, 0x6060, 0, -1, "b")
    for word in (6, 7, 15):
        patiently(client, 0x6040, 0, word, "H")
    patiently(client, 0x2052, 1, 2.0, "f")
    for channel, sub in enumerate((1, 2, 5, 11, 14), 1):
        patiently(client, 0x2061, channel, 0x20700020 | sub << 8, "I")
    patiently(client, 0x2060, 2, 500, "I")
    patiently(client, 0x2060, 7, 1, "B")
    bus.clock.wait(0.2)
    for _ in range(10):
        try:
            return client.read_block(0x2062)
        except Lost:
            client.abort(0x2062, 0)
            client.drain()
    raise RuntimeError("the trace did not come through")


if __name__ == "__main__":
    sys.stdout.write(" ".join(run(int(sys.argv[1]))) + "\n")
