"""Pose cells: a continuous attractor network over (heading, y, x), each axis a ring.

One packet of activity says where the robot is. A step is: inject what the view recalls, then for each
sub-step excite, inhibit, threshold, normalise and integrate a part of the motion; then decode the packet.
Sources: Milford & Wyeth 2004; Ball et al. 2013; the ways in which this differs from them are listed in
`ratslam/README.md`.

Activity is [K, N, N] over heading, y, x; poses in cells are [3] over x, y, heading, in [0, N) and [0, K).
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ratslam.attractor import adaptive_window
from ratslam.attractor.adaptive_window import Activity, Push, Rung
from ratslam.attractor.config import PoseCellConfig, rings, units
from ratslam.attractor.window import TIE, around, excited_share, turned
from tactile.base.types import Array, Odometry

LARGEST_PART = 0.5
"""Cells one sub-step moves at most: a packet moved further at once shears into a ring."""
MOST_PARTS = 256
"""Sub-steps of one step at most: bounds the time of a step whatever odometry says."""
JUMP = 1.0
"""A packet that moved this much otherwise than told (cells) has jumped; it has not lagged behind."""


class Outcome(IntEnum):
    """How a step of the network went."""

    OK = 0
    RESEEDED = 1
    """Activity had died out; one packet was put back where the last one had been."""
    TOO_FAST = 2
    """Odometry told of more motion than `MOST_PARTS` sub-steps can carry; the excess was dropped."""
    NOT_FINITE = 3
    """Odometry or view was NaN or infinite and was taken as no motion and no view."""
    FULL = 4
    """A new view or place had no room and was not kept."""


class PoseCells(NamedTuple):
    """The network's state.

    Attributes:
        activity: on the rung of the ladder that holds it; sums to 1 after every step.
        pose: [3] the decoded packet, cells.
        lag: [3] motion told but not yet made by the packet, cells.
        settling: steps until the lag is measured again, int32.
    """

    activity: Activity
    pose: Array
    lag: Array
    settling: Array


class Told(NamedTuple):
    """What a step says of itself.

    Attributes:
        spread: [3] of the packet, cells. outcome: an `Outcome`, int32. rung: of the ladder, int32.
    """

    spread: Array
    outcome: Array
    rung: Array


def start(config: PoseCellConfig, dtype: np.dtype, rungs: tuple[Rung, ...] | None = None) -> PoseCells:
    """One packet's seed, a single cell, in the middle; of the whole ladder or of these rungs."""
    pose = jnp.asarray(rings(config, dtype) // 2)
    activity = adaptive_window.seeded(rungs or adaptive_window.rungs(config, dtype), pose)
    return PoseCells(activity, pose, jnp.zeros(3, dtype), jnp.int32(0))


def activity(config: PoseCellConfig, cells: PoseCells) -> Array:
    """[K, N, N] the activity of the whole torus."""
    return adaptive_window.spread_out(adaptive_window.rungs(config, cells.pose.dtype), cells.activity)


def replaced(config: PoseCellConfig, cells: PoseCells, activity: Array) -> PoseCells:
    """The same state with any activity [K, N, N] of the whole torus."""
    return cells._replace(
        activity=adaptive_window.whole(adaptive_window.rungs(config, cells.pose.dtype), activity)
    )


def step(
    config: PoseCellConfig,
    rungs: tuple[Rung, ...],
    cells: PoseCells,
    odometry: Odometry,
    recall: Array,
    energy: Array,
) -> tuple[PoseCells, Told]:
    """One step of the network.

    Args:
        rungs: see `ladder.rungs`. odometry: body-frame motion, m, m, rad (finite).
        recall: [3] packet to inject at, cells. energy: how much, 0 for nothing.
    """
    dtype = cells.pose.dtype
    n, unit = rings(config, dtype), units(config, dtype)
    injected = energy > 0
    settling = jnp.where(injected, jnp.int32(config.settle_steps), jnp.maximum(cells.settling - 1, 0))
    measured = settling == 0
    lag = jnp.where(measured, cells.lag, jnp.zeros_like(cells.lag))

    told = jnp.stack([odometry.dx, odometry.dy, odometry.dtheta]) / unit
    reach = jnp.maximum(jnp.hypot(told[0], told[1]) + jnp.hypot(lag[0], lag[1]), jnp.abs(told[2] + lag[2]))
    wanted = jnp.maximum(jnp.ceil(reach / LARGEST_PART - TIE), 1.0)
    parts = jnp.minimum(wanted, float(MOST_PARTS))
    told, lag = told * (parts / wanted), lag * (parts / wanted)

    energy = excited_share(rungs[0].patch, recall) * energy
    push = Push(cells.pose, recall, energy, parts.astype(jnp.int32), told / parts, lag / parts, lag[2])
    activity, (pose, spread, died, rung) = adaptive_window.climb(rungs, cells.activity, push)

    world = jnp.stack([*turned(told[0], told[1], (cells.pose[2] + lag[2]) * unit[2]), told[2]])
    behind = around(world + lag - (pose - cells.pose), n)
    jumped = died | (jnp.max(jnp.abs(behind)) > JUMP)
    lag = jnp.where(measured, jnp.where(jumped, jnp.zeros_like(lag), behind), cells.lag)
    outcome = jnp.where(died, Outcome.RESEEDED, jnp.where(wanted > parts, Outcome.TOO_FAST, Outcome.OK))
    return PoseCells(activity, pose, lag, settling), Told(spread, outcome.astype(jnp.int32), rung)
