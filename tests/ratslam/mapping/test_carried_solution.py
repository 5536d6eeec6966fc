"""The final map of a robot that may be carried, driven by hand with ids of the places."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.mapping.carried_solution import is_retraced
from ratslam.mapping.loop_closures import Verdict
from ratslam.mapping.map import KeyframeMap
from tactile.base.se2 import between
from tactile.base.types import Odometry, observation
from tests.ratslam.mapping.map_cases import CELL, Pose, Seen, new_map
from tests.ratslam.mapping.selection_cases import LAP, lap_poses

AHEAD, JUMP, COUNT = 25, 150, 180
SCALE = CELL / 0.05
"""The laps of `selection_cases` are for cells of 0.05 m."""


def driven(jump: int | None = JUMP, **settings) -> KeyframeMap:
    """Three laps, in the last of which the robot is carried ahead; recall knows every place of the second lap
    again, and then only the last few, so that what it sees does not pay for a cut."""
    map = new_map(**{"may_be_carried": True, "select_every": 1000, "select_score": 5.0} | settings)
    place = np.arange(COUNT)
    if jump is not None:
        place[jump:] += AHEAD
    step = between(lap_poses(np.arange(LAP)), lap_poses(np.arange(1, LAP + 1)))
    for k, at in enumerate(place.tolist()):
        x, y, turn = (step[(at - 1) % LAP] * [SCALE, SCALE, 1.0]).tolist() if k else (0.0, 0.0, 0.0)
        ratio = 3.0 if LAP + 5 <= k < 2 * LAP else 1.7 if k >= COUNT - 8 else 0.0
        match = at % LAP if ratio else -1
        seen = Seen(k, match, 0, float(match >= 0), ratio)
        view = observation(Odometry(x, y, turn, 0.1), None, view_shape=(1, 1, 1), label=at % LAP)
        map.update(view, Pose(-1, -1, 0), seen)
    return map


def off(map: KeyframeMap, jump: int | None) -> np.ndarray:
    """[COUNT] distance from the truth, cells."""
    place = np.arange(COUNT)
    if jump is not None:
        place[jump:] += AHEAD
    truth = between(lap_poses(np.array([0]))[0], lap_poses(place)) * [SCALE, SCALE, 1.0]
    return np.hypot(*(map.solution().fit.poses - truth)[:, :2].T) / CELL


def test_the_odometry_is_cut_where_the_robot_was_carried():
    map = driven()
    cuts = np.flatnonzero(map.solution().cut.rows >= 0)
    assert len(cuts) == 1
    assert abs(cuts[0] - JUMP) <= 1
    assert off(map, JUMP).max() < 1.5
    assert not map.pieces().any()


def test_the_carried_part_is_tied_to_the_map_all_along():
    """Also where recall proposes nothing; the map that the session continues from is as recall left it."""
    map = driven()
    before = map.log.sequences
    solution = map.solution()
    tied = solution.log.accepted_pairs()
    assert np.isin(np.arange(JUMP + 1, COUNT), tied[:, 0]).all()
    assert not np.isin(np.arange(JUMP + 1, COUNT - 8), map.log.accepted_pairs()[:, 0]).any()
    assert (solution.log.verdicts()[before:] == Verdict.ACCEPTED)[solution.log.left()[before:] > 0].all()
    assert map.log.sequences == before
    with pytest.raises(ValueError, match="is not an accepted closure sequence"):
        map.undo(before)  # would come again


def test_nothing_is_cut_without_a_jump():
    map = driven(None)
    assert (map.solution().cut.rows < 0).all()
    assert off(map, None).max() < 1.0


def test_a_robot_that_may_not_be_carried_is_not_retraced():
    assert is_retraced(driven().keyframes())
    map = driven(may_be_carried=False)
    assert not is_retraced(map.keyframes())
    assert (map.solution().cut.rows < 0).all()
