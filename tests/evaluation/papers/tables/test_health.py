"""The table of map health: the regression, its rows, and the configurations of its sessions."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.papers.tables import health
from evaluation.papers.tables.health import fit_weights


def judged(seed, count=80):
    """Maps that are bad where their first feature is low, but for some chance."""
    random = np.random.default_rng(seed)
    features = random.normal(size=(count, 5))
    bad = features[:, 0] + 0.3 * random.normal(size=count) < -0.5
    return np.column_stack([features, np.where(bad, 2.0, 0.5), bad, random.integers(1, 50, count)])


def test_the_regression_finds_the_feature_that_tells():
    weights = fit_weights(judged(0, 400))
    assert weights[1] < -2
    assert np.all(np.abs(weights[2:]) < 0.3 * abs(weights[1]))


def test_the_regression_does_not_depend_on_the_units_of_features():
    maps, units = judged(0), np.array([1.0, 10.0, 0.1, 3.0, 1.0])
    scaled = fit_weights(maps * [*units, 1, 1, 1])
    assert scaled[1:] * units == pytest.approx(fit_weights(maps)[1:], rel=1e-3, abs=1e-4)


def test_every_second_session_tests_the_regression(monkeypatch):
    monkeypatch.setattr(health, "real_recordings", lambda: None)
    monkeypatch.setattr(health, "run_tasks", lambda function, tasks, workers: map(judged, range(len(tasks))))
    _, *lines, fitted = health.health_table(sessions=2)
    assert [line.split(" | ")[0] for line in lines] == [
        *(f"| {row}" for row in (*health.TOUCH, "all", "even, fitted on these", "odd, fitted on even ones"))
    ]
    assert float(lines[-1].split(" | ")[3]) > 0.9
    assert len(fitted.split(": ")[1].split(", ")) == 6


@pytest.mark.parametrize("row", health.TOUCH)
def test_rows_are_valid_configurations(row):
    config, touch = health.task_config(row, 3)
    assert touch
    assert config.simulation.maze.seed == health.FIRST_MAZE + 3
