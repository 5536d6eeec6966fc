"""The commands check (conformance of registered parts, robots), export, and tools, of what is seldom needed:
recover, convert, schema, version, completion."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ratslam.cli.common import (
    Commands,
    add_set,
    count_from_zero,
    positive_integer,
    positive_rate,
    prepare_jax,
)
from ratslam.runs.settings import SCHEMA_START
from tactile.base.errors import tell
from tactile.base.files import make_new_file, require_new_file, write_text_atomically

if TYPE_CHECKING:
    from ratslam.service.check_results import Result


def add_tools(commands: Commands) -> None:
    """Registers `tools` with its commands."""
    help = "repair recordings, convert settings, complete commands"
    tools = Commands(commands.add("tools", None, help, "tools version", "files"))
    recover = tools.add(
        "recover", _recover, "repair a recording that was cut off",
        "tools recover runs/maze/session.mcap -o runs/whole.mcap",
    )  # fmt: skip
    recover.add_path("recording", "MCAP", "the damaged recording")
    recover.add_path("-o", "MCAP", "the new file", required=True)

    convert = tools.add(
        "convert", _convert, "turn an OpenRatSLAM parameter file into a configuration",
        "tools convert config_irat.txt --recording irat_red.bag -o irat.yaml",
    )  # fmt: skip
    convert.add_path("parameters", "INI", "the parameter file")
    convert.add_path(
        "--recording", "FILE",
        "the bag or video to map (default ROOT.bag, where ROOT is `topic_root` of the parameter file)",
    )  # fmt: skip
    to_file = "write to this file instead of standard output"
    convert.add_path("-o", "YAML", to_file)

    schema = tools.add(
        "schema", _schema, "print the JSON schema of configurations, for editors",
        "tools schema -o runs/schema.json",
    )  # fmt: skip
    schema.add_path("-o", "FILE", to_file, check=partial(require_new_file, replaces=SCHEMA_START))

    tools.add("version", _version, "print the versions of ratslam, Python and JAX", "tools version")

    completion = tools.add(
        "completion", _completion, "print a script that completes commands in a shell",
        "tools completion bash > ~/.local/share/bash-completion/completions/ratslam",
    )  # fmt: skip
    completion.add_argument("shell", choices=("bash", "zsh", "fish"), help="your shell")
    completion.set_defaults(program=commands.parser)


def _recover(arguments: argparse.Namespace) -> None:
    from robot.recordings.mcap_reader import UNCLOSED
    from robot.recordings.mcap_writer import recover

    samples, reason = recover(arguments.recording, arguments.output)
    lost = f"; the rest is lost: {reason}" if reason else ""
    lost = f"; all that was written: {UNCLOSED}" if reason == UNCLOSED else lost
    print(f"{arguments.output}: {samples} samples{lost}")


def _convert(arguments: argparse.Namespace) -> None:
    from ratslam.runs.settings.openratslam import convert_parameters
    from ratslam.runs.settings.strict_yaml import dump_data

    output, recording = arguments.output, arguments.recording
    if recording is not None and output is not None and not recording.is_absolute():
        recording = Path(os.path.relpath(recording, output.parent))  # paths in a file start at its folder
    settings, notes = convert_parameters(arguments.parameters, recording)
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
    text = f"# From {arguments.parameters.name} of OpenRatSLAM.\n" + dump_data(settings)
    if output:
        make_new_file(output, lambda file: file.write_text(text, encoding="utf-8"))
    else:
        print(text, end="")


def _schema(arguments: argparse.Namespace) -> None:
    from ratslam.runs.settings.run_config import RunConfig
    from ratslam.runs.settings.strict_yaml import schema

    text = json.dumps(schema(RunConfig), indent=2) + "\n"
    if arguments.output:
        write_text_atomically(arguments.output, text)
    else:
        print(text, end="")


def _version(arguments: argparse.Namespace) -> None:
    import platform
    from importlib.metadata import version

    print(f"ratslam {version('ratslam')}")
    print(f"Python {platform.python_version()}, jax {version('jax')}, jaxlib {version('jaxlib')}")
    print(platform.platform())


def _completion(arguments: argparse.Namespace) -> None:
    import shtab

    print(shtab.complete(arguments.program, arguments.shell))


FAILED = 1
"""Exit code if a check failed."""


def add_check(commands: Commands) -> None:
    """Registers `check` with a command for each kind of part."""
    check = commands.add(
        "check", None, "check a backend, source, touch front end, metric, robot", "check backend recall",
        "files",
    )  # fmt: skip
    kinds = Commands(check)
    for kind, what, example in (
        ("backend", "a SLAM method", "recall"),
        ("source", "a source or recording format", "my_robot"),
        ("touch", "a touch front end", "my_taxels --source my_array"),
        ("metric", "a metric", "my_error"),
    ):
        parser = kinds.add(kind, partial(_check, kind), f"check {what}", f"check {kind} {example}")
        parser.add_argument("name", metavar="NAME", help="name under which it is registered")
        parser.add_argument(
            "--set", action="append", default=[], metavar="settings.a=value",
            help="replace a setting of it; may be repeated",
        )  # fmt: skip
    robot = kinds.add("robot", _check_robot, "move a robot and measure it", "check robot create live_create")
    robot.add_argument(
        "robot", choices=("create", "arm", "head"),
        help="create: odometry of a Create 1 or 2, on 2 m of free floor; arm: force and states of an arm, by "
        "pokes in free air; head: whiskers on an arm, by whisks in free air",
    )  # fmt: skip
    robot.add_path(
        "config", "CONFIG",
        "configuration of a live session, or the bench.json of an earlier check, to judge it with marks",
    )  # fmt: skip
    robot.add_path("-o", "DIR", "write page.txt, rig.yaml and bench.json to a new folder")
    robot.add_argument(
        "--turned-deg",
        type=positive_rate,
        metavar="DEG",
        help="create: true amount of the first turn, degrees",
    )
    robot.add_argument(
        "--drove-m", type=positive_rate, metavar="M", help="create: true way of the first drive, m"
    )
    add_set(robot)
    source, touch = kinds.parsers["source"], kinds.parsers["touch"]
    source.add_argument(
        "--touch", metavar="NAME",
        help="front end for readings that are not observations; its settings by --set touch.a=value",
    )  # fmt: skip
    source.add_argument(
        "--samples", type=positive_integer, metavar="N", help="samples to examine (default 4096)"
    )
    touch.add_argument(
        "--source", metavar="NAME",
        help="registered source of its readings, its settings by --set source.a=value (default: a simulated "
        "whisker head)",
    )  # fmt: skip


def _check(kind: str, arguments: argparse.Namespace) -> int:
    """Prints the result of each check of a part of this kind."""
    name, settings = arguments.name, arguments.set
    results: Iterator[Result]
    if kind == "backend":
        prepare_jax()
        from ratslam.service.backend_checks import check_backend

        tell("the checks take a minute or two, and several on a busy machine")
        results = check_backend(name, settings)
    elif kind == "source":
        from ratslam.service.source_checks import SAMPLES, check_source

        results = check_source(name, settings, arguments.touch, arguments.samples or SAMPLES)
    elif kind == "touch":
        from ratslam.service.source_checks import check_touch

        results = check_touch(name, settings, arguments.source)
    else:
        from ratslam.service.metric_checks import check_metric

        results = check_metric(name, settings)
    statuses = []
    for result in results:
        statuses.append(result.status)
        print(result.line(), flush=True)
    failed, skipped = statuses.count("FAIL"), statuses.count("-")
    rest = f", {skipped} not run" if skipped else ""
    print(f"{name}: {len(statuses)} checks, {failed} failed{rest}")
    return FAILED if failed else 0


def _check_robot(arguments: argparse.Namespace) -> int:
    """Moves a robot, or judges the record of an earlier check, and says what was found."""
    from ratslam.service.robot_check import ROBOTS, RobotRequest

    def ask(question: str) -> float | None:
        with suppress(EOFError):
            while text := input(question).strip():
                with suppress(argparse.ArgumentTypeError):
                    return positive_rate(text)
        return None

    marks = {"turned_deg": arguments.turned_deg, "drove_m": arguments.drove_m}
    request = RobotRequest(arguments.config, arguments.set, marks, ask if sys.stdin.isatty() else None)
    report = ROBOTS[arguments.robot](request)
    print(report.render())
    if arguments.output is not None:
        report.write(arguments.output, str(arguments.config))
        print(f"{arguments.output}: written; bench.json is what to send back")
    return FAILED if report.faulty else 0


def add_export(commands: Commands) -> None:
    """Registers the command of this module."""
    export = commands.add(
        "export", _export, "write a run as a standard file",
        "export runs/square -o runs/square.mcap", "files",
    )  # fmt: skip
    export.add_path("run", "RUN", "the run directory")
    export.add_path(
        "-o", "FILE",
        "the new file: .mcap for ROS 2 tools, .tum trajectory, .g2o pose graph, .json or .graphml "
        "experiences, .yaml nav2 map, .nwb or .npz spikes of recorded pose cells, .csv their scores; a name "
        "without a suffix becomes a ROS 2 bag folder", required=True,
    )  # fmt: skip
    export.add_argument(
        "--peak-rate", type=positive_rate, default=20.0, metavar="HZ",
        help="cells: rate of a cell at the peak of a settled packet (default 20 Hz)",
    )  # fmt: skip
    export.add_argument(
        "--spike-seed", type=count_from_zero, default=0, metavar="N", help="spikes: seed (default 0)"
    )
    export.add_argument(
        "--theta", type=positive_rate, default=0.0, metavar="HZ",
        help="spikes: in each of so many cycles a second one cell, drawn by its activity, fires for all "
        "(default: all fire by their activity at all times)",
    )  # fmt: skip
    export.add_argument(
        "--shuffles", type=count_from_zero, default=100, metavar="N",
        help="scores of cells: shuffled controls of each (default 100; 0: none)",
    )  # fmt: skip
    export.add_argument(
        "--about", action="append", default=[], metavar="KEY=VALUE",
        help="NWB: subject_id, species, sex, age, start, description, experimenter, lab or institution; may "
        "be repeated",
    )  # fmt: skip


def _export(arguments: argparse.Namespace) -> None:
    from ratslam.runs.settings.strict_yaml import override, parse, validate
    from ratslam.service.export_formats import NwbMetadata, export_run
    from ratslam.service.spikes import SpikeConfig

    export_run(
        arguments.run,
        arguments.output,
        lambda text: tell(f"warning: {text}"),
        SpikeConfig(peak_rate=arguments.peak_rate, seed=arguments.spike_seed, theta_hz=arguments.theta),
        validate(override(parse("{}", "--about"), arguments.about), NwbMetadata),
        arguments.shuffles,
    )
    print(f"{arguments.output}: written")
