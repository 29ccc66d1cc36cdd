"""Random CAN frames and damaged files at the tool: no crash, no hang, no error that is not ours.

Run from the repository: ``python benchmarks/fuzz.py [N]`` (default 100 000 of each). Seeds are fixed, so that a failure
comes again.
"""

from __future__ import annotations

import json
import random
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from pmsmtool.drive.port import Identity
from pmsmtool.errors import ConfigError
from pmsmtool.firmware.drive_map import dump_drive_map, parse_drive_map, reference_map
from pmsmtool.flash.journal import Entry, Snapshot, check_sum, parse_snapshot
from pmsmtool.params.parameter_set import default_set, parse_parameter_set
from tests.bus.frame_fuzz import transfers
from tests.flash.rig import with_tables

BATCH = 1000
SNAPSHOT = Snapshot(
    "journal",
    "open",
    Identity(1, 2, 3, 4, 5, "drive"),
    7,
    "sha256:00",
    (Entry("motor.R_s_ohm", 0x2010, 2, b"abcd", b"efgh"),),
)


def _use_set(text: str) -> None:
    """Read a set and do with it what a download does before its first write."""
    found = parse_parameter_set(text.replace("content = ", "# "))
    if not found.violations():
        reference_map().encode(found)


def _use_snapshot(text: str) -> None:
    """Read a snapshot, also one whose check sum was made right again: damage must not hide behind it."""
    try:
        body = json.loads(text)
    except ValueError:
        body = None
    if isinstance(body, dict):
        body.pop("check", None)
        parse_snapshot(json.dumps({**body, "check": check_sum(body)}), "fuzz")
    parse_snapshot(text, "fuzz")


TEXTS: dict[str, tuple[str, Callable[[str], object]]] = {
    "parameter sets": (default_set().merged(with_tables(3)).to_toml(), _use_set),
    "drive maps": (dump_drive_map(reference_map()), parse_drive_map),
    "snapshots": (SNAPSHOT.dumps(), _use_snapshot),
}


def damaged(text: str, rng: random.Random) -> str:
    """Return a text with a few characters, lines or numbers changed."""
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(text) or 1)
        kind = rng.random()
        if kind < 0.3:
            text = text[:at] + chr(rng.randrange(1, 0x250)) + text[at + 1 :]
        elif kind < 0.5:
            text = text[:at] + text[at + rng.randrange(20) :]
        elif kind < 0.8:
            text = (
                text[:at]
                + rng.choice(("nan", "inf", "-1", "1e400", "[]", "{}", '""', "0x1_0", "true", "9" * 400))
                + text[at:]
            )
        else:
            lines = text.split("\n")
            lines.insert(rng.randrange(len(lines)), rng.choice(lines))
            text = "\n".join(lines)
    return text


def main() -> None:
    """Print how the inputs ended."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
    started = time.perf_counter()
    ended: Counter[str] = Counter()
    for seed in range(-(-count // BATCH)):
        ended.update(transfers(1000 + seed, BATCH))
    print(f"{sum(ended.values())} transfers of random frames: {dict(ended)}, {time.perf_counter() - started:.0f} s")
    for name, (text, use) in TEXTS.items():
        rng, started = random.Random(name), time.perf_counter()
        refused = 0
        for _ in range(count):
            try:
                use(damaged(text, rng))
            except ConfigError:
                refused += 1
        seconds = time.perf_counter() - started
        print(f"{count} damaged {name}: {refused} refused, {count - refused} usable, {seconds:.0f} s")


if __name__ == "__main__":
    main()
