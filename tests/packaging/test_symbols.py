# SPDX-License-Identifier: MIT
"""Reading exports: on libraries that a compiler makes here, and on PE and Mach-O files made by hand."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import pytest

from pmsmtool.packaging import compiler, cross_wheels
from pmsmtool.packaging.compiler import COMPILE_FLAGS, TARGETS, Target
from pmsmtool.packaging.cross_wheels import Binary, read_binary

SOURCE = """\
#include <string.h>
extern int pmsm_elsewhere(int);
static int inside(int x) { return x * 3; }
int hidden(int x) { return inside(x) + pmsm_elsewhere(x); }
__attribute__((visibility("default"))) int pmsm_shown(int x) { return hidden(x); }
"""


@pytest.mark.skipif(sys.platform != "linux", reason="ELF")
def test_elf_object_tells_shown_hidden_and_missing(tmp_path: Path) -> None:
    (tmp_path / "x.c").write_text(SOURCE)
    try:
        found = compiler.build_compiler()
    except compiler.CompilerError as error:
        pytest.skip(f"no compiler: {error}")
    command = [*found.command, *COMPILE_FLAGS, "-c", "x.c", "-o", "x.o"]
    subprocess.run(command, cwd=tmp_path, check=True)
    binary = read_binary((tmp_path / "x.o").read_bytes())
    assert binary.exported == {"pmsm_shown"}
    assert binary.external == {"pmsm_shown", "hidden"}
    assert binary.undefined == {"pmsm_elsewhere"}
    assert (binary.platform, binary.signed) == ("linux", False)


def pe_file(names: list[bytes], machine: int = 0x8664) -> bytes:
    """A PE32+ image with one section that holds an export directory (PE/COFF specification, section 6.3)."""
    section, raw = 0x1000, 0x200
    texts = bytearray()
    pointers = b""
    for name in names:
        pointers += struct.pack("<I", section + 40 + 4 * len(names) + len(texts))
        texts += name + b"\0"
    directory = struct.pack("<IIHHIIIIIII", 0, 0, 0, 0, 0, 1, len(names), len(names), 0, section + 40, 0)
    body = directory + pointers + bytes(texts)
    optional = struct.pack("<H", 0x20B).ljust(112, b"\0") + struct.pack("<II", section, len(body))
    header = b"PE\0\0" + struct.pack("<HHIIIHH", machine, 1, 0, 0, 0, len(optional), 0x2000)
    table = b".edata\0\0" + struct.pack("<IIII", len(body), section, len(body), raw) + bytes(16)
    head = b"MZ".ljust(0x3C, b"\0") + struct.pack("<I", 0x40) + header + optional + table
    return head.ljust(raw, b"\0") + body


def macho_file(machine: int = 0x0100000C, *, signed: bool) -> bytes:
    """A 64-bit dylib with an export trie of _pmsm_a and _pmsm_bc, and a symbol table with one undefined name."""
    trie = bytearray(b"\0\1_pmsm_\0")  # root: not a symbol, one edge "_pmsm_" to the node behind it
    trie.append(len(trie) + 1)
    inner = len(trie)
    edges = [b"a", b"bc"]
    leaves_at = inner + 2 + sum(len(edge) + 2 for edge in edges)
    trie += b"\0" + bytes([len(edges)])
    for k, edge in enumerate(edges):
        trie += edge + b"\0" + bytes([leaves_at + 4 * k])
    trie += b"\2\0\1\0" * len(edges)  # leaf: two bytes of terminal information, no edges
    strings = b"\0_memcpy\0"
    symbol = struct.pack("<IBBHQ", 1, 0x01, 0, 0, 0)
    commands = 2 + signed
    data_at = 32 + 16 + 24 + (16 if signed else 0)
    trie_command = struct.pack("<IIII", 0x80000033, 16, data_at, len(trie))
    symbols_at = data_at + len(trie)
    table = struct.pack("<IIIIII", 0x2, 24, symbols_at, 1, symbols_at + len(symbol), len(strings))
    signature = struct.pack("<IIII", 0x1D, 16, 0, 0) if signed else b""
    head = b"\xcf\xfa\xed\xfe" + struct.pack("<IIIIIII", machine, 0, 6, commands, 0, 0, 0)
    return head + trie_command + table + signature + bytes(trie) + symbol + strings


def test_pe_exports() -> None:
    binary = read_binary(pe_file([b"pmsm_a", b"pmsm_bc"]))
    assert (binary.platform, binary.machine) == ("win32", "x86_64")
    assert binary.exported == {"pmsm_a", "pmsm_bc"}
    assert read_binary(pe_file([b"pmsm_a"], 0xAA64)).machine == "aarch64"


def test_macho_exports() -> None:
    binary = read_binary(macho_file(signed=True))
    assert (binary.platform, binary.machine, binary.signed) == ("darwin", "aarch64", True)
    assert binary.exported == {"pmsm_a", "pmsm_bc"}
    assert binary.undefined == {"memcpy"}
    assert not read_binary(macho_file(0x01000007, signed=False)).signed


@pytest.mark.parametrize(
    "data", [b"", b"\x7fELF\x01\x01", b"\x7fELF\x02\x01\0", b"MZ\0\0", b"\xcf\xfa\xed\xfe\0", b"#!/bin/sh"]
)
def test_what_is_no_library_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"not a 64-bit library|damaged binary"):
        read_binary(data)


def library(platform: str, machine: str, names: set[str], *, signed: bool = True) -> Binary:
    shown = frozenset(names)
    return Binary(platform, machine, shown, shown, frozenset(), signed)


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_library_faults(target: Target) -> None:
    def faults(binary: Binary) -> str:
        return "; ".join(cross_wheels.library_faults("libx", binary, target))

    right = target.platform, target.machine
    assert faults(library(*right, {"pmsm_a"})) == ""
    assert "exports names without the prefix" in faults(library(*right, {"pmsm_a", "step"}))
    assert "exports nothing" in faults(library(*right, set()))
    assert "not for" in faults(library(target.platform, "riscv64", {"pmsm_a"}))
    unsigned = faults(library(*right, {"pmsm_a"}, signed=False))
    assert unsigned == ("libx has no code signature" if target.name == "macos-arm64" else "")
