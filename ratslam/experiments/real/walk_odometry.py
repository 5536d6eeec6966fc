"""What odometry alone makes of the end of a walk, from where the robot turns round."""

from __future__ import annotations

import numpy as np

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.trajectory import align
from robot.sources.odometry import OdometryConfig, simulate_odometry
from tactile.base.random_streams import stream
from tactile.base.se2 import compose, integrate, wrap

TURNS = 0.05
"""Turn between two whisks above which the robot turns, rad."""


def last_before_reversal(truth: np.ndarray) -> int:
    """The row of true poses [N, 3] before the largest turn that is made without a pause.

    Raises:
        ValueError: the robot never turns.
    """
    turn = wrap(np.diff(truth[:, 2]))
    turns = np.abs(turn) > TURNS
    begins = np.flatnonzero(turns & ~np.concatenate([[False], turns[:-1]]))
    total = np.add.reduceat(np.where(turns, turn, 0.0), begins)
    return int(begins[np.argmax(np.abs(total))])


def continue_path(path: np.ndarray, motion: np.ndarray, last: int) -> np.ndarray:
    """[N, 3] the path [N, 3] up to row `last`, continued by motions into each row [N, 3]."""
    continued = path.copy()
    continued[last + 1 :] = integrate(motion[last + 1 :], path[last])
    return continued


def draw_energies(
    paths: tuple[np.ndarray, ...],
    truth: np.ndarray,
    time: np.ndarray,
    last: int,
    config: OdometryConfig,
    *,
    seed: int,
    draws: int,
) -> np.ndarray:
    """[P, draws] Energy Metric of P paths [N, 3] up to row `last`, continued by odometry whose noise is drawn
    anew; all paths have the same draws.

    Args:
        truth: [N, 3] true poses. time: [N] s. config: errors of the odometry. seed: of the draws.
    """
    random = stream(seed, "odometry after the reversal")
    pose = np.column_stack([truth[:, :2], np.unwrap(truth[:, 2])])
    placed = [compose(align(path[: last + 1], truth[: last + 1]), path) for path in paths]
    energies = np.zeros((len(paths), draws))
    for k in range(draws):
        motion = np.zeros_like(truth)
        motion[last:] = simulate_odometry(config, time[last:], pose[last:], random)[:, :3]
        for row, path in zip(energies, placed, strict=True):
            row[k] = energy_all_pairs(continue_path(path, motion, last), truth).total
    return energies
