"""Wheel odometry errors: statistics of each kind of noise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.simulation.create.wheel_odometry import WheelsConfig, simulate_wheel_odometry
from tactile.base.random_streams import stream
from tactile.base.types import MotionKind

KINDS = ("white", "move", "bias", "none")


def drive_and_turn(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Motions [N, 4] and kinds [N]: seven steps ahead, one back, two of turning, repeated."""
    phase = np.arange(count) % 10
    kind = np.where(phase < 7, MotionKind.FORWARD, np.where(phase < 8, MotionKind.BACK, MotionKind.TURN))
    motion = np.zeros((count, 4))
    motion[:, 0] = np.where(kind == MotionKind.FORWARD, 0.025, np.where(kind == MotionKind.BACK, -0.025, 0.0))
    motion[:, 2] = np.where(kind == MotionKind.TURN, 0.15, 0.0)
    motion[:, 3] = 0.5
    return motion, kind


def scales(
    noise: str, count: int = 3000, seed: int = 0, level: float = 0.05
) -> tuple[np.ndarray, np.ndarray]:
    """Ratio of measured to true motion of each step, and its kind."""
    motion, kind = drive_and_turn(count)
    measured = simulate_wheel_odometry(
        WheelsConfig(noise=noise, level=level), motion, kind, stream(seed, "wheels")
    )
    column = np.where(kind == MotionKind.TURN, 2, 0)
    rows = np.arange(count)
    return measured[rows, column] / motion[rows, column], kind


@given(st.integers(0, 10**6), st.sampled_from(KINDS))
def test_only_moving_parts_have_errors(seed: int, noise: str) -> None:
    motion, kind = drive_and_turn(40)
    config = WheelsConfig(noise=noise)
    measured = simulate_wheel_odometry(config, motion, kind, stream(seed, "wheels"))
    assert (measured[motion == 0] == 0).all()
    assert (measured[:, 3] == motion[:, 3]).all()
    assert (measured == simulate_wheel_odometry(config, motion, kind, stream(seed, "wheels"))).all()
    if noise != "none":
        assert (measured != simulate_wheel_odometry(config, motion, kind, stream(seed + 1, "wheels"))).any()
    assert (motion == drive_and_turn(40)[0]).all()


def test_without_noise_odometry_is_the_truth() -> None:
    motion, kind = drive_and_turn(30)
    for config in (WheelsConfig(noise="none"), WheelsConfig(noise="move", level=0.0)):
        assert (simulate_wheel_odometry(config, motion, kind, stream(0, "wheels")) == motion).all()
    assert simulate_wheel_odometry(WheelsConfig(), motion[:0], kind[:0], stream(0, "wheels")).shape == (0, 4)


def test_white_noise_is_of_its_level_and_independent() -> None:
    scale, _ = scales("white")
    assert scale.mean() == pytest.approx(1, abs=0.005)
    assert scale.std() == pytest.approx(0.05, rel=0.05)
    assert abs(np.corrcoef(scale[:-1], scale[1:])[0, 1]) < 0.06
    doubled, _ = scales("white", level=0.1)
    assert np.allclose(doubled - 1, 2 * (scale - 1))


def test_an_error_lasts_one_straight_or_turn() -> None:
    scale, kind = scales("move")
    same = kind[1:] == kind[:-1]
    assert np.allclose(scale[1:][same], scale[:-1][same])
    assert (np.abs(np.diff(scale))[~same] > 1e-9).all()
    assert scale[1:][~same].std() == pytest.approx(0.05, rel=0.1)


def test_a_bias_lasts_the_session() -> None:
    lengths, turns = [], []
    for seed in range(300):
        scale, kind = scales("bias", 200, seed)
        turned = kind == MotionKind.TURN
        assert scale[~turned].std() == pytest.approx(0.01, rel=0.3)
        lengths.append(scale[~turned].mean())
        turns.append(scale[turned].mean())
    assert np.std(lengths) == pytest.approx(0.05, rel=0.15)
    assert np.std(turns) == pytest.approx(0.05, rel=0.15)
    assert abs(np.corrcoef(lengths, turns)[0, 1]) < 0.2


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


def test_measured_errors_leave_the_streams_of_other_kinds() -> None:
    motion, kind = drive_and_turn(40)
    known = {"white": 0.026219139173103992, "move": 0.026219139173103992, "bias": 0.025110315063366685}
    for noise, value in known.items():
        config = WheelsConfig(noise=noise)
        assert simulate_wheel_odometry(config, motion, kind, stream(3, "wheels"))[0, 0] == value
