# SPDX-License-Identifier: MIT
"""``pmsmtool flash-params``: a parameter set into a drive, as a transaction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from pmsmtool.cli.drive_access import OWN_FAMILY, WHOLE_SET_S, map_of_drive, map_option, open_node, read_map
from pmsmtool.cli.fleet import NodeList, flash_fleet
from pmsmtool.cli.options import FILE, BusOptions, MotionOptions, bus_options, examples, output_options, write_options
from pmsmtool.cli.output import Output


@click.command(
    "flash-params",
    epilog=examples(
        "pmsmtool -i pmsmsim --yes flash-params params.toml",
        "pmsmtool -n 5 flash-params design.toml --dry-run",
        "pmsmtool -n 5 flash-params params.toml --check     # exit code 1 when the drive differs",
        "pmsmtool -i socketcan -c can0 flash-params RUN_DIR --nodes 2-6 --yes --serials serials.txt",
    ),
)
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--dry-run", is_flag=True, help="Show what would change and stop.")
@click.option("--check", is_flag=True, help="As --dry-run; exit code 1 when something would change.")
@click.option("--nodes", type=NodeList(), metavar="LIST", help="Several drives of the bus, e.g. 1-3,7.")
@click.option("--serials", type=FILE, help="With --nodes and --yes, without a prompt: a file with a line NODE "
              "SERIAL per drive.")  # fmt: skip
@click.option("--canary", type=click.Path(file_okay=False, path_type=Path), metavar="RUN_DIR", help="Run of a drive "
              "of this kind that passed `prove` with this set; needed by --serials.  [default: SOURCE]")  # fmt: skip
@click.option("--no-store", is_flag=True, help="Let it act until the next reset only.")
@map_option
@bus_options
@write_options
@output_options
def flash_params_command(
    bus: BusOptions,
    motion: MotionOptions,
    out: Output,
    source: Path,
    dry_run: bool,
    check: bool,
    no_store: bool,
    nodes: tuple[int, ...] | None,
    serials: Path | None,
    canary: Path | None,
    map_file: Path | None,
) -> None:
    """Write a parameter set, a design, a DCF or a run's parameters to the drive and store it.

    Only what differs is written. Before the first write the old contents are in a journal; everything is read back,
    activated together, stored, and compared again after a reset. Whatever fails, the old set comes back; after a power
    cut or a killed tool, the same command or `pmsmtool restore` finishes.
    """
    from pmsmtool.cli.flash_session import carry_out
    from pmsmtool.commissioning.parameter_source import load_parameters
    from pmsmtool.flash.download import set_named

    drive_map = read_map(map_file)
    wanted = load_parameters(source, None if map_file is None else drive_map)  # what cannot be read needs no bus
    if (source / "run.json").is_file():
        from pmsmtool.commissioning.report_page import verdict

        if (found := verdict(source)).word != "PASS":
            out.warn(f"the run ended so: {found.headline}")
    if nodes is None and (serials or canary):
        raise click.UsageError("--serials and --canary go with --nodes")
    if map_file is None:
        drive_map = map_of_drive(bus if nodes is None else replace(bus, node=nodes[0]), None, OWN_FAMILY)
        wanted = load_parameters(source, drive_map)
    if nodes is not None:
        flash_fleet(
            nodes, wanted, drive_map, bus, motion, out, store=not no_store, dry_run=dry_run, check=check,
            serials=serials, canary=canary or (source if source.is_dir() else None),
        )  # fmt: skip
        return
    with set_named() as jobs, open_node(bus, drive_map, within_s=WHOLE_SET_S) as node:
        carry_out(
            node, jobs, wanted, bus, motion, out,
            command="flash-params", store=not no_store, dry_run=dry_run, check=check,
        )  # fmt: skip
