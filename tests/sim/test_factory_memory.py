# SPDX-License-Identifier: MIT
"""A commissioning of a simulated drive starts from factory memory, unless the channel names a memory file."""

from __future__ import annotations

from pathlib import Path

import pytest

from pmsmtool.errors import ConfigError
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.sim.channel import erase_memory, parse_channel, simulated_machine_file


@pytest.fixture
def memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / ".pmsmsim"
    folder.mkdir()
    for name in ("interior-2k2", "interior-2k2-2", "interior-2k2-3", "jercic-2017", "interior-2k2-epos4"):
        (folder / f"{name}.nv").write_bytes(b"old")
    return folder


@pytest.mark.parametrize(
    ("channel", "erased"),
    [
        ("interior-2k2", {"interior-2k2.nv"}),
        (None, {"interior-2k2.nv"}),
        ("interior-2k2?seed=3", {"interior-2k2.nv"}),
        ("interior-2k2?nodes=2", {"interior-2k2.nv", "interior-2k2-2.nv"}),
        ("interior-2k2?drive=epos4&phase_open=a", {"interior-2k2-epos4.nv"}),
        ("fast-ipm", set()),
        ("interior-2k2?nv=mine.nv", set()),
        ("interior-2k2?nv=:memory:", set()),
    ],
)
def test_only_the_drives_own_default_memory_is_erased(channel: str | None, erased: set[str], memory: Path) -> None:
    before = {path.name for path in memory.iterdir()}
    assert {path.name for path in erase_memory(channel)} == erased
    assert {path.name for path in memory.iterdir()} == before - erased


def test_a_machine_file_has_the_memory_of_its_name(memory: Path) -> None:
    (memory / "mine.nv").write_bytes(b"old")
    Path("mine.toml").write_text((data_folder("profiles") / "interior-2k2.toml").read_text())
    assert [path.name for path in erase_memory("mine.toml")] == ["mine.nv"]


def test_a_channel_that_cannot_be_used_erases_nothing(memory: Path) -> None:
    with pytest.raises(ConfigError, match="interior-2k"):
        erase_memory("interior-2k")
    assert len(list(memory.iterdir())) == 5


def test_a_machine_file_by_hand_has_the_sensors_that_machine_new_assumes(tmp_path: Path) -> None:
    """Without noise its current measurement was refused, and without friction a light one had an open phase."""
    path = tmp_path / "hand.toml"
    path.write_text(
        'schema = "pmsmtool.machine/1"\nname = "hand"\n[machine]\npole_pairs = 5\nR_s_ohm = 0.93\nL_d_h = 0.0026\n'
        "L_q_h = 0.0026\npsi_f_wb = 0.0471\nI_nom_apk = 3.96\n[inverter]\nU_dc_v = 310\nf_s_hz = 16000\n"
    )
    assumed = simulated_machine_file(parse_channel(f"{path}?phase_open=a")).simulation
    assert float(assumed["sensor_noise_apk"]) > 0.0 and float(assumed["tau_c_nm"]) > 0.0  # type: ignore[arg-type]
    assert assumed["phase_open"] == "a"
    shipped = simulated_machine_file(parse_channel("interior-2k2")).simulation
    assert shipped == load_machine_file("interior-2k2").simulation
