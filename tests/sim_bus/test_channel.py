# SPDX-License-Identifier: MIT
"""Channel strings, profiles, memory files, and the lines built from them."""

from __future__ import annotations

from pathlib import Path

import pytest

from pmsmtool.errors import ConfigError
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import machine_path, profile_names
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.channel import DEFAULT_PROFILE, Channel, build_line, parse_channel
from tests.node.raw_client import RawClient
from tests.node.simple_core import SimpleCore

SAVE = 0x65766173


def open_bus(text: str | None) -> tuple[PmsmSimBus, RawClient]:
    channel = parse_channel(text)
    line = build_line(channel, make_core=lambda machine_file, seed: SimpleCore())
    bus = PmsmSimBus(text, line=line)
    return bus, RawClient(bus, channel.node or 1, timeout_s=2.0)


def test_everything_a_string_can_say() -> None:
    assert parse_channel(None) == parse_channel("") == Channel(name=DEFAULT_PROFILE)
    text = "a/b.toml?seed=7&nv=x%20y.nv&faults=f.toml&bitrate=500000&node=0x10&nodes=3&speed=2.5"
    assert parse_channel(text) == Channel("a/b.toml", 7, "x y.nv", Path("f.toml"), 500_000, 16, 3, 2.5)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("p?sede=1", "did you mean seed"),
        ("p?seed=-1", "seed"),
        ("p?bitrate=fast", "bitrate"),
        ("p?bitrate=1", "bitrate"),
        ("p?node=0", "node"),
        ("p?speed=0", "speed"),
    ],
)
def test_what_a_string_cannot_say(text: str, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        parse_channel(text)


def test_more_drives_than_node_ids_are_refused() -> None:
    with pytest.raises(ConfigError, match="exceed 127"):
        build_line(Channel(node=126, nodes=3), make_core=lambda machine_file, seed: SimpleCore())


def test_all_mistakes_are_listed_at_once() -> None:
    with pytest.raises(ConfigError) as caught:
        parse_channel("p?seed=x&nodes=y&what=z")
    assert len(caught.value.violations) == 3


def test_the_default_profile_ships_and_is_an_interior_magnet_machine() -> None:
    assert DEFAULT_PROFILE in profile_names()
    assert machine_path(DEFAULT_PROFILE).parent == data_folder("profiles")


def test_an_unknown_profile_names_the_nearest_ones() -> None:
    with pytest.raises(ConfigError, match="interior-2k2"):
        machine_path("interior-2k")


def test_memory_lies_under_the_working_directory_and_survives_the_bus(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    bus, client = open_bus(None)
    client.put(0x6007, 0, 1, "h")
    assert not (tmp_path / ".pmsmsim").exists()
    client.put(0x1010, 1, SAVE)
    bus.shutdown()
    assert [path.name for path in (tmp_path / ".pmsmsim").iterdir()] == [f"{DEFAULT_PROFILE}.nv"]
    bus, client = open_bus(None)
    assert client.number(0x6007, 0, "h") == 1
    bus.shutdown()
    bus, client = open_bus(f"{DEFAULT_PROFILE}?nv=:memory:")
    assert client.number(0x6007, 0, "h") == 3
    bus.shutdown()


def test_several_drives_have_their_own_memory_identity_and_id(tmp_path: Path) -> None:
    text = f"{DEFAULT_PROFILE}?nodes=3&node=5&nv={tmp_path / 'fleet.nv'}"
    bus, client = open_bus(text)
    serials = []
    for node in (5, 6, 7):
        client.node = node
        client.put(0x1010, 1, SAVE)
        serials.append(client.number(0x1018, 4))
    bus.shutdown()
    assert serials == [serials[0], serials[0] + 1, serials[0] + 2]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fleet-2.nv", "fleet-3.nv", "fleet.nv"]


def test_a_drive_leaves_the_factory_with_its_plate_and_harmless_gains(tmp_path: Path) -> None:
    bus, client = open_bus(f"{DEFAULT_PROFILE}?nv=:memory:")
    core = bus.line.nodes[0].core
    assert isinstance(core, SimpleCore)
    assert core.parameters is not None
    assert core.parameters.first_offender() is None
    plate = core.parameters
    assert plate.get("protection.i_trip_apk") > plate.get("motor.I_max_apk") >= plate.get("motor.I_nom_apk")
    assert plate.get("protection.U_dc_min_v") < plate.get("inverter.U_dc_nom_v") < plate.get("protection.U_dc_max_v")
    voltage = plate.get("inverter.voltage_utilisation") * plate.get("inverter.U_dc_nom_v")
    assert plate.get("current.K_p_d_v_per_a") < 0.2 * voltage / plate.get("motor.I_max_apk")
    assert client.read(0x1008).decode() == f"pmsmsim {DEFAULT_PROFILE}"
    bus.shutdown()


@pytest.mark.parametrize("name", profile_names())
def test_every_profile_makes_a_drive(name: str) -> None:
    line = build_line(parse_channel(f"{name}?nv=:memory:"))
    bus = PmsmSimBus(name, line=line)
    client = RawClient(bus)
    bus.clock.wait(0.5)
    assert int(client.number(0x6041, 0, "H")) & 0x6F == 0x40
    for word in (6, 7, 15):
        client.put(0x6040, 0, word, "H")
    bus.clock.wait(0.5)
    assert int(client.number(0x6041, 0, "H")) & 0x6F == 0x27
    assert client.number(0x603F, 0, "H") == 0
    bus.shutdown()


def test_a_string_changes_the_simulated_drive() -> None:
    channel = parse_channel("interior-2k2?leads_swapped=true&drive_fault=safe_torque_off&serial=7&nv=:memory:")
    assert channel.simulation == {"leads_swapped": True, "drive_fault": "safe_torque_off", "serial": 7}
    seen = []
    build_line(channel, make_core=lambda machine_file, seed: seen.append(machine_file) or SimpleCore())  # type: ignore[func-returns-value]
    assert seen[0].simulation.items() >= dict(channel.simulation).items()


def test_a_bad_value_of_a_simulated_drive_is_named() -> None:
    with pytest.raises(ConfigError, match="leads_swapped is text, allowed are true and false"):
        build_line(parse_channel("interior-2k2?leads_swapped=yes"), make_core=lambda machine_file, seed: SimpleCore())
    with pytest.raises(ConfigError, match="did you mean leads_swapped"):
        parse_channel("p?leads_swap=true")


def test_a_string_without_its_question_mark_says_so() -> None:
    with pytest.raises(ConfigError, match=r"a \? is missing"):
        parse_channel("motor.toml&drive=epos4")
