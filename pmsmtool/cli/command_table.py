# SPDX-License-Identifier: MIT
"""The table of commands. To add one: write ``pmsmtool/cli/<command>.py`` and add a row here.

The row is all that ``pmsmtool --help`` and completion read; the module is imported when its command runs.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

COMPLETE_VARIABLE = "_PMSMTOOL_COMPLETE"
"""Set by the scripts of ``pmsmtool completion``; with it the program answers completions instead of running."""

COMMON_TO_ALL = frozenset({"verbose", "quiet", "version", "help"})
"""Global options that mean something to every command."""


class Section(Enum):
    """Sections of ``pmsmtool --help``: what a command does to the machine."""

    LOOK = "Look"
    MOVE = "Move the machine"
    COMPUTE = "Compute"
    WRITE = "Write to the drive"
    TOOL = "The tool itself"


@dataclass(frozen=True, slots=True)
class Row:
    """One command."""

    name: str
    """What is typed; kebab-case."""
    target: str
    """``module:attribute`` of the click command."""
    section: Section
    """Where the help lists it."""
    help: str
    """One sentence; the short help everywhere."""


COMMANDS: tuple[Row, ...] = (
    Row("doctor", "pmsmtool.cli.doctor:doctor_command", Section.LOOK, "Examine adapters, wiring and bit rate."),
    Row("scan", "pmsmtool.cli.scan:scan_command", Section.LOOK, "List the nodes on a bus."),
    Row("info", "pmsmtool.cli.info:info_command", Section.LOOK, "Show identity, state and parameter set."),
    Row("caps", "pmsmtool.cli.caps:caps_command", Section.LOOK, "Show what a drive can measure, and what is missing."),
    Row("monitor", "pmsmtool.cli.monitor:monitor_command", Section.LOOK, "Show live values."),
    Row("scope", "pmsmtool.cli.scope:scope_command", Section.LOOK, "Show live signals on a local page."),
    Row("fault", "pmsmtool.cli.fault:fault_command", Section.LOOK, "Show or reset faults."),
    Row("commission", "pmsmtool.cli.commission:commission_command", Section.MOVE, "Identify, design, flash, prove."),
    Row("nmt", "pmsmtool.cli.nmt:nmt_command", Section.WRITE, "Send a network management command."),
    Row("lss", "pmsmtool.cli.lss:lss_command", Section.WRITE, "Give node ids to nodes without one."),
    Row("stop", "pmsmtool.cli.stop:stop_command", Section.MOVE, "Stop a drive, confirmed."),
    Row("identify", "pmsmtool.cli.identify:identify_command", Section.MOVE, "Measure the machine on its drive."),
    Row("track", "pmsmtool.cli.track:track_command", Section.LOOK, "Follow R and psi while the machine runs."),
    Row("check", "pmsmtool.cli.check:check_command", Section.MOVE, "Look for wrong wiring at a first power-on."),
    Row("map", "pmsmtool.cli.map:map_group", Section.MOVE, "Measure the units of a drive's gains."),
    Row("jog", "pmsmtool.cli.jog:jog_command", Section.MOVE, "Move for a short time, within limits."),
    Row("move", "pmsmtool.cli.move:move_command", Section.MOVE, "Move there and back, and see how it follows."),
    Row("prove", "pmsmtool.cli.prove:prove_command", Section.MOVE, "Show that the machine does what was designed."),
    Row("param", "pmsmtool.cli.param:param_command", Section.WRITE, "Read, write, compare parameters."),
    Row("flash-params", "pmsmtool.cli.flash_params:flash_params_command", Section.WRITE, "Write and store a set."),
    Row("verify", "pmsmtool.cli.verify:verify_command", Section.LOOK, "Compare what a drive holds."),
    Row("backup", "pmsmtool.cli.backup:backup_command", Section.LOOK, "Save everything a drive holds."),
    Row("restore", "pmsmtool.cli.restore:restore_command", Section.WRITE, "Bring a backup or download back."),
    Row("machine", "pmsmtool.cli.machine:machine_command", Section.COMPUTE, "Make a machine file from a datasheet."),
    Row("tune", "pmsmtool.cli.tune:tune_command", Section.COMPUTE, "Design the control of a machine."),
    Row("diff", "pmsmtool.cli.compare_runs:diff_command", Section.COMPUTE, "Compare two runs with their intervals."),
    Row("fleet", "pmsmtool.cli.fleet_runs:fleet_command", Section.COMPUTE, "Show the statistics of many runs."),
    Row("report", "pmsmtool.cli.report:report_command", Section.COMPUTE, "Write the report of a run."),
    Row("export", "pmsmtool.cli.export:export_command", Section.COMPUTE, "Write a design as DCF, C, CSV."),
    Row("margins", "pmsmtool.cli.margins:margins_command", Section.COMPUTE, "Judge a design over its tolerances."),
    Row("lut", "pmsmtool.cli.lut:lut_command", Section.COMPUTE, "Make current references over torque and speed."),
    Row("simulate", "pmsmtool.cli.simulate:simulate_command", Section.COMPUTE, "Run the closed loop in simulation."),
    Row("reproduce", "pmsmtool.cli.reproduce:reproduce_command", Section.COMPUTE, "Recompute figures of the papers."),
    Row("sim", "pmsmtool.cli.sim:sim_command", Section.TOOL, "Serve simulated drives to other programs."),
    Row("help", "pmsmtool.cli.help_topics:help_command", Section.TOOL, "Explain a topic or a command."),
    Row("completion", "pmsmtool.cli.completion:completion_command", Section.TOOL, "Print a shell's completion script."),
)


def load_command(row: Row) -> click.Command:
    """Import the command of a row of the table."""
    module, attribute = row.target.split(":")
    command: click.Command = getattr(importlib.import_module(module), attribute)
    command.short_help = row.help
    return command


def parameter_names(command: click.Command) -> set[str]:
    """Return the parameters of a command and of all commands below it."""
    names = {parameter.name for parameter in command.params if parameter.name}
    if isinstance(command, click.Group):
        for child in command.commands.values():
            names |= parameter_names(child)
    return names


def unused_options(ctx: click.Context, command: click.Command) -> list[str]:
    """Return the options typed before a command that it would silently ignore."""
    taken = parameter_names(command) | COMMON_TO_ALL
    return [
        max(parameter.opts, key=len)
        for parameter in ctx.command.params
        if parameter.name
        and parameter.name not in taken
        and ctx.get_parameter_source(parameter.name) is ParameterSource.COMMANDLINE
    ]


class LazyGroup(click.Group):
    """The top-level group; its commands stand in :data:`COMMANDS`."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the table."""
        return [row.name for row in COMMANDS]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command, importing its module."""
        row = next((row for row in COMMANDS if row.name == cmd_name), None)
        return None if row is None else load_command(row)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command, or say which one was probably meant."""
        name = args[0]
        command = self.get_command(ctx, name)
        if command is None:
            from difflib import get_close_matches

            near = get_close_matches(name, self.list_commands(ctx), n=1)
            raise click.UsageError(f"no such command: {name}" + (f"; did you mean {near[0]}?" if near else ""), ctx)
        ignored = unused_options(ctx, command)
        if ignored:
            raise click.UsageError(f"{name} takes no {', '.join(ignored)}", ctx)
        return name, command, args[1:]

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Put the commands before the options: they are what a newcomer looks for."""
        self.format_commands(ctx, formatter)
        click.Command.format_options(self, ctx, formatter)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands by what they do to the machine, without importing one."""
        width = max(len(row.name) for row in COMMANDS)
        for section in Section:
            rows = [(row.name.ljust(width), row.help) for row in COMMANDS if row.section is section]
            if rows:
                with formatter.section(section.value):
                    formatter.write_dl(rows)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete command names from the table, and options as click does."""
        from click.shell_completion import CompletionItem

        rows = (CompletionItem(row.name, help=row.help) for row in COMMANDS if row.name.startswith(incomplete))
        return [*rows, *click.Command.shell_complete(self, ctx, incomplete)]


def leaves(rows: Iterable[Row] = COMMANDS) -> Iterator[tuple[str, click.Command]]:
    """Yield every command that runs, as it is typed after ``pmsmtool``; imports them all."""
    for row in rows:
        yield from _leaves(row.name, load_command(row))


def _leaves(typed: str, command: click.Command) -> Iterator[tuple[str, click.Command]]:
    if not isinstance(command, click.Group):
        yield typed, command
        return
    for name, child in command.commands.items():
        yield from _leaves(f"{typed} {name}", child)
