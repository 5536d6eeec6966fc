"""Memories, beliefs and random cases for recall."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np

from ratslam.network.config import Network, PoseCellConfig
from ratslam.network.pose_cells import Belief, anchor
from ratslam.recall import observation_model
from ratslam.recall.config import RecallConfig, sector_shifts
from ratslam.recall.filter import recognise, view_cells
from ratslam.recall.memory import MapFeedback, init_memory

CELL, SIZE, CAPACITY, GUARD, SEEDS, ANGLE = 0.1, 12, 64, 5, range(16), 0.15
FAN = RecallConfig(sector_fov="auto", guard=GUARD)
FLAT = RecallConfig(sector_fov="none", guard=GUARD)
ROW, SMALL = (36, 13, 168), (12, 13, 13)
"""Cells of networks; in the first one no two places of `spaced` share one."""


def network_of(config, cell=CELL, shape=ROW):
    """The network that follows from settings; its first sides are of no account here."""
    cells = PoseCellConfig(cells_heading=shape[0], cell_size=cell)
    return Network(cells, config.excite, config.excite_heading, config.miss, config.leak)


def filled(config, views, poses, *, labels=None, scale=0.1, dtype=float, **calibration):
    """A memory of frames [N, D] at poses [N, 3]; the robot is at the newest. `calibration`: bias, turn_error,
    since and angle, by default 0."""
    count, store, ids = len(poses), np.zeros((views.shape[1], CAPACITY)), np.full(CAPACITY, -1, np.int32)
    store[:, :count] = views.T
    ids[:count] = -1 if labels is None else labels
    memory = init_memory(config, views.shape[1], CAPACITY, np.dtype(dtype))._replace(
        view=jnp.asarray(store, dtype), label=jnp.asarray(ids), count=jnp.int32(count),
        distinct=jnp.int32(len(set(ids[ids >= 0].tolist()))),
    )  # fmt: skip
    feedback = {"bias": 0.0, "turn_error": 0.0, "since": 0.0, "angle": 0.0} | calibration
    return memory.apply_map_feedback(MapFeedback(poses=poses, scale=scale, **feedback))


def holding(config, memory, masses=None, cell=CELL, shape=ROW):
    """The belief that gives these masses, by keyframe, to view cells of shift 0; the rest is novelty."""
    shifts = sector_shifts(config).tolist()
    mass = np.zeros((len(shifts), len(memory.label)))
    mass[shifts.index(0), list(masses or ())] = list((masses or {}).values())
    return believing(config, memory, mass, cell, shape)


def believing(config, memory, mass, cell=CELL, shape=ROW):
    """The belief of masses [S, C] of the view cells."""
    silent = Belief(jnp.zeros(shape, jnp.float32), jnp.asarray(mass, jnp.float32))
    return anchoring(config, network_of(config, cell, shape))(memory, silent)


@cache
def anchoring(config, network):
    """Drives the pose cells at a memory's poses by the mass of a belief."""
    return jax.jit(lambda memory, held: anchor(network, held, view_cells(config, memory), held.mass))


def recalled(config, memory, belief, weighed, cell=CELL):
    """The belief after a view of these likelihoods, and the result."""
    network, motion = network_of(config, cell, belief.activity.shape), memory.corrected_motion()
    return recognise(config, network, memory, belief, motion, weighed, config.local)


@partial(jax.jit, static_argnums=(0, 1))
def look(config, cell, memory, belief, view):
    weighed = observation_model.view_likelihood(config, cell, memory, view)
    return recalled(config, memory, belief, weighed, cell)


def observe(config, memory, view, belief=None, cell=CELL):
    """The belief after a view, and the result; without a belief all is novelty."""
    belief = holding(config, memory, cell=cell) if belief is None else belief
    view = jnp.asarray(view, memory.x.dtype)
    return jax.tree.map(np.asarray, look(config, cell, memory, belief, view))


def spaced(count, cells=4.0, cell=CELL):
    """Poses in a row so far apart that no frame is near another."""
    return np.outer(np.arange(count) * cells * cell, [1.0, 0.0, 0.0])


def random_case(seed, config=FAN, angle=ANGLE, dtype=float):
    """A memory in mid-session, with frames so close that all shares matter, its belief in a small network,
    and a half-known view."""
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
    mass = np.zeros((len(sector_shifts(config)), CAPACITY))
    frames = stream.integers(0, count - GUARD, 4)
    shifts = stream.integers(0, len(mass), 4) if angle else np.full(4, len(mass) // 2)
    np.add.at(mass, (shifts, frames), stream.dirichlet(np.full(5, 0.7))[:-1])
    belief = believing(config, memory, mass, shape=SMALL)
    for motion in stream.normal(0, [CELL, 0.2 * CELL, 0.1], (2, 3)):
        memory = memory.accumulate_motion(jnp.asarray(motion, dtype))
    heaviest = frames[int(mass[shifts, frames].argmax())]
    near = np.roll(views[heaviest], int(stream.choice([-2, -1, 0, 0, 0, 1, 2])))
    return memory, belief, np.clip(0.6 * near + 0.4 * stream.random(SIZE), 0, 1)


def errors_by_loops(config, m, view):
    shifts = [0] if config.sector_fov == "none" else range(-config.shifts, config.shifts + 1)
    errors = {}
    for k in shifts:
        for c in range(int(m.count) - config.guard):
            met = [abs(view[i + k] - m.view[i, c]) for i in range(len(view)) if 0 <= i + k < len(view)]
            errors[k, c] = sum(met) / len(met)
    return errors
