"""Metrics of occupancy maps: properties that hold in any arena, constant maps, pooling and the table."""

from __future__ import annotations

import itertools
from statistics import stdev

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.metrics.grid_error import (
    CONVENTIONS,
    MAIN_CONVENTION,
    Convention,
    grid_error,
    pool_errors,
    smooth_truth,
)
from evaluation.metrics.grid_metrics import CLAMP
from evaluation.metrics.grid_score import GridScore, pool_grids, render_grid_scores, score_grid
from evaluation.metrics.occupancy_grid import (
    PRIOR_OCCUPANCY,
    GridTruth,
    OccupancyGrid,
    cell_centres,
    mean_grid,
    touchable_surface,
    truth_occupancy,
)

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
    return grid._replace(probability=truth_occupancy(truth, touchable_surface(grid, truth).wall, outside))


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
    assert truth_occupancy(truth, surface.wall)[6 + 8, 7] == 1


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


def test_trials_are_averaged_not_maps():
    empty, truth = scene()
    random = np.random.default_rng(3)
    shape = empty.probability.shape
    maps = [empty._replace(probability=1.0 * (random.random(shape) < 0.5)) for _ in range(20)]
    pooled = pool_grids([score_grid(grid, truth) for grid in maps], "coin").under(MAIN_CONVENTION)
    assert pooled.error == pytest.approx(0.5, abs=0.01)
    assert error(mean_grid(maps), truth, MAIN_CONVENTION).error < 0.4


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


def test_a_pool_notes_how_many_trials_have_no_value():
    empty, truth = scene()
    pooled = pool_grids([score_grid(grid, truth) for grid in (empty, empty, true_grid(empty, truth))], "some")
    quantity = pooled.quantities["map_chamfer_map"]
    assert quantity.value is not None
    assert quantity.note == "2 of 3 trials without: no cell above 0.5"


def test_scores_are_json_with_reasons_for_missing_values():
    empty, truth = scene()
    nowhere = GridTruth(np.zeros_like(truth.inside), np.ones_like(truth.inside), np.zeros((0, 4)))
    for score in (score_grid(empty, truth), score_grid(empty, nowhere)):
        assert GridScore.model_validate_json(score.model_dump_json()) == score
        assert all(quantity.value is not None or quantity.note for quantity in score.quantities.values())
    assert score.quantities["map_auc"].note == "the truth has no wall"
    assert score.quantities["map_chamfer_map"].note == "the truth has no wall"


def mapper(name, error, spread=0.001):
    empty, truth = scene()
    score = pool_grids([score_grid(empty, truth)] * 4, name)
    return score.model_copy(
        update={
            "errors": tuple(e.model_copy(update={"error": error, "spread": spread}) for e in score.errors)
        }
    )


@pytest.mark.parametrize("order", list(itertools.permutations(("blob", "geometric", "template"))))
def test_the_table_notes_where_the_papers_order_holds(order):
    scores = {name: mapper(name, 0.2 - 0.05 * k) for k, name in enumerate(order)}
    text = render_grid_scores([scores[name] for name in ("blob", "geometric", "template")])
    orders = [line.strip() for line in text.splitlines() if line.strip().startswith("order")]
    holds = "as in the paper" if order == ("blob", "geometric", "template") else "not the paper's"
    assert orders == [f"order: {' > '.join(order)}, {holds}"] * 10
    assert max(map(len, text.splitlines())) <= 110
    assert "0.40" in text
    assert "0.39" in text
    assert "0.37" in text


def test_an_order_within_a_standard_error_is_marked():
    # four trials each, so that the mean's standard error is half the spread
    text = render_grid_scores(
        [mapper("blob", 0.2, 0.05), mapper("geometric", 0.19, 0.05), mapper("template", 0.15, 0.05)]
    )
    assert text.count("within a standard error: blob and geometric\n") == 10


def test_a_table_of_one_map_has_no_order():
    empty, truth = scene()
    text = render_grid_scores([score_grid(true_grid(empty, truth), truth, "perfect")])
    assert "order" not in text
    assert text.count(" 0.000 ") == text.count(" 1.00\n") == 2  # raw, unknown outside or within the arena
    assert all(line == line.rstrip() for line in text.splitlines())


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
    surface = touchable_surface(empty, truth)
    with pytest.raises(ValueError, match="different"):
        pool_errors([grid_error(empty, truth, surface, each) for each in (MAIN_CONVENTION, ARENA)])
