"""The commands doctor, which says what a recording, run or robot is, and fit, which measures a rig."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ratslam.cli.common import Commands, add_set, prepare_jax
from tactile.base.errors import InputError
from tactile.base.files import make_new_file

if TYPE_CHECKING:
    from ratslam.runs.settings.run_config import RunConfig
    from ratslam.service.recording_check import Diagnosis


FAULTY = 1
"""Exit code if a fault was found."""


def add_commands(commands: Commands) -> None:
    """Registers the commands of this module."""
    doctor = commands.add(
        "doctor", _doctor, "say what a recording, run or robot is, and what to do",
        "doctor my_bag -o mine.yaml", "look",
    )  # fmt: skip
    doctor.add_path("path", "FILE", "recording, run directory, or with --live a configuration")
    doctor.add_path("-o", "YAML", "write the configuration that reads the recording")
    doctor.add_path(
        "--like", "MAP",
        "with -o: a run directory or map of the same sensor, whose view, cells and method to take, so "
        "that the recording can be localised in it or continue it",
    )  # fmt: skip
    doctor.add_flag("--live", "check the robot of a live session; moves nothing")
    add_set(doctor)

    fit = commands.add(
        "fit", _fit, "measure wheels, whiskers and head from a record", "fit create_lab -o rig.yaml", "look"
    )
    fit.add_path(
        "record", "RECORD",
        "recording, or the configuration (YAML, or name of a packaged one) that reads it",
    )  # fmt: skip
    fit.add_path("-o", "YAML", "write the settings to a new file, for `include: [FILE]` in a configuration")
    fit.add_argument("--seed", type=int, default=0, metavar="S", help="seed of the bootstrap (default 0)")
    add_set(fit)


def _doctor(arguments: argparse.Namespace) -> int:

    if arguments.set and not arguments.live:
        raise InputError("--set", "settings without --live", "the configuration of a live session")
    if arguments.live:
        # Whether a live session could start.
        from ratslam.runs.settings.run_config import load_config
        from ratslam.service.run_check import diagnose_live

        prepare_jax()
        config = load_config(arguments.path, arguments.set)
        diagnosis = diagnose_live(config, str(arguments.path), Path("runs"))
    elif (arguments.path / "manifest.json").exists():
        from ratslam.service.run_check import diagnose_run

        diagnosis = diagnose_run(arguments.path)
    else:
        diagnosis = _check_recording(arguments)
    print(diagnosis.render())
    return FAULTY if diagnosis.faults else 0


def _check_recording(arguments: argparse.Namespace) -> Diagnosis:
    """What the recording is; writes its configuration."""
    from ratslam.runs.settings.strict_yaml import dump_data
    from ratslam.service.recording_check import diagnose_recording

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


def _fit(arguments: argparse.Namespace) -> None:
    if arguments.seed < 0:
        raise InputError("--seed", str(arguments.seed), "a non-negative integer")
    prepare_jax()
    from ratslam.service.record_fit import fit_record

    rig = fit_record(_config_of(arguments), arguments.seed)
    print(rig.render())
    if not rig.quantities and not rig.settings:
        raise InputError(str(arguments.record), "nothing that tells of the rig", "true poses or whiskers")
    output: Path | None = arguments.output
    if output is not None:
        text = rig.file_text(str(arguments.record))
        make_new_file(output, lambda file: file.write_text(text, encoding="utf-8"))
        print(f"{output}: written")


def _config_of(arguments: argparse.Namespace) -> RunConfig:
    """The configuration that reads the record: the one given, or that which the doctor finds."""
    from ratslam.runs.settings.packaged import packaged_configs
    from ratslam.runs.settings.run_config import RunConfig, load_config
    from ratslam.runs.settings.strict_yaml import dump_data, override, parse, validate
    from ratslam.service.recording_check import UNREADABLE, diagnose_recording
    from robot.sources.input_files import raise_errors

    record: Path = arguments.record
    named = not record.exists() and str(record) in packaged_configs()
    if named or record.suffix.lower() in (".yaml", ".yml"):
        return load_config(record, arguments.set)
    diagnosis = diagnose_recording(record)
    if not diagnosis.config:
        raise_errors([InputError("", fault) for fault in diagnosis.faults if fault != UNREADABLE])
        cure = f"`python -m ratslam doctor {record}` says what is missing"
        raise InputError(str(record), "no configuration reads it", "a recording", cure)
    text = dump_data(diagnosis.config)
    config = validate(override(parse(text, record.name), arguments.set), RunConfig)
    return config.with_absolute_paths(Path.cwd())
