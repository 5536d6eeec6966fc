"""Perturbed copies of a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robot.recordings.npz_trace import read_trace
from robot.sources import perturbation
from robot.sources.perturbation import perturb
from tactile.base.se2 import between, integrate

ROOT = Path(__file__).parents[3]


@pytest.fixture
def log():
    return read_trace(ROOT / "tests" / "golden" / "a_square3.npz")


def test_a_perturbed_copy_follows_from_its_seed(log):
    first, again, other = perturb(log, 1), perturb(log, 1), perturb(log, 2)
    assert np.array_equal(first.motion, again.motion)
    assert np.array_equal(first.views, again.views)
    assert not np.array_equal(first.views[:50], other.views[:50])
    assert first.digest == f"{log.digest}+1"
    assert 10 <= len(log.time) - len(first.time) <= 80 + 40


def test_dropped_rows_leave_the_path_unchanged(log, monkeypatch):
    for name in ("VIEW_NOISE", "LENGTH_NOISE", "TURN_NOISE"):
        monkeypatch.setattr(perturbation, name, 0.0)
    monkeypatch.setattr(perturbation, "DROPPED", 0.5)
    copy = perturb(log, 3)
    rows = np.searchsorted(log.time, copy.time)
    assert len(rows) < 0.7 * len(log.time)
    whole, part = integrate(log.motion[:, :3]), integrate(copy.motion[:, :3])
    assert np.allclose(between(whole[rows[0]], whole[rows]), between(part[0], part), atol=1e-12)
    assert np.array_equal(copy.views, log.views[rows])
    assert np.array_equal(copy.truth, log.truth[rows])
    assert copy.motion[1:, 3].sum() == pytest.approx(copy.time[-1] - copy.time[0])


def test_some_labels_are_replaced_by_new_or_wrong_ones():
    label = np.where(np.arange(3000) % 3 == 0, np.arange(3000) // 300, -1).astype(np.int32)
    changed = perturbation.corrupt_labels(label, np.random.default_rng(0))
    given = label >= 0
    assert np.array_equal(changed < 0, ~given)
    new = changed[given] > label.max()
    assert 0.07 < new.mean() < 0.13
    assert len(np.unique(changed[given][new])) == new.sum()
    assert 0.02 < (changed[given][~new] != label[given][~new]).mean() < 0.06
