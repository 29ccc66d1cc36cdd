# SPDX-License-Identifier: MIT
"""Non-volatile memory: power may fail after every write step."""

import os
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pmsmtool.errors import ConfigError
from pmsmtool.sim.node.memory import PAGE_BYTES, SLOT_BYTES, FileStorage, Memory, RamStorage, Storage
from tests.node.bench import steps_of

ROOT = Path(__file__).parents[2]
OLD = random.Random(1).randbytes(5 * PAGE_BYTES + 13)
NEW = random.Random(2).randbytes(7 * PAGE_BYTES)


def storages(tmp_path: Path) -> list[Storage]:
    return [RamStorage(), FileStorage(tmp_path / "folder" / "drive.nv")]


def store_all(memory: Memory, content: bytes) -> int:
    return sum(1 for _ in memory.store(content))


@pytest.mark.parametrize("kind", [0, 1])
def test_what_is_stored_is_read_back_by_a_fresh_memory(tmp_path: Path, kind: int) -> None:
    storage = storages(tmp_path)[kind]
    assert Memory(storage).load() is None
    for content in (OLD, NEW, b"", b"x", OLD):
        assert store_all(Memory(storage), content) == steps_of(content)
        assert Memory(storage).load() == content


@pytest.mark.parametrize("kind", [0, 1])
def test_power_cut_after_every_step_leaves_old_or_new(tmp_path: Path, kind: int) -> None:
    outcomes = []
    for step in range(steps_of(NEW) + 1):
        storage = storages(tmp_path / str(step))[kind]
        store_all(Memory(storage), b"older still")
        store_all(Memory(storage), OLD)
        writing = Memory(storage).store(NEW)
        for _ in range(step):
            next(writing)
        outcomes.append(Memory(storage).load())
    assert outcomes == [OLD] * steps_of(NEW) + [NEW]


def test_power_cut_inside_a_write_leaves_old_or_new() -> None:
    """A page or header that was written only in part, at every length, still leaves the old content."""

    class Cut(RamStorage):
        budget = 1 << 60

        def write(self, offset: int, data: bytes, *, durable: bool) -> None:
            data = data[: max(0, self.budget)]
            self.budget -= len(data)
            super().write(offset, data, durable=durable)

    total = 20 + 300 + 20
    seen = set()
    for budget in range(total + 1):
        storage = Cut()
        store_all(Memory(storage), b"older")
        store_all(Memory(storage), b"old")
        storage.budget = budget
        store_all(Memory(storage), b"n" * 300)
        held = Memory(storage).load()
        assert held in (b"old", b"n" * 300)
        seen.add(held)
    assert len(seen) == 2


WRITER = """
import sys
from pathlib import Path
from pmsmtool.sim.node.memory import FileStorage, Memory
memory = Memory(FileStorage(Path(sys.argv[1])))
number = 0
while True:
    number += 1
    for _ in memory.store(bytes([number % 251]) * 20000):
        pass
    print(number, flush=True)
"""


@pytest.mark.chain
@pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL")
def test_a_killed_process_leaves_a_whole_content(tmp_path: Path) -> None:
    """Ten kills at random moments: what is found is one of the contents that were being written, entire."""
    generator = random.Random(5)
    for number in range(10):
        path = tmp_path / f"{number}.nv"
        process = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, cwd=ROOT)
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(generator.uniform(0.0, 0.03))
        process.kill()
        process.wait()
        process.stdout.close()
        held = Memory(FileStorage(path)).load()
        assert held is not None
        assert len(held) == 20000
        assert len(set(held)) == 1


def test_an_interrupted_store_does_not_spoil_the_next_one() -> None:
    storage = RamStorage()
    store_all(Memory(storage), OLD)
    for step in range(1, steps_of(NEW)):
        writing = Memory(storage).store(NEW)
        for _ in range(step):
            next(writing)
        assert Memory(storage).load() == OLD
    store_all(Memory(storage), NEW)
    assert Memory(storage).load() == NEW


def test_every_flipped_byte_of_the_newest_slot_brings_back_the_other(tmp_path: Path) -> None:
    path = tmp_path / "drive.nv"
    memory = Memory(FileStorage(path))
    store_all(memory, b"old content")
    store_all(memory, b"new content")
    image = path.read_bytes()
    for position in [*range(SLOT_BYTES, SLOT_BYTES + 20), *range(SLOT_BYTES + PAGE_BYTES, len(image))]:
        damaged = bytearray(image)
        damaged[position] ^= 0x10
        path.write_bytes(damaged)
        assert memory.load() == b"old content"
    assert not memory.is_damaged()


def test_damage_of_both_slots_is_known_from_a_blank_memory(tmp_path: Path) -> None:
    path = tmp_path / "drive.nv"
    memory = Memory(FileStorage(path))
    assert not memory.is_damaged()
    store_all(memory, OLD)
    path.write_bytes(b"\xff" * 100)
    assert memory.load() is None
    assert memory.is_damaged()


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="needs a user whom permissions bind")
def test_read_only_folder_is_one_clear_error(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(ConfigError, match="nv="):
        store_all(Memory(FileStorage(tmp_path / "x" / "drive.nv")), OLD)


def test_a_path_that_is_a_folder_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="memory cannot be used"):
        Memory(FileStorage(tmp_path)).load()


def test_content_that_does_not_fit_is_refused_before_anything_is_written() -> None:
    memory = Memory(RamStorage())
    store_all(memory, OLD)
    with pytest.raises(ValueError, match="do not fit"):
        memory.store(bytes(SLOT_BYTES))
    assert memory.load() == OLD
