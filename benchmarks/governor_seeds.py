"""How far the numbers of the random governor figures move with the seed.

Run from the repository: ``python benchmarks/governor_seeds.py [--seeds 5] [--cases 300]``; about half a minute of one
core per seed. Every checked number is listed with its least and largest value over the seeds. Exit code 1 when one of
them is out of its range for a seed.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from pmsmtool.workflow.reproduce.figure import Check
from pmsmtool.workflow.reproduce.random_steps import plant_mismatch, random_steps, unreachable_references

FIGURES = {
    "governor-random-steps": random_steps,
    "governor-unreachable": unreachable_references,
    "plant-mismatch": plant_mismatch,
}


def main() -> int:
    """Print a table in Markdown; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--cases", type=int, default=300)
    asked = parser.parse_args()
    found: dict[tuple[str, str], list[Check]] = {}
    for name, figure in FIGURES.items():
        for seed in range(1, asked.seeds + 1):
            for check in figure(seed, asked.cases).checks:
                found.setdefault((name, check.what), []).append(check)
    print("| figure | number | least | largest | allowed | out of range |\n|---|---|---|---|---|---|")
    worst = 0
    for (name, what), checks in found.items():
        ours = [check.ours for check in checks if math.isfinite(check.ours)]
        bad = sum(not check.within for check in checks)
        worst += bad
        least, largest = (min(ours), max(ours)) if ours else (math.nan, math.nan)
        print(f"| {name} | {what} | {least:.5g} | {largest:.5g} | {checks[0].allowed} | {bad} of {len(checks)} |")
    return 1 if worst else 0


if __name__ == "__main__":
    sys.exit(main())
