"""A closure in a map of 1000 frames: solution, and test against the map's covariance; on one core."""

from __future__ import annotations

import time

import numpy as np

from ratslam.mapping.optimizer import (
    CalibrationPrior,
    LoopClosures,
    MapCovariance,
    MapFit,
    MapProblem,
    OdometryChain,
    solve,
)
from tactile.base.se2 import integrate


def laps(frames: int, closures: int):
    """A square driven again and again with a biased gyro, closed wherever it was before."""
    stream = np.random.default_rng(0)
    turn = np.where(np.arange(1, frames) % 12 == 0, np.pi / 2, 0.0)
    true = np.column_stack([np.full(frames - 1, 0.5), np.zeros(frames - 1), turn])
    motion = true - [0, 0, 0.001] + stream.normal(0, [0.01, 0.01, 0.005], true.shape)
    later = stream.integers(60, frames, closures)
    chain = OdometryChain(motion, np.full(frames - 1, 0.5), np.tile([0.01, 0.01, 0.001], (frames - 1, 1)))
    path = np.concatenate([np.zeros((1, 3)), integrate(true)])
    links = LoopClosures(
        i=later % 48, j=later, turn=(path[later] - path[later % 48])[:, 2], sequence=np.arange(closures) // 5,
        variance=np.array([0.1, 0.1, 0.02]), scale=np.full(closures // 5, 6.0),
    )  # fmt: skip
    return np.concatenate([np.zeros((1, 3)), integrate(motion)]), chain, links


def test_a_closure_among_1000_frames(benchmark):
    poses, chain, links = laps(1000, 400)
    prior = CalibrationPrior(0.0, 0.01, 0.0, 0.05)
    solving, checking = [], []
    fit = MapFit(poses, 0.0, np.ones(80))
    for _ in range(9):
        start = time.perf_counter()
        fit = solve(MapFit(poses, 0.0, np.zeros(0)), MapProblem(chain, links, prior), iterations=4)
        middle = time.perf_counter()
        MapCovariance(fit, MapProblem(chain, links, prior)).relative(5, 999, 0.0)
        solving.append(middle - start)
        checking.append(time.perf_counter() - middle)
    ms = {"ms_solve": np.median(solving) * 1e3, "ms_check": np.median(checking) * 1e3}
    benchmark.extra_info.update(ms)
    print(
        f"\n1000 frames, 400 closures: solved in {ms['ms_solve']:.1f} ms, checked in {ms['ms_check']:.1f} ms"
    )
    start, problem = MapFit(poses, 0.0, np.zeros(0)), MapProblem(chain, links, prior)
    benchmark.pedantic(solve, args=(start, problem, 4), rounds=1)
    assert abs(fit.bias - 0.002) < 0.001
