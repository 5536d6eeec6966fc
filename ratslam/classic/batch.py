"""Many sessions in one compiled call: parameter sets, seeds and noise levels of the published network.

Sessions are computed a few at a time, because all at once exceed the processor's cache; on a GPU blocks may
be as large as its memory. `networks` and `trials` compute each from beginning to end. `walk` takes many
networks over a long course, a segment at a time: at the smallest window level, and those that needed a larger
one again from where the segment began, one by one with all levels. Its memory is that of the networks' states
and of one segment.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.classic import pose_cells
from ratslam.classic.cell_probe import activity_of
from ratslam.classic.config import NetworkConfig, rings
from ratslam.classic.levels import window_levels
from ratslam.classic.pose_cells import PoseCells
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


Track = tuple[Array, Array, Array]
"""Decoded packets [B, T, 3] in cells, outcome [B, T] and window level [B, T]."""


def networks(config: NetworkConfig, sets: Network, course: Course, block: int = BLOCK) -> Track:
    """The pose cells with every parameter set over one course, in the precision of the course.

    All sets are computed at the smallest window level first; those that needed a larger one are computed
    again with all levels, which in a batch cost time even where they are not used.
    """
    track = jax.tree.map(np.array, _networks(config, 1, sets, course, block))
    again = np.flatnonzero(np.any(track[2] > 0, axis=1))
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
        tuned = tuple(level._replace(window=level.window.with_kernels(*kernels)) for level in used)

        def step(cells: Any, row: Course) -> Any:
            odometry = Odometry(row.motion[0], row.motion[1], row.motion[2], jnp.ones((), dtype))
            energy = row.energy * network.energy
            cells, (_, outcome, level) = pose_cells.step(config, tuned, cells, odometry, row.recall, energy)
            return cells, (cells.pose, outcome, level)

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


SEGMENT = 128
"""Steps of a segment: long enough that calls cost nothing, short enough that little is computed again."""
LONGEST_WAIT = 64
"""Largest number of segments that a network which needed larger levels is computed with all of them before
the smallest alone is tried again; the wait doubles with each failure."""


class CellSets(NamedTuple):
    """B networks and the noise on their odometry.

    Attributes:
        network: their parameters. speed_noise: [B] standard deviation of a step's motion, as a share of it.
            heading_noise: [B] of the heading, rad / sqrt(s).
    """

    network: Network
    speed_noise: Array
    heading_noise: Array


class CellCourse(NamedTuple):
    """Input of the networks over T steps.

    View matching does not depend on the network, so that the templates of a course are known before.

    Attributes:
        motion: [T, 3] body-frame odometry, m, m, rad. noise: [T, 2] unit noise of the motion, and of the
            heading times the square root of the step's duration in s. template: [T] int32 template seen; 0
            without view. novel: [T] bool, seen for the first time. turned: [T] heading of the robot minus
            that at which the template was stored, cells. energy: [T] injected where the packet was then.
    """

    motion: Array
    noise: Array
    template: Array
    novel: Array
    turned: Array
    energy: Array


class CellTrack(NamedTuple):
    """A segment of S steps of B networks, host NumPy.

    Attributes:
        pose: [B, S, 3] decoded packets, cells. activity: [B, S, C] of the chosen cells. outcome: [B, S] an
            `Outcome`. level: [B, S] window level.
    """

    pose: np.ndarray
    activity: np.ndarray
    outcome: np.ndarray
    level: np.ndarray


Walker = tuple[PoseCells, Array]
"""One network on its way: its state, and the packets [M, 3] at which templates were first seen."""


class _Fleet:
    """B networks on their way, on the host.

    Args:
        sets, course, chosen: as in `walk`.
    """

    def __init__(self, config: NetworkConfig, sets: CellSets, course: CellCourse, chosen: np.ndarray) -> None:
        self._config, self._chosen = config, tuple(map(int, chosen))
        dtype = np.dtype(course.motion.dtype)
        self._sets = jax.tree.map(lambda column: np.asarray(column, dtype), sets)
        self._count = len(self._sets.speed_noise)
        templates = int(np.max(course.template, initial=0)) + 1
        start: Walker = (pose_cells.start(config, dtype), jnp.zeros((templates, 3), dtype))
        self._walkers = [jax.device_get(start)] * self._count
        self._wait = np.zeros(self._count, int)  # segments until the smallest level alone is tried again
        self._failures = np.zeros(self._count, int)  # of the smallest level, one after the other

    def advance(self, rows: CellCourse, block: int) -> CellTrack:
        """The networks over a segment [S] of the course, `block` of them at a time where that is exact."""
        found: dict[int, CellTrack] = {}
        small = [cells.activity.level == 0 for cells, _ in self._walkers]
        tried = [k for k in range(self._count) if small[k] and not self._wait[k]]
        for first in range(0, len(tried), block):
            found |= self._advance_together(rows, tried[first : first + block], block)
        for k in set(tried) - set(found):
            self._failures[k] += 1
            self._wait[k] = min(1 << self._failures[k], LONGEST_WAIT)
        for k in range(self._count):
            if k not in found:
                self._wait[k] = max(self._wait[k] - 1, 0)
                own = self._of(k), self._walkers[k], rows, self._chosen
                self._walkers[k], found[k] = jax.device_get(_walk(self._config, *own, together=False))
        return jax.tree.map(lambda *tracks: np.stack(tracks), *(found[k] for k in range(self._count)))

    def _advance_together(self, rows: CellCourse, group: list[int], block: int) -> dict[int, CellTrack]:
        """The tracks of those networks of a group for which the smallest level sufficed."""
        # A group is filled up with its first network, whose copies are thrown away.
        members = np.resize(group, block)
        members[len(group) :] = group[0]
        states = []
        for cells, packet in (self._walkers[k] for k in members):
            activity = cells.activity._replace(blocks=cells.activity.blocks[:1])
            states.append((cells._replace(activity=activity), packet))
        together = jax.tree.map(lambda *leaves: np.stack(leaves), *states)
        after, track = jax.device_get(
            _walk(self._config, self._of(members), together, rows, self._chosen, together=True)
        )
        found = {}
        for j, k in enumerate(group):
            if not track.level[j].any():
                cells, packet = jax.tree.map(lambda leaf, j=j: leaf[j], after)
                # With the blocks of the larger levels, whose contents do not count.
                blocks = (*cells.activity.blocks, *self._walkers[k][0].activity.blocks[1:])
                activity = cells.activity._replace(blocks=blocks)
                self._walkers[k] = cells._replace(activity=activity), packet
                self._failures[k], found[k] = 0, jax.tree.map(lambda leaf, j=j: leaf[j], track)
        return found

    def _of(self, members: int | np.ndarray) -> CellSets:
        return jax.tree.map(lambda column: column[members], self._sets)


def walk(
    config: NetworkConfig, sets: CellSets, course: CellCourse, chosen: np.ndarray, block: int = BLOCK
) -> Iterator[CellTrack]:
    """Simulates B networks over a course; yields its segments, of `SEGMENT` steps except for the last.

    Args:
        course: T steps, whose dtype is that of the networks. chosen: [C] cells of the flattened network
            [K, N, N] whose activity is recorded. block: networks computed at a time.
    """
    fleet, steps = _Fleet(config, sets, course, chosen), len(course.motion)
    for first in range(0, steps, SEGMENT):
        # The last segment is filled up with the last row, whose steps are thrown away.
        at = np.minimum(np.arange(first, first + SEGMENT), steps - 1)
        rows = jax.tree.map(lambda column, at=at: np.asarray(column)[at], course)
        track = fleet.advance(rows, block)
        yield jax.tree.map(lambda column, left=steps - first: column[:, :left], track)


@partial(jax.jit, static_argnames=("config", "chosen", "together"))
def _walk(
    config: NetworkConfig,
    sets: CellSets,
    walker: Walker,
    rows: CellCourse,
    chosen: tuple[int, ...],
    together: bool,
) -> tuple[Walker, CellTrack]:
    """Networks over a segment: many `together` at the smallest level alone, or one with all levels."""
    dtype = rows.motion.dtype
    levels = window_levels(config, np.dtype(dtype))[: 1 if together else None]
    ring = rings(config, dtype)

    def simulate(own: CellSets, walker: Walker) -> tuple[Walker, CellTrack]:
        network = own.network
        kernels = network.excite_sigma, network.inhibit_sigma, network.global_inhibition
        tuned = tuple(level._replace(window=level.window.with_kernels(*kernels)) for level in levels)

        def step(walker: Walker, row: CellCourse) -> tuple[Walker, CellTrack]:
            cells, packet = walker
            faster, turn = 1 + own.speed_noise * row.noise[0], own.heading_noise * row.noise[1]
            moved = Odometry(
                row.motion[0] * faster, row.motion[1] * faster, row.motion[2] + turn, jnp.ones((), dtype)
            )
            seen = packet[row.template]
            # A template is learnt with the packet before the step.
            packet = packet.at[row.template].set(jnp.where(row.novel, cells.pose, seen))
            turned = jnp.stack([jnp.zeros_like(row.turned), jnp.zeros_like(row.turned), row.turned])
            recall, energy = (seen + turned) % ring, row.energy * network.energy
            cells, (_, outcome, level) = pose_cells.step(config, tuned, cells, moved, recall, energy)
            active = activity_of(levels, cells.activity, np.array(chosen, np.int32))
            return (cells, packet), CellTrack(cells.pose, active, outcome, level)

        return lax.scan(step, walker, rows)

    return (jax.vmap(simulate) if together else simulate)(sets, walker)
