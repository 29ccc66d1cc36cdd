# SPDX-License-Identifier: MIT
"""Inertia and friction of an identification, from the traces of its pushes."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial import Legendre

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.cross_check import cross_check
from pmsmtool.estimators.encoder import EncoderResult
from pmsmtool.estimators.estimate import COVERAGE_FACTOR, SensorTolerance, total_half_width
from pmsmtool.estimators.flux.linkage import FluxResult
from pmsmtool.estimators.injection.sampling_instant import Sampling, standstill_instant_s
from pmsmtool.estimators.inverter_error import Modulation
from pmsmtool.estimators.shaft.disturbances import TILT_FLOOR
from pmsmtool.estimators.shaft.mechanics import POWERED, MechanicsResult, Torque, estimate_mechanics, mean_mechanics
from pmsmtool.identification.iron_loss import best_L_q, iron_loss_of
from pmsmtool.identification.swing import NEAR, swing_of
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.torque import air_gap_torque, torque_per_ampere
from pmsmtool.machine.two_masses import SLOWEST_UNSEEN_HZ
from pmsmtool.trace import Trace

if TYPE_CHECKING:
    from pmsmtool.estimators.shaft.frequency_response import FrequencyResponse
    from pmsmtool.identification.evaluate import Evaluation


NOT_RIGID = ("E_MODEL_MISMATCH", "E_NOT_IDENTIFIABLE", "E_NOT_CONVERGED")
"""Reasons for which pushes are refused where a rigid shaft does not explain them."""
TRACE = "inertia_"
"""Followed by a number: push, coasting, push the other way, coasting."""
ELASTIC_FALLBACK = "torque pulses on a shaft that is not rigid; J agrees with the frequency response"
MEAN_FALLBACK = "mean acceleration of torque pulses on a shaft that is not rigid"
LINEAR_FALLBACK = "torque pulses on a shaft that is not rigid; they swing at the resonance of the frequency response"
PLAY_FALLBACK = "torque pulses on a shaft with play, of which a small torque turns a part"
PLAY_LEAST = 0.05
"""Share of the inertia that a small torque must leave unmoved before it counts as play."""
FINER = 2.0
"""Interval of the inertia by pulses, of the one by a small torque, from which on the latter stands."""
SATURATION_DOUBT = 0.25
"""Relative standard deviation of the torque without a flux map, of the curvature of psi_d over i_d: the flux that a q
current takes from the d axis is not seen. The saturated profile has a curvature of 3 % and its J was 0.77 % off."""
FAST_SHARE = 0.8
"""Speed of a push, of its largest, from which on the displacement there is looked at."""
SAMPLE_DOUBT = 0.2
"""Relative standard deviation of the displacement that a dead time gives the sample of a current; on nine random
drives with a switched inverter 0.02 to 0.5 % of J went down to at most 0.03 % with it."""
HARMONIC_DOUBT = 0.25
"""Relative standard deviation of the torque that harmonics of the back-EMF take."""
IRON_DOUBT = 0.1
"""The same of the reluctance torque that iron loss takes: R_fe, and L_q where a push saturates it, which is 9 % less on
a ferrite machine."""
HARMONIC_PARTS, HARMONIC_DEGREE, HARMONIC_SLOWEST = 8, 3, 0.2
"""Parts of a push, degree of the polynomial of time that the currents of one follow without harmonics, and the speed of
one, of the largest, below which it is not looked at: there the current's step is."""


@dataclass(frozen=True, slots=True)
class Pushes:
    """The traces of a run of pushes, and what turns their currents into torque."""

    parts: list[Trace]
    """Pushes with the mean currents of the periods, in the frame of the d axis, and coasting."""
    torque: Torque
    """Torque (N m) of arrays of i_d, i_q (A)."""
    torque_per_a: float
    """Of the q current (N m/A)."""
    sigma_a: float
    """Noise of one sample of a current (A)."""
    scale_std: float
    tilt_std: float
    """Relative standard deviations of the torque's scale, and of what it is off at the fastest speed."""
    direction: int
    """Sign of the encoder's count along the phase order."""
    encoder: EncoderResult
    """Pole pairs, and the encoder's error once and twice per turn."""
    tolerance: SensorTolerance | None
    """Declared sensor tolerances."""
    drag_std_nms: float = 0.0
    """What the displacement of the samples may make of B, of a shaft that coasts with the voltage on (N m s)."""

    def mechanics(self, *, elastic: bool = False) -> MechanicsResult:
        """Return inertia and friction; ``elastic``: take any torque that a rigid shaft does not explain for noise.

        Raises IdentificationError: as the estimator refuses.
        """
        found = estimate_mechanics(
            self.parts,
            self.torque,
            self.torque_per_a,
            self.sigma_a,
            self.scale_std,
            direction=self.direction,
            tolerance=self.tolerance,
            tilt_std=self.tilt_std,
            pole_pairs=round(self.encoder.pole_pairs.value),
            encoder=self.encoder.per_turn,
            elastic=elastic,
        )
        return replace(found, B=replace(found.B, std=math.hypot(found.B.std, self.drag_std_nms)))

    def means(self) -> dict[str, Estimate]:
        """Return inertia and friction of the mean accelerations, by their keys, as far as these tell them."""
        return mean_mechanics(self.parts, self.torque, self.scale_std, self.direction, self.tolerance)

    def swing_hz(self, response: FrequencyResponse | None) -> float:
        """Return the frequency (Hz) at which pushes clearly swing and a response does not, else 0."""
        resonance = None if response is None else response.found.get("resonance_hz")
        pushed = [part for part in self.parts if not part.meta["coasting"]]
        if not pushed:
            return 0.0
        claimed = () if resonance is None else (resonance.value, COVERAGE_FACTOR * resonance.std)
        return swing_of(pushed, self.torque, *claimed)


def pushes_of(
    traces: Mapping[str, Trace],
    result: Evaluation,
    tolerance: SensorTolerance | None,
    dead_time_s: float = 0.0,
    period_s: float = 0.0,
    rough_L_h: tuple[float, float] = (0.0, 0.0),
) -> Pushes | None:
    """Return the pushes of a run; None without them, or without a flux linkage.

    Parameters
    ----------
    traces : mapping of str to Trace
        ``inertia_<k>`` of the run.
    result : Evaluation
        What the runs before it say.
    tolerance : SensorTolerance
        Declared sensor tolerances.
    dead_time_s, period_s : float
        Of a leg, and of the control (s): they displace the samples of the current.
    rough_L_h : (float, float)
        Inductances (H) for that displacement where they are refused; 0: not known.
    """
    parts = [traces[f"{TRACE}{k}"] for k in range(sum(name.startswith(TRACE) for name in traces))]
    if not parts or result.flux is None or result.encoder is None or result.offset is None:
        return None
    pole_pairs = round(result.encoder.pole_pairs.value)
    behind = result.offset.value - float(parts[0].meta["offset_rad"])
    direction = int(parts[0].meta["direction"])
    psi = result.flux.psi_measured
    torque = torque_of(result, pole_pairs)
    found = result.inductance
    L_h = rough_L_h if found is None else (found.L_d.value, found.L_q.value)
    doubt = 1.0
    if found is not None and result.resistance is not None:  # what a slope leaves of a current that fades in a period
        faded = 0.5 * period_s * result.resistance.R_measured.value / min(L_h)
        doubt = min(1.0, math.hypot(SAMPLE_DOUBT, faded))
    iron = iron_loss_of(result)
    displaced, tilt, drag, taken, lost = 0.0, 0.0, 0.0, 0.0, 0.0
    for k, part in enumerate(parts):
        if not part.meta["coasting"] or part.meta.get(POWERED):
            sampled = in_frame(part, behind)
            parts[k] = _between_samples(sampled, direction * pole_pairs, result, L_h, dead_time_s, period_s)
            before, after = (torque(run["i_d_a"], run["i_q_a"]) for run in (sampled, parts[k]))
            if part.meta["coasting"]:
                known = doubt * float(np.mean(np.abs(after - before)) / np.mean(np.abs(_speed(part))))
                drag = max(drag, math.hypot(known, _drag_of_unknown_instant(result, pole_pairs, L_h[1])))
                continue
            fast = np.abs(_speed(part)) > FAST_SHARE * np.max(np.abs(_speed(part)))
            size = float(np.mean(np.abs(before)))
            displaced = max(displaced, abs(float(np.mean(after - before))) / size)
            eddy = _eddy_share(part, pole_pairs, result)
            by_harmonics = _harmonic_current(part, direction, pole_pairs, result)
            i_d, i_q = parts[k]["i_d_a"], parts[k]["i_q_a"] - by_harmonics
            if iron is not None and found is not None:
                # the flux of i_q drives a d current through the iron; that through the magnets' flux is in B
                driven = direction * pole_pairs * _speed(part) * best_L_q(found, result.flux).value / iron.value * i_q
                by_iron = float(np.mean(np.abs(torque(i_d + driven, i_q) - torque(i_d, i_q)))) / size
                i_d, lost = i_d + driven, max(lost, by_iron)
            parts[k] = replace(parts[k], signals={**parts[k].signals, "i_d_a": i_d, "i_q_a": i_q})
            taken = max(taken, float(np.mean(np.abs(by_harmonics))) / float(np.mean(np.abs(part["i_q_a"]))))
            tilt = max(tilt, math.hypot(doubt * float(np.mean((after - before)[fast])) / size, eddy))
    return Pushes(
        parts,
        torque,
        torque_per_ampere(pole_pairs, psi.value),
        result.noise.sigma_a,
        torque_doubt(
            result.flux,
            math.hypot(doubt * displaced, HARMONIC_DOUBT * taken, IRON_DOUBT * lost),
            mapped=result.flux_map is not None,
        ),
        math.hypot(TILT_FLOOR, tilt),
        direction,
        result.encoder,
        tolerance,
        drag,
    )


def of_no_rigid_shaft(
    pushes: Pushes, response: FrequencyResponse | None
) -> tuple[MechanicsResult | None, dict[str, Estimate], FrequencyResponse | None]:
    """Return what pushes of a shaft that is not rigid tell, else their means by key, and what of the response holds.

    A small random torque turns only what is this side of a play, pushes all of it: a response that shows less inertia
    than they do is none of the whole shaft. Where it shows more, the means of the pushes hold it in their intervals
    (play of 0.4 degrees; 0.2 % off, the response 5 %), but where pushes swing, which a response without resonance has
    missed (70 Hz; 0.4 % off, the response 22 %). So it is beside an elastic fit that agrees with a response without
    resonance: with play of 0.12 degrees both showed too much, by 11 and 22 %, the means 3 % too little. Where both
    swing at one frequency there is no play, and the inertia is the response's: pulses that a swing of 38 Hz outlasts,
    before friction of 9 % of the rated torque, showed 10 % too much.

    Parameters
    ----------
    pushes : Pushes
        A rigid shaft does not explain them.
    response : FrequencyResponse or None
        It has the torque's scale in common with them.
    """
    swing_hz = pushes.swing_hz(response)
    if response is not None and response.found and swing_hz:
        slow = response.found["resonance_hz"].value
        both = f"it swings at {slow:.3g} Hz by a small torque, at {swing_hz:.3g} Hz by pulses"
        why = f"play, the response depends on the torque: {both}"
        response = replace(response, found={}, inertia=None, shown_hz=0.0, reason=why)
        return None, _because(pushes.means(), f"{PLAY_FALLBACK}: {both}"), response
    small = None if response is None else response.inertia
    found = None
    if small is not None:
        with contextlib.suppress(IdentificationError):
            found = pushes.mechanics(elastic=True)
    means = pushes.means() if found is None else {"J_kgm2": found.J, "B_nms": found.B, "tau_c_nm": found.tau_c}
    whole = means.get("J_kgm2")
    if whole is None:
        return None, {}, response
    why = MEAN_FALLBACK if found is None else ELASTIC_FALLBACK
    if response is not None and small is not None:
        check = cross_check("J_kgm2", "J_kgm2", small, whole)
        if check.agrees and found is not None and not response.found:  # an elastic fit where nothing swings
            mean = pushes.means().get("J_kgm2", whole)
            beside = cross_check("J_kgm2", "J_kgm2", small, mean)
            check, whole = (check, whole) if beside.agrees else (beside, mean)
        if not check.agrees and _is_linear(response, pushes.swing_hz(None)):
            apart = (whole.value - small.value) / COVERAGE_FACTOR
            means["J_kgm2"] = small = replace(small, std=math.hypot(small.std, apart))
            response, why = replace(response, inertia=small), LINEAR_FALLBACK
        elif not check.agrees:
            both = f"{small.value:.3g} kg m2 by a small torque, {whole.value:.3g} by pulses"
            why = f"the shaft has play, or is not linear: {both}"
            response = replace(response, found={}, inertia=None, shown_hz=0.0, reason=why)
            means = pushes.means()  # positions in a play follow no torque: a fit had J 7.5 % off at +-3.4 %
            if check.difference < 0.0:
                return None, _because(means, f"{PLAY_FALLBACK}: {both}"), response
            if swing_hz:
                return None, _because(means, f"{MEAN_FALLBACK}, it swings at {swing_hz:.3g} Hz: {both}"), response
            apart = check.difference / COVERAGE_FACTOR  # one torque's scale makes all of them
            means = {key: replace(e, std=math.hypot(e.std, apart * e.value)) for key, e in means.items()}
            return None, _because(means, f"{MEAN_FALLBACK}: {both}"), response
        if small.std < whole.std:
            means["J_kgm2"] = small
    if found is None and means["J_kgm2"] is small:
        del means["J_kgm2"]  # the response says it by itself
    means = _because(means, why)
    if found is None:
        return None, means, response
    return replace(found, J=means["J_kgm2"], B=means["B_nms"], tau_c=means["tau_c_nm"]), {}, response


def _is_linear(response: FrequencyResponse, swing_hz: float) -> bool:
    """Return whether pulses swing the shaft at the resonance that a small torque shows: play would make that lower."""
    resonance = response.found.get("resonance_hz")
    return resonance is not None and resonance.value / NEAR < swing_hz < resonance.value * NEAR


def unseen_above_hz(response: FrequencyResponse | None, swing_hz: float) -> float:
    """Return from where on (Hz) it is not known what swings a shaft that is not rigid; 0 where it is known."""
    if swing_hz or (response is not None and response.found):
        return 0.0
    return max(SLOWEST_UNSEEN_HZ, 0.0 if response is None else response.shown_hz)


def _because(means: Mapping[str, Estimate], why: str) -> dict[str, Estimate]:
    return {key: replace(estimate, fallback=why) for key, estimate in means.items()}


def with_play_told(found: MechanicsResult, response: FrequencyResponse | None) -> MechanicsResult:
    """Return what pushes tell, its inertia saying so where a small torque turns less of the shaft: it has play.

    Where both agree, and the pushes turned a coarse encoder by few steps, the inertia is that of the small torque.
    """
    small = None if response is None else response.inertia
    if small is None:
        return found
    check = cross_check("J_kgm2", "J_kgm2", small, found.J)
    if check.agrees and FINER * total_half_width(small) < total_half_width(found.J):
        return replace(found, J=small)
    if check.agrees or check.difference > -PLAY_LEAST:
        return found
    both = f"{small.value:.3g} kg m2 by a small torque, {found.J.value:.3g} by pulses"
    return replace(found, J=replace(found.J, fallback=f"{PLAY_FALLBACK}: {both}"))


def torque_doubt(flux: FluxResult, displaced: float = 0.0, *, mapped: bool = False) -> float:
    """Return the relative standard deviation of the torque's scale.

    Parameters
    ----------
    flux : FluxResult
        Flux linkage, and how the d axis saturates.
    displaced : float
        Doubt about the displacement of the current's samples, of the torque.
    mapped : bool
        Whether a flux map gives the torque.
    """
    unseen = 0.0 if mapped else SATURATION_DOUBT * flux.curvature
    return math.hypot(flux.psi_measured.std / flux.psi_measured.value, displaced, unseen)


def _between_samples(
    trace: Trace, pole_pairs: int, result: Evaluation, L_h: tuple[float, float], dead_time_s: float, period_s: float
) -> Trace:
    """Return a push with the mean currents of the periods in place of the sampled ones.

    A dead time delays every pulse by half of it, so that the sample in the middle of the zero vector, where the current
    falls by the mean voltage over L, is ahead by u t_d/(2 L) (``estimators/inverter_error``); a sensor's
    lag, and the instant at which it is read, displace it, too, as the inductances' fit and the flux run have found
    them.
    """
    assert result.flux is not None and result.resistance is not None
    L_d, L_q = L_h
    if not (L_d > 0.0 and L_q > 0.0):
        return trace
    sampling = (result.inductance and result.inductance.sampling) or Sampling()
    R, psi = result.resistance.R_measured.value, result.flux.psi_measured.value
    i_d, i_q = trace["i_d_a"], trace["i_q_a"]
    omega = pole_pairs * _speed(trace)
    u_d, u_q = R * i_d - omega * L_q * i_q, R * i_q + omega * (psi + L_d * i_d)
    late = standstill_instant_s(sampling, Modulation(math.inf, L_h, period_s, dead_time_s))
    return replace(trace, signals={**trace.signals, "i_d_a": i_d + u_d * late / L_d, "i_q_a": i_q + u_q * late / L_q})


def _drag_of_unknown_instant(result: Evaluation, pole_pairs: int, L_q_h: float) -> float:
    """Return the standard deviation of B (N m s) by a displacement of the samples that may be none.

    What the flux run shows of their instant, eddy currents and an old encoder angle show as well. Beside the former it
    is in no current of a coasting: 7 us of a sensor's lag made 1.2 times the B of a light shaft. The latter is taken
    out of one: an angle 13 us old made B 20 times too large at +-56 %. All of it counts as two deviations.
    """
    if result.shown is None or result.flux is None or not L_q_h > 0.0:
        return 0.0
    psi, shown_s = result.flux.psi_measured.value, result.shown.value_s
    if result.inductance is not None and result.inductance.sampling is not None:
        shown_s = max(0.0, shown_s)  # no angle is early
    return 0.5 * torque_per_ampere(pole_pairs, psi) * pole_pairs * psi * abs(shown_s) / L_q_h


def _eddy_share(trace: Trace, pole_pairs: int, result: Evaluation) -> float:
    """Return what the eddy currents of the inductances' fit take of a push's current at its fastest speed."""
    if result.inductance is None or result.flux is None:
        return 0.0
    axis = result.inductance.axes["q"]
    emf = pole_pairs * float(np.max(np.abs(_speed(trace)))) * result.flux.psi_measured.value
    return emf * axis.eddy_s / axis.L_h / float(np.mean(np.abs(trace["i_q_a"])))


def _harmonic_current(trace: Trace, direction: int, pole_pairs: int, result: Evaluation) -> Array:
    """Return the q current whose torque harmonics of the back-EMF take from a push (A), row by row.

    They drive currents against the winding's resistance, the loop's proportional gain and the inverter's error, whose
    own harmonics do so, too: what these oppose is the power that brakes the shaft.
    """
    assert result.flux is not None and result.resistance is not None and result.offset is not None
    resistance, omega = result.resistance, direction * pole_pairs * _speed(trace)
    slowest = HARMONIC_SLOWEST * float(np.max(np.abs(omega)))
    currents = trace["i_d_a"], trace["i_q_a"]
    errors = np.zeros((2, len(trace)))
    if resistance.curve is not None:
        theta_e = direction * pole_pairs * trace["theta_M_rad"] - result.offset.value
        errors = np.stack(resistance.curve.error_dq_v(*currents, theta_e))
    taken = np.zeros(len(trace))
    for rows in np.array_split(np.arange(len(trace)), HARMONIC_PARTS)[1:]:
        speed = float(np.mean(omega[rows]))
        if abs(speed) <= slowest or len(rows) <= HARMONIC_DEGREE + 1:  # it stood, or a fit leaves nothing
            continue
        for i, error, K_p in zip(currents, errors, trace.meta.get("K_p_v_per_a", ()), strict=False):
            i_left, error_left = _quick_part(i[rows]), _quick_part(error[rows])
            square = float(np.mean(i_left**2)) - result.noise.sigma_a**2
            power = (resistance.R_measured.value + K_p) * square + float(np.mean(error_left * i_left))
            taken[rows] += power / (speed * result.flux.psi_measured.value)
    return taken


def _quick_part(signal: Array) -> Array:
    t = np.linspace(-1.0, 1.0, len(signal))
    return np.asarray(signal - Legendre.fit(t, signal, HARMONIC_DEGREE)(t))


def _speed(trace: Trace) -> Array:
    """Speed of a trace from its positions over a fiftieth of it (rad/s of the encoder)."""
    theta, n = trace["theta_M_rad"], len(trace)
    half = max(1, n // 100)
    k = np.arange(n)
    before, after = np.maximum(k - half, 0), np.minimum(k + half, n - 1)
    return np.asarray((theta[after] - theta[before]) / (trace.t_s[after] - trace.t_s[before]))


def in_frame(trace: Trace, behind_rad: float) -> Trace:
    """Return a trace with its currents in a frame that stands so much behind the recorded one."""
    c, s = math.cos(behind_rad), math.sin(behind_rad)
    i_d, i_q = trace["i_d_a"], trace["i_q_a"]
    return replace(trace, signals={**trace.signals, "i_d_a": c * i_d - s * i_q, "i_q_a": s * i_d + c * i_q})


def torque_of(result: Evaluation, pole_pairs: int) -> Torque:
    """Torque by the flux map where there is one, else by flux linkage and the difference of the inductances.

    Beside iron loss in a ferrite machine of 13 and 65 mH the square waves had 15 mH +-700 % on q, and J with it was
    9.6 % off at +-2.3 %.
    """
    assert result.flux is not None
    psi = result.flux.psi_measured.value
    if result.flux_map is not None:
        flux_map = result.flux_map.flux_map
        warmer = psi - result.flux.psi_f.value

        def by_map(i_d: Array, i_q: Array) -> Array:
            psi_d, psi_q = flux_map.flux(i_d, i_q)
            return air_gap_torque(pole_pairs, psi_d + warmer, psi_q, i_d, i_q)

        return by_map
    found = result.inductance
    difference = 0.0
    if found is not None:
        difference = found.L_d.value - best_L_q(found, result.flux).value
    return lambda i_d, i_q: torque_per_ampere(pole_pairs, psi + difference * i_d) * i_q
