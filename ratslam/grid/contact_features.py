"""The contacts and the wall of an observation, as the particle filter uses them."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from tactile.base.types import Array, MotionKind, Observation, Odometry

LARGEST = 1e6
"""Motion of one step above which odometry counts as invalid, m or rad."""


class ContactFeatures(NamedTuple):
    """Contacts of W whiskers and the wall of one observation, in base_link.

    Attributes:
        valid: bool, the observation counts as evidence. turning: bool, the robot turns. free: [W] bool,
            whiskers without contact. new: [W] bool, whiskers in contact that were not before. touching: [W]
            bool, whiskers in contact. point: [W, 2] contact points, m. wall: bool, there is a wall estimate.
            on_wall: [2] the mean contact point projected on the wall, m. direction: of the wall, rad, with
            standard deviation `sd`.
    """

    valid: Array
    turning: Array
    free: Array
    new: Array
    touching: Array
    point: Array
    wall: Array
    on_wall: Array
    direction: Array
    sd: Array


def contact_features(
    observation: Observation, touched: Array, dtype: np.dtype
) -> tuple[Odometry, ContactFeatures, Array]:
    """The observation with invalid values masked.

    Args:
        touched: [W] bool, whiskers in contact at the previous observation.

    Returns:
        odometry; contact features; whether all values were valid.
    """
    odometry = Odometry(*(jnp.asarray(value, dtype) for value in observation.odometry))
    moves = jnp.stack(odometry[:3])
    fine = jnp.all(jnp.abs(moves) < LARGEST)  # also false for NaN
    dx, dy, dtheta = jnp.where(fine, moves, 0.0)
    point = jnp.asarray(observation.point, dtype)
    placed = jnp.all(jnp.isfinite(point), axis=1)
    touching = jnp.asarray(observation.contact) & observation.alive & placed
    clean = fine & jnp.all(placed | ~observation.contact)
    measured = jnp.all(jnp.isfinite(jnp.append(observation.wall_point, observation.wall_sd)))
    clean &= measured | ~observation.wall

    turning = observation.motion == MotionKind.TURN
    valid = observation.motion != MotionKind.BACK
    # Whisking whiskers touch anew in each cycle; a fixed one stays in contact with the same wall.
    fresh = ~touched | (observation.motion == MotionKind.OTHER)
    foot = jnp.asarray(observation.wall_point, dtype)
    away = jnp.hypot(foot[0], foot[1])
    wall = observation.wall & valid & measured & (away > 1e-6) & jnp.any(touching)
    normal = jnp.where(wall, foot / jnp.where(wall, away, 1.0), jnp.zeros(2, dtype))
    among = touching.astype(dtype)
    point = jnp.where(touching[:, None], point, 0.0)
    middle = among @ point / jnp.maximum(jnp.sum(among), 1.0)
    features = ContactFeatures(
        valid=valid,
        turning=turning,
        free=valid & observation.alive & ~observation.contact,
        new=valid & touching & fresh & ~turning,
        touching=touching,
        point=point,
        wall=wall,
        on_wall=middle + normal * (jnp.where(wall, away, 0.0) - normal @ middle),
        direction=jnp.arctan2(normal[1], normal[0]) + np.pi / 2,
        sd=jnp.where(wall, jnp.asarray(observation.wall_sd, dtype), 1.0),
    )
    return Odometry(dx, dy, dtheta, odometry.dt), features, clean
