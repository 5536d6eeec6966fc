"""Grid errors of several trials, and the table of mappers."""

from __future__ import annotations

import itertools
from statistics import stdev

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.metrics.occupancy_grid import GridTruth, mean_grid
from evaluation.metrics.occupancy_score import (
    MAIN_CONVENTION,
    GridScore,
    pool_grids,
    render_grid_scores,
    score_grid,
)
from tests.evaluation.metrics.grid_scenes import error, law, noisy, scene, scenes, seeds, true_grid, values


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
