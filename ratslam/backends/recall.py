"""RatSLAM backend with Bayesian recall and verified loop closures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.backends.config import RecallBackendConfig
from ratslam.backends.piece_ties import PieceTies
from ratslam.classic import pose_cells, view_templates
from ratslam.classic.levels import activity_sums, window_levels
from ratslam.classic.pose_cell_config import network_of, rings, units
from ratslam.classic.pose_cells import Outcome, PoseCells
from ratslam.core.backend import Backend, enlarge
from ratslam.core.finite_values import finite_values
from ratslam.core.types import Action, Estimate, PoseCellActivity, Scalar
from ratslam.keyframes.acceptance import Acceptance, AcceptByEvidence
from ratslam.keyframes.appearance import Appearance, LabelAppearance, ViewAppearance, WhiskerAppearance
from ratslam.keyframes.closure_odds import AcceptByOdds
from ratslam.keyframes.config import FULL, Ablation
from ratslam.keyframes.keyframe_graph import KeyframeGraph
from ratslam.keyframes.map import KeyframeMap
from ratslam.keyframes.signed_appearance import SignedAppearance
from ratslam.recall import filter, mirror
from ratslam.recall import memory as recall_memory
from ratslam.recall.config import RecallConfig, fan_width, sector_shifts
from ratslam.recall.filter import RecallResult
from ratslam.recall.memory import CroppedRows, MapFeedback, Memory, MergedRows, Modes, crop_rows
from ratslam.recall.observation_model import (
    ObservationLikelihood,
    label_likelihood,
    signed_likelihood,
    touch_likelihood,
    view_likelihood,
)
from ratslam.recall.signed_likelihood import stored_image
from ratslam.recall.whisker_likelihood import live_pixels, pixel_layout, pixel_levels
from tactile.base.types import Array, Observation

HEALTH_RATE = 0.1
"""Share of the newest revisit in the running health."""


class RecallState(NamedTuple):
    """State of the kernel.

    Attributes:
        health: running share of revisits (keyframes near older ones on the map) whose view fits.
    """

    cells: PoseCells
    memory: Memory
    health: Array


class RecallEvidence(NamedTuple):
    """Evidence of one step.

    Attributes:
        keyframe to background: see `RecallResult`. mirror_match to mirror_log_ratio: the same of the control
            (`ratslam.recall.mirror`); with whiskers those of no match. energy: injected into the pose cells.
            packet: [3] decoded, cells. health: see `RecallState`. outcome: an `Outcome`, int32.
    """

    keyframe: Scalar
    match: Scalar
    shift: Scalar
    posterior: Scalar
    log_ratio: Scalar
    novelty: Scalar
    entropy: Scalar
    second_mode: Scalar
    view_fits: Scalar
    background: Array
    mirror_match: Scalar
    mirror_shift: Scalar
    mirror_posterior: Scalar
    mirror_log_ratio: Scalar
    energy: Scalar
    packet: Array
    window_level: Scalar
    health: Scalar
    outcome: Scalar


class RecallBackend(Backend):
    """Bayesian recall with verified loop closures, for views of one shape.

    Args:
        view_shape: (R, C, K) of the observations' views. dtype: of all floating state.
    """

    def __init__(
        self,
        config: RecallBackendConfig,
        view_shape: tuple[int, int, int],
        dtype: Any = np.float64,
        ablation: Ablation = FULL,
    ) -> None:
        labels = config.templates.source == "labels"
        self.config, self.ablation = config, ablation
        self.recall = config.recall.model_copy(update={"sector_fov": "none"}) if labels else config.recall
        if self.recall.sector_fov == "whiskers" and view_shape[1] % 2:  # no whisker is opposite another
            self.recall = self.recall.model_copy(update={"shifts": 0})
        self.labels, self.view_shape = labels, view_shape
        self.size = 0 if labels else int(np.prod(view_shape))
        self.pixels = pixel_layout(view_shape) if self.recall.sector_fov == "whiskers" else None
        self.signed = self.pixels is not None and self.recall.images == "signed"
        self.dtype = np.dtype(dtype)
        self.cell = config.pose_cells.cell_size
        self.network = network_of(config.pose_cells, config.attractor)
        self.window_levels = window_levels(self.network, self.dtype)
        self.rings = rings(config.pose_cells, self.dtype)
        self.units = units(config.pose_cells, self.dtype)

    def init(self, key: Array, capacity: int) -> RecallState:
        """One packet in the middle of the torus, and no keyframes. `key` is not used: nothing is random."""
        del key
        return RecallState(
            pose_cells.start(self.network, self.dtype),
            recall_memory.init_memory(self.recall, self.size, capacity, self.dtype, self.groups),
            jnp.ones((), self.dtype),
        )

    def rows(self, state: RecallState) -> int:
        """Number of keyframes."""
        return int(state.memory.count)

    def grow(self, state: RecallState, capacity: int) -> RecallState:
        """The same memory in larger arrays."""
        return state._replace(memory=enlarge(state.memory, self.init(None, capacity).memory))

    def apply_map_feedback(self, state: RecallState, feedback: MapFeedback) -> RecallState:
        """The filter takes over the poses, bias and scales of the map."""
        return state._replace(memory=recall_memory.apply_map_feedback(state.memory, feedback))

    def merge_rows(self, state: RecallState, merged: MergedRows) -> RecallState:
        """The memory of the keyframes that remain."""
        return state._replace(memory=recall_memory.merge_rows(state.memory, merged))

    def begin_piece(self, state: RecallState) -> RecallState:
        """The filter knows no place; its health is that of the start."""
        return state._replace(memory=recall_memory.begin_piece(state.memory), health=jnp.ones((), self.dtype))

    def crop_rows(self, state: RecallState, cropped: CroppedRows) -> RecallState:
        """The memory of a cropped map."""
        return state._replace(memory=crop_rows(state.memory, cropped))

    def kernel(
        self, state: RecallState, observation: Observation
    ) -> tuple[RecallState, Estimate, RecallEvidence]:
        """Recalls the view, injects activity by its posterior, moves the packet and stores the view."""
        odometry, view, visible, clean = finite_values(self.dtype, observation)
        seen, view = self.prepare(observation, view, visible)
        moved = jnp.stack([odometry.dx, odometry.dy, odometry.dtheta])
        memory = recall_memory.accumulate_motion(state.memory, moved)
        is_keyframe = seen & recall_memory.is_keyframe_due(self.recall, self.cell, memory)
        features = self.features(view, observation)

        memory, result, control = lax.cond(
            is_keyframe,
            lambda: self._recall(memory, features, observation.label),
            lambda: (memory, filter.empty_result(memory), _candidate(filter.empty_result(memory))),
        )
        recalled, energy = self._injection(memory, result)
        cells, info = pose_cells.step(
            self.network, self.window_levels, state.cells, odometry, recalled, energy
        )
        memory = lax.cond(
            is_keyframe,
            lambda: recall_memory.store_keyframe(memory, features, observation.label, cells.pose),
            lambda: memory,
        )
        health = self._health(state.health, result.view_fits)
        has_room = memory.count < memory.label.shape[0]
        outcome = jnp.where(has_room | ~seen, info.outcome, Outcome.FULL)
        outcome = jnp.where(clean, outcome, Outcome.NOT_FINITE).astype(jnp.int32)
        sd, sd_heading = recall_memory.pose_spread(self.recall, self.cell, memory)
        place = jnp.int32(-1)  # the map assigns places, because only it verifies closures
        estimate = Estimate(
            pose=recall_memory.current_pose(memory),
            spread=jnp.stack([sd, sd, sd_heading]),
            place=place,
            previous=place,
            action=jnp.int32(Action.NONE),
            lost=(health < self.config.min_fit_share) | (outcome == Outcome.TOO_FAST),
        )
        evidence = RecallEvidence(
            **result._asdict(), **control._asdict(), energy=energy, packet=cells.pose,
            window_level=info.level, health=health, outcome=outcome,
        )  # fmt: skip
        return RecallState(cells, memory, health), estimate, evidence

    def _health(self, health: Array, view_fits: Array) -> Array:
        """The running share of revisits whose view fits, after one more revisit."""
        updated = health + HEALTH_RATE * (view_fits.astype(self.dtype) - health)
        return jnp.where(view_fits >= 0, updated, health)

    def activity(self, state: RecallState) -> PoseCellActivity:
        return activity_sums(self.window_levels, state.cells.activity)

    def new_map(self) -> KeyframeMap:
        """An empty keyframe map; keyframes of views and given ids are not merged, because their sequences are
        judged by keyframe."""
        keyframes = self.config.keyframes
        if self.pixels is None:
            keyframes = keyframes.model_copy(update={"merge_stood": 0})
        return KeyframeMap(
            keyframes, self.cell, self._appearance(), self._acceptance(), guard=self.recall.guard,
            closures=self.config.experience.closures, ablation=self.ablation, find_tie=PieceTies(self),
        )  # fmt: skip

    def _acceptance(self) -> Callable[[KeyframeGraph], Acceptance]:
        """By odds for views and given ids; with whiskers, sequences are selected against each other."""
        by_evidence = self.pixels is not None or not self.ablation.verify
        return (lambda graph: AcceptByEvidence()) if by_evidence else AcceptByOdds

    def _appearance(self) -> Appearance:
        if self.labels:
            return LabelAppearance()
        if self.signed:
            return SignedAppearance(self.size)
        if self.pixels is not None:
            half_turns = len(sector_shifts(self.recall)) > 1
            return WhiskerAppearance(self.pixels, self.recall.temper, self._normalise, half_turns)
        return ViewAppearance(self.size, fan_width(self.recall), self._normalise)

    def _normalise(self, view: np.ndarray) -> np.ndarray:
        shaped = np.asarray(view.reshape(self.view_shape), self.dtype)
        config = self.config.templates
        if not (config.normalise_mean or config.patch):  # saves the slow call to JAX
            return shaped
        return np.asarray(view_templates.normalise(config, jnp.asarray(shaped)))

    def prepare(self, observation: Observation, view: Array, visible: Array) -> tuple[Array, Array]:
        """Whether a view can be compared, and the view normalised.

        Args:
            view, visible: see `finite_values`.
        """
        normalised = view_templates.normalise(self.config.templates, view)
        return view_templates.is_seen(self.config.templates, observation, visible), normalised

    @property
    def groups(self) -> int:
        """Number of groups of whisker pixels, 0 without whiskers."""
        return 0 if self.pixels is None else int(self.pixels.group.max()) + 1

    def features(self, view: Array, observation: Observation) -> Array:
        """The stored and compared form of a view: its values, the levels of its whisker pixels, or
        their signed roots."""
        flat = view.reshape(-1)[: self.size]
        if self.pixels is None:
            return flat
        alive = live_pixels(observation).reshape(-1)
        if self.signed:
            return stored_image(flat, alive)
        return pixel_levels(flat, alive.astype(self.dtype)).astype(jnp.int32)

    def _recall(
        self, memory: Memory, view: Array, label: Array
    ) -> tuple[Memory, RecallResult, mirror.Candidate]:
        """Recognises the view, and its mirror image where the rule of acceptance reads the control."""
        if self.pixels is not None:
            memory, likelihood = self.likelihood(self.recall, memory, view, label)
            memory, result = filter.recognise(self.recall, self.cell, memory, likelihood, self.recall.local)
            return memory, result, _candidate(filter.empty_result(memory))
        first = mirror.first_look(memory, view, label, self.recall.local)

        def look(_: None, one: mirror.Look) -> tuple[None, tuple[Modes, RecallResult]]:
            seen = memory._replace(**one.modes._asdict(), motion=one.motion, bias=one.bias)
            seen, likelihood = self.likelihood(self.recall, seen, one.view, one.label)
            after, result = filter.recognise(self.recall, self.cell, seen, likelihood, one.local)
            return None, (mirror.modes_of(after), result)

        both = mirror.both_looks(memory, first, self._mirrored(view, memory.angle))
        _, (modes, results) = lax.scan(look, None, both)
        own, control = (jax.tree.map(lambda x, k=k: x[k], modes) for k in (0, 1))
        result, false = (jax.tree.map(lambda x, k=k: x[k], results) for k in (0, 1))
        return memory._replace(**own._asdict(), control=control), result, _candidate(false)

    def likelihood(
        self, config: RecallConfig, memory: Memory, view: Array, label: Array
    ) -> tuple[Memory, ObservationLikelihood]:
        """Likelihood of a view's features, or of an id, at every keyframe of a memory; and the memory with
        what the next view needs."""
        if self.labels:
            return memory, label_likelihood(config, memory, label)
        if self.signed:
            return signed_likelihood(config, memory, view)
        if self.pixels is not None:
            return touch_likelihood(config, memory, view, self.pixels)
        return memory, view_likelihood(config, self.cell, memory, view)

    def _mirrored(self, view: Array, angle: Array) -> Array:
        return mirror.mirror_view(view, self.view_shape, angle) if len(view) else view

    def _injection(self, memory: Memory, result: RecallResult) -> tuple[Array, Array]:
        """The packet of a candidate turned by its sector shift, and energy proportional to its posterior."""
        known = (result.keyframe >= 0) & (result.posterior > self.config.keyframes.candidate_posterior)
        turned = -result.shift.astype(self.dtype) * memory.angle / self.units[2]
        packet = memory.packet[jnp.maximum(result.match, 0)]
        packet = packet + jnp.stack([jnp.zeros_like(turned), jnp.zeros_like(turned), turned])
        energy = jnp.where(known, self.recall.energy * result.posterior, 0.0)
        return packet % self.rings, energy


def _candidate(result: RecallResult) -> mirror.Candidate:
    return mirror.Candidate(result.match, result.shift, result.posterior, result.log_ratio)
