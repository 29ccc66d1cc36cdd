# SPDX-License-Identifier: MIT
"""The simulation kernel ``pmsm_sim`` through ctypes: its structs, signals, functions, owned memory.

The structs are read from ``closed_loop.h``, ``plant.h``, ``inverter.h``, ``sensors.h``, ``monte_carlo.h`` and
``pmsm_application.h``, where their members are explained; their sizes are checked when the library is loaded. The
numbers of the signals are those of ``pmsm_application.h`` and ``closed_loop.h``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from enum import IntEnum
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pmsmtool import native
from pmsmtool.arrays import Array
from pmsmtool.errors import ConfigError
from pmsmtool.firmware.core_binding import APPLICATION_HEADER, CORE_HEADERS, HEADER_FOLDER
from pmsmtool.machine.flux_map_cells import FluxMapStruct


class Signal(IntEnum):
    """A quantity that can be read, recorded, averaged or triggered on (``enum pmsm_signal``)."""

    NONE = 0
    I_D = 1
    I_Q = 2
    I_D_REQ = 3
    I_Q_REQ = 4
    I_D_REF = 5
    I_Q_REF = 6
    U_D = 7
    U_Q = 8
    U_D_LIM = 9
    U_Q_LIM = 10
    THETA_E = 11
    OMEGA_E = 12
    TAU = 13
    KAPPA = 14
    BINDING = 15
    ITERATIONS = 16
    FLAGS = 17
    I_A = 18
    I_B = 19
    I_C = 20
    U_DC = 21
    T_WINDING = 22
    T_MAGNET = 23
    THETA_M = 24
    FOLLOWING_ERROR = 25
    HALL = 26


class Truth(IntEnum):
    """Signals of the plant (``enum pmsm_truth``), numbered on beside those of the drive (:class:`Signal`)."""

    T = 64
    I_D = 65
    I_Q = 66
    I_A = 67
    I_B = 68
    I_C = 69
    PSI_D = 70
    PSI_Q = 71
    PSI_ALPHA = 72
    PSI_BETA = 73
    THETA_E = 74
    THETA_M = 75
    OMEGA_M = 76
    TORQUE = 77
    LOAD = 78
    U_DC = 79
    T_WINDING = 80
    T_MAGNET = 81
    DUTY_A = 82
    DUTY_B = 83
    DUTY_C = 84
    GATES = 85
    U_ALPHA = 86
    U_BETA = 87
    OMEGA_LOAD = 88
    TWIST = 89
    R = 90
    U_ALPHA_MEAN = 91
    U_BETA_MEAN = 92
    TRIP = 93


_f32, _f64, _u32, _u64 = ctypes.c_float, ctypes.c_double, ctypes.c_uint32, ctypes.c_uint64


_SIM = Path(__file__).parent


def _text(*headers: Path) -> str:
    return "\n".join(path.read_text(encoding="ascii") for path in headers)


STRUCTS = native.parse_structs(
    _text(*(_SIM / f"{name}.h" for name in ("plant", "inverter", "sensors", "closed_loop", "monte_carlo"))),
    {
        **native.parse_structs(_text(*(HEADER_FOLDER / name for name in CORE_HEADERS), APPLICATION_HEADER)),
        "pmsm_flux_map*": ctypes.POINTER(FluxMapStruct),
    },
    names=("pmsm_machine", "pmsm_inverter_setup", "pmsm_sensor_setup", "pmsm_sim_setup", "pmsm_drive_run",
           "pmsm_monte_carlo"),
)  # fmt: skip
"""Structs that Python and the kernel share, by their C names."""


class Setup(ctypes.Structure):
    """``pmsm_sim_setup``: everything that is fixed during a run."""

    _fields_ = STRUCTS["pmsm_sim_setup"]._fields_


class Params(ctypes.Structure):
    """``pmsm_params``: one member per catalogue row."""

    _fields_ = STRUCTS["pmsm_params"]._fields_


class Reference(ctypes.Structure):
    """``pmsm_reference`` in binary32."""

    _fields_ = STRUCTS["pmsm_reference"]._fields_


class Application(IntEnum):
    """Who runs between the samples and the duty ratios (``enum pmsm_runs``)."""

    DRIVE = 0
    CORE = 1


class Rotor(IntEnum):
    """``enum pmsm_rotor``."""

    FREE = 0
    LOCKED = 1
    DRIVEN = 2


class Target(IntEnum):
    """What a schedule moves (``enum pmsm_target``)."""

    I_D = 0
    I_Q = 1
    TORQUE = 2
    SPEED = 3
    LOAD = 4
    DRIVEN_SPEED = 5
    U_DC = 6
    U_D = 7
    U_Q = 8


class Part(IntEnum):
    """Parts of a drive that are read and written between calls (``enum pmsm_part``)."""

    PARAMS = 0
    LUT = 1
    REFERENCE = 2
    EXCITATION = 3
    RECORDER = 4
    AVERAGE = 5
    BUFFER = 6
    TRACE = 7
    ENABLED = 8
    QUICK_STOP = 9
    TRIP = 10
    FIXED_ANGLE = 11
    RECORDER_WRITE = 12
    LIVE = 13
    APPLICATION = 14
    POSITION = 15
    SPEED_INTEGRAL = 16
    FIELD_WEAKENING = 17


_LAYOUT_SIM, _LAYOUT_DRIVE = 0, 1
_SHARED: tuple[tuple[int, type[ctypes.Structure]], ...] = (
    (2, Setup),
    (6, Params),
    (7, Reference),
    (8, STRUCTS["pmsm_excitation"]),
    (9, STRUCTS["pmsm_recorder"]),
    (10, STRUCTS["pmsm_average"]),
    (11, FluxMapStruct),
)
"""Numbers of ``enum pmsm_layout``."""


@cache
def library() -> Any:
    """Return the kernel with its functions declared.

    Raises RuntimeError: a struct has another size in the library: it was built from other sources.
    """
    lib = native.load("pmsm_sim")
    lib.pmsm_sim_layout.argtypes, lib.pmsm_sim_layout.restype = (_u32,), _u32
    for number, struct in _SHARED:
        if lib.pmsm_sim_layout(number) != ctypes.sizeof(struct):
            raise RuntimeError(f"struct {struct.__name__} of the library pmsm_sim has another size; rebuild it")
    data = ctypes.c_void_p
    declarations: tuple[tuple[str, tuple[Any, ...], Any], ...] = (
        ("pmsm_sim_part", (data, _u32), data),
        ("pmsm_sim_start", (data, data, ctypes.POINTER(Setup)), None),
        ("pmsm_sim_run", (data, _u64), _u64),
        ("pmsm_sim_watch", (data, _u32), None),
        ("pmsm_sim_set_schedule", (data, _u32, _u32, data, data), None),
        ("pmsm_sim_set_record", (data, data, _u64, _u32, data, _u32), None),
        ("pmsm_sim_recorded", (data,), _u64),
        ("pmsm_sim_signal", (data, _u32), _f64),
        ("pmsm_sim_time_ns", (data,), _u64),
        ("pmsm_sim_set_load", (data, _f64), None),
        ("pmsm_sim_set_rotor", (data, _u32, _f64), None),
        ("pmsm_sim_set_open", (data, _u32, _u32, _u32), None),
        ("pmsm_sim_set_switches", (data, _f64, _f64), None),
        ("pmsm_sim_set_U_dc", (data, _f64), None),
        ("pmsm_sim_set_temperatures", (data, _f64, _f64), None),
        ("pmsm_sim_outside_count", (data,), _u64),
        ("pmsm_sim_overrun_count", (data,), _u64),
        ("pmsm_inverter_smallest_capacitance", (_f64, _f64), _f64),
        ("pmsm_sim_drive_plant", (data, _u64, _f64, data, data), None),
        ("pmsm_sim_elementary", (_u32, _f64), _f64),
        ("pmsm_sim_normal", (_u64, _u64, data), None),
        ("pmsm_drive_init", (data,), None),
        ("pmsm_drive_load", (data, ctypes.c_char_p, _u32), _u32),
        ("pmsm_application_reset_fault", (data,), None),
        ("pmsm_application_signal", (data, _u32), _f32),
    )
    for name, arguments, result in declarations:
        function = getattr(lib, name)
        function.argtypes, function.restype = arguments, result
    return lib


class Simulation:
    """One simulated drive with its machine: the C structs, and what they point to.

    Raises ConfigError: the drive refuses the image.

    Parameters
    ----------
    setup : Setup
        What is fixed during a run; it is copied.
    image : bytes
        Parameter image of the drive (``firmware.image.pack_image``).
    keep : object
        Whatever the setup points to (a flux map's struct), kept alive with the simulation.
    """

    def __init__(self, setup: Setup, image: bytes, keep: object = None) -> None:
        self.library = library()
        self._keep = keep
        self.setup = setup
        self._buffers: dict[object, object] = {}
        self._parts: dict[Part, int] = {}
        # 8-byte units: the structs hold doubles
        self._drive_memory = (_f64 * (self.library.pmsm_sim_layout(_LAYOUT_DRIVE) // 8 + 1))()
        self._sim_memory = (_f64 * (self.library.pmsm_sim_layout(_LAYOUT_SIM) // 8 + 1))()
        self.drive = ctypes.addressof(self._drive_memory)
        self.sim = ctypes.addressof(self._sim_memory)
        self.application = self.part(Part.APPLICATION)
        self.library.pmsm_drive_init(self.drive)
        self.load(image)
        self.library.pmsm_sim_start(self.sim, self.drive, ctypes.byref(setup))

    def load(self, image: bytes) -> None:
        """Give the drive a parameter image; controller memory is kept."""
        status = self.library.pmsm_drive_load(self.drive, image, len(image))
        if status:
            raise ConfigError(
                f"the simulated drive refuses the parameter image (status {status})",
                hint="`pmsmtool param help NAME` shows the bounds of each value",
            )

    def part(self, part: Part) -> int:
        """Return the address of a part of the drive."""
        address = self._parts.get(part)
        if address is None:
            address = self._parts[part] = int(self.library.pmsm_sim_part(self.drive, int(part)))
        return address

    @cached_property
    def params(self) -> Params:
        """The drive's active parameters."""
        return Params.from_address(self.part(Part.PARAMS))

    @cached_property
    def reference(self) -> Reference:
        """What the drive is asked to do."""
        return Reference.from_address(self.part(Part.REFERENCE))

    @cached_property
    def excitation(self) -> Any:
        """The drive's excitation."""
        return STRUCTS["pmsm_excitation"].from_address(self.part(Part.EXCITATION))

    @cached_property
    def recorder(self) -> Any:
        """The drive's trace recorder."""
        return STRUCTS["pmsm_recorder"].from_address(self.part(Part.RECORDER))

    @cached_property
    def average(self) -> Any:
        """The drive's window averages."""
        return STRUCTS["pmsm_average"].from_address(self.part(Part.AVERAGE))

    @cached_property
    def position(self) -> Any:
        """The drive's position controller."""
        return STRUCTS["pmsm_position"].from_address(self.part(Part.POSITION))

    def word(self, part: Part) -> Any:
        """Return ENABLED, QUICK_STOP, TRIP or RECORDER_WRITE as an unsigned word with a ``value``."""
        return _u32.from_address(self.part(part))

    @property
    def fixed_angle(self) -> Any:
        """Fixed frame angle of the drive (rad electrical, NaN: follows the rotor), with a ``value``."""
        return _f32.from_address(self.part(Part.FIXED_ANGLE))

    def bytes_at(self, part: Part, size: int) -> Any:
        """Return a writable view of a part's bytes."""
        return (ctypes.c_uint8 * size).from_address(self.part(part))

    def floats_at(self, part: Part, count: int) -> Any:
        """Return a writable view of a part's binary32 values."""
        return (_f32 * count).from_address(self.part(part))

    def schedule(self, target: Target, t_s: Sequence[float] | Array, value: Sequence[float] | Array) -> None:
        """Let a target follow a piecewise linear function; two nodes at one time make a step.

        Raises ConfigError: lengths differ, no nodes, or times that decrease.
        """
        t, v = np.ascontiguousarray(t_s, dtype=float), np.ascontiguousarray(value, dtype=float)
        if t.shape != v.shape or t.ndim != 1 or not len(t) or np.any(np.diff(t) < 0.0) or not np.all(np.isfinite(v)):
            raise ConfigError(
                f"the schedule of {target.name} needs finite values at times that do not decrease",
                hint="sort the nodes by time, and leave out what is not finite",
            )
        self._buffers[target] = (t, v)
        self.library.pmsm_sim_set_schedule(self.sim, int(target), len(t), t.ctypes.data, v.ctypes.data)

    def record(self, signals: Sequence[int], rows: int, decimation: int = 1) -> Array:
        """Write rows of signals from the next period on; returns the array, shape (rows, n), that fills up."""
        names = np.ascontiguousarray(signals, dtype=np.uint32)
        out = np.zeros((rows, len(names)))
        self._buffers["record"] = (out, names)
        self.library.pmsm_sim_set_record(self.sim, out.ctypes.data, rows, len(names), names.ctypes.data, decimation)
        return out

    @property
    def recorded_rows(self) -> int:
        """Rows written since :meth:`record`."""
        return int(self.library.pmsm_sim_recorded(self.sim))

    def run(self, periods: int) -> int:
        """Run at most ``periods`` periods; returns how many ran."""
        return int(self.library.pmsm_sim_run(self.sim, periods))

    def signal(self, signal: int) -> float:
        """Return a signal of the drive or of the truth as it would be recorded now."""
        return float(self.library.pmsm_sim_signal(self.sim, int(signal)))

    @property
    def time_ns(self) -> int:
        """Simulated time (ns)."""
        return int(self.library.pmsm_sim_time_ns(self.sim))

    def counts(self) -> Mapping[str, int]:
        """Return what a run should have none of: evaluations outside the flux map, unresolved events."""
        return {
            "outside_flux_map": int(self.library.pmsm_sim_outside_count(self.sim)),
            "event_overruns": int(self.library.pmsm_sim_overrun_count(self.sim)),
        }
