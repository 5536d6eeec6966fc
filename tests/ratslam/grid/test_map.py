"""Laws of the grid filter's map: what it keeps, draws and writes."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.core.estimates import Estimate
from ratslam.grid import particles
from ratslam.methods.grid import GridEvidence
from tactile.base.types import MotionKind
from tests.helpers.grid_world import TIPS, filter_of, report, settings

COUNT = 5
BACKEND = filter_of(settings(particles=COUNT), side=2.55)


def steady(pose):
    """Estimate and evidence of a filter with all particles at one pose."""
    weights = np.full(COUNT, 1 / COUNT)
    proof = GridEvidence(np.arange(COUNT, dtype=np.int32), np.tile(pose, (COUNT, 1)), weights, COUNT, 0)
    return Estimate(np.asarray(pose, float), np.zeros(3), -1, -1, 0, False), proof


def random_steps(count, seed=0):
    stream = np.random.default_rng(seed)
    for k in range(count):
        poses, weights = stream.normal(0, 0.3, (COUNT, 3)), stream.dirichlet(np.ones(COUNT))
        ancestor = np.sort(stream.integers(0, COUNT, COUNT)).astype(np.int32)
        estimate = Estimate(weights @ poses, np.zeros(3), -1, -1, 0, False)
        touching = np.flatnonzero(stream.random(4) < 0.4)
        wall = (0.3, 0.2) if len(touching) > 1 else None
        forward = stream.choice([0.05, -0.05])
        yield (
            report(forward, touching=touching, wall=wall, dead=[3] if k % 7 == 0 else []),
            estimate,
            GridEvidence(ancestor, poses, weights, 1 / (weights**2).sum(), 0),
        )


def map_of_steps(steps):
    grid = BACKEND.new_map()
    for step in steps:
        grid.update(*step)
    return grid


def map_of(*reports, pose=(0.0, 0.0, 0.0)):
    return map_of_steps((o, *steady(np.array(pose))) for o in reports)


def test_an_empty_map_is_the_prior():
    grid = BACKEND.new_map()
    assert grid.trajectory().shape == grid.online_trajectory().shape == (0, 3)
    assert grid.closures().shape == (0, 2)
    assert len(grid.graph()) == 0
    assert grid.occupancy() == pytest.approx(BACKEND.config.prior)
    assert grid.occupancy().shape == (51, 51)
    assert grid.feedback() is None


def test_obstacles_lie_at_the_contacts():
    for pose in ([0.0, 0.0, 0.0], [0.3, -0.4, 0.0], [0.3, -0.4, 2.0]):
        probability = map_of(report(0.05, touching=[1, 2]), pose=pose).occupancy()
        c, s = np.cos(pose[2]), np.sin(pose[2])
        for tip in TIPS[1:3]:
            x, y = pose[0] + c * tip[0] - s * tip[1], pose[1] + s * tip[0] + c * tip[1]
            assert probability[round(y / 0.05) + 25, round(x / 0.05) + 25] > 0.4
        assert probability[round(pose[1] / 0.05) + 25, round(pose[0] / 0.05) + 25] < BACKEND.config.prior
        assert probability.max() > 0.5


def test_reports_without_evidence_are_not_drawn():
    plain = map_of(report(0.05)).occupancy()
    for silent in (
        report(-0.05, touching=[0, 1], wall=(0.3, 0.0)),
        report(0.05, touching=[0, 1, 2, 3], dead=[0, 1, 2, 3], motion=MotionKind.BACK),
    ):
        assert np.array_equal(map_of(report(0.05), silent).occupancy(), plain)
    dead = [map_of(report(0.05, touching=touching, dead=[0])).occupancy() for touching in ([], [0])]
    assert np.array_equal(*dead)
    turning, numb = (
        map_of(o).occupancy() for o in (report(turn=0.1, touching=[0]), report(turn=0.1, dead=[0]))
    )
    assert np.array_equal(turning, numb)


def test_values_that_are_not_finite_are_not_drawn():
    """The map ignores the values that the filter ignores."""
    plain = report(0.05, touching=[0, 1], wall=(0.3, 0.1))
    expected = map_of(report(0.05, dead=[0, 1])).occupancy()
    odd = plain._replace(point=np.full((4, 2), np.nan))
    assert map_of(odd).occupancy() == pytest.approx(expected)
    unknown = map_of(plain._replace(wall_point=np.full(2, np.nan))).occupancy()
    assert unknown == pytest.approx(map_of(report(0.05, touching=[0, 1])).occupancy())
    at_foot = map_of(plain._replace(wall_point=np.zeros(2))).occupancy()
    assert at_foot == pytest.approx(map_of(report(0.05, touching=[0, 1])).occupancy())


def test_the_map_is_drawn_along_the_surviving_paths():
    """A particle far off that dies out leaves nothing."""
    off = np.tile([0.8, 0.8, 0.0], (COUNT, 1))
    off[2] = [-0.5, 0.0, 0.0]
    estimate, proof = steady(np.zeros(3))
    survivor = proof._replace(poses=off, ancestor=np.full(COUNT, 2, np.int32))
    grid = map_of_steps([(report(0.05, touching=[1]), estimate, survivor), (report(0.05), estimate, proof)])
    assert grid.trajectory()[0] == pytest.approx([-0.5, 0, 0])
    x, y = TIPS[1] + [-0.5, 0]
    probability = grid.occupancy()
    assert probability[round(y / 0.05) + 25, round(x / 0.05) + 25] > 0.45
    assert probability[25 + 10 :, 25 + 10 :] == pytest.approx(BACKEND.config.prior)


def test_files_hold_the_map_and_its_origin(tmp_path):
    grid = map_of(report(0.05, touching=[1, 2]))
    for name, write in grid.files().items():
        write(tmp_path / name)
    with np.load(tmp_path / "grid.npz") as stored:
        assert set(stored.files) == {"probability", "origin", "cell"}
        probability, origin, cell = stored["probability"], stored["origin"], float(stored["cell"])
    assert np.array_equal(probability, grid.occupancy())
    assert cell == 0.05
    assert origin == pytest.approx(-51 * 0.05 / 2)
    row, column = np.unravel_index(probability.argmax(), probability.shape)
    x, y = origin + (np.array([column, row]) + 0.5) * cell
    assert np.hypot(*(TIPS[1:3] - [x, y]).T).min() < 0.05


@pytest.mark.parametrize("levels", [8 * COUNT, 10**6])
@pytest.mark.parametrize("stop", [0, 1, 30])
def test_a_restored_map_continues_bit_for_bit(monkeypatch, levels, stop):
    monkeypatch.setattr(particles, "MAX_POSES", levels)
    steps = list(random_steps(50))
    whole, second = map_of_steps(steps), map_of_steps(random_steps(3, seed=7))
    second.restore({name: value.copy() for name, value in map_of_steps(steps[:stop]).arrays().items()})
    for step in steps[stop:]:
        second.update(*step)
    assert second.arrays().keys() == whole.arrays().keys()
    assert all(
        np.array_equal(value, second.arrays()[name], equal_nan=True) for name, value in whole.arrays().items()
    )
    assert np.array_equal(second.trajectory(), whole.trajectory())
    assert np.array_equal(second.occupancy(), whole.occupancy())
    assert whole.trajectory().shape == (50, 3)


def test_reading_the_map_does_not_change_it():
    steps = list(random_steps(20))
    first, second = map_of_steps(steps), BACKEND.new_map()
    for step in steps:
        second.update(*step)
        second.trajectory(), second.occupancy(), second.online_trajectory(), second.arrays()
    assert np.array_equal(first.occupancy(), second.occupancy())
    assert np.array_equal(first.trajectory(), second.trajectory())
