# SPDX-License-Identifier: MIT
"""The WebAssembly module of the report's page: the control core, the drive's application and the machine.

The same sources as the kernel ``pmsm_sim``, by the pinned ziglang alone: compilers of this machine make none. Where
ziglang is missing, an installation has no module and its reports say so. Nothing is imported by the module, so that a
page runs it without a network and without a C library.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from pmsmtool.native import PAGE_MODULE
from pmsmtool.packaging.compiler import CompilerError, run_compiler, zig_compiler
from pmsmtool.packaging.kernels import COMPILE_FLAGS, INCLUDE_FOLDERS, SIMULATION, Kernel, Target, is_current

SOURCES = Kernel("pmsm_page", SIMULATION, without=("sim/monte_carlo.c",))
"""Without the threads of the Monte Carlo run: a page has none."""
EXPORTS = (
    "pmsm_drive_size", "pmsm_drive_init", "pmsm_drive_load", "pmsm_sim_layout", "pmsm_sim_part", "pmsm_sim_start",
    "pmsm_sim_run", "pmsm_sim_set_schedule", "pmsm_sim_set_record", "__heap_base",
)  # fmt: skip
"""What the page's script calls, and where memory is free."""
_TARGET = Target("WebAssembly", "wasm", "wasm32", "wasm32-freestanding", "")
_HEADERS = ("wasm-wasi-musl", "generic-musl")
"""Headers that ziglang carries: of ``math.h`` and ``string.h`` only what the compiler itself does is used."""


def build_page_module(package: Path, folder: Path, *, strict: bool = False, force: bool = False) -> list[Path]:
    """Compile the module into ``folder`` and return it in a list.

    Where ziglang is missing or refuses, the list is empty and the reason is printed; with ``strict`` it is raised.
    """
    folder.mkdir(parents=True, exist_ok=True)
    module = folder / PAGE_MODULE
    if not force and is_current(module, SOURCES, package):
        return [module]
    try:
        _compile(package, module)
    except CompilerError as error:
        if strict:
            raise
        print(f"{module.name}: not built, reports do not recompute themselves: {error}", file=sys.stderr)
        return []
    return [module]


def _compile(package: Path, module: Path) -> None:
    compiler = zig_compiler(_TARGET)
    headers = Path(compiler.command[0]).parent / "lib" / "libc" / "include"
    arguments = [*COMPILE_FLAGS, "-O2", "-nostdlib", "-Wl,--no-entry"]
    arguments += [f"-Wl,--export={name}" for name in EXPORTS]
    arguments += [part for name in _HEADERS for part in ("-isystem", str(headers / name))]
    arguments += [part for name in INCLUDE_FOLDERS for part in ("-iquote", name)]
    arguments += [path.as_posix() for path in SOURCES.source_files(package)]
    with tempfile.TemporaryDirectory(dir=module.parent, prefix=".build-") as scratch:
        output = Path(scratch) / module.name
        run_compiler(compiler, [*arguments, "-o", str(output)], package, f"{compiler.name}: {module.name}")
        os.replace(output, module)
    print(f"{module.name}: compiled by {compiler.name}", file=sys.stderr)
