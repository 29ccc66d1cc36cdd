# SPDX-License-Identifier: MIT
"""What the traces of drives without injection tell: estimates, the machine file, and the judged stage.

Everything follows from the stored traces, the request and :class:`PulseFacts`, so that a replay gives the same bytes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal

import numpy as np

from pmsmtool.cia402 import LEAST_LINK_V
from pmsmtool.errors import ConfigError, IdentificationError, NotAvailable, PmsmtoolError
from pmsmtool.estimators.encoder import EncoderResult, estimate_encoder
from pmsmtool.estimators.estimate import SENSOR_GAIN_TOLERANCE, SensorTolerance, total_half_width
from pmsmtool.estimators.flux.linkage import normalised as flux_at_reference
from pmsmtool.estimators.flux.voltage_flux import flux_by_undriven_voltage, flux_by_voltage_limit
from pmsmtool.estimators.recorded_push import PushResult, estimate_pushes
from pmsmtool.estimators.resistance import R_MEASURED, Copper, copper_of
from pmsmtool.estimators.resistance import normalised as resistance_at_reference
from pmsmtool.estimators.shaft.inertia_ratio import BLOCKS, LEAST_PUSHES, SKIP_SHARE, estimate_ratios
from pmsmtool.estimators.shaft.position import offset_by_turns
from pmsmtool.files import read_text
from pmsmtool.identification.calibration import calibrated_traces
from pmsmtool.identification.completed_machine import completed_machine
from pmsmtool.identification.evaluate import tolerance_on
from pmsmtool.identification.request import MACHINE, REQUEST, IdentifyRequest, Method, place_of
from pmsmtool.identification.supply_power import resistance_by_supply
from pmsmtool.identification.value_verdict import TOLD_BY, judged, stage_of
from pmsmtool.identification.wiring import breaks_in, judge_pulses
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.machine.parameters import Estimate, InverterParameters
from pmsmtool.machine.temperature import MAGNET_ALPHA_PER_K, magnet_tolerance_per_k
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.report.verdict import ENCODER_SIGN as SIGN
from pmsmtool.run_directory import RunDirectory, Stage
from pmsmtool.trace import Trace, read_trace
from pmsmtool.units import RPM_PER_RAD_S

FACTS, OLDER_FACTS = "level.json", "tier.json"
"""What the estimates depend on besides traces, request and nameplate; its older name is still read."""
UTILISATION = 1.0 / math.sqrt(3.0)
"""Largest phase voltage amplitude over the DC link where no machine file says it."""
NO_RESISTANCE = "the inverter's error at running currents hides it on this drive; needs current set-points"
NO_POWER = "needs a recorder of voltages, or a bench supply whose power a person reads (`identify R --supply`)"
SUPPLY_LEVELS = "supply_levels"
"""Name of the trace of a bench supply's readings."""
NO_VOLTAGE = "needs injection, or a recorder of voltages at loop rate"
NO_POLE_PAIRS = "needs the pole pairs: mode 11, an object in the drive's map, or a machine file"
BY_ANGLE = ("poles", "encoder")
"""What a drive without injection tells by a vector that its mode 11 turns."""
NO_LINK = "needs the DC link (0x6079) or the machine's voltage"
TOO_WIDE = "E_NOT_IDENTIFIABLE"
"""Refusal of ratios whose interval is too wide: the flux linkage beside them stands, and the chain goes on."""
LEAST_ROWS = math.ceil(BLOCKS / (1.0 - SKIP_SHARE))
"""Readings without which a torque pulse has no block for each speed."""
LIGHT_SHAFT = (
    "a bare shaft with little inertia, or little current: the torque that is safe if the tool fails hardly exceeds "
    "friction"
)
LATE_CURRENT = (
    "loops of the drive that bring its current up too slowly: {:.0f} % of what was asked for flowed in the second half "
    "of the torque pulses; or an open phase (`pmsmtool check`)"
)
ARRIVED = 0.5
"""Share of the current asked for below which that is the cause: 0.2 where J came out negative, 0.9 and more else."""
ADD_INERTIA = (
    "couple an inertia to the shaft and say --shaft coupled, or allow more (--speed-max, --i-max, the drive's own "
    "limits)"
)
CHECK_WIRING = "switch off and measure the three line-line resistances; `pmsmtool check` looks at the wiring"
REFUSED_AS = {
    "phases": ("E_PHASE_OPEN", CHECK_WIRING),
    "current sensors": (
        "E_CURRENT_SENSOR",
        "name what shows the torque current in a map ([motion], current)",
    ),
}
"""What of the pulses takes every number along: the name of the refusal, and the next step."""
TAKES_ALL = {name for name, _ in REFUSED_AS.values()}
BY_PUSH = "J_per_psi, psi_f_wb"
UNDECIDED = (
    "no source says whether this drive's amperes are peak or rms: the interval holds for both; a map of your own may "
    "say it (rated_current)"
)
Voltage = Literal["machine", "link", ""]


def current_share(pushes: Sequence[Trace]) -> float:
    """Return what of the current asked for flowed in the second half of the pulses, their median; 1 where none says."""
    asked = [(push, float(push.meta.get("i_command_a", 0.0))) for push in pushes]
    shares = [float(np.mean(push["i_q_a"][len(push) // 2 :])) / command for push, command in asked if command]
    return float(np.median(shares)) if shares else 1.0


@dataclass(frozen=True, slots=True)
class PulseResult:
    """Estimates of a run without injection."""

    estimates: Mapping[str, Estimate]
    """By the keys of a machine file."""
    missing: Mapping[str, str]
    """What was asked and cannot be told, with the reason."""


@dataclass(frozen=True, slots=True)
class PulseFacts:
    """What a run without injection was, besides its traces."""

    kind: Method
    """``recorder``: recorded pushes; ``standard``: a turned vector, polled pushes."""
    period_s: float = 0.0
    """Control period of a recorder (s)."""
    pole_pairs: int = 0
    """As given, or as the drive's set says; 0 where only the turned vector tells them."""
    T_winding_c: float | None = None
    T_magnet_c: float | None = None
    """What the drive showed (degC)."""
    pushed: bool = False
    """Whether the shaft was pushed by torque."""
    voltage: Voltage = ""
    """What ``psi_f`` is told by: the ``machine`` voltage, the DC ``link`` at the limit, or neither."""
    top_rpm: float = 0.0
    U_dc_v: float = 0.0
    """Speed no run-up goes beyond, and the DC link as the drive shows it."""
    source: str = ""
    """Where what completes the values comes from (``nameplate.toml``); empty: nothing does."""
    traces: tuple[str, ...] = ()
    """Names of the traces in the order they were taken."""
    current_undecided: bool = False
    """Whether no source says if the drive's amperes are peak or rms; they were read as rms."""
    limit: str = ""
    """What is said of a current limit that was not proven."""
    no_vector: str = ""
    """Why no vector was turned, where the drive announces that it can be."""
    no_push: str = ""
    """Why the pushes told nothing, where something else was measured."""


def pulse_result(
    traces: Mapping[str, Trace],
    facts: PulseFacts,
    tolerance: SensorTolerance | None = None,
    inverter: InverterParameters | None = None,
    psi_f_wb: float = 0.0,
    copper: Copper | None = None,
    alpha_psi_per_k: float = MAGNET_ALPHA_PER_K,
) -> PulseResult:
    """Estimate from traces.

    Raises IdentificationError: a trap is seen; a single quantity that cannot be told is in ``missing``.

    Parameters
    ----------
    traces : mapping of str to Trace
        In the order they were taken.
    facts : PulseFacts
        Of the run.
    tolerance : SensorTolerance, optional
        Declared sensor tolerances.
    inverter : InverterParameters, optional
        Its voltage utilisation and dead time, where known.
    psi_f_wb : float
        Flux linkage as given (Wb); 0: none is. It tells how fast a run without voltage limit should have been.
    copper : Copper, optional
        Reference temperature, and what is known of the winding's temperature coefficient.
    alpha_psi_per_k : float
        Temperature coefficient of the flux linkage (1/K).
    """
    tolerance = tolerance or SensorTolerance()
    if tolerance.bridge_difference_v is not None:
        shown = facts.U_dc_v >= LEAST_LINK_V
        tolerance = tolerance_on(tolerance, facts.U_dc_v if shown else math.inf)
    traces = calibrated_traces(traces, tolerance)
    if facts.kind == Method.RECORDER:
        return _by_recorder(traces, facts, tolerance, copper or Copper(), alpha_psi_per_k)
    estimates: dict[str, Estimate] = {}
    if SUPPLY_LEVELS in traces:
        R = resistance_by_supply(traces[SUPPLY_LEVELS], tolerance=tolerance)
        estimates["R_s_ohm"] = replace(resistance_at_reference(R, copper or Copper(), tolerance), dof=R.dof)
        estimates[R_MEASURED] = R
    if "rotation_backward" in traces:
        found = estimate_encoder(traces["rotation_forward"], traces["rotation_backward"])
        estimates |= encoder_estimates(found, traces)
    missing: dict[str, str] = {}
    if facts.pushed:
        pole_pairs = round(estimates["pole_pairs"].value) if "pole_pairs" in estimates else facts.pole_pairs
        try:
            pushed, missing = _by_torque(traces, replace(facts, pole_pairs=pole_pairs), tolerance, inverter, psi_f_wb)
        except IdentificationError as error:
            if not estimates or error.reason in TAKES_ALL:
                raise
            pushed, missing = {}, {BY_PUSH: why_no_push(error)}
        estimates |= pushed
        missing = {name: why for name, why in missing.items() if name not in estimates}
    return PulseResult(estimates, missing | ({"offset_rad": facts.no_vector} if facts.no_vector else {}))


def why_no_push(error: PmsmtoolError) -> str:
    """Return why the pushes told nothing."""
    return f"{error.what} (likely {error.likely})" if error.likely else error.what


def _by_recorder(
    traces: Mapping[str, Trace], facts: PulseFacts, tolerance: SensorTolerance, copper: Copper, alpha_psi_per_k: float
) -> PulseResult:
    pushes = list(traces.values())
    found = estimate_pushes(pushes, period_s=facts.period_s, pole_pairs=facts.pole_pairs, tolerance=tolerance)
    T_winding_c, T_magnet_c = (math.nan if T is None else T for T in (facts.T_winding_c, facts.T_magnet_c))
    estimates = push_estimates(found)
    if "R_s_ohm" in estimates:
        R = replace(estimates["R_s_ohm"], T_c=T_winding_c)
        estimates["R_s_ohm"] = replace(resistance_at_reference(R, copper, tolerance), dof=R.dof)
        estimates[R_MEASURED] = R
    psi = replace(estimates["psi_f_wb"], T_c=T_magnet_c)
    estimates["psi_f_wb"] = flux_at_reference(psi, copper.T_ref_c, alpha_psi_per_k, tolerance)
    missing = {} if "R_s_ohm" in estimates else {"R_s_ohm": NO_RESISTANCE}
    try:
        estimates |= estimate_ratios(pushes, pole_pairs=facts.pole_pairs, tolerance=tolerance)
    except IdentificationError as error:
        missing["J_per_psi"] = error.what
    return PulseResult(estimates, missing)


def _by_torque(
    traces: Mapping[str, Trace],
    facts: PulseFacts,
    tolerance: SensorTolerance,
    inverter: InverterParameters | None,
    psi_f_wb: float,
) -> tuple[dict[str, Estimate], dict[str, str]]:
    pushes = [trace for name, trace in traces.items() if name.startswith("torque_push")]
    pole_pairs = facts.pole_pairs
    missing = {"R_s_ohm": NO_POWER, "L_d_h, L_q_h": NO_VOLTAGE}
    estimates: dict[str, Estimate] = {}
    too_wide: IdentificationError | None = None
    for wrong in judge_pulses(pushes):
        if wrong.looked_at in REFUSED_AS:
            name, hint = REFUSED_AS[wrong.looked_at]
            raise IdentificationError(name, wrong.shown, where="torque pulses", likely=wrong.likely, hint=hint)
        missing[SIGN] = f"{wrong.shown} (likely {wrong.likely}; try: `pmsmtool check`)"
    try:
        estimates = estimate_ratios(pushes, pole_pairs=pole_pairs or 1, tolerance=tolerance)
    except IdentificationError as error:
        enough = sum(len(push) >= LEAST_ROWS for push in pushes)
        if error.reason == "E_EXCITATION" and enough < LEAST_PUSHES <= len(pushes):
            raise IdentificationError(
                error.reason,
                f"{LEAST_ROWS} readings are needed in each of {LEAST_PUSHES} torque pulses, {enough} of {len(pushes)} "
                "pulses have them",
                where=error.where,
                likely="an adapter, a bus or a drive that answers slowly",
                hint="use another adapter or a faster bit rate, end other traffic; or couple an inertia to the shaft",
            ) from None
        if error.reason != TOO_WIDE:
            raise
        what = error.what.removeprefix(f"{TOO_WIDE}: ")
        flowed = current_share(pushes)
        arrived = breaks_in(pushes) or LIGHT_SHAFT
        likely = arrived if flowed >= ARRIVED else LATE_CURRENT.format(100.0 * flowed)
        too_wide = IdentificationError(TOO_WIDE, what, where=error.where, likely=likely, hint=ADD_INERTIA)
        missing["J_per_psi"] = f"{error.what} (likely {likely})"
    if facts.current_undecided:
        estimates = {name: either_reading(estimate) for name, estimate in estimates.items()}
    if not pole_pairs:
        return over_torque_constant(estimates), {**missing, "psi_f_wb": NO_POLE_PAIRS}
    utilisation = UTILISATION if inverter is None else inverter.voltage_utilisation
    try:
        if facts.voltage == "machine":
            coasts = [trace for name, trace in traces.items() if name.startswith("coast")]
            # another sensor than the DC link's: an instrument there says nothing of it
            gain = tolerance.voltage_gain if tolerance.voltage_scale == 1.0 else SENSOR_GAIN_TOLERANCE
            own = replace(tolerance, voltage_gain=gain)
            estimates["psi_f_wb"] = flux_by_undriven_voltage(coasts, pole_pairs=pole_pairs, tolerance=own)
        elif "voltage_limit" in traces:
            share = None if inverter is None or not inverter.dead_time_s else inverter.dead_time_s / inverter.T_s
            estimates["psi_f_wb"] = flux_by_voltage_limit(
                traces["voltage_limit"], pole_pairs=pole_pairs, utilisation=utilisation, dead_time_share=share,
                tolerance=tolerance,
            )  # fmt: skip
        else:
            missing["psi_f_wb"] = (
                below_voltage(facts, utilisation, psi_f_wb) if facts.voltage else no_link(facts.U_dc_v)
            )
    except IdentificationError as error:
        missing["psi_f_wb"] = error.what
    if too_wide is not None and not estimates:
        raise too_wide
    return estimates, missing


def either_reading(ratio: Estimate) -> Estimate:
    """Return a ratio to the current that holds whether the drive's amperes are rms, as they were read, or peak.

    Read as peak they are sqrt 2 smaller, and so is the ratio: the middle, with half of what lies between. The truth
    lies near an end, not somewhere between, so that its own interval stands beyond both (added, no root of squares).
    """
    middle, half = 0.5 * (1.0 + math.sqrt(0.5)), 0.5 * (1.0 - math.sqrt(0.5))
    systematic = half * ratio.value + total_half_width(ratio)
    return replace(
        ratio, value=middle * ratio.value, std=middle * ratio.std, systematic=systematic, fallback=UNDECIDED
    )  # fmt: skip


def over_torque_constant(ratios: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Return the ratios to the flux linkage of one pole pair as ratios to the torque constant K_T (N m per A peak).

    Without the pole pairs p, K_T = 1.5 p psi_f is what divides inertia and friction: 1.5 psi_f at one pole pair.
    """
    per_psi = torque_per_ampere(1.0, 1.0)
    names = {"J_per_psi": ("J_per_kt", "kg m2 A/(N m)"), "tau_c_per_psi": ("tau_c_per_kt", "A")}
    return {
        names[key][0]: replace(
            e, value=e.value / per_psi, std=e.std / per_psi, systematic=e.systematic / per_psi,
            unit=names[key][1],
        )
        for key, e in ratios.items()
    }  # fmt: skip


def no_link(U_dc_v: float) -> str:
    """Return what the flux linkage needs, with the DC link (V) that an energised drive shows; 0: it shows none."""
    if not U_dc_v:
        return NO_LINK
    return (
        f"{NO_LINK}: the drive is energised and shows a DC link of {U_dc_v:.3g} V, so that its unit is another; "
        "state its unit in a map of your own ([signals] U_dc_v)"
    )


def below_voltage(facts: PulseFacts, utilisation: float, psi_f_wb: float) -> str:
    """Return what the flux linkage needs of a run that did not reach the voltage limit."""
    text = f"needs a speed at which the voltage is at its limit, and up to {facts.top_rpm:.0f} rpm it was not"
    below = ""
    if psi_f_wb > 0.0:
        rpm = RPM_PER_RAD_S * utilisation * facts.U_dc_v / (psi_f_wb * facts.pole_pairs)
        text += f" (by the given flux linkage that is at about {rpm:.0f} rpm with {facts.U_dc_v:.4g} V)"
        below = f" below {facts.U_dc_v * facts.top_rpm / rpm:.2g} V"
    return f"{text}: allow a larger --speed-max where motor and drive bear it, or lower the DC link{below}"


def encoder_estimates(found: EncoderResult, traces: Mapping[str, Trace]) -> dict[str, Estimate]:
    """Return pole pairs, direction and offset by the keys of a machine file."""
    direction = Estimate(float(found.direction), 0.0, 0.0, "1", n=found.offset.n, method=found.pole_pairs.method)
    offset = offset_by_turns(found, traces["rotation_forward"], traces["rotation_backward"])
    return {"pole_pairs": replace(found.pole_pairs, std=0.0), "direction": direction, "offset_rad": offset}


def push_estimates(found: PushResult) -> dict[str, Estimate]:
    """Return what the pushes told by the keys of a machine file; R only where the inverter's error does not hide it."""
    told = {"psi_f_wb": found.psi_f, "L_q_app_h": found.L_q, "frame_offset_rad": found.frame_offset}
    return told if found.R is None else {"R_s_ohm": found.R, **told}


# ---- the stage --------------------------------------------------------------------------------------


def evaluated_stage(
    run: RunDirectory, facts: PulseFacts, request: IdentifyRequest, known: MachineFile | None = None
) -> Stage:
    """Estimate from the stored traces, write the machine file where it is whole, and judge every value.

    Raises IdentificationError: a trap was seen; no machine file is written; NotAvailable: nothing of what was asked
    could be told.
    """
    traces = {name: read_trace(run.path / f"traces/{name}.npz") for name in facts.traces}
    if known is None:
        result = pulse_result(traces, facts, request.tolerance)
    else:
        machine = known.machine
        tolerance = replace(request.tolerance, magnet_per_k=magnet_tolerance_per_k(machine))
        result = pulse_result(
            traces, facts, tolerance, known.inverter, machine.psi_f_wb, copper_of(known),
            machine.alpha_psi_per_k,
        )  # fmt: skip
    asked = request.quantities
    if facts.no_vector and known is not None:  # as given, like everything that is not measured
        asked = tuple(name for name in asked if name not in BY_ANGLE)
    if {"psi", "mechanics"} & set(asked) and facts.kind == Method.STANDARD and not facts.pushed:
        result = replace(result, missing={**result.missing, BY_PUSH: facts.no_push or NO_POLE_PAIRS})
    if not any(set(TOLD_BY.get(name, ())) & set(result.estimates) for name in asked):
        reasons = [f"{name}: not available: {why}" for name, why in result.missing.items()]
        raise NotAvailable("\n  - ".join(["nothing that was asked for was identified", *reasons]), where=str(run.path))
    designed = completed_machine(known, result.estimates, facts.source).machine
    judgement = judged(result.estimates, result.missing, asked, designed)
    made = completed_machine(known, judgement.kept(result.estimates), facts.source)
    files = dict.fromkeys((*(f"traces/{name}.npz" for name in traces), REQUEST, facts_name(run) or FACTS), "")
    if made.machine is not None and judgement.verdicts.accepted:
        text = dump_machine_file(made.machine)
        place, prefix = place_of(run, text)
        place.save(MACHINE, text)
        files[f"{prefix}{MACHINE}"] = ""
    missing = dict(result.missing)
    wrong = {SIGN: missing.pop(SIGN)} if SIGN in missing else {}
    stage = stage_of(result.estimates, missing, made, judgement, facts.source)
    if wrong:  # inertia and friction are right all the same: said beside them, so that nobody closes a speed loop on it
        status = "partial" if stage.status == "pass" else stage.status
        said = f"{stage.summary}; {SIGN}: {wrong[SIGN]}"
        stage = replace(stage, status=status, summary=said, refused={**stage.refused, **wrong})
    no_vector = f"{', '.join(BY_ANGLE)}: not measured: {facts.no_vector}" if facts.no_vector else ""
    return replace(stage, files=files, fallbacks=[*stage.fallbacks, *filter(None, (facts.limit, no_vector))])


def dump_facts(facts: PulseFacts) -> str:
    """Return facts as JSON."""
    return json.dumps(asdict(facts), indent=1) + "\n"


def facts_name(run: RunDirectory) -> str | None:
    """Return the name of the file of facts of a run; None where it has none: it was identified by injection."""
    return next((name for name in (FACTS, OLDER_FACTS) if (run.path / name).is_file()), None)


def read_facts(run: RunDirectory) -> PulseFacts | None:
    """Return the facts of a run, None where it has none.

    Raises ConfigError: they are not what :func:`dump_facts` writes.
    """
    name = facts_name(run)
    if name is None:
        return None
    path = run.path / name
    try:
        facts = json.loads(read_text(path))
        found = PulseFacts(**{**facts, "kind": Method(facts["kind"]), "traces": tuple(facts["traces"])})
        if found.kind not in (Method.RECORDER, Method.STANDARD):
            raise ValueError(f"no kind {found.kind!r}")
    except (ValueError, TypeError, KeyError) as error:
        raise ConfigError(
            f"the record of the capability level is damaged: {error}",
            where=str(path),
            hint="identify again; or take the file from a copy of the run",
        ) from error
    return found
