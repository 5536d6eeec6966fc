"""The final map of a robot that may be carried: views at its own keyframes, tracks, retracing, closures."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping import carried_solution
from ratslam.mapping.appearance import SAME_ID_LOG_ODDS
from ratslam.mapping.carried_solution import LOST, SelfTraverse
from ratslam.mapping.ground import LEAVING, REACH, REACH_HEADING, GainOdds, Ground
from ratslam.mapping.loop_closures import ClosureLog, Verdict
from ratslam.mapping.map import KeyframeMap
from tactile.base.se2 import between, integrate
from tests.ratslam.mapping.map_cases import CELL, Seen, new_map, step
from tests.ratslam.mapping.map_cases import LAP as LAP_OF_MAP
from tests.ratslam.mapping.map_cases import drive as drive_map
from tests.ratslam.mapping.selection_cases import LAP, NOISE, SPREAD, STEP, lap_poses

COUNT, FIT = 3 * LAP, 3.0
"""The last: log-odds of a view at its place, and against it elsewhere."""
ODDS = GainOdds(np.array([0.0]), np.array([-2.0, 2.0]), 2.0)


def places(jump: int | None, ahead: int) -> np.ndarray:
    """[COUNT] the place of each keyframe along the lap; carried ahead before keyframe `jump`."""
    place = np.arange(COUNT)
    if jump is not None:
        place[jump:] += ahead
    return place % LAP


def laps(place: np.ndarray, shown: np.ndarray | None = None) -> SelfTraverse:
    """A map by odometry alone, which does not measure that the robot is carried; `shown` [COUNT]: the places
    whose views are seen, by default those of the robot."""
    steps = between(lap_poses(np.arange(COUNT - 1)), lap_poses(np.arange(1, COUNT)))
    motions, start, time = steps[place[:-1]], lap_poses(place[:1]), np.arange(COUNT)
    poses = np.vstack([start, integrate(motions, start[0])])
    apart = np.abs(((place if shown is None else shown)[:, None] - place + LAP // 2) % LAP - LAP // 2)
    fits = np.where(apart <= 1, FIT, -FIT).astype(np.float32)
    fits[np.abs(time[:, None] - time) <= LAP // 2] = -np.inf
    ground = Ground(poses, np.zeros(1), REACH * STEP / 0.6, REACH_HEADING, SPREAD**2)
    return SelfTraverse(ground, fits[:, None], motions, np.tile((0.2 * NOISE) ** 2, (COUNT - 1, 1)))


SESSION = laps(places(None, 0))
"""Nobody was carried; read only."""


def test_every_view_is_compared_with_all_but_those_of_nearly_the_same_time():
    graph = drive_map(new_map(), {}, last=LAP_OF_MAP).state.unmerged
    fits, time = carried_solution.view_fits(graph), np.arange(LAP_OF_MAP)
    assert fits.shape == (LAP_OF_MAP, 1, LAP_OF_MAP)
    near = np.abs(time[:, None] - time) <= graph.guard
    assert np.array_equal(np.isneginf(fits[:, 0]), near)
    assert (fits[:, 0][~near] == -SAME_ID_LOG_ODDS).all()  # every id is seen once


@pytest.mark.parametrize("told", [FIT, 0.0])
def test_odds_are_as_large_as_the_views_tell(told):
    fits = np.where(np.isfinite(SESSION.fits), np.sign(SESSION.fits) * told, -np.inf)
    odds = carried_solution.learn_odds(SESSION._replace(fits=fits.astype(np.float32)))
    assert (odds.of(told) - odds.of(-told) > 2) == (told > 0)
    assert (np.diff(odds.odds) >= 0).all()
    assert (odds.expected > 0.5) == (told > 0)


frames = st.integers(0, COUNT - 1)


@given(frames, st.integers(0, 60))
def test_a_true_pose_is_followed_both_ways_as_long_as_the_views_do_not_contradict_it(frame, extent):
    poses, odds = SESSION.track_from(frame, SESSION.poses[frame], extent, ODDS)
    led = np.abs(np.arange(COUNT) - frame) <= extent
    assert np.hypot(*(poses - SESSION.poses)[led, :2].T).max() < SESSION.ground.reach
    assert (odds[led] == ODDS.odds[1]).all()
    assert np.isnan(poses[~led]).all()
    assert np.isneginf(odds[~led]).all()
    np.testing.assert_array_equal(poses[frame], SESSION.poses[frame])
    against = SESSION._replace(fits=-np.abs(SESSION.fits))
    led = np.flatnonzero(np.isfinite(against.track_from(frame, SESSION.poses[frame], COUNT, ODDS)[1]))
    length = int(-LOST // 2) + 1  # each view has log-odds of -2
    assert (led[0], led[-1]) == (max(frame - length, 0), min(frame + length, COUNT - 1))
    # Views of a stretch fit best where they were taken.
    found = SESSION.places()
    best = found[np.argmax(SESSION.scan(frame, found, 8))]
    assert np.hypot(*(best - SESSION.poses[frame])[:2]) < 1.5 * SESSION.ground.reach


def test_every_keyframe_has_a_place_and_own_fits_are_those_of_the_poses():
    found = SESSION.places()
    distance = np.hypot(*(found[:, None] - SESSION.poses)[..., :2].transpose(2, 0, 1))
    assert distance.min(axis=0).max() < SESSION.ground.reach  # every keyframe has a place
    assert len(found) <= LAP
    assert (SESSION.own_fits() == FIT).all()
    away = laps(places(None, 0))
    away.poses[40:50, 0] += 10.0
    assert np.isnan(away.own_fits()[40:50]).all()
    assert away.own_odds(ODDS)[40:50].tolist() == [LEAVING, *[0.0] * 9]


jumps = st.integers(2 * LAP + 5, 2 * LAP + 35), st.integers(LAP // 4, 3 * LAP // 4)
NONE = np.zeros(0, int)


def retraced(session, cuts=NONE):
    return carried_solution.retrace(session, ODDS, cuts, ClosureLog(), np.pi)


@settings(max_examples=12)
@given(*jumps, st.integers(LAP, COUNT - 10), st.integers(1, 5))
def test_a_carried_robot_is_found_again_and_one_that_was_not_stays_where_it_is(jump, ahead, first, length):
    place = places(jump, ahead)
    found = retraced(laps(place))
    assert len(found[2]) == 1
    assert abs(found[2][0] - jump) <= 2
    off = np.hypot(*(found[0] - lap_poses(place))[:, :2].T)
    assert off[np.abs(np.arange(COUNT) - jump) > 2].max() < 0.06
    # A few views of another place do not pay for two jumps.
    place, time = places(None, 0), np.arange(COUNT)
    found = retraced(laps(place, place + ahead * ((time >= first) & (time < first + length))))
    assert not len(found[2])
    assert np.hypot(*(found[0] - SESSION.poses)[:, :2].T).max() < SESSION.ground.reach


def test_a_wrong_cut_is_taken_back():
    found = retraced(SESSION, np.array([LAP + 20]))
    assert not len(found[2])
    assert found[1] == ODDS.odds[1] * COUNT
    carried = laps(places(2 * LAP + 20, LAP // 2))
    assert retraced(carried)[1] > ODDS.odds[1] * COUNT - carried_solution.JUMP - 6 * np.ptp(ODDS.odds)


CIRCLE, LENGTH, GUARD = 24, 60, 5
"""Keyframes of a lap and of all, and those before a keyframe that it is not compared with."""


def circles(shift: int = 0) -> SelfTraverse:
    """Laps of a circle of 1 m in which the view of a keyframe fits at those of the same place alone; with a
    `shift` of 1 only at those of the same place that face the other way."""
    angle = 2 * np.pi * np.arange(LENGTH) / CIRCLE
    poses = np.column_stack([np.cos(angle), np.sin(angle), angle + np.pi / 2 + np.pi * shift * (angle > 6.2)])
    apart = np.arange(LENGTH)[:, None] - np.arange(LENGTH)
    fits = np.full((LENGTH, 2, LENGTH), -2.0, np.float32)
    fits[:, shift][apart % CIRCLE == 0] = 3.0
    fits = np.where(np.abs(apart)[:, None] <= GUARD, np.float32(-np.inf), fits)
    still, on = np.zeros((LENGTH - 1, 3)), Ground(poses, np.array([0.0, np.pi]), 0.1, 0.3, np.ones(3))
    return SelfTraverse(on, fits, still, still)


def added(session: SelfTraverse, cuts: tuple[int, ...] = (), max_gap: int = 3) -> list[np.ndarray]:
    """The members of the sequences that are added."""
    log = ClosureLog()
    carried_solution.add_closures_along(log, session, np.array(cuts, int), max_gap)
    return [log.members(sequence) for sequence in range(log.sequences)]


@pytest.mark.parametrize("shift", [0, 1])
def test_every_keyframe_of_a_later_lap_is_tied_to_its_place(shift):
    """Turned, where it is passed the other way."""
    found = np.concatenate(added(circles(shift)))
    assert shift or found[:, 0].tolist() == list(range(CIRCLE, LENGTH))
    assert found[0, :3].tolist() == [CIRCLE, 0, shift]
    assert ((found[:, 0] - found[:, 1]) % CIRCLE == 0).all()
    assert shift or not found[:, 2].any()


def test_sequences_are_short_and_end_at_cuts_and_gaps():
    found, one = added(circles(), (30,)), circles()
    assert max(map(len, found)) == carried_solution.LONGEST
    assert [members[0, 0] for members in found] == [24, 30, 40, 50]
    one.fits[30:36] = -2.0
    assert [members[0, 0] for members in added(one)] == [24, 36, 46, 56]
    assert [members[0, 0] for members in added(one, max_gap=7)] == [24, 40, 50]
    one.fits[:] = -2.0
    assert added(one) == []  # where no view fits


AHEAD, CARRIED_AT, STEPS, SCALE = 25, 150, 180, CELL / 0.05
"""The last: the laps of `selection_cases` are for cells of 0.05 m."""


def driven_places(jump: int | None) -> np.ndarray:
    return np.arange(STEPS) + (0 if jump is None else AHEAD * (np.arange(STEPS) >= jump))


@cache
def driven(jump: int | None = CARRIED_AT, **settings) -> KeyframeMap:
    """Three laps, in the last of which the robot is carried ahead; recall knows every place of the second lap
    again, and then only the last few, so that what it sees does not pay for a cut."""
    map = new_map(**{"may_be_carried": True, "select_every": 1000, "select_score": 5.0} | settings)
    motion = between(lap_poses(np.arange(LAP)), lap_poses(np.arange(1, LAP + 1))) * [SCALE, SCALE, 1.0]
    for k, at in enumerate(driven_places(jump).tolist()):
        ratio = 3.0 if LAP + 5 <= k < 2 * LAP else 1.7 if k >= STEPS - 8 else 0.0
        match = at % LAP if ratio else -1
        seen = Seen(k, match, 0, float(match >= 0), ratio)
        step(map, motion[(at - 1) % LAP] if k else np.zeros(3), seen, at % LAP)
    return map


def off(map: KeyframeMap, jump: int | None) -> np.ndarray:
    """[STEPS] distance from the truth, cells."""
    truth = between(lap_poses(np.array([0]))[0], lap_poses(driven_places(jump))) * [SCALE, SCALE, 1.0]
    return np.hypot(*(map.solution().pose.rows - truth)[:, :2].T) / CELL


def test_the_odometry_is_cut_where_the_robot_was_carried_and_that_part_tied_to_the_map_all_along():
    """Also where recall proposes nothing; the map that the session continues from is as recall left it."""
    map = driven()
    before = map.state.log.sequences
    cuts = np.flatnonzero(map.solution().cut.rows >= 0)
    assert len(cuts) == 1
    assert abs(cuts[0] - CARRIED_AT) <= 1
    assert off(map, CARRIED_AT).max() < 1.5
    assert not map.pieces().any()
    solution = map.solution()
    assert np.isin(np.arange(CARRIED_AT + 1, STEPS), solution.log.accepted_pairs()[:, 0]).all()
    assert not np.isin(np.arange(CARRIED_AT + 1, STEPS - 8), map.state.log.accepted_pairs()[:, 0]).any()
    assert (solution.log.verdicts()[before:] == Verdict.ACCEPTED)[solution.log.left()[before:] > 0].all()
    assert map.state.log.sequences == before
    with pytest.raises(ValueError, match="is not an accepted closure sequence"):
        map.undo(before)  # would come again


def test_nothing_is_cut_without_a_jump_nor_of_a_robot_that_may_not_be_carried():
    stays, fixed = driven(None), driven(may_be_carried=False)
    for map in (stays, fixed):
        assert (map.solution().cut.rows < 0).all()
    assert off(stays, None).max() < 1.0
    assert [carried_solution.is_retraced(map.state.unmerged) for map in (driven(), fixed)] == [True, False]
