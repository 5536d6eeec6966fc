"""Perturbed copies of a recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evaluation.studies import perturbation
from evaluation.studies.perturbation import perturb, repeat_course
from robot.recordings.npz_trace import read_trace
from tactile.base.errors import InputError
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


def test_a_course_is_repeated_with_noise_of_its_own(log):
    rows = len(log.time)
    long = repeat_course(log, 2 * rows + 5, 1)
    assert long.length == 2 * rows + 5
    assert (np.diff(long.time) > 0).all()
    assert np.array_equal(long.truth[rows : 2 * rows], log.truth)
    step = between(log.truth[-1], log.truth[0])
    assert long.motion[rows, :3] == pytest.approx(
        step, abs=6 * max(perturbation.TURN_NOISE, np.hypot(*step[:2]))
    )
    first, second = long.views[:rows], long.views[rows : 2 * rows]
    assert 0 < np.abs(first - second).max() < 20 * perturbation.VIEW_NOISE
    assert np.array_equal(long.motion, repeat_course(log, 2 * rows + 5, 1).motion)
    assert len({long.digest, repeat_course(log, 2 * rows, 1).digest, log.digest}) == 3


def test_a_course_without_truth_cannot_be_repeated(log):
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


@pytest.fixture
def drive(log):
    """A drive of 600 views that turns in every second step."""
    turn = np.where(np.arange(600) % 2, 0.2, 0.0)
    step = np.full(600, 0.1)
    return replace(
        log, time=np.arange(600.0), motion=np.column_stack([step, 0 * step, turn, 0 * step + 1]),
        moved=np.ones(600, bool), views=np.zeros((600, 1, 6, 1)), seen=np.ones(600, bool),
        label=np.full(600, -1, np.int32), truth=None,
    )  # fmt: skip


def motions(log, copy):
    """[n, 3] motions of a copy, and those of the log, of rows whose previous row is kept too."""
    rows = np.searchsorted(log.time, copy.time)
    direct = np.flatnonzero(np.diff(rows) == 1) + 1
    return copy.motion[direct, :3], log.motion[rows[direct], :3]


def test_a_miscalibrated_copy_follows_from_its_seed(log):
    first, again, other = (perturbation.miscalibrate(log, seed) for seed in (1, 1, 2))
    assert np.array_equal(first.motion, again.motion)
    assert not np.array_equal(first.motion[:50], other.motion[:50])
    assert first.digest != perturb(log, 1).digest
    assert 10 <= np.searchsorted(log.time, first.time[0]) <= 80
    assert np.array_equal(first.views, log.views[np.searchsorted(log.time, first.time)])


def test_bias_and_scale_hold_for_the_whole_copy(drive, monkeypatch):
    for name in ("LENGTH_NOISE", "TURN_PER_RADIAN", "TURN_PER_METRE"):
        monkeypatch.setattr(perturbation, name, 0.0)
    errors = []
    for seed in range(60):
        changed, given = motions(drive, perturbation.miscalibrate(drive, seed))
        scale, bias = changed[:, 0] / 0.1 - 1, (changed[:, 2] - given[:, 2]) / 0.1
        assert np.ptp(scale) < 1e-12 > np.ptp(bias)
        errors.append((scale[0], bias[0]))
    assert np.std(errors, axis=0) == pytest.approx([0.02, 0.01], rel=0.3)


def test_a_tenth_of_the_views_is_dropped_and_noise_grows_with_the_motion(drive, monkeypatch):
    monkeypatch.setattr(perturbation, "HEADING_BIAS", 0.0)
    monkeypatch.setattr(perturbation, "LENGTH_SCALE", 0.0)
    copies = [perturbation.miscalibrate(drive, seed) for seed in range(20)]
    after = sum(600 - copy.time[0] for copy in copies)
    assert sum(copy.length for copy in copies) / after == pytest.approx(0.9, abs=0.02)
    changed, given = (np.concatenate(part) for part in zip(*(motions(drive, c) for c in copies), strict=True))
    turning, error = given[:, 2] > 0, changed[:, 2] - given[:, 2]
    assert np.std(changed[:, 0]) == pytest.approx(0.02 * 0.1, rel=0.05)
    assert np.std(error[~turning]) == pytest.approx(0.005 * 0.1, rel=0.05)
    assert np.std(error[turning]) == pytest.approx(np.hypot(0.005 * 0.1, 0.02 * 0.2), rel=0.05)


@pytest.fixture
def labelled(log):
    label = np.where(np.arange(log.length) % 2 == 0, np.arange(log.length) // 2 % 50, -1).astype(np.int32)
    return replace(log, label=label)


def test_a_third_of_the_labels_is_lost_or_wrong(labelled):
    given = labelled.label >= 0
    lost = perturbation.spoil_labels(labelled, 1, "lost").label
    assert (lost[given] < 0).mean() == pytest.approx(1 / 3, abs=0.01)
    assert np.array_equal(lost[lost >= 0], labelled.label[lost >= 0])
    wrong = perturbation.spoil_labels(labelled, 1, "wrong").label
    assert (wrong != labelled.label)[given].mean() == pytest.approx(1 / 3, abs=0.01)
    assert set(wrong) <= set(labelled.label)
    assert np.array_equal(wrong < 0, ~given)


def test_new_labels_are_used_once_and_only_at_known_places(labelled):
    new = perturbation.spoil_labels(labelled, 1, "new").label
    changed = np.flatnonzero(new != labelled.label)
    assert len(np.unique(new[changed])) == len(changed)
    assert new[changed].min() > labelled.label.max()
    assert all(labelled.label[row] in labelled.label[:row] for row in changed)
    known = (labelled.label >= 0).sum() - 50
    assert len(changed) == pytest.approx(known / 3, abs=1)
    assert not np.array_equal(new, perturbation.spoil_labels(labelled, 2, "new").label)


@pytest.mark.parametrize("kind", ["lost", "wrong"])
def test_recordings_without_labels_are_not_spoilt(log, kind):
    assert np.array_equal(perturbation.spoil_labels(log, 1, kind).label, log.label)
