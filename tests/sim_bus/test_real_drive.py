# SPDX-License-Identifier: MIT
"""The node over the simulated machine: trips, aborts, recordings and averages that only the kernel can produce."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import pytest

from pmsmtool.drive.port import Injection, Shape
from pmsmtool.machine.machine_file import load_machine_file, machine_path
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.node.objects import object_rows
from tests.node.raw_client import RawClient

PROFILE = "interior-2k2"
I_D, I_Q, U_D, THETA = 0x20700120, 0x20700220, 0x20700520, 0x20700B20


@pytest.fixture
def client() -> Iterator[RawClient]:
    bus = PmsmSimBus(f"{PROFILE}?nv=:memory:&seed=3")
    yield RawClient(bus, timeout_s=2.0)
    bus.shutdown()


def enable(client: RawClient) -> None:
    client.put(0x6060, 0, -1, "b")
    for word in (6, 7, 15):
        client.put(0x6040, 0, word, "H")


def record(client: RawClient, words: list[int], depth: int, trigger: int) -> None:
    for number in range(8):
        client.put(0x2061, number + 1, words[number] if number < len(words) else 0)
    client.put(0x2060, 2, depth)
    client.put(0x2060, 4, trigger, "B")
    client.put(0x2060, 7, 1, "B")


def hold(client: RawClient, i_d: float, angle: float) -> None:
    client.put(0x2052, 3, angle, "f")
    client.put(0x2052, 1, i_d, "f")


def test_a_held_current_vector_is_recorded_and_averaged(client: RawClient) -> None:
    enable(client)
    hold(client, 3.0, 0.0)
    client.bus.clock.wait(1.0)
    record(client, [I_D, I_Q, THETA], 1000, 0)
    for number, word in enumerate((I_D, I_Q), 1):
        client.put(0x2064, number, word)
    client.put(0x2063, 1, 2000)
    client.put(0x2063, 2, 1, "B")
    client.bus.clock.wait(0.3)
    assert client.number(0x2060, 8, "B") == 3
    rows = list(struct.iter_unpack("<3f", client.read_block(0x2062)))
    assert len(rows) == 1000
    assert sum(row[0] for row in rows) / 1000 == pytest.approx(3.0, abs=0.05)
    assert {row[2] for row in rows} == {0.0}
    assert client.number(0x2063, 0x11, "f") == pytest.approx(3.0, abs=0.05)
    assert client.number(0x2063, 0x12, "f") == pytest.approx(0.0, abs=0.05)
    assert 0.0 < client.number(0x2063, 0x21, "f") < 0.2


def test_a_square_wave_starts_with_the_recorder(client: RawClient) -> None:
    enable(client)
    client.put(0x2050, 1, Shape.SQUARE, "B")
    client.put(0x2050, 2, Injection.U_D, "B")
    client.put(0x2050, 3, 20.0, "f")
    client.put(0x2050, 9, 6)
    client.put(0x2050, 0x0A, 0.0, "f")
    client.put(0x2050, 8, 0.05, "f")
    record(client, [I_D, U_D], 240, 4)
    client.put(0x2050, 0x0D, 2, "B")
    client.bus.clock.wait(0.1)
    assert client.number(0x2050, 0x0E, "B") == 3
    rows = list(struct.iter_unpack("<2f", client.read_block(0x2062)))
    voltages = [row[1] for row in rows]
    assert max(voltages) == pytest.approx(20.0, abs=3.0)
    assert min(voltages) == pytest.approx(-20.0, abs=3.0)
    assert max(row[0] for row in rows) - min(row[0] for row in rows) > 0.1


def test_an_over_current_trips_and_is_reported_at_once(client: RawClient) -> None:
    enable(client)
    client.put(0x6040, 0, 6, "H")
    client.put(0x2012, 1, 1.5, "f")
    client.put(0x6040, 0, 15, "H")
    hold(client, 3.0, 0.0)
    client.bus.clock.wait(1.0)
    assert client.number(0x603F, 0, "H") == 0x2310
    assert int(client.number(0x6041, 0, "H")) & 0x4F == 0x08
    assert client.heard(0x081)[0][:3] == b"\x10\x23\x03"


def test_an_abort_current_ends_the_excitation_in_a_fault(client: RawClient) -> None:
    enable(client)
    client.put(0x2050, 1, Shape.STEP, "B")
    client.put(0x2050, 3, 60.0, "f")
    client.put(0x2050, 0x0A, 0.0, "f")
    client.put(0x2050, 0x0B, 2.0, "f")
    client.put(0x2050, 0x0D, 2, "B")
    client.bus.clock.wait(0.5)
    assert client.number(0x2050, 0x0E, "B") == 4
    assert client.number(0x603F, 0, "H") == 0xFF10


def tune(client: RawClient) -> None:
    """Write what identification and design would find for this profile; speed loop of 60 rad/s."""
    machine_file = load_machine_file(machine_path(PROFILE))
    machine, truth = machine_file.machine, machine_file.simulation_settings()
    assert machine.J_kgm2 is not None
    alpha, alpha_speed = 1500.0, 60.0
    values = {
        "motor.pole_pairs": machine.pole_pairs,
        "motor.R_s_ohm": machine.R_s_ohm,
        "motor.L_d_h": machine.L_d_h,
        "motor.L_q_h": machine.L_q_h,
        "motor.L_d_app_h": machine.L_d_h,
        "motor.L_q_app_h": machine.L_q_h,
        "motor.psi_f_wb": machine.psi_f_wb,
        "encoder.offset_rad": truth["encoder_offset_rad"],
        "encoder.reversed": int(bool(truth["encoder_reversed"])),
        "current.K_p_d_v_per_a": alpha * machine.L_d_h,
        "current.K_p_q_v_per_a": alpha * machine.L_q_h,
        "current.K_i_d_v_per_as": alpha * machine.R_s_ohm,
        "current.K_i_q_v_per_as": alpha * machine.R_s_ohm,
        "speed.K_p_nms_per_rad": alpha_speed * machine.J_kgm2,
        "speed.K_i_nm_per_rad": 0.25 * alpha_speed**2 * machine.J_kgm2,
        "speed.tau_max_nm": 0.8 * machine.torque_nm(0.0, machine.I_nom_apk or 1.0),
    }
    rows = {row.key: row for row in object_rows()}
    for name, value in values.items():
        row = rows[name]
        assert isinstance(value, (int, float))
        client.put(row.index, row.sub, value, row.data_type.letter)


def test_speed_mode_turns_the_machine_and_quick_stop_brings_it_to_rest(client: RawClient) -> None:
    tune(client)
    client.put(0x6060, 0, 3, "b")
    client.put(0x60FF, 0, 300_000, "i")
    for word in (6, 7, 15):
        client.put(0x6040, 0, word, "H")
    client.bus.clock.wait(2.0)
    assert client.number(0x606C, 0, "i") == pytest.approx(300_000, rel=0.02)
    assert int(client.number(0x6041, 0, "H")) & 0x427 == 0x427
    client.put(0x6040, 0, 2, "H")
    assert int(client.number(0x6041, 0, "H")) & 0x6F == 0x07
    client.bus.clock.wait(2.0)
    assert int(client.number(0x6041, 0, "H")) & 0x4F == 0x40
    assert abs(client.number(0x606C, 0, "i")) < 10_000


@pytest.mark.parametrize(("mode", "option", "seconds"), [(3, 2, 0.5), (4, 2, 0.5), (4, 3, 0.26)])
def test_quick_stop_follows_its_ramp_or_the_current_limit(
    client: RawClient, mode: int, option: int, seconds: float
) -> None:
    """From about 250 rpm with 500 rpm/s; at the limit, which ends like a viscous brake, in half of that."""
    tune(client)
    client.put(0x605A, 0, option, "h")
    client.put(0x6085, 0, 500)
    client.put(0x6060, 0, mode, "b")
    client.put(0x60FF, 0, 250_000, "i")
    client.put(0x6071, 0, 100, "h")
    for word in (6, 7, 15):
        client.put(0x6040, 0, word, "H")
    while client.number(0x606C, 0, "i") < 249_000:
        client.bus.clock.wait(0.002)
    client.put(0x6040, 0, 2, "H")
    started = client.bus.clock.now()
    while int(client.number(0x6041, 0, "H")) & 0x6F == 0x07:
        client.bus.clock.wait(0.001)
    assert client.bus.clock.now() - started == pytest.approx(seconds, abs=0.08)
    assert abs(client.number(0x606C, 0, "i")) < 10_000


def test_a_lost_master_stops_the_turning_machine(client: RawClient) -> None:
    """The dead-man: heartbeat every 50 ms, watched for 100 ms; then it ends."""
    tune(client)
    client.put(0x1016, 1, 0x7F << 16 | 100)
    ticker = client.bus.clock.every(0.05, lambda: client.send(b"\x05", 0x77F))
    client.put(0x6060, 0, 3, "b")
    client.put(0x60FF, 0, 300_000, "i")
    for word in (6, 7, 15):
        client.put(0x6040, 0, word, "H")
    client.bus.clock.wait(2.0)
    assert client.number(0x606C, 0, "i") == pytest.approx(300_000, rel=0.02)
    ticker.stop()
    client.bus.clock.wait(0.11)
    assert int(client.number(0x6041, 0, "H")) & 0x6F == 0x07
    client.bus.clock.wait(1.0)
    assert int(client.number(0x6041, 0, "H")) & 0x4F == 0x40
    assert abs(client.number(0x606C, 0, "i")) < 10_000
