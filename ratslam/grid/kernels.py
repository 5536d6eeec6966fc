"""Stamps: what an observation leaves in the map around it (Fox et al. 2012, II-E and II-F).

All are drawn into windows of the map; places are in cells of the window, of size `size`. Each stamp is a
shape with largest value 1, to be weighed by its evidence.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from tactile.base.types import Array


def blobs(place: Array, amount: Array, sd: float, size: int) -> Array:
    """[N, size, size] sums of round Gaussians (eq. 3).

    Args:
        place: [N, K, 2]. amount: [K]. sd: cells.
    """
    at = jnp.arange(size, dtype=place.dtype)[None, None]
    across = jnp.exp(((at - place[:, :, :1]) / sd) ** 2 * -0.5)
    down = jnp.exp(((at - place[:, :, 1:]) / sd) ** 2 * -0.5) * amount[None, :, None]
    # Multiplied out: a batch of small matrix products takes half as long again.
    return jnp.sum(down[:, :, :, None] * across[:, :, None, :], axis=1)


def disc(place: Array, radius: float, size: int) -> Array:
    """[N, size, size] 1 on a disc about places [N, 2], falling to 0 within a cell at its rim."""
    at = jnp.arange(size, dtype=place.dtype)[None]
    across, down = (at - place[:, :1]) ** 2, (at - place[:, 1:]) ** 2
    away = jnp.sqrt(down[:, :, None] + across[:, None, :])
    return jnp.clip(radius + 0.5 - away, 0.0, 1.0)


def edge(place: Array, direction: Array, along: float, across: float, size: int) -> Array:
    """[N, size, size] Gaussians drawn out along walls through places [N, 2] of directions [N]; cells."""
    right, up = _offsets(place, size)
    c, s = jnp.cos(direction)[:, None, None], jnp.sin(direction)[:, None, None]
    ahead, aside = c * right + s * up, c * up - s * right
    return jnp.exp(((ahead / along) ** 2 + (aside / across) ** 2) * -0.5)


def fan(place: Array, direction: Array, along: float, width: float, size: int) -> Array:
    """[N, size, size] eq. 4 as printed: Gaussian in distance (cells) and in the direction seen from the
    contact (rad), which is taken modulo half a turn so that the edge goes both ways; 1 at the contact."""
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
