"""Threshold tuning: differences of views, the rule that takes a threshold, and the command."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from evaluation.papers.salman2016.threshold_tuning import (
    THRESHOLDS,
    ThresholdScore,
    choose_threshold,
    tune_threshold,
    view_differences,
)
from evaluation.studies.metrics import ViewDifferences
from ratslam.classic import view_templates
from ratslam.classic.view_templates import TemplateConfig
from ratslam.cli import main
from ratslam.runs.settings.strict_yaml import parse
from robot.sources.in_memory import InMemorySource
from tactile.base.errors import InputError

ROOT = Path(__file__).parents[4]
VIEWS = ViewDifferences(np.linspace(0, 1, 11), np.eye(10, dtype=int)[1] * 8, np.ones(10, int), 0.9)
COUNTS = st.lists(st.integers(0, 5), min_size=1, max_size=9)
GRID = (0.01, 0.02, 0.04, 0.08)
TINY = """
simulation:
  maze: {columns: 3, rows: 2, loop: 6}
  path: {circuits: CCC}
  odometry: {noise: none}
pose_cells: {cells_xy: 11, cells_heading: 12}
"""


def scores(*results):
    return [
        ThresholdScore(0.01 * k, 0.5, correct, incorrect) for k, (correct, incorrect) in enumerate(results)
    ]


def log_of(truth, views, step=10.0):
    count = len(truth)
    return InMemorySource(
        name="made up",
        digest="",
        time=step * np.arange(count),
        motion=np.zeros((count, 4)),
        moved=np.ones(count, bool),
        views=np.asarray(views, float).reshape(count, 1, -1, 1),
        seen=np.ones(count, bool),
        label=np.full(count, -1, np.int32),
        truth=np.asarray(truth, float),
    )


@pytest.mark.parametrize(
    "how", [{}, {"shift": 1}, {"shift": 2, "shift_step": 2}, {"panoramic": True, "shift_step": 3}]
)
@settings(max_examples=5)
@given(views=arrays.arrays(float, (3, 3, 6, 2), elements=st.floats(0, 1)))
def test_differences_equal_those_of_the_matcher(how, views):
    config = TemplateConfig(threshold=1.0, **how)
    found = view_differences(config, views, views)
    store = view_templates.start(config, (3, 6, 2), 1, np.dtype(float))
    for i in range(3):
        stored = store._replace(view=jnp.asarray(views[i].reshape(-1, 1)), count=jnp.int32(1))
        match = view_templates.match_view(config, (3, 6, 2), stored, jnp.asarray(views[i - 1]))
        assert found[i - 1, i] == pytest.approx(float(match.error), abs=1e-12)


def test_most_correct_with_none_incorrect_wins():
    found = scores((9, 0), (12, 0), (30, 0), (30, 0), (99, 1))
    winner, why = choose_threshold(found, VIEWS)
    assert winner is found[2]
    assert "3 thresholds" in why


def test_the_reason_for_no_winner_is_given():
    few, why_few = choose_threshold(scores((0, 0), (9, 0), (3, 5)), VIEWS)
    wrong, why_wrong = choose_threshold(scores((12, 4), (50, 2), (9, 0)), VIEWS)
    assert few is wrong is None
    assert "0.01 gives 9" in why_few
    assert "0.01 has the fewest, 2 beside 50" in why_wrong
    assert "0.150" in why_wrong  # the median of views of the same place
    assert "15.0%" in why_wrong  # of the views of other places lie below


def test_the_command_tunes_a_simulated_session(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("evaluation.papers.salman2016.threshold_tuning.THRESHOLDS", GRID)
    config = tmp_path / "tiny.yaml"
    config.write_text(TINY)
    out = tmp_path / "out"
    assert main(["reproduce", "threshold", str(config), "-o", str(out)]) == 0
    text = capsys.readouterr().out
    assert len([line for line in text.splitlines() if line[:8].strip().startswith("0.")]) >= len(GRID)
    assert "AUC" in text
    assert "templates.threshold=" in text or "no threshold satisfies" in text
    assert len((out / "threshold.csv").read_text().splitlines()) == 1 + len(GRID)
    assert (out / "threshold.png").read_bytes().startswith(b"\x89PNG")


def test_parts_of_the_grid_are_run_tasks_and_put_together(monkeypatch):
    seen = []

    def run_tasks(function, tasks, workers):
        seen.append((len(tasks), workers))
        return ([ThresholdScore(float(t), 0.0, 20, 0) for t in part] for *_, part in tasks)

    monkeypatch.setattr("evaluation.papers.salman2016.threshold_tuning.run_tasks", run_tasks)
    lines = list(tune_threshold(parse(TINY, "tiny"), ROOT, workers=3))
    assert seen == [(3, 3)]
    assert [float(line.split()[0]) for line in lines if line[2:].strip().startswith("0.")] == list(THRESHOLDS)
    assert sum(line.endswith("<- the winner") for line in lines) == 1


def test_invalid_configurations_are_refused(tmp_path, capsys):
    config = tmp_path / "labels.yaml"
    config.write_text("recording: {file: missing.npz}\n")
    assert main(["reproduce", "threshold", str(config)]) == 2
    assert "missing.npz" in capsys.readouterr().err
    config.write_text("simulation: {path: {circuits: C}}\ntemplates: {threshold: high}\n")
    assert main(["reproduce", "threshold", str(config)]) == 2
    assert "templates.threshold" in capsys.readouterr().err


def test_all_steps_need_a_view(monkeypatch):
    truth = [[0, 0, 0], [1, 0, 0], [0, 0, 0]]
    blind = replace(log_of(truth, np.arange(3)), seen=np.array([True, False, True]))
    document = parse("simulation: {}\n", "here")
    monkeypatch.setattr(
        "evaluation.papers.salman2016.threshold_tuning.collect_session", lambda config: (config, blind)
    )
    with pytest.raises(InputError, match="without a view"):
        list(tune_threshold(document, ROOT))
