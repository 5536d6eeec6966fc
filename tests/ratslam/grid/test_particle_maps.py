"""Laws of the particles' maps, against NumPy and SciPy."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from ratslam.grid import particles
from ratslam.grid.particles import LAYERS

COUNT, SIDE = 3, 24

WINDOW = 16
read = jax.jit(particles.interpolate, static_argnums=1)
around = jax.jit(
    lambda place, side, size=WINDOW: particles.windows_around(place, side, size),
    static_argnums=(1, 2),
)
cut = jax.jit(
    particles.read_window,
    static_argnums=(2, 3),
)
put = jax.jit(
    particles.write_window,
    static_argnums=2,
)


def filled(side=SIDE, dtype=float, seed=0):
    return np.random.default_rng(seed).normal(size=(COUNT, LAYERS, side, side)).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("layer", range(LAYERS))
def test_cell_centres_are_read_exactly(layer, dtype):
    """Except in the last row and column, the rim, which counts as outside."""
    maps = filled(dtype=dtype)
    rows, columns = np.mgrid[: SIDE - 1, : SIDE - 1]
    cells = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(dtype)  # x first
    values = read(maps, layer, np.tile(cells, (COUNT, 1, 1)))
    assert values.dtype == dtype
    assert np.array_equal(values, maps[:, layer, :-1, :-1].reshape(COUNT, -1))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_between_cells_is_bilinear(dtype):
    maps = filled(dtype=dtype)
    place = np.random.default_rng(1).uniform(0, SIDE - 1, (COUNT, 500, 2)).astype(dtype)
    for layer in range(LAYERS):
        values = np.asarray(read(maps, layer, place))
        for k in range(COUNT):
            expected = map_coordinates(maps[k, layer].astype(float), place[k].T[::-1], order=1)
            assert values[k] == pytest.approx(expected, abs=1e-12 if dtype == np.float64 else 2e-5)


@given(st.tuples(*[st.floats(allow_nan=True, width=32)] * 2))
def test_places_outside_are_unexplored(place):
    x, y = place
    value = float(read(np.ones((1, LAYERS, SIDE, SIDE)), 0, np.array([[place]]))[0, 0])
    inside = 0 <= x < SIDE - 1 and 0 <= y < SIDE - 1
    assert value == pytest.approx(1.0 if inside else 0.0)


def test_places_are_relative_to_the_middle_of_the_map():
    point = np.array([[0.0, 0.0], [0.1, -0.05]])
    assert particles.to_cells(point, 0.05, 51) == pytest.approx(np.array([[25, 25], [27, 24]]))
    # In a map of even side the middle lies between cells.
    assert particles.to_cells(point, 0.05, 50)[0] == pytest.approx(24.5)
    maps = np.zeros((1, LAYERS, 51, 51))
    maps[0, 0, 24, 27] = 1  # row is y, column x
    assert read(maps, 0, np.asarray(particles.to_cells(point, 0.05, 51))[None])[0] == pytest.approx([0, 1])


@pytest.mark.parametrize("side", [1, 5, WINDOW - 1, WINDOW, WINDOW + 1, 40])
@pytest.mark.parametrize("size", [5, WINDOW, 22])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_windows_lie_inside_the_map_and_contain_their_place(side, size, dtype):
    stream = np.random.default_rng(side)
    near, far = (
        stream.uniform(0, side - 1, (50, 2)),
        stream.normal(0, 10.0 ** stream.uniform(0, 12, (50, 1)), (50, 2)),
    )
    size = min(size, side)
    corner = np.asarray(particles.windows_around(np.concatenate([near, far]).astype(dtype), side, size))
    assert corner.dtype == np.int32
    assert (corner >= 0).all()
    assert (corner + size <= side).all()
    # The place is in the middle, except at the rim of the map.
    left, right = near - corner[:50], corner[:50] + size - 1 - near
    room = size // 2 - 1
    assert ((left >= room) | (corner[:50] == 0)).all()
    assert ((right >= room) | (corner[:50] + size == side)).all()


@pytest.mark.parametrize("size", [6, WINDOW, SIDE])
@pytest.mark.parametrize("layer", range(LAYERS))
def test_written_windows_are_read_back_and_nothing_else_changes(size, layer):
    maps = filled()
    corner = np.asarray(around(np.random.default_rng(2).uniform(-5, SIDE + 5, (COUNT, 2)), SIDE, size))
    before = cut(maps, corner, size, layer)
    for k, (x, y) in enumerate(corner):
        assert np.array_equal(before[k], maps[k, layer, y : y + size, x : x + size])
    assert np.array_equal(put(maps, corner, layer, before), maps)
    values = np.random.default_rng(3).normal(size=before.shape)
    after = np.array(put(maps, corner, layer, values))
    assert np.array_equal(cut(after, corner, size, layer), values)
    for k, (x, y) in enumerate(corner):
        after[k, layer, y : y + size, x : x + size] = before[k]
    assert np.array_equal(after, maps)


def test_places_in_windows_are_places_in_the_map():
    maps = filled()
    place = np.random.default_rng(4).uniform(4, SIDE - 5, (COUNT, 2))
    corner = np.asarray(around(place, SIDE))
    inside = np.asarray(particles.to_window(place[:, None], corner))
    assert inside[:, 0] == pytest.approx(place - corner)
    windows = np.stack([cut(maps, corner, WINDOW, layer) for layer in range(LAYERS)], axis=1)
    for layer in range(LAYERS):
        assert read(windows, layer, inside) == pytest.approx(np.asarray(read(maps, layer, place[:, None])))
