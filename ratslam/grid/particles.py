"""Particles of the grid filter: motion, weights, resampling; their ancestors; their maps.

Each particle carries estimates of the odometry's errors: scale errors constant over the session, scale errors
constant over a movement, and a heading drift constant over the session. `Genealogy` keeps the paths of the
ancestors of the particles that survived. The maps of all particles are read and written through small
windows, so that work is independent of map size: a map holds evidence (log-odds, 0 where unexplored) and a
vector field of doubled wall directions. Places are in cells. Cells outside the map always count as
unexplored.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.grid.config import DriftConfig, ResamplingConfig
from tactile.base.types import Array, Odometry

RATE_STREAM, SLIP_STREAM = 1, 2
"""Random streams beside those of the scale errors, which stay the same where there is no drift or slip."""


class Particles(NamedTuple):
    """N particles.

    Attributes:
        pose: [N, 3] m, m, rad. session, move: [N, 2] relative scale errors of distances and turns, over the
            session and over the present movement. weight: [N] logarithms. heading_rate: [N] heading drift,
            rad/s; None if there is none.
    """

    pose: Array
    session: Array
    move: Array
    weight: Array
    heading_rate: Array | None = None


class Resampling(NamedTuple):
    """The particles after resampling, as copies of those before.

    Attributes:
        ancestor: [N] int32, the particle that each is a copy of. source, target: [N] int32, the copies to
            make, of which the first `copies` are valid.
    """

    ancestor: Array
    source: Array
    target: Array
    copies: Array


def start(config: DriftConfig, key: Array, count: int, dtype: jnp.dtype) -> Particles:
    """N particles at the origin, with random scale errors and heading drifts."""
    # Without the barrier XLA merges two factors: other bits compiled than not.
    session = config.session * lax.optimization_barrier(jax.random.normal(key, (count, 2), dtype))
    rate = None
    if config.heading_rate:
        draws = jax.random.normal(jax.random.fold_in(key, RATE_STREAM), (count,), dtype)
        rate = config.heading_rate * lax.optimization_barrier(draws)
    at, weight = jnp.zeros((count, 3), dtype), jnp.zeros(count, dtype)
    return Particles(at, session, jnp.zeros_like(session), weight, rate)


def move(
    config: DriftConfig,
    particles: Particles,
    odometry: Odometry,
    changed: Array,
    key: Array,
    pressed: Array | bool = False,
) -> Particles:
    """The particles after an odometry reading.

    Args:
        changed: bool, a new movement has begun, whose scale errors are drawn at random. pressed: bool, the
            step begins in contact.
    """
    dtype = particles.pose.dtype
    draws = jax.random.normal(key, (5, *particles.weight.shape), dtype)
    move = jnp.where(changed, config.move * draws[:2].T, particles.move)
    scale = 1 + particles.session + move + config.step * draws[2:4].T
    if config.slip:
        # Shares of distance and turn that remain: a robot that begins the step in contact and drives forward
        # stands still while its wheels turn; how far it turns is unknown.
        count, slip = len(draws[0]), config.slip
        lost = slip * jax.random.uniform(jax.random.fold_in(key, SLIP_STREAM), (count,), dtype)
        kept = jnp.stack([jnp.full(count, 1 - slip, dtype), 1 - lost], axis=1)
        scale *= jnp.where(pressed & (odometry.dx > 0), kept, 1.0)
    x, y, heading = particles.pose.T
    error = odometry.dtheta * (scale[:, 1] - 1) + config.heading * draws[4]
    if particles.heading_rate is not None:
        error += particles.heading_rate * odometry.dt
    on = heading + error / 2  # odometry is in the old frame; its heading error grows along the step
    c, s = jnp.cos(on), jnp.sin(on)
    dx, dy = odometry.dx * scale[:, 0], odometry.dy * scale[:, 0]
    turned = heading + odometry.dtheta + error
    turned -= 2 * jnp.pi * jnp.round(turned / (2 * jnp.pi))  # large angles lose precision in float32
    pose = jnp.stack([x + c * dx - s * dy, y + s * dx + c * dy, turned], axis=1)
    return particles._replace(pose=pose, move=move)


def weigh(particles: Particles, likelihood: Array) -> tuple[Particles, Array]:
    """Adds log-likelihoods [N]; the largest weight becomes 0. Also bool: all weights vanished, in which case
    they are left unchanged."""
    weight = particles.weight + likelihood
    most = jnp.max(weight)
    vanished = ~jnp.isfinite(most) | jnp.any(jnp.isnan(weight))
    return particles._replace(weight=jnp.where(vanished, particles.weight, weight - most)), vanished


def normalised_weights(weight: Array) -> Array:
    """[N] weights that sum to 1, from logarithms [N]."""
    share = jnp.exp(weight - jnp.max(weight))
    return share / jnp.sum(share)


def effective_count(share: Array) -> Array:
    """Effective number of particles of normalised weights [N]."""
    return 1 / jnp.sum(share**2)


def resample(config: ResamplingConfig, share: Array, key: Array) -> Resampling:
    """Draws N particles by their normalised weights [N]."""
    count = share.shape[0]
    total = jnp.cumsum(share)
    total = total / total[-1]
    if config.scheme == "multinomial":
        at = jnp.sort(jax.random.uniform(key, (count,), share.dtype))
    else:
        at = (jnp.arange(count, dtype=share.dtype) + jax.random.uniform(key, (), share.dtype)) / count
    at = jnp.minimum(at, 1 - jnp.finfo(share.dtype).epsneg)  # rounding may give 1
    # Points below the end of each particle's interval; the differences are the numbers of copies.
    below = jnp.searchsorted(at, total, side="left").astype(jnp.int32)
    offspring = jnp.diff(below, prepend=jnp.int32(0))
    return assign_copies(offspring)


def assign_copies(offspring: Array) -> Resampling:
    """The copies for given numbers of offspring [N]: survivors stay, extra copies fill the gaps."""
    count = offspring.shape[0]
    target = jnp.nonzero(offspring == 0, size=count, fill_value=count)[0].astype(jnp.int32)
    surplus = jnp.cumsum(jnp.maximum(offspring - 1, 0)).astype(jnp.int32)
    rank = jnp.arange(count, dtype=jnp.int32)
    source = jnp.minimum(jnp.searchsorted(surplus, rank, side="right").astype(jnp.int32), count - 1)
    ancestor = rank.at[target].set(source, mode="drop")
    return Resampling(ancestor, source, target, jnp.sum(offspring == 0).astype(jnp.int32))


def copy_particles(
    config: ResamplingConfig, particles: Particles, drawn: Resampling, key: Array
) -> Particles:
    """The resampled particles with equal weights; copies are displaced by small random amounts."""
    dtype, ancestor = particles.pose.dtype, drawn.ancestor
    new = (ancestor != jnp.arange(len(ancestor), dtype=jnp.int32)).astype(dtype)[:, None]
    draws = jax.random.normal(key, (len(ancestor), 5), dtype) * new
    rate = particles.heading_rate
    if rate is not None:
        changes = jax.random.normal(jax.random.fold_in(key, RATE_STREAM), new.shape[:1], dtype)
        rate = rate[ancestor] + config.heading_rate * new[:, 0] * changes
    spread = jnp.array([config.length, config.length, config.heading], dtype)
    pose = particles.pose[ancestor] + spread[None] * draws[:, :3]
    session = particles.session[ancestor] + config.scale * draws[:, 3:]
    return Particles(pose, session, particles.move[ancestor], jnp.zeros_like(particles.weight), rate)


def copy_rows(rows: Array, drawn: Resampling) -> Array:
    """[N, ...] rows that belong to the particles, resampled in place; only copies are written."""

    def copy(k: Array, rows: Array) -> Array:
        row = lax.dynamic_index_in_dim(rows, drawn.source[k], keepdims=True)
        return lax.dynamic_update_index_in_dim(rows, row, drawn.target[k], 0)

    return lax.fori_loop(jnp.int32(0), drawn.copies, copy, rows)


def weighted_mean(pose: Array, share: Array) -> tuple[Array, Array]:
    """[3] the mean pose by normalised weights [N], and [3] its standard deviations (m, m, rad)."""
    middle = share @ pose[:, :2]
    c, s = share @ jnp.cos(pose[:, 2]), share @ jnp.sin(pose[:, 2])
    spread = jnp.sqrt(share @ (pose[:, :2] - middle[None]) ** 2)
    length = jnp.clip(jnp.hypot(c, s), 1e-12, 1.0)
    heading = jnp.sqrt(-2 * jnp.log(length))
    return jnp.append(middle, jnp.arctan2(s, c)), jnp.append(spread, heading)


MAX_POSES = 4_000_000
"""Poses stored for individual particles."""


class Genealogy(Checkpointed):
    """Poses and ancestors of N particles at each report. Memory is bounded: of more than `MAX_POSES` poses,
    the older half is replaced by the weighted mean path."""

    VALUES = ("_weight",)

    def __init__(self, count: int) -> None:
        self.count = count
        self._settled = GrowableArray((3,), np.float64)
        self._ancestor = GrowableArray((count,), np.int32)
        self._pose = GrowableArray((count, 3), np.float64)
        self._weight = np.full(count, 1.0 / count)

    def append(self, poses: np.ndarray, weights: np.ndarray, ancestor: np.ndarray) -> None:
        """Adds a report: poses [N, 3], normalised weights [N], and the next ancestors [N]."""
        self._pose.append(poses)
        self._ancestor.append(ancestor)
        self._weight = np.asarray(weights, float)
        if len(self._pose.rows) * self.count > MAX_POSES and len(self._pose.rows) > 1:
            older = len(self._pose.rows) // 2
            for pose in self._mean_path()[:older]:
                self._settled.append(pose)
            self._pose.replace(self._pose.rows[older:].copy())
            self._ancestor.replace(self._ancestor.rows[older:].copy())

    def path(self) -> np.ndarray:
        """[T, 3] the weighted mean of the ancestral paths of the present particles."""
        return np.concatenate([self._settled.rows, self._mean_path()])

    def _mean_path(self) -> np.ndarray:
        pose, ancestor, weight = self._pose.rows, self._ancestor.rows, self._weight
        path = np.zeros((len(pose), 3))
        here = np.arange(self.count)
        for k in range(len(pose) - 1, -1, -1):
            if k + 1 < len(pose):
                here = ancestor[k][here]
            now = pose[k][here]
            heading = np.arctan2(weight @ np.sin(now[:, 2]), weight @ np.cos(now[:, 2]))
            path[k] = [*(weight @ now[:, :2]), heading]
        return path


EVIDENCE, COSINE, SINE = 0, 1, 2
LAYERS = 3
"""Layers of the maps [N, LAYERS, S, S] of all particles; rows are y, columns x."""


def to_cells(point: Array, cell: float, side: int) -> Array:
    """[..., 2] positions in m as places in cells, from the middle of the first cell."""
    return point / cell + (side - 1) / 2


def windows_around(place: Array, side: int, size: int) -> Array:
    """[N, 2] int32 corners, first column and row, of windows of `size` x `size` cells, at most `side`, around
    places [N, 2] in cells, moved to lie inside the map."""
    corner = jnp.floor(place).astype(jnp.int32) - (size // 2 - 1)
    return jnp.clip(corner, 0, side - size)


def read_window(maps: Array, corner: Array, size: int, layer: int) -> Array:
    """[N, size, size] one layer of the maps inside the windows with these corners [N, 2]."""

    def read(rows: Array, corner: Array) -> Array:
        return lax.dynamic_slice(rows[layer], (corner[1], corner[0]), (size, size))

    return jax.vmap(read)(maps, corner)


def write_window(maps: Array, corner: Array, layer: int, values: Array) -> Array:
    """The maps with one layer inside the windows replaced by values [N, size, size]."""
    zero = jnp.int32(layer)

    def write(rows: Array, corner: Array, value: Array) -> Array:
        return lax.dynamic_update_slice(rows, value[None], (zero, corner[1], corner[0]))

    return jax.vmap(write)(maps, corner, values)


def to_window(place: Array, corner: Array) -> Array:
    """[N, K, 2] places in the windows, from places in the map; cells."""
    return place - corner[:, None, :].astype(place.dtype)


def placed(pose: Array, points: Array) -> Array:
    """[N, K, 2] points [K, 2] of base_link at poses [N, 3]."""
    c, s = jnp.cos(pose[:, 2:]), jnp.sin(pose[:, 2:])
    right, up = points.T[:, None]
    return jnp.stack([pose[:, :1] + c * right - s * up, pose[:, 1:2] + s * right + c * up], axis=2)


def interpolate(maps: Array, layer: int, place: Array) -> Array:
    """[N, K] one layer at places [N, K, 2] in cells, interpolated bilinearly; 0 at the rim and outside."""
    count, layers, side, _ = maps.shape
    low = jnp.floor(place)
    inside = jnp.all((low >= 0) & (low < side - 1), axis=2)
    column, row = jnp.moveaxis(jnp.where(inside[:, :, None], low, 0.0).astype(jnp.int32), 2, 0)
    right, up = jnp.moveaxis(place - low, 2, 0)
    first = ((jnp.arange(count, dtype=jnp.int32)[:, None] * layers + layer) * side + row) * side + column
    flat = maps.reshape(-1)

    def at(index: Array) -> Array:
        return flat.at[index].get(mode="promise_in_bounds")

    below = at(first) * (1 - right) + at(first + 1) * right
    above = at(first + side) * (1 - right) + at(first + side + 1) * right
    return jnp.where(inside, below * (1 - up) + above * up, 0.0)
