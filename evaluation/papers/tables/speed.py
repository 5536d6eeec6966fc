"""The table of speed, µs: a pose-cell step by size of the network.

It times a step in replay beside `_NumpyNetwork`, the baseline of all stated speeds. All columns
of a row are timed in turns on one core, so that they share its state; only ratios carry over to other
machines.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import circulant

from evaluation.papers.tables.markdown import markdown_header, markdown_row
from ratslam.classic import pose_cells
from ratslam.classic.config import NetworkConfig, rings, units
from ratslam.classic.levels import window_levels
from ratslam.classic.pose_cells import PoseCells
from ratslam.core.compilation import prepare_precision
from tactile.base.types import Odometry

SIZES = (11, 21, 41, 61, 101, 201)
"""Cells along one side of the network."""
ROUNDS = 5
STEPS = 4000
"""Steps of one timing of the moving window."""
MOTION = 0.2, 0.1
"""Cells forward and heading cells per step."""
COLUMNS = ("cells a side", "ratslam", "float32", "whole torus", "NumPy", "NumPy / ratslam")


def speed_table(rows: Sequence[int] | None = None, rounds: int = ROUNDS) -> Iterator[str]:
    """The lines of the table, each as soon as it is timed; rows: of `SIZES`, or others."""
    prepare_precision("float64")
    yield markdown_header(COLUMNS)
    for n in rows or SIZES:
        us = interleaved_medians(network_calls(n), rounds)
        times = (f"{us[name]:.0f} us" for name in ("window", "window, float32", "dense", "numpy"))
        yield markdown_row([n, *times, f"{us['numpy'] / us['window']:.0f}"])


def network_calls(n: int) -> dict[str, tuple[Callable[[], Any], int]]:
    """The calls to time for networks of n x n x 36 cells, compiled."""
    steps, few = STEPS, max(5, 400 // n)
    window, start = replay_network(n, "window", steps)
    single, start32 = replay_network(n, "window", steps, np.float32)
    dense, whole = replay_network(n, "dense", few)
    network = _NumpyNetwork(n)
    return {
        "window": (partial(window, start), steps),
        "window, float32": (partial(single, start32), steps),
        "dense": (partial(dense, whole), few),
        "numpy": (lambda: [network.step(*MOTION) for _ in range(few)], few),
    }


def network_step(n: int, engine: str, dtype: Any = float) -> tuple[Callable[..., Any], PoseCells]:
    """A step of an engine as a function of cells, recall and energy, and the cells at the start."""
    config, dtype = NetworkConfig.model_validate({"cells_xy": n, "engine": engine}), np.dtype(dtype)
    levels, unit = window_levels(config, dtype), units(config, dtype)
    moved = Odometry(*(jnp.asarray(v, dtype) for v in (MOTION[0] * unit[0], 0.0, MOTION[1] * unit[2], 1.0)))

    def step(cells: PoseCells, recall: Any, energy: Any) -> Any:
        return pose_cells.step(config, levels, cells, moved, recall, energy)

    return step, pose_cells.start(config, dtype)


def replay_network(
    n: int, engine: str, steps: int, dtype: Any = float, every: int = 0
) -> tuple[Callable[..., Any], PoseCells]:
    """A compiled replay of some steps, and the cells at its start.

    Args:
        every: interval of an injection at a second packet half a torus away, in steps; 0: one packet only.

    Returns:
        a function of the cells to the cells after the replay and the number of steps with two packets.
    """
    step, start = network_step(n, engine, dtype)
    ring = rings(NetworkConfig(cells_xy=n), np.dtype(dtype))

    @jax.jit
    def replay(cells: PoseCells) -> Any:
        def body(k: Any, carry: Any) -> Any:
            cells, above = carry
            far = (cells.pose + ring / 2 * np.array([1, 1, 0], dtype)) % ring
            inject = (k % every == every - 1) if every else jnp.bool_(False)
            cells, (_, _, level) = step(cells, far, jnp.where(inject, 0.02, 0.0).astype(dtype))
            return cells, above + (level > 0).astype(jnp.int32)

        return jax.lax.fori_loop(0, steps, body, (cells, jnp.int32(0)))

    jax.block_until_ready(replay(start))
    return replay, start


def interleaved_medians(
    calls: Mapping[str, tuple[Callable[[], Any], int]], rounds: int = ROUNDS
) -> dict[str, float]:
    """Median microseconds per step of each call; each round times all calls in turn.

    Args:
        calls: by name, a call and the number of steps that it makes.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, (call, steps) in calls.items():
            start = time.perf_counter()
            jax.block_until_ready(call())
            times[name].append((time.perf_counter() - start) / steps * 1e6)
    return {name: float(np.median(each)) for name, each in times.items()}


class _NumpyNetwork:
    """A dense network of [K, N, N] cells in plain NumPy float64, the straightforward way.

    `step(d, turn)` moves it d cells forward and turns it by `turn` cells: separable circular convolutions as
    circulant products, heading layers translated one after another, a search for the peak.
    """

    def __init__(self, n: int, k: int = 36) -> None:
        self.n, self.k = n, k
        self.excite = [_circulant(7, 1.0, size) for size in (k, n, n)]
        self.inhibit = [_circulant(5, 2.0, size) for size in (k, n, n)]
        self.activity = np.zeros((k, n, n))
        self.activity[k // 2, n // 2, n // 2] = 1

    def step(self, d: float, turn: float) -> tuple[float, float, float]:
        """One step; the decoded pose in cells: x, y, heading."""
        p = _convolve(self.activity, self.excite)
        p = p - _convolve(p, self.inhibit)
        p = np.where(p >= 2e-5, p - 2e-5, 0.0)
        p /= p.sum()
        moved = np.empty_like(p)
        for layer in range(self.k):
            angle = layer * 2 * np.pi / self.k
            for axis, far in ((0, d * np.sin(angle)), (1, d * np.cos(angle))):
                source = p[layer] if axis == 0 else moved[layer]
                share = abs(far)
                moved[layer] = (1 - share) * source + share * np.roll(source, int(np.sign(far)), axis)
        share = abs(turn)
        self.activity = (1 - share) * moved + share * np.roll(moved, int(np.sign(turn)), 0)
        return self.decode()

    def decode(self) -> tuple[float, float, float]:
        """Circular mean of the activity around its peak, cells: x, y, heading."""
        sizes = (self.k, self.n, self.n)
        peak = np.unravel_index(np.argmax(self.activity), sizes)
        at = [(p + np.arange(-3, 4)) % size for p, size in zip(peak, sizes, strict=True)]
        box = self.activity[np.ix_(*at)]
        means = []
        for axis, size in enumerate(sizes):
            mass = box.sum(tuple(a for a in range(3) if a != axis))
            angle = at[axis] * 2 * np.pi / size
            means.append(np.arctan2(mass @ np.sin(angle), mass @ np.cos(angle)) * size / (2 * np.pi) % size)
        return means[2], means[1], means[0]


def _circulant(width: int, sigma: float, size: int) -> np.ndarray:
    """[size, size] the circular convolution with a Gaussian cut off at `width` cells."""
    at = np.arange(width) - width // 2
    column, weight = np.zeros(size), np.exp(-(at**2) / (2 * sigma**2))
    column[at] = weight / weight.sum()
    return circulant(column)


def _convolve(p: np.ndarray, along: list[np.ndarray]) -> np.ndarray:
    p = np.tensordot(along[0], p, axes=(1, 0))
    p = np.einsum("ab,kbi->kai", along[1], p, optimize=True)
    return p @ along[2].T
