"""Sources in memory, their motion from poses and velocities, and the correction of systematic errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from robot.recordings.formats import open_recording
from robot.recordings.mcap_writer import record_source
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources import odometry
from robot.sources.in_memory import InMemorySource, cut_log, load_into_memory, select_rows, truncate_log
from robot.sources.odometry import MIDPOINT, TURN_THEN_MOVE, OdometryCorrection, correct_motions
from tactile.base.se2 import integrate, wrap
from tactile.base.types import Odometry, observation

MOTIONS = st.integers(1, 30).flatmap(lambda n: arrays(np.float64, (n, 3), elements=st.floats(-3, 3)))
ERRORS = OdometryCorrection(length_scale=0.9, turn_scale=1.2, heading_bias=-0.05)
ROWS, WHISKERS = 6, 4


def source(alive: np.ndarray) -> InMemorySource:
    return InMemorySource(
        name="test",
        digest="0",
        time=np.arange(ROWS, dtype=float),
        motion=np.ones((ROWS, 4)),
        moved=np.ones(ROWS, bool),
        views=np.zeros((ROWS, 1, WHISKERS, 1)),
        seen=np.ones(ROWS, bool),
        label=np.full(ROWS, -1, np.int32),
        alive=alive,
    )


def test_rows_have_their_flags_and_contacts() -> None:
    alive = np.arange(ROWS)[:, None] % 3 != np.arange(WHISKERS) % 3
    point = np.arange(ROWS * WHISKERS * 2, dtype=float).reshape(ROWS, WHISKERS, 2)
    log = replace(source(alive), contact=alive, point=point)
    for some, rows in ((select_rows(log, np.array([1, 4, 5])), [1, 4, 5]), (truncate_log(log, 3), range(3))):
        assert some.whiskers == WHISKERS
        for row, sample in zip(rows, some, strict=True):
            np.testing.assert_array_equal(sample.reading.alive, alive[row])
            np.testing.assert_array_equal(sample.reading.contact, alive[row])
            np.testing.assert_array_equal(sample.reading.point, point[row])
    np.testing.assert_array_equal(load_into_memory(log).alive, alive)
    for sample in source(alive[1]):  # one row of flags holds for all
        np.testing.assert_array_equal(sample.reading.alive, alive[1])


def test_a_cut_log_starts_without_motion_and_leaves_the_original() -> None:
    log = source(np.ones(WHISKERS, bool))
    part = cut_log(log, 2, 5)
    assert part.motion.any(axis=1).tolist() == [False, True, True]
    assert log.motion.all()
    assert part.digest == "0[2:5]"
    assert cut_log(log, 1).length == log.length - 1


@given(MOTIONS)
def test_motions_are_recovered_from_integrated_poses(motions: np.ndarray) -> None:
    motions[0] = 0
    found = odometry.from_poses(np.arange(len(motions)) * 0.5, integrate(motions))
    np.testing.assert_allclose(found[:, :2], motions[:, :2], atol=1e-9)
    np.testing.assert_allclose(wrap(found[:, 2] - motions[:, 2]), 0, atol=1e-9)
    assert found[:, 3].tolist() == [0.0] + [0.5] * (len(motions) - 1)


@given(MOTIONS, st.sampled_from([MIDPOINT, TURN_THEN_MOVE]))
def test_the_first_row_only_sets_the_clock(velocities: np.ndarray, heading: float) -> None:
    motion = odometry.from_velocities(np.arange(len(velocities)) + 7.0, *velocities.T, heading)
    assert (motion[0] == 0).all()
    np.testing.assert_allclose(np.hypot(*motion[1:, :2].T), np.hypot(*velocities[1:, :2].T), atol=1e-12)
    np.testing.assert_array_equal(motion[1:, 2], velocities[1:, 2])


def test_the_mid_heading_closes_a_circle() -> None:
    """Forty steps of 9 degrees: the mid heading has an error of second order, the new one of first order."""
    time, turn = np.arange(41) * 0.5, np.full(41, np.pi / 10)
    middle, after = (
        integrate(odometry.from_velocities(time, np.full(41, 0.1), 0.0, turn, heading)[:, :3])
        for heading in (MIDPOINT, TURN_THEN_MOVE)
    )
    np.testing.assert_allclose([middle[-1], after[-1]], 0, atol=1e-12)
    # Half a circle ends straight to the left.
    assert np.hypot(*middle[20, :2]) == pytest.approx(2 / np.pi, rel=2e-3)
    assert abs(middle[20, 0]) < 1e-12 < 0.04 < abs(after[20, 0])


def test_scaled_and_bent_motions_are_made_straight() -> None:
    random = np.random.default_rng(0)
    way, turn, time = random.uniform(0, 0.2, 300), random.normal(0, 0.2, 300), np.arange(300.0)
    truth = odometry.from_motions(time, way, 0.0, turn)
    measured = odometry.from_motions(time, way / 0.9, 0.0, (turn + 0.05 * way / 0.9) / 1.2)
    assert np.hypot(*(integrate(measured[:, :3]) - integrate(truth[:, :3]))[-1, :2]) > 1.0
    corrected = integrate(correct_motions(ERRORS, measured[:, :3]))
    np.testing.assert_allclose(corrected, integrate(truth[:, :3]), atol=1e-12)


@pytest.mark.parametrize("kind", ["table", "whiskers"])
def test_a_recording_is_corrected_as_it_is_read(kind: str, tmp_path: Path) -> None:
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


@pytest.mark.parametrize("name", ["length_scale", "turn_scale"])
def test_a_scale_is_positive(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        OdometryCorrection.model_validate({name: 0.0})


def test_observations_are_corrected_in_their_odometry_only() -> None:
    motion = np.array([[0.1, 0.0, 0.2], [0.0, 0.0, -0.3]])
    before = [observation(Odometry(*row, 0.5), np.ones((1, 2, 1))) for row in motion]
    after = odometry.correct_observations(ERRORS, before)
    np.testing.assert_array_equal([one.odometry[:3] for one in after], correct_motions(ERRORS, motion))
    assert [one.odometry.dt for one in after] == [0.5, 0.5]
    assert all(one.view is was.view for one, was in zip(after, before, strict=True))
    assert odometry.correct_observations(ERRORS, []) == []
