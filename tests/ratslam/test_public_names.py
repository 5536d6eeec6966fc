"""The public names: they exist, are typed, are listed, and nothing else is."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import ratslam

ROOT = Path(__file__).parents[2]
USES = Path(__file__).parent / "public_names.py"


def test_every_name_exists() -> None:
    for name in ratslam.__all__:
        found = getattr(ratslam, name)
        assert getattr(found, "__name__", name) == name
        assert found.__doc__
    assert dir(ratslam) == sorted(ratslam.__all__)
    assert len(repr(dir(ratslam))) <= 24 * 80  # a terminal


def test_other_names_do_not_exist() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Pose'"):
        ratslam.Pose  # noqa: B018


def test_names_are_typed(tmp_path: Path) -> None:
    """`mypy --strict` accepts a file that uses every name, and finds a name that is missing."""
    used = set(re.findall(r"ratslam\.(\w+)", USES.read_text(encoding="utf-8")))
    assert used == set(ratslam.__all__)
    wrong = tmp_path / "wrong.py"
    wrong.write_text("import ratslam\n\nratslam.Pose\nratslam.run(3)\n")
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "--no-incremental"]
    environment = os.environ | {"MYPYPATH": str(ROOT)}
    done = subprocess.run(
        [*command, USES, wrong], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300
    )
    errors = re.findall(r"^(\S+?):(\d+): error: .*\[([\w-]+)\]", done.stdout, re.MULTILINE)
    assert [(Path(file).name, int(line), code) for file, line, code in errors] == [
        ("wrong.py", 3, "attr-defined"),
        ("wrong.py", 4, "arg-type"),
    ], done.stdout + done.stderr
