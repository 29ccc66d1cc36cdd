# SPDX-License-Identifier: MIT
"""A commissioning of a simulated drive starts from factory memory, unless the channel names a memory file."""

from __future__ import annotations

from pathlib import Path

import pytest

from pmsmtool.errors import ConfigError
from pmsmtool.resources import data_folder
from pmsmtool.sim.channel import erase_memory


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
