"""Views compared with the keyframes of a finished map, and ties between the pieces of a growing one.

`MapViews` compares the views of a session, or of the map itself, with keyframes that do not change.
`PieceTies` places the newest piece of a map on an older one like a session on a map: a sequence of closures
between pieces strains no odometry, so a false one would be accepted as easily as a true one, and a placement
of the whole piece has to explain all its views.
"""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.core.session import capacity_at
from ratslam.mapping.acceptance import Tie
from ratslam.mapping.ground import PIECE_WEIGHTING, GainOdds, GainWeighting, Ground, LearnedOdds, Motion
from ratslam.mapping.loop_closures import Candidate
from ratslam.mapping.map_state import MapState
from ratslam.network.pose_cells import Belief, Network
from ratslam.places.localiser import compare_with_itself
from ratslam.places.placement import Comparison, Traverse, closures_along, find_placements
from ratslam.recall import filter
from ratslam.recall.config import RecallConfig, sector_shifts
from ratslam.recall.memory import MapFeedback, Memory, init_memory
from ratslam.recall.observation_model import ObservationLikelihood
from tactile.base.types import Array

TOGETHER = 64
"""Number of views compared in one compiled call."""


Look = tuple[filter.RecallResult, Array, Array]
"""One view compared with a memory: the result of recall; gain [S, C], log-likelihood at each sector shift and
keyframe less that at a new place; bool, whether the view can be compared."""


class ViewMatcher(Protocol):
    """What of the recall backend compares views; see `ratslam.methods.recall.RecallBackend`."""

    recall: RecallConfig
    network: Network
    dtype: np.dtype
    cell: float

    @property
    def groups(self) -> int:
        """Number of groups of whisker pixels."""

    def likelihood(
        self, config: RecallConfig, memory: Memory, view: Array, label: Array
    ) -> tuple[Memory, ObservationLikelihood]:
        """Likelihood of a view at every keyframe of a memory."""

    def no_belief(self, capacity: int) -> Belief:
        """All is novelty, with view cells for so many keyframes."""


class MapViews:
    """The views of a finished map, compared with each other or with those of a session.

    Args:
        recall: the backend that made the map. state: its keyframes.
    """

    def __init__(self, recall: ViewMatcher, state: MapState) -> None:
        self.recall, self.state = recall, state
        # No keyframe of a finished map is too new to be recalled.
        self.config = recall.recall.model_copy(update={"guard": 0})
        self.shifts = sector_shifts(self.config)
        self._compare = jax.jit(self._look_at_many)
        self._gains = jax.jit(self._gains_of_many)

    def freeze(self, frames: np.ndarray, poses: np.ndarray, capacity: int = 0) -> Memory:
        """The memory of keyframes `frames` [N], of all ever taken, at `poses` [N, 3].

        Args:
            capacity: rows; 0: as many as it takes.
        """
        recall, state = self.recall, self.state
        feedback = MapFeedback(poses, state.bias, state.turn_error, 0.0, *state.appearance.metric())
        views, labels = state.appearance.stored(frames)
        capacity = capacity or capacity_at(len(labels))
        empty = init_memory(self.config, views.shape[1], capacity, recall.dtype, recall.groups)
        return empty.filled(feedback, views, labels)

    def ground(self, poses: np.ndarray) -> Ground:
        """Keyframes at `poses` [N, 3] as ground."""
        angle, variance = self.state.sector_angle, self.state.closure_variance()
        share = self.state.appearance.NEAR_SHARE
        return Ground.of(poses, self.shifts, self.recall.cell, angle, variance, share)

    def odds(
        self, frames: np.ndarray, poses: np.ndarray, weighing: GainWeighting, held: np.ndarray | None = None
    ) -> GainOdds:
        """The log-odds of gains, by comparing keyframes `frames` [N], of all ever taken and in order of time,
        with each other.

        Args:
            weighing: of the gains. held: [N] bool, those that a session is compared with, the others being
                merged with them; None: all.
        """
        held = np.ones(len(frames), bool) if held is None else held
        whole, guard = self.freeze(frames[held], poses[held]), self.recall.recall.guard
        views, labels = self.state.appearance.stored(frames)

        def gains(begin: int, count: int) -> np.ndarray:
            earlier = whole.first_keyframes(int(held[: begin - guard].sum()))
            view = jnp.asarray(views[begin : begin + count].T.astype(whole.view.dtype))
            label = jnp.asarray(labels[begin : begin + count].astype(np.int32))
            return np.asarray(self._gains(earlier, view, label))

        weighing = weighing._replace(prior=self.state.appearance.gain_prior(weighing.prior))
        return compare_with_itself(self.ground(poses), guard, gains, weighing, held)

    def compare(self, memory: Memory, frames: np.ndarray, motion: np.ndarray) -> Comparison:
        """Compares the views of keyframes `frames` [n], of all ever taken and in order of time.

        Args:
            motion: [n, 3] into each of them, without systematic errors, m, m, rad.
        """
        views, labels = self.state.appearance.stored(frames)
        count, parts = int(memory.count), []
        dtype, memory = memory.view.dtype, memory._replace(bias=jnp.zeros_like(memory.bias))
        memory = memory._replace(turn_error=jnp.zeros_like(memory.turn_error))
        belief = self.no_belief(memory)
        for begin in range(0, len(frames), TOGETHER):
            rows = slice(begin, begin + TOGETHER)
            size = len(labels[rows])
            filled = [
                jnp.asarray(np.pad(values, [(0, TOGETHER - size)] + [(0, 0)] * (values.ndim - 1)))
                for values in (
                    views[rows].astype(dtype), labels[rows].astype(np.int32),
                    motion[rows].astype(memory.x.dtype), np.ones(size, bool),
                )
            ]  # fmt: skip
            (memory, belief), looks = self._compare(memory, belief, *filled)
            parts.append(jax.tree.map(lambda values, size=size: np.asarray(values)[:size], looks))
        results, gains, shows = zip(*parts, strict=True)
        shift = np.concatenate([result.shift for result in results])
        return Comparison(
            gain=np.concatenate([gain[:, :, :count] for gain in gains]),
            shows=np.concatenate(shows),
            match=np.concatenate([result.match for result in results]),
            shift=np.argmax(self.shifts == shift[:, None], axis=1),
            posterior=np.concatenate([result.posterior for result in results]),
        )

    def no_belief(self, memory: Memory) -> Belief:
        """The pose cells of a robot that may be anywhere among the keyframes of a memory."""
        return self.recall.no_belief(memory.label.shape[0])

    def look(self, memory: Memory, belief: Belief, view: Array, label: Array) -> tuple[Memory, Belief, Look]:
        """Recalls one view in its stored form, and compares it with all keyframes."""
        memory, likelihood = self.recall.likelihood(self.config, memory, view, label)
        motion, network = memory.corrected_motion(), self.recall.network
        belief, result = filter.recognise(self.config, network, memory, belief, motion, likelihood, 0.0)
        zero = jnp.zeros_like(memory.length)
        memory = memory._replace(motion=jnp.zeros_like(memory.motion), length=zero, turn=zero)
        shows = likelihood.certain & likelihood.informative
        return memory, belief, (result, self._gain(memory, likelihood), shows)

    def no_look(self, memory: Memory) -> Look:
        """The result of a step without a comparison."""
        gain = jnp.zeros((len(self.shifts), memory.label.shape[0]), jnp.float32)
        return filter.empty_result(memory), gain, jnp.bool_(False)

    def _gain(self, memory: Memory, likelihood: ObservationLikelihood) -> Array:
        tiny = jnp.finfo(likelihood.novelty.dtype).tiny
        here, new = (jnp.maximum(values, tiny) for values in (likelihood.likelihood, likelihood.novelty))
        gain = (jnp.log(here) - jnp.log(new)).astype(jnp.float32)
        return jnp.broadcast_to(gain, (len(self.shifts), memory.label.shape[0]))

    def _look_at_many(
        self, memory: Memory, belief: Belief, views: Array, labels: Array, motions: Array, real: Array
    ) -> tuple[tuple[Memory, Belief], Look]:
        """Looks at views [n, D] in turn; those that are not `real` [n] are left out."""

        def look(state: tuple[Memory, Belief], one: tuple[Array, ...]) -> tuple[tuple[Memory, Belief], Look]:
            (memory, belief), (view, label, motion, real) = state, one
            length = jnp.hypot(motion[0], motion[1])
            moved = memory._replace(motion=motion, length=length, turn=jnp.abs(motion[2]))
            memory, belief, found = lax.cond(
                real,
                lambda: self.look(moved, belief, view, label),
                lambda: (memory, belief, self.no_look(memory)),
            )
            return (memory, belief), found

        return lax.scan(look, (memory, belief), (views, labels, motions, real))

    def _gains_of_many(self, memory: Memory, views: Array, labels: Array) -> Array:
        """[n, S, C] gains of stored views [D, n]; NaN of those that cannot be compared."""

        def look(memory: Memory, one: tuple[Array, Array]) -> tuple[Memory, Array]:
            memory, likelihood = self.recall.likelihood(self.config, memory, *one)
            shows = likelihood.certain & likelihood.informative
            return memory, jnp.where(shows, self._gain(memory, likelihood), jnp.nan)

        return lax.scan(look, memory, (views.T, labels))[1]


FEWEST = 10
"""Least number of keyframes of a piece that is placed on another or has another placed on it."""


class PieceTies:
    """Finds where the newest piece of a map lies on an older one. What it keeps between two calls are only
    compiled functions.

    Args:
        recall: the backend that makes the map.
    """

    def __init__(self, recall: ViewMatcher) -> None:
        self._recall = recall
        self._views: MapViews | None = None

    def __call__(self, state: MapState, odds: LearnedOdds) -> Tie | None:
        """The best placement of the keyframes since the newest beginning on one of the pieces before."""
        begin = int(np.flatnonzero(state.begins.rows)[-1])
        own, piece = np.arange(begin, state.count), state.pieces()[:begin]
        if len(own) < FEWEST:
            return None
        if self._views is None or self._views.state is not state:
            self._views = MapViews(self._recall, state)
        found: list[Tie] = []
        for number in np.unique(piece).tolist():
            frames = np.flatnonzero(piece == number)
            if len(frames) >= FEWEST:
                found += _place_on(self._views, odds, own, frames)
        if not found:
            return None
        (log_odds, closures), *others = sorted(found, key=lambda tie: -tie[0])
        ahead = log_odds - (others[0][0] if others else -np.inf)
        return (log_odds if ahead >= state.config.tie_log_odds / 2 else ahead), closures


def _place_on(views: MapViews, odds: LearnedOdds, own: np.ndarray, frames: np.ndarray) -> list[Tie]:
    """All placements of the keyframes `own` [n] of the newest piece on those of an older one, `frames`
    [N]."""
    state = views.state
    taken, poses = state.taken.rows[frames], state.pose.rows[frames]

    def learn() -> GainOdds:
        every = state.merged_into(frames)
        held = np.isin(every, taken)
        return views.odds(every, state.unmerged_poses()[every], PIECE_WEIGHTING, held)

    ground, memory = views.ground(poses), views.freeze(taken, poses)
    learned = odds.of((len(frames), int(taken[0]), int(taken[-1])), learn)
    # Odometry into each keyframe of the piece without its systematic errors.
    motion = state.correct(state.motion.rows[own], state.length.rows[own])
    variance = state.odometry_variance(state.length.rows[own], state.turn.rows[own])
    variance[:, 2] *= state.heading_noise.further_factor
    motions = [Motion(*one) for one in zip(motion, variance, strict=True)]
    compared = views.compare(memory, state.taken.rows[own], np.array([m.motion for m in motions]))
    places = float(np.log(max(ground.places(), 1.0)))
    session = Traverse(compared._replace(gain=PIECE_WEIGHTING.weigh(compared.gain)), motions)
    return [
        (
            float(path.independent_odds(ground).sum()) - places,
            [
                Candidate(int(own[k]), int(frames[at.frame]), int(views.shifts[at.shift]), 1.0, at.gain)
                for k, at in closures_along(ground, compared, path)
            ],
        )
        for path in find_placements(ground, learned, session)
    ]
