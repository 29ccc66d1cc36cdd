# SPDX-License-Identifier: MIT
"""Faults on purpose: each kind does what its file says, the same for the same seed."""

from __future__ import annotations

import errno
import tomllib
from pathlib import Path

import can
import pytest

from pmsmtool.errors import ConfigError
from pmsmtool.sim.faults import FaultPlan, load_faults, parse_faults
from tests.node.bench import SERIAL, Bench
from tests.node.conftest import BenchMaker
from tests.node.raw_client import HEAD, Aborted, Lost

READ = HEAD.pack(0x40, 0x1018, 4) + bytes(4)


def answers(bench: Bench, requests: int) -> list[bool]:
    found = []
    for _ in range(requests):
        bench.client.send(READ)
        found.append(bench.client.receive(0.01) is not None)
    return found


def test_dropped_frames_are_the_same_for_the_same_seed(make_bench: BenchMaker) -> None:
    text = '[[frame]]\naction="drop"\nprobability=0.2'
    first, again, other = (answers(make_bench(faults=text, seed=seed), 200) for seed in (1, 1, 2))
    assert first == again
    assert first != other
    assert 90 < sum(first) < 165  # both ways through at 0.8 each: 128 expected, sd 6.8


def test_a_rule_has_direction_identifiers_start_and_count(make_bench: BenchMaker) -> None:
    bench = make_bench(faults='[[frame]]\naction="drop"\nids="0x580-0x5FF"\ndirection="from-drive"\nafter=2\ncount=3')
    assert answers(bench, 8) == [True, True, False, False, False, True, True, True]
    bench = make_bench(faults='[[frame]]\naction="drop"\nids=["0x581"]\ndirection="to-drive"')
    assert all(answers(bench, 5))


def test_a_delayed_answer_arrives_late(make_bench: BenchMaker) -> None:
    bench = make_bench(faults='[[frame]]\naction="delay"\nids="0x581"\ncount=1\ndelay_s=0.45')
    bench.client.send(READ)
    assert bench.client.receive(0.44) is None
    assert bench.client.receive(0.02) is not None


def test_a_duplicated_request_is_answered_twice(make_bench: BenchMaker) -> None:
    bench = make_bench(faults='[[frame]]\naction="duplicate"\nids="0x601"\ncount=1')
    bench.client.send(READ)
    assert [bench.client.receive(0.01) is None for _ in range(3)] == [False, False, True]


def test_reordered_frames_change_places(make_bench: BenchMaker) -> None:
    bench = make_bench(faults='[[frame]]\naction="reorder"\nids="0x601"\ncount=1\ndelay_s=1.0')
    bench.client.send(READ)
    bench.client.send(HEAD.pack(0x40, 0x1018, 1) + bytes(4))
    subs = [frame[3] for frame in (bench.client.receive(0.1), bench.client.receive(0.1)) if frame is not None]
    assert subs == [1, 4]


def test_a_held_frame_is_let_go_when_nothing_follows(make_bench: BenchMaker) -> None:
    bench = make_bench(faults='[[frame]]\naction="reorder"\nids="0x601"\ncount=1\ndelay_s=0.05')
    bench.client.send(READ)
    assert bench.client.receive(0.04) is None
    assert bench.client.receive(0.02) is not None


def test_a_corrupted_frame_differs_in_one_bit(make_bench: BenchMaker) -> None:
    clean = make_bench().client.ask(READ)
    bench = make_bench(faults='[[frame]]\naction="corrupt"\nids="0x581"\ncount=1')
    spoiled = bench.client.ask(READ)
    assert clean is not None
    assert spoiled is not None
    difference = int.from_bytes(clean, "big") ^ int.from_bytes(spoiled, "big")
    assert difference.bit_count() == 1
    assert bench.client.ask(READ) == clean


def test_a_reset_at_a_frame(make_bench: BenchMaker) -> None:
    bench = make_bench(faults='[[drive]]\naction="reset"\nat_frame=5')
    assert answers(bench, 4) == [True, True, False, False]
    assert bench.frames(0x701, 0.1) == [b"\x00"]


def test_an_unplugged_drive_runs_on_unheard(make_bench: BenchMaker) -> None:
    bench = make_bench(faults='[[drive]]\naction="unplug"\nat_s=0.3\nback_after_s=0.4')
    bench.client.put(0x6040, 0, 6, "H")
    heard = [round(message.timestamp, 1) for message in bench.listen(1.1)]
    assert heard == [0.2, 0.8, 1.0]
    assert int(bench.client.number(0x6041, 0, "H")) & 0x6F == 0x21


def test_faults_name_their_drive(make_bench: BenchMaker) -> None:
    bench = make_bench(nodes=3, faults='[[drive]]\naction="unplug"\nnode=2\nat_s=0.1')
    assert sorted(set(bench.ids(0.5))) == [0x701, 0x703]
    with pytest.raises(ConfigError, match="no drive with node id 9"):
        make_bench(faults='[[drive]]\naction="reset"\nnode=9\nat_s=0.1')


@pytest.mark.parametrize("recv_raises", [False, True])
def test_a_pulled_adapter(make_bench: BenchMaker, recv_raises: bool) -> None:
    bench = make_bench(faults=f"[[adapter]]\nat_frame=4\nrecv_raises={str(recv_raises).lower()}")
    assert answers(bench, 1) == [True]
    bench.client.send(READ)
    bench.bus.clock.wait(0.01)
    with pytest.raises(can.CanOperationError) as caught:
        bench.client.send(READ)
    assert caught.value.error_code == errno.ENODEV
    if recv_raises:
        with pytest.raises(can.CanOperationError):
            bench.bus.recv(1.0)
    else:
        assert bench.bus.recv(1.0) is None


def test_refused_values(make_bench: BenchMaker) -> None:
    bench = make_bench(faults='[[refuse]]\nobject="0x2010:02"\ncode="0x06090030"\ncount=1')
    with pytest.raises(Aborted) as caught:
        bench.client.put(0x2010, 2, 0.2, "f")
    assert caught.value.code == 0x06090030
    bench.client.put(0x2010, 2, 0.2, "f")
    assert bench.client.number(0x2010, 2, "f") == pytest.approx(0.2)


@pytest.mark.parametrize(("announce", "cut", "announced", "sent"), [(16, 0, 26, 10), (0, 3, 10, 7), (-4, 0, 6, 10)])
def test_lies_about_sizes(make_bench: BenchMaker, announce: int, cut: int, announced: int, sent: int) -> None:
    bench = make_bench(faults=f'[[lie]]\nobject="0x1008"\nannounce={announce}\ncut={cut}')
    first = bench.client.ask(HEAD.pack(0x40, 0x1008, 0) + bytes(4))
    assert first is not None
    assert int.from_bytes(first[4:], "little") == announced
    data, toggle = b"", 0
    while True:
        frame = bench.client.ask(bytes((0x60 | toggle,)) + bytes(7))
        assert frame is not None
        data += frame[1 : 8 - (frame[0] >> 1 & 7)]
        toggle ^= 0x10
        if frame[0] & 1:
            break
    assert len(data) == sent
    with pytest.raises(Lost):
        bench.client.read(0x1008)


def test_a_slow_store(make_bench: BenchMaker) -> None:
    bench = make_bench(faults="[store]\nfactor=20.0", timeout_s=20.0)
    started = bench.bus.clock.now()
    bench.client.put(0x1010, 1, 0x65766173)
    assert 6.0 < bench.bus.clock.now() - started < 10.0
    assert bench.client.number(0x1018, 4) == SERIAL


def test_absent_objects(make_bench: BenchMaker) -> None:
    names = ("0x1016", "0x6007:00", "0x1018:04")
    bench = make_bench(faults="".join(f'[[absent]]\nobject="{name}"\n' for name in names))
    for _ in range(2):
        for index, sub, code in ((0x1016, 0, 0x06020000), (0x1016, 1, 0x06020000), (0x6007, 0, 0x06020000),
                                 (0x1018, 4, 0x06090011)):  # fmt: skip
            for request in (HEAD.pack(0x40, index, sub) + bytes(4), HEAD.pack(0x23, index, sub) + bytes(4)):
                answer = bench.client.ask(request)
                assert answer == b"\x80" + request[1:4] + code.to_bytes(4, "little")
        assert bench.client.number(0x1018, 1) == 0x706D736D
        bench.nmt(129)
        bench.wait(0.1)
        bench.client.drain()


def test_a_mapped_object_that_is_absent_empties_its_pdo(make_bench: BenchMaker) -> None:
    bench = make_bench(faults='[[absent]]\nobject="0x6041"')
    for command in (130, 1):
        bench.nmt(command)
        bench.wait(0.1)
    assert 0x181 not in bench.ids(0.5)
    with pytest.raises(ConfigError, match="no object 0x4711"):
        make_bench(faults='[[absent]]\nobject="0x4711"')


def test_an_empty_file_is_no_fault() -> None:
    assert parse_faults("") == FaultPlan()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[[frmae]]", "unknown table"),
        ('[[frame]]\naction="explode"', "allowed are drop"),
        ("[[frame]]\nprobability=0.5", "action missing"),
        ('[[frame]]\naction="drop"\nprobability=2', "within 0"),
        ('[[frame]]\naction="drop"\nprob=0.5', "unknown key"),
        ('[[drive]]\naction="reset"', "exactly one of"),
        ('[[drive]]\naction="reset"\nat_s=1\nat_frame=2', "exactly one of"),
        ('[[refuse]]\nobject="0x2010:02"', "code missing"),
        ('[[lie]]\nobject="here"', "object"),
        ('[[absent]]\nobject="here"', "object"),
        ("[store]\nfactor=0", "factor"),
        ("frame = 3", "array of tables"),
        ("[[frame", "is not TOML"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(text: str, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        parse_faults(text)


def test_all_mistakes_of_a_file_are_listed_at_once(tmp_path: Path) -> None:
    path = tmp_path / "faults.toml"
    path.write_text('[[frame]]\naction="x"\n[[drive]]\naction="y"\n[[lie]]\n', encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_faults(path)
    assert len(caught.value.violations) == 3
    assert str(path) in str(caught.value)
    with pytest.raises(ConfigError, match="no such file"):
        load_faults(tmp_path / "missing.toml")


def test_the_example_has_every_table_and_key_and_works(make_bench: BenchMaker) -> None:
    from pmsmtool.sim import faults

    tables = tomllib.loads(faults.EXAMPLE)
    assert set(tables) == set(faults._TABLES)
    for name, known in (
        ("frame", faults._FRAME), ("drive", faults._DRIVE), ("adapter", faults._ADAPTER), ("refuse", faults._REFUSE),
        ("lie", faults._LIE), ("absent", faults._ABSENT),
    ):  # fmt: skip
        shown = {key for row in tables[name] for key in row}
        assert all(key in shown or f"# {key} =" in faults.EXAMPLE or f"or {key}" in faults.EXAMPLE for key in known)
    for choice in (*faults.FRAME_ACTIONS, *faults.DRIVE_ACTIONS, *faults.DIRECTIONS):
        assert choice in faults.EXAMPLE
    bench = make_bench(faults=faults.EXAMPLE)
    assert bench.client.number(0x1018, 4) == SERIAL
