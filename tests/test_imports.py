"""Imports: contracts hold, imports are light, change nothing, and name a package that hides one of ours."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
HEAVY = ("jax", "matplotlib", "mcap", "scipy", "numba")
SLOW = ("matplotlib", "networkx") + tuple(
    f"scipy.{name}" for name in ("signal", "stats", "interpolate", "optimize", "spatial", "ndimage")
)
"""Modules that a run needs after its first estimate, or not at all."""


def test_contracts_hold() -> None:
    code = "from importlinter.cli import lint_imports_command as check; check()"
    command = [sys.executable, "-c", code, "--no-cache", "--no-logo"]
    environment = os.environ | {"COLUMNS": "200", "PYTHONPATH": ""}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    assert " KEPT" in done.stdout


def printed_by(code: str) -> Any:
    """The last line printed by a fresh interpreter in the root folder, as JSON."""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_importing_ratslam_and_its_help_are_light() -> None:
    code = f"""
import contextlib, json, sys
import ratslam
from ratslam.__main__ import main
with contextlib.suppress(SystemExit):
    assert main(["--help"]) == 0
print(json.dumps([name for name in {HEAVY} if name in sys.modules]))
"""
    assert printed_by(code) == []


def test_a_run_begins_without_slow_imports() -> None:
    code = f"""
import json, sys
from ratslam.cli.common import prepare_jax
prepare_jax()
import evaluation.metrics.scorecard
from ratslam.runs.settings.run_config import load_config
from ratslam.runs.run import open_observations
from ratslam.runs.build_session import build_session
with open_observations(load_config("configs/whisker_maze.yaml")) as (config, source):
    build_session(config, source)
    next(iter(source))
print(json.dumps([name for name in {SLOW} if name in sys.modules]))
"""
    assert printed_by(code) == []


def test_importing_ratslam_changes_no_setting_of_jax() -> None:
    code = """
import importlib, json, os, pkgutil
import jax
before = dict(jax.config.values), dict(os.environ)
import ratslam
names = [module.name for module in pkgutil.walk_packages(ratslam.__path__, "ratslam.")]
for name in names:
    importlib.import_module(name)
after = dict(jax.config.values), dict(os.environ)
print(json.dumps([len(names) > 5, before == after]))
"""
    assert printed_by(code) == [True, True]


# Packages of others


def started(*path: Path, cwd: Path, code: str = "") -> subprocess.CompletedProcess[str]:
    """Runs the program (or `code`) with `path` and then our packages on Python's path."""
    command = [sys.executable, *(["-c", code] if code else ["-m", "ratslam", "--help"])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, [*path, ROOT]))}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)


@pytest.mark.parametrize(
    ("names", "source"),
    [
        (["robot"], "__version__ = '7'"),
        (["evaluation"], "RATSLAM_PACKAGE = 'tactile'"),
        (["evaluation"], "raise RuntimeError('boom')"),
        (["robot"], "raise SystemExit(0)"),
        (["tactile", "robot"], ""),
    ],
    ids=["without a marker", "with another marker", "raising on import", "exiting on import", "two packages"],
)
def test_foreign_packages_are_named(names: list[str], source: str, tmp_path: Path) -> None:
    files = [tmp_path / "elsewhere" / name / "__init__.py" for name in names]
    for file in files:
        file.parent.mkdir(parents=True)
        file.write_text(source)
    done = started(tmp_path / "elsewhere", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    for name, file, line in zip(names, files, done.stderr.splitlines(), strict=True):
        assert f"'{name}' at {file} " in line
        assert "virtual environment of its own" in line


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
    done = started(tmp_path, cwd=tmp_path, code=code)
    assert done.returncode == 2
    assert "'robot' is missing" in done.stderr


def test_a_folder_without_init_does_not_hide_ours(tmp_path: Path) -> None:
    """A folder of data called `robot` in the working directory is not a package."""
    (tmp_path / "robot").mkdir()
    code = "from ratslam.__main__ import package_error; print(repr(package_error('robot')))"
    assert started(cwd=tmp_path, code=code).stdout == "''\n"
