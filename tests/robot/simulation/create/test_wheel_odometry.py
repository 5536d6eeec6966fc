"""Wheel odometry errors of kind `measured` are those of real Creates, when analysed alike."""

from __future__ import annotations

import numpy as np
import pytest

from robot.simulation.create.wheel_odometry import WheelsConfig, simulate_wheel_odometry
from tactile.base.random_streams import stream


def drive_as_mrclam(runs: int, first: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
    """True motions and odometry [N, 4] of runs of 75 windows of 10 s: 0.055 m/s ahead, turns of 0.925 rad."""
    found = []
    for seed in range(first, first + runs):
        turn = np.repeat(stream(seed, "drive").choice([-0.0925, 0.0925], 75), 20)
        motion = np.column_stack([np.full(1500, 0.0275), np.zeros(1500), turn / 2, np.full(1500, 0.5)])
        config, kind = WheelsConfig(noise="measured"), np.ones(1500, int)
        found.append((motion, simulate_wheel_odometry(config, motion, kind, stream(seed, "wheels"))))
    return found


def windows(rows: np.ndarray) -> np.ndarray:
    """[K, 4] sums over windows of 10 s."""
    return rows.reshape(-1, 20, 4).sum(axis=1)


def analyse(motion: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """As the recordings were analysed: truth over odometry of length and turn, heading drift (rad/s), spread
    of a window's distance as a share of it, turn residual of a window (rad)."""
    true, odometry = windows(motion), windows(measured)
    length = true[:, 0].sum() / odometry[:, 0].sum()
    known = odometry[:, [2, 3]]
    turn, drift = np.linalg.lstsq(known, true[:, 2], rcond=None)[0]
    spread = (length * odometry[:, 0] - true[:, 0]).std() / true[:, 0].mean()
    return np.array([length, turn, drift, spread, (known @ [turn, drift] - true[:, 2]).std()])


def test_measured_errors_are_those_of_real_creates_when_analysed_alike() -> None:
    """Size: means and deviations of 200 runs within 4.5 standard errors; 0.002 for rounding."""
    found = np.array([analyse(*run) for run in drive_as_mrclam(200)])
    length, turn, drift, spread, residual = found.T
    # Least squares underrates a scale whose regressor errs: turns by 1 + 0.143 squared.
    for values, mean, sd in ((length, 0.927, 0.018), (turn, 0.950 / (1 + 0.143**2), 0.021)):
        assert values.mean() == pytest.approx(mean, abs=4.5 * sd / np.sqrt(200) + 0.002)
        assert values.std() == pytest.approx(sd, rel=4.5 / np.sqrt(400))
    assert 60 * drift.mean() == pytest.approx(-0.105, abs=4.5 * 0.11 / np.sqrt(200))
    assert np.quantile(spread, [0.1, 0.9]) == pytest.approx([0.10, 0.14], abs=0.01)
    low, high = np.quantile(residual, [0.1, 0.9])
    assert 0.10 <= low < high <= 0.17


def test_a_measured_heading_drifts_within_the_published_bounds() -> None:
    """A robot that drives straight ahead reports turns; its true heading drifts the other way."""
    motion = np.tile([0.025, 0.0, 0.0, 0.5], (200, 1))
    config, kind = WheelsConfig(noise="measured"), np.ones(200, int)
    drifts = []
    for seed in range(100):
        measured = simulate_wheel_odometry(config, motion, kind, stream(seed, "wheels"))
        rate = -0.950 * measured[:, 2] / measured[:, 3] * 60
        assert (rate[:20] == rate[0]).all()
        assert rate[0] != rate[20]  # another error of scale in the next 10 s
        drifts.append(np.median(rate))
    assert -0.26 < min(drifts) < -0.18  # the scale of a turn errs by some 4 % in the median of ten windows
    assert 0.0 < max(drifts) < 0.012
    assert np.mean(drifts) == pytest.approx(-0.105, abs=4.5 * 0.066 / 10)
