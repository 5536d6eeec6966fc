"""A session is found in a finished map, lost where it is carried away, and not found elsewhere."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

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
from tests.ratslam.places.alignment_cases import (
    REACH,
    SEEDS,
    assert_same_pose,
    ground_at,
    odds_of,
    square_loop,
)

LOOP, ODDS = square_loop(), odds_of()
COUNT, NEEDED = 60, 15.0


def new_map() -> KeyframeMap:
    return KeyframeMap(KeyframeMapConfig(), 0.05, LabelAppearance(), AcceptByOdds, guard=20)


MAP = new_map()
FOUND, LOST = Localisation.FOUND, Localisation.LOST
BLANK = Estimate(np.zeros(3), np.zeros(3), np.int32(-1), np.int32(-1), np.int32(Action.NONE), np.bool_(True))


class Evidence(NamedTuple):
    """That of the localise backend, as far as its map reads it."""

    keyframe: int
    match: int
    shift_row: int
    posterior: float
    shows: bool
    gain: np.ndarray


class Drive(NamedTuple):
    """A session: observations and evidence [n], true poses [n, 3] in the map."""

    observations: list[Observation]
    evidence: list[Evidence]
    truth: np.ndarray


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


def new_localiser(ground: Ground = LOOP.ground, map: KeyframeMap = MAP, start=None) -> Localiser:
    return Localiser(Place(map, np.arange(len(ground.poses)), ground, ODDS), NEEDED, start)


def follow(localiser: Localiser, driven: Drive, first: int = 0) -> list[Estimate]:
    rows = list(zip(driven.observations, driven.evidence, strict=True))[first:]
    return [localiser.update(seen, BLANK, evidence) for seen, evidence in rows]


def errors(localiser: Localiser, driven: Drive) -> np.ndarray:
    """Errors of position where the pose was found, m."""
    found = localiser.states() == FOUND
    return np.hypot(*(localiser.trajectory() - driven.truth)[found][:, :2].T)


@settings(max_examples=6)
@given(SEEDS)
def test_a_session_on_the_map_is_found_where_it_is(seed: int) -> None:
    localiser, driven = new_localiser(), drive(seed)
    estimates = follow(localiser, driven)
    states = localiser.states()
    first = int(np.argmax(states == FOUND))
    assert 3 < first < 30  # not before much was seen
    assert (states[:first] == Localisation.SEARCHING).all()
    assert (states[first:] == FOUND).all()
    assert (errors(localiser, driven) < REACH).all()
    now = localiser.localisation()
    assert now.mass > 0.99
    assert now.log_odds > NEEDED
    assert np.linalg.eigvalsh(now.covariance).min() > 0
    assert [bool(estimate.lost) for estimate in estimates] == (states != FOUND).tolist()
    np.testing.assert_array_equal(estimates[-1].pose, now.pose)
    assert localiser.pieces().tolist() == [int(state == FOUND) for state in states]


@settings(max_examples=6)
@given(SEEDS)
def test_shuffled_views_are_never_found(seed: int) -> None:
    order = np.random.default_rng(seed).permutation(COUNT).tolist()
    localiser = new_localiser()
    follow(localiser, drive(seed, views=order))
    assert FOUND not in localiser.states()


def test_another_world_is_never_found_and_named_so() -> None:
    """Views that fit single keyframes by chance, as recall reports them."""
    driven, stream = drive(count=150), np.random.default_rng(0)
    localiser = new_localiser()
    for k, (seen, evidence) in enumerate(zip(driven.observations, driven.evidence, strict=True)):
        gain = stream.normal(-0.5, 1.0, evidence.gain.shape).astype(np.float32)
        other = evidence._replace(gain=gain, match=int(stream.integers(len(LOOP.poses))) if k % 3 else -1)
        localiser.update(seen, BLANK, other)
    assert FOUND not in localiser.states()
    assert localiser.states()[-1] == Localisation.NOT_THIS_MAP
    assert localiser.localisation().mass < 0.01
    follow(localiser, drive())
    assert localiser.states()[-1] == FOUND  # it may come to mapped ground yet


def test_a_carried_robot_is_lost_claims_nothing_and_is_found_where_it_is(tmp_path: Path) -> None:
    localiser, after = carried(), drive(seed=1, begin=45)
    for seen, evidence in zip(after.observations, after.evidence, strict=True):
        localiser.update(seen, BLANK, evidence)
        now = localiser.localisation()
        assert now.state == FOUND or now.mass < 0.9 or now.log_odds < NEEDED
    states, pieces = localiser.states(), localiser.pieces()
    assert (states[COUNT - 10 : COUNT] == FOUND).all()
    assert states[1:][np.diff(states) != 0].tolist() == [FOUND, LOST, FOUND]
    assert np.hypot(*(localiser.pose(BLANK) - after.truth[-1])[:2]) < REACH
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
    nothing = Evidence(-1, -1, 0, 0.0, False, there.evidence[0].gain)
    away = [np.array([4.0, 0.0, 0.0])] * 100 + [np.array([-4.0, 0.0, 0.0])] * 100
    for odometry in away:  # far beyond the map and back, without a view
        localiser.update(step(odometry), BLANK, nothing)
    # The state and the pose are those of the newest keyframe.
    blank = there.evidence[-1]._replace(match=-1, posterior=0.0, shows=False)
    localiser.update(step(np.zeros(3)), BLANK, blank)
    assert localiser.states()[-1] == LOST
    assert localiser.visits().step[-1] < COUNT
    follow(localiser, back, first=1)
    assert localiser.states()[-1] == FOUND
    assert np.hypot(*(localiser.pose(BLANK) - back.truth[-1])[:2]) < REACH


def test_without_views_the_pose_is_that_of_odometry() -> None:
    """What a map learns of its odometry does not make that of others better."""

    def spreads(localiser: Localiser) -> np.ndarray:
        return np.array([localiser.update(seen, BLANK, nothing).spread for seen in driven.observations])

    def learned(factor: float) -> np.ndarray:
        made = new_map()
        made.state.heading_noise = HeadingNoise(float(np.log(factor)))
        return spreads(new_localiser(map=made))[-1]

    driven, localiser = drive(), new_localiser()
    driven.observations[20] = step(np.array([np.nan, 0.0, np.inf]))  # what is not finite is left out
    nothing = Evidence(-1, -1, 0, 0.0, False, driven.evidence[0].gain)
    spread = spreads(localiser)
    assert (localiser.states() == Localisation.SEARCHING).all()
    expected = integrate(np.nan_to_num([seen.odometry[:3] for seen in driven.observations], posinf=0.0))
    assert_same_pose(localiser.trajectory(), expected)
    assert np.diff(spread.max(axis=1)).min() >= 0
    assert spread[-1].min() > 0
    assert learned(0.5) == pytest.approx(spread[-1])
    assert learned(4.0)[2] > 1.5 * spread[-1, 2]


@pytest.mark.parametrize("stop", [4, 12, COUNT + 8])
def test_a_restored_session_goes_on_to_the_same_bits(stop: int) -> None:
    """Stopped while it searches, when it is found, and while it is lost."""
    halves = drive(begin=5), drive(seed=1, begin=45)
    driven = Drive(halves[0].observations + halves[1].observations, halves[0].evidence + halves[1].evidence,
                   np.concatenate([half.truth for half in halves]))  # fmt: skip
    whole, first, second = new_localiser(), new_localiser(), new_localiser()
    expected = follow(whole, driven)
    for seen, evidence in list(zip(driven.observations, driven.evidence, strict=True))[:stop]:
        first.update(seen, BLANK, evidence)
    second.restore(first.arrays())
    found = follow(second, driven, stop)
    for one, other in zip(found, expected[stop:], strict=True):
        for value, like in zip(one, other, strict=True):
            np.testing.assert_array_equal(value, like)
    arrays, like = second.arrays(), whole.arrays()
    assert arrays.keys() == like.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, like[name], err_msg=name)


def test_a_session_in_a_map_that_has_changed_is_refused() -> None:
    localiser = new_localiser()
    follow(localiser, drive(count=5))
    changed = new_localiser(ground_at(LOOP.poses + [0.0, 0.01, 0.0]))
    with pytest.raises(ValueError, match="in another map, or in this one before it was changed"):
        changed.restore(localiser.arrays())


def begun_at(start: np.ndarray, driven: Drive) -> Localiser:
    """A session that is supposed to begin at `start` [3] in the map."""
    localiser = new_localiser(start=start)
    assert localiser.localisation().state == FOUND
    follow(localiser, driven)
    return localiser


@settings(max_examples=6)
@given(SEEDS)
def test_a_supposed_start_is_believed_from_the_first_step(seed: int) -> None:
    driven = drive(seed)
    localiser = begun_at(driven.truth[0], driven)
    assert (localiser.states() == FOUND).all()
    assert (errors(localiser, driven) < REACH).all()


@settings(max_examples=6)
@given(SEEDS)
def test_views_that_contradict_a_supposed_start_remove_it(seed: int) -> None:
    driven = drive(seed)
    elsewhere = LOOP.poses[int(np.hypot(*(LOOP.poses - driven.truth[0])[:, :2].T).argmax())]
    localiser = begun_at(elsewhere, driven)
    wrong = np.hypot(*(localiser.trajectory() - driven.truth)[:, :2].T) > REACH
    assert wrong[0]
    assert not wrong[COUNT // 2 :].any()
    assert localiser.states()[-1] == FOUND
