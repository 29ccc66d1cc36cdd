# SPDX-License-Identifier: MIT
"""Change one operator at a time and see whether the tests of its room notice.

    python -m benchmarks.mutations --count 60
    python -m benchmarks.mutations --count 60 --only 3 17      # survivors again, by their numbers

The mutations are drawn from the hash of the present commit, each with the same chance over all operators of the rooms:
comparisons, arithmetic, ``and``/``or``, ``not``, and numbers, in Python by its syntax tree and in C by its tokens. Each
is made in a copy of the commit, of which only the room's own tests run. A mutation is caught when a test fails, when
the tests need more than ten times what they need without it, or when the C does not compile.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import os
import random
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

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
LONGEST_S = 900.0


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
    """Return mutations with the tests of their rooms, drawn without repetition."""
    sites: list[tuple[str, Mutation]] = []
    for room, tests in ROOMS.items():
        for path in sorted((folder / room).rglob("*.[pch]*")):
            if path.suffix in (".py", ".c", ".h"):
                text = path.read_text(encoding="utf-8")
                make = in_python if path.suffix == ".py" else in_c
                sites += [(tests, mutation) for mutation in make(path.relative_to(folder), text)]
    return random.Random(seed).sample(sites, count)


def tested(folder: Path, tests: str, limit_s: float) -> tuple[bool, float]:
    """Run the tests of a room in a copy; return whether they pass, and the time (s)."""
    command = [
        sys.executable, "-m", "pytest", "-x", "-q", "-n", "2", "-p", "no:cacheprovider",
        "-m", "not wall_clock and not slow_install", tests,
    ]  # fmt: skip
    start = time.monotonic()
    try:
        done = subprocess.run(
            command, cwd=folder, env=_environment(folder), timeout=limit_s, capture_output=True, check=False
        )
    except subprocess.TimeoutExpired:
        return False, limit_s
    return done.returncode == 0, time.monotonic() - start


def survives(folder: Path, tests: str, mutation: Mutation, limit_s: float) -> bool:
    """Make a mutation, run the tests, take it back."""
    path = folder / mutation.path
    text = path.read_text(encoding="utf-8")
    path.write_text(mutation.of(text), encoding="utf-8")
    try:
        return (path.suffix == ".py" or _built(folder)) and tested(folder, tests, limit_s)[0]
    finally:
        path.write_text(text, encoding="utf-8")
        if path.suffix != ".py":
            _built(folder)


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
    asked = parser.parse_args()
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()
    seed = int(hashlib.sha256(commit.encode()).hexdigest()[:16], 16)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "copy"
        subprocess.run(["git", "clone", "-q", "--no-hardlinks", str(ROOT), str(folder)], check=True)
        if not _built(folder):
            sys.exit("the kernels cannot be built in the copy")
        chosen = [(k, *each) for k, each in enumerate(drawn(folder, asked.count, seed))]
        if asked.only is not None:
            chosen = [each for each in chosen if each[0] in asked.only]
        needed: dict[str, float] = {}
        caught = 0
        print(f"commit {commit[:12]}: {len(chosen)} mutations")
        for number, tests, mutation in chosen:
            if tests not in needed:
                passes, needed[tests] = tested(folder, tests, LONGEST_S)
                if not passes:
                    sys.exit(f"{tests} fails without a mutation")
            text = (folder / mutation.path).read_text(encoding="utf-8")
            alive = survives(folder, tests, mutation, min(LONGEST_S, 10.0 * needed[tests]))
            caught += not alive
            print(f"{number:3d} {'SURVIVES' if alive else 'caught  '} {mutation.line(text)}", flush=True)
    print(f"{caught} of {len(chosen)} caught ({100.0 * caught / len(chosen):.0f} %)")


if __name__ == "__main__":
    main()
