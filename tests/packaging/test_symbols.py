# SPDX-License-Identifier: MIT
"""Reading exports: on libraries that a compiler makes here, and on one of each other system."""

from __future__ import annotations

import base64
import subprocess
import sys
import zlib
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


PE = (
    "eNrzjapgYGRgYGBhQAUODIRBBRDzye/iY9jCeVZxB6PPWcWQjMxihYKi/PSixFyF5MS8vPwShaRUhaLSPIXMPAUX/2CF3PyUVD0VBoYAVwaGlD"
    "YWBnOn8vMw8z4wKClwM/ExMDABOWwQMQEBEAFmNjAyQNlMcGk4zRCA8AQTQwIjTBOMwuRDmAoKDAz22DwHDAAJbOIGDAwyDNQDeiWpFSVAWhrJ"
    "b+iRAXRigl5RSmJJIgNDAVQAOYyQnOygl1SamZOSmSIDdStYHQcWdQUQ8yRgkQ1Sx4WpjmEUDGsQ6tH5tPNE7GF++RY4fwcoo8UePjMKhj/4Dw"
    "Ww9IDORwYewHIHlDRg2A/IDwLiMCCu1EvJyQGXYBGg0omhILc4Nx5YvjCyMLGyMDMGwOjRHDf4AKwOFhgNipEHgJHOAcQJCpC2ljQQZyiMBstI"
    "AQDceM7+"
)
"""`int pmsm_a(int x) { return x; }` with an entry, by ziglang 0.14.1: cc -target x86_64-windows-gnu -nostdlib -O2 -s
-shared; packed by zlib."""
MACHO = (
    "eNrt3E9oHFUcwPHfTrLJhsZkA6lJqNUatGAKSQwRKpGYtqkxqG1DggSCPnfZTXZ0/7l/NHuwLoFCD1IST9WDSimFonjQetAWTMSrjYitnkpLEY"
    "PU6kHaJJTWN7tvt5NtEj3p5fuBt29+89785je/2c0xi6u/364X8YhWo4dfj5+rRY4UjkTa9DiqV5Ua2z8+JvdIbl0/9ppRbc4rlQlPZ+7uq8y3"
    "bDY2u2LLnbha8u5QqXQmG0xvmK/ea2ZX7M7nM/nq1+RTkXA0GU6tk6/V5HvEFW9eXzb+ph0PKTs+mVgn31MmX6//bmzJxpz3cLyQZ3DP2B617+"
    "CB0WK2AfM8pY0VcZUZHvNulZpKZNbU+c/5qlz7a0wud11L5TyuBdMN/wZxqS6rXEc0oNK5WDARVclMasN8PlfsrqtW1vZPqVAgE6h8Ttf7r8jn"
    "q8i3Xv+fLeR5fvjAc/sHh0vvcn5t30vxtCnGU9Gvdl15t9nn3Nun51Y97zDXObPTo249H9LzTtOzvFl/rCJ2btNqYieff0EkouctUry+tMcyv8"
    "Ua2fx7Jgvr96HBqc38Xrqy6VRX1A52hXLRkFm/z6y3lvMXnzxn1jvc3wWtx+wv9kZX62ksHJufhWwzua7NnBpo/K3n2KefNHw489GrV5z7715z"
    "nyGvk6Vckx6juXQmHOvc26nrs4PFfNtLfdPPt+y0v0pd1P1o1udm/T3Nc2I9dPGQc2wNrDjHI/r48XaZ+3Po69PdrvN6T+vKnTstpSd8wNTrni"
    "3z96tXisNT+q2b77xfX1lffPJNXwUAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAD+e91eegAAAAAAAAAAAAAA"
    "AAAAAAAAAAAAAAAAwP+tqV1GnPl1GQjloiGVzmSDKmjHQ+GUjDTNSkoGVMxOp+34lPTP6o0eJV6xkrF0TEmTkjaxAvJkUPrFikWUTmEHVSQccC"
    "7fp0LphIoE4qFoWIarZLlOquRWnVTL0bxlPsWjUzY4H+b/EEw4ca2IL2/q06NRry9XF+M2E98ycZ8Tu/a/UBE/LMV7lHQU4/KpGj1qzVxQelql"
    "MpFs/DVRhUcNmDlYXpd72qVUZQeUcregcEEyZb8RyITL9axeqp/X01+uMpv1Od0ZuSyWfkhLnONX9Bg36/rkQn6HJQ3/7g1vTZaOcp2F6mT3zW"
    "1vLc7GWz7b+fb5R68fudaXv7F977Rn/P6lE1fG+8++ePDXL96/calvcmJq+p1vVo6/+/HM4dWrJ6d6d/WduXru2MTtL3+4sOuD2bnQe+e+zSae"
    "PrvYcfO7+dEfn/ml++XlEy2Hvx+8fjL80h9Dpy5/nrDHf/pKnojGY+eX7DNb6k7nwpMXHvQ5tfwN1yYkqw=="
)
"""The same, and `double pmsm_b(double x) { return missing(x); }`: -target aarch64-macos.11.0 -undefined
dynamic_lookup."""


def test_libraries_of_other_systems() -> None:
    dll, dylib = (read_binary(zlib.decompress(base64.b64decode(text))) for text in (PE, MACHO))
    assert dll == library("win32", "x86_64", {"pmsm_a"}, signed=False)
    assert (dylib.platform, dylib.machine, dylib.signed) == ("darwin", "aarch64", True)
    assert dylib.exported - cross_wheels.LINKER_SYMBOLS == {"pmsm_a", "pmsm_b"}
    assert "missing" in dylib.undefined


@pytest.mark.parametrize("data", [b"", b"\x7fELF\x02\x01\0", b"MZ\0\0", b"\xcf\xfa\xed\xfe\0", b"#!/bin/sh"])
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
