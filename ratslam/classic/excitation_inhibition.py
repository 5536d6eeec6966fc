"""The attractor network on a window: a box of cells cut out of the torus, or the whole torus.

Along each axis a window covers a piece of the ring or all of it; only a full ring wraps. While all activity
stays at least a margin away from the window's faces, a step on the window equals the step on the torus:
excitation reaches no farther than the margin, and inhibition of cells that are not excited only makes them
negative, which the threshold sets to 0.

Activity is [H, Y, X] over heading, y, x; poses, origins and shifts are [3] over x, y, heading, in cells.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.classic.config import NetworkConfig
from tactile.base.types import Array

TIE = 1e-9
"""Relative difference below which activities are equal; the first cell wins, so rounding does not decide."""
MATRIX_BELOW = 18
"""Full rings with fewer cells use matrix products, which are faster there than shifted copies."""
EVEN_ROW = 32
"""Full rings in x that fit into as many cells together with what both kernels reach beyond their ends are
computed as rows of this length, which is faster than rows of odd length that wrap for each kernel."""
BOX = 3
"""The packet is decoded from the (2 BOX + 1)^3 cells around its peak."""


class Window(NamedTuple):
    """The shape of a window and the constants of the network.

    Attributes:
        shape: [H, Y, X] cells. rings: cells of the torus over heading, y, x. excite, inhibit: [w] kernels,
            the same along every axis. sigma: of excitation, cells. threshold: global inhibition. unit: rad
            per heading cell. margin: cells along each face that must stay empty. margin_mask: [H, Y, X] bool,
            these cells. gap: distance in cells beyond which two packets do not interact.
    """

    shape: tuple[int, int, int]
    rings: tuple[int, int, int]
    excite: Array
    inhibit: Array
    sigma: Any
    threshold: Any
    unit: float
    margin: int
    margin_mask: np.ndarray
    gap: int

    @property
    def is_torus(self) -> bool:
        """Whether the window is the whole torus."""
        return self.shape == self.rings

    def wraps(self, k: int) -> bool:
        """Whether the window is the full ring along axis k."""
        return self.shape[k] == self.rings[k]

    def uses_matrices(self, k: int) -> bool:
        """Whether activity moves along axis k by products with matrices."""
        return self.wraps(k) and self.shape[k] < MATRIX_BELOW

    def ring_sizes(self) -> np.ndarray:
        """[3] int32 cells of the torus along x, y and heading."""
        return np.array(self.rings[::-1], np.int32)

    def origin_centred_on(self, pose: Array) -> Array:
        """[3] int32 first cell of a window centred on a pose; 0 along full rings."""
        first = (jnp.floor(pose).astype(jnp.int32) - self.cells_before_centre()) % self.ring_sizes()
        return jnp.where(np.not_equal(self.shape, self.rings)[::-1], first, 0)

    def cells_before_centre(self) -> np.ndarray:
        """[3] int32 cells from the window's first cell to its centre, over x, y, heading."""
        return np.array(self.shape[::-1], np.int32) // 2 - 1

    def excite_and_inhibit(self, activity: Array) -> Array:
        """Activity after excitation, inhibition and threshold, not normalised. Both kernels are separable."""
        window, before, inside = self, 0, self.shape[2]
        reach = len(self.excite) // 2 + len(self.inhibit) // 2
        if self.wraps(2) and not self.uses_matrices(2) and inside + 2 * reach <= EVEN_ROW:
            before, after = reach, EVEN_ROW - inside - reach
            ends = activity[:, :, -before:], activity, activity[:, :, :after]
            activity = lax.optimization_barrier(jnp.concatenate(ends, axis=2))
            window = self._replace(shape=(*self.shape[:2], EVEN_ROW))
        excited = _convolve(window, window.excite, activity)
        left = (excited - _convolve(window, window.inhibit, excited))[:, :, before : before + inside]
        return jnp.where(left >= window.threshold, left - window.threshold, 0.0)

    def integrate(self, activity: Array, origin: Array, motion: Array, lag: Array, shift: Array) -> Array:
        """Path integration: every heading layer moves in its own direction.

        Args:
            motion: [3] body-frame motion, cells: each layer moves along its own heading, then all layers
                shift. lag: [3] extra motion in the frame of the network, cells, the same for every layer.
                Together less than a cell along each axis.
            shift: [3] int32, -1 to 1, motion of the window itself.
        """
        layer = (origin[2] + np.arange(self.shape[0], dtype=np.int32)) % self.rings[0]
        along, across = rotate(motion[0], motion[1], layer.astype(motion.dtype) * self.unit)
        moved = shift.astype(motion.dtype)
        activity = _translate(self, activity, 1, (across + (lag[1] - moved[1]))[:, None, None])
        activity = _translate(self, activity, 2, (along + (lag[0] - moved[0]))[:, None, None])
        return _translate(self, activity, 0, motion[2] + lag[2] - moved[2])

    def deposit(self, activity: Array, origin: Array, pose: Array, energy: Array) -> Array:
        """Adds `energy` at a pose, shared trilinearly among its eight neighbour cells; shares outside the
        window are dropped."""
        low = jnp.floor(pose)
        share = pose - low
        low = low.astype(jnp.int32) - origin
        corner = np.array([[x, y, th] for th in (0, 1) for y in (0, 1) for x in (0, 1)], np.int32)
        weight = jnp.prod(jnp.where(corner == 1, share[None], 1 - share[None]), axis=1)
        at = (low[None] + corner) % self.ring_sizes()[None]
        return activity.at[at[:, 2], at[:, 1], at[:, 0]].add(energy * weight, mode="drop")

    def holds_deposit(self, origin: Array, pose: Array) -> Array:
        """bool: a deposit at the pose would leave the margin of the window empty."""
        low = (jnp.floor(pose).astype(jnp.int32) - origin) % self.ring_sizes()
        fits = (low >= self.margin) & (low + 1 < np.array(self.shape[::-1], np.int32) - self.margin)
        return jnp.all(fits | np.equal(self.shape, self.rings)[::-1])

    def deposit_gain(self, pose: Array) -> Array:
        """Factor on the energy of a deposit between cells that makes it excite as much as one on a cell.

        Along one axis, a deposit with share f on the next cell is excited at its own position to
        (1 - f) g(f) + f g(1 - f) of its energy, where g is the excitation kernel.
        """
        f = pose - jnp.floor(pose)
        sharp = -0.5 / self.sigma**2
        return 1 / jnp.prod((1 - f) * jnp.exp(sharp * f**2) + f * jnp.exp(sharp * (1 - f) ** 2))

    def peak_index(self, activity: Array, origin: Array) -> Array:
        """int32 index of the cell with the largest activity, in the flattened torus."""
        first, ring = origin[::-1], self.ring_sizes()[::-1]
        peak = zip(_peak(self, activity, first), first, ring, strict=True)
        heading, y, x = ((a + b) % n for a, b, n in peak)
        return (heading * ring[1] + y) * ring[2] + x

    def margin_is_empty(self, activity: Array) -> Array:
        """bool: no activity in the margin."""
        if self.is_torus:
            return jnp.bool_(True)
        return jnp.max(jnp.where(self.margin_mask, activity, 0.0)) <= 0

    def decode(self, activity: Array, origin: Array) -> tuple[Array, Array]:
        """Circular mean and circular standard deviation of the strongest packet: [3], [3] in cells.

        Only the box around the peak counts, so other packets do not bias the mean. The peak is found one axis
        at a time, which needs one pass over the cells instead of a scalar search.
        """
        first = origin[::-1]
        box, low = activity, []
        for k, peak in enumerate(_peak(self, activity, first)):
            if self.wraps(k):
                at = (peak + np.arange(-BOX, BOX + 1, dtype=np.int32)) % self.shape[k]
                box, begin = jnp.take(box, at, axis=k), peak - BOX
            else:
                begin = jnp.clip(peak - BOX, 0, self.shape[k] - 2 * BOX - 1)
                box = lax.dynamic_slice_in_dim(box, begin, 2 * BOX + 1, k)
            low.append(begin)
        # Circular moments of the marginals [3, 2 BOX + 1] over heading, y, x, each on its ring.
        around = (first + jnp.stack(low))[:, None] + np.arange(2 * BOX + 1, dtype=np.int32)[None]
        mass = jnp.stack([jnp.sum(box, (1, 2)), jnp.sum(box, (0, 2)), jnp.sum(box, (0, 1))])
        cells = self.ring_sizes()[::-1]
        at, ring = around % cells[:, None], cells.astype(activity.dtype)
        unit = (2 * np.pi / ring).astype(mass.dtype)
        angle = at.astype(mass.dtype) * unit[:, None]
        s, c = jnp.sum(mass * jnp.sin(angle), 1), jnp.sum(mass * jnp.cos(angle), 1)
        mean = (jnp.arctan2(s, c) / unit) % ring
        length = jnp.minimum(jnp.hypot(s, c) / jnp.sum(mass, 1), 1.0)
        spread = jnp.sqrt(-2 * jnp.log(length)) / unit
        return jnp.where(mean >= ring, 0.0, mean)[::-1], spread[::-1]


def make_window(config: NetworkConfig, inner: int | None, dtype: np.dtype) -> Window:
    """A window that is exact for activity within `inner` cells along each axis; None: the whole torus."""
    margin = config.excite_width // 2
    gap = 2 * margin + config.inhibit_width // 2
    sizes, margin_mask = [], np.zeros((1, 1, 1), bool)
    rings = config.cells_heading, config.cells_xy, config.cells_xy
    for k, ring in enumerate(rings):
        # A packet must not interact with itself around the ring.
        whole = inner is None or ring < inner + gap
        size = ring if whole or inner is None else inner + 2 * margin
        sizes.append(size)
        at = np.arange(size)
        outer = np.zeros(size, bool) if whole else (at < margin) | (at >= size - margin)
        margin_mask = margin_mask | outer.reshape([-1 if axis == k else 1 for axis in range(3)])
    excite = _gaussian(config.excite_width, config.excite_sigma, dtype)
    inhibit = _gaussian(config.inhibit_width, config.inhibit_sigma, dtype)
    unit, (heading, y, x) = 2 * np.pi / config.cells_heading, sizes
    sigma, threshold = config.excite_sigma, config.global_inhibition
    return Window((heading, y, x), rings, excite, inhibit, sigma, threshold, unit, margin, margin_mask, gap)


def rotate(x: Array, y: Array, angle: Array) -> tuple[Array, Array]:
    """A vector rotated by an angle, rad."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return c * x - s * y, s * x + c * y


def ring_difference(difference: Array, size: Array) -> Array:
    """A difference of positions on a ring, in cells, wrapped to [-size/2, size/2)."""
    return (difference + size / 2) % size - size / 2


def _convolve(window: Window, kernel: Array, activity: Array) -> Array:
    """Activity convolved with an even kernel [w] along each axis."""
    half = len(kernel) // 2
    for k in (1, 0, 2):
        if window.uses_matrices(k):
            matrix = jnp.tensordot(kernel, _roll_matrices(window.shape[k], half, kernel.dtype), 1)
            activity = _multiply_along(matrix, activity, k)
            continue
        shape = activity.shape
        shifted = _shifter(window, activity, k, half)
        activity = kernel[half] * shifted(0)
        for t in range(1, half + 1):
            activity = activity + kernel[half + t] * (shifted(t) + shifted(-t))
        activity = activity.reshape(shape)
    return activity


def _translate(window: Window, activity: Array, k: int, distance: Array) -> Array:
    """Activity moved along axis k by a distance [] or [H, 1, 1] in cells, with linear interpolation."""
    reach = 1 if window.wraps(k) else 2
    share = [jnp.maximum(0.0, 1 - jnp.abs(distance - t)) for t in range(-reach, reach + 1)]
    if window.uses_matrices(k):
        matrices = _roll_matrices(window.shape[k], 1, activity.dtype)
        return _multiply_along(jnp.tensordot(jnp.stack(share, -1), matrices, 1), activity, k)
    shifted = _shifter(window, activity, k, reach)
    moved = (part * shifted(t) for t, part in zip(range(-reach, reach + 1), share, strict=True))
    return reduce(jnp.add, moved).reshape(activity.shape)


def _roll_matrices(size: int, reach: int, dtype: np.dtype) -> np.ndarray:
    """[2 reach + 1, size, size] matrices that roll activity around a ring by -reach to reach cells."""
    return np.stack([np.roll(np.eye(size, dtype=dtype), t, axis=0) for t in range(-reach, reach + 1)])


def _multiply_along(matrix: Array, activity: Array, k: int) -> Array:
    """Product along axis k with a matrix [n, n], or with one for each heading layer [H, 1, 1, n, n]."""
    h, n, m = activity.shape
    if k == 0:
        return (matrix @ activity.reshape(h, n * m)).reshape(h, n, m)
    matrix = matrix.reshape(-1, *matrix.shape[-2:])
    if k == 1:
        return jnp.matmul(jnp.broadcast_to(matrix, (h, n, n)), activity)
    return jnp.matmul(activity, jnp.broadcast_to(jnp.swapaxes(matrix, 1, 2), (h, m, m)))


def _shifter(window: Window, activity: Array, k: int, reach: int) -> Callable[[int], Array]:
    """A function of t that gives the activity moved by t cells along axis k, |t| <= reach.

    Between products with matrices a heading layer is one row of cells; the caller restores the shape.
    """
    if k == 0 and window.uses_matrices(2):
        activity = activity.reshape(len(activity), -1)  # rows of 11 to 17 cells are slow to shift
    size = activity.shape[k]
    if window.wraps(k):
        before = lax.slice_in_dim(activity, size - reach, size, axis=k)
        after = lax.slice_in_dim(activity, 0, reach, axis=k)
    else:
        shape = [reach if a == k else n for a, n in enumerate(activity.shape)]
        before = after = jnp.zeros(shape, activity.dtype)
    # The barrier makes one array of the three pieces; without it every cell costs a branch.
    padded = lax.optimization_barrier(jnp.concatenate([before, activity, after], axis=k))
    return lambda t: lax.slice_in_dim(padded, reach - t, reach - t + size, axis=k)


def _peak(window: Window, activity: Array, first: Array) -> tuple[Array, Array, Array]:
    """Indices of the largest activity: heading, y, x; among ties along an axis, the torus's first cell."""
    found = []
    for k, ring in enumerate(window.rings):
        marginal = jnp.max(activity, axis=(1, 2)[: 2 - k])
        at = (first[k] + np.arange(len(marginal), dtype=np.int32)) % ring
        tied = marginal >= jnp.max(marginal) * (1 - TIE)
        found.append(jnp.argmin(jnp.where(tied, at, ring)).astype(jnp.int32))
        activity = lax.dynamic_index_in_dim(activity, found[k], 0, keepdims=False)
    heading, y, x = found
    return heading, y, x


def _gaussian(width: int, sigma: float, dtype: np.dtype) -> np.ndarray:
    weight = np.exp((np.arange(width) - width // 2).astype(float) ** 2 / (-2 * np.float64(sigma) ** 2))
    return (weight / weight.sum()).astype(dtype)
