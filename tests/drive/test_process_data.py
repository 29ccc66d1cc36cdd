# SPDX-License-Identifier: MIT
"""Live quantities as process data: sent by the drive, and its PDOs as before afterwards."""

from __future__ import annotations

import pytest

from pmsmtool.drive.process_data import live_values
from pmsmtool.errors import NotAvailable
from pmsmtool.sim.node.session import NmtState
from tests.drive.bench import sim_bench


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
