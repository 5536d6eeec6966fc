"""RatSLAM as published: view templates, pose cells, places and the experience map."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ratslam.classic import experience_map, pose_cells, view_templates
from ratslam.classic.cell_probe import active_cells, activity_of, hold_cells
from ratslam.classic.config import network_of, rings, units
from ratslam.classic.experience_map import ExperienceMap, Places
from ratslam.classic.levels import activity_sums, window_levels
from ratslam.classic.pose_cells import Outcome, PoseCells
from ratslam.classic.view_templates import Templates
from ratslam.core.backend import Backend, PoseCellProbe, enlarge
from ratslam.core.estimates import Estimate, PoseCellActivity, Scalar
from ratslam.core.session import finite_values
from ratslam.methods.config import ClassicBackendConfig
from tactile.base.se2 import wrap
from tactile.base.types import Array, Observation


class ClassicState(NamedTuple):
    """State of the kernel."""

    cells: PoseCells
    templates: Templates
    places: Places
    relative: Array
    """Heading of the robot minus its heading when the current template was stored, rad."""


class ClassicEvidence(NamedTuple):
    """Evidence of one step.

    Attributes:
        template: current template, int32; -1 before the first view. error: of the best match. relative: see
            `ClassicState`. energy: injected into the pose cells. packet: [3] decoded pose, cells.
            window_level: of the adaptive window, int32. outcome: an `Outcome`, int32.
    """

    template: Scalar
    error: Scalar
    relative: Scalar
    energy: Scalar
    packet: Array
    window_level: Scalar
    outcome: Scalar


class ClassicBackend(Backend):
    """RatSLAM as published: only the best match of a view injects activity.

    Args:
        view_shape: (R, C, K) of the observations' views. dtype: of all floating state.
    """

    def __init__(
        self, config: ClassicBackendConfig, view_shape: tuple[int, int, int], dtype: Any = np.float64
    ) -> None:
        self.config = config
        self.view_shape = view_shape
        self.dtype = np.dtype(dtype)
        self.network = network_of(config.pose_cells, config.attractor)
        self.window_levels = window_levels(self.network, self.dtype)
        self.rings = rings(self.network, self.dtype)
        self.units = units(self.network, self.dtype)

    def init(self, key: Array, capacity: int) -> ClassicState:
        """One packet in the middle of the torus, empty memories. `key` is not used: nothing is random."""
        del key
        return ClassicState(
            pose_cells.start(self.network, self.dtype),
            view_templates.start(self.config.templates, self.view_shape, capacity, self.dtype),
            experience_map.start(capacity, self.dtype),
            jnp.zeros((), self.dtype),
        )

    def rows(self, state: ClassicState) -> int:
        """Number of templates, places or links, whichever is largest."""
        return max(int(n) for n in (state.templates.count, state.places.count, state.places.links))

    def grow(self, state: ClassicState, capacity: int) -> ClassicState:
        """The same memories in larger arrays."""
        empty = self.init(None, capacity)
        return state._replace(
            templates=enlarge(state.templates, empty.templates), places=enlarge(state.places, empty.places)
        )

    def kernel(
        self, state: ClassicState, observation: Observation
    ) -> tuple[ClassicState, Estimate, ClassicEvidence]:
        """One step of RatSLAM (Milford & Wyeth 2004; Ball et al. 2013): matches the view, injects activity,
        moves the packet, learns a template and decides on the place."""
        config = self.config
        odometry, view, visible, clean = finite_values(self.dtype, observation)
        view = view_templates.normalise(config.templates, view)
        seen = view_templates.is_seen(config.templates, observation, visible)
        if config.templates.source == "labels":
            match = view_templates.match_label(state.templates, observation.label)
        else:
            match = view_templates.match_view(config.templates, self.view_shape, state.templates, view)
        match = match._replace(error=jnp.where(seen, match.error, jnp.inf))
        memory, energy = view_templates.recall(config.templates, state.templates, match, seen)
        memory, learnt = view_templates.learn(
            memory,
            view.reshape(-1)[: memory.view.shape[0]],
            observation.label,
            state.cells.pose,
            seen & (match.template < 0),
        )
        relative = jnp.where(seen, match.relative, state.relative)
        turned = jnp.stack([jnp.zeros_like(relative), jnp.zeros_like(relative), relative / self.units[2]])

        recalled = (memory.packet[jnp.maximum(match.template, 0)] + turned) % self.rings
        cells, (spread, outcome, level) = pose_cells.step(
            self.network, self.window_levels, state.cells, odometry, recalled, energy
        )
        canonical = (cells.pose - turned) % self.rings
        world, (place, previous, action, room) = experience_map.decide(
            config.places, self.rings, state.places, canonical, memory.current, seen & (memory.current >= 0)
        )

        outcome = jnp.where(learnt & room, outcome, Outcome.FULL)
        outcome = jnp.where(clean, outcome, Outcome.NOT_FINITE).astype(jnp.int32)
        pose = cells.pose * self.units
        estimate = Estimate(
            pose=jnp.stack([pose[0], pose[1], wrap(pose[2])]),
            spread=spread * self.units,
            place=place,
            previous=previous,
            action=action,
            lost=(outcome == Outcome.RESEEDED) | (outcome == Outcome.TOO_FAST),
        )
        evidence = ClassicEvidence(memory.current, match.error, relative, energy, cells.pose, level, outcome)
        return ClassicState(cells, memory, world, relative), estimate, evidence

    def probe(self) -> PoseCellProbe:
        cells, levels = self.config.pose_cells, self.window_levels
        return PoseCellProbe(
            (cells.cells_heading, cells.cells_xy, cells.cells_xy),
            cells.cell_size,
            lambda state, chosen: activity_of(levels, state.cells.activity, chosen).astype(np.float32),
            lambda state: hold_cells(levels, state.cells.activity),
            partial(active_cells, levels),
            lambda evidence: evidence.packet,
            lambda evidence: evidence.energy,
        )

    def activity(self, state: ClassicState) -> PoseCellActivity:
        return activity_sums(self.window_levels, state.cells.activity)

    def new_map(self) -> ExperienceMap:
        """An empty experience map."""
        return ExperienceMap(self.config.experience)
