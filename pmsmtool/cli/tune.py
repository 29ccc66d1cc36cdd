# SPDX-License-Identifier: MIT
"""``pmsmtool tune``: from a machine file to a design and its parameter set."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.drive_access import map_option, read_map
from pmsmtool.cli.options import DB, DEG, FILE, HZ, TOML, examples, options_named, output_options, overspeed_option
from pmsmtool.cli.output import Output, figure_format, save_figure, table
from pmsmtool.errors import ConfigError, Partial
from pmsmtool.files import refuse_source, write_file
from pmsmtool.units import unit_of_key

if TYPE_CHECKING:
    from pmsmtool.design.design_file import Design
    from pmsmtool.design.loops.sampled_loop import LoopMargins
    from pmsmtool.drive_maps.drive_map import DriveMap
    from pmsmtool.machine.machine_file import MachineFile
    from pmsmtool.params.parameter_set import ParameterSet


@click.command(
    "tune",
    epilog=examples(
        "pmsmtool tune machine.toml -o design.toml",
        "pmsmtool tune interior-2k2 -o design.toml --bandwidth-hz 600 --phase-margin-deg 55",
        "pmsmtool tune machine.toml -o design.toml --map my-drive.toml --drive-bandwidth-hz 95",
        "pmsmtool tune machine.toml -o axis.toml --axis --map epos4",
    ),
)
@click.argument("machine")
@click.option("-o", "--output", "path", type=TOML, required=True, help="Design file to write.")
@click.option("--params", "params_path", type=FILE, help="Parameter set to write.  [default: beside "
              "it, params.toml for design.toml, X.params.toml for X.toml]")  # fmt: skip
@click.option("--plot", "plot_path", type=FILE, help="Bode plot of the loops to write (.svg, .png, .pdf).")
@click.option("--controller", type=click.Choice(["pi", "polar"]), default="pi", help="Field-oriented PI, or polar.")
@click.option(
    "--polar-law",
    type=click.Choice(["conventional", "proposed", "linear", "linear-printed", "regularised", "unified"]),
    default="unified",
    help="Law of --controller polar.",
)
@click.option(
    "--method",
    type=click.Choice(["imc", "modulus-optimum", "second-order"]),
    default="imc",
    help="Rule of the current gains.",
)
@click.option("--bandwidth-hz", type=HZ, metavar="HZ", help="Bandwidth of the current loops (second-order: natural "
              "frequency).  [default: modulus optimum, lowered to the margins]")  # fmt: skip
@click.option("--damping", type=float, default=1.0, help="Damping of second-order.")
@click.option("--phase-margin-deg", type=DEG, default=45.0, metavar="DEG", help="Least phase margin, with delay.")
@click.option("--gain-margin-db", type=DB, default=6.0, metavar="DB", help="Least gain margin.")
@click.option("--predictor/--no-predictor", default=None, help="One-step prediction of the current.  [default: where "
              "the rotor turns by more than 0.1 rad in a period at base speed]")  # fmt: skip
@click.option(
    "--speed-method",
    type=click.Choice(["symmetric-optimum", "pole-placement"]),
    default="symmetric-optimum",
    help="Rule of the speed gains.",
)
@click.option("--speed-bandwidth-hz", type=HZ, metavar="HZ", help="Crossover of the speed loop.  [default: from "
              "--speed-phase-margin-deg]")  # fmt: skip
@click.option("--speed-phase-margin-deg", type=DEG, default=60.0, metavar="DEG",
              help="Phase margin of the symmetric optimum.")  # fmt: skip
@click.option("--speed-damping", type=float, default=1.0, help="Damping of pole-placement.")
@click.option("--speed-decimation", type=int, metavar="N", help="Control periods per speed-controller period.")
@click.option("--speed-filter-hz", type=HZ, metavar="HZ", help="Cut-off of the speed filter.")
@click.option("--pll-rad-s", type=float, metavar="RAD/S", help="Pole of the speed estimate.")
@click.option("--notch-hz", type=HZ, metavar="HZ", help="Notch on the torque, 0 off.  [default: at the resonance "
              "that identify frf found]")  # fmt: skip
@click.option("--notch-zeta-num", type=float, default=0.05, help="Numerator damping of the notch.")
@click.option("--notch-zeta-den", type=float, default=0.5, help="Denominator damping of the notch.")
@click.option("--voltage-margin", type=float, default=0.08, metavar="RATIO", help="Share of V_max kept for control.")
@click.option(
    "--governor",
    type=click.Choice(["off", "paper", "line", "best", "linearised", "observe"]),
    default="best",
    help="Reference governor.",
)
@click.option("--eps", type=float, metavar="RATIO", help="Voltage share that it keeps back.  [default: from 0.015 on]")
@click.option(
    "--field-weakening",
    type=click.Choice(["auto", "off", "lookup", "gradient", "accelerated", "uncompensated"]),
    default="auto",
    help="auto: a table for a saturated machine, else the accelerated optimisation.",
)
@click.option("--axis", is_flag=True, help="Design speed and position loops of the axis with its load; the parameter "
              "set then holds nothing else.")  # fmt: skip
@click.option("--axis-phase-margin-deg", type=DEG, default=45.0, metavar="DEG", help="Least phase margin of both "
              "loops over the tolerance box.")  # fmt: skip
@click.option("--axis-peak-db", type=DB, default=6.0, metavar="DB", help="Largest |S| of both, over the box.")
@click.option("--loop-rate-hz", type=HZ, metavar="HZ", help="Rate of the drive's speed and position loops.  "
              "[default: as its map states]")  # fmt: skip
@click.option("--stored", type=FILE, metavar="FILE", help="What the drive holds (`pmsmtool backup`): its gains are "
              "kept where they follow better with the margins asked for.")  # fmt: skip
@overspeed_option
@map_option
@click.option("--drive-bandwidth-hz", type=HZ, metavar="HZ", help="Current bandwidth of a drive with fixed "
              "firmware (--map).")  # fmt: skip
@click.option("--limit-speed-rpm", type=float, metavar="RPM", help="Speed up to which a drive of --map never saturates."
              "  [default: at the most torque x speed]")  # fmt: skip
@click.option("--limit-rise-s", type=float, default=0.02, metavar="S", help="That drive's time to its torque limit.")
@click.option("--limit-acceleration-rpm-per-s", type=float, metavar="RPM/S", help="That drive's largest acceleration.  "
              "[default: torque limit / J]")  # fmt: skip
@output_options
def tune_command(
    machine: str,
    path: Path,
    params_path: Path | None,
    map_file: Path | None,
    plot_path: Path | None,
    out: Output,
    **asked: Any,
) -> None:
    """Design the control of MACHINE (a machine file, a run directory or a profile).

    Writes the design: the machine, and every gain with its unit, method and achieved margin. The parameter set for
    flash-params is written beside it. Exit code 1 when the margins asked for cannot be met.

    With --map of a drive with fixed firmware: the limits of torque or current, slope and speed are designed, so that
    its voltage demand stays within the limit. Guarantee and cost are printed. The map must have objects for slope and
    limit; cia402 and copley have them. Without them, as for epos4, its gains alone are designed. Loops are checked with
    the rounded gains of the drive, or with gains of the bandwidth in --drive-bandwidth-hz.

    With --axis: gains, feed-forward and notch of the speed and position loops in the structure of the drive, with the
    least phase margin and the largest |S| over the tolerance box (inertia, torque, resonance), and a jerk-limited move.
    Exit code 10 when the drive has no object of known unit for a gain: the table says its value all the same.
    """
    from pmsmtool.design.design_file import design_text
    from pmsmtool.machine.machine_file import load_machine_file

    drive_map = read_map(map_file)
    axis = {name: asked.pop(name) for name in _AXIS}
    params_path = params_path or _params_path(path)
    refuse_source(machine, path, params_path)
    if asked.pop("axis"):
        _axis(machine, drive_map, asked, axis, path, params_path, out)
        return
    _refuse_without_axis(axis)
    if plot_path is not None:
        figure_format(plot_path)
    design = _design(load_machine_file(machine), drive_map, asked)
    params = design.parameter_set()
    write_file(path, design_text(design))
    write_file(params_path, params.to_toml())
    if plot_path is not None:
        _plot(design, plot_path)
    data = {
        "machine": design.name,
        "design": path,
        "params": params_path,
        "plot": plot_path,
        "content": params.content_hash(),
        "values": {name: design[name] for name in design.values},
        "loops": design.loops,
        "facts": design.facts,
        "notes": design.notes,
    }
    out.result("tune", data, lambda: _lines(design, drive_map))
    for note in design.notes:
        out.note(note)
    out.note(f"wrote {path}, {params_path}")


def _plot(design: Design, path: Path) -> None:
    from pmsmtool.design.loops.designed_loops import open_loops
    from pmsmtool.report.figures import bode_figure

    loops = open_loops(design)
    if not loops:
        raise ConfigError("the design has no loops to draw: the drive's gains cannot be written", where=str(path),
                          hint="leave --plot out, or state --drive-bandwidth-hz")  # fmt: skip
    save_figure(bode_figure(loops, {name: design.loops[name] for name in loops}).canvas, path)


_AXIS = ("axis_phase_margin_deg", "axis_peak_db", "loop_rate_hz", "stored")


def _refuse_without_axis(axis: dict[str, Any]) -> None:
    for name in ("loop_rate_hz", "stored"):
        if axis[name] is not None:
            raise ConfigError(f"--{name.replace('_', '-')}: for the loops of --axis", hint="add --axis")


def _axis(
    machine: str, drive_map: DriveMap, asked: dict[str, Any], axis: dict[str, Any],
    path: Path, params_path: Path, out: Output,
) -> None:  # fmt: skip
    from pmsmtool.axis.drive import AxisRequest
    from pmsmtool.commissioning.axis_design import axis_parameters, design_axis, flashed_design, not_offered, stored_in
    from pmsmtool.design.design_file import design_text
    from pmsmtool.design.tune_request import TuneRequest
    from pmsmtool.machine.machine_file import load_machine_file

    for name in _LIMITS:
        asked.pop(name)
    bandwidth_hz, filter_hz = asked.pop("drive_bandwidth_hz"), None if drive_map.staging else asked["speed_filter_hz"]
    if bandwidth_hz is not None:
        asked["bandwidth_hz"] = bandwidth_hz
    request = AxisRequest(axis["axis_phase_margin_deg"], axis["axis_peak_db"], axis["loop_rate_hz"], filter_hz)
    source, tuned = load_machine_file(machine), TuneRequest(**asked)
    held, flashed = stored_in(axis["stored"], drive_map, source), flashed_design(machine, tuned, drive_map)
    design = design_axis(source, tuned, request, drive_map, *held, flashed)
    params = axis_parameters(design)
    write_file(path, design_text(design))
    write_file(params_path, params.to_toml())
    lacking = {} if drive_map.staging else not_offered(drive_map)
    facts = {name: fact for name, fact in design.facts.items() if name.startswith("axis_")}
    loops = {name: loop for name, loop in design.loops.items() if name.startswith("axis_")}
    data = {
        "machine": design.name, "design": path, "params": params_path, "content": params.content_hash(),
        "drive": drive_map.name, "values": {name: design[name] for name in params.values}, "loops": loops,
        "facts": facts, "not_written": lacking, "notes": design.notes,
    }  # fmt: skip
    out.result("tune.axis", data, lambda: _axis_lines(design, params, drive_map))
    for note in design.notes:
        out.note(note)
    out.note(f"wrote {path}, {params_path}")
    if lacking:
        raise Partial(
            f"the drive has no object of known unit for {', '.join(lacking)}",
            hint="enter them with the maker's software; `pmsmtool map learn` measures what one of a speed gain counts",
        )


def _axis_lines(design: Design, params: ParameterSet, drive_map: DriveMap) -> Iterator[str]:
    from pmsmtool.axis.design import POSITION_LOOP, SPEED_LOOP
    from pmsmtool.params.catalogue import BY_NAME

    def counts(name: str) -> str:
        cell = drive_map.cells.get(name)
        if cell is None or not drive_map.writes(name, params.values):
            return "-"
        return f"0x{cell.index:04X}:{cell.sub:02X}"

    rows = [
        (name, f"{value:.6g}", BY_NAME[name].unit, counts(name), design.values[name].method)
        for name, value in params.values.items()
    ]
    yield from table(("parameter", "value", "unit", "object", "method"), rows)
    yield ""
    box = ("phase_least_deg", "S_peak_db", "T_peak_db")
    judged = [
        (*_loop(name, design.loops[name]), *(f"{float(design.facts[f'{name}_{key}']):.1f}" for key in box))
        for name in (SPEED_LOOP, POSITION_LOOP)
    ]
    yield from table((*_LOOP, "least phase deg", "|S| dB", "|T| dB"), judged)
    yield ""
    facts = {name: fact for name, fact in design.facts.items() if name.startswith("axis_") and "_at" not in name}
    yield from _facts("axis", facts)


def _design(source: MachineFile, drive_map: DriveMap, asked: dict[str, Any]) -> Design:
    from pmsmtool.design.tune import tune
    from pmsmtool.design.tune_request import TuneRequest

    limits = {name.removeprefix("limit_"): asked.pop(name) for name in _LIMITS}
    bandwidth_hz = asked.pop("drive_bandwidth_hz")
    if drive_map.staging:
        _refuse_for_reflashed(drive_map.name, {"drive_bandwidth_hz": bandwidth_hz, **limits})
        return tune(source, TuneRequest(**asked))
    from pmsmtool.commissioning.design_stages import closed_design

    options = {name.removeprefix("limit_"): f"--{name.replace('_', '-')}" for name in _LIMITS}
    with options_named(options | {"bandwidth_hz": "--drive-bandwidth-hz"}):
        return closed_design(source, TuneRequest(**asked), drive_map, bandwidth_hz=bandwidth_hz, **limits)


_LIMITS = ("limit_speed_rpm", "limit_rise_s", "limit_acceleration_rpm_per_s")


def _refuse_for_reflashed(name: str, closed: dict[str, float | None]) -> None:
    """Refuse options that only mean something for a drive that keeps its own control."""
    given = [option for option, value in closed.items() if value is not None and option != "rise_s"]
    if given:
        options = ", ".join(f"--{'' if option.startswith('drive') else 'limit_'}{option}" for option in given)
        raise ConfigError(
            f"{options.replace('_', '-')}: for a drive that cannot be reflashed, and {name!r} is none",
            hint="name that drive with --map, e.g. --map copley",
        )


def _params_path(design: Path) -> Path:
    # Two designs in one folder keep a parameter set each.
    return design.with_name("params.toml" if design.name == "design.toml" else f"{design.stem}.params.toml")


_SHOWN = (
    "current.K_p_d_v_per_a", "current.K_i_d_v_per_as", "current.K_p_q_v_per_a", "current.K_i_q_v_per_as",
    "speed.K_p_nms_per_rad", "speed.K_i_nm_per_rad", "speed.tau_max_nm", "position.K_p_per_s",
)  # fmt: skip
_SHOWN_LIMITS = (
    "governor.mode", "governor.k_max", "governor.eps", "governor.options", "governor.I_transient_apk",
    "governor.observer_gain", "field_weakening.mode", "field_weakening.N_fw", "field_weakening.margin",
    "field_weakening.h1", "field_weakening.h2", "field_weakening.beta", "field_weakening.sigma",
    "field_weakening.iterations", "field_weakening.i_d_min_a", "field_weakening.i_d_lm_a",
)  # fmt: skip
_SHOWN_CLOSED = (
    *_SHOWN[4:7], "motor.I_max_apk", "reference.tau_rated_nm", "reference.torque_slope_nm_per_s", "motor.n_max_rpm",
)  # fmt: skip
_SHOWN_POLAR = (
    "polar.mode", "polar.options", "polar.sigma_phase_rad_s", "polar.sigma_amplitude_rad_s", "polar.tau_s",
    "polar.omega_c_rad_s", "polar.omega_dob_rad_s", "polar.V_ref_ratio", *_SHOWN[4:],
)  # fmt: skip


def _lines(design: Design, drive_map: DriveMap) -> Iterator[str]:
    from pmsmtool.params.catalogue import BY_NAME

    polar = design["polar.mode"] != 0.0
    shown: tuple[str, ...] = _SHOWN_POLAR if polar else (*_SHOWN, *_SHOWN_LIMITS)
    if not drive_map.staging:
        shown = (*_SHOWN[:4], *(name for name in _SHOWN_CLOSED if name in drive_map.cells))
    rows = [(name, f"{design[name]:.6g}", BY_NAME[name].unit, design.values[name].method) for name in shown]
    yield from table(("parameter", "value", "unit", "method"), rows)
    yield ""
    loops = {name: loop for name, loop in design.loops.items() if not (polar and name.startswith("current"))}
    yield from table(_LOOP, [_loop(name, loop) for name, loop in loops.items()])
    facts = {name: value for name, value in design.facts.items() if name.startswith("polar_") == polar}
    if facts:
        yield ""
        yield from _facts("polar loops" if polar else "governor, field weakening, loops", facts)


_LOOP = ("loop", "phase deg", "gain dB", "delay us", "bandwidth Hz")


def _loop(name: str, loop: LoopMargins) -> tuple[str, ...]:
    delay_us, hertz = 1e6 * loop.delay_margin_s, loop.bandwidth_rad_s / (2.0 * math.pi)
    return name, f"{loop.phase_margin_deg:.1f}", f"{loop.gain_margin_db:.1f}", f"{delay_us:.0f}", f"{hertz:.4g}"


def _facts(head: str, facts: Mapping[str, bool | float | str]) -> list[str]:
    units = [unit_of_key(name) if isinstance(value, float) else "" for name, value in facts.items()]
    return table((head, "value", "unit"), list(zip(facts, map(_fact, facts.values()), units, strict=True)))


def _fact(value: bool | float | str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.5g}" if isinstance(value, float) else str(value)
