"""Figures of the reproductions, drawn from arrays; equal arrays give equal bytes."""

from __future__ import annotations

import io
from types import SimpleNamespace

import numpy as np
import pytest

from evaluation.papers.salman2016.paper_figures import (
    draw_curves,
    draw_directions,
    draw_drift,
    draw_experiences,
    draw_measured,
    draw_tuning,
)
from evaluation.studies.metrics import ViewDifferences

RANDOM = np.random.default_rng(0)
WAY = np.cumsum(RANDOM.normal(size=(40, 2)), axis=0)
METRIC = SimpleNamespace(
    counted=np.array([0, 0, 1, 0, 1, 0], bool), right=np.array([0, 0, 1, 0, 0, 0], bool), base=2
)
HISTORY = np.array([0, 1, 0, 2, 1, 3, -1]), METRIC
EDGE = np.linspace(0, 1, 11)


def drift():
    return draw_drift("a", "b", {"white": (WAY, WAY + 1, np.repeat([0, 1], 20))})


def experiences():
    return draw_experiences("a", "b", {"classic": HISTORY, "ours": HISTORY})


def measured():
    values = {"classic": np.array([[0.1, 0.2], [0.3, np.nan]]), "ours": np.full((2, 2), np.nan)}
    paper = np.array([0.15, np.nan])
    quantities = [
        ("ARR", values, paper, False),
        ("EM", values, np.full(2, np.nan), True),
    ]
    return draw_measured("a", "b", ["open", "RCP"], quantities)


def directions():
    return draw_directions("a", "b", {name: (WAY, np.arange(40) < 20) for name in ("x", "y", "z")})


def curves():
    pair = RANDOM.random((2, 3, 5))
    return draw_curves("a", "b", {"gated": {"open": (pair[0], pair[1]), "RCP": (pair[1], pair[0])}})


def tuning(winner=0.05):
    grid = np.arange(4) / 20
    views = ViewDifferences(EDGE, np.arange(10), np.ones(10), 0.9)
    return draw_tuning(views, np.array([grid, np.arange(4), np.ones(4)]), winner)


ALL = (drift, experiences, measured, directions, curves, tuning)


def drawn(figure):
    file = io.BytesIO()
    figure.savefig(file)
    return file.getvalue()


def labels(figure):
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


@pytest.mark.parametrize("draw", [drift, experiences, measured, directions, tuning])
def test_equal_arrays_give_equal_bytes(draw):
    assert drawn(draw()) == drawn(draw())


@pytest.mark.parametrize("draw", ALL)
def test_panels_neither_overlap_nor_leave_the_figure(draw):
    figure = draw()
    boxes = [axes.get_position() for axes in figure.axes]
    assert all(box.x0 > 0 and box.x1 <= 1 and box.y0 > 0 and box.y1 < 1 for box in boxes)
    for k, a in enumerate(boxes):
        for b in boxes[:k]:
            assert a.x0 > b.x1 or b.x0 > a.x1 or a.y0 > b.y1 or b.y0 > a.y1


def test_every_step_of_a_history_is_drawn_once():
    axes = experiences().axes[0]
    marks = {line.get_label(): list(line.get_xdata()) for line in axes.lines}
    assert marks["correct re-localisation"] == [2]
    assert marks["incorrect re-localisation"] == [4]
    assert marks["valid experience"] == [0, 1, 3]
    assert marks["invalid experience"] == [5]  # made after the incorrect re-localisation
    assert marks["end of the base set"][0] == 1.5


def test_the_papers_values_are_drawn():
    figure = measured()
    assert labels(figure) == ["classic", "ours", "paper"]
    assert figure.axes[1].get_yscale() == "log"
    dots = [line for line in figure.axes[0].lines if line.get_label() == "classic"]
    assert np.nansum(dots[0].get_ydata()) == pytest.approx(0.6)


def test_directions_have_two_panels_per_row():
    figure = directions()
    tops = {round(axes.get_position().y1, 6) for axes in figure.axes}
    assert len(tops) == 2
    assert labels(figure) == ["clockwise", "anticlockwise"]


def test_histograms_sum_to_1_and_the_chosen_threshold_is_marked():
    figure = tuning()
    shares = [patch.get_data().values.sum() for patch in figure.axes[0].patches]
    assert shares == pytest.approx([1, 1])
    assert "chosen" in labels(figure)
    assert "chosen" not in labels(tuning(None))


def test_later_laps_are_darker():
    lines = [line for line in drift().axes[0].lines if line.get_alpha() is not None]
    assert [line.get_alpha() for line in lines] == sorted(line.get_alpha() for line in lines)
    assert len(lines) == 2
