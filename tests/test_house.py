"""Rules of the layout: every room has a README, the house does not grow, tests use public names."""

import ast
import re
from pathlib import Path

import pytest

from tests.house_figures import PACKAGES, count

ROOT = Path(__file__).parents[1]
ROOMS = [
    path.parent
    for package in PACKAGES
    for path in sorted((ROOT / package).glob("*/__init__.py"))
    if len(list(path.parent.rglob("*.py"))) > 1
]
MOST = {
    "rooms": 30, "folders": 50, "files": 434, "product lines": 83_361, "code lines": 56_773,
    "test lines": 45_500, "largest file": 600, "longest function": 80, "public names": 1_997,
    "all names": 3_137, "records": 326, "short and called once": 62, "unused private names": 0,
    "twin names": 0, "module circles": 0, "room circles": 0,
}  # fmt: skip
"""Largest number of each figure of `tests.house_figures`; lowered with every step towards its goals."""


def test_the_house_does_not_grow():
    found = count(ROOT)
    assert {name: (found[name], most) for name, most in MOST.items() if found[name] > most} == {}


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.relative_to(ROOT).as_posix())
def test_every_room_has_a_readme_with_an_example(room):
    text = (room / "README.md").read_text(encoding="utf-8")
    assert re.match(r"# .+\n+\w", text), "a title, then a paragraph on the purpose of the room"
    assert "```python" in text


def test_root_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 1200


def test_tests_use_no_private_names():
    """Attributes and imports with a leading underscore; those of named tuples, notebooks and `os._exit` are
    public."""
    allowed = {"_replace", "_asdict", "_fields", "_make", "_exit", "_repr_html_"}
    found = []
    for path in sorted((ROOT / "tests").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.ImportFrom) else []
            if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") not in ("self", "cls"):
                names = [node.attr]
            private = [name for name in names if re.match(r"_[a-z]", name) and name not in allowed]
            found += [f"{path.relative_to(ROOT)}:{node.lineno}: {name}" for name in private]
    assert found == []
