"""What a finished session knows of its odometry, as settings from which the next one starts."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from ratslam.mapping.config import KeyframeMapConfig
from ratslam.mapping.odometry_calibration import HeadingNoise, starting_calibration, write_calibration
from ratslam.mapping.optimizer import CalibrationPrior, MapCovariance
from tactile.base.se2 import wrap
from tests.ratslam.mapping.map_cases import BIAS, CELL, LAP, TRUE, drive, new_map
from tests.ratslam.mapping.test_calibration_consistency import calibration_covariance, sessions

__all__ = ["sessions"]


def written(path, map):
    map.files()["calibration.yaml"](path)
    return KeyframeMapConfig.model_validate(yaml.safe_load(path.read_text())["keyframes"])


def test_without_a_calibration_the_map_starts_from_zero():
    config = KeyframeMapConfig()
    expected = CalibrationPrior(0.0, config.bias_sd / CELL, 0.0, config.turn_error_sd)
    assert starting_calibration(config, CELL) == expected
    assert HeadingNoise.of_start(config) == HeadingNoise()


def test_what_is_written_is_what_the_next_session_starts_from(tmp_path):
    known, noise = CalibrationPrior(0.0123, 0.004, -0.05, 0.006), HeadingNoise(np.log(1.7), 0.2)
    write_calibration(tmp_path / "calibration.yaml", known, noise)
    text = (tmp_path / "calibration.yaml").read_text()
    config = KeyframeMapConfig.model_validate(yaml.safe_load(text)["keyframes"])
    assert starting_calibration(config, CELL) == pytest.approx(known)
    assert HeadingNoise.of_start(config).factor == pytest.approx(noise.factor)


def test_turns_without_systematic_error_have_none_to_start_from():
    start = {"turn_error": 0.1, "turn_error_sd": 0.01}
    config = KeyframeMapConfig.model_validate({"turn_error_sd": 0.0, "calibration": start})
    assert starting_calibration(config, CELL)[2:] == (0.0, 0.0)


def test_impossible_calibrations_are_refused():
    for wrong in ({"turn_error": -1.0}, {"heading_bias_sd": 0.0}, {"heading_noise": 0.0}):
        with pytest.raises(ValidationError):
            KeyframeMapConfig.model_validate({"calibration": wrong})


def test_a_finished_map_writes_the_bias_that_closures_show(tmp_path):
    config = written(tmp_path / "calibration.yaml", drive(new_map(), TRUE))
    start = config.calibration
    assert start.heading_bias == pytest.approx(BIAS, abs=3 * start.heading_bias_sd)
    assert start.heading_bias_sd < new_map().config.bias_sd / CELL


def test_the_next_session_begins_with_it(tmp_path):
    """Without closures its path is that of corrected odometry, from the first step on."""
    config = written(tmp_path / "calibration.yaml", drive(new_map(), TRUE))
    warm, cold = drive(new_map(calibration=config.calibration.model_dump()), {}), drive(new_map(), {})
    assert warm.keyframes().bias == config.calibration.heading_bias
    turned = 2 * np.pi / LAP * (LAP + 59)
    off = [abs(wrap(one.trajectory()[-1, 2] - one.trajectory()[0, 2] - turned)) for one in (warm, cold)]
    assert off[0] < 0.2 * off[1]


def test_standard_deviations_are_those_of_the_dense_equations(sessions):
    for session in sessions[:3]:
        found = MapCovariance(session.fit, session.problem).calibration_sd()
        assert found == pytest.approx(np.sqrt(np.diag(calibration_covariance(session))), rel=1e-4)


def test_the_live_pose_is_odometry_until_a_closure_is_accepted():
    """Before that, a heading bias is no more than a belief, and it may be wrong."""
    map = drive(new_map(), {}, last=60)
    graph = map.keyframes()
    expected = graph.dead_reckoned()[-1]
    graph.bias = 0.05
    graph.dead_reckon()
    assert graph.pose.rows[-1] != pytest.approx(expected)
    assert map.pose(None) == pytest.approx(expected)
    closed = drive(new_map(), TRUE)
    assert len(closed.closures())
    assert closed.pose(None) == pytest.approx(closed.keyframes().pose.rows[-1])
