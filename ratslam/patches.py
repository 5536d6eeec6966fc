"""The attractor network on a patch: a box of cells cut out of the torus, or all of it.

Along each axis a patch is a piece of the ring or the whole of it; only the whole wraps. Where all activity
lies a margin inside the pieces, a patch steps exactly as the torus does: excitation reaches no farther than
the margin, and what inhibition would do beyond what is excited lies below the threshold.

Activity is [H, Y, X] over heading, y, x; poses, origins and shifts are [3] over x, y, heading, in cells.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.cellsettings import PoseCellConfig
from tactile.types import Array

TIE = 1e-9
"""Activities this close to the largest (as a share) tie with it: the first wins, whatever the rounding."""
BOX = 3
"""The packet is decoded from the (2 BOX + 1)^3 cells around its peak."""


class Axis(NamedTuple):
    """One axis of a patch, host constants.

    Attributes:
        size, ring: cells of the patch and of the torus. whole: the patch is the ring. excite, both:
            [size, size] excitation, and excitation followed by inhibition. apart: [size, size] cells from
            column to row.
    """

    size: int
    ring: int
    whole: bool
    excite: Array
    both: Array
    apart: np.ndarray


class Patch(NamedTuple):
    """Host constants of one shape.

    Attributes:
        axes: heading, y, x. threshold: global inhibition. unit: of heading, rad. margin: cells that activity
            must lie inside. shell: [H, Y, X] bool, the cells of the margin. gap: cells between packets that
            do not feel each other.
    """

    axes: tuple[Axis, Axis, Axis]
    threshold: Any
    unit: float
    margin: int
    shell: np.ndarray
    gap: int

    @property
    def shape(self) -> tuple[int, int, int]:
        """[H, Y, X]."""
        heading, y, x = (axis.size for axis in self.axes)
        return heading, y, x

    @property
    def all_whole(self) -> bool:
        """Whether it is the torus."""
        return all(axis.whole for axis in self.axes)


def patch(config: PoseCellConfig, inner: int | None, dtype: np.dtype) -> Patch:
    """A patch that shows exactly any activity that lies within `inner` cells along each axis; None: all."""
    excite = _gaussian(config.excite_width, config.excite_sigma)
    both = np.convolve(excite, _gaussian(config.inhibit_width, config.inhibit_sigma))
    margin, gap = len(excite) // 2, len(excite) // 2 + len(both) // 2
    axes, shell = [], np.zeros((1, 1, 1), bool)
    for k, ring in enumerate((config.cells_heading, config.cells_xy, config.cells_xy)):
        # Activity must not feel itself around the ring: inner cells, and the gap besides.
        whole = inner is None or ring < inner + gap
        size = ring if whole or inner is None else inner + 2 * margin
        at = np.arange(size)
        apart = at[:, None] - at[None, :]
        if whole:
            apart = (apart + size // 2) % size - size // 2
        first, second = (_banded(kernel, size, whole).astype(dtype) for kernel in (excite, both))
        axes.append(Axis(size, ring, whole, first, second, apart.astype(dtype)))
        outer = np.zeros(size, bool) if whole else (at < margin) | (at >= size - margin)
        shell = shell | outer.reshape([-1 if axis == k else 1 for axis in range(3)])
    unit = 2 * np.pi / config.cells_heading
    return Patch((axes[0], axes[1], axes[2]), config.global_inhibition, unit, margin, shell, gap)


def tuned(config: PoseCellConfig, patch: Patch, excite: Array, inhibit: Array, threshold: Array) -> Patch:
    """The patch with other kernels of the same widths, traced.

    Args:
        excite, inhibit: their standard deviations, cells. threshold: global inhibition.
    """
    excitation = _gaussian(config.excite_width, excite)
    both = jnp.convolve(excitation, _gaussian(config.inhibit_width, inhibit))
    heading, y, x = (
        axis._replace(excite=_spread(excitation, axis.apart), both=_spread(both, axis.apart))
        for axis in patch.axes
    )
    return patch._replace(axes=(heading, y, x), threshold=threshold)


def torus(patch: Patch) -> np.ndarray:
    """[3] int32 cells around x, y and heading."""
    return np.array([axis.ring for axis in patch.axes[::-1]], np.int32)


def origin_about(patch: Patch, pose: Array) -> Array:
    """[3] int32 first cell of a patch whose middle is at a pose; 0 along whole rings."""
    piece = np.array([not axis.whole for axis in patch.axes[::-1]])
    return jnp.where(piece, (jnp.floor(pose).astype(jnp.int32) - half(patch)) % torus(patch), 0)


def half(patch: Patch) -> np.ndarray:
    """[3] int32 cells before its middle, over x, y, heading."""
    return np.array([axis.size // 2 - 1 for axis in patch.axes[::-1]], np.int32)


def kept(patch: Patch, activity: Array) -> Array:
    """What excitation, inhibition and threshold leave; not normalised."""
    heading, y, x = patch.axes
    h, n, m = patch.shape
    twice = jnp.concatenate([heading.excite, heading.both])
    excited, inhibited = (twice @ activity.reshape(h, n * m)).reshape(2, h * n, m)
    excited = jnp.einsum("ab,kbi->kai", y.excite, (excited @ x.excite.T).reshape(h, n, m))
    inhibited = jnp.einsum("ab,kbi->kai", y.both, (inhibited @ x.both.T).reshape(h, n, m))
    left = excited - inhibited
    return jnp.where(left >= patch.threshold, left - patch.threshold, 0.0)


def integrate(patch: Patch, activity: Array, origin: Array, told: Array, lag: Array, shift: Array) -> Array:
    """Path integration: every heading layer moves its own way.

    Args:
        told: [3] body-frame motion, cells: each layer moves along its own heading, then all turn. Less than
            a cell where the patch is a whole ring. lag: [3] in the network's frame, cells: every layer moves
            alike. shift: [3] int32 by which the patch itself moves.
    """
    heading, y, x = patch.axes
    h, n, m = patch.shape
    layer = (origin[2] + np.arange(h, dtype=np.int32)) % heading.ring
    along, across = turned(told[0], told[1], layer.astype(told.dtype) * patch.unit)
    moved = shift.astype(told.dtype)
    activity = jnp.matmul(_shared(y, across + (lag[1] - moved[1])), activity)
    activity = jnp.matmul(activity, jnp.swapaxes(_shared(x, along + (lag[0] - moved[0])), 1, 2))
    turn = _shared(heading, told[2] + lag[2] - moved[2])
    return (turn @ activity.reshape(h, n * m)).reshape(h, n, m)


def deposit(patch: Patch, activity: Array, origin: Array, pose: Array, energy: Array) -> Array:
    """Adds `energy` at a pose between cells, shared trilinearly among its eight neighbours; what lies beyond
    the patch is lost."""
    low = jnp.floor(pose)
    share = pose - low
    low = low.astype(jnp.int32) - origin
    corner = np.array([[x, y, th] for th in (0, 1) for y in (0, 1) for x in (0, 1)], np.int32)
    weight = jnp.prod(jnp.where(corner == 1, share[None], 1 - share[None]), axis=1)
    at = (low[None] + corner) % torus(patch)[None]
    return activity.at[at[:, 2], at[:, 1], at[:, 0]].add(energy * weight, mode="drop")


def inside(patch: Patch, origin: Array, pose: Array) -> Array:
    """Whether a deposit at a pose lies within the margin of the patch, bool."""
    low = (jnp.floor(pose).astype(jnp.int32) - origin) % torus(patch)
    size = np.array([axis.size for axis in patch.axes[::-1]], np.int32)
    piece = np.array([not axis.whole for axis in patch.axes[::-1]])
    fits = (low >= patch.margin) & (low + 1 < size - patch.margin)
    return jnp.all(fits | ~piece)


def decode(patch: Patch, activity: Array, origin: Array) -> tuple[Array, Array]:
    """The strongest packet: circular mean and circular standard deviation [3], [3] in cells.

    Only the box around the peak counts, so other packets do not pull the mean. The peak is found axis by
    axis: one pass over the cells instead of a scalar search.
    """
    first = origin[::-1]
    box, low = activity, []
    for k, (axis, at) in enumerate(zip(patch.axes, _peak(patch, activity, first), strict=True)):
        box, begins = _around(axis, box, at, k)
        low.append(begins)
    around = (first + jnp.stack(low))[:, None] + np.arange(2 * BOX + 1, dtype=np.int32)[None]
    marginals = jnp.stack([jnp.sum(box, (1, 2)), jnp.sum(box, (0, 2)), jnp.sum(box, (0, 1))])
    ring = torus(patch)[::-1]
    mean, spread = _circular(marginals, around % ring[:, None], ring.astype(activity.dtype))
    return mean[::-1], spread[::-1]


def peak_number(patch: Patch, activity: Array, origin: Array) -> Array:
    """int32, of the largest activity's cell, counted through the torus."""
    first, ring = origin[::-1], torus(patch)[::-1]
    heading, y, x = ((a + b) % n for a, b, n in zip(_peak(patch, activity, first), first, ring, strict=True))
    return (heading * ring[1] + y) * ring[2] + x


def contained(patch: Patch, activity: Array) -> Array:
    """Whether the margin is empty, bool."""
    if patch.all_whole:
        return jnp.bool_(True)
    return jnp.max(jnp.where(patch.shell, activity, 0.0)) <= 0


def turned(x: Array, y: Array, angle: Array) -> tuple[Array, Array]:
    """A vector turned by an angle."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return c * x - s * y, s * x + c * y


def around(difference: Array, size: Array) -> Array:
    """A difference of poses in cells the short way round, in [-size/2, size/2)."""
    return (difference + size / 2) % size - size / 2


def excited_share(config: PoseCellConfig, pose: Array) -> Array:
    """How much more energy a deposit between cells needs to be excited as high as one on a cell.

    Along one axis, a share f on the next cell is excited to (1 - f) g(f) + f g(1 - f) of the whole at the
    point itself, g the excitation kernel.
    """
    f = pose - jnp.floor(pose)
    sharp = -0.5 / config.excite_sigma**2
    return 1 / jnp.prod((1 - f) * jnp.exp(sharp * f**2) + f * jnp.exp(sharp * (1 - f) ** 2))


def _shared(axis: Axis, distance: Array) -> Array:
    """Matrices [..., size, size] that move activity by a part of a cell, linearly shared."""
    apart = axis.apart.reshape((1,) * distance.ndim + axis.apart.shape)
    return jnp.maximum(0.0, 1 - jnp.abs(apart - distance[..., None, None]))


def _peak(patch: Patch, activity: Array, first: Array) -> tuple[Array, Array, Array]:
    """Indices of the largest activity: heading, y, x."""
    heading = _first_peak(patch.axes[0], jnp.max(activity, axis=(1, 2)), first[0])
    layer = lax.dynamic_index_in_dim(activity, heading, 0, keepdims=False)
    y = _first_peak(patch.axes[1], jnp.max(layer, axis=1), first[1])
    row = lax.dynamic_index_in_dim(layer, y, 0, keepdims=False)
    return heading, y, _first_peak(patch.axes[2], row, first[2])


def _first_peak(axis: Axis, marginal: Array, first: Array) -> Array:
    """Where a marginal [size] is largest; of ties, the first cell of the torus."""
    at = (first + np.arange(axis.size, dtype=np.int32)) % axis.ring
    tied = marginal >= jnp.max(marginal) * (1 - TIE)
    return jnp.argmin(jnp.where(tied, at, axis.ring)).astype(jnp.int32)


def _around(axis: Axis, activity: Array, peak: Array, k: int) -> tuple[Array, Array]:
    """The cells about a peak along one axis, and where they begin."""
    if axis.whole:
        at = (peak + np.arange(-BOX, BOX + 1, dtype=np.int32)) % axis.size
        return jnp.take(activity, at, axis=k), peak - BOX
    low = jnp.clip(peak - BOX, 0, axis.size - 2 * BOX - 1)
    return lax.dynamic_slice_in_dim(activity, low, 2 * BOX + 1, k), low


def _circular(mass: Array, at: Array, ring: np.ndarray) -> tuple[Array, Array]:
    unit = (2 * np.pi / ring).astype(mass.dtype)
    angle = at.astype(mass.dtype) * unit[:, None]
    s, c = jnp.sum(mass * jnp.sin(angle), 1), jnp.sum(mass * jnp.cos(angle), 1)
    mean = (jnp.arctan2(s, c) / unit) % ring
    length = jnp.minimum(jnp.hypot(s, c) / jnp.sum(mass, 1), 1.0)
    return jnp.where(mean >= ring, 0.0, mean), jnp.sqrt(-2 * jnp.log(length)) / unit


def _gaussian(width: int, sigma: Any) -> Any:
    offset = np.arange(width) - width // 2
    square = offset.astype(sigma.dtype) ** 2 if isinstance(sigma, jax.Array) else offset**2
    weight = (jnp if isinstance(sigma, jax.Array) else np).exp(-square / (2 * sigma**2))
    return weight / weight.sum()


def _spread(kernel: Array, apart: np.ndarray) -> Array:
    """[size, size] a traced kernel laid along an axis; it must be shorter than a whole ring."""
    at = apart.astype(np.int32) + len(kernel) // 2
    return jnp.where((at >= 0) & (at < len(kernel)), kernel[np.clip(at, 0, len(kernel) - 1)], 0.0)


def _banded(kernel: np.ndarray, size: int, ring: bool) -> np.ndarray:
    """C with (C @ v)[i] = sum over t of kernel[t] v[i + t - half], around a ring or between two ends."""
    row = np.arange(size)
    matrix = np.zeros((size, size))
    for t, weight in enumerate(kernel):
        column = row + t - len(kernel) // 2
        among = np.ones(size, bool) if ring else (column >= 0) & (column < size)
        np.add.at(matrix, (row[among], column[among] % size), weight)
    return matrix
