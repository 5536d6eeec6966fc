"""Mutants: small changes of the product that some test has to find.

    python -m tests.mutants draw --count 80 --seed 52  # writes tests/data/mutants.json
    python -m pytest -n 3 --cov --cov-context=test --cov-report=  # which test reaches which line
    python -m tests.mutants run -o found.json          # the first test that finds each; goes on after a stop

A mutant replaces one comparison, operator or constant, or drops one statement. The draw gives every room as
many as the root of its lines. A mutant is named by its file and its line's text, so that it is found again
after other lines have moved; a mutant whose line is gone is reported as such. Each runs only the tests that
reach its line. Coverage does not see compiled functions or child processes: for a line that no test reaches,
and for files with jax or numba, all tests that import the file run, too. Without a `.coverage` file the tests
that import the file run, and the others of its room.
"""

import argparse
import ast
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.house_figures import PACKAGES

ROOT = Path(__file__).parents[1]
DRAWN = ROOT / "tests" / "data" / "mutants.json"
KINDS = ("comparison", "operator", "constant", "statement")
COMPARISONS = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==",
    ast.Is: "is not", ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in",
}  # fmt: skip
OPERATORS = {
    ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.FloorDiv: "*", ast.Mod: "*", ast.Pow: "*",
    ast.BitAnd: "|", ast.BitOr: "&", ast.And: "or", ast.Or: "and",
}  # fmt: skip
TIMEOUT = 900
"""Largest time of one run of tests, s; a mutant that takes longer is found."""


class Mutant(NamedTuple):
    """A change: file, kind, text of the first changed line, which of the equal lines of the file it is,
    column in it, changed text and what replaces it."""

    file: str
    kind: str
    line: str
    nth: int
    column: int
    before: str
    after: str


def room_of(file: str) -> str:
    return "/".join(file.split("/")[:2])


def mutants_of(file: str, text: str) -> Iterator[Mutant]:
    """All mutants of a file; annotations, docstrings, checks for types and assertions are left out."""
    lines = text.split("\n")
    starts = np.cumsum([0, *(len(line.encode()) + 1 for line in lines)])
    data = text.encode()

    def mutant(kind: str, start: int, end: int, after: str) -> Mutant:
        row = int(np.searchsorted(starts, start, side="right")) - 1
        line = lines[row]
        return Mutant(
            file, kind, line, lines[: row + 1].count(line) - 1, start - int(starts[row]),
            data[start:end].decode(), after,
        )  # fmt: skip

    def begin(node: Any) -> int:
        return int(starts[node.lineno - 1]) + node.col_offset

    def end(node: Any) -> int:
        return int(starts[node.end_lineno - 1]) + node.end_col_offset

    for node in _code(ast.parse(text)):
        for left, right, pattern, after in _infixes(node):
            found = list(re.finditer(pattern.encode(), data[end(left) : begin(right)]))
            if len(found) == 1:
                kind = "comparison" if isinstance(node, ast.Compare) else "operator"
                yield mutant(kind, end(left) + found[0].start(), end(left) + found[0].end(), after)
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            bigger = node.value + 1 if isinstance(node.value, int) or not node.value else 2 * node.value
            after = str(not node.value) if isinstance(node.value, bool) else repr(bigger)
            yield mutant("constant", begin(node), end(node), after)
        elif isinstance(node, ast.AugAssign | ast.Raise) or (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
        ):
            yield mutant("statement", begin(node), end(node), "pass")


def _infixes(node: ast.AST) -> Iterator[tuple[ast.expr, ast.expr, str, str]]:
    """Operands of each comparison and operator, a pattern of what stands between, and what replaces it."""
    if isinstance(node, ast.Compare):
        operands = [node.left, *node.comparators]
        for left, right, comparison in zip(operands, node.comparators, node.ops, strict=False):
            yield left, right, r"not\s+in|is\s+not|is|in|[<>=!]=|[<>]", COMPARISONS[type(comparison)]
    elif isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        yield node.left, node.right, r"\*\*|//|[-+*/%&|]", OPERATORS[type(node.op)]
    elif isinstance(node, ast.BoolOp):
        for left, right in pairwise(node.values):
            yield left, right, r"\b(?:and|or)\b", OPERATORS[type(node.op)]


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes of a tree that a test can run."""
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns"):
            continue
        for child in value if isinstance(value, list) else [value]:
            for_types = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)
            if isinstance(child, ast.AST) and not isinstance(child, ast.Assert) and not for_types:
                yield from _code(child)


def draw(root: Path, count: int, seed: int) -> list[Mutant]:
    """`count` mutants: rooms by the root of their lines, kinds in turn, files and places at random."""
    paths = [path for package in PACKAGES for path in sorted((root / package).rglob("*.py"))]
    texts = {str(path.relative_to(root)): path.read_text(encoding="utf-8") for path in paths}
    by_room: dict[str, list[Mutant]] = {}
    lines: dict[str, int] = {}
    for file, text in texts.items():
        by_room.setdefault(room_of(file), []).extend(mutants_of(file, text))
        lines[room_of(file)] = lines.get(room_of(file), 0) + text.count("\n")
    rooms = sorted(room for room in by_room if by_room[room])
    weights = np.sqrt([lines[room] for room in rooms])
    bounds = np.cumsum(weights) / weights.sum()
    rng = np.random.default_rng(seed)
    drawn: list[Mutant] = []
    for k in range(count):
        among = by_room[rooms[int(np.searchsorted(bounds, (k + rng.random()) / count))]]
        wanted = [m for m in among if m.kind == KINDS[k % len(KINDS)]] or among
        drawn.append(wanted[int(rng.integers(len(wanted)))])
    return drawn


def mutated(mutant: Mutant, text: str) -> str | None:
    """The file's text with the change; None: the line is gone."""
    lines = text.split("\n")
    rows = [row for row, line in enumerate(lines) if line == mutant.line]
    if len(rows) <= mutant.nth:
        return None
    data = text.encode()
    start = sum(len(line.encode()) + 1 for line in lines[: rows[mutant.nth]]) + mutant.column
    before = mutant.before.encode()
    if data[start : start + len(before)] != before:
        return None
    return (data[:start] + mutant.after.encode() + data[start + len(before) :]).decode()


def tests_of(mutant: Mutant, root: Path) -> list[str]:
    """Tests to run: those that reach the line, and where coverage cannot see, files that import its file."""
    from coverage import CoverageData

    near, reached = f"tests/{room_of(mutant.file)}/", root / ".coverage"
    text = (root / mutant.file).read_text(encoding="utf-8")
    files = [str(f.relative_to(root)) for f in sorted((root / "tests").rglob("test_*.py"))]
    tests = [file for file in files if file.startswith(near)]
    if reached.exists():
        data = CoverageData(str(reached))
        data.read()
        rows = [row for row, line in enumerate(text.split("\n"), start=1) if line == mutant.line]
        contexts = data.contexts_by_lineno(str(root / mutant.file)).get(rows[mutant.nth], [])
        tests = [context.split("|")[0] for context in contexts if context]
    if not tests or not reached.exists() or re.search(r"^\s*(import|from) (jax|numba)", text, re.MULTILINE):
        module = mutant.file.removesuffix(".py").replace("/", ".")
        room, _, name = module.rpartition(".")
        direct = re.compile(rf"{re.escape(module)}\b|from {re.escape(room)} import [^\n]*\b{name}\b")
        tests += [file for file in files if direct.search((root / file).read_text(encoding="utf-8"))]
    return sorted(set(tests), key=lambda test: (not test.startswith(near), test))


def find(mutant: Mutant, root: Path) -> str:
    """The first test that fails with the mutant; "lost", "gone" or "no test" without one."""
    path = root / mutant.file
    text = mutated(mutant, path.read_text(encoding="utf-8")) if path.exists() else None
    if text is None:
        return "gone"
    tests = tests_of(mutant, root)
    if not tests:
        return "no test"
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "tree"
        subprocess.run(["git", "clone", "--quiet", root, copy], check=True)
        (copy / mutant.file).write_text(text, encoding="utf-8")
        options = ["-x", "-q", "--no-header", "-p", "no:cacheprovider", "--tb=line"]
        listed = copy / "selected.txt"
        listed.write_text("\n".join(tests), encoding="utf-8")
        command = [sys.executable, "-m", "pytest", *options, f"@{listed}"]
        run = partial(subprocess.run, cwd=copy, env=os.environ | {"PYTHONPATH": str(copy)}, timeout=TIMEOUT)
        try:
            done = run(command, capture_output=True, text=True, check=False)
        except subprocess.TimeoutExpired:
            return "timeout"
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return failed[1] if failed else "lost" if done.returncode == 0 else f"stopped with {done.returncode}"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.mutants")
    commands = parser.add_subparsers(required=True, dest="command")
    drawing = commands.add_parser("draw", help=f"write {DRAWN.name}")
    drawing.add_argument("--count", type=int, default=80)
    drawing.add_argument("--seed", type=int, default=52)
    running = commands.add_parser("run", help="find each")
    running.add_argument("-o", "--output", type=Path, required=True, metavar="JSON")
    arguments = parser.parse_args()
    if arguments.command == "draw":
        rows = [mutant._asdict() for mutant in draw(ROOT, arguments.count, arguments.seed)]
        DRAWN.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
        return
    drawn = [Mutant(**row) for row in json.loads(DRAWN.read_text(encoding="utf-8"))]
    found = json.loads(arguments.output.read_text(encoding="utf-8")) if arguments.output.exists() else []
    for mutant in drawn[len(found) :]:
        found.append(find(mutant, ROOT))
        print(f"{len(found):3} {mutant.file}: {mutant.before!r} -> {mutant.after!r}: {found[-1]}", flush=True)
        arguments.output.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    lost = sum(result in ("lost", "no test") for result in found)
    print(f"{len(found)} mutants: {lost} lost, {found.count('gone')} gone")


if __name__ == "__main__":
    main()
