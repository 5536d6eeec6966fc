"""Exports a run; the suffix of the new file chooses the format."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from evaluation.artifacts.grid_npz import read_grid
from evaluation.artifacts.nav2 import write_nav2
from evaluation.cells.analysis import (
    AnalysisSettings,
    CellScores,
    analyse_all_cells,
    analyse_cells,
    write_scores,
)
from evaluation.cells.recording import NAME, CellRecording, read_recording
from ratslam.classic.pose_cell_config import NetworkConfig, network_of
from ratslam.core.precision import prepare_precision
from ratslam.mapping.io import read_json
from ratslam.runs.settings.run_config import load_config
from ratslam.service.export.nwb import write_nwb
from ratslam.service.export.ros_bag import write_bag, write_mcap
from ratslam.service.export.ros_messages import RosMessages
from ratslam.service.export.run_export import ExportedRun, read_exported_run
from ratslam.service.rats.settled_peak import settled_peak
from ratslam.service.rats.spikes import SpikeConfig, SpikeTrains, draw_spikes, write_spikes
from robot.sources.input_files import digest_of
from tactile.base.errors import InputError
from tactile.base.new_file import make_new_file, new_folder, require_new_file

Warn = Callable[[str], None]
PARTED = "the map is in several pieces, whose poses cannot be compared"
FORMATS = (
    ".mcap, .tum, .g2o, .json, .graphml, .yaml, .nwb, .npz or .csv, "
    "or a folder without a suffix for a ROS 2 bag"
)


def export_run(
    directory: Path, output: Path, warn: Warn = lambda sentence: None, spikes: SpikeConfig | None = None
) -> None:
    """Writes the results of a run to a new file, whole or not at all.

    Args:
        directory: of the run. output: its suffix chooses the format; without one, the folder of a ROS 2 bag.
        warn: called with a sentence about parts that the file lacks. spikes: of the recorded cells in .nwb
            and .npz files; its peak rate is also that of the scores in a .csv file.

    Raises:
        InputError: the run lacks what the format holds, a file of it is malformed, the output exists or its
            folder does not, or the format is unknown.
    """
    suffix = output.suffix.lower()
    if suffix not in WRITERS and suffix not in CELL_WRITERS:
        raise InputError(str(output), f"an unknown suffix {output.suffix!r}", FORMATS)
    if not directory.is_dir():
        raise InputError(str(directory), "no such folder", "a run directory")
    require_new_file(output)
    if suffix in CELL_WRITERS:
        CELL_WRITERS[suffix](directory, output, spikes or SpikeConfig())
    else:
        WRITERS[suffix](directory, output, warn)


def _read_run(directory: Path, warn: Warn) -> ExportedRun:
    exported = read_exported_run(directory, warn)
    if exported.run.has_pieces:
        warn(f"{PARTED}; the file shows them beside each other, or each where it is true if that is known")
    return exported


def _write_mcap(directory: Path, output: Path, warn: Warn) -> None:
    ros = RosMessages()
    exported = _read_run(directory, warn)
    make_new_file(output, lambda path: write_mcap(path, exported, ros))


def _write_bag(directory: Path, output: Path, warn: Warn) -> None:
    ros = RosMessages()
    exported = _read_run(directory, warn)
    with new_folder(output) as folder:
        write_bag(folder, output.name, exported, ros)


def _write_tum(directory: Path, output: Path, warn: Warn) -> None:
    """The final trajectory, of an interrupted run the online one; of a map in several pieces also which of
    them each pose is in, beside it."""
    final, pieces = directory / "trajectory.tum", directory / "pieces.csv"
    if pieces.exists():
        beside = output.with_suffix(".pieces.csv")
        require_new_file(beside)
        warn(f"{PARTED}; {beside} says which of them each pose is in")
        make_new_file(beside, lambda path: shutil.copyfile(pieces, path))
    _copy(final if final.exists() else directory / "online.tum", output, "a trajectory")


def _write_g2o(directory: Path, output: Path, warn: Warn) -> None:
    _copy(directory / "map.g2o", output, "a pose graph")


def _write_json(directory: Path, output: Path, warn: Warn) -> None:
    _copy(directory / "map.json", output, "a map of experiences")


def _write_graphml(directory: Path, output: Path, warn: Warn) -> None:
    import networkx  # slow to import

    graph = read_json(_file(directory / "map.json", "a map of experiences"))
    make_new_file(output, lambda path: networkx.write_graphml_xml(graph, path))


def _write_nav2(directory: Path, output: Path, warn: Warn) -> None:
    """map_server's YAML file, and beside it the image of the same name."""
    grid = read_grid(_file(directory / "grid.npz", "an occupancy grid"))
    for suffix in (".pgm", ".yaml"):  # whatever the case of the one given
        require_new_file(output.with_suffix(suffix))
    write_nav2(output.parent, grid, output.stem)


def _write_nwb(directory: Path, output: Path, config: SpikeConfig) -> None:
    cells = read_run_cells(directory, config)
    make_new_file(output, lambda path: write_nwb(path, *cells))


def _write_spikes(directory: Path, output: Path, config: SpikeConfig) -> None:
    cells = read_run_cells(directory, config)
    make_new_file(output, lambda path: write_spikes(path, cells.spikes))


def _write_scores(directory: Path, output: Path, config: SpikeConfig) -> None:
    scores = score_run_cells(directory, config.peak_rate)
    make_new_file(output, lambda path: write_scores(path, scores))


WRITERS: dict[str, Callable[[Path, Path, Warn], None]] = {
    "": _write_bag,
    ".mcap": _write_mcap,
    ".tum": _write_tum,
    ".g2o": _write_g2o,
    ".json": _write_json,
    ".graphml": _write_graphml,
    ".yaml": _write_nav2,
}
CELL_WRITERS: dict[str, Callable[[Path, Path, SpikeConfig], None]] = {
    ".nwb": _write_nwb,
    ".npz": _write_spikes,
    ".csv": _write_scores,
}


def _copy(file: Path, output: Path, what: str) -> None:
    _file(file, what)
    make_new_file(output, lambda path: shutil.copyfile(file, path))


def _file(file: Path, what: str) -> Path:
    """The file of a run directory.

    Raises:
        InputError: there is none.
    """
    if not file.exists():
        cure = "`run --continue` ends an interrupted run; some methods have no such map"
        raise InputError(str(file), "no such file", f"a run with {what}", cure)
    return file


CURE = "add `cells: {chosen: 64}` to the configuration and run it again"


class RunCells(NamedTuple):
    """Recorded cells of a run, their spikes, and the sha256 (hex) of all that they were made from."""

    recording: CellRecording
    spikes: SpikeTrains
    digest: str


def read_run_cells(directory: Path, config: SpikeConfig) -> RunCells:
    """Reads the chosen cells of a run and draws their spikes. A cell fires at the peak rate at the peak of a
    settled packet of the run's network; that is computed in float64, also for a run in float32.

    Raises:
        InputError: the run has no recorded cells, no chosen ones among them, or a file is malformed.
    """
    recording, network = _read_cells(directory)
    file = directory / NAME
    if not len(recording.cell):
        raise InputError(str(file), "no chosen cells", "cells recorded at every step", CURE)
    spikes = draw_spikes(recording, settled_peak(network), config)
    documents = [network.model_dump_json().encode(), config.model_dump_json().encode()]
    return RunCells(recording, spikes, digest_of([file.read_bytes(), *documents]))


def score_run_cells(directory: Path, peak_rate: float) -> CellScores:
    """Scores of the chosen cells of a run; if only sums were recorded, of all cells.

    Args:
        peak_rate: of a cell at the peak of a settled packet of the run's network, Hz.

    Raises:
        InputError: the run has no recorded cells, no true pose is known, the path has no area, or a file is
            malformed.
    """
    recording, network = _read_cells(directory)
    settings = AnalysisSettings(gain=peak_rate / settled_peak(network))
    analyse = analyse_all_cells if not len(recording.cell) and recording.sums else analyse_cells
    return analyse(recording, settings)


def _read_cells(directory: Path) -> tuple[CellRecording, NetworkConfig]:
    """The recorded cells of a run and its network; sets JAX to float64."""
    file = directory / NAME
    if not file.exists():
        raise InputError(str(file), "no such file", "a run with recorded pose cells", CURE)
    recording = read_recording(file)
    prepare_precision("float64")
    config = load_config(directory / "config.yaml")
    return recording, network_of(config.pose_cells, config.attractor)
