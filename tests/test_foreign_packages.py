"""A package of another distribution that hides one of ours gives a one-line error without a traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOREIGN = {
    "without a marker": "__version__ = '7'",
    "with another marker": "RATSLAM_PACKAGE = 'tactile'",
    "raising on import": "raise RuntimeError('boom')",
    "exiting on import": "raise SystemExit(0)",
}


def _run(*path: Path, cwd: Path, code: str = "") -> subprocess.CompletedProcess[str]:
    """Runs the program (or `code`) with `path` and then our packages on Python's path."""
    command = [sys.executable, *(["-c", code] if code else ["-m", "ratslam", "--help"])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, [*path, ROOT]))}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)


@pytest.mark.parametrize("name", ["robot", "evaluation"])
@pytest.mark.parametrize("source", FOREIGN.values(), ids=FOREIGN.keys())
def test_a_foreign_package_is_named(name: str, source: str, tmp_path: Path) -> None:
    package = tmp_path / "elsewhere" / name
    package.mkdir(parents=True)
    (package / "__init__.py").write_text(source)
    done = _run(package.parent, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert f"'{name}' at {package / '__init__.py'} " in done.stderr
    assert "virtual environment of its own" in done.stderr


def test_every_foreign_package_is_named(tmp_path: Path) -> None:
    for name in ("tactile", "robot"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
    lines = _run(tmp_path, cwd=tmp_path).stderr.splitlines()
    assert [line.split("'")[1] for line in lines] == ["tactile", "robot"]


def test_a_missing_package_is_named(tmp_path: Path) -> None:
    """An incomplete copy with the package `ratslam` only."""
    (tmp_path / "ratslam").symlink_to(ROOT / "ratslam")
    code = f"""
import sys
sys.path = [p for p in sys.path if p != {str(ROOT)!r}]
sys.meta_path = [f for f in sys.meta_path if "editable" not in str(f)]
from ratslam.__main__ import main
sys.exit(main([]))
"""
    done = _run(tmp_path, cwd=tmp_path, code=code)
    assert done.returncode == 2
    assert "'robot' is missing" in done.stderr


def test_a_folder_without_init_does_not_hide_ours(tmp_path: Path) -> None:
    """A folder of data called `robot` in the working directory is not a package."""
    (tmp_path / "robot").mkdir()
    code = "from ratslam.__main__ import package_error; print(repr(package_error('robot')))"
    assert _run(cwd=tmp_path, code=code).stdout == "''\n"
