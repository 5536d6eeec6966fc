"""Systematic errors are taken out of the odometry of every format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robot.recordings.formats import open_recording
from robot.recordings.mcap_writer import record_source
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources.in_memory import load_into_memory
from robot.sources.odometry import (
    OdometryCorrection,
    correct_motions,
    correct_observations,
    correct_odometry,
    from_motions,
)
from tactile.base.se2 import integrate
from tactile.base.types import Odometry, observation

ERRORS = OdometryCorrection(length_scale=0.9, turn_scale=1.2, heading_bias=-0.05)


def test_scaled_and_bent_motions_are_made_straight() -> None:
    random = np.random.default_rng(0)
    way, turn = random.uniform(0, 0.2, 300), random.normal(0, 0.2, 300)
    time = np.arange(300.0)
    truth = from_motions(time, way, 0.0, turn)
    measured = from_motions(time, way / 0.9, 0.0, (turn + 0.05 * way / 0.9) / 1.2)
    np.testing.assert_allclose(
        integrate(correct_motions(ERRORS, measured[:, :3])), integrate(truth[:, :3]), atol=1e-12
    )
    assert np.hypot(*(integrate(measured[:, :3]) - integrate(truth[:, :3]))[-1, :2]) > 1.0


def test_a_recording_is_corrected_as_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,distance,turn\n0,0,0\n1,0.1,0.2\n2,0.1,-0.1\n")
    config = RecordingConfig.model_validate({"file": tmp_path / "a.csv", "table": {"motion": {}}})
    with (
        open_recording(config) as plain,
        open_recording(config.model_copy(update={"odometry": ERRORS})) as corrected,
    ):
        first, second = load_into_memory(plain), load_into_memory(corrected)
    np.testing.assert_array_equal(second.motion[:, :3], correct_motions(ERRORS, first.motion[:, :3]))
    np.testing.assert_array_equal(second.motion[:, 3], first.motion[:, 3])
    assert first.digest != second.digest


def test_a_recording_of_whiskers_is_corrected_sample_by_sample(tmp_path: Path) -> None:
    file = tmp_path / "w.mcap"
    record_source(HeadSimulation(SimulationConfig.model_validate({"path": {"explore": 5}})), file)
    plain, corrected = (
        RecordingConfig.model_validate({"file": file, "odometry": odometry})
        for odometry in ({}, ERRORS.model_dump())
    )
    with open_recording(plain) as one, open_recording(corrected) as two:
        assert (two.length, two.whiskers, two.info) == (one.length, one.whiskers, one.info)
        for before, after in zip(one, two, strict=True):
            motion = np.array(before.reading.odometry, float)
            np.testing.assert_array_equal(
                np.array(after.reading.odometry, float), [*correct_motions(ERRORS, motion[:3]), motion[3]]
            )
            np.testing.assert_array_equal(after.reading.contact, before.reading.contact)


def test_without_errors_the_source_is_the_same_object() -> None:
    source = HeadSimulation(SimulationConfig.model_validate({"path": {"explore": 5}}))
    assert correct_odometry(source, OdometryCorrection()) is source


@pytest.mark.parametrize("name", ["length_scale", "turn_scale"])
def test_a_scale_is_positive(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        OdometryCorrection.model_validate({name: 0.0})


def test_observations_are_corrected_in_their_odometry_only() -> None:
    motion = np.array([[0.1, 0.0, 0.2], [0.0, 0.0, -0.3]])
    before = [observation(Odometry(*row, 0.5), np.ones((1, 2, 1))) for row in motion]
    after = correct_observations(ERRORS, before)
    np.testing.assert_array_equal([one.odometry[:3] for one in after], correct_motions(ERRORS, motion))
    assert [one.odometry.dt for one in after] == [0.5, 0.5]
    assert all(one.view is was.view for one, was in zip(after, before, strict=True))
    assert correct_observations(ERRORS, []) == []
