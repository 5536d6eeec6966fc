"""Small groups of particles, odometry, and settings of resampling."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ratslam.grid import particles
from ratslam.grid.config import ResamplingConfig
from ratslam.grid.particles import Particles
from tactile.base.types import Odometry

SYSTEMATIC = ResamplingConfig()
MULTINOMIAL = ResamplingConfig(scheme="multinomial")
COUNT = 16

placing = jax.jit(particles.assign_copies)


def placed(offspring):
    return jax.tree.map(np.asarray, placing(jnp.asarray(offspring, jnp.int32)))


def swarm(poses, dtype=float, session=0.0, weight=0.0):
    poses = np.atleast_2d(np.asarray(poses, dtype))
    scales = np.full((len(poses), 2), session, dtype)
    return jax.tree.map(
        jnp.asarray, Particles(poses, scales, np.zeros_like(scales), np.full(len(poses), weight, dtype))
    )


def odometry(dx, dy, dtheta, dtype=float):
    return Odometry(*(jnp.asarray(value, dtype) for value in (dx, dy, dtheta, 0.5)))
