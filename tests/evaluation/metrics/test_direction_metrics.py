"""Association of laps in two directions on made-up laps."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.papers.salman2016.protocols import direction_metrics, lap_of_step
from evaluation.studies.metrics import lap_ends
from tests.helpers.laps import session, square

CHANGE = 0.3


@pytest.mark.parametrize("word", ["C", "CA", "CCCAAACACA"])
def test_laps_end_where_they_began(word):
    truth = square(word)
    ends = lap_ends(truth)
    assert ends.tolist() == [48 * (k + 1) for k in range(len(word))]
    assert np.bincount(lap_of_step(truth, len(word))).tolist() == [49, *[48] * (len(word) - 1)]


def test_laps_the_other_way_round_are_associated_by_experience_or_closure():
    word, truth = "CA", square("CA")
    new = direction_metrics(session(truth), word, CHANGE)
    assert (new["first_anticlockwise"], new["directions_apart"]) == (0, 0)
    nearest = [int(np.argmin(np.hypot(*(truth[:49, :2] - p[:2]).T))) for p in truth]
    known = direction_metrics(session(truth, place=np.array(nearest)), word, CHANGE)
    assert known["first_anticlockwise"] == known["associated_correct"] == 1
    far = np.where(np.arange(len(truth)) > 48, 24, nearest)
    wrong = direction_metrics(session(truth, place=far), word, CHANGE)
    assert wrong["first_anticlockwise"] == 1 > wrong["associated_correct"]
    closures = np.array([[k, nearest[k]] for k in range(49, 73)])
    half = direction_metrics(session(truth, closures=closures), word, CHANGE)
    assert half["first_anticlockwise"] == half["first_anticlockwise_correct"] == pytest.approx(0.5)
    assert half["associated_correct"] == 1
    assert wrong["first_anticlockwise_correct"] < 0.5


def test_a_step_closed_with_an_associated_step_is_associated():
    word, truth = "CAA", square("CAA")
    again = np.array([[k, k - 48] for k in range(97, 145)])
    none = direction_metrics(session(truth, closures=again), word, CHANGE)
    assert none["last_anticlockwise"] == 0
    first_lap = np.array([[k, 0] for k in range(49, 97)])
    all_of_it = direction_metrics(session(truth, closures=np.concatenate([first_lap, again])), word, CHANGE)
    assert all_of_it["last_anticlockwise"] == 1 > all_of_it["associated_correct"]


def test_the_distance_of_the_two_directions_is_measured_in_the_map():
    truth = square("CA")
    moved = truth + np.where(np.arange(len(truth)) > 48, 1, 0)[:, None] * [0.3, 0, 0]
    found = direction_metrics(session(truth, trajectory=moved), "CA", CHANGE)
    assert found["directions_apart"] == pytest.approx(0.3)
    assert np.isnan(direction_metrics(session(truth), "CC", CHANGE)["directions_apart"])


def test_closures_across_the_change_are_counted():
    truth = square("CCC")
    closures = np.array([[90, 2], [100, 80], [30, 4], [44, 42]])
    found = direction_metrics(session(truth, closures=closures), "CCC", CHANGE)
    assert found["across"] == 2  # 145 steps: the change is at 43
