"""Arenas, their true grids and noisy maps of them."""

from __future__ import annotations

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

from evaluation.metrics.occupancy_grid import (
    PRIOR_OCCUPANCY,
    GridTruth,
    OccupancyGrid,
    touchable_surface,
)
from evaluation.metrics.occupancy_score import Convention, grid_error

law = settings(max_examples=25)
CELL = 0.05
ARENA = Convention(mask="arena")
CHAMFER = ("map_chamfer_map", "map_chamfer_walls")
SCORES = ("map_brier_skill", "map_auc", "map_log_loss", *CHAMFER)


def box(west, south, east, north):
    """Its four sides as segments."""
    corner = np.array([[west, south], [east, south], [east, north], [west, north]])
    return np.hstack([corner, np.roll(corner, -1, axis=0)])


def scene(boxes=((5, 5, 8, 8), (13, 12, 16, 15)), side=20, margin=6, cell=CELL):
    """A square arena with boxes in it (west, south, east, north, cells), all on the borders of cells."""
    size = side + 2 * margin
    occupied, inside = np.zeros((size, size), bool), np.zeros((size, size), bool)
    inside[margin:-margin, margin:-margin] = True
    walls = [box(0, 0, side, side)]
    for west, south, east, north in boxes:
        occupied[margin + south : margin + north, margin + west : margin + east] = True
        walls.append(box(west, south, east, north))
    empty = OccupancyGrid(np.full((size, size), PRIOR_OCCUPANCY), np.full(2, -margin * cell), cell)
    return empty, GridTruth(occupied, inside, np.concatenate(walls) * cell)


def true_grid(grid, truth, outside=PRIOR_OCCUPANCY):
    """The truth as a map on the cells of another map: the best possible map."""
    return grid._replace(probability=truth.occupancy(touchable_surface(grid, truth).wall, outside))


@st.composite
def scenes(draw):
    """Arenas with up to three boxes that neither overlap nor touch the wall."""
    lengths = st.integers(1, 4)
    boxes = [
        (x + dx, y + dy, x + dx + draw(lengths), y + dy + draw(lengths))
        for x, y in ((2, 2), (11, 3), (6, 11))[: draw(st.integers(0, 3))]
        for dx, dy in [draw(st.tuples(st.integers(0, 3), st.integers(0, 3)))]
    ]
    return scene(boxes)


def noisy(empty, seed):
    """A map with random values in all cells, hidden ones included."""
    random = np.random.default_rng(seed)
    shape = empty.probability.shape
    return empty._replace(
        probability=np.where(random.random(shape) < 0.3, PRIOR_OCCUPANCY, random.random(shape))
    )


def values(score):
    return {name: quantity.value for name, quantity in score.quantities.items()}


def error(grid, truth, convention):
    return grid_error(grid, truth, touchable_surface(grid, truth), convention)


seeds = st.integers(0, 2**32)
