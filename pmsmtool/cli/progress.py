# SPDX-License-Identifier: MIT
"""How far a chain of stages has come: a live line on a terminal, one line per stage everywhere."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from pmsmtool.cli.output import Output
from pmsmtool.plain_text import plain

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from pmsmtool.run_directory import Stage


class StageProgress:
    """Tells the stages on standard error; implements ``commissioning.commission.Progress``.

    Parameters
    ----------
    out : Output
        Where the lines go; quiet says nothing, ``-v`` every step.
    """

    def __init__(self, out: Output) -> None:
        self._out = out
        self._live: Progress | None = None
        self._task: TaskID | None = None
        self._head = ""

    def skip(self, stage: Stage, number: int, count: int) -> None:
        """Say how a stage ended that was run before."""
        self._out.note(f"[{number}/{count}] {stage.name:<9} {stage.status.upper()}  as recorded, not run again")

    def begin(self, name: str, number: int, count: int) -> None:
        """Show the stage while it runs."""
        self._head = f"[{number}/{count}] {name}"
        self.resume()

    def resume(self) -> None:
        """Show the stage again after a question."""
        if self._out.verbosity < 0 or not sys.stderr.isatty():
            return
        from rich.console import Console
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
        self._live = Progress(*columns, console=Console(stderr=True), transient=True)
        self._task = self._live.add_task(self._head, total=None)
        self._live.start()

    def say(self, text: str) -> None:
        """Show a step inside the stage."""
        text = plain(text)
        if self._live is None or self._task is None:
            self._out.detail(f"      {text}")
            return
        self._live.update(self._task, description=f"{self._head}  {text}")
        if self._out.verbosity >= 1:
            self._live.console.print(f"      {text}", markup=False, highlight=False)

    def pause(self) -> None:
        """Take the live line away, so that a question can be asked."""
        if self._live is not None:
            self._live.stop()
            self._live, self._task = None, None

    def end(self, stage: Stage, number: int, count: int) -> None:
        """Say how the stage ended, in one line."""
        self.pause()
        text = (
            stage.summary if stage.status in ("pass", "partial") else stage.note.splitlines()[0] if stage.note else ""
        )
        seconds = f"  ({stage.seconds:.1f} s)" if stage.seconds >= 0.05 else ""
        self._out.note(f"[{number}/{count}] {stage.name:<9} {stage.status.upper()}  {text}{seconds}".rstrip())
        if any(row["stated"] is not None for row in stage.comparison):
            from pmsmtool.cli.output import table
            from pmsmtool.report.comparison import HEADS, table_cells

            for line in table(HEADS, table_cells(stage.comparison)):
                self._out.note(f"      {line}")
