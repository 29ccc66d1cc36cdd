# SPDX-License-Identifier: MIT
"""The Monte Carlo prediction: the drive's own firmware on machines drawn from their intervals.

What varies: the machine's parameters (statistical and systematic part; a machine that saturates has its flux map scaled
by those of its inductances and of its magnet), the encoder offset, temperatures about what
the drive measures, the DC link, friction, the inverter's error, sensor offsets and mismatch, lag, the angle at the
start. What is the same: the set the drive holds, cut to the envelope as the drive cuts it.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.design.design_file import Design
from pmsmtool.design.prediction import Direction, Prediction, Runs, predict
from pmsmtool.design.tolerance import Samples, tolerance_box
from pmsmtool.drive.port import Excitation, Injection
from pmsmtool.estimators.resistance import at_the_test
from pmsmtool.identification.sampling import INSTANT, LAG
from pmsmtool.machine.flux_map import FluxScale, ScalableMap
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.torque import iron_drag
from pmsmtool.machine.two_masses import ZETA_FACTOR, doubt
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.proof.defects import DEFECTS, QUANTITIES, Defect, is_possible
from pmsmtool.proof.plan import Conditions, Experiment, ProofPlan
from pmsmtool.proof.simulated_move import hold, record_move
from pmsmtool.sim.closed_loop import DRIVE_SIGNALS, image_of
from pmsmtool.sim.kernel import Params, Part, Setup, Simulation, library
from pmsmtool.sim.scenarios import MODES
from pmsmtool.sim.signals import Truth
from pmsmtool.sim.simulated_machine import MODELS, SHAPES, build_setup
from pmsmtool.units import rad_s_from_rpm, rpm_from_rad_s

RUNS = 96
"""Drawn machines: the largest of 96 holds 95 % of all with a confidence of 99.3 %."""
FAULT_RUNS = 4
"""Drawn machines behind each fault's signature, for :data:`RUNS`; the first of the healthy ones, with their numbers."""

T_SPREAD_K = 5.0
"""Half range of the winding's temperature about its sensor, and of the magnets' about theirs."""
T_MAGNET_SPREAD_K = 15.0
"""Half range of the magnets' temperature about the winding's where they have no sensor."""
U_DC_SPREAD = 0.01
RIPPLE_LEAST = 0.005
"""Amplitude of the link's ripple, relative, from which on it is drawn: what less does, :data:`U_DC_SPREAD` covers."""
RIPPLE_HZ = (100.0, 120.0, 300.0, 360.0)
"""Its frequency: twice that of the mains behind one phase, six times behind three."""
DEAD_SPREAD = 0.2
KNEE_FACTOR = 3.0
MISMATCH_OF_LEGS = 0.05
LARGEST_DROP_SHARE = 0.5
"""Inverter: half range of its plateau, factor either way of its knee, dead times of the legs against each other, and
largest part of the plateau that comes from thresholds."""
FRICTION_SHARE = 0.03
"""Largest Coulomb and viscous friction, of the rated torque, where the machine file gives none."""
FRICTION_FACTOR = 2.0
"""Factor either way where it gives them."""
LAG_SHARES, LAG_S = (0.1, 0.4), 20e-6
"""Largest lag of the current sensors where it was not identified: that of amplifier and filter (s), within these shares
of the control period. With a tenth of it a healthy drive (17 of 44 us) was 1.23 half widths of the delay off."""
TIMING_COVERAGE = 2.0
"""Half range of identified lag and instant, of their standard deviation."""
OFFSET_SHARE = 0.001
MISMATCH = 0.002
"""Standard deviations of sensor offsets (of I_max) and of the phases' gains against each other."""
SEEN_SHARES, EDDY_FACTOR = (0.5, 1.5), 2.0
"""Range of identified eddy currents, drag, cogging, encoder errors and ripple of the link, and factor either way of the
currents' time constant: one branch stands for many, one order for the orders of the cogging."""
EMF_HARMONICS = {"psi_5_wb": ("psi_6", 5, 0.05), "psi_7_wb": ("psi_7", 7, 0.03)}
"""Harmonics of the back-EMF: in a machine file's estimates, in the plant, of a phase, and the largest of the usual
range, of the fundamental, where none was identified (a healthy machine with 3.7 % of the 5th was at 1.29 of the band of
a speed step without). Patterns that are repeated are then simulated without: their bands have the ripple that the
repeats show, and with 5 % in them a gain 20 % too high passed on one drive."""
BASE_SPEED = (-0.03, 0.01)
"""Relative range of the speed that is held before current steps: what coasting lets it lose, too."""
COAST_PERIODS = 64
"""The speed loop's current is switched off at most this long before a current step: the loops may not have settled.
At standstill, they settle for so long."""
PHASES = 64
"""Periods over which the start is drawn: slower tasks of the drive (speed control) are anywhere in their cycle."""
ALLOWANCES = {"unreachable": 2.0}
"""Half width over that of the drawn machines where it is not the usual 1.3: at the voltage limit ripple, shortest
pulses and the flux map decide (with 1.3 one healthy drive of 125 came to 1.13 of its band, the measured map to 1.03).
"""
RUN_IN = 4.0
"""A speed is held for this many time constants of the speed loop before a speed step."""
HOLD = 6.0
LONGEST_HOLD = 4096
"""Time constants L/R for which the current that holds a speed flows before a current step, and most periods: with less,
what is left of the start shifts the prediction (64 periods, 1 L/R, of a warm winding: i_q by 0.35 of 7.2 A)."""


@dataclass(frozen=True, slots=True)
class Start:
    """How one machine enters one experiment: by chance, and anew each time.

    Attributes
    ----------
    base_speed : float
        Speed held before current steps, relative to the one asked for, less one.
    phase, coasting : int
        Control periods of the drive's slower tasks that have passed, and without current before a current step.
    held : float
        Torque that holds the shaft before a move, of the Coulomb torque.
    theta_M_rad : float
        Angle of the shaft (rad).
    """

    base_speed: float
    phase: int
    coasting: int
    held: float
    theta_M_rad: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Start:
        """Draw one."""
        return cls(
            float(rng.uniform(*BASE_SPEED)), int(rng.integers(PHASES)), int(rng.integers(1, COAST_PERIODS + 1)),
            float(rng.uniform(-1.0, 1.0)), float(rng.uniform(-math.pi, math.pi)),
        )  # fmt: skip


class SimulatedDrives:
    """Drives with one design on machines drawn from their intervals.

    Parameters
    ----------
    design : Design
        What the drive holds.
    conditions : Conditions
        What it measured before.
    plan : ProofPlan
        The experiments.
    runs : int
        Machines drawn.
    seed : int
        Seed of everything random.
    """

    def __init__(self, design: Design, conditions: Conditions, plan: ProofPlan, runs: int, seed: int) -> None:
        self._design, self._plan = design, plan
        machine = _simulated(design.machine, conditions)
        base, self._keep = build_setup(machine, seed=seed)
        self._nominal = Setup.from_buffer_copy(base)
        flux_map = machine.flux_map
        self._map = None if flux_map is None else ScalableMap.of(flux_map, machine.machine.psi_f_wb)
        self._image = image_of(machine, _cut(design, conditions))
        self._T_s = design.machine.inverter.T_s
        self._increments = conditions.encoder_counts
        # one start for all experiments let a friction that held two moves alike cancel in what they tell together: a
        # healthy machine whose friction is 6 % of its rated torque had a speed gain 131 % of the band off
        self._starts = {
            (e.name, row): Start.draw(np.random.default_rng([seed, 2, k, row]))
            for k, e in enumerate(plan.experiments)
            for row in range(runs)
        }
        self.setups = [*self._drawn(base, machine, conditions, runs, seed)]

    def _drawn(
        self, base: Setup, machine: MachineFile, conditions: Conditions, runs: int, seed: int
    ) -> Sequence[Setup]:
        rng = np.random.default_rng([seed, 1])
        samples = tolerance_box(
            as_tested(machine),
            U_dc_v=_about(conditions.U_dc_v, U_DC_SPREAD * conditions.U_dc_v),
            T_winding_c=_about(base.T_winding, T_SPREAD_K),
            T_magnet_c=_about(base.T_magnet, T_MAGNET_SPREAD_K if math.isnan(conditions.T_magnet_c) else T_SPREAD_K),
        ).draw(runs, seed, 0)
        return [_draw(base, machine, samples, row, rng, self._design["motor.I_max_apk"]) for row in range(runs)]

    def respond(self, experiment: Experiment, defect: Defect | None = None, runs: int | None = None) -> Array:
        """Simulate an experiment.

        Returns
        -------
        ndarray, shape (runs, signals, pattern rows)
            Signals as the experiment lists them.
        """
        if experiment.move is not None:
            count = len(self.setups) if runs is None else runs
            return np.stack([self._move(k, experiment, defect).T for k in range(count)])
        drives = [self._start(k, experiment, defect) for k in range(len(self.setups) if runs is None else runs)]
        in_speed_mode = experiment.excitation.point is Injection.SPEED
        run_in = COAST_PERIODS
        if in_speed_mode:
            crossover = float(self._design.facts.get("speed_crossover_rad_s", 50.0))
            run_in = round((RUN_IN if experiment.base_rad_s else 0.25) / (crossover * self._T_s))
        elif experiment.base_rad_s:
            machine = self._nominal.machine
            slowest_s = max(machine.L_d, machine.L_q) / (machine.R_copper + machine.R_fixed)
            run_in = min(max(run_in, round(HOLD * slowest_s / self._T_s)), LONGEST_HOLD)
        for row, drive in enumerate(drives):
            self._get_ready(drive, row, experiment, run_in)
            if experiment.base_rad_s and not in_speed_mode:
                # a light shaft has coasted: the record of the machine begins at its speed (``measured.KEPT``)
                begun = (1.0 + self._starts[experiment.name, row].base_speed) * experiment.base_rad_s
                lost = begun - drive.signal(Truth.OMEGA_M)
                drives[row] = self._start(row, experiment, defect, lost)
                self._get_ready(drives[row], row, experiment, run_in)
        wanted = [DRIVE_SIGNALS[name][0] for name in experiment.signals]
        for drive in drives:
            _excite(drive, experiment.excitation)
        records = [drive.record(wanted, experiment.rows, experiment.decimation) for drive in drives]
        for drive in drives:
            drive.run(experiment.rows * experiment.decimation)
        return averaged(np.stack(records).transpose(0, 2, 1), experiment)

    def _move(self, row: int, experiment: Experiment, defect: Defect | None) -> Array:
        drive = self._start(row, experiment, defect)
        start = self._starts[experiment.name, row]
        hold(drive, experiment, self._increments, self._T_s, start.phase, start.held * self.setups[row].machine.tau_c)
        return record_move(drive, experiment)

    def _get_ready(self, drive: Simulation, row: int, experiment: Experiment, run_in: int) -> None:
        """Let the loops settle; before a step at a speed, the current that held it has just been switched off."""
        coasts = experiment.base_rad_s and experiment.excitation.point is not Injection.SPEED
        if coasts:
            drawn, torque_per_amp = self.setups[row].machine, self._design.machine.machine.torque_nm(0.0, 1.0)
            friction = drawn.tau_c + drawn.B * experiment.base_rad_s
            drive.reference.i_q_ref = friction / torque_per_amp if torque_per_amp else 0.0
        start = self._starts[experiment.name, row]
        drive.run(start.phase + run_in)
        if coasts:
            drive.reference.i_q_ref = 0.0
            drive.run(start.coasting)

    def _start(self, row: int, experiment: Experiment, defect: Defect | None, lead_rad_s: float = 0.0) -> Simulation:
        setup = Setup.from_buffer_copy(self.setups[row])
        if experiment.repeats > 1 and not EMF_HARMONICS.keys() & self._design.machine.estimates.keys():
            setup.machine.psi_6 = setup.machine.psi_7 = 0.0  # repeats show by themselves what of them is left
        in_speed_mode = experiment.excitation.point is Injection.SPEED
        start = self._starts[experiment.name, row]
        share, setup.theta_M = 0.0 if in_speed_mode else start.base_speed, start.theta_M_rad
        setup.omega_M = (1.0 + share) * experiment.base_rad_s + lead_rad_s
        params = Params()
        simulation = Simulation(setup, self._image, self._scaled(setup))
        if defect is not None:
            params = simulation.params
            defect.change(setup, params)
            kept = bytes(params)
            simulation = Simulation(setup, self._image, self._scaled(setup))
            ctypes.memmove(ctypes.addressof(simulation.params), kept, len(kept))
        simulation.reference.mode = MODES["speed" if in_speed_mode else "current"]
        simulation.reference.omega_M_ref = experiment.base_rad_s
        simulation.word(Part.ENABLED).value = 1
        return simulation

    def _scaled(self, setup: Setup) -> object:
        """Give a machine that saturates the map of its inductances and its magnet; returns what must live as long."""
        if self._map is None:
            return self._keep
        drawn, nominal = setup.machine, self._nominal.machine
        psi_f = drawn.psi_f / nominal.psi_f if nominal.psi_f else 1.0
        struct = self._map.struct(FluxScale(drawn.L_d / nominal.L_d, drawn.L_q / nominal.L_q, psi_f))
        drawn.map = ctypes.pointer(struct)
        return struct


def averaged(signals: NDArray[np.float64], experiment: Experiment) -> Array:
    """Average the repeated patterns of a record, shape (..., rows) to (..., pattern rows)."""
    repeated = signals.reshape(*signals.shape[:-1], experiment.repeats, experiment.pattern_rows)
    return np.asarray(repeated.mean(axis=-2))


def predict_proof(
    design: Design, conditions: Conditions, plan: ProofPlan, *, runs: int = RUNS, seed: int = 0
) -> Prediction:
    """Return the prediction of the planned experiments.

    Parameters
    ----------
    design, conditions, plan
        As for :class:`SimulatedDrives`.
    runs : int
        Machines drawn.
    seed : int
        Seed of everything random.
    """
    drives = SimulatedDrives(design, conditions, plan, runs, seed)
    few_runs = max(2, runs * FAULT_RUNS // RUNS)
    healthy = {e.name: drives.respond(e) for e in plan.experiments}
    few: dict[str, Array] = {name: values[:few_runs] for name, values in healthy.items()}
    wrong = {
        name: {
            e.name: few[e.name] if defect.moves_only and e.move is None else drives.respond(e, defect, few_runs)
            for e in plan.experiments
        }
        for name, defect in DEFECTS.items()
        if is_possible(name, design, moves=any(e.move is not None for e in plan.experiments))
    }
    T_s = design.machine.inverter.T_s
    facts = {
        "design": design.content_hash(),
        "parameters": design.parameter_set().content_hash(),
        "conditions": conditions.facts(),
        "experiments": [e.text for e in plan.experiments],
        "left_out": list(plan.left_out),
        "steady_rows": {e.name: e.steady_rows for e in plan.experiments},
        "runs": runs,
        "seed": seed,
    }
    directions = {}
    for name, derived in QUANTITIES.items():
        shown = [e for e in plan.experiments if e.name.startswith(derived.shown_by)]
        if not shown:
            continue
        high, low = (_judged(shown, wrong[fault] if fault else few) for fault in (derived.high, derived.low))
        below, above = (DEFECTS[fault].text if fault else "" for fault in (derived.low, derived.high))
        directions[name] = Direction(
            derived.nominal, "1", high, low, derived.at_high, derived.at_low, below, above, derived.least
        )  # fmt: skip
    return predict(
        {e.name: np.arange(e.pattern_rows, dtype=np.float64) * (T_s * e.decimation) for e in plan.experiments},
        _judged(plan.experiments, healthy),
        {(e.name, s): e.scale(s) for e in plan.experiments for s in e.judged},
        directions=directions,
        faults={name: (DEFECTS[name].text, _judged(plan.experiments, values)) for name, values in wrong.items()},
        facts=facts,
        allowances=ALLOWANCES,
    )  # fmt: skip


def _judged(experiments: Sequence[Experiment], responses: Mapping[str, Array]) -> Runs:
    return {
        (e.name, signal): np.ascontiguousarray(responses[e.name][:, e.signals.index(signal), :])
        for e in experiments
        for signal in e.judged
    }


# ---- one drawn drive ------------------------------------------------------------------------------------------


def as_tested(machine: MachineFile) -> MachineFile:
    """Return a machine with the interval its resistance has at the temperature of the test, where that is unknown."""
    R = at_the_test(machine.estimates).get("R_s_ohm")
    if R is None or "R_s_ohm" not in machine.std or R is machine.estimates["R_s_ohm"]:
        return machine
    return replace(
        machine,
        std={**machine.std, "R_s_ohm": R.std},
        systematic={**machine.systematic, "R_s_ohm": R.systematic},
    )


def _simulated(machine: MachineFile, conditions: Conditions) -> MachineFile:
    """Return the machine with simulation settings from what the drive measured, whatever its file says of the truth."""
    T_winding = machine.machine.T_ref_c if math.isnan(conditions.T_winding_c) else conditions.T_winding_c
    inverter = machine.inverter
    plateau = inverter.V_dead_v
    dead_time = inverter.dead_time_s if plateau is None else plateau * inverter.T_s / conditions.U_dc_v
    settings: dict[str, Value] = {
        "adc_bits": 0,
        "encoder_bits": max(0, conditions.encoder_counts.bit_length() - 1),
        "sensor_noise_apk": _noise(machine),
        "U_dc_v": conditions.U_dc_v,
        "T_winding_c": T_winding,
        "T_magnet_c": T_winding if math.isnan(conditions.T_magnet_c) else conditions.T_magnet_c,
        "dead_time_s": min(dead_time, 2e-5),
    }
    if conditions.U_dc_ripple_v > RIPPLE_LEAST * conditions.U_dc_v:
        settings["U_dc_ripple_v"] = conditions.U_dc_ripple_v
    if inverter.i_knee_apk:
        settings["i_knee_apk"] = inverter.i_knee_apk
    if conditions.shaft == "locked" or machine.machine.J_kgm2 is None:
        settings["rotor"] = "locked"
    return replace(machine, simulation=settings)


def _noise(machine: MachineFile) -> float:
    """Noise of a phase current (A): what identification saw in i_d and i_q, else two steps of a 12-bit converter."""
    seen = machine.conditions.get("noise_apk")
    if isinstance(seen, int | float):
        return math.sqrt(1.5) * float(seen)
    return 2.0 * 3.0 * (machine.machine.I_max_apk or machine.machine.I_nom_apk or 1.0) / 4096.0


def _cut(design: Design, conditions: Conditions) -> ParameterSet:
    """Return the set as the drive runs it while the guard limits current and speed (objects 0x6073, 0x6080)."""
    wanted = design.parameter_set()
    cut = {
        "motor.I_max_apk": conditions.i_max_apk,
        "governor.I_transient_apk": conditions.i_max_apk,
        "motor.n_max_rpm": rpm_from_rad_s(conditions.speed_max_rad_s),
    }
    return replace(wanted, values={n: min(v, cut[n]) if n in cut else v for n, v in wanted.values.items()})


def _about(middle: float, half: float) -> tuple[float, float]:
    return middle - half, middle + half


def _draw(
    base: Setup, machine: MachineFile, samples: Samples, row: int, rng: np.random.Generator, I_max: float
) -> Setup:
    setup = Setup.from_buffer_copy(base)
    varied = samples.describe(row)
    out = setup.machine
    R = varied.get("R_s_ohm", 1.0)
    out.R_copper, out.R_fixed = R * out.R_copper, R * out.R_fixed
    out.L_d, out.L_q = (getattr(out, n) * varied.get(f"{n}_h", 1.0) for n in ("L_d", "L_q"))
    out.psi_f *= varied.get("psi_f_wb", 1.0)
    out.J *= varied.get("J_kgm2", 1.0)
    _draw_elastic_shaft(setup, machine, rng)
    out.B, out.tau_c = _friction(machine, rng)
    setup.T_winding, setup.T_magnet, setup.U_dc = (varied[n] for n in ("T_winding_c", "T_magnet_c", "U_dc_v"))
    if setup.U_dc_ripple > 0.0:
        setup.U_dc_ripple *= float(rng.uniform(*SEEN_SHARES))
        setup.U_dc_ripple_hz = float(rng.choice(RIPPLE_HZ))
    setup.sensors.encoder_offset_e += varied["encoder_rad"]
    setup.sensors.offset[:] = list(rng.normal(0.0, OFFSET_SHARE * I_max, 3))
    known = [machine.conditions.get(f"sensor_gain_{phase}_over_mean", 1.0) for phase in "abc"]
    setup.sensors.gain[:] = list(rng.normal(1.0, MISMATCH, 3) * np.array(known))
    _draw_eddy_currents(setup, machine, rng)
    _draw_harmonics(setup, machine, rng)
    _draw_shaft_effects(setup, machine, rng)
    _draw_inverter(setup, machine, rng)
    setup.sensor_lag, setup.sampling_shift, age_s = _timing(machine, rng, late=setup.delay > 0)
    setup.sensors.encoder_latency = age_s
    setup.seed = int(rng.integers(2**62))
    return setup


def _draw_eddy_currents(setup: Setup, machine: MachineFile, rng: np.random.Generator) -> None:
    """Draw eddy currents about those that the inductances were identified with; none where there were none.

    Within a control period they are nothing but iron loss; slower ones are a branch, whose time constant the plant has
    once for both axes.
    """
    sizes_s = [machine.conditions.get(f"eddy_{axis}_s", 0.0) for axis in "dq"]
    taus_s = [tau for axis in "dq" if isinstance(tau := machine.conditions.get(f"eddy_{axis}_time_s"), float)]
    if not taus_s:
        return
    out, T_s = setup.machine, machine.inverter.T_s
    sizes_s = [float(rng.uniform(*SEEN_SHARES)) * size_s for size_s in sizes_s]
    tau_s = float(np.mean(taus_s)) * math.exp(rng.uniform(-1.0, 1.0) * math.log(EDDY_FACTOR))
    per_volt = [size_s / L for size_s, L in zip(sizes_s, (out.L_d, out.L_q), strict=True)]
    if np.mean(taus_s) < T_s:
        if sum(per_volt) > 0.0:
            out.R_iron = 2.0 / sum(per_volt)
            out.B = max(0.0, out.B - iron_drag(out.pole_pairs, out.psi_f, out.R_iron))  # identified as one
        return
    out.eddy_rate = 1.0 / max(tau_s, T_s)  # shorter than a step of the plant would not be integrated
    out.eddy_d, out.eddy_q = (amperes * out.eddy_rate for amperes in per_volt)


def _draw_harmonics(setup: Setup, machine: MachineFile, rng: np.random.Generator) -> None:
    """Draw the 5th and 7th harmonic of the back-EMF.

    About what was identified, at any phase; of a back-EMF of which nothing was identified, within the usual range.
    """
    out, seen = setup.machine, machine.estimates
    for key, (name, order, most) in EMF_HARMONICS.items():
        found = seen.get(key)
        share = float(rng.uniform(*SEEN_SHARES)) if found is not None else float(rng.uniform(0.0, 1.0))
        flux = found.value if found is not None else most * out.psi_f / order
        setattr(out, name, float(rng.choice((-1.0, 1.0))) * share * flux)


def _draw_elastic_shaft(setup: Setup, machine: MachineFile, rng: np.random.Generator) -> None:
    """Divide the inertia into the two masses that resonance and antiresonance tell; nothing without them."""
    known, out = machine.machine, setup.machine
    if known.resonance_hz is None or known.antiresonance_hz is None:
        return
    places = {"resonance_hz": known.resonance_hz, "antiresonance_hz": known.antiresonance_hz}
    halves = {name: doubt(machine, name, place) for name, place in places.items()}
    w_r, w_a = (
        2.0 * math.pi * place * float(rng.uniform(*_about(1.0, halves[name]))) for name, place in places.items()
    )
    if w_a >= w_r:
        return
    out.J_load = out.J * (1.0 - (w_a / w_r) ** 2)
    out.J -= out.J_load
    out.coupling_stiffness = out.J_load * w_a**2
    zeta = (known.resonance_zeta or 0.0) * math.exp(rng.uniform(-1.0, 1.0) * math.log(ZETA_FACTOR))
    out.coupling_damping = 2.0 * zeta * out.coupling_stiffness / w_r


def _draw_shaft_effects(setup: Setup, machine: MachineFile, rng: np.random.Generator) -> None:
    """Draw what was identified along the shaft: drag, largest order of the cogging, errors and noise of the encoder."""
    out, seen = setup.machine, machine.conditions
    for name in ("encoder_once", "encoder_twice"):
        if isinstance(error_rad := seen.get(f"{name}_rad"), float):
            setattr(setup.sensors, name, float(rng.uniform(*SEEN_SHARES)) * error_rad)
    if isinstance(noise_rad := seen.get("encoder_noise_rad"), float):
        setup.sensors.encoder_noise = noise_rad
    if isinstance(drag := seen.get("drag_nms2"), float):
        out.drag = float(rng.uniform(*SEEN_SHARES)) * drag
    torque_nm, periods = seen.get("cogging_nm"), seen.get("cogging_periods")
    if isinstance(torque_nm, float) and isinstance(periods, int):
        out.cogging, out.cogging_periods = float(rng.uniform(*SEEN_SHARES)) * torque_nm, float(periods)


def _timing(machine: MachineFile, rng: np.random.Generator, *, late: bool) -> tuple[float, float, float]:
    """Draw the lag of the current sensors, the sampling instant and the age of the encoder's angle (s).

    About what was identified, else a short lag. What lag and instant do together is known better than either: what one
    is drawn longer, the other is earlier. An old angle shows at speed what a late sample does: half of the drives have
    the one, half the other; the age is then all that the d voltage at speed shows, of which a late sample that the
    square waves at standstill show is only the middle.
    """
    shown = machine.conditions.get("shown_instant_s")
    age = shown if isinstance(shown, float) else 0.0
    lag, instant, T_s = machine.inverter.current_lag_s, machine.inverter.sampling_instant_s, machine.inverter.T_s
    where = float(rng.uniform(0.0, 1.0))
    if lag is None or instant is None:
        return where * min(max(LAG_S, LAG_SHARES[0] * T_s), LAG_SHARES[1] * T_s), 0.0, 0.0
    stds = [machine.estimates[name].std for name in (LAG, INSTANT) if name in machine.estimates]
    apart = (2.0 * where - 1.0) * TIMING_COVERAGE * math.hypot(*stds)
    shift = max(-T_s, min(T_s, instant - apart))
    lag_s, shift_s = max(0.0, lag + apart), shift if late else min(0.0, shift)
    if instant > 0.0 and rng.random() < 0.5:
        return lag_s, 0.0, max(0.0, shift_s, age - lag_s)
    return lag_s, shift_s, 0.0


def _draw_inverter(setup: Setup, machine: MachineFile, rng: np.random.Generator) -> None:
    """Draw the inverter's error: every other drive with each edge, where the ripple decides what a dead time does.

    The plateau is dead time and thresholds together; the knee is what charges a leg's output within the dead time.
    """
    inverter, out = machine.inverter, setup.inverter
    nominal = out.dead_time[2]
    dead = nominal * float(rng.uniform(1.0 - DEAD_SPREAD, 1.0 + DEAD_SPREAD))
    mismatch = MISMATCH_OF_LEGS * dead * float(rng.uniform(-1.0, 1.0))
    knee = out.i_knee * math.exp(rng.uniform(-1.0, 1.0) * math.log(KNEE_FACTOR))
    share = float(rng.uniform(0.0, LARGEST_DROP_SHARE))
    if rng.random() < 0.5:
        out.model, out.shape = MODELS.index("averaged"), int(rng.integers(SHAPES.index("atan"), len(SHAPES)))
        out.i_knee, out.dead_time[:] = knee, [dead] * 3
        return
    out.model = MODELS.index("switched")
    out.dead_time[:] = [(1.0 - share) * t for t in (dead + mismatch, dead - mismatch, dead)]
    drop = share * dead * setup.U_dc / inverter.T_s
    out.V_switch, out.V_diode = drop, drop
    capacitance = 0.5 * knee * (1.0 - share) * dead / setup.U_dc
    L = min(setup.machine.L_d, setup.machine.L_q)
    least = library().pmsm_inverter_smallest_capacitance(dead + abs(mismatch), L)
    out.capacitance = capacitance if capacitance >= least else 0.0


def _friction(machine: MachineFile, rng: np.random.Generator) -> tuple[float, float]:
    """Draw viscous (N m s) and Coulomb friction (N m)."""
    known = machine.machine
    torque = abs(known.torque_nm(0.0, known.I_nom_apk or known.I_max_apk or 0.0))
    omega = rad_s_from_rpm(known.n_nom_rpm or known.n_max_rpm or 3000.0)
    drawn = []
    for value, largest in ((known.B_nms, FRICTION_SHARE * torque / omega), (known.tau_c_nm, FRICTION_SHARE * torque)):
        factor = math.exp(rng.uniform(-1.0, 1.0) * math.log(FRICTION_FACTOR))
        drawn.append(float(rng.uniform(0.0, largest)) if value is None else factor * value)
    return drawn[0], drawn[1]


def _excite(simulation: Simulation, excitation: Excitation) -> None:
    """Start an excitation with the next period."""
    out = simulation.excitation
    out.shape, out.point, out.hold_periods = excitation.shape, excitation.point, excitation.hold_periods
    out.amplitude, out.duration = excitation.amplitude, excitation.duration_s
    out.fixed_angle, out.buffer_samples = math.nan, len(excitation.buffer)
    if excitation.buffer:
        simulation.floats_at(Part.BUFFER, len(excitation.buffer))[:] = list(excitation.buffer)
    out.command = 2
