# SPDX-License-Identifier: MIT
"""How far a chain of stages has come: a live line on a terminal, one line per stage everywhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from pmsmtool.cli.output import Output
from pmsmtool.plain_text import plain

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from pmsmtool.run_directory import Stage


STEPS: Mapping[str, Sequence[tuple[str, float]]] = {
    "identify": (
        ("noise: ", 0.01), ("phases: ", 0.02), ("R and inverter: ", 0.05), ("pairs of phases: ", 0.26),
        ("pole pairs, direction, offset: ", 0.28), ("L_d, L_q: ", 0.37), ("flux and inertia, first", 0.43),
        ("psi_f and fine offset: ", 0.47), ("J, B, tau_c: ", 0.63), ("frequency response: ", 0.66),
        ("J/psi, tau_c/psi: ", 0.3), ("psi: the ", 0.8), ("R, psi, L_q, J: ", 0.3), ("voltage off, ", 0.98),
    ),
    "flash": (("writing and reading back ", 0.05), ("storing", 0.3), ("resetting the drive ", 0.6)),
    "prove": (
        ("predicting ", 0.02), ("prediction committed", 0.4), ("speed step ", 0.5), ("i_q steps ", 0.6),
        ("i_d steps ", 0.7), ("i_q step to ", 0.8), ("speed ramp ", 0.85), ("voltage off, ", 0.98),
    ),
}  # fmt: skip
"""How the steps of a stage begin, and the share of the stage's time that has passed when they do: in the README's
session, whose identification takes 66 s on the drive's clock."""
LEAST_SHARE = 0.04
"""Share of a stage from which its remaining time is said: before, what has passed tells nothing."""
BAR = 20
"""Width of the bar (characters)."""


class StageProgress:
    """Tells the stages on standard error; implements ``commissioning.commission.Progress``.

    ``out``: where the lines go; quiet says nothing, ``-v`` every step.
    """

    def __init__(self, out: Output) -> None:
        self._out = out
        self._live: Progress | None = None
        self._task: TaskID | None = None
        self._head, self._stage, self._began, self._share = "", "", 0.0, 0.0

    def skip(self, stage: Stage, number: int, count: int) -> None:
        """Say how a stage ended that was run before."""
        self._out.note(f"[{number}/{count}] {stage.name:<9} {stage.status.upper()}  as recorded, not run again")

    def begin(self, name: str, number: int, count: int) -> None:
        """Show the stage while it runs."""
        self._head, self._stage, self._share = f"[{number}/{count}] {name}", name, 0.0
        self._began = time.monotonic()
        self.resume()

    def resume(self) -> None:
        """Show the stage again after a question."""
        if self._out.verbosity < 0 or not sys.stderr.isatty():
            return
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn
        from rich.table import Column

        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=BAR),
            TextColumn("{task.fields[share]:>4} {task.fields[left]:<14}", markup=False),
            TextColumn("{task.fields[action]}", markup=False, table_column=Column(ratio=1, no_wrap=True)),
        )
        self._live = Progress(*columns, console=Console(stderr=True), transient=True, expand=True)
        self._task = self._live.add_task(self._head, total=None, share="", left="", action="")
        self._show()
        self._live.start()

    def _show(self) -> None:
        """Draw the share of the stage's time that has passed; a stage without known steps has a bar that runs."""
        if self._live is None or self._task is None or not self._share:
            return
        left = (time.monotonic() - self._began) * (1.0 - self._share) / self._share
        self._live.update(
            self._task, total=1.0, completed=self._share, share=f"{100.0 * self._share:.0f} %",
            left=f"{left // 60:.0f}:{left % 60:02.0f} left" if self._share > LEAST_SHARE else "",
        )  # fmt: skip

    def say(self, text: str) -> None:
        """Show a step inside the stage."""
        text = plain(text)
        if text.startswith("interrupted"):  # the stage ends here, not with its last step
            self._stage, self._share = "", 0.0
            if self._live is not None:
                self.pause()
                self.resume()
        reached = (share for start, share in STEPS.get(self._stage, ()) if text.startswith(start))
        self._share = next(reached, self._share)
        if self._live is None or self._task is None:
            self._out.detail(f"      {text}")
            return
        if not text.startswith(" "):  # those are results of a step, not the step
            self._live.update(self._task, action=text)
        self._show()
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
        if stage.name == "identify" and stage.values and text is not stage.summary:
            self._out.note(f"      measured: {stage.summary}")
        if any(row["stated"] is not None for row in stage.comparison):
            from pmsmtool.cli.output import table
            from pmsmtool.report.comparison import HEADS, table_cells

            for line in table(HEADS, table_cells(stage.comparison), indent=6):
                self._out.note(f"      {line}")
