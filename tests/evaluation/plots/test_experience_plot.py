"""The experience history: every step once, coloured by the strict Experience Metric."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.metrics.exm import experience_metric
from evaluation.metrics.scorecard import score_run
from evaluation.plots.experience_plot import draw_experience_history


def marks(figure):
    """Of each kind of mark its steps and experiences, by the first words of its name."""
    return {line.get_label().split(" (")[0]: line.get_xydata() for line in figure.axes[0].lines}


@pytest.fixture
def confused(circle):
    """The third lap takes half of the places for their neighbours across the circle."""
    experience = circle.experience.copy()
    experience[80:98] = (experience[80:98] + 18) % 36
    return circle._replace(experience=experience)


def test_every_step_is_drawn_once_with_its_verdict(confused):
    figure = draw_experience_history(confused, score_run(confused))
    found = marks(figure)
    base = found.pop("end of the base set")
    expected = experience_metric(confused.experience, confused.truth)
    assert base[0, 0] == expected.base - 0.5
    for name, which in (
        ("no re-localisation", ~expected.counted),
        ("correct re-localisation", expected.right),
        ("incorrect re-localisation", expected.counted & ~expected.right),
    ):
        steps = np.flatnonzero(which)
        assert len(steps) > 0
        assert np.array_equal(found[name], np.stack([steps, confused.experience[steps]], axis=1)), name
    assert len(found) == 3


def test_the_legend_has_the_counts(confused):
    found = experience_metric(confused.experience, confused.truth)
    names = [
        text.get_text()
        for text in draw_experience_history(confused, score_run(confused)).legends[0].get_texts()
    ]
    assert f"correct re-localisation ({found.correct})" in names
    assert f"incorrect re-localisation ({found.relocalisations - found.correct})" in names


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"truth": None}, "no ground truth"),
        ({"experience": np.full(108, -1)}, "no experiences"),
        ({"truth": np.linspace([0, 0, 0], [9, 9, 0], 108)}, "never returns"),
    ],
)
def test_runs_without_verdicts_are_drawn_with_the_reason(circle, change, reason):
    run = circle._replace(**change)
    figure = draw_experience_history(run, score_run(run))
    assert any(reason in text.get_text() for text in figure.texts)
    assert set(marks(figure)) <= {"experience"}


def test_plot_and_scorecard_agree(confused):
    """Also where experiences begin late, or the truth has holes."""
    late = confused._replace(experience=np.where(np.arange(108) < 10, -1, confused.experience))
    truth = confused.truth.copy()
    truth[5:9] = np.nan
    for run in (confused, late, late._replace(truth=truth)):
        card = score_run(run)
        figure = draw_experience_history(run, card)
        texts = " ".join(text.get_text() for text in figure.texts)
        base = card.quantities["exm_base"].value
        assert f"base set of {base} steps" in texts
        for name, words in (("exm_arr", "ARR"), ("exm_arcr_strict", "ARCR")):
            assert f"{words} {card.quantities[name].value:.2f} (" in texts
        steps = np.flatnonzero((run.experience >= 0) & np.isfinite(run.truth).all(axis=1))
        assert marks(figure)["end of the base set"][0, 0] == steps[base] - 0.5


def test_steps_without_truth_are_left_out(circle):
    truth = circle.truth.copy()
    truth[::7] = np.nan
    holed = circle._replace(truth=truth)
    found = marks(draw_experience_history(holed, score_run(holed)))
    found.pop("end of the base set")
    steps = np.sort(np.concatenate([points[:, 0] for points in found.values()]))
    assert np.array_equal(steps, np.flatnonzero(np.isfinite(truth).all(axis=1)))
