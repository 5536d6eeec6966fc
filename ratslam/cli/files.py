"""The commands around files and the program itself: recover, schema, version, completion."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from ratslam.cli.common import Commands


def add_commands(commands: Commands) -> None:
    """Registers the commands of this module."""
    recover = commands.add(
        "recover", _recover, "repair a recording that was cut off",
        "recover runs/maze/session.mcap -o runs/whole.mcap", "files",
    )  # fmt: skip
    recover.add_argument("recording", type=Path, metavar="MCAP", help="the damaged recording")
    recover.add_argument("-o", "--output", type=Path, required=True, metavar="MCAP", help="the new file")

    schema = commands.add(
        "schema", _schema, "print the JSON schema of configurations, for editors",
        "schema -o runs/schema.json", "files",
    )  # fmt: skip
    schema.add_argument("-o", "--output", type=Path, metavar="FILE", help="write to a file instead")

    commands.add("version", _version, "print the versions of ratslam, Python and JAX", "version", "files")

    completion = commands.add(
        "completion", _completion, "print a script that completes commands in a shell",
        "completion bash > ~/.local/share/bash-completion/completions/ratslam", "files",
    )  # fmt: skip
    completion.add_argument("shell", choices=("bash", "zsh", "fish"), help="your shell")


def _recover(arguments: argparse.Namespace) -> int:
    from robot.recordings.mcap_reader import recover

    report = recover(arguments.recording, arguments.output)
    lost = f"; the rest is lost: {report.reason}" if report.reason else ""
    print(f"{arguments.output}: {report.samples} samples{lost}")
    return 0


def _schema(arguments: argparse.Namespace) -> int:
    from ratslam.config.run_config import RunConfig
    from ratslam.config.strict_yaml import schema

    text = json.dumps(schema(RunConfig), indent=2) + "\n"
    if arguments.output:
        arguments.output.write_text(text, encoding="utf-8")
    else:
        print(text, end="")
    return 0


def _version(arguments: argparse.Namespace) -> int:
    import platform
    from importlib.metadata import version

    print(f"ratslam {version('ratslam')}")
    print(f"Python {platform.python_version()}, jax {version('jax')}, jaxlib {version('jaxlib')}")
    print(platform.platform())
    return 0


def _completion(arguments: argparse.Namespace) -> int:
    import shtab

    from ratslam.cli import build_parser

    print(shtab.complete(build_parser(), arguments.shell))
    return 0
