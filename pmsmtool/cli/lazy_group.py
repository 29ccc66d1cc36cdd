# SPDX-License-Identifier: MIT
"""A click group that imports a command's module only when that command runs."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from pmsmtool.cli.command_table import COMMANDS, Row, Section

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

COMPLETE_VARIABLE = "_PMSMTOOL_COMPLETE"
"""Set by the scripts of ``pmsmtool completion``; with it the program answers completions instead of running."""

COMMON_TO_ALL = frozenset({"verbose", "quiet", "version", "help"})
"""Global options that mean something to every command."""


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
