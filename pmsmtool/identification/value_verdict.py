# SPDX-License-Identifier: MIT
"""What is recorded of an identification: values with their intervals, whether they are accepted, and what to know.

Without injection each value is judged for itself. What recorded pushes do not tell of some machines, although a number
comes out, is said by name and not given.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.angle_harmonics import ENCODER_ORDERS
from pmsmtool.estimators.cross_check import CrossCheck
from pmsmtool.estimators.encoder import RESTS
from pmsmtool.estimators.estimate import Verdict, coverage_factor, statistical_half_width, total_half_width
from pmsmtool.estimators.injection.inductance import InductanceResult
from pmsmtool.estimators.resistance import at_the_test
from pmsmtool.identification import flux_map, frequency_response
from pmsmtool.identification.completed_machine import CompletedMachine
from pmsmtool.identification.evaluate import NOTABLY_WIDER, Evaluation
from pmsmtool.identification.interval_needs import JUDGED, OFFSET, Need, interval_needs
from pmsmtool.identification.iron_loss import LEAST, iron_loss_lines, iron_loss_of, least_ohm
from pmsmtool.identification.verdicts import KEYS, NOT_ACCEPTED, STEP, Verdicts, verdicts_of
from pmsmtool.identification.wiring import LINK_AT_REST, SUPPLY, WRONG
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import Estimate
from pmsmtool.machine.temperature import WARMING
from pmsmtool.machine.two_masses import INERTIA, LOAD_RATIO, REFUSED, SWING, TORQUE_NOISE, UNSEEN
from pmsmtool.run_directory import Acceptance, Stage
from pmsmtool.units import format_estimate

if TYPE_CHECKING:
    from pmsmtool.identification.request import IdentifyRequest

TOLD_BY: Mapping[str, tuple[str, ...]] = {
    "R": ("R_s_ohm",), "L": ("L_q_app_h",), "psi": ("psi_f_wb",), "encoder": ("offset_rad",), "poles": ("pole_pairs",),
    "mechanics": ("J_per_psi", "J_per_kt"),
}  # fmt: skip
"""Keys of the estimates of which one answers for a quantity."""
NO_SLOW_TURN = (
    "the encoder's error once and twice per turn was not looked for: with --accuracy pole pairs and offset come from "
    "the rotor's rests, without the slow turn"
)
NOT_TOLD = "E_NOT_MEASURED"
BEND_NOTED = 0.15
"""Relative change of L_d from no current to twice the bias (the rated current) from which on a flux map is due, and
which is said of a machine without one: a step to half of that current then meets a mean L_d 4 % off, which is what a
predicted band leaves the loop's gain (a machine of 41 % failed its proof with a gain 11 % off, one of 28 % passed it).
"""
UNSEEN_SHARE = 0.03
"""Current of the legs that no sample holds, of the smallest d current of a coasting, from which on a proof draws what
makes it: it is below 0.005 where neither iron loss nor a late sample is."""


def acceptance_of(
    evaluation: Evaluation, found: Mapping[str, Estimate], machine: MachineFile, asked: Collection[str]
) -> dict[str, Acceptance]:
    """Return what every value is judged by, by its key: what its interval leaves of the design's margins and limits."""
    # the offset of the slow turn alone, which is for the pole pairs, is coarse, and nobody asked for it
    coarse = {OFFSET} if evaluation.flux is None and "encoder" not in asked else set()
    found = at_the_test(found)
    if evaluation.flux is not None and "psi_f_wb" in found:  # loops see the magnets as they were, too
        measured = evaluation.flux.psi_measured
        share = measured.systematic / measured.value
        found["psi_f_wb"] = replace(found["psi_f_wb"], systematic=share * found["psi_f_wb"].value)
    judged = [name for name in JUDGED if name in found and name not in coarse]
    criteria = judged_values({name: found[name] for name in judged}, machine)
    mapped = flux_map.map_acceptance(evaluation.flux_map)
    return criteria | dict(zip(("flux map",), mapped, strict=False))


def had_of(evaluation: Evaluation) -> list[str]:
    """Return the evaluations that gave a result, by the keys of ``Evaluation.refused``."""
    results = {
        "R": evaluation.resistance, "encoder": evaluation.encoder, "L": evaluation.inductance, "psi": evaluation.flux,
        "map": evaluation.flux_map, "mechanics": evaluation.mechanics or evaluation.means.get("tau_c_nm"),
        "frf": evaluation.frequency_response,
        "cogging": evaluation.cogging, "harmonics": evaluation.harmonics,
    }  # fmt: skip
    return [name for name, result in results.items() if result is not None]


STANDS_FOR: Mapping[str, str] = {"L_q_app_h": "L_q_h", "J_per_psi": "J_kgm2"}
"""Values of a drive without injection, and the machine key whose place they take: loops depend on the ratio J/psi."""


def judged_values(found: Mapping[str, Estimate], machine: MachineFile | None) -> dict[str, Acceptance]:
    """Return the criterion of every value by its key: what binds the design of the machine first over its interval.

    Without a machine there is no design; then only an angle has a limit of its own.
    """
    halves = {name: total_half_width(estimate) for name, estimate in found.items()}
    for name, key in STANDS_FOR.items():
        if machine is not None and name in halves and found[name].value:
            halves[key] = halves[name] / abs(found[name].value) * abs(getattr(machine.machine, key) or 0.0)
    needs = interval_needs(machine, halves)
    return {
        name: _accepted(name, estimate, needs.get(STANDS_FOR.get(name, name), ())) for name, estimate in found.items()
    }


def summary_of(evaluation: Evaluation, found: Mapping[str, Estimate], asked: Sequence[str]) -> str:
    """Return the one line of the stage; what was asked for and refused is said by its verdict."""
    values = ", ".join(
        f"{name} {format_estimate(found[name].value, total_half_width(found[name]), found[name].unit)}"
        for name in ("R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb")
        if name in found
    )
    refused = None if "frf" in asked else evaluation.refused.get("frf")
    response = frequency_response.response_summary(evaluation.frequency_response, refused)
    reversed_ = evaluation.encoder is not None and evaluation.encoder.direction < 0
    sign = "; encoder counts against the phase order (two motor leads or its tracks swapped): taken over"
    summary = values + flux_map.map_summary(evaluation.flux_map) + response + (sign if reversed_ else "")
    return summary.removeprefix("; ")


def warnings_of(evaluation: Evaluation, request: IdentifyRequest) -> list[str]:
    """Return what a reader should know about a result that was accepted all the same."""
    lines = []
    if evaluation.supply is not None and evaluation.supply.verdict == WRONG:
        lines.append(f"supply: {evaluation.supply.shown}: {evaluation.supply.likely}")
    if evaluation.resistance is not None and evaluation.resistance.verdict is Verdict.WARN:
        lines.append("R_s: the fit is above its chi-square limit, the interval is widened")
    if evaluation.mismatch is not None and evaluation.mismatch.corrected:
        gains = ", ".join(f"{100.0 * gain:+.2g} %" for gain in evaluation.mismatch.gains)
        lines.append(
            f"the gains of the current sensors of a, b and c are {gains} off their mean: corrected in the values, not "
            "in the drive, whose torque ripples twice per electrical turn"
        )
    lines += [
        f"the encoder is off by {math.degrees(error_rad):.2g} deg (mechanical) {OFTEN[order]} per turn: mounted off "
        "centre? J, B and tau_c of torque pulses are without it"
        for order, error_rad in sorted(_encoder_errors(evaluation).items())
    ]
    if evaluation.encoder is not None and evaluation.encoder.offset.method == RESTS:
        lines.append(NO_SLOW_TURN)
    if evaluation.mechanics is not None and evaluation.mechanics.harmonics.line_rad:
        once = evaluation.mechanics.harmonics.line_rad[0]
        error_rad = max(h.amplitude for h in evaluation.mechanics.harmonics.line_rad)
        lines.append(
            f"the encoder is off by {math.degrees(error_rad):.2g} deg (mechanical) within each of {once.order} lines: "
            "offset or amplitude of its sine and cosine? A slow speed loop follows it"
        )
    flux = evaluation.flux
    if flux is not None and flux.psi_f.systematic > NOTABLY_WIDER * flux.psi_measured.systematic:
        lines.append(
            "psi_f at the reference temperature rests on an assumed temperature coefficient of the magnets: its range, "
            "samarium-cobalt to ferrite, is in the interval; state alpha_psi_per_k and alpha_psi_tolerance_per_k"
        )
    if evaluation.mechanics is not None and evaluation.mechanics.note:
        lines.append(evaluation.mechanics.note)
    lines += iron_loss_lines(evaluation)
    lines += [f"{check.name} {check.verdict}; {IF_APART[check.of]}" for check in evaluation.checks if not check.agrees]
    if evaluation.pairs is not None and not evaluation.pairs.judged:
        lines.append("the phases were not compared: the rotor did not come to rest on the three pairs")
    inductance = evaluation.inductance
    if inductance is not None and inductance.verdict is Verdict.WARN:
        dependent = ", ".join(inductance.frequency_dependent)
        lines.append(f"L: {'depends on frequency on ' + dependent if dependent else 'chi-square above its limit'}")
    if inductance is not None and evaluation.flux_map is None:
        lines += _bend_note(inductance, tried="map" in evaluation.refused)
    if evaluation.flux_map is not None:
        lines += evaluation.flux_map.notes
    return [*lines, *filter(None, [frequency_response.response_note(evaluation.frequency_response)])]


IF_APART = {
    "psi_f_wb": "the inverter's error weighs less at a larger --speed-max; `identify psi` measures again",
    "L_q_h": "flux over current at speed, and its change at standstill, differ where the q axis saturates; "
    "`identify map` measures it, `commission --flux-map` designs with it",
}
"""What to do where a second method disagrees, by the quantity."""


OFTEN = dict(zip(ENCODER_ORDERS, ("once", "twice"), strict=True))


def _encoder_errors(evaluation: Evaluation) -> dict[int, float]:
    """Return the encoder's error (rad) by its order per turn: of a coasting where there is one, else of slow turns."""
    errors_rad: dict[int, float] = {}
    if evaluation.encoder is not None:
        errors_rad = {k: v for k, v in zip(ENCODER_ORDERS, evaluation.encoder.per_turn_rad, strict=False) if v > 0.0}
    errors_rad |= evaluation.encoder_errors
    if evaluation.mechanics is not None:
        errors_rad |= {h.order: h.amplitude for h in evaluation.mechanics.harmonics.encoder_rad}
    return errors_rad


def _bend_note(inductance: InductanceResult, *, tried: bool) -> list[str]:
    """Say that one L_d is not the machine's: the run over speeds shows it where its flux is not small beside psi_f."""
    i_d_a = 2.0 * inductance.L_d.i_d_apk
    change = inductance.d_change(i_d_a)
    if not abs(change) >= BEND_NOTED:
        return []
    what = f"L_d changes by {100.0 * change:+.2g} % from i_d = 0 to {i_d_a:.3g} A: the machine saturates, and a "
    hint = "" if tried else "; `commission --flux-map` designs with its flux map"
    return [f"{what}design with one L_d does not know it{hint}"]


def conditions_of(evaluation: Evaluation, request: IdentifyRequest) -> dict[str, Any]:
    """Return under what the machine was identified, as its file says it."""
    conditions: dict[str, Any] = {
        "shaft": request.shaft,
        "current_gain_tolerance": request.tolerance.current_gain,
        "voltage_gain_tolerance": request.tolerance.voltage_gain,
        "current_scale": request.tolerance.current_scale,
        "voltage_scale": request.tolerance.voltage_scale,
        "noise_apk": evaluation.noise.sigma_a,
        "encoder_noise_rad": evaluation.encoder_noise_rad,
    }
    if request.tolerance.bridge_difference_v is not None:
        conditions["bridge_difference_v"] = request.tolerance.bridge_difference_v
    if evaluation.mismatch is not None and evaluation.mismatch.corrected:
        pairs = zip("abc", evaluation.mismatch.gains, strict=True)
        conditions |= {f"sensor_gain_{phase}_over_mean": 1.0 + gain for phase, gain in pairs}
    if evaluation.inductance is not None and (bend_per_a := evaluation.inductance.axes["d"].bend_per_a):
        conditions["L_d_bend_per_a"] = bend_per_a
    for axis, fit in () if evaluation.inductance is None else evaluation.inductance.axes.items():
        if "eddy" in fit.effects:
            conditions |= {f"eddy_{axis}_s": fit.eddy_s, f"eddy_{axis}_time_s": fit.eddy_tau_s}
    if (least := least_ohm(evaluation)) and iron_loss_of(evaluation) is None:
        conditions[LEAST] = least
    if math.isfinite(evaluation.supply_w):
        conditions[SUPPLY] = evaluation.supply_w
    if math.isfinite(evaluation.U_dc_rest_v):
        conditions[LINK_AT_REST] = evaluation.U_dc_rest_v
    if evaluation.shown is not None:
        conditions["shown_instant_s"] = evaluation.shown.value_s
    flux = evaluation.flux
    if flux is not None and abs(flux.unseen_a) > UNSEEN_SHARE * flux.low_i_d_a:
        conditions["unseen_current_a"] = abs(flux.unseen_a)
    if "frf" in request.measured:
        conditions[frequency_response.SHOWN] = frequency_response.shown_of(evaluation.frequency_response)
    if evaluation.swing_hz:
        conditions[SWING] = evaluation.swing_hz
    if evaluation.unseen_hz:
        conditions[UNSEEN] = evaluation.unseen_hz
    if evaluation.load_ratio:
        conditions[LOAD_RATIO] = evaluation.load_ratio
    if "mechanics" in request.measured and "J_kgm2" not in evaluation.estimates():
        conditions[INERTIA] = REFUSED
    if evaluation.mechanics is not None:
        if evaluation.mechanics.drag is not None:
            conditions["drag_nms2"] = evaluation.mechanics.drag.value
        if evaluation.mechanics.unexplained and not evaluation.mechanics.J.fallback:
            conditions[TORQUE_NOISE] = evaluation.mechanics.ripple
        for name, h in zip(("line", "line_twice"), evaluation.mechanics.harmonics.line_rad, strict=False):
            conditions[f"encoder_{name}_rad"] = h.amplitude
            conditions.setdefault("encoder_lines", h.order)
    conditions |= {f"encoder_{OFTEN[order]}_rad": error for order, error in _encoder_errors(evaluation).items()}
    if evaluation.cogging is not None and evaluation.cogging.harmonics.acceleration_rad_s2:
        largest = max(evaluation.cogging.harmonics.acceleration_rad_s2, key=lambda h: h.amplitude)
        conditions |= {"cogging_nm": evaluation.cogging.J.value * largest.amplitude, "cogging_periods": largest.order}
    if evaluation.resistance is not None and math.isfinite(evaluation.resistance.R_measured.T_c):
        conditions["T_winding_c"] = evaluation.resistance.R_measured.T_c
        conditions[WARMING] = evaluation.warming_k_per_a2s
    return conditions


def value_facts(name: str, estimate: Estimate) -> dict[str, Any]:
    """Return an estimate as a stage records it; numbers that are not finite as None."""
    facts = {key: getattr(estimate, key) for key in ("value", "std", "systematic", "unit", "n", "method", "source")}
    for key in ("chi2", "T_c", "i_d_apk", "i_q_apk"):
        number = getattr(estimate, key)
        facts[key] = number if math.isfinite(number) else None
    halves = {"statistical_95": statistical_half_width(estimate), "total_95": total_half_width(estimate)}
    return {"name": name, **facts, "coverage_factor": coverage_factor(estimate.dof), **halves}


def check_facts(check: CrossCheck) -> dict[str, Any]:
    """Return a second method's estimate as a stage records it, with what it says about the first."""
    facts = value_facts(check.name, check.estimate)
    judged = {"of": check.of, "difference": check.difference, "interval_95": check.half_width, "agrees": check.agrees}
    return {**facts, "method": f"check, {check.estimate.method}: {check.verdict}", "check": judged}


def _accepted(name: str, estimate: Estimate, needs: Sequence[Need]) -> Acceptance:
    half = total_half_width(estimate)
    relative = half / abs(estimate.value) if estimate.value else math.inf
    width = f"{math.degrees(half):.3g} deg" if name == OFFSET else f"{100.0 * relative:.2g} %"
    what = f"{name}: total 95 % interval"
    if not needs:  # no design, or nothing of it depends on the value
        return Acceptance(what, width, "100 %, no design depends on it", relative < 1.0)
    binding = min(needs, key=lambda need: need.reserve)
    return Acceptance(
        what,
        f"{width}, least within it: {binding.what} {_number(binding.worst, binding.unit)}",
        _number(binding.least, binding.unit),
        all(need.ok for need in needs),
    )


def _number(value: float, unit: str) -> str:
    return f"{value:.3g}" if unit == "1" else f"{value:.3g} {unit}"


@dataclass(frozen=True, slots=True)
class Judgement:
    """The criterion of each judged value by its key, and what became of each quantity that was asked for."""

    acceptance: Mapping[str, Acceptance]
    verdicts: Verdicts

    @property
    def rejected(self) -> set[str]:
        """Keys of values whose interval is too wide."""
        return {name for name, line in self.acceptance.items() if not line.ok}

    def kept(self, estimates: Mapping[str, Estimate]) -> dict[str, Estimate]:
        """Return the estimates that are accepted."""
        return without(estimates, self.rejected)


def judged(
    estimates: Mapping[str, Estimate], missing: Mapping[str, str], asked: Sequence[str], machine: MachineFile | None
) -> Judgement:
    """Judge every value by what its interval costs the design of a machine; what is missing is refused by its reason.

    Parameters
    ----------
    estimates : mapping of str to Estimate
        By their keys.
    missing : mapping of str to str
        Keys, separated by commas, and why they cannot be told.
    asked : sequence of str
        Quantities; those that no experiment of these drives tells are left out.
    machine : MachineFile, optional
        The machine with the estimates in it, where it is whole.
    """
    acceptance = judged_values(
        {name: estimate for name, estimate in at_the_test(estimates).items() if name in JUDGED or name in STANDS_FOR},
        machine,
    )
    had = [STEP[name] for name, told in TOLD_BY.items() if set(told) & set(estimates)]
    lacking = {
        STEP[name]: _refusal(why, machine is not None)
        for name, told in TOLD_BY.items()
        for keys, why in missing.items()
        if told[0] in keys.split(", ") and not set(told) & set(estimates)
    }
    return Judgement(acceptance, verdicts_of([name for name in asked if name in TOLD_BY], lacking, had, acceptance))


def _refusal(why: str, stated: bool) -> IdentificationError:
    """Return the error of a quantity that is missing; a reason that has its name keeps it.

    ``stated``: a machine file has it already.
    """
    name, _, text = why.partition(": ")
    reason, what = (name, text) if name.startswith("E_") else (NOT_TOLD, why)
    if ": allow " in what:  # it says what to allow
        return IdentificationError(reason, what, hint="" if stated else "state it in MACHINE")
    more = "allow more current and speed"
    return IdentificationError(reason, what, hint=more if stated else f"state it in MACHINE, or {more}")


def stage_of(
    estimates: Mapping[str, Estimate],
    missing: Mapping[str, str],
    made: CompletedMachine,
    judgement: Judgement,
    source: str,
) -> Stage:
    """Return the stage as it is recorded, without its files."""
    verdicts, rejected = judgement.verdicts, judgement.rejected
    values = [{**value_facts(name, estimate), "accepted": name not in rejected} for name, estimate in estimates.items()]
    summary = ", ".join(
        f"{name} {format_estimate(e.value, total_half_width(e), e.unit)}"
        for name, e in estimates.items()
        if name not in rejected
    )
    said = {key for name in verdicts.refused for key in TOLD_BY[name]}
    lost = [f"{name} not identified: {why}" for name, why in missing.items() if said & set(name.split(", "))]
    unsaid = {name: why for name, why in missing.items() if not said & set(name.split(", "))}
    refused = [f"{name} refused" for name, why in verdicts.refused.items() if why.startswith(NOT_ACCEPTED)]
    fallen = [f"{name}: {estimate.fallback}" for name, estimate in estimates.items() if estimate.fallback]
    given = [f"{source}: {', '.join(made.given)}"] if made.given else []
    return Stage(
        "identify",
        verdicts.status,
        0.0,
        values=[*values, *made.given_values(source)],
        # what is refused is no criterion of the values that go on
        acceptance=[line for line in judgement.acceptance.values() if line.ok or verdicts.status == "fail"],
        fallbacks=[
            *verdicts.lines(),
            *(f"{name}: not available: {why}" for name, why in unsaid.items()),
            *fallen,
            *made.notes,
        ],
        note="" if made.machine is not None else "a part of the machine only: no machine file is written",
        summary="; ".join(filter(None, (summary, *lost, *refused, *given))),
        refused=dict(verdicts.refused),
    )


def with_left_out(stage: Stage, request: IdentifyRequest) -> Stage:
    """Refuse in a stage what was asked for and this drive does not give; each reason is said once."""
    if not request.left_out:
        return stage
    keys = {key for name in request.left_out for key in KEYS.get(name, ())}
    return replace(
        stage,
        status="partial" if stage.status == "pass" else stage.status,
        refused={**stage.refused, **request.left_out},
        fallbacks=[line for line in stage.fallbacks if not set(line.partition(":")[0].split(", ")) <= keys],
    )


def without(estimates: Mapping[str, Estimate], reasons: Iterable[str]) -> dict[str, Estimate]:
    """Return the estimates that are given; the friction goes with the inertia it was told with."""
    left_out = set(reasons)
    left_out |= {"tau_c_per_psi"} if "J_per_psi" in left_out else set()
    return {name: estimate for name, estimate in estimates.items() if name not in left_out}
