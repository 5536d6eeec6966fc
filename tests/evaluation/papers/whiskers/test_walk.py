"""The walk over real images: which object is felt where, and that no row is given twice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.whiskers import walk_source
from evaluation.papers.whiskers.walk import continue_path, draw_energies, last_before_reversal
from robot.simulation.head.odometry_errors import OdometryConfig
from robot.world.maze import CELL_SIDE
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose, integrate, wrap

SLICE = Path(__file__).parents[3] / "data" / "real_touch" / "purdue"


def along(cells, heading=0.0, whisks=6):
    """[N, 3] poses in cells of a row, several whisks in each."""
    x = (np.repeat(cells, whisks) + 0.5) * CELL_SIDE
    return np.column_stack([x, np.full(len(x), 0.5 * CELL_SIDE), np.full(len(x), heading)])


def records_of(rows=20, things=3):
    """Records in which every row is another number."""
    number = np.arange(things * rows, dtype=float).reshape(things, rows, 1, 1)
    return [np.broadcast_to(one, (rows, 8, 16)).copy() for one in number]


def test_a_place_is_a_cell_and_a_facing():
    there = along(np.arange(40))
    back = along(np.arange(40), heading=np.pi)
    thing, later = walk_source.plan_visits(np.concatenate([there, back, there]), 10, seed=1)
    first, turned, again = thing.reshape(3, 40, 6)
    np.testing.assert_array_equal(first, again)
    assert (first == first[:, :1]).all()
    assert (turned == turned[:, :1]).all()
    assert (first != turned).mean() > 0.5
    later = later.reshape(3, -1)
    assert not later[:2].any()
    assert later[2].all()


def test_rows_come_from_the_half_of_the_visit_and_never_twice():
    random = np.random.default_rng(2)
    thing, later = random.integers(3, size=24), random.random(24) < 0.5
    number = walk_source.draw_by_place(records_of(), (thing, later), seed=3)[:, 0, 0]
    assert len(set(number)) == 24
    np.testing.assert_array_equal(number // 20, thing)
    np.testing.assert_array_equal(number % 20 >= 10, later)


def test_a_visit_ends_after_long_enough_elsewhere():
    short, long = (
        np.concatenate([along([0]), along([1], whisks=away), along([0])])
        for away in (walk_source.AWAY - 1, walk_source.AWAY)
    )
    assert not walk_source.plan_visits(short, 10, 0)[1].any()
    assert walk_source.plan_visits(long, 10, 0)[1].sum() == 6


def test_too_few_recordings_are_refused(tmp_path):
    visits = np.zeros(11, int), np.zeros(11, bool)
    assert walk_source.most_needed(visits) == 11
    with pytest.raises(InputError, match="object 0 is felt 11 times"):
        walk_source.draw_by_place(records_of(), visits, seed=0)
    for folder, named in ((tmp_path, "no CSV files"), (SLICE, "choose another seed")):
        with pytest.raises(InputError, match=named):
            walk_source.open_walk(
                walk_source.WalkConfig(folder=folder, simulation=walk_source.walk_simulation(31200))
            )
    assert walk_source.ENTRY.config_class is walk_source.WalkConfig


def test_reckoned_path_is_true_up_to_its_start():
    motion = np.random.default_rng(0).normal(size=(10, 3))
    truth = integrate(np.random.default_rng(1).normal(size=(10, 3)))
    path = continue_path(truth, motion, 3)
    np.testing.assert_array_equal(path[:4], truth[:4])
    np.testing.assert_allclose(between(path[3:-1], path[4:])[:, :2], motion[4:, :2], atol=1e-9)


def test_reversal_is_the_largest_turn_whatever_its_side_and_the_wrap():
    turns = np.zeros(40)
    turns[5:9], turns[20:27], turns[30:34] = 0.4, -0.45, 0.4
    heading = 3.0 + np.cumsum(turns)
    truth = np.column_stack([np.zeros((40, 2)), wrap(heading)])
    assert last_before_reversal(truth) == 19
    with pytest.raises(ValueError, match="empty"):
        last_before_reversal(np.zeros((5, 3)))


def there_and_back():
    """[N, 3] poses along a line and, after a turn, back; and times, s."""
    x = np.concatenate([np.arange(20), np.full(7, 19), np.arange(19, -1, -1)]) * 0.05
    heading = wrap(np.concatenate([np.zeros(20), np.arange(1, 8) * np.pi / 7, np.full(20, np.pi)]))
    return np.column_stack([x, np.zeros(len(x)), heading]), np.arange(len(x), dtype=float)


def energies_of(paths, noise, seed=3):
    truth, time = there_and_back()
    config = OdometryConfig(noise=noise)
    last = last_before_reversal(truth)
    return draw_energies(paths, truth, time, last, config, seed=seed, draws=5)


def test_drawn_energies_are_those_of_the_noise_and_of_the_path():
    truth, _ = there_and_back()
    moved = compose(np.array([2.0, -1.0, 0.7]), truth)
    bent = truth + np.linspace(0, 0.4, len(truth))[:, None] * [0, 0, 1.0]
    np.testing.assert_allclose(energies_of((truth, moved), "none"), 0, atol=1e-12)
    drawn = energies_of((truth, moved, bent), "gated")
    np.testing.assert_allclose(drawn[0], drawn[1], rtol=1e-6)
    assert (drawn[0] > 0).all()
    assert len(np.unique(drawn[0])) == 5
    assert (drawn[2] != drawn[0]).all()
    np.testing.assert_array_equal(drawn[0], energies_of((truth,), "gated")[0])
