"""How two runs of the pose cells part that differ by next to nothing.

    python -m ratslam.experiments.tables.chaos [--steps 100000] [--walks 3] [--pairs one-cell ...]
    [--motions drive]

Each pair of runs is given the same motion and no views: `random`, half a cell and half a heading cell a step
along each axis, or `drive`, a cell ahead and half a heading cell of turns. Printed is the largest difference
of their decoded poses along any axis up to so many steps, cells, the short way round the torus (x and y are
never farther apart than 10.5, headings than 18): the median over walks, and the largest.
"""

from __future__ import annotations

import argparse
import time
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.attractor import adaptive_window, pose_cells
from ratslam.attractor.config import PoseCellConfig, rings, units
from ratslam.attractor.pose_cells import PoseCells
from ratslam.attractor.window import around
from tactile.base.random_streams import stream
from tactile.base.types import Odometry

MARKS = 100, 1_000, 10_000, 20_000, 100_000
"""Steps after which the difference is told."""
SETTLING = 50
"""Steps at rest before anything is changed."""
NUDGE = 1e-13
"""What one cell is given, of an activity that sums to 1."""
MOTIONS = {"random": ((0.0, 0.0, 0.0), (0.5, 0.5, 0.5)), "drive": ((1.0, 0.0, 0.0), (0.0, 0.0, 0.5))}
"""Mean and standard deviation of normal motion along each axis, cells a step."""


class Kind(NamedTuple):
    """One run: its precision, its engine, whether what the packet lags behind is fed back, and what is added
    to its strongest cell before it sets out."""

    dtype: str = "float64"
    engine: str = "window"
    fed_back: bool = True
    nudge: float = 0.0


PAIRS = {
    "one-cell": (Kind(), Kind(nudge=NUDGE)),
    "one-cell, open loop": (Kind(fed_back=False), Kind(fed_back=False, nudge=NUDGE)),
    "window, dense": (Kind(), Kind(engine="dense")),
    "float64, float32": (Kind(), Kind("float32")),
}


def parted(one: Kind, other: Kind, motion: np.ndarray) -> np.ndarray:
    """[T] largest difference of two runs' decoded poses along any axis, after each step of motion [T, 3], in
    cells as all is."""
    ring = rings(PoseCellConfig(), np.dtype(float))
    return np.abs(around(decoded(one, motion) - decoded(other, motion), ring)).max(axis=1)


def decoded(kind: Kind, motion: np.ndarray) -> np.ndarray:
    """[T, 3] poses decoded after each step of motion [T, 3], all in cells."""
    config = PoseCellConfig.model_validate({"engine": kind.engine})
    if not kind.fed_back:  # the lag is measured once the packet has settled: never
        config = config.model_copy(update={"settle_steps": 2**31 - 1})
    dtype = np.dtype(kind.dtype)
    start = pose_cells.start(config, dtype)
    if not kind.fed_back:
        start = start._replace(settling=jnp.int32(config.settle_steps))
    settled, _ = _walk(config, start, np.zeros((SETTLING, 3), dtype))
    _, poses = _walk(config, _nudged(settled, kind.nudge), motion.astype(dtype))
    return np.asarray(poses, float)


def _nudged(cells: PoseCells, by: float) -> PoseCells:
    blocks = list(cells.activity.blocks)
    held = blocks[int(cells.activity.rung)]
    strongest = np.unravel_index(int(np.argmax(held.activity)), held.activity.shape)
    blocks[int(cells.activity.rung)] = held._replace(activity=held.activity.at[strongest].add(by))
    return cells._replace(activity=cells.activity._replace(blocks=tuple(blocks)))


@partial(jax.jit, static_argnums=0)
def _walk(config: PoseCellConfig, cells: PoseCells, motion: Any) -> tuple[PoseCells, Any]:
    dtype = np.dtype(motion.dtype)
    rungs, unit = adaptive_window.rungs(config, dtype), units(config, dtype)
    nowhere, nothing = jnp.zeros(3, dtype), jnp.zeros((), dtype)

    def step(cells: PoseCells, moved: Any) -> tuple[PoseCells, Any]:
        dx, dy, dtheta = moved * unit
        odometry = Odometry(dx, dy, dtheta, jnp.ones((), dtype))
        cells, _ = pose_cells.step(config, rungs, cells, odometry, nowhere, nothing)
        return cells, cells.pose

    return lax.scan(step, cells, motion)


def walk(number: int, steps: int, motion: str = "random") -> np.ndarray:
    """[T, 3] motion, cells."""
    mean, deviation = MOTIONS[motion]
    return stream(number, "tests.chaos").normal(mean, deviation, (steps, 3))


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=MARKS[-1])
    parser.add_argument("--walks", type=int, default=3)
    parser.add_argument("--pairs", nargs="*", choices=PAIRS, default=list(PAIRS))
    parser.add_argument("--motions", nargs="*", choices=MOTIONS, default=list(MOTIONS))
    given = parser.parse_args()
    marks = [mark for mark in MARKS if mark <= given.steps]
    print(f"{'steps':30s}" + "".join(f"{mark:>20d}" for mark in marks), flush=True)
    for motion, name in product(given.motions, given.pairs):
        began = time.perf_counter()
        gaps = np.array([parted(*PAIRS[name], walk(k, marks[-1], motion)) for k in range(given.walks)])
        most = np.array([gaps[:, :mark].max(axis=1) for mark in marks])
        told = "".join(f"{np.median(row):>10.1e} {row.max():>9.1e}" for row in most)
        print(f"{motion:8s}{name:22s}{told}   ({time.perf_counter() - began:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
