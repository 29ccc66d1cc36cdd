# SPDX-License-Identifier: MIT
"""A short life of a simulated drive on a lossy bus, worked with the tool; prints hashes of every frame and of a trace.

``python tests/sim_bus/repeatable_run.py SEED`` from the root of the checkout. The guard proves the dead-man, holds a
current, injects a square wave and records it; one frame in 500 is lost and one in 500 comes twice.
"""

from __future__ import annotations

import hashlib
import struct
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from pmsmtool.bus.connect import Connection
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.port import Excitation, Injection, Shape
from pmsmtool.sim.bus import PmsmSimBus

FAULTS = """
[[frame]]
action = "drop"
ids = ["0x581", "0x601"]
probability = 0.002
[[frame]]
action = "duplicate"
ids = ["0x581", "0x601"]
probability = 0.002
"""
SIGNALS = ("i_d_a", "i_q_a", "u_d_v", "theta_e_rad", "i_a_a")


def run(seed: int) -> tuple[str, str]:
    """Return hashes of all frames with their times, and of the recorded trace."""
    with tempfile.TemporaryDirectory() as folder:
        faults = Path(folder) / "faults.toml"
        faults.write_text(FAULTS, encoding="utf-8")
        channel = f"interior-2k2?nv=:memory:&seed={seed}&bitrate=500000&faults={faults}"
        witness = PmsmSimBus(channel, receive_own_messages=True)
        with Connection(PmsmSimBus(channel)) as connection:
            trace = _record(CanopenDrive(connection, 1))
        frames = hashlib.sha256()
        while (message := witness.recv(0.0)) is not None:
            frames.update(struct.pack("<dI", message.timestamp, message.arbitration_id) + message.data)
        witness.shutdown()
        return frames.hexdigest(), hashlib.sha256(trace).hexdigest()


def _record(drive: CanopenDrive) -> bytes:
    square = Excitation(
        Shape.SQUARE, Injection.U_D, 5.0, bias_d_a=1.0, bias_bandwidth_rad_s=94.0, hold_periods=6, fixed_angle_rad=0.0
    )
    with guarded(drive, Envelope(i_max_apk=3.0, speed_max_rad_s=100.0)) as guard:
        guard.enable()
        guard.command_current(1.0, 0.0, fixed_angle_rad=0.0)
        guard.wait(0.2)
        trace = guard.record(SIGNALS, 1024, excitation=square, pretrigger=64)
    return b"".join(trace[name].tobytes() for name in SIGNALS)


if __name__ == "__main__":
    sys.stdout.write(" ".join(run(int(sys.argv[1]))) + "\n")
