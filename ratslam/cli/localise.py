"""The command localise."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ratslam.cli.common import INTERRUPTED, Commands, add_set, prepare_jax
from ratslam.cli.run import add_rerun, open_target
from tactile.base.errors import tell

if TYPE_CHECKING:
    from ratslam.runs.saved_map import SavedMap
    from ratslam.runs.settings.run_config import RunConfig

CONFIGURATIONS = (".yaml", ".yml", "")
"""Suffixes of a configuration or its name; other files, and folders, are recordings."""


def add_commands(commands: Commands) -> None:
    """Registers the command."""
    localise = commands.add(
        "localise", _localise, "find a recording's poses in a saved map",
        "localise runs/whisker_maze another_day.yaml -o runs/found", "maps",
    )  # fmt: skip
    localise.add_argument("map", type=Path, metavar="MAP", help="a run directory or its map.npz")
    localise.add_argument(
        "recording", type=Path, metavar="RECORDING",
        help="configuration with the recording or simulation to localise, or a recording of the map's sensor "
        "(the method and its settings are those of the map)",
    )  # fmt: skip
    add_set(localise)
    localise.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="new run directory (default runs/RECORDING_in_MAP)"
    )
    add_rerun(localise)


def _localise(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from evaluation.report.summary import summarise
    from ratslam.runs.localise import localise
    from ratslam.runs.saved_map import read_map
    from ratslam.service.viewer.observer import open_viewer

    target, saved = open_target(arguments), read_map(arguments.map, tell)
    config = _read_recording(arguments, saved)
    place = arguments.map.name.removesuffix(".npz") or "map"
    directory = arguments.output or Path("runs") / f"{arguments.recording.stem}_in_{place}"
    with open_viewer(target) as observers:
        card, summary, interrupted = localise(saved, config, directory, observers)
    print(summary.describe())
    print(f"{directory}/localisation.csv holds the state and the probability of every step,")
    print(f"{directory}/trajectory.tum the poses, in the frame of the map where it was found")
    print(summarise(directory, card, f"localising in {arguments.map}"))
    return INTERRUPTED if interrupted else 0


def _read_recording(arguments: argparse.Namespace, saved: SavedMap) -> RunConfig:
    from ratslam.runs.localise import check_assignments, recorded_alike
    from ratslam.runs.settings.run_config import load_config

    file: Path = arguments.recording
    if file.suffix in CONFIGURATIONS and not file.is_dir():
        config = load_config(file, arguments.set)
    else:
        config = recorded_alike(file, saved, arguments.set)
    check_assignments(arguments.set, saved)
    return config
