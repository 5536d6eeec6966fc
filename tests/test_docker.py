"""The Dockerfile's steps work in an empty folder, and the forms for issues are valid."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
COPIED = ("ratslam", "tactile", "robot", "evaluation", "configs", "tests/golden")


def instructions(name: str) -> list[str]:
    """The arguments of the Dockerfile's instructions of a name."""
    lines = (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines()
    return [line.removeprefix(name).strip() for line in lines if line.startswith(f"{name} ")]


@pytest.fixture
def image(tmp_path: Path) -> Path:
    """A folder with what `COPY . .` copies, as far as an installation reads it."""
    for name in COPIED:
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    return tmp_path


def execute(command: str, folder: Path, **variables: str) -> str:
    """Executes a line as Docker does, with this Python as `python`; returns what it prints."""
    binaries = folder / "bin"
    binaries.mkdir(exist_ok=True)
    if not (binaries / "python").exists():
        (binaries / "python").symlink_to(sys.executable)
    kept = {name: value for name, value in os.environ.items() if name.startswith(("PIP_", "SSL_"))}
    environment = kept | {"PATH": f"{binaries}:{os.environ['PATH']}", "HOME": str(folder)} | variables
    done = subprocess.run(["sh", "-c", command], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_copied_files_are_not_ignored() -> None:
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    assert not set(COPIED) & set(ignored)
    assert instructions("COPY") == [". ."]


@pytest.mark.soak
def test_the_steps_install_the_program(image: Path) -> None:
    """Without dependencies, which other tests install: `make soak` runs the steps as they are."""
    pytest.importorskip("build", reason="of the extra [dev]")
    packages = Path(pytest.__file__).parents[1]
    for line in instructions("RUN"):
        execute(line, image, PIP_NO_DEPS="1", PIP_NO_BUILD_ISOLATION="0", PYTHONPATH=str(packages))
    shutil.rmtree(image / "ratslam")
    program = ".venv/bin/" + " ".join(json.loads(instructions("CMD")[0])[:4])
    listed = execute(f"{program} --list", image, PYTHONPATH=str(packages))
    assert json.loads(instructions("CMD")[0])[4] in listed


@pytest.mark.soak
def test_the_steps_and_the_command_run(image: Path) -> None:
    for line in instructions("RUN"):
        execute(line, image)
    command = json.loads(instructions("CMD")[0])
    execute(f".venv/bin/{' '.join(command)}", image)
    assert (image / command[-1] / "map.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    "form", sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")), ids=lambda f: f.stem
)
def test_forms_ask_for_the_manifest(form: Path) -> None:
    content = yaml.safe_load(form.read_text(encoding="utf-8"))
    assert {"name", "description", "body"} <= content.keys()
    fields = {field["id"]: field for field in content["body"]}
    assert fields["manifest"]["validations"]["required"]
    assert "manifest.json" in fields["manifest"]["attributes"]["label"]


def test_there_are_two_forms() -> None:
    assert len(FORMS) == 2
