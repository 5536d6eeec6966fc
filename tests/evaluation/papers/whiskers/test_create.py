"""The figure of a real Create: distances from walls, true revisits as closures, table and picture."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from evaluation.papers.whiskers.bumps import wall_distances
from evaluation.papers.whiskers.create import FIGURE, CreateResult, Variant, true_revisits
from ratslam.mapping.appearance import ViewAppearance
from ratslam.mapping.config import FULL, KeyframeMapConfig
from ratslam.mapping.keyframe_graph import KeyframeGraph

ROOM = np.array([[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0]], float)


def variant(final, live, drawn):
    return Variant(1.0, final, live, drawn, 0.8, 20, 5, 100, 25, 0.6)


@pytest.fixture
def result():
    path = np.random.default_rng(0).normal(2, 0.5, (50, 3))
    return CreateResult(
        variants={
            "classic": Variant(1.0, 1.8, 1.7, 1.8, np.nan, 0, 0, 0, 0, np.nan),
            "create 1 1": variant(1.0, 0.9, 0.8),
            "create 2 1": variant(0.4, 1.2, 0.4),
        },
        true_turns=0.3,
        drift=2.0,
        latency=0.45,
        paths={name: path for name in ("odometry", "map", "truth")},
        walls=ROOM,
        distances=wall_distances(path[:, :2], path[:, 0] > 2.5, ROOM),
    )


def test_a_contact_counts_once_and_by_its_first_reading():
    position = np.array([[2.0, 1.0], [2.0, 0.2], [2.0, 0.3], [2.0, 1.5], [3.9, 1.5], [5.0, 4.0]])
    contact, every = wall_distances(position, np.array([0, 1, 1, 0, 1, 0], bool), ROOM)
    np.testing.assert_allclose(contact, [0.2, 0.1])
    np.testing.assert_allclose(every, [1.0, 0.2, 0.3, 1.5, 0.1, np.sqrt(2)])


def test_true_revisits_are_of_the_same_place_and_heading():
    """A lap of 30 keyframes driven twice, the second time 0.1 rad to the left."""
    angle = 2 * np.pi * np.arange(60) / 30
    truth = np.stack([2 * np.cos(angle), 2 * np.sin(angle), angle + np.pi / 2], axis=1)
    truth[30:, 2] += 0.1
    graph = KeyframeGraph(KeyframeMapConfig(), 0.3, ViewAppearance(9, -1.2), 20, FULL)
    found = list(true_revisits(graph, truth))
    assert [candidate.keyframe for candidate in found] == list(range(30, 60))
    assert {candidate.keyframe - candidate.match for candidate in found} == {30}
    assert {candidate.shift for candidate in found} == {1}
    assert all(a.keyframe < b.keyframe for a, b in pairwise(found))


def test_the_table_counts_sessions_above_odometry(result):
    lines = list(FIGURE.table(result))
    summary = next(line for line in lines if line.startswith("ATE in m."))
    assert "Above odometry: 0 at the end, 1 live" in summary
    assert "2 settings, median: 0.700 at the end" in summary
    assert any(line.startswith("| recall, cell x 1, sector x 1 (defaults) | 1.00 | 0.900") for line in lines)
    rows = "\n".join(lines[: lines.index("")]).splitlines()
    assert len({row.count("|") for row in rows}) == 1


def test_the_picture_is_drawn(result, tmp_path):
    FIGURE.draw(result, tmp_path / "create.png")
    assert (tmp_path / "create.png").stat().st_size > 10_000
