# SPDX-License-Identifier: MIT
"""Find a C compiler that really works, or the pinned zig, and compile a kernel with it.

The list of compiled kernels: what is built from which sources. To add a kernel, add a row.

Platforms a wheel is built for, and the platform this Python runs on.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from dataclasses import dataclass
from pathlib import Path

from pmsmtool.native import library_name


@dataclass(frozen=True, slots=True)
class Kernel:
    """One shared library."""

    name: str
    """Library name without prefix and suffix; what ``native.load`` takes."""
    sources: tuple[str, ...]
    """Globs relative to the package folder. A glob that matches nothing adds nothing."""
    defines: tuple[str, ...] = ()
    """Preprocessor symbols besides :data:`COMMON_DEFINES`."""
    without: tuple[str, ...] = ()
    """Sources that are left out."""

    def source_files(self, package: Path) -> list[Path]:
        """Return the sources relative to ``package``, each once, in a fixed order."""
        found = {path.relative_to(package) for pattern in self.sources for path in package.glob(pattern)}
        return sorted(path for path in found if path.as_posix() not in self.without)


_CORE = "firmware/core/*.c"
SIMULATION = ("sim/*.c", "machine/*.c", "firmware/application/*.c", _CORE)
"""The simulated drive and its machine."""

KERNELS: tuple[Kernel, ...] = (
    Kernel("pmsm_core", (_CORE,)),
    Kernel("pmsm_core_f64", (_CORE,), ("PMSM_REAL_DOUBLE",)),
    Kernel("pmsm_sim", SIMULATION),
    Kernel("pmsm_design", ("design/lookup/*.c", "machine/*.c")),
)

INCLUDE_FOLDERS: tuple[str, ...] = ("firmware/core", "firmware/application", "machine", "sim", "design/lookup")
"""Searched for quoted includes only, so that no header here can hide one of the C library."""

HEADERS: tuple[str, ...] = tuple(f"{folder}/*.h" for folder in INCLUDE_FOLDERS)

COMMON_DEFINES: tuple[str, ...] = ("PMSM_SHARED",)
"""``PMSM_EXPORT`` becomes visibility or ``__declspec(dllexport)`` (``firmware/core/pmsm_types.h``)."""

COMPILE_FLAGS: tuple[str, ...] = (
    "-std=c99",
    "-O3",
    # The same bits on every platform: no fused multiply-add, no reassociation (-O3 without -ffast-math keeps order).
    "-ffp-contract=off",
    # Lets sqrt be one instruction; changes no value.
    "-fno-math-errno",
    "-fvisibility=hidden",
)

WARNING_FLAGS: tuple[str, ...] = (
    "-Wall",
    "-Wextra",
    "-Wshadow",
    "-Wdouble-promotion",
    "-Wfloat-conversion",
    "-Werror",
)
"""For development and release builds; ``pip install`` must not fail on a warning a later compiler invents."""


def is_current(library: Path, kernel: Kernel, package: Path) -> bool:
    """Return whether a compiled file is newer than its sources, all headers and the build rules."""
    if not library.is_file():
        return False
    inputs = [package / source for source in kernel.source_files(package)]
    inputs += [path for pattern in HEADERS for path in package.glob(pattern)]
    inputs += Path(__file__).parent.glob("*.py")
    return library.stat().st_mtime > max(path.stat().st_mtime for path in inputs)


@dataclass(frozen=True, slots=True)
class Target:
    """One platform."""

    name: str
    """Name on the command line of ``cross_wheels``."""
    platform: str
    """As ``sys.platform``; decides the library's file name."""
    machine: str
    """``x86_64`` or ``aarch64``, as the library's header says it."""
    zig: str
    """Target triple of zig; with the oldest C library (Linux) or system (macOS) that must run it."""
    wheel_tag: str
    """Platform tag of the wheel (PEP 425, PEP 600)."""


TARGETS: tuple[Target, ...] = (
    Target("linux-x86_64", "linux", "x86_64", "x86_64-linux-gnu.2.17", "manylinux_2_17_x86_64"),
    Target("linux-aarch64", "linux", "aarch64", "aarch64-linux-gnu.2.17", "manylinux_2_17_aarch64"),
    Target("windows-x86_64", "win32", "x86_64", "x86_64-windows-gnu", "win_amd64"),
    Target("macos-x86_64", "darwin", "x86_64", "x86_64-macos.11.0", "macosx_11_0_x86_64"),
    Target("macos-arm64", "darwin", "aarch64", "aarch64-macos.11.0", "macosx_11_0_arm64"),
)

_MACHINE = {"amd64": "x86_64", "arm64": "aarch64"}


def here() -> Target | None:
    """Return the row of :data:`TARGETS` this Python can load, None for any other platform."""
    machine = platform.machine().lower()
    machine = _MACHINE.get(machine, machine)
    if sys.platform == "linux" and (platform.libc_ver()[0] != "glibc" or sys.maxsize < 2**32):
        return None
    matching = (row for row in TARGETS if (row.platform, row.machine) == (sys.platform, machine))
    return next(matching, None)


def local_wheel_tag() -> str:
    """Return the platform tag of a wheel that is built here for here."""
    if sys.platform == "darwin":
        # get_platform() names the interpreter, which may be universal; the library has one architecture.
        return f"macosx_11_0_{platform.machine()}"
    return re.sub(r"[^A-Za-z0-9_]", "_", sysconfig.get_platform())


CANDIDATES: tuple[str, ...] = ("cc", "gcc", "clang")
ZIG = "zig"
"""Value of the environment variable ``CC`` that asks for the pinned ziglang although a compiler is installed."""

_PROBE_C = """\
#include <math.h>
#include <stdint.h>
#include <string.h>
#ifdef _WIN32
__declspec(dllexport)
#else
__attribute__((visibility("default")))
#endif
int32_t pmsm_probe(double x) {
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    return (int32_t)(sqrt(x) + (double)(bits >> 63));
}
"""
_PROBE_PY = "import ctypes, sys; sys.exit(ctypes.CDLL(sys.argv[1]).pmsm_probe(ctypes.c_double(1764.0)) != 42)"


class CompilerError(RuntimeError):
    """No usable compiler, or a source that does not compile; the text is what the person who installs reads."""


@dataclass(frozen=True, slots=True)
class Compiler:
    """A command that compiles and links a shared library."""

    command: tuple[str, ...]
    """Program and leading arguments."""
    name: str
    """How to name it to a person."""
    tolerated: tuple[str, ...] = ()
    """Flags that take back warnings this compiler gives without need."""


def zig_compiler(target: Target | None) -> Compiler:
    """Return the installed ziglang as a compiler for a platform (None: the one it runs on), baseline CPU.

    Raises CompilerError: ziglang is not importable.
    """
    spec = importlib.util.find_spec("ziglang")
    if spec is None or not spec.submodule_search_locations:
        raise CompilerError("ziglang is not installed in this environment: pip install '.[cross]'")
    folder = Path(next(iter(spec.submodule_search_locations)))
    program = folder / ("zig.exe" if sys.platform == "win32" else "zig")
    # Without -mcpu=baseline zig emits the instructions of the machine that builds; its sanitizer needs a run time;
    # its debug information names folders of this machine.
    arguments: tuple[str, ...] = (str(program), "cc", "-mcpu=baseline", "-fno-sanitize=undefined", "-g0", "-s")
    if target:
        arguments += ("-target", target.zig)
    # clang warns of the constant INFINITY, a float by the standard; gcc, in development, of real promotions only.
    return Compiler(arguments, f"ziglang for {target.name if target else 'this machine'}", ("-Wno-double-promotion",))


def system_compiler() -> tuple[Compiler | None, list[str]]:
    """Return the first compiler of this machine that builds a library this Python can load, and why others do not.

    ``CC`` is obeyed: when it is set nothing else is tried, and a ``CC`` that does not work is an error.

    Raises CompilerError: ``CC`` is set and does not work.
    """
    chosen = os.environ.get("CC", "").strip()
    if chosen == ZIG:
        return None, ["CC=zig asks for ziglang"]
    reasons: list[str] = []
    for text in (chosen,) if chosen else CANDIDATES:
        command = tuple(shlex.split(text))
        program = shutil.which(command[0])
        reason = "not found" if program is None else _probe(Compiler((program, *command[1:]), text))
        if program is not None and not reason:
            return Compiler((program, *command[1:]), text), reasons
        reasons.append(f"{text}: {reason}")
    if chosen:
        raise CompilerError(f"CC is set to a compiler that does not work here: {reasons[0]}")
    return None, reasons


def build_compiler() -> Compiler:
    """Return the compiler for a build on and for this machine: the system's own, else ziglang."""
    compiler, reasons = system_compiler()
    if compiler is not None:
        return compiler
    try:
        return zig_compiler(here())
    except CompilerError as error:
        raise CompilerError("no C compiler works here ({}) and {}".format("; ".join(reasons), error)) from None


def compile_library(
    compiler: Compiler,
    kernel: Kernel,
    package: Path,
    library: Path,
    *,
    platform: str = sys.platform,
    strict: bool = False,
) -> None:
    """Compile one kernel. Raises CompilerError: the compiler refused; carries its messages.

    Parameters
    ----------
    compiler : Compiler
        From :func:`build_compiler` or :func:`zig_compiler`.
    kernel : Kernel
        Must have sources.
    package : Path
        The folder ``pmsmtool`` that holds the sources.
    library : Path
        The file to write; replaced as a whole, so that a process that has the old one loaded keeps it.
    platform : str
        Platform of the target, as ``sys.platform``.
    strict : bool
        Treat warnings as errors.
    """
    with tempfile.TemporaryDirectory(dir=library.parent, prefix=".build-") as scratch:
        # A scratch folder of its own: linkers for Windows leave import libraries and debug files beside the output.
        output = Path(scratch) / library.name
        run_compiler(
            compiler,
            _arguments(kernel, package, output, platform, strict, compiler.tolerated),
            package,
            f"{compiler.name}: {kernel.name}",
        )
        os.replace(output, library)


def _arguments(
    kernel: Kernel, package: Path, output: Path, platform: str, strict: bool, tolerated: tuple[str, ...]
) -> list[str]:
    """Arguments with paths relative to the package, so that no path of the building machine gets into a library."""
    arguments = ["-shared", *COMPILE_FLAGS, *([] if platform == "win32" else ["-fPIC"])]
    if platform == "darwin":
        # The library's own name, else the linker writes the path of the scratch folder into it.
        arguments += ["-mmacosx-version-min=11.0", f"-Wl,-install_name,@rpath/{output.name}"]
    if platform == "linux":
        arguments += ["-Wl,-z,defs"]  # a missing function is an error here, as it is on the other platforms
    arguments += [*WARNING_FLAGS, *tolerated] if strict else []
    arguments += [f"-D{define}" for define in (*COMMON_DEFINES, *kernel.defines)]
    arguments += [part for folder in INCLUDE_FOLDERS for part in ("-iquote", folder)]
    # pmsm_sim runs batches of drives on threads; Windows has its own.
    libraries = ["-lm"] if platform == "win32" else ["-lm", "-lpthread"]
    return [*arguments, *(path.as_posix() for path in kernel.source_files(package)), *libraries, "-o", str(output)]


def run_compiler(compiler: Compiler, arguments: list[str], folder: Path, what: str) -> None:
    """Run a compiler in ``folder``; raises CompilerError with its messages, ``what`` before them."""
    done = subprocess.run(
        [*compiler.command, *arguments], cwd=folder, capture_output=True, text=True, errors="replace", check=False
    )
    if done.returncode != 0:
        raise CompilerError(f"{what}: exit {done.returncode}\n{done.stderr.strip() or done.stdout.strip()}")


def _probe(compiler: Compiler) -> str:
    """Return why a compiler is of no use here, empty when it is: compile a library, load and call it."""
    with tempfile.TemporaryDirectory(prefix="pmsm-probe-", ignore_cleanup_errors=True) as scratch:
        folder = Path(scratch)
        (folder / "probe.c").write_text(_PROBE_C, encoding="ascii")
        output = folder / library_name("probe")
        arguments = ["-shared", *COMPILE_FLAGS, *([] if sys.platform == "win32" else ["-fPIC"])]
        try:
            command = [*arguments, "probe.c", "-lm", "-o", str(output)]
            run_compiler(compiler, command, folder, "does not build a library")
        except (CompilerError, OSError) as error:
            return str(error)
        # In a process of its own: a library that crashes must not take the installation with it.
        loaded = subprocess.run(
            [sys.executable, "-I", "-c", _PROBE_PY, str(output)], capture_output=True, text=True, check=False
        )
        return (
            "" if loaded.returncode == 0 else f"its library does not run in this Python: {loaded.stderr.strip()[-300:]}"
        )
