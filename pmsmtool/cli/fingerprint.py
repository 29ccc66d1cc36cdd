# SPDX-License-Identifier: MIT
"""``pmsmtool identify --fingerprint RUN``: the values of an earlier run, measured again and compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pmsmtool.cli.output import table
from pmsmtool.errors import CheckFailed, ConfigError, Partial

if TYPE_CHECKING:
    from pmsmtool.identification.compared_runs import Difference
    from pmsmtool.identification.fingerprint import Earlier
    from pmsmtool.identification.request import IdentifyRequest
    from pmsmtool.run_directory import RunDirectory, Stage

HEADS = ("quantity", "then", "now", "difference", "interval", "verdict")


@dataclass(frozen=True, slots=True)
class Comparison:
    """A run beside an earlier one: the recorded stage, its rows, and what was not compared, with the reason."""

    earlier: Earlier
    stage: Stage
    rows: Sequence[Difference]
    left: Mapping[str, str]

    def facts(self) -> dict[str, Any]:
        """Return what ``--json`` says."""
        from pmsmtool.identification.fingerprint import verdict_of

        rows = [{**asdict(row), "verdict": verdict_of(row)} for row in self.rows]
        return {
            "run": self.earlier.run, "status": self.stage.status, "quantities": rows,
            "not_compared": dict(self.left), "likely": self.stage.note if self.stage.status == "fail" else "",
        }  # fmt: skip

    def lines(self) -> list[str]:
        """Return what a person reads."""
        from pmsmtool.identification.compared_runs import told
        from pmsmtool.identification.fingerprint import verdict_of

        cells = [(*told(row), verdict_of(row)) for row in self.rows]
        left = [f"not compared: {name}: {why}" for name, why in self.left.items()]
        return ["", f"compared with {self.earlier.run}:", *table(HEADS, cells), *left]

    def require_same(self, run: RunDirectory) -> None:
        """Raise ``CheckFailed`` where a value differs."""
        changed = [row.name for row in self.rows if row.verdict == "differs"]
        if changed:
            raise CheckFailed(
                f"{', '.join(changed)}: not as in {self.earlier.run}", where=str(run.path), likely=self.stage.note,
                hint="commission a machine that is another one anew; `pmsmtool diff` compares all values of two runs",
            )  # fmt: skip

    def require_whole(self, run: RunDirectory) -> None:
        """Raise ``Partial`` where a value could not be compared."""
        if self.left:
            raise Partial(
                f"{len(self.left)} of the values could not be compared with {self.earlier.run}", where=str(run.path),
                hint="the others agree; name the quantities that both runs have, or give another run",
                missing=[f"{name}: {why}" for name, why in self.left.items()],
            )  # fmt: skip


def earlier_run(path: Path, quantities: Sequence[str], method: str) -> tuple[Earlier, tuple[str, ...]]:
    """Return an earlier run and what of the quantities is asked to be compared.

    Raises ConfigError: it cannot be compared with: damaged, without these values, or of another level than ``method``.
    """
    from pmsmtool.identification.fingerprint import QUANTITIES, read_earlier
    from pmsmtool.run_directory import RunDirectory

    earlier = read_earlier(RunDirectory(path))
    if method not in ("auto", earlier.level):
        raise ConfigError(
            f"the run was measured with --method {earlier.level}, and {method} is asked for", where=str(path),
            likely="values of two methods have different errors", hint="leave --method out, or give another run",
        )  # fmt: skip
    asked = tuple(quantities) or QUANTITIES
    earlier.measurable(asked)
    return earlier, asked


def like_then(request: IdentifyRequest, earlier: Earlier, *, own_tolerance: bool) -> IdentifyRequest:
    """Return a request that measures what an earlier run has, as it did; in short where a drive allows that."""
    from pmsmtool.identification.fingerprint import ACCURACY

    inject = earlier.level == "inject"
    return replace(
        request,
        quantities=earlier.measurable(request.quantities),
        accuracy=(request.accuracy or ACCURACY) if inject else request.accuracy,
        tolerance=request.tolerance if own_tolerance else earlier.request.tolerance,
    )


def compare(earlier: Earlier, run: RunDirectory, asked: Sequence[str]) -> Comparison:
    """Compare a run with the earlier one, and record it there."""
    from pmsmtool.identification.fingerprint import fingerprint_stage

    stage, rows, left = fingerprint_stage(earlier, run, asked)
    run.add(stage)
    return Comparison(earlier, stage, rows, left)
