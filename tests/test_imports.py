"""Imports: the contracts of pyproject.toml hold, each of them can fail, and imports are light."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("ratslam", "tactile", "robot", "evaluation")
# For each contract, imports that break it: the importing module and the imported one.
VIOLATIONS = {
    "packages: ratslam above robot, tactile below all": [
        ("tactile.planted", "robot"),
        ("robot.planted", "ratslam.core.estimates"),
    ],
    "evaluation knows tactile alone, but for studies and papers": [
        ("evaluation.metrics.trajectory", "ratslam.core.estimates"),
        ("evaluation.plots.style", "robot"),
    ],
    "only entry points know studies and papers": [
        ("ratslam.runs.run", "evaluation.studies"),
        ("robot.planted", "evaluation.papers"),
    ],
    "robots and sensors do not know evaluation": [
        ("robot.planted", "evaluation"),
        ("tactile.planted", "evaluation"),
    ],
    "rooms of tactile": [("tactile.base.types", "tactile.frontend"), ("tactile.planted", "tactile.base")],
    "rooms of robot": [
        ("robot.drivers.outcome", "robot.emulators"),
        ("robot.recordings.cdr", "robot.live"),
        ("robot.simulation.head.simulated_session", "robot.touch_source"),
    ],
    "rooms of evaluation": [
        ("evaluation.metrics.trajectory", "evaluation.plots.style"),
        ("evaluation.studies.study", "evaluation.papers.trial_sessions"),
    ],
    "rooms of ratslam": [
        ("ratslam.core.session", "ratslam.methods.recall"),
        ("ratslam.classic.pose_cells", "ratslam.grid.config"),
        ("ratslam.recall.filter", "ratslam.mapping"),
        ("ratslam.runs.run", "ratslam.service.source_checks"),
        ("ratslam.service.backend_checks", "ratslam.live"),
        ("ratslam.planted", "ratslam.core.estimates"),
    ],
    "rooms of evaluation.papers": [
        ("evaluation.papers.tables.touch_table", "evaluation.papers.maps"),
        ("evaluation.papers.planted", "ratslam.core.estimates"),
    ],
    "the engine does not know robot and evaluation": [
        ("ratslam.core.session", "robot"),
        ("ratslam.methods.classic", "evaluation"),
    ],
    "networkx is for maps": [
        ("ratslam.classic.pose_cells", "networkx"),
        ("robot.planted", "networkx.algorithms"),
    ],
    "jax is for the engine": [("robot.planted", "jax.numpy"), ("evaluation.metrics.trajectory", "jax")],
    "the libraries of robots are for drivers and live sessions": [
        ("ratslam.runs.run", "usb.core"),
        ("tactile.planted", "serial"),
        ("evaluation.report.page", "rtde_control"),
    ],
}


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the packages and their contracts."""
    folder = tmp_path_factory.mktemp("tree")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


@pytest.fixture(scope="module")
def kept(tree: Path) -> str:
    """What the linter prints of the packages as they are."""
    return _linted(tree)


@pytest.fixture(scope="module")
def broken(tree: Path, kept: str) -> str:
    """What it prints of the packages with all violations planted."""
    for violations in VIOLATIONS.values():
        for importer, imported in violations:
            _plant(tree, importer, imported)
    return _linted(tree)


def _plant(tree: Path, importer: str, imported: str) -> None:
    for module in (imported, importer):
        folder, _, name = module.rpartition(".")
        if name == "planted":
            (tree.joinpath(*folder.split(".")) / "planted.py").touch()
    path = tree.joinpath(*importer.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    path.write_text(f"{path.read_text()}\nimport {imported}\n")


def _linted(tree: Path) -> str:
    code = "from importlinter.cli import lint_imports_command as check; check()"
    command = [sys.executable, "-c", code, "--no-cache", "--no-logo"]
    environment = os.environ | {"COLUMNS": "200", "PYTHONPATH": ""}
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=60)
    assert "Contracts" in done.stdout, done.stdout + done.stderr
    return done.stdout


def _verdicts(printed: str) -> dict[str, str]:
    """KEPT or BROKEN for each contract."""
    return dict(re.findall(r"^(.*) (KEPT|BROKEN)", printed, re.MULTILINE))


def test_contracts_hold(kept: str) -> None:
    assert _verdicts(kept) == dict.fromkeys(VIOLATIONS, "KEPT"), kept


@pytest.mark.parametrize(
    ("contract", "importer", "imported"),
    [(contract, *violation) for contract, violations in VIOLATIONS.items() for violation in violations],
)
def test_a_planted_import_breaks_its_contract(
    contract: str, importer: str, imported: str, broken: str
) -> None:
    """The section of the contract names the import, or the module that is in no layer."""
    assert _verdicts(broken)[contract] == "BROKEN"
    names = "|".join(re.escape(name) for name in VIOLATIONS)
    parts = re.split(rf"^({names})\n-+\n", broken, flags=re.MULTILINE)
    section = dict(zip(parts[1::2], parts[2::2], strict=True))[contract]
    own = imported.split(".")[0] if imported.split(".")[0] not in PACKAGES else imported
    importing = rf"- +{re.escape(importer)} -> {re.escape(own)} \(l\."
    without_layer = rf"listed as layers:\n\n- {re.escape(importer)}\n"
    assert re.search(f"{importing}|{without_layer}", section), section


def _report(code: str) -> Any:
    """The last line printed by a fresh interpreter in the root folder, as JSON."""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


HEAVY = """
import json, sys
print(json.dumps([name for name in ("jax", "matplotlib", "mcap", "scipy", "numba") if name in sys.modules]))
"""


def test_importing_ratslam_is_light() -> None:
    assert _report(f"import ratslam\n{HEAVY}") == []


def test_help_is_light() -> None:
    code = """
import contextlib
from ratslam.__main__ import main
with contextlib.suppress(SystemExit):
    assert main(["--help"]) == 0
"""
    assert _report(code + HEAVY) == []


SLOW = ("matplotlib", "networkx") + tuple(
    f"scipy.{name}" for name in ("signal", "stats", "interpolate", "optimize", "spatial", "ndimage")
)
"""Modules that a run needs after its first estimate, or not at all."""


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
    assert _report(code) == []


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
print(json.dumps([len(names), before == after]))
"""
    count, unchanged = _report(code)
    assert count > 5
    assert unchanged
