"""Revisits of places, and the errors of their offsets."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.papers.fox2012.reproduction import LEAVE_DISTANCE, find_revisits, path_metrics


def there_and_back(count: int = 40, far: float = 1.0) -> np.ndarray:
    x = np.concatenate([np.linspace(0, far, count), np.linspace(far, 0, count)])
    return np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])


def test_returns_are_found_as_revisits() -> None:
    truth = there_and_back()
    later, earlier = find_revisits(truth).T
    assert (later >= 40).all()
    assert np.abs(truth[later, 0] - truth[earlier, 0]).max() < 0.02
    assert truth[later, 0].max() < 1 - LEAVE_DISTANCE / 2 + 0.03  # not near the turn
    assert len(find_revisits(truth[:40])) == 0
    assert len(find_revisits(there_and_back(far=LEAVE_DISTANCE))) == 0


def test_revisits_are_closed_by_the_offset_of_the_two_visits() -> None:
    truth = there_and_back()
    shifted = truth + [3.0, -4.0, 0.1]
    found = path_metrics(shifted, shifted, truth)
    assert found["online_error"] == found["final_error"] == pytest.approx(5)
    assert found["revisit_gap"] == pytest.approx(0, abs=1e-12)
    assert found["revisits_closed"] == 1
    assert found["online_heading_error_deg"] == pytest.approx(np.degrees(0.1))
    drifted = truth + np.column_stack([np.zeros(80), np.linspace(0, 1, 80), np.zeros(80)])
    assert path_metrics(truth, drifted, truth)["revisits_closed"] == 0
    assert path_metrics(truth[:9], truth[:9], truth[:9])["revisits_closed"] is None
