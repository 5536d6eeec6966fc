"""The wheel holds all that a program needs, and maps as the checkout does, from any folder; the Dockerfile's
steps install the program."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest
import yaml

pytest.importorskip("build", reason="of the extra [dev]")

ROOT = Path(__file__).parents[1]
PACKAGES = ("ratslam", "tactile", "robot", "evaluation")
COPIED = (*PACKAGES, "configs", "tests/golden")
FILES = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "CITATION.cff", "constraints.txt")
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))


def copied(folder: Path) -> Path:
    """A folder with what an installation reads."""
    for name in COPIED:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in FILES:
        shutil.copy(ROOT / name, folder)
    return folder


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built without network in a copy of what it is made of."""
    tree = copied(tmp_path_factory.mktemp("tree"))
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


def test_an_installed_program_finds_its_configurations_and_all_commands(site: Path, tmp_path: Path) -> None:
    for command in ("study", "reproduce"):
        assert command in start(site, tmp_path, "-m", "ratslam", command, "--help")
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


@pytest.mark.soak
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
    start(ROOT, tmp_path / "checkout", "-m", "ratslam", "run", str(ROOT / "configs" / f"{name}.yaml"))
    for file in ("trajectory.tum", "steps.csv", "map.g2o"):
        pair = [tmp_path / folder / "runs" / name / file for folder in ("installed", "checkout")]
        assert pair[0].read_bytes() == pair[1].read_bytes(), file


# The Dockerfile, and the forms for issues


def instructions(name: str) -> list[str]:
    """The arguments of the Dockerfile's instructions of a name."""
    lines = (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines()
    return [line.removeprefix(name).strip() for line in lines if line.startswith(f"{name} ")]


def execute(command: str, folder: Path) -> None:
    """Executes a line as Docker does, with this Python as `python`."""
    binaries = folder / "bin"
    binaries.mkdir(exist_ok=True)
    if not (binaries / "python").exists():
        (binaries / "python").symlink_to(sys.executable)
    kept = {name: value for name, value in os.environ.items() if name.startswith(("PIP_", "SSL_"))}
    environment = kept | {"PATH": f"{binaries}:{os.environ['PATH']}", "HOME": str(folder)}
    done = subprocess.run(["sh", "-c", command], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_image_copies_what_is_not_ignored() -> None:
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    assert not set(COPIED) & set(ignored)
    assert instructions("COPY") == [". ."]


@pytest.mark.soak
def test_the_steps_of_the_image_and_its_command_run(tmp_path: Path) -> None:
    image = copied(tmp_path)
    for line in instructions("RUN"):
        execute(line, image)
    command = json.loads(instructions("CMD")[0])
    execute(f".venv/bin/{' '.join(command)}", image)
    assert (image / command[-1] / "map.png").stat().st_size > 10_000


def test_both_forms_ask_for_the_manifest() -> None:
    assert len(FORMS) == 2
    for form in FORMS:
        content = yaml.safe_load(form.read_text(encoding="utf-8"))
        assert {"name", "description", "body"} <= content.keys()
        (manifest,) = (field for field in content["body"] if field["id"] == "manifest")
        assert manifest["validations"]["required"]
        assert "manifest.json" in manifest["attributes"]["label"]
