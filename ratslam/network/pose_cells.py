"""The pose cells: a network over x, y and heading whose activity is the posterior of the robot's pose.

Every cell prefers one pose of the map. Its activity A is the probability that the robot is there: the total
activity is certainty, and what is missing to 1 is the activity nu of a global inhibitory unit, which stands
for novelty. Several packets of activity are competing hypotheses. View cell (k, s), keyframe k seen at sector
shift s, is joined by ties K to the cells around its pose p_ks in the map; l_ks is the likelihood of the
present view there, l_new that at a new place. One update, at every view that becomes a keyframe:

    path integration      X(p) = A(p m^-1)                        cells' poses move with the odometry m
    local excitation      Y = E * [X / (E * K 1 + miss)]          a packet excites the view cells around it
    view cells            v_ks = l_ks [(1 - leak) (K'Y)_ks + e_ks]    shunted by the view
    global inhibition     v / Z,  nu = n / Z,  Z = sum v + n      divisive
    view cells drive      A = K v                                 packets are anchored on the map

e: mass that enters anew from nu (`ratslam.recall`); n: l_new times the mass that found no view cell. These
are prediction and update of a hidden Markov model, exactly: mass is conserved, and a view that contradicts a
packet removes it. RatSLAM (Milford & Wyeth 2004; Milford, Wiles & Wyeth 2010) has the same loop, but there
views add activity and global inhibition subtracts, which is no posterior. That a network can be one if its
inhibition grows with the total activity: Kutschireiter et al. 2023.

Odometry moves the poses that cells prefer, as a whole and by any distance, and A stays: shifting A by a part
f of a cell would blur it by f (1 - f) cells^2 each time. Excitation is the noise of odometry and map since
the last view; whether it acts before or after the motion is the same up to its turn.

x and y are rings, so that places a whole period apart share cells; their own views tell them apart. The sides
double where the map outgrows them (`sides_for`). Activity is [H, Y, X] over heading, y, x, float32; S sector
shifts, C rows of view cells.
"""

from __future__ import annotations

import math
from functools import partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.network.config import Network
from tactile.base.se2 import wrap
from tactile.base.types import Array

OUTGROWN = 1.25
"""Length of a map, in periods of the network, from which its side doubles."""
LARGEST = 8
"""Largest factor by which a side grows."""
ROWS = 256
"""Rows of view cells that are joined to pose cells at a time, up to the last in use: a step takes time for
the keyframes that there are, not for those that there is room for."""
BASIN = 2.0
"""Radius of a packet, cells."""
SUPPORT = 8.0
"""Squared deviation at which the kernel (1 - d2 / 8)^4 ends: like exp(-d2 / 2), but compact."""


class Belief(NamedTuple):
    """A posterior.

    Attributes:
        activity: [H, Y, X] float32 of the pose cells after the last view. mass: [S, C] float32 of the view
            cells that drive them, by which the activity follows a map that moves.
    """

    activity: Array
    mass: Array


class ViewCells(NamedTuple):
    """View cells [S, C].

    Attributes:
        x, y: m, heading: rad, cosine, sine: pose of the robot in the map where each is active. used: 1 for
            those that may be active, else 0.
    """

    x: Array
    y: Array
    heading: Array
    cosine: Array
    sine: Array
    used: Array


Ties = tuple[Array, Array]
"""Ties of view cells [S, C] to the eight pose cells around each: index [8, S, C] into the flattened network,
and weight [8, S, C], float32."""


def start(network: Network, views: tuple[int, int]) -> Belief:
    """A belief that is all novelty, for S sector shifts and C rows of view cells."""
    cells = network.cells
    shape = cells.cells_heading, cells.cells_xy, cells.cells_xy
    return Belief(jnp.zeros(shape, jnp.float32), jnp.zeros(views, jnp.float32))


def cover(network: Network, belief: Belief, sides: tuple[int, ...]) -> Belief:
    """The belief with other numbers of cells along x and y; they are silent until they are anchored again."""
    x, y = sides
    return belief._replace(activity=jnp.zeros((network.cells.cells_heading, y, x), jnp.float32))


def predict(network: Network, belief: Belief, cells: ViewCells, motion: Array) -> tuple[Array, Array]:
    """Path integration and local excitation: the prior of the view cells, before the view is compared.

    Args:
        belief: after the last update. cells: the view cells. motion: [3] odometry since then, m, m, rad.

    Returns:
        mass [S, C] that reaches the view cells, and mass that finds none; float32.
    """
    activity, moved = belief.activity, integrate_path(cells, motion)
    # Y = E * [X / (E * K 1 + miss)]: E * K 1 is the density of view cells around each pose cell.
    density = excite(network, drive(network, activity.shape, moved, jnp.ones_like(belief.mass)))
    excited = excite(network, activity / (density + network.miss))
    # (1 - leak) K'Y
    found = (1 - network.leak) * read(network, moved, excited)
    return found, jnp.maximum(jnp.sum(activity) - jnp.sum(found), 0.0)


def inhibit(mass: Array, novel: Array) -> tuple[Array, Array]:
    """Global inhibition is divisive: v / Z and nu = n / Z with Z = sum v + n.

    Args:
        mass: v [S, C] of the view cells. novel: n of novelty.
    """
    total = jnp.maximum(jnp.sum(mass) + novel, jnp.finfo(novel.dtype).tiny)
    return mass / total, novel / total


def anchor(network: Network, belief: Belief, cells: ViewCells, mass: Array) -> Belief:
    """The belief after view cells of mass v [S, C] drive their pose cells: A = K v."""
    mass = mass.astype(jnp.float32)
    return Belief(drive(network, belief.activity.shape, cells, mass), mass)


def integrate_path(cells: ViewCells, motion: Array) -> ViewCells:
    """The view cells as seen by pose cells whose preferred poses have moved: at p m^-1, for X(p) = A(p m^-1).

    Args:
        motion: m [3], body-frame odometry since the last update, m, m, rad.
    """
    motion = motion.astype(cells.x.dtype)
    turn_cosine, turn_sine = jnp.cos(motion[2]), jnp.sin(motion[2])
    cosine = cells.cosine * turn_cosine + cells.sine * turn_sine
    sine = cells.sine * turn_cosine - cells.cosine * turn_sine
    return ViewCells(
        x=cells.x - (cosine * motion[0] - sine * motion[1]),
        y=cells.y - (sine * motion[0] + cosine * motion[1]),
        heading=cells.heading - motion[2],
        cosine=cosine,
        sine=sine,
        used=cells.used,
    )


def tie(network: Network, shape: tuple[int, ...], cells: ViewCells) -> Ties:
    """K: view cells joined to the eight pose cells around each, by trilinear shares."""
    low: list[Array] = []
    high: list[Array] = []
    share: list[Array] = []
    units = (2 * np.pi / shape[0], network.cells.cell_size, network.cells.cell_size)
    for value, unit, size in zip((cells.heading, cells.y, cells.x), units, shape, strict=True):
        at = value * (1 / unit)
        first = jnp.floor(at)
        share.append((at - first).astype(jnp.float32))
        on_ring = (first - size * jnp.floor(first * (1 / size))).astype(jnp.int32)  # vector code, unlike %
        low.append(jnp.where(on_ring == size, 0, on_ring))
        high.append(jnp.where(low[-1] + 1 == size, 0, low[-1] + 1))
    index, weight = [], []
    for heading, y, x in np.ndindex(2, 2, 2):
        corner = [(high if up else low)[k] for k, up in enumerate((heading, y, x))]
        weighed = [share[k] if up else 1 - share[k] for k, up in enumerate((heading, y, x))]
        index.append((corner[0] * shape[1] + corner[1]) * shape[2] + corner[2])
        weight.append(cells.used * weighed[0] * weighed[1] * weighed[2])
    return jnp.stack(index), jnp.stack(weight)


def activity_at(network: Network, belief: Belief, motion: Array, chosen: Array) -> Array:
    """[n] activity at the poses that pose cells preferred at the start.

    Args:
        motion: [3] odometry since the last update, m, m, rad. chosen: [n] indices in the flattened network
            at the start.
    """
    cells, single = network.cells, jnp.float32
    row, x = jnp.divmod(jnp.asarray(chosen), cells.cells_xy)
    layer, y = jnp.divmod(row, cells.cells_xy)
    heading = layer.astype(single) * (2 * np.pi / cells.cells_heading)
    x, y = (value.astype(single) * cells.cell_size for value in (x, y))
    at = ViewCells(x, y, heading, jnp.cos(heading), jnp.sin(heading), jnp.ones_like(x))
    return read(network, integrate_path(at, motion), belief.activity)


def drive(network: Network, shape: tuple[int, ...], cells: ViewCells, mass: Array) -> Array:
    """K v: the activity [H, Y, X] that view cells of mass [S, C], float32, give to their pose cells."""

    def add(k: Array, activity: Array) -> Array:
        index, weight = _tie_block(network, shape, cells, k)
        update = (weight * _rows(k, mass)[None]).reshape(-1)
        return activity.at[index.reshape(-1)].add(update, mode="promise_in_bounds")

    activity = jnp.zeros(int(np.prod(shape)), jnp.float32)
    return lax.fori_loop(0, _blocks(cells), add, activity).reshape(shape)


def read(network: Network, cells: ViewCells, activity: Array) -> Array:
    """K'Y: the activity [S, C] at the view cells."""

    def fetch(k: Array, held: Array) -> Array:
        index, weight = _tie_block(network, activity.shape, cells, k)
        there = activity.reshape(-1).at[index].get(mode="promise_in_bounds")
        part = jnp.sum(weight * there, axis=0)
        return lax.dynamic_update_slice_in_dim(held, part, k * part.shape[-1], axis=-1)

    return lax.fori_loop(0, _blocks(cells), fetch, jnp.zeros(cells.used.shape, jnp.float32))


def _tie_block(network: Network, shape: tuple[int, ...], cells: ViewCells, k: Array) -> Ties:
    """Ties of block k. They are the result of a branch, always taken, because XLA would otherwise compute
    each one amid the scatter that needs it, which takes twice the time."""
    none = jnp.zeros((8, *_rows(k, cells.x).shape), jnp.int32)
    block = jax.tree.map(partial(_rows, k), cells)
    untied = none, none.astype(jnp.float32)
    return lax.cond(k >= 0, partial(tie, network, shape), lambda _: untied, block)


def _blocks(cells: ViewCells) -> Array:
    """int32 number of blocks of rows up to the last view cell in use."""
    row = jnp.arange(1, cells.used.shape[-1] + 1, dtype=jnp.int32)
    size = math.gcd(len(row), ROWS)
    return (jnp.max(jnp.where(cells.used > 0, row, 0)) + (size - 1)) // size


def _rows(k: Array, rows: Array) -> Array:
    """Block k of rows [..., C]."""
    size = math.gcd(rows.shape[-1], ROWS)
    return lax.dynamic_slice_in_dim(rows, k * size, size, axis=-1)


def excite(network: Network, activity: Array) -> Array:
    """E *: local excitation of activity [H, Y, X], a separable convolution of peak 1 along each ring."""
    heading = network.excite_heading * activity.shape[0] / (2 * np.pi)
    for axis, sd in ((0, heading), (1, network.excite), (2, network.excite)):
        size = activity.shape[axis]
        weights = excitation(sd, size)
        reach = len(weights) // 2
        end = lax.slice_in_dim(activity, size - reach, size, axis=axis)
        begin = lax.slice_in_dim(activity, 0, reach, axis=axis)
        padded = lax.optimization_barrier(jnp.concatenate([end, activity, begin], axis=axis))
        parts = [
            np.float32(weight) * lax.slice_in_dim(padded, k, k + size, axis=axis)
            for k, weight in enumerate(weights)
        ]
        activity = reduce(jnp.add, parts)
    return activity


def excitation(sd: float, size: int) -> np.ndarray:
    """[2 r + 1] weights of excitation along a ring, by distance.

    Args:
        sd: standard deviation, cells. size: cells of the ring.
    """
    reach = min(int(np.ceil(np.sqrt(SUPPORT) * sd)) - 1, (size - 1) // 2)
    return np.asarray(np.maximum(1 - (np.arange(-reach, reach + 1) / sd) ** 2 / SUPPORT, 0) ** 4)


def packets(network: Network, belief: Belief, poses: np.ndarray, turns: np.ndarray, most: int) -> np.ndarray:
    """The heaviest packets, at most `most`: [n, 4] pose of the heaviest view cell, m, m, rad, and mass within
    `BASIN` cells of it. On the host; compiles nothing.

    Args:
        poses: [C, 3] of the rows of view cells. turns: [S] rad, by which the robot is turned at each shift.
    """
    mass, reach = np.array(belief.mass), BASIN * network.cells.cell_size
    found = np.zeros((0, 4))
    while len(found) < most and mass.max(initial=0.0) > 0:
        shift, row = np.unravel_index(int(mass.argmax()), mass.shape)
        basin = np.hypot(*(poses[:, :2] - poses[row, :2]).T) < reach
        heading = wrap(poses[row, 2] + turns[shift])
        found = np.vstack([found, [*poses[row, :2], heading, mass[:, basin].sum()]])
        mass[:, basin] = 0
    return found


def sides_for(network: Network, poses: np.ndarray) -> tuple[int, int]:
    """Cells along x and along y for a map with keyframes at poses [N, 3], N >= 0, by doubling."""
    extent = np.ptp(poses[:, :2], axis=0) if len(poses) else np.zeros(2)
    periods = np.minimum(extent / (network.cells.cell_size * network.cells.cells_xy * OUTGROWN), LARGEST)
    doublings = np.ceil(np.log2(np.maximum(periods, 1.0))).astype(int)
    x, y = (network.cells.cells_xy << doublings).tolist()
    return x, y


def merge_rows(belief: Belief, onto: np.ndarray, offset: np.ndarray) -> Belief:
    """The mass of merged keyframes at those they are merged with; at the opposite shift if they face the
    other way. The pose cells follow when they are anchored again.

    Args:
        onto, offset: [N] and [N, 3], see `ratslam.recall.memory.MergedRows`.
    """
    mass = np.asarray(belief.mass)
    if not mass.size:
        return belief
    moved = np.zeros_like(mass)
    turned = (np.cos(offset[:, 2]) < 0) & (len(mass) > 1)
    for shift in range(len(mass)):
        for rows, target in (
            (np.flatnonzero(~turned), shift),
            (np.flatnonzero(turned), len(mass) - 1 - shift),
        ):
            np.add.at(moved[target], onto[rows], mass[shift, rows])
    return belief._replace(mass=jnp.array(moved))


def lose_rows(belief: Belief, left: np.ndarray) -> Belief:
    """The belief in which only the first rows of which `left` [N] is True keep their mass; the rest is
    novelty."""
    rows = np.zeros(belief.mass.shape[1], np.float32)
    rows[: len(left)] = left[: len(rows)]
    return belief._replace(mass=belief.mass * rows[None])
