# SPDX-License-Identifier: MIT
"""The contract on every way to the simulated drive, and on stacks that are not ours with their deviations."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import pytest

from pmsmtool.bus.connect import Connection
from pmsmtool.bus.nmt import reset_node
from pmsmtool.sim.bus import PmsmSimBus
from tests.contract.contract import NODE, DriveNodeContract, NodeContract, Peer
from tests.drive.served import Server, serving

pytestmark = pytest.mark.wall_clock


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving("--nv", ":memory:") as running:
        yield running


class TestPmsmsim(DriveNodeContract):
    """In this process, nominal frame times."""

    @pytest.fixture
    def peer(self) -> Iterator[Peer]:
        with Connection(PmsmSimBus("interior-2k2?nv=:memory:")) as connection:
            yield Peer(connection, staged=True)


class TestPaced(DriveNodeContract):
    """In this process, bit-exact frame times at 500 kbit/s."""

    @pytest.fixture
    def peer(self) -> Iterator[Peer]:
        with Connection(PmsmSimBus("interior-2k2?nv=:memory:&bitrate=500000")) as connection:
            yield Peer(connection, staged=True)


class TestServed(DriveNodeContract):
    """``pmsmtool sim serve`` in another process, python-can's stock socketcand backend, the wall clock."""

    @pytest.fixture
    def peer(self, server: Server) -> Iterator[Peer]:
        with server.connect() as connection:
            reset_node(connection, NODE)
            yield Peer(connection, staged=True)


_SERVER_WITHOUT_TIME = "it has no time-outs: an unfinished transfer stays open"
_ONE_LENGTH_CODE = "any wrong length is 0x06070010"


class TestDurand(NodeContract):
    """durand 0.5, a slave stack by other people."""

    DEVIATIONS: ClassVar[dict[str, str]] = {
        "test_block_uploads_are_block_uploads[sevens]": "its last frame disowns 7 bytes of a size divisible by 7",
        "test_a_gap_in_a_block_download_is_acknowledged_up_to_the_gap": "a gap aborts with 0x05040003",
        "test_a_wrong_length_says_which_way": _ONE_LENGTH_CODE,
        "test_not_a_number_is_refused": "NaN passes both limits",
        "test_fewer_bytes_than_announced_are_refused": "the announced size is ignored",
        "test_an_abandoned_transfer_is_aborted_in_time": _SERVER_WITHOUT_TIME,
        "test_a_new_request_replaces_an_abandoned_transfer[164]": "an open block upload swallows all requests",
        "test_the_channel_recovers_from_whatever_was_left_open": "an open block upload ends with its own abort only",
        "test_a_lost_heartbeat_of_the_master_is_an_emergency": "it watches no heartbeats (0x1016)",
    }
    SURVIVING: ClassVar[int] = 12
    """A gap costs the whole transfer; measured 17 to 21 of 24."""

    @pytest.fixture
    def peer(self) -> Iterator[Peer]:
        pytest.importorskip("durand")
        from tests.contract.stacks import durand_peer

        with durand_peer() as peer:
            yield peer


class TestLocalNode(NodeContract):
    """canopen 2.4's LocalNode."""

    DEVIATIONS: ClassVar[dict[str, str]] = {
        "test_block_uploads_are_block_uploads": "a block upload is answered by segments",
        "test_block_downloads_are_block_downloads": "a block download is refused with 0x05040001",
        "test_a_gap_in_a_block_download_is_acknowledged_up_to_the_gap": "it has no block download",
        "test_refusals_carry_their_code[too high]": "limits are not enforced",
        "test_refusals_carry_their_code[too low]": "limits are not enforced",
        "test_a_refused_value_leaves_the_old_one": "limits are not enforced",
        "test_not_a_number_is_refused": "limits are not enforced",
        "test_a_wrong_length_says_which_way": _ONE_LENGTH_CODE,
        "test_fewer_bytes_than_announced_are_refused": "the announced size is ignored",
        "test_a_segment_without_a_transfer_is_an_unknown_command": "it answers 0x05030000, toggle error",
        "test_an_abandoned_transfer_is_aborted_in_time": _SERVER_WITHOUT_TIME,
        "test_silent_while_stopped": "its SDO server answers in every state",
        "test_a_lost_heartbeat_of_the_master_is_an_emergency": "it watches no heartbeats (0x1016)",
        "test_lss_tells_its_node_id": "it has no LSS slave",
    }
    SURVIVING: ClassVar[int] = 12
    """Without block transfers any lost frame costs the whole transfer; measured 15 to 20 of 24."""

    @pytest.fixture
    def peer(self) -> Iterator[Peer]:
        from tests.contract.stacks import local_node_peer

        with local_node_peer() as peer:
            yield peer
