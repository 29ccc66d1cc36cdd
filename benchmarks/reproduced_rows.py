# SPDX-License-Identifier: MIT
"""Every checked number of ``pmsmtool reproduce``: figure, row, printed, expected, target, measured, source.

Run from the repository: ``python -m benchmarks.reproduced_rows [--seed 1] [--only NAME ...]``; about two minutes of one
core. Writes ``benchmarks/tables/reproduce.txt`` (``--only``: prints). Exit code 1 when a row does not hold.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from pmsmtool.papers.figure import Check
from pmsmtool.papers.registry import FIGURES, reproduce

TABLE = Path(__file__).resolve().parent / "tables" / "reproduce.txt"


def line(check: Check) -> str:
    """One row of the table."""
    unit = "" if check.unit == "1" else f" {check.unit}"
    printed, expected = ("-" if number is None else f"{number:.6g}{unit}" for number in check.two_columns)
    return " | ".join(
        (
            "yes" if check.within else "NO ", check.what, printed, expected, f"{check.allowed}{unit}",
            f"{check.ours:.4g}{unit}", check.where or "-",
        )
    )  # fmt: skip


def rows(seed: int, only: list[str]) -> tuple[list[str], int]:
    """All rows, a heading per figure, and how many do not hold."""
    lines, missed, count = [], 0, 0
    for figure in FIGURES:
        if only and figure.name not in only:
            continue
        checks = reproduce(figure.name, seed).checks
        lines += ["", f"{figure.name}: {figure.title}", *(line(check) for check in checks)]
        count += len(checks)
        missed += sum(not check.within for check in checks)
    return [
        f"{count} rows, {missed} do not hold. Columns: holds | number | printed in the paper | expected | target | "
        "measured | source.",
        *lines,
    ], missed


def main() -> int:
    """Compute, write, compare."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=[], help="figures; the table is printed, not written")
    asked = parser.parse_args()
    lines, missed = rows(asked.seed, asked.only)
    head = f"Checked numbers of `pmsmtool reproduce`, seed {asked.seed}, by `python -m benchmarks.reproduced_rows`."
    text = "\n".join([head, *lines]) + "\n"
    if asked.only:
        print(text, end="")
    else:
        TABLE.write_text(text, encoding="utf-8")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
