# SPDX-License-Identifier: MIT
"""The catalogue: one row per parameter of the drive, the one source for all its appearances.

A row yields the member of the C parameter struct (``firmware/core/pmsm_params.h`` is generated
from this table), the bytes of the packed image, the object in the drive's dictionary, the bounds
the drive and the tool check, the key of a parameter set, and the help text.

Every struct member is four bytes (binary32 or unsigned 32-bit), so the packed little-endian image
is the memory image on every target. An object may be narrower on the wire (UNSIGNED8, UNSIGNED16);
its value is widened in the image.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Literal

from pmsmtool.machine.parameters import MAX_POLE_PAIRS
from pmsmtool.machine.temperature import COPPER_ALPHA_PER_K, MAGNET_ALPHA_PER_K

SCHEMA_VERSION = 1
"""Counted by hand when a value changes meaning; a migration accompanies each step."""

K_MAX_NOT_DETERMINED = 255
"""Value of ``governor.k_max`` that says: the horizon is not finitely determined."""

GOVERNOR_MODES = {"off": 0, "paper": 1, "line": 2, "best": 3, "linearised": 4, "observe": 5}
"""Names of ``governor.mode``."""

FIELD_WEAKENING_MODES = {"off": 0, "lookup": 1, "gradient": 2, "accelerated": 3, "uncompensated": 4}
"""Names of ``field_weakening.mode``."""

WireType = Literal["UNSIGNED8", "UNSIGNED16", "UNSIGNED32", "REAL32"]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of the drive."""

    name: str
    """Catalogue name, ``group.key``; the unit is the key's suffix."""
    index: int
    sub: int
    """Object in the reference drive's dictionary."""
    wire: WireType
    """CiA 301 data type of that object."""
    unit: str
    """SI unit, as in ``units.UNITS``."""
    default: float
    minimum: float
    maximum: float
    """Factory value and inclusive bounds, in SI."""
    live: bool
    """Whether the drive takes a change while it is enabled (RPDO-mappable gain)."""
    meaning: str
    """One line for help texts and C comments."""

    @property
    def is_integer(self) -> bool:
        """Whether the value is an unsigned integer."""
        return self.wire != "REAL32"

    @property
    def c_name(self) -> str:
        """Member of the C struct ``pmsm_params``: ``group_key``."""
        return self.name.replace(".", "_")


_U8: WireType = "UNSIGNED8"
_U16: WireType = "UNSIGNED16"
_U32: WireType = "UNSIGNED32"
_F32: WireType = "REAL32"

_Row = tuple[str, WireType, str, float, float, float, str]
"""Key, type, unit, factory value, least, largest, meaning."""


def _object(index: int, group: str, *rows: _Row, first: int = 1, live: Collection[str] = ()) -> Iterator[Parameter]:
    """Yield the parameters of an object: sub-indices one after the other, keys of ``live`` change while enabled."""
    for sub, (key, wire, unit, default, least, largest, meaning) in enumerate(rows, first):
        yield Parameter(f"{group}.{key}", index, sub, wire, unit, default, least, largest, key in live, meaning)


# fmt: off
CATALOGUE: tuple[Parameter, ...] = (
    # motor data (defaults: Jercic et al. 2017, Table 1)
    *_object(
        0x2010, "motor",
        ("pole_pairs", _U8, "1", 4, 1, MAX_POLE_PAIRS, "pole pairs"),
        ("R_s_ohm", _F32, "ohm", 0.137, 1e-5, 1e3, "loop resistance per phase at T_ref"),
        ("L_d_h", _F32, "H", 0.0023, 1e-7, 10, "incremental d inductance"),
        ("L_q_h", _F32, "H", 0.0021, 1e-7, 10, "incremental q inductance"),
        ("psi_f_wb", _F32, "Wb", 0.41, 0, 100, "PM flux linkage at T_ref (peak)"),
        ("I_max_apk", _F32, "A", 56, 1e-3, 1e5, "time-limited peak current"),
        ("I_nom_apk", _F32, "A", 28, 1e-3, 1e5, "rated current (peak)"),
        ("J_kgm2", _F32, "kg m2", 0, 0, 1e4, "total inertia"),
        ("T_ref_c", _F32, "degC", 20, -60, 200, "reference temperature of R_s and psi_f"),
        ("alpha_R_per_k", _F32, "1/K", COPPER_ALPHA_PER_K, 0, 0.01,
            "temperature coefficient of R_s (copper's times its share)"),
        ("alpha_psi_per_k", _F32, "1/K", MAGNET_ALPHA_PER_K, -0.01, 0.001,
            "temperature coefficient of the magnet flux"),
        ("L_d_app_h", _F32, "H", 0.0023, 1e-7, 10, "apparent d inductance (decoupling, torque)"),
        ("L_q_app_h", _F32, "H", 0.0021, 1e-7, 10, "apparent q inductance (decoupling, torque)"),
        ("B_nms", _F32, "N m s", 0, 0, 1e4, "viscous friction"),
        ("tau_c_nm", _F32, "N m", 0, 0, 1e5, "Coulomb friction torque"),
        ("I_max_time_s", _F32, "s", 10, 0, 3600, "time I_max may flow from cold (I2t)"),
        ("n_max_rpm", _F32, "rpm", 1200, 1, 1e6, "largest mechanical speed"),
    ),
    # inverter and timing
    *_object(
        0x2011, "inverter",
        ("T_s_ns", _U32, "ns", 83333, 5000, 10_000_000, "control period"),
        ("voltage_utilisation", _F32, "1", 0.577350269, 0.1, 0.6366198, "V_max / U_dc"),
        ("dead_time_ns", _U16, "ns", 2000, 0, 20000, "dead time per switching edge"),
        ("delay_periods", _F32, "1", 1.5, 0.5, 3, "delay from sample to mean applied voltage, in T_s"),
        ("deadtime_compensation", _U8, "1", 0, 0, 1, "0 off, 1 on (V_dead, i_knee)"),
        ("V_dead_v", _F32, "V", 0, 0, 1e3, "compensated voltage error of one phase"),
        ("i_knee_apk", _F32, "A", 0.5, 1e-4, 1e4, "current at which the error reaches its plateau"),
        ("U_dc_nom_v", _F32, "V", 210, 1, 2000, "nominal DC-link voltage"),
        ("min_off_time_ns", _U16, "ns", 0, 0, 20000, "time a leg's lower switch is on in each period"),
        ("sample_window_ns", _U16, "ns", 0, 0, 20000, "time that reading a shunt takes"),
        ("shunts", _U8, "1", 0, 0, 3, "shunts: 1 in the link, 3 in the legs, 0: sensors in the phases"),
    ),
    *_object(
        0x2012, "protection",
        ("i_trip_apk", _F32, "A", 84, 1e-3, 1e5, "instantaneous trip of any phase current"),
        ("U_dc_min_v", _F32, "V", 20, 0, 2000, "undervoltage trip"),
        ("U_dc_max_v", _F32, "V", 800, 1, 2000, "overvoltage trip"),
        ("n_trip_rpm", _F32, "rpm", 1800, 1, 2e6, "overspeed trip"),
        ("T_winding_max_c", _F32, "degC", 155, 20, 300, "winding over-temperature trip"),
        ("I_cont_apk", _F32, "A", 28, 1e-3, 1e5, "current limit once the I2t budget is used"),
        ("n_short_circuit_rpm", _F32, "rpm", 0, 0, 2e6,
            "a fault above it shorts the windings, below it removes the gates; 0: removes them at every speed"),
    ),
    *_object(
        0x2013, "encoder",
        ("offset_rad", _F32, "rad", 0, -6.2831855, 6.2831855, "theta_e = direction p theta_M - offset"),
        ("reversed", _U8, "1", 0, 0, 1, "1: the encoder counts against the phase order"),
        ("pll_bandwidth_rad_s", _F32, "rad/s", 600, 1, 1e5, "natural frequency of the speed estimate"),
    ),
    # Hall sensors
    *_object(
        0x2014, "hall",
        ("commutation", _U8, "1", 0, 0, 3, "by Hall sensors: 0 not, 1 start, 2 alone, 3 six steps"),
        ("axis_1_rad", _F32, "rad", 0, -6.2831855, 6.2831855, "middle of wire 1's high half"),
        ("axis_2_rad", _F32, "rad", 2.0943951, -6.2831855, 6.2831855, "of wire 2's, electrical"),
        ("axis_3_rad", _F32, "rad", 4.1887902, -6.2831855, 6.2831855, "of wire 3's, electrical"),
    ),
    # current controller
    *_object(
        0x2020, "current",
        ("K_p_d_v_per_a", _F32, "V/A", 6.9, 0, 1e5, "proportional gain, d axis"),
        ("K_i_d_v_per_as", _F32, "V/(A s)", 411, 0, 1e8, "integral gain, d axis"),
        ("K_p_q_v_per_a", _F32, "V/A", 6.3, 0, 1e5, "proportional gain, q axis"),
        ("K_i_q_v_per_as", _F32, "V/(A s)", 411, 0, 1e8, "integral gain, q axis"),
        ("options", _U8, "1", 7, 0, 63,
            "bit0 decoupling, bit1 emf feed-forward, bit2 back-calculation, bit3 hexagon limit, bit4 one-step "
            "predictor, bit5 record the dead-time compensation in u_d_lim, u_q_lim"),
        live=("K_p_d_v_per_a", "K_i_d_v_per_as", "K_p_q_v_per_a", "K_i_q_v_per_as"),
    ),
    # speed controller
    *_object(
        0x2021, "speed",
        ("K_p_nms_per_rad", _F32, "N m s/rad", 0, 0, 1e6, "proportional gain"),
        ("K_i_nm_per_rad", _F32, "N m/rad", 0, 0, 1e8, "integral gain"),
        ("filter_hz", _F32, "Hz", 200, 1, 1e5, "feedback filter cut-off"),
        ("tau_max_nm", _F32, "N m", 130, 0, 1e6, "torque limit of the speed controller"),
        ("decimation", _U16, "1", 10, 1, 1000, "control periods per speed-controller period"),
        ("notch_hz", _F32, "Hz", 0, 0, 1e5, "notch frequency, 0 off"),
        ("notch_zeta_num", _F32, "1", 0.05, 0, 10, "notch numerator damping"),
        ("notch_zeta_den", _F32, "1", 0.5, 0.01, 10, "notch denominator damping"),
        ("acceleration_rpm_per_s", _F32, "rpm/s", 1e5, 0.1, 1e9, "slope limit of the speed reference"),
        live=("K_p_nms_per_rad", "K_i_nm_per_rad"),
    ),
    # position controller, above the speed controller and in its period (subs 04..07: other makers' drives)
    *_object(
        0x2022, "position",
        ("K_p_per_s", _F32, "1/s", 0, 0, 1e5, "speed reference per position error, 0: not tuned"),
        ("velocity_ff", _F32, "1", 1, 0, 2, "share of a move's speed added to it"),
        ("inertia_ff_kgm2", _F32, "kg m2", 0, 0, 1e4, "torque per acceleration of a move"),
        live=("K_p_per_s", "velocity_ff", "inertia_ff_kgm2"),
    ),
    # reference governor (subs 04..08 are its read-only status)
    *_object(
        0x2030, "governor",
        ("mode", _U8, "1", 0, 0, 5, "0 off, 1 paper (exact), 2 line search, 3 best, 4 linearised, 5 observe"),
        ("k_max", _U8, "1", 5, 0, 255, "horizon in T_s, 255 not determined"),
        ("eps", _F32, "1", 0.02, 0, 0.5, "tightening of the steady-state row"),
    ),
    *_object(
        0x2030, "governor",
        ("options", _U8, "1", 0, 0, 31,
            "bit0 hexagon row 0, bit1 predictor, bit2 current row, bit3 pre-projection, bit4 minimum-time direction"),
        ("I_transient_apk", _F32, "A", 56, 1e-3, 1e5, "transient current limit"),
        ("observer_gain", _F32, "1", 0.1, 0, 1, "disturbance observer gain per T_s"),
        ("alpha_rad_s", _F32, "rad/s", 3000, 1, 1e6, "bandwidth the rows are built for"),
        ("slack", _F32, "1", 0.0002, 0, 0.1, "squared-voltage slack before the fallback"),
        first=9,
    ),
    # field weakening
    *_object(
        0x2040, "field_weakening",
        ("mode", _U8, "1", 0, 0, 4, "0 off, 1 look-up, 2 gradient, 3 accelerated, 4 uncompensated gradient"),
        ("N_fw", _U16, "1", 50, 1, 10000, "control periods per optimisation step"),
        ("margin", _F32, "1", 0.08, 0, 0.5, "V_m = (1 - margin) V_max"),
        ("h1", _F32, "1/(N m)2", 1, 0, 1e9, "weight of the torque error"),
        ("h2", _F32, "1/A2", 0.001, 0, 1e9, "weight of i_d - i_d_LM"),
        ("beta", _F32, "1", 0.06, 0, 1e9, "first step length"),
        ("sigma", _F32, "1", 0.1, 0, 1, "Armijo constant"),
        ("iterations", _U8, "1", 8, 1, 255, "iterations per call"),
        ("i_d_min_a", _F32, "A", -56, -1e5, 0, "most negative i_d (demagnetisation)"),
        ("i_d_lm_a", _F32, "A", 0, -1e5, 1e5, "loss-minimising i_d"),
    ),
    # look-up table descriptor (axes and tables are the DOMAIN objects 0x2042..0x2046)
    *_object(
        0x2041, "lut",
        ("format", _U8, "1", 0, 0, 2, "0 none, 1 binary32, 2 int16 times lsb"),
        ("axis_kind", _U8, "1", 0, 0, 1, "second axis: 0 mechanical speed (rpm), 1 flux limit (Wb)"),
        ("n_x", _U8, "1", 0, 0, 255, "nodes of the torque axis"),
        ("n_y", _U8, "1", 0, 0, 255, "nodes of the speed or flux axis"),
        ("n_z", _U8, "1", 0, 0, 16, "nodes of the U_dc axis, 1 when there is none"),
        ("lsb_a", _F32, "A", 0, 0, 100, "current of one int16 step"),
    ),
    # saturation table (its nodes are the DOMAIN object 0x2049)
    *_object(
        0x2047, "saturation",
        ("n_d", _U8, "1", 0, 0, 32, "nodes along i_d, 0 without saturation"),
        ("n_q", _U8, "1", 0, 0, 32, "nodes along i_q, from 0 on"),
        ("i_d_min_a", _F32, "A", 0, -1e5, 0, "first node along i_d"),
        ("i_d_max_a", _F32, "A", 0, 0, 1e5, "last node along i_d"),
        ("i_q_max_a", _F32, "A", 0, 0, 1e5, "last node along i_q"),
    ),
    # polar-coordinate controller (Miyajima et al. 2013)
    *_object(
        0x2048, "polar",
        ("mode", _U8, "1", 0, 0, 6,
            "0 off, 1 conventional, 2 proposed, 3 linear range, 4 linear as printed, 5 regularised, 6 unified"),
        ("options", _U8, "1", 0, 0, 15,
            "bit0 P and D on the measurement, bit1 no anti-windup, bit2 predict over the delay, bit3 switch "
            "to 5 in the linear range"),
        ("V_a_max_ratio", _F32, "1", 1, 0.1, 1.2, "amplitude limit / V_max"),
        ("sigma_phase_rad_s", _F32, "rad/s", 600, 1, 1e6, "real part of the phase loop's poles"),
        ("sigma_amplitude_rad_s", _F32, "rad/s", 300, 1, 1e6, "real part of the amplitude loop's poles"),
        ("tau_s", _F32, "s", 0.001, 1e-6, 1, "CDM equivalent time constant"),
        ("gamma", _F32, "1", 2.5, 1, 10, "CDM stability index"),
        ("omega_c_rad_s", _F32, "rad/s", 1250, 1, 1e6, "bandwidth of the unified law"),
        ("omega_dob_rad_s", _F32, "rad/s", 400, 0, 1e6, "disturbance observer bandwidth"),
        ("eps_ratio", _F32, "1", 0.02, 0, 1, "regularisation radius / V_max of the polar map"),
        ("b", _F32, "1", 0, 0, 1, "set-point weight of the regularised law"),
        ("V_ref_ratio", _F32, "1", 1, 0.1, 1.2, "reference amplitude of the unified law / V_max"),
    ),
)
"""All parameters, in the order of the C struct and of the packed image."""

CLOSED_DRIVE: tuple[Parameter, ...] = (
    Parameter("reference.tau_rated_nm", 0x6076, 0, _F32, "N m", 65, 1e-3, 4e6, False,
        "rated torque, base of relative torques"),
    Parameter("reference.torque_slope_nm_per_s", 0x6087, 0, _F32, "N m/s", 1e4, 1e-3, 1e9, False,
        "slope limit of the torque set-point"),
    Parameter("reference.K_t_nm_per_a", 0x2023, 1, _F32, "N m/A", 1, 1e-6, 1e4, False,
        "torque per A as a drive counts it"),
    Parameter("reference.encoder_increments", 0x608F, 1, _F32, "1", 65536, 4, 2**32, False, "increments of a turn"),
    Parameter("reference.profile_speed_rpm", 0x6081, 0, _F32, "rpm", 1000, 0, 1e6, False, "speed of a move"),
    Parameter("reference.profile_acceleration_rpm_per_s", 0x6083, 0, _F32, "rpm/s", 1e4, 0, 1e9, False,
        "acceleration of a move"),
    Parameter("reference.profile_deceleration_rpm_per_s", 0x6084, 0, _F32, "rpm/s", 1e4, 0, 1e9, False,
        "deceleration of a move"),
    Parameter("reference.profile_jerk_rpm_per_s2", 0x60A4, 1, _F32, "rpm/s2", 1e6, 0, 1e12, False, "jerk of a move"),
    Parameter("speed.inertia_ff_kgm2", 0x2023, 2, _F32, "kg m2", 0, 0, 1e4, True, "torque per reference acceleration"),
    Parameter("speed.friction_ff_nms_per_rad", 0x2023, 3, _F32, "N m s/rad", 0, 0, 1e4, True,
        "torque per reference speed"),
    Parameter("position.friction_ff_nms_per_rad", 0x2022, 4, _F32, "N m s/rad", 0, 0, 1e4, True,
        "torque per move speed"),
    Parameter("position.pid_p_nm_per_rad", 0x2022, 5, _F32, "N m/rad", 0, 0, 1e8, True, "torque per position error"),
    Parameter("position.pid_i_nm_per_rads", 0x2022, 6, _F32, "N m/(rad s)", 0, 0, 1e10, True,
        "torque per integral of it"),
    Parameter("position.pid_d_nms_per_rad", 0x2022, 7, _F32, "N m s/rad", 0, 0, 1e6, True,
        "torque per derivative of it"),
    Parameter("position.acceleration_ff_s", 0x2022, 8, _F32, "s", 0, 0, 10, True,
        "speed per move acceleration, added to the reference of the speed"),
    Parameter("position.derivative_share", 0x2022, 9, _F32, "1", 0, 0, 10, True,
        "share of the speed of the position error, added to the reference of the speed"),
)
"""What other makers' drives have besides: limits of CiA 402, speed and position loops. Not in the reference drive's image."""
# fmt: on

TORQUE_PER_AMPERE = "reference.K_t_nm_per_a"
"""What gains in amperes rest on: compared with what a drive holds, never written."""
INCREMENTS = "reference.encoder_increments"
"""What gains per increment rest on: a drive's own are taken, never written."""
OWN_SCALES = (TORQUE_PER_AMPERE, INCREMENTS)
MIDDLE_KIND = 2.0**0.25
"""Torque per ampere of unknown kind over that per ampere peak: the geometric mean of peak and rms, 19 % from both."""

EVERY: tuple[Parameter, ...] = (*CATALOGUE, *CLOSED_DRIVE)
"""Everything a parameter set may hold, in its order."""

BY_NAME: dict[str, Parameter] = {row.name: row for row in EVERY}

LUT_CAPACITY_WORDS = 8192
"""Four-byte words the drive reserves for axes and tables (32 KiB)."""

LUT_LAYOUT = "lut:axis_x,axis_y,axis_z:binary32;table_i_d,table_i_q:format;row-major x,y,z;padded to 4 bytes"
SATURATION_LAYOUT = "saturation:nodes:binary32;row-major d,q,(psi_d,psi_q/i_q,dpsi_d/di_d,dpsi_q/di_q)"
"""What follows the scalars in the image, one after the other; part of the signature."""

SATURATION_VALUES = 4
"""Numbers of a node: psi_d (Wb), psi_q/i_q, dpsi_d/di_d and dpsi_q/di_q (H)."""
FLUX_MOST_WB, INDUCTANCE_RANGE_H = 100.0, (1e-7, 10.0)
"""Bounds of those numbers."""


def layout_text() -> str:
    """Return the lines ``name:type:dim:unit:scale`` in struct order that the signature covers."""
    lines = [f"{row.name}:{'u32' if row.is_integer else 'f32'}:1:{row.unit}:1" for row in CATALOGUE]
    return "\n".join([*lines, LUT_LAYOUT, SATURATION_LAYOUT])


def layout_signature() -> int:
    """Return the CRC-32 of :func:`layout_text`: a drive and a tool that differ in it do not talk."""
    return zlib.crc32(layout_text().encode("ascii"))
