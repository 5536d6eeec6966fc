"""Sources in memory, their motion, corrections, perturbed copies, and controls with other views."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from evaluation.papers.trial_sessions import apply_control
from evaluation.studies import perturbation
from evaluation.studies.perturbation import miscalibrate, perturb, repeat_course, spoil_labels
from robot.recordings.formats import open_recording
from robot.recordings.mcap_writer import record_source
from robot.recordings.npz_trace import read_trace
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources import odometry
from robot.sources.in_memory import InMemorySource, cut_log, load_into_memory, select_rows, truncate_log
from robot.sources.odometry import MIDPOINT, TURN_THEN_MOVE, OdometryCorrection, correct_motions
from robot.touch_source import open_touch_source
from tactile.base.errors import InputError
from tactile.base.se2 import between, integrate, wrap
from tactile.base.types import Odometry, observation
from tactile.frontend import TouchConfig

MOTIONS = st.integers(1, 30).flatmap(lambda n: arrays(np.float64, (n, 3), elements=st.floats(-3, 3)))
ERRORS = OdometryCorrection(length_scale=0.9, turn_scale=1.2, heading_bias=-0.05)
ROWS, WHISKERS = 6, 4


def source(alive: np.ndarray) -> InMemorySource:
    time, every, label = np.arange(ROWS, dtype=float), np.ones(ROWS, bool), np.full(ROWS, -1, np.int32)
    motion, views = np.ones((ROWS, 4)), np.zeros((ROWS, 1, WHISKERS, 1))
    return InMemorySource("test", "0", time, motion, every, views, every, label, alive=alive)


def test_rows_have_their_flags_and_contacts():
    alive = np.arange(ROWS)[:, None] % 3 != np.arange(WHISKERS) % 3
    point = np.arange(ROWS * WHISKERS * 2, dtype=float).reshape(ROWS, WHISKERS, 2)
    log = replace(source(alive), contact=alive, point=point)
    for some, rows in ((select_rows(log, np.array([1, 4, 5])), [1, 4, 5]), (truncate_log(log, 3), range(3))):
        assert some.whiskers == WHISKERS
        for row, sample in zip(rows, some, strict=True):
            for name, values in (("alive", alive), ("contact", alive), ("point", point)):
                np.testing.assert_array_equal(getattr(sample.reading, name), values[row])
    np.testing.assert_array_equal(load_into_memory(log).alive, alive)
    for sample in source(alive[1]):  # one row of flags holds for all
        np.testing.assert_array_equal(sample.reading.alive, alive[1])
    log = source(np.ones(WHISKERS, bool))
    part = cut_log(log, 2, 5)
    assert part.motion.any(axis=1).tolist() == [False, True, True]
    assert log.motion.all()
    assert part.digest == "0[2:5]"
    assert cut_log(log, 1).length == log.length - 1


@given(MOTIONS, st.sampled_from([MIDPOINT, TURN_THEN_MOVE]))
def test_motions_come_from_poses_and_velocities(motions, heading):
    motion = odometry.from_velocities(np.arange(len(motions)) + 7.0, *motions.T, heading)
    assert (motion[0] == 0).all()
    np.testing.assert_allclose(np.hypot(*motion[1:, :2].T), np.hypot(*motions[1:, :2].T), atol=1e-12)
    np.testing.assert_array_equal(motion[1:, 2], motions[1:, 2])
    motions[0] = 0
    found = odometry.from_poses(np.arange(len(motions)) * 0.5, integrate(motions))
    np.testing.assert_allclose(found[:, :2], motions[:, :2], atol=1e-9)
    np.testing.assert_allclose(wrap(found[:, 2] - motions[:, 2]), 0, atol=1e-9)
    assert found[:, 3].tolist() == [0.0] + [0.5] * (len(motions) - 1)


def test_scaled_and_bent_motions_are_made_straight():
    random = np.random.default_rng(0)
    way, turn, time = random.uniform(0, 0.2, 300), random.normal(0, 0.2, 300), np.arange(300.0)
    truth = odometry.from_motions(time, way, 0.0, turn)
    measured = odometry.from_motions(time, way / 0.9, 0.0, (turn + 0.05 * way / 0.9) / 1.2)
    assert np.hypot(*(integrate(measured[:, :3]) - integrate(truth[:, :3]))[-1, :2]) > 1.0
    corrected = integrate(correct_motions(ERRORS, measured[:, :3]))
    np.testing.assert_allclose(corrected, integrate(truth[:, :3]), atol=1e-12)


@pytest.mark.parametrize("kind", ["table", "whiskers"])
def test_a_recording_is_corrected_as_it_is_read(kind, tmp_path):
    if kind == "table":
        (tmp_path / "a.csv").write_text("t,distance,turn\n0,0,0\n1,0.1,0.2\n2,0.1,-0.1\n")
        given = {"file": tmp_path / "a.csv", "table": {"motion": {}}}
    else:
        simulation = HeadSimulation(SimulationConfig.model_validate({"path": {"explore": 5}}))
        record_source(simulation, tmp_path / "w.mcap")
        given = {"file": tmp_path / "w.mcap"}
        assert odometry.correct_odometry(simulation, OdometryCorrection()) is simulation
    config = RecordingConfig.model_validate(given)
    errors = config.model_copy(update={"odometry": ERRORS})
    with open_recording(config) as plain, open_recording(errors) as corrected:
        assert plain.digest != corrected.digest
        same = ("name", "rate_hz", "view_shape", "whiskers", "length", "info")
        assert [getattr(corrected, name) for name in same] == [getattr(plain, name) for name in same]
        for before, after in zip(plain, corrected, strict=True):
            motion = np.array(before.reading.odometry, float)
            expected = [*correct_motions(ERRORS, motion[:3]), motion[3]]
            np.testing.assert_array_equal(np.array(after.reading.odometry, float), expected)
            np.testing.assert_array_equal(after.reading.contact, before.reading.contact)


def test_observations_are_corrected_in_their_odometry_only_by_positive_scales():
    motion = np.array([[0.1, 0.0, 0.2], [0.0, 0.0, -0.3]])
    before = [observation(Odometry(*row, 0.5), np.ones((1, 2, 1))) for row in motion]
    after = odometry.correct_observations(ERRORS, before)
    np.testing.assert_array_equal([one.odometry[:3] for one in after], correct_motions(ERRORS, motion))
    assert [one.odometry.dt for one in after] == [0.5, 0.5]
    assert all(one.view is was.view for one, was in zip(after, before, strict=True))
    assert odometry.correct_observations(ERRORS, []) == []
    for name in ("length_scale", "turn_scale"):
        with pytest.raises(ValueError, match=name):
            OdometryCorrection.model_validate({name: 0.0})


@pytest.fixture
def log(golden):
    return read_trace(golden / "a_square3.npz")


@pytest.fixture
def labelled(log):
    rows = np.arange(log.length)
    return replace(log, label=np.where(rows % 2 == 0, rows // 2 % 50, -1).astype(np.int32))


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
    assert len({long.digest, repeat_course(log, 2 * rows, 1).digest, log.digest}) == 3
    with pytest.raises(InputError, match="no true pose of its first and last row"):
        repeat_course(replace(log, truth=None), 100, 0)


def test_some_labels_are_replaced_by_new_or_wrong_ones(log):
    rows, long = np.arange(log.length), 9 * log.length
    label = np.where(rows % 3 == 0, rows * 10 // log.length, -1).astype(np.int32)
    label, changed = np.resize(label, long), repeat_course(replace(log, label=label), long, 0).label
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
    for copy in (perturb, miscalibrate):
        first, other = copy(labelled, 1), copy(labelled, 2)
        assert not np.array_equal(first.motion[:50], other.motion[:50])
        assert len({first.digest, other.digest, labelled.digest}) == 3
        unchanged = np.array_equal(first.views, labelled.views[np.searchsorted(labelled.time, first.time)])
        assert unchanged == (copy is miscalibrate)
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
