# SPDX-License-Identifier: MIT
"""The machine at given temperatures: what a steady operating point is computed from.

R(T) and psi(T) are those of ``machine/temperature``. A flux map is shifted along psi_d by the change of psi_f, its
inductances kept.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pmsmtool.arrays import Array
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.flux_map_cells import FluxMapStruct, library
from pmsmtool.machine.parameters import MachineParameters
from pmsmtool.machine.temperature import magnet_flux_at, resistance_at
from pmsmtool.machine.torque import air_gap_torque
from pmsmtool.native import parse_structs

_STRUCTS = parse_structs(
    Path(__file__).with_name("lookup").joinpath("current_plane.h").read_text(encoding="ascii"),
    {"pmsm_flux_map*": ctypes.POINTER(FluxMapStruct)},
    names=("pmsm_plane",),
)


class PlaneStruct(ctypes.Structure):
    """``pmsm_plane``; ``maps`` keeps the flux-map structs alive."""

    _fields_ = _STRUCTS["pmsm_plane"]._fields_
    maps: tuple[FluxMapStruct, ...] = ()


@cache
def design_library() -> Any:
    """Return the design kernel with the functions of ``lookup_table.h`` declared, its struct layout checked."""
    lib = library()
    lib.pmsm_plane_size.restype = ctypes.c_uint32
    if lib.pmsm_plane_size() != ctypes.sizeof(PlaneStruct):
        raise RuntimeError("struct pmsm_plane of the library differs from PlaneStruct")
    data, integer, plane = ctypes.c_void_p, ctypes.c_int32, ctypes.POINTER(PlaneStruct)
    lib.pmsm_lookup_table.argtypes = (plane, *(integer, data) * 3, *(data,) * 5)
    lib.pmsm_lookup_table.restype = integer
    lib.pmsm_lookup_error.argtypes = (
        plane, integer, data, integer, data, data, integer, data, data, data, data, integer, data, data,
    )  # fmt: skip
    lib.pmsm_lookup_error.restype = None
    return lib


@dataclass(frozen=True, slots=True, eq=False)
class OperatingMachine:
    """A machine at fixed temperatures."""

    pole_pairs: int
    """Pole pairs."""
    R: float
    """Loop resistance (ohm) at the winding temperature."""
    L_d: float
    L_q: float
    """Apparent inductances (H) of a constant machine; unused with a map."""
    psi_f: float
    """Magnet flux linkage (Wb) at the magnet temperature."""
    flux_map: FluxMap | None = None
    """Saturated machine, at the map's own magnet temperature."""
    psi_shift: float = 0.0
    """Added to psi_d of the map (Wb)."""
    loss_map: FluxMap | None = None
    """Iron loss P_fe = c_h f + c_e f^2 with f the electrical frequency (Hz); ``psi_d_wb`` of this map holds c_h
    (W/Hz), ``psi_q_wb`` holds c_e (W/Hz^2)."""

    def flux(self, i_d_a: ArrayLike, i_q_a: ArrayLike) -> tuple[Array, Array]:
        """Return psi_d, psi_q (Wb) at currents (A peak) of any shape."""
        i_d, i_q = np.broadcast_arrays(np.asarray(i_d_a, dtype=np.float64), np.asarray(i_q_a, dtype=np.float64))
        if self.flux_map is None:
            return self.psi_f + self.L_d * i_d, self.L_q * i_q
        i_d, i_q = np.asarray(i_d, order="C"), np.asarray(i_q, order="C")
        psi_d, psi_q = np.empty(i_d.shape), np.empty(i_d.shape)
        design_library().pmsm_flux_map_flux_many(
            ctypes.byref(self.flux_map.as_struct(inverse=False)), i_d.size,
            i_d.ctypes.data, i_q.ctypes.data, psi_d.ctypes.data, psi_q.ctypes.data, None, None,
        )  # fmt: skip
        return psi_d + self.psi_shift, psi_q

    def torque_nm(self, i_d_a: ArrayLike, i_q_a: ArrayLike) -> Array:
        """Return 1.5 p (psi_d i_q - psi_q i_d) (N m)."""
        psi_d, psi_q = self.flux(i_d_a, i_q_a)
        return air_gap_torque(self.pole_pairs, psi_d, psi_q, np.asarray(i_d_a, float), np.asarray(i_q_a, float))

    def voltage_v(self, i_d_a: ArrayLike, i_q_a: ArrayLike, omega_e: ArrayLike) -> Array:
        """Return the amplitude of the steady-state voltage (V peak) at electrical speeds (rad/s)."""
        psi_d, psi_q = self.flux(i_d_a, i_q_a)
        omega = np.asarray(omega_e)
        return np.hypot(self.R * np.asarray(i_d_a) - omega * psi_q, self.R * np.asarray(i_q_a) + omega * psi_d)

    def as_struct(self, I_max_apk: float, i_d_min_a: float = -math.inf) -> PlaneStruct:
        """Return ``pmsm_plane`` for the kernel."""
        plane = PlaneStruct(
            R=self.R, pole_pairs=self.pole_pairs, L_d=self.L_d, L_q=self.L_q, psi_f=self.psi_f,
            psi_shift=self.psi_shift, I_max=I_max_apk, i_d_min=i_d_min_a,
        )  # fmt: skip
        plane.maps = tuple(m.as_struct(inverse=False) for m in (self.flux_map, self.loss_map) if m is not None)
        if self.flux_map is not None:
            plane.map = ctypes.pointer(plane.maps[0])
        if self.loss_map is not None:
            plane.loss = ctypes.pointer(plane.maps[-1])
        return plane

    def content(self) -> str:
        """Return one line that fixes the machine: numbers in full and the hashes of its maps."""
        numbers = (self.pole_pairs, self.R, self.L_d, self.L_q, self.psi_f, self.psi_shift)
        maps = tuple("" if m is None else m.content_hash() for m in (self.flux_map, self.loss_map))
        return " ".join(repr(part) for part in (*numbers, *maps))


def at_temperature(
    machine: MachineParameters,
    flux_map: FluxMap | None = None,
    *,
    T_winding_c: float | None = None,
    T_magnet_c: float | None = None,
    loss_map: FluxMap | None = None,
) -> OperatingMachine:
    """Return the machine at temperatures (degC); T_ref where none is given."""
    psi_f = magnet_flux_at(machine, machine.T_ref_c if T_magnet_c is None else T_magnet_c)
    return OperatingMachine(
        machine.pole_pairs,
        resistance_at(machine, machine.T_ref_c if T_winding_c is None else T_winding_c),
        machine.L_d_decoupling_h,
        machine.L_q_decoupling_h,
        psi_f,
        flux_map,
        0.0 if flux_map is None else psi_f - machine.psi_f_wb,
        loss_map,
    )
