"""Laws of the genealogy: the mean path, and its independence of the bound on memory."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.grid import particles
from ratslam.grid.particles import Genealogy
from tactile.base.se2 import wrap

COUNT = 6


def reports(count, *, every=1, seed=0):
    """Poses, shares and ancestors of random particles; all descend from few at every `every`-th report."""
    stream = np.random.default_rng(seed)
    for k in range(count):
        ancestor = np.sort(stream.integers(0, COUNT, COUNT)) if k % every == every - 1 else np.arange(COUNT)
        pose = np.array([k, 0, 0]) + stream.normal(0, [1, 1, 0.05], (COUNT, 3))
        yield pose, stream.dirichlet(np.ones(COUNT)), ancestor


def genealogy_of(rows, count=COUNT):
    tree = Genealogy(count)
    for row in rows:
        tree.append(*row)
    return tree


def by_copying(rows):
    """The weighted mean of whole paths, copied at every resampling as in Algorithm 1."""
    paths, weights = [[] for _ in range(COUNT)], np.full(COUNT, 1 / COUNT)
    ancestor = np.arange(COUNT)
    for pose, share, after in rows:
        paths = [[*paths[ancestor[n]], pose[n]] for n in range(COUNT)]
        weights, ancestor = share, after
    return np.einsum("n,ntc->tc", weights, np.array(paths).reshape(COUNT, -1, 3))


def assert_same(path, expected):
    """The headings are so close that all kinds of mean agree within the tolerance."""
    assert path.shape == expected.shape
    assert path[:, :2] == pytest.approx(expected[:, :2])
    assert path[:, 2] == pytest.approx(expected[:, 2], abs=1e-3)


@pytest.mark.parametrize("count", [0, 1, 2, 17, 40])
@pytest.mark.parametrize("every", [1, 7])
def test_the_path_is_that_of_the_ancestors(count, every):
    rows = list(reports(count, every=every))
    tree = genealogy_of(rows)
    assert len(tree) == count
    assert_same(tree.path(), by_copying(rows))


def test_paths_of_extinct_particles_have_no_effect():
    stream = np.random.default_rng(0)
    first, second = stream.normal(0, 0.1, (2, COUNT, 3))
    ancestor = np.array([3] * COUNT)
    path = genealogy_of(
        [(first, np.full(COUNT, 1 / COUNT), ancestor), (second, np.full(COUNT, 1 / COUNT), ancestor)]
    ).path()
    assert path[0] == pytest.approx(first[3])
    assert path[1, :2] == pytest.approx(second[:, :2].mean(axis=0))  # resampled only after this report


def test_the_path_changes_with_later_weights():
    """Two particles at opposite sides; the weights of the last report select one of them."""
    left, right = np.array([[-1.0, 0, 0], [1.0, 0, 0]]), np.array([[-2.0, 0, 0], [2.0, 0, 0]])
    same = np.arange(2)
    half = (left, np.array([0.5, 0.5]), same)
    assert genealogy_of([half], 2).path()[0, 0] == 0
    assert genealogy_of([half, (right, np.array([0.0, 1.0]), same)], 2).path()[:, 0] == pytest.approx([1, 2])


@pytest.mark.parametrize("levels", [1, 5 * COUNT, 40 * COUNT])
def test_memory_is_bounded_and_settled_paths_stay(monkeypatch, levels):
    """Settling is exact if all particles descend from one, as they soon do."""
    stream = np.random.default_rng(1)
    rows = []
    for pose, share, _ in reports(200):
        rows.append((pose, share, np.full(COUNT, stream.integers(0, COUNT))))
    whole = genealogy_of(rows).path()
    monkeypatch.setattr(particles, "MAX_POSES", levels)
    tree = genealogy_of(rows)
    assert len(tree) == 200
    assert tree.arrays()["pose"].size // 3 <= max(levels, COUNT)
    assert tree.path() == pytest.approx(whole)
    assert_same(whole, by_copying(rows))


def test_poses_beyond_the_bound_are_weighted_means(monkeypatch):
    monkeypatch.setattr(particles, "MAX_POSES", 20 * COUNT)
    rows = list(reports(60, every=9))
    assert np.abs(genealogy_of(rows).path() - by_copying(rows)).max() < 2


def test_headings_are_averaged_on_the_circle():
    """The mean equals that of the filter, in any order of the particles."""
    share = np.full(COUNT, 1 / COUNT)
    for heading in ([3.1, 3.2, 3.3, -3.1, -3.0, 3.14], [0.0, 1.0, 2.0, 3.0, -1.5, -0.4]):
        expected = np.angle(share @ np.exp(1j * np.array(heading)))
        for turned in range(COUNT):
            pose = np.zeros((COUNT, 3))
            pose[:, 2] = np.roll(heading, turned)
            found = genealogy_of([(pose, share, np.arange(COUNT))]).path()[0, 2]
            assert wrap(found - expected) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("levels", [5 * COUNT, 10**6])
def test_a_restored_genealogy_continues_bit_for_bit(monkeypatch, levels):
    monkeypatch.setattr(particles, "MAX_POSES", levels)
    rows = list(reports(80, every=3))
    whole = genealogy_of(rows)
    for stop in (0, 1, 16, 43):
        second = genealogy_of(list(reports(5, seed=9)))
        second.restore(genealogy_of(rows[:stop]).arrays())
        for row in rows[stop:]:
            second.append(*row)
        assert np.array_equal(second.path(), whole.path())
        assert all(np.array_equal(value, second.arrays()[name]) for name, value in whole.arrays().items())
