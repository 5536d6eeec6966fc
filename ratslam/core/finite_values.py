"""Observations without values that are NaN or infinite."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from tactile.base.types import Array, Observation, Odometry


def finite_values(dtype: np.dtype, observation: Observation) -> tuple[Odometry, Array, Array, Array]:
    """The odometry and view of an observation in this precision; a value that is not finite zeroes the whole
    motion or the whole view.

    Returns:
        odometry; view [R, C, K]; bool: the view was finite; bool: nothing was masked.
    """
    odometry = Odometry(*(jnp.asarray(value, dtype) for value in observation.odometry))
    moves = jnp.stack(odometry[:3])
    fine = jnp.all(jnp.isfinite(moves))
    dx, dy, dtheta = jnp.where(fine, moves, 0.0)
    view = jnp.asarray(observation.view, dtype)
    visible = jnp.all(jnp.isfinite(view))
    clean = fine & (visible | ~observation.view_seen)
    return Odometry(dx, dy, dtheta, odometry.dt), jnp.where(visible, view, 0.0), visible, clean
