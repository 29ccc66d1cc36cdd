# SPDX-License-Identifier: MIT
"""What the kernel is measured against: the scenarios of docs/simulation.md, and an independent integration of them.

The same float32 core runs through ``pmsm_step`` of the library ``pmsm_core``, one call per period; between the samples
scipy integrates the dq equations (not the stationary-flux form of the kernel) with DOP853, restarted every period.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from pmsmtool import native
from pmsmtool.files import data_folder
from pmsmtool.firmware.image import pack_image
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.params.catalogue import CATALOGUE
from pmsmtool.sim.kernel import Application, Params, Part, Reference, Rotor, Setup, Simulation, Target, Truth

T_S_NS = 83333
"""Control period of all scenarios (ns), 12 kHz."""
STATE_BYTES = 4096
"""Room for a pmsm_state of the core; the struct has 400 bytes."""
MODE_CURRENT = 2


@dataclass(frozen=True)
class Scenario:
    """One row of the table in docs/simulation.md, 1."""

    name: str
    pole_pairs: int
    R_s: float
    L_d: float
    L_q: float
    psi_f: float
    rpm: float
    U_dc: float
    alpha: float
    i_d: tuple[float, float]  # value (A), time (s)
    i_q: tuple[float, float]
    saturated: bool = False

    @property
    def omega_M(self) -> float:
        return self.rpm * 2.0 * math.pi / 60.0

    def values(self) -> dict[str, float]:
        """Drive parameters: PI with K_p = alpha L, K_i = 4 alpha R_s, decoupling and back-calculation."""
        values = {row.name: row.default for row in CATALOGUE}
        values |= {
            "motor.pole_pairs": self.pole_pairs,
            "motor.R_s_ohm": self.R_s,
            "motor.L_d_h": self.L_d,
            "motor.L_q_h": self.L_q,
            "motor.L_d_app_h": self.L_d,
            "motor.L_q_app_h": self.L_q,
            "motor.psi_f_wb": self.psi_f,
            "motor.I_max_apk": 300.0,
            "motor.I_nom_apk": 300.0,
            "motor.n_max_rpm": 20000.0,
            "protection.I_cont_apk": 300.0,
            "protection.i_trip_apk": 1000.0,
            "protection.n_trip_rpm": 30000.0,
            "inverter.T_s_ns": T_S_NS,
            "inverter.U_dc_nom_v": self.U_dc,
            "current.K_p_d_v_per_a": self.alpha * self.L_d,
            "current.K_p_q_v_per_a": self.alpha * self.L_q,
            "current.K_i_d_v_per_as": 4.0 * self.alpha * self.R_s,
            "current.K_i_q_v_per_as": 4.0 * self.alpha * self.R_s,
        }
        return values

    def references(self) -> dict[Target, tuple[list[float], list[float]]]:
        def step(value: float, at: float) -> tuple[list[float], list[float]]:
            return ([0.0, at, at], [0.0, 0.0, value]) if at > 0.0 else ([0.0], [value])

        return {Target.I_D: step(*self.i_d), Target.I_Q: step(*self.i_q)}


_PI2 = 2.0 * math.pi
SCENARIOS = (
    Scenario("S1 rated", 4, 0.137, 2.3e-3, 2.1e-3, 0.41, 620, 540, _PI2 * 400, (0.0, 0.0), (26.0, 0.1)),
    Scenario("S2 field weakening", 4, 0.137, 2.3e-3, 2.1e-3, 0.41, 1860, 540, _PI2 * 400, (-30.0, 0.05), (15.0, 0.1)),
    Scenario("S3 2.2-kW IPM", 3, 3.6, 36e-3, 51e-3, 0.545, 1500, 540, _PI2 * 200, (-2.0, 0.05), (5.0, 0.1)),
    Scenario("S4 saturated", 2, 0.63, 25e-3, 100e-3, 0.445, 900, 540, _PI2 * 200, (-4.0, 0.05), (8.0, 0.1), True),
    Scenario(
        "S5 fast IPM", 3, 17.932e-3, 0.37e-3, 1.2e-3, 65.65e-3, 11000, 400, _PI2 * 300, (-140.0, 0.0), (20.0, 0.1)
    ),
)


@cache
def saturated_map() -> FluxMap:
    """5.6-kW PM-SyRM of docs/simulation.md, 1, as it ships: the map with its interpolation is the machine."""
    flux_map = load_machine_file(data_folder("profiles") / "saturated-pmsyrm.toml").flux_map
    assert flux_map is not None
    return flux_map


def setup_of(scenario: Scenario, application: Application = Application.CORE) -> tuple[Setup, object]:
    """Ideal sensors, averaged inverter without error, rotor driven at constant speed; and what to keep alive."""
    setup = Setup()
    machine = setup.machine
    machine.pole_pairs, machine.R_copper = scenario.pole_pairs, scenario.R_s
    machine.L_d, machine.L_q, machine.psi_f = scenario.L_d, scenario.L_q, scenario.psi_f
    machine.T_ref, machine.alpha_R, machine.alpha_psi = 20.0, 0.00393, -0.0012
    machine.rotor = Rotor.DRIVEN
    keep = None
    if scenario.saturated:
        keep = saturated_map().as_struct()
        machine.map = ctypes.pointer(keep)
    setup.sensors.gain[:] = [1.0, 1.0, 1.0]
    setup.sensors.U_dc_gain = 1.0
    setup.U_dc, setup.T_winding, setup.T_magnet = scenario.U_dc, 20.0, 20.0
    setup.omega_M, setup.delay, setup.application = scenario.omega_M, 1, application
    return setup, keep


def simulate(
    scenario: Scenario,
    periods: int,
    application: Application = Application.CORE,
    signals: tuple[Truth, ...] = (Truth.I_D, Truth.I_Q),
) -> np.ndarray:
    """Return i_d, i_q (or other signals) of the kernel at the sampling instants, shape (periods, 2)."""
    setup, keep = setup_of(scenario, application)
    simulation = Simulation(setup, pack_image(scenario.values()), keep)
    simulation.reference.mode = MODE_CURRENT
    simulation.word(Part.ENABLED).value = 1
    for target, (t, value) in scenario.references().items():
        simulation.schedule(target, t, value)
    record = simulation.record(signals, periods)
    assert simulation.run(periods) == periods
    assert simulation.counts() == {"outside_flux_map": 0, "event_overruns": 0}
    return record


class Measurement(ctypes.Structure):
    _fields_ = tuple(
        (name, ctypes.c_float) for name in ("i_a", "i_b", "i_c", "theta_e", "omega_e", "U_dc", "T_winding")
    )


class Output(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_float) for name in ("duty_a", "duty_b", "duty_c", "u_alpha", "u_beta")),
        ("gates", ctypes.c_uint32),
    )


def flux_derivative(scenario: Scenario, u: complex, theta_0: float, omega_e: float) -> Callable[[float, Any], Any]:
    """Return d(psi_d, psi_q)/dt at constant stator-frame voltage u, the dq axes turning from theta_0."""
    if scenario.saturated:
        current = saturated_map().tables.inverse.evaluate

        def rate(t: float, psi: Any) -> Any:
            i_d, i_q = current(psi[0], psi[1]).value
            u_dq = u * np.exp(-1j * (theta_0 + omega_e * t))
            return [
                u_dq.real - scenario.R_s * float(i_d) + omega_e * psi[1],
                u_dq.imag - scenario.R_s * float(i_q) - omega_e * psi[0],
            ]

        return rate

    def linear_rate(t: float, psi: Any) -> Any:
        u_dq = u * np.exp(-1j * (theta_0 + omega_e * t))
        return [
            u_dq.real - scenario.R_s * (psi[0] - scenario.psi_f) / scenario.L_d + omega_e * psi[1],
            u_dq.imag - scenario.R_s * psi[1] / scenario.L_q - omega_e * psi[0],
        ]

    return linear_rate


def currents(scenario: Scenario, psi: Any) -> tuple[float, float]:
    if scenario.saturated:
        i_d, i_q = saturated_map().tables.inverse.evaluate(psi[0], psi[1]).value
        return float(i_d), float(i_q)
    return (psi[0] - scenario.psi_f) / scenario.L_d, psi[1] / scenario.L_q


def start_flux(scenario: Scenario) -> np.ndarray:
    if not scenario.saturated:
        return np.array([scenario.psi_f, 0.0])
    psi, inverse = np.array([0.45, 0.0]), saturated_map().tables.inverse
    for _ in range(20):
        at = inverse.evaluate(psi[0], psi[1])
        psi = psi - np.linalg.solve(at.jacobian, at.value)
    return psi


def reference_run(scenario: Scenario, periods: int, rtol: float = 1e-12) -> np.ndarray:
    """Return i_d, i_q at the sampling instants by DOP853 and the core of the library ``pmsm_core``."""
    # a handle of its own: the structs here are laid out by hand, and other tests declare theirs on the shared one
    core = ctypes.CDLL(str(native.LIBRARY_FOLDER / native.library_name("pmsm_core")))
    params = Params.from_buffer_copy(pack_image(scenario.values()))
    state = (ctypes.c_double * (STATE_BYTES // 8))()
    core.pmsm_init(ctypes.byref(state))
    request, output = Reference(), Output(0.5, 0.5, 0.5, 0.0, 0.0, 0)
    request.mode = MODE_CURRENT
    T_s, omega_e = 1e-9 * T_S_NS, scenario.pole_pairs * scenario.omega_M
    psi, held, out = start_flux(scenario), 0j, np.empty((periods, 2))
    for k in range(periods):
        t = k * T_s
        theta = math.remainder(omega_e * t, 2.0 * math.pi)
        i_d, i_q = currents(scenario, psi)
        out[k] = i_d, i_q
        i = (i_d + 1j * i_q) * np.exp(1j * theta)
        phases = [i.real, -0.5 * i.real + 0.5 * math.sqrt(3.0) * i.imag, -0.5 * i.real - 0.5 * math.sqrt(3.0) * i.imag]
        measured = Measurement(*phases, theta, omega_e, scenario.U_dc, 20.0)
        for name, (value, at) in (("i_d_ref", scenario.i_d), ("i_q_ref", scenario.i_q)):
            setattr(request, name, value if t + 1e-6 * T_s >= at else 0.0)
        acting = held
        core.pmsm_step(
            ctypes.byref(state), ctypes.byref(params), None,
            ctypes.byref(measured), ctypes.byref(request), ctypes.byref(output),
        )  # fmt: skip
        d = (output.duty_a, output.duty_b, output.duty_c)
        held = scenario.U_dc * ((2.0 * d[0] - d[1] - d[2]) / 3.0 + 1j * (d[1] - d[2]) / math.sqrt(3.0))
        solution = solve_ivp(
            flux_derivative(scenario, acting, theta, omega_e), (0.0, T_s), psi, method="DOP853", rtol=rtol, atol=1e-15
        )
        psi = solution.y[:, -1]
    return out


def relative_error(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest |i - i_ref| over largest |i_ref|."""
    return float(np.hypot(*(found - expected).T).max() / np.hypot(*expected.T).max())
