"""Many published networks over one long course: parameter sets and noise levels in one compiled call.

`walk` takes them over the course a segment at a time: at the smallest window level, and those that needed a
larger one again from where the segment began, one by one with all levels. Networks are computed a few at a
time, because all at once exceed the processor's cache. The memory is that of their states and of one segment.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.classic import pose_cells
from ratslam.classic.cell_probe import activity_of
from ratslam.classic.config import NetworkConfig, rings
from ratslam.classic.excitation_inhibition import Window
from ratslam.classic.levels import Level, window_levels
from ratslam.classic.pose_cells import PoseCells
from tactile.base.types import Array, Odometry

BLOCK = 8
"""Networks computed at a time; they fit into a processor's cache."""


def tuned_levels(
    levels: tuple[Level, ...], excite: Array, inhibit: Array, threshold: Array
) -> tuple[Level, ...]:
    """The levels with kernels of the same widths but other standard deviations, which may be traced.

    Args:
        excite, inhibit: standard deviations, cells. threshold: global inhibition.
    """

    def kernel(like: Array, sigma: Array) -> Array:
        offset = (np.arange(len(like)) - len(like) // 2).astype(sigma.dtype)
        weight = jnp.exp(offset**2 / (-2 * sigma**2))
        return weight / weight.sum()

    def tuned(window: Window) -> Window:
        kernels = kernel(window.excite, excite), kernel(window.inhibit, inhibit)
        return window._replace(excite=kernels[0], inhibit=kernels[1], sigma=excite, threshold=threshold)

    return tuple(level._replace(window=tuned(level.window)) for level in levels)


SEGMENT = 128
"""Steps of a segment: long enough that calls cost nothing, short enough that little is computed again."""
LONGEST_WAIT = 64
"""Largest number of segments that a network which needed larger levels is computed with all of them before
the smallest alone is tried again; the wait doubles with each failure."""


class CellSets(NamedTuple):
    """B networks and the noise on their odometry.

    Attributes:
        excite_sigma, inhibit_sigma: [B] cells. global_inhibition: [B]. energy: [B] factor on the injected
            energy. speed_noise: [B] standard deviation of a step's motion, as a share of it. heading_noise:
            [B] of the heading, rad / sqrt(s).
    """

    excite_sigma: Array
    inhibit_sigma: Array
    global_inhibition: Array
    energy: Array
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
        these = self._of(members), together, rows, self._chosen
        after, track = jax.device_get(_walk(self._config, *these, together=True))
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
        tuned = tuned_levels(levels, own.excite_sigma, own.inhibit_sigma, own.global_inhibition)

        def step(walker: Walker, row: CellCourse) -> tuple[Walker, CellTrack]:
            cells, packet = walker
            faster, turn = 1 + own.speed_noise * row.noise[0], own.heading_noise * row.noise[1]
            along, aside = row.motion[0] * faster, row.motion[1] * faster
            moved = Odometry(along, aside, row.motion[2] + turn, jnp.ones((), dtype))
            seen = packet[row.template]
            # A template is learnt with the packet before the step.
            packet = packet.at[row.template].set(jnp.where(row.novel, cells.pose, seen))
            turned = jnp.stack([jnp.zeros_like(row.turned), jnp.zeros_like(row.turned), row.turned])
            recall, energy = (seen + turned) % ring, row.energy * own.energy
            cells, (_, outcome, level) = pose_cells.step(config, tuned, cells, moved, recall, energy)
            active = activity_of(levels, cells.activity, np.array(chosen, np.int32))
            return (cells, packet), CellTrack(cells.pose, active, outcome, level)

        return lax.scan(step, walker, rows)

    return (jax.vmap(simulate) if together else simulate)(sets, walker)
