"""Paths: poses at even times, the heading of motion, files and their errors, random walks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.simulation.rat.rat_path import MotionConfig, RatPath, sample_path
from robot.simulation.rat.simulated_session import (
    PACKAGED,
    PathFileConfig,
    RandomWalkConfig,
    read_path,
    walk_randomly,
)
from tactile.base.errors import InputError

MOTION = MotionConfig()
MILLIMETRES = st.integers(0, 1000).map(lambda value: value / 1000)


@given(
    st.lists(st.tuples(MILLIMETRES, MILLIMETRES), min_size=2, max_size=20),
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
    kept = sample_path(path, MOTION, 2.0)  # at the path's own times
    np.testing.assert_allclose(kept[:, :2], path.position, atol=1e-9)


def test_the_heading_is_that_of_a_circle_and_is_not_wrapped() -> None:
    angle = np.linspace(0, 6 * np.pi, 601)
    path = RatPath(angle, np.column_stack([np.cos(angle), np.sin(angle)]))
    heading = sample_path(path, MOTION, 50.0)[:, 2]
    time = np.arange(len(heading)) / 50
    np.testing.assert_allclose(heading[50:-50], time[50:-50] + np.pi / 2, atol=0.01)
    given = RatPath(np.array([0.0, 1.0]), np.zeros((2, 2)), np.array([3.0, -3.0]))
    np.testing.assert_allclose(sample_path(given, MOTION, 2.0)[:, 2], [3.0, np.pi, 2 * np.pi - 3.0])


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


def test_packaged_paths_are_of_rats() -> None:
    for name, seconds, size in (("sargolini", 599.5, (1.0, 1.0)), ("tanni", 1199.5, (3.5, 2.5))):
        path = read_path(PathFileConfig(file=name))
        assert path.time[-1] - path.time[0] > seconds
        assert ((path.position > -0.1) & (path.position < np.add(size, 0.1))).all()
        assert PACKAGED[name].with_name("LICENSE").exists()


@pytest.mark.parametrize("kind", ["csv", "npz", "whole numbers"])
def test_files_of_each_kind_give_the_same_path(kind: str, tmp_path: Path) -> None:
    time, position = 0.1 * np.arange(30), np.random.default_rng(0).integers(0, 10_000, (30, 2)) / 1000
    file = tmp_path / ("a.csv" if kind == "csv" else "a.npz")
    if kind == "csv":
        rows = np.column_stack([time, position])
        np.savetxt(file, rows, delimiter=",", header="t,x,y", comments="", fmt="%.17g")
    elif kind == "npz":
        np.savez(file, t=time, pos=position)
    else:  # in ms and mm
        np.savez(file, t=np.arange(0, 3000, 100), pos=np.round(1000 * position).astype(int))
    path = read_path(PathFileConfig(file=file, unit=0.01, shift=(1.0, 0.0), skip=1.05))
    np.testing.assert_allclose(path.time, time[11:], atol=1e-12)
    np.testing.assert_allclose(path.position, position[11:] * 0.01 + [1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["0,0,0", "0.1,nan,0", "0.2,0,0"], ":3: x is nan"),
        (["0,0,0", "0.1,,0"], ":3: x is empty"),
        (["0,0,0", "0.1,0,0", "0.05,0,0"], ":4: t goes back"),
        (["0,0,0", "0.1,0,0", "0.1,0,0"], ":4: t repeats"),
        (["0,0,0", "0.1,60,0"], ":3: a speed of 600 m/s; expected at most 5 m/s"),
        (["0,0,0", "0.1,0,0", "9,0,0"], ":4: no position for 8.9 s; expected at most 2 s"),
        (["0,0,0"], ":2: 1 positions"),
    ],
)
def test_a_faulty_path_gives_file_and_row(lines: list[str], message: str, tmp_path: Path) -> None:
    file = tmp_path / "path.csv"
    file.write_text("\n".join(["t,x,y", *lines]))
    with pytest.raises(InputError) as caught:
        read_path(PathFileConfig(file=file))
    assert str(caught.value).startswith(f"{file}{message}")


def test_other_arrays_and_too_short_paths_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=np.arange(3.0), pos=np.zeros((3, 3)))
    np.savez(tmp_path / "b.npz", t=np.array([0.0, 0.1]), pos=np.array([[0.0, 0.0], [np.nan, 0.0]]))
    for config, message in (
        ({"file": tmp_path / "a.npz"}, r"a.npz: another kind of file .*pos \[3, 3\]"),
        ({"file": tmp_path / "b.npz"}, "b.npz:1: the position is nan"),
        ({"skip": 700}, r"rat_simulation.path.skip: 700 s to skip"),
    ):
        with pytest.raises(InputError, match=message):
            read_path(PathFileConfig(**config))


def test_a_walk_has_the_given_speeds_stays_inside_and_begins_a_longer_one() -> None:
    config = RandomWalkConfig(speed=0.2, speed_sd=0.1)
    path = walk_randomly(config, (1.0, 0.6), 300.0, 20.0, 3)
    assert (path.position >= 0).all()
    assert (path.position <= [1.0, 0.6]).all()
    speed = np.hypot(*np.diff(path.position, axis=0).T) * 20
    assert abs(speed.mean() - 0.2) < 0.02
    assert abs(speed.std() - 0.1) < 0.02
    short = walk_randomly(config, (1.0, 0.6), 5.0, 20.0, 3).position
    np.testing.assert_array_equal(short, path.position[: len(short)])
    known = [[0.5, 0.3], [0.93205, 0.218491], [0.53375, 0.344527], [0.756468, 0.06543]]
    np.testing.assert_allclose(path.position[[0, 50, 100, -1]], known, atol=1e-6)
