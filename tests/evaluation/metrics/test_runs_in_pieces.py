"""Runs of a map in pieces: scores and pictures compare poses within pieces only."""

from __future__ import annotations

import json

import numpy as np
import pytest

from evaluation.artifacts.run_reader import read_run, write_pieces
from evaluation.metrics.run_metrics import PIECES, arrange_pieces, ate_within_pieces
from evaluation.metrics.scorecard import score_run
from evaluation.metrics.trajectory import ate, write_tum
from evaluation.plots.map_plot import Layers, draw_changes, draw_map, map_headline
from evaluation.report.verdict import describe_score
from ratslam.core.estimates import Localisation, pieces_of, write_course
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose

AWAY = np.array([170.0, 30.0, 2.0])


@pytest.fixture
def parted(circle):
    """The circle with its last third in another piece, which lies elsewhere."""
    count = len(circle.time)
    piece = (np.arange(count) >= 2 * count // 3).astype(int)
    of_node = piece[circle.created] == 1
    final, nodes = circle.final.copy(), circle.nodes.copy()
    final[piece == 1] = compose(AWAY, final[piece == 1])
    nodes[of_node] = compose(AWAY, nodes[of_node])
    return circle._replace(final=final, nodes=nodes, piece=piece)


def test_a_run_in_one_piece_is_scored_as_before(circle):
    one = circle._replace(piece=np.zeros(len(circle.time), int))
    assert score_run(one) == score_run(circle)
    assert PIECES not in score_run(one).lines()
    assert arrange_pieces(one) is one


def test_the_score_of_pieces_does_not_depend_on_where_they_lie(circle, parted):
    card, near = score_run(parted).quantities, score_run(parted._replace(final=circle.final)).quantities
    assert card["pieces"].value == 2
    assert card["unjoined_share"].value == pytest.approx(1 / 3)
    for name in ("energy_within_pieces", "ate_within_pieces"):
        assert card[name].value == pytest.approx(near[name].value, abs=1e-9)
    assert card["ate_final"].value is None
    assert card["energy_all"].value is None
    assert card["energy_all"].odometry == score_run(circle).quantities["energy_all"].odometry


def test_a_piece_that_was_tied_is_remarked_beside_errors_of_online_poses(circle):
    tied = len(circle.time) // 3
    online = circle.online.copy()
    online[:tied] = compose(AWAY, online[:tied])
    note = f"m at t = {circle.time[tied]:.1f} s, as where a new piece is tied"
    card = score_run(circle._replace(online=online)).quantities
    assert card["ate_online"].value > 1
    assert card["ate_online"].note.endswith(note)
    assert card["ate_final"] == score_run(circle).quantities["ate_final"]
    killed = score_run(circle._replace(online=online, final=online)).quantities
    assert killed["ate_final"].note.endswith(note)
    assert score_run(circle).quantities["ate_online"].note == ""


def test_each_piece_is_aligned_by_itself(circle, parted):
    noise = np.random.default_rng(0).normal(0, 0.01, circle.final.shape)
    final, piece = compose(parted.final, noise), parted.piece
    parts = [
        ate(final[piece == one], circle.truth[piece == one]) ** 2 * (piece == one).sum() for one in (0, 1)
    ]
    found = ate_within_pieces(final, circle.truth, piece)
    assert found == pytest.approx(np.sqrt(sum(parts) / len(piece)))
    assert found < ate(final, circle.truth)
    assert ate_within_pieces(circle.final, circle.truth, 0 * piece) == ate(circle.final, circle.truth)


def test_a_picture_shows_pieces_where_they_are_true(circle, parted):
    shown = arrange_pieces(parted)
    assert np.abs(shown.final[:, :2] - circle.final[:, :2]).max() < 1e-6  # in the frame of the largest piece
    draw_map(parted, score_run(parted))  # draws nothing outside of its frame
    assert "2 pieces, 33% of the steps unjoined" in map_headline(score_run(parted))
    assert "within the pieces of the map" in describe_score(score_run(parted))


def test_online_poses_are_moved_with_their_pieces(parted):
    run = parted._replace(truth=None, online=parted.final)
    shown = arrange_pieces(run)
    assert np.array_equal(shown.online, shown.final)


LOCALISED = {
    "found at once": "f" * 108,
    "found late": "s" * 30 + "f" * 78,
    "carried away": "s" * 9 + "f" * 40 + "l" * 20 + "f" * 39,
    "lost at the end": "f" * 40 + "l" * 68,
    "another map": "s" * 60 + "n" * 48,
}
"""The first letters of the states of a session."""


@pytest.mark.parametrize("seen", [True, False], ids=["truth", "no truth"])
@pytest.mark.parametrize("case", LOCALISED)
def test_the_saved_map_of_a_localised_session_stays_where_it_is(circle, tmp_path, case, seen):
    names = {state.name[0].lower(): state for state in Localisation}
    states = np.array([names[letter] for letter in LOCALISED[case]])
    found, piece = states == Localisation.FOUND, pieces_of(states)
    final = circle.final.copy()
    for one in np.unique(piece[~found]):
        final[piece == one] = compose(AWAY / (1 + one), final[piece == one])
    paths = {"online": final, "trajectory": final, "odometry": circle.odometry, "truth": circle.truth}
    (tmp_path / "truth.tum").touch()
    for name, path in [*paths.items()][: 3 + seen]:
        write_tum(tmp_path / f"{name}.tum", circle.time, path)
    (tmp_path / "steps.csv").write_text("place\n" + "-1\n" * len(states))
    nodes = [{"x": x, "y": y, "heading": turn, "piece": 0} for x, y, turn in circle.nodes.tolist()]
    links = [{"source": a, "target": b} for a, b in circle.links.tolist()]
    (tmp_path / "map.json").write_text(json.dumps({"nodes": nodes, "links": links}))
    write_course(tmp_path / "localisation.csv", states, np.zeros((len(states), 3)))
    write_pieces(tmp_path / "pieces.csv", circle.time, piece)

    run = read_run(tmp_path)
    shown = arrange_pieces(run)
    assert np.array_equal(run.found, found)
    assert np.array_equal(run.piece, piece)
    assert shown.nodes == pytest.approx(circle.nodes)
    assert shown.final[found] == pytest.approx(circle.final[found], abs=1e-9)
    if seen and found.any():
        assert shown.final[:, :2] == pytest.approx(circle.final[:, :2], abs=1e-6)
        assert Layers.align(shown).truth == pytest.approx(circle.final[:, :2], abs=1e-6)
    elif not found.any():
        assert shown.final[:, 0].min() > circle.nodes[:, 0].max()
    (path,) = (line for line in draw_changes("", run, []).axes[0].lines if line.get_zorder() == 3)
    assert np.array_equal(np.isfinite(path.get_xydata()[:, 0]), found)
    labels = [text.get_text() for text in draw_map(run, score_run(run)).legends[0].get_texts()]
    words = {run.name_piece(one).split(",")[0] for one in piece}
    assert words <= {"found", "searching", "lost", "not this map"}
    assert {label.split(",")[0] for label in labels} >= words
    assert ("found" in words) == found.any()


def test_without_truth_a_picture_shows_pieces_side_by_side(parted):
    shown = arrange_pieces(parted._replace(truth=None))
    first, second = (shown.final[shown.piece == one] for one in (0, 1))
    assert first[:, 0].max() < second[:, 0].min() < first[:, 0].max() + np.ptp(first[:, 0])
    for one in (0, 1):
        steps = parted.piece == one
        own, before = shown.final[steps], parted.final[steps]
        assert np.allclose(between(own[:1], own)[:, :2], between(before[:1], before)[:, :2])
    names = [label.get_text() for label in draw_map(parted, score_run(parted)).legends[0].get_texts()]
    steps = int((parted.piece == 0).sum())
    assert f"piece 1, {steps} steps" in names


def test_a_run_with_too_few_pieces_is_refused(circle, tmp_path):
    for name in ("online", "odometry", "truth"):
        write_tum(tmp_path / f"{name}.tum", circle.time, circle.online)
    (tmp_path / "steps.csv").write_text("place\n" + "-1\n" * len(circle.time))
    assert (read_run(tmp_path).piece == 0).all()
    write_pieces(tmp_path / "pieces.csv", circle.time[:5], np.zeros(5, int))
    with pytest.raises(InputError, match="5 lines"):
        read_run(tmp_path)
