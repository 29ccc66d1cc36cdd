# SPDX-License-Identifier: MIT
"""``pmsmtool margins``: what a design tolerates, over what the machine may be.

Work of a batch is done by this process, a pool of processes, or a Dask cluster.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.options import ANY_PATH, FILE, Quantity, examples, output_options
from pmsmtool.cli.output import Output, figure_format, inside, save_figure, table
from pmsmtool.errors import BusError, CheckFailed, NotAvailable

if TYPE_CHECKING:
    from pmsmtool.design.design_file import Design
    from pmsmtool.design.loops.margins import MarginReport, Spread
    from pmsmtool.proof.simulated_margins import Observed, SimulatedMargins
    from pmsmtool.sim.scenarios import Scenario

_TEMPERATURE = Quantity("temperature")
_VOLTAGE = Quantity("voltage")

IN_PROCESS = 20_000
"""Random samples below which starting a pool of processes costs more than it saves."""


@click.command(
    "margins",
    epilog=examples(
        "pmsmtool margins design.toml --monte-carlo 100000 --phase-margin-deg 40",
        "pmsmtool margins design.toml --monte-carlo 1000000 --scheduler tcp://10.0.0.5:8786",
        "pmsmtool margins design.toml --simulate 256 --scenario load-step --current-headroom -0.05",
        "pmsmtool margins design.toml --u-dc 480V 560V --magnet -20degC 110degC --voltage-headroom 0",
    ),
)
@click.argument("design", type=ANY_PATH)
@click.option("--monte-carlo", "samples", type=click.IntRange(0, 10**8), default=0, metavar="N", help="Random samples.")
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of the random samples.")
@click.option(
    "--simulate", "drives", type=click.IntRange(0, 10**6), default=0, metavar="N", help="Random drives in closed loop."
)
@click.option("--scenario", metavar="NAME|FILE", help="What they do.  [default: torque reversals up to top speed]")
@click.option(
    "--scheduler", default="processes", metavar="NAME", help="local, processes, or a Dask scheduler's address."
)
@click.option("--workers", type=click.IntRange(1), metavar="N", help="Processes.  [default: one per core]")
@click.option("--phase-margin-deg", type=float, default=30.0, metavar="DEG", help="Least one of the current loops.")
@click.option("--gain-margin-db", type=float, default=4.0, metavar="DB", help="Least one of the current loops.")
@click.option("--speed-phase-margin-deg", type=float, default=30.0, metavar="DEG", help="Least one of the speed loop.")
@click.option("--voltage-headroom", type=float, metavar="RATIO", help="Least 1 - |v|/V_max.  [default: not judged]")
@click.option("--current-headroom", type=float, metavar="RATIO", help="Least 1 - |i|/I_max.  [default: not judged]")
@click.option("--thermal-headroom", type=float, metavar="RATIO", help="Least 1 - copper loss.  [default: not judged]")
@click.option("--u-dc", "U_dc_v", type=(_VOLTAGE, _VOLTAGE), metavar="LOW HIGH", help="Range of the DC link.  [+-5 %]")
@click.option("--winding", "T_winding_c", type=(_TEMPERATURE, _TEMPERATURE), metavar="LOW HIGH",
              help="Range of the winding temperature.")  # fmt: skip
@click.option("--magnet", "T_magnet_c", type=(_TEMPERATURE, _TEMPERATURE), metavar="LOW HIGH",
              help="Range of the magnet temperature.")  # fmt: skip
@click.option("--plot", "plot_path", type=FILE, help="Margins over the box to write (.svg, .png, .pdf).")
@output_options
def margins_command(
    design: Path,
    samples: int,
    seed: int,
    drives: int,
    scenario: str | None,
    scheduler: str,
    workers: int | None,
    U_dc_v: tuple[float, float] | None,
    T_winding_c: tuple[float, float] | None,
    T_magnet_c: tuple[float, float] | None,
    plot_path: Path | None,
    out: Output,
    **asked: Any,
) -> None:
    """Judge DESIGN (or the design of a run directory) over the tolerance box of its machine.

    Loop margins and limit headroom are kept apart. The worst corner of the 95 % box is named with its sample; random
    samples give percentiles. With --simulate the whole firmware runs on random machines of the box as well, over all
    cores of this computer or on a Dask cluster. Exit code 1 when a margin asked for fails at a corner or at the 5th
    percentile, or when more than 5 % of the simulated drives trip.
    """
    from pmsmtool.commissioning.axis_design import why_not_judged
    from pmsmtool.design.design_file import load_design
    from pmsmtool.design.loops.margins import MarginRequest, margin_report
    from pmsmtool.design.tolerance import tolerance_box

    if plot_path is not None:
        figure_format(plot_path)
    file = inside(design, "design.toml")
    source = load_design(file)
    box = tolerance_box(source.machine, U_dc_v=U_dc_v, T_winding_c=T_winding_c, T_magnet_c=T_magnet_c)
    if scheduler == "processes" and samples < IN_PROCESS and workers is None:
        scheduler = "local"
    course = _scenario(scenario, source) if drives else None
    simulated = None
    with executor(scheduler, workers) as pool:
        report = margin_report(
            source, box, MarginRequest(**asked), samples=samples, seed=seed, executor=pool,
            progress=lambda done, wanted: out.status(f"{done} of {wanted} samples"),
        )  # fmt: skip
        if drives:
            from pmsmtool.proof.simulated_margins import simulated_margins

            # the kernel has threads of its own: processes would only add copies
            own = scheduler in ("local", "processes")
            simulated = simulated_margins(
                source, box, MarginRequest(**asked), drives=drives, seed=seed, scenario=course,
                executor=None if own else pool, threads=workers,
                progress=lambda done, wanted: out.status(f"{done} of {wanted} drives"),
            )  # fmt: skip
    ok = report.ok and (simulated is None or simulated.ok)
    found = {"design": file, "seed": seed, "ok": ok, "report": report, "simulated": simulated}
    out.result("margins", found, lambda: _lines(report, simulated))
    for note in report.notes:
        out.note(note)
    if plot_path is not None:
        from pmsmtool.report.figures import margin_figure

        save_figure(margin_figure(report).canvas, plot_path)
    if not ok:
        bad = [*(s.name for s in (*report.loops, *report.headroom) if not s.ok), *_failed(simulated)]
        raise CheckFailed(
            f"margins asked for are not met: {', '.join(bad)}",
            where=str(file),
            hint="lower the bandwidth, narrow the tolerances by identification, or ask for less",
        )
    if not report.loops and simulated is None and not any(spread.least for spread in report.headroom):
        raise NotAvailable(
            f"loop margins: {why_not_judged(source)}",
            where=str(file),
            hint="`pmsmtool tune --map FAMILY --drive-bandwidth-hz HZ` checks the loops of a drive with fixed "
            "firmware; --voltage-headroom, --current-headroom and --thermal-headroom judge the rest",
        )


def _scenario(name: str | None, source: Design) -> Scenario | None:
    if name is None:
        return None
    from pmsmtool.sim.simulate import SimulatedDrive, find_scenario

    return find_scenario(name, SimulatedDrive(source.machine, source.parameter_set(), "design"))


def _failed(simulated: SimulatedMargins | None) -> list[str]:
    if simulated is None or simulated.ok:
        return []
    bad = [quantity.name for quantity in simulated.quantities if not quantity.ok]
    return bad or [f"{sum(simulated.trips.values())} of {simulated.drives} simulated drives tripped"]


def _lines(report: MarginReport, simulated: SimulatedMargins | None) -> Iterator[str]:
    over = f"over {report.corners} corners" + (f" and {report.samples} samples" if report.samples else "")
    if report.loops:
        yield f"loop margins {over}"
        yield from _table(report.loops)
        phase = min((s for s in report.loops if s.name.endswith("_phase")), key=lambda s: s.worst)
        yield f"worst {phase.name}: {_sample(phase.worst_sample)}"
    else:
        yield f"no loop margins: the gains cannot be written to the drive; headroom {over}"
    yield ""
    yield "limit headroom of the references for the nominal machine (1: nothing needed, 0: at the limit)"
    yield from _table(report.headroom)
    for spread in report.headroom:
        if spread.worst < 0.0:
            yield f"worst {spread.name}: {spread.worst_cell or 'rated torque'}, {_sample(spread.worst_sample)}"
    if report.cells:
        yield ""
        yield "cells where machines of the box need more than the limit, and how many do"
        yield from table(
            ("cell", "voltage", "current"),
            [(risk.cell, f"{100.0 * risk.voltage:.3g} %", f"{100.0 * risk.current:.3g} %") for risk in report.cells],
        )
    if report.unreachable:
        yield ""
        yield f"not reached by the nominal machine: {report.unreachable[0]}" + (
            f" and {len(report.unreachable) - 1} more" if len(report.unreachable) > 1 else ""
        )
    if simulated is not None:
        yield ""
        yield from _simulated_lines(simulated)


def _simulated_lines(simulated: SimulatedMargins) -> Iterator[str]:
    yield f"{simulated.drives} drives in closed loop, scenario {simulated.scenario}, {simulated.duration_s:g} s each"
    yield from _table(simulated.quantities, "worst drive")
    worst = next(q for q in simulated.quantities if q.name == "simulated_current")
    yield f"worst simulated_current: {_sample(worst.worst_sample)}"
    trips = ", ".join(f"{count} {name}" for name, count in simulated.trips.items())
    yield f"tripped: {trips or 'none'}"
    if simulated.outside_flux_map:
        yield f"left the flux map, not to be relied on: {simulated.outside_flux_map} drives"


def _sample(sample: Mapping[str, float]) -> str:
    """Return a machine of the box: factors over nominal (``x``), then absolutes."""
    absolute = ("encoder_rad", "T_winding_c", "T_magnet_c", "U_dc_v", "operating_point")
    return ", ".join(f"{name} {'' if name in absolute else 'x '}{value:.4g}" for name, value in sample.items())


def _table(spreads: Sequence[Spread] | Sequence[Observed], worst: str = "worst corner") -> list[str]:
    random = bool(spreads and spreads[0].percentiles)
    heads = ["quantity", "unit", "nominal", worst, *(["p1", "p5", "p50"] if random else []), "asked", "verdict"]
    rows = []
    for s in spreads:
        shares = [f"{s.percentiles[p]:.4g}" for p in (1.0, 5.0, 50.0)] if random else []
        asked = "-" if s.least is None else f"{s.least:g}"
        verdict = "-" if s.least is None else "PASS" if s.ok else "FAIL"
        rows.append([s.name, s.unit, f"{s.nominal:.4g}", f"{s.worst:.4g}", *shares, asked, verdict])
    return table(heads, rows)


@contextmanager
def executor(scheduler: str, workers: int | None = None) -> Iterator[Any]:
    """Open an executor with ``map``, as ``concurrent.futures``.

    Raises NotAvailable: the extra ``cluster`` is not installed; BusError: the cluster does not answer.

    Parameters
    ----------
    scheduler : str
        ``local`` (this process; None is given), ``processes``, or the address of a Dask scheduler
        (``tcp://host:8786``).
    workers : int, optional
        Processes of the pool.
    """
    if scheduler == "local":
        yield None
    elif scheduler == "processes":
        import concurrent.futures
        import multiprocessing

        # spawn: the parent may hold threads (a bus, a plot), which a forked child would inherit locked
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(workers, mp_context=context) as pool:
            yield pool
    else:
        yield from _cluster(scheduler)


def _cluster(address: str) -> Iterator[Any]:
    try:
        Client = importlib.import_module("distributed").Client
    except ImportError:
        raise NotAvailable(
            "a Dask cluster needs the package distributed",
            where=f"--scheduler {address}",
            hint="pip install 'pmsmtool[cluster]', or --scheduler processes",
        ) from None
    try:
        client = Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError) as error:
        raise BusError(
            f"no Dask scheduler answers: {error}",
            where=f"--scheduler {address}",
            hint="start one with `dask scheduler`, or --scheduler processes",
        ) from error
    with client:
        yield client.get_executor(pure=False, retries=3)
