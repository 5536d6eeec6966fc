"""SLAM by a grid particle filter: each particle has a pose, its own map and persistent odometry errors.

After Fox et al. 2012, Algorithm 1. Unlike in the paper, persistent odometry errors are part of the state,
unexplored space is neutral, and walls are expected to continue straight.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.core.backend import Backend
from ratslam.core.estimates import Estimate, Scalar
from ratslam.grid import likelihoods, particles
from ratslam.grid.config import GridConfig
from ratslam.grid.contact_features import ContactFeatures, contact_features
from ratslam.grid.map import GridMap
from ratslam.grid.particles import COSINE, EVIDENCE, LAYERS, SINE, Particles
from ratslam.methods.config import GridBackendConfig
from tactile.base.errors import InputError
from tactile.base.types import Array, MotionKind, Observation
from tactile.whisker_geometry import PlanarWhiskers

FREE_POINTS = (0.2, 0.5, 0.8)
"""Points along a whisker without contact that are marked free, as shares of its length."""
RIM_POINTS = 4
"""Number of points on the robot's rim at which the map is read, besides its centre."""
SEGMENTS = 5
"""Number of segments of a whisker for eq. 2."""
REACH = 2.5
"""Radius at which a footprint is cut off, standard deviations."""
WALL, WALL_DIRECTIONS = 100.0, 40.0
"""Largest precision of a wall's direction: given the field there, and given all walls."""
LIVE_SIDE = 2.5
"""Default side length of the map, m (Fox et al. 2012, II-D)."""
MAX_CELLS = 2**31 - 1
"""Largest number of cells of all maps together: they are indexed in int32."""
MAX_WINDOW_CELLS = 1 << 27
"""Largest number of cells that the footprints of a step cover, a few of which arrays hold at a time."""


class GridOutcome(IntEnum):
    """Outcome of a step of the filter."""

    OK = 0
    RESAMPLED = 1
    """The particles were resampled."""
    VANISHED = 2
    """No particle explains the contacts; the weights are left unchanged."""
    OUTSIDE = 3
    """Contacts lie outside the map for at least one particle and are ignored there."""
    NOT_FINITE = 4
    """Odometry or contacts were NaN, infinite or impossibly large; treated as no motion and no contact."""


class GridState(NamedTuple):
    """State of the filter.

    Attributes:
        maps: [N, layers, S, S]. wall_directions: [N, 2] sums of unit vectors
            at four times the direction of each wall.
        motion: the last report's `Motion`. touched: [W] its contacts. key: data of the random stream's key.
    """

    particles: Particles
    maps: Array
    wall_directions: Array
    motion: Array
    touched: Array
    key: Array


class GridEvidence(NamedTuple):
    """Evidence of one step.

    Attributes:
        ancestor: [N] int32, the particle that each particle was copied from. poses: [N, 3] and weights: [N]
            before resampling. effective_particles: their effective number. outcome: a `GridOutcome`, int32.
    """

    ancestor: Array
    poses: Array
    weights: Array
    effective_particles: Scalar
    outcome: Scalar


class GridBackend(Backend):
    """The grid particle filter as a backend.

    Args:
        feelers: whisker geometry of the observations. side: of the map, m. dtype: of all floating state.
    """

    def __init__(
        self, config: GridConfig, feelers: PlanarWhiskers, side: float, dtype: Any = np.float64
    ) -> None:
        self.config, self.feelers, self.dtype = config, feelers, np.dtype(dtype)
        self.side = int(np.ceil(side / config.cell))
        self.whiskers = len(feelers.length)
        self.free = feelers.points(np.array(FREE_POINTS)).reshape(-1, 2).astype(self.dtype)
        self.shafts = feelers.points((1 + np.arange(SEGMENTS)) / SEGMENTS).reshape(-1, 2).astype(self.dtype)
        angle = np.arange(RIM_POINTS) * 2 * np.pi / RIM_POINTS
        rim = 0.85 * config.body * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self.body = np.concatenate([np.zeros((1, 2)), rim]).astype(self.dtype)
        sds = config.footprint.blob_sd, config.footprint.free_sd, config.footprint.along
        self.blob_sd, self.free_sd, self.along = (sd / config.cell for sd in sds)
        blob, free, along = (REACH * sd for sd in sds)
        reach = max(np.hypot(*self.free.T).max(initial=0.0) + free, config.body)
        tips = np.hypot(*feelers.points(np.ones(1))[:, 0].T).max(initial=0.0)
        self.near, self.far, self.long = (self._window(far) for far in (reach, tips + blob, along))

    def init(self, key: Array, capacity: int) -> GridState:
        """All particles at the origin of an empty map. Nothing grows, so `capacity` is not used."""
        del capacity
        count = self.config.particles
        first, key = jax.random.split(key)
        return GridState(
            particles.start(self.config.drift, first, count, self.dtype),
            jnp.zeros((count, LAYERS, self.side, self.side), self.dtype),
            jnp.zeros((count, 2), self.dtype),
            jnp.int32(MotionKind.OTHER),
            jnp.zeros(self.whiskers, bool),
            jax.random.key_data(key),
        )

    def kernel(self, state: GridState, observation: Observation) -> tuple[GridState, Estimate, GridEvidence]:
        """Moves, weighs and resamples the particles, then updates their maps."""
        key, draw, pick, jitter = jax.random.split(jax.random.wrap_key_data(state.key), 4)
        odometry, features, clean = contact_features(observation, state.touched, self.dtype)
        motion = jnp.asarray(observation.motion, jnp.int32)
        changed, pressed = motion != state.motion, jnp.any(state.touched)
        swarm = particles.move(self.config.drift, state.particles, odometry, changed, draw, pressed)
        swarm, vanished = particles.weigh(swarm, self._likelihood(state, swarm.pose, features))
        share = particles.normalised_weights(swarm.weight)
        worth = particles.effective_count(share)
        pose, spread = particles.weighted_mean(swarm.pose, share)
        poses = swarm.pose

        swarm, drawn = self._resample(swarm, share, worth, features.valid, pick, jitter)
        maps = particles.copy_rows(state.maps, drawn)
        wall_directions = state.wall_directions[drawn.ancestor]
        maps, wall_directions, outside = self._update_maps(maps, wall_directions, swarm.pose, features)

        outcome = jnp.where(drawn.copies > 0, GridOutcome.RESAMPLED, GridOutcome.OK)
        outcome = jnp.where(outside, GridOutcome.OUTSIDE, outcome)
        outcome = jnp.where(vanished, GridOutcome.VANISHED, outcome)
        outcome = jnp.where(clean, outcome, GridOutcome.NOT_FINITE).astype(jnp.int32)
        estimate = Estimate.without_place(pose, spread, vanished)
        evidence = GridEvidence(drawn.ancestor, poses, share, worth, outcome)
        touched = jnp.where(features.valid, features.touching, False)
        after = GridState(swarm, maps, wall_directions, motion, touched, jax.random.key_data(key))
        return after, estimate, evidence

    def counted(self, cell: Array, contact: Array) -> Array:
        """The free points that count in eq. 2 (`likelihood.model: literal`): as printed every point, also the
        tip of a whisker in contact.

        Args:
            cell: [N, W, G, 2] cells at the points of each whisker, from base to tip. contact: [W] bool.
        """
        del contact
        return jnp.ones(cell.shape[:-1], bool)

    def new_map(self) -> GridMap:
        """An empty map."""
        return GridMap(self.config, self.feelers, self.side)

    def _likelihood(self, state: GridState, pose: Array, features: ContactFeatures) -> Array:
        config = self.config.likelihood
        if config.model != "evidence":  # as printed
            cell = jnp.round(self._in_cells(pose, jnp.asarray(self.shafts)))
            evidence = particles.interpolate(state.maps, EVIDENCE, cell)
            shape = (len(pose), self.whiskers, SEGMENTS)
            reporting = features.free | features.touching
            among = self.counted(cell.reshape(*shape, 2), features.touching) & reporting[None, :, None]
            likelihood = likelihoods.printed_likelihood(
                self.config.prior, evidence.reshape(shape), features.touching, among
            )
            return jnp.where(features.valid, likelihood, 0.0)
        points = jnp.concatenate([jnp.asarray(self.free), jnp.asarray(self.body)])
        evidence = particles.interpolate(state.maps, EVIDENCE, self._in_cells(pose, points))
        shafts = jnp.repeat(features.free, len(FREE_POINTS))
        body = jnp.broadcast_to(features.valid & (self.config.body > 0), len(self.body))
        likelihood = likelihoods.free_space(config, evidence, jnp.concatenate([shafts, body]))
        # Few observations have contacts; the rest is computed for those alone.
        return likelihood + lax.cond(
            jnp.any(features.new) | features.wall,
            lambda: self._contact_likelihood(state, pose, features),
            lambda: jnp.zeros_like(likelihood),
        )

    def _contact_likelihood(self, state: GridState, pose: Array, features: ContactFeatures) -> Array:
        """[N] log-likelihood of new contacts, and of a wall's direction given the map there and given the
        directions of all walls."""
        config = self.config.likelihood
        evidence = particles.interpolate(state.maps, EVIDENCE, self._in_cells(pose, features.point))
        likelihood = likelihoods.contact(config, evidence, features.new)
        place = self._in_cells(pose, features.on_wall[None])
        field = [particles.interpolate(state.maps, layer, place) for layer in (COSINE, SINE)]
        direction = pose[:, 2] + features.direction
        sharp = jnp.minimum(WALL, 1 / (4 * features.sd**2))
        aligned = likelihoods.wall_direction(config, jnp.concatenate(field, axis=1), 2 * direction, sharp)
        if config.wall_direction_prior:
            sharp = jnp.minimum(WALL_DIRECTIONS, 1 / (16 * features.sd**2))
            aligned += likelihoods.wall_direction(config, state.wall_directions, 4 * direction, sharp)
        return likelihood + jnp.where(features.wall, aligned, 0.0)

    def _resample(
        self, swarm: Particles, share: Array, worth: Array, valid: Array, pick: Array, jitter: Array
    ) -> tuple[Particles, particles.Resampling]:
        config, count = self.config.resampling, self.config.particles
        needed = worth < config.min_effective_share * count if config.schedule == "needed" else valid
        rank = jnp.arange(count, dtype=jnp.int32)
        none = particles.Resampling(rank, rank, rank, jnp.int32(0))  # every particle remains

        def draw_particles() -> tuple[Particles, particles.Resampling]:
            drawn = particles.resample(config, share, pick)
            return particles.copy_particles(config, swarm, drawn, jitter), drawn

        return lax.cond(needed, draw_particles, lambda: (swarm, none))

    def _update_maps(
        self, maps: Array, wall_directions: Array, pose: Array, features: ContactFeatures
    ) -> tuple[Array, Array, Array]:
        """Every particle's map and wall directions after the observation; bool: a contact lies outside."""
        config = self.config.footprint
        middle = self._in_cells(pose, jnp.zeros((1, 2), self.dtype))
        corner = particles.windows_around(middle[:, 0], self.side, self.near)
        amount = -config.free * jnp.repeat(features.free, len(FREE_POINTS)).astype(self.dtype)
        place = particles.to_window(self._in_cells(pose, jnp.asarray(self.free)), corner)
        footprint = likelihoods.gaussian_blobs(place, amount, self.free_sd, self.near)
        if self.config.body:
            middle = particles.to_window(middle, corner)[:, 0]
            body = likelihoods.disc(middle, self.config.body / self.config.cell, self.near)
            footprint -= jnp.where(features.valid, config.body, 0.0) * body
        maps = self._add_footprint(maps, corner, footprint)

        met = jnp.any(features.new) | (features.wall & (config.wall != "blob"))
        maps, wall_directions = lax.cond(
            met,
            lambda: self._add_contacts(maps, wall_directions, pose, features),
            lambda: (maps, wall_directions),
        )
        ends = self._in_cells(pose, features.point)
        beyond = jnp.any((ends < 0) | (ends > self.side - 1), axis=-1)
        return maps, wall_directions, jnp.any(beyond & features.touching[None])

    def _add_contacts(
        self, maps: Array, wall_directions: Array, pose: Array, features: ContactFeatures
    ) -> tuple[Array, Array]:
        """The maps and wall directions with contacts and a wall added."""
        config = self.config.footprint
        middle = self._in_cells(pose, jnp.zeros((1, 2), self.dtype))
        corner = particles.windows_around(middle[:, 0], self.side, self.far)
        ends = particles.to_window(self._in_cells(pose, features.point), corner)
        amount = config.blob * features.new.astype(self.dtype)
        footprint = likelihoods.gaussian_blobs(ends, amount, self.blob_sd, self.far)
        maps = self._add_footprint(maps, corner, footprint)
        if config.wall == "blob":
            return maps, wall_directions
        place = self._in_cells(pose, features.on_wall[None])
        corner = particles.windows_around(place[:, 0], self.side, self.long)
        place = particles.to_window(place, corner)[:, 0]
        direction = pose[:, 2] + features.direction
        if config.wall == "edge":
            shape = likelihoods.wall_sector(place, direction, self.along, config.sector, self.long)
        else:
            across = config.across / self.config.cell
            shape = likelihoods.wall_edge(place, direction, self.along, across, self.long)
        shape = jnp.where(features.wall, shape, 0.0)
        maps = self._add_footprint(maps, corner, config.edge * shape)
        for layer, part in ((COSINE, jnp.cos(2 * direction)), (SINE, jnp.sin(2 * direction))):
            field = particles.read_window(maps, corner, self.long, layer) + shape * part[:, None, None]
            maps = particles.write_window(maps, corner, layer, field)
        pointing = jnp.stack([jnp.cos(4 * direction), jnp.sin(4 * direction)], axis=1)
        return maps, wall_directions + jnp.where(features.wall, pointing, 0.0)

    def _add_footprint(self, maps: Array, corner: Array, footprint: Array) -> Array:
        """The maps with a footprint [N, size, size] added to the evidence in windows with these corners."""
        most = self.config.footprint.max_log_odds
        before = particles.read_window(maps, corner, footprint.shape[1], EVIDENCE)
        evidence = jnp.clip(before + footprint, -most, most)
        return particles.write_window(maps, corner, EVIDENCE, evidence)

    def _window(self, reach: float) -> int:
        """Side length, cells, of a window that reaches `reach` m in every direction, or that of the map.

        Raises:
            InputError: the windows of all particles and whiskers would have too many cells.
        """
        cells = self.config.particles * max(1, self.whiskers) * (2 * reach / self.config.cell + 3) ** 2
        if not cells <= MAX_WINDOW_CELLS:
            found = f"footprints that reach {reach:g} m, in cells of {self.config.cell:g} m"
            expected = f"{MAX_WINDOW_CELLS:.3g} cells around all whiskers of all particles"
            raise InputError("grid", found, expected, "smaller footprints, coarser cells or fewer particles")
        return min(2 * int(np.ceil(reach / self.config.cell)) + 2, self.side)

    def _in_cells(self, pose: Array, points: Array) -> Array:
        """[N, K, 2] points [K, 2] of base_link in cells of the map."""
        return particles.to_cells(particles.placed(pose, points), self.config.cell, self.side)


def build(settings: GridBackendConfig, feelers: PlanarWhiskers | None, dtype: Any) -> GridBackend:
    """The backend for a session with these whiskers.

    Raises:
        InputError: there are no whiskers, or the maps have more cells than int32 can index.
    """
    if feelers is None:
        found = "grid, for a recording without whiskers"
        raise InputError("backend", found, "recall, or a recording with whiskers")
    config = settings.grid
    side = config.side or LIVE_SIDE
    if config.particles * LAYERS * np.ceil(side / config.cell) ** 2 > MAX_CELLS:
        found = f"{config.particles} particles with maps of {side:g} m in cells of {config.cell:g} m"
        cure = "fewer particles, coarser cells or a smaller map"
        raise InputError("grid", found, "2^31 cells in all", cure)
    return GridBackend(config, feelers, side, dtype)
