# SPDX-License-Identifier: MIT
"""``pmsmtool simulate``: the closed loop in the embedded simulator."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.options import FILE, TIME, WholeNumber, examples, output_options
from pmsmtool.cli.output import Output, figure_format, table
from pmsmtool.errors import ConfigError
from pmsmtool.units import RPM_PER_RAD_S

if TYPE_CHECKING:
    from pmsmtool.trace import Trace

_SEED = WholeNumber("seed", 0, 2**63 - 1)
_SUFFIXES = (".npz", ".csv")


@click.command(
    "simulate",
    epilog=examples(
        "pmsmtool simulate design.toml --scenario speed-ramp -o trace.npz",
        "pmsmtool simulate jercic-2017 --scenario current-steps -o trace.csv --plot trace.svg",
        "pmsmtool simulate machine.toml --scenario reversal.toml -o trace.npz --set sensor_noise_apk=0 --seed 7",
        "pmsmtool simulate --list",
    ),
)
@click.argument("design", metavar="DESIGN", required=False)
@click.option("--scenario", metavar="NAME|FILE", help="A built-in scenario (--list) or a scenario file.")
@click.option("-o", "--output", "path", type=FILE, help="Trace to write (.npz or .csv).")
@click.option("--plot", "figure_path", type=FILE, help="Figure to write (.svg, .png, .pdf).")
@click.option("--duration", "duration_s", type=TIME, help="Another duration than the scenario's, e.g. 250ms.")
@click.option("--seed", type=_SEED, help="Seed of the sensors' noise.")
@click.option("--params", type=FILE, help="Parameter set that is laid over the design's.")
@click.option(
    "--set", "changes", multiple=True, metavar="KEY=VALUE", help="Another value in [simulation]; may be repeated."
)
@click.option("--list", "list_only", is_flag=True, help="List the built-in scenarios.")
@output_options
def simulate_command(
    design: str | None,
    scenario: str | None,
    path: Path | None,
    figure_path: Path | None,
    duration_s: float | None,
    seed: int | None,
    params: Path | None,
    changes: tuple[str, ...],
    list_only: bool,
    out: Output,
) -> None:
    """Simulate DESIGN (a design, a machine file, a run directory or a profile) in closed loop.

    The drive's own firmware runs against the machine that the file's [simulation] table describes: inverter, sensors,
    temperatures, load. Same inputs and seed, same bytes. Nothing is touched.
    """
    if list_only:
        _list(out)
        return
    if design is None:
        raise click.UsageError("missing argument DESIGN: a design, a machine file, a run directory or a profile")
    if scenario is None:
        raise click.UsageError("which --scenario? --list names the built-in ones")
    from pmsmtool.sim.simulate import find_drive, find_scenario, run_scenario

    if path is not None and path.suffix.lower() not in _SUFFIXES:
        raise ConfigError(f"{path.name} has no trace format", where=str(path), hint="use .npz or .csv")
    if figure_path is not None:
        figure_format(figure_path)
    drive = find_drive(design, params)
    found = find_scenario(scenario, drive)
    if path is None and figure_path is None and not out.json:
        raise click.UsageError("nothing to write: give -o, --plot or --json")
    trace = run_scenario(drive, found, seed=seed, duration_s=duration_s, simulation=_changes(changes))
    if drive.origin != "design":
        out.note(f"parameters: {drive.origin}")
    for note in drive.notes:
        out.note(note)
    if scenario == "field-weakening-sweep" and not drive.params.values.get("field_weakening.mode"):
        out.note("field weakening is off in these parameters (field_weakening.mode = 0)")
    _warn(trace, out)
    _write(trace, path, figure_path, out)
    summary = _summary(trace)
    data = {
        "machine": drive.machine.name,
        "scenario": trace.meta["scenario"],
        "rows": len(trace),
        "duration_s": float(trace.t_s[-1] - trace.t_s[0]),
        "trace": path,
        "plot": figure_path,
        "signals": summary,
        "meta": trace.meta,
    }
    out.result("simulate", data, lambda: _lines(summary))


def _list(out: Output) -> None:
    from pmsmtool.sim.scenarios import BUILT_IN

    rows = [{"name": name, "does": does} for name, (does, _) in BUILT_IN.items()]
    out.result("simulate", {"scenarios": rows}, table(("scenario", "does"), [tuple(row.values()) for row in rows]))


def _changes(given: tuple[str, ...]) -> dict[str, Any]:
    """``KEY=VALUE`` as TOML would read it; a bare word is text."""
    from pmsmtool.toml_file import written_value

    found: dict[str, Any] = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not equals:
            raise click.UsageError(f"--set {text!r} is not KEY=VALUE")
        found[name.strip()] = written_value(value)
    return found


def _warn(trace: Trace, out: Output) -> None:
    if trace.trip:
        out.warn(trace.trip)
    if trace.meta["outside_flux_map"]:
        out.warn(f"{trace.meta['outside_flux_map']} evaluations outside the flux map: the currents leave its range")
    if trace.meta["event_overruns"]:
        out.warn(f"{trace.meta['event_overruns']} intervals of the inverter were not resolved to the last event")


def _write(trace: Trace, path: Path | None, figure_path: Path | None, out: Output) -> None:
    if path is not None:
        from pmsmtool.trace import write_trace

        write_trace(trace, path)
        out.note(f"wrote {path}")
    if figure_path is not None:
        from pmsmtool.cli.output import save_figure
        from pmsmtool.report.plots import trace_figure

        save_figure(trace_figure(trace, title=f"{trace.meta['machine']}: {trace.meta['scenario']}"), figure_path)
        out.note(f"wrote {figure_path}")


_SHOWN = ("i_d_a", "i_q_a", "u_d_lim_v", "u_q_lim_v", "torque_true_nm", "omega_m_rad_s", "T_winding_true_c")


def _summary(trace: Trace) -> dict[str, dict[str, Any]]:
    return {
        name: {
            "unit": trace.units[name],
            "min": float(trace[name].min()),
            "max": float(trace[name].max()),
            "last": float(trace[name][-1]),
        }
        for name in _SHOWN
    }


def _lines(summary: dict[str, dict[str, Any]]) -> Iterator[str]:
    rows = []
    for name, line in summary.items():
        rows.append((name, *(f"{line[key]:.5g}" for key in ("min", "max", "last")), line["unit"]))
        if name == "omega_m_rad_s":
            rpm = RPM_PER_RAD_S
            rows.append(("speed", *(f"{rpm * line[key]:.5g}" for key in ("min", "max", "last")), "rpm"))
    return iter(table(("signal", "min", "max", "last", "unit"), rows))
