"""Localisation in a finished grid map: pose hypotheses anywhere in it, weighed by what whiskers meet."""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.core.backend import Backend
from ratslam.core.estimates import Estimate, Scalar
from ratslam.grid.contact_features import contact_features
from ratslam.grid.expectation import Expectation, draw_surfaces
from ratslam.grid.localiser import GridLocaliser, Hypotheses, Search
from ratslam.grid.map import GridMap
from ratslam.methods import grid
from ratslam.methods.config import GridLocaliseBackendConfig
from ratslam.methods.map_file import restore_map
from tactile.base.errors import InputError
from tactile.base.types import Array, MotionKind, Observation
from tactile.whisker_geometry import PlanarWhiskers

DRIVEN = -2.0
"""Log-odds of a surface below which a cell is known to be free, and the robot may stand there."""

LOG_ODDS = 15.0
"""Log-odds at which a pose is found, beyond the logarithm of the number of places, by default."""

ALIKE = 6.0
"""Log-odds that are needed beyond those settings and places ask for: reports of one place are counted as
independent, so a place that is alike within the errors of the map gains as long as it is driven."""


class GridLocaliseOutcome(IntEnum):
    """Outcome of a step."""

    OK = 0
    RESAMPLED = 1
    """The pose hypotheses were resampled."""
    BEGUN_ANEW = 2
    """No pose hypothesis explains the session; the search begins anew, anywhere in the map."""
    VANISHED = 3
    """No pose hypothesis explains the report; the weights are left unchanged."""
    NOT_FINITE = 4
    """Odometry or contacts were NaN, infinite or impossibly large; treated as no motion and no contact."""


class GridLocaliseEvidence(NamedTuple):
    """Evidence of one step.

    Attributes:
        pose: [3] the most likely pose, m, m, rad. covariance: [3, 3] of it. share: of the pose hypotheses
            that are the same. log_odds: of the session being there, against the most alike place elsewhere,
            since the search began. fall: by how much they are below their best. effective_particles: their
            effective number. failed: bool, the search failed and begins anew. outcome: see
            `GridLocaliseOutcome`.
    """

    pose: Array
    covariance: Array
    share: Scalar
    log_odds: Scalar
    fall: Scalar
    effective_particles: Scalar
    failed: Array
    outcome: Scalar


class GridLocaliseState(NamedTuple):
    """State of the search.

    Attributes:
        known: the pose hypotheses. motion: the last report's `Motion`. touched: [W] its contacts. key: data
            of the random stream's key.
    """

    known: Hypotheses
    motion: Array
    touched: Array
    key: Array


class GridLocaliseBackend(Backend):
    """Localisation in a finished grid map.

    Args:
        made: the finished map, which has contacts. log_odds: see `LocaliseConfig`. count: pose hypotheses.
        here: whether the robot is assumed to stand where the map ended.
    """

    def __init__(
        self, made: GridMap, log_odds: float, count: int, dtype: Any = np.float64, here: bool = False
    ) -> None:
        self._hopeless, self.dtype = log_odds, np.dtype(dtype)
        path, config = made.trajectory(), made.config
        surfaces = draw_surfaces(config, made.feelers, made.side, path, made.contacts())
        free = surfaces.centres()[surfaces.evidence < DRIVEN]
        if not len(free):
            found = "a map without driven ground"
            raise InputError("localise.map", found, "one in which a session can be found")
        expected = Expectation(surfaces, made.feelers, config.body)
        self._search = Search(config, expected, free, count, self.dtype)
        self._needed = log_odds + float(np.log(self._search.places())) + ALIKE
        self._drawn, self._path = made.grid(), path.copy()
        self._start = path[-1] if here else None
        self._whiskers = len(made.feelers.length)

    def init(self, key: Array, capacity: int) -> GridLocaliseState:
        """Pose hypotheses all over the map, or where it ended. Nothing grows: `capacity` is not used."""
        del capacity
        first, key = jax.random.split(key)
        if self._start is None:
            known = self._search.begin(first)
        else:
            known = self._search.begin_at(first, self._start, self._needed)
        none = jnp.zeros(self._whiskers, bool)
        return GridLocaliseState(known, jnp.int32(MotionKind.OTHER), none, jax.random.key_data(key))

    def kernel(
        self, state: GridLocaliseState, observation: Observation
    ) -> tuple[GridLocaliseState, Estimate, GridLocaliseEvidence]:
        """Moves and weighs the pose hypotheses; begins anew if none explains the session."""
        key, draw, again, anew = jax.random.split(jax.random.wrap_key_data(state.key), 4)
        odometry, features, clean = contact_features(observation, state.touched, self.dtype)
        motion = jnp.asarray(observation.motion, jnp.int32)
        pressed = jnp.any(state.touched)
        known = self._search.move(state.known, odometry, motion != state.motion, draw, pressed)
        known, vanished = self._search.weigh(known, features, state.touched)
        pose, covariance, share, odds, fall = self._search.best_cluster(known)
        known, worth, drawn = self._search.resample(known, again)
        failed = (odds < -self._hopeless / 2) | (fall > self._hopeless)
        known = lax.cond(failed, lambda: self._search.begin(anew), lambda: known)

        outcome = jnp.where(drawn, GridLocaliseOutcome.RESAMPLED, GridLocaliseOutcome.OK)
        outcome = jnp.where(vanished, GridLocaliseOutcome.VANISHED, outcome)
        outcome = jnp.where(failed, GridLocaliseOutcome.BEGUN_ANEW, outcome)
        outcome = jnp.where(clean, outcome, GridLocaliseOutcome.NOT_FINITE).astype(jnp.int32)
        estimate = Estimate.without_place(pose, jnp.sqrt(jnp.diag(covariance)), jnp.bool_(True))
        evidence = GridLocaliseEvidence(pose, covariance, share, odds, fall, worth, failed, outcome)
        touched = jnp.where(features.valid, features.touching, False)
        after = GridLocaliseState(known, motion, touched, jax.random.key_data(key))
        return after, estimate, evidence

    def new_map(self) -> GridLocaliser:
        """A session of which nothing is known but perhaps its start."""
        return GridLocaliser(self._drawn, self._path, self._needed, self._start is not None)


def build(
    config: GridLocaliseBackendConfig, feelers: PlanarWhiskers | None, dtype: Any = np.float64
) -> GridLocaliseBackend:
    """The backend of a configuration.

    Raises:
        InputError: the map cannot be read, or was not made with these settings and whiskers.
    """
    settings, method = config.localise, grid.build(config, feelers, dtype)
    made = restore_map(settings, method.new_map(), "grid")
    here = settings.start == "here"
    return GridLocaliseBackend(made, settings.log_odds or LOG_ODDS, settings.particles, dtype, here)
