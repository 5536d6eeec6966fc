"""The attractor network on a patch: a box of cells cut out of the torus, or all of it.

Along each axis a patch is a piece of the ring or the whole of it; only the whole wraps. Where all activity
lies a margin inside the pieces, a patch steps exactly as the torus does: excitation reaches no farther than
the margin, and what inhibition would do beyond what is excited lies below the threshold.

Activity is [H, Y, X] over heading, y, x; poses, origins and shifts are [3] over x, y, heading, in cells.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.attractor.config import PoseCellConfig
from tactile.base.types import Array

TIE = 1e-9
"""Activities this close to the largest (as a share) tie with it: the first wins, whatever the rounding."""
SMALL = 18
"""Whole rings of fewer cells are worked on by matrices: loops over so few cost more than they do."""
BOX = 3
"""The packet is decoded from the (2 BOX + 1)^3 cells around its peak."""


class Axis(NamedTuple):
    """One axis of a patch: size, ring: its cells and those of the torus. whole: the patch is the ring."""

    size: int
    ring: int
    whole: bool


class Patch(NamedTuple):
    """One shape, and the network's constants.

    Attributes:
        axes: heading, y, x. excite, inhibit: [w] kernels along any axis. sigma: of excitation, cells.
            threshold: global inhibition. unit: of heading, rad. margin: cells that activity must lie inside.
        shell: [H, Y, X] bool, the cells of the margin. gap: cells between packets that do not feel each
            other.
    """

    axes: tuple[Axis, Axis, Axis]
    excite: Array
    inhibit: Array
    sigma: Any
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
    margin = config.excite_width // 2
    gap = 2 * margin + config.inhibit_width // 2
    axes, shell = [], np.zeros((1, 1, 1), bool)
    for k, ring in enumerate((config.cells_heading, config.cells_xy, config.cells_xy)):
        # Activity must not feel itself around the ring: inner cells, and the gap besides.
        whole = inner is None or ring < inner + gap
        size = ring if whole or inner is None else inner + 2 * margin
        axes.append(Axis(size, ring, whole))
        at = np.arange(size)
        outer = np.zeros(size, bool) if whole else (at < margin) | (at >= size - margin)
        shell = shell | outer.reshape([-1 if axis == k else 1 for axis in range(3)])
    excite = _gaussian(config.excite_width, np.float64(config.excite_sigma)).astype(dtype)
    inhibit = _gaussian(config.inhibit_width, np.float64(config.inhibit_sigma)).astype(dtype)
    unit, (heading, y, x) = 2 * np.pi / config.cells_heading, axes
    sigma, threshold = config.excite_sigma, config.global_inhibition
    return Patch((heading, y, x), excite, inhibit, sigma, threshold, unit, margin, shell, gap)


def tuned(patch: Patch, excite: Array, inhibit: Array, threshold: Array) -> Patch:
    """The patch with other kernels of the same widths, traced.

    Args:
        excite, inhibit: their standard deviations, cells. threshold: global inhibition.
    """
    return patch._replace(
        excite=_gaussian(len(patch.excite), excite),
        inhibit=_gaussian(len(patch.inhibit), inhibit),
        sigma=excite,
        threshold=threshold,
    )


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
    """What excitation, inhibition and threshold leave; not normalised. Both kernels are separable."""
    excited = _blurred(patch, patch.excite, activity)
    left = excited - _blurred(patch, patch.inhibit, excited)
    return jnp.where(left >= patch.threshold, left - patch.threshold, 0.0)


def integrate(patch: Patch, activity: Array, origin: Array, told: Array, lag: Array, shift: Array) -> Array:
    """Path integration: every heading layer moves its own way.

    Args:
        told: [3] body-frame motion, cells: each layer moves along its own heading, then all turn. lag: [3]
            in the network's frame, cells: every layer moves alike. Together less than a cell along each axis.
        shift: [3] int32, -1 to 1, by which the patch itself moves.
    """
    heading = patch.axes[0]
    layer = (origin[2] + np.arange(heading.size, dtype=np.int32)) % heading.ring
    along, across = turned(told[0], told[1], layer.astype(told.dtype) * patch.unit)
    moved = shift.astype(told.dtype)
    activity = _moved(patch, activity, 1, (across + (lag[1] - moved[1]))[:, None, None])
    activity = _moved(patch, activity, 2, (along + (lag[0] - moved[0]))[:, None, None])
    return _moved(patch, activity, 0, told[2] + lag[2] - moved[2])


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


def excited_share(patch: Patch, pose: Array) -> Array:
    """How much more energy a deposit between cells needs to be excited as high as one on a cell.

    Along one axis, a share f on the next cell is excited to (1 - f) g(f) + f g(1 - f) of the whole at the
    point itself, g the excitation kernel.
    """
    f = pose - jnp.floor(pose)
    sharp = -0.5 / patch.sigma**2
    return 1 / jnp.prod((1 - f) * jnp.exp(sharp * f**2) + f * jnp.exp(sharp * (1 - f) ** 2))


def _blurred(patch: Patch, kernel: Array, activity: Array) -> Array:
    """Convolved with an even kernel [w] along each axis."""
    half = len(kernel) // 2
    for k in (1, 0, 2):
        if _small(patch.axes[k]):
            activity = _product(
                jnp.tensordot(kernel, _turns(patch.axes[k], half, kernel.dtype), 1), activity, k
            )
            continue
        shifted = _shifted(patch, activity, k, half)
        activity = kernel[half] * shifted(0)
        for t in range(1, half + 1):
            activity = activity + kernel[half + t] * (shifted(t) + shifted(-t))
    return activity


def _moved(patch: Patch, activity: Array, k: int, distance: Array) -> Array:
    """Moved along one axis by a distance [] or [H, 1, 1], in parts of a cell linearly shared."""
    reach = 1 if patch.axes[k].whole else 2
    share = [jnp.maximum(0.0, 1 - jnp.abs(distance - t)) for t in range(-reach, reach + 1)]
    if _small(patch.axes[k]):
        return _product(
            jnp.tensordot(jnp.stack(share, -1), _turns(patch.axes[k], 1, activity.dtype), 1), activity, k
        )
    shifted = _shifted(patch, activity, k, reach)
    return reduce(
        jnp.add, (part * shifted(t) for t, part in zip(range(-reach, reach + 1), share, strict=True))
    )


def _small(axis: Axis) -> bool:
    return axis.whole and axis.size < SMALL


def _turns(axis: Axis, reach: int, dtype: np.dtype) -> np.ndarray:
    """[2 reach + 1, size, size] matrices that move activity around a ring by -reach to reach cells."""
    return np.stack([np.roll(np.eye(axis.size, dtype=dtype), t, axis=0) for t in range(-reach, reach + 1)])


def _product(matrix: Array, activity: Array, k: int) -> Array:
    """A matrix [n, n], or one for each heading layer [H, 1, 1, n, n], along one axis."""
    h, n, m = activity.shape
    if k == 0:
        return (matrix @ activity.reshape(h, n * m)).reshape(h, n, m)
    matrix = matrix.reshape(-1, *matrix.shape[-2:])
    if k == 1:
        return jnp.matmul(jnp.broadcast_to(matrix, (h, n, n)), activity)
    return jnp.matmul(activity, jnp.broadcast_to(jnp.swapaxes(matrix, 1, 2), (h, m, m)))


def _shifted(patch: Patch, activity: Array, k: int, reach: int) -> Callable[[int], Array]:
    """Activity moved by t cells along one axis, |t| up to the reach, as a function of t."""
    size = activity.shape[k]
    if patch.axes[k].whole:
        before = lax.slice_in_dim(activity, size - reach, size, axis=k)
        after = lax.slice_in_dim(activity, 0, reach, axis=k)
    else:
        before = after = jnp.zeros(
            [reach if a == k else n for a, n in enumerate(activity.shape)], activity.dtype
        )
    # Kept as an array: looked up through its three pieces, every cell would cost a branch.
    padded = lax.optimization_barrier(jnp.concatenate([before, activity, after], axis=k))
    return lambda t: lax.slice_in_dim(padded, reach - t, reach - t + size, axis=k)


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
    weight = (jnp if isinstance(sigma, jax.Array) else np).exp(
        offset.astype(sigma.dtype) ** 2 / (-2 * sigma**2)
    )
    return weight / weight.sum()
