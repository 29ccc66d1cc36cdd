# SPDX-License-Identifier: MIT
"""What is in a wheel and in a source archive, and that the same tree gives the same bytes."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from pmsmtool import files
from pmsmtool.errors import ConfigError, PmsmtoolError
from pmsmtool.packaging import backend, cross_wheels

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def metadata(tmp_path: Path) -> Path:
    folder = tmp_path / "thing-1.0.dist-info"
    (folder / "licenses").mkdir(parents=True)
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: thing\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[console_scripts]\nthing = thing:main\n")
    (folder / "licenses" / "LICENSE").write_text("free\n")
    (folder / "RECORD").write_text("stale\n")
    return folder


def test_wheel_is_complete_described_and_reproducible(metadata: Path, tmp_path: Path) -> None:
    source = tmp_path / "a.py"
    source.write_text("x = 1\n")
    first = backend.write_wheel(
        tmp_path, metadata, "py3-none-linux_x86_64", {"thing/b.so": b"\0", "thing/a.py": source}
    )
    assert first.name == "thing-1.0-py3-none-linux_x86_64.whl"
    with zipfile.ZipFile(first) as archive:
        assert archive.namelist() == [
            "thing/a.py",
            "thing/b.so",
            "thing-1.0.dist-info/METADATA",
            "thing-1.0.dist-info/WHEEL",
            "thing-1.0.dist-info/entry_points.txt",
            "thing-1.0.dist-info/licenses/LICENSE",
            "thing-1.0.dist-info/RECORD",
        ]
        assert "Root-Is-Purelib: false\nTag: py3-none-linux_x86_64\n" in archive.read(archive.namelist()[3]).decode()
        assert cross_wheels.record_faults(archive) == []
    content = first.read_bytes()
    os.utime(source, (0, 0))
    backend.write_wheel(tmp_path, metadata, "py3-none-linux_x86_64", {"thing/a.py": source, "thing/b.so": b"\0"})
    assert first.read_bytes() == content


def test_a_changed_file_is_not_described_by_its_record(metadata: Path, tmp_path: Path) -> None:
    built = backend.write_wheel(tmp_path, metadata, "py3-none-any", {"thing/a.py": b"x = 1\n"})
    changed = tmp_path / "changed.whl"
    with zipfile.ZipFile(built) as old, zipfile.ZipFile(changed, "w") as new:
        for name in old.namelist():
            new.writestr(name, b"x = 2\n" if name == "thing/a.py" else old.read(name))
        new.writestr("thing/added.py", b"")
    with zipfile.ZipFile(changed) as archive:
        faults = cross_wheels.record_faults(archive)
    assert faults == ["RECORD does not describe thing/a.py", "RECORD does not describe thing/added.py"]


def test_source_archive_is_reproducible(metadata: Path, tmp_path: Path) -> None:
    source = tmp_path / "a.py"
    source.write_text("x = 1\n")
    first = backend.write_source_archive(tmp_path, "thing-1.0", metadata, {"thing/a.py": source, ".ci/run": source})
    content = first.read_bytes()
    with tarfile.open(first) as archive:
        assert archive.getnames() == ["thing-1.0/.ci/run", "thing-1.0/PKG-INFO", "thing-1.0/thing/a.py"]
        assert [entry.mode for entry in archive.getmembers()] == [0o755, 0o644, 0o644]
    os.utime(source, (0, 0))
    backend.write_source_archive(tmp_path, "thing-1.0", metadata, {".ci/run": source, "thing/a.py": source})
    assert first.read_bytes() == content


def tracked() -> list[str]:
    done = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        pytest.skip("not a git checkout")
    return [name for name in done.stdout.split("\0") if name and (ROOT / name).is_file()]


def test_every_tracked_file_has_its_place() -> None:
    in_wheel = set(backend.package_files(ROOT).values())
    package = [name for name in tracked() if name.startswith(("pmsmtool/", *(f"{f}/" for f in backend.DATA_FOLDERS)))]
    assert package
    assert [name for name in package if ROOT / name not in in_wheel] == []
    in_archive = set(backend.source_files(ROOT))
    assert [name for name in tracked() if name not in in_archive] == []


def test_nothing_generated_is_packed(tmp_path: Path) -> None:
    for name in ("pmsmtool/a.py", "profiles/p.toml", "pmsmtool/_native/liba.so", "pmsmtool/_data/profiles/old.toml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    (tmp_path / "pmsmtool" / "__pycache__").mkdir()
    (tmp_path / "pmsmtool" / "__pycache__" / "a.py").write_text("")
    assert set(backend.package_files(tmp_path)) == {"pmsmtool/a.py", "pmsmtool/_data/profiles/p.toml"}


@pytest.mark.parametrize("name", ["profiles", "firmware-params"])
def test_data_folder_from_either_place(name: files.DataFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "pmsmtool"
    monkeypatch.setattr(files, "_PACKAGE", package)
    with pytest.raises(PmsmtoolError, match="install pmsmtool again"):
        files.data_folder(name)
    (tmp_path / name).mkdir()
    with pytest.raises(PmsmtoolError):  # beside an installed package: somebody else's folder
        files.data_folder(name)
    (tmp_path / "pyproject.toml").write_text("")
    assert files.data_folder(name) == tmp_path / name
    (package / "_data" / name).mkdir(parents=True)
    assert files.data_folder(name) == package / "_data" / name


@pytest.mark.parametrize(
    ("platform", "environment", "expected"),
    [
        ("linux", {"PMSMTOOL_HOME": "/x"}, "/x"),
        ("linux", {"XDG_DATA_HOME": "/d"}, "/d/pmsmtool"),
        ("linux", {}, "/h/.local/share/pmsmtool"),
        ("darwin", {}, "/h/Library/Application Support/pmsmtool"),
        ("win32", {"LOCALAPPDATA": "/l"}, "/l/pmsmtool"),
        ("win32", {}, "/h/AppData/Local/pmsmtool"),
    ],
)
def test_user_folder(
    platform: str, environment: dict[str, str], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("PMSMTOOL_HOME", "XDG_DATA_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(Path, "home", lambda: Path("/h"))
    assert files.user_folder() == Path(expected)


def test_user_without_a_home_is_told_what_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("PMSMTOOL_HOME", raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    with pytest.raises(ConfigError, match="PMSMTOOL_HOME"):
        files.user_folder()
