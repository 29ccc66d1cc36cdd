# SPDX-License-Identifier: MIT
"""The simulation kernel ``pmsm_sim`` through ctypes: mirrored structs, declared functions, owned memory.

Field names and their meaning are those of ``closed_loop.h``, ``plant.h``, ``inverter.h``, ``sensors.h`` and
``pmsm_application.h``; every mirrored struct is checked against the library's size when it is loaded.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from enum import IntEnum
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool import native
from pmsmtool.errors import ConfigError
from pmsmtool.machine.flux_map_cells import FluxMapStruct
from pmsmtool.params.catalogue import CATALOGUE

Array = NDArray[np.float64]

_f32, _f64, _i32, _u32, _u64 = ctypes.c_float, ctypes.c_double, ctypes.c_int32, ctypes.c_uint32, ctypes.c_uint64
TRACE_CHANNELS = 8


class Machine(ctypes.Structure):
    """``pmsm_machine``."""

    _fields_ = (
        ("pole_pairs", _f64),
        ("R_copper", _f64),
        ("R_fixed", _f64),
        ("L_d", _f64),
        ("L_q", _f64),
        ("psi_f", _f64),
        ("T_ref", _f64),
        ("alpha_R", _f64),
        ("alpha_psi", _f64),
        ("map", ctypes.POINTER(FluxMapStruct)),
        ("R_iron", _f64),
        ("eddy_d", _f64),
        ("eddy_q", _f64),
        ("eddy_rate", _f64),
        ("psi_6", _f64),
        ("psi_12", _f64),
        ("psi_7", _f64),
        ("J", _f64),
        ("B", _f64),
        ("tau_c", _f64),
        ("load_viscous", _f64),
        ("drag", _f64),
        ("cogging", _f64),
        ("cogging_periods", _f64),
        ("thermal_resistance", _f64),
        ("thermal_capacity", _f64),
        ("T_ambient", _f64),
        ("rotor", _u32),
        ("J_load", _f64),
        ("coupling_stiffness", _f64),
        ("coupling_damping", _f64),
        ("backlash", _f64),
        ("stribeck", _f64),
        ("stribeck_speed", _f64),
        ("friction_once", _f64),
        ("cogging_slot", _f64),
        ("cogging_slot_periods", _f64),
        ("cogging_pole", _f64),
        ("cogging_pole_periods", _f64),
        ("L_6", _f64),
        ("L_imbalance", _f64),
    )


class Inverter(ctypes.Structure):
    """``pmsm_inverter_setup``."""

    _fields_ = (
        ("model", _u32),
        ("shape", _u32),
        ("dead_time", _f64 * 3),
        ("i_knee", _f64),
        ("V_switch", _f64),
        ("r_switch", _f64),
        ("V_diode", _f64),
        ("r_diode", _f64),
        ("r_leg", _f64 * 3),
        ("capacitance", _f64),
        ("minimum_pulse", _f64),
        ("open", _u32 * 3),
    )


class Sensors(ctypes.Structure):
    """``pmsm_sensor_setup``."""

    _fields_ = (
        ("gain", _f64 * 3),
        ("offset", _f64 * 3),
        ("noise", _f64),
        ("full_scale", _f64),
        ("adc_bits", _u32),
        ("encoder_bits", _u32),
        ("U_dc_gain", _f64),
        ("encoder_offset_e", _f64),
        ("encoder_reversed", _u32),
        ("fault", _u32),
        ("encoder_latency", _f64),
        ("encoder_once", _f64),
        ("encoder_twice", _f64),
        ("encoder_noise", _f64),
        ("T_lag", _f64),
        ("blind", _f64),
        ("cubic", _f64),
        ("drift", _f64),
        ("hall_axis", _f64 * 3),
        ("hall", _u32),
    )


class Setup(ctypes.Structure):
    """``pmsm_sim_setup``: everything that is fixed during a run."""

    _fields_ = (
        ("machine", Machine),
        ("inverter", Inverter),
        ("sensors", Sensors),
        ("U_dc", _f64),
        ("U_dc_ripple", _f64),
        ("U_dc_ripple_hz", _f64),
        ("U_dc_source", _f64),
        ("U_dc_source_time", _f64),
        ("U_dc_capacitance", _f64),
        ("U_dc_chopper", _f64),
        ("U_dc_chopper_ohm", _f64),
        ("T_winding", _f64),
        ("T_magnet", _f64),
        ("theta_M", _f64),
        ("omega_M", _f64),
        ("load", _f64),
        ("sensor_lag", _f64),
        ("sampling_shift", _f64),
        ("seed", _u64),
        ("delay", _u32),
        ("application", _u32),
        ("T_s_ns", _u32),
    )


class Params(ctypes.Structure):
    """``pmsm_params``: one member per catalogue row."""

    _fields_ = tuple((row.c_name, _u32 if row.is_integer else _f32) for row in CATALOGUE)


class Reference(ctypes.Structure):
    """``pmsm_reference`` in binary32."""

    _fields_ = (
        ("mode", _u32),
        ("i_d_ref", _f32),
        ("i_q_ref", _f32),
        ("tau_ref", _f32),
        ("omega_M_ref", _f32),
        ("u_d_inject", _f32),
        ("u_q_inject", _f32),
        ("bias_bandwidth", _f32),
    )


class ExcitationState(ctypes.Structure):
    """``pmsm_excitation``."""

    _fields_ = (
        ("shape", _u32),
        ("point", _u32),
        ("hold_periods", _u32),
        ("amplitude", _f32),
        ("amplitude_q", _f32),
        ("bias_d", _f32),
        ("bias_q", _f32),
        ("bias_bandwidth", _f32),
        ("f0", _f32),
        ("f1", _f32),
        ("duration", _f32),
        ("fixed_angle", _f32),
        ("i_limit_d", _f32),
        ("i_limit_q", _f32),
        ("i_centre_d", _f32),
        ("abort_current", _f32),
        ("abort_speed", _f32),
        ("command", _u32),
        ("state", _u32),
        ("buffer_samples", _u32),
    )


class Recorder(ctypes.Structure):
    """``pmsm_recorder``."""

    _fields_ = (
        ("decimation", _u32),
        ("depth", _u32),
        ("pretrigger", _u32),
        ("trigger", _u32),
        ("trigger_signal", _u32),
        ("trigger_level", _f32),
        ("command", _u32),
        ("state", _u32),
        ("stored", _u32),
        ("trigger_position", _u32),
        ("channel", _u32 * TRACE_CHANNELS),
    )


class Average(ctypes.Structure):
    """``pmsm_average``."""

    _fields_ = (
        ("periods", _u32),
        ("command", _u32),
        ("state", _u32),
        ("signal", _u32 * TRACE_CHANNELS),
        ("mean", _f32 * TRACE_CHANNELS),
        ("std", _f32 * TRACE_CHANNELS),
    )


class HomingRequest(ctypes.Structure):
    """``pmsm_homing_request``."""

    _fields_ = (
        ("active", _u32),
        ("start", _u32),
        ("method", _i32),
        ("slow", _f32),
        ("torque", _f32),
        ("home_offset", _i32),
    )


class PositionRequest(ctypes.Structure):
    """``pmsm_position_request``."""

    _fields_ = (
        ("increments", _u32),
        ("offset", _i32),
        ("profile", _u32),
        ("target", _i32),
        ("set_point", _u32),
        ("interval", _f32),
        ("velocity", _f32),
        ("acceleration", _f32),
        ("deceleration", _f32),
        ("stop_deceleration", _f32),
        ("jerk", _f32),
        ("halt", _u32),
        ("minimum", _i32),
        ("maximum", _i32),
        ("window", _f32),
        ("window_time", _f32),
        ("homing", HomingRequest),
    )


class Position(ctypes.Structure):
    """``pmsm_position``, up to its private memory."""

    _fields_ = (
        ("asked", PositionRequest),
        ("actual", _i32),
        ("reference", _i32),
        ("reference_part", _f32),
        ("velocity", _f32),
        ("acceleration", _f32),
        ("error", _f32),
        ("flags", _u32),
        ("limits", _u32),
        ("homing", _u32),
    )


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


_LAYOUT_SIM, _LAYOUT_DRIVE = 0, 1
_MIRRORED: tuple[tuple[int, type[ctypes.Structure]], ...] = (
    (2, Setup),
    (3, Machine),
    (4, Inverter),
    (5, Sensors),
    (6, Params),
    (7, Reference),
    (8, ExcitationState),
    (9, Recorder),
    (10, Average),
    (11, FluxMapStruct),
    (12, Position),
)


@cache
def library() -> Any:
    """Return the kernel with its functions declared.

    Raises
    ------
    RuntimeError
        A mirrored struct has another size in the library: it was built from other sources.
    """
    lib = native.load("pmsm_sim")
    lib.pmsm_sim_layout.argtypes, lib.pmsm_sim_layout.restype = (_u32,), _u32
    for number, mirror in _MIRRORED:
        if lib.pmsm_sim_layout(number) != ctypes.sizeof(mirror):
            raise RuntimeError(f"struct {mirror.__name__} of the library pmsm_sim has another size; rebuild it")
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

    Parameters
    ----------
    setup : Setup
        What is fixed during a run; it is copied.
    image : bytes
        Parameter image of the drive (``firmware.image.pack_image``).
    keep : object
        Whatever the setup points to (a flux map's struct), kept alive with the simulation.

    Raises
    ------
    ConfigError
        The drive refuses the image.
    """

    def __init__(self, setup: Setup, image: bytes, keep: object = None) -> None:
        self.library = library()
        self._keep = keep
        self.setup = setup
        self._buffers: dict[object, object] = {}
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
        return int(self.library.pmsm_sim_part(self.drive, int(part)))

    @property
    def params(self) -> Params:
        """The drive's active parameters."""
        return Params.from_address(self.part(Part.PARAMS))

    @property
    def reference(self) -> Reference:
        """What the drive is asked to do."""
        return Reference.from_address(self.part(Part.REFERENCE))

    @property
    def excitation(self) -> ExcitationState:
        """The drive's excitation."""
        return ExcitationState.from_address(self.part(Part.EXCITATION))

    @property
    def recorder(self) -> Recorder:
        """The drive's trace recorder."""
        return Recorder.from_address(self.part(Part.RECORDER))

    @property
    def average(self) -> Average:
        """The drive's window averages."""
        return Average.from_address(self.part(Part.AVERAGE))

    @property
    def position(self) -> Position:
        """The drive's position controller."""
        return Position.from_address(self.part(Part.POSITION))

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

        Raises
        ------
        ConfigError
            Lengths differ, no nodes, or times that decrease.
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
