# SPDX-License-Identifier: MIT
"""Inertia, viscous and Coulomb friction: whitened output-error fit on the encoder's position.

    J dw/dt = T_e - B w - T_c sgn(w), with stick-slip (docs/identification.md, 3.5)

Pushes by a known current, and coasting with the voltage off; each trace has its own first position and speed. The
measured currents drive the model, so their noise is torque noise, a random walk in speed. The residual of the
position is whitened with Sigma = s_theta^2 I + s_T^2 G G', G_kj = (k - j - 1/2) T^2/J for j < k; without it friction
wanders by several standard deviations. Torque that neither model nor noise explains (an inverter's ripple between the
samples, cogging) counts as more noise of the torque, until the residual agrees with it or it is too much. Every
interval is solved in closed form, with the instant of a reversal.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.angle_harmonics import DEGREE, LEAST_SPEED, SURE, AngleHarmonics, Harmonic, angle_harmonics
from pmsmtool.estimators.estimate import (
    COVERAGE_FACTOR,
    SensorTolerance,
    chi2_gate,
    condition_gate,
    coverage_factor,
    information_weights,
    scaled_covariance,
)
from pmsmtool.estimators.least_squares import RELATIVE_STEP, Fit, levenberg_marquardt, linear_solve
from pmsmtool.estimators.shaft.disturbances import NONE, TILT_FLOOR, Extent, disturbances, encoder_prior
from pmsmtool.estimators.shaft.model import (
    COASTING_FLOOR,
    SHAFT,
    Problem,
    Run,
    cogging_orders,
    fastest,
    largest_torque,
    noisier,
    sizes_of,
    torque_noise,
    whitener,
)
from pmsmtool.estimators.shaft.position import encoder_step, position_noise, position_std
from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

Torque = Callable[[Array, Array], Array]
"""Torque (N m) of arrays of i_d, i_q (A)."""

STAGE = "mechanics"
POWERED = "powered"
"""Condition of a coasting with the voltage on: ``i_d_a`` and ``i_q_a`` are its torque."""
BLOCKS = 250
"""Positions of a trace in the fit; the currents between two are averaged."""
TRACES_LEAST = 4
"""A push and a coasting in each direction."""
MOVING_LEAST = 16  # blocks at the begin of a trace from which a fit starts, however soon the shaft rests
REST_SHARE = 0.005
"""Way of the shaft, of a trace's whole, from which on it is fitted."""
STEP_SHARE = 0.1
"""Part of a push within which its step may be limited."""
COARSE_RIPPLES = (0.3, 0.03, 3e-3, 3e-4)
"""Least noise of the torque in the first fits, of the push's, one after the other: with an encoder's resolution alone
the cost is a narrow, bent valley in which a fit from rough starting values does not arrive (1 of 160 realisations)."""
COST_TOLERANCE, COARSE_TOLERANCE = 1e-4, 1.0
"""Fall of the whitened cost below which a fit is done, a hundredth of a standard deviation, and one of the first fits,
which only lead there: with the smaller one there, too, values moved by 6e-5 of their deviations, for a fifth more
time."""
FITS_MOST = 10
"""Fits after it; the second whitens with the inertia of the first, more only where the torque's noise grows."""
PATIENT_FITS = 2
"""Fits after which the noise grows before a minimum, too: a shaft that the model is far from has none."""
TORQUE_FLOOR = 1e-3
"""Deviation of a block's torque beyond the noise of the currents, of the push's: ripple that samples do not show."""
SEPARABLE = 0.5e7
"""Largest condition number: a covariance is good to 1e7; below, a friction that is known badly leaves J as it is."""
RIPPLE_MOST = 0.15
"""Largest deviation of a block's torque, of the push's: above, the shaft is not what the model says."""
UNEXPLAINED = 2.0
"""Growth of the torque's noise in pushes or coasting from which on it is more than the model's."""
DRAG_PENALTY = 6.0
"""Price of the drag in the information criterion: half from 2.4 standard deviations on. With 9 one of 1.9 was left out,
B 8 times too large at +-48 %; with 4 a shaft without drag has up to 6 times the deviation of B, with 6 up to 3."""
NOTED = 0.01
"""Deviation of a block's torque, of the push's, from which on a reader is told why the intervals are wide; the default
machine has 0.0035 to 0.0039."""
NOISY_TORQUE = "cogging, a load or a gear on the shaft, an elastic coupling, an encoder that is off centre"
SCALE_FLOOR = 3e-4
"""Relative deviation of the torque's scale beyond that of flux linkage and displaced samples."""
HELD = 1.4  # cogging, of a push's torque, that holds a rotor at rest: a pendulum goes over from 0.725 of its weight on
NO_HARMONICS = AngleHarmonics()
MEAN_STD = 0.04
"""Relative standard deviation of the inertia by mean accelerations: six shafts with play were 0.1 to 1.6 % off."""
MEANS = {"J_kgm2": "kg m2", "B_nms": "N m s", "tau_c_nm": "N m"}
MEAN_METHOD = "mean torque and acceleration of torque pulses and coasting"
METHOD = "torque pulses and coasting, output error on position, whitened"


@dataclass(frozen=True, slots=True)
class MechanicsResult:
    """What a run of current steps says of the shaft."""

    J: Estimate
    B: Estimate
    tau_c: Estimate
    """Inertia (kg m2), viscous (N m s) and Coulomb friction (N m)."""
    fit_std: tuple[float, float, float]
    """Standard deviations of the three by the fit alone, without the torque's scale that they share."""
    ripple: float
    """Deviation of a block's torque that the residual asked for, of the push's."""
    chi2: float
    """Reduced chi-square of the whitened position."""
    unexplained: bool
    """Whether that is so much more than the currents' noise and the floor that it widens the intervals notably."""
    harmonics: AngleHarmonics = NO_HARMONICS
    """Cogging torque and encoder error that were taken out."""
    drag: Estimate | None = None
    """Torque per square of the speed (N m s2), where the data ask for it: it is in neither B nor tau_c."""
    orders: Sequence[int] = ()
    """Of a cogging (per turn) that a coasting of less than a turn hides, and that was fitted along."""

    @property
    def note(self) -> str:
        """What a reader should know of the torque's noise; empty where it is too small to be worth it."""
        lines = []
        if self.drag is not None:
            lines.append(f"drag over the square of the speed, {self.drag.value:.3g} N m s2, is in neither B nor tau_c")
        if self.harmonics.acceleration_rad_s2:
            orders = ", ".join(f"{h.order}" for h in self.harmonics.acceleration_rad_s2)
            torque = max(h.amplitude for h in self.harmonics.acceleration_rad_s2) * self.J.value
            lines.append(f"cogging of {torque:.3g} N m (orders per turn: {orders}) was taken out of J, B and tau_c")
        if self.orders:
            lines.append(
                f"cogging (orders per turn: {', '.join(map(str, self.orders))}), which so short a coasting does not "
                "show alone, was fitted along with J, B and tau_c"
            )
        if self.unexplained and self.ripple >= NOTED:
            lines.append(
                f"J, B and tau_c: torque noise of {100.0 * self.ripple:.2g} % of that of the pulses, counted in "
                f"their intervals; likely {NOISY_TORQUE}"
            )
        return "; ".join(lines)


def estimate_mechanics(
    runs: Sequence[Trace],
    torque: Torque,
    torque_per_a: float,
    sigma_a: float,
    scale_std: float,
    *,
    direction: int = 1,
    tolerance: SensorTolerance | None = None,
    tilt_std: float = TILT_FLOOR,
    pole_pairs: int = 1,
    encoder: Sequence[Harmonic] = (),
    elastic: bool = False,
) -> MechanicsResult:
    """Estimate inertia and friction.

    Raises IdentificationError: ``E_CLIPPED``, ``E_EXCITATION``, ``E_NOT_IDENTIFIABLE``, ``E_NOT_CONVERGED``,
    ``E_MODEL_MISMATCH``.

    Parameters
    ----------
    runs : sequence of Trace
        ``theta_M_rad`` of pushes and coasting in both directions; of a push ``i_d_a i_q_a flagged``, too, in the frame
        of the d axis; ``meta["coasting"]``: no torque, or hardly any (:data:`POWERED`).
    torque : callable
        Torque of the currents, by flux linkage or flux map at the temperature of the run.
    torque_per_a : float
        Its slope over i_q (N m/A), for the noise.
    sigma_a : float
        Noise of one sample of i_q (A).
    scale_std : float
        Relative standard deviation of that torque's scale: it goes into all three one to one.
    direction : int
        Sign of the encoder's count along the phase order.
    tolerance : SensorTolerance
        Declared sensor tolerances.
    tilt_std : float
        Relative standard deviation of the pushes' torque at their fastest speed, less at others.
    pole_pairs : int
        Of the machine: the current sensors' errors turn with the electrical angle.
    encoder : sequence of Harmonic
        Its error once and twice per turn along the phase order (rad), as a slow rotation shows it.
    elastic : bool
        Count any deviation of the torque as noise: the caller has another method to compare the inertia with.
    """
    tolerance = tolerance or SensorTolerance()
    if len(runs) < TRACES_LEAST:
        raise refuse("E_EXCITATION", f"{len(runs)} traces, {TRACES_LEAST} needed", stage=STAGE)
    runs = [_window(run) for run in runs]
    flagged = sum(int(np.sum(run["flagged"] > 0.0)) for run in runs if not run.meta["coasting"])
    if flagged:
        raise refuse("E_CLIPPED", f"{flagged} samples of the run are limited or clipped", stage=STAGE)
    step = encoder_step([run["theta_M_rad"] for run in runs])
    coasted = [(run.t_s, direction * run["theta_M_rad"]) for run in runs if run.meta["coasting"]]
    pushed = [(run, max(2, len(run) // 40)) for run in runs if not run.meta["coasting"]]
    changes = [np.diff(run["theta_M_rad"][::k], 2) / (k * run.period_s) ** 2 for run, k in pushed]
    most = HELD * max((float(np.max(np.abs(change), initial=0.0)) for change in changes), default=math.inf)
    harmonics = angle_harmonics([(t_s, theta, position_std(theta, step)) for t_s, theta in coasted], step, most)
    coasting = {h.order: h for h in harmonics.encoder_rad}
    prior = [replace(coasting.get(h.order, h), std=h.std) for h in encoder_prior(encoder, pole_pairs)]
    known = replace(harmonics, encoder_rad=tuple(prior))

    def fitted(runs: Sequence[Trace]) -> Fitted:
        def blocks_of(J_kgm2: float, orders: Sequence[int] = ()) -> list[Run]:
            given = (torque, abs(torque_per_a) * sigma_a, direction, pole_pairs, step, known, J_kgm2)
            found = [_blocks(run, *given) for run in runs]
            sizes = fastest([run for _, run in found]), largest_torque([run for _, run in found])
            extent = Extent(*sizes, tilt_std, prior, orders)
            return [
                replace(run, disturbances=disturbances(theta, run.torque, run.T, extent, pole_pairs))
                for theta, run in found
            ]

        blocks = blocks_of(0.0)
        start = _start(blocks)
        if harmonics.acceleration_rad_s2:
            # the torque over the angle is known as an acceleration: it takes the inertia of a fit before
            start = _without_shapes(_fit(blocks_of(math.exp(start[0])), start, elastic)[0], len(runs))
            blocks = blocks_of(math.exp(start[0]))
        found, chi2, noisy = _fit(blocks, start, elastic)
        if _unexplained(blocks, noisy) and (orders := cogging_orders(noisy, found)):
            blocks = blocks_of(math.exp(found.x[0]), orders)
            found, chi2, noisy = _fit(blocks, _without_shapes(found, len(runs)), elastic)
        if (slower := noisier(noisy, found.residual, slow=True)) is not noisy:
            found, noisy = _minimum(slower, found.x, sizes_of(slower, drag=True)), slower
        return blocks, found, chi2, noisy

    blocks, with_drag, chi2, noisy = _explained(fitted, runs)
    # where the other parameters would lead without the drag: left as they are, they may be too far off for a fit
    others, of_it = np.delete(with_drag.jacobian, SHAFT, axis=1), with_drag.jacobian[:, SHAFT] * with_drag.x[SHAFT]
    start = np.delete(with_drag.x, SHAFT) + np.linalg.lstsq(others, of_it, rcond=None)[0]
    without = _minimum(noisy, start, sizes_of(blocks))
    if without.cost < with_drag.cost:  # a drag of zero is better: its fit stopped short, or had less noise
        with_drag = _minimum(noisy, np.insert(without.x, SHAFT, 0.0), sizes_of(blocks, drag=True))
    covariance, condition = scaled_covariance(without.jacobian)
    condition_gate(condition, "B and tau_c", STAGE, SEPARABLE)
    _, widen = chi2_gate(chi2, STAGE)
    x, more = _held_at_zero(without.x[:SHAFT], covariance[:SHAFT, :SHAFT], (1, 2))
    of_drag = scaled_covariance(with_drag.jacobian)[0][: SHAFT + 1, : SHAFT + 1]
    x_drag, more_drag = _held_at_zero(with_drag.x[: SHAFT + 1], of_drag, (SHAFT, 1, 2))  # B often takes what it was
    criteria = without.cost + more, with_drag.cost + more_drag + DRAG_PENALTY
    share = float(information_weights(criteria)[1]) * (x_drag[SHAFT] > 0.0)
    if elastic:  # so much noise may hide a drag: what it may be is then in the intervals of B and tau_c
        share = max(share, 0.5)
    # friction that falls with the speed is no viscous one: a drag beside it fits the dip of Stribeck's curve, and is
    # 76 N m at the rated speed of a shaft with 1 N m of friction. Half of what it moves the others by is a deviation
    falls = more_drag > (COVERAGE_FACTOR * widen) ** 2
    apart, moved = x_drag[:SHAFT] - x, 0.5 * falls * (with_drag.x[:SHAFT] - x_drag[:SHAFT])
    ln_J, B, tau_c = (x + share * apart).tolist()
    own = (1.0 - share) * np.diag(covariance)[:SHAFT] + share * np.diag(of_drag)[:SHAFT]
    # a coasting through few speeds does not tell a drag from viscous friction: B may then be none
    of_none, more_none = _held_at_zero(with_drag.x[: SHAFT + 1], of_drag, (1, SHAFT, 2), without=1)
    none = float(information_weights((min(criteria), with_drag.cost + more_none))[1])
    instead = none * (of_none[:SHAFT] - (x + share * apart)) ** 2
    deviations = (widen * np.sqrt(own + share * (1.0 - share) * apart**2 + moved**2 + instead)).tolist()
    J, stds = math.exp(ln_J), (math.exp(ln_J) * deviations[0], deviations[1], deviations[2])
    require_useful(noisy, stds[1], stds[2])
    drag, scale_std = None, math.hypot(scale_std, SCALE_FLOOR)
    if share > 0.5:
        size, of_dip = float(x_drag[SHAFT]), 0.5 * falls * float(with_drag.x[SHAFT] - x_drag[SHAFT])
        std = math.hypot(widen * math.sqrt(of_drag[SHAFT, SHAFT]), of_dip, scale_std * size)
        drag = Estimate(size, std, tolerance.inertia * size, "N m s2", method=METHOD)
    n = sum(len(block.theta) for block in blocks)
    J_found, B_found, tau_found = (
        Estimate(value, math.hypot(std, scale_std * value), tolerance.inertia * abs(value), unit, n=n, chi2=chi2,
                 method=METHOD, fallback="" if value else f"held at zero: the fit alone has {alone:.2g} {unit}")
        for value, std, unit, alone in zip((J, B, tau_c), stds, MEANS.values(), without.x, strict=False)
    )  # fmt: skip
    ripple, unexplained = max(torque_noise(noisy).values()), _unexplained(blocks, noisy)
    orders = blocks[0].disturbances.orders
    harmonics = _with_encoder(harmonics, prior, without.x[: -2 * len(runs)], widen * np.sqrt(np.diag(covariance)))
    return MechanicsResult(J_found, B_found, tau_found, stds, ripple, chi2, unexplained, harmonics, drag, orders)


def _with_encoder(harmonics: AngleHarmonics, prior: Sequence[Harmonic], x: Array, std: Array) -> AngleHarmonics:
    """Return harmonics with what all traces show of the encoder's error where the turns of a coasting are too few.

    ``x`` ends with the sizes of the error's waves about the ``prior``. Friction over the angle is fitted beside it.
    """
    found = list(harmonics.encoder_rad)
    shown, stds = (of[SHAFT : len(x)][-2 * len(prior) :].reshape(-1, 2).tolist() for of in (x, std))
    for h, (cosine, sine), pair in zip(prior, shown, stds, strict=False):  # a fit without shapes has none
        seen = Harmonic(h.order, h.cosine + h.std * cosine, h.sine + h.std * sine, h.std * max(pair))
        if h.order * harmonics.turns < DEGREE and seen.amplitude > SURE * seen.std:
            found.append(seen)
    return replace(harmonics, encoder_rad=tuple(found))


def mean_mechanics(
    runs: Sequence[Trace], torque: Torque, scale_std: float, direction: int, tolerance: SensorTolerance | None = None
) -> dict[str, Estimate]:
    """Return inertia and friction by their keys, from a regression of mean torques on mean motions.

    Of pushes and halves of coasting: what swings or strikes within is in no mean. As :func:`estimate_mechanics`; no
    friction that may be more than what turned the shaft.
    """
    runs = [_fast(_window(run)) for run in runs]
    step = encoder_step([run["theta_M_rad"] for run in runs])
    blocks = [_blocks(run, torque, 0.0, direction, 1, step, NO_HARMONICS, 0.0)[1] for run in runs]
    rows = sum(1 + run.coasting for run in blocks)
    # whether friction grows with the speed or with its square: means of a short coasting do not tell
    fits = [_mean_motion(blocks, power=1.0, drag=drag) for drag in (False, True)]
    (values, covariance, *_, misfit), (with_drag, of_drag, *_, beside) = fits
    if not values[0] > 0.0:
        return {}
    dof = rows - len(values)
    share = float(information_weights([dof * math.log(max(left, sys.float_info.min)) for left in (misfit, beside)])[1])
    values, _ = _held_at_zero(values, covariance, (1, 2))
    apart = _held_at_zero(with_drag, of_drag, (1, 2))[0] * (1.0, 0.0, 1.0) - values
    variance = (1.0 - share) * np.diag(covariance) + share * np.diag(of_drag) * (1.0, 0.0, 1.0)
    stds = coverage_factor(dof) / COVERAGE_FACTOR * np.sqrt(variance)
    unknown = COVERAGE_FACTOR * max(stds[1] * fastest(blocks), stds[2]) > largest_torque(blocks)
    values, stds = values + share * apart, np.hypot(stds, math.sqrt(share * (1.0 - share)) * apart)
    scale, systematic = math.hypot(MEAN_STD, scale_std), (tolerance or SensorTolerance()).inertia
    known = values.tolist()[: 1 if unknown else None]
    return {
        key: Estimate(v, math.hypot(std, scale * v), systematic * abs(v), unit, n=len(runs), method=MEAN_METHOD)
        for v, std, (key, unit) in zip(known, stds.tolist(), MEANS.items(), strict=False)
    }


def _held_at_zero(
    x: Array, covariance: NDArray[np.float64], friction: Sequence[int], without: int = 0
) -> tuple[Array, float]:
    """Return least squares with friction at zero that came out below it, where it would drive, and their added cost.

    ``without`` is the index of one that is held there whatever it came out, 0 for none.
    """
    cost = 0.0
    for k in friction:
        if x[k] < 0.0 or k == without > 0:
            column = covariance[:, k] / covariance[k, k]
            cost += float(x[k]) ** 2 / float(covariance[k, k])
            x, covariance = x - column * x[k], covariance - np.outer(column, covariance[k])
    return np.append(x[:1], np.maximum(x[1:], 0.0)), cost


def require_useful(runs: Sequence[Run], B_std: float, tau_std: float) -> None:
    """Refuse friction that may be more than what turned the shaft: a fit that ran away, and J with it."""
    if (doubt := COVERAGE_FACTOR * max(B_std * fastest(runs), tau_std)) > (largest := largest_torque(runs)):
        raise refuse("E_NOT_IDENTIFIABLE", f"friction is known to +-{doubt:.2g} N m, the pulses made {largest:.2g} N m",
                     stage=STAGE, likely=NOISY_TORQUE)  # fmt: skip


Fitted = tuple[Sequence[Run], Fit, float, Sequence[Run]]
"""Blocks, fit with drag, its reduced chi-square, and the blocks with the torque's noise that it took."""


def _explained(fitted: Callable[[Sequence[Trace]], Fitted], runs: Sequence[Trace]) -> Fitted:
    """Return the fit to the traces, or to what of them is fast where that needs less noise of the torque.

    Near standstill cogging that is too fine to be seen holds the rotor, or lets it go late.
    """
    try:
        whole = fitted(runs)
    except IdentificationError as refused:
        try:
            return fitted([_fast(run) for run in runs])
        except IdentificationError:
            raise refused from None
    if not _unexplained(whole[0], whole[3]):
        return whole
    try:
        fast = fitted([_fast(run) for run in runs])
    except IdentificationError:
        return whole
    return fast if max(torque_noise(fast[3]).values()) < max(torque_noise(whole[3]).values()) else whole


def _unexplained(blocks: Sequence[Run], noisy: Sequence[Run]) -> bool:
    """Whether the torque's noise grew so much in a fit that the intervals are notably wider."""
    before, noise = torque_noise(blocks), torque_noise(noisy)
    return any(noise[kind] > UNEXPLAINED * max(before[kind], COASTING_FLOOR) for kind in noise)


def _fast(run: Trace) -> Trace:
    """Return the longest part of a trace above a share of its fastest speed."""
    theta = run["theta_M_rad"]
    count = max(2, len(theta) // 40)
    speed = np.abs(theta[count:] - theta[:-count])
    fast = np.concatenate([[False], speed >= LEAST_SPEED * np.max(speed), [False]])
    starts, ends = np.flatnonzero(np.diff(fast)).reshape(-1, 2).T
    longest = int(np.argmax(ends - starts))
    return run.rows(slice(int(starts[longest]), int(ends[longest]) + count))


def _window(run: Trace) -> Trace:
    """Return a trace from where the shaft moves and the step of the current is over; a coasting up to where it rests.

    At rest, the first speed leaves no slope for a fit to go down; and a step may meet the voltage limit. Near the end
    friction is neither Coulomb's nor viscous: with it B of a shaft was 4.7 % off at +-3.3 %, of one tau_c 17 at +-9.
    """
    theta = run["theta_M_rad"]
    least, last = REST_SHARE * np.ptp(theta), len(theta)
    first = int(np.argmax(np.abs(theta - theta[0]) > least))
    if run.meta["coasting"]:
        last += 1 - int(np.argmax(np.abs(theta - theta[-1])[::-1] > least))
    else:
        limited = np.nonzero(run["flagged"][: round(STEP_SHARE * len(run))] > 0.0)[0]
        first = max(first, int(limited[-1]) + 1 if len(limited) else 0)
    return run.rows(slice(first, last))


def _blocks(run: Trace, torque: Torque, sigma_nm: float, direction: int, pole_pairs: int, step: float,
            harmonics: AngleHarmonics, J_kgm2: float) -> tuple[Array, Run]:  # fmt: skip
    """Return a trace's positions, and it in blocks, without the encoder's error.

    A coasting within the record of a push begins with what is left of its current. Cogging is a torque of the pushes,
    and out of the way of a coasting: it goes through periods within a block of one, where only the position shows it.
    """
    rows = max(1, (len(run) - 1) // BLOCKS)
    count = (len(run) - 1) // rows
    shown = direction * run["theta_M_rad"]
    theta_std = np.maximum(position_std(shown[: count * rows + 1 : rows], step), position_noise(shown))
    coasting, powered = bool(run.meta["coasting"]), bool(run.meta.get(POWERED))
    tau = np.zeros(len(run))
    if powered or not coasting:
        behind = pole_pairs * (shown - harmonics.shaft(shown))  # the frame goes with the encoder
        i = (run["i_d_a"] + 1j * run["i_q_a"]) * np.exp(1j * behind)
        tau = torque(i.real, i.imag)
    if not coasting:
        tau = tau + harmonics.torque_nm(shown, J_kgm2)
    mean = (0.5 * (tau[:-1] + tau[1:]))[: count * rows].reshape(count, rows).mean(axis=1)
    if coasting:
        theta = harmonics.shaft(harmonics.without_ripple(run.t_s, shown))[: count * rows + 1]
        noise = sigma_nm / math.sqrt(rows) if powered else 0.0
        return theta, Run(theta[::rows], mean, rows * run.period_s, theta_std, noise, True)
    theta = harmonics.shaft(shown)[: count * rows + 1]
    noise = math.hypot(sigma_nm / math.sqrt(rows), TORQUE_FLOOR * float(np.max(np.abs(mean))))
    return theta, Run(theta[::rows], mean, rows * run.period_s, theta_std, noise, False)


def _start(runs: Sequence[Run]) -> Array:
    """Return ln J, B, tau_c and each trace's first position and speed, from a regression of torque on motion."""
    x, _, states, _ = _mean_motion(runs)
    if not x[0] > 0.0:
        raise refuse("E_NOT_IDENTIFIABLE", f"J = {x[0]:.3g} kg m2", stage=STAGE, likely="the shaft is held or driven")
    return np.array([math.log(x[0]), x[1], max(x[2], 0.0), *states])


def _mean_motion(
    runs: Sequence[Run], power: float = 0.0, drag: bool = False
) -> tuple[Array, NDArray[np.float64], list[float], float]:
    """Return J, B (or a drag), tau_c of mean torques and motions, their covariance, first states and squared misfit.

    With a ``power`` of 1 errors are a share of the acceleration (pushes tell J, coasting friction), and a push is
    whole: half of one was a single swing of the shaft, which made J 34 % too large.
    """
    from scipy.integrate import cumulative_trapezoid

    rows, torques, states = [], [], []
    for run in runs:
        way = np.abs(np.diff(run.theta))
        moving = max(MOVING_LEAST, int(np.nonzero(way > LEAST_SPEED * np.max(way))[0][-1]) + 1)  # a rest tells nothing
        t = run.T * np.arange(moving)
        # what makes a parabola's curvature of the position makes it of the speed's and the torque's integrals, too
        gain = run.T * np.append(0.0, np.cumsum(run.torque))
        once, twice = cumulative_trapezoid([run.theta, gain], dx=run.T, initial=0.0)
        ways = np.stack([run.theta, once, twice], axis=1)
        for part in np.array_split(np.arange(moving), 1 if power and not run.coasting else 2):
            a, omega, mean = 2.0 * np.polyfit(t[part], ways[part], 2)[0]
            rows.append([a, omega * abs(omega) if drag else omega, math.copysign(1.0, omega)])
            torques.append(float(mean))
        first = np.polyfit(t[: len(t) // 4], run.theta[: len(t) // 4], 2)
        states += [run.theta[0], float(first[1])]
    change = np.abs(np.array(rows)[:, 0])
    weight = (change + 1e-3 * np.max(change)) ** -power
    x, covariance, residual, _ = linear_solve(np.array(rows), np.array(torques), weight)
    misfit = float(residual @ residual)
    return x, covariance * misfit / (len(rows) - len(x)), states, misfit


def _fit(runs: Sequence[Run], start: Array, elastic: bool) -> tuple[Fit, float, Sequence[Run]]:
    """Return the fit with drag, its reduced chi-square, and the runs with the torque's noise that it took."""
    largest = largest_torque(runs)
    scale = sizes_of(runs, drag=True)
    x = np.insert(start, SHAFT, 0.0)
    for count, share in enumerate(COARSE_RIPPLES):
        coarse = [replace(run, torque_std=max(run.torque_std, share * largest)) for run in runs]
        if not count:  # a rough start knows nothing of the disturbances
            bare = [replace(run, disturbances=NONE) for run in coarse]
            x = _minimum(bare, x, sizes_of(bare, drag=True), COARSE_TOLERANCE).x
            x = np.insert(x, SHAFT + 1, np.zeros(len(scale) - len(x)))
        x = _minimum(coarse, x, scale, COARSE_TOLERANCE).x
    for count in range(FITS_MOST):
        fit = _minimum(runs, x, scale)
        x = fit.x
        chi2 = fit.cost / fit.dof
        ripple = max(torque_noise(runs).values())
        more = noisier(runs, fit.residual)
        if ripple > RIPPLE_MOST and not elastic:
            what = (f"torque off by {100.0 * ripple:.2g} % of that of the pulses, and more, from one "
                    f"{1e3 * runs[0].T:.2g} ms to the next, limit {100.0 * RIPPLE_MOST:g} %")  # fmt: skip
            hint = "`identify R L psi encoder poles inverter frf` finds the resonance of an elastic shaft, and J"
            raise refuse("E_MODEL_MISMATCH", what, stage=STAGE, likely=NOISY_TORQUE, hint=hint)
        if fit.converged or count >= PATIENT_FITS:
            if fit.converged and count and more is runs:
                break
            runs = more  # before a minimum the residual says little of the noise
    if not fit.converged:
        raise refuse("E_NOT_CONVERGED", f"{fit.iterations} steps without a minimum", stage=STAGE)
    return fit, chi2, runs


def _without_shapes(fit: Fit, traces: int) -> Array:
    """Return the parameters of a fit without those of the drag and the disturbances."""
    return np.delete(fit.x, range(SHAFT, len(fit.x) - 2 * traces))


def _minimum(runs: Sequence[Run], x: Array, scale: Array, tolerance: float = COST_TOLERANCE) -> Fit:
    factors = [whitener(run, math.exp(float(x[0]))) for run in runs]
    sizes = runs[0].disturbances.torque.shape[1]
    problem = Problem(runs, factors, RELATIVE_STEP * scale, drag=len(x) == SHAFT + 1 + sizes + 2 * len(runs))
    return levenberg_marquardt(problem.residual, x, scale, cost_tolerance=tolerance, derivative=problem.jacobian)
