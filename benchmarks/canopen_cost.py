# SPDX-License-Identifier: MIT
"""CPU cost of CANopen traffic on the simulated bus, as a ratio to canopen's LocalNode on python-can's virtual bus.

Run from the repository: ``python benchmarks/canopen_cost.py``. Both drives live in this process. The stock client
(canopen's RemoteNode, reader thread and all) talks to both; the tool's own channel and a bare frame loop show what the
drive itself costs. LocalNode has no block transfer, so its 64 KiB travel in segments. Times are CPU times of the
whole process, best of several runs; wire times are those of the simulated bus at 1 Mbit/s, counted bit by bit.
"""

from __future__ import annotations

import json
import logging
import random
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import canopen

sys.path.insert(0, str(Path(__file__).parent.parent))

from pmsmtool.bus.connect import Connection
from pmsmtool.bus.sdo import Mode, SdoChannel
from pmsmtool.files import data_folder
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.node.objects import FILE_NAME

ROUNDS = 2000
REPEATS = 5
TRACE_BYTES = 65536
EXPEDITED_TARGET_US = 150.0
BLOCK_TARGET_S = 0.25
READ = bytes.fromhex("4010200200000000")
EDS = str(data_folder("firmware-params") / "pmsmsim" / FILE_NAME)
CHANNEL = "interior-2k2?nv=:memory:&bitrate=1000000"


def best_cpu_s(run: Callable[[], object], repeats: int = REPEATS) -> float:
    """CPU time of the fastest of several runs (s)."""
    fastest = float("inf")
    for _ in range(repeats):
        start = time.process_time()
        run()
        fastest = min(fastest, time.process_time() - start)
    return fastest


def record_full_trace(channel: SdoChannel) -> None:
    """Fill the drive's recorder."""
    for number in range(8):
        channel.download(0x2061, number + 1, (0x20700120 + (number << 8)).to_bytes(4, "little"))
    channel.download(0x2060, 2, (2048).to_bytes(4, "little"))
    channel.download(0x2060, 7, b"\1")
    channel.connection.wait(1.0)


def bare_loop(bus: can.BusABC) -> None:
    """Expedited reads without any client around them."""
    request = can.Message(arbitration_id=0x601, data=READ, is_extended_id=False)
    for _ in range(ROUNDS):
        bus.send(request)
        while (answer := bus.recv(1.0)) is None or answer.arbitration_id != 0x581:
            pass


def own_channel() -> dict[str, float]:
    """Costs with the bare loop and with the tool's channel."""
    with Connection(PmsmSimBus(CHANNEL)) as connection:
        bus, channel = connection.bus, SdoChannel(connection, 1)
        line = bus.line  # type: ignore[attr-defined]
        result = {"bare_us": best_cpu_s(lambda: bare_loop(bus)) / ROUNDS * 1e6}
        reads = best_cpu_s(lambda: [channel.read(0x2010, 2) for _ in range(ROUNDS)])
        result["channel_us"] = reads / ROUNDS * 1e6
        record_full_trace(channel)
        before = line.wire_ns
        if len(channel.upload(0x2062, 0, mode=Mode.BLOCK).data) != TRACE_BYTES:
            raise RuntimeError("the trace is not complete")
        result["block_wire_s"] = (line.wire_ns - before) / 1e9
        result["block_s"] = best_cpu_s(lambda: channel.upload(0x2062, 0, mode=Mode.BLOCK))
        result["segmented_s"] = best_cpu_s(lambda: channel.upload(0x2062, 0, mode=Mode.SEGMENTED), 2)
    return result


def stock_client(network: canopen.Network, index: int) -> dict[str, float]:
    """Costs with canopen's RemoteNode: expedited reads, 64 KiB in segments."""
    node: Any = network.add_node(1, EDS)
    node.sdo.RESPONSE_TIMEOUT = 2.0
    reads = best_cpu_s(lambda: [node.sdo.upload(0x2010, 2) for _ in range(ROUNDS)])
    segments = best_cpu_s(lambda: node.sdo.upload(index, 0), 2)
    return {"expedited_us": reads / ROUNDS * 1e6, "segmented_s": segments}


def stock_on_simulated() -> dict[str, float]:
    """The stock client against our drive."""
    network = canopen.Network(PmsmSimBus(CHANNEL))
    with Connection(PmsmSimBus(CHANNEL)) as connection:
        record_full_trace(SdoChannel(connection, 1))
    network.connect()
    try:
        return stock_client(network, 0x2062)
    finally:
        network.disconnect()


def stock_on_local_node() -> dict[str, float]:
    """The stock client against the stock server."""
    server = canopen.Network()
    server.connect(interface="virtual", channel="canopen_cost", ignore_config=True)
    local: Any = server.create_node(1, EDS)
    local.sdo[0x2010][2].raw = 0.137
    local.set_data(0x2062, 0, random.Random(1).randbytes(TRACE_BYTES))
    client = canopen.Network()
    client.connect(interface="virtual", channel="canopen_cost", ignore_config=True)
    try:
        return stock_client(client, 0x2062)
    finally:
        client.disconnect()
        server.disconnect()


def main() -> None:
    """Measure and print."""
    logging.disable(logging.CRITICAL)
    own, simulated, local = own_channel(), stock_on_simulated(), stock_on_local_node()
    result = {
        "expedited read, bare frames, us": own["bare_us"],
        "expedited read, tool's channel, us": own["channel_us"],
        "expedited read, stock client on our drive, us": simulated["expedited_us"],
        "expedited read, stock client on LocalNode, us": local["expedited_us"],
        "expedited ratio": simulated["expedited_us"] / local["expedited_us"],
        "64 KiB block upload, tool's channel, s": own["block_s"],
        "64 KiB block upload, wire at 1 Mbit/s, s": own["block_wire_s"],
        "64 KiB segmented, tool's channel, s": own["segmented_s"],
        "64 KiB segmented, stock client on our drive, s": simulated["segmented_s"],
        "64 KiB segmented, stock client on LocalNode, s": local["segmented_s"],
        "segmented ratio": simulated["segmented_s"] / local["segmented_s"],
    }
    met = own["channel_us"] <= EXPEDITED_TARGET_US and own["block_s"] <= BLOCK_TARGET_S
    print(json.dumps({**{name: round(value, 4) for name, value in result.items()}, "targets met": met}, indent=1))
    sys.exit(0 if met else 1)


if __name__ == "__main__":
    main()
