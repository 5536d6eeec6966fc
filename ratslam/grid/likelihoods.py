"""Log-likelihoods of a report given the maps of N particles (Fox et al. 2012, eq. 1 and 2, and others), and
footprint kernels: the change of the map around an observation (II-E and II-F, eq. 3 and 4).

All kernels are computed on windows of `size` x `size` cells; places are in cells of the window. Each has a
maximum of 1, to be multiplied by its log-odds.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ratslam.grid.config import LikelihoodConfig
from tactile.base.types import Array

HALF_WEIGHT_LENGTH = 0.5
"""Length of the direction field at which its weight is one half."""


def free_space(config: LikelihoodConfig, evidence: Array, among: Array) -> Array:
    """[N] log-likelihood of free points with log-odds `evidence` [N, K]; `among` [K]: which count."""
    cost = jax.nn.softplus(evidence + _logit(config.unexplored))
    return -config.free * (cost @ among.astype(evidence.dtype))


def contact(config: LikelihoodConfig, evidence: Array, among: Array) -> Array:
    """[N] log-likelihood of contacts at points with log-odds `evidence` [N, K]; `among` [K]: which count."""
    chance = jax.nn.sigmoid(evidence + _logit(config.unexplored))
    logs = jnp.log(config.surprise + (1 - config.surprise) * chance)
    return config.contact * (logs @ among.astype(evidence.dtype))


def wall_direction(config: LikelihoodConfig, field: Array, angle: Array, precision: Array) -> Array:
    """[N] log-likelihood of measured wall directions given fields of wall directions.

    Args:
        field: [N, 2] sums of unit vectors at a multiple of the direction. angle: [N] the same multiple of the
            measured direction, rad. precision: of its cosine.
    """
    length = jnp.hypot(field[:, 0], field[:, 1])
    along = field[:, 0] * jnp.cos(angle) + field[:, 1] * jnp.sin(angle)
    agreement = along / jnp.maximum(length, 1e-9)
    known = length / (length + HALF_WEIGHT_LENGTH)
    peak = jnp.sqrt(2 * np.pi * jnp.maximum(precision, 0.16))
    likely = (1 - known) + known * jnp.exp(precision * (agreement - 1)) * peak
    return jnp.log(1 - config.wall + config.wall * likely)


def printed_likelihood(prior: float, evidence: Array, contact: Array, among: Array) -> Array:
    """[N] log-likelihood by eq. 1 and 2.

    Args:
        evidence: [N, W, G] log-odds at the points along each whisker, from base to tip. contact: [W] bool,
            contacts, all at the tip. among: [N or 1, W, G] bool, the free points that count.
    """
    chance = jnp.clip(jax.nn.sigmoid(evidence + _logit(prior)), 1e-6, 1 - 1e-6)
    clear = jnp.sum(jnp.where(among, jnp.log1p(-chance), 0.0), axis=(1, 2))
    return clear + jnp.log(chance[:, :, -1]) @ contact.astype(evidence.dtype)


def _logit(chance: float) -> float:
    return float(np.log(chance / (1 - chance)))


def gaussian_blobs(place: Array, amount: Array, sd: float, size: int) -> Array:
    """[N, size, size] sums of K isotropic Gaussians (eq. 3).

    Args:
        place: [N, K, 2]. amount: [K]. sd: cells.
    """
    at = jnp.arange(size, dtype=place.dtype)[None, None]
    across = jnp.exp(((at - place[:, :, :1]) / sd) ** 2 * -0.5)
    down = jnp.exp(((at - place[:, :, 1:]) / sd) ** 2 * -0.5) * amount[None, :, None]
    # Elementwise, because a batch of small matrix products takes 1.5 times as long.
    return jnp.sum(down[:, :, :, None] * across[:, :, None, :], axis=1)


def disc(place: Array, radius: float, size: int) -> Array:
    """[N, size, size] 1 inside discs about places [N, 2], falling to 0 over one cell at the rim."""
    at = jnp.arange(size, dtype=place.dtype)[None]
    across, down = (at - place[:, :1]) ** 2, (at - place[:, 1:]) ** 2
    away = jnp.sqrt(down[:, :, None] + across[:, None, :])
    return jnp.clip(radius + 0.5 - away, 0.0, 1.0)


def wall_edge(place: Array, direction: Array, along: float, across: float, size: int) -> Array:
    """[N, size, size] Gaussians elongated along walls through places [N, 2] in directions [N], rad."""
    right, up = _offsets(place, size)
    c, s = jnp.cos(direction)[:, None, None], jnp.sin(direction)[:, None, None]
    ahead, aside = c * right + s * up, c * up - s * right
    return jnp.exp(((ahead / along) ** 2 + (aside / across) ** 2) * -0.5)


def wall_sector(place: Array, direction: Array, along: float, width: float, size: int) -> Array:
    """[N, size, size] eq. 4: Gaussian in distance (cells) and in direction from the contact (rad), modulo pi
    so that the wall extends both ways; 1 at the contact."""
    right, up = _offsets(place, size)
    seen = jnp.arctan2(up, right) - direction[:, None, None]
    half = np.pi / 2
    off = jnp.mod(seen + half, np.pi) - half
    away = right**2 + up**2
    off = jnp.where(away > 0, off, 0.0)
    return jnp.exp((away / along**2 + (off / width) ** 2) * -0.5)


def _offsets(place: Array, size: int) -> tuple[Array, Array]:
    at = jnp.arange(size, dtype=place.dtype)[None]
    return (at - place[:, :1])[:, None, :], (at - place[:, 1:])[:, :, None]
