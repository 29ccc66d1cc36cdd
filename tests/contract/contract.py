# SPDX-License-Identifier: MIT
"""What every CANopen slave owes the tool: one class, run on every way to a slave and on stacks that are not ours.

A slave is reached with the tool's own connection and SDO channel, and with raw frames where the channel would hide what
is asked for. Where another stack does something else, its test class names the test and what the stack does in
``DEVIATIONS``; such a test must fail, so a deviation that has gone away is noticed, and every one is listed.
"""

from __future__ import annotations

import itertools
import random
import struct
from binascii import crc_hqx
from dataclasses import dataclass
from typing import Any, ClassVar

import can
import pytest

from pmsmtool.bus.clock import VirtualClock
from pmsmtool.bus.connect import Connection
from pmsmtool.bus.nmt import NmtCommand, NmtState, find_nodes, reset_node, send_nmt
from pmsmtool.bus.sdo import Mode, SdoChannel
from pmsmtool.errors import DriveTimeout, PmsmtoolError, SdoAbort
from pmsmtool.firmware.image import crc32

NODE = 1
VENDOR = 0x706D736D
TABLE = (0x2042, 0)
"""A DOMAIN that takes any size once :meth:`Peer.prepare` has been called."""
ODD_SIZES = (1, 2, 4, 5, 8, 888, 890, 896, 1777, 1779, 4000)
SEVENS = (7, 14, 882, 889, 1778, 7 * 127 * 5)
"""Sizes divisible by 7, among them full sub-blocks of 889 bytes."""
HEAD = struct.Struct("<BHB")
FAILURES = (AssertionError, PmsmtoolError, pytest.fail.Exception)
"""How a deviation may show."""


@dataclass
class Peer:
    """A slave and the tool's way to it."""

    connection: Connection
    staged: bool = False
    """Whether the slave takes a table only while a parameter set is staged (the simulated drive)."""

    def __post_init__(self) -> None:
        self.sdo = SdoChannel(self.connection, NODE)
        self.answers = self.connection.mailbox(0x580 + NODE)

    def prepare(self) -> None:
        """Make the table writable."""
        if self.staged:
            self.sdo.download(0x2000, 6, b"\1")

    def number(self, index: int, sub: int = 0) -> int:
        return int.from_bytes(self.sdo.read(index, sub), "little")

    def ask(self, frame: bytes, timeout_s: float = 0.9) -> bytes | None:
        """Send a raw request and return the next raw answer.

        The wait is shorter than the second after which a slave aborts what was left open.
        """
        self.answers.clear()
        self.connection.send(0x600 + NODE, frame.ljust(8, b"\0"))
        return self.answers.get(timeout_s)

    def heard(self, cob_id: int, seconds: float) -> list[bytes]:
        """Return the frames of an identifier within a time."""
        found: list[bytes] = []
        self.connection.subscribe(cob_id, lambda cob, data, stamp: found.append(data))
        self.connection.wait(seconds)
        self.connection.unsubscribe(cob_id)
        return found


def lossy(bus: can.BusABC, probability: float, seed: int) -> None:
    """Drop SDO frames of a bus, both ways, from now on."""
    generator = random.Random(seed)
    send, recv = bus.send, bus.recv

    def strikes(message: can.Message | None) -> bool:
        concerned = message is not None and message.arbitration_id in (0x580 + NODE, 0x600 + NODE)
        return concerned and generator.random() < probability

    def lossy_send(msg: can.Message, timeout: float | None = None) -> None:
        if not strikes(msg):
            send(msg, timeout)

    def lossy_recv(timeout: float | None = None) -> can.Message | None:
        message = recv(timeout)
        return None if strikes(message) else message

    bus.send, bus.recv = lossy_send, lossy_recv  # type: ignore[method-assign]


class NodeContract:
    """CiA 301 as the tool uses it. Subclasses give the fixture ``peer``."""

    DEVIATIONS: ClassVar[dict[str, str]] = {}
    SURVIVING: ClassVar[int] = 24
    """Transfers of the 24 in the loss test that must come through."""

    @pytest.fixture(autouse=True)
    def _deviations(self, request: pytest.FixtureRequest) -> None:
        node: Any = request.node
        for name in (node.name, node.originalname):
            if name in self.DEVIATIONS:
                mark = pytest.mark.xfail(strict=True, raises=FAILURES, reason=self.DEVIATIONS[name])
                request.applymarker(mark)
                return

    def test_every_deviation_named_is_a_test(self) -> None:
        assert all(hasattr(self, name.partition("[")[0]) for name in self.DEVIATIONS)

    # ---- reading and writing -------------------------------------------------------------------

    def test_device_type_and_identity(self, peer: Peer) -> None:
        assert peer.number(0x1000) == 0x00020192
        assert [peer.number(0x1018, sub) for sub in (1, 2, 3)] == [VENDOR, 1, 0x00010000]

    def test_a_string_comes_by_segments(self, peer: Peer) -> None:
        transfer = peer.sdo.upload(0x1008, 0)
        assert transfer.mode is Mode.SEGMENTED
        assert transfer.data.startswith(b"pmsmsim ")

    @pytest.mark.parametrize(
        ("index", "sub", "data"),
        [(0x2010, 1, b"\5"), (0x1017, 0, b"\xfa\0"), (0x1016, 1, b"\x20\3\x7d\0"), (0x2010, 2, b"\0\0\x80\x3e")],
        ids=["U8", "U16", "U32", "REAL32"],
    )
    def test_every_width_is_written_and_read_back(self, peer: Peer, index: int, sub: int, data: bytes) -> None:
        assert peer.sdo.download(index, sub, data).mode is Mode.EXPEDITED
        assert peer.sdo.upload(index, sub).data == data
        assert peer.sdo.download(index, sub, data, mode=Mode.SEGMENTED).mode is Mode.SEGMENTED

    @pytest.mark.parametrize("mode", [Mode.SEGMENTED, Mode.BLOCK, Mode.AUTO])
    @pytest.mark.parametrize("sizes", [ODD_SIZES, SEVENS], ids=["odd", "sevens"])
    def test_sizes_travel_both_ways(self, peer: Peer, mode: Mode, sizes: tuple[int, ...]) -> None:
        """Right in any case: a slave without block transfers, or with bad ones, is met by segments."""
        peer.prepare()
        for size in sizes:
            data = random.Random(size).randbytes(size)
            peer.sdo.download(*TABLE, data, mode=mode)
            assert peer.sdo.upload(*TABLE, size=size, mode=mode).data == data

    @pytest.mark.parametrize("size", [4000, 889], ids=["odd", "sevens"])
    def test_block_uploads_are_block_uploads(self, peer: Peer, size: int) -> None:
        peer.prepare()
        peer.sdo.download(*TABLE, bytes(size), mode=Mode.SEGMENTED)
        transfer = peer.sdo.upload(*TABLE, size=size, mode=Mode.BLOCK)
        assert (transfer.mode, transfer.tries) == (Mode.BLOCK, 1)

    @pytest.mark.parametrize("size", [4000, 889], ids=["odd", "sevens"])
    def test_block_downloads_are_block_downloads(self, peer: Peer, size: int) -> None:
        peer.prepare()
        transfer = peer.sdo.download(*TABLE, bytes(size), mode=Mode.BLOCK)
        assert (transfer.mode, transfer.tries) == (Mode.BLOCK, 1)

    def test_transfers_under_loss_are_right_or_reported(self, peer: Peer) -> None:
        """1 % of the frames; the full numbers are those of ``benchmarks/transfers.py``."""
        peer.prepare()
        lossy(peer.connection.bus, 0.01, seed=5)
        generator = random.Random(6)
        right = 0
        for _ in range(12):
            data = generator.randbytes(generator.choice((1, 4, 7, 100, 889)))
            try:
                peer.sdo.download(*TABLE, data)
                right += 1
                assert peer.sdo.upload(*TABLE, size=len(data)).data == data
                right += 1
            except (SdoAbort, DriveTimeout):
                continue
        assert right >= self.SURVIVING

    # ---- refusals ------------------------------------------------------------------------------

    @pytest.mark.parametrize(
        ("index", "sub", "data", "codes"),
        [
            (0x4711, 0, None, {0x06020000}),
            (0x1018, 9, None, {0x06090011}),
            (0x1018, 1, bytes(4), {0x06010002}),
            (0x2010, 2, bytes(8), {0x06070010, 0x06070012}),
            (0x2010, 2, bytes(2), {0x06070010, 0x06070013}),
            (0x2010, 2, struct.pack("<f", 1e9), {0x06090030, 0x06090031}),
            (0x2010, 2, struct.pack("<f", -1.0), {0x06090030, 0x06090032}),
        ],
        ids=["no object", "no sub-index", "read-only", "too long", "too short", "too high", "too low"],
    )
    def test_refusals_carry_their_code(
        self, peer: Peer, index: int, sub: int, data: bytes | None, codes: set[int]
    ) -> None:
        with pytest.raises(SdoAbort) as caught:
            if data is None:
                peer.sdo.read(index, sub)
            else:
                peer.sdo.download(index, sub, data)
        assert caught.value.code in codes
        assert (caught.value.index, caught.value.sub) == (index, sub)

    @pytest.mark.parametrize(("size", "code"), [(8, 0x06070012), (2, 0x06070013)])
    def test_a_wrong_length_says_which_way(self, peer: Peer, size: int, code: int) -> None:
        with pytest.raises(SdoAbort) as caught:
            peer.sdo.download(0x2010, 2, bytes(size))
        assert caught.value.code == code

    def test_a_refused_value_leaves_the_old_one(self, peer: Peer) -> None:
        peer.sdo.download(0x2010, 2, struct.pack("<f", 0.25))
        with pytest.raises(SdoAbort):
            peer.sdo.download(0x2010, 2, struct.pack("<f", 1e9))
        assert struct.unpack("<f", peer.sdo.read(0x2010, 2)) == (0.25,)

    def test_not_a_number_is_refused(self, peer: Peer) -> None:
        with pytest.raises(SdoAbort):
            peer.sdo.download(0x2010, 2, struct.pack("<f", float("nan")))

    def test_fewer_bytes_than_announced_are_refused(self, peer: Peer) -> None:
        peer.prepare()
        answer = peer.ask(struct.pack("<BHBI", 0x21, *TABLE, 100))
        assert answer is not None
        assert answer[0] == 0x60
        answer = peer.ask(b"\x01" + bytes(7))
        assert answer is not None
        assert answer[0] == 0x80

    def test_a_segment_without_a_transfer_is_an_unknown_command(self, peer: Peer) -> None:
        answer = peer.ask(b"\x60")
        assert answer is not None
        assert (answer[0], int.from_bytes(answer[4:], "little")) == (0x80, 0x05040001)

    # ---- gaps and silence ----------------------------------------------------------------------

    def test_a_gap_in_a_block_download_is_acknowledged_up_to_the_gap(self, peer: Peer) -> None:
        peer.prepare()
        data = random.Random(1).randbytes(70)
        frames = [bytes((k + 1 | (0x80 if k == 9 else 0),)) + data[7 * k : 7 * k + 7] for k in range(10)]
        assert peer.ask(struct.pack("<BHBI", 0xC6, *TABLE, 70)) is not None
        for k in (0, 1, 2, 4, 5, 6, 7, 8):
            peer.connection.send(0x600 + NODE, frames[k])
        answer = peer.ask(frames[9])
        assert answer is not None
        assert answer[:2] == b"\xa2\x03"
        for k in range(3, 9):
            again = bytes((k - 2,)) + frames[k][1:]
            peer.connection.send(0x600 + NODE, again)
        answer = peer.ask(b"\x87" + frames[9][1:])
        assert answer is not None
        assert answer[:2] == b"\xa2\x07"
        answer = peer.ask(b"\xc1" + crc_hqx(data, 0).to_bytes(2, "little"))
        assert answer is not None
        assert answer[0] == 0xA1
        assert peer.sdo.read(*TABLE) == data

    def test_an_abandoned_transfer_is_aborted_in_time(self, peer: Peer) -> None:
        for command in (0x40, 0x21, 0xA4, 0xC6):
            self.open_transfer(peer, command)
            answer = peer.answers.get(1.3)
            assert answer is not None
            assert (answer[0], int.from_bytes(answer[4:], "little")) == (0x80, 0x05040000)

    @pytest.mark.parametrize("command", [0x40, 0x21, 0xA4])
    def test_a_new_request_replaces_an_abandoned_transfer(self, peer: Peer, command: int) -> None:
        self.open_transfer(peer, command)
        answer = peer.ask(HEAD.pack(0x40, 0x1018, 1))
        assert answer == HEAD.pack(0x43, 0x1018, 1) + VENDOR.to_bytes(4, "little")

    @staticmethod
    def open_transfer(peer: Peer, command: int) -> None:
        peer.prepare()
        peer.sdo.download(*TABLE, bytes(100), mode=Mode.SEGMENTED)
        details = bytes((127, 0, 0, 0)) if command == 0xA4 else (100).to_bytes(4, "little")
        answer = peer.ask(HEAD.pack(command, *TABLE) + (bytes(4) if command == 0x40 else details))
        assert answer is not None
        assert answer[0] != 0x80

    def test_the_channel_recovers_from_whatever_was_left_open(self, peer: Peer) -> None:
        for command in (0x40, 0x21, 0xA4, 0xC6):
            answer = peer.ask(HEAD.pack(command, *TABLE) + (100).to_bytes(4, "little"))
            assert answer is not None
            assert peer.number(0x1018, 1) == VENDOR

    # ---- network management --------------------------------------------------------------------

    def test_a_reset_is_announced(self, peer: Peer) -> None:
        reset_node(peer.connection, NODE)
        assert peer.number(0x1018, 1) == VENDOR

    def test_silent_while_stopped(self, peer: Peer) -> None:
        send_nmt(peer.connection, NmtCommand.STOP, NODE)
        assert peer.ask(HEAD.pack(0x40, 0x1018, 1), timeout_s=0.3) is None
        send_nmt(peer.connection, NmtCommand.PRE_OPERATIONAL, NODE)
        assert peer.ask(HEAD.pack(0x40, 0x1018, 1)) is not None

    @pytest.mark.parametrize(
        ("command", "state"),
        [
            (NmtCommand.START, NmtState.OPERATIONAL),
            (NmtCommand.STOP, NmtState.STOPPED),
            (NmtCommand.PRE_OPERATIONAL, NmtState.PRE_OPERATIONAL),
        ],
    )
    def test_heartbeats_keep_their_period_and_show_the_state(
        self, peer: Peer, command: NmtCommand, state: NmtState
    ) -> None:
        peer.sdo.download(0x1017, 0, (50).to_bytes(2, "little"))
        send_nmt(peer.connection, command, NODE)
        peer.connection.wait(0.06)
        clock = peer.connection.clock
        beats: list[tuple[float, bytes]] = []
        peer.connection.subscribe(0x700 + NODE, lambda cob, data, stamp: beats.append((clock.now(), data)))
        assert peer.connection.wait_until(lambda: len(beats) > 8, 5.0)
        took_s = (beats[8][0] - beats[0][0]) / 8
        assert {data for _, data in beats} == {bytes((state,))}
        # On the wall clock a busy computer wakes either side late: that the period is no multiple, a median tells.
        gaps = sorted(late - early for (early, _), (late, _) in itertools.pairwise(beats))
        assert 0.03 < took_s
        assert gaps[len(gaps) // 2] < 0.09
        if isinstance(clock, VirtualClock):
            assert gaps == pytest.approx([0.05] * len(gaps), abs=0.002)

    def test_it_is_found_by_a_scan(self, peer: Peer) -> None:
        found = find_nodes(peer.connection)
        assert [(node.node, node.is_drive) for node in found] == [(NODE, True)]

    def test_a_lost_heartbeat_of_the_master_is_an_emergency(self, peer: Peer) -> None:
        peer.sdo.download(0x1016, 1, (0x7E << 16 | 100).to_bytes(4, "little"))
        peer.connection.send(0x77E, b"\5")
        frames = peer.heard(0x080 + NODE, 0.3)
        assert [frame[:2] for frame in frames] == [b"\x30\x81"]

    def test_lss_tells_its_node_id(self, peer: Peer) -> None:
        answers = peer.connection.mailbox(0x7E4)
        peer.connection.send(0x7E5, b"\x04\x01".ljust(8, b"\0"))
        peer.connection.send(0x7E5, b"\x5e".ljust(8, b"\0"))
        assert answers.get(0.3) == bytes((0x5E, NODE)).ljust(8, b"\0")


class DriveNodeContract(NodeContract):
    """What the simulated drive owes beyond CiA 301, however it is reached."""

    def test_the_image_has_the_crc_the_drive_reports(self, peer: Peer) -> None:
        assert crc32(peer.sdo.upload(0x2001, 0, mode=Mode.BLOCK).data) == peer.number(0x2000, 3)

    def test_states_by_controlword(self, peer: Peer) -> None:
        for word, pattern in ((0x06, 0x21), (0x07, 0x23), (0x0F, 0x27), (0x00, 0x40)):
            peer.sdo.download(0x6040, 0, word.to_bytes(2, "little"))
            assert peer.number(0x6041) & 0x6F == pattern

    def test_saved_values_survive_a_reset_and_restored_ones_do_not(self, peer: Peer) -> None:
        peer.sdo.slow_objects |= {(0x1010, 1): 3.0, (0x1011, 1): 3.0}
        for value, index, signature in ((150, 0x1010, b"save"), (200, 0x1011, b"load")):
            peer.sdo.download(0x1017, 0, (150).to_bytes(2, "little"))
            peer.sdo.download(index, 1, signature)
            reset_node(peer.connection, NODE)
            assert peer.number(0x1017) == value

    def test_a_trace_comes_by_block_with_its_crc(self, peer: Peer) -> None:
        for number in range(8):
            peer.sdo.download(0x2061, number + 1, (0x20700120 + (number << 8)).to_bytes(4, "little"))
        peer.sdo.download(0x2060, 2, (2048).to_bytes(4, "little"))
        peer.sdo.download(0x2060, 7, b"\1")
        assert peer.connection.wait_until(lambda: peer.number(0x2060, 8) == 3, 2.0)
        transfer = peer.sdo.upload(0x2062, 0, size=65536)
        assert transfer.mode is Mode.BLOCK
        assert crc32(transfer.data) == peer.number(0x2060, 0x0C)
