"""Simulated odometry errors: statistics of each kind of noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.simulation.head.odometry_errors import (
    OdometryConfig,
    OdometryErrors,
    motions_between,
    simulate_odometry,
)
from tactile.base.random_streams import stream
from tactile.base.se2 import between, integrate, wrap

KINDS = ("white", "gated", "telescoping")


def still(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(count, dtype=float), np.zeros((count, 3))


def drive_and_turn(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Repeats 20 s ahead at 30 mm/s and 5 s of turning on the spot at 0.4 rad/s."""
    turns = np.arange(count) % 25 >= 20
    motion = np.zeros((count, 3))
    motion[~turns, 0], motion[turns, 2] = 0.03, 0.4
    motion[0] = 0
    pose = integrate(motion)
    pose[:, 2] = np.cumsum(motion[:, 2])
    return np.arange(count, dtype=float), pose


def errors(kind: str, scene: tuple[np.ndarray, np.ndarray], seed: int = 0, **changes: Any) -> np.ndarray:
    """[N - 1, 3] measured motion minus true motion."""
    time, pose = scene
    noisy = simulate_odometry(OdometryConfig(noise=kind, **changes), time, pose, stream(seed, "odometry"))
    error = noisy[1:, :3] - between(pose[:-1], pose[1:])
    return np.column_stack([error[:, :2], wrap(error[:, 2])])


@given(st.integers(0, 10**6), st.sampled_from(KINDS))
def test_odometry_follows_from_its_seed(seed: int, kind: str) -> None:
    one, again, other = (errors(kind, drive_and_turn(60), k) for k in (seed, seed, seed + 1))
    assert (one == again).all()
    assert (one != other).any()


def test_without_noise_odometry_is_the_truth() -> None:
    assert np.abs(errors("none", drive_and_turn(100))).max() < 1e-12


def test_white_noise_is_in_every_step_and_independent() -> None:
    for scene in (still(4000), drive_and_turn(4000)):
        error = errors("white", scene)
        assert error[:, 0].std() == pytest.approx(8.2e-3, rel=0.05)
        assert error[:, 2].std() == pytest.approx(0.103, rel=0.05)
        assert (error[:, 1] == 0).all() or np.abs(error[:, 1]).max() < 1e-12
        for column in (0, 2):
            lagged = np.corrcoef(error[:-1, column], error[1:, column])[0, 1]
            assert abs(lagged) < 0.06


def test_gated_noise_is_only_in_moving_parts() -> None:
    assert np.abs(errors("gated", still(500))).max() == 0
    time, pose = drive_and_turn(4000)
    error = errors("gated", (time, pose))
    turns = np.abs(np.diff(pose[:, 2])) > 0.1
    assert np.abs(error[turns, 0]).max() < 1e-12
    assert np.abs(error[~turns, 2]).max() < 1e-12
    assert error[~turns, 0].std() == pytest.approx(8.2e-3, rel=0.05)
    assert error[turns, 2].std() == pytest.approx(0.103, rel=0.1)


def test_telescoping_noise_stays_bounded_and_the_others_grow() -> None:
    def last(kind: str, count: int) -> float:
        totals = [errors(kind, still(count), seed)[:, 2].sum() for seed in range(200)]
        return float(np.std(totals))

    short, long = (last("telescoping", count) for count in (50, 800))
    assert long == pytest.approx(short, rel=0.25)
    assert short == pytest.approx(np.sqrt(2) * 0.103, rel=0.2)
    assert last("white", 800) == pytest.approx(4 * last("white", 50), rel=0.3)
    every = errors("telescoping", still(800))
    assert np.abs(np.cumsum(every[:, 0])).max() < 10 * 8.2e-3


@pytest.mark.parametrize("kind", KINDS)
def test_noise_does_not_depend_on_the_row_rate(kind: str) -> None:
    """Errors at twice the row rate add up to the same errors."""
    time, pose = drive_and_turn(200)
    fine = np.arange(0, 199.5, 0.5)
    finely = np.column_stack([np.interp(fine, time, column) for column in pose.T])
    coarse = errors(kind, (time, pose))
    halves = errors(kind, (fine, finely))
    assert np.allclose(halves[:, [0, 2]].reshape(-1, 2, 2).sum(axis=1), coarse[:, [0, 2]], atol=1e-9)


def test_biases_are_constant_in_a_session() -> None:
    time, pose = drive_and_turn(500)
    scales, bends = [], []
    for seed in range(300):
        config = OdometryConfig(noise="none", length_bias=0.02, heading_bias=0.1)
        noisy = simulate_odometry(config, time, pose, stream(seed, "odometry"))[1:]
        true = between(pose[:-1], pose[1:])
        ahead = true[:, 0] > 0.01
        scale, bend = noisy[ahead, 0] / true[ahead, 0], (noisy[ahead, 2] - true[ahead, 2]) / true[ahead, 0]
        assert np.allclose(scale, scale[0])
        assert np.allclose(bend, bend[0])
        scales.append(scale[0])
        bends.append(bend[0])
    assert np.std(scales) == pytest.approx(0.02, rel=0.15)
    assert np.mean(scales) == pytest.approx(1, abs=5e-3)
    assert np.std(bends) == pytest.approx(0.1, rel=0.15)


def test_a_kidnap_repeats_the_motion_before() -> None:
    time, pose = drive_and_turn(100)
    pose = pose.copy()
    pose[50:, :2] += [0.7, -0.4]
    pose[50:, 2] += 2.0
    hidden = np.zeros(100, bool)
    hidden[50] = True
    random = stream(0, "odometry")
    noisy = simulate_odometry(OdometryConfig(noise="none"), time, pose, random, hidden)
    assert np.allclose(noisy[50, :3], noisy[49, :3])
    open_ = simulate_odometry(OdometryConfig(noise="none"), time, pose, stream(0, "odometry"))
    assert np.hypot(*open_[50, :2]) > 0.5
    assert (np.delete(noisy, 50, 0) == np.delete(open_, 50, 0)).all()


def test_the_first_row_only_sets_the_clock() -> None:
    time, pose = drive_and_turn(10)
    for kind in (*KINDS, "none"):
        noisy = simulate_odometry(OdometryConfig(noise=kind), time + 7.0, pose, stream(0, "odometry"))
        assert (noisy[0] == 0).all()
        assert (noisy[1:, 3] == 1).all()
        one = simulate_odometry(OdometryConfig(noise=kind), time[:1], pose[:1], stream(0, "odometry"))
        assert (one == 0).all()


@given(
    st.integers(0, 10**6),
    st.sampled_from([*KINDS, "none"]),
    st.sampled_from([0.3, 1.0, 3.7]),
    st.floats(0.2, 2.5),
)
def test_errors_of_a_growing_path_are_those_of_the_path_so_far(
    seed: int, kind: str, rate: float, period: float
) -> None:
    """To the bit, whatever follows: a live session gives its motions one by one."""
    config = OdometryConfig(noise=kind, rate=rate, length_bias=0.02, heading_bias=0.1)
    _, pose = drive_and_turn(40)
    time = 0.4 + np.cumsum(period * stream(seed, "times").uniform(0.5, 1.0, len(pose)))
    growing = OdometryErrors(config, stream(seed, "odometry"))
    for row in range(1, len(pose)):
        (measured,) = growing.add_to(time[row - 1 : row + 1], motions_between(pose[row - 1 : row + 1]))
        whole = simulate_odometry(config, time[: row + 1], pose[: row + 1], stream(seed, "odometry"))
        assert measured.tobytes() == whole[-1, :3].tobytes(), row
