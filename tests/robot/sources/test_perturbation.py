"""Perturbed copies of a recording, and controls: shuffled, blank and ideal views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evaluation.papers.trial_sessions import apply_control
from evaluation.studies import perturbation
from evaluation.studies.perturbation import miscalibrate, perturb, repeat_course, spoil_labels
from robot.recordings.npz_trace import read_trace
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources.in_memory import load_into_memory
from robot.touch_source import open_touch_source
from tactile.base.errors import InputError
from tactile.base.se2 import between, integrate
from tactile.frontend import TouchConfig


@pytest.fixture
def log(golden):
    return read_trace(golden / "a_square3.npz")


@pytest.fixture
def labelled(log):
    label = np.where(np.arange(log.length) % 2 == 0, np.arange(log.length) // 2 % 50, -1).astype(np.int32)
    return replace(log, label=label)


@pytest.mark.parametrize("copy", [perturb, miscalibrate])
def test_a_copy_follows_from_its_seed(log, copy):
    first, again, other = copy(log, 1), copy(log, 1), copy(log, 2)
    assert np.array_equal(first.motion, again.motion)
    assert np.array_equal(first.views, again.views)
    assert not np.array_equal(first.motion[:50], other.motion[:50])
    assert len({first.digest, other.digest, log.digest}) == 3
    assert 10 <= np.searchsorted(log.time, first.time[0]) <= 80
    unchanged = np.array_equal(first.views, log.views[np.searchsorted(log.time, first.time)])
    assert unchanged == (copy is miscalibrate)


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


def test_a_course_is_repeated_with_noise_of_its_own(log):
    rows = len(log.time)
    long = repeat_course(log, 2 * rows + 5, 1)
    assert long.length == 2 * rows + 5
    assert (np.diff(long.time) > 0).all()
    assert np.array_equal(long.truth[rows : 2 * rows], log.truth)
    step = between(log.truth[-1], log.truth[0])
    noise = 6 * max(perturbation.TURN_NOISE, np.hypot(*step[:2]))
    assert long.motion[rows, :3] == pytest.approx(step, abs=noise)
    off = long.views[:rows] - long.views[rows : 2 * rows]
    assert 0 < np.abs(off).max() < 0.2
    assert off[np.minimum(log.views, 1 - log.views) > 0.05].std() == pytest.approx(0.014, rel=0.05)
    assert np.array_equal(long.motion, repeat_course(log, 2 * rows + 5, 1).motion)
    assert len({long.digest, repeat_course(log, 2 * rows, 1).digest, log.digest}) == 3
    with pytest.raises(InputError, match="no true pose of its first and last row"):
        repeat_course(replace(log, truth=None), 100, 0)


def test_some_labels_are_replaced_by_new_or_wrong_ones(log):
    rows = np.arange(log.length)
    label = np.where(rows % 3 == 0, rows * 10 // log.length, -1).astype(np.int32)
    labelled = replace(log, label=label)
    label, changed = np.resize(label, 9 * log.length), repeat_course(labelled, 9 * log.length, 0).label
    given = label >= 0
    assert np.array_equal(changed < 0, ~given)
    new = changed[given] > label.max()
    assert 0.07 < new.mean() < 0.13
    assert len(np.unique(changed[given][new])) == new.sum()
    assert 0.02 < (changed[given][~new] != label[given][~new]).mean() < 0.06


def test_a_third_of_the_labels_is_lost_or_wrong_or_new(labelled, log):
    label = labelled.label
    given = label >= 0
    lost, wrong, new = (spoil_labels(labelled, 1, kind).label for kind in ("lost", "wrong", "new"))
    assert (lost[given] < 0).mean() == pytest.approx(1 / 3, abs=0.01)
    assert np.array_equal(lost[lost >= 0], label[lost >= 0])
    assert (wrong != label)[given].mean() == pytest.approx(1 / 3, abs=0.01)
    assert set(wrong) <= set(label)
    assert np.array_equal(wrong < 0, ~given)
    # New labels are used once, and only at places known by then.
    changed = np.flatnonzero(new != label)
    assert len(np.unique(new[changed])) == len(changed)
    assert new[changed].min() > label.max()
    assert all(label[row] in label[:row] for row in changed)
    assert len(changed) == pytest.approx((given.sum() - 50) / 3, abs=1)
    assert not np.array_equal(new, spoil_labels(labelled, 2, "new").label)
    for kind in ("lost", "wrong"):
        assert np.array_equal(spoil_labels(log, 1, kind).label, log.label)


def test_controls_change_only_the_views():
    given = {"maze": {"columns": 2, "rows": 2, "loop": 4}, "path": {"circuits": "CCA"}}
    simulation = HeadSimulation(SimulationConfig.model_validate(given), TouchConfig().head)
    log = load_into_memory(open_touch_source(simulation, TouchConfig()))
    assert apply_control(log, "none", 1) is log
    shuffled, blank, ideal = (apply_control(log, control, 1) for control in ("shuffled", "blank", "ideal"))
    for changed in (shuffled, blank, ideal):
        assert changed.views.shape == log.views.shape
        assert not np.array_equal(changed.views, log.views)
        assert np.array_equal(changed.motion, log.motion)
        assert np.array_equal(changed.truth, log.truth)
    assert np.array_equal(np.sort(shuffled.views.reshape(-1)), np.sort(log.views.reshape(-1)))
    assert not blank.views.any()
    # Ideal views are equal exactly at one spot and heading.
    assert np.array_equal(ideal.views, apply_control(log, "ideal", 1).views)
    x, y, heading = np.asarray(log.truth).T
    spot = np.stack([np.round(x / 0.06), np.round(y / 0.06), np.round(heading / (np.pi / 4)) % 8], axis=1)
    same = (spot[:, None] == spot[None]).all(axis=2)
    views = ideal.views.reshape(log.length, -1)
    assert np.array_equal(same, (views[:, None] == views[None]).all(axis=2))
    assert same.sum() > log.length
    assert 0.4 < (views > 0).mean() < 0.6


def test_a_seed_gives_the_same_copies_for_ever(labelled):
    copies = perturb(labelled, 1), miscalibrate(labelled, 1), repeat_course(labelled, 2 * labelled.length, 1)
    found = [
        (copy.length, *copy.motion.sum(axis=0), copy.views.sum(), np.maximum(copy.label, 0).sum())
        for copy in copies
    ]
    known = [
        [285, 10.3078433, 0.0315826704, 18.4743805, 153, 2544.9039, 4053],
        [272, 10.3716053, 0.0514087348, 18.5734653, 153, 2436.32237, 3091],
        [698, 23.9191857, 0.0513127263, 40.289614, 348.5, 6243.61122, 9186],
    ]
    np.testing.assert_allclose(found, known, rtol=1e-6, atol=1e-9)
