# SPDX-License-Identifier: MIT
"""Build and check the wheels of every platform on one machine.

``python -m pmsmtool.packaging.cross_wheels --out DIR``, in a checkout; needs the extra ``cross`` (the pinned
ziglang and setuptools) and nothing else.

What a library exports is read with struct alone (64-bit little-endian), as no binutils for the target are here.
Layouts: System V ABI (ELF-64), Microsoft PE/COFF specification, Apple ``mach-o/loader.h`` and ``nlist.h``.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import ctypes
import hashlib
import importlib.metadata
import io
import os
import struct
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pmsmtool.native import PAGE_MODULE, library_name
from pmsmtool.packaging import backend
from pmsmtool.packaging.backend import package_files
from pmsmtool.packaging.build_kernels import PACKAGE
from pmsmtool.packaging.compiler import KERNELS, TARGETS, CompilerError, Target, here, zig_compiler

_ELF_MACHINE = {62: "x86_64", 183: "aarch64"}
_PE_MACHINE = {0x8664: "x86_64", 0xAA64: "aarch64"}
_MACHO_MACHINE = {0x01000007: "x86_64", 0x0100000C: "aarch64"}

_SHT_SYMTAB, _SHT_DYNSYM = 2, 11
_STB_LOCAL, _STV_HIDDEN = 0, 2
_LC_SYMTAB, _LC_CODE_SIGNATURE, _LC_DYLD_INFO_ONLY, _LC_DYLD_EXPORTS_TRIE = 0x2, 0x1D, 0x80000022, 0x80000033
_N_STAB, _N_TYPE, _N_EXT = 0xE0, 0x0E, 0x01


@dataclass(frozen=True, slots=True)
class Binary:
    """What the linker of another program sees.

    Attributes
    ----------
    platform : str
        ``linux``, ``win32`` or ``darwin``, as ``sys.platform``.
    machine : str
        ``x86_64`` or ``aarch64``; the raw number in hex for any other.
    exported : frozenset of str
        Visible symbols the file defines.
    external : frozenset of str
        Symbols with external linkage the file defines, hidden ones too (ELF object files; else as ``exported``).
    undefined : frozenset of str
        Symbols the file needs from elsewhere (not for PE).
    signed : bool
        Mach-O with a code signature, without which an Apple-silicon machine refuses to load it.
    """

    platform: str
    machine: str
    exported: frozenset[str]
    external: frozenset[str]
    undefined: frozenset[str]
    signed: bool = False


def read_binary(data: bytes) -> Binary:
    """Return the facts of a library or object file.

    Raises ValueError: not a 64-bit little-endian ELF, PE or Mach-O file.
    """
    try:
        if data[:6] == b"\x7fELF\x02\x01":
            return _elf(data)
        if data[:2] == b"MZ":
            return _pe(data)
        if data[:4] == b"\xcf\xfa\xed\xfe":
            return _macho(data)
    except (struct.error, IndexError) as error:
        raise ValueError(f"damaged binary: {error}") from error
    raise ValueError(f"not a 64-bit library: starts with {data[:6].hex()}")


def _string(data: bytes, offset: int) -> str:
    return data[offset : data.index(b"\0", offset)].decode("ascii")


def _elf(data: bytes) -> Binary:
    kind, machine = struct.unpack_from("<HH", data, 16)
    (section_offset,) = struct.unpack_from("<Q", data, 40)
    entry_size, count = struct.unpack_from("<HH", data, 58)
    sections = [struct.unpack_from("<IIQQQQIIQQ", data, section_offset + k * entry_size) for k in range(count)]
    table = _SHT_SYMTAB if kind == 1 else _SHT_DYNSYM  # 1: object file
    exported: set[str] = set()
    external: set[str] = set()
    undefined: set[str] = set()
    for _, section_type, _, _, offset, size, link, *_ in sections:
        if section_type != table:
            continue
        for position in range(offset, offset + size, 24):
            name_at, info, other, section, _, _ = struct.unpack_from("<IBBHQQ", data, position)
            if info >> 4 == _STB_LOCAL or not name_at:
                continue
            name = _string(data, sections[link][4] + name_at)
            if section == 0:
                undefined.add(name)
                continue
            external.add(name)
            if other & 3 != _STV_HIDDEN:
                exported.add(name)
    return Binary(
        "linux", _ELF_MACHINE.get(machine, hex(machine)), frozenset(exported), frozenset(external), frozenset(undefined)
    )


def _pe(data: bytes) -> Binary:
    (header,) = struct.unpack_from("<I", data, 0x3C)
    machine, section_count = struct.unpack_from("<HH", data, header + 4)
    (optional_size,) = struct.unpack_from("<H", data, header + 20)
    optional = header + 24
    if struct.unpack_from("<H", data, optional)[0] != 0x20B:
        raise ValueError("not a PE32+ file")
    (directory,) = struct.unpack_from("<I", data, optional + 112)
    sections = [struct.unpack_from("<IIII", data, optional + optional_size + 40 * k + 8) for k in range(section_count)]

    def at(address: int) -> int:
        for size, start, _, raw in sections:
            if start <= address < start + size:
                return int(address - start + raw)
        raise ValueError("damaged binary: an address outside every section")

    names: set[str] = set()
    if directory:
        table = at(directory)
        (count,) = struct.unpack_from("<I", data, table + 24)
        (pointers,) = struct.unpack_from("<I", data, table + 32)
        for (address,) in struct.iter_unpack("<I", data[at(pointers) : at(pointers) + 4 * count]):
            names.add(_string(data, at(address)))
    found = frozenset(names)
    return Binary("win32", _PE_MACHINE.get(machine, hex(machine)), found, found, frozenset())


def _macho_commands(data: bytes) -> Iterator[tuple[int, int]]:
    (count,) = struct.unpack_from("<I", data, 16)
    offset = 32
    for _ in range(count):
        command, size = struct.unpack_from("<II", data, offset)
        yield command, offset
        offset += size


def _uleb128(data: bytes, offset: int) -> tuple[int, int]:
    """Return an unsigned LEB128 number and the offset behind it."""
    value = shift = 0
    while True:
        byte = data[offset]
        offset += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if not byte & 0x80:
            return value, offset


def _trie_names(trie: bytes, node: int = 0, prefix: bytes = b"") -> Iterator[bytes]:
    """Names in a Mach-O export trie: what the loader finds (the symbol table also lists the linker's own names)."""
    terminal_size, offset = _uleb128(trie, node)
    if terminal_size:
        yield prefix
    offset += terminal_size
    children = trie[offset]
    offset += 1
    for _ in range(children):
        end = trie.index(b"\0", offset)
        child, behind = _uleb128(trie, end + 1)
        yield from _trie_names(trie, child, prefix + trie[offset:end])
        offset = behind


def _macho(data: bytes) -> Binary:
    (machine,) = struct.unpack_from("<I", data, 4)
    commands = dict(_macho_commands(data))
    trie_at = trie_size = 0
    if _LC_DYLD_INFO_ONLY in commands:
        trie_at, trie_size = struct.unpack_from("<II", data, commands[_LC_DYLD_INFO_ONLY] + 40)
    elif _LC_DYLD_EXPORTS_TRIE in commands:
        trie_at, trie_size = struct.unpack_from("<II", data, commands[_LC_DYLD_EXPORTS_TRIE] + 8)
    trie = data[trie_at : trie_at + trie_size]
    # The C compiler of this platform puts an underscore before every name.
    exported = frozenset(name.decode("ascii").removeprefix("_") for name in _trie_names(trie)) if trie else frozenset()
    undefined: set[str] = set()
    if _LC_SYMTAB in commands:
        symbols, count, strings, _ = struct.unpack_from("<IIII", data, commands[_LC_SYMTAB] + 8)
        for k in range(count):
            name_at, kind, _, _, _ = struct.unpack_from("<IBBHQ", data, symbols + 16 * k)
            if kind & _N_EXT and not kind & (_N_STAB | _N_TYPE):
                undefined.add(_string(data, strings + name_at).removeprefix("_"))
    return Binary(
        "darwin",
        _MACHO_MACHINE.get(machine, hex(machine)),
        exported,
        exported,
        frozenset(undefined),
        _LC_CODE_SIGNATURE in commands,
    )


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
