# SPDX-License-Identifier: MIT
"""Cortex-M processors for tests and benchmarks: compile C for thumb, run it in an emulator, count instructions.

The compiler is ``arm-none-eabi-gcc`` where it is installed, else the ziglang package; the emulator is the unicorn
package. ``missing()`` names what is absent. Instruction counts are exact and repeat bit for bit. Cycles are a model,
not silicon: the weights of the Cortex-M4 technical reference manual as in the firmware reference (division and square
root 14, single load or store 2, multiple 1 + N, taken branch 3, everything else 1, one more where a floating-point
result is used by the next instruction); no flash wait states, no interrupt entry, no stacking of registers. Test code
only.
"""

from __future__ import annotations

import importlib.util
import shutil
import struct
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

FLAGS = (
    "-std=c99",
    "-Wall",
    "-Wextra",
    "-Wdouble-promotion",
    "-Wfloat-conversion",
    "-Wshadow",
    "-Werror",
    "-ffp-contract=off",
    "-fno-math-errno",
)
STACK_TOP, DATA, RETURN = 0x2010_0000, 0x2000_0000, 0x0800_0000
ARGUMENTS = 0x100
"""Room for arguments behind the top of the stack."""
ROOT = r"""
#include <stdint.h>
float sqrtf(float x);
float sqrtf(float x) /* binary32, correctly rounded, in integers; for processors without the instruction */
{
    union {
        float number;
        uint32_t word;
    } bits = {x};
    const uint32_t word = bits.word;
    int32_t exponent = (int32_t)((word >> 23) & 255u);
    if (word == 0u || word == 0x80000000u || exponent == 255) {
        return ((word >> 31) != 0u && word != 0x80000000u) ? (x - x) / (x - x) : x;
    }
    if ((word >> 31) != 0u) {
        return (x - x) / (x - x);
    }
    uint32_t m = word & 0x7FFFFFu;
    if (exponent == 0) {
        exponent = 1;
        while ((m & 0x800000u) == 0u) {
            m <<= 1;
            exponent--;
        }
    } else {
        m |= 0x800000u;
    }
    exponent -= 127;
    if ((exponent & 1) != 0) {
        m <<= 1;
        exponent--;
    }
    uint64_t rest = (uint64_t)m << 25; /* 24 bits of root and one to round by */
    uint64_t root = 0u;
    for (uint64_t bit = (uint64_t)1 << 48; bit != 0u; bit >>= 2) {
        if (rest >= root + bit) {
            rest -= root + bit;
            root = (root >> 1) + bit;
        } else {
            root >>= 1;
        }
    }
    const uint32_t rounded = (uint32_t)((root >> 1) + (root & 1u)); /* never a tie: the root would be exact */
    bits.word = rounded + ((uint32_t)(exponent / 2 + 126) << 23);
    return bits.number;
}
"""


@dataclass(frozen=True)
class Processor:
    """How the compilers call one processor."""

    name: str
    zig: tuple[str, str]
    gcc: tuple[str, ...]


PROCESSORS = {
    processor.name: processor
    for processor in (
        Processor("Cortex-M3", ("thumb-freestanding-eabi", "cortex_m3"), ("-mcpu=cortex-m3", "-mfloat-abi=soft")),
        Processor(
            "Cortex-M4F",
            ("thumb-freestanding-eabihf", "cortex_m4+vfp4d16sp"),
            ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"),
        ),
        Processor(
            "Cortex-M7",
            ("thumb-freestanding-eabihf", "cortex_m7+fp_armv8d16sp"),
            ("-mcpu=cortex-m7", "-mfpu=fpv5-sp-d16", "-mfloat-abi=hard"),
        ),
    )
}


def missing() -> str:
    """Say what is absent, or nothing."""
    lines = []
    if importlib.util.find_spec("unicorn") is None:
        lines.append("the emulator (pip install unicorn)")
    if shutil.which("arm-none-eabi-gcc") is None and importlib.util.find_spec("ziglang") is None:
        lines.append("a compiler for thumb (apt-get install gcc-arm-none-eabi, or pip install ziglang==0.14.1)")
    return " and ".join(lines)


def build(processor: Processor, sources: Sequence[Path], entry: str, folder: Path) -> tuple[Path, str]:
    """Compile and link without a C library; return the ELF file and the compiler's name."""
    elf, root = folder / "core.elf", folder / "root.c"
    root.write_text(ROOT if processor.name == "Cortex-M3" else "typedef int nothing;\n")
    files = [str(path) for path in (*sources, root)]
    common = (
        "-O2",
        *FLAGS,
        "-ffreestanding",
        "-static",
        "-nostdlib",
        "-Wl,--no-gc-sections",
        f"-Wl,-e,{entry}",
        "-o",
        str(elf),
    )
    gcc = shutil.which("arm-none-eabi-gcc")
    if gcc:
        version = subprocess.run([gcc, "-dumpversion"], capture_output=True, text=True, check=True).stdout.strip()
        command = [gcc, "-mthumb", *processor.gcc, "-Wl,-Ttext=0x10000", *common, *files, "-lgcc"]
        name = f"arm-none-eabi-gcc {version}"
    else:
        target, cpu = processor.zig
        command = [sys.executable, "-m", "ziglang", "cc", "-target", target, f"-mcpu={cpu}", *common, *files]
        version = subprocess.run(
            [sys.executable, "-m", "ziglang", "version"], capture_output=True, text=True, check=True
        ).stdout.strip()
        name = f"ziglang {version} (clang)"
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{name} for {processor.name}: {done.stderr}")
    return elf, name


@dataclass(frozen=True)
class Elf:
    """Loadable bytes by address, and function symbols."""

    segments: list[tuple[int, int, bytes]]
    symbols: dict[str, tuple[int, int]]


def read_elf(path: Path) -> Elf:
    """Read the program headers and the symbol table of a 32-bit little-endian ELF file."""
    data = path.read_bytes()
    ph, sh = struct.unpack_from("<II", data, 28)
    _, ph_size, ph_count, sh_size, sh_count, _ = struct.unpack_from("<HHHHHH", data, 40)
    segments = []
    for k in range(ph_count):
        kind, offset, address, _, size, in_memory, _, _ = struct.unpack_from("<8I", data, ph + k * ph_size)
        if kind == 1 and in_memory:
            segments.append((address, in_memory, data[offset : offset + size]))
    symbols: dict[str, tuple[int, int]] = {}
    for k in range(sh_count):
        _, kind, _, _, offset, size, link, _, _, entry = struct.unpack_from("<10I", data, sh + k * sh_size)
        if kind != 2:
            continue
        names = struct.unpack_from("<10I", data, sh + link * sh_size)[4]
        for at in range(offset, offset + size, entry):
            name, value, length, info = struct.unpack_from("<IIIB", data, at)
            if info & 15 in (1, 2):
                end = data.index(b"\0", names + name)
                symbols[data[names + name : end].decode()] = (value & ~1, length)
    return Elf(segments, symbols)


def is_vfp(first: int, second: int) -> bool:
    """Floating-point data processing or a move between the register files."""
    return first & 0xEF00 == 0xEE00 and second & 0x0E00 == 0x0A00


def weight(code: bytes) -> int:
    """Model cycles of one instruction that does not branch."""
    (first,) = struct.unpack_from("<H", code)
    if len(code) == 2:
        if first >> 12 in (5, 6, 7, 8, 9) or first >> 11 == 0b01001:
            return 2  # load or store
        if first & 0xF600 == 0xB400 or first >> 12 == 0xC:
            return 1 + (first & 0x1FF).bit_count()  # push, pop, multiple
        return 1
    (second,) = struct.unpack_from("<H", code, 2)
    if is_vfp(first, second):
        divide = first & 0xFFB0 == 0xEE80 and not second & 0x40
        root = first & 0xFFBF == 0xEEB1 and second & 0x00C0 == 0x00C0
        fused = first & 0xFFB0 in (0xEE00, 0xEE10, 0xEE90, 0xEEA0) and not second & 0x10
        return 14 if divide or root else 3 if fused else 1
    if first & 0xFE00 == 0xEC00:  # load and store of floating-point registers
        single = first & 0x0120 == 0x0100
        return 2 if single else 1 + (second & 0xFF)
    if first & 0xFE00 == 0xE800:
        return 1 + second.bit_count() if first & 0x0040 == 0 else 3
    if first & 0xFE00 == 0xF800:
        return 2
    if first & 0xFF90 == 0xFB90:
        return 7  # integer division, typical
    return 1


def registers(code: bytes) -> tuple[int, set[int]]:
    """Single-precision register that an instruction computes (-1: none) and those it reads."""
    if len(code) == 2:
        return -1, set()
    first, second = struct.unpack("<HH", code)
    d, n = second >> 12 << 1 | first >> 6 & 1, (first & 15) << 1 | second >> 7 & 1
    if first & 0xFE00 == 0xEC00 and first & 0x0110 == 0x0100 and second & 0x0F00 == 0x0A00:
        return -1, {d}  # VSTR
    if not is_vfp(first, second):
        return -1, set()
    if second & 0x10:
        return -1, {n} if first & 0x10 else set()
    m = (second & 15) << 1 | second >> 5 & 1
    unary = first & 0xB0 == 0xB0
    compare = unary and first & 0xF in (4, 5)
    accumulate = not unary and first & 0xA0 in (0, 0xA0)
    read = {m} if unary else {n, m}
    return (-1 if compare else d), read | ({d} if compare or accumulate else set())


def straight_cost(code: bytes) -> tuple[int, int]:
    """Instructions and model cycles of a run without a branch taken inside."""
    at = count = cycles = 0
    result = -1
    while at < len(code):
        wide = struct.unpack_from("<H", code, at)[0] >> 11 in (0b11101, 0b11110, 0b11111)
        length = 4 if wide else 2
        now = code[at : at + length]
        computed, read = registers(now)
        cycles += weight(now) + (result in read)
        result = computed
        count += 1
        at += length
    return count, cycles


class Emulator:
    """A program in an emulated thumb processor; single-precision floating point where the program uses it."""

    def __init__(self, elf: Elf) -> None:
        from unicorn import UC_ARCH_ARM, UC_HOOK_BLOCK, UC_MODE_THUMB, Uc
        from unicorn import arm_const as arm

        self.arm, self.elf = arm, elf
        self.uc = Uc(UC_ARCH_ARM, UC_MODE_THUMB)
        self.uc.ctl_set_cpu_model(arm.UC_CPU_ARM_MAX)
        mapped: set[int] = set()
        for address, size, data in elf.segments:
            for page in range(address & ~0xFFFF, address + size, 0x1_0000):
                if page not in mapped:
                    self.uc.mem_map(page, 0x1_0000)
                    mapped.add(page)
            self.uc.mem_write(address, data)
        self.uc.mem_map(DATA, STACK_TOP - DATA)
        self.uc.mem_map(RETURN, 0x1000)
        access = self.uc.reg_read(arm.UC_ARM_REG_C1_C0_2)
        self.uc.reg_write(arm.UC_ARM_REG_C1_C0_2, access | 0xF << 20)
        self.uc.reg_write(arm.UC_ARM_REG_FPEXC, 0x4000_0000)
        self.blocks: dict[tuple[int, int], tuple[int, int]] = {}
        self.count = self.cycles = self.expected = 0
        self.uc.hook_add(UC_HOOK_BLOCK, self._on_block)

    def _on_block(self, uc: Any, address: int, size: int, _: Any) -> None:
        """Add the straight run of instructions that is about to be executed."""
        key = (address, size)
        if key not in self.blocks:
            self.blocks[key] = straight_cost(bytes(uc.mem_read(address, size)))
        count, cycles = self.blocks[key]
        self.count += count
        self.cycles += cycles if address == self.expected else cycles + 2  # a taken branch refills the pipeline
        self.expected = address + size

    def write(self, address: int, data: bytes) -> None:
        """Copy bytes into the memory."""
        self.uc.mem_write(address, data)

    def read(self, address: int, size: int) -> bytes:
        """Copy bytes out of the memory."""
        return bytes(self.uc.mem_read(address, size))

    def call(self, name: str, *arguments: int) -> tuple[int, int]:
        """Call a function with word arguments; return its instructions and model cycles."""
        arm, top = self.arm, STACK_TOP - ARGUMENTS
        self.write(top, struct.pack(f"<{max(0, len(arguments) - 4)}I", *arguments[4:]))
        self.uc.reg_write(arm.UC_ARM_REG_SP, top)
        for register, value in zip(("R0", "R1", "R2", "R3"), arguments, strict=False):
            self.uc.reg_write(getattr(arm, f"UC_ARM_REG_{register}"), value)
        self.uc.reg_write(arm.UC_ARM_REG_LR, RETURN | 1)
        start = self.elf.symbols[name][0]
        self.count, self.cycles, self.expected = 0, 0, start
        self.uc.emu_start(start | 1, RETURN)
        return self.count, self.cycles

    def set_floats(self, *values: float) -> None:
        """Floating-point arguments of the next call, where they travel in registers."""
        for k, value in enumerate(values):
            (word,) = struct.unpack("<I", struct.pack("<f", value))
            self.uc.reg_write(getattr(self.arm, f"UC_ARM_REG_S{k}"), word)

    def result(self) -> int:
        """First word that the last function returned."""
        return int(self.uc.reg_read(self.arm.UC_ARM_REG_R0))


def emulator(processor: str, sources: Sequence[Path], entry: str, folder: Path) -> tuple[Emulator, str]:
    """Build for a processor and load it; the second value names the compiler."""
    elf, compiler = build(PROCESSORS[processor], sources, entry, folder)
    return Emulator(read_elf(elf)), compiler


def worst_of(costs: Sequence[tuple[int, int]]) -> np.ndarray:
    """Largest instructions and model cycles."""
    return np.asarray(costs).max(axis=0)
