# SPDX-License-Identifier: MIT
"""A second simulated motor, shaft and bridge, to judge the tool on a world it was not developed with.

The C sources of this folder define what ``sim/plant.h`` and ``sim/inverter.h`` declare and the closed loop calls; they
take the places of the project's own plant and bridge in a library of their own. Sensors, control core, application
and node stay the project's. The sources were written from the data sheet (the structs of those headers) without the
project's plant, bridge or estimators having been read: phase equations and winding functions where the first plant has
a stationary-frame flux, Kirchhoff's equations of the legs where it has sources and hold voltages, and another
integrator. Where the data sheet leaves it open: the core loss is a resistor across each coil at every instant (with a
switching bridge a sample in the zero voltage holds none of it), field harmonics follow the magnet's temperature.

The sources are fixed by :func:`digest` before the first commissioning; a change afterwards needs a fault that physics
shows, and is recorded here with the old and the new digest:

a3db7fe80fbb79337235f9a8e310313a6baf6a44513be2c807f5fc83aa6f4d88  since the first commissioning (drive 170000)

A machine that saturates is another one, ``saturated/machine.c``: the closed form of ``analytic_saturation.py`` at an
imposed speed behind the project's ideal bridge, without any map. It is for control, not for identification, and not
part of the digest.

A known difference from the first plant that is not numerics: a sample of the first plant holds the core's mean current
of the last period, one of this plant that of the sampling instant.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import hashlib
import tempfile
import unittest.mock
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.analytic_saturation import BridgeSaturation
from pmsmtool import native
from pmsmtool.errors import ConfigError
from pmsmtool.native import library_name
from pmsmtool.packaging.build_kernels import PACKAGE
from pmsmtool.packaging.compiler import HEADERS, Kernel, build_compiler, compile_library
from pmsmtool.proof import stage
from pmsmtool.proof.simulated import predict_proof
from pmsmtool.sim import kernel
from pmsmtool.sim.kernel import Setup, Simulation

FOLDER = Path(__file__).resolve().parent
NAME = "pmsm_sim"
REPLACED = ("plant.c", "plant_circuit.c", "inverter.c", "leg_circuit.c")
"""Sources of the kernel that this folder's take the place of."""
MACHINE_ALONE = ("plant.c", "plant_circuit.c")
"""Those that the saturated machine takes the place of."""


def sources() -> list[Path]:
    """Return the plant's own sources."""
    return sorted([*FOLDER.glob("*.c"), *FOLDER.glob("*.h")])


def digest() -> str:
    """Return the sha256 of the plant's sources, name and content of each."""
    found = hashlib.sha256()
    for path in sources():
        found.update(path.name.encode() + b"\0" + path.read_bytes().replace(b"\r\n", b"\n") + b"\0")
    return found.hexdigest()


@functools.cache
def build(folder: Path = FOLDER, replaced: tuple[str, ...] = REPLACED) -> Path:
    """Compile the kernel with a folder's plant into the folder for temporary files, once per state of all its sources.

    Raises
    ------
    CompilerError
        No compiler works here.
    """
    kept = [path for path in (PACKAGE / "sim").glob("*.c") if path.name not in replaced]
    own = sorted([*folder.glob("*.c"), *folder.glob("*.h")])
    row = Kernel(
        NAME,
        (
            *(path.relative_to(PACKAGE).as_posix() for path in kept),
            *(f"{part}/*.c" for part in ("machine", "firmware/application", "firmware/core")),
            f"../{folder.relative_to(PACKAGE.parent).as_posix()}/*.c",
        ),
    )
    inputs = {*(PACKAGE / path for path in row.source_files(PACKAGE)), *own}
    inputs |= {path for pattern in HEADERS for path in PACKAGE.glob(pattern)}
    state = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(inputs))).hexdigest()[:16]
    library = Path(tempfile.gettempdir()) / f"pmsm-second-plant-{state}" / library_name(NAME)
    if not library.is_file():
        library.parent.mkdir(parents=True, exist_ok=True)
        compile_library(build_compiler(), row, PACKAGE, library, strict=True)
    return library


@contextlib.contextmanager
def used() -> Iterator[str]:
    """Simulate with this plant inside the block, in this process; gives :func:`digest`.

    The bands of a proof are predicted with the project's own plant, as on any drive.

    Raises
    ------
    CompilerError
        No compiler works here.
    ConfigError
        From a simulation that is opened inside: it has a flux map, which this plant does not know.
    """
    first_load, first_init = native.load, Simulation.__init__

    def init(self: Simulation, setup: Setup, image: bytes, keep: object = None) -> None:
        if setup.machine.map:
            raise ConfigError(
                "the second plant has constant inductances and cannot simulate a flux map",
                hint="run this machine on the project's own plant",
            )
        first_init(self, setup, image, keep)

    def predict(*arguments: Any, **options: Any) -> Any:
        with _simulating(first_load, first_init):
            return predict_proof(*arguments, **options)

    with _simulating(_loads(build()), init), unittest.mock.patch.object(stage, "predict_proof", predict):
        yield digest()


@contextlib.contextmanager
def saturated(form: BridgeSaturation) -> Iterator[None]:
    """Simulate with the machine of a closed form inside the block, in this process, at driven speeds and constant R.

    The flux map of the machine file is not read: it is what the design knows.

    Raises
    ------
    CompilerError
        No compiler works here.
    """
    library = build(FOLDER / "saturated", MACHINE_ALONE)
    constants = dataclasses.astuple(form)
    ctypes.CDLL(str(library)).saturated_machine_set((ctypes.c_double * len(constants))(*constants))
    with _simulating(_loads(library), Simulation.__init__):
        yield


def _loads(library: Path) -> Callable[[str], Any]:
    own, first = ctypes.CDLL(str(library)), native.load
    return lambda name: own if name == NAME else first(name)


@contextlib.contextmanager
def _simulating(load: Callable[[str], Any], init: Callable[..., None]) -> Iterator[None]:
    with unittest.mock.patch.object(native, "load", load), unittest.mock.patch.object(Simulation, "__init__", init):
        kernel.library.cache_clear()
        try:
            yield
        finally:
            kernel.library.cache_clear()
