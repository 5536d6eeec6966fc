"""Whisker images and random cases for the observation model."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from ratslam.recall.config import RecallConfig, sector_shifts
from ratslam.recall.filter import recognise
from ratslam.recall.memory import MapFeedback, init_memory
from ratslam.recall.observation_model import touch_likelihood
from ratslam.recall.whisker_likelihood import DEAD, PRIOR, estimate_background, log_odds_table, pixel_layout
from tests.ratslam.recall.recall_cases import SMALL, believing, holding, network_of

CELL = 0.05
SHAPE = (3, 6, 1)
PIXELS = pixel_layout(SHAPE)
SIZE = len(PIXELS.group)
GUARD = 5
CAPACITY = 64
NEW_IMAGE_LOG_ODDS = 3.0
BOTH = RecallConfig(sector_fov="whiskers", guard=GUARD)
AHEAD = BOTH.model_copy(update={"shifts": 0})
SEEDS = range(8)


def images_of(stream, count, touching=0.4, dead=0.0):
    """[count, D] levels."""
    level = stream.integers(1, DEAD, (count, SIZE)) * (stream.random((count, SIZE)) < touching)
    return np.where(stream.random((count, SIZE)) < dead, DEAD, level)


def learn(images):
    """The log-odds table learned from these images."""
    return log_odds_table(estimate_background(images, PIXELS.group), PRIOR)


def filled(config, images, poses, likeness, *, scale=NEW_IMAGE_LOG_ODDS, dtype=float):
    """A memory of frames [N, D] at poses [N, 3]; the robot is at the newest."""
    count = len(poses)
    memory = init_memory(config, SIZE, CAPACITY, np.dtype(dtype), len(likeness))
    store = np.zeros((SIZE, CAPACITY), np.int32)
    store[:, :count] = images.T
    memory = memory._replace(view=jnp.asarray(store), count=jnp.int32(count))
    return memory.apply_map_feedback(MapFeedback(poses, 0.0, 0.0, 0.0, np.pi, scale, likeness))


def spaced(count, cells=4.0):
    """Poses in a row so far apart that no frame is near another."""
    return np.stack([np.arange(count) * cells * CELL, np.zeros(count), np.zeros(count)], axis=1)


def random_case(seed, config=BOTH):
    """A memory in the middle of a path that doubles back, with all arrays filled, its belief, and a
    half-known image."""
    stream = np.random.default_rng(seed)
    count = int(stream.integers(GUARD + 2, CAPACITY + 1))
    poses = np.cumsum(stream.normal(0, 0.5 * CELL, (count, 3)), axis=0)
    poses[:, 2] = stream.normal(0, 0.3, count) + np.pi * stream.integers(0, 2, count)
    images = images_of(stream, count, dead=0.05)
    memory = filled(config, images, poses, learn(images))
    old = max(count - GUARD, 0)
    rows = len(sector_shifts(config))
    before, mass = np.zeros((2, rows, CAPACITY))
    before[:, :old] = stream.exponential(1, (rows, old))
    before[:, CAPACITY // 3] = 0.0
    mass[:, :old] = stream.dirichlet(np.full(rows * old + 1, 0.3))[:-1].reshape(rows, old)
    memory = memory._replace(before=jnp.asarray(before))
    belief = believing(config, memory, mass, CELL, SMALL)
    memory = memory.accumulate_motion(jnp.asarray(stream.normal(0, [CELL, 0.2 * CELL, 0.1])))
    near = images[stream.integers(0, max(old, 1))]
    return memory, belief, np.where(stream.random(SIZE) < 0.7, near, images_of(stream, 1)[0])


@cache
def compile_likelihood(config):
    return jax.jit(lambda memory, level: touch_likelihood(config, memory, level, PIXELS))


@cache
def filter_of(config):
    network = network_of(config, CELL)

    def observe(memory, belief, level):
        memory, weighing = touch_likelihood(config, memory, level, PIXELS)
        motion = memory.corrected_motion()
        return memory, *recognise(config, network, memory, belief, motion, weighing, config.local)

    return jax.jit(observe)


def host(tree):
    return jax.tree.map(np.asarray, tree)


def weigh(config, memory, level):
    return host(compile_likelihood(config)(memory, jnp.asarray(level, jnp.int32)))


def observe(config, memory, level, belief=None):
    """The memory and the belief after an image, and the result; without a belief all is novelty."""
    belief = holding(config, memory, cell=CELL) if belief is None else belief
    return host(filter_of(config)(memory, belief, jnp.asarray(level, jnp.int32)))
