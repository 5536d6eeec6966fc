"""The figures of a real Create and its bumpers, and the page of figures on real recordings."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from evaluation.papers import figure as figures_of_papers
from evaluation.papers.figure import REAL, Figure, write_page
from evaluation.papers.tables.recordings import UNPROVEN, require_recordings
from evaluation.papers.whiskers import bumps
from evaluation.papers.whiskers.bumps import BumpsResult, wall_distances
from evaluation.papers.whiskers.create import FIGURE, CreateResult, Variant, true_revisits
from ratslam.core.estimates import GridDrawing
from ratslam.mapping.appearance import ViewAppearance
from ratslam.mapping.config import FULL, KeyframeMapConfig
from ratslam.mapping.map_state import MapState
from tactile.base.errors import InputError
from tests.evaluation.papers.shown import rows_of, table_of

ROOM = np.array([[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0]], float)


def test_a_contact_counts_once_and_by_its_first_reading() -> None:
    position = np.array([[2.0, 1.0], [2.0, 0.2], [2.0, 0.3], [2.0, 1.5], [3.9, 1.5], [5.0, 4.0]])
    contact, every = wall_distances(position, np.array([0, 1, 1, 0, 1, 0], bool), ROOM)
    np.testing.assert_allclose(contact, [0.2, 0.1])
    np.testing.assert_allclose(every, [1.0, 0.2, 0.3, 1.5, 0.1, np.sqrt(2)])


def test_true_revisits_are_of_the_same_place_and_heading() -> None:
    """A lap of 30 keyframes driven twice, the second time 0.1 rad to the left."""
    angle = 2 * np.pi * np.arange(60) / 30
    truth = np.stack([2 * np.cos(angle), 2 * np.sin(angle), angle + np.pi / 2], axis=1)
    truth[30:, 2] += 0.1
    graph = MapState(KeyframeMapConfig(), 0.3, ViewAppearance(9, -1.2), 20, FULL)
    found = list(true_revisits(graph, truth))
    assert [candidate.keyframe for candidate in found] == list(range(30, 60))
    assert {candidate.keyframe - candidate.match for candidate in found} == {30}
    assert {candidate.shift for candidate in found} == {1}
    assert all(a.keyframe < b.keyframe for a, b in pairwise(found))


def test_the_table_counts_sessions_above_odometry(tmp_path: Path) -> None:
    def variant(*errors: float) -> Variant:
        return Variant(1.0, *errors, 0.8, 20, 5, 100, 25, 0.6)

    path = np.random.default_rng(0).normal(2, 0.5, (50, 3))
    result = CreateResult(
        variants={
            "classic": Variant(1.0, 1.8, 1.7, 1.8, np.nan, 0, 0, 0, 0, np.nan),
            "create 1 1": variant(0.9, 0.8, 1.0),
            "create 2 1": variant(1.2, 0.4, 0.4),
        },
        true_turns=0.3, drift=2.0, latency=0.45, walls=ROOM,
        paths={name: path for name in ("odometry", "map", "truth")},
        distances=wall_distances(path[:, :2], path[:, 0] > 2.5, ROOM),
    )  # fmt: skip
    lines = table_of(FIGURE, result, tmp_path)
    (summary,) = (line for line in lines if line.startswith("ATE in m."))
    assert "Above odometry: 1 at the end, 0 live" in summary
    assert "2 settings, median: 1.05 at the end" in summary
    rows_of(lines[: lines.index("")])


def test_the_table_of_bumpers_names_the_rows_that_are_worse_than_their_odometry(tmp_path: Path) -> None:
    grid = GridDrawing(np.full((4, 4), 0.3), np.array([-0.2, -0.2]), 0.1)
    path = np.column_stack([np.linspace(0, 1, 5), np.zeros(5), np.zeros(5)])
    result = BumpsResult(
        {"grid filter": np.array([0.5, 0.7, 1.2]), bumps.OTHERS: np.array([0.5])},
        {"grid filter": np.array([0.6, 0.8, 1.3]), bumps.OTHERS: np.array([0.5])},
        {"odometry": 1.08, f"odometry, {bumps.OTHERS}": 0.4},
        (0.1, 0.9), np.array([0.17, 0.18, 0.25]), path, path, path, (grid, np.zeros(3)),
        np.array([[0.0, 0, 1, 1]]),
    )  # fmt: skip
    lines = table_of(bumps.FIGURE, result, tmp_path)
    assert "| grid filter | 0.70 (1.20) | 0.80 (1.30) | 1 of 3 |" in lines
    assert f"| {bumps.OTHERS} | 0.50 (0.50) | 0.50 (0.50) | 1 of 1 |" in lines
    assert "3 contacts; the true distance to the nearest wall is 0.180 m" in lines[-1]
    assert "advances by 0.10 of its odometry, in others by 0.90" in lines[-1]


def real_page(places: dict[str, str], data: Path, output: Path) -> Iterator[str]:
    return write_page(output / "real.md", places, places, lambda _, one: ((), one.measure(data)), [UNPROVEN])


def test_the_page_holds_what_was_measured_before_an_error(tmp_path: Path, monkeypatch) -> None:
    def measure(data: Path) -> str:
        require_recordings(data, "touch.csv")
        return "7 whiskers"

    def draw(result: str, picture: Path) -> None:
        picture.write_text(result)

    figures = {
        "good": Figure("Whiskers", lambda data: "7 whiskers", lambda result: [f"| {result} |"], draw),
        "bad": Figure("Fingers", measure, lambda result: [], draw),
    }
    monkeypatch.setattr(figures_of_papers, "find_figure", figures.__getitem__)
    output, lines = tmp_path / "new" / "page", list[str]()
    with pytest.raises(InputError, match=r"touch\.csv"):
        lines.extend(real_page(dict(zip(figures, figures, strict=True)), tmp_path, output))
    page = (output / "real.md").read_text(encoding="utf-8")
    assert lines == page.removesuffix(UNPROVEN).split("\n")[: len(lines)]
    assert {"| 7 whiskers |", "![Whiskers](good.png)"} <= set(lines)
    assert sorted(path.name for path in output.iterdir()) == ["good.png", "real.md"]
    assert page.endswith(UNPROVEN)


@pytest.mark.parametrize(
    ("name", "file"), [("drift", "reaching_take20"), ("bumps", r"create_lab_odometry\.csv")]
)
def test_nothing_is_left_where_a_recording_is_missing(tmp_path: Path, name: str, file: str) -> None:
    with pytest.raises(InputError, match=file):
        list(real_page({name: REAL[name]}, tmp_path, tmp_path / "page"))
    assert not (tmp_path / "page").exists()
