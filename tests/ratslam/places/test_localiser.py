"""A session is found in a finished map, lost where it is carried away, and not found elsewhere."""

import csv
from collections import namedtuple
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings

from ratslam.core.estimates import Action, Estimate
from ratslam.mapping.acceptance import AcceptByOdds
from ratslam.mapping.appearance import LabelAppearance
from ratslam.mapping.config import KeyframeMapConfig
from ratslam.mapping.ground import Ground
from ratslam.mapping.map import KeyframeMap
from ratslam.mapping.odometry_calibration import HeadingNoise
from ratslam.places.localiser import Localisation, Localiser, Place
from tactile.base.se2 import between, integrate
from tactile.base.types import Observation, Odometry, observation
from tests.ratslam.places import alignment_cases as cases

LOOP, ODDS = cases.Loop(), cases.odds_of()
COUNT, NEEDED = 60, 15.0
FOUND, LOST, SEARCHING = Localisation.FOUND, Localisation.LOST, Localisation.SEARCHING
BLANK = Estimate(np.zeros(3), np.zeros(3), np.int32(-1), np.int32(-1), np.int32(Action.NONE), np.bool_(True))
Evidence = namedtuple("Evidence", "keyframe match shift_row posterior shows gain")
"""That of the localise backend, as far as its map reads it."""
Drive = namedtuple("Drive", "observations evidence truth")
"""A session: observations and evidence [n], true poses [n, 3] in the map."""
NOTHING = Evidence(-1, -1, 0, 0.0, False, np.zeros((1, len(LOOP.poses)), np.float32))


def step(odometry: np.ndarray) -> Observation:
    return observation(Odometry(*(float(value) for value in odometry), 0.1), view_shape=(1, 1, 1))


def drive(seed: int = 0, begin: int = 5, count: int = COUNT, views: Sequence[int] | None = None) -> Drive:
    """A session on the loop, of which every step is a keyframe; `views`: numbers of the views it has."""
    truth = LOOP.drive(begin, count, seed)
    steps = np.concatenate([np.zeros((1, 3)), between(truth[:-1], truth[1:])])
    steps += np.random.default_rng([seed, 3]).normal(0, [0.003, 0.003, 0.02], (count, 3))
    gains = LOOP.gains(truth, seed)
    evidence = []
    for k, number in enumerate(range(count) if views is None else views):
        nearest = int(np.hypot(*(LOOP.poses - truth[number])[:, :2].T).argmin())
        evidence.append(Evidence(k, nearest, 0, 0.9, True, gains[number]))
    return Drive([step(odometry) for odometry in steps], evidence, truth)


def new_localiser(ground: Ground = LOOP.ground, noise: float = 1.0, start=None) -> Localiser:
    """Without a pose; `noise`: factor that the map has learned of the noise of headings."""
    map = KeyframeMap(KeyframeMapConfig(), 0.05, LabelAppearance(), AcceptByOdds, guard=20)
    map.state.heading_noise = HeadingNoise(float(np.log(noise)))
    return Localiser(Place(map, np.arange(len(ground.poses)), ground, ODDS), NEEDED, start)


def follow(localiser: Localiser, driven: Drive, rows: slice = slice(None)) -> list[Estimate]:
    pairs = zip(driven.observations[rows], driven.evidence[rows], strict=True)
    return [localiser.update(seen, BLANK, evidence) for seen, evidence in pairs]


def errors(localiser: Localiser, driven: Drive) -> np.ndarray:
    """[n] errors of position, m."""
    return np.hypot(*(localiser.trajectory() - driven.truth)[:, :2].T)


@settings(max_examples=6)
@given(cases.SEEDS)
def test_a_session_on_the_map_is_found_where_it_is_and_never_with_shuffled_views(seed: int) -> None:
    localiser, driven = new_localiser(), drive(seed)
    estimates = follow(localiser, driven)
    states = localiser.states()
    first = int(np.argmax(states == FOUND))
    assert 3 < first < 30  # not before much was seen
    assert (states[:first] == SEARCHING).all()
    assert (states[first:] == FOUND).all()
    assert (errors(localiser, driven)[first:] < cases.REACH).all()
    now = localiser.localisation()
    assert now.mass > 0.99
    assert now.log_odds > NEEDED
    assert np.linalg.eigvalsh(now.covariance).min() > 0
    assert [bool(estimate.lost) for estimate in estimates] == (states != FOUND).tolist()
    np.testing.assert_array_equal(estimates[-1].pose, now.pose)
    assert localiser.pieces().tolist() == [int(state == FOUND) for state in states]
    shuffled, order = new_localiser(), np.random.default_rng(seed).permutation(COUNT).tolist()
    follow(shuffled, drive(seed, views=order))
    assert FOUND not in shuffled.states()


def test_another_world_is_never_found_and_named_so_and_a_map_that_has_changed_is_refused() -> None:
    """Views that fit single keyframes by chance, as recall reports them."""
    driven, stream, localiser = drive(count=150), np.random.default_rng(0), new_localiser()
    for k, evidence in enumerate(driven.evidence):
        gain = stream.normal(-0.5, 1.0, evidence.gain.shape).astype(np.float32)
        match = int(stream.integers(len(LOOP.poses))) if k % 3 else -1
        driven.evidence[k] = evidence._replace(gain=gain, match=match)
    follow(localiser, driven)
    assert FOUND not in localiser.states()
    assert localiser.states()[-1] == Localisation.NOT_THIS_MAP
    assert localiser.localisation().mass < 0.01
    follow(localiser, drive())
    assert localiser.states()[-1] == FOUND  # it may come to mapped ground yet
    changed = new_localiser(cases.ground_at(LOOP.poses + [0.0, 0.01, 0.0]))
    with pytest.raises(ValueError, match="in another map, or in this one before it was changed"):
        changed.restore(localiser.arrays())


def test_a_carried_robot_is_lost_claims_nothing_and_is_found_where_it_is(tmp_path: Path) -> None:
    localiser, after = carried(), drive(seed=1, begin=45)
    for k in range(COUNT):
        follow(localiser, after, slice(k, k + 1))
        now = localiser.localisation()
        assert now.state == FOUND or now.mass < 0.9 or now.log_odds < NEEDED
    states, pieces = localiser.states(), localiser.pieces()
    assert (states[COUNT - 10 : COUNT] == FOUND).all()
    assert states[1:][np.diff(states) != 0].tolist() == [FOUND, LOST, FOUND]
    assert np.hypot(*(localiser.pose(BLANK) - after.truth[-1])[:2]) < cases.REACH
    lost = int(np.argmax(states == LOST))
    assert (pieces[0], pieces[lost - 1], pieces[lost], pieces[-1]) == (0, 1, 2, 1)

    localiser.files()["localisation.csv"](tmp_path / "localisation.csv")
    with (tmp_path / "localisation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [Localisation[row["state"].upper()] for row in rows] == states.tolist()
    assert [int(row["step"]) for row in rows] == list(range(2 * COUNT))
    assert (float(rows[-1]["mass"]), float(rows[-1]["log_odds"])) == (now.mass, now.log_odds)
    deviation = np.sqrt(np.linalg.eigvalsh(now.covariance[:2, :2]).max())
    assert float(rows[-1]["sd"]) == pytest.approx(deviation)


def carried() -> Localiser:
    """A robot that was found, and now is carried away."""
    localiser = new_localiser()
    follow(localiser, drive(begin=5))
    assert localiser.states()[-1] == FOUND
    return localiser


def test_a_pose_that_odometry_alone_has_made_uncertain_is_lost_and_found_again() -> None:
    localiser, there, back = carried(), drive(begin=5), drive(seed=1, begin=5 + COUNT)
    for ahead in [4.0] * 100 + [-4.0] * 100:  # far beyond the map and back, without a view
        localiser.update(step(np.array([ahead, 0.0, 0.0])), BLANK, NOTHING)
    # The state and the pose are those of the newest keyframe.
    blank = there.evidence[-1]._replace(match=-1, posterior=0.0, shows=False)
    localiser.update(step(np.zeros(3)), BLANK, blank)
    assert localiser.states()[-1] == LOST
    assert localiser.visits().step[-1] < COUNT
    follow(localiser, back, slice(1, None))
    assert localiser.states()[-1] == FOUND
    assert np.hypot(*(localiser.pose(BLANK) - back.truth[-1])[:2]) < cases.REACH


def test_without_views_the_pose_is_that_of_odometry() -> None:
    """What a map learns of its odometry does not make that of others better."""
    driven = drive()
    driven.observations[20] = step(np.array([np.nan, 0.0, np.inf]))  # what is not finite is left out

    def spreads(localiser: Localiser) -> np.ndarray:
        return np.array([localiser.update(seen, BLANK, NOTHING).spread for seen in driven.observations])

    localiser = new_localiser()
    spread = spreads(localiser)
    assert (localiser.states() == SEARCHING).all()
    expected = integrate(np.nan_to_num([seen.odometry[:3] for seen in driven.observations], posinf=0.0))
    cases.assert_same_pose(localiser.trajectory(), expected)
    assert np.diff(spread.max(axis=1)).min() >= 0
    assert spread[-1].min() > 0
    assert spreads(new_localiser(noise=0.5))[-1] == pytest.approx(spread[-1])
    assert spreads(new_localiser(noise=4.0))[-1, 2] > 1.5 * spread[-1, 2]


@pytest.mark.parametrize("stop", [4, 12, COUNT + 8])
def test_a_restored_session_goes_on_to_the_same_bits(stop: int) -> None:
    """Stopped while it searches, when it is found, and while it is lost."""
    driven, later = drive(begin=5), drive(seed=1, begin=45)
    driven.observations.extend(later.observations)
    driven.evidence.extend(later.evidence)
    whole, first, second = new_localiser(), new_localiser(), new_localiser()
    expected = follow(whole, driven)
    follow(first, driven, slice(stop))
    second.restore(first.arrays())
    np.testing.assert_equal(follow(second, driven, slice(stop, None)), expected[stop:])
    np.testing.assert_equal(second.arrays(), whole.arrays())


@settings(max_examples=6)
@given(cases.SEEDS)
def test_a_supposed_start_is_believed_from_the_first_step_until_views_contradict_it(seed: int) -> None:
    driven = drive(seed)
    elsewhere = LOOP.poses[int(np.hypot(*(LOOP.poses - driven.truth[0])[:, :2].T).argmax())]
    right, wrong = new_localiser(start=driven.truth[0]), new_localiser(start=elsewhere)
    for localiser in (right, wrong):
        assert localiser.localisation().state == FOUND
        follow(localiser, driven)
    assert (right.states() == FOUND).all()
    assert (errors(right, driven) < cases.REACH).all()
    assert errors(wrong, driven)[0] > cases.REACH
    assert (errors(wrong, driven)[COUNT // 2 :] <= cases.REACH).all()
    assert wrong.states()[-1] == FOUND
