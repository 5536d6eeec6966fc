"""Arenas from a seed: square, with square objects, of which the robot can get around every one.

An object touches the wall, or stands so far from it and from other objects that the robot passes between
them. So the robot can reach every place that it fits in.
"""

from __future__ import annotations

from pathlib import Path as File
from typing import Annotated, Self

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat, model_validator

from robot.world.arena import Arena, has_clearance, read_arena
from robot.world.polygons import polygon_contains, polygon_gap, square
from tactile.base.config import Settings
from tactile.base.errors import InputError
from tactile.base.random_streams import stream

Share = Annotated[float, Field(ge=0, le=1)]
MAX_OBJECT_TRIES = 200
"""Tried for the objects of an arena."""
MAX_RESTARTS = 50
"""Of starting over when they found none."""
MAX_START_TRIES = 400
"""Places looked at for a start."""


class ArenaConfig(Settings):
    """A square arena with square objects, its south-west corner at the origin; or any, from a text file."""

    side: PositiveFloat = 1.25
    """Of the arena, m; the paper's second one has 2.5."""
    objects: NonNegativeInt | None = None
    """How many; as many as suit the side where it is left out: 4 on 1.25 m, 7 on 2.5 m."""
    smallest: PositiveFloat = 0.12
    """Side of an object, m."""
    largest: PositiveFloat = 0.25
    """The same."""
    rotated: bool = False
    """Whether objects are turned by any angle."""
    against: Share = 0.75
    """Of objects that touch the wall."""
    passage: PositiveFloat = 0.47
    """Narrowest way between what does not touch, m; the robot is 0.34 m wide, its whiskers sweep 0.54 m."""
    file: File | None = None
    """A text file to take the arena from instead (see `read_arena`)."""
    seed: NonNegativeInt | None = None
    """Of the arena; the session's own where there is none."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.smallest > self.largest:
            raise ValueError(f"smallest: {self.smallest:g} m is larger than largest, {self.largest:g} m")
        if self.largest * np.sqrt(2) > self.side:
            raise ValueError(f"largest: an object of {self.largest:g} m in an arena of {self.side:g} m")
        return self

    @property
    def count(self) -> int:
        return round(2.4 * self.side) + 1 if self.objects is None else self.objects


def make_arena(config: ArenaConfig, seed: int) -> Arena:
    """The arena of a configuration; `seed` counts where it has none of its own.

    Raises:
        InputError: objects that do not fit, or a file that cannot be used.
    """
    if config.file is not None:
        return read_arena(config.file)
    seed = config.seed if config.seed is not None else seed
    random = stream(seed, "arena")
    outer = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * config.side
    for _ in range(MAX_RESTARTS):
        objects = _placed(config, random)
        if objects is None:
            continue
        made = Arena(f"arena {seed}", outer, tuple(objects), np.zeros(3))
        start = _start(made, config.passage / 2, random)
        if start is not None:
            return made._replace(start=start)
    raise InputError(
        "create_simulation.arena.objects",
        f"{config.count} objects of {config.smallest:g} to {config.largest:g} m",
        f"what fits {config.side:g} m with ways of {config.passage:g} m",
        "fewer or smaller objects, or a larger side",
    )


def _placed(config: ArenaConfig, random: np.random.Generator) -> list[np.ndarray] | None:
    """[4, 2] each, put down one by one; None where one found no place."""
    objects: list[np.ndarray] = []
    for _ in range(MAX_OBJECT_TRIES):
        if len(objects) == config.count:
            return objects
        drawn = _drawn(config, random)
        if _allowed(drawn, config, objects):
            objects.append(drawn)
    return None


def _drawn(config: ArenaConfig, random: np.random.Generator) -> np.ndarray:
    """[4, 2] A square somewhere in the arena; some shares of them at a wall, or in a corner."""
    angle = random.uniform(0, np.pi / 2) if config.rotated else 0.0
    corners = square(np.zeros(2), random.uniform(config.smallest, config.largest), angle)
    low, high = -corners.min(axis=0), config.side - corners.max(axis=0)
    place = random.uniform(low, high)
    if random.random() < config.against:
        axis, corner = int(random.integers(2)), random.random() < 0.25
        ends = np.where(random.random(2) < 0.5, low, high)
        place[axis] = ends[axis]
        if corner:
            place = ends
    return corners + place


def _allowed(polygon: np.ndarray, config: ArenaConfig, others: list[np.ndarray]) -> bool:
    """Whether it leaves every way wide enough."""
    room = np.concatenate([polygon.min(axis=0), config.side - polygon.max(axis=0)])
    if ((room > 1e-9) & (room < config.passage)).any():
        return False
    return all(
        polygon_gap(polygon, other) >= config.passage and not polygon_contains(other, polygon[0])
        for other in others
    )


def _start(arena: Arena, room: float, random: np.random.Generator) -> np.ndarray | None:
    """[3] A pose with room around it, m; None where there is none."""
    low, high = arena.outer.min(axis=0), arena.outer.max(axis=0)
    places = random.uniform(low, high, (MAX_START_TRIES, 2))
    heading = random.uniform(-np.pi, np.pi)
    there = np.flatnonzero(has_clearance(arena, places, room))
    return None if not len(there) else np.array([*places[there[0]], heading])
