# SPDX-License-Identifier: MIT
"""Excitation, recorder, averages and live values over SDO."""

from __future__ import annotations

import math
import struct
import zlib

import pytest

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.drive.port import Injection, Shape
from pmsmtool.sim.kernel import Signal
from pmsmtool.sim.node.measurement import LIVE_SIGNALS
from pmsmtool.sim.node.objects import object_rows
from tests.node.bench import Bench
from tests.node.raw_client import Aborted, RawClient

FIELDS = {row.key.removeprefix("excitation."): row for row in object_rows() if row.key.startswith("excitation.")}
LIVE = [row for row in object_rows() if row.key.startswith("live.")]
WORDS = {row.key.removeprefix("live."): row.index << 16 | row.sub << 8 | 32 for row in LIVE}


def enable(bench: Bench, mode: int = -1) -> None:
    bench.client.put(0x6060, 0, mode, "b")
    for word in (6, 7, 15):
        bench.client.put(0x6040, 0, word, "H")


def excite(client: RawClient, **values: float) -> None:
    for name, value in values.items():
        row = FIELDS[name]
        client.put(row.index, row.sub, value, row.data_type.letter)
    client.put(0x2050, 0x0D, 2, "B")


def record(client: RawClient, channels: list[str], depth: int, **values: float) -> None:
    for number in range(8):
        client.put(0x2061, number + 1, WORDS[channels[number]] if number < len(channels) else 0)
    client.put(0x2060, 2, depth)
    rows = {row.key.removeprefix("trace."): row for row in object_rows() if row.key.startswith("trace.")}
    for name, value in values.items():
        client.put(rows[name].index, rows[name].sub, value, rows[name].data_type.letter)
    client.put(0x2060, 7, 1, "B")


def state_of_excitation(client: RawClient) -> int:
    return int(client.number(0x2050, 0x0E, "B"))


def test_all_fields_of_an_excitation_reach_the_core(bench: Bench) -> None:
    enable(bench)
    names = (
        "amplitude bias_d_a bias_q_a f0_hz f1_hz duration_s fixed_angle_rad abort_current_apk abort_speed_rad_s "
        "bias_bandwidth_rad_s amplitude_q i_limit_d_a i_limit_q_a i_centre_d_a"
    )
    values: dict[str, float] = {name: 0.5 + number for number, name in enumerate(names.split())}
    values |= {"shape": Shape.HYSTERESIS, "point": Injection.U_Q, "hold_periods": 6}
    excite(bench.client, **values)
    seen = bench.core._excitation
    assert seen is not None
    assert {name: getattr(seen, name) for name in values} == values
    assert seen.buffer == ()
    excite(bench.client, fixed_angle_rad=math.nan)
    assert bench.core._excitation is not None
    assert bench.core._excitation.fixed_angle_rad is None


def test_an_excitation_starts_in_the_identification_mode_only(bench: Bench) -> None:
    with pytest.raises(Aborted) as caught:
        excite(bench.client, shape=Shape.DC)
    assert caught.value.code == AbortCode.DEVICE_STATE
    enable(bench, mode=10)
    with pytest.raises(Aborted):
        excite(bench.client, shape=Shape.DC)
    bench.client.put(0x6060, 0, -1, "b")
    excite(bench.client, shape=Shape.DC)
    assert state_of_excitation(bench.client) == 2


def test_states_of_an_excitation(bench: Bench) -> None:
    client = bench.client
    assert state_of_excitation(client) == 0
    client.put(0x2050, 0x0D, 1, "B")
    assert state_of_excitation(client) == 1
    enable(bench)
    excite(client, shape=Shape.STEP, amplitude=5.0, duration_s=0.1)
    assert state_of_excitation(client) == 2
    bench.wait(0.11)
    assert state_of_excitation(client) == 3
    client.put(0x2050, 0x0D, 0, "B")
    assert state_of_excitation(client) == 0


def test_an_aborted_excitation_is_a_fault(bench: Bench) -> None:
    client = bench.client
    enable(bench)
    excite(client, shape=Shape.DC, bias_d_a=20.0, abort_current_apk=10.0)
    bench.wait(0.1)
    assert state_of_excitation(client) == 4
    assert client.number(0x603F, 0, "H") == 0xFF10
    assert [*client.heard(0x081), *bench.frames(0x081, 0.1)][0][:2] == b"\x10\xff"


def test_leaving_operation_ends_the_excitation(bench: Bench) -> None:
    enable(bench)
    excite(bench.client, shape=Shape.DC, bias_d_a=2.0)
    bench.client.put(0x6040, 0, 0, "H")
    assert bench.core._excitation is None
    assert state_of_excitation(bench.client) == 0


def test_a_running_bias_can_be_moved(bench: Bench) -> None:
    enable(bench)
    excite(bench.client, shape=Shape.DC, bias_d_a=2.0)
    bench.client.put(0x2050, 4, 3.0, "f")
    assert bench.core._excitation is not None
    assert bench.core._excitation.bias_d_a == 3.0
    bench.wait(0.01)
    assert bench.client.number(0x2070, 1, "f") == pytest.approx(3.0, abs=1e-3)


def test_speed_injection_uses_the_speed_controller(bench: Bench) -> None:
    enable(bench)
    excite(bench.client, shape=Shape.SINE, point=Injection.SPEED, amplitude=1.0, f0_hz=1.0)
    assert bench.core.command_seen.mode.name == "SPEED"
    bench.client.put(0x2050, 0x0D, 0, "B")
    assert bench.core.command_seen.mode.name == "CURRENT"


def test_buffer_is_checked_and_played(bench: Bench) -> None:
    client = bench.client
    samples = [0.5 * k for k in range(2000)]
    client.write_block(0x2051, 0, struct.pack("<2000f", *samples))
    assert client.number(0x2050, 0x14) == 2000
    enable(bench)
    excite(client, shape=Shape.BUFFER)
    assert bench.core._excitation is not None
    assert list(bench.core._excitation.buffer) == samples
    for data, code in (
        (bytes(6), AbortCode.LENGTH),
        (bytes(4 * 4097), AbortCode.TOO_LONG),
        (struct.pack("<f", math.nan) * 2, AbortCode.VALUE),
    ):
        with pytest.raises(Aborted) as caught:
            client.write(0x2051, 0, data, segmented=True)
        assert caught.value.code == code


def test_a_recording_holds_what_the_core_stored_with_crc_and_times(bench: Bench) -> None:
    client = bench.client
    enable(bench)
    record(client, ["i_d_a", "u_q_v", "U_dc_v"], 300, trigger=4, pretrigger=50, decimation=2)
    bench.wait(0.1)
    assert client.number(0x2060, 8, "B") == 1
    with pytest.raises(Aborted) as caught:
        client.read_block(0x2062)
    assert caught.value.code == AbortCode.DEVICE_STATE
    excite(client, shape=Shape.STEP, point=Injection.U_Q, amplitude=7.0, duration_s=1.0)
    bench.wait(0.2)
    assert client.number(0x2060, 8, "B") == 3
    assert (client.number(0x2060, 9), client.number(0x2060, 0xA)) == (300, 50)
    assert client.number(0x2060, 0xD) == 200_000
    data = client.read_block(0x2062)
    assert zlib.crc32(data) == client.number(0x2060, 0xC)
    rows = list(struct.iter_unpack("<3f", data))
    assert [row[1] for row in rows] == [0.0] * 50 + [7.0] * 250
    assert {row[2] for row in rows} == {300.0}


def test_recorder_set_ups_that_cannot_work_are_refused_when_armed(bench: Bench) -> None:
    client = bench.client
    for number in range(8):
        client.put(0x2061, number + 1, 0)
    with pytest.raises(Aborted) as caught:
        client.put(0x2060, 7, 1, "B")
    assert caught.value.code == AbortCode.NO_DATA
    with pytest.raises(Aborted) as caught:
        record(client, list(WORDS)[:8], 2049)
    assert caught.value.code == AbortCode.PDO_LENGTH
    with pytest.raises(Aborted) as caught:
        record(client, ["i_d_a"], 100, pretrigger=100)
    assert caught.value.code == AbortCode.INCOMPATIBLE
    with pytest.raises(Aborted) as caught:
        record(client, ["i_d_a"], 100, pretrigger=0, trigger=1)
    assert caught.value.code == AbortCode.INCOMPATIBLE
    record(client, list(WORDS)[:8], 2048, trigger=0)


def test_forced_and_fault_triggers(bench: Bench) -> None:
    client = bench.client
    record(client, ["i_d_a"], 20, trigger=5, pretrigger=5)
    bench.wait(0.1)
    assert client.number(0x2060, 8, "B") == 1
    bench.core.persistent_trip = 0x2310
    bench.wait(0.1)
    assert client.number(0x2060, 8, "B") == 3
    record(client, ["i_d_a"], 20, trigger=5, pretrigger=5)
    bench.core.persistent_trip = 0
    bench.core.reset_fault()
    client.put(0x2060, 7, 2, "B")
    bench.wait(0.1)
    assert client.number(0x2060, 8, "B") == 3


def test_window_averages(bench: Bench) -> None:
    client = bench.client
    enable(bench)
    client.put(0x2052, 1, 4.0, "f")
    bench.wait(0.1)
    client.put(0x2064, 1, WORDS["i_d_a"])
    client.put(0x2064, 2, WORDS["U_dc_v"])
    client.put(0x2063, 1, 500)
    client.put(0x2063, 2, 1, "B")
    assert client.number(0x2063, 3, "B") == 1
    assert math.isnan(client.number(0x2063, 0x11, "f"))
    bench.wait(0.051)
    assert client.number(0x2063, 3, "B") == 2
    assert client.number(0x2063, 0x11, "f") == pytest.approx(4.0)
    assert client.number(0x2063, 0x12, "f") == 300.0
    assert client.number(0x2063, 0x21, "f") == pytest.approx(0.0, abs=1e-6)
    assert math.isnan(client.number(0x2063, 0x13, "f"))


def test_every_live_value_shows_its_signal(bench: Bench) -> None:
    for name, signal in LIVE_SIGNALS.items():
        row = next(row for row in object_rows() if row.key == f"live.{name}")
        shown = bench.client.number(row.index, row.sub, row.data_type.letter)
        assert shown == pytest.approx(bench.core.signal(signal))
    assert set(LIVE_SIGNALS.values()) == set(Signal) - {Signal.NONE}


def test_the_core_runs_in_few_calls(bench: Bench) -> None:
    """A second without anybody looking: one call per node timer, here five heartbeats."""
    before = bench.core.calls
    bench.wait(1.0)
    assert bench.core.calls - before <= 6
    before = bench.core.calls
    for _ in range(100):
        bench.client.number(0x1018, 4)
    assert bench.core.calls - before <= 30
