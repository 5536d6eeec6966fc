"""Small runs whose right answers are known."""

from collections.abc import Callable

import numpy as np
import pytest

from evaluation.metrics.run_metrics import RunArrays
from tactile.base.se2 import compose, integrate, inverse


@pytest.fixture(scope="session")
def square() -> Callable[[int, int], tuple[np.ndarray, np.ndarray]]:
    """Laps round a 0.6 m square of 8 places 0.3 m apart: ids [N] and true poses [N, 3]; at each place the
    robot dwells some steps, 0.02 m a step along its side."""

    def walk(laps: int, dwell: int) -> tuple[np.ndarray, np.ndarray]:
        corners = np.array([[0, 0, 0], [0.6, 0, np.pi / 2], [0.6, 0.6, np.pi], [0, 0.6, -np.pi / 2]])
        way = [(place // 2, 0.3 * (place % 2) + 0.02 * k) for place in range(8) for k in range(dwell)]
        lap = np.array([compose(corners[side], np.array([along, 0, 0])) for side, along in way])
        lap[:, 2] = corners[[side for side, _ in way], 2]
        return np.tile(np.repeat(np.arange(8), dwell), laps), np.tile(lap, (laps, 1))

    return walk


@pytest.fixture(scope="session")
def circle() -> RunArrays:
    """Three laps of a circle of 36 places; a perfect map in a frame of its own, and drifting odometry."""
    laps, places = 3, 36
    turn = np.full(laps * places, 2 * np.pi / places)
    turn[0] = 0.0
    motion = np.stack([np.where(turn > 0, 0.1, 0.0), np.zeros_like(turn), turn], axis=1)
    truth = integrate(motion, np.array([2.0, 1.0, 0.5]))
    elsewhere = np.array([-1.0, 0.5, 2.0])
    final = compose(elsewhere, compose(inverse(truth[0]), truth))
    step, place = np.arange(laps * places), np.arange(places)
    return RunArrays(
        100.0 + step / 2, truth, online=final, final=final, odometry=integrate(motion * [1.0, 1.0, 1.03]),
        experience=step % places, created=place, nodes=final[:places],
        links=np.stack([place, (place + 1) % places], axis=1),
    )  # fmt: skip
