"""Closure sequences along the poses of a map."""

from __future__ import annotations

import numpy as np

from ratslam.mapping.carried_solution import LONGEST, add_closures_along
from ratslam.mapping.ground import Ground
from ratslam.mapping.loop_closures import ClosureLog
from ratslam.mapping.pose_tracks import SelfTraverse

LAP, COUNT, GUARD = 24, 60, 5
"""Keyframes of a lap and of all, and those before a keyframe that it is not compared with."""


def laps(shift: int = 0) -> SelfTraverse:
    """Laps of a circle of 1 m in which the view of a keyframe fits at those of the same place alone; with a
    `shift` of 1 only at those of the same place that face the other way."""
    angle = 2 * np.pi * np.arange(COUNT) / LAP
    poses = np.column_stack([np.cos(angle), np.sin(angle), angle + np.pi / 2 + np.pi * shift * (angle > 6.2)])
    same = (np.arange(COUNT)[:, None] - np.arange(COUNT)) % LAP == 0
    fits = np.full((COUNT, 2, COUNT), -2.0, np.float32)
    fits[:, shift][same] = 3.0
    for frame in range(COUNT):
        fits[frame, :, max(frame - GUARD, 0) : frame + GUARD + 1] = -np.inf
    still = np.zeros((COUNT - 1, 3))
    on = Ground(poses, np.array([0.0, np.pi]), 0.1, 0.3, np.ones(3))
    return SelfTraverse(on, fits, still, still)


def added(session: SelfTraverse, cuts: tuple[int, ...] = (), max_gap: int = 3) -> list[np.ndarray]:
    """The members of the sequences that are added."""
    log = ClosureLog()
    add_closures_along(log, session, np.array(cuts, int), max_gap)
    return [log.members(sequence) for sequence in range(log.sequences)]


def test_every_keyframe_of_a_later_lap_is_tied_to_its_place():
    found = np.concatenate(added(laps()))
    assert found[:, 0].tolist() == list(range(LAP, COUNT))
    assert ((found[:, 0] - found[:, 1]) % LAP == 0).all()
    assert not found[:, 2].any()


def test_places_that_are_passed_the_other_way_are_turned():
    found = np.concatenate(added(laps(1)))
    assert found[0, :3].tolist() == [LAP, 0, 1]


def test_sequences_are_short_and_end_at_cuts():
    found = added(laps(), (30,))
    assert max(map(len, found)) == LONGEST
    assert [one[0, 0] for one in found] == [24, 30, 40, 50]


def test_a_gap_ends_a_sequence():
    one = laps()
    one.fits[30:36] = -2.0
    assert [members[0, 0] for members in added(one)] == [24, 36, 46, 56]
    assert [members[0, 0] for members in added(one, max_gap=7)] == [24, 40, 50]


def test_nothing_is_added_where_no_view_fits():
    one = laps()
    one.fits[:] = -2.0
    assert added(one) == []
