"""Footprint kernels: the change of the map around an observation (Fox et al. 2012, II-E and II-F).

All kernels are computed on windows of `size` x `size` cells; places are in cells of the window. Each has a
maximum of 1, to be multiplied by its log-odds.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from tactile.base.types import Array


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
