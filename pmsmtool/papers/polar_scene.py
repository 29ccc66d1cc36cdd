# SPDX-License-Identifier: MIT
"""Machine, controllers and runs of the polar-coordinate figures; every run is one call of the compiled closed loop.

The paper counts power-invariantly: its amperes and volts are sqrt(3/2) times the peak values of the drive. Everything
this module returns is in the paper's units, everything it sends is peak.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import LINEAR_RANGE, NO_ANTI_WINDUP, ON_MEASUREMENT, POLAR_LAWS, PREDICT, TuneRequest
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.papers import figure
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.sim.closed_loop import simulate
from pmsmtool.sim.kernel import Application
from pmsmtool.sim.scenarios import Profile, Scenario
from pmsmtool.units import rpm_from_rad_s

PROFILE = "miyajima-2013-assumed"
SOURCE = "Miyajima, Fujimoto, Fujitsuna 2013; expected numbers re-derived, Table I is assumed"

PEAK = math.sqrt(2.0 / 3.0)
"""Peak over power-invariant value of a current or voltage."""

CDM_A1_TAU, CDM_A0_TAU2 = 2.5, 2.5
"""a1 tau and a0 tau^2 of the coefficient diagram method, (32)-(35); tau is 10 T_u."""

K_T = 8 * 0.033
"""Torque constant of the assumed machine (N m per power-invariant A): pole pairs times K_e."""

V_DC = 36.0
V_MAX = V_DC / math.sqrt(2.0)
"""Largest amplitude of the linear range (V, power-invariant): V_dc/sqrt(2), peak V_dc/sqrt(3)."""

M_PER_V = 2.0 / (math.sqrt(1.5) * V_DC)
"""Modulation index M = V_a / (sqrt(3/2) V_dc/2) per volt; M_max = 2/sqrt(3) at the linear limit."""

EXPECTED = "derived: the paper's equations on the assumed machine"
"""Where the expected numbers come from: the paper prints none, and its Table I is missing."""

at_least, at_most, near = (partial(check, where=EXPECTED) for check in (figure.at_least, figure.at_most, figure.near))
"""Checks of a number against one of :data:`EXPECTED`, unless they say where else it comes from."""

ASSUMED = (
    "the paper's Table I is missing: every machine number is assumed (profile miyajima-2013-assumed)",
    "the paper prints curves, no numbers: 'expected' is what its equations give for the assumed machine",
    "amperes and volts are power-invariant as in the paper: times sqrt(2/3) for peak",
)
"""Notes that every figure carries."""

IDEAL: Mapping[str, Value] = {
    "dead_time_s": 0.0,
    "device_slope_ohm": 0.0,
    "diode_slope_ohm": 0.0,
    "diode_drop_v": 0.0,
    "output_capacitance_f": 0.0,
    "sensor_noise_apk": 0.0,
    "adc_bits": 0,
    "encoder_bits": 0,
}
"""``[simulation]`` of a perfect inverter and perfect sensors."""

NOISE_A = 0.05
"""Noise of the reference: standard deviation per dq axis (A, power-invariant)."""


@dataclass(frozen=True, slots=True)
class Bench:
    """What stands between controller and machine."""

    name: str
    """In titles."""
    delay_periods: float
    """0.5: the voltage acts in the period it is computed in; 1.5: one period later."""
    simulation: Mapping[str, Value]
    """``[simulation]`` keys."""
    application: Application = Application.CORE
    """The control core with the exact speed, or the drive's whole firmware."""


SIMULATION = Bench("ideal inverter and sensors, no delay", 0.5, IDEAL)
# three phase sensors of standard deviation s give sqrt(2/3) s per dq axis: the factor to peak cancels
NOISY = Bench("one period of delay, 0.05 A noise per axis", 1.5, {**IDEAL, "sensor_noise_apk": NOISE_A})
QUIET_NOISY = Bench("no delay, 0.05 A noise per axis", 0.5, {**IDEAL, "sensor_noise_apk": NOISE_A})
EXPERIMENT = Bench("whole drive: delay, dead time, noise, 12 bit, encoder", 1.5, {}, Application.DRIVE)


@dataclass(frozen=True, slots=True)
class Controller:
    """One way to control the current."""

    name: str
    """In tables."""
    law: str = ""
    """Law of ``tune --controller polar``; empty: field-oriented."""
    options: int = -1
    """``polar.options`` in place of what ``tune`` chooses; -1: as tuned."""
    values: tuple[tuple[str, float], ...] = ()
    """Further values of the catalogue."""
    request: TuneRequest = field(default_factory=TuneRequest)
    """What is asked of ``tune`` besides; a polar law weakens the field itself unless it asks for the table."""
    cdm: bool = False
    """Field-oriented gains of the coefficient diagram method with tau = 10 T_u in place of the tuned ones, so that
    no bandwidth separates them from the paper's linear-range law."""


CONVENTIONAL = Controller("conventional (PID on error)", "conventional", 0)
PROPOSED = Controller("proposed (PID on error)", "proposed", 0)
WOUND_UP = Controller("proposed without anti-windup", "proposed", NO_ANTI_WINDUP)
CONVENTIONAL_ON_MEASUREMENT = Controller("conventional, P and D on measurement", "conventional", ON_MEASUREMENT)
PROPOSED_ON_MEASUREMENT = Controller("proposed, P and D on measurement", "proposed", ON_MEASUREMENT)
SWITCHED = Controller("proposed, switched to the regularised law", "proposed", LINEAR_RANGE)
LINEAR = Controller("linear range, (15) corrected", "linear", 0)
PRINTED = Controller("linear range, (15) as printed", "linear-printed", 0)
REGULARISED = Controller("regularised polar map", "regularised", 0)
UNIFIED = Controller("unified, V_ref = V_max", "unified", 0, (("polar.V_ref_ratio", 1.0),))
UNIFIED_TUNED = Controller("unified, V_ref = 0.97 V_max", "unified", 0)
TABLE = TuneRequest(field_weakening="lookup", voltage_margin=0.05)
"""A table of currents with the voltage margin of the baselines."""
REGULARISED_TABLE = Controller("regularised polar map, table of currents", "regularised", 0, request=TABLE)
UNIFIED_TABLE = Controller("unified, table of currents", "unified", 0, request=TABLE)


def _field_oriented(name: str, governor: str, weakening: str, margin: float, *, cdm: bool = False) -> Controller:
    request = TuneRequest(governor=governor, voltage_margin=margin, field_weakening=weakening)
    return Controller(f"{name}, {1.0 - margin:g} V_max", request=request, cdm=cdm)


FOC_CDM = _field_oriented("FOC (CDM gains) + field weakening", "off", "lookup", 0.05, cdm=True)
FOC = _field_oriented("FOC + field weakening", "off", "lookup", 0.05)
OPTIMISER = _field_oriented("FOC + field weakening by optimisation", "off", "accelerated", 0.05)
GOVERNOR = _field_oriented("FOC + reference governor", "best", "lookup", 0.05)
GOVERNOR_99 = _field_oriented("FOC + reference governor", "best", "lookup", 0.01)
BASELINES = (FOC, GOVERNOR)
"""What every comparison prints beside the polar laws; voltage margin as in the reference."""


@cache
def machine_file(delay_periods: float = 1.5) -> MachineFile:
    """Return the assumed machine of the paper behind an inverter with a delay."""
    source = load_machine_file(PROFILE)
    return replace(source, inverter=replace(source.inverter, delay_periods=delay_periods))


def parameter_set(controller: Controller, source: MachineFile) -> ParameterSet:
    """Return the drive parameters of a controller on a machine: as ``tune`` makes them, then its own changes.

    Raises DesignInfeasible: the law does not hold for this machine.
    """
    request = controller.request
    if controller.law:
        own = "off" if request.field_weakening == "auto" else request.field_weakening
        request = replace(request, controller="polar", polar_law=controller.law, field_weakening=own)
    design = tune(source, request)
    tuned = design.parameter_set()
    values = dict(tuned.values)
    if controller.law and controller.options >= 0:
        predict = PREDICT if source.inverter.delay_periods >= 1.0 and POLAR_LAWS[controller.law] >= 5 else 0
        values["polar.options"] = float(controller.options | predict)
    if controller.cdm:
        values |= _cdm_gains(source)
    values |= dict(controller.values)
    return ParameterSet(values=values, tables=tuned.tables)


def _cdm_gains(source: MachineFile) -> dict[str, float]:
    tau = 10.0 * source.inverter.T_s
    gains: dict[str, float] = {}
    for axis, L in (("d", source.machine.L_d_h), ("q", source.machine.L_q_h)):
        gains[f"current.K_p_{axis}_v_per_a"] = CDM_A1_TAU / tau * L - source.machine.R_s_ohm
        gains[f"current.K_i_{axis}_v_per_as"] = CDM_A0_TAU2 / tau**2 * L
    return gains


@dataclass(frozen=True, slots=True)
class Response:
    """A run in the paper's units, one entry per control period, shape (n,) each."""

    t: Array
    """Time (s)."""
    i_d: Array
    i_q: Array
    """True currents (A, power-invariant)."""
    torque: Array
    torque_asked: Array
    """True torque and its reference (N m)."""
    V_a: Array
    delta: Array
    """Signed voltage amplitude (V, power-invariant) and phase (rad, within +-pi/2) of the demand."""
    u_d: Array
    u_q: Array
    """The demand (V, power-invariant)."""
    v_d: Array
    v_q: Array
    """What the inverter's limits leave of it (V, power-invariant)."""
    speed_rpm: Array
    """Mechanical speed (rpm)."""

    def index(self, t: float) -> int:
        """Return the first period at or after a time."""
        return int(np.searchsorted(self.t, t - 1e-9))


def run(
    controller: Controller,
    bench: Bench,
    torque: Profile,
    speed: Profile,
    duration_s: float,
    *,
    seed: int = 0,
    source: MachineFile | None = None,
    plant: Mapping[str, Value] | None = None,
) -> Response:
    """Run a torque course at a speed course.

    Parameters
    ----------
    controller, bench : Controller, Bench
        Who controls what.
    torque : sequence of (s, N m)
        Nodes of the reference; two nodes at one time make a step.
    speed : sequence of (s, rpm)
        Speed the rotor is driven at.
    duration_s : float
        Length (s).
    seed : int
        Of the noise.
    source : MachineFile, optional
        Another machine than the paper's.
    plant : mapping, optional
        ``[simulation]`` keys in which the true machine differs from what the drive believes.
    """
    source = machine_file(bench.delay_periods) if source is None else source
    params = _cached_set(controller, source)
    scenario = Scenario(
        name=controller.name,
        duration_s=duration_s,
        mode="torque",
        schedule={"torque_nm": torque, "driven_rpm": speed},
        rotor="driven",
        start_rpm=speed[0][1],
        simulation={**bench.simulation, **(plant or {})},
    )
    trace = simulate(source, params, scenario, seed=seed, application=bench.application)
    u_d, u_q = trace["u_d_v"] / PEAK, trace["u_q_v"] / PEAK
    sign = np.where(u_q < 0.0, -1.0, 1.0)
    t, (at, asked) = trace.t_s, np.array(torque, dtype=np.float64).T
    return Response(
        t=t,
        i_d=trace["i_d_true_a"] / PEAK,
        i_q=trace["i_q_true_a"] / PEAK,
        torque=trace["torque_true_nm"],
        torque_asked=np.interp(t, at, asked),
        V_a=sign * np.hypot(u_d, u_q),
        delta=np.arctan2(-sign * u_d, sign * u_q),
        u_d=u_d,
        u_q=u_q,
        v_d=trace["u_d_lim_v"] / PEAK,
        v_q=trace["u_q_lim_v"] / PEAK,
        speed_rpm=rpm_from_rad_s(trace["omega_m_rad_s"]),
    )


_SETS: dict[tuple[Controller, str], ParameterSet] = {}


def _cached_set(controller: Controller, source: MachineFile) -> ParameterSet:
    key = (controller, source.content_hash())
    if key not in _SETS:
        _SETS[key] = parameter_set(controller, source)
    return _SETS[key]


def steps(levels: Sequence[tuple[float, float]]) -> Profile:
    """Return the nodes of a staircase from (time, value) pairs."""
    nodes: list[tuple[float, float]] = [levels[0]]
    for at, value in levels[1:]:
        nodes += [(at, nodes[-1][1]), (at, value)]
    return nodes
