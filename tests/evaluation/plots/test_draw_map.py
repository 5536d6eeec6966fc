"""The map plot: layers, walls, closures and missing truth; equal runs give equal bytes."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from evaluation.metrics.scorecard import score_run
from evaluation.plots.map_plot import draw_map, map_headline, split_at_jumps
from tactile.base.se2 import compose, inverse


def labels(figure):
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def test_the_plot_shows_map_truth_and_odometry(circle):
    figure = draw_map(circle, score_run(circle, "circle"))
    assert labels(figure)[:4] == ["truth", "odometry", "mapped path", "experience"]
    assert "link to an older experience" in labels(figure)
    axes = figure.axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_aspect()) == (
        "x in the frame of the map (m)", "y in the frame of the map (m)", 1.0
    )  # fmt: skip
    (truth,) = (line for line in axes.lines if line.get_label() == "truth")
    (drawn,) = (line for line in axes.lines if line.get_label() == "mapped path")
    assert np.array(drawn.get_data()) == pytest.approx(np.array(truth.get_data()), abs=1e-9)
    assert drawn.get_xydata() == pytest.approx(circle.final[:, :2])  # a place read off is one of the map


def test_equal_runs_give_equal_bytes(circle, tmp_path):
    for name in ("map.png", "again.png"):
        draw_map(circle, score_run(circle, "circle")).savefig(tmp_path / name)
    assert (tmp_path / "map.png").read_bytes() == (tmp_path / "again.png").read_bytes()


def test_both_axes_have_the_same_scale(circle):
    flat = circle._replace(
        **{name: getattr(circle, name) * [1, 0.1, 1] for name in ("truth", "final", "nodes")}
    )
    figure = draw_map(flat, score_run(flat))
    axes = figure.axes[0]
    width, height = figure.get_size_inches() * axes.get_position().size
    assert np.ptp(axes.get_xlim()) / width == pytest.approx(np.ptp(axes.get_ylim()) / height)


def test_without_truth_odometry_starts_where_the_map_does(circle):
    blind = circle._replace(truth=None)
    figure = draw_map(blind, score_run(blind))
    odometry, final = (
        next(line for line in figure.axes[0].lines if line.get_label() == name).get_xydata()[0]
        for name in ("odometry", "mapped path")
    )
    assert odometry == pytest.approx(final)
    assert "truth" not in labels(figure)
    assert "no ground truth" in map_headline(score_run(blind))


def test_a_run_without_experiences_or_motion_is_drawn(circle):
    still = circle._replace(
        truth=np.zeros((108, 3)),
        final=np.zeros((108, 3)),
        odometry=np.zeros((108, 3)),
        experience=np.full(108, -1),
        created=np.zeros(0, int),
        nodes=np.zeros((0, 3)),
        links=np.zeros((0, 2), int),
    )
    assert "experience" not in labels(draw_map(still, score_run(still)))


def test_truth_with_holes_is_drawn(circle):
    truth = circle.truth.copy()
    truth[:5] = np.nan
    holed = circle._replace(truth=truth)
    assert "truth" in labels(draw_map(holed, score_run(holed)))


WALLS = np.array([[-1.0, -1.0, 5.0, -0.9, 0.05], [-1.0, 4.0, 5.0, 4.1, 0.02]])


def drawn(figure, label):
    """The lines with that label in the legend, [n, 2, 2]."""
    found = [lines for lines in figure.axes[0].collections if lines.get_label() == label]
    return np.array([segment for lines in found for segment in lines.get_segments()])


def test_walls_are_drawn_where_the_map_says_they_are(circle):
    figure = draw_map(circle, score_run(circle), WALLS)
    axes = figure.axes[0]
    assert labels(figure)[:3] == ["truth", "mapped path", "odometry"]
    (boxes,) = (found for found in axes.collections if len(found.get_paths()) == len(WALLS))
    to_map = compose(circle.final[0], inverse(circle.truth[0]))
    for (west, south, _, north, _), path in zip(WALLS, boxes.get_paths(), strict=True):
        ends = compose(to_map, np.array([[west, south, 0.0], [west, north, 0.0]]))
        assert path.vertices[[0, 3]] == pytest.approx(ends[:, :2])
    tall, low = boxes.get_facecolor()[:, 0]
    assert tall < low < 1
    corners = np.concatenate([path.vertices for path in boxes.get_paths()])
    low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
    assert (low < corners.min(axis=0)).all()
    assert (high > corners.max(axis=0)).all()


def test_a_closure_of_distant_places_is_drawn_as_false(circle):
    right, wrong = [[0, 36], [5, 77], [36, 72]], [[0, 18], [3, 50]]
    figure = draw_map(circle, score_run(circle), WALLS, np.array(right + wrong))
    for joined, label in ((right, "loop closure"), (wrong, "false loop closure (over 0.1 m)")):
        ends = drawn(figure, label)
        assert ends == pytest.approx(circle.final[np.array(joined)][..., :2], abs=1e-9)


def test_without_closures_the_links_to_older_experiences_are_drawn(circle):
    figure = draw_map(circle, score_run(circle), WALLS)
    links = circle.links[np.abs(circle.links[:, 0] - circle.links[:, 1]) > 1]
    assert len(drawn(figure, "false loop closure (over 0.1 m)")) == len(links) == 1  # 0.115 m apart


def test_walls_are_not_drawn_without_truth(circle):
    blind = circle._replace(truth=None)
    assert labels(draw_map(blind, score_run(blind), WALLS)) == labels(draw_map(blind, score_run(blind)))


def test_a_path_is_interrupted_only_where_the_robot_was_moved_by_hand(circle):
    path = circle.truth[:, :2].copy()
    assert split_at_jumps(path, path) is path or np.array_equal(split_at_jumps(path, path), path)
    path[50:] += 2.0
    found = split_at_jumps(path, path)
    assert np.flatnonzero(np.isnan(found).all(axis=1)).tolist() == [50]
    assert np.array_equal(np.delete(found, 50, axis=0), path)
    assert np.isnan(split_at_jumps(path[46:54], path[46:54])[4]).all()


def test_scoring_needs_no_matplotlib_and_drawing_no_pyplot():
    code = (
        "import sys, evaluation.plots.run_plots, evaluation.metrics.scorecard;"
        "assert not [m for m in sys.modules if m.split('.')[0] in ('matplotlib', 'robot', 'ratslam', 'jax')]"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
