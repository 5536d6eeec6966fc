"""Head paths: route, speed, variation between visits, kidnaps, and reverse tracking."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from robot.world.maze import CELL_SIDE, cell_centre, circuit_route, random_loop
from robot.world.scene import HeadPath, JitterConfig, MotionConfig, add_kidnaps, plan_path, poses_at
from tactile.base.random_streams import stream
from tactile.base.se2 import wrap

SEEDS = st.integers(0, 1000)
STEADY = JitterConfig(position=0, yaw_deg=0, speed=0)


def route(seed: int, word: str = "CA") -> list[tuple[int, int]]:
    return circuit_route(random_loop(5, 4, 12, stream(seed, "maze.loop")), word)


def path_of(seed: int, word: str = "CA", **changes: object) -> HeadPath:
    return plan_path(MotionConfig(**changes), route(seed, word), stream(seed, "motion"))


@given(SEEDS)
def test_without_jitter_the_path_joins_cell_centres_and_faces_ahead(seed: int) -> None:
    path = path_of(seed, jitter=STEADY)
    passed = path.pose[np.concatenate([[True], np.abs(np.diff(path.pose[:, :2], axis=0)).sum(axis=1) > 1e-9])]
    assert np.allclose(passed[:, :2], [cell_centre(cell) for cell in route(seed)], atol=1e-12)
    step, took = np.diff(path.pose, axis=0), np.diff(path.time)
    driven = np.hypot(step[:, 0], step[:, 1])
    straight = driven > 1e-9
    assert np.allclose(driven[straight] / took[straight], 0.03)
    assert np.allclose(step[straight, 2], 0)
    course = np.arctan2(step[straight, 1], step[straight, 0])
    assert np.allclose(wrap(course - path.pose[1:][straight, 2]), 0, atol=1e-9)
    assert np.allclose(np.abs(step[~straight, 2]) / took[~straight], 0.4)
    assert (np.abs(step[:, 2]) <= np.pi + 1e-12).all()
    assert np.isclose(path.duration, 24 * CELL_SIDE / 0.03 + np.abs(step[:, 2]).sum() / 0.4)


@given(SEEDS)
def test_backwards_faces_against_the_direction_of_travel(seed: int) -> None:
    there = plan_path(MotionConfig(jitter=STEADY), route(seed, "A"), stream(seed, "motion"))
    turned = MotionConfig(jitter=STEADY, backwards=True)
    back = plan_path(turned, route(seed, "A")[::-1], stream(seed, "motion"))
    assert np.isclose(there.duration, back.duration)
    time = np.linspace(0, there.duration, 200)
    one, other = poses_at(there, time), poses_at(back, there.duration - time)
    assert np.allclose(one[:, :2], other[:, :2], atol=1e-9)
    assert np.allclose(wrap(one[:, 2] - other[:, 2]), 0, atol=1e-9)
    assert (poses_at(there, np.array([-5.0, 1e9])) == there.pose[[0, -1]]).all()


def test_the_path_of_a_seed_stays_the_same_with_the_configured_jitter() -> None:
    path = path_of(3, jitter=JitterConfig(position=0.005, yaw_deg=3.0, speed=0.1))
    assert (np.diff(path.time) > 0).all()
    np.testing.assert_allclose(path.time[[1, 2, -1]], [6.165587, 10.092578, 191.124197], atol=1e-6)
    np.testing.assert_allclose(path.pose[0], [0.634887, 0.088557, 1.548726], atol=1e-6)
    np.testing.assert_allclose(path.pose[-1], [0.630716, 0.094068, 4.738440], atol=1e-6)


@settings(max_examples=40)
@given(SEEDS, st.lists(st.floats(0.05, 0.7), min_size=1, max_size=4), st.floats(1.0, 30.0))
@example(0, [0.95], 45.0)
def test_a_kidnap_continues_at_the_later_pose(seed: int, shares: list[float], ahead: float) -> None:
    path = path_of(seed)
    when = [share * path.duration for share in shares]
    there, jumps = add_kidnaps(path, when, ahead)
    assert (np.diff(there.time) >= 0).all()
    # Kidnap k, from 0, leads to `when + (k + 1) * ahead` of the path; the path ends at the first one beyond.
    beyond = np.sort(when) + ahead * np.arange(1, len(when) + 1) >= path.duration
    count = int(beyond.argmax()) if beyond.any() else len(when)
    assert np.allclose(jumps, np.sort(when)[:count])
    ended = np.sort(when)[count] if beyond.any() else path.duration - ahead * count
    assert there.duration == pytest.approx(min(ended, path.duration - ahead * count))
    time = np.linspace(0, there.duration, 300)
    skipped = ahead * (time[:, None] > jumps).sum(axis=1)
    away = np.abs(time[:, None] - jumps).min(axis=1, initial=np.inf) > 1e-6
    assert np.allclose(poses_at(there, time)[away], poses_at(path, time + skipped)[away], atol=1e-9)
