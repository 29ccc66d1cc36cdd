# SPDX-License-Identifier: MIT
"""``pmsmtool help``: topics that belong to no single command."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import click

from pmsmtool.cli.command_table import COMMANDS
from pmsmtool.cli.options import examples
from pmsmtool.cli.output import table, terminal_width
from pmsmtool.errors import ExitCode
from pmsmtool.files import user_folder
from pmsmtool.plain_text import folded
from pmsmtool.units import UNITS

if TYPE_CHECKING:
    from pmsmtool.machine.key import Key

EXIT_CODES: dict[ExitCode, str] = {
    ExitCode.OK: "done, and good",
    ExitCode.CHECK_FAILED: "checked and not good: a margin, a comparison, a prediction; also an infeasible design",
    ExitCode.USAGE: "wrong command line, or a file or folder that cannot be used",
    ExitCode.BUS: "no bus, no drive on it, or the connection was lost",
    ExitCode.DRIVE: "the drive is in fault, or refused a value (SDO abort)",
    ExitCode.SAFETY: "refused by a safety limit before anything moved, or one was exceeded and the machine stopped",
    ExitCode.NOT_TRUSTWORTHY: "the measurement is not trustworthy, so no number is given (help refusals)",
    ExitCode.DECLINED: "declined at a prompt, or no terminal; what was asked about was not done",
    ExitCode.STOP_NOT_CONFIRMED: "STOP NOT CONFIRMED: the machine may be energised, use the hardware stop",
    ExitCode.NOT_AVAILABLE: "this drive cannot give that; what is missing is named",
    ExitCode.PARTIAL: "partial: what ran is good, but something asked for could not be had; it is named",
    ExitCode.INTERNAL: "a bug in pmsmtool; the traceback is in the file that is named",
    ExitCode.INTERRUPTED: "interrupted; a machine that moved was stopped, and the stop was confirmed",
    ExitCode.READER_GONE: "the reader of the output went away (| head), as with any filter",
}

_WIDTH = 120
"""Letters of a line where no terminal is."""

SAFETY = """\
Nothing moves and nothing is written without your consent; the two are asked one by one:
  motion   before the first current the envelope is printed: largest current, energy, speed, travel, duration, and \
what the shaft may do (--shaft, --load, --brake).
  writing  before the first write the list of differences is printed: name, old, new, unit.
--yes answers them on a simulated drive. On a real bus it needs --serial as well, and --i-max, --speed-max and --shaft \
where the machine moves. The serial number must be that of the drive that answers. A drive that shows no serial number \
is moved and written by a person at a terminal only. --yes cannot be set by an environment variable. Without a \
terminal and without a valid --yes nothing is done: exit 7.

A command that moved the machine always ends in the same way: voltage off, zero current, parameters restored, and the \
stop confirmed from the statusword. If the drive does not confirm it, the exit code is 8 whatever else went wrong: use \
the hardware stop. Ctrl-C, SIGTERM and a closed terminal do the same; a second Ctrl-C removes the voltage at once.

A software stop is no safety function. Keep a hardware stop within reach."""

FILES = """\
machine file     profiles/*.toml, machine.toml  the machine and its inverter, SI with the unit in the key (R_s_ohm); \
its keys: help machine-file, help simulation
flux map         .npz .mat .csv                 grids of i_d, i_q (A peak) and psi_d, psi_q (Wb)
iron-loss map    .npz                           axes i_d_a, i_q_a and grids c_h_w_per_hz, c_e_w_per_hz2 over them: \
P_fe = c_h f + c_e f^2, f the electrical frequency (Hz)
design file      design.toml                    gains and limits with their margins; the machine is embedded
parameter set    params.toml                    catalogue name and SI value; what is written to a drive
look-up table    .npz .csv                      i_d, i_q over torque and speed; which limit binds, and by how much; \
flash-params and export take the .npz
scenario         .toml                          what happens in a simulation (help scenario)
trace            .npz .csv                      named signals over t_s; the second CSV row holds the units
run directory    runs/<utc>-<serial>/           run.json, traces/, and the files above, as a commissioning leaves them
drive memory     .pmsmsim/<profile>.nv          non-volatile memory of a simulated drive

What is generated (designs, sets, tables, C, DCF) holds no dates, paths or names: same input, same bytes."""

ENVIRONMENT = """\
PMSMTOOL_INTERFACE PMSMTOOL_CHANNEL PMSMTOOL_BITRATE PMSMTOOL_NODE PMSMTOOL_SIM PMSMTOOL_TRACE_CAN
                       as -i -c -b -n --sim --trace-can; an option that is typed wins
PMSMTOOL_JSON PMSMTOOL_VERBOSE PMSMTOOL_QUIET
                       as --json -v -q
PMSMTOOL_HOME          folder for what must outlive a run (journals, locks, crash reports); now {home}
CAN_INTERFACE CAN_CHANNEL CAN_BITRATE CAN_CONFIG
                       python-can's own, with ~/can.conf (Linux and macOS also ~/.canrc); decide what is not given
NO_COLOR               no colours
CC                     when installing from source: the C compiler; CC=zig takes the pinned ziglang

Order: after the command, before the command, PMSMTOOL_*, python-can's configuration."""


def _units() -> str:
    rows = [(unit.symbol, unit.dimension, ", ".join(unit.spellings)) for unit in UNITS.values()]
    return "\n".join(
        [
            "A value carries its unit: 800Hz, 1.2mH, 1200rpm; prefixes p n u m k M G where the unit takes one.",
            "Spaces, * and ^ make no difference: gcm2, g cm2 and g*cm^2 are one unit.",
            "A current carries its kind too: 12Apk (amplitude) or 8.5Arms. A bare number where a unit is due: refused.",
            "An option or key that ends in a unit (--bandwidth-hz, R_s_ohm) takes the bare number in that unit.",
            "",
            "dq quantities are amplitudes (peak phase values), torque = 1.5 p (psi_d i_q - psi_q i_d), motoring "
            "positive, angles electrical, resistance and inductance per phase (star).",
            "",
            *table(("unit", "measures", "also written"), rows),
        ]
    )


def _exit_codes() -> str:
    rows = [(int(code), meaning) for code, meaning in EXIT_CODES.items()]
    return "\n".join(table(("code", "meaning"), sorted(rows)))


def _refusals() -> str:
    from pmsmtool.refusals import REFUSALS

    parts = ["A value that cannot be trusted is refused: exit code 6, and one of these names."]
    for row in REFUSALS.values():
        parts.append(f"\n{row.name}\n  {row.meaning}\n  likely: {row.likely}\n  try:    {row.next_step}")
    return "\n".join(parts)


def _default(key: Key) -> str:
    if key.required:
        return "required"
    if key.falls_back:
        return f"as {key.falls_back.split()[0]}"
    if key.kind == "bool":
        return str(key.default).lower()
    return "" if key.default in (None, ()) else f"{key.default:.6g}" if key.kind == "float" else str(key.default)


def _keys(keys: Iterable[Key]) -> list[str]:
    rows = []
    for key in keys:
        rows.append((key.name, "" if key.unit == "1" else key.unit, _default(key), key.meaning))
        if key.choices:
            rows.append(("", "", "", f"  one of {', '.join(key.choices)}"))
    return table(("key", "unit", "default", "meaning"), rows)


def _machine_file() -> str:
    from pmsmtool.machine.machine_keys import ENCODER_KEYS, ESTIMATE_KEYS, INVERTER_KEYS, LIMIT_KEYS, MACHINE_KEYS

    parts = ['A machine file starts with schema = "pmsmtool.machine/1" and name = "..."; then come these tables.', ""]
    for name, keys in (
        ("machine", MACHINE_KEYS), ("inverter", INVERTER_KEYS), ("encoder", ENCODER_KEYS), ("limits", LIMIT_KEYS),
        ("estimate.<key>", ESTIMATE_KEYS),
    ):  # fmt: skip
        parts += [f"[{name}]", *_keys(keys), ""]
    parts += [
        "[std], [systematic]: numeric keys of machine, inverter and encoder with one standard deviation, and with the "
        "half width of the 95 % systematic part, in the key's own unit.",
        "[conditions], [provenance]: free keys. [simulation]: help simulation. `pmsmtool machine new` writes a file.",
    ]
    return "\n".join(parts)


def _simulation() -> str:
    from pmsmtool.machine.simulation_keys import SIMULATION_KEYS
    from pmsmtool.sim.simulated_machine import DRIVE_FAULTS

    return "\n".join(
        [
            "[simulation] of a machine file is for the simulated drive alone; design commands ignore it.",
            "For one run: `simulate --set KEY=VALUE`, or a simulated drive --sim 'NAME?KEY=VALUE&KEY=VALUE'.",
            "",
            *_keys(SIMULATION_KEYS),
            "",
            *table(("drive_fault", "meaning"), DRIVE_FAULTS.items()),
        ]
    )


def _scenario() -> str:
    from pmsmtool.sim.scenarios import BUILT_IN, FILE_EXAMPLE, MODES, SCHEDULES

    return "\n".join(
        [
            f"Built in (`pmsmtool simulate --list`): {', '.join(BUILT_IN)}",
            "A scenario file:",
            "",
            FILE_EXAMPLE,
            f"mode: {', '.join(MODES)}",
            f"names of [schedule]: {', '.join(SCHEDULES)}",
        ]
    )


def _environment() -> str:
    return ENVIRONMENT.format(home=user_folder())


TOPICS: dict[str, tuple[str, Callable[[], str]]] = {
    "units": ("units, prefixes and conventions of every number", _units),
    "exit-codes": ("what a script can rely on", _exit_codes),
    "safety": ("consents, stops, and what --yes may answer", lambda: SAFETY),
    "files": ("the files that are read and written", lambda: FILES),
    "machine-file": ("keys of a machine file", _machine_file),
    "simulation": ("keys of [simulation]: what the simulated drive is like", _simulation),
    "scenario": ("what can happen in a simulation", _scenario),
    "environment": ("environment variables and their order", _environment),
    "refusals": ("named reasons for a refused value", _refusals),
}
"""Topic -> one line, text."""


@click.command("help", epilog=examples("pmsmtool help units", "pmsmtool help completion"))
@click.argument("topic", nargs=-1)
@click.pass_context
def help_command(ctx: click.Context, topic: tuple[str, ...]) -> None:
    """Explain a TOPIC, or a command; without one, list the topics."""
    if not topic:
        lines = [f"{name:<12}  {line}" for name, (line, _) in TOPICS.items()]
        commands = click.wrap_text(" ".join(row.name for row in COMMANDS), 79, "or a command: ", " " * 14)
        click.echo("\n".join([*lines, "", commands]))
        return
    if len(topic) == 1 and topic[0] in TOPICS:
        width = terminal_width(sys.stdout) or _WIDTH
        click.echo(
            "\n".join(part for line in TOPICS[topic[0]][1]().split("\n") for part in folded(line, width, hanging=0))
        )
        return
    click.echo(_command_help(ctx, topic))


def _command_help(ctx: click.Context, names: tuple[str, ...]) -> str:
    context = ctx.find_root()
    for name in names:
        group = context.command
        command = group.get_command(context, name) if isinstance(group, click.Group) else None
        if command is None:
            known = [*TOPICS, *group.list_commands(context)] if isinstance(group, click.Group) else []
            from difflib import get_close_matches

            near = get_close_matches(name, known, n=1)
            guess = f"did you mean {near[0]}?" if near else f"topics: {', '.join(TOPICS)}"
            raise click.UsageError(f"no topic and no command: {' '.join(names)}; {guess}", ctx)
        context = click.Context(command, parent=context, info_name=name)
    return context.get_help()
