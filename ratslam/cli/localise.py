"""The command localise."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ratslam.cli.common import INTERRUPTED, Commands, add_set, prepare_jax
from ratslam.cli.run import add_rerun, open_target

if TYPE_CHECKING:
    from ratslam.config.run_config import RunConfig

CONFIGURATIONS = (".yaml", ".yml", "")
"""Suffixes of a configuration; other files are recordings."""


def add_commands(commands: Commands) -> None:
    """Registers the command."""
    localise = commands.add(
        "localise", _localise, "find a recording's poses in a saved map",
        "localise runs/whisker_maze another_day.yaml -o runs/found", "maps",
    )  # fmt: skip
    localise.add_argument("map", type=Path, metavar="MAP", help="a run directory or its map.npz")
    localise.add_argument(
        "recording", type=Path, metavar="RECORDING",
        help="configuration with the recording or simulation to localise, or a recording of the map's sensor",
    )  # fmt: skip
    add_set(localise)
    localise.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="new run directory (default runs/RECORDING_in_MAP)"
    )
    add_rerun(localise)


def _localise(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from evaluation.metrics.scorecard import render_scorecard
    from ratslam.pipeline.localise import localise
    from ratslam.viewer.observer import open_viewer

    config, target = _read_recording(arguments), open_target(arguments)
    place = arguments.map.name.removesuffix(".npz") or "map"
    directory = arguments.output or Path("runs") / f"{arguments.recording.stem}_in_{place}"
    with open_viewer(target) as observers:
        card, summary, interrupted = localise(arguments.map, config, directory, observers)
    print(render_scorecard(card))
    print(f"\n{summary.describe()}")
    print(f"{directory}/localisation.csv holds the state and the probability of every step,")
    print(f"{directory}/trajectory.tum the poses in the frame of the map")
    return INTERRUPTED if interrupted else 0


def _read_recording(arguments: argparse.Namespace) -> RunConfig:
    from ratslam.config.run_config import RunConfig, load_config

    if arguments.recording.suffix in CONFIGURATIONS:
        return load_config(arguments.recording, arguments.set)
    return RunConfig.model_validate({"recording": {"file": str(arguments.recording.resolve())}})
