# SPDX-License-Identifier: MIT
"""``pmsmtool export``: a design or a parameter set in the forms other programs take."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.drive_access import map_option, read_map
from pmsmtool.cli.options import ANY_PATH, DIR, FILE, NODE, examples, text_options
from pmsmtool.cli.output import Output
from pmsmtool.files import make_folder, read_bytes, refuse_source, write_file

if TYPE_CHECKING:
    from pmsmtool.drive_maps.drive_map import DriveMap
    from pmsmtool.params.parameter_set import ParameterSet

_SOURCE = click.argument("design", type=ANY_PATH)
_OUTPUT = click.option("-o", "--output", "path", type=FILE, help="File to write.  [default: standard output]")
_PREFIX = click.option("--prefix", default="pmsm", help="C identifier in front of every name.")
SHOWN = 5
"""Parameters that a warning names."""


@click.group(
    "export",
    epilog=examples("pmsmtool export c design.toml -o firmware", "pmsmtool export csv design.toml -o parameters.csv"),
)
def export_command() -> None:
    """Write a design as files for other programs.

    DESIGN is design.toml, params.toml, a .dcf or a run directory. Each file depends on the parameters alone: no date,
    no path, no name of a person.
    """


def _written(command: Callable[..., bytes | str]) -> Callable[..., None]:
    """Write what a command returns to ``-o`` or to standard output."""

    @functools.wraps(command)
    def write(path: Path | None, out: Output, **given: Any) -> None:
        refuse_source(given["design"], path)
        content = command(out=out, **given)
        if path is None:
            if isinstance(content, bytes) and b"\0" in content and sys.stdout.isatty():
                raise click.UsageError("binary data is not printed on a terminal: give -o FILE")
            click.echo(content, nl=False)
        else:
            write_file(path, content)
            out.note(f"wrote {path}")

    return write


def _parameters(design: Path, drive_map: DriveMap, out: Output, *, partly: bool = False) -> ParameterSet:
    """Read the set and say what the drive has no object for, and with ``partly`` what its object does not hold."""
    from pmsmtool.commissioning.parameter_source import load_parameters
    from pmsmtool.flash.plan import without_assumed

    wanted, kept = without_assumed(drive_map, load_parameters(design, drive_map))
    if partly:
        drive_map = drive_map.without(drive_map.refused(wanted))
    missing = drive_map.missing(wanted)
    made_on = _map_of_run(design)
    if drive_map.staging and made_on not in ("", drive_map.name):
        out.warn(f"{design}: the run is of a drive of the map {made_on!r}, and this file is for the reference drive: "
                 f"--map {made_on} makes one for that drive")  # fmt: skip
    if missing:
        few = ", ".join(missing[:SHOWN]) + (", ... (-v names all)" if len(missing) > SHOWN else "")
        count = f"{len(missing)} of {len(wanted.values) + len(wanted.tables)} parameters"
        out.warn(f"drive family {drive_map.name} has no object for {count}: {few}")
        if len(missing) > SHOWN:
            out.detail(f"no object for {', '.join(missing)}")
    for name, why in {**drive_map.not_written(missing), **kept}.items():
        (out.note if name in (*drive_map.left_out, *kept) else out.detail)(f"not written: {name}: {why}")
    for name in wanted.values:
        if name in drive_map.cells:
            out.detail(f"written: {drive_map.row_text(name)}")
    return wanted


def _map_of_run(design: Path) -> str:
    from pmsmtool.run_directory import RunDirectory

    return str(RunDirectory(design).read().drive.get("map", "")) if (design / "run.json").is_file() else ""


@export_command.command(
    "dcf",
    epilog=examples(
        "pmsmtool export dcf design.toml --node 5 -o drive5.dcf",
        "pmsmtool export dcf design.toml --into vendor.eds --map vendor-map.toml -o drive.dcf",
    ),
)
@_SOURCE
@click.option("--into", type=FILE, help="EDS or DCF to lay the values into; its other bytes are kept.")
@click.option("-n", "--node", "node_id", type=NODE, default=1, help="Node id for a file that names none.")
@map_option
@_OUTPUT
@text_options
@_written
def dcf_command(design: Path, into: Path | None, node_id: int, map_file: Path | None, out: Output) -> bytes:
    """Write a device configuration file (CiA 306)."""
    from pmsmtool.commissioning.export import dcf_file
    from pmsmtool.drive_maps.eds import parse_eds
    from pmsmtool.drive_maps.sheet_check import family_of_sheet, other_identity

    drive_map, given = read_map(map_file), map_file is not None
    if into is None and map_file is not None:
        raise click.UsageError("--map needs --into: the data sheet of that drive")
    base = None if into is None else read_bytes(into, hint="give with --into an EDS or DCF that you may read")
    if base is not None:
        sheet = parse_eds(base, str(into))
        family = None if given else family_of_sheet(sheet)
        drive_map, given = family or drive_map, given or family is not None
        differs = other_identity(sheet, drive_map)
        if differs and given:
            out.warn(f"{into}: {differs}")
    wanted = _parameters(design, drive_map, out)
    known = drive_map if given else None
    return dcf_file(wanted, drive_map=known, base=base, node_id=node_id, where=str(into or "EDS"))


@export_command.command("cdcf", epilog=examples("pmsmtool export cdcf design.toml -o drive.cdcf"))
@_SOURCE
@map_option
@_OUTPUT
@text_options
@_written
def cdcf_command(design: Path, map_file: Path | None, out: Output) -> bytes:
    """Write a concise DCF (CiA 302-2): what a CANopen manager sends at boot-up.

    A complete set is framed by the staging commands of the drive, so that the drive activates it as a whole.
    """
    from pmsmtool.commissioning.export import concise_dcf

    drive_map = read_map(map_file)
    return concise_dcf(_parameters(design, drive_map, out), drive_map=drive_map)


@export_command.command("header", epilog=examples("pmsmtool export header design.toml --prefix left -o left_cfg.h"))
@_SOURCE
@_PREFIX
@_OUTPUT
@text_options
@_written
def header_command(design: Path, prefix: str, out: Output) -> str:
    """Write one C header with the parameters as a static constant."""
    from pmsmtool.commissioning.export import image_of
    from pmsmtool.commissioning.parameter_source import load_parameters
    from pmsmtool.firmware.export_c import header_file

    wanted = load_parameters(design)
    return header_file(image_of(wanted), prefix=prefix, design_id=wanted.content_hash())


@export_command.command("c", epilog=examples("pmsmtool export c design.toml --prefix left -o firmware"))
@_SOURCE
@_PREFIX
@click.option(
    "-o",
    "--output",
    "folder",
    type=DIR,
    required=True,
    help="Folder to write into; made when it is not there.",
)
@click.option("--fixed-point", is_flag=True, help="Add the reference governor in Q4.27, for parts without an FPU.")
@click.option("--all-laws", is_flag=True, help="Keep laws that DESIGN does not use: for two motors, or later sets.")
@text_options
def c_command(design: Path, prefix: str, folder: Path, fixed_point: bool, all_laws: bool, out: Output) -> None:
    """Write the parameters, the control core and an application around it as C99 sources, with a README.md.

    They are what the simulated drive runs, less the laws that DESIGN does not use. README.md says how to build and
    call them, what a period costs, and what to do at a fault. The application (speed estimate, trips, quick stop,
    excitation, recorder) is optional. Values that neither reads are for your program; they are listed.
    """
    from pmsmtool.commissioning.export import image_of
    from pmsmtool.commissioning.parameter_source import load_parameters
    from pmsmtool.firmware.export_c import c_files, not_read
    from pmsmtool.firmware.export_readme import period_share

    wanted = load_parameters(design)
    files = c_files(image_of(wanted), prefix=prefix, design_id=wanted.content_hash(), all_laws=all_laws)
    if fixed_point:
        from pmsmtool.commissioning.export import q_files

        files |= q_files(wanted.values, prefix=prefix, design_id=wanted.content_hash())
    make_folder(folder)
    for name, text in files.items():
        write_file(folder / name, text)
    out.note(f"wrote {len(files)} files to {folder}")
    others = sorted({path.name for path in folder.glob("*.[ch]")} - set(files))
    if others:
        few = ", ".join(others[:SHOWN]) + (", ..." if len(others) > SHOWN else "")
        out.warn(f"{folder}: {len(others)} C files there are not of this export: {few}")
    out.note(f"for your program, not read by these files: {', '.join(not_read())}")
    if (share := period_share(wanted.values)) > 1.0:
        out.warn(
            f"the worst counted period takes {100 * share:.0f} % of the control period on a Cortex-M4F at 170 MHz "
            "(README.md, Cost): lower the control frequency, choose a lighter law (`tune --governor`), or a faster part"
        )


@export_command.command("csv", epilog=examples("pmsmtool export csv design.toml -o parameters.csv"))
@_SOURCE
@map_option
@_OUTPUT
@text_options
@_written
def csv_command(design: Path, map_file: Path | None, out: Output) -> str:
    """Write a table: value asked for and held, unit, object, type, bytes, meaning."""
    from pmsmtool.commissioning.export import csv_text

    drive_map = read_map(map_file)
    return csv_text(_parameters(design, drive_map, out, partly=True), drive_map=drive_map)


@export_command.command("params", epilog=examples("pmsmtool export params design.toml -o params.toml"))
@_SOURCE
@_OUTPUT
@text_options
@_written
def params_command(design: Path, out: Output) -> str:
    """Write the parameter set that flash-params sends."""
    from pmsmtool.commissioning.export import checked
    from pmsmtool.commissioning.parameter_source import load_parameters

    return checked(load_parameters(design)).to_toml()
