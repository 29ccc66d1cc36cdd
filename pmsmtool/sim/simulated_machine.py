# SPDX-License-Identifier: MIT
"""From a machine file to the kernel's setup: the truth of ``[simulation]`` over what ``[machine]`` says.

Resistance: ``R_s_ohm`` is the loop. The devices' share (``device_slope_ohm``, in the switched model of an IGBT the mean
of switch and diode) is taken out of it for the phase, so that the loop is what the file says; only the copper part
(``R_winding_ohm`` over the phase, all of it when that is not given) follows the temperature.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pmsmtool.errors import ConfigError, next_step
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import hall_axis
from pmsmtool.machine.two_masses import damping_nms_per_rad
from pmsmtool.sim.kernel import Application, Rotor, Setup, library
from pmsmtool.units import RAD_S_PER_RPM

NEXT_STEP = "`pmsmtool help simulation` lists the keys of [simulation]"

SHAPES = ("none", "sign", "atan", "tanh", "capacitive")
"""``deadtime_shape`` in the order of ``enum pmsm_deadtime_shape``."""
MODELS = ("averaged", "switched")
"""``inverter_model`` in the order of ``enum pmsm_inverter_model``."""
ENCODERS = ("absolute", "index", "none")
"""``encoder_kind`` in the order of ``enum pmsm_sensor_encoder``."""
ROTORS = {"free": Rotor.FREE, "locked": Rotor.LOCKED, "driven": Rotor.DRIVEN}

DRIVE_FAULTS = {
    "none": "no fault",
    "not_connected": "no phase is connected to the machine",
    "unbalanced": "a bad joint: phase a has half of R_s more",
    "encoder_stuck": "the encoder keeps its first reading",
    "encoder_signal": "the encoder's signals are not there: fault 0x7305 with the first current",
    "phases_shorted": "two leads of the motor touch each other: fault 0x2320 with the first current",
    "safe_torque_off": "safe torque off is open: the drive does not leave SWITCH ON DISABLED",
    "supply_limit": "the supply is in current limit: the link falls to 60 % with the first current",
}
"""Values of ``drive_fault`` and what they mean."""
UNBALANCE_SHARE = 0.5
"""Further resistance of phase a in the fault ``unbalanced``, share of R_s."""
WRONG_COMPENSATION = 1.4
"""Plateau of ``compensation = "wrong"`` over the right one."""


class Settings:
    """The resolved ``[simulation]`` table with typed access."""

    def __init__(self, values: Mapping[str, Value]) -> None:
        self._values = values

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def number(self, name: str, default: float = 0.0) -> float:
        """Return a number, the default where neither the file nor its fall-back has one."""
        return float(self._values.get(name, default))  # type: ignore[arg-type]

    def whole(self, name: str) -> int:
        """Return a whole number."""
        return int(self._values[name])  # type: ignore[arg-type]

    def text(self, name: str) -> str:
        """Return a text."""
        return str(self._values[name])

    def flag(self, name: str) -> bool:
        """Return a flag."""
        return bool(self._values[name])


EXCHANGED = {ord("b"): "c", ord("c"): "b"}
"""Phases of the motor at the drive's leads b and c, where these are exchanged; ``none`` has neither letter."""


@next_step(NEXT_STEP)
def settings_of(machine_file: MachineFile) -> Settings:
    """Return the simulation settings as the drive meets them; the encoder's kind falls back to ``[encoder]``.

    Two swapped leads are resolved here. They mirror the machine: with its shaft counted along the phase order of the
    drive, it is the same machine with an encoder that counts the other way and has the opposite offset and angle.

    Raises ConfigError: ``drive_fault`` names no fault.
    """
    values = machine_file.simulation_settings()
    if "encoder_reversed" not in machine_file.simulation:
        values["encoder_reversed"] = machine_file.encoder.direction < 0
    if "encoder_bits" not in machine_file.simulation and machine_file.encoder.bits is not None:
        values["encoder_bits"] = machine_file.encoder.bits
    if values["leads_swapped"]:
        values["encoder_reversed"] = not values["encoder_reversed"]
        # the sensors sit in the motor: those of its phases b and c have their places on the drive's axes exchanged
        values["hall_order"] = str(values["hall_order"]).translate(EXCHANGED)
        b, c = "hall_error_b_rad", "hall_error_c_rad"
        values[b], values[c] = values[c], values[b]
        for name in ("encoder_offset_rad", "theta_M_start_rad", "hall_offset_rad", "hall_error_a_rad", b, c):
            values[name] = -float(values.get(name, 0.0))  # type: ignore[arg-type]
    if values["drive_fault"] not in DRIVE_FAULTS:
        raise ConfigError(
            f"there is no drive fault {values['drive_fault']!r}",
            where=f"{machine_file.name}: [simulation] drive_fault",
            hint=f"one of {', '.join(DRIVE_FAULTS)}",
        )
    return Settings(values)


@next_step(NEXT_STEP)
def with_simulation(machine_file: MachineFile, changes: Mapping[str, Value]) -> MachineFile:
    """Return the machine with other simulation keys; they are checked as in a file.

    Raises ConfigError: an unknown key or a bad value.
    """
    from pmsmtool.machine.key import check_table
    from pmsmtool.machine.simulation_keys import SIMULATION_KEYS

    violations: list[str] = []
    where = {"": "[simulation]", **{name: f"[simulation] {name}" for name in changes}}
    checked = check_table(dict(changes), SIMULATION_KEYS, where, violations, {})
    if violations:
        raise ConfigError("the simulation settings cannot be used", violations=violations)
    return replace(machine_file, simulation={**machine_file.simulation, **checked})


@next_step(NEXT_STEP)
def build_setup(
    machine_file: MachineFile,
    *,
    seed: int | None = None,
    application: Application = Application.DRIVE,
    start_rad_s: float = 0.0,
) -> tuple[Setup, object]:
    """Return the kernel's setup and the object that keeps its flux map alive.

    Raises ConfigError: what cannot be simulated, all of it.

    Parameters
    ----------
    machine_file : MachineFile
        Machine and its ``[simulation]``.
    seed : int, optional
        Seed of the noise; default the file's.
    application : Application
        Whole drive, or the control core alone.
    start_rad_s : float
        Mechanical speed at the start (rad/s); a driven rotor without a schedule keeps it.
    """
    settings = settings_of(machine_file)
    violations: list[str] = []
    setup = Setup()
    keep = _machine(setup.machine, machine_file, settings, violations)
    _inverter(setup.inverter, settings, violations)
    _sensors(setup.sensors, settings, violations)
    _timing(setup, machine_file, settings, violations)
    setup.U_dc, setup.load = settings.number("U_dc_v"), settings.number("load_nm")
    setup.U_dc_ripple, setup.U_dc_ripple_hz = settings.number("U_dc_ripple_v"), settings.number("U_dc_ripple_hz")
    setup.U_dc_source, setup.U_dc_source_time = settings.number("U_dc_source_ohm"), settings.number("U_dc_source_s")
    setup.U_dc_capacitance = settings.number("U_dc_capacitance_f")
    setup.U_dc_chopper, setup.U_dc_chopper_ohm = settings.number("U_dc_chopper_v"), settings.number("U_dc_chopper_ohm")
    setup.T_winding, setup.T_magnet = settings.number("T_winding_c"), settings.number("T_magnet_c")
    setup.theta_M = settings.number("theta_M_start_rad")
    driven = setup.machine.rotor == Rotor.DRIVEN and start_rad_s == 0.0
    setup.omega_M = RAD_S_PER_RPM * settings.number("driven_rpm") if driven else start_rad_s
    setup.seed = settings.whole("seed") if seed is None else seed
    setup.application = application
    if violations:
        raise ConfigError("this machine cannot be simulated", where=machine_file.name, violations=violations)
    return setup, keep


def device_slope_ohm(settings: Settings) -> float:
    """Return the devices' share of the loop resistance (ohm)."""
    switch, diode = settings.number("device_slope_ohm"), settings.number("diode_slope_ohm")
    two_kinds = settings.text("inverter_model") == "switched" and settings.number("device_drop_v") > 0.0
    return 0.5 * (switch + diode) if two_kinds else switch


def _machine(out: Any, machine_file: MachineFile, settings: Settings, violations: list[str]) -> object:
    machine = machine_file.machine
    devices = device_slope_ohm(settings)
    # phase a has 1.5 times the imbalance more in its lead
    R_phase = settings.number("R_s_ohm") * (1.0 - 0.5 * settings.number("resistance_imbalance")) - devices
    if R_phase <= 0.0:
        violations.append(f"R_s_ohm is the loop and must exceed the devices' share of {devices:g} ohm")
    winding = machine.R_winding_ohm
    share = 1.0 if winding is None else min(1.0, winding / max(machine.R_s_ohm - devices, 1e-12))
    out.R_copper, out.R_fixed = share * R_phase, (1.0 - share) * R_phase
    out.pole_pairs = settings.whole("pole_pairs")
    out.L_d, out.L_q, out.psi_f = (settings.number(name) for name in ("L_d_h", "L_q_h", "psi_f_wb"))
    out.L_6, out.L_imbalance = settings.number("inductance_6"), settings.number("inductance_imbalance")
    out.T_ref, out.alpha_R = machine.T_ref_c, machine.alpha_R_per_k
    out.alpha_psi = settings.number("alpha_psi_per_k")
    out.R_iron = settings.number("iron_loss_ohm")
    out.psi_6, out.psi_12, out.psi_7 = (settings.number(f"psi_{order}_wb") for order in (6, 12, 7))
    eddy = settings.number("eddy_share")
    if eddy > 0.0:
        out.eddy_d, out.eddy_q = (eddy / ((1.0 - eddy) * L) for L in (out.L_d, out.L_q))
        out.eddy_rate = 1.0 / settings.number("eddy_time_s")
    out.T_ambient = settings.number("T_ambient_c")
    if settings.flag("thermal_on"):
        out.thermal_resistance = settings.number("thermal_resistance_k_per_w")
        out.thermal_capacity = settings.number("thermal_capacity_j_per_k")
    _mechanics(out, settings, violations)
    if machine_file.flux_map is None:
        return None
    of_constants = ("L_d_h", "L_q_h", "psi_f_wb", "inductance_6", "inductance_imbalance")
    given = [name for name in of_constants if name in machine_file.simulation]
    if given:
        violations.append(f"{', '.join(given)}: the flux map is the machine, its inductances and flux are in the map")
    keep = machine_file.flux_map.as_struct()
    out.map = ctypes.pointer(keep)
    return keep


def _mechanics(out: Any, settings: Settings, violations: list[str]) -> None:
    out.rotor = ROTORS[settings.text("rotor")]
    if out.rotor == Rotor.FREE and "J_kgm2" not in settings:
        violations.append('a free rotor needs J_kgm2 in [machine] or [simulation], or rotor = "locked" or "driven"')
    out.J, out.B = settings.number("J_kgm2", 1.0), settings.number("B_nms")
    out.tau_c, out.load_viscous = settings.number("tau_c_nm"), settings.number("load_viscous_nms")
    out.drag = settings.number("drag_nms2")
    out.cogging, out.cogging_periods = settings.number("cogging_nm"), float(settings.whole("cogging_periods"))
    for of in ("slot", "pole"):
        setattr(out, f"cogging_{of}", settings.number(f"cogging_{of}_nm"))
        setattr(out, f"cogging_{of}_periods", float(settings.whole(f"cogging_{of}_periods")))
    out.stribeck, out.stribeck_speed = (
        settings.number("stribeck_share"),
        RAD_S_PER_RPM * settings.number("stribeck_rpm"),
    )
    out.friction_once, out.backlash = settings.number("friction_once"), settings.number("backlash_rad")
    out.J_load = settings.number("J_load_kgm2")
    out.coupling_stiffness = settings.number("coupling_stiffness_nm_per_rad")
    out.coupling_damping = settings.number("coupling_damping_nms_per_rad")
    if out.J_load > 0.0 and out.coupling_stiffness <= 0.0:
        violations.append("J_load_kgm2 needs coupling_stiffness_nm_per_rad")
    elif out.J_load > 0.0 and out.coupling_damping == 0.0:  # no shaft swings for ever
        resonance_rad_s = math.sqrt(out.coupling_stiffness * (1.0 / out.J + 1.0 / out.J_load))
        out.coupling_damping = damping_nms_per_rad(out.coupling_stiffness, resonance_rad_s)


def _inverter(out: Any, settings: Settings, violations: list[str]) -> None:
    dead, mismatch = settings.number("dead_time_s"), settings.number("leg_mismatch_s")
    out.model, out.shape = MODELS.index(settings.text("inverter_model")), SHAPES.index(settings.text("deadtime_shape"))
    out.dead_time[:] = [dead + mismatch, dead - mismatch, dead]
    if dead < abs(mismatch):
        violations.append(f"leg_mismatch_s = {mismatch:g} s leaves no dead time of {dead:g} s")
    out.i_knee, out.minimum_pulse = settings.number("i_knee_apk"), settings.number("minimum_pulse_s")
    out.V_switch, out.r_switch = settings.number("device_drop_v"), settings.number("device_slope_ohm")
    out.V_diode, out.r_diode = settings.number("diode_drop_v"), settings.number("diode_slope_ohm")
    out.capacitance = settings.number("output_capacitance_f")
    out.open[:] = [int(settings.text("phase_open") == phase) for phase in "abc"]
    fault = settings.text("drive_fault")
    if fault == "not_connected":
        out.open[:] = [1, 1, 1]
    if fault == "unbalanced":
        out.r_leg[0] = UNBALANCE_SHARE * settings.number("R_s_ohm")
    out.r_leg[0] += 1.5 * settings.number("resistance_imbalance") * settings.number("R_s_ohm")
    if out.model == MODELS.index("switched") and out.capacitance > 0.0:
        L_min = min(settings.number("L_d_h"), settings.number("L_q_h"))
        least = library().pmsm_inverter_smallest_capacitance(dead + abs(mismatch), L_min)
        if out.capacitance < least:
            violations.append(f"output_capacitance_f below {least:.2g} F is not resolved; write 0 for none")


def _sensors(out: Any, settings: Settings, violations: list[str]) -> None:
    out.gain[:] = [settings.number(f"sensor_gain_{phase}") for phase in "abc"]
    out.offset[:] = [settings.number(f"sensor_offset_{phase}_apk") for phase in "abc"]
    out.noise = settings.number("sensor_noise_apk")
    out.adc_bits, out.full_scale = settings.whole("adc_bits"), settings.number("adc_full_scale_apk")
    if out.adc_bits and not out.full_scale:
        violations.append(
            "adc_bits needs adc_full_scale_apk in [simulation], or I_max_apk or I_nom_apk in [machine]; or set it to 0"
        )
    out.encoder_bits, out.U_dc_gain = settings.whole("encoder_bits"), settings.number("U_dc_gain")
    out.encoder_offset_e = settings.number("encoder_offset_rad")
    out.encoder_reversed = int(settings.flag("encoder_reversed"))
    out.fault = int(settings.text("drive_fault") == "encoder_stuck")
    out.encoder_latency = settings.number("encoder_latency_s")
    out.encoder_noise = settings.number("encoder_noise_rad")
    out.encoder_once, out.encoder_twice = settings.number("encoder_once_rad"), settings.number("encoder_twice_rad")
    out.encoder_line = settings.number("encoder_line_rad")
    out.encoder_line_twice = settings.number("encoder_line_twice_rad")
    out.encoder_lines = settings.number("encoder_lines")
    out.cubic, out.drift = settings.number("sensor_cubic"), settings.number("sensor_drift_apk_per_s")
    out.encoder = ENCODERS.index(settings.text("encoder_kind"))
    order = settings.text("hall_order")
    out.hall = int(order != "none")
    if out.hall:
        offset = settings.number("hall_offset_rad")
        out.hall_axis[:] = [offset + hall_axis(x) + settings.number(f"hall_error_{x}_rad") for x in order]
    out.T_lag, out.blind = settings.number("T_sensor_lag_s"), settings.number("shunt_blind_s")


def _timing(setup: Setup, machine_file: MachineFile, settings: Settings, violations: list[str]) -> None:
    inverter = machine_file.inverter
    whole = inverter.delay_periods - 0.5
    if whole not in (0.0, 1.0, 2.0):
        violations.append(f"[inverter] delay_periods = {inverter.delay_periods:g}: simulated are 0.5, 1.5 and 2.5")
        return
    setup.delay, shift = int(whole), settings.number("sampling_shift_s")
    setup.sampling_shift, setup.sensor_lag = shift, settings.number("sensor_lag_s")
    if abs(shift) >= inverter.T_s:
        violations.append(f"sampling_shift_s = {shift:g} s is not within one period of {inverter.T_s:g} s")
    if shift > 0.0 and setup.delay == 0:
        violations.append("a late sample (sampling_shift_s > 0) needs delay_periods = 1.5 or more")


def own_compensation(machine_file: MachineFile) -> dict[str, float]:
    """Return the parameters of the compensation built into the simulated drive; empty when it has none.

    ``compensation = "right"`` has the plateau U_dc t_dead / T_s + V_device, ``"wrong"`` has
    :data:`WRONG_COMPENSATION` times it.
    """
    settings = settings_of(machine_file)
    kind = settings.text("compensation")
    if kind == "off":
        return {}
    plateau = settings.number("U_dc_v") * settings.number("dead_time_s") / machine_file.inverter.T_s
    plateau += settings.number("device_drop_v")
    return {
        "inverter.deadtime_compensation": 1.0,
        "inverter.V_dead_v": plateau * (1.0 if kind == "right" else WRONG_COMPENSATION),
        "inverter.i_knee_apk": settings.number("i_knee_apk"),
    }


RECORD_COMPENSATION = 1 << 5
"""Bit of ``current.options``: the recorded limited voltage contains the compensation."""


def records_compensation(machine_file: MachineFile) -> bool:
    """Return whether the drive records its voltage after its compensation."""
    return settings_of(machine_file).text("recorded_voltage") == "after"
