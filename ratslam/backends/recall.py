"""RatSLAM backend with Bayesian recall and verified loop closures."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.attractor import pose_cells
from ratslam.attractor.config import rings, units
from ratslam.attractor.levels import window_levels
from ratslam.attractor.pose_cells import Outcome, PoseCells
from ratslam.backends.classic import finite
from ratslam.backends.config import RecallBackendConfig
from ratslam.classic import view_templates
from ratslam.core.types import Action, Estimate, Scalar
from ratslam.keyframes.ablation import FULL, Ablation
from ratslam.keyframes.appearance import Appearance, LabelAppearance, ViewAppearance, WhiskerAppearance
from ratslam.keyframes.map import KeyframeMap
from ratslam.recall import filter
from ratslam.recall import memory as recall_memory
from ratslam.recall.config import fan_width
from ratslam.recall.filter import RecallResult
from ratslam.recall.memory import MapFeedback, Memory
from ratslam.recall.observation_model import label_likelihood, touch_likelihood, view_likelihood
from ratslam.recall.whisker_likelihood import levels, pixels
from tactile.base.types import Array, Observation

HEALTH_RATE = 0.1
"""Share of the newest revisit in the running health."""


class RecallState(NamedTuple):
    """State of the kernel.

    Attributes:
        health: running share of revisits (frames where the map has older ones) whose view fits.
    """

    cells: PoseCells
    memory: Memory
    health: Array


class RecallEvidence(NamedTuple):
    """Evidence of one step.

    Attributes:
        frame to background: see `RecallResult`. energy: injected into the pose cells. packet: [3] decoded,
            cells. health: see `RecallState`. outcome: an `Outcome`, int32.
    """

    frame: Scalar
    match: Scalar
    shift: Scalar
    mass: Scalar
    gain: Scalar
    novel: Scalar
    entropy: Scalar
    second: Scalar
    agree: Scalar
    background: Array
    energy: Scalar
    packet: Array
    window_level: Scalar
    health: Scalar
    outcome: Scalar


class RecallBackend:
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
        self.pixels = pixels(view_shape) if self.recall.sector_fov == "whiskers" else None
        self.dtype = np.dtype(dtype)
        self.cell = config.pose_cells.cell_size
        self.window_levels = window_levels(config.pose_cells, self.dtype)
        self.rings = rings(config.pose_cells, self.dtype)
        self.units = units(config.pose_cells, self.dtype)

    def init(self, key: Array, capacity: int) -> RecallState:
        """One packet in the middle of the torus, and no keyframes. `key` is not used: nothing is random."""
        del key
        return RecallState(
            pose_cells.start(self.config.pose_cells, self.dtype),
            recall_memory.init_memory(self.recall, self.size, capacity, self.dtype, self._groups()),
            jnp.ones((), self.dtype),
        )

    def rows(self, state: RecallState) -> int:
        """Number of keyframes."""
        return int(state.memory.count)

    def grow(self, state: RecallState, capacity: int) -> RecallState:
        """The same memory in larger arrays."""

        def enlarge(old: Array, new: Array) -> Array:
            return old if old.shape == new.shape else new.at[tuple(slice(0, n) for n in old.shape)].set(old)

        empty = self.init(None, capacity).memory
        return state._replace(memory=jax.tree.map(enlarge, state.memory, empty))

    def apply_map_feedback(self, state: RecallState, feedback: MapFeedback) -> RecallState:
        """The filter takes over the poses, bias and scales of the map."""
        return state._replace(memory=recall_memory.apply_map_feedback(state.memory, feedback))

    def kernel(
        self, state: RecallState, observation: Observation
    ) -> tuple[RecallState, Estimate, RecallEvidence]:
        """Moves, recalls, injects activity by posterior, and stores the view."""
        odometry, view, seen, clean = finite(self.config.templates, self.dtype, observation)
        moved = jnp.stack([odometry.dx, odometry.dy, odometry.dtheta])
        memory = recall_memory.accumulate_motion(state.memory, moved)
        frame = seen & recall_memory.is_keyframe_due(self.recall, self.cell, memory)
        features = self._features(view, observation)

        memory, result = lax.cond(
            frame,
            lambda: self._look(memory, features, observation.label),
            lambda: (memory, filter.empty_result(memory)),
        )
        recalled, energy = self._injection(memory, result)
        cells, told = pose_cells.step(
            self.config.pose_cells, self.window_levels, state.cells, odometry, recalled, energy
        )
        memory = lax.cond(
            frame,
            lambda: recall_memory.store_keyframe(memory, features, observation.label, cells.pose),
            lambda: memory,
        )
        health = self._health(state.health, result.agree)
        room = memory.count < memory.label.shape[0]
        outcome = jnp.where(room | ~seen, told.outcome, Outcome.FULL)
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
            **result._asdict(),
            energy=energy,
            packet=cells.pose,
            window_level=told.level,
            health=health,
            outcome=outcome,
        )
        return RecallState(cells, memory, health), estimate, evidence

    def _health(self, health: Array, agree: Array) -> Array:
        """The running share of revisits whose view fits, after one more revisit."""
        updated = health + HEALTH_RATE * (agree.astype(self.dtype) - health)
        return jnp.where(agree >= 0, updated, health)

    def new_map(self) -> KeyframeMap:
        """An empty keyframe map."""
        guard, closures = self.recall.guard, self.config.experience.closures
        return KeyframeMap(
            self.config.keyframes,
            self.cell,
            self._appearance(),
            guard=guard,
            closures=closures,
            ablation=self.ablation,
        )

    def _appearance(self) -> Appearance:
        if self.labels:
            return LabelAppearance()
        if self.pixels is not None:
            return WhiskerAppearance(self.pixels, self.recall.temper, self._normalised)
        return ViewAppearance(self.size, fan_width(self.recall), self._normalised)

    def _groups(self) -> int:
        return 0 if self.pixels is None else int(self.pixels.group.max()) + 1

    def _normalised(self, view: np.ndarray) -> np.ndarray:
        shaped = np.asarray(view.reshape(self.view_shape), self.dtype)
        config = self.config.templates
        if not (config.normalise_mean or config.patch):  # nothing to do, and the call to JAX takes long
            return shaped
        return np.asarray(view_templates.normalise(config, jnp.asarray(shaped)))

    def _features(self, view: Array, observation: Observation) -> Array:
        """The stored and compared form of a view: its values, or the levels of its whisker pixels."""
        flat = view.reshape(-1)[: self.size]
        if self.pixels is None:
            return flat
        reports = jnp.ones(self.view_shape[:2], bool)
        if observation.alive.size == reports.size:
            reports = observation.alive.reshape(reports.shape)
        reports = jnp.repeat(reports[:, :, None], self.view_shape[2], axis=2).reshape(-1)
        return levels(flat, reports.astype(self.dtype)).astype(jnp.int32)

    def _look(self, memory: Memory, view: Array, label: Array) -> tuple[Memory, RecallResult]:
        if self.labels:
            weighing = label_likelihood(self.recall, memory, label)
        elif self.pixels is not None:
            memory, weighing = touch_likelihood(self.recall, memory, view, self.pixels)
        else:
            weighing = view_likelihood(self.recall, self.cell, memory, view)
        return filter.recognise(self.recall, self.cell, memory, weighing)

    def _injection(self, memory: Memory, result: RecallResult) -> tuple[Array, Array]:
        """The packet of a candidate turned by its sector shift, and energy proportional to its posterior."""
        known = (result.frame >= 0) & (result.mass > self.config.keyframes.candidate_posterior)
        turned = -result.shift.astype(self.dtype) * memory.angle / self.units[2]
        packet = memory.packet[jnp.maximum(result.match, 0)]
        packet = packet + jnp.stack([jnp.zeros_like(turned), jnp.zeros_like(turned), turned])
        energy = jnp.where(known, self.recall.energy * result.mass, 0.0)
        return packet % self.rings, energy
