"""Maps of sessions on the disk, each made once: rows that need the same map share it.

A map is that of a recipe, which holds all settings, and of the code that made it: other code makes its own.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.run_metrics import energy_within_pieces
from evaluation.metrics.trajectory import ate
from evaluation.papers.maps.localisation_metrics import MapSteps
from evaluation.papers.maps.scenarios import Recipe, Recorded, record
from evaluation.papers.trial_sessions import start_session
from evaluation.studies.machine import code_digest
from ratslam.core.session import Session
from ratslam.mapping.map import KeyframeMap
from ratslam.methods.map_file import NAME
from ratslam.runs.saved_map import describe_readings, write_map
from robot.touch_source import observation_of
from tactile.base.files import hidden_folder

STEPS = "steps.npz"
"""File beside a map that holds its `MapArrays`."""


class MapArrays(NamedTuple):
    """What is measured of a map of T steps.

    Attributes:
        trajectory: [T, 3] final poses. truth: [T, 3] true ones, NaN where unknown. piece: [T] the piece of
            each step. frames: number of keyframes that the map keeps.
    """

    trajectory: np.ndarray
    truth: np.ndarray
    piece: np.ndarray
    frames: int

    @property
    def steps(self) -> MapSteps:
        """The steps with a true pose."""
        return MapSteps.known(self.trajectory, self.truth)

    @property
    def em(self) -> float:
        """Energy Metric over all pairs of steps with a true pose, m^2 + rad^2."""
        return energy_all_pairs(*self.steps).total

    @property
    def em_within_pieces(self) -> float:
        """The same over the pairs of steps in one piece."""
        known = np.isfinite(self.truth).all(axis=1)
        return energy_within_pieces(*self.steps, self.piece[known]).total

    @property
    def ate(self) -> float:
        """RMS position error after alignment, m."""
        return ate(*self.steps)

    @classmethod
    def of_session(cls, session: Session, truth: np.ndarray) -> Self:
        """Those of the map of a finished session over steps with these true poses [T, 3]."""
        made = session.map
        assert isinstance(made, KeyframeMap)
        return cls(made.map_trajectory(), truth, made.pieces(), made.state.count)


class StoredMap(NamedTuple):
    """A map on the disk.

    Attributes:
        path: the folder of its map file. arrays: what is measured of it. order: [T] the step of the map that
            each step of `arrays` is.
    """

    path: Path
    arrays: MapArrays
    order: np.ndarray

    @staticmethod
    def place(recipe: Recipe, folder: Path) -> Path:
        """Where in `folder` the map of a session by this code is."""
        return folder / f"{recipe.digest[:16]}-{code_digest()}"


def store_map(recipe: Recipe, folder: Path) -> StoredMap:
    """The map of a session; made and written to `folder` unless it is there, by the same code.

    Raises:
        InputError: the session cannot be recorded.
    """
    path = StoredMap.place(recipe, folder)
    if not path.exists():
        _write_map(record(recipe), path)
    with np.load(path / STEPS) as saved:
        arrays = MapArrays(saved["trajectory"], saved["truth"], saved["piece"], int(saved["frames"]))
    return StoredMap(path, arrays, np.arange(len(arrays.truth)))


def _write_map(recorded: Recorded, path: Path) -> None:
    """Maps a session into a new folder, which appears complete."""
    config, log = recorded
    path.parent.mkdir(parents=True, exist_ok=True)
    with hidden_folder(path, path.parent, ".unfinished-") as folder:
        session = start_session(config, log)
        for _ in session.replay(observation_of(sample) for sample in log):
            pass
        write_map(folder / NAME, session, config, describe_readings(log), recording=log.digest)
        np.savez(folder / STEPS, **MapArrays.of_session(session, recorded.truth)._asdict())
        try:
            folder.rename(path)
        except OSError:
            if not path.exists():  # else another process was faster
                raise
