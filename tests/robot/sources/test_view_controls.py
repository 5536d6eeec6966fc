"""Controls: shuffled, blank and ideal views."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.papers.trial_sessions import apply_control
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources.in_memory import load_into_memory
from robot.touch_source import open_touch_source
from tactile.frontend import TouchConfig


@pytest.fixture(scope="module")
def log():
    given = {"maze": {"columns": 2, "rows": 2, "loop": 4}, "path": {"circuits": "CCA"}}
    simulation = HeadSimulation(SimulationConfig.model_validate(given), TouchConfig().head)
    return load_into_memory(open_touch_source(simulation, TouchConfig()))


@pytest.mark.parametrize("control", ["shuffled", "blank", "ideal"])
def test_controls_change_only_the_views(log, control):
    changed = apply_control(log, control, 1)
    assert changed.views.shape == log.views.shape
    assert not np.array_equal(changed.views, log.views)
    assert np.array_equal(changed.motion, log.motion)
    assert np.array_equal(changed.truth, log.truth)
    assert np.array_equal(changed.views, apply_control(log, control, 1).views)
    assert 0 <= changed.views.min() <= changed.views.max() <= 1
    assert apply_control(log, "none", 1) is log


def test_shuffled_views_are_the_same_views(log):
    views, shuffled = (np.sort(x.views.reshape(-1)) for x in (log, apply_control(log, "shuffled", 0)))
    assert np.array_equal(views, shuffled)
    assert not apply_control(log, "blank", 0).views.any()


def test_ideal_views_are_equal_exactly_at_one_spot_and_heading(log):
    views = apply_control(log, "ideal", 0).views.reshape(log.length, -1)
    x, y, heading = np.asarray(log.truth).T
    spot = np.stack([np.round(x / 0.06), np.round(y / 0.06), np.round(heading / (np.pi / 4)) % 8], axis=1)
    same = (spot[:, None] == spot[None]).all(axis=2)
    alike = (views[:, None] == views[None]).all(axis=2)
    assert np.array_equal(same, alike)
    assert same.sum() > log.length
