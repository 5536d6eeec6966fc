"""Stand-ins for the operations on saved maps that know the truth, or that are wrong on purpose."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from evaluation.papers.maps.operations import Localised, Methods
from evaluation.papers.maps.scenarios import Recorded
from evaluation.papers.maps.stored_maps import MapArrays, StoredMap
from robot.world.maze import CELL_SIDE
from tactile.base.se2 import between, compose

FOUND_AFTER = 10
"""Steps after which the stand-in is found."""


def true_pose(made: StoredMap, truth: np.ndarray) -> np.ndarray:
    """[T, 3] where true poses are in a map: moved with the nearest step."""
    steps = made.arrays.steps
    near = steps.nearest(truth, 0.09)
    return compose(steps.pose[near], between(steps.truth[near], truth))


class Oracle(Methods):
    """Knows the truth."""

    def localise(self, made: StoredMap, recorded: Recorded) -> Localised:
        """Found after `FOUND_AFTER` steps at the true pose if images are those of the place, else never."""
        known = "+" not in recorded.log.digest
        steps = np.arange(recorded.log.length)
        found = known & (steps >= FOUND_AFTER)
        return Localised(found, ~found & (steps > 100), true_pose(made, recorded.truth))

    def extend(self, made: StoredMap, recorded: Recorded) -> MapArrays:
        """Tied on at the true pose, unless the images are in random order."""
        return _joined(made, recorded.truth, true_pose(made, recorded.truth), "+" not in recorded.log.digest)

    def merge(self, maps: Sequence[StoredMap], path: Path) -> StoredMap:
        """The second map at its true place in the first, without a common keyframe more."""
        one, other = maps
        return _stored(path, _joined(one, other.arrays.truth, true_pose(one, other.arrays.truth), True))

    def changes(self, made: StoredMap, recorded: Recorded) -> np.ndarray:
        """Where the session is at its step 50, in the map; nowhere in an unchanged maze."""
        simulation = recorded.config.simulation
        assert simulation is not None
        return true_pose(made, recorded.truth[[50]])[:, :2] if simulation.maze.added else np.zeros((0, 2))


class Wrong(Oracle):
    """Sure and wrong, two cells off; joins everything."""

    def localise(self, made: StoredMap, recorded: Recorded) -> Localised:
        found = np.ones(recorded.log.length, bool)
        return Localised(found, ~found, true_pose(made, recorded.truth) + [2 * CELL_SIDE, 0, 0])

    def extend(self, made: StoredMap, recorded: Recorded) -> MapArrays:
        pose = true_pose(made, recorded.truth) + [2 * CELL_SIDE, 0, 0]
        return _joined(made, recorded.truth, pose, True)


class Apart(Oracle):
    """Joins nothing: two pieces."""

    def merge(self, maps: Sequence[StoredMap], path: Path) -> StoredMap:
        one, other = maps
        return _stored(path, _joined(one, other.arrays.truth, other.arrays.trajectory, False))


def _stored(path: Path, arrays: MapArrays) -> StoredMap:
    return StoredMap(path, arrays, np.arange(len(arrays.truth)))


def _joined(made: StoredMap, truth: np.ndarray, pose: np.ndarray, joined: bool) -> MapArrays:
    arrays = made.arrays
    later = np.full(len(truth), arrays.piece[0] if joined else arrays.piece.max() + 1)
    return MapArrays(
        np.concatenate([arrays.trajectory, pose]),
        np.concatenate([arrays.truth, truth]),
        np.concatenate([arrays.piece, later]),
        arrays.frames,
    )


ORACLE, WRONG, APART = Oracle(), Wrong(), Apart()


def cells_by_figure(lines: Iterable[str]) -> dict[str, tuple[str, str]]:
    """What was measured and the control, by the figure of a line of a Markdown table."""
    _, *rows = ([cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines)
    return {figure: (measured, control) for figure, _, measured, control in rows}
