# SPDX-License-Identifier: MIT
"""Incremental L_d and L_q at a bias from square-wave shots in a frozen frame (docs/identification.md, 3.2).

Two half periods per axis separate the delay, the sensor lag and the motion of the rotor from L; the frame's offset from
the d axis, known from the flux run, mixes the axes and is undone with the measured inverse inductances

    1/L_d' = cos^2 eps / L_d + sin^2 eps / L_q,    1/L_q' = sin^2 eps / L_d + cos^2 eps / L_q,

each with the angle at which the rotor stood during its own shots.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.current_sensors import Noise
from pmsmtool.estimators.estimate import CHI2_REFUSE, SensorTolerance, Verdict, chi2_gate, condition_gate
from pmsmtool.estimators.injection.angle_dependence import UNSEEN_RANGE, AngleDependence, over_angle
from pmsmtool.estimators.injection.axis_fit import MOST_R, AxisFit, fit_axis
from pmsmtool.estimators.injection.axis_layout import Motion
from pmsmtool.estimators.injection.axis_response import SKIP_SAMPLES, Shot, VoltageError, projected, with_line
from pmsmtool.estimators.injection.sampling_instant import Sampling, ShownInstant
from pmsmtool.estimators.inverter_error import LEG_ANGLES, InverterCurve
from pmsmtool.estimators.shaft.position import position_noise
from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

MODEL_FLOOR = 1e-4
"""Relative standard deviation added for what the model leaves out; docs/identification.md, 4 has 3e-4 where nothing
better is known, here bridge, commutation and rotor have terms of their own."""
FREQUENCY_LIMIT = 0.01
"""Relative difference between two injection frequencies above which both values are reported."""
ROTOR_LIMIT_RAD = math.radians(2.0)
"""Rotor motion in one shot (electrical, beyond one encoder step): mixes the axes by sin^2(2 deg) = 0.12 %."""
INSTANT_LIMIT = 10.0
"""Standard deviations by which square waves and turning machine may differ about the sampling instant before the
interval includes what the difference makes (40 drives: at most 1.1 and, with a dead time of 5.5 % of the period, 4.0;
with 2 kohm of iron loss, where L_q came out 12 % wrong, 41)."""
CHI2_HOPELESS = 300.0
"""Reduced chi-square above which no number is given. Between it and the usual limit the interval is widened (ripple of
3 % of a DC link: 37, L_d 0.1 % off) ..."""
FOLLOWS_WITHIN = 3.0
"""Standard deviations from what pushes say of a rotor's motion beyond which friction holds it, and the fit is free."""
LINES_MOST = 2
"""Sines beside the injection that are taken out of a record, one after the other."""
IN_STEP = 0.2
"""... where a smaller part of the residual than this repeats with the square wave (that ripple: 0.0003; a current that
is clipped: 0.91 to 0.98)."""
MISFIT_MOST = 0.05
"""Residual in step with the square wave, over the response to it (rms), above which a d axis gives no number. The
effect that is missing may be in L as much as it is in the residual: that share is a standard deviation of L (iron and
eddy losses leave 0.3 to 3 %; a current that is clipped, or a rotor that swings, more than 10: such L_q were 1 to 113 %
off at +-16 to 1000, and L_d beside them within 0.04 %)."""
EDGE_STD = 0.05
"""Standard deviation of the instant at which a leg's error depends on its current (T_s): a fifth of its distance."""
EDDY_STD = 5e-3
"""Relative standard deviation of L beside eddy currents, whose branch has one time constant (8 % of iron loss: 0.0 to
0.3 % off; an eddy branch of 10 %: 0.1 %)."""
EDDY_MISFIT_STD = 0.02
"""More of it per root of the reduced chi-square beyond 1: iron loss of 5.6 % beside eddy currents of 6.8 %, which are
two branches, left 1.13 and 1.69 of it, and L_d, L_q 1.4 and 2.5 % off."""
MINIMUM_PERIODS = 20
"""Full periods of the square wave below which a shot is not an excitation."""
CURVE_POINTS = 256
FRAME_LIMIT_RAD = math.radians(30.0)
"""Angle of the frame off the d axis beyond which the axes are not separated: at 45 deg they cannot be."""
ANISOTROPY_LIMIT = 0.03
"""(1/L_d - 1/L_q) over the mean below which the axis angle cannot be told from the inductances."""


@dataclass(frozen=True, slots=True)
class FrameAhead:
    """Angle of the frozen frame ahead of the rotor's d axis during the shots of each axis (rad electrical)."""

    d_rad: float
    q_rad: float
    """During the shots on d and on q: an injection may shake the rotor loose from its friction."""
    std_rad: float
    """Standard deviation of both (they share the encoder offset)."""


@dataclass(frozen=True, slots=True)
class InductanceResult:
    """Incremental inductances and what came with them."""

    L_d: Estimate
    L_q: Estimate
    """Incremental inductances at the bias stated in the estimate (H)."""
    axes: Mapping[str, AxisFit]
    """Fits of the frame's own axes, before the offset is undone."""
    delay: float
    """Sample to acting voltage, mean of both axes (T_s)."""
    lag_s: float
    """Time constant of the current sensor (s)."""
    frequency_dependent: tuple[str, ...]
    """Axes whose inductances differ by more than 1 % between the injection frequencies."""
    axis_angle_rad: float
    """Angle of the frame ahead of the d axis, from the cross responses; NaN for a round machine."""
    verdict: Verdict
    """``warn`` above the chi-square limit or when frequency dependent."""
    sampling: Sampling | None = None
    """When and how currents are sampled, by the best model; None where the flux run did not show the instant."""
    samplings: tuple[tuple[float, Sampling], ...] = ()
    """The same by every model that counts, with its weight. Tuple of (float, Sampling)."""
    apart_s: float = 0.0
    """How far the instants of square waves and turning machine lie apart where they contradict, else 0 (s)."""

    def d_change(self, i_d_a: float) -> float:
        """Return the relative change of L_d from no current to i_d, by its slope at the bias."""
        return i_d_a * self.axes["d"].bend_per_a


def estimate_inductances(
    d_shots: Sequence[Trace],
    q_shots: Sequence[Trace],
    noise: Noise,
    R_ohm: float,
    *,
    frame: FrameAhead | None = None,
    inverter: InverterCurve | None = None,
    motion: Motion | None = None,
    instant: ShownInstant | None = None,
    U_dc_v: float = math.inf,
    tolerance: SensorTolerance | None = None,
    further: Mapping[str, Sequence[tuple[Trace, float]]] | None = None,
    unseen_a: float = 0.0,
) -> InductanceResult:
    """Incremental inductances from square-wave shots.

    Raises IdentificationError: ``E_EXCITATION``, ``E_CLIPPED``, ``E_ROTOR_MOVED``, ``E_MODEL_MISMATCH``,
    ``E_NOT_IDENTIFIABLE``.

    Parameters
    ----------
    d_shots, q_shots : sequence of Trace
        ``i_d_a i_q_a theta_M_rad`` (and ``flagged``) and the voltage of their axis, in a frozen frame;
        ``meta["half_period"]`` in samples, ``meta["fixed_angle_rad"]``, ``meta["pole_pairs"]``, ``meta["T_winding_c"]``
        where there is a sensor.
    noise : Noise
        From the zero-current trace.
    R_ohm : float
        Loop resistance (ohm).
    frame : FrameAhead or None
        Where the rotor stood, with the encoder offset of the flux run. None: taken from the cross responses where the
        machine is salient enough, and said so in ``fallback``.
    inverter : InverterCurve or None
        Voltage error from the DC levels.
    motion : Motion or None
        How the rotor follows an injection on q, from the flux run and the pushes; None: free in the fit.
    instant : ShownInstant or None
        What the flux run shows of the instant at which currents are sampled.
    U_dc_v : float
        DC link (V): height of the bridge's pulses; infinite: the mean voltage is taken for all of a period.
    tolerance : SensorTolerance
        Declared sensor tolerances.
    further : mapping of str to sequence of (Trace, float), optional
        Shots at more angles of the rotor by axis, with the shortest half period, and the angle of the frame ahead
        of the rotor's d axis during each (rad electrical): L is then the mean over the angle.
    unseen_a : float
        Current of the legs that no sample holds, of which iron loss makes the most (A); 0: nothing shows one.
    """
    tolerance = tolerance or SensorTolerance()
    traces = {"d": d_shots, "q": q_shots}
    shots: dict[str, list[Shot]] = {}
    for axis, records in traces.items():
        found = (_shot(record, axis, inverter, U_dc_v, f"inductance, {axis} axis") for record in records)
        shots[axis] = sorted(found, key=lambda shot: shot.half_period)
    fits = _fitted(shots, noise.sigma_a, R_ohm, motion, instant)
    for axis, fit in fits.items():
        condition_gate(fit.condition, f"L_{axis} and the delay", f"inductance, {axis} axis")
    cross = {axis: _cross_response(shots[axis][0], fit, noise.sigma_a) for axis, fit in fits.items()}
    misfit, apart_s = dict.fromkeys(fits, 0.0), 0.0
    if instant is not None and any(
        not instant.knows(f.delay) or abs(instant.distance(f.delay, f.lag_s)) > INSTANT_LIMIT for f in fits.values()
    ):
        # what a turning machine shows is then not the instant alone, and square waves alone may err as well
        alone = _fitted(shots, noise.sigma_a, R_ohm, motion, None)
        misfit = {axis: abs(alone[axis].L_h - fit.L_h) for axis, fit in fits.items()}
        apart_s = max(abs(instant.distance(fit.delay, fit.lag_s)) for fit in fits.values()) * instant.std_s
        if any("eddy" in fit.effects for fit in alone.values()):
            # iron loss turns the voltage of a turning machine, as an instant would; what cannot follow says nothing
            follow = {a: fit.chi2 <= CHI2_REFUSE and instant.knows(fit.delay) for a, fit in fits.items()}
            # a delay t that no drive has, beside eddy currents, stands for a branch that is late, and 1.1 to 2.1 R t of
            # L are missing (currents of 0.05 to 0.35 T_s/L per voltage, half a period to one late)
            late_h = {a: R_ohm * instant.outside(fit.delay) * instant.period_s for a, fit in alone.items()}
            misfit = {a: math.hypot(m * follow[a], late_h[a]) for a, m in misfit.items()}
            fits, instant = alone, None
        elif max((fits[a].chi2 - fit.chi2) * fit.n for a, fit in alone.items()) > INSTANT_LIMIT**2:
            fits, misfit, instant = alone, dict.fromkeys(alone, 0.0), replace(instant, value_s=0.0)  # an old angle
    widen = {axis: _widening(fit, shots[axis], noise.sigma_a, axis) for axis, fit in fits.items()}
    # the q axis was fitted with what the d axis says; where no model of it fits, that alone counts
    timed = fits["d" if widen["q"][2] > MISFIT_MOST else "q"]
    misfit = {axis: math.hypot(misfit[axis], widen[axis][2] * fit.L_h) for axis, fit in fits.items()}
    angle, angle_std = _axis_angle(fits, cross)
    fallback = ""
    if frame is None:
        if math.isfinite(angle):
            frame, fallback = FrameAhead(angle, angle, angle_std), "frame offset from the cross responses"
        else:
            frame, fallback = FrameAhead(0.0, 0.0, 0.0), "frame offset unknown, machine nearly round: axes as they are"
    values, stds = _unmix(fits, {axis: factor for axis, (_, factor, _) in widen.items()}, frame)
    stood = {axis: float(records[0].meta["fixed_angle_rad"]) for axis, records in traces.items()}
    uneven = _over_angle(fits, shots, further or {}, inverter, U_dc_v, frame, stood, values, unseen_a)
    biases = {"d": _bias(d_shots, frame.d_rad), "q": _bias(q_shots, frame.q_rad)}
    dependent = tuple(a for a, f in fits.items() if np.ptp(f.L_by_shot_h) > FREQUENCY_LIMIT * f.L_by_shot_h[0])
    estimates = {
        axis: Estimate(
            value=values[axis],
            std=math.hypot(
                stds[axis],
                misfit[axis],
                MODEL_FLOOR * values[axis],
                tolerance.voltage_scale_std * values[axis],
                _commutation_std(shots[axis]),
                _unseen_std(shots[axis][0], unseen_a) * values[axis],
                _eddy_std(fits[axis]) * values[axis],
                _resistance_std(fits[axis], shots[axis][0], R_ohm),
            ),
            systematic=math.hypot(
                tolerance.impedance * values[axis], R_ohm * tolerance.encoder_latency_s * (instant is not None)
            ),
            unit="H",
            n=fits[axis].n,
            chi2=fits[axis].chi2,
            T_c=_temperature(traces[axis]),
            method="square wave on d bias, output error, incremental",
            i_d_apk=biases[axis][0],
            i_q_apk=biases[axis][1],
            fallback=fallback,
        )
        for axis in fits
    }
    estimates = {axis: _with_angle(L, uneven.get(axis)) for axis, L in estimates.items()}
    # an angle that is old shows what a late sample does and leaves L larger by R t: L is the middle, both are inside
    half_h = 0.5 * R_ohm * (0.0 if instant is None else max(0.0, instant.value_s))
    estimates = {a: replace(L, value=L.value + half_h, systematic=L.systematic + half_h) for a, L in estimates.items()}
    return InductanceResult(
        L_d=estimates["d"],
        L_q=estimates["q"],
        axes=fits,
        delay=0.5 * (fits["d"].delay + fits["q"].delay),
        lag_s=0.5 * (fits["d"].lag_s + fits["q"].lag_s),
        frequency_dependent=dependent,
        axis_angle_rad=angle,
        verdict=Verdict.WARN if dependent or any(v is Verdict.WARN for v, *_ in widen.values()) else Verdict.PASS,
        sampling=None if instant is None else instant.sampling(timed.delay, timed.lag_s),
        samplings=tuple((w, instant.sampling(delay, lag)) for w, delay, lag in timed.places if instant is not None),
        apart_s=apart_s,
    )


def _over_angle(
    fits: Mapping[str, AxisFit], shots: Mapping[str, Sequence[Shot]],
    further: Mapping[str, Sequence[tuple[Trace, float]]], inverter: InverterCurve | None, U_dc_v: float,
    frame: FrameAhead, frames_rad: Mapping[str, float], L_h: Mapping[str, float], unseen_a: float,
) -> dict[str, AngleDependence]:  # fmt: skip
    """Return by axis how its inductance depends on the angle of the rotor, where that was measured.

    What counts is where the rotor stood: cogging and bias turn it away from the frame, which then sees a part of the
    other axis, of the inductances ``L_h``.
    """
    found = {}
    for axis, records in further.items():
        stage = f"inductance over the angle, {axis} axis"
        if any(abs(ahead) > FRAME_LIMIT_RAD for _, ahead in records):
            continue
        try:
            others = [_shot(record, axis, inverter, U_dc_v, stage) for record, _ in records]
        except IdentificationError:
            continue  # a rotor that moved there, or a limited voltage: L is that of its own angle
        inverse = {name: 1.0 / L for name, L in L_h.items()}
        across = inverse["q" if axis == "d" else "d"] / inverse[axis] - 1.0
        aheads = [frame.d_rad if axis == "d" else frame.q_rad, *(ahead for _, ahead in records)]
        here, *mixed = (-math.log1p(across * math.sin(ahead) ** 2) for ahead in aheads)
        stood = [frames_rad[axis], *(float(record.meta["fixed_angle_rad"]) for record, _ in records)]
        angles = [frame_rad - ahead for frame_rad, ahead in zip(stood, aheads, strict=True)]
        if others:
            std = max(_unseen_std(shot, unseen_a) for shot in others)
            found[axis] = over_angle(fits[axis], shots[axis][0], others, angles, [there - here for there in mixed], std)
    return found


def _with_angle(L: Estimate, at: AngleDependence | None) -> Estimate:
    """Return an inductance as the mean over the angle. A controller of one L meets all: how far it goes is inside."""
    at = at or AngleDependence(1.0, UNSEEN_RANGE)
    seen = "mean over the angle, it changes by" if at.mean != 1.0 else "no change over the angle seen nor excluded:"
    told = f"{seen} {100.0 * at.spread:.2g} %" if at.spread else ""
    return replace(
        L,
        value=at.mean * L.value,
        std=at.mean * L.std,
        systematic=math.hypot(at.mean * L.systematic, at.spread * at.mean * L.value),
        fallback="; ".join(filter(None, (told, L.fallback))),
    )


def _fitted(
    shots: dict[str, list[Shot]], sigma_a: float, R_ohm: float, motion: Motion | None, instant: ShownInstant | None
) -> dict[str, AxisFit]:
    """Fit both axes, d first; where a fit leaves sines that are not the injection's, again without these."""
    fits: dict[str, AxisFit] = {}
    for axis in "dq":
        torque, d = axis == "q", fits.get("d")
        fit = partial(fit_axis, sigma_a=sigma_a, R_guess=R_ohm, torque=torque, other=d, instant=instant)
        for _ in range(LINES_MOST + 1):
            fits[axis] = fit(shots[axis], motion=motion)
            if motion and torque and abs(fits[axis].motion_per_f - motion.per_f) > FOLLOWS_WITHIN * motion.std_per_f:
                motion, fits[axis] = None, fit(shots[axis])
            found = [with_line(shot, r) for shot, r in zip(shots[axis], fits[axis].residuals, strict=True)]
            if all(new is old for new, old in zip(found, shots[axis], strict=True)):
                break
            shots[axis] = found
    return fits


def _eddy_std(fit: AxisFit) -> float:
    """Relative standard deviation beside eddy currents: more, where a residual shows that one branch is not all."""
    if "eddy" not in fit.effects:
        return 0.0
    return EDDY_STD + EDDY_MISFIT_STD * math.sqrt(max(0.0, fit.chi2 - 1.0))


def _resistance_std(fit: AxisFit, shot: Shot, R_ohm: float) -> float:
    """What a resistance beyond the loop's stands for in L (H): what it drops over half of a half period.

    Two branches of iron loss, 3 and 7 %, left 1.6 of the loop's R beside the one of the model, and L_q 2.6 % off.
    """
    return 0.5 * shot.half_period * shot.period_s * max(0.0, fit.R_ohm - MOST_R * R_ohm)


def _widening(fit: AxisFit, shots: Sequence[Shot], sigma_a: float, axis: str) -> tuple[Verdict, float, float]:
    """Return the verdict of a fit, the factor on its standard deviation, and a relative one to be added.

    A residual that is not in step with the square wave is noise of another kind, and widens. One that is belongs to an
    effect that the model lacks. A q axis that none describes leaves L_d as it is, and L_q with an interval by which the
    design judges it; the delay of a d axis would be in both.
    """
    stage = f"inductance, {axis} axis"
    if not CHI2_REFUSE < fit.chi2:
        return *chi2_gate(fit.chi2, stage), 0.0
    parts = list(zip(fit.residuals, shots, strict=True))
    if fit.chi2 < CHI2_HOPELESS and max(_in_step(residual, 2 * shot.half_period) for residual, shot in parts) < IN_STEP:
        return Verdict.WARN, math.sqrt(fit.chi2), 0.0
    shares = [
        sigma_a * float(np.std(residual)) / float(np.std(projected(shot.i_a[SKIP_SAMPLES:], shot.slow_basis())))
        for residual, shot in parts
    ]
    if axis == "d" and max(shares) > MISFIT_MOST:
        chi2_gate(fit.chi2, stage)
    return Verdict.WARN, math.sqrt(fit.chi2), max(shares)


def _in_step(residual: Array, period: int) -> float:
    """Part of a residual's power that repeats with a period (samples)."""
    count = len(residual) // period
    mean = residual[: count * period].reshape(count, period).mean(axis=0)
    return float(mean @ mean) / period / float(np.mean(residual**2))


def _bias(traces: Sequence[Trace], ahead_rad: float) -> tuple[float, float]:
    """Mean current in the rotor's own frame (A)."""
    i_d, i_q = (float(np.mean([np.mean(trace[name]) for trace in traces])) for name in ("i_d_a", "i_q_a"))
    c, s = math.cos(ahead_rad), math.sin(ahead_rad)
    return c * i_d - s * i_q, s * i_d + c * i_q


def _commutation_std(shots: Sequence[Shot]) -> float:
    """What an inverter error that depends on the current adds to L (H).

    What depends on the current acts at one switching edge (``VoltageError``); where that edge lies is known to
    :data:`EDGE_STD` of a period, and a slope de/di there looks like an inductance of |de/di| T_s times that.
    """
    return max(EDGE_STD * slope * shot.period_s for shot in shots for slope in _slopes(shot))


def _unseen_std(shot: Shot, unseen_a: float) -> float:
    """Relative standard deviation of L by what a current that no sample holds makes of the inverter's error."""
    return sum(_slopes(shot)) * unseen_a / float(np.mean(np.abs(shot.u_v - np.mean(shot.u_v))))


def _slopes(shot: Shot) -> list[float]:
    """Slopes of both parts of an inverter's error over the currents of a shot (ohm)."""
    if shot.error is None:
        return [0.0]
    ends = np.array([np.min(shot.i_a), np.max(shot.i_a)])
    parts = shot.error.early_v, shot.error.late_v
    return [abs(float(np.ptp(np.interp(ends, shot.error.i_a, part)) / np.ptp(ends))) for part in parts]


def bare_shot(trace: Trace, axis: str) -> Shot:
    """Return a record as a shot, unchecked and without an inverter's error."""
    other = "q" if axis == "d" else "d"
    signals = trace[f"u_{axis}_v"], trace[f"i_{axis}_a"], trace[f"i_{other}_a"]
    return Shot(*signals, int(trace.meta["half_period"]), trace.period_s)


def _shot(trace: Trace, axis: str, inverter: InverterCurve | None, U_dc_v: float, stage: str) -> Shot:
    half_period = int(trace.meta["half_period"])
    if len(trace) < SKIP_SAMPLES + 2 * half_period * MINIMUM_PERIODS:
        few = f"{len(trace)} samples hold fewer than {MINIMUM_PERIODS} periods of {2 * half_period}"
        raise refuse("E_EXCITATION", few, stage=stage)
    if "flagged" in trace.signals and np.any(trace["flagged"] > 0.0):
        raise refuse("E_CLIPPED", f"{int(np.sum(trace['flagged'] > 0.0))} samples limited or clipped", stage=stage)
    way = math.degrees(rotor_way(float(trace.meta["pole_pairs"]) * trace["theta_M_rad"]))
    if way > (most := math.degrees(ROTOR_LIMIT_RAD)):
        raise refuse("E_ROTOR_MOVED", f"the rotor moved by {way:.2g} deg (electrical), limit {most:g} deg", stage=stage)
    shot, error = bare_shot(trace, axis), None
    if inverter is not None:
        i, across_a = shot.i_a, float(np.mean(shot.cross_a))
        margin = 0.2 * float(np.ptp(i))
        grid = np.linspace(float(np.min(i)) - margin, float(np.max(i)) + margin, CURVE_POINTS)
        frame = float(trace.meta["fixed_angle_rad"])
        error = VoltageError(grid, *inverter.along_axis(frame, axis, grid, across_a, float(np.mean(i))))
    return replace(shot, error=error, pulse_v=_pulse_height(float(trace.meta["fixed_angle_rad"]), axis, U_dc_v))


def _pulse_height(frame_rad: float, axis: str, U_dc_v: float) -> float:
    """Mean voltage along an axis while the legs differ (V): a command u makes pulses of the share u over this."""
    legs = np.cos(frame_rad + (0.0 if axis == "d" else 0.5 * math.pi) - LEG_ANGLES)
    return U_dc_v / float(np.ptp(legs))


def rotor_way(theta_e: Array) -> float:
    """Return how far the rotor went in a record (rad electrical), beyond an encoder's step and scatter."""
    moves = np.abs(np.diff(theta_e))
    moves = moves[moves > 1e-9]
    step = float(np.min(moves)) if len(moves) else 0.0
    # what the encoder scatters is no motion: as far as so many normal numbers reach to both sides
    scatter = 2.0 * position_noise(theta_e) * math.sqrt(2.0 * math.log(len(theta_e)))
    return float(np.ptp(theta_e)) - max(step, scatter)


def _cross_response(shot: Shot, fit: AxisFit, sigma_a: float) -> tuple[float, float]:
    """Current of the other axis per current of the injected one, and its standard deviation."""
    slow = shot.slow_basis()
    main = shot.i_a[SKIP_SAMPLES:] + fit.residuals[0] * sigma_a  # the modelled current carries no noise
    main = main - slow @ (slow.T @ main)
    other = shot.cross_a[SKIP_SAMPLES:]
    other = other - slow @ (slow.T @ other)
    power = float(main @ main)
    return float(main @ other) / power, sigma_a / math.sqrt(power)


def _axis_angle(fits: Mapping[str, AxisFit], cross: Mapping[str, tuple[float, float]]) -> tuple[float, float]:
    """Angle of the frame ahead of the d axis, from all four responses (rad).

    The bias holds the rotor within 45 degrees. The d axis has the largest 1/L on most machines, the smallest on some.
    """
    g_d, g_q = 1.0 / fits["d"].L_h, 1.0 / fits["q"].L_h
    weights = [1.0 / (g_d * cross["d"][1]) ** 2, 1.0 / (g_q * cross["q"][1]) ** 2]
    g_dq = (weights[0] * g_d * cross["d"][0] + weights[1] * g_q * cross["q"][0]) / sum(weights)
    std = 1.0 / math.sqrt(sum(weights))
    difference = math.hypot(g_d - g_q, 2.0 * g_dq)
    if difference < ANISOTROPY_LIMIT * (g_d + g_q):
        return math.nan, math.nan
    # frame ahead by eps: G' = R(-eps) G R(eps), so 2 g_dq = -(g_d - g_q)_true sin(2 eps)
    return 0.5 * math.atan2(-math.copysign(2.0, g_d - g_q) * g_dq, abs(g_d - g_q)), std / difference


def _unmix(
    fits: Mapping[str, AxisFit], widen: Mapping[str, float], frame: FrameAhead
) -> tuple[dict[str, float], dict[str, float]]:
    """Undo the frame offset; standard deviations by first-order propagation."""

    def unmixed(L_d: float, L_q: float, shift: float) -> tuple[float, float]:
        s_d, s_q = math.sin(frame.d_rad + shift) ** 2, math.sin(frame.q_rad + shift) ** 2
        g_d, g_q = 1.0 / L_d, 1.0 / L_q
        determinant = 1.0 - s_d - s_q
        return determinant / ((1.0 - s_q) * g_d - s_d * g_q), determinant / ((1.0 - s_d) * g_q - s_q * g_d)

    eps = max(frame.d_rad, frame.q_rad, key=abs)
    if abs(eps) > FRAME_LIMIT_RAD:
        raise refuse(
            "E_NOT_IDENTIFIABLE",
            f"the frame is {math.degrees(eps):.3g} deg off the d axis: L_d and L_q cannot be separated",
            stage="inductance",
            likely="wrong encoder offset",
            hint="check the coupling of the encoder and its increments per turn, then repeat",
        )
    L = {axis: fit.L_h for axis, fit in fits.items()}
    std = {axis: fit.std_h * widen[axis] for axis, fit in fits.items()}
    values = unmixed(L["d"], L["q"], 0.0)
    shifted = [
        unmixed(L["d"] + std["d"], L["q"], 0.0),
        unmixed(L["d"], L["q"] + std["q"], 0.0),
        unmixed(L["d"], L["q"], frame.std_rad),
    ]
    spread = [math.sqrt(sum((row[k] - values[k]) ** 2 for row in shifted)) for k in (0, 1)]
    return {"d": values[0], "q": values[1]}, {"d": spread[0], "q": spread[1]}


def _temperature(traces: Sequence[Trace]) -> float:
    values = [float(trace.meta["T_winding_c"]) for trace in traces if "T_winding_c" in trace.meta]
    values += [float(np.mean(trace["T_winding_c"])) for trace in traces if "T_winding_c" in trace.signals]
    return float(np.mean(values)) if values else math.nan
