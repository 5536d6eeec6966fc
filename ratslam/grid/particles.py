"""Particles: how they move, how their weights are kept, and how they are drawn anew.

Each carries along what it believes of the odometry's scale errors: those that last for the run, and those
that last for one movement.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ratslam.grid.config import DriftConfig, ResamplingConfig
from tactile.base.types import Array, Odometry


class Particles(NamedTuple):
    """N hypotheses.

    Attributes:
        pose: [N, 3] m, m, rad. run, move: [N, 2] scale errors of distances and turns, of the run and of the
            movement in progress. weight: [N] log.
    """

    pose: Array
    run: Array
    move: Array
    weight: Array


class Drawn(NamedTuple):
    """Who takes whose place.

    Attributes:
        ancestor: [N] int32, whom each is a copy of. source, target: [N] int32, the copies to make, the first
            `copies` of them.
    """

    ancestor: Array
    source: Array
    target: Array
    copies: Array


def start(config: DriftConfig, key: Array, count: int, dtype: jnp.dtype) -> Particles:
    """All at the origin, with different beliefs of the odometry."""
    run = config.run * jax.random.normal(key, (count, 2), dtype)
    return Particles(jnp.zeros((count, 3), dtype), run, jnp.zeros_like(run), jnp.zeros(count, dtype))


def moved(
    config: DriftConfig, particles: Particles, odometry: Odometry, changed: Array, key: Array
) -> Particles:
    """After an odometry reading.

    Args:
        changed: bool, another movement has begun; its scale errors are drawn.
    """
    dtype = particles.pose.dtype
    draws = jax.random.normal(key, (5, *particles.weight.shape), dtype)
    move = jnp.where(changed, config.move * draws[:2].T, particles.move)
    scale = 1 + particles.run + move + config.step * draws[2:4].T
    x, y, heading = particles.pose.T
    error = odometry.dtheta * (scale[:, 1] - 1) + config.heading * draws[4]
    on = heading + error / 2  # odometry tells of the way in the old frame; its errors build up along it
    c, s = jnp.cos(on), jnp.sin(on)
    dx, dy = odometry.dx * scale[:, 0], odometry.dy * scale[:, 0]
    turned = heading + odometry.dtheta + error
    turned -= 2 * jnp.pi * jnp.round(turned / (2 * jnp.pi))  # large angles are coarse in float32
    pose = jnp.stack([x + c * dx - s * dy, y + s * dx + c * dy, turned], axis=1)
    return particles._replace(pose=pose, move=move)


def weighed(particles: Particles, likelihood: Array) -> tuple[Particles, Array]:
    """With log-likelihoods [N] added, the largest weight 0; and whether no weight was left, when all keep
    what they had."""
    weight = particles.weight + likelihood
    most = jnp.max(weight)
    vanished = ~jnp.isfinite(most) | jnp.any(jnp.isnan(weight))
    return particles._replace(weight=jnp.where(vanished, particles.weight, weight - most)), vanished


def shares(weight: Array) -> Array:
    """[N] weights that sum to 1, of log weights."""
    share = jnp.exp(weight - jnp.max(weight))
    return share / jnp.sum(share)


def effective(share: Array) -> Array:
    """How many particles weights [N] are worth."""
    return 1 / jnp.sum(share**2)


def drawn(config: ResamplingConfig, share: Array, key: Array) -> Drawn:
    """Draws as many as there are, by their shares [N]."""
    count = share.shape[0]
    total = jnp.cumsum(share)
    total = total / total[-1]
    if config.how == "multinomial":
        at = jnp.sort(jax.random.uniform(key, (count,), share.dtype))
    else:
        at = (jnp.arange(count, dtype=share.dtype) + jax.random.uniform(key, (), share.dtype)) / count
    at = jnp.minimum(at, 1 - jnp.finfo(share.dtype).epsneg)  # where it was rounded up to 1
    # How many points fall below the end of each particle's stretch, so how many copies it gets.
    below = jnp.searchsorted(at, total, side="left").astype(jnp.int32)
    offspring = jnp.diff(below, prepend=jnp.int32(0))
    return placed(offspring)


def placed(offspring: Array) -> Drawn:
    """Survivors stay where they are, and what they have more of fills the gaps of the others."""
    count = offspring.shape[0]
    target = jnp.nonzero(offspring == 0, size=count, fill_value=count)[0].astype(jnp.int32)
    surplus = jnp.cumsum(jnp.maximum(offspring - 1, 0)).astype(jnp.int32)
    rank = jnp.arange(count, dtype=jnp.int32)
    source = jnp.minimum(jnp.searchsorted(surplus, rank, side="right").astype(jnp.int32), count - 1)
    ancestor = rank.at[target].set(source, mode="drop")
    return Drawn(ancestor, source, target, jnp.sum(offspring == 0).astype(jnp.int32))


def spared(count: int) -> Drawn:
    """Nobody takes anybody's place."""
    rank = jnp.arange(count, dtype=jnp.int32)
    return Drawn(rank, rank, rank, jnp.int32(0))


def copied(config: ResamplingConfig, particles: Particles, who: Drawn, key: Array) -> Particles:
    """The particles drawn, of equal weight; copies differ a little from whom they are copies of."""
    dtype = particles.pose.dtype
    new = (who.ancestor != jnp.arange(len(who.ancestor), dtype=jnp.int32)).astype(dtype)[:, None]
    draws = jax.random.normal(key, (len(who.ancestor), 5), dtype) * new
    spread = jnp.array([config.length, config.length, config.heading], dtype)
    return Particles(
        particles.pose[who.ancestor] + spread[None] * draws[:, :3],
        particles.run[who.ancestor] + config.scale * draws[:, 3:],
        particles.move[who.ancestor],
        jnp.zeros_like(particles.weight),
    )


def copied_rows(rows: Array, who: Drawn) -> Array:
    """[N, ...] what belongs to the particles, copied in place: nothing else is touched."""

    def copy(k: Array, rows: Array) -> Array:
        row = lax.dynamic_index_in_dim(rows, who.source[k], keepdims=True)
        return lax.dynamic_update_index_in_dim(rows, row, who.target[k], 0)

    return lax.fori_loop(jnp.int32(0), who.copies, copy, rows)


def mean(pose: Array, share: Array) -> tuple[Array, Array]:
    """[3] the weighted mean pose, and [3] its standard deviations (m, m, rad)."""
    middle = share @ pose[:, :2]
    c, s = share @ jnp.cos(pose[:, 2]), share @ jnp.sin(pose[:, 2])
    spread = jnp.sqrt(share @ (pose[:, :2] - middle[None]) ** 2)
    length = jnp.clip(jnp.hypot(c, s), 1e-12, 1.0)
    heading = jnp.sqrt(-2 * jnp.log(length))
    return jnp.append(middle, jnp.arctan2(s, c)), jnp.append(spread, heading)
