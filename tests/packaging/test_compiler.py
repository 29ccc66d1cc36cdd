# SPDX-License-Identifier: MIT
"""Which compiler a build takes, and what it requires where there is none."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from pmsmtool.packaging import backend, build_kernels, compiler
from pmsmtool.packaging.compiler import here

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="compilers are made of shell scripts here")


@pytest.fixture
def empty_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A PATH with nothing on it."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.chdir(ROOT)
    return folder


def install(folder: Path, name: str, body: str) -> None:
    program = folder / name
    program.write_text(f"#!/bin/sh\n{body}\n")
    program.chmod(0o755)


def real_compiler() -> compiler.Compiler:
    found, reasons = compiler.system_compiler()
    if found is None:
        pytest.skip(f"no compiler here: {'; '.join(reasons)}")
    return found


def test_no_compiler_requires_the_pinned_ziglang(empty_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    requirement = backend.get_requires_for_build_wheel()
    assert requirement == backend.get_requires_for_build_editable() == [backend.ziglang_requirement(ROOT)]
    assert requirement[0].split("==")[0] == "ziglang"
    assert "cc: not found" in capsys.readouterr().err
    assert backend.get_requires_for_build_sdist() == []


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("echo licence expired >&2; exit 1", "licence expired"),
        ("exit 0", "does not run in this Python"),
        ('for last; do :; done; echo text > "$last"', "does not run in this Python"),
    ],
)
def test_a_compiler_that_does_not_work_is_passed_over(empty_path: Path, body: str, reason: str) -> None:
    for name in compiler.CANDIDATES:
        install(empty_path, name, body)
    found, reasons = compiler.system_compiler()
    assert found is None
    assert len(reasons) == len(compiler.CANDIDATES)
    assert all(reason in text for text in reasons)


def test_the_next_candidate_is_tried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CC", raising=False)
    real = real_compiler()
    folder = tmp_path / "bin"
    folder.mkdir()
    install(folder, "cc", "exit 1")
    install(folder, "clang", f'PATH="{os.environ["PATH"]}" exec "{real.command[0]}" "$@"')
    monkeypatch.setenv("PATH", f"{folder}")
    found, reasons = compiler.system_compiler()
    assert found is not None
    assert found.name == "clang"
    assert [text.split(":")[0] for text in reasons] == ["cc", "gcc"]


def test_cc_is_obeyed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CC", raising=False)
    real = real_compiler()
    monkeypatch.setenv("CC", f"{real.command[0]} -O1")
    found, _ = compiler.system_compiler()
    assert found is not None
    assert found.command == (real.command[0], "-O1")
    assert backend.get_requires_for_build_wheel() == []


def test_the_page_of_reports_asks_for_ziglang_beside_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.delenv("CC", raising=False)
    real_compiler()
    expected = [] if here() is None else [backend.ziglang_requirement(ROOT)]
    assert backend.get_requires_for_build_wheel() == backend.get_requires_for_build_editable() == expected


def test_without_ziglang_the_page_is_left_out_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert build_kernels.build_page_module(ROOT / "pmsmtool", tmp_path) == []
    assert "reports do not recompute themselves: ziglang is not installed" in capsys.readouterr().err
    with pytest.raises(compiler.CompilerError):
        build_kernels.build_page_module(ROOT / "pmsmtool", tmp_path, strict=True)


def test_cc_that_does_not_work_is_an_error_not_a_fallback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(compiler.CompilerError, match="CC is set to a compiler that does not work here"):
        backend.get_requires_for_build_wheel()


def test_cc_zig_asks_for_ziglang(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("CC", "zig")
    assert backend.get_requires_for_build_wheel() == [backend.ziglang_requirement(ROOT)]


def test_no_compiler_and_no_ziglang_says_how_to_get_one(empty_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(compiler.CompilerError, match=r"no C compiler works here .*pip install '\.\[cross\]'"):
        compiler.build_compiler()
