"""The walk over real images: which object is felt where, and that no row is given twice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ratslam.experiments.real.walk import reckon_from
from ratslam.experiments.real.walk_source import (
    AWAY,
    ENTRY,
    Visits,
    WalkConfig,
    draw_any,
    draw_by_place,
    most_needed,
    open_walk,
    plan_visits,
    walk_simulation,
)
from robot.recordings.whiskers.objects import ObjectRecord
from robot.world.maze import CELL_SIDE
from tactile.base.errors import InputError
from tactile.base.se2 import between, integrate

SLICE = Path(__file__).parents[3] / "data" / "real_touch" / "purdue"


def along(cells, heading=0.0, whisks=6):
    """[N, 3] poses in cells of a row, several whisks in each."""
    x = (np.repeat(cells, whisks) + 0.5) * CELL_SIDE
    return np.column_stack([x, np.full(len(x), 0.5 * CELL_SIDE), np.full(len(x), heading)])


def records_of(rows=20, things=3):
    """Records in which every row is another number."""
    number = np.arange(things * rows, dtype=float).reshape(things, rows, 1, 1)
    return [ObjectRecord(np.broadcast_to(one, (rows, 8, 16)).copy(), "") for one in number]


def test_a_place_is_a_cell_and_a_facing():
    there = along(np.arange(40))
    back = along(np.arange(40), heading=np.pi)
    visits = plan_visits(np.concatenate([there, back, there]), 10, seed=1)
    first, turned, again = visits.thing.reshape(3, 40, 6)
    np.testing.assert_array_equal(first, again)
    assert (first == first[:, :1]).all()
    assert (turned == turned[:, :1]).all()
    assert (first != turned).mean() > 0.5
    later = visits.later.reshape(3, -1)
    assert not later[:2].any()
    assert later[2].all()


def test_a_visit_ends_after_long_enough_elsewhere():
    short = np.concatenate([along([0]), along([1], whisks=AWAY - 1), along([0])])
    long = np.concatenate([along([0]), along([1], whisks=AWAY), along([0])])
    assert not plan_visits(short, 10, 0).later.any()
    assert plan_visits(long, 10, 0).later.sum() == 6


def test_rows_come_from_the_half_of_the_visit_and_never_twice():
    random = np.random.default_rng(2)
    visits = Visits(random.integers(3, size=24), random.random(24) < 0.5)
    number = draw_by_place(records_of(), visits, seed=3)[:, 0, 0]
    assert len(set(number)) == 24
    np.testing.assert_array_equal(number // 20, visits.thing)
    np.testing.assert_array_equal(number % 20 >= 10, visits.later)
    assert len(set(draw_any(records_of(), visits, seed=3)[:, 0, 0])) == 24


def test_object_that_is_needed_too_often():
    visits = Visits(np.zeros(11, int), np.zeros(11, bool))
    assert most_needed(visits) == 11
    with pytest.raises(InputError, match="object 0 is felt 11 times in first visits"):
        draw_by_place(records_of(), visits, seed=0)


def test_reckoned_path_is_true_up_to_its_start():
    motion = np.random.default_rng(0).normal(size=(10, 3))
    truth = integrate(np.random.default_rng(1).normal(size=(10, 3)))
    path = reckon_from(truth, motion, 4)
    np.testing.assert_array_equal(path[:4], truth[:4])
    np.testing.assert_allclose(between(path[3:-1], path[4:])[:, :2], motion[4:, :2], atol=1e-9)


def test_folder_without_recordings(tmp_path):
    with pytest.raises(InputError, match="no CSV files"):
        open_walk(WalkConfig(folder=tmp_path, simulation=walk_simulation(31200)))


def test_slice_is_too_short_for_a_walk():
    with pytest.raises(InputError, match="choose another seed"):
        open_walk(WalkConfig(folder=SLICE, simulation=walk_simulation(31200)))
    assert ENTRY.config_class is WalkConfig


def test_walk_over_the_whole_recording(reference_data):
    folder = reference_data / "real_touch" / "actuated_whisker_purdue" / "data" / "objCls"
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}")
    config = WalkConfig(folder=folder, simulation=walk_simulation(31201), seed=31201)
    walk, shuffled = open_walk(config), open_walk(config.model_copy(update={"shuffled": True}))
    assert walk.view_shape == (1, 8, 16)
    assert walk.info.signed_views
    assert 500 < walk.length < 800
    np.testing.assert_array_equal(walk.truth, shuffled.truth)
    assert walk.digest != shuffled.digest
    assert not np.array_equal(walk.views, shuffled.views)
