# SPDX-License-Identifier: MIT
"""Change one operator at a time and see whether the tests of its room notice.

    python -m benchmarks.mutations --count 60
    python -m benchmarks.mutations --count 60 --only 3 17      # survivors again, by their numbers

The mutations are drawn from the hash of the present commit, each with the same chance over all operators of the rooms:
comparisons, arithmetic, ``and``/``or``, ``not``, and numbers, in Python by its syntax tree and in C by its tokens. Each
is made in a copy of the commit, of which only the room's own tests run, first those that enter the changed function. A
mutation is caught when a test fails, when one needs more than ten times what it needs without it, or when the C does
not compile.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import queue
import random
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = {
    "pmsmtool/design": "tests/design",
    "pmsmtool/estimators": "tests/estimators",
    "pmsmtool/firmware/core": "tests/firmware",
    "pmsmtool/drive": "tests/drive",
    "pmsmtool/flash": "tests/flash",
}
COMPARISONS = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "=="}
ARITHMETIC = {"+": "-", "-": "+", "*": "/", "/": "*"}
LOGIC = {"and": "or", "or": "and", "&&": "||", "||": "&&"}
SYMBOLS: dict[type, str] = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/",
}  # fmt: skip
_TOKEN = re.compile(
    r"""/\*.*?\*/|//[^\n]*|"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|^[ \t]*\#[^\n]*(?:\\\n[^\n]*)*"""
    r"""|(?P<two><=|>=|==|!=|&&|\|\||->|<<|>>|\+\+|--|[-+*/|&^%]=)|(?P<one>[-+*/<>])""",
    re.DOTALL | re.MULTILINE,
)
LONGEST_S = 1800.0
WATCH = "PMSMTOOL_WATCHED_TESTS"
_PACKAGE = str(ROOT / "pmsmtool") + "/"


@dataclass(frozen=True, slots=True)
class Test:
    """A test, its time, the functions it entered (path, first line), and the text of its file."""

    number: int
    node: str
    seconds: float
    entered: frozenset[tuple[str, int]]
    text: str

    @property
    def file(self) -> str:
        """Where it is written."""
        return self.node.split("::")[0]


@dataclass(frozen=True, slots=True)
class Mutation:
    """One change of one file: ``before`` at ``at`` becomes ``after``."""

    path: Path
    at: int
    before: str
    after: str

    def of(self, text: str) -> str:
        """Return the changed text."""
        return text[: self.at] + self.after + text[self.at + len(self.before) :]

    def line(self, text: str) -> str:
        """Return where it is, as a person reads it."""
        number = text.count("\n", 0, self.at) + 1
        return f"{self.path}:{number}: {text.splitlines()[number - 1].strip()}   [{self.before} -> {self.after}]"


def in_python(path: Path, text: str) -> Iterator[Mutation]:
    """Yield the mutations of a Python file."""
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def position(line: int, column: int) -> int:
        raw = text[starts[line - 1] : starts[line]].encode()[:column]
        return starts[line - 1] + len(raw.decode())

    def between(left: ast.expr, right: ast.expr, symbol: str, other: str) -> Iterator[Mutation]:
        assert left.end_lineno is not None and left.end_col_offset is not None
        begin, end = position(left.end_lineno, left.end_col_offset), position(right.lineno, right.col_offset)
        found = re.search(rf"(?<![\w<>=!*/]){re.escape(symbol)}(?![\w<>=*/])|\b{re.escape(symbol)}\b", text[begin:end])
        if found:
            yield Mutation(path, begin + found.start(), symbol, other)

    tree = ast.parse(text)
    hidden = {
        id(inner)
        for node in ast.walk(tree)
        for name in ("annotation", "returns", "decorator_list")
        for part in [getattr(node, name, None)]
        for top in (part if isinstance(part, list) else [part])
        if isinstance(top, ast.AST)
        for inner in ast.walk(top)
    }
    for node in ast.walk(tree):
        if id(node) in hidden:
            continue
        if isinstance(node, ast.Compare):
            for left, operator, right in zip([node.left, *node.comparators], node.ops, node.comparators, strict=False):
                symbol = SYMBOLS.get(type(operator))
                if symbol:
                    yield from between(left, right, symbol, COMPARISONS[symbol])
        elif isinstance(node, ast.BinOp) and type(node.op) in SYMBOLS:
            symbol = SYMBOLS[type(node.op)]
            yield from between(node.left, node.right, symbol, ARITHMETIC[symbol])
        elif isinstance(node, ast.BoolOp):
            symbol = "and" if isinstance(node.op, ast.And) else "or"
            for left, right in zip(node.values, node.values[1:], strict=False):
                yield from between(left, right, symbol, LOGIC[symbol])
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            yield Mutation(path, position(node.lineno, node.col_offset), "not ", "")
        elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            if isinstance(node.value, bool):
                continue
            at = position(node.lineno, node.col_offset)
            literal = text[at : position(node.end_lineno or 0, node.end_col_offset or 0)]
            yield Mutation(path, at, literal, f"({literal} + 1)" if abs(node.value) <= 1 else f"({literal} * 2)")


def in_c(path: Path, text: str) -> Iterator[Mutation]:
    """Yield the mutations of a C file: binary operators with a blank on both sides."""
    for found in _TOKEN.finditer(text):
        symbol = found["two"] or found["one"]
        other = (COMPARISONS | ARITHMETIC | LOGIC).get(symbol or "")
        if symbol and other and text[found.start() - 1] == " " == text[found.end()]:
            yield Mutation(path, found.start(), symbol, other)


def drawn(folder: Path, count: int, seed: int) -> list[tuple[str, Mutation]]:
    """Return mutations with their rooms, drawn without repetition."""
    sites: list[tuple[str, Mutation]] = []
    for room in ROOMS:
        for path in sorted((folder / room).rglob("*.[pch]*")):
            if path.suffix in (".py", ".c", ".h"):
                text = path.read_text(encoding="utf-8")
                make = in_python if path.suffix == ".py" else in_c
                sites += [(room, mutation) for mutation in make(path.relative_to(folder), text)]
    return random.Random(seed).sample(sites, count)


def place(text: str, at: int) -> int:
    """Return the first line of the innermost Python function around a place, 0 where none is."""
    line = text.count("\n", 0, at) + 1
    starts = [0]
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef) and node.lineno <= line <= (node.end_lineno or 0):
            starts.append(min([node.lineno, *(each.lineno for each in node.decorator_list)]))
    return max(starts)


def in_turn(tests: Sequence[Test], mutation: Mutation, text: str) -> list[list[Test]]:
    """Return the tests that can notice a mutation, in runs one after the other, quick files first.

    Those that entered the mutated function; the others of their files, which share fixtures, and those that start
    programs; and where a constant or C is mutated, whose use nobody watches, all others. What is left out never comes
    to the changed line.
    """
    name = str(mutation.path)
    first = place(text, mutation.at) if mutation.path.suffix == ".py" else 0
    cost: dict[str, float] = {}
    for test in tests:
        cost[test.file] = cost.get(test.file, 0.0) + test.seconds

    def enters(test: Test) -> bool:
        if mutation.path.suffix != ".py":
            return mutation.path.stem in test.file + test.text
        return (name, first) in test.entered if first else any(path == name for path, _ in test.entered)

    entering = {test for test in tests if enters(test)}
    files = {test.file for test in entering}
    beside = {test for test in tests if test.file in files or "subprocess" in test.text or "served" in test.text}
    runs = [entering, beside - entering, set() if first else set(tests) - beside - entering]
    return [sorted(run, key=lambda test: (cost[test.file], test.number)) for run in runs]


def watched(folder: Path, room: str) -> list[Test]:
    """Run the tests of a room as they are; return them with their times and the room's functions that each entered."""
    with tempfile.TemporaryDirectory() as name:
        report = Path(name) / "watched.json"
        environment = {**_environment(folder), WATCH: str(report)}
        done = _pytest(folder, [ROOMS[room], "-p", "benchmarks.mutations"], environment, LONGEST_S)
        if done.returncode:
            sys.exit(f"{ROOMS[room]} fails without a mutation\n{done.stdout[-2000:]}")
        rows = json.loads(report.read_text(encoding="utf-8"))
    texts = {path: (folder / path).read_text(encoding="utf-8") for path in {row[0].split("::")[0] for row in rows}}
    return [
        Test(k, node, seconds, frozenset((path, line) for path, line in entered), texts[node.split("::")[0]])
        for k, (node, seconds, entered) in enumerate(rows)
    ]


def passes(folder: Path, tests: Sequence[Test]) -> bool:
    """Run some tests in a copy up to the first that fails; return whether none did, in ten times their time."""
    if not tests:
        return True
    with tempfile.TemporaryDirectory() as name:
        names = Path(name) / "tests"
        names.write_text("\n".join(test.node for test in tests), encoding="utf-8")
        longest = 10.0 * max(test.seconds for test in tests) + 10.0
        limit_s = min(LONGEST_S, 10.0 * sum(test.seconds for test in tests) + 30.0)
        arguments = [f"@{names}", "-o", f"timeout={longest:.0f}"]
        return _pytest(folder, arguments, _environment(folder), limit_s).returncode == 0


def _pytest(
    folder: Path, arguments: list[str], environment: dict[str, str], limit_s: float
) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
    command += ["-o", "addopts=--import-mode=importlib", "-m", "not wall_clock and not slow_install", *arguments]
    try:
        return subprocess.run(
            command, cwd=folder, env=environment, timeout=limit_s, capture_output=True, text=True, check=False
        )
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, 1, "", "")


def survives(folder: Path, tests: Sequence[Test], mutation: Mutation) -> bool:
    """Make a mutation, run the tests, take it back."""
    path = folder / mutation.path
    text = path.read_text(encoding="utf-8")
    path.write_text(mutation.of(text), encoding="utf-8")
    try:
        built = path.suffix == ".py" or _built(folder)
        return built and all(passes(folder, some) for some in in_turn(tests, mutation, text))
    finally:
        path.write_text(text, encoding="utf-8")
        if path.suffix != ".py":
            _built(folder)


class _Watch:
    """A pytest plug-in: how long each test takes and which of the package's functions it enters."""

    def __init__(self, report: Path) -> None:
        self.report = report
        self.rows: list[tuple[str, float, list[tuple[str, int]]]] = []
        self.at_import: set[tuple[str, int]] | None = None
        self.entered: set[tuple[str, int]] = set()
        sys.settrace(self.called)

    def called(self, frame: FrameType, event: str, argument: object) -> None:
        """Note a call; a trace function."""
        del event, argument
        code = frame.f_code
        if code.co_filename.startswith(_PACKAGE):
            self.entered.add((code.co_filename[len(_PACKAGE) - len("pmsmtool/") :], code.co_firstlineno))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Watch one test, which remembers nothing that another has computed."""
        for module in [each for name, each in sys.modules.items() if name.startswith("pmsmtool.")]:
            for thing in vars(module).values():
                getattr(thing, "cache_clear", int)()
        if self.at_import is None:
            self.at_import = self.entered
        self.entered = set(self.at_import)
        begun = time.monotonic()
        threading.settrace(self.called)
        sys.settrace(self.called)
        try:
            return (yield)
        finally:
            sys.settrace(None)
            self.rows.append((item.nodeid, time.monotonic() - begun, sorted(self.entered)))

    def pytest_sessionfinish(self) -> None:
        """Write what was seen."""
        self.report.write_text(json.dumps(self.rows), encoding="utf-8")


def pytest_configure(config: pytest.Config) -> None:
    """Watch the tests where the benchmark asks for it."""
    config.pluginmanager.register(_Watch(Path(os.environ[WATCH])))


def _built(folder: Path) -> bool:
    command = [sys.executable, "-m", "pmsmtool.packaging.build_kernels"]
    done = subprocess.run(command, cwd=folder, env=_environment(folder), capture_output=True, check=False)
    return done.returncode == 0


def _environment(folder: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--only", type=int, nargs="*", help="numbers of the drawn ones to run")
    parser.add_argument("--jobs", type=int, default=2, help="mutations at a time, each in its own copy")
    asked = parser.parse_args()
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()
    seed = int(hashlib.sha256(commit.encode()).hexdigest()[:16], 16)
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(asked.jobs) as pool:
        copies: queue.SimpleQueue[Path] = queue.SimpleQueue()
        for job in range(asked.jobs):
            folder = Path(name) / f"copy{job}"
            subprocess.run(["git", "clone", "-q", "--no-hardlinks", str(ROOT), str(folder)], check=True)
            if not _built(folder):
                sys.exit("the kernels cannot be built in the copy")
            copies.put(folder)
        chosen = [(k, *each) for k, each in enumerate(drawn(folder, asked.count, seed))]
        if asked.only is not None:
            chosen = [each for each in chosen if each[0] in asked.only]
        print(f"commit {commit[:12]}: {len(chosen)} mutations", flush=True)

        @contextmanager
        def a_copy() -> Iterator[Path]:
            folder = copies.get()
            try:
                yield folder
            finally:
                copies.put(folder)

        def watch(room: str) -> list[Test]:
            with a_copy() as folder:
                return watched(folder, room)

        def one(number: int, room: str, mutation: Mutation) -> bool:
            line = mutation.line((ROOT / mutation.path).read_text(encoding="utf-8"))
            with a_copy() as folder:
                begun = time.monotonic()
                alive = survives(folder, tests[room], mutation)
            seconds = time.monotonic() - begun
            print(f"{number:3d} {'SURVIVES' if alive else 'caught  '} {seconds:4.0f} s  {line}", flush=True)
            return alive

        rooms = sorted({room for _, room, _ in chosen})
        tests = dict(zip(rooms, pool.map(watch, rooms), strict=True))
        for room in rooms:
            print(f"{room}: {len(tests[room])} tests, {sum(test.seconds for test in tests[room]):.0f} s", flush=True)
        alive = sum(pool.map(lambda each: one(*each), chosen))
    caught = len(chosen) - alive
    print(f"{caught} of {len(chosen)} caught ({100.0 * caught / len(chosen):.0f} %)")


if __name__ == "__main__":
    main()
