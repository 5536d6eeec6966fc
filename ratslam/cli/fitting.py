"""The command fit."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ratslam.cli.common import Commands, add_set, prepare_jax
from tactile.base.errors import InputError
from tactile.base.new_file import make_new_file

if TYPE_CHECKING:
    from ratslam.runs.settings.run_config import RunConfig


def add_commands(commands: Commands) -> None:
    """Registers the commands of this module."""
    fit = commands.add(
        "fit", _fit, "measure wheels, whiskers and head from a record", "fit create_lab -o rig.yaml", "look"
    )
    fit.add_argument(
        "record", type=Path, metavar="RECORD",
        help="recording, or the configuration (YAML, or name of a packaged one) that reads it",
    )  # fmt: skip
    fit.add_argument(
        "-o", "--output", type=Path, metavar="YAML",
        help="write the settings to a new file, for `include: [FILE]` in a configuration",
    )  # fmt: skip
    fit.add_argument("--seed", type=int, default=0, metavar="S", help="seed of the bootstrap (default 0)")
    add_set(fit)


def _fit(arguments: argparse.Namespace) -> int:
    if arguments.seed < 0:
        raise InputError("--seed", str(arguments.seed), "a non-negative integer")
    prepare_jax()
    from ratslam.service.fit.record import fit_record
    from ratslam.service.fit.rig_fit import render_rig, rig_file

    rig = fit_record(_config_of(arguments), arguments.seed)
    print(render_rig(rig))
    if not rig.quantities and not rig.settings:
        raise InputError(str(arguments.record), "nothing that tells of the rig", "true poses or whiskers")
    output: Path | None = arguments.output
    if output is not None:
        text = rig_file(rig, str(arguments.record))
        make_new_file(output, lambda file: file.write_text(text, encoding="utf-8"))
        print(f"{output}: written")
    return 0


def _config_of(arguments: argparse.Namespace) -> RunConfig:
    """The configuration that reads the record: the one given, or that which the doctor finds."""
    from ratslam.runs.settings.packaged import packaged_configs
    from ratslam.runs.settings.run_config import RunConfig, load_config
    from ratslam.runs.settings.strict_yaml import dump_data, override, parse, validate
    from ratslam.service.doctor.recording_check import UNREADABLE, diagnose_recording
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
