"""Metrics of occupancy maps: laws that hold in any arena, known maps, chamfer distances, several trials."""

from statistics import stdev

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.metrics import occupancy_grid, occupancy_score
from evaluation.metrics.occupancy_grid import PRIOR_OCCUPANCY, GridTruth, OccupancyGrid, touchable_surface
from evaluation.metrics.occupancy_score import CLAMP, CONVENTIONS, MAIN_CONVENTION, pool_grids, score_grid

law = settings(max_examples=15)
CELL = 0.05
ARENA = occupancy_score.Convention(mask="arena")
CHAMFER = ("map_chamfer_map", "map_chamfer_walls")
MAPPERS = ("blob", "geometric", "template")
seeds, constants = st.integers(0, 2**32), st.floats(0, 1).map(lambda value: round(value, 6))


def box(west, south, east, north):
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


def true_grid(grid, truth, outside=PRIOR_OCCUPANCY):
    return grid._replace(probability=truth.occupancy(touchable_surface(grid, truth).wall, outside))


def filled(grid, value):
    return grid._replace(probability=np.full(grid.probability.shape, float(value)))


def noisy(empty, seed):
    random, shape = np.random.default_rng(seed), empty.probability.shape
    known = random.random(shape) >= 0.3
    return empty._replace(probability=np.where(known, random.random(shape), PRIOR_OCCUPANCY))


def values(score):
    return {name: quantity.value for name, quantity in score.quantities.items()}


def error(grid, truth, convention):
    return occupancy_score.grid_error(grid, truth, touchable_surface(grid, truth), convention)


def test_a_known_map_has_known_scores():
    empty, truth = scene()
    score = score_grid(noisy(empty, 3), truth)
    assert (len(set(CONVENTIONS)), len(occupancy_score.DISTINCT_CONVENTIONS)) == (12, 10)
    assert {MAIN_CONVENTION, ARENA} < set(CONVENTIONS)
    found = [[getattr(one, part) for one in score.errors] for part in ("error", "prior", "best")]
    known = [
        [0.3305, 0.4499, 0.5050, 0.4523, 0.4523, 0.4523, 0.2666, 0.3584, 0.4354, 0.3101, 0.3155, 0.3296],
        [0.1816, 0.3398, 0.5508, 0.3843, 0.3843, 0.3843, 0.0968, 0.2043, 0.4617, 0.1640, 0.1678, 0.2234],
        [0.1816, 0.0996, 0.3730, 0.2107, 0.2107, 0.2107, 0.0968, 0.0993, 0.3563, 0.1296, 0.1003, 0.1982],
    ]
    np.testing.assert_allclose(found, known, atol=1e-4)
    known = [0.2770, -0.6847, -0.0597, 0.8475, 0.5106, 0.5098, 0.4946, 0.1472, 0.0411]
    assert list(values(score).values()) == pytest.approx(known, abs=1e-4)


@law
@given(scenes(), st.sampled_from(CONVENTIONS), constants)
def test_constant_and_random_maps_have_no_skill(scene, convention, value):
    empty, truth = scene
    found = error(filled(empty, value), truth, convention)
    assert found.coin == pytest.approx(0.5, abs=1e-12)
    assert found.best <= min(found.prior, found.error) + 1e-12
    assert found.skill is None or found.skill <= 1e-12
    assert error(empty, truth, convention).error == pytest.approx(found.prior)
    score = score_grid(filled(empty, value), truth)
    found = values(score)
    assert found["map_auc"] == found["map_auc_free"] == 0.5
    assert found["map_brier_skill"] <= 1e-12
    assert found["map_log_loss"] >= found["map_log_loss_constant"] - 1e-12
    for name in CHAMFER:
        assert (found[name] is None) == (value <= 0.5)
        assert found[name] is not None or score.quantities[name].note == "no cell above 0.5"


@law
@given(scenes(), st.sampled_from([(0, 1), (1, 0), (-2, 1), (3, 3)]))
def test_a_perfect_map_has_the_best_scores_and_a_displaced_one_worse(scene, by):
    empty, truth = scene
    for convention in CONVENTIONS:
        grid = true_grid(empty, truth, convention.outside)
        found = error(grid, truth, convention)
        if not convention.smooth:
            assert (found.error, found.skill) == (0, 1)
        else:  # but not if the truth is smoothed: a blurred map is better
            assert found.error > 0
            blurred = grid._replace(probability=occupancy_score.smooth_truth(grid.probability))
            assert error(blurred, truth, convention).error == pytest.approx(0, abs=1e-12)
    perfect = true_grid(empty, truth)
    moved = perfect._replace(probability=np.roll(perfect.probability, by, axis=(0, 1)))
    right, wrong = values(score_grid(perfect, truth)), values(score_grid(moved, truth))
    assert right["map_brier"] == 0
    assert right["map_brier_skill"] == right["map_auc"] == 1
    assert right["map_log_loss"] == pytest.approx(-np.log(1 - CLAMP))
    assert right["map_chamfer_map"] <= 0.55 * CELL  # half a cell, and the cells beyond the corners
    assert right["map_chamfer_walls"] <= CELL * np.sqrt(0.5)
    assert error(moved, truth, MAIN_CONVENTION).error > 0
    for name in ("map_auc", "map_brier_skill"):
        assert wrong[name] < right[name]
    for name in CHAMFER:
        assert wrong[name] > right[name]


@law
@given(scenes(), seeds)
def test_auc_is_the_share_of_ordered_pairs(scene, seed):
    empty, truth = scene
    grid, surface = noisy(empty, seed), touchable_surface(empty, truth)
    walls, free = grid.probability[surface.wall][:, None], grid.probability[surface.free]
    pairs = (walls > free) + 0.5 * (walls == free)
    found = values(score_grid(grid, truth))
    assert found["map_auc"] == pytest.approx(pairs.mean(), abs=1e-4)
    inverse = grid._replace(probability=1 - grid.probability)
    assert values(score_grid(inverse, truth))["map_auc"] == pytest.approx(1 - found["map_auc"])
    clipped = grid._replace(probability=np.minimum(grid.probability, PRIOR_OCCUPANCY))
    blunt = values(score_grid(clipped, truth))
    for name in ("map_auc", "map_brier_skill"):  # with free space alone: clipped at the prior
        assert found[f"{name}_free"] == blunt[f"{name}_free"] == blunt[name]


@law
@given(scenes(), seeds)
def test_hidden_cells_and_the_truth_beyond_the_outer_wall_do_not_count(scene, seed):
    empty, truth = scene
    grid, surface = noisy(empty, seed), touchable_surface(empty, truth)
    ours = score_grid(grid, truth)
    guess = np.where(truth.occupied, 1.0, PRIOR_OCCUPANCY)
    seen = surface.free | surface.wall
    theirs = values(score_grid(grid._replace(probability=np.where(seen, grid.probability, guess)), truth))
    assert all(theirs[name] == value for name, value in values(ours).items() if name not in CHAMFER)
    deep = truth.occupied & ~surface.wall
    drawn = grid._replace(probability=np.where(deep, 1.0, grid.probability))
    assert values(score_grid(drawn, truth)) == values(ours)
    assert score_grid(grid, truth._replace(occupied=truth.occupied | ~truth.inside)) == ours


def test_false_walls_are_penalised_and_certain_errors_finite():
    empty, truth = scene()
    perfect = true_grid(empty, truth)
    lost = perfect.probability.copy()
    lost[0, :] = 1.0
    found = score_grid(perfect._replace(probability=lost), truth)
    assert values(found)["map_chamfer_map"] > values(score_grid(perfect, truth))["map_chamfer_map"] + 0.02
    assert found.under(MAIN_CONVENTION).error > 0
    assert found.under(ARENA).error == 0
    wrong = empty._replace(probability=np.where(touchable_surface(empty, truth).wall, 0.0, 1.0))
    found = values(score_grid(wrong, truth))
    assert found["map_log_loss"] == pytest.approx(-np.log(CLAMP))
    assert (found["map_auc"], found["map_brier"]) == (0, 1)


@pytest.mark.parametrize("offset", [0.0, 0.25, 0.5, 0.75])
@pytest.mark.parametrize("cell", [0.05, 0.025])
def test_a_wall_is_one_cell_thick_at_any_offset(offset, cell):
    """A wall without thickness, `offset` cells beyond a border, is one ring of cells that are not free."""
    side, margin = 20, 6
    low, high = -offset * cell, (side + offset) * cell
    grid = OccupancyGrid(np.full((side + 2 * margin,) * 2, PRIOR_OCCUPANCY), np.full(2, -margin * cell), cell)
    inside = (
        (occupancy_grid.cell_centres(grid) > low + 1e-9) & (occupancy_grid.cell_centres(grid) < high - 1e-9)
    ).all(axis=-1)
    surface = touchable_surface(grid, GridTruth(np.zeros_like(inside), inside, box(low, low, high, high)))
    across = int(inside.any(axis=0).sum())
    assert surface.wall.sum() - 4 * across in (0, 4)  # the cells beyond the corners may be too far off
    assert not (surface.wall & inside).any()


def test_only_surfaces_that_face_free_space_count():
    # its west side touches the wall, and it is large enough for inner cells
    empty, truth = scene([(0, 6, 5, 12)])
    surface = touchable_surface(empty, truth)
    x, y = surface.points.T / CELL
    beside = (y > 6) & (y < 12)
    assert [(np.isclose(x, side) & beside).sum() for side in (0, 5)] == [0, 30]
    block = surface.wall[6 + 6 : 6 + 12, 6:11]
    assert np.concatenate([block[0], block[-1], block[:, -1]]).all()
    assert not block[1:-1, :-1].any()
    assert not surface.wall[6 + 7 : 6 + 11, 5].any()  # the ring behind it is out of reach
    assert truth.occupancy(surface.wall)[6 + 8, 7] == 1


def test_invalid_maps_are_refused():
    empty, truth = scene()
    for grid, world, message in (
        *((filled(empty, bad), truth, "probabilities") for bad in (np.nan, -0.1, 1.1)),
        (empty._replace(probability=np.zeros((3, 3))), truth, "cells"),
        (empty._replace(probability=np.zeros(3)), truth, "shape"),
        (empty._replace(cell=0.0), truth, "cell 0"),
        (empty, truth._replace(segments=np.full((1, 4), np.nan)), "segments"),
    ):
        with pytest.raises(ValueError, match=message):
            score_grid(grid, world)
    for other in (empty._replace(cell=0.1), empty._replace(origin=empty.origin + 1)):
        with pytest.raises(ValueError, match="expected the same shape"):
            occupancy_grid.mean_grid([empty, other])


@law
@given(scenes(), st.lists(seeds, min_size=1, max_size=4))
def test_a_pool_is_the_mean_of_its_trials(scene, several):
    empty, truth = scene
    scores = [score_grid(noisy(empty, seed), truth) for seed in several]
    pooled = pool_grids(scores, "all")
    assert pooled.trials == len(scores)
    for found, each in zip(pooled.errors, zip(*(s.errors for s in scores), strict=True), strict=True):
        assert found.error == pytest.approx(np.mean([e.error for e in each]))
        assert (found.prior, found.best) == pytest.approx((each[0].prior, each[0].best))
        assert found.spread == (None if len(each) == 1 else pytest.approx(stdev(e.error for e in each)))
    for name, value in values(pooled).items():
        assert value == pytest.approx(np.mean([values(score)[name] for score in scores]))


def test_trials_are_averaged_not_maps_and_scores_are_json_with_reasons_for_missing_values():
    empty, truth = scene()
    random = np.random.default_rng(3)
    maps = [empty._replace(probability=1.0 * (random.random((32, 32)) < 0.5)) for _ in range(20)]
    pooled = pool_grids([score_grid(grid, truth) for grid in maps], "coin").under(MAIN_CONVENTION)
    assert pooled.error == pytest.approx(0.5, abs=0.01)
    assert error(occupancy_grid.mean_grid(maps), truth, MAIN_CONVENTION).error < 0.4
    some = pool_grids([score_grid(grid, truth) for grid in (empty, empty, true_grid(empty, truth))], "some")
    assert some.quantities["map_chamfer_map"].value is not None
    assert some.quantities["map_chamfer_map"].note == "2 of 3 trials without: no cell above 0.5"
    empty, truth = scene()
    nowhere = GridTruth(np.zeros_like(truth.inside), np.ones_like(truth.inside), np.zeros((0, 4)))
    score = score_grid(empty, nowhere)
    assert occupancy_score.GridScore.model_validate_json(score.model_dump_json()) == score
    assert all(quantity.value is not None or quantity.note for quantity in score.quantities.values())
    for name in ("map_auc", "map_chamfer_map"):
        assert score.quantities[name].note == "the truth has no wall"


def mapper(name, value, spread=0.001):
    score = pool_grids([score_grid(*scene())] * 4, name)
    errors = tuple(e.model_copy(update={"error": value, "spread": spread}) for e in score.errors)
    return score.model_copy(update={"errors": errors})


@pytest.mark.parametrize("order", [MAPPERS, MAPPERS[::-1]])
def test_the_table_notes_where_the_papers_order_holds(order):
    scores = {name: mapper(name, 0.2 - 0.05 * k) for k, name in enumerate(order)}
    text = occupancy_score.render_grid_scores([scores[name] for name in MAPPERS])
    holds = "as in the paper" if order == MAPPERS else "not the paper's"
    assert text.count(f"order: {' > '.join(order)}, {holds}\n") == 10
    # four trials each, so that the mean's standard error is half the spread
    close = [mapper(*one, 0.05) for one in zip(MAPPERS, (0.2, 0.19, 0.15), strict=True)]
    assert (
        occupancy_score.render_grid_scores(close).count("within a standard error: blob and geometric\n") == 10
    )
    empty, truth = scene()
    assert "order" not in occupancy_score.render_grid_scores(
        [score_grid(true_grid(empty, truth), truth, "perfect")]
    )
