"""Scales, heading bias and noise of wheels are found again where they are known."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.metrics.trajectory import ate
from ratslam.service.rig_fit import WheelFit, fit_wheels
from robot.sources.odometry import correct_motions, from_motions
from tactile.base.errors import InputError
from tactile.base.se2 import integrate

LENGTH, TURN, BIAS = 0.93, 1.12, -0.04
HEADING_NOISE, TURN_NOISE = 0.03, 0.05  # rad per root metre, rad per root radian
ROWS, STEP = 3000, 0.5


def drive(seed: int, rows: int = ROWS, turning: float = 0.25) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, odometry with the errors above, and true poses of a robot."""
    random = np.random.default_rng(seed)
    time = STEP * np.arange(rows)
    way, turn = random.uniform(0, 0.2, rows), turning * random.standard_normal(rows)
    motion = from_motions(time, way, 0.0, turn)[:, :3]
    noise = HEADING_NOISE * np.sqrt(way) * random.standard_normal(rows)
    noise += TURN_NOISE * np.sqrt(np.abs(turn)) * random.standard_normal(rows)
    noise[0] = way[0] = turn[0] = 0
    true = from_motions(time, LENGTH * way, 0.0, TURN * turn + BIAS * way + noise)[:, :3]
    return time, motion, integrate(true)


def sure(found: tuple[float, float], value: float, sds: float = 4.0) -> None:
    assert abs(found[0] - value) < sds * found[1], (found, value)


@pytest.fixture(scope="module")
def found() -> WheelFit:
    return fit_wheels(*drive(0))


def test_systematic_errors_are_found(found: WheelFit) -> None:
    assert found.turn_scale is not None
    sure(found.length_scale, LENGTH)
    sure(found.turn_scale, TURN)
    sure(found.heading_bias, BIAS)
    assert found.length_scale[1] < 0.01
    assert found.turn_scale[1] < 0.01
    assert found.heading_bias[1] < 0.01


def test_noise_is_found(found: WheelFit) -> None:
    per_row = np.hypot(HEADING_NOISE * np.sqrt(0.1), TURN_NOISE * np.sqrt(0.2))
    seen = np.hypot(found.heading_noise[0] * np.sqrt(0.1), found.turn_noise[0] * np.sqrt(0.2))
    assert abs(seen / per_row - 1) < 0.15
    assert found.slips <= 2


def test_standard_deviations_are_those_between_records() -> None:
    """Over several records, errors are about as large as said."""
    fits = [fit_wheels(*drive(seed, 1200)) for seed in range(1, 7)]
    off = np.array([(fit.heading_bias[0] - BIAS) / fit.heading_bias[1] for fit in fits])
    assert 0.2 < np.sqrt((off**2).mean()) < 2.5


def test_the_correction_found_on_one_half_helps_the_other() -> None:
    time, motion, truth = drive(7)
    half = ROWS // 2
    correction = fit_wheels(time[:half], motion[:half], truth[:half]).correction
    rest = motion[half:]
    before = ate(integrate(rest), truth[half:])
    assert ate(integrate(correct_motions(correction, rest)), truth[half:]) < 0.5 * before


def test_a_slipping_wheel_is_counted_and_spoils_little() -> None:
    time, motion, truth = drive(8)
    true = motion.copy()
    slips = [500, 1500, 2500]
    motion = motion.copy()
    motion[slips, 2] += 2.0
    clean, spoilt = fit_wheels(time, true, truth), fit_wheels(time, motion, truth)
    assert spoilt.slips >= 2
    assert clean.turn_scale is not None
    assert spoilt.turn_scale is not None
    assert abs(spoilt.turn_scale[0] - clean.turn_scale[0]) < 0.02


def test_rows_without_truth_are_bridged() -> None:
    time, motion, truth = drive(9)
    truth[::3] = np.nan
    found = fit_wheels(time, motion, truth)
    sure(found.length_scale, LENGTH)
    sure(found.heading_bias, BIAS)


def test_a_robot_that_hardly_turns_has_no_turn_scale() -> None:
    found = fit_wheels(*drive(10, turning=1e-4))
    assert found.turn_scale is None
    sure(found.heading_bias, BIAS)


def test_the_bootstrap_is_reproducible() -> None:
    record = drive(11, 600)
    found = fit_wheels(*record, seed=3)
    assert found == fit_wheels(*record, seed=3)
    assert found.turn_scale != fit_wheels(*record, seed=4).turn_scale


@pytest.mark.parametrize("spoil", ["short", "still", "unknown"])
def test_a_record_that_tells_nothing_is_refused(spoil: str) -> None:
    time, motion, truth = drive(12, 600)
    if spoil == "short":
        time, motion, truth = time[:50], motion[:50], truth[:50]
    elif spoil == "still":
        motion = np.zeros_like(motion)
    else:
        truth = np.full_like(truth, np.nan)
    with pytest.raises(InputError, match="windows"):
        fit_wheels(time, motion, truth)
