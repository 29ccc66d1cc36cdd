# SPDX-License-Identifier: MIT
"""Compile the kernels of a checkout: ``python -m pmsmtool.packaging.build_kernels``, and the module of a report's page.

The page's WebAssembly module has the sources of the kernel ``pmsm_sim``, by the pinned ziglang alone: compilers of this
machine make none. Where ziglang is missing, an installation has no module and its reports say so. The module imports
nothing, so that a page runs it without a network and without a C library.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pmsmtool.native import LIBRARY_FOLDER, PAGE_MODULE, library_name
from pmsmtool.packaging.compiler import (
    COMPILE_FLAGS,
    INCLUDE_FOLDERS,
    KERNELS,
    SIMULATION,
    Compiler,
    CompilerError,
    Kernel,
    Target,
    build_compiler,
    compile_library,
    is_current,
    run_compiler,
    zig_compiler,
)

PACKAGE = Path(__file__).resolve().parent.parent

PAGE_SOURCES = Kernel("pmsm_page", SIMULATION, without=("sim/monte_carlo.c",))
"""Without the threads of the Monte Carlo run: a page has none."""
EXPORTS = (
    "pmsm_drive_size", "pmsm_drive_init", "pmsm_drive_load", "pmsm_sim_layout", "pmsm_sim_part", "pmsm_sim_start",
    "pmsm_sim_run", "pmsm_sim_set_schedule", "pmsm_sim_set_record", "__heap_base",
)  # fmt: skip
"""What the page's script calls, and where memory is free."""
_TARGET = Target("WebAssembly", "wasm", "wasm32", "wasm32-freestanding", "")
_HEADERS = ("wasm-wasi-musl", "generic-musl")
"""Headers that ziglang carries: of ``math.h`` and ``string.h`` only what the compiler itself does is used."""


def build_all(
    package: Path,
    folder: Path,
    compiler: Compiler,
    *,
    platform: str = sys.platform,
    strict: bool = False,
    force: bool = False,
    kernels: Sequence[Kernel] = KERNELS,
) -> list[Path]:
    """Compile every kernel that has sources, and return the libraries.

    A library that is newer than its sources, all headers and the build rules is kept unless ``force`` is set.
    """
    folder.mkdir(parents=True, exist_ok=True)

    def built(kernel: Kernel) -> Path | None:
        if not kernel.source_files(package):
            print(f"{kernel.name}: no sources match {', '.join(kernel.sources)}, not built", file=sys.stderr)
            return None
        library = folder / library_name(kernel.name, platform)
        if force or not is_current(library, kernel, package):
            compile_library(compiler, kernel, package, library, platform=platform, strict=strict)
            print(f"{library.name}: compiled by {compiler.name}", file=sys.stderr)
        return library

    with ThreadPoolExecutor() as pool:  # each compiler is a process of its own
        return [library for library in pool.map(built, kernels) if library is not None]


def build_page_module(package: Path, folder: Path, *, strict: bool = False, force: bool = False) -> list[Path]:
    """Compile the module into ``folder`` and return it in a list.

    Where ziglang is missing or refuses, the list is empty and the reason is printed; with ``strict`` it is raised.
    """
    folder.mkdir(parents=True, exist_ok=True)
    module = folder / PAGE_MODULE
    if not force and is_current(module, PAGE_SOURCES, package):
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
    arguments += [path.as_posix() for path in PAGE_SOURCES.source_files(package)]
    with tempfile.TemporaryDirectory(dir=module.parent, prefix=".build-") as scratch:
        output = Path(scratch) / module.name
        run_compiler(compiler, [*arguments, "-o", str(output)], package, f"{compiler.name}: {module.name}")
        os.replace(output, module)
    print(f"{module.name}: compiled by {compiler.name}", file=sys.stderr)


def main(argv: list[str] | None = None) -> int:
    """Build into ``pmsmtool/_native``; warnings are errors; one kernel's errors do not keep the others back."""
    names = [kernel.name for kernel in (*KERNELS, PAGE_SOURCES)]
    parser = argparse.ArgumentParser(description="Compile the kernels of this checkout into pmsmtool/_native.")
    parser.add_argument("kernel", nargs="*", help=f"which ones; default all of {', '.join(names)}")
    parser.add_argument("--force", action="store_true", help="compile also what is up to date")
    options = parser.parse_args(argv)
    if unknown := sorted({*options.kernel} - {*names}):
        parser.error(f"no such kernel: {', '.join(unknown)}")
    failed = 0
    for kernel in (row for row in KERNELS if not options.kernel or row.name in options.kernel):
        try:
            build_all(PACKAGE, LIBRARY_FOLDER, build_compiler(), strict=True, force=options.force, kernels=(kernel,))
        except CompilerError as error:
            print(error, file=sys.stderr)
            failed = 1
    if not options.kernel or PAGE_SOURCES.name in options.kernel:
        build_page_module(PACKAGE, LIBRARY_FOLDER, force=options.force)
    return failed


if __name__ == "__main__":
    sys.exit(main())
