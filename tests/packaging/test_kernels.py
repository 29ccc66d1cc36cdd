# SPDX-License-Identifier: MIT
"""The compiled kernels: what they export, what they need, and that a warning stops a development build."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from pmsmtool import native
from pmsmtool.errors import PmsmtoolError
from pmsmtool.packaging import build_kernels, compiler, cross_wheels
from pmsmtool.packaging.compiler import KERNELS, Kernel, here
from pmsmtool.packaging.cross_wheels import read_binary

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "pmsmtool"

NEEDED_OF_LIBC = frozenset({"memcpy", "memmove", "memset", "memcmp", "sqrt", "sqrtf"})
"""What a compiler may call on its own account; a target's own library has them too."""


@pytest.fixture(scope="module")
def working_compiler() -> compiler.Compiler:
    try:
        return compiler.build_compiler()
    except compiler.CompilerError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda kernel: kernel.name)
def test_every_glob_finds_sources(kernel: Kernel) -> None:
    for pattern in kernel.sources:
        assert list(PACKAGE.glob(pattern)), f"{kernel.name}: {pattern} finds nothing"


@pytest.mark.chain
@pytest.mark.parametrize("kernel", KERNELS, ids=lambda kernel: kernel.name)
def test_kernel_compiles_without_a_warning_and_exports_only_its_prefix(
    kernel: Kernel, working_compiler: compiler.Compiler, tmp_path: Path
) -> None:
    """Without defines of its own, its sources are compiled below, and its library is the one that is built."""
    library = native.LIBRARY_FOLDER / native.library_name(kernel.name)
    if kernel.defines or not compiler.is_current(library, kernel, PACKAGE):
        library = tmp_path / library.name
        compiler.compile_library(working_compiler, kernel, PACKAGE, library, strict=True)
        assert [path.name for path in tmp_path.iterdir()] == [library.name]
    target = here()
    if target is not None:
        assert cross_wheels.library_faults(library.name, read_binary(library.read_bytes()), target) == []


@pytest.mark.chain
@pytest.mark.parametrize("source", sorted({s for kernel in KERNELS for s in kernel.source_files(PACKAGE)}), ids=str)
def test_each_source_compiles_without_a_warning_and_its_symbols_have_the_prefix(
    source: Path, working_compiler: compiler.Compiler, tmp_path: Path
) -> None:
    """Linked statically into a firmware, hidden symbols meet those of others as well: every one has the prefix."""
    target = tmp_path / "unit.o"
    includes = [part for folder in compiler.INCLUDE_FOLDERS for part in ("-iquote", folder)]
    flags = (*compiler.COMPILE_FLAGS, *compiler.WARNING_FLAGS, *working_compiler.tolerated)
    command = [*working_compiler.command, *flags, *includes, "-c", source.as_posix(), "-o", str(target)]
    subprocess.run(command, cwd=PACKAGE, check=True)
    data = target.read_bytes()
    if data[:4] != b"\x7fELF":
        pytest.skip("object files are read on ELF systems only")
    binary = read_binary(data)
    assert binary.external
    assert {name for name in binary.external if not name.startswith("pmsm_")} == set()
    if source.parts[0] == "firmware":
        outside = {name for name in binary.undefined if not name.startswith("pmsm_")}
        assert outside <= NEEDED_OF_LIBC


def test_a_warning_is_an_error_only_in_strict_builds(working_compiler: compiler.Compiler, tmp_path: Path) -> None:
    (tmp_path / "x.c").write_text("float pmsm_x(double a);\nfloat pmsm_x(double a) { return a; }\n")
    kernel = Kernel("x", ("x.c",))
    library = tmp_path / native.library_name("x")
    compiler.compile_library(working_compiler, kernel, tmp_path, library)
    assert library.is_file()
    with pytest.raises(compiler.CompilerError, match=r"x\.c"):
        compiler.compile_library(working_compiler, kernel, tmp_path, library, strict=True)


def test_a_missing_function_is_found_when_linking(working_compiler: compiler.Compiler, tmp_path: Path) -> None:
    (tmp_path / "x.c").write_text("int pmsm_elsewhere(void);\nint pmsm_x(void) { return pmsm_elsewhere(); }\n")
    with pytest.raises(compiler.CompilerError, match="pmsm_elsewhere"):
        compiler.compile_library(working_compiler, Kernel("x", ("x.c",)), tmp_path, tmp_path / native.library_name("x"))


@pytest.mark.chain
def test_same_source_same_bytes(working_compiler: compiler.Compiler, tmp_path: Path) -> None:
    """Also from another folder: no path of the building machine gets into a library."""
    kernel, libraries = Kernel("x", ("x.c", "part/y.c")), []
    for name in ("one", "another-place"):
        (tmp_path / name / "part").mkdir(parents=True)
        (tmp_path / name / "x.c").write_text("char const *pmsm_x(void) { return __FILE__; }\n")
        (tmp_path / name / "part" / "y.c").write_text("char const *pmsm_y(void) { return __FILE__; }\n")
        library = tmp_path / name / native.library_name(kernel.name)
        compiler.compile_library(working_compiler, kernel, tmp_path / name, library)
        libraries.append(library.read_bytes())
    assert libraries[0] == libraries[1]


def test_build_keeps_what_is_current_and_skips_kernels_without_sources(
    working_compiler: compiler.Compiler, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "x.c").write_text("int pmsm_x(void);\nint pmsm_x(void) { return 1; }\n")
    rows = (Kernel("x", ("x.c",)), Kernel("y", ("none/*.c",)))
    folder = tmp_path / "built"
    first = build_kernels.build_all(tmp_path, folder, working_compiler, kernels=rows)
    assert [path.name for path in first] == [native.library_name("x")]
    printed = capsys.readouterr().err
    assert "compiled by" in printed
    assert "y: no sources match none/*.c, not built" in printed
    build_kernels.build_all(tmp_path, folder, working_compiler, kernels=rows[:1])
    assert capsys.readouterr().err == ""
    build_kernels.build_all(tmp_path, folder, working_compiler, kernels=rows[:1], force=True)
    assert "compiled by" in capsys.readouterr().err


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda kernel: kernel.name)
def test_built_kernel_loads(kernel: Kernel) -> None:
    library = native.load(kernel.name)
    assert library is native.load(kernel.name)


def test_missing_or_damaged_kernel_says_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(native, "LIBRARY_FOLDER", tmp_path)
    with pytest.raises(PmsmtoolError, match="build_kernels") as missing:
        native.load("pmsm_absent")
    assert str(tmp_path) in missing.value.where
    # after `pip install .`, Python in the clone's folder imports the sources, which have no kernels
    assert "hides the installed" in missing.value.likely and "another folder" in missing.value.hint
    (tmp_path / native.library_name("pmsm_damaged")).write_bytes(b"not a library")
    with pytest.raises(PmsmtoolError, match="another machine"):
        native.load("pmsm_damaged")
