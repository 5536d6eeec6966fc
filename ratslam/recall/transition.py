"""Transition of the recall filter: the modes of the posterior move with the odometry to other keyframes.

Whiskers: mass outside the modes moves along the sequence of keyframes. Mass that arrives at no keyframe goes
to novelty, and a share of novelty enters anew, in part around the map's pose."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax

from ratslam.recall.config import RecallConfig, sector_shifts
from ratslam.recall.memory import Memory, allowed_shifts, corrected_motion, pose_spread
from tactile.base.se2 import compose
from tactile.base.types import Array

SUPPORT = 8.0
"""Squared deviation at which the alignment kernel (1 - d2 / 8)^4 ends: like exp(-d2 / 2), but compact."""
FOLLOWERS = 4
"""Number of keyframes that may follow a keyframe: itself, the next one, and two further."""


def predict(
    config: RecallConfig,
    cell: float,
    memory: Memory,
    angles: Array,
    known: Array,
    here: Array,
    local_share: Array | float,
) -> tuple[Array, Array]:
    """The prior: every mode moves with the robot to the keyframes near it, and novelty enters as new modes.

    Args:
        angles: [S] turn of each shift, rad. known: [C] bool, recallable keyframes. here: [3] current pose.
        local_share: share of new modes around the current pose.

    Returns:
        prior mass at each shift and keyframe [S, C], and of novelty.
    """
    dtype = memory.x.dtype
    cells = allowed_shifts(sector_shifts(config), memory)[:, None] & known[None]
    moved = corrected_motion(memory)
    at = memory.anchor
    heading = jnp.arctan2(memory.sine[at], memory.cosine[at])
    anchors = jnp.stack([memory.x[at], memory.y[at], heading], axis=1)
    poses = compose(compose(anchors, memory.offset), jnp.broadcast_to(moved, anchors.shape))

    reach = jnp.asarray(config.reach * cell, dtype), jnp.asarray(config.reach_heading, dtype)

    def carry(k: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        belief, novel = sums
        fall = _overlap(memory, poses[k], angles, cells, *reach)
        total = jnp.sum(fall) + config.miss_weight
        stay = memory.mass[k] * (1 - config.mode_decay)
        belief = belief + (stay / total) * fall
        return belief, novel + stay * config.miss_weight / total + memory.mass[k] * config.mode_decay

    fresh = 1 - jnp.sum(memory.mass) - jnp.sum(memory.rest)
    shut = jnp.zeros(cells.shape, dtype), jnp.zeros((), dtype)
    if config.sector_fov == "whiskers":
        shut = follow_keyframes(config, cell, memory, angles, cells.astype(dtype), moved)
    belief, novel = lax.fori_loop(0, config.modes, carry, shut)
    near = _overlap(memory, here, angles, cells, *pose_spread(config, cell, memory))
    total = jnp.sum(near)
    local, everywhere = fresh * config.enter * local_share, fresh * config.enter * (1 - local_share)
    belief = belief + jnp.where(cells, everywhere / jnp.maximum(jnp.sum(cells), 1).astype(dtype), 0.0)
    belief = belief + (local / jnp.maximum(total, 1.0)) * near
    entered = jnp.where(jnp.any(known), everywhere, 0.0) + local * total / jnp.maximum(total, 1.0)
    return belief, novel + fresh - entered


def _overlap(memory: Memory, pose: Array, angles: Array, cells: Array, sd: Array, sd_heading: Array) -> Array:
    """[S, C] alignment kernel between a pose [3] and every keyframe at every shift."""
    apart = ((memory.x - pose[0]) ** 2 + (memory.y - pose[1]) ** 2) / sd**2
    turned = pose[2] - angles
    facing = jnp.cos(turned)[:, None] * memory.cosine[None] + jnp.sin(turned)[:, None] * memory.sine[None]
    deviation = apart[None] + (2 / sd_heading**2) * (1 - facing)
    inside = jnp.maximum(1 - deviation / SUPPORT, 0.0)
    return jnp.where(cells, inside**2 * inside**2, 0.0)


def follow_keyframes(
    config: RecallConfig, cell: float, memory: Memory, angles: Array, cells: Array, moved: Array
) -> tuple[Array, Array]:
    """Moves the mass outside the modes along the order of the keyframes, from each to the few that follow it;
    backwards where the robot faces the other way.

    Args:
        cells: [S, C] 1 where a keyframe may be recalled, else 0. moved: [3] motion since the newest keyframe.

    Returns:
        as `predict`.
    """
    beliefs, novel = [], jnp.zeros((), memory.x.dtype)
    index = jnp.arange(len(memory.x), dtype=jnp.int32)
    for s, sign in enumerate((1, -1)[: len(cells)]):
        cosine = memory.cosine * jnp.cos(angles[s]) - memory.sine * jnp.sin(angles[s])
        sine = memory.sine * jnp.cos(angles[s]) + memory.cosine * jnp.sin(angles[s])
        x = memory.x + cosine * moved[0] - sine * moved[1]
        y = memory.y + sine * moved[0] + cosine * moved[1]
        ahead = cosine * jnp.cos(moved[2]) - sine * jnp.sin(moved[2])
        aside = sine * jnp.cos(moved[2]) + cosine * jnp.sin(moved[2])
        falls = []
        for step in range(FOLLOWERS):
            to = index + sign * step
            there = (to >= 0) & (to < len(index))
            near = jnp.roll(jnp.stack([memory.x, memory.y, cosine, sine, cells[s]]), -sign * step, axis=1)
            apart = ((x - near[0]) ** 2 + (y - near[1]) ** 2) / (config.reach * cell) ** 2
            facing = ahead * near[2] + aside * near[3]
            inside = jnp.maximum(1 - (apart + (2 / config.reach_heading**2) * (1 - facing)) / SUPPORT, 0.0)
            falls.append(jnp.where(there, near[4] * inside**2 * inside**2, 0.0))
        total = sum(falls, jnp.full_like(x, config.miss_weight))
        stay = memory.rest[s] * (1 - config.mode_decay)
        zero = jnp.zeros_like(x)
        beliefs.append(
            sum((jnp.roll(stay * fall / total, sign * step) for step, fall in enumerate(falls)), zero)
        )
        novel = (
            novel + jnp.sum(stay * config.miss_weight / total) + jnp.sum(memory.rest[s]) * config.mode_decay
        )
    return jnp.stack(beliefs), novel
