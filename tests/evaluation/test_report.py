"""The picture of a run: drawn for every kind of run, the same each time, without global state."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from evaluation.report import draw_map, headline, save_map
from evaluation.scorecard import score


def labels(figure):
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def test_the_picture_shows_map_truth_and_odometry(circle, tmp_path):
    figure = draw_map(circle, score(circle, "circle"))
    assert labels(figure)[:4] == ["truth", "raw odometry", "trajectory in the map", "experience"]
    assert "link to an older experience" in labels(figure)
    axes = figure.axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_aspect()) == ("x (m)", "y (m)", 1.0)
    (truth,) = (line for line in axes.lines if line.get_label() == "truth")
    (drawn,) = (line for line in axes.lines if line.get_label() == "trajectory in the map")
    assert np.array(drawn.get_data()) == pytest.approx(np.array(truth.get_data()), abs=1e-9)
    save_map(tmp_path / "map.png", circle, score(circle, "circle"))
    save_map(tmp_path / "again.png", circle, score(circle, "circle"))
    assert (tmp_path / "map.png").read_bytes() == (tmp_path / "again.png").read_bytes()


def test_a_metre_is_as_long_upwards_as_sideways(circle):
    flat = circle._replace(
        **{name: getattr(circle, name) * [1, 0.1, 1] for name in ("truth", "final", "nodes")}
    )
    figure = draw_map(flat, score(flat))
    axes = figure.axes[0]
    width, height = figure.get_size_inches() * axes.get_position().size
    assert np.ptp(axes.get_xlim()) / width == pytest.approx(np.ptp(axes.get_ylim()) / height)


def test_without_truth_odometry_starts_where_the_map_does(circle):
    blind = circle._replace(truth=None)
    figure = draw_map(blind, score(blind))
    odometry, final = (
        next(line for line in figure.axes[0].lines if line.get_label() == name).get_xydata()[0]
        for name in ("raw odometry", "trajectory in the map")
    )
    assert odometry == pytest.approx(final)
    assert "truth" not in labels(figure)
    assert "no ground truth" in headline(score(blind))


def test_a_run_without_places_or_motion_is_drawn(circle):
    still = circle._replace(
        truth=np.zeros((108, 3)),
        final=np.zeros((108, 3)),
        odometry=np.zeros((108, 3)),
        experience=np.full(108, -1),
        created=np.zeros(0, int),
        nodes=np.zeros((0, 3)),
        links=np.zeros((0, 2), int),
    )
    assert "experience" not in labels(draw_map(still, score(still)))


def test_truth_with_holes_is_drawn(circle):
    truth = circle.truth.copy()
    truth[:5] = np.nan
    holed = circle._replace(truth=truth)
    assert "truth" in labels(draw_map(holed, score(holed)))


def test_scoring_needs_no_matplotlib_and_drawing_no_pyplot():
    code = (
        "import sys, evaluation.report, evaluation.scorecard;"
        "assert not [m for m in sys.modules if m.split('.')[0] in ('matplotlib', 'robot', 'ratslam', 'jax')]"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
