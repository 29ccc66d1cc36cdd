# SPDX-License-Identifier: MIT
"""Mechanical frequency response, and a second mass where the data support one.

The response is acceleration per torque: the second difference of the position over the torque of the measured currents,
both sampled at the same instants. Of a rigid shaft it is 1/J at every frequency; of two masses behind a spring

    G(s) = 1/J_M (s^2 + 2 zeta_a w_a s + w_a^2)/(s^2 + 2 zeta_r w_r s + w_r^2), w_r^2/w_a^2 = 1 + J_L/J_M.

Lines, their noise and coherence come from the local polynomial method, which takes the transient of a record apart from
the response (Pintelon and Schoukens, System Identification, 2nd ed. 2012, chapter 7, DOI 10.1002/9781118287422). Both
models are fitted to the transforms of the records with those weights; the Bayesian information criterion (Schwarz 1978,
DOI 10.1214/aos/1176344136) decides: a second mass must explain more than a rigid shaft, and more than one that rings
at the same frequency by itself. Where neither is the shaft, a rigid one with a torque ripple over its angle is tried.
The coherence of a line says nothing there: a peak narrower than seven lines is no polynomial, and what is left of it is
no noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array, Complex
from pmsmtool.estimators.estimate import (
    CHI2_REFUSE,
    COVERAGE_FACTOR,
    SensorTolerance,
    information_bound,
    scaled_covariance,
)
from pmsmtool.estimators.least_squares import Fit, levenberg_marquardt
from pmsmtool.estimators.shaft.response_lines import (
    HALF_WIDTH,
    SHARE_LEAST,
    STAGE,
    counted,
    local_polynomials,
    smooth_power,
    transforms,
    without_noise,
)
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.two_masses import CERTAIN_ZETA
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

RECORDS_LEAST = 3
"""Records below which a line's noise is not known."""
STOPPED_S = 0.02
"""Time over which a speed is looked at for a change of its sign: friction is no constant there (J 3.9 % too large)."""
COHERENT = 0.5
"""Coherence from which a line belongs to the band that the data support."""
COHERENT_LEAST = 8
"""Coherent lines below which no response is given: a heavy load shows at its resonance only (29 of a load of 11 J)."""
INFORMATION_GAIN = 10.0
"""Smallest difference of the information criterion: very strong evidence (Kass and Raftery 1995)."""
RESONANCE_STD, ANTIRESONANCE_STD = 0.03, 0.1
"""Largest relative standard deviations of a resonance and an antiresonance that are claimed: those of a heavy load have
few lines (130 +- 5.5 of 137 Hz), and a controller that knows neither shakes it."""
APART, APART_STDS = 0.02, 4.0
"""Least distance of resonance and antiresonance: closer, a second mass would be a twenty-fifth of the first; and in
their standard deviations (12.8 and 12.4 Hz of a rigid shaft with cogging were 2.5 apart, and claimed)."""
RIPPLE_ORDERS, RIPPLE_MOST = 128, 4
"""Largest order of the shaft's angle at which a torque ripple is looked for (cogging: LCM of slots and poles), and most
orders taken."""
START_STEP = 0.02
"""Relative step of the resonances tried as a start."""
START_ZETAS = (0.003, 0.01, 0.05, 0.2)
LN_LARGEST = 20.0
"""Largest logarithm of a frequency (rad/s) or damping that a fit may try."""
SHOWN_RATIO, SHOWN_ZETA, SHOWN_TRIED = 0.2, 0.01, 60
"""Load over motor and damping of the resonance whose largest visible frequency is told where none is found; tries."""
ZETA_FLOOR = 0.01
"""Relative deviation of the damping beyond the fit's: rows do not show the current between them (0.014 once)."""
INERTIA_FLOOR = 1e-3
"""Relative deviation of the inertia beyond the fit's and the torque's (tests/measurement/test_frequency_response)."""
INERTIA_FALLBACK = "from the frequency response alone: friction is not known, and a load behind a play is not seen"
ACROSS_DOUBT = 0.5
"""Part of what as much noise in i_q as i_d has would take off the response that is a deviation of the inertia: motors
of a stranger's plant were 5.8, 1.0, 21 and 10 % off where it takes 8.2, 0.9, 69 and 61 %."""
METHOD = "random torque at speed, maximum likelihood in the frequency domain"


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyResponse:
    """Acceleration per torque over frequency, and what it says of the shaft."""

    frequency_hz: Array
    """Lines (Hz). Shape (n,)."""
    response: Complex
    """Acceleration per torque (rad/s2/(N m)). Shape (n,)."""
    std: Array
    """Standard deviation of its magnitude. Shape (n,)."""
    coherence: Array
    """Share of the answer's power that the torque explains. Shape (n,)."""
    highest_hz: float
    """End of the band that the data support (Hz)."""
    chi2_rigid: float
    chi2_two_mass: float
    """Reduced chi-square of either model; NaN where there was no start for a second mass."""
    information_gain: float
    """How much the information criterion prefers two masses."""
    found: dict[str, Estimate] = field(default_factory=dict)
    """``resonance_hz``, ``antiresonance_hz``, ``resonance_zeta`` where a second mass is supported, else nothing."""
    reason: str = ""
    """Why a second mass is claimed, or is not."""
    inertia: Estimate | None = None
    """All that turns, of the model that explains the response: 1/J of a rigid shaft, the low-frequency end
    J_M w_r^2/w_a^2 of two masses (kg m2); None where neither explains it. Its interval holds both where two masses
    explain more and are not claimed."""
    shown_hz: float = 0.0
    """Up to where a small second mass would have shown, where none is found (Hz); 0: nowhere."""
    suspected_hz: tuple[float, ...] = ()
    """Resonance and antiresonance (Hz) of a second mass that is shown, but not claimed; else empty."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the table that is kept as a file."""
        return {
            "frequency_hz": self.frequency_hz,
            "acceleration_per_torque": np.abs(self.response),
            "phase_rad": np.angle(self.response),
            "acceleration_per_torque_std": self.std,
            "coherence": self.coherence,
        }


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Transforms of torque and acceleration, shape (records, lines), noise of a line, and its frequency."""

    omega: Array
    back: Complex
    """One row's delay, exp(-j omega T)."""
    T: float
    U: Complex
    Y: Complex
    sigma: Array


def estimate_frequency_response(
    runs: Sequence[Trace],
    torque: Callable[[Array, Array], Array],
    *,
    direction: int = 1,
    scale_std: float = 0.0,
    noise_nm: float = 0.0,
    over_angle: Callable[[Array], Array] = np.zeros_like,
    angle_std: float = 0.0,
    tolerance: SensorTolerance | None = None,
) -> FrequencyResponse:
    """Estimate the response, the inertia, and the resonance where there is one.

    Raises IdentificationError: ``E_EXCITATION``, ``E_CLIPPED``, ``E_COHERENCE``.

    Parameters
    ----------
    runs : sequence of Trace
        ``i_d_a i_q_a theta_M_rad flagged`` of records of the same length, in the frame of the d axis.
    torque : callable
        Torque (N m) of arrays of i_d, i_q (A).
    direction : int
        Sign of the encoder's count along the phase order.
    scale_std : float
        Relative standard deviation of the torque's scale, which goes into the inertia one to one.
    noise_nm : float
        Standard deviation of the torque's samples by the noise of the measured currents (N m).
    over_angle, angle_std : callable, float
        Cogging (N m) of an array of angles along the phase order: it moves the shaft, too; its relative deviation.
    tolerance : SensorTolerance
        Declared sensor tolerances.
    """
    lengths = {len(run) for run in runs}
    given, runs = len(runs), [run for run in runs if not _stopped(run)]
    if len(runs) < RECORDS_LEAST <= given:
        raise refuse("E_EXCITATION", f"the shaft stopped in {given - len(runs)} of {given} records", stage=STAGE)
    if len(runs) < RECORDS_LEAST or len(lengths) != 1:
        raise refuse("E_EXCITATION", f"{len(runs)} records, {RECORDS_LEAST} of one length needed", stage=STAGE)
    flagged = sum(int(np.sum(run["flagged"] > 0.0)) for run in runs)
    if flagged:
        raise refuse("E_CLIPPED", f"{flagged} samples of the run are limited or clipped", stage=STAGE)
    omega, of_currents, Y, T = transforms(runs, [torque(run["i_d_a"], run["i_q_a"]) for run in runs], direction)
    per_a = torque(np.zeros(1), np.ones(1))
    _, across, *_ = transforms(runs, [per_a * run["i_d_a"] for run in runs], direction)
    white = (len(runs[0]) - 2) * noise_nm**2
    noise = np.maximum(0.0, smooth_power(across) - white) / smooth_power(of_currents)
    _, cogging, *_ = transforms(runs, [over_angle(direction * run["theta_M_rad"]) for run in runs], direction)
    U = without_noise(of_currents + cogging, white)
    omega, Y = omega[: U.shape[1]], Y[:, : U.shape[1]]
    unsure = angle_std * np.sqrt(np.mean(np.abs(cogging[:, : U.shape[1]]) ** 2, axis=0))
    scale = (scale_std, tolerance or SensorTolerance())
    result, lines, rigid = _judged(omega, U, Y, T, unsure, scale)
    if result.information_gain > INFORMATION_GAIN and np.any(blind := counted(runs, omega)):
        beside, _, _ = _judged(omega, U, Y, T, np.where(blind, math.inf, unsure), scale)
        if beside.information_gain <= INFORMATION_GAIN:
            return _doubted(beside, noise)
    if result.information_gain > INFORMATION_GAIN and not result.found:
        ripple = _ripple(lines, rigid, runs, direction, U.shape[1])
        if ripple is not None:
            steady, _, _ = _judged(omega, U + ripple, Y, T, unsure, scale)
            result = steady if steady.information_gain <= INFORMATION_GAIN else result
    return _doubted(result, noise)


def _doubted(result: FrequencyResponse, noise: Array) -> FrequencyResponse:
    """Return a response whose inertia has in its interval what noise of the torque may take off it.

    ``noise`` is its share of each line. The steps are in i_q alone: what i_d has beside the noise of a sample at rest,
    i_q may have as well, of currents that turn with the rotor or that flow between the rows. It is in no torque.
    """
    if result.inertia is None:
        return result
    weight = np.where(result.coherence >= COHERENT, (np.abs(result.response) / result.std) ** 2, 0.0)
    taken = -np.log(np.maximum(SHARE_LEAST, 1.0 - noise[HALF_WIDTH:][: len(weight)]))
    doubt = ACROSS_DOUBT * float(np.average(taken, weights=weight)) * result.inertia.value
    return replace(result, inertia=replace(result.inertia, std=math.hypot(result.inertia.std, doubt)))


def _judged(
    omega: Array, U: Complex, Y: Complex, T: float, unsure: Array, scale: tuple[float, SensorTolerance]
) -> tuple[FrequencyResponse, _Lines, Fit]:
    """Return what transforms of torque and acceleration say, their inner lines, and the fit of one mass."""
    lines, G, std, coherence, rigid = _rigid_shaft(omega, U, Y, T, unsure)
    frequency = lines.omega / (2.0 * math.pi)
    highest = float(frequency[coherence >= COHERENT][-1])
    chi2_rigid = rigid.cost / rigid.dof
    facts = (frequency, G, std, coherence, highest, chi2_rigid)
    one = _inertia(rigid, chi2_rigid, (-1.0, 0.0), *scale)
    shown, to_hz = _shown(lines, rigid)
    start = _start(lines.omega, G, std)
    if start is None:
        reason = f"rigid up to {highest:.3g} Hz: no pair of poles fits; {shown}"
        return FrequencyResponse(*facts, math.nan, 0.0, reason=reason, inertia=one, shown_hz=to_hz), lines, rigid
    two = _fit(lines, _two_mass, start)
    # the same transients, rung by something else than the torque
    ringing = _fit(lines, lambda at, x: (_rigid(at, x)[0], _two_mass(at, two.x)[1]), rigid.x)
    penalty = math.log(len(rigid.residual))
    transients = 2 * len(U) * penalty
    without, cost = min(rigid.cost, ringing.cost + transients), two.cost + transients
    if _decays(two, lines):
        unrung = _fit(lines, lambda at, x: (_two_mass(at, x)[0], _rigid(at, x)[1]), two.x)
        if unrung.cost < cost and _decays(unrung, lines):
            two, cost = unrung, unrung.cost
    chi2 = two.cost / two.dof
    gain = (without - cost) / max(1.0, chi2) - (len(start) - len(rigid.x)) * penalty
    estimates = _estimates(two, chi2)
    against = _against(two, chi2, gain, estimates, frequency)
    both = _inertia(two, chi2, (-1.0, 0.0, 2.0, 0.0, -2.0, 0.0), *scale)
    if against:
        if one is not None and both is not None and gain > INFORMATION_GAIN:  # not claimed, but no rigid shaft either
            one = replace(both, std=math.hypot(both.std, abs(both.value - one.value) / COVERAGE_FACTOR))
        reason = f"no resonance found up to {highest:.3g} Hz: {against}; {shown}"
        f_r, f_a = estimates["resonance_hz"].value, estimates["antiresonance_hz"].value
        pair = (f_r, f_a) if gain > INFORMATION_GAIN and two.converged and frequency[0] < f_a < f_r else ()
        none = FrequencyResponse(*facts, chi2, gain, reason=reason, inertia=one, shown_hz=to_hz, suspected_hz=pair)
        return none, lines, rigid
    resonance, antiresonance = estimates["resonance_hz"].value, estimates["antiresonance_hz"].value
    reason = f"two masses, J_load/J_motor {(resonance / antiresonance) ** 2 - 1.0:.3g}, measured up to {highest:.3g} Hz"
    return FrequencyResponse(*facts, chi2, gain, estimates, reason, both), lines, rigid


def _decays(fit: Fit, lines: _Lines) -> bool:
    """Whether poles, damped as those of a coupling, ring so shortly that their peak is wider than the polynomials."""
    w_r, zeta_r = np.exp(fit.x[2:4])
    return bool(zeta_r <= CERTAIN_ZETA and 2.0 * zeta_r * w_r >= 2 * HALF_WIDTH * (lines.omega[1] - lines.omega[0]))


def _rigid_shaft(
    omega: Array, U: Complex, Y: Complex, T: float, unsure: Array
) -> tuple[_Lines, Complex, Array, Array, Fit]:
    """Return inner lines, response, its deviation and coherence, and the fit of one mass; ``unsure``: of the torque."""
    G, sigma, std, coherence = local_polynomials(U, Y)
    inner = slice(HALF_WIDTH, len(omega) - HALF_WIDTH)
    sigma = np.hypot(sigma, unsure[inner] * np.abs(G))  # what all records share is not in their noise
    std, coherence = (np.where(np.isinf(sigma), worst, x) for x, worst in ((std, math.inf), (coherence, 0.0)))
    lines = _Lines(omega[inner], np.exp(-1j * omega[inner] * T), T, U[:, inner], Y[:, inner], sigma)
    coherent = coherence >= COHERENT
    if (count := int(np.sum(coherent))) < COHERENT_LEAST:
        raise refuse(
            "E_COHERENCE",
            f"{count} of {len(lines.omega)} lines have a coherence of {COHERENT:g}, {COHERENT_LEAST} are needed",
            stage=STAGE,
        )
    start = np.array([math.log(float(np.median(np.abs(G[coherent])))), 0.0])
    return lines, G, std, coherence, _fit(lines, _rigid, start)


def _ripple(lines: _Lines, rigid: Fit, runs: Sequence[Trace], direction: int, count: int) -> Complex | None:
    """Return the transforms of a torque over the angle of the shaft that one mass leaves unexplained; None without.

    Orders are taken one by one, while each gains what the information criterion asks of a second mass.
    """
    G, basis = _rigid(lines, rigid.x)
    Q, _ = np.linalg.qr(_stacked(basis.T, lines.sigma).T)

    def whitened(values: Complex) -> Array:
        rest = _stacked(values, lines.sigma)
        return np.asarray((rest - (rest @ Q) @ Q.T).ravel())

    waves, pairs = [], []
    for order in range(1, RIPPLE_ORDERS + 1):
        torques = [[wave(order * (direction * run["theta_M_rad"])) for run in runs] for wave in (np.cos, np.sin)]
        waves.append([transforms(runs, both, direction)[1][:, :count] for both in torques])
        pairs.append(np.stack([whitened(G * wave[:, HALF_WIDTH : count - HALF_WIDTH]) for wave in waves[-1]], axis=1))
    asked = max(1.0, rigid.cost / rigid.dof) * (2.0 * math.log(len(rigid.residual)) + INFORMATION_GAIN)
    target, taken = whitened(lines.Y - G * lines.U), np.zeros((len(rigid.residual), 0))
    ripple: Complex | None = None
    for _ in range(RIPPLE_MOST):
        bases = [np.linalg.qr(pair - taken @ (taken.T @ pair))[0] for pair in pairs]
        gains = [float(np.sum((basis.T @ target) ** 2)) for basis in bases]
        best = int(np.argmax(gains))
        if gains[best] < asked:
            break
        (c, s), *_ = np.linalg.lstsq(pairs[best], target, rcond=None)
        ripple = (0.0 if ripple is None else ripple) + c * waves[best][0] + s * waves[best][1]
        target, taken = target - pairs[best] @ np.array([c, s]), np.concatenate([taken, bases[best]], axis=1)
    return ripple


def _stopped(run: Trace) -> bool:
    """Whether the shaft came to rest, or turned back, in a record."""
    theta, count = run["theta_M_rad"], max(1, round(STOPPED_S / run.period_s))
    turned = theta[count:] - theta[:-count]
    return len(turned) > 0 and float(np.min(turned) * np.max(turned)) <= 0.0


def _rigid(lines: _Lines, x: Array) -> tuple[Complex, Complex]:
    """Response and basis of the transient for ln 1/J and delay."""
    return np.exp(x[0] - 1j * lines.omega * x[1] * lines.T), np.stack([np.ones_like(lines.back), lines.back], axis=1)


def _two_mass(lines: _Lines, x: Array) -> tuple[Complex, Complex]:
    """The same for ln 1/J_M, delay, logarithms of w_r, zeta_r, w_a, and zeta_a, which noise may make negative."""
    w_r, zeta_r, w_a = np.exp(np.minimum(x[2:5], LN_LARGEST))
    zeta_a = x[5]
    s = 1j * lines.omega
    G = (s**2 + 2.0 * zeta_a * w_a * s + w_a**2) / (s**2 + 2.0 * zeta_r * w_r * s + w_r**2)
    rigid, basis = _rigid(lines, x)
    # the poles as rows see them
    decay = math.exp(-zeta_r * w_r * lines.T)
    turn = w_r * lines.T * math.sqrt(max(0.0, 1.0 - zeta_r**2))
    poles = 1.0 - 2.0 * decay * math.cos(turn) * lines.back + decay**2 * lines.back**2
    return rigid * G, np.concatenate([basis, basis / poles[:, None]], axis=1)


def _stacked(values: Complex, sigma: Array) -> Array:
    """Real and imaginary part in standard deviations, on the last axis but one of a matrix or the last of a row."""
    whitened = math.sqrt(2.0) * values / sigma
    return np.concatenate([whitened.real, whitened.imag], axis=-1)


def _fit(lines: _Lines, model: Callable[[_Lines, Array], tuple[Complex, Complex]], start: Array) -> Fit:
    """Fit a model to all records; the transients are linear and taken out of every residual."""

    def residual(x: Array) -> Array:
        G, basis = model(lines, x)
        Q, _ = np.linalg.qr(_stacked(basis.T, lines.sigma).T)
        rest = _stacked(lines.Y - G * lines.U, lines.sigma)
        return np.asarray((rest - (rest @ Q) @ Q.T).ravel())

    return levenberg_marquardt(residual, start, np.ones(len(start)), cost_tolerance=1e-3)


def _start(omega: Array, G: Complex, std: Array) -> Array | None:
    """Return the start of a second mass: with the poles given, the numerator is linear; None where none fits."""
    s = 1j * omega
    best, found = math.inf, None
    for w_r in np.exp(np.arange(math.log(1.5 * omega[0]), math.log(omega[-1]), START_STEP)):
        for zeta_r in START_ZETAS:
            A = s**2 + 2.0 * zeta_r * w_r * s + w_r**2
            rows = _stacked(np.stack([np.full_like(s, w_r**2), w_r * s, s**2]) / A, std).T
            target = _stacked(G, std)
            b, _, _, _ = np.linalg.lstsq(rows, target, rcond=None)
            cost = float(np.sum((rows @ b - target) ** 2))
            if cost < best and 0.0 < b[0] < b[2]:
                w_a = w_r * math.sqrt(b[0] / b[2])
                best = cost
                zeta_a = 0.5 * b[1] / math.sqrt(b[0] * b[2])
                found = np.array([math.log(b[2]), 0.0, *np.log([w_r, zeta_r, w_a]), zeta_a])
    return found


def _estimates(fit: Fit, chi2: float) -> dict[str, Estimate]:
    bound, _ = information_bound(fit.jacobian)
    widen = math.sqrt(max(1.0, chi2))
    values = np.exp(fit.x[2:5])
    rows = (
        ("resonance_hz", 0, 2.0 * math.pi, 0.0, "Hz"),
        ("antiresonance_hz", 2, 2.0 * math.pi, 0.0, "Hz"),
        ("resonance_zeta", 1, 1.0, ZETA_FLOOR, "1"),
    )
    found = {}
    for name, k, per, floor, unit in rows:
        value = float(values[k]) / per
        std = value * math.hypot(float(bound[2 + k]) * widen, floor)
        found[name] = Estimate(value, std, 0.0, unit, n=len(fit.residual), chi2=chi2, method=METHOD)
    return found


def _inertia(
    fit: Fit, chi2: float, log_weights: tuple[float, ...], scale_std: float, tolerance: SensorTolerance
) -> Estimate | None:
    """Return the inertia whose logarithm is that sum of a fit's parameters; None where the fit does not tell it."""
    if not fit.converged or chi2 > CHI2_REFUSE:
        return None
    used = np.flatnonzero(log_weights)
    weights = np.array(log_weights)[used]
    covariance = scaled_covariance(fit.jacobian)[0][np.ix_(used, used)]
    if not np.all(np.isfinite(covariance)):
        return None
    value = math.exp(float(weights @ fit.x[used]))
    own = math.sqrt(max(1.0, chi2) * float(weights @ covariance @ weights))
    return Estimate(
        value, value * math.hypot(own, scale_std, INERTIA_FLOOR), tolerance.inertia * value, "kg m2",
        n=len(fit.residual), chi2=chi2, method=METHOD, fallback=INERTIA_FALLBACK,
    )  # fmt: skip


def _shown(lines: _Lines, rigid: Fit) -> tuple[str, float]:
    """Return up to where (Hz) a second mass would have shown: its difference to a rigid shaft, in the lines' noise."""
    penalty = INFORMATION_GAIN + (4 + 2 * len(lines.U)) * math.log(len(rigid.residual))
    power = 2.0 * np.sum(np.abs(lines.U) ** 2, axis=0) / lines.sigma**2
    highest = 0.0
    for w_r in np.geomspace(lines.omega[0], lines.omega[-1], SHOWN_TRIED):
        w_a = w_r / math.sqrt(1.0 + SHOWN_RATIO)
        zeta_a = SHOWN_ZETA * w_a / w_r
        # all that turns is known; the motor's share of it is smaller
        x = np.array([rigid.x[0] + 2.0 * math.log(w_r / w_a), rigid.x[1], *np.log([w_r, SHOWN_ZETA, w_a]), zeta_a])
        change = np.abs(_two_mass(lines, x)[0] - _rigid(lines, rigid.x)[0])
        if float(np.sum(power * change**2)) > penalty:
            highest = float(w_r) / (2.0 * math.pi)
    load = f"a load of {SHOWN_RATIO:g} of the motor's inertia at {100.0 * SHOWN_ZETA:g} % damping"
    return f"{load} would " + (f"show up to {highest:.3g} Hz" if highest else "not show at any frequency"), highest


def _against(fit: Fit, chi2: float, gain: float, estimates: dict[str, Estimate], frequency: Array) -> str:
    """Return what speaks against a second mass, empty where nothing does."""
    resonance, antiresonance = estimates["resonance_hz"], estimates["antiresonance_hz"]
    zeta = estimates["resonance_zeta"]
    if not gain > INFORMATION_GAIN:
        return f"the shaft is rigid, the information criterion gains {gain:.3g} by a second mass"
    if not fit.converged:
        return "the fit of a second mass did not converge"
    if chi2 > CHI2_REFUSE:
        return f"two masses do not explain the response either, reduced chi-square {chi2:.3g}"
    if not frequency[0] < antiresonance.value < resonance.value < frequency[-1 - HALF_WIDTH]:
        return f"{antiresonance.value:.3g} and {resonance.value:.3g} Hz are not the pair of two masses inside the band"
    if resonance.value < (1.0 + APART) * antiresonance.value:
        return f"zeros and poles at {resonance.value:.3g} Hz are less than {100.0 * APART:g} % apart"
    if resonance.value - antiresonance.value < APART_STDS * math.hypot(resonance.std, antiresonance.std):
        return f"zeros and poles at {resonance.value:.3g} Hz are no {APART_STDS:g} standard deviations apart"
    if zeta.value - COVERAGE_FACTOR * zeta.std > CERTAIN_ZETA:
        return f"poles at {resonance.value:.3g} Hz damped by {zeta.value:.2g}, and no coupling by {CERTAIN_ZETA:g}"
    if resonance.std > RESONANCE_STD * resonance.value or antiresonance.std > ANTIRESONANCE_STD * antiresonance.value:
        return (
            f"poles at {resonance.value:.4g} Hz are known to {resonance.std:.2g} Hz and zeros at "
            f"{antiresonance.value:.4g} Hz to {antiresonance.std:.2g} Hz, limits {100.0 * RESONANCE_STD:g} and "
            f"{100.0 * ANTIRESONANCE_STD:g} %"
        )
    return ""
