# SPDX-License-Identifier: MIT
"""What the run will be good for, from its first small shot: standard deviations before the machine moves.

R from the design matrix of the levels and the noise at rest, L from the information of a triangle of the planned
ripple, psi_f from what the dead-time voltage of the small vectors leaves in the intercept. A prediction above the limit
of an accepted value refuses the run while nothing larger than the small vectors has been applied.

For inertia, friction and frequency response the plan is simulated with the rough shaft, and the Cramer-Rao bound of the
same whitened model that the estimator fits (``shaft.model``) is its prediction; of the frequency response, signal and
noise of a line.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.estimators.current_sensors import Noise
from pmsmtool.estimators.estimate import CONDITION_LIMIT, COVERAGE_FACTOR, SensorTolerance, information_bound
from pmsmtool.estimators.least_squares import RELATIVE_STEP, linear_solve
from pmsmtool.estimators.resistance import FIT_FROM, MEAN_NOISE_FACTOR, MODEL_FLOOR
from pmsmtool.estimators.shaft.disturbances import TILT_FLOOR, Extent, disturbances
from pmsmtool.estimators.shaft.frequency_response import COHERENT
from pmsmtool.estimators.shaft.mechanics import BLOCKS, SCALE_FLOOR
from pmsmtool.estimators.shaft.model import SHAFT, Problem, Run, fastest, positions, sizes_of, whitener
from pmsmtool.estimators.shaft.position import position_std
from pmsmtool.estimators.shaft.response_lines import HALF_WIDTH, HIGHEST_SHARE, LOWEST_HZ, ORDER
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

RIPPLE = 2.2e-3
"""Deviation of a block's torque, of the push's, that the fits of random drives with a switched inverter took: median
of 18, which go from 1.1e-3 to 6.6e-3."""
UNDRIVEN_SHARE = 0.1
"""Largest q current of a window that counts as coasting, of the largest one of the run."""


@dataclass(frozen=True, slots=True)
class RoughShaft:
    """What is known of a shaft before it is measured."""

    J: float
    B: float
    tau_c: float
    """Inertia (kg m2), viscous (N m s) and Coulomb friction (N m); friction 0 where nothing was seen of it."""
    torque_per_a: float
    """Torque per q current (N m/A)."""
    step_rad: float
    """Step of the encoder (rad)."""
    pole_pairs: int = 1
    """Of the machine."""


def rough_friction(speeds: Trace, J: float, torque_per_a: float, pole_pairs: int) -> tuple[float, float]:
    """Return viscous (N m s) and Coulomb friction (N m) as the windows of a run over speeds slow down.

    Parameters
    ----------
    speeds : Trace
        ``omega_first_rad_s omega_second_rad_s half_s i_q_a`` of every window, electrical, signed by the phase order.
    J : float
        Rough inertia (kg m2).
    torque_per_a : float
        Torque per q current (N m/A).
    pole_pairs : int
        Of the machine.
    """
    i_q = speeds["i_q_a"]
    undriven = np.abs(i_q) <= UNDRIVEN_SHARE * float(np.max(np.abs(i_q)))
    first, second = (speeds[f"omega_{half}_rad_s"][undriven] / pole_pairs for half in ("first", "second"))
    slowing = torque_per_a * i_q[undriven] - J * (second - first) / speeds["half_s"][undriven]
    omega = 0.5 * (first + second)
    columns = np.stack([omega, np.sign(omega)], axis=1)
    if len(omega) < 3:
        return 0.0, 0.0
    x, _, _, _ = linear_solve(columns, slowing, np.ones(len(omega)))
    return max(0.0, float(x[0])), max(0.0, float(x[1]))


# ---- pushes and coasting --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class PushPlan:
    """Pushes of a current (A peak) for so long (s), and coasting (s), once there and once back; rows of a push."""

    i_q_a: float
    unit_s: float
    coast_s: float
    rows: int


def predict_mechanics(shaft: RoughShaft, plan: PushPlan, sigma_a: float, scale_std: float) -> dict[str, float]:
    """Return relative standard deviations by machine-file key; a friction that was not seen is left out.

    Parameters
    ----------
    shaft : RoughShaft
        What is known so far.
    plan : PushPlan
        What will be done.
    sigma_a : float
        Noise of one sample of i_q (A).
    scale_std : float
        Relative standard deviation of the torque's scale.
    """
    runs = _planned(shaft, plan, sigma_a)
    speed = fastest(runs)
    if speed == 0.0:
        return {}
    extent = Extent(speed, shaft.torque_per_a * plan.i_q_a, TILT_FLOOR)
    runs = [
        replace(run, disturbances=disturbances(run.theta, run.torque, run.T, extent, shaft.pole_pairs)) for run in runs
    ]
    scale = sizes_of(runs)
    states = [v for run in runs for v in _state(run)]
    x = np.array([math.log(shaft.J), shaft.B, shaft.tau_c, *np.zeros(len(scale) - SHAFT - len(states)), *states])
    problem = Problem(runs, [whitener(run, shaft.J) for run in runs], RELATIVE_STEP * scale)
    bound, condition = information_bound(problem.jacobian(x))
    if not condition < CONDITION_LIMIT:
        return {}
    common = math.hypot(scale_std, SCALE_FLOOR)
    found = {"J_kgm2": math.hypot(float(bound[0]), common)}
    for name, value, std in (("B_nms", shaft.B, bound[1]), ("tau_c_nm", shaft.tau_c, bound[2])):
        if value > 0.0:
            found[name] = math.hypot(float(std) / value, common)
    return found


def _planned(shaft: RoughShaft, plan: PushPlan, sigma_a: float) -> list[Run]:
    """Return push, coasting, push back, coasting as the rough shaft would make them."""
    torque = shaft.torque_per_a * plan.i_q_a
    noise = math.hypot(shaft.torque_per_a * sigma_a * math.sqrt(BLOCKS / max(plan.rows, BLOCKS)), RIPPLE * torque)
    there, reached = _moved(shaft, torque, plan.unit_s, 0.0, noise)
    coasting, left = _moved(shaft, 0.0, plan.coast_s, reached, 0.0)
    back_s = plan.unit_s * min(2.0, 1.0 + abs(left) / abs(reached)) if reached != 0.0 else plan.unit_s
    back, turned = _moved(shaft, -torque, back_s, left, noise)
    last, _ = _moved(shaft, 0.0, plan.coast_s, turned, 0.0)
    return [there, coasting, back, last]


def _moved(shaft: RoughShaft, torque: float, seconds: float, omega: float, noise: float) -> tuple[Run, float]:
    """Return a trace at constant torque from a speed (rad/s), and the speed at its end."""
    T = seconds / BLOCKS
    torques = np.full(BLOCKS, torque)
    theta = positions(torques, T, np.array([math.log(shaft.J), shaft.B, shaft.tau_c, 0.0, omega]))
    single = theta.astype(np.float32).astype(np.float64)  # as a recorder carries it
    end = float(1.5 * (theta[-1] - theta[-2]) - 0.5 * (theta[-2] - theta[-3])) / T
    return Run(theta, torques, T, position_std(single, shaft.step_rad), noise, torque == 0.0), end


def _state(run: Run) -> tuple[float, float]:
    """First position and first speed of a trace."""
    return float(run.theta[0]), float(1.5 * (run.theta[1] - run.theta[0]) - 0.5 * (run.theta[2] - run.theta[1])) / run.T


# ---- frequency response ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ResponsePlan:
    """Binary sequence of a level (A peak) and a bit (s) at a speed (rad/s), in records of rows at a period (s).

    ``bandwidth_rad_s`` is that of the current loop, which the sequence passes.
    """

    i_q_a: float
    omega_rad_s: float
    bit_s: float
    row_s: float
    rows: int
    records: int
    bandwidth_rad_s: float


@dataclass(frozen=True, slots=True, eq=False)
class ResponsePrediction:
    """Relative standard deviation of the response of a rigid shaft over frequency."""

    frequency_hz: Array
    std: Array
    """Lines (Hz), and relative standard deviation of the magnitude at each. Shape (n,)."""
    highest_hz: float
    """Up to where the response will be coherent (Hz)."""
    J: float
    """Relative standard deviation of the inertia that its lines give, without the torque's scale."""
    deviation_a: float
    """Standard deviation of the current that shakes the shaft (A)."""

    def at(self, frequency_hz: float) -> float:
        """Return the relative standard deviation at a frequency."""
        return float(np.interp(frequency_hz, self.frequency_hz, self.std))


def predict_response(shaft: RoughShaft, plan: ResponsePlan, sigma_a: float) -> ResponsePrediction:
    """Predict what the lines of a response will be good for.

    The noise of a line is that of the positions times the frequency squared, and that of the currents; a resonance
    raises one and lowers the other, so that its own deviation is not known before it is.

    Parameters
    ----------
    shaft : RoughShaft
        What is known so far; its friction does not matter.
    plan : ResponsePlan
        What will be done.
    sigma_a : float
        Noise of one sample of i_q (A).
    """
    lines = np.arange(1, plan.rows // 2) / (plan.rows * plan.row_s)
    frequency = lines[(lines >= LOWEST_HZ) & (lines <= HIGHEST_SHARE / plan.row_s)]
    omega = 2.0 * math.pi * frequency
    loop = 1.0 / (1.0 + (omega / plan.bandwidth_rad_s) ** 2)
    # densities per line of one row: a binary sequence has A^2 T_bit sinc^2(f T_bit)
    torque = (
        shaft.torque_per_a**2 * plan.i_q_a**2 * plan.bit_s / plan.row_s * np.sinc(frequency * plan.bit_s) ** 2 * loop
    )
    turned = np.array([plan.omega_rad_s * plan.rows * plan.row_s], dtype=np.float32).astype(np.float64)
    position = float(position_std(turned, shaft.step_rad)[0])
    noise = (position * shaft.J * omega**2) ** 2 + (shaft.torque_per_a * sigma_a) ** 2
    freedom = plan.records * (2 * HALF_WIDTH - ORDER)
    std = np.sqrt(0.5 * noise / (torque * freedom))
    coherent = torque / (torque + noise) >= COHERENT
    highest = float(frequency[coherent][-1]) if np.any(coherent) else 0.0
    information = 2.0 * plan.records * float(np.sum(torque / noise))
    deviation = math.sqrt(2.0 * float(np.sum(torque)) / plan.rows) / shaft.torque_per_a
    return ResponsePrediction(frequency, std, highest, 1.0 / math.sqrt(information), deviation)


def displaced_share(u_v: Sequence[float], L_h: float, i_a: float, dead_time_s: float) -> float:
    """Return by how much of a current its samples are off the mean, at voltages (V): u t_d/(2 L) each, of the current.

    A dead time delays every pulse by half of it (``estimators/inverter_error``).
    """
    return 0.5 * dead_time_s * float(np.mean(np.abs(u_v))) / (L_h * i_a)


STAGE = "plan"
TAIL = (1, 2)
"""Tail terms of the predicted fit: the richest of the usual models."""
L_NUISANCE = 2.0
"""Standard deviation with delay, lag and resistance free, over the one of L alone (random drives: 1.5 to 2.5)."""
L_FLOOR = 3e-4
PSI_DEAD_TIME = 0.02
"""Part of the dead-time voltage that stays in psi_f's back-emf (random drives: 0.01 to 0.03)."""
LIMIT = 0.03
"""Relative 95 % half width of an accepted value."""


NAMES: Mapping[str, str] = {
    "R_s_ohm": "R_s",
    "L_d_h": "L_d",
    "L_q_h": "L_q",
    "psi_f_wb": "psi_f",
    "J_kgm2": "J",
    "B_nms": "B",
    "tau_c_nm": "tau_c",
}
"""Machine-file keys as a person reads them."""
STEPS: Mapping[str, tuple[str, ...]] = {"levels": ("R_s_ohm",), "square": ("L_d_h", "L_q_h"), "speeds": ("psi_f_wb",)}
"""What each experiment gives that the first small shot predicts."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """Relative standard deviations of the run to come (1)."""

    R_s: float
    L: float
    psi_f: float

    def values(self, steps: Iterable[str] = tuple(STEPS)) -> dict[str, float]:
        """Return those that a run of these experiments gives, by machine-file key."""
        known = {"R_s_ohm": self.R_s, "L_d_h": self.L, "L_q_h": self.L, "psi_f_wb": self.psi_f}
        run = set(steps)
        return {key: known[key] for step, keys in STEPS.items() if step in run for key in keys}


def line_of(values: Mapping[str, float]) -> str:
    """Return predictions as a person reads them; neighbours of one value share it."""
    parts: list[str] = []
    keys = list(values)
    for k, key in enumerate(keys):
        alike = k + 1 < len(keys) and values[keys[k + 1]] == values[key]
        parts.append(NAMES[key] if alike else f"{NAMES[key]} {100 * values[key]:.2g} %")
    return "predicted standard deviation: " + ", ".join(parts)


def predict(
    noise: Noise,
    levels_a: Sequence[float],
    window_samples: int,
    ripple_a: float,
    shot_samples: int,
    dead_time_v: float,
    emf_v: float,
    tolerance: SensorTolerance,
) -> Prediction:
    """Predict the standard deviations.

    Parameters
    ----------
    noise : Noise
        From the zero-current trace.
    levels_a : sequence of float
        Planned DC levels, both signs (A).
    window_samples : int
        Samples averaged at each.
    ripple_a, shot_samples : float, int
        Planned ripple, peak to peak (A), and samples of both shots of an axis.
    dead_time_v, emf_v : float
        Largest voltage of the small vectors, which dead time makes, and back-emf of the middle speed (V).
    tolerance : SensorTolerance
        With the thresholds of the bridge.
    """
    levels = np.asarray(levels_a, dtype=np.float64)
    peak = float(np.max(np.abs(levels)))
    used = levels[np.abs(levels) >= FIT_FROM * peak] / peak
    sign = np.sign(used)
    columns = np.stack([used, sign, np.ones_like(used), *(sign / np.abs(used) ** p for p in TAIL)], axis=1)
    covariance = linear_solve(columns, used, np.ones_like(used))[1]
    per_level = math.hypot(MEAN_NOISE_FACTOR * noise.sigma_a / (math.sqrt(window_samples) * peak), MODEL_FLOOR)
    R_s = per_level * math.sqrt(float(covariance[0, 0]))
    L = L_NUISANCE * noise.sigma_a * math.sqrt(12.0 / shot_samples) / ripple_a
    scale = tolerance.voltage_scale_std
    return Prediction(
        math.hypot(R_s, scale), math.hypot(L, L_FLOOR, scale), math.hypot(PSI_DEAD_TIME * dead_time_v / emf_v, scale)
    )


def check_prediction(values: Mapping[str, float]) -> None:
    """Refuse a run whose intervals would be wider than an accepted value's. Raises IdentificationError: ``E_SNR``.

    Parameters
    ----------
    values : mapping of str to float
        Relative standard deviations of what the run is to give.
    """
    for key, value in values.items():
        if COVERAGE_FACTOR * value > LIMIT:
            raise refuse(
                "E_SNR",
                f"the 95 % interval of {NAMES[key]} would be {100 * COVERAGE_FACTOR * value:.2g} %, limit "
                f"{100 * LIMIT:g} %",
                stage=STAGE,
            )
