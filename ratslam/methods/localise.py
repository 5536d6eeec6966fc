"""Localisation in a finished keyframe map: recall without new keyframes, and pose hypotheses that have to
explain the whole session."""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.core.backend import Backend, Map
from ratslam.core.estimates import Estimate, Scalar
from ratslam.core.session import finite_values
from ratslam.mapping.ground import SESSION_WEIGHTING
from ratslam.mapping.map import KeyframeMap
from ratslam.methods.config import LocaliseBackendConfig
from ratslam.methods.map_file import restore_map
from ratslam.methods.recall import RecallBackend
from ratslam.network.pose_cells import Belief
from ratslam.places.localiser import Localiser, Place
from ratslam.places.map_views import MapViews
from ratslam.recall.memory import Memory
from tactile.base.errors import InputError
from tactile.base.types import Array, Observation

LOG_ODDS = 7.5
"""Log-odds at which a pose is found, beyond the logarithm of the number of places, by default."""


class LocaliseOutcome(IntEnum):
    """Outcome of a step."""

    OK = 0
    """Odometry and view were used."""
    NOT_FINITE = 1
    """Odometry or view had values that are not finite, and was not used."""


class LocaliseEvidence(NamedTuple):
    """Evidence of one step.

    Attributes:
        keyframe: number of the view among those compared, -1 for none. match: the keyframe of the map that is
            recalled, -1 for none. shift_row: its sector shift, a row of `recall.config.sector_shifts`.
            posterior, log_ratio, novelty: see `RecallResult`. shows: whether the view can be compared.
            gain: [S, C] log-likelihood of the view at each keyframe less that at a new place. outcome: a
            `LocaliseOutcome`.
    """

    keyframe: Scalar
    match: Scalar
    shift_row: Scalar
    posterior: Scalar
    log_ratio: Scalar
    novelty: Scalar
    shows: Array
    gain: Array
    outcome: Scalar


class LocaliseState(NamedTuple):
    """State of the kernel: the keyframes of the map, the belief of the pose cells, and the number of views
    compared so far."""

    memory: Memory
    belief: Belief
    seen: Array


class LocaliseBackend(Backend):
    """Localisation in a finished keyframe map.

    Args:
        recall: the backend that made the map. map: the finished map. log_odds: see `LocaliseConfig`.
        here: whether the robot is assumed to stand where the map ended.
    """

    SINGLE = ("belief",)

    def __init__(self, recall: RecallBackend, map: KeyframeMap, log_odds: float, here: bool = False) -> None:
        self._recall, self._log_odds = recall, log_odds
        self._views = views = MapViews(recall, map.state)
        poses = map.solution().pose.rows  # those of trajectory.tum and map.json
        frames = map.state.taken.rows
        self._memory = views.freeze(frames, poses[frames])
        every = np.arange(len(poses))
        odds = views.odds(every, poses, SESSION_WEIGHTING, np.isin(every, frames))
        self._place = Place(map, frames, views.ground(poses[frames]), odds)
        self._start = map.map_trajectory()[-1] if here else None

    def init(self, key: Array, capacity: int) -> LocaliseState:
        """The map, and no idea where in it. `key` and `capacity` are not used."""
        del key, capacity
        memory = jax.tree.map(jnp.array, self._memory)
        return LocaliseState(memory, self._views.no_belief(memory), jnp.int32(0))

    def state_of(self, map: Map, capacity: int) -> LocaliseState:
        """The map, and no idea where in it, after the views compared so far."""
        assert isinstance(map, Localiser)
        return self.init(None, capacity)._replace(seen=jnp.int32(map.compared))

    def kernel(
        self, state: LocaliseState, observation: Observation
    ) -> tuple[LocaliseState, Estimate, LocaliseEvidence]:
        """Compares the view of a keyframe with the map."""
        recall = self._recall
        odometry, view, visible, clean = finite_values(recall.dtype, observation)
        seen, view = recall.prepare(observation, view, visible)
        moved = jnp.stack([odometry.dx, odometry.dy, odometry.dtheta])
        memory = state.memory.accumulate_motion(moved)
        due = memory.is_motion_due(self._views.config, recall.cell) | (state.seen == 0)
        is_keyframe = seen & due
        features = recall.features(view, observation)

        memory, belief, (result, gain, shows) = lax.cond(
            is_keyframe,
            lambda: self._views.look(memory, state.belief, features, observation.label),
            lambda: (memory, state.belief, self._views.no_look(memory)),
        )
        shifts = jnp.asarray(self._views.shifts)
        zero = jnp.zeros(3, recall.dtype)
        estimate = Estimate.without_place(zero, zero, jnp.bool_(True))
        evidence = LocaliseEvidence(
            keyframe=jnp.where(is_keyframe, state.seen, -1),
            match=result.match,
            shift_row=jnp.argmax(shifts == result.shift).astype(jnp.int32),
            posterior=result.posterior,
            log_ratio=result.log_ratio,
            novelty=result.novelty,
            shows=shows,
            gain=gain,
            outcome=jnp.where(clean, LocaliseOutcome.OK, LocaliseOutcome.NOT_FINITE).astype(jnp.int32),
        )
        return LocaliseState(memory, belief, state.seen + is_keyframe.astype(jnp.int32)), estimate, evidence

    def new_map(self) -> Localiser:
        """A session of which nothing is known but perhaps its start."""
        return Localiser(self._place, self._log_odds, self._start)


def build(config: LocaliseBackendConfig, view_shape: tuple[int, int, int], dtype: Any) -> LocaliseBackend:
    """The backend of a configuration.

    Raises:
        InputError: the map cannot be read, or was not made with these settings.
    """
    settings, recall = config.localise, RecallBackend(config, view_shape, dtype)
    map = restore_map(settings, recall.new_map(), "recall")
    if not map.state.count:
        expected = "a map in which a session can be found"
        raise InputError(str(settings.map), "a map without keyframes", expected)
    return LocaliseBackend(recall, map, settings.log_odds or LOG_ODDS, settings.start == "here")
