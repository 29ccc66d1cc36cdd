# SPDX-License-Identifier: MIT
"""Which experiments prove a design, and how large: sized from the design, the drive's conditions and the envelope."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from pmsmtool.design.design_file import Design
from pmsmtool.drive.port import Excitation, Injection, ProfileMove, Shape
from pmsmtool.errors import ConfigError, NotAvailable
from pmsmtool.identification.frequency_response import NOTHING, RIGID, SHOWN
from pmsmtool.identification.mechanics import ELASTIC_FALLBACK, MEAN_FALLBACK, PLAY_FALLBACK
from pmsmtool.machine.parameters import HallCommutation
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.machine.two_masses import (
    CERTAIN_ZETA,
    INERTIA,
    SWING,
    TORQUE_NOISE,
    TORQUE_NOISE_MOST,
    UNSEEN,
    hides_play,
)
from pmsmtool.machine.uncontrolled_generation import STATED
from pmsmtool.params.catalogue import FIELD_WEAKENING_MODES
from pmsmtool.proof.conditions import Conditions, room_k, warmth
from pmsmtool.units import RAD_S_PER_RPM

SPEED = "omega_e_rad_s"
SIGNALS = ("i_d_a", "i_q_a", SPEED, "u_d_lim_v", "u_q_lim_v")
"""What is recorded of every experiment but a move."""
LINK, VOLTAGE_LIMITED = "U_dc_v", ("unreachable", "weakening")
"""Recorded beside them in experiments whose response the link decides."""
MOVE_SIGNALS = ("following_error_rad", "omega_e_rad_s", "i_q_a")
"""What is recorded of a move by the position loop, and judged."""
STEPS = (0.5, 0.0, -0.5, 0.0, 1.0, 0.0, -1.0, 0.0)
"""Current steps of one pattern, over the larger one: two sizes and both signs."""
SETTLE = 8.0
"""A current level lasts this many time constants 1/alpha of its loop."""
BANDWIDTH_ROUNDING = 1e-3
"""Of them a rounding is no row more: the modulus optimum 1/(3 T_s) makes them 24 rows to the last bit of K_p and L."""
LEVEL_ROWS = (24, 64)
"""Least and most rows of a level."""
PATTERN_ROWS = 1536
"""Rows of the current steps: as many patterns as fit are averaged, against noise and the inverter's dead time."""
STEP_SHARE = 0.5
"""Larger current step, of the rated current."""
STEP_VOLTAGE_SHARE = 0.7
"""And its first voltage K_p i, of what the back-EMF leaves: the steps are to show the linear loop."""
GENERATION_SHARE = 0.97
"""Largest speed of the proof, of that of uncontrolled generation: room for what a ramp overshoots."""
STEP_SPEED_SHARE = 0.4
"""Speed of the current steps, of the base speed: fast enough to show the decoupling."""
STEP_SPEEDS, PATTERN_LOSS, TURN_ORDERS = np.linspace(1.0, 0.85, 31), np.linspace(-0.03, 0.01, 9), (1, 2, 6, 12)
"""Speeds of the current steps, of that one; the speed's change over their record; and orders per electrical turn of
what offsets, gains, dead time and harmonics do. Where all patterns begin at the same angle they are in the mean of all
patterns and in no scatter: two healthy drives failed that turned by 0.99 and 1.00 turns per pattern."""
STEP_SPEED_RISE = 0.25
"""Largest rise of the speed within a level of the q steps, relative (40 random drives: at most 0.032)."""
SCALE_SHARE = 0.25
"""Least scale of the current steps, of the rated current: ripple and converter steps do not shrink with the steps."""
SPEED_SHARE = 0.92
"""Largest speed that is asked for, of the envelope's."""
CURRENT_SHARE = 0.9
"""Largest current that is asked for, of the envelope's."""
COOL_LEAST = 0.2
"""Least speed step that such a winding is asked for, of the one that the loops and the record have room for."""
SPEED_ROWS = 400
SPEED_SETTLE = 8.0
"""A speed step is recorded for its ramp and this many time constants of the speed loop after it."""
LONGEST_S = 3.0
STEADY_ROWS = 20
"""Longest record of a speed, and its least rows after the ramp: what a machine shakes by shows in them alone. The ramps
of a shaft of 21 times the inertia ended behind their records, the one into field weakening before it: an encoder 0.03
deg off centre put i_q at 159 % of a band that knew nothing of it.
"""
WEAKENING_START, WEAKENING_LATEST = 0.8, 0.95
WEAKENING_END = 1.25
WEAKENING_LEAST = 1.03
"""Speeds of the entry into field weakening, of the speed at which the no-load voltage takes all there is; a heavy shaft
begins later."""
WEAKENING_SLOPE = 0.25
"""Slope of the ramp, of the design's: the full one takes most of the torque, whose currents would hide the entry."""
WEAKENING_HOLD = 4
"""Rows per level of the ramp's staircase."""
WEAKENING_CURRENT = 0.35
"""Most field-weakening current at its end without a load, of the current limit."""
UNREACHABLE = 1.15
UNREACHABLE_LEAST = 1.05
"""Voltage that an unreachable current takes in steady state, of the largest: wanted, and least that counts."""
UNREACHABLE_ROWS = (24, 96)
UNREACHABLE_SPEED_RISE = 0.05
UNREACHABLE_LARGEST_RISE = 0.25
"""Rise of the speed while it is asked for, relative: wanted, and largest with the fewest rows and all of the current
(40 random drives: at most 0.032). Beyond, the speed decides what the voltage lets through, not the governor."""

MOVE_ACCELERATION, MOVE_SPEED_SHARE = 0.4, 0.5
"""Acceleration of a move, of the design's largest, and its speed, of the largest that is asked for: no limit is to act.
"""
MOVE_RISE, MOVE_AT_SPEED, MOVE_SETTLE = 3.0, 3.0, 3.0
"""Most time to its speed, time at its speed, and time after it, in time constants 1 / K_p of the position loop: the
following error settles to 5 %."""
MOVE_RAMP, MOVE_RAMP_STEPS = 2.0, 100.0
"""Ramp of its acceleration, in time constants of the speed loop, and its most steps (the core has memory for 128)."""
MOVE_LEAST_INCREMENTS = 1.0
"""Least speed, in increments per step of the speed loop."""
MOST_COUNTS = 4e9
"""Increments/s3 and /s2: what 0x60A4, 0x6083 and 0x6084 (UNSIGNED32) hold."""
MOST_WAY = 2**30
"""Increments of a move: half of what tells forth from back in 0x607A (INTEGER32)."""


@dataclass(frozen=True, slots=True)
class Experiment:
    """One record."""

    name: str
    """``speed_step``, ``q_steps``, ``d_steps``, ``unreachable``, ``weakening``, ``move``, ``move_lag``."""
    text: str
    """What happens, one line."""
    base_rad_s: float
    """Mechanical speed held before (rad/s)."""
    excitation: Excitation
    """What is asked on top of it."""
    rows: int
    decimation: int
    """Size of the record."""
    repeats: int = 1
    """The record is this often the same pattern; it is averaged over them."""
    judged: tuple[str, ...] = ("i_d_a", "i_q_a")
    """Signals that have a band."""
    scale_a: float = 1.0
    scale_rad_s: float = 1.0
    """Scale of its currents (A), and of its electrical speed (rad/s)."""
    settle_s: float = 0.0
    """Time at the speed held before, after it is reached (s)."""
    steady_rows: int = 0
    """So many rows at the end are steady: what they shake by is the machine's ripple."""
    scale_rad: float = 1.0
    """Scale of its following error (rad)."""
    move: ProfileMove | None = None
    """Instead of the excitation: a move by the position loop."""
    velocity_ff: float = 1.0
    """Of the move's speed, share of what the design feeds forward; the drive is lent it for the record."""

    @property
    def signals(self) -> tuple[str, ...]:
        """What is recorded."""
        if self.move is not None:
            return MOVE_SIGNALS
        return (*SIGNALS, LINK) if self.name in VOLTAGE_LIMITED else SIGNALS

    def scale(self, signal: str) -> float:
        """Return the scale of a signal, in its unit."""
        return {"omega_e_rad_s": self.scale_rad_s, "following_error_rad": self.scale_rad}.get(signal, self.scale_a)

    @property
    def pattern_rows(self) -> int:
        """Rows after averaging."""
        return self.rows // self.repeats


@dataclass(frozen=True, slots=True)
class ProofPlan:
    """The experiments in the order they are run, and what is left out, with the reason."""

    experiments: tuple[Experiment, ...]
    left_out: tuple[str, ...] = ()

    def seconds(self, T_s: float, slope_rad_s2: float) -> float:
        """Return about how long the machine is energised (s), with a mechanical acceleration (rad/s2)."""
        speeds = [0.0, *(e.base_rad_s for e in self.experiments), 0.0]
        ramps = sum(abs(b - a) for a, b in pairwise(speeds)) / slope_rad_s2 if slope_rad_s2 > 0.0 else 0.0
        return ramps + sum(e.rows * e.decimation * T_s + 0.5 for e in self.experiments)


HALLS_ALONE = "nothing predicts a drive that commutates by Hall sensors alone"
"""Why such a drive is not proven."""


def plan_proof(design: Design, conditions: Conditions) -> ProofPlan:
    """Return the experiments that fit a design within an envelope.

    Raises NotAvailable: not even current steps fit, or the design is for a drive that Hall sensors alone commutate;
    ConfigError: the design gives no rated current.
    """
    if design["hall.commutation"] >= HallCommutation.ALONE:
        raise NotAvailable(
            HALLS_ALONE,
            hint="compare moves and records by hand; `pmsmtool caps` lists what such a drive gives",
        )
    sizes = _Sizes.of(design, conditions)
    experiments: list[Experiment] = []
    left_out: list[str] = []
    turning, unmodelled = sizes.turns, _unmodelled(design)
    if turning and unmodelled:
        left_out.append(f"speed step, field weakening: {unmodelled}")
    elif turning:
        step = _speed_step(sizes)
        if isinstance(step, Experiment):
            experiments.append(step)
        else:
            left_out.append(step)
    else:
        why = "the shaft is locked" if conditions.shaft == "locked" else "the design has no speed controller"
        left_out.append(f"speed step, field weakening, unreachable reference: {why}; current steps at standstill")
    if turning and INERTIA in design.machine.conditions:  # one of 220 Hz before 6.4 rotors was at 126 % of a rigid band
        left_out.append("q current steps: the speed follows them, and the inertia could not be identified")
    else:
        experiments.append(_current_steps(sizes, "q"))
    experiments.append(_current_steps(sizes, "d"))
    if turning:
        for make in (_unreachable,) if unmodelled else (_unreachable, _weakening):
            found = make(sizes)
            if isinstance(found, Experiment):
                experiments.append(found)
            else:
                left_out.append(found)
    moves = _moves(sizes, conditions.encoder_counts) if turning else "position moves: no speed loop, or a locked shaft"
    if isinstance(moves, str):
        left_out.append(moves)
    else:
        experiments += moves
    return ProofPlan(tuple(experiments), tuple(left_out))


@dataclass(frozen=True, slots=True)
class _Sizes:
    """What the experiments are sized with; speeds electrical unless they end in M."""

    design: Design
    T_s: float
    p: int
    psi: float
    L_d: float
    L_q: float
    R: float
    J: float
    I_test: float
    i_lim: float
    V_linear: float
    V_weakening: float
    omega_max: float
    omega_base: float
    turns: bool
    fastest_warm_rad_s: float
    alpha: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, design: Design, conditions: Conditions) -> _Sizes:
        machine, inverter = design.machine.machine, design.machine.inverter
        I_nom = design["motor.I_nom_apk"]
        if I_nom <= 0.0:
            raise ConfigError(
                "the design has no rated current",
                where="motor.I_nom_apk",
                hint="give I_nom_apk in the machine file, then tune again",
            )
        i_lim = CURRENT_SHARE * min(conditions.i_max_apk, design["motor.I_max_apk"])
        I_test = min(I_nom, i_lim)
        V = inverter.voltage_utilisation * conditions.U_dc_v
        psi, L_q = machine.psi_f_wb, machine.L_q_decoupling_h
        p = machine.pole_pairs
        omega_max = p * min(
            SPEED_SHARE * min(conditions.speed_max_rad_s, design["motor.n_max_rpm"] * RAD_S_PER_RPM),
            GENERATION_SHARE * _generation_rpm(design) * RAD_S_PER_RPM,
        )
        omega_base = V / math.hypot(psi, L_q * I_test)
        turns = conditions.shaft != "locked" and design["speed.K_p_nms_per_rad"] > 0.0
        warming, slope = warmth(design), design["speed.acceleration_rpm_per_s"] * RAD_S_PER_RPM
        return cls(
            design, inverter.T_s, p, psi, machine.L_d_decoupling_h, L_q, machine.R_s_ohm, machine.J_kgm2 or 0.0,
            I_test, i_lim, 0.85 * V, (1.0 - design["field_weakening.margin"]) * V, omega_max, omega_base, turns,
            room_k(design, conditions.T_winding_c) / (warming * slope) if warming * slope > 0.0 else math.inf,
            {a: design[f"current.K_p_{a}_v_per_a"] / L for a, L in (("d", machine.L_d_h), ("q", machine.L_q_h))},
        )  # fmt: skip

    @property
    def crossover_rad_s(self) -> float:
        """Crossover of the speed loop."""
        return float(self.design.facts.get("speed_crossover_rad_s", 50.0))

    @property
    def omega_steps(self) -> float:
        """Speed of the current steps."""
        return min(STEP_SPEED_SHARE * self.omega_base, 0.7 * self.omega_max) if self.turns else 0.0

    def rise(self, i_q_a: float) -> float:
        """Rise of the electrical speed per control period at i_d = 0 (rad/s); none where the inertia is not known."""
        return torque_per_ampere(self.p**2, self.psi) * i_q_a / self.J * self.T_s if self.J > 0.0 else 0.0


def _generation_rpm(design: Design) -> float:
    """Speed (rpm) above which a fault charges the DC link; infinity where something holds it."""
    held = design.machine.inverter.U_dc_chopper_v is not None or design.request.get("overspeed_protection") in STATED
    protected = held or design["protection.n_short_circuit_rpm"] > 0.0
    return math.inf if protected else float(design.facts.get("generation_rpm", math.inf))


def _unmodelled(design: Design) -> str:
    """Return why no response of the speed loop is predicted; empty where identification says how the shaft moves."""
    machine = design.machine
    inertia = machine.estimates.get("J_kgm2")
    told = inertia is not None and inertia.fallback.startswith(PLAY_FALLBACK)
    if told:
        return "the shaft has play, which nothing predicts"
    if hides_play(machine, CERTAIN_ZETA):
        zeta = 100.0 * (machine.machine.resonance_zeta or 0.0)
        return f"the resonance is damped by {zeta:.2g} %: play, or a coupling with very much damping"
    if INERTIA in machine.conditions:
        return "the inertia was to be identified, and could not be"
    noise = machine.conditions.get(TORQUE_NOISE)
    if isinstance(noise, float) and noise > TORQUE_NOISE_MOST and machine.machine.resonance_hz is None:
        return f"{100.0 * noise:.2g} % of the pulses' torque is not that of a rigid shaft: play, or an elastic coupling"
    if SWING in machine.conditions:
        return "torque pulses swing the shaft as no known resonance does: play, or an elastic coupling"
    if UNSEEN in machine.conditions:
        return "the shaft is not rigid, and what swings is not known: play, or an elastic coupling"
    if machine.conditions.get(SHOWN, RIGID) not in (RIGID, NOTHING) and machine.machine.resonance_hz is None:
        return "the shaft is not rigid, and no resonance was found: play, or an elastic coupling with much damping"
    return ""


def _speed_step(s: _Sizes) -> Experiment | str:
    slope = s.design["speed.acceleration_rpm_per_s"] * RAD_S_PER_RPM
    speed, cool = min(s.omega_steps / s.p, slope * _longest_ramp_s(s)), s.fastest_warm_rad_s
    if cool < COOL_LEAST * speed:
        return "speed step: its currents would warm the winding up to its trip; let it cool, then prove again"
    warm = ", no faster: the winding is warm" if cool < speed else ""
    speed = min(speed, cool)
    ramp_s = speed / slope
    rows, decimation = _record_of(s, ramp_s)
    text = f"speed step from standstill to {speed / RAD_S_PER_RPM:.4g} rpm{warm}"
    return Experiment("speed_step", text, 0.0, _speed_excitation(s, speed, rows, decimation), rows, decimation,
                      judged=("i_d_a", "i_q_a", "omega_e_rad_s"), scale_a=s.I_test,
                      scale_rad_s=s.p * speed, steady_rows=_steady_rows(s, ramp_s, rows, decimation))  # fmt: skip


def _record_of(s: _Sizes, ramp_s: float) -> tuple[int, int]:
    settle_s, moving = SPEED_SETTLE / s.crossover_rad_s, 1.0 - STEADY_ROWS / SPEED_ROWS
    seconds = min(LONGEST_S, max(ramp_s + settle_s, (ramp_s + 0.5 * settle_s) / moving))
    decimation = max(1, math.ceil(seconds / (SPEED_ROWS * s.T_s)))
    return SPEED_ROWS, decimation


def _longest_ramp_s(s: _Sizes) -> float:
    """Longest ramp whose record has a steady end; a third of the record at least."""
    moving = 1.0 - STEADY_ROWS / SPEED_ROWS
    return max(moving * LONGEST_S - 0.5 * SPEED_SETTLE / s.crossover_rad_s, LONGEST_S / 3.0)


def _steady_rows(s: _Sizes, ramp_s: float, rows: int, decimation: int) -> int:
    """Rows from half of the settling after a ramp on."""
    steady_from = math.ceil((ramp_s + 0.5 * SPEED_SETTLE / s.crossover_rad_s) / (decimation * s.T_s))
    return max(0, rows - steady_from)


def _speed_excitation(s: _Sizes, step_rad_s: float, rows: int, decimation: int) -> Excitation:
    # a little longer than the record: the reference falls back only after its last row
    duration = (rows * decimation + 2 * decimation) * s.T_s
    return Excitation(Shape.STEP, Injection.SPEED, step_rad_s, duration_s=duration)


def _current_steps(s: _Sizes, axis: str) -> Experiment:
    emf = s.omega_steps * s.psi
    room = s.V_linear - emf if axis == "q" else math.sqrt(max(s.V_linear**2 - emf**2, 0.0))
    K_p = s.design[f"current.K_p_{axis}_v_per_a"]
    periods = (1.0 - BANDWIDTH_ROUNDING) * SETTLE / (s.alpha[axis] * s.T_s)
    decimation = max(1, math.ceil(periods / LEVEL_ROWS[1]))
    level = min(LEVEL_ROWS[1], max(LEVEL_ROWS[0], math.ceil(periods / decimation)))
    # the shaft runs up while a level lasts: a light one takes voltage with it, and speed
    rise = s.rise(1.0) * level * decimation if axis == "q" and s.omega_steps > 0.0 else 0.0
    step = min(STEP_SHARE * s.I_test, STEP_VOLTAGE_SHARE * room / (max(K_p, 1e-9) + STEP_VOLTAGE_SHARE * rise * s.psi))
    if rise > 0.0:
        step = min(step, STEP_SPEED_RISE * s.omega_steps / rise, (s.omega_max - s.omega_steps) / rise)
    if step <= 0.0:
        raise NotAvailable("no current step fits the voltage", hint="check U_dc and the design's voltage")
    pattern = tuple(step * share for share in STEPS for _ in range(level))
    repeats = max(1, PATTERN_ROWS // len(pattern))
    rows = repeats * len(pattern)
    excitation = Excitation(
        Shape.BUFFER, Injection.I_Q if axis == "q" else Injection.I_D, step, hold_periods=decimation,
        duration_s=rows * decimation * s.T_s, buffer=pattern,
    )  # fmt: skip
    speed = _apart(s.omega_steps, len(pattern) * decimation * s.T_s, repeats) / s.p
    text = (
        f"i_{axis} steps of +-{0.5 * step:.4g} and +-{step:.4g} A at {speed / RAD_S_PER_RPM:.4g} rpm, {repeats} times"
    )
    scale = max(step, SCALE_SHARE * s.I_test)
    return Experiment(f"{axis}_steps", text, speed, excitation, rows, decimation, repeats, scale_a=scale)


def _apart(omega: float, pattern_s: float, repeats: int) -> float:
    """Return the electrical speed (rad/s) at which patterns begin at angles that are the most evenly apart."""
    if not omega or repeats < 2:
        return omega
    turns = np.multiply.outer(STEP_SPEEDS, 1.0 + PATTERN_LOSS) * omega * pattern_s
    angles = np.multiply.outer(turns, np.multiply.outer(TURN_ORDERS, np.arange(repeats)))
    left = np.abs(np.exp(1j * angles).mean(axis=-1)).mean(axis=1).max(axis=1)
    return float(omega * STEP_SPEEDS[np.argmin(left)])


def _unreachable(s: _Sizes) -> Experiment | str:
    if s.design["governor.mode"] == 0:
        return "unreachable reference: the design has no governor"
    V = s.V_linear / 0.85
    fastest = min(0.9 * s.V_weakening / s.psi if s.psi > 0.0 else math.inf, 0.85 * s.omega_max)
    K_p = s.design["current.K_p_q_v_per_a"]
    for current in (s.I_test, s.i_lim):
        omega = min(fastest, _speed_of_voltage(s, current, UNREACHABLE * V))
        needed, when = math.hypot(omega * s.L_q * current, omega * s.psi + s.R * current), "for good"
        if needed < UNREACHABLE_LEAST * V:
            needed, when = K_p * current + omega * s.psi, "at once"
        if needed >= UNREACHABLE_LEAST * V:
            break
    else:
        return f"unreachable reference: the voltage suffices for {s.i_lim:.4g} A at every speed below field weakening"
    rise = s.rise(current)
    if UNREACHABLE_ROWS[0] * rise > min(UNREACHABLE_LARGEST_RISE * omega, s.omega_max - omega):
        return (
            f"unreachable reference: the shaft is too light, {current:.4g} A may speed it up by "
            f"{UNREACHABLE_ROWS[0] * rise / s.p / RAD_S_PER_RPM:.4g} rpm from "
            f"{omega / s.p / RAD_S_PER_RPM:.4g} rpm within the record"
        )
    periods = UNREACHABLE_SPEED_RISE * omega / max(rise, 1e-30)
    rows = round(min(UNREACHABLE_ROWS[1], max(UNREACHABLE_ROWS[0], periods)))
    excitation = Excitation(Shape.STEP, Injection.I_Q, current, duration_s=rows * s.T_s)
    speed = omega / s.p / RAD_S_PER_RPM
    text = f"i_q step to {current:.4g} A at {speed:.4g} rpm, for which the voltage does not suffice {when}"
    return Experiment("unreachable", text, omega / s.p, excitation, rows, 1, scale_a=current,
                      settle_s=SPEED_SETTLE / s.crossover_rad_s)  # fmt: skip


def _back(levels: tuple[float, ...]) -> tuple[float, ...]:
    """Return the levels of a staircase in reverse, down to none; what it held at its top is not held again."""
    return (*(level for level in reversed(levels) if level < levels[-1]), 0.0)


def _speed_of_voltage(s: _Sizes, i_q: float, V: float) -> float:
    """Electrical speed at which i_d = 0 and i_q take the voltage V."""
    a, b, c = (s.L_q * i_q) ** 2 + s.psi**2, s.psi * s.R * i_q, (s.R * i_q) ** 2 - V**2
    return (-b + math.sqrt(max(b * b - a * c, 0.0))) / a


def _weakening(s: _Sizes) -> Experiment | str:
    if s.design["field_weakening.mode"] == FIELD_WEAKENING_MODES["off"]:
        return "entry into field weakening: it is off in the design"
    if s.psi <= 0.0:
        return "entry into field weakening: no magnet flux"
    corner = s.V_weakening / s.psi
    i_d = max(-WEAKENING_CURRENT * s.i_lim, 0.8 * s.design["field_weakening.i_d_min_a"])
    psi_end = s.psi + s.L_d * i_d
    end = min(WEAKENING_END * corner, s.omega_max, s.V_weakening / psi_end if psi_end > 0.0 else math.inf)
    slope = WEAKENING_SLOPE * s.design["speed.acceleration_rpm_per_s"] * RAD_S_PER_RPM
    span = s.p * slope * _longest_ramp_s(s)
    begin = min(max(WEAKENING_START * corner, end - span), WEAKENING_LATEST * corner)
    if end >= WEAKENING_LEAST * corner > begin + span:
        return (
            f"entry into field weakening: the shaft takes more than {LONGEST_S:g} s from "
            f"{begin / s.p / RAD_S_PER_RPM:.4g} rpm to {WEAKENING_LEAST * corner / s.p / RAD_S_PER_RPM:.4g} rpm"
        )
    end = min(end, begin + span)
    if end < WEAKENING_LEAST * corner:
        above = _generation_rpm(s.design)
        bound = s.omega_max >= GENERATION_SHARE * above * RAD_S_PER_RPM * s.p
        why = f"; above {above:.4g} rpm a fault would charge the DC link (--overspeed-protection)" if bound else ""
        return (
            f"entry into field weakening: it begins at {corner / s.p / RAD_S_PER_RPM:.4g} rpm, "
            f"{end / s.p / RAD_S_PER_RPM:.4g} rpm are within the limits{why}"
        )
    start, step = begin / s.p, (end - begin) / s.p
    rows, decimation = _record_of(s, step / slope)
    levels, hold = rows // WEAKENING_HOLD, WEAKENING_HOLD * decimation
    rise = slope * hold * s.T_s
    # one level more than the record has; then down by the levels it came, unrecorded: from there in one step, the
    # drive would brake with all its torque while the flux is weakened
    ramp = tuple(min(step, rise * k) for k in range(1, levels + 2))
    excitation = Excitation(Shape.BUFFER, Injection.SPEED, step, hold_periods=hold, buffer=(*ramp, *_back(ramp)))
    text = f"speed ramp from {start / RAD_S_PER_RPM:.4g} to {end / s.p / RAD_S_PER_RPM:.4g} rpm, into field weakening"
    return Experiment("weakening", text, start, excitation, rows, decimation,
                      judged=("i_d_a", "i_q_a", "omega_e_rad_s"), scale_a=s.I_test, scale_rad_s=end,
                      settle_s=SPEED_SETTLE / s.crossover_rad_s,
                      steady_rows=_steady_rows(s, step / slope, rows, decimation))  # fmt: skip


def _moves(s: _Sizes, increments: int) -> tuple[Experiment, ...] | str:
    """Return a move with the speed fed forward as designed, and its way back without: what K_p alone leaves shows."""
    K_p, slope = s.design["position.K_p_per_s"], s.design["speed.acceleration_rpm_per_s"] * RAD_S_PER_RPM
    if K_p <= 0.0:
        return "position moves: the design has no position controller"
    if unmodelled := _unmodelled(s.design):
        return f"position moves: {unmodelled}"
    machine = s.design.machine
    shown, J = machine.conditions.get(SHOWN, RIGID), machine.estimates.get("J_kgm2")
    bent = J is not None and J.fallback.startswith((ELASTIC_FALLBACK, MEAN_FALLBACK))
    if bent or shown not in (RIGID, NOTHING) or machine.machine.resonance_hz is not None:
        return "position moves: the shaft is not rigid, and its play where the torque reverses is not known"
    if shown == NOTHING:
        return "position moves: nothing shows that the shaft is rigid and without play: no frequency response"
    if not increments:
        return "position moves: the drive does not state the increments of a turn (0x608F)"
    unit = 2.0 * math.pi / increments
    acceleration = MOVE_ACCELERATION * slope * min(1.0, s.i_lim / s.design["motor.I_max_apk"])
    acceleration = min(acceleration, MOST_COUNTS * unit)
    speed = min(s.omega_steps / s.p, MOVE_SPEED_SHARE * s.omega_max / s.p, MOVE_RISE * acceleration / K_p)
    step_s = s.T_s * s.design["speed.decimation"]
    ramp_s = min(max(MOVE_RAMP / s.crossover_rad_s, step_s), MOVE_RAMP_STEPS * step_s)
    jerk = min(acceleration / (ramp_s * unit), MOST_COUNTS)
    move = ProfileMove(0, round(speed / unit), max(1, round(acceleration / unit)), max(1, round(jerk)))
    if move.velocity < MOVE_LEAST_INCREMENTS / step_s:
        return f"position moves: {increments} increments of a turn are too coarse for {speed / RAD_S_PER_RPM:.4g} rpm"
    rise_s, ramp_s = move.velocity / move.acceleration, move.acceleration / move.jerk
    at_speed_s = rise_s + ramp_s + MOVE_AT_SPEED / K_p
    move = replace(move, way=round(move.velocity * at_speed_s))
    if move.way > MOST_WAY:
        return f"position moves: {increments} increments of a turn are too fine for {speed / RAD_S_PER_RPM:.4g} rpm"
    moving_s, settling_s = at_speed_s + rise_s + ramp_s, MOVE_SETTLE / K_p + 0.5 * SPEED_SETTLE / s.crossover_rad_s
    decimation = max(1, math.ceil((moving_s + settling_s) / (SPEED_ROWS * s.T_s)))
    steady = max(0, SPEED_ROWS - math.ceil((moving_s + 0.5 * settling_s) / (decimation * s.T_s)))
    turns = f"{move.way / increments:.4g} turns at {speed / RAD_S_PER_RPM:.4g} rpm"
    nothing = Excitation(Shape.NONE, Injection.SPEED, 0.0)
    whole = Experiment(
        "move", f"move of {turns} by the position loop", 0.0, nothing, SPEED_ROWS, decimation, judged=MOVE_SIGNALS,
        scale_a=s.I_test, scale_rad_s=s.p * speed, steady_rows=steady, scale_rad=speed / K_p, move=move,
    )  # fmt: skip
    back = replace(
        whole, name="move_lag", text=f"and back, {turns}, without the speed fed forward", velocity_ff=0.0,
        move=replace(move, way=-move.way),
    )  # fmt: skip
    return whole, back
