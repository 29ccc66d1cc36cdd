# SPDX-License-Identifier: MIT
"""Set-point slope, its cadence and filter, and late process data: what a closed drive does to its master's wishes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from pmsmtool.bus.connect import Connection, connect
from pmsmtool.cia402 import Mode
from pmsmtool.errors import ConfigError
from pmsmtool.sim.channel import parse_channel
from pmsmtool.sim.node.node import Node

SLOPE = 20_000
"""permille per second: 20 permille in a millisecond."""


def opened(query: str = "") -> tuple[Connection, Node]:
    connection = connect("pmsmsim", f"interior-2k2?nv=:memory:&drive=cia402{query}")
    return connection, connection.bus.line.nodes[0]  # type: ignore[attr-defined]


class Demand:
    """Torque demands a node gives to its core, with their instants (s, permille of rated)."""

    def __init__(self, node: Node, connection: Connection) -> None:
        self.node, self.connection = node, connection
        assert node.session is not None
        self.dictionary = node.session.dictionary
        self.seen: list[tuple[float, float]] = []
        command = node.core.command
        rated = self.dictionary["cia402.rated_torque"].number() / 1000.0

        def note(given) -> None:  # type: ignore[no-untyped-def]
            self.seen.append((1e-9 * node.line.clock.now_ns, 1000.0 * given.torque_nm / rated))
            command(given)

        node.core.command = note  # type: ignore[method-assign]
        self.write(0x6087, SLOPE, 4)
        self.write(0x6060, Mode.PROFILE_TORQUE, 1)
        for word in (6, 7, 15):
            self.write(0x6040, word, 2)
        self.seen.clear()

    def write(self, index: int, number: int, size: int) -> None:
        entry = self.dictionary.writable(index, 0)
        self.dictionary.write(entry, number.to_bytes(size, "little", signed=number < 0))

    def wait(self, seconds: float) -> None:
        self.node.line.clock.wait(seconds)


@pytest.mark.parametrize("every_s", [5e-5, 2e-4, 1e-3, 3e-3])
def test_the_slope_holds_however_often_the_master_writes(every_s: float) -> None:
    connection, node = opened()
    with connection:
        demand = Demand(node, connection)
        for k in range(round(0.03 / every_s)):
            demand.write(0x6071, 1000 + k % 2, 2)
            demand.wait(every_s)
        t, value = np.array(demand.seen).T
        steps = np.diff(value)
        assert steps.max() == pytest.approx(20.0)
        moves = t[1:][steps > 0.0]
        assert np.diff(moves).min() >= 1e-3 - 1e-9
        assert value[-1] > 400.0


def test_a_filter_makes_the_end_of_a_ramp_soft() -> None:
    courses = {}
    for query in ("", "&filter=0.01"):
        connection, node = opened(query)
        with connection:
            demand = Demand(node, connection)
            demand.write(0x6071, 200, 2)
            demand.wait(0.15)
            courses[query] = np.array(demand.seen)
    plain, soft = courses[""], courses["&filter=0.01"]
    assert plain[-1, 1] == soft[-1, 1] == pytest.approx(200.0)
    assert plain[:, 1].max() <= 200.0 + 1e-6
    assert soft[-1, 0] > plain[-1, 0] + 0.05  # arrives within 1e-3 permille after 12 time constants
    at = np.interp(0.01, plain[:, 0] - plain[0, 0], plain[:, 1])
    assert np.interp(0.01, soft[:, 0] - soft[0, 0], soft[:, 1]) < 0.6 * at
    assert all(b >= a for a, b in itertools.pairwise(soft[:, 1]))


@pytest.mark.parametrize("jitter", ["", "&jitter=0.002"])
def test_process_data_are_as_late_as_the_switch_says(jitter: str) -> None:
    """A TPDO every 5 ms: instants on the raster, or up to 2 ms late, in the order of the samples, equal for a seed."""
    runs = []
    for _ in range(2):
        connection, node = opened(f"{jitter}&seed=3")
        sent: list[float] = []
        with connection:
            demand = Demand(node, connection)
            honest = node.send

            def send(can_id: int, data: bytes, node: Node = node, sent: list[float] = sent, honest=honest) -> None:  # type: ignore[no-untyped-def]
                if can_id == 0x181:
                    sent.append(1e-9 * node.line.clock.now_ns)
                honest(can_id, data)

            session = node.session
            assert session is not None
            session.pdo._send = send
            entries = demand.dictionary
            for key, number in (("type", 255), ("event_ms", 5)):
                entries.write(entries[f"tpdo1.{key}"], entries[f"tpdo1.{key}"].encode(number))
            session.command_nmt(1)
            demand.wait(0.2)
        runs.append(sent)
    assert runs[0] == runs[1]
    assert len(runs[0]) >= 38
    late = np.array(runs[0][1:]) - runs[0][0]
    off = np.abs(late / 0.005 - np.round(late / 0.005)) * 0.005
    assert np.all(np.diff(runs[0]) >= 0.0)
    if jitter:
        assert off.max() > 5e-4
        assert np.ptp(np.diff(runs[0])) > 1e-3
    else:
        assert off.max() < 1e-9


@pytest.mark.parametrize("text", ["interior-2k2?filter=-1", "interior-2k2?jitter=2", "interior-2k2?filter=soft"])
def test_times_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        parse_channel(text)
