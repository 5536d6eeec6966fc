"""Walled arenas with objects (Fox et al. 2012, II-C and fig. 2), as data and as text.

As text: one item per line, lengths in m, angles in degrees, `#` before comments.

    outer 0 0  1.25 0  1.25 1.25  0 1.25    # corners of the walls, in order
    square 0.6 0.7 0.2 30                   # middle, side, angle
    polygon 1.25 0.5  1.05 0.6  1.25 0.7    # corners of any other object
    start 0.3 0.3 90                        # of the robot, and its heading

Random arenas are squares with square objects. An object either touches the wall or leaves a passage to the
wall and to other objects wide enough for the robot, which can reach all free space.
"""

from __future__ import annotations

import re
from pathlib import Path as File
from typing import Annotated, NamedTuple, Self

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat, model_validator

from robot.sources.input_files import read_bytes
from robot.world.walls import (
    polygon_area,
    polygon_contains,
    polygon_edges,
    polygon_gap,
    segment_distance,
    segments_cross,
    square,
)
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.settings import Settings

LINE_FORMS = {
    "outer": "outer x y x y x y ...",
    "square": "square x y side angle",
    "polygon": "polygon x y x y x y ...",
    "start": "start x y heading",
}
REQUIRED_LINES = {"outer": "the walls", "start": "the start of the robot"}
START_CLEARANCE = 0.17
"""Radius of free space required at the start, m."""


class Arena(NamedTuple):
    """Attributes:
    name: for reports. outer: [N, 2] corners of the outer wall, m. objects: corners [M, 2] of each, m.
    start: [3] start pose of the robot (x m, y m, heading rad).
    """

    name: str
    outer: np.ndarray
    objects: tuple[np.ndarray, ...]
    start: np.ndarray

    @property
    def side(self) -> float:
        """The larger extent of the outer wall along x and y, m."""
        return float(np.ptp(self.outer, axis=0).max())

    def is_enclosed(self, points: np.ndarray) -> np.ndarray:
        """[...] bool, whether points [..., 2] are inside the outer wall; objects are ignored."""
        return polygon_contains(self.outer, points)

    def in_free_space(self, points: np.ndarray) -> np.ndarray:
        """[...] bool, whether points [..., 2] are in free space."""
        free = self.is_enclosed(points)
        for polygon in self.objects:
            free &= ~polygon_contains(polygon, points)
        return free

    def has_clearance(self, places: np.ndarray, radius: float) -> np.ndarray:
        """[...] bool, whether a disc of this radius (m) at places [..., 2] is entirely in free space."""
        room = segment_distance(wall_segments(self), places).min(axis=-1)
        return self.in_free_space(places) & (room >= radius)


def wall_segments(arena: Arena) -> np.ndarray:
    """All wall segments [S, 4], x1, y1, x2, y2, m, those of objects included."""
    return np.vstack([polygon_edges(polygon) for polygon in (arena.outer, *arena.objects)])


def read_arena(path: File) -> Arena:
    """Read an arena file.

    Raises:
        InputError: the file is not a valid arena; the error gives line and column.
    """
    try:
        lines = read_bytes(path).decode("utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(str(path), f"is not text ({error})", "an arena file in UTF-8") from None
    read = [line for number, content in enumerate(lines, 1) if (line := _parse_line(path, number, content))]
    single: dict[str, _Line] = {}
    for word, values, places in read:
        if word in REQUIRED_LINES and word in single:
            raise InputError(places[0], f"another `{word}`", "one", "remove one of them")
        single[word] = word, values, places
    for word, meaning in REQUIRED_LINES.items():
        if word not in single:
            raise InputError(str(path), f"has no line `{word}`", f"`{LINE_FORMS[word]}`, {meaning}")
    outer = _polygon(single["outer"])
    objects: list[np.ndarray] = []
    for line in read:
        if line[0] not in REQUIRED_LINES:
            polygon = _polygon(line)
            _check_position(line[2][0], polygon, outer, objects)
            objects.append(polygon)
    _, (x, y, heading), places = single["start"]
    made = Arena(path.stem, outer, tuple(objects), np.array([x, y, np.radians(heading)]))
    if not made.has_clearance(made.start[:2], START_CLEARANCE):
        found = f"a start at {x:g} {y:g} too close to a wall or object"
        expected = f"{START_CLEARANCE:g} m of free space around it"
        raise InputError(places[1], found, expected)
    return made


def arena_text(arena: Arena) -> str:
    """The arena in the file format; the inverse of `read_arena`."""

    def line(word: str, values: np.ndarray) -> str:
        return " ".join([word, *(repr(float(value)) for value in values)])

    x, y, heading = arena.start
    lines = [line("outer", arena.outer.ravel())]
    lines += [line("polygon", polygon.ravel()) for polygon in arena.objects]
    lines.append(line("start", np.array([x, y, np.degrees(heading)])))
    return "\n".join(lines) + "\n"


_Line = tuple[str, np.ndarray, list[str]]
"""A line: its keyword, its numbers, and the position of each word."""


def _parse_line(path: File, number: int, content: str) -> _Line | None:
    """A parsed line, or None if it is empty."""
    words = [(found[0], found.start() + 1) for found in re.finditer(r"\S+", content.split("#")[0])]
    if not words:
        return None
    places = [f"{path}:{number}:{column}" for _, column in words]
    word = words[0][0]
    if word not in LINE_FORMS:
        raise InputError(places[0], f"{word!r}", f"one of {', '.join(LINE_FORMS)}")
    values = []
    for (text, _), place in zip(words[1:], places[1:], strict=True):
        try:
            value = float(text)
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise InputError(place, f"{text!r}", "a number", f"`{LINE_FORMS[word]}`")
        values.append(value)
    count = len(values)
    wanted = {"square": 4, "start": 3}.get(word)
    if wanted is None and (count % 2 or count < 6):
        raise InputError(places[0], f"{count} numbers", "at least three corners with two numbers each")
    if wanted is not None and count != wanted:
        raise InputError(places[0], f"{count} numbers", f"`{LINE_FORMS[word]}`")
    if word == "square" and values[2] <= 0:
        raise InputError(places[3], f"a side of {values[2]:g} m", "a side above 0 m")
    return word, np.array(values), places


def _polygon(line: _Line) -> np.ndarray:
    """The corners of a line's polygon, checked to enclose an area."""
    word, values, places = line
    if word == "square":
        return square(values[:2], values[2], np.radians(values[3]))
    corners = values.reshape(-1, 2)
    sides = polygon_edges(corners)
    short = np.hypot(*(sides[:, 2:] - sides[:, :2]).T) < 1e-9
    if short.any():
        again = (int(np.argmax(short)) + 1) % len(corners)
        where, cure = places[1 + 2 * again], "leave it out: the polygon is closed automatically"
        raise InputError(where, "the same corner twice in a row", "different successive corners", cure)
    crosses = np.argwhere(segments_cross(sides, sides))
    if len(crosses):
        one, other = sorted(crosses[0].tolist())
        found = f"walls that cross: side {one + 1} and side {other + 1}"
        raise InputError(places[1 + 2 * one], found, "corners in order around the area")
    if abs(polygon_area(corners)) < 1e-9:
        raise InputError(places[0], "corners on one line", "corners that enclose an area")
    return corners


def _check_position(place: str, polygon: np.ndarray, outer: np.ndarray, others: list[np.ndarray]) -> None:
    """Raise an error for an object outside the arena or overlapping another one."""
    middle = (polygon + np.roll(polygon, -1, axis=0)) / 2
    probe = np.vstack([polygon, middle]) * (1 - 1e-6) + polygon.mean(axis=0) * 1e-6  # may touch the wall
    sides = polygon_edges(polygon)
    if segments_cross(sides, polygon_edges(outer)).any() or not polygon_contains(outer, probe).all():
        raise InputError(place, "an object outside the walls", "objects within `outer`")
    for number, other in enumerate(others, 1):
        inside = polygon_contains(other, probe).any() or polygon_contains(polygon, other.mean(axis=0))
        if inside or segments_cross(sides, polygon_edges(other)).any():
            found = f"an object that overlaps object {number}"
            raise InputError(place, found, "objects that do not overlap", "move one of them")


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
    """The arena with another random start in free space."""
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
    there = np.flatnonzero(arena.has_clearance(places, room))
    return None if not len(there) else np.array([*places[there[0]], heading])
