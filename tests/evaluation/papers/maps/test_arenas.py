"""The rows of grid maps, from planted sessions."""

from __future__ import annotations

import numpy as np

from evaluation.papers.maps.arenas import GRID, REPORTS, SOON, arena_figures, shuffled_contacts
from evaluation.papers.maps.localising import Judged
from evaluation.papers.maps.operations import Localised, Measured
from tests.evaluation.papers.maps.stand_ins import cells_by_figure
from tests.helpers.grid_world import report


def judged(found_at: int, error: float) -> Judged:
    found = np.arange(REPORTS) >= found_at
    errors = np.column_stack([np.full(REPORTS, error), np.zeros(REPORTS)])
    return Judged(found, ~found, found & (error <= 0.09), found & (error > 0.18), errors)


def figures(found_at: int, error: float, other_at: int) -> Measured:
    other = np.arange(REPORTS) >= other_at
    elsewhere = Localised(other, np.full(REPORTS, other_at >= REPORTS), np.zeros((REPORTS, 3)))
    session, shuffled = judged(found_at, error), judged(REPORTS, 1.0)
    return arena_figures(session, shuffled, elsewhere, np.full(REPORTS, 0.2))


def measured(*found: Measured) -> dict[str, str]:
    return {figure: values[0].split(" [")[0] for figure, values in cells_by_figure(GRID.table(found)).items()}


def test_right_and_wrong_sessions_are_counted() -> None:
    lines = measured(figures(SOON - 1, 0.02, REPORTS), figures(SOON, 0.03, SOON), figures(0, 0.5, REPORTS))
    assert lines["found and right within 300 reports"] == "1 of 3"
    assert lines["found and right within 900 reports"] == "2 of 3"
    assert lines["sure and wrong (> 0.18 m or 30 degrees)"] == "1 of 3"
    assert lines["found in another arena within 300 reports"] == "0 of 3"
    assert lines["found in another arena within 900 reports"] == "1 of 3"
    assert lines["says after 900 reports that this is not the map"].startswith("2 of 3")


def test_a_session_is_recorded_with_what_it_fails_in() -> None:
    def failed(one: Measured) -> list[str]:
        return [name for name, value in one.record.items() if value is True]

    assert failed(figures(SOON - 1, 0.02, REPORTS)) == []
    assert failed(figures(SOON, 0.03, SOON)) == ["missed_soon", "found_elsewhere", "not_said"]
    wrong = ["missed_soon", "missed", "sure_and_wrong", "best_wrong_soon", "best_wrong"]
    assert failed(figures(0, 0.5, REPORTS)) == wrong


def test_shuffled_contacts_keep_odometry_and_what_was_met() -> None:
    seen = [report(0.01 * k, touching=[k % 4] if k % 3 == 0 else []) for k in range(20)]
    mixed = shuffled_contacts(seen, 0)
    assert [one.odometry for one in mixed] == [one.odometry for one in seen]
    contacts, before = ([one.contact.tolist() for one in each] for each in (mixed, seen))
    assert sorted(contacts) == sorted(before)
    assert contacts != before
