"""The tables of pose cells at a small size."""

from __future__ import annotations

from typing import Any

import pytest

from evaluation.papers.cells.agreement import GOAL, compare_scores
from evaluation.papers.cells.costs import measure_analysis, measure_networks
from evaluation.papers.cells.shuffles import check_shuffles
from evaluation.papers.figure import CELLS, Task, find_figure


def rows_of(name: str, found: Any) -> int:
    """Rows of a table below its header."""
    return sum(line.startswith("| ") for line in find_figure(CELLS[name]).table(found)) - 1


@pytest.mark.parametrize("name", CELLS)
def test_every_figure_has_a_title_and_can_be_measured(name: str) -> None:
    figure = find_figure(CELLS[name])
    assert figure.title
    assert callable(figure.measure)


# In make test the same session as below, and so the same compiled kernel.
@pytest.mark.parametrize(("cells", "seconds"), [(12, 30.0), pytest.param(30, 120.0, marks=pytest.mark.soak)])
def test_scores_agree_with_other_packages(cells: int, seconds: float) -> None:
    pytest.importorskip("opexebo", reason="compared with")
    pytest.importorskip("pynapple", reason="compared with")
    found = compare_scores(Task(3, cells), seconds=seconds)
    assert {score: apart for score, _, _, apart, _ in found if not apart <= GOAL} == {}
    assert rows_of("agreement", found) == len(found)


@pytest.mark.soak
def test_shuffles_of_every_score_are_compared() -> None:
    found = check_shuffles(Task(3, 12), shuffles=19, seconds=60.0)
    _, rows = found
    assert len({score for _, score, *_ in rows}) == 13
    assert all(0 < cells.cells <= 12 for _, score, cells, *_ in rows if score == "information")
    assert rows_of("shuffles", found) == len(rows)


@pytest.mark.soak
def test_costs_are_measured() -> None:
    analysis = measure_analysis(cells=4, shuffles=19, seconds=60.0)
    assert all(min(numbers) > 0 for numbers in analysis[1])
    assert rows_of("analysis_cost", analysis) == 3
    networks = measure_networks(sets=1, steps=200)
    assert all(min(numbers) > 0 for numbers in networks[1])
    assert rows_of("networks", networks) == 2
