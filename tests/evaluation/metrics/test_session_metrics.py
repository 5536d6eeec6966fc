"""Metrics of sessions on made-up laps: ends of laps, energies, false closures."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.studies.metrics import lap_ends, touch_metrics
from tactile.base.se2 import compose
from tests.helpers.laps import session, square


def test_a_path_that_never_returns_has_no_laps():
    assert len(lap_ends(square("C")[:40])) == 0


def test_a_perfect_map_has_no_energy_in_any_frame():
    truth = square("CC")
    moved = compose(np.array([3.0, -1.0, 2.0]), truth)
    place = np.arange(len(truth)) % 48
    perfect = session(truth, trajectory=moved, place=place, node=moved[:48])
    trial = touch_metrics(perfect)
    assert trial.em == pytest.approx(0, abs=1e-9)
    assert trial.em_experiences == pytest.approx(0, abs=1e-9)
    assert (trial.arcr, trial.arcr_chain_free) == (1, 1)
    assert trial.arr > 0.9  # the base set ends a few steps before the places begin again
    assert touch_metrics(session(truth)).arr == 0


def test_closures_are_false_from_ten_centimetres_on():
    truth = square("CC")
    closures = np.array([[48, 0], [50, 2], [60, 8], [60, 30]])
    trial = touch_metrics(session(truth, closures=closures))
    assert (trial.closures, trial.false_closures) == (4, 2)


def test_a_step_lies_where_its_experience_does():
    truth = square("CC")
    spread = session(truth, place=np.arange(len(truth)) // 4, node=truth[::4])
    trial = touch_metrics(spread)
    assert trial.em == 0 < trial.em_experiences
