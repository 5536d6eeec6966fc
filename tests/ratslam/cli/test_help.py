"""The help, the version, the schema and the completion scripts of the program."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from importlib.metadata import EntryPoint, version

from ratslam.cli import GROUPS, build_parser
from ratslam.cli.common import Commands
from tests.helpers.commands import ROOT, said

COMMANDS = build_parser().commands.parsers


def test_the_help_lists_every_command_with_an_example_that_is_understood() -> None:
    lines = build_parser().format_help().splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    assert {parser.group for parser in COMMANDS.values()} == set(GROUPS)
    for name, parser in COMMANDS.items():
        assert any(f" {name} " in line and line.endswith(parser.help) for line in lines)
        assert parser.epilog is not None
        words = shlex.split(parser.epilog.removeprefix("Example: python -m ").split(" > ")[0])
        assert words[:2] == ["ratslam", name]
        assert callable(build_parser().parse_args(words[1:]).command)


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


def test_commands_of_packages_are_listed_and_broken_ones_harm_no_others(monkeypatch, capsys) -> None:
    broken = EntryPoint("broken", "no_such_package.commands:add_commands", "ratslam.commands")
    mine = EntryPoint("mine", f"{__name__}:add_commands", "ratslam.commands")
    monkeypatch.setattr("ratslam.cli.entry_points", lambda group: [mine, broken])
    assert "\nmine    survey " in build_parser().format_help()
    assert "the commands 'broken' (no_such_package" in capsys.readouterr().err


def add_commands(commands: Commands) -> None:
    commands.add("survey", None, "measure a field", "survey field", "mine")


def test_the_version_names_python_and_jax_and_the_schema_every_part(capsys) -> None:
    first, second, _ = said(capsys, "tools", "version").splitlines()
    assert first == f"ratslam {version('ratslam')}"
    assert f"jax {version('jax')}" in second
    schema = json.loads(said(capsys, "tools", "schema"))
    assert {"recording", "pose_cells", "templates", "places", "experience"} <= set(schema["properties"])


def test_a_completion_script_knows_every_command_and_completes_files(capsys) -> None:
    for shell, files in (("bash", "run_pos_0_COMPGEN=_shtab_compgen_files"), ("zsh", "_files")):
        script = said(capsys, "tools", "completion", shell)
        assert all(name in script for name in COMMANDS)
        assert files in script
