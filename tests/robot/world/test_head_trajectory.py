"""Head paths: route, speed, variation between visits, kidnaps, and reverse tracking."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.world.maze import CELL_SIDE, cell_centre, circuit_route, random_loop
from robot.world.scene import HeadPath, JitterConfig, MotionConfig, add_kidnaps, plan_path, poses_at
from tactile.base.random_streams import stream
from tactile.base.se2 import wrap

SEEDS = st.integers(0, 1000)
STEADY = JitterConfig(position=0, yaw_deg=0, speed=0)


def path_of(seed: int, word: str = "CA", **changes: object) -> HeadPath:
    way = circuit_route(random_loop(7, 5, 20, stream(seed, "maze.loop")), word)
    return plan_path(MotionConfig(**changes), way, stream(seed, "motion"))


@given(SEEDS)
def test_without_jitter_the_path_joins_cell_centres_and_faces_ahead(seed: int) -> None:
    path = path_of(seed, jitter=STEADY)
    way = circuit_route(random_loop(7, 5, 20, stream(seed, "maze.loop")), "CA")
    passed = path.pose[np.concatenate([[True], np.abs(np.diff(path.pose[:, :2], axis=0)).sum(axis=1) > 1e-9])]
    assert np.allclose(passed[:, :2], [cell_centre(cell) for cell in way], atol=1e-12)
    step, took = np.diff(path.pose, axis=0), np.diff(path.time)
    driven = np.hypot(step[:, 0], step[:, 1])
    straight = driven > 1e-9
    assert np.allclose(driven[straight] / took[straight], 0.03)
    assert np.allclose(step[straight, 2], 0)
    assert np.allclose(
        wrap(np.arctan2(step[straight, 1], step[straight, 0]) - path.pose[1:][straight, 2]), 0, atol=1e-9
    )
    assert np.allclose(np.abs(step[~straight, 2]) / took[~straight], 0.4)
    assert (np.abs(step[:, 2]) <= np.pi + 1e-12).all()
    assert np.isclose(path.duration, 40 * CELL_SIDE / 0.03 + np.abs(step[:, 2]).sum() / 0.4)


@given(SEEDS)
def test_backwards_faces_against_the_direction_of_travel(seed: int) -> None:
    """The headings are those of the opposite direction of travel."""
    way = circuit_route(random_loop(7, 5, 20, stream(seed, "maze.loop")), "A")
    there = plan_path(MotionConfig(jitter=STEADY), way, stream(seed, "motion"))
    back = plan_path(MotionConfig(jitter=STEADY, backwards=True), way[::-1], stream(seed, "motion"))
    assert np.isclose(there.duration, back.duration)
    time = np.linspace(0, there.duration, 200)
    one, other = poses_at(there, time), poses_at(back, there.duration - time)
    assert np.allclose(one[:, :2], other[:, :2], atol=1e-9)
    assert np.allclose(wrap(one[:, 2] - other[:, 2]), 0, atol=1e-9)


def test_visits_vary_by_the_configured_jitter() -> None:
    jitter = JitterConfig(position=0.005, yaw_deg=3.0, speed=0.1)
    path = path_of(0, "A" * 60, jitter=jitter)
    steady = path_of(0, "A" * 60, jitter=STEADY)
    off = path.pose - steady.pose
    assert off[:, :2].std() == pytest.approx(0.005, rel=0.1)
    assert np.degrees(off[:, 2]).std() == pytest.approx(3.0, rel=0.1)
    took = np.diff(path.time) / np.diff(steady.time)
    turns = np.hypot(*np.diff(steady.pose[:, :2], axis=0).T) < 1e-9
    assert np.allclose(took[turns], 1)
    assert (1 / took[~turns]).std() == pytest.approx(0.1, rel=0.1)


@given(SEEDS, st.integers(0, 1000))
def test_a_path_depends_on_its_seed_only(seed: int, other: int) -> None:
    one, again = path_of(seed), path_of(seed)
    assert (one.pose == again.pose).all()
    if other != seed:
        assert path_of(other).pose.shape != one.pose.shape or (path_of(other).pose != one.pose).any()


def test_time_increases_and_poses_are_clamped_to_the_ends() -> None:
    path = path_of(3)
    assert (np.diff(path.time) > 0).all()
    assert (poses_at(path, np.array([-5.0, 1e9])) == path.pose[[0, -1]]).all()


@settings(max_examples=40)
@given(SEEDS, st.lists(st.floats(0.05, 0.7), min_size=1, max_size=4), st.floats(1.0, 30.0))
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
    away = np.abs(time[:, None] - jumps).min(axis=1) > 1e-6
    assert np.allclose(poses_at(there, time)[away], poses_at(path, time + skipped)[away], atol=1e-9)


def test_a_kidnap_beyond_the_end_ends_the_path() -> None:
    path = path_of(0)
    there, jumps = add_kidnaps(path, [path.duration - 10.0], 45.0)
    assert there.duration == pytest.approx(path.duration - 10.0)
    assert len(jumps) == 0
