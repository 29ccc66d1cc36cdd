# SPDX-License-Identifier: MIT
"""Change one operator at a time and see whether the tests of its room notice.

    python -m benchmarks.mutations --count 60
    python -m benchmarks.mutations --count 60 --only 3 17      # survivors again, by their numbers
    python -m benchmarks.mutations --count 20 --numbers        # numbers instead of operators
    python -m benchmarks.mutations --rooms flash --unseen      # operators that no test can notice, without mutations

The mutations are drawn from the hash of the present commit, each with the same chance over all operators of the rooms:
comparisons, arithmetic, ``and``/``or`` and ``not``, in Python by its syntax tree and in C by its tokens; the numbers
of the Python sources are a draw of their own. Each is made in a copy of the commit, of which only the room's own tests
run. A mutation is caught when a test fails, when one needs more than ten times what it needs without it, or when the
C does not compile.

In Python the tests run once before with every drawn place watched: it computes both what is written and the mutation,
and notes for each test whether they differ anywhere, in programs that the test starts as well. Only those tests run
with the mutation; no other can notice it. C whose compiled bytes are those without the mutation survives at once.
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
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import pytest

from pmsmtool.packaging.compiler import KERNELS

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
PLACES, REPORT = "PMSMTOOL_WATCHED_PLACES", "PMSMTOOL_WATCHED_TESTS"


@dataclass(frozen=True, slots=True)
class Test:
    """A test, its time, the numbers of the mutations it can notice, and the text of its file."""

    number: int
    node: str
    seconds: float
    seen: frozenset[int]
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

    @property
    def of_number(self) -> bool:
        """Whether it changes a number, not an operator."""
        return self.before[0].isdigit() or self.before[0] == "."

    def of(self, text: str) -> str:
        """Return the changed text."""
        return text[: self.at] + self.after + text[self.at + len(self.before) :]

    def line(self, text: str) -> str:
        """Return where it is, as a person reads it."""
        number = text.count("\n", 0, self.at) + 1
        return f"{self.path}:{number}: {text.splitlines()[number - 1].strip()}   [{self.before} -> {self.after}]"


def in_python(path: Path, text: str, tree: ast.Module) -> Iterator[tuple[ast.expr, Mutation]]:
    """Yield the mutations of a Python file, each with its expression in the file's tree."""
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

    def of(node: ast.AST) -> Iterator[Mutation]:
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
                return
            at = position(node.lineno, node.col_offset)
            literal = text[at : position(node.end_lineno or 0, node.end_col_offset or 0)]
            yield Mutation(path, at, literal, f"({literal} + 1)" if abs(node.value) <= 1 else f"({literal} * 2)")

    hidden: set[int] = set()
    for node in ast.walk(tree):
        for name in ("annotation", "returns", "decorator_list"):
            part = getattr(node, name, None)
            for top in part if isinstance(part, list) else [part]:
                hidden |= {id(inner) for inner in ast.walk(top)} if isinstance(top, ast.AST) else set()
    for node in ast.walk(tree):
        if id(node) not in hidden and isinstance(node, ast.expr):
            yield from ((node, each) for each in of(node))


class _Watching(ast.NodeTransformer):
    """Puts a watch around the expressions of some mutations (by the expression's id: numbers and mutations)."""

    def __init__(self, places: Mapping[int, list[tuple[int, Mutation]]]) -> None:
        self.places = places

    def visit(self, node: ast.AST) -> ast.AST:
        """Watch a node, its inner ones first; the patterns of a ``match`` and what makes a type are left alone."""
        places = self.places.get(id(node), [])
        new = node if isinstance(node, ast.pattern) else self.generic_visit(node)
        if isinstance(new, ast.BinOp) or (isinstance(new, ast.Compare) and len(new.ops) == 1):
            left, right = (new.left, new.right) if isinstance(new, ast.BinOp) else (new.left, new.comparators[0])
            for number, mutation in places:
                what = [ast.Constant(each) for each in (number, mutation.before, mutation.after)]
                return ast.Call(_name("computed"), [*what, left, right], [])
        for number, _ in places:
            new = ast.Call(_name("reached"), [ast.Constant(number), cast(ast.expr, new)], [])
        return new


def _name(function: str) -> ast.expr:
    return ast.Attribute(ast.Name("_watched_places", ast.Load()), function, ast.Load())


def watching(text: str, mutations: Mapping[int, Mutation]) -> str:
    """Return the text of a Python file with some of its mutations watched under their numbers."""
    path = next(iter(mutations.values())).path
    numbers = {mutation: number for number, mutation in mutations.items()}
    tree = ast.parse(text)
    places: dict[int, list[tuple[int, Mutation]]] = {}
    for node, mutation in in_python(path, text, tree):
        if mutation in numbers:
            places.setdefault(id(node), []).append((numbers[mutation], mutation))
    new = cast(ast.Module, _Watching(places).visit(tree))
    futures = [k for k, node in enumerate(new.body) if isinstance(node, ast.ImportFrom) and node.module == "__future__"]
    new.body[max(futures, default=-1) + 1 : 0] = ast.parse("import benchmarks.watched_places as _watched_places").body
    return ast.unparse(ast.fix_missing_locations(new))


def in_c(path: Path, text: str) -> Iterator[Mutation]:
    """Yield the mutations of a C file: binary operators with a blank on both sides."""
    for found in _TOKEN.finditer(text):
        symbol = found["two"] or found["one"]
        other = (COMPARISONS | ARITHMETIC | LOGIC).get(symbol or "")
        if symbol and other and text[found.start() - 1] == " " == text[found.end()]:
            yield Mutation(path, found.start(), symbol, other)


def places(folder: Path, rooms: Sequence[str], numbers: bool) -> list[tuple[str, Mutation]]:
    """Return all mutations of operators, or of numbers, with their rooms."""
    found: list[tuple[str, Mutation]] = []
    for room in rooms:
        for path in sorted((folder / room).rglob("*.[pch]*")):
            if path.suffix in (".py", ".c", ".h"):
                text, name = path.read_text(encoding="utf-8"), path.relative_to(folder)
                python = path.suffix == ".py"
                made = (each for _, each in in_python(name, text, ast.parse(text))) if python else in_c(name, text)
                found += [(room, mutation) for mutation in made if mutation.of_number == numbers]
    return found


def in_turn(tests: Sequence[Test], number: int, mutation: Mutation) -> list[Test]:
    """Return the tests that can notice a mutation, quick ones first, then by files, whose tests share fixtures.

    What one test has noticed, the others of its file may through what the file computes once. In C nobody looks; first
    come the tests whose file speaks of the mutated one.
    """
    of_c = mutation.path.suffix != ".py"
    seen = {test for test in tests if number in test.seen}
    sharing = {test.file for test in seen if re.search(r"\bscope=|\bcache\b", test.text)}
    chosen = [test for test in tests if of_c or test in seen or test.file in sharing]
    cost: dict[str, float] = {}
    for test in chosen:
        cost[test.file] = cost.get(test.file, 0.0) + test.seconds

    def turn(test: Test) -> tuple[bool, bool, float, int]:
        return (
            test.seconds > 1.0,
            of_c and mutation.path.stem not in test.file + test.text,
            cost[test.file],
            test.number,
        )

    return sorted(chosen, key=turn)


def watched(folder: Path, room: str, mutations: Mapping[int, Mutation]) -> list[Test]:
    """Run the tests of a room with the Python mutations watched; return them with their times and what each notices."""
    by_file: dict[Path, dict[int, Mutation]] = {}
    for number, mutation in mutations.items():
        if mutation.path.suffix == ".py":
            by_file.setdefault(mutation.path, {})[number] = mutation
    for path, some in by_file.items():
        (folder / path).write_text(watching((folder / path).read_text(encoding="utf-8"), some), encoding="utf-8")
    with tempfile.TemporaryDirectory() as name:
        report, noted = Path(name) / "watched.json", Path(name) / "noted"
        noted.write_bytes(bytes(max(mutations, default=0) + 1))
        environment = {**_environment(folder), PLACES: str(noted), REPORT: str(report)}
        done = _pytest(folder, [ROOMS[room], "-p", "benchmarks.mutations"], environment, LONGEST_S)
        subprocess.run(["git", "checkout", "-q", "--", "pmsmtool"], cwd=folder, check=True)
        if not report.exists() or not (rows := json.loads(report.read_text(encoding="utf-8"))):
            sys.exit(f"{ROOMS[room]} cannot be watched\n{done.stdout[-2000:]}")
    texts = {path: (folder / path).read_text(encoding="utf-8") for path in {row[0].split("::")[0] for row in rows}}
    tests = [
        Test(k, node, seconds, frozenset(seen) if passed else frozenset(mutations), texts[node.split("::")[0]])
        for k, (node, seconds, passed, seen) in enumerate(rows)
    ]
    upset = [test for test, (_, _, passed, _) in zip(tests, rows, strict=True) if not passed]
    broken = {test for test in upset if not passes(folder, [test])}
    for test in broken:
        print(f"{test.node} fails without a mutation, and is left out", flush=True)
    return [test for test in tests if test not in broken]


def passes(folder: Path, tests: Sequence[Test]) -> bool:
    """Run some tests in a copy up to the first that fails; return whether none did, in ten times their time."""
    if not tests:
        return True
    with tempfile.TemporaryDirectory() as name:
        names = Path(name) / "tests"
        names.write_text("\n".join(test.node for test in tests), encoding="utf-8")
        longest = 10.0 * max(test.seconds for test in tests) + 10.0
        limit_s = min(LONGEST_S, 10.0 * sum(test.seconds for test in tests) + 30.0)
        arguments = ["-x", f"@{names}", "-o", f"timeout={longest:.0f}"]
        return _pytest(folder, arguments, _environment(folder), limit_s).returncode == 0


def _pytest(
    folder: Path, arguments: list[str], environment: dict[str, str], limit_s: float
) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
    command += ["-o", "addopts=--import-mode=importlib", "-m", "not wall_clock and not slow_install", *arguments]
    try:
        return subprocess.run(
            command, cwd=folder, env=environment, timeout=limit_s, capture_output=True, text=True, check=False
        )
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, 1, "", "")


def survives(folder: Path, tests: Sequence[Test], number: int, mutation: Mutation) -> bool:
    """Make a mutation, run the tests, take it back."""
    path = folder / mutation.path
    text = path.read_text(encoding="utf-8")
    before = {library: library.read_bytes() for library in (folder / "pmsmtool/_native").glob("*.so")}
    path.write_text(mutation.of(text), encoding="utf-8")
    try:
        if path.suffix != ".py":
            if not _built(folder):
                return False
            if all(library.read_bytes() == compiled for library, compiled in before.items()):
                return True
        return passes(folder, in_turn(tests, number, mutation))
    finally:
        path.write_text(text, encoding="utf-8")
        if path.suffix != ".py":
            for library, compiled in before.items():
                library.write_bytes(compiled)


class _Watch:
    """A pytest plug-in: how long each test takes and which watched places it notices."""

    def __init__(self, report: Path) -> None:
        from benchmarks.watched_places import NOTED

        self.report, self.noted = report, NOTED
        self.rows: list[tuple[str, float, bool, list[int]]] = []
        self.at_import: bytes | None = None
        self.passed = True

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Watch one test, which remembers nothing that another has computed."""
        for module in [each for name, each in sys.modules.items() if name.startswith("pmsmtool.")]:
            for thing in vars(module).values():
                getattr(thing, "cache_clear", int)()
        if self.at_import is None:
            self.at_import = self.noted[:]
        self.noted[:] = self.at_import
        self.passed = True
        begun = time.monotonic()
        try:
            return (yield)
        finally:
            seen = [number for number, byte in enumerate(self.noted[:]) if byte]
            self.rows.append((item.nodeid, time.monotonic() - begun, self.passed, seen))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note a test that fails because of the watch: it may notice everything."""
        self.passed = self.passed and not report.failed

    def pytest_sessionfinish(self) -> None:
        """Write what was seen."""
        self.report.write_text(json.dumps(self.rows), encoding="utf-8")


def pytest_configure(config: pytest.Config) -> None:
    """Watch the tests where the benchmark asks for it."""
    config.pluginmanager.register(_Watch(Path(os.environ[REPORT])))


def _built(folder: Path) -> bool:
    kernels = [kernel.name for kernel in KERNELS]
    command = [sys.executable, "-m", "pmsmtool.packaging.build_kernels", *kernels]
    done = subprocess.run(command, cwd=folder, env=_environment(folder), capture_output=True, check=False)
    return done.returncode == 0


def _environment(folder: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--numbers", action="store_true", help="change numbers of the Python sources, not operators")
    parser.add_argument("--rooms", nargs="*", default=[], help="parts of the rooms' paths; default all of them")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of the drawn ones to run")
    parser.add_argument("--unseen", action="store_true", help="list what no test can notice, without mutations")
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
        rooms = [room for room in ROOMS if not asked.rooms or any(part in room for part in asked.rooms)]
        found = places(folder, rooms, asked.numbers)
        drawn = found if asked.unseen else random.Random(seed).sample(found, asked.count)
        chosen = [(k, *each) for k, each in enumerate(drawn) if asked.only is None or k in asked.only]
        what = "numbers" if asked.numbers else "operators"
        print(f"commit {commit[:12]}: {len(chosen)} of {len(found)} {what}", flush=True)

        @contextmanager
        def a_copy() -> Iterator[Path]:
            folder = copies.get()
            try:
                yield folder
            finally:
                copies.put(folder)

        def watch(room: str) -> list[Test]:
            with a_copy() as folder:
                return watched(folder, room, {k: mutation for k, where, mutation in chosen if where == room})

        def text_of(mutation: Mutation) -> str:
            return mutation.line((ROOT / mutation.path).read_text(encoding="utf-8"))

        def one(number: int, room: str, mutation: Mutation) -> bool:
            with a_copy() as folder:
                begun = time.monotonic()
                alive = survives(folder, tests[room], number, mutation)
            seconds = time.monotonic() - begun
            verdict = "SURVIVES" if alive else "caught  "
            print(f"{number:3d} {verdict} {seconds:4.0f} s  {text_of(mutation)}", flush=True)
            return alive

        rooms = sorted({room for _, room, _ in chosen})
        tests = dict(zip(rooms, pool.map(watch, rooms), strict=True))
        for room in rooms:
            print(f"{room}: {len(tests[room])} tests, {sum(test.seconds for test in tests[room]):.0f} s", flush=True)
        if asked.unseen:
            seen = frozenset().union(*(test.seen for some in tests.values() for test in some))
            for k, _, mutation in chosen:
                if k not in seen and mutation.path.suffix == ".py":
                    print(text_of(mutation))
            return
        alive = sum(pool.map(lambda each: one(*each), chosen))
    caught = len(chosen) - alive
    print(f"{caught} of {len(chosen)} {what} caught ({100.0 * caught / len(chosen):.0f} %)")


if __name__ == "__main__":
    main()
