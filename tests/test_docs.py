"""The READMEs are valid: Python blocks run, commands are accepted, links have targets."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from evaluation.studies.study import check_study, read_study
from ratslam.cli import build_parser, main
from ratslam.runs.settings.packaged import find_config, packaged_configs
from ratslam.runs.settings.run_config import LoopConfig, RunConfig, load_config
from ratslam.runs.settings.strict_yaml import override, parse, validate

ROOT = Path(__file__).parents[1]
READMES = sorted(
    path
    for path in ROOT.rglob("*.md")
    if not {".venv", "runs", "build", ".git"} & set(path.relative_to(ROOT).parts)
    and path.name != "CHANGELOG.md"
)


def read(path):
    return path.read_text(encoding="utf-8")


def blocks(path, *languages):
    found = re.findall(r"^```(\w*)\n(.*?)^```", read(path), re.MULTILINE | re.DOTALL)
    return [body for language, body in found if language in languages]


PROGRAMS = ("python -m ", "make ", "pip ")


def commands(path):
    """Commands in a README, a continued one as one line, comments removed."""
    for block in blocks(path, "", "sh", "bash"):
        for line in block.replace("\\\n", "").splitlines():
            if line.startswith(PROGRAMS):
                yield re.split(r"\s+#", line)[0]


def name(path):
    return path.relative_to(ROOT).as_posix()


COMMANDS = [command for path in READMES for command in commands(path)]
MARKED = {
    "robot": (
        "live ", "topics ", "emulate ", "robot.emulators", "doctor --live", "run runs/",
        "run square -o runs/shown",
    ),
    "data": (
        "doctor ", "fit ", "run mine", "run tuesday", "localise runs/monday", "merge runs/monday",
        "tools recover", "tools convert", "pip ", "cells score rat", "cells compare runs/rat rat",
    ),
    "hours": ("study ", "size ", "reproduce ", "check ", "make "),
}  # fmt: skip
"""The only commands that no test types, by their beginnings: they need a robot (or a screen), data of one's
own, or minutes to hours. They are parsed, and their configurations validated; most have tests elsewhere."""
REFUSED = {"python -m ratslam run square --continue runs/square -o runs/rest": "already holds all 349"}
"""What is refused, as its README says: that run was not interrupted."""
SLOW = (
    "run create_arena", "run rat_box", "run rat_kidnap", "run rat_grid", "run whisker_maze", "simulate ",
    "export runs/rat", "timeit ", "run square -o runs/seen", "cells score runs/rat", "cells compare runs/rat",
)  # fmt: skip
"""Commands that take longest: for `make soak`."""


def begins(command, starts):
    return command.removeprefix("python -m ").removeprefix("ratslam ").startswith(starts)


def is_marked(command):
    return any(begins(command, starts) for starts in MARKED.values())


LONG = {
    "docs/cells.md", "ratslam/README.md", "ratslam/classic/README.md", "ratslam/core/README.md",
    "evaluation/studies/README.md", "evaluation/papers/README.md",
    "ratslam/service/README.md", "ratslam/grid/README.md", "ratslam/runs/README.md",
}  # fmt: skip
"""READMEs whose blocks take longest, on parts that have tests of their own: for `make soak`."""


PYTHON = [
    pytest.param(path, marks=pytest.mark.soak if name(path) in LONG else (), id=name(path))
    for path in READMES
    if blocks(path, "python")
]


@pytest.mark.parametrize("readme", PYTHON)
def test_python_blocks_run(readme, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # blocks may write files
    for block in blocks(readme, "python"):
        exec(compile(block, name(readme), "exec"), {"__name__": "__main__"})


def test_commands_are_valid():
    """Options and names, and of a packaged configuration also what `--set` sets."""
    for command in COMMANDS:
        if not command.startswith("python -m ratslam ") or "--list" in command:
            continue
        words = shlex.split(command.partition(" ratslam ")[2])
        given = build_parser().parse_args(words)
        assert callable(given.command)
        config = getattr(given, "config", getattr(given, "recording", None))
        if words[0] == "study" and not given.preset:
            read_study(find_config(config), given.set)
        elif str(config) in packaged_configs() and getattr(given, "preset", None) != "cells":
            load_config(config, given.set)


MADE: dict[str, Path] = {}
"""The directories of runs by the command that made them."""
TYPED = {path: [command for command in commands(path) if not is_marked(command)] for path in READMES}


ALL = pytest.mark.soak, pytest.mark.timeout(1800)
TYPING = [
    pytest.param(path, slow, marks=ALL if slow else (), id=f"{name(path)}{'-all' * slow}")
    for path, typed in TYPED.items()
    for slow in (False, True)
    if any(begins(command, SLOW) == slow for command in typed)
]


@pytest.mark.parametrize(("readme", "slow"), TYPING)
def test_commands_run(readme, slow, tmp_path, monkeypatch, capsys):
    """In a new folder, one after another, as a reader would type them; equal runs are made once."""
    monkeypatch.chdir(tmp_path)
    for command in TYPED[readme]:
        if begins(command, SLOW) and not slow:
            continue
        output = command.partition(" -o ")[2]
        if command in MADE:
            shutil.copytree(MADE[command], output)
            continue
        words = shlex.split(command)
        if words[2] != "ratslam":
            assert subprocess.run([sys.executable, *words[1:]], cwd=ROOT).returncode == 0, command
            continue
        try:
            code = main(words[3:])
        except SystemExit as ended:  # of --list
            code = ended.code
        error = capsys.readouterr().err
        assert code == (2 if command in REFUSED else 0), f"{command}\n{error}"
        assert REFUSED.get(command, "") in error
        if output and begins(command, ("run square -o",)):
            MADE[command] = tmp_path / output


def test_settings_are_valid():
    for path in READMES:
        for text in blocks(path, "yaml"):
            settings = parse(text.replace("whisker_maze.yaml", "whisker_maze"), name(path))
            if "studies" in name(path):
                check_study("study", settings, ROOT)
            else:
                validate(settings, LoopConfig)


def test_every_block_is_tried():
    """Prose (text), a table of numbers and an entry point are the only blocks of other kinds."""
    known = {"", "sh", "bash", "python", "yaml", "text", "toml"}
    for path in READMES:
        assert set(re.findall(r"^```(\w+)$", read(path), re.MULTILINE)) <= known, path
        for block in blocks(path, "", "sh", "bash"):
            lines = [line for line in block.splitlines() if line.startswith(PROGRAMS)]
            assert lines or block.startswith("t,vx"), block
    every = [start for starts in MARKED.values() for start in starts]
    assert all(any(begins(command, (start,)) for command in COMMANDS) for start in every)


def test_links_have_targets():
    missing = []
    for readme in READMES:
        text = re.sub(r"^```.*?^```", "", read(readme), flags=re.MULTILINE | re.DOTALL)
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
            if not re.match(r"\w+:", target) and not (readme.parent / target).exists():
                missing.append((name(readme), target))
    assert missing == []


def test_files_of_the_equations_exist():
    text = read(ROOT / "evaluation" / "RESULTS.md")
    files = re.findall(r"`([\w/]+(?:\.py|/))`", text[text.index("## Equations and files") :])
    assert len(files) > 20
    assert [file for file in files if not (ROOT / file).exists()] == []


def test_settings_named_for_users_of_openratslam_exist():
    page = ROOT / "docs" / "coming_from_openratslam.md"
    text, (content,) = read(page), blocks(page, "yaml")
    camera = ["recording.visual_odometry.fov_deg=60"]  # its settings are in the table too
    config = validate(override(parse(content, "irat.yaml"), camera), RunConfig)
    table = text[text.index("## Parameters") : text.index("## What we do")]
    paths = re.findall(r"`([a-z_]+(?:\.[a-z_]+)+)`", table)
    assert len(paths) > 20
    for path in paths:
        section = config
        for key in path.split("."):
            assert hasattr(section, key), path
            section = getattr(section, key)


@pytest.mark.soak
def test_the_reference_is_built_without_warnings(tmp_path):
    pytest.importorskip("pdoc", reason="of the extra [docs]")
    command = [sys.executable, str(ROOT / "docs" / "reference.py"), str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    for page in ("index", "tactile/base/types", "robot/sources", "evaluation/metrics"):
        assert (tmp_path / f"{page}.html").is_file()
