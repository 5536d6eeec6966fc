"""Checks of a method's map."""

from __future__ import annotations

import tempfile
from pathlib import Path

import networkx
import numpy as np

from ratslam.checks.backend_trial import STEPS, BackendTrial
from ratslam.checks.common import Check, require
from ratslam.core.backend import Map


def _maps(trial: BackendTrial) -> tuple[tuple[int, Map], ...]:
    """An empty map and that of the walk, each with its number of steps."""
    return (0, trial.backend.new_map()), (STEPS, trial.map)


def _trajectories(trial: BackendTrial) -> str:
    for count, made in _maps(trial):
        for name in ("trajectory", "map_trajectory", "online_trajectory"):
            poses = np.asarray(getattr(made, name)())
            found = f"{name} {poses.shape} after {count} steps"
            require(poses.shape == (count, 3), found, f"({count}, 3)")
            require(bool(np.isfinite(poses).all()), f"{name} with NaN or infinity", "finite poses")
    return ""


def _closures(trial: BackendTrial) -> str:
    for count, made in _maps(trial):
        pairs = np.asarray(made.closures())
        sound = pairs.ndim == 2 and pairs.shape[1] == 2 and pairs.dtype.kind in "iu"
        require(sound, f"closures {pairs.dtype} {pairs.shape} after {count} steps", "integers (M, 2)")
        later, earlier = pairs.T
        ordered = bool(((earlier >= 0) & (earlier < later) & (later < count)).all())
        require(ordered, f"closures {pairs[:3].tolist()} of {count} steps", "later and earlier step of each")
    return f"{len(pairs)} closures"


def _pieces(trial: BackendTrial) -> str:
    for count, made in _maps(trial):
        pieces = np.asarray(made.pieces())
        sound = pieces.shape == (count,) and pieces.dtype.kind in "iu"
        require(sound, f"pieces {pieces.dtype} {pieces.shape} after {count} steps", f"integers ({count},)")
    numbers = sorted(set(pieces.tolist()))
    require(pieces[0] == 0 and numbers == list(range(len(numbers))), f"pieces {numbers}", "numbers from 0")
    return ""


def _doubts(trial: BackendTrial) -> str:
    made = trial.map
    for name in ("doubt", "final_doubt"):
        value = float(getattr(made, name)())
        require(np.isnan(value) or 0 <= value <= 1, f"{name} {value}", "a probability, or NaN")
    return ""


def _files(trial: BackendTrial) -> str:
    made = trial.map
    graph = made.graph()
    found = f"graph of type {type(graph).__name__}"
    require(isinstance(graph, networkx.DiGraph), found, "networkx.DiGraph")
    with tempfile.TemporaryDirectory() as folder:
        for name, write in made.files().items():
            require(Path(name).name == name, f"file {name!r}", "a name without a folder")
            write(Path(folder) / name)
            there = [path.name for path in Path(folder).iterdir()]
            require(name in there, f"{name!r} not written", "the file at the path given")
    return ", ".join(made.files())


def _arrays(trial: BackendTrial) -> str:
    arrays = trial.map.arrays()
    require(isinstance(arrays, dict), f"arrays of type {type(arrays).__name__}", "a dict by name")
    for name, array in arrays.items():
        sound = isinstance(name, str) and isinstance(array, np.ndarray) and array.dtype != object
        found = f"{name!r}: {getattr(array, 'dtype', type(array).__name__)}"
        require(sound, found, "NumPy arrays of numbers by name")
    return ""


MAP_CHECKS = (
    Check("trajectories are [T, 3] and finite", "trajectory.tum is written from them", _trajectories),
    Check("closures are pairs of steps", "they are counted, drawn and scored", _closures),
    Check("every step is in a piece", "plots and scores treat pieces separately", _pieces),
    Check("doubt is a probability", "a doubted map is replaced by odometry", _doubts),
    Check("the map's files and graph can be written", "a run ends with writing them", _files),
    Check("the map's arrays are named NumPy arrays", "checkpoints are npz files without pickles", _arrays),
)
