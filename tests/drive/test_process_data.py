# SPDX-License-Identifier: MIT
"""Live quantities as process data: sent by the drive, and its PDOs as before afterwards."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import pytest

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.connect import connect
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.motion_objects import POSITION
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.process_data import LiveValues, live_values
from pmsmtool.errors import NotAvailable
from pmsmtool.sim.node.dictionary import Refused
from pmsmtool.sim.node.node import Node
from pmsmtool.sim.node.session import NmtState, Session
from tests.drive.bench import sim_bench
from tests.foreign.data_sheets import COMMON, Row, write_eds


def test_drive_sends_and_is_restored() -> None:
    with sim_bench() as bench:
        before = bench.memory()
        names = ["i_d_a", "i_q_a", "omega_e_rad_s", "U_dc_v", "flags", "T_winding_c"]
        with live_values(bench.drive.node, names, 0.01) as live:
            frames = bench.bus.line.frames
            bench.connection.wait(1.0)
            assert set(live.values) == set(names) and live.values["U_dc_v"] == pytest.approx(540.0, rel=0.05)
            assert 290 <= live.received <= 320 and bench.bus.line.frames - frames < 330, "no request is sent"
        assert bench.memory() == before
        assert bench.session.nmt is NmtState.PRE_OPERATIONAL


def test_a_short_message_is_left_out() -> None:
    live = LiveValues({"first": DriveObject(0x2000, 1, "H"), "second": DriveObject(0x2000, 2, "i")})
    live.expect(0x181, ("first", "second"))
    live.take(0x181, bytes((1, 0, 2, 0)), 0.0)
    assert live.received == 0
    live.take(0x181, bytes((1, 0, 2, 0, 0, 0)), 0.0)
    assert live.received == 1 and live.values == {"first": 1.0, "second": 2.0}


def test_values_follow_the_machine() -> None:
    with sim_bench() as bench, live_values(bench.drive.node, ["i_d_a"], 0.005) as live:
        bench.drive.enable()
        bench.drive.command_current(1.5, 0.0, fixed_angle_rad=0.0)
        bench.connection.wait(0.3)
        assert live.values["i_d_a"] == pytest.approx(1.5, abs=0.1)
        bench.drive.quick_stop()


def test_more_than_fits_is_refused_before_anything_changes() -> None:
    with sim_bench() as bench:
        before = bench.memory()
        with pytest.raises(NotAvailable, match="do not fit"), live_values(bench.drive.node, ["i_d_a"] * 7, 0.01):
            pass
        assert bench.memory() == before


def test_a_block_that_was_never_begun_is_undone_when_the_node_is_closed() -> None:
    """As a Ctrl-C between two bytecodes of the `with` statement leaves it."""
    with sim_bench() as bench:
        before = bench.memory()
        borrowed = live_values(bench.drive.node, ["i_d_a"], 0.01)
        borrowed.__enter__()
        assert bench.memory() != before
        bench.drive.close()
        assert bench.memory() == before
        del borrowed  # its own end finds nothing left to do
        assert bench.memory() == before


def transmitted(number: int, words: tuple[str, ...], inhibit: str = "100") -> tuple[Row, ...]:
    """A PDO as its maker maps it, with an inhibit time of 10 ms."""
    entries = (*words, *(8 - len(words)) * ("0",))
    return (
        (0x17FF + number, 1, "U32", "rw", f"$NODEID+{0x40000080 + 0x100 * number:#x}"),
        (0x17FF + number, 2, "U8", "rw", "255"), (0x17FF + number, 3, "U16", "rw", inhibit),
        (0x17FF + number, 5, "U16", "rw", "0"), (0x19FF + number, 0, "U8", "rw", str(len(words))),
        *((0x19FF + number, sub, "U32", "rw", word) for sub, word in enumerate(entries, 1)),
    )  # fmt: skip


MAKERS = (
    *COMMON, (0x2013, 0, "U64", "ro", "0"), (0x6044, 0, "I16", "ro", "0"), (0x6502, 0, "U32", "ro", "0x201"),
    *transmitted(2, ("0x20130040",)), *transmitted(3, ("0x60440010", "0x60640020")), *transmitted(4, ()),
)  # fmt: skip
"""An interpreter's answer of 64 bits, a speed of the frequency-converter profile, nothing."""


@contextmanager
def makers_node(path: Path) -> Iterator[tuple[DriveNode, Session]]:
    with connect("pmsmsim", f"interior-2k2?nv=:memory:&eds={write_eds(path / 'drive.eds', MAKERS)}") as connection:
        simulated = cast(Node, connection.bus.line.nodes[0])  # type: ignore[attr-defined]
        node = DriveNode(connection, 1)
        assert simulated.session is not None
        yield node, simulated.session
        node.close()


def pdos(session: Session) -> dict[tuple[int, int], bytes]:
    rows = [entry for entry in session.dictionary if 0x1800 <= entry.row.index < 0x1B00]
    return {(entry.row.index, entry.row.sub): entry.read() for entry in rows}


def objects_of(count: int) -> dict[str, DriveObject]:
    """As many names for the position: two of them fill a PDO."""
    return {f"position {number}": POSITION for number in range(count)}


def test_a_makers_mapping_is_restored_and_its_inhibit_time_does_not_hold_samples_back(tmp_path: Path) -> None:
    with makers_node(tmp_path) as (node, session):
        before, items = pdos(session), objects_of(6)
        with live_values(node, list(items), 0.001, items) as live:
            node.connection.wait(0.1)
        assert live.received >= 3 * 90 and set(live.values) == set(items)
        assert pdos(session) == before and before[0x1A02, 0] == b"\2" and any(before[0x1801, 3])


def test_a_mapping_of_an_object_that_the_drive_lacks_is_left_alone(tmp_path: Path) -> None:
    with makers_node(tmp_path) as (node, session):
        session.dictionary.hide(0x6044)
        before, items = pdos(session), objects_of(6)
        with pytest.raises(NotAvailable, match="0x60440010"), live_values(node, list(items), 0.001, items):
            pass
        assert pdos(session) == before
        items = objects_of(4)
        with live_values(node, list(items), 0.001, items) as live:
            node.connection.wait(0.05)
            assert pdos(session)[0x1A02, 0] == before[0x1A02, 0], "the other two are borrowed"
        assert set(live.values) == set(items) and pdos(session) == before


def test_a_drive_that_refuses_its_own_mapping_keeps_it(tmp_path: Path) -> None:
    with makers_node(tmp_path) as (node, session):
        entry = session.dictionary.find(0x1A01, 1)
        taken = entry.sink
        assert taken is not None

        def sink(data: bytes) -> None:
            if session.dictionary.find(0x1A01, 0).integer() == 0:
                raise Refused(AbortCode.NOT_MAPPABLE)
            taken(data)

        entry.sink = sink
        before, items = pdos(session), objects_of(4)
        with live_values(node, list(items), 0.001, items) as live:
            node.connection.wait(0.05)
        assert set(live.values) == set(items) and pdos(session) == before
        items = objects_of(6)
        with pytest.raises(NotAvailable, match="refuses what its own PDOs hold"):
            live_values(node, list(items), 0.001, items).__enter__()
        assert pdos(session) == before
