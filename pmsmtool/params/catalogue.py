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
from dataclasses import dataclass
from typing import Literal

from pmsmtool.machine.temperature import COPPER_ALPHA_PER_K, MAGNET_ALPHA_PER_K

SCHEMA_VERSION = 1
"""Counted by hand when a value changes meaning; a migration accompanies each step."""

K_MAX_NOT_DETERMINED = 255
"""Value of ``governor.k_max`` that says: the horizon is not finitely determined."""

WireType = Literal["UNSIGNED8", "UNSIGNED16", "UNSIGNED32", "REAL32"]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of the drive.

    Attributes
    ----------
    name : str
        Catalogue name, ``group.key``; the unit is the key's suffix.
    index, sub : int
        Object in the reference drive's dictionary.
    wire : WireType
        CiA 301 data type of that object.
    unit : str
        SI unit, as in ``units.UNITS``.
    default, minimum, maximum : float
        Factory value and inclusive bounds, in SI.
    live : bool
        Whether the drive takes a change while it is enabled (RPDO-mappable gain).
    meaning : str
        One line for help texts and C comments.
    """

    name: str
    index: int
    sub: int
    wire: WireType
    unit: str
    default: float
    minimum: float
    maximum: float
    live: bool
    meaning: str

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

_ROWS: tuple[tuple[str, int, int, WireType, str, float, float, float, bool, str], ...] = (
    # 0x2010 motor data (defaults: Jercic et al. 2017, Table 1)
    ("motor.pole_pairs", 0x2010, 0x01, _U8, "1", 4, 1, 64, False, "pole pairs"),
    ("motor.R_s_ohm", 0x2010, 0x02, _F32, "ohm", 0.137, 1e-5, 1e3, False, "loop resistance per phase at T_ref"),
    ("motor.L_d_h", 0x2010, 0x03, _F32, "H", 0.0023, 1e-7, 10, False, "incremental d inductance"),
    ("motor.L_q_h", 0x2010, 0x04, _F32, "H", 0.0021, 1e-7, 10, False, "incremental q inductance"),
    ("motor.psi_f_wb", 0x2010, 0x05, _F32, "Wb", 0.41, 0, 100, False, "PM flux linkage at T_ref (peak)"),
    ("motor.I_max_apk", 0x2010, 0x06, _F32, "A", 56, 1e-3, 1e5, False, "time-limited peak current"),
    ("motor.I_nom_apk", 0x2010, 0x07, _F32, "A", 28, 1e-3, 1e5, False, "rated current (peak)"),
    ("motor.J_kgm2", 0x2010, 0x08, _F32, "kg m2", 0, 0, 1e4, False, "total inertia"),
    ("motor.T_ref_c", 0x2010, 0x09, _F32, "degC", 20, -60, 200, False, "reference temperature of R_s and psi_f"),
    (
        "motor.alpha_R_per_k",
        0x2010,
        0x0A,
        _F32,
        "1/K",
        COPPER_ALPHA_PER_K,
        0,
        0.01,
        False,
        "temperature coefficient of R_s (copper's times its share)",
    ),
    (
        "motor.alpha_psi_per_k",
        0x2010,
        0x0B,
        _F32,
        "1/K",
        MAGNET_ALPHA_PER_K,
        -0.01,
        0.001,
        False,
        "temperature coefficient of the magnet flux",
    ),
    ("motor.L_d_app_h", 0x2010, 0x0C, _F32, "H", 0.0023, 1e-7, 10, False, "apparent d inductance (decoupling, torque)"),
    ("motor.L_q_app_h", 0x2010, 0x0D, _F32, "H", 0.0021, 1e-7, 10, False, "apparent q inductance (decoupling, torque)"),
    ("motor.B_nms", 0x2010, 0x0E, _F32, "N m s", 0, 0, 1e4, False, "viscous friction"),
    ("motor.tau_c_nm", 0x2010, 0x0F, _F32, "N m", 0, 0, 1e5, False, "Coulomb friction torque"),
    ("motor.I_max_time_s", 0x2010, 0x10, _F32, "s", 10, 0, 3600, False, "time I_max may flow from cold (I2t)"),
    ("motor.n_max_rpm", 0x2010, 0x11, _F32, "rpm", 1200, 1, 1e6, False, "largest mechanical speed"),
    # 0x2011 inverter and timing
    ("inverter.T_s_ns", 0x2011, 0x01, _U32, "ns", 83333, 5000, 10_000_000, False, "control period"),
    ("inverter.voltage_utilisation", 0x2011, 0x02, _F32, "1", 0.577350269, 0.1, 0.6366198, False, "V_max / U_dc"),
    ("inverter.dead_time_ns", 0x2011, 0x03, _U16, "ns", 2000, 0, 20000, False, "dead time per switching edge"),
    (
        "inverter.delay_periods",
        0x2011,
        0x04,
        _F32,
        "1",
        1.5,
        0.5,
        3,
        False,
        "delay from sample to mean applied voltage, in T_s",
    ),
    ("inverter.deadtime_compensation", 0x2011, 0x05, _U8, "1", 0, 0, 1, False, "0 off, 1 on (V_dead, i_knee)"),
    ("inverter.V_dead_v", 0x2011, 0x06, _F32, "V", 0, 0, 1e3, False, "compensated voltage error of one phase"),
    (
        "inverter.i_knee_apk",
        0x2011,
        0x07,
        _F32,
        "A",
        0.5,
        1e-4,
        1e4,
        False,
        "current at which the error reaches its plateau",
    ),
    ("inverter.U_dc_nom_v", 0x2011, 0x08, _F32, "V", 210, 1, 2000, False, "nominal DC-link voltage"),
    # 0x2012 protection
    ("protection.i_trip_apk", 0x2012, 0x01, _F32, "A", 84, 1e-3, 1e5, False, "instantaneous trip of any phase current"),
    ("protection.U_dc_min_v", 0x2012, 0x02, _F32, "V", 20, 0, 2000, False, "undervoltage trip"),
    ("protection.U_dc_max_v", 0x2012, 0x03, _F32, "V", 800, 1, 2000, False, "overvoltage trip"),
    ("protection.n_trip_rpm", 0x2012, 0x04, _F32, "rpm", 1800, 1, 2e6, False, "overspeed trip"),
    ("protection.T_winding_max_c", 0x2012, 0x05, _F32, "degC", 155, 20, 300, False, "winding over-temperature trip"),
    (
        "protection.I_cont_apk",
        0x2012,
        0x06,
        _F32,
        "A",
        28,
        1e-3,
        1e5,
        False,
        "current limit once the I2t budget is used",
    ),
    (
        "protection.n_short_circuit_rpm",
        0x2012,
        0x07,
        _F32,
        "rpm",
        0,
        0,
        2e6,
        False,
        "a fault above it shorts the windings, below it removes the gates; 0: removes them at every speed",
    ),
    # 0x2013 encoder
    (
        "encoder.offset_rad",
        0x2013,
        0x01,
        _F32,
        "rad",
        0,
        -6.2831855,
        6.2831855,
        False,
        "theta_e = direction p theta_M - offset",
    ),
    ("encoder.reversed", 0x2013, 0x02, _U8, "1", 0, 0, 1, False, "1: the encoder counts against the phase order"),
    (
        "encoder.pll_bandwidth_rad_s",
        0x2013,
        0x03,
        _F32,
        "rad/s",
        600,
        1,
        1e5,
        False,
        "natural frequency of the speed estimate",
    ),
    # 0x2014 Hall sensors
    (
        "hall.commutation",
        0x2014,
        0x01,
        _U8,
        "1",
        0,
        0,
        3,
        False,
        "by Hall sensors: 0 not, 1 start, 2 alone, 3 six steps",
    ),
    ("hall.axis_1_rad", 0x2014, 0x02, _F32, "rad", 0, -6.2831855, 6.2831855, False, "middle of wire 1's high half"),
    ("hall.axis_2_rad", 0x2014, 0x03, _F32, "rad", 2.0943951, -6.2831855, 6.2831855, False, "of wire 2's, electrical"),
    ("hall.axis_3_rad", 0x2014, 0x04, _F32, "rad", 4.1887902, -6.2831855, 6.2831855, False, "of wire 3's, electrical"),
    # 0x2020 current controller
    ("current.K_p_d_v_per_a", 0x2020, 0x01, _F32, "V/A", 6.9, 0, 1e5, True, "proportional gain, d axis"),
    ("current.K_i_d_v_per_as", 0x2020, 0x02, _F32, "V/(A s)", 411, 0, 1e8, True, "integral gain, d axis"),
    ("current.K_p_q_v_per_a", 0x2020, 0x03, _F32, "V/A", 6.3, 0, 1e5, True, "proportional gain, q axis"),
    ("current.K_i_q_v_per_as", 0x2020, 0x04, _F32, "V/(A s)", 411, 0, 1e8, True, "integral gain, q axis"),
    (
        "current.options",
        0x2020,
        0x05,
        _U8,
        "1",
        7,
        0,
        63,
        False,
        "bit0 decoupling, bit1 emf feed-forward, bit2 back-calculation, bit3 hexagon limit, bit4 one-step predictor, bit5 record the dead-time compensation in u_d_lim, u_q_lim",
    ),
    # 0x2021 speed controller
    ("speed.K_p_nms_per_rad", 0x2021, 0x01, _F32, "N m s/rad", 0, 0, 1e6, True, "proportional gain"),
    ("speed.K_i_nm_per_rad", 0x2021, 0x02, _F32, "N m/rad", 0, 0, 1e8, True, "integral gain"),
    ("speed.filter_hz", 0x2021, 0x03, _F32, "Hz", 200, 1, 1e5, False, "feedback filter cut-off"),
    ("speed.tau_max_nm", 0x2021, 0x04, _F32, "N m", 130, 0, 1e6, False, "torque limit of the speed controller"),
    ("speed.decimation", 0x2021, 0x05, _U16, "1", 10, 1, 1000, False, "control periods per speed-controller period"),
    ("speed.notch_hz", 0x2021, 0x06, _F32, "Hz", 0, 0, 1e5, False, "notch frequency, 0 off"),
    ("speed.notch_zeta_num", 0x2021, 0x07, _F32, "1", 0.05, 0, 10, False, "notch numerator damping"),
    ("speed.notch_zeta_den", 0x2021, 0x08, _F32, "1", 0.5, 0.01, 10, False, "notch denominator damping"),
    (
        "speed.acceleration_rpm_per_s",
        0x2021,
        0x09,
        _F32,
        "rpm/s",
        1e5,
        0.1,
        1e9,
        False,
        "slope limit of the speed reference",
    ),
    # 0x2022 position controller, above the speed controller and in its period (subs 04..07: other makers' drives)
    (
        "position.K_p_per_s",
        0x2022,
        0x01,
        _F32,
        "1/s",
        0,
        0,
        1e5,
        True,
        "speed reference per position error, 0: not tuned",
    ),
    ("position.velocity_ff", 0x2022, 0x02, _F32, "1", 1, 0, 2, True, "share of a move's speed added to it"),
    (
        "position.inertia_ff_kgm2",
        0x2022,
        0x03,
        _F32,
        "kg m2",
        0,
        0,
        1e4,
        True,
        "torque per acceleration of a move",
    ),
    # 0x2030 reference governor (subs 04..08 are its read-only status)
    (
        "governor.mode",
        0x2030,
        0x01,
        _U8,
        "1",
        0,
        0,
        5,
        False,
        "0 off, 1 paper (exact), 2 line search, 3 best, 4 linearised, 5 observe",
    ),
    ("governor.k_max", 0x2030, 0x02, _U8, "1", 5, 0, 255, False, "horizon in T_s, 255 not determined"),
    ("governor.eps", 0x2030, 0x03, _F32, "1", 0.02, 0, 0.5, False, "tightening of the steady-state row"),
    (
        "governor.options",
        0x2030,
        0x09,
        _U8,
        "1",
        0,
        0,
        31,
        False,
        "bit0 hexagon row 0, bit1 predictor, bit2 current row, bit3 pre-projection, bit4 minimum-time direction",
    ),
    ("governor.I_transient_apk", 0x2030, 0x0A, _F32, "A", 56, 1e-3, 1e5, False, "transient current limit"),
    ("governor.observer_gain", 0x2030, 0x0B, _F32, "1", 0.1, 0, 1, False, "disturbance observer gain per T_s"),
    ("governor.alpha_rad_s", 0x2030, 0x0C, _F32, "rad/s", 3000, 1, 1e6, False, "bandwidth the rows are built for"),
    ("governor.slack", 0x2030, 0x0D, _F32, "1", 0.0002, 0, 0.1, False, "squared-voltage slack before the fallback"),
    # 0x2040 field weakening
    (
        "field_weakening.mode",
        0x2040,
        0x01,
        _U8,
        "1",
        0,
        0,
        4,
        False,
        "0 off, 1 look-up, 2 gradient, 3 accelerated, 4 uncompensated gradient",
    ),
    ("field_weakening.N_fw", 0x2040, 0x02, _U16, "1", 50, 1, 10000, False, "control periods per optimisation step"),
    ("field_weakening.margin", 0x2040, 0x03, _F32, "1", 0.08, 0, 0.5, False, "V_m = (1 - margin) V_max"),
    ("field_weakening.h1", 0x2040, 0x04, _F32, "1/(N m)2", 1, 0, 1e9, False, "weight of the torque error"),
    ("field_weakening.h2", 0x2040, 0x05, _F32, "1/A2", 0.001, 0, 1e9, False, "weight of i_d - i_d_LM"),
    ("field_weakening.beta", 0x2040, 0x06, _F32, "1", 0.06, 0, 1e9, False, "first step length"),
    ("field_weakening.sigma", 0x2040, 0x07, _F32, "1", 0.1, 0, 1, False, "Armijo constant"),
    ("field_weakening.iterations", 0x2040, 0x08, _U8, "1", 8, 1, 255, False, "iterations per call"),
    ("field_weakening.i_d_min_a", 0x2040, 0x09, _F32, "A", -56, -1e5, 0, False, "most negative i_d (demagnetisation)"),
    ("field_weakening.i_d_lm_a", 0x2040, 0x0A, _F32, "A", 0, -1e5, 1e5, False, "loss-minimising i_d"),
    # 0x2041 look-up table descriptor (axes and tables are the DOMAIN objects 0x2042..0x2046)
    ("lut.format", 0x2041, 0x01, _U8, "1", 0, 0, 2, False, "0 none, 1 binary32, 2 int16 times lsb"),
    (
        "lut.axis_kind",
        0x2041,
        0x02,
        _U8,
        "1",
        0,
        0,
        1,
        False,
        "second axis: 0 mechanical speed (rpm), 1 flux limit (Wb)",
    ),
    ("lut.n_x", 0x2041, 0x03, _U8, "1", 0, 0, 255, False, "nodes of the torque axis"),
    ("lut.n_y", 0x2041, 0x04, _U8, "1", 0, 0, 255, False, "nodes of the speed or flux axis"),
    ("lut.n_z", 0x2041, 0x05, _U8, "1", 0, 0, 16, False, "nodes of the U_dc axis, 1 when there is none"),
    ("lut.lsb_a", 0x2041, 0x06, _F32, "A", 0, 0, 100, False, "current of one int16 step"),
    # 0x2047 saturation table (its nodes are the DOMAIN object 0x2049)
    ("saturation.n_d", 0x2047, 0x01, _U8, "1", 0, 0, 32, False, "nodes along i_d, 0 without saturation"),
    ("saturation.n_q", 0x2047, 0x02, _U8, "1", 0, 0, 32, False, "nodes along i_q, from 0 on"),
    ("saturation.i_d_min_a", 0x2047, 0x03, _F32, "A", 0, -1e5, 0, False, "first node along i_d"),
    ("saturation.i_d_max_a", 0x2047, 0x04, _F32, "A", 0, 0, 1e5, False, "last node along i_d"),
    ("saturation.i_q_max_a", 0x2047, 0x05, _F32, "A", 0, 0, 1e5, False, "last node along i_q"),
    # 0x2048 polar-coordinate controller (Miyajima et al. 2013)
    (
        "polar.mode",
        0x2048,
        0x01,
        _U8,
        "1",
        0,
        0,
        6,
        False,
        "0 off, 1 conventional, 2 proposed, 3 linear range, 4 linear as printed, 5 regularised, 6 unified",
    ),
    (
        "polar.options",
        0x2048,
        0x02,
        _U8,
        "1",
        0,
        0,
        15,
        False,
        "bit0 P and D on the measurement, bit1 no anti-windup, bit2 predict over the delay, bit3 switch to 5 in the linear range",
    ),
    ("polar.V_a_max_ratio", 0x2048, 0x03, _F32, "1", 1, 0.1, 1.2, False, "amplitude limit / V_max"),
    ("polar.sigma_phase_rad_s", 0x2048, 0x04, _F32, "rad/s", 600, 1, 1e6, False, "real part of the phase loop's poles"),
    (
        "polar.sigma_amplitude_rad_s",
        0x2048,
        0x05,
        _F32,
        "rad/s",
        300,
        1,
        1e6,
        False,
        "real part of the amplitude loop's poles",
    ),
    ("polar.tau_s", 0x2048, 0x06, _F32, "s", 0.001, 1e-6, 1, False, "CDM equivalent time constant"),
    ("polar.gamma", 0x2048, 0x07, _F32, "1", 2.5, 1, 10, False, "CDM stability index"),
    ("polar.omega_c_rad_s", 0x2048, 0x08, _F32, "rad/s", 1250, 1, 1e6, False, "bandwidth of the unified law"),
    ("polar.omega_dob_rad_s", 0x2048, 0x09, _F32, "rad/s", 400, 0, 1e6, False, "disturbance observer bandwidth"),
    ("polar.eps_ratio", 0x2048, 0x0A, _F32, "1", 0.02, 0, 1, False, "regularisation radius / V_max of the polar map"),
    ("polar.b", 0x2048, 0x0B, _F32, "1", 0, 0, 1, False, "set-point weight of the regularised law"),
    (
        "polar.V_ref_ratio",
        0x2048,
        0x0C,
        _F32,
        "1",
        1,
        0.1,
        1.2,
        False,
        "reference amplitude of the unified law / V_max",
    ),
)

CATALOGUE: tuple[Parameter, ...] = tuple(Parameter(*row) for row in _ROWS)
"""All parameters, in the order of the C struct and of the packed image."""

CLOSED_DRIVE: tuple[Parameter, ...] = tuple(
    Parameter(*row)
    for row in (
        (
            "reference.tau_rated_nm",
            0x6076,
            0,
            _F32,
            "N m",
            65,
            1e-3,
            4e6,
            False,
            "rated torque, base of relative torques",
        ),
        (
            "reference.torque_slope_nm_per_s",
            0x6087,
            0,
            _F32,
            "N m/s",
            1e4,
            1e-3,
            1e9,
            False,
            "slope limit of the torque set-point",
        ),
        ("reference.K_t_nm_per_a", 0x2023, 1, _F32, "N m/A", 1, 1e-6, 1e4, False, "torque per A as a drive counts it"),
        ("reference.encoder_increments", 0x608F, 1, _F32, "1", 65536, 4, 2**32, False, "increments of a turn"),
        ("reference.profile_speed_rpm", 0x6081, 0, _F32, "rpm", 1000, 0, 1e6, False, "speed of a move"),
        (
            "reference.profile_acceleration_rpm_per_s",
            0x6083,
            0,
            _F32,
            "rpm/s",
            1e4,
            0,
            1e9,
            False,
            "acceleration of a move",
        ),
        (
            "reference.profile_deceleration_rpm_per_s",
            0x6084,
            0,
            _F32,
            "rpm/s",
            1e4,
            0,
            1e9,
            False,
            "deceleration of a move",
        ),
        ("reference.profile_jerk_rpm_per_s2", 0x60A4, 1, _F32, "rpm/s2", 1e6, 0, 1e12, False, "jerk of a move"),
        ("speed.inertia_ff_kgm2", 0x2023, 2, _F32, "kg m2", 0, 0, 1e4, True, "torque per reference acceleration"),
        ("speed.friction_ff_nms_per_rad", 0x2023, 3, _F32, "N m s/rad", 0, 0, 1e4, True, "torque per reference speed"),
        ("position.friction_ff_nms_per_rad", 0x2022, 4, _F32, "N m s/rad", 0, 0, 1e4, True, "torque per move speed"),
        ("position.pid_p_nm_per_rad", 0x2022, 5, _F32, "N m/rad", 0, 0, 1e8, True, "torque per position error"),
        ("position.pid_i_nm_per_rads", 0x2022, 6, _F32, "N m/(rad s)", 0, 0, 1e10, True, "torque per integral of it"),
        ("position.pid_d_nms_per_rad", 0x2022, 7, _F32, "N m s/rad", 0, 0, 1e6, True, "torque per derivative of it"),
    )
)
"""What other makers' drives have besides: limits of CiA 402, speed and position loops. Not in the reference drive's image."""

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
