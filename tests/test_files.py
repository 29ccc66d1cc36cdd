# SPDX-License-Identifier: MIT
"""Whole files: what is too large is not read; what is written is there as a whole, and no planted link is followed."""

import os
import secrets
import sys
from pathlib import Path

import numpy as np
import pytest

from pmsmtool.cli.main import run
from pmsmtool.errors import ConfigError
from pmsmtool.files import read_bytes, read_text, refuse_existing, write_file
from pmsmtool.run_directory import RUN_ROOM, RunDirectory, new_record
from pmsmtool.trace import Trace, write_trace


def test_a_file_larger_than_the_limit_is_refused(tmp_path):
    path = tmp_path / "a.toml"
    path.write_bytes(b"x" * 101)
    assert read_bytes(path, largest=101) == b"x" * 101
    with pytest.raises(ConfigError, match="more than"):
        read_bytes(path, largest=100)


def test_an_endless_device_ends_at_the_limit():
    with pytest.raises(ConfigError, match="more than"):
        read_text("/dev/zero")


def test_line_ends_of_any_kind_are_one_kind(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(b"a\r\nb\rc\n")
    assert read_text(path) == "a\nb\nc\n"


TRACE = Trace(np.array([0.0, 1.0]), {"i_a": np.array([1.0, 2.0])}, {"i_a": "A"}, {})
WRITERS = {
    "trace": lambda path: write_trace(TRACE, path),
    "file": lambda path: write_file(path, "new"),
    "run": lambda path: RunDirectory(path.parent).save(path.name, "new"),
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_a_link_planted_at_the_temporary_name_is_never_followed(tmp_path, write):
    """Both names that were used before; the name now holds 48 random bits and is opened exclusively."""
    victim, path = tmp_path / "victim", tmp_path / "out.csv"
    victim.write_text("precious")
    for name in (f"{path.name}.part", f".{path.name}.part", f".{path.name}.{os.getpid()}.part"):
        (tmp_path / name).symlink_to(victim)
    write(path)
    assert victim.read_text() == "precious"
    assert path.read_bytes() not in (b"", b"precious") and not path.is_symlink()


def test_a_guessed_temporary_name_is_refused_not_followed(tmp_path, monkeypatch):
    victim, path = tmp_path / "victim", tmp_path / "out"
    victim.write_text("precious")
    monkeypatch.setattr(os, "urandom", bytes)
    (tmp_path / f".out.{bytes(6).hex()}.part").symlink_to(victim)
    with pytest.raises(ConfigError, match="cannot be written"):
        write_file(path, secrets.token_hex(4))
    assert victim.read_text() == "precious" and not path.exists()


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "out"
    path.write_text("old")
    monkeypatch.setattr(os, "replace", lambda *names: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(ConfigError, match="No space left"):
        write_file(path, "new", synced=True)
    assert path.read_text() == "old" and [found.name for found in tmp_path.iterdir()] == ["out"]


def test_what_must_last_is_on_the_disk_before_it_takes_the_name_and_the_name_after(tmp_path, monkeypatch):
    done = []
    for name in ("fsync", "replace"):
        real = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *given, name=name, real=real: (done.append(name), real(*given))[1])
    write_file(tmp_path / "a.toml", "a")
    assert done == ["replace"]
    done.clear()
    write_file(tmp_path / "a.toml", "b", synced=True)
    assert done == ["fsync", "replace", "fsync"]


def test_the_usual_rights_of_a_new_file_are_kept(tmp_path):
    (tmp_path / "usual").touch()
    write_file(tmp_path / "ours", b"")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "usual").stat().st_mode


@pytest.mark.parametrize(("typed", "asked"), [("motr.toml", "motor.toml"), ("motor", "motor.toml"), ("q.bin", "")])
def test_a_missing_file_asks_for_the_near_one(tmp_path, typed, asked):
    (tmp_path / "motor.toml").touch()
    with pytest.raises(ConfigError, match="no such file") as caught:
        read_text(tmp_path / typed)
    assert caught.value.likely == (f"did you mean {tmp_path / asked}?" if asked else "")


def test_a_missing_folder_is_no_full_disk(tmp_path):
    with pytest.raises(ConfigError) as caught:
        write_file(tmp_path / "none" / "out", b"")
    assert caught.value.likely == f"there is no folder {tmp_path / 'none'}"


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="no folder here that takes no files")
def test_a_folder_that_takes_no_files_is_not_said_to_be_missing():
    with pytest.raises(ConfigError) as caught:
        write_file(Path("/proc/out"), b"")
    assert caught.value.likely == "a read-only or full disk"


def test_another_encoding_is_named(tmp_path):
    (tmp_path / "m.toml").write_bytes("name = 'ü'".encode("utf-16"))
    with pytest.raises(ConfigError, match="byte 1 is not UTF-8") as caught:
        read_text(tmp_path / "m.toml")
    assert "UTF-16" in caught.value.likely


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of a file's size there")
def test_a_full_disk_is_found_before_a_run_begins(tmp_path):
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (RUN_ROOM // 2, before[1]))
    try:
        with pytest.raises(ConfigError, match="cannot be written"):
            RunDirectory.create(tmp_path, 1, new_record((), drive={}, bus={}, versions={}))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "command",
    [
        "machine new --name m --pole-pairs 4 --r 1ohm --l 1mH --ke 0.1Wb --u-dc 48V --pwm 10kHz",
        "backup", "param dump", "scope", "sim clone m.toml", "map learn --machine m.toml", "move --by 9deg",
    ],
)  # fmt: skip
def test_what_files_cannot_give_again_is_not_replaced(command, tmp_path, monkeypatch, capsys):
    """Before any bus is opened: there is none here."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old.csv").write_text("precious")
    assert run([*command.split(), "-o", "old.csv"]) == 2
    assert "the file exists" in capsys.readouterr().err and (tmp_path / "old.csv").read_text() == "precious"
    assert run([*command.split(), "-o", "none/new.csv"]) == 2
    assert "no such folder" in capsys.readouterr().err
    refuse_existing(Path("/dev/stdout"), force=False)


@pytest.mark.parametrize("command", ["tune d.toml", "export params d.toml", "machine map d.toml"])
def test_what_a_file_is_made_from_is_not_replaced(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    name = "d.toml" if "map" not in command else "d.csv"
    (tmp_path / name).write_text("precious")
    assert run([*command.replace("d.toml", name).split(), "-o", f"./{name}"]) == 2
    assert "this is the file that is read" in capsys.readouterr().err and (tmp_path / name).read_text() == "precious"


def test_a_path_in_another_encoding_does_not_end_a_report(tmp_path):
    """A machine file named in Latin-1 ended `commission` with a traceback, after the drive was written."""
    path = tmp_path / "report.html"
    write_file(path, "Mot\udcf6r.toml")
    assert path.read_text(encoding="utf-8") == "Mot\\udcf6r.toml"
