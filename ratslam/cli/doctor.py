"""The command doctor."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ratslam.cli.common import Commands, add_set, prepare_jax
from tactile.base.errors import InputError
from tactile.base.new_file import make_new_file

if TYPE_CHECKING:
    from ratslam.service.doctor.diagnosis import Diagnosis

FAULTY = 1
"""Exit code if a fault was found."""


def add_commands(commands: Commands) -> None:
    """Registers the commands of this module."""
    doctor = commands.add(
        "doctor", _doctor, "say what a recording, run or robot is, and what to do",
        "doctor my_bag -o mine.yaml", "look",
    )  # fmt: skip
    doctor.add_argument(
        "path", type=Path, metavar="FILE", help="recording, run directory, or with --live a configuration"
    )
    doctor.add_argument(
        "-o", "--output", type=Path, metavar="YAML", help="write the configuration that reads the recording"
    )
    doctor.add_argument(
        "--like", type=Path, metavar="MAP",
        help="with -o: a run directory or map of the same sensor, whose view, cells and method to take, so "
        "that the recording can be localised in it or continue it",
    )  # fmt: skip
    doctor.add_argument(
        "--live", action="store_true", help="check the robot of a live session; moves nothing"
    )
    add_set(doctor)


def _doctor(arguments: argparse.Namespace) -> int:
    from ratslam.service.doctor.diagnosis import render

    if arguments.set and not arguments.live:
        raise InputError("--set", "settings without --live", "the configuration of a live session")
    if arguments.live:
        # Whether a live session could start.
        from ratslam.runs.settings.run_config import load_config
        from ratslam.service.doctor.live_check import diagnose_live

        prepare_jax()
        config = load_config(arguments.path, arguments.set)
        diagnosis = diagnose_live(config, str(arguments.path), Path("runs"))
    elif (arguments.path / "manifest.json").exists():
        from ratslam.service.doctor.run_check import diagnose_run

        diagnosis = diagnose_run(arguments.path)
    else:
        diagnosis = _check_recording(arguments)
    print(render(diagnosis))
    return FAULTY if diagnosis.faults else 0


def _check_recording(arguments: argparse.Namespace) -> Diagnosis:
    """What the recording is; writes its configuration."""
    from ratslam.runs.settings.strict_yaml import dump_data
    from ratslam.service.doctor.recording_check import diagnose_recording

    like = None
    if arguments.like is not None:
        from ratslam.methods.method_registry import LOCALISING
        from ratslam.runs.saved_map import read_map

        like = read_map(arguments.like)
        if like.config.backend in LOCALISING.values() and like.config.localise.map is not None:
            like = read_map(like.config.localise.map)
    diagnosis = diagnose_recording(arguments.path, like)
    output = arguments.output
    if output is None or not diagnosis.config:
        return diagnosis
    first = f"# Reads {arguments.path}; written by `python -m ratslam doctor`.\n"
    text = first + dump_data(diagnosis.config)
    make_new_file(output, lambda file: file.write_text(text, encoding="utf-8"))
    return diagnosis._replace(advice=(*diagnosis.advice, f"python -m ratslam run {output}"))
