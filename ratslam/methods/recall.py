"""The default method: RatSLAM whose pose cells hold the belief, with verified loop closures.

The loop is that of RatSLAM (Milford & Wyeth 2004; Milford, Wiles & Wyeth 2010): odometry moves the activity
of the pose cells, views anchor it, and places that are seen again become links of the map. Here the activity
is a posterior (`ratslam.network.pose_cells`), every keyframe is a view cell (`ratslam.recall`), and a
candidate for a loop closure is accepted only by the map (`ratslam.mapping`), which weighs sequences of them
against its odometry. The kernel never reads the map; the map's poses come back to the view cells as
`MapFeedback`.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.classic import view_templates
from ratslam.core.backend import Backend, Map, PoseCellProbe, enlarge
from ratslam.core.estimates import Estimate, PoseCellActivity, Scalar
from ratslam.core.session import finite_values
from ratslam.mapping.acceptance import Acceptance, AcceptByEvidence, AcceptByOdds
from ratslam.mapping.appearance import (
    Appearance,
    LabelAppearance,
    SignedAppearance,
    ViewAppearance,
    WhiskerAppearance,
)
from ratslam.mapping.config import FULL, Ablation
from ratslam.mapping.map import KeyframeMap
from ratslam.mapping.map_state import MapState
from ratslam.mapping.pieces import piece_start
from ratslam.methods.config import RecallBackendConfig
from ratslam.network import grid_cells, pose_cells
from ratslam.network.config import Network, SheetConfig
from ratslam.network.pose_cells import Belief
from ratslam.places.map_views import MapViews, PieceTies
from ratslam.recall import filter, observation_model
from ratslam.recall.config import RecallConfig, sector_shifts
from ratslam.recall.filter import RecallResult
from ratslam.recall.memory import CroppedRows, MapFeedback, Memory, MergedRows, init_memory
from ratslam.recall.signed_likelihood import stored_image
from ratslam.recall.whisker_likelihood import live_pixels, pixel_layout, pixel_levels
from tactile.base.se2 import compose, correct_heading
from tactile.base.types import Array, Observation

HEALTH_RATE = 0.1
"""Share of the newest revisit in the running health."""
SHOWN = 4
"""Number of competing packets that are shown."""


class RecallOutcome(IntEnum):
    """Outcome of a step."""

    OK = 0
    NOT_FINITE = 1
    """Odometry or view was NaN or infinite and was taken as no motion and no view."""
    FULL = 2
    """A view exceeded the capacity and was not stored."""


class RecallState(NamedTuple):
    """State of the kernel.

    Attributes:
        belief: of the pose cells. memory: of the view cells. packet: [3] the place of the heaviest packet, m,
            m, rad. health: running share of revisits (keyframes near older ones on the map) whose view fits.
    """

    belief: Belief
    memory: Memory
    packet: Array
    health: Array


class RecallEvidence(NamedTuple):
    """Evidence of one step.

    Attributes:
        keyframe to background: see `RecallResult`. certainty: activity of all pose cells. packet, health: see
            `RecallState`. outcome: a `RecallOutcome`, int32.
    """

    keyframe: Scalar
    match: Scalar
    shift: Scalar
    posterior: Scalar
    second: Scalar
    log_ratio: Scalar
    novelty: Scalar
    view_fits: Scalar
    background: Array
    certainty: Scalar
    packet: Array
    health: Scalar
    outcome: Scalar


class RecallBackend(Backend):
    """Bayesian recall with verified loop closures, for views of one shape.

    Args:
        view_shape: (R, C, K) of the observations' views. dtype: of all floating state but the belief.
    """

    SINGLE = ("belief",)

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
        noise = self.recall.excite, self.recall.excite_heading
        self.network = Network(config.pose_cells, *noise, self.recall.miss, self.recall.leak)
        self._anchor, self._follow = jax.jit(self._anchored), jax.jit(self.follow_map)

    def init(self, key: Array, capacity: int) -> RecallState:
        """All is novelty, and no keyframes. `key` is not used: nothing is random."""
        del key
        return RecallState(
            self.no_belief(capacity),
            init_memory(self.recall, self.size, capacity, self.dtype, self.groups),
            jnp.zeros(3, self.dtype),
            jnp.ones((), self.dtype),
        )

    def rows(self, state: RecallState) -> int:
        """Number of keyframes."""
        return int(state.memory.count)

    def grow(self, state: RecallState, capacity: int) -> RecallState:
        """The same memory in larger arrays."""
        empty = self.init(None, capacity)
        grown = state._replace(memory=enlarge(state.memory, empty.memory))
        mass = enlarge(state.belief.mass, empty.belief.mass)
        return grown._replace(belief=state.belief._replace(mass=mass))

    def sides(self, feedback: MapFeedback) -> tuple[int, ...]:
        """Cells of the network along x and y. Pieces of a map need no cells for the ground between them."""
        poses, apart = feedback.poses.copy(), piece_start(1, self.cell)[0]
        poses[:, 0] -= apart * np.round(poses[:, 0] / apart)
        return pose_cells.sides_for(self.network, poses)

    def cover(self, state: RecallState, sides: tuple[int, ...]) -> RecallState:
        """The state with more pose cells, silent until they are driven at the map's feedback."""
        return state._replace(belief=pose_cells.cover(self.network, state.belief, sides))

    def apply_map_feedback(self, state: RecallState, feedback: MapFeedback) -> RecallState:
        """View cells take over the poses, bias and scales of the map, and pose cells follow them: what the
        last view said of each keyframe is driven again at its new pose."""
        if not len(feedback.poses):
            return state
        memory = state.memory
        memory, belief = self._follow(memory, state.belief, memory.pack_feedback(feedback))
        return state._replace(memory=memory, belief=belief)

    def merge_rows(self, state: RecallState, merged: MergedRows) -> RecallState:
        """The memory of the keyframes that remain; mass of merged ones goes to those they are merged with."""
        memory = state.memory.merge_rows(merged)
        belief = pose_cells.merge_rows(state.belief, merged.onto, merged.offset)
        return state._replace(memory=memory, belief=belief)

    def begin_piece(self, state: RecallState) -> RecallState:
        """All is novelty; the health is that of the start."""
        memory, health = state.memory.begin_piece(), jnp.ones((), self.dtype)
        belief = jax.tree.map(jnp.zeros_like, state.belief)
        return state._replace(belief=belief, memory=memory, health=health)

    def crop_rows(self, state: RecallState, cropped: CroppedRows) -> RecallState:
        """The memory of a cropped map; mass of keyframes that are gone becomes novelty."""
        memory = state.memory.crop_rows(cropped)
        belief = pose_cells.lose_rows(state.belief, cropped.left)
        # Anchored at once, because the next feedback may be steps away.
        belief = self._anchor(memory, pose_cells.merge_rows(belief, cropped.rows.onto, cropped.rows.offset))
        return state._replace(belief=belief, memory=memory)

    def state_of(self, map: Map, capacity: int) -> RecallState:
        """The keyframes of a map and the motion since the newest; all of the belief is novelty."""
        assert isinstance(map, KeyframeMap)
        state = self.init(None, capacity)
        if not map.state.count:
            return state
        state = self.remember(map.state, state)
        motion, length, turn = (jnp.array(value, self.dtype) for value in map.travel)
        return state._replace(memory=state.memory._replace(motion=motion, length=length, turn=turn))

    def remember(self, kept: MapState, state: RecallState) -> RecallState:
        """The state, which has room for them, with all keyframes of a map that are not merged; all of its
        belief is novelty."""
        frozen = MapViews(self, kept).freeze(kept.taken.rows, kept.pose.rows, state.memory.label.shape[0])
        return self.begin_piece(state)._replace(memory=frozen, health=state.health)

    def no_belief(self, capacity: int) -> Belief:
        """All is novelty, with view cells for so many keyframes."""
        return pose_cells.start(self.network, (len(sector_shifts(self.recall)), capacity))

    def follow_map(
        self, memory: Memory, belief: Belief, feedback: tuple[Array, Array, Array]
    ) -> tuple[Memory, Belief]:
        """Memory and belief of a map that has moved; pure."""
        memory = memory.take_feedback(feedback)
        return memory, self._anchored(memory, belief)

    def _anchored(self, memory: Memory, belief: Belief) -> Belief:
        return pose_cells.anchor(self.network, belief, filter.view_cells(self.recall, memory), belief.mass)

    def kernel(
        self, state: RecallState, observation: Observation
    ) -> tuple[RecallState, Estimate, RecallEvidence]:
        """Moves by the odometry; a view that becomes a keyframe weighs the belief and is stored.

        Returns:
            the state; the estimate: pose [3] in the map at the last feedback, moved on by odometry, m, m,
            rad, with its standard deviations; the evidence: the candidate for a loop closure and how certain
            it is.
        """
        odometry, view, visible, clean = finite_values(self.dtype, observation)
        seen, view = self.prepare(observation, view, visible)
        moved = jnp.stack([odometry.dx, odometry.dy, odometry.dtheta])
        memory = state.memory.accumulate_motion(moved)
        is_keyframe = seen & memory.is_keyframe_due(self.recall, self.cell)
        features = self.features(view, observation)

        travelled = jnp.hypot(odometry.dx, odometry.dy)
        onwards = compose(state.packet, correct_heading(moved, travelled, memory.bias, memory.turn_error))
        state = state._replace(memory=memory)
        # A loop of at most one round: XLA copies the results of a branch, not what a loop leaves as it is.
        _, state, result = lax.while_loop(
            lambda carry: carry[0],
            lambda carry: (jnp.bool_(False), *self._recall(carry[1], features, observation.label)),
            (is_keyframe, state, filter.empty_result(memory)),
        )
        memory = state.memory
        packet = jnp.where(result.match >= 0, filter.place_of(memory, result), onwards)
        # The running share of revisits whose view fits, after one more revisit.
        updated = state.health + HEALTH_RATE * (result.view_fits.astype(self.dtype) - state.health)
        health = jnp.where(result.view_fits >= 0, updated, state.health)
        has_room = memory.count < memory.label.shape[0]
        outcome = jnp.where(has_room | ~seen, RecallOutcome.OK, RecallOutcome.FULL)
        outcome = jnp.where(clean, outcome, RecallOutcome.NOT_FINITE).astype(jnp.int32)
        sd, sd_heading = memory.pose_spread(self.recall, self.cell)
        # The map assigns places, because only it verifies closures.
        spread, lost = jnp.stack([sd, sd, sd_heading]), health < self.config.min_fit_share
        estimate = Estimate.without_place(memory.current_pose(), spread, lost)
        evidence = RecallEvidence(
            **result._asdict(), certainty=jnp.sum(state.belief.activity), packet=packet, health=health,
            outcome=outcome,
        )  # fmt: skip
        return state._replace(memory=memory, packet=packet, health=health), estimate, evidence

    def probe(self) -> PoseCellProbe:
        """The cells that the network begins with, read where their preferred poses have moved to."""
        cells = self.config.pose_cells
        shape = cells.cells_heading, cells.cells_xy, cells.cells_xy
        units = 2 * np.pi / shape[0], cells.cell_size, cells.cell_size

        def each(state: RecallState, chosen: Array) -> Array:
            motion = state.memory.corrected_motion()
            return pose_cells.activity_at(self.network, state.belief, motion, chosen)

        def active(held: Any) -> tuple[np.ndarray, np.ndarray]:
            at = np.flatnonzero(held)
            return at, np.asarray(held)[at]

        return PoseCellProbe(
            shape,
            cells.cell_size,
            each,
            lambda state: each(state, np.arange(np.prod(shape))),
            active,
            lambda evidence: (evidence.packet / units[::-1]) % shape[::-1],
            lambda evidence: evidence.certainty,
        )

    def sheet_probe(self, sheet: SheetConfig) -> PoseCellProbe:
        """Grid cells, which read the belief where odometry has moved it since the last view."""
        shape, size = grid_cells.sheet_shape(sheet), sheet.spacing / grid_cells.SIDE
        period = np.array([shape[2], 2 * shape[1] if sheet.twisted else shape[1], 1])

        def each(state: RecallState, chosen: Array) -> Array:
            memory, mass = state.memory, state.belief.mass
            motion, here = memory.corrected_motion(), memory.current_pose()
            cells = filter.view_cells(self.recall, memory)
            return grid_cells.sheet_activity(sheet, mass, cells, motion, here, chosen)

        return PoseCellProbe(
            shape,
            size,
            each,
            lambda state: each(state, np.arange(np.prod(shape))),
            lambda held: (np.arange(len(held)), np.asarray(held)),
            lambda evidence: (evidence.packet / [size, size, 2 * np.pi]) % period,
            lambda evidence: evidence.certainty,
        )

    def activity(self, state: RecallState) -> PoseCellActivity:
        cells, memory = np.asarray(state.belief.activity), state.memory
        poses = np.stack([np.asarray(each) for each in (memory.x, memory.y, memory.heading)], axis=1)
        turns = -sector_shifts(self.recall) * float(memory.angle)
        packets = pose_cells.packets(self.network, state.belief, poses, turns, SHOWN)
        return PoseCellActivity(cells.sum(axis=0), cells.sum(axis=(1, 2)), packets)

    def new_map(self) -> KeyframeMap:
        """An empty keyframe map, which compares stored views by the kind of sensor."""
        appearance: Appearance
        if self.labels:
            appearance = LabelAppearance()
        elif self.signed:
            appearance = SignedAppearance(self.size)
        elif self.pixels is not None:
            half_turns = len(sector_shifts(self.recall)) > 1
            appearance = WhiskerAppearance(self.pixels, self.recall.temper, self._normalise, half_turns)
        else:
            # Width of the sectors, rad; 0: to be estimated; None: the views are not ordered sectors.
            view = self.recall.sector_fov
            fan = view if not isinstance(view, str) else 0.0 if view == "auto" else None
            appearance = ViewAppearance(self.size, fan, self._normalise)
        # By odds for views and given ids; with whiskers, sequences are selected against each other.
        by_odds = self.pixels is None and self.ablation.verify
        acceptance: Callable[[MapState], Acceptance]
        acceptance = AcceptByOdds if by_odds else lambda state: AcceptByEvidence()
        return KeyframeMap(
            self.config.keyframes, self.cell, appearance, acceptance, guard=self.recall.guard,
            closures=self.config.experience.closures, ablation=self.ablation, find_tie=PieceTies(self),
        )  # fmt: skip

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

    def _recall(self, state: RecallState, view: Array, label: Array) -> tuple[RecallState, RecallResult]:
        """Recognises and stores a view. While no sectors are known to be ordered, only unshifted views are
        compared and only their view cells computed."""
        shifts = sector_shifts(self.recall)
        if self.pixels is not None or len(shifts) == 1:
            return self._recognise(self.recall, state, view, label)
        plain, row = self.recall.model_copy(update={"shifts": 0}), len(shifts) // 2

        def unshifted(state: RecallState) -> tuple[RecallState, RecallResult]:
            mass = state.belief.mass
            alone = state._replace(belief=state.belief._replace(mass=mass[row : row + 1]))
            after, result = self._recognise(plain, alone, view, label)
            mass = jnp.zeros_like(mass).at[row].set(after.belief.mass[0])
            return after._replace(belief=after.belief._replace(mass=mass)), result

        def shifted(state: RecallState) -> tuple[RecallState, RecallResult]:
            return self._recognise(self.recall, state, view, label)

        if self.labels:
            return unshifted(state)
        return lax.cond(state.memory.angle == 0, unshifted, shifted, state)

    def _recognise(
        self, config: RecallConfig, state: RecallState, view: Array, label: Array
    ) -> tuple[RecallState, RecallResult]:
        motion = state.memory.corrected_motion()
        memory, likelihood = self.likelihood(config, state.memory, view, label)
        belief, result = filter.recognise(
            config, self.network, memory, state.belief, motion, likelihood, self.recall.local
        )
        memory = memory.store_keyframe(view, label)
        return state._replace(belief=belief, memory=memory), result

    def likelihood(
        self, config: RecallConfig, memory: Memory, view: Array, label: Array
    ) -> tuple[Memory, observation_model.ObservationLikelihood]:
        """Likelihood of a view's features, or of an id, at every keyframe of a memory; and the memory with
        what the next view needs."""
        if self.labels:
            return memory, observation_model.label_likelihood(config, memory, label)
        if self.signed:
            return observation_model.signed_likelihood(config, memory, view)
        if self.pixels is not None:
            return observation_model.touch_likelihood(config, memory, view, self.pixels)
        return memory, observation_model.view_likelihood(config, self.cell, memory, view)
