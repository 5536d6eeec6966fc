"""Saved maps of a building whose places have given ids, as with markers on the walls."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from evaluation.metrics.trajectory import align, ate
from ratslam.core.estimates import Localisation
from ratslam.runs.merge import merge_maps
from ratslam.runs.saved_map import read_map
from ratslam.runs.settings.run_config import LoopConfig
from ratslam.runs.slam import Slam
from robot.sources.source import SourceDescription
from tactile.base.se2 import compose, integrate
from tactile.base.types import Observation, Odometry, observation

SIDES = (16.0, 12.0)
"""Of the rectangle that the robot drives along, m."""
STEP, MARKED = 0.25, 8
"""Motion of a step, m; steps between two places with an id."""
UNCERTAIN = 0.9
"""Largest standard deviation of the position of a robot that is found, m."""
SETTINGS = {
    "templates": {"source": "labels"},
    "pose_cells": {"cells_xy": 11, "cell_size": 0.5},
    "attractor": {"engine": "dense"},
    "session": {"reserve": 128},
}


class Drive(NamedTuple):
    """Readings [N] and true poses [N, 3]."""

    readings: list[Observation]
    truth: np.ndarray


def lap() -> np.ndarray:
    """[n, 3] motions once round the rectangle."""
    sides = [np.tile([STEP, 0.0, 0.0], (round(length / STEP), 1)) for length in SIDES * 2]
    for side in sides:
        side[-1, 2] = np.pi / 2
    return np.concatenate(sides)


def drive(begin: int, steps: int, seed: int, first_id: int = 0, order: int = 1) -> Drive:
    """A drive that begins at a step of the lap; markers have consecutive ids, but for an order."""
    motion = np.roll(lap(), -begin, axis=0)[np.arange(steps) % len(lap())]
    truth = compose(integrate(lap())[begin], integrate(motion))
    noise = np.random.default_rng(seed).normal(0, [0.01, 0.002, 0.01], (steps, 3))
    at = (begin + 1 + np.arange(steps)) % len(lap())
    given = first_id + order * (at // MARKED) % (len(lap()) // MARKED)
    label = np.where(at % MARKED == 0, given, -1)
    readings = [
        observation(Odometry(*moved, 0.25), view_shape=(1, 1, 1), label=int(one))
        for moved, one in zip(motion + noise, label, strict=True)
    ]
    return Drive(readings, truth)


def mapped(path: Path, made: Drive) -> Path:
    """The map file of a drive."""
    slam = Slam(LoopConfig.model_validate(SETTINGS), SourceDescription(view_shape=(1, 1, 1), rate_hz=4.0))
    for reading in made.readings:
        slam.step(reading)
    slam.save(path)
    return path


FIRST = drive(0, 450, 1)


@pytest.fixture(scope="module")
def map_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return mapped(tmp_path_factory.mktemp("ids") / "first.npz", FIRST)


def states(map_file: Path, session: Drive) -> tuple[np.ndarray, np.ndarray]:
    """[N] the state at each step, and the largest error of the poses where the robot is found, m."""
    slam = Slam.load(map_file, mode="localise")
    poses = np.array([slam.step(reading).pose for reading in session.readings])
    state = np.asarray(slam.map.states())
    frame = align(read_map(map_file).open_session().map.trajectory(), FIRST.truth)
    apart = np.hypot(*(compose(frame, poses) - session.truth)[:, :2].T)
    return state, apart[state == Localisation.FOUND].max(initial=0)


def test_a_robot_is_found_by_a_few_ids_and_stays_found(map_file: Path) -> None:
    state, error = states(map_file, drive(100, 150, 2))
    found = state == Localisation.FOUND
    assert 0 < np.argmax(found) <= 6 * MARKED
    assert found[np.argmax(found) :].all()
    assert error < UNCERTAIN


def test_a_robot_that_sees_no_id_for_long_is_lost_and_found_again(map_file: Path) -> None:
    session = drive(100, 300, 3)
    hidden = [one._replace(label=np.int32(-1)) for one in session.readings]
    readings = [*session.readings[:60], *hidden[60:200], *session.readings[200:]]
    state, error = states(map_file, Drive(readings, session.truth))
    found = state == Localisation.FOUND
    assert found[59]
    assert state[199] == Localisation.LOST
    assert 0 < int(np.argmax(found[200:])) <= 6 * MARKED
    assert error < 3 * UNCERTAIN


@pytest.mark.parametrize(("first_id", "order"), [(1000, 1), (0, 11)], ids=["other ids", "the same elsewhere"])
def test_in_another_building_it_is_never_found(first_id: int, order: int, map_file: Path) -> None:
    state, _ = states(map_file, drive(100, 300, 8, first_id, order))
    assert not (state == Localisation.FOUND).any()
    assert (state[-1] == Localisation.NOT_THIS_MAP) == (order > 1)


def test_sessions_that_saw_the_same_ids_become_one_map(map_file: Path, tmp_path: Path) -> None:
    again, other = drive(60, 300, 5), drive(0, 300, 6, first_id=1000)
    report = merge_maps([map_file, mapped(tmp_path / "again.npz", again)], tmp_path / "joined.npz")
    assert len(report["pieces"]) == 1
    order = [FIRST if path == str(map_file) else again for path in report["maps"]]
    path = read_map(tmp_path / "joined.npz").open_session().map.trajectory()
    assert ate(path, np.concatenate([one.truth for one in order])) < 0.5
    apart = merge_maps([map_file, mapped(tmp_path / "other.npz", other)], tmp_path / "apart.npz")
    assert len(apart["pieces"]) == 2


def test_a_session_that_continues_elsewhere_is_tied_on_by_the_ids_it_sees(map_file: Path) -> None:
    session, slam = drive(100, 200, 7), Slam.load(map_file)
    slam.session.begin_piece()
    for reading in session.readings:
        slam.step(reading)
    assert not slam.map.pieces().any()
    assert ate(slam.trajectory(), np.concatenate([FIRST.truth, session.truth])) < 0.5
