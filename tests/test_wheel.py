"""The wheel holds all that a program needs, and maps as the checkout does, from any folder."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

pytest.importorskip("build", reason="of the extra [dev]")

ROOT = Path(__file__).parents[1]
PACKAGES = ("ratslam", "tactile", "robot", "evaluation")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built without network in a copy of what it is made of."""
    tree = tmp_path_factory.mktemp("tree")
    for name in (*PACKAGES, "configs", "tests/golden"):
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE", "CITATION.cff"):
        shutil.copy(ROOT / name, tree)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", "dist", "."]
    done = subprocess.run(command, cwd=tree, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (file,) = (tree / "dist").glob("*.whl")
    return file


@pytest.fixture(scope="module")
def site(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of packages with the wheel in it."""
    folder = tmp_path_factory.mktemp("site")
    with ZipFile(wheel) as archive:  # a wheel of Python files is installed by unpacking it
        archive.extractall(folder)
    return folder


def start(site: Path, folder: Path, *arguments: str) -> str:
    """Runs Python with the wheel's packages before all others; returns what it prints."""
    environment = os.environ | {"PYTHONPATH": str(site), "RATSLAM_DATA": "/nowhere"}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_has_every_file(wheel: Path) -> None:
    names = {name for name in ZipFile(wheel).namelist() if ".dist-info/" not in name}
    sources = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.parent.name != "__pycache__"
    }
    assert {f"{package}/py.typed" for package in PACKAGES} <= sources
    packaged = [*(ROOT / "configs").glob("*.yaml"), ROOT / "tests" / "golden" / "a_square3.npz"]
    packaged.append(ROOT / "CITATION.cff")
    assert names == sources | {f"ratslam/packaged/{path.relative_to(ROOT).as_posix()}" for path in packaged}


def test_an_installed_program_finds_its_configurations(site: Path, tmp_path: Path) -> None:
    lines = start(site, tmp_path, "-m", "ratslam", "run", "--list").splitlines()
    assert [line.split()[0] for line in lines] == sorted(
        path.stem for path in (ROOT / "configs").glob("*.yaml")
    )
    code = (
        "import json\n"
        "from ratslam.runs.settings.packaged import find_config\n"
        "from ratslam.runs.settings.run_config import load_config\n"
        "file = load_config(find_config('square')).recording.file\n"
        "print(json.dumps([str(find_config('square')), str(file.resolve())]))\n"
    )
    config, recording = json.loads(start(site, tmp_path, "-c", code))
    assert config == str(site / "ratslam" / "packaged" / "configs" / "square.yaml")
    assert Path(recording).is_relative_to(site)
    assert Path(recording).exists()


@pytest.mark.timeout(1200)  # Numba compiles anew in another folder
@pytest.mark.parametrize(
    ("command", "file"),
    [
        ("reproduce cells --rows drift --sessions 1", "cells.md"),
        ("study --preset spread square --set copies=2", "table.md"),
    ],
)
def test_an_installed_program_has_the_studies_and_the_papers(
    command: str, file: str, site: Path, tmp_path: Path
) -> None:
    start(site, tmp_path, "-m", "ratslam", *command.split(), "-o", "made")
    assert (tmp_path / "made" / file).read_text(encoding="utf-8").count("\n| ") > 3


@pytest.mark.soak
@pytest.mark.parametrize("name", ["square", "whisker_maze"])
def test_an_installed_program_maps_to_the_same_bytes(name: str, site: Path, tmp_path: Path) -> None:
    for folder in ("installed", "checkout"):
        (tmp_path / folder).mkdir()
    start(site, tmp_path / "installed", "-m", "ratslam", "run", name)
    config = str(ROOT / "configs" / f"{name}.yaml")
    start(ROOT, tmp_path / "checkout", "-m", "ratslam", "run", config)
    for file in ("trajectory.tum", "steps.csv", "map.g2o"):
        pair = [tmp_path / folder / "runs" / name / file for folder in ("installed", "checkout")]
        assert pair[0].read_bytes() == pair[1].read_bytes(), file
