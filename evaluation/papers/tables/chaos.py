"""The chaos table: how fast two almost equal pose-cell networks diverge.

Both networks of a pair get the same motion without views: `random`, half a cell and half a heading cell per
step along each axis, or `drive`, one cell ahead and half a heading cell of turn. The table gives the largest
difference of their decoded poses along any axis up to a number of steps, in cells, the short way round the
torus (at most 10.5 in x and y and 18 in heading): median and largest over the walks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from evaluation.papers.tables.markdown import markdown_header, markdown_row
from ratslam.classic import pose_cells
from ratslam.classic.levels import window_levels
from ratslam.classic.pose_cell_config import NetworkConfig, rings, units
from ratslam.classic.pose_cells import PoseCells
from ratslam.classic.window import ring_difference
from ratslam.core.precision import prepare_precision
from tactile.base.random_streams import stream
from tactile.base.types import Odometry

MARKS = 100, 1_000, 10_000, 20_000, 100_000
"""Steps after which the difference is printed."""
SETTLING = 50
"""Steps at rest before the networks differ."""
NUDGE = 1e-13
"""Activity added to one cell; all activity sums to 1."""
MOTIONS = {"random": ((0.0, 0.0, 0.0), (0.5, 0.5, 0.5)), "drive": ((1.0, 0.0, 0.0), (0.0, 0.0, 0.5))}
"""Mean and standard deviation of the normally distributed motion along each axis, cells per step."""


class Variant(NamedTuple):
    """One network: precision, engine, whether the lag of the packet is fed back, and the activity added to
    the strongest cell before the first step."""

    dtype: str = "float64"
    engine: str = "window"
    fed_back: bool = True
    nudge: float = 0.0


PAIRS = {
    "one-cell": (Variant(), Variant(nudge=NUDGE)),
    "one-cell, open loop": (Variant(fed_back=False), Variant(fed_back=False, nudge=NUDGE)),
    "window, dense": (Variant(), Variant(engine="dense")),
    "float64, float32": (Variant(), Variant("float32")),
}


def separation(one: Variant, other: Variant, motion: np.ndarray) -> np.ndarray:
    """[T] largest difference between the decoded poses of two networks along any axis, cells.

    Args:
        motion: [T, 3] cells per step.
    """
    apart = decoded_poses(one, motion) - decoded_poses(other, motion)
    return np.abs(ring_difference(apart, rings(NetworkConfig(), np.dtype(float)))).max(axis=1)


def decoded_poses(kind: Variant, motion: np.ndarray) -> np.ndarray:
    """[T, 3] poses decoded after each step of motion [T, 3], all in cells."""
    config = NetworkConfig.model_validate({"engine": kind.engine})
    if not kind.fed_back:  # the lag is measured after settling, so never
        config = config.model_copy(update={"settle_steps": 2**31 - 1})
    dtype = np.dtype(kind.dtype)
    start = pose_cells.start(config, dtype)
    if not kind.fed_back:
        start = start._replace(settling=jnp.int32(config.settle_steps))
    settled, _ = _walk(config, start, np.zeros((SETTLING, 3), dtype))
    blocks, level = list(settled.activity.blocks), int(settled.activity.level)
    cells = blocks[level].activity
    strongest = np.unravel_index(int(np.argmax(cells)), cells.shape)
    blocks[level] = blocks[level]._replace(activity=cells.at[strongest].add(kind.nudge))
    nudged = settled._replace(activity=settled.activity._replace(blocks=tuple(blocks)))
    _, poses = _walk(config, nudged, motion.astype(dtype))
    return np.asarray(poses, float)


@partial(jax.jit, static_argnums=0)
def _walk(config: NetworkConfig, cells: PoseCells, motion: Any) -> tuple[PoseCells, Any]:
    dtype = np.dtype(motion.dtype)
    levels, unit = window_levels(config, dtype), units(config, dtype)
    no_recall, no_energy = jnp.zeros(3, dtype), jnp.zeros((), dtype)

    def step(cells: PoseCells, moved: Any) -> tuple[PoseCells, Any]:
        dx, dy, dtheta = moved * unit
        odometry = Odometry(dx, dy, dtheta, jnp.ones((), dtype))
        cells, _ = pose_cells.step(config, levels, cells, odometry, no_recall, no_energy)
        return cells, cells.pose

    return lax.scan(step, cells, motion)


def walk(number: int, steps: int, motion: str = "random") -> np.ndarray:
    """[T, 3] motion of a numbered walk, cells per step."""
    mean, deviation = MOTIONS[motion]
    return stream(number, "tests.chaos").normal(mean, deviation, (steps, 3))


def chaos_table(
    pairs: Sequence[str] = tuple(PAIRS),
    motions: Sequence[str] = tuple(MOTIONS),
    steps: int = MARKS[-1],
    walks: int = 3,
) -> Iterator[str]:
    """The lines of the table, each as soon as its walks are done."""
    prepare_precision("float64")
    marks = [mark for mark in MARKS if mark <= steps]
    yield markdown_header(("motion", "pair", *(f"{mark} steps" for mark in marks)))
    for motion, name in product(motions, pairs):
        gaps = np.array([separation(*PAIRS[name], walk(k, marks[-1], motion)) for k in range(walks)])
        most = [gaps[:, :mark].max(axis=1) for mark in marks]
        yield markdown_row((motion, name, *(f"{np.median(row):.1e} ({row.max():.1e})" for row in most)))
