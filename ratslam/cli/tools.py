"""The command tools, of what is seldom needed: recover, convert, schema, version, completion."""

from __future__ import annotations

import argparse
import json
import os
import sys
from functools import partial
from pathlib import Path

from ratslam.cli.common import Commands
from ratslam.runs.settings import SCHEMA_START
from tactile.base.atomic_write import write_text_atomically
from tactile.base.new_file import make_new_file, require_new_file


def add_commands(commands: Commands) -> None:
    """Registers `tools` with its commands."""
    help = "repair recordings, convert settings, complete commands"
    tools = Commands(commands.add("tools", None, help, "tools version", "files"))
    recover = tools.add(
        "recover", _recover, "repair a recording that was cut off",
        "tools recover runs/maze/session.mcap -o runs/whole.mcap",
    )  # fmt: skip
    recover.add_argument("recording", type=Path, metavar="MCAP", help="the damaged recording")
    recover.add_argument("-o", "--output", type=Path, required=True, metavar="MCAP", help="the new file")

    convert = tools.add(
        "convert", _convert, "turn an OpenRatSLAM parameter file into a configuration",
        "tools convert config_irat.txt --recording irat_red.bag -o irat.yaml",
    )  # fmt: skip
    convert.add_argument("parameters", type=Path, metavar="INI", help="the parameter file")
    convert.add_argument(
        "--recording", type=Path, metavar="FILE",
        help="the bag or video to map (default ROOT.bag, where ROOT is `topic_root` of the parameter file)",
    )  # fmt: skip
    to_file = "write to this file instead of standard output"
    convert.add_argument("-o", "--output", type=Path, metavar="YAML", help=to_file)

    schema = tools.add(
        "schema", _schema, "print the JSON schema of configurations, for editors",
        "tools schema -o runs/schema.json",
    )  # fmt: skip
    schema.add_argument(
        "-o", "--output", type=Path, metavar="FILE",
        check=partial(require_new_file, replaces=SCHEMA_START), help=to_file,
    )  # fmt: skip

    tools.add("version", _version, "print the versions of ratslam, Python and JAX", "tools version")

    completion = tools.add(
        "completion", _completion, "print a script that completes commands in a shell",
        "tools completion bash > ~/.local/share/bash-completion/completions/ratslam",
    )  # fmt: skip
    completion.add_argument("shell", choices=("bash", "zsh", "fish"), help="your shell")
    completion.set_defaults(program=commands.parser)


def _recover(arguments: argparse.Namespace) -> int:
    from robot.recordings.mcap_reader import recover
    from robot.recordings.mcap_scanner import UNCLOSED

    report = recover(arguments.recording, arguments.output)
    lost = f"; the rest is lost: {report.reason}" if report.reason else ""
    lost = f"; all that was written: {UNCLOSED}" if report.reason == UNCLOSED else lost
    print(f"{arguments.output}: {report.samples} samples{lost}")
    return 0


def _convert(arguments: argparse.Namespace) -> int:
    from ratslam.runs.settings.openratslam import convert_parameters
    from ratslam.runs.settings.strict_yaml import dump_data

    output, recording = arguments.output, arguments.recording
    if recording is not None and output is not None and not recording.is_absolute():
        recording = Path(os.path.relpath(recording, output.parent))  # paths in a file start at its folder
    converted = convert_parameters(arguments.parameters, recording)
    for note in converted.notes:
        print(f"note: {note}", file=sys.stderr)
    text = f"# From {arguments.parameters.name} of OpenRatSLAM.\n" + dump_data(converted.settings)
    if output:
        make_new_file(output, lambda file: file.write_text(text, encoding="utf-8"))
    else:
        print(text, end="")
    return 0


def _schema(arguments: argparse.Namespace) -> int:
    from ratslam.runs.settings.run_config import RunConfig
    from ratslam.runs.settings.strict_yaml import schema

    text = json.dumps(schema(RunConfig), indent=2) + "\n"
    if arguments.output:
        write_text_atomically(arguments.output, text)
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

    print(shtab.complete(arguments.program, arguments.shell))
    return 0
