"""Small worlds with truth: the kinds of the reference traces, regenerated from a seed, and worse ones.

A place is a cell of 10 cm seen under one of six headings; every place has a random 3 x 6 view, so views of
neighbours are as different as any. Odometry has noise, a scale error of its turns and a gyro bias, as the
traces have.
"""

import numpy as np

from robot.sources.in_memory import InMemorySource
from robot.sources.source import SourceInfo
from tactile.base.se2 import between, wrap

CELL = 0.1
STEP = 0.05


def square(seed: int, laps: int) -> InMemorySource:
    """Laps of a 1 m square, turning on the spot at its corners, like a_square3."""
    side = [(STEP, 0.0)] * 20 + [(0.0, np.pi / 18)] * 9
    return sensed(followed(side * 4 * laps), seed)


def corridor(seed: int, length: int) -> InMemorySource:
    return sensed(followed([(STEP, 0.0)] * length), seed)


def followed(moves: list[tuple[float, float]]) -> np.ndarray:
    """[N, 3] the path of steps ahead (m) and turns (rad), from the origin; headings are not wrapped."""
    ahead, turn = np.array(moves).T
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    x = np.concatenate([[0.0], np.cumsum(ahead * np.cos(heading[1:]))])
    y = np.concatenate([[0.0], np.cumsum(ahead * np.sin(heading[1:]))])
    return np.stack([x, y, heading], axis=1)


def sensed(path: np.ndarray, seed: int) -> InMemorySource:
    """Log of a robot on a path [N, 3]."""
    stream = np.random.default_rng(seed)
    count = len(path)
    motion = np.zeros((count, 4))
    motion[1:, :3] = between(path[:-1], path[1:])
    scale, bias = stream.normal(1, 0.015), stream.normal(0, 0.002)
    motion[1:, 0] += stream.normal(0, 0.001, count - 1)
    motion[1:, 2] = motion[1:, 2] * scale + bias + stream.normal(0, 0.005, count - 1)
    motion[:, 3] = 0.5

    bucket = np.floor((wrap(path[:, 2:]) + np.pi + 0.01) / (np.pi / 3))
    keys = np.concatenate([np.floor(path[:, :2] / CELL + 0.5), bucket], axis=1)
    _, first, place = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    looks = stream.random((len(first), 18))
    views = np.clip(looks[place.reshape(-1)] + stream.normal(0, 0.012, (count, 18)), 0, 1)
    return recorded(path, motion, views)


def recorded(path: np.ndarray, motion: np.ndarray, views: np.ndarray) -> InMemorySource:
    count = len(path)
    yes, label = np.ones(count, bool), np.full(count, -1, np.int32)
    return InMemorySource(
        name="scene", digest="", time=0.5 * np.arange(count), motion=motion, moved=yes,
        views=views.reshape(count, 3, 6, 1).copy(), seen=yes.copy(), label=label,
        truth=np.column_stack([path[:, :2], wrap(path[:, 2])]), info=SourceInfo(cell_size=CELL),
    )  # fmt: skip
