"""Random square arenas with square objects; the robot can reach all free space.

An object either touches the wall or leaves a passage to the wall and to other objects wide enough for the
robot.
"""

from __future__ import annotations

from pathlib import Path as File
from typing import Annotated, Self

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat, model_validator

from robot.world.arena import Arena, has_clearance, read_arena
from robot.world.polygons import polygon_contains, polygon_gap, square
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.settings import Settings

Share = Annotated[float, Field(ge=0, le=1)]
MAX_OBJECT_TRIES = 200
"""Largest number of positions drawn for the objects of an arena."""
MAX_RESTARTS = 50
"""Largest number of restarts if the objects do not fit."""
MAX_START_TRIES = 400
"""Number of positions drawn for the start of a random arena."""
OTHER_START_TRIES, OTHER_START_CLEARANCE = 1000, 0.2
"""Number of positions drawn for another start, and its free radius, m: a little over the robot's radius."""


class ArenaConfig(Settings):
    """A random square arena with square objects, its south-west corner at the origin, or an arena file."""

    side: Annotated[float, Field(gt=0, le=100)] = 1.25
    """Side length of the arena, m; the second one of the paper has 2.5."""
    objects: Annotated[int, Field(ge=0, le=1000)] | None = None
    """Number of objects; null: proportional to the side, 4 on 1.25 m and 7 on 2.5 m."""
    smallest: PositiveFloat = 0.12
    """Smallest side of an object, m."""
    largest: PositiveFloat = 0.25
    """Largest side of an object, m."""
    rotated: bool = False
    """Whether objects are rotated by random angles."""
    against: Share = 0.75
    """Fraction of objects that touch the wall."""
    passage: PositiveFloat = 0.47
    """Narrowest passage between objects and walls that do not touch, m; the robot is 0.34 m wide, with its
    whiskers 0.54 m."""
    file: File | None = None
    """An arena file to use instead (see `read_arena`)."""
    seed: NonNegativeInt | None = None
    """Seed of the arena; null: that of the session."""

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
    """The arena of a configuration; `seed` is used if it has none of its own.

    Raises:
        InputError: the objects do not fit, or the file is not a valid arena.
    """
    if config.file is not None:
        return read_arena(config.file)
    seed = config.seed if config.seed is not None else seed
    random = stream(seed, "arena")
    outer = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * config.side
    for _ in range(MAX_RESTARTS):
        objects = _place_objects(config, random)
        if objects is None:
            continue
        made = Arena(f"arena {seed}", outer, tuple(objects), np.zeros(3))
        start = _draw_start(made, config.passage / 2, random, MAX_START_TRIES)
        if start is not None:
            return made._replace(start=start)
    found = f"{config.count} objects of {config.smallest:g} to {config.largest:g} m"
    expected = f"objects that fit in {config.side:g} m with passages of {config.passage:g} m"
    cure = "fewer or smaller objects, or a larger side"
    raise InputError("create_simulation.arena.objects", found, expected, cure)


def place_start(arena: Arena, seed: int) -> Arena:
    """The arena with another random start in free space.

    Raises:
        InputError: no start was found.
    """
    start = _draw_start(arena, OTHER_START_CLEARANCE, stream(seed, "start"), OTHER_START_TRIES)
    if start is None:
        room = f"{OTHER_START_CLEARANCE:g} m of free space"
        raise InputError("create_simulation.arena", "no room for a start", room)
    return arena._replace(start=start)


def _place_objects(config: ArenaConfig, random: np.random.Generator) -> list[np.ndarray] | None:
    """Corners [4, 2] of each object, placed one by one; None if they do not fit."""
    objects: list[np.ndarray] = []
    for _ in range(MAX_OBJECT_TRIES):
        if len(objects) == config.count:
            return objects
        drawn = _draw_object(config, random)
        if _leaves_passages(drawn, config, objects):
            objects.append(drawn)
    return None


def _draw_object(config: ArenaConfig, random: np.random.Generator) -> np.ndarray:
    """Corners [4, 2] of a random square in the arena, some of them at a wall or in a corner."""
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


def _leaves_passages(polygon: np.ndarray, config: ArenaConfig, others: list[np.ndarray]) -> bool:
    """Whether an object leaves all passages wide enough."""
    room = np.concatenate([polygon.min(axis=0), config.side - polygon.max(axis=0)])
    if ((room > 1e-9) & (room < config.passage)).any():
        return False
    return all(
        polygon_gap(polygon, other) >= config.passage and not polygon_contains(other, polygon[0])
        for other in others
    )


def _draw_start(arena: Arena, room: float, random: np.random.Generator, tries: int) -> np.ndarray | None:
    """A random pose [3] with this free radius (m), or None if none was found."""
    low, high = arena.outer.min(axis=0), arena.outer.max(axis=0)
    places = random.uniform(low, high, (tries, 2))
    heading = random.uniform(-np.pi, np.pi)
    there = np.flatnonzero(has_clearance(arena, places, room))
    return None if not len(there) else np.array([*places[there[0]], heading])
