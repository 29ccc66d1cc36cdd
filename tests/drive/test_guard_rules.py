# SPDX-License-Identifier: MIT
"""The rules of the guard, one by one, on a drive that shows what it is told to show."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from pmsmtool.cia402 import State
from pmsmtool.drive import guard as guarding
from pmsmtool.drive import objects
from pmsmtool.drive.envelope import Envelope, largest_acceleration
from pmsmtool.drive.guard import GuardedDrive
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.port import Excitation, Injection, ProfileMove, Shape
from pmsmtool.errors import LimitExceeded, SafetyRefusal
from pmsmtool.machine.parameters import MachineParameters

ENVELOPE = Envelope(i_max_apk=4.0, speed_max_rad_s=100.0, i_d_max_apk=3.0)
POLE_PAIRS = 3.0


class Shown:
    """A drive and its node: what it shows, what it was asked, and a clock."""

    def __init__(self) -> None:
        self.t_s, self.active_s = 50.0, -math.inf
        self.values: dict[str, Any] = {"i_d_a": 0.0, "i_q_a": 0.0, "omega_e_rad_s": 0.0, "theta_m_rad": 1.0}
        self.asked: list[Any] = []
        self.may_be_energised, self.stops_by_ramp, self.period_s = True, False, 1e-3
        self.identity = None
        self.node: Any = self
        self.connection: Any = self
        self.clock: Any = self
        self.sdo: Any = self
        self.recorder: Any = self
        self.held = b"\x07\0"
        self.status = State.SWITCH_ON_DISABLED

    def __getattr__(self, name: str) -> Any:
        return lambda *given, **named: self.asked.append((name, *given, *([named] if named else [])))

    def now(self) -> float:
        return self.t_s

    def wait(self, seconds: float) -> None:
        self.asked.append(("wait", round(seconds, 9)))
        self.t_s += seconds

    def live(self, name: str) -> float:
        value = self.values[name]
        return float(value.pop(0) if isinstance(value, list) else value)

    def take(self, recording: Any, wait: Any) -> Any:
        self.asked.append(recording)
        return recording

    def whole(self, item: DriveObject) -> int:
        return 4000

    def state(self) -> State:
        return self.status

    def read(self, index: int, sub: int) -> bytes:
        return self.held

    def quick_stop(self) -> None:
        self.asked.append("stop")
        self.may_be_energised = False

    def finish_average(self, signals: Any) -> dict[str, float]:
        return {"i_d_a": 1.0}

    def halves(self, take: Any, periods: int) -> Any:
        return take(periods)


@pytest.fixture
def drive() -> Shown:
    return Shown()


def guard_of(drive: Shown, envelope: Envelope = ENVELOPE, R_s_ohm: float = 0.5) -> GuardedDrive:
    made = object.__new__(GuardedDrive)
    made.envelope, made._drive, made._node = envelope, drive, drive.node  # type: ignore[assignment]
    made.energy_j = made.energised_s = made._asked_rad_s = 0.0
    made._start_rad, made._kept_since_s, made._looked_s = 1.0, None, drive.t_s
    made._speed_overshoot, made._pole_pairs, made._R_s_ohm = guarding.OVERSHOOT, POLE_PAIRS, R_s_ohm
    made._counts = None
    return made


def wave(shape: Shape, point: Injection, amplitude: float = 0.0, **more: Any) -> Excitation:
    return Excitation(shape, point, amplitude, **more)


@pytest.mark.parametrize(
    ("excitation", "ends"),
    [
        (wave(Shape.SINE, Injection.I_D, 1.0, bias_d_a=3.0), ""),
        (wave(Shape.SINE, Injection.I_D, 1.1, bias_d_a=3.0), "current"),
        (wave(Shape.SINE, Injection.I_Q, -1.1, bias_q_a=-3.0), "current"),
        (wave(Shape.SINE, Injection.I_Q, 0.9, bias_d_a=2.4, bias_q_a=1.8), ""),
        (wave(Shape.SINE, Injection.I_Q, 1.1, bias_d_a=2.4, bias_q_a=1.8), "current"),
        (wave(Shape.SINE, Injection.U_D, 99.0, bias_d_a=4.0), ""),
        (wave(Shape.SINE, Injection.U_Q, 9.0, bias_q_a=4.1), "current"),
        (wave(Shape.BUFFER, Injection.I_Q, 99.0, buffer=(1.0, -3.9)), ""),
        (wave(Shape.BUFFER, Injection.I_Q, 0.0, buffer=(1.0, -4.1)), "current"),
        (wave(Shape.BUFFER, Injection.I_Q, 0.0), ""),
        (wave(Shape.BUFFER, Injection.SPEED, 0.0, buffer=(-99.0, 99.9)), ""),
        (wave(Shape.BUFFER, Injection.SPEED, 0.0, buffer=(-100.1,)), "speed"),
        (wave(Shape.STEP, Injection.SPEED, -100.1), "speed"),
        (wave(Shape.STEP, Injection.SPEED, 99.9, bias_q_a=4.0), ""),
        (wave(Shape.HYSTERESIS, Injection.U_D, i_limit_d_a=2.4, i_limit_q_a=3.2), ""),
        (wave(Shape.HYSTERESIS, Injection.U_D, i_limit_d_a=2.4, i_limit_q_a=3.3), "current"),
        (wave(Shape.HYSTERESIS, Injection.U_D, i_centre_d_a=-1.4, i_limit_d_a=1.0, i_limit_q_a=3.3), "current"),
        (wave(Shape.HYSTERESIS, Injection.U_D, i_centre_d_a=-2.0, i_limit_d_a=1.1), "d current"),
        (wave(Shape.HYSTERESIS, Injection.U_D, i_centre_d_a=-2.0, i_limit_d_a=0.9), ""),
    ],
)  # fmt: skip
def test_an_excitation_stays_within_the_envelope(drive: Shown, excitation: Excitation, ends: str) -> None:
    """4 A in all, 3 A along d, 100 rad/s: by its bias and what swings about it."""
    if ends:
        with pytest.raises(LimitExceeded) as caught:
            guard_of(drive).record(["i_d_a"], 10, excitation=excitation)
        assert caught.value.what.startswith(ends) and drive.asked == []
        return
    recording: Any = guard_of(drive).record(["i_d_a"], 10, excitation=excitation, decimation=2, pretrigger=3)
    assert (recording.samples, recording.decimation, recording.pretrigger) == (10, 2, 3)
    within = recording.excitation
    assert within.abort_current_apk == pytest.approx(5.0) and within.abort_speed_rad_s == pytest.approx(375.0)
    assert replace(within, abort_current_apk=0.0, abort_speed_rad_s=0.0) == excitation


@pytest.mark.parametrize(
    ("said", "asked"),
    [
        ("speed 3729 rpm is outside the limit 2500 rpm", ("speed", 390.515, 261.799, "rad/s")),
        ("travel 183.3 deg is outside the limit 180 deg", ("travel", 3.2, math.pi, "rad")),
        ("current 5 A is outside the limit 4 A", ("current", 5.0, 4.0, "A")),
    ],
)
def test_a_limit_is_told_in_the_unit_it_was_given_in(drive: Shown, said: str, asked: Any) -> None:
    """Before, `--speed-max 2000rpm` was answered by 390.515 rad/s."""
    with pytest.raises(LimitExceeded) as caught:
        guard_of(drive)._check(*asked)
    assert caught.value.what == said
    guard_of(drive)._check("a limit that was rounded", 4.0 * (1.0 + 1e-9), 4.0, "A")


@pytest.mark.parametrize(("counts", "told"), [(None, False), (4096.0, False), (1024.0, True)])
def test_a_coarse_encoder_is_the_likely_cause_of_a_current_beyond_its_limit(
    drive: Shown, counts: float | None, told: bool
) -> None:
    """10 bits at 24 pole pairs: "raise the limit" was all that was said."""
    guard = guard_of(drive)
    guard._counts, guard._pole_pairs = counts, 24.0
    with pytest.raises(LimitExceeded) as caught:
        guard._check("current", 5.0, 4.0, "A")
    assert ("42.7 counts per electrical turn" in caught.value.likely) is told
    assert "8.4 deg" in guard._likely("current") or not told
    assert "counts" not in guard._likely("speed")


def test_an_excitation_keeps_narrower_limits_of_its_own(drive: Shown) -> None:
    asked = wave(Shape.SINE, Injection.I_D, 1.0, abort_current_apk=2.0, abort_speed_rad_s=50.0)
    recording: Any = guard_of(drive).record(["i_d_a"], 10, excitation=asked)
    assert recording.excitation == asked
    recording = guard_of(drive).record(["i_d_a"], 10)
    assert recording.excitation is None and (recording.decimation, recording.pretrigger) == (1, 0)


@pytest.mark.parametrize(
    ("i_d", "i_q", "angle", "ends"),
    [
        (0.0, 4.0, None, ""), (2.4, 3.2, None, ""), (2.4, 3.3, None, "current"), (-3.0, 0.0, None, ""),
        (-3.1, 0.0, None, "d current"), (3.1, 0.0, None, "d current"), (3.9, 0.0, 0.0, ""), (4.1, 0.0, 0.0, "current"),
    ],
)  # fmt: skip
def test_a_vector_stays_within_the_envelope(
    drive: Shown, i_d: float, i_q: float, angle: float | None, ends: str
) -> None:
    """At a fixed angle there is no d axis of the rotor."""
    guard = guard_of(drive)
    guard._asked_rad_s = 5.0
    if ends:
        with pytest.raises(LimitExceeded) as caught:
            guard.command_current(i_d, i_q, fixed_angle_rad=angle)
        assert caught.value.what.startswith(ends) and drive.asked == []
    else:
        guard.command_current(i_d, i_q, fixed_angle_rad=angle)
        assert drive.asked == [("command_current", i_d, i_q, {"fixed_angle_rad": angle})] and guard._asked_rad_s == 0.0


@pytest.mark.parametrize(("velocity", "ends"), [(63_661, False), (63_663, True)])
def test_a_move_keeps_the_speed_of_the_envelope(drive: Shown, velocity: int, ends: bool) -> None:
    """4000 increments per turn: 100 rad/s are 63662 increments per second."""
    move = ProfileMove(1000, velocity, 10)
    if ends:
        with pytest.raises(LimitExceeded, match="speed"):
            guard_of(drive).record_move(["i_q_a"], 10, 2, move)
    else:
        recording: Any = guard_of(drive).record_move(["i_q_a"], 10, 2, move)
        assert recording.move == move and recording.decimation == 2
    commands: tuple[Callable[[GuardedDrive], object], ...] = (
        lambda guard: guard.record_move([], 1, 1, replace(move, velocity=1)), lambda guard: guard.command_speed(1.0),
        lambda guard: guard.record([], 1, excitation=wave(Shape.STEP, Injection.SPEED, 1.0)),
    )  # fmt: skip
    for commanded in commands:
        with pytest.raises(SafetyRefusal, match="--shaft locked"):
            commanded(guard_of(drive, replace(ENVELOPE, shaft="locked")))


def looked(drive: Shown, guard: GuardedDrive) -> str:
    """Look once; return the quantity that ends it, if any."""
    try:
        guard._watch()
    except LimitExceeded as error:
        assert drive.asked[-1] == "stop", "the voltage is off before it is told"
        return error.what.partition(" of ")[0].partition(":")[0]
    return ""


@pytest.mark.parametrize(
    ("shown", "envelope", "ends"),
    [
        ({"i_d_a": 3.0, "i_q_a": -3.99}, {}, False), ({"i_d_a": 3.0, "i_q_a": -4.01}, {}, True),
        ({"i_d_a": [3.0], "i_q_a": -4.0}, {}, False),
        ({"omega_e_rad_s": -374.0}, {}, False), ({"omega_e_rad_s": -376.0}, {}, True),
        ({"omega_e_rad_s": math.nan}, {}, True),
        ({"theta_m_rad": 1.49}, {"travel_rad": 0.5}, False), ({"theta_m_rad": 0.49}, {"travel_rad": 0.5}, True),
        ({"theta_m_rad": 99.0}, {}, False), ({"theta_m_rad": 1.34}, {"shaft": "locked"}, False),
        ({"theta_m_rad": 1.36}, {"shaft": "locked"}, True), ({"theta_m_rad": 1.3}, {"shaft": "locked",
        "travel_rad": 0.2}, True),
        ({}, {"duration_s": 0.019}, True), ({}, {"duration_s": 0.021}, False),
        ({"i_q_a": 2.0}, {"energy_j": 0.061}, False), ({"i_q_a": 2.0}, {"energy_j": 0.059}, True),
    ],
)  # fmt: skip
def test_a_look_ends_what_exceeds_a_limit(
    drive: Shown, shown: dict[str, Any], envelope: dict[str, Any], ends: bool
) -> None:
    """Overshoot of 25 % for current and speed; 20 degrees of a locked shaft; 1.5 R i^2 t = 0.06 J in 20 ms."""
    guard = guard_of(drive, replace(ENVELOPE, **envelope))
    drive.values |= shown
    drive.t_s += 0.02
    assert bool(looked(drive, guard)) == ends == ("stop" in drive.asked)
    assert guard.energised_s == pytest.approx(0.02)


def test_time_and_energy_add_up(drive: Shown) -> None:
    guard = guard_of(drive)
    for current, seconds in ((2.0, 0.03), (-1.0, 0.05)):
        drive.values["i_q_a"] = current
        drive.t_s += seconds
        guard._watch()
    assert guard.energised_s == pytest.approx(0.08) and guard.energy_j == pytest.approx(0.75 * (4.0 * 0.03 + 0.05))


@pytest.mark.parametrize(
    ("i_d", "counted"), [([-4.9, -4.8], 5.7), ([-4.9, 0.5], 3.05), ([-4.9, -5.5], 5.74), ([1.0], 3.16)]
)  # fmt: skip
def test_what_seems_too_much_is_read_again(drive: Shown, i_d: list[float], counted: float) -> None:
    """i_d is read on either side of i_q, and the smaller counts."""
    drive.values |= {"i_d_a": list(i_d), "i_q_a": 3.0}
    assert guard_of(drive)._current() == pytest.approx(counted, abs=0.05)
    assert drive.values["i_d_a"] == []


@pytest.mark.parametrize(
    ("energised", "look_s", "transfer_s", "watched"),
    [(False, 9.0, 9.0, True), (True, 0.1, 9.0, True), (True, 0.11, 9.0, False), (True, 9.0, 0.1, True),
    (True, 9.0, 0.11, False)],
)  # fmt: skip
def test_a_machine_is_watched_for_a_tenth_of_a_second(
    drive: Shown, energised: bool, look_s: float, transfer_s: float, watched: bool
) -> None:
    guard = guard_of(drive)
    drive.may_be_energised, drive.t_s = energised, 0.0
    guard._looked_s, drive.active_s = drive.t_s - look_s, drive.t_s - transfer_s
    assert guard._is_watched() == watched


@pytest.mark.parametrize(
    ("since_s", "energised", "looks"), [(0.05, True, False), (0.051, True, True), (9.0, False, False)]
)
def test_who_reads_lets_the_guard_look_when_it_is_due(
    drive: Shown, since_s: float, energised: bool, looks: bool
) -> None:
    guard, drive.t_s = guard_of(drive), 0.0
    drive.may_be_energised, guard._looked_s = energised, drive.t_s - since_s
    drive.values["theta_m_rad"] = 7.0
    assert guard.live("theta_m_rad") == 7.0
    assert (guard.energised_s > 0.0) == looks


@pytest.mark.parametrize(
    ("seconds", "waits"),
    [(0.12, [0.05, 0.05, 0.02]), (0.05, [0.05]), (0.0, [0.0]), (-1.0, [0.0]), (0.11, [0.05, 0.05, 0.01])],
)
def test_the_machine_is_looked_at_while_time_passes(drive: Shown, seconds: float, waits: list[float]) -> None:
    drive.t_s = 0.0
    guard = guard_of(drive)
    guard.wait(seconds)
    assert [each[1] for each in drive.asked if each[0] == "wait"] == pytest.approx(waits)
    looks = [each for each in drive.asked if each[0] == "check_operating"]
    assert len(looks) == len(waits)
    drive.may_be_energised = False
    drive.asked.clear()
    guard.wait(0.05)
    assert ("check_operating",) not in drive.asked


def test_means_are_taken_while_the_guard_looks(drive: Shown) -> None:
    guard = guard_of(drive)
    assert guard.average(["i_d_a"], 120) == {"i_d_a": 1.0}
    names = [each[0] for each in drive.asked]
    assert names[0] == "start_average" and names[-1] == "check_operating" and names.count("wait") == 3
    both: Any = guard.halves(["i_d_a"], 10)
    assert drive.t_s == pytest.approx(50.13) and both == {"i_d_a": 1.0}


def prover(drive: Shown, monkeypatch: pytest.MonkeyPatch, held: float | None = 6.0) -> tuple[GuardedDrive, list[Any]]:
    guard, options = guard_of(drive), list[Any]()
    guard._changed = SimpleNamespace(held_before=lambda item: held)  # type: ignore[assignment]
    monkeypatch.setattr(guarding, "set_quick_stop", lambda node, option: options.append(option))
    return guard, options


def kept(guard: GuardedDrive, drive: Shown, mechanical: float, seconds: float) -> bool:
    """Show a speed for a time; return whether the ramp may be used at its end."""
    drive.values["omega_e_rad_s"] = POLE_PAIRS * mechanical
    for _ in range(round(seconds / 0.05)):
        drive.t_s += 0.05
        guard._watch()
    return drive.stops_by_ramp


@pytest.mark.parametrize(
    ("asked", "shown", "seconds", "proven"),
    [
        (50.0, 55.0, 0.6, True), (50.0, 45.0, 0.6, True), (50.0, 55.1, 0.6, False), (50.0, 44.9, 0.6, False),
        (-50.0, -54.9, 0.6, True), (-50.0, 54.9, 0.6, False), (50.0, 50.0, 0.45, False), (0.0, 0.0, 0.9, False),
    ],
)  # fmt: skip
def test_a_speed_kept_for_half_a_second_proves_the_ramp(
    drive: Shown, monkeypatch: pytest.MonkeyPatch, asked: float, shown: float, seconds: float, proven: bool
) -> None:
    """Within a tenth of what was asked for; then the drive's own quick stop option comes back."""
    guard, options = prover(drive, monkeypatch)
    guard.command_speed(asked)
    assert kept(guard, drive, shown, seconds) == proven
    assert options == ([6] if proven else [])


def test_a_speed_that_was_lost_in_between_begins_anew(drive: Shown, monkeypatch: pytest.MonkeyPatch) -> None:
    guard, options = prover(drive, monkeypatch, held=None)
    guard.command_speed(50.0)
    assert not kept(guard, drive, 50.0, 0.4) and not kept(guard, drive, 90.0, 0.05)
    assert not kept(guard, drive, 50.0, 0.4)
    guard.command_speed(50.0)  # asked for again
    assert not kept(guard, drive, 50.0, 0.45)
    assert kept(guard, drive, 50.0, 0.15) and options == [], "the option was never changed"


@pytest.mark.parametrize("energised", [False, True])
@pytest.mark.parametrize("status", [State.SWITCH_ON_DISABLED, State.QUICK_STOP_ACTIVE])
@pytest.mark.parametrize("holds", [b"\x07\0", b"\x08\0"])
def test_a_gain_is_changed_while_the_voltage_is_off_and_read_back(
    drive: Shown, monkeypatch: pytest.MonkeyPatch, energised: bool, status: State, holds: bytes
) -> None:
    guard, options = prover(drive, monkeypatch)
    drive.may_be_energised, drive.status, drive.held, drive.stops_by_ramp = energised, status, holds, True
    item = DriveObject(0x60F6, 1, "H")
    if energised or status is not State.SWITCH_ON_DISABLED:
        with pytest.raises(SafetyRefusal, match="only while the voltage is off"):
            guard.change(item, b"\x07\0")
        assert drive.asked == [] and drive.stops_by_ramp
        return
    if holds == b"\x08\0":
        with pytest.raises(SafetyRefusal, match="holds 08 00, not the 07 00") as caught:
            guard.change(item, b"\x07\0")
        assert "0x60F6:01" in caught.value.where
    else:
        guard.change(item, b"\x07\0")
    assert drive.asked == [("write_bytes", 0x60F6, 1, b"\x07\0")]
    assert options == [0] and not drive.stops_by_ramp, "the speed loop is proven no more"


# ---- the envelope ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("load", "shaft", "refused"),
    [("none", "free", False), ("gravity", "free", True), ("gravity", "coupled", True), ("gravity", "locked", False)],
)
def test_a_load_that_falls_is_refused_unless_the_shaft_is_locked(load: Any, shaft: Any, refused: bool) -> None:
    envelope = replace(ENVELOPE, load=load, shaft=shaft)
    if refused:
        with pytest.raises(SafetyRefusal, match="a gravity load falls"):
            envelope.refuse_gravity()
    else:
        envelope.refuse_gravity()


def test_what_a_person_reads_before_consenting() -> None:
    lines = replace(ENVELOPE, travel_rad=math.pi, energy_j=12.5, duration_s=30.0, acceleration_rad_s2=200.0).lines()
    assert lines[1:5] == [
        "speed     at most 954.9 rpm", "travel    180 deg (mech)", "energy    12.5 J in the winding",
        "duration  at most 30 s",
    ]  # fmt: skip
    assert lines[5].endswith("voltage off after 0.5 s; until then full torque adds up to 955 rpm")
    assert [line.split("  ")[-1].strip() for line in ENVELOPE.lines()[2:4]] == [
        "not limited",
        "not limited in the winding",
    ]


@pytest.mark.parametrize(("L_q_h", "torque"), [(0.01, 9.0), (0.02, 9.04), (0.05, 9.414)])
def test_the_largest_acceleration_is_that_of_the_best_vector(L_q_h: float, torque: float) -> None:
    """1.5 x 3 x (0.5 i_q + (L_d - L_q) i_d i_q), over angles of 5 degrees, on 0.8 of the inertia."""
    machine = MachineParameters(3, 1.0, 0.01, L_q_h, 0.5, J_kgm2=0.01)
    best = max(
        4.5 * (0.5 * 4.0 * math.cos(a) - (0.01 - L_q_h) * 16.0 * math.sin(a) * math.cos(a))
        for a in (math.radians(0.01 * k) for k in range(4500))
    )
    assert best == pytest.approx(torque, rel=3e-3)
    assert largest_acceleration(machine, 4.0) == pytest.approx(best / 0.008, rel=1e-3)


def test_objects_that_a_watch_needs() -> None:
    assert objects.ENCODER_INCREMENTS.index == 0x608F
