"""The help, the version and the completion scripts of the program."""

from __future__ import annotations

import shlex
import subprocess
import sys
from importlib.metadata import EntryPoint, version
from pathlib import Path

import pytest

from evaluation.papers.figure import MAPS
from ratslam.cli import GROUPS, build_parser, main
from ratslam.cli.common import Commands

ROOT = Path(__file__).parents[3]
PROGRAM = build_parser()
COMMANDS = PROGRAM.commands.parsers


def test_the_help_fits_one_screen_and_lists_every_command() -> None:
    lines = PROGRAM.format_help().splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    assert {parser.group for parser in COMMANDS.values()} == set(GROUPS)
    for name, parser in COMMANDS.items():
        assert any(f" {name} " in line and line.endswith(parser.help) for line in lines)


def test_the_help_of_saved_maps_lists_every_row(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["reproduce", "maps", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert all(row in text for row in MAPS)


def test_the_help_loads_no_numerics() -> None:
    code = (
        "import sys\n"
        "from ratslam.cli import build_parser\n"
        "build_parser().format_help()\n"
        "slow = {'jax', 'numpy', 'scipy', 'pydantic', 'matplotlib', 'yaml', 'tqdm'}\n"
        "print(sorted(slow & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_an_example_that_is_understood(name: str) -> None:
    epilog = COMMANDS[name].epilog
    assert epilog is not None
    words = shlex.split(epilog.removeprefix("Example: python -m ").split(" > ")[0])
    assert words[:2] == ["ratslam", name]
    assert callable(build_parser().parse_args(words[1:]).command)


def test_commands_of_a_broken_package_harm_no_others(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    broken = EntryPoint("broken", "no_such_package.commands:add_commands", "ratslam.commands")
    monkeypatch.setattr("ratslam.cli.entry_points", lambda group: [broken])
    assert "run" in build_parser().commands.parsers
    assert "the commands 'broken' (no_such_package" in capsys.readouterr().err


def test_commands_of_an_own_group_are_in_the_help(monkeypatch) -> None:
    mine = EntryPoint("mine", f"{__name__}:add_commands", "ratslam.commands")
    monkeypatch.setattr(EntryPoint, "load", lambda self: add_commands)
    monkeypatch.setattr("ratslam.cli.entry_points", lambda group: [mine])
    assert "\nmine    survey " in build_parser().format_help()


def add_commands(commands: Commands) -> None:
    commands.add("survey", None, "measure a field", "survey field", "mine")


def test_an_unknown_command_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["runn"])
    assert left.value.code == 2
    assert "invalid choice: 'runn'" in capsys.readouterr().err


def test_the_version_names_python_and_jax(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tools", "version"]) == 0
    first, second, _ = capsys.readouterr().out.splitlines()
    assert first == f"ratslam {version('ratslam')}"
    assert f"jax {version('jax')}" in second


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_completion_script_knows_every_command(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tools", "completion", shell]) == 0
    script = capsys.readouterr().out
    assert all(name in script for name in COMMANDS)


def test_bash_completes_commands_options_choices_and_files(tmp_path: Path, capsys) -> None:
    assert main(["tools", "completion", "bash"]) == 0
    (tmp_path / "script").write_text(capsys.readouterr().out)
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "maze.yaml").touch()

    def completions(*words: str) -> set[str]:
        code = (
            f"source ../script; COMP_WORDS=({' '.join(map(shlex.quote, words))}); "
            f"COMP_CWORD={len(words) - 1}; _shtab_ratslam; printf '%s\\n' \"${{COMPREPLY[@]}}\""
        )
        done = subprocess.run(
            ["bash", "-c", code], cwd=tmp_path / "work", capture_output=True, text=True, check=True
        )
        return set(done.stdout.split())

    assert completions("ratslam", "expo") == {"export"}
    assert completions("ratslam", "tools", "vers") == {"version"}
    assert completions("ratslam", "run", "--cont") == {"--continue"}
    assert completions("ratslam", "tools", "completion", "") == {"bash", "zsh", "fish"}
    assert completions("ratslam", "run", "ma") == {"maze.yaml"}
