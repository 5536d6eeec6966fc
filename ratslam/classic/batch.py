"""Many sessions in one compiled call: parameter sets, seeds, noise levels.

Sessions are computed a few at a time, each from beginning to end, because all at once exceed the processor's
cache. On a GPU blocks may be as large as its memory.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.classic import pose_cells
from ratslam.classic.excitation_inhibition import with_kernels
from ratslam.classic.levels import window_levels
from ratslam.classic.pose_cell_config import NetworkConfig
from ratslam.core.estimates import Estimate
from tactile.base.types import Array, Observation, Odometry

BLOCK = 8
"""Sessions of the pose cells computed at a time; they fit into a processor's cache."""


class Network(NamedTuple):
    """B parameter sets of the pose cells.

    Attributes:
        excite_sigma, inhibit_sigma: [B] cells. global_inhibition: [B]. energy: [B] factor on the injected
            energy.
    """

    excite_sigma: Array
    inhibit_sigma: Array
    global_inhibition: Array
    energy: Array


class Course(NamedTuple):
    """Input of the pose cells over T steps.

    Attributes:
        motion: [T, 3] body-frame odometry, m, m, rad. recall: [T, 3] recalled poses, cells. energy: [T]
            injected there.
    """

    motion: Array
    recall: Array
    energy: Array


class Track(NamedTuple):
    """Result: pose [B, T, 3] in cells, outcome [B, T] and window level [B, T]."""

    pose: Array
    outcome: Array
    level: Array


def networks(config: NetworkConfig, sets: Network, course: Course, block: int = BLOCK) -> Track:
    """The pose cells with every parameter set over one course, in the precision of the course.

    All sets are computed at the smallest window level first; those that needed a larger one are computed
    again with all levels, which in a batch cost time even where they are not used.
    """
    track = jax.tree.map(np.array, _networks(config, 1, sets, course, block))
    again = np.flatnonzero(np.any(track.level > 0, axis=1))
    if len(again):
        room = np.resize(again, 1 << (len(again) - 1).bit_length())  # few shapes to compile
        chosen = jax.tree.map(lambda column: jnp.asarray(column)[room], sets)
        # All levels: one by one a set takes the time of its own level; at once, as on a GPU, that of all.
        whole = _networks(config, None, chosen, course, 1 if block <= BLOCK else block)
        for rows, exact in zip(track, whole, strict=True):
            rows[again] = np.asarray(exact)[: len(again)]
    return track


@partial(jax.jit, static_argnames=("config", "levels", "block"))
def _networks(config: NetworkConfig, levels: int | None, sets: Network, course: Course, block: int) -> Track:
    dtype = np.dtype(course.motion.dtype)
    used = window_levels(config, dtype)[:levels]

    def simulate(network: Network) -> Track:
        kernels = network.excite_sigma, network.inhibit_sigma, network.global_inhibition
        tuned = tuple(level._replace(window=with_kernels(level.window, *kernels)) for level in used)

        def step(cells: Any, row: Course) -> Any:
            odometry = Odometry(row.motion[0], row.motion[1], row.motion[2], jnp.ones((), dtype))
            energy = row.energy * network.energy
            cells, info = pose_cells.step(config, tuned, cells, odometry, row.recall, energy)
            return cells, Track(cells.pose, info.outcome, info.level)

        return lax.scan(step, pose_cells.start(config, dtype, used), course)[1]

    return lax.map(simulate, sets, batch_size=block)


@partial(jax.jit, static_argnames=("kernel", "block"))
def trials(kernel: Any, states: Any, observations: Observation, block: int = 1) -> Estimate:
    """Estimates [B, T, ...] of one kernel from B states (one for each seed) over B courses of observations
    [B, T] (one for each noise level)."""

    def simulate(trial: Any) -> Estimate:
        def step(state: Any, observation: Observation) -> Any:
            state, estimate, _ = kernel(state, observation)
            return state, estimate

        return lax.scan(step, *trial)[1]

    return lax.map(simulate, (states, observations), batch_size=block)
