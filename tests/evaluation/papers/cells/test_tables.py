"""The tables of pose cells at a small size."""

from __future__ import annotations

import pytest

from evaluation.papers.cells.agreement import GOAL, compare_scores
from evaluation.papers.cells.analysis_cost import measure_analysis
from evaluation.papers.cells.networks import measure_networks
from evaluation.papers.cells.shuffles import check_shuffles
from evaluation.papers.figure import CELLS, Task, find_figure


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
    assert {one.score: one.difference() for one in found if not one.difference() <= GOAL} == {}
    assert len(list(find_figure(CELLS["agreement"]).table(found))) == 2 + len(found)


@pytest.mark.soak
def test_shuffles_of_every_score_are_compared() -> None:
    found = check_shuffles(Task(3, 12), shuffles=19, seconds=60.0)
    _, rows = found
    assert len({row.score for row in rows}) == 13
    assert all(0 < row.calibration.cells <= 12 for row in rows if row.score == "information")
    assert len(list(find_figure(CELLS["shuffles"]).table(found))) == 2 + len(rows)


@pytest.mark.soak
def test_costs_are_measured() -> None:
    analysis = measure_analysis(cells=4, shuffles=19, seconds=60.0)
    assert all(taken.processor > 0 for _, taken in analysis[1].values())
    assert len(list(find_figure(CELLS["analysis_cost"]).table(analysis))) == 5
    networks = measure_networks(sets=1, steps=200)
    assert len(list(find_figure(CELLS["networks"]).table(networks))) == 4
    assert all(min(numbers) > 0 for numbers in networks[2].values())
