"""Rules of the layout: every room has a README, files and functions are short, tests use public names."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.house_figures import count

ROOT = Path(__file__).parents[1]
PACKAGES = ("ratslam", "robot", "evaluation", "tactile")
ROOMS = sorted(
    path.parent
    for package in PACKAGES
    for path in (ROOT / package).glob("*/__init__.py")
    if len(list(path.parent.rglob("*.py"))) > 1
)
LONGEST_FILE, LONGEST_FUNCTION, LONGEST_ROOT_README = 600, 80, 1200
MOST = {
    "rooms": 30, "folders": 50, "files": 408, "product lines": 76_600, "code lines": 51_720,
    "test lines": 48_400, "public names": 1_841, "all names": 2_940, "records": 300,
    "short and called once": 55,
    "twin names": 0, "module circles": 0, "room circles": 0, "upward arrows": 0,
}  # fmt: skip
"""Largest number of each figure of `tests.house_figures`; lowered with every step towards its goals."""


def sources() -> Iterator[tuple[str, str]]:
    """Name and text of every source file of the four packages."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            yield path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")


def test_files_are_short() -> None:
    lengths = {name: text.count("\n") for name, text in sources()}
    assert {name: n for name, n in lengths.items() if n > LONGEST_FILE} == {}


def test_functions_are_short() -> None:
    long = []
    for name, text in sources():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                length = (node.end_lineno or node.lineno) - node.lineno + 1
                if length > LONGEST_FUNCTION:
                    long.append((name, node.name, length))
    assert long == []


def test_the_house_does_not_grow() -> None:
    found = count(ROOT)
    assert {name: (found[name], most) for name, most in MOST.items() if found[name] > most} == {}


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.relative_to(ROOT).as_posix())
def test_every_room_has_a_readme_with_an_example(room: Path) -> None:
    text = (room / "README.md").read_text(encoding="utf-8")
    assert re.match(r"# .+\n+\w", text), "a title, then a paragraph on the purpose of the room"
    assert "```python" in text


def test_root_readme_is_short() -> None:
    words = (ROOT / "README.md").read_text(encoding="utf-8").split()
    assert len(words) <= LONGEST_ROOT_README


def test_tests_use_no_private_names() -> None:
    """Attributes and imports with a leading underscore; those of named tuples, notebooks and `os._exit` are
    public."""
    allowed = {"_replace", "_asdict", "_fields", "_make", "_exit", "_repr_html_"}
    found = []
    for path in sorted((ROOT / "tests").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Attribute) and not (
                isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
            ):
                names = [node.attr]
            elif isinstance(node, ast.ImportFrom):
                names = [alias.name for alias in node.names]
            found += [
                f"{path.relative_to(ROOT)}:{node.lineno}: {name}"
                for name in names
                if re.match(r"_[a-z]", name) and name not in allowed
            ]
    assert found == []


def test_private_functions_and_classes_are_used() -> None:
    """Every private function and class of a module is used in it."""
    unused = []
    for name, text in sources():
        tree = ast.parse(text)
        named = [node.id for node in ast.walk(tree) if isinstance(node, ast.Name)]
        named += [node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and re.match(r"_[a-zA-Z]", node.name):
                unused += [(name, node.name)] if node.name not in named else []
    assert unused == []
