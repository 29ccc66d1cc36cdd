# SPDX-License-Identifier: MIT
"""The dead-man: proven before motion, refused where the drive cannot, and true when it matters."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import can
import pytest

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.clock import WallClock
from pmsmtool.bus.connect import Connection
from pmsmtool.bus.nmt import HEARTBEAT_ID, TOOL_NODE, NmtCommand, NmtState
from pmsmtool.cia402 import AbortConnection, FaultReaction, State
from pmsmtool.drive import dead_man, objects
from pmsmtool.drive.dead_man import CONSUMER_MS, TRIES, DeadManProof, _fault_without_ramp, prove_dead_man
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.heartbeat import PERIOD_S, Heartbeat
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import BusError, SafetyRefusal
from pmsmtool.sim.node.dictionary import Refused
from tests.bus.scripted import ScriptedBus, ScriptedSlave
from tests.drive.bench import ENVELOPE, SimBench, sim_bench
from tests.drive.table_drive import node_of


@pytest.fixture
def bench() -> Iterator[SimBench]:
    with sim_bench() as opened:
        yield opened


@pytest.mark.parametrize("option", [AbortConnection.FAULT, AbortConnection.DISABLE_VOLTAGE, AbortConnection.QUICK_STOP])
def test_every_option_that_stops_is_proven(bench: SimBench, option: AbortConnection) -> None:
    """Where the drive does not take the one that removes the voltage."""
    bench.drive.node.sdo.download(0x6007, 0, int(option).to_bytes(2, "little"))
    bench.session.dictionary["cia402.abort_connection"].sink = lambda data: None
    proof = prove_dead_man(bench.drive, Heartbeat(bench.connection))
    assert proof.abort_connection is option and proof.measured_s <= proof.declared_s
    assert proof.measured_s > 1e-3 * CONSUMER_MS - PERIOD_S
    assert bench.session.power.state is State.SWITCH_ON_DISABLED


def test_option_that_does_nothing_is_changed_for_the_experiment_and_restored(bench: SimBench) -> None:
    bench.drive.node.sdo.download(0x6007, 0, b"\0\0")
    with guarded(bench.drive, ENVELOPE) as guard:
        assert guard.proof is not None and guard.proof.abort_connection is AbortConnection.DISABLE_VOLTAGE
    assert bench.drive.node.sdo.read(0x6007, 0) == b"\0\0"


@pytest.mark.parametrize("index", [0x1016, 0x6007])
def test_drive_without_the_objects_is_refused_before_motion(bench: SimBench, index: int) -> None:
    def absent() -> bytes:
        raise Refused(AbortCode.NO_OBJECT)

    def refused(data: bytes) -> None:
        raise Refused(AbortCode.NO_OBJECT)

    for entry in bench.session.dictionary:
        if entry.row.index == index:
            entry.source = absent
            entry.sink = refused
    states: list[State] = []
    bench.session.power.on_state = lambda: states.append(bench.session.power.state)
    with pytest.raises(SafetyRefusal) as caught, guarded(bench.drive, ENVELOPE):
        pass
    assert caught.value.exit_code == 5 and f"0x{index:04X}" in str(caught.value)
    assert State.OPERATION_ENABLED not in states


def test_drive_that_ignores_the_heartbeat_is_refused_and_stopped(bench: SimBench) -> None:
    bench.session.consumer.heard = lambda node: None  # type: ignore[method-assign]
    with pytest.raises(SafetyRefusal, match="still enabled 350 ms after"), guarded(bench.drive, ENVELOPE):
        pass
    assert bench.session.power.state is State.SWITCH_ON_DISABLED


def test_the_proof_itself_stops_what_it_has_enabled(bench: SimBench) -> None:
    """Not only the guard around it, which comes later."""
    heartbeat = Heartbeat(bench.connection)
    with pytest.raises(SafetyRefusal, match="still enabled"):
        bench.session.consumer.heard = lambda node: None  # type: ignore[method-assign]
        prove_dead_man(bench.drive, heartbeat)
    assert bench.session.power.state is State.SWITCH_ON_DISABLED


def test_what_a_person_reads_of_a_proof() -> None:
    proof = DeadManProof(0.25, 0.105, AbortConnection.FAULT, 2, State.SWITCH_ON_DISABLED, by="node guarding")
    assert str(proof) == (
        "supervision tested: node guarding stopped, voltage off after 105 ms (declared 250 ms), to SWITCH ON DISABLED"
    )


@pytest.mark.parametrize(("held", "written"), [(FaultReaction.DISABLE, 0), (FaultReaction.SLOW_DOWN, 1)])
def test_a_fault_removes_the_voltage_at_once(held: FaultReaction, written: int) -> None:
    with node_of({objects.FAULT_REACTION: held}, load_family("cia402")) as (table, node):
        _fault_without_ramp(node)
        assert node.whole(objects.FAULT_REACTION) == FaultReaction.DISABLE
        assert len(table.written(objects.FAULT_REACTION)) == written


def stalling(bench: SimBench, monkeypatch: pytest.MonkeyPatch, stalls: int) -> list[float]:
    """Let the computer stand still behind the first question for the state in each of so many measurements."""
    state, begun = bench.drive.node.state, Heartbeat.stop
    due: list[float] = []
    seen: list[float] = []

    def stop(self: Heartbeat) -> None:
        begun(self)
        if len(seen) < stalls:
            due.append(0.5)

    def asked() -> State | None:
        found = state()
        if due:
            seen.append(due.pop())
            bench.bus.clock.wait(seen[-1])
        return found

    monkeypatch.setattr(Heartbeat, "stop", stop)
    monkeypatch.setattr(bench.drive.node, "state", asked)
    return seen


def test_a_measurement_in_which_the_computer_stalled_is_repeated(
    bench: SimBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = stalling(bench, monkeypatch, TRIES - 1)
    proof = prove_dead_man(bench.drive, Heartbeat(bench.connection))
    assert len(seen) == TRIES - 1, "the trap was set"
    assert 1e-3 * CONSUMER_MS - PERIOD_S < proof.measured_s <= proof.declared_s
    assert bench.session.power.state is State.SWITCH_ON_DISABLED


def test_late_answers_show_no_dead_man_and_are_not_told_as_a_busy_computer(
    bench: SimBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = stalling(bench, monkeypatch, 100)
    late = pytest.raises(SafetyRefusal, match="answer took up to 50. ms, and this computer was up to 0 ms late")
    with late as caught, guarded(bench.drive, ENVELOPE):
        pass
    assert len(seen) >= TRIES and "bus is slow" in caught.value.likely
    assert bench.session.power.state is State.SWITCH_ON_DISABLED


def test_a_computer_that_always_stalls_shows_no_dead_man(bench: SimBench, monkeypatch: pytest.MonkeyPatch) -> None:
    """It wakes late from its own pauses."""
    wait, stop, stopped = bench.connection.wait, Heartbeat.stop, list[bool]()

    def late(seconds: float) -> None:
        wait(seconds + (0.4 if stopped and stopped.pop() else 0.0))

    def note(self: Heartbeat) -> None:
        stop(self)
        stopped.append(True)

    monkeypatch.setattr(bench.connection, "wait", late)
    monkeypatch.setattr(Heartbeat, "stop", note)
    with pytest.raises(SafetyRefusal, match="this computer was up to 4.. ms late") as caught:
        prove_dead_man(bench.drive, Heartbeat(bench.connection))
    assert "other programs" in caught.value.likely
    assert bench.session.power.state is State.SWITCH_ON_DISABLED


def test_a_heartbeat_that_this_computer_held_back_is_no_fault_of_the_drive(bench: SimBench) -> None:
    heartbeat = Heartbeat(bench.connection)
    beat, held = heartbeat._beat, [2e-3 * CONSUMER_MS]

    def late() -> None:
        if not held or bench.bus.clock.now() > started + held[0]:
            held.clear()
            beat()

    heartbeat._beat = late  # type: ignore[method-assign]
    started = bench.bus.clock.now()
    assert prove_dead_man(bench.drive, heartbeat).measured_s > 1e-3 * CONSUMER_MS - PERIOD_S
    assert not held, "the trap was set"


def test_a_drive_that_reacts_late_is_refused(bench: SimBench) -> None:
    heard = bench.session.consumer.heard

    def late(node: int) -> None:
        heard(node)
        bench.session.consumer._deadline[node] += 200_000_000

    bench.session.consumer.heard = late  # type: ignore[method-assign]
    with pytest.raises(SafetyRefusal, match="350 ms after"), guarded(bench.drive, ENVELOPE):
        pass
    assert bench.session.power.state is State.SWITCH_ON_DISABLED


def test_all_entries_taken_is_refused(bench: SimBench) -> None:
    for sub in range(1, 5):
        bench.drive.node.sdo.download(0x1016, sub, (0x10 + sub << 16 | 500).to_bytes(4, "little"))
    with pytest.raises(SafetyRefusal, match="taken"), guarded(bench.drive, ENVELOPE):
        pass


def test_a_drive_that_counts_more_entries_than_it_has_is_supervised(bench: SimBench) -> None:
    """It was refused as one without a consumer heartbeat."""
    for sub in (2, 3, 4):
        bench.session.dictionary.hide(0x1016, sub)
    with guarded(bench.drive, ENVELOPE) as guard:
        assert guard.proof is not None


@pytest.mark.parametrize(("held", "after"), [(CONSUMER_MS, 0), (CONSUMER_MS + 1, TOOL_NODE << 16 | CONSUMER_MS + 1)])
def test_the_entry_a_killed_run_left_is_freed_and_an_owners_is_kept(bench: SimBench, held: int, after: int) -> None:
    bench.drive.node.sdo.download(0x1016, 1, (TOOL_NODE << 16 | held).to_bytes(4, "little"))
    with guarded(bench.drive, ENVELOPE) as guard:
        assert guard.proof is not None
    assert int.from_bytes(bench.drive.node.sdo.read(0x1016, 1), "little") == after


def test_an_entry_that_watches_the_tool_already_is_taken_before_a_free_one(bench: SimBench) -> None:
    """Two entries for one node are refused by many drives (CiA 301, object 0x1016)."""
    sdo = bench.drive.node.sdo
    sdo.download(0x1016, 2, (TOOL_NODE << 16 | 777).to_bytes(4, "little"))
    with guarded(bench.drive, ENVELOPE):
        words = [int.from_bytes(sdo.read(0x1016, sub), "little") for sub in (1, 2)]
    assert words == [0, TOOL_NODE << 16 | CONSUMER_MS]


def test_a_lost_adapter_hides_no_other_error_of_a_drive_that_was_started(monkeypatch: pytest.MonkeyPatch) -> None:
    """Exit code 3 of the adapter stood over 8: the drive did not confirm that it stopped."""
    sent: list[NmtCommand] = []

    def send(connection: Any, command: NmtCommand, node: int) -> None:
        sent.append(command)
        if command is NmtCommand.PRE_OPERATIONAL:
            raise BusError("the adapter is gone")

    monkeypatch.setattr(dead_man, "send_nmt", send)
    state = SimpleNamespace(nmt_state=NmtState.PRE_OPERATIONAL)
    node: Any = SimpleNamespace(supervision=state, connection=None, node=5, before_close=[])
    dead_man._start(node)
    for restore in node.before_close:
        restore()
    assert sent == [NmtCommand.START, NmtCommand.PRE_OPERATIONAL]


def test_killed_tool_stops_the_machine(bench: SimBench) -> None:
    with guarded(bench.drive, ENVELOPE) as guard:
        guard.enable()
        guard._heartbeat.stop()
        bench.bus.clock.wait(1e-3 * CONSUMER_MS - PERIOD_S)
        assert bench.session.power.state is State.OPERATION_ENABLED
        bench.bus.clock.wait(PERIOD_S + 0.1)
        assert bench.session.power.state is not State.OPERATION_ENABLED
        bench.bus.clock.wait(0.5)  # the quick stop is over
        assert bench.session.power.state is State.SWITCH_ON_DISABLED


@pytest.mark.chain
@pytest.mark.wall_clock
def test_heartbeat_on_the_wall_clock_has_its_own_thread() -> None:
    """A main thread busy for a second: the gaps between heartbeats stay far below the consumer time."""
    bus = ScriptedBus(ScriptedSlave())
    beats: list[float] = []
    threads = threading.active_count()

    def note(msg: can.Message, timeout: float | None = None) -> None:
        beats.append(time.monotonic())

    bus.send = note  # type: ignore[method-assign]
    connection = Connection(bus)
    connection.clock = WallClock()
    with Heartbeat(connection):
        end = time.monotonic() + 1.0
        while time.monotonic() < end:
            sum(range(20_000))
    gaps = [b - a for a, b in itertools.pairwise(beats)]
    assert len(beats) >= 15 and max(gaps) < 1e-3 * CONSUMER_MS
    assert threading.active_count() <= threads + 1, "the bus's reader"


def test_heartbeat_carries_the_tools_node_id(bench: SimBench) -> None:
    heard: list[int] = []

    def note(can_id: int, data: bytes, flags: int = 0) -> None:
        heard.append(can_id)

    bench.simulated.receive = note  # type: ignore[method-assign]
    with Heartbeat(bench.connection):
        bench.bus.clock.wait(0.5)
    assert heard.count(0x700 + TOOL_NODE) in (10, 11)


def test_nothing_is_enabled_unwatched_after_the_dead_man_ended_operation(bench: SimBench) -> None:
    """The drive watches again from the next heartbeat on: enabling sends it, and a tool that then dies is noticed."""
    with guarded(bench.drive, ENVELOPE) as guard, bench.drive.node.emergencies_tolerated():
        guard.enable()
        guard._heartbeat.stop()
        bench.connection.wait(4e-3 * CONSUMER_MS)
        assert bench.session.power.state is not State.OPERATION_ENABLED, "the dead-man ended operation"
        guard.enable()
        guard.wait(4e-3 * CONSUMER_MS)
        assert bench.session.power.state is State.OPERATION_ENABLED, "the heartbeat runs again"
        guard._heartbeat.stop()
        bench.connection.wait(4e-3 * CONSUMER_MS)
        assert bench.session.power.state is not State.OPERATION_ENABLED, "and the drive watches it"


def test_a_heartbeat_that_could_not_be_sent_is_sent_before_enabling(
    bench: SimBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    send, lost = bench.connection.send, []

    def broken(identifier: int, data: bytes, **options: float) -> None:
        if identifier == HEARTBEAT_ID + TOOL_NODE and lost:
            raise BusError("the cable is pulled")
        send(identifier, data, **options)

    monkeypatch.setattr(bench.connection, "send", broken)
    heartbeat = Heartbeat(bench.connection)
    with heartbeat:
        lost.append(True)
        bench.connection.wait(1.5 * PERIOD_S)
        with pytest.raises(BusError, match="cable"):
            heartbeat.resume()
        lost.clear()
        heard: list[int] = []
        monkeypatch.setattr(bench.connection, "send", lambda identifier, data, **options: heard.append(identifier))
        heartbeat.resume()
        heartbeat.resume()
        assert heard == [HEARTBEAT_ID + TOOL_NODE], "one at once, and none more while it runs"


def test_a_guard_that_has_ended_enables_nothing(bench: SimBench) -> None:
    with guarded(bench.drive, ENVELOPE) as guard:
        pass
    with pytest.raises(SafetyRefusal, match="the guard has ended"):
        guard.enable()
    assert bench.session.power.state is State.SWITCH_ON_DISABLED
