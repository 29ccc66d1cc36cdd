# SPDX-License-Identifier: MIT
"""The Monte Carlo prediction: the drive's own firmware on machines drawn from their intervals.

What varies: the machine's parameters (statistical and systematic part; a machine that saturates has its flux map scaled
by those of its inductances and of its magnet), the encoder offset, temperatures about what the drive measures, the DC
link, friction, the inverter's error, sensor offsets and mismatch, lag, the angle at the start, and the d current of a
field weakening that searches. What is the same: the set the drive holds, cut to the envelope as the drive cuts it.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.design.design_file import Design
from pmsmtool.design.prediction import Direction, Prediction, Runs, predict
from pmsmtool.design.tolerance import tolerance_box
from pmsmtool.drive.port import Excitation, Injection
from pmsmtool.estimators.resistance import R_MEASURED, at_the_test
from pmsmtool.machine.flux_map import FluxScale, ScalableMap
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.params.catalogue import FIELD_WEAKENING_MODES
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.proof.conditions import Conditions
from pmsmtool.proof.defects import DEFECTS, QUANTITIES, Defect, is_possible
from pmsmtool.proof.drawn_machine import (
    EMF_HARMONICS,
    T_MAGNET_SPREAD_K,
    T_SPREAD_K,
    U_DC_SPREAD,
    about,
    draw_machine,
    with_fine_cogging,
)
from pmsmtool.proof.plan import Experiment, ProofPlan
from pmsmtool.proof.simulated_move import hold, record_move, weaken
from pmsmtool.sim.closed_loop import DRIVE_SIGNALS, cores, image_of
from pmsmtool.sim.kernel import Params, Part, Setup, Simulation, Truth
from pmsmtool.sim.scenarios import MODES
from pmsmtool.sim.simulated_machine import build_setup
from pmsmtool.units import rpm_from_rad_s

RUNS = 96
"""Drawn machines: the largest of 96 holds 95 % of all with a confidence of 99.3 %."""
FAULT_RUNS = 4
"""Drawn machines behind each fault's signature, for :data:`RUNS`; the first of the healthy ones, with their numbers."""

RIPPLE_LEAST = 0.005
"""Amplitude of the link's ripple, relative, from which on it is drawn: what less does, :data:`U_DC_SPREAD` covers."""
BASE_SPEED = (-0.03, 0.01)
"""Relative range of the speed that is held before current steps: what coasting lets it lose, too."""
COAST_PERIODS = (8, 64)
"""The speed loop's current is switched off so long before a current step: the loops may not have settled, but a bus
takes some periods (ten records held nothing of it; one machine of 96 that did made the bands of all twice as wide).
At standstill, they settle for the longer one."""
PHASES = 64
"""Periods over which the start is drawn: slower tasks of the drive (speed control) are anywhere in their cycle."""
ALLOWANCES = {"unreachable": 2.0}
"""Half width over that of the drawn machines where it is not the usual 1.3: at the voltage limit ripple, shortest
pulses and the flux map decide (with 1.3 one healthy drive of 125 came to 1.13 of its band, the measured map to 1.03).
"""
SAME_SPEED, STARTS, LEAST_LEFT = 5e-3, 5, 0.2
"""Share of the speed that a shaft may be off when a current step begins, of 4 % that :data:`BASE_SPEED` draws, and how
often it is started again for that: a light one loses a quarter of its speed, and how much depends on it. Of a faster
start at least that share is left."""
_WITHOUT_SEARCH = {FIELD_WEAKENING_MODES[name] for name in ("off", "lookup")}
"""Field weakening whose d current follows the torque at once; the other modes come to it step by step."""
RUN_IN = 4.0
"""A speed is held for this many time constants of the speed loop before a speed step."""
HOLD = 6.0
LONGEST_HOLD = 4096
"""Time constants L/R for which the current that holds a speed flows before a current step, and most periods: with less,
what is left of the start shifts the prediction (64 periods, 1 L/R, of a warm winding: i_q by 0.35 of 7.2 A)."""


@dataclass(frozen=True, slots=True)
class Start:
    """How one machine enters one experiment: by chance, and anew each time."""

    base_speed: float
    """Speed held before current steps, relative to the one asked for, less one."""
    phase: int
    coasting: int
    """Control periods of the drive's slower tasks that have passed, and without current before a current step."""
    held: float
    """Torque that holds the shaft before a move, of the Coulomb torque."""
    theta_M_rad: float
    """Angle of the shaft (rad)."""
    weakened: float
    """d current that field weakening without a table starts from, of the one of least current at rated torque."""
    cogging: float
    """Of a move: share of the largest usual cogging."""

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Start:
        """Draw one."""
        return cls(
            float(rng.uniform(*BASE_SPEED)), int(rng.integers(PHASES)),
            int(rng.integers(COAST_PERIODS[0], COAST_PERIODS[1] + 1)),
            float(rng.uniform(-1.0, 1.0)), float(rng.uniform(-math.pi, math.pi)), float(rng.uniform(0.0, 1.0)),
            float(rng.uniform(0.0, 1.0)),
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
        machine = _simulated(as_tested(design.machine), conditions)
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
            machine,
            U_dc_v=about(conditions.U_dc_v, U_DC_SPREAD * conditions.U_dc_v),
            T_winding_c=about(base.T_winding, T_SPREAD_K),
            T_magnet_c=about(base.T_magnet, T_MAGNET_SPREAD_K if math.isnan(conditions.T_magnet_c) else T_SPREAD_K),
        ).draw(runs, seed, 0)
        return [draw_machine(base, machine, samples, row, rng, self._design["motor.I_max_apk"]) for row in range(runs)]

    def respond(self, experiment: Experiment, defect: Defect | None = None, runs: int | None = None) -> Array:
        """Simulate an experiment.

        Returns
        -------
        ndarray, shape (runs, signals, pattern rows)
            Signals as the experiment lists them.
        """
        count = len(self.setups) if runs is None else runs
        # a drive is simulated in C, beside the others
        with ThreadPoolExecutor(cores()) as pool:
            responses = pool.map(lambda row: self._response(row, experiment, defect), range(count))
            return np.stack([response.T for response in responses])

    def _response(self, row: int, experiment: Experiment, defect: Defect | None) -> Array:
        """Simulate an experiment on one drive, shape (pattern rows, signals)."""
        if experiment.move is not None:
            return self._move(row, experiment, defect)
        drive = self._start(row, experiment, defect)
        in_speed_mode = experiment.excitation.point is Injection.SPEED
        run_in = COAST_PERIODS[1]
        if in_speed_mode:
            crossover = float(self._design.facts.get("speed_crossover_rad_s", 50.0))
            run_in = round((RUN_IN if experiment.base_rad_s else 0.25) / (crossover * self._T_s))
        elif experiment.base_rad_s:
            machine = self._nominal.machine
            slowest_s = max(machine.L_d, machine.L_q) / (machine.R_copper + machine.R_fixed)
            run_in = min(max(run_in, round(HOLD * slowest_s / self._T_s)), LONGEST_HOLD)
        self._get_ready(drive, row, experiment, run_in)
        if experiment.base_rad_s and not in_speed_mode:
            drive = self._at_speed(drive, row, experiment, defect, run_in)
        _excite(drive, experiment.excitation)
        record = drive.record(
            [DRIVE_SIGNALS[name][0] for name in experiment.signals], experiment.rows, experiment.decimation
        )
        drive.run(experiment.rows * experiment.decimation)
        return averaged(record.T, experiment).T

    def _at_speed(
        self, drive: Simulation, row: int, experiment: Experiment, defect: Defect | None, run_in: int
    ) -> Simulation:
        """Return a drive that has coasted to its speed: there the record of the machine begins (``measured.KEPT``)."""
        begun = (1.0 + self._starts[experiment.name, row].base_speed) * experiment.base_rad_s
        lead = before = 0.0
        for _ in range(STARTS):
            lost = begun - drive.signal(Truth.OMEGA_M)
            if abs(lost) <= SAME_SPEED * abs(experiment.base_rad_s):
                break
            lead += lost / max(LEAST_LEFT, 1.0 - lost / before if before else 1.0)
            before = lost
            faster = self._start(row, experiment, defect, lead)
            self._get_ready(faster, row, experiment, run_in)
            if faster.word(Part.TRIP).value:
                break  # off, it would be no drive of this machine
            drive = faster
        return drive

    def _move(self, row: int, experiment: Experiment, defect: Defect | None) -> Array:
        drive = self._start(row, experiment, defect)
        start = self._starts[experiment.name, row]
        held_nm = start.held * self.setups[row].machine.tau_c
        hold(drive, experiment, self._increments, self._T_s, start.phase, held_nm, self._weakened_a(start))
        return record_move(drive, experiment)

    def _weakened_a(self, start: Start) -> float:
        """Return the d current that field weakening has when an experiment begins (A).

        An optimisation without a table comes to that of least current within seconds, however long the drive is on: a
        healthy machine with L_q 2.5 times L_d had -37 A where a drive just switched on has -2.5 A.
        """
        searches = self._design["field_weakening.mode"] not in _WITHOUT_SEARCH
        return start.weakened * self._design["field_weakening.i_d_lm_a"] if searches else 0.0

    def _get_ready(self, drive: Simulation, row: int, experiment: Experiment, run_in: int) -> None:
        """Let the loops settle; before a step at a speed, the current that held it has just been switched off."""
        coasts = experiment.base_rad_s and experiment.excitation.point is not Injection.SPEED
        if coasts:
            drawn, torque_per_amp = self.setups[row].machine, self._design.machine.machine.torque_nm(0.0, 1.0)
            friction = drawn.tau_c + (drawn.B + drawn.drag * experiment.base_rad_s) * experiment.base_rad_s
            drive.reference.i_q_ref = friction / torque_per_amp if torque_per_amp else 0.0
        start = self._starts[experiment.name, row]
        if experiment.excitation.point is Injection.SPEED:
            drive.run(1)  # the first period clears the controllers
            weaken(drive, self._weakened_a(start))
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
        if experiment.move is not None:
            with_fine_cogging(setup, self._design.machine, start.cogging)
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
            derived.nominal, derived.unit, high, low, derived.at_high, derived.at_low, below, above, derived.least
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
    """Return a machine with the resistance and the interval of the test.

    A resistance that was refused because an inverter's knee may be part of it is what the loop has all the same, as far
    as the test went, and the inverter's error is what it leaves: with that of the data sheet, 28 % less, a healthy
    motor of 0.05 A left its band.
    """
    measured, source = machine.estimates.get(R_MEASURED), machine.machine
    if measured is not None and "R_s_ohm" not in machine.estimates:
        warmer = measured.T_c - source.T_ref_c if math.isfinite(measured.T_c) else 0.0
        R = measured.value / (1.0 + source.alpha_R_per_k * warmer)
        copper = None if source.R_winding_ohm is None else source.R_winding_ohm * R / source.R_s_ohm
        std = {name: value for name, value in machine.std.items() if name != "R_s_ohm"}  # no less than is assumed
        return replace(machine, machine=replace(source, R_s_ohm=R, R_winding_ohm=copper), std=std)
    R_tested = at_the_test(machine.estimates).get("R_s_ohm")
    if R_tested is None or "R_s_ohm" not in machine.std or R_tested is machine.estimates["R_s_ohm"]:
        return machine
    return replace(
        machine,
        std={**machine.std, "R_s_ohm": R_tested.std},
        systematic={**machine.systematic, "R_s_ohm": R_tested.systematic},
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
        **{f"sensor_offset_{x}_apk": offset for x, offset in zip("abc", conditions.offsets_apk, strict=True)},
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


def _excite(simulation: Simulation, excitation: Excitation) -> None:
    """Start an excitation with the next period."""
    out = simulation.excitation
    out.shape, out.point, out.hold_periods = excitation.shape, excitation.point, excitation.hold_periods
    out.amplitude, out.duration = excitation.amplitude, excitation.duration_s
    out.fixed_angle, out.buffer_samples = math.nan, len(excitation.buffer)
    if excitation.buffer:
        simulation.floats_at(Part.BUFFER, len(excitation.buffer))[:] = list(excitation.buffer)
    out.command = 2
