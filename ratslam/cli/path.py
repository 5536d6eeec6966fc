"""The command path."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ratslam.cli.common import Commands, prepare_jax
from tactile.base.errors import InputError, tell
from tactile.base.new_file import require_new_file

if TYPE_CHECKING:
    from ratslam.places.route import Way

Place = tuple[float, float] | int
"""A point x, y (m) or the number of an experience."""
NO_WAY = 1
"""Exit code where no way joins start and goal."""


def add_commands(commands: Commands) -> None:
    """Registers the commands of this module."""
    path = commands.add(
        "path", _path, "find the way on a saved map", "path runs/square --from here --to -0.1,0.8", "maps"
    )
    path.add_argument("map", type=Path, metavar="MAP", help="run directory, or its map.npz")
    path.add_argument(
        "--from", dest="start", default="here", metavar="X,Y|EXPERIENCE|here",
        help="start: a point, m, such as -0.1,0.2, an experience, or the map's last pose (default)",
    )  # fmt: skip
    path.add_argument(
        "--to", dest="goal", required=True, metavar="X,Y|EXPERIENCE",
        help="goal: a point, m, such as -0.1,0.2, or an experience; the way ends at the first experience "
        "within 0.02 m of it, at any heading",
    )  # fmt: skip
    path.add_argument(
        "--mode", choices=("time", "temporal"), default="time",
        help="least expected time (default), or RatSLAM's goal temporal map",
    )  # fmt: skip
    path.add_argument(
        "-o", "--output", type=Path, metavar="PNG", check=_require_new_picture,
        help="draw the way to a new file",
    )  # fmt: skip
    path.add_argument("--json", action="store_true", help="print JSON")


def _path(arguments: argparse.Namespace) -> int:
    start = None if arguments.start == "here" else read_place(arguments.start, "--from")
    goal = read_place(arguments.goal, "--to")
    prepare_jax()
    from ratslam.places.route import NoWay
    from ratslam.runs.map_way import draw_map_way, find_map_way
    from ratslam.runs.saved_map import read_map

    saved = read_map(arguments.map, tell)
    made = saved.open_session().map
    try:
        way = find_map_way(made, saved, start, goal, arguments.mode)
    except NoWay as error:
        print(f"ratslam: no way: {error}", file=sys.stderr)
        return NO_WAY
    if arguments.output is not None:
        draw_map_way(arguments.output, made, saved, way)
    content = way._asdict() | {"poses": way.poses.tolist()}
    print(json.dumps(content) if arguments.json else render_way(way, goal))
    return 0


def render_way(way: Way, goal: Place) -> str:
    """A way to a goal as text."""
    places = way.experiences
    lines = [
        f"{len(places)} experiences from {places[0]} to {places[-1]}: {way.length:.2f} m, {way.seconds:.0f} s"
    ]
    if not isinstance(goal, int):
        apart = math.dist(way.poses[-1][:2], goal)
        lines.append(f"ends {apart:.2f} m from {goal[0]:g},{goal[1]:g}")
    elif places[-1] != goal:
        lines.append(f"ends at {places[-1]}, which is so near to {goal} that it counts as the same place")
    lines.append(
        f"expected {way.expected:.0f} s, as a link may be blocked: one driven n times before is counted as "
        "free with probability (n + 1) / (n + 2)"
    )
    return "\n".join(lines)


def read_place(text: str, where: str) -> Place:
    """The place of a text.

    Raises:
        InputError: it is not a place.
    """
    try:
        if "," not in text:
            return int(text)
        x, y = map(float, text.split(","))
        if math.isfinite(x) and math.isfinite(y):
            return x, y
    except ValueError:
        pass
    raise InputError(where, repr(text), "X,Y in m (finite numbers), or the number of an experience")


def _require_new_picture(path: Path) -> None:
    if path.suffix.lower() != ".png":
        raise InputError(f"-o {path}", "not the name of a picture", "a new file that ends in .png")
    require_new_file(path)
