"""``pmsmtool margins``: what a design tolerates, over what the machine may be."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.options import Quantity, examples, output_options
from pmsmtool.cli.output import Output, table
from pmsmtool.cli.output_file import inside

if TYPE_CHECKING:
    from pmsmtool.design.margins import MarginReport, Spread

_TEMPERATURE = Quantity("temperature")
_VOLTAGE = Quantity("voltage")

IN_PROCESS = 20_000
"""Random samples below which starting a pool of processes costs more than it saves."""


@click.command(
    "margins",
    epilog=examples(
        "pmsmtool margins design.toml",
        "pmsmtool margins design.toml --monte-carlo 100000 --phase-margin-deg 40",
        "pmsmtool margins design.toml --monte-carlo 1000000 --scheduler tcp://10.0.0.5:8786",
        "pmsmtool margins design.toml --u-dc 480V 560V --magnet -20degC 110degC --voltage-headroom 0",
    ),
)
@click.argument("design", type=click.Path(path_type=Path))
@click.option("--monte-carlo", "samples", type=click.IntRange(0, 10**8), default=0, metavar="N", help="Random samples.")
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of the random samples.")
@click.option(
    "--scheduler", default="processes", metavar="NAME", help="local, processes, or a Dask scheduler's address."
)
@click.option("--workers", type=click.IntRange(1), metavar="N", help="Processes.  [default: one per core]")
@click.option("--phase-margin-deg", type=float, default=30.0, metavar="DEG", help="Least, of the current loops.")
@click.option("--gain-margin-db", type=float, default=4.0, metavar="DB", help="Least, of the current loops.")
@click.option("--speed-phase-margin-deg", type=float, default=30.0, metavar="DEG", help="Least, of the speed loop.")
@click.option("--voltage-headroom", type=float, metavar="RATIO", help="Least 1 - |v|/V_max.  [default: not judged]")
@click.option("--current-headroom", type=float, metavar="RATIO", help="Least 1 - |i|/I_max.  [default: not judged]")
@click.option("--thermal-headroom", type=float, metavar="RATIO", help="Least 1 - copper loss.  [default: not judged]")
@click.option("--u-dc", "U_dc_v", type=(_VOLTAGE, _VOLTAGE), metavar="LOW HIGH", help="Range of the DC link.  [+-5 %]")
@click.option("--winding", "T_winding_c", type=(_TEMPERATURE, _TEMPERATURE), metavar="LOW HIGH", help="Winding.")
@click.option("--magnet", "T_magnet_c", type=(_TEMPERATURE, _TEMPERATURE), metavar="LOW HIGH", help="Magnet.")
@output_options
def margins_command(
    design: Path,
    samples: int,
    seed: int,
    scheduler: str,
    workers: int | None,
    U_dc_v: tuple[float, float] | None,
    T_winding_c: tuple[float, float] | None,
    T_magnet_c: tuple[float, float] | None,
    out: Output,
    **asked: Any,
) -> None:
    """Judge DESIGN (or the design of a run directory) over the tolerance box of its machine.

    Loop margins and limit headroom are kept apart. The worst corner of the 95 % box is named with its sample; random
    samples give percentiles. Exit code 1 when a margin asked for fails at a corner or at the 5th percentile.
    """
    from pmsmtool.cli.scheduler import executor
    from pmsmtool.design.design_file import load_design
    from pmsmtool.design.margins import MarginRequest, margin_report
    from pmsmtool.design.tolerance import tolerance_box
    from pmsmtool.errors import CheckFailed

    file = inside(design, "design.toml")
    source = load_design(file)
    box = tolerance_box(source.machine, U_dc_v=U_dc_v, T_winding_c=T_winding_c, T_magnet_c=T_magnet_c)
    if scheduler == "processes" and samples < IN_PROCESS and workers is None:
        scheduler = "local"
    with executor(scheduler, workers) as pool:
        report = margin_report(
            source, box, MarginRequest(**asked), samples=samples, seed=seed, executor=pool,
            progress=lambda done, wanted: out.status(f"{done} of {wanted} samples"),
        )  # fmt: skip
    out.result("margins", {"design": file, "seed": seed, "ok": report.ok, "report": report}, lambda: _lines(report))
    for note in report.notes:
        out.note(note)
    if not report.ok:
        bad = [spread.name for spread in (*report.loops, *report.headroom) if not spread.ok]
        raise CheckFailed(
            f"margins asked for are not met: {', '.join(bad)}",
            where=str(file),
            hint="lower the bandwidth, narrow the tolerances by identification, or ask for less",
        )


def _lines(report: MarginReport) -> Iterator[str]:
    yield f"loop margins over {report.corners} corners" + (f" and {report.samples} samples" if report.samples else "")
    yield from _table(report.loops)
    yield ""
    yield "limit headroom of the references for the nominal machine (1: nothing needed, 0: at the limit)"
    yield from _table(report.headroom)
    for name in ("headroom_voltage", "headroom_current"):
        spread = next(s for s in report.headroom if s.name == name)
        if spread.worst < 0.0:
            yield f"worst {name}: {spread.worst_cell}"
    if report.cells:
        yield ""
        yield from table(
            ("cell beyond a limit", "voltage %", "current %"),
            [(risk.cell, f"{100.0 * risk.voltage:.3g}", f"{100.0 * risk.current:.3g}") for risk in report.cells],
        )
    if report.unreachable:
        yield ""
        yield f"not reached by the nominal machine: {report.unreachable[0]}" + (
            f" and {len(report.unreachable) - 1} more" if len(report.unreachable) > 1 else ""
        )


def _table(spreads: Sequence[Spread]) -> list[str]:
    random = bool(spreads and spreads[0].percentiles)
    heads = [
        "quantity",
        "unit",
        "nominal",
        "worst corner",
        *(["p1", "p5", "p50"] if random else []),
        "asked",
        "verdict",
    ]
    rows = []
    for s in spreads:
        shares = [f"{s.percentiles[p]:.4g}" for p in (1.0, 5.0, 50.0)] if random else []
        asked = "-" if s.least is None else f"{s.least:g}"
        verdict = "-" if s.least is None else "PASS" if s.ok else "FAIL"
        rows.append([s.name, s.unit, f"{s.nominal:.4g}", f"{s.worst:.4g}", *shares, asked, verdict])
    return table(heads, rows)
