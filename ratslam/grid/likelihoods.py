"""How well what was felt goes with a particle's map (Fox et al. 2012, eq. 1 and 2, and what works better).

All are sums over whiskers of logarithms of chances, for N particles at once.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ratslam.grid.config import LikelihoodConfig
from tactile.base.types import Array

FIRM = 0.5
"""Length of the direction field at which it counts half."""


def free(config: LikelihoodConfig, evidence: Array, among: Array) -> Array:
    """[N] of points [N, K] of evidence that were found free; `among` [K] bool says which count."""
    return -config.free * (_soft(evidence + _logit(config.unexplored)) @ among.astype(evidence.dtype))


def contact(config: LikelihoodConfig, evidence: Array, among: Array) -> Array:
    """[N] of contacts at points [N, K] of evidence; unexplained ones happen too."""
    chance = jax.nn.sigmoid(evidence + _logit(config.unexplored))
    logs = jnp.log(config.surprise + (1 - config.surprise) * chance)
    return config.contact * (logs @ among.astype(evidence.dtype))


def direction(config: LikelihoodConfig, field: Array, angle: Array, precision: Array) -> Array:
    """[N] of directions felt against fields of directions.

    Args:
        field: [N, 2] sums of unit vectors at some multiple of the direction. angle: [N] that multiple of
            the direction felt, rad. precision: of its cosine.
    """
    length = jnp.hypot(field[:, 0], field[:, 1])
    along = field[:, 0] * jnp.cos(angle) + field[:, 1] * jnp.sin(angle)
    agreement = along / jnp.maximum(length, 1e-9)
    known = length / (length + FIRM)
    peak = jnp.sqrt(2 * np.pi * jnp.maximum(precision, 0.16))
    likely = (1 - known) + known * jnp.exp(precision * (agreement - 1)) * peak
    return jnp.log(1 - config.wall + config.wall * likely)


def printed(
    config: LikelihoodConfig, prior: float, evidence: Array, cell: Array, felt: Array, alive: Array
) -> Array:
    """[N] eq. 1 and 2.

    Args:
        evidence: [N, W, G] at the points along each whisker, from base to tip. cell: [N, W, G, 2] their
            cells. felt: [W] bool, contacts, which are all at the tip. alive: [W] bool, whiskers that count.
    """
    chance = jnp.clip(jax.nn.sigmoid(evidence + _logit(prior)), 1e-6, 1 - 1e-6)
    count = evidence.shape[2]
    tip = jnp.arange(count) == count - 1
    counted = jnp.broadcast_to(alive[None, :, None], evidence.shape)
    if config.model != "literal":
        counted = ~(tip[None] & felt[:, None])[None] & counted
    if config.model == "distinct":
        same = jnp.all(cell[:, :, :, None] == cell[:, :, None], axis=-1)  # [N, W, G, G]
        earlier = np.tri(count, k=-1, dtype=bool)
        again = jnp.any(same & earlier[None, None], axis=-1)
        counted &= ~again & ~(same[..., -1] & felt[None, :, None])
    clear = jnp.sum(jnp.where(counted, jnp.log1p(-chance), 0.0), axis=(1, 2))
    return clear + jnp.log(chance[:, :, -1]) @ felt.astype(evidence.dtype)


def _soft(value: Array) -> Array:
    """-log(1 - sigmoid)."""
    return jax.nn.softplus(value)


def _logit(chance: float) -> float:
    return float(np.log(chance / (1 - chance)))
