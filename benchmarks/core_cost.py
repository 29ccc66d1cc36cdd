"""Instructions of the control core on a Cortex-M4F, counted under emulation.

Run from the repository with ``pip install ziglang==0.14.1 unicorn``: ``python benchmarks/core_cost.py [--json FILE]``.
The core is compiled for the thumb target (by ``arm-none-eabi-gcc`` where it is installed, else by the pinned ziglang)
and every instruction of ``pmsm_step`` is counted by the emulator, so the counts are exact and repeat bit for bit.
Cycles are a model, not silicon: counts weighted with the Cortex-M4 reference manual (division and square root 14,
load and store 2, taken branch 3, everything else 1); no flash wait states, no interrupt entry, no FP stacking.

Two sets of inputs: *nominal*, a closed loop with steps of the request; *adversarial*, states that no closed loop visits
(random current, integrators, held reference, speed, DC voltage, request), so that sets are empty, held references are
inadmissible and every solver runs to its end. Budgets belong to the adversarial worst case. Exit code 1 when one is
missed.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from pmsmtool.firmware.core_binding import CORE_HEADERS, HEADER_FOLDER, parse_structs
from pmsmtool.firmware.image import pack_image
from tests.firmware.closed_loop import (
    BEST,
    CURRENT_ROW,
    LINE,
    MINIMUM_TIME,
    MODE_CURRENT,
    MODE_TORQUE,
    PAPER,
    PRE_PROJECTION,
    PREDICTOR,
    RPM,
    reference_case,
)
from tests.firmware.linear_plant import LinearPlant

BUDGET_12_KHZ, BUDGET_10_KHZ = 14_167, 17_000
"""Cycles of a control period at 170 MHz."""
LINE_LIMIT, EXACT_LIMIT = 600, 4500
"""Instructions: line search; exact projection on 12 rows (k_max 10 and the steady state)."""
BEST_TYPICAL, BEST_WORST, UNIFIED_WORST = 0.25, 0.50, 0.25
"""Shares of the period: best mode over 12 kHz, unified polar law over 10 kHz."""
NOMINAL_STEPS, ADVERSARIAL_STEPS = 180, 600
V_DC = 210.0
COMMON = ("-O2", "-std=c99", "-ffp-contract=off", "-fno-math-errno", "-ffreestanding", "-nostdlib", "-static")
STACK_TOP, DATA, RETURN = 0x2010_0000, 0x2000_0000, 0x0800_0000

Inputs = Iterator[None]


def build(folder: Path) -> tuple[Path, str]:
    """Compile the core for the M4F; return the ELF file and the compiler's name."""
    elf = folder / "core.elf"
    sources = sorted(str(path) for path in HEADER_FOLDER.glob("*.c"))
    gcc = shutil.which("arm-none-eabi-gcc")
    if gcc:
        compiler = [gcc, "-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-Wl,-Ttext=0x10000"]
        sources.append("-lgcc")
        name = subprocess.run([gcc, "-dumpversion"], capture_output=True, text=True, check=True).stdout.strip()
        name = f"arm-none-eabi-gcc {name}"
    else:
        compiler = [sys.executable, "-m", "ziglang", "cc", "-target", "thumb-freestanding-eabihf"]
        compiler.append("-mcpu=cortex_m4+vfp4d16sp")
        name = "ziglang 0.14.1 (clang)"
    subprocess.run([*compiler, *COMMON, "-Wl,-e,pmsm_step", "-o", str(elf), *sources], check=True)
    return elf, name


@dataclass(frozen=True)
class Elf:
    """Loadable bytes by address, and function symbols."""

    segments: list[tuple[int, bytes]]
    symbols: dict[str, tuple[int, int]]


def read_elf(path: Path) -> Elf:
    """Read the program headers and the symbol table of a 32-bit little-endian ELF file."""
    data = path.read_bytes()
    ph, sh = struct.unpack_from("<II", data, 28)
    _, ph_size, ph_count, sh_size, sh_count, _ = struct.unpack_from("<HHHHHH", data, 40)
    segments = []
    for k in range(ph_count):
        kind, offset, address, _, size, _, _, _ = struct.unpack_from("<8I", data, ph + k * ph_size)
        if kind == 1 and size:
            segments.append((address, data[offset : offset + size]))
    symbols: dict[str, tuple[int, int]] = {}
    for k in range(sh_count):
        _, kind, _, _, offset, size, link, _, _, entry = struct.unpack_from("<10I", data, sh + k * sh_size)
        if kind != 2:
            continue
        names = struct.unpack_from("<10I", data, sh + link * sh_size)[4]
        for at in range(offset, offset + size, entry):
            name, value, length, info = struct.unpack_from("<IIIB", data, at)
            if info & 15 == 2:
                end = data.index(b"\0", names + name)
                symbols[data[names + name : end].decode()] = (value & ~1, length)
    return Elf(segments, symbols)


def weight(code: bytes) -> int:
    """Model cycles of one instruction that does not branch (Cortex-M4 reference manual, section 3.3)."""
    (first,) = struct.unpack_from("<H", code)
    if len(code) == 2:
        if first >> 12 in (5, 6, 7, 8, 9) or first >> 11 == 0b01001:
            return 2  # load or store
        if first & 0xF600 == 0xB400 or first >> 12 == 0xC:
            return 1 + (first & 0x1FF).bit_count()  # push, pop, multiple
        return 1
    (second,) = struct.unpack_from("<H", code, 2)
    if first & 0xEF00 == 0xEE00 and second & 0x0E00 == 0x0A00:  # VFP data processing
        divide = first & 0xFFB0 == 0xEE80 and not second & 0x40
        root = first & 0xFFBF == 0xEEB1 and second & 0x00C0 == 0x00C0
        return 14 if divide or root else 1
    if first & 0xFE00 == 0xEC00:  # VFP load and store
        single = first & 0x0120 == 0x0100
        return 2 if single else 1 + (second & 0xFF)
    if first & 0xFE00 == 0xE800:
        return 1 + second.bit_count() if first & 0x0040 == 0 else 3
    if first & 0xFE00 == 0xF800:
        return 2
    if first & 0xFF90 == 0xFB90:
        return 7  # integer division, typical
    return 1


def straight_cost(code: bytes) -> tuple[int, int]:
    """Instructions and model cycles of Thumb-2 code without a branch taken inside."""
    at = count = cycles = 0
    while at < len(code):
        wide = struct.unpack_from("<H", code, at)[0] >> 11 in (0b11101, 0b11110, 0b11111)
        length = 4 if wide else 2
        cycles += weight(code[at : at + length])
        count += 1
        at += length
    return count, cycles


class Emulator:
    """The core in an emulated Thumb-2 processor with single-precision VFP."""

    def __init__(self, elf: Elf) -> None:
        from unicorn import UC_ARCH_ARM, UC_HOOK_BLOCK, UC_MODE_THUMB, Uc
        from unicorn import arm_const as arm

        self.arm, self.elf = arm, elf
        self.uc = Uc(UC_ARCH_ARM, UC_MODE_THUMB)
        for address, data in elf.segments:
            low, high = address & ~0xFFFF, (address + len(data) + 0xFFFF) & ~0xFFFF
            for page in range(low, high, 0x1_0000):
                if not any(start <= page <= end for start, end, _ in self.uc.mem_regions()):
                    self.uc.mem_map(page, 0x1_0000)
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

    def call(self, name: str, *arguments: int) -> tuple[int, int]:
        """Call a function with up to six word arguments; return its instructions and model cycles."""
        arm = self.arm
        self.uc.mem_write(STACK_TOP - 64, struct.pack(f"<{max(0, len(arguments) - 4)}I", *arguments[4:]))
        self.uc.reg_write(arm.UC_ARM_REG_SP, STACK_TOP - 64)
        for register, value in zip(("R0", "R1", "R2", "R3"), arguments, strict=False):
            self.uc.reg_write(getattr(arm, f"UC_ARM_REG_{register}"), value)
        self.uc.reg_write(arm.UC_ARM_REG_LR, RETURN | 1)
        start = self.elf.symbols[name][0]
        self.count, self.cycles, self.expected = 0, 0, start
        self.uc.emu_start(start | 1, RETURN)
        return self.count, self.cycles


class Target:
    """The core's structures in the emulated memory, and one period at a time."""

    def __init__(self, emulator: Emulator, values: dict[str, float]) -> None:
        text = "\n".join((HEADER_FOLDER / name).read_text(encoding="ascii") for name in CORE_HEADERS)
        types = parse_structs(text)
        self.emulator = emulator
        self.state, self.measurement, self.reference, self.output = (
            types[f"pmsm_{name}"]() for name in ("state", "measurement", "reference", "output")
        )
        self.at = {name: DATA + 0x2000 * k for k, name in enumerate(("state", "params", "m", "r", "o"))}
        emulator.uc.mem_write(self.at["params"], pack_image(values))
        emulator.call("pmsm_init", self.at["state"])
        self.pull()

    def pull(self) -> None:
        """Copy the controller's memory out of the emulator."""
        raw = self.emulator.uc.mem_read(self.at["state"], len(bytes(self.state)))
        self.state = type(self.state).from_buffer_copy(raw)

    def push(self) -> None:
        """Copy it back."""
        self.emulator.uc.mem_write(self.at["state"], bytes(self.state))

    def step(self) -> tuple[int, int]:
        """Run one period on the present structures; return instructions and model cycles."""
        memory = self.emulator.uc
        self.push()
        memory.mem_write(self.at["m"], bytes(self.measurement))
        memory.mem_write(self.at["r"], bytes(self.reference))
        at = self.at
        cost = self.emulator.call("pmsm_step", at["state"], at["params"], 0, at["m"], at["r"], at["o"])
        self.pull()
        self.output = type(self.output).from_buffer_copy(memory.mem_read(at["o"], len(bytes(self.output))))
        return cost


def nominal(target: Target, values: dict[str, float], mode: int) -> Inputs:
    """Closed loop at 620 rpm with a step of the request every 60 periods."""
    plant = LinearPlant(R=values["motor.R_s_ohm"], L_d=values["motor.L_d_h"], L_q=values["motor.L_q_h"],
                        psi=values["motor.psi_f_wb"], T_s=1e-9 * values["inverter.T_s_ns"], omega=620 * RPM,
                        delayed=values["inverter.delay_periods"] >= 1)
    m, r = target.measurement, target.reference
    for k in range(NOMINAL_STEPS):
        m.i_a, m.i_b, m.i_c = plant.phases()
        m.theta_e, m.omega_e, m.U_dc, m.T_winding = plant.theta, plant.omega, V_DC, 20.0
        r.mode, r.i_q_ref, r.tau_ref = mode, (28.0, -28.0, 0.0)[k // 60], (40.0, -40.0, 0.0)[k // 60]
        yield
        plant.advance(target.output.u_alpha, target.output.u_beta)


def adversarial(target: Target, values: dict[str, float], mode: int) -> Inputs:
    """States, speeds and requests drawn at random, the memory of the controller included."""
    rng = np.random.default_rng(1)
    m, r, R = target.measurement, target.reference, values["motor.R_s_ohm"]
    top = 1300.0 if mode == MODE_CURRENT else 1000.0
    for _ in range(ADVERSARIAL_STEPS):
        angle, radius = rng.uniform(0, 2 * math.pi, 3), 56 * np.sqrt(rng.uniform(0, 1, 3))
        i, asked, held = (np.array([a * math.cos(p), a * math.sin(p)]) for a, p in zip(radius, angle, strict=True))
        theta = float(rng.uniform(-3, 3))
        alpha = math.cos(theta) * i[0] - math.sin(theta) * i[1]
        beta = math.sin(theta) * i[0] + math.cos(theta) * i[1]
        m.i_a, m.i_b = alpha, -alpha / 2 + math.sqrt(0.75) * beta
        m.i_c = -m.i_a - m.i_b
        m.theta_e, m.omega_e = theta, float(rng.uniform(-top, top)) * RPM
        m.U_dc, m.T_winding = V_DC * float(rng.uniform(0.8, 1.1)), 20.0
        r.mode, (r.i_d_ref, r.i_q_ref), r.tau_ref = mode, asked, float(rng.uniform(-80, 80))
        state = target.state
        state.integrator.d, state.integrator.q = R * i + rng.normal(0, 3, 2)
        state.disturbance.d, state.disturbance.q = rng.normal(0, 3, 2)
        state.reference_held.d, state.reference_held.q = held
        state.time_to_go = float(rng.choice([0.0, 0.002]))
        state.fw_count = 0
        yield


@dataclass(frozen=True)
class Cost:
    """Mean and worst instructions and model cycles over a set of inputs."""

    mean: float
    worst: int
    mean_cycles: float
    worst_cycles: int


def measure(emulator: Emulator, values: dict[str, float], inputs: Callable[..., Inputs], mode: int) -> Cost:
    """Cost of one period, the first (which derives constants) excepted."""
    target = Target(emulator, values)
    costs = []
    for _ in inputs(target, values, mode):
        costs.append(target.step())
    counts, cycles = np.array(costs[1:]).T
    return Cost(float(counts.mean()), int(counts.max()), float(cycles.mean()), int(cycles.max()))


def laws() -> dict[str, tuple[dict[str, float], int]]:
    """Name -> values and mode of every measured configuration."""
    options = CURRENT_ROW | PRE_PROJECTION | MINIMUM_TIME
    best = {"governor__mode": BEST, "governor__eps": 0.001}
    return {
        "PI": (reference_case(4000.0), MODE_CURRENT),
        "PI, predictor": (reference_case(4000.0, current__options=23, inverter__delay_periods=1.5), MODE_CURRENT),
        "line search": (reference_case(4000.0, governor__mode=LINE), MODE_CURRENT),
        "exact, 7 rows": (reference_case(4000.0, governor__mode=PAPER, governor__k_max=5), MODE_CURRENT),
        "exact, 12 rows": (reference_case(4000.0, governor__mode=PAPER, governor__k_max=10), MODE_CURRENT),
        "best, rows only": (reference_case(4000.0, **best, governor__options=CURRENT_ROW), MODE_CURRENT),
        "best": (reference_case(7540.0, **best, governor__options=options), MODE_CURRENT),
        "best, delay": (reference_case(7540.0, **best, governor__options=options | PREDICTOR,
                                       inverter__delay_periods=1.5), MODE_CURRENT),
        "best + accelerated FW": (reference_case(7540.0, **best, governor__options=options, field_weakening__mode=3),
                                  MODE_TORQUE),
        "polar, proposed": (reference_case(4000.0, polar__mode=2), MODE_CURRENT),
        "polar, regularised": (reference_case(4000.0, polar__mode=5), MODE_CURRENT),
        "polar, unified": (reference_case(4000.0, polar__mode=6, polar__options=4, inverter__delay_periods=1.5),
                           MODE_CURRENT),
    }


def verdicts(table: dict[str, dict[str, Cost]]) -> list[tuple[str, float, float]]:
    """What is promised, the measured number, the limit; governors without the PI period they run in."""
    base = table["PI"]["nominal"].mean
    best = table["best, delay"]
    return [
        ("line search, worst instructions", table["line search"]["adversarial"].worst - base, LINE_LIMIT),
        ("exact 12 rows, worst instructions", table["exact, 12 rows"]["adversarial"].worst - base, EXACT_LIMIT),
        ("best, typical share of 12 kHz", best["nominal"].mean_cycles / BUDGET_12_KHZ, BEST_TYPICAL),
        ("best, worst share of 12 kHz", best["adversarial"].worst_cycles / BUDGET_12_KHZ, BEST_WORST),
        ("unified polar law, worst share of 10 kHz",
         table["polar, unified"]["adversarial"].worst_cycles / BUDGET_10_KHZ, UNIFIED_WORST),
    ]


def main() -> int:
    """Measure, print, compare with the limits."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--json", type=Path, help="write the table here")
    options = parser.parse_args()
    try:
        import unicorn  # noqa: F401
    except ImportError:
        print("core_cost: skipped, the emulator is missing (pip install unicorn ziglang==0.14.1)")
        return 0
    with tempfile.TemporaryDirectory() as folder:
        elf_path, compiler = build(Path(folder))
        emulator = Emulator(read_elf(elf_path))
    table = {
        name: {kind.__name__: measure(emulator, values, kind, mode) for kind in (nominal, adversarial)}
        for name, (values, mode) in laws().items()
    }
    print(f"compiled by {compiler}; instructions (model cycles) of one whole period")
    print(f"{'':24}{'nominal mean':>16}{'nominal worst':>16}{'adversarial mean':>20}{'worst':>16}")
    for name, row in table.items():
        n, a = row["nominal"], row["adversarial"]
        print(f"{name:24}{n.mean:8.0f} ({n.mean_cycles:5.0f}){n.worst:8d} ({n.worst_cycles:5d})"
              f"{a.mean:12.0f} ({a.mean_cycles:5.0f}){a.worst:8d} ({a.worst_cycles:5d})")
    missed = 0
    for text, value, limit in verdicts(table):
        good = value <= limit
        missed += not good
        print(f"{'ok  ' if good else 'MISS'} {text}: {value:.4g} (limit {limit:g})")
    if options.json:
        record = {name: {kind: vars(cost) for kind, cost in row.items()} for name, row in table.items()}
        options.json.write_text(json.dumps({"compiler": compiler, "periods": record}, indent=1) + "\n")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
