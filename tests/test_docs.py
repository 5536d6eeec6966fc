"""The READMEs are valid: Python blocks run, commands are accepted, links have targets."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ratslam.cli import build_parser
from ratslam.config.run_config import RunConfig
from ratslam.config.strict_yaml import override, parse, validate

ROOT = Path(__file__).parents[1]
READMES = sorted(
    path
    for path in ROOT.rglob("*.md")
    if not {".venv", "runs", "build", ".git"} & set(path.relative_to(ROOT).parts)
    and path.name != "CHANGELOG.md"
)


def blocks(text: str, *languages: str) -> list[str]:
    """The fenced code blocks of a text in one of the languages."""
    found = re.findall(r"^```(\w*)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return [body for language, body in found if language in languages]


def commands(path: Path) -> Iterator[str]:
    """Commands of the program in a README, comments removed."""
    for block in blocks(path.read_text(encoding="utf-8"), "", "sh", "bash"):
        for line in block.splitlines():
            if line.startswith("python -m ratslam "):
                yield line.split("  #")[0].strip()


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


PYTHON = [path for path in READMES if blocks(path.read_text(encoding="utf-8"), "python")]
COMMANDS = [(name(path), command) for path in READMES for command in commands(path)]


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the repository's root, in which blocks may write files."""
    for part in ("configs", "tests"):
        (tmp_path / part).symlink_to(ROOT / part)
    monkeypatch.chdir(tmp_path)
    return tmp_path


LONG = {
    "docs/cells.md", "ratslam/README.md", "ratslam/attractor/README.md", "ratslam/core/README.md",
    "ratslam/experiments/studies/README.md", "ratslam/experiments/trials/README.md",
    "ratslam/export/README.md", "ratslam/grid/README.md", "ratslam/pipeline/README.md",
    "ratslam/rats/README.md", "ratslam/viewer/README.md",
}  # fmt: skip
"""READMEs whose blocks take longest, on parts that have tests of their own: for `make soak`."""


@pytest.mark.parametrize(
    "readme",
    [
        pytest.param(path, marks=pytest.mark.soak if name(path) in LONG else (), id=name(path))
        for path in PYTHON
    ],
)
@pytest.mark.usefixtures("checkout")
def test_python_blocks_run(readme: Path) -> None:
    for block in blocks(readme.read_text(encoding="utf-8"), "python"):
        exec(compile(block, name(readme), "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize(("readme", "command"), COMMANDS)
def test_commands_are_valid(readme: str, command: str) -> None:
    words = shlex.split(command)[3:]
    if "--list" in words:
        with pytest.raises(SystemExit, match=r"^0$"):
            build_parser().parse_args(words)
    else:
        assert callable(build_parser().parse_args(words).command)


@pytest.mark.soak
def test_commands_of_the_root_readme_run(tmp_path: Path) -> None:
    """In a fresh copy of the repository, one after another, as a reader would type them."""
    clone = tmp_path / "clone"
    subprocess.run(["git", "clone", "--quiet", "--depth=1", ROOT.as_uri(), str(clone)], check=True)
    environment = os.environ | {"PYTHONPATH": str(clone)}
    for command in commands(clone / "README.md"):
        arguments = [sys.executable, *shlex.split(command)[1:]]
        done = subprocess.run(arguments, cwd=clone, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, f"{command}\n{done.stderr}"


@pytest.mark.parametrize("readme", READMES, ids=name)
def test_links_have_targets(readme: Path) -> None:
    text = re.sub(r"^```.*?^```", "", readme.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    targets = re.findall(r"\]\(([^)#\s]+)[^)]*\)", text)
    missing = [
        target
        for target in targets
        if not re.match(r"\w+:", target) and not (readme.parent / target).exists()
    ]
    assert missing == []


def test_files_of_the_equations_exist() -> None:
    text = (ROOT / "evaluation" / "RESULTS.md").read_text(encoding="utf-8")
    files = re.findall(r"`([\w/]+(?:\.py|/))`", text[text.index("## Equations and files") :])
    assert len(files) > 20
    assert [file for file in files if not (ROOT / file).exists()] == []


def test_settings_named_for_users_of_openratslam_exist() -> None:
    text = (ROOT / "docs" / "coming_from_openratslam.md").read_text(encoding="utf-8")
    (content,) = blocks(text, "yaml")
    settings = parse(content, "irat.yaml")
    camera = override(settings, ["recording.visual_odometry.fov_deg=60"])  # its settings are in the table too
    config = validate(camera, RunConfig)
    table = text[text.index("## Parameters") : text.index("## What we do")]
    paths = re.findall(r"`([a-z_]+(?:\.[a-z_]+)+)`", table)
    assert len(paths) > 20
    for path in paths:
        section: object = config
        for key in path.split("."):
            assert hasattr(section, key), path
            section = getattr(section, key)


@pytest.mark.soak
def test_the_reference_is_built_without_warnings(tmp_path: Path) -> None:
    pytest.importorskip("pdoc", reason="of the extra [docs]")
    command = [sys.executable, str(ROOT / "docs" / "reference.py"), str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    for page in (
        "index",
        "ratslam/config/packaged",
        "tactile/base/types",
        "robot/sources",
        "evaluation/metrics",
    ):
        assert (tmp_path / f"{page}.html").is_file()
