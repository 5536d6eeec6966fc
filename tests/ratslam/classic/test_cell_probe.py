"""The probe of pose cells reads what is on the torus, whichever window level holds it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.classic.cell_probe import active_cells, activity_of, choose_cells, hold_cells
from ratslam.classic.config import NetworkConfig
from ratslam.classic.levels import Activity, Block, to_full_torus, window_levels
from tactile.base.errors import InputError

CONFIG = NetworkConfig(cells_xy=45, cells_heading=72)
SHAPE = (72, 45, 45)
LEVELS = window_levels(CONFIG, np.dtype(np.float64))
DENSE = window_levels(CONFIG.model_copy(update={"engine": "dense"}), np.dtype(np.float64))


def random_activity(levels, number):
    """Activity in every block, of which that of one level is valid, in windows over the seams."""
    random, blocks = np.random.default_rng(number), []
    for level in levels:
        cells = random.random((level.windows, *level.window.shape))
        whole = level is levels[-1]
        origin = np.zeros((1, 3)) if whole else random.integers(0, (45, 45, 72), (level.windows, 3))
        blocks.append(Block(jnp.asarray(cells), jnp.asarray(origin, jnp.int32)))
    return Activity(tuple(blocks), jnp.int32(number))


@pytest.mark.parametrize(
    ("levels", "number"), [*((LEVELS, number) for number in range(len(LEVELS))), (DENSE, 0)]
)
def test_chosen_and_all_cells_are_those_of_the_torus(levels, number):
    activity = random_activity(levels, number)
    torus = np.asarray(to_full_torus(levels, activity)).reshape(-1)
    assert len(LEVELS) == 4
    assert (torus > 0).any()
    everything = np.arange(len(torus), dtype=np.int32)
    np.testing.assert_array_equal(activity_of(levels, activity, everything), torus)
    chosen = choose_cells(50, SHAPE, seed=number)
    np.testing.assert_array_equal(activity_of(levels, activity, chosen), torus[chosen])
    held = jax.device_get(jax.jit(lambda: hold_cells(levels, activity))())
    cell, active = active_cells(levels, held)
    assert (active > 0).all()
    np.testing.assert_allclose(np.bincount(cell, active, len(torus)), torus, rtol=1e-6)


def test_no_chosen_cells_give_no_numbers():
    assert activity_of(LEVELS, random_activity(LEVELS, 0), np.zeros(0, np.int32)).shape == (0,)


def test_cells_are_drawn_by_the_seed_without_repetition():
    one, again, other = (choose_cells(64, SHAPE, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()
    assert len(np.unique(one)) == 64
    assert one.dtype == np.int32
    np.testing.assert_array_equal(choose_cells(7 * 7 * 8, (8, 7, 7), 0), np.arange(7 * 7 * 8))


def test_given_cells_keep_their_order():
    found = choose_cells(((44, 0, 0), (1, 2, 3), (0, 44, 71)), SHAPE, 0)
    heading, y, x = np.unravel_index(found, SHAPE)
    assert list(zip(x.tolist(), y.tolist(), heading.tolist(), strict=True)) == [
        (44, 0, 0),
        (1, 2, 3),
        (0, 44, 71),
    ]


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        (45 * 45 * 72 + 1, r"cells.chosen: 145801; expected at most 145800, the cells of the network"),
        (((0, 0, 0), (45, 0, 0)), r"cells.chosen.1: \[45, 0, 0\]; expected x and y below 45"),
        (((0, 0, 72),), r"cells.chosen.0: \[0, 0, 72\]; expected x and y below 45, heading below 72"),
    ],
)
def test_cells_outside_the_network_are_refused(chosen, message):
    with pytest.raises(InputError, match=message):
        choose_cells(chosen, SHAPE, 0)
