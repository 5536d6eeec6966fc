"""Walled arenas with objects (Fox et al. 2012, II-C and fig. 2), as data and as text.

As text: one item per line, lengths in m, angles in degrees, `#` before comments.

    outer 0 0  1.25 0  1.25 1.25  0 1.25    # corners of the walls, in order
    square 0.6 0.7 0.2 30                   # middle, side, angle
    polygon 1.25 0.5  1.05 0.6  1.25 0.7    # corners of any other object
    start 0.3 0.3 90                        # of the robot, and its heading
"""

from __future__ import annotations

import re
from pathlib import Path as File
from typing import NamedTuple

import numpy as np

from robot.sources.input_files import read_bytes
from robot.world.polygons import (
    polygon_area,
    polygon_contains,
    polygon_edges,
    segment_distance,
    segments_cross,
    square,
)
from tactile.base.errors import InputError

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


def wall_segments(arena: Arena) -> np.ndarray:
    """All wall segments [S, 4], x1, y1, x2, y2, m, those of objects included."""
    return np.vstack([polygon_edges(arena.outer), *(polygon_edges(polygon) for polygon in arena.objects)])


def is_enclosed(arena: Arena, points: np.ndarray) -> np.ndarray:
    """[...] bool, whether points [..., 2] are inside the outer wall; objects are ignored."""
    return polygon_contains(arena.outer, points)


def in_free_space(arena: Arena, points: np.ndarray) -> np.ndarray:
    """[...] bool, whether points [..., 2] are in free space."""
    free = is_enclosed(arena, points)
    for polygon in arena.objects:
        free &= ~polygon_contains(polygon, points)
    return free


def is_occupied(arena: Arena, centres: np.ndarray) -> np.ndarray:
    """[...] bool, whether cells with these centres [..., 2] are in an object or outside the outer wall."""
    return ~in_free_space(arena, centres)


def has_clearance(arena: Arena, places: np.ndarray, radius: float) -> np.ndarray:
    """[...] bool, whether a disc of this radius (m) at places [..., 2] is entirely in free space."""
    room = segment_distance(wall_segments(arena), places).min(axis=-1)
    return in_free_space(arena, places) & (room >= radius)


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
    for line in read:
        if line.word in REQUIRED_LINES and line.word in single:
            raise InputError(line.places[0], f"another `{line.word}`", "one", "remove one of them")
        single[line.word] = line
    for word, meaning in REQUIRED_LINES.items():
        if word not in single:
            raise InputError(str(path), f"has no line `{word}`", f"`{LINE_FORMS[word]}`, {meaning}")
    outer = _polygon(single["outer"])
    objects: list[np.ndarray] = []
    for line in read:
        if line.word not in REQUIRED_LINES:
            polygon = _polygon(line)
            _check_position(line, polygon, outer, objects)
            objects.append(polygon)
    x, y, heading = single["start"].values
    made = Arena(path.stem, outer, tuple(objects), np.array([x, y, np.radians(heading)]))
    if not has_clearance(made, made.start[:2], START_CLEARANCE):
        found = f"a start at {x:g} {y:g} too close to a wall or object"
        expected = f"{START_CLEARANCE:g} m of free space around it"
        raise InputError(single["start"].places[1], found, expected)
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


class _Line(NamedTuple):
    """A line: its keyword, its numbers, and the position of each word."""

    word: str
    values: np.ndarray
    places: list[str]


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
    return _Line(word, np.array(values), places)


def _polygon(line: _Line) -> np.ndarray:
    """The corners of a line's polygon, checked to enclose an area."""
    if line.word == "square":
        return square(line.values[:2], line.values[2], np.radians(line.values[3]))
    corners = line.values.reshape(-1, 2)
    sides = polygon_edges(corners)
    short = np.hypot(*(sides[:, 2:] - sides[:, :2]).T) < 1e-9
    if short.any():
        again = (int(np.argmax(short)) + 1) % len(corners)
        where, cure = line.places[1 + 2 * again], "leave it out: the polygon is closed automatically"
        raise InputError(where, "the same corner twice in a row", "different successive corners", cure)
    crosses = np.argwhere(segments_cross(sides, sides))
    if len(crosses):
        one, other = sorted(crosses[0].tolist())
        found = f"walls that cross: side {one + 1} and side {other + 1}"
        raise InputError(line.places[1 + 2 * one], found, "corners in order around the area")
    if abs(polygon_area(corners)) < 1e-9:
        raise InputError(line.places[0], "corners on one line", "corners that enclose an area")
    return corners


def _check_position(line: _Line, polygon: np.ndarray, outer: np.ndarray, others: list[np.ndarray]) -> None:
    """Raise an error for an object outside the arena or overlapping another one."""
    middle = (polygon + np.roll(polygon, -1, axis=0)) / 2
    probe = np.vstack([polygon, middle]) * (1 - 1e-6) + polygon.mean(axis=0) * 1e-6  # may touch the wall
    sides = polygon_edges(polygon)
    if segments_cross(sides, polygon_edges(outer)).any() or not polygon_contains(outer, probe).all():
        raise InputError(line.places[0], "an object outside the walls", "objects within `outer`")
    for number, other in enumerate(others, 1):
        inside = polygon_contains(other, probe).any() or polygon_contains(polygon, other.mean(axis=0))
        if inside or segments_cross(sides, polygon_edges(other)).any():
            found = f"an object that overlaps object {number}"
            raise InputError(line.places[0], found, "objects that do not overlap", "move one of them")
