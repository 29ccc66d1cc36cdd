# SPDX-License-Identifier: MIT
"""`map learn` on a simulated drive whose gains a seed drew: what it finds, what it refuses, what it leaves."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import MagicMock

import numpy as np
import pytest

from pmsmtool.bus.connect import connect
from pmsmtool.bus.connection import Connection
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import GuardedDrive, guarded
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.position_drive import PositionDrive
from pmsmtool.drive.speed_loop_drive import Oscillation, SpeedLoopDrive
from pmsmtool.drive_maps.drive_map_file import parse_drive_map
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import DriveFault, LimitExceeded, SafetyRefusal
from pmsmtool.flash.gain_journal import any_left
from pmsmtool.identification.asked_current import AskedLoop
from pmsmtool.identification.learned_gains import Learned, Observation
from pmsmtool.identification.position_lag import PositionLag
from pmsmtool.identification.speed_loop_response import Emf, SpeedLoop
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file, machine_path
from pmsmtool.measurement import changed_gains, learn_gains, learn_position_gain
from pmsmtool.measurement.learned_rows import MeasuredRow, with_measured
from pmsmtool.sim.foreign.drawn_gains import DrawnGains
from pmsmtool.sim.foreign.drive import ForeignDrive
from pmsmtool.sim.node.node import Node
from pmsmtool.trace import Trace
from pmsmtool.units import rad_s_from_rpm
from tests.cli.conftest import Tool
from tests.drive.table_drive import node_of
from tests.foreign.data_sheets import COMMON, HEARTBEAT, Row, identity, write_eds

SEED = 4
MARGIN_TOL_RAD = math.radians(0.8)
"""Of a predicted phase margin; measured 0.4 degrees."""
SCALE_TOL = 0.05
"""Largest error of a position gain (relative); measured 0.01."""
GAIN, INTEGRAL = "speed.K_p_nms_per_rad", "speed.K_i_nm_per_rad"
PDO: tuple[Row, ...] = tuple(
    (base + number, sub, kind, "rw", value)
    for number in (1, 2, 3)
    for base, rows in (
        (0x1800, ((1, "U32", f"{0x80000180 + 0x100 * number:#x}"), (2, "U8", "255"), (5, "U16", "0"))),
        (0x1A00, ((0, "U8", "0"), (1, "U32", "0"), (2, "U32", "0"))),
    )
    for sub, kind, value in rows
)


def drive_rows(*more: Row, modes: int = 0x100) -> tuple[Row, ...]:
    """A drive of CiA 402 with a cyclic velocity mode, limits, process data, and gains in 0x60F9."""
    return (
        *COMMON, *HEARTBEAT, *PDO, *identity(0x999, 1), (0x6007, 0, "I16", "rw", "2"),
        (0x6073, 0, "U16", "rw", ""), (0x6075, 0, "U32", "rw", ""), (0x6078, 0, "I16", "ro", ""),
        (0x606C, 0, "I32", "ro", ""), (0x6080, 0, "U32", "rw", ""), (0x608F, 1, "U32", "ro", "8192"),
        (0x608F, 2, "U32", "ro", "1"), (0x60FF, 0, "I32", "rw", "0"), (0x60F9, 1, "U16", "rw", "0"),
        (0x60F9, 2, "U16", "rw", "0"), (0x6502, 0, "U32", "ro", f"{modes:#x}"), *more,
    )  # fmt: skip


class Bench:
    """A drawn drive that stays powered while commands come and go, and a machine file for it."""

    def __init__(self, folder: Path, *more: Row, modes: int = 0x100) -> None:
        eds = write_eds(folder / "drive.eds", drive_rows(*more, modes=modes))
        machine = load_machine_file(machine_path("interior-2k2"))
        machine.std["J_kgm2"] = 0.02 * machine.machine.J_kgm2  # type: ignore[index, operator]
        self.machine = folder / "machine.toml"
        self.machine.write_text(dump_machine_file(machine), encoding="utf-8")
        self.channel = f"interior-2k2?nv=:memory:&eds={eds}&gains={SEED}"
        self.holder = connect("pmsmsim", self.channel)

    @property
    def node(self) -> Node:
        return cast(Node, self.holder.bus.line.nodes[0])  # type: ignore[attr-defined]

    @property
    def drawn(self) -> DrawnGains:
        gains = cast(ForeignDrive, self.node.face).gains
        assert gains is not None
        return gains

    def counts(self) -> tuple[int, int]:
        assert self.node.session is not None
        find = self.node.session.dictionary.find
        return find(*self.drawn.gain).integer(), find(*self.drawn.integral).integer()

    def learn(self, tool: Tool, *arguments: str, yes: bool = True) -> Any:
        consent = ("--yes",) if yes else ()
        return tool("--sim", self.channel, *consent, "map", "learn", "--machine", str(self.machine), *arguments)


@pytest.fixture
def bench(tool: Tool, tmp_path: Path) -> Any:
    made = Bench(tmp_path)
    yield made
    made.holder.close()


@pytest.mark.chain
def test_learned_gains_are_the_drawn_ones_and_go_into_a_map(
    bench: Bench, tool: Tool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learn_gains, "SETTLE_S", 0.4)
    monkeypatch.setattr(learn_gains, "LEAST_S", 2.4)  # with 1.2 one in a few noises left K_i open
    before = bench.counts()
    code, printed, said = bench.learn(tool, "-o", "mine.toml", "--json")
    assert code == 0, said
    assert bench.counts() == before and not any_left()
    facts = json.loads(printed)
    assert "of the current of torque pulses" in said, "no object shows what the loop asks for"
    drawn, found = bench.drawn, {row["name"]: row for row in facts["gains"]}
    assert found[GAIN]["scale"] == pytest.approx(drawn.K_p_nms_per_rad, rel=0.12)
    assert found[INTEGRAL]["form"] == drawn.form == "time"
    per_ampere, kind = facts["currents"]["torque_per_ampere"], math.sqrt(2.0) if drawn.rms else 1.0
    assert per_ampere == pytest.approx(kind * facts["currents"]["expected_peak"], rel=0.12), "0x6075 may be either"
    assert found[INTEGRAL]["scale"] == pytest.approx(drawn.integral_scale, rel=0.12)
    cells = parse_drive_map((tmp_path / "mine.toml").read_text(encoding="utf-8")).cells
    assert cells[GAIN].source == "measured" and (cells[GAIN].index, cells[GAIN].sub) == drawn.gain
    assert INTEGRAL in cells
    assert cells[GAIN].wire == "INTEGER16", "its two bytes may have a sign: 35000 counts were refused by the drive"


POSITION_ROWS: tuple[Row, ...] = (
    (0x6062, 0, "I32", "ro", ""), (0x607A, 0, "I32", "rw", "0"), (0x6081, 0, "U32", "rw", ""),
    (0x6083, 0, "U32", "rw", ""), (0x6084, 0, "U32", "rw", ""), (0x60FB, 1, "U16", "rw", "0"),
    (0x60FB, 2, "U16", "rw", "0"), (0x60FB, 3, "U16", "rw", "0"),
)  # fmt: skip


@pytest.mark.chain
def test_a_learned_position_gain_is_the_drawn_one(tool: Tool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The drive feeds speed and acceleration forward: these objects are 0 meanwhile, else there is no lag."""
    monkeypatch.setattr(learn_position_gain, "WAY_RAD", 13.0)
    monkeypatch.setattr(learn_position_gain, "REST_S", 0.5)
    bench = Bench(tmp_path, *POSITION_ROWS, modes=0x101)
    drawn, places = bench.drawn, {
        "position.K_p_per_s": (0x60FB, 1), "position.velocity_ff": (0x60FB, 2),
        "position.acceleration_ff_s": (0x60FB, 3),
    }  # fmt: skip
    named = {name: f"0x{index:04X}:{sub:02X} has no unit" for name, (index, sub) in places.items()}
    assert bench.node.session is not None
    forward = bench.node.session.dictionary.find(0x60FB, 2)
    written: list[bytes] = []
    sink = forward.sink
    assert sink is not None
    with connect("pmsmsim", bench.channel) as connection:
        node = DriveNode(connection, 1, drive_map=replace(load_family("cia402"), left_out=named))
        node.write_bytes(0x60FB, 2, round(1.0 / drawn.forward_share).to_bytes(2, "little"))
        node.write_bytes(0x60FB, 3, round(0.03 / drawn.acceleration_ff_s).to_bytes(2, "little"))
        forward.sink = lambda data: (written.append(data), sink(data))[1]
        before = [node.sdo.read(*place) for place in places.values()]
        gain = learn_position_gain.position_gain(node)
        assert gain is not None and (gain.item.index, gain.item.sub) == drawn.position
        envelope = Envelope(i_max_apk=8.0, speed_max_rad_s=60.0, duration_s=60.0)
        found, stopped = learn_position_gain.learn_position_gain(connection, node, gain, envelope, lambda text: None)
        assert [node.sdo.read(*place) for place in places.values()] == before and not any_left()
    assert stopped is None and [one.why for one in found.values()] == ["", "", ""]
    for name, scale in zip(places, (drawn.K_v_per_s, drawn.forward_share, drawn.acceleration_ff_s), strict=True):
        assert found[name].scale == pytest.approx(scale, rel=SCALE_TOL)
    assert written == [bytes(2), before[1], bytes(2), before[1]], "0, its own counts to be learned, 0, then restored"
    bench.holder.close()


@pytest.mark.parametrize(("held", "led_s"), [(21.0, 0.05), (1.0, None)])
def test_a_derivative_part_is_as_small_as_it_can_be_and_is_learned_from_what_it_held(
    held: float, led_s: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """0x2332:02 of a Faulhaber takes 1 to 255; the gain of its loop is larger by what it is worth."""
    written: list[tuple[str, float]] = []
    acting = {learn_position_gain.POSITION: 100.0}

    def put(gain: changed_gains.GainObject, counts: float) -> None:
        acting[gain.name] = counts
        written.append((gain.name, counts))

    @contextmanager
    def changing(*arguments: Any) -> Iterator[tuple[MagicMock, Any]]:
        yield MagicMock(), put

    def lag(trace: object, rad_per_count: float) -> PositionLag:
        gain = 0.1 * acting[learn_position_gain.POSITION]
        return PositionLag(gain, 1e-3, 0.0, 1e-3, (1.0 / gain, 1.0 / gain))

    monkeypatch.setattr(learn_position_gain, "changing", changing)
    monkeypatch.setattr(learn_position_gain, "record_move", lambda *arguments, **found: (MagicMock(), None))
    monkeypatch.setattr(learn_position_gain, "position_lag", lag)
    monkeypatch.setattr(learn_position_gain, "ramp_areas", lambda trace: None)
    monkeypatch.setattr(learn_position_gain, "led_s", lambda trace, areas: (led_s, 1e-3))
    counts = {DriveObject(0x2332, 1, "H"): 100.0, DriveObject(0x2332, 2, "H"): held}
    found: dict[str, Learned] = {}
    with node_of(counts, load_family("faulhaber")) as (_, node):
        gain = learn_position_gain.position_gain(node)
        assert gain is not None
        drive = cast(PositionDrive, MagicMock(node=node))
        learn_position_gain._moved(drive, gain, Envelope(8.0, 60.0), lambda text: None, found)
    name = learn_position_gain.DERIVATIVE
    assert found[learn_position_gain.POSITION].scale == pytest.approx(0.1)
    asked = [counts for which, counts in written if which == name]
    if led_s is None:
        assert name not in found and asked == [1.0], "it is not more than its least: as it was at the end"
        return
    assert found[name].scale == pytest.approx(10.0 * led_s / 20.0), "K_v times the lead, over 20 counts more"
    assert asked == [1.0, held, held], "its least, its own counts, which are learned, and as it was"


def test_measured_rows_make_a_map_and_check_a_published_one() -> None:
    rows = [
        MeasuredRow(GAIN, 0x60F9, 1, "UNSIGNED16", "value", "", 2e-4, "N m s/rad", 0.1),
        MeasuredRow(INTEGRAL, 0x60F9, 2, "UNSIGNED16", "time", GAIN, 5e-5, "s", 0.1),
    ]
    made = with_measured(load_family("cia402"), 0x999, 1, rows, "on a bench", None)
    assert made.is_for(0x999, 1) and made.cells[INTEGRAL].source == "measured"
    K_p = made.cells[GAIN].decode((500).to_bytes(2, "little"), {})
    assert K_p == pytest.approx(0.1)
    assert made.cells[INTEGRAL].decode((2000).to_bytes(2, "little"), {GAIN: K_p}) == pytest.approx(K_p / 0.1)
    alone = with_measured(load_family("cia402"), 0x999, 1, rows[1:], "on a bench", None)
    assert INTEGRAL not in alone.cells and f"needs {GAIN}" in alone.sources["measured"]
    assert "in the map, measured is" in replace(rows[0], scale=4e-4).against(made.cells[GAIN])
    assert replace(rows[0], scale=2.1e-4).against(made.cells[GAIN]) == ""
    assert "form" in replace(rows[1], form="rate").against(made.cells[INTEGRAL])


def test_refused_before_anything_is_written(tool: Tool, tmp_path: Path) -> None:
    bench = Bench(tmp_path, (0x1010, 1, "U32", "rw", "2"))
    with bench.holder:
        code, _, said = bench.learn(tool)
        assert code == 5 and "stores parameters by itself" in said
    (tmp_path / "other").mkdir()
    bench = Bench(tmp_path / "other")
    with bench.holder:
        for arguments, why in ((("--shaft", "coupled"), "free shaft"), (("--load", "gravity"), "falls")):
            code, _, said = bench.learn(tool, *arguments)
            assert code == 5 and (why in said or "free shaft" in said)
        code, _, said = bench.learn(tool, yes=False)
        assert code == 7 and "is changed while the voltage is off" in said
        assert not any_left()


@pytest.mark.chain
def test_killed_with_a_changed_gain_the_next_connection_restores(
    bench: Bench, tool: Tool, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = bench.counts()
    change = GuardedDrive.change

    def cut(self: GuardedDrive, item: Any, data: bytes) -> None:
        change(self, item, data)
        connection: Connection = self._node.connection
        monkeypatch.setattr(connection.bus, "_pulled", True)
        raise KeyboardInterrupt

    loop = SpeedLoop(40.0, 200.0, 2e-3, 1e-3, 0.02)
    monkeypatch.setattr(learn_gains, "fit_speed_loop", lambda *arguments, **options: loop)
    monkeypatch.setattr(learn_gains, "LEAST_S", 0.6)
    monkeypatch.setattr(learn_gains, "SETTLE_S", 0.2)
    monkeypatch.setattr(learn_gains, "TRIES", 1)
    monkeypatch.setattr(GuardedDrive, "change", cut)
    code, _, said = bench.learn(tool)
    assert code != 0 and bench.counts() != before and any_left()
    assert "gains in 0x60F9:01, 0x60F9:02 may be changed: the next `pmsmtool` command" in said
    bench.holder.wait(1.0)
    code, _, said = tool("--sim", bench.channel, "info")
    assert "restored" in said and bench.counts() == before and not any_left()


@pytest.mark.chain
def test_a_run_that_ends_with_an_error_leaves_no_journal_and_no_fit_was_made_under_voltage(
    bench: Bench, tool: Tool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gains were back, and the journal refused every later command once the drive was set up anew (exit code 5).

    On the wall clock the heartbeat stayed away during a fit, and the drive left operation at the first (exit 4).
    """
    before, change, begin = bench.counts(), GuardedDrive.change, GuardedDrive.begin
    guards: list[GuardedDrive] = []
    energised: list[bool] = []

    def noted(self: GuardedDrive, **how: Any) -> None:
        guards.append(self)
        begin(self, **how)

    def fit(*arguments: Any, **options: Any) -> SpeedLoop:
        energised.append(guards[0]._drive.may_be_energised)
        return SpeedLoop(40.0, 200.0, 2e-3, 1e-3, 0.02)

    def fails(self: GuardedDrive, item: Any, data: bytes) -> None:
        change(self, item, data)
        raise DriveFault("the drive left operation during a measurement")

    monkeypatch.setattr(GuardedDrive, "begin", noted)
    monkeypatch.setattr(learn_gains, "fit_speed_loop", fit)
    monkeypatch.setattr(learn_gains, "LEAST_S", 0.6)
    monkeypatch.setattr(learn_gains, "SETTLE_S", 0.2)
    monkeypatch.setattr(learn_gains, "TRIES", 1)
    monkeypatch.setattr(GuardedDrive, "change", fails)
    code, _, said = bench.learn(tool)
    assert code == 4 and "left operation" in said and bench.counts() == before and not any_left()
    assert energised and not any(energised)


@pytest.mark.chain
def test_a_limit_that_stops_the_move_is_exit_code_5_and_the_table_is_told(
    tool: Tool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was a reason in the table, and exit code 10 (`interface.md`: 5)."""
    bench = Bench(tmp_path, *POSITION_ROWS, modes=0x101)
    one = learn_gains.Observation(1.0, 1.0, SpeedLoop(40.0, 200.0, 2e-3, 1e-3, 0.02))
    loop = learn_gains.LearnedLoop((one, one), None, (), 1e-3, ())
    monkeypatch.setattr(learn_gains, "learn_speed_loop", lambda *arguments: loop)
    monkeypatch.setattr(learn_position_gain, "TRAVEL", 0.1)
    with bench.holder:
        code, printed, said = bench.learn(tool, GAIN, INTEGRAL, "position.K_p_per_s=0x60FB:01")
        assert code == 5 and "travel" in said and not any_left()
    assert "position.K_p_per_s" in printed and "outside the limit" in printed


def test_the_predicted_margin_counts_on_the_integral_part_that_the_loop_asks_for() -> None:
    """At 0.2 of its rated current the response alone showed a K_i 46 % too large: 35 degrees."""
    response = SpeedLoop(107.6, 6490.0, 3.73e-3, 1e-3, 0.02)
    asked = AskedLoop(replace(response, K_p_per_J=107.0, K_i_per_J=4753.0, lag_s=2e-3), (0.02, 0.02, 0.02))
    own = Observation(7174.0, 251.0, response, asked=asked)
    margin = learn_gains._margin(own, (1.0, 1.0 / learn_gains.LITTLE_DOWN))
    assert margin == pytest.approx(math.radians(42.0), abs=MARGIN_TOL_RAD) and margin > learn_gains.LEAST_MARGIN_RAD
    alone = learn_gains._margin(replace(own, asked=None), (1.0, 1.0 / learn_gains.LITTLE_DOWN))
    assert alone == pytest.approx(math.radians(35.0), abs=MARGIN_TOL_RAD)


@pytest.mark.parametrize(
    ("asks", "at_bound", "decided", "lost"),
    [
        (True, "", True, False),
        (True, "", False, False),
        (True, "", False, True),
        (False, "", False, False),
        (False, "lag", False, False),
    ],
)
def test_records_are_long_where_short_ones_do_not_decide_and_nothing_is_changed_on_a_fit_at_a_bound(
    asks: bool, at_bound: str, decided: bool, lost: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """120 s under voltage for a Nanotec PD4-C, where half of them did."""
    lasted: list[bool] = []
    pulses: list[float] = []
    put: list[object] = []
    loop = SpeedLoop(40.0, 200.0, 2e-3, 1e-3, 0.02, at_bound=at_bound)

    def observe(self: Any, what: str, step: float, counts: Any, *known: Any) -> Observation:
        lasted.append(self.long)
        self.asks = asks
        shown = asks and not (lost and "half" in what)
        return Observation(
            counts[GAIN], counts[INTEGRAL], loop, asked=AskedLoop(loop, (0.0, 0.0, 0.0)) if shown else None
        )

    monkeypatch.setattr(learn_gains, "find_speed_unit", lambda *arguments: 1e-3)
    monkeypatch.setattr(learn_gains._Learner, "_observe", observe)
    monkeypatch.setattr(learn_gains._Learner, "_size", lambda self, step: 1.0)
    monkeypatch.setattr(learn_gains._Learner, "_show_current_loop", lambda self, step: pulses.append(step))
    guard, drive = MagicMock(envelope=Envelope(6.0, 50.0)), MagicMock(current_count_a=0.01)
    drive.oscillation.largest_a = 1.0
    learner = learn_gains._Learner(guard, drive, lambda *arguments: put.append(arguments), Emf(0.0, 100.0), print)
    gain, integral = DriveObject(0x60F9, 1, "H"), DriveObject(0x60F9, 2, "H")
    measured = learner.run(
        changed_gains.GainObject(GAIN, gain, 1000.0), changed_gains.GainObject(INTEGRAL, integral, 1000.0),
        lambda measured: decided,
    )  # fmt: skip
    assert lasted[:3] == [False, *(not asks,) * 2] and not lasted[0]
    assert lasted.count(True) == (lasted.count(False) - 1 if asks and not decided else 0 if asks else len(lasted) - 1)
    assert bool(pulses) != asks and measured.by_asked == (asks and not lost)
    assert len(set(measured.notes)) == len(measured.notes), "of the record that did not decide"
    assert bool(put) != bool(at_bound)
    if at_bound:
        assert measured.gain_changed is None and not measured.integral_changed
        assert any("bound of the loop's lag" in note for note in measured.notes)


@pytest.mark.parametrize("limited", [True, False])
def test_what_runs_away_is_off_before_1_3_of_the_speed_limit(monkeypatch: pytest.MonkeyPatch, limited: bool) -> None:
    """A free rotor of a data sheet had 3 % of its current at 0.4 of its speed, on a drive without a speed limit."""
    for module in (learn_gains, learn_position_gain):
        monkeypatch.setattr(module, "limits_speed", lambda node: limited)
    source = load_machine_file("interior-2k2")
    light = replace(source, machine=replace(source.machine, J_kgm2=1e-4))
    drive = MagicMock(rated_apk=6.0, shows_apk=6.0)
    made = learn_gains.learning_envelope(drive, light, None, None, "free", "none", "none")
    top = rad_s_from_rpm(light.machine.top_rpm or 0.0)
    emf = light.inverter.U_dc_v / math.sqrt(3.0) / (light.machine.pole_pairs * light.machine.psi_f_wb)
    assert emf < top and made.speed_max_rad_s == pytest.approx(0.4 * top if limited else 0.8 * emf)
    gained = (made.acceleration_rad_s2 or 0.0) * learn_gains.SEEN_S
    ends = learn_gains.trip_share(drive.node) * made.speed_max_rad_s
    assert (made.i_max_apk == 6.0) == limited
    assert limited or 1.1 < (ends + gained) / made.speed_max_rad_s <= 1.3, "reluctance torque: less than in proportion"
    slow = replace(light, machine=replace(light.machine, n_max_rpm=500.0))
    assert learn_gains.largest_speed(drive.node, slow) == pytest.approx(rad_s_from_rpm(200.0 if limited else 400.0))


def test_an_oscillation_trips() -> None:
    watched = Oscillation()
    for k in range(40):
        watched.take(0.1 * (-1) ** k)
    watched.limit_a = 3.0 * watched.largest_a
    watched.begin()
    for k in range(20):
        watched.take(0.29 * (-1) ** k)
    watched.check("node 1")
    for k in range(20):
        watched.take(0.4 * (-1) ** k)
    with pytest.raises(LimitExceeded, match="oscillation"):
        watched.check("node 1")


def test_a_gain_is_changed_only_while_the_voltage_is_off(bench: Bench) -> None:
    before = bench.counts()
    with connect("pmsmsim", bench.channel) as connection:
        drive = SpeedLoopDrive(connection, 1, drive_map=load_family("cia402"))
        gain = changed_gains.gain_object(drive.node, GAIN, *bench.drawn.gain)
        data = gain.item.encode(gain.counts - 100)
        with guarded(drive, Envelope(6.0, 50.0)) as guard:
            guard.enable()
            with pytest.raises(SafetyRefusal, match="only while the voltage is off"):
                guard.change(gain.item, data)
            assert bench.counts() == before
            guard.stop()
            guard.change(gain.item, data)
            assert bench.counts() == (before[0] - 100, before[1])
        assert bench.counts() == before
        drive.close()


def test_torque_pulses_that_contradict_the_motor_file_are_told() -> None:
    """The assumed share of the EMF was kept without a word."""
    t = np.arange(0.0, 1.0, 1e-3)
    still = Trace(t, {"i_q_a": np.full(t.size, 0.1)}, {"i_q_a": "A"}, {"steps": [(0.0, 10.0), (0.5, 50.0)]})
    done: list[str] = []
    learner: Any = object.__new__(learn_gains._Learner)
    learner.guard = SimpleNamespace(
        limit_current=lambda limit_a: limit_a, quick_stop=lambda: done.append("off"), enable=lambda: done.append("on")
    )
    learner.drive, learner.emf, learner.notes = SimpleNamespace(current_count_a=0.01), Emf(0.01, 100.0, 0.007), []
    learner.low, learner.span, learner.bandwidth, learner.settle_s = 10.0, 100.0, 20.0, 0.1
    learner.step_current_a, learner._taken = (0.1, 1.0), lambda speeds: still
    learner._show_current_loop(1.0)
    assert learner.emf == Emf(0.01, 100.0, 0.007) and done == ["off", "on"]
    assert ["torque pulses at 1 A" in note for note in learner.notes] == [True]
