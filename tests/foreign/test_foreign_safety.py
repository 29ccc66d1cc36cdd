# SPDX-License-Identifier: MIT
"""Safety on drives as their makers built them: whatever they have is used and proven, what they lack is replaced.

The limits of every class of drive stand in ``tests/drive``; here is what differs where objects are missing.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import cast

import can
import pytest

from pmsmtool.bus.connect import connect
from pmsmtool.cia402 import AbortConnection, State
from pmsmtool.drive.dead_man import CONSUMER_MS, REACTION_S
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import WATCH_S, guarded
from pmsmtool.drive.motion_objects import LENT_SLOPE, position_units, watched_by_tool
from pmsmtool.drive.torque_drives import SpeedPushDrive, TorqueDrive, pushing_drive
from pmsmtool.drive_maps.drive_map_file import parse_drive_map
from pmsmtool.drive_maps.shipped_maps import family_of, load_family
from pmsmtool.errors import DriveFault, LimitExceeded, NotAvailable, SafetyRefusal
from pmsmtool.sim.foreign.drive import ForeignDrive
from pmsmtool.sim.node.node import Node
from pmsmtool.sim.node.session import Session
from tests.foreign.data_sheets import (
    COMMON,
    EXPECTED_PDO,
    GUARDING,
    HEARTBEAT,
    TORQUE,
    Row,
    copley,
    epos4,
    faulhaber,
    identity,
    unknown,
    write_eds,
)

ENVELOPE = Envelope(i_max_apk=3.0, speed_max_rad_s=100.0)
DECLARED_S = 1e-3 * CONSUMER_MS + REACTION_S


class Rig:
    """A foreign drive and the tool's side of it."""

    def __init__(self, drive: TorqueDrive, node: Node) -> None:
        self.drive, self.simulated = drive, node
        assert node.session is not None
        self.session: Session = node.session
        self.face = cast(ForeignDrive, node.face)
        self.off_since: float | None = None
        self.was_on = False
        self.session.power.on_state = self._noted

    def _noted(self) -> None:
        energised = self.session.power.state.energised
        self.was_on |= energised
        self.off_since = None if energised else self.drive.node.connection.clock.now()

    def number(self, index: int, sub: int = 0) -> int:
        return self.session.dictionary.find(index, sub).integer()

    def memory(self) -> dict[tuple[int, int], bytes]:
        entries = [entry for entry in self.session.dictionary if entry.writable and entry.row.index != 0x6040]
        return {(entry.row.index, entry.row.sub): entry.read() for entry in entries}


@contextmanager
def opened(
    path: Path, rows: tuple[Row, ...], family: str = "", limits: dict[tuple[int, int], tuple[int, int]] | None = None
) -> Iterator[Rig]:
    eds = write_eds(path / "drive.eds", rows, limits)
    with connect("pmsmsim", f"interior-2k2?nv=:memory:&eds={eds}") as connection:
        node = cast(Node, connection.bus.line.nodes[0])  # type: ignore[attr-defined]
        drive_map = load_family(family) if family else family_of(*node.identity[:2]) or load_family("cia402")
        drive = pushing_drive(connection, 1, drive_map)
        yield Rig(drive, node)
        drive.close()


def test_node_guarding_is_proven_where_there_is_no_heartbeat(tmp_path: Path) -> None:
    """Vendor 0xAB: no 0x1016, no 0x6007, none of 0x6073, 0x6075, 0x6080; its own limit in its own unit."""
    with opened(tmp_path, copley()) as rig:
        before = rig.memory()
        with guarded(rig.drive, ENVELOPE) as guard:
            assert guard.proof is not None and str(guard.proof).startswith("supervision tested: node guarding stopped")
            assert guard.proof.abort_connection is None and guard.proof.measured_s <= DECLARED_S
            assert rig.number(0x2110) == 300, "counts of 0.01 A peak"
            guard.enable()
            guard.command_current(0.0, 1.0)
            guard.wait(3.0 * WATCH_S)
            assert rig.session.power.state is State.OPERATION_ENABLED
        assert rig.off_since is not None
        assert [key for key, data in rig.memory().items() if data != before[key]] == []


@pytest.mark.parametrize("kind", ["I32", "U8"])
def test_option_codes_of_another_width_are_set_and_brought_back(tmp_path: Path, kind: str) -> None:
    """They were refused as a drive without heartbeat supervision, for a length that was not expected."""
    codes = {0x6007: "3", 0x605A: "6", 0x605E: "1"}
    rows = unknown("0x2D", *((index, 0, kind, "rw", value) for index, value in codes.items()))
    with opened(tmp_path, rows) as rig:
        before = rig.memory()
        with guarded(rig.drive, ENVELOPE) as guard:
            assert guard.proof is not None and guard.proof.abort_connection is AbortConnection.DISABLE_VOLTAGE
            assert [rig.number(index) for index in (0x6007, 0x605A)] == [2, 0]
            guard.enable()
        assert rig.off_since is not None
        assert [key for key, data in rig.memory().items() if data != before[key]] == []


FIXED_HEARTBEAT: tuple[Row, ...] = ((0x1016, 1, "U32", "ro", "0"),)
"""A consumer heartbeat time that nobody sets over the bus."""


def test_a_heartbeat_that_cannot_be_set_leaves_node_guarding(tmp_path: Path) -> None:
    with opened(tmp_path, (*copley(), *FIXED_HEARTBEAT)) as rig, guarded(rig.drive, ENVELOPE) as guard:
        assert guard.proof is not None and guard.proof.by == "node guarding"


def test_a_target_beyond_what_the_drive_takes_is_not_available(tmp_path: Path) -> None:
    """Refused in the middle of a push: the voltage is off, and the limit is named instead of an abort code."""
    with opened(tmp_path, unknown(), limits={(0x6071, 0): (-100, 100)}) as rig:
        with pytest.raises(NotAvailable, match="takes no target of"), guarded(rig.drive, ENVELOPE) as guard:
            guard.enable()
            guard.command_current(0.0, 2.0)
        assert rig.was_on and rig.off_since is not None


FIXED_PDO: tuple[Row, ...] = ((0x1400, 2, "U8", "rw", "255"), (0x1400, 5, "U16", "rw", "100"))
"""A receive PDO that is expected, but carries what it carries."""


def unwatched(*more: Row) -> tuple[Row, ...]:
    """Vendor 0xAB without node guarding."""
    return (*(row for row in copley() if row not in GUARDING), *more)


@pytest.mark.parametrize("more", [(), FIXED_PDO, FIXED_HEARTBEAT])
def test_a_drive_without_any_supervision_is_refused(tmp_path: Path, more: tuple[Row, ...]) -> None:
    with opened(tmp_path, unwatched(*more)) as rig:
        with pytest.raises(SafetyRefusal, match="there is no node guarding"), guarded(rig.drive, ENVELOPE):
            pass
        assert not rig.was_on


@pytest.mark.parametrize("by", ["heartbeat", "node guarding", "process data"])
def test_a_supervision_that_ends_takes_the_voltage_away(tmp_path: Path, by: str) -> None:
    """An expected PDO is the last choice; it is borrowed, carries nothing, and is what it was afterwards."""
    rows = {"heartbeat": epos4(), "node guarding": copley(), "process data": unwatched(*EXPECTED_PDO)}
    with opened(tmp_path, rows[by]) as rig:
        before = rig.memory()
        with pytest.raises(DriveFault), guarded(rig.drive, ENVELOPE) as guard:
            assert guard.proof is not None and guard.proof.by == by and guard.proof.measured_s <= DECLARED_S
            guard.enable()
            guard.command_current(0.0, 1.0)
            guard.wait(5.0 * WATCH_S)
            assert rig.session.power.state is State.OPERATION_ENABLED
            guard._heartbeat.stop()
            began = rig.drive.node.connection.clock.now()
            guard.wait(5.0)
        assert rig.off_since is not None and 0.0 < rig.off_since - began <= DECLARED_S
        rig.drive.close()
        assert [key for key, data in rig.memory().items() if data != before[key]] == []


@pytest.mark.parametrize("more", [GUARDING, EXPECTED_PDO])
def test_a_supervision_that_only_reports_is_refused(tmp_path: Path, more: tuple[Row, ...]) -> None:
    with opened(tmp_path, unwatched(*more)) as rig:
        power = rig.session.power
        power.connection_lost = lambda node, code=0: power._emergency.raise_error(0x8130)  # type: ignore[method-assign]
        with pytest.raises(SafetyRefusal, match="still enabled 350 ms after"), guarded(rig.drive, ENVELOPE):
            pass
        assert not power.state.energised


def test_an_adapter_without_remote_frames_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with opened(tmp_path, copley()) as rig:
        bus = rig.drive.node.connection.bus
        send = bus.send

        def without(message: can.Message, timeout: float | None = None) -> None:
            if not message.is_remote_frame:
                send(message, timeout)

        monkeypatch.setattr(bus, "send", without)
        with pytest.raises(SafetyRefusal, match="does not answer the remote frames") as caught, \
                guarded(rig.drive, ENVELOPE):  # fmt: skip
            pass
        assert "adapter sends no remote frames" in caught.value.likely and not rig.was_on


@pytest.mark.parametrize(("access", "step_s"), [("rw", 1e-3), ("ro", 1e-2)])
def test_a_cyclic_torque_is_asked_for_at_the_drives_period(tmp_path: Path, access: str, step_s: float) -> None:
    """Stored 10 ms: set to the 1 ms of the tool's ramp where the drive takes it, else the ramp takes 10 ms a step."""
    period: tuple[Row, ...] = ((0x60C2, 1, "U8", access, "10"), (0x60C2, 2, "I8", "ro", "-3"))
    with opened(tmp_path, (*epos4(), *period)) as rig:
        before = rig.memory()
        with guarded(rig.drive, ENVELOPE) as guard:
            guard.enable()
            assert rig.number(0x60C2, 1) == round(1e3 * step_s)
            began = rig.drive.node.connection.clock.now()
            guard.command_current(0.0, 2.9)
            steps = math.ceil(2.9 / (0.1 * rig.drive.rated_apk)) - 1
            assert steps >= 2 and rig.drive.node.connection.clock.now() - began >= steps * step_s
        assert [key for key, data in rig.memory().items() if data != before[key]] == []


def test_its_own_limit_gets_the_reading_with_the_smaller_current(tmp_path: Path) -> None:
    """mA, peak or rms unknown: 3 A peak is 2121 mA if rms, and 2.12 A peak if the drive means peak."""
    with opened(tmp_path, epos4()) as rig:
        before = rig.memory()
        with guarded(rig.drive, ENVELOPE) as guard:
            held = rig.number(0x3001, 2)
            assert held == math.ceil(3000.0 / math.sqrt(2.0)) and rig.number(0x6080) == 955
            guard.enable()
            guard.command_current(0.0, 2.0)
            guard.wait(0.03)
            shown = rig.drive.live("i_q_a")
            assert 0.0 < shown <= 1.1 * 2.0, "what is watched is the larger reading"
        assert [key for key, data in rig.memory().items() if data != before[key]] == []


def test_a_limit_of_its_own_that_is_not_held_is_refused(tmp_path: Path) -> None:
    with opened(tmp_path, epos4()) as rig:
        rig.session.dictionary.find(0x3001, 2).sink = lambda data: None
        with pytest.raises(SafetyRefusal, match="holds the limit") as caught, guarded(rig.drive, ENVELOPE):
            pass
        assert "0x3001:02" in caught.value.where and not rig.was_on


def test_a_limit_that_limits_nothing_is_refused_by_the_makers_rated_current(tmp_path: Path) -> None:
    with opened(tmp_path, copley()) as rig:
        with pytest.raises(SafetyRefusal, match="is none"), guarded(rig.drive, replace(ENVELOPE, i_max_apk=1e4)):
            pass
        assert not rig.was_on


def test_without_a_speed_limit_the_tool_stops_at_the_limit_itself(tmp_path: Path) -> None:
    """No 0x6080: not one quarter above, as where the drive limits the speed, too."""
    with opened(tmp_path, copley()) as rig:
        envelope, seen = replace(ENVELOPE, speed_max_rad_s=10.0), list[float]()
        with pytest.raises(LimitExceeded, match="speed") as caught, guarded(rig.drive, envelope) as guard:
            guard.enable()
            guard.command_current(0.0, 0.6)
            for _ in range(100):
                guard.wait(0.01)
                seen.append(rig.session.power.omega_m())
        assert max(seen) < 10.0 + 0.06 * (seen[-1] - seen[-3]) / 0.02, "one look later at most"
        assert caught.value.exit_code == 5 and not rig.session.power.state.energised


def test_a_torque_that_is_taken_at_once_is_ramped_here(tmp_path: Path) -> None:
    """Mode 10 has no torque slope: at most a tenth of rated per millisecond."""
    with opened(tmp_path, epos4()) as rig:
        assert rig.drive.target.mode == 10
        with guarded(rig.drive, replace(ENVELOPE, i_max_apk=6.0)) as guard:
            guard.enable()
            began = rig.drive.node.connection.clock.now()
            guard.command_current(0.0, 5.0)
            took = rig.drive.node.connection.clock.now() - began
        assert rig.face.behind is not None
        assert 0.05 < rig.face.behind.largest_step <= 0.101
        assert took >= 0.005


@pytest.mark.parametrize(("modes", "mode"), [(0x22D, 4), (0x225, 10)])
def test_the_mode_is_the_live_drives(tmp_path: Path, modes: int, mode: int) -> None:
    with opened(tmp_path, epos4(modes)) as rig:
        assert rig.drive.target.mode == mode


@pytest.mark.parametrize(("late_s", "shown"), [(math.inf, 3), (math.inf, 0), (0.2, 3)])
def test_a_drive_that_stays_in_another_mode_is_refused_before_it_is_energised(
    tmp_path: Path, late_s: float, shown: int
) -> None:
    """0x6060 is taken, 0x6061 stays: its velocity loop would have taken the torque's zero for a speed."""
    with opened(tmp_path, epos4()) as rig:
        clock, mode = rig.drive.node.connection.clock, rig.session.dictionary.find(0x6060, 0)
        taken, written = [0.0], mode.sink
        assert written is not None

        def take(data: bytes) -> None:
            taken[0] = clock.now()
            written(data)

        mode.sink = take
        rig.session.dictionary.find(0x6061, 0).source = lambda: (
            mode.value if clock.now() - taken[0] >= late_s else bytes((shown,))
        )
        if late_s < 1.0:
            with guarded(rig.drive, ENVELOPE) as guard:
                guard.enable()
            return
        stays = pytest.raises(NotAvailable, match=rf"stays in mode .*\({shown}\), though cyclic torque \(10\)")
        with stays, guarded(rig.drive, ENVELOPE) as guard:
            guard.enable()
        assert not rig.was_on


def test_a_drive_that_shows_no_mode_is_taken_at_its_word(tmp_path: Path) -> None:
    with opened(tmp_path, epos4()) as rig:
        rig.session.dictionary.hide(0x6061)
        with guarded(rig.drive, ENVELOPE) as guard:
            guard.enable()
        assert rig.was_on


SLOPE: tuple[Row, ...] = ((0x6087, 0, "U32", "rw", "100"),)
"""10 % of the rated torque per second: as one maker's drive is stored."""


@pytest.mark.parametrize(
    ("modes", "slope", "mode"), [(0x22D, "100", 10), (0x22D, "3000", 4), (0x22D, "0", 4), (0x2D, "100", 4)]
)
def test_a_slope_too_slow_for_a_push_is_left_for_the_cyclic_mode(
    tmp_path: Path, modes: int, slope: str, mode: int
) -> None:
    with opened(tmp_path, (*epos4(modes), (0x6087, 0, "U32", "rw", slope))) as rig:
        assert rig.drive.target.mode == mode
        told = [line for line in watched_by_tool(rig.drive.node, 10.0) if "0x6087" in line]
        assert len(told) == (slope == "100") and all(("mode 10" in line) == (mode == 10) for line in told)


def test_a_cyclic_torque_is_not_held_back_by_the_slope(tmp_path: Path) -> None:
    """Two amperes within 20 ms in steps of a tenth of rated per millisecond; the slope would take 3 s."""
    with opened(tmp_path, (*epos4(), *SLOPE)) as rig, guarded(rig.drive, ENVELOPE) as guard:
        guard.enable()
        guard.command_current(0.0, 2.0)
        guard.wait(0.02)
        assert rig.drive.live("i_q_a") > 1.0
        assert rig.face.behind is not None and rig.face.behind.largest_step <= 0.101
        assert rig.number(0x6087) == 100, "what the drive holds is left alone"


def test_a_slow_slope_of_the_torque_mode_is_lent_a_faster_one(tmp_path: Path) -> None:
    """Mode 4 alone: two amperes within 60 ms, which would take 3 s; then the slope is the drive's again."""
    with opened(tmp_path, (*epos4(0x2D), *SLOPE)) as rig:
        with guarded(rig.drive, ENVELOPE) as guard:
            guard.enable()
            assert rig.number(0x6087) == LENT_SLOPE
            guard.command_current(0.0, 2.0)
            guard.wait(0.06)
            assert rig.drive.live("i_q_a") > 1.0
        assert rig.number(0x6087) == 100


def test_a_slope_that_stays_slow_is_refused_before_anything_is_energised(tmp_path: Path) -> None:
    rows = (*epos4(0x2D), (0x6087, 0, "U32", "ro", "100"))
    with (
        opened(tmp_path, rows) as rig,
        pytest.raises(NotAvailable, match="10 s to its rated torque"),
        guarded(rig.drive, ENVELOPE) as guard,
    ):
        guard.enable()


def test_a_limit_that_cannot_be_lowered_is_named_and_watched_here(tmp_path: Path) -> None:
    """0x6080 that only reports: the speed may not even overshoot, as without one."""
    rows = (*(row for row in epos4() if row[0] != 0x6080), (0x6080, 0, "U32", "ro", "6000"))
    said: list[str] = []
    with opened(tmp_path, rows) as rig, guarded(rig.drive, ENVELOPE, say=said.append) as guard:
        assert guard.refused_limits and guard.refused_limits[0] in said
        assert "0x6080" in said[0] and "this program looks instead" in said[0]
        assert guard._limits.speed is None and guard._limits.current is not None


def test_a_drive_without_torque_mode_has_no_target(tmp_path: Path) -> None:
    with opened(tmp_path, epos4(0x25)) as rig, pytest.raises(NotAvailable, match="0x6502 = 0x25"):
        rig.drive.command_current(0.0, 1.0)


def test_without_a_torque_mode_the_current_limit_is_the_push(tmp_path: Path) -> None:
    """Velocity mode: enabled with no current at all, pushed by the limit, and everything brought back."""
    with opened(tmp_path, faulhaber()) as rig:
        assert isinstance(rig.drive, SpeedPushDrive)
        rig.drive.top_rad_s = 75.0
        before, at_enable = rig.memory(), list[int]()
        note = rig.session.power.on_state

        def noted() -> None:
            note()
            at_enable.append(rig.number(0x2333, 2) if rig.session.power.state.energised else 0)

        rig.session.power.on_state = noted
        with guarded(rig.drive, ENVELOPE) as guard:
            guard.enable()
            guard.command_current(0.0, 2.0)
            guard.wait(0.1)
            assert rig.number(0x2333, 2) == 1414 and rig.number(0x60FF) == 716
            assert 1.6 < rig.drive.live("i_q_a") < 2.1 and rig.session.power.omega_m() > 5.0
            guard.command_current(0.0, -2.0)
            guard.wait(0.05)
            assert rig.drive.live("i_q_a") < -1.0 and rig.number(0x60FF) == -716
            guard.command_current(0.0, 0.0)
            assert rig.number(0x2333, 2) == 0
            with pytest.raises(LimitExceeded, match="current"):
                guard.command_current(0.0, 3.1)
        assert set(at_enable) == {0}, "the speed loop is not proven when it is enabled"
        assert [key for key, data in rig.memory().items() if data != before[key]] == []


@pytest.mark.parametrize(
    ("rows", "units"),
    [
        (((0x608F, 1, "U32", "ro", "2000"), (0x608F, 2, "U32", "rw", "1")), 2000.0),
        (((0x608F, 1, "U32", "ro", "2000"), (0x607E, 0, "U8", "rw", "0x80")), -2000.0),
        (((0x608F, 1, "U32", "ro", "2000"), (0x60A8, 0, "U32", "rw", "0xFF410000")), 3600.0),
        (((0x6092, 1, "U32", "rw", "360"), (0x6091, 1, "U32", "rw", "10"), (0x6091, 2, "U32", "rw", "1")), 36.0),
    ],
)
def test_position_is_counted_as_the_drive_counts(tmp_path: Path, rows: tuple[Row, ...], units: float) -> None:
    """0x607E, 0x608F, 0x6091, 0x6092 and 0x60A8; drive and tool decode them each for itself."""
    base = tuple(row for row in epos4() if row[0] != 0x3010)
    with opened(tmp_path, (*base, *rows, (0x6075, 0, "U32", "rw", ""))) as rig:
        assert position_units(rig.drive.node) == units
        angle = rig.drive.live("theta_m_rad")
        with guarded(rig.drive, ENVELOPE) as guard:
            guard.enable()
            guard.command_current(0.0, 1.5)
            guard.wait(0.1)
            way = rig.drive.live("theta_m_rad") - angle
        assert way > 0.1, "torque and position turn the same way, whatever the polarity"


def test_a_gear_without_a_feed_is_refused(tmp_path: Path) -> None:
    rows: tuple[Row, ...] = ((0x608F, 1, "U32", "ro", "2000"), (0x6091, 1, "U32", "rw", "10"))
    with pytest.raises(NotAvailable, match="gear of 10"), opened(tmp_path, (*epos4(), *rows)):
        pass


def test_heartbeat_stays_the_first_choice(tmp_path: Path) -> None:
    with opened(tmp_path, (*copley(), *HEARTBEAT)) as rig, guarded(rig.drive, ENVELOPE) as guard:
        assert guard.proof is not None and guard.proof.by == "heartbeat"
        assert rig.number(0x100C) == 0


def test_what_only_its_owner_knows_moves_a_drive(tmp_path: Path) -> None:
    """Torque mode and a torque limit in permille, but neither a rated current nor counts per turn: Eyou's drives."""
    own = (0x6072, 0, "U16", "rw", "1000"), (0x6502, 0, "U32", "ro", "0x8")
    rows = (*COMMON, *HEARTBEAT, *TORQUE, *identity(0x668, 1), (0x6007, 0, "I16", "rw", "2"), *own)
    eds = write_eds(tmp_path / "drive.eds", rows)
    numbers = """
        [capabilities]
        torque_mode = true
        [motion]
        rated_current = { number = 6.0, unit = "A peak", source = "plate" }
        counts_per_turn = { number = 131072, source = "plate" }
        [sources]
        plate = "name plate"
        """
    head = 'schema = "pmsmtool.drive-map/1"\nname = "mine"\nvendor = 0x668\nproduct = 1\n'
    with connect("pmsmsim", f"interior-2k2?nv=:memory:&eds={eds}") as connection:
        with pytest.raises(NotAvailable, match="increments"):
            pushing_drive(connection, 1, load_family("cia402"))
        drive = pushing_drive(connection, 1, parse_drive_map(head + textwrap.dedent(numbers)))
        assert drive.rated_apk == pytest.approx(6.0) and drive.counts_per_turn == 131072
        with guarded(drive, ENVELOPE) as guard:
            guard.enable()
            guard.command_current(0.0, 1.0)
            guard.wait(2.0 * WATCH_S)
            assert abs(guard.live("omega_e_rad_s")) > 1.0
        drive.close()


def test_a_fault_without_an_error_code_is_named_by_its_emergency(tmp_path: Path) -> None:
    """EPOS4's public files have no 0x603F, and an identifier of the emergency that follows the node id."""
    with opened(tmp_path, (*epos4(), (0x1014, 0, "U32", "ro", "$NODEID+0x80"))) as rig:
        assert rig.number(0x1014) == 0x81
        assert not rig.drive.node.has(0x603F, 0)
        rig.session.power.fail(0x3220)
        assert "fault 0x3220: DC-link under-voltage" in rig.drive.node.fault_error().what
