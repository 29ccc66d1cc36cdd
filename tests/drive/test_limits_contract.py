# SPDX-License-Identifier: MIT
"""One contract for every drive class: each limit stops the machine in its time, restores the drive, and is named.

What the drive shows is set behind the tool's back, so that the same excess can be shown to every class, and so that a
limit is met from both sides: just below it nothing happens, just above it the machine is off.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import can
import pytest

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.connection import Connection
from pmsmtool.cia402 import AbortConnection, QuickStop, State
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.dead_man import CONSUMER_MS, REACTION_S
from pmsmtool.drive.envelope import OFF_S, Envelope, largest_acceleration, voltage_speed
from pmsmtool.drive.guard import FRESH_S, LOCKED_TRAVEL_RAD, OVERSHOOT, WATCH_S, GuardedDrive, guarded
from pmsmtool.drive.heartbeat import PERIOD_S
from pmsmtool.drive.port import Drive
from pmsmtool.drive.position_drive import PositionDrive
from pmsmtool.drive.recorder_drives import MappedRecorderDrive, RecordedMeans
from pmsmtool.drive.speed_loop_drive import SpeedLoopDrive
from pmsmtool.drive.standard_drive import RecorderDrive, StandardDrive
from pmsmtool.drive.torque_drives import SpeedPushDrive, TorqueDrive
from pmsmtool.drive.vendor_tuning import VendorDrive
from pmsmtool.drive_maps.drive_map_file import parse_drive_map
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import (
    DriveFault,
    Interrupted,
    LimitExceeded,
    NotAvailable,
    PmsmtoolError,
    SafetyRefusal,
    StopNotConfirmed,
)
from pmsmtool.experiments.mechanics_run import acceleration_per_ampere
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import InverterParameters, MachineParameters
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.node.dictionary import Entry, Refused
from pmsmtool.sim.node.session import Session
from tests.drive.bench import COMMANDS
from tests.foreign.data_sheets import CIA402, Row, faulhaber, write_eds
from tests.measurement.test_mapped_recorder import completed

ENVELOPE = Envelope(i_max_apk=3.0, speed_max_rad_s=100.0)

STOP_S = 0.1
"""From the look that sees the excess to the voltage being off; measured 12 to 43 ms."""
WITHIN, BEYOND = 0.96, 1.04
"""Of a limit: below it nothing may happen, above it the machine must be stopped."""
POLE_PAIRS = 3
CREEP_S = 0.02
LEFT = "left operation|heartbeat of the master"
"""How a drive that has stopped by itself is named."""
EXCLUDED = {*COMMANDS, "cia402.statusword"}
MA_RMS = 1e-3 * math.sqrt(2.0)
"""A peak."""


@dataclass(frozen=True)
class DriveClass:
    """How a drive of one class is opened, and by which objects the tool watches it.

    ``rated_apk``: of a count of ``rated``; ``shown``: current and A peak of its count, by default permille of rated.
    """

    channel: str
    open: Callable[[Connection], CanopenDrive]
    standard: bool = False
    map_text: str = ""
    rows: tuple[Row, ...] = ()
    rated: tuple[int, int] = (0x6075, 0)
    rated_apk: float = MA_RMS
    shown: tuple[int, int, float] | None = None
    limits: tuple[tuple[int, int], ...] = ((0x6073, 0), (0x6080, 0))


def _family(family: str, kind: type[CanopenDrive]) -> DriveClass:
    return DriveClass(f"&drive={family}", lambda bus: kind(bus, 1, drive_map=load_family(family)), standard=True)


def _written(text: str, kind: type[CanopenDrive]) -> DriveClass:
    drive_map = parse_drive_map(text)
    return DriveClass("", lambda bus: kind(bus, 1, drive_map=drive_map), True, text)


def _sheet(rows: tuple[Row, ...], open_drive: Callable[[Connection], CanopenDrive]) -> DriveClass:
    return DriveClass("", open_drive, True, rows=rows)


def _speed_push() -> DriveClass:
    """No torque mode, no 0x6075: currents in mA, and no speed limit of its own."""
    more: tuple[Row, ...] = (
        (0x6007, 0, "I16", "rw", "1"), (0x605A, 0, "I16", "rw", "2"), (0x605E, 0, "I16", "rw", "2"),
        (0x608F, 2, "U32", "ro", "1"),
    )  # fmt: skip
    kind = _sheet((*faulhaber(), *more), lambda bus: SpeedPushDrive(bus, 1, drive_map=load_family("faulhaber")))
    return replace(kind, rated=(0x2333, 1), limits=((0x2333, 2),), shown=(0x6078, 0, MA_RMS))


def _inject(connection: Connection) -> CanopenDrive:
    drive = CanopenDrive(connection, 1)
    drive.recorder = RecordedMeans(drive.node, drive.period_s)
    return drive


CLASSES = {
    "full": DriveClass("", lambda bus: CanopenDrive(bus, 1)),
    "inject": DriveClass("&level=inject", _inject),
    "recorder": DriveClass("&level=recorder", lambda bus: RecorderDrive(bus, 1)),
    "standard": _family("cia402", StandardDrive),
    "torque": replace(
        _family("epos4", TorqueDrive), rated=(0x3001, 1), limits=((0x3001, 2), (0x6080, 0)), shown=(0x30D1, 2, MA_RMS)
    ),
    "mapped-rows": replace(
        _written(completed(), MappedRecorderDrive),
        rated=(0x2111, 0),
        rated_apk=0.01,
        limits=((0x2110, 0),),
        shown=(0x221C, 0, 0.01),
    ),
    "mapped-index": _family("ingenia", MappedRecorderDrive),
    "vendor-os-command": _family("synapticon", VendorDrive),
    "position": _sheet(CIA402, lambda bus: PositionDrive(bus, 1, drive_map=load_family("cia402"))),
    "speed-loop": _family("cia402", SpeedLoopDrive),
    "speed-push": _speed_push(),
}
"""Every class that is energised, with the recorders of the makers behind it."""


class Rig:
    """A drive of a class, behind the tool's back as well."""

    def __init__(self, kind: DriveClass, drive: CanopenDrive, session: Session, sign: float) -> None:
        self.kind, self.drive, self.session, self.sign = kind, drive, session, sign
        self.clock = drive.node.connection.clock
        self.off_since: float | None = None
        self.states: list[State] = []
        self._angle: float | None = None
        session.power.on_state = self._changed

    def _changed(self) -> None:
        self.states.append(self.session.power.state)
        if not self.session.power.state.energised:
            self.off_since = self.off_since if self.off_since is not None else self.clock.now()
        else:
            self.off_since = None

    @property
    def energised(self) -> bool:
        return self.session.power.state.energised

    @property
    def rated_apk(self) -> float:
        return self.kind.rated_apk * self.session.dictionary.find(*self.kind.rated).number()

    @property
    def counts_per_turn(self) -> float:
        if not self.held(0x608F):  # the maker's own object holds them
            return self.session.dictionary["cia402.encoder_counts"].number()
        return self.session.dictionary.find(0x608F, 1).number() / self.session.dictionary.find(0x608F, 2).number()

    def held(self, *indices: int) -> list[Entry]:
        """Those of the objects that the drive has."""
        found = {e.row.index: e for e in self.session.dictionary if e.row.sub == 0}
        return [found[index] for index in indices if index in found]

    def memory(self) -> dict[tuple[int, int], bytes]:
        rows = ((entry.row.index, entry.row.sub, entry) for entry in self.session.dictionary)
        return {(i, s): e.read() for i, s, e in rows if "w" in e.row.access and e.row.key not in EXCLUDED}

    def _show(self, index: int, sub: int, value: Callable[[], float]) -> None:
        entry = self.session.dictionary.find(index, sub)
        entry.source = lambda: entry.encode(value())

    def show_current(self, ampere: float) -> None:
        """Show a current vector of a length (A peak)."""
        if self.kind.standard:
            index, sub, apk = self.kind.shown or (0x6078, 0, 1e-3 * self.rated_apk)
            self._show(index, sub, lambda: round(-ampere / apk))
            return
        self._show(0x2070, 1, lambda: -0.6 * ampere)
        self._show(0x2070, 2, lambda: 0.8 * ampere)

    def show_turning(self, rad_s: float) -> None:
        """Show a shaft that turns from now on (rad/s, mechanical)."""
        began, at = self.clock.now(), self.drive.live("theta_m_rad")
        self._show_angle(lambda: at + rad_s * (self.clock.now() - began))
        if not self.kind.standard:
            self._show(0x2070, 7, lambda: POLE_PAIRS * rad_s)

    def set_angle(self, rad: float) -> None:
        """Show a shaft that stands at an angle (rad), before anything is enabled."""
        self._show_angle(lambda: rad)
        self.drive.live("theta_m_rad")
        self._angle = rad

    def show_angle(self, rad: float) -> None:
        """Show a shaft that creeps to an angle (rad): no speed of its own counts."""
        began, at = self.clock.now(), self.drive.live("theta_m_rad") if self._angle is None else self._angle
        self._angle = rad
        self._show_angle(lambda: at + (rad - at) * min(1.0, (self.clock.now() - began) / CREEP_S))

    def _show_angle(self, angle: Callable[[], float]) -> None:
        if isinstance(self.drive, StandardDrive):
            per_rad = self.counts_per_turn / (2.0 * math.pi)
            self._show(0x6064, 0, lambda: (round(angle() * per_rad) + 2**31) % 2**32 - 2**31)
        else:
            self._show(0x2070, 0x14, angle)


@contextmanager
def opened(name: str, folder: Path) -> Iterator[Rig]:
    kind = CLASSES[name]
    channel = f"interior-2k2?nv=:memory:&seed=7{kind.channel}"
    if kind.map_text:
        path = folder / "map.toml"
        path.write_text(kind.map_text, encoding="utf-8")
        channel += f"&drive={path}"
    if kind.rows:
        channel += f"&eds={write_eds(folder / 'drive.eds', kind.rows)}"
    with Connection(PmsmSimBus(channel)) as connection:
        drive = kind.open(connection)
        sign = (-1.0) ** [*CLASSES].index(name)  # the way a shaft turns: every second class the other one
        rig = Rig(kind, drive, connection.bus.line.nodes[0].session, sign)  # type: ignore[attr-defined]
        if not kind.standard:
            drive.write({"motor.pole_pairs": POLE_PAIRS, "motor.R_s_ohm": 3.6})
        yield rig
        drive.close()


@pytest.fixture(params=CLASSES)
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    with opened(request.param, tmp_path) as opened_rig:
        yield opened_rig


Provoke = Callable[[GuardedDrive], None]


def stopped(
    rig: Rig, envelope: Envelope, provoke: Provoke, named: str, within_s: float, *,
    allowed: Provoke | None = None, error: type[BaseException] = LimitExceeded,
) -> BaseException:  # fmt: skip
    """Show what is allowed, which ends nothing, then too much: off in time, every object restored, the limit named."""
    before = rig.memory()
    with pytest.raises(error, match=named) as caught, guarded(rig.drive, envelope) as guard:
        guard.enable()
        guard.wait(WATCH_S)
        if allowed is not None:
            allowed(guard)
            guard.wait(6.0 * WATCH_S)
        assert rig.energised, "the machine is enabled before anything is exceeded"
        assert rig.memory() != before, "there is something to restore"
        began = rig.clock.now()
        provoke(guard)
        guard.wait(5.0)
    assert not rig.energised and rig.off_since is not None
    assert 0.0 <= rig.off_since - began <= within_s
    assert [key for key, data in rig.memory().items() if data != before[key]] == []
    if isinstance(caught.value, LimitExceeded):
        assert caught.value.where == "node 1" and caught.value.exit_code == 5 and caught.value.hint
    return caught.value


def test_over_speed(rig: Rig) -> None:
    limit = rig.sign * (OVERSHOOT if len(rig.kind.limits) > 1 else 1.0) * ENVELOPE.speed_max_rad_s
    stopped(
        rig, ENVELOPE, lambda guard: rig.show_turning(BEYOND * limit), "speed", 2 * WATCH_S + STOP_S,
        allowed=lambda guard: rig.show_turning(WITHIN * limit),
    )  # fmt: skip


def test_travel(rig: Rig) -> None:
    envelope, at = replace(ENVELOPE, travel_rad=0.5), rig.drive.live("theta_m_rad")
    stopped(
        rig, envelope, lambda guard: rig.show_angle(at + rig.sign * BEYOND * 0.5), "travel", WATCH_S + STOP_S,
        allowed=lambda guard: rig.show_angle(at + rig.sign * WITHIN * 0.5),
    )  # fmt: skip


def test_a_position_that_wraps_is_no_motion(rig: Rig) -> None:
    """The counter of 32 bits goes from its largest number to its smallest; beyond the limit it counts as ever."""
    sign = rig.sign
    edge = sign * (2.0**31 / rig.counts_per_turn * 2.0 * math.pi if rig.kind.standard else 100.0)  # a float never wraps
    rig.set_angle(edge - sign * 0.1)
    stopped(
        rig, replace(ENVELOPE, travel_rad=0.5), lambda guard: rig.show_angle(edge + sign * 0.45), "travel",
        WATCH_S + STOP_S, allowed=lambda guard: rig.show_angle(edge + sign * 0.3),
    )  # fmt: skip


def test_a_locked_shaft_that_turns(rig: Rig) -> None:
    at = rig.drive.live("theta_m_rad")
    error = stopped(
        rig, replace(ENVELOPE, shaft="locked"), lambda guard: rig.show_angle(at + BEYOND * LOCKED_TRAVEL_RAD),
        "travel", WATCH_S + STOP_S, allowed=lambda guard: rig.show_angle(at + WITHIN * LOCKED_TRAVEL_RAD),
    )  # fmt: skip
    assert isinstance(error, PmsmtoolError) and "--shaft locked is given" in error.likely


def test_over_current(rig: Rig) -> None:
    limit = OVERSHOOT * ENVELOPE.i_max_apk
    stopped(
        rig, ENVELOPE, lambda guard: rig.show_current(BEYOND * limit), "current", WATCH_S + STOP_S,
        allowed=lambda guard: rig.show_current(WITHIN * limit),
    )  # fmt: skip


def test_an_experiment_that_swallows_the_excess_goes_on_without_voltage(rig: Rig) -> None:
    with guarded(rig.drive, ENVELOPE) as guard:
        guard.enable()
        rig.show_current(2.0 * ENVELOPE.i_max_apk)
        with pytest.raises(LimitExceeded):
            guard.wait(1.0)
        assert not rig.energised


def test_energised_too_long(rig: Rig) -> None:
    """By the clock, also where the time passes in transfers rather than in the guard's own waiting."""
    envelope = replace(ENVELOPE, duration_s=1.0)

    def transfer(guard: GuardedDrive) -> None:
        until = rig.clock.now() + 1.2 - guard.energised_s
        while rig.clock.now() < until:
            rig.drive.node.connection.wait(0.03)
            rig.drive.node.state()
        assert rig.energised

    stopped(rig, envelope, transfer, "time energised", 1.2 + WATCH_S + STOP_S)


def test_a_current_limit_that_limits_nothing_is_refused(rig: Rig) -> None:
    """30 times the rated current is the most that counts as a limit, whatever motor the drive still holds."""
    before = rig.memory()
    for i_max_apk in (1e5, math.inf, math.nan):
        with pytest.raises(SafetyRefusal, match="is none: the drive is rated") as caught, \
                guarded(rig.drive, replace(ENVELOPE, i_max_apk=i_max_apk)):  # fmt: skip
            pass
        assert rig.off_since is None, "it was never enabled"
        assert rig.memory() == before
        assert caught.value.where and caught.value.likely and caught.value.hint
    with guarded(rig.drive, replace(ENVELOPE, i_max_apk=min(29.9 * rig.rated_apk, rig.drive.shows_apk))):
        pass


def test_energy(rig: Rig) -> None:
    """1.5 R i^2: 48.6 W at 3 A and 3.6 ohm, which spend 25 J in 0.51 s. Without a resistance the limit is refused."""
    envelope, R_s_ohm = replace(ENVELOPE, energy_j=25.0), rig.drive.read("motor.R_s_ohm")
    if R_s_ohm == 0.0:
        with pytest.raises(SafetyRefusal, match="energy limit 25 J cannot be watched"), guarded(rig.drive, envelope):
            pass
        assert rig.off_since is None, "it was never enabled"
        return
    seconds = 25.0 / (1.5 * R_s_ohm * 9.0)
    begun = []

    def flow(guard: GuardedDrive) -> None:
        rig.show_current(3.0)
        begun.append(rig.clock.now())

    stopped(rig, envelope, flow, "energy", seconds + 2 * WATCH_S + STOP_S)
    assert rig.off_since is not None and rig.off_since - begun[0] > seconds - 2 * WATCH_S


def test_commands_beyond_the_limits_are_not_sent(rig: Rig) -> None:
    with guarded(rig.drive, ENVELOPE) as guard:
        guard.enable()
        for current in ((0.0, 3.01), (0.0, -3.01), (-2.2, 2.2), (0.0, math.nan)):
            with pytest.raises(LimitExceeded, match="current"):
                guard.command_current(*current)
        for speed in (100.1, -100.1, math.nan):
            with pytest.raises(LimitExceeded, match="speed"):
                guard.command_speed(speed)
        assert rig.energised


def test_a_lost_heartbeat(rig: Rig) -> None:
    """The tool's heartbeat ends: the drive itself leaves operation, and the guard's next look says so."""
    declared = 1e-3 * CONSUMER_MS + REACTION_S
    stopped(rig, ENVELOPE, lambda guard: guard._heartbeat.stop(), LEFT, declared, error=DriveFault)


HUNG_S = OFF_S
"""From the last look of a tool that hangs to the voltage being off, as declared; measured 0.30 to 0.36 s."""


def test_a_main_thread_that_hangs_in_a_driver_call(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The adapter's driver does not return from a request; the heartbeat's own thread must not keep the machine on."""
    bus = rig.drive.node.connection.bus
    send, hung = bus.send, list[bool]()

    def hang(guard: GuardedDrive) -> None:
        def blocked(message: can.Message, timeout: float | None = None) -> None:
            if message.arbitration_id == 0x601 and not hung:
                hung.append(True)
                rig.clock.wait(2.0)
            send(message, timeout)

        monkeypatch.setattr(bus, "send", blocked)

    stopped(rig, ENVELOPE, hang, LEFT, WATCH_S + HUNG_S, error=DriveFault)
    assert hung


def test_a_guard_that_hangs(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The look at the machine does not come back."""
    live, hung = rig.drive.live, list[bool]()

    def slow(name: str) -> float:
        if not hung:
            hung.append(True)
            rig.clock.wait(2.0)
        return live(name)

    stopped(
        rig, ENVELOPE, lambda guard: monkeypatch.setattr(rig.drive, "live", slow), LEFT, WATCH_S + HUNG_S,
        error=DriveFault,
    )  # fmt: skip
    assert hung


def test_an_experiment_that_does_not_let_the_guard_look(rig: Rig) -> None:
    """The main thread computes: the bus is idle, nobody watches the machine."""
    stopped(rig, ENVELOPE, lambda guard: rig.clock.wait(2.0), LEFT, HUNG_S, error=DriveFault)


def test_an_exception(rig: Rig) -> None:
    def fail(guard: GuardedDrive) -> None:
        raise ZeroDivisionError("of the experiment")

    stopped(rig, ENVELOPE, fail, "of the experiment", STOP_S, error=ZeroDivisionError)


def test_ctrl_c(rig: Rig) -> None:
    def interrupt(guard: GuardedDrive) -> None:
        rig.clock.after(0.02, lambda: signal.raise_signal(signal.SIGINT))  # type: ignore[attr-defined]

    stopped(rig, ENVELOPE, interrupt, "voltage off, and the drive restored", 0.02 + STOP_S, error=Interrupted)


@pytest.mark.parametrize("which", [0, 1])
def test_a_limit_that_the_drive_does_not_hold_is_refused(rig: Rig, which: int) -> None:
    """Current and speed limit are written into the drive and read back."""
    if which >= len(rig.kind.limits):
        pytest.skip("the drive has no speed limit: this program looks, and removes the voltage")
    index, sub = rig.kind.limits[which]
    rig.session.dictionary.find(index, sub).sink = lambda data: None
    with pytest.raises(SafetyRefusal, match=f"0x{index:04X}:{sub:02X}") as caught, guarded(rig.drive, ENVELOPE):
        pass
    assert "holds the limit" in caught.value.what and rig.off_since is None


def test_a_drive_that_changes_its_mode_once_it_is_enabled_is_off_again(rig: Rig) -> None:
    """An option of some drives: what 0x6060 asks for holds until the enable input does more."""
    if isinstance(rig.drive, VendorDrive):
        pytest.skip("its own mode, which its identification leaves by itself")
    before, shown = rig.memory(), rig.session.dictionary.find(0x6061, 0)
    mode, power = rig.session.dictionary.find(0x6060, 0), rig.session.power
    shown.source = lambda: shown.encode(6) if power.state is State.OPERATION_ENABLED else mode.read()
    named = r"once enabled, the drive changes to mode of operation.*\(6\)"
    with pytest.raises(NotAvailable, match=named) as caught, guarded(rig.drive, ENVELOPE) as guard:
        guard.enable()
    assert not rig.energised and rig.memory() == before and caught.value.where == "node 1, 0x6061:00"


def test_a_supervision_that_only_reports_is_refused(rig: Rig) -> None:
    """An emergency message and the state as it was: no stop."""
    power = rig.session.power
    power.connection_lost = lambda node: power._emergency.raise_error(0x8130, bytes((node,)))  # type: ignore[method-assign]
    with pytest.raises(SafetyRefusal, match="still enabled 350 ms after"), guarded(rig.drive, ENVELOPE):
        pass
    assert not rig.energised


def test_the_time_that_is_declared_is_that_of_its_parts() -> None:
    assert pytest.approx(FRESH_S + PERIOD_S + 1e-3 * CONSUMER_MS + REACTION_S) == OFF_S


def test_the_envelope_says_what_a_failure_adds_in_speed() -> None:
    """1.5 x 3 x 0.5 Wb x 4 A = 9 Nm on 0.8 x 0.01 kg m2: 1125 rad/s2, in 0.5 s 5370 rpm; a salient machine more."""
    machine = MachineParameters(3, 1.0, 0.01, 0.01, 0.5, J_kgm2=0.01)
    acceleration = largest_acceleration(machine, 4.0)
    assert acceleration == pytest.approx(1125.0)
    line = replace(ENVELOPE, acceleration_rad_s2=acceleration).lines()[5]
    assert "voltage off after 0.5 s" in line and "adds up to 5370 rpm" in line
    salient = largest_acceleration(replace(machine, L_q_h=0.05), 4.0)
    assert salient == pytest.approx(1176.7, rel=1e-3), "its reluctance torque at some 20 degrees"
    assert largest_acceleration(replace(machine, J_kgm2=None), 4.0) is None
    assert "not known (no inertia is given)" in ENVELOPE.lines()[5]


def test_the_voltage_ends_what_a_failure_adds_in_speed() -> None:
    """48 V, 11.51 mWb, 0.1875 mH, 4 pole pairs, 1.414 A: 1.1 x 48 x 2/pi over 4 (0.8 psi - 1.3 L I) is 948 rad/s."""
    machine = MachineParameters(4, 0.2069, 0.1875e-3, 0.1875e-3, 11.51e-3, J_kgm2=3e-5)
    known = MachineFile("light", machine, InverterParameters(U_dc_v=48.0, f_s_hz=25e3))
    speed = voltage_speed(known, 1.414)
    assert speed == pytest.approx(33.614 / (4.0 * (9.208e-3 - 0.3447e-3)), rel=1e-3)
    light = replace(ENVELOPE, acceleration_rad_s2=24_000.0, voltage_speed_rad_s=speed)
    assert light.lines()[5].endswith("until then full torque may reach 9050 rpm, where the voltage limits it")
    assert "adds up to" in replace(light, acceleration_rad_s2=10.0).lines()[5]
    fast = replace(light, speed_max_rad_s=2.0 * speed)
    assert "may reach 18100 rpm" in fast.lines()[5], "a shaft that is allowed more is not stopped by its voltage"
    assert math.isinf(voltage_speed(known, 100.0)), "this current weakens the whole flux"


def test_the_first_torque_pulse_is_small_and_short() -> None:
    """Inertia unknown: at most 5 % of the current for 20 ms, whatever the shaft then does."""
    asked: list[tuple[float, float]] = []
    current = [0.0]

    class Light:
        def live(self, name: str) -> float:
            return 1.0 * len(asked)

        def command_current(self, i_d_a: float, i_q_a: float) -> None:
            current[0] = i_q_a

        def wait(self, seconds: float) -> None:
            asked.append((current[0], seconds))

    acceleration_per_ampere(cast(Drive, Light()), 10.0, lambda way, seconds: True)
    assert asked[0][0] > 0.0
    assert all(abs(current) <= 0.5 and (seconds <= 0.02 or not current) for current, seconds in asked)


# ---- how it stops --------------------------------------------------------------------------------


def test_until_the_speed_loop_is_proven_a_stop_removes_the_voltage(rig: Rig) -> None:
    """No ramp, which would run a speed loop: 0x605A = 0 and 0x6007 = 2 meanwhile, and no quick stop is active."""
    options = rig.held(0x605A, 0x6007)
    before = [6, 1][: len(options)]
    for entry, value in zip(options, before, strict=True):
        entry.value = entry.encode(value)  # as on an EPOS4; a fault when the connection is lost
    seen: list[float] = []

    def fail(guard: GuardedDrive) -> None:
        seen.extend(entry.number() for entry in options)
        raise ZeroDivisionError("of the experiment")

    stopped(rig, ENVELOPE, fail, "of the experiment", STOP_S, error=ZeroDivisionError)
    assert seen == [QuickStop.DISABLE, AbortConnection.DISABLE_VOLTAGE][: len(options)]
    assert State.QUICK_STOP_ACTIVE not in rig.states
    assert [entry.number() for entry in options] == before


def test_a_drive_that_keeps_its_option_codes_is_stopped_without_a_ramp_too(rig: Rig) -> None:
    def refused(data: bytes) -> None:
        raise Refused(AbortCode.VALUE)

    for entry in rig.held(0x605A, 0x6007):
        entry.value, entry.sink = entry.encode(2 if entry.row.index == 0x605A else 3), refused

    def fail(guard: GuardedDrive) -> None:
        rig.states.clear()
        raise ZeroDivisionError("of the experiment")

    stopped(rig, ENVELOPE, fail, "of the experiment", STOP_S, error=ZeroDivisionError)
    assert State.QUICK_STOP_ACTIVE not in rig.states


def test_a_supervision_that_leaves_the_voltage_on_is_refused(rig: Rig) -> None:
    """Another state is not enough: quick stop active after which the drive stays energised (0x605A = 6)."""
    options = rig.held(0x605A, 0x6007)
    if rig.kind.rows or len(options) < 2:
        pytest.skip("no quick stop that stays energised: the drive of a data sheet, or a lost master is a fault")
    for entry, value in zip(options, (6, 3), strict=True):
        entry.value, entry.sink = entry.encode(value), lambda data: None
    named = "QUICK STOP ACTIVE, but was still energised, 350 ms"
    with pytest.raises(SafetyRefusal, match=named), guarded(rig.drive, ENVELOPE):
        pass
    assert not rig.energised


@pytest.mark.chain
def test_a_pulled_cable_is_said_above_all(rig: Rig) -> None:
    """Nothing can be confirmed or restored; the drive stops by itself."""
    declared = 1e-3 * CONSUMER_MS + REACTION_S
    with pytest.raises(StopNotConfirmed, match="may be energised"), guarded(rig.drive, ENVELOPE) as guard:
        guard.enable()
        guard.wait(2.0 * WATCH_S)
        rig.drive.node.connection.bus.line.nodes[0].plugged = False  # type: ignore[attr-defined]
        began = rig.clock.now()
        guard.wait(5.0)
    assert rig.off_since is not None and rig.off_since - began <= declared
