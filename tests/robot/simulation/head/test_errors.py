"""Errors of simulated odometry, and coloured noise, drift and creep of simulated whiskers."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.simulation.head.baseline import HALL_BASELINE, Baseline, BaselineConfig, make_baseline
from robot.simulation.head.odometry_errors import (
    OdometryConfig,
    OdometryErrors,
    motions_between,
    simulate_odometry,
)
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from tactile.base.random_streams import stream
from tactile.base.se2 import between, integrate, wrap

KINDS = ("white", "gated", "telescoping")


def drive_and_turn(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Repeats 20 s ahead at 30 mm/s and 5 s of turning on the spot at 0.4 rad/s."""
    turns = np.arange(count) % 25 >= 20
    motion = np.column_stack([np.where(turns, 0, 0.03), np.zeros(count), np.where(turns, 0.4, 0)])
    motion[0] = 0
    pose = integrate(motion)
    pose[:, 2] = np.cumsum(motion[:, 2])
    return np.arange(count, dtype=float), pose


def measured(scene: tuple[np.ndarray, np.ndarray], seed: int = 0, hidden=None, **config: Any) -> np.ndarray:
    return simulate_odometry(OdometryConfig(**config), *scene, stream(seed, "odometry"), hidden)


def errors(kind: str, scene: tuple[np.ndarray, np.ndarray], seed: int = 0, **biases: float) -> np.ndarray:
    """[N - 1, 3] measured motion minus true motion."""
    error = measured(scene, seed, noise=kind, **biases)[1:, :3] - between(scene[1][:-1], scene[1][1:])
    return np.column_stack([error[:, :2], wrap(error[:, 2])])


def test_errors_of_each_kind_follow_from_their_seed() -> None:
    assert np.abs(errors("none", drive_and_turn(100))).max() < 1e-12
    known = {
        "white": [[-0.073578, 0.108129], [-0.083586, -0.004056], [-0.011004, -0.447488]],
        "gated": [[-0.073578, 0.042215], [-0.073578, -0.069970], [-0.015004, -0.179417]],
        "telescoping": [[0.002793, 0.224927], [0.006571, 0.039339], [0.043138, 0.210314]],
        "none": [[0.017395, 0.042215], [0.017395, 0.042215], [0.044861, 0.108869]],
    }
    for kind, sums in known.items():
        error = errors(kind, drive_and_turn(60), 3, length_bias=0.02, heading_bias=0.1)
        np.testing.assert_allclose(np.cumsum(error[:, [0, 2]], axis=0)[[18, 22, 58]], sums, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_noise_does_not_depend_on_the_row_rate(kind: str) -> None:
    """Errors at twice the row rate add up to the same errors."""
    time, pose = drive_and_turn(200)
    fine = np.arange(0, 199.5, 0.5)
    finely = np.column_stack([np.interp(fine, time, column) for column in pose.T])
    coarse, halves = errors(kind, (time, pose)), errors(kind, (fine, finely))
    assert np.allclose(halves[:, [0, 2]].reshape(-1, 2, 2).sum(axis=1), coarse[:, [0, 2]], atol=1e-9)


def test_a_kidnap_repeats_the_motion_before() -> None:
    time, pose = drive_and_turn(100)
    pose[50:] += [0.7, -0.4, 2.0]
    noisy = measured((time, pose), hidden=np.arange(100) == 50, noise="none")
    plain = measured((time, pose), noise="none")
    assert np.allclose(noisy[50, :3], noisy[49, :3])
    assert np.hypot(*plain[50, :2]) > 0.5
    assert (np.delete(noisy, 50, 0) == np.delete(plain, 50, 0)).all()


@given(
    st.integers(0, 10**6),
    st.sampled_from([*KINDS, "none"]),
    st.sampled_from([0.3, 1.0, 3.7]),
    st.floats(0.2, 2.5),
)
def test_errors_of_a_growing_path_are_those_of_the_path_so_far(
    seed: int, kind: str, rate: float, period: float
) -> None:
    """To the bit, whatever follows: a live session gives its motions one by one. Row 0 sets the clock."""
    given = {"noise": kind, "rate": rate, "length_bias": 0.02, "heading_bias": 0.1}
    _, pose = drive_and_turn(30)
    time = 0.4 + np.cumsum(period * stream(seed, "times").uniform(0.5, 1.0, len(pose)))
    growing = OdometryErrors(OdometryConfig(**given), stream(seed, "odometry"))
    for row in range(len(pose)):
        whole = measured((time[: row + 1], pose[: row + 1]), seed, **given)
        assert (whole[0] == 0).all()
        if row:
            (step,) = growing.add_to(time[row - 1 : row + 1], motions_between(pose[row - 1 : row + 1]))
            assert (*step, time[row] - time[row - 1]) == tuple(whole[-1]), row


NOISE, WHISKERS = 2e-3, 3000
"""Of many whiskers, so that a variance over them and both channels is known within 1.8 % (one sd)."""
TOLERANCE = 0.08
"""4.4 standard deviations of such a variance."""
SEEDS, FEW = st.integers(0, 2**32), settings(max_examples=8)


def baseline(rate: float, whiskers: int = WHISKERS, seed: int = 0, **changes: float) -> Baseline:
    return Baseline(BaselineConfig.model_validate(changes), NOISE, rate, whiskers, seed)


@given(st.floats(0.001, 0.5), st.floats(0.05, 3), st.sampled_from([200.0, 2000.0]), st.floats(-1, 1))
def test_creep_tends_to_its_share_of_a_deflection_and_returns_to_zero(
    share: float, time: float, rate: float, bend: float
) -> None:
    whisker = baseline(rate, 1, creep=share, creep_time=time)
    count = round(rate * time)
    bent = whisker.wander(np.full((1, count, 1, 2), bend))[0, :, 0, 0]
    grown = share * bend * (1 - np.exp(-count / (rate * time)))
    assert bent[-1] == pytest.approx(grown)
    after = whisker.wander(np.zeros((1, 12 * count, 1, 2)))[0, :, 0, 0]
    assert after[count - 1] == pytest.approx(grown * np.exp(-count / (rate * time)))
    assert (np.diff(np.abs(after)) <= 0).all()


@given(st.lists(st.integers(1, 119), max_size=6, unique=True))
def test_the_parts_into_which_the_samples_are_cut_make_no_difference(cuts: list[int]) -> None:
    deflection = stream(1, "bends").standard_normal((1, 120, 2, 2))

    def samples(ends: list[int]) -> np.ndarray:
        made = make_baseline(HALL_BASELINE, NOISE, 100.0, 2, 5)
        assert made is not None
        parts = [deflection[:, a:b] for a, b in itertools.pairwise([0, *sorted(ends), 120])]
        return np.concatenate([made.colour(part) + made.wander(part) for part in parts], axis=1)

    assert np.array_equal(samples(cuts), samples([]))
    assert make_baseline(BaselineConfig(), NOISE, 2000.0, 18, 0) is None


def simulate(baseline: BaselineConfig, **changes: Any) -> HeadSimulation:
    slow = {"path": {"explore": 4.0}, "stream": {"rate": 1000.0}, "whisking": {"mode": "open"}}
    mechanics = {"mechanics": {"baseline": baseline.model_dump()}}
    return HeadSimulation(SimulationConfig.model_validate(slow | mechanics | changes))


def bends(source: HeadSimulation) -> np.ndarray:
    return np.array([sample.reading.deflection for sample in source])


@pytest.mark.parametrize("fidelity", ["quasistatic", "dynamic"])
def test_a_baseline_reaches_the_deflections_of_a_session_and_nothing_else(fidelity: str) -> None:
    source, plain = (simulate(one, fidelity=fidelity) for one in (HALL_BASELINE, BaselineConfig()))
    for with_it, without in zip(source, plain, strict=True):
        assert np.array_equal(with_it.reading.angle, without.reading.angle)
        off = np.abs(with_it.reading.deflection - without.reading.deflection)
        assert (off.max(axis=0) > NOISE).all()
    assert np.array_equal(source.odometry, plain.odometry)
    assert np.array_equal(source.truth, plain.truth)
    assert np.array_equal(bends(source), bends(source))
    cut = simulate(HALL_BASELINE, fidelity=fidelity, stream={"rate": 1000.0, "batch": 2})
    assert np.array_equal(bends(cut), bends(source))


def test_drift_goes_on_through_the_free_record_and_from_whisk_to_whisk() -> None:
    source = simulate(BaselineConfig(drift=100.0), calibration={"max_outlier_share": 0.9})
    drift = bends(source) - bends(simulate(BaselineConfig(), raw=True))
    between = drift[1:, 0] - drift[:-1, -1]
    assert between.std() < 0.1 * (drift[:, -1] - drift[:, 0]).std()
    # After 4 s of free record the drift has 2 sd of a second.
    assert drift[0, 0].std() == pytest.approx(2 * 100 * NOISE, rel=0.5)


def test_a_seed_gives_the_same_noise_and_drift_for_ever() -> None:
    made = make_baseline(HALL_BASELINE, NOISE, 100.0, 200, 5)
    assert made is not None
    colour = made.colour(NOISE * stream(5, "sensor").standard_normal((1, 400, 200, 2))) / NOISE
    drift = made.wander(np.zeros((1, 400, 200, 2)))[0, -1] / NOISE
    assert colour.std() == pytest.approx(1, rel=0.02)
    correlation = (colour[0, 1:] * colour[0, :-1]).mean()
    assert correlation == pytest.approx(np.exp(-0.01 / HALL_BASELINE.colour_time), abs=0.02)
    assert drift.std() == pytest.approx(HALL_BASELINE.drift * np.sqrt(4.0), rel=0.1)
    np.testing.assert_allclose([colour[0, 9, 3, 1], drift[3, 1]], [0.150775, 0.825184], atol=1e-6)
