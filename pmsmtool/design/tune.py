# SPDX-License-Identifier: MIT
"""From a machine file and a request to a complete design: every row of the parameter catalogue, with its reason.

What only some designs need (tables, polar control, flux maps) is imported where it is used: every command that designs
on its way pays for what is imported here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from pmsmtool.design.design_file import Design, DesignValue, Scalar
from pmsmtool.design.field_weakening import design_field_weakening
from pmsmtool.design.governor import design_governor
from pmsmtool.design.loops.current_loop import maximum_delay_periods
from pmsmtool.design.loops.designed_loops import CurrentChoice, choose_current
from pmsmtool.design.loops.sampled_loop import LoopMargins, margins
from pmsmtool.design.loops.speed_loop import (
    Notch,
    SpeedGains,
    SpeedMethod,
    SpeedPath,
    pole_placement,
    position_gain,
    quieter,
    slowed,
    small_time_constants,
    speed_loop,
    symmetric_optimum,
    symmetric_ratio,
)
from pmsmtool.design.ratings import Ratings, rating_values, ratings, voltage_facts
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import DesignInfeasible
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.machine.parameters import implausible
from pmsmtool.machine.two_masses import shafts_of, why_slower
from pmsmtool.params.catalogue import CATALOGUE, FIELD_WEAKENING_MODES
from pmsmtool.params.parameter_set import SATURATION
from pmsmtool.units import RPM_PER_RAD_S

PLL_PER_PERIOD = 0.1
"""Default pole of the speed estimate times T_s: a tenth of the sampling rate, 1200 rad/s at 12 kHz."""
FILTER_PER_RATE = 1.0 / 60.0
"""Default cut-off of the speed filter over the sampling rate: 200 Hz at 12 kHz."""
NOTCH_RATE_SHARE = 0.4
"""Largest resonance that gets a notch unasked, of the rate of the speed controller: half of it is the end."""
SPEED_RATE_HZ = 1200.0
"""Default rate of the speed controller; the decimation is rounded to reach it."""
ACCELERATION_SHARE = 0.8
"""Slope limit of the speed reference: this share of what the largest torque can accelerate."""
FW_SHARE = 0.8
"""And at most this share of the slope at which field weakening falls behind by the whole voltage reserve."""
PREDICTED_TURN = 0.1
"""rad that the rotor turns in a period at base speed. Beyond it decoupling by the sampled current comes so late that
steps of drawn machines left 1.05 I_max, 1.10 at most, and 1.02 with the predictor (docs/control.md, section 7).
"""
EDDY_NOTED = 0.01
"""Part of L that eddy currents hide from the current loops, from which on it is told: what L is known to."""
_CURRENT_OPTIONS = 0b111
_PREDICTOR_OPTION = 1 << 4


def tune(source: MachineFile | str | Path, request: TuneRequest | None = None) -> Design:
    """Design a drive.

    Parameters
    ----------
    source : MachineFile, str or Path
        Machine, inverter, encoder and limits; text names a file, a run directory or a shipped profile.
    request : TuneRequest, optional
        What is asked; the defaults of the class.

    Raises
    ------
    ConfigError
        The machine file lacks what no rule can supply.
    DesignInfeasible
        The margins asked for cannot be met with the bandwidth asked for, or a value leaves the drive's range; or
        nothing holds the DC link at a fault at rated speed.
    """
    request = TuneRequest() if request is None else request
    if not isinstance(source, MachineFile):
        source = load_machine_file(source)
    V_limit = (1.0 - request.voltage_margin) * source.inverter.V_max_v
    rated = ratings(source, V_limit, request.overspeed_protection)
    values = {row.name: DesignValue(row.default, "catalogue default") for row in CATALOGUE}
    values |= rating_values(source, rated)
    if (predictor := request.predictor) is None:
        turn = rated.base_speed_rpm / RPM_PER_RAD_S * source.machine.pole_pairs * source.inverter.T_s
        delayed = source.inverter.delay_periods >= 1.0 and request.controller == "pi"
        predictor = delayed and turn > PREDICTED_TURN
        request = replace(request, predictor=predictor)
    told = (*implausible(source.machine, source.inverter), *filter(None, (rated.reaction.note,)))
    n_ucg = rated.reaction.generation_rpm
    generation = {} if math.isinf(n_ucg) else {"generation_rpm": n_ucg}
    choice = choose_current(source, request, rated.I_max_apk)
    weakening = design_field_weakening(source, rated, _weakening_mode(source, request), request.voltage_margin)
    gains = {axis: choice.gains(axis) for axis in "dq"}
    governor = design_governor(source, rated, gains, request.governor, predictor=predictor, eps=request.eps)
    parts = [
        _design_current(source, choice),
        _design_speed(source, request, rated, choice, weakening.ramp_limit_rpm_per_s),
        _Part(dict(governor.values), {}, dict(governor.facts), governor.notes),
        _Part(
            dict(weakening.values), {}, {**generation, **voltage_facts(source, rated, V_limit), **weakening.facts}, told
        ),
    ]
    tables: dict[str, tuple[float, ...]] = {}
    if weakening.values["field_weakening.mode"].value == FIELD_WEAKENING_MODES["lookup"]:
        table, tables = _design_table(source, request, rated)
        parts.append(table)
    if source.flux_map is not None:
        saturation, nodes = _design_saturation(source.flux_map, rated)
        parts.insert(0, saturation)
        tables |= nodes
    if request.controller == "polar":
        from pmsmtool.design.polar_values import polar_values

        mode = _weakening_mode(source, request)
        found, facts, notes = polar_values(source, rated, request.polar_law, mode)
        parts.append(_Part(found, {}, facts, notes))
    for part in parts:
        values |= part.values
    design = Design(
        source,
        request.table(),
        values,
        {name: loop for part in parts for name, loop in part.loops.items()},
        {name: fact for part in parts for name, fact in part.facts.items()},
        tuple(note for part in parts for note in part.notes),
        tables,
    )
    violations = design.parameter_set().violations()
    if violations:
        raise DesignInfeasible(
            "values leave the range of the drive: " + "; ".join(violations),
            where="parameter catalogue",
            hint="ask for another bandwidth, or correct the machine file",
        )
    return design


@dataclass(frozen=True, slots=True)
class _Part:
    """Values of one part of a design, with its loops, facts and notes."""

    values: dict[str, DesignValue]
    loops: dict[str, LoopMargins]
    facts: dict[str, Scalar]
    notes: tuple[str, ...]


def _design_current(source: MachineFile, current: CurrentChoice) -> _Part:
    request, alpha = current.request, current.alpha
    how = f"{request.method}, {alpha / (2.0 * math.pi):.5g} Hz{current.why}"
    values = {}
    for axis in "dq":
        gain = current.gains(axis)
        values[f"current.K_p_{axis}_v_per_a"] = DesignValue(gain.K_p, how, f"current_{axis}")
        values[f"current.K_i_{axis}_v_per_as"] = DesignValue(gain.K_i, how, f"current_{axis}")
    options = _CURRENT_OPTIONS | (_PREDICTOR_OPTION if request.predictor else 0)
    values["current.options"] = DesignValue(
        options, "decoupling, emf feed-forward, back-calculation" + (", predictor" if request.predictor else "")
    )
    values["governor.alpha_rad_s"] = DesignValue(alpha, "bandwidth of the current loops")
    facts: dict[str, Scalar] = {"current_bandwidth_rad_s": alpha}
    for axis in "dq":
        plant = current.plants[axis]
        facts[f"maximum_delay_{axis}_periods"] = maximum_delay_periods(
            current.gains(axis), plant, plant if request.predictor else None
        )
    return _Part(values, current.loops(), facts, tuple(_eddy_notes(source, alpha)))


def _eddy_notes(source: MachineFile, alpha: float) -> Iterator[str]:
    """Yield what identified eddy currents hide of L at the current loops' bandwidth, iron loss among them.

    The file's L with the branch e/(L (1 + s tau)) across its flux, e = ``eddy_*_s``, has the impedance
    s L/(1 + s e/(1 + s tau)); its imaginary part is what the loops see as an inductance.
    """
    for axis in "dq":
        e_s, tau_s = source.seen(f"eddy_{axis}_s"), source.seen(f"eddy_{axis}_time_s")
        hidden = 1.0 - (1.0 / (1.0 + 1j * alpha * e_s / (1.0 + 1j * alpha * tau_s))).real
        if hidden >= EDDY_NOTED:
            yield (
                f"L_{axis}_h is that of slow changes: at the {alpha / (2.0 * math.pi):.4g} Hz of the current loops "
                f"eddy currents or iron loss hide {100.0 * hidden:.2g} % of it"
            )


def _weakening_mode(source: MachineFile, request: TuneRequest) -> str:
    if request.field_weakening != "auto":
        return request.field_weakening
    if request.controller == "polar":
        from pmsmtool.design.polar_values import weakening_mode

        return weakening_mode(source, request.polar_law)
    return "accelerated" if source.flux_map is None else "lookup"


def _design_saturation(flux_map: FluxMap, rated: Ratings) -> tuple[_Part, dict[str, tuple[float, ...]]]:
    """The saturation table of a map, and what is to be said of the map."""
    from pmsmtool.machine.flux_map_check import check_flux_map
    from pmsmtool.machine.saturation_table import saturation_table

    said, found = check_flux_map(flux_map).complaints, saturation_table(flux_map, rated.I_max_apk)
    if found is None:
        return _Part({}, {}, {}, (*said, "decoupling by constants: the flux map has nodes without inductance")), {}
    values = {f"saturation.{k}": DesignValue(v, "flux map up to 1.1 I_max") for k, v in found.descriptor().items()}
    nodes = tuple(found.nodes.ravel().tolist())
    return _Part(values, {}, {"saturation_flux_error_wb": found.flux_error_wb}, said), {SATURATION: nodes}


def _design_table(
    source: MachineFile, request: TuneRequest, rated: Ratings
) -> tuple[_Part, dict[str, tuple[float, ...]]]:
    """The table of the look-up mode, with the tightest bound that fits the drive."""
    from pmsmtool.design.lookup.design import LookupRequest, design_table
    from pmsmtool.design.lookup.file import lut_values

    made = design_table(source, rated, LookupRequest(), request.voltage_margin)
    values, tables = lut_values(made.table, made.stored)
    how = f"{made.stored}, within {100.0 * made.torque_bound:g} % of torque and voltage between nodes"
    facts: dict[str, Scalar] = {
        "table_torque_error_nm": made.error.torque_nm,
        "table_voltage_excess_v": made.error.voltage_v,
    }
    return _Part({name: DesignValue(value, how) for name, value in values.items()}, {}, facts, made.notes), tables


def _design_speed(
    source: MachineFile, request: TuneRequest, rated: Ratings, current: CurrentChoice, ramp_limit: float
) -> _Part:
    T_s = source.inverter.T_s
    pll = request.pll_rad_s or PLL_PER_PERIOD / T_s
    filter_hz = request.speed_filter_hz or FILTER_PER_RATE / T_s
    decimation = request.speed_decimation or max(1, round(1.0 / (SPEED_RATE_HZ * T_s)))
    notch, notch_choice, notes = _notch(source, request, decimation * T_s)
    choice = "asked for" if request.pll_rad_s else "a tenth of the sampling rate"
    values = {
        "encoder.pll_bandwidth_rad_s": DesignValue(pll, choice),
        "speed.filter_hz": DesignValue(filter_hz, "asked for" if request.speed_filter_hz else "rate / 60"),
        "speed.decimation": DesignValue(
            decimation, "asked for" if request.speed_decimation else f"nearest to {SPEED_RATE_HZ:g} Hz"
        ),
        "speed.tau_max_nm": DesignValue(rated.tau_max_nm, rated.methods["tau_max"]),
        "speed.notch_hz": DesignValue(notch.hz, notch_choice),
        "speed.notch_zeta_num": DesignValue(notch.zeta_num, "request"),
        "speed.notch_zeta_den": DesignValue(notch.zeta_den, "request"),
    }
    J = source.machine.J_kgm2
    if J is None:
        off = DesignValue(0.0, "off: the inertia J_kgm2 is not known", "")
        values |= {"speed.K_p_nms_per_rad": off, "speed.K_i_nm_per_rad": off, "position.K_p_per_s": off}
        return _Part(values, {}, {}, ("speed control is off: the machine file has no inertia J_kgm2", *notes))
    path = SpeedPath(J, source.machine.B_nms or 0.0, current.loop("q"), decimation, pll, filter_hz, notch)
    gains = _speed_gains(request, path, current.alpha)
    rated_rad_s = (source.machine.n_nom_rpm or rated.base_speed_rpm) / RPM_PER_RAD_S
    share, why_quiet = quieter(source, path, gains.K_p, rated.tau_max_nm, rated_rad_s)
    if share < 1.0 and request.speed_bandwidth_hz is None:
        gains = gains.slower(share)
        notes = (*notes, why_quiet)
    paths = [replace(path, shaft=shaft) for shaft in shafts_of(source)]
    if paths and request.speed_bandwidth_hz is None:
        rigid_rad_s, path, gains = gains.omega_c, paths[0], slowed(gains, paths)
        notes = (*notes, *why_slower(source, rigid_rad_s, gains.omega_c))
    found = margins(speed_loop(gains, path))
    if not found.stable:
        raise DesignInfeasible(
            f"the speed loop with crossover {gains.omega_c / (2.0 * math.pi):.4g} Hz is unstable",
            where="speed loop", likely="too fast for its delays and filters",
            hint="ask for a lower --speed-bandwidth-hz, or raise the filter and the speed estimate",
        )  # fmt: skip
    how = f"{gains.method}, {gains.omega_c / (2.0 * math.pi):.4g} Hz"
    slope, why = ACCELERATION_SHARE * rated.tau_max_nm / J * RPM_PER_RAD_S, f"{ACCELERATION_SHARE:g} tau_max / J"
    if FW_SHARE * ramp_limit < slope:
        slope, why = FW_SHARE * ramp_limit, f"{FW_SHARE:g} of the slope that spends the voltage reserve"
    values |= {
        "speed.K_p_nms_per_rad": DesignValue(gains.K_p, how, "speed"),
        "speed.K_i_nm_per_rad": DesignValue(gains.K_i, how, "speed"),
        "speed.acceleration_rpm_per_s": DesignValue(slope, why),
    }
    K_p, crossover = position_gain(gains, path)
    values |= {
        "position.K_p_per_s": DesignValue(K_p, f"{crossover / (2.0 * math.pi):.4g} Hz, 60 deg, |S| <= 6 dB at least"),
        "position.velocity_ff": DesignValue(1.0, "whole: a constant speed leaves no following error"),
        "position.inertia_ff_kgm2": DesignValue(J, "J"),
    }
    facts: dict[str, Scalar] = {
        "speed_crossover_rad_s": gains.omega_c if paths else found.crossover_rad_s,
        "position_crossover_rad_s": crossover,
    }
    return _Part(values, {"speed": found}, facts, notes)


def _notch(source: MachineFile, request: TuneRequest, T_speed: float) -> tuple[Notch, str, tuple[str, ...]]:
    """Return the notch asked for, else one at the machine's resonance; with how it was chosen, and notes."""
    asked, resonance = request.notch_hz, source.machine.resonance_hz
    choice = "asked for" if asked else "off"
    notes: tuple[str, ...] = ()
    if asked is None and resonance is not None:
        if resonance * T_speed < NOTCH_RATE_SHARE:
            asked, choice = resonance, "at the resonance of the machine file"
            notes = (f"notch at {resonance:.4g} Hz, the resonance of the machine file; --notch-hz 0 leaves it out",)
        else:
            notes = (
                f"no notch at the resonance of {resonance:.4g} Hz: it is above {NOTCH_RATE_SHARE:g} of the speed "
                f"controller's rate, {1.0 / T_speed:.4g} Hz",
            )
    return Notch(asked or 0.0, request.notch_zeta_num, request.notch_zeta_den), choice, notes


def _speed_gains(request: TuneRequest, path: SpeedPath, alpha: float) -> SpeedGains:
    T_sum = small_time_constants(path, alpha)
    asked = None if request.speed_bandwidth_hz is None else 2.0 * math.pi * request.speed_bandwidth_hz
    if request.speed_method == SpeedMethod.POLE_PLACEMENT:
        ratio = symmetric_ratio(math.radians(request.speed_phase_margin_deg))
        return pole_placement(path.J, path.B, asked or 0.5 / (ratio * T_sum), request.speed_damping)
    ratio = symmetric_ratio(math.radians(request.speed_phase_margin_deg)) if asked is None else 1.0 / (asked * T_sum)
    return symmetric_optimum(path.J, T_sum, ratio)
