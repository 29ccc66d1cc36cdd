# SPDX-License-Identifier: MIT
"""Build and check the wheels of every platform on one machine.

``python -m pmsmtool.packaging.cross_wheels --out DIR``, in a checkout; needs the extra ``cross`` (the pinned
ziglang, setuptools, and LIEF, which reads what a library exports) and nothing else.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import ctypes
import enum
import hashlib
import importlib.metadata
import io
import os
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pmsmtool.native import PAGE_MODULE, library_name
from pmsmtool.packaging import backend
from pmsmtool.packaging.backend import package_files
from pmsmtool.packaging.build_kernels import PACKAGE
from pmsmtool.packaging.compiler import KERNELS, TARGETS, CompilerError, Target, here, zig_compiler

_MACHINES = {"X86_64": "x86_64", "AMD64": "x86_64", "AARCH64": "aarch64", "ARM64": "aarch64"}
"""LIEF's names of what is built for."""


@dataclass(frozen=True, slots=True)
class Binary:
    """What the linker of another program sees."""

    platform: str
    """``linux``, ``win32`` or ``darwin``, as ``sys.platform``."""
    machine: str
    """``x86_64`` or ``aarch64``; LIEF's name of any other."""
    exported: frozenset[str]
    """Visible symbols the file defines."""
    external: frozenset[str]
    """Symbols with external linkage the file defines, hidden ones too (ELF object files; else as ``exported``)."""
    undefined: frozenset[str]
    """Symbols the file needs from elsewhere (not for PE)."""
    signed: bool = False
    """Mach-O with a code signature, without which an Apple-silicon machine refuses to load it."""


def read_binary(data: bytes) -> Binary:
    """Return the facts of a library or object file.

    Raises ValueError: not a 64-bit ELF, PE or Mach-O file.
    """
    import lief  # of the extra "cross"

    lief.logging.disable()
    file = lief.parse(io.BytesIO(data))
    if isinstance(file, lief.ELF.Binary) and file.header.machine_type == lief.ELF.ARCH.NONE:
        raise ValueError("damaged binary: its header ends early")
    if isinstance(file, lief.ELF.Binary) and file.header.identity_class == lief.ELF.Header.CLASS.ELF64:
        loose = file.header.file_type == lief.ELF.Header.FILE_TYPE.REL
        symbols = [one for one in (file.symtab_symbols if loose else file.dynamic_symbols) if one.name]
        symbols = [one for one in symbols if one.binding != lief.ELF.Symbol.BINDING.LOCAL]
        external = [one for one in symbols if one.shndx]
        shown = [one for one in external if one.visibility != lief.ELF.Symbol.VISIBILITY.HIDDEN]
        missing = [one for one in symbols if not one.shndx]
        machine = _machine(file.header.machine_type)
        return Binary("linux", machine, _names(shown), _names(external), _names(missing))
    if isinstance(file, lief.PE.Binary) and file.optional_header.magic == lief.PE.PE_TYPE.PE32_PLUS:
        names = _names(file.exported_functions)
        return Binary("win32", _machine(file.header.machine), names, names, frozenset())
    if isinstance(file, lief.MachO.Binary) and (trie := file.dyld_exports_trie or file.dyld_info):
        # The C compiler of this platform puts an underscore before every name.
        names = _names((one.symbol for one in trie.exports), "_")
        undefined = _names(file.imported_symbols, "_")
        return Binary("darwin", _machine(file.header.cpu_type), names, names, undefined, file.has_code_signature)
    raise ValueError(f"not a 64-bit library: starts with {data[:6].hex()}")


def _names(symbols: Iterable[Any], before: str = "") -> frozenset[str]:
    return frozenset(str(symbol.name).removeprefix(before) for symbol in symbols)


def _machine(kind: enum.Enum) -> str:
    return _MACHINES.get(kind.name, kind.name)


SYMBOL_PREFIX = "pmsm_"
LINKER_SYMBOLS = frozenset({"__dso_handle", "_mh_dylib_header"})
"""What zig's Mach-O linker adds to every library; macOS looks names up per library, so they meet no others."""


def library_faults(name: str, binary: Binary, target: Target) -> list[str]:
    """Return what is wrong with one library of a wheel."""
    faults = []
    if (binary.platform, binary.machine) != (target.platform, target.machine):
        faults.append(f"{name} is for {binary.platform} {binary.machine}, not for {target.name}")
    if not binary.exported:
        faults.append(f"{name} exports nothing")
    own = binary.exported - LINKER_SYMBOLS if target.platform == "darwin" else binary.exported
    foreign = sorted(symbol for symbol in own if not symbol.startswith(SYMBOL_PREFIX))
    if foreign:
        faults.append(f"{name} exports names without the prefix {SYMBOL_PREFIX}: {', '.join(foreign)}")
    if (target.platform, target.machine) == ("darwin", "aarch64") and not binary.signed:
        faults.append(f"{name} has no code signature")
    return faults


def record_faults(archive: zipfile.ZipFile) -> list[str]:
    """Return the entries of a wheel that its RECORD does not describe."""
    names = archive.namelist()
    record_name = next(name for name in names if name.endswith(".dist-info/RECORD"))
    stated = {}
    for line in archive.read(record_name).decode("utf-8").splitlines():
        name, digest, _ = line.rsplit(",", 2)
        stated[name] = digest
    faults = []
    for name in names:
        actual = base64.urlsafe_b64encode(hashlib.sha256(archive.read(name)).digest()).rstrip(b"=").decode("ascii")
        if name != record_name and stated.get(name) != f"sha256={actual}":
            faults.append(f"RECORD does not describe {name}")
    return faults


def wheel_faults(wheel: Path, target: Target, root: Path) -> tuple[list[str], dict[str, frozenset[str]]]:
    """Return what is wrong with a wheel, and kernel -> exported symbols."""
    expected = set(package_files(root))
    kernels = [kernel for kernel in KERNELS if kernel.source_files(root / "pmsmtool")]
    expected |= {f"pmsmtool/_native/{library_name(kernel.name, target.platform)}" for kernel in kernels}
    expected.add(f"pmsmtool/_native/{PAGE_MODULE}")
    symbols: dict[str, frozenset[str]] = {}
    with zipfile.ZipFile(wheel) as archive:
        faults = record_faults(archive)
        present = {name for name in archive.namelist() if ".dist-info/" not in name}
        faults += [f"missing: {name}" for name in sorted(expected - present)]
        faults += [f"not expected: {name}" for name in sorted(present - expected)]
        for kernel in kernels:
            name = library_name(kernel.name, target.platform)
            binary = read_binary(archive.read(f"pmsmtool/_native/{name}"))
            faults += library_faults(name, binary, target)
            symbols[kernel.name] = binary.exported - LINKER_SYMBOLS
        if target == here():
            faults += _load_faults(archive, symbols)
    return faults, symbols


def _load_faults(archive: zipfile.ZipFile, symbols: dict[str, frozenset[str]]) -> list[str]:
    """Load the libraries of the wheel for this machine and look every symbol up."""
    faults = []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        for kernel, names in symbols.items():
            path = archive.extract(f"pmsmtool/_native/{library_name(kernel)}", scratch)
            try:
                library = ctypes.CDLL(path)
                for name in names:
                    getattr(library, name)
            except (OSError, AttributeError) as error:
                faults.append(f"{kernel} does not load on this machine: {error}")
    return faults


def write_metadata(root: Path, folder: Path) -> Path:
    """Return the ``.dist-info`` folder of the checkout, made by the build backend in ``folder``."""
    previous = Path.cwd()
    os.chdir(root)  # the backend's contract (PEP 517): it runs in the source tree
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # setuptools tells every step
            return folder / backend.prepare_metadata_for_build_wheel(str(folder))
    finally:
        os.chdir(previous)


def _check_compiler_pin(root: Path) -> None:
    requirement = backend.ziglang_requirement(root)
    zig_compiler(None)  # says how to install it where it is missing
    found = importlib.metadata.version("ziglang")
    if requirement != f"ziglang=={found}":
        raise CompilerError(f"ziglang {found} is installed, the kernels are pinned to {requirement}")


def build_and_check(targets: Sequence[Target], root: Path, out: Path) -> bool:
    """Build the wheels, print a line for each, and return whether all are right."""
    good = True
    reference: dict[str, frozenset[str]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        metadata = write_metadata(root, Path(scratch))
        for target in targets:
            start = time.perf_counter()
            compiler = zig_compiler(target)
            wheel = backend.wheel_for(out, root, metadata, compiler, target.platform, target.wheel_tag, strict=True)
            faults, symbols = wheel_faults(wheel, target, root)
            reference = reference or symbols
            differing = (name for name in symbols if symbols[name] != reference[name])
            faults += [f"{name}: other symbols than in the first wheel" for name in differing]
            loaded = "loaded here" if target == here() else "not loaded (other platform)"
            print(
                f"{wheel.name}: {wheel.stat().st_size / 1024:.0f} KiB, {len(symbols)} kernels, "
                f"{sum(map(len, symbols.values()))} symbols, {time.perf_counter() - start:.1f} s, {loaded}: "
                f"{'NOT OK' if faults else 'ok'}"
            )
            for fault in faults:
                print(f"  {fault}")
            good = good and not faults
    return good


def main(argv: Sequence[str] | None = None) -> int:
    """Build, check and list the wheels; exit 1 when one of them is not right."""
    parser = argparse.ArgumentParser(description="Build and check the wheels of every platform on this machine.")
    parser.add_argument("--out", type=Path, required=True, help="folder for the wheels")
    parser.add_argument("--target", action="append", choices=[target.name for target in TARGETS])
    options = parser.parse_args(argv)
    root = PACKAGE.parent
    if not (root / "pyproject.toml").is_file():
        parser.error("run this in a checkout of pmsmtool, not in an installation")
    out = options.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    try:
        _check_compiler_pin(root)
        good = build_and_check([row for row in TARGETS if not options.target or row.name in options.target], root, out)
    except CompilerError as error:
        print(error, file=sys.stderr)
        return 1
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
