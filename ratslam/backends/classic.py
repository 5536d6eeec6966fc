"""The rat: view templates recall, pose cells integrate, places and the experience map remember."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

from ratslam.attractor import adaptive_window, pose_cells
from ratslam.attractor.config import PoseCellConfig, rings, units
from ratslam.attractor.pose_cells import Outcome, PoseCells
from ratslam.classic import places, view_templates
from ratslam.classic.experience_map import ExperienceConfig, ExperienceMap
from ratslam.classic.places import PlaceConfig, Places
from ratslam.classic.view_templates import Match, TemplateConfig, Templates
from ratslam.core.types import Estimate
from ratslam.keyframes.config import FrameMapConfig
from ratslam.recall.filter import RecallConfig
from tactile.base.config import Settings
from tactile.base.se2 import wrap
from tactile.base.types import Array, Observation, Odometry


class RatConfig(Settings):
    """Every parameter of the rat backend."""

    matcher: Literal["recall", "classic"] = "recall"
    """`recall`: the unified filter and the frame map; `classic`: winner takes all, as RatSLAM does."""
    pose_cells: PoseCellConfig = PoseCellConfig()
    """The attractor network."""
    templates: TemplateConfig = TemplateConfig()
    """View matching."""
    places: PlaceConfig = PlaceConfig()
    """When a place is made, reached or kept."""
    experience: ExperienceConfig = ExperienceConfig()
    """The classic map; `closures` holds for both."""
    recall: RecallConfig = RecallConfig()
    """The unified filter."""
    frames: FrameMapConfig = FrameMapConfig()
    """The map of frames, for the unified filter."""
    lost: Annotated[float, Field(ge=0, le=1)] = 0.25
    """Share of fitting revisits under which the robot is lost (see `RecallEvidence.health`)."""


class State(NamedTuple):
    """All that the neural half remembers."""

    cells: PoseCells
    templates: Templates
    places: Places
    relative: Array
    """Heading of the robot less that at which the current template was stored, rad."""


class RatEvidence(NamedTuple):
    """What one step adds to the map and to the record.

    Attributes:
        template: int32, -1 while no view was ever seen. error: of the best match. relative: rad, see `State`.
        energy: injected. packet: [3] decoded, cells. rung: of the ladder of patches, int32. outcome: an
            `Outcome`, int32.
    """

    template: Array
    error: Array
    relative: Array
    energy: Array
    packet: Array
    rung: Array
    outcome: Array


class Rat:
    """The rat backend for views of one shape.

    Args:
        view_shape: (R, C, K) of the observations' views. dtype: of all floating state.
    """

    def __init__(self, config: RatConfig, view_shape: tuple[int, int, int], dtype: Any = np.float64) -> None:
        self.config = config
        self.view_shape = view_shape
        self.dtype = np.dtype(dtype)
        self.rungs = adaptive_window.rungs(config.pose_cells, self.dtype)
        self.rings = rings(config.pose_cells, self.dtype)
        self.units = units(config.pose_cells, self.dtype)

    def init(self, key: Array, capacity: int) -> State:
        """One packet in the middle of an empty world. Nothing here is random, so `key` is not used."""
        del key
        return State(
            pose_cells.start(self.config.pose_cells, self.dtype),
            view_templates.start(self.config.templates, self.view_shape, capacity, self.dtype),
            places.start(capacity, self.dtype),
            jnp.zeros((), self.dtype),
        )

    def rows(self, state: State) -> int:
        """Templates, places or links, whichever are most."""
        return max(int(n) for n in (state.templates.count, state.places.count, state.places.links))

    def grow(self, state: State, capacity: int) -> State:
        """The same memories in larger arrays."""
        empty = self.init(None, capacity)

        def enlarge(old: Array, new: Array) -> Array:
            return new.at[tuple(slice(0, size) for size in old.shape)].set(old) if old.shape else old

        memories = jax.tree.map(enlarge, (state.templates, state.places), (empty.templates, empty.places))
        return state._replace(templates=memories[0], places=memories[1])

    def inform(self, state: State, guidance: None) -> State:
        """The classic map tells its kernel nothing."""
        del guidance
        return state

    def kernel(self, state: State, observation: Observation) -> tuple[State, Estimate, RatEvidence]:
        """See, recall, inject and move, decode, learn, decide."""
        config = self.config
        odometry, view, seen, clean = finite(config.templates, self.dtype, observation)

        match = self._match(state.templates, view, observation.label, seen)
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
        cells, told = pose_cells.step(config.pose_cells, self.rungs, state.cells, odometry, recalled, energy)
        canonical = (cells.pose - turned) % self.rings
        world, decision = places.decide(
            config.places, self.rings, state.places, canonical, memory.current, seen & (memory.current >= 0)
        )

        outcome = jnp.where(learnt & decision.room, told.outcome, Outcome.FULL)
        outcome = jnp.where(clean, outcome, Outcome.NOT_FINITE).astype(jnp.int32)
        pose = cells.pose * self.units
        estimate = Estimate(
            pose=jnp.stack([pose[0], pose[1], wrap(pose[2])]),
            spread=told.spread * self.units,
            place=decision.place,
            previous=decision.previous,
            action=decision.action,
            lost=(outcome == Outcome.RESEEDED) | (outcome == Outcome.TOO_FAST),
        )
        evidence = RatEvidence(memory.current, match.error, relative, energy, cells.pose, told.rung, outcome)
        return State(cells, memory, world, relative), estimate, evidence

    def new_map(self) -> ExperienceMap:
        """An empty experience map."""
        return ExperienceMap(self.config.experience)

    def _match(self, store: Templates, view: Array, label: Array, seen: Array) -> Match:
        if self.config.templates.source == "labels":
            match = view_templates.match_label(store, label)
        else:
            match = view_templates.match_view(self.config.templates, self.view_shape, store, view)
        return match._replace(error=jnp.where(seen, match.error, jnp.inf))


def finite(
    config: TemplateConfig, dtype: np.dtype, observation: Observation
) -> tuple[Odometry, Array, Array, Array]:
    """The observation in this precision, with anything that is not a number masked.

    Returns:
        odometry; the view as it is stored and compared; whether there is a view (or given id); whether all of
        it was finite.
    """
    odometry = Odometry(*(jnp.asarray(value, dtype) for value in observation.odometry))
    moves = jnp.stack(odometry[:3])
    fine = jnp.all(jnp.isfinite(moves))
    dx, dy, dtheta = jnp.where(fine, moves, 0.0)
    view = jnp.asarray(observation.view, dtype)
    visible = jnp.all(jnp.isfinite(view))
    view = view_templates.normalise(config, jnp.where(visible, view, 0.0))
    given = observation.label >= 0 if config.source == "labels" else observation.view_seen & visible
    return Odometry(dx, dy, dtheta, odometry.dt), view, given, fine & (visible | ~observation.view_seen)


def from_parameters(params: dict[str, Any], labels: bool) -> RatConfig:
    """The configuration that a reference stream's parameters ask for (`ratslam/README.md` has the table).

    Args:
        params: names and values of OpenRatSLAM's [ratslam] section; missing ones take its defaults.
        labels: whether the stream gives template ids instead of views.
    """
    names = {
        "pose_cells": {
            "pc_dim_xy": "cells_xy",
            "pc_dim_th": "cells_heading",
            "pc_cell_x_size": "cell_size",
            "pc_w_e_dim": "excite_width",
            "pc_w_e_var": "excite_sigma",
            "pc_w_i_dim": "inhibit_width",
            "pc_w_i_var": "inhibit_sigma",
            "pc_global_inhib": "global_inhibition",
        },
        "templates": {
            "vt_shift_match": "shift",
            "vt_step_match": "shift_step",
            "vt_panoramic": "panoramic",
            "vt_match_threshold": "threshold",
            "vt_active_decay": "habituation",
            "pc_vt_restore": "recovery",
            "pc_vt_inject_energy": "energy",
        },
    }
    defaults = {
        "pc_dim_xy": 21,
        "pc_dim_th": 36,
        "pc_cell_x_size": 1.0,
        "vt_shift_match": 25,
        "vt_step_match": 5,
        "vt_match_threshold": 0.03,
        "vt_panoramic": 0,
        "exp_delta_pc_threshold": 2.0,
    }
    given = defaults | {name: float(value) for name, value in params.items()}
    whole = {
        "pc_dim_xy",
        "pc_dim_th",
        "pc_w_e_dim",
        "pc_w_i_dim",
        "vt_shift_match",
        "vt_step_match",
        "vt_panoramic",
    }
    given = {name: int(value) if name in whole else value for name, value in given.items()}
    parts: dict[str, dict[str, Any]] = {
        part: {ours: given[theirs] for theirs, ours in table.items() if theirs in given}
        for part, table in names.items()
    }
    parts["templates"] |= {
        "source": "labels" if labels else "views",
        "panoramic": bool(given["vt_panoramic"]),
    }
    radius = given["exp_delta_pc_threshold"]
    return RatConfig.model_validate(
        {"matcher": "classic", **parts, "places": {"radius": radius, "radius_heading": radius}}
    )
