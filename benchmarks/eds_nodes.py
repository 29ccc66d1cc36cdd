# SPDX-License-Identifier: MIT
"""EDS files that nobody has seen: makers' objects with some taken away or changed, written in every odd way.

    python -m benchmarks.eds_nodes TABLE.csv [--files 200] [--first 0] [--motion 4] [--keep FOLDER]

From every seed follows a file: a family of the table (columns of ``sim/foreign/file_rows.py``), objects that are
missing, of another type, access or limit, and a text as makers write it: section names in any case, CR LF, a byte
order mark, Latin-1, compact sub-objects, `$NODEID`, decimal and hexadecimal numbers, sections twice, in any order, with
remarks.
`caps --eds` reads it; a node that is simulated from it is asked by `caps`; every ``--motion``-th node is moved by
`check` and commissioned. Counted are tracebacks, exit codes that a refusal or a part may not have, limits of the
simulated machine that were passed, and values that the node counts in another unit than the map.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from benchmarks.makers_drives import files_of, wrong_units
from pmsmtool.data_types import BY_SHORT
from pmsmtool.drive_maps.shipped_maps import family_names
from pmsmtool.errors import PmsmtoolError
from pmsmtool.machine.machine_file import load_machine_file, machine_path
from pmsmtool.sim.foreign.file_rows import read_makers_objects
from pmsmtool.sim.node.objects import ObjectRow

MACHINE = "interior-2k2"
LOST = 0.06
"""Share of objects that are missing; of those by which a drive is moved, twice as many."""
CHANGED = 0.05
"""Share of objects whose type, access, limit or value is another one."""
MOVING = frozenset(
    {0x1016, 0x100C, 0x100D, 0x1017, 0x1018, 0x6007, 0x605A, 0x605E, 0x6060, 0x6064, 0x606C, 0x6071, 0x6072, 0x6073}
    | {0x6075, 0x6076, 0x6077, 0x6078, 0x6079, 0x6080, 0x6087, 0x608F, 0x60A8, 0x60A9, 0x60C2, 0x60FF, 0x6502}
)  # fmt: skip
OTHER_TYPES = ("I8", "I16", "I32", "U8", "U16", "U32", "R32", "VSTR", "I64")
UNIT_WORDS = ("0x00B44700", "0xFDB44700", "0xFF410000", "0x00B40300", "0x00000000", "0xFE410300")
ALLOWED = {
    "caps": (0, 2, 4),
    "node": (0, 2, 4),
    "check": (0, 1, 2, 4, 5, 9, 10),
    "commission": (0, 1, 2, 4, 5, 6, 9, 10),
}
"""Exit codes of a command on a drive that cannot do everything; 70 is a defect of the program, 8 one of the stop."""
TEXTS = (
    "object",
    "Geschwindigkeit µ",
    "Größe °C",
    "100 % of %(rated)s",
    "a = b; c",
    "[sub]",
    "",
    "Überwachung",
    "x" * 300,
)


@dataclass(frozen=True, slots=True)
class Entry:
    """One object of a file, its numbers as text."""

    index: int
    sub: int
    name: str
    kind: str
    access: str
    value: str
    low: str
    high: str


def entry_of(row: ObjectRow) -> Entry:
    """Return a row of a node as an entry of a file."""
    low, high = ("" if limit is None else str(int(limit)) for limit in (row.low, row.high))
    return Entry(row.index, row.sub, row.name, row.type, row.access, row.default, low, high)


def mutated(entries: Sequence[Entry], chance: random.Random) -> list[Entry]:
    """Return the entries with some missing and some changed."""
    found = []
    for entry in entries:
        moving = entry.index in MOVING
        if chance.random() < (2.0 * LOST if moving else LOST):
            continue
        found.append(changed(entry, chance) if chance.random() < (2.0 * CHANGED if moving else CHANGED) else entry)
    for index, words in ((0x60A8, UNIT_WORDS), (0x60A9, UNIT_WORDS), (0x607E, ("0x80", "0x40", "0xC0"))):
        if chance.random() < 0.1:
            kind = "U8" if index == 0x607E else "U32"
            found = [e for e in found if e.index != index]
            found.append(Entry(index, 0, "unit", kind, "rw", chance.choice(words), "", ""))
    for sub, ratio in ((1, "10"), (2, "3")):
        if chance.random() < 0.05:
            found.append(Entry(0x6091, sub, "gear", "U32", "rw", ratio, "", ""))
    return list({(e.index, e.sub): e for e in found}.values())


def changed(entry: Entry, chance: random.Random) -> Entry:
    """Return one entry with another type, access, limit or value."""
    kind = chance.randrange(7)
    if kind == 0:
        return replace(entry, kind=chance.choice(OTHER_TYPES))
    if kind == 1:
        return replace(entry, access=chance.choice(("ro", "wo", "const", "RW", "rww", "", "read")))
    if kind == 2:
        return replace(entry, low="0", high=str(chance.choice((0, 1, 10, 100, 1000, 65535))))
    if kind == 3:
        return replace(
            entry, low=chance.choice(("0x80000000", "-5", "5", "x", "")), high=chance.choice(("", "0x7FFF", "3"))
        )
    if kind == 4:
        return replace(
            entry, value=chance.choice(("", "0", "1", "-1", "0xFFFFFFFF", "99999999999", "NaN", "1.5", "abc"))
        )
    if kind == 5:
        return replace(entry, value=chance.choice(("$NODEID+0x180", "$NodeID+5", "0x200+$NODEID", "$NODEID")))
    return replace(entry, name=chance.choice(TEXTS))


def number(text: str, chance: random.Random) -> str:
    """Return a number written another way, where it is a plain one."""
    try:
        value = int(text, 0)
    except ValueError:
        return text
    ways = [text, hex(value), hex(value).upper().replace("0X", "0x"), f" {value} "]
    return chance.choice(ways if value >= 0 else [text])


def cased(text: str, chance: random.Random) -> str:
    """Return a key or a section's name in some case."""
    return chance.choice((text, text, text.lower(), text.upper()))


def text_of(entries: Sequence[Entry], chance: random.Random) -> bytes:
    """Return the file."""
    blocks = [block_of(index, [e for e in entries if e.index == index], chance) for index in {e.index for e in entries}]
    if chance.random() < 0.3:
        chance.shuffle(blocks)
    head = [
        f"[{cased('FileInfo', chance)}]",
        "FileName=x.eds",
        f"[{cased('DeviceInfo', chance)}]",
        "ProductName=some drive",
    ]
    if chance.random() < 0.3:
        head += [
            f"[{chance.choice(('DeviceComissioning', 'DeviceCommissioning'))}]",
            f"NodeID={chance.choice(('1', '0x7F', ''))}",
        ]
    if chance.random() < 0.3:
        head += ["[Comments]", "Lines=1", "Line1=written by hand; 100 %"]
    lines = head + [line for block in blocks for line in block]
    if chance.random() < 0.1 and blocks:
        lines += chance.choice(blocks)
    end = chance.choice(("\n", "\n", "\r\n", "\r"))
    text = end.join(lines) + end
    encoding = chance.choice(("utf-8", "latin-1", "utf-8-sig", "cp1252"))
    return text.encode(encoding, "replace")


def block_of(index: int, entries: Sequence[Entry], chance: random.Random) -> list[str]:
    """Return the sections of one object."""
    head = cased(f"{index:04X}", chance)
    if len(entries) == 1 and entries[0].sub == 0:
        return [f"[{head}]", *lines_of(entries[0], chance)]
    lines = [f"[{head}]", "ParameterName=record", "ObjectType=0x9"]
    same = {(e.kind, e.access) for e in entries if e.sub}
    if len(same) == 1 and chance.random() < 0.2:  # compact: one description for all
        first = next(e for e in entries if e.sub)
        lines[2] = "ObjectType=8"
        lines += [*lines_of(first, chance)[2:], f"CompactSubObj={max(e.sub for e in entries)}", f"[{head}Value]"]
        return [*lines, f"NrOfEntries={len(entries)}", *(f"{e.sub}={e.value}" for e in entries if e.sub)]
    if chance.random() < 0.5:
        lines.append(f"SubNumber={len(entries)}")
    for entry in entries:
        lines += [f"[{head}{chance.choice(('sub', 'sub', 'Sub', 'SUB'))}{entry.sub:X}]", *lines_of(entry, chance)]
    return lines


def lines_of(entry: Entry, chance: random.Random) -> list[str]:
    """Return the keys of one entry."""
    code = BY_SHORT[entry.kind].code if entry.kind in BY_SHORT else 0xF
    equals = chance.choice(("=", "=", " = "))
    rows = [
        ("ParameterName", entry.name), ("ObjectType", chance.choice(("0x7", "7", "0x07", ""))),
        ("DataType", chance.choice((f"{code:#06x}", str(code), f"0x{code:X}"))), ("AccessType", entry.access),
        ("DefaultValue", number(entry.value, chance)), ("PDOMapping", "0"), ("LowLimit", number(entry.low, chance)),
        ("HighLimit", number(entry.high, chance)),
    ]  # fmt: skip
    lines = [f"{cased(key, chance)}{equals}{value}" for key, value in rows]
    return [*lines, chance.choice(("", "; a remark", "# another", ""))]


@lru_cache
def entries_of(source: str) -> tuple[Entry, ...]:
    """Return the objects of a family."""
    return tuple(entry_of(row) for row in read_makers_objects(source).rows.values())


def file_of(seed: int, sources: Sequence[str]) -> tuple[str, bytes]:
    """Return the label and the bytes of a seed's file."""
    chance = random.Random(f"eds {seed}")
    source = chance.choice(sources)
    entries = entries_of(source)
    return source.partition("#")[2] or Path(source).name, text_of(mutated(entries, chance), chance)


def is_drive(source: str) -> bool:
    """Whether a file is of a drive (CiA 402)."""
    try:
        return bool(entries_of(source))
    except PmsmtoolError:
        return False


def asked(*words: str) -> tuple[int, str]:
    """Run a command as a shell would; return its exit code and everything that it printed."""
    from pmsmtool.cli.main import run

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        code = run(words)
    return code, printed.getvalue()


def faults_of(
    seed: int, sources: Sequence[str], motion: int, keep: Path | None
) -> tuple[str, list[tuple[str, str]], list[str]]:
    """Return label, every command's exit code with its last words, and what must not be, of one seed."""
    label, data = file_of(seed, sources)
    said: list[tuple[str, str]] = []
    wrong: list[str] = []

    def ask(name: str, *words: str) -> int:
        code, text = asked(*words)
        last = " / ".join(text.strip().splitlines()[-4:])
        for crash in Path("crashes").glob("*"):
            last += " / " + " / ".join(crash.read_text(encoding="utf-8").strip().splitlines()[-3:])
            crash.unlink()
        said.append((f"{name} {code}", last))
        if "Traceback" in text or code not in ALLOWED[name]:
            wrong.append(f"{name}: exit {code}: {last}")
        elif code and not text.strip():
            wrong.append(f"{name}: exit {code} without a word")
        return code

    Path("x.eds").write_bytes(data)
    channel = f"{MACHINE}?nv=:memory:&eds=x.eds"
    if ask("caps", "caps", "--eds", "x.eds") != 2 and ask("node", "--sim", channel, "caps") not in (2, 3):
        machine = str(machine_path(MACHINE))
        if motion and seed % motion == 0:
            ask("check", "--sim", channel, "--yes", "check", machine)
            ask("commission", "--yes", "commission", machine, "--eds", "x.eds", "--runs", f"chain{seed}")
        objects, file = read_makers_objects("x.eds"), load_machine_file(Path(machine))
        for family in family_names():
            with contextlib.suppress(PmsmtoolError):
                wrong += wrong_units(objects, file, family)[1] if family in label else []
    if wrong and keep is not None:
        (keep / f"{seed}.eds").write_bytes(data)
    return label, said, wrong


def main() -> int:
    """Print a line per file that shows what must not be, and the exit codes; exit code 1 where there is one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", metavar="FILE")
    parser.add_argument("--files", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--motion", type=int, default=4)
    parser.add_argument(
        "--show", action="append", default=[], metavar="'COMMAND CODE'", help="print what these exit codes say"
    )
    parser.add_argument("--keep", type=lambda text: Path(text).resolve())
    options = parser.parse_args()
    sources = [source for source in files_of(options.sources, []) if is_drive(source)]
    codes: Counter[str] = Counter()
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        os.environ["PMSMTOOL_HOME"] = folder
        for seed in range(options.first, options.first + options.files):
            began = time.perf_counter()
            label, found, wrong = faults_of(seed, sources, options.motion, options.keep)
            codes.update(name for name, _ in found)
            for name, last in found:
                if name in options.show:
                    print(f"{seed} {label}: {name}: {last}", flush=True)
            bad += bool(wrong)
            for line in wrong:
                print(f"{seed} {label} ({time.perf_counter() - began:.0f} s): {line}", flush=True)
    for name, count in sorted(codes.items()):
        print(f"{name}: {count}")
    print(f"{options.files} files, {bad} with something that must not be")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
