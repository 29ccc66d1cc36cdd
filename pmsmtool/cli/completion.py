# SPDX-License-Identifier: MIT
"""``pmsmtool completion``: the shell's completion script."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from pmsmtool.cli.command_table import COMPLETE_VARIABLE
from pmsmtool.cli.options import examples
from pmsmtool.errors import NotAvailable


@click.command(
    "completion",
    epilog=examples(
        'eval "$(pmsmtool completion bash)"      # in ~/.bashrc',
        'eval "$(pmsmtool completion zsh)"       # in ~/.zshrc',
        "pmsmtool completion fish | source       # in ~/.config/fish/config.fish",
    ),
)
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion_command(ctx: click.Context, shell: str) -> None:
    """Print the completion script of a SHELL."""
    kind = get_completion_class(shell)
    if kind is None:
        raise NotAvailable(
            f"this version of click completes nothing for {shell}",
            hint="update click, or take bash, zsh or fish as `pmsmtool completion --help` shows",
        )
    click.echo(kind(ctx.find_root().command, {}, "pmsmtool", COMPLETE_VARIABLE).source())
