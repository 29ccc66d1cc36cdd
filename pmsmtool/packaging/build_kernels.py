# SPDX-License-Identifier: MIT
"""Compile the kernels of a checkout: ``python -m pmsmtool.packaging.build_kernels``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from pmsmtool.native import LIBRARY_FOLDER, library_name
from pmsmtool.packaging.compiler import Compiler, CompilerError, build_compiler, compile_library
from pmsmtool.packaging.kernels import KERNELS, Kernel, is_current
from pmsmtool.packaging.page_module import SOURCES, build_page_module

PACKAGE = Path(__file__).resolve().parent.parent


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
    libraries: list[Path] = []
    for kernel in kernels:
        if not kernel.source_files(package):
            print(f"{kernel.name}: no sources match {', '.join(kernel.sources)}, not built", file=sys.stderr)
            continue
        library = folder / library_name(kernel.name, platform)
        if force or not is_current(library, kernel, package):
            compile_library(compiler, kernel, package, library, platform=platform, strict=strict)
            print(f"{library.name}: compiled by {compiler.name}", file=sys.stderr)
        libraries.append(library)
    return libraries


def main(argv: list[str] | None = None) -> int:
    """Build into ``pmsmtool/_native``; warnings are errors; one kernel's errors do not keep the others back."""
    names = [kernel.name for kernel in (*KERNELS, SOURCES)]
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
    if not options.kernel or SOURCES.name in options.kernel:
        build_page_module(PACKAGE, LIBRARY_FOLDER, force=options.force)
    return failed


if __name__ == "__main__":
    sys.exit(main())
