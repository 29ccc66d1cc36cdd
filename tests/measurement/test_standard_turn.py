# SPDX-License-Identifier: MIT
"""The turned vector of the standard level: rotors that swung away from it, by a fall onto it or by the dead time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.random_drives import draw_drive
from pmsmtool.bus.connect import connect
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.port import Identity
from pmsmtool.drive.standard_drive import StandardDrive
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import IdentificationError
from pmsmtool.experiments.rotation import FIRST_SHARE, LEAD_S, lead_onto_vector
from pmsmtool.identification.by_pulses import PulseFacts, pulse_result
from pmsmtool.identification.request import Method
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.measurement import by_pulses
from pmsmtool.measurement.by_pulses import HEADROOM, TURNS, turn_both_ways
from pmsmtool.measurement.capabilities import WAYS, Capabilities
from pmsmtool.sim.simulated_machine import settings_of
from pmsmtool.trace import Trace

SWINGING = 8001
"""A random drive whose rotor left the vector of 0.35 and of 0.7 of the test current that was switched on."""
FALLING = 8007
"""One whose rotor fell onto the first vector and left it by 93 degrees: two pole pairs, little to turn."""
SWING_RAD_S = 2.0 * math.pi * 6.0
FRICTION = 0.01
"""Of the torque at the test current."""
FINAL = 0.35


class Pendulum:
    """A rotor with Coulomb friction on an ideal current vector of the test current 1 A."""

    def __init__(self, theta_rad: float) -> None:
        self.theta, self.omega, self.i_a, self.angle, self.time_s = theta_rad, 0.0, 0.0, 0.0, 0.0
        self.lengths: list[float] = []

    def command_current(self, i_d_a: float, i_q_a: float, *, fixed_angle_rad: float) -> None:
        assert i_q_a == 0.0
        self.i_a, self.angle = i_d_a, fixed_angle_rad
        self.lengths.append(i_d_a)

    def wait(self, seconds: float) -> float:
        """Pass time; return the largest speed meanwhile, over that of a swing of one radian."""
        step, largest = 1e-4, 0.0
        for _ in range(round(seconds / step)):
            at_one_amp = SWING_RAD_S**2 / FINAL
            omega = self.omega + step * at_one_amp * self.i_a * math.sin(self.angle - self.theta)
            held = step * at_one_amp * FRICTION
            self.omega = math.copysign(max(0.0, abs(omega) - held), omega)
            self.theta += step * self.omega
            largest = max(largest, abs(self.omega) / SWING_RAD_S)
        self.time_s += seconds
        return largest


@pytest.mark.parametrize("off_deg", [-179.9, -90.0, 0.0, 60.0, 120.0, 175.0, 180.0])
def test_a_rotor_rests_where_the_vector_led_it(off_deg: float) -> None:
    rotor = Pendulum(math.radians(off_deg))
    lead_onto_vector(rotor, FINAL, 0.0)  # type: ignore[arg-type]
    assert rotor.angle == 0.0 and rotor.lengths[-1] == pytest.approx(FINAL)
    assert rotor.lengths == sorted(rotor.lengths) and rotor.lengths[0] < 1.02 * FIRST_SHARE * FINAL
    assert rotor.time_s == pytest.approx(LEAD_S)
    assert rotor.wait(0.3) < math.radians(3.0)  # swing; measured: 0.13 deg at most
    assert abs(math.remainder(rotor.theta, 2.0 * math.pi)) < math.radians(3.0)  # measured: 1.6 deg, held by friction


def test_a_rotor_falls_onto_a_vector_that_is_switched_on() -> None:
    """What the lead is there for: after 0.3 s on the full vector such a rotor still swings."""
    rotor = Pendulum(math.radians(120.0))
    rotor.command_current(FINAL, 0.0, fixed_angle_rad=0.0)
    rotor.wait(0.3)
    assert rotor.wait(0.3) > math.radians(60.0)  # measured: 86 deg


def twin(seed: int, pole_pairs: int) -> MachineFile:
    """Return a random drive with other pole pairs and the same swing on a vector: less to turn."""
    drive = draw_drive(seed)
    machine, share = drive.machine, pole_pairs / drive.machine.pole_pairs
    assert machine.J_kgm2 is not None and machine.B_nms is not None and machine.tau_c_nm is not None
    return replace(
        drive,
        machine=replace(
            machine,
            pole_pairs=pole_pairs,
            J_kgm2=machine.J_kgm2 * share**2,
            B_nms=machine.B_nms * share**2,
            tau_c_nm=machine.tau_c_nm * share,
        ),
    )


@contextmanager
def standard(drive: MachineFile, folder: Path) -> Iterator[tuple[StandardDrive, Envelope]]:
    path = folder / "drive.toml"
    path.write_text(dump_machine_file(drive), encoding="utf-8")
    machine = drive.machine
    assert machine.I_nom_apk is not None and machine.n_max_rpm is not None
    envelope = Envelope(HEADROOM * machine.I_nom_apk, machine.n_max_rpm * math.pi / 30.0)
    with connect("pmsmsim", f"{path}?nv=:memory:&drive=cia402") as connection:
        opened = StandardDrive(connection, 1, drive_map=load_family("cia402"))
        yield opened, envelope
        opened.close()


def offset_error_deg(drive: MachineFile, traces: dict[str, Trace]) -> float:
    """Return the error of the offset; the pole pairs are asserted."""
    found = pulse_result(traces, PulseFacts(Method.STANDARD)).estimates
    assert found["pole_pairs"].value == drive.machine.pole_pairs
    truth = settings_of(drive).number("encoder_offset_rad")
    return abs(math.degrees(math.remainder(found["offset_rad"].value - truth, 2.0 * math.pi)))


@pytest.mark.chain
def test_a_rotor_of_little_friction_stays_on_the_first_vector(tmp_path: Path) -> None:
    drive = draw_drive(FALLING)
    kept: list[str] = []
    traces: dict[str, Trace] = {}
    with standard(drive, tmp_path) as (opened, envelope):
        keep = lambda name, trace: (kept.append(name), traces.update({name: trace}))[0]  # noqa: E731
        turn_both_ways(opened, envelope, keep, lambda text: None)
    assert kept == ["rotation_forward", "rotation_backward"]  # no second try
    assert offset_error_deg(drive, traces) < 0.5  # measured: 0.02 deg; 2 deg are asked for


@pytest.mark.chain
def test_dead_time_that_drives_the_swing_is_left_by_a_slower_turn(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """On 0.7 of the test current the sixth harmonic of 7 Hz meets the swing of this rotor."""
    drive = twin(SWINGING, 3)
    fast_s, (large, slow_s) = 0.02, TURNS[-1]
    traces: dict[str, Trace] = {}
    with standard(drive, tmp_path) as (opened, envelope):
        monkeypatch.setattr(by_pulses, "TURNS", ((large, fast_s),))
        with pytest.raises(IdentificationError, match="E_ROTOR_MOVED"):
            turn_both_ways(opened, envelope, traces.__setitem__, lambda text: None)
    with standard(drive, tmp_path) as (opened, envelope):
        monkeypatch.setattr(by_pulses, "TURNS", ((large, slow_s),))
        turn_both_ways(opened, envelope, traces.__setitem__, lambda text: None)
    assert offset_error_deg(drive, traces) < 0.5  # measured: 0.01 deg


@pytest.mark.parametrize(
    ("seen", "says"),
    [
        (("line voltage",), "psi where the speed at the voltage limit is reached"),
        ((), "no psi: it shows no voltage"),
    ],
)
def test_the_plan_promises_psi_only_where_a_voltage_shows_it(seen: tuple[str, ...], says: str) -> None:
    features = frozenset({*WAYS["mechanics"][Method.STANDARD].needs, *seen})
    found = Capabilities(Identity(1, 0, 0, 0, 1), load_family("cia402"), False, features)
    known = load_machine_file("interior-2k2")
    plan = by_pulses.measurable(Method.STANDARD, found, known)[-1]
    assert says in plan and "peak or rms" not in plan
    (doubtful,) = by_pulses.measurable(Method.STANDARD, replace(found, current_undecided=True), known)
    assert says in doubtful and "peak or rms: +-17 % more, a map of your own may say it" in doubtful
