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
