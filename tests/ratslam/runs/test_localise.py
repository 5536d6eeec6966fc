"""Sessions by whisker in the saved map of a small maze."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest

from ratslam.core.session import Session, Step
from ratslam.methods.localise import LocaliseBackend
from ratslam.places.localiser import Localisation, Localiser
from tactile.base.se2 import between, wrap
from tactile.base.types import Observation
from tests.ratslam.runs.touch_walks import Walk, empty_session, follow, shuffled, simulate_walk, unseen

FOUND, LOST = Localisation.FOUND, Localisation.LOST
LAP = {"maze": {"columns": 5, "rows": 5, "loop": 12, "seed": 31003}}
FAR, TURNED = 0.09, np.radians(20)
"""A pose is right if it is nearer than this, m, rad."""


@cache
def mapped() -> tuple[Walk, np.ndarray, Session]:
    """A walk of three circuits, its poses in the map, and a session that localises in it."""
    walk, mapping = simulate_walk(1, **LAP, path={"circuits": "CCA"}), empty_session()
    path = follow(mapping, walk.readings).path
    return walk, path, Session(LocaliseBackend(mapping.backend, mapping.map, 15.0))


@cache
def another_day() -> Walk:
    return simulate_walk(77, **LAP, path={"circuits": "AA"})


def localise(readings: Sequence[Observation]) -> tuple[list[Step], Localiser]:
    session = mapped()[2]
    session.restart()
    steps = list(session.replay(readings))
    assert isinstance(session.map, Localiser)
    return steps, session.map


def errors(steps: Sequence[Step], truth: np.ndarray) -> np.ndarray:
    """[n, 2] errors of position (m) and heading (rad) against the nearest step that faces alike."""
    walk, path, _ = mapped()
    found = []
    for step, pose in zip(steps, truth, strict=True):
        apart = np.hypot(*(walk.truth - pose)[:, :2].T) + (np.abs(wrap(walk.truth[:, 2] - pose[2])) > 0.8)
        near = int(apart.argmin())
        error = between(between(walk.truth[near], pose), between(path[near], step.pose))
        found.append((np.hypot(*error[:2]), abs(wrap(error[2]))))
    return np.array(found)


def is_right(error: np.ndarray) -> np.ndarray:
    return (error[:, 0] < FAR) & (error[:, 1] < TURNED)


def test_the_session_of_the_map_is_found_in_it() -> None:
    walk = mapped()[0]
    steps, localiser = localise(walk.readings)
    found = localiser.states() == FOUND
    assert 0.7 < found.mean() < 1
    assert is_right(errors(steps, walk.truth))[found].mean() > 0.95


def test_another_session_is_found_and_stays_found() -> None:
    """It turns the other way round half of the time, so by half turns of the views too."""
    walk = another_day()
    steps, localiser = localise(walk.readings)
    states = localiser.states()
    first = int(np.argmax(states == FOUND))
    assert 0 < first < 120
    assert (states[first:] == FOUND).all()
    right = is_right(errors(steps, walk.truth))
    assert right[first]
    assert right[first:].mean() > 0.9
    assert localiser.localisation().mass > 0.99


def mirrored(readings: Sequence[Observation]) -> list[Observation]:
    """The session of a robot in the mirrored maze."""
    flipped = []
    for one in readings:
        view = np.ravel(one.view)[::-1].reshape(one.view.shape)
        move = one.odometry._replace(dy=-one.odometry.dy, dtheta=-one.odometry.dtheta)
        flipped.append(one._replace(view=view, odometry=move))
    return flipped


@pytest.mark.parametrize("control", [shuffled, unseen, mirrored])
def test_sessions_that_are_not_in_the_map_are_not_found(control: Any) -> None:
    _, localiser = localise(control(another_day().readings))
    assert FOUND not in localiser.states()


def test_the_session_of_another_maze_is_not_found() -> None:
    other = simulate_walk(3, maze=LAP["maze"] | {"seed": 31005}, path={"circuits": "AA"})
    _, localiser = localise(other.readings)
    assert FOUND not in localiser.states()


def test_a_carried_robot_is_lost_and_found_again() -> None:
    walk = simulate_walk(77, **LAP, path={"circuits": "AAA"})  # a circuit after it is put down
    rows = np.r_[: 2 * len(walk.readings) // 5, 2 * len(walk.readings) // 5 + 40 : len(walk.readings)]
    steps, localiser = localise([walk.readings[k] for k in rows])
    states = localiser.states()
    changes = states[1:][np.diff(states) != 0].tolist()
    assert changes[:2] == [FOUND, LOST]
    assert states[-1] == FOUND
    assert is_right(errors(steps, walk.truth[rows]))[-1]


def test_live_and_replay_and_a_checkpoint_give_the_same_bits() -> None:
    """Both while it is searched for and where it is found; one compilation serves all."""
    readings, (_, _, session) = another_day().readings, mapped()
    expected, localiser = localise(readings)
    like = session.arrays()
    first = int(np.argmax(localiser.states() == FOUND))
    for stop in (first - 5, first + 3):
        session.restart()
        live = [session.step(one) for one in readings[:stop]]
        saved = session.arrays()
        session.restart()
        session.restore(saved)
        live += session.replay(readings[stop:])
        for step, other in zip(live, expected, strict=True):
            np.testing.assert_array_equal(step.pose, other.pose)
            for one, value in zip(step.estimate, other.estimate, strict=True):
                np.testing.assert_array_equal(one, value)
        for name, array in session.arrays().items():
            np.testing.assert_array_equal(array, like[name], err_msg=name)
    assert session.compilations() == 1


def test_odometry_and_views_that_are_not_finite_are_left_out() -> None:
    readings = list(another_day().readings)
    readings[5] = readings[5]._replace(odometry=readings[5].odometry._replace(dx=np.float64(np.nan)))
    readings[60] = readings[60]._replace(view=np.full_like(readings[60].view, np.inf))
    steps, localiser = localise(readings)
    assert [int(steps[k].evidence.outcome) for k in (4, 5, 60)] == [0, 1, 1]
    assert np.isfinite(localiser.trajectory()).all()
    assert localiser.states()[-1] == FOUND
