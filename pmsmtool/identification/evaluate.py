# SPDX-License-Identifier: MIT
"""From the stored traces of a run to the identified machine: pure arithmetic, the same bytes at every replay."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from pmsmtool.errors import ConfigError, IdentificationError
from pmsmtool.estimators.cross_check import CrossCheck, cross_check
from pmsmtool.estimators.current_sensors import (
    Noise,
    SensorMismatch,
    estimate_mismatch,
    estimate_noise,
    widened,
    without_mismatch,
)
from pmsmtool.estimators.encoder import (
    JUMP_LIMIT_RAD,
    EncoderResult,
    check_encoder_counts,
    estimate_by_rests,
    estimate_encoder,
)
from pmsmtool.estimators.estimate import CHI2_WARN, SensorTolerance, total_half_width
from pmsmtool.estimators.flux.linkage import FluxResult, check_magnet, estimate_flux_linkage, magnet_change
from pmsmtool.estimators.flux.map_result import FluxMapResult
from pmsmtool.estimators.injection.axis_layout import Motion
from pmsmtool.estimators.injection.axis_response import initial_inductance
from pmsmtool.estimators.injection.inductance import FrameAhead, InductanceResult, bare_shot, estimate_inductances
from pmsmtool.estimators.injection.sampling_instant import Sampling, ShownInstant
from pmsmtool.estimators.inverter_error import Modulation
from pmsmtool.estimators.resistance import (
    R_MEASURED,
    Copper,
    ResistanceResult,
    estimate_resistance,
    resistance_warmed,
    settled_levels,
)
from pmsmtool.estimators.shaft.frequency_response import FrequencyResponse
from pmsmtool.estimators.shaft.mechanics import MechanicsResult
from pmsmtool.identification import frequency_response
from pmsmtool.identification.calibration import calibrated_traces
from pmsmtool.identification.cogging import Cogging, cogging_of
from pmsmtool.identification.emf_harmonics import EmfHarmonics, harmonics_of
from pmsmtool.identification.flux_map import flux_map_of, map_estimates
from pmsmtool.identification.iron_loss import IRON_LOSS, iron_loss_of
from pmsmtool.identification.mechanics import (
    NOT_RIGID,
    of_no_rigid_shaft,
    pushes_of,
    unseen_above_hz,
    with_play_told,
)
from pmsmtool.identification.phase_check import PairCheck, at_one_temperature, check_pairs, check_phases, over_phases
from pmsmtool.identification.sampling import resistance_as_sampled
from pmsmtool.identification.wiring import Finding, link_at_rest, supply_power, supply_under_load
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.temperature import MAGNET_ALPHA_PER_K
from pmsmtool.plain_text import counted
from pmsmtool.trace import Trace
from pmsmtool.units import format_quantity

MOTION_STD = 0.2
"""Relative standard deviation of the rotor's answer to an injection as the pushes show it: friction takes part."""
RELUCTANCE_STD = 0.3
"""Standard deviation of what reluctance takes from it, relative: the inductances are rough and incremental."""
FIXED = ("levels", "square_", "angle_")
"""Beginnings of the names of traces whose current vector keeps its angle."""
NOTABLY_WIDER = 1.2
"""Growth of a total interval from which on a reader is told of what makes it wider."""
MAGNET_MOST = 0.05
"""Change of the flux linkage over the pulses of a flux map beyond which psi_f is refused, too, relative. A magnet 14 K
warmer gave 2 % less."""
HIDDEN_INSTANT_S = 5e-6
"""Standard deviation of the instant at which currents are sampled where eddy currents hide it, at most half of what the
run over speeds shows of it (s): current sensors lag by 1 to 10 us."""
MOSFET_LINK_V = 100.0
"""Below this DC link bridges are made of MOSFETs, which have no threshold."""


_Found = TypeVar("_Found")


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What the traces of a run say; None where an experiment was not run, or is in ``refused`` with its reason.

    ``refused`` has the keys ``R``, ``encoder``, ``L``, ``psi``, ``map``, ``mechanics``, ``frf``, ``cogging`` and
    ``harmonics``. ``means`` are inertia and friction by mean accelerations, by their keys, where no model explains the
    pushes, and ``encoder_errors`` those of the position once and twice per turn (rad); ``swing_hz`` is where pushes
    swing the shaft and no linear response does (Hz), ``unseen_hz`` from where on a shaft that is not rigid may swing
    unseen, and ``load_ratio`` of load to motor there (0: unknown). ``encoder_noise_rad`` is the standard deviation of a
    position at rest, without what drifts (mechanical). ``warming_k_per_a2s`` is what the winding's sensor rises by
    (:func:`warming`), ``supply_w`` the power from which on the DC link gives way (W), and ``U_dc_rest_v`` the link that
    the drive showed before anything moved (V).
    """

    noise: Noise
    encoder_noise_rad: float = 0.0
    mismatch: SensorMismatch | None = None
    pairs: PairCheck | None = None
    resistance: ResistanceResult | None = None
    warming_k_per_a2s: float = 0.0
    supply: Finding | None = None
    supply_w: float = math.inf
    U_dc_rest_v: float = math.nan
    encoder: EncoderResult | None = None
    inductance: InductanceResult | None = None
    flux: FluxResult | None = None
    mechanics: MechanicsResult | None = None
    means: Mapping[str, Estimate] = field(default_factory=dict)
    encoder_errors: Mapping[int, float] = field(default_factory=dict)
    swing_hz: float = 0.0
    unseen_hz: float = 0.0
    load_ratio: float = 0.0
    flux_map: FluxMapResult | None = None
    frequency_response: FrequencyResponse | None = None
    cogging: Cogging | None = None
    harmonics: EmfHarmonics | None = None
    map_estimates: Mapping[str, Estimate] = field(default_factory=dict)
    refused: Mapping[str, IdentificationError] = field(default_factory=dict)

    def whole(self) -> Evaluation:
        """Return this; raises the first refusal where there is one (``IdentificationError``)."""
        for refusal in self.refused.values():
            raise refusal
        return self

    @property
    def offset(self) -> Estimate | None:
        """Encoder offset: the slow rotation's, made fine by the speed run where there was one (rad)."""
        if self.encoder is None:
            return None
        if self.flux is None:
            return self.encoder.offset
        fine = self.flux.frame_offset
        return replace(fine, value=wrapped(self.encoder.offset.value + fine.value))

    @property
    def shown(self) -> ShownInstant | None:
        """What the speed run shows of the instant at which currents are sampled."""
        return None if self.flux is None else self.flux.shown

    @property
    def checks(self) -> list[CrossCheck]:
        """What second methods say: psi_f by q currents, and L_q, apparent, beside the incremental one."""
        found = []
        if self.flux is not None and self.flux.driven is not None:
            common, first = self.flux.voltage_scale_std, self.flux.psi_f
            apart = self.flux.apart_wb * first.value / self.flux.psi_measured.value
            alone = replace(first, std=math.sqrt(max(0.0, first.std**2 - apart**2)))
            wider = total_half_width(first) > NOTABLY_WIDER * total_half_width(alone)
            # what they are apart is in the interval of psi_f: it is an alarm where that is another interval by it
            judged = alone if wider else first
            found.append(cross_check("psi_f_wb_driven", "psi_f_wb", self.flux.driven, judged, common))
        if self.flux is not None and self.inductance is not None:
            found.append(cross_check("L_q_h_apparent", "L_q_h", self.flux.L_q_app, self.inductance.L_q))
        return found

    def effects(self) -> dict[str, Estimate]:
        """Return what no design depends on, by its key: what repeats with the shaft's angle, iron loss, drag of air."""
        losses = {IRON_LOSS: iron_loss_of(self), "drag_nms2": None if self.mechanics is None else self.mechanics.drag}
        found = [part.estimates() for part in (self.harmonics, self.cogging) if part is not None]
        return {k: e for part in found for k, e in part.items()} | {k: e for k, e in losses.items() if e is not None}

    def estimates(self) -> dict[str, Estimate]:
        """Return every estimate by its machine-file key."""
        found: dict[str, Estimate] = {}
        if self.resistance is not None:
            found["R_s_ohm"] = self.resistance.R_s
            found[R_MEASURED] = self.resistance.R_measured
        if self.inductance is not None:
            found["L_d_h"], found["L_q_h"] = self.inductance.L_d, self.inductance.L_q
        if self.flux is not None:
            found["psi_f_wb"] = self.map_estimates.get("psi_f_wb", self.flux.psi_f)
        if self.encoder is not None:
            found["pole_pairs"] = replace(self.encoder.pole_pairs, std=0.0)  # an integer, or refused
        if self.offset is not None:
            found["offset_rad"] = self.offset
        if self.mechanics is not None:
            found |= {"J_kgm2": self.mechanics.J, "B_nms": self.mechanics.B, "tau_c_nm": self.mechanics.tau_c}
        found |= self.means
        if self.frequency_response is not None:
            found |= self.frequency_response.found
            if "J_kgm2" not in found and self.frequency_response.inertia is not None:
                found["J_kgm2"] = self.frequency_response.inertia
        found.update((name, estimate) for name, estimate in self.map_estimates.items() if name not in found)
        return found


def wrapped(angle: float) -> float:
    """Return an angle within (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


def _beside_speeds(inductance: InductanceResult, apparent: Estimate) -> InductanceResult:
    """Return L_q with what the run over speeds says otherwise in its interval, where the model misses its shots, too.

    A phase current within the inverter's knee made L_q four times too large at +-13 %. Counted is what lies beyond the
    interval of the difference: a motor of 2 kN m, which shows L_q at speed to +-44 %, lost it by 80 % at +-78 %.
    """
    L_q = inductance.L_q
    check = cross_check("L_q_h_apparent", "L_q_h", apparent, L_q)
    if check.agrees or not (L_q.chi2 > CHI2_WARN or "q" in inductance.frequency_dependent):
        return inductance
    told = f"the model misses the shots, and the run over speeds shows {format_quantity(apparent.value, 'H')}"
    fallback = "; ".join(filter(None, (L_q.fallback, told)))
    beyond = L_q.value * (abs(check.difference) - check.half_width)
    return replace(inductance, L_q=replace(L_q, std=math.hypot(L_q.std, beyond), fallback=fallback))


def tolerance_on(tolerance: SensorTolerance, U_dc_v: float) -> SensorTolerance:
    """Return the tolerances with the DC link on which the thresholds of the bridge act (V)."""
    without = U_dc_v < MOSFET_LINK_V and tolerance.bridge_difference_v is None
    return replace(tolerance, U_dc_v=U_dc_v, bridge_threshold_v=0.0 if without else tolerance.bridge_threshold_v)


def evaluate(
    traces: Mapping[str, Trace],
    period_s: float,
    *,
    T_ref_c: float = 20.0,
    copper: Copper | None = None,
    alpha_psi_per_k: float = MAGNET_ALPHA_PER_K,
    U_dc_v: float = math.inf,
    tolerance: SensorTolerance | None = None,
    ended: Mapping[str, IdentificationError] | None = None,
    plateau_v: float = 0.0,
) -> Evaluation:
    """Estimate everything the traces allow; what is refused takes only what depends on it along.

    Raises IdentificationError: noise, phases, encoder counts or current sensors: then no value can be trusted;
    ConfigError: there is no zero-current trace.

    Parameters
    ----------
    traces : mapping of str to Trace
        As the run directory keeps them: ``zero_current``, ``phase_vectors``, ``first_turn``, ``levels``,
        ``phase_pairs``, ``rotation_forward``, ``rotation_backward``, ``square_d_<half period>``, ``square_q_<half
        period>``, ``angle_d_<k>``, ``angle_q_<k>``, ``speeds``, ``map_<k>``, ``speeds_after_map``, ``inertia_<k>``,
        ``frf_<k>``, ``turns_<k>``, ``slow_<k>``.
    period_s : float
        Control period (s).
    T_ref_c : float
        Temperature the values are referred to (degC); that of ``copper`` where it is given.
    copper : Copper, optional
        What the machine file says of the winding.
    alpha_psi_per_k : float
        Temperature coefficient of the magnet flux (1/K).
    U_dc_v : float
        DC link of the nameplate (V); infinite: the thresholds of the bridge are not counted.
    tolerance : SensorTolerance
        Declared sensor tolerances.
    ended : mapping of str to IdentificationError, optional
        Experiments that were refused while they ran, by the keys of ``Evaluation.refused``: their traces are not whole.
    plateau_v : float
        As of ``estimators/resistance.py`` (V).
    """
    if "zero_current" not in traces:
        raise ConfigError("the run has no zero-current trace", hint="run identify again")
    tolerance = tolerance_on(tolerance or SensorTolerance(), U_dc_v)
    copper = copper or Copper(T_ref_c)
    shown_v = link_at_rest(traces["zero_current"])
    traces = calibrated_traces(traces, tolerance)
    noise = estimate_noise(traces["zero_current"])
    mismatch = estimate_mismatch(traces["phase_pairs"], noise) if "phase_pairs" in traces else None
    traces = with_equal_sensors(traces, mismatch)
    result = Evaluation(noise, _encoder_noise(traces["zero_current"]), mismatch=mismatch, U_dc_rest_v=shown_v)
    if "phase_vectors" in traces:
        check_phases(traces["phase_vectors"], result.noise)
    if "first_turn" in traces:
        check_encoder_counts(traces["first_turn"])
    refused = dict(ended or {})

    def attempt(quantity: str, estimate: Callable[[], _Found]) -> _Found | None:
        if quantity in refused:
            return None
        try:
            return estimate()
        except IdentificationError as refusal:
            refused[quantity] = refusal
            return None

    if "levels" in traces:
        rest_and_load = traces["zero_current"], traces["levels"]
        result = replace(result, supply=supply_under_load(*rest_and_load), supply_w=supply_power(*rest_and_load)[0])
        result = replace(result, warming_k_per_a2s=warming(traces["levels"]))
        R = attempt("R", lambda: resistance_of(traces["levels"], result.noise, copper, tolerance, plateau_v))
        if R is not None:
            R = replace(R, R_s=widened(R.R_s, mismatch), R_measured=widened(R.R_measured, mismatch))
            result = replace(result, resistance=R)
    if "phase_pairs" in traces and result.resistance is not None:
        alike = at_one_temperature(traces["phase_pairs"], result.resistance)
        pairs = check_pairs(alike, result.noise, result.resistance.curve)
        result = replace(result, pairs=pairs, resistance=over_phases(result.resistance, pairs, tolerance))
    if "rotation_backward" in traces:
        turns = traces["rotation_forward"], traces["rotation_backward"]
        result = replace(result, encoder=attempt("encoder", lambda: estimate_encoder(*turns, JUMP_LIMIT_RAD)))
    elif "phase_pairs" in traces and "theta_imposed_rad" in traces["phase_pairs"].signals:
        rests = traces["levels"], traces["phase_pairs"]
        result = replace(result, encoder=attempt("encoder", lambda: estimate_by_rests(*rests)))
    resistance = result.resistance
    # a wrong angle or number of pole pairs is in the speeds, too
    if "speeds" in traces and resistance is not None and "encoder" not in refused:
        flux = attempt("psi", lambda: flux_of(traces, resistance, period_s, alpha_psi_per_k, tolerance))
        result = replace(result, flux=flux)
    shots = all(any(name.startswith(f"square_{axis}") for name in traces) for axis in "dq")
    if resistance is not None and result.encoder is not None and shots:
        before = result
        inductance = attempt("L", lambda: inductance_of(traces, before, tolerance, U_dc_v))
        if inductance is not None:
            L_d, L_q = widened(inductance.L_d, mismatch), widened(inductance.L_q, mismatch)
            inductance = replace(inductance, L_d=L_d, L_q=L_q)
            rough = replace(before, inductance=inductance)
            result = attempt("psi", lambda: as_sampled(traces, rough, period_s, alpha_psi_per_k, tolerance)) or replace(
                rough, flux=None
            )
    result = attempt("psi", lambda: magnet_checked(traces, result, alpha_psi_per_k, refused)) or replace(
        result, flux=None
    )
    if result.inductance is not None and result.flux is not None:
        result = replace(result, inductance=_beside_speeds(result.inductance, result.flux.L_q_app))
    flux_map = attempt("map", lambda: flux_map_of(traces, result, tolerance, U_dc_v))
    if flux_map is not None:
        result = replace(result, flux_map=flux_map, map_estimates=map_estimates(result, flux_map, traces))
    dead_time_s = 0.0 if result.resistance is None else result.resistance.dead_time_s(U_dc_v, period_s)
    shaft = result
    rough_L_h = _rough_inductance(traces, "d"), _rough_inductance(traces, "q")
    pushes = pushes_of(traces, shaft, tolerance, dead_time_s, period_s, rough_L_h)
    moving = shaft if pushes is None else replace(shaft, mechanics=attempt("mechanics", pushes.mechanics))
    response = attempt("frf", lambda: frequency_response.frequency_response_of(traces, moving, tolerance, dead_time_s))
    if pushes is not None and "mechanics" in refused and refused["mechanics"].reason in NOT_RIGID:
        elastic, means, response = of_no_rigid_shaft(pushes, response)
        swing_hz = 0.0 if response is not None and response.found else pushes.swing_hz(response)
        errors = {} if elastic is not None else frequency_response.encoder_errors_of(traces, moving)
        unseen_hz = unseen_above_hz(response, swing_hz)
        moving = replace(
            moving, mechanics=elastic, means=means, encoder_errors=errors, swing_hz=swing_hz, unseen_hz=unseen_hz
        )
        if elastic is not None or "tau_c_nm" in means:
            del refused["mechanics"]
    elif moving.mechanics is not None:
        moving = replace(moving, mechanics=with_play_told(moving.mechanics, response))
        if response is not None and response.suspected_hz:
            resonance_hz, antiresonance_hz = response.suspected_hz
            ratio = (resonance_hz / antiresonance_hz) ** 2 - 1.0
            moving = replace(moving, unseen_hz=resonance_hz, load_ratio=ratio)
    modulation = None
    if shaft.resistance is not None and shaft.inductance is not None and "speeds" in traces:
        L_h = shaft.inductance.L_d.value, shaft.inductance.L_q.value
        modulation = modulation_of(traces["speeds"], shaft.resistance, L_h, period_s)
    harmonics = attempt("harmonics", lambda: harmonics_of(traces, shaft, tolerance, period_s, modulation))
    turned = replace(moving, frequency_response=response, harmonics=harmonics)
    return replace(turned, cogging=attempt("cogging", lambda: cogging_of(traces, turned)), refused=refused)


def _encoder_noise(at_rest: Trace) -> float:
    """Standard deviation of a position (rad), from differences of rows, which hold next to nothing of a drift."""
    if "theta_M_rad" not in at_rest.signals:
        return 0.0
    change = np.diff(at_rest["theta_M_rad"])
    return float(np.std((change + math.pi) % (2.0 * math.pi) - math.pi)) / math.sqrt(2.0)


def with_equal_sensors(traces: Mapping[str, Trace], mismatch: SensorMismatch | None) -> Mapping[str, Trace]:
    """Return the traces along fixed vectors as equal current sensors would have shown them.

    In a frame that follows the rotor the mismatch is a second harmonic, which the means over whole turns do not see.
    """
    if mismatch is None or not mismatch.corrected:
        return traces
    fixed = {name: trace for name, trace in traces.items() if name.startswith(FIXED)}
    return {
        **traces,
        **{n: without_mismatch(trace, mismatch, float(trace.meta["fixed_angle_rad"])) for n, trace in fixed.items()},
    }


def resistance_of(
    levels: Trace,
    noise: Noise,
    copper: Copper | None = None,
    tolerance: SensorTolerance | None = None,
    plateau_v: float = 0.0,
) -> ResistanceResult:
    """Return the resistance at a reference temperature; levels at which the shaft moved are left out, and counted."""
    levels, left_out = settled_levels(levels, noise)
    result = estimate_resistance(levels, noise, tolerance=tolerance, copper=copper, plateau_v=plateau_v)
    if not left_out:
        return result
    note = f"{counted(left_out, 'level')} left out: shaft or voltage moved then"
    fallback = "; ".join(part for part in (result.R_s.fallback, note) if part)
    return replace(result, R_s=replace(result.R_s, fallback=fallback))


def warming(levels: Trace) -> float:
    """Return what a winding of one time constant rises by per square of a current (A peak) and time (K/(A2 s)).

    0 without a sensor, and where it does not rise. Of all levels: between the ones left out something else flowed.
    """
    T_c, time_s = levels["T_winding_c"], np.diff(levels.t_s)
    if not np.all(np.isfinite(T_c)):
        return 0.0
    columns = np.stack([levels["i_d_a"][1:] ** 2, 0.5 * (T_c[1:] + T_c[:-1]), np.ones_like(time_s)], axis=1)
    x, *_ = np.linalg.lstsq(columns * time_s[:, None], np.diff(T_c), rcond=None)
    return max(0.0, float(x[0]))


def as_sampled(
    traces: Mapping[str, Trace], result: Evaluation, period_s: float, alpha_psi_per_k: float, tolerance: SensorTolerance
) -> Evaluation:
    """Return resistance and flux linkage for the mean current, once the inductances and the instant are known."""
    resistance, flux, inductance = result.resistance, result.flux, result.inductance
    assert resistance is not None and inductance is not None
    if flux is None or flux.shown is None:
        return result
    L = (inductance.L_d.value, inductance.L_q.value)
    if inductance.sampling is None:
        # eddy currents show what a late sample does: nothing is corrected, and what one may make of psi_f is inside
        hidden_s = min(0.5 * abs(flux.shown.value_s), HIDDEN_INSTANT_S)
        given = (traces, resistance, period_s, alpha_psi_per_k, tolerance, L)
        now, later = (flux_of(*given, Sampling(instant_s)).psi_measured.value for instant_s in (0.0, hidden_s))
        off = later / now - 1.0
        psi_f, measured = (replace(e, std=math.hypot(e.std, off * e.value)) for e in (flux.psi_f, flux.psi_measured))
        return replace(result, flux=replace(flux, psi_f=psi_f, psi_measured=measured))
    modulation = modulation_of(traces["speeds"], resistance, L, period_s)
    assert modulation is not None
    copper = resistance.copper
    resistance = resistance_as_sampled(resistance, inductance, flux.shown, modulation, copper, tolerance)
    again = flux_of(
        traces, resistance, period_s, alpha_psi_per_k, tolerance, L, inductance.sampling, inductance.apart_s
    )
    return replace(result, resistance=resistance, flux=replace(again, shown=flux.shown))


def magnet_checked(
    traces: Mapping[str, Trace], result: Evaluation, alpha_psi_per_k: float, refused: dict[str, IdentificationError]
) -> Evaluation:
    """Return the result; where the magnets give another flux after the pulses of a flux map, the map is refused.

    psi_f then holds the flux before and after them. Raises IdentificationError: ``E_MAGNET_CHANGED``: it changed by
    more than :data:`MAGNET_MOST`.
    """
    flux = result.flux
    if flux is None or "speeds_after_map" not in traces:
        return result
    windows = traces["speeds"], traces["speeds_after_map"]
    try:
        check_magnet(*windows, flux, alpha_psi_per_k)
        return result
    except IdentificationError as refusal:
        change = magnet_change(*windows, alpha_psi_per_k)
        if not abs(change) <= MAGNET_MOST:
            raise
        refused.setdefault("map", refusal)
    told = f"it changed by {100.0 * change:.2g} % over the pulses of the flux map: warmer, or demagnetised in part"
    psi_f, measured = (
        replace(e, std=math.hypot(e.std, change * e.value), fallback="; ".join(filter(None, (e.fallback, told))))
        for e in (flux.psi_f, flux.psi_measured)
    )
    return replace(result, flux=replace(flux, psi_f=psi_f, psi_measured=measured))


def modulation_of(
    speeds: Trace, resistance: ResistanceResult, L_h: tuple[float, float], period_s: float
) -> Modulation | None:
    """Return what the ripple of the speed run depends on; None where DC link or inductances are not known."""
    U_dc_v = float(speeds.meta.get("U_dc_v", math.inf))
    if not all(L > 0.0 for L in L_h) or not math.isfinite(U_dc_v):
        return None
    return Modulation(U_dc_v, L_h, period_s, resistance.dead_time_s(U_dc_v, period_s))


def flux_of(
    traces: Mapping[str, Trace],
    resistance: ResistanceResult,
    period_s: float,
    alpha_psi_per_k: float,
    tolerance: SensorTolerance | None,
    L_h: tuple[float, float] | None = None,
    sampling: Sampling | None = None,
    apart_s: float = 0.0,
) -> FluxResult:
    """Return the flux linkage, with the resistance at the temperature of the speed run.

    Before the inductances are known (H), rough ones from the ripple serve, and currents count as sampled in time.
    """
    speeds = traces["speeds"]
    T = float(np.mean(speeds["T_winding_c"]))
    return estimate_flux_linkage(
        speeds,
        resistance_warmed(resistance.R_measured, T, resistance.copper),
        period_s=period_s,
        inverter=resistance.curve,
        modulation=modulation_of(
            speeds, resistance, L_h or (_rough_inductance(traces, "d"), _rough_inductance(traces, "q")), period_s
        ),
        lag_s=float(speeds.meta.get("speed_lag_s", 0.0)),
        sampling=sampling,
        apart_s=apart_s,
        tolerance=tolerance,
        T_ref_c=resistance.copper.T_ref_c,
        alpha_psi_per_k=alpha_psi_per_k,
    )


def _rough_inductance(traces: Mapping[str, Trace], axis: str) -> float:
    """Inductance from the ripple of the first shot of an axis, without its delay and resistance; 0 without one (H)."""
    shots = shots_of(traces, axis, 1)
    try:
        return initial_inductance(bare_shot(shots[0], axis)) if shots else 0.0
    except IdentificationError:  # a bad shot refuses L, not what only corrects by it
        return 0.0


def inductance_of(
    traces: Mapping[str, Trace], result: Evaluation, tolerance: SensorTolerance | None = None, U_dc_v: float = math.inf
) -> InductanceResult:
    """Return the incremental inductances, with the frame's angle from the encoder."""
    assert result.resistance is not None and result.encoder is not None
    pole_pairs = round(result.encoder.pole_pairs.value)
    shots = {axis: shots_of(traces, axis, pole_pairs) for axis in "dq"}
    further = {axis: [(shot, 0.0) for shot in shots_of(traces, axis, pole_pairs, "angle")] for axis in "dq"}
    offset = result.offset
    frame = None
    if offset is not None and result.flux is not None:
        ahead = {axis: _frame_ahead(shots[axis], result.encoder, offset.value) for axis in "dq"}
        frame = FrameAhead(ahead["d"], ahead["q"], max(offset.std, 1e-6))
        further = {
            axis: [(shot, _frame_ahead([shot], result.encoder, offset.value)) for shot, _ in there]
            for axis, there in further.items()
        }
    return estimate_inductances(
        shots["d"],
        shots["q"],
        result.noise,
        result.resistance.R_measured.value,
        frame=frame,
        inverter=result.resistance.curve,
        motion=None if result.flux is None else motion_of(traces, result.flux.psi_measured.value, shots["q"]),
        instant=None if result.flux is None else result.flux.shown,
        U_dc_v=U_dc_v,
        tolerance=tolerance,
        further=further,
        unseen_a=0.0 if result.flux is None else abs(result.flux.unseen_a),
    )


def motion_of(traces: Mapping[str, Trace], psi_wb: float, q_shots: Sequence[Trace]) -> Motion | None:
    """Return how the rotor answers an injection on q, from the pushes of the flux run; None without them.

    A push at i_d = 0 shows the acceleration per ampere, 1.5 p^2 psi/J; reluctance takes some of the torque away.
    """
    pushes = [traces[name] for name in ("push_0", "push_1") if name in traces]
    charges = [float(np.sum(push["i_q_a"][8:-8])) * push.period_s for push in pushes]
    if not pushes or min(map(abs, charges)) == 0.0:
        return None
    changes = [float(np.mean(push["omega_e_rad_s"][-16:]) - np.mean(push["omega_e_rad_s"][:16])) for push in pushes]
    rate = float(np.mean([abs(change / charge) for change, charge in zip(changes, charges, strict=True)]))
    rough = [_rough_inductance(traces, axis) for axis in "dq"]
    i_d = float(np.mean([np.mean(shot["i_d_a"]) for shot in q_shots]))
    weakened = max(0.0, psi_wb + (rough[0] - rough[1]) * i_d)
    free, per_f = rate * psi_wb, rate * weakened**2 / psi_wb
    return Motion(per_f, MOTION_STD * per_f + RELUCTANCE_STD * abs(free - per_f))


def shots_of(traces: Mapping[str, Trace], axis: str, pole_pairs: int, kind: str = "square") -> list[Trace]:
    """Return the square-wave shots of one axis, the shorter half period (of ``angle``: the first angle) first."""
    head = f"{kind}_{axis}_"
    names = sorted((name for name in traces if name.startswith(head)), key=lambda name: int(name[len(head) :]))
    return [
        Trace(trace.t_s, trace.signals, trace.units, {**trace.meta, "pole_pairs": pole_pairs})
        for trace in (traces[name] for name in names)
    ]


def _frame_ahead(shots: Sequence[Trace], encoder: EncoderResult, offset: float) -> float:
    """Return the angle of the frozen frame ahead of the rotor's d axis, from where the rotor stood (rad)."""
    pole_pairs = encoder.direction * round(encoder.pole_pairs.value)
    angles = [
        float(shot.meta["fixed_angle_rad"]) - (pole_pairs * float(np.mean(shot["theta_M_rad"])) - offset)
        for shot in shots
    ]
    return math.atan2(sum(map(math.sin, angles)), sum(map(math.cos, angles)))
