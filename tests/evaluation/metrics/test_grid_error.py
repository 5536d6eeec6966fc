"""Metrics of occupancy maps: properties that hold in any arena, constant maps, chamfer distances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.metrics.occupancy_grid import (
    PRIOR_OCCUPANCY,
    GridTruth,
    OccupancyGrid,
    cell_centres,
    mean_grid,
    touchable_surface,
)
from evaluation.metrics.occupancy_score import (
    CLAMP,
    CONVENTIONS,
    MAIN_CONVENTION,
    score_grid,
    smooth_truth,
)
from tests.evaluation.metrics.grid_scenes import (
    ARENA,
    CELL,
    CHAMFER,
    box,
    error,
    law,
    noisy,
    scene,
    scenes,
    seeds,
    true_grid,
    values,
)

constants = st.floats(0, 1).map(lambda value: round(value, 6))
conventions = st.sampled_from(CONVENTIONS)


def test_there_are_twelve_different_conventions():
    assert len(set(CONVENTIONS)) == len(CONVENTIONS) == 12
    assert {MAIN_CONVENTION, ARENA} < set(CONVENTIONS)


@law
@given(scenes(), conventions)
def test_a_random_map_has_an_error_of_one_half(scene, convention):
    empty, truth = scene
    assert error(empty, truth, convention).coin == pytest.approx(0.5, abs=1e-12)
    random = np.random.default_rng(0)
    shape = empty.probability.shape
    thrown = [
        error(empty._replace(probability=(random.random(shape) < 0.5) * 1.0), truth, convention).error
        for _ in range(20)
    ]
    # a coin differs from its mean by at most half a cell's error: 5 sd of the mean of 20 maps of >= 400 cells
    assert abs(np.mean(thrown) - 0.5) < 5 * 0.5 / np.sqrt(20 * 400)


@law
@given(scenes())
def test_a_perfect_map_has_the_best_scores(scene):
    empty, truth = scene
    for convention in CONVENTIONS:
        grid = true_grid(empty, truth, convention.outside)
        found = error(grid, truth, convention)
        if not convention.smooth:
            assert found.error == 0
            assert found.skill == 1
        else:  # but not if the truth is smoothed: a blurred map is better
            assert found.error > 0
            blurred = grid._replace(probability=smooth_truth(grid.probability))
            assert error(blurred, truth, convention).error == pytest.approx(0, abs=1e-12)
    found = values(score_grid(true_grid(empty, truth), truth))
    assert found["map_brier"] == 0
    assert found["map_brier_skill"] == found["map_auc"] == 1
    assert found["map_log_loss"] == pytest.approx(-np.log(1 - CLAMP))
    assert found["map_chamfer_map"] <= 0.55 * CELL  # half a cell, and the cells beyond the corners
    assert found["map_chamfer_walls"] <= CELL * np.sqrt(0.5)


@law
@given(scenes(), constants, conventions)
def test_the_best_constant_is_the_best_constant_map(scene, value, convention):
    empty, truth = scene
    constant = empty._replace(probability=np.full_like(empty.probability, value))
    found = error(constant, truth, convention)
    assert found.best <= found.prior + 1e-12
    assert found.best <= found.error + 1e-12
    assert found.skill is None or found.skill <= 1e-12
    assert error(empty, truth, convention).error == pytest.approx(found.prior)


@law
@given(scenes(), constants)
def test_a_constant_map_has_no_skill(scene, value):
    empty, truth = scene
    score = score_grid(empty._replace(probability=np.full_like(empty.probability, value)), truth)
    found = values(score)
    assert found["map_auc"] == found["map_auc_free"] == 0.5
    assert found["map_brier_skill"] <= 1e-12
    assert found["map_log_loss"] >= found["map_log_loss_constant"] - 1e-12
    for name in CHAMFER:
        assert (found[name] is None) == (value <= 0.5)
        assert found[name] is not None or score.quantities[name].note == "no cell above 0.5"


@law
@given(scenes(), seeds)
def test_scores_are_invariant_to_mirroring(scene, seed):
    empty, truth = scene
    grid = noisy(empty, seed)
    middle = 2 * empty.origin[0] + len(empty.probability) * CELL
    mirrored = truth.segments * [-1, 1, -1, 1] + [middle, 0, middle, 0]
    other = GridTruth(truth.occupied[:, ::-1], truth.inside[:, ::-1], mirrored)
    ours, theirs = (
        score_grid(grid, truth),
        score_grid(grid._replace(probability=grid.probability[:, ::-1]), other),
    )
    assert values(theirs) == pytest.approx(values(ours))
    for a, b in zip(ours.errors, theirs.errors, strict=True):
        assert (b.error, b.best, b.prior) == pytest.approx((a.error, a.best, a.prior))


@law
@given(scenes(), seeds, st.integers(-3, 3), st.integers(-3, 3))
def test_scores_are_invariant_to_shifts_by_whole_cells(scene, seed, across, up):
    empty, truth = scene
    grid = noisy(empty, seed)
    grid.probability[~np.pad(np.ones((26, 26), bool), 3)] = (
        PRIOR_OCCUPANCY  # the shift moves no wall out of the map
    )

    def rolled(cells):
        return np.roll(cells, (up, across), axis=(0, 1))

    moved = GridTruth(
        rolled(truth.occupied), rolled(truth.inside), truth.segments + CELL * np.tile([across, up], 2)
    )
    ours = score_grid(grid, truth)
    cells = score_grid(grid._replace(probability=rolled(grid.probability)), moved)
    frame = score_grid(
        grid._replace(origin=grid.origin + CELL * np.array([across, up])),
        truth._replace(segments=moved.segments),
    )
    for other in (cells, frame):
        assert values(other) == pytest.approx(values(ours))
        assert [e.error for e in other.errors] == pytest.approx([e.error for e in ours.errors])


@law
@given(scenes(), st.sampled_from([(0, 1), (1, 0), (-2, 1), (3, 3)]))
def test_a_displaced_map_is_worse(scene, by):
    empty, truth = scene
    perfect = true_grid(empty, truth)
    moved = perfect._replace(probability=np.roll(perfect.probability, by, axis=(0, 1)))
    assert error(moved, truth, MAIN_CONVENTION).error > 0
    right, wrong = values(score_grid(perfect, truth)), values(score_grid(moved, truth))
    assert wrong["map_auc"] < right["map_auc"]
    assert wrong["map_brier_skill"] < right["map_brier_skill"]
    for name in CHAMFER:
        assert wrong[name] > right[name]


@law
@given(scenes(), seeds)
def test_auc_is_the_share_of_ordered_pairs(scene, seed):
    empty, truth = scene
    grid, surface = noisy(empty, seed), touchable_surface(empty, truth)
    walls, free = grid.probability[surface.wall][:, None], grid.probability[surface.free]
    pairs = (walls > free) + 0.5 * (walls == free)
    auc = values(score_grid(grid, truth))["map_auc"]
    assert auc == pytest.approx(pairs.mean(), abs=1e-4)
    inverse = grid._replace(probability=1 - grid.probability)
    assert values(score_grid(inverse, truth))["map_auc"] == pytest.approx(1 - auc)
    steeper = grid._replace(probability=grid.probability**2)
    assert values(score_grid(steeper, truth))["map_auc"] == pytest.approx(auc, abs=1e-4)


@law
@given(scenes(), seeds)
def test_hidden_cells_do_not_count(scene, seed):
    empty, truth = scene
    grid, surface = noisy(empty, seed), touchable_surface(empty, truth)
    hidden = ~(surface.free | surface.wall)
    deep = truth.occupied & ~surface.wall
    guessed = grid._replace(
        probability=np.where(hidden, np.where(truth.occupied, 1.0, PRIOR_OCCUPANCY), grid.probability)
    )
    drawn = grid._replace(probability=np.where(deep, 1.0, grid.probability))
    ours = values(score_grid(grid, truth))
    theirs = values(score_grid(guessed, truth))
    assert {n: v for n, v in theirs.items() if n not in CHAMFER} == {
        n: v for n, v in ours.items() if n not in CHAMFER
    }
    assert values(score_grid(drawn, truth)) == ours


@law
@given(scenes(), seeds)
def test_occupancy_beyond_the_outer_wall_has_no_effect(scene, seed):
    empty, truth = scene
    grid = noisy(empty, seed)
    filled = truth._replace(occupied=truth.occupied | ~truth.inside)
    assert score_grid(grid, filled) == score_grid(grid, truth)


def test_one_cell_or_all_cells_minimise_only_one_chamfer_distance():
    empty, truth = scene()
    surface = touchable_surface(empty, truth)
    one = empty.probability.copy()
    one[tuple(np.argwhere(surface.wall)[0])] = 0.9
    to_walls, to_map = (values(score_grid(empty._replace(probability=one), truth))[name] for name in CHAMFER)
    assert to_walls < CELL < 0.3 < to_map
    everything = empty._replace(probability=np.ones_like(one))
    to_walls, to_map = (values(score_grid(everything, truth))[name] for name in CHAMFER)
    assert to_map < CELL < 0.1 < to_walls


def test_false_walls_outside_are_penalised():
    empty, truth = scene()
    perfect = true_grid(empty, truth)
    lost = perfect.probability.copy()
    lost[0, :] = 1.0
    found = score_grid(perfect._replace(probability=lost), truth)
    assert values(found)["map_chamfer_map"] > values(score_grid(perfect, truth))["map_chamfer_map"] + 0.02
    assert found.under(MAIN_CONVENTION).error > 0
    assert found.under(ARENA).error == 0


def test_an_empty_map_has_no_chamfer_distance():
    score = score_grid(*scene())
    assert [values(score)[name] for name in CHAMFER] == [None, None]


@law
@given(scenes(), seeds)
def test_free_space_scores_are_of_the_map_clipped_at_its_prior(scene, seed):
    empty, truth = scene
    grid = noisy(empty, seed)
    blunt = grid._replace(probability=np.minimum(grid.probability, PRIOR_OCCUPANCY))
    ours, theirs = values(score_grid(grid, truth)), values(score_grid(blunt, truth))
    for name in ("map_auc", "map_brier_skill"):
        assert ours[f"{name}_free"] == theirs[f"{name}_free"] == theirs[name]


def test_log_loss_of_certain_errors_is_finite():
    empty, truth = scene()
    surface = touchable_surface(empty, truth)
    wrong = empty._replace(probability=np.where(surface.wall, 0.0, 1.0))
    found = values(score_grid(wrong, truth))
    assert found["map_log_loss"] == pytest.approx(-np.log(CLAMP))
    assert found["map_auc"] == 0
    assert found["map_brier"] == 1


@pytest.mark.parametrize("offset", [0.0, 0.25, 0.5, 0.75])
@pytest.mark.parametrize("cell", [0.05, 0.025])
def test_a_wall_is_one_cell_thick_at_any_offset(offset, cell):
    """A wall without thickness, `offset` cells beyond a border, is one ring of cells that are not free."""
    side, margin = 20, 6
    low, high = -offset * cell, (side + offset) * cell
    grid = OccupancyGrid(np.full((side + 2 * margin,) * 2, PRIOR_OCCUPANCY), np.full(2, -margin * cell), cell)
    inside = ((cell_centres(grid) > low + 1e-9) & (cell_centres(grid) < high - 1e-9)).all(axis=-1)
    surface = touchable_surface(grid, GridTruth(np.zeros_like(inside), inside, box(low, low, high, high)))
    across = int(inside.any(axis=0).sum())
    assert surface.wall.sum() - 4 * across in (0, 4)  # the cells beyond the corners may be too far off
    assert not (surface.wall & inside).any()


def test_only_surfaces_that_face_free_space_count():
    # its west side touches the wall, and it is large enough for inner cells
    empty, truth = scene([(0, 6, 5, 12)])
    surface = touchable_surface(empty, truth)
    points = surface.points / CELL
    assert not (np.isclose(points[:, 0], 0) & (points[:, 1] > 6) & (points[:, 1] < 12)).any()
    assert (np.isclose(points[:, 0], 5) & (points[:, 1] > 6) & (points[:, 1] < 12)).sum() == 30
    block = surface.wall[6 + 6 : 6 + 12, 6:11]
    assert block[0].all()
    assert block[-1].all()
    assert block[:, -1].all()
    assert not block[1:-1, :-1].any()
    assert not surface.wall[6 + 7 : 6 + 11, 5].any()  # the ring behind it is out of reach
    assert truth.occupancy(surface.wall)[6 + 8, 7] == 1


def test_rotated_objects_have_a_closed_surface():
    empty, truth = scene([])
    turn, middle = 0.4, 10 * CELL
    c, s = np.cos(turn), np.sin(turn)
    away = cell_centres(empty) - middle
    along = np.stack([c * away[..., 0] + s * away[..., 1], c * away[..., 1] - s * away[..., 0]], axis=-1)
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.15 @ np.array([[c, s], [-s, c]]) + middle
    sides = np.hstack([corner, np.roll(corner, -1, axis=0)])
    truth = truth._replace(
        occupied=(np.abs(along) < 0.15).all(axis=-1), segments=np.vstack([truth.segments, sides])
    )
    surface = touchable_surface(empty, truth)
    depth = 0.15 - np.abs(along).max(axis=-1)
    skin = surface.wall & truth.inside
    assert (skin == (truth.occupied & (depth < CELL)))[np.abs(depth - CELL) > 1e-3].all()
    found = values(score_grid(true_grid(empty, truth), truth))
    assert found["map_brier_skill"] == found["map_auc"] == 1
    assert max(found[name] for name in CHAMFER) < 0.6 * CELL


def test_invalid_maps_are_refused():
    empty, truth = scene()
    for bad in (np.nan, -0.1, 1.1):
        broken = empty.probability.copy()
        broken[3, 4] = bad
        with pytest.raises(ValueError, match="probabilities"):
            score_grid(empty._replace(probability=broken), truth)
    with pytest.raises(ValueError, match="cells"):
        score_grid(empty._replace(probability=np.zeros((3, 3))), truth)
    with pytest.raises(ValueError, match="shape"):
        score_grid(empty._replace(probability=np.zeros(3)), truth)
    with pytest.raises(ValueError, match="cell 0"):
        score_grid(empty._replace(cell=0.0), truth)
    with pytest.raises(ValueError, match="segments"):
        score_grid(empty, truth._replace(segments=np.full((1, 4), np.nan)))
    for other in (empty._replace(cell=0.1), empty._replace(origin=empty.origin + 1)):
        with pytest.raises(ValueError, match="expected the same shape"):
            mean_grid([empty, other])
