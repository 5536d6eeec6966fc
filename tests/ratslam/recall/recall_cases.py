"""Memories and random cases for the recall filter."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from ratslam.recall import observation_model
from ratslam.recall.config import RecallConfig
from ratslam.recall.filter import recognise
from ratslam.recall.memory import MapFeedback, accumulate_motion, apply_map_feedback, init_memory

CELL = 0.1
SIZE = 12
CAPACITY = 64
GUARD = 5
SEEDS = range(16)
ANGLE = 0.15
FAN = RecallConfig(sector_fov="auto", guard=GUARD)
FLAT = RecallConfig(sector_fov="none", guard=GUARD)


def filled(
    config,
    views,
    poses,
    *,
    labels=None,
    bias=0.0,
    turn_error=0.0,
    since=0.0,
    angle=0.0,
    scale=0.1,
    dtype=float,
    capacity=CAPACITY,
):
    """A memory of frames [N, D] at poses [N, 3]; the robot is at the newest, all mass is novelty."""
    count = len(poses)
    store = np.zeros((views.shape[1], capacity))
    store[:, :count] = views.T
    ids = np.full(capacity, -1, np.int32)
    ids[:count] = -1 if labels is None else labels
    memory = init_memory(config, views.shape[1], capacity, np.dtype(dtype))._replace(
        view=jnp.asarray(store, dtype),
        label=jnp.asarray(ids),
        count=jnp.int32(count),
        distinct=jnp.int32(len(set(ids[ids >= 0].tolist()))),
    )
    return apply_map_feedback(memory, MapFeedback(poses, bias, turn_error, since, angle, scale))


def with_modes(memory, frames, masses, offsets=None):
    """The memory with modes at these frames."""
    modes = len(memory.mass)
    anchor, mass, offset = np.zeros(modes, np.int32), np.zeros(modes), np.zeros((modes, 3))
    anchor[: len(frames)], mass[: len(frames)] = frames, masses
    if offsets is not None:
        offset[: len(frames)] = offsets
    dtype = memory.mass.dtype
    return memory._replace(
        anchor=jnp.asarray(anchor), mass=jnp.asarray(mass, dtype), offset=jnp.asarray(offset, dtype)
    )


@cache
def filter_of(config, cell=CELL):
    return jax.jit(
        lambda memory, view: recognise(
            config, cell, memory, observation_model.view_likelihood(config, cell, memory, view), config.local
        )
    )


@cache
def compile_label_filter(config):
    def read(memory, label):
        weighed = observation_model.label_likelihood(config, memory, label)
        return *recognise(config, CELL, memory, weighed, config.local), weighed

    return jax.jit(read)


def observe(config, memory, view, cell=CELL):
    memory, found = filter_of(config, cell)(memory, jnp.asarray(view, memory.x.dtype))
    return jax.tree.map(np.asarray, memory), jax.tree.map(np.asarray, found)


def spaced(count, cells=4.0):
    """Poses in a row so far apart that no frame is near another."""
    return np.stack([np.arange(count) * cells * CELL, np.zeros(count), np.zeros(count)], axis=1)


def random_case(seed, config=FAN, angle=ANGLE, dtype=float):
    """A memory in mid-session, with frames so close that all shares matter, and a half-known view."""
    stream = np.random.default_rng(seed)
    count = int(stream.integers(GUARD + 2, CAPACITY))
    poses = np.cumsum(stream.normal(0, 0.6 * CELL, (count, 3)), axis=0)
    poses[:, 2] = stream.normal(0, 0.5, count)
    views = stream.random((count, SIZE))
    memory = filled(
        config, views, poses, dtype=dtype, angle=angle, bias=float(stream.normal(0, 0.2)),
        turn_error=float(stream.normal(0, 0.2)), since=float(stream.uniform(0, 1)),
        scale=float(stream.uniform(0.05, 0.3)),
    )  # fmt: skip
    # Not at the newest frame, which is guarded, but near older frames of the map.
    pose = poses[stream.integers(0, count - GUARD)] + stream.normal(0, [CELL, CELL, 0.3])
    memory = memory._replace(pose=jnp.asarray(pose, dtype))
    masses = stream.dirichlet(np.full(config.modes + 1, 0.7))[:-1]
    frames = stream.integers(0, count - GUARD, config.modes)
    memory = with_modes(memory, frames, masses, stream.normal(0, 0.5 * CELL, (config.modes, 3)) * [1, 1, 4])
    memory = accumulate_motion(memory, jnp.asarray(stream.normal(0, [CELL, 0.2 * CELL, 0.1]), dtype))
    memory = accumulate_motion(memory, jnp.asarray(stream.normal(0, [CELL, 0.2 * CELL, 0.1]), dtype))
    near = np.roll(views[frames[int(masses.argmax())]], int(stream.choice([-2, -1, 0, 0, 0, 1, 2])))
    return memory, np.clip(0.6 * near + 0.4 * stream.random(SIZE), 0, 1)


# The loops


def errors_by_loops(config, m, view):
    shifts = [0] if config.sector_fov == "none" else range(-config.shifts, config.shifts + 1)
    errors = {}
    for k in shifts:
        for c in range(int(m.count) - config.guard):
            met = [abs(view[i + k] - m.view[i, c]) for i in range(len(view)) if 0 <= i + k < len(view)]
            errors[k, c] = sum(met) / len(met)
    return errors
