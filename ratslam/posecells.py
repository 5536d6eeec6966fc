"""Pose cells: a continuous attractor network over (heading, y, x), each axis a ring.

One packet of activity says where the robot is. A step is: inject what the view recalls, then for each
sub-step excite, inhibit, threshold, normalise and integrate a part of the motion; then decode the packet.
Sources: Milford & Wyeth 2004; Ball et al. 2013; the ways in which this differs from them are listed in
`ratslam/README.md`.

Activity is [K, N, N] over heading, y, x; poses in cells are [3] over x, y, heading, in [0, N) and [0, K).
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from pydantic import AfterValidator, Field, PositiveFloat, PositiveInt

from tactile.settings import Settings
from tactile.types import Array, Odometry

TIE = 1e-9
"""Activities this close to the largest (as a share) tie with it: the first wins, whatever the rounding."""
BOX = 3
"""The packet is decoded from the (2 BOX + 1)^3 cells around its peak."""
SIDE = 18
"""Cells along each axis of the box that a settled packet is worked on in: 9 or 10, and a margin each side."""
MARGIN = 4
"""Cells that activity can spread in one iteration: 3 excited, 1 moved."""
LEAST_BOXED = 31
"""Smaller tori are as fast whole."""
LARGEST_PART = 0.5
"""Cells one sub-step moves at most: a packet moved further at once shears into a ring."""
MOST_PARTS = 256
"""Sub-steps of one step at most: bounds the time of a step whatever odometry says."""
JUMP = 1.0
"""A packet that moved this much otherwise than told (cells) has jumped; it has not lagged behind."""


def _odd(width: int) -> int:
    if width % 2 == 0:
        raise ValueError("must be odd, so that a kernel has a middle")
    return width


Width = Annotated[int, Field(ge=3, le=15), AfterValidator(_odd)]


class Outcome(IntEnum):
    """How a step of the network went."""

    OK = 0
    RESEEDED = 1
    """Activity had died out; one packet was put back where the last one had been."""
    TOO_FAST = 2
    """Odometry told of more motion than `MOST_PARTS` sub-steps can carry; the excess was dropped."""
    NOT_FINITE = 3
    """Odometry or view was NaN or infinite and was taken as no motion and no view."""
    FULL = 4
    """A new view or place had no room and was not kept."""


class PoseCellConfig(Settings):
    """The pose-cell network."""

    cells_xy: Annotated[int, Field(ge=7, le=1001)] = 21
    """Cells along x and along y."""
    cells_heading: Annotated[int, Field(ge=7, le=720)] = 36
    """Cells around the heading ring."""
    cell_size: PositiveFloat = 0.1
    """Side of a cell, m."""
    excite_width: Width = 7
    """Cells across the excitation kernel, odd."""
    excite_sigma: PositiveFloat = 1.0
    """Standard deviation of excitation, cells."""
    inhibit_width: Width = 5
    """Cells across the inhibition kernel, odd."""
    inhibit_sigma: PositiveFloat = 2.0
    """Standard deviation of inhibition, cells."""
    global_inhibition: Annotated[float, Field(ge=0, lt=0.1)] = 2e-5
    """Activity taken from every cell at each sub-step."""
    settle_steps: PositiveInt = 10
    """Steps after an injection during which the packet's lag is not measured: it moves by recall then."""


class PoseCells(NamedTuple):
    """The network's state.

    Attributes:
        activity: [K, N, N], sums to 1 after every step.
        pose: [3] the decoded packet, cells.
        lag: [3] motion told but not yet made by the packet, cells.
        settling: steps until the lag is measured again, int32.
    """

    activity: Array
    pose: Array
    lag: Array
    settling: Array


class Tables(NamedTuple):
    """Constants of one network shape, host NumPy: circulant matrices [n, n] along each axis, and the heading
    [k] of each layer, rad."""

    excite_xy: np.ndarray
    both_xy: np.ndarray
    excite_heading: np.ndarray
    both_heading: np.ndarray
    heading: Array


def tables(config: PoseCellConfig, dtype: np.dtype) -> Tables:
    """Excitation, and excitation followed by inhibition, as circulant matrices along one axis.

    Both kernels are separable Gaussians of sum 1, so three products make a 3-D convolution.
    """
    return _tables(config, config.cells_xy, config.cells_heading, dtype)


def box_tables(config: PoseCellConfig, dtype: np.dtype) -> Tables | None:
    """The same for a box of `SIDE` cells cut out of the torus; None where that would save nothing.

    Around a box's edge the products wrap, but what they wrap there is below the threshold on both sides.
    """
    if config.cells_xy < LEAST_BOXED or config.cells_heading < SIDE:
        return None
    if max(config.excite_width, config.inhibit_width) > 2 * MARGIN - 1:
        return None
    return _tables(config, SIDE, SIDE, dtype)


def _tables(config: PoseCellConfig, n: int, k: int, dtype: np.dtype) -> Tables:
    excite = _gaussian(config.excite_width, config.excite_sigma)
    both = np.convolve(excite, _gaussian(config.inhibit_width, config.inhibit_sigma))
    matrices = (_circulant(excite, n), _circulant(both, n), _circulant(excite, k), _circulant(both, k))
    heading = 2 * np.pi / config.cells_heading * np.arange(k)
    return Tables(*(matrix.astype(dtype) for matrix in (*matrices, heading)))


def rings(config: PoseCellConfig, dtype: np.dtype) -> np.ndarray:
    """[3] cells around x, y and heading."""
    return np.array([config.cells_xy, config.cells_xy, config.cells_heading], dtype)


def units(config: PoseCellConfig, dtype: np.dtype) -> np.ndarray:
    """[3] size of a cell along x, y and heading: m, m, rad."""
    return np.array([config.cell_size, config.cell_size, 2 * np.pi / config.cells_heading], dtype)


def start(config: PoseCellConfig, dtype: np.dtype) -> PoseCells:
    """One packet's seed, a single cell, in the middle."""
    pose = jnp.asarray(rings(config, dtype) // 2)
    activity = jnp.zeros((config.cells_heading, config.cells_xy, config.cells_xy), dtype)
    return PoseCells(deposit(activity, pose, jnp.asarray(1, dtype)), pose, jnp.zeros(3, dtype), jnp.int32(0))


def step(
    config: PoseCellConfig, table: Tables, cells: PoseCells, odometry: Odometry, recall: Array, energy: Array
) -> tuple[PoseCells, Array, Array]:
    """One step of the network.

    Args:
        odometry: body-frame motion, m, m, rad (finite).
        recall: [3] packet to inject at, cells. energy: how much, 0 for nothing.

    Returns:
        the new state, the packet's spread [3] in cells, and an `Outcome`.
    """
    dtype = cells.activity.dtype
    n, unit = rings(config, dtype), units(config, dtype)
    injected = energy > 0
    activity = deposit(cells.activity, recall, excited_share(config, recall) * energy)
    settling = jnp.where(injected, jnp.int32(config.settle_steps), jnp.maximum(cells.settling - 1, 0))
    measured = settling == 0
    lag = jnp.where(measured, cells.lag, jnp.zeros_like(cells.lag))

    told = jnp.stack([odometry.dx, odometry.dy, odometry.dtheta]) / unit
    reach = jnp.maximum(jnp.hypot(told[0], told[1]) + jnp.hypot(lag[0], lag[1]), jnp.abs(told[2] + lag[2]))
    wanted = jnp.maximum(jnp.ceil(reach / LARGEST_PART - TIE), 1.0)
    parts = jnp.minimum(wanted, float(MOST_PARTS))
    told, lag = told * (parts / wanted), lag * (parts / wanted)

    part, behind_part = told / parts, lag / parts
    ahead = jnp.stack([*_turned(part[0], part[1], cells.pose[2] * unit[2]), part[2]])  # about, for each part

    def sub_step(s, carry):
        activity, died = carry
        # Odometry is told in the frame the step began in; the packet has turned since, and lags behind it.
        aside = lag[2] - s.astype(lag.dtype) * (part[2] + behind_part[2])
        moved = jnp.stack([*_turned(part[0], part[1], aside * unit[2]), part[2]])
        centre = cells.pose + s.astype(lag.dtype) * ahead
        activity, dead = iterate(config, table, activity, cells.pose, centre, moved, behind_part)
        return activity, died | dead

    count = parts.astype(jnp.int32)
    activity, died = lax.fori_loop(0, count, sub_step, (activity, jnp.bool_(False)))
    pose, spread = decode(activity)

    world = jnp.stack([*_turned(told[0], told[1], (cells.pose[2] + lag[2]) * unit[2]), told[2]])
    behind = around(world + lag - (pose - cells.pose), n)
    jumped = died | (jnp.max(jnp.abs(behind)) > JUMP)
    lag = jnp.where(measured, jnp.where(jumped, jnp.zeros_like(lag), behind), cells.lag)
    outcome = jnp.where(died, Outcome.RESEEDED, jnp.where(wanted > parts, Outcome.TOO_FAST, Outcome.OK))
    return PoseCells(activity, pose, lag, settling), spread, outcome.astype(jnp.int32)


def iterate(
    config: PoseCellConfig,
    table: Tables,
    activity: Array,
    seed: Array,
    centre: Array,
    told: Array,
    lag: Array,
) -> tuple[Array, Array]:
    """One network iteration: attract, then integrate a part of the motion; also whether activity died.

    A settled packet fills some 200 cells however large the torus is. Where all activity lies `MARGIN` cells
    inside a box around `centre` [3], about where the packet is, only the box is worked on: excitation reaches
    3 cells and motion 1, and inhibition beyond what is excited is below the threshold, so the result is that
    of the whole torus.
    """
    box = box_tables(config, activity.dtype)
    rest = (told, lag)
    if box is None:
        return _iterate(config, table, activity, seed, *rest)
    k, n, _ = activity.shape
    origin = jnp.floor(centre) - SIDE // 2 + 1
    row = np.arange(SIDE, dtype=np.int32)
    corner = origin.astype(jnp.int32)
    at = [(corner[axis] + row) % size for axis, size in ((2, k), (1, n), (0, n))]
    window = (at[0][:, None, None], at[1][None, :, None], at[2][None, None, :])
    part = activity[window]
    inner = part[MARGIN:-MARGIN, MARGIN:-MARGIN, MARGIN:-MARGIN]
    within = jnp.all((seed >= origin) & (seed < origin + SIDE - 1))  # where a dead network starts again
    fits = within & (jnp.sum(inner != 0) == jnp.sum(activity != 0))

    def boxed() -> tuple[Array, Array]:
        here = box._replace(heading=jnp.asarray(table.heading)[at[0]])
        moved, died = _iterate(config, here, part, seed - origin, *rest)
        return activity.at[window].set(moved), died

    return lax.cond(fits, boxed, lambda: _iterate(config, table, activity, seed, *rest))


def _iterate(
    config: PoseCellConfig, table: Tables, activity: Array, seed: Array, told: Array, lag: Array
) -> tuple[Array, Array]:
    activity, died = attract(config, table, activity, seed)
    return integrate(table, activity, told, lag), died


def attract(config: PoseCellConfig, table: Tables, activity: Array, seed: Array) -> tuple[Array, Array]:
    """Excite, inhibit, threshold and normalise; a network that dies of it restarts from `seed` [3].

    Uniform activity always dies: both kernels sum to 1, so it excites and inhibits itself alike.
    """
    k, n, _ = activity.shape
    excited = _along_xy(table.excite_xy, activity)
    inhibited = _along_xy(table.both_xy, activity)
    difference = table.excite_heading @ excited.reshape(k, n * n)
    difference = (difference - table.both_heading @ inhibited.reshape(k, n * n)).reshape(k, n, n)
    kept = jnp.where(difference >= config.global_inhibition, difference - config.global_inhibition, 0.0)
    total = jnp.sum(kept)
    dead = ~(total > 0)
    alive = kept / jnp.where(dead, 1.0, total)
    return lax.cond(
        dead, lambda: deposit(jnp.zeros_like(alive), seed, jnp.ones_like(total)), lambda: alive
    ), dead


def integrate(table: Tables, activity: Array, told: Array, lag: Array) -> Array:
    """Path integration of at most half a cell: every heading layer moves its own way.

    Args:
        told: [3] body-frame motion, cells: each layer moves along its own heading, then all turn.
        lag: [3] in the network's frame, cells: every layer moves alike.
    """
    k, n, _ = activity.shape
    x, y = _turned(told[0], told[1], jnp.asarray(table.heading))
    activity = jnp.matmul(_shift(y + lag[1], n), activity)
    activity = jnp.matmul(activity, jnp.swapaxes(_shift(x + lag[0], n), 1, 2))
    return (_shift(told[2] + lag[2], k) @ activity.reshape(k, n * n)).reshape(k, n, n)


def deposit(activity: Array, pose: Array, energy: Array) -> Array:
    """Adds `energy` at a pose [3] between cells, shared trilinearly among its eight neighbours."""
    k, n, _ = activity.shape
    low = jnp.floor(pose)
    share = pose - low
    low = low.astype(jnp.int32)
    corner = np.array([[x, y, th] for th in (0, 1) for y in (0, 1) for x in (0, 1)], np.int32)
    weight = jnp.prod(jnp.where(corner == 1, share[None, :], 1 - share[None, :]), axis=1)
    at = (low[None, :] + corner) % np.array([[n, n, k]], np.int32)
    return activity.at[at[:, 2], at[:, 1], at[:, 0]].add(energy * weight)


def excited_share(config: PoseCellConfig, pose: Array) -> Array:
    """How much more energy a deposit between cells needs to be excited as high as one on a cell.

    Along one axis, a share f on the next cell is excited to (1 - f) g(f) + f g(1 - f) of the whole at the
    point itself, g the excitation kernel.
    """
    f = pose - jnp.floor(pose)
    sharp = -0.5 / config.excite_sigma**2
    return 1 / jnp.prod((1 - f) * jnp.exp(sharp * f**2) + f * jnp.exp(sharp * (1 - f) ** 2))


def decode(activity: Array) -> tuple[Array, Array]:
    """The strongest packet: circular mean and circular standard deviation [3], [3] in cells.

    Only the box around the peak counts, so other packets do not pull the mean. The peak is found axis by
    axis: one pass over the cells instead of a scalar search.
    """
    k, n, _ = activity.shape
    heading = _first_peak(jnp.max(activity, axis=(1, 2)))
    layer = lax.dynamic_index_in_dim(activity, heading, 0, keepdims=False)
    y = _first_peak(jnp.max(layer, axis=1))
    x = _first_peak(lax.dynamic_index_in_dim(layer, y, 0, keepdims=False))
    around_peak = np.arange(-BOX, BOX + 1, dtype=np.int32)
    at = [(peak + around_peak) % size for peak, size in ((heading, k), (y, n), (x, n))]
    box = activity[at[0]][:, at[1]][:, :, at[2]]
    marginals = (jnp.sum(box, (0, 1)), jnp.sum(box, (0, 2)), jnp.sum(box, (1, 2)))
    means, spreads = zip(
        *(_circular(m, i, size) for m, i, size in zip(marginals, at[::-1], (n, n, k), strict=True)),
        strict=True,
    )
    return jnp.stack(means), jnp.stack(spreads)


def around(difference: Array, size: Array) -> Array:
    """A difference of poses in cells the short way round, in [-size/2, size/2)."""
    return (difference + size / 2) % size - size / 2


def _turned(x: Array, y: Array, angle: Array) -> tuple[Array, Array]:
    c, s = jnp.cos(angle), jnp.sin(angle)
    return c * x - s * y, s * x + c * y


def _first_peak(marginal: Array) -> Array:
    return jnp.argmax(marginal >= jnp.max(marginal) * (1 - TIE)).astype(jnp.int32)


def _circular(mass: Array, at: Array, size: int) -> tuple[Array, Array]:
    unit = 2 * np.pi / size
    angle = at.astype(mass.dtype) * unit
    s, c = jnp.sum(mass * jnp.sin(angle)), jnp.sum(mass * jnp.cos(angle))
    mean = (jnp.arctan2(s, c) / unit) % size
    length = jnp.minimum(jnp.hypot(s, c) / jnp.sum(mass), 1.0)
    return jnp.where(mean >= size, 0.0, mean), jnp.sqrt(-2 * jnp.log(length)) / unit


def _along_xy(matrix: np.ndarray, activity: Array) -> Array:
    k, n, _ = activity.shape
    along_x = (activity.reshape(k * n, n) @ matrix.T).reshape(k, n, n)
    return jnp.einsum("ab,kbi->kai", matrix, along_x)


def _shift(distance: Array, size: int) -> Array:
    """Matrices [..., size, size] that move activity along a ring by a part of a cell, linearly shared."""
    d = distance[..., None, None]
    eye = np.eye(size, dtype=distance.dtype).reshape((1,) * distance.ndim + (size, size))
    up, down = np.roll(eye, 1, axis=-2), np.roll(eye, -1, axis=-2)
    return jnp.maximum(d, 0.0) * up + (1 - jnp.abs(d)) * eye + jnp.maximum(-d, 0.0) * down


def _gaussian(width: int, sigma: float) -> np.ndarray:
    offset = np.arange(width) - width // 2
    weight = np.exp(-(offset**2) / (2 * sigma**2))
    return weight / weight.sum()


def _circulant(kernel: np.ndarray, size: int) -> np.ndarray:
    """C with (C @ v)[i] = sum over t of kernel[t] v[i + t - half], indices around the ring."""
    rows = np.arange(size)
    matrix = np.zeros((size, size))
    for t, weight in enumerate(kernel):
        np.add.at(matrix, (rows, (rows + t - len(kernel) // 2) % size), weight)
    return matrix
