"""Paths: poses at even times, the heading of motion, files and their errors, random walks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.simulation.rat.rat_path import MotionConfig, RatPath, sample_path
from robot.simulation.rat.simulated_session import (
    PACKAGED,
    PathFileConfig,
    RandomWalkConfig,
    ornstein_uhlenbeck,
    read_path,
    walk_randomly,
)
from tactile.base.errors import InputError

MOTION = MotionConfig()


@settings(max_examples=25, derandomize=True, deadline=None)
@given(
    st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1)), min_size=2, max_size=20),
    st.floats(5, 60),
    st.sampled_from([0.0, 0.1]),
)
def test_sampled_positions_stay_in_bounds(points: list, rate: float, smoothing: float) -> None:
    position = np.array(points)
    path = RatPath(0.5 * np.arange(len(points)), position)
    pose = sample_path(path, MOTION, rate, smoothing)
    assert (pose[:, :2] >= position.min(axis=0) - 1e-12).all()
    assert (pose[:, :2] <= position.max(axis=0) + 1e-12).all()
    assert len(pose) == int(path.time[-1] * rate + 1e-6) + 1


def test_positions_at_their_own_times_are_kept() -> None:
    path = RatPath(0.1 * np.arange(50), np.random.default_rng(0).random((50, 2)))
    np.testing.assert_allclose(sample_path(path, MOTION, 10.0)[:, :2], path.position, atol=1e-9)


def test_the_heading_is_that_of_a_circle_and_is_not_wrapped() -> None:
    angle = np.linspace(0, 6 * np.pi, 601)
    path = RatPath(angle, np.column_stack([np.cos(angle), np.sin(angle)]))
    heading = sample_path(path, MOTION, 50.0)[:, 2]
    time = np.arange(len(heading)) / 50
    np.testing.assert_allclose(heading[50:-50], time[50:-50] + np.pi / 2, atol=0.01)


def test_a_standing_rat_keeps_its_heading() -> None:
    """North, 4 s of standing with a jitter of 0.1 mm, then west."""
    random = np.random.default_rng(1)
    north, west = np.linspace(0, 0.4, 41), np.linspace(0, -0.4, 41)
    x = np.concatenate([np.zeros(41), np.zeros(40), west])
    y = np.concatenate([north, np.full(40, 0.4), np.full(41, 0.4)])
    position = np.column_stack([x, y]) + 1e-4 * random.standard_normal((122, 2))
    pose = sample_path(RatPath(0.1 * np.arange(122), position), MOTION, 50.0)
    np.testing.assert_allclose(pose[220:360, 2], np.pi / 2, atol=0.05)
    np.testing.assert_allclose(pose[-100:, 2], np.pi, atol=0.05)
    assert np.abs(np.diff(pose[:, 2])).max() < 0.2


def test_given_headings_are_interpolated() -> None:
    path = RatPath(np.array([0.0, 1.0]), np.zeros((2, 2)), np.array([3.0, -3.0]))
    heading = sample_path(path, MOTION, 2.0)[:, 2]
    np.testing.assert_allclose(heading, [3.0, np.pi, 2 * np.pi - 3.0])


@pytest.mark.parametrize(
    ("name", "seconds", "size"), [("sargolini", 599.5, (1.0, 1.0)), ("tanni", 1199.5, (3.5, 2.5))]
)
def test_packaged_paths_are_of_rats(name: str, seconds: float, size: tuple[float, float]) -> None:
    path = read_path(PathFileConfig(file=name))
    assert path.time[-1] - path.time[0] > seconds
    assert (path.position > -0.1).all()
    assert (path.position < np.add(size, 0.1)).all()
    assert PACKAGED[name].with_name("LICENSE").exists()


def test_csv_and_npz_give_the_same_path(tmp_path: Path) -> None:
    time, position = 0.1 * np.arange(30), np.random.default_rng(0).random((30, 2)) * 10
    rows = np.column_stack([time, position])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header="t,x,y", comments="", fmt="%.17g")
    np.savez(tmp_path / "a.npz", t=time, pos=position)
    given = {"unit": 0.01, "shift": (1.0, 0.0), "skip": 1.05}
    both = [read_path(PathFileConfig(file=tmp_path / f"a.{kind}", **given)) for kind in ("csv", "npz")]
    for path in both:
        np.testing.assert_array_equal(path.time, time[11:])
        np.testing.assert_array_equal(path.position, position[11:] * 0.01 + [1.0, 0.0])


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["0,0,0", "0.1,nan,0", "0.2,0,0"], ":3: x is nan"),
        (["0,0,0", "0.1,,0"], ":3: x is empty"),
        (["0,0,0", "0.1,0,0", "0.05,0,0"], ":4: t goes back"),
        (["0,0,0", "0.1,0,0", "0.1,0,0"], ":4: t repeats"),
        (
            ["0,0,0", "0.1,60,0"],
            ":3: a speed of 600 m/s; expected at most 5 m/s; are the positions in metres",
        ),
        (["0,0,0", "0.1,0,0", "9,0,0"], ":4: no position for 8.9 s; expected at most 2 s"),
        (["0,0,0"], ":2: 1 positions; expected two at least"),
    ],
)
def test_a_faulty_path_gives_file_and_row(lines: list[str], message: str, tmp_path: Path) -> None:
    file = tmp_path / "path.csv"
    file.write_text("\n".join(["t,x,y", *lines]))
    with pytest.raises(InputError) as caught:
        read_path(PathFileConfig(file=file))
    assert str(caught.value).startswith(f"{file}{message}")


def test_other_arrays_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=np.arange(3.0), pos=np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"a.npz: another kind of file .*pos \[3, 3\]"):
        read_path(PathFileConfig(file=tmp_path / "a.npz"))
    np.savez(tmp_path / "b.npz", t=np.array([0.0, 0.1]), pos=np.array([[0.0, 0.0], [np.nan, 0.0]]))
    with pytest.raises(InputError, match=r"b.npz:1: the position is nan"):
        read_path(PathFileConfig(file=tmp_path / "b.npz"))


def test_more_skipped_than_there_is() -> None:
    with pytest.raises(InputError, match=r"rat_simulation.path.skip: 700 s to skip"):
        read_path(PathFileConfig(skip=700))


def test_a_walk_has_the_given_speeds_and_stays_inside() -> None:
    config = RandomWalkConfig(speed=0.2, speed_sd=0.1)
    path = walk_randomly(config, (1.0, 0.6), 300.0, 20.0, 3)
    assert (path.position >= 0).all()
    assert (path.position <= [1.0, 0.6]).all()
    speed = np.hypot(*np.diff(path.position, axis=0).T) * 20
    assert abs(speed.mean() - 0.2) < 0.02
    assert abs(speed.std() - 0.1) < 0.02


def test_a_shorter_walk_begins_a_longer_one() -> None:
    short, long = (walk_randomly(RandomWalkConfig(), (1.0, 1.0), s, 20.0, 3).position for s in (5.0, 50.0))
    np.testing.assert_array_equal(short, long[: len(short)])
    assert not np.array_equal(short, walk_randomly(RandomWalkConfig(), (1.0, 1.0), 5.0, 20.0, 4).position)


def test_thigmotaxis_draws_the_rat_to_walls() -> None:
    near = []
    for share in (0.0, 1.0):
        position = walk_randomly(RandomWalkConfig(thigmotaxis=share), (1.0, 1.0), 400.0, 20.0, 0).position
        near.append((np.minimum(position, 1 - position).min(axis=1) < 0.1).mean())
    assert near[0] + 0.15 < near[1]


def test_the_process_has_unit_variance_and_its_correlation_time() -> None:
    draws = np.random.default_rng(0).standard_normal((40000, 1))
    values = ornstein_uhlenbeck(draws, np.array([0.5]), 0.05)[:, 0]
    assert abs(values.std() - 1) < 0.05
    assert abs(np.mean(values[10:] * values[:-10]) - np.exp(-1)) < 0.05
