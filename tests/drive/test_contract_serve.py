# SPDX-License-Identifier: MIT
"""The drive contract over socketcand, the drive in another process on the wall clock."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from pmsmtool.bus.connect import connect
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.guard import guarded
from pmsmtool.errors import BusError, DriveFault, StopNotConfirmed
from tests.drive.contract import ENVELOPE, DriveContract
from tests.drive.served import Server, serving

pytestmark = pytest.mark.wall_clock


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving("--nv", ":memory:") as running:
        yield running


class TestServed(DriveContract):
    @pytest.fixture
    def drive(self, server: Server) -> Iterator[CanopenDrive]:
        with server.connect() as connection:
            drive = CanopenDrive(connection, 1)
            drive.node.reset()
            yield drive


@pytest.mark.chain
def test_main_thread_busy_for_two_seconds_leaves_the_machine_off(server: Server) -> None:
    """Nobody looked at the machine meanwhile: the heartbeat stops, and the drive removes the voltage by itself."""
    with server.connect() as connection:
        drive = CanopenDrive(connection, 1)
        with pytest.raises(DriveFault, match="heartbeat"), guarded(drive, ENVELOPE) as guard:
            guard.enable()
            end = time.monotonic() + 2.0
            while time.monotonic() < end:
                sum(range(50_000))
            assert drive.node.state() != 0x27
            guard.wait(0.0)


@pytest.mark.chain
def test_server_that_dies_is_noticed_within_two_seconds_and_not_confirmed() -> None:
    with serving("--nv", ":memory:") as running, running.connect() as connection:
        drive = CanopenDrive(connection, 1)
        died = 0.0
        with pytest.raises(StopNotConfirmed), guarded(drive, ENVELOPE) as guard:
            guard.enable()
            running.process.kill()
            died = time.monotonic()
            guard.wait(30.0)
        assert time.monotonic() - died < 2.0 + 1.0, "noticed within 2 s, the failed stop within another"


@pytest.mark.chain
def test_nobody_listens() -> None:
    with pytest.raises(BusError) as caught:
        connect("socketcand", "vcan0", host="127.0.0.1", port=9, ignore_config=True)
    assert caught.value.exit_code == 3 and "sim serve" in str(caught.value)
