# SPDX-License-Identifier: MIT
"""The exported C against the simulated drive's core and the numpy twins, bit for bit over closed loops.

On the host with any C compiler; on Cortex-M3 (soft float), M4F and M7 under emulation where the tools are installed.
"""

from __future__ import annotations

import ctypes
import math
import shutil
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pmsmtool.firmware.core_binding import CoreBinding, bind, core
from pmsmtool.firmware.export_c import FLAGS, c_files
from pmsmtool.firmware.image import pack_image
from tests.firmware import cortex_m
from tests.firmware.closed_loop import (
    BEST,
    CURRENT_ROW,
    LINE,
    MINIMUM_TIME,
    MODE_CURRENT,
    MODE_SPEED,
    MODE_TORQUE,
    PRE_PROJECTION,
    PREDICTOR,
    RPM,
    Loop,
    reference_case,
    tuned,
)
from tests.firmware.core_twin import Twin, f
from tests.firmware.governor_twin import GovernedTwin

pytestmark = pytest.mark.chain

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler on this machine")
U_DC = 210.0
PERIODS = 300
OPTIONS = CURRENT_ROW | PRE_PROJECTION | MINIMUM_TIME


def table() -> tuple[dict[str, float], bytes, tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Values, words, axes and currents of a small look-up table over torque and speed."""
    x, y, z = (np.array(a, dtype="<f4") for a in ([-70, -20, 0, 20, 70], [0, 400, 900], [U_DC]))
    T, n = np.meshgrid(x.astype(float), y.astype(float), indexing="ij")
    i_q = (T / 2.46).astype("<f4")[..., None]
    i_d = (-n * n / 20000 - 0.1 * np.abs(T)).astype("<f4")[..., None]
    shape = {"lut.format": 1, "lut.n_x": 5, "lut.n_y": 3, "lut.n_z": 1, "lut.axis_kind": 0}
    return shape, b"".join(a.tobytes() for a in (x, y, z, i_d, i_q)), (x, y, z), (i_d, i_q)


SHAPE, WORDS, AXES, TABLES = table()
LOOKED_UP = reference_case(4000.0, field_weakening__mode=1) | SHAPE
CASES: dict[str, tuple[dict[str, float], bytes, int]] = {
    "PI": (tuned(), b"", MODE_CURRENT),
    "look-up": (LOOKED_UP, WORDS, MODE_TORQUE),
    "line search": (reference_case(4000.0, governor__mode=LINE, governor__eps=0.01), b"", MODE_CURRENT),
    "best": (
        reference_case(7540.0, governor__mode=BEST, governor__eps=0.001, governor__options=OPTIONS),
        b"",
        MODE_CURRENT,
    ),
    "best, delay, field weakening": (
        reference_case(
            7540.0,
            governor__mode=BEST,
            governor__eps=0.001,
            governor__options=OPTIONS | PREDICTOR,
            inverter__delay_periods=1.5,
            field_weakening__mode=3,
        ),
        b"",
        MODE_TORQUE,
    ),
    "polar": (reference_case(4000.0, polar__mode=6, polar__options=4, inverter__delay_periods=1.5), b"", MODE_CURRENT),
    "speed": (tuned(speed__K_p_nms_per_rad=2.0, speed__K_i_nm_per_rad=20.0), b"", MODE_SPEED),
}


def periods(loop: Loop, mode: int) -> Iterator[Any]:
    """Run a closed loop with random steps of the request and a rising speed; yield the live values."""
    rng = np.random.default_rng(9)
    request = {"i_d_ref": 0.0, "i_q_ref": 0.0, "tau_ref": 0.0, "omega_M_ref": 0.0}
    for k in range(PERIODS):
        if k % 50 == 0:
            angle, size = rng.uniform(0, 2 * math.pi), 50 * math.sqrt(rng.uniform())
            request = {
                "i_d_ref": size * math.cos(angle) - 15,
                "i_q_ref": size * math.sin(angle),
                "tau_ref": float(rng.uniform(-60, 60)),
                "omega_M_ref": float(rng.uniform(-80, 80)),
            }
        if k == 170:
            loop.plant.omega *= 1.3
        yield loop.step(mode=mode, **request)


def export(folder: Path, values: dict[str, float], lut: bytes) -> list[Path]:
    """Write the exported files; return the sources."""
    for name, text in c_files(pack_image(values, lut), prefix="motor", all_laws=True).items():
        (folder / name).write_text(text)
    return sorted(folder.glob("*.c"))


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> CoreBinding:
    """The look-up case, exported and compiled with the flags that the export names."""
    assert COMPILER is not None
    folder = tmp_path_factory.mktemp("exported")
    sources = [path.name for path in export(folder, LOOKED_UP, WORDS)]
    subprocess.run(
        [COMPILER, *FLAGS.split(), "-O2", "-fPIC", "-shared", "-o", "exported.so", *sources], cwd=folder, check=True
    )
    return bind(ctypes.CDLL(str(folder / "exported.so")))


def exported_loop(binding: CoreBinding, case: str, rpm: float) -> Loop:
    """Closed loop of the compiled export; the case it was exported for runs on its own constant parameters."""
    values, lut, _ = CASES[case]
    loop = Loop(binding, values, omega=rpm * RPM, U_dc=U_DC, lut=lut)
    if case == "look-up":
        image = pack_image(values, lut)
        content = bytes((ctypes.c_uint8 * len(image)).in_dll(binding.library, "motor_cfg"))
        assert content == image
        loop.params = binding.types["pmsm_params"].from_buffer_copy(content)
    return loop


@needs_compiler
@pytest.mark.parametrize("case", CASES)
def test_the_compiled_export_equals_the_simulated_drives_core(case: str, exported: CoreBinding) -> None:
    values, lut, mode = CASES[case]
    loop = exported_loop(exported, case, 500.0)
    simulated = Loop(core(), values, omega=500.0 * RPM, U_dc=U_DC, lut=lut)
    moved = 0.0
    for k, _ in enumerate(zip(periods(loop, mode), periods(simulated, mode), strict=True)):
        assert bytes(loop.state) == bytes(simulated.state), k
        assert bytes(loop.output) == bytes(simulated.output), k
        moved = max(moved, float(np.abs(simulated.plant.i).max()))
    assert moved > 1.0


@needs_compiler
@pytest.mark.parametrize("case", ["line search", "best"])
def test_the_compiled_export_equals_the_governors_twin(case: str, exported: CoreBinding) -> None:
    values, _, mode = CASES[case]
    loop, twin = exported_loop(exported, case, 700.0), GovernedTwin(values)
    active = 0
    for k, live in enumerate(periods(loop, mode)):
        m, out = loop.measurement, loop.output
        v, duties, realised = twin.period(
            (f(m.i_a), f(m.i_b), f(m.i_c)), f(m.theta_e), f(m.omega_e), f(m.U_dc), (f(live.i_d_req), f(live.i_q_req))
        )
        mine = np.array([live.i_d_ref, live.i_q_ref, live.u_d_lim, live.u_q_lim, out.duty_a, out.duty_b, out.duty_c])
        assert mine.astype(f).tobytes() == np.array([*v, *realised, *duties], dtype=f).tobytes(), k
        active += bool(live.flags & 32)
    assert active > 20


@needs_compiler
def test_the_compiled_export_equals_the_twin_of_controller_and_look_up(exported: CoreBinding) -> None:
    loop, twin = exported_loop(exported, "look-up", 500.0), Twin(LOOKED_UP, AXES, TABLES)
    for k, live in enumerate(periods(loop, MODE_TORQUE)):
        m, out = loop.measurement, loop.output
        duties, u, realised = twin.step(
            (f(m.i_a), f(m.i_b), f(m.i_c)), f(m.theta_e), f(m.omega_e), f(m.U_dc), tau=f(loop.reference.tau_ref)
        )
        mine = np.array([live.u_d, live.u_q, live.u_d_lim, live.u_q_lim, out.duty_a, out.duty_b, out.duty_c])
        assert mine.astype(f).tobytes() == np.array([*u, *realised, *duties], dtype=f).tobytes(), k


@needs_compiler
@pytest.mark.parametrize("case", ["look-up", "best"])
def test_the_example_compiles_without_a_warning_and_reaches_its_current(case: str, tmp_path: Path) -> None:
    values, lut, _ = CASES[case]
    sources = [path.name for path in export(tmp_path, values, lut)]
    assert COMPILER is not None
    subprocess.run(
        [COMPILER, *FLAGS.split(), "-O1", "-DPMSM_EXAMPLE_MAIN", "-o", "example", *sources, "-lm"],
        cwd=tmp_path,
        check=True,
    )
    assert subprocess.run([tmp_path / "example"]).returncode == 0


FAULTS = {  # what a person gets wrong -> file, text, wrong text, exit code, what the example prints
    "a constant changed by hand": ("cfg", "pole_pairs = 4u", "pole_pairs = 5u", 2, "_cfg.c is not as it was"),
    "a sample is no number": ("main", "sampled.i_a = motor->i_d", "sampled.i_a = 0.0F / 0.0F", 1, "fault 1"),
    "no mode is asked for": ("main", "request.mode = PMSM_MODE_CURRENT", "request.mode = PMSM_MODE_OFF", 1, "gates"),
    "two phases are swapped": ("main", "0.866025404F", "-0.866025404F", 1, "order and signs of i_a, i_b, i_c"),
}  # fmt: skip


@needs_compiler
def test_the_example_prints_the_likely_cause(tmp_path: Path) -> None:
    assert COMPILER is not None
    command = [COMPILER, "-std=c99", "-fno-math-errno", "-DPMSM_EXAMPLE_MAIN"]
    for path in export(tmp_path, tuned(), b""):
        if path.stem not in ("motor_main", "motor_cfg"):
            subprocess.run([*command, "-c", path.name], cwd=tmp_path, check=True)
    held = {part: (tmp_path / f"motor_{part}.c").read_text() for part in ("main", "cfg")}
    objects = [path.name for path in tmp_path.glob("*.o")]
    for part, right, wrong, code, said in FAULTS.values():
        for name, text in held.items():
            (tmp_path / f"motor_{name}.c").write_text(text.replace(right, wrong) if name == part else text)
        subprocess.run(
            [*command, "motor_main.c", "motor_cfg.c", *objects, "-o", "example", "-lm"], cwd=tmp_path, check=True
        )
        done = subprocess.run([tmp_path / "example"], capture_output=True, text=True)
        assert (done.returncode, said in done.stdout) == (code, True), (said, done.stdout)


@needs_compiler
def test_a_compiler_that_knows_no_nan_is_refused(tmp_path: Path) -> None:
    """-ffast-math lets a compiler drop the comparisons that keep such a sample from the voltage."""
    export(tmp_path, tuned(), b"")
    assert COMPILER is not None
    command = [COMPILER, "-std=c99", "-ffast-math", "-fsyntax-only", "pmsm_step.c"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode and "samples which are not a number" in done.stderr


@pytest.mark.skipif(bool(cortex_m.missing()), reason=f"absent: {cortex_m.missing()}")
@pytest.mark.parametrize("processor", cortex_m.PROCESSORS)
def test_the_export_on_a_cortex_m_equals_the_recorded_loop(processor: str, tmp_path: Path) -> None:
    values, lut, _ = CASES["look-up"]
    emulator, _ = cortex_m.emulator(processor, export(tmp_path, values, lut), "pmsm_step", tmp_path)
    cfg = emulator.elf.symbols["motor_cfg"][0]
    assert emulator.read(cfg, len(pack_image(values, lut))) == pack_image(values, lut)
    at = {name: cortex_m.DATA + 0x2000 * k for k, name in enumerate(("state", "m", "r", "o", "params"))}
    for case, (values, lut, mode) in CASES.items():
        image = pack_image(values, lut)
        emulator.write(at["params"], image)
        words = at["params"] + len(image) - len(lut) if lut else 0
        params = cfg if case == "look-up" else at["params"]
        emulator.call("pmsm_init", at["state"])
        loop = Loop(core(), values, omega=500.0 * RPM, U_dc=U_DC, lut=lut)
        for k, _ in enumerate(periods(loop, mode)):
            emulator.write(at["m"], bytes(loop.measurement))
            emulator.write(at["r"], bytes(loop.reference))
            emulator.call("pmsm_step", at["state"], params, words, at["m"], at["r"], at["o"])
            assert emulator.read(at["state"], ctypes.sizeof(loop.state)) == bytes(loop.state), (case, k)
            assert emulator.read(at["o"], ctypes.sizeof(loop.output)) == bytes(loop.output), (case, k)


@needs_compiler
def test_the_integer_square_root_of_the_soft_float_build_is_correctly_rounded(tmp_path: Path) -> None:
    (tmp_path / "root.c").write_text(cortex_m.ROOT.replace("sqrtf", "own_root"))
    assert COMPILER is not None
    subprocess.run([COMPILER, "-O2", "-fPIC", "-shared", "-o", "root.so", "root.c"], cwd=tmp_path, check=True)
    root = ctypes.CDLL(str(tmp_path / "root.so")).own_root
    root.restype, root.argtypes = ctypes.c_float, [ctypes.c_float]
    rng = np.random.default_rng(2)
    words = [*rng.integers(0, 0x7F800000, 4000), 0, 1, 0x007FFFFF, 0x00800000, 0x7F7FFFFF, 0x7F800000, 0x80000000]
    for word in words:
        (x,) = struct.unpack("<f", struct.pack("<I", int(word)))
        assert struct.pack("<f", root(x)) == np.sqrt(f(x)).tobytes(), hex(int(word))
    assert math.isnan(root(-1.0))


@pytest.mark.parametrize(
    ("words", "cycles"),
    [
        ((0xEEB0, 0x0AC0), 1),  # VABS
        ((0xEEB4, 0x0A60), 1),  # VCMP
        ((0xEEB0, 0x0A60), 1),  # VMOV of registers
        ((0xEEF1, 0xFA10), 1),  # VMRS
        ((0xEE80, 0x0A81), 14),  # VDIV
        ((0xEEB1, 0x0AC0), 14),  # VSQRT
        ((0xEE00, 0x0A81), 3),  # VMLA
        ((0xEEA0, 0x0A81), 3),  # VFMA
        ((0xEE90, 0x0A81), 3),  # VFNMS
        ((0xED90, 0x0A00), 2),  # VLDR
    ],
)
def test_cycles_of_an_instruction_are_those_of_the_manual(words: tuple[int, int], cycles: int) -> None:
    """Cortex-M4 technical reference manual, instruction set of the floating-point unit."""
    assert cortex_m.weight(struct.pack("<HH", *words)) == cycles
