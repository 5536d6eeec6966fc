"""Many whole runs in one compiled call: parameter sets, seeds, noise levels.

Runs are taken a few at a time, each from its beginning to its end: all at once they would fall out of the
processor's cache. On a GPU blocks may be as large as its memory.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.attractor import adaptive_window, pose_cells, window
from ratslam.attractor.config import PoseCellConfig
from ratslam.core.types import Estimate
from tactile.base.types import Array, Observation, Odometry

BLOCK = 8
"""Runs of the pose cells at a time: what a processor's cache holds."""


class Network(NamedTuple):
    """B parameter sets of the pose cells.

    Attributes:
        excite_sigma, inhibit_sigma: [B] cells. global_inhibition: [B]. energy: [B] factor of what is
            injected.
    """

    excite_sigma: Array
    inhibit_sigma: Array
    global_inhibition: Array
    energy: Array


class Course(NamedTuple):
    """What the pose cells are given, step by step.

    Attributes:
        motion: [T, 3] body-frame odometry, m, m, rad. recall: [T, 3] cells. energy: [T] injected there.
    """

    motion: Array
    recall: Array
    energy: Array


class Track(NamedTuple):
    """What they made of it: pose [B, T, 3] cells; outcome and rung [B, T]."""

    pose: Array
    outcome: Array
    rung: Array


def networks(config: PoseCellConfig, sets: Network, course: Course, block: int = BLOCK) -> Track:
    """The pose cells with every parameter set over one course, in the precision of the course.

    All are run on the lowest rung of the ladder; those that it could not hold all the way are run again with
    the others at hand, which cost even where they are not climbed.
    """
    track = jax.tree.map(np.array, _networks(config, 1, sets, course, block))
    again = np.flatnonzero(np.any(track.rung > 0, axis=1))
    if len(again):
        room = np.resize(again, 1 << (len(again) - 1).bit_length())  # few shapes to compile
        chosen = jax.tree.map(lambda column: jnp.asarray(column)[room], sets)
        whole = _networks(config, None, chosen, course, 1)
        for rows, exact in zip(track, whole, strict=True):
            rows[again] = np.asarray(exact)[: len(again)]
    return track


@partial(jax.jit, static_argnames=("config", "rungs", "block"))
def _networks(config: PoseCellConfig, rungs: int | None, sets: Network, course: Course, block: int) -> Track:
    dtype = np.dtype(course.motion.dtype)
    steps = adaptive_window.rungs(config, dtype)[:rungs]

    def run(network: Network) -> Track:
        kernels = network.excite_sigma, network.inhibit_sigma, network.global_inhibition
        tuned = tuple(rung._replace(patch=window.tuned(rung.patch, *kernels)) for rung in steps)

        def step(cells: Any, row: Course) -> Any:
            odometry = Odometry(row.motion[0], row.motion[1], row.motion[2], jnp.ones((), dtype))
            energy = row.energy * network.energy
            cells, told = pose_cells.step(config, tuned, cells, odometry, row.recall, energy)
            return cells, Track(cells.pose, told.outcome, told.rung)

        return lax.scan(step, pose_cells.start(config, dtype, steps), course)[1]

    return lax.map(run, sets, batch_size=block)


@partial(jax.jit, static_argnames=("kernel", "block"))
def trials(kernel: Any, states: Any, observations: Observation, block: int = 1) -> Estimate:
    """Estimates [B, T, ...] of one kernel from B states (other seeds) over B courses of observations [B, T]
    (other noise)."""

    def run(trial: Any) -> Estimate:
        def step(state: Any, observation: Observation) -> Any:
            state, estimate, _ = kernel(state, observation)
            return state, estimate

        return lax.scan(step, *trial)[1]

    return lax.map(run, (states, observations), batch_size=block)
