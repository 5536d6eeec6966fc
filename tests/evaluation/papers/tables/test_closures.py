"""The table of closures: the regression, and the test of each session by weights of the others."""

from __future__ import annotations

import json

import numpy as np

from evaluation.papers.tables import closures
from evaluation.papers.tables import touch_table as touch
from evaluation.papers.tables.closures import closures_table, fit_weights
from ratslam.mapping.closure_judge import KINDS, WEIGHTS, SequenceEvidence, shipped_weights

FIT, CONTRADICT = 3, 0


def session(seed, count=60):
    """Sequences that are true where many views fit, but for some chance; contradictions go with true ones."""
    random = np.random.default_rng(seed)
    true = random.random(count) < 0.4
    counts = random.poisson(3.0, (count, 2, 2, KINDS)).astype(float)
    counts[..., FIT] += 6 * true[:, None, None]
    counts[..., CONTRADICT] += 2 * true[:, None, None]
    evidence = SequenceEvidence(random.normal(2.0 * true - 1, 2.0), counts)
    return true, random.random(count), random.random(count) < 0.5, (evidence,) * 3


def test_the_regression_finds_the_views_that_tell():
    weights = fit_weights([session(seed) for seed in range(5)])
    within = weights[:, 3 : 3 + KINDS]
    assert np.all(within[:, FIT] > 0.1)
    assert np.all(within.argmax(axis=1) == FIT)


def test_contradictions_never_count_for_a_place():
    weights = fit_weights([session(seed) for seed in range(5)])
    assert np.all(weights[:, [3, 4, 3 + KINDS, 4 + KINDS]] <= 0)


def test_every_session_is_tested_by_the_weights_of_the_others(monkeypatch, tmp_path):
    monkeypatch.setattr(
        closures, "run_tasks", lambda function, tasks, workers: (session(k) for k in range(len(tasks)))
    )
    _, *lines, fitted = closures_table(sessions=2, folder=tmp_path)
    assert [line.split(" | ")[0] for line in lines] == [f"| {row}" for row in (*closures.ROWS, "all")]
    assert float(lines[-1].split(" | ")[6]) > 0.9
    held = json.loads((tmp_path / WEIGHTS).read_text(encoding="utf-8"))
    assert held == json.loads(fitted.strip().removeprefix("```json").removesuffix("```"))
    assert np.shape(held["weights"]) == shipped_weights().shape


def test_nothing_said_is_not_counted():
    one = session(0)
    one[3][0].odometry_ratio[:10] = np.nan
    odds = one[3][0].log_odds(fit_weights([one, session(1)]))
    assert np.isnan(odds[:10]).all()
    assert np.isfinite(odds[10:]).all()


def test_rows_are_rows_of_the_touch_table():
    assert set(closures.ROWS) <= set(touch.ROWS)
