"""Pose cells: a continuous attractor network over (heading, y, x), each axis a ring.

One packet of activity represents the robot's pose. A step injects energy at the recalled pose, then for each
sub-step excites, inhibits, thresholds, normalises and integrates a part of the motion, then decodes the
packet. Sources: Milford & Wyeth 2004; Ball et al. 2013; differences: `ratslam/classic/README.md`.

Activity is [K, N, N] over heading, y, x; poses in cells are [3] over x, y, heading, in [0, N) and [0, K).
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ratslam.classic.config import NetworkConfig, rings, units
from ratslam.classic.excitation_inhibition import TIE, ring_difference, rotate
from ratslam.classic.levels import (
    Activity,
    Levels,
    StepInput,
    point_activity,
    step_at_smallest,
    window_levels,
)
from tactile.base.types import Array, Odometry

LARGEST_SUBSTEP = 0.75
"""Largest motion of one sub-step, cells. The heading layers of a packet move apart in a sub-step: up to 0.75
cells the packet's standard deviation stays within 6 % of that at 0.5, at 0.85 it differs by 12 %."""
MOST_SUBSTEPS = 256
"""Limit on the sub-steps of one step, which bounds its computing time for any odometry."""
JUMP = 1.0
"""Difference between packet and odometry, cells, above which the packet has jumped instead of lagging."""


class Outcome(IntEnum):
    """Outcome of a step of the network."""

    OK = 0
    RESEEDED = 1
    """Activity had died out; one packet was reseeded at the last decoded pose."""
    TOO_FAST = 2
    """Odometry exceeded the motion of `MOST_SUBSTEPS` sub-steps; the excess was dropped."""
    NOT_FINITE = 3
    """Odometry or view was NaN or infinite and was taken as no motion and no view."""
    FULL = 4
    """A new view or place exceeded the capacity and was not stored."""


class PoseCells(NamedTuple):
    """The network's state.

    Attributes:
        activity: at one of the window levels; sums to 1 after every step.
        pose: [3] the decoded packet, cells.
        lag: [3] odometry that the packet has not followed yet, cells.
        settling: steps until the lag is measured again, int32.
    """

    activity: Activity
    pose: Array
    lag: Array
    settling: Array


def start(config: NetworkConfig, dtype: np.dtype, levels: Levels | None = None) -> PoseCells:
    """A single active cell in the middle of the torus; with all window levels, or with those given."""
    pose = jnp.asarray(rings(config, dtype) // 2)
    activity = point_activity(levels or window_levels(config, dtype), pose)
    return PoseCells(activity, pose, jnp.zeros(3, dtype), jnp.int32(0))


def step(
    config: NetworkConfig, levels: Levels, cells: PoseCells, odometry: Odometry, recall: Array, energy: Array
) -> tuple[PoseCells, tuple[Array, Array, Array]]:
    """One step of the network.

    Args:
        levels: see `window_levels`. odometry: body-frame motion, m, m, rad (finite).
        recall: [3] recalled pose, cells. energy: injected there, 0 for none.

    Returns:
        the network; and the spread [3] of the packet, cells, an `Outcome` and the window level, int32.
    """
    dtype = cells.pose.dtype
    n, unit = rings(config, dtype), units(config, dtype)
    injected = energy > 0
    settling = jnp.where(injected, jnp.int32(config.settle_steps), jnp.maximum(cells.settling - 1, 0))
    measured = settling == 0
    lag = jnp.where(measured, cells.lag, jnp.zeros_like(cells.lag))

    moved = jnp.stack([odometry.dx, odometry.dy, odometry.dtheta]) / unit
    reach = jnp.maximum(jnp.hypot(moved[0], moved[1]) + jnp.hypot(lag[0], lag[1]), jnp.abs(moved[2] + lag[2]))
    needed = jnp.maximum(jnp.ceil(reach / LARGEST_SUBSTEP - TIE), 1.0)
    substeps = jnp.minimum(needed, float(MOST_SUBSTEPS))
    moved, lag = moved * (substeps / needed), lag * (substeps / needed)

    energy = levels[0].window.deposit_gain(recall) * energy
    parts = moved / substeps, lag / substeps
    inputs = StepInput(cells.pose, recall, energy, substeps.astype(jnp.int32), *parts, lag[2])
    activity, (pose, spread, died, level) = step_at_smallest(levels, cells.activity, inputs)

    world = jnp.stack([*rotate(moved[0], moved[1], (cells.pose[2] + lag[2]) * unit[2]), moved[2]])
    behind = ring_difference(world + lag - (pose - cells.pose), n)
    jumped = died | (jnp.max(jnp.abs(behind)) > JUMP)
    lag = jnp.where(measured, jnp.where(jumped, jnp.zeros_like(lag), behind), cells.lag)
    outcome = jnp.where(died, Outcome.RESEEDED, jnp.where(needed > substeps, Outcome.TOO_FAST, Outcome.OK))
    return PoseCells(activity, pose, lag, settling), (spread, outcome.astype(jnp.int32), level)
