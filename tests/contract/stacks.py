# SPDX-License-Identifier: MIT
"""Slaves that are not ours, made from the simulated drive's own object table: durand, and canopen's LocalNode."""

from __future__ import annotations

import contextlib
import threading
import uuid
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import can
import canopen

from pmsmtool.bus.connect import Connection
from pmsmtool.files import data_folder
from pmsmtool.sim.node.objects import ObjectRow, object_rows
from tests.contract.contract import NODE, VENDOR, Peer

NAME = b"pmsmsim stand-in"
END_S = 0.02
"""How often the stacks' reader threads look whether they shall end (theirs: 1 s)."""
IDENTITY = (VENDOR, 1, 0x00010000, 22001)


@contextlib.contextmanager
def _virtual() -> Iterator[tuple[can.BusABC, Connection]]:
    """Yield the slave's end and the tool's end of python-can's own virtual bus."""
    channel = uuid.uuid4().hex
    slave = can.Bus(interface="virtual", channel=channel, ignore_config=True)
    try:
        with Connection(can.Bus(interface="virtual", channel=channel, ignore_config=True)) as connection:
            yield slave, connection
    finally:
        slave.shutdown()


# ---- durand --------------------------------------------------------------------------------------


class _Timers:
    """Scheduler for durand: a thread per timer."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.running: set[threading.Timer] = set()

    def add(self, delay: float, callback: Callable[..., None], args: Any = (), kwargs: Any = None) -> threading.Timer:
        timer = threading.Timer(delay, callback, args, kwargs)
        timer.daemon = True
        self.running.add(timer)
        timer.start()
        return timer

    def cancel(self, entry: threading.Timer) -> None:
        entry.cancel()

    def end(self) -> None:
        for timer in tuple(self.running):
            timer.cancel()


def _durand_variable(row: ObjectRow) -> Any:
    from durand.datatypes import DatatypeEnum
    from durand.object_dictionary import Variable

    value: float | bytes
    if not row.data_type.letter:
        value = row.default_bytes(NODE)
    else:
        value = row.default_number(NODE)
        value = value if row.data_type.is_float else int(value)
    access = "rw" if row.container else row.access
    kind = DatatypeEnum(row.data_type.code)
    return Variable(kind, access, value, minimum=row.low, maximum=row.high, name=row.name)


def _durand_node(network: Any) -> Any:
    from durand.node import MinimalNode
    from durand.object_dictionary import ObjectDictionary, Record

    dictionary = ObjectDictionary()
    records: dict[int, Any] = {}
    indices_with_subs = {row.index for row in object_rows() if row.sub}
    for row in object_rows():
        if row.index not in indices_with_subs:
            dictionary[row.index] = _durand_variable(row)
        elif row.sub:
            records.setdefault(row.index, Record(name=row.name))[row.sub] = _durand_variable(row)
    for index, record in records.items():
        dictionary[index] = record
    node = MinimalNode(network, NODE, dictionary)  # its own services replace the rows of the same index
    dictionary.write(0x1000, 0, 0x00020192)
    dictionary.write(0x1008, 0, NAME)
    for sub, number in enumerate(IDENTITY, 1):
        dictionary.write(0x1018, sub, number)
    return node


@contextlib.contextmanager
def durand_peer() -> Iterator[Peer]:
    """Yield a slave of the stack ``durand``."""
    from durand.network import CANBusNetwork
    from durand.scheduler import set_scheduler

    timers = _Timers()
    set_scheduler(timers)
    with _virtual() as (bus, connection):
        network = CANBusNetwork(bus)
        network._notifier.timeout = END_S
        try:
            _durand_node(network)
            yield Peer(connection)
        finally:
            timers.end()
            network.stop()


# ---- canopen's LocalNode -------------------------------------------------------------------------


@cache
def _dictionary() -> canopen.ObjectDictionary:
    return canopen.import_od(str(data_folder("firmware-params") / "pmsmsim" / "pmsmsim.eds"))


@contextlib.contextmanager
def local_node_peer() -> Iterator[Peer]:
    """Yield a slave of the stack ``canopen`` (LocalNode)."""
    with _virtual() as (bus, connection):
        network = canopen.Network(bus)
        network.NOTIFIER_CYCLE = END_S
        network.connect()
        try:
            local: Any = network.create_node(NODE, _dictionary())
            local.set_data(0x1008, 0, NAME)
            for sub, number in enumerate(IDENTITY, 1):
                local.sdo[0x1018][sub].raw = number
            local.nmt.state = "PRE-OPERATIONAL"
            yield Peer(connection)
        finally:
            network.bus = None  # closed by its owner
            assert network.notifier is not None
            network.notifier.stop()
