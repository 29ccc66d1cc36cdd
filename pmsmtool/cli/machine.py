# SPDX-License-Identifier: MIT
"""``pmsmtool machine``: machine files from what is printed on paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pmsmtool.cli.drive_access import new_file
from pmsmtool.cli.options import FILE, FREQUENCY, TIME, Quantity, examples, output_options
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import CheckFailed, ConfigError
from pmsmtool.files import refuse_source, write_file


class _LineCurrent(click.ParamType[float]):
    """A line current of a datasheet, as A peak."""

    name = "current"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return A peak; click's error names the option."""
        from pmsmtool.machine.datasheet import line_current

        try:
            return value if isinstance(value, float) else line_current(str(value))
        except ConfigError as error:
            parts = (error.what, error.likely, error.hint, "'9A block' is the direct current of block commutation")
            self.fail("; ".join(part for part in parts if part), param, ctx)


_LINE_CURRENT = _LineCurrent()
_BETWEEN = click.Choice(["line-line", "phase"])
_SOURCE = click.Choice(["datasheet", "meter", "guess"])


@click.group("machine", epilog=examples("pmsmtool machine new --help", "pmsmtool machine map measured.npz"))
def machine_command() -> None:
    """Make machine files; check and repair flux maps."""


_ONE_OF = (("--l, or --l-d and --l-q", ("L_h", "L_d_h", "L_q_h")), ("--ke or --kt", ("ke", "kt")))
"""Options of `machine new` of which one must be there."""


class _AllMissingAtOnce(click.Command):
    """A command that names every missing option in one error."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse as click does; where an option is missing, look for all others that are."""
        typed = list(args)
        try:
            return super().parse_args(ctx, args)
        except click.MissingParameter as error:
            given, _, _ = self.make_parser(ctx).parse_args(args=typed)
            missing = [max(p.opts, key=len) for p in self.params if p.required and p.name not in given]
            missing += [text for text, names in _ONE_OF if not any(name in given for name in names)]
            raise click.UsageError(f"missing options: {', '.join(missing)}", ctx) from error


@machine_command.command(
    "new",
    cls=_AllMissingAtOnce,
    epilog=examples(
        "pmsmtool machine new --name m1 --pole-pairs 4 --r 0.274ohm --l 4.4mH --ke 60.7Vrms/krpm "
        "--ke-between line-line --i-nom 19.8Arms --u-dc 540V --pwm 12kHz -o m1.toml",
        "pmsmtool machine new --name m2 --pole-pairs 3 --connection delta --r 3.2ohm --r-between phase --l-d 30mH "
        "--l-q 42mH --l-between phase --kt 0.9Nm/Arms --u-dc 325V --pwm 10kHz --source meter -o m2.toml",
    ),
)
@click.option("--name", required=True, help="Name of the machine.")
@click.option("--pole-pairs", required=True, type=click.IntRange(1, 64), help="Pole pairs.")
@click.option("--connection", type=click.Choice(["star", "delta"]), default="star", help="Winding connection.")
@click.option("--r", "R_ohm", required=True, type=Quantity("resistance"), help="Resistance, e.g. 0.274ohm.")
@click.option("--r-between", "R_between", type=_BETWEEN, default="line-line", help="Where it is measured.")
@click.option("--r-temperature", "T_c", type=Quantity("temperature"), default="25degC", help="Temperature it is for.")
@click.option("--l", "L_h", type=Quantity("inductance"), help="Inductance of both axes, e.g. 4.4mH.")
@click.option("--l-d", "L_d_h", type=Quantity("inductance"), help="d inductance (the smaller line-line reading).")
@click.option("--l-q", "L_q_h", type=Quantity("inductance"), help="q inductance (the larger line-line reading).")
@click.option("--l-between", "L_between", type=_BETWEEN, default="line-line", help="Where they are measured.")
@click.option("--ke", help="Back-EMF constant: 58Vrms/krpm, 0.39Vpks/rad, 190rpm/Vpk, '251rpm/V block', or 0.41Wb.")
@click.option("--ke-between", type=_BETWEEN, help="Where the back-EMF is measured.")
@click.option("--kt", help="Torque constant: 1.74Nm/Arms, 85mNm/Apk, '38mNm/A block'.")
@click.option("--i-nom", "I_nom_apk", type=_LINE_CURRENT, help="Rated line current, e.g. 19.8Arms, '9A block'.")
@click.option("--i-peak", "I_max_apk", type=_LINE_CURRENT, help="Short-time line current, e.g. 40Arms.")
@click.option("--n-nom", "n_nom_rpm", type=Quantity("rpm"), metavar="SPEED", help="Rated speed, e.g. 3000rpm.")
@click.option("--n-max", "n_max_rpm", type=Quantity("rpm"), metavar="SPEED", help="Largest speed, e.g. 6000rpm.")
@click.option("--inertia", "J_kgm2", type=Quantity("inertia"), help="Inertia, e.g. 12kgcm2.")
@click.option("--u-dc", "U_dc_v", required=True, type=Quantity("voltage"), help="DC-link voltage, e.g. 540V.")
@click.option("--pwm", "f_s_hz", required=True, type=FREQUENCY, help="Control frequency, e.g. 12kHz.")
@click.option("--dead-time", "dead_time_s", type=TIME, default="0s", help="Dead time, e.g. 2us.")
@click.option("--encoder-bits", type=click.IntRange(8, 32), help="Encoder counts per turn, as bits: 12 for 4096.")
@click.option("--source", type=_SOURCE, default="datasheet", help="Where the numbers come from; sets the deviations.")
@click.option("--r-source", type=_SOURCE, help="As --source, for the resistance.", show_default=False)
@click.option("--l-source", type=_SOURCE, help="As --source, for the inductances.", show_default=False)
@click.option("--psi-source", type=_SOURCE, help="As --source, for the flux.", show_default=False)
@new_file("path", required=True, help="Machine file to write.")
@output_options
def new_command(path: Path, out: Output, **given: Any) -> None:
    """Write a machine file from a datasheet or meter readings.

    Line-line or phase, star or delta, rms or peak: every conversion is printed. A torque constant that contradicts the
    back-EMF constant is flagged (exit code 0; the file states which one was used). The table [simulation] is what
    `commission FILE --rehearse FAMILY` and `--eds` need; what is assumed for it is printed.
    """
    from pmsmtool.machine.datasheet import machine_from_datasheet
    from pmsmtool.machine.machine_file import dump_machine_file, parse_machine

    sheet, recognised = _sheet(given)
    result = machine_from_datasheet(sheet)
    text = dump_machine_file(result.machine_file)
    parse_machine(text, where=str(path))  # what the reader would refuse is not written
    write_file(path, text)
    rows = [(step.key, step.given, step.rule, step.result) for step in result.conversions]
    data = {
        "file": path,
        "machine": result.machine_file.machine,
        "std": result.machine_file.std,
        "conversions": result.conversions,
        "warnings": result.warnings,
    }
    out.result("machine-new", data, table(("key", "given", "rule", "result"), rows))
    if recognised:
        out.note(recognised)
    for warning in result.warnings:
        out.warn(warning)
    out.note(f"wrote {path}")


def _sheet(given: dict[str, Any]) -> tuple[Any, str]:
    """The datasheet of the command's options, and which ampere was recognised."""
    from pmsmtool.machine.datasheet import Datasheet, parse_emf_constant, parse_torque_constant, torque_constant_by_emf

    both, axes = given.pop("L_h"), (given["L_d_h"], given["L_q_h"])
    if None in axes if both is None else axes != (None, None):
        raise ConfigError("not one inductance of each axis", hint="give --l, or --l-d and --l-q")
    if both is not None:
        given["L_d_h"] = given["L_q_h"] = both
    common = given.pop("source")
    given["sources"] = {
        quantity: given.pop(f"{quantity.lower()}_source", None) or common for quantity in ("R", "L", "psi", "J")
    }
    ke, between, kt = given.pop("ke"), given.pop("ke_between"), given.pop("kt")
    given["K_e"] = None if ke is None else parse_emf_constant(ke, between)
    recognised = ""
    if kt is not None and given["K_e"] is not None:
        given["K_t"], recognised = torque_constant_by_emf(kt, given["K_e"], given["pole_pairs"], given["connection"])
    else:
        given["K_t"] = None if kt is None else parse_torque_constant(kt)
    return Datasheet(**given), recognised


@machine_command.command(
    "map",
    epilog=examples(
        "pmsmtool machine map measured.mat",
        "pmsmtool machine map measured.npz --fill-holes --rotate --symmetrise -o repaired.npz",
    ),
)
@click.argument("source", type=FILE)
@click.option("--fill-holes", "fill", is_flag=True, help="Fill nodes without a flux by the smoothest surface.")
@click.option("--rotate", "turn", is_flag=True, help="Turn the frame so that the no-load flux lies on the d axis.")
@click.option("--symmetrise", is_flag=True, help="Make psi_d even and psi_q odd in i_q.")
@click.option("--make-reciprocal", "reciprocal", is_flag=True, help="Move the fluxes least to a map with a co-energy.")
@click.option("-o", "--output", "path", type=FILE, help="Write the map as read and repaired (.npz or .csv).")
@output_options
def map_command(
    source: Path, fill: bool, turn: bool, symmetrise: bool, reciprocal: bool, path: Path | None, out: Output
) -> None:
    """Check a flux map: reciprocity, monotonicity, holes, rotation, asymmetry, each with its number.

    Repairs happen only on request, in the order fill, rotate, symmetrise, reciprocal, and each says what it changed.
    Exit code 1 when a number is outside its limit.
    """
    from pmsmtool.machine import flux_map_repair
    from pmsmtool.machine.flux_map_check import check_flux_map
    from pmsmtool.machine.flux_map_import import flux_map_csv, flux_map_npz, load_flux_map

    if path is not None and path.suffix.lower() not in (".npz", ".csv"):
        raise ConfigError(f"{path.name} is neither .npz nor .csv", hint="choose one of them")
    refuse_source(source, path)
    flux_map = load_flux_map(source, fill=fill)
    if turn:
        flux_map = flux_map_repair.rotate(flux_map, check_flux_map(flux_map).no_load_angle_rad)
    if symmetrise:
        flux_map = flux_map_repair.symmetrise(flux_map)
    if reciprocal:
        flux_map = flux_map_repair.make_reciprocal(flux_map)
    report = check_flux_map(flux_map)
    error = None if report.not_monotonic else flux_map.tables.inverse_error_a
    data = {"map": flux_map.meta, "interpolation": flux_map.interpolation(), "inverse_error_a": error, "report": report}
    lines = [f"{'ok  ' if finding.ok else 'BAD '} {finding.name}: {finding.text}" for finding in report.findings]
    lines += [f"done {text}" for text in (*flux_map.meta.get("notes", ()), *flux_map.meta.get("repairs", ()))]
    lines.append(f"     {flux_map.interpolation()}" + (f", at most {error:.3g} A off" if error is not None else ""))
    out.result("machine-map", data, lines)
    if path is not None:
        content = flux_map_npz(flux_map) if path.suffix.lower() == ".npz" else flux_map_csv(flux_map).encode()
        write_file(path, content)
        out.note(f"wrote {path}")
    if not report.ok:
        bad = [finding.name for finding in report.findings if not finding.ok]
        raise CheckFailed(", ".join(bad), where=str(source), hint="`pmsmtool machine map --help` lists what repairs it")
