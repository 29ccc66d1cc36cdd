# SPDX-License-Identifier: MIT
"""``pmsmtool lut``: current references over torque and speed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.options import FILE, NPZ, Quantity, examples, output_options, overspeed_option
from pmsmtool.cli.output import Output, figure_format, save_figure
from pmsmtool.files import write_file

if TYPE_CHECKING:
    from pmsmtool.design.lookup.design import LookupDesign
    from pmsmtool.machine.uncontrolled_generation import Protection

_TEMPERATURE = Quantity("temperature")


@click.command(
    "lut",
    epilog=examples(
        "pmsmtool lut design.toml -o lut.npz",
        "pmsmtool lut machine.toml -o lut.npz --torque-points 100 --speed-points 100 --plot lut.svg",
        "pmsmtool lut machine.toml -o lut.npz && pmsmtool -n 5 flash-params lut.npz",
        "pmsmtool lut machine.toml -o hot.npz --winding 140degC --magnet 110degC --u-dc 510V --u-dc 540V",
    ),
)
@click.argument("source")
@click.option("-o", "--output", "path", type=NPZ, required=True, help="Table to write (.npz); a .csv goes beside it.")
@click.option("--axis", type=click.Choice(["speed", "flux"]), default="speed", help="Second axis.")
@click.option("--torque-points", type=int, metavar="N", help="Uniform torque axis.  [default: refined to the bounds]")
@click.option("--speed-points", "y_points", type=int, metavar="N", help="Uniform second axis.")
@click.option(
    "--torque-bound",
    type=float,
    metavar="RATIO",
    help="Torque error between nodes / T_max.  [default: 0.01, or the next larger one that fits the drive]",
)
@click.option("--voltage-bound", type=float, metavar="RATIO", help="Voltage excess there / limit.  [default: as above]")
@click.option("--stored", type=click.Choice(["auto", "float32", "int16"]), default="auto", help="Format in the drive.")
@click.option(
    "--u-dc", "U_dc_v", type=Quantity("voltage"), multiple=True, help="DC-link voltage; several: an axis, refined."
)
@click.option("--winding", "T_winding_c", type=_TEMPERATURE, help="Winding temperature, e.g. 140degC.")
@click.option("--magnet", "T_magnet_c", type=_TEMPERATURE, help="Magnet temperature.")
@click.option("--n-max", "n_max_rpm", type=Quantity("rpm"), metavar="SPEED", help="Largest speed, e.g. 3000rpm.")
@click.option("--voltage-margin", type=float, metavar="RATIO", help="Share of V_max kept.  [default: the design's]")
@click.option("--iron-loss", type=FILE, help="Iron-loss map (.npz): least total loss instead of least copper loss.")
@click.option("--plot", "plot_path", type=FILE, help="Figure to write (.svg, .png, .pdf).")
@overspeed_option
@output_options
def lut_command(
    source: str,
    path: Path,
    voltage_margin: float | None,
    iron_loss: Path | None,
    plot_path: Path | None,
    overspeed_protection: Protection | None,
    out: Output,
    **asked: Any,
) -> None:
    """Make the current references of SOURCE, a machine file, a design, a run directory or a profile.

    Each cell has the currents of least loss for its torque and speed, motoring and generating. Limits are current,
    voltage, demagnetisation and the range of the flux map; the cell names the one that binds, and its margins.

    Without bounds the largest grid that fits the drive's memory is used. Exit code 1 when given bounds do not fit.
    """
    from pmsmtool.commissioning.design_stages import lut
    from pmsmtool.design.design_file import load_machine_or_design
    from pmsmtool.design.lookup.design import LookupRequest
    from pmsmtool.design.lookup.file import table_csv, table_facts, table_npz
    from pmsmtool.design.lookup.table import loci
    from pmsmtool.machine.flux_map_check import check_flux_map
    from pmsmtool.machine.iron_loss_map import load_iron_loss_map
    from pmsmtool.machine.machine_file import machine_path

    if plot_path is not None:
        figure_format(plot_path)
    machine, design = load_machine_or_design(source)
    if iron_loss is None and machine.machine.iron_loss_map is not None:
        iron_loss = machine_path(source).parent / machine.machine.iron_loss_map
    loss_map = None if iron_loss is None else load_iron_loss_map(iron_loss)
    made = lut(
        design or machine, LookupRequest(**asked),
        voltage_margin=voltage_margin, overspeed_protection=overspeed_protection, loss_map=loss_map,
    )  # fmt: skip
    facts, lines = table_facts(made.table, made.stored, made.error), loci(made.table)
    write_file(path, table_npz(made.table, facts, lines))
    write_file(path.with_suffix(".csv"), table_csv(made.table))
    written = [path, path.with_suffix(".csv")]
    if plot_path is not None:
        from pmsmtool.report.plots import lookup_figure

        save_figure(lookup_figure(made.table, lines), plot_path)
        written.append(plot_path)
    notes = list(made.notes)
    out.result("lut", {"files": written, "notes": notes, **facts, **_counts(made)}, lambda: str(made).splitlines())
    for note in (*notes, *(check_flux_map(machine.flux_map).complaints if machine.flux_map else ())):
        out.note(note)
    out.note(f"wrote {', '.join(map(str, written))}")


def _counts(made: LookupDesign) -> dict[str, Any]:
    names, counts = made.table.binding_counts()
    return {"cells": dict(zip(names, counts, strict=True)), "shape": made.table.i_d_a.shape}
