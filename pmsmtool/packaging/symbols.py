# SPDX-License-Identifier: MIT
"""Read what a shared library or object file exports: ELF, PE and Mach-O, 64-bit little-endian, with struct alone.

Enough to check a cross-built wheel on a machine that has no binutils for the target. Layouts: System V ABI
(ELF-64), Microsoft PE/COFF specification, Apple ``mach-o/loader.h`` and ``nlist.h``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

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
